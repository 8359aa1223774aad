"""What is judged on data that were not used: a cause that does not predict is not named."""

import jax
import numpy as np
import pytest

import ehsvjax
from ehsvjax.diagnosis.bench.evidence import INSEPARABLE
from ehsvjax.diagnosis.bench.noise import plain_noise
from ehsvjax.diagnosis.decision.prediction import Predicted
from tests.hidden_records import Hidden, records
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
    suspected = {*found.names, *(name for a in found.alternatives for name in a.causes)}
    assert ("harmonic_force" in suspected) == named, str(found)
    gain = found.gain.outputs["position"]
    assert gain.rmse_after <= gain.rmse_before


def a_prediction(draws, samples=200, used=140, size=0.0):
    """Fit a line, with and without a parabola of some size, to the first readings of noise, and predict the others.

    Returns what each leaves of all readings, [set, draw, time], and by how much its prediction may be off,
    [set][direction, time]; both by plain linear regression.
    """
    time = np.linspace(0.0, 1.0, samples)
    parabola = time**2
    readings = size * parabola + np.random.default_rng(5).standard_normal((draws, samples))
    left, spreads = [], []
    for columns in (np.stack([time**0, time, parabola], axis=1), np.stack([time**0, time], axis=1)):
        covariance = np.linalg.inv(columns[:used].T @ columns[:used])
        estimate = readings[:, :used] @ columns[:used] @ covariance
        left.append(readings - estimate @ columns.T)
        spreads.append(np.linalg.cholesky(covariance).T @ columns.T)
    return np.array(left), spreads


def as_predicted(left, spreads, draw, used=140):
    measured = np.arange(left.shape[-1])[None, :, None] >= used
    spread = np.zeros((2, 3, *measured.shape))
    for k, own in enumerate(spreads):
        spread[k, : len(own), 0, :, 0] = own
    return Predicted(left[:, draw, None, :, None], spread, plain_noise(np.array([1.0]), measured))


def test_a_true_cause_is_not_contradicted_by_what_its_estimate_leaves_open():
    """A parabola that is barely seen in the first part runs far off in the second: by no more than it may."""
    left, spreads = a_prediction(1000, size=3.0)
    contradicted = []
    for draw in range(left.shape[1]):
        unused = as_predicted(left, spreads, draw)
        contradicted.append((unused.noise.gained(*unused.residual), unused.better(1, unused, 0)))
    plain, known = np.mean(np.array(contradicted) > INSEPARABLE, axis=0)
    assert plain > 0.05 and known < 0.005


def test_a_cause_that_is_not_there_is_contradicted():
    """What the first part shows plainly and the second does not have."""
    left, spreads = a_prediction(200, size=0.0)
    time = np.linspace(0.0, 1.0, left.shape[-1])
    for draw in range(left.shape[1]):
        unused = as_predicted(left - np.array([40.0, 0.0])[:, None, None] * (time**2 - time), spreads, draw)
        assert unused.better(1, unused, 0) > INSEPARABLE


def test_a_delay_that_is_known_too_little_to_predict_by_is_in_the_answer():
    """A swinging oscillator: what its delay leaves open of the phase grows until the end of the record."""
    (made,) = records([Hidden("van_der_pol", "white", 0.01, ("transport_delay",), 1872047817)])
    record = ehsvjax.Record(made.time, {"command": made.command}, {"position": made.position})
    fit = ehsvjax.identify(ehsvjax.van_der_pol(), record, key=KEY, population=100, generations=50)
    found = ehsvjax.diagnose(fit, record, key=KEY)
    assert "transport_delay" in {*found.names, *(name for a in found.alternatives for name in a.causes)}, str(found)


def test_what_the_search_takes_for_significant_earns_its_place():
    """A bias of 4.3 standard deviations, p = 0.0011 of the whole search, was "unexplained"."""
    (made,) = records([Hidden("servovalve", "white", 1e-5, ("asymmetric_dead_zone",), 75656314)])
    record = ehsvjax.Record(made.time, {"command": made.command}, {"position": made.position})
    fit = ehsvjax.identify(ehsvjax.servovalve(), record, key=KEY, population=50, generations=20)
    found = ehsvjax.diagnose(fit, record, key=KEY)
    assert found.verdict != "unexplained", str(found)
    assert "asymmetric_dead_zone" in {*found.names, *(name for a in found.alternatives for name in a.causes)}
