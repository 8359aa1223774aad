"""The search for causes: add the one that explains most, refit, look again; then its rivals, swaps and deletions."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.diagnose.missing import curve_responses, quantities, strongest_dependence
from ehsvjax.diagnose.noise import Whitening, noise_outside, whitening
from ehsvjax.diagnose.refits import Refits, bounds_of, padded, refit
from ehsvjax.diagnose.screening import Responses, Screened, Screening, complement, responses_at, screen
from ehsvjax.diagnose.workbench import REFINED_ABREAST, Workbench
from ehsvjax.effects.effect import Scales
from ehsvjax.precision.residual_noise import ResidualNoise

SIGNIFICANT = 0.002
"""Corrected p-value of the whole search below which an effect is taken to be there."""
INSEPARABLE = 3.5**2
"""Likelihood ratio (noise variances) within which two causes explain a record alike."""
_MOST_EFFECTS = 3
# A term of free form that explains so much more than the best candidate shows that the bank lacks something.
_BANK_LACKS_IT = 3.0
# Of what is left above the noise, what the next effect must take.
_SHARE_OF_MISFIT = 0.15
# Numbers of effects that can be refitted besides the model's unknowns; likelihood that each but the first must bring.
_OWN_NUMBERS = 6
_PER_NUMBER = 4.0
# Shares of a linear estimate of an effect from which it is refitted too.
_SHARES = (2.0, 1.4, 0.7, 0.5, 0.35, 0.2, 0.1, 0.02)
# Frequencies at which the residual is strongest that are tried, of itself and of its product with a motion.
_PEAKS = 3


class Stage(NamedTuple):
    """One look at what is left: the refit that it started from, the noise, and the candidates' scores."""

    included: tuple[int, ...]
    current: Refits
    white: Whitening
    screening: Screening
    tried: Responses


class Rival(NamedTuple):
    """A refit of one candidate in the place of another: how much worse than the best, in noise variances."""

    candidate: int
    deficit: float
    refitted: Refits


@dataclass(frozen=True, eq=False)
class Selection:
    """What the search came to.

    Attributes:
        bench: the workbench, with the samples that were used and the frequencies that were tried.
        seen: what runs along the nominal model and varies, by name.
        included: positions of the effects, in the order in which they were found.
        final: the refit with them.
        nominal: the refit without any, under the same noise.
        white: the noise of what is left.
        stages: the looks, the first at the nominal model.
        rivals: for each included effect those that could be there instead, itself first.
        gains: for each included effect how much worse the fit is without it, in noise variances.

    """

    bench: Workbench
    seen: dict[str, Float[np.ndarray, " time"]]
    included: tuple[int, ...]
    final: Refits
    nominal: Refits
    white: Whitening
    stages: tuple[Stage, ...]
    rivals: tuple[tuple[Rival, ...], ...]
    gains: tuple[float, ...]


