"""Is a diagnosis right where several outputs are measured, and where a constant was given wrong?

    python benchmarks/several_outputs.py [--nulls 250] [--draws 1] [--kind all] [--seed 0]

Servovalves of independent plants (tests/plants.py by LSODA, tests/hidden_plants.py in steps of 10 us). Nothing hidden:
two outputs or three, four kinds of excitation. One effect of each kind, position and load pressure measured. Constants
that were given wrong, from 20% to a factor of 3, with the position alone and with the load pressure: told is what a
refit of everything else in the plant leaves, in noise variances.
"""

import argparse
import sys
import time
import traceback
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))

import jax
import numpy as np
import pandas as pd
from scipy.optimize import least_squares

import ehsvjax
from benchmarks.processes import rows_of, said
from ehsvjax.diagnosis import diagnose
from tests.hidden_plants import SERVOVALVE_EFFECTS, servovalve_with
from tests.hidden_records import Hidden, sizes_of
from tests.plants import Valve, held_levels, servovalve_plant

PERIOD, SAMPLES = 1e-3, 5000
# Deviations of the sensors' noise, SI.
NOISE = {"position": 3e-4, "spool": 2e-5, "load_pressure": 5e4}
# Steps of the plant in which a load pressure is known to a few readings.
FINE_STEP = 1e-5
CONSTANTS = ("mass", "stiffness", "piston_area", "supply_pressure", "leakage_coefficient")
# Noise variances from which an effect can be told from nothing.
SEEN = 25.0
# And deviations of the noise between two readings that are a jump.
JUMP = 10.0


class Trial(NamedTuple):
    """One record to be made and diagnosed: of no effect, of one, or of a constant that is another by a factor."""

    kind: str
    outputs: tuple[str, ...]
    excitation: str
    name: str
    factor: float
    seed: int


