"""The causes as a person sees them: how sure, how large, what share of the misfit, in which records; what is left."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.diagnosis.bench.evidence import INSEPARABLE
from ehsvjax.diagnosis.decision.search import Selection
from ehsvjax.diagnosis.decision.verdict import PROCESS_NOISE, Verdict
from ehsvjax.diagnosis.hypotheses.process_noise import ProcessNoise
from ehsvjax.fit import Fit


class Size(NamedTuple):
    """One number of a cause.

    Attributes:
        number: its name, `coefficient`.
        value: in `unit`.
        standard_error: in `unit`, by what is left of the records; NaN where nothing tells.
        unit: SI.
        record: the record of which it is, where each has its own; else None.
        bound: "lower" or "upper", where that end of what makes sense holds it: it would be less, or more, or something
            else stands behind it; else None.

    """

    number: str
    value: float
    standard_error: float
    unit: str
    record: str | None = None
    bound: str | None = None


class Cause(NamedTuple):
    """What is missing in a model, and how sure that is.

    Attributes:
        name: of the effect.
        signal: of the model, at which it acts.
        sizes: its numbers.
        probability: that it is there, against all that could be there instead, and against nothing.
        share: of the misfit on data that were not used, how much comes back without it; NaN where there is none.
        gain: variances of what is left by which the records are explained worse without it.
        records: names of those that are.
        contradicted_by: names of records that are explained better without it.
        of_run: whether each record has its own: a property of these runs, absent in any other.

    """

    name: str
    signal: str
    sizes: tuple[Size, ...]
    probability: float
    share: float
    gain: float
    records: tuple[str, ...]
    contradicted_by: tuple[str, ...]
    of_run: bool


def causes_of(selection: Selection, verdict: Verdict, chance: ProcessNoise | None, extended: Fit) -> tuple[Cause, ...]:
    """Return the causes of a verdict, in its order.

    Args:
        selection: what the search came to.
        verdict: what is said.
        chance: the random force, if it is the cause.
        extended: the fit of the model with the causes.

    """
    errors = _standard_errors(selection) if selection.included else {}
    return tuple(
        _unmodelled(selection, name, group[name], chance) if position is None
        else _cause(selection, position, name, group[name], extended, errors)
        for group, position in zip(verdict.groups, verdict.included, strict=True)
        for name in [next(iter(group))]
    )  # fmt: skip


def _cause(selection: Selection, position: int, name: str, probability: float, extended: Fit, errors) -> Cause:
    bench, k = selection.bench, selection.included.index(position)
    candidate, need = bench.candidates[position], selection.needs[k]
    said = [record.name for record in bench.records]
    return Cause(
        name=name,
        signal=candidate.signal,
        sizes=_sizes(selection, position, extended, errors),
        probability=probability,
        share=_share(selection, k),
        gain=need.gain,
        records=tuple(n for n, gain in zip(said, need.of_record, strict=True) if gain > INSEPARABLE),
        contradicted_by=tuple(n for n, gain in zip(said, need.of_record, strict=True) if gain < -INSEPARABLE),
        of_run=candidate.effect.of_run,
    )


def _unmodelled(selection: Selection, name: str, probability: float, chance: ProcessNoise | None) -> Cause:
    """Return a cause that no model simulates: chance, or the steps of a sensor."""
    bench, nothing = selection.bench, float("nan")
    records = tuple(record.name for record in bench.records)
    if name == PROCESS_NOISE:
        assert chance is not None
        unit = bench.fit.model.unit(chance.place)
        size = Size("spectral_density", chance.intensity, nothing, f"({unit})^2 s" if unit else "s")
        return Cause(name, chance.place, (size,), probability, nothing, chance.likelihood - chance.of_sensor, records,
                     (), True)  # fmt: skip
    output = name.partition("@")[2] or bench.problem.observed[0]
    return Cause(name, output, (), probability, nothing, nothing, records, (), False)


def _share(selection: Selection, k: int) -> float:
    """Return the share of what can be removed of unused data that comes back without a cause."""
    noise, residual = selection.unused.noise, selection.unused.residual
    with_all, without, without_any = (float(np.sum(noise.scaled(residual[i]) ** 2)) for i in (0, 1 + k, -1))
    removable = without_any - float(noise.measured.sum())
    return (without - with_all) / removable if removable > 0.0 and np.isfinite(without) else float("nan")


def _sizes(selection: Selection, position: int, extended: Fit, errors: Mapping[int, float]) -> tuple[Size, ...]:
    bench, found = selection.bench, []
    candidate, point = bench.candidates[position], selection.final.points[0]
    for number, column in bench.unknowns_of(candidate):
        name, named = candidate.parameter(number.name), bench.problem.names[column]
        ends = zip(("lower", "upper"), bench.bounds, strict=True)
        bound = next((side for side, end in ends if point[column] == end[column]), None)
        record = int(named.rpartition("[")[2].rstrip("]")) if named != name else None
        value = extended.parameters[name] if record is None else extended.records[record].constants[name]
        found.append(
            Size(number.name, value, errors.get(column, float("nan")), extended.model.parameter(name).unit,
                 None if record is None else bench.records[record].name, bound)
        )  # fmt: skip
    return tuple(found)


def _standard_errors(selection: Selection) -> dict[int, float]:
    """Return the standard error of each unknown by its column, of an effect's number in SI, by what is left.

    What a reading moves an unknown by, to first order, is a direction of readings; the variance of what is left along
    it is that in which explanations are compared.
    """
    noise, final = selection.noise, selection.final
    columns = final.chosen[0][final.chosen[0] >= 0]
    jacobian = noise.scaled(final.slopes[0][: len(columns)])
    left = noise.scaled(final.residual[0])
    found = {}
    for column, influence in zip(columns.tolist(), _influences(jacobian), strict=True):
        if influence.any():
            variance = float(influence @ influence) * noise.left_along(influence, left)[0]
            found[column] = float(np.sqrt(variance)) * selection.bench.value_by_coordinate(final.points[0], column)
    return found


def _influences(jacobian: Float[np.ndarray, "unknown sample"]) -> Float[np.ndarray, "unknown sample"]:
    """Return what a unit of each reading moves each unknown by; nothing for one that the readings do not show."""
    norms = np.linalg.norm(jacobian, axis=1)
    seen = norms > 0.0
    influences = np.zeros_like(jacobian)
    influences[seen] = np.linalg.pinv(jacobian[seen] / norms[seen, None]).T / norms[seen, None]
    return influences


class Left(NamedTuple):
    """What no cause explains.

    Attributes:
        share: of the removable squared error of data that were not used, output -> what is still there.
        by_record: the same of each record in turn.
        innocent: whether it depends on nothing: then it is taken for noise.
        place, quantity: where it shows most, and along what it differs; None where it is innocent.
        p_value: of that, all tests together.

    """

    share: dict[str, float]
    by_record: tuple[dict[str, float], ...]
    innocent: bool
    place: str | None
    quantity: str | None
    p_value: float


def how_sure(probability: float) -> str:
    """Return a probability in a word."""
    if probability >= 0.99:
        return "certain"
    return f"{100 * probability:.0f}%"
