"""Diagnoses of measured records of six rigs, against what is known of each, and what they predict of other records.

Nothing is simulated here to be found again: the rigs had their faults before this package was written. The files are
not part of it; they are looked for in ../shared/data beside the checkout, or where EHSVJAX_DATA points.

    python benchmarks/real_records.py                        # all, some minutes
    python benchmarks/real_records.py leakage tanks          # some of them
"""

import argparse
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))

import jax
import numpy as np
import pandas as pd

import ehsvjax
from benchmarks import real_models
from ehsvjax.diagnosis import Diagnosis

DATA = Path(os.environ.get("EHSVJAX_DATA", Path(__file__).parents[2] / "shared" / "data"))
AT_HAND = (DATA / "silverbox").is_dir()


class Rig(NamedTuple):
    """A rig: its model, what is diagnosed, what is predicted with it, and the truth in words.

    `known` are the causes that are right, alone or in a group; the groups of `needed` must each have one of them.
    """

    model: ehsvjax.Model
    records: tuple[ehsvjax.Record, ...]
    others: tuple[ehsvjax.Record, ...]
    known: tuple[str, ...]
    needed: tuple[str, ...]
    settings: Mapping[str, object]


def _table(name: str) -> pd.DataFrame:
    return pd.read_csv(DATA / name)


def silverbox() -> Rig:
    """Two stretches of a multisine; the arrow, whose end goes beyond them, is predicted."""

    def record(name, first, last):
        table = _table(f"silverbox/{name}.csv")
        table = table - table.mean()
        u, y = (table[column].to_numpy()[first:last] for column in ("u_V", "y_V"))
        return ehsvjax.Record(
            np.arange(len(u)) / 610.35, {"voltage": u}, {"position": y}, name=name, hold="band-limited"
        )  # fmt: skip

    return Rig(
        real_models.silverbox(),
        (record("multisine_1", 0, 3000), record("multisine_3", 0, 3000)),
        (record("arrow", 0, 38_500),),
        ("cubic_stiffness", "quadratic_stiffness"),
        ("cubic_stiffness",),
        {},
    )


def damper() -> Rig:
    """One amplitude; the other is predicted."""

    def record(name):
        table = _table(f"friction_damper/{name}.csv").iloc[::4]
        displacement = 0.0254 * table["displacement_in"].to_numpy()
        force = 4448.2 * table["damper_force_kip"].to_numpy()
        time_ = np.arange(len(table)) / 128.0
        return ehsvjax.Record(time_, {"displacement": displacement}, {"force": force}, name=name, hold="linear")

    return Rig(
        real_models.damper(),
        (record("0p5Hz_1in"),),
        (record("0p5Hz_1p5in"),),
        ("coulomb_friction", "dead_zone", "stribeck_friction"),
        ("coulomb_friction",),
        {},
    )


def leakage() -> Rig:
    """Two sweeps of unlike rate; each is predicted from the other."""

    def record(name):
        table = _table(f"servovalve_5329/{name}.csv").iloc[::10]
        current, flow = table["current_mA"].to_numpy(), table["flow_GPM"].to_numpy()
        return ehsvjax.Record(0.1 * np.arange(len(table)), {"current": current}, {"flow": flow}, name=name)

    return Rig(
        real_models.leakage(),
        (record("leakage_T100"), record("leakage_T200")),
        (),
        ("input_hysteresis", "sensor_lag"),
        ("input_hysteresis", "sensor_lag"),
        {},
    )


def tanks() -> Rig:
    """One record; the validation record of the benchmark is predicted."""

    def record(name):
        table = _table(f"cascaded_tanks/{name}.csv")
        inputs, outputs = {"pump_voltage": table["pump_V"].to_numpy()}, {"level": table["level_V"].to_numpy()}
        return ehsvjax.Record(4.0 * np.arange(len(table)), inputs, outputs, name=name)

    return Rig(
        real_models.tanks(),
        (record("estimation"),),
        (record("validation"),),
        ("hard_limit@upper_filling", "hard_limit@lower_filling", "sensor_saturation", "hard_limit"),
        ("hard_limit",),
        {},
    )


def drive() -> Rig:
    """The train of moves; the run with pulses is predicted."""

    def record(name):
        table = _table(f"emps/{name}.csv").iloc[::4]
        pulse = table["pulse_V"].to_numpy() if "pulse_V" in table else np.zeros(len(table))
        return ehsvjax.Record(
            0.004 * np.arange(len(table)),
            {"reference": table["q_ref_m"].to_numpy(), "pulse": pulse},
            {"position": table["q_meas_m"].to_numpy(), "motor_force": table["force_gtau_vir_N"].to_numpy()},
            name=name,
            hold={"reference": "linear", "pulse": "zero"},
        )

    return Rig(
        real_models.drive(),
        (record("train"),),
        (record("pulses"),),
        ("coulomb_friction", "constant_force", "sensor_gain@motor_force", "stribeck_friction", "input_bias"),
        ("coulomb_friction",),
        {},
    )


