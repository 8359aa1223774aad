"""What could be known of hidden effects at all, as the plants themselves say: their worth, and that of their rivals.

Used by tests and by benchmarks/diagnosis.py. A servovalve is taken to first order where that is enough; the
oscillator, whose phase any refit moves, is refitted by least squares in the plant.
"""

import functools
from collections.abc import Mapping
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares, minimize_scalar

from tests.hidden_plants import effect_sizes, servovalve_with, van_der_pol_with
from tests.hidden_records import COARSEST, ONE_SIDED, TRUTH, Hidden, Made, excitation, plant

SEPARABLE = 5.0**2
"""Noise variances by which a fit has to be worse for a record to tell."""
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
# Shares of a servovalve's worth below which what is left to first order is not trusted: it is refitted in the plant.
_OF_FIRST_ORDER = 0.03
# Rivals that are refitted in the place of what is hidden.
_RIVALS_REFITTED, _HARMONIC_REFITTED = 3, 2
# Rivals of the oscillator's with a frequency, rad/s, any of which may be the one that is like something else; phases.
_HARMONIC, _HIGHEST_FREQUENCY, _PHASES = ("harmonic_force", "parametric_excitation", "sensor_hum"), 6.0, 8
# Of the oscillator where it is refitted, s: a step a sample, whose error is a millionth.
_REFIT_STEP = 0.02
_INITIAL_CONDITIONS = {"servovalve": 1, "van_der_pol": 2}
# Differences for derivatives: share of a parameter, initial condition, share of an effect's number.
_OF_PARAMETER, _OF_INITIAL, _OF_SIZE = 1e-5, {"servovalve": 1e-6, "van_der_pol": 1e-5}, 1e-4


class Oracle(NamedTuple):
    """What could be known of what is hidden, in noise variances.

    Attributes:
        worth: of it beside a refit of what is known.
        deficit: by which the best rival is worse; 0 for a rival that makes the same record. Where one is not worse by
            `SEPARABLE`, others are not asked any further.
        rival: that rival: one other effect; for several together any of one less, for one that is in no bank any two.

    """

    worth: float
    deficit: float
    rival: str


def oracle(hidden: Hidden, made: Made) -> Oracle:
    """Return what could be known of the effects that a record hides: up to three, or one that is in no bank."""
    left = _left_by_nothing(hidden, made)
    size = float(left @ left) / hidden.variance
    unit = left / max(np.linalg.norm(left), 1e-300)
    if len(hidden.names) == 1:
        (name,) = hidden.names
        if _is_noise(name, hidden, made):
            return Oracle(size, 0.0, "quantised noise")
        if name in EXACTLY_ALIKE[hidden.model]:
            return Oracle(size, 0.0, EXACTLY_ALIKE[hidden.model][name])
    every = library(hidden.model, made.excitation, len(made.time))
    if hidden.names[0].startswith("unknown") or len(hidden.names) == 3:
        rivals = {names: _together(unit, names, every) for names in combinations(every, 2)}
    else:
        rivals = {(name,): _alone(unit, name, every) for name in every if hidden.names != (name,)}
    best = sorted(rivals, key=lambda names: -rivals[names].share)
    deficits = {names: size * (1.0 - rivals[names].share) for names in best}
    # What has a frequency and a phase to choose is more like anything to first order than what it is.
    harmonic = [names for names in best if set(names) & set(_HARMONIC)]
    doubtful = [names for names in best if names not in harmonic][:_RIVALS_REFITTED] + harmonic[:_HARMONIC_REFITTED]
    if hidden.model == "servovalve":
        doubtful = [names for names in doubtful if deficits[names] < _OF_FIRST_ORDER * size]
    elif hidden.names != ("process_noise",):
        deficits["process_noise",] = _deficit_of_random_force(left / hidden.variance**0.5, made)
    for names in doubtful:
        if min(deficits.values()) <= SEPARABLE:
            break
        left = left_beside(hidden.model, made, rivals[names].start)
        deficits[names] = min(deficits[names], float(left @ left) / hidden.variance)
    rival = min(deficits, key=lambda names: deficits[names])
    return Oracle(size, deficits[rival], " and ".join(rival))


def worth(hidden: Hidden, made: Made) -> float:
    """Return the noise variances that the effects are worth beside a refit of what is known."""
    return float(np.sum(_left_by_nothing(hidden, made) ** 2)) / hidden.variance


def worth_each(hidden: Hidden, made: Made) -> tuple[float, ...] | None:
    """Return the noise variances that each of several effects is worth beside the others; None with random ones."""
    if "process_noise" in hidden.names:
        return None

    def refitted(name):
        left = left_beside(hidden.model, made, {n: sizes for n, sizes in made.sizes.items() if n != name})
        return float(left @ left) / hidden.variance

    if hidden.model == "van_der_pol":
        return tuple(refitted(name) for name in hidden.names)
    doubted = _OF_FIRST_ORDER * worth(hidden, made)
    found = []
    for name, to_first_order in zip(hidden.names, _worth_to_first_order(hidden, made), strict=True):
        if _is_noise(name, hidden, made):
            found.append(0.0)
        elif SEPARABLE < to_first_order < doubted:
            found.append(refitted(name))
        else:
            found.append(to_first_order)
    return tuple(found)


