"""Effects on an input, as a whole before it is simulated, and on a sensor."""

import math

import jax.numpy as jnp
import numpy as np
from jax import lax

from ehsvjax.effects.effect import Effect, Scales, amplitude, constant, limit, off_by_error, relative_error, size, width
from ehsvjax.effects.forces import harmonic, harmonic_parameters
from ehsvjax.holds import at_nodes, following
from ehsvjax.holds import course as course_of

# Share by which what has been calibrated is usually off at most.
_CALIBRATED = 0.05


def _small(scales: Scales) -> float:
    return 1e-3 * scales["value"]


def _tenth_of_duration(scales: Scales) -> float:
    return 0.1 * scales["duration"]


def _half_sample(scales: Scales) -> float:
    return 0.5 * scales["sample_period"]


def _bent(share: float):
    """Return the coefficient that bends the largest reading by a share of itself."""
    return lambda scales: share / max(scales["value"], 1e-300) ** 2


def dead_zone(value, half_width):
    """Return what lies beyond +-half_width, less that."""
    return value - jnp.clip(value, -half_width, half_width)


def play(value, memory, half_width):
    """Return the output of a play (backlash, hysteresis) that stood at `memory`: it follows within +-half_width."""
    return jnp.minimum(jnp.maximum(memory, value - half_width), value + half_width)


def _gauss(count):
    """Return points of a period and their weights, by which integrals over it are exact to power 2 count - 1."""
    points, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 + 0.5 * points, 0.5 * weights


def _legendre(fraction):
    """Return the first three Legendre polynomials of a fraction of a period, `[..., order]`."""
    middle = 2.0 * fraction - 1.0
    return jnp.stack([jnp.ones_like(middle), middle, 1.5 * middle**2 - 0.5], axis=-1)


# Of a parabola with given moments by these polynomials, at its three nodes, `[order, node]`. To a plant that does not
# turn far within a period, what is no parabola acts like the one of the same moments: by the mean alone a delay that is
# short beside the period is wrong by half of what it does.
_AT_NODES = np.array([[1.0, 1.0, 1.0], [-3.0, 0.0, 3.0], [5.0, -2.5, 5.0]])


def _product(left, right):
    """Matrix product of small matrices, written out: no native function holds a call of a library (see kernels)."""
    return sum(left[:, k, None] * right[k][None].astype(left.dtype) for k in range(left.shape[1]))


def _delayed(own, course, context):
    """Delay by any time; before the record it was zero, and after it what it was at its end."""
    samples = own["delay"] / context["sample_period"]
    whole = jnp.floor(samples)
    part = samples - whole
    # Every period holds the end of one that came before and the beginning of the next.
    at = jnp.arange(-1, len(course)) - whole.astype(int)
    earlier = jnp.where(at[:, None] >= 0, course[jnp.clip(at, 0, len(course) - 1)], 0.0)
    points, weights = (jnp.asarray(each, course.dtype) for each in _gauss(3))

    def moved(nodes, begins, length, arrives):
        """Of a piece of a period, which begins at one fraction of that and arrives at one of the delayed."""
        f = begins + length * points
        by_node = jnp.stack([(2.0 * f - 1.0) * (f - 1.0), 4.0 * f * (1.0 - f), f * (2.0 * f - 1.0)])
        moments = _product((length * weights)[None] * by_node, _legendre(arrives + length * points))
        return _product(nodes, _product(moments, _AT_NODES))

    return moved(earlier[:-1], 1.0 - part, part, 0.0) + moved(earlier[1:], 0.0, 1.0 - part, part)


def _between_steps(own, course, context):
    """Run from value to value instead of in steps: for share 1 straight."""
    del context
    step = own["share"] * (following(course[:, 0]) - course[:, 0])
    return course + jnp.stack([0.0 * step, 0.5 * step, step], axis=-1)


def _smooth_between(own, course, context):
    """Keep to a band: for share 1 the smooth curve that the samples fix."""
    del context
    smooth = at_nodes(course_of(course[:, :1], None, "band-limited"))[..., 0]
    return course + own["share"] * (smooth - course)


