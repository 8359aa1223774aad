"""Refits of curves that can be drawn by hand: what a race gives up, and what it does not."""

from types import SimpleNamespace

import numpy as np
import pytest

from ehsvjax.diagnosis.bench.noise import plain_noise
from ehsvjax.diagnosis.bench.refits import refit
from ehsvjax.diagnosis.bench.workbench import Workbench

READING, AT_THE_READING = 5.0, 0.1 * (1.0 + 4.0 / 30.0)
LAST = (np.arange(1000) == 999)[None, :, None]


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
