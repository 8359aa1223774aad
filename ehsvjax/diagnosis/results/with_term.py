"""A fit with a term of free form: what no effect explains, identified in the simulation that it acts in."""

from typing import TYPE_CHECKING

from jaxtyping import Array, Key

from ehsvjax.diagnosis.bench.workbench import duration_of
from ehsvjax.effects.extended import DURATION, extended
from ehsvjax.effects.free_form import Attachable, FreeForm, attachable
from ehsvjax.fit import Fit
from ehsvjax.identify import identify

if TYPE_CHECKING:
    from ehsvjax.diagnosis.results.diagnosis import Diagnosis

# Individuals beside the one from which the model is refined.
_POPULATION = 20


def terms_that_act(diagnosis: "Diagnosis") -> list[tuple[FreeForm, Attachable]]:
    """Return the forms that what is left may have, of those that can act in another record, as effects."""
    missing = diagnosis.missing
    if missing is None or not diagnosis.leaves_something:
        return []
    forms = [(form, attachable(form, diagnosis.extended.model)) for form in (missing.form, *missing.alike)]
    return [(form, term) for form, term in forms if term is not None]


def with_term(plain: Fit, term: Attachable, key: Key[Array, ""]) -> Fit:
    """Return a fit of its model with a term, all identified anew from where both are known to be."""
    duration = plain.model.nominal.get(DURATION, duration_of(plain.records))
    model = extended(plain.model, (term.candidate,), term.numbers, duration)
    known = [{n: v for n, v in one.items() if n not in plain.estimated_initial} for one in plain.initial]
    return identify(
        model, plain.records, key=key, start=plain.parameters, initial=known, population=_POPULATION, generations=1,
        starts=1,
    )  # fmt: skip
