"""The oracle of hidden effects, against the plants' own records."""

import numpy as np

from tests.hidden_oracle import SEPARABLE, nominal, oracle, random_force
from tests.hidden_records import Hidden, excitation, plant, records


def test_a_random_force_moves_the_plant_as_much_as_the_oracle_says():
    seed, samples, intensity, count = 3, 1000, 1e-5, 100
    command, period = excitation("van_der_pol", seed)
    effects = [{"process_noise": {"intensity": intensity, "seed": float(k)}} for k in range(count)]
    y = plant("van_der_pol", effects, np.tile(command[:samples], (count, 1)), period)
    without = nominal("van_der_pol", seed, samples)
    energy = [float(np.sum(without.outside(row) ** 2)) for row in y]
    expected = intensity * period * np.sum(random_force(seed, samples)[1] ** 2)
    assert abs(np.mean(energy) - expected) < 4.0 * np.std(energy) / count**0.5


def test_a_harmonic_rival_is_looked_for_at_every_frequency():
    # A stiffness that pulsates shakes an oscillation of its own frequency at the sum and the difference of both.
    hidden = Hidden("van_der_pol", "white", 0.01, ("parametric_excitation",), 221289491)
    (made,) = records([hidden])
    found = oracle(hidden, made)
    assert found.rival == "harmonic_force"
    assert found.deficit < SEPARABLE < 0.2 * found.worth
