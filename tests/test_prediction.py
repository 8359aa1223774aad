"""What is judged on data that were not used: a cause that does not predict is not named."""

import jax
import numpy as np
import pytest

import ehsvjax
from ehsvjax.diagnose.noise import plain_noise
from ehsvjax.diagnose.prediction import _doubt
from tests.small_models import carriage, carriage_plant

PERIOD, SAMPLES = 0.02, 1500
KEY = jax.random.key(0)


def shaken(until):
    """A record of a carriage that a periodic force shakes until some share of the time, and not any more after it."""
    rng = np.random.default_rng(3)
    time = PERIOD * np.arange(SAMPLES)
    push = np.repeat(rng.uniform(-10.0, 10.0, SAMPLES // 20), 20)
    force = 0.3 * np.sin(6.0 * time) * (time < until * time[-1])
    position = carriage_plant(push + force, PERIOD)[:, 0] + 0.005 * rng.standard_normal(SAMPLES)
    return ehsvjax.Record(time, {"push": push}, {"position": position})


@pytest.mark.parametrize(("until", "named"), [(1.1, True), (0.65, False)])
def test_a_periodic_force_is_named_only_if_it_goes_on(until, named):
    record = shaken(until)
    fit = ehsvjax.identify(carriage(), record, key=KEY, population=20, generations=5)
    found = ehsvjax.diagnose(fit, record, key=KEY)
    suspected = {*found.causes, *(name for a in found.alternatives for name in a.causes)}
    assert ("harmonic_force" in suspected) == named, str(found)
    gain = found.gain.outputs["position"]
    assert gain.rmse_after <= gain.rmse_before


def test_what_a_prediction_does_not_know_is_what_its_parameters_errors_do_to_it():
    slopes = np.random.default_rng(1).standard_normal((3, 1, 100, 1))
    slopes[2] *= 1e-6
    every = np.ones((1, 100, 1), bool)
    used = every & (np.arange(100) < 70)[:, None]
    noise = plain_noise(np.array([0.25]), every)
    found = _doubt(slopes, noise, used, noise._replace(measured=~used))
    known, ahead = np.split(slopes[:, 0, :, 0] / 0.5, [70], axis=1)
    np.testing.assert_allclose(found.T @ found, ahead.T @ np.linalg.inv(known @ known.T) @ ahead, rtol=1e-6)


def test_what_some_readings_do_not_tell_is_in_doubt_and_contradicts_nothing():
    """A bend that is in the later readings alone: what is predicted of them from the others says nothing of it."""
    time = np.linspace(0.0, 1.0, 200)
    late = np.where(time > 0.7, time - 0.7, 0.0)
    slopes = np.stack([time, late])[:, None, :, None]
    every = np.ones((1, 200, 1), bool)
    used = every & (time <= 0.7)[:, None]
    unused = plain_noise(np.array([1e-4]), every)._replace(measured=~used)
    doubt = _doubt(slopes, plain_noise(np.array([1e-4]), every), used, unused)
    noise = 0.01 * np.random.default_rng(2).standard_normal(200)
    wrong, right = ((noise + by * late)[None, :, None] for by in (1.0, 0.0))
    assert unused.gained(wrong, right) > 100.0
    assert unused.gained(wrong, right, doubt) < 1.0
