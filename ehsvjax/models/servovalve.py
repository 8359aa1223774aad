"""The electrohydraulic servovalve of the paper: transfer function, dead zone, saturation, orifices, mass-spring load.

The paper's figures are lost; where its transfer function sits is read in three ways, see `servovalve`.
"""

import functools
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from ehsvjax import hydraulics
from ehsvjax.checks import choice, flag, number
from ehsvjax.integrators import SDIRK_GAMMA, second_order_filter
from ehsvjax.models.model import Model, Parameter, Signal, identity

Placement = Literal["valve", "forward", "return"]


class ServovalveState(NamedTuple):
    """Position m, velocity m/s, output of the transfer function m and its rate m/s, load pressure Pa."""

    position: Any
    velocity: Any
    filtered: Any
    filtered_rate: Any
    load_pressure: Any


def servovalve(
    *,
    piston_area: float = 25e-4,
    supply_pressure: float = 140e5,
    mass: float = 20.0,
    stiffness: float = 1e4,
    area_ratio: float = 1.0,
    transfer_function: Placement = "valve",
    open_loop: bool = False,
    hydraulic_capacitance: float = 0.0,
    leakage_coefficient: float = 0.0,
    flow_force: bool = False,
    spool_stiffness: float = 1e6,
    oil_density: float = 850.0,
) -> Model:
    """Return the paper's servovalve with a mass-spring load.

        e   = u - Gc*x                            position feedback; u in metres of spool stroke
        p'' + 2*xi*w*p' + w^2*p = w^2*e           linear transfer function
        xv  = saturate(dead_zone(p, d), S)        dead zone first, then saturation, slope 1 between
        Q   = H*xv*sqrt(Ps - sgn(xv)*PL)          orifice flow, equation (4)
        Q   = A*x' + C*PL' + Ct*PL                continuity, equation (8); C = Ct = 0 in the paper
        A*PL = M*x'' + K*x                        load

    The two areas of a piston with one rod are A and r*A: PL is then the load's force over A, and the orifices give
    (the flow through the two being in the ratio of the areas; Merritt 1967, "Hydraulic control systems", has r = 1)

        Q   = H*xv*sqrt(2/(1 + r^3))*sqrt(s*Ps - sgn(xv)*PL),    s = 1 forward, r backward
        pA - pB = ((1 + r^2)*PL - (1 - r)*c*Ps)/(1 + r^3),       c = r^2 forward, 1 backward

    Input `command`; outputs `position`, `spool` and `load_pressure`, the difference pA - pB of the chambers' pressures,
    any of which a record may hold. Identified unless fixed: dead_zone d, saturation S, flow_gain H = Cd*w/sqrt(rho),
    feedback_gain Gc, damping_ratio xi, natural_frequency w; bounds are +-50% of the paper's values (H: of 1.45e-4, as
    the printed 1e-5 is a misprint, which the identified values in the paper's table 2 show). The constants are
    parameters too, fixed by default: give bounds to one and it is identified.

    Args:
        piston_area: A, m^2.
        supply_pressure: Ps, Pa.
        mass: M, kg.
        stiffness: K, N/m.
        area_ratio: r, of the area on the rod's side, which draws back, and that of the other; 1 for equal areas.
        transfer_function: where the second-order transfer function sits, which the paper leaves open:
            "valve": on the spool, p = W(s)*(u - Gc*x); the only reading in which the position fixes all six parameters;
            "forward": the controller in the forward path, p = Gc*W(s)*(u - x), u in metres of position; only H*Gc,
            d/Gc and S/Gc are fixed by the position;
            "return": in the feedback, p = u - Gc*W(s)*x; xi and w are hardly fixed.
        open_loop: no position feedback: the model then has no feedback_gain, and the transfer function is the spool's.
        hydraulic_capacitance: C = V/(4*beta), m^3/Pa; 0 as in the paper.
        leakage_coefficient: cross-piston leakage Ct, m^3/(s Pa).
        flow_force: the steady flow force of equation (6) against the spool, off as in the paper.
        spool_stiffness: N/m of spool force per stroke, for the flow force.
        oil_density: rho, kg/m^3, for the flow force (the area gradient is H*sqrt(rho)/Cd).

    Raises:
        ValueError: for an unknown `transfer_function`, an open loop with a transfer function elsewhere than in the
            valve, or a constant that is negative (zero where it divides) or so large or small that its unit must be
            another one: a pressure of 140 Pa.

    """
    choice("transfer_function", transfer_function, ("valve", "forward", "return"))
    flag("open_loop", open_loop)
    flag("flow_force", flow_force)
    if open_loop and transfer_function != "valve":
        raise ValueError(f"expected transfer_function='valve' in open loop, got {transfer_function!r}")
    constants: tuple[Parameter, ...] = (
        Parameter("piston_area", "A", "m^2", piston_area, 1e-5, 1e-1, "log", fixed=True),
        Parameter("supply_pressure", "Ps", "Pa", supply_pressure, 1e5, 1e8, "log", fixed=True),
        Parameter("mass", "M", "kg", mass, 1e-2, 1e5, "log", fixed=True),
        Parameter("stiffness", "K", "N/m", stiffness, 0.0, 1e9, fixed=True),
        Parameter("area_ratio", "r", "", area_ratio, 0.2, 5.0, "log", fixed=True, certain=True),
        Parameter("hydraulic_capacitance", "C", "m^3/Pa", hydraulic_capacitance, 0.0, 1e-9, fixed=True),
        Parameter("leakage_coefficient", "Ct", "m^3/(s Pa)", leakage_coefficient, 0.0, 1e-9, fixed=True),
    )
    if flow_force:
        constants += (
            Parameter("spool_stiffness", "Ks", "N/m", spool_stiffness, 1e3, 1e9, "log", fixed=True),
            Parameter("oil_density", "rho", "kg/m^3", oil_density, 500.0, 2000.0, fixed=True),
        )
    _check_constants(constants)
    feedback = () if open_loop else (Parameter("feedback_gain", "Gc", "m/m", 0.09, 0.045, 0.135, "log"),)
    equations = _equations(transfer_function, open_loop, flow_force)
    return Model(
        name="servovalve",
        parameters=(
            Parameter("dead_zone", "d", "m", 1e-4, 0.5e-4, 1.5e-4, "log"),
            Parameter("saturation", "S", "m", 3e-3, 1.5e-3, 4.5e-3, "log"),
            Parameter("flow_gain", "H", "m^2.5 kg^-0.5", 1.45e-4, 0.725e-4, 2.175e-4, "log"),
            *feedback,
            Parameter("damping_ratio", "ξ", "", 0.72, 0.36, 1.08, "log"),
            Parameter("natural_frequency", "ω", "rad/s", 300.0, 150.0, 450.0, "log"),
            *constants,
        ),
        initial=(
            Parameter("initial_position", "x(0)", "m", 0.0, -0.2, 0.2, output="position"),
            Parameter("initial_filtered", "p(0)", "m", 0.0, -0.01, 0.01),
            Parameter("initial_filtered_rate", "p'(0)", "m/s", 0.0, -3.0, 3.0),
        ),
        signals=(
            Signal("command", "input", "m"),
            *(() if open_loop else (Signal("feedback", "feedback", "m"),)),
            Signal("drive", "drive", "m"),
            Signal("filtered", "spool", "m"),
            Signal("spool_rate", "rate", "m/s"),
            Signal("opening", "opening", "m"),
            Signal("supply", "supply", "Pa"),
            Signal("load_force", "load", "N"),
            Signal("load_friction", "friction", "N"),
            Signal("retraction_area", "area", "m^2"),
            Signal("area_ratio", "area_ratio", ""),
            Signal("leakage_coefficient", "leakage", "m^3/(s Pa)"),
            Signal("hydraulic_capacitance", "capacitance", "m^3/Pa"),
            Signal("position", "sensor", "m"),
            Signal("spool", "sensor", "m"),
            Signal("load_pressure", "sensor", "Pa"),
        ),
        start=equations.start,
        stepper=equations.stepper,
        measure=equations.measure,
        max_step=0.25e-3,
        options=(
            *((c.name, c.value) for c in constants),
            ("transfer_function", transfer_function),
            ("open_loop", open_loop),
            ("flow_force", flow_force),
        ),
    )


