"""A family of commands, each a point of the unit cube: what a search for the best experiment can choose from."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ehsvjax import kernels

KINDS = ("held levels", "two levels", "staircase", "triangles", "multisine", "steps with rest")
OWN = "your own signal"
_LEVELS = 12
GENES = 5 + _LEVELS
"""Coordinates of a command: its kind, amplitude, offset, time scale, another number of its kind, and levels."""
# Of the longest hold in the record's length, and of the shortest in samples.
_LONGEST, _SHORTEST = 0.25, 4.0
# Of the amplitude, in half of the limits' range.
_LEAST = 0.02
_LINES = 16
_STEPS = 12
# The levels of a longer sequence follow by this share of the range, which meets no level twice (Weyl 1916).
_GOLDEN = 0.6180339887498949


class Reach(NamedTuple):
    """What an input can do.

    Attributes:
        lower, upper: its limits.
        rate: the most that it changes by in a second; +inf where that has no limit.
        own: `[time]` a signal of the user's; None where there is none.

    """

    lower: Any
    upper: Any
    rate: Any
    own: Any = None

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of commands there are."""
        return KINDS if self.own is None else (*KINDS, OWN)


def command(genes: Float[Array, " gene"], time: Float[Array, " time"], reach: Reach) -> Float[Array, " time"]:
    """Return the command of one point of the unit cube; it keeps within what the input can do.

    Args:
        genes: in the unit cube.
        time: from zero, s.
        reach: of the input, in its unit.

    """
    amplitude, centre, hold = _size(genes, time, reach)
    own = [] if reach.own is None else [_from_minus_one_to_one(reach.own)]
    forms = jnp.stack([form(genes, time, hold) for form in _FORMS] + own)
    wanted = centre + amplitude * forms[kind_of(genes, reach)]
    return jnp.where(jnp.isinf(reach.rate), wanted, _no_faster(wanted, time, reach))


def kind_of(genes, reach: Reach):
    """Return the place in `reach.kinds` of a point of the unit cube."""
    count = len(reach.kinds)
    return jnp.minimum((genes[0] * count).astype(jnp.int32), count - 1)


def _no_faster(wanted, time, reach):
    """Follow a signal at no more than the greatest rate, from rest: from zero, or what is nearest to it."""
    most = jnp.minimum(reach.rate * (time[1] - time[0]), reach.upper - reach.lower)

    def step(now, target):
        now = now + jnp.clip(target - now, -most, most)
        return now, now

    rest = jnp.clip(jnp.zeros_like(wanted[0]), reach.lower, reach.upper)
    return lax.scan(step, rest, wanted)[1]


def _size(genes, time, reach):
    """Return amplitude, centre and hold time."""
    half = 0.5 * (reach.upper - reach.lower)
    amplitude = half * (_LEAST + (1.0 - _LEAST) * genes[1])
    centre = reach.lower + half + (2.0 * genes[2] - 1.0) * (half - amplitude)
    shortest, longest = _SHORTEST * (time[1] - time[0]), _LONGEST * time[-1]
    return amplitude, centre, shortest * (longest / shortest) ** genes[3]


