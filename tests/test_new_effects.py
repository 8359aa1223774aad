"""Limits of what is stored, holds, feedthroughs, pulsations: independent plants hide them, the package finds them."""

import itertools

import jax
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lsim

import ehsvjax
from ehsvjax.diagnosis import diagnose
from ehsvjax.effects import BANK, attach, candidates
from ehsvjax.effects.internal import contexts_of
from tests.plants import held_levels
from tests.small_models import (
    OUTFLOW,
    PUMP,
    carriage,
    carriage_plant,
    damper,
    driven_plant,
    hysteretic_plant,
    one_way_plant,
    record_of,
    tanks,
    tanks_plant,
    wandering,
)

# One process compiles.
pytestmark = pytest.mark.xdist_group("diagnoses of a carriage")
KEY = jax.random.key(0)


def diagnosed(model, record):
    fit = ehsvjax.identify(model, record, key=KEY, population=40, generations=15)
    return diagnose(fit, record, key=KEY)


# --- A tank that overflows ---

PERIOD_OF_TANKS, BRIM = 0.5, 4.0


def voltage(seed):
    return np.repeat(np.random.default_rng(seed).uniform(0.1, 1.9, 40), 15)


@pytest.fixture(scope="module")
def overflowing():
    pumped = voltage(3)
    levels = tanks_plant(pumped, PERIOD_OF_TANKS, brim=BRIM)
    assert 0.03 < np.mean(levels[:, 0] >= BRIM) < 0.3
    record = record_of(PERIOD_OF_TANKS, {"voltage": pumped}, {"lower": levels[:, 1]}, {"lower": 0.01}, 1)
    return diagnosed(tanks(), record)


def test_a_tank_that_overflows_has_a_hard_limit(overflowing):
    assert "hard_limit" in overflowing.suspected, str(overflowing)
    assert len(overflowing.names) == 1
    name = "hard_limit.positive_limit"
    found, error = (of[name] for of in (overflowing.extended.parameters, overflowing.extended.standard_errors))
    assert abs(found - BRIM) < 5.0 * error and error < 0.05 * BRIM
    assert overflowing.extended.model.parameter(name).unit == "m"
    pump = overflowing.extended.parameters["pump"]
    assert pump == pytest.approx(PUMP, rel=0.05), "the pump is no longer blamed for what is spilled"


def test_a_limit_needs_no_finer_step_than_the_model(overflowing):
    # A level that went past its limit by a step's rise, and stayed there, would need a step of a thirtieth.
    assert overflowing.integration.step_size == tanks().max_step
    assert sum(overflowing.integration.left_out.values()) == 0


@pytest.mark.parametrize(("number", "limit"), [("positive_limit", BRIM), ("negative_limit", -1.5)])
def test_a_level_stays_within_its_limit(number, limit):
    pumped, start = voltage(4), (2.0, 2.0)
    ends = {"positive_limit": {"brim": limit}, "negative_limit": {"least": -limit}}[number]
    truth, unlimited = (tanks_plant(pumped, PERIOD_OF_TANKS, start=start, **e)[:, 1] for e in (ends, {}))
    assert np.max(np.abs(truth - unlimited)) > 0.05
    model = attach(tanks(), {f"hard_limit.{number}": (-10.0, 10.0)}, duration=300.0, bank=BANK)
    record = ehsvjax.Record(PERIOD_OF_TANKS * np.arange(len(pumped)), {"voltage": pumped})
    values = {"pump": PUMP, "outflow": OUTFLOW, f"hard_limit.{number}": limit}
    found = ehsvjax.simulate(model, record, values, {"initial_upper": start[0], "initial_lower": start[1]})
    np.testing.assert_allclose(found["lower"], truth, atol=5e-3)


# --- A hold that is none, a sensor that shows the input ---

PERIOD, SAMPLES, NOISE = 0.02, 1200, {"position": 2e-3}