def _check_constants(constants):
    for constant in constants:
        may_be_zero = constant.name in ("stiffness", "hydraulic_capacitance", "leakage_coefficient")
        bound = f"{'zero or more' if may_be_zero else 'positive'} ({constant.unit})"
        number(constant.name, constant.value, bound, lambda x, zero=may_be_zero: x > 0.0 or (zero and x == 0.0))
        lower, upper, value = constant.lower, constant.upper, constant.value
        if value > upper or (value < lower and not may_be_zero):
            raise ValueError(
                f"expected {constant.name} between {lower:g} and {upper:g} {constant.unit}, got {value}: mind the unit"
            )


class _Equations(NamedTuple):
    start: Any
    stepper: Any
    measure: Any


@functools.cache
def _equations(transfer_function: Placement, open_loop: bool, flow_force: bool) -> _Equations:
    """Return start, stepper and measure of one structure, the same objects for the same structure."""

    def drive(parameters, command, position, signal):
        """Input of the transfer function, m."""
        if open_loop:
            return signal("drive", command)
        gain = parameters["feedback_gain"]
        feedback = signal("feedback", position)
        e = {
            "valve": lambda: command - gain * feedback,
            "forward": lambda: gain * (command - feedback),
            "return": lambda: gain * feedback,
        }[transfer_function]()
        return signal("drive", e)

    def spool_of(parameters, command, filtered, signal):
        """Spool position before dead zone and saturation, m."""
        spool = command - filtered if transfer_function == "return" else filtered
        return signal("filtered", spool, dead_zone=parameters["dead_zone"])

    def opening_of(parameters, spool, signal):
        """Opening of the orifices, m: dead zone, then saturation."""
        dead_zone, saturation = parameters["dead_zone"], parameters["saturation"]
        opened = spool - jnp.clip(spool, -dead_zone, dead_zone)
        limited = jnp.clip(opened, -saturation, saturation)
        return signal("opening", limited, spool=spool, dead_zone=dead_zone, saturation=saturation)

    def limited(before, filtered, filtered_rate, per_duration, signal):
        """The transfer function's output and its rate, where the spool cannot move as fast as it should."""
        rate = (filtered - before) * per_duration
        possible = signal("spool_rate", rate)
        if possible is rate:
            return filtered, filtered_rate
        return before + possible / per_duration, signal("spool_rate", filtered_rate)

    def straightened(start, middle, end):
        """A command at the start, the stage and the end of a step: on the straight line of its mean and its change."""
        bend = (2.0 / 3.0) * (middle - 0.5 * (start + end))
        return tuple(start + fraction * (end - start) + bend for fraction in (0.0, SDIRK_GAMMA, 1.0))

    def start(parameters, initial, inputs):
        """Position and filter as given; the velocity that the valve's flow gives at once, for it settles in 0.2 ms."""
        position = initial["initial_position"]
        filtered = initial["initial_filtered"]
        command = inputs["command"]
        opening = opening_of(parameters, spool_of(parameters, command, filtered, identity), identity)
        per_area = 1.0 / parameters["piston_area"]
        load_pressure = parameters["stiffness"] * per_area * position
        supply = _supply_towards(parameters, opening, parameters["supply_pressure"])
        flow = hydraulics.load_flow(_flow_gain(parameters), opening, supply, load_pressure)
        return ServovalveState(
            position=position,
            velocity=flow * per_area,
            filtered=filtered,
            filtered_rate=initial["initial_filtered_rate"],
            load_pressure=load_pressure,
        )

    def stepper(parameters, step_size, signal):
        """Return one step: the transfer function exactly, for an input drawn as a straight line; the load by SDIRK."""
        parameters = _with_rod(parameters, signal)
        stage_size = SDIRK_GAMMA * step_size
        per_stage_size, per_step_size = 1.0 / stage_size, 1.0 / step_size
        to_stage, to_end = (
            second_order_filter(parameters["damping_ratio"], parameters["natural_frequency"], duration)
            for duration in (stage_size, step_size)
        )
        load_stage = _load_stage(parameters, stage_size, signal)

        def spool_drive(command, position, opening_state):
            e = drive(parameters, command, position, signal)
            return e - _flow_force_stroke(parameters, *opening_state) if flow_force else e

        def step(state, inputs):
            command_start, command_stage, command_end = straightened(
                *(signal("command", inputs(fraction)["command"]) for fraction in (0.0, 0.5, 1.0))
            )
            flow = parameters["piston_area"] * state.velocity
            supply = signal("supply", parameters["supply_pressure"], flow=flow)
            # Forces act at their size in the middle of the step: of second order where they depend on the position.
            motion = {"position": state.position + 0.5 * step_size * state.velocity, "velocity": state.velocity}
            force = signal("load_force", 0.0, **motion)
            friction = signal("load_friction", 0.0, **motion)

            opening = opening_of(parameters, spool_of(parameters, command_start, state.filtered, signal), signal)
            e = spool_drive(command_start, state.position, (opening, supply, state.load_pressure))

            # First stage. The drive's slope is predicted from the velocity: an error of third order in the spool.
            predicted = state.position + stage_size * state.velocity
            e_predicted = spool_drive(command_stage, predicted, (opening, supply, state.load_pressure))
            filtered, rate = to_stage(state.filtered, state.filtered_rate, e, (e_predicted - e) * per_stage_size)
            filtered, _ = limited(state.filtered, filtered, rate, per_stage_size, signal)
            opening = opening_of(parameters, spool_of(parameters, command_stage, filtered, signal), signal)
            position, velocity, pressure = load_stage(
                state.position, state.velocity, state.load_pressure, opening, supply, force, friction
            )

            # Second stage, from the state that the first stage's rates lead to.
            e_stage = spool_drive(command_stage, position, (opening, supply, pressure))
            filtered, filtered_rate = to_end(state.filtered, state.filtered_rate, e, (e_stage - e) * per_stage_size)
            filtered, filtered_rate = limited(state.filtered, filtered, filtered_rate, per_step_size, signal)
            carried = (1.0 - SDIRK_GAMMA) / SDIRK_GAMMA
            opening = opening_of(parameters, spool_of(parameters, command_end, filtered, signal), signal)
            position, velocity, pressure = load_stage(
                state.position + carried * (position - state.position),
                state.velocity + carried * (velocity - state.velocity),
                state.load_pressure + carried * (pressure - state.load_pressure),
                opening,
                supply,
                force,
                friction,
            )
            return ServovalveState(position, velocity, filtered, filtered_rate, pressure)

        return step

    def measure(parameters, state, inputs, signal):
        parameters = _with_rod(parameters, signal)
        spool = spool_of(parameters, signal("command", inputs["command"]), state.filtered, signal)
        load_force = parameters["piston_area"] * state.load_pressure
        return {
            "position": signal("position", state.position, velocity=state.velocity, load_force=load_force),
            "spool": signal("spool", spool),
            "load_pressure": signal("load_pressure", _difference_of_chambers(parameters, spool, state.load_pressure)),
        }

    return _Equations(start, stepper, measure)


