"""Fits that explain nothing, and what is likely behind it: signs, units, offsets, an unknown without effect.

A simulation that fails is refused (`failure`): there is no fit. A model that explains nothing is a result with a
warning, as it may be what the record says; only what was tried and would explain it is named.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ehsvjax.arithmetic import outputs_of
from ehsvjax.fit import EXPLAINS_NOTHING, Effort, Fit, at_bound
from ehsvjax.models.model import Model
from ehsvjax.population import Problem
from ehsvjax.record import Record
from ehsvjax.simulate import grid_of, simulate
from ehsvjax.unknowns import guess_noise_variance

# Share of an output's variance below which a model explains nothing of it, and from which a change would explain it.
_NOTHING, _MOST = 0.1, 0.5
# Share by which another sign or unit has to explain more than what was given, before any fit.
_BETTER = 0.3
# Residuals of at most this many variances of white noise leave nothing to explain.
_NOISE = 2.0
# Integration steps between two samples over which what a model does is long over.
_STEPS = 1000
# Noise variances that the integration may be worth before a comparison of two fits rests on it.
_ONE_READING = 1.0
NO_CHANGE = 1e-6
"""Changes of the sum of squares, in noise variances, that are none."""
# Of columns: decades, and inches.
_UNITS = (1e-4, 1e-3, 1e-2, 1e-1, 1e1, 1e2, 1e3, 1e4, 0.0254, 1.0 / 0.0254, 25.4, 1.0 / 25.4)
# Slope of readings over simulated ones from which on their unit is another.
_OTHER_UNIT = 1.5
_NORMAL_MEDIAN = 0.6744897501960817


def about_steps(model: Model, records: Sequence[Record]) -> tuple[str, ...]:
    """Doubt records whose samples lie a thousand and more integration steps apart: milliseconds taken for seconds."""
    return tuple(
        f"{record.name} has a sample every {record.sample_period:.4g} s, {substeps} integration steps of "
        f"{model.name} (max_step {model.max_step:.4g} s), which is slow and seldom meant: is its time in ms? Then use "
        "time=Column(..., scale=1e-3), else a larger max_step"
        for record in records
        if (substeps := grid_of(model, record).substeps) > _STEPS
    )


def about_record(model: Model, record: Record, name: str) -> tuple[float, str]:
    """Return how well a model can mean an output before any fit, and what would let it mean more, "" if nothing does.

    With nominal values: the share of the output's variance that a straight line of the simulated one explains, which
    bears with a gain and an offset but not with another sign, another unit of time or of an input.
    """
    nominal = _nominal(model)
    share, slope, _ = _straight(model, record, name, *nominal)
    share = share if slope > 0 else 0.0
    best = _best(trial for trial in _trials(model, record, name, *nominal) if trial.mistaken)
    better = best.share > max(_MOST, share + _BETTER)
    return share, f"{best.words} would explain {best.share:.0%}" if better else ""


def about_fit(
    fit: Fit,
    problem: Problem,
    individual: Float[np.ndarray, " parameter"],
    residual_variance: Float[np.ndarray, " signal"],
    idle: Bool[np.ndarray, " parameter"],
) -> tuple[str, ...]:
    """Return what a user should know before trusting the numbers of a fit, each with what to do, the gravest first.

    Args:
        fit: whose own warnings are to be found.
        problem: that was solved.
        individual: the solution, in the unit cube.
        residual_variance: of each observed output, unit squared.
        idle: which unknowns change nothing near the solution.

    """
    return (
        *_about_outputs(fit, dict(zip(problem.observed, residual_variance.tolist(), strict=True))),
        *about_arithmetic(fit.model, fit.effort),
        *_about_unknowns(fit.model, problem, individual, idle),
        *_about_search(fit.model, problem, individual, fit.effort),
    )


def about_arithmetic(model: Model, effort: Effort) -> tuple[str, ...]:
    """Doubt a fit of which the integration's own error is worth more than the noise of one reading."""
    if effort.arithmetic is None or effort.arithmetic <= _ONE_READING:
        return ()
    finite = np.isfinite(effort.arithmetic)
    worth = f"{effort.arithmetic:.2g} noise variances" if finite else "more than can be said"
    return (
        f"the integration of {model.name} is off by {worth}, at steps of {effort.step_size:.3g} s: use a smaller "
        "max_step, dataclasses.replace(model, max_step=...), or a method for stiff equations",
    )


