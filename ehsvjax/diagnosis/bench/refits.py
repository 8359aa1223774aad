"""Refits: from many starts at once, each with unknowns of its own, by Levenberg-Marquardt on scaled residuals."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from ehsvjax.diagnosis.bench.noise import Noise, noise_outside
from ehsvjax.diagnosis.bench.workbench import ABREAST, TOLD_APART, Workbench

_ITERATIONS = 60
# A start is given up if so many steps like the next would not bring it to the best, so many times in a row: a kink
# makes some of them short, until damping has grown and shrunk again.
_HOPELESS = 5.0
_PATIENCE = 4
_STEEPEST = 1e100
# How many times as long the steps are at which a refit begins where that many times as many are not few.
_COARSER = 8
# Share of a step at which its curvature is taken, and of the step that its acceleration may be.
_AHEAD, _MOST_BENT = 0.1, 0.75


class Refits(NamedTuple):
    """Where each start has led.

    Attributes:
        points: `[individual, parameter]` the best point of each.
        cost: the sum of squares of its scaled residuals.
        residual: measured minus simulated there, in the outputs' units.
        slopes: derivatives of the outputs by the chosen unknowns there; zero along padding.
        chosen: `[individual, direction]` the unknowns' columns; -1 is padding.
        converged: whether another step would gain less than a hundredth of the residuals' variance.

    """

    points: Float[np.ndarray, "individual parameter"]
    cost: Float[np.ndarray, " individual"]
    residual: Float[np.ndarray, "individual record time signal"]
    slopes: Float[np.ndarray, "individual direction record time signal"]
    chosen: Int[np.ndarray, "individual direction"]
    converged: Bool[np.ndarray, " individual"]

    def of(self, some: Sequence[int]) -> "Refits":
        """Return the refits of some starts."""
        return Refits(*(field[list(some)] for field in self))


@runtime_checkable
class Weighing(Protocol):
    """What a refit's readings count by."""

    def scaled(self, series: Float[np.ndarray, "*batch record time signal"]) -> Float[np.ndarray, "*batch sample"]:
        """Return the readings that count in deviations of what is of chance in them."""


def span(slopes: Float[np.ndarray, "direction sample"]) -> Float[np.ndarray, "sample independent"]:
    """Return an orthonormal basis of what the unknowns can do to first order."""
    norms = np.linalg.norm(slopes, axis=1)
    kept = slopes[norms > 0] / norms[norms > 0, None]
    if not len(kept):
        return np.zeros((slopes.shape[1], 0))
    vectors, values, _ = np.linalg.svd(kept.T, full_matrices=False)
    return vectors[:, values > TOLD_APART * values[0]]


def unexplained(
    final: Refits, weigh: Callable[[np.ndarray], np.ndarray]
) -> tuple[Float[np.ndarray, "sample independent"], Float[np.ndarray, " sample"]]:
    """Return what the unknowns of a refit can do to first order, and its residual outside of that, both weighed.

    Args:
        final: one refit.
        weigh: `Noise.scaled`, or `Noise.innovations`.

    """
    known = span(weigh(final.slopes[0]))
    residual = weigh(final.residual[0])
    return known, residual - known @ (known.T @ residual)


def not_made_up_for(
    change: Float[np.ndarray, "record time signal"], refitted: Refits, weigh: Callable[[np.ndarray], np.ndarray]
) -> Float[np.ndarray, "record time signal"]:
    """Return what of a change of the outputs the unknowns of one refit cannot make up for, to first order."""
    slopes = weigh(refitted.slopes[0]).T
    norms = np.linalg.norm(slopes, axis=0)
    norms[norms == 0.0] = 1.0
    amounts = np.linalg.lstsq(slopes / norms, weigh(change), rcond=TOLD_APART)[0]
    return change - np.tensordot(amounts / norms, refitted.slopes[0], 1)


def noise_of_all_left(bench: Workbench, final: Refits) -> Noise:
    """Return the noise of a refit's residual, if all that is left of it is noise."""
    return noise_outside(final.residual[0], bench.problem.samples.measured, [final.slopes[0]])


def padded(columns: list[list[int]]) -> Int[np.ndarray, "individual direction"]:
    """Return lists of columns side by side, filled up with -1 to the length of the longest; one at least."""
    width = max(1, *map(len, columns))
    return np.array([list(c) + [-1] * (width - len(c)) for c in columns])


