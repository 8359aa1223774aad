"""A fit in words: plain text in lmfit's manner, and the same as HTML for notebooks."""

import math
from collections.abc import Iterator, Sequence
from html import escape
from typing import NamedTuple

import numpy as np

from ehsvjax.fit import EXPLAINS_NOTHING, Effort, Fit
from ehsvjax.linear import LinearModel
from ehsvjax.models.model import Model, Parameter
from ehsvjax.precision.directions import Direction
from ehsvjax.precision.standard_errors import Precision
from ehsvjax.quantities import NOT_FINITE, quantity
from ehsvjax.record import Record


def summary(fit: Fit) -> str:
    """Return the model, records, statistics, parameters and warnings of a fit as text: parameters in SI units.

    The sections are those of lmfit's fit report (Newville et al., lmfit-py).
    """
    return "\n".join(line for section in _sections(fit) for line in _text_lines(section))


def summary_html(fit: Fit) -> str:
    """Return `summary` as an HTML fragment: tables without scripts, colours or outside resources.

    Every text that a user may have chosen (names of records, signals, parameters and their units) is escaped.
    """
    return f'<div style="max-width: 60em">{"".join(_html_table(section) for section in _sections(fit))}</div>'


def model_summary(model: Model) -> str:
    """Return a model's parameters with bounds, initial conditions and signals as text, SI units."""
    return "\n".join(line for section in _model_sections(model) for line in _text_lines(section))


def model_summary_html(model: Model) -> str:
    """Return `model_summary` as an HTML fragment, as `summary_html` does for a fit."""
    return f'<div style="max-width: 60em">{"".join(_html_table(section) for section in _model_sections(model))}</div>'


def precision_summary(precision: Precision) -> str:
    """Return parameters with standard errors, correlations and what is not fixed, as text."""
    rows = [
        (name, f"{value:.6g}", _error(precision, name), precision.units[name])
        for name, value in precision.values.items()
    ]
    sections = [_Section("Parameters", rows, ("name", "value", "standard error", "unit"))]
    sections += _precision_sections(precision)
    return "\n".join(line for section in sections for line in _text_lines(section))


def linear_summary(linear: LinearModel) -> str:
    """Return a linear model's operating point, poles, and what a lasting deviation comes to, as text, SI units."""
    poles = [
        (f"{pole.real:.6g}" + (f" +/- {pole.imag:.6g}j" if pole.imag else ""), f"{abs(pole):.6g}",
         f"{abs(pole) / (2 * math.pi):.4g}", f"{-pole.real / abs(pole):.3g}" if pole else "")
        for pole in linear.poles if pole.imag >= 0.0
    ]  # fmt: skip
    gains = [
        (output, *(f"{gain:.6g}" if np.isfinite(gain) else "does not settle" for gain in row))
        for output, row in zip(linear.outputs, linear.lasting, strict=True)
    ]
    sections = [
        _Section("Operating point", [(name, f"{value:.6g}") for name, value in linear.point.items()]),
        _Section("Poles", poles, ("pole, rad/s", "rad/s", "Hz", "damping ratio")),
        _Section("Change of each output by a lasting unit of", gains, ("", *linear.inputs)),
    ]
    return "\n".join(line for section in sections if section.rows for line in _text_lines(section))


class _Section(NamedTuple):
    """A titled table; `head` names its columns where that needs saying."""

    title: str
    rows: Sequence[tuple[str, ...]]
    head: tuple[str, ...] = ()


_OUTPUT_HEAD = ("output", "rmse", "fit", "noise standard deviation")
_PARAMETER_HEAD = ("name", "symbol", "value", "standard error", "unit", "bounds")
_UNKNOWN = "not known"
# Share of its value from which an error is large.
_LARGE = 0.1
# Per cent beyond which a figure says no more than that.
_ABSURD = 1000.0
# Noise variances below which what the integration is worth need not be told.
_LEAST_WORTH = 0.001
# Correlations that are printed, as in lmfit's reports.
_LEAST_CORRELATION = 0.5
# Of what was known of a parameter beforehand: information of all else that is next to none; standard deviations between
# the two that are no chance.
_LEAST_TOLD, _CONTRADICTED = 1e-3, 3.0
_RECORD_HEAD = ("name", "samples", "missing", "period", "duration")


