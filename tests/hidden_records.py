"""Records with hidden effects: excitation, sizes drawn at random, noise, and what the plant says could be known.

Used by tests and by benchmarks/diagnosis.py; the plants are those of hidden_plants.py.
"""

import functools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from tests.hidden_plants import effect_sizes, held_levels, servovalve_with, van_der_pol_with

EXCITATIONS = 3
# Sizes of these are never negative.
ONE_SIDED = frozenset(
    """
    coulomb_friction stribeck_friction viscous_friction null_leakage cross_piston_leakage supply_droop return_pressure
    oil_compressibility structural_flexibility spool_rate_limit torque_motor_hysteresis feedback_backlash
    transport_delay sensor_lag sensor_saturation sensor_quantisation end_stop flow_gain_rounding harmonic_load
    damping_threshold input_lag input_dead_zone input_saturation harmonic_force parametric_excitation process_noise
    unknown_position_dependent_supply unknown_spool_notch unknown_cogging
    """.split()  # noqa: SIM905
)


class Hidden(NamedTuple):
    """What one record hides: the model, the noise's kind and variance, the names of the effects, and the seed."""

    model: str
    noise: str
    variance: float
    names: tuple[str, ...]
    seed: int


def sizes_of(hidden: Hidden, rng) -> dict[str, dict[str, float]]:
    """Draw the sizes of the effects, logarithmic between the plausible ones."""
    ranges, drawn = effect_sizes(hidden.model), {}
    for name in hidden.names:
        drawn[name] = {}
        for i, (number, (low, high)) in enumerate(ranges[name].items()):
            value = float(np.exp(rng.uniform(np.log(low), np.log(high)))) if low > 0 else float(rng.uniform(low, high))
            if i == 0 and name not in ONE_SIDED and rng.random() < 0.5:
                value = -value
            drawn[name][number] = value
        if name == "process_noise":
            drawn[name]["seed"] = float(rng.integers(1000))
    return drawn


def excitation(model: str, seed: int) -> tuple[np.ndarray, float]:
    """Return a command [time] and its sample period, s: 5 s at 1 kHz, or 40 s at 50 Hz."""
    rng = np.random.default_rng([77, seed])
    if model == "servovalve":
        return held_levels(rng, 6e-3, 25, 200), 1e-3
    return held_levels(rng, 1.0, 40, 50), 0.02


def noise_of(hidden: Hidden, rng, count: int) -> np.ndarray:
    """Draw the noise, of its variance but for outliers."""
    deviation = hidden.variance**0.5
    white = rng.standard_normal(count + 500)
    if hidden.noise == "AR":
        pole = float(rng.uniform(0.3, 0.95))
        return deviation * (1.0 - pole**2) ** 0.5 * lfilter([1.0], [1.0, -pole], white)[500:]
    noise = deviation * white[500:]
    if hidden.noise == "outliers":
        where = rng.random(count) < 0.005
        noise[where] += rng.choice([-1.0, 1.0], where.sum()) * rng.uniform(10.0, 50.0, where.sum()) * deviation
    return noise


def plant(model: str, effects: Sequence[Mapping], commands, period, noise=None) -> np.ndarray:
    """Return positions [record, time] of a plant."""
    if model == "servovalve":
        return servovalve_with(effects, commands, period, noise=noise)["position"]
    position = van_der_pol_with(effects, commands, period)["position"]
    return position if noise is None else position + noise


