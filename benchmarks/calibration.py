"""Are the probabilities of a diagnosis right? Of names given with 90 to 99%, are 90 to 99% there?

    python benchmarks/calibration.py out/benchmarks/diagnosis.json out/benchmarks/several_outputs.json ...

Reads what the other benchmarks of diagnoses have stored: for every cause that was named, and every one that could be
there instead, how probable it was said to be, and whether it was hidden in the record. Records in which something was
hidden that the bank lacks are left out: no name could be right there.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

EDGES = (0.0, 0.05, 0.2, 0.5, 0.8, 0.95, 0.99, 1.0)
# Of a group, whose smallest set of names that is as probable as this should hold the truth as often.
SET = 0.95


def truth_of(row: dict[str, Any]) -> set[str]:
    """Return the names of what was hidden; of a wrong constant also that of the constant."""
    return set(row["names"]) if "names" in row else {row["name"]} - {""}


def statements(rows: list[dict[str, Any]]) -> pd.DataFrame:
    """Return every name that was given: its probability, whether it was hidden, and of which trial."""
    found = []
    for trial, row in enumerate(rows):
        truth = truth_of(row)
        if row["verdict"] == "failed" or any(name.startswith("unknown") for name in truth):
            continue
        for group in row["probabilities"]:
            for name, probability in group.items():
                found.append({"trial": trial, "probability": probability, "right": name.partition("@")[0] in truth})
    return pd.DataFrame(found)


def reliability(table: pd.DataFrame) -> pd.DataFrame:
    """Return for each range of probabilities how many names were given with it, and which share of them was right."""
    bins = pd.cut(table["probability"], EDGES, include_lowest=True)
    grouped = table.groupby(bins, observed=True)
    counts, said, right = grouped.size(), grouped["probability"].mean(), grouped["right"].mean()
    error = np.sqrt(said * (1.0 - said) / counts)
    return pd.DataFrame({"names": counts, "said, mean": said, "right": right, "sampling error": error})


def within_set(rows: list[dict[str, Any]]) -> tuple[int, int]:
    """Return of how many single hidden causes that were seen the smallest 95% set holds the truth, and how many."""
    held = seen = 0
    for row in rows:
        truth = truth_of(row)
        groups = row.get("probabilities") or []
        if len(truth) != 1 or not groups or any(name.startswith("unknown") for name in truth):
            continue
        seen += 1
        sets = [_smallest_set(group) for group in groups]
        held += any(name.partition("@")[0] in truth for names in sets for name in names)
    return held, seen


def _smallest_set(group: dict[str, float]) -> list[str]:
    names = sorted(group, key=lambda name: -group[name])
    reached = np.cumsum([group[name] for name in names])
    return names[: int(np.searchsorted(reached, SET * reached[-1])) + 1]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path)
    rows = [row for file in parser.parse_args().files for row in json.loads(file.read_text())]
    table = statements(rows)
    print(f"{len(rows)} diagnoses, {len(table)} names")
    print(reliability(table).to_string(float_format=lambda value: f"{value:.3f}"))
    held, seen = within_set(rows)
    print(f"the truth is in the smallest set of {SET:.0%} in {held} of {seen}")


if __name__ == "__main__":
    main()
