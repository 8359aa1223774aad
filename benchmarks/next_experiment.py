"""Does the experiment that is planned settle what a record left open? The loop, closed by independent plants.

    python benchmarks/next_experiment.py [--draws 1] [--add-pressure] [--seed 0]

A servovalve of tests/hidden_plants.py hides one effect of random size; its record is diagnosed. Where the diagnosis
cannot tell what it is, the next experiment is planned from the diagnosis alone, the plant runs it, and both records are
diagnosed together. Whether any experiment can tell says an exhaustive search in the plant (benchmarks/exhaustive.py).
The table says how often the effect was then named, how far the two explanations really came apart against what the plan
said, how often they were told apart against its probability, how much further than by simple choices, how the errors of
the parameters came out, and whether the plant kept the limits.
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

import ehsvjax
from benchmarks.exhaustive import PRESSURE_STEP, Question, Rig, best
from benchmarks.processes import rows_of, said
from ehsvjax import excitation as excitation_of
from ehsvjax.diagnosis import Diagnosis
from ehsvjax.diagnosis.bench.evidence import INSEPARABLE
from ehsvjax.experiment import Plan
from ehsvjax.experiment.plan import told_apart
from ehsvjax.experiment.separation import as_said, as_said_so_far, refitted_cost
from tests.hidden_oracle import SEPARABLE
from tests.hidden_plants import SERVOVALVE_EFFECTS, SERVOVALVE_STEP, Valve, servovalve_with
from tests.hidden_records import EXCITATIONS, Hidden, excitation, noise_of, sizes_of

LIMITS = ehsvjax.Limits(command=(-8e-3, 8e-3), position=(-0.2, 0.2))
SUPPLY = (70e5, 210e5)
RIG = Rig(LIMITS.between["command"][1], (SUPPLY[0], Valve().supply_pressure, SUPPLY[1]), LIMITS.between["position"])
PRESSURE_NOISE = 2.5e9
VARIANCES = (1e-8, 1e-7, 1e-6)
# Steps of the plant in which a load pressure is known to a few readings; the position needs none so short.
FINE_STEP = {True: PRESSURE_STEP, False: SERVOVALVE_STEP}


class Trial(NamedTuple):
    """One loop: the effect, the variance of the position's noise, whether a pressure may be added, the seed."""

    name: str
    variance: float
    add_pressure: bool
    seed: int


def trials_of(options) -> list[Trial]:
    """Return the loops that were asked for: every effect, `draws` times."""
    rng = np.random.default_rng(options.seed)
    names = [n for n in SERVOVALVE_EFFECTS if not n.startswith("unknown") and n != "sensor_quantisation"]
    return [
        Trial(name, VARIANCES[int(rng.integers(len(VARIANCES)))], options.add_pressure, int(rng.integers(2**31)))
        for _ in range(options.draws)
        for name in names
    ]


def tried(trials: list[Trial]) -> list[dict[str, Any]]:
    """Close loops, one after the other."""
    return [_tried(trial) for trial in trials]


def _tried(trial: Trial) -> dict[str, Any]:
    row: dict[str, Any] = trial._asdict()
    try:
        return row | _loop(trial)
    except Exception:
        return row | {"answer": "crashed", "error": traceback.format_exc()}