def _about_outputs(fit: Fit, residual_variance: Mapping[str, float]) -> tuple[str, ...]:
    """Doubt a fit of whose outputs the model explains next to nothing, more than noise being there to explain."""
    found = []
    for name, left in residual_variance.items():
        holding = [(r, start) for r, start in zip(fit.records, fit.initial, strict=True) if name in r.outputs]
        readings = [record.outputs[name] for record, _ in holding]
        share = 1.0 - left / _variance(readings, robust=fit.huber is not None)
        noise = float(np.mean([guess_noise_variance(y) for y in readings]))
        if share < _NOTHING and (left > _NOISE * noise or share < -_NOTHING):
            record, start = max(holding, key=lambda pair: np.nanvar(pair[0].outputs[name]))
            found.append(
                f"{EXPLAINS_NOTHING} {name}: {_fit(share)}, where its mean alone has 0 %; "
                + _what_would(fit.model, record, name, fit.parameters, start)
            )
    return tuple(found)


def _about_unknowns(
    model: Model,
    problem: Problem,
    individual: Float[np.ndarray, " parameter"],
    suspected: Bool[np.ndarray, " parameter"],
) -> tuple[str, ...]:
    """Doubt suspected parameters whose whole range, the others held, changes no output."""
    found = []
    for i, name in enumerate(problem.free):
        if suspected[i]:
            rows = [np.where(np.arange(len(individual)) == i, place, individual) for place in (0.0, 0.5, 1.0)]
            least, *others = (residuals_at(problem, row) for row in rows)
            if all(np.sum((other - least) ** 2) < NO_CHANGE for other in others):
                lower, upper, unit = (
                    problem.coordinates.lower[i],
                    problem.coordinates.upper[i],
                    model.parameter(name).unit,
                )
                found.append(
                    f"{name} changes nothing over all its bounds, {lower:.4g} .. {upper:.4g} {unit}".rstrip()
                    + ": no output depends on it here; fix it, or use a record that excites what it does"
                )
    return tuple(found)


def _about_search(model: Model, problem: Problem, individual, effort: Effort) -> tuple[str, ...]:
    """Doubt what search and refinement left at a bound, unconverged or found once only."""
    found = []
    names = [*problem.free, *(n for _ in range(len(problem.samples.inputs)) for n in problem.free_initial)]
    for name, place in zip(names, individual, strict=True):
        if min(place, 1.0 - place) < 1e-6:
            side = "lower" if place < 0.5 else "upper"
            shown = name in problem.free or model.parameter(name).output in problem.observed
            what = "" if shown else " (an initial condition, which this record may hardly show)"
            found.append(at_bound(name, side, what))
    if not effort.refined:
        found.append("not refined: the parameters are as good as the search left them; use refine=True")
    elif not effort.converged:
        found.append(
            "the refinement has not converged: a further step would lower the sum of squares by "
            f"{effort.remaining:.2g} noise variances; perhaps the record does not fix every parameter"
        )
    if effort.refined and effort.starts > 1 and effort.starts_agreeing == 1:
        found.append(
            f"only one of {effort.starts} starts led to this minimum, there may be a better one: use a larger "
            "population or more generations"
        )
    return tuple(found)


def residuals_at(
    problem: Problem, individual: Float[np.ndarray, " parameter"]
) -> Float[np.ndarray, "record time signal"]:
    """Return the standardised residuals of one individual of the unit cube, in float64; zero where nothing counts."""
    samples = problem.samples
    off = (samples.outputs - outputs_of(problem, individual)) / np.sqrt(problem.noise_variance)
    return np.where(samples.measured, off, 0.0)


def _variance(readings: Sequence[Float[np.ndarray, " _"]], robust: bool) -> float:
    """Return the variance of readings about their mean in each record, or by their median distance from the median."""
    if robust:
        about = np.concatenate([np.abs(y - np.nanmedian(y)) for y in readings])
        return float(np.nanmedian(about) / _NORMAL_MEDIAN) ** 2
    return float(np.nanmean(np.concatenate([y - np.nanmean(y) for y in readings]) ** 2))


def _fit(share: float) -> str:
    percent = 100.0 * (1.0 - max(1.0 - share, 0.0) ** 0.5)
    return "fit below -1000 %" if percent < -1000.0 else f"fit {percent:.{0 if abs(percent) >= 10.0 else 2}f} %"


class _Trial(NamedTuple):
    """What would explain an output, in words, the share of its variance that it would, and whose column is mistaken.

    An output's size and zero are no mistakes: its sensor may have them.
    """

    share: float
    words: str
    mistaken: Literal["inputs", "output", ""] = "inputs"


