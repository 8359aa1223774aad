"""Sensitivities: how each output moves with each unknown, by forward differentiation in float64."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ehsvjax.population import Coordinates, Problem, cast, simulated

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

    """

    names: tuple[str, ...]
    values: Float[np.ndarray, " parameter"]
    scale: Float[np.ndarray, " parameter"]
    relative: Bool[np.ndarray, " parameter"]
    simulated: Float[np.ndarray, "record time signal"]
    jacobian: Float[np.ndarray, "record time signal parameter"]
    measured: Bool[np.ndarray, "record time signal"]

    @property
    def rows(self) -> Float[np.ndarray, "sample parameter"]:
        """The jacobian's rows of measured samples."""
        return self.jacobian[self.measured]


def sensitivities(problem: Problem, values: Float[np.ndarray, " parameter"]) -> Sensitivities:
    """Return the sensitivities at values of the unknowns, SI; the problem's arrays are NumPy's."""
    lower, upper = problem.coordinates.lower, problem.coordinates.upper
    width = upper - lower
    in_widths = Coordinates(np.zeros_like(width), width, np.zeros(len(width), bool))
    with jax.enable_x64(True):
        y, jacobian = _simulated_and_jacobian(
            cast(replace(problem, coordinates=in_widths), jnp.float64), jnp.asarray(values / width)
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
    )


@jax.jit
def _simulated_and_jacobian(problem: Problem, point):
    def twice(point):
        y = simulated(problem, point)
        return y, y

    jacobian, y = jax.jacfwd(twice, has_aux=True)(point)
    return y, jacobian
