"""What is known of parameters beforehand, and parameters that follow others: against the closed forms of a line."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import lfilter

import ehsvjax
from ehsvjax import Model, Parameter, Signal
from ehsvjax.precision.residual_noise import residual_noise
from ehsvjax.precision.sensitivities import sensitivities
from ehsvjax.precision.standard_errors import covariance_of
from ehsvjax.unknowns import problem_of
from tests.small_models import DAMPING, MASS, STIFFNESS, carriage, carriage_plant, record_of

KEY = jax.random.key(0)
COLOURED = np.ones((1, 50_000), bool)
SLOPE, OFFSET, DEVIATION = 1.5, -0.4, 0.2
MEANS, KNOWN = {"slope": 1.2, "offset": 0.5}, {"slope": 0.1, "offset": 0.02}


def _start(parameters, initial, inputs):
    return {"kept": 0.0}


def _stepper(parameters, step_size, signal):
    return lambda state, inputs: state


def _measure(parameters, state, inputs, signal):
    return {"y": signal("y", parameters["slope"] * signal("u", inputs["u"]) + parameters["offset"])}


LINE = Model(
    name="line",
    parameters=(
        Parameter("slope", "a", "", 1.0, -10.0, 10.0),
        Parameter("offset", "b", "", 0.0, -10.0, 10.0),
    ),
    initial=(),
    signals=(Signal("u", "input", ""), Signal("y", "sensor", "")),
    start=_start,
    stepper=_stepper,
    measure=_measure,
    max_step=1.0,
)


def line_record(memory=0.0, seed=3):
    """40 readings of a line with noise of that deviation, which may remember itself."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1.0, 1.0, 40)
    noise = lfilter([np.sqrt(1.0 - memory**2)], [1.0, -memory], DEVIATION * rng.standard_normal(240))[200:]
    return ehsvjax.Record(np.arange(40.0), {"u": u}, {"y": SLOPE * u + OFFSET + noise})


def identified(record, model=LINE, **settings):
    settings = {"noise_variance": {"y": DEVIATION**2}, **settings}
    return ehsvjax.identify(model, record, key=KEY, population=50, generations=20, **settings)


def posterior(record, known, variance=DEVIATION**2):
    """Return mean and covariance of slope and offset by Bayes' theorem."""
    rows = np.stack([record.inputs["u"], np.ones(40)], axis=1)
    precision = np.diag([1.0 / known[name] ** 2 if name in known else 0.0 for name in MEANS])
    covariance = np.linalg.inv(rows.T @ rows / variance + precision)
    mean = covariance @ (rows.T @ record.outputs["y"] / variance + precision @ list(MEANS.values()))
    return mean, covariance


@pytest.mark.parametrize("known", [("slope",), ("offset",), ("slope", "offset")])
def test_priors_move_the_estimate_and_shrink_the_errors_as_bayes_says(known):
    record = line_record()
    fit = identified(record, priors={name: (MEANS[name], KNOWN[name]) for name in known})
    mean, covariance = posterior(record, {name: KNOWN[name] for name in known})
    errors = np.sqrt(np.diag(covariance))
    # The refinement ends where a further step would gain next to nothing.
    assert (list(fit.parameters.values()) - mean) / errors == pytest.approx(0.0, abs=0.05)
    assert list(fit.standard_errors.values()) == pytest.approx(errors, rel=1e-6)
    correlation = covariance[0, 1] / np.prod(errors)
    assert fit.correlations["offset", "slope"] == pytest.approx(correlation, rel=1e-6)


def test_a_noise_that_is_not_known_is_weighed_against_what_is():
    """The residuals' own variance decides between readings and prior: the two are consistent in the end."""
    record = line_record()
    fit = identified(record, priors={"slope": (MEANS["slope"], KNOWN["slope"])}, noise_variance=None)
    variance = fit.noise_variance["y"]
    assert variance == pytest.approx(np.mean(fit.residuals()["y"] ** 2), rel=0.01)
    mean, _ = posterior(record, {"slope": KNOWN["slope"]}, variance)
    assert list(fit.parameters.values()) == pytest.approx(mean, rel=2e-3)
    _, covariance = posterior(record, {"slope": KNOWN["slope"]}, variance * 40 / 38)
    assert list(fit.standard_errors.values()) == pytest.approx(np.sqrt(np.diag(covariance)), rel=0.01)


