"""Standard errors, bands and draws against closed forms of linear least squares, and against SciPy's curve_fit."""

import dataclasses
import functools

import jax
import numpy as np
import pytest
from matplotlib.path import Path
from scipy.linalg import toeplitz
from scipy.optimize import curve_fit
from scipy.signal import lfilter

import ehsvjax
from ehsvjax.precision.standard_errors import linearised
from ehsvjax.unknowns import problem_of
from tests import plants

SAMPLES = 400
TIME = np.arange(SAMPLES) * 0.01
FORCE = np.sin(7.0 * TIME) + 0.3 * np.cos(23.0 * TIME)
NAMES = ("gain", "offset")


def _start(parameters, initial, inputs):
    return {"x": initial["start"]}


def _derivative(parameters, state, inputs, signal):
    return {"x": 0.0 * state["x"] + 1.0}


def _measure(parameters, state, inputs, signal):
    # The state is start + t, so that the output is linear in all unknowns.
    return {"y": signal("y", parameters["gain"] * inputs["force"] + parameters["offset"] * 0.1 + state["x"])}


def _line(**changes):
    """y = gain*force + 0.1*offset + x, x = x(0) + t: linear in everything."""
    model = ehsvjax.Model(
        name="line",
        parameters=(
            ehsvjax.Parameter("gain", "g", "m/N", 2.0, 0.5, 8.0, "log"),
            ehsvjax.Parameter("offset", "o", "m", 1.0, -50.0, 50.0, fixed=True),
        ),
        initial=(ehsvjax.Parameter("start", "x0", "m", 0.0, -10.0, 10.0),),
        signals=(ehsvjax.Signal("force", "input", "N"), ehsvjax.Signal("y", "sensor", "m")),
        start=_start,
        stepper=ehsvjax.runge_kutta_4(_derivative),
        measure=_measure,
        max_step=0.01,
    )
    return dataclasses.replace(model, **changes)


def _noise(seed, pole=0.0, deviation=0.1):
    white = np.random.default_rng(seed).normal(0.0, deviation, SAMPLES + 500)
    return lfilter([1.0], [1.0, -pole], white)[500:]


def _record(noise):
    return ehsvjax.Record(TIME, {"force": FORCE}, {"y": 2.5 * FORCE + 0.4 + TIME + noise})


DESIGN = np.stack([FORCE, np.ones(SAMPLES)], axis=1)


@functools.cache
def _fit(seed=1, pole=0.0, noise_variance=None, missing=False):
    record = _record(_noise(seed, pole))
    if missing:
        output = record.outputs["y"].copy()
        output[50:90] = np.nan
        record = dataclasses.replace(record, outputs={"y": output})
    given = None if noise_variance is None else {"y": noise_variance}
    return ehsvjax.identify(_line(), record, key=jax.random.key(0), population=16, generations=12, noise_variance=given)


def _least_squares(record):
    """Estimates, covariance and noise variance by the normal equations."""
    there = np.isfinite(record.outputs["y"])
    design, y = DESIGN[there], (record.outputs["y"] - TIME)[there]
    estimate = np.linalg.solve(design.T @ design, design.T @ y)
    variance = np.sum((y - design @ estimate) ** 2) / (len(y) - 2)
    return estimate, variance * np.linalg.inv(design.T @ design), variance


@pytest.mark.parametrize("missing", [False, True])
def test_linear_model_has_the_errors_of_least_squares(missing):
    fit = _fit(missing=missing)
    estimate, covariance, _ = _least_squares(fit.records[0])
    precision = fit.precision("white")
    assert fit.parameters["gain"] == pytest.approx(estimate[0], rel=1e-6)
    assert precision.standard_errors["gain"] == pytest.approx(covariance[0, 0] ** 0.5, rel=1e-6)
    assert precision.initial_errors[0]["start"] == pytest.approx(covariance[1, 1] ** 0.5, rel=1e-6)
    assert precision.covariance[0, 0] == pytest.approx(covariance[0, 0], rel=1e-6)
    # The gain is searched by its logarithm.
    factor = np.exp(1.959964 * covariance[0, 0] ** 0.5 / estimate[0])
    assert precision.intervals()["gain"] == pytest.approx((estimate[0] / factor, estimate[0] * factor))
    assert precision.unfixed == () and precision.combinations == ()


def test_a_noise_variance_that_is_given_is_believed():
    fit = _fit(noise_variance=0.04)
    expected = (0.04 * np.linalg.inv(DESIGN.T @ DESIGN)[0, 0]) ** 0.5
    assert fit.standard_errors["gain"] == pytest.approx(expected, rel=1e-6)
    assert fit.noise_variance_given


