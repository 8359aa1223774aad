"""How a workbench is set up: which effects are tried at which signals, between which bounds, with which steps."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ehsvjax.diagnosis.bench.workbench import ROUNDING, Workbench, duration_of
from ehsvjax.doubts import NO_CHANGE
from ehsvjax.effects.effect import PROBED, Candidate, Effect, EffectParameter, Scales, candidates, input_named
from ehsvjax.effects.extended import disturbance, extended
from ehsvjax.effects.internal import Internal, internal_signals, side_by_side
from ehsvjax.effects.of_model import differences_for, effects_for
from ehsvjax.fit import Fit, at_bounds
from ehsvjax.models.model import Model, Parameter
from ehsvjax.population import observed_outputs
from ehsvjax.record import Record
from ehsvjax.simulate import simulate
from ehsvjax.unknowns import problem_of

# Kinds of signals at which a missing term is looked for.
_PLACES = ("force", "load", "opening", "supply", "damping", "displacement")
# Of coordinates, for derivatives. An effect's size may count so little in its own that rounding would drown it.
_DIFFERENCE, _DIFFERENCE_OF_SIZE = 1e-6, 1e-3
# Share of what runs along a signal that is tried first.
_PROBE = 1e-3


def workbench(fit: Fit, records: Sequence[Record], bank: Sequence[Effect]) -> Workbench:
    """Set up the trials of a fit on records.

    Args:
        fit: of the nominal model.
        records: to diagnose it on.
        bank: the candidate effects.

    """
    initial = [fit.initial_of(record) for record in records]
    internal = side_by_side(
        [internal_signals(fit.model, r, fit.parameters, start) for r, start in zip(records, initial, strict=True)]
    )
    idle = _idle(fit, records, initial)
    # How much a force moves depends on the machine: on a larger one a probe of any fixed size is lost in rounding.
    probes = _calibrated(_bench(fit, records, initial, internal, bank, idle, {}))
    return _bench(fit, records, initial, internal, bank, idle, probes)


def _idle(fit: Fit, records: Sequence[Record], initial: Sequence[Mapping[str, float]]) -> list[str]:
    """Return the free parameters that change nothing between their bounds: something beyond them may."""

    def outputs(**changed) -> Iterator[Float[np.ndarray, " time"]]:
        for record, start in zip(records, initial, strict=True):
            simulated = simulate(fit.model, record, fit.parameters | changed, start)
            yield from (simulated[name] / fit.noise_variance[name] ** 0.5 for name in fit.outputs)

    def changes(name: str, value: float) -> bool:
        moved = zip(outputs(**{name: value}), here, strict=True)
        return not sum(float(np.sum((there - then) ** 2)) for there, then in moved) < NO_CHANGE

    here = list(outputs())
    ends = {name: (fit.model.parameter(name).lower, fit.model.parameter(name).upper) for name in fit.model.free}
    return [name for name, values in ends.items() if fit.parameters[name] and not any(changes(name, v) for v in values)]


def _calibrated(bench: Workbench) -> dict[str, float]:
    """Return for each place the disturbance that, held, moves some output by `PROBED` of its size.

    What is moved at once and stays there is moved too: of a stiff drive a force moves nothing else.
    """
    points = np.repeat(bench.nominal[None], 1 + len(bench.places), axis=0)
    added = np.zeros((len(points), *bench.disturbances.shape))
    for k, place in enumerate(bench.places):
        added[1 + k, ..., k] = bench.probes[place]
    outputs = bench.simulated(points, added)
    size = np.maximum(np.std(outputs[0], axis=(0, 1)), 1e-300)
    moved = np.max(np.sqrt(np.mean((outputs[1:] - outputs[0]) ** 2, axis=(1, 2))) / size, axis=1)
    return {
        place: bench.probes[place] * (PROBED / by if np.isfinite(by) and by > ROUNDING else 1.0)
        for place, by in zip(bench.places, moved, strict=True)
    }


def _bench(
    fit: Fit,
    records: Sequence[Record],
    initial: Sequence[Mapping[str, float]],
    internal: Internal,
    bank: Sequence[Effect],
    idle: Sequence[str],
    probes: Mapping[str, float],
) -> Workbench:
    """Return the bench before its step is settled, with the probes that are known."""
    model = fit.model
    observed = observed_outputs(model, records)
    # A single record differs from none.
    held = [name for name, _ in at_bounds(model, fit.parameters) if fit.parameters[name] and name not in idle]
    own = (*effects_for(model, held, idle), *(differences_for(model) if len(records) > 1 else ()))
    found = candidates(model, (*bank, *own), internal.contexts, observed)
    places = tuple(s.name for s in model.signals if s.kind in _PLACES and s.name in internal.values)
    probes = {place: _probe(internal.values[place]) for place in places} | dict(probes)
    forces = [s.name for s in model.signals if s.kind in ("force", "load") and s.name in places]
    scales = {c.name: _scales(model, c, internal, records, probes, forces) for c in found}
    duration = duration_of(records)
    numbers = {c.parameter(p.name): _free(c, p, model, scales[c.name]) for c in found for p in c.effect.parameters}
    full = extended(model, found, numbers, duration, places, switched=True)
    quiet = [{disturbance(place): np.zeros(len(record)) for place in places} for record in records]
    of_run = [
        c.parameter(p.name) for c in found if c.effect.of_run for p in c.effect.parameters if p.absent is not None
    ]
    problem = problem_of(
        full,
        [replace(record, inputs={**record.inputs, **nothing}) for record, nothing in zip(records, quiet, strict=True)],
        initial=[{n: v for n, v in start.items() if n not in fit.estimated_initial} for start in initial],
        noise_variance={n: fit.noise_variance[n] for n in observed},
        # A single record has nothing for itself that it does not share.
        by_record=of_run if len(records) > 1 else (),
    )
    column = {name: j for j, name in enumerate(problem.names)}
    coordinates = problem.coordinates
    nominal, differences = np.zeros(len(column)), np.full(len(column), _DIFFERENCE)
    bench = Workbench(fit, tuple(records), full, problem, found, scales, internal, places, probes,
                      np.zeros((*problem.samples.inputs.shape[:2], len(places))), column, nominal, differences,
                      int(problem.substeps))  # fmt: skip
    for c in found:
        for p, j in bench.unknowns_of(c):
            tried = p.tries(scales[c.name])
            unit = max((abs(t) for t in tried), default=1.0) or 1.0
            coordinates.lower[j], coordinates.upper[j] = 0.0, unit
            coordinates.logarithmic[j], coordinates.offset[j] = p.relative, float(p.relative)
            first = tried[0] if len(tried) else unit
            nominal[j] = bench.coordinate(first if p.absent is None else p.absent, j)
            if p.absent is not None:
                differences[j] = _DIFFERENCE_OF_SIZE
    values = fit.parameters | {f"{n}[{k}]": value for k, start in enumerate(initial) for n, value in start.items()}
    names = problem.names
    for j in bench.base_columns:
        nominal[j] = np.clip(bench.coordinate(values[names[j]], j), 0.0, 1.0)
    return bench


def _probe(values: Float[np.ndarray, "record time"]) -> float:
    """Return a small part of what runs along a signal, or a small number where nothing does."""
    largest = float(np.max(np.abs(values)))
    return _PROBE * largest if 0.0 < largest < np.inf else _PROBE


def _scales(
    model: Model,
    candidate: Candidate,
    internal: Internal,
    records: Sequence[Record],
    probes: Mapping[str, float],
    forces: Sequence[str],
) -> Scales:
    def largest(series):
        return float(np.max(np.abs(series))) if np.all(np.isfinite(series)) else 0.0

    signal = candidate.signal
    inputs = {name: np.concatenate([record.inputs[name] for record in records]) for name in model.inputs}
    value = inputs.get(signal, internal.values.get(signal, np.ones(1)))
    least = 0.0
    if candidate.effect.kind == "constant":
        # Of a constant, how large it can be.
        bounds = model.parameter(signal)
        value, least = np.array([bounds.lower, bounds.upper]), bounds.lower
    context = {input_named(name): largest(series) for name, series in inputs.items()}
    for name, series in internal.contexts.get(signal, {}).items():
        context[name] = largest(series)
        context |= {f"{name}{sign}": largest(np.maximum(side * series, 0.0)) for sign, side in (("+", 1), ("-", -1))}
    return {
        **context,
        "value": largest(value),
        "least": least,
        "probe": next((probes[place] for place in (signal, *forces) if place in probes), _PROBE),
        "duration": duration_of(records),
        "sample_period": min(record.sample_period for record in records),
        # Where the search begins; it goes where a residual leads it.
        "frequencies": (2.0 * np.pi / duration_of(records),),
    }


def _free(candidate: Candidate, number: EffectParameter, model: Model, scales: Scales) -> Parameter:
    """Return an effect's number as a free parameter, between the bounds that make sense at all."""
    unit = candidate.unit(number, model)
    lower, upper = number.lower(scales), number.upper(scales)
    value = min(max(0.0, lower), upper)
    name = candidate.parameter(number.name)
    return Parameter(name, name, unit, value, lower, max(upper, lower + 1e-300))
