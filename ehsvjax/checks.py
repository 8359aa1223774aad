"""What an argument must be: one sentence for whoever gives something else, before anything is traced.

Each function returns the argument as it is meant, or raises ValueError: "expected NAME to be ..., got ...: what to do".
"""

import math
import os
from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np


def refused(name: str, wanted: str, value: Any, remedy: str = "") -> ValueError:
    """Return the error that says what was expected, what came instead, and what to do."""
    return ValueError(f"expected {name} to be {wanted}, got {shown(value)}" + (f": {remedy}" if remedy else ""))


def shown(value: Any) -> str:
    """Return a value as it is written in a sentence: in one line, its first 80 characters."""
    words = " ".join(repr(value).split())
    return f"{words[:80]} ..." if len(words) > 80 else words


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
    number(name, value, remedy=remedy)  # infinity is positive
    return number(name, value, "positive", lambda value: value > 0.0, remedy)


def whole(name: str, value: Any, least: int, most: float = math.inf, remedy: str = "give one, such as 10") -> int:
    """Return a whole number from `least` to `most`; one whose type is a floating-point one is none.

    Raises:
        ValueError: for anything else.

    """
    is_whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not (is_whole and least <= value <= most):
        reach = f"of at least {least}" if most == math.inf else f"from {least} to {most:g}"
        raise refused(name, f"a whole number {reach}", value, remedy)
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
        *others, last = map(repr, choices)
        raise refused(name, f"{', '.join(others)} or {last}", value, "choose one")
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


def file_path(name: str, value: Any, what: str = "a file") -> str | os.PathLike:
    """Return the path of a file, there or not; `what` is in it.

    Raises:
        ValueError: for anything else.

    """
    if not isinstance(value, str | os.PathLike) or not os.fspath(value) or "\0" in str(value):
        raise refused(name, f"the path of {what}", value, "give a string or a pathlib.Path")
    return value


def function(name: str, value: Any, form: str) -> Callable:
    """Return a function by which compiled programs can be kept; `form` says how it is called.

    Raises:
        ValueError: for anything else.

    """
    if not callable(value):
        raise refused(name, f"a function, {form}", value, "pass the function itself")
    try:
        hash(value)
    except TypeError:
        remedy = "compiled programs are kept by it; use functions, or frozen dataclasses"
        raise refused(name, "something with a hash", value, remedy) from None
    return value


def instance(name: str, value: Any, kind: type, remedy: str) -> Any:
    """Return an object of a type.

    Raises:
        ValueError: for anything else.

    """
    if not isinstance(value, kind):
        article = "an" if kind.__name__[0] in "AEIOU" else "a"
        raise refused(name, f"{article} {kind.__name__}", value, remedy)
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


def fits_memory(name: str, sizes: str, needed: float) -> None:
    """Refuse what would take more bytes than this machine has; `sizes` says which arguments make it so.

    Raises:
        ValueError: with both numbers.

    """
    memory = _memory()
    if needed > memory:
        raise ValueError(
            f"expected {name} that fits into this machine's memory of {memory / 1e9:.3g} GB, got {sizes}, which takes "
            f"{needed / 1e9:.3g} GB: take fewer"
        )


def _memory() -> float:
    """Return the memory of this machine in bytes; +inf where the system does not say."""
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, OSError, ValueError):
        return math.inf
