"""Columns of numbers out of data frames and files: CSV, NPZ and MATLAB.

A reader gives a table, that is a mapping from column name to raw values; `pick` takes the columns that are
asked for and converts them to SI units. What makes a valid record of them is checked in `ehsvjax.record`.
"""

import difflib
import warnings
import zipfile
from collections.abc import Collection, Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

if TYPE_CHECKING:
    import pandas


class Column(NamedTuple):
    """A column of a table and its conversion: SI value = scale * raw value + offset.

    `Column("valve_cmd_mV", scale=1e-3)` reads millivolts as volts; `offset` is in the SI unit.
    """

    name: str
    scale: float = 1.0
    offset: float = 0.0


class Signals(NamedTuple):
    """What `pick` found: time [time] in s, inputs and outputs name -> [time] in SI units."""

    time: Float[np.ndarray, " time"]
    inputs: dict[str, np.ndarray]
    outputs: dict[str, np.ndarray]


def pick(
    table: Mapping[str, Any],
    source: str,
    *,
    time: str | Column | float,
    inputs: Mapping[str, str | Column],
    outputs: Mapping[str, str | Column],
) -> Signals:
    """Take the named columns of a table as float64 in SI units.

    `source` is what error messages call the table. `time` is a column or, where the table has none, the
    sample period in s. Lengths may differ here; they are compared by `Record`, which also refuses NaN and the
    like. Raises ValueError for an unknown column (with those known), a zero or infinite scale, or a column
    that is not a vector of real numbers; TypeError for a column that is neither a name nor a `Column`.
    """
    for kind, columns in (("inputs", inputs), ("outputs", outputs)):
        if not isinstance(columns, Mapping):
            raise TypeError(f"expected {kind} as a mapping from signal name to column, got {columns!r}")
    input_values = {name: _si_values(table, source, column) for name, column in inputs.items()}
    output_values = {name: _si_values(table, source, column) for name, column in outputs.items()}
    if not isinstance(time, int | float | np.number):
        return Signals(_si_values(table, source, time), input_values, output_values)
    if not 0 < time < np.inf:
        raise ValueError(f"time={time} is not a sample period: give a positive number of seconds or a column name")
    if not (input_values or output_values):
        raise ValueError(f"time={time} needs an input or an output to count the samples of: name one")
    count = len(next(iter((input_values | output_values).values())))
    return Signals(time * np.arange(count), input_values, output_values)


def frame_table(frame: "pandas.DataFrame", source: str = "the data frame") -> dict[str, np.ndarray]:
    """Columns of a data frame by name; a name that is no string, as with header=None, by its str().

    Raises ValueError where two columns have one name.
    """
    names = [str(label) for label in frame.columns]
    repeated = next((name for name in names if names.count(name) > 1), None)
    if repeated is not None:
        raise ValueError(f"column {repeated!r} stands more than once in {source}: rename all but one")
    return {name: frame.iloc[:, index].to_numpy() for index, name in enumerate(names)}


def csv_table(path: str | PathLike[str], **options: Any) -> dict[str, np.ndarray]:
    """Columns of a text file by the names in its header; `options` go to `pandas.read_csv`.

    Raises ValueError for an empty file, a repeated name, or rows that are longer than the header.
    """
    import pandas

    _refuse_empty_file(path)
    try:
        with warnings.catch_warnings():
            # by default pandas takes the surplus fields for an index and shifts every column
            warnings.filterwarnings("error", "Length of header", pandas.errors.ParserWarning)
            frame = pandas.read_csv(path, **{"index_col": False, **options})
    except pandas.errors.ParserWarning:
        raise ValueError(
            f"the rows of {path} have more fields than its header: name them all (header=0, names=[...])"
        ) from None
    except pandas.errors.EmptyDataError:
        raise ValueError(f"{path} holds no columns: check skiprows and comment, or the export") from None
    # pandas renames the second 'x' to 'x.1'; names= says that the names are meant as they are
    repeated = [name for name in frame.columns if f"{name}.1" in frame.columns]
    if repeated and "names" not in options:
        raise ValueError(
            f"column {str(repeated[0])!r} stands more than once in {path} (or has a neighbour named "
            f"'{repeated[0]}.1'): rename one, or name all columns with header=0, names=[...]"
        )
    return frame_table(frame, str(path))


def open_npz(path: str | PathLike[str]) -> np.lib.npyio.NpzFile:
    """Open an archive written by `numpy.savez`, arrays by name, for a `with` block.

    An array is read when it is asked for; pickled content never is. Raises ValueError where it is no such
    archive.
    """
    _refuse_empty_file(path)
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{path} is not an NPZ archive: write one with numpy.savez(path, name=array, ...)")
    return np.load(path, allow_pickle=False)


