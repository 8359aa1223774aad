"""Attach effects to a model by name: for a person who knows what is missing."""

from collections.abc import Mapping, Sequence

from ehsvjax.effects.effect import Candidate, Effect
from ehsvjax.effects.extended import extended
from ehsvjax.models.model import Model, Parameter


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
            that it does not have, or one without bounds.

    """
    attached: dict[str, Candidate] = {}
    for name in bounds:
        cause, _, number = name.rpartition(".")
        if cause not in attached:
            attached[cause] = _candidate(model, cause, number, bank)
    numbers = {}
    for cause, candidate in attached.items():
        own = [p.name for p in candidate.effect.parameters]
        given = {n.rpartition(".")[2] for n in bounds if n.rpartition(".")[0] == cause}
        if given != set(own):
            raise ValueError(
                f"expected bounds of every number of {cause}, {', '.join(own)}; got {', '.join(sorted(given))}"
            )
        for p in candidate.effect.parameters:
            name = candidate.parameter(p.name)
            lower, upper = bounds[name]
            absent = p.absent if p.absent is not None else 0.5 * (lower + upper)
            unit = candidate.unit(p, model)
            numbers[name] = Parameter(name, name, unit, min(max(absent, lower), upper), lower, upper)
    return extended(model, tuple(attached.values()), numbers, duration)


def _candidate(model: Model, cause: str, number: str, bank: Sequence[Effect]) -> Candidate:
    name, _, place = cause.partition("@")
    found = [e for e in bank if e.name == name and number in {p.name for p in e.parameters}]
    if not found:
        known = ", ".join(sorted({f"{e.name}.{p.name}" for e in bank for p in e.parameters}))
        raise ValueError(f"expected an effect and one of its numbers, got {cause}.{number}; the bank has {known}")
    places = [
        (effect, s.name)
        for effect in found
        for s in model.signals
        if s.kind == effect.kind and place in ("", s.name)
    ]  # fmt: skip
    places += [(e, p) for e in found if e.kind == "parameter" for p in model.free if place in ("", p)]
    if not places:
        kinds = ", ".join(sorted({e.kind for e in found}))
        raise ValueError(f"expected a signal of {model.name} of kind {kinds} for {cause}, got none")
    if len(places) > 1:
        names = ", ".join(f"{name}@{p}" for _, p in places)
        raise ValueError(f"expected {cause} to say at which signal it acts, one of {names}")
    ((effect, signal),) = places
    return Candidate(effect, signal, cause)
