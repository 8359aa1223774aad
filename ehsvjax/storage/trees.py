"""Results as JSON and arrays, and back: NamedTuples and dataclasses of this package, whatever their fields.

What is immutable and larger than a number is listed once, in `objects`, and referred to by its place there: two fields
that hold the same record hold one record again when they are read.
"""

import contextlib
import dataclasses
import functools
import importlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ehsvjax.effects.effect import Effect
from ehsvjax.models.model import Model
from ehsvjax.storage.models import describe_effect, describe_model, find_effect, find_model

_PACKAGE = __name__.partition(".")[0]


class Tree(NamedTuple):
    """A result taken apart: JSON facts of each object, those that it refers to before it, and arrays by name."""

    objects: list[dict[str, Any]]
    arrays: dict[str, np.ndarray]


def as_tree(result: Any) -> Tree:
    """Take a result apart.

    Raises:
        TypeError: for what no file can hold, such as a function.

    """
    tree = Tree([], {})
    _encoded(result, tree, {})
    return tree


def from_tree(tree: Tree, model: Model | None, bank: Sequence[Effect]) -> Any:
    """Put a result together again.

    Args:
        tree: as `as_tree` gave it.
        model: the user's own, or None: then all models are made again by this package.
        bank: where effects are looked up.

    Raises:
        ValueError: if a model or an effect is missing, or another one, or if this version of the package knows no
            result of that form.

    """
    made: list[Any] = []
    for one in tree.objects:
        made.append(_made(one, tree.arrays, made, model, bank))
    return made[-1]


def _encoded(value: Any, tree: Tree, places: dict[int, tuple[Any, int]]) -> Any:
    """Return the JSON form of a value; `places` holds the objects that are listed, by identity, and where."""
    if value is None or type(value) in (bool, int, float, str):
        return value

    def encoded(value):
        return _encoded(value, tree, places)

    if type(value) is list:
        return {"list": [encoded(v) for v in value]}
    if type(value) is tuple:
        return {"tuple": [encoded(v) for v in value]}
    if isinstance(value, Mapping):
        return {"dict": [[encoded(k), encoded(v)] for k, v in value.items()]}
    if id(value) not in places:
        described = _described(value, tree, encoded)
        tree.objects.append(described)
        # Kept with its place: an object that is gone would give its identity to another.
        places[id(value)] = value, len(tree.objects) - 1
    return {"object": places[id(value)][1]}


def _described(value: Any, tree: Tree, encoded: Callable) -> dict[str, Any]:
    if isinstance(value, Model):
        return {"model": describe_model(value, encoded)}
    if isinstance(value, Effect):
        return {"effect": describe_effect(value)}
    kind = type(value)
    if kind.__module__.startswith(f"{_PACKAGE}.") and (fields := _fields(kind)):
        contents = {name: encoded(getattr(value, name)) for name in fields}
        return {"result": {"type": [kind.__module__, kind.__qualname__], "fields": contents}}
    if _is_frame(value):
        return {"frame": _described_frame(value, encoded)}
    if isinstance(value, np.ndarray | np.generic) or hasattr(value, "__array__"):
        array = np.asarray(value)
        if array.dtype.kind not in "biufcUS":
            raise TypeError(f"expected an array of numbers or text to store, got one of {array.dtype}")
        name = str(len(tree.arrays))
        tree.arrays[name] = array
        return {"scalar" if isinstance(value, np.generic) else "array": name}
    raise TypeError(f"expected numbers, text, arrays, tables and results of this package to store, got {kind.__name__}")


def _fields(kind: type) -> tuple[str, ...]:
    if dataclasses.is_dataclass(kind):
        return tuple(field.name for field in dataclasses.fields(kind) if field.init)
    return kind._fields if issubclass(kind, tuple) and hasattr(kind, "_fields") else ()


def _is_frame(value: Any) -> bool:
    return type(value).__name__ == "DataFrame" and type(value).__module__.startswith("pandas")


def _described_frame(frame: Any, encoded: Callable) -> dict[str, Any]:
    if not frame.columns.is_unique:
        raise TypeError("expected a table whose columns have different names to store, got some twice")

    def column(values):
        plain = isinstance(values.dtype, np.dtype) and values.dtype.kind in "biufc"
        return encoded(values.to_numpy() if plain else values.tolist()), str(values.dtype)

    return {"columns": [[name, *column(frame[name])] for name in frame.columns], "index": column(frame.index)}


def _made(
    one: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
    made: Sequence[Any],
    model: Model | None,
    bank: Sequence[Effect],
) -> Any:
    """Return one listed object, made of those before it."""
    decoded = functools.partial(_decoded, made)
    ((form, content),) = one.items()
    if form == "model":
        return find_model(content, decoded, model)
    if form == "effect":
        return find_effect(content, bank)
    if form == "result":
        return _result(content["type"], {name: decoded(value) for name, value in content["fields"].items()})
    if form == "frame":
        return _frame(content["columns"], content["index"], decoded)
    array = arrays[content]
    return array[()] if form == "scalar" else array


def _decoded(made: Sequence[Any], value: Any) -> Any:
    """Return a value from its JSON form."""
    if not isinstance(value, dict):
        return value
    ((form, content),) = value.items()
    if form == "object":
        return made[content]
    if form == "dict":
        return {_decoded(made, k): _decoded(made, v) for k, v in content}
    items = [_decoded(made, v) for v in content]
    return tuple(items) if form == "tuple" else items


def _frame(columns, index, decoded: Callable) -> Any:
    import pandas as pd

    rows = pd.Index(decoded(index[0]), dtype=index[1])
    return pd.DataFrame({name: pd.Series(decoded(v), dtype=dtype, index=rows) for name, v, dtype in columns}, rows)


def _result(kind: Sequence[str], fields: dict[str, Any]) -> Any:
    """Return a NamedTuple or a dataclass of this package; nothing else is ever made."""
    (module, name), found = kind, None
    if module.startswith(f"{_PACKAGE}."):
        with contextlib.suppress(ImportError):
            found = getattr(importlib.import_module(module), name, None)
    known = _fields(found) if isinstance(found, type) else ()
    if found is None or not known or not set(fields) <= set(known):
        unknown = ", ".join(sorted(set(fields) - set(known)))
        raise ValueError(f"{name} of another version of {_PACKAGE} (this one does not know {unknown or 'it'})")
    try:
        return found(**fields)
    except TypeError:
        missing = ", ".join(sorted(set(known) - set(fields)))
        raise ValueError(f"{name} of another version of {_PACKAGE} (this one has also {missing})") from None
