"""Calls that cannot be meant, refused by a sentence: a share of `benchmarks/damaged_calls.py`, and what words say."""

import re
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ehsvjax
from benchmarks import damaged_arguments, damaged_models, damaged_results
from benchmarks.damaged_calls import answer_of, offenders
from benchmarks.damaged_models import FAULTS, tank, tank_record, with_derivative
from ehsvjax import Parameter, Signal, effects, excitation
from ehsvjax import __main__ as demo
from ehsvjax.effects.internal import contexts_of
from ehsvjax.models.check import check_equations
from ehsvjax.models.model import KINDS

ROOMS = ("of_excitation", "of_operators", "of_models", "of_hydraulics", "of_effects", "of_simulation")


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("room", ROOMS)
def test_wrong_arguments_are_refused_by_a_sentence_and_at_once(room):
    calls = list(getattr(damaged_arguments, room)())
    # The right calls all, of the wrong ones every sixth.
    chosen = [call for i, call in enumerate(calls) if call.may_answer or i % 6 == 0]
    assert offenders([answer_of(call) for call in chosen]) == []


@pytest.mark.usefixtures("unchecked")
def test_wrong_arguments_of_records_and_fits_are_refused_by_a_sentence_and_at_once():
    calls = [call for call in damaged_results.calls() if not call.may_answer]
    assert offenders([answer_of(call) for call in calls[::7]]) == []


@pytest.mark.usefixtures("unchecked")
def test_every_fault_of_a_model_is_named():
    calls = [call for call in damaged_models.calls() if not call.may_answer]
    # Where it is simulated; of the identifications those that are refused before the search is compiled.
    calls = [c for c in calls if c.name == "simulate own model" or c.wrong in ("np.sin", "an output missing")]
    assert offenders([answer_of(call) for call in calls]) == []


@pytest.mark.usefixtures("unchecked")
def test_what_is_harmless_works():
    """Odd names, kinds of one's own, and no input at all."""
    calls = [call for call in damaged_models.calls() if call.may_answer and call.name != "identify own model"]
    assert [answer_of(call).kind for call in calls] == ["answered"] * len(calls)


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [
        (
            "np.sin",
            r"TracerArrayConversionError .* in .*\(damaged_models.py, line \d+\): call the function of jax.numpy",
        ),
        ("assigned into NumPy", r"in _assigned \(damaged_models.py, line \d+\): .* make arrays by jnp.stack"),
        ("if", r"TracerBoolConversionError .* in _if \(damaged_models.py, line \d+\): write jnp.where"),
        ("float()", r"ConcretizationTypeError .*\(damaged_models.py, line \d+\): leave out float\(\)"),
        (
            "unknown parameter",
            r"KeyError \('gian'\) in .*\(damaged_models.py, line \d+\): use the names of the model's",
        ),
        (
            "a rate more",
            r"expected the rates that .* returns to be like the state, \{'level': a number\}, got \{.*other",
        ),
        (
            "step with inputs as they are",
            r"TypeError .* in .*\(damaged_models.py, line \d+\): a step asks for its inputs by the share",
        ),
        ("step of another shape", r"expected the state one step later, .*, got \{'level': an array \(3,\)\}"),
        ("an output missing", r"to return a number for each output, level; got none"),
        ("an output too many", r"to return a number for each output, level; got level, flow"),
        ("start that is an array", r"to return a number for each output, level; got an array \(3,\) for 'level'"),
        (
            "a signal misspelt",
            r"expected a signal of tank, command, flow, level, got signal\('flwo', ...\): write 'flow'",
        ),
        ("a signal that is not listed", r"got signal\('leak', ...\): add Signal\('leak', kind, unit\) to its signals"),
        (
            "a signal that is never passed",
            r"pass through its signal 'leak', got none, so that an effect there would do",
        ),
        (
            "the longest step is tiny",
            r"expected at most 1e\+09 integration steps, got 300 samples of .*max_step of tank",
        ),
    ],
)
def test_a_fault_is_named_with_its_function_and_remedy(fault, sentence):
    with pytest.raises(ValueError, match=sentence):
        ehsvjax.simulate(FAULTS[fault](), tank_record())


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [
        ("a sensor that is never passed", "output 'level' of tank does not pass through its signal"),
        ("NaN at the start", r"the state at the start, \['level'\], of tank is nan: look at .*gain = 2, lag = 0.2"),
        ("division by zero", r"the state after one step, \['level'\], of tank is inf"),
    ],
)
def test_what_may_still_be_meant_is_warned_of(fault, sentence):
    with pytest.warns(UserWarning, match=sentence):
        ehsvjax.simulate(FAULTS[fault](), tank_record())


def test_equations_are_traced_once_for_all_values_and_bounds():
    traced = []

    def term(parameters, level, command):
        traced.append(level)
        return (parameters["gain"] * command - level) / parameters["lag"]

    model = with_derivative(term)
    for changed in (model, model.with_bounds({"gain": (0.5, 4.0)}), model.with_bounds(fixed={"lag": 0.3})):
        check_equations(changed)
    assert len(traced) == 4  # the stages of one Runge-Kutta step


# --- Kinds and names ---


