"""Processes side by side, one on each core, for draws and trials that have nothing to do with each other."""

import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor


def workers() -> ProcessPoolExecutor:
    """Return processes of their own JAX and NumPy, as many as there are cores.

    Threads of OpenBLAS that wait for each other in several processes at once take half of the machine: each has one.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    return ProcessPoolExecutor(os.cpu_count(), mp_context=multiprocessing.get_context("spawn"))
