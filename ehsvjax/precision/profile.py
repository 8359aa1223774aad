"""Profile likelihood: how the best cost rises as one parameter is held away from its estimate, all refits in one batch.

Unlike a standard error the interval follows a cost that is no parabola, and it ends at a bound where it reaches one.
"""

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ehsvjax import kernels
from ehsvjax.population import Problem, cast, to_unit, to_values
from ehsvjax.precision.standard_errors import quantile_of
from ehsvjax.refine import refine

if TYPE_CHECKING:
    import matplotlib.figure

# Standard errors at which the parameter is held, on either side; farther in the next round where that is too near.
_DISTANCES = np.array([0.7, 1.4, 2.1, 2.8])
_ROUNDS = 4


class Profile(NamedTuple):
    """The profile of one parameter.

    Attributes:
        values: `[point]` at which it was held, ascending, the estimate among them, SI.
        signed_root: `[point]` the root of the rise of the cost, in noise variances, negative below the estimate: a
            straight line through zero where the cost is a parabola (Venables & Ripley's profile t).
        interval: (lower, upper), SI.
        at_bound: whether each end is where the parameter's bounds end, and not where the cost says so.

    """

    values: Float[np.ndarray, " point"]
    signed_root: Float[np.ndarray, " point"]
    interval: tuple[float, float]
    at_bound: tuple[bool, bool]


class ProfileLikelihood(NamedTuple):
    """Profiles by name of the parameter.

    Attributes:
        profiles: name -> profile.
        estimates: name -> value of the fit, SI.
        standard_errors: name -> by the curvature at the fit, SI; +inf where it has none.
        level: of the intervals.
        better: noise variances by which some refit costs less than the fit itself: 0 where the fit is the minimum.
        units: name -> unit.

    """

    profiles: dict[str, Profile]
    estimates: dict[str, float]
    standard_errors: dict[str, float]
    level: float
    better: float
    units: dict[str, str]

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """Name -> (lower, upper), SI."""
        return {name: profile.interval for name, profile in self.profiles.items()}

    def plot(self) -> "matplotlib.figure.Figure":
        """Draw every profile with its interval, and what the standard error says; returns the matplotlib figure."""
        from ehsvjax.plots import plot_profiles

        return plot_profiles(self)

    def __str__(self) -> str:
        """Return a line for each parameter."""
        lines = [f"[[Profile likelihood, {100 * self.level:g}% intervals]]"]
        width = max(map(len, self.profiles))
        for name, (_, _, (lower, upper), bound) in self.profiles.items():
            estimate = self.estimates[name]
            ends = [f"{lower:.6g}" + bound[0] * " (its bound)", f"{upper:.6g}" + bound[1] * " (its bound)"]
            lines.append(f"    {name:<{width}}  {estimate:.6g}  {' .. '.join(ends)}  {self.units[name]}".rstrip())
        if self.better > 0.1:
            lines.append(
                f"    a refit costs {self.better:.2g} noise variances less than the fit: identify again with a larger "
                "population"
            )
        return "\n".join(lines)


def profile_likelihood(
    problem: Problem,
    values: Float[np.ndarray, " parameter"],
    covariance: Float[np.ndarray, "parameter parameter"],
    seen: Bool[np.ndarray, " parameter"],
    *,
    names: Sequence[str],
    level: float,
    noise_factors: dict[str, float],
    units: dict[str, str],
    together: int,
) -> ProfileLikelihood:
    """Profile parameters about the best fit.

    Args:
        problem: in NumPy float64.
        values: of every unknown at the minimum, SI.
        covariance: of the unknowns there, SI, from which each refit starts and by which the distances are chosen.
        seen: whether that says anything about an unknown; if not, the parameter is held all over its bounds.
        names: of the parameters to profile.
        level: of the intervals.
        noise_factors: name -> variance of the residuals in the problem's noise variances, as it counts for that
            parameter (more where the noise is coloured).
        units: name -> unit, for the print.
        together: how many refits go side by side; as many as `identify` refined need not be compiled again.

    """
    quantile = quantile_of(level)
    best = to_unit(problem.coordinates, values)
    least = np.nan
    held: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
    distances = _DISTANCES * quantile / 1.96
    for _ in range(_ROUNDS):
        starts, masks = _starts(problem, values, best, covariance, seen, names, distances)
        with kernels.double_precision():
            costs = _refitted(cast(problem, jnp.float64), starts, masks, together)
        # The first start is the fit itself, nothing held.
        least = float(costs[0]) if np.isnan(least) else least
        for i, name in enumerate(names):
            place = problem.free.index(name)
            part = slice(1 + 2 * len(distances) * i, 1 + 2 * len(distances) * (i + 1))
            held[name] += list(zip(starts[part, place], costs[part], strict=True))
        found = {
            name: _profile(problem, best, problem.free.index(name), held[name], least, noise_factors[name], quantile)
            for name in names
        }
        if all(profile is not None for profile in found.values()):
            break
        distances = distances * 3.0
    profiles = {
        name: profile or _profile(problem, best, problem.free.index(name), held[name], least, noise_factors[name],
                                  quantile, last=True)
        for name, profile in found.items()
    }  # fmt: skip
    every = np.array([cost for points in held.values() for _, cost in points])
    if not np.isfinite(every).all():
        words = (
            f"{np.sum(~np.isfinite(every))} of {len(every)} refits could not be simulated, and count as infinitely bad"
        )
        warnings.warn(words, RuntimeWarning, stacklevel=4)
    lowest = np.min(every)
    better = max(0.0, (least - lowest) / min(noise_factors.values()))
    places = {name: problem.free.index(name) for name in names}
    return ProfileLikelihood(
        profiles,
        estimates={name: float(values[i]) for name, i in places.items()},
        standard_errors={name: float(np.sqrt(covariance[i, i])) if seen[i] else np.inf for name, i in places.items()},
        level=level,
        better=better,
        units=units,
    )


