"""A tank as a user writes it, and tanks with a fault each."""

import functools
import math
from collections.abc import Iterator
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

import ehsvjax
from benchmarks.damaged_calls import Call
from ehsvjax import Model, Parameter, Record, Signal


def start(parameters, initial, inputs):
    """Return the state at the first sample."""
    return {"level": initial["start"]}


def derivative(parameters, state, inputs, signal):
    """Return the rate of the level."""
    flow = signal("flow", parameters["gain"] * inputs["command"])
    return {"level": (flow - state["level"]) / parameters["lag"]}


def measure(parameters, state, inputs, signal):
    """Return the level."""
    return {"level": signal("level", state["level"])}


def tank(**changes) -> Model:
    """Return lag*level' = gain*command - level, with changes."""
    return replace(
        Model(
            name="tank",
            parameters=(
                Parameter("gain", "k", "", 2.0, 1.0, 3.0, "log"),
                Parameter("lag", "T", "s", 0.2, 0.1, 2.0, "log"),
            ),
            initial=(Parameter("start", "level(0)", "", 0.0, -1.0, 1.0),),
            signals=(Signal("command", "input", ""), Signal("flow", "inflow", ""), Signal("level", "sensor", "")),
            start=start,
            stepper=ehsvjax.runge_kutta_4(derivative),
            measure=measure,
            max_step=0.1,
        ),
        **changes,
    )


@functools.cache
def tank_record() -> Record:
    """Return 3 s of a noisy tank at 100 Hz."""
    clock = 0.01 * np.arange(300)
    command = np.repeat(np.random.default_rng(0).uniform(-1.0, 1.0, 15), 20)
    level = ehsvjax.simulate(tank(), Record(clock, {"command": command}))["level"]
    return Record(clock, {"command": command}, {"level": level + np.random.default_rng(1).normal(0.0, 0.01, 300)})


@functools.cache
def tank_fit() -> ehsvjax.Fit:
    """Return the tank fitted to its record."""
    return ehsvjax.identify(tank(), tank_record(), key=jax.random.key(0), population=8, generations=4)


def with_derivative(term) -> Model:
    """Return a tank whose level's rate is what `term(parameters, level, command)` says."""

    def wrong(parameters, state, inputs, signal):
        signal("flow", 0.0)
        return {"level": term(parameters, state["level"], inputs["command"])}

    return tank(stepper=ehsvjax.runge_kutta_4(wrong))


def with_rates(rates) -> Model:
    """Return a tank whose derivative returns `rates(state)`."""

    def wrong(parameters, state, inputs, signal):
        signal("flow", 0.0)
        return rates(state)

    return tank(stepper=ehsvjax.runge_kutta_4(wrong))


def with_step(following) -> Model:
    """Return a tank whose step returns `following(state)`."""
    return with_whole_step(lambda state, inputs: following(state))


def with_whole_step(following) -> Model:
    """Return a tank whose step returns `following(state, inputs)`."""

    def stepper(parameters, step_size, signal):
        signal("flow", 0.0)
        return following

    return tank(stepper=stepper)


def with_start(made) -> Model:
    """Return a tank that starts from `made(initial)`."""
    return tank(start=lambda parameters, initial, inputs: made(initial))


def with_outputs(outputs) -> Model:
    """Return a tank that measures `outputs(state)`."""

    def wrong(parameters, state, inputs, signal):
        signal("level", 0.0)
        return outputs(state)

    return tank(measure=wrong)


def _passes(name):
    def wrong(parameters, state, inputs, signal):
        return {"level": signal("flow", signal(name, inputs["command"])) - state["level"]}

    return tank(stepper=ehsvjax.runge_kutta_4(wrong))


def _if(parameters, level, command):
    if level > 0.0:
        return command - level
    return command


def _loop(parameters, level, command):
    while level > 1.0:
        level = level - 1.0
    return command - level


FIXED = tuple(p._replace(fixed=True) for p in tank().parameters)

