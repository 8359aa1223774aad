"""Standard errors and correlations of parameters, and which of them a record fixes at all."""

from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ehsvjax.checks import choice, number
from ehsvjax.models.model import Model
from ehsvjax.population import Problem
from ehsvjax.precision.directions import (
    NOT_FIXED,
    Combination,
    Direction,
    Spectrum,
    combinations,
    of_covariance,
    parameter_root,
    spectrum,
    taking_part,
)
from ehsvjax.precision.remedies import unfixed_directions
from ehsvjax.precision.residual_noise import SUSPICION, ResidualNoise, absorbed_by_the_fit, meat, residual_noise
from ehsvjax.precision.sensitivities import ROUNDING, Sensitivities, check_finite, sensitivities
from ehsvjax.quantities import quantity

if TYPE_CHECKING:
    import matplotlib.figure


@dataclass(frozen=True, eq=False)
class Precision:
    """How sure the parameters are, to first order (Fisher information). Printed in lmfit's manner.

    Attributes:
        values: name -> value of each free parameter, SI.
        units: name -> its unit.
        standard_errors: name -> standard deviation, SI; +inf for a parameter that the record does not fix.
        correlations: (name, name) -> correlation of each pair of parameters that are fixed.
        covariance: `[parameter, parameter]`, SI, in the order of `values`; NaN where a parameter is not fixed.
        combinations: products, ratios and sums that are fixed although their parameters are not.
        unfixed: the directions that are not fixed, with what would fix them.
        initial_errors: for each record, name -> standard deviation of the initial conditions estimated, SI.
        noise: what noise was counted on, and why, in a sentence.
        coloured: whether correlated noise was counted on.
        logarithmic: names of the parameters that are searched by their logarithm.

    """

    values: dict[str, float]
    units: dict[str, str]
    standard_errors: dict[str, float]
    correlations: dict[tuple[str, str], float]
    covariance: Float[np.ndarray, "parameter parameter"]
    combinations: tuple[Combination, ...]
    unfixed: tuple[Direction, ...]
    initial_errors: tuple[dict[str, float], ...]
    noise: str
    coloured: bool
    logarithmic: tuple[str, ...]

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Return name -> (lower, upper) of each parameter by its standard error; infinite where it is not fixed.

        Symmetric on the scale on which the parameter is searched: on a logarithmic one it reaches the same factor up
        and down. Where errors are a tenth of the value and more that holds the truth more often.

        Raises:
            ValueError: unless the level is between 0 and 1.

        """
        quantile = quantile_of(level)
        found = {}
        for name, value in self.values.items():
            reach = quantile * self.standard_errors[name]
            if name in self.logarithmic and np.isfinite(reach):
                factor = float(np.exp(reach / value))
                found[name] = (value / factor, value * factor)
            else:
                found[name] = (value - reach, value + reach)
        return found

    def plot(self) -> "matplotlib.figure.Figure":
        """Draw the ellipse of every pair of parameters that holds them with 95%; returns the matplotlib figure."""
        from ehsvjax.plots import plot_corner

        return plot_corner(self.values, self.units, self.covariance)

    def __str__(self) -> str:
        """Return the table of parameters, correlations above 0.5, and what is not fixed."""
        from ehsvjax.summary import precision_summary

        return precision_summary(self)

    __repr__ = __str__


# Of the noise's variance, in the problem's.
_LEAST_FACTOR = 1e-100


def quantile_of(level: float) -> float:
    """Return the normal quantile of a two-sided interval.

    Raises:
        ValueError: unless the level is between 0 and 1.

    """
    level = number("level", level, "a confidence level between 0 and 1", lambda x: 0.0 < x < 1.0, "0.95 is usual")
    return NormalDist().inv_cdf(0.5 + 0.5 * level)


class Linearised(NamedTuple):
    """A fit to first order: what standard errors, bands and draws are made of.

    Attributes:
        found: the sensitivities.
        noises: of each output's residuals; None where the noise is expected, not seen.
        factor: the noise's variance in units of the problem's, as it counts for the parameters.
        curvature: of the cost, over that of the sum of squares: below 1 where large residuals weigh linearly.
        words: what noise was counted on, and why.
        covariance: `[parameter, parameter]` of the unknowns, each in its unit.
        seen: `[parameter]` which of them the record shows apart at all.

    """

    found: Sensitivities
    noises: list[ResidualNoise] | None
    factor: float
    curvature: float
    words: str
    covariance: Float[np.ndarray, "parameter parameter"]
    seen: Bool[np.ndarray, " parameter"]


def linearised(
    problem: Problem,
    values: Float[np.ndarray, " parameter"],
    *,
    noise_variance_given: bool,
    colour: str = "auto",
    expected: bool = False,
) -> Linearised:
    """Return the unknowns' covariance at their values.

    Args:
        problem: in NumPy float64.
        values: of every unknown, SI.
        noise_variance_given: whether the problem's noise variance is known, or is to be taken from the residuals.
        colour: "white" noise, "coloured" noise, or "auto": coloured if the residuals are not white.
        expected: there are no residuals: the noise is white, of the problem's variance.

    Raises:
        ValueError: for an unknown colour, or where the simulation or a derivative of it is not finite.

    """
    choice("noise", colour, ("auto", "white", "coloured"))
    found = sensitivities(problem, values)
    check_finite(problem, found)
    noises, factor, curvature, words = None, 1.0, 1.0, "white, of the variance given"
    if not expected:
        noises, factor, curvature, words = _noise(problem, found, noise_variance_given, colour)
    covariance, seen = covariance_of(found, noises, factor)
    return Linearised(found, noises, factor, curvature, words, covariance, seen)


def covariance_of(
    found: Sensitivities, noises: list[ResidualNoise] | None, factor: float
) -> tuple[Float[np.ndarray, "parameter parameter"], Bool[np.ndarray, " parameter"]]:
    """Return the covariance of the unknowns, each in its unit, and which of them the record shows apart at all.

    (J^T J)^-1 times the noise's variance; where the noise is coloured the sandwich with J^T Sigma J inside. What is
    known of an unknown beforehand is one more reading.
    """
    bread, seen = bread_of(found, factor)
    if noises is None or not any(len(noise.coefficients) for noise in noises):
        return factor * bread, seen
    return factor * bread @ (_inside(found, noises) + factor * np.diag(found.known**2)) @ bread, seen


def bread_of(
    found: Sensitivities, factor: float
) -> tuple[Float[np.ndarray, "parameter parameter"], Bool[np.ndarray, " parameter"]]:
    """Return (J^T J)^-1 without the directions that are rounding, and which unknowns take no part in those."""
    rows = found.rows_with_known(factor)
    size = np.linalg.norm(rows, axis=0)
    per_size = np.where(size > 0, 1.0 / np.where(size > 0, size, 1.0), 0.0)
    values, vectors = np.linalg.svd(np.linalg.qr(rows * per_size, mode="r"))[1:]
    informed = values > ROUNDING * max(values[0], np.finfo(float).tiny)
    seen = (size > 0) & (np.linalg.norm(vectors[~informed], axis=0) < 1e-4)
    half = (vectors[informed].T / values[informed]) * per_size[:, None]
    return half @ half.T, seen


def _inside(found: Sensitivities, noises: list[ResidualNoise]) -> Float[np.ndarray, "parameter parameter"]:
    """Return J^T Sigma J over all outputs, for noises of mean variance 1."""
    jacobian = np.where(found.measured[..., None], found.jacobian, 0.0)
    inside = np.sum([meat(jacobian[:, :, i], noise) for i, noise in enumerate(noises)], axis=0)
    return inside / _mean_variance(found, noises)


def _mean_variance(found: Sensitivities, noises: list[ResidualNoise]) -> float:
    counts = found.measured.sum(axis=(0, 1))
    return float(np.sum(counts * [noise.variance for noise in noises]) / np.sum(counts))


def _noise(problem: Problem, found: Sensitivities, given: bool, colour: str):
    """Return each output's noise, the variance in units of the problem's, the cost's curvature, and a sentence."""
    standardised = (problem.samples.outputs - found.simulated) / np.sqrt(problem.noise_variance)
    standardised = np.where(found.measured, standardised, 0.0)
    count, unknowns = int(found.measured.sum()), len(found.values)
    # The influence of a residual, and how much of a step of the parameters it undoes (Huber 1981, section 7.6).
    influence, curvature = standardised, 1.0
    if problem.huber is not None:
        influence = np.clip(standardised, -problem.huber, problem.huber)
        curvature = float(np.mean(np.abs(standardised[found.measured]) <= problem.huber))
    noises = [
        residual_noise(influence[..., i], found.measured[..., i], colour) for i in range(len(problem.noise_variance))
    ]
    variance = float(np.sum(influence**2)) / (count - unknowns)
    if any(len(noise.coefficients) for noise in noises):
        noises = _with_what_the_fit_took(found, influence, noises)
        variance = _mean_variance(found, noises)
    if given and problem.huber is None:
        factor, source = 1.0, "of the variance given"
    else:
        factor, source = variance / curvature**2, "of the residuals' variance"
    return noises, factor, curvature, _sentence(problem, noises, colour, source)


