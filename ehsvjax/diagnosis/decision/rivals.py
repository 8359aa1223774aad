"""What could be there instead of an effect that was found: its rivals, refitted in its place."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.diagnosis.bench.evidence import INSEPARABLE, PER_NUMBER
from ehsvjax.diagnosis.bench.noise import Noise
from ehsvjax.diagnosis.bench.refits import Refits, padded, refit
from ehsvjax.diagnosis.bench.workbench import Workbench
from ehsvjax.diagnosis.decision.prediction import predicted
from ehsvjax.diagnosis.decision.stage import Stage, all_but, with_instead
from ehsvjax.diagnosis.decision.trials import (
    REFITTED_TOGETHER,
    Trials,
    refit_screened,
    refit_set,
    refit_sets,
    with_only,
)
from ehsvjax.diagnosis.hypotheses.screening import Screened, responses_at, screen

_SWAPS = 3
# Noise variances by which a refit has to be better than another to take its place.
_LOWER = 0.1
# Deficit to first order of a rival that is refitted, however many there are; a large effect is not of first order.
_WORTH_A_REFIT = 100.0


def price(bench: Workbench, candidate: int, point: Float[np.ndarray, " parameter"]) -> float:
    """Return the noise variances that a candidate must bring to come before another: for its numbers, search, rarity.

    A constant that was given wrong, the commonest cause of all, may be off by any factor; a sensor hardly by a third.
    """
    unknowns = bench.unknowns_of(bench.candidates[candidate])
    rarest = max(number.rarity(bench.value(point, j)) for number, j in unknowns if number.absent is not None)
    return PER_NUMBER * (bench.numbers_of(candidate) + rarest) + bench.search_of(candidate)


class Rival(NamedTuple):
    """A refit of one candidate in the place of another: how much worse than the best, as `Noise.gained` counts."""

    candidate: int
    deficit: float
    refitted: Refits


def rivals_of_all(stage: Stage) -> tuple[tuple[int, ...], Refits, tuple[tuple[Rival, ...], ...]]:
    """Return the effects after swaps for better rivals, their refit, and for each all that could be there instead."""
    groups: dict[int, tuple[Rival, ...]] = {}
    swaps, waiting = 0, list(stage.included)
    while waiting:
        own = waiting.pop(0)
        group = _rivals_of(stage, own)
        best = group[0]
        if swaps < _SWAPS and (best.candidate != own or _cost(best.refitted) < _cost(stage.current) - _LOWER):
            # The others are looked at anew, beside what is better.
            swaps += 1
            stage = _swapped(stage, own, best)
            waiting = [j for j in stage.included if j != best.candidate]
            own = best.candidate
        groups[own] = group
    return stage.included, stage.current, tuple(groups[i] for i in stage.included)


def rivals_again(
    stage: Stage, groups: Sequence[Sequence[Rival]]
) -> tuple[tuple[int, ...], Refits, tuple[tuple[Rival, ...], ...]]:
    """Return the same as `rivals_of_all` from where all have been refitted, under another step or noise."""
    ranked = []
    for own, group in zip(stage.included, groups, strict=True):
        rest = all_but(stage.included, own)
        others = [r for r in group if r.candidate not in stage.included]
        ranked.append(_ranked(stage, own, {own: stage.current} | _refitted_beside(stage, others, rest)))
    for own, group in zip(stage.included, ranked, strict=True):
        if group[0].candidate != own:
            stage = _swapped(stage, own, group[0])
            break
    # What has taken one cause's place is no rival of another.
    of_each = [tuple(r for r in group if r.candidate not in stage.included or r is group[0]) for group in ranked]
    return stage.included, stage.current, tuple(of_each)


def _swapped(stage: Stage, own: int, rival: Rival) -> Stage:
    """Return the stage with a rival in the place of a cause; what else could be there is as it was."""
    return stage._replace(included=with_instead(stage.included, own, rival.candidate), current=rival.refitted)


def _refitted_beside(stage: Stage, rivals: Sequence[Rival], rest: tuple[int, ...]) -> dict[int, Refits]:
    """Return rivals refitted from where each was, and from where all else is as it is in the stage's refit.

    Two that do the same are else told apart by the local minimum of the model's own unknowns that each has come to, or
    by how far the other has gone on along a flat valley.
    """
    if not rivals:
        return {}
    bench, starts = stage.trials.bench, []
    for rival in rivals:
        own, there = bench.columns_of(bench.candidates[rival.candidate]), stage.current.points[0].copy()
        there[own] = rival.refitted.points[0][own]
        starts.append([rival.refitted.points[0], there])
    led = refit_sets(stage.trials, starts, [(*rest, r.candidate) for r in rivals], stage.noise, race=True)
    return {r.candidate: led.of([k]) for k, r in enumerate(rivals)}


def _rivals_of(stage: Stage, own: int) -> tuple[Rival, ...]:
    """Return what was refitted in the place of one effect, the best first."""
    trials, final, noise = stage.trials, stage.current, stage.noise
    rest = all_but(stage.included, own)
    start = with_only(trials.bench, final.points[0], rest)
    current = refit_set(trials, start, rest, noise)
    base = _beside(trials, start, current, noise) if rest else current
    # From where the model is without the cause, and from where it is with it: a rival may do just the same.
    found = _refitted_from(trials, base, own, rest, noise, start)
    group = _ranked(stage, own, found | {own: min(found.get(own, final), final, key=_cost)})
    best, *others = (r for r in group if r.deficit < _WORTH_A_REFIT)
    again = _refitted_beside(stage._replace(current=best.refitted), others, rest)
    return _ranked(stage, own, {r.candidate: r.refitted for r in group} | again) if again else group


def _ranked(stage: Stage, own: int, found: Mapping[int, Refits]) -> tuple[Rival, ...]:
    """Return what was refitted in the place of an effect, the best first, with how much worse each is.

    No rival is what chance could gain as well, where the effect surely gains more; nor what would take its place, and
    has unused data against it by more than chance.
    """
    trials, noise, rest = stage.trials, stage.noise, all_but(stage.included, own)
    able = {candidate: refitted for candidate, refitted in found.items() if np.isfinite(_cost(refitted))}
    neither = refit_set(trials, able[own].points[0], rest, noise)
    gains = {candidate: noise.gained(neither.residual[0], able[candidate].residual[0]) for candidate in able}
    for candidate, gain in gains.items():
        if gain < min(stage.required_gain(candidate), gains[own] - INSEPARABLE):
            del able[candidate]
    prices = {candidate: price(trials.bench, candidate, refitted.points[0]) for candidate, refitted in able.items()}

    def behind(best: int) -> dict[int, float]:
        """Return by how much each is worse than one of them, their prices included."""
        return {
            candidate: noise.gained(refitted.residual[0], able[best].residual[0]) + prices[candidate] - prices[best]
            for candidate, refitted in able.items()
        }

    best, been = own, {own}
    while True:
        deficits = behind(best)
        better = min(deficits, key=lambda candidate: deficits[candidate])
        # As good but for rounding: no reason to swap.
        if not deficits[better] < -1e-3:
            break
        if better in been:
            # Each of them is better than another, as what they leave differs: none is the best.
            best = own
            break
        unused = predicted(trials.bench, [(*rest, best), (*rest, better)], [able[best], able[better]], noise)
        if unused.against(1, 0) > INSEPARABLE:
            del able[better]
        else:
            best = better
            been.add(better)
    ranked = sorted(behind(best).items(), key=lambda pair: (pair[0] != best, pair[1]))
    return tuple(Rival(candidate, max(0.0, deficit), able[candidate]) for candidate, deficit in ranked)


def _cost(refitted: Refits) -> float:
    return float(refitted.cost[0])


def _beside(trials: Trials, start: Float[np.ndarray, " parameter"], current: Refits, noise: Noise) -> Refits:
    """Return the point where the model's own unknowns are refitted, and other effects stay as they are with the cause.

    Once these have gone to make up for what is not there, they do not always find back: a frequency for one.
    """
    bench = trials.bench
    own = bench.base_columns
    # The model's unknowns from where they are with the cause, and from where they are without it.
    starts = np.stack([start, start])
    starts[1, own] = current.points[0, own]
    held = refit(bench, starts, padded([own] * 2), noise)
    return refit(bench, held.points[np.argmin(held.cost)][None], current.chosen, noise, iterations=1)


def _refitted_from(
    trials: Trials, base: Refits, own: int, rest: tuple[int, ...], noise: Noise, with_it: np.ndarray
) -> dict[int, Refits]:
    """Return the refits of candidates that are, at a point without the effect, most like it.

    Also from where all else is as it is with it.
    """
    bench = trials.bench
    screening = screen(bench, base, responses_at(bench, base, rest, noise, trials.waves), noise, 1)
    # What all records share is no worse an explanation for what each could have for itself.
    able = [s for s in screening.ranked if bench.of_each(own) or not bench.of_each(s.candidate)]
    close = _close(able, own)
    if not close:
        return {}
    refitted = refit_screened(trials, close, rest, noise, base, [with_it])
    return {s.candidate: refitted.of([k]) for k, s in enumerate(close)}


def _close(ranked: Sequence[Screened], own: int) -> list[Screened]:
    """Return the candidates whose response is most like that of one effect, itself among them."""
    mine = next((s for s in ranked if s.candidate == own), None)
    if mine is None:
        return list(ranked[:REFITTED_TOGETHER])
    alike = sorted(ranked, key=lambda s: -abs(float(s.response @ mine.response)))
    strongest = [s for s in ranked[: REFITTED_TOGETHER // 2] if s.candidate != own]
    chosen = {s.candidate: s for s in [mine, *strongest]}
    for s in alike:
        # What a rival's refit could at most reach, to first order.
        deficit = mine.score**2 * (1.0 - float(s.response @ mine.response) ** 2)
        if len(chosen) < REFITTED_TOGETHER or (deficit < _WORTH_A_REFIT and len(chosen) < 2 * REFITTED_TOGETHER):
            chosen.setdefault(s.candidate, s)
    return list(chosen.values())
