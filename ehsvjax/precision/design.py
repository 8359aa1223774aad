"""Before any data: what errors an experiment leads to, from the model and the excitation alone."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ehsvjax.checks import by_name, instance
from ehsvjax.models.model import Model
from ehsvjax.population import Problem
from ehsvjax.precision.sensitivities import check_finite, sensitivities
from ehsvjax.precision.standard_errors import Precision, covariance_of, linearised, precision_of
from ehsvjax.record import Record, checked_records
from ehsvjax.simulate import changed, simulate
from ehsvjax.unknowns import Initial, checked_variance, problem_of


def design(
    model: Model,
    records: Record | Sequence[Record],
    *,
    noise_variance: Mapping[str, float],
    parameters: Mapping[str, float] | None = None,
    initial_values: Mapping[str, float] | None = None,
    initial: Initial = "estimate",
) -> Precision:
    """Return the precision that an experiment would give, before it is done: amplitude, hold time and length to choose.

    The standard errors are the Cramer-Rao bound under white Gaussian noise, to which an identification by `identify`
    comes; parameters that the experiment would not fix are named, with what would.

    Args:
        model: whose free parameters are to be identified.
        records: the planned experiment, one or several: times and inputs. Where a record has outputs, those count as
            measured, and where they are missing samples as that; else all that `noise_variance` names.
        noise_variance: name of each output that would be measured -> variance of its noise, unit squared.
        parameters: name -> value to expect; by default nominal.
        initial_values: name -> initial condition to expect; by default nominal.
        initial: which initial conditions would be estimated too, as for `identify`.

    Raises:
        ValueError: as `identify` does, and for an output that the model does not have.

    """
    records = _checked(model, records, noise_variance)
    expected = []
    for record in records:
        simulated = simulate(model, record, parameters, initial_values)
        measured = record.outputs or {name: np.zeros(len(record)) for name in noise_variance}
        outputs = {name: np.where(np.isfinite(y), simulated[name], np.nan) for name, y in measured.items()}
        expected.append(replace(record, outputs=outputs))
    problem = problem_of(model, expected, initial=initial, noise_variance=noise_variance)
    point = _point(model, problem, parameters, initial_values)
    return precision_of(model, problem, linearised(problem, point, noise_variance_given=True, expected=True))


def cramer_rao_bound(
    model: Model,
    records: Record | Sequence[Record],
    *,
    noise_variance: Mapping[str, float],
    parameters: Mapping[str, float] | None = None,
    initial_values: Mapping[str, float] | None = None,
    initial: Initial = "estimate",
) -> dict[str, float]:
    """Return the smallest standard deviation that an unbiased estimate can have under white Gaussian noise.

    From the Fisher information J^T J / noise_variance, J the sensitivities of the outputs to the free parameters and to
    the initial conditions that are estimated with them, by forward differentiation in float64 (Ljung 1999, System
    Identification, section 7.4).

    Args:
        model: whose free parameters are meant.
        records: their times, inputs, and which samples of which outputs are measured; the values measured do not count.
        noise_variance: name of the output -> variance, unit squared.
        parameters: name -> value at which the bound is taken; by default nominal.
        initial_values: name -> initial condition at which it is taken; by default nominal.
        initial: which initial conditions are estimated too, as for `identify`.

    Returns:
        name -> standard deviation, SI, of each free parameter; +inf for those of which the records show nothing.

    Raises:
        ValueError: as `identify` does.

    """
    records = _checked(model, records, noise_variance)
    problem = problem_of(model, records, initial=initial, noise_variance=noise_variance)
    found = sensitivities(problem, _point(model, problem, parameters, initial_values))
    check_finite(problem, found)
    covariance, seen = covariance_of(found, None, 1.0)
    deviations = np.where(seen, np.sqrt(np.diagonal(covariance)) * found.scale, np.inf)
    return {name: float(deviation) for name, deviation in zip(problem.free, deviations, strict=False)}


def _checked(model: Model, records, noise_variance) -> tuple[Record, ...]:
    """Return the records as a tuple, once they, the model and the variances can be meant."""
    instance("model", model, Model, "make one, such as ehsvjax.servovalve()")
    records = checked_records(records)
    given = by_name("noise_variance", noise_variance, "{'position': 1e-8}")
    known = ", ".join(model.outputs)
    if not given:
        raise ValueError(
            f"expected noise_variance of each output that is measured, of {known}; got none: give it by name"
        )
    for name, variance in given.items():
        if name not in model.outputs:
            raise ValueError(f"expected noise_variance of outputs of {model.name}, {known}; got {name!r}")
        checked_variance(model, name, variance)
    return records


def _point(model: Model, problem: Problem, parameters, initial_values) -> np.ndarray:
    values = changed(model, "parameters", model.nominal, parameters)
    start = changed(model, "initial conditions", {p.name: p.value for p in model.initial}, initial_values)
    count = len(problem.samples.inputs)
    return np.array(
        [values[name] for name in problem.free] + [start[name] for _ in range(count) for name in problem.free_initial]
    )