@pytest.mark.parametrize("kind", ["senzor", "Sensor", "sensors", "inputs", "forse", "frction", "imput"])
def test_a_kind_that_is_all_but_a_known_one_is_refused(kind):
    with pytest.raises(
        ValueError, match=rf"expected the kind of leak to be one of input, sensor, .*, got '{kind}': wri"
    ):
        tank(signals=(*tank().signals, Signal("leak", kind, "")))
    with pytest.raises(ValueError, match="expected the kind of sticking to be one of"):
        ehsvjax.Effect("sticking", kind, (effects.size("force", "N", lambda scales: 1.0),), lambda own, value, _: value)


@pytest.mark.parametrize("kind", ["inflow", "voltage", "torque", "temperature", "flow", *KINDS])
def test_known_kinds_and_kinds_of_ones_own_are_taken(kind):
    tank(signals=(*tank().signals, Signal("leak", kind, "")))


def test_every_effect_acts_at_a_known_kind_and_every_model_has_known_kinds():
    assert {effect.kind for effect in effects.BANK} - {"parameter"} <= set(KINDS)
    for model in (ehsvjax.servovalve(), ehsvjax.van_der_pol()):
        assert {signal.kind for signal in model.signals} <= set(KINDS)


@pytest.mark.parametrize("name", ["x$_1$", "a<b>", "inner level", "ξ", "x|y", "100 %"])
def test_names_that_only_look_odd_are_taken(name):
    def measure(parameters, state, inputs, signal):
        return {name: signal(name, state["level"], level=state["level"])}

    signals = (*tank().signals[:2], Signal(name, "sensor", ""))
    model = tank(
        signals=signals, measure=measure, parameters=(*tank().parameters, Parameter(name, name, "", 1.0, 0.5, 2.0))
    )
    assert set(ehsvjax.simulate(model, tank_record())) == {name}
    assert contexts_of(model)[name] == ("level",)


@pytest.mark.parametrize("name", ["", " ", " level", "level ", "le\nvel", "le\tvel"])
def test_names_that_cannot_be_read_are_refused(name):
    sentence = re.escape("neither is empty nor begins or ends with a blank")
    with pytest.raises(ValueError, match=f"expected the name of a parameter to be .*{sentence}"):
        tank(parameters=(Parameter(name, "k", "", 1.0, 0.5, 2.0),))
    with pytest.raises(ValueError, match=f"expected the name of a signal of tank to be .*{sentence}"):
        tank(signals=(*tank().signals, Signal(name, "sensor", "")))


def test_nothing_left_to_identify_says_what_could_be_freed():
    model = tank().with_bounds(fixed={"gain": 2.0, "lag": 0.2})
    with pytest.raises(ValueError, match=r"tank with every parameter fixed: free one by bounds=\{.*\}, of gain, lag"):
        ehsvjax.identify(model, tank_record(), key=jax.random.key(0), initial="nominal")


# --- Sizes, units, files ---


def test_absurd_sizes_are_refused_at_once():
    began = time.perf_counter()
    with pytest.raises(
        ValueError, match=r"expected at most 1e\+08 samples, got 1000000000.0 s every 0.001 s, 1e\+12: shorten"
    ):
        excitation.sample_times(1e9, 1e-3)
    with pytest.raises(ValueError, match=r"expected at most 1e\+08 samples"):
        excitation.staircase(amplitude=1.0, levels=10**8, hold_time=1.0, sample_period=0.1)
    with pytest.raises(ValueError, match=r"expected at most 1e\+09 integration steps"):
        ehsvjax.simulate(tank(), tank_record(), substeps=10**9)
    assert time.perf_counter() - began < 1.0


@pytest.mark.parametrize(
    ("constant", "value", "unit"),
    [("supply_pressure", 140.0, "Pa"), ("piston_area", 25.0, "m^2"), ("mass", 1e9, "kg"), ("stiffness", 1e12, "N/m")],
)
def test_a_constant_in_another_unit_is_refused(constant, value, unit):
    with pytest.raises(
        ValueError, match=rf"expected {constant} between .* {re.escape(unit)}, got {value}: mind the unit"
    ):
        ehsvjax.servovalve(**{constant: value})


def test_the_bound_refuses_values_of_parameters_that_there_are_not():
    """They were ignored."""
    with pytest.raises(ValueError, match="expected a parameter of tank, got 'gian'; it has gain, lag"):
        ehsvjax.cramer_rao_bound(tank(), tank_record(), noise_variance={"level": 1e-4}, parameters={"gian": 2.0})


@pytest.mark.parametrize("out", ["a file", "a file/below"])
def test_the_demo_says_at_once_that_it_cannot_write(out, tmp_path, capsys):
    (tmp_path / "a file").touch()
    with pytest.raises(SystemExit):
        demo.main(["--out", str(tmp_path / out)])
    assert "expected --out to be a folder that can be written" in capsys.readouterr().err


def test_a_model_that_only_runs_out_needs_no_input():
    found = damaged_models._autonomous()["level"]
    np.testing.assert_allclose(found, np.exp(-tank_record().time / 0.2), atol=1e-6)


@pytest.mark.usefixtures("unchecked")
def test_scalars_of_numpy_and_jax_are_numbers_too():
    assert ehsvjax.servovalve(mass=np.float32(20.0)).nominal["mass"] == 20.0
    assert len(excitation.sample_times(jnp.float32(1.0), np.float64(0.1))) == 10
