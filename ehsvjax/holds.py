"""What inputs do between samples: they stay, run straight to the next value, or keep to a band.

A band-limited input is the smooth curve that its samples fix. In every period it is the polynomial of fifth order that
has the curve's value, slope and curvature at both ends; slopes and curvatures are sums over neighbouring samples. Up to
0.65 of half the sample rate that is right to 0.2 % of the amplitude between the samples, up to 0.8 to 0.5 %; a straight
line is off by 53 and 79 %.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

HOLDS = ("zero", "linear", "band-limited")
"""From the least to the most that has to be known of an input between its samples."""
WORDS = {"zero": "zero-order hold", "linear": "linear hold", "band-limited": "band-limited hold"}

# Neighbours on each side that a slope is taken from, and the share of half the sample rate up to which it is right.
_NEIGHBOURS, _BAND = 16, 0.8


def course(inputs: Float[Array, "time input"], holds: Float[Array, " input"] | None, most: str) -> tuple[Array, ...]:
    """Return what `between` needs of each period: coefficients `[time, input]` of a polynomial.

    Args:
        inputs: their values at the samples.
        holds: of each input its place in HOLDS; None: all as `most` says.
        most: the last of HOLDS that any input has; static.

    """
    if most == "zero":
        return (inputs,)
    following = jnp.concatenate([inputs[1:], inputs[-1:]])
    following = following if holds is None else jnp.where(holds > 0.0, following, inputs)
    if most == "linear":
        return inputs, following
    step = following - inputs
    smooth = jnp.ones(inputs.shape[1], bool) if holds is None else holds > 1.0
    # Straight lines and constants are such polynomials too.
    first, *higher = _quintic(inputs)
    return inputs, jnp.where(smooth, first, step), *(jnp.where(smooth, c, 0.0) for c in higher)


def between(course: tuple[Any, ...], fraction: Any) -> Any:
    """Return the inputs at a fraction of a period, from what `course` says of it."""
    if len(course) == 2:
        now, then = course
        return now + fraction * (then - now)
    value = course[-1]
    for coefficient in course[-2::-1]:
        value = coefficient + fraction * value
    return value


def interpolated(values: Float[np.ndarray, " time"], place: Float[np.ndarray, " place"]) -> Float[np.ndarray, " place"]:
    """Return a band-limited input at places that are counted in samples."""
    start = np.minimum(np.floor(place).astype(int), len(values) - 1)
    with jax.enable_x64(True):
        periods = course(jnp.asarray(values)[:, None], None, "band-limited")
    return np.asarray(between(tuple(np.asarray(c)[start, 0] for c in periods), place - start))


def continued(inputs: Float[np.ndarray, "time input"], count: int) -> Float[np.ndarray, "longer input"]:
    """Return so many samples of inputs: beyond their end mirrored, as far as slopes reach, then constant."""
    mirrored = min(_NEIGHBOURS, len(inputs) - 1, count - len(inputs))
    inputs = np.pad(inputs, ((0, mirrored), (0, 0)), "reflect", reflect_type="odd")
    return np.pad(inputs, ((0, count - len(inputs)), (0, 0)), "edge")


def _quintic(inputs: Array) -> tuple[Array, ...]:
    """Return coefficients of the first to the fifth power of the fraction, `[time, input]` each (Hermite's)."""
    slope, curvature = _derivatives(inputs)

    def following(series):
        return jnp.concatenate([series[1:], series[-1:]])

    step, next_slope, next_curvature = following(inputs) - inputs, following(slope), following(curvature)
    return (
        slope,
        0.5 * curvature,
        10.0 * step - 6.0 * slope - 4.0 * next_slope - 1.5 * curvature + 0.5 * next_curvature,
        -15.0 * step + 8.0 * slope + 7.0 * next_slope + 1.5 * curvature - next_curvature,
        6.0 * step - 3.0 * slope - 3.0 * next_slope - 0.5 * curvature + 0.5 * next_curvature,
    )


def _derivatives(inputs: Array) -> tuple[Array, Array]:
    """Return slopes and curvatures at the samples, per period and its square; beyond the ends inputs are mirrored."""
    count = len(inputs)
    reach = min(_NEIGHBOURS, count - 1)
    before, after = 2.0 * inputs[:1] - inputs[reach:0:-1], 2.0 * inputs[-1:] - inputs[-2 : -reach - 2 : -1]
    extended = jnp.concatenate([before, inputs, after])
    slope = curvature = jnp.zeros_like(inputs)
    for m, (odd, even) in enumerate(zip(*_weights(reach), strict=True), 1):
        left, right = extended[reach - m : reach - m + count], extended[reach + m : reach + m + count]
        slope = slope + odd * (right - left)
        curvature = curvature + even * (left + right - 2.0 * inputs)
    return slope, curvature


@functools.cache
def _weights(reach: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return weights of neighbours in a slope and a curvature: least squares over the band, exact for parabolas."""
    frequency = np.pi * _BAND * (np.arange(400) + 0.5) / 400  # rad per sample
    neighbours = np.arange(1, reach + 1)
    phase = np.outer(frequency, neighbours)
    odd = np.linalg.lstsq(2.0 * np.sin(phase), frequency, rcond=None)[0]
    even = np.linalg.lstsq(2.0 * (np.cos(phase) - 1.0), -(frequency**2), rcond=None)[0]
    return tuple((odd / (2.0 * odd @ neighbours)).tolist()), tuple((even / (even @ neighbours**2)).tolist())
