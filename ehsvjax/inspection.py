"""A record before any fit: what a careful engineer looks at first, each with what to do.

Nothing is changed and nothing refused: what cannot be a record at all is refused when it is made.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from html import escape
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.doubts import about_record, about_steps
from ehsvjax.models.model import Model
from ehsvjax.readings import lattice, spikes
from ehsvjax.record import Record
from ehsvjax.simulate import grid_of, input_array
from ehsvjax.unknowns import guess_noise_variance

# Readings in a row at a signal's highest or lowest that are an end, and times the longest row elsewhere.
_ROW, _LONGER = 5, 3
# Share of a record over which a signal that repeats itself is dead.
_DEAD = 0.1
# Levels below which a lattice is coarse; values of an input from which it is no longer one of few levels.
_COARSE, _FEW = 200, 3
# Share of half the sample rate up to which an input between its samples hardly matters, and of its power to lie there.
_SLOW, _POWER = 0.2, 0.95
# Share of readings that may be missing, or stand alone.
_MISSING, _ALONE = 0.1, 0.01


class Finding(NamedTuple):
    """What was looked at, whether it is as it should be, what was seen, and what to do where it is not."""

    subject: str
    passed: bool
    seen: str
    remedy: str = ""


@dataclass(frozen=True)
class Inspection:
    """What was found of one record.

    Attributes:
        name: of the record.
        findings: one for each check.

    """

    name: str
    findings: tuple[Finding, ...]

    @property
    def passed(self) -> bool:
        """Whether nothing has to be looked at."""
        return all(finding.passed for finding in self.findings)

    def __str__(self) -> str:
        """One line for each check; those to be looked at are marked, with what to do."""
        width = max(len(finding.subject) for finding in self.findings)
        lines = [
            f"  {'ok  ' if one.passed else 'LOOK'}  {one.subject.ljust(width)}  {one.seen}"
            + (f": {one.remedy}" if one.remedy and not one.passed else "")
            for one in self.findings
        ]
        return "\n".join([self._head(), *lines])

    def _repr_html_(self) -> str:
        cell = 'style="text-align: left; padding: 0.1em 1em 0.1em 0; vertical-align: top"'
        rows = "".join(
            f"<tr><td {cell}>{'ok' if one.passed else '<b>look</b>'}</td><td {cell}>{escape(one.subject)}</td>"
            f"<td {cell}>{escape(one.seen)}</td><td {cell}>{escape('' if one.passed else one.remedy)}</td></tr>"
            for one in self.findings
        )
        return f'<p><b>{escape(self._head())}</b></p><table style="border-collapse: collapse">{rows}</table>'

    def _head(self) -> str:
        off = sum(not finding.passed for finding in self.findings)
        return f"{self.name}: {off} of {len(self.findings)} checks to look at" if off else f"{self.name}: all in order"


def inspected(record: Record, model: Model | None = None) -> Inspection:
    """Return what there is to see in a record, and whether a model can mean it; no parameter is fitted."""
    findings = [_of_time(record)]
    for name, values in record.inputs.items():
        findings += _of_input(record, name, values)
    for name, values in record.outputs.items():
        findings += _of_output(record, name, values)
    if model is not None:
        findings += _of_model(record, model)
    return Inspection(record.name, tuple(findings))


def _of_time(record: Record) -> Finding:
    seen = f"{len(record)} samples in {record.duration:.4g} s"
    if not record.uniform:
        return Finding("time", False, f"{seen}, not uniform", "record.resample(period) before it is fitted")
    return Finding("time", True, f"{seen}, one every {record.sample_period:.4g} s")


def _of_input(record: Record, name: str, values: Float[np.ndarray, " time"]) -> Iterator[Finding]:
    levels, changes = len(np.unique(values)), int(np.count_nonzero(np.diff(values)))
    if levels == 1:
        yield Finding(name, False, f"never changes, {values[0]:.4g}", "nothing that goes by it can be identified")
        return
    seen = f"{levels} values, {values.min():.4g} to {values.max():.4g}, changes {changes} times"
    remedy = "with so few levels a dead zone, a gain and a saturation look alike; add amplitudes"
    yield Finding(name, levels > _FEW, seen, remedy)
    if record.uniform and changes > 0.5 * len(values) and record.hold_of(name) != "band-limited":
        share = _share_of_band(values)
        nyquist = 0.5 / record.sample_period
        yield Finding(
            f"{name}, between samples",
            record.hold_of(name) == "zero" or share <= _SLOW,
            f"{_POWER:.0%} of its power below {share * nyquist:.3g} Hz, {share:.0%} of half the sample rate; "
            f'hold="{record.hold_of(name)}"',
            'how it runs between samples matters; a generator behind a filter makes hold="band-limited"',
        )


def _of_output(record: Record, name: str, values: Float[np.ndarray, " time"]) -> Iterator[Finding]:
    missing = ~np.isfinite(values)
    longest = _longest(missing)
    seen = "none missing" if not longest else f"{missing.sum()} missing, {longest} in a row"
    few = missing.sum() <= _MISSING * len(values)
    yield Finding(name, few, f"{len(values) - missing.sum()} readings, {seen}", "look why; a gap is no misfit")
    same = np.r_[False, np.diff(values) == 0.0]
    measured = values[~missing]
    for side, end in (("highest", measured.max()), ("lowest", measured.min())):
        at_end = values == end
        row, elsewhere = _longest(at_end), 1 + _longest(same & ~at_end)
        if row >= max(_ROW, _LONGER * elsewhere):
            seen = f"{at_end.sum()} readings at its {side}, {end:.6g}, {row} in a row"
            remedy = f"the sensor's end? Then record.within({name}=(low, high)) marks such readings as missing"
            yield Finding(f"{name}, ends", False, seen, remedy)
    standing = 1 + _longest(same & (values != measured.max()) & (values != measured.min()))
    if standing > _DEAD * len(values):
        yield Finding(f"{name}, alive", False, f"stands still for {standing} samples", "cut what is no experiment")
    step, noise = lattice(values), guess_noise_variance(values) ** 0.5
    if step is not None:
        levels = float(np.ptp(measured)) / step
        seen = f"a lattice of {step:.3g}, {levels:.0f} steps over its range"
        yield Finding(f"{name}, steps", levels >= _COARSE, seen, "a coarse sensor; a diagnosis takes it into account")
    series, there = values[None, :, None], ~missing[None, :, None]
    alone = int(spikes(series, there, series).sum())
    yield Finding(
        f"{name}, spikes",
        alone <= _ALONE * len(values),
        f"{alone} readings stand alone; noise at most {noise:.3g}, its own deviation {np.nanstd(values):.3g}",
        "identify(huber=1.345) bears with them",
    )


def _of_model(record: Record, model: Model) -> Iterator[Finding]:
    try:
        input_array(model, record)
        known = [name for name in record.outputs if name in model.outputs]
        steps = grid_of(model, record).substeps
    except ValueError as refusal:
        yield Finding(model.name, False, "cannot take this record", str(refusal))
        return
    doubts = about_steps(model, [record])
    seen = f"{steps} integration step{'s' if steps > 1 else ''} a sample"
    yield Finding(f"{model.name}, time", not doubts, seen, "".join(doubts))
    for name in known if not doubts else ():
        share, words = about_record(model, record, name)
        seen = f"with nominal values a straight line of the simulated one explains {share:.0%} of it"
        yield Finding(f"{name}, by {model.name}", not words, seen, words)


def _longest(so: np.ndarray) -> int:
    """Return the length of the longest row of samples of which it is so."""
    edges = np.flatnonzero(np.diff(np.r_[0, so.astype(int), 0]))
    return int(np.max(edges[1::2] - edges[::2], initial=0))


def _share_of_band(values: np.ndarray) -> float:
    """Return the share of half the sample rate below which most of a signal's power lies."""
    power = np.cumsum(np.abs(np.fft.rfft(values - values.mean())) ** 2)
    return float(np.searchsorted(power, _POWER * power[-1]) / max(len(power) - 1, 1))
