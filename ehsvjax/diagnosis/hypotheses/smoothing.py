"""Curves that are as smooth as a record says, and single waves."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Weights of roughness that are tried, and how far beyond those that bend the stiffest and the softest direction, in
# logarithms.
_WEIGHTS, _BEYOND = 50, 10.0
# Share of the strongest information below which a record tells nothing.
_TOLD = 1e-8
_NUMBERS_OF_A_WAVE = 3.0


class Smooth(NamedTuple):
    """A smooth curve: its coefficients, their covariance, how many pieces it effectively has.

    `left` is the sum of squares of the residual that it leaves, `evidence` twice the logarithm of how much more
    probable the readings are with some curve as smooth as this than without, in the same unit.
    """

    coefficients: Float[np.ndarray, " knot"]
    covariance: Float[np.ndarray, "knot knot"]
    pieces: float
    left: float
    evidence: float


def smoothed(
    knots: Float[np.ndarray, " knot"],
    responses: Float[np.ndarray, "knot sample"],
    readings: Float[np.ndarray, " sample"],
    colour: float = 1.0,
) -> Smooth:
    """Return a curve through knots that explains readings, as smooth as they say.

    Second derivatives are a priori normal numbers, whose variance has the largest marginal likelihood (Wahba 1985; the
    same as restricted maximum likelihood). What the readings cannot tell, such as a share of the curve that was
    projected out of the responses, is left out.

    Args:
        knots: ascending; the curve is straight in between.
        responses: of the readings to the value at each knot.
        readings: with noise, and what else the curve is not.
        colour: variance along the responses of what the curve leaves, over its variance: one if that is white.

    """
    from scipy.optimize import minimize_scalar

    raw = np.linalg.lstsq(responses.T, readings, rcond=_TOLD**0.5)[0]
    variance = colour * float(np.mean((readings - raw @ responses) ** 2))
    information = responses @ responses.T / variance
    along = responses @ readings / variance
    # In coordinates in which information is one, and roughness is diagonal (Demmler and Reinsch 1975).
    values, vectors = np.linalg.eigh(information)
    told = vectors[:, values > _TOLD * values[-1]]
    root = told / np.sqrt(values[values > _TOLD * values[-1]])
    roughness, turned = np.linalg.eigh(root.T @ _roughness(knots) @ root)
    root = root @ turned
    # Constants and straight lines, as far as the readings tell them, are not rough at all.
    straight = np.linalg.qr(np.stack([np.ones(len(knots)), knots]).T)[0]
    roughness[: int(np.sum(np.linalg.svd(told.T @ straight)[1] > 0.99))] = 0.0
    rough = roughness[roughness > 0]
    z = root.T @ along

    def cost(log_weight):
        kept = 1.0 / (1.0 + np.exp(log_weight) * roughness)
        return float(np.sum(np.log1p(np.exp(-log_weight) / rough)) - z @ (kept * z))

    if not len(rough):
        rough = np.ones(1)  # A straight line is all that the readings tell: no weight matters.
    weights = np.linspace(-np.log(rough[-1]) - _BEYOND, -np.log(rough[0]) + _BEYOND, _WEIGHTS)
    start = weights[int(np.argmin([cost(weight) for weight in weights]))]
    apart = weights[1] - weights[0]
    best = minimize_scalar(cost, bounds=(start - apart, start + apart), method="bounded").x
    kept = 1.0 / (1.0 + np.exp(best) * roughness)
    coefficients = root @ (kept * z)
    return Smooth(
        coefficients,
        (root * kept) @ root.T,
        float(np.sum(kept)),
        float(np.sum((readings - coefficients @ responses) ** 2)),
        # What is not rough at all has Bayes' price: two numbers are not for nothing.
        -(cost(best) + np.sum(roughness == 0) * np.log(len(readings))) * variance,
    )


def of_one_wave(responses: Float[np.ndarray, "phase sample"], readings: Float[np.ndarray, " sample"]) -> Smooth:
    """Return the wave of some period that explains readings best; two phases and a period have their price."""
    coefficients = np.linalg.lstsq(responses.T, readings, rcond=_TOLD**0.5)[0]
    left = float(np.sum((readings - coefficients @ responses) ** 2))
    evidence = float(readings @ readings) - left - _NUMBERS_OF_A_WAVE * float(np.log(len(readings)))
    covariance = np.linalg.pinv(responses @ responses.T, rcond=_TOLD, hermitian=True)
    return Smooth(coefficients, covariance, _NUMBERS_OF_A_WAVE, left, evidence)


def _roughness(knots) -> Float[np.ndarray, "knot knot"]:
    """Return the integral of the squared second derivative of a curve, as a quadratic form of its values at knots."""
    apart = np.diff((knots - knots[0]) / (knots[-1] - knots[0]))
    slopes = np.diff(np.eye(len(knots)), axis=0) / apart[:, None]
    curvatures = np.diff(slopes, axis=0) / np.sqrt(0.5 * (apart[1:] + apart[:-1]))[:, None]
    return curvatures.T @ curvatures