def _lagged(own, course, context):
    """First-order lag of what is a straight line in every period; at rest before the record."""
    ratio = context["sample_period"] / jnp.maximum(own["time_constant"], 1e-6 * context["sample_period"])
    decay = jnp.exp(-ratio)
    # Moments of exp(-ratio * fraction) by parts; where differences would be lost in rounding, by quadrature.
    mean = -jnp.expm1(-ratio) / ratio
    first = (2.0 * mean - 1.0 - decay) / ratio
    by_parts = jnp.stack([mean, first, mean + 6.0 * first / ratio])
    points, weights = (jnp.asarray(each, course.dtype) for each in _gauss(5))
    by_points = _product((weights * jnp.exp(-jnp.minimum(ratio, 1.0) * points))[None], _legendre(points))[0]
    moments = _product(jnp.where(ratio < 1.0, by_points, by_parts)[None], _AT_NODES)[0]

    # What follows a straight line is that line, later by the time constant, but for what decays.
    start, middle, end = course.T
    slope = end - start
    line = (start + 4.0 * middle + end) / 6.0 - 0.5 * slope - slope / ratio

    def follow(level, here):
        line, slope = here
        return line + slope + (level - line) * decay, level - line

    off = lax.scan(follow, jnp.zeros((), course.dtype), (line, slope))[1]
    straight = jnp.stack([line, line + 0.5 * slope, line + slope], axis=-1)
    lagging = straight + off[:, None] * moments[None]
    return jnp.where(own["time_constant"] > 0.0, lagging, course)


def _play_along(own, course, context):
    del context

    def follow(level, nodes):
        levels = [level := play(target, level, own["half_width"]) for target in nodes]
        return level, jnp.stack(levels)

    return lax.scan(follow, jnp.zeros((), course.dtype), course)[1]


def _sensor_lag(own, value, context, memory):
    """Follow the value, which is a straight line between the steps; starts where the value is."""
    level, before = (jnp.where(jnp.isnan(m), value, m) for m in memory)
    time_constant = jnp.maximum(own["time_constant"], 1e-9)
    ratio = context["step_size"] / time_constant
    decay = jnp.exp(-ratio)
    # With the slope of the line, what lags behind it is slope * time constant.
    share = jnp.where(ratio > 1e-3, (1.0 - decay) / jnp.maximum(ratio, 1e-3), 1.0 - 0.5 * ratio)
    level = decay * level + (share - decay) * before + (1.0 - share) * value
    # Any lag shows what was before a value that jumps at this very moment, as an output does that depends on an input.
    level = jnp.where(own["time_constant"] > 0.0, level, value)
    return level, (level, value)


def follow_with_play(own, value, context, memory):
    """Apply a play of a `half_width`: backlash or hysteresis along the simulation."""
    del context
    level = play(value, memory[0], own["half_width"])
    return level, (level,)


# To another course between the samples, one for all of it.
_SHARE_OF_THE_WAY = amplitude("share", "", constant(1e-2), constant(-1.0), constant(2.0))

# In this order: an amplifier has its dead zone and its limit before anything lags behind it.
INPUT = (
    Effect(
        "input_gain",
        "input",
        (relative_error(usual=_CALIBRATED),),
        off_by_error,
        says="the input acts more or less than it says",
        settled_by="measure the input at the plant",
    ),
    Effect(
        "input_bias",
        "input",
        (amplitude("bias", "{value}", _small),),
        lambda own, u, context: u + own["bias"],
        says="the input is off by a constant",
        settled_by="measure the input at the plant, at rest",
    ),
    Effect(
        "transport_delay",
        "input",
        (amplitude("delay", "s", _half_sample, lambda scales: -_tenth_of_duration(scales), _tenth_of_duration),),
        _delayed,
        says="the input acts later than it was read, or earlier, where channels are not read at once",
        settled_by="a multisine of 5-40 Hz at two amplitudes: a delay turns the phase in proportion to frequency",
    ),
    Effect(
        "input_hold",
        "input",
        (_SHARE_OF_THE_WAY,),
        _between_steps,
        says="the input runs otherwise between samples than it is said to: by half a sample for a share of one",
        settled_by="declare how the input runs between samples (hold), or measure it at ten times the rate",
    ),
    Effect(
        "band_limited_input",
        "input",
        (_SHARE_OF_THE_WAY,),
        _smooth_between,
        says="the input is a smooth curve between samples, as behind a filter, and not what it is said to be",
        settled_by="declare the input's hold (band-limited), or measure it at ten times the rate",
    ),
    Effect(
        "input_dead_zone",
        "input",
        (width("half_width", "{value}", (0.01, 0.04, 0.12)),),
        lambda own, u, context: dead_zone(u, own["half_width"]),
        says="small inputs do nothing",
        settled_by="small inputs held for long, of both signs",
    ),
    Effect(
        "input_saturation",
        "input",
        (limit("limit", "{value}", (0.97, 0.9, 0.75, 0.55)),),
        lambda own, u, context: jnp.clip(u, -own["limit"], own["limit"]),
        says="large inputs are cut off",
        settled_by="a staircase of levels up to the largest input",
    ),
    Effect(
        "input_lag",
        "input",
        (size("time_constant", "s", _half_sample, _tenth_of_duration),),
        _lagged,
        says="a first-order lag before the plant",
        settled_by="a multisine of 5-40 Hz at two amplitudes: a lag attenuates, a delay does not",
    ),
    Effect(
        "input_hysteresis",
        "input",
        (width("half_width", "{value}", (0.005, 0.02, 0.06)),),
        _play_along,
        says="the input acts only once it has moved by more than a play",
        settled_by="small triangles at three rates and amplitudes",
    ),
)

