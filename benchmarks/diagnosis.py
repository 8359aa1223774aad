"""Does a diagnosis find what was hidden? Many records of independent plants, each with effects drawn at random.

    python benchmarks/diagnosis.py [--draws 2] [--nulls 250] [--pairs 60] [--unknown 60] [--kind all] [--seed 0]

The plants are those of tests/hidden_plants.py, which share nothing with the package. Hidden are: one effect of each
kind at three noise levels; two effects together; nothing, under white, correlated, quantised noise and outliers; and an
effect that the bank does not have. For one effect the plant also says what could be known: the noise variances by which
the best rival would fit worse, to first order, the nominal parameters refitted. Draws are shared out to processes, one
on each core; each trial can be repeated from its seed.
"""

import argparse
import functools
import json
import multiprocessing
import os
import sys
import time
import traceback
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))

import jax
import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.signal import lfilter
from tqdm import tqdm

import ehsvjax
from ehsvjax.diagnose import diagnose
from tests.hidden_plants import effect_sizes, held_levels, servovalve_with, van_der_pol_with

matplotlib.use("Agg")

SEPARABLE = 5.0**2
VARIANCES = {"servovalve": (1e-8, 1e-7, 1e-5), "van_der_pol": (0.001, 0.01, 0.05)}
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


class Trial(NamedTuple):
    """One record to be made and diagnosed."""

    kind: str
    model: str
    noise: str
    variance: float
    names: tuple[str, ...]
    seed: int


