"""What makes samples on a time a record; refusals name the signal, the sample (counted from 0) and the remedy."""

from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float

from ehsvjax.checks import by_name, choice, flag, instance, number, shown
from ehsvjax.holds import HOLDS

# Share of a period by which a time stamp may be off the uniform grid through the first and the last one.
# Stamps within 1 % of any straight line always keep to it, as the grid is then itself off by at most 1 %.
TOLERANCE = 0.02
# Seconds, 30,000 years: what is beyond is no time in s but one counted in ms, us or ns since 1970.
_LATEST = 1e12


def checked_hold(hold: Any, inputs: Collection[str]) -> Any:
    """Return what inputs do between samples, by name as a read-only mapping.

    Raises:
        ValueError: for another hold, or that of no input.

    """
    if not isinstance(hold, Mapping):
        return choice("hold", hold, HOLDS)
    for name, one in hold.items():
        if name not in inputs:
            raise ValueError(
                f"expected the names of inputs in hold, {', '.join(inputs) or 'none'}; got {shown(name)}: mind the "
                "spelling"
            )
        choice(f"the hold of {name}", one, HOLDS)
    return MappingProxyType(dict(hold))


def check_settings(name: Any, uniform: Any) -> None:
    """Raise ValueError for a name that is no text, or a `uniform` that is neither True nor False."""
    instance("name", name, str, "write it between quotes")
    flag("uniform", uniform)


def check_names(inputs: Any, outputs: Any) -> None:
    """Raise TypeError for signals without names, ValueError for a name that is taken."""
    for kind, signals in (("inputs", inputs), ("outputs", outputs)):
        if not isinstance(signals, Mapping):
            raise TypeError(f"expected {kind} as a mapping from name to values, got {type(signals).__name__}")
        for name in signals:
            if not isinstance(name, str) or not name:
                raise TypeError(f"expected names of {kind} that are strings and not empty, got {shown(name)}")
            if name == "time":
                raise ValueError(f"'time' cannot be one of the {kind}: time is given apart, rename the signal")
    for name in inputs:
        if name in outputs:
            raise ValueError(f"signal {name!r} is both an input and an output: rename one or leave it out")


def checked_constants(constants: Any) -> dict[str, float]:
    """Return what was known about a record by name; ValueError for what are no numbers by name."""
    found = by_name("constants", constants, "{'supply_pressure': 70e5}")
    return {name: number(name, value, remedy="give its value, SI") for name, value in found.items()}


def check_time(time: Float[np.ndarray, " time"]) -> None:
    """Raise ValueError unless there are two stamps or more, in s, finite and increasing."""
    if len(time) < 2:
        raise ValueError("time has 1 sample: a record needs at least 2, pass a longer one")
    unknown_time = ~np.isfinite(time)
    if unknown_time.any():
        row = _first(unknown_time)
        raise ValueError(f"time is {time[row]} at sample {row}: remove the row or fill in its time")
    if np.abs(time).max() > _LATEST:
        raise ValueError(
            f"time runs from {time[0]:.6g} to {time[-1]:.6g}, which are no seconds: give its column a scale, such as "
            "Column(name, 1e-3) for ms or 1e-9 for ns"
        )
    standing = np.diff(time) <= 0
    if standing.any():
        row = _first(standing) + 1
        raise ValueError(
            f"time does not increase at sample {row} ({time[row]:.9g} s after {time[row - 1]:.9g} s): "
            "sort the rows by time and remove repeated ones"
        )


def check_uniform(time: Float[np.ndarray, " time"]) -> None:
    """Raise ValueError where stamps stray from the straight line through the first and the last one."""
    period = (time[-1] - time[0]) / (len(time) - 1)
    straying = np.abs(time - np.linspace(time[0], time[-1], len(time))).max() / period
    if straying > TOLERANCE:
        steps = np.diff(time)
        usual = np.median(steps)
        row = int(np.argmax(np.abs(steps - usual))) + 1
        raise ValueError(
            f"time is not uniform, it strays from a straight line by {straying:.2g} periods: sample {row} "
            f"comes {steps[row - 1]:.9g} s after sample {row - 1}, where {usual:.9g} s is usual; use "
            f"Record(..., uniform=False).resample({usual:.6g}), or even time if only its stamps are poor"
        )


def check_samples(
    time: Float[np.ndarray, " time"], inputs: Mapping[str, np.ndarray], outputs: Mapping[str, np.ndarray]
) -> None:
    """Raise ValueError for signals of another length, inputs not known throughout, outputs that say nothing."""
    for name, values in inputs.items():
        _check_length(f"input {name!r}", values, time)
        _check_input(f"input {name!r}", values)
    for name, values in outputs.items():
        _check_length(f"output {name!r}", values, time)
        _check_output(f"output {name!r}", values)


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
    if present.size == 1:
        raise ValueError(
            f"{label} has a single measured sample of {len(values)}, {measured[0]:.9g} at sample {present[0]}: leave "
            "it out, or take a longer part of the record, or one with fewer gaps"
        )
    if measured.min() == measured.max():
        raise ValueError(
            f"{label} never changes, it is {measured[0]:.9g} from sample {present[0]} to {present[-1]}: "
            "leave it out, or take a longer part of the record"
        )


def _first(mask: np.ndarray) -> int:
    return int(np.argmax(mask))
