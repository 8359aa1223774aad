"""Processes side by side, one on each core, for draws and trials that have nothing to do with each other."""

import json
import multiprocessing
import os
import threading
import time
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from tqdm import tqdm

from ehsvjax.diagnosis import Diagnosis

# Trials of one kind that a process makes and diagnoses together, at most: an own plant steps them all at once.
_TOGETHER = 8


def workers() -> ProcessPoolExecutor:
    """Return processes of their own JAX and NumPy, as many as there are cores.

    Threads of OpenBLAS that wait for each other in several processes at once take half of the machine: each has one.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(os.cpu_count(), context, _end_with, (os.getpid(),))


def _end_with(parent: int) -> None:
    """End this process when its parent has ended, however that came: killed, it cannot tell its workers."""

    def watch():
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def rows_of(
    tried: Callable[[list], list[dict[str, Any]]], trials: Sequence, kind: Callable[[Any], Hashable], path: Path
) -> list[dict[str, Any]]:
    """Return the rows of all trials, tried side by side, those of one kind together.

    What has been measured is kept in the file, even if the rest is interrupted.
    """
    chunks = []
    for key in dict.fromkeys(map(kind, trials)):
        same = [trial for trial in trials if kind(trial) == key]
        # No core is to wait while the last of a few trials are diagnosed on another.
        together = min(_TOGETHER, -(-len(same) // (2 * (os.cpu_count() or 1))))
        chunks += [same[k : k + together] for k in range(0, len(same), together)]
    rows: list[dict[str, Any]] = []
    path.parent.mkdir(parents=True, exist_ok=True)
    with workers() as pool:
        for found in tqdm(pool.map(tried, chunks), total=len(chunks), mininterval=10.0):
            rows += found
            path.write_text(json.dumps(rows, indent=1, default=float))
    return rows


def said(found: Diagnosis) -> dict[str, Any]:
    """Return what a diagnosis says, as columns of a row: the verdict, the causes, the groups, how probable each is."""
    grouped = [dict(zip(a.causes, a.probabilities, strict=True)) for a in found.alternatives]
    alone = [{c.name: c.probability} for c in found.causes if not any(c.name in group for group in grouped)]
    return {
        "verdict": found.verdict,
        "causes": found.names,
        "groups": [a.causes for a in found.alternatives],
        "probabilities": [*alone, *grouped],
        "innocent": found.innocent,
        # Uniform where nothing is left.
        "p_value": found.misfit.tests_after[0].corrected if found.misfit.tests_after else 1.0,
    }
