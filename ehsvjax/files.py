"""Files at the edge: written whole or not at all; whatever a library raises while it reads one becomes one sentence.

    with reading(path, "a MATLAB file", "save it again with '-v7'"):
        variables = loadmat(path)

Only the library's calls belong inside; what the package itself refuses in the content is raised after the block, as
`unreadable`: PATH cannot be read as WHAT (REASON): REMEDY.
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

from ehsvjax.checks import file_path


@contextmanager
def written_whole(path: str | os.PathLike) -> Iterator[BinaryIO]:
    """Open a file to be written in bytes, which takes its place at `path` once it is complete.

    It is written beside `path` under a name that no other process uses, and renamed. Whatever goes wrong, a full disk
    or a kill, the old file stays as it was; of several that write one path at once the last wins, whole. What is no
    ordinary file (a pipe, `/dev/stdout`) is written as it is.

    Raises:
        ValueError: if `path` is no path.
        FileNotFoundError: if the folder is not there.
        OSError: for what else the system refuses, with the name of the path.

    """
    target = place_to_write("path", path)
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
            raise _refused_by_the_system(
                error, path, "written", "look at its folder and at the room on its disk"
            ) from None
        raise


def place_to_write(name: str, path: str | os.PathLike) -> Path:
    """Return where a file would be written: a link stays a link, the file that it points to is replaced.

    Raises:
        ValueError: if it is no path; `name` says of what.
        FileNotFoundError: if the folder is not there.
        IsADirectoryError: if it is a folder.

    """
    target = Path(file_path(name, path)).resolve()
    if not target.parent.is_dir():
        raise FileNotFoundError(f"expected the folder of {path} to be there, got none: make {target.parent} first")
    if target.is_dir():
        raise IsADirectoryError(f"expected {path} to be a file to write, got a folder: name a file in it")
    return target


@contextmanager
def reading(path: str | os.PathLike[str], what: str, remedy: str) -> Iterator[None]:
    """Run the block that reads the file `path` as `what`, e.g. "a MATLAB file"; `remedy` says what to do if it fails.

    Raises:
        ValueError: if `path` is no path; for an empty file; and with the library's reason for every error that the
            block raises: once the file is open, all that can be wrong is in it.
        OSError: of its usual kind (FileNotFoundError, PermissionError, IsADirectoryError), if there is nothing to open.

    """
    file_path("path", path, what)
    try:
        with open(path, "rb") as file:
            empty = not file.read(1)
    except OSError as error:
        remedy = f"check its name and folder, and who may read it; the current folder is {os.getcwd()}"
        raise _refused_by_the_system(error, path, "opened", remedy) from None
    if empty:
        raise unreadable(path, what, "it is empty", "check that its export, copy or download was completed")
    try:
        yield
    except Exception as error:
        raise unreadable(path, what, reason_of(error), remedy) from None


def unreadable(path: str | os.PathLike, what: str, reason: str, remedy: str) -> ValueError:
    """Return the error about what is in a file."""
    return ValueError(f"{path} cannot be read as {what} ({reason}): {remedy}")


def _refused_by_the_system(error: OSError, path: str | os.PathLike, done: str, remedy: str) -> OSError:
    """Return an error of the same kind that says what could not be done to the file, and what to do."""
    reason = (error.strerror or type(error).__name__).lower()
    said = type(error)(f"{path} cannot be {done} ({reason}): {remedy}")
    said.errno = error.errno
    return said


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
