"""Does a diagnosis find what was hidden? Many records of independent plants, each with effects drawn at random.

    python benchmarks/diagnosis.py [--draws 2] [--nulls 250] [--pairs 60] [--triples 40] [--unknown 60] [--kind all]
                                   [--model all] [--seed 0]

The plants are those of tests/hidden_plants.py, which share nothing with the package. Hidden are: one effect of each
kind at three noise levels; two or three together; nothing, under white, correlated, quantised noise and outliers; and
an effect that the bank lacks. Of effects the plant also says what could be known: the noise variances by which the
best rival would fit worse, the nominal parameters refitted, to first order for the servovalve. Draws are shared out to
processes, one on each core; each trial can be repeated from its seed.
"""

import argparse
import sys
import time
import traceback
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))

import jax
import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

import ehsvjax
from benchmarks.processes import rows_of, said
from ehsvjax.diagnosis import Diagnosis, diagnose
from ehsvjax.diagnosis.hypotheses.missing import MissingTerm
from tests.hidden_oracle import SEPARABLE, oracle, worth_each
from tests.hidden_plants import effect_sizes
from tests.hidden_records import TRUTH, Hidden, Made, records, true_term

matplotlib.use("Agg")

VARIANCES = {"servovalve": (1e-8, 1e-7, 1e-5), "van_der_pol": (0.001, 0.01, 0.05)}