def test_an_input_that_runs_straight_from_value_to_value_is_a_hold():
    # A smooth input: what is left is half a sample of it.
    push = 10.0 * np.convolve(np.random.default_rng(9).standard_normal(SAMPLES + 7), np.ones(8) / 8**0.5, "valid")
    position = carriage_plant(push, PERIOD, straight=True)[:, 0]
    held = record_of(PERIOD, {"push": push}, {"position": position}, NOISE, 5)
    found = diagnosed(carriage(), held)
    assert "input_hold" in found.suspected, str(found)
    if "input_hold" in found.names:
        assert found.extended.parameters["input_hold.share"] == pytest.approx(1.0, abs=0.1)
    # Declared as it is, nothing is missing.
    straight = record_of(PERIOD, {"push": push}, {"position": position}, NOISE, 5, hold="linear")
    assert diagnosed(carriage(), straight).verdict == "adequate"


def behind_a_filter(declared):
    """Return a record of a multisine up to 0.6 of half the sample rate, stepped by SciPy twenty times a sample."""
    rng = np.random.default_rng(12)
    frequencies, phases = rng.uniform(0.02, 0.6, 15) * np.pi / PERIOD, rng.uniform(0.0, 2.0 * np.pi, 15)
    fine = PERIOD / 20 * np.arange(20 * SAMPLES)
    push = 10.0 * np.sin(fine[:, None] * frequencies + phases).sum(axis=1)
    position = carriage_plant(push, PERIOD / 20, straight=True)[::20, 0]
    return record_of(PERIOD, {"push": push[::20]}, {"position": position}, NOISE, 5, hold=declared)


@pytest.mark.parametrize("declared", ["zero", "linear"])
def test_an_input_behind_a_filter_is_no_hold_and_no_feedthrough(declared):
    found = diagnosed(carriage(), behind_a_filter(declared))
    assert found.names == ("band_limited_input",), str(found)
    share = "band_limited_input.share"
    off_by = found.extended.parameters[share] - 1.0
    assert abs(off_by) < 4.0 * found.extended.standard_errors[share], str(found)


def test_an_input_behind_a_filter_that_is_declared_leaves_nothing():
    assert diagnosed(carriage(), behind_a_filter("band-limited")).verdict == "adequate"


def test_a_force_that_acts_in_what_is_measured_alone_is_named():
    # A damper that is moved: the lag is SciPy's, the friction is added to its force.
    time = 0.01 * np.arange(1500)
    moved = 0.1 * np.sin(2.0 * time) + 0.05 * np.sin(3.1 * time)
    follows = lsim(([[-100.0]], [[100.0]], [[-100.0]], [[100.0]]), moved, time, X0=moved[0], interp=False)[1]
    force = 200.0 * follows + 30.0 * np.sign(follows)
    found = diagnosed(damper(), record_of(0.01, {"displacement": moved}, {"force": force}, {"force": 1.0}, 3))
    assert found.names == ("coulomb_friction",), str(found)
    assert found.extended.parameters["coulomb_friction.force"] == pytest.approx(30.0, rel=0.02)


def test_a_drive_that_ends_and_then_lags_has_a_limit_and_a_lag_that_may_be_the_sensors():
    # What follows the limit is linear: the record is the same whichever of the two lags.
    push, limit, lag = held_levels(12, 20.0, 150, 10), 15.0, 0.06
    position = driven_plant(push, PERIOD, limit=limit, lag=lag)
    found = diagnosed(carriage(), record_of(PERIOD, {"push": push}, {"position": position}, NOISE, 13))
    assert "input_saturation" in found.names, str(found)
    assert [{"input_lag", "sensor_lag"}] == [set(group.causes) for group in found.alternatives], str(found)
    sizes = {size.number: size.value for cause in found.causes for size in cause.sizes}
    assert sizes == {"limit": pytest.approx(limit, rel=0.02), "time_constant": pytest.approx(lag, rel=0.02)}


# --- Forces ---


def test_a_damper_that_is_stiffer_one_way_is_named():
    push = wandering(np.random.default_rng(2), 1500, 8.0)
    position = one_way_plant(push, 0.02, back=1.5, forth=4.5, steps=200)
    found = diagnosed(carriage(), record_of(0.02, {"push": push}, {"position": position}, {"position": 2e-4}, 3))
    assert found.names == ("one_way_damping",), str(found)
    assert found.extended.parameters["one_way_damping.coefficient"] == pytest.approx(1.5, rel=0.03)
    assert found.extended.parameters["damping"] == pytest.approx(3.0, rel=0.03)


