"""Friction that gives like a spring before it slides, or a spring with hysteresis."""

from collections.abc import Callable

import jax.numpy as jnp

from ehsvjax.effects.effect import Effect, Scales, constant, shape, size


def elastic_friction(stiffness: Callable[[Scales], float]) -> Effect:
    """Return the effect on a force, with a small stiffness to try, from the scales.

    Of Bouc (1967, "Forced vibration of mechanical systems with hysteresis") and Wen (1976) with exponent one, which is
    the friction of Dahl (1968, "A solid friction model") where the spring does not soften. What is stretched by u moves
    by dx: du = dx - (|dx| u + softening dx |u|) / length.
    """
    return Effect(
        "elastic_friction",
        "force",
        (
            size("stiffness", "{value}/{length}", stiffness),
            shape(
                "length",
                "{length}",
                lambda scales: [share * scales["position"] for share in (0.03, 0.2, 1.0)],
                lambda scales: 0.01 * scales["position"],
                lambda scales: 10.0 * scales["position"],
            ),
            shape("softening", "", lambda scales: (0.0,), constant(-2.0), constant(1.0)),
        ),
        _drive,
        needs=("position", "velocity"),
        memory=(0.0, float("nan"), float("nan")),
        says="friction that gives like a spring before it slides: hysteresis",
        settled_by="slow motion to and fro, at two amplitudes",
    )


def _drive(own, value, context, memory):
    stretch, position, velocity = memory
    way = jnp.where(jnp.isnan(position), 0.0, context["position"] - position)
    # Where the motion has turned since, it went further: as far as it does under a steady acceleration.
    turned = velocity * context["velocity"] < 0.0
    change = jnp.where(turned, velocity - context["velocity"], 1.0)
    further = jnp.where(turned, 0.5 * context["step_size"] * velocity**2 / change, 0.0)
    stretch = _stretched(_stretched(stretch, further, own), way - further, own)
    return value - own["stiffness"] * stretch, (stretch, context["position"], context["velocity"])


def _stretched(stretch, way, own):
    """Return the stretch after a way in one direction: first back to zero, if it is there, then away from it."""
    direction, left = jnp.sign(way), jnp.abs(way)
    ahead = direction * stretch
    before, after = jnp.minimum(ahead, 0.0), jnp.maximum(ahead, 0.0)
    to_zero, from_zero = (1.0 - own["softening"]) / own["length"], (1.0 + own["softening"]) / own["length"]
    # The logarithm of the solution below, by a rational function: exact where the step ends at zero.
    back = jnp.minimum(left, -before * (6.0 - to_zero * before) / (6.0 - 4.0 * to_zero * before))
    moved = _towards_end(before, back, to_zero) + _towards_end(after, left - back, from_zero)
    return jnp.where(way == 0.0, stretch, direction * moved)


def _towards_end(stretch, way, rate):
    """Return the solution of du/dx = 1 - rate u, its exponential by Pade's rational function of third order."""
    times = rate * way
    return stretch + way * (1.0 - rate * stretch) * (1.0 + times / 6.0) / (1.0 + times * (2.0 / 3.0 + times / 6.0))
