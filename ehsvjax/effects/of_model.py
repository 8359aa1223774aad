"""Effects that only a model can name: a constant that was given wrong or changed, an input that a sensor shows."""

import functools
import math
from collections.abc import Collection, Sequence

from ehsvjax.effects.effect import CHANGE, Effect, EffectParameter, amplitude, input_named, off_by_error, relative_error
from ehsvjax.models.model import Model

_FEEDTHROUGH = "feedthrough_of_"
# Shares by which an idle parameter may be off, in half decades.
_ERRORS_TRIED = tuple(10.0 ** (k / 2) - 1.0 for k in (-4, -3, -2, -1, 1, 2, 3, 4))


def effects_for(model: Model, held: Collection[str] = (), idle: Collection[str] = ()) -> tuple[Effect, ...]:
    """Return the candidate causes that no bank can hold, as their names are the model's.

    A constant of zero that is a signal of the diagram too has the effects of that signal's kind.

    Args:
        model: the model.
        held: free parameters that their bounds hold: what a bound says may be as wrong as a constant.
        idle: free parameters that change nothing between their bounds, and may do so beyond them.

    """
    signals = {s.name for s in model.signals}
    constants = [p for p in model.parameters if p.fixed and not p.certain and "." not in p.name]
    return (
        *(_off(p.name) if p.value else _there(p.name) for p in constants if p.value or p.name not in signals),
        *(_off(name) for name in held),
        *(_off(name, idle=True) for name in idle),
        *(_feedthrough(name) for name in model.inputs),
    )


def differences_for(model: Model) -> tuple[Effect, ...]:
    """Return the candidate causes of what differs between records: each parameter and constant, each sensor's zero."""
    return (
        *(_changed(p.name) for p in model.parameters if p.value and not p.certain and "." not in p.name),
        _zero(),
    )


def effect_of_model(name: str, kind: str, numbers: Sequence[str]) -> Effect | None:
    """Return the effect that `effects_for` gives for some model under that name; None for any other effect."""
    if kind == "sensor" and name.startswith(_FEEDTHROUGH):
        return _feedthrough(name.removeprefix(_FEEDTHROUGH))
    if kind == "sensor" and name == _zero().name:
        return _zero()
    if kind == "constant" and name.startswith(CHANGE):
        return _changed(name.removeprefix(CHANGE))
    if kind == "constant":
        return next((e for e in (_off(name), _there(name)) if [p.name for p in e.parameters] == list(numbers)), None)
    return None


@functools.cache
def _feedthrough(name: str) -> Effect:
    """Return the effect of an input that a sensor shows at once, the same object for the same input."""
    there = input_named(name)
    return Effect(
        f"{_FEEDTHROUGH}{name}",
        "sensor",
        (amplitude("gain", "", lambda s: 1e-3 * s["value"] / max(s[there], 1e-300)),),
        lambda own, y, context: y + own["gain"] * context[there],
        needs=(there,),
        says="the sensor shows a part of the input at once",
        settled_by="declare how the input runs between samples (hold); or a step while the plant is held still",
    )


@functools.cache
def _off(name: str, idle: bool = False) -> Effect:
    """Return the effect of a constant that is off by a share of what was given, the same object for the same name.

    Of what is idle no small error shows what a large one would do.
    """
    error = relative_error(usual=math.inf)
    return Effect(
        name,
        "constant",
        (error._replace(tries=lambda scales: _ERRORS_TRIED) if idle else error,),
        off_by_error,
        says="a constant of the model is another than was given",
        settled_by=_settled_by(name),
    )


@functools.cache
def _there(name: str) -> Effect:
    """Return the effect of a constant that was given as zero and is not, the same object for the same name."""
    number = EffectParameter(
        "value", "{value}", 0.0, lambda s: min(s["least"], 0.0), lambda s: s["value"],
        lambda s: [share * s["value"] for share in (1e-4, 1e-2, 0.3)], usual=math.inf,
    )  # fmt: skip
    return Effect(
        name,
        "constant",
        (number,),
        lambda own, value, context: value + own["value"],
        says="a constant of the model is there, and was given as zero",
        settled_by=_settled_by(name),
    )


@functools.cache
def _changed(name: str) -> Effect:
    """Return the effect of a parameter that changed between records, the same object for the same name."""
    return Effect(
        f"{CHANGE}{name}",
        "constant",
        (relative_error(),),
        off_by_error,
        says="a parameter is another in every record",
        settled_by=f"measure it in every record, and say so: record.at({name}=...)",
        by_record=True,
    )


@functools.cache
def _zero() -> Effect:
    """Return the effect of a sensor whose zero is another in every record."""
    return Effect(
        "change_of_zero",
        "sensor",
        (amplitude("bias", "{value}", lambda scales: 1e-3 * scales["value"]),),
        lambda own, y, context: y + own["bias"],
        says="the sensor's zero is another in every record",
        settled_by="a gauge of the true zero before every record",
        by_record=True,
    )


def _settled_by(name: str) -> str:
    return f"measure it, or free it: bounds={{{name!r}: ...}}"
