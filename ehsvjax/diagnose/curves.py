"""Terms of free form: curves of straight pieces along what runs along a model, and what they do to its outputs.

At a place (a force, an opening, a sensor) a term is added that depends on one quantity (velocity, position, spool,
time, ...). Coefficients of its pieces count in probes, small disturbances at that place.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.diagnose.workbench import Workbench
from ehsvjax.models.model import Model

# Pieces of a curve in the tests; along an output, where a term may repeat over short distances, also this many, if
# there are so many samples for each.
_COARSE, _CLOSE = 8, 96
_SAMPLES_PER_PIECE = 50
# Of the range, between two knots: what rests is told apart by rounding alone.
_LEAST_APART = 1e-4
_PROBE = 1e-3
TIME = "time"


class Curve(NamedTuple):
    """Straight pieces along one quantity at one place: `[piece, time]`, and the knots."""

    place: str
    quantity: str
    knots: Float[np.ndarray, " knot"]
    pieces: Float[np.ndarray, "piece time"]
    relative: bool


def quantities(bench: Workbench) -> dict[str, Float[np.ndarray, " time"]]:
    """Return what runs along the nominal model and varies, each once: the inputs, outputs, signals, their contexts."""
    record_time = np.arange(bench.problem.samples.inputs.shape[1]) * float(bench.problem.samples.sample_period[0])
    inputs = bench.problem.samples.inputs[0]
    found = {TIME: record_time}
    found |= {name: inputs[:, k] for k, name in enumerate(bench.fit.model.inputs)}
    # The outputs first: of two names for one motion that of the sensor is the one that people know.
    found |= {name: bench.internal.values[name] for name in bench.problem.observed if name in bench.internal.values}
    found |= dict(bench.internal.values)
    for context in bench.internal.contexts.values():
        for name, series in context.items():
            found.setdefault(name, series)
    kept: dict[str, np.ndarray] = {}
    for name, series in found.items():
        if not np.all(np.isfinite(series)) or np.ptp(series) <= 1e-9 * (np.max(np.abs(series)) + 1e-300):
            continue
        alike = (abs(np.corrcoef(series, other)[0, 1]) > 0.9999 for other in kept.values())
        if not any(alike):
            kept[name] = series
    return kept


def curves_of_tests(bench: Workbench, seen: Mapping[str, Float[np.ndarray, " time"]]) -> list[Curve]:
    """Return the curves of all tests."""
    coarse = [c for place in (*bench.places, *bench.problem.observed) for c in _curves(bench, place, seen, _COARSE)]
    pieces = min(_CLOSE, bench.problem.samples.outputs.shape[1] // _SAMPLES_PER_PIECE)
    if pieces <= _COARSE:
        return coarse
    outputs = {name: seen[name] for name in bench.problem.observed if name in seen}
    return coarse + [c for place in bench.places for c in _curves(bench, place, outputs, pieces)]


def curve_along(
    bench: Workbench, place: str, quantity: str, seen: Mapping[str, Float[np.ndarray, " time"]], pieces: int
) -> Curve:
    """Return the curve of so many pieces along one quantity at one place."""
    (curve,) = _curves(bench, place, {quantity: seen[quantity]}, pieces)
    return curve


def _curves(bench, place, seen, pieces) -> list[Curve]:
    """Return curves of straight pieces along every quantity at a place."""
    kinds = {s.name: s.kind for s in bench.fit.model.signals}
    relative = kinds[place] == "opening"
    found = []
    for name, series in seen.items():
        knots = knots_along(series, pieces)
        hats = np.stack([np.interp(series, knots, np.eye(len(knots))[k]) for k in range(len(knots))])
        found.append(Curve(place, name, knots, hats, relative))
    return found


def knots_along(series: Float[np.ndarray, " time"], pieces: int) -> Float[np.ndarray, " knot"]:
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
    """Return the size of a small disturbance at a place: a share of its value where it has one."""
    kinds = {s.name: s.kind for s in bench.fit.model.signals}
    if kinds[place] == "opening" or place in bench.problem.observed:
        return _PROBE
    largest = float(np.max(np.abs(bench.internal.values[place])))
    return _PROBE * largest if largest > 0 else _PROBE


def curve_responses(bench: Workbench, point, curves: Sequence[Curve]) -> Float[np.ndarray, "piece record time signal"]:
    """Return what each piece of curves, as large as a probe, does to the outputs."""
    samples = bench.problem.samples
    inside = [c for c in curves if c.place in bench.places]
    added = np.zeros((1 + sum(len(c.pieces) for c in inside), *samples.outputs.shape[:2], len(bench.places)))
    row = 1
    for curve in inside:
        acting = _acting(bench, curve, curve.pieces)
        added[row : row + len(curve.pieces), 0, :, bench.places.index(curve.place)] = acting
        row += len(curve.pieces)
    outputs = bench.simulated(np.repeat(point[None], len(added), axis=0), added) if inside else None
    changes, row = [], 1
    for curve in curves:
        if curve.place in bench.places:
            assert outputs is not None
            changes.append(outputs[row : row + len(curve.pieces)] - outputs[0])
            row += len(curve.pieces)
        else:
            sensed = np.zeros((len(curve.pieces), *samples.outputs.shape))
            sensed[:, 0, :, bench.problem.observed.index(curve.place)] = _acting(bench, curve, curve.pieces)
            changes.append(sensed)
    return np.concatenate(changes)


def outputs_with(bench: Workbench, points, coefficients, curve: Curve):
    """Return the outputs of points with a curve acting at its place."""
    shape = bench.problem.samples.outputs.shape
    acting = _acting(bench, curve, coefficients @ curve.pieces)
    if curve.place not in bench.places:
        outputs = bench.simulated(points)
        outputs[:, 0, :, bench.problem.observed.index(curve.place)] += acting
        return outputs
    added = np.zeros((len(points), *shape[:2], len(bench.places)))
    added[:, 0, :, bench.places.index(curve.place)] = acting
    return bench.simulated(points, added)


def _acting(bench: Workbench, curve: Curve, probes: Float[np.ndarray, "*batch time"]):
    """Return what a curve adds to the value at its place, from its probes along the record."""
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
        units = {"velocity": "m/s", "flow": "m^3/s", "load_force": "N"} | units
    return units.get(name, "")
