"""All candidates in a table, and what a record excludes or cannot show."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ehsvjax.diagnosis.decision.search import Selection
from ehsvjax.diagnosis.results.diagnosis import Excluded
from ehsvjax.effects.effect import UNLIMITED

if TYPE_CHECKING:
    import pandas

# Power of a test at the smallest size that is said to have shown: 95%.
_POWER_QUANTILE = 1.6449
# Response of a candidate and of another that are called alike.
_CONFOUNDED = 0.95


class _Row(NamedTuple):
    cause: str
    signal: str
    size: float
    unit: str
    score: float
    p_value: float
    p_corrected: float
    likelihood_gain: float
    smallest_detectable: float
    confounded_with: str
    included: bool


def table_of(selection: Selection) -> "pandas.DataFrame":
    """Return all candidates on the nominal model, those that were included first."""
    import pandas as pd

    bench = selection.bench
    screening = selection.stages[0].screening
    responses = np.array([s.response for s in screening.ranked])
    alike = np.abs(responses @ responses.T) if len(responses) else np.zeros((0, 0))
    detectable = _detectable(selection)
    gains = {i: need.gain for i, need in zip(selection.included, selection.needs, strict=True)}
    rows = []
    for k, s in enumerate(screening.ranked):
        candidate = bench.candidates[s.candidate]
        number, column = bench.unknowns_of(candidate)[0]
        included = s.candidate in gains
        others = dict.fromkeys(
            bench.candidates[o.candidate].name
            for j, o in enumerate(screening.ranked) if j != k and alike[k, j] > _CONFOUNDED
        )  # fmt: skip
        rows.append(
            _Row(
                candidate.name,
                candidate.signal,
                bench.value(selection.final.points[0], column) if included else s.amount,
                bench.model.parameter(candidate.parameter(number.name)).unit,
                s.score,
                s.p_value,
                s.corrected,
                gains.get(s.candidate, s.score**2),
                detectable.get(s.candidate, float("nan")),
                ", ".join(n for n in others if n != candidate.name),
                included,
            )
        )
    rows.sort(key=lambda row: (not row.included, row.p_value, -abs(row.score)))
    table = pd.DataFrame(rows, columns=list(_Row._fields))
    unseen = [bench.candidates[i] for i in screening.unseen]
    blank = [
        _Row(c.name, c.signal, np.nan, bench.model.parameter(c.parameter(c.effect.parameters[0].name)).unit, np.nan,
             np.nan, 1.0, 0.0, np.inf, "the parameters", False)
        for c in unseen
    ]  # fmt: skip
    return pd.concat([table, pd.DataFrame(blank, columns=list(_Row._fields))], ignore_index=True) if blank else table


def _detectable(selection: Selection) -> dict[int, float]:
    """Return the smallest size of each candidate, in its first number's unit, that would have been found in 95%."""
    found = {}
    # The last look comes last: at a cause the one before it was added.
    for stage in selection.stages:
        for s in stage.screening.ranked:
            needed = np.sqrt(stage.required_gain(s.candidate)) + _POWER_QUANTILE
            found[s.candidate] = _least_size(s.shown, s.proportional, float(needed))
    for i in selection.stages[-1].screening.unseen:
        found.pop(i, None)
    return {i: size for i, size in found.items() if np.isfinite(size)}


def _least_size(shown: Sequence[tuple[float, float]], proportional: bool, needed: float) -> float:
    """Return the size that moves the record by so many deviations of the noise; +inf if none that was tried does."""
    if proportional:
        # Of several shapes the one that shows best.
        return min((size * needed / deviations for size, deviations in shown if deviations > 0), default=float("inf"))
    # Not proportional: between sizes that were tried, on logarithmic scales; nothing is claimed below the least.
    before = None
    for size, deviations in shown:
        if deviations >= needed:
            if before is None or before[1] <= 0:
                return size
            share = np.log(needed / before[1]) / np.log(deviations / before[1])
            return float(before[0] * (size / before[0]) ** share)
        before = (size, deviations)
    return float("inf")


def excluded_by(selection: Selection, causes: tuple[str, ...]) -> tuple[Excluded, ...]:
    """Return the effects that a record excludes above a size, those that are its causes aside."""
    bench = selection.bench
    least: dict[str, Excluded] = {}
    for i, above in _detectable(selection).items():
        candidate = bench.candidates[i]
        number = candidate.effect.parameters[0]
        # A size beyond what makes sense is not excluded, it is not seen.
        if candidate.name in causes or above > number.upper(bench.scales[candidate.name]):
            continue
        unit = bench.model.parameter(candidate.parameter(number.name)).unit
        if candidate.name not in least or above < least[candidate.name].above:
            least[candidate.name] = Excluded(candidate.name, float(above), unit)
    return tuple(sorted(least.values(), key=lambda e: [c.name for c in bench.candidates].index(e.cause)))


def unseen_by(selection: Selection, causes: tuple[str, ...]) -> tuple[str, ...]:
    """Return the effects that a record can't show whatever their size, those that are its causes aside."""
    bench = selection.bench
    known = {e.cause for e in excluded_by(selection, causes)} | set(causes)
    limits = {c.name for c in bench.candidates if any(p.absent == UNLIMITED for p in c.effect.parameters)}
    seen = {bench.candidates[s.candidate].name for s in selection.stages[-1].screening.ranked} & limits
    names = dict.fromkeys(c.name for c in bench.candidates)
    return tuple(name for name in names if name not in known | seen)
