"""Records with hidden effects: excitation, sizes drawn at random, noise.

Used by tests and by benchmarks/diagnosis.py; the plants are those of hidden_plants.py.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from tests.hidden_plants import Valve, effect_sizes, held_levels, servovalve_with, van_der_pol_with

EXCITATIONS = 3
# What is identified, as the plants have it.
_IDENTIFIED = ("dead_zone", "saturation", "flow_gain", "feedback_gain", "damping_ratio", "natural_frequency")
TRUTH = {
    "servovalve": {name: getattr(Valve(), name) for name in _IDENTIFIED},
    "van_der_pol": {"alpha": 0.96, "gamma": 1.23},
}
# Of quantised noise, in deviations of the noise: nothing is hidden in a record whose readings are as coarse as that.
COARSEST = 2.0
# Sizes of these are never negative.
ONE_SIDED = frozenset(
    """
    coulomb_friction stribeck_friction viscous_friction null_leakage cross_piston_leakage supply_droop return_pressure
    oil_compressibility structural_flexibility spool_rate_limit torque_motor_hysteresis feedback_backlash
    transport_delay sensor_lag sensor_saturation sensor_quantisation end_stop flow_gain_rounding harmonic_load
    damping_threshold input_lag input_dead_zone input_saturation harmonic_force parametric_excitation process_noise
    unknown_position_dependent_supply unknown_spool_notch unknown_cogging elastic_friction area_ratio sensor_hum
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


def plant(model: str, effects: Sequence[Mapping], commands, period, noise=0.0) -> np.ndarray:
    """Return positions [record, time] of a plant."""
    if model == "servovalve":
        return servovalve_with(effects, commands, period, noise=noise)["position"]
    return van_der_pol_with(effects, commands, period)["position"] + noise


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
        float(rng.uniform(0.2, COARSEST)) * h.variance**0.5 if h.noise == "quantised" else 0.0
        for h, rng in zip(hidden, rngs, strict=True)
    ]
    # With noise and without, side by side.
    both = np.concatenate([noises, np.zeros_like(noises)])
    measured, clean = np.split(plant(model, effects * 2, np.tile(commands, (2, 1)), period, both), 2)
    made = []
    for i, step in enumerate(steps):
        position = step * np.round(measured[i] / step) if step else measured[i]
        time = np.arange(len(position)) * period
        made.append(Made(time, commands[i], position, clean[i], effects[i], seeds[i]))
    return made


def true_term(hidden: Hidden, made: Made) -> tuple[str, np.ndarray, np.ndarray]:
    """Return where an effect that is in no bank acts, the term, a force or a share, and how it acts, along the record.

    How it acts is [time] the weight of each time: the square of the opening through which a valve's terms act.
    """
    ((name, sizes),) = made.sizes.items()
    position, period = made.clean, excitation(hidden.model, 0)[1]
    always = np.ones(len(position))
    if name == "unknown_bump":
        return "force", sizes["force"] * np.exp(-0.5 * ((position - sizes["place"]) / sizes["width"]) ** 2), always
    if name == "unknown_step_damping":
        return "force", -sizes["coefficient"] * (position > sizes["place"]) * np.gradient(position, period), always
    spool = servovalve_with([made.sizes], made.command[None], period)["spool"][0]
    opening = np.clip(spool - np.clip(spool, -1e-4, 1e-4), -3e-3, 3e-3)
    if name == "unknown_cogging":
        return "load_force", sizes["force"] * np.sin(2.0 * np.pi * position / sizes["pitch"]), opening**2
    along = opening if name == "unknown_spool_notch" else position
    term = -sizes["depth"] * np.exp(-0.5 * ((along - sizes["place"]) / sizes["width"]) ** 2)
    return ("opening" if name == "unknown_spool_notch" else "supply"), term, opening**2
