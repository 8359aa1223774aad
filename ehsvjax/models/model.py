"""What a model is: parameters, named signals, and the equations of one individual over one step.

A model is a block diagram written for one individual. Its equations are three plain functions that take the values
of all parameters as a dict `name -> scalar`:

    start(parameters, initial, inputs) -> state                    the state at the first sample
    stepper(parameters, step_size, signal) -> step                 step(state, inputs) -> state, one step later
    measure(parameters, state, inputs, signal) -> outputs          dict of every output, at the sample itself

`stepper` is called once per individual, outside the time loop: what does not change from step to step is computed
there. In `step`, `inputs(fraction)` gives the inputs at that fraction of the step, as a dict. Every line of the
diagram that physics could disturb passes through `signal(name, value, **context)`, the identity of the nominal model;
the context is what an effect there may depend on (a force: `position=`, `velocity=`).

A fourth, `prepare(parameters, inputs, sample_period) -> changed`, may change inputs as a whole beforehand: by name,
what they are at the start, in the middle and at the end of every sample period, `[time, node]`; it returns those that
are others then.
"""

import difflib
import functools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from ehsvjax.checks import (
    as_number,
    by_name,
    choice,
    flag,
    function,
    label,
    number,
    positive,
    several,
    text,
)

State = Any
Inputs = Callable[[float], dict[str, Any]]


class Parameter(NamedTuple):
    """One number of a model: an unknown with bounds, or a constant (`fixed=True`).

    `value` is the nominal value, used where the parameter is fixed; `scale` says in which coordinate the search moves:
    "log" for positive quantities known by their order of magnitude. For an initial condition, `output` names the output
    whose first samples tell about where it lies, if that output is measured: the search begins there. The bounds stand,
    but where those samples lie beyond them; bounds given to `identify` stand in any case. A constant is taken to be
    what it is given as, and may have been given wrong: `diagnose` tries that too, unless it is `certain`. `prior` is
    what is known of an unknown beforehand, its mean and its standard deviation, as if it had been measured so.
    """

    name: str
    symbol: str
    unit: str
    value: float
    lower: float
    upper: float
    scale: Literal["linear", "log"] = "linear"
    fixed: bool = False
    output: str | None = None
    certain: bool = False
    prior: tuple[float, float] | None = None


KINDS = (
    "input", "sensor", "force", "load", "friction", "storage", "displacement", "damping",
    "feedback", "drive", "spool", "rate", "opening", "supply", "area", "area_ratio", "leakage", "capacitance",
)  # fmt: skip
"""Kinds of signals at which effects of this package can act."""


class Signal(NamedTuple):
    """A named line of the block diagram, with its kind and its unit.

    Lines of kind "input" are the model's inputs, lines of kind "sensor" its outputs. The kind says which effects can
    act there (`ehsvjax.effects`): a "force" drives the motion, a "load" resists it, "friction" is the size of a force
    against the velocity (a model steps it without chatter), "storage" is the rate at which something is stored (its
    `level=` the context), a "displacement" is any other length; `KINDS` has them all. A kind of your own, at which
    effects of your own act, is any word that resembles none of them: one that is close to a known kind, "senzor", is
    taken for a slip and refused.
    """

    name: str
    kind: str
    unit: str


class Equations(NamedTuple):
    """The part of a model that is traced: compiled once for all values, bounds and records."""

    start: Callable[..., State]
    stepper: Callable[..., Callable[[State, Inputs], State]]
    measure: Callable[..., dict[str, Any]]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    prepare: Callable[..., Any] | None = None


