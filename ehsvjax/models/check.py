"""Whether a model's equations can be simulated: traced once over scalars, without a number computed, at first use."""

import difflib
import functools
import sysconfig
import traceback
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ehsvjax import kernels
from ehsvjax.models.model import Equations, Model
from ehsvjax.structures import in_words, is_numeric, name_of, same_structure

_SAMPLES = 8  # of a series that `prepare` is traced with
_OWN = Path(__file__).parents[1]
_NOT_THE_USERS = (_OWN, *(Path(sysconfig.get_paths()[key]) for key in ("stdlib", "purelib", "platlib")))

_NUMPY = "call the function of jax.numpy in place of NumPy's: jnp.sin, jnp.interp, ...; make arrays by jnp.stack([...])"
_CONDITION = "write jnp.where(condition, a, b), jnp.maximum, jnp.logical_and, ... in place of if, while, max, and"
_CONVERSION = (
    "leave out float() and int(), and call jnp.sin, ... in place of math.sin: values are known only when it runs"
)
_NAMES = "use the names of the model's parameters, initial conditions, inputs and state"
_INPUTS = "a step asks for its inputs by the share of it that has passed: inputs(0.5) are those halfway"
# What an exception is, a part of its words, and what to do.
_REMEDIES = (
    (jax.errors.TracerBoolConversionError, "", _CONDITION),
    (jax.errors.TracerArrayConversionError, "", _NUMPY),
    (ValueError, "array element with a sequence", _NUMPY),
    (jax.errors.ConcretizationTypeError, "", _CONVERSION),
    (TypeError, "integer scalar arrays", _CONVERSION),
    (TypeError, "'function' object is not subscriptable", _INPUTS),
    (KeyError, "", _NAMES),
)


def check_equations(model: Model) -> None:
    """Refuse equations that cannot be traced, or that do not do what the model says.

    Costs some milliseconds (30 ms for the servovalve), once for the same equations and names.

    Raises:
        ValueError: naming the function and its line for NumPy functions, a Python `if` or `float()` of traced values;
            for outputs that are missing, too many or no numbers, a step or rates of another structure than the state, a
            signal that is not listed, or one that is listed and that no value passes through.

    """
    _checked(
        model.name,
        model.equations,
        tuple(p.name for p in model.parameters),
        tuple(p.name for p in model.initial),
        tuple((s.name, s.kind) for s in model.signals),
    )


@functools.lru_cache(maxsize=4096)
def _checked(
    model: str,
    equations: Equations,
    parameters: tuple[str, ...],
    initial: tuple[str, ...],
    signals: tuple[tuple[str, str], ...],
) -> None:
    passed: set[str] = set()
    kinds = dict(signals)

    def signal(name, value, **context):
        """Raise a ValueError for a signal that is not listed, or pass the value on."""
        if name not in kinds:
            raise unlisted(model, name, kinds)
        passed.add(name)
        return value

    def whole(parameters, initial, inputs, series, step_size):
        return one_step(model, equations, signal, parameters, initial, inputs, series, step_size)

    with kernels.double_precision():
        scalar = jax.ShapeDtypeStruct((), jnp.float64)
        series = dict.fromkeys(equations.inputs, jax.ShapeDtypeStruct((_SAMPLES, 3), jnp.float64))
        names = (parameters, initial, equations.inputs)
        jax.eval_shape(whole, *(dict.fromkeys(n, scalar) for n in names), series, scalar)
    for name, kind in kinds.items():
        if name in passed or kind == "input":
            continue
        remedy = f"write signal({name!r}, value) where the equations use it, or leave it out of the model's signals"
        if kind != "sensor":
            raise ValueError(
                f"expected a value of {model} to pass through its signal {name!r}, got none, so that an effect there "
                f"would do nothing: {remedy}"
            )
        warnings.warn(
            f"the output {name!r} of {model} does not pass through its signal, so that a diagnosis cannot tell whether "
            f"its sensor is at fault: return signal({name!r}, value) from {name_of(equations.measure)}",
            stacklevel=5,
        )


