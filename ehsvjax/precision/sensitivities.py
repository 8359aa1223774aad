"""Sensitivities: how each output moves with each unknown, by forward differentiation in float64."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ehsvjax import kernels
from ehsvjax.population import Problem, cast, in_units, simulated

ROUNDING = 1e-8
"""Singular values of sensitivities below this share of the largest are rounding in float64."""


class Sensitivities(NamedTuple):
    """The model linearised about one point, every unknown in a unit of its own.

    That unit is the value itself for a parameter whose bounds are of one sign, so that its column is by the relative
    change; for the others, initial conditions among them, it is the width of the bounds.

    Attributes:
        names: of the free parameters; their columns come first, those of the initial conditions follow.
        values: `[parameter]` of every unknown, SI.
        scale: `[parameter]` its unit, SI.
        relative: `[parameter]` whether that is the value itself.
        simulated: `[record, time, signal]`, SI.
        jacobian: `[record, time, signal, parameter]` by the unknowns in their units, over the noise's deviation.
        measured: `[record, time, signal]` where there is a sample.
        known: `[parameter]` each unknown's unit over the standard deviation with which it is known beforehand; 0 where
            it is not.

    """

    names: tuple[str, ...]
    values: Float[np.ndarray, " parameter"]
    scale: Float[np.ndarray, " parameter"]
    relative: Bool[np.ndarray, " parameter"]
    simulated: Float[np.ndarray, "record time signal"]
    jacobian: Float[np.ndarray, "record time signal parameter"]
    measured: Bool[np.ndarray, "record time signal"]
    known: Float[np.ndarray, " parameter"]

    def rows_with_known(self, noise_factor: float = 1.0) -> Float[np.ndarray, "sample parameter"]:
        """`rows`, and one for what is known of each unknown beforehand, in noise of so many times the variance."""
        return np.concatenate([self.rows, noise_factor**0.5 * np.diag(self.known)[self.known > 0.0]])

    @property
    def rows(self) -> Float[np.ndarray, "sample parameter"]:
        """The jacobian's rows of measured samples."""
        return self.jacobian[self.measured]

    @property
    def finite(self) -> Bool[np.ndarray, "record time signal"]:
        """Where the outputs and all of their derivatives are finite."""
        return np.isfinite(self.simulated) & np.isfinite(self.jacobian).all(axis=-1)


def sensitivities(problem: Problem, values: Float[np.ndarray, " parameter"]) -> Sensitivities:
    """Return the sensitivities at values of the unknowns, SI; the problem's arrays are NumPy's."""
    lower, upper = problem.coordinates.lower, problem.coordinates.upper
    width = upper - lower
    with kernels.double_precision():
        y, jacobian = _simulated_and_jacobian(
            cast(replace(problem, coordinates=in_units(width)), jnp.float64), jnp.asarray(values / width)
        )
    is_parameter = np.arange(len(width)) < len(problem.free)
    relative = is_parameter & ((lower > 0) | (upper < 0)) & (values != 0)
    scale = np.where(relative, np.abs(values), width)
    deviation = np.sqrt(problem.noise_variance)[:, None]
    return Sensitivities(
        names=problem.free,
        values=np.asarray(values),
        scale=scale,
        relative=relative,
        simulated=np.asarray(y),
        jacobian=np.asarray(jacobian) * (scale / width) / deviation,
        measured=np.asarray(problem.samples.measured),
        known=np.zeros(len(width)) if problem.priors is None else scale / problem.priors.deviation,
    )


def check_finite(problem: Problem, found: Sensitivities) -> None:
    """Refuse what cannot be linearised where something was measured.

    Raises:
        ValueError: naming the output, the sample, and the unknown by which it has no finite derivative.

    """
    if np.isfinite(found.rows).all():
        return
    row = np.argwhere(found.measured & ~found.finite)[0]
    record, sample, signal = (int(i) for i in row)
    output, after = problem.observed[signal], sample * float(problem.samples.sample_period[record])
    where = f"at sample {sample} of record {record}, {after:.6g} s after its start"
    if not np.isfinite(found.simulated[tuple(row)]):
        raise ValueError(
            f"expected a simulation that stays finite, got none of {output} {where}: mind units, initial conditions "
            "and max_step"
        )
    names = [*problem.free, *problem.free_initial * len(problem.samples.inputs)]
    unknown = names[int(np.argmin(np.isfinite(found.jacobian[tuple(row)])))]
    raise ValueError(
        f"expected {output} to have a finite derivative by {unknown}, got none {where}: in the model's equations keep "
        "both branches of jnp.where finite, and roots and logarithms off zero"
    )


@kernels.jit
def _simulated_and_jacobian(problem: Problem, point):
    def twice(point):
        y = simulated(problem, point)
        return y, y

    jacobian, y = jax.jacfwd(twice, has_aux=True)(point)
    return y, jacobian
