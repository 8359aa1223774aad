"""A model with effects attached: a model like any other."""

import functools
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from ehsvjax.checks import instance
from ehsvjax.effects.effect import Candidate, input_named
from ehsvjax.models.model import Equations, Model, Parameter, Signal, identity

DURATION = "record_duration"
"""Constant of an extended model: the time over which a drift is counted, s."""


class ExtendedState(NamedTuple):
    """The model's own state, the steps and the time since the record's start, and the effects' memories by their names.

    The time is that of the steps taken: added up in single precision it would be a percent off after some minutes.
    """

    state: Any
    steps: Any
    time: Any
    memories: dict[str, Any]


def extended(
    model: Model,
    attached: Sequence[Candidate],
    parameters: Mapping[str, Parameter],
    duration: float,
    disturbed: Sequence[str] = (),
    switched: bool = False,
) -> Model:
    """Return the model with effects attached at its signals.

    Its further parameters are the effects' own numbers, `name.number`; a model that is extended already is extended
    further. The same equations with the same effects are compiled once.

    Args:
        model: the model to extend.
        attached: effects at signals of it.
        parameters: of each number of the effects by its name in the model: value and bounds.
        duration: s over which drifts are counted.
        disturbed: signals to which a series of any form can be added: the model has an input `disturbance(name)` for
            each of them.
        switched: whether each effect can be skipped: the model has a constant `switch(candidate)` for each that acts on
            what runs along a signal; where it is zero the effect is not computed.

    """
    equations = _equations(model.equations, tuple(attached), tuple(disturbed), switched)
    constants = [] if any(p.name == DURATION for p in model.parameters) else [
        Parameter(DURATION, "T", "s", duration, 0.0, 1e9, fixed=True, certain=True),
    ]  # fmt: skip
    if switched:
        constants += [Parameter(name, "on", "", 1.0, 0.0, 1.0, fixed=True, certain=True) for name in switches(attached)]
    own = tuple(parameters[c.parameter(p.name)] for c in attached for p in c.effect.parameters)
    # An end stop on either side is the same effect twice.
    names = tuple(dict.fromkeys([*effects_of(model), *(c.name for c in attached)]))
    others = (option for option in model.options if option[0] != "effects")
    return replace(
        model,
        signals=(*model.signals, *(Signal(disturbance(place), "input", "") for place in disturbed)),
        name=f"{model.name.partition(' with ')[0]} with {', '.join(names)}",
        parameters=(*model.parameters, *constants, *own),
        start=equations.start,
        stepper=equations.stepper,
        measure=equations.measure,
        prepare=equations.prepare,
        options=(*others, ("effects", names)),
        layers=(*model.layers, tuple(attached)),
    )


def disturbance(signal: str) -> str:
    """Name of the input that is added to a signal."""
    return f"disturbance of {signal}"


def switch(candidate: Candidate) -> str:
    """Name of the constant that is zero where an effect is skipped; that of the two forms of one effect is the same."""
    return f"whether {candidate.name} acts"


def switches(attached: Sequence[Candidate]) -> dict[str, list[Candidate]]:
    """Return the effects on what runs along the model's signals, by the constant that skips them."""
    return _by([c for c in attached if c.effect.kind not in ("parameter", "constant")], switch)


def _by(attached: Sequence[Candidate], key: Callable[[Candidate], str]) -> dict[str, list[Candidate]]:
    found: dict[str, list[Candidate]] = {}
    for candidate in attached:
        found.setdefault(key(candidate), []).append(candidate)
    return found


def effects_of(model: Model) -> tuple[str, ...]:
    """Return the names of the effects that a model was extended by.

    Raises:
        ValueError: for what is no model.

    """
    instance("model", model, Model, "make one, such as ehsvjax.servovalve()")
    return tuple(name for key, names in model.options if key == "effects" for name in names)


