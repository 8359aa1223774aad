"""Independent plants with hidden effects: a servovalve and a Van der Pol oscillator, in loops that Numba compiles.

Nothing of the package is used here. Every record of a batch has its own effects, which the model to be diagnosed may
or may not have; those named unknown_* are in no bank. SI units; a Gaussian of a given width is exp(-(z/width)^2/2).

The load is stiff where the spool closes. It is stepped by Alexander's L-stable diagonally implicit Runge-Kutta method
of two stages and second order, and each stage has a closed form: with w the signed root of the pressure drop, velocity
and load pressure are linear in w and w|w|, and so the stage is a quadratic equation in w. Leakage and compressibility
stay within that form. The spool's filter is propagated exactly for an input that is linear over a step.
"""

import math
from collections import namedtuple
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numba
import numpy as np

ANY_PHASE = (0.0, 0.0, 2.0 * math.pi)
# Effect: parameter: (value that means absent, smallest, largest plausible size). Signed effects may be negated. Depths
# are fractions. The oscillator's sizes move its position by about 1 to 20 % of its rms, for levels in +-1 held 1 s.
SERVOVALVE_EFFECTS = {
    "coulomb_friction": {"force": (0.0, 500.0, 3500.0)},
    "stribeck_friction": {"force": (0.0, 200.0, 2000.0), "velocity": (1.0, 5e-3, 5e-2)},
    "viscous_friction": {"coefficient": (0.0, 500.0, 5000.0)},
    "null_bias": {"bias": (0.0, 3e-5, 9e-5)},
    "asymmetric_dead_zone": {"asymmetry": (0.0, 0.1, 0.5)},
    "null_leakage": {"ratio": (0.0, 0.05, 0.3)},
    "cross_piston_leakage": {"coefficient": (0.0, 1e-13, 1e-11)},
    "supply_droop": {"resistance": (0.0, 4.3e8, 1.7e9)},
    "return_pressure": {"pressure": (0.0, 2e5, 1e6)},
    "oil_compressibility": {"capacitance": (0.0, 5e-14, 3e-13)},
    "structural_flexibility": {"stiffness": (np.inf, 1e7, 1e8)},
    "spool_rate_limit": {"rate": (np.inf, 0.2, 1.0)},
    "torque_motor_hysteresis": {"width": (0.0, 3e-5, 1.5e-4)},
    "feedback_backlash": {"width": (0.0, 5e-5, 5e-4)},
    "transport_delay": {"delay": (0.0, 1e-3, 5e-3)},
    "sensor_lag": {"time_constant": (0.0, 1e-3, 5e-3)},
    "sensor_gain": {"error": (0.0, 2e-3, 2e-2)},
    "sensor_asymmetry": {"error": (0.0, 2e-3, 2e-2)},
    "sensor_bias": {"bias": (0.0, 1e-4, 1e-3)},
    "sensor_drift": {"drift": (0.0, 2e-4, 2e-3)},
    "sensor_hum": {"amplitude": (0.0, 5e-5, 1e-3), "frequency": (0.0, 20.0, 1500.0), "phase": ANY_PHASE},
    "sensor_saturation": {"limit": (np.inf, 0.03, 0.05)},
    "sensor_quantisation": {"step": (0.0, 2e-5, 5e-4)},
    "hardening_spring": {"coefficient": (0.0, 5.6e5, 2.8e6)},
    "constant_load": {"force": (0.0, 100.0, 3000.0)},
    "area_asymmetry": {"asymmetry": (0.0, 0.05, 0.5)},
    "area_ratio": {"ratio": (1.0, 0.5, 0.95)},
    "end_stop": {"position": (np.inf, 0.02, 0.04), "stiffness": (0.0, 1e7, 1e8)},
    "flow_gain_drift": {"drift": (0.0, 0.02, 0.1)},
    "flow_gain_rounding": {"width": (0.0, 1e-5, 1e-4)},
    "flow_gain_curvature": {"curvature": (0.0, 0.05, 0.1)},
    "harmonic_load": {"force": (0.0, 100.0, 1000.0), "frequency": (0.0, 5.0, 60.0), "phase": ANY_PHASE},
    "unknown_position_dependent_supply": {
        "depth": (0.0, 0.1, 0.4),
        "place": (0.0, -0.03, 0.03),
        "width": (1.0, 5e-3, 0.015),
    },
    "unknown_spool_notch": {"depth": (0.0, 0.1, 0.4), "place": (0.0, 5e-4, 2e-3), "width": (1.0, 1e-4, 4e-4)},
    "unknown_cogging": {"force": (0.0, 300.0, 3000.0), "pitch": (1.0, 5e-3, 2e-2)},
}
VAN_DER_POL_EFFECTS = {
    "cubic_stiffness": {"coefficient": (0.0, 5e-4, 6e-3)},
    "quintic_stiffness": {"coefficient": (0.0, 1.5e-4, 2e-3)},
    "quadratic_stiffness": {"coefficient": (0.0, 5e-3, 0.04)},
    "linear_damping": {"coefficient": (0.0, 0.01, 0.12)},
    "rayleigh_damping": {"coefficient": (0.0, 1e-3, 0.01)},
    "quadratic_damping": {"coefficient": (0.0, 2e-3, 0.025)},
    "coulomb_friction": {"force": (0.0, 0.01, 0.1)},
    "elastic_friction": {"stiffness": (0.0, 0.05, 0.4), "length": (1.0, 0.1, 0.4)},
    "one_way_damping": {"coefficient": (0.0, 0.01, 0.1)},
    "asymmetric_damping": {"offset": (0.0, 0.01, 0.09)},
    "damping_threshold": {"threshold": (1.0, 1.01, 1.12)},
    "constant_force": {"force": (0.0, 0.01, 0.08)},
    "input_gain": {"error": (0.0, 0.01, 0.1)},
    "transport_delay": {"delay": (0.0, 0.02, 0.2)},
    "input_lag": {"time_constant": (0.0, 0.02, 0.25)},
    "input_dead_zone": {"width": (0.0, 5e-3, 0.05)},
    "input_saturation": {"limit": (np.inf, 0.75, 0.95)},
    "parameter_drift": {"drift": (0.0, 0.02, 0.17)},
    "harmonic_force": {"force": (0.0, 0.02, 0.1), "frequency": (0.0, 0.3, 5.0), "phase": ANY_PHASE},
    "parametric_excitation": {"depth": (0.0, 0.02, 0.1), "frequency": (0.0, 0.3, 5.0), "phase": ANY_PHASE},
    "sensor_bias": {"bias": (0.0, 0.02, 0.2)},
    "sensor_hum": {"amplitude": (0.0, 0.02, 0.2), "frequency": (0.0, 0.3, 60.0), "phase": ANY_PHASE},
    "sensor_gain": {"error": (0.0, 0.01, 0.1)},
    "sensor_asymmetry": {"error": (0.0, 0.01, 0.1)},
    "sensor_cubic": {"coefficient": (0.0, 5e-3, 0.05)},
    "sensor_saturation": {"limit": (np.inf, 1.5, 1.9)},
    "sensor_lag": {"time_constant": (0.0, 0.02, 0.2)},
    "process_noise": {"intensity": (0.0, 1e-4, 1e-2), "seed": (0.0, 0.0, 1e6)},
    "unknown_bump": {"force": (0.0, 0.03, 0.08), "place": (0.0, -1.5, 1.5), "width": (1.0, 0.15, 0.5)},
    "unknown_step_damping": {"coefficient": (0.0, 0.03, 0.2), "place": (0.0, -1.0, 1.0)},
}
EFFECTS = {"servovalve": SERVOVALVE_EFFECTS, "van_der_pol": VAN_DER_POL_EFFECTS}