class _Search:
    """The bench and what was computed on it: refits by the effects that they include and the noise."""

    def __init__(self, bench: Workbench, progress: Callable[[str], None]):
        self.bench, self.progress = bench, progress
        self.width = len(bench.base_columns) + _OWN_NUMBERS
        self.seen = quantities(bench)
        self.reached: dict[frozenset[int], np.ndarray] = {}
        self.curves = np.zeros((0, *bench.problem.samples.outputs.shape))

    def columns(self, included: Sequence[int]) -> list[int]:
        own = [j for i in included for j in self.bench.columns_of(self.bench.candidates[i])]
        return [*self.bench.base_columns, *own]

    def fits(self, included: Sequence[int]) -> bool:
        return len(self.columns(included)) <= self.width

    def refits(self, starts: Sequence[np.ndarray], sets: Sequence[Sequence[int]], white: Whitening) -> Refits:
        """Refit each start with its effects, or from where these have been refitted before if that is better."""
        best = self.best_of([[start, *self.known(s)] for start, s in zip(starts, sets, strict=True)], white)
        found = refit(self.bench, best, padded([self.columns(s) for s in sets], self.width), white)
        for point, cost, included in zip(found.points, found.cost, sets, strict=True):
            if np.isfinite(cost):
                self.reached[frozenset(included)] = point
        return found

    def known(self, included: Sequence[int]) -> list[np.ndarray]:
        point = self.reached.get(frozenset(included))
        return [] if point is None else [point]

    def best_of(
        self, choices: Sequence[Sequence[np.ndarray]], white: Whitening, current: Refits | None = None
    ) -> np.ndarray:
        """Return of each list of points the one that fits best, or would after a linear refit of what `current` has."""
        if all(len(choice) == 1 for choice in choices):
            return np.stack([choice[0] for choice in choices])
        points = np.concatenate([np.stack(choice) for choice in choices])
        r = white(self.bench.problem.samples.outputs - self.bench.simulated(points))
        if current is not None:
            known = complement(white(current.slopes[0]))
            r = r - (r @ known) @ known.T
        cost = np.sum(r**2, axis=1)
        cost = np.where(np.isfinite(cost), cost, np.inf)
        edges = np.cumsum([0, *(len(choice) for choice in choices)])
        return np.stack([points[a + np.argmin(cost[a:b])] for a, b in itertools.pairwise(edges)])

    def starts_of(self, screened: Screened) -> list[np.ndarray]:
        """Return the start of a candidate, and starts with more or less of the effect, which may be far from linear."""
        candidate = self.bench.candidates[screened.candidate]
        amplitudes = [n for n in candidate.effect.parameters if n.absent is not None and abs(n.absent) < 1e29]
        columns = [self.bench.column[candidate.parameter(n.name)] for n in amplitudes]
        absent = np.array([n.absent for n in amplitudes]) / self.bench.problem.coordinates.upper[columns]
        lower, upper = bounds_of(self.bench)
        starts = [screened.start]
        for share in _SHARES if columns else ():
            start = screened.start.copy()
            start[columns] = np.clip(absent + share * (start[columns] - absent), lower[columns], upper[columns])
            starts.append(start)
        return starts

    def refitted(self, some: Sequence[Screened], rest: Sequence[int], white: Whitening, current: Refits) -> Refits:
        """Refit each screened candidate beside the effects that are there already, from the refit without it."""
        starts = self.best_of([self.starts_of(s) for s in some], white, current)
        return self.refits(list(starts), [(*rest, s.candidate) for s in some], white)

    def without(self, point: Float[np.ndarray, " parameter"], candidate: int) -> Float[np.ndarray, " parameter"]:
        """Return the point with an effect absent."""
        own = self.bench.columns_of(self.bench.candidates[candidate])
        point = point.copy()
        point[own] = self.bench.nominal[own]
        return point

    def stage(self, included: tuple[int, ...], current: Refits) -> Stage:
        """Look at what is left after a refit."""
        bench = self.bench = with_frequencies(self.bench, current)
        tried = responses_at(bench, current, included)
        if not len(self.curves):
            self.curves = curve_responses(bench, current, self.seen)
        spanned = np.concatenate([current.slopes[0], tried.changes, self.curves])
        white = noise_outside(current.residual[0], bench.problem.samples.measured, spanned)
        return self.judged(included, current, tried, white)

    def judged(self, included, current, tried, white) -> Stage:
        """Refit under the noise, and screen."""
        if white.coloured or len(white.noises) > 1:
            current = self.refits([current.points[0]], [included], white)
        else:
            # The variance of one output's white noise does not move the best fit.
            current = current._replace(cost=np.array([_cost_under(current, white)]))
        harmonics = int(self.bench.problem.samples.measured.sum()) // 2
        return Stage(included, current, white, screen(self.bench, current, tried, white, harmonics), tried)


def select(bench: Workbench, progress: Callable[[str], None]) -> Selection:
    """Search for the causes of what a fit leaves of a record."""
    search = _Search(bench, progress)
    progress("refitting the model")
    plain = plain_noise(bench, bench.problem.noise_variance)
    current = search.refits([bench.nominal], [()], plain)
    progress("simulating every candidate")
    stages = [search.stage((), current)]
    while len(stages[-1].included) < _MOST_EFFECTS:
        found = _next_effect(search, stages[-1])
        if found is None:
            break
        stages.append(found)
    last = stages[-1]
    progress("refitting the rivals")
    included, final, rivals = _rivals(search, last)
    if set(included) != set(last.included):
        last = search.stage(included, final)
        final = last.current
    nominal = search.refits([stages[0].current.points[0]], [()], last.white)
    while True:
        gains, needless = _gains(search, included, final, nominal, last)
        if needless is None:
            break
        # What was added first can become needless by what was added later.
        rest = tuple(j for j in included if j != needless)
        without = search.refits([search.without(final.points[0], needless)], [rest], last.white)
        last = search.stage(rest, without)
        included, final, rivals = _rivals(search, last)
    return Selection(
        search.bench, search.seen, included, final, nominal, last.white, (*stages[:-1], last), rivals, tuple(gains)
    )  # fmt: skip


def _gains(search: _Search, included, final: Refits, nominal: Refits, last: Stage):
    """Return how much worse the fit is without each effect, and the first that is not needed beside the others."""
    gains, needless = [], None
    for i in included:
        rest = tuple(j for j in included if j != i)
        start = search.without(final.points[0], i) if rest else nominal.points[0]
        gain = float(search.refits([start], [rest], last.white).cost[0] - final.cost[0])
        gains.append(gain)
        if len(included) > 1 and needless is None and gain < required_gain(search.bench, last.screening, i):
            needless = i
    return gains, needless


