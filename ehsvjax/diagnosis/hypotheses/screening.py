"""Which of all candidates could explain what is left: a score for each, and how often noise alone would do as well.

For each candidate, finite steps of its numbers are simulated, for a derivative would not see a kink or a play. What
refitting the unknowns could do instead is projected out of the response; along what remains the whitened residual is
a standard normal number if there is noise alone (Lagrange multiplier test; one-sided where the effect is). The p-value
counts the whole search: it is how often the largest of all candidates' scores is as large under noise (Monte Carlo of
the correlated normal numbers), with the frequencies that were searched.
"""

import functools
import itertools
from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.diagnosis.bench.evidence import SIGNIFICANT, corrected, smallest_p_values
from ehsvjax.diagnosis.bench.noise import Noise
from ehsvjax.diagnosis.bench.refits import Refits, unexplained
from ehsvjax.diagnosis.bench.workbench import Workbench, known_alone
from ehsvjax.diagnosis.hypotheses.harmonics import Waves, with_frequencies
from ehsvjax.effects.effect import UNLIMITED, Candidate

# Share of a response that must be left after the refit of the unknowns: below is rounding.
_SURVIVES = 1e-5


class Trial(NamedTuple):
    """One step of a candidate: for a harmonic effect the two steps of one frequency.

    Attributes:
        candidate: position in the workbench.
        points: `[step, parameter]` where each step leads.
        one_sided: whether the effect can only act in this direction.
        proportional: whether half the step would do half as much.
        harmonic: whether its frequency was chosen by the residual.

    """

    candidate: int
    points: Float[np.ndarray, "step parameter"]
    one_sided: bool
    proportional: bool
    harmonic: bool


class Screened(NamedTuple):
    """What one candidate could do, at its best trial.

    Attributes:
        candidate: position in the workbench.
        score: of the residual along the response, in deviations; signed for a single step.
        p_value: of that score alone.
        corrected: of the whole search.
        start: `[parameter]` the point from which to refit it.
        response: `[sample]` what the refit of the unknowns cannot do instead, whitened, of unit length.
        shown: sizes of the effect, of `amount`'s unit, that were tried, and the deviations of the noise by which each
            moves the record; none for a limit.
        proportional: whether half the size would show half as much.
        amount: of the step, SI, in the first of the effect's numbers.

    """

    candidate: int
    score: float
    p_value: float
    corrected: float
    start: Float[np.ndarray, " parameter"]
    response: Float[np.ndarray, " sample"]
    shown: tuple[tuple[float, float], ...]
    proportional: bool
    amount: float


class Screening(NamedTuple):
    """All candidates on one residual.

    Attributes:
        ranked: those whose response survives, the most significant first.
        unseen: positions of candidates whose response does not survive a refit of the unknowns, or is none.
        threshold: score of one two-sided candidate that the search exceeds in `SIGNIFICANT` of records of noise.

    """

    ranked: tuple[Screened, ...]
    unseen: tuple[int, ...]
    threshold: float


class Responses(NamedTuple):
    """What every trial does to the outputs: made once at a point, judged under any noise."""

    trials: tuple[Trial, ...]
    changes: Float[np.ndarray, "response record time signal"]


def responses_at(
    bench: Workbench, current: Refits, excluded: Collection[int], noise: Noise, waves: Mapping[str, Waves]
) -> Responses:
    """Simulate the trials of every candidate but the excluded ones from the point of a refit.

    Args:
        bench: the trials' workbench.
        current: one refit.
        excluded: positions of candidates that it includes already.
        noise: of the noise in which frequencies are looked for.
        waves: of harmonic effects, by the candidate's name, for the same.

    """
    bench = with_frequencies(bench, current, noise, waves)
    point = current.points[0]
    trials = [
        trial for i, c in enumerate(bench.candidates) if i not in excluded for trial in _trials(bench, i, c, point)
    ]
    points = np.concatenate([np.zeros((0, len(point))), *(t.points for t in trials)])
    outputs = bench.sketched(np.concatenate([point[None], points]))
    return Responses(tuple(trials), known_alone(outputs[1:] - outputs[0]))


def _trials(bench: Workbench, position: int, candidate: Candidate, point) -> list[Trial]:
    """Return the steps of a candidate: of each amplitude, at each combination of its shapes."""
    scales = bench.scales[candidate.name]
    lower, _ = bench.bounds
    numbers = bench.unknowns_of(candidate)
    amplitudes = [(number, j) for number, j in numbers if number.absent is not None]
    shapes = [(number, j) for number, j in numbers if number.absent is None]
    found = []
    for values in itertools.product(*(number.tries(scales) for number, _ in shapes)):
        at = point.copy()
        for (_, j), value in zip(shapes, values, strict=True):
            at[j] = bench.coordinate(value, j)
        for steps in itertools.zip_longest(*(number.tries(scales) for number, _ in amplitudes)):
            moved = np.repeat(at[None], len(amplitudes), axis=0)
            for row, ((_, j), value) in enumerate(zip(amplitudes, steps, strict=True)):
                moved[row, j] = bench.coordinate(value, j)
            number, first = amplitudes[0]
            tried = number.tries(scales)
            limited = number.absent == UNLIMITED or (number.absent == 0.0 and lower[first] >= 0.0)
            found.append(
                Trial(
                    position,
                    moved,
                    one_sided=len(amplitudes) == 1 and limited,
                    proportional=len(tried) == 1,
                    harmonic=candidate.effect.harmonic,
                )
            )
    return found


