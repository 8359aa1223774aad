"""Fits as they were stored first: an NPZ with a JSON text `facts`, without a seal, of models without effects."""

import json
import os
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ehsvjax.files import reading, unreadable
from ehsvjax.fit import Effort, Fit, History
from ehsvjax.models.model import Model
from ehsvjax.record import Record
from ehsvjax.sealed import read_arrays
from ehsvjax.storage.models import MAKERS

_WHAT, _REMEDY = "a fit written by Fit.save", "take another copy, or fit and save it again"
_MAKERS = {"servovalve": "servovalve", "Van der Pol oscillator": "van_der_pol"}


def is_version_1(path: str | os.PathLike) -> bool:
    """Return whether a file is laid out like that; False for what is no NPZ file at all."""
    try:
        with zipfile.ZipFile(path) as file:
            return "facts.npy" in file.namelist()
    except Exception:
        # What is wrong with it is said by who reads it.
        return False


def load_fit(path: str | os.PathLike, model: Model | None = None) -> Fit:
    """Read such a fit.

    Raises:
        ValueError: if it is damaged, contradicts itself, or is of a model that is not there.

    """
    with reading(path, _WHAT, _REMEDY):
        arrays = read_arrays(path)
        facts = json.loads(str(arrays.pop("facts")))
        name, options, stored = facts["model"], dict(facts["options"]), dict(facts["unknowns"])
    if model is None and (name not in _MAKERS or "effects" in options):
        why = "which effects act where was not stored yet" if "effects" in options else "it is not of this package"
        raise ValueError(
            f"expected the model of {path} to be handed over, {name!r}, got none, and {why}: Fit.load(path, model)"
        )
    with reading(path, _WHAT, _REMEDY):
        model = MAKERS[_MAKERS[name]](**options) if model is None else model
    names = [p.name for p in (*model.parameters, *model.initial)]
    if sorted(names) != sorted(stored):
        raise ValueError(
            f"expected a model with the parameters {', '.join(stored)} for {path}, got one with {', '.join(names)}: "
            "hand over the one that was fitted, Fit.load(path, model)"
        )
    with reading(path, _WHAT, _REMEDY):
        fit = _fit(facts, arrays, _as_fitted(model, stored))
        problem = _contradiction(fit)
    if problem:
        raise unreadable(path, _WHAT, f"it contradicts itself, {problem}", _REMEDY)
    return fit


def _fit(facts: Mapping[str, Any], arrays: Mapping[str, np.ndarray], model: Model) -> Fit:
    def below(prefix: str) -> dict[str, np.ndarray]:
        return {name.removeprefix(prefix): a for name, a in arrays.items() if name.startswith(prefix)}

    return Fit(
        model=model,
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


def _as_fitted(model: Model, stored: Mapping[str, Mapping[str, Any]]) -> Model:
    """Return the model with the values, bounds and fixed parameters of the fit; what was not stored is the model's."""
    return replace(
        model,
        parameters=tuple(p._replace(**stored[p.name]) for p in model.parameters),
        initial=tuple(p._replace(**stored[p.name]) for p in model.initial),
    )


def _contradiction(fit: Fit) -> str | None:
    """Return what cannot be in a fit, for there is no seal that would tell; None if nothing shows."""
    initial = tuple(p.name for p in fit.model.initial)
    numbers = [
        *fit.parameters.values(),
        *fit.noise_variance.values(),
        *(v for ones in fit.initial for v in ones.values()),
    ]
    if set(fit.parameters) != set(fit.model.free):
        return f"the values are of {', '.join(fit.parameters)}, the free parameters {', '.join(fit.model.free)}"
    if len(fit.initial) != len(fit.records) or any(set(ones) != set(initial) for ones in fit.initial):
        return "its initial conditions are not those of its model and its records"
    if not np.isfinite(numbers).all() or min(fit.noise_variance.values()) <= 0.0:
        return "a number in it is none"
    if any(np.shape(leaf) != (fit.effort.generations,) for leaf in (*fit.history[:-1], *fit.history.best.values())):
        return f"its history is not one of {fit.effort.generations} generations"
    return None
