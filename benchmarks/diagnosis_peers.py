"""What do others make of the same residuals? Sparse regression, a Gaussian process, a correlation test and a diagnosis.

    pip install -c constraints.txt -e ".[benchmark]"
    python benchmarks/diagnosis_peers.py [--draws 1] [--nulls 20] [--seed 0]

Records of the independent plants with one effect of each kind, the smallest noise variance of benchmarks/diagnosis.py,
and with none. Every method has the same fit and the same record (benchmarks/residual_methods.py); a peer is right if
its strongest term can mean the effect, and so is a diagnosis that puts it into a group. A term more is a name more: so
many on average are told.
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import jax
import numpy as np
import pandas as pd

import ehsvjax
from benchmarks.diagnosis import VARIANCES, base
from benchmarks.processes import rows_of
from benchmarks.residual_methods import (
    Answer,
    correlation_test,
    forward_regression,
    gaussian_process,
    thresholded_regression,
)
from ehsvjax.diagnosis import diagnose
from tests.hidden_oracle import SEPARABLE, oracle
from tests.hidden_plants import effect_sizes
from tests.hidden_records import Hidden, records

Method = Callable[[ehsvjax.Fit, ehsvjax.Record], Answer]


def diagnosed(fit: ehsvjax.Fit, record: ehsvjax.Record) -> Answer:
    """Answer as this package does; each cause means itself or what it shares a group with."""
    found = diagnose(fit, record, key=jax.random.key(0), progress=False)
    groups = {a.causes[0]: frozenset(map(base, a.causes)) for a in found.alternatives}
    meant = tuple(groups.get(name, frozenset([base(name)])) for name in found.names)
    return Answer(found.verdict != "adequate", found.names, meant)


METHODS: dict[str, Method] = {
    "ehsvjax.diagnose": diagnosed,
    "sparse regression, thresholds (pysindy)": thresholded_regression,
    "sparse regression, forward (pysindy)": forward_regression,
    "Gaussian process (scikit-learn)": gaussian_process,
    "correlation test": correlation_test,
}


def trials_of(draws: int, nulls: int, seed: int) -> list[Hidden]:
    """Return what each record hides."""
    rng = np.random.default_rng(seed)
    found = []
    for model, variances in VARIANCES.items():
        effects = [(name,) for name in effect_sizes(model) if not name.startswith("unknown")] * draws
        for names in [*effects, *[()] * nulls]:
            found.append(Hidden(model, "white", variances[0], names, int(rng.integers(2**31))))
    return found


def tried(trials: list[Hidden]) -> list[dict[str, Any]]:
    """Let every method answer on some records of one model; one row each."""
    rows = []
    model = ehsvjax.servovalve() if trials[0].model == "servovalve" else ehsvjax.van_der_pol()
    for hidden, made in zip(trials, records(trials), strict=True):
        record = ehsvjax.Record(made.time, {"command": made.command}, {"position": made.position})
        fit = ehsvjax.identify(model, record, key=jax.random.key(hidden.seed), population=50, generations=30)
        known = oracle(hidden, made) if hidden.names and "process_noise" not in hidden.names else None
        for name, method in METHODS.items():
            began = time.perf_counter()
            answer = method(fit, record)
            rows.append(
                {
                    "model": hidden.model,
                    "hidden": ", ".join(hidden.names),
                    "seed": hidden.seed,
                    "worth": known.worth if known else None,
                    "separable": known is not None and known.deficit > SEPARABLE,
                    "method": name,
                    "answer": judged(hidden.names, answer),
                    "alone": bool(answer.meant) and len(answer.meant[0]) == 1,
                    "terms": answer.terms,
                    "seconds": time.perf_counter() - began,
                }
            )
    return rows


def judged(truth: tuple[str, ...], answer: Answer) -> str:
    """Judge an answer: the strongest term is right, wrong, or there is none."""
    if not answer.inadequate:
        return "nothing seen"
    if not answer.meant:
        return "something, no name"
    return "right" if truth and truth[0] in answer.meant[0] else "wrong name"


def table_of(rows: list[dict[str, Any]]) -> pd.DataFrame:
    """Return how each method answered, in percent of the records of each kind."""
    table = pd.DataFrame(rows)
    seen = (table["worth"] > SEPARABLE) | (table["hidden"] == "process_noise")
    nothing = table["hidden"] == ""
    kinds = {"separable": table["separable"], "seen, rivals as good": seen & ~table["separable"], "nothing": nothing}
    lines = []
    for kind, chosen in kinds.items():
        for method in METHODS:
            some = table[chosen & (table["method"] == method)]
            counts = some["answer"].value_counts()
            answers = ("right", "wrong name", "something, no name", "nothing seen")
            lines.append(
                {
                    "hidden": f"{kind} ({len(some)})",
                    "method": method,
                    **{answer: int(counts.get(answer, 0)) for answer in answers},
                    "right, alone": int((some["alone"] & (some["answer"] == "right")).sum()),
                    "terms": some["terms"].map(len).mean(),
                    "s": some["seconds"].median(),
                }
            )
    return pd.DataFrame(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=1, help="of every effect")
    parser.add_argument("--nulls", type=int, default=20, help="records of each model without any effect")
    parser.add_argument("--seed", type=int, default=0, help="of all trials")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    options = parser.parse_args()
    trials = trials_of(options.draws, options.nulls, options.seed)
    rows = rows_of(tried, trials, lambda hidden: hidden.model, options.out / "diagnosis_peers.json")
    print(table_of(rows).to_string(index=False, float_format="%.1f"))


if __name__ == "__main__":
    main()
