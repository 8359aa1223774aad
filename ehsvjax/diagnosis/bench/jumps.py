"""Readings beside a jump of an output, which no unknown is known well enough to place before or behind it.

A load pressure jumps as the spool leaves its dead zone. Where a reading lies within what the unknowns' own errors make
of that moment, the sum of squares has a step, a refit ends where it happens to stand, and a cause that moves the jump
by a microsecond seems to be there. Such a reading is not straight within the errors, and its neighbours are: it carries
no weight. A smooth bend has neighbours that bend as well.
"""

import numpy as np

from ehsvjax.arithmetic import LEFT_OUT, few
from ehsvjax.diagnosis.bench.noise import Noise
from ehsvjax.diagnosis.bench.refits import Refits
from ehsvjax.diagnosis.bench.workbench import TOLD_APART, Workbench, with_readings
from ehsvjax.readings import standing_out

# Standard errors of the unknowns over which a jump is looked for: of many jumps a third lie beyond one of them. And
# deviations of the noise by which a reading may bend over them, more than its neighbours.
_ERRORS, _STRAIGHT = 3.0, 0.3
# Times as many steps that tell what a jump looks like.
_FINER = 4


def without_jumps(bench: Workbench, current: Refits, noise: Noise) -> Workbench:
    """Return the bench without readings that jump within the errors of a refit; itself if there is none.

    Args:
        bench: the trials' workbench.
        current: one refit.
        noise: of its noise.

    """
    samples = bench.problem.samples
    point, columns = current.points[0], current.chosen[0][current.chosen[0] >= 0]
    jacobian = noise.scaled(current.slopes[0][: len(columns)])
    norms = np.linalg.norm(jacobian, axis=1)
    seen = norms > 0
    if not seen.any():
        return bench
    vectors, values, _ = np.linalg.svd(jacobian[seen] / norms[seen, None], full_matrices=False)
    kept = values > TOLD_APART * values[0]
    # Along each principal direction.
    errors = _ERRORS * vectors[:, kept] / values[kept] / norms[seen, None]
    moved = columns[seen]
    lower, upper = bench.bounds
    points = np.repeat(point[None], 1 + 2 * errors.shape[1], axis=0)
    points[1:, moved] = np.clip(point[moved] + np.concatenate([errors.T, -errors.T]), lower[moved], upper[moved])
    outputs = bench.simulated(points)
    forward, backward = np.split(outputs[1:], 2)
    deviations = np.sqrt(noise.innovation_variances)[:, None]
    # Steps smear a jump over their length: what comes before the next reading looks smooth, and shorter ones move it.
    smeared = np.max(np.abs(bench.simulated(points, substeps=_FINER * int(bench.problem.substeps)) - outputs), axis=0)
    bent = np.maximum(np.max(np.abs(forward + backward - 2.0 * outputs[0]), axis=0), smeared) / deviations
    # More than the others: the first reading of a bend that begins bends less.
    alone = [standing_out(bent[..., i], _STRAIGHT) for i in range(bent.shape[-1])]
    jumping = samples.measured & np.stack(alone, axis=-1)
    # More than that no jump bends.
    if not jumping.any() or not few(jumping, samples.measured, LEFT_OUT):
        return bench
    return with_readings(bench, samples.measured & ~jumping)
