"""What sets of causes predict of data that they were not fitted to: each record from the others, or its own past."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ehsvjax.diagnosis.bench.noise import Noise
from ehsvjax.diagnosis.bench.refits import Refits, padded, refit
from ehsvjax.diagnosis.bench.workbench import Workbench

HELD_BACK = 0.3
"""Share of a single record's readings that is predicted from the others, the last."""


class Predicted(NamedTuple):
    """Data that were not used.

    Attributes:
        residual: `[set, record, time, signal]` measured minus predicted.
        noise: of the model, for the readings that were predicted.

    """

    residual: Float[np.ndarray, "set record time signal"]
    noise: Noise


def predicted(
    bench: Workbench,
    sets: Sequence[Sequence[int]],
    starts: Float[np.ndarray, "set parameter"],
    noise: Noise,
    told: Callable[[Noise], Workbench] | None = None,
) -> Predicted:
    """Refit sets of causes to some of the readings, and return what they leave of the others.

    Of several records each is predicted from the others: it starts as it says itself, and what is of a run no other
    record tells.

    Args:
        bench: the trials' workbench.
        sets: positions of the effects of each.
        starts: of each.
        noise: of what is left.
        told: what the readings of a noise tell of a term that acts besides, as a bench with it; by default none acts.

    """

    def refitted(used: Bool[np.ndarray, "record time signal"]) -> tuple[Workbench, Refits]:
        known = noise._replace(measured=noise.measured & used)
        acting = bench if told is None else told(known)
        return acting, refit(acting, starts, columns, known, race=False)

    own = [bench.columns_with(some) for some in sets]
    columns = padded(own, max(map(len, own)))
    if len(bench.records) == 1:
        counted = np.cumsum(noise.measured[0].sum(axis=-1))
        later = np.zeros_like(noise.measured)
        later[:, int(np.searchsorted(counted, (1.0 - HELD_BACK) * counted[-1])) :] = True
        return Predicted(refitted(~later)[1].residual, noise._replace(measured=noise.measured & later))
    residual = np.empty((len(sets), *noise.measured.shape))
    for k in range(len(bench.records)):
        this = np.zeros_like(noise.measured)
        this[k] = True
        residual[:, k] = _left_out(*refitted(~this), k, noise)[:, k]
    return Predicted(residual, noise)


def _left_out(
    bench: Workbench, others: Refits, record: int, noise: Noise
) -> Float[np.ndarray, "set record time signal"]:
    """Return the residuals of a record that was left out, its initial conditions refitted to it."""
    points = others.points.copy()
    of_record = [j for j, name in enumerate(bench.problem.names) if name.endswith(f"[{record}]")]
    initial = [j for j in of_record if j in bench.base_columns]
    points[:, of_record] = np.where(np.isin(of_record, initial), points[:, of_record], bench.nominal[of_record])
    chosen = padded([initial] * len(points), max(len(initial), 1))
    return refit(bench, points, chosen, noise.of_record(record), race=False).residual
