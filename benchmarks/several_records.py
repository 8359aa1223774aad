"""Does a second record settle what one leaves open, and does a diagnosis say what records disagree about?

    python benchmarks/several_records.py [--draws 1] [--nulls 30] [--kind all] [--seed 0]

Servovalves of the independent plants (tests/hidden_plants.py), two records each: 5 s of held levels, and 3 s of others
at half the supply pressure, at two thirds of the amplitude, or with the load pressure measured too. Hidden is one
effect of each kind, in both; nothing; an effect in the second record alone; or a parameter, a constant or the sensor's
zero that is another there. Of effects the plant says what two records can tell, the parameters refitted, to first order
and where that is not enough by least squares: the noise variances by which the best rival fits both worse.
"""

import argparse
import functools
import sys
import time
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))

import jax
import numpy as np
import pandas as pd
from scipy.optimize import least_squares

import ehsvjax
from benchmarks.diagnosis import base, counts
from benchmarks.processes import rows_of, said
from benchmarks.several_outputs import FINE_STEP, steady
from ehsvjax.diagnosis import Diagnosis, diagnose
from tests.hidden_oracle import EXACTLY_ALIKE, SEPARABLE, variants_of
from tests.hidden_plants import SERVOVALVE_EFFECTS, SERVOVALVE_STEP, Valve, held_levels, servovalve_with
from tests.hidden_records import ONE_SIDED, TRUTH, Hidden, sizes_of

MODEL, PERIOD = "servovalve", 1e-3
NOISE = {"position": 1e-4, "load_pressure": 5e4}
CONDITIONS = ("half the supply", "less amplitude", "load pressure too")
# Deviations of the noise between two readings that are a jump: a position may move by ten from sample to sample.
JUMP = 30.0
# What may change between two records, and by how much, in shares of it; the zero in m.
CHANGES = {
    "flow_gain": (0.03, 0.3), "feedback_gain": (0.03, 0.3), "dead_zone": (0.1, 0.8), "damping_ratio": (0.1, 0.5),
    "natural_frequency": (0.05, 0.3), "supply_pressure": (0.05, 0.3), "piston_area": (0.03, 0.3), "zero": (1e-4, 1e-3),
}  # fmt: skip
# Shares of what an effect is worth below which what a rival leaves to first order is not trusted, and how many rivals
# are refitted.
OF_FIRST_ORDER, REFITTED = 0.03, 3
# What is refitted in the plants: the identified parameters, the start of each record, m; changes for derivatives.
PLAIN = np.array([*TRUTH[MODEL].values(), 0.0, 0.0])
STEPS = np.array([*(1e-5 * PLAIN[:-2]), 1e-6, 1e-6])


class Trial(NamedTuple):
    """Two records to be made and diagnosed, the second at a condition of its own: what is hidden, and the seed."""

    kind: str
    name: str
    condition: str
    seed: int


class Stroke(NamedTuple):
    """One record: its command [time], the constants of the rig, what is measured, and the step of the plant, s."""

    command: np.ndarray
    constants: dict[str, float]
    outputs: tuple[str, ...]
    step: float


