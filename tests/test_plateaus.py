"""A limit that is never reached changes nothing, wherever it is: what lies below is looked for all the same."""

import numpy as np
import pytest

import ehsvjax
from ehsvjax.population import to_unit
from ehsvjax.solve import refine_and_reweigh, values_of
from ehsvjax.unknowns import problem_of
from tests.plants import Valve, held_levels, servovalve_plant

SAMPLES, NOISE = 1500, 1e-4
TIME = 1e-3 * np.arange(SAMPLES)
COMMAND = held_levels(3, 3.6e-3, SAMPLES // 150, 150)


@pytest.mark.parametrize("saturation", [3e-3, 2.5e-3, 6e-3])
def test_a_saturation_is_found_from_where_none_is_reached(saturation):
    """The spool would go beyond the first and the second, and never reaches the third."""
    model = ehsvjax.servovalve()
    position = servovalve_plant(COMMAND, 1e-3, saturation=saturation).position
    noisy = position + NOISE * np.random.default_rng(4).standard_normal(SAMPLES)
    record = ehsvjax.Record(TIME, {"command": COMMAND}, {"position": noisy})
    problem = problem_of(model, [record], initial="nominal", noise_variance={"position": NOISE**2}, huber=None)
    place = problem.free.index("saturation")
    start = np.array([getattr(Valve(), name) for name in problem.free])
    start[place] = model.parameter("saturation").upper
    starts = np.clip(start * np.linspace(0.97, 1.0, 5)[:, None], problem.coordinates.lower, problem.coordinates.upper)

    refined, _, problem = refine_and_reweigh(problem, to_unit(problem.coordinates, starts), reweigh=False)

    best = int(np.argmin(refined.cost))
    assert refined.cost[best] < SAMPLES + 4.0 * (2 * SAMPLES) ** 0.5
    if saturation < 3.5e-3:
        found = values_of(problem, refined.individual[best])[place]
        assert found == pytest.approx(saturation, rel=2e-3)