class Trial(NamedTuple):
    """One record to be made and diagnosed."""

    kind: str
    hidden: Hidden


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
            found += [Trial("one", Hidden(model, "white", v, (name,), seed())) for name in known for v in variances]
        for i in range(options.nulls):
            kind = ("white", "AR", "quantised", "outliers")[i % 4]
            found.append(Trial("none", Hidden(model, kind, variances[i % 3], (), seed())))
        for kind, count, together in (("two", options.pairs, 2), ("three", options.triples, 3)):
            for i in range(count // 2):
                some = tuple(rng.choice(known, together, replace=False).tolist())
                found.append(Trial(kind, Hidden(model, "white", variances[i % 2], some, seed())))
        for i in range(options.unknown // 2):
            found.append(Trial("unknown", Hidden(model, "white", variances[0], (unknown[i % len(unknown)],), seed())))
    return [t for t in found if options.kind in ("all", t.kind) and options.model in ("all", t.hidden.model)]


def tried(trials: list[Trial]) -> list[dict[str, Any]]:
    """Make and diagnose the records of some trials of one model, in whatever process this is."""
    rows = []
    made = records([t.hidden for t in trials])
    model = trials[0].hidden.model
    nominal = ehsvjax.servovalve() if model == "servovalve" else ehsvjax.van_der_pol()
    population, generations = (50, 20) if model == "servovalve" else (100, 50)
    for trial, one in zip(trials, made, strict=True):
        record = ehsvjax.Record(one.time, {"command": one.command}, {"position": one.position})
        hidden = trial.hidden
        row: dict[str, Any] = {"kind": trial.kind, **hidden._asdict(), "sizes": one.sizes}
        if trial.kind != "none" and "process_noise" not in hidden.names:
            known = oracle(hidden, one)
            row |= {"worth": known.worth, "rival_deficit": known.deficit, "rival": known.rival}
        if len(hidden.names) > 1:
            row["worth_each"] = worth_each(hidden, one)
        key = jax.random.key(hidden.seed)
        began = time.perf_counter()
        try:
            fit = ehsvjax.identify(nominal, record, key=key, population=population, generations=generations)
            identified = time.perf_counter()
            d = diagnose(fit, record, key=key)
        except Exception:  # a failure is a result, and the others go on
            rows.append(row | {"verdict": "failed", "error": traceback.format_exc(limit=-4)})
            continue
        gain = d.gain.outputs["position"]
        if trial.kind == "unknown" and d.missing is not None:
            row["missing_correlation"] = correlation(hidden, one, d.missing)
        if trial.kind == "one" and d.verdict == "named":
            row["inside"] = inside(d, hidden)
        rows.append(
            row
            | {
                **said(d),
                "seconds": time.perf_counter() - identified,
                "seconds_to_fit": identified - began,
                "rmse_after_over_noise": gain.rmse_after / gain.noise_floor,
                "noise_over_true": gain.noise_floor / hidden.variance**0.5,
                "missing": None if d.missing is None else (d.missing.place, d.missing.quantity),
            }
        )
    return rows


def correlation(hidden: Hidden, made: Made, missing: MissingTerm) -> float:
    """Correlate an estimated missing term with the true one along the record; none where the place is wrong.

    A servovalve's terms act through its flow: times count by the square of the opening, and a closed valve tells
    nothing.
    """
    place, truth, acting = true_term(hidden, made)
    estimate = missing.series
    if missing.place == "damping":
        # As a force: the damping is proportional to 1 - x^2.
        x = made.clean
        estimate = (x**2 - (x + estimate) ** 2) * np.gradient(x)
    # Both openings and supply pressures act on the flow, both damping and forces on the motion.
    if not any({place, missing.place} <= alike for alike in ({"opening", "supply"}, {"force", "damping"}, {place})):
        return 0.0
    moments = np.cov(estimate, truth, aweights=acting)
    return float(moments[0, 1] / np.sqrt(max(moments[0, 0] * moments[1, 1], 1e-300)))


def inside(d: Diagnosis, hidden: Hidden) -> list[bool]:
    """Return for each parameter of the nominal model whether the extended fit's 95% interval holds the truth."""
    intervals = d.extended.precision().intervals()
    return [bool(low <= TRUTH[hidden.model][n] <= high) for n, (low, high) in intervals.items() if "." not in n]


def base(cause: str) -> str:
    """Name of an effect without its signal."""
    return cause.partition("@")[0]


def outcome(row) -> str:
    """Judge one trial of up to three effects, or of none."""
    truth = set(row["names"])
    if row["kind"] == "unknown" and row["verdict"] not in ("failed", "unexplained"):
        return "explained away" if row["innocent"] else "residual not innocent"
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
        held = one.loc[one["outcome"] == "named", "inside"].dropna() if "inside" in one else pd.Series()
        every = [i for row in held for i in row]
        if every:
            share, error = 100 * np.mean(every), 100 * np.sqrt(0.95 * 0.05 / len(every))
            lines.append(f"parameters within their 95% intervals where the effect was named: {share:.1f}% "
                         f"of {len(every)} (sampling error {error:.1f})")  # fmt: skip
    for kind in ("none", "two", "three", "unknown"):
        some = table[table["kind"] == kind]
        if len(some):
            lines.append(f"{kind}: {counts(some)}")
            if kind in ("two", "three"):
                each = np.array([worths is not None and min(worths) > SEPARABLE for worths in some["worth_each"]])
                seen = some[each & (some["rival_deficit"] > SEPARABLE)]
                lines.append(f"    each worth more than {SEPARABLE:g} beside the others, any fewer worse by as much: "
                             f"{counts(seen)}")  # fmt: skip
            if kind == "unknown":
                clear = some[some["rival_deficit"] > SEPARABLE]
                lines.append(f"    best two of the bank worse by more than {SEPARABLE:g}: {counts(clear)}")
                told = clear["missing_correlation"].dropna()
                lines.append(f"    correlation of the missing term with the true one: median {told.median():.2f}, "
                             f"above 0.9 in {100 * (told > 0.9).mean():.0f}% of {len(told)}")  # fmt: skip
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
    parser.add_argument("--triples", type=int, default=40, help="records with three effects")
    parser.add_argument("--unknown", type=int, default=60, help="records with an effect that the bank lacks")
    parser.add_argument("--kind", choices=["all", "one", "none", "two", "three", "unknown"], default="all")
    parser.add_argument("--model", choices=["all", *VARIANCES], default="all")
    parser.add_argument("--seed", type=int, default=0, help="of all trials")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    options = parser.parse_args()
    rows = rows_of(tried, trials_of(options), lambda t: (t.kind, t.hidden.model), options.out / "diagnosis.json")
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
