"""Models of the measured rigs of benchmarks/real_records.py: what each publisher's description gives, and no more.

Each lacks what is known to be missing, so that a diagnosis has it to find.
"""

import jax.numpy as jnp

import ehsvjax
from ehsvjax import Model, Parameter, Signal, runge_kutta_4

# --- An electronic oscillator: y'' = b u - d y' - k y ---


def silverbox() -> Model:
    """Return the linear oscillator; its spring is known to stiffen with the third power."""
    return Model(
        name="Silverbox",
        parameters=(
            Parameter("gain", "b", "1/s^2", 1e5, 1e3, 1e7, "log"),
            Parameter("damping", "d", "1/s", 50.0, 1.0, 1e3, "log"),
            Parameter("stiffness", "k", "1/s^2", 2e5, 1e4, 1e6, "log"),
        ),
        initial=(
            Parameter("initial_position", "y(0)", "V", 0.0, -0.5, 0.5, output="position"),
            Parameter("initial_velocity", "y'(0)", "V/s", 0.0, -200.0, 200.0),
        ),
        signals=(
            Signal("voltage", "input", "V"),
            Signal("force", "force", "V/s^2"),
            Signal("position", "sensor", "V"),
        ),
        start=_oscillator_start,
        stepper=runge_kutta_4(_oscillator_rates),
        measure=_oscillator_outputs,
        max_step=1e-3,
    )


def _oscillator_start(parameters, initial, inputs):
    del parameters, inputs
    return {"y": initial["initial_position"], "v": initial["initial_velocity"]}


def _oscillator_rates(parameters, state, inputs, signal):
    y, v = state["y"], state["v"]
    driven = parameters["gain"] * signal("voltage", inputs["voltage"]) + signal("force", 0.0, position=y, velocity=v)
    return {"y": v, "v": driven - parameters["damping"] * v - parameters["stiffness"] * y}


def _oscillator_outputs(parameters, state, inputs, signal):
    del parameters, inputs
    return {"position": signal("position", state["y"])}


# --- A viscous damper behind a spring: k (u - x) = c x' ---


def damper() -> Model:
    """Return the viscous damper and the spring of its mounting; it is known to be a friction damper with a gap."""
    return Model(
        name="damper",
        parameters=(
            Parameter("stiffness", "k", "N/m", 3e6, 1e5, 1e8, "log"),
            Parameter("damping", "c", "N s/m", 1e5, 1e3, 1e7, "log"),
        ),
        initial=(Parameter("initial_force", "F(0)", "N", 0.0, -2e4, 2e4, output="force"),),
        signals=(
            Signal("displacement", "input", "m"),
            Signal("extension", "displacement", "m"),
            Signal("friction", "friction", "N"),
            Signal("load", "load", "N"),
            Signal("force", "sensor", "N"),
        ),
        start=_damper_start,
        stepper=runge_kutta_4(_damper_rates),
        measure=_damper_outputs,
        max_step=2e-3,
    )


def _damper_start(parameters, initial, inputs):
    displacement = inputs["displacement"]
    return {"x": displacement - initial["initial_force"] / parameters["stiffness"]}


def _spring_force(parameters, state, inputs, signal):
    stretched = signal("displacement", inputs["displacement"]) - state["x"]
    return parameters["stiffness"] * signal("extension", stretched, position=stretched)


def _damper_rates(parameters, state, inputs, signal):
    force = _spring_force(parameters, state, inputs, signal)
    # Without dry friction; with it the damper stands still until the force is larger.
    velocity = force / parameters["damping"]
    held = signal("friction", 0.0, velocity=velocity, position=state["x"])
    left = force - signal("load", 0.0, velocity=velocity, position=state["x"])
    return {"x": jnp.sign(left) * jnp.maximum(jnp.abs(left) - held, 0.0) / parameters["damping"]}


def _damper_outputs(parameters, state, inputs, signal):
    return {"force": signal("force", _spring_force(parameters, state, inputs, signal))}


# --- The flow that a servovalve leaks about its null, by the current ---


def leakage() -> Model:
    """Return a bell about the null; hysteresis of the current and a lag of the flow meter are known to be there."""
    return Model(
        name="null leakage",
        parameters=(
            Parameter("floor", "Q0", "gal/min", 0.2, 0.01, 1.0, "log"),
            Parameter("peak", "Qn", "gal/min", 0.5, 0.01, 2.0, "log"),
            Parameter("null", "i0", "mA", 0.0, -2.0, 2.0),
            Parameter("width", "w", "mA", 1.0, 0.05, 5.0, "log"),
        ),
        initial=(),
        signals=(
            Signal("current", "input", "mA"),
            Signal("opening", "opening", "mA"),
            Signal("flow", "sensor", "gal/min"),
        ),
        start=_nothing,
        stepper=_stays,
        measure=_leaked,
        max_step=1.0,
    )


def _nothing(parameters, initial, inputs):
    del parameters, initial, inputs
    return {"nothing": 0.0}


def _stays(parameters, step_size, signal):
    del parameters, step_size, signal
    return lambda state, inputs: state


def _leaked(parameters, state, inputs, signal):
    del state
    current = signal("current", inputs["current"])
    opening = signal("opening", current - parameters["null"])
    bell = 1.0 / (1.0 + (opening / parameters["width"]) ** 2)
    return {"flow": signal("flow", parameters["floor"] + parameters["peak"] * bell)}


