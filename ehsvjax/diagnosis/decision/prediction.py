"""What sets of causes predict of data that they were not fitted to: each record from the others, or its own past."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ehsvjax.diagnosis.bench.evidence import INSEPARABLE
from ehsvjax.diagnosis.bench.noise import Noise
from ehsvjax.diagnosis.bench.refits import Refits, padded, refit
from ehsvjax.diagnosis.bench.workbench import Workbench

HELD_BACK = 0.3
"""Share of a single record's readings that is predicted from the others, the last."""


class Predicted(NamedTuple):
    """Data that were not used, and what they say of sets of causes.

    Attributes:
        residual: `[set, record, time, signal]` measured minus predicted.
        refitted: the same of the refits to all.
        noise: of the model, for the readings that were predicted.
        squares: `[set, part]` by how much each record in turn, or the last part of a single one, adds to the sum of
            squares of a refit to all, in variances of the noise.

    """

    residual: Float[np.ndarray, "set record time signal"]
    refitted: Float[np.ndarray, "set record time signal"]
    noise: Noise
    squares: Float[np.ndarray, "set part"]

    def against(self, k: int, j: int, parts: slice = slice(None)) -> float:
        """Return by how much unused data speak against one set and for another, as `Noise.gained` counts.

        The likelihood of all readings is that of those that were used times that of the others, given those: what the
        others tell is what a refit to all gains, less what it gains on those that were used (Dawid 1984, "The
        prequential approach"). An unknown that the used readings leave open is no fault of a prediction.
        """
        lost = float(np.sum((self.squares[k] - self.squares[j])[parts]))
        return self.noise.as_gain(lost, self.refitted[k], self.refitted[j])

    def left_open(self, record: int, k: int) -> bool:
        """Whether a record is predicted worse by the first set than by another, and yet speaks for it."""
        worse = self.noise.of_record(record).gained(self.residual[0], self.residual[k])
        part = min(record, self.squares.shape[1] - 1)
        return worse > INSEPARABLE and self.against(0, k, slice(part, part + 1)) < -INSEPARABLE

    def of(self, some: Sequence[int]) -> "Predicted":
        """Return it for some of the sets."""
        chosen = list(some)
        return self._replace(
            residual=self.residual[chosen], refitted=self.refitted[chosen], squares=self.squares[chosen]
        )


def predicted(
    bench: Workbench,
    sets: Sequence[Sequence[int]],
    refits: Sequence[Refits],
    noise: Noise,
    told: Callable[[Noise], Workbench] | None = None,
) -> Predicted:
    """Refit sets of causes to some of the readings, and return what they leave of the others.

    Of several records each is predicted from the others: it starts as it says itself, and what is of a run no other
    record tells.

    Args:
        bench: the trials' workbench.
        sets: positions of the effects of each.
        refits: of each, to all readings.
        noise: of what is left.
        told: what the readings of a noise tell of a term that acts besides, as a bench with it; by default none acts.

    """
    own = [bench.columns_with(some) for some in sets]
    columns = padded(own)
    points, refitted = (np.concatenate(each) for each in zip(*[(r.points, r.residual) for r in refits], strict=True))
    squares = np.sum(noise.scaled(refitted) ** 2, axis=1)
    residual = np.full_like(refitted, np.nan)
    later = _later(noise.measured)
    added = np.zeros((len(sets), len(later)))
    for k, left_out in enumerate(later):
        known = noise._replace(measured=noise.measured & ~left_out)
        acting = bench if told is None else told(known)
        used = refit(acting, points, columns, known, race=False)
        added[:, k] = squares - used.cost
        left = used.residual if len(later) == 1 else _left_out(acting, used, k, noise)
        residual = np.where(left_out, left, residual)
    unused = noise._replace(measured=noise.measured & np.any(later, axis=0))
    return Predicted(residual, refitted, unused, added)


def _later(measured: Bool[np.ndarray, "record time signal"]) -> list[Bool[np.ndarray, "record time signal"]]:
    """Return which readings are predicted in turn: each record, or the last of a single one."""
    if len(measured) > 1:
        return [
            np.broadcast_to((np.arange(len(measured)) == k)[:, None, None], measured.shape)
            for k in range(len(measured))
        ]
    counted = np.cumsum(measured[0].sum(axis=-1))
    later = np.zeros_like(measured)
    later[:, int(np.searchsorted(counted, (1.0 - HELD_BACK) * counted[-1])) :] = True
    return [later]


def _left_out(
    bench: Workbench, others: Refits, record: int, noise: Noise
) -> Float[np.ndarray, "set record time signal"]:
    """Return the residuals of a record that was left out, its initial conditions refitted to it."""
    points = others.points.copy()
    of_record = [j for j, name in enumerate(bench.problem.names) if name.endswith(f"[{record}]")]
    initial = [j for j in of_record if j in bench.base_columns]
    points[:, of_record] = np.where(np.isin(of_record, initial), points[:, of_record], bench.nominal[of_record])
    chosen = padded([initial] * len(points))
    return refit(bench, points, chosen, noise.of_record(record), race=False).residual
