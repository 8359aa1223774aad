"""What an effect is: a disturbance of one named signal of a model, with parameters that can make it vanish."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ehsvjax.checks import as_number, by_name, function, instance, label, number, positive, refused, several, text
from ehsvjax.models.model import KINDS, Model, check_kind

Scales = Mapping[str, Any]
"""How large things are in a record: `value`, the largest size of the signal itself (of a constant how large it can be,
and the `least` that it can), and of each quantity of its context by name (0 where nothing is known), with `+` or `-`
behind the name how far it goes on that side; `duration` and `sample_period` in s, `frequencies` in rad/s at which a
harmonic effect would explain most, and `probe`, a disturbance of a force that moves the machine by `PROBED`."""
PROBED = 1e-4
"""Share of an output's size by which a probe moves it."""


def input_named(name: str) -> str:
    """Return the name of an input's value in the context of a sensor."""
    return f"input {name}"


ALWAYS = ("time", "step_size", "duration")
"""Quantities that every effect's context has."""
UNLIMITED = 1e30
"""A limit that nothing reaches."""


class EffectParameter(NamedTuple):
    """One number of an effect.

    Attributes:
        name: in the field's terms, `coefficient`.
        unit: SI; `{value}` in it stands for the unit of the signal, `{length}` for that of the model's position.
        absent: the value with which the effect is not there, if this parameter makes it vanish: 0 for an amplitude,
            `UNLIMITED` for a limit; None for a shape (a frequency, a width) that means nothing without the amplitude.
        lower, upper: the least and the largest value that make sense, from the scales; an amplitude with a lower bound
            of zero has one sign.
        tries: values that the screening simulates, from the scales: one small probe for an amplitude whose effect is
            proportional to it, several for one whose effect is not, or for a shape.
        usual: how far from `absent` it usually is at most, beyond which it is rare: `inf` where any value is as usual
            as another; None where nothing is known.
        relative: whether it is the share by which something is off: what is known is known by its factor, so that it
            is looked for by the logarithm of that, along which a product of two unknowns is a straight line.

    """

    name: str
    unit: str
    absent: float | None
    lower: Callable[[Scales], float]
    upper: Callable[[Scales], float]
    tries: Callable[[Scales], Sequence[float]]
    usual: float | None = None
    relative: bool = False

    def rarity(self, value: float) -> float:
        """Return from 0 to 1 how rare a value is: a half where it is as far as usual, or where nothing is known.

        However far, it is no more than rare (Geman & McClure 1987, "Statistical methods for tomographic image
        reconstruction", for the form).
        """
        if self.usual is None or self.absent is None:
            return 0.5
        off = (value - self.absent) / self.usual
        return off**2 / (1.0 + off**2)


@dataclass(frozen=True)
class Effect:
    """A candidate cause: what it does to a signal of one kind.

    Attributes:
        name: in the field's terms, `transport_delay`.
        kind: of the signals at which it can act, `Signal.kind`; "parameter", for the value of a free parameter as time
            passes; or "constant", for a constant that may have been given wrong.
        parameters: its own numbers.
        apply: `apply(own, value, context)` returns the disturbed value; `own` are its numbers by name, `context` what
            the model passes with the signal and `time` s, `step_size` s, `duration` s of the record. With a memory:
            `apply(own, value, context, memory)` returns the value and the new memory. For an input the value is all
            that it does, `[time, node]`: at the start, in the middle and at the end of every sample period.
        needs: names of quantities that the context must hold; the effect is no candidate where it does not. One that
            needs the `time` is of its run: in each of several records it has amplitudes of its own.
        memory: what it remembers at the start, scalars; NaN is a good mark for "nothing yet". The memory moves on once
            a step, by the value at its start.
        says: what it is, in half a sentence.
        settled_by: the experiment or the sensor that tells it from what looks like it.
        by_record: whether it is a difference between records: its amplitudes are others in every one.

    """

    name: str
    kind: str
    parameters: tuple[EffectParameter, ...]
    apply: Callable[..., Any]
    needs: tuple[str, ...] = ()
    memory: tuple[float, ...] = ()
    says: str = ""
    settled_by: str = ""
    by_record: bool = False

    @property
    def of_run(self) -> bool:
        """Whether it goes by the clock of a record, or by the record: its amplitudes then are others in every one."""
        return self.by_record or "time" in self.needs

    @property
    def harmonic(self) -> bool:
        """Whether one of its numbers is a frequency that has to be found."""
        return any(p.name == "frequency" for p in self.parameters)

    def __post_init__(self):
        """Refuse an effect that could never vanish, and what cannot be an effect.

        Raises:
            ValueError: if it has no number that makes it vanish, or two of one name, a kind that is all but a known
                one, or a field of another type.

        """
        _check_fields(self)
        names = [p.name for p in self.parameters]
        if all(p.absent is None for p in self.parameters):
            raise ValueError(
                f"expected {self.name} to have a number that makes it vanish, such as amplitude(...); got "
                f"{', '.join(names) or 'no number'}"
            )
        if len(set(names)) < len(names):
            raise ValueError(f"expected every number of {self.name} to have its own name, got {', '.join(names)}")


