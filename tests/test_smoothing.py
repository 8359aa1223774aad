"""Curves as smooth as the readings say: against curves that are known, and SciPy's smoothing spline."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import make_smoothing_spline

from ehsvjax.diagnosis.hypotheses.smoothing import of_one_wave, smoothed

KNOTS = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.09, 60)) - 1.0
ALONG = np.random.default_rng(1).uniform(KNOTS[0], KNOTS[-1], 3000)
HATS = np.stack([np.interp(ALONG, KNOTS, np.eye(len(KNOTS))[k]) for k in range(len(KNOTS))])


def noise(seed, deviation=1.0):
    return deviation * np.random.default_rng(seed).standard_normal(len(ALONG))


def deviation(found):
    return np.sqrt(np.diag(found.covariance))


@given(seed=st.integers(0, 10_000), size=st.floats(0.1, 100.0), slope=st.floats(-100.0, 100.0))
@settings(max_examples=20, deadline=None)
def test_a_straight_line_needs_two_pieces(seed, size, slope):
    truth = size + slope * KNOTS
    found = smoothed(KNOTS, HATS, truth @ HATS + noise(seed))
    assert found.pieces > 1.99
    assert np.max(np.abs(found.coefficients - truth) / deviation(found)) < 6.0


def test_a_straight_line_hardly_ever_takes_more():
    pieces = np.array([smoothed(KNOTS, HATS, HATS.sum(axis=0) + noise(seed)).pieces for seed in range(400)])
    assert np.mean(pieces > 8.0) < 0.01 and np.mean(pieces > 4.0) < 0.1


@pytest.mark.parametrize("size", [1.0, 5.0, 50.0])
def test_a_bump_is_found_within_its_band(size):
    truth = size * np.exp(-0.5 * ((KNOTS - 0.7) / 0.15) ** 2)
    inside = []
    for seed in range(20):
        found = smoothed(KNOTS, HATS, truth @ HATS + noise(seed))
        inside.append(np.abs(found.coefficients - truth) < 1.96 * deviation(found))
        assert np.corrcoef(found.coefficients, truth)[0, 1] > 0.9
    # Bayesian bands of curves cover 95% on average over the curve (Wahba 1983).
    assert 0.88 < np.mean(inside) < 0.995


def test_the_curve_is_near_that_of_a_smoothing_spline():
    truth = 4.0 * np.sin(3.0 * ALONG)
    readings = truth + noise(3)
    at = np.linspace(KNOTS[0], KNOTS[-1], 150)
    means = [readings[np.abs(ALONG - a) < 0.5 * (at[1] - at[0])].mean() for a in at]
    spline = make_smoothing_spline(at, means)
    found = smoothed(KNOTS, HATS, readings)
    apart = np.sqrt(np.mean((found.coefficients - spline(KNOTS)) ** 2))
    assert apart < 0.2
    # Both are nearer to each other than the noise lets them be to the truth.
    assert apart < 2.0 * np.sqrt(np.mean((spline(KNOTS) - 4.0 * np.sin(3.0 * KNOTS)) ** 2))


def test_what_was_projected_out_is_left_out():
    # Unknowns beside the curve can do a constant.
    constant = np.ones(len(ALONG)) / np.sqrt(len(ALONG))
    responses = HATS - np.outer(HATS @ constant, constant)
    truth = 10.0 + 3.0 * KNOTS**2
    found = smoothed(KNOTS, responses, truth @ responses + noise(4))
    assert np.corrcoef(found.coefficients, truth)[0, 1] > 0.999
    assert np.ptp(found.coefficients - truth) < 1.0
    # It is not known where the curve begins, and nobody claims to.
    assert abs(np.mean(found.coefficients)) < 10.0


def test_noise_larger_than_said_does_not_roughen_the_curve():
    found = smoothed(KNOTS, HATS, 2.0 * KNOTS @ HATS + noise(5, deviation=20.0))
    assert found.pieces < 8.0


def test_a_line_has_its_price_and_noise_is_no_evidence_for_one():
    evidence = [smoothed(KNOTS, HATS, noise(seed)).evidence for seed in range(20)]
    assert np.mean(np.array(evidence) < 0.0) > 0.9
    assert smoothed(KNOTS, HATS, 2.0 * KNOTS @ HATS + noise(6)).evidence > 1000.0


def test_a_wave_is_the_least_squares_one_and_its_covariance_that_of_many_draws():
    responses = np.stack([np.cos(40.0 * ALONG), np.sin(40.0 * ALONG)])
    truth = np.array([0.3, -0.2])
    found = [of_one_wave(responses, truth @ responses + noise(seed)) for seed in range(400)]
    coefficients = np.stack([f.coefficients for f in found])
    assert coefficients.mean(axis=0) == pytest.approx(truth, abs=5.0 * (2.0 / 3000 / 400) ** 0.5)
    assert np.cov(coefficients.T) == pytest.approx(found[0].covariance, abs=0.25 * 2.0 / 3000)
    readings = truth @ responses + noise(0)
    expected = np.linalg.lstsq(responses.T, readings, rcond=None)
    assert found[0].coefficients == pytest.approx(expected[0]) and found[0].left == pytest.approx(expected[1][0])
    assert found[0].evidence == pytest.approx(readings @ readings - found[0].left - 3.0 * np.log(3000))
