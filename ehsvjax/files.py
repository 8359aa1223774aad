"""Files at the edge: written whole or not at all, and what is wrong with one that cannot be read, in one sentence."""

import contextlib
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO


@contextlib.contextmanager
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


@contextlib.contextmanager
def reading(path: str | os.PathLike, what: str, remedy: str) -> Iterator[None]:
    """Turn whatever a library raises on a damaged file into one sentence.

    Args:
        path: the file.
        what: it should be, "a fit written by Fit.save".
        remedy: what to do, "save the fit again".

    Raises:
        ValueError: with the file, what was expected, what is wrong, and the remedy.
        OSError: if the file is not there or may not be read.

    """
    try:
        yield
    except OSError as error:
        # Where the system does not open a file it names it; elsewhere a library was led astray by what is in it.
        if error.filename is not None:
            raise
        raise ValueError(_sentence(path, what, error, remedy)) from error
    except Exception as error:
        raise ValueError(_sentence(path, what, error, remedy)) from error


def _sentence(path: str | os.PathLike, what: str, error: Exception, remedy: str) -> str:
    said = " ".join(str(error).split())
    return (
        f"expected {what} at {path}, got a file that cannot be read as one ({said or type(error).__name__}): {remedy}"
    )
