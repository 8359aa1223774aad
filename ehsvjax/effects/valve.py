"""Effects of a servovalve and its actuator, and of the Van der Pol oscillator's damping."""

import math

import jax.numpy as jnp
import numpy as np

from ehsvjax.effects.effect import (
    Effect,
    EffectParameter,
    amplitude,
    constant,
    limit,
    off_by_error,
    relative_error,
    size,
    width,
)
from ehsvjax.effects.forces import harmonic, harmonic_parameters
from ehsvjax.effects.series import dead_zone, follow_with_play

_TRIANGLES = "small triangles at three rates and amplitudes"
_STAIRCASE = "a staircase of levels; measure the supply pressure"


def _leaking(own, opening, context):
    """Return the opening with flow inside the dead zone; fully open it is as far open as without."""
    spool, most = context["spool"], context["saturation"]
    sharp = dead_zone(spool, context["dead_zone"])
    leaking = sharp + own["ratio"] * (spool - sharp)
    # What another effect has done to the opening stays.
    return opening + jnp.clip(leaking, -most, most) - jnp.clip(sharp, -most, most)


def _rounded(own, opening, context):
    """Return the opening with a softplus in place of the dead zone's corners, exact for a width of zero."""
    half_width = jnp.maximum(own["width"], 1e-9)
    spool, edge, most = context["spool"], context["dead_zone"], context["saturation"]

    def excess(at):
        # softplus less the corner that it replaces: decays on both sides.
        return half_width * jnp.log1p(jnp.exp(-jnp.abs(at) / half_width))

    sharp = dead_zone(spool, edge)
    rounded = jnp.clip(sharp + excess(spool - edge) - excess(-spool - edge), -most, most)
    # What another effect has done to the opening stays.
    return opening + rounded - jnp.clip(sharp, -most, most)


VALVE = (
    Effect(
        "torque_motor_hysteresis",
        "drive",
        (width("half_width", "{value}", (0.003, 0.01, 0.03)),),
        follow_with_play,
        memory=(0.0,),
        says="the torque motor follows its current with a play",
        settled_by=_TRIANGLES,
    ),
    Effect(
        "feedback_backlash",
        "feedback",
        (width("half_width", "{value}", (0.002, 0.01, 0.03)),),
        follow_with_play,
        memory=(0.0,),
        says="the feedback follows the piston with a play",
        settled_by=_TRIANGLES,
    ),
    Effect(
        "null_bias",
        "spool",
        (amplitude("bias", "{value}", lambda s: 1e-3 * s["value"]),),
        lambda own, spool, context: spool - own["bias"],
        says="the spool's null is off",
        settled_by="measure the spool (no input can tell it from an asymmetric dead zone)",
    ),
    Effect(
        "asymmetric_dead_zone",
        "spool",
        (amplitude("asymmetry", "", constant(1e-2), constant(-0.95), constant(0.95)),),
        # d*(1 + e) on one side and d*(1 - e) on the other is the same dead zone about d*e.
        lambda own, spool, context: spool - own["asymmetry"] * context["dead_zone"],
        needs=("dead_zone",),
        says="the lands overlap more on one side than on the other",
        settled_by="measure the spool (no input can tell it from a null bias)",
    ),
    Effect(
        "spool_rate_limit",
        "rate",
        (limit("limit", "{value}", (0.9, 0.7, 0.45, 0.25, 0.12)),),
        lambda own, rate, context: jnp.clip(rate, -own["limit"], own["limit"]),
        says="the spool cannot move faster",
        settled_by="steps of several sizes, with the spool measured",
    ),
    Effect(
        "null_leakage",
        "opening",
        # Small leaks a refit of the dead zone does as well: what is left grows faster than the ratio.
        (EffectParameter("ratio", "", 0.0, constant(0.0), constant(3.0), lambda s: (0.03, 0.1, 0.3)),),
        _leaking,
        needs=("spool", "dead_zone", "saturation"),
        says="flow passes the lands inside the dead zone",
        settled_by="slow small ramps through null, and long dwells",
    ),
    Effect(
        "flow_gain_rounding",
        "opening",
        (width("width", "{value}", (0.003, 0.01, 0.03)),),
        _rounded,
        needs=("spool", "dead_zone", "saturation"),
        says="the lands' edges are round",
        settled_by="slow small ramps through null",
    ),
    Effect(
        "flow_gain_curvature",
        "opening",
        (amplitude("curvature", "", constant(1e-3), constant(-0.9), constant(3.0)),),
        lambda own, xv, context: xv * (1.0 + own["curvature"] * (xv / context["saturation"]) ** 2),
        needs=("saturation",),
        says="the flow gain changes with the opening",
        settled_by=_STAIRCASE,
    ),
    Effect(
        "flow_gain_drift",
        "opening",
        (amplitude("drift", "", constant(1e-3), constant(-0.9), constant(9.0)),),
        lambda own, xv, context: xv * (1.0 + own["drift"] * context["time"] / context["duration"]),
        needs=("time",),
        says="the flow gain changes as time passes (oil temperature)",
        settled_by="repeat the record after warming up; measure the oil's temperature",
    ),
    Effect(
        "supply_droop",
        "supply",
        (size("resistance", "{value}/(m^3/s)", lambda s: 1e-3 * s["value"] / max(s["flow"], 1e-300)),),
        lambda own, pressure, context: pressure - own["resistance"] * jnp.abs(context["flow"]),
        needs=("flow",),
        says="the supply pressure gives way under flow",
        settled_by="measure the supply pressure",
    ),
    Effect(
        "supply_pulsation",
        "supply",
        harmonic_parameters("{value}", lambda s: 1e-3 * s["value"]),
        lambda own, pressure, context: pressure - harmonic(own, context),
        needs=("time",),
        says="the supply pressure pulsates",
        settled_by="measure the supply pressure: what it does changes its sign with the opening, what a load does not",
    ),
    Effect(
        "return_pressure",
        "supply",
        (size("pressure", "{value}", lambda s: 1e-3 * s["value"], lambda s: 0.5 * s["value"]),),
        lambda own, pressure, context: pressure - own["pressure"],
        says="the return line is under pressure",
        settled_by="measure the load pressure",
    ),
    Effect(
        "area_asymmetry",
        "area",
        (amplitude("asymmetry", "", constant(1e-3), constant(-3.0), constant(0.9)),),
        lambda own, area, context: area * (1.0 - own["asymmetry"]),
        says="the piston's area is smaller on its way back",
        settled_by="half the supply pressure",
    ),
    Effect(
        "area_ratio",
        "area_ratio",
        (relative_error(usual=math.inf),),
        off_by_error,
        says="the piston has a rod on one side, or one that is larger than was given: its two areas differ",
        settled_by="measure the rod, and say so: servovalve(area_ratio=...); or the pressures of both chambers",
    ),
    Effect(
        "cross_piston_leakage",
        "leakage",
        (size("coefficient", "{value}", constant(1e-14), constant(1e-9)),),
        lambda own, leakage, context: leakage + own["coefficient"],
        says="oil passes the piston",
        settled_by="long dwells under load",
    ),
    Effect(
        "oil_compressibility",
        "capacitance",
        # The oil rings after each stroke: what is a fifth off has another frequency, and explains nothing of it.
        (
            EffectParameter(
                "capacitance",
                "{value}",
                0.0,
                constant(0.0),
                constant(1e-9),
                lambda s: np.geomspace(1e-15, 1e-11, 36).tolist(),
            ),
        ),
        lambda own, capacitance, context: capacitance + own["capacitance"],
        says="the oil is compressed before the piston moves",
        settled_by="measure the load pressure through fast steps",
    ),
)