SERVOVALVE_STEP = 1e-4  # s
VAN_DER_POL_STEP = 2e-3  # s
FIRST = 1.0 - math.sqrt(0.5)  # node and diagonal of Alexander's method


class Valve(NamedTuple):
    """The paper's servovalve, SI units."""

    dead_zone: float = 1e-4
    saturation: float = 3e-3
    flow_gain: float = 1.45e-4
    feedback_gain: float = 0.09
    damping_ratio: float = 0.72
    natural_frequency: float = 300.0
    piston_area: float = 25e-4
    supply_pressure: float = 140e5
    mass: float = 20.0
    stiffness: float = 1e4


def _numbers(effects):
    """Every number of every effect, by the effect's name and the number's: the value that means absent."""
    return {f"{effect}_{name}": absent for effect, sizes in effects.items() for name, (absent, _, _) in sizes.items()}


_OF_VALVE, _OF_OSCILLATOR = _numbers(SERVOVALVE_EFFECTS), _numbers(VAN_DER_POL_EFFECTS)
ValveSizes = namedtuple("ValveSizes", _OF_VALVE, defaults=_OF_VALVE.values())
OscillatorSizes = namedtuple("OscillatorSizes", _OF_OSCILLATOR, defaults=_OF_OSCILLATOR.values())
# Division by zero is infinite, as NumPy's is.
_compiled = numba.njit(cache=True, error_model="numpy")


