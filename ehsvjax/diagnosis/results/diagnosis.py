"""The result of a diagnosis: verdict, causes, what could be there instead, the extended model, and its gain."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from ehsvjax.diagnosis.decision.search import Integration
from ehsvjax.diagnosis.decision.verdict import Alternative, leaves_something
from ehsvjax.diagnosis.hypotheses.missing import MissingTerm
from ehsvjax.diagnosis.hypotheses.process_noise import ProcessNoise
from ehsvjax.diagnosis.results.causes import Cause, Left
from ehsvjax.diagnosis.results.explanations import Explanation
from ehsvjax.diagnosis.results.gain import Gain
from ehsvjax.diagnosis.results.misfit import Misfit
from ehsvjax.draws import check_key
from ehsvjax.effects.effect import Effect
from ehsvjax.fit import Fit
from ehsvjax.models.model import Model
from ehsvjax.record import Record

if TYPE_CHECKING:
    import matplotlib.figure
    import pandas
    from jaxtyping import Array, Key

    from ehsvjax.experiment import Limits, Plan


class Excluded(NamedTuple):
    """An effect that a record excludes above a size, in the unit of the effect's first number."""

    cause: str
    above: float
    unit: str


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What a fitted model gets wrong on records, and why. Made by `diagnose`; print it.

    Attributes:
        verdict: "adequate", "named", "ambiguous" or "unexplained".
        causes: what is missing in the model, what gains most first: how sure, how large, which share of the misfit;
            empty unless named or ambiguous. `names` has their names.
        alternatives: for each cause that is not alone: all that could be there instead, itself among them.
        table: every candidate: signal, size, unit, score, p-values, likelihood gain, smallest size that the record
            could have shown, and what it is confounded with.
        significant_score: that the best of all candidates exceeds in 0.2% of records of noise; one-sided effects and
            waves, of which the frequency is searched, have their own.
        extended: the fit of the extended model; the refitted nominal one where nothing was found.
        gain: on data that were not used for fitting.
        misfit: what the nominal model gets wrong.
        excluded: effects that the record excludes, above which size.
        unseen: effects that the record cannot show at all, whatever their size.
        innocent: whether what the extended model leaves depends on nothing any more.
        undecided: whether it may be chance all the same, slow noise or a disturbance: only a repeat tells.
        missing: where something is left, the term that is missing, estimated without a form; where several causes
            were found, the one term that would explain the record as well, if there is one.
        process_noise: the random force that was found, if it is the cause.
        integration: the step that was needed, and what its arithmetic is worth.
        fit: the fit that was diagnosed.
        records: on which.
        explanations: what these records cannot tell apart, each as a fit: `next_experiment` tells how to.
        alone: of several records that leave something together, what each says by itself, if that explains every one of
            them. Where they do not all say what was found together, they disagree, and that is not named.

    """

    verdict: str
    causes: tuple[Cause, ...]
    alternatives: tuple[Alternative, ...]
    table: "pandas.DataFrame"
    significant_score: float
    extended: Fit
    gain: Gain
    misfit: Misfit
    excluded: tuple[Excluded, ...]
    unseen: tuple[str, ...]
    innocent: bool
    undecided: bool
    missing: MissingTerm | None
    process_noise: ProcessNoise | None
    integration: Integration
    fit: Fit
    records: tuple[Record, ...]
    explanations: tuple[Explanation, ...] = ()
    alone: tuple["Diagnosis", ...] = ()

    @property
    def record(self) -> Record:
        """The first of the records."""
        return self.records[0]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the causes."""
        return tuple(cause.name for cause in self.causes)

    @property
    def suspected(self) -> set[str]:
        """Names of the causes, and of all that could be there instead."""
        return {*self.names, *(name for group in self.alternatives for name in group.causes)}

    @property
    def leaves_something(self) -> bool:
        """Whether something is left that no cause explains: `missing` then acts beside them, else in their place."""
        return leaves_something(self.verdict, self.innocent)

    @property
    def left(self) -> Left:
        """What no cause explains: how much of it, where it shows, along what; see `missing` for its form."""
        test = None if self.innocent or not self.misfit.tests_after else self.misfit.tests_after[0]
        place, quantity, p_value = (None, None, 1.0) if test is None else (test.place, test.quantity, test.corrected)
        share, *by_record = (
            {name: 1.0 - g.share_removed for name, g in outputs.items()}
            for outputs in (self.gain.outputs, *self.gain.by_record)
        )
        return Left(share, tuple(by_record), self.innocent, place, quantity, p_value)

    def __str__(self) -> str:
        """Return the diagnosis in a few sentences."""
        from ehsvjax.diagnosis.results.words import sentences

        return "\n".join(sentences(self))

    __repr__ = __str__

    def plot(self) -> "matplotlib.figure.Figure":
        """Draw the misfit, the suspects, what the extended model leaves; returns the matplotlib figure."""
        from ehsvjax.diagnosis.results.pictures import plot_diagnosis

        return plot_diagnosis(self)

    def report(self, path: str | os.PathLike, plan: "Plan | None" = None) -> None:
        """Write one HTML page that needs no other file: misfit, suspects, verdict, extended model, gain, next step.

        Args:
            path: the file, `.html`; its folder is made if need be.
            plan: of the next experiment, which is then told and drawn there as well.

        Raises:
            ValueError: for what is no path or no plan.
            OSError: if it cannot be written; a file that was there stays as it was.

        """
        from ehsvjax.diagnosis.results.page import write_page

        write_page(self, path, plan)

    def next_experiment(
        self,
        limits: "Limits",
        *,
        key: "Key[Array, '']",
        can_change: Mapping[str, tuple[float, float]] | None = None,
        can_add: Mapping[str, float] | None = None,
        records: int = 1,
        own: Record | None = None,
        against: Mapping[str, float] | None = None,
        generations: int = 20,
    ) -> "Plan":
        """Return the experiment that would tell what these records cannot; see `ehsvjax.next_experiment`.

        The four most probable explanations of each cause are told from each other; where there are none, the forms that
        a missing term may have. With `against`, those are left aside: what is told is whether an effect of that size is
        there, which these records may not show.

        Args:
            limits: of the inputs, of outputs, of time.
            key: random key, `jax.random.key(0)`.
            can_change: name of a constant of the model -> (least, most) that the rig can be set to, SI.
            can_add: name of an output that could be measured too -> variance of its noise, its unit squared.
            records: how many short records may share the time.
            own: a record whose inputs are tried as well.
            against: number of an effect -> its size, SI: `{"coulomb_friction.force": 50.0}`; every number of an effect.
            generations: of the search.

        Raises:
            ValueError: where there is nothing to tell apart, and as `ehsvjax.next_experiment` does.

        """
        from ehsvjax.experiment import next_experiment
        from ehsvjax.experiment.limits import check_limits
        from ehsvjax.experiment.questions import doubts_of, undecided_of

        # Before anything is identified.
        check_limits(limits, self.fit.model)
        check_key(key)
        explanations, pairs = undecided_of(self, key) if against is None else doubts_of(self, against)
        return next_experiment(
            explanations, limits, key=key, can_change=can_change, can_add=can_add, records=records, own=own,
            pairs=pairs, generations=generations,
        )  # fmt: skip

    def with_missing_term(self, *, key: "Key[Array, '']") -> Fit:
        """Return the extended fit with the missing term in its simulation: straight pieces, identified with all else.

        Further from the truth than the noise, `missing` tells the term along a motion that is itself wrong; here it
        acts on the motion that it makes. What it is worth is seen like that of any fit, on records that were not used.

        Args:
            key: random key, `jax.random.key(0)`.

        Raises:
            ValueError: where nothing is missing, or what is depends on what the model does not know at its place, such
                as the time.

        """
        from ehsvjax.diagnosis.results.with_term import with_term
        from ehsvjax.effects.free_form import attachable

        check_key(key)
        if self.missing is None or not self.leaves_something:
            raise ValueError(f"expected a diagnosis that leaves something, got {self.verdict!r} with no missing term")
        term = attachable(self.missing.form, self.extended.model)
        if term is None:
            raise ValueError(
                f"expected a missing term that depends on what {self.extended.model.name} passes at "
                f"{self.missing.place}, got {self.missing.form}: write an effect (ehsvjax.effects.Effect) and diagnose "
                "again with it in the bank"
            )
        return with_term(self.extended, term, key)

    def save(self, path: str | os.PathLike) -> None:
        """Write the diagnosis, its fits and its record included, to one NPZ file without pickled content.

        Raises:
            OSError: if it cannot be written; a file that was there stays as it was.

        """
        from ehsvjax.storage import save_diagnosis

        save_diagnosis(self, path)

    @staticmethod
    def load(path: str | os.PathLike, model: Model | None = None, bank: Sequence[Effect] | None = None) -> "Diagnosis":
        """Read a diagnosis that `save` wrote: it prints, draws and reports the same.

        Args:
            path: the file.
            model: needed for a model of your own, as equations are not stored: the one that was fitted; those of this
                package are made again.
            bank: needed for an effect of your own, `(*ehsvjax.effects.BANK, my_effect)`.

        Raises:
            ValueError: if the file holds no diagnosis, was altered, or needs a model or an effect that was not handed
                over.
            OSError: if the file is not there or may not be read.

        """
        from ehsvjax.storage import load_diagnosis

        return load_diagnosis(path, model, bank)