def test_errors_are_those_of_curve_fit_on_the_oscillator():
    period, truth, variance = 0.05, (0.96, 1.23, 0.4, -0.3), 0.04
    command = np.repeat(np.random.default_rng(8).uniform(-2, 2, 15), 20)
    time = np.arange(len(command)) * period

    def simulate(_, *values):
        return plants.van_der_pol_plant(command, period, *values[:2], tuple(values[2:]))[:, 0]

    measured = simulate(None, *truth) + np.random.default_rng(9).normal(0.0, variance**0.5, len(command))
    best, covariance = curve_fit(simulate, time, measured, p0=truth, xtol=1e-12, ftol=1e-12)
    record = ehsvjax.Record(time, {"command": command}, {"position": measured})
    fit = ehsvjax.identify(ehsvjax.van_der_pol(), record, key=jax.random.key(1), population=40, generations=25)
    precision = fit.precision("white")
    deviation = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(list(fit.parameters.values()), best[:2], atol=1e-2 * deviation[:2].min())
    np.testing.assert_allclose(list(precision.standard_errors.values()), deviation[:2], rtol=2e-3)
    np.testing.assert_allclose(list(precision.initial_errors[0].values()), deviation[2:], rtol=2e-3)
    ((pair, correlation),) = precision.correlations.items()
    assert set(pair) == {"alpha", "gamma"}
    assert correlation == pytest.approx(covariance[0, 1] / deviation[0] / deviation[1], abs=2e-3)


def test_coloured_noise_is_noticed_and_counted():
    white, coloured = _fit(seed=3).precision(), _fit(seed=3, pole=0.9).precision()
    assert not white.coloured and white.noise.startswith("white")
    assert coloured.coloured and "residuals are correlated" in coloured.noise and "order 1" in coloured.noise
    # The exact covariance of least squares under that noise.
    covariance = 0.1**2 / (1 - 0.9**2) * toeplitz(0.9 ** np.arange(SAMPLES))
    bread = np.linalg.inv(DESIGN.T @ DESIGN)
    exact = np.sqrt(np.diag(bread @ DESIGN.T @ covariance @ DESIGN @ bread))
    # The noise is estimated from 400 correlated samples.
    assert coloured.standard_errors["gain"] == pytest.approx(exact[0], rel=0.25)
    assert coloured.initial_errors[0]["start"] == pytest.approx(exact[1], rel=0.35)
    naive = _fit(seed=3, pole=0.9).precision("white").initial_errors[0]["start"]
    assert naive < 0.4 * exact[1]


@pytest.mark.parametrize("pole", [0.0, 0.9])
def test_intervals_cover_the_truth_as_often_as_they_say(pole):
    # Without the search: the estimate of a linear model is known.
    problem = problem_of(_line(), [_record(_noise(0))])
    seeds, inside = range(1000, 1400), 0
    for seed in seeds:
        record = _record(_noise(seed, pole))
        estimate, *_ = _least_squares(record)
        drawn = dataclasses.replace(
            problem, samples=problem.samples._replace(outputs=record.outputs["y"][None, :, None])
        )
        # The constant is the start and a tenth of the offset.
        first_order = linearised(drawn, estimate - [0.0, 0.1], noise_variance_given=False)
        error = np.sqrt(first_order.covariance[0, 0]) * first_order.found.scale[0]
        inside += abs(estimate[0] - 2.5) < 1.96 * error
    # 95% of 400 is 380 with a standard deviation of 4.4; 5 of those leave one false alarm in a million.
    assert 358 <= inside <= 400 - 1, inside


@pytest.mark.parametrize("kind", ["parametric", "block"])
@pytest.mark.parametrize("pole", [0.0, 0.8])
def test_bootstrap_has_the_errors_of_the_closed_form(kind, pole):
    fit = _fit(seed=5, pole=pole)
    drawn = fit.bootstrap(jax.random.key(2), draws=300, kind=kind)
    assert drawn.lost == 0
    expected = fit.standard_errors["gain"]
    # A standard deviation of 300 draws is known to 4%; blocks of few residuals are cruder.
    assert drawn.standard_errors["gain"] == pytest.approx(expected, rel=0.2 if kind == "parametric" else 0.35)
    low, high = drawn.intervals()["gain"]
    assert low < fit.parameters["gain"] < high
    assert high - low == pytest.approx(2 * 1.96 * drawn.standard_errors["gain"], rel=0.2)


def test_a_corner_plot_shows_the_draws_with_linear_theory_and_profiles():
    model = _line().with_bounds({"offset": (-50.0, 50.0)})
    options = {"population": 16, "generations": 12, "initial": {"start": 0.4}}
    fit = ehsvjax.identify(model, _record(_noise(5)), key=jax.random.key(0), **options)
    drawn = fit.bootstrap(jax.random.key(2), draws=300)
    assert str(drawn).startswith("[[Bootstrap, 300 draws, 95% intervals]]\n    gain ")
    figure = drawn.plot(fit.profile_likelihood())
    alone, _, pair, _ = figure.axes
    draws, ellipse, _ = pair.lines
    inside = Path(ellipse.get_xydata()).contains_points(draws.get_xydata())
    # 95% of 300 draws, with a deviation of 1.3%.
    assert 0.9 < inside.mean() < 0.995
    bell, profile = (np.interp(fit.parameters["gain"], *line.get_data()) for line in alone.lines)
    assert profile == pytest.approx(bell, rel=0.02)
    # Of a plan there are no draws.
    planned = ehsvjax.design(model, fit.records, noise_variance={"y": 0.01}, initial={"start": 0.4}).plot()
    assert [len(axes.lines) for axes in planned.axes] == [1, 0, 2, 1]
    with pytest.raises(ValueError, match="expected profiles to be"):
        drawn.plot(fit)


