"""Bands about a simulated output: where the model's own curve may lie, and where a new measurement would."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.precision.sensitivities import ROUNDING, Sensitivities


class Band(NamedTuple):
    """Half widths of the bands about one simulated output, in its unit.

    Attributes:
        model: `[time]`, for the errors of the parameters and initial conditions: where the true curve lies.
        measurement: `[time]`, for the noise as well: where a new sample lies.

    """

    model: Float[np.ndarray, " time"]
    measurement: Float[np.ndarray, " time"]


def deviations(
    found: Sensitivities, covariance: Float[np.ndarray, "parameter parameter"]
) -> Float[np.ndarray, "record time signal"]:
    """Return the standard deviation of each simulated output due to the unknowns', in noise standard deviations.

    It is +inf where the simulation is not finite.
    """
    return _root(found, np.einsum("...p,pq,...q->...", found.jacobian, covariance, found.jacobian))


def new_deviations(
    found: Sensitivities, covariance: Float[np.ndarray, "parameter parameter"], factor: float
) -> Float[np.ndarray, "record time signal"]:
    """Return the same for a record that was not fitted, whose initial conditions are estimated from its own readings.

    Args:
        found: on that record.
        covariance: of the parameters.
        factor: variance of its noise, in the problem's.

    """
    known = found._replace(
        jacobian=np.where(found.finite[..., None], found.jacobian, 0.0), measured=found.measured & found.finite
    )
    by_parameters, by_initial = total_sensitivities(known)
    variance = np.einsum("...p,pq,...q->...", by_parameters, covariance, by_parameters)
    return _root(found, variance + factor * np.sum(by_initial**2, axis=-1))


def _root(found: Sensitivities, variance) -> Float[np.ndarray, "record time signal"]:
    return np.where(found.finite, np.sqrt(np.maximum(variance, 0.0)), np.inf)


def total_sensitivities(
    found: Sensitivities,
) -> tuple[Float[np.ndarray, "record time signal parameter"], Float[np.ndarray, "record time signal initial"]]:
    """Return the sensitivities to the parameters of a record whose initial conditions are fitted for given parameters.

    As the parameters move, the initial conditions move with them: J - J0 (J0^T J0)^-1 J0^T J. The second result are the
    initial conditions' own, in units of their errors.
    """
    count = len(found.names)
    initial = found.rows[:, count:]
    size = np.linalg.norm(initial, axis=0)
    kept = size > 0
    basis, values, vectors = np.linalg.svd(initial[:, kept] / size[kept], full_matrices=False)
    informed = values > ROUNDING * max(values[0], np.finfo(float).tiny) if len(values) else np.zeros(0, bool)
    to_units = (vectors[informed].T / values[informed]) / size[kept][:, None]
    own = found.jacobian[..., count:][..., kept] @ to_units
    following = basis[:, informed].T @ found.rows[:, :count]
    return found.jacobian[..., :count] - own @ following, own
