"""What any second experiment could tell of an effect: an exhaustive search in the independent plant.

Commands of five kinds, at two sizes and two paces, at three supply pressures, the load pressure measured or not. Of
each the plant says by how many noise variances the best rival explains the first record and the second together worse
than the truth does, the identified parameters and each record's start refitted: to first order, and for the experiments
that tell most by least squares, where what is left is too small a part for first order.
"""

import functools
import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import sawtooth

from benchmarks.several_outputs import steady
from benchmarks.several_records import MODEL, OF_FIRST_ORDER, PLAIN, REFITTED, STEPS
from tests.hidden_oracle import EXACTLY_ALIKE, variants_of
from tests.hidden_plants import SERVOVALVE_STEP, Valve, held_levels, servovalve_with
from tests.hidden_records import ONE_SIDED, TRUTH, excitation

# Of a plant whose load pressure is known to a few readings, s.
PRESSURE_STEP = 2e-5
# Experiments in which rivals are refitted.
EXPERIMENTS_REFITTED = 3
# Of what is kept of each output, SI.
UNIT = {"position": 1e-4, "load_pressure": 5e4}
PARAMETERS = tuple(TRUTH[MODEL])
_PERIOD = excitation(MODEL, 0)[1]


class Rig(NamedTuple):
    """What may be done: the largest command, m, supply pressures, Pa, and the positions that are kept, m."""

    command: float
    supply: tuple[float, ...]
    position: tuple[float, float]


class Experiment(NamedTuple):
    """A second record: the command's kind, its size as a share of the largest, its pace, s, and the supply, Pa."""

    kind: str
    share: float
    pace: float
    supply: float


class Best(NamedTuple):
    """The experiment that tells most, by how many noise variances the best rival is worse then, and that rival."""

    deficit: float
    rival: str
    experiment: Experiment | None


def experiments(rig: Rig) -> list[Experiment]:
    """Return all that are tried."""
    return [Experiment(*each) for each in itertools.product(_KINDS, (0.4, 1.0), (0.1, 0.4), rig.supply)]


def command_of(experiment: Experiment, rig: Rig, samples: int, period: float) -> np.ndarray:
    """Return the command [time] of an experiment, m."""
    time = period * np.arange(samples)
    return experiment.share * rig.command * _KINDS[experiment.kind](time, experiment.pace)


