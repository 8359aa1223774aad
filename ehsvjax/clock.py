"""Dates and clock times as seconds."""

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike


def seconds_of(raw: ArrayLike) -> Float[np.ndarray, " time"] | None:
    """Dates and clock times in s from the first one on, time differences in s as they are; NaN where one is missing.

    Understood are datetime64 and timedelta64, objects of `datetime` and pandas, and text that can be read in one way
    only: ISO 8601 dates and hh:mm:ss. Returns None for anything else, numbers and numbers as text among it.
    """
    import pandas

    values = np.asarray(raw)
    if values.ndim != 1 or values.dtype.kind not in "MmOUT":
        return None
    kind = pandas.api.types.infer_dtype(values, skipna=True)
    try:
        if kind.startswith("timedelta"):
            return _in_seconds(pandas.to_timedelta(values))
        if kind == "time":
            since_midnight = pandas.to_timedelta([str(value) for value in values])
            return _in_seconds(since_midnight - since_midnight[0])
        if kind == "string":
            stamps = _read(values)
        elif kind.startswith("date"):
            stamps = pandas.to_datetime(values, utc=True)
        else:
            return None
        return None if stamps is None else _in_seconds(stamps - stamps[0])
    except (ValueError, TypeError, OverflowError):  # no date after all, or one that pandas cannot hold
        return None


def _read(values: np.ndarray) -> Any:
    import pandas

    texts = [value for value in values if isinstance(value, str)]
    if all(text.count("-") >= 2 for text in texts):
        return pandas.to_datetime(values, format="ISO8601", utc=True)
    # without a colon pandas takes "5" for nanoseconds and "5 m" for minutes
    return pandas.to_timedelta(values) if all(":" in text for text in texts) else None


def _in_seconds(differences: Any) -> np.ndarray:
    return np.asarray(differences / np.timedelta64(1, "s"), dtype=np.float64)
