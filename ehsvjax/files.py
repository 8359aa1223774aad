"""Files at the edge: written whole or not at all; whatever a library raises while it reads one becomes one sentence.

    with reading(path, "a MATLAB file", "save it again with '-v7'"):
        variables = loadmat(path)

Only the library's calls belong inside; what the package itself refuses in the content is raised after the block.
"""

import importlib
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import BinaryIO


@contextmanager
def written_whole(path: str | os.PathLike) -> Iterator[BinaryIO]:
    """Open a file to be written in bytes, which takes its place at `path` once it is complete.

    It is written beside `path` under a name that no other process uses, and renamed. Whatever goes wrong, a full disk
    or a kill, the old file stays as it was; of several that write one path at once the last wins, whole. What is no
    ordinary file (a pipe, `/dev/stdout`) is written as it is.

    Raises:
        FileNotFoundError: if the folder is not there.
        OSError: for what else the system refuses, with the name of the path.

    """
    # A link stays a link: the file that it points to is replaced.
    target = Path(path).resolve()
    if not target.parent.is_dir():
        raise FileNotFoundError(f"expected the folder of {path} to be there, got none: make {target.parent} first")
    if target.exists() and not target.is_file():
        with open(target, "wb") as file:
            yield file
        return
    beside = target.with_name(f".{target.name[:40]}.{secrets.token_hex(8)}.writing")
    try:
        with open(beside, "xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        if target.exists():
            shutil.copymode(target, beside)
        os.replace(beside, target)
    except BaseException as error:
        beside.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename in (None, str(beside)):
            error.filename = str(path)
        raise


@contextmanager
def reading(path: str | os.PathLike[str], what: str, remedy: str) -> Iterator[None]:
    """Run the block that reads the file `path` as `what`, e.g. "a MATLAB file"; `remedy` says what to do if it fails.

    Raises:
        TypeError: if `path` is no path.
        OSError: of its usual kind (FileNotFoundError, PermissionError, IsADirectoryError), if there is nothing to open.
        ValueError: for an empty file, and with the library's reason for every error that the block raises: once the
            file is open, all that can be wrong is in it.

    """
    if not isinstance(path, str | os.PathLike):
        raise TypeError(f"expected the path of {what}, got {type(path).__name__}: give a string or a pathlib.Path")
    try:
        with open(path, "rb") as file:
            empty = not file.read(1)
    except OSError as error:
        reason = (error.strerror or type(error).__name__).lower()
        raise type(error)(
            f"{path} cannot be opened ({reason}): check its name and folder, and who may read it; "
            f"the current folder is {os.getcwd()}"
        ) from None
    except ValueError as error:
        raise ValueError(f"{path!r} is not a path ({error}): give the name of a file") from None
    if empty:
        raise ValueError(f"{path} is an empty file: check that the export or the download was completed")
    try:
        yield
    except Exception as error:
        raise ValueError(f"{path} cannot be read as {what} ({reason_of(error)}): {remedy}") from None


def reason_of(error: Exception) -> str:
    """What an error of a library says, its kind and the first 160 characters, in one line."""
    words = " ".join(str(error).split()).rstrip(".")
    kind = type(error).__name__
    return f"{kind}: {words[:160]}{' ...' if len(words) > 160 else ''}" if words else kind


def needed(library: str, purpose: str) -> ModuleType:
    """Import an optional library; raises ImportError with the command that installs it."""
    try:
        return importlib.import_module(library)
    except ImportError:
        package = library.partition(".")[0]
        raise ImportError(
            f"{purpose} needs {package}, which is not installed: pip install {package}, or all readers with "
            "pip install 'ehsvjax[files]'"
        ) from None
