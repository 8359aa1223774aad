"""A random force, alone and beside a cause, on an integrator of its own: a ball on a beam, which nothing holds."""

import jax
import numpy as np
import pytest

import ehsvjax
from ehsvjax.diagnosis.decision.verdict import PROCESS_NOISE, UNKNOWN
from ehsvjax.effects import BANK
from tests.hidden_records import Hidden, records
from tests.small_models import ball, carriage, one_way_plant, shaken_ball, wandering

pytestmark = pytest.mark.xdist_group("diagnoses of a ball")
PERIOD, SAMPLES, NOISE = 0.1, 336, 5e-4
CHANCE = {PROCESS_NOISE, UNKNOWN}


def diagnosed(seed, density, samples=SAMPLES, **plant):
    rng = np.random.default_rng(seed)
    angle = np.repeat(rng.uniform(-0.05, 0.05, samples // 8), 8)
    position = shaken_ball(angle, PERIOD, density, rng, **plant) + rng.normal(0.0, NOISE, len(angle))
    record = ehsvjax.Record(PERIOD * np.arange(len(angle)), {"angle": angle}, {"position": position})
    fit = ehsvjax.identify(ball(), record, key=jax.random.key(0))
    return ehsvjax.diagnose(fit, record, key=jax.random.key(1))


@pytest.mark.thorough
def test_a_random_force_on_what_nothing_holds_is_chance_and_no_cause():
    """Of many, see benchmarks/shaken.py."""
    diagnosis = diagnosed(0, 1.6e-4)
    assert diagnosis.suspected <= CHANCE, diagnosis
    assert diagnosis.verdict != "adequate"


@pytest.mark.thorough
def test_beside_a_random_force_only_what_gains_beside_it_is_a_cause():
    """A bias of the input was named for what the force had moved."""
    diagnosis = diagnosed(59182745, 5.7e-5, stiffness=0.1036)
    assert {c.name for c in diagnosis.causes} - CHANCE == {"linear_stiffness"}, diagnosis
    assert diagnosis.suspected <= {"linear_stiffness", *CHANCE}, diagnosis
    assert PROCESS_NOISE in diagnosis.suspected


@pytest.mark.parametrize(
    ("seed", "density"),
    [
        (471920975, 2.221569789754284e-05),
        pytest.param(1922185331, 5.466243701559712e-05, marks=pytest.mark.thorough),
    ],
)
def test_what_chance_explains_better_is_named_after_it(seed, density):
    """A spring, 16%, came before chance, 80%; and a damping that nothing needed, once the spring was left out."""
    diagnosis = diagnosed(seed, density)
    assert [cause.name for cause in diagnosis.causes] == [PROCESS_NOISE], diagnosis
    (group,) = diagnosis.alternatives
    assert group.causes[:2] == (PROCESS_NOISE, UNKNOWN)
    assert list(group.probabilities[2:]) == sorted(group.probabilities[2:], reverse=True)
    assert sum(group.probabilities) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.thorough
def test_causes_that_leave_something_and_predict_worse_are_not_named():
    """A spring and a constant force, by whose model the held-back data came out worse by a third."""
    diagnosis = diagnosed(1568853910, 2.8866660624402016e-05)
    assert diagnosis.suspected == CHANCE, diagnosis


def test_a_cause_is_named_beside_a_random_force():
    diagnosis = diagnosed(7, 1e-5, samples=672, stiffness=0.5)
    spring, chance = diagnosis.causes
    assert (spring.name, chance.name) == ("linear_stiffness", PROCESS_NOISE)
    assert spring.probability > 0.99
    (size,) = spring.sizes
    assert abs(size.value - 0.5) < 4.0 * size.standard_error < 0.1
    assert chance.sizes[0].value == pytest.approx(1e-5, rel=0.4)


def test_a_weak_force_on_an_oscillator_is_no_periodic_one():
    """An oscillator's unknowns take up most of what shakes it: what is left was named a periodic stiffness."""
    (made,) = records([Hidden("van_der_pol", "white", 0.05, ("process_noise",), 1626778172)])
    record = ehsvjax.Record(made.time, {"command": made.command}, {"position": made.position})
    fit = ehsvjax.identify(ehsvjax.van_der_pol(), record, key=jax.random.key(0), population=100, generations=50)
    diagnosis = ehsvjax.diagnose(fit, record, key=jax.random.key(1))
    assert PROCESS_NOISE in diagnosis.suspected, diagnosis


def test_a_damper_that_is_stiffer_one_way_is_no_random_force():
    """Not in a bank without: drawn along a motion that is 5% off, the term alone leaves a trace, and chance nothing."""
    rng = np.random.default_rng(2)
    push = wandering(rng, 1500, 8.0)
    position = one_way_plant(push, 0.02, back=1.5, forth=4.5) + rng.normal(0.0, 2e-4, len(push))
    record = ehsvjax.Record(0.02 * np.arange(len(push)), {"push": push}, {"position": position})
    model = carriage().with_bounds({"stiffness": (10.0, 100.0)})
    fit = ehsvjax.identify(model, record, key=jax.random.key(0), population=50, generations=20)
    without = [effect for effect in BANK if effect.name != "one_way_damping"]
    diagnosis = ehsvjax.diagnose(fit, record, key=jax.random.key(1), bank=without)
    assert PROCESS_NOISE not in diagnosis.suspected, diagnosis
    assert (diagnosis.missing.place, diagnosis.missing.quantity) == ("force", "velocity"), diagnosis
    assert diagnosis.missing.explained > 0.9
