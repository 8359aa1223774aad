"""A fit with a term of free form: what no effect explains, identified in the simulation that it acts in."""

from jaxtyping import Array, Key

from ehsvjax.diagnosis.bench.workbench import duration_of
from ehsvjax.effects.extended import DURATION, extended
from ehsvjax.effects.free_form import FreeForm, attachable
from ehsvjax.fit import Fit
from ehsvjax.identify import identify

# Individuals beside the one from which the model is refined.
_POPULATION = 20


def with_term(plain: Fit, form: FreeForm, key: Key[Array, ""]) -> Fit | None:
    """Return a fit of its model with a term, all identified anew; None where the model cannot have that term."""
    term = attachable(form, plain.model)
    if term is None:
        return None
    duration = plain.model.nominal.get(DURATION, duration_of(plain.records))
    model = extended(plain.model, (term.candidate,), term.numbers, duration)
    known = [{n: v for n, v in one.items() if n not in plain.estimated_initial} for one in plain.initial]
    return identify(
        model, plain.records, key=key, start=plain.parameters, initial=known, population=_POPULATION, generations=1,
        starts=1,
    )  # fmt: skip
