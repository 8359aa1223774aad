"""What does a diagnosis make of rigs from other fields, and of what goes wrong on any bench?

    python benchmarks/other_fields.py [--draws 2] [--seed 0]

Rigs: an oven that radiates, a pendulum, a hysteretic spring, a vehicle with and without hills, a shaft with a gap, a
tachometer without sign, each in short steps of its own, each diagnosed with the simple model that one would write down
first. Faults: a carriage on a spring whose record or surroundings are not what they seem (a hum, a clock that runs
fast, an input that is read with noise, readings that repeat the one before, a sensor that averages, ...), of which the
bank has some. Right is an answer that holds what is hidden, alone or in a group; where the bank lacks it, one that
names nothing else. False is a cause that is neither what is hidden nor left open to be something else.
"""

import argparse
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))

import jax
import numba
import numpy as np
import pandas as pd
from scipy.signal import lfilter, lsim

import ehsvjax
from benchmarks.processes import rows_of, said
from ehsvjax import Model, Parameter, Signal, runge_kutta_4
from ehsvjax.diagnosis import Diagnosis
from ehsvjax.diagnosis.decision.verdict import PROCESS_NOISE, UNKNOWN

_compiled = numba.njit(cache=True)


class Rig(NamedTuple):
    """A record, the model that one would write down first, and the causes that say what is hidden, if any do."""

    hidden: str
    said_by: frozenset[str]
    model: Model
    record: ehsvjax.Record


# --- Models ---


def machine(name: str, mass: float, damping: float, stiffness: float, step: float) -> Model:
    """Return m*x'' = u - c*x' - k*x, everything in wide bounds."""

    def rates(parameters, state, inputs, signal):
        x, v = state["x"], state["v"]
        force = signal("push", inputs["push"]) + signal("force", 0.0, position=x, velocity=v)
        return {"x": v, "v": (force - parameters["damping"] * v - parameters["stiffness"] * x) / parameters["mass"]}

    guesses = {"mass": ("m", "kg", mass), "damping": ("c", "N s/m", damping), "stiffness": ("k", "N/m", stiffness)}
    return Model(
        name=name,
        parameters=tuple(Parameter(n, s, u, g, g / 10.0, g * 10.0, "log") for n, (s, u, g) in guesses.items()),
        initial=(
            Parameter("initial_position", "x(0)", "m", 0.0, -1.0, 1.0, output="position"),
            Parameter("initial_velocity", "v(0)", "m/s", 0.0, -5.0, 5.0),
        ),
        signals=(Signal("push", "input", "N"), Signal("force", "force", "N"), Signal("position", "sensor", "m")),
        start=lambda parameters, initial, inputs: {"x": initial["initial_position"], "v": initial["initial_velocity"]},
        stepper=runge_kutta_4(rates),
        measure=lambda parameters, state, inputs, signal: {"position": signal("position", state["x"])},
        max_step=step,
    )


def vehicle_model() -> Model:
    """Return m*v' = F - b*v, of which the speed is measured."""

    def rates(parameters, state, inputs, signal):
        v = state["v"]
        force = signal("traction", inputs["traction"]) + signal("force", 0.0, position=state["x"], velocity=v)
        return {"x": v, "v": (force - parameters["drag"] * v) / parameters["mass"]}

    return Model(
        name="vehicle",
        parameters=(
            Parameter("mass", "m", "kg", 1000.0, 300.0, 4000.0, "log"),
            Parameter("drag", "b", "N s/m", 20.0, -100.0, 200.0),
        ),
        initial=(Parameter("initial_speed", "v(0)", "m/s", 10.0, 0.0, 40.0, output="speed"),),
        signals=(Signal("traction", "input", "N"), Signal("force", "force", "N"), Signal("speed", "sensor", "m/s")),
        start=lambda parameters, initial, inputs: {"x": 0.0, "v": initial["initial_speed"]},
        stepper=runge_kutta_4(rates),
        measure=lambda parameters, state, inputs, signal: {"speed": signal("speed", state["v"])},
        max_step=0.5,
    )


