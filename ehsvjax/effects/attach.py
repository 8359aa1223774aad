"""Attach effects to a model by name: for a person who knows what is missing."""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence

from ehsvjax.checks import as_number, by_name, instance, several
from ehsvjax.effects.effect import Candidate, Effect, candidates
from ehsvjax.effects.extended import DURATION, extended
from ehsvjax.effects.internal import contexts_of
from ehsvjax.effects.of_model import effects_for
from ehsvjax.models.model import Model, Parameter, as_bounds, check_bounds


def attach(
    model: Model,
    bounds: Mapping[str, tuple[float, float]],
    duration: float,
    bank: Sequence[Effect],
) -> Model:
    """Return the model with effects attached, to be identified like any other.

    Args:
        model: the model to extend.
        bounds: `effect.number` -> (lower, upper), SI, for every number of every effect that is to be attached;
            `effect@signal.number` where several signals of the model take the effect.
        duration: s over which drifts are counted, the record's.
        bank: where the effects are looked up, `ehsvjax.effects.BANK`.

    Raises:
        ValueError: for an effect that the bank does not have or no signal takes, several signals that take it, a number
            that it does not have or one without bounds, bounds that are none, an effect that the model has already, or
            a duration that is none or another than that of the model.

    """
    instance("model", model, Model, "make one, such as ehsvjax.servovalve()")
    bank = several("bank", bank, Effect, "pass ehsvjax.effects.BANK, or (*BANK, my_effect)")
    bounds = by_name("bounds", bounds, "{'sensor_bias.bias': (-1e-3, 1e-3)}")
    _check_duration(model, duration)
    if not bounds:
        raise ValueError(
            "expected bounds of an effect's numbers, such as {'sensor_bias.bias': (-1e-3, 1e-3)}; got none"
        )
    bank = (*bank, *effects_for(model))
    possible = candidates(model, bank, contexts_of(model), model.outputs)
    attached: dict[Candidate, dict[str, tuple[float, float]]] = {}
    for name in bounds:
        cause, _, number = name.rpartition(".")
        candidate = _candidate(model, possible, cause, number, bank)
        own = attached.setdefault(candidate, {})
        if number in own:
            raise ValueError(f"expected bounds of {candidate.parameter(number)} once, got them twice")
        own[number] = as_bounds(name, bounds[name])
    numbers = {}
    for candidate, given in attached.items():
        own_names = [p.name for p in candidate.effect.parameters]
        if set(given) != set(own_names):
            raise ValueError(
                f"expected bounds of every number of {candidate.name}, {', '.join(own_names)}; got "
                f"{', '.join(sorted(given))}"
            )
        for p in candidate.effect.parameters:
            name, (lower, upper) = candidate.parameter(p.name), given[p.name]
            if lower < 0.0 <= p.lower(defaultdict(lambda: 1.0)):
                raise ValueError(f"expected {name} to be bounded by zero or more, got a lower bound of {lower}")
            absent = p.absent if p.absent is not None else 0.5 * (lower + upper)
            value = min(max(absent, lower), upper)
            numbers[name] = Parameter(name, name, candidate.unit(p, model), value, lower, upper)
            check_bounds(numbers[name])
    return extended(model, tuple(attached), numbers, duration)


def _check_duration(model: Model, duration: float) -> None:
    if not 0.0 < (as_number(duration) or 0.0) < math.inf:
        raise ValueError(f"expected the duration of the record, positive seconds, got {duration!r}")
    counted = model.nominal.get(DURATION, duration)
    if counted != duration:
        raise ValueError(
            f"expected the duration over which {model.name} counts its drifts, {counted} s; got {duration}"
        )


def _candidate(
    model: Model, possible: Sequence[Candidate], cause: str, number: str, bank: Sequence[Effect]
) -> Candidate:
    """Return the candidate that is meant by a name with or without a signal, and by the number of the effect."""
    name, _, place = cause.partition("@")
    forms = [e for e in bank if e.name == name and number in {p.name for p in e.parameters}]
    if not forms:
        known = ", ".join(sorted({f"{e.name}.{p.name}" for e in bank for p in e.parameters}))
        raise ValueError(f"expected an effect and one of its numbers, got {cause}.{number}; the bank has {known}")
    found = [c for c in possible if c.effect in forms and place in ("", c.signal)]
    if not found:
        wanted = ", ".join(sorted({" with ".join((e.kind, *e.needs)) for e in forms}))
        there = f": it has {cause} already" if f"{cause}.{number}" in model.nominal else ", got none"
        raise ValueError(f"expected a signal of {model.name} of kind {wanted} for {cause}{there}")
    if len(found) > 1:
        raise ValueError(f"expected {cause} to say at which signal it acts, one of {', '.join(c.name for c in found)}")
    return found[0]
