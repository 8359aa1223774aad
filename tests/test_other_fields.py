"""Rigs from other fields: the short version of benchmarks/other_fields.py."""

import jax
import numpy as np
import pytest

import ehsvjax
from benchmarks.other_fields import RIGS, answer, faults, hills, vehicle

pytestmark = pytest.mark.xdist_group("diagnoses of a ball")


def diagnosed(rig, seed):
    key = jax.random.key(seed)
    fit = ehsvjax.identify(rig.model, rig.record, key=key, population=60, generations=40)
    return ehsvjax.diagnose(fit, rig.record, key=key)


def test_two_causes_are_found_where_one_alone_is_nearly_like_both():
    """Drag by the third power of the speed and less of a linear one is all but drag by the second and rolling."""
    rig = vehicle(np.random.default_rng(11))
    found = diagnosed(rig, 11)
    assert found.names[0] == "quadratic_damping" and found.causes[0].probability > 0.99, str(found)
    (size,) = found.causes[0].sizes
    assert abs(size.value - 0.45) < 4.0 * size.standard_error < 0.02
    (rolling,) = found.alternatives
    assert {"coulomb_friction", "constant_force", "input_bias"} <= set(rolling.causes) <= rig.said_by, str(found)
    assert found.causes[1].sizes[0].value == pytest.approx(130.0, rel=0.1)
    assert not found.leaves_something


@pytest.mark.thorough
def test_hills_of_a_road_are_no_periodic_force():
    found = diagnosed(hills(np.random.default_rng(11)), 11)
    assert answer(found, frozenset()) == "left open", str(found)


@pytest.mark.thorough
def test_what_takes_half_of_what_is_wrong_may_be_a_part_of_what_the_bank_lacks():
    """A push that fades in fast motion: "sensor_cubic (certain)", and half of it left."""
    rig = faults(np.random.default_rng(1755846791))[-1]
    assert rig.hidden == "the push loses 20% in fast motion"
    found = diagnosed(rig, 1755846791)
    assert found.leaves_something and found.alternatives, str(found)
    assert answer(found, rig.said_by) == "left open", str(found)


def test_every_rig_and_fault_can_be_recorded():
    made = [rig(np.random.default_rng(3)) for rig in RIGS] + faults(np.random.default_rng(3))
    assert len({rig.hidden for rig in made}) == len(made)
    for rig in made:
        rig.record.check(rig.model)
        assert all(np.isfinite(series).all() for series in rig.record.outputs.values()), rig.hidden
