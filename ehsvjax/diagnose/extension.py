"""Refits as ordinary fits: of the nominal model, and of the model with the effects that were found."""

from dataclasses import replace

import numpy as np

from ehsvjax.diagnose.noise import plain_noise
from ehsvjax.diagnose.refits import Refits, padded, refit
from ehsvjax.diagnose.selection import Selection
from ehsvjax.doubts import about_arithmetic
from ehsvjax.effects.effect import UNLIMITED
from ehsvjax.effects.extended import extended
from ehsvjax.fit import Effort, Fit, History, at_bound
from ehsvjax.models.model import Model, Parameter
from ehsvjax.population import to_values
from ehsvjax.record import Record

# Bounds of an effect's number that has none: this many times its value.
_REACH = 10.0


def as_fit(selection: Selection, refits: Refits, included: tuple[int, ...], record: Record) -> Fit:
    """Return a refit as an ordinary fit by least squares, which weights no correlation, as `identify` fits.

    Args:
        selection: what was found.
        refits: one refit.
        included: positions of the effects that it includes; none for the nominal model.
        record: that it was refitted to.

    """
    bench = selection.bench
    refits = _unweighted(selection, refits, included)
    values = dict(zip(bench.column, to_values(bench.problem.coordinates, refits.points[0]), strict=True))
    known = {n: v[0] for n, v in bench.problem.known_initial.items()}
    initial = {p.name: float((values | known)[p.name]) for p in bench.fit.model.initial}
    # In the order of the bank, in which they act one after another at a signal.
    attached = tuple(bench.candidates[i] for i in sorted(included))
    numbers = {}
    for candidate in attached:
        scales = bench.scales[candidate.name]
        for number in candidate.effect.parameters:
            name = candidate.parameter(number.name)
            value = float(values[name])
            lower, upper = number.lower(scales), number.upper(scales)
            reach = _REACH * abs(value) or bench.problem.coordinates.upper[bench.column[name]]
            lower = -reach if lower <= -UNLIMITED else min(lower, value)
            upper = reach if upper >= UNLIMITED else max(upper, value)
            numbers[name] = Parameter(name, name, bench.model.parameter(name).unit, value, lower, upper)
    model = bench.fit.model
    if attached:
        model = extended(model, attached, numbers, len(record) * record.sample_period)
    if bench.problem.substeps > bench.problem.grid.substeps:
        model = replace(model, max_step=record.sample_period / int(bench.problem.substeps))
    parameters = {name: float(values[name]) for name in model.free}
    # Nothing was searched: it was refined from the fit that was diagnosed, by squares, spikes left out.
    effort = Effort(
        population=0,
        generations=0,
        stopped_early=False,
        simulations=0,
        refined=True,
        iterations=0,
        starts=1,
        starts_agreeing=1,
        converged=bool(refits.converged[0]),
        remaining=float("nan"),
        arithmetic=selection.integration.worth,
        step_size=record.sample_period / int(bench.problem.substeps),
        left_out=sum(selection.integration.left_out.values()),
    )
    return replace(
        bench.fit,
        model=model,
        records=(record,),
        parameters=parameters,
        initial=(initial,),
        noise_variance=_variances(selection, refits),
        effort=effort,
        history=History(*(np.zeros(0),) * 4, best={}),
        huber=None,
        warnings=(*about_arithmetic(model, effort), *_at_bounds(model, parameters)),
    )


def _unweighted(selection: Selection, refits: Refits, included: tuple[int, ...]) -> Refits:
    bench = selection.bench
    variances = np.array(list(_variances(selection, refits).values()))
    columns = padded([bench.columns_with(included)], refits.chosen.shape[1])
    return refit(bench, refits.points, columns, plain_noise(variances, bench.problem.samples.measured))


def _variances(selection: Selection, refits: Refits) -> dict[str, float]:
    problem = selection.bench.problem
    return {
        name: float(np.mean(refits.residual[0][..., i][problem.samples.measured[..., i]] ** 2))
        for i, name in enumerate(problem.observed)
    }


def _at_bounds(model: Model, parameters: dict[str, float]) -> tuple[str, ...]:
    found = []
    for name, value in parameters.items():
        p = model.parameter(name)
        for side, bound in (("lower", p.lower), ("upper", p.upper)):
            if abs(value - bound) < 1e-6 * (p.upper - p.lower):
                found.append(at_bound(name, side))
    return tuple(found)
