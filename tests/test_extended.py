"""Extended models: their time, and what several effects remember."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ehsvjax
from ehsvjax import Effect
from ehsvjax.effects import BANK, amplitude, attach
from ehsvjax.population import cast, simulated, to_unit
from ehsvjax.unknowns import problem_of
from tests.hand_made import amplifier


def outputs_at(model, record, values, dtype):
    """Return the force at values of the free parameters, simulated in a precision as a population is."""
    problem = problem_of(model, [record], initial="nominal")
    individual = to_unit(problem.coordinates, np.array([values[name] for name in problem.free]))
    with jax.enable_x64(True):
        return np.asarray(simulated(cast(problem, dtype), jnp.asarray(individual, dtype)))[0, :, 0]


def test_time_is_right_in_single_precision_after_minutes():
    count, period = 400_000, 1e-3
    time = period * np.arange(count)
    model = replace(amplifier(), max_step=period)
    model = attach(model, {"sensor_drift@force.drift": (-1e4, 1e4)}, duration=count * period, bank=BANK)
    record = ehsvjax.Record(time, {"command": np.zeros(count)}, {"force": time})
    # As many newtons as seconds.
    values = {"gain": 1.0, "sensor_drift@force.drift": count * period}
    found = outputs_at(model, record, values, jnp.float32)
    np.testing.assert_allclose(found[1:], time[1:], rtol=1e-5)
    assert found[0] == pytest.approx(0.0, abs=1e-6)


def test_time_goes_on_within_a_sample():
    # A drift of 0.1 s in ten steps for every sample.
    count, period = 50, 0.1
    model = replace(amplifier(), max_step=0.1 * period)
    model = attach(model, {"sensor_drift@force.drift": (-10.0, 10.0)}, duration=count * period, bank=BANK)
    record = ehsvjax.Record(period * np.arange(count), {"command": np.zeros(count)})
    found = ehsvjax.simulate(model, record, {"sensor_drift@force.drift": 5.0})["force"]
    np.testing.assert_allclose(found, record.time, atol=1e-12)


def counting(number, step):
    """Return a form of an effect that adds to a sensor's value what it has counted, in steps of its own."""

    def apply(own, value, context, memory):
        del context
        return value + own[number] * memory[0], (memory[0] + step,)

    return Effect("count", "sensor", (amplitude(number, "N", lambda s: 1.0),), apply, memory=(0.0,))


def test_two_forms_of_one_effect_remember_each_for_itself():
    record = ehsvjax.Record(np.arange(20.0), {"command": np.zeros(20)})
    bounds = {"count@force.slow": (-10.0, 10.0), "count@force.fast": (-10.0, 10.0)}
    model = attach(amplifier(), bounds, duration=20.0, bank=(counting("slow", 1.0), counting("fast", 10.0)))

    def force(slow, fast):
        values = {"count@force.slow": slow, "count@force.fast": fast}
        return ehsvjax.simulate(model, record, values)["force"]

    alone, other, together = force(1.0, 0.0), force(0.0, 1.0), force(1.0, 1.0)
    # Each has counted the steps: the fast one ten for the slow one's one.
    np.testing.assert_allclose(np.diff(alone), 1.0)
    np.testing.assert_allclose(other, 10.0 * alone)
    np.testing.assert_allclose(together, alone + other)
