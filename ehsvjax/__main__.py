"""The demo, `python -m ehsvjax [--out DIR]`: the paper's two identifications again, a hidden effect found, a plan."""

import argparse
import sys
import tempfile
import textwrap
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import numpy as np

from ehsvjax import effects, excitation, paper
from ehsvjax.diagnosis import diagnose
from ehsvjax.drawing import to_png
from ehsvjax.experiment import Limits
from ehsvjax.identify import identify
from ehsvjax.models import servovalve, van_der_pol
from ehsvjax.paper import Identification
from ehsvjax.record import Record
from ehsvjax.report import write_report
from ehsvjax.simulate import simulate


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the demo with the arguments given, by default those of the command line."""
    parser = argparse.ArgumentParser(prog="python -m ehsvjax", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the results (default: out)")
    parser.add_argument("--seed", type=int, default=0, help="of the noise and of the search (default: 0)")
    options = parser.parse_args(arguments)
    if not 0 <= options.seed < 2**32:
        parser.error(f"expected --seed from 0 to {2**32 - 1}, got {options.seed}")
    try:
        # Now, and not after minutes of work.
        options.out.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=options.out).close()
    except OSError as error:
        parser.error(f"expected --out to be a folder that can be written, got {options.out} ({error.strerror})")
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

    print("\nA servovalve whose torque motor sticks; its model does not know, and is asked what is wrong")
    page = _find_what_is_hidden(jax.random.key(options.seed), options.out)
    print(f"\nOpen {report.resolve()} and {page.resolve()} in a browser. ({time.perf_counter() - began:.0f} s in all)")


def _find_what_is_hidden(key, out: Path) -> Path:
    """Hide hysteresis in a simulated valve, fit the model that has none, diagnose, plan, and write pictures and page.

    The valve is this package's own, at a quarter of its usual step; tests and benchmarks use plants of their own.
    """
    excitation_key, noise_key, search_key, diagnosis_key, plan_key = jax.random.split(key, 5)
    timing = {"duration": 4.0, "sample_period": 1e-3}
    command = excitation.pseudo_random_signal(excitation_key, amplitude=6e-3, hold_time=0.2, **timing)
    clock = excitation.sample_times(**timing)
    hidden = {"torque_motor_hysteresis.half_width": 6e-5}
    bounds = {name: (0.0, 1e-3) for name in hidden}
    plant = effects.attach(servovalve(), bounds, duration=timing["duration"], bank=effects.BANK)
    position = simulate(plant, Record(clock, {"command": command}), hidden, substeps=16)["position"]
    noise = 1e-4 * np.asarray(jax.random.normal(noise_key, position.shape))
    record = Record(clock, {"command": command}, {"position": position + noise}, name="a valve that sticks")
    fit = identify(servovalve(), record, key=search_key, population=50, generations=20)
    print(f"  the model without it fits to {fit.fit_percent['position']:.2f} %")
    diagnosis = diagnose(fit, record, key=diagnosis_key, progress=sys.stderr.isatty())
    _print_folded(diagnosis)
    print("\nIt would not show a piston that rubs with 1 kN. Which experiment would?")
    plan = diagnosis.next_experiment(
        Limits(command=(-6e-3, 6e-3), position=(-0.1, 0.1)), key=plan_key,
        can_change={"supply_pressure": (70e5, 140e5)}, against={"coulomb_friction.force": 1e3}, generations=8,
    )  # fmt: skip
    _print_folded(plan)
    (out / "diagnosis.png").write_bytes(to_png(diagnosis.plot(), 110.0))
    (out / "next_experiment.png").write_bytes(to_png(plan.plot(), 110.0))
    diagnosis.report(out / "diagnosis.html", plan)
    return out / "diagnosis.html"


def _print_folded(text: object) -> None:
    for line in str(text).splitlines():
        print(textwrap.fill(line.strip(), 100, initial_indent="  ", subsequent_indent="    "))


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
