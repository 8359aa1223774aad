"""From a model and records to a `Problem`: what is searched, between which bounds, and how noisy each output is."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from ehsvjax.models.model import Model, Parameter
from ehsvjax.population import Problem, coordinates_of, observed_outputs, stack_records
from ehsvjax.record import Record

Initial = str | Mapping[str, float] | Sequence[Mapping[str, float]]


def problem_of(
    model: Model,
    records: Sequence[Record],
    *,
    initial: Initial = "estimate",
    noise_variance: Mapping[str, float] | None = None,
    huber: float | None = None,
) -> Problem:
    """Return the problem of identifying a model's free parameters, in NumPy float64.

    Args:
        model: with the bounds and fixed values to use.
        records: one or more.
        initial: "estimate" the initial conditions of each record, take their "nominal" values, or a mapping of those
            that are known (the others are estimated), one for all records or one for each.
        noise_variance: of each output, in its unit squared; by default guessed from the record, `guess_noise_variance`.
        huber: see `Problem`.

    Raises:
        ValueError: for records without samples enough, unknown names, values that are no variances.

    """
    given = _given_initial(model, records, initial)
    observed = observed_outputs(model, records)
    free_initial = tuple(p.name for p in model.initial if any(p.name not in g for g in given))
    samples, grid = stack_records(model, records)
    unknowns = [model.parameter(name) for name in model.free]
    for record in records:
        unknowns += [_around_first_samples(model.parameter(name), record) for name in free_initial]
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
        free=model.free,
        free_initial=free_initial,
        huber=_checked_huber(huber),
    )


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
            raise ValueError(f"expected initial 'estimate', 'nominal' or known values by name, got {initial!r}")
        return [held | {p.name: p.value for p in model.initial if initial == "nominal"}] * len(records)
    per_record = [initial] * len(records) if isinstance(initial, Mapping) else list(initial)
    if len(per_record) != len(records):
        raise ValueError(f"expected initial conditions for each of {len(records)} records, got {len(per_record)}")
    if any(set(given) != set(per_record[0]) for given in per_record):
        raise ValueError("expected the same initial conditions to be known in every record, got different names")
    for given in per_record:
        for name, value in given.items():
            if name not in names:
                known = ", ".join(names)
                raise ValueError(f"expected an initial condition of {model.name}, got {name!r}; it has {known}")
            if not np.isfinite(value):
                raise ValueError(f"expected a finite value for {name}, got {value}")
    return [held | dict(given) for given in per_record]


def _around_first_samples(parameter: Parameter, record: Record) -> Parameter:
    """Return the initial condition with bounds around the first samples of the output that shows it.

    Five samples, give or take a tenth of the output's range and five times its noise: wide enough for an output that
    moves at once, and far narrower than anything that it could ever be.
    """
    output = record.outputs.get(parameter.output) if parameter.output else None
    if output is None:
        return parameter
    measured = output[np.isfinite(output)]
    centre = float(np.median(measured[:5]))
    reach = 0.1 * float(np.ptp(measured)) + 5.0 * guess_noise_variance(output) ** 0.5
    return parameter._replace(value=centre, lower=centre - reach, upper=centre + reach, scale="linear")


def _variances(model, records, observed, given) -> Float[np.ndarray, " signal"]:
    if given is None:
        return np.array(
            [
                np.mean([guess_noise_variance(r.outputs[name]) for r in records if name in r.outputs])
                for name in observed
            ]
        )
    if set(given) != set(observed):
        raise ValueError(
            f"expected the noise variance of each measured output of {model.name}, {', '.join(observed)}; "
            f"got {', '.join(given) or 'none'}"
        )
    for name, variance in given.items():
        if not (np.isfinite(variance) and variance > 0):
            unit = model.unit(name)
            raise ValueError(f"expected a positive noise variance of {name}, in ({unit})^2, got {variance}")
    return np.array([float(given[name]) for name in observed])


def _checked_huber(huber):
    if huber is not None and not (np.isfinite(huber) and huber > 0):
        raise ValueError(
            f"expected huber to be a positive number of standard deviations (1.345 is usual) or None, got {huber}"
        )
    return None if huber is None else float(huber)


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