# --- Two tanks one above the other: pump voltage to the level of the lower one ---


def tanks() -> Model:
    """Return Bernoulli's equations; the upper tank is known to overflow, and the sensor to end."""
    return Model(
        name="cascaded tanks",
        parameters=(
            Parameter("between", "k1", "V^.5/s", 0.05, 0.005, 0.5, "log"),
            Parameter("outflow", "k3", "V^.5/s", 0.05, 0.005, 0.5, "log"),
            Parameter("pump", "k4", "1/s", 0.05, 0.005, 0.5, "log"),
        ),
        initial=(
            Parameter("initial_upper", "x1(0)", "V", 5.0, 0.1, 15.0),
            Parameter("initial_lower", "x2(0)", "V", 5.0, 0.1, 15.0, output="level"),
        ),
        signals=(
            Signal("pump_voltage", "input", "V"),
            Signal("upper_filling", "storage", "V/s"),
            Signal("lower_filling", "storage", "V/s"),
            Signal("level", "sensor", "V"),
        ),
        start=_tanks_start,
        stepper=runge_kutta_4(_tanks_rates),
        measure=_tanks_outputs,
        max_step=2.0,
    )


def _tanks_start(parameters, initial, inputs):
    del parameters, inputs
    return {"upper": initial["initial_upper"], "lower": initial["initial_lower"]}


def _tanks_rates(parameters, state, inputs, signal):
    upper, lower = (jnp.maximum(state[name], 1e-6) for name in ("upper", "lower"))
    between = parameters["between"] * jnp.sqrt(upper)
    filled = parameters["pump"] * signal("pump_voltage", inputs["pump_voltage"]) - between
    drained = between - parameters["outflow"] * jnp.sqrt(lower)
    return {
        "upper": signal("upper_filling", filled, level=upper),
        "lower": signal("lower_filling", drained, level=lower),
    }


def _tanks_outputs(parameters, state, inputs, signal):
    del parameters, inputs
    return {"level": signal("level", state["lower"])}


# --- A positioning drive in closed loop ---

_PROPORTIONAL, _DERIVATIVE, _FORCE_PER_VOLT, _LIMIT = 160.18, 243.45, 35.15, 10.0


def drive() -> Model:
    """Return inertia, viscous friction and the controller; dry friction and a constant force are known to be there."""
    return Model(
        name="EMPS drive",
        parameters=(
            Parameter("mass", "M", "kg", 90.0, 50.0, 150.0, "log"),
            Parameter("viscous_coefficient", "Fv", "N s/m", 300.0, 50.0, 1000.0, "log"),
        ),
        initial=(
            Parameter("initial_position", "q(0)", "m", 0.0, -0.01, 0.01, output="position"),
            Parameter("initial_velocity", "q'(0)", "m/s", 0.0, -0.5, 0.5),
        ),
        signals=(
            Signal("reference", "input", "m"),
            Signal("pulse", "input", "V"),
            Signal("force", "force", "N"),
            Signal("position", "sensor", "m"),
            Signal("motor_force", "sensor", "N"),
        ),
        start=_drive_start,
        stepper=runge_kutta_4(_drive_rates),
        measure=_drive_outputs,
        max_step=1e-3,
    )


def _drive_start(parameters, initial, inputs):
    del parameters, inputs
    return {"position": initial["initial_position"], "velocity": initial["initial_velocity"]}


def _motor_force(state, reference, pulse):
    volts = _PROPORTIONAL * _DERIVATIVE * (reference - state["position"]) - _DERIVATIVE * state["velocity"]
    return _FORCE_PER_VOLT * (jnp.clip(volts, -_LIMIT, _LIMIT) + pulse)


def _drive_rates(parameters, state, inputs, signal):
    velocity = state["velocity"]
    disturbance = signal("force", 0.0, position=state["position"], velocity=velocity)
    reference, pulse = signal("reference", inputs["reference"]), signal("pulse", inputs["pulse"])
    force = _motor_force(state, reference, pulse) - parameters["viscous_coefficient"] * velocity + disturbance
    return {"position": velocity, "velocity": force / parameters["mass"]}


def _drive_outputs(parameters, state, inputs, signal):
    del parameters
    return {
        "position": signal("position", state["position"]),
        "motor_force": signal("motor_force", _motor_force(state, inputs["reference"], inputs["pulse"])),
    }


# --- A servovalve and a small cylinder with a rod, between two stops ---

PISTON, ROD = jnp.pi / 4 * 0.016**2, jnp.pi / 4 * 0.010**2
STOPS = {
    "end_stop.positive_end": (0.194, 0.22),
    "end_stop.positive_stiffness": (1e6, 3e7),
    "end_stop.negative_end": (0.0, 0.01),
    "end_stop.negative_stiffness": (1e6, 3e7),
}


def valve(duration: float) -> Model:
    """Return the open-loop valve of one area with stops; areas differ, and a dead zone is known to be there."""
    model = ehsvjax.servovalve(
        open_loop=True, piston_area=float(PISTON - ROD / 2), supply_pressure=4.35e6, mass=1.0, stiffness=0.0
    )
    return ehsvjax.effects.attach(model, STOPS, duration=duration, bank=ehsvjax.effects.BANK)
