"""What arguments must be: each check ends in one sentence, before anything is traced."""

import os
from collections.abc import Mapping, Sequence
from numbers import Integral, Real
from typing import Any, TypeVar

import numpy as np

_Kind = TypeVar("_Kind")


def number(words: str, value: Any) -> float:
    """Return one finite number as a float; `words` name it.

    Raises:
        ValueError: for anything else: text, truth values, arrays, NaN and infinity.

    """
    if not _is_number(value):
        raise ValueError(f"expected {words} to be a number, got {value!r}")
    if not np.isfinite(float(value)):
        raise ValueError(f"expected a finite value for {words}, got {float(value)}")
    return float(value)


def positive(words: str, value: Any) -> float:
    """Return one positive, finite number as a float; `words` say what is expected.

    Raises:
        ValueError: for anything else.

    """
    if not (_is_number(value) and 0.0 < float(value) < np.inf):
        raise ValueError(f"expected {words}, got {value!r}")
    return float(value)


def not_negative(words: str, value: Any) -> float:
    """Return one finite number that is not negative, as a float; `words` say what is expected.

    Raises:
        ValueError: for anything else.

    """
    if not (_is_number(value) and 0.0 <= float(value) < np.inf):
        raise ValueError(f"expected {words}, got {value!r}")
    return float(value)


def _is_number(value: Any) -> bool:
    scalar = isinstance(value, Real) or (hasattr(value, "dtype") and np.ndim(value) == 0 and value.dtype.kind in "iuf")
    return scalar and not isinstance(value, bool | np.bool_)


def whole_number(words: str, value: Any, least: int) -> int:
    """Return a whole number of at least `least`.

    Raises:
        ValueError: for anything else.

    """
    if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
        raise ValueError(f"expected {words} to be a whole number of at least {least}, got {value!r}")
    return int(value)


def flag(words: str, value: Any) -> bool:
    """Return True or False.

    Raises:
        ValueError: for anything else, which would count as True.

    """
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"expected {words} to be True or False, got {value!r}")
    return bool(value)


def by_name(words: str, values: Any) -> dict[str, Any]:
    """Return a mapping from names as a dict, None as an empty one.

    Raises:
        ValueError: for what is no mapping, or names that are not strings.

    """
    if values is None:
        return {}
    if not isinstance(values, Mapping) or not all(isinstance(name, str) for name in values):
        raise ValueError(f"expected {words} by name, as a dict {{name: value}}, got {values!r}")
    return dict(values)


def instance(words: str, value: Any, kind: type[_Kind], remedy: str) -> _Kind:
    """Return a value of that class.

    Raises:
        ValueError: for one of another class, with the remedy.

    """
    if not isinstance(value, kind):
        raise ValueError(f"expected {words} to be a {kind.__name__}, got {type(value).__name__}: {remedy}")
    return value


def several(words: str, values: Any, kind: type[_Kind], remedy: str) -> tuple[_Kind, ...]:
    """Return one object of a class, or a sequence of them, as a tuple.

    Raises:
        ValueError: for none, or any of another class.

    """
    listed = (values,) if isinstance(values, kind) else tuple(values) if isinstance(values, Sequence) else ()
    if not listed or not all(isinstance(value, kind) for value in listed):
        others = sorted({type(v).__name__ for v in listed if not isinstance(v, kind)}) or [type(values).__name__]
        raise ValueError(
            f"expected a {kind.__name__} or a sequence of {kind.__name__}s for {words}, got "
            f"{', '.join(others) if values not in ((), []) else 'none'}: {remedy}"
        )
    return listed


def one_of(words: str, value: Any, choices: Sequence[str]) -> str:
    """Return one of the words that can be chosen.

    Raises:
        ValueError: for another.

    """
    if not isinstance(value, str) or value not in choices:
        listed = ", ".join(repr(c) for c in choices[:-1]) + f" or {choices[-1]!r}"
        raise ValueError(f"expected {words} to be {listed}, got {value!r}")
    return value


def file_path(words: str, value: Any) -> str | os.PathLike:
    """Return the path of a file.

    Raises:
        ValueError: for what is no path.

    """
    if not isinstance(value, str | os.PathLike) or not os.fspath(value):
        raise ValueError(f"expected {words} to be the path of a file, got {value!r}")
    return value