def valve() -> Rig:
    """Runs at 1, 3 and 5 V, each to one stop and back; others are predicted."""

    def record(name):
        table = _table(f"festo/{name}.csv")
        command, position = 1e-4 * table["valve_cmd_V"].to_numpy(), 0.02 * table["position_raw_V"].to_numpy() - 0.0055
        # The sensor ends at 10 V.
        position = np.where(position > 0.194, np.nan, position)
        arrives, leaves = np.flatnonzero(_mostly(np.isnan(position)))[[0, -1]]
        position[arrives:leaves] = np.nan
        turned = np.flatnonzero(command < 0)[0]
        back = leaves + np.flatnonzero(_mostly(position < 0.003)[leaves:])[0]
        # Most of the waiting at the stops is left out.
        kept = np.r_[: arrives + 100, turned - 150 : min(back + 200, len(table))][::4]
        return ehsvjax.Record(
            0.004 * np.arange(len(kept)), {"command": command[kept]}, {"position": position[kept]}, name=name
        )  # fmt: skip

    records = tuple(record(f"pA_{run}") for run in ("1V_s03", "3V_s02", "5V_s03"))
    runs = ("A_2V_s01", "A_3V_s01", "A_4V_s01", "B_2V_s01", "B_3V_s01", "B_4V_s01")
    others = tuple(record(f"p{run}") for run in runs)
    stiff = {name: 1e7 for name in real_models.STOPS if name.endswith("stiffness")}
    return Rig(
        real_models.valve(max(float(one.time[-1]) for one in records)),
        records,
        others,
        ("dead_zone", "saturation", "area_asymmetry", "area_ratio", "constant_load", "input_lag", "input_saturation",
         "input_dead_zone", "null_bias", "coulomb_friction", "natural_frequency"),
        ("dead_zone",),
        {
            "fixed": {"dead_zone": 0.0, "saturation": 1e-3} | stiff,
            "bounds": {"flow_gain": (5e-6, 5e-4), "damping_ratio": (0.3, 3.0), "natural_frequency": (10.0, 1000.0)},
            "initial": {"initial_filtered": 0.0, "initial_filtered_rate": 0.0, "initial_position": 0.0},
            "huber": 1.345,
        },
    )  # fmt: skip


def _mostly(so):
    """Say around each sample whether it is so for most of 31 of them: spikes do not count."""
    return np.convolve(so, np.ones(31), "same") > 15


RIGS: dict[str, Callable[[], Rig]] = {
    "leakage": leakage, "tanks": tanks, "drive": drive, "damper": damper, "silverbox": silverbox, "valve": valve,
}  # fmt: skip


def judged(rig: Rig, diagnosis: Diagnosis) -> str:
    """Return which of the causes that are needed were named, alone or in a group, and which others."""
    groups = [a.causes for a in diagnosis.alternatives]
    groups += [(c,) for c in diagnosis.names if not any(c in group for group in groups)]
    if not groups:
        return "no name"
    missed = [one for one in rig.needed if not any(_known(group, (one,)) for group in groups)]
    others = [group[0] for group in groups if not _known(group, rig.known)]
    said = f"without {', '.join(missed)}" if missed else "right"
    return f"{said}; also {', '.join(others)}" if others else said


def _known(group: Sequence[str], known: Sequence[str]) -> bool:
    return any(name in known or name.split("@")[0] in known for name in group)


def predicted(fit: ehsvjax.Fit, records: Sequence[ehsvjax.Record]) -> str:
    """Return the rmse of each output on other records, initial conditions estimated there."""
    if not records:
        return ""
    scores = [fit.score(record) for record in records]
    mean = {n: float(np.sqrt(np.mean([s.rmse[n] ** 2 for s in scores]))) for n in scores[0].rmse}
    fits = [value for s in scores for value in s.fit_percent.values()]
    return ", ".join(f"{n} {value:.3g}" for n, value in mean.items()) + f" ({min(fits):.1f} to {max(fits):.1f}%)"


def main() -> None:
    """Print each diagnosis and a table of all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rigs", nargs="*", help=f"of {', '.join(RIGS)}; by default all")
    chosen = parser.parse_args().rigs or list(RIGS)
    if unknown := set(chosen) - set(RIGS):
        parser.error(f"expected rigs of {', '.join(RIGS)}; got {', '.join(unknown)}")
    if not AT_HAND:
        sys.exit(f"expected the measured records in {DATA}: set EHSVJAX_DATA to where they are")
    rows = []
    for name in chosen:
        rig = RIGS[name]()
        fit = ehsvjax.identify(
            rig.model, list(rig.records), key=jax.random.key(0), population=40, generations=20, **rig.settings
        )
        begun = time.perf_counter()
        diagnosis = ehsvjax.diagnose(fit, list(rig.records), key=jax.random.key(1))
        seconds = time.perf_counter() - begun
        print(f"{diagnosis}\n")
        rows.append(
            {
                "rig": name,
                "answer": judged(rig, diagnosis),
                "held out, before": ", ".join(f"{n} {g.rmse_before:.3g}" for n, g in diagnosis.gain.outputs.items()),
                "after": ", ".join(f"{n} {g.rmse_after:.3g}" for n, g in diagnosis.gain.outputs.items()),
                "other records, before": predicted(fit, rig.others),
                "other, after": predicted(diagnosis.extended, rig.others),
                "s": round(seconds),
            }
        )
        print(pd.DataFrame(rows[-1:]).T.to_string(header=False), "\n", flush=True)
    print(pd.DataFrame(rows).to_string(index=False))


if __name__ == "__main__":
    main()
