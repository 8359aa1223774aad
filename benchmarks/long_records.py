"""How long a diagnosis takes, and how much memory, by the length of the record, the outputs and a busy neighbour.

    python benchmarks/long_records.py [--samples 5000 60000] [--out out/benchmarks]

A servovalve at 1 kHz of the plant of tests/hidden_plants.py, held levels, with two areas of the piston: a diagnosis in
a new process, where everything is compiled, and the same record once more. The memory is the most that the process
held, that of the identification before it included. A neighbour keeps one core busy all the while.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
import pandas as pd

from tests.hidden_plants import held_levels, servovalve_with

PERIOD, HELD = 1e-3, 200
NOISE = {"position": 3e-4, "load_pressure": 5e4}
# Steps of the plant, s: of a long record those of 20 us would take longer than the diagnosis.
FINE_STEP = 1e-4

PROCESS = """
import json, resource, sys, time
import numpy as np
import jax
import ehsvjax

with np.load(sys.argv[1]) as data:
    outputs = {name: data[name] for name in ("position", "load_pressure") if name in data}
    record = ehsvjax.Record(data["time"], {"command": data["command"]}, outputs)
fit = ehsvjax.identify(ehsvjax.servovalve(), record, key=jax.random.key(0), population=50, generations=20)
seconds = []
for _ in range(int(sys.argv[2])):
    began = time.perf_counter()
    found = ehsvjax.diagnose(fit, record, key=jax.random.key(1), progress=False)
    seconds.append(time.perf_counter() - began)
memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
print(json.dumps({"seconds": seconds, "memory": memory, "verdict": str(found).splitlines()[0]}))
"""
BUSY = "while True: pass"


def record_at(path: Path, samples: int, outputs: tuple[str, ...]) -> None:
    """Make a record with an effect and put it into a file."""
    rng = np.random.default_rng(samples)
    command = held_levels(rng, 6e-3, -(-samples // HELD), HELD)[:samples]
    made = servovalve_with([{"area_asymmetry": {"asymmetry": 0.1}}], command[None], PERIOD, fine_step=FINE_STEP)
    measured = {name: made[name][0] + NOISE[name] * rng.standard_normal(samples) for name in outputs}
    np.savez(path, time=PERIOD * np.arange(samples), command=command, **measured)


def measured(path: Path, repeats: int, busy: bool) -> dict:
    """Diagnose a record in a process of its own."""
    neighbour = subprocess.Popen([sys.executable, "-c", BUSY]) if busy else None
    try:
        command = [sys.executable, "-c", PROCESS, str(path), str(repeats)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    finally:
        if neighbour is not None:
            neighbour.kill()
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Print a row for each record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, nargs="+", default=[5000, 60000], help="of the records")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for samples in options.samples:
        shortest = samples == min(options.samples)
        for outputs in (("position",), ("position", "load_pressure"))[: 2 if shortest else 1]:
            path = options.out / f"record_of_{samples}_{len(outputs)}.npz"
            record_at(path, samples, outputs)
            for busy in (False, True)[: 2 if shortest else 1]:
                found = measured(path, 2 if samples <= 100_000 else 1, busy)
                rows.append(
                    {
                        "samples": samples,
                        "outputs": len(outputs),
                        "busy neighbour": busy,
                        "cold, s": round(found["seconds"][0], 1),
                        "warm, s": round(found["seconds"][-1], 1) if len(found["seconds"]) > 1 else None,
                        "memory, GB": round(found["memory"], 2),
                        "verdict": found["verdict"],
                    }
                )
                print(rows[-1], flush=True)
    pd.DataFrame(rows).to_json(options.out / "long_records.json", orient="records", indent=1)


if __name__ == "__main__":
    main()
