"""What could be there instead of an effect that was found: its rivals, refitted in its place."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ehsvjax.diagnose.noise import Whitening
from ehsvjax.diagnose.refits import Refits
from ehsvjax.diagnose.screening import Screened, responses_at, screen
from ehsvjax.diagnose.significance import INSEPARABLE
from ehsvjax.diagnose.trials import REFITTED_TOGETHER, Trials, fits, refit_screened, refit_sets, without

PER_NUMBER = 4.0
"""Likelihood that each number of an effect must bring, so that more numbers are no advantage."""
_SWAPS = 3
# Noise variances by which a refit has to be better than another to take its place.
_LOWER = 0.1
# Deficit to first order of a rival that is refitted, however many there are; a large effect is not of first order.
_WORTH_A_REFIT = 100.0


class Rival(NamedTuple):
    """A refit of one candidate in the place of another: how much worse than the best, in noise variances."""

    candidate: int
    deficit: float
    refitted: Refits


def rivals_of_all(
    trials: Trials, included: tuple[int, ...], final: Refits, white: Whitening
) -> tuple[tuple[int, ...], Refits, tuple[tuple[Rival, ...], ...]]:
    """Return the effects after swaps for better rivals, their refit, and for each all that could be there instead."""
    groups: list[tuple[Rival, ...]] = []
    for attempt in range(_SWAPS + 1):
        groups, better = [], None
        for i in included:
            rest = tuple(j for j in included if j != i)
            group = _rivals_of(trials, i, rest, final, white)
            groups.append(group)
            first = group[0]
            lower = float(first.refitted.cost[0]) < float(final.cost[0]) - _LOWER
            if (first.candidate != i or lower) and attempt < _SWAPS:
                better = (tuple(first.candidate if j == i else j for j in included), first.refitted)
                break
        if better is None:
            break
        included, final = better
    return included, final, tuple(groups)


def _rivals_of(trials: Trials, own: int, rest: tuple[int, ...], final: Refits, white: Whitening) -> tuple[Rival, ...]:
    """Return what could be in the place of one effect, the best first: all within `INSEPARABLE` of the best."""
    bench = trials.bench
    current = refit_sets(trials, [without(bench, final.points[0], own)], [rest], white)
    tried = responses_at(bench, current, rest, white, trials.parts)
    screening = screen(bench, current, tried, white, 1)
    close = [s for s in _close(screening.ranked, own) if fits(bench, (*rest, s.candidate))]
    refitted = refit_screened(trials, close, rest, white, current)
    rivals = [Rival(own, float(final.cost[0]) + PER_NUMBER * bench.numbers_of(own), final)]
    for k, s in enumerate(close):
        cost = float(refitted.cost[k]) + PER_NUMBER * bench.numbers_of(s.candidate)
        if s.candidate == own:
            if cost < rivals[0].deficit:
                rivals[0] = Rival(own, cost, refitted.best(k))
        elif np.isfinite(cost):
            rivals.append(Rival(s.candidate, cost, refitted.best(k)))
    rivals.sort(key=lambda rival: rival.deficit)
    least = rivals[0].deficit
    if rivals[0].candidate != own and least > next(r.deficit for r in rivals if r.candidate == own) - 1e-3:
        # As good but for rounding: no reason to swap.
        rivals.sort(key=lambda rival: rival.candidate != own)
    return tuple(r._replace(deficit=max(0.0, r.deficit - least)) for r in rivals if r.deficit - least < INSEPARABLE)


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