def _sequence(genes, time, hold):
    """Return the level of each moment, from 0 to 1, and how many levels have been held before."""
    count = jnp.floor(time / hold + 1e-4).astype(jnp.int32)
    return (genes[5:][count % _LEVELS] + _GOLDEN * (count // _LEVELS)) % 1.0, count


def _held_levels(genes, time, hold):
    return 2.0 * _sequence(genes, time, hold)[0] - 1.0


def _two_levels(genes, time, hold):
    return jnp.where(_sequence(genes, time, hold)[0] < 0.5, -1.0, 1.0)


def _steps(genes):
    return 2.0 + jnp.floor(genes[4] * (_STEPS - 1))


def _staircase(genes, time, hold):
    """From the middle up, down and up again in equal steps."""
    count = jnp.floor(time / hold + 1e-4)
    return _triangle(count / (4.0 * _steps(genes)))


def _triangle(turns):
    """Return a triangle wave from 0 up to 1, down to -1 and back in one turn."""
    return 1.0 - jnp.abs((4.0 * turns - 1.0) % 4.0 - 2.0)


def _triangles(genes, time, hold):
    """Grow from a share of the amplitude to all of it."""
    first = genes[4]
    return _triangle(time / (4.0 * hold)) * (first + (1.0 - first) * time / time[-1])


def _multisine(genes, time, hold):
    """Lines from one period in the record up to half the rate of the holds, with Schroeder's phases."""
    line = jnp.arange(1, _LINES + 1)
    highest = 0.5 / hold
    lowest = jnp.minimum(1.0 / time[-1], highest)
    frequency = lowest + (highest - lowest) * (line - 1) / (_LINES - 1)
    phase = -jnp.pi * line * (line - 1) / _LINES
    total = jnp.sum(jnp.cos(2.0 * jnp.pi * jnp.outer(frequency, time) + phase[:, None]), axis=0)
    return total / jnp.max(jnp.abs(total))


def _steps_with_rest(genes, time, hold):
    """Up, rest, down, rest, each as long as a hold, of sizes that grow in a few steps and begin again."""
    count = jnp.floor(time / hold + 1e-4)
    size = (jnp.floor(count / 4.0) % _steps(genes) + 1.0) / _steps(genes)
    return size * jnp.array([1.0, 0.0, -1.0, 0.0])[(count % 4).astype(jnp.int32)]


def _from_minus_one_to_one(own):
    """Shift and scale a signal; one that stands still is in the middle."""
    lowest, highest = jnp.min(own), jnp.max(own)
    return (2.0 * own - lowest - highest) / jnp.where(highest > lowest, highest - lowest, 1.0)


_FORMS = (_held_levels, _two_levels, _staircase, _triangles, _multisine, _steps_with_rest)


def realised(genes: Float[np.ndarray, " gene"], time, reach: Reach) -> Float[np.ndarray, " time"]:
    """Return the command in float64, as a rig is given it."""
    with kernels.double_precision():
        return np.asarray(_command(*jax.tree.map(jnp.float64, (genes, time, reach))))


_command = kernels.jit(command)


def of_own_size(reach: Reach) -> tuple[float, float]:
    """Return the genes of amplitude and offset by which a signal of the user's own is as it was, if that can be."""
    values = np.asarray(reach.own)
    half, middle = 0.5 * (reach.upper - reach.lower), 0.5 * (reach.upper + reach.lower)
    amplitude = np.clip(0.5 * np.ptp(values) / half, _LEAST, 1.0)
    room = half * (1.0 - amplitude)
    offset = (0.5 * (values.max() + values.min()) - middle) / room if room > 0.0 else 0.0
    return float((amplitude - _LEAST) / (1.0 - _LEAST)), float(np.clip(0.5 + 0.5 * offset, 0.0, 1.0))


def described(genes: Float[np.ndarray, " gene"], time, reach: Reach, quantity) -> str:
    """Return a command in words a technician follows; `quantity` writes a value of the command with its unit."""
    amplitude, centre, hold = (float(x) for x in _size(genes, time, reach))
    kind, steps = reach.kinds[int(kind_of(jnp.asarray(genes), reach))], int(2.0 + np.floor(genes[4] * (_STEPS - 1)))
    about = f" about {quantity(centre)}" if abs(centre) > 0.01 * amplitude else ""
    size = f"of up to {quantity(amplitude)}{about}"
    words = {
        "held levels": f"held levels {size}, a new one every {hold:.3g} s",
        "two levels": f"two levels {size}, a new draw every {hold:.3g} s",
        "staircase": f"a staircase {size}, up and down in {steps} steps from the middle, each held for {hold:.3g} s",
        "triangles": f"triangles {size} of {4.0 * hold:.3g} s each, growing from {100 * float(genes[4]):.0f}%",
        "multisine": f"a multisine {size}, up to {0.5 / hold:.3g} Hz",
        "steps with rest": f"steps {size} of both signs in {steps} sizes, each for {hold:.3g} s and as long a rest",
        OWN: f"{OWN} {size}",
    }[kind]
    return words if np.isinf(reach.rate) else f"{words}, no faster than {quantity(float(reach.rate))} a second"
