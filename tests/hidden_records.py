"""Records with hidden effects: excitation, sizes drawn at random, noise, and what the plant says could be known.

Used by tests and by benchmarks/diagnosis.py; the plants are those of hidden_plants.py.
"""

import functools
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import lfilter

from tests.hidden_plants import Valve, effect_sizes, held_levels, servovalve_with, van_der_pol_with

EXCITATIONS = 3
# What is identified, as the plants have it.
_IDENTIFIED = ("dead_zone", "saturation", "flow_gain", "feedback_gain", "damping_ratio", "natural_frequency")
TRUTH = {
    "servovalve": {name: getattr(Valve(), name) for name in _IDENTIFIED},
    "van_der_pol": {"alpha": 0.96, "gamma": 1.23},
}
# Another effect that makes the same record with other parameters, whatever its size: gamma*(1 - x^2/c^2) - d is
# g*(1 - x^2/k^2) with g = gamma - d; a stiffer spring is a smaller input; an input's bias is a constant force. What a
# pump's resistance takes from the supply at a flow A*v, a viscous friction of A^2 times that takes from the load.
EXACTLY_ALIKE = {
    "servovalve": {
        "null_bias": "asymmetric_dead_zone",
        "asymmetric_dead_zone": "null_bias",
        "supply_droop": "viscous_friction",
        "viscous_friction": "supply_droop",
    },
    "van_der_pol": {
        "linear_damping": "damping_threshold",
        "damping_threshold": "linear_damping",
        "input_gain": "linear_stiffness",
        "constant_force": "input_bias",
    },
}
# Sizes that are larger than plausible, but which plausible ones of other effects may look like.
_IMPLAUSIBLE = (("constant_load", {"force": 1e4}), ("constant_load", {"force": -1e4}))
# Of quantised noise, in deviations of the noise: nothing is hidden in a record whose readings are as coarse as that.
COARSEST = 2.0
# Rivals of the oscillator's that are refitted in the place of what is hidden.
_RIVALS_REFITTED = 3
_HARMONIC = ("harmonic_force", "parametric_excitation")
# Of the oscillator where it is refitted, s: a step a sample, whose error is a millionth.
_REFIT_STEP = 0.02
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


class Nominal(NamedTuple):
    """A plant without any effect: its position [time], and orthonormal directions [time, direction].

    The directions are those of its parameters and initial conditions: what lies outside them no refit could do, to
    first order.
    """

    position: np.ndarray
    basis: np.ndarray

    def outside(self, position: np.ndarray) -> np.ndarray:
        """Return what a position [time] has that a refit has not."""
        change = position - self.position
        return change - self.basis @ (self.basis.T @ change)


@functools.cache
def nominal(model: str, seed: int, samples: int) -> Nominal:
    """Return the plant without any effect under an excitation."""
    command, period = excitation(model, seed)
    simulate = servovalve_with if model == "servovalve" else van_der_pol_with

    def positions(changed):
        """Simulate with each of some parameters changed in turn; those of a filter are not taken side by side."""
        count = len(next(iter(changed.values()), [0]))
        return simulate([{}] * count, np.tile(command[:samples], (count, 1)), period, **changed)["position"]

    truth = TRUTH[model]
    alone = [name for name in truth if name in ("damping_ratio", "natural_frequency")]
    together = [name for name in truth if name not in alone]
    sides = {name: truth[name] * (1.0 + 1e-5 * np.eye(len(together) + 1)[i + 1]) for i, name in enumerate(together)}
    plain, *moved = positions(sides)
    others = [{name: truth[name] * (1.0 + 1e-5)} for name in alone]
    others += [{"initial_position": 1e-6}] if model == "servovalve" else [{"initial": x} for x in 1e-5 * np.eye(2)]
    moved += [simulate([{}], command[None, :samples], period, **other)["position"][0] for other in others]
    return Nominal(plain, np.linalg.qr((np.array(moved) - plain).T)[0])