def test_errors_with_coloured_noise_and_a_prior_are_those_that_come():
    """The sandwich with a prior in it, against the spread of the closed form over many records."""
    record = line_record(0.8)
    rows, rng = np.stack([record.inputs["u"], np.ones(40)], axis=1), np.random.default_rng(5)
    precision = np.diag([KNOWN["slope"] ** -2, 0.0])
    gain = np.linalg.inv(rows.T @ rows / DEVIATION**2 + precision)
    noise = lfilter([0.6], [1.0, -0.8], DEVIATION * rng.standard_normal((20_000, 240)), axis=1)[:, 200:]
    # What is known was measured so too, once, with an error of its own.
    told = np.zeros((20_000, 2))
    told[:, 0] = KNOWN["slope"] * rng.standard_normal(20_000)
    spread = np.std((noise @ rows / DEVIATION**2 + told @ precision) @ gain, axis=0)
    model = LINE.with_priors({"slope": (MEANS["slope"], KNOWN["slope"])})
    problem = problem_of(model, [record], noise_variance={"y": DEVIATION**2})
    found = sensitivities(problem, np.array([SLOPE, OFFSET]))
    colour = residual_noise(lfilter([0.6], [1.0, -0.8], rng.standard_normal(50_000))[None], COLOURED, "coloured")
    covariance, _ = covariance_of(found, [colour], 1.0)
    assert np.sqrt(np.diag(covariance)) * found.scale == pytest.approx(spread, rel=0.05)


def test_profile_and_bootstrap_know_what_was_known():
    record = line_record()
    fit = identified(record, priors={"slope": (MEANS["slope"], KNOWN["slope"])})
    errors = np.sqrt(np.diag(posterior(record, {"slope": KNOWN["slope"]})[1]))
    profile = fit.profile_likelihood(level=0.95).intervals
    for name, error in zip(fit.parameters, errors, strict=True):
        assert np.ptp(profile[name]) == pytest.approx(2 * 1.96 * error, rel=0.02)
    drawn = fit.bootstrap(KEY, draws=400, noise="white")
    assert list(drawn.standard_errors.values()) == pytest.approx(errors, rel=0.12)


def test_a_prior_is_printed_beside_what_the_record_alone_says_of_it_and_kept(tmp_path):
    record = line_record()
    fit = identified(record, priors={"slope": (MEANS["slope"], 0.01)})
    (line,) = [line for line in str(fit).splitlines() if line.strip().startswith("slope") and "apart" in line]
    mean, covariance = posterior(record, {})
    told, error = mean[0], covariance[0, 0] ** 0.5
    apart = (told - MEANS["slope"]) / np.hypot(error, 0.01)
    assert apart > 3.0
    assert line.split()[:4] == ["slope", "1.2", "+/-", "0.01"]
    assert float(line.split()[4]) == pytest.approx(told, rel=1e-2)
    assert float(line.split()[6]) == pytest.approx(error, rel=1e-2)
    assert f"{apart:.1f} standard deviations apart: they contradict each other" in line
    assert "known as 1.2 +/- 0.01" in str(fit.model)
    fit.save(tmp_path / "fit.npz")
    again = ehsvjax.Fit.load(tmp_path / "fit.npz", LINE)
    assert again.standard_errors == fit.standard_errors and str(again) == str(fit)


def test_of_what_no_record_shows_the_prior_is_all_that_there_is():
    still = ehsvjax.Record(np.arange(40.0), {"u": np.zeros(40)}, {"y": line_record().outputs["y"]})
    fit = identified(still, priors={"slope": (1.2, 0.1)})
    assert fit.parameters["slope"] == pytest.approx(1.2, abs=0.01)
    assert fit.standard_errors["slope"] == pytest.approx(0.1, rel=1e-6)
    assert "next to nothing" in str(fit)


def test_a_diagnosis_asks_the_records_alone():
    push = 20.0 * np.sign(np.sin(0.7 * np.arange(0.0, 12.0, 0.02) ** 1.3))
    position = carriage_plant(push, 0.02)[:, 0]
    record = record_of(0.02, {"push": push}, {"position": position}, {"position": 2e-3}, 0)
    # What was believed of the damping is far from what it is.
    fit = ehsvjax.identify(carriage(), record, key=KEY, population=50, generations=20, priors={"damping": (6.0, 0.01)})
    assert fit.parameters["damping"] == pytest.approx(6.0, abs=0.1)
    found = ehsvjax.diagnose(fit, record, key=KEY)
    assert found.verdict == "adequate", str(found)
    assert "of damping, was left aside" in str(found)
    assert found.extended.parameters["damping"] == pytest.approx(3.0, rel=0.02)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("priors", "said"),
    [
        ({"slop": (1.0, 0.1)}, "expected priors of parameters that are to be identified, slope, offset; got 'slop'"),
        ({"slope": 1.0}, "expected the prior of slope as .mean, standard deviation., the latter positive, got 1.0"),
        ({"slope": (1.0, 0.0)}, "the latter positive"),
        ({"slope": (np.nan, 0.1)}, "the latter positive"),
        ([("slope", 1.0)], "expected priors to be a mapping from names"),
    ],
)
def test_what_is_no_prior_is_refused(priors, said):
    with pytest.raises(ValueError, match=said):
        identified(line_record(), priors=priors)