def effect_sizes(model_name: str) -> dict[str, dict[str, tuple[float, float]]]:
    """Plausible (low, high) sizes of each parameter of each effect of "servovalve" or "van_der_pol"."""
    return {
        effect: {parameter: (low, high) for parameter, (_, low, high) in parameters.items()}
        for effect, parameters in EFFECTS[model_name].items()
    }


def held_levels(rng: np.random.Generator, amplitude: float, count: int, samples: int) -> np.ndarray:
    """Pseudo random signal [count*samples]: `count` levels, uniform in +-amplitude, each held for `samples` samples."""
    return np.repeat(rng.uniform(-amplitude, amplitude, count), samples)


def servovalve_with(
    effects: Sequence[Mapping[str, Mapping[str, float]]],
    command: np.ndarray,
    sample_period: float,
    *,
    noise: np.ndarray | float = 0.0,
    initial_position: float | np.ndarray = 0.0,
    fine_step: float = SERVOVALVE_STEP,
    **valve: float | np.ndarray,
) -> dict[str, np.ndarray]:
    """Simulate servovalves from rest at a position over a command [batch, time], m of stroke, held between samples.

    Takes one mapping of effects for each record, the parameters of `Valve`, one for all or [batch], and noise
    [batch, time], m, to be added to the position before it is quantised. Returns, [batch, time], the measured
    position m, the spool's displacement before bias and dead zone m, and the load pressure Pa.
    """
    if unknown := set(valve) - set(Valve._fields):
        raise ValueError(f"unknown parameters of the servovalve: {sorted(unknown)}")
    sizes = [_sizes_of(some, SERVOVALVE_EFFECTS, ValveSizes) for some in effects]
    command = _checked_command(command, len(effects))
    batch, samples = command.shape
    clock, noise = np.arange(samples) * sample_period, np.broadcast_to(noise, command.shape)
    given = np.broadcast_arrays(np.zeros(batch), *Valve(**valve), initial_position)[1:]
    position, displacement, pressure = np.empty((3, batch, samples))
    for i, size in enumerate(sizes):
        *values, initial = (float(value[i]) for value in given)
        one = Valve(*values)
        timing = _timing(size.transport_delay_delay, sample_period, fine_step)
        matrix = _filter_matrix(one.natural_frequency, one.damping_ratio, timing[1])
        position[i], displacement[i], pressure[i] = _valve_and_load(command[i], timing, matrix, one, size, initial)
        drifted = size.sensor_drift_drift * clock / (samples * sample_period)
        position[i] = _sensed_position(position[i], size.sensor_bias_bias + drifted + _hum(clock, size), size)
        position[i] += noise[i]
        if size.sensor_quantisation_step > 0.0:
            position[i] = size.sensor_quantisation_step * np.round(position[i] / size.sensor_quantisation_step)
        if size.area_ratio_ratio != 1.0:
            pressure[i] = _between_chambers(pressure[i], displacement[i], one.supply_pressure, size.area_ratio_ratio)
    return {"position": position, "spool": displacement, "load_pressure": pressure}