@dataclass(frozen=True)
class Model:
    """A model to identify: `servovalve()`, `van_der_pol()`, or one that you wrote.

    Attributes:
        name: what it is called in prints and plots.
        parameters: the unknowns and the constants.
        initial: the unknown initial conditions, one set for each record.
        signals: the named lines of the diagram; the inputs and outputs among them.
        start, stepper, measure, prepare: the equations, see the module's docstring. Use module-level functions, or
            cached factories of them: the same function object is compiled once.
        max_step: longest integration step, s; a sample is divided into as many equal steps as this needs.
        options: how the model was made, for prints and for `Fit.save`.
        layers: the effects that it was extended by (`ehsvjax.effects.Candidate`), one tuple for each extension.
        ties: name of a constant and the function of all parameters that it is, one pair for each (`with_ties`).

    Raises:
        ValueError: for names that repeat or are none (empty, with blanks at their ends, of two lines), a kind of signal
            that is all but a known one, bounds that are not in order, a value outside its bounds, a log scale with a
            bound that is not positive or a negative value, an initial condition shown by an output that there is not,
            a model without an output, or a field of another type. What the equations do is checked at their first use.

    """

    name: str
    parameters: tuple[Parameter, ...]
    initial: tuple[Parameter, ...]
    signals: tuple[Signal, ...]
    start: Callable[..., State]
    stepper: Callable[..., Callable[[State, Inputs], State]]
    measure: Callable[..., dict[str, Any]]
    max_step: float
    options: tuple[tuple[str, Any], ...] = ()
    prepare: Callable[..., Any] | None = None
    layers: tuple[tuple[Any, ...], ...] = ()
    ties: tuple[tuple[str, Callable[..., Any]], ...] = ()

    def __post_init__(self):
        """Refuse what cannot be a model."""
        self._check_types()
        names = [p.name for p in (*self.parameters, *self.initial)]
        signals = [s.name for s in self.signals]
        for kind, found in (("parameter", names), ("signal", signals)):
            repeated = {n for n in found if found.count(n) > 1}
            if repeated:
                raise ValueError(f"expected every {kind} of {self.name} to have its own name, got {repeated} twice")
        if not self.outputs:
            raise ValueError(f"expected {self.name} to have an output, got no signal of kind 'sensor'")
        for parameter in (*self.parameters, *self.initial):
            check_bounds(parameter)
            if parameter.output is not None and label("output", parameter.output) not in self.outputs:
                raise ValueError(
                    f"expected the output that shows {parameter.name} of {self.name} to be a signal of kind 'sensor', "
                    f"{', '.join(self.outputs)}; got {parameter.output!r}"
                )
        positive(f"max_step of {self.name}", self.max_step, "give seconds above 0")

    def _check_types(self):
        label("the name of a model", self.name)
        for field, kind, example in (
            ("parameters", Parameter, 'Parameter("mass", "M", "kg", 20.0, 10.0, 30.0)'),
            ("initial", Parameter, 'Parameter("position", "x(0)", "m", 0.0, -0.1, 0.1)'),
            ("signals", Signal, 'Signal("position", "sensor", "m")'),
        ):
            given = several(f"{field} of {self.name}", getattr(self, field), kind, f"make each by {example}")
            object.__setattr__(self, field, given)
        several(f"options of {self.name}", self.options, tuple, "give pairs (name, value)")
        for signal in self.signals:
            label(f"the name of a signal of {self.name}", signal.name)
            text(f"the unit of {signal.name}", signal.unit)
            check_kind(signal.name, signal.kind, KINDS)
        function(f"start of {self.name}", self.start, "start(parameters, initial, inputs) -> state")
        function(f"stepper of {self.name}", self.stepper, "stepper(parameters, step_size, signal) -> step")
        function(f"measure of {self.name}", self.measure, "measure(parameters, state, inputs, signal) -> outputs")
        if self.prepare is not None:
            function(f"prepare of {self.name}", self.prepare, "prepare(parameters, inputs, sample_period) -> inputs")

    def __str__(self) -> str:
        """Tables of the parameters, the initial conditions and the signals."""
        from ehsvjax.summary import model_summary

        return model_summary(self)

    def _repr_html_(self) -> str:
        from ehsvjax.summary import model_summary_html

        return model_summary_html(self)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return tuple(s.name for s in self.signals if s.kind == "input")

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs that can be measured."""
        return tuple(s.name for s in self.signals if s.kind == "sensor")

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the parameters that are identified unless fixed."""
        return tuple(p.name for p in self.parameters if not p.fixed)

    @property
    def nominal(self) -> dict[str, float]:
        """Nominal value of every parameter and constant, SI."""
        return {p.name: p.value for p in self.parameters}

    @property
    def equations(self) -> Equations:
        """What is traced and compiled."""
        return Equations(self.start, self.stepper, self.measure, self.inputs, self.outputs, self.prepare)

    @property
    def of_run(self) -> dict[str, float]:
        """Numbers of its effects that go by a record's clock, with the values at which they are absent in others."""
        return {
            candidate.parameter(number.name): number.absent
            for layer in self.layers for candidate in layer if candidate.effect.of_run
            for number in candidate.effect.parameters if number.absent is not None
        }  # fmt: skip

    def parameter(self, name: str) -> Parameter:
        """Return the parameter, constant or initial condition of that name.

        Raises:
            ValueError: if the model has none of that name; lists those that it has.

        """
        everything = (*self.parameters, *self.initial)
        for parameter in everything:
            if isinstance(name, str) and parameter.name == name:
                return parameter
        known = ", ".join(p.name for p in everything)
        raise ValueError(f"expected a parameter of {self.name}, got {name!r}; it has {known}")

    def unit(self, signal: str) -> str:
        """Return the unit of the signal of that name.

        Raises:
            ValueError: if the model has none of that name; lists those that it has.

        """
        units = {s.name: s.unit for s in self.signals}
        if not isinstance(signal, str) or signal not in units:
            raise ValueError(f"expected a signal of {self.name}, got {signal!r}; it has {', '.join(units)}")
        return units[signal]

    def with_bounds(
        self,
        bounds: Mapping[str, tuple[float, float]] | None = None,
        fixed: Mapping[str, float] | None = None,
    ) -> "Model":
        """Return the model with other bounds (which frees a constant) and with parameters fixed at values.

        Raises:
            ValueError: for an unknown name, a name in both, one that is tied, bounds out of order, or what is no
                number.

        """
        bounds, fixed = by_name("bounds", bounds, '{"mass": (10.0, 30.0)}'), by_name("fixed", fixed, '{"mass": 20.0}')
        for name in (*bounds, *fixed):
            self.parameter(name)
        self.check_untied((*bounds, *fixed))
        both = sorted(set(bounds) & set(fixed))
        if both:
            raise ValueError(f"expected each parameter to be either bounded or fixed, got both for {', '.join(both)}")

        def changed(p: Parameter) -> Parameter:
            if p.name in bounds:
                lower, upper = as_bounds(p.name, bounds[p.name])
                value = min(max(p.value, lower), upper)
                # A search over both signs cannot be logarithmic.
                scale = p.scale if lower > 0 else "linear"
                # Bounds given for an initial condition stand, whatever its output shows.
                return p._replace(lower=lower, upper=upper, value=value, fixed=False, scale=scale, output=None)
            if p.name in fixed:
                return p._replace(value=number(p.name, fixed[p.name], remedy="give its value, SI"), fixed=True)
            return p

        parameters = tuple(changed(p) for p in self.parameters)
        following = tied_values(self.ties, {p.name: p.value for p in parameters})
        return replace(
            self,
            parameters=tuple(p._replace(value=following.get(p.name, p.value)) for p in parameters),
            initial=tuple(changed(p) for p in self.initial),
        )

    def check_untied(self, names: Collection[str]) -> None:
        """Refuse values of parameters that follow others.

        Raises:
            ValueError: naming the first.

        """
        for name in names:
            if name in dict(self.ties):
                raise ValueError(
                    f"expected no value of {name}, which is tied to other parameters of {self.name}: give theirs"
                )

    def with_priors(self, priors: Mapping[str, tuple[float, float]] | None = None) -> "Model":
        """Return the model with what is known of unknowns beforehand: name -> (mean, standard deviation), SI.

        Raises:
            ValueError: for a name that is no unknown parameter, or what is no mean with a positive deviation.

        """
        priors = by_name("priors", priors, '{"mass": (20.0, 0.5)}')
        for name in priors:
            if name not in self.free:
                known = ", ".join(self.free) or "none"
                raise ValueError(
                    f"expected priors of parameters that are to be identified, {known}; got {name!r}: free it by bounds"
                )
        given = {name: as_prior(name, prior) for name, prior in priors.items()}
        return replace(self, parameters=tuple(p._replace(prior=given.get(p.name, p.prior)) for p in self.parameters))

    def without_priors(self) -> "Model":
        """Return the model of whose parameters nothing is known beforehand."""
        return replace(self, parameters=tuple(p._replace(prior=None) for p in self.parameters))

    def with_ties(self, ties: Mapping[str, Callable[..., Any]] | None = None) -> "Model":
        """Return the model with parameters that are functions of others: name -> function of all, by name, to a number.

        What is tied is no unknown any longer, and no constant that may have been given wrong. A function in the manner
        of the equations: `lambda p: 2.0 * p["damping"]`, of JAX.

        Raises:
            ValueError: for an unknown name, what is no function, or one that gives no finite number of the nominal
                values.

        """
        ties = by_name("tied", ties, '{"b": lambda p: 2.0 * p["a"]}')
        if not ties:
            return self
        self.check_untied(ties)
        for name, tie in ties.items():
            if self.parameter(name) not in self.parameters:
                raise ValueError(f"expected tied to name parameters of {self.name}, got {name!r}, an initial condition")
            function(f"the tie of {name}", tie, "lambda p: 2.0 * p['a']")
        pairs = tuple(ties.items())
        values = tied_values(pairs, self.nominal)
        equations = _tied(self.equations, pairs)
        return replace(
            self,
            parameters=tuple(
                p._replace(value=values[p.name], fixed=True, certain=True, prior=None) if p.name in ties else p
                for p in self.parameters
            ),
            start=equations.start,
            stepper=equations.stepper,
            measure=equations.measure,
            prepare=equations.prepare,
            ties=(*self.ties, *pairs),
        )


