"""Measured data: time, named inputs and named outputs, checked once, when a record is made."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float

from ehsvjax.columns import Column, csv_table, frame_table, mat_table, open_npz, pick, unknown_name, vector

if TYPE_CHECKING:
    import pandas

# Share of a period by which a time stamp may be off the uniform grid through the first and the last one.
# Stamps within 1 % of any straight line always keep to it, as the grid is then itself off by at most 1 %.
_TOLERANCE = 0.02


@dataclass(frozen=True, eq=False, repr=False)
class Record:
    """Measured (or simulated) signals on a common time, in SI units, immutable.

    Arrays are kept as read-only float64 copies. Raises ValueError (TypeError for names that are no strings)
    with a sentence that names the signal, the sample (counted from 0) and the remedy.

    Attributes:
        time: time stamps `[time]` in s, increasing and, unless `uniform=False`, uniform: rounding or jitter of up to
            1 % of a period passes.
        inputs: name -> values `[time]`. With `hold="zero"` an input is held from time[k] to time[k+1], with
            `hold="linear"` it is interpolated.
        outputs: name -> values `[time]`, sample k taken at time[k]. NaN is a missing sample and carries no weight.
            May be empty, for a record that is only simulated.
        hold: what the inputs do between samples, "zero" or "linear".
        name: what the record is called in print and in legends.
        uniform: False admits non-uniform time, for a record that is then resampled: `sample_period` refuses it.

    """

    time: Float[np.ndarray, " time"]
    inputs: Mapping[str, Float[np.ndarray, " time"]]
    outputs: Mapping[str, Float[np.ndarray, " time"]] = field(default_factory=dict)
    hold: Literal["zero", "linear"] = "zero"
    name: str = "record"
    uniform: bool = True

    def __post_init__(self) -> None:
        """Check and copy the arguments."""
        _check_hold(self.hold)
        _check_names(self.inputs, self.outputs)
        time = vector("time", self.time)
        inputs = {name: vector(f"input {name!r}", values) for name, values in self.inputs.items()}
        outputs = {name: vector(f"output {name!r}", values) for name, values in self.outputs.items()}
        _check_time(time)
        if self.uniform:
            _check_uniform(time)
        for name, values in inputs.items():
            _check_length(f"input {name!r}", values, time)
            _check_input(f"input {name!r}", values)
        for name, values in outputs.items():
            _check_length(f"output {name!r}", values, time)
            _check_output(f"output {name!r}", values)
        for values in (time, *inputs.values(), *outputs.values()):
            values.setflags(write=False)
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "inputs", MappingProxyType(inputs))
        object.__setattr__(self, "outputs", MappingProxyType(outputs))

    def __len__(self) -> int:
        """Count the samples."""
        return len(self.time)

    @property
    def duration(self) -> float:
        """Seconds from the first sample to the last."""
        return float(self.time[-1] - self.time[0])

    @property
    def sample_period(self) -> float:
        """Sample period in s, that of the straight line through the first and the last time stamp.

        Raises ValueError if the time of a record made with `uniform=False` is not uniform.
        """
        if not self.uniform:
            _check_uniform(self.time)
        return self.duration / (len(self) - 1)

    def slice(self, start: float = -math.inf, stop: float = math.inf) -> "Record":
        """Take the samples with start <= time < stop, in s of the record's own time, which they keep.

        A sample within 2 % of a period of a bound counts as lying on it, so rounded time stamps are cut where
        one expects. Raises ValueError if fewer than two samples are left, and where `Record` does: an output
        may be constant there.
        """
        first, last = (self._sample_from(bound) for bound in (start, stop))
        return self._cut(first, last)

    def split(self, at: float | None = None, *, fraction: float | None = None) -> tuple["Record", "Record"]:
        """Cut in two at a time in s (a sample on it opens the second part) or at a fraction of the samples.

        Raises ValueError unless exactly one of the two is given, or if a part has fewer than two samples.
        """
        if at is not None and fraction is None:
            middle = self._sample_from(at)
        elif at is None and fraction is not None and 0 < fraction < 1:
            middle = round(fraction * len(self))
        else:
            raise ValueError(
                "expected either a time (s) or a fraction between 0 and 1 to split at, "
                f"got at={at} and fraction={fraction}"
            )
        return self._cut(0, middle), self._cut(middle, len(self))

    def resample(self, sample_period: float) -> "Record":
        """Put the record on a uniform grid from its first time stamp on.

        Inputs follow their hold: zero-order hold takes the last value at or before the new time (2 % of a
        step early counts as at it, so that rounding delays nothing), linear interpolates. Outputs are
        interpolated linearly, also across a gap in the time stamps; a missing neighbour makes a missing
        sample. There is **no anti-aliasing**: before going to a coarser grid, low-pass the outputs yourself.
        Raises ValueError unless the period (s) is positive and at most the record's duration.
        """
        if not 0 < sample_period <= self.duration:
            raise ValueError(
                f"cannot resample {self.name!r} to a period of {sample_period} s: "
                f"expected a positive period of at most its duration of {self.duration:.6g} s"
            )
        count = math.floor(self.duration / sample_period + _TOLERANCE) + 1
        grid = sample_period * np.arange(count)
        stamps = np.linspace(0.0, self.duration, len(self)) if self.uniform else self.time - self.time[0]
        place = np.round(np.interp(grid, stamps, np.arange(len(self))), 6)  # in samples
        hold = _hold_last if self.hold == "zero" else _interpolate
        return replace(
            self,
            time=self.time[0] + grid,
            inputs={name: hold(values, place) for name, values in self.inputs.items()},
            outputs={name: _interpolate(values, place) for name, values in self.outputs.items()},
            uniform=True,
        )

    def select(self, *, outputs: Sequence[str]) -> "Record":
        """Keep the named outputs only, in the order given, and all inputs; ValueError for an unknown name."""
        if isinstance(outputs, str):
            raise TypeError(f"expected a list of output names, got a string: write outputs=[{outputs!r}]")
        for name in outputs:
            if name not in self.outputs:
                raise unknown_name("output", name, self.outputs, f"record {self.name!r}")
        return replace(self, outputs={name: self.outputs[name] for name in outputs})

    def to_dataframe(self) -> "pandas.DataFrame":
        """Copy to a pandas data frame: `time` (s), then the inputs, then the outputs by name (SI units)."""
        import pandas

        return pandas.DataFrame({"time": self.time, **self.inputs, **self.outputs})

    @classmethod
    def from_dataframe(
        cls,
        frame: "pandas.DataFrame",
        *,
        time: str | Column | float,
        inputs: Mapping[str, str | Column],
        outputs: Mapping[str, str | Column],
        hold: Literal["zero", "linear"] = "zero",
        name: str = "record",
        uniform: bool = True,
    ) -> "Record":
        """Read a pandas data frame.

        `inputs` and `outputs` say which column each signal is: `{"command": "valve_cmd_V"}` or, converted to
        SI units, `{"position": Column("position_V", scale=0.02)}`. `time` is a column as well or, where there
        is none, the sample period in s. Raises ValueError for a column that is unknown, repeated or not
        numeric, and where `Record` does.
        """
        signals = pick(frame_table(frame), "the data frame", time=time, inputs=inputs, outputs=outputs)
        return cls(*signals, hold, name, uniform)

    @classmethod
    def from_csv(
        cls,
        path: str | PathLike[str],
        *,
        time: str | Column | float,
        inputs: Mapping[str, str | Column],
        outputs: Mapping[str, str | Column],
        hold: Literal["zero", "linear"] = "zero",
        name: str | None = None,
        uniform: bool = True,
        **read_csv: Any,
    ) -> "Record":
        """Read a text file with a header; other keywords (`sep`, `comment`, ...) go to `pandas.read_csv`.

        Columns, their conversion and errors as in `from_dataframe`; `name` is by default the file's.
        """
        signals = pick(csv_table(path, **read_csv), str(path), time=time, inputs=inputs, outputs=outputs)
        return cls(*signals, hold, name or Path(path).stem, uniform)

    @classmethod
    def from_npz(
        cls,
        path: str | PathLike[str],
        *,
        time: str | Column | float,
        inputs: Mapping[str, str | Column],
        outputs: Mapping[str, str | Column],
        hold: Literal["zero", "linear"] = "zero",
        name: str | None = None,
        uniform: bool = True,
    ) -> "Record":
        """Read 1-D arrays of a NumPy archive by name; pickled content is refused, never loaded.

        Columns, their conversion and errors as in `from_dataframe`; `name` is by default the file's.
        """
        with open_npz(path) as table:
            signals = pick(table, str(path), time=time, inputs=inputs, outputs=outputs)
        return cls(*signals, hold, name or Path(path).stem, uniform)

    @classmethod
    def from_mat(
        cls,
        path: str | PathLike[str],
        *,
        time: str | Column | float,
        inputs: Mapping[str, str | Column],
        outputs: Mapping[str, str | Column],
        hold: Literal["zero", "linear"] = "zero",
        name: str | None = None,
        uniform: bool = True,
    ) -> "Record":
        """Read vectors of a MATLAB file (-v7 or older) by name; `data.position` is a field of a struct.

        Columns, their conversion and errors as in `from_dataframe`; `name` is by default the file's.
        """
        signals = pick(mat_table(path), str(path), time=time, inputs=inputs, outputs=outputs)
        return cls(*signals, hold, name or Path(path).stem, uniform)

    def __repr__(self) -> str:
        """Give the name, the samples and the range of every signal."""
        steps = np.diff(self.time)
        period = f"{self.sample_period:.6g} s" if self.uniform else f"{steps.min():.6g} to {steps.max():.6g} s"
        head = (
            f"Record {self.name!r}: {len(self)} samples every {period}, {self._span()}, "
            f"{'zero-order' if self.hold == 'zero' else 'linear'} hold"
        )
        width = max(map(len, [*self.inputs, *self.outputs]), default=0)
        inputs = [f"  input   {name:{width}}  {_range(values)}" for name, values in self.inputs.items()]
        outputs = [f"  output  {name:{width}}  {_range(values)}" for name, values in self.outputs.items()]
        return "\n".join([head, *inputs, *outputs])

    def __reduce__(self) -> tuple:
        """Pickle and copy by the constructor's arguments: a read-only mapping cannot be pickled itself."""
        return Record, (self.time, dict(self.inputs), dict(self.outputs), self.hold, self.name, self.uniform)

    def _span(self) -> str:
        return f"{self.time[0]:.6g} to {self.time[-1]:.6g} s"

    def _sample_from(self, bound: float) -> int:
        return int(np.searchsorted(self.time, bound - _TOLERANCE * np.diff(self.time).min()))

    def _cut(self, first: int, last: int) -> "Record":
        if last - first < 2:
            raise ValueError(
                f"this leaves {max(last - first, 0)} of the {len(self)} samples of {self.name!r} "
                f"({self._span()}): a record needs at least 2, choose other bounds"
            )
        return replace(
            self,
            time=self.time[first:last],
            inputs={name: values[first:last] for name, values in self.inputs.items()},
            outputs={name: values[first:last] for name, values in self.outputs.items()},
        )