def van_der_pol_with(
    effects: Sequence[Mapping[str, Mapping[str, float]]],
    command: np.ndarray,
    sample_period: float,
    alpha: float = 0.96,
    gamma: float = 1.23,
    initial: Sequence[float] | np.ndarray = (0.0, 0.0),
    *,
    fine_step: float = VAN_DER_POL_STEP,
) -> dict[str, np.ndarray]:
    """Simulate x1' = alpha*x2, x2' = -x1 + gamma*(1 - x1^2)*x2 + u over a command [batch, time] held between samples.

    Takes one mapping of effects for each record and the initial (x1, x2), [2] or [batch, 2]; process noise of
    intensity q adds a variance of q*t to x2. Returns the measured position x1 and the velocity x2, [batch, time].
    """
    sizes = [_sizes_of(some, VAN_DER_POL_EFFECTS, OscillatorSizes) for some in effects]
    command = _checked_command(command, len(effects))
    batch, samples = command.shape
    alphas, gammas, _ = np.broadcast_arrays(alpha, gamma, np.zeros(batch))
    starts = np.broadcast_to(np.asarray(initial, dtype=float), (batch, 2))
    position, velocity = np.empty((2, batch, samples))
    for i, size in enumerate(sizes):
        timing = _timing(size.transport_delay_delay, sample_period, fine_step)
        oscillator = (float(alphas[i]), float(gammas[i]))
        kicks = _process_noise(size, samples * timing[0], timing[1])
        # A static nonlinearity of the input commutes with its delay and with holding it.
        shaped = _shaped_input(command[i], size)
        start = (starts[i, 0], starts[i, 1])
        position[i], velocity[i] = _oscillation(shaped, timing, oscillator, size, start, kicks)
        bent = position[i] + size.sensor_cubic_coefficient * position[i] ** 3
        hum = _hum(np.arange(samples) * sample_period, size)
        position[i] = _sensed_position(bent, size.sensor_bias_bias + hum, size)
    return {"position": position, "velocity": velocity}


@_compiled
def _oscillation(command, timing, oscillator, sizes, initial, kicks):
    """Position as the sensor's lag leaves it, and velocity, of one record, each [time]; `kicks` are of x2, [step]."""
    substeps, step, delay, part = timing
    alpha, gamma = oscillator
    samples = len(command)
    laws = (gamma, samples * substeps * step, sizes)
    position, velocity = np.empty(samples), np.empty(samples)
    (x1, x2), lagged, stretch, sensed = initial, 0.0, 0.0, initial[0]
    input_lag, sensor_lag = sizes.input_lag_time_constant, sizes.sensor_lag_time_constant
    stiffness, length = sizes.elastic_friction_stiffness, sizes.elastic_friction_length
    for sample in range(samples):
        position[sample], velocity[sample] = sensed, x2
        for substep in range(substeps):
            time = (sample * substeps + substep) * step
            held = _delayed(command, sample, substep, delay, part)
            start = lagged if input_lag > 0.0 else held
            middle = held + (start - held) * _decay(0.5 * step, input_lag)
            end = held + (start - held) * _decay(step, input_lag)
            lagged, before = end, x1
            # Dahl's stretch over the step, as the velocity is expected to run.
            rising = _acceleration(x1, x2, time, start - stiffness * stretch, laws)
            ahead = _dahl(stretch, alpha * step * (x2 + 0.5 * step * rising), length)
            inputs = (
                start - stiffness * stretch,
                middle - stiffness * 0.5 * (stretch + ahead),
                end - stiffness * ahead,
            )
            x1, x2 = _van_der_pol_step(x1, x2, time, step, inputs, alpha, laws)
            stretch = _dahl(stretch, x1 - before, length)
            if len(kicks) > 0:
                x2 += kicks[sample * substeps + substep]
            sensed = _lagged(sensed, before, x1, sensor_lag, step)
    return position, velocity


@_compiled
def _dahl(stretch, way, length):
    """Stretch of what slides at a length, after a way: the midpoint rule."""
    middle = stretch + 0.5 * (way - np.abs(way) * stretch / length)
    return stretch + way - np.abs(way) * middle / length


def _sizes_of(effects, known, kind):
    """Every number of one record's effects, of one of the kinds of sizes."""
    for effect, parameters in effects.items():
        if effect not in known:
            raise ValueError(f"unknown effect {effect!r}; there are {sorted(known)}")
        if set(parameters) != set(known[effect]):
            raise ValueError(f"{effect} has the parameters {sorted(known[effect])}, not {sorted(parameters)}")
    return kind(
        **{f"{effect}_{name}": float(value) for effect, some in effects.items() for name, value in some.items()}
    )


def _checked_command(command, batch):
    command = np.asarray(command, dtype=float)
    if command.ndim != 2 or len(command) != batch:
        raise ValueError(f"the command must be [batch, time] with {batch} records, not of shape {command.shape}")
    return command


def _timing(delay, sample_period, fine_step):
    """Fine steps of a sample, their length s, and a delay as whole samples and fine steps beyond them.

    A delay of whole samples must not be off by one sample because of rounding.
    """
    substeps = max(1, round(sample_period / fine_step))
    step = sample_period / substeps
    whole = math.floor(delay / (step * substeps) + 1e-9)
    return substeps, step, whole, max(delay / step - whole * substeps, 0.0)


