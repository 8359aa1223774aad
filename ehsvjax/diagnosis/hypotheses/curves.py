"""Terms of free form: curves along what runs along a model, and what they do to its outputs.

At a place (a force, an opening, a sensor) a term is added that depends on one quantity (velocity, position, spool,
time, ...). It is a sum of pieces, straight ones or waves; their coefficients count in probes, small disturbances at
that place.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, lru_cache, partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.diagnosis.bench.workbench import Workbench
from ehsvjax.effects.effect import length_unit
from ehsvjax.models.model import Model

# Straight pieces of a curve in the tests. Along an output a term may repeat over short distances: there it is also
# looked for as waves, at most so many in the range, if there are so many samples for each.
_COARSE, _WAVES = 8, 24
_SAMPLES_PER_WAVE = 200
# Waves in the range that straight pieces follow, the step to the next wave, and knots over each.
_FOLLOWED, _WAVE_STEP, _KNOTS_PER_WAVE = 2, 0.25, 10
# Of the range, between two knots: what rests is told apart by rounding alone.
_LEAST_APART = 1e-4
_PROBE = 1e-3
TIME = "time"


class Curve(NamedTuple):
    """A term of free form along one quantity at one place.

    Attributes:
        place: signal at which it acts.
        quantity: that it depends on.
        knots: `[knot]` ascending values of the quantity.
        values: `[piece, knot]` each piece there.
        series: `[record, time]` the quantity along the records.
        form: the pieces at any values of the quantity.
        relative: whether it is a share of the value at the place.
        periods: `[wave]` of the waves of which each could be the whole term, in the quantity's unit; none of straight
            pieces.

    """

    place: str
    quantity: str
    knots: Float[np.ndarray, " knot"]
    values: Float[np.ndarray, "piece knot"]
    series: Float[np.ndarray, "record time"]
    form: Callable[[Float[np.ndarray, "..."]], Float[np.ndarray, "piece ..."]]
    relative: bool
    periods: Float[np.ndarray, " wave"]

    @property
    def pieces(self) -> Float[np.ndarray, "piece record time"]:
        """Each piece along the records, made anew: those of all curves of a long record would take much memory."""
        return self.form(self.series)


class Terms(NamedTuple):
    """Curves, and what each of their pieces, one curve after the other, does to the outputs of a point."""

    curves: list[Curve]
    responses: Float[np.ndarray, "piece record time signal"]


def quantities(bench: Workbench) -> dict[str, Float[np.ndarray, "record time"]]:
    """Return what runs along the nominal model and varies, each once: the inputs, outputs, signals, their contexts.

    The time runs on from record to record.
    """
    inputs, present = bench.problem.samples.inputs, bench.present
    before = np.cumsum([0.0, *(present.sum(axis=1) * bench.problem.samples.sample_period)])[:-1]
    found = {TIME: bench.clock + before[:, None]}
    found |= {name: inputs[..., k] for k, name in enumerate(bench.fit.model.inputs)}
    # The outputs first: of two names for one motion that of the sensor is the one that people know.
    found |= {name: bench.internal.values[name] for name in bench.problem.observed if name in bench.internal.values}
    found |= dict(bench.internal.values)
    for context in bench.internal.contexts.values():
        for name, series in context.items():
            found.setdefault(name, series)
    kept: dict[str, np.ndarray] = {}
    for name, series in found.items():
        there = series[present]
        if not np.all(np.isfinite(there)) or np.ptp(there) <= 1e-9 * (np.max(np.abs(there)) + 1e-300):
            continue
        alike = (abs(np.corrcoef(there, other[present])[0, 1]) > 0.9999 for other in kept.values())
        if not any(alike):
            kept[name] = series
    return kept


def terms_at(bench: Workbench, point: Float[np.ndarray, " parameter"], curves: list[Curve]) -> Terms:
    """Return the terms of curves at a point."""
    return Terms(curves, curve_responses(bench, point, curves))


def every_curve(bench: Workbench, seen: Mapping[str, Float[np.ndarray, "record time"]]) -> list[Curve]:
    """Return the curves of all tests, along all quantities at all places."""
    places = (*bench.places, *bench.problem.observed)
    coarse = [straight_along(bench, place, quantity, seen, _COARSE) for place in places for quantity in seen]
    waves = min(_WAVES, int(bench.present.sum()) // _SAMPLES_PER_WAVE)
    if waves <= _FOLLOWED:
        return coarse
    outputs = [name for name in bench.problem.observed if name in seen]
    return coarse + [_waves_along(bench, place, name, seen[name], waves) for place in bench.places for name in outputs]


def straight_along(
    bench: Workbench, place: str, quantity: str, seen: Mapping[str, Float[np.ndarray, "record time"]], pieces: int
) -> Curve:
    """Return the curve of so many straight pieces along a quantity at a place."""
    knots = knots_along(seen[quantity][bench.present], pieces)
    return _curve(bench, place, quantity, knots, seen[quantity], partial(hats, knots), np.zeros(0))


def wave_along(
    bench: Workbench, place: str, quantity: str, seen: Mapping[str, Float[np.ndarray, "record time"]], period: float
) -> Curve:
    """Return the curve that repeats with a period of a quantity, in two phases."""
    there = seen[quantity][bench.present]
    least, size = there.min(), np.ptp(there)
    knots = np.linspace(least, there.max(), int(size / period * _KNOTS_PER_WAVE) + 2)

    def form(along):
        return _phases((along - least) / size, size / period)

    return _curve(bench, place, quantity, knots, seen[quantity], form, np.array([period]))


def _waves_along(bench, place, quantity, series, waves) -> Curve:
    """Return the curve of all waves of which there are at most so many in the range, in steps of half a wave."""
    there = series[bench.present]
    least, size = there.min(), np.ptp(there)
    knots = np.linspace(least, there.max(), waves * _KNOTS_PER_WAVE)

    def form(along):
        return _all_waves((along - least) / size, waves)

    return _curve(bench, place, quantity, knots, series, form, size / _wave_numbers(waves))


def _curve(bench: Workbench, place, quantity, knots, series, form, periods) -> Curve:
    return Curve(place, quantity, knots, form(knots), series, form, _is_opening(bench, place), periods)


def hats(knots: Float[np.ndarray, " knot"], along: Float[np.ndarray, "..."]) -> Float[np.ndarray, "knot ..."]:
    """Return straight pieces at some values: each is one at its own knot and nothing at the others."""
    return np.stack([np.interp(along, knots, value) for value in np.eye(len(knots))])


def _phases(share, number) -> Float[np.ndarray, "phase ..."]:
    return np.stack([np.cos(2.0 * np.pi * number * share), np.sin(2.0 * np.pi * number * share)])


def _all_waves(share, waves) -> Float[np.ndarray, "piece ..."]:
    numbers = np.arange(1, 2 * waves + 1) / 2.0
    return np.concatenate([np.ones((1, *share.shape)), *(_phases(share, number) for number in numbers)])


def waves_in(curve: Curve) -> int:
    """Return how many waves there are in the range at most, of a curve of all waves."""
    return (len(curve.values) - 1) // 4


def _wave_numbers(waves) -> Float[np.ndarray, " wave"]:
    return np.arange(_FOLLOWED + _WAVE_STEP, waves + 0.5 * _WAVE_STEP, _WAVE_STEP)


@cache
def single_waves(waves: int) -> Float[np.ndarray, "wave phase piece"]:
    """Return the coefficients of each single wave in the pieces of a curve of all waves, of which there are so many.

    In steps of a quarter: of a wave that is half a step further from the next, much would be lost.
    """
    share = np.linspace(0.0, 1.0, waves * _KNOTS_PER_WAVE)
    wanted = np.concatenate([_phases(share, number) for number in _wave_numbers(waves)])
    coefficients = np.linalg.lstsq(_all_waves(share, waves).T, wanted.T, rcond=1e-6)[0].T
    return coefficients.reshape(-1, 2, coefficients.shape[1])


def _is_opening(bench: Workbench, place: str) -> bool:
    return any(s.name == place and s.kind == "opening" for s in bench.fit.model.signals)


def knots_along(series: Float[np.ndarray, " sample"], pieces: int) -> Float[np.ndarray, " knot"]:
    """Return ascending knots, at most so many, with as many samples between each two, over the range of a series."""
    quantiles = np.quantile(series, np.linspace(0.0, 1.0, pieces))
    knots = [quantiles[0]]
    for value in quantiles[1:]:
        if value - knots[-1] > _LEAST_APART * (quantiles[-1] - quantiles[0]):
            knots.append(value)
    if len(knots) < 4:
        # Held levels, of which most samples have the same: spread over the range.
        return np.linspace(quantiles[0], quantiles[-1], pieces)
    return np.array([*knots[:-1], quantiles[-1]])


def probe_at(bench: Workbench, place: str) -> float:
    """Return the size of a small disturbance at a place: of its unit, or a share of an opening."""
    if _is_opening(bench, place) or place in bench.problem.observed:
        return _PROBE
    return bench.probes[place]


def curve_responses(bench: Workbench, point, curves: Sequence[Curve]) -> Float[np.ndarray, "piece record time signal"]:
    """Return what each piece of curves, as large as a probe, does to the outputs."""
    rows = [(of, piece) for of, curve in enumerate(curves) for piece in range(len(curve.values))]
    inside = [row for row, (of, _) in enumerate(rows) if curves[of].place in bench.places]

    @lru_cache(maxsize=1)
    def acting(of: int) -> Float[np.ndarray, "piece record time"]:
        return _acting(bench, curves[of], curves[of].pieces)

    def at_its_place(k: int) -> Float[np.ndarray, "record time place"]:
        of, piece = rows[inside[k]]
        added = np.zeros((*bench.present.shape, len(bench.places)))
        added[..., bench.places.index(curves[of].place)] = acting(of)[piece]
        return added

    changes = np.zeros((len(rows), *bench.problem.samples.outputs.shape), np.float32)
    changes[inside] = bench.responses(point, len(inside), at_its_place)
    for row, (of, piece) in enumerate(rows):
        if curves[of].place in bench.problem.observed:
            changes[row, ..., bench.problem.observed.index(curves[of].place)] = acting(of)[piece]
    return changes


def outputs_with(bench: Workbench, points, coefficients, curve: Curve):
    """Return the outputs of points with a curve acting at its place."""
    shape = bench.problem.samples.outputs.shape
    acting = _acting(bench, curve, along_records(curve, coefficients))
    if curve.place not in bench.places:
        outputs = bench.simulated(points)
        outputs[..., bench.problem.observed.index(curve.place)] += acting
        return outputs
    added = np.zeros((len(points), *shape[:2], len(bench.places)))
    added[..., bench.places.index(curve.place)] = acting
    return bench.simulated(points, added)


def bench_with(bench: Workbench, curve: Curve, coefficients: Float[np.ndarray, " piece"]) -> Workbench:
    """Return the workbench with a curve that always acts at its place."""
    acting = _acting(bench, curve, along_records(curve, coefficients))
    if curve.place in bench.places:
        disturbances = bench.disturbances.copy()
        disturbances[..., bench.places.index(curve.place)] += acting
        return replace(bench, disturbances=disturbances)
    # What a sensor adds may as well be taken from its readings.
    samples = bench.problem.samples
    readings = samples.outputs.copy()
    readings[..., bench.problem.observed.index(curve.place)] -= acting
    return replace(bench, problem=replace(bench.problem, samples=samples._replace(outputs=readings)))


def along_records(
    curve: Curve, coefficients: Float[np.ndarray, "*batch piece"]
) -> Float[np.ndarray, "*batch record time"]:
    """Return a curve of these coefficients along the records, in probes."""
    return np.tensordot(coefficients, curve.pieces, 1)


def _acting(bench: Workbench, curve: Curve, probes: Float[np.ndarray, "*batch record time"]):
    """Return what a curve adds to the value at its place, from its probes along the records."""
    size = bench.internal.values[curve.place] if curve.relative else 1.0
    return probe_at(bench, curve.place) * probes * size


def slopes_with(bench: Workbench, point, columns, coefficients, curve: Curve):
    """Return the derivatives of the outputs by unknowns and by a curve's coefficients, while the curve acts."""
    count = 1 + len(columns) + len(coefficients)
    points, curves = np.repeat(point[None], count, axis=0), np.repeat(coefficients[None], count, axis=0)
    unknowns = np.arange(len(columns))
    points[1 + unknowns, columns] += bench.differences[columns]
    curves[1 + len(columns) :] += np.eye(len(coefficients))
    outputs = outputs_with(bench, points, curves, curve)
    by_unknowns, by_coefficients = np.split(outputs[1:], [len(columns)])
    here = np.broadcast_to(outputs[0], by_unknowns.shape)
    return np.concatenate([bench.derivatives(here, by_unknowns, columns), by_coefficients - outputs[0]])


def quantity_unit(model: Model, name: str) -> str:
    """Return the unit of something that runs along a model, a signal or what comes with one."""
    units = {TIME: "s"} | {s.name: s.unit for s in model.signals}
    # A dimensionless model has no units but that of time.
    if model.unit(model.outputs[0]):
        units = {"velocity": f"{length_unit(model)}/s", "flow": "m^3/s", "load_force": "N"} | units
    return units.get(name, "")
