"""Refits of curves that can be drawn by hand: what a race gives up, and what it does not."""

from types import SimpleNamespace

import numpy as np
import pytest

from ehsvjax.diagnosis.bench.noise import plain_noise
from ehsvjax.diagnosis.bench.refits import refit
from ehsvjax.diagnosis.bench.workbench import Workbench

READING, AT_THE_READING = 5.0, 0.1 * (1.0 + 4.0 / 30.0)
FIRST, LAST = ((np.arange(1000) == k)[None, :, None] for k in (0, 999))


class Bent(Workbench):
    """A bench of one unknown: the last reading is 10 p up to a kink at 0.1, and thirty times as steep beyond.

    From the flat side every step of Gauss and Newton goes far too far. All other readings are known.
    """

    def __init__(self):
        readings = SimpleNamespace(outputs=np.where(LAST, READING, 0.0))
        for name, value in {
            "candidates": (),
            "nominal": np.zeros(1),
            "problem": SimpleNamespace(samples=readings, substeps=1),
        }.items():
            object.__setattr__(self, name, value)

    def simulated(self, points, added=None, substeps=None):
        x = 10.0 * points[:, 0]
        return LAST * np.where(x < 1.0, x, 1.0 + 30.0 * (x - 1.0))[:, None, None, None]

    def linearised(self, points, chosen):
        slope = np.where(points[:, 0] < 0.1, 10.0, 300.0)
        return self.simulated(points), LAST * slope[None, :, None, None, None]


@pytest.mark.parametrize("race", [True, False])
def test_a_start_that_a_kink_holds_up_is_not_given_up_beside_the_best(race):
    noise = plain_noise(np.ones(1), np.ones(LAST.shape, bool))
    found = refit(Bent(), np.array([[0.0], [AT_THE_READING]]), np.zeros((2, 1), int), noise, race=race)
    assert found.cost == pytest.approx([0.0, 0.0], abs=1e-6)
    assert found.points[:, 0] == pytest.approx([AT_THE_READING, AT_THE_READING])


class Watched(Bent):
    """The same bench, which remembers where it was asked for derivatives."""

    def __init__(self):
        super().__init__()
        object.__setattr__(self, "asked", [])

    def linearised(self, points, chosen):
        self.asked.append(float(points[0, 0]))
        return super().linearised(points, chosen)


def test_a_step_that_failed_is_at_least_halved_however_little_was_damped():
    bench, noise = Watched(), plain_noise(np.ones(1), np.ones(LAST.shape, bool))
    # Good steps along the flat side first: they leave the next one all but undamped.
    refit(bench, np.array([[-1e6]]), np.zeros((1, 1), int), noise)
    cost = [(READING - bench.simulated(np.array([[x]]))[0, 0, 999, 0]) ** 2 for x in bench.asked]
    best, failed = 0, 0
    for k in range(1, len(cost)):
        if cost[k] < cost[best]:
            best = k
        elif k + 1 < len(cost) and best < k:
            failed += 1
            assert abs(bench.asked[k + 1] - bench.asked[best]) <= 0.501 * abs(bench.asked[k] - bench.asked[best])
    assert failed >= 3


class Folded(Workbench):
    """A bench of two unknowns: one reading has its least where they are alike, and a fold there, one their sum."""

    def __init__(self):
        readings = SimpleNamespace(outputs=np.where(LAST, 2.0, 0.0) - np.where(FIRST, READING, 0.0))
        for name, value in {
            "candidates": (),
            "nominal": np.zeros(2),
            "problem": SimpleNamespace(samples=readings, substeps=1),
        }.items():
            object.__setattr__(self, name, value)

    def simulated(self, points, added=None, substeps=None):
        apart, both = points[:, 0] - points[:, 1], points.sum(axis=1)
        return FIRST * 300.0 * np.abs(apart)[:, None, None, None] + LAST * both[:, None, None, None]

    def linearised(self, points, chosen):
        side = np.where(points[:, 0] > points[:, 1], 300.0, -300.0)[:, None, None, None]
        return self.simulated(points), np.stack([FIRST * side + LAST, LAST - FIRST * side])


def test_a_fold_is_followed_to_its_end():
    """Every step towards one side fails until it is so short that it gains nothing: that is no minimum."""
    noise = plain_noise(np.ones(1), np.ones(LAST.shape, bool))
    found = refit(Folded(), np.array([[0.2, 0.2]]), np.array([[0, 1]]), noise)
    assert found.points[0] == pytest.approx([1.0, 1.0], abs=1e-2)
    assert found.cost[0] == pytest.approx(READING**2, rel=1e-2)