@functools.cache
def library(model: str, seed: int, samples: int) -> dict[str, np.ndarray]:
    """Return what a plant could do instead of an effect that is hidden: by its name [variant, time], of unit length.

    Each effect at small, medium and large sizes, and a few implausible ones, outside what a refit could do.
    """
    command, period = excitation(model, seed)
    ranges = {n: r for n, r in effect_sizes(model).items() if n != "process_noise" and not n.startswith("unknown")}
    variants = [
        (name, {k: sign**(i == 0) * _between(low, high, share) for i, (k, (low, high)) in enumerate(numbers.items())})
        for name, numbers in ranges.items()
        for share, sign in ((0.1, 1.0), (0.5, 1.0), (0.9, 1.0), (0.5, -1.0))
        if sign > 0 or name not in ONE_SIDED
    ]  # fmt: skip
    variants += [(name, sizes) for name, sizes in _IMPLAUSIBLE if name in ranges]
    y = plant(
        model, [{name: sizes} for name, sizes in variants], np.tile(command[:samples], (len(variants), 1)), period
    )
    without = nominal(model, seed, samples)
    directions: dict[str, list[np.ndarray]] = {}
    for (name, _), row in zip(variants, y, strict=True):
        left = without.outside(row)
        directions.setdefault(name, []).append(left / max(np.linalg.norm(left), 1e-300))
    return {name: np.array(rows) for name, rows in directions.items()}


def _between(low: float, high: float, share: float) -> float:
    """Return the size at a share of the way between plausible ones, logarithmic as they are drawn."""
    return low * (high / low) ** share if low > 0 else low + share * (high - low)


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


def left_by_refit(hidden: Hidden, made: Made) -> np.ndarray:
    """Return what a refit of the plant without any effect leaves of the position without noise, [time].

    To first order for the servovalve. A refit of the oscillator moves its phase, which is far from linear: by least
    squares in the plant.
    """
    if hidden.model == "servovalve":
        return nominal(hidden.model, made.excitation, len(made.time)).outside(made.clean)
    return _left_by_oscillator(made, {})


def _left_by_oscillator(made: Made, beside: Mapping[str, Mapping[str, float]]) -> np.ndarray:
    """Return what the oscillator with these effects leaves of the position without noise, [time], all refitted."""
    truth, period = TRUTH["van_der_pol"], excitation("van_der_pol", 0)[1]
    numbers = [(name, number) for name, sizes in beside.items() for number in sizes]
    sizes = [beside[name][number] for name, number in numbers]
    start = np.array([truth["alpha"], truth["gamma"], 0.0, 0.0, *sizes])
    lowest = [-np.inf] * 4 + [0.0 if name in ONE_SIDED else -np.inf for name, _ in numbers]
    steps = np.array([1e-5] * 4 + [1e-4 * abs(size) for size in sizes])

    def positions(points):
        effects = [{name: {} for name in beside} for _ in points]
        for effect, point in zip(effects, points, strict=True):
            for (name, number), value in zip(numbers, point[4:], strict=True):
                effect[name][number] = value
        commands = np.tile(made.command, (len(points), 1))
        alpha, gamma, initial = points[:, 0], points[:, 1], points[:, 2:4]
        return van_der_pol_with(effects, commands, period, alpha, gamma, initial, fine_step=_REFIT_STEP)["position"]

    def left(point):
        return made.clean - positions(point[None])[0]

    def slopes(point):
        y = positions(np.concatenate([point[None], point + np.diag(steps)]))
        return -((y[1:] - y[0]) / steps[:, None]).T

    # A step too far overflows; the next is shorter.
    with np.errstate(over="ignore", invalid="ignore"):
        found = least_squares(left, start, slopes, bounds=(lowest, np.inf), x_scale="jac", ftol=1e-4, max_nfev=50)
    return found.fun


def worth(hidden: Hidden, made: Made) -> float:
    """Return the noise variances that the effects are worth beside a refit of what is known."""
    return float(np.sum(left_by_refit(hidden, made) ** 2)) / hidden.variance


class Oracle(NamedTuple):
    """What could be known of what is hidden, in noise variances.

    Attributes:
        worth: of it beside a refit of what is known.
        deficit: by which the best rival is worse, to first order for the servovalve; 0 for a rival that makes the
            same record.
        rival: that rival: one other effect, for two effects together any one; for an effect that is in no bank two.

    """

    worth: float
    deficit: float
    rival: str