def _load_stage(parameters, h, signal):
    """Return the implicit stage of length h: position, velocity and pressure where the rates there lead from a start.

    The stage solves, for the opening xv given,
        x1 = x0 + h*v1
        M*(v1 - v0)/h + K*x1 + F = A*PL1
        H*xv*q = A*v1 + Ct*PL1 + C*(PL1 - PL0)/h,   PL1 = s*(Ps - q*|q|),   s = sgn(xv).
    The load is linear, so that its flow is a straight line of the pressure, and what remains is a quadratic for the
    signed root q of the pressure drop. Its closed form never divides by xv: at xv = 0 (hydraulic lock) it gives Q = 0.

    Dry friction R adds R*sgn(v1) to F. As v1 falls with F, the piston moves forward if it does so against F + R,
    backward if it does so against F - R, and sticks otherwise: no chatter.
    """
    area = parameters["piston_area"]
    retraction_area = signal("retraction_area", area)
    out = _load_coefficients(parameters, area, h, signal)
    back = out if retraction_area is area else _load_coefficients(parameters, retraction_area, h, signal)

    def motion(position, velocity, pressure, opening, supply, force):
        side = out if back is out else jax.tree.map(functools.partial(jnp.where, opening < 0.0), back, out)
        return _motion(parameters, side, h, position, velocity, pressure, opening, supply, force)

    def stage(position, velocity, pressure, opening, supply, force, friction):
        if isinstance(friction, float) and friction == 0.0:
            return motion(position, velocity, pressure, opening, supply, force)
        forward = motion(position, velocity, pressure, opening, supply, force + friction)
        backward = motion(position, velocity, pressure, opening, supply, force - friction)
        stuck = position, jnp.zeros_like(velocity), 0.5 * (forward[2] + backward[2])
        return tuple(
            jnp.where(forward[1] > 0.0, f, jnp.where(backward[1] < 0.0, b, s))
            for f, b, s in zip(forward, backward, stuck, strict=True)
        )

    return stage


