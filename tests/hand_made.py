"""A fit made by hand, whose statistics can be worked out with pencil and paper."""

from dataclasses import replace

import numpy as np

from ehsvjax import Fit, Model, Parameter, Record, Signal
from ehsvjax.fit import Effort, History


def _start(parameters, initial, inputs):
    del parameters, inputs
    return {"load": initial["initial_load"]}


def _stepper(parameters, step_size, signal):
    del parameters, step_size, signal
    return lambda state, inputs: state


def _measure(parameters, state, inputs, signal):
    force = parameters["gain"] * inputs["command"] + state["load"]
    return {"force": signal("force", force), "strain": signal("strain", 1e-3 * force)}


def amplifier() -> Model:
    """Return force = gain*command + load, strain = force/1000."""
    return Model(
        name="amplifier",
        parameters=(
            Parameter("gain", "k", "N/V", 1.0, 0.5, 5.0, "log"),
            Parameter("temperature", "T", "K", 293.0, 250.0, 350.0, fixed=True),
        ),
        initial=(Parameter("initial_load", "F(0)", "N", 0.0, -1.0, 1.0),),
        signals=(
            Signal("command", "input", "V"),
            Signal("force", "sensor", "N"),
            Signal("strain", "sensor", "m/m"),
        ),
        start=_start,
        stepper=_stepper,
        measure=_measure,
        max_step=1.0,
        options=(("temperature", 293.0), ("coupling", "dc")),
    )


def record(name="bench 7") -> Record:
    """Return four samples 0.1 off the model's 2.5, 4.5, 6.5, 8.5 N, the third of them missing."""
    return Record(
        time=np.array([0.0, 0.5, 1.0, 1.5]),
        inputs={"command": np.array([1.0, 2.0, 3.0, 4.0])},
        outputs={"force": np.array([2.6, 4.4, np.nan, 8.6])},
        name=name,
    )


def record_of_both(name="bench 8") -> Record:
    """Return the same record with the strain, 1e-4 too large throughout."""
    strain = 1e-3 * np.array([2.5, 4.5, 6.5, 8.5]) + 1e-4
    return replace(record(name), outputs={**record().outputs, "strain": strain})


def fit(*records: Record, **changes) -> Fit:
    """Return a fit to the records with gain 2 and load 0.5; other fields as given."""
    records = records or (record(),)
    names = [name for name in ("force", "strain") if any(name in r.outputs for r in records)]
    made = Fit(
        model=amplifier(),
        records=records,
        parameters={"gain": 2.0},
        initial=tuple({"initial_load": 0.5} for _ in records),
        noise_variance={name: 0.01 if name == "force" else 1e-8 for name in names},
        history=History(
            best_cost=np.array([50.0, 9.0, 3.1]),
            median_cost=np.array([np.inf, 80.0, 12.0]),
            failed=np.array([0.6, 0.0, 0.0]),
            spread=np.array([0.3, 0.1, 0.02]),
            best={"gain": np.array([3.0, 2.2, 2.1])},
        ),
        effort=Effort(
            population=10,
            generations=3,
            stopped_early=False,
            simulations=30,
            refined=True,
            iterations=7,
            starts=4,
            starts_agreeing=3,
            converged=True,
            remaining=1e-6,
        ),
        warnings=(),
    )
    return replace(made, **changes)
