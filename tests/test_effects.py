"""Effects: absent they change nothing, attached by name they are parameters, and what cannot be meant is refused."""

import jax
import numpy as np
import pytest

import ehsvjax
from ehsvjax.effects import BANK, attach, candidates, effects_of
from ehsvjax.effects.internal import internal_signals
from tests.hidden_plants import held_levels, servovalve_with

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


@pytest.mark.parametrize(
    ("name", "value", "effect"),
    [
        ("transport_delay.delay", 3e-3, {"transport_delay": {"delay": 3e-3}}),
        ("null_bias.bias", 5e-5, {"null_bias": {"bias": 5e-5}}),
        ("supply_droop.resistance", 1e9, {"supply_droop": {"resistance": 1e9}}),
        ("feedback_backlash.half_width", 4e-4, {"feedback_backlash": {"width": 4e-4}}),
        ("coulomb_friction.force", 3e3, {"coulomb_friction": {"force": 3e3}}),
    ],
)
def test_an_effect_is_what_an_independent_plant_has(name, value, effect):
    model = attach(ehsvjax.servovalve(), {name: (0.0, 2.0 * value)}, duration=0.3, bank=BANK)
    found = ehsvjax.simulate(model, RECORD, {name: value})["position"]
    plant = servovalve_with([effect], COMMAND[None], 1e-3)["position"][0]
    plain = servovalve_with([{}], COMMAND[None], 1e-3)["position"][0]
    assert np.abs(found - plant).max() < 0.02 * np.abs(plain - plant).max() + 2e-6


def test_candidates_are_found_from_the_model():
    model = ehsvjax.van_der_pol()
    record = ehsvjax.Record(np.arange(50) * 0.02, {"command": np.ones(50)})
    seen = internal_signals(model, record, {}, {})
    found = {c.name for c in candidates(model, BANK, seen.contexts, ("position",))}
    assert {"cubic_stiffness", "sensor_bias", "transport_delay", "damping_threshold"} <= found
    assert {"parameter_drift@alpha", "parameter_drift@gamma"} <= found
    assert not {"null_bias", "coulomb_friction@load_friction"} & found


@pytest.mark.parametrize(
    ("bounds", "said"),
    [
        ({"friktion.force": (0, 1)}, "expected an effect"),
        ({"cubic_stiffness.coefficient": (0, 1)}, "kind force"),
        ({"sensor_bias.bias": (0, 1)}, "at which signal"),
        ({"harmonic_load.cosine": (-1, 1)}, "bounds of every number"),
    ],
)
def test_what_cannot_be_attached_is_refused(bounds, said):
    with pytest.raises(ValueError, match=said):
        attach(ehsvjax.servovalve(), bounds, duration=1.0, bank=BANK)


def test_what_cannot_be_diagnosed_is_refused():
    time = np.arange(400) * 0.02
    command = np.repeat([1.0, -1.0, 0.5, -0.5], 100)
    model = ehsvjax.van_der_pol()
    position = ehsvjax.simulate(model, ehsvjax.Record(time, {"command": command}))["position"]
    record = ehsvjax.Record(time, {"command": command}, {"position": position + 0.01 * np.cos(50.0 * time)})
    key = jax.random.key(0)
    fit = ehsvjax.identify(model, record, key=key, population=20, generations=3)
    with pytest.raises(ValueError, match="hold an output that was fitted"):
        ehsvjax.diagnose(fit, ehsvjax.Record(time, {"command": command}), key=key)
    with pytest.raises(ValueError, match="validation to hold an output"):
        ehsvjax.diagnose(fit, record, ehsvjax.Record(time, {"command": command}), key=key)
    with pytest.raises(ValueError, match="sequence of effects"):
        ehsvjax.diagnose(fit, record, key=key, bank=())