def _check_hold(hold: Any) -> None:
    if hold not in ("zero", "linear"):
        raise ValueError(f"expected hold='zero' or hold='linear', got {hold!r}")


def _check_names(inputs: Any, outputs: Any) -> None:
    for kind, signals in (("inputs", inputs), ("outputs", outputs)):
        if not isinstance(signals, Mapping):
            raise TypeError(f"expected {kind} as a mapping from name to values, got {type(signals).__name__}")
        for name in signals:
            if not isinstance(name, str) or not name:
                raise TypeError(f"expected names of {kind} that are strings and not empty, got {name!r}")
            if name == "time":
                raise ValueError(f"'time' cannot be one of the {kind}: time is given apart, rename the signal")
    for name in inputs:
        if name in outputs:
            raise ValueError(f"signal {name!r} is both an input and an output: rename one or leave it out")


def _check_time(time: np.ndarray) -> None:
    if len(time) < 2:
        raise ValueError("time has 1 sample: a record needs at least 2, pass a longer one")
    unknown_time = ~np.isfinite(time)
    if unknown_time.any():
        row = _first(unknown_time)
        raise ValueError(f"time is {time[row]} at sample {row}: remove the row or fill in its time")
    standing = np.diff(time) <= 0
    if standing.any():
        row = _first(standing) + 1
        raise ValueError(
            f"time does not increase at sample {row} ({time[row]:.9g} s after {time[row - 1]:.9g} s): "
            "sort the rows by time and remove repeated ones"
        )


