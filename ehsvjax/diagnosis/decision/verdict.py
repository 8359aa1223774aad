"""The verdict: adequate, named, ambiguous or unexplained, with the causes and what could be there instead."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ehsvjax.diagnosis.bench.evidence import INSEPARABLE, probabilities
from ehsvjax.diagnosis.bench.workbench import Workbench
from ehsvjax.diagnosis.decision.examination import Examination
from ehsvjax.diagnosis.decision.search import Need, Selection
from ehsvjax.diagnosis.hypotheses.process_noise import ProcessNoise
from ehsvjax.readings import lattice

QUANTISATION = "sensor_quantisation"
PROCESS_NOISE = "process_noise"
UNKNOWN = "unknown_term"
"""What no effect of the bank is: in one record it may look like chance, or like what does not predict another."""
# Step of the readings' lattice, in deviations of the other noise, beyond which it is a cause.
_COARSEST = 2.2


class Alternative(NamedTuple):
    """Causes that a record cannot tell apart, the best first, and what would: an experiment or a sensor.

    `probabilities` are those of the causes in turn; what is left to one is that of nothing, or of any other.
    """

    causes: tuple[str, ...]
    settled_by: str
    probabilities: tuple[float, ...]


class Verdict(NamedTuple):
    """What is said, and of what.

    Attributes:
        word: "adequate", "named", "ambiguous" or "unexplained".
        groups: for each cause all that could be there instead, itself first: name -> probability; what gains most
            first. A cause that is alone is one that the records tell from all others.
        included: position of the effect of each group; None for what is no effect of the bank.
        alternatives: the groups of more than one.

    """

    word: str
    groups: tuple[dict[str, float], ...]
    included: tuple[int | None, ...]
    alternatives: tuple[Alternative, ...]


UNEXPLAINED = Verdict("unexplained", (), (), ())
"""That something is missing, and nothing is named."""


def leaves_something(word: str, innocent: bool) -> bool:
    """Whether something is left that no cause explains, by the verdict's word and whether what is left is innocent."""
    return word == "unexplained" or not innocent


def may_be_unknown(innocent: bool, chance: ProcessNoise | None) -> bool:
    """Whether what is left may be what the bank lacks: something is left, or a force that was not seen to be chance."""
    return not innocent or (chance is not None and not chance.settled)


def verdict_of(examined: Examination, predicted_by: Sequence[float]) -> Verdict:
    """Return the verdict, with the causes and what could be there instead.

    Args:
        examined: the causes, and what they leave.
        predicted_by: of each cause, the share of what is left without it of data that were not used that it removes.

    """
    selection, bench = examined.selection, examined.selection.bench
    order = np.argsort([-need.gain for need in selection.needs]).tolist()
    groups = [_group(examined, k) for k in order]
    if may_be_unknown(examined.innocent, examined.chance):
        groups = [_or_unknown(g, predicted_by[k]) for k, g in zip(order, groups, strict=True)]
    if examined.lacking or not (examined.innocent or groups):
        return UNEXPLAINED
    others = [{name: 1.0} for name in _quantised(selection)]
    if examined.chance:
        named = {next(iter(group)) for group in groups}
        doubted = {name: behind for name, behind in examined.doubted.items() if name not in named}
        others.append(_chance(examined.chance, doubted))
    included = (*(selection.included[k] for k in order), *(None for _ in others))
    every = (*groups, *others)
    if not every:
        return Verdict("adequate", (), (), ())
    alternatives = tuple(
        Alternative(tuple(g), _settled_by(bench, tuple(g)), tuple(g.values())) for g in every if len(g) > 1
    )
    return Verdict("ambiguous" if alternatives else "named", every, included, alternatives)


def _or_unknown(group: Mapping[str, float], predicted_by: float) -> dict[str, float]:
    """Return a group with what the bank lacks as one of it, which may be what a cause is taken for.

    As likely as the group where that predicts nothing, and less by what it leaves where it does: what explains half of
    what was wrong may be a part of what all of it is.
    """
    left = 1.0 - predicted_by
    if not left > np.exp(-0.5 * INSEPARABLE):
        return dict(group)
    return {name: p / (1.0 + left) for name, p in group.items()} | {UNKNOWN: left / (1.0 + left)}


def _group(examined: Examination, k: int) -> dict[str, float]:
    """Return what could be there as one of the causes, the best first, with probabilities.

    Against each other, against a random force in its place or that of them all, and against nothing.
    """
    selection = examined.selection
    rivals, need = selection.rivals[k], selection.needs[k]
    deficits = [rival.deficit for rival in rivals]
    chance_behind = examined.chance_behind[k]
    every = probabilities([*deficits, chance_behind, _nothing_behind(need)])
    found: dict[str, float] = {}
    for rival, probable in zip(rivals, every, strict=False):
        name = selection.bench.candidates[rival.candidate].name
        if rival.deficit < INSEPARABLE:
            found[name] = found.get(name, 0.0) + float(probable)
    if np.isfinite(chance_behind):
        found[PROCESS_NOISE] = float(every[len(rivals)])
    return found


def _nothing_behind(need: Need) -> float:
    """Return by how much nothing at all explains the records worse than a cause does, its search paid."""
    return need.gain - need.required


def _chance(chance: ProcessNoise, doubted: Mapping[str, float]) -> dict[str, float]:
    """Return what may be there of chance, and what chance explains better without being told from it.

    Unless the experiment was repeated, nothing speaks for chance against a term that the bank lacks.
    """
    names = sorted(doubted, key=lambda name: doubted[name])
    likely, *others = probabilities([0.0, *(doubted[name] for name in names)]).tolist()
    alone = {PROCESS_NOISE: likely} if chance.settled else {PROCESS_NOISE: likely / 2.0, UNKNOWN: likely / 2.0}
    return alone | dict(zip(names, others, strict=True))


def _quantised(selection: Selection) -> tuple[str, ...]:
    samples, observed = selection.bench.problem.samples, selection.bench.problem.observed
    coarse: dict[str, None] = {}
    for k, noises in enumerate(selection.noise.of):
        for i, name in enumerate(observed):
            step = lattice(samples.outputs[k, :, i][samples.measured[k, :, i]])
            if step is not None and step**2 > _COARSEST**2 * (noises[i].variance - step**2 / 12.0):
                coarse[name] = None
    return tuple(QUANTISATION if len(observed) == 1 else f"{QUANTISATION}@{name}" for name in coarse)


def _settled_by(bench: Workbench, group: tuple[str, ...]) -> str:
    ways = {c.name: c.effect.settled_by for c in bench.candidates if c.effect.settled_by}
    ways[PROCESS_NOISE] = "the same experiment again: chance does not repeat itself"
    ways[UNKNOWN] = "another record, or a longer one, which causes that are there predict"
    return "; ".join(dict.fromkeys(f"{name}: {ways[name]}" for name in group if name in ways))