def mistaken_columns(fit: Fit, record: Record, simulated: Mapping[str, Float[np.ndarray, " time"]]) -> str:
    """Return which mistake in a record's columns would explain what the fit does not, "" if there is none.

    Where an output is explained the inputs are as they should be, and another can be mistaken in its own column only.

    Args:
        fit: of the model.
        record: with outputs that were fitted.
        simulated: name -> what the fit makes of them.

    """
    unexplained = []
    for name, readings in record.outputs.items():
        kept = np.isfinite(readings)
        left = np.mean((readings - simulated[name])[kept] ** 2)
        if not left < (1.0 - _NOTHING) * np.var(readings[kept]):
            unexplained.append(name)
    able = ("inputs", "output") if len(unexplained) == len(record.outputs) else ("output",)
    for name in unexplained:
        best = _best_of_fit(fit.model, record, name, fit.parameters, fit.initial_of(record))
        if best.share > _MOST and best.mistaken in able:
            return f"the fit explains nothing of {name}, and {best.words} would give {_fit(best.share)}"
    return ""


def _what_would(model: Model, record: Record, name: str, parameters, start) -> str:
    best = _best_of_fit(model, record, name, parameters, start)
    if best.share > _MOST:
        return f"{best.words} would give {_fit(best.share)}"
    return (
        f"no other sign, unit or offset alone explains it: look at the columns of {name} and "
        f"{', '.join(model.inputs)}, at constants and at bounds"
    )


def _best_of_fit(model: Model, record: Record, name: str, parameters, start) -> _Trial:
    """Return the single change that explains most of an output, with the fitted or with the nominal values."""
    values = (parameters, start), _nominal(model)
    return _best(trial for some in values for trial in _trials(model, record, name, *some))


def _best(trials: Iterable[_Trial]) -> _Trial:
    return max(trials, key=lambda trial: round(trial.share, 2), default=_Trial(0.0, ""))


def _nominal(model: Model) -> tuple[Mapping[str, float], Mapping[str, float]]:
    return model.nominal, {p.name: p.value for p in model.initial}


def _trials(model: Model, record: Record, name: str, parameters, start) -> Iterator[_Trial]:
    """Yield single changes of sign, unit, order or offset."""
    unit, inputs = model.unit(name), ", ".join(model.inputs)
    if grid_of(model, record).substeps <= _STEPS:
        share, slope, offset = _straight(model, record, name, parameters, start)
        if slope < 0:
            yield _Trial(share, f"the opposite sign of {name}, or of {inputs},", mistaken="output")
        elif slope > 0 and not 1.0 / _OTHER_UNIT < slope < _OTHER_UNIT:
            words = f"a simulated {name} {slope:.2g} times as large (its unit, or that of {inputs})"
            yield _Trial(share, words, mistaken="")
        else:
            words = f"{name} less {offset:.3g} {unit}".rstrip() + " (its zero: Column(..., offset=...))"
            yield _Trial(share, words, mistaken="")
    for changed, words in _other_records(model, record, name):
        share, slope, _ = _straight(model, changed, name, parameters, start)
        if slope > 0:
            yield _Trial(share, words)


def _other_records(model: Model, record: Record, name: str) -> Iterator[tuple[Record, str]]:
    """Yield the record with another unit of time, and, unless that is slow, with its columns taken otherwise.

    These are other signs and units of the inputs, and an input that was exchanged with the output.
    """
    yield replace(record, time=1e-3 * record.time), "a thousandth of the time (is it in ms?)"
    for given in model.inputs if grid_of(model, record).substeps <= _STEPS else ():
        values, measured = record.inputs[given], record.outputs[name]
        if np.isfinite(measured).all() and np.ptp(values) > 0.0:
            exchanged = {**record.inputs, given: measured}, {**record.outputs, name: values}
            yield replace(record, inputs=exchanged[0], outputs=exchanged[1]), f"{given} and {name} exchanged"
        yield replace(record, inputs={**record.inputs, given: -values}), f"the opposite sign of {given}, or of {name},"
        for factor in _UNITS:
            changed = replace(record, inputs={**record.inputs, given: factor * values})
            yield changed, f"{factor:.4g} times {given} (mind the unit of its column)"


def _straight(model: Model, record: Record, name: str, parameters, start) -> tuple[float, float, float]:
    """Return the share of an output's variance that a line of the simulated one explains, its slope and offset."""
    simulated = simulate(model, record, parameters, start)[name]
    kept = np.isfinite(record.outputs[name])
    y, x = record.outputs[name][kept], simulated[kept]
    spread = float(np.var(x)) if np.isfinite(x).all() else 0.0
    if not 0.0 < spread < np.inf:
        return 0.0, 0.0, float(np.mean(y))
    slope = float(np.mean((x - x.mean()) * (y - y.mean()))) / spread
    return slope**2 * spread / float(np.var(y)), slope, float(np.mean(y) - slope * np.mean(x))