@_compiled
def _delayed(command, sample, substep, delay, part):
    """The mean of a delayed command over a fine step of a sample: zero before the record.

    In the one step that holds a jump it keeps second order: it is right but for the second moment in time.
    """
    new = command[sample - delay] if sample >= delay else 0.0
    old = command[sample - delay - 1] if sample > delay else 0.0
    weight = min(max(substep + 1 - part, 0.0), 1.0)
    return old * (1.0 - weight) + new * weight


def _filter_matrix(omega, damping, step):
    """From (p, p', input at the start, input at the end) to p at the inner stage, p and p' at the end, [3, 4]."""
    dynamics = np.zeros((4, 4))  # of p, p', the input and its slope
    dynamics[0, 1] = dynamics[2, 3] = 1.0
    dynamics[1, :3] = -(omega**2), -2.0 * damping * omega, omega**2
    slope = np.eye(4)
    slope[3, 2:] = -1.0 / step, 1.0 / step
    inner, full = (_exponential(dynamics * t) @ slope for t in (FIRST * step, step))
    return np.stack([inner[0], full[0], full[1]])


def _exponential(matrix):
    """Exponential of a matrix, by its series after halving it to a norm below one half, and squaring back."""
    halvings = max(0, math.ceil(math.log2(2.0 * np.abs(matrix).sum(axis=1).max() + 1e-300)))
    term = total = np.eye(len(matrix))
    for order in range(1, 20):
        term = term @ matrix / (order * 2.0**halvings)
        total = total + term
    return np.linalg.matrix_power(total, 2**halvings)


@_compiled
def _decay(time, time_constant):
    """exp(-time/time_constant), and 0 where there is no lag."""
    return math.exp(-time / time_constant) if time_constant > 0.0 else 0.0


@_compiled
def _lagged(output, start, end, time_constant, step):
    """First-order lag of a signal that is linear over the step from start to end."""
    decay = _decay(step, time_constant)
    return end - (end - start) * (time_constant / step) * (1.0 - decay) + (output - start) * decay


@_compiled
def _valve_and_load(command, timing, matrix, valve, sizes, initial_position):
    """Position as the sensor's lag leaves it m, spool m and load pressure Pa of one record, each [time]."""
    substeps, step, delay, part = timing
    samples = len(command)
    duration = samples * substeps * step
    position, displacement, pressure = np.empty(samples), np.empty(samples), np.empty(samples)
    load = (initial_position, 0.0, 0.0)
    spool, rate, fed_back, driven = 0.0, 0.0, 0.0, 0.0
    seen, sensed = initial_position, initial_position
    width, backlash = sizes.torque_motor_hysteresis_width, sizes.feedback_backlash_width
    for sample in range(samples):
        position[sample], displacement[sample], pressure[sample] = sensed, spool, load[2]
        for substep in range(substeps):
            time = (sample * substeps + substep) * step
            held = _delayed(command, sample, substep, delay, part)
            fed_back = _dragged(load[0], fed_back, backlash)
            driven = _dragged(held - valve.feedback_gain * fed_back, driven, width)
            ahead = _dragged(load[0] + step * load[1], fed_back, backlash)
            error = _dragged(held - valve.feedback_gain * ahead, driven, width)
            spool_between, spool_after, rate_after = matrix @ np.array([spool, rate, driven, error])
            limit = sizes.spool_rate_limit_rate
            excess = rate_after - min(max(rate_after, -limit), limit)
            spool, rate = spool_after - 0.5 * step * excess, rate_after - excess
            spool_between -= 0.5 * step * FIRST**2 * excess
            load = _load_step(load, spool_between, spool, time, step, duration, valve, sizes)
            previous, seen = seen, load[0] + valve.piston_area * load[2] / sizes.structural_flexibility_stiffness
            sensed = _lagged(sensed, previous, seen, sizes.sensor_lag_time_constant, step)
    return position, displacement, pressure


@_compiled
def _dragged(value, output, width):
    """Play operator: the output is dragged along so that it stays within +-width of the value."""
    return min(max(output, value - width), value + width)


@_compiled
def _bell(value, place, width):
    return math.exp(-0.5 * ((value - place) / width) ** 2)


