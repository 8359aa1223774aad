"""Refits of sets of effects: from several starts, and from where a set has been refitted before."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.diagnosis.bench.noise import Noise
from ehsvjax.diagnosis.bench.progress import Progress
from ehsvjax.diagnosis.bench.refits import Refits, padded, refit, span
from ehsvjax.diagnosis.bench.workbench import TOLD_APART, Workbench, prepared, with_readings
from ehsvjax.diagnosis.hypotheses.curves import Terms, every_curve, quantities, terms_at
from ehsvjax.diagnosis.hypotheses.harmonics import Waves, waves_of
from ehsvjax.diagnosis.hypotheses.screening import Screened
from ehsvjax.effects.effect import UNLIMITED

REFITTED_TOGETHER = 8
"""Candidates that are refitted in one race."""
# Shares of a linear estimate of an effect from which it is refitted too.
_SHARES = (2.0, 1.4, 0.7, 0.5, 0.35, 0.2, 0.1, 0.02)

# Multiples of an effect's shape from which it is refitted too.
_SHAPES = (0.25, 0.5, 0.7, 1.4, 2.0, 4.0)


class Trials(NamedTuple):
    """What every step of the search for causes needs.

    Attributes:
        bench: the workbench.
        seen: what runs along the nominal model and varies, by name.
        terms: of free form, at all places, and what they would do to the outputs of the nominal model.
        waves: what harmonic effects would do, by the candidate's name.
        begun: the workbench that each look begins with: at the nominal model's step, with all readings. What arithmetic
            another explanation needs, and where its jumps lie, the look finds itself.
        reached: set of effects -> the point to which its last refit has led; grows as the search goes on.
        progress: told of each stage.

    """

    bench: Workbench
    seen: dict[str, Float[np.ndarray, "record time"]]
    terms: Terms
    waves: dict[str, Waves]
    begun: Workbench
    reached: dict[frozenset[int], Float[np.ndarray, " parameter"]]
    progress: Progress


def trials_of(begun: Workbench, progress: Progress) -> Trials:
    """Simulate what terms of free form and harmonic ones would do; nothing has been refitted yet."""
    bench = prepared(begun)
    seen = quantities(bench)
    terms = terms_at(bench, bench.nominal, every_curve(bench, seen))
    every = with_readings(bench, begun.problem.samples.measured)
    return Trials(bench, seen, terms, waves_of(bench), every, {}, progress)


def refit_sets(
    trials: Trials,
    starts: Sequence[Sequence[Float[np.ndarray, " parameter"]]],
    sets: Sequence[Sequence[int]],
    noise: Noise,
    race: bool = False,
) -> Refits:
    """Refit each set of effects from each of its starts, and from where it has been refitted before; return the best.

    Where it was before is better than any start, and may yet be a local minimum: all are refitted. In a race, what
    falls far behind the best is given up. Of a start that has other effects too, nothing of these is kept.
    """
    bench = trials.bench
    choices = [
        _different([with_only(bench, point, s) for point in (*some, *_before(trials, s))])
        for some, s in zip(starts, sets, strict=True)
    ]
    of = np.repeat(np.arange(len(sets)), [len(choice) for choice in choices])
    columns = padded([bench.columns_with(s) for s in sets])
    led = refit(bench, np.concatenate([np.stack(choice) for choice in choices]), columns[of], noise, race=race)
    # Among its own: a set of which no start can be simulated is not to have another's refit.
    own = [np.flatnonzero(of == i) for i in range(len(sets))]
    found = led.of([int(rows[np.argmin(led.cost[rows])]) for rows in own])
    for point, cost, included in zip(found.points, found.cost, sets, strict=True):
        if np.isfinite(cost):
            trials.reached[frozenset(included)] = point
    return found


def refit_set(trials: Trials, start: Float[np.ndarray, " parameter"], included: Sequence[int], noise: Noise) -> Refits:
    """Refit one set of effects from one start; see `refit_sets`."""
    return refit_sets(trials, [[start]], [included], noise)


def refit_screened(
    trials: Trials,
    some: Sequence[Screened],
    rest: Sequence[int],
    noise: Noise,
    current: Refits,
    also: Sequence[Float[np.ndarray, " parameter"]] = (),
) -> Refits:
    """Refit each screened candidate beside the effects that are there already.

    From the start that promises most, and from where its own numbers lead from a refit without it, and from other
    points at which it is absent.
    """
    bench = trials.bench
    starts = _most_promising(bench, [_starts(bench, s) for s in some], noise, current)
    grown = _grown(bench, some, [current.points[0], *also], noise)
    every = [[start, *points] for start, points in zip(starts, grown, strict=True)]
    return refit_sets(trials, every, [(*rest, s.candidate) for s in some], noise, race=True)


def refit_reshaped(trials: Trials, current: Refits, included: Sequence[int], candidate: int, noise: Noise) -> Refits:
    """Refit from other shapes of one effect, if one leads lower: a stop's place and stiffness have many local minima.

    Frequencies are searched elsewhere.
    """
    bench = trials.bench
    harmonic = bench.candidates[candidate].effect.harmonic
    shapes = [j for n, j in bench.unknowns_of(bench.candidates[candidate]) if n.absent is None and not harmonic]
    lower, upper = bench.bounds
    starts = []
    for j, factor in itertools.product(shapes, _SHAPES):
        start = current.points[0].copy()
        start[j] = np.clip(factor * start[j], lower[j], upper[j])
        starts.append(start)
    if not starts:
        return current
    columns = padded([bench.columns_with(included)] * len(starts))
    found = refit(bench, np.stack(starts), columns, noise)
    best = found.of([int(np.argmin(found.cost))])
    if not best.cost[0] < current.cost[0]:
        return current
    trials.reached[frozenset(included)] = best.points[0]
    return best


def with_only(
    bench: Workbench, point: Float[np.ndarray, " parameter"], included: Sequence[int]
) -> Float[np.ndarray, " parameter"]:
    """Return the point with all effects absent but some."""
    return np.where(np.isin(np.arange(len(point)), bench.columns_with(included)), point, bench.nominal)


def _before(trials: Trials, included: Sequence[int]) -> list[Float[np.ndarray, " parameter"]]:
    """Return where a set of effects has been refitted before, if it has."""
    point = trials.reached.get(frozenset(included))
    return [] if point is None else [point]


def _different(points: Sequence[Float[np.ndarray, " parameter"]]) -> list[Float[np.ndarray, " parameter"]]:
    return list({point.tobytes(): point for point in points}.values())


def _most_promising(
    bench: Workbench, choices: Sequence[Sequence[np.ndarray]], noise: Noise, current: Refits
) -> Float[np.ndarray, "individual parameter"]:
    """Return of each list of points the one that would fit best after a linear refit of what `current` has.

    With that refit, where it fits better so: a start that is far off as it stands would be given up in a race. Where an
    effect does nothing, as a limit that is never reached, no derivative leads on.
    """
    points = np.concatenate([current.points[:1], *(np.stack(choice) for choice in choices)])
    without_it, *outputs = bench.simulated(points)
    acts = np.array([not np.array_equal(with_it, without_it) for with_it in outputs])
    r = noise.scaled(bench.problem.samples.outputs - np.stack(outputs))
    jacobian = noise.scaled(current.slopes[0])
    known = span(jacobian)
    cost = np.sum((r - (r @ known) @ known.T) ** 2, axis=1)
    cost = np.where(np.isfinite(cost) & acts, cost, np.inf)
    edges = np.cumsum([0, *(len(choice) for choice in choices)])
    best = np.array([a + np.argmin(cost[a:b]) for a, b in itertools.pairwise(edges)])
    as_they_are, refitted = points[1 + best], points[1 + best]
    columns = current.chosen[0][current.chosen[0] >= 0]
    lower, upper = bench.bounds
    finite = np.where(np.isfinite(r[best]), r[best], 0.0)
    steps = np.linalg.lstsq(jacobian[: len(columns)].T, finite.T, rcond=TOLD_APART)[0].T
    refitted[:, columns] = np.clip(refitted[:, columns] + steps, lower[columns], upper[columns])
    left = np.sum(noise.scaled(bench.problem.samples.outputs - bench.simulated(refitted)) ** 2, axis=1)
    better = np.isfinite(left) & ~(left >= np.sum(r[best] ** 2, axis=1))
    return np.where(better[:, None], refitted, as_they_are)


def _grown(
    bench: Workbench, some: Sequence[Screened], points: Sequence[Float[np.ndarray, " parameter"]], noise: Noise
) -> list[list[Float[np.ndarray, " parameter"]]]:
    """Return for each candidate where its own numbers lead from points with nothing of it, all else as it is there.

    Refitted at once, all other unknowns would run far to make up for what it does. None of a limit: no derivative
    brings it near.
    """
    starts, columns, of = [], [], []
    for k, screened in enumerate(some):
        candidate = bench.candidates[screened.candidate]
        numbers = {j: number.absent for number, j in bench.unknowns_of(candidate)}
        if UNLIMITED in numbers.values():
            continue
        for point in points:
            start = point.copy()
            for j, absent in numbers.items():
                start[j] = screened.start[j] if absent is None else bench.nominal[j]
            starts.append(start)
            columns.append(list(numbers))
            of.append(k)
    if not starts:
        return [[] for _ in some]
    led = refit(bench, np.stack(starts), padded(columns), noise, race=False).points
    return [[point for point, i in zip(led, of, strict=True) if i == k] for k in range(len(some))]


def _starts(bench: Workbench, screened: Screened) -> list[Float[np.ndarray, " parameter"]]:
    """Return the start of a candidate, and starts with more or less of the effect, which may be far from linear."""
    candidate = bench.candidates[screened.candidate]
    amplitudes = {j: number.absent for number, j in bench.unknowns_of(candidate) if number.absent is not None}
    columns = list(amplitudes)
    # Shares of a limit are shares of itself: where it hardly acts yet, no derivative tells how low it is.
    absent = np.array([0.0 if absent == UNLIMITED else bench.nominal[j] for j, absent in amplitudes.items()])
    lower, upper = bench.bounds
    starts = [screened.start]
    for share in _SHARES if columns else ():
        start = screened.start.copy()
        start[columns] = np.clip(absent + share * (start[columns] - absent), lower[columns], upper[columns])
        starts.append(start)
    return starts
