"""A fit as tables, against what a fit made by hand is known to hold."""

import numpy as np
import pandas as pd
import pytest

from tests import hand_made


def test_the_parameters_are_a_table_for_reports():
    table = hand_made.fit().table
    assert table.index.name == "parameter" and list(table.index) == ["gain", "temperature"]
    gain, temperature = table.loc["gain"], table.loc["temperature"]
    # 0.03 N^2 over 3 - 1 degrees of freedom, over 1 + 4 + 16 V^2.
    assert (gain["value"], gain["unit"], gain["symbol"], gain["lower"], gain["upper"]) == (2.0, "N/V", "k", 0.5, 5.0)
    assert gain["standard_error"] == pytest.approx((0.015 / 21.0) ** 0.5) and gain["identified"]
    assert temperature["value"] == 293.0 and not temperature["identified"]
    assert np.isnan([temperature["standard_error"], temperature["lower"], temperature["upper"]]).all()
    assert r"N/V" in table.to_latex()


def test_a_fit_that_cannot_be_simulated_has_a_table_without_errors():
    table = hand_made.fit(parameters={"gain": np.inf}).table
    assert table.loc["gain", "value"] == np.inf and np.isnan(table["standard_error"]).all()


def test_a_record_is_a_table_with_what_is_simulated_and_left():
    fit = hand_made.fit()
    frame = fit.to_dataframe()
    assert list(frame) == [
        "time", "command", "force", "force, simulated", "force, left", "strain, simulated"
    ]  # fmt: skip
    np.testing.assert_allclose(frame["force, simulated"], [2.5, 4.5, 6.5, 8.5])
    np.testing.assert_allclose(frame["force, left"], [0.1, -0.1, np.nan, 0.1], atol=1e-12)
    both = fit.to_dataframe(hand_made.record_of_both(), {"initial_load": 1.5})
    np.testing.assert_allclose(both["strain, left"], np.full(4, 1e-4 - 1e-3), atol=1e-12)
    pd.testing.assert_series_equal(both["time"], frame["time"])