def trials_of(options) -> list[Trial]:
    """Return every trial that was asked for."""
    rng = np.random.default_rng(options.seed)
    found = []

    def seed():
        return int(rng.integers(2**31))

    for model, variances in VARIANCES.items():
        every = [name for name in effect_sizes(model)]
        known = [name for name in every if not name.startswith("unknown")]
        unknown = [name for name in every if name.startswith("unknown")]
        for _ in range(options.draws):
            found += [Trial("one", model, "white", v, (name,), seed()) for name in known for v in variances]
        for i in range(options.nulls):
            kind = ("white", "AR", "quantised", "outliers")[i % 4]
            found.append(Trial("none", model, kind, variances[i % 3], (), seed()))
        for i in range(options.pairs // 2):
            pair = tuple(rng.choice(known, 2, replace=False).tolist())
            found.append(Trial("two", model, "white", variances[i % 2], pair, seed()))
        for i in range(options.unknown // 2):
            found.append(Trial("unknown", model, "white", variances[0], (unknown[i % len(unknown)],), seed()))
    return [t for t in found if options.kind in ("all", t.kind)]


def sizes_of(trial: Trial, rng) -> dict[str, dict[str, float]]:
    """Draw the sizes of a trial's effects, logarithmic between the plausible ones."""
    ranges, drawn = effect_sizes(trial.model), {}
    for name in trial.names:
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


def noise_of(trial: Trial, rng, count: int) -> np.ndarray:
    """Draw the noise of a trial, of its variance but for outliers."""
    deviation = trial.variance**0.5
    white = rng.standard_normal(count + 500)
    if trial.noise == "AR":
        pole = float(rng.uniform(0.3, 0.95))
        return deviation * (1.0 - pole**2) ** 0.5 * lfilter([1.0], [1.0, -pole], white)[500:]
    noise = deviation * white[500:]
    if trial.noise == "outliers":
        where = rng.random(count) < 0.005
        noise[where] += rng.choice([-1.0, 1.0], where.sum()) * rng.uniform(10.0, 50.0, where.sum()) * deviation
    return noise


def plant(model: str, effects, commands, period, noise=None) -> np.ndarray:
    """Return positions [record, time] of a plant."""
    if model == "servovalve":
        return servovalve_with(effects, commands, period, noise=noise)["position"]
    position = van_der_pol_with(effects, commands, period)["position"]
    return position if noise is None else position + noise


@functools.cache
def library(model: str, seed: int) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Return a plant's nominal position under an excitation, its directions by parameters, and by each effect."""
    command, period = excitation(model, seed)
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


def expected(trial: Trial, seed: int, clean: np.ndarray) -> tuple[float, float, str]:
    """Return the noise variances that the effect is worth, by which its best rival is worse, and that rival."""
    nominal, basis, directions = library(trial.model, seed)
    g = clean - nominal
    g = g - basis @ (basis.T @ g)
    worth = float(g @ g) / trial.variance
    unit = g / max(np.linalg.norm(g), 1e-300)
    alike = {name: float((unit @ d) ** 2) for name, d in directions.items() if name not in trial.names}
    rival = max(alike, key=lambda name: alike[name])
    return worth, worth * (1.0 - alike[rival]), rival


def tried(trials: list[Trial]) -> list[dict[str, Any]]:
    """Make and diagnose the records of some trials of one model, in whatever process this is."""
    rows = []
    rngs = [np.random.default_rng(t.seed) for t in trials]
    seeds = [int(rng.integers(EXCITATIONS)) for rng in rngs]
    effects = [sizes_of(t, rng) for t, rng in zip(trials, rngs, strict=True)]
    model = trials[0].model
    commands, period = [excitation(model, s)[0] for s in seeds], excitation(model, 0)[1]
    noises = np.stack([noise_of(t, rng, len(commands[0])) for t, rng in zip(trials, rngs, strict=True)])
    quantised = [
        effect | ({"sensor_quantisation": {"step": float(rng.uniform(0.2, 2.0)) * t.variance**0.5}}
                  if t.noise == "quantised" and model == "servovalve" else {})
        for t, effect, rng in zip(trials, effects, rngs, strict=True)
    ]  # fmt: skip
    positions = plant(model, quantised, np.stack(commands), period, noises)
    clean = plant(model, effects, np.stack(commands), period) if trials[0].kind == "one" else positions
    nominal = ehsvjax.servovalve() if model == "servovalve" else ehsvjax.van_der_pol()
    population, generations = (50, 20) if model == "servovalve" else (100, 50)
    for i, trial in enumerate(trials):
        y = positions[i]
        if trial.noise == "quantised" and model != "servovalve":
            step = float(rngs[i].uniform(0.2, 2.0)) * trial.variance**0.5
            y = step * np.round(y / step)
        record = ehsvjax.Record(np.arange(len(y)) * period, {"command": commands[i]}, {"position": y})
        row: dict[str, Any] = {**trial._asdict(), "sizes": effects[i], "excitation": seeds[i]}
        if trial.kind == "one" and trial.names != ("process_noise",):
            row["worth"], row["rival_deficit"], row["rival"] = expected(trial, seeds[i], clean[i])
        began = time.perf_counter()
        try:
            fit = ehsvjax.identify(
                nominal, record, key=jax.random.key(trial.seed), population=population, generations=generations
            )
            identified = time.perf_counter()
            d = diagnose(fit, record, key=jax.random.key(trial.seed))
        except Exception:  # a failure is a result, and the others go on
            rows.append(row | {"verdict": "failed", "error": traceback.format_exc(limit=-4)})
            continue
        gain = d.gain.outputs["position"]
        rows.append(
            row
            | {
                "verdict": d.verdict,
                "causes": d.causes,
                "groups": [a.causes for a in d.alternatives],
                "innocent": d.innocent,
                "seconds": time.perf_counter() - identified,
                "seconds_to_fit": identified - began,
                "rmse_after_over_noise": gain.rmse_after / gain.noise_floor,
                "noise_over_true": gain.noise_floor / trial.variance**0.5,
                "missing": None if d.missing is None else (d.missing.place, d.missing.quantity),
            }
        )
    return rows


def base(cause: str) -> str:
    """Name of an effect without its signal."""
    return cause.partition("@")[0]


def outcome(row) -> str:
    """Judge one trial of one or two effects, or of none."""
    truth = set(row["names"])
    if row["verdict"] in ("failed", "unexplained"):
        return row["verdict"]
    if row["kind"] == "none":
        return "right" if row["verdict"] == "adequate" else "false alarm"
    if row["verdict"] == "adequate":
        return "not seen"
    causes = [base(c) for c in row["causes"]]
    groups = [{base(c) for c in group} for group in row["groups"]]
    held = {t for t in truth if t in causes or any(t in g for g in groups)}
    if row["verdict"] == "named" and set(causes) == truth:
        return "named"
    if held == truth:
        return "ambiguous, truth within" if len(causes) == len(truth) else "truth and more"
    return "part of the truth" if held else "wrong"


def summary(table: pd.DataFrame) -> list[str]:
    """Return what was found, a line for each question."""
    lines = []
    one = table[table["kind"] == "one"]
    if len(one):
        clear = one[one["rival_deficit"] > SEPARABLE]
        close = one[(one["rival_deficit"] <= SEPARABLE)]
        lines.append(f"one effect, best rival worse by more than {SEPARABLE:g}: {counts(clear)}")
        lines.append(f"one effect, rivals closer: {counts(close)}")
        lines.append(f"process noise: {counts(one[one['rival_deficit'].isna()])}")
    for kind in ("none", "two", "unknown"):
        some = table[table["kind"] == kind]
        if len(some):
            lines.append(f"{kind}: {counts(some)}")
            for noise in some["noise"].unique() if kind == "none" else ():
                lines.append(f"    {noise}: {counts(some[some['noise'] == noise])}")
    right = table[table["outcome"].isin(["named", "ambiguous, truth within"])]
    if len(right):
        ratio = right["rmse_after_over_noise"]
        lines.append(
            f"held-out rmse over the noise after extension: median {ratio.median():.3f}, 95% below "
            f"{ratio.quantile(0.95):.3f}; within 3% in {100 * (ratio < 1.03).mean():.0f}%"
        )
    lines.append(
        f"seconds a diagnosis: median {table['seconds'].median():.1f}, 90% below {table['seconds'].quantile(0.9):.1f}"
    )
    return lines


def counts(some: pd.DataFrame) -> str:
    """Return how often each outcome was."""
    found = some["outcome"].value_counts()
    return f"{len(some)} trials: " + ", ".join(f"{n} {what}" for what, n in found.items())


def confusion(table: pd.DataFrame) -> pd.DataFrame:
    """Return how often each hidden effect was named what, first cause only."""
    one = table[(table["kind"] == "one") & (table["verdict"] != "failed")]
    named = [
        base(r["causes"][0]) if r["verdict"] in ("named", "ambiguous") and len(r["causes"]) else r["verdict"]
        for _, r in one.iterrows()
    ]
    return pd.crosstab(one["names"].map(lambda n: n[0]), pd.Series(named, index=one.index, name="found"))


def picture(matrix: pd.DataFrame) -> Figure:
    """Draw the confusion matrix."""
    order = [n for n in matrix.index if n in matrix.columns] + [n for n in matrix.columns if n not in matrix.index]
    values = matrix.reindex(columns=order)
    figure = Figure(figsize=(13, 11), layout="constrained")
    axes = figure.subplots()
    axes.imshow(values / values.sum(axis=1).to_numpy()[:, None], cmap="Blues", vmin=0, vmax=1)
    axes.set_xticks(range(len(order)), order, rotation=90, fontsize=8)
    axes.set_yticks(range(len(values)), values.index, fontsize=8)
    for (i, j), count in np.ndenumerate(values.to_numpy()):
        if count:
            axes.text(j, i, int(count), ha="center", va="center", fontsize=7)
    axes.set(xlabel="first cause found", ylabel="hidden")
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=2, help="of every effect at every noise level")
    parser.add_argument("--nulls", type=int, default=250, help="records of each model without any effect")
    parser.add_argument("--pairs", type=int, default=60, help="records with two effects")
    parser.add_argument("--unknown", type=int, default=60, help="records with an effect that the bank lacks")
    parser.add_argument("--kind", choices=["all", "one", "none", "two", "unknown"], default="all")
    parser.add_argument("--seed", type=int, default=0, help="of all trials")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    trials = trials_of(options)
    chunks = []
    for key in dict.fromkeys((t.kind, t.model) for t in trials):
        same = [t for t in trials if (t.kind, t.model) == key]
        chunks += [same[k : k + 8] for k in range(0, len(same), 8)]
    rows: list[dict[str, Any]] = []
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(os.cpu_count(), mp_context=context) as pool:
        # In the order in which they end: what has been measured is kept, even if the rest is interrupted.
        for found in tqdm(pool.map(tried, chunks), total=len(chunks), mininterval=10.0):
            rows += found
            (options.out / "diagnosis.json").write_text(json.dumps(rows, indent=1, default=float))
    table = pd.DataFrame(rows)
    table["outcome"] = [outcome(row) for _, row in table.iterrows()]
    for line in summary(table):
        print(line)
    off = table[table["outcome"].isin(["wrong", "failed", "false alarm", "part of the truth", "unexplained"])]
    off = off[off["kind"] != "unknown"]
    print(off[[c for c in ("kind", "model", "noise", "variance", "names", "sizes", "seed", "worth", "rival_deficit",
                           "verdict", "causes") if c in off]].to_string())  # fmt: skip
    if (table["kind"] == "one").any():
        matrix = confusion(table)
        print(matrix.to_string())
        matrix.to_csv(options.out / "diagnosis_confusion.csv")
        picture(matrix).savefig(options.out / "diagnosis_confusion.png", dpi=120)


if __name__ == "__main__":
    main()
