"""What is left of a model that is shaken, on an integrator of its own: a ball on a beam, which nothing holds."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2

import ehsvjax
from ehsvjax.diagnosis.bench.discrepancy import Disturbances, kinds_of
from ehsvjax.diagnosis.bench.noise import plain_noise
from ehsvjax.diagnosis.bench.parts import Parts
from ehsvjax.diagnosis.decision.verdict import PROCESS_NOISE, UNKNOWN
from tests.small_models import ball, shaken_ball

pytestmark = pytest.mark.xdist_group("diagnoses of a ball")
PERIOD, SAMPLES, NOISE = 0.1, 336, 5e-4
CHANCE = {PROCESS_NOISE, UNKNOWN}


def rolled(force):
    """Return where an undamped ball rolls under a force that is held from sample to sample: a closed form."""
    return lfilter([0.0, PERIOD**2 / 2.0, PERIOD**2 / 2.0], [1.0, -2.0, 1.0], force)


def outside(known, series):
    basis = np.linalg.qr(known.T)[0]
    return series - basis @ (basis.T @ series)


def test_what_a_random_force_moves_counts_by_what_it_gives_where_the_unknowns_left_nothing_of_it():
    """Gains of directions that have no part in what is left are as large as chance makes them, and no larger."""
    rng = np.random.default_rng(0)
    time, count = PERIOD * np.arange(SAMPLES), SAMPLES // 16
    of_sample = np.arange(SAMPLES) // 16
    responses = np.stack([rolled((of_sample == k).astype(float)) for k in range(count)])
    parts = Parts("force", of_sample[None], np.zeros(count, int), 16 * PERIOD, responses[:, None, :, None])
    measured = np.ones((1, SAMPLES, 1), bool)
    gains = {"noise alone": [], "and disturbances": []}
    for _ in range(60):
        angle = np.repeat(rng.uniform(-0.1, 0.1, SAMPLES // 16), 16)
        known = np.stack([np.ones(SAMPLES), time, rolled(5.0 * angle)])
        left = outside(known, rolled(rng.normal(0.0, 0.04, SAMPLES)) + rng.normal(0.0, NOISE, SAMPLES))
        noises = {"noise alone": plain_noise(np.array([NOISE**2]), measured)}
        disturbances = Disturbances(kinds_of([parts], 1), known[:, None, :, None])
        noises["and disturbances"] = replace(noises["noise alone"], disturbances=disturbances)
        for force in (np.ones(SAMPLES), rolled(angle), np.sign(angle), np.sin(time / 2.0), np.abs(rolled(angle))):
            direction = outside(known, rolled(force))
            best = left - direction * (direction @ left) / (direction @ direction)
            for name, noise in noises.items():
                gains[name].append(noise.gained(left[None, :, None], best[None, :, None]))
    share = {name: np.mean(np.array(found) > chi2.isf(0.01, 1)) for name, found in gains.items()}
    # Where most is left in a few slow directions, parts of the record cannot tell how it differs between them.
    assert share["noise alone"] > 0.2, share
    assert share["and disturbances"] < 0.025, share
    assert 0.2 < np.mean(gains["and disturbances"]) < 1.5, gains


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
    assert {cause.name for cause in diagnosis.causes} <= CHANCE, diagnosis
    assert {name for group in diagnosis.alternatives for name in group.causes} <= CHANCE, diagnosis
    assert diagnosis.verdict != "adequate"


def test_a_cause_is_named_beside_a_random_force():
    diagnosis = diagnosed(7, 1e-5, samples=672, stiffness=0.5)
    spring, chance = diagnosis.causes
    assert (spring.name, chance.name) == ("linear_stiffness", PROCESS_NOISE)
    assert spring.probability > 0.99
    (size,) = spring.sizes
    assert abs(size.value - 0.5) < 4.0 * size.standard_error < 0.1
    assert chance.sizes[0].value == pytest.approx(1e-5, rel=0.4)