def tied_values(ties: Sequence[tuple[str, Callable[..., Any]]], parameters: Mapping[str, float]) -> dict[str, float]:
    """Return the value of each tied parameter at values of all, SI; one may be tied to another before it.

    Raises:
        ValueError: naming the tie that gives no finite number.

    """
    values, found = dict(parameters), dict[str, float]()
    for name, tie in ties:
        try:
            value = as_number(np.asarray(tie(values)).item())
        except Exception as error:
            reason = f"{type(error).__name__} ({str(error).partition(chr(10))[0]})"
            raise ValueError(
                f"expected the tie of {name} to be a function of {', '.join(values)}, got {reason}: give a function of "
                "a dict of all parameters, such as lambda p: 2.0 * p['a']"
            ) from error
        if value is None or not np.isfinite(value):
            raise ValueError(f"expected the tie of {name} to give a finite number, got {value}: look at its values")
        values[name] = found[name] = value
    return found


@functools.cache
def _tied(equations: Equations, ties: tuple[tuple[str, Callable[..., Any]], ...]) -> Equations:
    """Return equations of which some parameters are functions of others, the same objects for the same ties."""

    def with_ties(parameters):
        values = dict(parameters)
        for name, tie in ties:
            values[name] = tie(values)
        return values

    def tied(function):
        return None if function is None else lambda parameters, *others: function(with_ties(parameters), *others)

    return equations._replace(
        start=tied(equations.start),
        stepper=tied(equations.stepper),
        measure=tied(equations.measure),
        prepare=tied(equations.prepare),
    )


