"""Small models as a user would write them, and independent plants of the same: SciPy's linear systems, plain loops."""

import jax.numpy as jnp
import numpy as np
from scipy.signal import lsim

import ehsvjax
from ehsvjax import Model, Parameter, Signal, runge_kutta_4

# --- A carriage on a spring: m*x'' = u - c*x' - k*x - b*u*x ---

MASS, DAMPING, STIFFNESS = 2.0, 3.0, 40.0


def carriage(stiffness=STIFFNESS, mass=MASS, max_step=0.02) -> Model:
    """Return the model: its damping is identified, its mass certain, its stiffness given; b is given as zero."""
    return Model(
        name="carriage",
        parameters=(
            Parameter("damping", "c", "N s/m", 2.0, 0.5, 10.0, "log"),
            Parameter("mass", "m", "kg", mass, 0.1, 100.0, fixed=True, certain=True),
            Parameter("stiffness", "k", "N/m", stiffness, 1.0, 1e3, fixed=True),
            Parameter("modulation", "b", "1/m", 0.0, -10.0, 10.0, fixed=True),
        ),
        initial=(
            Parameter("initial_position", "x(0)", "m", 0.0, -1.0, 1.0, output="position"),
            Parameter("initial_velocity", "v(0)", "m/s", 0.0, -5.0, 5.0),
        ),
        signals=(
            Signal("push", "input", "N"),
            Signal("force", "force", "N"),
            Signal("position", "sensor", "m"),
            Signal("velocity", "sensor", "m/s"),
        ),
        start=_carriage_start,
        stepper=runge_kutta_4(carriage_rates),
        measure=_carriage_outputs,
        max_step=max_step,
    )


def _carriage_start(parameters, initial, inputs):
    del parameters, inputs
    return {"x": initial["initial_position"], "v": initial["initial_velocity"]}


def carriage_rates(parameters, state, inputs, signal):
    x, v, u = state["x"], state["v"], signal("push", inputs["push"])
    driving = u * (1.0 - parameters["modulation"] * x) + signal("force", 0.0, position=x, velocity=v)
    return {"x": v, "v": (driving - parameters["damping"] * v - parameters["stiffness"] * x) / parameters["mass"]}


def _carriage_outputs(parameters, state, inputs, signal):
    del parameters, inputs
    return {"position": signal("position", state["x"]), "velocity": signal("velocity", state["v"])}


def carriage_plant(push, period, *, stiffness=STIFFNESS, damping=DAMPING, mass=MASS, straight=False) -> np.ndarray:
    """Return position and velocity [time, 2], exactly, of a push that is held, or runs straight from value to value."""
    system = [[0.0, 1.0], [-stiffness / mass, -damping / mass]], [[0.0], [1.0 / mass]], np.eye(2), np.zeros((2, 1))
    time = np.arange(len(push)) * period
    return lsim(system, push, time, interp=straight)[1]


def driven_plant(push, period, *, limit, lag) -> np.ndarray:
    """Return the position [time], exactly, of a carriage whose drive ends at a force, and then lags: held pushes."""
    system = (
        [[-1.0 / lag, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0 / MASS, -STIFFNESS / MASS, -DAMPING / MASS]],
        [[1.0 / lag], [0.0], [0.0]], [[0.0, 1.0, 0.0]], [[0.0]],
    )  # fmt: skip
    return lsim(system, np.clip(push, -limit, limit), np.arange(len(push)) * period, interp=False)[1]


def modulated_plant(push, period, modulation, steps=40) -> np.ndarray:
    """Return the position [time] of a carriage whose push depends on where it is, by the trapezoidal rule."""
    h, x, v, found = period / steps, 0.0, 0.0, []
    for u in push:
        found.append(x)
        for _ in range(steps):
            rate = (u * (1.0 - modulation * x) - DAMPING * v - STIFFNESS * x) / MASS
            ahead, faster = x + h * v, v + h * rate
            there = (u * (1.0 - modulation * ahead) - DAMPING * faster - STIFFNESS * ahead) / MASS
            x, v = x + 0.5 * h * (v + faster), v + 0.5 * h * (rate + there)
    return np.array(found)


