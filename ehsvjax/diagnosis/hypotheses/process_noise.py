"""Noise that acts on the motion, told from noise of the sensor by its likelihood.

A random force passes through the model before it is seen: its residuals are smooth, grow where the motion is sensitive,
and remember for as long as the motion does. Correlated noise of a sensor is alike all along a record. Both are Gaussian
with a covariance that the model gives: q*H*H' + s*I for a force of intensity q that is constant over short parts of the
record, whose responses H are simulated, and an autoregression for the sensor.
"""

from typing import NamedTuple

import numpy as np

from ehsvjax.diagnosis.bench.noise import Noise
from ehsvjax.diagnosis.bench.parts import parts_at
from ehsvjax.diagnosis.bench.refits import Refits, span
from ehsvjax.diagnosis.bench.workbench import Workbench
from ehsvjax.precision.residual_noise import residual_noise


class ProcessNoise(NamedTuple):
    """A random force: at which signal, its spectral density, unit^2 s, and how well it explains the residual.

    Attributes:
        place: signal at which it acts.
        intensity: its spectral density.
        likelihood: twice the logarithm with the random force and white noise of the sensor.
        of_sensor: the same with the best noise of the sensor alone, white or correlated.
        settled: whether a repeat of the experiment left something else: without one, nothing tells chance from a term
            that the bank lacks.

    """

    place: str
    intensity: float
    likelihood: float
    of_sensor: float
    settled: bool = False


def process_noise(bench: Workbench, final: Refits, noise: Noise) -> ProcessNoise | None:
    """Compare a random force with noise of the sensor; None for several outputs, or where no force shows.

    By the samples that are used for any other explanation too, as `noise` says: likelihoods of others are no
    comparison.
    """
    kinds = {s.name: s.kind for s in bench.fit.model.signals}
    places = [p for p in bench.places if kinds[p] == "force"]
    if not places or len(bench.problem.observed) > 1:
        return None
    measured = noise.known[..., 0]
    # Each record in deviations of its own noise.
    deviation = np.sqrt(noise.innovation_variances)
    known = span((final.slopes[0][..., 0] / deviation)[:, measured])
    residual = final.residual[0][..., 0] / deviation
    r = residual[measured]
    r = r - known @ (known.T @ r)
    parts = parts_at(bench, final.points[0], places[0])
    h = (parts.responses[..., 0] / deviation)[:, measured]
    h = h - (h @ known) @ known.T
    if not h.any():
        return None
    intensity, force = _likelihood_of_force(h, r)
    sensor = sum(
        _likelihood_of_sensor(np.where(there, one, 0.0)[None], there[None])
        for one, there in zip(residual, measured, strict=True)
    )
    units = noise.log_units
    return ProcessNoise(places[0], intensity * parts.length, 2.0 * force - units, 2.0 * sensor - units)


def _likelihood_of_force(h, r) -> tuple[float, float]:
    """Return the variance of the force of a part, and the log-likelihood, at their best."""
    from scipy.optimize import minimize_scalar

    vectors, values, _ = np.linalg.svd(h.T, full_matrices=False)
    z2 = (vectors.T @ r) ** 2
    rest = max(float(r @ r - z2.sum()), 1e-300)
    count = len(r)

    def profiled(log_ratio):
        spread = 1.0 + np.exp(log_ratio) * values**2
        variance = (rest + np.sum(z2 / spread)) / count
        return 0.5 * (count * np.log(variance) + np.sum(np.log(spread)) + count), variance

    largest = np.log(1.0 / max(values[0], 1e-300) ** 2)
    best = minimize_scalar(lambda x: profiled(x)[0], bounds=(largest - 10.0, largest + 25.0), method="bounded")
    return float(np.exp(best.x) * profiled(best.x)[1]), -float(best.fun)


def _likelihood_of_sensor(residual, measured) -> float:
    """Return the log-likelihood of the best noise of a sensor, less half of Bayes' price for its numbers."""
    count = int(measured.sum())
    scale = float(np.std(residual[measured]))
    best = -np.inf
    for colour in ("white", "coloured"):
        noise = residual_noise(residual / scale, measured, colour)
        variance = noise.innovation_variance * scale**2
        numbers = len(noise.coefficients)
        best = max(best, -0.5 * (count * np.log(variance) + count) - 0.5 * numbers * np.log(count))
    return best
