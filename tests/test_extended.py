"""Extended models: their time, and what several effects remember."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import ehsvjax
from ehsvjax import Effect
from ehsvjax.effects import BANK, amplitude, attach
from ehsvjax.population import cast, simulated, to_unit
from ehsvjax.unknowns import problem_of
from tests.hand_made import amplifier
from tests.small_models import DAMPING, MASS, STIFFNESS, carriage


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


def test_a_force_that_depends_on_time_is_right_to_second_order_of_the_step():
    period, count, frequency, force = 0.02, 400, 6.0, 5.0
    model = attach(
        carriage(max_step=period),
        {"harmonic_force.cosine": (0, 10), "harmonic_force.sine": (0, 10), "harmonic_force.frequency": (1, 20)},
        duration=count * period,
        bank=BANK,
    )
    record = ehsvjax.Record(period * np.arange(count), {"push": np.zeros(count)})
    values = {"harmonic_force.cosine": force, "harmonic_force.sine": 0.0, "harmonic_force.frequency": frequency}
    found = ehsvjax.simulate(model, record, {"damping": DAMPING} | values)["position"]

    def rates(t, y):
        return y[1], (force * np.cos(frequency * t) - DAMPING * y[1] - STIFFNESS * y[0]) / MASS

    truth = solve_ivp(rates, (0.0, record.time[-1]), (0.0, 0.0), t_eval=record.time, rtol=1e-10, atol=1e-12).y[0]
    # Held from the start of each step it would be late by half a step: 0.06 rad.
    assert np.max(np.abs(found - truth)) < 3e-3 * np.max(np.abs(truth))


def test_a_sensor_that_lags_is_shown_what_a_further_extension_knows_of_the_inputs():
    # The fit that a diagnosis extended by a lag could not be diagnosed.
    count, period, push, gain = 200, 0.02, 3.0, 1e-3
    record = ehsvjax.Record(period * np.arange(count), {"push": np.full(count, push)})
    duration = count * period
    lagging = attach(carriage(), {"sensor_lag@position.time_constant": (0.0, 1.0)}, duration=duration, bank=BANK)
    both = attach(lagging, {"feedthrough_of_push@position.gain": (-1.0, 1.0)}, duration=duration, bank=BANK)
    lag = {"sensor_lag@position.time_constant": 0.1}
    shown = ehsvjax.simulate(both, record, lag | {"feedthrough_of_push@position.gain": gain})["position"]
    without = ehsvjax.simulate(lagging, record, lag)["position"]
    # A lag of what is constant is what it is, once it has settled.
    np.testing.assert_allclose((shown - without)[-50:], gain * push, rtol=1e-9)