def trials_of(options) -> list[Trial]:
    """Return every trial that was asked for."""
    rng = np.random.default_rng(options.seed)
    two, three = ("position", "load_pressure"), ("position", "spool", "load_pressure")
    found = []

    def add(kind, outputs, excitation="levels", name="", factor=1.0):
        found.append(Trial(kind, outputs, excitation, name, factor, int(rng.integers(2**31))))

    for i in range(options.nulls):
        add("none", (two, three)[i % 2], tuple(EXCITATIONS)[i // 2 % len(EXCITATIONS)])
    for _ in range(options.draws):
        for name in SERVOVALVE_EFFECTS:
            if not name.startswith("unknown") and name != "sensor_quantisation":
                add("one", two, name=name)
        for name in CONSTANTS:
            for outputs in (("position",), two):
                factor = float(np.exp(rng.uniform(np.log(1.2), np.log(3.0))))
                add("constant", outputs, name=name, factor=factor ** rng.choice([-1.0, 1.0]))
    return [t for t in found if options.kind in ("all", t.kind)]


def _multisine(rng) -> np.ndarray:
    time_s = PERIOD * np.arange(SAMPLES)
    frequencies = np.arange(1, 60) / (PERIOD * SAMPLES) * 2.0
    phases = rng.uniform(0.0, 2.0 * np.pi, len(frequencies))
    waves = np.cos(2.0 * np.pi * np.outer(time_s, frequencies) + phases).sum(axis=1)
    # Held for five samples, as a slow controller would give it.
    return np.repeat((6e-3 * waves / np.max(np.abs(waves)))[::5], 5)


def _staircase(rng) -> np.ndarray:
    levels = np.concatenate([np.linspace(-6e-3, 6e-3, 13), np.linspace(6e-3, -6e-3, 12)])
    return np.repeat(levels + rng.uniform(-2e-4, 2e-4, 25), SAMPLES // 25)


EXCITATIONS = {
    "levels": lambda rng: held_levels(rng, 6e-3, 25, 200),
    "short levels": lambda rng: held_levels(rng, 6e-3, 100, 50),
    "multisine": _multisine,
    "staircase": _staircase,
}


def excited(trial: Trial) -> np.ndarray:
    """Return the command [time], m."""
    return EXCITATIONS[trial.excitation](np.random.default_rng([5, trial.seed]))


def given(trial: Trial) -> dict[str, float]:
    """Return what is given for the constant of a trial, which in the plant is `factor` times that."""
    if trial.kind != "constant":
        return {}
    # A leakage is given as one that shows in the load pressure; there may also be none in the plant.
    value = 1e-11 if trial.name == "leakage_coefficient" else getattr(Valve(), trial.name)
    return {trial.name: value}


def made(trials: list[Trial]) -> list[dict[str, np.ndarray]]:
    """Return the outputs of each trial without noise, `[time]` by name."""
    found: list[dict[str, np.ndarray]] = []
    for trial in trials:
        if trial.kind == "one":
            continue
        constants = {name: trial.factor * value for name, value in given(trial).items()}
        motion = servovalve_plant(excited(trial), PERIOD, **constants)
        found.append({name: getattr(motion, name) for name in trial.outputs})
    one = [t for t in trials if t.kind == "one"]
    if one:
        effects = [sizes_of(Hidden("servovalve", "white", 0.0, (t.name,), t.seed), np.random.default_rng(t.seed))
                   for t in one]  # fmt: skip
        batch = servovalve_with(effects, np.stack([excited(t) for t in one]), PERIOD, fine_step=FINE_STEP)
        found += [{name: batch[name][i] for name in t.outputs} for i, t in enumerate(one)]
    return found


def steady(output: np.ndarray, jump: float = JUMP) -> np.ndarray:
    """Return which readings of an output, in deviations of its noise, are less than a jump from both neighbours."""
    near = np.abs(np.diff(output)) < jump
    return np.append(True, near) & np.append(near, True)


def worth(trial: Trial, clean: dict[str, np.ndarray]) -> float:
    """Return the noise variances that a wrong constant leaves when everything else is refitted in the plant.

    Of readings that are not beside a jump: on those the plant's own last bit would decide.
    """
    names = ("dead_zone", "saturation", "flow_gain", "feedback_gain", "damping_ratio", "natural_frequency")
    start = np.array([getattr(Valve(), name) for name in names])
    command = excited(trial)
    # In proportion where the supply or the area is absorbed by the flow gain.
    ratio = {"supply_pressure": trial.factor**0.5, "piston_area": 1.0 / trial.factor}.get(trial.name, 1.0)
    start[2] *= ratio
    readable = {name: steady(clean[name] / NOISE[name]) for name in trial.outputs}

    def left(logarithms):
        values = dict(zip(names, start * np.exp(logarithms), strict=True))
        motion = servovalve_plant(command, PERIOD, rtol=1e-8, **values, **given(trial))
        return np.concatenate([(getattr(motion, n) - clean[n])[readable[n]] / NOISE[n] for n in trial.outputs])

    def slopes(logarithms):
        step = 1e-4
        changes = np.stack([left(logarithms + by) - left(logarithms - by) for by in step * np.eye(len(names))], axis=1)
        # Where a jump passes a reading there is no slope, and one would end the descent.
        return np.where(np.abs(changes) < JUMP, changes, 0.0) / (2.0 * step)

    best = least_squares(left, np.zeros(len(names)), slopes, max_nfev=12, xtol=1e-6, ftol=1e-4)
    return float(2.0 * best.cost)


def tried(trials: list[Trial]) -> list[dict[str, Any]]:
    """Make and diagnose the records of some trials of one kind, in whatever process this is."""
    rows = []
    for trial, clean in zip(trials, made(trials), strict=True):
        rng = np.random.default_rng([9, trial.seed])
        measured = {n: y + NOISE[n] * rng.standard_normal(SAMPLES) for n, y in clean.items()}
        record = ehsvjax.Record(PERIOD * np.arange(SAMPLES), {"command": excited(trial)}, measured)
        row: dict[str, Any] = trial._asdict()
        key = jax.random.key(trial.seed)
        # Where the area or the supply is off, so is the flow gain that makes up for it.
        bounds = {"flow_gain": (3e-5, 6e-4)} if trial.kind == "constant" else None
        began = time.perf_counter()
        try:
            model = ehsvjax.servovalve(**given(trial))
            fit = ehsvjax.identify(model, record, key=key, population=50, generations=20, bounds=bounds)
            identified = time.perf_counter()
            d = diagnose(fit, record, key=key, progress=False)
        except Exception:  # a failure is a result, and the others go on
            rows.append(row | {"verdict": "failed", "error": traceback.format_exc(limit=-4)})
            continue
        row |= {
            **said(d),
            "step_size": d.integration.step_size,
            "left_out": sum(d.integration.left_out.values()),
            "arithmetic": d.integration.worth,
            "seconds": time.perf_counter() - identified,
            "seconds_to_fit": identified - began,
        }
        if trial.kind == "constant":
            row["worth"] = worth(trial, clean)
        rows.append(row)
    return rows


def outcome(row) -> str:
    """Judge one trial."""
    if row["verdict"] in ("failed", "unexplained", "no oracle"):
        return row["verdict"]
    if row["kind"] == "none":
        return "right" if row["verdict"] == "adequate" else "false alarm"
    if row["verdict"] == "adequate":
        return "not seen"
    causes = [c.partition("@")[0] for c in row["causes"]]
    groups = [{c.partition("@")[0] for c in group} for group in row["groups"]]
    held = row["name"] in causes or any(row["name"] in g for g in groups)
    if not held:
        return "wrong"
    if len(causes) > 1:
        return "truth and more"
    return "named" if row["verdict"] == "named" else "ambiguous, truth within"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nulls", type=int, default=250, help="records without any effect")
    parser.add_argument("--draws", type=int, default=1, help="of every effect and of every wrong constant")
    parser.add_argument("--kind", choices=["all", "none", "one", "constant"], default="all")
    parser.add_argument("--seed", type=int, default=0, help="of all trials")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    options = parser.parse_args()
    rows = rows_of(tried, trials_of(options), lambda t: t.kind, options.out / "several_outputs.json")
    table = pd.DataFrame(rows)
    table["outcome"] = [outcome(row) for _, row in table.iterrows()]
    table["measured"] = table["outputs"].map(", ".join)
    for (kind, measured), some in table.groupby(["kind", "measured"]):
        found = some["outcome"].value_counts()
        print(f"{kind}, {measured}: {len(some)} trials: " + ", ".join(f"{n} {what}" for what, n in found.items()))
        if kind == "constant":
            seen = some[some["worth"] > SEEN]["outcome"].value_counts()
            print(f"    worth more than {SEEN:g}: " + ", ".join(f"{n} {what}" for what, n in seen.items()))
    print(f"arithmetic in any comparison: at most {table['arithmetic'].max():.3g} noise variances, readings left out: "
          f"median {table['left_out'].median():.0f}, at most {table['left_out'].max():.0f}")  # fmt: skip
    print(
        f"seconds a diagnosis: median {table['seconds'].median():.1f}, 90% below {table['seconds'].quantile(0.9):.1f}"
    )
    off = table[~table["outcome"].isin(["right", "named", "ambiguous, truth within", "not seen"])]
    columns = ["kind", "measured", "excitation", "name", "factor", "seed", "worth", "verdict", "causes", "groups"]
    print(off[[c for c in columns if c in off]].to_string())


if __name__ == "__main__":
    main()