def oven_model() -> Model:
    """Return C*T' = P - k*T, the temperature above that of the room."""

    def rates(parameters, state, inputs, signal):
        warmer = state["warmer"]
        heat = signal("power", inputs["power"]) + signal("heat", 0.0, position=warmer)
        return {"warmer": (heat - parameters["loss"] * warmer) / parameters["capacity"]}

    return Model(
        name="oven",
        parameters=(
            Parameter("capacity", "C", "J/K", 300.0, 50.0, 2000.0, "log"),
            Parameter("loss", "k", "W/K", 1.0, 0.1, 10.0, "log"),
        ),
        initial=(Parameter("initial_warmth", "T(0)", "K", 10.0, -20.0, 100.0, output="warmth"),),
        signals=(Signal("power", "input", "W"), Signal("heat", "force", "W"), Signal("warmth", "sensor", "K")),
        start=lambda parameters, initial, inputs: {"warmer": initial["initial_warmth"]},
        stepper=runge_kutta_4(rates),
        measure=lambda parameters, state, inputs, signal: {"warmth": signal("warmth", state["warmer"])},
        max_step=10.0,
    )


def shaft_model() -> Model:
    """Return two masses on a shaft, of which both angles are measured."""

    def rates(parameters, state, inputs, signal):
        twist = signal("twist", state["motor"] - state["load"])
        torque = parameters["stiffness"] * twist + 0.05 * (state["motor_speed"] - state["load_speed"])
        driving = signal("torque", inputs["torque"]) - 0.05 * state["motor_speed"] - torque
        resisted = torque - parameters["friction"] * state["load_speed"]
        resisted += signal("load_torque", 0.0, position=state["load"], velocity=state["load_speed"])
        return {
            "motor": state["motor_speed"],
            "load": state["load_speed"],
            "motor_speed": driving / parameters["motor_inertia"],
            "load_speed": resisted / parameters["load_inertia"],
        }

    return Model(
        name="shaft",
        parameters=(
            Parameter("stiffness", "k", "N m/rad", 100.0, 20.0, 500.0, "log"),
            Parameter("motor_inertia", "J1", "kg m^2", 0.02, 0.004, 0.1, "log"),
            Parameter("load_inertia", "J2", "kg m^2", 0.05, 0.01, 0.25, "log"),
            Parameter("friction", "d", "N m s/rad", 0.1, 0.01, 1.0, "log"),
        ),
        initial=(
            Parameter("initial_motor", "a(0)", "rad", 0.0, -1.0, 1.0, output="motor_angle"),
            Parameter("initial_load", "b(0)", "rad", 0.0, -1.0, 1.0, output="load_angle"),
        ),
        signals=(
            Signal("torque", "input", "N m"),
            Signal("twist", "displacement", "rad"),
            Signal("load_torque", "force", "N m"),
            Signal("motor_angle", "sensor", "rad"),
            Signal("load_angle", "sensor", "rad"),
        ),
        start=lambda parameters, initial, inputs: {
            "motor": initial["initial_motor"], "load": initial["initial_load"], "motor_speed": 0.0, "load_speed": 0.0,
        },
        stepper=runge_kutta_4(rates),
        measure=lambda parameters, state, inputs, signal: {
            "motor_angle": signal("motor_angle", state["motor"]), "load_angle": signal("load_angle", state["load"]),
        },
        max_step=1e-3,
    )  # fmt: skip