def plain_noise(bench: Workbench, variances: Float[np.ndarray, " signal"]) -> Whitening:
    """Return white noise of these variances: least squares as `identify` does them."""
    noises = [ResidualNoise(float("nan"), np.zeros(0), float(v), float(v)) for v in variances]
    return whitening(noises, bench.problem.samples.measured)


def required_gain(bench: Workbench, screening: Screening, candidate: int) -> float:
    """Return the likelihood ratio that an effect must bring, in noise variances, for the search that found it."""
    numbers = candidate_numbers(bench, candidate)
    if _is_harmonic(bench, candidate):
        frequencies = bench.problem.samples.measured.sum() / 2
        return float(2.0 * np.log(frequencies / SIGNIFICANT)) + _PER_NUMBER
    return screening.threshold**2 + _PER_NUMBER * (numbers - 1)


def candidate_numbers(bench: Workbench, candidate: int) -> int:
    """Return how many numbers an effect has."""
    return len(bench.candidates[candidate].effect.parameters)


def _is_harmonic(bench: Workbench, candidate: int) -> bool:
    return any(n.name == "frequency" for n in bench.candidates[candidate].effect.parameters)


def _next_effect(search: _Search, stage: Stage) -> Stage | None:
    """Return the next look, with one effect more, or none if no effect is significant."""
    bench = search.bench
    hopeful = [
        s for s in stage.screening.ranked if s.corrected < SIGNIFICANT and search.fits((*stage.included, s.candidate))
    ]
    if not hopeful:
        return None
    best: Stage | None = None
    without_form = strongest_dependence(bench, stage.current, stage.white, search.seen)
    # The best by score are not always the best once refitted: if something is left of them, others are tried.
    for first in range(0, min(len(hopeful), 2 * REFINED_ABREAST), REFINED_ABREAST):
        some = hopeful[first : first + REFINED_ABREAST]
        names = ", ".join(dict.fromkeys(bench.candidates[s.candidate].name for s in some[:3]))
        search.progress(f"refitting the model with {names}{', ...' if len(some) > 3 else ''}")
        refitted = search.refitted(some, stage.included, stage.white, stage.current)
        penalised = refitted.cost + [_PER_NUMBER * candidate_numbers(bench, s.candidate) for s in some]
        order = np.argsort(np.where(np.isnan(penalised), np.inf, penalised))
        chosen = int(order[0])
        if best is not None and not refitted.cost[chosen] < _cost_under(best.current, stage.white):
            break
        candidate = some[chosen].candidate
        gain = float(stage.current.cost[0] - refitted.cost[chosen])
        if without_form > _BANK_LACKS_IT * max(gain, required_gain(bench, stage.screening, candidate)):
            # A term of free form explains far more: the bank does not have what is missing.
            continue
        if not _is_gain(search, stage, refitted.best(chosen), candidate):
            continue
        best = search.stage((*stage.included, candidate), refitted.best(chosen))
        left = best.screening.ranked
        if not left or left[0].corrected >= SIGNIFICANT:
            break
    return best


def _cost_under(refits: Refits, white: Whitening) -> float:
    return float(np.sum(white(refits.residual[0]) ** 2))


def _is_gain(search: _Search, stage: Stage, extended: Refits, candidate: int) -> bool:
    """Whether an effect gains enough, under the noise of the stage, and under that of what it leaves itself.

    The latter counts as noise whatever the effect does not explain: it cannot be fooled by a noise that was taken to be
    whiter than it is.
    """
    required = required_gain(search.bench, stage.screening, candidate)
    removable = float(stage.current.cost[0]) - stage.white.used.sum()
    # What takes only a little of a large misfit is not its cause.
    if not stage.current.cost[0] - extended.cost[0] > max(required, _SHARE_OF_MISFIT * removable):
        return False
    measured = search.bench.problem.samples.measured
    own = noise_outside(extended.residual[0], measured, extended.slopes[0])
    if not own.coloured and not stage.white.coloured:
        return True
    both = search.refits(
        [stage.current.points[0], extended.points[0]], [stage.included, (*stage.included, candidate)], own
    )
    return bool(both.cost[0] - both.cost[1] > required)


def _rivals(search: _Search, last: Stage) -> tuple[tuple[int, ...], Refits, tuple[tuple[Rival, ...], ...]]:
    """Return the effects after swaps, their refit, and for each those that could be there instead."""
    included, final = last.included, last.current
    for _ in range(3):
        groups, swapped = [], None
        for i in included:
            rest = tuple(j for j in included if j != i)
            group = _rivals_of(search, i, rest, final, last.white)
            groups.append(group)
            if group[0].candidate != i:
                swapped = (tuple(group[0].candidate if j == i else j for j in included), group[0].refitted)
                break
        if swapped is None:
            return included, final, tuple(groups)
        included, final = swapped
    return included, final, tuple(_rivals_of(search, i, tuple(j for j in included if j != i), final, last.white)
                                  for i in included)  # fmt: skip


