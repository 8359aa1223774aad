"""Fits side by side: figures worked out by hand, and what must be refused."""

import jax
import numpy as np
import pytest

import ehsvjax
from tests import hand_made


def better():
    """A fit with gain 2.1 and load 0.3: 2.4, 4.5, 6.6, 8.7 N, off by 0.2, -0.1 and -0.1 N."""
    return hand_made.fit(parameters={"gain": 2.1}, initial=({"initial_load": 0.3},))


def test_fits_of_one_record_are_told_apart_by_hand_made_figures():
    fits = {"first": hand_made.fit(), "second": better()}
    found = ehsvjax.compare(fits, hand_made.record())
    first, second = found.scores.to_dict("records")
    assert (first["fit"], first["record"], first["output"], first["unit"]) == ("first", "bench 7", "force", "N")
    assert first["used"] == "fitted"
    assert first["rmse"] == pytest.approx(0.1)
    assert second["rmse"] == pytest.approx((0.06 / 3.0) ** 0.5)
    assert first["fit %"] == pytest.approx(100.0 * (1.0 - (0.03 / 18.96) ** 0.5))
    # -n/2 (log(2 pi s^2) + 1) of three readings; a gain and a variance, the load was known.
    likelihood = -1.5 * (np.log(2.0 * np.pi * 0.01) + 1.0)
    assert found.criteria.loc["first", "log likelihood"] == pytest.approx(likelihood)
    assert found.criteria.loc["first", "AIC"] == pytest.approx(4.0 - 2.0 * likelihood)
    assert found.criteria.loc["first", "BIC"] == pytest.approx(2.0 * np.log(3.0) - 2.0 * likelihood)
    assert found.criteria.loc["second", "AIC"] > found.criteria.loc["first", "AIC"]


def test_a_record_that_was_not_fitted_is_predicted():
    other = hand_made.record_of_both("bench 8")
    found = ehsvjax.compare([hand_made.fit(other), hand_made.fit(other)], [other, other.slice(0.4)])
    assert found.scores["fit"].unique().tolist() == ["amplifier", "amplifier #2"]
    assert found.scores["record"].unique().tolist() == ["bench 8", "bench 8 #2"]
    assert found.scores["used"].tolist() == 2 * (2 * ["fitted"] + 2 * ["predicted"])
    text = str(found)
    assert "bench 8 #2" in text and "amplifier #2" in text and "BIC" in text
    assert found._repr_html_().count("<table") == 2


def test_fits_of_unlike_records_have_no_criteria():
    fits = [hand_made.fit(), hand_made.fit(hand_made.record().slice(0.4))]
    found = ehsvjax.compare(fits, hand_made.record())
    assert len(found.criteria) == 0 and "BIC" not in str(found)


def test_a_fit_that_was_loaded_is_of_the_same_record(tmp_path):
    record = ehsvjax.Record(np.arange(200) * 0.02, {"command": np.sin(np.arange(200.0))}, {})
    position = ehsvjax.simulate(ehsvjax.van_der_pol(), record)["position"] + 1e-3 * np.cos(np.arange(200.0) ** 2)
    record = ehsvjax.Record(record.time, record.inputs, {"position": position})
    fit = ehsvjax.identify(ehsvjax.van_der_pol(), record, key=jax.random.key(0), population=8, generations=2)
    fit.save(tmp_path / "fit.npz")
    found = ehsvjax.compare({"now": fit, "then": ehsvjax.Fit.load(tmp_path / "fit.npz")}, record)
    assert found.scores["used"].tolist() == ["fitted", "fitted"] and len(found.criteria) == 2


def test_a_comparison_is_drawn_with_every_fit():
    other = hand_made.record_of_both()
    figure = ehsvjax.compare({"old": hand_made.fit(other), "new": hand_made.fit(other)}, other).plot()
    assert len(figure.axes) == 2
    labels = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert labels == ["measured", "old: 96.02 %", "new: 96.02 %"]


@pytest.mark.parametrize("fits", [[], {}, "fit", [1], {"a": 1}, None, 3.0])
def test_what_is_no_fit_is_refused(fits):
    with pytest.raises(ValueError, match="expected fits"):
        ehsvjax.compare(fits, hand_made.record())