def _sections(fit: Fit) -> Iterator[_Section]:
    # Warnings come last, unless they are all that matters.
    first = any(warning.startswith(EXPLAINS_NOTHING) for warning in fit.warnings)
    if first:
        yield _warnings(fit)
    yield _Section("Model", _model_rows(fit.model))
    title = "Record" if len(fit.records) == 1 else "Records"
    yield _Section(title, [_record_row(record) for record in fit.records], _RECORD_HEAD)
    known = [
        (r.name, name, f"{value:.6g}", fit.model.parameter(name).unit)
        for r in fit.records
        for name, value in r.constants.items()
    ]
    if known:
        yield _Section("Known of a record", known, ("record", "constant", "value", "unit"))
    yield _Section("Fit statistics", _statistics_rows(fit))
    yield _Section("Outputs", _output_rows(fit), _OUTPUT_HEAD)
    precision = _precision_of(fit)
    yield _Section("Parameters", [_parameter_row(fit, precision, p) for p in fit.model.parameters], _PARAMETER_HEAD)
    priors = [_prior_row(fit, precision, p) for p in fit.model.parameters if p.prior and p.name in fit.parameters]
    if priors:
        yield _Section("Known beforehand", priors, ("name", "value", "unit", "from all else", ""))
    if isinstance(precision, Precision):
        yield from _precision_sections(precision)
    else:
        yield _Section("No standard errors", [(precision,)])
    if fit.model.initial:
        yield _initial_section(fit)
    if not first:
        yield _warnings(fit)


def _model_sections(model: Model) -> Iterator[_Section]:
    yield _Section("Model", [*_model_rows(model), ("longest step", quantity(model.max_step, "s"))])
    head = ("name", "symbol", "value", "unit", "bounds")
    for title, parameters in (("Parameters", model.parameters), ("Initial conditions", model.initial)):
        if parameters:
            yield _Section(title, [_unfitted_row(parameter) for parameter in parameters], head)
    yield _Section("Signals", [tuple(signal) for signal in model.signals], ("name", "kind", "unit"))


def _unfitted_row(parameter: Parameter) -> tuple[str, ...]:
    bounds = f"{parameter.lower:.6g} .. {parameter.upper:.6g}"
    if parameter.fixed:
        bounds = "(fixed, certain)" if parameter.certain else "(fixed)"
    elif parameter.prior:
        bounds += f", known as {parameter.prior[0]:.6g} +/- {parameter.prior[1]:.3g}"
    return parameter.name, parameter.symbol, f"{parameter.value:.6g}", parameter.unit, bounds


def _warnings(fit: Fit) -> _Section:
    return _Section("Warnings", [(warning,) for warning in fit.warnings or ("none",)])


def _precision_of(fit: Fit) -> Precision | str:
    """Return how sure the parameters are, or why that cannot be said: a fit that fails is printed all the same."""
    try:
        return fit.precision()
    except ValueError as refusal:
        return str(refusal)


def _model_rows(model: Model) -> Sequence[tuple[str, ...]]:
    rows = [("name", model.name), ("signals", f"{', '.join(model.inputs)} -> {', '.join(model.outputs)}")]
    names = {p.name for p in model.parameters}
    options = ", ".join(f"{name}={value!r}" for name, value in model.options if name not in names)
    return [*rows, ("options", options)] if options else rows


def _record_row(record: Record) -> tuple[str, ...]:
    counts = {name: int(np.isnan(values).sum()) for name, values in record.outputs.items()}
    missing = ", ".join(f"{count} of {name}" for name, count in counts.items() if count)
    return record.name, f"{len(record)}", missing or "none", f"{record.sample_period:.4g} s", f"{record.duration:.4g} s"


def _statistics_rows(fit: Fit) -> Sequence[tuple[str, ...]]:
    effort = fit.effort
    samples = sum(int(np.isfinite(y).sum()) for record in fit.records for y in record.outputs.values())
    rows = _method_rows(effort)
    if fit.huber is not None:
        rows.append(("residuals", f"weighed linearly beyond {fit.huber:g} standard deviations (Huber)"))
    if effort.step_size is not None:
        rows.append(("integration", _integration(effort.step_size, effort)))
    return [
        *rows,
        ("samples", f"{samples} measured"),
        ("unknowns", _unknowns(fit)),
        ("cost, equation (9)", f"{fit.cost:.6g} {_cost_unit(fit)}" if math.isfinite(fit.cost) else NOT_FINITE),
    ]