def drive_model() -> Model:
    """Return a motor with a lag, which drives a mass by a belt; its speed is measured."""

    def rates(parameters, state, inputs, signal):
        motor = parameters["rate"] * (signal("voltage", inputs["voltage"]) - state["motor"])
        return {
            "motor": motor,
            "speed": parameters["coupling"] * (parameters["gain"] * state["motor"] - state["speed"]),
        }

    return Model(
        name="drive",
        parameters=(
            Parameter("rate", "r", "1/s", 2.0, 0.2, 20.0, "log"),
            Parameter("coupling", "w", "1/s", 20.0, 2.0, 200.0, "log"),
            Parameter("gain", "g", "rad/(s V)", 1.0, 0.1, 10.0, "log"),
        ),
        initial=(Parameter("initial_speed", "v(0)", "rad/s", 0.0, -3.0, 3.0, output="speed"),),
        signals=(Signal("voltage", "input", "V"), Signal("speed", "sensor", "rad/s")),
        start=lambda parameters, initial, inputs: {"motor": 0.0, "speed": initial["initial_speed"]},
        stepper=runge_kutta_4(rates),
        measure=lambda parameters, state, inputs, signal: {"speed": signal("speed", state["speed"])},
        max_step=0.01,
    )


# --- Rigs ---


