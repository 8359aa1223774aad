"""What inputs do between samples: they stay, run straight to the next value, or keep to a band.

A band-limited input is the smooth curve that its samples fix. In every period it is the polynomial of fifth order that
has the curve's value, slope and curvature at both ends; slopes and curvatures are sums over neighbouring samples. Up to
0.65 of half the sample rate that is right to 0.2 % of the amplitude between the samples, up to 0.8 to 0.5 %; a straight
line is off by 53 and 79 %.
"""

import functools
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ehsvjax import kernels

HOLDS = ("zero", "linear", "band-limited")
"""From the least to the most that has to be known of an input between its samples."""
WORDS = {"zero": "zero-order hold", "linear": "linear hold", "band-limited": "band-limited hold"}

# Neighbours on each side that a slope is taken from, and the share of half the sample rate up to which it is right.
_NEIGHBOURS, _BAND = 16, 0.8


def course(inputs: Float[Array, "time input"], holds: Float[Array, " input"] | None, most: str) -> tuple[Array, ...]:
    """Return what `between` needs of each period: coefficients `[time, input]` of a polynomial, the constant first.

    Args:
        inputs: their values at the samples.
        holds: of each input its place in HOLDS; None: all as `most` says.
        most: the last of HOLDS that any input has; static.

    """
    if most == "zero":
        return (inputs,)
    step = following(inputs) - inputs
    if most == "linear":
        return inputs, step if holds is None else jnp.where(holds > 0.0, step, 0.0)
    if holds is None:
        return inputs, *_quintic(inputs)
    # Straight lines and constants are such polynomials too.
    first, *higher = _quintic(inputs)
    first = jnp.where(holds > 1.0, first, jnp.where(holds > 0.0, step, 0.0))
    return inputs, first, *(jnp.where(holds > 1.0, c, 0.0) for c in higher)


def between(course: tuple[Any, ...], fraction: Any) -> Any:
    """Return the inputs at a fraction of a period, from what `course` says of it."""
    value = course[-1]
    for coefficient in course[-2::-1]:
        value = coefficient + fraction * value
    return value


def at_nodes(course: tuple[Array, ...]) -> Float[Array, "time node input"]:
    """Return the inputs at the start, in the middle and at the end of every period."""
    return jnp.stack([between(course, fraction) for fraction in (0.0, 0.5, 1.0)], axis=1)


def through_nodes(nodes: Float[Array, "time node"], hold: Float[Array, ""] | None, most: str) -> tuple[Array, ...]:
    """Return the course `[time]` of one input that was changed at the nodes: parabolas, unless it keeps to a band.

    Args:
        nodes: as of `at_nodes`; the end of a period may be another value than the start of the next.
        hold: its place in HOLDS; None: as `most` says.
        most: the last of HOLDS that any input has; static.

    """
    start, middle, end = nodes.T
    parabola = start, 4.0 * middle - 3.0 * start - end, 2.0 * (start + end) - 4.0 * middle
    if most != "band-limited":
        return parabola
    # Where one period ends and the next begins is a sample of the smooth curve.
    samples = jnp.concatenate([start[:1], 0.5 * (end[:-1] + start[1:])])
    smooth = tuple(c[:, 0] for c in course(samples[:, None], None, most))
    if hold is None:
        return smooth
    bent = (*parabola, *[jnp.zeros_like(start)] * (len(smooth) - len(parabola)))
    return tuple(jnp.where(hold > 1.0, c, p) for c, p in zip(smooth, bent, strict=True))


def following(series: Array) -> Array:
    """Return a series `[time, ...]` one sample ahead; after its end it stays."""
    return jnp.concatenate([series[1:], series[-1:]])


def interpolated(values: Float[np.ndarray, " time"], place: Float[np.ndarray, " place"]) -> Float[np.ndarray, " place"]:
    """Return a band-limited input at places that are counted in samples."""
    start = np.minimum(np.floor(place).astype(int), len(values) - 1)
    with kernels.double_precision():
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
