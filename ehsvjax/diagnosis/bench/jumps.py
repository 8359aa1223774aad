"""Readings beside a jump of an output, which no unknown is known well enough to place before or behind it.

A load pressure jumps as the spool leaves its dead zone. Where a reading lies within what the unknowns' own errors make
of that moment, the sum of squares has a step, a refit ends where it happens to stand, and a cause that moves the jump
by a microsecond seems to be there. So where a piston rests, and its friction may be of either sign. Such a reading
carries no weight: along the errors it changes at once, where what is smooth, or has a kink, changes by and by.
"""

import numpy as np
from jaxtyping import Float

from ehsvjax.arithmetic import LEFT_OUT, few
from ehsvjax.diagnosis.bench.noise import Noise
from ehsvjax.diagnosis.bench.refits import Refits
from ehsvjax.diagnosis.bench.workbench import TOLD_APART, Workbench, with_readings
from ehsvjax.readings import standing_out

# Standard errors of the unknowns over which a jump is looked for: of many jumps a third lie beyond one of them. In so
# many steps to either side. And deviations of the noise that a reading may change by at once, or a step smear.
_ERRORS, _STEPS, _AT_ONCE = 3.0, 8, 0.3
# Times as many steps that tell what a jump looks like.
_FINER = 4


def without_jumps(bench: Workbench, current: Refits, noise: Noise) -> Workbench:
    """Return the bench without readings that jump within the errors of a refit; itself if there is none.

    Args:
        bench: the trials' workbench.
        current: one refit.
        noise: of its noise.

    """
    samples, point = bench.problem.samples, current.points[0]
    sides = _errors(bench, current, noise)
    if not len(sides):
        return bench
    deviations = np.sqrt(noise.innovation_variances)[:, None]
    # Steps smear a jump over their length: what comes before the next reading looks smooth, and shorter ones move it.
    ends = np.concatenate([point[None], *(point + both for both in sides)])
    coarse, fine = (bench.simulated(ends, substeps=n * int(bench.problem.substeps)) for n in (1, _FINER))
    at_once = np.fmax.reduce([_change_at_once(bench, point, both, coarse[0]) for both in sides]) / deviations
    smeared = np.max(np.abs(fine - coarse), axis=0) / deviations
    # More than the others: the first reading of a bend that begins is smeared less.
    alone = [standing_out(smeared[..., i], _AT_ONCE) for i in range(smeared.shape[-1])]
    jumping = samples.measured & ((at_once > _AT_ONCE) | np.stack(alone, axis=-1))
    # More than that no jump bends.
    if not jumping.any() or not few(jumping, samples.measured, LEFT_OUT):
        return bench
    return with_readings(bench, samples.measured & ~jumping)


def _errors(bench: Workbench, current: Refits, noise: Noise) -> Float[np.ndarray, "direction side parameter"]:
    """Return the unknowns' errors along each principal direction, to either side as far as the bounds leave them."""
    point, columns = current.points[0], current.chosen[0][current.chosen[0] >= 0]
    jacobian = noise.scaled(current.slopes[0][: len(columns)])
    norms = np.linalg.norm(jacobian, axis=1)
    seen = norms > 0
    if not seen.any():
        return np.zeros((0, 2, len(point)))
    vectors, values, _ = np.linalg.svd(jacobian[seen] / norms[seen, None], full_matrices=False)
    kept = values > TOLD_APART * values[0]
    errors = np.zeros((np.count_nonzero(kept), len(point)))
    errors[:, columns[seen]] = (_ERRORS * vectors[:, kept] / values[kept] / norms[seen, None]).T
    lower, upper = bench.bounds

    def within(error):
        # Shortened as a whole: cut at a bound one by one, unknowns that make up for each other would not.
        moved = error != 0.0
        room = np.where(error < 0.0, lower - point, upper - point)
        return error * min(1.0, float(np.min(room[moved] / error[moved])))

    return np.array([[within(-error), within(error)] for error in errors])


def _change_at_once(
    bench: Workbench,
    point: Float[np.ndarray, " parameter"],
    both: Float[np.ndarray, "side parameter"],
    here: Float[np.ndarray, "record time signal"],
) -> Float[np.ndarray, "record time signal"]:
    """Return the most that each reading changes in one of some steps along an error, more than in those beside it."""
    back, forth = both
    places = np.arange(1, _STEPS + 1)[:, None] / _STEPS
    before, after = np.split(bench.simulated(np.concatenate([point + places[::-1] * back, point + places * forth])), 2)
    change = np.abs(np.diff(np.concatenate([before, here[None], after]), axis=0))
    beside = np.pad(change, ((1, 1), *[(0, 0)] * (change.ndim - 1)))
    # Nothing is known where a step leads to what cannot be simulated.
    return np.fmax.reduce(change - np.maximum(beside[:-2], beside[2:]))