def _check_uniform(time: np.ndarray) -> None:
    period = (time[-1] - time[0]) / (len(time) - 1)
    straying = np.abs(time - np.linspace(time[0], time[-1], len(time))).max() / period
    if straying > _TOLERANCE:
        steps = np.diff(time)
        usual = np.median(steps)
        row = int(np.argmax(np.abs(steps - usual))) + 1
        raise ValueError(
            f"time is not uniform, it strays from a straight line by {straying:.2g} periods: sample {row} "
            f"comes {steps[row - 1]:.9g} s after sample {row - 1}, where {usual:.9g} s is usual; use "
            f"Record(..., uniform=False).resample({usual:.6g}), or even time if only its stamps are poor"
        )


def _check_length(label: str, values: np.ndarray, time: np.ndarray) -> None:
    if len(values) != len(time):
        raise ValueError(
            f"{label} has {len(values)} samples but time has {len(time)}: one of them ends before sample "
            f"{min(len(values), len(time))}, give both the same rows"
        )


def _check_input(label: str, values: np.ndarray) -> None:
    if np.isnan(values).all():
        raise ValueError(f"{label} is empty, all {len(values)} samples are NaN: check the name of its column")
    bad = ~np.isfinite(values)
    if bad.any():
        row = _first(bad)
        raise ValueError(
            f"{label} is {values[row]} at sample {row}: an input must be known throughout, fill the gap or cut it out"
        )


