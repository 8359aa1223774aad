"""What a diagnosis leaves open, as explanations to be told apart."""

import itertools
from collections.abc import Mapping
from dataclasses import replace

from jaxtyping import Array, Key

from ehsvjax.checks import by_name, number
from ehsvjax.diagnosis.bench.workbench import duration_of
from ehsvjax.diagnosis.results.diagnosis import Diagnosis
from ehsvjax.diagnosis.results.with_term import terms_that_act, with_term
from ehsvjax.effects import BANK, attach
from ehsvjax.effects.extended import DURATION
from ehsvjax.experiment.plan import Pair
from ehsvjax.fit import Fit
from ehsvjax.models.model import Model

# Of a group, the most probable.
_MOST = 4
NOTHING_MORE = "nothing more"
"""The explanation that has no effect of a size that is asked about."""


def undecided_of(diagnosis: Diagnosis, key: Key[Array, ""]) -> tuple[dict[str, Fit], list[Pair]]:
    """Return the explanations that a diagnosis cannot tell apart, and the pairs: those of one cause among themselves.

    Where no cause has another in its place and something is missing, the forms that explain it alike.

    Raises:
        ValueError: where there are none.

    """
    explanations: dict[str, Fit] = {}
    pairs: list[Pair] = []
    causes = dict.fromkeys(one.instead_of for one in diagnosis.explanations)
    for cause in causes:
        group = [one for one in diagnosis.explanations if one.instead_of == cause]
        likely = sorted(group, key=lambda one: -one.probability)[:_MOST]
        names = [one.cause if one.cause == cause or len(causes) == 1 else f"{one.cause} for {cause}" for one in likely]
        explanations |= {name: one.fit for name, one in zip(names, likely, strict=True)}
        pairs += itertools.permutations(names, 2)
    if not pairs:
        explanations = _terms_of(diagnosis, key)
        pairs = list(itertools.permutations(explanations, 2))
    if not pairs:
        raise ValueError(
            f"expected a diagnosis with causes that the records cannot tell apart, got {diagnosis.verdict!r} without: "
            "ask about an effect that they may not show, against={'coulomb_friction.force': 50.0}"
        )
    return explanations, pairs


def _terms_of(diagnosis: Diagnosis, key: Key[Array, ""]) -> dict[str, Fit]:
    """Return the forms that a missing term may have, each beside what was found; not those that go by the clock."""
    terms = terms_that_act(diagnosis)[:_MOST]
    return {str(form): with_term(diagnosis.extended, term, key) for form, term in terms} if len(terms) > 1 else {}


def doubts_of(diagnosis: Diagnosis, against: Mapping[str, float]) -> tuple[dict[str, Fit], list[Pair]]:
    """Return the extended fit as it is, and with each effect that is asked about.

    What has the effect contains what has not: only where it is there can the two be told apart.

    Raises:
        ValueError: for an effect or a number that there is none of.

    """
    sizes: dict[str, dict[str, float]] = {}
    for name, size in by_name("against", against, "{'coulomb_friction.force': 50.0}").items():
        sizes.setdefault(name.rpartition(".")[0], {})[name] = number(name, size, remedy="give its size, SI")
    if not sizes:
        raise ValueError("expected against to name an effect's numbers and sizes, got none")
    plain = diagnosis.extended
    explanations = {NOTHING_MORE: plain}
    for cause, numbers in sizes.items():
        reach = {name: _around(size) for name, size in numbers.items()}
        duration = plain.model.nominal.get(DURATION, duration_of(diagnosis.records))
        model = attach(plain.model, reach, duration, BANK)
        explanations[cause] = replace(plain, model=_fixed(model, numbers))
    return explanations, [(cause, NOTHING_MORE) for cause in sizes]


def _around(size: float) -> tuple[float, float]:
    return (0.0, 2.0 * size) if size > 0.0 else (2.0 * size, 0.0) if size < 0.0 else (-1.0, 1.0)


def _fixed(model: Model, values: Mapping[str, float]) -> Model:
    parameters = tuple(
        p._replace(value=values[p.name], fixed=True) if p.name in values else p for p in model.parameters
    )
    return replace(model, parameters=parameters)