def _with_rod(parameters, signal):
    """Return the parameters with the ratio of the areas behind the effects on it."""
    return {**parameters, "area_ratio": signal("area_ratio", parameters["area_ratio"])}


def _flow_gain(parameters):
    """Return the flow gain of the two orifices in series, by the areas; for equal ones it is H."""
    return parameters["flow_gain"] * jnp.sqrt(2.0 / (1.0 + parameters["area_ratio"] ** 3))


def _supply_towards(parameters, opening, supply):
    """Return the pressure that drives the piston where the valve opens to: backward it acts on the other area."""
    return jnp.where(opening < 0.0, parameters["area_ratio"] * supply, supply)


def _difference_of_chambers(parameters, spool, load_pressure):
    """Return pA - pB, of the chambers as the valve last filled them."""
    ratio = parameters["area_ratio"]
    by_supply = jnp.where(spool < 0.0, 1.0 - ratio, (1.0 - ratio) * ratio**2) * parameters["supply_pressure"]
    return ((1.0 + ratio**2) * load_pressure - by_supply) / (1.0 + ratio**3)


class _LoadCoefficients(NamedTuple):
    """What of a stage does not change from step to step, for one piston area: a reciprocal serves every step."""

    flow_gain: Any
    flow_by_momentum: Any
    pressure_by_flow: Any
    half_slope_by_opening: Any
    per_area: Any
    storage: Any
    leakage: Any


