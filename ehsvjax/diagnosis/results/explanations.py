"""What could be there, each as an ordinary fit: what a next experiment has to tell apart."""

from typing import NamedTuple

from ehsvjax.diagnosis.decision.search import Selection
from ehsvjax.diagnosis.decision.verdict import PROCESS_NOISE, UNKNOWN, Verdict
from ehsvjax.diagnosis.results.extension import as_fit
from ehsvjax.fit import Fit


class Explanation(NamedTuple):
    """A model that explains the records about as well as the best one.

    Attributes:
        cause: name of the effect that it has where the best has its own.
        instead_of: the cause of the best explanation that stands there; `cause` itself for the best.
        probability: of the cause, against all that could be there instead.
        fit: of the model with it to the records.

    """

    cause: str
    instead_of: str
    probability: float
    fit: Fit


def explanations_of(selection: Selection, verdict: Verdict) -> tuple[Explanation, ...]:
    """Return the explanations that the records cannot tell apart, those of a group after each other, the best first.

    A random force and a term that the bank lacks are no models: they are not among them.
    """
    found = []
    for group, position in zip(verdict.groups, verdict.included, strict=True):
        names = set(group) - {PROCESS_NOISE, UNKNOWN}
        if position is None or len(names) < 2:
            continue
        rest = tuple(i for i in selection.included if i != position)
        for rival in selection.rivals[selection.included.index(position)]:
            name = selection.bench.candidates[rival.candidate].name
            # Of several forms of one effect the best stands for all.
            if name in names:
                names.remove(name)
                fit = as_fit(selection, rival.refitted, (*rest, rival.candidate))
                found.append(Explanation(name, next(iter(group)), group[name], fit))
    return tuple(found)