def _check_fields(effect: Effect) -> None:
    if "@" in label("the name of an effect", effect.name):
        raise refused("the name of an effect", "free of @, behind which a signal is named", effect.name, "leave it out")
    check_kind(effect.name, effect.kind, (*KINDS, "parameter", "constant"))
    several(
        f"parameters of {effect.name}", effect.parameters, EffectParameter, "make each by amplitude(...) or shape(...)"
    )
    function(f"apply of {effect.name}", effect.apply, "apply(own, value, context) -> value")
    for name in several(f"needs of {effect.name}", effect.needs, str, 'give names, such as ("position", "velocity")'):
        label(f"every name in needs of {effect.name}", name)
    if not isinstance(effect.memory, tuple | list) or None in map(as_number, effect.memory):
        raise refused(
            f"memory of {effect.name}", "a tuple of numbers", effect.memory, "give what it remembers at the start"
        )
    text(f"says of {effect.name}", effect.says)
    text(f"settled_by of {effect.name}", effect.settled_by)
    for number_of in effect.parameters:
        where = f"of a number of {effect.name}"
        if "." in label(f"the name {where}", number_of.name):
            raise refused(
                f"the name {where}", "free of points, behind which it is named", number_of.name, "leave it out"
            )
        text(f"the unit {where}", number_of.unit)
        if number_of.absent is not None:
            number(f"absent {where}", number_of.absent)
        if number_of.usual not in (None, np.inf):
            positive(f"usual {where}", number_of.usual, "give inf where any value is as usual as another")
        for field in ("lower", "upper", "tries"):
            function(
                f"{field} {where}", getattr(number_of, field), "of the scales: lambda scales: 0.1 * scales['value']"
            )


class Candidate(NamedTuple):
    """An effect at one signal of a model, and the name under which it is reported there."""

    effect: Effect
    signal: str
    name: str

    def parameter(self, own: str) -> str:
        """Name of one of the effect's numbers among the parameters of an extended model."""
        return f"{self.name}.{own}"

    def unit(self, number: EffectParameter, model: Model) -> str:
        """Unit of one of the effect's numbers; none where the model is dimensionless at the signal."""
        at_parameter = self.effect.kind in ("parameter", "constant")
        unit = model.parameter(self.signal).unit if at_parameter else model.unit(self.signal)
        if "{value}" in number.unit and not unit:
            return ""
        found = number.unit.replace("{value}", unit).replace("{length}", length_unit(model))
        return found.replace("/s s", "")


def length_unit(model: Model) -> str:
    """Unit in which a model counts its position: that of the signal of this name, or of all its sensors."""
    units = {s.unit for s in model.signals if s.name == "position"} or {
        s.unit for s in model.signals if s.kind == "sensor"
    }
    unit = next(iter(units)) if len(units) == 1 else "m"
    return unit if unit.isalnum() or not unit else f"({unit})"


CHANGE = "change_of_"
"""How the name of an effect begins that a constant of this name is another in every record."""


def constant_of(effect: Effect) -> str:
    """Return the constant at which an effect of that kind acts; its name says which."""
    return effect.name.removeprefix(CHANGE)


def candidates(
    model: Model, bank: Sequence[Effect], contexts: Mapping[str, Collection[str]], observed: Collection[str]
) -> tuple[Candidate, ...]:
    """Return every effect of the bank at every signal of the model that takes it and could show it.

    What the model was extended by already is left out. The name of a candidate is the effect's, followed by `@signal`
    where more than one signal takes effects of this name.

    Args:
        model: the model.
        bank: effects; two of one name are two forms of it.
        contexts: for each signal that the model passes values through, the names in its context.
        observed: the outputs that are measured: an effect on the sensor of another could not show.

    Raises:
        ValueError: for what is no model, no effects, no mapping or no names.

    """
    instance("model", model, Model, "make one, such as ehsvjax.servovalve()")
    bank = several("bank", bank, Effect, "pass ehsvjax.effects.BANK, or (*BANK, my_effect)")
    contexts = by_name(
        "contexts", instance("contexts", contexts, Mapping, "give names by signal"), "{'load': ['velocity']}"
    )
    if (
        isinstance(observed, str)
        or not isinstance(observed, Collection)
        or not all(isinstance(o, str) for o in observed)
    ):
        raise refused("observed", "names of outputs", observed, "give them in a tuple")
    inputs = {input_named(name) for name in model.inputs}

    def takes(effect, signal):
        if signal.kind != effect.kind or (signal.kind == "sensor" and signal.name not in observed):
            return False
        there = {*contexts.get(signal.name, ()), *ALWAYS, *(inputs if signal.kind == "sensor" else ())}
        return signal.kind == "input" or (signal.name in contexts and set(effect.needs) <= there)

    # A valve's flow gain drifts at its opening; to let its other parameters drift, its transfer function would have
    # to be set up anew at every step.
    own = [p for p in model.free if "." not in p]
    drifting = [] if any(s.kind == "opening" for s in model.signals) else own
    found = []
    for effect in bank:
        elsewhere = {"parameter": drifting, "constant": [constant_of(effect)]}
        places = elsewhere.get(effect.kind) or [s.name for s in model.signals if takes(effect, s)]
        found += [(effect, place) for place in places]
    places_of: dict[str, set[str]] = {}
    for effect, place in found:
        places_of.setdefault(effect.name, set()).add(place)
    named = [
        Candidate(effect, place, effect.name if len(places_of[effect.name]) == 1 else f"{effect.name}@{place}")
        for effect, place in found
    ]
    there = {p.name for p in model.parameters}

    def has(candidate):
        # The name says the signal only where there was a choice, which depends on the outputs that are measured.
        names = (candidate.effect.name, f"{candidate.effect.name}@{candidate.signal}")
        return any(f"{name}.{p.name}" in there for name in names for p in candidate.effect.parameters)

    return tuple(c for c in named if not has(c))


