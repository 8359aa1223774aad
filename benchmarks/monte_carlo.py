"""How close to the Cramer-Rao bound? Many noise draws of the paper's two experiments.

    python benchmarks/monte_carlo.py [--draws 200] [--model van_der_pol] [--out out/benchmarks]

The plant is the independent simulator of tests/plants.py. For every noise variance and parameter the table shows the
bound in per cent of the true value, the error's root mean square over the bound for the genetic algorithm alone and
with refinement, and the paper's one draw in standard deviations of what it could have been. A draw counts as lost where
the fit's sum of squares exceeds, by more than 0.1 noise variances, that of a refinement started at the truth.
"""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parents[1]))

import ehsvjax
from ehsvjax import excitation
from ehsvjax.population import cast, to_unit
from ehsvjax.refine import refine
from ehsvjax.unknowns import problem_of
from tests import plants

matplotlib.use("Agg")


class Experiment(NamedTuple):
    """One of the paper's two tables."""

    model: ehsvjax.Model
    record: ehsvjax.Record  # without noise
    truth: dict[str, float]
    population: int
    generations: int
    paper: dict[float, dict[str, float]]  # noise variance -> printed row


def van_der_pol() -> Experiment:
    period = 0.02
    command = excitation.pseudo_random_signal(
        jax.random.key(1), amplitude=2.0, hold_time=1.0, duration=40.0, sample_period=period
    )
    plant = plants.van_der_pol_plant(command, period, alpha=0.96, gamma=1.23, initial=(0.0, 0.0))
    return Experiment(
        model=ehsvjax.van_der_pol(),
        record=_record(command, period, plant[:, 0]),
        truth={"alpha": 0.96, "gamma": 1.23},
        population=100,
        generations=50,
        paper={0.05: {"alpha": 0.9606, "gamma": 1.2345}, 0.1: {"alpha": 0.9307, "gamma": 1.1337}},
    )


def servovalve() -> Experiment:
    period = 1e-3
    command = excitation.pseudo_random_signal(
        jax.random.key(1), amplitude=6e-3, hold_time=0.2, duration=4.0, sample_period=period
    )
    names = ("dead_zone", "saturation", "flow_gain", "feedback_gain", "damping_ratio", "natural_frequency")
    rows = {
        1e-8: (9.92e-5, 3.0e-3, 1.41e-4, 0.0919, 0.6647, 296.35),
        1e-7: (9.21e-5, 2.0e-3, 1.40e-4, 0.0872, 0.7418, 327.6),
        1e-5: (1.2e-4, 3.8e-3, 1.58e-4, 0.0909, 0.7145, 265.93),
    }
    return Experiment(
        model=ehsvjax.servovalve(),
        record=_record(command, period, plants.servovalve_plant(command, period).position),
        truth=dict(zip(names, (1e-4, 3e-3, 1.45e-4, 0.09, 0.72, 300.0), strict=True)),
        population=50,
        generations=20,
        paper={variance: dict(zip(names, row, strict=True)) for variance, row in rows.items()},
    )


def _record(command, period, position):
    return ehsvjax.Record(np.arange(len(command)) * period, {"command": command}, {"position": np.array(position)})


def measure(experiment: Experiment, variance: float, draws: int, seed: int) -> tuple[pd.DataFrame, dict]:
    """Return the table of one noise variance, and the estimates themselves."""
    model, record, truth = experiment.model, experiment.record, experiment.truth
    names = list(truth)
    rng = np.random.default_rng([seed, round(-1e3 * np.log10(variance))])
    alone, refined, lost, unconverged, seconds = [], [], 0, 0, []
    for draw in tqdm(range(draws), desc=f"{model.name}, variance {variance:g}", mininterval=5.0):
        noise = rng.normal(0.0, variance**0.5, len(record))
        noisy = ehsvjax.Record(record.time, record.inputs, {"position": record.outputs["position"] + noise})
        began = time.perf_counter()
        fit = ehsvjax.identify(
            model,
            noisy,
            key=jax.random.fold_in(jax.random.key(seed), draw),
            population=experiment.population,
            generations=experiment.generations,
        )
        seconds.append(time.perf_counter() - began)
        alone.append([fit.history.best[name][-1] for name in names])
        refined.append([fit.parameters[name] for name in names])
        lost += cost_of(fit) > cost_from_truth(model, noisy, truth) + 0.1 * variance
        unconverged += not fit.effort.converged
    bound = ehsvjax.cramer_rao_bound(model, record, noise_variance={"position": variance})
    true, limit = np.array(list(truth.values())), np.array([bound[name] for name in names])
    errors = {"alone": np.array(alone) - true, "refined": np.array(refined) - true}
    paper = np.array([experiment.paper[variance][name] for name in names]) - true
    table = pd.DataFrame(
        {
            "variance": variance,
            "parameter": names,
            "bound %": 100 * limit / true,
            "GA: RMSE/bound": _ratio(errors["alone"], limit),
            "GA+refinement: RMSE/bound": _ratio(errors["refined"], limit),
            "bias/bound": errors["refined"].mean(0) / limit,
            "paper error %": 100 * paper / true,
            "paper error/bound": paper / limit,
            "GA draws with larger error %": 100 * np.mean(np.abs(errors["alone"]) >= np.abs(paper), axis=0),
        }
    )
    facts = {
        "variance": variance,
        "draws": draws,
        "lost": int(lost),
        "unconverged": int(unconverged),
        "median seconds per identification": float(np.median(seconds)),
        "alone": np.array(alone).tolist(),
        "refined": np.array(refined).tolist(),
        "bound": limit.tolist(),
    }
    return table, facts