def mat_table(path: str | PathLike[str]) -> dict[str, Any]:
    """Variables of a MATLAB file (-v4 to -v7), [n, 1] and [1, n] as [n]; fields of structs by dotted name.

    `data.position` is a field of a struct, `data.signals.0.values` a field of the first element of a struct
    array or cell. Raises ValueError for an empty file and for -v7.3 (HDF5).
    """
    from scipy.io import loadmat

    _refuse_empty_file(path)
    try:
        variables = loadmat(path, appendmat=False, squeeze_me=True, struct_as_record=False)
    except ValueError as error:
        raise ValueError(f"{path} cannot be read as a MATLAB file ({error}): save it with '-v7'") from None
    except NotImplementedError:
        raise ValueError(
            f"{path} is a MATLAB v7.3 (HDF5) file, which cannot be read: save it with save(file, ..., '-v7')"
        ) from None
    table: dict[str, Any] = {}
    for name, value in variables.items():
        if not name.startswith("__"):
            _flatten(name, value, table)
    return table


def vector(label: str, values: ArrayLike) -> Float[np.ndarray, " time"]:
    """Copy `values` to a new float64 array [time]; NaN and infinity pass.

    Raises ValueError, naming `label`, for an empty, masked or not one-dimensional array and for anything but
    real numbers.
    """
    array = np.asarray(values)
    if isinstance(values, np.ma.MaskedArray):
        raise ValueError(f"{label} is a masked array: use .filled(numpy.nan), NaN is a missing output sample")
    if array.size == 0:
        raise ValueError(f"{label} is empty: expected one number per sample, check the column and its source")
    if array.dtype.kind not in "iuf":
        raise ValueError(_not_real(label, array.ravel()))
    if array.ndim != 1:
        raise ValueError(f"{label} has shape {array.shape}: expected 1-D, one number per sample; pass one column")
    return array.astype(np.float64)


def unknown_name(kind: str, name: str, known: Collection[str], source: str = "") -> ValueError:
    """Error for a name that is not there: lists those known (the first 30) and the nearest one."""
    near = difflib.get_close_matches(name, known, n=1)
    hint = f" (did you mean {near[0]!r}?)" if near else ""
    listed = ", ".join(repr(one) for one in list(known)[:30]) or "none"
    more = f" and {len(known) - 30} more" if len(known) > 30 else ""
    place = f" in {source}" if source else ""
    return ValueError(f"unknown {kind} {name!r}{place}{hint}; known: {listed}{more}")


def _si_values(table: Mapping[str, Any], source: str, column: str | Column) -> np.ndarray:
    if not isinstance(column, str | Column):
        raise TypeError(f"expected a column name or a Column(name, scale, offset), got {column!r}")
    name, scale, offset = Column(column) if isinstance(column, str) else column
    if name not in table:
        raise unknown_name("column", name, table.keys(), source)
    label = f"column {name!r} of {source}"
    if not np.isfinite([scale, offset]).all() or scale == 0:
        raise ValueError(f"{label} has scale {scale}, offset {offset}: give finite numbers and a scale other than 0")
    try:
        raw = table[name]
    except ValueError as error:  # an NPZ array is read only here
        raise ValueError(
            f"{label} is not a plain array ({error}): pickled content is never loaded, save it as numbers"
        ) from None
    return scale * vector(label, raw) + offset


def _flatten(name: str, value: Any, table: dict[str, Any]) -> None:
    if hasattr(value, "_fieldnames"):
        for field in value._fieldnames:
            _flatten(f"{name}.{field}", getattr(value, field), table)
    elif isinstance(value, np.ndarray) and value.dtype == object:
        for index, element in enumerate(value.flat):
            _flatten(f"{name}.{index}", element, table)
    else:
        table[name] = value


def _refuse_empty_file(path: str | PathLike[str]) -> None:
    if Path(path).stat().st_size == 0:
        raise ValueError(f"{path} is an empty file: check that the export or the download was completed")


def _not_real(label: str, array: np.ndarray) -> str:
    remedy = {
        "c": "take its real part or its magnitude",
        "b": "convert it with .astype(float)",
        "M": "convert the dates to seconds",
        "m": "convert the time differences to seconds",
    }.get(array.dtype.kind, "use .astype(float) or, in pandas.read_csv, skiprows, comment, na_values or decimal")
    row = 0
    if array.dtype.kind in "OUST":
        row = next((row for row, value in enumerate(array) if not _reads_as_number(value)), 0)
    found = f"{str(array[row])!r} at sample {row} (dtype {array.dtype})"
    return f"{label} holds {found}: expected real numbers; {remedy}"


def _reads_as_number(value: Any) -> bool:
    try:
        float(value)
    except (TypeError, ValueError):
        return False
    return True
