"""How precisely a record can fix its parameters: the Fisher information of a model at given values."""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ehsvjax.models.model import Model
from ehsvjax.population import Coordinates, Problem, cast, residuals
from ehsvjax.record import Record
from ehsvjax.unknowns import Initial, problem_of


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
        name -> standard deviation, SI, of each free parameter; +inf for those that the records do not fix.

    Raises:
        ValueError: as `identify` does.

    """
    records = (records,) if isinstance(records, Record) else tuple(records)
    problem = problem_of(model, records, initial=initial, noise_variance=noise_variance)
    values = model.nominal | dict(parameters or {})
    start = {p.name: p.value for p in model.initial} | dict(initial_values or {})
    point = [values[name] for name in problem.free]
    point += [start[name] for _ in records for name in problem.free_initial]
    deviations = _deviations(_information(problem, np.array(point)), problem)
    return {name: float(deviation) for name, deviation in zip(problem.free, deviations, strict=False)}


def _information(problem: Problem, point: Float[np.ndarray, " parameter"]) -> Float[np.ndarray, "parameter parameter"]:
    """Return the Fisher information of the unknowns, each in units of the width of its bounds."""
    width = problem.coordinates.upper - problem.coordinates.lower
    in_widths = Coordinates(np.zeros_like(width), width, np.zeros(len(width), bool))
    with jax.enable_x64(True):
        scaled = cast(replace(problem, coordinates=in_widths), jnp.float64)
        return np.asarray(_fisher_information(scaled, jnp.asarray(point / width)))


@jax.jit
def _fisher_information(problem: Problem, individual):
    jacobian = jax.jacfwd(functools.partial(residuals, problem))(individual).reshape(-1, len(individual))
    return jacobian.T @ jacobian


def _deviations(information, problem: Problem) -> Float[np.ndarray, " parameter"]:
    """Return the square roots of the diagonal of the inverse, +inf where a direction of no information takes part."""
    diagonal = np.diagonal(information)
    seen = diagonal > 0
    scale = np.where(seen, 1.0 / np.sqrt(np.where(seen, diagonal, 1.0)), 0.0)
    values, vectors = np.linalg.eigh(information * scale[:, None] * scale[None, :])
    # Below this, rounding of the sensitivities in float64 looks like information.
    informed = values > 1e-12 * values[-1]
    variance = vectors[:, informed] ** 2 @ (1.0 / values[informed])
    unresolved = ~seen | (np.sum(vectors[:, ~informed] ** 2, axis=1) > 1e-6)
    width = problem.coordinates.upper - problem.coordinates.lower
    return np.where(unresolved, np.inf, np.sqrt(variance) * scale * width)
