"""What fails says so: a simulation that is not finite is infinitely bad, a search of which nothing succeeds is refused.

The model grows without end where `rate` is positive: x' = rate*x + gain*u + x^3 at `cubic`.
"""

from dataclasses import replace

import jax
import numpy as np
import pytest

import ehsvjax
from ehsvjax.failure import failure_of, nothing_finite
from ehsvjax.fit import Effort, Fit, History
from ehsvjax.precision import Bootstrap

TIME = 0.05 * np.arange(60)


def _derivative(parameters, state, inputs, signal):
    del signal
    x = state["x"]
    return {"x": parameters["rate"] * x + parameters["gain"] * inputs["command"] + parameters["cubic"] * x**3}


GROWTH = ehsvjax.Model(
    name="growth",
    parameters=(
        ehsvjax.Parameter("rate", "r", "1/s", -1.0, -5.0, -0.1),
        ehsvjax.Parameter("gain", "g", "m/(V s)", 1.0, 0.1, 5.0, "log"),
        ehsvjax.Parameter("cubic", "c", "1/(m^2 s)", 0.0, -1.0, 1.0, fixed=True),
    ),
    initial=(ehsvjax.Parameter("start", "x(0)", "m", 0.0, -1.0, 1.0, output="level"),),
    signals=(ehsvjax.Signal("command", "input", "V"), ehsvjax.Signal("level", "sensor", "m")),
    start=lambda parameters, initial, inputs: {"x": initial["start"]},
    stepper=ehsvjax.runge_kutta_4(_derivative),
    measure=lambda parameters, state, inputs, signal: {"level": signal("level", state["x"])},
    max_step=0.05,
)
COMMAND = np.where(np.arange(60) // 10 % 2, 1.0, -1.0)


def _record(name="bench 2", outputs=True, scale=1.0):
    record = ehsvjax.Record(TIME, {"command": scale * COMMAND}, {}, name=name)
    level = np.array(ehsvjax.simulate(GROWTH, replace(record, inputs={"command": COMMAND}))["level"])
    level[7] = np.nan
    return replace(record, outputs={"level": level} if outputs else {})


def _fit(record=None, **parameters):
    """Return a fit made by hand."""
    return Fit(
        model=GROWTH.with_bounds(fixed={"cubic": parameters.pop("cubic", 0.0)}),
        records=(record or _record(),),
        parameters={"rate": -1.0, "gain": 1.0} | parameters,
        initial=({"start": 0.0},),
        noise_variance={"level": 1e-4},
        history=History(*(np.array([1.0]) for _ in range(4)), best={"rate": np.array([-1.0]), "gain": np.array([1.0])}),
        effort=Effort(4, 1, False, 4, True, 1, 1, 1, True, 0.0),
        warnings=(),
        estimated_initial=("start",),
    )


# Blows up on a command 30 times as large, at the sample that the simulation itself says.
EXPLOSIVE = {"cubic": 0.5}


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_missing_readings_count_for_nothing():
    score = _fit().score(_record(), "nominal")
    assert score.rmse["level"] < 1e-12
    assert score.fit_percent["level"] == pytest.approx(100.0)
    assert np.flatnonzero(np.isnan(_fit().residuals(_record(), "nominal")["level"])).tolist() == [7]


def test_a_simulation_that_fails_is_infinitely_bad():
    fit, new = _fit(**EXPLOSIVE), _record("hard", scale=30.0)
    with pytest.warns(RuntimeWarning, match=r"simulation of growth on hard fails: level is not finite from .* s on"):
        score = fit.score(new, "nominal")
    assert score.rmse["level"] == score.cost["level"] == np.inf
    assert score.fit_percent["level"] == -np.inf


def test_where_it_fails_is_said():
    fit, new = _fit(**EXPLOSIVE), _record("hard", scale=30.0)
    with pytest.warns(RuntimeWarning):
        simulated, residual = fit.simulate(new, "nominal"), fit.residuals(new, "nominal")["level"]
    failure = failure_of(new, simulated)
    assert np.isfinite(simulated["level"][: failure.sample]).all() and not np.isfinite(
        simulated["level"][failure.sample]
    )
    assert failure.time == new.time[failure.sample]
    assert np.isnan(residual[7])
    assert np.isposinf(np.delete(residual, 7)[failure.sample :]).all()


def test_a_fit_that_fails_on_its_own_record_says_so_in_every_way():
    fit = _fit(_record("hard", scale=30.0), **EXPLOSIVE)
    with pytest.warns(RuntimeWarning, match="not finite"):
        assert fit.rmse["level"] == fit.cost == np.inf
    text = str(fit)
    assert "not finite" in text and "nan" not in text and "inf" not in text.replace("not finite", "")
    assert "expected a simulation that stays finite, got none of level at sample" in text
    for ask in (fit.precision, fit.profile_likelihood, lambda: fit.bootstrap(jax.random.key(0)), fit.bands):
        with pytest.raises(ValueError, match="expected a simulation that stays finite, got none of level at sample"):
            ask()


def test_a_plot_of_what_fails_is_drawn_and_says_so():
    fit, new = _fit(**EXPLOSIVE), _record("hard", scale=30.0)
    with pytest.warns(RuntimeWarning, match="not finite"):
        figure = fit.plot(new)
    assert figure._repr_png_().startswith(b"\x89PNG")
    assert figure.axes[0].get_title(loc="left") == "fit not finite, rmse not finite"


def test_bands_are_infinite_where_the_simulation_fails():
    fit, new = _fit(**EXPLOSIVE), _record("hard", scale=30.0)
    with pytest.warns(RuntimeWarning, match="not finite"):
        band, simulated = fit.bands(new, "nominal")["level"], fit.simulate(new, "nominal")["level"]
    assert np.isposinf(band.model[~np.isfinite(simulated)]).all()
    assert np.isposinf(band.measurement[~np.isfinite(simulated)]).all()
    assert not np.isnan(band.measurement).any() and np.isfinite(band.measurement[0])


def test_refits_that_all_fail_leave_nothing_known():
    units = {"rate": "1/s", "gain": ""}
    lost = Bootstrap({"rate": np.zeros(0), "gain": np.ones(1)}, {"rate": -1.0, "gain": 1.0}, 3, units, np.eye(2))
    assert lost.standard_errors == {"rate": np.inf, "gain": np.inf}
    assert lost.intervals() == {"rate": (-np.inf, np.inf), "gain": (-np.inf, np.inf)}
    assert "rate  -1 +/- not known  1/s" in str(lost) and "3 more refits failed" in str(lost)
    with pytest.raises(ValueError, match="expected two refits that converged, got fewer: draw more"):
        lost.plot()


def test_a_profile_says_what_could_not_be_simulated():
    # At a rate of 0.5 the model blows up within the record.
    model = GROWTH.with_bounds({"rate": (-3.0, 3.0)}, {"cubic": 0.5, "gain": 1.0})
    record = replace(_record(), outputs={})
    level = ehsvjax.simulate(model, record, {"rate": 0.3}, {"start": 0.0})["level"]
    noisy = replace(record, outputs={"level": level + np.random.default_rng(0).normal(0.0, 0.5, len(level))})
    fit = replace(
        _fit(noisy), model=model, parameters={"rate": 0.3}, noise_variance={"level": 0.25}, estimated_initial=()
    )
    with pytest.warns(RuntimeWarning, match="refits could not be simulated, and count as infinitely bad"):
        profile = fit.profile_likelihood(["rate"])
    lower, upper = profile.intervals["rate"]
    assert lower < 0.3 < upper and np.isfinite([lower, upper]).all()
    assert profile.plot()._repr_png_().startswith(b"\x89PNG")


def _sqrt_of(parameters, state, inputs, signal):
    del signal, inputs
    return {"level": jax.numpy.sqrt(parameters["gain"] * state["x"] * 0.0)}


def test_a_derivative_that_is_not_finite_is_named():
    fit = replace(_fit(), model=replace(GROWTH, measure=_sqrt_of))
    with pytest.raises(ValueError, match=r"expected level to have a finite derivative by (rate|gain|start), got none"):
        fit.precision()
    assert "finite derivative" in str(fit)


def _identified(model, record, **changes):
    options = {"key": jax.random.key(0), "population": 8, "generations": 3, "starts": 1}
    return ehsvjax.identify(model, record, **(options | changes))


@pytest.mark.parametrize("refine", [True, False])
def test_a_search_of_which_nothing_succeeds_is_refused_with_the_unit_to_look_at(refine):
    model = GROWTH.with_bounds(fixed={"cubic": 0.5})
    sentence = (
        r"got none among 24: with the nominal parameters level is not finite from .* s on \(sample \d+\) on hard; it"
    )
    with pytest.raises(
        ValueError, match=sentence + ".* finite with .*a thousandth of command, which reaches 300 V"
    ) as e:
        _identified(model, _record("hard", scale=300.0), refine=refine, initial={"start": 0.0})
    assert "nan" not in str(e.value)


def test_a_step_that_is_too_long_is_named():
    model = replace(GROWTH, max_step=0.05).with_bounds({"rate": (-900.0, -500.0)})
    with pytest.raises(ValueError, match=r"it stays finite with max_step=0\.003\d* s \(it is 0\.05 s\)"):
        _identified(model, _record())


def test_an_unknown_that_is_behind_it_is_named():
    model = GROWTH.with_bounds({"cubic": (1e-6, 80.0)}, {"rate": 5.0})
    model = replace(
        model, parameters=tuple(p._replace(value=80.0) if p.name == "cubic" else p for p in model.parameters)
    )
    found = nothing_finite(model, [_record()], [{"start": 0.0}], 24)
    assert "cubic at its lower bound, 1e-06 1/(m^2 s)" in found


def test_a_score_of_a_column_that_the_model_lacks_is_answered():
    other = replace(_record(), outputs={"level": _record().outputs["level"], "height": np.arange(60.0)})
    sentence = "expected the outputs of bench 2 to be among those of growth, level; got height: name its columns"
    with pytest.raises(ValueError, match=sentence):
        _fit().score(other)


def _two_sensors(parameters, state, inputs, signal):
    return {"level": signal("level", state["x"]), "twice": signal("twice", 2.0 * state["x"])}


def test_an_output_that_was_not_fitted_is_predicted_all_the_same():
    signals = (*GROWTH.signals, ehsvjax.Signal("twice", "sensor", "m"))
    fit = replace(_fit(), model=replace(GROWTH, signals=signals, measure=_two_sensors))
    level = _record().outputs["level"]
    both = replace(_record("another"), outputs={"level": level, "twice": 2.0 * level})
    assert fit.score(both).fit_percent["twice"] > 99.9
    with pytest.raises(
        ValueError, match="expected another to hold an output that was fitted, level, to estimate its ini"
    ):
        fit.score(both.select(outputs=["twice"]))
