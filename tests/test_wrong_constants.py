"""A constant that was given wrong is found under its own name, in one group with what looks the same."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ehsvjax
from ehsvjax import Parameter, runge_kutta_4
from ehsvjax.diagnosis import diagnose
from tests.plants import held_levels, servovalve_plant
from tests.small_models import (
    DAMPING,
    MASS,
    STIFFNESS,
    carriage,
    carriage_plant,
    carriage_rates,
    modulated_plant,
    record_of,
)

# One process compiles for one model.
of_a_carriage = pytest.mark.xdist_group("diagnoses of a carriage")
KEY = jax.random.key(0)
PERIOD, SAMPLES = 0.02, 1200
NOISE = {"position": 2e-3}
PUSH = held_levels(5, 20.0, 60, 20)


def diagnosed(model, position, seed):
    record = record_of(PERIOD, {"push": PUSH}, {"position": position}, NOISE, seed)
    fit = ehsvjax.identify(model, record, key=KEY, population=40, generations=15)
    return diagnose(fit, record, key=KEY)


@pytest.fixture(scope="module")
def softer():
    return diagnosed(carriage(), carriage_plant(PUSH, PERIOD, stiffness=1.5 * STIFFNESS)[:, 0], seed=1)


@of_a_carriage
def test_a_constant_that_is_off_is_in_one_group_with_what_looks_the_same(softer):
    assert softer.suspected == {"stiffness", "linear_stiffness"}, str(softer)
    # The same as more of a spring at the force: no record tells them apart.
    assert softer.verdict == "ambiguous"
    settled_by = next(group.settled_by for group in softer.alternatives)
    assert "stiffness: measure it, or free it: bounds={'stiffness': ...}" in settled_by
    found = softer.extended.parameters
    error = (
        found["stiffness.error"] if "stiffness.error" in found else found["linear_stiffness.coefficient"] / STIFFNESS
    )
    assert error == pytest.approx(0.5, abs=0.01)


@of_a_carriage
def test_what_is_certain_is_no_candidate(softer):
    assert {"stiffness", "modulation"} <= set(softer.table["cause"])
    assert "mass" not in set(softer.table["cause"])
    # Nor is anything that is not identified but for the record's sake.
    assert not any(cause.startswith("record_duration") for cause in softer.table["cause"])


@of_a_carriage
def test_a_constant_that_is_certain_is_not_blamed_though_it_is_off():
    found = diagnosed(carriage(mass=1.3 * MASS), carriage_plant(PUSH, PERIOD)[:, 0], seed=2)
    assert found.verdict != "adequate"
    assert "mass" not in found.suspected, str(found)


def of_mass(given: float, **bounds) -> ehsvjax.Model:
    """Return the carriage with a mass that is given, and may have been given wrong, or is between some bounds."""
    model = carriage(mass=given).with_bounds(bounds)
    return replace(model, parameters=tuple(p._replace(certain=False) for p in model.parameters))


@of_a_carriage
def test_a_constant_that_is_off_by_a_factor_of_twelve_is_found():
    # An error that ended at ten times as much left something, which a dead zone and a softer spring stood for.
    found = diagnosed(of_mass(MASS / 12.0), carriage_plant(PUSH, PERIOD)[:, 0], seed=3)
    assert (found.verdict, found.names) == ("named", ("mass",)), str(found)
    assert 1.0 + found.extended.parameters["mass.error"] == pytest.approx(12.0, rel=0.01)


@of_a_carriage
def test_a_parameter_beyond_its_bounds_is_named_and_no_cause_that_stands_for_it(tmp_path):
    found = diagnosed(of_mass(5.0, mass=(4.0, 10.0)), carriage_plant(PUSH, PERIOD)[:, 0], seed=6)
    assert (found.verdict, found.names) == ("named", ("mass",)), str(found)
    assert "mass (2 kg, certain)" in str(found)
    assert "instead of the 4 kg at which its bound holds it" in str(found)
    # What holds a parameter is given in the extended model; its error is found there.
    better = found.extended
    assert better.model.parameter("mass").value == pytest.approx(4.0)
    assert better.parameters["mass.error"] == pytest.approx(MASS / 4.0 - 1.0, abs=0.01)
    found.save(tmp_path / "found.zip")
    assert str(ehsvjax.Diagnosis.load(tmp_path / "found.zip", model=of_mass(5.0, mass=(4.0, 10.0)))) == str(found)


@of_a_carriage
def test_a_parameter_that_noise_drives_to_its_bound_leaves_noise():
    # The bound is where the truth is: half of all records have their minimum beyond it.
    at_truth = carriage().with_bounds({"damping": (DAMPING, 10.0)})
    verdicts = [diagnosed(at_truth, carriage_plant(PUSH, PERIOD)[:, 0], seed).verdict for seed in range(20, 26)]
    assert verdicts == ["adequate"] * 6


@of_a_carriage
def test_channels_that_are_not_read_at_once_are_a_delay_of_less_than_nothing():
    # A feedthrough and an error of the hold, both certain, stood for it.
    position = carriage_plant(PUSH, PERIOD)[:, 0]
    record = record_of(PERIOD, {"push": PUSH[:-3]}, {"position": position[3:]}, NOISE, 12)
    fit = ehsvjax.identify(carriage(), record, key=KEY, population=40, generations=15)
    found = diagnose(fit, record, key=KEY)
    assert (found.verdict, found.names) == ("named", ("transport_delay",)), str(found)
    assert found.causes[0].sizes[0].value == pytest.approx(-3.0 * PERIOD, rel=0.02)


@of_a_carriage
def test_a_column_with_the_wrong_sign_is_refused():
    with pytest.raises(ValueError, match=r"explains nothing of position, and the opposite sign of position, or of"):
        diagnosed(carriage(), -carriage_plant(PUSH, PERIOD)[:, 0], seed=1)


def limited(parameters, state, inputs, signal):
    """Return the rates of a carriage whose drive ends at a force."""
    highest = parameters["highest"]
    push = {"push": jnp.clip(inputs["push"], -highest, highest)}
    return carriage_rates(parameters, state, push, signal)


@of_a_carriage
def test_a_parameter_that_acts_beyond_its_bounds_only_is_found():
    # Between them it changes nothing, so that no slope leads out of them: of a servovalve, a saturation that no command
    # reached was an error of the input's gain.
    highest = Parameter("highest", "F", "N", 50.0, 30.0, 300.0, "log")
    model = carriage()
    model = replace(model, parameters=(*model.parameters, highest), stepper=runge_kutta_4(limited))
    found = diagnosed(model, carriage_plant(np.clip(PUSH, -8.0, 8.0), PERIOD)[:, 0], seed=15)
    assert found.suspected == {"highest", "input_saturation"}, str(found)
    assert found.fit.parameters["highest"] * (1.0 + found.extended.parameters["highest.error"]) == pytest.approx(
        8.0, rel=0.01
    )
    assert "N where it changes nothing" in str(found)
    silent = diagnosed(model, carriage_plant(PUSH, PERIOD)[:, 0], seed=16)
    assert silent.verdict == "adequate", str(silent)


@of_a_carriage
def test_a_dead_zone_of_most_of_the_input_is_found():
    half_width = 0.7 * np.max(np.abs(PUSH))
    passed = np.sign(PUSH) * np.maximum(np.abs(PUSH) - half_width, 0.0)
    found = diagnosed(carriage(), carriage_plant(passed, PERIOD)[:, 0], seed=4)
    assert (found.verdict, found.names) == ("named", ("input_dead_zone",)), str(found)
    assert found.causes[0].sizes[0].value == pytest.approx(half_width, rel=0.01)


@of_a_carriage
def test_a_constant_of_zero_that_is_there_is_named_with_its_size():
    found = diagnosed(carriage(), modulated_plant(PUSH, PERIOD, 0.5), seed=3)
    assert found.verdict == "named" and found.names == ("modulation",), str(found)
    assert found.extended.parameters["modulation.value"] == pytest.approx(0.5, abs=0.01)
    assert found.extended.model.parameter("modulation.value").unit == "1/m"


@of_a_carriage
def test_constants_that_are_right_are_excluded_above_a_size():
    found = diagnosed(carriage(), carriage_plant(PUSH, PERIOD)[:, 0], seed=4)
    assert found.verdict == "adequate", str(found)
    excluded = {e.cause: e.above for e in found.excluded}
    assert excluded["stiffness"] < 0.01 and excluded["modulation"] < 0.1


@pytest.mark.xdist_group("diagnoses of the servovalve")
def test_a_stiffness_given_at_half_of_what_it_is_is_found_from_the_position_alone():
    command = held_levels(1, 6e-3, 10, 200)
    position = servovalve_plant(command, 1e-3, stiffness=2e4).position
    position = position + 1e-4 * np.random.default_rng(1001).standard_normal(len(command))
    record = ehsvjax.Record(1e-3 * np.arange(len(command)), {"command": command}, {"position": position})
    fit = ehsvjax.identify(
        ehsvjax.servovalve(), record, key=KEY, population=50, generations=20, bounds={"flow_gain": (3e-5, 5e-4)}
    )
    found = diagnose(fit, record, key=KEY)
    # The position shows the load's pressure over the supply's alone: twice the stiffness is half of area or supply.
    assert "stiffness" in found.suspected, str(found)
    assert found.names[0] in ("stiffness", "piston_area", "supply_pressure"), str(found)
    assert len(found.names) == 1 and found.innocent
