"""Correlations of residuals against closed forms, and how often their bands hold what chance makes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from ehsvjax.correlations import with_input, with_itself
from tests import hand_made


def remembering(rng, pole, count):
    return lfilter([1.0], [1.0, -pole], rng.standard_normal(count + 300))[300:]


def test_an_autoregression_forgets_geometrically():
    found = with_itself(remembering(np.random.default_rng(0), 0.8, 200_000), 10)
    np.testing.assert_array_equal(found.lags, np.arange(1, 11))
    np.testing.assert_allclose(found.values, 0.8**found.lags, atol=0.02)


def test_what_comes_after_an_input_shows_at_its_delay():
    driving = np.random.default_rng(1).standard_normal(5000)
    found = with_input(np.roll(driving, 7) + np.random.default_rng(2).standard_normal(5000), driving, 20)
    outside = found.lags[np.abs(found.values) > 2.0 * found.band]
    assert outside.tolist() == [7.0]
    assert found.values[found.lags == 7.0] == pytest.approx(0.5**0.5, abs=0.03)


@pytest.mark.parametrize("pole", [0.0, 0.7, 0.95])
def test_bands_hold_what_chance_makes(pole):
    """An input and a residual that have nothing to do with each other, however slow both are."""
    rng = np.random.default_rng(3)
    crossed = []
    for _ in range(60):
        found = with_input(remembering(rng, pole, 2000), remembering(rng, pole, 2000), 25)
        crossed.append(np.mean(np.abs(found.values) > found.band))
    assert 0.0 < np.mean(crossed) < 0.03  # 0.01 is expected; neighbours of a slow series cross together


def test_white_noise_stays_in_its_band():
    rng = np.random.default_rng(4)
    crossed = [np.mean(np.abs(f.values) > f.band) for f in (with_itself(rng.normal(size=1000), 25) for _ in range(100))]
    assert 0.004 < np.mean(crossed) < 0.02


def test_missing_readings_count_for_nothing():
    rng = np.random.default_rng(5)
    residual = remembering(rng, 0.8, 50_000)
    residual[rng.random(50_000) < 0.1] = np.nan
    found = with_itself(residual, 3)
    assert found.band == pytest.approx(2.576 / np.isfinite(residual).sum() ** 0.5, rel=1e-3)
    np.testing.assert_allclose(found.values, 0.8**found.lags, atol=0.03)


def test_what_is_left_is_drawn_for_every_output_and_input():
    figure = hand_made.fit(hand_made.record_of_both()).plot_residuals()
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles == 2 * ["with itself", "with command", "its values", "its power, and that of white noise"]
    assert figure.axes[2].get_xlabel() == "residual (mN)"


def test_a_record_without_output_leaves_nothing_to_draw():
    with pytest.raises(ValueError, match="expected bench 7 to hold an output to draw, got none"):
        hand_made.fit().plot_residuals(replace(hand_made.record("bench 7"), outputs={}))
