"""A fit in a file: one NPZ of plain arrays and a JSON text, without pickled content."""

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ehsvjax.fit import Effort, Fit, History
from ehsvjax.models.model import Model, Parameter
from ehsvjax.models.servovalve import servovalve
from ehsvjax.models.van_der_pol import van_der_pol
from ehsvjax.record import Record


def save_fit(fit: Fit, path: str | os.PathLike) -> None:
    """Write a fit, its records included."""
    arrays: dict[str, Any] = {f"history/{k}": v for k, v in fit.history._asdict().items() if k != "best"}
    arrays |= {f"history/best/{k}": v for k, v in fit.history.best.items()}
    for i, record in enumerate(fit.records):
        arrays[f"record{i}/time"] = record.time
        arrays |= {f"record{i}/inputs/{k}": v for k, v in record.inputs.items()}
        arrays |= {f"record{i}/outputs/{k}": v for k, v in record.outputs.items()}
    facts = {
        "model": fit.model.name,
        "options": dict(fit.model.options),
        "unknowns": {p.name: p._asdict() for p in (*fit.model.parameters, *fit.model.initial)},
        "records": [(record.name, record.hold) for record in fit.records],
        "parameters": fit.parameters,
        "initial": fit.initial,
        "noise_variance": fit.noise_variance,
        "effort": fit.effort._asdict(),
        "warnings": fit.warnings,
        "huber": fit.huber,
        "estimated_initial": fit.estimated_initial,
        "noise_variance_given": fit.noise_variance_given,
    }
    # An open file keeps the name as given: numpy would append .npz to a path.
    with open(path, "wb") as file:
        np.savez_compressed(file, facts=np.array(json.dumps(facts)), **arrays)


def load_fit(path: str | os.PathLike, model: Model | None = None) -> Fit:
    """Read a fit that `save_fit` wrote; see `Fit.load`.

    Raises:
        ValueError: if the file holds no fit, or the model is another one.

    """
    with np.load(path, allow_pickle=False) as file:
        if "facts" not in file.files:
            raise ValueError(f"expected a fit written by Fit.save at {path}, got {', '.join(file.files)}")
        facts = json.loads(str(file["facts"]))
        arrays = {name: file[name] for name in file.files if name != "facts"}

    def below(prefix: str) -> dict[str, np.ndarray]:
        return {name.removeprefix(prefix): a for name, a in arrays.items() if name.startswith(prefix)}

    return Fit(
        model=_as_fitted(_model_of(facts, model, path), facts["unknowns"]),
        records=tuple(
            Record(
                arrays[f"record{i}/time"],
                below(f"record{i}/inputs/"),
                below(f"record{i}/outputs/"),
                hold=hold,
                name=name,
            )
            for i, (name, hold) in enumerate(facts["records"])
        ),
        parameters=facts["parameters"],
        initial=tuple(facts["initial"]),
        noise_variance=facts["noise_variance"],
        history=History(
            **{name: arrays[f"history/{name}"] for name in History._fields if name != "best"},
            best=below("history/best/"),
        ),
        effort=Effort(**facts["effort"]),
        warnings=tuple(facts["warnings"]),
        huber=facts["huber"],
        estimated_initial=tuple(facts["estimated_initial"]),
        noise_variance_given=facts["noise_variance_given"],
    )


def _model_of(facts: Mapping[str, Any], model: Model | None, path: str | os.PathLike) -> Model:
    if model is not None:
        return model
    makers: dict[str, Callable[..., Model]] = {"servovalve": servovalve, "Van der Pol oscillator": van_der_pol}
    if facts["model"] not in makers:
        raise ValueError(
            f"expected the model of {path}, {facts['model']!r}, to be one of this package; "
            "pass your own as Fit.load(path, model)"
        )
    return makers[facts["model"]](**facts["options"])


def _as_fitted(model: Model, stored: Mapping[str, Mapping[str, Any]]) -> Model:
    """Return the model with the values, bounds and fixed parameters of the fit."""
    names = [p.name for p in (*model.parameters, *model.initial)]
    if sorted(names) != sorted(stored):
        raise ValueError(f"expected a model with the parameters {', '.join(stored)}, got one with {', '.join(names)}")
    return replace(
        model,
        parameters=tuple(Parameter(**stored[p.name]) for p in model.parameters),
        initial=tuple(Parameter(**stored[p.name]) for p in model.initial),
    )
