"""A fit or a diagnosis, saved and loaded."""

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ehsvjax.checks import instance, several
from ehsvjax.effects import BANK
from ehsvjax.effects.effect import Effect
from ehsvjax.files import unreadable
from ehsvjax.fit import Fit
from ehsvjax.models.model import Model
from ehsvjax.sealed import read_sealed, write_sealed
from ehsvjax.storage import version_1
from ehsvjax.storage.trees import Tree, as_tree, from_tree

if TYPE_CHECKING:
    from ehsvjax.diagnosis.results.diagnosis import Diagnosis

_DAMAGED = "take another copy, or save it again"


def save_fit(fit: Fit, path: str | os.PathLike) -> None:
    """Write a fit, its records included; see `Fit.save`."""
    _save(fit, path)


def load_fit(path: str | os.PathLike, model: Model | None = None, bank: Sequence[Effect] | None = None) -> Fit:
    """Read a fit that `save_fit` wrote, of this or of an older version; see `Fit.load`.

    Raises:
        ValueError: if the file holds no fit, was altered, or needs a model or an effect that is not there.
        OSError: if the file is not there or may not be read.

    """
    bank = _check_handed(model, bank)
    if version_1.is_version_1(path):
        return version_1.load_fit(path, model)
    return _load(path, Fit, "a fit written by Fit.save", model, bank)


def save_diagnosis(diagnosis: "Diagnosis", path: str | os.PathLike) -> None:
    """Write a diagnosis, its fits and its record included; see `Diagnosis.save`."""
    _save(diagnosis, path)


def load_diagnosis(
    path: str | os.PathLike, model: Model | None = None, bank: Sequence[Effect] | None = None
) -> "Diagnosis":
    """Read a diagnosis that `save_diagnosis` wrote; see `Diagnosis.load`.

    Raises:
        ValueError: if the file holds no diagnosis, was altered, or needs a model or an effect that is not there.
        OSError: if the file is not there or may not be read.

    """
    from ehsvjax.diagnosis.results.diagnosis import Diagnosis

    bank = _check_handed(model, bank)
    return _load(path, Diagnosis, "a diagnosis written by Diagnosis.save", model, bank)


def _save(result: Any, path: str | os.PathLike) -> None:
    tree = as_tree(result)
    write_sealed(path, type(result).__name__, {"objects": tree.objects}, tree.arrays)


def _check_handed(model: Any, bank: Any) -> tuple[Effect, ...]:
    if model is not None:
        instance("model", model, Model, "hand over the model that was fitted, or none for one of this package")
    return several("bank", BANK if bank is None else bank, Effect, "hand over (*ehsvjax.effects.BANK, my_effect)")


def _load(path: str | os.PathLike, kind: type, what: str, model: Model | None, bank: Sequence[Effect]) -> Any:
    sealed = read_sealed(path, kind.__name__, what, _DAMAGED)
    try:
        result = from_tree(Tree(sealed.facts["objects"], sealed.arrays), model, bank)
    except ValueError as error:
        raise ValueError(f"{path} cannot be read as {what}: it holds {error}") from error
    except Exception as error:
        # The seal is whole: it was not written by this package.
        raise unreadable(path, what, f"it was never a result, {error!r}", _DAMAGED) from error
    if not isinstance(result, kind):
        raise unreadable(path, what, f"it is one of {type(result).__name__}", _DAMAGED)
    return result