def oracle(hidden: Hidden, made: Made) -> Oracle:
    """Return what could be known of the effects that a record hides: one or two, or one that is in no bank."""
    left = left_by_refit(hidden, made)
    size = float(left @ left) / hidden.variance
    unit = left / max(np.linalg.norm(left), 1e-300)
    unknown = hidden.names[0].startswith("unknown")
    if len(hidden.names) == 1 and _is_noise(hidden.names[0], hidden, made):
        return Oracle(size, 0.0, "quantised noise")
    if len(hidden.names) == 1 and hidden.names[0] in EXACTLY_ALIKE[hidden.model]:
        return Oracle(size, 0.0, EXACTLY_ALIKE[hidden.model][hidden.names[0]])
    every = library(hidden.model, made.excitation, len(made.time))
    if unknown:
        rivals = {pair: _share_of(unit, *(every[other] for other in pair)) for pair in combinations(every, 2)}
    else:
        rivals = {(other,): float(np.max((every[other] @ unit) ** 2)) for other in every if hidden.names != (other,)}
    best = sorted(rivals, key=lambda names: -rivals[names])
    deficits = {names: size * (1.0 - rivals[names]) for names in best}
    if hidden.model == "van_der_pol":
        # What is to make up for something else may have to be large, or of a frequency that the library lacks.
        tried = dict.fromkeys([*best[:_RIVALS_REFITTED], *((name,) for name in _HARMONIC if (name,) in deficits)])
        deficits |= {names: min(deficits[names], _refitted(hidden, made, names)) for names in tried}
    rival = min(deficits, key=lambda names: deficits[names])
    return Oracle(size, deficits[rival], " and ".join(rival))


def _is_noise(name: str, hidden: Hidden, made: Made) -> bool:
    """Whether an effect is a lattice of readings as fine as that of quantised noise."""
    return name == "sensor_quantisation" and made.sizes[name]["step"] < COARSEST * hidden.variance**0.5


def _refitted(hidden: Hidden, made: Made, names: Sequence[str]) -> float:
    """Return the noise variances that the oscillator with other effects leaves of a record."""
    ranges = effect_sizes(hidden.model)
    middle = {name: {k: _between(low, high, 0.5) for k, (low, high) in ranges[name].items()} for name in names}
    left = _left_by_oscillator(made, middle)
    return float(left @ left) / hidden.variance


def _share_of(unit: np.ndarray, first: np.ndarray, second: np.ndarray) -> float:
    """Return the share of a direction that two effects take together, each at the best of its sizes."""
    a, b, c = (first @ unit)[:, None], (second @ unit)[None, :], first @ second.T
    return float(np.max((a**2 + b**2 - 2.0 * a * b * c) / np.maximum(1.0 - c**2, 1e-6)))


def worth_each(hidden: Hidden, made: Made) -> tuple[float, ...] | None:
    """Return the noise variances that each of several effects is worth beside the others; None with random ones.

    To first order for the servovalve, by least squares for the oscillator; none for what is but noise.
    """
    if "process_noise" in hidden.names:
        return None
    if hidden.model == "van_der_pol":
        left = [
            _left_by_oscillator(made, {n: sizes for n, sizes in made.sizes.items() if n != name})
            for name in hidden.names
        ]
        return tuple(float(r @ r) / hidden.variance for r in left)
    without = nominal(hidden.model, made.excitation, len(made.time))
    alone = plant(
        hidden.model,
        [{name: made.sizes[name]} for name in hidden.names],
        np.tile(made.command, (len(hidden.names), 1)),
        excitation(hidden.model, 0)[1],
    )
    changes = alone - without.position
    worths = []
    for i in range(len(changes)):
        others = np.concatenate([without.basis, np.delete(changes, i, axis=0).T], axis=1)
        q = np.linalg.qr(others)[0]
        left = changes[i] - q @ (q.T @ changes[i])
        worths.append(0.0 if _is_noise(hidden.names[i], hidden, made) else float(left @ left) / hidden.variance)
    return tuple(worths)


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
