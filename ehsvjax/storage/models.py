"""Models and effects in files: their numbers and names; their equations are found again, or handed over."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

from ehsvjax.effects import BANK
from ehsvjax.effects.effect import Effect
from ehsvjax.effects.extended import extended
from ehsvjax.effects.free_form import effect_of_term
from ehsvjax.effects.of_model import effect_of_model
from ehsvjax.models.model import Equations, Model
from ehsvjax.models.servovalve import servovalve
from ehsvjax.models.van_der_pol import van_der_pol

MAKERS: dict[str, Callable[..., Model]] = {"servovalve": servovalve, "van_der_pol": van_der_pol}
"""The models of this package."""


def describe_model(model: Model, encoded: Callable[[Any], Any]) -> dict[str, Any]:
    """Return all that a model says but its equations, and what made those; `encoded` gives JSON forms of values."""
    maker = _maker_of(model)
    # Equations are code, and so is what a parameter is tied by.
    code = (*Equations._fields, "ties")
    numbers = {name: value for name, value in _fields_of(model).items() if name not in code}
    if maker is None:
        # How a user's model was made is the user's own.
        del numbers["options"]
    return {"maker": maker, "numbers": {name: encoded(value) for name, value in numbers.items()}}


def find_model(described: Mapping[str, Any], decoded: Callable[[Any], Any], model: Model | None) -> Model:
    """Return a described model with its equations.

    Args:
        described: as `describe_model` gave it.
        decoded: gives values from their JSON forms.
        model: that whose equations they are, with all of the effects or with the first; None for one of this package.

    Raises:
        ValueError: if the model is a user's own and none is handed over, or one that has other parameters or signals.

    """
    numbers = {name: decoded(value) for name, value in described["numbers"].items()}
    if model is None and described["maker"] not in MAKERS:
        raise ValueError(f"{numbers['name']!r}, a model that is not of this package: hand it over, .load(path, model)")
    base = _made(described["maker"], numbers["options"]) if model is None else model
    own = {p.name: p for p in numbers["parameters"]}
    for layer in numbers["layers"][len(base.layers) :]:
        if not all(c.parameter(p.name) in own for c in layer for p in c.effect.parameters):
            raise ValueError(f"{numbers['name']!r} with the parameters {', '.join(own)}, which its effects lack")
        # Every number is set to the stored one below, the duration among them.
        base = extended(base, layer, own, 1.0)
    for kind in ("parameters", "initial", "signals"):
        stored, there = ([one.name for one in ones] for ones in (numbers[kind], getattr(base, kind)))
        if sorted(stored) != sorted(there):
            raise ValueError(
                f"{numbers['name']!r}, of which {kind} are {', '.join(stored)}; those of the model are "
                f"{', '.join(there)}: hand over the model that was fitted"
            )
    # The equations take the inputs in the order of their model's signals.
    return replace(base, **numbers | {"signals": base.signals})


def describe_effect(effect: Effect) -> dict[str, Any]:
    """Return by what an effect is found again: its name, the kind of signal, its numbers, and whose it is."""
    known = effect in BANK or effect == _of_this_package(*_key(effect))
    return {"key": _key(effect), "own": not known}


def find_effect(described: Mapping[str, Any], bank: Sequence[Effect]) -> Effect:
    """Return a described effect.

    Args:
        described: as `describe_effect` gave it.
        bank: with the user's own effects, if it is one of those; those of this package are known.

    Raises:
        ValueError: if the bank does not have it.

    """
    for effect in [e for e in bank if e not in BANK] if described["own"] else BANK:
        if _key(effect) == described["key"]:
            return effect
    name, kind, numbers = described["key"]
    found = None if described["own"] else _of_this_package(name, kind, numbers)
    if found is not None:
        return found
    raise ValueError(
        f"an effect {name!r} on signals of kind {kind!r} with the numbers {', '.join(numbers)}, which the bank does "
        "not have: hand it over, .load(path, bank=(*ehsvjax.effects.BANK, my_effect))"
    )


def _of_this_package(name: str, kind: str, numbers: Sequence[str]) -> Effect | None:
    """Return an effect that this package makes of a model, or of what a record leaves."""
    return effect_of_model(name, kind, numbers) or effect_of_term(name, kind, tuple(numbers))


def _maker_of(model: Model) -> str | None:
    """Return the name of what makes the model's equations again, these very functions; None if nothing does."""
    own = {p.name: p for p in model.parameters}
    for name in MAKERS:
        try:
            made = _made(name, model.options)
            for layer in model.layers:
                made = extended(made, layer, own, 1.0)
        except (KeyError, TypeError, ValueError):
            continue
        if made.equations == model.equations:
            return name
    return None


def _made(maker: str, options: Sequence[tuple[str, Any]]) -> Model:
    return MAKERS[maker](**{name: value for name, value in options if name != "effects"})


def _fields_of(model: Model) -> dict[str, Any]:
    return {field.name: getattr(model, field.name) for field in fields(model)}


def _key(effect: Effect) -> list[Any]:
    return [effect.name, effect.kind, [p.name for p in effect.parameters]]
