"""Tables out of MATLAB files: -v4 to -v7 by SciPy, -v7.3, which is HDF5, by h5py."""

import itertools
import math
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from ehsvjax.files import needed, reading
from ehsvjax.mat5 import check_elements

if TYPE_CHECKING:
    import h5py

_HDF5 = b"\x89HDF\r\n\x1a\n"
_DEFLATED = 1032  # at most as many bytes become one
_AGAIN = "save it again, with save(file, ..., '-v7')"


def mat_table(path: str | PathLike[str]) -> dict[str, Any]:
    """Variables of a MATLAB file, [n, 1] and [1, n] as [n]; fields of structs by dotted name.

    `data.position` is a field of a struct, `data.signals.0.values` a field of the first element of a struct
    array or cell. Those of a -v7.3 file are read when they are called. Raises ValueError for a file that cannot be
    read, ImportError for one of -v7.3 without h5py.
    """
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadWarning

    with reading(path, "a MATLAB file", _AGAIN), open(path, "rb") as file:
        head = file.read(520)
    if head.startswith(b"MATLAB 7.3 MAT-file") or _HDF5 in (head[:8], head[512:]):
        return _hdf5_table(path)
    with reading(path, "a MATLAB file", _AGAIN), open(path, "rb") as file, warnings.catch_warnings():
        if 0 not in head[:4]:  # it begins with a text, and is not of -v4
            check_elements(file.read())
            file.seek(0)
        warnings.simplefilter("error", MatReadWarning)  # a variable that cannot be read, or stands there twice
        variables = loadmat(file, appendmat=False, squeeze_me=True, struct_as_record=False)
    table: dict[str, Any] = {}
    for name, value in variables.items():
        if not name.startswith("__"):
            table |= _flatten(name, value)
    return table


def _flatten(name: str, value: Any) -> dict[str, Any]:
    if hasattr(value, "_fieldnames"):
        parts = {field: getattr(value, field) for field in value._fieldnames}
    elif isinstance(value, np.ndarray) and value.dtype == object:
        parts = dict(enumerate(value.flat))
    else:
        return {name: value}
    return {key: leaf for part, inside in parts.items() for key, leaf in _flatten(f"{name}.{part}", inside).items()}


def _hdf5_table(path: str | PathLike[str]) -> dict[str, Callable[[], np.ndarray]]:
    h5py = needed("h5py", "reading MATLAB -v7.3")
    boundary = partial(reading, path, "a MATLAB v7.3 (HDF5) file", _AGAIN)

    def read(place: str) -> np.ndarray:
        with boundary(), h5py.File(path, "r") as file:
            return _values(file[place])

    with boundary(), h5py.File(path, "r") as file:
        places = dict(_places("", file))
    return {name: partial(read, place) for name, place in places.items()}


def _places(name: str, node: Any) -> Iterator[tuple[str, str]]:
    """Names of the arrays in and below a group, and where they are in the file."""
    import h5py

    dot = f"{name}." if name else ""
    if isinstance(node, h5py.Group):
        for part in node:
            # '#refs#' holds what cells refer to; a link into another file is no part of this one
            if not part.startswith("#") and isinstance(node.get(part, getlink=True), h5py.HardLink):
                yield from _places(f"{dot}{part}", node[part])
    elif isinstance(node, h5py.Dataset) and node.dtype == h5py.ref_dtype:
        for index, reference in enumerate(node[()].T.flat):
            yield from _places(f"{dot}{index}", node.file[reference])
    elif isinstance(node, h5py.Dataset):
        yield name, node.name


def _values(dataset: "h5py.Dataset") -> np.ndarray:
    """The array as MATLAB has it, without axes of length 1; an object, such as a datetime, as a text that says so."""
    kind = dataset.attrs.get("MATLAB_class", dataset.dtype.name)
    kind = kind.decode() if isinstance(kind, bytes) else str(kind)
    if dataset.attrs.get("MATLAB_empty", 0):
        return np.zeros(0)
    if "MATLAB_object_decode" in dataset.attrs:
        return np.array(f"a {kind} of MATLAB")
    if dataset.dtype.names == ("real", "imag"):
        return np.squeeze(dataset["real"].T + 1j * dataset["imag"].T)
    _check_type(dataset, kind)
    _check_stored(dataset)
    values = np.squeeze(dataset[()].T)
    if kind == "char":
        return np.array("".join(chr(code) for code in values.ravel()))
    return values.astype(bool) if kind == "logical" else values


def _check_type(dataset: "h5py.Dataset", kind: str) -> None:
    """Refuse numbers whose bits are not laid out as those of the class are; others than double have their own name."""
    import h5py

    name = {"double": "float64", "single": "float32", "logical": "uint8", "char": "uint16"}.get(kind, kind)
    if dataset.dtype.name != name or dataset.id.get_type() != h5py.h5t.py_create(dataset.dtype):
        raise ValueError(f"an array of class {kind} whose numbers are stored as {dataset.dtype.name}")


def _check_stored(dataset: "h5py.Dataset") -> None:
    """Refuse what HDF5 would fill up with zeros, or take as it is: chunks that are not stored, lost filters."""
    stored = dataset.id.get_storage_size()
    if dataset.nbytes > _DEFLATED * stored:
        raise ValueError(f"an array of {dataset.nbytes} bytes of which {stored} are stored")
    if dataset.chunks is None:
        return
    corners = [range(0, size, step) for size, step in zip(dataset.shape, dataset.chunks, strict=True)]
    plain = math.prod(dataset.chunks) * dataset.dtype.itemsize
    if not dataset.id.get_create_plist().get_nfilters() and stored != plain * math.prod(map(len, corners)):
        raise ValueError(f"chunks of {plain} bytes, not compressed, in {stored} bytes")
    for corner in itertools.product(*corners):
        filters_skipped, chunk = dataset.id.read_direct_chunk(corner)  # raises where the index leads to no chunk
        if filters_skipped and len(chunk) != plain:
            raise ValueError(f"a chunk of {plain} bytes, not compressed, in {len(chunk)} bytes")
