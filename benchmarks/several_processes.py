"""Islands in two processes under jax.distributed, a core each, against one process on one core.

    python benchmarks/several_processes.py [--repeats 5] [--population 256] [--generations 100] [--out out/benchmarks]

Every process shows its core as four devices, with an island on each: two processes have twice the islands, and twice
the throughput if exchanging the best costs nothing. Each identifies the paper's oscillator, first to compile, then to
be measured. The islands of both are compared, bit by bit, with as many in one process.
"""

import argparse
import json
import os
import socket
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import common

DEVICES = 4

PROCESS = """
import json, os, sys, time
data, core, address, count, index, islands, devices, population, generations, repeats = sys.argv[1:]
os.sched_setaffinity(0, {int(core)})
import jax
jax.config.update("jax_num_cpu_devices", int(devices))
if int(count) > 1:
    jax.distributed.initialize(address, int(count), int(index))
import numpy as np
import ehsvjax
file = np.load(data)
record = ehsvjax.Record(file["time"], {"command": file["command"]}, {"position": file["position"]})
taken = []
for _ in range(1 + int(repeats)):
    began = time.perf_counter()
    fit = ehsvjax.identify(ehsvjax.van_der_pol(), record, key=jax.random.key(0), population=int(population),
                           generations=int(generations), tolerance=0.0, refine=False, islands=int(islands),
                           devices=jax.devices())
    taken.append(time.perf_counter() - began)
bits = [v.hex() for v in fit.parameters.values()] + [float(c).hex() for c in fit.history.best_cost]
print(json.dumps({"seconds": taken[1:], "bits": bits}))
"""


def measured(data: Path, processes: int, devices: int, repeats: int, options: argparse.Namespace) -> list[dict]:
    """Return what each of some processes says, a core each, an island on each of their devices."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    cores = sorted(os.sched_getaffinity(0))
    common_arguments = [processes * devices, devices, options.population, options.generations, repeats]
    running = []
    for index in range(processes):
        arguments = [data, cores[index % len(cores)], address, processes, index, *common_arguments]
        running.append(
            subprocess.Popen(
                [sys.executable, "-c", PROCESS, *map(str, arguments)],
                stdout=subprocess.PIPE,
                text=True,
                env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])},
            )
        )
    printed = [process.communicate()[0] for process in running]
    if any(process.returncode for process in running):
        raise SystemExit("expected every process to end well: see what they printed above")
    return [json.loads(lines.splitlines()[-1]) for lines in printed]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--population", type=int, default=256)
    parser.add_argument("--generations", type=int, default=100)
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        data = common.oscillator_record(Path(folder))
        (together,) = measured(data, 1, 2 * DEVICES, 0, options)
        for processes in (1, 2):
            said = measured(data, processes, DEVICES, options.repeats, options)
            # They wait for each other: the slowest says how long it took.
            seconds = statistics.median(map(max, zip(*(each["seconds"] for each in said), strict=True)))
            islands = processes * DEVICES
            rows.append({
                "processes": processes,
                "islands": islands,
                "seconds": seconds,
                "generations of an island per s": islands * options.generations / seconds,
                "same bits as in one process": all(each["bits"] == together["bits"] for each in said)
                if processes == 2
                else None,
            })  # fmt: skip
    one, two = (row["generations of an island per s"] for row in rows)
    rows[1]["throughput over twice one"] = two / (2.0 * one)
    what = (
        f"Islands of {options.population} oscillators, {DEVICES} devices in each process, medians of {options.repeats}"
    )
    common.report(rows, options.out, "several_processes", what)


if __name__ == "__main__":
    main()