@_compiled
def _softplus(value):
    return max(value, 0.0) + math.log1p(math.exp(-abs(value)))


@_compiled
def _opening(spool, valve, sizes):
    """Opening, m: dead zone, then saturation."""
    spool -= sizes.null_bias_bias
    asymmetry = sizes.asymmetric_dead_zone_asymmetry
    low, high = -valve.dead_zone * (1.0 - asymmetry), valve.dead_zone * (1.0 + asymmetry)
    inside = min(max(spool, low), high)
    opening, width = spool - inside, sizes.flow_gain_rounding_width
    if width > 0.0:
        opening = width * (_softplus((spool - high) / width) - _softplus((low - spool) / width))
    opening += sizes.null_leakage_ratio * inside
    return min(max(opening, -valve.saturation), valve.saturation)


@_compiled
def _conductance(opening, time, duration, valve, sizes):
    """Flow per root of pressure, m^3/(s Pa^0.5), not negative."""
    conductance = valve.flow_gain * abs(opening) * math.sqrt(2.0 / (1.0 + sizes.area_ratio_ratio**3))
    conductance *= 1.0 + sizes.flow_gain_drift_drift * (time / duration)
    conductance *= 1.0 + sizes.flow_gain_curvature_curvature * (opening / valve.saturation) ** 2
    if sizes.unknown_spool_notch_depth != 0.0:
        at = _bell(opening, sizes.unknown_spool_notch_place, sizes.unknown_spool_notch_width)
        conductance *= 1.0 - sizes.unknown_spool_notch_depth * at
    return conductance


@_compiled
def _external_force(x, time, valve, sizes):
    """Force N against positive motion at the position x, and the stiffness N/m; force = stiffness*x + it."""
    force, stiffness = sizes.constant_load_force, valve.stiffness
    force += sizes.hardening_spring_coefficient * x * x * x
    if sizes.harmonic_load_force != 0.0:
        force += sizes.harmonic_load_force * math.sin(sizes.harmonic_load_frequency * time + sizes.harmonic_load_phase)
    if sizes.unknown_cogging_force != 0.0:
        force += sizes.unknown_cogging_force * math.sin(2.0 * math.pi * x / sizes.unknown_cogging_pitch)
    if x > sizes.end_stop_position:
        stiffness += sizes.end_stop_stiffness
        force -= sizes.end_stop_stiffness * sizes.end_stop_position
    return force, stiffness


@_compiled
def _load_step(load, spool_between, spool_after, time, step, duration, valve, sizes):
    """One step of Alexander's method for position m, velocity m/s and load pressure Pa."""
    part = FIRST * step
    between = _load_stage(load, load[1], spool_between, time + part, part, duration, valve, sizes)
    # Where the second stage starts: the state plus (1 - FIRST)*step times its rates in the first stage.
    share = (1.0 - FIRST) / FIRST
    start = (
        load[0] + share * (between[0] - load[0]),
        load[1] + share * (between[1] - load[1]),
        load[2] + share * (between[2] - load[2]),
    )
    return _load_stage(start, between[1], spool_after, time + step, part, duration, valve, sizes)


@_compiled
def _load_stage(start, velocity, spool, time, step, duration, valve, sizes):
    """Backward Euler over `step` from a start; `velocity` is the one expected.

    What the closed form leaves to the expected velocity changes little with it, and two passes settle it. Stribeck's
    friction together with compressibility hunts, though: that record repeats only to about 1e-4 m.
    """
    opening = _opening(spool, valve, sizes)
    conductance = _conductance(opening, time, duration, valve, sizes)
    found = _balanced(start, velocity, opening, conductance, time, step, valve, sizes)
    if sizes.stribeck_friction_force != 0.0 or sizes.supply_droop_resistance != 0.0:
        found = _balanced(start, found[1], opening, conductance, time, step, valve, sizes)
    return found