DAMPING = (
    Effect(
        "asymmetric_damping",
        "damping",
        (amplitude("offset", "{value}", lambda s: 1e-3 * s["value"]),),
        lambda own, x, context: x - own["offset"],
        says="the damping changes its sign about another place",
        settled_by="free decay from both sides of the cycle",
    ),
    Effect(
        "damping_threshold",
        "damping",
        (
            EffectParameter(
                "threshold", "{value}", 1.0, constant(0.1), constant(10.0), lambda s: (1.001,),
            ),
        ),
        lambda own, x, context: x / own["threshold"],
        says="the damping changes its sign at another amplitude",
        settled_by="two amplitudes, and free decay from inside and outside the cycle",
    ),
)  # fmt: skip

DISPLACEMENT = (
    Effect(
        "displacement_bias",
        "displacement",
        (amplitude("bias", "{value}", lambda s: 1e-3 * s["value"]),),
        lambda own, x, context: x + own["bias"],
        says="a constant is added",
        settled_by="measure there",
    ),
    Effect(
        "displacement_gain",
        "displacement",
        (relative_error(),),
        off_by_error,
        says="it acts more or less than it is",
        settled_by="measure there",
    ),
    Effect(
        "dead_zone",
        "displacement",
        (width("half_width", "{value}", (0.01, 0.04, 0.12)),),
        lambda own, x, context: dead_zone(x, own["half_width"]),
        says="small values do nothing",
        settled_by="small motions about zero",
    ),
    Effect(
        "backlash",
        "displacement",
        (width("half_width", "{value}", (0.005, 0.02, 0.06)),),
        follow_with_play,
        memory=(0.0,),
        says="it follows with a play",
        settled_by=_TRIANGLES,
    ),
    Effect(
        "saturation",
        "displacement",
        (limit("limit", "{value}", (0.97, 0.9, 0.75, 0.55)),),
        lambda own, x, context: jnp.clip(x, -own["limit"], own["limit"]),
        says="large values are cut off",
        settled_by="a staircase of levels",
    ),
)

DRIFT = (
    Effect(
        "parameter_drift",
        "parameter",
        (amplitude("drift", "", constant(1e-3), constant(-0.9), constant(9.0)),),
        lambda own, value, context: value * (1.0 + own["drift"] * context["time"] / context["duration"]),
        needs=("time",),
        says="a parameter changes as time passes",
        settled_by="repeat the record later",
    ),
)
