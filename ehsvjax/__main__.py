"""The demo, `python -m ehsvjax [--out DIR]`: the paper's two identifications again, with its figures and tables."""

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import jax

from ehsvjax import paper
from ehsvjax.models import servovalve, van_der_pol
from ehsvjax.paper import Identification
from ehsvjax.report import write_report


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the demo with the arguments given, by default those of the command line."""
    parser = argparse.ArgumentParser(prog="python -m ehsvjax", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the results (default: out)")
    parser.add_argument("--seed", type=int, default=0, help="of the noise and of the search (default: 0)")
    options = parser.parse_args(arguments)
    began = time.perf_counter()
    oscillator_key, valve_key = jax.random.split(jax.random.key(options.seed))

    print("Van der Pol oscillator (the first run of each model compiles it)")
    oscillator = _identify_each(paper.identify_van_der_pol, oscillator_key, paper.PAPER_TABLE_1)
    print("Servovalve")
    valve = _identify_each(paper.identify_servovalve, valve_key, paper.PAPER_TABLE_2)

    print("\nTable 1. Van der Pol oscillator: values and errors in % of the true value\n")
    print(paper.table_text(paper.table_1(oscillator), van_der_pol(), paper.VAN_DER_POL_TRUTH))
    print("\nTable 2. Servovalve: values (SI) and errors in % of the true value\n")
    print(paper.table_text(paper.table_2(valve), servovalve(), paper.SERVOVALVE_TRUTH))
    print(f"\nThe paper prints H = {paper.PRINTED_FLOW_GAIN:g} as the true one, a misprint: the report says why.")

    report = write_report(options.out, oscillator, valve)
    print(f"\nFigures 1, 4 and 5, both tables and {report.name} are in {report.parent.resolve()}")
    print(f"Open {report.resolve()} in a browser. ({time.perf_counter() - began:.0f} s in all)")


def _identify_each(identify: Callable[..., Identification], key, noise_variances) -> list[Identification]:
    identifications = []
    for i, variance in enumerate(noise_variances):
        began = time.perf_counter()
        identification = identify(jax.random.fold_in(key, i), variance, progress=sys.stderr.isatty())
        effort = identification.fit.effort
        print(
            f"  noise variance {variance:g}: {effort.simulations} simulations, then {effort.iterations} gradient steps "
            f"from the best start, in {time.perf_counter() - began:.1f} s",
            flush=True,
        )
        identifications.append(identification)
    return identifications


if __name__ == "__main__":
    main()
