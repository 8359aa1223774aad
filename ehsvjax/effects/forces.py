"""Effects on forces and on what is stored: friction, stiffness, stops; in the signs of a driving force or a load."""

import functools
import math

import jax.numpy as jnp

from ehsvjax.effects.effect import PROBED, UNLIMITED, Effect, EffectParameter, Scales, amplitude, shape, size
from ehsvjax.effects.hysteresis import elastic_friction

# Stiffness of an end stop over that of the machine, as it seems where the fit is bad: a softer one is a spring.
_STOP_STIFFNESS, _SOFTEST, _STIFFEST = (6.0, 18.0, 60.0), 0.1, 1e5


def _probe(scales: Scales) -> float:
    """Return a force that moves the machine a little, which is known only once one was tried."""
    return scales["probe"]


def _stiffness(scales: Scales) -> float:
    """Return how stiff a machine is: the force that moves it as far as it goes, over that way."""
    return _probe(scales) / (PROBED * (scales["position"] or 1.0))


def _per(quantity: str, power: int):
    return lambda scales: _probe(scales) / max(scales[quantity], 1e-300) ** power


def _sign(velocity):
    """Sign of a velocity; zero at rest."""
    return velocity / jnp.maximum(jnp.abs(velocity), 1e-12)


def _resisting(term, own, value, context):
    return value + term(own, context)


def _driving(term, own, value, context):
    return value - term(own, context)


def _load(name, parameters, term, *, needs=("position", "velocity"), says="", settled_by=""):
    return Effect(name, "load", parameters, functools.partial(_resisting, term), needs, (), says, settled_by)


def _force(name, parameters, term, *, needs=("position", "velocity"), says="", settled_by=""):
    return Effect(name, "force", parameters, functools.partial(_driving, term), needs, (), says, settled_by)


def _viscous(own, context):
    return own["coefficient"] * context["velocity"]


def _cubic(own, context):
    return own["coefficient"] * context["position"] ** 3


def harmonic(own, context):
    """Return the negative of a harmonic of time: as a force it drives, as a load it resists."""
    angle = own["frequency"] * context["time"]
    return -(own["cosine"] * jnp.cos(angle) + own["sine"] * jnp.sin(angle))


def harmonic_parameters(unit, probe, turn=2.0):
    """Return the numbers of a harmonic: its two amplitudes, and a frequency that is looked for in the record.

    Up to that of a turn of so many radians in a sample period, of which pi is the highest that readings show.
    """
    frequency = shape(
        "frequency",
        "rad/s",
        lambda scales: scales["frequencies"],
        # What a record has not shown twice is not known to be periodic: it would stand for anything that is slow.
        lambda scales: 4.0 * math.pi / scales["duration"],
        lambda scales: turn / scales["sample_period"],
    )
    return amplitude("cosine", unit, probe), amplitude("sine", unit, probe), frequency


def _stribeck_shape(scales: Scales):
    return [share * scales["velocity"] for share in (0.01, 0.05, 0.2)]


def _stribeck_parameters(unit):
    return (
        size("force", unit, _probe),
        shape("velocity", "{length}/s", _stribeck_shape, lambda s: 1e-3 * s["velocity"], lambda s: 0.5 * s["velocity"]),
    )


def _stribeck(own, velocity):
    return own["force"] * jnp.exp(-((velocity / own["velocity"]) ** 2))


