"""Sealed files: an NPZ of plain arrays and a JSON text, with a digest of both, so that no altered content is read."""

import hashlib
import json
import os
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ehsvjax.files import reading, unreadable, written_whole

VERSION = 2
"""Of the layout; version 1 had no digest."""

_CONTENT, _SEAL = "content", "seal"


class Sealed(NamedTuple):
    """What a sealed file holds: facts as JSON has them, and arrays by name."""

    facts: dict[str, Any]
    arrays: dict[str, np.ndarray]


def write_sealed(
    path: str | os.PathLike,
    kind: str,
    facts: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
    *,
    compressed: bool = True,
) -> None:
    """Write facts and arrays to one file, whole or not at all.

    Args:
        path: the file.
        kind: of what is in it, in a word: a file of another kind is not read.
        facts: what JSON can hold, NaN and infinities included.
        arrays: by name, of plain numbers.
        compressed: smaller, and slower to write.

    Raises:
        OSError: if it cannot be written; the old file then stays as it was.

    """
    text = json.dumps({"kind": kind, "version": VERSION, "facts": facts})
    content = np.frombuffer(text.encode(), np.uint8)
    everything: dict[str, Any] = {_CONTENT: content, **{_array(name): np.asarray(a) for name, a in arrays.items()}}
    # An open file keeps the name as given: numpy would append .npz to a path.
    with written_whole(path) as file:
        save = np.savez_compressed if compressed else np.savez
        save(file, **everything | {_SEAL: np.array(_digest(everything))})


def read_sealed(path: str | os.PathLike, kind: str, what: str, remedy: str) -> Sealed:
    """Read what `write_sealed` wrote; no pickle is run.

    Args:
        path: the file.
        kind: as it was written.
        what: words for what is expected there, "a fit written by Fit.save".
        remedy: what to do about another or a damaged file.

    Raises:
        ValueError: for another file, one of another kind or of a newer layout, or one whose content was altered.
        OSError: if the file is not there or may not be read.

    """
    with reading(path, what, remedy):
        everything = read_arrays(path)
    if not {_CONTENT, _SEAL} <= set(everything):
        held = ", ".join(everything) or "nothing"
        raise unreadable(path, what, f"it is of an older version of ehsvjax, or another file: it holds {held}", remedy)
    with reading(path, what, remedy):
        header = json.loads(everything[_CONTENT].tobytes().decode())
        found, version, facts = header["kind"], header["version"], header["facts"]
        seal = str(everything.pop(_SEAL))
    if version != VERSION:
        reason = f"it is of layout {version}, while this version of ehsvjax reads up to {VERSION}"
        raise unreadable(path, what, reason, "read it with the version that wrote it")
    if seal != _digest(everything):
        raise unreadable(path, what, "its content was altered after it was written", remedy)
    if found != kind:
        raise unreadable(path, what, f"it holds a {found}", remedy)
    arrays = {name.removeprefix(_array("")): a for name, a in everything.items() if name != _CONTENT}
    return Sealed(facts, arrays)


def read_arrays(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """Read every array of an NPZ file, in the file's order; raises whatever NumPy does."""
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def _array(name: str) -> str:
    return f"array/{name}"


def _digest(arrays: Mapping[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        digest.update(repr((name, array.dtype.str, array.shape)).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
