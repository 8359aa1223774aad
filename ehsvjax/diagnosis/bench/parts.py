"""Records in short parts: what a small disturbance over each of them does, and so any disturbance by sums of them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ehsvjax.diagnosis.bench.workbench import Workbench

PARTS = 20
"""Of a record, between which what is left of it may differ."""
# Of a record, for what is quicker.
_FINE = 200
_LEAST_SAMPLES = 2


class Parts(NamedTuple):
    """What disturbances at one signal do to the outputs, to first order.

    Attributes:
        place: the signal.
        of_sample: `[record, time]` the part in which each sample lies, counted on from record to record.
        of_record: `[part]` the record in which each part lies.
        length: of a part, s.
        responses: `[part, record, time, signal]` by unit of the disturbance.

    """

    place: str
    of_sample: Int[np.ndarray, "record time"]
    of_record: Int[np.ndarray, " part"]
    length: float
    responses: Float[np.ndarray, "part record time signal"]

    def means(self, series: Float[np.ndarray, "*batch record time"]) -> Float[np.ndarray, "*batch part"]:
        """Return the means of a series over the parts."""
        inside = self.of_sample >= 0
        which = self.of_sample[inside]
        first = np.searchsorted(which, np.arange(len(self.responses)))
        return np.add.reduceat(series[..., inside], first, axis=-1) / np.bincount(which)


def parts_at(bench: Workbench, point: Float[np.ndarray, " parameter"], place: str) -> Parts:
    """Simulate a small disturbance over each part of the records at one of the workbench's places."""
    lengths = bench.present.sum(axis=1)
    durations = lengths * bench.problem.samples.sample_period
    # As long in every record.
    length = float(np.max(durations / np.minimum(_FINE, lengths // _LEAST_SAMPLES)))
    counts = np.maximum(np.round(durations / length).astype(int), 1)
    within = np.where(bench.present, np.arange(bench.present.shape[1]) * counts[:, None] // lengths[:, None], -1)
    # What acts in one record does nothing in the others: a part of each is simulated at once.
    size = float(counts.max() * bench.probes[place])

    def over_part(k: int) -> Float[np.ndarray, "record time place"]:
        added = np.zeros((*within.shape, len(bench.places)))
        added[within == k, bench.places.index(place)] = size
        return added

    changes = bench.responses(point, int(counts.max()), over_part) / size
    of_record = np.repeat(np.arange(len(counts)), counts)
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    responses = changes
    if len(counts) > 1:
        responses = np.zeros((len(of_record), *changes.shape[1:]))
        for part, record in enumerate(of_record):
            responses[part, record] = changes[part - first[record], record]
    of_sample = np.where(bench.present, within + first[:, None], -1)
    return Parts(place, of_sample, of_record, length, responses)
