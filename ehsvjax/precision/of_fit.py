"""What a fit says about its precision: the pieces of this folder put to a `Fit`."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Key

from ehsvjax.arithmetic import settled_at
from ehsvjax.checks import refused
from ehsvjax.failure import warn_of_failure
from ehsvjax.fit import Fit
from ehsvjax.linear import LinearModel, linearise
from ehsvjax.linear.model import ASIDE
from ehsvjax.population import Problem, to_unit
from ehsvjax.precision.bands import Band, deviations, new_deviations
from ehsvjax.precision.bootstrap import Bootstrap, bootstrap
from ehsvjax.precision.profile import ProfileLikelihood, profile_likelihood
from ehsvjax.precision.sensitivities import sensitivities
from ehsvjax.precision.standard_errors import (
    Linearised,
    Precision,
    covariance_of,
    linearised,
    precision_of,
    quantile_of,
)
from ehsvjax.record import Record, checked_record
from ehsvjax.unknowns import problem_of


class Prepared(NamedTuple):
    """A fit as its problem, the values of the unknowns, and to first order."""

    problem: Problem
    values: Float[np.ndarray, " parameter"]
    first_order: Linearised


def prepared(fit: Fit, colour: str) -> Prepared:
    """Return what everything here starts from."""
    problem = _problem(fit, fit.records, fit.initial)
    values = [fit.parameters[name] for name in problem.free]
    values += [initial[name] for initial in fit.initial for name in problem.free_initial]
    point = np.array(values)
    problem = settled_at(problem, to_unit(problem.coordinates, point))
    given = fit.noise_variance_given
    return Prepared(problem, point, linearised(problem, point, noise_variance_given=given, colour=colour))


def precision(fit: Fit, of: Prepared) -> Precision:
    """Return standard errors, correlations and identifiable directions."""
    return precision_of(fit.model, of.problem, of.first_order)


def profiles(fit: Fit, of: Prepared, names: Sequence[str] | None, level: float) -> ProfileLikelihood:
    """Return profile likelihood intervals.

    Raises:
        ValueError: for a name that is not identified, or a level that is none.

    """
    if isinstance(names, str) or not isinstance(names, Sequence | None):
        raise refused("names", "names of parameters", names, "give them in a list, [name, ...]")
    names = of.problem.free if names is None else tuple(names)
    known = ", ".join(of.problem.free)
    if not names:
        raise ValueError(f"expected names of parameters, of {known}; got none")
    for name in names:
        if name not in of.problem.free:
            raise ValueError(f"expected parameters that were identified, {known}; got {name!r}")
    found, _, factor, curvature, _, covariance, seen = of.first_order
    deviation = np.sqrt(np.diagonal(covariance_of(found, None, factor)[0]))
    # Where the noise is coloured the cost rises too fast by the ratio of the variances (Rotnitzky & Jewell 1990).
    ratio = np.diagonal(covariance) / np.where(deviation > 0, deviation**2, 1.0)
    factor = factor * curvature
    factors = {name: float(factor * (ratio[i] if seen[i] else 1.0)) for i, name in enumerate(of.problem.free)}
    scale = found.scale
    return profile_likelihood(
        of.problem,
        of.values,
        covariance * np.outer(scale, scale),
        seen,
        names=names,
        level=level,
        noise_factors=factors,
        units={name: fit.model.parameter(name).unit for name in names},
        together=fit.effort.starts or 5,
    )


def draws(fit: Fit, of: Prepared, key: Key[Array, ""], count: int, kind: str) -> Bootstrap:
    """Return the bootstrap."""
    found, noises = of.first_order.found, of.first_order.noises
    assert noises is not None
    variance = _sample_variance(fit, of)
    linear = precision(fit, of)
    return bootstrap(
        of.problem,
        of.values,
        found.simulated,
        noises,
        variance,
        key=key,
        draws=count,
        kind=kind,
        units=linear.units,
        covariance=linear.covariance,
    )


def bands(fit: Fit, of: Prepared, record: Record, initial, level: float) -> dict[str, Band]:
    """Return the bands about the outputs of one record, by name of the output.

    Raises:
        ValueError: if the record holds none of the outputs that were fitted.

    """
    quantile, record = quantile_of(level), checked_record(record)
    names = [name for name in record.outputs if name in fit.noise_variance]
    if not names:
        raise ValueError(f"expected {record.name} to hold one of {', '.join(fit.noise_variance)}, got none of them")
    start = fit.initial_of(record, initial)
    found, covariance, factor = of.first_order.found, of.first_order.covariance, _sample_variance(fit, of)
    noise = np.sqrt(of.problem.noise_variance)
    for i, (fitted, estimated) in enumerate(zip(fit.records, fit.initial, strict=True)):
        if fitted is record and start == estimated:
            spread = deviations(found, covariance)[i, : len(record)]
            return _bands(of.problem.observed, spread, noise, factor, quantile)
    problem = _problem(fit, [record.select(outputs=names)], [start])
    values = [fit.parameters_of(record)[name] for name in problem.free] + [start[name] for name in problem.free_initial]
    new = sensitivities(problem, np.array(values))
    warn_of_failure(fit.model, record, {name: new.simulated[0, :, i] for i, name in enumerate(problem.observed)})
    count = len(new.names)
    spread = new_deviations(new, covariance[:count, :count], factor)[0]
    return _bands(problem.observed, spread, np.sqrt(problem.noise_variance), factor, quantile)


def linear(
    fit: Fit,
    of: Prepared,
    at: Mapping[str, float] | None,
    initial: Mapping[str, float] | None,
    inputs: Sequence[str] | None,
    outputs: Sequence[str] | None,
) -> LinearModel:
    """Return the linear model at an operating point, with those beside it along the errors of the parameters."""

    def at_values(values: np.ndarray) -> LinearModel:
        parameters = of_no_run | dict(zip(fixed, values.tolist(), strict=True))
        return linearise(fit.model, at, parameters=parameters, initial=initial, inputs=inputs, outputs=outputs)

    # What goes by the clock of a record is absent from any other.
    of_no_run = fit.parameters | {name: value for name, value in fit.model.of_run.items() if name in fit.parameters}
    counted = [i for i, name in enumerate(of.problem.free) if of.first_order.seen[i] and name not in fit.model.of_run]
    fixed = [of.problem.free[i] for i in counted]
    scale = of.first_order.found.scale[counted]
    variances, axes = np.linalg.eigh(of.first_order.covariance[np.ix_(counted, counted)])
    values = np.array([fit.parameters[name] for name in fixed])
    steps = (ASIDE * np.sqrt(np.maximum(variances, 0.0)) * axes).T * scale
    beside = tuple((at_values(values + step), at_values(values - step)) for step in steps if np.any(step))
    return replace(at_values(values), beside=beside)


def _sample_variance(fit: Fit, of: Prepared) -> float:
    """Return the variance of a sample's noise in units of the problem's, with Huber's cost that of its core."""
    return of.first_order.factor if fit.huber is None else 1.0


def _bands(names, spread, noise, factor, quantile) -> dict[str, Band]:
    return {
        name: Band(quantile * noise[i] * spread[:, i], quantile * noise[i] * np.sqrt(spread[:, i] ** 2 + factor))
        for i, name in enumerate(names)
    }


def _problem(fit: Fit, records, initial) -> Problem:
    known = [{name: v for name, v in values.items() if name not in fit.estimated_initial} for values in initial]
    variance = {name: v for name, v in fit.noise_variance.items() if any(name in r.outputs for r in records)}
    return problem_of(fit.model, records, initial=known, noise_variance=variance, huber=fit.huber)