@pytest.mark.parametrize(("beta", "gamma"), [(10.0, 0.0), (8.0, -11.0)])
def test_a_spring_with_hysteresis_is_named(beta, gamma):
    """Dry friction that gives before it slides, and a spring that hardens; no cubic spring, no quadratic damping."""
    push = wandering(np.random.default_rng(5), 1500, 8.0)
    position = hysteretic_plant(push, 0.02, stiffness=30.0, beta=beta, gamma=gamma)
    found = diagnosed(carriage(), record_of(0.02, {"push": push}, {"position": position}, {"position": 2e-4}, 4))
    assert found.names == ("elastic_friction",), str(found)
    numbers = {"stiffness": 30.0, "length": 1.0 / beta, "softening": gamma / beta}
    for number, value in numbers.items():
        name = f"elastic_friction.{number}"
        off_by = found.extended.parameters[name] - value
        assert abs(off_by) < 4.0 * found.extended.standard_errors[name], str(found)


def test_a_sensor_that_shows_a_part_of_the_input_at_once_is_named():
    push = held_levels(6, 20.0, SAMPLES // 20, 20)
    position = carriage_plant(push, PERIOD)[:, 0] + 1e-3 * push
    found = diagnosed(carriage(), record_of(PERIOD, {"push": push}, {"position": position}, NOISE, 6))
    assert found.verdict == "named" and found.names == ("feedthrough_of_push",), str(found)
    assert found.extended.parameters["feedthrough_of_push.gain"] == pytest.approx(1e-3, rel=0.05)


@pytest.mark.parametrize("gain", [0.97, -1.0])
def test_a_sensor_that_shows_one_side_otherwise_or_without_its_sign_is_named(gain):
    push = held_levels(7, 20.0, SAMPLES // 20, 20) + 4.0
    position = carriage_plant(push, PERIOD)[:, 0]
    shown = np.where(position < 0.0, gain * position, position)
    found = diagnosed(carriage(), record_of(PERIOD, {"push": push}, {"position": shown}, NOISE, 8))
    assert found.names == ("sensor_asymmetry",), str(found)
    assert found.extended.parameters["sensor_asymmetry.error"] == pytest.approx(gain - 1.0, rel=0.05)


@pytest.mark.parametrize(
    ("frequency", "suspected"),
    [(20.0, {"sensor_hum", "harmonic_force"}),
     # Beyond what held forces are looked for at: half the sample rate is 157 rad/s.
     (140.0, {"sensor_hum"})],
)  # fmt: skip
def test_a_hum_of_the_sensor_is_not_taken_for_a_force(frequency, suspected):
    """In a linear plant a force of that frequency moves the position alike: no record of it alone tells which."""
    push = held_levels(9, 20.0, SAMPLES // 20, 20)
    time = PERIOD * np.arange(SAMPLES)
    position = carriage_plant(push, PERIOD)[:, 0] + 2e-3 * np.sin(frequency * time + 1.0)
    found = diagnosed(carriage(), record_of(PERIOD, {"push": push}, {"position": position}, NOISE, 10))
    assert found.suspected == suspected, str(found)
    assert found.causes[0].probability > 0.95 or len(suspected) > 1


def test_a_hum_is_found_at_the_sensor_that_has_it():
    push = held_levels(11, 20.0, SAMPLES // 20, 20)
    both = carriage_plant(push, PERIOD)
    hum = 0.02 * np.cos(25.0 * PERIOD * np.arange(SAMPLES))
    outputs = {"position": both[:, 0], "velocity": both[:, 1] + hum}
    found = diagnosed(carriage(), record_of(PERIOD, {"push": push}, outputs, NOISE | {"velocity": 5e-3}, 12))
    assert (found.verdict, found.names) == ("named", ("sensor_hum@velocity",)), str(found)
    sizes = {size.number: size.value for size in found.causes[0].sizes}
    assert sizes["cosine"] == pytest.approx(0.02, rel=0.1) and sizes["frequency"] == pytest.approx(25.0, rel=1e-3)


def test_every_input_may_reach_every_sensor_that_is_measured():
    found = {c.name for c in attached_candidates(carriage(), ("position", "velocity"))}
    assert {"feedthrough_of_push@position", "feedthrough_of_push@velocity"} <= found
    assert "feedthrough_of_push" in {c.name for c in attached_candidates(carriage(), ("velocity",))}


def attached_candidates(model, observed):
    from ehsvjax.effects.of_model import effects_for

    return candidates(model, (*BANK, *effects_for(model)), contexts_of(model), observed)


# --- A supply that pulsates ---


def pulsating_valve(command, period, amplitude, frequency):
    """Simulate the paper's valve in open loop with its spool in place of the servo: Ps(t) = Ps + a*sin(w*t).

    Compressible oil, so that the load pressure is a state; the spool follows the command by its transfer function.
    """
    dead_zone, flow_gain, gain, damping, omega = 1e-4, 1.45e-4, 0.09, 0.72, 300.0
    area, supply, mass, stiffness, capacitance = 25e-4, 140e5, 20.0, 1e4, 1e-13

    def rates(t, y, u):
        x, v, p, p_rate, pressure = y
        xv = np.sign(p) * min(max(abs(p) - dead_zone, 0.0), 3e-3)
        drop = supply + amplitude * np.sin(frequency * t) - np.sign(xv) * pressure
        flow = flow_gain * xv * np.sign(drop) * np.sqrt(abs(drop))
        return [
            v,
            (area * pressure - stiffness * x) / mass,
            p_rate,
            omega**2 * (u - gain * x - p) - 2.0 * damping * omega * p_rate,
            (flow - area * v) / capacitance,
        ]

    state, positions = np.zeros(5), []
    edges = [0, *(np.flatnonzero(np.diff(command)) + 1), len(command)]
    for first, last in itertools.pairwise(edges):
        times = period * np.arange(first, last + 1)
        found = solve_ivp(rates, times[[0, -1]], state, "LSODA", times, args=(command[first],), rtol=1e-8, atol=1e-10)
        positions.append(found.y[0, :-1])
        state = found.y[:, -1]
    return np.concatenate(positions)


def test_a_supply_that_pulsates_is_what_a_plant_with_one_does():
    command = np.repeat([3e-3, -3e-3, 2e-3], 60)
    amplitude, frequency = 20e5, 90.0
    plain, pulsating = (pulsating_valve(command, 1e-3, a, frequency) for a in (0.0, amplitude))
    names = ("cosine", "sine", "frequency")
    bounds = {f"supply_pulsation.{name}": (-1e7, 1e7) if name != "frequency" else (1.0, 1e3) for name in names}
    model = attach(ehsvjax.servovalve(hydraulic_capacitance=1e-13), bounds, duration=0.18, bank=BANK)
    record = ehsvjax.Record(1e-3 * np.arange(len(command)), {"command": command})
    assert np.max(np.abs(pulsating - plain)) > 2e-4
    values = dict(zip(bounds, (0.0, amplitude, frequency), strict=True))
    changes = [ehsvjax.simulate(model, record, values | {"supply_pulsation.sine": a})["position"]
               for a in (0.0, amplitude, -amplitude)]  # fmt: skip
    np.testing.assert_allclose(changes[1] - changes[0], pulsating - plain, atol=0.03 * np.ptp(pulsating - plain))
    assert np.max(np.abs(changes[2] - changes[0] - (pulsating - plain))) > 2e-4, "the sign counts"


def test_a_pulsation_acts_at_the_supply_alone():
    found = [c for c in attached_candidates(ehsvjax.servovalve(), ("position",)) if c.effect.name == "supply_pulsation"]
    assert [c.signal for c in found] == ["supply"]
    assert found[0].effect.harmonic
    assert found[0].unit(found[0].effect.parameters[0], ehsvjax.servovalve()) == "Pa"
