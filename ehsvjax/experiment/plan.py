"""The plan of a next experiment: what to do, and what it will tell. Made by `next_experiment`; print it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.diagnosis.bench.evidence import INSEPARABLE
from ehsvjax.experiment.separation import as_said, known_initial
from ehsvjax.fit import Fit
from ehsvjax.precision.design import design
from ehsvjax.precision.standard_errors import Precision
from ehsvjax.record import Record

if TYPE_CHECKING:
    import matplotlib.figure

Pair = tuple[str, str]


class Option(NamedTuple):
    """One experiment, and what it would tell.

    Attributes:
        words: what to do.
        records: inputs and constants of each; no outputs.
        outputs: names of those that are measured.
        separations: (true, other) -> noise variances by which the records so far and these would speak for the true
            one of two explanations, all else refitted.
        simple: whether it is one of a few plain ones, and not what the search came to.
        changed: how much is other than in the records so far: constants, sensors that are added, records beyond one.

    """

    words: str
    records: tuple[Record, ...]
    outputs: tuple[str, ...]
    separations: dict[Pair, float]
    simple: bool
    changed: int

    @property
    def probability(self) -> float:
        """Probability that a pair of explanations will be told apart, noise considered: the mean of all pairs."""
        pairs = by_pair(self.separations).values()
        return sum(map(told_apart, pairs)) / len(pairs)

    @property
    def total(self) -> float:
        """All of its separations together."""
        return sum(self.separations.values())


def told_apart(separation: float) -> float:
    """Return the probability that two explanations are told apart, from their separation in noise variances.

    What the records then say for the true one is normal about the separation, its deviation twice its root (the
    difference of two sums of squares along one direction of the noise).
    """
    if separation <= 0.0:
        return 0.0
    return NormalDist().cdf((separation - INSEPARABLE) / (2.0 * math.sqrt(separation)))


@dataclass(frozen=True, eq=False)
class Plan:
    """The next experiment. Made by `next_experiment`; print it.

    Attributes:
        chosen: what to do: the simplest of the options that tells enough, or what tells most.
        options: all that were worked out, the one that tells most first.
        same_again: what the first record once more would tell.
        today: (true, other) -> separation by the records so far.
        explanations: name -> fit.
        noise_variance: of each output that was measured or could be.

    """

    chosen: Option
    options: tuple[Option, ...]
    same_again: Option
    today: dict[Pair, float]
    explanations: dict[str, Fit]
    noise_variance: dict[str, float]

    @property
    def records(self) -> tuple[Record, ...]:
        """The records to be made: time, inputs and constants, without outputs; `to_csv` writes one for the rig."""
        return self.chosen.records

    @property
    def record(self) -> Record:
        """The first of them."""
        return self.records[0]

    @property
    def command(self) -> Float[np.ndarray, " time"]:
        """The first input of the first record, `[time]`, SI."""
        return next(iter(self.record.inputs.values()))

    def predicted(self, name: str) -> tuple[Record, ...]:
        """Return the chosen records with every output as an explanation says that it will be.

        Raises:
            ValueError: for a name that is no explanation's.

        """
        fit = self._explanation(name)
        return tuple(as_said(fit, self.records, fit.model.outputs))

    def precision(self, name: str) -> Precision:
        """Return the standard errors that an explanation's parameters would have by all records together.

        Raises:
            ValueError: for a name that is no explanation's.

        """
        fit = self._explanation(name)
        new = as_said(fit, self.records, self.chosen.outputs)
        names = {n for record in (*fit.records, *new) for n in record.outputs}
        return design(
            fit.model, [*fit.records, *new], parameters=fit.parameters, initial_values=fit.initial[0],
            noise_variance={n: v for n, v in self.noise_variance.items() if n in names},
            initial=known_initial(fit, len(fit.records), len(new)),
        )  # fmt: skip

    def _explanation(self, name: str) -> Fit:
        if name not in self.explanations:
            raise ValueError(f"expected one of {', '.join(self.explanations)}; got {name!r}")
        return self.explanations[name]

    def __str__(self) -> str:
        """Return what to do and what it will tell, in a few sentences."""
        return "\n".join(_sentences(self))

    __repr__ = __str__

    def plot(self) -> "matplotlib.figure.Figure":
        """Draw the chosen experiment and what each explanation says it will show; returns the matplotlib figure."""
        from ehsvjax.experiment.pictures import plot_plan

        return plot_plan(self)


def _sentences(plan: Plan) -> list[str]:
    chosen = plan.chosen
    lines = [f"Next: {chosen.words}.", ""]
    for (true, other), separation in by_pair(chosen.separations).items():
        before = min(plan.today.get((true, other), 0.0), plan.today.get((other, true), 0.0))
        probability = told_apart(separation)
        lines.append(
            f"  {true} against {other}: {separation:.3g} noise variances ({before:.2g} today): "
            + (f"told apart in {_share(probability)}" if probability >= 0.5 else _why_not(plan, true, other))
        )
    lines += ["", "  what else was tried, by the share of pairs that it tells apart, with its mean separation:"]
    others = [one for one in plan.options if one is not chosen][:_LISTED]
    for option in ranked([*others, plan.same_again]):
        mean = option.total / len(option.separations)
        lines.append(f"  {100 * option.probability:4.0f}%  {mean:9.3g}  {option.words}")
    return lines


def _why_not(plan: Plan, true: str, other: str) -> str:
    """Return why two explanations stay together, whatever was tried: too small to be seen, or followed by the other."""
    difference = sum(
        np.sum((one.outputs[name] - two.outputs[name]) ** 2) / plan.noise_variance[name]
        for one, two in zip(plan.predicted(true), plan.predicted(other), strict=True)
        for name in plan.chosen.outputs
    )
    if difference < INSEPARABLE:
        return "the noise hides it; wider limits or a longer record would show it, if anything does"
    return (
        f"hardly told apart, as the parameters of one can do what the other does ({difference:.3g} noise variances "
        "before they do); another sensor would tell, or a constant that can be changed, if anything does"
    )


def ranked(options: Sequence[Option]) -> tuple[Option, ...]:
    """Return options, the one that tells most first."""
    return tuple(sorted(options, key=lambda option: (-option.probability, -option.total)))


def by_pair(separations: Mapping[Pair, float]) -> dict[Pair, float]:
    """Return for each pair, whichever is true, the lesser of its separations."""
    found: dict[Pair, float] = {}
    for (true, other), separation in separations.items():
        if (other, true) in found:
            found[other, true] = min(found[other, true], separation)
        else:
            found[true, other] = separation
    return found


def _share(probability: float) -> str:
    if probability > 0.995:
        return "99 of 100 records and more"
    return f"{100 * probability:.0f} of 100 records"


def best_of(options: Sequence[Option]) -> Option:
    """Return the option to choose: the plainest that tells as much as any, to a hundredth of the pairs."""
    enough = max(option.probability for option in options) - _AS_MUCH
    return max(
        (option for option in options if option.probability >= enough),
        key=lambda option: (option.simple, -option.changed, option.total),
    )


# Options that a print tells of besides.
_LISTED = 5
# Share of the pairs of explanations by which one experiment may tell less than another and be preferred.
_AS_MUCH = 0.01
