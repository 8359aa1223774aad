"""A term whose form no effect has: a curve along one quantity, as records tell it, made an effect like any other."""

import functools
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ehsvjax.effects.effect import Candidate, Effect, amplitude, constant, input_named
from ehsvjax.effects.internal import contexts_of
from ehsvjax.models.model import Model, Parameter

# How such an effect is called: a term along something, a share of the value there, along the value itself; and how its
# numbers are, what acts at so much of that.
_TERM, _SHARE, _ITSELF, _AT = "term_along_", "share_along_", "itself", "at_"
# Knots at most, and the share of its height by which a curve of straight pieces between them may be off, or which is
# nothing: that is held as it is.
_KNOTS, _OFF, _NOTHING = 17, 0.02, 0.05
# How far from its estimate each may be, over the largest of them.
_REACH = 2.0


class FreeForm(NamedTuple):
    """What acts at a place as a function of one quantity.

    Attributes:
        place: signal at which it acts.
        quantity: that it depends on.
        at: `[knot]` ascending values of the quantity.
        estimate: `[knot]` what acts there, in the unit of the place.
        relative: whether the estimate is a share of the value at the place.

    """

    place: str
    quantity: str
    at: Float[np.ndarray, " knot"]
    estimate: Float[np.ndarray, " knot"]
    relative: bool

    def __str__(self) -> str:
        """Return where it acts, and along what."""
        return f"a term at {self.place}, as a function of {self.quantity}"


class Attachable(NamedTuple):
    """A term as an effect of a model, and its numbers, bounded about what they are."""

    candidate: Candidate
    numbers: dict[str, Parameter]


def attachable(form: FreeForm, model: Model) -> Attachable | None:
    """Return a term as an effect at its place in a model; None where the model does not know there what it depends on.

    Its numbers are what acts at the knots that its form needs: records tell them anew, in the simulation. Between knots
    the curve is straight; beyond them it stays as it is at the last one, and where there is nothing it stays that.
    """
    kind = next((s.kind for s in model.signals if s.name == form.place), None)
    there = (*contexts_of(model).get(form.place, ()), *(input_named(name) for name in model.inputs if kind == "sensor"))
    known = [name for name in (form.quantity, input_named(form.quantity)) if name in there]
    if kind is None or not (known or form.quantity == form.place):
        return None
    along = _ITSELF if form.quantity == form.place else known[0]
    kept = _needed(form)
    names = tuple(dict.fromkeys(_named(value) for value in form.at[kept].tolist()))
    estimate = np.interp([_value(name) for name in names], form.at, form.estimate)
    effect = _effect((_SHARE if form.relative else _TERM) + along, kind, names)
    candidate = Candidate(effect, form.place, f"{effect.name}@{form.place}")
    height = float(np.max(np.abs(estimate)))
    numbers = {}
    for number, value in zip(effect.parameters, estimate.tolist(), strict=True):
        name = candidate.parameter(number.name)
        unit = candidate.unit(number, model)
        nothing, reach = abs(value) < _NOTHING * height, _REACH * height
        numbers[name] = Parameter(name, name, unit, value, value - reach, value + reach, fixed=nothing, certain=nothing)
    return Attachable(candidate, numbers)


def _needed(form: FreeForm) -> list[int]:
    """Return which knots straight pieces need: the ends, then where they are furthest off with those before."""
    kept = [0, len(form.at) - 1]
    least = _OFF * float(np.max(np.abs(form.estimate)))
    while len(kept) < min(_KNOTS, len(form.at)):
        off = np.abs(form.estimate - np.interp(form.at, form.at[kept], form.estimate[kept]))
        if not off.max() > least:
            break
        kept = sorted({*kept, int(np.argmax(off))})
    return sorted(set(kept))


def effect_of_term(name: str, kind: str, numbers: tuple[str, ...]) -> Effect | None:
    """Return the effect of a term by its name, the kind of its signal and its numbers, which say it all; or None."""
    terms = name.startswith((_TERM, _SHARE)) and all(number.startswith(_AT) for number in numbers)
    return _effect(name, kind, numbers) if terms else None


@functools.cache
def _effect(name: str, kind: str, numbers: tuple[str, ...]) -> Effect:
    """Return the effect of a curve with these knots, the same object for the same ones."""
    relative = name.startswith(_SHARE)
    along = name.removeprefix(_SHARE if relative else _TERM)
    return Effect(
        name=name,
        kind=kind,
        parameters=tuple(amplitude(number, "" if relative else "{value}", constant(1e-3)) for number in numbers),
        apply=_Curve(along, numbers, relative),
        needs=() if along == _ITSELF else (along,),
        says="a term of a form that no effect has",
    )


def _named(value: float) -> str:
    """Return the name of what acts at a knot: its value to five digits, without a point."""
    mantissa, exponent = f"{value:.4e}".split("e")
    return f"{_AT}{mantissa.replace('.', '')}e{int(exponent) - 4}"


def _value(name: str) -> float:
    return float(name.removeprefix(_AT))


@dataclass(frozen=True)
class _Curve:
    """What the effect of a curve does: one of the same knots is compiled once."""

    along: str
    names: tuple[str, ...]
    relative: bool

    def __call__(self, own, value, context):
        quantity = jnp.asarray(value if self.along == _ITSELF else context[self.along], float)
        knots = jnp.asarray([_value(name) for name in self.names], quantity.dtype)
        here = jnp.stack([own[name] for name in self.names])
        added = jnp.interp(quantity, knots, here)
        return value + (value * added if self.relative else added)