def test_blocks_of_a_record_that_lacks_an_output():
    def measure(parameters, state, inputs, signal):
        y = parameters["gain"] * inputs["force"] + state["x"]
        return {"y": signal("y", y), "double": signal("double", 2.0 * y)}

    model = _line(signals=(*_line().signals, ehsvjax.Signal("double", "sensor", "m")), measure=measure)
    first, second = (2.5 * FORCE + 0.4 + TIME + _noise(seed) for seed in (11, 12))
    records = [
        ehsvjax.Record(TIME, {"force": FORCE}, {"y": first, "double": 2.0 * (first + _noise(13))}),
        ehsvjax.Record(TIME, {"force": FORCE}, {"y": second}),
    ]
    fit = ehsvjax.identify(model, records, key=jax.random.key(0), population=16, generations=12)
    drawn = fit.bootstrap(jax.random.key(1), draws=100, kind="block")
    assert drawn.lost == 0
    assert drawn.standard_errors["gain"] == pytest.approx(fit.standard_errors["gain"], rel=0.35)


def test_huber_has_the_errors_of_robust_regression():
    noise = _noise(6)
    noise[::15] += 3.0
    record = _record(noise)
    fit = ehsvjax.identify(_line(), record, key=jax.random.key(0), population=16, generations=12, huber=1.345)
    precision = fit.precision("white")
    scale = fit.noise_variance["y"] ** 0.5
    residual = fit.residuals()["y"] / scale
    inside = np.abs(residual) <= 1.345
    # Huber 1981, section 7.6: the influence's variance over its mean slope squared.
    variance = np.sum(np.clip(residual, -1.345, 1.345) ** 2) / (SAMPLES - 2) / np.mean(inside) ** 2
    expected = scale * np.sqrt(variance * np.linalg.inv(DESIGN.T @ DESIGN)[0, 0])
    assert precision.standard_errors["gain"] == pytest.approx(expected, rel=1e-6)
    # A profile of Huber's cost agrees: it has less curvature than the sum of squares.
    lower, upper = fit.profile_likelihood(noise="white").intervals["gain"]
    assert upper - lower == pytest.approx(2 * 1.96 * expected, rel=0.05)
    # And the spikes do not widen the band of samples.
    assert fit.bands()["y"].measurement.mean() == pytest.approx(1.96 * scale, rel=0.02)


def test_draws_repeat_with_the_key():
    first, again = (_fit().bootstrap(jax.random.key(4), draws=8).parameters["gain"] for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, _fit().bootstrap(jax.random.key(5), draws=8).parameters["gain"])


def test_bands_are_those_of_least_squares():
    fit = _fit()
    _, covariance, variance = _least_squares(fit.records[0])
    band = fit.bands()["y"]
    of_line = np.einsum("ti,ij,tj->t", DESIGN, covariance, DESIGN)
    np.testing.assert_allclose(band.model, 1.959964 * np.sqrt(of_line), rtol=1e-5)
    np.testing.assert_allclose(band.measurement, 1.959964 * np.sqrt(of_line + variance), rtol=1e-5)


def test_bands_of_a_new_record_know_that_its_start_was_fitted_too():
    fit = _fit()
    force = np.cos(3.0 * TIME) + 0.5
    new = ehsvjax.Record(TIME, {"force": force}, {"y": 2.5 * force - 0.2 + TIME + _noise(77)})
    band = fit.bands(new)["y"]
    _, covariance, variance = _least_squares(fit.records[0])
    # With the start fitted for a given gain, only the force about its mean moves with the gain.
    of_line = covariance[0, 0] * (force - force.mean()) ** 2 + variance / SAMPLES
    np.testing.assert_allclose(band.model, 1.959964 * np.sqrt(of_line), rtol=1e-5)
    known = fit.bands(new, initial={"start": -0.2})["y"]
    assert np.all(known.measurement >= known.model)


def test_what_cannot_be_meant_is_refused():
    fit = _fit()
    for call, words in (
        (lambda: fit.precision("pink"), "'auto', 'white' or 'coloured', got 'pink'"),
        (lambda: fit.precision().intervals(95), "between 0 and 1"),
        (lambda: fit.bootstrap(jax.random.key(0), draws=1), "at least 2, got 1"),
        (lambda: fit.bootstrap(jax.random.key(0), kind="residual"), "'parametric' or 'block', got 'residual'"),
        (lambda: fit.profile_likelihood(["mass"]), "identified, gain; got 'mass'"),
        (lambda: fit.profile_likelihood(level=1.0), "between 0 and 1"),
        (lambda: fit.bands(ehsvjax.Record(TIME, {"force": FORCE})), "to hold one of y, got none"),
    ):
        with pytest.raises(ValueError, match=words):
            call()
