"""Effects: absent they change nothing, attached by name they are parameters, and what cannot be meant is refused."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ehsvjax
from ehsvjax import kernels
from ehsvjax.effects import BANK, Effect, amplitude, attach, candidates, effects_of
from ehsvjax.effects.internal import contexts_of, internal_signals
from ehsvjax.effects.of_model import effects_for
from ehsvjax.population import cast, population_cost
from ehsvjax.unknowns import problem_of
from tests.compilations import compilations
from tests.hidden_plants import effect_sizes, held_levels, servovalve_with, van_der_pol_with
from tests.small_models import damper

TIME = np.arange(300) * 1e-3
COMMAND = held_levels(np.random.default_rng(0), 6e-3, 3, 100)
RECORD = ehsvjax.Record(TIME, {"command": COMMAND})


def test_attached_but_absent_effects_change_nothing():
    model = ehsvjax.servovalve()
    bounds = {
        "transport_delay.delay": (0.0, 0.01),
        "torque_motor_hysteresis.half_width": (0.0, 1e-3),
        "sensor_lag@position.time_constant": (0.0, 0.01),
        "coulomb_friction.force": (0.0, 1e4),
        "flow_gain_rounding.width": (0.0, 1e-3),
        "area_asymmetry.asymmetry": (-0.5, 0.5),
    }
    extended = attach(model, bounds, duration=0.3, bank=BANK)
    assert effects_of(extended) == tuple(name.rpartition(".")[0] for name in bounds)
    assert set(bounds) <= set(extended.free)
    nominal = ehsvjax.simulate(model, RECORD)["position"]
    np.testing.assert_allclose(ehsvjax.simulate(extended, RECORD)["position"], nominal, atol=1e-7)


# What the plants call otherwise: number of the plant -> numbers of the package.
RENAMED = {
    ("feedback_backlash", "width"): lambda width: {"half_width": width},
    ("torque_motor_hysteresis", "width"): lambda width: {"half_width": width},
    ("input_dead_zone", "width"): lambda width: {"half_width": width},
    ("spool_rate_limit", "rate"): lambda rate: {"limit": rate},
    ("structural_flexibility", "stiffness"): lambda stiffness: {"compliance": 1.0 / stiffness},
    ("area_ratio", "ratio"): lambda ratio: {"error": ratio - 1.0},
    # The plant's ends where it began to give.
    ("elastic_friction", "length"): lambda length: {"length": length, "softening": 0.0},
    ("end_stop", "position"): lambda position: {"positive_end": position},
    ("end_stop", "stiffness"): lambda stiffness: {"positive_stiffness": stiffness},
}
# That this short record reaches.
STOP = {"position": 0.01, "stiffness": 8e7}


def in_the_package(name, sizes):
    """Return the numbers of the package's effect that has a plant's sizes."""
    if "phase" in sizes:
        # A load by the sine of the plant's phase, against the package's force, a hum with it; the rest by its cosine.
        (size,), phase = sizes.keys() - {"frequency", "phase"}, sizes["phase"]
        size, sine = sizes[size], np.array([np.sin(phase), np.cos(phase)])
        by_name = {"harmonic_load": -sine, "sensor_hum": sine}
        turned = by_name.get(name, (np.cos(phase), -np.sin(phase)))
        return {"cosine": size * turned[0], "sine": size * turned[1], "frequency": sizes["frequency"]}
    found = {}
    for number, value in sizes.items():
        found |= RENAMED.get((name, number), lambda value, number=number: {number: value})(value)
    return found


def everything_attached(model, duration):
    """Return the model with the whole bank, and the values with which all of it is absent."""
    bounds, absent = {}, {}
    for candidate in candidates(model, BANK, contexts_of(model), model.outputs):
        for number in candidate.effect.parameters:
            # A shape means nothing where the amplitude is zero.
            name = candidate.parameter(number.name)
            absent[name] = 1.0 if number.absent is None else number.absent
            bounds[name] = (absent[name], absent[name] + max(1.0, absent[name]))
    return attach(model, bounds, duration=duration, bank=BANK), absent


@pytest.mark.parametrize(
    ("make", "plant", "period", "command", "exact"),
    [
        (ehsvjax.servovalve, servovalve_with, 1e-3, COMMAND, 4e-6),
        (ehsvjax.van_der_pol, van_der_pol_with, 0.02, held_levels(np.random.default_rng(2), 1.0, 10, 60), 2e-4),
    ],
)
def test_every_effect_is_what_an_independent_plant_has(make, plant, period, command, exact):
    model, record = make(), ehsvjax.Record(np.arange(len(command)) * period, {"command": command})
    ranges = effect_sizes("servovalve" if make is ehsvjax.servovalve else "van_der_pol")
    hidden = {
        name: STOP if name == "end_stop" else {k: low + 0.7 * (high - low) for k, (low, high) in numbers.items()}
        for name, numbers in ranges.items()
        if not name.startswith("unknown") and name not in ("sensor_quantisation", "process_noise")
    }
    # Limits that this short record reaches, and sizes that it shows.
    limits = {"sensor_saturation": 0.01 if make is ehsvjax.servovalve else 1.6, "input_saturation": 0.5}
    hidden |= {name: {"limit": limit} for name, limit in limits.items() if name in hidden}
    large = {"stribeck_friction": {"force": 1e4, "velocity": 0.05}, "flow_gain_rounding": {"width": 3e-4}}
    hidden |= {name: sizes for name, sizes in (large | {"spool_rate_limit": {"rate": 0.3}}).items() if name in hidden}
    plain, *shown = plant([{}, *({n: s} for n, s in hidden.items())], np.tile(command, (len(hidden) + 1, 1)), period)[
        "position"
    ]
    extended, absent = everything_attached(model, len(command) * period)
    off = {}
    for (name, sizes), truth in zip(hidden.items(), shown, strict=True):
        values = dict(absent)
        for number, value in in_the_package(name, sizes).items():
            (found,) = [n for n in (f"{name}{at}.{number}" for at in ("", "@position", "@gamma")) if n in values]
            values[found] = value
        simulated = ehsvjax.simulate(extended, record, values)["position"]
        effect, error = np.abs(truth - plain).max(), np.abs(simulated - truth).max()
        if effect < 3 * exact or error > 0.02 * effect + exact:
            off[name] = (float(effect), float(error))
    assert off == {}


def test_a_sensor_lags_before_its_readings_end():
    """The plant's range ends behind all else, as a converter's does: the reading stays at its end until the lag is."""
    sizes = {"sensor_lag": {"time_constant": 4e-3}, "sensor_saturation": {"limit": 0.01}}
    truth = servovalve_with([sizes], COMMAND[None], 1e-3)["position"][0]
    record = ehsvjax.Record(np.arange(len(COMMAND)) * 1e-3, {"command": COMMAND})
    extended, absent = everything_attached(ehsvjax.servovalve(), len(COMMAND) * 1e-3)
    values = absent | {"sensor_lag@position.time_constant": 4e-3, "sensor_saturation@position.limit": 0.01}
    assert np.abs(ehsvjax.simulate(extended, record, values)["position"] - truth).max() < 4e-6


@pytest.mark.parametrize(("make", "period"), [(ehsvjax.servovalve, 1e-3), (ehsvjax.van_der_pol, 0.02)])
def test_every_effect_leaves_a_search_in_one_native_function(make, period, monkeypatch):
    model, _ = everything_attached(make(), 1.0)
    time = np.arange(len(COMMAND)) * period
    record = ehsvjax.Record(time, {"command": COMMAND}, {"position": np.sin(time)})
    compiled = []

    def in_blocks(function, rows):
        compiled.append(kernels._compiles_inside(jax.make_jaxpr(function)(rows).jaxpr))
        return function(rows)

    monkeypatch.setattr(kernels, "in_blocks", in_blocks)
    problem = cast(problem_of(model, [record]), jnp.float32)
    jax.eval_shape(population_cost, problem, jnp.full((2, problem.unknowns), 0.5, jnp.float32))
    assert compiled == [True]


@pytest.mark.parametrize(("effect", "value"), [("transport_delay.delay", 0.033), ("input_lag.time_constant", 0.05)])
def test_what_precedes_a_model_is_identified_with_it(effect, value):
    model = attach(ehsvjax.van_der_pol(), {effect: (0.0, 0.2)}, duration=6.0, bank=BANK)
    rng = np.random.default_rng(3)
    command = np.repeat(rng.uniform(-2.0, 2.0, 10), 30)
    name, number = effect.split(".")
    position = van_der_pol_with([{name: {number: value}}], command[None], 0.02)["position"][0]
    noisy = position + rng.normal(0.0, 0.01, len(command))
    record = ehsvjax.Record(np.arange(len(command)) * 0.02, {"command": command}, {"position": noisy})
    # Of this size a population filled one block, and XLA aborted on what the kernel left outside.
    fit = ehsvjax.identify(model, record, key=jax.random.key(0), population=96, generations=10)
    assert abs(fit.parameters[effect] - value) < 4.0 * fit.standard_errors[effect]


@pytest.mark.parametrize("stiffness", [1e7, 1e8])
def test_a_stop_is_right_to_a_hundredth_of_the_least_noise(stiffness):
    end = 0.01
    bounds = {"end_stop.positive_end": (0.0, 1.0), "end_stop.positive_stiffness": (1e6, 3e8)}
    extended = attach(ehsvjax.servovalve(), bounds, duration=0.3, bank=BANK)
    values = {"end_stop.positive_end": end, "end_stop.positive_stiffness": stiffness}
    stopped = {"end_stop": {"position": end, "stiffness": stiffness}}
    truth = servovalve_with([stopped], RECORD.inputs["command"][None], 1e-3, fine_step=2.5e-5)["position"][0]
    position = ehsvjax.simulate(extended, RECORD, values)["position"]
    assert position.max() > end
    # Forces taken at the step's start instead of its middle are 20 times worse.
    assert np.sqrt(np.mean((position - truth) ** 2)) < 1e-6


def test_candidates_are_found_from_the_model():
    model = ehsvjax.van_der_pol()
    record = ehsvjax.Record(np.arange(50) * 0.02, {"command": np.ones(50)})
    seen = internal_signals(model, record, {}, {})
    found = {c.name for c in candidates(model, BANK, seen.contexts, ("position",))}
    assert {"cubic_stiffness", "sensor_bias", "transport_delay", "damping_threshold"} <= found
    assert {"parameter_drift@alpha", "parameter_drift@gamma"} <= found
    assert not {"null_bias", "coulomb_friction@load_friction"} & found


@pytest.mark.parametrize(
    ("make", "amplitude", "period"),
    [(ehsvjax.servovalve, 6e-3, 1e-3), (ehsvjax.van_der_pol, 1.0, 0.02), (damper, 0.1, 0.01)],
)
def test_every_effect_of_the_bank_absent_changes_nothing(make, amplitude, period):
    # The damper's output jumps with its input.
    model = make()
    (name,) = model.inputs
    levels = held_levels(np.random.default_rng(1), amplitude, 3, 100)
    record = ehsvjax.Record(np.arange(300) * period, {name: levels})
    extended, absent = everything_attached(model, 300 * period)
    nominal, found = ehsvjax.simulate(model, record), ehsvjax.simulate(extended, record, absent)
    for name in model.outputs:
        np.testing.assert_allclose(found[name], nominal[name], rtol=1e-9, atol=1e-9 * np.abs(nominal[name]).max())


def test_what_is_attached_already_is_no_candidate_and_is_not_attached_again():
    model = attach(ehsvjax.van_der_pol(), {"cubic_stiffness.coefficient": (0.0, 1.0)}, duration=30.0, bank=BANK)
    names = {c.name for c in candidates(model, BANK, contexts_of(model), ("position",))}
    assert "cubic_stiffness" not in names and "sensor_bias" in names
    assert not any("." in name for name in names)
    with pytest.raises(ValueError, match="has cubic_stiffness already"):
        attach(model, {"cubic_stiffness.coefficient": (0.0, 1.0)}, duration=30.0, bank=BANK)
    with pytest.raises(ValueError, match="counts its drifts, 30.0 s; got 10.0"):
        attach(model, {"sensor_drift.drift": (0.0, 1.0)}, duration=10.0, bank=BANK)


@pytest.mark.parametrize("make", [ehsvjax.servovalve, ehsvjax.van_der_pol])
def test_a_model_with_every_effect_passes_the_same_signals_and_can_be_extended_further(make):
    extended, _ = everything_attached(make(), 0.3)
    before, after = contexts_of(make()), contexts_of(extended)
    assert all(set(context) <= set(after[name]) for name, context in before.items())


def test_what_is_far_off_is_rarer_and_however_far_no_more_than_rare():
    error = next(e for e in BANK if e.name == "sensor_gain").parameters[0]
    rarity = [error.rarity(size) for size in (0.0, 0.05, -0.05, 0.33, 9.0, 1e9)]
    assert rarity[0] == 0.0 and rarity[1] == rarity[2] == 0.5 and 0.95 < rarity[3] < rarity[4] < 1.0 == rarity[5]
    # A constant may have been given wrong by any factor; of a friction nobody knows how large it usually is.
    given = next(e for e in effects_for(ehsvjax.servovalve()) if e.name == "stiffness").parameters[0]
    assert given.rarity(9.0) == 0.0
    friction = next(e for e in BANK if e.name == "coulomb_friction").parameters[0]
    assert friction.rarity(1.0) == friction.rarity(1e6) == 0.5


def test_a_usual_size_is_positive():
    depth = amplitude("depth", "N", lambda s: 1.0, usual=-1.0)
    with pytest.raises(ValueError, match="usual of a number of cogging to be positive.*got -1.*inf where any value"):
        Effect("cogging", "force", (depth,), lambda own, force, context: force + own["depth"])


def test_an_effect_that_can_never_vanish_is_refused():
    with pytest.raises(ValueError, match="cogging to have a number that makes it vanish.*got no number"):
        Effect("cogging", "force", (), lambda own, force, context: force)
    with pytest.raises(ValueError, match="its own name, got depth, depth"):
        Effect("cogging", "force", (amplitude("depth", "N", lambda s: 1.0),) * 2, lambda own, force, context: force)


@pytest.mark.parametrize(
    ("bounds", "said"),
    [
        (
            {"sensor_bais.bias": (-1, 1)},
            r"an effect and one of its numbers, got sensor_bais\.bias; the bank has ",
        ),
        (
            {"sensor_bias.size": (-1, 1)},
            r"an effect and one of its numbers, got sensor_bias\.size; the bank has ",
        ),
        ({"harmonic_force.sine": (-1, 1)}, "bounds of every number of harmonic_force, cosine, sine, .*; got sine"),
        ({"null_bias.bias": (-1, 1)}, "expected a signal of Van der Pol oscillator of kind spool for null_bias"),
        ({"sensor_bias@speed.bias": (-1, 1)}, "expected a signal of Van der Pol oscillator of kind sensor"),
        ({"parameter_drift.drift": (-1, 1)}, "one of parameter_drift@alpha, parameter_drift@gamma"),
        ({"structural_flexibility.compliance": (0, 1)}, "load_force"),  # which this model does not pass on
        ({"sensor_bias.bias": (1, -1)}, r"finite bounds of sensor_bias\.bias with lower < upper, got \(1\.0, -1\.0\)"),
        ({}, "bounds of an effect's numbers, .*; got none"),
        ({"input_lag.time_constant": (-1, 1)}, r"input_lag\.time_constant to be bounded by zero or more, got .* -1\.0"),
        ({"sensor_bias.bias": (0, 1), "sensor_bias@position.bias": (0, 1)}, r"bounds of sensor_bias\.bias once"),
        ({"sensor_bias.bias": (1,)}, r"bounds of sensor_bias\.bias as \(lower, upper\), got \(1,\)"),
        ({"sensor_bias.bias": 0.1}, r"bounds of sensor_bias\.bias as \(lower, upper\), got 0\.1"),
    ],
)
def test_what_cannot_be_attached_is_refused(bounds, said):
    with compilations() as compiled, pytest.raises(ValueError, match=said):
        inspect.unwrap(attach)(ehsvjax.van_der_pol(), bounds, duration=30.0, bank=BANK)
    assert compiled == []


def test_several_signals_that_take_an_effect_are_named_and_one_can_be_chosen():
    bounds = (-1e-3, 1e-3)
    with pytest.raises(ValueError, match="one of sensor_bias@position, sensor_bias@spool, sensor_bias@load_pressure"):
        attach(ehsvjax.servovalve(), {"sensor_bias.bias": bounds}, duration=1.0, bank=BANK)
    chosen = attach(ehsvjax.servovalve(), {"sensor_bias@spool.bias": bounds}, duration=1.0, bank=BANK)
    assert effects_of(chosen) == ("sensor_bias@spool",)
    assert chosen.parameter("sensor_bias@spool.bias").unit == "m"


@pytest.mark.parametrize("duration", [0.0, -1.0, np.nan])
def test_a_duration_that_is_none_is_refused(duration):
    with pytest.raises(ValueError, match="duration"):
        attach(ehsvjax.van_der_pol(), {"sensor_drift.drift": (-1.0, 1.0)}, duration=duration, bank=BANK)


def test_two_forms_of_one_name_are_attached_together():
    ends = {f"end_stop.{side}_end": (0.0, 0.1) for side in ("positive", "negative")}
    ends |= {f"end_stop.{side}_stiffness": (1e6, 3e8) for side in ("positive", "negative")}
    assert set(ends) <= set(attach(ehsvjax.servovalve(), ends, duration=1.0, bank=BANK).free)
