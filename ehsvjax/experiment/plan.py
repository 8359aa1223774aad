"""The plan of a next experiment: what to do, and what it will tell. Made by `next_experiment`; print it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.diagnosis.bench.evidence import INSEPARABLE
from ehsvjax.fit import Fit
from ehsvjax.record import Record

if TYPE_CHECKING:
    import matplotlib.figure

Pair = tuple[str, str]


class Option(NamedTuple):
    """One experiment, and what it would tell.

    Attributes:
        words: what to do.
        record: its inputs and constants; no outputs.
        outputs: names of those that are measured in it.
        separations: (true, other) -> noise variances by which the records so far and this one would speak for the
            true one of two explanations, all else refitted.
        simple: whether it is one of a few plain ones, and not what the search came to.
        changed: how many constants are other than in the records so far.

    """

    words: str
    record: Record
    outputs: tuple[str, ...]
    separations: dict[Pair, float]
    simple: bool
    changed: int

    @property
    def least(self) -> float:
        """The least of its separations: of the two explanations that it tells apart worst."""
        return min(self.separations.values())

    @property
    def hardest(self) -> Pair:
        """The (true, other) explanations that it tells apart worst."""
        return min(self.separations, key=lambda pair: self.separations[pair])

    @property
    def probability(self) -> float:
        """Probability that the least separated pair will be told apart, noise considered."""
        return told_apart(self.least)


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

    """

    chosen: Option
    options: tuple[Option, ...]
    same_again: Option
    today: dict[Pair, float]
    explanations: dict[str, Fit]

    @property
    def record(self) -> Record:
        """The record to be made: time, inputs and constants, without outputs."""
        return self.chosen.record

    @property
    def command(self) -> Float[np.ndarray, " time"]:
        """The first input of the record, `[time]`, SI."""
        return next(iter(self.chosen.record.inputs.values()))

    def predicted(self, name: str) -> dict[str, Float[np.ndarray, " time"]]:
        """Return what an explanation says that the chosen experiment will show, output -> `[time]`, SI.

        Raises:
            ValueError: for a name that is no explanation's.

        """
        if name not in self.explanations:
            raise ValueError(f"expected one of {', '.join(self.explanations)}; got {name!r}")
        fit = self.explanations[name]
        return fit.simulate(self.chosen.record, fit.initial[0])

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
    for (true, other), separation in _by_pair(chosen.separations).items():
        before = min(plan.today.get((true, other), 0.0), plan.today.get((other, true), 0.0))
        lines.append(
            f"  {true} against {other}: {separation:.3g} noise variances ({before:.2g} today): "
            f"told apart in {_share(told_apart(separation))}"
        )
    if told_apart(chosen.least) < 0.5:
        lines.append("  nothing within these limits tells them apart: give wider ones, a longer record, another sensor")
    lines += ["", "  what else was tried, by the pair that it tells apart worst:"]
    others = [option for option in (*plan.options, plan.same_again) if option is not chosen]
    lines += [f"  {option.least:8.3g}  {option.words}" for option in sorted(others, key=lambda o: -o.least)]
    return lines


def _by_pair(separations: Mapping[Pair, float]) -> dict[Pair, float]:
    """Return the lesser of a pair's two separations."""
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
    """Return the option to choose: the plainest that tells enough, or nearly all that any tells."""
    best = max(options, key=lambda option: option.least)
    enough = min(_ENOUGH, _NEARLY * best.least)
    return max(
        (option for option in options if option is best or (option.simple and option.least >= enough)),
        key=lambda option: (option.simple, -option.changed, option.least),
    )


# Noise variances that are as good as any: two explanations are then told apart in 99.9% of all records.
_ENOUGH = 60.0
# Share of the best separation for which a plain experiment is preferred.
_NEARLY = 0.8