def _unknowns(fit: Fit) -> str:
    parameters, initial, records = len(fit.parameters), len(fit.estimated_initial), len(fit.records)
    words = f"{parameters} parameter{'s' if parameters > 1 else ''}"
    if initial:
        words += f", {initial} initial condition{'s' if initial > 1 else ''}"
        words += f" of each of {records} records" if records > 1 else ""
    return words


def _method_rows(effort: Effort) -> list[tuple[str, str]]:
    if not effort.generations:
        ended = "converged" if effort.converged else "not converged"
        return [("method", f"refitted by a diagnosis, from the fit that it extends: by gradient, {ended}")]
    return [("method", f"genetic algorithm, {_search(effort)}"), ("refinement", _refinement(effort))]


def _integration(step_size: float, effort: Effort) -> str:
    words = [f"steps of {quantity(step_size, 's')}"]
    if effort.arithmetic is not None:
        words.append(f"worth {_worth(effort.arithmetic)}")
    if effort.left_out:
        readings = "1 reading" if effort.left_out == 1 else f"{effort.left_out} readings"
        words.append(f"{readings} that it cannot know left out")
    return "; ".join(words)


def _worth(variances: float) -> str:
    if not math.isfinite(variances):
        return "more than can be said, half a step is not finite"
    size = f"{variances:.2g}" if variances >= _LEAST_WORTH else f"less than {_LEAST_WORTH:g}"
    return f"{size} noise variances"


def _search(effort: Effort) -> str:
    sizes = f"{effort.population} individuals x {effort.generations} generations = {effort.simulations} simulations"
    return f"{sizes}; ended by its stop test" if effort.stopped_early else sizes


def _refinement(effort: Effort) -> str:
    if not effort.refined:
        return "none"
    steps = f"{effort.iterations} steps by gradient, {'converged' if effort.converged else 'not converged'}"
    return f"{steps}; {effort.starts_agreeing} of {effort.starts} starts led to this minimum"


def _cost_unit(fit: Fit) -> str:
    if len(fit.outputs) > 1:
        return "s (each output over its noise variance)"
    unit = fit.model.unit(fit.outputs[0])
    return f"({unit})^2 s" if unit and not unit.isalpha() else f"{unit}^2 s" if unit else "s"


def _output_rows(fit: Fit) -> Sequence[tuple[str, ...]]:
    rmse, fit_percent = fit.rmse, fit.fit_percent
    deviation = {name: math.sqrt(variance) for name, variance in fit.noise_variance.items()}
    units = {name: fit.model.unit(name) for name in fit.outputs}
    return [
        (
            name,
            quantity(rmse[name], unit, digits=4),
            percent_of_fit(fit_percent[name]),
            quantity(deviation[name], unit, digits=4),
        )
        for name, unit in units.items()
    ]


def _parameter_row(fit: Fit, precision: Precision | str, parameter: Parameter) -> tuple[str, ...]:
    name, symbol, unit = parameter.name, parameter.symbol, parameter.unit
    if name in fit.tied:
        return name, symbol, f"{fit.tied[name]:.6g}", "", unit, "(tied)"
    if name not in fit.parameters:
        return name, symbol, f"{parameter.value:.6g}", "", unit, "(fixed)"
    bounds = f"{parameter.lower:.6g} .. {parameter.upper:.6g}"
    return name, symbol, f"{fit.parameters[name]:.6g}", _error(precision, name), unit, bounds


def _prior_row(fit: Fit, precision: Precision | str, parameter: Parameter) -> tuple[str, ...]:
    """Return what was known of a parameter beside what all else says of it, and how far apart they are."""
    assert parameter.prior is not None
    name, (mean, deviation) = parameter.name, parameter.prior
    row = name, f"{mean:.6g} +/- {deviation:.3g}", parameter.unit
    if isinstance(precision, str):
        return *row, _UNKNOWN, ""
    error = precision.standard_errors[name]
    information = 1.0 / error**2 - 1.0 / deviation**2 if error > 0.0 else math.inf
    if not _LEAST_TOLD / deviation**2 < information < math.inf:
        return *row, "next to nothing", ""
    other = (fit.parameters[name] / error**2 - mean / deviation**2) / information
    apart = abs(other - mean) / math.hypot(information**-0.5, deviation)
    words = f"{apart:.1f} standard deviations apart" + (": they contradict each other" if apart > _CONTRADICTED else "")
    return *row, f"{other:.6g} +/- {information**-0.5:.3g}", words


