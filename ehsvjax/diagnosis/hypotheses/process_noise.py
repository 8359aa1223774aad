"""Noise that acts on the motion, told from noise of the sensor by its likelihood.

A random force passes through the model before it is seen: its residuals are smooth, grow where the motion is sensitive,
and remember for as long as the motion does. Correlated noise of a sensor is alike all along a record. Both are Gaussian
with a covariance that the model gives: q*H*H' + s*I for a force of intensity q that is constant over short parts of the
record, whose responses H are simulated, and an autoregression for the sensor.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.diagnosis.bench.noise import Noise
from ehsvjax.diagnosis.bench.parts import parts_at
from ehsvjax.diagnosis.bench.refits import Refits, refit, span
from ehsvjax.diagnosis.bench.workbench import Workbench
from ehsvjax.precision.residual_noise import residual_noise

# Rounds in which a random force and the unknowns under it settle, and what the last one gains at most.
_ROUNDS, _SETTLED = 5, 0.1


class ProcessNoise(NamedTuple):
    """A random force: at which signal, its spectral density, unit^2 s, and how well it explains the residual.

    Attributes:
        place: signal at which it acts.
        intensity: its spectral density.
        likelihood: twice the logarithm with the random force and white noise of the sensor, less Bayes' price for its
            intensity.
        of_sensor: the same with the best noise of the sensor alone, white or correlated.
        settled: whether a repeat of the experiment left something else: without one, nothing tells chance from a term
            that the bank lacks.

    """

    place: str
    intensity: float
    likelihood: float
    of_sensor: float
    settled: bool = False

    @property
    def best(self) -> float:
        """The likelihood of the better of the two."""
        return max(self.likelihood, self.of_sensor)


def process_noise(
    bench: Workbench, final: Refits, noise: Noise, also: Sequence[Float[np.ndarray, " parameter"]] = ()
) -> ProcessNoise | None:
    """Compare a random force with noise of the sensor; None for several outputs, or where no force shows.

    By the samples that are used for any other explanation too, as `noise` says: likelihoods of others are no
    comparison.

    Args:
        bench: the trials' workbench.
        final: a refit by least squares: what of it a sensor's noise leaves.
        noise: of what is left.
        also: other points from which its unknowns are refitted under a force.

    """
    kinds = {s.name: s.kind for s in bench.fit.model.signals}
    places = [p for p in bench.places if kinds[p] == "force"]
    if not places or len(bench.problem.observed) > 1:
        return None
    measured = noise.known[..., 0]
    # Each record in deviations of its own noise.
    deviation = np.sqrt(noise.innovation_variances)
    force = _refitted(bench, final, places[0], lambda series: (series[..., 0] / deviation)[..., measured], also)
    if force is None:
        return None
    residual = final.residual[0][..., 0] / deviation
    sensor = sum(
        _likelihood_of_sensor(np.where(there, one, 0.0)[None], there[None])
        for one, there in zip(residual, measured, strict=True)
    )
    units, price = noise.log_units, float(np.log(measured.sum()))
    return ProcessNoise(places[0], force.intensity, 2.0 * force.likelihood - price - units, 2.0 * float(sensor) - units)


class _Force(NamedTuple):
    """A random force at its most likely: weighed by it and the sensor's noise, readings are white.

    Attributes:
        intensity: its spectral density.
        likelihood: the logarithm of that of all readings.
        unweighed: readings in deviations of the sensor's noise, as they are.
        directions: `[sample, direction]` along which the force acts.
        deviations: `[direction]` along each, in those of the noise.

    """

    intensity: float
    likelihood: float
    unweighed: Callable[[np.ndarray], np.ndarray]
    directions: Float[np.ndarray, "sample direction"]
    deviations: Float[np.ndarray, " direction"]

    def scaled(self, series: Float[np.ndarray, "*batch record time signal"]) -> Float[np.ndarray, "*batch sample"]:
        """Return the readings in deviations of what is of chance in them."""
        scaled = self.unweighed(series)
        return scaled - ((scaled @ self.directions) * (1.0 - 1.0 / self.deviations)) @ self.directions.T


def _refitted(
    bench: Workbench,
    final: Refits,
    place: str,
    scaled: Callable[[np.ndarray], np.ndarray],
    also: Sequence[Float[np.ndarray, " parameter"]],
) -> _Force | None:
    """Refit a model's unknowns under a random force, by generalised least squares; None where no force shows.

    The motion that a force leaves behind has led a refit by least squares far off.
    """
    best: _Force | None = None
    refitted = final
    for _ in range(_ROUNDS):
        parts = parts_at(bench, refitted.points[0], place)
        responses, residual = scaled(parts.responses), scaled(refitted.residual[0])
        if not responses.any() or not np.isfinite(residual).all():
            break
        force = _most_likely(responses, scaled(refitted.slopes[0]), residual, parts.length, scaled)
        if best is not None and not force.likelihood > best.likelihood + _SETTLED:
            break
        best = force
        starts = np.stack([refitted.points[0], *also])
        led = refit(bench, starts, np.repeat(final.chosen[:1], len(starts), axis=0), force, race=False)
        refitted = led.of([int(np.argmin(led.cost))])
    return best


def _most_likely(responses, slopes, residual, length, scaled) -> _Force:
    """Return the random force, of which parts have some length, s, that is most likely as the unknowns follow it.

    By its restricted likelihood: what the unknowns take up of it tells nothing of its intensity (Patterson & Thompson
    1971, "Recovery of inter-block information when block sizes are unequal").
    """
    from scipy.optimize import minimize_scalar

    directions, gains, _ = np.linalg.svd(responses.T, full_matrices=False)
    both = np.column_stack([span(slopes), residual])
    squares, along = both.T @ both, directions.T @ both
    count = len(residual)

    def profiled(log_ratio):
        spread = 1.0 + np.exp(log_ratio) * gains**2
        weighed = squares - along.T @ ((1.0 - 1.0 / spread)[:, None] * along)
        known, of_residual = weighed[:-1, :-1], weighed[:-1, -1]
        variance = float(weighed[-1, -1] - of_residual @ np.linalg.solve(known, of_residual)) / count
        volume = np.sum(np.log(spread)) + np.linalg.slogdet(known)[1]
        return 0.5 * (count * np.log(max(variance, 1e-300)) + volume + count), variance, spread

    largest = np.log(1.0 / max(gains[0], 1e-300) ** 2)
    best = minimize_scalar(lambda x: profiled(x)[0], bounds=(largest - 10.0, largest + 25.0), method="bounded")
    cost, variance, spread = profiled(best.x)
    return _Force(float(np.exp(best.x)) * variance * length, -float(cost), scaled, directions, np.sqrt(spread))


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
