"""Which directions of the parameters a record fixes, and which it does not: named, with what would.

A direction is a joint change of several parameters. Where the record does not show it, none of its parameters has a
standard error; products and ratios that it leaves alone may be fixed all the same.
"""

from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ehsvjax.precision.sensitivities import ROUNDING, Sensitivities

NOT_FIXED = 1.0
"""Standard deviation from which on a direction is not fixed: 100% of the value, or the width of the bounds."""

# Components of a unit vector below this do not count as taking part.
_TAKES_PART = 1e-4


class Direction(NamedTuple):
    """A joint change of parameters that the record does not fix.

    Attributes:
        weights: name -> component of the unit vector, largest first: relative changes, or shares of the bounds' width.
        deviation: standard deviation along it; +inf where nothing of it shows.
        structural: no record of this kind shows it, whatever its amplitude.
        remedy: what would fix it.

    """

    weights: dict[str, float]
    deviation: float
    structural: bool = False
    remedy: str = ""


class Combination(NamedTuple):
    """A product of powers (or a sum) of parameters that is fixed although they are not.

    Attributes:
        name: "flow_gain x feedback_gain".
        exponents: name -> power; of a sum, name -> factor.
        value: of the combination, SI.
        standard_error: likewise.

    """

    name: str
    exponents: dict[str, float]
    value: float
    standard_error: float

    @property
    def percent(self) -> float:
        """Standard error in per cent of the value."""
        return 100.0 * self.standard_error / abs(self.value)


class Spectrum(NamedTuple):
    """Singular directions of the parameters' sensitivities, what initial conditions could imitate taken out.

    Attributes:
        directions: `[parameter, direction]`, unit vectors in the parameters' own units.
        deviation: `[direction]` standard deviation along each, +inf where it is rounding.

    """

    directions: Float[np.ndarray, "parameter direction"]
    deviation: Float[np.ndarray, " direction"]

    @property
    def unfixed(self) -> Float[np.ndarray, "parameter direction"]:
        """The directions that are not fixed."""
        return self.directions[:, self.deviation > NOT_FIXED]

    def along(self, vector: Float[np.ndarray, " parameter"]) -> float:
        """Return the standard deviation along a unit vector."""
        parts = self.directions.T @ vector
        if np.any(np.abs(parts[~np.isfinite(self.deviation)]) > _TAKES_PART):
            return float("inf")
        return float(np.linalg.norm(parts[np.isfinite(self.deviation)] * self.deviation[np.isfinite(self.deviation)]))


def spectrum(root: Float[np.ndarray, "parameter parameter"]) -> Spectrum:
    """Return the singular directions of the free parameters from a root of their information."""
    values, vectors = np.linalg.svd(root)[1:]
    seen = values > ROUNDING * max(values[0], np.finfo(float).tiny)
    return Spectrum(vectors.T, np.where(seen, 1.0 / np.where(seen, values, 1.0), np.inf))


def of_covariance(white: Spectrum, covariance: Float[np.ndarray, "parameter parameter"]) -> Spectrum:
    """Return the directions of a covariance that is not the inverse of the information: noise was coloured.

    Where the sensitivities are rounding, nothing shows whatever the noise; the rest has the covariance's own axes.
    """
    shown = np.isfinite(white.deviation)
    basis = white.directions[:, shown]
    variances, axes = np.linalg.eigh(basis.T @ covariance @ basis)
    deviation = np.sqrt(np.maximum(variances, 0.0))
    return Spectrum(
        np.concatenate([basis @ axes, white.directions[:, ~shown]], axis=1),
        np.concatenate([deviation, white.deviation[~shown]]),
    )


def parameter_root(found: Sensitivities, noise_factor: float = 1.0) -> Float[np.ndarray, "parameter parameter"]:
    """Return R with R^T R the information of the free parameters, that of the initial conditions eliminated.

    In units of the problem's noise variance, of which the noise has so many times.
    """
    rows, count = found.rows_with_known(noise_factor), len(found.names)
    nuisance, parameters = rows[:, count:], rows[:, :count]
    size = np.linalg.norm(nuisance, axis=0)
    basis, triangle = np.linalg.qr(nuisance[:, size > 0] / size[size > 0])
    # Initial conditions that cannot be told apart span fewer dimensions than there are of them.
    basis = basis[:, np.abs(np.diagonal(triangle)) > ROUNDING]
    return np.asarray(np.linalg.qr(parameters - basis @ (basis.T @ parameters), mode="r"))


def named(names: Sequence[str], vector: Float[np.ndarray, " parameter"]) -> dict[str, float]:
    """Return the components that count, largest first, the sign such that the largest is positive."""
    order = _largest_first(vector)
    sign = np.sign(vector[order[0]])
    return {names[i]: float(sign * vector[i]) for i in order if abs(vector[i]) > _TAKES_PART * 10}


def _largest_first(vector: Float[np.ndarray, " parameter"]) -> Int[np.ndarray, " parameter"]:
    """Return the order of the components by size, of equal ones that in which they stand."""
    return np.argsort(-np.round(np.abs(vector), 6), kind="stable")