def _stop(side):
    """Return the force of a stop on one side, and its tries, shares of how far the motion goes on that side."""
    sign = "positive" if side > 0 else "negative"
    end, stiffness, reach = f"{sign}_end", f"{sign}_stiffness", "position+" if side > 0 else "position-"

    def term(own, context):
        depth = jnp.maximum(side * context["position"] - own[end], 0.0)
        return side * own[stiffness] * depth

    position = EffectParameter(
        end, "{length}", UNLIMITED, lambda s: 0.02 * s[reach], lambda s: 1.02 * s[reach],
        lambda s: [t * s[reach] for t in (0.98, 0.9, 0.75)],
    )  # fmt: skip
    hardness = shape(
        stiffness,
        "{value}/{length}",
        lambda s: [times * _stiffness(s) for times in _STOP_STIFFNESS],
        lambda s: _SOFTEST * _stiffness(s),
        lambda s: _STIFFEST * _stiffness(s),
    )
    return _load(
        "end_stop",
        (position, hardness),
        term,
        says=f"the motion ends at a stop on the {sign} side",
        settled_by="move to the end by hand, with a gauge: a stop stops the load, a sensor's end does not",
    )


def _hard_limit(side):
    """Return the end, on one side, of what is stored: its rate of change stops there, and is lost.

    No step goes further than to the end: one that went past it would have the level stay too high for as long as it is
    full, an error in proportion to the step.
    """
    sign, there, opposite = ("positive", "level+", "level-") if side > 0 else ("negative", "level-", "level+")
    number = f"{sign}_limit"

    def apply(own, rate, context):
        room = own[number] - side * context["level"]
        # Where a model passes the rate at a moment, no step follows.
        return side * jnp.minimum(side * rate, room / jnp.maximum(context["step_size"], 1e-12))

    # What is stored is seldom measured: with the limit its scale may be another than the nominal model has it.
    end = EffectParameter(
        number, "{value} s", UNLIMITED, lambda s: -s[opposite], lambda s: 10.0 * s[there],
        lambda s: [share * s[there] - (1.0 - share) * s[opposite] for share in (0.98, 0.9, 0.75)],
    )  # fmt: skip
    return Effect(
        "hard_limit",
        "storage",
        (end,),
        apply,
        needs=("level",),
        says=f"what is stored ends on the {sign} side: it overflows, or stands at its stop",
        settled_by="look there while it happens, or measure what is stored",
    )


STORAGE = (_hard_limit(1.0), _hard_limit(-1.0))

_MEASURE_PRESSURE = "measure the load, its force or its pressure"
_TWO_AMPLITUDES = "two amplitudes, and free decay"

FRICTION = (
    Effect(
        "coulomb_friction",
        "friction",
        (size("force", "{value}", _probe),),
        lambda own, value, context: value + own["force"],
        says="dry friction of constant size",
        settled_by=_MEASURE_PRESSURE,
    ),
    Effect(
        "stribeck_friction",
        "friction",
        _stribeck_parameters("{value}"),
        lambda own, value, context: value + _stribeck(own, context["velocity"]),
        needs=("velocity",),
        says="dry friction that is larger at small velocities",
        settled_by=f"{_MEASURE_PRESSURE}, at slow motion",
    ),
)

LOAD = (
    _load(
        "constant_load",
        (amplitude("force", "{value}", _probe),),
        lambda own, context: own["force"],
        says="a constant force on the piston",
        settled_by=f"half the supply, which changes all but a force; or {_MEASURE_PRESSURE}",
    ),
    _load(
        "viscous_friction",
        (size("coefficient", "{value}/({length}/s)", _per("velocity", 1)),),
        _viscous,
        says="friction in proportion to velocity",
        settled_by="measure the supply or the load pressure",
    ),
    _load(
        "hardening_spring",
        (amplitude("coefficient", "{value}/{length}^3", _per("position", 3)),),
        _cubic,
        says="the load's spring becomes stiffer with its stroke",
        settled_by=f"{_MEASURE_PRESSURE} at several positions",
    ),
    _load(
        "harmonic_load",
        harmonic_parameters("{value}", _probe),
        harmonic,
        needs=("position", "velocity", "time"),
        says="a periodic force on the piston",
        settled_by="a record at rest: a hum of the sensor is there too, a load on a closed valve is not",
    ),
    _stop(1.0),
    _stop(-1.0),
)

