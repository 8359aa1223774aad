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
        spread: `[set, direction, record, time, signal]` what the readings that were used leave open of the prediction:
            independent directions, each by its standard deviation.
        noise: of the model, for the readings that were predicted.

    """

    residual: Float[np.ndarray, "set record time signal"]
    spread: Float[np.ndarray, "set direction record time signal"]
    noise: Noise

    def better(self, k: int, than: "Predicted", j: int) -> float:
        """Return by how much one set predicts better than a set of another, in variances of what may be left.

        A prediction may be off by what its unknowns are uncertain by, which is no fault of the causes.
        """
        return self.noise.gained(than.residual[j], self.residual[k], [self.spread[k], than.spread[j]])


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
        earlier = refitted(~later)[1]
        spread = _spread(earlier, noise._replace(measured=noise.measured & ~later))
        return Predicted(earlier.residual, spread, noise._replace(measured=noise.measured & later))
    residual = np.empty((len(sets), *noise.measured.shape))
    spread = np.zeros((*columns.shape, *noise.measured.shape))
    for k in range(len(bench.records)):
        this = np.zeros_like(noise.measured)
        this[k] = True
        acting, others = refitted(~this)
        itself = _left_out(acting, others, k, noise)
        residual[:, k] = itself.residual[:, k]
        spread[:, :, k] = _spread(others, noise._replace(measured=noise.measured & ~this), itself)[:, :, k]
    return Predicted(residual, spread, noise)


def _spread(
    used: Refits, noise: Noise, refitted: Refits | None = None
) -> Float[np.ndarray, "set direction record time signal"]:
    """Return by how much predictions may be off, as the readings that were used leave it open.

    Args:
        used: refits to them.
        noise: of them.
        refitted: what was refitted to the readings that are predicted: it follows them.

    """
    found = np.empty_like(used.slopes)
    for k, slopes in enumerate(used.slopes):
        known = noise.scaled(slopes)
        # No less is known of an unknown than its range.
        information = known @ known.T / noise.along(known) + 12.0 * np.eye(len(known))
        found[k] = np.tensordot(np.linalg.inv(np.linalg.cholesky(information)), slopes, 1)
        if refitted is not None:
            own = refitted.slopes[k].reshape(len(refitted.slopes[k]), -1).T
            flat = found[k].reshape(len(found[k]), -1).T
            found[k] = (flat - own @ np.linalg.lstsq(own, flat, rcond=None)[0]).T.reshape(found[k].shape)
    return found


def _left_out(bench: Workbench, others: Refits, record: int, noise: Noise) -> Refits:
    """Return the refits of what a record that was left out has for itself, its initial conditions, to it."""
    points = others.points.copy()
    of_record = [j for j, name in enumerate(bench.problem.names) if name.endswith(f"[{record}]")]
    initial = [j for j in of_record if j in bench.base_columns]
    points[:, of_record] = np.where(np.isin(of_record, initial), points[:, of_record], bench.nominal[of_record])
    chosen = padded([initial] * len(points), max(len(initial), 1))
    return refit(bench, points, chosen, noise.of_record(record), race=False)