def constant(value: float) -> Callable[[Scales], float]:
    """Return a bound that does not depend on scales."""
    return lambda scales: value


def _no_more(scales: Scales) -> float:
    del scales
    return UNLIMITED


def _no_less(scales: Scales) -> float:
    del scales
    return -UNLIMITED


def amplitude(
    name: str,
    unit: str,
    probe: Callable[[Scales], float],
    lower: Callable[[Scales], float] = _no_less,
    upper: Callable[[Scales], float] = _no_more,
    usual: float | None = None,
) -> EffectParameter:
    """Return a number to which the effect is proportional, at least while it is small.

    Raises:
        ValueError: for a probe that is no function of the scales.

    """
    function("probe", probe, "of the scales: lambda scales: 1e-3 * scales['value']")
    return EffectParameter(name, unit, 0.0, lower, upper, lambda scales: (probe(scales),), usual)


def relative_error(usual: float | None = None) -> EffectParameter:
    """Return by what share something is more than it is taken for.

    It is a million times as much at most, or a millionth, as where a unit was mistaken.
    """
    number = amplitude("error", "", constant(1e-3), constant(1e-6 - 1.0), constant(1e6 - 1.0), usual)
    return number._replace(relative=True)


def off_by_error(own: Mapping[str, Any], value: Any, context: Mapping[str, Any]) -> Any:
    """Return a value that is more by its `relative_error`."""
    del context
    return value * (1.0 + own["error"])


def size(
    name: str,
    unit: str,
    probe: Callable[[Scales], float],
    upper: Callable[[Scales], float] = _no_more,
) -> EffectParameter:
    """Return an amplitude that is never negative."""
    return amplitude(name, unit, probe, constant(0.0), upper)


def width(name: str, unit: str, tries: Sequence[float]) -> EffectParameter:
    """Return a width, from nothing to the signal's size, whose effect is not proportional to it; shares of that size.

    Raises:
        ValueError: for tries that are no positive numbers.

    """
    tries = _shares(tries)
    return EffectParameter(
        name, unit, 0.0, constant(0.0), lambda s: s["value"], lambda s: [t * s["value"] for t in tries]
    )


def limit(name: str, unit: str, tries: Sequence[float], lower: float = 0.02) -> EffectParameter:
    """Return a level that the signal does not pass; shares of the signal's size.

    Raises:
        ValueError: for tries that are no positive numbers, or a lower bound that is not from 0 to 1.

    """
    tries, lower = _shares(tries), number("lower", lower, "from 0 to 1", lambda x: 0.0 <= x <= 1.0)
    return EffectParameter(
        name,
        unit,
        UNLIMITED,
        lambda s: lower * s["value"],
        lambda s: 1.02 * s["value"],
        lambda s: [t * s["value"] for t in tries],
    )


def _shares(tries: Sequence[float]) -> list[float]:
    if not isinstance(tries, tuple | list | np.ndarray) or not len(tries):
        raise refused(
            "tries", "a list of positive numbers", tries, "give shares of the signal's size, such as [0.01, 0.1]"
        )
    return [positive("each of tries", share, "give shares of the signal's size") for share in tries]


def shape(
    name: str,
    unit: str,
    tries: Callable[[Scales], Sequence[float]],
    lower: Callable[[Scales], float],
    upper: Callable[[Scales], float],
) -> EffectParameter:
    """Return a number that means nothing while the amplitude is zero."""
    return EffectParameter(name, unit, None, lower, upper, tries)
