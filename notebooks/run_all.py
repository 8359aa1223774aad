"""Run every notebook top to bottom, as CI does, or those named; committed outputs stay unless --save is given.

Two at a time: compiling, most of what they do, takes one core.
"""

import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import nbformat
from nbclient import NotebookClient


def run(path: Path) -> None:
    """Run one notebook in a process of its own."""
    began = time.perf_counter()
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(
        notebook, timeout=900, kernel_name="python3", resources={"metadata": {"path": path.parent}}
    ).execute()
    print(f"{path.name}: ran in {time.perf_counter() - began:.0f} s", flush=True)
    if "--save" in sys.argv:
        for cell in notebook.cells:
            cell.metadata.pop("execution", None)
            # Bars and warnings are of the run, not of the notebook.
            if cell.cell_type == "code":
                cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr"]
        nbformat.write(notebook, path)


# Threads of OpenBLAS that wait for each other in two kernels at once take half of the machine.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# What one has compiled, and the tests before it, need not be compiled again.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).resolve().parents[1] / ".jax_cache"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
chosen = [a for a in sys.argv[1:] if not a.startswith("-")] or ["*.ipynb"]
# The last one takes longest.
paths = sorted({p for pattern in chosen for p in Path(__file__).parent.glob(pattern)}, reverse=True)
with ThreadPoolExecutor(2) as pool:
    # Taking the results raises what a notebook has raised.
    list(pool.map(run, paths))
