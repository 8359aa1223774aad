"""Effects that only a model can name: a constant that was given wrong, an input that reaches a sensor by itself."""

import functools

from ehsvjax.effects.effect import Effect, EffectParameter, amplitude, constant, input_named
from ehsvjax.models.model import Model, Parameter


def effects_for(model: Model) -> tuple[Effect, ...]:
    """Return the candidate causes that no bank can hold, as their names are the model's."""
    return (*given_wrong(model), *(feedthrough(name, len(model.inputs) == 1) for name in model.inputs))


@functools.cache
def feedthrough(name: str, alone: bool) -> Effect:
    """Return the effect of an input that a sensor shows at once, the same object for the same input."""
    there = input_named(name)
    return Effect(
        "feedthrough" if alone else f"feedthrough_of_{name}",
        "sensor",
        (amplitude("gain", "", lambda s: 1e-3 * s["value"] / max(s[there], 1e-300)),),
        lambda own, y, context: y + own["gain"] * context[there],
        needs=(there,),
        says="the sensor shows a part of the input at once",
        settled_by="declare how the input runs between samples (hold); or a step while the plant is held still",
    )


def given_wrong(model: Model) -> tuple[Effect, ...]:
    """Return for each constant of a model that is not certain the effect that it is another than was given.

    A constant of zero that is a signal of the diagram too has the effects of that signal's kind.
    """
    signals = {s.name for s in model.signals}
    return tuple(
        _off(p.name) if p.value else _there(p)
        for p in model.parameters
        if p.fixed and not p.certain and "." not in p.name and (p.value or p.name not in signals)
    )


@functools.cache
def _off(name: str) -> Effect:
    """Return the effect of a constant that is off by a share of what was given, the same object for the same name."""
    return Effect(
        name,
        "constant",
        (amplitude("error", "", constant(1e-3), constant(-0.9), constant(9.0)),),
        _scaled,
        says="a constant of the model is another than was given",
        settled_by=_settled_by(name),
    )


@functools.cache
def _there(parameter: Parameter) -> Effect:
    """Return the effect of a constant that was given as zero and is not."""
    largest = max(abs(parameter.lower), abs(parameter.upper))
    lower = constant(parameter.lower if parameter.lower < 0.0 else 0.0)
    tries = [share * largest for share in (1e-4, 1e-2, 0.3)]
    number = EffectParameter("value", "{value}", 0.0, lower, constant(largest), lambda scales: tries)
    return Effect(
        parameter.name,
        "constant",
        (number,),
        _shifted,
        says="a constant of the model is there, and was given as zero",
        settled_by=_settled_by(parameter.name),
    )


def _scaled(own, value, context):
    del context
    return value * (1.0 + own["error"])


def _shifted(own, value, context):
    del context
    return value + own["value"]


def _settled_by(name: str) -> str:
    return f"measure it, or free it: bounds={{{name!r}: ...}}"