def left_beside(model: str, made: Made, beside: Mapping[str, Mapping[str, float]]) -> np.ndarray:
    """Return what the plant with some effects leaves of the position without noise, [time].

    All refitted by least squares: the parameters that are identified, initial conditions and the effects' numbers.
    """
    plain, changes = _identified(model)
    numbers = [(name, number) for name, sizes in beside.items() for number in sizes]
    sizes = np.array([beside[name][number] for name, number in numbers])
    start = np.concatenate([plain, sizes])
    steps = np.concatenate([changes, _OF_SIZE * np.abs(sizes)])
    lowest = np.full(len(start), -np.inf)
    if model == "servovalve":
        lowest[: len(TRUTH[model])] = 0.0
    lowest[len(plain) :] = [0.0 if name in ONE_SIDED else -np.inf for name, _ in numbers]

    def positions(points):
        effects = [{name: {} for name in beside} for _ in points]
        for effect, point in zip(effects, points, strict=True):
            for (name, number), value in zip(numbers, point[len(plain) :], strict=True):
                effect[name][number] = value
        return _positions(model, made.command, points[:, : len(plain)], effects)

    def left(point):
        return made.clean - positions(point[None])[0]

    def slopes(point):
        y = positions(np.concatenate([point[None], point + np.diag(steps)]))
        return -((y[1:] - y[0]) / steps[:, None]).T

    # A step too far overflows; the next is shorter.
    with np.errstate(over="ignore", invalid="ignore"):
        found = least_squares(left, start, slopes, bounds=(lowest, np.inf), x_scale="jac", ftol=1e-4, max_nfev=50)
    return found.fun