def _loop(trial: Trial) -> dict[str, Any]:
    hidden = Hidden("servovalve", "white", trial.variance, (trial.name,), trial.seed)
    rng = np.random.default_rng(trial.seed)
    sizes = sizes_of(hidden, rng)
    seed = int(rng.integers(EXCITATIONS))
    command, period = excitation("servovalve", seed)
    first, _ = _run(hidden, sizes, ehsvjax.Record(period * np.arange(len(command)), {"command": command}), (), rng)
    key = jax.random.key(trial.seed)
    fit = ehsvjax.identify(ehsvjax.servovalve(), first, key=key, population=50, generations=20)
    found = ehsvjax.diagnose(fit, first, key=key, progress=False)
    row = {"first": _answer(found, trial.name), "groups": [a.causes for a in found.alternatives], "sizes": sizes}
    if row["first"] != "named" and trial.name != "process_noise":
        variances = {"position": trial.variance} | ({"load_pressure": PRESSURE_NOISE} if trial.add_pressure else {})
        can = best(Question(trial.name, sizes, seed, RIG, variances))
        row |= {"can": can.deficit, "rival": can.rival, "by": can.experiment}
    hidden_sizes = {f"{name}.{number}": size for name, own in sizes.items() for number, size in own.items()}
    # Who sees nothing asks what would show it.
    against = hidden_sizes if row["first"] == "not seen" and trial.name != "process_noise" else None
    if against is None and not found.explanations:
        return row | {"answer": row["first"]}
    began = time.perf_counter()
    adding = {"load_pressure": PRESSURE_NOISE} if trial.add_pressure else None
    plan = found.next_experiment(
        LIMITS, key=key, can_change={"supply_pressure": SUPPLY}, can_add=adding, against=against
    )  # fmt: skip
    row |= {"seconds": time.perf_counter() - began, "probability": plan.chosen.probability}
    second, clean = _run(hidden, sizes, plan.record, plan.chosen.outputs, rng)
    lower, upper = LIMITS.between["position"]
    row |= {"words": plan.chosen.words, "kept": bool(np.all((clean >= lower) & (clean <= upper)))}
    row |= _separations(plan, trial.name, first, second)
    # A pressure that was not measured before was not fitted: the nominal model is fitted to both.
    both = ehsvjax.identify(ehsvjax.servovalve(), [first, second], key=key, population=50, generations=20)
    joint = ehsvjax.diagnose(both, [first, second], key=key, progress=False)
    row |= {"errors": _errors(plan, trial.name, joint)}
    return row | said(joint) | {"answer": _answer(joint, trial.name)}


def _run(hidden: Hidden, sizes, planned: ehsvjax.Record, outputs, rng) -> tuple[ehsvjax.Record, np.ndarray]:
    """Return what the plant shows in an experiment, and its position without noise."""
    command = planned.inputs["command"]
    valve = {k: v for k, v in planned.constants.items() if k in Valve._fields}
    noise = noise_of(hidden, rng, len(command))
    seen = servovalve_with(
        [sizes] * 2, np.stack([command] * 2), planned.sample_period, noise=np.stack([noise, np.zeros_like(noise)]),
        fine_step=FINE_STEP["load_pressure" in outputs], **valve,
    )  # fmt: skip
    shown = {"position": seen["position"][0]}
    if "load_pressure" in outputs:
        shown["load_pressure"] = seen["load_pressure"][0] + PRESSURE_NOISE**0.5 * rng.standard_normal(len(command))
    record = ehsvjax.Record(planned.time, {"command": command}, shown, constants=planned.constants)
    return record, seen["position"][1]


def _answer(found: Diagnosis, name: str) -> str:
    """Return "named", "in group", "wrong", "unexplained" or "not seen"."""
    causes = {cause.split("@")[0] for cause in found.names}
    groups = {cause.split("@")[0] for group in found.alternatives for cause in group.causes}
    if causes == {name} and not groups:
        return "named"
    if name in causes | groups:
        return "in group"
    return {"adequate": "not seen", "unexplained": "unexplained"}.get(found.verdict, "wrong")


def _separations(plan: Plan, name: str, first, second) -> dict[str, float]:
    """Return what the plan said of the truth against what it is told from worst, and what came of it.

    What no experiment tells from it, such as an offset of the command from one of the spool, is left out.
    """
    true = next((n for n in plan.explanations if n.split("@")[0] == name), None)
    if true is None:
        return {}
    variances = dict(next(iter(plan.explanations.values())).noise_variance)
    variances |= {"load_pressure": PRESSURE_NOISE} if "load_pressure" in second.outputs else {}
    costs = {n: refitted_cost(fit, [first, second], variances) for n, fit in plan.explanations.items()}
    most = {pair: max(o.separations[pair] for o in plan.options) for pair in plan.chosen.separations}
    others = [other for (one, other), separation in most.items() if one == true and separation > 1.0]
    if not others:
        return {"equal": len(most)}
    hardest = min(others, key=lambda other: plan.chosen.separations[true, other])
    return {
        "said": plan.chosen.separations[true, hardest],
        "came": costs[hardest] - costs[true],
        "simple": {
            name: min(_separation(plan, true, other, record, variances) for other in others)
            for name, record in _simple_choices(first).items()
        },
        "today": min(plan.today[true, other] for other in others),
        "pairs": [(told_apart(plan.chosen.separations[true, o]), float(costs[o] - costs[true])) for o in others],
    }