def _rivals_of(search: _Search, own: int, rest: tuple[int, ...], final: Refits, white: Whitening) -> tuple[Rival, ...]:
    """Return what could be in the place of one effect, the best first: all within `INSEPARABLE` of the best."""
    bench = search.bench
    current = search.refits([search.without(final.points[0], own)], [rest], white)
    tried = responses_at(bench, current, rest)
    screening = screen(bench, current, tried, white, 1)
    close = _close_rivals(screening.ranked, own)
    close = [s for s in close if search.fits((*rest, s.candidate))]
    refitted = search.refitted(close, rest, white, current)
    rivals = [Rival(own, float(final.cost[0]) + _PER_NUMBER * candidate_numbers(bench, own), final)]
    for k, s in enumerate(close):
        cost = float(refitted.cost[k]) + _PER_NUMBER * candidate_numbers(bench, s.candidate)
        if s.candidate == own:
            if cost < rivals[0].deficit:
                rivals[0] = Rival(own, cost, refitted.best(k))
        elif np.isfinite(cost):
            rivals.append(Rival(s.candidate, cost, refitted.best(k)))
    # Of forms of one name the better one counts.
    rivals.sort(key=lambda rival: rival.deficit)
    least = rivals[0].deficit
    if rivals[0].candidate != own and rivals[0].deficit > next(r.deficit for r in rivals if r.candidate == own) - 1e-3:
        # As good but for rounding: no reason to swap.
        rivals.sort(key=lambda rival: rival.candidate != own)
    return tuple(r._replace(deficit=max(0.0, r.deficit - least)) for r in rivals if r.deficit - least < INSEPARABLE)


def _close_rivals(ranked: Sequence[Screened], own: int) -> list[Screened]:
    """Return the candidates whose response is most like that of one effect, itself among them."""
    mine = next((s for s in ranked if s.candidate == own), None)
    if mine is None:
        return list(ranked[:REFINED_ABREAST])
    alike = sorted(ranked, key=lambda s: -abs(float(s.response @ mine.response)))
    strongest = [s for s in ranked[: REFINED_ABREAST // 2] if s.candidate != own]
    chosen = {s.candidate: s for s in [mine, *strongest]}
    for s in alike:
        # What a rival's refit could at most reach, to first order; a large effect is not of first order.
        deficit = mine.score**2 * (1.0 - float(s.response @ mine.response) ** 2)
        if len(chosen) < REFINED_ABREAST or (deficit < 100.0 and len(chosen) < 2 * REFINED_ABREAST):
            chosen.setdefault(s.candidate, s)
    return list(chosen.values())


def with_frequencies(bench: Workbench, current: Refits) -> Workbench:
    """Return the bench with the frequencies at which a residual, and its product with a motion, are strongest."""
    measured = bench.problem.samples.measured[0, :, 0]
    period = float(bench.problem.samples.sample_period[0])
    residual = np.where(measured, current.residual[0, 0, :, 0], 0.0)
    motion = bench.problem.samples.outputs[0, :, 0] * measured
    plain = _peaks(residual, period, _PEAKS)
    modulated = plain + _peaks(residual * motion, period, _PEAKS) + _peaks(
        residual * np.gradient(motion), period, _PEAKS
    )  # fmt: skip
    scales: dict[str, Scales] = {
        name: {**own, "frequencies": plain, "modulations": modulated} for name, own in bench.scales.items()
    }
    return replace(bench, scales=scales)


def _peaks(series: Float[np.ndarray, " time"], period: float, count: int) -> tuple[float, ...]:
    """Return the frequencies of the largest peaks of a series' spectrum, rad/s, by an oversampled periodogram."""
    length = len(series)
    size = 8 * length
    power = np.abs(np.fft.rfft((series - series.mean()) * np.hanning(length), size)) ** 2
    frequency = 2.0 * np.pi * np.fft.rfftfreq(size, period)
    inside = (frequency > 3.0 / (length * period)) & (frequency < 2.0 / period)
    peak = np.zeros(len(power), bool)
    peak[1:-1] = (power[1:-1] >= power[:-2]) & (power[1:-1] > power[2:]) & inside[1:-1]
    found: list[float] = []
    for j in np.flatnonzero(peak)[np.argsort(-power[peak])]:
        # Side lobes of a stronger peak are no peaks.
        if all(abs(frequency[j] - f) > 12.0 / (length * period) for f in found):
            found.append(float(frequency[j]))
        if len(found) == count:
            break
    return tuple(found) or (2.0 * np.pi / (length * period),)