FAULTS = {
    "np.sin": lambda: with_derivative(lambda p, level, u: np.sin(level) + u),
    "np.where": lambda: with_derivative(lambda p, level, u: np.where(level > 0.0, u, -u)),
    "np.sqrt of a parameter": lambda: with_derivative(lambda p, level, u: u - level * np.sqrt(p["gain"])),
    "np.array of values": lambda: with_derivative(lambda p, level, u: np.array([level, u]).sum()),
    "np.interp": lambda: with_derivative(lambda p, level, u: np.interp(level, [0.0, 1.0], [0.0, 1.0])),
    "assigned into NumPy": lambda: with_derivative(_assigned),
    "math.sin": lambda: with_derivative(lambda p, level, u: math.sin(level) + u),
    "float()": lambda: with_derivative(lambda p, level, u: float(level) + u),
    "int()": lambda: with_derivative(lambda p, level, u: int(level) + u),
    "if": lambda: with_derivative(_if),
    "while": lambda: with_derivative(_loop),
    "max()": lambda: with_derivative(lambda p, level, u: max(level, 0.0) + u),
    "and": lambda: with_derivative(lambda p, level, u: u * (level > 0.0 and u > 0.0)),
    "range()": lambda: with_derivative(lambda p, level, u: sum(u for _ in range(level))),
    "item()": lambda: with_derivative(lambda p, level, u: level.item() + u),
    "a list as index": lambda: with_derivative(lambda p, level, u: [1.0, 2.0][level] + u),
    "unknown parameter": lambda: with_derivative(lambda p, level, u: p["gian"] * u - level),
    "name that is not there": lambda: with_derivative(lambda p, level, u: u - levle),  # noqa: F821
    "text for a rate": lambda: with_derivative(lambda p, level, u: "fast"),
    "None for a rate": lambda: with_derivative(lambda p, level, u: None),
    "an array for a rate": lambda: with_derivative(lambda p, level, u: jnp.stack([level, u])),
    "complex rate": lambda: with_derivative(lambda p, level, u: (u - level) * 1j),
    "no rate": lambda: with_rates(lambda state: {}),
    "a rate more": lambda: with_rates(lambda state: {"level": 0.0, "other": 0.0}),
    "a rate of another name": lambda: with_rates(lambda state: {"volume": 0.0}),
    "rates as a tuple": lambda: with_rates(lambda state: (0.0,)),
    "rate alone": lambda: with_rates(lambda state: state["level"]),
    "None for rates": lambda: with_rates(lambda state: None),
    "state that is not there": lambda: with_rates(lambda state: {"level": state["volume"]}),
    "attribute of a dict": lambda: with_rates(lambda state: {"level": state.level}),
    "derivative with too few arguments": lambda: tank(stepper=ehsvjax.runge_kutta_4(lambda parameters, state: state)),
    "step of another structure": lambda: with_step(lambda state: (state["level"],)),
    "step of other keys": lambda: with_step(lambda state: {"volume": state["level"]}),
    "step of another shape": lambda: with_step(lambda state: {"level": jnp.ones(3) * state["level"]}),
    "step to whole numbers": lambda: with_step(lambda state: {"level": jnp.int32(1)}),
    "step with inputs as they are": lambda: with_whole_step(lambda state, inputs: {"level": inputs["command"]}),
    "step to None": lambda: with_step(lambda state: None),
    "step that is no function": lambda: tank(stepper=lambda parameters, step_size, signal: 3.0),
    "start that is an array": lambda: with_start(lambda initial: {"level": jnp.zeros(3)}),
    "start with text": lambda: with_start(lambda initial: {"level": "0"}),
    "start that is None": lambda: with_start(lambda initial: None),
    "start of other keys": lambda: with_start(lambda initial: {"volume": initial["start"]}),
    "start by a misspelt name": lambda: with_start(lambda initial: {"level": initial["strat"]}),
    "start by NumPy": lambda: with_start(lambda initial: {"level": np.tanh(initial["start"])}),
    "an output missing": lambda: with_outputs(lambda state: {}),
    "an output too many": lambda: with_outputs(lambda state: {"level": state["level"], "flow": 0.0}),
    "an output misspelt": lambda: with_outputs(lambda state: {"levle": state["level"]}),
    "outputs as an array": lambda: with_outputs(lambda state: jnp.stack([state["level"]])),
    "outputs as None": lambda: with_outputs(lambda state: None),
    "an output that is an array": lambda: with_outputs(lambda state: {"level": jnp.ones(2) * state["level"]}),
    "an output that is text": lambda: with_outputs(lambda state: {"level": "high"}),
    "an output that is None": lambda: with_outputs(lambda state: {"level": None}),
    "a complex output": lambda: with_outputs(lambda state: {"level": state["level"] * 1j}),
    "output by NumPy": lambda: with_outputs(lambda state: {"level": np.abs(state["level"]) ** np.float64(0.5)}),
    "a signal that is not listed": lambda: _passes("leak"),
    "a signal misspelt": lambda: _passes("flwo"),
    "a signal that is never passed": lambda: tank(signals=(*tank().signals, Signal("leak", "force", "N"))),
    "a sensor that is never passed": lambda: tank(measure=lambda p, state, inputs, signal: {"level": state["level"]}),
    "an input that is not there": lambda: tank(signals=(Signal("voltage", "input", "V"), *tank().signals[1:])),
    "NaN at the start": lambda: with_start(lambda initial: {"level": jnp.sqrt(initial["start"] - 1.0)}),
    "NaN in the rate": lambda: with_derivative(lambda p, level, u: jnp.log(-p["gain"]) * u),
    "division by zero": lambda: with_derivative(lambda p, level, u: u / (p["gain"] - p["gain"])),
    "NaN in an output": lambda: with_outputs(lambda state: {"level": jnp.sqrt(-1.0 - state["level"] ** 2)}),
    "prepare of another shape": lambda: tank(
        prepare=lambda parameters, inputs, period: {"command": inputs["command"][1:]}
    ),
    "prepare by NumPy": lambda: tank(
        prepare=lambda parameters, inputs, period: {"command": np.cumsum(inputs["command"])}
    ),
    "prepare to None": lambda: tank(prepare=lambda parameters, inputs, period: None),
    "the longest step is tiny": lambda: tank(max_step=1e-300),
    "equations that cannot be hashed": lambda: tank(start=_Unhashable()),
}
"""Name of the fault -> the model that has it; some are refused as they are made, others where they are used."""


