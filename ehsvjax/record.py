"""Measured data: time, named inputs and named outputs, checked once, when a record is made."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from ehsvjax.checks import as_number, file_path, flag, instance, number, refused, shown
from ehsvjax.columns import Column, pick, unknown_name, vector
from ehsvjax.files import written_whole
from ehsvjax.holds import WORDS, interpolated
from ehsvjax.matlab import mat_table
from ehsvjax.readers import csv_table, excel_table, frame_table, npz_table, parquet_table
from ehsvjax.record_checks import (
    TOLERANCE,
    check_names,
    check_samples,
    check_settings,
    check_time,
    check_uniform,
    checked_constants,
    checked_hold,
)

if TYPE_CHECKING:
    import matplotlib.figure
    import pandas

    from ehsvjax.inspection import Inspection
    from ehsvjax.models.model import Model

Hold = str | Mapping[str, str]
"""What inputs do between samples, one of `holds.HOLDS` for all, or by name; those that are not named are held."""


@dataclass(frozen=True, eq=False, repr=False)
class Record:
    """Measured (or simulated) signals on a common time, in SI units, immutable.

    Arrays are kept as read-only float64 copies. Raises ValueError (TypeError for names that are no strings)
    with a sentence that names the signal, the sample (counted from 0) and the remedy.

    Attributes:
        time: time stamps `[time]` in s, increasing and, unless `uniform=False`, uniform: rounding or jitter of up to
            1 % of a period passes.
        inputs: name -> values `[time]`. With `hold="zero"` an input is held from time[k] to time[k+1], with
            `hold="linear"` it runs straight to the next value, with `hold="band-limited"` it is the smooth curve that
            its samples fix, as behind a generator's or an amplifier's reconstruction filter (`ehsvjax.holds`).
        outputs: name -> values `[time]`, sample k taken at time[k]. NaN is a missing sample and carries no weight.
            May be empty, for a record that is only simulated.
        hold: what the inputs do between samples, "zero", "linear" or "band-limited". By name where they differ:
            {"reference": "linear", "pulse": "zero"}; those that are not named are held.
        name: what the record is called in print and in legends.
        uniform: False admits non-uniform time, for a record that is then resampled: `sample_period` refuses it.
        constants: name of a model's parameter -> its value, SI, where it is known for this record and may be another in
            other records: the supply pressure of that day, a load mass. It holds whatever is said or found elsewhere.

    """

    time: Float[np.ndarray, " time"]
    inputs: Mapping[str, Float[np.ndarray, " time"]]
    outputs: Mapping[str, Float[np.ndarray, " time"]] = field(default_factory=dict)
    hold: Hold = "zero"
    name: str = "record"
    uniform: bool = True
    constants: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check and copy the arguments."""
        check_settings(self.name, self.uniform)
        check_names(self.inputs, self.outputs)
        hold = checked_hold(self.hold, self.inputs)
        time = vector("time", self.time)
        inputs = {name: vector(f"input {name!r}", values) for name, values in self.inputs.items()}
        outputs = {name: vector(f"output {name!r}", values) for name, values in self.outputs.items()}
        check_time(time)
        if self.uniform:
            check_uniform(time)
        check_samples(time, inputs, outputs)
        for values in (time, *inputs.values(), *outputs.values()):
            values.setflags(write=False)
        object.__setattr__(self, "time", time)
        object.__setattr__(self, "inputs", MappingProxyType(inputs))
        object.__setattr__(self, "outputs", MappingProxyType(outputs))
        object.__setattr__(self, "hold", hold)
        object.__setattr__(self, "constants", MappingProxyType(checked_constants(self.constants)))

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
            check_uniform(self.time)
        return self.duration / (len(self) - 1)

    def hold_of(self, name: str) -> str:
        """Say what one input does between samples: "zero", "linear" or "band-limited"."""
        return self.hold.get(name, "zero") if isinstance(self.hold, Mapping) else self.hold

    def slice(self, start: float = -math.inf, stop: float = math.inf) -> "Record":
        """Take the samples with start <= time < stop, in s of the record's own time, which they keep.

        A sample within 2 % of a period of a bound counts as lying on it, so rounded time stamps are cut where
        one expects. Raises ValueError if fewer than two samples are left, and where `Record` does: an output
        may be constant there; TypeError for bounds that are no numbers.
        """
        first, last = (self._sample_from(bound) for bound in (start, stop))
        return self._cut(first, last if start < stop else first)

    def split(self, at: float | None = None, *, fraction: float | None = None) -> tuple["Record", "Record"]:
        """Cut in two at a time in s (a sample on it opens the second part) or at a fraction of the samples.

        Raises ValueError unless exactly one of the two is given, or if a part has fewer than two samples, TypeError for
        a time that is no number.
        """
        if at is not None and fraction is None:
            middle = self._sample_from(at)
        elif at is None and 0.0 < (share := as_number(fraction) or 0.0) < 1.0:
            middle = round(share * len(self))
        else:
            raise ValueError(
                "expected either a time (s) or a fraction between 0 and 1 to split at, "
                f"got at={shown(at)} and fraction={shown(fraction)}"
            )
        return self._cut(0, middle), self._cut(middle, len(self))

    def stretches(self, condition: Any, *, shortest: float = 0.0, bridged: float = 0.0) -> list["Record"]:
        """Take every stretch in which a condition holds, `[time]` of true and false, as a record of its own.

        Strokes one by one, `record.stretches(record.inputs["command"] > 0.0)`, or all but the rests. Interruptions of
        up to `bridged` s, as by a spike, do not end a stretch; those of less than `shortest` s, or of fewer than two
        samples, are left out.

        Raises ValueError for a condition that is none, times that are no positive numbers or zero, and where no stretch
        is long enough.
        """
        holds = np.asarray(condition)
        if holds.shape != (len(self),) or holds.dtype != bool:
            remedy = 'compare a series with a value: record.inputs["command"] > 0.0'
            raise refused("condition", f"true or false at each of the {len(self)} samples", condition, remedy)
        for name, value in (("shortest", shortest), ("bridged", bridged)):
            number(name, value, "zero or more seconds", lambda x: x >= 0.0)
        # Where it begins to hold and where it ends, in pairs.
        edges = np.flatnonzero(np.diff(holds, prepend=False, append=False)).reshape(-1, 2)
        until = np.append(self.time, self.time[-1] + self.duration / (len(self) - 1))
        apart = until[edges[1:, 0]] - until[edges[:-1, 1]] > bridged * (1.0 + TOLERANCE)
        first, last = edges[np.append(True, apart)[: len(edges)], 0], edges[np.append(apart, True)[: len(edges)], 1]
        long = (until[last] - until[first] >= shortest * (1.0 - TOLERANCE)) & (last - first > 1)
        if not long.any():
            raise ValueError(
                f"expected the condition to hold for two samples of {self.name!r} and {shortest:g} s at least, got "
                f"{holds.sum()} of {len(self)} samples where it does, in {len(first)} stretches: choose another one"
            )
        return [
            replace(self._cut(a, b), name=f"{self.name}, {until[a]:.4g} to {until[b]:.4g} s")
            for a, b in zip(first[long].tolist(), last[long].tolist(), strict=True)
        ]

    def resample(self, sample_period: float, *, inputs_known_in_gaps: bool = False) -> "Record":
        """Put the record on a uniform grid from its first time stamp on.

        Inputs follow their hold: zero-order hold takes the last value at or before the new time (2 % of a
        step early counts as at it, so that rounding delays nothing), linear interpolates, and so does a band-limited
        one, by its smooth curve, where the time stamps are uniform. Outputs are interpolated linearly; a missing
        neighbour makes a missing sample. There is **no anti-aliasing**: before going to a coarser grid, low-pass the
        outputs yourself.

        A step of the time stamps longer than two usual ones (their median; half a one more, for jitter) is a gap.
        Nothing is known of the outputs there, they are missing samples; nor of the inputs, which cannot be missing, so
        that the gap is refused unless `inputs_known_in_gaps` says that they kept to their hold there too, as a command
        does that is logged when it changes.

        Raises ValueError for a gap in the inputs, for a band-limited input whose time is not uniform, and unless the
        period (s) is positive, at most the record's duration and not so short that there were more than 10^8 samples.
        """
        if not 0.0 < (as_number(sample_period) or 0.0) <= self.duration:
            raise ValueError(
                f"cannot resample {self.name!r} to a period of {shown(sample_period)} s: "
                f"expected a positive period of at most its duration of {self.duration:.6g} s"
            )
        if self.duration / sample_period > 1e8:
            raise ValueError(
                f"cannot resample {self.name!r} to a period of {sample_period} s: its {self.duration:.6g} s would be "
                "more than 1e8 samples, is the period in s?"
            )
        flag("inputs_known_in_gaps", inputs_known_in_gaps)
        if not self.uniform and any(self.hold_of(name) == "band-limited" for name in self.inputs):
            raise ValueError(
                f"cannot resample {self.name!r}: the smooth curve of a band-limited input is known from uniform "
                "samples only; resample it with hold='linear' and declare the hold of the result"
            )
        gaps = _gaps(self.time)
        if self.inputs and gaps.any() and not inputs_known_in_gaps:
            raise ValueError(_unknown_inputs(self.name, self.time, gaps))
        count = math.floor(self.duration / sample_period + TOLERANCE) + 1
        grid = sample_period * np.arange(count)
        stamps = np.linspace(0.0, self.duration, len(self)) if self.uniform else self.time - self.time[0]
        place = np.round(np.interp(grid, stamps, np.arange(len(self))), 6)  # in samples
        unknown = (place % 1 > 0) & np.append(gaps, False)[place.astype(int)]
        return replace(
            self,
            time=self.time[0] + grid,
            inputs={name: _between(values, place, self.hold_of(name)) for name, values in self.inputs.items()},
            outputs={
                name: np.where(unknown, np.nan, _interpolate(values, place)) for name, values in self.outputs.items()
            },
            uniform=True,
        )

    def within(self, **ranges: Any) -> "Record":
        """Mark readings at or beyond the ends of a sensor's range as missing: `within(position=(-0.1, 0.194))`.

        A reading at the end of a sensor is no measurement. Ends are in SI units; one that there is not is infinite.
        Raises ValueError for a name that is no output, or ends that are not in order.
        """
        outputs = dict(self.outputs)
        for name, ends in ranges.items():
            if name not in outputs:
                raise ValueError(f"expected outputs of {self.name!r} ({', '.join(outputs) or 'none'}), got {name!r}")
            pair = tuple(ends) if isinstance(ends, Sequence) and not isinstance(ends, str) else ()
            if len(pair) != 2 or None in map(as_number, pair) or not pair[0] < pair[1]:
                raise ValueError(f"expected the ends of {name} as a pair (low, high), got {shown(ends)}")
            outputs[name] = np.where((outputs[name] > pair[0]) & (outputs[name] < pair[1]), outputs[name], np.nan)
        return replace(self, outputs=outputs)

    def check(self, model: "Model | None" = None) -> "Inspection":
        """Look at the record before any fit: a line for each signal, passed or not, with what to do.

        Ends of sensors, signals that stand still, steps of a lattice, readings that stand alone or are missing, levels
        and band of the inputs; and with a model whether it can mean the record at all: its names, its time, its signs
        and units. Print it, or let a notebook show it.

        Raises ValueError for a model that is none.
        """
        from ehsvjax.inspection import inspected
        from ehsvjax.models.model import Model

        if model is not None:
            instance("model", model, Model, "make one, such as ehsvjax.servovalve()")
        return inspected(self, model)

    def plot(self) -> "matplotlib.figure.Figure":
        """Draw every input and output over time; missing readings are marked below."""
        from ehsvjax.plots import plot_record

        return plot_record(self)

    def select(self, *, outputs: Sequence[str]) -> "Record":
        """Keep the named outputs only, in the order given, and all inputs; ValueError for an unknown name."""
        if isinstance(outputs, str):
            raise TypeError(f"expected a list of output names, got a string: write outputs=[{outputs!r}]")
        if not isinstance(outputs, Iterable):
            raise TypeError(f"expected a list of output names, got {shown(outputs)}")
        outputs = list(outputs)
        for name in outputs:
            if not isinstance(name, str) or name not in self.outputs:
                raise unknown_name("output", name, self.outputs, f"record {self.name!r}")
            if outputs.count(name) > 1:
                raise ValueError(f"output {name!r} is named {outputs.count(name)} times: name it once")
        return replace(self, outputs={name: self.outputs[name] for name in outputs})

    def at(self, **constants: float) -> "Record":
        """Say what is known about this record besides: `record.at(supply_pressure=70e5)`.

        Raises ValueError for a value that is no finite number.
        """
        return replace(self, constants={**self.constants, **constants})

    def to_dataframe(self) -> "pandas.DataFrame":
        """Copy to a pandas data frame: `time` (s), then the inputs, then the outputs by name (SI units)."""
        import pandas

        return pandas.DataFrame({"time": self.time, **self.inputs, **self.outputs})

    def to_csv(self, path: str | PathLike[str]) -> None:
        """Write `to_dataframe()` as a text file with a header, to the last digit; `from_csv` reads it.

        Raises OSError if it cannot be written; a file that was there stays as it was.
        """
        with written_whole(Path(file_path("path", path))) as whole:
            whole.write(self.to_dataframe().to_csv(index=False).encode())

    @classmethod
    def from_dataframe(
        cls,
        frame: "pandas.DataFrame",
        *,
        time: str | Column | float,
        inputs: Mapping[str, str | Column],
        outputs: Mapping[str, str | Column],
        hold: Hold = "zero",
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
        hold: Hold = "zero",
        name: str | None = None,
        uniform: bool = True,
        **read_csv: Any,
    ) -> "Record":
        """Read a text file with a header; other keywords (`sep`, `comment`, ...) go to `pandas.read_csv`.

        Columns, their conversion and errors as in `from_dataframe`; `name` is by default the file's.
        """
        signals = pick(csv_table(path, **read_csv), str(path), time=time, inputs=inputs, outputs=outputs)
        return cls(*signals, hold, Path(path).stem if name is None else name, uniform)

    @classmethod
    def from_excel(
        cls,
        path: str | PathLike[str],
        *,
        time: str | Column | float,
        inputs: Mapping[str, str | Column],
        outputs: Mapping[str, str | Column],
        hold: Hold = "zero",
        name: str | None = None,
        uniform: bool = True,
        **read_excel: Any,
    ) -> "Record":
        """Read a sheet of an Excel workbook with a header; other keywords go to `pandas.read_excel`. Needs openpyxl.

        Columns, their conversion and errors as in `from_dataframe`; `name` is by default the file's.
        """
        signals = pick(excel_table(path, **read_excel), str(path), time=time, inputs=inputs, outputs=outputs)
        return cls(*signals, hold, Path(path).stem if name is None else name, uniform)

    @classmethod
    def from_parquet(
        cls,
        path: str | PathLike[str],
        *,
        time: str | Column | float,
        inputs: Mapping[str, str | Column],
        outputs: Mapping[str, str | Column],
        hold: Hold = "zero",
        name: str | None = None,
        uniform: bool = True,
    ) -> "Record":
        """Read columns of a parquet file by name. Needs pyarrow.

        Columns, their conversion and errors as in `from_dataframe`; `name` is by default the file's.
        """
        signals = pick(parquet_table(path), str(path), time=time, inputs=inputs, outputs=outputs)
        return cls(*signals, hold, Path(path).stem if name is None else name, uniform)

    @classmethod
    def from_npz(
        cls,
        path: str | PathLike[str],
        *,
        time: str | Column | float,
        inputs: Mapping[str, str | Column],
        outputs: Mapping[str, str | Column],
        hold: Hold = "zero",
        name: str | None = None,
        uniform: bool = True,
    ) -> "Record":
        """Read 1-D arrays of a NumPy archive by name; pickled content is refused, never loaded.

        Columns, their conversion and errors as in `from_dataframe`; `name` is by default the file's.
        """
        signals = pick(npz_table(path), str(path), time=time, inputs=inputs, outputs=outputs)
        return cls(*signals, hold, Path(path).stem if name is None else name, uniform)

    @classmethod
    def from_mat(
        cls,
        path: str | PathLike[str],
        *,
        time: str | Column | float,
        inputs: Mapping[str, str | Column],
        outputs: Mapping[str, str | Column],
        hold: Hold = "zero",
        name: str | None = None,
        uniform: bool = True,
    ) -> "Record":
        """Read vectors of a MATLAB file by name; `data.position` is a field of a struct. -v7.3 needs h5py.

        Columns, their conversion and errors as in `from_dataframe`; `name` is by default the file's.
        """
        signals = pick(mat_table(path), str(path), time=time, inputs=inputs, outputs=outputs)
        return cls(*signals, hold, Path(path).stem if name is None else name, uniform)

    def __repr__(self) -> str:
        """Give the name, the samples and the range of every signal."""
        steps = np.diff(self.time)
        period = f"{self.sample_period:.6g} s" if self.uniform else f"{steps.min():.6g} to {steps.max():.6g} s"
        head = f"Record {self.name!r}: {len(self)} samples every {period}, {self._span()}, {self._held()}"
        width = max(map(len, [*self.inputs, *self.outputs]), default=0)
        inputs = [f"  input   {name:{width}}  {_range(values)}" for name, values in self.inputs.items()]
        outputs = [f"  output  {name:{width}}  {_range(values)}" for name, values in self.outputs.items()]
        constants = [f"  at {name} = {value:.6g}" for name, value in self.constants.items()]
        return "\n".join([head, *inputs, *outputs, *constants])

    def __reduce__(self) -> tuple:
        """Pickle and copy by the constructor's arguments: a read-only mapping cannot be pickled itself."""
        signals = (self.time, dict(self.inputs), dict(self.outputs))
        hold = dict(self.hold) if isinstance(self.hold, Mapping) else self.hold
        return Record, (*signals, hold, self.name, self.uniform, dict(self.constants))

    def _held(self) -> str:
        """Say in words what the inputs do between samples."""
        by_hold: dict[str, list[str]] = {}
        for name in self.inputs:
            by_hold.setdefault(WORDS[self.hold_of(name)], []).append(name)
        if len(by_hold) < 2:
            return next(iter(by_hold), WORDS["zero"])
        return ", ".join(f"{hold} of {' and '.join(names)}" for hold, names in by_hold.items())

    def _span(self) -> str:
        return f"{self.time[0]:.6g} to {self.time[-1]:.6g} s"

    def _sample_from(self, bound: float) -> int:
        if as_number(bound) is None:
            raise TypeError(f"expected a time in s to cut {self.name!r} at ({self._span()}), got {shown(bound)}")
        return int(np.searchsorted(self.time, bound - TOLERANCE * np.diff(self.time).min()))

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


