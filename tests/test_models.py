"""The contract of every model: its names, its signals, its equality; and a model that a user writes."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

from ehsvjax import effects
from ehsvjax.integrators import runge_kutta_4
from ehsvjax.models import Model, Parameter, Signal, identity, servovalve, van_der_pol
from ehsvjax.record import Record
from ehsvjax.simulate import grid_of, input_array, scan_model, simulate

# --- A model as a user writes it: M x'' + B x' + K x = F ---


def start(parameters, initial, inputs):
    return {"x": initial["x0"], "v": 0.0}


def derivative(parameters, state, inputs, signal):
    x = signal("place", state["x"], velocity=state["v"])
    force = signal("push", inputs["push"]) + signal("load", 0.0, position=x, velocity=state["v"])
    return {"x": state["v"], "v": (force - parameters["B"] * state["v"] - parameters["K"] * x) / parameters["M"]}


def measure(parameters, state, inputs, signal):
    return {
        "distance": signal("distance", state["x"]),
        "spring_force": signal("spring_force", parameters["K"] * state["x"]),
    }


OSCILLATOR = Model(
    name="oscillator",
    parameters=(
        Parameter("K", "K", "N/m", 40.0, 20.0, 60.0, "log"),
        Parameter("B", "B", "N s/m", 0.8, 0.0, 2.0),
        Parameter("M", "M", "kg", 0.5, 0.1, 1.0, "log", fixed=True),
    ),
    initial=(Parameter("x0", "x(0)", "m", 0.0, -1.0, 1.0, output="distance"),),
    signals=(
        Signal("push", "input", "N"),
        Signal("place", "displacement", "m"),
        Signal("load", "force", "N"),
        Signal("distance", "sensor", "m"),
        Signal("spring_force", "sensor", "N"),
    ),
    start=start,
    stepper=runge_kutta_4(derivative),
    measure=measure,
    max_step=0.005,
)

MAKERS = {
    "valve": servovalve,
    "forward": functools.partial(servovalve, transfer_function="forward"),
    "return": functools.partial(servovalve, transfer_function="return"),
    "open loop": functools.partial(servovalve, open_loop=True),
    "compressible": functools.partial(servovalve, hydraulic_capacitance=1e-12, leakage_coefficient=1e-12),
    "flow force": functools.partial(servovalve, flow_force=True),
    "open loop, flow force": functools.partial(servovalve, open_loop=True, flow_force=True),
    "Van der Pol": van_der_pol,
    "user's own": lambda: dataclasses.replace(OSCILLATOR),
}
every_model = pytest.mark.parametrize("name", MAKERS)

# A command that moves each model, its sample period, and a start off the equilibrium.
RUNS = {"Van der Pol": (1.5, 0.02, {"initial_position": 0.5}), "user's own": (10.0, 0.01, {"x0": 0.2})}
SIZES = {"m": 2e-4, "Pa": 1e5, "N": 500.0, "": 0.1, "m/s": 0.05, "m^2": 1e-4, "m^3/(s Pa)": 1e-12, "m^3/Pa": 1e-12}


def record_for(name):
    amplitude, period, _ = RUNS.get(name, (0.03 if name == "forward" else 4e-3, 1e-3, {}))
    command = amplitude * np.repeat([1.0, -0.8, 0.0, 0.5], 60)
    return Record(period * np.arange(240), {"push" if name == "user's own" else "command": command})


def initial_for(name):
    model = MAKERS[name]()
    given = RUNS[name][2] if name in RUNS else {"initial_position": 0.01}
    return {p.name: p.value for p in model.initial} | given


@functools.cache
def disturbed(name):
    """Return run(offsets, inputs) -> outputs, with a constant added at every signal, and the names that were seen."""
    model, record, initial, seen = MAKERS[name](), record_for(name), initial_for(name), set()

    @jax.jit
    def run(offsets, inputs):
        def signal(name, value, **context):
            seen.add(name)
            return value + offsets[name]

        def keep(carry, outputs, sample):
            return carry, outputs

        period = jnp.asarray(record.sample_period)
        grid = grid_of(model, record)
        return scan_model(model.equations, grid, signal, model.nominal, initial, inputs, period, keep, None, None)[1]

    def outputs(offsets=None, shift=0.0):
        with jax.enable_x64(True):
            added = {s.name: jnp.asarray((offsets or {}).get(s.name, 0.0)) for s in model.signals}
            found = run(added, jnp.asarray(input_array(model, record) + shift))
            return {name: np.asarray(output) for name, output in found.items()}

    outputs.seen = seen
    return outputs


@every_model
def test_names_are_declared_once_and_in_one_place(name):
    model = MAKERS[name]()
    names = [p.name for p in (*model.parameters, *model.initial)]
    assert len(set(names)) == len(names)
    assert len({s.name for s in model.signals}) == len(model.signals)
    assert set(model.free) <= set(model.nominal) == {p.name for p in model.parameters}
    assert model.outputs
    # Every line is one that some effect can disturb.
    assert {s.kind for s in model.signals} <= {effect.kind for effect in effects.BANK}
    assert {p.output for p in model.initial} <= {None, *model.outputs}
    assert all(isinstance(p.symbol, str) and isinstance(p.unit, str) for p in model.parameters)


@every_model
def test_every_declared_signal_is_passed_and_no_other(name):
    run = disturbed(name)
    run()
    assert run.seen == {s.name for s in MAKERS[name]().signals}


@every_model
def test_an_undisturbed_model_is_the_nominal_one(name):
    nominal = simulate(MAKERS[name](), record_for(name), initial=initial_for(name))
    assert tuple(nominal) == MAKERS[name]().outputs
    for output, values in disturbed(name)().items():
        assert values.std() > 0
        np.testing.assert_allclose(values, nominal[output], rtol=0, atol=1e-9 * np.abs(values).max())


@every_model
def test_a_constant_at_any_signal_is_seen(name):
    run, model = disturbed(name), MAKERS[name]()
    nominal = run()
    for signal in model.signals:
        size = SIZES[signal.unit]
        outputs = run({signal.name: size})
        if signal.kind == "sensor":
            # A sensor's error is added to its own reading, and stays there.
            for output in model.outputs:
                shift = size if output == signal.name else 0.0
                np.testing.assert_allclose(outputs[output], nominal[output] + shift, rtol=1e-14)
        else:
            moved = {o: np.abs(outputs[o] - nominal[o]).max() / nominal[o].std() for o in model.outputs}
            assert max(moved.values()) > 1e-4, (signal.name, moved)


@every_model
def test_a_constant_at_an_input_is_another_input(name):
    run, model = disturbed(name), MAKERS[name]()
    (command,) = model.inputs
    size = 0.1 * np.abs(record_for(name).inputs[command]).max()
    at_signal, in_record = run({command: size}), run(shift=size)
    nominal = run()
    for output in model.outputs:
        effect = np.abs(in_record[output] - nominal[output])[20:].max()
        off = np.abs(at_signal[output] - in_record[output])[20:].max()
        # The first 20 samples, in which a start that knows the record's input alone may still be felt, are left out.
        assert off < 0.01 * effect, output


@every_model
def test_equal_makings_are_equal_models(name):
    one, other = MAKERS[name](), MAKERS[name]()
    assert one == other
    assert hash(one) == hash(other)
    assert one.equations == other.equations
    assert hash(one.equations) == hash(other.equations)


@pytest.mark.parametrize("change", [{"piston_area": 30e-4}, {"mass": 30.0}, {"hydraulic_capacitance": 1e-12}])
def test_constants_change_the_model_but_not_what_is_compiled(change):
    assert servovalve(**change) != servovalve()
    assert servovalve(**change).equations == servovalve().equations


def test_a_constant_with_another_value_is_not_traced_again():
    traces = []

    def counting(name, value, **context):
        if name == "position":
            traces.append(name)
        return value

    record = record_for("valve")
    results = [
        simulate(model, record, signal=counting)["position"]
        for model in (
            servovalve(),
            servovalve(),
            servovalve(piston_area=30e-4),
            servovalve(leakage_coefficient=1e-12).with_bounds({"dead_zone": (1e-5, 1e-3)}, {"saturation": 2e-3}),
        )
    ]
    assert len(traces) == 1
    np.testing.assert_array_equal(results[0], results[1])
    assert np.abs(results[0] - results[2]).max() > 1e-4
    simulate(servovalve(transfer_function="return"), record, signal=counting)
    assert len(traces) == 2


def test_the_names_that_users_rely_on():
    assert servovalve().inputs == ("command",)
    assert servovalve().outputs == ("position", "spool", "load_pressure")
    valve = ("dead_zone", "saturation", "flow_gain", "feedback_gain", "damping_ratio", "natural_frequency")
    assert servovalve().free == valve
    assert servovalve(open_loop=True).free == tuple(name for name in valve if name != "feedback_gain")
    assert van_der_pol().inputs == ("command",)
    assert van_der_pol().outputs == ("position",)
    assert van_der_pol().free == ("alpha", "gamma")
    assert [servovalve().unit(name) for name in ("position", "supply")] == ["m", "Pa"]
    with pytest.raises(ValueError, match=r"expected a signal of servovalve, got 'pressure'; it has .*load_pressure"):
        servovalve().unit("pressure")


@every_model
def test_bounds_of_the_paper_are_half_of_the_value_to_either_side(name):
    for parameter in MAKERS[name]().parameters:
        if not parameter.fixed and name != "user's own":
            assert parameter.lower == pytest.approx(0.5 * parameter.value)
            assert parameter.upper == pytest.approx(1.5 * parameter.value)


# --- Bounds and constants ---


def test_bounds_free_a_constant_and_fixing_holds_a_parameter():
    model = servovalve().with_bounds({"mass": (5.0, 50.0)}, {"dead_zone": 2e-4})
    assert "mass" in model.free
    assert "dead_zone" not in model.free
    assert model.nominal["dead_zone"] == 2e-4
    assert (model.parameter("mass").lower, model.parameter("mass").upper) == (5.0, 50.0)
    assert servovalve().free[0] == "dead_zone"  # the model it was made from is as it was


def test_a_value_outside_new_bounds_moves_to_the_nearer_one():
    assert servovalve().with_bounds({"mass": (30.0, 50.0)}).nominal["mass"] == 30.0


def test_initial_conditions_take_bounds_and_values_too():
    model = servovalve().with_bounds({"initial_filtered": (-1e-3, 1e-3)}, {"initial_position": 0.03})
    assert model.parameter("initial_filtered").upper == 1e-3
    assert model.parameter("initial_position").fixed
    assert simulate(model, record_for("valve"))["position"][0] == 0.03


@pytest.mark.parametrize(("lower", "scale"), [(-1.0, "linear"), (0.0, "linear"), (0.1, "log")])
def test_bounds_that_reach_zero_are_searched_on_a_linear_scale(lower, scale):
    assert servovalve().with_bounds({"feedback_gain": (lower, 2.0)}).parameter("feedback_gain").scale == scale


@pytest.mark.parametrize(
    ("bounds", "fixed", "sentence"),
    [
        ({"dead_zne": (0.0, 1.0)}, {}, "expected a parameter of servovalve, got 'dead_zne'; it has dead_zone, satur"),
        ({}, {"gamma": 1.0}, "expected a parameter of servovalve, got 'gamma'; it has dead_zone"),
        (
            {"mass": (1.0, 2.0)},
            {"mass": 1.5},
            "expected each parameter to be either bounded or fixed, got both for mass",
        ),
        (
            {"dead_zone": (2e-4, 1e-4)},
            {},
            r"expected finite bounds of dead_zone with lower < upper, got \(0.0002, 0.0001\)",
        ),
        ({"dead_zone": (1e-4, 1e-4)}, {}, r"to hold it at one value use fixed=\{'dead_zone': value\}"),
        ({"dead_zone": (1e-4, float("inf"))}, {}, "expected finite bounds of dead_zone"),
        ({"dead_zone": (float("nan"), 1e-4)}, {}, "expected finite bounds of dead_zone"),
        ({}, {"dead_zone": float("nan")}, "expected dead_zone to be a finite number, got nan: give its value, SI"),
        ({}, {"mass": -1.0}, "expected a positive value for mass, or zero, got -1.0: mind the sign"),
    ],
)
def test_bounds_that_cannot_be(bounds, fixed, sentence):
    with pytest.raises(ValueError, match=sentence):
        servovalve().with_bounds(bounds, fixed)


def test_an_unknown_parameter():
    with pytest.raises(
        ValueError, match="expected a parameter of Van der Pol oscillator, got 'beta'; it has alpha, gam"
    ):
        van_der_pol().parameter("beta")


# --- A user's model that cannot be ---


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            {"initial": (Parameter("K", "x", "m", 0.0, -1.0, 1.0),)},
            "expected every parameter of oscillator to have its own name, got {'K'} twice",
        ),
        (
            {"signals": (*OSCILLATOR.signals, Signal("place", "force", "N"))},
            "expected every signal of oscillator to have its own name, got {'place'} twice",
        ),
        (
            {"signals": (Signal("push", "input", "N"),)},
            "expected oscillator to have an output, got no signal of kind 'sensor'",
        ),
        (
            {"parameters": (Parameter("K", "K", "N/m", 1.0, 0.0, 2.0, "log"),)},
            "expected a positive lower bound of K, which is searched by its logarithm, got 0.0",
        ),
        (
            {"parameters": (Parameter("K", "K", "N/m", 3.0, 1.0, 2.0),)},
            r"expected the value of K inside its bounds \(1.0, 2.0\), got 3.0",
        ),
        (
            {"parameters": (Parameter("K", "K", "N/m", 1.0, 2.0, 0.0),)},
            r"expected finite bounds of K with lower < upper, got \(2.0, 0.0\)",
        ),
        (
            {"initial": (Parameter("x0", "x(0)", "m", 0.0, -1.0, 1.0, output="push"),)},
            "expected the output that shows x0 of .* of kind 'sensor', distance, spring_force; got 'push'",
        ),
        ({"max_step": 0.0}, "expected max_step of oscillator to be positive, got 0.0: give seconds above 0"),
        ({"max_step": float("nan")}, "expected max_step of oscillator to be a finite number, got nan"),
    ],
)
def test_a_model_that_cannot_be(change, sentence):
    with pytest.raises(ValueError, match=sentence):
        dataclasses.replace(OSCILLATOR, **change)


# --- A user's model against SciPy ---


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_a_users_model_is_simulated_right(hold):
    time = 0.01 * np.arange(500)
    push = 5.0 * np.random.default_rng(1).standard_normal(500)
    outputs = simulate(OSCILLATOR, Record(time, {"push": push}, hold=hold), {"B": 1.1}, {"x0": 0.3})
    mass, damping, stiffness = 0.5, 1.1, 40.0
    system = scipy.signal.StateSpace([[0, 1], [-stiffness / mass, -damping / mass]], [[0], [1 / mass]], [[1, 0]], [[0]])
    _, expected, _ = scipy.signal.lsim(system, push, time, X0=[0.3, 0.0], interp=hold == "linear")
    np.testing.assert_allclose(outputs["distance"], expected, rtol=0, atol=2e-7)
    np.testing.assert_allclose(outputs["spring_force"], stiffness * outputs["distance"], rtol=1e-14)


def test_a_users_model_rings_down_as_the_closed_form_says():
    record = Record(0.01 * np.arange(300), {"push": np.zeros(300)})
    outputs = simulate(OSCILLATOR, record, {"B": 1.2}, {"x0": 0.1})
    decay, omega = 1.2, np.sqrt(80.0 - 1.2**2)  # B/(2M), K/M = 80
    expected = (
        0.1 * np.exp(-decay * record.time) * (np.cos(omega * record.time) + decay / omega * np.sin(omega * record.time))
    )
    np.testing.assert_allclose(outputs["distance"], expected, rtol=0, atol=1e-8)


def test_a_users_equations_are_compiled_once():
    assert MAKERS["user's own"]().equations == OSCILLATOR.equations
    assert OSCILLATOR.with_bounds({"M": (0.1, 1.0)}).equations == OSCILLATOR.equations


def test_the_identity_leaves_every_signal_alone():
    value = object()
    assert identity("position", value, velocity=1.0) is value