FORCE = (
    _force(
        "constant_force",
        (amplitude("force", "{value}", _probe),),
        lambda own, context: -own["force"],
        needs=(),
        says="a constant force",
        settled_by=_TWO_AMPLITUDES,
    ),
    _force(
        "coulomb_friction",
        (size("force", "{value}", _probe),),
        lambda own, context: own["force"] * _sign(context["velocity"]),
        needs=("velocity",),
        says="dry friction of constant size",
        settled_by="slow motion in both directions",
    ),
    _force(
        "stribeck_friction",
        _stribeck_parameters("{value}"),
        lambda own, context: _stribeck(own, context["velocity"]) * _sign(context["velocity"]),
        needs=("velocity",),
        says="dry friction that is larger at small velocities",
        settled_by="slow motion in both directions",
    ),
    elastic_friction(_per("position", 1)),
    _force(
        "one_way_damping",
        (amplitude("coefficient", "{value}/({length}/s)", _per("velocity", 1)),),
        lambda own, context: own["coefficient"] * jnp.abs(context["velocity"]),
        needs=("velocity",),
        says="a damper that is stiffer one way",
        settled_by=_TWO_AMPLITUDES,
    ),
    _force(
        "linear_damping",
        (amplitude("coefficient", "{value}/({length}/s)", _per("velocity", 1)),),
        _viscous,
        needs=("velocity",),
        says="a force in proportion to velocity",
        settled_by=_TWO_AMPLITUDES,
    ),
    _force(
        "quadratic_damping",
        (amplitude("coefficient", "{value}/({length}/s)^2", _per("velocity", 2)),),
        lambda own, context: own["coefficient"] * context["velocity"] * jnp.abs(context["velocity"]),
        needs=("velocity",),
        says="drag in proportion to the square of velocity",
        settled_by=_TWO_AMPLITUDES,
    ),
    _force(
        "rayleigh_damping",
        (amplitude("coefficient", "{value}/({length}/s)^3", _per("velocity", 3)),),
        lambda own, context: own["coefficient"] * context["velocity"] ** 3,
        needs=("velocity",),
        says="a force in proportion to the cube of velocity",
        settled_by=_TWO_AMPLITUDES,
    ),
    _force(
        "linear_stiffness",
        (amplitude("coefficient", "{value}/{length}", _per("position", 1)),),
        lambda own, context: own["coefficient"] * context["position"],
        needs=("position",),
        says="a spring more or less",
        settled_by=_TWO_AMPLITUDES,
    ),
    _force(
        "quadratic_stiffness",
        (amplitude("coefficient", "{value}/{length}^2", _per("position", 2)),),
        lambda own, context: own["coefficient"] * context["position"] ** 2,
        needs=("position",),
        says="a spring that is stiffer on one side",
        settled_by=_TWO_AMPLITUDES,
    ),
    _force(
        "cubic_stiffness",
        (amplitude("coefficient", "{value}/{length}^3", _per("position", 3)),),
        _cubic,
        needs=("position",),
        says="a spring that becomes stiffer with its stroke, by the third power",
        settled_by=_TWO_AMPLITUDES,
    ),
    _force(
        "quintic_stiffness",
        (amplitude("coefficient", "{value}/{length}^5", _per("position", 5)),),
        lambda own, context: own["coefficient"] * context["position"] ** 5,
        needs=("position",),
        says="a spring that becomes stiffer with its stroke, by the fifth power",
        settled_by=_TWO_AMPLITUDES,
    ),
    _force(
        "harmonic_force",
        harmonic_parameters("{value}", _probe),
        harmonic,
        needs=("time",),
        says="a periodic force",
        settled_by="a record at rest",
    ),
    _force(
        "parametric_excitation",
        harmonic_parameters("{value}/{length}", _per("position", 1)),
        lambda own, context: -harmonic(own, context) * context["position"],
        needs=("position", "time"),
        says="a stiffness that changes periodically",
        settled_by="records at two amplitudes: a force does not grow with them, a stiffness does",
    ),
)
