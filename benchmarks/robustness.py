"""Does a diagnosis say the same when nothing that matters has changed?

    python benchmarks/robustness.py [--effects 16] [--seed 0]

Records of the independent plants with one effect, drawn among those that a diagnosis of the smallest noise can see, are
diagnosed once, and then again: by four other keys; from another fit, which stands elsewhere within the search's
tolerance; from the fit that the first diagnosis extended, where nothing more should be found; and half by half, where
the effect may no longer be seen or told from others, but nothing else may be named.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import jax
import numpy as np
import pandas as pd

import ehsvjax
from benchmarks.diagnosis import VARIANCES, base
from benchmarks.processes import rows_of, said
from ehsvjax.diagnosis import Diagnosis, diagnose
from tests.hidden_plants import effect_sizes
from tests.hidden_records import Hidden, records

KEYS = 4


def trials_of(effects: int, seed: int) -> list[Hidden]:
    """Return what each record hides: of both models as many effects, drawn without replacement."""
    rng = np.random.default_rng(seed)
    found = []
    for model, variances in VARIANCES.items():
        known = [name for name in effect_sizes(model) if not name.startswith("unknown")]
        for name in rng.choice(known, effects // 2, replace=False).tolist():
            found.append(Hidden(model, "white", variances[0], (name,), int(rng.integers(2**31))))
    return found


def answer_of(found: Diagnosis) -> set[frozenset[str]]:
    """Return the names of a diagnosis, each with those that could be there instead."""
    return {frozenset(map(base, group)) for group in said(found)["probabilities"]}


def compared(first: Diagnosis, again: Diagnosis) -> str:
    """Say how a second diagnosis of the same record differs from the first."""
    if answer_of(first) == answer_of(again):
        return "the same"
    # One who stands at the edge of what can be told may leave a group.
    shared = all(any(one & other for other in answer_of(again)) for one in answer_of(first))
    return "a group of another size" if shared and len(answer_of(first)) == len(answer_of(again)) else "another answer"


def tried(trials: list[Hidden]) -> list[dict[str, Any]]:
    """Diagnose some records of one model again and again; a row for each diagnosis but the first."""
    rows = []
    model = ehsvjax.servovalve() if trials[0].model == "servovalve" else ehsvjax.van_der_pol()

    def fitted(record, seed):
        return ehsvjax.identify(model, record, key=jax.random.key(seed), population=50, generations=30)

    for hidden, made in zip(trials, records(trials), strict=True):
        record = ehsvjax.Record(made.time, {"command": made.command}, {"position": made.position})
        fit = fitted(record, 0)
        first = diagnose(fit, record, key=jax.random.key(0), progress=False)
        facts = {"model": hidden.model, "hidden": hidden.names[0], "seed": hidden.seed, "first": in_words(first)}

        def row(change, outcome, found, facts=facts):
            rows.append(facts | {"change": change, "outcome": outcome, "said": in_words(found)})

        for key in range(1, 1 + KEYS):
            again = diagnose(fit, record, key=jax.random.key(key), progress=False)
            row("another key", compared(first, again), again)
        again = diagnose(fitted(record, 1), record, key=jax.random.key(0), progress=False)
        row("another fit", compared(first, again), again)
        if first.verdict in ("named", "ambiguous"):
            again = diagnose(first.extended, record, key=jax.random.key(0), progress=False)
            row("its extended fit", "nothing more" if again.verdict == "adequate" else "something more", again)
        middle = 0.5 * (record.time[0] + record.time[-1])
        for half in (record.slice(stop=middle), record.slice(start=middle)):
            again = diagnose(fitted(half, 0), half, key=jax.random.key(0), progress=False)
            row("half of the record", of_half(hidden, first, again), again)
    return rows


def of_half(hidden: Hidden, whole: Diagnosis, half: Diagnosis) -> str:
    """Judge what half of a record says."""
    if half.verdict == "adequate":
        return "not seen"
    if half.verdict == "unexplained":
        return "unexplained"
    if all(hidden.names[0] in group for group in answer_of(half)):
        return "the truth, or a group with it"
    # What the whole record cannot tell from the truth, half of it may take for it.
    everything = frozenset().union(*answer_of(whole))
    return "what the whole says too" if all(group & everything for group in answer_of(half)) else "another name"


def in_words(found: Diagnosis) -> str:
    """Return the verdict and the names in one line."""
    return " and ".join(" or ".join(sorted(group)) for group in answer_of(found)) or found.verdict


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--effects", type=int, default=16, help="records, half of each model")
    parser.add_argument("--seed", type=int, default=0, help="of all trials")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    options = parser.parse_args()
    trials = trials_of(options.effects, options.seed)
    table = pd.DataFrame(rows_of(tried, trials, lambda hidden: hidden.model, options.out / "robustness.json"))
    print(pd.crosstab(table["change"], table["outcome"]).to_string())
    off = table[table["outcome"].isin(["another answer", "another name", "something more", "unexplained"])]
    if len(off):
        print(off.to_string())


if __name__ == "__main__":
    main()
