"""The search for causes: add the one that explains most, refit, look again; then its rivals, swaps and deletions."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.arithmetic import finest
from ehsvjax.diagnosis.bench.evidence import INSEPARABLE, SIGNIFICANT
from ehsvjax.diagnosis.bench.jumps import without_jumps
from ehsvjax.diagnosis.bench.noise import Noise, noise_outside, plain_noise
from ehsvjax.diagnosis.bench.progress import Progress
from ehsvjax.diagnosis.bench.refits import Refits, not_made_up_for
from ehsvjax.diagnosis.bench.workbench import Workbench, same_readings, settled
from ehsvjax.diagnosis.decision.prediction import Predicted, predicted
from ehsvjax.diagnosis.decision.rivals import Rival, price, rivals_again, rivals_of_all
from ehsvjax.diagnosis.decision.stage import Stage, all_but, with_instead
from ehsvjax.diagnosis.decision.trials import (
    REFITTED_TOGETHER,
    Trials,
    refit_reshaped,
    refit_screened,
    refit_set,
    refit_sets,
    trials_of,
)
from ehsvjax.diagnosis.hypotheses.screening import Screened, responses_at, screen

_MOST_EFFECTS = 3
# Rounds of swaps and new looks, in which causes, noise and arithmetic settle.
_ROUNDS = 6
# Deficit of rivals whose arithmetic a verdict stands on; beyond, a part of it is enough, and none takes the place of
# what is ahead of it by so much.
_WEIGHED = 25.0


class Integration(NamedTuple):
    """How a diagnosis was simulated.

    Attributes:
        step_size: s.
        left_out: output -> readings beside a jump, which no such step knows or no unknown places: they carry no weight.
        worth: by how much halving the step changes what the explanation gains over any other that it is compared with,
            at most, as `Noise.gained` counts; of what is more than 25 behind, in twenty-fifths of that.

    """

    step_size: float
    left_out: dict[str, int]
    worth: float


class Need(NamedTuple):
    """How much worse the fit is without an effect, everything else refitted, as `Noise.gained` counts.

    Attributes:
        gain: of all records.
        of_record: of each in turn; negative where it would do better without.
        required: what chance would gain with it, after the search that found it.

    """

    gain: float
    of_record: tuple[float, ...]
    required: float


@dataclass(frozen=True, eq=False)
class Selection:
    """What the search came to.

    Attributes:
        begun: the workbench before any arithmetic was settled.
        trials: what was tried, with, on their workbench, the samples that were used.
        included: positions of the effects, in the order in which they were found.
        final: the refit with them.
        nominal: the refit without any, under the same noise.
        noise: the noise of what is left.
        stages: the looks, the first at the nominal model.
        rivals: for each included effect all that were refitted in its place, the best, itself, first.
        needs: for each included effect what the fit needs it for.
        unused: what is left of data that were not used: with all effects, without each of them in turn, without any.
        integration: how all was simulated.

    """

    begun: Workbench
    trials: Trials
    included: tuple[int, ...]
    final: Refits
    nominal: Refits
    noise: Noise
    stages: tuple[Stage, ...]
    rivals: tuple[tuple[Rival, ...], ...]
    needs: tuple["Need", ...]
    unused: Predicted
    integration: Integration

    @property
    def bench(self) -> Workbench:
        """The workbench."""
        return self.trials.bench

    @property
    def seen(self) -> dict[str, Float[np.ndarray, "record time"]]:
        """What runs along the nominal model and varies, by name."""
        return self.trials.seen

    def without_causes(self) -> "Selection":
        """Return it with the nominal model alone."""
        unused = self.unused.of([-1])
        return replace(self, included=(), final=self.nominal, rivals=(), needs=(), unused=unused)


def forward(bench: Workbench, progress: Progress) -> tuple[Stage, ...]:
    """Add the cause that explains most, refit and look again, until nothing gains enough; return the looks.

    Args:
        bench: the fit and the record.
        progress: told of each stage.

    """
    progress("simulating every candidate", 0.15)
    trials = trials_of(bench, progress)
    plain = plain_noise(bench.problem.noise_variance, trials.bench.problem.samples.measured)
    stages = [_look(trials, (), refit_set(trials, bench.nominal, (), plain), plain)]
    while (found := _next_effect(stages[-1])) is not None:
        stages.append(found)
    return tuple(stages)


def select(bench: Workbench, found: Sequence[Stage]) -> Selection:
    """Weigh the causes of the last of some looks against their rivals, and go on from what comes out of that.

    Args:
        bench: the fit and the record, as the looks began.
        found: the looks, the first at the nominal model.

    """
    looked_beside = {frozenset(stage.included) for stage in found}
    replaced: set[frozenset[int]] = set()
    *stages, last = found
    nominal = found[0].current
    weighed = _weighed(last, nominal)
    while True:
        last = weighed.stage
        included = frozenset(last.included)
        look: Stage | None
        if weighed.needless is not None:
            # What was added first can become needless by what was added later.
            look = _look_without(last, [weighed.needless])
        elif included not in looked_beside and len(looked_beside) <= len(stages) + _ROUNDS:
            # Beside what was swapped in, or without what was needless, something else may explain the rest.
            looked_beside.add(included)
            look = _next_effect(last)
        elif included not in replaced and len(replaced) < _ROUNDS:
            replaced.add(included)
            look = _instead_of_what_is_there(weighed)
        else:
            break
        if look is not None:
            weighed = _weighed(look, nominal)
    return _selection(bench, stages, weighed)


def _instead_of_what_is_there(weighed: "_Weighed") -> Stage | None:
    """Return the look with a near rival in the place of a cause, where that changes how many causes there need be.

    What acts like two causes together, but for a little, may come before either of them, and once it is there, too
    little is left for another to gain much beside it. What came before may likewise need two others to make up for what
    it is not.
    """
    near = [(k, r) for k, group in enumerate(weighed.rivals) for r in group[1:] if r.deficit < _WEIGHED]
    return _one_in_the_place_of_two(weighed, near) or _two_in_the_place_of_one(weighed, near)


def _one_in_the_place_of_two(weighed: "_Weighed", near: Sequence[tuple[int, Rival]]) -> Stage | None:
    """Return the look with a rival in the place of one cause and without another, if that is needless then."""
    stage = weighed.stage
    trials, noise, final = stage.trials, stage.noise, stage.current
    tried: dict[tuple[int, ...], list[tuple[float, Rival]]] = {}
    for k, rival in near:
        own = stage.included[k]
        dearer = _price(trials, rival.candidate, rival.refitted) - _price(trials, own, final)
        for other in {*stage.included} - {own}:
            instead = all_but(with_instead(stage.included, own, rival.candidate), other)
            tried.setdefault(instead, []).append((stage.required_gain(other) - dearer, rival))
    if not tried:
        return None
    sets = list(tried)
    starts = [[rival.refitted.points[0] for _, rival in tried[instead]] for instead in sets]
    refitted = refit_sets(trials, starts, sets, noise, race=True)
    spare = [
        max(needed for needed, _ in tried[instead]) - noise.gained(residual, final.residual[0])
        for instead, residual in zip(sets, refitted.residual, strict=True)
    ]
    best = int(np.argmax(spare))
    if not spare[best] > 0.0:
        return None
    unused = predicted(trials.bench, [stage.included, sets[best]], [final, refitted.of([best])], noise)
    if unused.against(1, 0) > INSEPARABLE:
        return None
    return _look(trials, sets[best], refitted.of([best]), noise)


def _two_in_the_place_of_one(weighed: "_Weighed", near: Sequence[tuple[int, Rival]]) -> Stage | None:
    """Return the look with the nearest rival of any cause in its place and one effect more, if nothing is left then."""
    stage = weighed.stage
    if not stage.leaves_something or not near:
        return None
    place, rival = min(near, key=lambda one: one[1].deficit)
    instead = with_instead(stage.included, stage.included[place], rival.candidate)
    found = _next_effect(_look(stage.trials, instead, rival.refitted, stage.noise))
    return None if found is None or found.leaves_something else found


def without(selection: Selection, causes: Sequence[int]) -> Selection:
    """Return a selection without some of its causes, nor others that are needless then, what is left weighed anew."""
    *stages, last = selection.stages
    weighed = _weighed(_look_without(last, causes), selection.nominal)
    while weighed.needless is not None:
        weighed = _weighed(_look_without(weighed.stage, [weighed.needless]), selection.nominal)
    return _selection(selection.begun, stages, weighed)


def _look_without(stage: Stage, causes: Sequence[int]) -> Stage:
    rest = tuple(j for j in stage.included if j not in causes)
    refitted = refit_set(stage.trials, stage.current.points[0], rest, stage.noise)
    return _look(stage.trials, rest, refitted, stage.noise)


def _selection(begun: Workbench, stages: Sequence[Stage], weighed: "_Weighed") -> Selection:
    last = weighed.stage
    return Selection(
        begun=begun,
        trials=last.trials,
        included=last.included,
        final=last.current,
        nominal=weighed.nominal,
        noise=last.noise,
        stages=(*stages, last),
        rivals=weighed.rivals,
        needs=weighed.needs,
        unused=weighed.unused,
        integration=_integration(begun, last.trials.bench, weighed.worth),
    )


class _Weighed(NamedTuple):
    """The causes of a stage, each in the best form of its rivals, and all that they are compared with.

    Attributes:
        stage: with the causes after swaps for better rivals, at the step that all that is compared needs.
        nominal: the refit without any, under the same noise.
        rivals: for each cause all that was refitted in its place, the best first.
        needs: for each cause what the fit needs it for.
        unused: what is left of unused data with all causes, without each of them, and without any.
        needless: the cause that is needed least, if the record can do without it.
        worth: by how much halving the step changes what they gain over any of them.

    """

    stage: Stage
    nominal: Refits
    rivals: tuple[tuple[Rival, ...], ...]
    needs: tuple[Need, ...]
    unused: Predicted
    needless: int | None
    worth: float


def _weighed(stage: Stage, nominal: Refits) -> _Weighed:
    """Refit what could be there instead of each cause, and settle the arithmetic for all that is compared."""
    looked_at = {frozenset(stage.included)}
    included, final, rivals = rivals_of_all(stage._replace(current=_from_nominal_starts_too(stage)))
    for rounds_left in reversed(range(_ROUNDS)):
        stage = stage._replace(included=included, current=final)
        trials, noise = stage.trials, stage.noise
        nominal = refit_set(trials, nominal.points[0], (), noise)
        known, worth = _settled_for_all(trials.bench, _compared(final, nominal, rivals), noise)
        # Of two that are as good each may be the better one beside the noise that the other leaves.
        if not rounds_left or (known is trials.bench and frozenset(included) in looked_at):
            break
        # Nothing is searched again: what was found is refitted from where it is, under the noise that is left now.
        stage = _look(trials._replace(bench=known), included, final, noise, int(known.problem.substeps))
        looked_at.add(frozenset(included))
        included, final, rivals = rivals_again(stage, rivals)
    needs, unused = _needs(stage, nominal)
    return _Weighed(stage, nominal, rivals, needs, unused, _needless(included, needs, unused), worth)


def _from_nominal_starts_too(stage: Stage) -> Refits:
    """Return the refit of a stage's causes also from where each record would start nominally.

    Without the causes a start may have run to a bound to make up for them, where a limit hides it: a spool that begins
    far beyond its stop moves nothing.
    """
    bench, point = stage.trials.bench, stage.current.points[0]
    start = point.copy()
    for k, record in enumerate(bench.records):
        for name, value in bench.fit.initial_of(record, "nominal").items():
            column = bench.column.get(f"{name}[{k}]")
            if column is not None:
                start[column] = bench.coordinate(value, column)
    return refit_sets(stage.trials, [[point, start]], [stage.included], stage.noise)


def _settled_for_all(bench: Workbench, compared: Sequence[Refits], noise: Noise) -> tuple[Workbench, float]:
    """Return the bench settled for the best of all explanations that are compared, the first, and what arithmetic is
    worth between it and any other: by how much half the step changes what the one gains over the other, once the
    unknowns of both have followed.

    Where another is far behind, its arithmetic counts as a part of that.
    """
    known = _settled(bench, compared[0].points, noise)
    coarse = known.problem.samples.outputs - known.simulated(np.concatenate([r.points for r in compared]))
    fine = _at_half_the_step(known, compared, coarse, noise)
    before, after = (np.array([noise.gained(each, left[0]) for each in left]) for left in (coarse, fine))
    worth = float(np.max(np.abs(after - before) / np.maximum(1.0, np.abs(after) / _WEIGHED)))
    if known is bench and worth > 1.0 and not finest(known.problem):
        return replace(known, problem=replace(known.problem, substeps=2 * known.problem.substeps)), worth
    return known, worth


def _at_half_the_step(
    bench: Workbench,
    compared: Sequence[Refits],
    coarse: Float[np.ndarray, "explanation record time signal"],
    noise: Noise,
) -> Float[np.ndarray, "explanation record time signal"]:
    """Return what explanations would leave at half the step, once their unknowns have followed, from what they leave.

    Of what could not be simulated or refitted, nothing that is finite.
    """
    points = np.concatenate([refitted.points for refitted in compared])
    fine = bench.problem.samples.outputs - bench.simulated(points, substeps=2 * int(bench.problem.substeps))
    change = fine - coarse
    return coarse + np.stack([
        not_made_up_for(each, refitted, noise.scaled) if np.isfinite(each).all() else each
        for each, refitted in zip(change, compared, strict=True)
    ])  # fmt: skip


def _settled(bench: Workbench, point: Float[np.ndarray, "1 parameter"], noise: Noise) -> Workbench:
    """Return the bench settled for one explanation: as any change of the outputs, what its arithmetic makes of them
    counts in variances of what is left along it.
    """
    outputs_at, here = bench.stepped(point), int(bench.problem.substeps)
    off = noise.scaled(outputs_at(2 * here)[0] - outputs_at(here)[0])
    left = noise.scaled(bench.problem.samples.outputs - outputs_at(here)[0])
    variance, _ = noise.left_along(off, left) if 0.0 < float(off @ off) < np.inf else (1.0, np.inf)
    return settled(bench, outputs_at, noise.variances * variance)


def _integration(begun: Workbench, ended: Workbench, worth: float) -> Integration:
    """Return how all was simulated, from the benches at the start and at the end."""
    samples = ended.problem.samples
    left_out = (begun.problem.samples.measured & ~samples.measured).sum(axis=(0, 1))
    return Integration(
        step_size=float(np.max(samples.sample_period)) / int(ended.problem.substeps),
        left_out=dict(zip(ended.problem.observed, left_out.tolist(), strict=True)),
        worth=worth,
    )


def _compared(final: Refits, nominal: Refits, rivals: Sequence[Sequence[Rival]]) -> list[Refits]:
    """Return the refits of all explanations that a verdict weighs against each other."""
    return [final, nominal, *(r.refitted for group in rivals for r in group if r.deficit < _WEIGHED)]


def _look(
    trials: Trials, included: tuple[int, ...], current: Refits, noise: Noise, substeps: int | None = None
) -> Stage:
    """Look at what is left after a refit: its noise, first taken to be as before, and what could explain the rest.

    With at least so many steps a sample, or as many as the refit itself needs.
    """
    every = trials.begun
    if substeps is not None:
        every = replace(every, problem=replace(every.problem, substeps=np.int32(substeps)))
    trials, current = _known(trials, every, included, current, noise)
    while True:
        bench = trials.bench
        measured = bench.problem.samples.measured
        tried = responses_at(
            bench, current, included, plain_noise(bench.problem.noise_variance, measured), trials.waves
        )
        spanned = current.slopes[0], tried.changes, trials.terms.responses
        noise = noise_outside(current.residual[0], measured, spanned)
        before = trials
        trials, current = _known(before, bench, included, current, noise)
        if trials is before:
            break
    if noise.coloured or noise.variances.size > 1:
        current = refit_set(trials, current.points[0], included, noise)
        tried = responses_at(bench, current, included, noise, trials.waves)
    else:
        # The variance of one record's and output's white noise does not move the best fit.
        current = current._replace(cost=np.array([_cost_under(current, noise)]))
    return Stage(trials, included, current, noise, screen(bench, current, tried, noise, int(measured.sum()) // 2))


def _known(
    trials: Trials, bench: Workbench, included: tuple[int, ...], current: Refits, noise: Noise
) -> tuple[Trials, Refits]:
    """Return trials with those readings of a bench that are known at a refit, and the refit there.

    Both as they are if these are the readings that they have.
    """
    while True:
        bench = without_jumps(_settled(bench, current.points, noise), current, noise)
        if same_readings(bench, trials.bench):
            return trials, current
        trials = trials._replace(bench=bench)
        only_known = plain_noise(noise.variances, bench.problem.samples.measured)
        current = refit_set(trials, current.points[0], included, only_known)


def _next_effect(stage: Stage) -> Stage | None:
    """Return the next look, with the effect more that explains most; none if none gains enough, or there are enough.

    What each of several records has for itself fits whatever each of them is: what all share, and explains alike, comes
    before it.
    """
    if len(stage.included) == _MOST_EFFECTS:
        return None
    bench = stage.trials.bench
    hopeful = [s for s in stage.screening.ranked if s.corrected < SIGNIFICANT]
    shared = _best_of(stage, [s for s in hopeful if not bench.of_each(s.candidate)])
    own = _best_of(stage, [s for s in hopeful if bench.of_each(s.candidate)])
    if shared is None or own is None:
        return shared or own
    return own if stage.noise.gained(shared.current.residual[0], own.current.residual[0]) > INSEPARABLE else shared


def _best_of(stage: Stage, hopeful: Sequence[Screened]) -> Stage | None:
    """Return the look with the one of some candidates that explains most; none if none gains enough."""
    trials = stage.trials
    bench = trials.bench
    best: Stage | None = None
    # The best by score are not always the best once refitted: if something is left of them, others are tried.
    for first in range(0, min(len(hopeful), 2 * REFITTED_TOGETHER), REFITTED_TOGETHER):
        some = hopeful[first : first + REFITTED_TOGETHER]
        names = ", ".join(dict.fromkeys(bench.candidates[s.candidate].name for s in some[:3]))
        more = ", ..." if len(some) > 3 else ""
        trials.progress(f"refitting the model with {names}{more}", 0.25 + 0.08 * len(stage.included))
        refitted = refit_screened(trials, some, stage.included, stage.noise, stage.current)
        # What half the step takes away was no gain: friction that is steeper than the step shakes what nothing holds.
        left = _at_half_the_step(bench, [refitted.of([k]) for k in range(len(some))], refitted.residual, stage.noise)
        cost = np.sum(stage.noise.scaled(left) ** 2, axis=1)
        penalised = cost + [price(bench, s.candidate, x) for s, x in zip(some, refitted.points, strict=True)]
        enough = [
            np.isfinite(squares)
            and stage.noise.in_variances(
                float(stage.current.cost[0] - squares), stage.current.residual[0], residual
            )[0] > stage.required_gain(s.candidate)
            for s, squares, residual in zip(some, cost, left, strict=True)
        ]  # fmt: skip
        if not any(enough):
            continue
        chosen = int(np.argmin(np.where(enough & np.isfinite(penalised), penalised, np.inf)))
        if best is not None and not cost[chosen] < _cost_under(best.current, stage.noise):
            break
        candidate = some[chosen].candidate
        best = _look(trials, (*stage.included, candidate), refitted.of([chosen]), stage.noise)
        if not best.leaves_something:
            break
        reshaped = refit_reshaped(best.trials, best.current, best.included, candidate, best.noise)
        if reshaped is not best.current:
            best = _look(best.trials, best.included, reshaped, best.noise)
            if not best.leaves_something:
                break
    return best


def _price(trials: Trials, candidate: int, refitted: Refits) -> float:
    return price(trials.bench, candidate, refitted.points[0])


def _cost_under(refits: Refits, noise: Noise) -> float:
    return float(np.sum(noise.scaled(refits.residual[0]) ** 2))


def _needs(stage: Stage, nominal: Refits) -> tuple[tuple[Need, ...], Predicted]:
    """Return what the fit needs each effect for, and what is left of unused data; see `Selection.unused`."""
    trials, final, noise = stage.trials, stage.current, stage.noise
    sets, refits, needs = [stage.included], [final], []
    for i in stage.included:
        rest = all_but(stage.included, i)
        sets.append(rest)
        refits.append(refit_set(trials, final.points[0] if rest else nominal.points[0], rest, noise))
        both = refits[-1].residual[0], final.residual[0]
        needs.append(Need(
            gain=noise.gained(*both),
            of_record=tuple(noise.of_record(k).gained(*both) for k in range(len(trials.bench.records))),
            required=stage.required_gain(i),
        ))  # fmt: skip
    if len(stage.included) > 1:
        sets.append(())
        refits.append(nominal)
    return tuple(needs), predicted(trials.bench, sets, refits, noise)


def _needless(included: Sequence[int], needs: Sequence[Need], unused: Predicted) -> int | None:
    """Return the effect that is needed least, if it is needless; None if all are needed.

    It is needless if it gains less than chance could, or if data that were not used speak against it by more than
    chance.
    """
    spare = {}
    for k, (i, need) in enumerate(zip(included, needs, strict=True)):
        spare[i] = min(need.gain - need.required, INSEPARABLE - unused.against(0, k + 1))
    least = min(spare, key=lambda i: spare[i], default=None)
    return least if least is not None and spare[least] < 0.0 else None
