"""Several fits side by side: how well each reproduces and predicts, and what its parameters cost."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ehsvjax.checks import refused, several
from ehsvjax.fit import Fit
from ehsvjax.record import Record, checked_records

if TYPE_CHECKING:
    import matplotlib.figure
    import pandas

_TWO_DIGITS, _ONE_DIGIT = "{:.2f}".format, "{:.1f}".format


@dataclass(frozen=True)
class Comparison:
    """What several fits make of the same records.

    Attributes:
        fits: by name.
        records: on which they were compared.
        scores: a row for each fit, record and output: fit in percent, rmse in the output's unit, whether the record
            was fitted or predicted.
        criteria: a row for each fit: its unknowns, the readings that it was fitted to, log likelihood, AIC and BIC;
            none where fits are of other records than each other, as these say nothing then.

    """

    fits: Mapping[str, Fit]
    records: tuple[Record, ...]
    scores: "pandas.DataFrame"
    criteria: "pandas.DataFrame"

    def __str__(self) -> str:
        """Both tables, with the fits side by side."""
        tables = [f"fit in percent\n{self._side_by_side().to_string(float_format=_TWO_DIGITS)}"]
        if len(self.criteria):
            tables.append(
                f"for white noise of the size that is left\n{self.criteria.to_string(float_format=_ONE_DIGIT)}"
            )
        return "\n\n".join(tables)

    def _repr_html_(self) -> str:
        tables = [(self._side_by_side(), _TWO_DIGITS), (self.criteria, _ONE_DIGIT)]
        return "".join(table.to_html(float_format=form) for table, form in tables if len(table))

    def _side_by_side(self) -> "pandas.DataFrame":
        wide = self.scores.pivot(index=["record", "output"], columns="fit", values="fit %")[list(self.fits)]
        return wide.rename_axis(columns=None)

    def plot(self) -> "matplotlib.figure.Figure":
        """Draw what was measured and what each fit simulates, a row for each record and output."""
        from ehsvjax.plots import plot_comparison

        return plot_comparison(self.fits, self.records)


def compare(fits: Any, records: Record | Sequence[Record]) -> Comparison:
    """Compare fits on records, fitted ones or new ones, whose initial conditions are then estimated for each fit.

    Args:
        fits: a mapping from names to fits, or a list of fits, each of which goes by the name of its model, with a
            number where that repeats.
        records: one or several.

    Raises:
        ValueError: for what is no fit, no record, or a record that a fit's model cannot take.

    """
    import pandas as pd

    named = _named(fits)
    measured = checked_records(records)
    titles = _numbered([record.name for record in measured])
    rows = []
    for name, fit in named.items():
        for title, record in zip(titles, measured, strict=True):
            score = fit.score(record)
            used = "fitted" if any(_same(record, one) for one in fit.records) else "predicted"
            rows += [
                {
                    "fit": name,
                    "record": title,
                    "output": output,
                    "fit %": score.fit_percent[output],
                    "rmse": score.rmse[output],
                    "unit": fit.model.unit(output),
                    "used": used,
                }
                for output in record.outputs
            ]
    criteria = pd.DataFrame([_criteria(fit) for fit in named.values()], index=pd.Index(named, name="fit"))
    return Comparison(named, measured, pd.DataFrame(rows), criteria if _of_the_same(named.values()) else criteria[:0])


def _of_the_same(fits: Collection[Fit]) -> bool:
    """Whether fits are of the same records."""
    first = next(iter(fits)).records
    return all(len(f.records) == len(first) and all(map(_same, f.records, first)) for f in fits)


def _same(record: Record, other: Record) -> bool:
    """Whether two records hold the same readings, as those of a fit that was saved and loaded do."""
    return record is other or (
        record.outputs.keys() == other.outputs.keys()
        and np.array_equal(record.time, other.time)
        and all(np.array_equal(y, other.outputs[n], equal_nan=True) for n, y in record.outputs.items())
    )


def _numbered(names: Sequence[str]) -> list[str]:
    """Return names, with a number where one repeats."""
    return [f"{n} #{1 + names[:i].count(n)}" if names[:i].count(n) else n for i, n in enumerate(names)]


def _named(fits: Any) -> dict[str, Fit]:
    if fits == [] or fits == {}:
        raise refused("fits", "one or several", fits, "make each by ehsvjax.identify")
    if isinstance(fits, Mapping):
        several("fits", list(fits.values()), Fit, "make each by ehsvjax.identify")
        return {str(name): fit for name, fit in fits.items()}
    given = several("fits", [fits] if isinstance(fits, Fit) else fits, Fit, "make each by ehsvjax.identify")
    return dict(zip(_numbered([fit.model.name for fit in given]), given, strict=True))


def _criteria(fit: Fit) -> dict[str, float]:
    """Return log likelihood and criteria of a fit under white noise whose variance is what is left of each output."""
    squares = {name: 0.0 for name in fit.outputs}
    counts = dict.fromkeys(fit.outputs, 0)
    for record in fit.records:
        for name, residual in fit.residuals(record).items():
            squares[name] += float(np.nansum(residual**2))
            counts[name] += int(np.isfinite(record.outputs[name]).sum())
    likelihood = sum(-0.5 * n * (np.log(2.0 * np.pi * squares[name] / n) + 1.0) for name, n in counts.items())
    # What was estimated, the variances too.
    unknowns = len(fit.parameters) + len(fit.estimated_initial) * len(fit.records) + len(fit.outputs)
    readings = sum(counts.values())
    return {
        "unknowns": unknowns,
        "readings": readings,
        "log likelihood": float(likelihood),
        "AIC": float(2.0 * unknowns - 2.0 * likelihood),
        "BIC": float(np.log(readings) * unknowns - 2.0 * likelihood),
    }
