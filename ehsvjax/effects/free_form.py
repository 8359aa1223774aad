"""A term whose form no effect has: a curve along one quantity, as records tell it, made an effect like any other."""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ehsvjax.effects.effect import Candidate, Effect, amplitude, constant, input_named
from ehsvjax.effects.internal import contexts_of
from ehsvjax.models.model import Model, Parameter

# Knots of the effect, each a number that is identified, at most.
_KNOTS = 16
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

    Its numbers are what acts at some of the knots: records tell the form anew, in the simulation that it acts in.
    Between its knots the curve is straight; beyond them it stays as it is at the last one.
    """
    kind = next((s.kind for s in model.signals if s.name == form.place), None)
    there = (*contexts_of(model).get(form.place, ()), *(input_named(name) for name in model.inputs if kind == "sensor"))
    known = [name for name in (form.quantity, input_named(form.quantity)) if name in there]
    if kind is None or not (known or form.quantity == form.place):
        return None
    along = None if form.quantity == form.place else known[0]
    # As many of its knots between each two: they lie where the samples do.
    kept = np.unique(np.linspace(0, len(form.at) - 1, min(len(form.at), _KNOTS)).round().astype(int))
    at, estimate = form.at[kept], form.estimate[kept]
    names = [f"at_knot_{k}" for k in range(len(at))]
    unit = "" if form.relative else "{value}"
    effect = Effect(
        name=f"term_along_{form.quantity}",
        kind=kind,
        parameters=tuple(amplitude(name, unit, constant(1e-3)) for name in names),
        apply=_Curve(along, tuple(at.tolist()), tuple(names), form.relative),
        needs=() if along is None else (along,),
        says="a term of a form that no effect has",
    )
    candidate = Candidate(effect, form.place, f"{effect.name}@{form.place}")
    reach = _REACH * float(np.max(np.abs(estimate)))
    numbers = {}
    for number, value in zip(effect.parameters, estimate.tolist(), strict=True):
        name = candidate.parameter(number.name)
        unit = candidate.unit(number, model)
        numbers[name] = Parameter(name, name, unit, value, value - reach, value + reach)
    return Attachable(candidate, numbers)


@dataclass(frozen=True)
class _Curve:
    """The effect of a curve: those of the same knots are compiled once."""

    along: str | None
    at: tuple[float, ...]
    names: tuple[str, ...]
    relative: bool

    def __call__(self, own, value, context):
        quantity = jnp.asarray(value if self.along is None else context[self.along], float)
        knots, here = jnp.asarray(self.at, quantity.dtype), jnp.stack([own[name] for name in self.names])
        added = jnp.interp(quantity, knots, here)
        return value + (value * added if self.relative else added)