def as_prior(name: str, prior: Any) -> tuple[float, float]:
    """Return a prior as two numbers.

    Raises:
        ValueError: if it is no pair of a mean and a positive standard deviation.

    """
    pair = _two_numbers(prior)
    if pair is None or not np.isfinite(pair).all() or pair[1] <= 0.0:
        raise ValueError(
            f"expected the prior of {name} as (mean, standard deviation), the latter positive, got {prior!r}: give two "
            "numbers, SI"
        )
    return pair


def as_bounds(name: str, bounds: Any) -> tuple[float, float]:
    """Return bounds as two numbers.

    Raises:
        ValueError: if they are no such pair.

    """
    pair = _two_numbers(bounds)
    if pair is None:
        raise ValueError(f"expected bounds of {name} as (lower, upper), got {bounds!r}: give two numbers, SI")
    return pair


def _two_numbers(values: Any) -> tuple[float, float] | None:
    """Return a pair of numbers as one, None if it is none."""
    if not isinstance(values, tuple | list | np.ndarray) or len(values) != 2:
        return None
    first, second = map(as_number, values)
    return None if first is None or second is None else (first, second)


def check_kind(name: str, kind: str, known: Collection[str]) -> None:
    """Refuse a kind of signal that is close to a known one and is not that one.

    Raises:
        ValueError: with the known kinds and the closest one.

    """
    label(f"the kind of {name}", kind)
    close = difflib.get_close_matches(kind.lower(), known, n=1, cutoff=0.75)
    if kind not in known and close:
        raise ValueError(
            f"expected the kind of {name} to be one of {', '.join(known)}, got {kind!r}: write {close[0]!r}, or for a "
            "kind of your own a word that resembles none of them"
        )


def check_bounds(parameter: Parameter) -> None:
    """Refuse bounds out of order, a value outside them, a log scale that reaches zero, and fields of another type.

    Raises:
        ValueError: with the parameter's name, what came, and what to do.

    """
    name, value, lower, upper = parameter.name, parameter.value, parameter.lower, parameter.upper
    label("the name of a parameter", name)
    text(f"the symbol of {name}", parameter.symbol)
    text(f"the unit of {name}", parameter.unit)
    choice(f"the scale of {name}", parameter.scale, ("linear", "log"))
    flag(f"fixed of {name}", parameter.fixed)
    if parameter.prior is not None:
        as_prior(name, parameter.prior)
    number(name, value, remedy="give its nominal value, SI")
    as_bounds(name, (lower, upper))
    if parameter.scale == "log" and value < 0:
        raise ValueError(f"expected a positive value for {name}, or zero, got {value}: mind the sign")
    if parameter.fixed:
        return
    if not (abs(lower) < float("inf") and abs(upper) < float("inf") and lower < upper):
        raise ValueError(
            f"expected finite bounds of {name} with lower < upper, got ({lower}, {upper}); to hold it at one value "
            f"use fixed={{{name!r}: value}}"
        )
    if parameter.scale == "log" and lower <= 0:
        raise ValueError(f"expected a positive lower bound of {name}, which is searched by its logarithm, got {lower}")
    if not lower <= value <= upper:
        raise ValueError(f"expected the value of {name} inside its bounds ({lower}, {upper}), got {value}")


def identity(name: str, value: Any, **context: Any) -> Any:
    """Pass a signal through unchanged: every line of a nominal model."""
    del name, context
    return value
