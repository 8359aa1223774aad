"""Readings as a sensor gives them: those that stand alone, those on a lattice."""

import numpy as np
from jaxtyping import Bool, Float

# A sample stands alone if it differs from its neighbours by this many deviations of a difference.
_SPIKE = 4.0


def spikes(
    residual: Float[np.ndarray, "record time signal"],
    measured: Bool[np.ndarray, "record time signal"],
    outputs: Float[np.ndarray, "record time signal"],
) -> Bool[np.ndarray, "record time signal"]:
    """Return samples that stand alone, on one side of nearly all their neighbours, residual and reading alike.

    A misfit of a jump stands alone in the residual, but not in the reading: it is no spike. One neighbour may be a
    spike itself.
    """
    found = np.zeros_like(measured)
    for i in range(residual.shape[-1]):
        differences = np.diff(residual[..., i], axis=1)[measured[:, 1:, i] & measured[:, :-1, i]]
        spread = 1.4826 * np.median(np.abs(differences - np.median(differences))) if len(differences) else 0.0
        if spread == 0.0:
            continue
        seen = (np.where(measured[..., i], series[..., i], np.nan) for series in (residual, outputs))
        apart = _SPIKE * spread
        alone = [standing_out(series, apart) | standing_out(-series, apart) for series in seen]
        found[..., i] = alone[0] & alone[1] & measured[..., i]
    return found


def standing_out(series: Float[np.ndarray, "record time"], apart: float) -> Bool[np.ndarray, "record time"]:
    """Return samples that lie further than this above all but one of the three before and the three after.

    At an end of the record, and beside what is missing, there are fewer.
    """
    reach = 3
    filled = np.pad(series, ((0, 0), (reach, reach)), constant_values=np.nan)
    length = series.shape[1]
    neighbours = np.stack([filled[:, k : k + length] for k in range(2 * reach + 1) if k != reach])
    needed = np.maximum(np.sum(np.isfinite(neighbours), axis=0) - 1, 2)
    return np.sum(series - neighbours > apart, axis=0) >= needed


def lattice(values: Float[np.ndarray, " time"]) -> float | None:
    """Return the step of the lattice on which readings lie, in their unit; None if they lie on none that shows.

    Every difference of two readings is a multiple of the step, to a thousandth of it.
    """
    levels = np.unique(values[np.isfinite(values)])
    if len(levels) < 3 or len(levels) > 0.5 * len(values):
        return None
    gaps = np.diff(levels)
    step = float(np.min(gaps))
    if step <= 1e-9 * float(np.ptp(levels)):
        return None
    multiples = gaps / step
    step = float(np.sum(gaps) / np.sum(np.round(multiples)))
    off = np.abs(gaps / step - np.round(gaps / step))
    return step if np.max(off) < min(1e-3 * np.max(multiples) + 1e-3, 0.05) else None
