"""Simulations that fail: which output stops being finite, when, and what to look at."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.models.model import Model
from ehsvjax.record import Record
from ehsvjax.simulate import grid_of, simulate

# Of an input, to see whether its unit is what is wrong; and how much finer a step is tried.
_SMALL = 1e-3
_FINER = 16
# Steps that one trial may take: some seconds.
_MOST_STEPS = 2e7


class Failure(NamedTuple):
    """Where a simulation stops being finite: the outputs that are the first, and at which sample of the record."""

    outputs: tuple[str, ...]
    sample: int
    time: float

    def __str__(self) -> str:
        """Return the sentence without its subject's record."""
        verb = "is" if len(self.outputs) == 1 else "are"
        return f"{', '.join(self.outputs)} {verb} not finite from {self.time:.6g} s on (sample {self.sample})"


def failure_of(record: Record, simulated: Mapping[str, Float[np.ndarray, " time"]]) -> Failure | None:
    """Return where simulated outputs stop being finite, None if they never do."""
    failed = {name: np.flatnonzero(~np.isfinite(values)) for name, values in simulated.items()}
    first = {name: int(samples[0]) for name, samples in failed.items() if samples.size}
    if not first:
        return None
    sample = min(first.values())
    return Failure(tuple(name for name, k in first.items() if k == sample), sample, float(record.time[sample]))


def warn_of_failure(model: Model, record: Record, simulated: Mapping[str, Float[np.ndarray, " time"]]) -> None:
    """Warn, as Python does, of a simulation that is not finite throughout."""
    failure = failure_of(record, simulated)
    if failure is not None:
        warnings.warn(
            f"the simulation of {model.name} on {record.name} fails: {failure}; mind the units of its inputs, its "
            "initial conditions and max_step",
            RuntimeWarning,
            stacklevel=3,
        )


def nothing_finite(
    model: Model, records: Sequence[Record], initial: Sequence[Mapping[str, float]], simulations: int
) -> str:
    """Say of a search in which every simulation failed what fails with the model's nominal parameters, and what to do.

    Args:
        model: with the bounds and fixed values that were used.
        records: that were to be fitted.
        initial: for each record the initial conditions to try.
        simulations: how many failed.

    """
    head = f"expected simulations of {model.name} that stay finite within the bounds, got none among {simulations}"
    for record, start in zip(records, initial, strict=True):
        failure = failure_of(record, simulate(model, record, None, start))
        if failure is not None:
            return f"{head}: with the nominal parameters {failure} on {record.name}; {_remedy(model, record, start)}"
    return f"{head}, though the nominal parameters do: narrow the bounds about them"


def _remedy(model: Model, record: Record, start: Mapping[str, float]) -> str:
    """Return which single changes keep the simulation finite, or which keeps it so for longest."""
    lasting, longest, after = [], "", -1
    for words, trial in _trials(model, record, start):
        failure = failure_of(record, trial())
        if failure is None:
            lasting.append(words)
        elif failure.sample > after:
            longest, after = words, failure.sample
    if lasting:
        return f"it stays finite with {'; or with '.join(lasting[:3])}"
    return (
        f"nor does one change keep it finite; it lasts longest, {after} samples, with {longest}: look at the units of "
        "inputs, constants and bounds, and at max_step"
    )


def _trials(model: Model, record: Record, start: Mapping[str, float]) -> Iterator[tuple]:
    """Yield single changes: what each is, in words, and a function that simulates it."""
    substeps = _FINER * grid_of(model, record).substeps
    if substeps * len(record) < _MOST_STEPS:
        step = record.sample_period / substeps
        yield (
            f"max_step={step:.3g} s (it is {model.max_step:.3g} s)",
            lambda: simulate(model, record, None, start, substeps=substeps),
        )
    for name in model.inputs:
        smaller = replace(record, inputs={**record.inputs, name: _SMALL * record.inputs[name]})
        yield (
            f"a thousandth of {name}, which reaches {np.max(np.abs(record.inputs[name])):.3g} "
            f"{model.unit(name)}".rstrip()
            + " (mind the unit of its column)",
            lambda smaller=smaller: simulate(model, smaller, None, start),
        )
    for parameter in model.parameters:
        for side in ("lower", "upper") if not parameter.fixed else ():
            value = {parameter.name: getattr(parameter, side)}
            words = f"{parameter.name} at its {side} bound, {value[parameter.name]:.3g} {parameter.unit}".rstrip()
            yield words, lambda value=value: simulate(model, record, value, start)
    for parameter in model.initial:
        for side in ("lower", "upper") if not parameter.fixed else ():
            value = {**start, parameter.name: getattr(parameter, side)}
            words = f"{parameter.name} at its {side} bound, {value[parameter.name]:.3g} {parameter.unit}".rstrip()
            yield words, lambda value=value: simulate(model, record, None, value)
