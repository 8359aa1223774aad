"""From a fresh process to the first identified parameters, or the first diagnosis: import, trace, compile, run.

    python benchmarks/cold_start.py [--repeats 3] [--out out/benchmarks]

What is identified is a row of the paper's table 1: the Van der Pol oscillator, population 100, 50 generations, search
and refinement. Every process is new; the second of each pair finds the first one's compiled programs in a cache folder.
What is diagnosed is a servovalve, 5 s at 1 kHz, with the whole bank, identified in the same process: records of the
plant of tests/hidden_plants.py with nothing hidden, one effect, and two.
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import common
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.hidden_records import Hidden, records

STAGES = ("import", "trace", "compile", "cache", "run", "total")

PROCESS = """
import time
began = time.perf_counter()
import json, sys
import numpy as np
import jax
import ehsvjax
imported = time.perf_counter()

kinds = {"/jax/core/compile/jaxpr_trace_duration": "trace",
         "/jax/core/compile/jaxpr_to_mlir_module_duration": "trace",
         "/jax/core/compile/backend_compile_duration": "compile",
         "/jax/compilation_cache/cache_retrieval_time_sec": "cache"}
spans = []

def listen(name, duration, **_):
    if name in kinds:
        now = time.perf_counter()
        spans.append((kinds[name], now - duration, now))

jax.monitoring.register_event_duration_secs_listener(listen)
with np.load(sys.argv[1]) as data:
    record = ehsvjax.Record(data["time"], {"command": data["command"]}, {"position": data["position"]})
fit = ehsvjax.identify(getattr(ehsvjax, sys.argv[2])(), record, key=jax.random.key(0), population=100, generations=50)
if sys.argv[3] == "diagnose":
    ehsvjax.diagnose(fit, record, key=jax.random.key(1))
total = time.perf_counter() - began
print(json.dumps({"import": imported - began, "spans": spans, "total": total}))
"""


HIDDEN = {
    "diagnosis, nothing hidden": (),
    "diagnosis, one effect": ("constant_load",),
    "diagnosis, two effects": ("constant_load", "torque_motor_hysteresis"),
}


def one_process(data: Path, model: str, last: str, cache: Path | None = None) -> dict:
    """Return the seconds of each stage of one fresh process, whose last step is to identify or to diagnose."""
    environment = {"PATH": "/usr/bin:/bin", "PYTHONPATH": str(Path(__file__).parents[1])}
    if cache is not None:
        # Programs of any compile time and size are stored: by default JAX keeps those that took over a second.
        environment |= {
            "JAX_COMPILATION_CACHE_DIR": str(cache),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        }
    printed = subprocess.run(
        [sys.executable, "-c", PROCESS, str(data), model, last],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    stages = json.loads(printed.splitlines()[-1])
    # Two programs are compiled beside each other, and while one is traced: each moment counts once, for the first of
    # these that goes on in it. JAX counts fetching from the cache as compiling. The run is what is left.
    spans = stages.pop("spans")
    taken = 0.0
    for count, name in enumerate(("cache", "compile", "trace"), start=1):
        kinds = ("cache", "compile", "trace")[:count]
        stages[name] = covered([(begin, end) for kind, begin, end in spans if kind in kinds]) - taken
        taken += stages[name]
    return stages | {"run": stages["total"] - stages["import"] - taken}


def covered(spans: list[tuple[float, float]]) -> float:
    """Return the length of the union of intervals."""
    length, reached = 0.0, float("-inf")
    for begin, end in sorted(spans):
        length += max(0.0, end - max(begin, reached))
        reached = max(reached, end)
    return length


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        data = common.oscillator_record(Path(folder))
        measured: dict[str, list[dict]] = {"without a cache": [], "cache, first": [], "cache, second": []}
        for repeat in range(options.repeats):
            cache = Path(folder) / f"cache_{repeat}"
            measured["without a cache"].append(one_process(data, "van_der_pol", "identify"))
            measured["cache, first"].append(one_process(data, "van_der_pol", "identify", cache))
            measured["cache, second"].append(one_process(data, "van_der_pol", "identify", cache))
        made = records([Hidden("servovalve", "white", 1e-7, names, seed=1) for names in HIDDEN.values()])
        for name, one in zip(HIDDEN, made, strict=True):
            np.savez(data, time=one.time, command=one.command, position=one.position)
            measured[name] = [one_process(data, "servovalve", "diagnose") for _ in range(options.repeats)]
        for name, runs in measured.items():
            rows.append({"process": name} | {stage: statistics.median(r[stage] for r in runs) for stage in STAGES})
    common.report(rows, options.out, "cold_start", f"Seconds from a fresh process, medians of {options.repeats}")


if __name__ == "__main__":
    main()