# In this order: mounting and coupling come before the transducer, and its electronics lag before their range ends.
SENSOR = (
    Effect(
        "structural_flexibility",
        "sensor",
        (size("compliance", "{value}/N", lambda s: 1e-3 * s["value"] / max(s["load_force"], 1e-300)),),
        lambda own, y, context: y + own["compliance"] * context["load_force"],
        needs=("load_force",),
        says="the mounting gives way under the load force",
        settled_by="two loads at the same motion, or a sensor on the structure",
    ),
    Effect(
        "sensor_backlash",
        "sensor",
        (width("half_width", "{value}", (0.002, 0.01, 0.03)),),
        follow_with_play,
        memory=(0.0,),
        says="the sensor is coupled with play",
        settled_by="small triangles at three rates and amplitudes, with a gauge",
    ),
    Effect(
        "sensor_gain",
        "sensor",
        (relative_error(usual=_CALIBRATED),),
        off_by_error,
        says="the sensor shows more or less than there is",
        settled_by="an external gauge",
    ),
    Effect(
        "sensor_bias",
        "sensor",
        (amplitude("bias", "{value}", _small),),
        lambda own, y, context: y + own["bias"],
        says="the sensor is off by a constant",
        settled_by="a gauge of the true zero",
    ),
    Effect(
        "sensor_drift",
        "sensor",
        (amplitude("drift", "{value}", _small),),
        lambda own, y, context: y + own["drift"] * context["time"] / context["duration"],
        needs=("time",),
        says="the sensor's zero moves as time passes",
        settled_by="the same level at the beginning and at the end, by a gauge",
    ),
    Effect(
        "sensor_hum",
        "sensor",
        harmonic_parameters("{value}", _small, turn=math.pi),
        lambda own, y, context: y - harmonic(own, context),
        needs=("time",),
        says="a harmonic is added to what the sensor shows, as by the mains",
        settled_by="read the sensor while the machine stands still",
    ),
    Effect(
        "sensor_cubic",
        "sensor",
        (amplitude("coefficient", "1/({value})^2", _bent(1e-3), _bent(-1.0), _bent(1.0)),),
        lambda own, y, context: y + own["coefficient"] * y**3,
        says="the sensor is bent towards its ends",
        settled_by="an external gauge at several levels",
    ),
    Effect(
        "sensor_asymmetry",
        "sensor",
        (amplitude("error", "", constant(1e-3), constant(-2.0), constant(9.0)),),
        lambda own, y, context: y + own["error"] * jnp.minimum(y, 0.0),
        says="the sensor shows what is negative more or less than what is positive; at -2 as positive",
        settled_by="an external gauge on both sides of zero",
    ),
    Effect(
        "sensor_lag",
        "sensor",
        (size("time_constant", "s", _half_sample, _tenth_of_duration),),
        _sensor_lag,
        memory=(float("nan"), float("nan")),
        says="the sensor follows with a lag",
        settled_by="a multisine of 5-40 Hz, or a second, faster sensor",
    ),
    Effect(
        "sensor_saturation",
        "sensor",
        (limit("limit", "{value}", (0.98, 0.93, 0.85, 0.7, 0.5)),),
        lambda own, y, context: jnp.clip(y, -own["limit"], own["limit"]),
        says="the sensor ends before the motion does",
        settled_by="move to the end by hand, with a gauge",
    ),
)