def wandering(rng, samples, rms) -> np.ndarray:
    """Return a push [time] that wanders and comes back."""
    push = np.cumsum(rng.normal(0.0, 1.0, samples))
    push -= np.linspace(push[0], push[-1], samples)
    return push * (rms / push.std())


def one_way_plant(push, period, *, back, forth, steps=20) -> np.ndarray:
    """Return the position [time] of a carriage that is damped otherwise on its way back, in short steps."""
    h, x, v, found = period / steps, 0.0, 0.0, []
    for u in push:
        found.append(x)
        for _ in range(steps):
            rate = (u - (forth if v > 0.0 else back) * v - STIFFNESS * x) / MASS
            x, v = x + h * v + 0.5 * h * h * rate, v + h * rate
    return np.array(found)


def hysteretic_plant(push, period, *, stiffness, beta, gamma, steps=20) -> np.ndarray:
    """Return the position [time] of a carriage on a spring of Bouc and Wen beside its own, in steps of Runge-Kutta."""

    def rates(state, u):
        x, v, z = state
        force = u - DAMPING * v - STIFFNESS * x - stiffness * z
        return np.array([v, force / MASS, v - beta * abs(v) * z - gamma * v * abs(z)])

    h, state, found = period / steps, np.zeros(3), []
    for u in push:
        found.append(state[0])
        for _ in range(steps):
            first = rates(state, u)
            second = rates(state + 0.5 * h * first, u)
            third = rates(state + 0.5 * h * second, u)
            state = state + h / 6.0 * (first + 2.0 * second + 2.0 * third + rates(state + h * third, u))
    return np.array(found)


# --- Two tanks, as of the benchmark of cascaded tanks: pump voltage to the level of the lower one ---

OUTFLOW, BETWEEN, PUMP = 0.5, 0.4, 0.6


def tanks() -> Model:
    """Return the model: x1' = k4*u - k1*sqrt(x1), x2' = k2*sqrt(x1) - k3*sqrt(x2); all of them but k3 are known."""
    return Model(
        name="tanks",
        parameters=(
            Parameter("pump", "k4", "m/(s V)", 0.5, 0.1, 2.0, "log"),
            Parameter("outflow", "k3", "m^0.5/s", 0.4, 0.1, 2.0, "log"),
            Parameter("between", "k1", "m^0.5/s", BETWEEN, 0.1, 2.0, fixed=True, certain=True),
        ),
        initial=(
            Parameter("initial_upper", "x1(0)", "m", 1.0, 0.1, 5.0),
            Parameter("initial_lower", "x2(0)", "m", 1.0, 0.1, 5.0, output="lower"),
        ),
        signals=(
            Signal("voltage", "input", "V"),
            Signal("filling", "storage", "m/s"),
            Signal("lower", "sensor", "m"),
        ),
        start=_tanks_start,
        stepper=runge_kutta_4(_tanks_rates),
        measure=_tanks_outputs,
        max_step=0.05,
    )


def _tanks_start(parameters, initial, inputs):
    del parameters, inputs
    return {"upper": initial["initial_upper"], "lower": initial["initial_lower"]}


def _root(level):
    return jnp.sqrt(jnp.maximum(level, 1e-6))


def _tanks_rates(parameters, state, inputs, signal):
    through = parameters["between"] * _root(state["upper"])
    filling = parameters["pump"] * signal("voltage", inputs["voltage"]) - through
    filling = signal("filling", filling, level=state["upper"])
    return {"upper": filling, "lower": through - parameters["outflow"] * _root(state["lower"])}


def _tanks_outputs(parameters, state, inputs, signal):
    del parameters, inputs
    return {"lower": signal("lower", state["lower"])}