@_compiled
def _balanced(start, velocity, opening, conductance, time, step, valve, sizes):
    """Solve a stage's balances of flow and force, with sticking exact, for everything else at the expected velocity.

    With s the sign of the opening and w the signed root of s*Ps - P,
        A*V + Ct*P + C*(P - P_start)/step = G*w,    P = s*Ps - w*|w|,
        M*(V - V_start)/step = A*P - K*X - B*V - F - friction.
    """
    old_position, old_velocity, old_pressure = start
    x = old_position + step * velocity
    area = valve.piston_area
    backward = area * (1.0 - sizes.area_asymmetry_asymmetry)
    supply = valve.supply_pressure - sizes.return_pressure_pressure
    supply -= sizes.supply_droop_resistance * abs(velocity) * (backward if velocity < 0.0 else area)
    if sizes.unknown_position_dependent_supply_depth != 0.0:
        at = _bell(x, sizes.unknown_position_dependent_supply_place, sizes.unknown_position_dependent_supply_width)
        supply -= valve.supply_pressure * sizes.unknown_position_dependent_supply_depth * at
    if opening < 0.0:
        # Backward the supply acts on the smaller area of a piston with one rod.
        supply *= sizes.area_ratio_ratio
    blocked = np.sign(opening) * supply  # load pressure without any flow
    mobility = step / valve.mass
    force, stiffness = _external_force(x, time, valve, sizes)
    inertia = 1.0 + mobility * (step * stiffness + sizes.viscous_friction_coefficient)
    momentum = old_velocity - mobility * (stiffness * old_position + force)

    storage = sizes.oil_compressibility_capacitance / step
    loss = sizes.cross_piston_leakage_coefficient + storage
    lost = loss * blocked - storage * old_pressure
    root = 2.0 * lost / (conductance + math.sqrt(conductance**2 + 4.0 * loss * abs(lost)) + 1e-300)
    resting = blocked - root * abs(root)  # load pressure at rest, which is all of it without leakage
    if momentum + mobility * (backward if opening < 0.0 else area) * resting < 0.0:
        area = backward
    push = mobility * area
    friction = sizes.coulomb_friction_force
    if sizes.stribeck_friction_force != 0.0:
        friction += sizes.stribeck_friction_force * math.exp(-((velocity / sizes.stribeck_friction_velocity) ** 2))
    unbalanced = momentum + push * resting
    held = min(max(unbalanced, -mobility * friction), mobility * friction)
    ratio = inertia / area
    quadratic, linear = push + ratio * loss, ratio * conductance
    constant = momentum - held + push * blocked + ratio * lost
    w = 2.0 * constant / (linear + math.sqrt(linear**2 + 4.0 * quadratic * abs(constant)) + 1e-300)
    square = w * abs(w)
    velocity = (conductance * w + loss * square - lost) / area
    if friction > 0.0 and held == unbalanced:
        velocity = 0.0
    position = old_position + step * velocity
    # A valve that closed during the step has stopped the load: what is left is the static balance.
    pressure = blocked - square if conductance + loss > 0.0 else (stiffness * position + force) / area
    return position, velocity, pressure


def _between_chambers(pressure, spool, supply, ratio):
    """Difference of the chambers' pressures, where the load's force over the larger area is a pressure.

    Each chamber has half of the valve; the flows into the one and out of the other are as the areas are.
    """
    ahead = np.where(spool < 0, pressure + ratio * supply, pressure + ratio**3 * supply) / (1.0 + ratio**3)
    behind = np.where(spool < 0, supply - ratio**2 * ahead, ratio**2 * (supply - ahead))
    return ahead - behind


def _sensed_position(position, bias, sizes):
    """Static part of the sensor, on positions [time]."""
    position = np.where(position < 0.0, (1.0 + sizes.sensor_asymmetry_error) * position, position)
    position = (1.0 + sizes.sensor_gain_error) * position + bias
    return np.clip(position, -sizes.sensor_saturation_limit, sizes.sensor_saturation_limit)


def _hum(clock, sizes):
    """What the mains add to a sensor, at times [time]."""
    return sizes.sensor_hum_amplitude * np.sin(sizes.sensor_hum_frequency * clock + sizes.sensor_hum_phase)


def _shaped_input(command, sizes):
    """Gain, dead zone and saturation of the input, in this order, on [time]."""
    command = command * (1.0 + sizes.input_gain_error)
    command = command - np.clip(command, -sizes.input_dead_zone_width, sizes.input_dead_zone_width)
    return np.clip(command, -sizes.input_saturation_limit, sizes.input_saturation_limit)


def _process_noise(sizes, steps, step):
    """Increments of x2, [step]; none without a random force."""
    if sizes.process_noise_intensity == 0.0:
        return np.zeros(0)
    draws = np.random.default_rng(int(sizes.process_noise_seed)).standard_normal(steps)
    return np.sqrt(sizes.process_noise_intensity * step) * draws


