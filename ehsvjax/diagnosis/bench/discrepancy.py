"""What is left of a model that lacks something, or is shaken: sums of small disturbances, of chance in size.

No experiment shows how a model is wrong beyond its causes. But what is wrong passes through the model before it is
seen: it acts somewhere, is new from part to part of a record or wanders, and the model makes of it what it makes of any
disturbance there. So what is left in quick directions tells how much more there is in slow ones, where the unknowns and
the causes have taken it away (the discrepancy of Kennedy & O'Hagan 2001, "Bayesian calibration of computer models",
with the covariance that the model gives; its size by restricted maximum likelihood, Patterson & Thompson 1971).
"""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.diagnosis.bench.evidence import probabilities
from ehsvjax.diagnosis.bench.parts import Parts
from ehsvjax.diagnosis.bench.workbench import TOLD_APART

# Directions of what a disturbance does below this share of the largest are rounding.
_NEGLIGIBLE = 1e-6


class Disturbances(NamedTuple):
    """What disturbances do to the outputs.

    Attributes:
        responses: of each kind, to that of each part of the records, by unit.
        unknowns: derivatives of the outputs by what is refitted: what of a disturbance these can do is not left.

    """

    responses: tuple[Float[np.ndarray, "part record time signal"], ...]
    unknowns: Float[np.ndarray, "direction record time signal"]


class Discrepancy(NamedTuple):
    """The same of one kind, of readings that count in deviations of their noise.

    Attributes:
        responses: `[part, sample]`.
        left: of these what the unknowns cannot do.
        products: of what is left of each.
        noise_products: covariance of the noise's products with it.

    """

    responses: Float[np.ndarray, "part sample"]
    left: Float[np.ndarray, "part sample"]
    products: Float[np.ndarray, "part part"]
    noise_products: Float[np.ndarray, "part part"]

    def along(
        self, direction: Float[np.ndarray, " sample"], residual: Float[np.ndarray, " sample"]
    ) -> tuple[float, float]:
        """Return by how much more likely than noise alone a random disturbance is, twice the logarithm, and the
        variance that it then gives along a direction of length one, along which the residual tells nothing.
        """
        from scipy.optimize import minimize_scalar

        along = self.left @ direction
        values, vectors = np.linalg.eigh(self.products - np.outer(along, along))
        told = values > _NEGLIGIBLE * max(values[-1], float(along @ along))
        if not told.any():
            return 0.0, 0.0
        values, vectors = values[told], vectors[:, told] / np.sqrt(values[told])
        squares = (vectors.T @ (self.left @ residual - along * (direction @ residual))) ** 2
        of_noise = np.sum(vectors * (self.noise_products @ vectors), axis=0)
        of_noise /= np.sum(vectors * (self.products @ vectors), axis=0)

        def deviance(log_variance):
            of_both = of_noise + np.exp(log_variance) * values
            return float(np.sum(np.log(of_both / of_noise) + squares / of_both - squares / of_noise))

        largest = -np.log(values[-1])
        best = minimize_scalar(deviance, bounds=(largest - 5.0, largest + 30.0), method="bounded")
        return -float(best.fun), float(np.exp(best.x) * np.sum((self.responses @ direction) ** 2))


def variance_along(
    some: Sequence[Discrepancy], direction: Float[np.ndarray, " sample"], residual: Float[np.ndarray, " sample"]
) -> float:
    """Return the variance that random disturbances give along a direction of length one, as what is left says.

    The mean over what may act, each as probable as it is likely, noise alone among them: as probable beforehand as all
    kinds of disturbance together (Hoeting et al. 1999, "Bayesian model averaging"), each of which has a variance more.
    """
    if not some:
        return 0.0
    likelier, variances = zip(*[one.along(direction, residual) for one in some], strict=True)
    price = 2.0 * np.log(len(some)) + np.log([len(one.left) for one in some])
    return float(probabilities([0.0, *(price - likelier)])[1:] @ variances)


def discrepancies(
    disturbances: Disturbances,
    scaled: Callable[[np.ndarray], np.ndarray],
    noise_products: Callable[[np.ndarray], np.ndarray],
) -> tuple[Discrepancy, ...]:
    """Return what disturbances do to readings in deviations of their noise.

    Args:
        disturbances: of which kinds.
        scaled: `Noise.scaled`.
        noise_products: `Noise.products`.

    """
    known = span(scaled(disturbances.unknowns))
    found = []
    for of_kind in disturbances.responses:
        responses = scaled(of_kind)
        left = responses - (responses @ known) @ known.T
        found.append(Discrepancy(responses, left, left @ left.T, noise_products(left)))
    return tuple(found)


def kinds_of(every: Iterable[Parts], sensors: int) -> tuple[Float[np.ndarray, "part record time signal"], ...]:
    """Return what disturbances at some places, and at each of so many sensors, do to the outputs.

    Each is new in every part of a record, or goes on from there.

    Args:
        every: what one over each of the same parts does, of each place.
        sensors: whose readings it may be.

    """
    responses: list[np.ndarray] = []
    for one in every:
        over_each = [one.responses.astype(float)]
        if not responses:
            inside = one.of_sample == np.arange(len(one.of_record))[:, None, None]
            over_each += [inside[..., None] * sensor for sensor in np.eye(sensors)]
        for new in over_each:
            of_records = [new[one.of_record == k] for k in np.unique(one.of_record)]
            responses += [new, np.concatenate([np.cumsum(of[::-1], axis=0)[::-1] for of in of_records])]
    return tuple(responses)


def span(slopes: Float[np.ndarray, "direction sample"]) -> Float[np.ndarray, "sample independent"]:
    """Return an orthonormal basis of what the unknowns can do to first order."""
    norms = np.linalg.norm(slopes, axis=1)
    kept = slopes[norms > 0] / norms[norms > 0, None]
    if not len(kept):
        return np.zeros((slopes.shape[1], 0))
    vectors, values, _ = np.linalg.svd(kept.T, full_matrices=False)
    return vectors[:, values > TOLD_APART * values[0]]