def tanks_plant(voltage, period, *, brim=np.inf, least=0.0, start=(1.0, 1.0), steps=100) -> np.ndarray:
    """Return the levels [time, 2] of tanks, of which the upper one is full at its brim: the rest is spilled.

    At its least level it is filled up at once.
    """
    h, (upper, lower), found = period / steps, start, []
    for u in voltage:
        found.append((upper, lower))
        for _ in range(steps):
            through = BETWEEN * upper**0.5
            upper = max(min(upper + h * (PUMP * u - through), brim), least)
            lower = lower + h * (through - OUTFLOW * lower**0.5)
    return np.array(found)


def record_of(period, inputs, outputs, noise, seed, name="bench", **about) -> ehsvjax.Record:
    """Return a record with white noise of these deviations on its outputs, by name."""
    rng = np.random.default_rng(seed)
    noisy = {name: series + noise[name] * rng.standard_normal(len(series)) for name, series in outputs.items()}
    count = len(next(iter(inputs.values())))
    return ehsvjax.Record(np.arange(count) * period, inputs, noisy, name=name, **about)


# --- A damper that is moved: its force acts in what is measured alone ---


def damper() -> Model:
    """Return a damper of viscous friction whose force is measured while it is moved."""

    def start(parameters, initial, inputs):
        del parameters, initial
        return {"x": inputs["displacement"]}

    def rates(parameters, state, inputs, signal):
        del parameters
        return {"x": (signal("displacement", inputs["displacement"]) - state["x"]) / 0.01}

    def measure(parameters, state, inputs, signal):
        velocity = (inputs["displacement"] - state["x"]) / 0.01
        friction = signal("friction", 0.0, position=state["x"], velocity=velocity)
        return {"force": signal("force", parameters["coefficient"] * velocity - friction)}

    return Model(
        name="damper",
        parameters=(Parameter("coefficient", "c", "N s/m", 100.0, 10.0, 1e3, "log"),),
        initial=(),
        signals=(
            Signal("displacement", "input", "m"),
            Signal("friction", "force", "N"),
            Signal("force", "sensor", "N"),
        ),
        start=start,
        stepper=runge_kutta_4(rates),
        measure=measure,
        max_step=0.005,
    )


# --- A ball on a beam: y'' = g*u - d*y', which nothing holds ---


def ball() -> Model:
    """Return the model of a ball that rolls along a beam, from the beam's angle."""
    return Model(
        name="ball on a beam",
        parameters=(
            Parameter("gain", "g", "m/s^2", 5.0, 0.5, 50.0, "log"),
            Parameter("damping", "d", "1/s", 0.1, 1e-3, 5.0, "log"),
        ),
        initial=(
            Parameter("initial_position", "y(0)", "m", 0.0, -0.3, 0.3, output="position"),
            Parameter("initial_velocity", "v(0)", "m/s", 0.0, -0.5, 0.5),
        ),
        signals=(Signal("angle", "input", "rad"), Signal("force", "force", "m/s^2"), Signal("position", "sensor", "m")),
        start=lambda parameters, initial, inputs: {"y": initial["initial_position"], "v": initial["initial_velocity"]},
        stepper=runge_kutta_4(_ball_rates),
        measure=lambda parameters, state, inputs, signal: {"position": signal("position", state["y"])},
        max_step=0.02,
    )


def _ball_rates(parameters, state, inputs, signal):
    pushed = parameters["gain"] * signal("angle", inputs["angle"]) - parameters["damping"] * state["v"]
    return {"y": state["v"], "v": pushed + signal("force", 0.0, position=state["y"], velocity=state["v"])}


def shaken_ball(angle, period, density, rng, *, gain=5.0, damping=0.5, stiffness=0.0, steps=10) -> np.ndarray:
    """Return the motion of a ball under a white random force of some spectral density, (m/s^2)^2 s, in small steps."""
    step = period / steps
    position = velocity = 0.0
    found = np.zeros(len(angle))
    for k, held in enumerate(angle):
        found[k] = position
        for force in rng.normal(0.0, np.sqrt(density / step), steps):
            acceleration = gain * held - damping * velocity - stiffness * position + force
            position += step * velocity + 0.5 * step**2 * acceleration
            velocity += step * acceleration
    return found
