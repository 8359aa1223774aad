"""What a user's equations returned: its structure in words, compared with the one that was meant."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np


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
