"""The paper's open problem: a search space that is wide. How often is the minimum still found, at what price?

    python benchmarks/wide_bounds.py [--draws 50] [--width 10] [--population 200] [--generations 40]

Every parameter of the servovalve gets bounds whose ratio is `--width`, with the true value at a random place between
them on a logarithmic scale. A draw succeeds where the fit's sum of squares is within 0.1 noise variances of that of a
refinement started at the truth. The plant is the independent simulator of tests/plants.py.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pandas as pd
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parents[1]))

import ehsvjax
from benchmarks.monte_carlo import cost_from_truth, cost_of, servovalve


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=50)
    parser.add_argument("--width", type=float, default=10.0)
    parser.add_argument("--variance", type=float, default=1e-7)
    parser.add_argument("--population", type=int, default=200)
    parser.add_argument("--generations", type=int, default=40)
    parser.add_argument("--starts", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)

    experiment = servovalve()
    model, record, truth = experiment.model, experiment.record, experiment.truth
    bound = ehsvjax.cramer_rao_bound(model, record, noise_variance={"position": options.variance})
    rng = np.random.default_rng(options.seed)
    rows = []
    for draw in tqdm(range(options.draws), desc=f"bounds with a ratio of {options.width:g}", mininterval=5.0):
        noise = rng.normal(0.0, options.variance**0.5, len(record))
        noisy = ehsvjax.Record(record.time, record.inputs, {"position": record.outputs["position"] + noise})
        place = rng.uniform(0.0, 1.0, len(truth))
        bounds = {
            name: (value * options.width**-p, value * options.width ** (1.0 - p))
            for (name, value), p in zip(truth.items(), place, strict=True)
        }
        began = time.perf_counter()
        fit = ehsvjax.identify(
            model,
            noisy,
            key=jax.random.fold_in(jax.random.key(options.seed), draw),
            population=options.population,
            generations=options.generations,
            starts=options.starts,
            bounds=bounds,
        )
        seconds = time.perf_counter() - began
        excess = (cost_of(fit) - cost_from_truth(model, noisy, truth)) / options.variance
        rows.append(
            {
                "draw": draw,
                "excess": excess,
                "simulations": fit.effort.simulations,
                "agreeing": fit.effort.starts_agreeing,
                "converged": fit.effort.converged,
                "seconds": seconds,
                "worst error/bound": max(abs(fit.parameters[n] - truth[n]) / bound[n] for n in truth),
            }
        )
    table = pd.DataFrame(rows)
    found = int((table["excess"] < 0.1).sum())
    print(f"\nservovalve, variance {options.variance:g}, every parameter's bounds with a ratio of {options.width:g}")
    print(table.to_string(index=False, float_format=lambda v: f"{v:.3g}"))
    print(
        f"{found} of {options.draws} draws reached the minimum, with {int(table['simulations'].max())} simulations "
        f"each and {table['seconds'].median():.1f} s (median)"
    )
    stem = options.out / f"wide_bounds_{options.width:g}"
    stem.with_suffix(".json").write_text(
        json.dumps({"options": {k: str(v) for k, v in vars(options).items()}, "found": found, "draws": rows})
    )


if __name__ == "__main__":
    main()
