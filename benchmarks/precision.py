"""Are the errors as small as they can be, and the intervals as wide as they should be? Many draws of noise.

    python benchmarks/precision.py [--draws 1000] [--coloured 400] [--profiles 400] [--model both] [--variance V ...]

The plant is the independent simulator of tests/plants.py. Under white noise of each of the paper's variances: the root
mean squared error over the Cramer-Rao bound, for the genetic algorithm alone, with refinement, and for the paper's own
draw; and how often the 95% intervals of `fit.precision()` hold the truth. Under noise of the same variance that
remembers 0.9 of itself from sample to sample (at 1 kHz for the servovalve) least squares is not efficient: the
intervals are to hold the truth all the same. At each model's largest variance, where linear theory is at its limit,
profile likelihood is asked as well, of the first draws. Draws are shared out to processes, one on each core.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))

import jax
import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.signal import lfilter
from tqdm import tqdm

import ehsvjax
from benchmarks import monte_carlo
from benchmarks.processes import workers

matplotlib.use("Agg")

POLE = 0.9
CHUNK = 10
EXPERIMENTS = {"van_der_pol": monte_carlo.van_der_pol, "servovalve": monte_carlo.servovalve}


class Draws(NamedTuple):
    """Of many identifications, `[draw, parameter, ...]`: estimates, their errors, and what noise was seen.

    `profiles` are intervals by profile likelihood, NaN for a draw of which they were not asked.
    """

    alone: np.ndarray
    refined: np.ndarray
    errors: np.ndarray
    intervals: np.ndarray
    profiles: np.ndarray
    coloured: np.ndarray
    converged: np.ndarray


def identified(name: str, variance: float, pole: float, seeds: range, profiled: int) -> Draws:
    """Identify one record for each seed, in whatever process this is; ask the first `profiled` seeds for profiles."""
    experiment = EXPERIMENTS[name]()
    record, names = experiment.record, list(experiment.truth)
    rows = []
    for seed in seeds:
        position = record.outputs["position"] + noise(seed, variance, pole, len(record))
        fit = ehsvjax.identify(
            experiment.model,
            ehsvjax.Record(record.time, record.inputs, {"position": position}),
            key=jax.random.key(seed),
            population=experiment.population,
            generations=experiment.generations,
        )
        precision = fit.precision()
        profile = fit.profile_likelihood().intervals if seed < profiled else dict.fromkeys(names, (np.nan, np.nan))
        rows.append(
            (
                [fit.history.best[n][-1] for n in names],
                [fit.parameters[n] for n in names],
                [precision.standard_errors[n] for n in names],
                [precision.intervals()[n] for n in names],
                [profile[n] for n in names],
                precision.coloured,
                fit.effort.converged,
            )
        )
    return Draws(*(np.array(column) for column in zip(*rows, strict=True)))


def noise(seed: int, variance: float, pole: float, count: int) -> np.ndarray:
    """Return stationary noise of this variance, white or with a memory."""
    settling = 200 if pole else 0
    white = np.random.default_rng([seed, round(-1e3 * np.log10(variance))]).standard_normal(count + settling)
    return (variance * (1.0 - pole**2)) ** 0.5 * lfilter([1.0], [1.0, -pole], white)[settling:]


def gather(pool, name: str, variance: float, pole: float, draws: int, profiled: int) -> Draws:
    """Return all draws, of every process."""
    chunks = [range(start, min(start + CHUNK, draws)) for start in range(0, draws, CHUNK)]
    waiting = [pool.submit(identified, name, variance, pole, chunk, profiled) for chunk in chunks]
    label = f"{name}, variance {variance:g}, {'coloured' if pole else 'white'}"
    done = [future.result() for future in tqdm(waiting, desc=label, mininterval=10.0)]
    return Draws(*(np.concatenate(column) for column in zip(*done, strict=True)))


def judged(name: str, variance: float, pole: float, found: Draws) -> pd.DataFrame:
    """Return the table of one noise."""
    experiment = EXPERIMENTS[name]()
    names, truth = list(experiment.truth), np.array(list(experiment.truth.values()))
    bound = ehsvjax.cramer_rao_bound(experiment.model, experiment.record, noise_variance={"position": variance})
    limit = np.array([bound[n] for n in names])
    inside, profiled = (
        (interval[..., 0] <= truth) & (truth <= interval[..., 1]) for interval in (found.intervals, found.profiles)
    )
    asked = np.isfinite(found.profiles).all(axis=(1, 2))
    table = pd.DataFrame({"model": name, "variance": variance, "noise": "AR(1) 0.9" if pole else "white",
                          "parameter": names})  # fmt: skip
    if not pole:
        table["bound %"] = 100 * limit / truth
        table["GA: RMSE/bound"] = np.sqrt(np.mean((found.alone - truth) ** 2, axis=0)) / limit
        table["GA+refinement: RMSE/bound"] = np.sqrt(np.mean((found.refined - truth) ** 2, axis=0)) / limit
        table["paper's error/bound"] = ([experiment.paper[variance][n] for n in names] - truth) / limit
    table["coverage of 95% intervals, %"] = 100 * np.mean(inside, axis=0)
    if asked.any():
        table["coverage of profiles, %"] = 100 * np.mean(profiled[asked], axis=0)
    table["mean standard error/RMSE"] = np.mean(np.where(np.isfinite(found.errors), found.errors, np.nan), axis=0) \
        / np.std(found.refined, axis=0)  # fmt: skip
    table["not fixed, %"] = 100 * np.mean(np.isinf(found.errors), axis=0)
    table["seen as coloured, %"] = 100 * np.mean(found.coloured)
    table["not converged"] = int(np.sum(~found.converged))
    return table


COST = """
import json, sys, time
sys.path[:0] = [sys.argv[1]]
import jax
import ehsvjax
from benchmarks import monte_carlo, precision

