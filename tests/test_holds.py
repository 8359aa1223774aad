"""What inputs do between samples, each by itself: against SciPy's linear systems, which know both holds exactly."""

import copy
import pickle

import jax
import numpy as np
import pytest
from scipy.signal import lsim

import ehsvjax
from ehsvjax import Model, Parameter, Record, Signal, identify, runge_kutta_4, simulate

MASS, DAMPING, STIFFNESS, PERIOD = 2.0, 3.0, 40.0, 0.05


def _start(parameters, initial, inputs):
    del parameters, initial, inputs
    return {"x": 0.0, "v": 0.0}


def _rates(parameters, state, inputs, signal):
    driving = signal("push", inputs["push"]) - signal("pull", inputs["pull"])
    return {
        "x": state["v"],
        "v": (driving - parameters["damping"] * state["v"] - STIFFNESS * state["x"]) / MASS,
    }


def _outputs(parameters, state, inputs, signal):
    del parameters, inputs
    return {"position": signal("position", state["x"])}


CARRIAGE = Model(
    name="carriage between two ropes",
    parameters=(Parameter("damping", "c", "N s/m", 2.0, 0.5, 10.0, "log"),),
    initial=(),
    signals=(Signal("push", "input", "N"), Signal("pull", "input", "N"), Signal("position", "sensor", "m")),
    start=_start,
    stepper=runge_kutta_4(_rates),
    measure=_outputs,
    max_step=0.002,
)


def exact(push, pull, straight):
    """The position [time], by superposition of what each rope does."""
    system = [[0.0, 1.0], [-STIFFNESS / MASS, -DAMPING / MASS]], [[0.0], [1.0 / MASS]], [[1.0, 0.0]], [[0.0]]
    time = PERIOD * np.arange(len(push))
    alone = [lsim(system, force, time, interp=name in straight)[1] for name, force in (("push", push), ("pull", -pull))]
    return np.ravel(alone[0]) + np.ravel(alone[1])


def forces(seed, count=200):
    """Push and pull [time], another value in every sample."""
    return np.random.default_rng(seed).uniform(-10.0, 10.0, (2, count))


def record_of(seed, hold, straight, noise=0.0):
    """A record in which what is straight runs straight, and what is said of it."""
    push, pull = forces(seed)
    position = exact(push, pull, straight) + noise * np.random.default_rng([1, seed]).standard_normal(len(push))
    time = PERIOD * np.arange(len(push))
    return Record(time, {"push": push, "pull": pull}, {"position": position}, hold=hold, name=f"record {seed}")


@pytest.mark.parametrize(
    ("hold", "straight"),
    [
        ({"push": "linear"}, {"push"}),
        ({"pull": "linear", "push": "zero"}, {"pull"}),
        ({"push": "linear", "pull": "linear"}, {"push", "pull"}),
        ({}, set()),
        ("linear", {"push", "pull"}),
    ],
)
def test_each_input_runs_as_it_is_said_to(hold, straight):
    record = record_of(1, hold, straight)
    found = simulate(CARRIAGE, record, {"damping": DAMPING})["position"]
    np.testing.assert_allclose(found, record.outputs["position"], atol=1e-7)


def test_records_of_unlike_holds_are_identified_and_diagnosed_side_by_side():
    noise = 1e-3
    records = [
        record_of(2, {"push": "linear"}, {"push"}, noise),
        record_of(3, "zero", set(), noise),
        record_of(4, "linear", {"push", "pull"}, noise),
    ]
    fit = identify(CARRIAGE, records, key=jax.random.key(0), population=20, generations=5)
    error = fit.precision().standard_errors["damping"]
    assert fit.parameters["damping"] == pytest.approx(DAMPING, abs=4.0 * error) and error < 0.05
    assert fit.rmse["position"] == pytest.approx(noise, rel=0.1)
    found = ehsvjax.diagnose(fit, records, key=jax.random.key(1))
    assert found.verdict == "adequate", str(found)


def test_each_input_is_resampled_by_its_hold():
    time = np.array([0.0, 1.0, 2.0])
    record = Record(time, {"a": time, "b": time}, {"y": time}, hold={"b": "linear"}).resample(0.5)
    np.testing.assert_allclose(record.inputs["a"], [0.0, 0.0, 1.0, 1.0, 2.0])
    np.testing.assert_allclose(record.inputs["b"], [0.0, 0.5, 1.0, 1.5, 2.0])
    assert record.hold_of("a") == "zero" and record.hold_of("b") == "linear"


def test_a_hold_by_name_is_kept_and_printed(tmp_path):
    record = record_of(5, {"push": "linear"}, {"push"}, 1e-3)
    for again in (
        pickle.loads(pickle.dumps(record)),
        copy.deepcopy(record),
        record.slice(0.0, 5.0),
        record.at(damping=1),
    ):
        assert again.hold == {"push": "linear"}
    assert "linear hold of push, zero-order hold of pull" in repr(record)
    with pytest.raises(TypeError):
        record.hold["pull"] = "linear"
    fit = identify(CARRIAGE, record, key=jax.random.key(0), population=8, generations=2)
    fit.save(tmp_path / "fit.npz")
    (kept,) = ehsvjax.Fit.load(tmp_path / "fit.npz", CARRIAGE).records
    assert kept.hold == {"push": "linear"}


@pytest.mark.parametrize(
    ("hold", "said"),
    [
        ({"psuh": "linear"}, "expected the names of inputs in hold, push, pull; got 'psuh': mind the spelling"),
        ({"push": "cubic"}, "expected the hold of push to be 'zero', 'linear' or 'band-limited', got 'cubic'"),
        ("first", "expected hold to be 'zero', 'linear' or 'band-limited', got 'first'"),
    ],
)
def test_another_hold_is_refused(hold, said):
    push, pull = forces(6, 10)
    with pytest.raises(ValueError, match=said):
        Record(PERIOD * np.arange(10), {"push": push, "pull": pull}, hold=hold)