class _Unhashable:
    __hash__ = None

    def __call__(self, parameters, initial, inputs):
        return start(parameters, initial, inputs)


def _assigned(parameters, level, command):
    rates = np.zeros(1)
    rates[0] = command - level
    return rates[0]


def calls() -> Iterator[Call]:
    """Yield each fault in a simulation and in an identification; and what is harmless, which must work."""
    for fault, make in FAULTS.items():
        yield Call("simulate own model", "", fault, lambda make=make: _simulated(make()))
        if not fault.startswith(("NaN", "division")):
            yield Call("identify own model", "", fault, lambda make=make: _identified(make()))
    yield Call(
        "identify own model", "", "every parameter fixed", lambda: _identified(tank(parameters=FIXED), "nominal")
    )
    for label, name in {"dollar": "x$_1$", "angle": "a<b>", "inner blank": "inner level", "Greek": "ξ"}.items():
        gain, lag = tank().parameters
        renamed = tank(parameters=(gain, lag, Parameter(name, name, "", 1.0, 0.5, 1.5)))
        yield Call("identify own model", "name", label, lambda m=renamed: _identified(m), may_answer=True)
    yield Call("simulate own model", "kind", "of one's own", lambda: _simulated(tank()), may_answer=True)
    yield Call("simulate own model", "inputs", "nothing but a start", _autonomous, may_answer=True)


def _simulated(model: Model):
    found = ehsvjax.simulate(model, tank_record())
    return found


def _identified(model: Model, initial="estimate"):
    return ehsvjax.identify(
        model, tank_record(), key=jax.random.key(0), population=4, generations=1, refine=False, initial=initial
    )


def _autonomous():
    """Simulate a tank that only runs empty."""

    def empties(parameters, state, inputs, signal):
        return {"level": signal("flow", -state["level"]) / parameters["lag"]}

    return ehsvjax.simulate(
        tank(signals=tank().signals[1:], stepper=ehsvjax.runge_kutta_4(empties)), tank_record(), initial={"start": 1.0}
    )