def _with_what_the_fit_took(found: Sensitivities, influence, noises: list[ResidualNoise]) -> list[ResidualNoise]:
    """Return the noises estimated again from autocovariances to which what the fit absorbed is added back."""
    bread, _ = bread_of(found, 1.0)
    # Of the inverse of J^T J: J times this root has orthonormal columns.
    scale = np.sqrt(np.maximum(np.diag(bread), 1e-300))
    squares, directions = np.linalg.eigh(bread / scale[:, None] / scale)
    root = scale[:, None] * directions * np.sqrt(np.maximum(squares, 0.0))
    basis = np.where(found.measured[..., None], found.jacobian, 0.0) @ root
    for _ in range(2):
        inside = root.T @ _inside(found, noises) @ root * _mean_variance(found, noises)
        noises = [
            residual_noise(
                influence[..., i],
                found.measured[..., i],
                "coloured" if len(noise.coefficients) else "white",
                absorbed_by_the_fit(basis[:, :, i], found.measured[..., i], noise, inside),
            )._replace(p_value=noise.p_value)
            for i, noise in enumerate(noises)
        ]
    return noises


def _sentence(problem: Problem, noises: list[ResidualNoise], colour: str, source: str) -> str:
    p_value = min((noise.p_value for noise in noises), key=lambda p: (np.isnan(p), p))
    test = f"Ljung-Box test p = {p_value:.2g}" if p_value >= 1e-3 else "Ljung-Box test p < 0.001"
    coloured = [(name, n) for name, n in zip(problem.observed, noises, strict=True) if len(n.coefficients)]
    if not coloured:
        if colour == "white":
            why = "asked for"
        elif np.isnan(p_value):
            why = "the residuals are too few to tell"
        elif p_value < SUSPICION or colour == "coloured":
            why = f"no autoregression describes the residuals better ({test})"
        else:
            why = f"the residuals look white ({test})"
        return f"white, {source}: {why}"
    period, samples = float(np.max(problem.samples.sample_period)), int(np.sum(problem.samples.measured))
    each = ", ".join(
        f"{name}: autoregression of order {len(n.coefficients)}, {_worth(n, period, samples)}" for name, n in coloured
    )
    why = "asked for" if colour == "coloured" else f"the residuals are correlated ({test})"
    return f"coloured, {source}: {why}; {each}"


