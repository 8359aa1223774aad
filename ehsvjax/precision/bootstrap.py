"""The bootstrap: refit records drawn anew from the fit, all draws in one batch, without any formula for the errors."""

import warnings
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Key

from ehsvjax import kernels
from ehsvjax.checks import choice, fits_memory, whole
from ehsvjax.draws import check_key
from ehsvjax.population import Problem, cast, to_unit, to_values
from ehsvjax.precision.residual_noise import ResidualNoise
from ehsvjax.precision.standard_errors import quantile_of
from ehsvjax.refine import refine

if TYPE_CHECKING:
    import matplotlib.figure

    from ehsvjax.precision.profile import ProfileLikelihood

# Draws that are refitted side by side.
_TOGETHER = 32


class Bootstrap(NamedTuple):
    """Parameters refitted to drawn records.

    Attributes:
        parameters: name -> `[draw]`, SI, of the refits that converged.
        estimates: name -> value of the fit itself, SI.
        lost: how many refits did not converge, and are left out.
        units: name -> unit.
        covariance: `[free, free]` by linear theory, SI, in the order of `parameters`; NaN where it says
            nothing.

    """

    parameters: dict[str, Float[np.ndarray, " draw"]]
    estimates: dict[str, float]
    lost: int
    units: dict[str, str]
    covariance: Float[np.ndarray, "free free"]

    @property
    def standard_errors(self) -> dict[str, float]:
        """Name -> standard deviation over the draws, SI; +inf where fewer than two refits converged."""
        return {
            name: float(np.std(values, ddof=1)) if len(values) > 1 else np.inf
            for name, values in self.parameters.items()
        }

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Return name -> (lower, upper), the basic interval: the estimate less the draws' own deviations.

        Davison & Hinkley 1997, Bootstrap Methods and their Application, section 5.2. Infinite where fewer than two
        refits converged.

        Raises:
            ValueError: unless the level is between 0 and 1.

        """
        quantile_of(level)
        tail = 0.5 * (1.0 - level)
        found = {}
        for name, values in self.parameters.items():
            if len(values) < 2:
                found[name] = (-np.inf, np.inf)
                continue
            low, high = np.quantile(values, [tail, 1.0 - tail])
            found[name] = (float(2.0 * self.estimates[name] - high), float(2.0 * self.estimates[name] - low))
        return found

    def plot(self, profiles: "ProfileLikelihood | None" = None) -> "matplotlib.figure.Figure":
        """Draw every pair of parameters and every one by itself; returns the matplotlib figure.

        The draws, the ellipse or the bell of linear theory, and the profile likelihood where it is handed over.

        Raises:
            ValueError: for profiles that are none, or of none of these parameters, or where too few refits converged.

        """
        from ehsvjax.plots import plot_corner

        if len(next(iter(self.parameters.values()))) < 2:
            raise ValueError("expected two refits that converged, got fewer: draw more, or look why the fit fails")
        return plot_corner(self.estimates, self.units, self.covariance, self.parameters, profiles)

    def __str__(self) -> str:
        """Return a line for each parameter."""
        draws = len(next(iter(self.parameters.values())))
        lines = [f"[[Bootstrap, {draws} draws, 95% intervals]]"]
        width, errors = max(map(len, self.parameters)), self.standard_errors
        for name, (lower, upper) in self.intervals().items():
            known = f"{errors[name]:.2g}  {lower:.6g} .. {upper:.6g}" if len(self.parameters[name]) > 1 else "not known"
            lines.append(f"    {name:<{width}}  {self.estimates[name]:.6g} +/- {known}  {self.units[name]}".rstrip())
        if self.lost:
            lines.append(f"    {self.lost} more refits failed or did not converge, and are left out")
        return "\n".join(lines)


def bootstrap(
    problem: Problem,
    values: Float[np.ndarray, " parameter"],
    simulated: Float[np.ndarray, "record time signal"],
    noises: list[ResidualNoise],
    variance: float,
    *,
    key: Key[Array, ""],
    draws: int,
    kind: str,
    units: dict[str, str],
    covariance: Float[np.ndarray, "free free"],
) -> Bootstrap:
    """Refit drawn records, from the fit's own values on.

    Args:
        problem: in NumPy float64.
        values: of every unknown of the fit, SI.
        simulated: the fit's outputs, SI.
        noises: of each output's standardised residuals.
        variance: of a sample's noise in units of the problem's.
        key: random key.
        draws: how many.
        kind: "parametric" draws Gaussian noise of the residuals' own colour; "block" puts blocks of the residuals
            themselves together anew (Kunsch 1989), longer than the noise is correlated.
        units: name -> unit, of every parameter.
        covariance: of the parameters by linear theory, SI.

    Raises:
        ValueError: for an unknown kind, or fewer than 2 draws.

    """
    check_key(key)
    choice("kind", kind, ("parametric", "block"))
    whole("draws", draws, 2)
    fits_memory("a bootstrap", f"draws={draws} of {simulated.size} readings", float(draws) * simulated.nbytes)
    random = np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel())
    deviation = np.sqrt(problem.noise_variance)
    shape = simulated.shape[:2]
    drawn = np.empty((draws, *simulated.shape))
    # Residuals are smaller than the noise by what the unknowns took.
    count = int(problem.samples.measured.sum())
    fuller = np.sqrt(count / (count - len(values)))
    for i, noise in enumerate(noises):
        if kind == "parametric":
            relative = np.sqrt(variance) * _coloured(random, noise, (draws, *shape))
        else:
            residuals = fuller * (problem.samples.outputs - simulated)[..., i] / deviation[i]
            relative = _blocks(random, residuals, problem.samples.measured[..., i], noise, draws)
        drawn[..., i] = simulated[..., i] + deviation[i] * relative
    start = np.clip(to_unit(problem.coordinates, values), 0.0, 1.0)
    known = None
    if problem.priors is not None:
        # What is known beforehand is a reading too, and drawn anew as they are.
        off = np.where(np.isfinite(problem.priors.deviation), problem.priors.deviation, 0.0)
        known = values + off * random.standard_normal((draws, len(values)))
    with kernels.double_precision():
        drawn_anew = jnp.asarray(drawn), None if known is None else jnp.asarray(known)
        individuals, converged = _refits(cast(problem, jnp.float64), drawn_anew, jnp.asarray(start))
    refitted, good = to_values(problem.coordinates, np.asarray(individuals)), np.asarray(converged)
    if not good.all():
        words = f"{np.sum(~good)} of {draws} refits failed or did not converge, and are left out"
        warnings.warn(words, RuntimeWarning, stacklevel=4)
    return Bootstrap(
        {name: refitted[good, i] for i, name in enumerate(problem.free)},
        {name: float(values[i]) for i, name in enumerate(problem.free)},
        int(np.sum(~good)),
        units,
        covariance,
    )


@kernels.jit
def _refits(problem: Problem, drawn, start: Float[Array, " parameter"]):
    """Refit to drawn outputs `[draw, record, time, signal]` and means of priors `[draw, parameter]`, if there are."""

    def refit(drawn):
        outputs, known = drawn
        priors = None if problem.priors is None else problem.priors._replace(mean=known)
        samples = problem.samples._replace(outputs=outputs)
        found = refine(replace(problem, samples=samples, priors=priors), start[None])
        return found.individual[0], found.converged[0]

    return lax.map(refit, drawn, batch_size=min(_TOGETHER, len(drawn[0])))


def _coloured(random: np.random.Generator, noise: ResidualNoise, shape: tuple[int, ...]) -> np.ndarray:
    """Return noise of unit variance with the residuals' colour, `[draw, record, time]`, from its steady state on."""
    if not len(noise.coefficients):
        return random.standard_normal(shape)
    from scipy.signal import lfilter  # slow to import

    settling = 20 * len(noise.coefficients) + int(20 * noise.correlation_samples)
    innovations = random.standard_normal((*shape[:-1], shape[-1] + settling))
    coloured = lfilter([1.0], np.concatenate([[1.0], -noise.coefficients]), innovations, axis=-1)
    return coloured[..., settling:] * np.sqrt(noise.innovation_variance / noise.variance)


def _blocks(random: np.random.Generator, residuals, measured, noise: ResidualNoise, draws: int) -> np.ndarray:
    """Return residuals put together from blocks that begin anywhere and go round at the end of the record."""
    records, length = residuals.shape
    block = int(np.clip(10 * noise.correlation_samples, 1, max(length // 10, 1))) if len(noise.coefficients) else 1
    drawn = np.zeros((draws, records, length))
    for record in range(records):
        source = residuals[record][measured[record]]
        if not source.size:
            continue  # this record does not hold this output
        # Their mean is the model's error, not the noise's.
        source = source - source.mean()
        starts = random.integers(0, len(source), (draws, -(-length // block)))
        places = (starts[:, :, None] + np.arange(block)) % len(source)
        drawn[:, record] = source[places.reshape(draws, -1)[:, :length]]
    return drawn