def _refitted(problem: Problem, starts, masks, together: int) -> Float[np.ndarray, " individual"]:
    """Return the least cost from every start with its coordinate held, some starts side by side."""
    filling = -len(starts) % together
    starts, masks = (np.concatenate([rows, rows[:1].repeat(filling, axis=0)]) for rows in (starts, masks))
    costs = [
        refine(problem, jnp.asarray(starts[i : i + together]), held=jnp.asarray(masks[i : i + together])).cost
        for i in range(0, len(starts), together)
    ]
    return np.concatenate(costs)[: len(starts) - filling]


def _starts(problem: Problem, values, best, covariance, seen, names, distances):
    """Return where the refits start, `[individual, parameter]` in the unit cube, and which coordinate each holds.

    The other unknowns go along as far as they are correlated with the one that is held.
    """
    lower, upper = problem.coordinates.lower, problem.coordinates.upper
    starts, masks = [best], [np.zeros(len(best), bool)]
    for name in names:
        place = problem.free.index(name)
        deviation = np.sqrt(covariance[place, place])
        for distance in np.concatenate([-distances[::-1], distances]):
            if seen[place] and deviation > 0:
                along = covariance[:, place] / deviation * distance
                moved = np.where(seen, values + np.nan_to_num(along), values)
                start = to_unit(problem.coordinates, np.clip(moved, lower, upper))
            else:
                start = best.copy()
                start[place] += distance / distances[-1]
            starts.append(np.clip(start, 0.0, 1.0))
            masks.append(np.arange(len(best)) == place)
    return np.array(starts), np.array(masks)


def _profile(problem, best, place: int, points, least: float, factor: float, quantile: float, last: bool = False):
    """Return the profile, None as long as an end is neither found nor at a bound and there are rounds left."""
    unit, cost = np.array([(best[place], least), *points]).T
    order = np.argsort(unit, kind="stable")
    unit, cost = unit[order], cost[order]
    unit, first = np.unique(unit, return_index=True)
    rise = np.maximum(cost[first] - least, 0.0) / factor
    root = np.sign(unit - best[place]) * np.sqrt(rise)
    ends, at_bound = [], []
    for side in (-1.0, 1.0):
        mine = side * (unit - best[place]) >= 0
        distance, height = np.abs(unit[mine] - best[place]), np.abs(root[mine])
        inwards = np.argsort(distance)
        distance, height = distance[inwards], height[inwards]
        beyond = np.flatnonzero(height >= quantile)
        if len(beyond):
            k = beyond[0]
            # Where no refit could be simulated, the end is no nearer than that.
            share = (quantile - height[k - 1]) / (height[k] - height[k - 1]) if np.isfinite(height[k]) else 1.0
            end = distance[k - 1] + share * (distance[k] - distance[k - 1])
            ends.append(best[place] + side * end)
            at_bound.append(False)
        elif last or distance[-1] >= (best[place] if side < 0 else 1.0 - best[place]) - 1e-9:
            ends.append(0.0 if side < 0 else 1.0)
            at_bound.append(True)
        else:
            return None
    whole = np.tile(best, (len(unit) + 2, 1))
    whole[:, place] = [*unit, *ends]
    values = to_values(problem.coordinates, whole)[:, place]
    return Profile(values[:-2], root, (float(values[-2]), float(values[-1])), (at_bound[0], at_bound[1]))