experiment, record = monte_carlo.servovalve(), monte_carlo.servovalve().record
position = record.outputs["position"] + precision.noise(0, 1e-8, 0.0, len(record))
measured = ehsvjax.Record(record.time, record.inputs, {"position": position})
fit = ehsvjax.identify(experiment.model, measured, key=jax.random.key(0), population=50, generations=20)
calls = {
    "precision": fit.precision,
    "profile_likelihood": fit.profile_likelihood,
    "bands": fit.bands,
    "design": lambda: ehsvjax.design(experiment.model, measured, noise_variance={"position": 1e-8}),
    "bootstrap, 200 draws": lambda: fit.bootstrap(jax.random.key(1)),
}
for name, call in calls.items():
    began = time.perf_counter()
    call()
    calls[name] = time.perf_counter() - began
print(json.dumps(calls))
"""


def cost() -> dict[str, float]:
    """Return the seconds of each question to a fit of 4,000 samples and six parameters, compiling included."""
    root = str(Path(__file__).parents[1])
    printed = subprocess.run([sys.executable, "-c", COST, root], capture_output=True, text=True, check=True).stdout
    return json.loads(printed.splitlines()[-1])


def picture(table: pd.DataFrame) -> Figure:
    """Draw the coverage of every parameter and noise."""
    figure = Figure(figsize=(8, 3.6), layout="constrained")
    axes = figure.subplots()
    labels = []
    for i, ((model, variance, kind), rows) in enumerate(table.groupby(["model", "variance", "noise"], sort=False)):
        colour = "C0" if kind == "white" else "C1"
        axes.plot(np.full(len(rows), i), rows["coverage of 95% intervals, %"], "o", color=colour)
        labels.append(f"{model}\n{variance:g}\n{kind}")
    axes.axhspan(93.0, 97.0, color="0.85", zorder=0)
    axes.set_xticks(range(len(labels)), labels, fontsize=8)
    axes.set(ylabel="coverage of 95% intervals (%)", ylim=(88, 100))
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=1000, help="under white noise")
    parser.add_argument("--coloured", type=int, default=400, help="under coloured noise")
    parser.add_argument("--profiles", type=int, default=400, help="of each noise at a model's largest variance")
    parser.add_argument("--model", choices=[*EXPERIMENTS, "both"], default="both")
    parser.add_argument("--variance", type=float, nargs="+", help="only these of the paper's noise variances")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    tables = []
    with workers() as pool:
        for name, make in EXPERIMENTS.items():
            if options.model not in (name, "both"):
                continue
            for variance in make().paper:
                if options.variance and variance not in options.variance:
                    continue
                for pole, draws in ((0.0, options.draws), (POLE, options.coloured)):
                    profiled = min(options.profiles, draws) if variance == max(make().paper) else 0
                    found = gather(pool, name, variance, pole, draws, profiled)
                    tables.append(judged(name, variance, pole, found))
                    # What has been measured is kept, even if the rest is interrupted.
                    table = pd.concat(tables, ignore_index=True)
                    rows = json.loads(table.to_json(orient="records"))
                    (options.out / "precision.json").write_text(json.dumps(rows, indent=1))
    print(table.to_string(index=False, float_format=lambda v: f"{v:.3g}", na_rep="-"))
    ratio = 100 / np.sqrt(2 * options.draws)
    white, coloured = (100 * np.sqrt(0.95 * 0.05 / draws) for draws in (options.draws, options.coloured))
    print(
        f"{options.draws} draws of white, {options.coloured} of coloured noise. Sampling error (one deviation) "
        f"of a ratio {ratio:.1f}%, of a coverage {white:.1f} and {coloured:.1f} points."
    )
    picture(table).savefig(options.out / "precision.png", dpi=120)
    seconds = cost()
    (options.out / "precision_cost.json").write_text(json.dumps(seconds))
    print("Seconds after an identification in the same process, compiling included: "
          + ", ".join(f"{name} {taken:.2f}" for name, taken in seconds.items()))  # fmt: skip


if __name__ == "__main__":
    main()
