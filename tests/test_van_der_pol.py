"""The Van der Pol oscillator against SciPy at 12 digits, and against what is known of its motion."""

import numpy as np
import pytest

from ehsvjax.models import van_der_pol
from ehsvjax.record import Record
from ehsvjax.simulate import simulate
from tests.plants import held_levels, van_der_pol_plant


def record_of(command, period):
    return Record(period * np.arange(len(command)), {"command": np.asarray(command, dtype=float)})


def staircase(seed, period):
    """Levels in +-2, held 1 s, for 40 s."""
    return held_levels(seed, 2.0, 40, round(1.0 / period))


@pytest.mark.parametrize("period", [0.02, 0.1])
@pytest.mark.parametrize("seed", range(4))
def test_a_forced_record(seed, period):
    command, initial = staircase(seed, period), (0.5, -1.0)
    outputs = simulate(
        van_der_pol(), record_of(command, period), initial={"initial_position": 0.5, "initial_velocity": -1.0}
    )
    expected = van_der_pol_plant(command, period, initial=initial)[:, 0]
    assert np.abs(outputs["position"] - expected).max() < 1e-6


def test_other_parameters():
    command = staircase(0, 0.02)
    outputs = simulate(van_der_pol(), record_of(command, 0.02), {"alpha": 1.3, "gamma": 0.7})
    expected = van_der_pol_plant(command, 0.02, alpha=1.3, gamma=0.7)[:, 0]
    assert np.abs(outputs["position"] - expected).max() < 1e-6


def test_a_weakly_damped_oscillator_has_the_amplitude_2_and_the_period_of_the_linear_one():
    # Averaging: amplitude 2 and angular frequency sqrt(alpha)*(1 - gamma^2/(16 alpha)), for small gamma.
    alpha, gamma = 0.96, 0.05
    outputs = simulate(
        van_der_pol(),
        record_of(np.zeros(10_000), 0.02),
        {"alpha": alpha, "gamma": gamma},
        {"initial_position": 1.9},
    )
    late = outputs["position"][5000:]
    assert np.abs(late).max() == pytest.approx(2.0, abs=2e-3)
    rising = np.flatnonzero((late[:-1] < 0) & (late[1:] >= 0))
    crossings = 0.02 * (rising - late[rising] / (late[rising + 1] - late[rising]))
    expected = 2 * np.pi / np.sqrt(alpha) * (1 + gamma**2 / (16 * alpha))
    assert np.diff(crossings).mean() == pytest.approx(expected, rel=1e-5)


def test_the_limit_cycle_is_reached_from_inside_and_from_outside():
    outputs = [
        simulate(van_der_pol(), record_of(np.zeros(3000), 0.02), initial={"initial_position": start})["position"]
        for start in (0.01, 3.0)
    ]
    for output in outputs:
        assert np.abs(output[1500:]).max() == pytest.approx(2.02, abs=0.02)


def test_rest_is_an_equilibrium():
    np.testing.assert_array_equal(simulate(van_der_pol(), record_of(np.zeros(100), 0.02))["position"], 0.0)


def test_nominal_values_outside_their_bounds_are_refused():
    with pytest.raises(ValueError, match=r"expected the value of gamma inside its bounds \(0.615, 1.845\), got 5.0"):
        van_der_pol(gamma=5.0)