@functools.cache
def library(model: str, seed: int, samples: int) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Return a plant's nominal position under an excitation, its directions by parameters, and by each effect."""
    command, period = excitation(model, seed)
    command = command[:samples]
    ranges = {n: r for n, r in effect_sizes(model).items() if n != "process_noise" and not n.startswith("unknown")}
    middle = [
        {name: {k: (low * high) ** 0.5 if low > 0 else 0.5 * (low + high) for k, (low, high) in numbers.items()}}
        for name, numbers in ranges.items()
    ]
    y = plant(model, [{}, *middle], np.tile(command, (len(middle) + 1, 1)), period)
    truth = (
        {"dead_zone": 1e-4, "saturation": 3e-3, "flow_gain": 1.45e-4, "feedback_gain": 0.09, "damping_ratio": 0.72,
         "natural_frequency": 300.0}
        if model == "servovalve" else {"alpha": 0.96, "gamma": 1.23}
    )  # fmt: skip
    simulate = servovalve_with if model == "servovalve" else van_der_pol_with
    by_parameter = []
    for name, value in truth.items():
        up, down = (
            simulate([{}], command[None], period, **{name: value * f})["position"][0] for f in (1.0 + 1e-4, 1.0 - 1e-4)
        )
        by_parameter.append(up - down)
    basis = np.linalg.qr(np.array(by_parameter).T)[0]
    directions = {}
    for name, row in zip(ranges, y[1:] - y[0], strict=True):
        left = row - basis @ (basis.T @ row)
        directions[name] = left / max(np.linalg.norm(left), 1e-300)
    return y[0], basis, directions


class Made(NamedTuple):
    """A record: time s, command, the measured position and that without noise, `[time]`, the sizes, the excitation."""

    time: np.ndarray
    command: np.ndarray
    position: np.ndarray
    clean: np.ndarray
    sizes: dict[str, dict[str, float]]
    excitation: int


def records(hidden: Sequence[Hidden], samples: int | None = None) -> list[Made]:
    """Make records of one model, each with its own effects and noise; `samples` shortens them."""
    model = hidden[0].model
    rngs = [np.random.default_rng(h.seed) for h in hidden]
    seeds = [int(rng.integers(EXCITATIONS)) for rng in rngs]
    effects = [sizes_of(h, rng) for h, rng in zip(hidden, rngs, strict=True)]
    period = excitation(model, 0)[1]
    commands = np.stack([excitation(model, s)[0] for s in seeds])[:, :samples]
    noises = np.stack([noise_of(h, rng, commands.shape[1]) for h, rng in zip(hidden, rngs, strict=True)])
    steps = [
        float(rng.uniform(0.2, 2.0)) * h.variance**0.5 if h.noise == "quantised" else 0.0
        for h, rng in zip(hidden, rngs, strict=True)
    ]
    measured = plant(model, effects, commands, period, noises)
    clean = plant(model, effects, commands, period)
    made = []
    for i, step in enumerate(steps):
        position = step * np.round(measured[i] / step) if step else measured[i]
        time = np.arange(len(position)) * period
        made.append(Made(time, commands[i], position, clean[i], effects[i], seeds[i]))
    return made


def expected(hidden: Hidden, made: Made) -> tuple[float, float, str]:
    """Return the noise variances that the effect is worth, by which its best rival is worse, and that rival."""
    nominal, basis, directions = library(hidden.model, made.excitation, len(made.time))
    g = made.clean - nominal
    g = g - basis @ (basis.T @ g)
    worth = float(g @ g) / hidden.variance
    unit = g / max(np.linalg.norm(g), 1e-300)
    alike = {name: float((unit @ d) ** 2) for name, d in directions.items() if name not in hidden.names}
    rival = max(alike, key=lambda name: alike[name])
    return worth, worth * (1.0 - alike[rival]), rival


def worth_each(hidden: Hidden, made: Made) -> tuple[float, ...] | None:
    """Return the noise variances that each of several effects is worth beside the others; None with random ones."""
    if "process_noise" in hidden.names:
        return None
    nominal, basis, _ = library(hidden.model, made.excitation, len(made.time))
    alone = plant(
        hidden.model,
        [{name: made.sizes[name]} for name in hidden.names],
        np.tile(made.command, (len(hidden.names), 1)),
        excitation(hidden.model, 0)[1],
    )
    changes = alone - nominal
    worths = []
    for i in range(len(changes)):
        others = np.concatenate([basis, np.delete(changes, i, axis=0).T], axis=1)
        q = np.linalg.qr(others)[0]
        left = changes[i] - q @ (q.T @ changes[i])
        worths.append(float(left @ left) / hidden.variance)
    return tuple(worths)