def _levels(time: np.ndarray, pace: float) -> np.ndarray:
    each = max(1, round(pace / time[1]))
    return held_levels(np.random.default_rng(5), 1.0, -(-len(time) // each), each)[: len(time)]


def _two_levels(time: np.ndarray, pace: float) -> np.ndarray:
    return np.where(_levels(time, pace) < 0.0, -1.0, 1.0)


def _staircase(time: np.ndarray, pace: float) -> np.ndarray:
    return sawtooth(2.0 * np.pi * (np.floor(time / pace) / 16.0 + 0.25), 0.5)


def _ramps(time: np.ndarray, pace: float) -> np.ndarray:
    return sawtooth(2.0 * np.pi * (time / (4.0 * pace) + 0.25), 0.5) * (0.2 + 0.8 * time / time[-1])


def _multisine(time: np.ndarray, pace: float) -> np.ndarray:
    line = np.arange(1, 17)
    waves = np.cos(2.0 * np.pi * np.outer(time, line) / (32.0 * pace) - np.pi * line * (line - 1) / 16.0)
    return waves.sum(axis=1) / np.max(np.abs(waves.sum(axis=1)))


_KINDS = {
    "held levels": _levels,
    "two levels": _two_levels,
    "staircase": _staircase,
    "ramps": _ramps,
    "multisine": _multisine,
}


def rivals() -> list[tuple[str, dict[str, float]]]:
    """Return every rival at several sizes."""
    samples = len(excitation(MODEL, 0)[0])
    return [(name, size) for name, sizes in variants_of(MODEL, samples * _PERIOD).items() for size in sizes]


class Run(NamedTuple):
    """A record to be made: its command [time], m, the supply pressure, Pa, and the outputs that are measured."""

    command: np.ndarray
    supply: float
    measured: tuple[str, ...]

    def outputs(self, points: np.ndarray, effects: Sequence[Mapping]) -> dict[str, np.ndarray]:
        """Return what plants show without noise, [point, time], SI.

        `points` are `[point, number]`: the parameters that are identified, and where the record starts, m.
        """
        plant = dict(zip((*PARAMETERS, "initial_position"), points.T, strict=True))
        step = PRESSURE_STEP if "load_pressure" in self.measured else SERVOVALVE_STEP
        commands = np.tile(self.command, (len(points), 1))
        return servovalve_with(effects, commands, _PERIOD, fine_step=step, supply_pressure=self.supply, **plant)


def _run(rig: Rig, made: int | Experiment, measured: tuple[str, ...]) -> Run:
    """Return the run of a first record, by its excitation's seed, or of a second one."""
    if isinstance(made, Experiment):
        samples = len(excitation(MODEL, 0)[0])
        return Run(command_of(made, rig, samples, _PERIOD), made.supply, measured)
    return Run(excitation(MODEL, made)[0], Valve().supply_pressure, ("position",))


class Bank(NamedTuple):
    """What plants do to one output of one record.

    Attributes:
        plain: `[time]` of the plant without any effect, SI.
        steady: `[time]` which of them count.
        changes: `[change, time]` by each parameter, by this record's start, and by each rival; in units of `UNIT`.
        products: `[change, change]` of these.

    """

    plain: np.ndarray
    steady: np.ndarray
    changes: np.ndarray
    products: np.ndarray


@functools.cache
def _banks(rig: Rig, made: int | Experiment, measured: tuple[str, ...]) -> dict[str, Bank]:
    """Return what plants do to each measured output of a first record, or of a second one."""
    run, some, own = _run(rig, made, measured), rivals(), slice(0, len(PARAMETERS) + 1)
    point, steps = PLAIN[own], STEPS[own]
    points = np.concatenate([point[None], point + np.diag(steps), np.tile(point, (len(some), 1))])
    shown = run.outputs(points, [{}] * (1 + len(point)) + [{name: sizes} for name, sizes in some])
    found = {}
    for name in run.measured:
        plain = shown[name][0]
        # A position has none.
        kept = steady(plain / UNIT[name]) if name == "load_pressure" else np.ones(len(plain), bool)
        changes = ((shown[name][1:] - plain) * kept / UNIT[name]).astype(np.float32)
        found[name] = Bank(plain, kept, changes, (changes @ changes.T).astype(float))
    return found


def _joint(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Add what two records have along all changes: the start of each is its own."""
    p = len(PARAMETERS)
    a, b = (np.insert(each, p + k, 0.0, axis=0) for each, k in ((first, 1), (second, 0)))
    if first.ndim > 1:
        a, b = np.insert(a, p + 1, 0.0, axis=1), np.insert(b, p, 0.0, axis=1)
    return a + b


class Question(NamedTuple):
    """What is asked: of which effect, with its sizes, after which excitation's record, on which rig, with what noise.

    `noise_variance` is that of each output of the second record; of the first, the position is measured.
    """

    name: str
    sizes: Mapping[str, Mapping[str, float]]
    first: int
    rig: Rig
    noise_variance: Mapping[str, float]

    @property
    def measured(self) -> tuple[str, ...]:
        """Outputs of the second record."""
        return tuple(self.noise_variance)


def best(question: Question) -> Best:
    """Return what an exhaustive search finds for a hidden effect."""
    if question.name in EXACTLY_ALIKE[MODEL] and question.measured == ("position",):
        return Best(0.0, EXACTLY_ALIKE[MODEL][question.name], None)
    low, high = question.rig.position
    told, before = [], _truth(question, question.first)
    for second in experiments(question.rig):
        truth = _truth(question, second)
        if np.all((truth["position"] >= low) & (truth["position"] <= high)):
            told.append((*_to_first_order(question, second, before, truth), second))
    told.sort(key=lambda each: -min(each[0].values()))
    found = Best(0.0, "", None)
    for deficits, worth, nearest, second in told[:EXPERIMENTS_REFITTED]:
        for rival in sorted(deficits, key=lambda n: deficits[n])[:REFITTED]:
            if deficits[rival] < OF_FIRST_ORDER * worth and min(deficits.values()) > found.deficit:
                deficits[rival] = min(deficits[rival], _refitted(question, second, rival, nearest[rival]))
        rival = min(deficits, key=lambda n: deficits[n])
        if deficits[rival] > found.deficit:
            found = Best(deficits[rival], rival, second)
    return found


def _truth(question: Question, made: int | Experiment) -> dict[str, np.ndarray]:
    """Return what the plant with the effect shows, [time]."""
    shown = _run(question.rig, made, question.measured).outputs(PLAIN[None, : len(PARAMETERS) + 1], [question.sizes])
    return {name: values[0] for name, values in shown.items()}


class Found(NamedTuple):
    """By how much each rival is worse in both records, what the truth is worth, and each rival's most alike size."""

    deficits: dict[str, float]
    worth: float
    nearest: dict[str, dict[str, float]]


def _to_first_order(
    question: Question, second: Experiment, before: Mapping[str, np.ndarray], truth: Mapping[str, np.ndarray]
) -> Found:
    square, along, products, count = 0.0, [], [], len(PLAIN)
    for made, shown in ((question.first, before), (second, truth)):
        own, gram = 0.0, 0.0
        for name, bank in _banks(question.rig, made, question.measured).items():
            weight = UNIT[name] ** 2 / question.noise_variance[name]
            change = (shown[name] - bank.plain) * bank.steady / UNIT[name]
            square += weight * float(change @ change)
            own, gram = own + weight * (bank.changes @ change), gram + weight * bank.products
        along.append(own)
        products.append(gram)
    projected, both = _joint(*along), _joint(*products)
    # Beside what a refit of the parameters and the starts could do.
    taken = np.linalg.pinv(both[:count, :count], rcond=1e-10, hermitian=True)
    worth = square - projected[:count] @ taken @ projected[:count]
    mixed = both[count:, :count]
    alike = projected[count:] - mixed @ taken @ projected[:count]
    lengths = np.diag(both)[count:] - np.einsum("ij,jk,ik->i", mixed, taken, mixed)
    # What is all but done by the parameters is no rival of its own.
    sure = lengths > 1e-6 * np.diag(both)[count:]
    shares = np.where(sure, alike**2 / np.where(sure, lengths, 1.0), 0.0)
    # Nothing at all is a rival too.
    deficits: dict[str, float] = {"nothing": float(worth)}
    nearest: dict[str, dict[str, float]] = {"nothing": {}}
    for (rival, size), share in zip(rivals(), shares.tolist(), strict=True):
        if rival != question.name and worth - share < deficits.get(rival, np.inf):
            deficits[rival], nearest[rival] = float(worth) - share, size
    return Found(deficits, float(worth), nearest)


def _refitted(question: Question, second: Experiment, rival: str, start: Mapping[str, float]) -> float:
    """Return the noise variances that a rival leaves of both records, refitted in the plant with all parameters."""
    count, p, numbers = len(PLAIN), len(PARAMETERS), np.array([*start.values()])
    point, steps = np.concatenate([PLAIN, numbers]), np.concatenate([STEPS, 1e-4 * np.abs(numbers)])
    lowest = np.full(len(point), -np.inf)
    lowest[:p] = 0.0
    lowest[count:] = 0.0 if rival in ONE_SIDED else -np.inf

    def readings(points, effects):
        found = []
        for k, made in enumerate((question.first, second)):
            shown = _run(question.rig, made, question.measured).outputs(points[:, [*range(p), p + k]], effects)
            for name, bank in _banks(question.rig, made, question.measured).items():
                found.append(shown[name] * bank.steady / question.noise_variance[name] ** 0.5)
        return np.concatenate(found, axis=1)

    def ran(points):
        beside = [{rival: dict(zip(start, one[count:].tolist(), strict=True))} if start else {} for one in points]
        return readings(points, beside)

    truth = readings(PLAIN[None], [question.sizes])[0]

    def left(one):
        return truth - ran(one[None])[0]

    def slopes(one):
        y = ran(np.concatenate([one[None], one + np.diag(steps)]))
        return -((y[1:] - y[0]) / steps[:, None]).T

    with np.errstate(over="ignore", invalid="ignore"):
        found = least_squares(left, point, slopes, bounds=(lowest, np.inf), x_scale="jac", ftol=1e-4, max_nfev=20)
    return float(2.0 * found.cost)