def _identified(model: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a plant's parameters that are identified and its initial conditions, and changes for derivatives."""
    parameters = np.array([*TRUTH[model].values()])
    initial = np.zeros(_INITIAL_CONDITIONS[model])
    return np.concatenate([parameters, initial]), np.concatenate(
        [_OF_PARAMETER * parameters, initial + _OF_INITIAL[model]]
    )


def _positions(model: str, command, points, effects) -> np.ndarray:
    """Return the positions [point, time] of plants whose parameters and initial conditions are [point, number].

    Over one command [time], or one each [point, time].
    """
    commands, period = np.broadcast_to(command, (len(points), command.shape[-1])), excitation(model, 0)[1]
    if model == "van_der_pol":
        alpha, gamma, initial = points[:, 0], points[:, 1], points[:, 2:]
        return van_der_pol_with(effects, commands, period, alpha, gamma, initial, fine_step=_REFIT_STEP)["position"]
    valve = {name: points[:, i] for i, name in enumerate([*TRUTH[model], "initial_position"])}
    return servovalve_with(effects, commands, period, **valve)["position"]


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
    command = excitation(model, seed)[0][:samples]
    plain, changes = _identified(model)
    points = np.concatenate([plain[None], plain + np.diag(changes)])
    y = _positions(model, command, points, [{}] * len(points))
    return Nominal(y[0], np.linalg.qr((y[1:] - y[0]).T)[0])


class Variants(NamedTuple):
    """An effect at several sizes: what each does outside what a refit could do, [variant, time], of unit length."""

    sizes: list[dict[str, float]]
    directions: np.ndarray

    def like(self, unit: np.ndarray) -> np.ndarray:
        """Return the cosines [variant] of the angles to a direction."""
        return self.directions @ unit


@functools.cache
def library(model: str, seed: int, samples: int) -> dict[str, Variants]:
    """Return what a plant could do instead of an effect that is hidden, by its name.

    Each effect at small, medium and large sizes, and a few implausible ones; the oscillator's harmonic ones, small, at
    every frequency that the record tells from the next.
    """
    command, period = excitation(model, seed)
    without, variants = nominal(model, seed, samples), variants_of(model, samples * period)
    effects = [{name: sizes} for name, some in variants.items() for sizes in some]
    points = np.tile(_identified(model)[0], (len(effects), 1))
    left = np.array([without.outside(row) for row in _positions(model, command[:samples], points, effects)])
    left /= np.maximum(np.linalg.norm(left, axis=1, keepdims=True), 1e-300)
    ends = np.cumsum([len(some) for some in variants.values()])[:-1]
    return {
        name: Variants(some, rows) for (name, some), rows in zip(variants.items(), np.split(left, ends), strict=True)
    }


def variants_of(model: str, duration: float) -> dict[str, list[dict[str, float]]]:
    """Return sizes of each effect of a bank, for a record of a duration, s."""
    ranges = {n: r for n, r in effect_sizes(model).items() if n != "process_noise" and not n.startswith("unknown")}
    found = {
        name: [
            {k: sign ** (i == 0) * _between(low, high, share) for i, (k, (low, high)) in enumerate(numbers.items())}
            for share, sign in ((0.1, 1.0), (0.5, 1.0), (0.9, 1.0), (0.5, -1.0))
            if sign > 0 or name not in ONE_SIDED
        ]
        for name, numbers in ranges.items()
    }
    for name, sizes in _IMPLAUSIBLE:
        if name in found:
            found[name].append(sizes)
    half_wave = np.pi / duration
    for name in _HARMONIC if model == "van_der_pol" else ():
        found[name] = [
            {**found[name][0], "frequency": frequency, "phase": phase}
            for frequency in np.arange(half_wave, _HIGHEST_FREQUENCY, half_wave)
            for phase in (np.arange(_PHASES) + 0.5) * 2.0 * np.pi / _PHASES
        ]
    return found


@functools.cache
def random_force(seed: int, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return how a force of white noise moves the oscillator outside what a refit could do, to first order.

    Orthonormal directions [time, direction], the strongest first, and the deviation along each if the velocity is
    kicked in every sample by a deviation of 1.
    """
    command, period = excitation("van_der_pol", seed)
    command = command[:samples]
    small = 1e-3
    point = _identified("van_der_pol")[0]
    commands = command + small / period * np.eye(samples)
    y = _positions("van_der_pol", commands, np.tile(point, (samples, 1)), [{}] * samples)
    without = nominal("van_der_pol", seed, samples)
    kicked = np.array([without.outside(row) for row in y]) / small
    directions, deviations, _ = np.linalg.svd(kicked.T, full_matrices=False)
    return directions, deviations


def _deficit_of_random_force(left: np.ndarray, made: Made) -> float:
    """Return by how much a random force explains worse what no refit does, left, [time], in deviations of the noise.

    Twice the logarithm of the likelihoods, expected over noise of variance 1, at the intensity that is best.
    """
    directions, deviations = random_force(made.excitation, len(made.time))
    along = (directions.T @ left) ** 2
    rest = float(left @ left - along.sum())

    def deficit(log_intensity):
        spread = 1.0 + np.exp(log_intensity) * deviations**2
        return rest + float(np.sum((1.0 + along) / spread + np.log(spread) - 1.0))

    none = -2.0 * np.log(deviations[0])
    return float(minimize_scalar(deficit, bounds=(none - 10.0, none + 25.0), method="bounded").fun)


def _between(low: float, high: float, share: float) -> float:
    """Return the size at a share of the way between plausible ones, logarithmic as they are drawn."""
    return low * (high / low) ** share if low > 0 else low + share * (high - low)


def _left_by_nothing(hidden: Hidden, made: Made) -> np.ndarray:
    """Return what a refit of the plant without any effect leaves of the position without noise, [time]."""
    if hidden.model == "servovalve":
        return nominal(hidden.model, made.excitation, len(made.time)).outside(made.clean)
    return left_beside(hidden.model, made, {})


def _is_noise(name: str, hidden: Hidden, made: Made) -> bool:
    """Whether an effect is a lattice of readings as fine as that of quantised noise."""
    return name == "sensor_quantisation" and made.sizes[name]["step"] < COARSEST * hidden.variance**0.5


class Rival(NamedTuple):
    """Effects instead of what is hidden: the share of it that they take to first order, sizes to refit them from."""

    share: float
    start: dict[str, dict[str, float]]


def _alone(unit: np.ndarray, name: str, every: Mapping[str, Variants]) -> Rival:
    """Return one effect as a rival of what points in a direction, at the best of its sizes."""
    like = every[name].like(unit)
    return Rival(float(np.max(like**2)), {name: every[name].sizes[int(np.argmax(like))]})


def _together(unit: np.ndarray, names: tuple[str, str], every: Mapping[str, Variants]) -> Rival:
    """Return two effects as a rival, each at the best of its sizes."""
    first, second = (every[name] for name in names)
    a, b, c = first.like(unit)[:, None], second.like(unit)[None, :], first.directions @ second.directions.T
    shares = (a**2 + b**2 - 2.0 * a * b * c) / np.maximum(1.0 - c**2, 1e-6)
    i, j = np.unravel_index(np.argmax(shares), shares.shape)
    return Rival(float(shares[i, j]), {names[0]: first.sizes[i], names[1]: second.sizes[j]})


def _worth_to_first_order(hidden: Hidden, made: Made) -> list[float]:
    """Return the noise variances that each of a servovalve's effects is worth beside the others, to first order."""
    without = nominal(hidden.model, made.excitation, len(made.time))
    commands = np.tile(made.command, (len(hidden.names), 1))
    effects = [{name: made.sizes[name]} for name in hidden.names]
    changes = plant(hidden.model, effects, commands, excitation(hidden.model, 0)[1]) - without.position
    found = []
    for i, change in enumerate(changes):
        q = np.linalg.qr(np.concatenate([without.basis, np.delete(changes, i, axis=0).T], axis=1))[0]
        left = change - q @ (q.T @ change)
        found.append(float(left @ left) / hidden.variance)
    return found
