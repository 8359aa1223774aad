"""A record in short parts: what a small disturbance over each of them does, and so any disturbance by sums of them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.diagnose.workbench import Workbench

_PARTS = 200
_LEAST_SAMPLES = 10


class Parts(NamedTuple):
    """What disturbances at one signal do to the outputs, to first order.

    Attributes:
        place: the signal.
        of_sample: `[time]` the part in which each sample lies.
        length: of a part, s.
        responses: `[part, record, time, signal]` by unit of the disturbance.

    """

    place: str
    of_sample: np.ndarray
    length: float
    responses: Float[np.ndarray, "part record time signal"]

    def means(self, series: Float[np.ndarray, "*batch time"]) -> Float[np.ndarray, "*batch part"]:
        """Return the means of a series over the parts."""
        first = np.searchsorted(self.of_sample, np.arange(len(self.responses)))
        return np.add.reduceat(series, first, axis=-1) / np.bincount(self.of_sample)


def parts_at(bench: Workbench, point: Float[np.ndarray, " parameter"], place: str) -> Parts:
    """Simulate a small disturbance over each part of the record at one of the workbench's places."""
    shape = bench.problem.samples.outputs.shape
    count = min(_PARTS, shape[1] // _LEAST_SAMPLES)
    part = np.arange(shape[1]) * count // shape[1]
    added = np.zeros((count + 1, *shape[:2], len(bench.places)))
    for k in range(count):
        added[k + 1, :, part == k, bench.places.index(place)] = count * bench.probes[place]
    outputs = bench.sketched(np.repeat(point[None], count + 1, axis=0), added)
    length = shape[1] / count * float(bench.problem.samples.sample_period[0])
    return Parts(place, part, length, (outputs[1:] - outputs[0]) / (count * bench.probes[place]))
