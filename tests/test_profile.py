"""Profile likelihood intervals: against closed forms, SciPy's root finder, and bounds."""

import jax
import numpy as np
import pytest
from scipy.optimize import brentq

import ehsvjax
from tests.test_standard_errors import _fit

TIME = np.arange(60) * 0.05


def _decay(lower=0.05, upper=20.0):
    def measure(parameters, state, inputs, signal):
        return {"y": signal("y", state["x"])}

    def derivative(parameters, state, inputs, signal):
        return {"x": -parameters["rate"] * state["x"] + inputs["u"]}

    return ehsvjax.Model(
        name="decay",
        parameters=(ehsvjax.Parameter("rate", "k", "1/s", min(max(1.0, lower), upper), lower, upper, "log"),),
        initial=(ehsvjax.Parameter("start", "x0", "", 1.0, 0.5, 1.5, fixed=True),),
        signals=(ehsvjax.Signal("u", "input", ""), ehsvjax.Signal("y", "sensor", "")),
        start=_start,
        stepper=ehsvjax.runge_kutta_4(derivative),
        measure=measure,
        max_step=0.02,
    )


def _start(parameters, initial, inputs):
    return {"x": initial["start"]}


def _identified(model, rate=2.0, noise=0.15):
    y = np.exp(-rate * TIME) + np.random.default_rng(1).normal(0.0, noise, len(TIME))
    record = ehsvjax.Record(TIME, {"u": np.zeros(len(TIME))}, {"y": y})
    return ehsvjax.identify(
        model, record, key=jax.random.key(0), population=16, generations=12, noise_variance={"y": noise**2}
    )


def test_linear_model_has_the_interval_of_its_standard_error():
    fit = _fit()
    profile = fit.profile_likelihood(noise="white")
    lower, upper = profile.intervals["gain"]
    expected = fit.precision("white").intervals()["gain"]
    # To first order in n: least squares counts n - p degrees of freedom in both.
    assert (lower, upper) == pytest.approx(expected, rel=1e-4)
    assert profile.profiles["gain"].at_bound == (False, False)
    assert profile.better == pytest.approx(0.0, abs=0.01)
    assert "gain" in str(profile) and "95%" in str(profile)


@pytest.mark.parametrize("level", [0.68, 0.95])
def test_crooked_cost_has_the_interval_that_scipy_finds(level):
    fit = _identified(_decay())
    y, rate = fit.records[0].outputs["y"], fit.parameters["rate"]

    def rise(k):
        return (np.sum((y - np.exp(-k * TIME)) ** 2) - np.sum((y - np.exp(-rate * TIME)) ** 2)) / 0.15**2

    threshold = {0.68: 0.9889, 0.95: 3.8415}[level]
    expected = [brentq(lambda k: rise(k) - threshold, *ends) for ends in ((0.3 * rate, rate), (rate, 4 * rate))]
    assert fit.profile_likelihood(level=level).intervals["rate"] == pytest.approx(expected, rel=5e-3)
    # The cost is no parabola of the rate, and nearly one of its logarithm.
    precision = fit.precision("white")
    quantile = threshold**0.5
    straight = rate + quantile * precision.standard_errors["rate"]
    logarithmic = precision.intervals(level)["rate"][1]
    assert abs(logarithmic - expected[1]) < 0.5 * abs(straight - expected[1])


def test_interval_ends_at_the_bound_that_it_reaches():
    fit = _identified(_decay(lower=1.9, upper=20.0))
    profile = fit.profile_likelihood().profiles["rate"]
    assert profile.at_bound == (True, False)
    assert profile.interval[0] == pytest.approx(1.9)
    assert "(its bound)" in str(fit.profile_likelihood())


def test_coloured_noise_widens_the_profile_as_it_widens_the_error():
    fit = _fit(seed=3, pole=0.9)
    white, coloured = (fit.profile_likelihood(noise=noise).intervals["gain"] for noise in ("white", "coloured"))
    ratio = fit.precision("coloured").standard_errors["gain"] / fit.precision("white").standard_errors["gain"]
    assert (coloured[1] - coloured[0]) / (white[1] - white[0]) == pytest.approx(ratio, rel=1e-2)


def test_a_parameter_that_shows_nowhere_has_its_bounds_for_an_interval():
    # No start, no decay to see.
    time = np.arange(40) * 0.05
    record = ehsvjax.Record(time, {"u": np.zeros(40)}, {"y": np.random.default_rng(2).normal(0.0, 0.1, 40)})
    fit = ehsvjax.identify(
        _decay().with_bounds(fixed={"start": 0.0}), record, key=jax.random.key(0), population=8, generations=4
    )
    assert np.isinf(fit.standard_errors["rate"])
    profile = fit.profile_likelihood().profiles["rate"]
    assert profile.interval == pytest.approx((0.05, 20.0))
    assert profile.at_bound == (True, True)


def test_picture_has_a_panel_for_every_parameter():
    figure = _fit().profile_likelihood().plot()
    assert [axes.get_title() or axes.get_title("left") for axes in figure.axes] == ["gain"]
    assert figure._repr_png_()[:4] == b"\x89PNG"
