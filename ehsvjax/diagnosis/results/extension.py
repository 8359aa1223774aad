"""Refits as ordinary fits: of the nominal model, and of the model with the effects that were found."""

from dataclasses import replace

import numpy as np

from ehsvjax.diagnosis.bench.noise import plain_noise
from ehsvjax.diagnosis.bench.refits import Refits, padded, refit
from ehsvjax.diagnosis.bench.workbench import duration_of
from ehsvjax.diagnosis.decision.search import Selection
from ehsvjax.doubts import about_arithmetic
from ehsvjax.effects.extended import extended
from ehsvjax.fit import Effort, Fit, History, at_bound, at_bounds
from ehsvjax.models.model import Parameter
from ehsvjax.population import to_values

# Bounds of an effect's number, where what makes sense goes on beyond them: this many times its value.
_REACH = 10.0


def as_fit(selection: Selection, refits: Refits, included: tuple[int, ...]) -> Fit:
    """Return a refit as an ordinary fit by least squares, which weights no correlation, as `identify` fits.

    What an effect of the run does in each of several records is known of that record, and absent in any other.

    Args:
        selection: what was found.
        refits: one refit.
        included: positions of the effects that it includes; none for the nominal model.

    """
    bench = selection.bench
    records, names = bench.records, bench.problem.names
    refits = _unweighted(selection, refits, included)
    values = dict(zip(names, to_values(bench.problem.coordinates, refits.points[0]), strict=True))
    values |= {f"{n}[{k}]": v for n, known in bench.problem.known_initial.items() for k, v in enumerate(known)}
    initial = [{p.name: float(values[f"{p.name}[{k}]"]) for p in bench.fit.model.initial} for k in range(len(records))]
    # In the order of the bank, in which they act one after another at a signal.
    attached = tuple(bench.candidates[i] for i in sorted(included))
    numbers: dict[str, Parameter] = {}
    of_run: list[dict[str, float]] = [{} for _ in records]
    for candidate in attached:
        scales = bench.scales[candidate.name]
        for number, column in bench.unknowns_of(candidate):
            name, named = candidate.parameter(number.name), names[column]
            value = float(values[named])
            reach = _REACH * abs(value) or bench.problem.coordinates.upper[column]
            lower = min(max(number.lower(scales), -reach), value)
            upper = max(min(number.upper(scales), reach), value)
            numbers[name] = Parameter(name, name, bench.model.parameter(name).unit, value, lower, upper)
            if named != name:
                assert number.absent is not None
                numbers[name] = numbers[name]._replace(value=number.absent, fixed=True)
                next(own for own in of_run if name not in own)[name] = value
    model = bench.fit.model
    if attached:
        # What stands for a parameter beyond its bound is a share of it.
        beyond = {c.signal for c in attached if c.effect.kind == "constant" and not c.effect.by_record}
        given = model.with_bounds(fixed={name: values[name] for name in model.free if name in beyond})
        model = extended(given, attached, numbers, duration_of(records))
    step_size = min(record.sample_period for record in records) / int(bench.problem.substeps)
    if bench.problem.substeps > bench.problem.grid.substeps:
        model = replace(model, max_step=step_size)
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
        step_size=step_size,
        left_out=sum(selection.integration.left_out.values()),
    )
    return replace(
        bench.fit,
        model=model,
        records=tuple(record.at(**own) if own else record for record, own in zip(records, of_run, strict=True)),
        parameters=parameters,
        initial=tuple(initial),
        noise_variance=_variances(selection, refits),
        effort=effort,
        history=History(*(np.zeros(0),) * 4, best={}),
        huber=None,
        warnings=(*about_arithmetic(model, effort), *(at_bound(*held) for held in at_bounds(model, parameters))),
    )


def _unweighted(selection: Selection, refits: Refits, included: tuple[int, ...]) -> Refits:
    bench = selection.bench
    variances = np.array(list(_variances(selection, refits).values()))
    columns = padded([bench.columns_with(included)])
    return refit(bench, refits.points, columns, plain_noise(variances, bench.problem.samples.measured))


def _variances(selection: Selection, refits: Refits) -> dict[str, float]:
    problem = selection.bench.problem
    return {
        name: float(np.mean(refits.residual[0][..., i][problem.samples.measured[..., i]] ** 2))
        for i, name in enumerate(problem.observed)
    }