def percent_of_fit(percent: float) -> str:
    """Return MATLAB's fit in words that can be meant, whatever it is."""
    if not math.isfinite(percent):
        return NOT_FINITE
    return f"{percent:.2f} %" if percent > -_ABSURD else f"below -{_ABSURD:g} %"


def _error(precision: Precision | str, name: str) -> str:
    if isinstance(precision, str):
        return _UNKNOWN
    error, value = precision.standard_errors[name], precision.values[name]
    if not math.isfinite(error):
        return "not fixed"
    return f"+/- {error:.3g}" + (f" ({_percent(100.0 * error / abs(value))})" if value else "")


def _percent(share: float) -> str:
    if share > _ABSURD:
        return f"over {_ABSURD:g}%"
    return f"{share:.2f}%" if share >= 0.1 else f"{share:.2g}%"


def _share(deviation: float) -> str:
    return f"{100 * deviation:.2g}%" if 100 * deviation <= _ABSURD else f"over {_ABSURD:g}%"


def _precision_sections(precision: Precision) -> Iterator[_Section]:
    above = {pair: value for pair, value in precision.correlations.items() if abs(value) > _LEAST_CORRELATION}
    pairs = sorted(above.items(), key=lambda item: -abs(item[1]))
    if pairs:
        rows = [(f"C({first}, {second})", f"= {value:+.3f}") for (first, second), value in pairs]
        yield _Section(f"Correlations above {_LEAST_CORRELATION:g}", rows)
    if precision.unfixed:
        rows = [(_direction(direction), direction.remedy) for direction in precision.unfixed]
        yield _Section("Not fixed by the record" + ("s" if len(precision.initial_errors) > 1 else ""), rows)
    if precision.combinations:
        fixed = [
            (c.name, f"{c.value:.6g}", f"+/- {c.standard_error:.3g} ({_percent(c.percent)})")
            for c in precision.combinations
        ]
        yield _Section("Fixed all the same", fixed)
    noise: list[tuple[str, ...]] = [(precision.noise,)]
    large = [name for name, error in precision.standard_errors.items()
             if _LARGE * abs(precision.values[name]) < error < math.inf]  # fmt: skip
    if large:
        noise.append((f"large errors stretch linear theory: fit.profile_likelihood() for {', '.join(large)}",))
    yield _Section("Noise that the errors count on", noise)


def _direction(direction: Direction) -> str:
    """Return who goes up with whom, with the standard deviation where the direction shows at all."""
    up = [name for name, weight in direction.weights.items() if weight > 0]
    down = [name for name, weight in direction.weights.items() if weight < 0]
    words = f"{', '.join(up)} up" + (f", {', '.join(down)} down" if down else "") if len(up + down) > 1 else up[0]
    return words if math.isinf(direction.deviation) else f"{words} (to {_share(direction.deviation)})"


def _initial_section(fit: Fit) -> _Section:
    """One row for each initial condition, one column for each record."""
    names = [record.name for record in fit.records]
    rows = [(p.name, p.symbol, *(f"{values[p.name]:.6g}" for values in fit.initial), p.unit) for p in fit.model.initial]
    values = ["value"] if len(names) == 1 else names
    return _Section("Initial conditions", rows, ("name", "symbol", *values, "unit"))


def _text_lines(section: _Section) -> list[str]:
    table = [section.head, *section.rows] if section.head else section.rows
    # A name with a new line in it would tear its row apart.
    rows = [[" ".join(cell.splitlines()) for cell in row] for row in table]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
    return [f"[[{section.title}]]", *(f"    {line}".rstrip() for line in lines)]


def _html_table(section: _Section) -> str:
    cell = 'style="text-align: left; padding: 0.1em 1em 0.1em 0"'
    rows = [f"<tr>{''.join(f'<th {cell}>{escape(name)}</th>' for name in section.head)}</tr>"] if section.head else []
    rows += [f"<tr>{''.join(f'<td {cell}>{escape(text)}</td>' for text in row)}</tr>" for row in section.rows]
    title = f'<p style="margin: 0.6em 0 0.1em"><b>{section.title}</b></p>'
    return f'{title}<table style="border-collapse: collapse">{"".join(rows)}</table>'
