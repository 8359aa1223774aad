"""One look at what is left beside some causes: the refit with them, the noise, the scores of all other candidates."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ehsvjax.diagnosis.bench.evidence import PER_NUMBER, SIGNIFICANT
from ehsvjax.diagnosis.bench.noise import Noise
from ehsvjax.diagnosis.bench.refits import Refits
from ehsvjax.diagnosis.decision.trials import Trials
from ehsvjax.diagnosis.hypotheses.screening import Screening


class Stage(NamedTuple):
    """One look at what is left: the refit that it started from, the noise, and the candidates' scores.

    Its trials have the step that arithmetic needs there, and the readings that it knows.
    """

    trials: Trials
    included: tuple[int, ...]
    current: Refits
    noise: Noise
    screening: Screening

    @property
    def leaves_something(self) -> bool:
        """Whether a candidate is significant on what is left."""
        return bool(self.screening.ranked) and self.screening.ranked[0].corrected < SIGNIFICANT

    def required_gain(self, candidate: int) -> float:
        """Return the likelihood ratio that an effect must bring, in noise variances, for the search that found it."""
        bench = self.trials.bench
        if searched := bench.search_of(candidate):
            return searched - 2.0 * float(np.log(SIGNIFICANT)) + PER_NUMBER
        return self.screening.threshold**2 + PER_NUMBER * (bench.numbers_of(candidate) - 1)


def with_instead(included: Sequence[int], own: int, candidate: int) -> tuple[int, ...]:
    """Return effects with another in the place of one of them."""
    return tuple(candidate if j == own else j for j in included)


def all_but(included: Sequence[int], own: int) -> tuple[int, ...]:
    """Return effects but for one of them."""
    return tuple(j for j in included if j != own)
