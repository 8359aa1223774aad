"""From a model and records to a `Problem`: what is searched, between which bounds, and how noisy each output is."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.checks import by_name, number, positive, refused
from ehsvjax.models.model import Model, Parameter
from ehsvjax.population import Coordinates, Priors, Problem, coordinates_of, observed_outputs, stack_records
from ehsvjax.record import Record

_HUBER = "a positive number of standard deviations or None"
Initial = str | Mapping[str, float] | Sequence[Mapping[str, float]]

# First readings that tell where an initial condition lies; how far beyond them it may lie, in ranges of the output and
# in standard deviations of its noise.
_FIRST = 5
_REACH_OF_RANGE, _REACH_OF_NOISE = 0.1, 3.0
# Share of an output's steps that are no steeper than its steepest but for spikes.
_STEEPEST = 0.98


def problem_of(
    model: Model,
    records: Sequence[Record],
    *,
    initial: Initial = "estimate",
    noise_variance: Mapping[str, float] | None = None,
    huber: float | None = None,
    by_record: Sequence[str] = (),
) -> Problem:
    """Return the problem of identifying a model's free parameters, in NumPy float64.

    Args:
        model: with the bounds and fixed values to use.
        records: one or more.
        initial: "estimate" the initial conditions of each record, take their "nominal" values, or a mapping of those
            that are known (the others are estimated), one for all records or one for each.
        noise_variance: of each output, in its unit squared; by default guessed from the record, `guess_noise_variance`.
        huber: see `Problem`.
        by_record: names of free parameters that may be another in every record.

    Raises:
        ValueError: for records without samples enough, unknown names, values that are no variances.

    """
    given = _given_initial(model, records, initial)
    observed = observed_outputs(model, records)
    free_initial = tuple(p.name for p in model.initial if any(p.name not in g for g in given))
    samples, grid = stack_records(model, records)
    free = tuple(name for name in model.free if name not in by_record)
    unknowns = [model.parameter(name) for name in free]
    for record in records:
        unknowns += [model.parameter(name) for name in by_record]
        unknowns += [_wide_enough(model.parameter(name), record) for name in free_initial]
    _check_not_all_known(model, records)
    _check_enough_samples(model, records, samples.measured, unknowns)
    return Problem(
        samples=samples,
        noise_variance=_variances(model, records, observed, noise_variance),
        coordinates=coordinates_of(unknowns),
        known={p.name: np.array(p.value) for p in model.parameters if p.fixed},
        known_initial={
            p.name: np.array([g.get(p.name, p.value) for g in given])
            for p in model.initial
            if p.name not in free_initial
        },
        equations=model.equations,
        substeps=np.int32(grid.substeps),
        grid=grid,
        observed=observed,
        free=free,
        free_initial=free_initial,
        free_by_record=tuple(by_record),
        priors=_priors(unknowns),
        huber=None if huber is None else number("huber", huber, _HUBER, lambda x: x > 0.0, "1.345 is usual"),
    )


def _priors(unknowns: Sequence[Parameter]) -> Priors | None:
    """Return what is known of unknowns beforehand."""
    if all(p.prior is None for p in unknowns):
        return None
    mean, deviation = zip(*(p.prior or (0.0, np.inf) for p in unknowns), strict=True)
    return Priors(np.array(mean), np.array(deviation))


def where_to_search(model: Model, records: Sequence[Record], problem: Problem) -> Coordinates:
    """Return the coordinates in which to search first: initial conditions within what their outputs first show.

    Within the bounds, and only a place to start from: a refinement has all of the bounds.
    """
    unknowns = [model.parameter(name) for name in problem.free]
    for record in records:
        unknowns += [_as_first_shown(model.parameter(name), record) for name in problem.free_initial]
    return coordinates_of(unknowns)


def guess_noise_variance(output: Float[np.ndarray, " time"]) -> float:
    """Guess the variance of white noise on a sampled smooth signal, from its third differences.

    A smooth signal all but vanishes from third differences, in which white noise has 20 times its variance; the median
    of their size is not moved by steps and spikes (Hall, Kay & Titterington 1990, Biometrika 77). At least 1e-12 of the
    signal's variance, so that a record without noise can be weighted too.
    """
    differences = np.diff(output, 3)
    differences = np.abs(differences[np.isfinite(differences)])
    deviation = np.median(differences) / 0.6744897501960817 / 20.0**0.5 if differences.size else 0.0
    return max(deviation**2, 1e-12 * float(np.nanvar(output)))


def _given_initial(model: Model, records: Sequence[Record], initial: Initial) -> list[dict[str, float]]:
    """Return the initial conditions that are known, for each record."""
    names = [p.name for p in model.initial]
    held = {p.name: p.value for p in model.initial if p.fixed}
    if isinstance(initial, str):
        if initial not in ("estimate", "nominal"):
            raise _no_initial(initial)
        return [held | {p.name: p.value for p in model.initial if initial == "nominal"}] * len(records)
    per_record = [initial] * len(records) if isinstance(initial, Mapping) else initial
    if not isinstance(per_record, Sequence):
        raise _no_initial(initial)
    if len(per_record) != len(records):
        raise ValueError(f"expected initial conditions for each of {len(records)} records, got {len(per_record)}")
    known = [by_name("initial conditions", given, "{'initial_position': 0.0}") for given in per_record]
    if any(set(given) != set(known[0]) for given in known):
        raise ValueError("expected the same initial conditions to be known in every record, got different names")
    for name in known[0]:
        if name not in names:
            there = ", ".join(names) or "none"
            raise ValueError(f"expected an initial condition of {model.name}, got {name!r}; it has {there}")
    return [
        held | {name: number(name, value, remedy="give its value, SI") for name, value in given.items()}
        for given in known
    ]


def _no_initial(initial: Any) -> ValueError:
    return refused("initial", "'estimate', 'nominal' or known values by name", initial, "choose one")


class _Shown(NamedTuple):
    """Where an output starts: between the least and the largest of its first readings, give or take the reach."""

    least: float
    most: float
    reach: float


def _first_shown(parameter: Parameter, record: Record) -> _Shown | None:
    """Return where the output that shows an initial condition starts; None if it is not measured.

    From the least to the largest of the first readings, as a signal may turn at once and a reading may be a spike; by
    the output's steepest step, but for spikes, farther for every sample that is missing before them, and for the first
    one if it is a spike; and give or take a tenth of the output's range and three times its noise.
    """
    output = record.outputs.get(parameter.output) if parameter.output else None
    if output is None:
        return None
    present = np.flatnonzero(np.isfinite(output))
    first = output[present[:_FIRST]]
    # Where the first readings turn, those before them were steeper.
    slopes = np.abs(np.diff(output[present]) / np.diff(present))
    steepest = float(np.quantile(slopes, _STEEPEST)) if len(slopes) else 0.0
    unknown = int(present[0]) + bool(np.any(slopes[:1] > steepest))
    reach = _REACH_OF_RANGE * float(np.ptp(output[present])) + _REACH_OF_NOISE * guess_noise_variance(output) ** 0.5
    return _Shown(float(np.min(first)), float(np.max(first)), reach + unknown * steepest)


def _wide_enough(parameter: Parameter, record: Record) -> Parameter:
    """Return the initial condition with its bounds; where the first readings lie beyond them, wide enough for those."""
    shown = _first_shown(parameter, record)
    if shown is None or parameter.lower <= shown.least <= shown.most <= parameter.upper:
        return parameter
    lower, upper = min(parameter.lower, shown.least - shown.reach), max(parameter.upper, shown.most + shown.reach)
    return parameter._replace(lower=lower, upper=upper, scale=parameter.scale if lower > 0 else "linear")


def _as_first_shown(parameter: Parameter, record: Record) -> Parameter:
    """Return the initial condition between what its output first shows, within its bounds."""
    shown, parameter = _first_shown(parameter, record), _wide_enough(parameter, record)
    if shown is None:
        return parameter
    lower = max(parameter.lower, shown.least - shown.reach)
    return parameter._replace(lower=lower, upper=min(parameter.upper, shown.most + shown.reach), scale="linear")


def _variances(model, records, observed, given) -> Float[np.ndarray, " signal"]:
    if given is None:
        return np.array(
            [
                np.mean([guess_noise_variance(r.outputs[name]) for r in records if name in r.outputs])
                for name in observed
            ]
        )
    given = by_name("noise_variance", given, "{'position': 1e-8}")
    if set(given) != set(observed):
        raise ValueError(
            f"expected the noise variance of each measured output of {model.name}, {', '.join(observed)}; "
            f"got {', '.join(given) or 'none'}"
        )
    return np.array([checked_variance(model, name, given[name]) for name in observed])


def checked_variance(model: Model, output: str, variance: Any) -> float:
    """Return the variance of an output's noise.

    Raises:
        ValueError: for what is no positive number.

    """
    return positive(f"noise_variance of {output}", variance, f"give it in ({model.unit(output)})^2")


def _check_not_all_known(model, records):
    for name in model.free:
        if all(name in record.constants for record in records):
            raise ValueError(
                f"expected a record that {name} can be identified from, got its value with every one: fix it "
                f"(fixed={{{name!r}: value}}), or leave it out of the constants"
            )


def _check_enough_samples(model, records, measured, unknowns):
    count = int(np.sum(measured))
    if not unknowns:
        names = ", ".join(p.name for p in model.parameters)
        raise ValueError(
            f"expected something to identify, got {model.name} with every parameter fixed: free one by "
            f"bounds={{name: (lower, upper)}}, of {names}"
        )
    if count <= len(unknowns):
        names = ", ".join(record.name for record in records)
        raise ValueError(
            f"expected more samples than unknowns, got {count} measured samples in {names} for {len(unknowns)} "
            "unknowns: fix parameters, give initial conditions, or use a longer record"
        )