@_compiled
def _acceleration(x1, x2, time, u, laws):
    """Acceleration of the oscillator, without the laws that jump."""
    gamma, duration, sizes = laws
    offset, threshold = sizes.asymmetric_damping_offset, sizes.damping_threshold_threshold
    damping = gamma * (1.0 + sizes.parameter_drift_drift * (time / duration)) * (1.0 - ((x1 - offset) / threshold) ** 2)
    damping -= sizes.linear_damping_coefficient + sizes.rayleigh_damping_coefficient * x2 * x2
    damping -= sizes.quadratic_damping_coefficient * abs(x2)
    force = u + sizes.constant_force_force - x1 - sizes.one_way_damping_coefficient * abs(x2)
    force -= sizes.quadratic_stiffness_coefficient * x1**2
    force -= sizes.cubic_stiffness_coefficient * x1**3
    force -= sizes.quintic_stiffness_coefficient * x1**5
    if sizes.harmonic_force_force != 0.0:
        force += sizes.harmonic_force_force * math.cos(
            sizes.harmonic_force_frequency * time + sizes.harmonic_force_phase
        )
    if sizes.parametric_excitation_depth != 0.0:
        turned = sizes.parametric_excitation_frequency * time + sizes.parametric_excitation_phase
        force -= sizes.parametric_excitation_depth * math.cos(turned) * x1
    if sizes.unknown_bump_force != 0.0:
        force += sizes.unknown_bump_force * _bell(x1, sizes.unknown_bump_place, sizes.unknown_bump_width)
    return force + damping * x2


@_compiled
def _van_der_pol_step(x1, x2, time, step, inputs, alpha, laws):
    """One Runge-Kutta step of fourth order; the inputs are those at its start, middle and end.

    Laws that jump are replaced by their mean over the step, from the expected time of the jump: second order.
    """
    sizes = laws[2]
    middle, half = time + 0.5 * step, 0.5 * step
    first = _acceleration(x1, x2, time, inputs[0], laws)
    damping = held = rest = 0.0
    sticks = False
    if sizes.unknown_step_damping_coefficient != 0.0:
        start = x1 - sizes.unknown_step_damping_place
        end = start + alpha * step * (x2 + 0.5 * step * first)
        share = max(start, end) / max(abs(end - start), 1e-300)
        damping = sizes.unknown_step_damping_coefficient * min(max(share, 0.0), 1.0)
    friction = sizes.coulomb_friction_force
    if friction != 0.0:
        drive = first - damping * x2
        v2 = x2 + half * (drive - friction * np.sign(x2))
        change = _acceleration(x1 + half * alpha * x2, v2, middle, inputs[1], laws) - damping * v2 - drive
        sign, sticks, rest = _friction_over_step(x2, drive, change / half, friction, step)
        held = friction * sign
    a1 = first - damping * x2 - held
    v2 = x2 + half * a1
    a2 = _acceleration(x1 + half * alpha * x2, v2, middle, inputs[1], laws) - damping * v2 - held
    v3 = x2 + half * a2
    a3 = _acceleration(x1 + half * alpha * v2, v3, middle, inputs[1], laws) - damping * v3 - held
    v4 = x2 + step * a3
    a4 = _acceleration(x1 + step * alpha * v3, v4, time + step, inputs[2], laws) - damping * v4 - held
    if sticks:
        return x1 + 0.5 * alpha * x2 * rest, 0.0
    position = x1 + alpha * step / 6.0 * (x2 + 2.0 * v2 + 2.0 * v3 + v4)
    return position, x2 + step / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)


@_compiled
def _friction_over_step(velocity, drive, drive_rate, friction, step):
    """Mean sign of the velocity over a step, whether it ends at rest, and the time until rest, s."""
    direction = np.sign(velocity) if velocity != 0.0 else np.sign(drive)
    rest = 0.0
    for _ in range(3):
        slowing = friction * abs(direction) - direction * (drive + 0.5 * drive_rate * rest)
        rest = min(abs(velocity) / (slowing if slowing > 0.0 else 1e-300), step)
    drive += drive_rate * rest
    sticks = friction > 0.0 and rest < step and abs(drive) < friction
    return (direction * rest + np.sign(drive) * (step - rest)) / step, sticks, rest