def trials_of(options) -> list[Trial]:
    """Return every trial that was asked for."""
    rng = np.random.default_rng(options.seed)
    found = []

    def add(kind, name):
        found.append(Trial(kind, name, CONDITIONS[len(found) % len(CONDITIONS)], int(rng.integers(2**31))))

    effects = [n for n in SERVOVALVE_EFFECTS if not n.startswith("unknown") and n != "sensor_quantisation"]
    for _ in range(options.draws):
        for name in effects:
            add("one", name)
        for name in rng.choice(effects, len(effects) // 3, replace=False).tolist():
            add("in the second alone", name)
        for name in CHANGES:
            add("changed", name)
    for _ in range(options.nulls):
        add("none", "")
    return [t for t in found if options.kind in ("all", t.kind)]


@functools.cache
def strokes(condition: str) -> tuple[Stroke, Stroke]:
    """Return what is run: the first record's command is the same in all trials, the second's at each condition."""
    first, second = (np.random.default_rng([6, k]) for k in range(2))
    amplitude = 4e-3 if condition == "less amplitude" else 6e-3
    constants = {"supply_pressure": 0.5 * Valve().supply_pressure} if condition == "half the supply" else {}
    outputs = ("position", "load_pressure") if condition == "load pressure too" else ("position",)
    step = FINE_STEP if len(outputs) > 1 else SERVOVALVE_STEP
    return (
        Stroke(held_levels(first, 6e-3, 25, 200), {}, ("position",), SERVOVALVE_STEP),
        Stroke(held_levels(second, amplitude, 15, 200), constants, outputs, step),
    )


def run(stroke: Stroke, effects: Sequence[Mapping], **plant) -> np.ndarray:
    """Return the readings [plant, reading] of one record without noise, one output after the other, over its noise."""
    commands = np.tile(stroke.command, (len(effects), 1))
    found = servovalve_with(effects, commands, PERIOD, fine_step=stroke.step, **{**stroke.constants, **plant})
    return np.concatenate([found[name] / NOISE[name] for name in stroke.outputs], axis=1)


def clean_of(trial: Trial, sizes: Mapping) -> list[np.ndarray]:
    """Return the readings of both records without noise, `[reading]` each."""
    first, second = strokes(trial.condition)
    rng = np.random.default_rng([7, trial.seed])
    if trial.kind != "changed":
        return [run(first, [sizes if trial.kind == "one" else {}])[0], run(second, [sizes])[0]]
    by = float(np.exp(rng.uniform(*np.log(CHANGES[trial.name])))) * rng.choice([-1.0, 1.0])
    if trial.name == "zero":
        other = run(second, [{}])[0]
        other[: len(second.command)] += by / NOISE["position"]
        return [run(first, [{}])[0], other]
    # Of the supply, what is known of the second record is wrong.
    value = second.constants.get(trial.name, getattr(Valve(), trial.name))
    return [run(first, [{}])[0], run(second, [{}], **{trial.name: value * (1.0 + by)})[0]]


def record_of(stroke: Stroke, readings: np.ndarray, name: str, rng) -> ehsvjax.Record:
    """Return a record with noise."""
    noisy = readings + rng.standard_normal(len(readings))
    outputs = {o: NOISE[o] * y for o, y in zip(stroke.outputs, np.split(noisy, len(stroke.outputs)), strict=True)}
    time_s = PERIOD * np.arange(len(stroke.command))
    record = ehsvjax.Record(time_s, {"command": stroke.command}, outputs, name=name)
    return record.at(**stroke.constants) if stroke.constants else record


def readings_of(condition: str, points: np.ndarray, effects: Sequence[Mapping]) -> np.ndarray:
    """Return the readings [point, reading] of both records, one after the other, of plants with effects.

    `points` are `[point, number]`: the identified parameters, and where each record starts, m.
    """
    plant = {name: points[:, i] for i, name in enumerate(TRUTH[MODEL])}
    starts = points[:, len(TRUTH[MODEL]) :].T
    found = [run(s, effects, initial_position=x, **plant) for s, x in zip(strokes(condition), starts, strict=True)]
    return np.concatenate(found, axis=1)


class Library(NamedTuple):
    """What plants do in both records of one condition, `[reading]` each, over the noise.

    Attributes:
        plain: the readings of the plant without any effect.
        steady: which of them are less than a jump from both neighbours; only those count.
        basis: `[reading, direction]` what refits of the plant could do.
        effects: rivals at several sizes.
        directions: `[rival, reading]` what each does beside that, of unit length.

    """

    plain: np.ndarray
    steady: np.ndarray
    basis: np.ndarray
    effects: list[dict[str, dict[str, float]]]
    directions: np.ndarray

    def beside(self, readings: np.ndarray) -> np.ndarray:
        """Return what readings [..., reading] have that no refit of the plain plant has, to first order."""
        change = (readings - self.plain) * self.steady
        return change - (change @ self.basis) @ self.basis.T


@functools.cache
def library(condition: str) -> Library:
    """Return what plants do in both records of one condition."""
    y = readings_of(condition, np.concatenate([PLAIN[None], PLAIN + np.diag(STEPS)]), [{}] * (1 + len(PLAIN)))
    kept = steady(y[0], JUMP)
    basis = np.linalg.qr(((y[1:] - y[0]) * kept).T)[0]
    variants = variants_of(MODEL, PERIOD * len(strokes(condition)[0].command))
    effects = [{name: sizes} for name, some in variants.items() for sizes in some]
    bare = Library(y[0], kept, basis, effects, np.zeros((0, len(y[0]))))
    left = bare.beside(readings_of(condition, np.tile(PLAIN, (len(effects), 1)), effects))
    return bare._replace(directions=left / np.maximum(np.linalg.norm(left, axis=1, keepdims=True), 1e-300))


def deficit_of(trial: Trial, clean: Sequence[np.ndarray]) -> tuple[float, str]:
    """Return the noise variances by which the best rival of an effect fits both records worse, and that rival."""
    alike = EXACTLY_ALIKE[MODEL].get(trial.name)
    if alike is not None:
        return 0.0, alike
    known, both = library(trial.condition), np.concatenate(clean)
    left = known.beside(both)
    worth = float(left @ left)
    like = known.directions @ left / max(worth, 1e-300) ** 0.5
    deficits: dict[str, float] = {}
    nearest: dict[str, Mapping] = {}
    for cosine, effect in zip(like.tolist(), known.effects, strict=True):
        (name,) = effect
        if name != trial.name and worth * (1.0 - cosine**2) < deficits.get(name, np.inf):
            deficits[name], nearest[name] = worth * (1.0 - cosine**2), effect
    for name in sorted(deficits, key=lambda name: deficits[name])[:REFITTED]:
        if deficits[name] < OF_FIRST_ORDER * worth and min(deficits.values()) > SEPARABLE:
            deficits[name] = min(deficits[name], _refitted(trial.condition, both, nearest[name]))
    rival = min(deficits, key=lambda name: deficits[name])
    return deficits[rival], rival


def _refitted(condition: str, both: np.ndarray, effect: Mapping) -> float:
    """Return the noise variances that a rival leaves of both records, refitted in the plant with all parameters."""
    ((name, sizes),) = effect.items()
    kept, numbers = library(condition).steady, np.array([*sizes.values()])
    start = np.concatenate([PLAIN, numbers])
    steps = np.concatenate([STEPS, 1e-4 * np.abs(numbers)])
    lowest = np.full(len(start), -np.inf)
    lowest[: len(TRUTH[MODEL])] = 0.0
    lowest[len(PLAIN) :] = 0.0 if name in ONE_SIDED else -np.inf

    def simulated(points):
        some = [{name: dict(zip(sizes, point[len(PLAIN) :].tolist(), strict=True))} for point in points]
        return readings_of(condition, points[:, : len(PLAIN)], some)

    def left(point):
        return (both - simulated(point[None])[0]) * kept

    def slopes(point):
        y = simulated(np.concatenate([point[None], point + np.diag(steps)]))
        return -((y[1:] - y[0]) * kept / steps[:, None]).T

    with np.errstate(over="ignore", invalid="ignore"):
        found = least_squares(left, start, slopes, bounds=(lowest, np.inf), x_scale="jac", ftol=1e-4, max_nfev=20)
    return float(2.0 * found.cost)


def tried(trials: list[Trial]) -> list[dict[str, Any]]:
    """Make and diagnose the records of some trials, in whatever process this is."""
    rows = []
    for trial in trials:
        rng = np.random.default_rng([8, trial.seed])
        names = (trial.name,) if trial.kind in ("one", "in the second alone") else ()
        sizes = sizes_of(Hidden(MODEL, "white", NOISE["position"] ** 2, names, trial.seed), rng)
        clean = clean_of(trial, sizes)
        records = [
            record_of(stroke, readings, name, rng)
            for stroke, readings, name in zip(strokes(trial.condition), clean, ("first", "second"), strict=True)
        ]
        row: dict[str, Any] = trial._asdict() | {"sizes": sizes}
        key = jax.random.key(trial.seed)
        try:
            row["alone"] = _told(records[:1], trial, key) if trial.kind == "one" else None
            began = time.perf_counter()
            found = _diagnosed(records, key)
            row |= said(found) | {"seconds": time.perf_counter() - began, "outcome": outcome(trial, found)}
            row["wanted_by"] = {cause.name: cause.records for cause in found.causes}
            row["sizes_by_record"] = {c.name: [(s.record, s.value) for s in c.sizes] for c in found.causes}
        except Exception:  # a failure is a result, and the others go on
            rows.append(row | {"verdict": "failed", "outcome": "failed", "error": traceback.format_exc(limit=-4)})
            continue
        if trial.kind == "one":
            row["deficit"], row["rival"] = deficit_of(trial, clean)
        rows.append(row)
    return rows


def _diagnosed(records: Sequence[ehsvjax.Record], key) -> Diagnosis:
    fit = ehsvjax.identify(ehsvjax.servovalve(), records, key=key, population=50, generations=20)
    return diagnose(fit, records, key=key, progress=False)


def _told(records: Sequence[ehsvjax.Record], trial: Trial, key) -> str:
    return outcome(trial, _diagnosed(records, key))


def outcome(trial: Trial, found: Diagnosis) -> str:
    """Judge one diagnosis."""
    if found.alone and trial.kind == "in the second alone":
        first, second = found.alone
        right = trial.name in map(base, second.suspected)
        return "said, with the record" if right and not first.names else "wrong"
    if found.verdict == "unexplained":
        return found.verdict
    if trial.kind == "none":
        return "right" if found.verdict == "adequate" else "false alarm"
    if found.verdict == "adequate":
        return "not seen"
    truth = f"change_of_{trial.name}" if trial.kind == "changed" else trial.name
    causes = [base(name) for name in found.names]
    within = any(truth in map(base, group.causes) for group in found.alternatives)
    if trial.kind == "in the second alone":
        # No model has it in one record and not in the other: what counts is that the record is said.
        if all(cause.of_run or cause.records == ("second",) or cause.contradicted_by for cause in found.causes):
            return "said, with the record"
        return "blamed on both" if truth in causes or within else "wrong"
    if not (truth in causes or within):
        return "wrong"
    if len(causes) > 1:
        return "truth and more"
    return "named" if found.verdict == "named" else "ambiguous, truth within"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=1, help="of every effect, at conditions in turn")
    parser.add_argument("--nulls", type=int, default=30, help="pairs of records without any effect")
    parser.add_argument("--kind", choices=["all", "one", "none", "in the second alone", "changed"], default="all")
    parser.add_argument("--seed", type=int, default=0, help="of all trials")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    options = parser.parse_args()
    rows = rows_of(tried, trials_of(options), lambda t: (t.kind, t.condition), options.out / "several_records.json")
    table = pd.DataFrame(rows)
    for kind, some in table.groupby("kind", sort=False):
        print(f"{kind}: {counts(some)}")
        if kind != "one":
            continue
        told = some[some["deficit"] > SEPARABLE]
        print(f"    best rival worse by more than {SEPARABLE:g}: {counts(told)}")
        print(f"    rivals closer: {counts(some[~(some['deficit'] > SEPARABLE)])}")
        for condition, of in some.groupby("condition", sort=False):
            settled = of["outcome"] == "named"
            left_open = (of["alone"] != "named") & (of["deficit"] > SEPARABLE)
            alone = (of["alone"] == "named").sum()
            print(f"    {condition}: the first record alone named {alone} of {len(of)}; of the rest two can tell "
                  f"{left_open.sum()}, and named {(left_open & settled).sum()}")  # fmt: skip
    print(
        f"seconds a diagnosis: median {table['seconds'].median():.1f}, 90% below {table['seconds'].quantile(0.9):.1f}"
    )
    off = table[~table["outcome"].isin(["right", "named", "ambiguous, truth within", "said, with the record"])]
    columns = ["kind", "condition", "name", "sizes", "seed", "deficit", "rival", "verdict", "causes", "groups"]
    print(off[[c for c in columns if c in off]].to_string())


if __name__ == "__main__":
    main()