def screen(bench: Workbench, current: Refits, tried: Responses, noise: Noise, harmonics: int) -> Screening:
    """Score every trial under a noise.

    Args:
        bench: the trials' workbench.
        current: the refit to which an effect would be added.
        tried: the responses at its point.
        noise: of the noise.
        harmonics: how many frequencies were searched for the few that were tried.

    """
    from scipy.special import ndtri

    known, r = unexplained(current, noise.innovations)
    g = noise.innovations(tried.changes)
    whole = np.linalg.norm(g, axis=1)
    g = g - (g @ known) @ known.T
    left = np.linalg.norm(g, axis=1)
    survives = left > _SURVIVES * np.maximum(whole, 1e-300)
    bases, row = [], 0
    for trial in tried.trials:
        rows = np.arange(row, row + len(trial.points))
        row += len(trial.points)
        ok = rows[survives[rows]]
        bases.append((trial, rows, _basis(g[ok]) if len(ok) else None))
    judged = [(t, rows, q) for t, rows, q in bases if q is not None]
    if not judged:
        return Screening((), tuple(sorted({t.candidate for t in tried.trials})), 0.0)
    # The frequencies of a harmonic effect were chosen by the residual: they have a correction of their own.
    single = [(q, functools.partial(_p_value, trial=trial)) for trial, _, q in judged if not trial.harmonic]
    null = smallest_p_values([q for q, _ in single], [p for _, p in single], seed=0)
    best: dict[int, Screened] = {}
    for trial, rows, q in judged:
        u = q.T @ r
        p = float(_p_value(u[None], trial)[0])
        several = q.shape[1] > 1
        start, amount, shown = _start(bench, trial, g[rows], r, left[rows])
        found = Screened(
            candidate=trial.candidate,
            score=float(np.linalg.norm(u)) if several else float(u[0]),
            p_value=p,
            corrected=float(-np.expm1(harmonics * np.log1p(-min(p, 1.0 - 1e-16)))) if trial.harmonic
            else corrected(p, null, len(judged)),
            start=start,
            response=q @ u / max(np.linalg.norm(u), 1e-300) if several else q[:, 0],
            shown=shown,
            proportional=trial.proportional,
            amount=amount,
        )  # fmt: skip
        before = best.get(trial.candidate)
        if before is not None:
            # What each step would show tells what could have been seen, whichever explains most.
            every = tuple(sorted({*found.shown, *before.shown}))
            found, before = (s._replace(shown=every) for s in (found, before))
            best[trial.candidate] = before
        # Among trials of one candidate the one that explains most.
        if before is None or (found.p_value, -abs(found.score)) < (before.p_value, -abs(before.score)):
            best[trial.candidate] = found
    ranked = tuple(sorted(best.values(), key=lambda s: (s.p_value, -abs(s.score))))
    unseen = tuple(sorted({t.candidate for t in tried.trials} - set(best)))
    return Screening(ranked, unseen, float(-ndtri(0.5 * max(null[int(SIGNIFICANT * len(null))], 1e-12))))


def _basis(responses: Float[np.ndarray, "step sample"]) -> Float[np.ndarray, "sample step"]:
    """Return orthonormal directions of a trial's responses; of a single step the way in which it acts."""
    q = np.linalg.qr(responses.T)[0]
    return q * np.sign(q.T @ responses[0]) if len(responses) == 1 else q


def _p_value(u: Float[np.ndarray, "draw step"], trial: Trial) -> Float[np.ndarray, " draw"]:
    from scipy.special import chdtrc, ndtr

    if u.shape[1] > 1:
        return chdtrc(u.shape[1], np.sum(u**2, axis=1))
    if trial.one_sided:
        return ndtr(-u[:, 0])
    return 2.0 * ndtr(-np.abs(u[:, 0]))


def _start(bench: Workbench, trial: Trial, g, r, left):
    """Return the point from which to refit, the first amplitude there, SI, and what the step shows of which size."""
    candidate = bench.candidates[trial.candidate]
    amplitudes = {j: number.absent for number, j in bench.unknowns_of(candidate) if number.absent is not None}
    columns = list(amplitudes)
    start = trial.points[0].copy()
    absent = bench.nominal[columns]
    steps = np.array([trial.points[row, j] for row, j in enumerate(columns)]) - absent
    if trial.proportional:
        factors = np.linalg.lstsq(g.T, r, rcond=None)[0]
        lower, upper = bench.bounds
        for j, step, nothing, factor in zip(columns, steps, absent, factors, strict=True):
            start[j] = np.clip(nothing + factor * step, lower[j], upper[j])
    first, nothing = columns[0], amplitudes[columns[0]]
    amount = bench.value(start, first)
    if nothing == UNLIMITED or not steps[0]:
        return start, amount, ()
    return start, amount, ((abs(bench.value(trial.points[0], first) - nothing), float(left[0])),)
