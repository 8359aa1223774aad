"""A diagnosis as one HTML page that needs no other file, written by Jinja2 with every text escaped."""

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from ehsvjax.checks import file_path, refused
from ehsvjax.diagnosis.results import words
from ehsvjax.diagnosis.results.diagnosis import Diagnosis
from ehsvjax.diagnosis.results.pictures import plot_diagnosis
from ehsvjax.drawing import embedded, to_png
from ehsvjax.files import written_whole
from ehsvjax.plots import plot_fit
from ehsvjax.quantities import quantity

if TYPE_CHECKING:
    from ehsvjax.experiment import Plan

_HEADS = ("cause", "signal", "size", "score", "p, whole search", "gain", "smallest to be found", "looks like")
_ABSENT = "–"


def write_page(diagnosis: Diagnosis, path: str | os.PathLike, plan: "Plan | None") -> None:
    """Write the page.

    Args:
        diagnosis: what it tells of.
        path: the file, `.html`; its folder is made if need be.
        plan: of the next experiment.

    Raises:
        ValueError: for what is no path or no plan.

    """
    if plan is not None and not hasattr(plan, "chosen"):
        raise refused("plan", "the plan of a next experiment", plan, "make it by diagnosis.next_experiment(...)")
    environment = Environment(
        loader=PackageLoader("ehsvjax.diagnosis.results", "."), autoescape=True, undefined=StrictUndefined
    )
    page = environment.get_template("page.html").render(
        diagnosis=diagnosis,
        title=words.title(diagnosis),
        these=words.these(diagnosis),
        verdict=words.verdict(diagnosis),
        misfit=words.misfit_lines(diagnosis),
        causes=words.cause_lines(diagnosis),
        gain=words.gain_lines(diagnosis),
        following=words.next_lines(diagnosis),
        heads=_HEADS,
        rows=[_row(row) for row in diagnosis.table.itertuples()],
        excluded=[(e.cause, _size(e.above, e.unit)) for e in diagnosis.excluded],
        tests=diagnosis.misfit.tests,
        tests_after=diagnosis.misfit.tests_after,
        extended=str(diagnosis.extended),
        plan=None if plan is None else str(plan),
        planned=None if plan is None else embedded(to_png(plan.plot())),
        picture=embedded(to_png(plot_diagnosis(diagnosis))),
        fitted=[embedded(to_png(plot_fit(diagnosis.extended, record))) for record in diagnosis.extended.records],
    )
    file = Path(file_path("path", path))
    file.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(file) as whole:
        whole.write(page.encode())


def _row(row) -> dict:
    return {
        "included": row.included,
        "cells": (
            row.cause, row.signal, _size(row.size, row.unit), _number(row.score), _number(row.p_corrected),
            _number(row.likelihood_gain), _size(row.smallest_detectable, row.unit), row.confounded_with,
        ),
    }  # fmt: skip


def _size(value: float, unit: str) -> str:
    return _ABSENT if not np.isfinite(value) else quantity(value, unit).replace("-", "−")


def _number(value: float) -> str:
    return _ABSENT if not np.isfinite(value) else f"{value:.3g}".replace("-", "−")
