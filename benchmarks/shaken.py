"""Is a random force taken for chance, alone and beside a cause? A ball that rolls along a beam, which nothing holds.

    python benchmarks/shaken.py [--draws 20] [--seed 0] [--out out/benchmarks]

The plant of tests/small_models.py, which shares nothing with the package, with a force that is white, and with nothing
else, or a spring that the model lacks. What chance does to it is integrated twice: in seconds it leaves more than any
sensor's noise, in a few slow directions, in which every cause can follow it. The force's density and the spring are
drawn by a factor of ten; of each spring the plant says what it is worth under the force that acted, in variances of
chance.
"""

import argparse
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))

import jax
import numpy as np
import pandas as pd

import ehsvjax
from benchmarks.processes import rows_of
from ehsvjax.diagnosis.decision.verdict import PROCESS_NOISE, UNKNOWN
from tests.small_models import ball, shaken_ball

PERIOD, NOISE, HELD = 0.1, 5e-4, 8
DENSITIES, STIFFNESSES = (1e-5, 1e-4), (0.03, 0.3)
SPRING = "linear_stiffness"
# Worth, in variances of chance, from which a spring should be named.
SEEN = 5.0**2


class Trial(NamedTuple):
    """One record to be made and diagnosed."""

    samples: int
    density: float
    stiffness: float
    seed: int


def trials_of(draws: int, seed: int) -> list[Trial]:
    """Return the trials, with a spring and without."""
    rng = np.random.default_rng(seed)

    def between(bounds):
        return float(np.exp(rng.uniform(*np.log(bounds))))

    return [
        Trial(samples, between(DENSITIES), between(STIFFNESSES) if spring else 0.0, int(rng.integers(2**31)))
        for _ in range(draws) for samples in (336, 672) for spring in (False, True)
    ]  # fmt: skip


def worth(angle, trial: Trial) -> float:
    """Return what a spring is worth, the gain, the damping and the start refitted, to first order at the true plant.

    In variances of what is of chance: the sensor's noise and what a force does that is held from sample to sample.
    """

    def moved(angle, **plant):
        return shaken_ball(angle, PERIOD, 0.0, np.random.default_rng(0), **plant)

    count, plant = len(angle), {"gain": 5.0, "damping": 0.5, "stiffness": trial.stiffness}
    here = moved(angle, **plant)
    kick = np.zeros(count)
    kick[0] = 1.0 / plant["gain"]
    response = moved(kick, **plant)
    forces = np.stack([np.concatenate([np.zeros(k), response[: count - k]]) for k in range(count)])
    covariance = NOISE**2 * np.eye(count) + trial.density / PERIOD * forces.T @ forces
    slopes = [moved(angle, **{**plant, name: 1.001 * plant[name]}) - here for name in ("gain", "damping")]
    spring = (moved(angle, **{**plant, "stiffness": trial.stiffness + 1e-4}) - here) * trial.stiffness / 1e-4
    root = np.linalg.cholesky(covariance)
    known = np.linalg.solve(root, np.stack([*slopes, np.ones(count), response]).T)
    known /= np.linalg.norm(known, axis=0)
    seen = np.linalg.solve(root, spring)
    left = seen - known @ np.linalg.lstsq(known, seen, rcond=None)[0]
    return float(left @ left)


def tried(trials: list[Trial]) -> list[dict[str, Any]]:
    """Make the records, diagnose them, and return what was said."""
    return [_tried(trial) for trial in trials]


def _tried(trial: Trial) -> dict[str, Any]:
    rng = np.random.default_rng(trial.seed)
    angle = np.repeat(rng.uniform(-0.05, 0.05, trial.samples // HELD), HELD)
    position = shaken_ball(angle, PERIOD, trial.density, rng, stiffness=trial.stiffness)
    position += rng.normal(0.0, NOISE, len(angle))
    record = ehsvjax.Record(PERIOD * np.arange(len(angle)), {"angle": angle}, {"position": position})
    began = time.perf_counter()
    fit = ehsvjax.identify(ball(), record, key=jax.random.key(0))
    found = ehsvjax.diagnose(fit, record, key=jax.random.key(1))
    return {
        **trial._asdict(),
        "worth": worth(angle, trial) if trial.stiffness else 0.0,
        "verdict": found.verdict,
        "causes": [cause.name for cause in found.causes],
        "groups": [group.causes for group in found.alternatives],
        "density found": found.process_noise.intensity if found.process_noise else None,
        "spring found": next((c.sizes[0].value for c in found.causes if c.name == SPRING), None),
        "seconds": time.perf_counter() - began,
    }


def outcome(row: Mapping[Any, Any]) -> str:
    """Return what an answer was: of a group that holds the spring, or chance, nothing is wrong."""
    named = set(row["causes"]) - {PROCESS_NOISE, UNKNOWN}
    groups = {group[0]: set(group) for group in row["groups"]}
    right = {SPRING} if row["stiffness"] else set()
    if not named:
        return "chance" if PROCESS_NOISE in row["causes"] else row["verdict"]
    if named == right:
        return "in a group" if SPRING in groups else "named"
    others = [groups.get(name, {name}) for name in named - right]
    if len(others) == 1 and not right <= named and right & others[0]:
        return "in a group"
    return "a cause or chance" if all(PROCESS_NOISE in group for group in others) else "a false name"


def main() -> None:
    """Print a row for each kind of record, and what was wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=20, help="of each length, with a spring and without")
    parser.add_argument("--seed", type=int, default=0, help="of all trials")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    options = parser.parse_args()
    rows = rows_of(tried, trials_of(options.draws, options.seed), lambda t: t.samples, options.out / "shaken.json")
    table = pd.DataFrame(rows)
    table["outcome"] = [outcome(row) for row in table.to_dict("records")]
    seen = np.where(table["worth"] >= SEEN, "a spring that shows", "a spring that does not")
    table["hidden"] = np.where(table["stiffness"] == 0.0, "nothing", seen)
    print(pd.crosstab([table["samples"], table["hidden"]], table["outcome"]).to_string())
    ratio = (table["density found"] / table["density"]).dropna()
    print(f"density found over that which acted: median {ratio.median():.2f}, {ratio.min():.2f} to {ratio.max():.2f}")
    print(f"seconds: median {table['seconds'].median():.0f}, at most {table['seconds'].max():.0f}")
    off = table["outcome"].isin(["a false name", "a cause or chance"])
    print(table[off].drop(columns=["density found"]).to_string())


if __name__ == "__main__":
    main()
