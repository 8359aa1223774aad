"""The result of a diagnosis: verdict, causes, what could be there instead, the extended model, and its gain."""

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from ehsvjax.diagnose.gain import Gain
from ehsvjax.diagnose.misfit import Misfit
from ehsvjax.diagnose.missing import MissingTerm
from ehsvjax.diagnose.process_noise import ProcessNoise
from ehsvjax.diagnose.selection import Integration
from ehsvjax.fit import Fit
from ehsvjax.record import Record

if TYPE_CHECKING:
    import pandas


class Alternative(NamedTuple):
    """Causes that a record cannot tell apart, the best first, and what would: an experiment or a sensor."""

    causes: tuple[str, ...]
    settled_by: str


class Excluded(NamedTuple):
    """An effect that a record excludes above a size, in the unit of the effect's first number."""

    cause: str
    above: float
    unit: str


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What a fitted model gets wrong on a record, and why. Made by `diagnose`; print it.

    Attributes:
        verdict: "adequate", "named", "ambiguous" or "unexplained".
        causes: names of the effects that are missing in the model, best first; empty unless named or ambiguous.
        alternatives: for each cause that is not alone: all that could be there instead, itself among them.
        table: every candidate: signal, size, unit, score, p-values, likelihood gain, smallest size that the record
            could have shown, and what it is confounded with.
        extended: the fit of the extended model; the refitted nominal one where nothing was found.
        gain: on data that were not used for fitting.
        misfit: what the nominal model gets wrong.
        excluded: effects that the record excludes, above which size.
        unseen: effects that the record cannot show at all, whatever their size.
        innocent: whether what the extended model leaves depends on nothing any more.
        missing: where something is left, the term that is missing, estimated without a form; where several causes
            were found, the one term that would explain the record as well, if there is one.
        process_noise: the random force that was found, if it is the cause.
        integration: the step that was needed, and what its arithmetic is worth.
        fit: the fit that was diagnosed.
        record: on which.

    """

    verdict: str
    causes: tuple[str, ...]
    alternatives: tuple[Alternative, ...]
    table: "pandas.DataFrame"
    extended: Fit
    gain: Gain
    misfit: Misfit
    excluded: tuple[Excluded, ...]
    unseen: tuple[str, ...]
    innocent: bool
    missing: MissingTerm | None
    process_noise: ProcessNoise | None
    integration: Integration
    fit: Fit
    record: Record

    def __str__(self) -> str:
        """Return the diagnosis in a few sentences."""
        from ehsvjax.diagnose.words import sentences

        return "\n".join(sentences(self))

    __repr__ = __str__

    def plot(self):
        """Draw the misfit, the suspects, what the extended model leaves; returns the matplotlib figure."""
        from ehsvjax.diagnose.pictures import plot_diagnosis

        return plot_diagnosis(self)

    def report(self, path: str | os.PathLike) -> None:
        """Write one HTML page that needs no other file: misfit, suspects, verdict, extended model, gain, next step."""
        from ehsvjax.diagnose.page import write_page

        write_page(self, path)