def refit(
    bench: Workbench,
    starts: Float[np.ndarray, "individual parameter"],
    chosen: Int[np.ndarray, "individual direction"],
    noise: Weighing,
    iterations: int = _ITERATIONS,
    race: bool = True,
) -> Refits:
    """Refit the chosen unknowns of every start.

    Damping is relative to the diagonal and grows by 2, 4, 8, ... for steps in a row that did not lower the cost
    (Nielsen 1999); an unknown at a bound that the gradient pushes outwards is held there. Steps bend with the valley
    that they follow (geodesic acceleration, Transtrum & Sethna 2012, arXiv 1201.5885), which takes one more simulation.

    Args:
        bench: the trials' workbench.
        starts: points.
        chosen: columns of the unknowns of each start; -1 is padding.
        noise: by which readings are weighed.
        iterations: at most this many steps.
        race: whether the starts compete: what is far behind the best is given up.

    """
    if iterations > 1 and int(bench.problem.substeps) >= _COARSER**2:
        starts = _led_roughly(bench, starts, chosen, noise, race)
    lower, upper = bench.bounds
    readings = bench.problem.samples.outputs
    count, width = chosen.shape
    points = starts.copy()
    kept: list[_Here | None] = [None] * count
    # Of all starts at once: of a long record by far the most that there is to remember.
    every_slope = np.zeros((count, width, *readings.shape))
    damping, growth = np.full(count, 1e-4), np.full(count, 2.0)
    cost = np.full(count, np.inf)
    converged, hopeless = np.zeros(count, bool), np.zeros(count, int)
    running, bending = np.ones(count, bool), np.ones(count, bool)
    for k in range(count):
        own = chosen[k][chosen[k] >= 0]
        points[k, own] = np.clip(points[k, own], lower[own], upper[own])
    trial = points.copy()
    for _ in range(iterations):
        at = np.flatnonzero(running)
        if not len(at):
            break
        for i, y, slopes in _linearised(bench, at, trial, chosen):
            residual = readings - y
            scaled, jacobian = noise.scaled(residual), noise.scaled(slopes)
            value = float(scaled @ scaled)
            # A NaN is no improvement, nor is a place that is so steep that nothing can be told from there.
            if value < cost[i] and np.max(np.abs(jacobian), initial=0.0) < _STEEPEST:
                points[i], cost[i] = trial[i], value
                every_slope[i, chosen[i] >= 0] = slopes[chosen[i] >= 0]
                kept[i] = _Here(residual, every_slope[i], jacobian @ scaled, jacobian @ jacobian.T)
                damping[i], growth[i] = 0.1 * damping[i], 2.0
            else:
                damping[i], growth[i] = damping[i] * growth[i], 2.0 * growth[i]
            here = kept[i]
            if here is None:
                running[i] = False
                continue
            step, gain = _step(points[i], chosen[i], here.gradient, here.information, damping[i], lower, upper)
            variance = max(cost[i] / len(scaled), 1e-300)
            bending[i] = gain > variance
            if gain < 0.01 * variance:
                converged[i] = True
                running[i] = False
            hopeless[i] = hopeless[i] + 1 if _HOPELESS * gain < cost[i] - np.min(cost) else 0
            if damping[i] > 1e12 or (race and hopeless[i] >= _PATIENCE):
                running[i] = False
            trial[i] = points[i] + step
        # Near the minimum no valley is left to follow.
        _bend(bench, noise, trial, np.flatnonzero(running & bending), points, chosen, kept, damping, lower, upper)
    for i, here in enumerate(kept):
        if here is not None:
            # What a bound holds can do nothing.
            every_slope[i, _held(points[i], chosen[i], here.gradient, lower, upper)] = 0.0
    nothing = np.full(readings.shape, np.nan)
    residuals = np.stack([k.residual if k else nothing for k in kept])
    return Refits(points, cost, residuals, every_slope, chosen, converged)


def _linearised(bench: Workbench, at, trial, chosen):
    """Yield some starts, and the outputs and their derivatives at the trial of each, some at a time."""
    for first in range(0, len(at), ABREAST):
        some = at[first : first + ABREAST]
        outputs, slopes = bench.linearised(trial[some], chosen[some])
        for row, i in enumerate(some):
            yield i, outputs[row], slopes[:, row]