def twice(parameters):
    return 2.0 * parameters["slope"]


def test_a_tied_parameter_follows_and_the_rest_is_the_closed_form():
    record = line_record()
    fit = identified(record, tied={"offset": twice})
    column = record.inputs["u"] + 2.0
    slope = column @ record.outputs["y"] / (column @ column)
    error = DEVIATION / np.sqrt(column @ column)
    assert fit.parameters == {"slope": pytest.approx(slope, abs=0.03 * error)}
    assert fit.standard_errors["slope"] == pytest.approx(error, rel=1e-6)
    assert fit.tied == {"offset": pytest.approx(2.0 * fit.parameters["slope"])}
    assert fit.table.loc["offset", "value"] == pytest.approx(fit.tied["offset"])
    assert "(tied)" in str(fit)
    expected = fit.parameters["slope"] * column
    np.testing.assert_allclose(fit.simulate(record)["y"], expected, rtol=1e-6)


def test_ties_may_follow_one_another_and_are_kept_with_the_model(tmp_path):
    tied = LINE.with_bounds(fixed={"offset": 3.0}).with_ties({"offset": lambda p: jnp.exp(p["slope"])})
    assert tied.nominal["offset"] == pytest.approx(np.e)
    fit = identified(line_record(), tied)
    fit.save(tmp_path / "fit.npz")
    with pytest.raises(ValueError, match="hand it over"):
        ehsvjax.Fit.load(tmp_path / "fit.npz")
    again = ehsvjax.Fit.load(tmp_path / "fit.npz", tied)
    assert again.tied == fit.tied and str(again) == str(fit)


def test_beside_a_prior_nothing_is_said_of_a_fit_whose_errors_are_not_known(monkeypatch):
    fit = identified(line_record(), priors={"slope": (MEANS["slope"], 0.01)})

    def refused(fit):
        raise ValueError("expected a simulation that stays finite")

    monkeypatch.setattr(ehsvjax.Fit, "precision", refused)
    told, prior = (line for line in str(fit).splitlines() if line.strip().startswith("slope"))
    assert "not known" in told and "not known" in prior and "next to nothing" not in prior


def test_what_follows_a_parameter_follows_it_to_where_it_is_fixed():
    tied = LINE.with_ties({"offset": lambda p: 2.0 * p["slope"]})
    assert tied.with_bounds(fixed={"slope": 4.0}).nominal == {"slope": 4.0, "offset": 8.0}


def test_a_mass_that_is_given_by_the_stiffness_is_that_of_the_plant():
    tied = carriage().with_ties({"mass": lambda p: MASS / STIFFNESS * p["stiffness"]})
    push = 20.0 * np.sign(np.sin(0.7 * np.arange(0.0, 6.0, 0.02) ** 1.3))
    record = ehsvjax.Record(0.02 * np.arange(len(push)), {"push": push})
    softer = ehsvjax.simulate(tied, record, {"stiffness": 20.0, "damping": DAMPING})["position"]
    lighter = carriage_plant(push, 0.02, stiffness=20.0, mass=0.5 * MASS)[:, 0]
    np.testing.assert_allclose(softer, lighter, atol=1e-4)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: LINE.with_ties({"gain": twice}), "expected a parameter of line, got 'gain'"),
        (lambda: LINE.with_ties({"offset": 2.0}), "expected the tie of offset to be a function"),
        (lambda: LINE.with_ties({"offset": lambda p: p["slop"]}), "of offset to be a function of slope, offset"),
        (lambda: LINE.with_ties({"offset": lambda p: 1.0 / 0.0}), "ZeroDivisionError"),
        (lambda: LINE.with_ties({"offset": lambda p: jnp.inf}), "to give a finite number, got inf"),
        (lambda: LINE.with_ties({"offset": twice}).with_ties({"offset": twice}), "expected no value of offset"),
        (lambda: LINE.with_ties({"offset": twice}).with_bounds({"offset": (0.0, 1.0)}), "expected no value of offset"),
        (
            lambda: ehsvjax.identify(LINE, line_record(), key=jax.random.key(0), tied={"offset": twice},
                                     bounds={"offset": (0.0, 1.0)}),
            "expected no value of offset",
        ),
        (
            lambda: ehsvjax.simulate(LINE.with_ties({"offset": twice}), line_record(), {"offset": 1.0}),
            "expected no value of offset, which is tied to other parameters of line: give theirs",
        ),
        (
            lambda: identified(line_record().at(offset=1.0), LINE.with_ties({"offset": twice})),
            "expected no value of offset",
        ),
    ],
)  # fmt: skip
def test_what_is_no_tie_is_refused(call, said):
    with pytest.raises(ValueError, match=said):
        call()
