"""A piston with one rod: two areas, two chambers, each with two orifices of its own, by an independent plant."""

import jax
import numpy as np
import pytest

import ehsvjax
from ehsvjax.diagnosis import diagnose
from tests.plants import held_levels, two_chamber_plant
from tests.small_models import record_of

# One process compiles.
pytestmark = pytest.mark.xdist_group("diagnoses of a cylinder with one rod")
PERIOD, NOISE = 2e-3, {"position": 2e-4, "load_pressure": 5e4}
KEY = jax.random.key(0)


def command(seed):
    return held_levels(seed, 6e-3, 12, 100)


@pytest.mark.parametrize("ratio", [0.6, 1.0, 1.5])
def test_a_piston_with_two_areas_moves_as_one_with_two_chambers_does(ratio):
    # The model's oil is stiff, and so the chambers' jump from one direction to the other takes it no time.
    levels = command(3)
    position, difference = two_chamber_plant(levels, PERIOD, ratio)
    record = record_of(PERIOD, {"command": levels}, {"position": position, "load_pressure": difference}, NOISE, 4)
    found = ehsvjax.simulate(ehsvjax.servovalve(area_ratio=ratio), record)
    assert np.std(found["position"] - position) < 5e-3 * np.std(position)
    assert np.median(np.abs(found["load_pressure"] - difference)) < 1e4
    if ratio != 1.0:
        otherwise = ehsvjax.simulate(ehsvjax.servovalve(), record)
        assert np.std(otherwise["position"] - position) > 0.02 * np.std(position)


def test_two_areas_are_named_where_the_pressures_of_both_chambers_are_measured():
    """They are no constant force with dry friction, which shift the pressure and its step between directions alike."""
    levels, ratio = command(5), 0.7
    position, difference = two_chamber_plant(levels, PERIOD, ratio, bulk=14e9)
    record = record_of(PERIOD, {"command": levels}, {"position": position, "load_pressure": difference}, NOISE, 6)
    fit = ehsvjax.identify(ehsvjax.servovalve(), record, key=KEY, population=50, generations=20)
    found = diagnose(fit, record, key=KEY)
    assert found.names[:1] == ("area_ratio",), str(found)
    assert not {"constant_load", "coulomb_friction", "stribeck_friction"} & set(found.names), str(found)
    assert found.causes[0].probability > 0.99
    assert ratio * 0.98 < 1.0 + found.extended.parameters["area_ratio.error"] < ratio * 1.02


def test_from_the_position_alone_two_areas_may_be_a_constant_force():
    levels = command(7)
    position, _ = two_chamber_plant(levels, PERIOD, 0.7, bulk=14e9)
    record = record_of(PERIOD, {"command": levels}, {"position": position}, NOISE, 8)
    fit = ehsvjax.identify(ehsvjax.servovalve(), record, key=KEY, population=50, generations=20)
    found = diagnose(fit, record, key=KEY)
    assert "area_ratio" in found.suspected, str(found)
    assert found.suspected <= {"area_ratio", "area_asymmetry", "constant_load"}, str(found)