@functools.cache
def _equations(base: Equations, attached: tuple[Candidate, ...], places: tuple[str, ...], switched: bool) -> Equations:
    """Return the equations with effects, the same objects for the same effects."""
    inputs = _by([c for c in attached if c.effect.kind == "input"], lambda c: c.signal)
    given_wrong = tuple(c for c in attached if c.effect.kind == "constant")
    drifting = tuple(c for c in attached if c.effect.kind == "parameter")
    remembering = tuple(c for c in attached if c.effect.memory and c.effect.kind != "input")
    sensors = [c for c in remembering if c.signal in base.outputs]
    sensing = {_slot(c) for c in sensors}
    inside = {_slot(c) for c in remembering} - sensing
    names = (*base.inputs, *(disturbance(place) for place in places))
    at_signal = _by(
        [c for c in attached if c.effect.kind not in ("input", "parameter", "constant")], lambda c: c.signal
    )

    def own_of(candidate, parameters):
        return {p.name: parameters[candidate.parameter(p.name)] for p in candidate.effect.parameters}

    def added_by(series):
        return {place: series[disturbance(place)] for place in places}

    def disturbing(parameters, signal, current):
        """Return the signal function with the effects behind it, at the moment that `current` holds."""

        def disturbed(name, value, **context):
            value = signal(name, value, **context)
            (moment,) = current
            if name in moment.added:
                value = value + moment.added[name]
            context |= {"duration": parameters[DURATION], "time": moment.time, "step_size": moment.step_size}
            if name in base.outputs:
                context |= {input_named(key): held for key, held in moment.values.items()}
            for candidate in at_signal.get(name, ()):
                value = behind(candidate, parameters, value, context, moment)
            return value

        return disturbed

    def behind(candidate, parameters, value, context, moment):
        """Return the value behind an effect, whose memory moves on; both as they are where the effect is skipped."""
        apply, own = candidate.effect.apply, own_of(candidate, parameters)
        if not candidate.effect.memory:
            (value,) = where_on(parameters, [candidate], lambda value: (apply(own, value, context),), value)
            return value
        slot = _slot(candidate)
        remembered = moment.memories[slot]
        value, memory = where_on(
            parameters, [candidate], lambda *both: apply(own, both[0], context, both[1]), value, remembered
        )
        moment.remember(slot, memory)
        return value

    def where_on(parameters, effects, function, *operands):
        """Return what the function makes of the operands, or these themselves where none of the effects acts."""
        if not switched:
            return function(*operands)
        acting = functools.reduce(operator.or_, [parameters[name] > 0.0 for name in switches(effects)])
        typed = jax.tree.map(lambda a, b: jnp.asarray(a, b.dtype), operands, jax.eval_shape(function, *operands))
        return lax.cond(acting, function, lambda *operands: operands, *typed)

    def corrected(parameters):
        changed = dict(parameters)
        for c in given_wrong:
            changed[c.signal] = c.effect.apply(own_of(c, parameters), changed[c.signal], {})
        return changed

    def drifted(parameters, time):
        if not drifting:
            return parameters
        context = {"duration": parameters[DURATION], "time": time}
        changed = dict(parameters)
        for c in drifting:
            changed[c.signal] = c.effect.apply(own_of(c, parameters), changed[c.signal], context)
        return changed

    def start(parameters, initial, series):
        parameters = corrected(parameters)
        state = base.start(parameters, initial, series)
        memories = {_slot(c): tuple(jnp.asarray(m) for m in c.effect.memory) for c in remembering}
        moment = _Moment(0.0, 0.0, memories, sensing, values=series)
        if sensing:
            base.measure(parameters, state, series, disturbing(parameters, identity, [moment]))
        return ExtendedState(state, jnp.int32(0), 0.0, moment.memories)

    def stepper(parameters, step_size, signal):
        parameters = corrected(parameters)
        # Without drifts what does not change is computed once; signals outside the time loop have no memory.
        outside = _Moment(0.0, step_size, {}, set())
        current = [outside]
        disturbed = disturbing(parameters, signal, current)
        steady = None if drifting else base.stepper(parameters, step_size, disturbed)

        def step(state, series):
            added = added_by(series(0.0)) if places else {}
            # What depends on time is held over the step: at its middle that is right to second order.
            middle = (state.steps + 0.5) * step_size
            # A model that was extended before shows its sensors' memories their outputs within the step.
            current[0] = _Moment(middle, step_size, state.memories, inside, added, series(0.5))
            now = drifted(parameters, middle)
            once = base.stepper(now, step_size, disturbed) if steady is None else steady
            following = once(state.state, series)
            time = (state.steps + 1) * step_size
            memories = current[0].memories
            if sensing:
                ahead = series(1.0)

                def sensed(memories):
                    current[0] = _Moment(time, step_size, memories, sensing, added_by(ahead), ahead)
                    base.measure(now, following, ahead, disturbed)
                    return (current[0].memories,)

                (memories,) = where_on(parameters, sensors, sensed, memories)
            return ExtendedState(following, state.steps + 1, time, memories)

        return step

    def measure(parameters, state, series, signal):
        # The memories have moved on to this moment: no time is left for them to do so.
        parameters = corrected(parameters)
        moment = _Moment(state.time, 0.0, state.memories, set(), added_by(series), series)
        disturbed = disturbing(parameters, signal, [moment])
        return base.measure(drifted(parameters, state.time), state.state, series, disturbed)

    def prepare(parameters, series, sample_period):
        parameters = corrected(parameters)
        changed = {} if base.prepare is None else base.prepare(parameters, series, sample_period)
        some = next(iter(series.values()))
        samples = jnp.arange(len(some), dtype=some.dtype)
        time = sample_period * jnp.stack([samples, samples + 0.5, samples + 1.0], axis=-1)
        context = {"duration": parameters[DURATION], "time": time, "sample_period": sample_period}
        for name, effects in inputs.items():
            course = changed.get(name, series[name])
            for candidate in effects:
                course = behind(candidate, parameters, course, context, None)
            changed = changed | {name: course}
        return changed

    return base._replace(
        start=start, stepper=stepper, measure=measure, prepare=prepare if inputs else base.prepare, inputs=names
    )


def _slot(candidate: Candidate) -> str:
    """Where the memory of an effect is kept: two forms of one effect share their name, but no number."""
    return candidate.parameter(candidate.effect.parameters[0].name)


class _Moment:
    """The time and the memories at one moment, while a step is traced; a signal's first call moves its memory on."""

    def __init__(self, time, step_size, memories, moving, added=None, values=None):
        self.time, self.step_size, self.memories, self._moving = time, step_size, dict(memories), set(moving)
        self.added, self.values = added or {}, values or {}

    def remember(self, name, memory):
        if name in self._moving:
            self._moving.discard(name)
            self.memories[name] = memory