def _check_output(label: str, values: np.ndarray) -> None:
    if np.isinf(values).any():
        row = _first(np.isinf(values))
        raise ValueError(f"{label} is {values[row]} at sample {row}: set it to NaN if the sample is missing")
    present = np.flatnonzero(~np.isnan(values))
    if present.size == 0:
        raise ValueError(f"{label} is empty, all {len(values)} samples are NaN: leave it out or check its column")
    measured = values[present]
    if measured.min() == measured.max():
        raise ValueError(
            f"{label} never changes, it is {measured[0]:.9g} from sample {present[0]} to {present[-1]}: "
            "leave it out, or take a longer part of the record"
        )


def _first(mask: np.ndarray) -> int:
    return int(np.argmax(mask))


def _hold_last(values: np.ndarray, place: np.ndarray) -> np.ndarray:
    return values[np.floor(place + _TOLERANCE).astype(int)]


def _interpolate(values: np.ndarray, place: np.ndarray) -> np.ndarray:
    below = np.floor(place).astype(int)
    above = np.minimum(below + 1, len(values) - 1)
    share = place - below
    # on a sample, its neighbour may be missing
    return np.where(share == 0, values[below], (1 - share) * values[below] + share * values[above])


def _range(values: np.ndarray) -> str:
    missing = int(np.isnan(values).sum())
    return f"{np.nanmin(values):.6g} .. {np.nanmax(values):.6g}" + (f", {missing} missing" if missing else "")
