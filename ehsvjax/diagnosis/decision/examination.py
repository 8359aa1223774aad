"""What the causes that were found leave: is it innocent, is it chance, does the bank lack what is missing?"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ehsvjax.diagnosis.bench.evidence import INSEPARABLE, SIGNIFICANT
from ehsvjax.diagnosis.bench.noise import Noise
from ehsvjax.diagnosis.bench.refits import Refits, noise_of_all_left, refit
from ehsvjax.diagnosis.decision.prediction import predicted
from ehsvjax.diagnosis.decision.repeats import repeats_itself
from ehsvjax.diagnosis.decision.search import Selection, without
from ehsvjax.diagnosis.decision.trials import refit_set, with_only
from ehsvjax.diagnosis.hypotheses.curves import TIME, terms_at
from ehsvjax.diagnosis.hypotheses.dependence import Dependence, dependences
from ehsvjax.diagnosis.hypotheses.missing import MissingTerm, missing_term, told_by
from ehsvjax.diagnosis.hypotheses.process_noise import ProcessNoise, process_noise

# Dependences that are followed up where something is left.
_SUSPECTS = 8


class Examination(NamedTuple):
    """What is left of the residual, and of the causes.

    Attributes:
        selection: with the noise of what is left, without causes that a random force explains better.
        before: what the nominal model's residual depends on, the most significant first.
        after: what the extended model's residual depends on.
        innocent: whether that is nothing.
        undecided: whether it is nothing if all that is left is noise: one record does not tell.
        chance: the random force that explains what the causes leave; None if none does.
        chance_behind: of each cause, noise variances by which a random force in its place, or in that of all, is
            behind, less what chance would gain with what it stands for; infinite where none is about as likely.
        doubted: of those beside which no chance is left, and of what could be there instead of each, by how many noise
            variances it is behind chance.
        left: a term of free form in what the causes leave; None where that is nothing, or chance.
        instead: one term of free form that explains the record as well as all causes together and what they leave, but
            for the price of its pieces; looked for beside several, or where they leave something; None if none does.
        lacking: whether that term explains more, its price paid: the bank lacks what is missing.

    """

    selection: Selection
    before: tuple[Dependence, ...]
    after: tuple[Dependence, ...]
    innocent: bool
    undecided: bool
    chance: ProcessNoise | None
    chance_behind: tuple[float, ...]
    doubted: dict[str, float]
    left: MissingTerm | None
    instead: MissingTerm | None
    lacking: bool

    @property
    def missing(self) -> MissingTerm | None:
        """What is missing beside the causes that were found, or could be in the place of them all."""
        return self.instead if self.innocent or self.lacking else self.left


def examine(selection: Selection) -> Examination:
    """Test what a selection leaves, and whether something else explains the record better."""
    bench = selection.bench
    noise, terms = selection.noise, selection.trials.terms
    before = dependences(selection.nominal, noise, terms)
    after = before
    if selection.included:
        terms = terms_at(bench, selection.final.points[0], terms.curves)
        after = dependences(selection.final, noise, terms)
    # Noise that is seen outside all responses excuses what lies along them. An autoregression of all that is left takes
    # any slow misfit for its own: it does so only if the experiment was repeated and left something else.
    undecided = False
    if _significant(after):
        everything = noise_of_all_left(bench, selection.final)
        undecided = everything.coloured and not _significant(dependences(selection.final, everything, terms))
    repeated = repeats_itself(bench, selection.final.residual[0], noise) if undecided else None
    innocent = repeated is False or not _significant(after)
    force = process_noise(bench, selection.final, noise)
    chance, chance_behind = None, (np.inf,) * len(selection.included)
    if force is not None:
        # What no test sees must be there by the likelihood alone.
        needed = 0.0 if _significant(after) else -2.0 * float(np.log(SIGNIFICANT))
        chance = _chance_in(selection, selection.final, force, after, needed)
        instead_of = _chance_instead(selection, force)
        least = min(instead_of, key=lambda causes: instead_of[causes], default=())
        if least and instead_of[least] < 0.0:
            rest = examine(without(selection, least))
            # Where chance is there beside them as well, they are needless; else chance or they are there.
            doubted = {} if chance is not None else _doubted(selection, least, -instead_of[least])
            return rest._replace(doubted=rest.doubted | doubted)
        chance_behind = tuple(
            min((behind for causes, behind in instead_of.items() if cause in causes), default=np.inf)
            for cause in selection.included
        )
    if chance is not None:
        innocent = True
    elif innocent:
        # Then all of it tells of the noise, and more than what lies outside all responses.
        selection = replace(selection, noise=noise_of_all_left(bench, selection.final))
    left = None
    if not innocent:
        left, _ = missing_term(bench, selection.final, selection.noise, selection.seen, _suspects(after))
    instead, lacking = _instead(selection, before, innocent and chance is None, left)
    if lacking and chance is not None:
        innocent = False
    still_open = undecided and repeated is None
    return Examination(
        selection, before, after, innocent, still_open, chance, chance_behind, {}, left, instead, lacking
    )  # fmt: skip


def _doubted(selection: Selection, causes: tuple[int, ...], behind: float) -> dict[str, float]:
    """Return causes that chance explains better, and their rivals, unless they are told from it: how far behind."""
    found: dict[str, float] = {}
    for cause in causes:
        for rival in selection.rivals[selection.included.index(cause)]:
            if behind + rival.deficit < INSEPARABLE:
                found.setdefault(selection.bench.candidates[rival.candidate].name, behind + rival.deficit)
    return found


def _significant(tests: tuple[Dependence, ...]) -> bool:
    """Whether what is left depends on something."""
    return bool(tests) and tests[0].corrected < SIGNIFICANT


def _suspects(tests: tuple[Dependence, ...]) -> tuple[Dependence, ...]:
    """Return the dependences that are followed up: the most significant, and those of a place on itself."""
    at_home = (t for t in tests[_SUSPECTS:] if t.place == t.quantity and t.corrected < SIGNIFICANT)
    return (*tests[:_SUSPECTS], *at_home)


def _chance_instead(selection: Selection, beside: ProcessNoise) -> dict[tuple[int, ...], float]:
    """Return what a random force can stand for as well: each of the causes, or all of them.

    With the noise variances by which it is less likely, all else refitted under it, than they are, less what chance
    would gain with them.

    Args:
        selection: the causes.
        beside: a random force in what they leave.

    """
    bench, noise, found = selection.bench, selection.noise, {}
    required = {cause: need.required for cause, need in zip(selection.included, selection.needs, strict=True)}
    for causes in filter(None, dict.fromkeys([*((cause,) for cause in required), selection.included])):
        rest = tuple(j for j in required if j not in causes)
        start = with_only(bench, selection.final.points[0], rest)
        refitted = refit_set(selection.trials, start, rest, noise)
        force = process_noise(bench, refitted, noise, [start])
        if force is None:
            continue
        behind = beside.best - force.likelihood - sum(required[cause] for cause in causes)
        if behind < INSEPARABLE:
            terms = terms_at(bench, refitted.points[0], selection.trials.terms.curves)
            # Something is there: the causes were seen.
            if _chance_in(selection, refitted, force, dependences(refitted, noise, terms), 0.0) is not None:
                found[causes] = behind
    return found


def _chance_in(
    selection: Selection, refitted: Refits, force: ProcessNoise, tests: tuple[Dependence, ...], needed: float
) -> ProcessNoise | None:
    """Return a random force that shows in what a refit leaves, if that is chance.

    What repeats itself is none, nor what a term of free form, its price paid, explains beside another such force.

    Args:
        selection: of the refit.
        refitted: without the random force.
        force: what is left as one.
        tests: of what is left.
        needed: by how much it must be more likely than noise of the sensor.

    """
    bench, noise = selection.bench, selection.noise
    repeated = repeats_itself(bench, refitted.residual[0], noise)
    if repeated or not force.likelihood - force.of_sensor > needed:
        return None
    if _significant(tests):
        term, curve = missing_term(bench, refitted, noise, selection.seen, _suspects(tests))
        acting = told_by(bench, refitted, noise, curve)
        beside = process_noise(acting, refit(acting, refitted.points, refitted.chosen, noise), noise)
        if beside is not None and beside.best - _bayes_price(noise, term.pieces) > force.likelihood + INSEPARABLE:
            return None
    return force._replace(settled=repeated is False)


def _instead(
    selection: Selection, before: tuple[Dependence, ...], innocent: bool, left: MissingTerm | None
) -> tuple[MissingTerm | None, bool]:
    """Return a term of free form that explains the record as well as all causes together, and whether better.

    What the causes leave may have a term of free form too: one that follows anything is always better than causes that
    leave something. It is not better if the causes predict the unused data of any record better: what
    follows any data that it is refitted to must at least predict. What depends on time alone does not: no other record
    would have it. It is better than causes of which one is of this run alone too: it is the general form of those.
    """
    causes = selection.included
    if not before or not causes or (innocent and len(causes) == 1):
        return None, False
    bench, noise, nominal = selection.bench, selection.noise, selection.nominal
    term, curve = missing_term(bench, nominal, noise, selection.seen, _suspects(before))
    better = noise.gained(selection.final.residual[0], term.residual) + sum(_price(selection, i) for i in causes)
    least = INSEPARABLE
    if left is not None:
        # Beside a term in what they leave they must gain what they had to gain beside nothing.
        required = sum(need.required for need in selection.needs)
        beside = noise.gained(left.residual, term.residual) + _bayes_price(noise, left.pieces) + required
        better, least = min((better, INSEPARABLE), (beside, 0.0), key=lambda pair: pair[0] - pair[1])
    better -= _bayes_price(noise, term.pieces)
    of_run = any(bench.candidates[i].effect.of_run for i in causes)
    if (term.quantity == TIME and not of_run) or not better > least:
        return (term if better > -INSEPARABLE else None), False
    if term.quantity == TIME:
        return term, True
    with_it = nominal._replace(residual=term.residual[None])
    unused = predicted(bench, [()], [with_it], noise, lambda known: told_by(bench, nominal, known, curve))
    contradicted = [
        unused.noise.of_record(k).gained(unused.residual[0], selection.unused.residual[0])
        for k in range(len(bench.records))
    ]
    return term, max(contradicted) < INSEPARABLE


def _bayes_price(noise: Noise, numbers: float) -> float:
    return float(np.log(noise.measured.sum())) * numbers


def _price(selection: Selection, candidate: int) -> float:
    """Return Bayes' price for the numbers of a cause, and for the search where it has a frequency.

    A record fixes a frequency sharply: its information grows with the third power of the record's length (Djuric 1996,
    "A model selection rule for sinusoids in white Gaussian noise").
    """
    bench = selection.bench
    return _bayes_price(selection.noise, bench.numbers_of(candidate)) + bench.search_of(candidate)