def _load_coefficients(parameters, area, h, signal):
    storage = signal("hydraulic_capacitance", parameters["hydraulic_capacitance"]) / h
    leakage = signal("leakage_coefficient", parameters["leakage_coefficient"])
    flow_by_momentum = area / (parameters["mass"] + h * h * parameters["stiffness"])
    pressure_by_flow = 1.0 / (h * area * flow_by_momentum + leakage + storage)
    flow_gain = _flow_gain(parameters)
    half_slope = 0.5 * flow_gain * pressure_by_flow
    return _LoadCoefficients(flow_gain, flow_by_momentum, pressure_by_flow, half_slope, 1.0 / area, storage, leakage)


def _motion(parameters, coefficients, h, position, velocity, pressure, opening, supply, force):
    """Return position, velocity and pressure at the end of a stage without dry friction."""
    flow_gain, flow_by_momentum, pressure_by_flow, half_slope_by_opening, per_area, storage, leakage = coefficients
    momentum = parameters["mass"] * velocity - h * (parameters["stiffness"] * position + force)
    flow_at_rest = flow_by_momentum * momentum - storage * pressure
    direction = jnp.where(opening < 0.0, -1.0, 1.0)
    half_slope = half_slope_by_opening * jnp.abs(opening)
    drop = _supply_towards(parameters, opening, supply) + direction * flow_at_rest * pressure_by_flow
    square = half_slope * half_slope + jnp.abs(drop)
    # Closed, and just balanced by the load: no flow, and no derivative of a root of zero.
    flowing = square > 0.0
    root = jnp.where(flowing, drop / (half_slope + jnp.sqrt(jnp.where(flowing, square, 1.0))), 0.0)
    flow = flow_gain * opening * root
    pressure_end = (flow - flow_at_rest) * pressure_by_flow
    velocity_end = (flow - leakage * pressure_end - storage * (pressure_end - pressure)) * per_area
    return position + h * velocity_end, velocity_end, pressure_end


def _flow_force_stroke(parameters, opening, supply, load_pressure):
    """Stroke by which the steady flow force, equation (6), holds the spool back, m; two orifices share the drop."""
    area_gradient = parameters["flow_gain"] * jnp.sqrt(parameters["oil_density"]) / hydraulics.DISCHARGE_COEFFICIENT
    drop = _supply_towards(parameters, opening, supply) - jnp.where(opening < 0.0, -1.0, 1.0) * load_pressure
    return hydraulics.flow_force_stiffness(area_gradient, drop) * opening / parameters["spool_stiffness"]