def _worth(noise: ResidualNoise, period: float, samples: int) -> str:
    """Say how much samples with noise of that colour tell of a constant."""
    together = noise.correlation_samples
    if not together < samples:
        return f"which all {samples} samples together do not average out"
    if together < 1.0:
        return f"whose swings cancel: of a constant one sample tells as much as {1.0 / together:.3g} with white noise"
    return f"{together:.3g} samples ({quantity(period * together, 's')}) tell as much as one"


def precision_of(model: Model, problem: Problem, fit: Linearised) -> Precision:
    """Return what a person wants to know of a fit to first order."""
    found, noises, factor, _, words, covariance, seen = fit
    # Data without any noise leave no residuals, and all directions that show are fixed.
    factor = max(factor, _LEAST_FACTOR)
    directions = spectrum(parameter_root(found, factor) / np.sqrt(factor))
    count, names = len(found.names), list(found.names)
    coloured = noises is not None and any(len(noise.coefficients) for noise in noises)
    if coloured:
        directions = of_covariance(directions, covariance[:count, :count])
    deviation = np.sqrt(np.diagonal(covariance))
    fixed = seen & (deviation <= NOT_FIXED)
    fixed[:count] &= ~taking_part_strongly(directions)
    errors = np.where(fixed[:count], deviation[:count] * found.scale[:count], np.inf)
    parameters = covariance[:count, :count] * np.outer(found.scale[:count], found.scale[:count])
    both = np.outer(fixed[:count], fixed[:count])
    per_deviation = np.where(deviation > 0, 1.0 / np.where(deviation > 0, deviation, 1.0), 0.0)
    correlation = covariance * np.outer(per_deviation, per_deviation)
    initial = np.where(seen[count:], deviation[count:] * found.scale[count:], np.inf)
    by_record = initial.reshape(len(problem.samples.inputs), len(problem.free_initial))
    return Precision(
        values={name: float(v) for name, v in zip(names, found.values, strict=False)},
        units={name: model.parameter(name).unit for name in names},
        standard_errors={name: float(e) for name, e in zip(names, errors, strict=True)},
        correlations={
            (names[i], names[j]): float(correlation[i, j]) for i in range(count) for j in range(i) if both[i, j]
        },
        covariance=np.where(both, parameters, np.nan),
        combinations=combinations(found, directions, ~fixed[:count]),
        unfixed=unfixed_directions(problem, found, directions),
        initial_errors=tuple(
            {name: float(e) for name, e in zip(problem.free_initial, row, strict=True)} for row in by_record
        ),
        noise=words,
        coloured=coloured,
        logarithmic=tuple(name for name in names if model.parameter(name).scale == "log"),
    )


def taking_part_strongly(directions: Spectrum) -> Bool[np.ndarray, " parameter"]:
    """Return which parameters take part in a direction of which the record shows nothing."""
    return taking_part(directions.directions[:, ~np.isfinite(directions.deviation)])
