"""Results as pictures: each function returns a matplotlib figure, which no global state of pyplot knows about."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from ehsvjax.checks import instance
from ehsvjax.correlations import Correlation, with_input, with_itself
from ehsvjax.drawing import (
    AXIS,
    COMMAND,
    MEASURED,
    MODEL,
    TRUE,
    empty_figure,
    house_style,
    legend_above,
    plain_text,
    scale_and_unit,
    scale_to_order_of_one,
    share_time,
    spaced,
)
from ehsvjax.fit import Fit
from ehsvjax.hydraulics import normalised_pressure_flow_curves
from ehsvjax.linear import LinearModel
from ehsvjax.models.model import Model
from ehsvjax.precision.standard_errors import quantile_of
from ehsvjax.quantities import NOT_FINITE, PREFIXES, prefix_of, quantity
from ehsvjax.record import Record, checked_record
from ehsvjax.summary import percent_of_fit

if TYPE_CHECKING:
    import matplotlib.figure

    from ehsvjax.precision import Band, ProfileLikelihood

# Samples by which residuals are compared with themselves and with inputs.
_LAGS = 25


def plot_fit(fit: Fit, record: Record) -> "matplotlib.figure.Figure":
    """Draw each output of a record, measured and simulated, its residual, and the cost by generation of a search.

    The residual lies in two bands: the wide one holds 95% of new samples, in the narrow one lies the true output less
    the model's with 95%, as far as the errors of the parameters go.

    Args:
        fit: whose model is simulated.
        record: one that was fitted, or a new one, whose initial conditions are then estimated first.

    Raises:
        ValueError: if the record lacks an input, or holds no output.

    """
    if not checked_record(record).outputs:
        raise ValueError(f"expected {record.name} to hold an output to draw, got none: use fit.simulate(record)")
    initial = fit.initial_of(record)
    simulated, score = fit.simulate(record, initial), fit.score(record, initial)
    bands = fit.bands(record, initial)
    count = len(record.outputs)
    with house_style():
        searched = len(fit.history.best_cost) > 0  # a fit that a diagnosis extended was not
        figure = empty_figure(width=9.0, height=3.4 * count + 2.2 * searched)
        figure.suptitle(plain_text(f"{fit.model.name}: {record.name}"), x=0.01, ha="left", fontweight="bold")
        rows = figure.subplots(2 * count + searched, 1, height_ratios=[2.2, 1.2] * count + [2.2] * searched)
        signals = rows[: 2 * count]
        for i, (name, measured) in enumerate(record.outputs.items()):
            unit = fit.model.unit(name)
            axes, below = signals[2 * i : 2 * i + 2]
            axes.set_title(
                plain_text(f"fit {percent_of_fit(score.fit_percent[name])}, rmse {quantity(score.rmse[name], unit)}")
            )
            _draw_series(axes, record.time, {"measured": measured, "model": simulated[name]}, name, unit)
            _draw_residual(below, record.time, measured - simulated[name], unit, bands.get(name))
        share_time(signals, record)
        if searched:
            _draw_search(rows[-1], fit)
        figure.align_ylabels()
    return figure


def plot_residuals(fit: Fit, record: Record) -> "matplotlib.figure.Figure":
    """Draw what a fit leaves of each output: its correlations with itself and with every input, its values, its power.

    The bands hold 99% of the correlations that noise alone would show. Correlated noise leaves the first band and not
    the others; a model that is wrong leaves those too.

    Args:
        fit: whose model is simulated.
        record: one that was fitted, or a new one, whose initial conditions are then estimated first.

    Raises:
        ValueError: if the record lacks an input, holds no output, or the simulation fails.

    """
    from scipy.signal import welch
    from scipy.stats import norm

    if not checked_record(record).outputs:
        raise ValueError(f"expected {record.name} to hold an output to draw, got none: use fit.simulate(record)")
    left = fit.residuals(record)
    failed = [name for name, residual in left.items() if np.isinf(residual).any()]
    if failed:
        raise ValueError(
            f"the simulation of {', '.join(failed)} is not finite on {record.name}: nothing is left to draw"
        )
    lags = min(_LAGS, len(record) // 4)
    with house_style():
        figure = empty_figure(width=2.9 * (3 + len(record.inputs)), height=0.5 + 2.6 * len(left))
        figure.suptitle(
            plain_text(f"{fit.model.name}: what is left of {record.name}"), x=0.01, ha="left", fontweight="bold"
        )
        rows = figure.subplots(len(left), 3 + len(record.inputs), squeeze=False)
        for axes, (name, residual) in zip(rows, left.items(), strict=True):
            factor, label = scale_and_unit(residual, fit.model.unit(name))
            _draw_correlation(axes[0], with_itself(residual, lags), "with itself")
            axes[0].set_ylabel(f"{spaced(name)}\ncorrelation")
            for below, (driving, values) in zip(axes[1:], record.inputs.items(), strict=False):
                _draw_correlation(below, with_input(residual, values, lags), f"with {spaced(driving)}")
            there = residual[np.isfinite(residual)] / factor
            axes[-2].hist(there, bins="auto", density=True, color=MEASURED)
            places = np.linspace(there.min(), there.max(), 200)
            axes[-2].plot(places, norm.pdf(places, there.mean(), there.std() or 1.0), color=MODEL)
            axes[-2].set(title="its values", xlabel=f"residual {label}", yticks=[])
            filled = np.nan_to_num(residual - np.nanmean(residual)) / factor
            frequencies, power = welch(filled, 1.0 / record.sample_period, nperseg=min(len(filled), 512))
            axes[-1].loglog(frequencies[1:], power[1:], color=MEASURED)
            axes[-1].axhline(2.0 * record.sample_period * float(np.mean(filled**2)), color=MODEL, ls=(0, (4, 3)))
            axes[-1].set(title="its power, and that of white noise", xlabel="frequency (Hz)")
    return figure


def plot_comparison(fits: Mapping[str, Fit], records: Sequence[Record]) -> "matplotlib.figure.Figure":
    """Draw the outputs of records, measured and as several fits simulate them, a row for each record and output."""
    pairs = [(record, output) for record in records for output in record.outputs]
    with house_style():
        figure = empty_figure(width=9.0, height=0.4 + 2.6 * len(pairs))
        rows = figure.subplots(len(pairs), 1, squeeze=False)[:, 0]
        for axes, (record, output) in zip(rows, pairs, strict=True):
            unit = next(iter(fits.values())).model.unit(output)
            factor, label = scale_and_unit(record.outputs[output], unit)
            axes.plot(record.time, record.outputs[output] / factor, color=MEASURED, ls="none", marker=".", ms=2.5,
                      label="measured", rasterized=True)  # fmt: skip
            for i, (name, fit) in enumerate(fits.items()):
                initial = fit.initial_of(record)  # of a new record a fit of its own
                percent = percent_of_fit(fit.score(record, initial).fit_percent[output])
                axes.plot(record.time, fit.simulate(record, initial)[output] / factor, color=f"C{i}", lw=1.1,
                          label=plain_text(f"{name}: {percent}"))  # fmt: skip
            axes.set(title=plain_text(record.name), ylabel=f"{spaced(output)}\n{label}", xlabel="time (s)")
            axes.legend(loc="best")
        figure.align_ylabels()
    return figure


def plot_bode(linear: LinearModel) -> "matplotlib.figure.Figure":
    """Draw size and phase of a linear model's responses over frequency: a column for each input, two rows an output.

    The band holds the true response with 95%, as far as the errors of a fit's parameters go.
    """
    rates = np.abs(linear.poles[np.abs(linear.poles) > 0.0])
    least, most = (rates.min(), rates.max()) if len(rates) else (1.0, 1.0)
    frequency = np.geomspace(0.05 * least, 10.0 * min(most, 1e3 * least), 400)
    response, reach = linear.response(frequency), quantile_of(0.95) * linear.deviation(frequency)
    answers = np.any(response != 0.0, axis=0)
    decibel = 20.0 * np.log10(np.where(answers, np.abs(response), np.nan))
    phase = np.where(answers, np.unwrap(np.angle(response), axis=0), np.nan)
    with house_style():
        figure = empty_figure(width=1.0 + 4.5 * len(linear.inputs), height=0.4 + 3.8 * len(linear.outputs))
        shape = (2 * len(linear.outputs), len(linear.inputs))
        rows = figure.subplots(*shape, squeeze=False, sharex=True, height_ratios=[1.6, 1.0] * len(linear.outputs))
        for (i, output), (k, name) in itertools.product(enumerate(linear.outputs), enumerate(linear.inputs)):
            size, angle = rows[2 * i : 2 * i + 2, k]
            for axes, curve, half in (
                (size, decibel[:, i, k], 20.0 / math.log(10.0) * reach.real[:, i, k]),
                (angle, np.degrees(phase[:, i, k]), np.degrees(reach.imag[:, i, k])),
            ):
                axes.fill_between(frequency / math.tau, curve - half, curve + half, color=MODEL, alpha=0.25, lw=0)
                axes.semilogx(frequency / math.tau, curve, color=MODEL)
                # What hardly changes is drawn as such.
                low, high = axes.get_ylim()
                axes.set_ylim(min(low, 0.5 * (low + high) - 5.0), max(high, 0.5 * (low + high) + 5.0))
            silent = "" if answers[i, k] else ": does not answer"
            size.set(title=f"{spaced(name)} to {spaced(output)}{silent}", ylabel="size (dB)" if k == 0 else "")
            angle.set(ylabel="phase (°)" if k == 0 else "")
            angle.locator_params(axis="y", nbins=5, steps=[1, 1.5, 3, 4.5, 9, 10])
        for axes in rows[-1]:
            axes.set_xlabel("frequency (Hz)")
        figure.align_ylabels()
    return figure


def plot_record(record: Record) -> "matplotlib.figure.Figure":
    """Draw every signal of a record over time, inputs as they run between samples; what is missing is marked below."""
    signals = {**record.inputs, **record.outputs}
    with house_style():
        figure = empty_figure(width=9.0, height=0.6 + 1.5 * len(signals))
        figure.suptitle(plain_text(record.name), x=0.01, ha="left", fontweight="bold")
        rows = figure.subplots(len(signals), 1, squeeze=False)[:, 0]
        for axes, (name, values) in zip(rows, signals.items(), strict=True):
            if name in record.inputs:
                _draw_input(axes, record, name)
            else:
                axes.plot(record.time, values, color=MEASURED, ls="none", marker=".", ms=2.5, rasterized=True)
            missing = record.time[~np.isfinite(values)]
            if len(missing):
                axes.plot(missing, np.zeros(len(missing)), "|", color=MODEL, transform=axes.get_xaxis_transform(),
                          label=f"{len(missing)} missing")  # fmt: skip
                legend_above(axes)
            axes.set_ylabel(spaced(name))
        share_time(rows, record)
        figure.align_ylabels()
    return figure


def plot_experiment(
    records: Sequence[Record], model: Model, said: Mapping[str, Sequence[Record]], outputs: Sequence[str]
) -> "matplotlib.figure.Figure":
    """Draw an experiment that is planned: its inputs, what several models say of each output, and their differences.

    Args:
        records: inputs; one column for each.
        model: for the units.
        said: name of each model -> the records with its outputs; the first is what the others are compared with.
        outputs: those that are drawn.

    """
    count = len(records[0].inputs) + 2 * len(outputs)
    with house_style():
        figure = empty_figure(width=9.0, height=0.6 + 1.6 * count)
        grid = figure.subplots(count, len(records), squeeze=False)
        for k, record in enumerate(records):
            _draw_experiment(grid[:, k], record, model, {name: each[k].outputs for name, each in said.items()}, outputs)
            if len(records) > 1:
                grid[0, k].set_title(record.name)
        figure.align_ylabels()
    return figure


def _draw_experiment(rows, record: Record, model: Model, said: Mapping[str, Mapping[str, Any]], outputs) -> None:
    first, *others = said
    for axes, (name, values) in zip(rows, record.inputs.items(), strict=False):
        factor, label = scale_and_unit(values, model.unit(name))
        _draw_input(axes, record, name, factor)
        axes.set_ylabel(f"{spaced(name)}\n{label}")
    for i, output in enumerate(outputs):
        together, apart = rows[len(record.inputs) + 2 * i :][:2]
        factor, label = scale_and_unit(np.concatenate([one[output] for one in said.values()]), model.unit(output))
        for k, (name, one) in enumerate(said.items()):
            together.plot(record.time, one[output] / factor, color=f"C{k}", lw=1.0, label=spaced(name))
        together.set_ylabel(f"{spaced(output)}\n{label}")
        legend_above(together)
        differences = {name: said[name][output] - said[first][output] for name in others}
        factor, label = scale_and_unit(np.concatenate(list(differences.values())), model.unit(output))
        for k, (name, values) in enumerate(differences.items(), 1):
            apart.plot(record.time, values / factor, color=f"C{k}", lw=1.0, label=f"{spaced(name)} − {spaced(first)}")
        apart.set_ylabel(f"difference\n{label}")
        legend_above(apart)
    share_time(rows, record)


def plot_identification(
    fits: Fit | Sequence[Fit],
    noise_free: Mapping[str, Float[np.ndarray, " time"]] | Sequence[Mapping[str, Float[np.ndarray, " time"]]] = (),
) -> "matplotlib.figure.Figure":
    """Draw the command, the noisy output, the noise-free one and the model's: figures 4 and 5 of the paper.

    One column for each fit: its first record, and the first output of that.

    Args:
        fits: one or several.
        noise_free: for each fit, name of the output -> `[time]` without noise in its unit, where it is known.

    Raises:
        ValueError: if as many `noise_free` as fits are not given.

    """
    fits = [fits] if isinstance(fits, Fit) else list(fits)
    known = [noise_free] if isinstance(noise_free, Mapping) else list(noise_free)
    if known and len(known) != len(fits):
        raise ValueError(
            f"expected noise_free for each of {len(fits)} fits, got {len(known)}: leave it out or add some"
        )
    with house_style():
        figure = empty_figure(width=8.0 if len(fits) == 1 else 5.4 * len(fits), height=6.4)
        columns = figure.subplots(3, len(fits), squeeze=False, height_ratios=[1.0, 2.4, 1.3]).T
        for axes, fit, true in zip(columns, fits, known or [{}] * len(fits), strict=True):
            _draw_identification(axes, fit, true)
        figure.align_ylabels()
    return figure


def plot_profiles(found: "ProfileLikelihood") -> "matplotlib.figure.Figure":
    """Draw the signed root of each profile's rise in cost against the parameter, with its interval.

    The straight line is what the standard error alone says.
    """
    names = list(found.profiles)
    columns = min(3, len(names))
    quantile = quantile_of(found.level)
    with house_style():
        figure = empty_figure(width=3.4 * columns, height=2.6 * -(-len(names) // columns) + 0.3)
        every = figure.subplots(-(-len(names) // columns), columns, squeeze=False).ravel()
        for axes, name in zip(every, names, strict=False):
            profile, unit = found.profiles[name], found.units[name]
            estimate, error = found.estimates[name], found.standard_errors[name]
            prefix = prefix_of(abs(estimate), unit)
            factor = PREFIXES[prefix]
            if math.isfinite(error):
                reach = 3.0 * error * np.array([-1.0, 1.0])
                axes.plot((estimate + reach) / factor, [-3.0, 3.0], color=MEASURED, ls=(0, (4, 3)))
            axes.plot(profile.values / factor, profile.signed_root, color=MODEL, marker=".", ms=4)
            axes.axvspan(*(end / factor for end in profile.interval), color=MODEL, alpha=0.12, lw=0)
            axes.axhline(0.0, color=AXIS, lw=0.8)
            axes.set_yticks([-quantile, 0.0, quantile], [f"−{quantile:.2f}", "0", f"{quantile:.2f}"])
            inside = [v for v, r in zip(profile.values, profile.signed_root, strict=True) if abs(r) < 2 * quantile]
            low, high = min(*inside, profile.interval[0]), max(*inside, profile.interval[1])
            axes.set(title=spaced(name), xlabel=plain_text(f"{prefix}{unit}") if unit else "",
                     xlim=(low / factor, high / factor), ylim=(-2 * quantile, 2 * quantile))  # fmt: skip
            axes.ticklabel_format(axis="x", style="sci", scilimits=(-3, 4), useOffset=False)
            axes.xaxis.get_major_locator().set_params(nbins=4)
        for axes in every[len(names) :]:
            axes.set_visible(False)
        every[0].set_ylabel("signed root of\nthe rise in cost")
    return figure


def plot_corner(
    estimates: Mapping[str, float],
    units: Mapping[str, str],
    covariance: Float[np.ndarray, "parameter parameter"],
    draws: Mapping[str, Float[np.ndarray, " draw"]] | None = None,
    profiles: "ProfileLikelihood | None" = None,
) -> "matplotlib.figure.Figure":
    """Draw what is known of parameters, by pairs and one by one.

    Args:
        estimates: name -> value, SI.
        units: name -> unit.
        covariance: by linear theory, SI, in the order of the estimates; NaN where it says nothing.
        draws: name -> values of a bootstrap, SI.
        profiles: of some of them.

    Raises:
        ValueError: for profiles that are none, or of none of these parameters.

    """
    from ehsvjax.precision import ProfileLikelihood

    names = list(estimates)
    if profiles is not None:
        instance("profiles", profiles, ProfileLikelihood, "pass fit.profile_likelihood()")
        if not set(names) & set(profiles.profiles):
            raise ValueError(f"expected profiles of {', '.join(names)}, got {', '.join(profiles.profiles)}")
    drawn_in = {name: scale_to_order_of_one(estimates[name], units[name]) for name in names}
    values = {name: each / drawn_in[name][0] for name, each in ({} if draws is None else draws).items()}
    count = len(names)
    with house_style():
        figure = empty_figure(width=1.5 * count + 1.2, height=1.5 * count + 0.8)
        grid = figure.subplots(count, count, squeeze=False, sharex="col")
        for i, j in itertools.product(range(count), repeat=2):
            axes, below, left = grid[i, j], names[j], names[i]
            if j > i:
                axes.set_visible(False)
                continue
            axes.ticklabel_format(style="plain", useOffset=False)
            axes.xaxis.get_major_locator().set_params(nbins=3)
            factors = np.array([drawn_in[below][0], drawn_in[left][0]])
            spread = covariance[np.ix_([j, i], [j, i])] / np.outer(factors, factors)
            centre = np.array([estimates[below], estimates[left]]) / factors
            if i == j:
                profile = None if profiles is None else profiles.profiles.get(below)
                _draw_alone(axes, values.get(below), centre[0], spread[0, 0], profile, factors[0])
            else:
                if values:
                    axes.plot(values[below], values[left], ls="", marker=".", ms=3, color=MEASURED, alpha=0.6)
                axes.plot(*_ellipse(centre, spread), color=COMMAND)
                axes.plot(*centre, marker="+", ms=8, color=TRUE)
                axes.yaxis.get_major_locator().set_params(nbins=3)
                axes.tick_params(labelleft=j == 0)
            if i == count - 1:
                axes.set_xlabel(f"{spaced(below)}\n{drawn_in[below][1]}")
            if j == 0 < i:
                axes.set_ylabel(f"{spaced(left)}\n{drawn_in[left][1]}")
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="upper right")
    return figure


def _draw_alone(axes, values, estimate: float, variance: float, profile, factor: float) -> None:
    """Draw the density of one parameter: of its draws, of linear theory, and the likelihood of its profile."""
    axes.set_yticks([])
    if values is not None:
        axes.hist(values, bins="auto", density=True, color=MEASURED, alpha=0.6, label="bootstrap")
    reach = np.linspace(-3.5, 3.5, 141)
    if variance > 0.0:
        deviation = math.sqrt(variance)
        bell = np.exp(-0.5 * reach**2) / (math.sqrt(2.0 * math.pi) * deviation)
        axes.plot(estimate + deviation * reach, bell, color=COMMAND, label="linear theory (95% ellipse)")
    if profile is not None:
        at = np.linspace(profile.values[0], profile.values[-1], 141) / factor
        likelihood = np.exp(-0.5 * np.interp(at, profile.values / factor, profile.signed_root) ** 2)
        axes.plot(at, likelihood / np.trapezoid(likelihood, at), color=MODEL, label="profile likelihood")


def _ellipse(centre, covariance, level: float = 0.95):
    """Return the curve of two parameters that holds them by linear theory; none where that says nothing of them."""
    if not np.isfinite(covariance).all():
        return [], []
    variances, axes = np.linalg.eigh(covariance)
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    size = np.sqrt(-2.0 * math.log(1.0 - level) * np.maximum(variances, 0.0))
    return centre[:, None] + (axes * size) @ np.stack([np.cos(angle), np.sin(angle)])


def plot_pressure_flow() -> "matplotlib.figure.Figure":
    """Draw the normalised pressure-flow curves of a critical-centre valve: figure 1 of the paper."""
    openings = np.array([0.2, 0.4, 0.6, 0.8, 1.0])
    # Closer towards stall, where the root is steep.
    pressures = np.sin(np.linspace(-np.pi / 2, np.pi / 2, 401))
    with house_style():
        figure = empty_figure(width=7.0, height=5.0)
        axes = figure.subplots()
        for side, colour in ((1.0, COMMAND), (-1.0, MODEL)):
            curves = np.asarray(normalised_pressure_flow_curves(side * openings, pressures))
            for opening, curve in zip(openings, curves, strict=True):
                axes.plot(pressures, curve, color=colour)
                text = f"{side * opening:+.1f}".replace("-", "\N{MINUS SIGN}")
                axes.annotate(text, (-side, curve[0 if side > 0 else -1]), (-5 * side, 0), textcoords="offset points",
                              ha="right" if side > 0 else "left", va="center", color=colour, fontsize=9)  # fmt: skip
        axes.set(xlabel="load pressure $P_L / P_S$", ylabel="load flow $Q_L / Q_\\max$",
                 xlim=(-1.22, 1.22), ylim=(-1.55, 1.55))  # fmt: skip
        for spine in ("left", "bottom"):
            axes.spines[spine].set_visible(False)
        axes.tick_params(length=0)
        axes.axhline(0, color=AXIS, lw=0.8)
        axes.axvline(0, color=AXIS, lw=0.8)
        axes.set_title("on the curves: spool opening $x_v / x_{v,\\max}$", loc="right")
    return figure


def _draw_identification(axes, fit: Fit, true: Mapping[str, Any]) -> None:
    command_axes, output_axes, error_axes = axes
    record = fit.records[0]
    name = next(name for name in fit.outputs if name in record.outputs)
    measured, simulated, unit = record.outputs[name], fit.simulate(record)[name], fit.model.unit(name)
    command = fit.model.inputs[0]
    factor, label = scale_and_unit(record.inputs[command], fit.model.unit(command))
    style = "steps-post" if record.hold_of(command) == "zero" else "default"
    command_axes.plot(record.time, record.inputs[command] / factor, color=COMMAND, drawstyle=style)
    command_axes.set(ylabel=f"{spaced(command)}\n{label}", title=plain_text(record.name))

    series = {"measured": measured, "model": simulated}
    if name in true:
        series["noise-free"] = true[name]
    _draw_series(output_axes, record.time, series, name, unit)
    _draw_residual(error_axes, record.time, measured - simulated, unit)
    if name in true:
        factor, _ = scale_and_unit(measured - simulated, unit)
        error_axes.plot(record.time, (true[name] - simulated) / factor, color=MODEL, label="noise-free − model")
        legend_above(error_axes)
    share_time(axes, record)


def _draw_input(axes, record: Record, name: str, factor: float = 1.0) -> None:
    """Draw an input as it runs between samples."""
    held = "steps-post" if record.hold_of(name) == "zero" else "default"
    axes.plot(record.time, record.inputs[name] / factor, color=COMMAND, drawstyle=held, lw=1.0)


def _draw_series(axes, time, series: Mapping[str, Any], name: str, unit: str) -> None:
    looks: dict[str, dict[str, Any]] = {
        "measured": {"color": MEASURED, "ls": "none", "marker": ".", "ms": 2.5, "rasterized": True},
        "noise-free": {"color": TRUE, "ls": (0, (4, 3)), "lw": 1.1},
        "model": {"color": MODEL},
    }
    factor, label = scale_and_unit(np.concatenate(list(series.values())), unit)
    for kind, values in series.items():
        absent = int(np.sum(~np.isfinite(values)))
        why = "missing" if kind == "measured" else NOT_FINITE
        axes.plot(time, values / factor, label=f"{kind} ({absent} {why})" if absent else kind, **looks[kind])
    axes.set_ylabel(f"{spaced(name)}\n{label}")
    legend_above(axes)


def _draw_residual(axes, time, residual, unit: str, band: "Band | None" = None) -> None:
    factor, label = scale_and_unit(residual, unit)
    if band is not None:
        for half, alpha, words in ((band.measurement, 0.12, "95% of samples"), (band.model, 0.5, "95% of the model")):
            axes.fill_between(time, -half / factor, half / factor, color=MODEL, alpha=alpha, lw=0, label=words)
    axes.plot(time, residual / factor, color=MEASURED, ls="none", marker=".", ms=2.0, rasterized=True,
              label="measured − model")  # fmt: skip
    axes.axhline(0, color=AXIS, lw=0.8)
    axes.set_ylabel(f"residual\n{label}")
    if band is not None:
        legend_above(axes)


def _draw_correlation(axes, found: Correlation, title: str) -> None:
    outside = np.abs(found.values) > found.band
    axes.axhspan(-found.band, found.band, color=MODEL, alpha=0.12, lw=0)
    axes.vlines(found.lags, 0.0, found.values, colors=np.where(outside, MODEL, MEASURED), lw=1.6)
    axes.axhline(0.0, color=AXIS, lw=0.8)
    axes.set(title=title, xlabel="lag (samples)")


def _draw_search(axes, fit: Fit) -> None:
    generations = np.arange(1, len(fit.history.best_cost) + 1)
    median, best = (
        np.where(np.isfinite(cost), cost, np.nan) for cost in (fit.history.median_cost, fit.history.best_cost)
    )
    axes.semilogy(generations, median, color=MEASURED, marker=".", label="median of the generation")
    axes.semilogy(generations, best, color=MODEL, marker=".", label="best so far")
    axes.set(xlabel="generation", ylabel="cost\n(noise variances)", title="genetic search")
    axes.xaxis.get_major_locator().set_params(integer=True)
    legend_above(axes)
