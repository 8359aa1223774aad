"""Records that disagree: what changed between them is said, with the record, and nothing else is blamed for it."""

import jax
import numpy as np
import pytest

import ehsvjax
from tests.small_models import DAMPING, carriage, carriage_plant, record_of

PERIOD, SAMPLES, KEY = 0.02, 1200, jax.random.key(0)


def run(seed, zero=0.0, **plant):
    """A record of a carriage with these constants, and a sensor whose zero is off."""
    push = np.repeat(np.random.default_rng(seed).uniform(-10.0, 10.0, SAMPLES // 20), 20)
    position = carriage_plant(push, PERIOD, **plant)[:, 0] + zero
    return record_of(PERIOD, {"push": push}, {"position": position}, {"position": 0.002}, seed, f"run {seed}")


def diagnosed(records):
    fit = ehsvjax.identify(carriage(), records, key=KEY, population=20, generations=5)
    return ehsvjax.diagnose(fit, records, key=KEY)


def test_a_constant_that_changed_is_named_with_its_value_in_every_record():
    found = diagnosed([run(1), run(2), run(3, stiffness=46.0)])
    assert found.names == ("change_of_stiffness",), str(found)
    sizes = found.causes[0].sizes
    assert [s.record for s in sizes] == ["run 1", "run 2", "run 3"]
    errors = np.array([s.value for s in sizes])
    # The constant was given as it is in two of them.
    assert errors == pytest.approx([0.0, 0.0, 0.15], abs=0.02)
    assert found.innocent and found.causes[0].of_run
    assert "run 3" in str(found)


def test_a_parameter_that_was_identified_and_changed_is_told():
    found = diagnosed([run(1), run(2, damping=1.5 * DAMPING)])
    assert found.names == ("change_of_damping",), str(found)
    first, second = (1.0 + s.value for s in found.causes[0].sizes)
    assert second / first == pytest.approx(1.5, rel=0.05)
    # What both records have in common the parameter says: beside it each change would be open, with any error.
    assert all(0.0 < s.standard_error < 0.02 for s in found.causes[0].sizes), str(found)


def test_a_zero_that_moved_between_records_is_told():
    found = diagnosed([run(1), run(2, zero=0.02)])
    assert "change_of_zero" in found.suspected, str(found)
    assert found.innocent, str(found)


def test_records_that_agree_are_adequate():
    found = diagnosed([run(1), run(2), run(3)])
    assert found.verdict == "adequate", str(found)
    assert not any(e.cause.startswith("change_of") for e in found.excluded if not np.isfinite(e.above))