def _simple_choices(first: ehsvjax.Record) -> dict[str, ehsvjax.Record]:
    """Return the records that one would try without a plan, within the limits of the command."""
    command, period = first.inputs["command"], first.sample_period
    most = LIMITS.between["command"][1]
    length, count = period * len(command), len(command)
    rich = excitation_of.multisine(
        None, amplitude=most, frequencies_hz=np.arange(1, 17) / length * 3.0, duration=length, sample_period=period,
        phases="schroeder",
    )  # fmt: skip
    stairs = excitation_of.staircase(amplitude=most, levels=9, hold_time=length / 17, sample_period=period)
    commands = {
        "same again": command,
        "twice the amplitude": np.clip(2.0 * command, -most, most),
        "a multisine": rich,
        "a staircase": np.resize(stairs, count),
    }
    found = {n: ehsvjax.Record(first.time, {"command": c}, constants=first.constants) for n, c in commands.items()}
    return found | {"half the supply pressure": found["same again"].at(supply_pressure=SUPPLY[0])}


def _separation(plan: Plan, true: str, other: str, new: ehsvjax.Record, variances) -> float:
    """Return by how much a new record would tell one explanation from another, the outputs of the plan measured."""
    fits, outputs = plan.explanations, plan.chosen.outputs
    records = [*as_said_so_far(fits[true]), *as_said(fits[true], [new], tuple(variances))]
    return refitted_cost(fits[other], records, variances, outputs)


def _errors(plan: Plan, name: str, joint: Diagnosis) -> list[float]:
    """Return the standard errors that were promised over those that came, where the truth is what was found."""
    true = next((n for n in plan.explanations if n.split("@")[0] == name), None)
    if true is None or joint.names != (true,):
        return []
    said, came = plan.precision(true).standard_errors, joint.extended.standard_errors
    return [said[n] / came[n] for n in said if n in came and np.isfinite(came[n]) and np.isfinite(said[n])]


def main() -> None:
    """Close the loops and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=1, help="of every effect")
    parser.add_argument("--add-pressure", action="store_true", help="the load pressure may be measured too")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/next_experiment"))
    options = parser.parse_args()
    rows = rows_of(tried, trials_of(options), lambda trial: trial.add_pressure, options.out / "rows.json")
    table = pd.DataFrame(rows)
    print(pd.crosstab(table["first"].fillna("crashed"), table["answer"]).to_string())
    can = table[table["can"] > SEPARABLE] if "can" in table else table[:0]
    named = int((can["answer"] == "named").sum())
    print(f"not named at first, and some experiment can tell: {len(can)}; named then: {named}")
    planned = table[table["said"].notna()] if "said" in table else table[:0]
    if len(planned):
        ratio = planned["came"] / planned["said"]
        print(f"{len(planned)} plans with the truth among their explanations: realised over predicted separation:")
        print(ratio.quantile([0.05, 0.25, 0.5, 0.75, 0.95]).round(2).to_string())
        print(f"within a factor of 1.6: {100 * ratio.between(1 / 1.6, 1.6).mean():.0f}%")
        pairs = np.array([pair for row in planned["pairs"] for pair in row])
        for low, high in ((0.0, 0.5), (0.5, 0.9), (0.9, 0.99), (0.99, 1.01)):
            inside = pairs[(pairs[:, 0] >= low) & (pairs[:, 0] < high)]
            if len(inside):
                told = np.mean(inside[:, 1] > INSEPARABLE)
                print(f"pairs told apart: said {inside[:, 0].mean():.2f}, came {told:.2f} of {len(inside)}")
        simple = pd.DataFrame(list(planned["simple"]), index=planned.index)
        further = planned["said"] / simple.max(axis=1).clip(lower=1e-3)
        print(f"over the best of {', '.join(simple)}: median {further.median():.3g}")
        print((planned["said"].to_numpy()[:, None] / simple.clip(lower=1e-3)).median().round(2).to_string())
        errors = np.concatenate([np.asarray(row, float) for row in planned["errors"]])
        if len(errors):
            low, middle, high = np.quantile(errors, [0.05, 0.5, 0.95]).round(2)
            print(f"standard errors, said over came: median {middle}, 90% from {low} to {high}, of {len(errors)}")
        unseen = planned[planned["first"] == "not seen"]
        shown = unseen["answer"].isin(["named", "in group"]) | (unseen["probability"] < 0.5)
        print(f"not seen at first: {len(unseen)}; seen then, or said that nothing shows it: {int(shown.sum())}")
        print(f"within the limits: {int(planned['kept'].sum())} of {len(planned)}")
        print(f"seconds a plan: median {planned['seconds'].median():.0f}, at most {planned['seconds'].max():.0f}")
    columns = ["name", "variance", "first", "answer", "can", "rival", "said", "came", "words"]
    print(table[[c for c in columns if c in table]].to_string())


if __name__ == "__main__":
    main()