def _led_roughly(bench: Workbench, starts, chosen, noise: Weighing, race) -> Float[np.ndarray, "individual parameter"]:
    """Return where each start leads at a step that is many times longer, or itself where that is better.

    Most of the way to a minimum needs no exact arithmetic; what is compared in the end has it.
    """
    rough = replace(bench, problem=replace(bench.problem, substeps=bench.problem.substeps // _COARSER))
    led = refit(rough, starts, chosen, noise, race=race).points
    off = noise.scaled(bench.problem.samples.outputs - bench.simulated(np.concatenate([starts, led])))
    as_it_was, after = np.sum(off**2, axis=1).reshape(2, -1)
    # A NaN is no improvement.
    return np.where((after < as_it_was)[:, None], led, starts)


class _Here(NamedTuple):
    """What is known at the best point of a start; from the gradient on scaled."""

    residual: Float[np.ndarray, "record time signal"]
    slopes: Float[np.ndarray, "direction record time signal"]
    gradient: Float[np.ndarray, " direction"]
    information: Float[np.ndarray, "direction direction"]


def _bend(bench, noise, trial, running, points, chosen, kept, damping, lower, upper) -> None:
    """Add to steps half the acceleration that keeps them in their valley, where it is less than the step itself."""
    if not len(running):
        return
    steps = trial[running] - points[running]
    ahead = bench.simulated(points[running] + _AHEAD * steps)
    for row, i in enumerate(running):
        here, own = kept[i], np.maximum(chosen[i], 0)
        assert here is not None
        along = np.where(chosen[i] >= 0, steps[row][own], 0.0)
        changed = noise.scaled(ahead[row] - (bench.problem.samples.outputs - here.residual))
        # Made anew: kept for every start it would take as much memory as the slopes.
        jacobian = noise.scaled(here.slopes)
        curvature = 2.0 / _AHEAD * (changed / _AHEAD - along @ jacobian)
        if not np.isfinite(curvature).all():
            continue
        gradient = -(jacobian @ curvature)
        bent, _ = _step(points[i], chosen[i], gradient, here.information, damping[i], lower, upper)
        size = np.sqrt(np.diag(here.information))
        if 2.0 * np.linalg.norm(size * bent[own]) <= _MOST_BENT * np.linalg.norm(size * along):
            moved = trial[i, own] + 0.5 * np.where(chosen[i] >= 0, bent[own], 0.0)
            trial[i, own] = np.clip(moved, lower[own], upper[own])


def _step(point, chosen, gradient, information, damping, lower, upper):
    """Return the step of one point in all its coordinates, and what it should gain to first order.

    Unknowns that would pass a bound go as far as that, and the others take the best step beside it (active set).
    """
    columns = np.maximum(chosen, 0)
    room = np.stack([lower[columns], upper[columns]]) - point[columns]
    free = (chosen >= 0) & (np.diag(information) > 0) & ~_held(point, chosen, gradient, lower, upper)
    moved, able = np.zeros(len(chosen)), free.copy()
    while able.any():
        moved[able] = _damped(
            information[np.ix_(able, able)], (gradient - information @ np.where(able, 0.0, moved))[able], damping
        )
        passing = able & ((moved < room[0]) | (moved > room[1]))
        if not passing.any():
            break
        moved[passing] = np.clip(moved, *room)[passing]
        able &= ~passing
    step = np.zeros(len(point))
    step[chosen[free]] = moved[free]
    return step, float(gradient[free] @ moved[free])


def _held(point, chosen, gradient, lower, upper) -> Bool[np.ndarray, " direction"]:
    """Return which of the chosen unknowns are at a bound that the gradient pushes outwards."""
    columns = np.maximum(chosen, 0)
    at_lower, at_upper = point[columns] <= lower[columns], point[columns] >= upper[columns]
    return (at_upper & (gradient > 0)) | (at_lower & (gradient < 0))


def _damped(information, gradient, damping):
    """Return the damped Gauss-Newton step of unknowns that are free to move."""
    scale = 1.0 / np.sqrt(np.diag(information))
    values, vectors = np.linalg.eigh(information * scale[:, None] * scale)
    fixed = values > TOLD_APART**2 * values[-1]
    inverse = np.where(fixed, 1.0 / (np.where(fixed, values, 1.0) + damping), 0.0)
    return scale * (vectors @ (inverse * (vectors.T @ (scale * gradient))))