def _gaps(time: np.ndarray) -> np.ndarray:
    """Which steps of the time stamps are longer than two usual ones, with half a step for jitter; [time - 1]."""
    steps = np.diff(time)
    return steps > 2.5 * np.median(steps)


def _unknown_inputs(name: str, time: np.ndarray, gaps: np.ndarray) -> str:
    row = int(np.argmax(gaps))
    more = f" (one of {gaps.sum()} gaps)" if gaps.sum() > 1 else ""
    return (
        f"the inputs of {name!r} are unknown from {time[row]:.9g} to {time[row + 1]:.9g} s, a gap{more} where "
        f"{np.median(np.diff(time)):.6g} s from row to row is usual: slice it there and resample each part (identify "
        "takes a list of records), or say resample(..., inputs_known_in_gaps=True) if they kept to their hold, as a "
        "command does that is logged when it changes"
    )


def _between(values: np.ndarray, place: np.ndarray, hold: str) -> np.ndarray:
    """Return an input at places that are counted in samples."""
    if hold == "zero":
        return values[np.floor(place + TOLERANCE).astype(int)]
    return _interpolate(values, place) if hold == "linear" else interpolated(values, place)


def _interpolate(values: np.ndarray, place: np.ndarray) -> np.ndarray:
    below = np.floor(place).astype(int)
    above = np.minimum(below + 1, len(values) - 1)
    share = place - below
    # on a sample, its neighbour may be missing
    return np.where(share == 0, values[below], (1 - share) * values[below] + share * values[above])


def _range(values: np.ndarray) -> str:
    missing = int(np.isnan(values).sum())
    return f"{np.nanmin(values):.6g} .. {np.nanmax(values):.6g}" + (f", {missing} missing" if missing else "")


def checked_record(record: Any) -> Record:
    """Return a record.

    Raises:
        ValueError: for anything else.

    """
    return instance("record", record, Record, _MAKE_ONE)


def checked_records(records: Any, name: str = "records") -> tuple[Record, ...]:
    """Return one record, or a sequence of them, as a tuple; `name` is what the argument is called.

    Raises:
        ValueError: for none, or anything else.

    """
    listed = (records,) if isinstance(records, Record) else tuple(records) if isinstance(records, Sequence) else ()
    if not listed or not all(isinstance(record, Record) for record in listed):
        raise refused(name, "a Record or a sequence of Records", records, _MAKE_ONE)
    return listed


_MAKE_ONE = "make one with Record or Record.from_csv"