def one_step(
    model: str,
    equations: Equations,
    signal: Callable,
    parameters: Mapping[str, Any],
    initial: Mapping[str, Any],
    inputs: Mapping[str, Any],
    series: Any,
    step_size: Any,
):
    """Return the state and the outputs at the first sample and one step later, each checked.

    Raises:
        ValueError: as `check_equations` does.

    """
    run = functools.partial(_run, model)
    if equations.prepare is not None:
        prepared = run(equations.prepare, parameters, series, step_size)
        if not isinstance(prepared, dict) or any(
            name not in series or np.shape(prepared[name]) != np.shape(series[name]) for name in prepared
        ):
            raise ValueError(
                f"expected {name_of(equations.prepare)} of {model} to return inputs by name, [time, node] in the shape "
                f"in which they came, got {in_words(prepared)}"
            )

    state = run(equations.start, parameters, initial, inputs)
    if not jax.tree.leaves(state) or not all(map(is_numeric, jax.tree.leaves(state))):
        where = f"{name_of(equations.start)} of {model}"
        raise ValueError(f"expected {where} to return the state, such as {{'x': 0.0}}, got {in_words(state)}")
    before = run(_as_numbers, state, called=equations.start)
    outputs = _checked_outputs(model, equations, run(equations.measure, parameters, before, inputs, signal))
    step = run(equations.stepper, parameters, step_size, signal)
    if not callable(step):
        raise ValueError(f"expected {name_of(equations.stepper)} of {model} to return a step, a function; got {step!r}")
    after = run(step, before, lambda fraction: inputs, called=equations.stepper)
    what = f"the state one step later, by {name_of(equations.stepper)} of {model},"
    same_structure(what, after, "the state at the start", before)
    for old, new in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        if np.shape(old) != np.shape(new) or not jnp.issubdtype(jnp.result_type(new), jnp.floating):
            raise ValueError(
                f"expected {what} to be like the state at the start, {in_words(before)}, got {in_words(after)} "
                f"({jnp.result_type(new)}): return real numbers of the same shapes"
            )
    return before, outputs, after


def where_not_finite(
    model: Model,
    signal: Callable,
    parameters: Mapping[str, Any],
    initial: Mapping[str, Any],
    inputs: Float[np.ndarray, "time input"],
    step_size: float,
) -> str:
    """Return what is not finite at the first sample of a simulation or one step later, and what to look at.

    Computed one operation at a time, which takes a second: for a simulation that has failed.

    Args:
        model: the model.
        signal: what every named signal passes through.
        parameters: values by name.
        initial: values by name.
        inputs: of the whole record, in the model's order.
        step_size: s.

    """
    with kernels.double_precision():
        numbers, begin, first, series, step_size = jax.tree.map(
            jnp.float64, (parameters, initial, dict(zip(model.inputs, inputs[0], strict=True)), inputs, step_size)
        )
        moments = one_step(model.name, model.equations, signal, numbers, begin, first, series, step_size)
    for what, values in zip(("the state at the start", "the output", "the state after one step"), moments, strict=True):
        for path, leaf in jax.tree_util.tree_leaves_with_path(values):
            if not np.isfinite(leaf):
                return (
                    f"{what}, {jax.tree_util.keystr(path)}, of {model.name} is {leaf}: look at the values and units of "
                    f"its parameters, {', '.join(f'{name} = {value:g}' for name, value in parameters.items())}"
                )
    return f"the outputs of {model.name} are not finite after the first sample: take shorter steps, or look at units"


def _as_numbers(state):
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, float), state)


def _checked_outputs(model: str, equations: Equations, outputs: Any) -> Mapping[str, Any]:
    where = f"{name_of(equations.measure)} of {model}"
    wanted = f"expected {where} to return a number for each output, {', '.join(equations.outputs)}; got"
    if not isinstance(outputs, Mapping):
        raise ValueError(f"{wanted} {in_words(outputs)}: return a dict")
    if set(outputs) != set(equations.outputs):
        found = ", ".join(map(str, outputs)) or "none"
        raise ValueError(f"{wanted} {found}: outputs are the signals of kind 'sensor', by their names")
    for name, value in outputs.items():
        if not is_numeric(value) or np.shape(value) or jnp.iscomplexobj(value):
            raise ValueError(f"{wanted} {in_words(value)} for {name!r}: return one real number")
    return outputs


def unlisted(model: str, name: Any, signals: Mapping[str, str]) -> ValueError:
    """Return the error for a signal that equations pass values through and that the model does not list."""
    close = difflib.get_close_matches(str(name), signals, n=1)
    remedy = f"write {close[0]!r}" if close else f"add Signal({name!r}, kind, unit) to its signals"
    return ValueError(f"expected a signal of {model}, {', '.join(signals)}, got signal({name!r}, ...): {remedy}")


def _run(model: str, function: Callable, *arguments: Any, called: Callable | None = None) -> Any:
    """Call one of the equations; whatever it raises becomes one sentence that names the function and its line."""
    try:
        return function(*arguments)
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        if isinstance(error, ValueError) and Path(last.filename).is_relative_to(_OWN) and "expected" in str(error):
            raise
        remedies = (do for kind, words, do in _REMEDIES if isinstance(error, kind) and words in str(error))
        remedy = next(remedies, "mend that line")
        first = str(error).partition("\n")[0]
        raise ValueError(
            f"expected the equations of {model} to be functions of JAX, got {type(error).__name__} ({first}) in "
            f"{_place(error, called or function)}: {remedy}"
        ) from error


def _place(error: Exception, function: Callable) -> str:
    """Return the innermost function of the user's in a traceback, with its line."""
    for frame, line in reversed(list(traceback.walk_tb(error.__traceback__))):
        code = frame.f_code
        path = Path(code.co_filename)
        if not any(path.is_relative_to(library) for library in _NOT_THE_USERS):
            return f"{getattr(code, 'co_qualname', code.co_name)} ({path.name}, line {line})"
    return name_of(function)
