"""Columns of numbers out of a table, converted to SI units.

A table is a mapping from column name to raw values, or to a function that reads them; `ehsvjax.readers` and
`ehsvjax.matlab` make one of a file. What makes a valid record of the columns is checked in `ehsvjax.record`.
"""

import difflib
from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ehsvjax.checks import as_number, shown
from ehsvjax.clock import seconds_of
from ehsvjax.files import reason_of


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
    sample period in s; dates and clock times count in s from the first sample on, time differences as they are. Lengths
    may differ here; they are compared by `Record`, which also refuses NaN and the like. Raises ValueError for an
    unknown column (with those known), a zero or infinite scale, or a column that is not a vector of real numbers;
    TypeError for a column that is neither a name nor a `Column`.
    """
    for kind, columns in (("inputs", inputs), ("outputs", outputs)):
        if not isinstance(columns, Mapping):
            raise TypeError(f"expected {kind} as a mapping from signal name to column, got {shown(columns)}")
    input_values = {name: _si_values(table, source, column) for name, column in inputs.items()}
    output_values = {name: _si_values(table, source, column) for name, column in outputs.items()}
    period = as_number(time)
    if period is not None:
        return Signals(_counted(period, input_values | output_values), input_values, output_values)
    return Signals(_si_values(table, source, time, is_time=True), input_values, output_values)


def vector(label: str, values: ArrayLike) -> Float[np.ndarray, " time"]:
    """Copy `values` to a new float64 array [time]; NaN and infinity pass.

    Raises ValueError, naming `label`, for an empty, masked or not one-dimensional array and for anything but
    real numbers.
    """
    try:
        array = np.asarray(values)
    except Exception as error:  # what NumPy, JAX or pandas say of ragged lists, traced values, ...
        raise ValueError(f"{label} is no array ({reason_of(error)}): expected one real number per sample") from None
    if isinstance(values, np.ma.MaskedArray):
        raise ValueError(f"{label} is a masked array: use .filled(numpy.nan), NaN is a missing output sample")
    if array.size == 0:
        raise ValueError(f"{label} is empty: expected one number per sample, check the column and its source")
    if array.dtype.kind not in "iuf":
        raise ValueError(_not_real(label, array.ravel()))
    if array.ndim != 1:
        raise ValueError(f"{label} has shape {array.shape}: expected 1-D, one number per sample; pass one column")
    return array.astype(np.float64)


def unknown_name(kind: str, name: str, known: Collection[str], source: str = "", remedy: str = "") -> ValueError:
    """Error for a name that is not there: lists those known (the first 30) and the nearest one, then the remedy."""
    near = difflib.get_close_matches(str(name), known, n=1)
    hint = f" (did you mean {near[0]!r}?)" if near else ""
    listed = ", ".join(repr(one[:60]) for one in list(known)[:30]) or "none"
    more = f" and {len(known) - 30} more" if len(known) > 30 else ""
    place = f" in {source}" if source else ""
    return ValueError(f"unknown {kind} {shown(name)}{place}{hint}; known: {listed}{more}{remedy and f': {remedy}'}")


def other_separator(header: str) -> str:
    """What to do about a header that came as one column, "" if it can be one."""
    separator = next((mark for mark in ";\t|" if mark in header), None)
    return f"give sep={separator!r}, and decimal=',' if the numbers have commas" if separator else ""


def _counted(period: float, signals: Mapping[str, np.ndarray]) -> np.ndarray:
    if not 0 < period < np.inf:
        raise ValueError(f"time={period} is not a sample period: give a positive number of seconds or a column name")
    if not signals:
        raise ValueError(f"time={period} needs an input or an output to count the samples of: name one")
    return period * np.arange(len(next(iter(signals.values()))))


def _si_values(table: Mapping[str, Any], source: str, column: Any, is_time: bool = False) -> np.ndarray:
    if not isinstance(column, str | Column):
        raise TypeError(f"expected a column name or a Column(name, scale, offset), got {shown(column)}")
    name, scale, offset = Column(column) if isinstance(column, str) else column
    if not (isinstance(name, str) and None not in (as_number(scale), as_number(offset))):
        raise TypeError(f"expected a name, a scale and an offset (a string and two numbers), got {shown(column)}")
    if name not in table:
        remedy = other_separator(next(iter(table))) if len(table) == 1 else ""
        raise unknown_name("column", name, table.keys(), source, remedy)
    label = f"column {name!r} of {source}"
    if not np.isfinite([scale, offset]).all() or scale == 0:
        raise ValueError(f"{label} has scale {scale}, offset {offset}: give finite numbers and a scale other than 0")
    raw = table[name]() if callable(table[name]) else table[name]
    seconds = seconds_of(raw) if is_time else None
    if seconds is None:
        return scale * vector(label, raw) + offset
    if scale != 1:
        raise ValueError(f"{label} holds dates or times, counted in s already: leave out its scale of {scale}")
    return seconds + offset


def _not_real(label: str, array: np.ndarray) -> str:
    row = 0
    if array.dtype.kind in "OUST":
        row = next((row for row, value in enumerate(array) if not _reads_as_number(value)), 0)
    remedy = {
        "c": "take its real part or its magnitude",
        "b": "convert it with .astype(float)",
        "M": "convert the dates to seconds",
        "m": "convert the time differences to seconds",
    }.get(array.dtype.kind) or _remedy_for_text(array, row)
    found = f"{str(array[row])[:60]!r} at sample {row} (dtype {array.dtype})"
    return f"{label} holds {found}: expected real numbers; {remedy}"


def _remedy_for_text(array: np.ndarray, row: int) -> str:
    text = str(array[row])
    if _reads_as_number(text.replace(",", ".", 1)) and "," in text:
        return "decimal=',' reads a decimal comma"
    first = row == 0 and not _reads_as_number(text)
    if first and len(array) > 1 and _reads_as_number(str(array[1]).replace(",", ".", 1)):
        return "skiprows=[1] leaves out a row of units below the header"
    if sum(text.count(mark) for mark in ".-/:") > 1 and any(digit in text for digit in "0123456789"):
        return (
            "as time, ISO 8601 dates and hh:mm:ss are read; for others parse_dates=[name], "
            "date_format='%d.%m.%Y %H:%M:%S.%f', as pandas.read_csv has them"
        )
    return "use .astype(float) or, in pandas.read_csv, skiprows, comment, na_values or decimal"


def _reads_as_number(value: Any) -> bool:
    try:
        float(value)
    except (TypeError, ValueError, OverflowError):
        return False
    return True