def _ratio(errors, limit):
    return np.sqrt(np.mean(errors**2, axis=0)) / limit


def cost_of(fit) -> float:
    """Sum of squared residuals, unit squared."""
    return float(np.sum(fit.residuals()["position"] ** 2))


def cost_from_truth(model, record, truth) -> float:
    """Sum of squared residuals of a refinement from the true values, unit squared."""
    problem = problem_of(model, [record])
    values = [truth[name] for name in problem.free] + [0.0] * len(problem.free_initial)
    with jax.enable_x64(True):
        start = jnp.clip(to_unit(problem.coordinates, jnp.array(values)), 0.0, 1.0)
        cost = refine(cast(problem, jnp.float64), start[None]).cost[0]
    return float(cost) * float(problem.noise_variance[0])


def picture(experiment: Experiment, facts: list[dict]) -> Figure:
    """Draw every estimate, as error over bound, beside the normal density that an efficient estimate has."""
    names = list(experiment.truth)
    figure = Figure(figsize=(2.2 * len(names) + 1, 2.2 * len(facts)), layout="constrained")
    axes = np.atleast_2d(figure.subplots(len(facts), len(names), sharex=True, sharey=True))
    grid = np.linspace(-5, 5, 200)
    for row, result in zip(axes, facts, strict=True):
        for i, (axis, name) in enumerate(zip(row, names, strict=True)):
            for label, colour in (("alone", "C1"), ("refined", "C0")):
                errors = (np.array(result[label])[:, i] - experiment.truth[name]) / result["bound"][i]
                legend = "GA alone" if label == "alone" else "GA and refinement"
                axis.hist(np.clip(errors, -5, 5), bins=41, range=(-5, 5), density=True, color=colour, alpha=0.5,
                          label=legend)  # fmt: skip
            axis.plot(grid, np.exp(-0.5 * grid**2) / np.sqrt(2 * np.pi), "k", lw=1, label="efficient")
            paper = (experiment.paper[result["variance"]][name] - experiment.truth[name]) / result["bound"][i]
            if abs(paper) <= 5:
                axis.axvline(paper, color="C3", lw=1.5, label="the paper's draw")
            else:
                axis.text(0.97 if paper > 0 else 0.03, 0.9, f"paper: {paper:+.0f}", transform=axis.transAxes,
                          color="C3", ha="right" if paper > 0 else "left", fontsize=8)  # fmt: skip
            axis.set_title(f"{name}, {result['variance']:g}", fontsize=9)
    axes[0, 0].legend(fontsize=7)
    figure.supxlabel("error over the Cramér-Rao bound (beyond 5 drawn at 5)", fontsize=9)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--model", choices=["van_der_pol", "servovalve", "both"], default="both")
    parser.add_argument("--variances", type=float, nargs="*", help="some of the paper's only")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for make in (van_der_pol, servovalve):
        if options.model not in (make.__name__, "both"):
            continue
        experiment = make()
        stem = options.out / f"monte_carlo_{make.__name__}"
        tables, facts = [], []
        for variance in options.variances or experiment.paper:
            rows, fact = measure(experiment, variance, options.draws, options.seed)
            tables.append(rows)
            facts.append(fact)
            # What has been measured is kept, even if the rest is interrupted.
            stem.with_suffix(".json").write_text(json.dumps(facts))
        table = pd.concat(tables, ignore_index=True)
        print(f"\n{experiment.model.name}: {options.draws} draws, seed {options.seed}, population "
              f"{experiment.population}, {experiment.generations} generations")  # fmt: skip
        print(table.to_string(index=False, float_format=lambda v: f"{v:.3g}"))
        for fact in facts:
            print(f"variance {fact['variance']:g}: {fact['lost']} of {fact['draws']} draws lost, {fact['unconverged']} "
                  f"not converged, {fact['median seconds per identification']:.2f} s each (median)")  # fmt: skip
        print(f"Sampling error of each ratio: {100 / np.sqrt(2 * options.draws):.1f}% (one standard deviation).")
        table.to_csv(stem.with_suffix(".csv"), index=False)
        picture(experiment, facts).savefig(stem.with_suffix(".png"), dpi=120)


if __name__ == "__main__":
    main()
