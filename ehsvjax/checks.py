"""What an argument must be: one sentence for whoever gives something else, before anything is traced.

Each function returns the argument as it is meant, or raises ValueError: "expected NAME to be ..., got ...: what to do".
"""

import math
import reprlib
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np


def refused(name: str, wanted: str, value: Any, remedy: str = "") -> ValueError:
    """Return the error that says what was expected, what came instead, and what to do."""
    shown = " ".join(reprlib.repr(value).split())
    return ValueError(f"expected {name} to be {wanted}, got {shown}" + (f": {remedy}" if remedy else ""))


def number(
    name: str,
    value: Any,
    wanted: str = "a finite number",
    valid: Callable[[float], bool] = lambda value: True,
    remedy: str = "",
) -> float:
    """Return a finite number for which `valid` holds; `wanted` says so in words.

    A NumPy or JAX scalar is a number, `True` and text are none.

    Raises:
        ValueError: for anything else.

    """
    found = as_number(value)
    if found is None or not (math.isfinite(found) and valid(found)):
        raise refused(name, wanted, value, remedy)
    return found


def as_number(value: Any) -> float | None:
    """Return a number, finite or not, as a float, and anything else as None: True and text are no numbers."""
    kind = getattr(getattr(value, "dtype", None), "kind", None)
    scalar = (isinstance(value, int | float) and not isinstance(value, bool)) or (
        kind in ("i", "u", "f") and np.shape(value) == ()
    )
    try:
        return float(value) if scalar else None
    except (TypeError, OverflowError):  # a traced value, or a whole number beyond all floating-point ones
        return None


def positive(name: str, value: Any, remedy: str = "give a number above 0") -> float:
    """Return a finite number above zero.

    Raises:
        ValueError: for anything else.

    """
    number(name, value, remedy="give it in SI units")
    return number(name, value, "positive", lambda value: value > 0.0, remedy)


def whole(name: str, value: Any, least: int, most: int, remedy: str = "") -> int:
    """Return a whole number from `least` to `most`; one whose type is a floating-point one is none.

    Raises:
        ValueError: for anything else.

    """
    is_whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not (is_whole and least <= value <= most):
        raise refused(name, f"a whole number from {least} to {most:g}", value, remedy)
    return int(value)


def flag(name: str, value: Any) -> bool:
    """Return True or False.

    Raises:
        ValueError: for anything else.

    """
    if not isinstance(value, bool | np.bool_):
        raise refused(name, "True or False", value, "choose one")
    return bool(value)


def choice(name: str, value: Any, choices: Collection[str]) -> str:
    """Return one of the choices.

    Raises:
        ValueError: for anything else.

    """
    if not isinstance(value, str) or value not in choices:
        raise refused(name, " or ".join(map(repr, choices)), value, "choose one")
    return value


def text(name: str, value: Any) -> str:
    """Return text of one line, that may be empty: a unit, a symbol.

    Raises:
        ValueError: for anything else.

    """
    if not isinstance(value, str) or not value.isprintable():
        raise refused(name, "text of one line", value, "write it between quotes, without line breaks")
    return value


def label(name: str, value: Any) -> str:
    """Return text that can be a name: of one line, not empty, without blanks at its ends.

    Raises:
        ValueError: for anything else.

    """
    if not isinstance(value, str) or not value or value != value.strip() or not value.isprintable():
        raise refused(
            name, "text of one line that neither is empty nor begins or ends with a blank", value, "write it out"
        )
    return value


def function(name: str, value: Any, form: str) -> Callable:
    """Return a function; `form` says how it is called.

    Raises:
        ValueError: for anything else.

    """
    if not callable(value):
        raise refused(name, f"a function, {form}", value, "pass the function itself")
    return value


def instance(name: str, value: Any, kind: type, remedy: str) -> Any:
    """Return an object of a type.

    Raises:
        ValueError: for anything else.

    """
    if not isinstance(value, kind):
        raise refused(name, f"a {kind.__name__}", value, remedy)
    return value


def several(name: str, values: Any, kind: type, remedy: str) -> tuple:
    """Return a sequence of objects of one type as a tuple.

    Raises:
        ValueError: for anything else.

    """
    if not isinstance(values, tuple | list):
        raise refused(name, f"a tuple of {kind.__name__}s", values, remedy)
    for i, value in enumerate(values):
        instance(f"{name}[{i}]", value, kind, remedy)
    return tuple(values)


def by_name(name: str, values: Any, example: str) -> dict[str, Any]:
    """Return a mapping from names as a dict, None as an empty one; `example` shows such a mapping.

    Raises:
        ValueError: for anything else.

    """
    if values is None:
        return {}
    if not isinstance(values, Mapping) or not all(isinstance(key, str) for key in values):
        raise refused(name, f"a mapping from names, such as {example}", values, "give each value by its name")
    return dict(values)


def same_structure(name: str, found: Any, whose: str, wanted: Any) -> None:
    """Refuse what a function returned if it has not the keys of something else, in the same structure.

    Raises:
        ValueError: with both structures.

    """
    numeric = all(map(is_numeric, jax.tree.leaves(found)))
    if not numeric or str(jax.tree.structure(found)) != str(jax.tree.structure(wanted)):
        remedy = "return the same keys in the same structure, with a number for each"
        raise ValueError(f"expected {name} to be like {whose}, {in_words(wanted)}, got {in_words(found)}: {remedy}")


def in_words(tree: Any) -> str:
    """Return the structure of a pytree, with what is in it: numbers, arrays of a shape, or other things."""

    def words(leaf):
        if not is_numeric(leaf):
            return _Words(f"a {type(leaf).__name__}")
        return _Words(f"an array {np.shape(leaf)}" if np.shape(leaf) else "a number")

    return str(jax.tree.map(words, tree))


def is_numeric(value: Any) -> bool:
    """Return whether a value is a number or an array of numbers, traced or not."""
    kind = getattr(getattr(value, "dtype", None), "kind", None)
    return isinstance(value, int | float | complex) if kind is None else kind in "biufc"


class _Words(str):
    """Text that is printed without quotes."""

    __repr__ = str.__str__


def name_of(equation: Callable) -> str:
    """Return how a person knows a function: its name, and where it is defined."""
    code = getattr(equation, "__code__", None)
    name = getattr(equation, "__qualname__", type(equation).__name__)
    return f"{name} ({Path(code.co_filename).name}, line {code.co_firstlineno})" if code else name