def levels(rng, low: float, high: float, samples: int, held: int) -> np.ndarray:
    """Return levels, each held for so many samples, `[time]`."""
    return np.repeat(rng.uniform(low, high, -(-samples // held)), held)[:samples]


def _record(period: float, inputs, outputs, deviation: float, rng) -> ehsvjax.Record:
    noisy = {name: series + deviation * rng.standard_normal(len(series)) for name, series in outputs.items()}
    return ehsvjax.Record(period * np.arange(len(next(iter(inputs.values())))), inputs, noisy)


def oven(rng) -> Rig:
    """Return an oven in a room of 295 K that loses heat by radiation too."""
    power, temperature, shown = levels(rng, 0.0, 200.0, 2000, 50), 320.0, []
    for heat in power:
        shown.append(temperature - 295.0)
        for _ in range(20):
            loss = temperature - 295.0 + 3e-9 * (temperature**4 - 295.0**4)
            temperature += 0.5 * (heat - loss) / 400.0
    record = _record(10.0, {"power": power}, {"warmth": np.array(shown)}, 0.1, rng)
    powers = frozenset({"quadratic_stiffness", "cubic_stiffness", "quintic_stiffness"})
    return Rig("radiation, the fourth power of the temperature", powers, oven_model(), record)


@_compiled
def _swung(torque, period, steps):
    h, x, v, shown = period / steps, 0.1, 0.0, np.zeros(len(torque))
    for k in range(len(torque)):
        shown[k] = x
        for _ in range(steps):
            rate = (torque[k] - 0.4 * v - 5.0 * np.sin(x)) / 0.5
            ahead, faster = x + 0.5 * h * v, v + 0.5 * h * rate
            v += h * (torque[k] - 0.4 * faster - 5.0 * np.sin(ahead)) / 0.5
            x += h * faster
    return shown


def pendulum(rng) -> Rig:
    """Return a pendulum that swings far, but not over."""
    torque = levels(rng, -2.5, 2.5, 3000, 75)
    record = _record(0.01, {"push": torque}, {"position": _swung(torque, 0.01, 40)}, 2e-3, rng)
    odd = frozenset({"cubic_stiffness", "quintic_stiffness"})
    return Rig("the sine of the angle", odd, machine("pendulum", 0.5, 0.4, 5.0, 0.01), record)


@_compiled
def _hysteretic(push, period, steps):
    h, state, shown = period / steps, np.zeros(3), np.zeros(len(push))
    rate = np.zeros((4, 3))
    for k in range(len(push)):
        shown[k] = state[0]
        for _ in range(steps):
            for stage in range(4):
                x, v, z = state if stage == 0 else state + (h if stage == 3 else 0.5 * h) * rate[stage - 1]
                rate[stage, 0], rate[stage, 1] = v, (push[k] - 10.0 * v - 5e4 * x - z) / 2.0
                rate[stage, 2] = 5e4 * v - 1e3 * (0.8 * np.abs(v) * z - 1.1 * v * np.abs(z))
            state = state + h / 6.0 * (rate[0] + 2.0 * rate[1] + 2.0 * rate[2] + rate[3])
    return shown


def hysteretic_spring(rng) -> Rig:
    """Return the oscillator of the benchmark of Bouc and Wen (Noël & Schoukens 2016), its numbers, a multisine."""
    samples, period = 6144, 1.0 / 750.0
    frequencies = np.arange(5.0, 150.0, 750.0 / 8192)
    phases = rng.uniform(0.0, 2.0 * np.pi, len(frequencies))
    push = np.cos(2.0 * np.pi * frequencies * period * np.arange(samples)[:, None] + phases).sum(axis=1)
    push *= 50.0 / push.std()
    record = _record(period, {"push": push}, {"position": _hysteretic(push, period, 20)}, 8e-6, rng)
    model = machine("oscillator", 2.0, 20.0, 8e4, period / 2.0)
    return Rig("a spring of Bouc and Wen", frozenset({"elastic_friction"}), model, record)


def _driven(traction, period: float, hills: float, drag: Callable[[float], float]) -> np.ndarray:
    x, v, shown = 0.0, 12.0, []
    for force in traction:
        shown.append(v)
        for _ in range(50):
            hill = 1200.0 * 9.81 * hills * np.exp(-(((x % 4000.0 - 2000.0) / 150.0) ** 2))
            v += period / 50.0 * (force - drag(v) - hill) / 1200.0
            x += period / 50.0 * v
    return np.array(shown)


def vehicle(rng) -> Rig:
    """Return a vehicle on a flat road: drag by the square of its speed, and what rolling takes."""
    traction = levels(rng, 300.0, 1500.0, 1500, 40)
    speed = _driven(traction, 0.5, 0.0, lambda v: 0.45 * v**2 + 130.0 * np.sign(v))
    # It only goes forward: rolling is a constant, a bias of the traction, friction.
    rolling = {"constant_force", "input_bias", "coulomb_friction", "input_dead_zone", "stribeck_friction"}
    said_by = frozenset({"quadratic_damping", *rolling})
    record = _record(0.5, {"traction": traction}, {"speed": speed}, 0.05, rng)
    return Rig("drag by the square of the speed, rolling friction", said_by, vehicle_model(), record)


def hills(rng) -> Rig:
    """Return a vehicle on a road with a hill every 4 km, which no candidate is."""
    traction = levels(rng, 300.0, 1500.0, 1500, 40)
    speed = _driven(traction, 0.5, 0.02, lambda v: 25.0 * v)
    record = _record(0.5, {"traction": traction}, {"speed": speed}, 0.05, rng)
    return Rig("hills of a road", frozenset(), vehicle_model(), record)


@_compiled
def _twisted(torque, period, steps, gap):
    h, shown = period / steps, np.zeros((len(torque), 2))
    motor = load = motor_speed = load_speed = 0.0
    for k in range(len(torque)):
        shown[k, 0], shown[k, 1] = motor, load
        for _ in range(steps):
            twist = motor - load
            held = twist - min(max(twist, -gap), gap)
            through = 120.0 * held + 0.05 * (motor_speed - load_speed)
            motor_speed += h * (torque[k] - 0.05 * motor_speed - through) / 0.02
            load_speed += h * (through - 0.1 * load_speed) / 0.05
            motor += h * motor_speed
            load += h * load_speed
    return shown


def shaft(rng) -> Rig:
    """Return two masses on a shaft with a gap of 0.02 rad to either side."""
    torque = levels(rng, -3.0, 3.0, 2500, 100)
    angles = _twisted(torque, 2e-3, 40, 0.02)
    outputs = {"motor_angle": angles[:, 0], "load_angle": angles[:, 1]}
    record = _record(2e-3, {"torque": torque}, outputs, 1e-3, rng)
    return Rig("a gap in the shaft", frozenset({"dead_zone"}), shaft_model(), record)


def tachometer(rng) -> Rig:
    """Return a drive whose speed is counted, without its sign."""
    voltage, motor, speed, shown = levels(rng, -1.0, 2.0, 500, 25), 0.0, 0.0, []
    for volts in voltage:
        shown.append(abs(speed))
        for _ in range(100):
            motor += 2e-4 * 2.0 * (volts - motor)
            speed += 2e-4 * 20.0 * (motor - speed)
    record = _record(0.02, {"voltage": voltage}, {"speed": np.array(shown)}, 0.01, rng)
    return Rig("a speed without its sign", frozenset({"sensor_asymmetry"}), drive_model(), record)


RIGS = (oven, pendulum, hysteretic_spring, vehicle, hills, shaft, tachometer)

# --- Faults of any bench, on a carriage on a spring ---

PERIOD, SAMPLES, NOISE = 0.01, 3000, 2e-4
TIME = PERIOD * np.arange(SAMPLES)


def _carried(push, period=PERIOD) -> np.ndarray:
    system = [[0.0, 1.0], [-100.0, -4.0]], [[0.0], [0.5]], [[1.0, 0.0]], [[0.0]]
    return lsim(system, push, period * np.arange(len(push)), interp=False)[1]


@_compiled
def _stepped(push, kind, steps):
    h, x, v, shown = 0.01 / steps, 0.0, 0.0, np.zeros(len(push))
    for k in range(len(push)):
        shown[k] = x
        for _ in range(steps):
            force, damping, stiffness = push[k], 8.0, 200.0
            if kind == 0 and k * 0.01 > 15.0:
                damping = 16.0
            if kind == 1 and x > 0.02:
                stiffness = 260.0
            if kind == 2:
                force -= np.sign(v) * (1.0 + 40.0 * np.abs(x))
            if kind == 3 and np.abs(v) > 0.1:
                force *= 0.8
            v += h * (force - damping * v - stiffness * x) / 2.0
            x += h * v
    return shown


def _stuck(shown, rng):
    repeats = np.flatnonzero(rng.random(len(shown)) < 0.05)
    for k in repeats[repeats > 0]:
        shown[k] = shown[k - 1]
    return shown


def faults(rng) -> list[Rig]:
    """Return records of a carriage, each with one thing wrong."""
    push = levels(rng, -10.0, 10.0, SAMPLES, 60)
    there, noise = _carried(push), NOISE * rng.standard_normal(SAMPLES)
    fast = rng.standard_normal(SAMPLES)
    slow = lfilter([np.sqrt(1.0 - 0.98**2)], [1.0, -0.98], rng.standard_normal(SAMPLES))
    shown: dict[str, tuple[set[str], np.ndarray, np.ndarray]] = {
        "nothing": (set(), push, there + noise),
        "the time of all stamps is 3% too short": (set(), push, _carried(push, 1.03 * PERIOD) + noise),
        "1% of the readings are zero": (set(), push, np.where(rng.random(SAMPLES) < 0.01, 0.0, there) + noise),
        "5% of the readings repeat the one before": (set(), push, _stuck(there + noise, rng)),
        "a hum of 17.3 Hz": ({"sensor_hum", "harmonic_force"}, push,
                             there + 1e-3 * np.sin(2.0 * np.pi * 17.3 * TIME + 1.0) + noise),
        "the sensor's zero walks": ({"sensor_drift"}, push, there + np.cumsum(0.5 * noise)),
        "the sensor averages over 9 samples": ({"transport_delay", "input_lag", "sensor_lag"}, push,
                                               np.convolve(there, np.ones(9) / 9.0)[:SAMPLES] + noise),
        "the sensor's clock runs 0.2% fast": ({"transport_delay"}, push, np.interp(1.002 * TIME, TIME, there) + noise),
        "the push is read with white noise": ({PROCESS_NOISE}, push + 0.5 * fast, there + noise),
        "the push is read with slow noise": ({PROCESS_NOISE}, push + 0.5 * slow, there + noise),
        "the damping doubles half way": ({"parameter_drift@damping"}, push, _stepped(push, 0, 20) + noise),
        "a spring that is stiffer beyond 20 mm": (
            {"quadratic_stiffness", "cubic_stiffness", "quintic_stiffness"}, push, _stepped(push, 1, 20) + noise),
        "friction that grows with the stroke": (
            {"coulomb_friction", "stribeck_friction"}, push, _stepped(push, 2, 20) + noise),
        "the push loses 20% in fast motion": (set(), push, _stepped(push, 3, 20) + noise),
    }  # fmt: skip
    model = machine("carriage", 2.0, 6.0, 150.0, PERIOD)
    return [
        Rig(hidden, frozenset(said_by), model, ehsvjax.Record(TIME, {"push": read}, {"position": position}))
        for hidden, (said_by, read, position) in shown.items()
    ]


# --- What is made of them ---


def answer(found: Diagnosis, said_by: frozenset[str]) -> str:
    """Return "right", "left open" or "false" and the causes that are."""
    groups = [dict(zip(a.causes, a.probabilities, strict=True)) for a in found.alternatives]
    groups += [{c.name: c.probability} for c in found.causes if not any(c.name in group for group in groups)]
    open_ones = {UNKNOWN, PROCESS_NOISE}
    named = {name for group in groups for name in group}
    # At another signal it is another cause.
    meant = {name for name in named if {name, name.partition("@")[0]} & said_by}
    false = [next(iter(group)) for group in groups if not set(group) & (meant | open_ones)]
    if false:
        return f"false: {', '.join(false)}"
    return "right" if meant or (found.verdict == "adequate" and not said_by) else "left open"


def tried(trials: list[tuple[int, int]]) -> list[dict[str, Any]]:
    """Diagnose the rig, or the fault behind the rigs, of each number, drawn by the seed."""
    rows = []
    for number, seed in trials:
        rng = np.random.default_rng(seed)
        rig = RIGS[number](rng) if number < len(RIGS) else faults(rng)[number - len(RIGS)]
        row: dict[str, Any] = {"rig": rig.model.name, "hidden": rig.hidden}
        key = jax.random.key(seed)
        began = time.perf_counter()
        try:
            fit = ehsvjax.identify(rig.model, rig.record, key=key, population=60, generations=40)
            found = ehsvjax.diagnose(fit, rig.record, key=key, progress=False)
            row |= said(found) | {"answer": answer(found, rig.said_by), "says": str(found).splitlines()[0]}
        except Exception:
            row |= {"answer": "crashed", "error": traceback.format_exc()}
        rows.append(row | {"seconds": time.perf_counter() - began})
    return rows


def main() -> None:
    """Diagnose all and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=2, help="of every rig and fault")
    parser.add_argument("--seed", type=int, default=0, help="of all trials")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    count = len(RIGS) + len(faults(rng))
    trials = [(number, int(rng.integers(2**31))) for number in range(count) for _ in range(options.draws)]
    table = pd.DataFrame(rows_of(tried, trials, lambda t: min(t[0], len(RIGS)), options.out / "other_fields.json"))
    kinds = table["answer"].str.partition(":")[0]
    print(kinds.value_counts().to_string())
    print(
        f"seconds, identification included: median {table['seconds'].median():.0f}, most {table['seconds'].max():.0f}"
    )
    for (rig, hidden), rows in table.groupby(["rig", "hidden"], sort=False):
        print(f"\n{rig}, {hidden}:")
        for _, row in rows.iterrows():
            print(f"  {row['answer']}: {row.get('says', row.get('error'))} ({row['seconds']:.0f} s)")


if __name__ == "__main__":
    main()