def taking_part(unfixed: Float[np.ndarray, "parameter direction"]) -> np.ndarray:
    """Return which parameters take part in directions that are not fixed, `[parameter]`."""
    return np.linalg.norm(unfixed, axis=1) > _TAKES_PART


def combinations(
    found: Sensitivities, fixed: Spectrum, not_fixed: Bool[np.ndarray, " parameter"]
) -> tuple[Combination, ...]:
    """Return what is fixed of each parameter that itself is `not_fixed`, but for as many as there are directions.

    The parameters left over are those by which the others are multiplied or divided, chosen so that the largest error
    of a combination is least. Relative changes combine as products of powers, others as sums.
    """
    unfixed = fixed.unfixed
    # One that has a standard error of its own needs no other.
    tied = np.flatnonzero(taking_part(unfixed) & not_fixed)
    count = unfixed.shape[1]
    if count == 0 or len(tied) <= count:
        return ()
    informed = fixed.deviation <= NOT_FIXED
    root = fixed.directions[:, informed] * fixed.deviation[informed]
    candidates = []
    for pivots in _choices(unfixed, tied):
        others = [i for i in tied if i not in pivots]
        weights = -np.linalg.lstsq(unfixed[pivots].T, unfixed[others].T, rcond=None)[0].T
        vectors = np.zeros((len(others), len(unfixed)))
        vectors[np.arange(len(others)), others] = 1.0
        vectors[:, pivots] = weights
        errors = np.linalg.norm(vectors @ root, axis=1)
        candidates.append((np.max(np.abs(weights)) > 10.0, float(np.max(errors)), vectors, errors))
    _, _, vectors, errors = min(candidates, key=lambda c: c[:2])
    return tuple(_combination(found, vector, error) for vector, error in zip(vectors, errors, strict=True))


def _choices(unfixed: Float[np.ndarray, "parameter direction"], tied: np.ndarray) -> list[list[int]]:
    """Return the sets of pivots to try: each parameter alone for one direction, otherwise those farthest apart."""
    if unfixed.shape[1] == 1:
        return [[int(i)] for i in tied]
    from scipy.linalg import qr

    order = qr(unfixed[tied].T, mode="r", pivoting=True)[1]
    return [[int(tied[i]) for i in order[: unfixed.shape[1]]]]


def _combination(found: Sensitivities, vector: np.ndarray, error: float) -> Combination:
    """Return the combination as a product of powers or as a sum, whichever has the plainer powers or factors.

    To first order both say the same; where neither is plainer it is a product of relative changes, otherwise a sum.
    """
    taking = [i for i in _largest_first(vector) if abs(vector[i]) > _TAKES_PART]
    names, first = [found.names[i] for i in taking], taking[0]
    values, scale, weights = found.values[taking], found.scale[taking], vector[taking]
    factors = dict(zip(names, (weights * scale[0] / scale / weights[0]).tolist(), strict=True))
    # Relative changes by which the combination changes as much.
    changes = weights * values / scale
    unit = 1.0 if found.relative[first] or changes[0] == 0.0 else 1.0 / changes[0]
    powers = {name: _rounded(unit * change) for name, change in zip(names, changes, strict=True)}
    defined = all(
        value > 0 or (value < 0 and powers[name].is_integer()) for name, value in zip(names, values, strict=True)
    )
    plainer = _denominators(factors) - _denominators(powers)
    if defined and (plainer > 0 or (plainer == 0 and found.relative[taking].all())):
        product = float(np.prod([value ** powers[name] for name, value in zip(names, values, strict=True)]))
        return Combination(_product(powers), powers, product, float(abs(product * unit) * error))
    # A sum, in the unit of the first.
    total = float(sum(factors[name] * value for name, value in zip(names, values, strict=True)))
    return Combination(_sum(factors), factors, total, float(scale[0] * error / abs(weights[0])))


def _denominators(numbers: dict[str, float]) -> int:
    """Return how far from plain numbers are: the sum of their denominators, those that are no simple fraction apart."""
    near = [Fraction(number).limit_denominator(4) for number in numbers.values()]
    plain = all(abs(float(f) - number) < 1e-3 for f, number in zip(near, numbers.values(), strict=True))
    return sum(f.denominator for f in near) if plain else 5 * len(near)


def _rounded(power: float) -> float:
    near = Fraction(power).limit_denominator(4)
    return float(near) if abs(float(near) - power) < 1e-3 else float(power)


def _product(powers: dict[str, float]) -> str:
    def term(name, power):
        return name if power == 1 else f"{name}^{power:.3g}"

    above = [term(name, power) for name, power in powers.items() if power > 0]
    below = [term(name, -power) for name, power in powers.items() if power < 0]
    return " x ".join(above) + "".join(f" / {name}" for name in below)


def _sum(factors: dict[str, float]) -> str:
    def term(name, factor):
        size = f"{abs(factor):.3g}"
        return f"{'+' if factor > 0 else '-'} {name if size == '1' else f'{size} {name}'}"

    return " ".join(term(name, factor) for name, factor in factors.items()).removeprefix("+ ")
