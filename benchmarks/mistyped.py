"""What does a diagnosis make of what people mistype: bounds, constants, units, signs, channels that are skewed?

    python benchmarks/mistyped.py [--draws 1] [--kind all] [--seed 0]

Servovalves of an independent plant (tests/hidden_plants.py) that hide nothing, one mistake each: the bounds of a
parameter that leave the truth outside, below or above; a constant that is given 3 to 100 times as large as it is, or as
small; a column in another unit; one with the other sign; a position that was read up to five samples before the command
or after it. Right is an answer that holds the mistake, alone or in a group, and nothing false beside it; a refusal or
the first warning of the fit that names it is as good.
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
import numpy as np
import pandas as pd

import ehsvjax
from benchmarks.processes import rows_of, said
from ehsvjax.diagnosis import diagnose
from tests.hidden_plants import Valve, held_levels, servovalve_with

PERIOD, SAMPLES = 1e-3, 2500
NOISE = 1e-4  # m, deviation
CONSTANTS = ("mass", "stiffness", "piston_area", "supply_pressure")
PARAMETERS = ("dead_zone", "saturation", "flow_gain", "feedback_gain", "damping_ratio", "natural_frequency")
COLUMNS = ("command", "position")
# Of the flow gain, the area and the supply a position tells one number only, and of what scales the whole record.
FLOW = {"flow_gain", "piston_area", "supply_pressure"}
MEANT: dict[str, set[str]] = {
    **{name: {name} for name in (*PARAMETERS, *CONSTANTS)},
    **dict.fromkeys(FLOW, FLOW),
    "position": {"sensor_gain", "feedback_gain", "input_gain"},
    "command": {"sensor_gain", "feedback_gain", "input_gain"},
    "skew": {"transport_delay"},
}


class Trial(NamedTuple):
    """One record with a mistake: its kind, what it is about, by which factor or how many samples, and the seed."""

    kind: str
    name: str
    size: float
    seed: int


def trials_of(options) -> list[Trial]:
    """Return every trial that was asked for."""
    rng = np.random.default_rng(options.seed)
    found = []

    def add(kind, name, size):
        found.append(Trial(kind, name, float(size), int(rng.integers(2**31))))

    for _ in range(options.draws):
        for name in PARAMETERS:
            add("bounds below", name, rng.uniform(0.4, 0.9))
            add("bounds above", name, 1.0 / rng.uniform(0.4, 0.9))
        for name in CONSTANTS:
            for sign in (-1.0, 1.0):
                add("constant", name, 10.0 ** (sign * rng.uniform(0.5, 2.0)))
        for name in COLUMNS:
            add("unit", name, rng.choice([25.4, 10.0, 100.0, 1000.0]) ** rng.choice([-1.0, 1.0]))
            add("sign", name, -1.0)
        for sign in (-1.0, 1.0):
            add("skew", "skew", sign * rng.integers(1, 6))
    return [t for t in found if options.kind in ("all", t.kind)]


def record_of(trial: Trial) -> ehsvjax.Record:
    """Return what was measured, with the mistakes that are in the columns."""
    rng = np.random.default_rng([3, trial.seed])
    late = int(trial.size) if trial.kind == "skew" else 0
    command = held_levels(rng, 3e-3, SAMPLES // 100 + 1, 100)[: SAMPLES + abs(late)]
    position = servovalve_with([{}], command[None], PERIOD)["position"][0]
    position = position + NOISE * rng.standard_normal(len(position))
    # Of a positive skew the position was read before the command.
    columns = {"command": command[max(-late, 0) :][:SAMPLES], "position": position[max(late, 0) :][:SAMPLES]}
    if trial.kind in ("unit", "sign"):
        columns[trial.name] = trial.size * columns[trial.name]
    time_s = PERIOD * np.arange(SAMPLES)
    return ehsvjax.Record(time_s, {"command": columns["command"]}, {"position": columns["position"]})


def bounds_of(trial: Trial) -> dict[str, tuple[float, float]] | None:
    """Return the bounds that are handed over: a factor of ten wide, the truth below or above them."""
    if not trial.kind.startswith("bounds"):
        return None
    nearest = trial.size * getattr(Valve(), trial.name)
    return {trial.name: (0.1 * nearest, nearest) if trial.size < 1.0 else (nearest, 10.0 * nearest)}


def tried(trials: list[Trial]) -> list[dict[str, Any]]:
    """Make and diagnose the records of some trials, in whatever process this is."""
    rows = []
    for trial in trials:
        record, key = record_of(trial), jax.random.key(trial.seed)
        given = {trial.name: trial.size * getattr(Valve(), trial.name)} if trial.kind == "constant" else {}
        row: dict[str, Any] = trial._asdict()
        began = time.perf_counter()
        try:
            fit = ehsvjax.identify(
                ehsvjax.servovalve(**given), record, key=key, population=50, generations=20, bounds=bounds_of(trial)
            )
            row["warning"] = next(iter(fit.warnings), "")
            row |= said(diagnose(fit, record, key=key, progress=False))
        except ValueError as error:
            row |= {"verdict": "refused", "warning": str(error)}
        except Exception:  # a failure is a result, and the others go on
            row |= {"verdict": "failed", "error": traceback.format_exc(limit=-4)}
        rows.append(row | {"seconds": time.perf_counter() - began})
    return rows


SAID: dict[str, Callable[[str], bool]] = {
    "sign": lambda words: "opposite sign" in words,
    "unit": lambda words: "unit" in words and "would give fit" in words,
    "constant": lambda words: "mind the unit" in words,
}


def outcome(row) -> str:
    """Judge one trial."""
    told = row["kind"] in SAID and SAID[row["kind"]](row.get("warning", ""))
    if row["verdict"] in ("refused", "failed"):
        return "refused, and why" if told else "failed"
    meant = MEANT[row["name"]]
    groups = [set(group) for group in row["groups"]]
    alone = set(row["causes"]) - set().union(*groups)
    false = bool(alone - meant) or any(not group & meant for group in groups)
    true = bool(alone & meant) or any(group & meant for group in groups)
    if true and not false:
        return "named" if row["verdict"] == "named" else "in a group with the truth"
    if told:
        return "said by the fit"
    if row["verdict"] in ("adequate", "unexplained"):
        return {"adequate": "not seen", "unexplained": "unexplained"}[row["verdict"]]
    return "truth, and something false" if true else "false"


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=1, help="of every mistake")
    kinds = ("bounds below", "bounds above", "constant", "unit", "sign", "skew")
    parser.add_argument("--kind", choices=["all", *kinds], default="all")
    parser.add_argument("--seed", type=int, default=0, help="of all trials")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    options = parser.parse_args()
    rows = rows_of(tried, trials_of(options), lambda trial: trial.kind, options.out / "mistyped.json")
    table = pd.DataFrame(rows)
    table["outcome"] = [outcome(row) for row in rows]
    print(pd.crosstab(table["kind"], table["outcome"]).to_string())
    for _, row in table.iterrows():
        answer = row.get("causes") or row["verdict"]
        print(f"{row['kind']:13} {row['name']:18} x {row['size']:<8.3g} {row['outcome']:27} {answer}")
    print(f"seconds each: median {table['seconds'].median():.0f}, most {table['seconds'].max():.0f}")


if __name__ == "__main__":
    main()
