"""The Cramér-Rao bound against sensitivities of independent plants by finite differences."""

import jax
import numpy as np
import pytest

import ehsvjax
from ehsvjax import excitation
from tests import plants

PERIOD, SAMPLES = 0.05, 200
COMMAND = np.repeat(np.random.default_rng(8).uniform(-2, 2, SAMPLES // 20), 20)
OSCILLATOR = ehsvjax.Record(np.arange(SAMPLES) * PERIOD, {"command": COMMAND}, {"position": np.cos(np.arange(SAMPLES))})


def _bound_by_differences(simulate, point, noise_variance, count):
    """Square roots of the inverse information's diagonal, of the first `count` unknowns."""
    columns = []
    for i, value in enumerate(point):
        step = 1e-4 * max(abs(value), 0.1)
        above, below = (simulate([*point[:i], value + s, *point[i + 1 :]]) for s in (step, -step))
        columns.append((above - below) / (2.0 * step))
    jacobian = np.stack(columns, axis=1)
    return np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian / noise_variance)))[:count]


def _oscillate(values):
    return plants.van_der_pol_plant(COMMAND, PERIOD, *values[:2], tuple(values[2:]))[:, 0]


@pytest.mark.parametrize("estimated", [True, False])
def test_oscillator(estimated):
    point = [0.96, 1.23, 0.4, -0.3]
    start = dict(zip(("initial_position", "initial_velocity"), point[2:], strict=True))
    bound = ehsvjax.cramer_rao_bound(
        ehsvjax.van_der_pol(),
        OSCILLATOR,
        noise_variance={"position": 0.05},
        initial_values=start,
        initial="estimate" if estimated else start,
    )
    # What is known about the start is not paid for.
    simulate = _oscillate if estimated else lambda values: _oscillate([*values, *point[2:]])
    expected = _bound_by_differences(simulate, point if estimated else point[:2], 0.05, 2)
    np.testing.assert_allclose(list(bound.values()), expected, rtol=2e-3)
    assert list(bound) == ["alpha", "gamma"]


def test_servovalve_at_values_that_are_not_nominal():
    period = 1e-3
    command = excitation.pseudo_random_signal(
        jax.random.key(6), amplitude=6e-3, hold_time=0.1, duration=0.8, sample_period=period
    )
    names = ("flow_gain", "feedback_gain", "natural_frequency")
    values = {"flow_gain": 1.6e-4, "feedback_gain": 0.08, "natural_frequency": 250.0}
    record = ehsvjax.Record(np.arange(len(command)) * period, {"command": command}, {"position": np.sin(command)})
    model = ehsvjax.servovalve().with_bounds(fixed={"dead_zone": 1e-4, "saturation": 3e-3, "damping_ratio": 0.72})
    bound = ehsvjax.cramer_rao_bound(
        model, record, noise_variance={"position": 1e-8}, parameters=values, initial="nominal"
    )

    def simulate(logarithms):
        changed = dict(zip(names, np.exp(logarithms), strict=True))
        return plants.servovalve_plant(command, period, **changed).position

    relative = _bound_by_differences(simulate, [float(np.log(values[name])) for name in names], 1e-8, 3)
    for name, expected in zip(names, relative, strict=True):
        # The plant's own tolerance and the kinks of dead zone and saturation leave a per cent.
        assert bound[name] / values[name] == pytest.approx(expected, rel=0.03)


def test_bound_scales_with_the_noise_and_with_what_is_measured():
    model = ehsvjax.van_der_pol()
    bound, louder = (
        ehsvjax.cramer_rao_bound(model, OSCILLATOR, noise_variance={"position": variance}) for variance in (0.05, 0.2)
    )
    for name in bound:
        assert louder[name] == pytest.approx(2.0 * bound[name])
    output = np.array(OSCILLATOR.outputs["position"])
    output[50:] = np.nan
    part = ehsvjax.Record(OSCILLATOR.time, OSCILLATOR.inputs, {"position": output})
    fewer = ehsvjax.cramer_rao_bound(model, part, noise_variance={"position": 0.05})
    short = ehsvjax.cramer_rao_bound(model, OSCILLATOR.slice(0.0, 49.5 * PERIOD), noise_variance={"position": 0.05})
    for name in bound:
        assert fewer[name] > bound[name]
        assert fewer[name] == pytest.approx(short[name])


def test_what_a_record_does_not_fix_has_no_bound():
    # In the forward reading only products and ratios of four parameters show in the position.
    command = excitation.pseudo_random_signal(
        jax.random.key(6), amplitude=0.05, hold_time=0.2, duration=1.0, sample_period=1e-3
    )
    record = ehsvjax.Record(np.arange(len(command)) * 1e-3, {"command": command}, {"position": np.sin(command)})
    model = ehsvjax.servovalve(transfer_function="forward")
    bound = ehsvjax.cramer_rao_bound(model, record, noise_variance={"position": 1e-8}, initial="nominal")
    assert all(np.isinf(bound[name]) for name in ("dead_zone", "saturation", "flow_gain", "feedback_gain"))
    assert np.isfinite(bound["natural_frequency"])


def test_refusals():
    with pytest.raises(
        ValueError, match="expected noise_variance of outputs of Van der Pol oscillator, position; got .speed"
    ):
        ehsvjax.cramer_rao_bound(ehsvjax.van_der_pol(), OSCILLATOR, noise_variance={"speed": 1.0})
    record = ehsvjax.Record(OSCILLATOR.time, {}, OSCILLATOR.outputs)
    with pytest.raises(ValueError, match="it lacks command"):
        ehsvjax.cramer_rao_bound(ehsvjax.van_der_pol(), record, noise_variance={"position": 1.0})
