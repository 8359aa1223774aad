"""A diagnosis as pictures: what is wrong, where it comes from, what is left of it, and the form of a missing term."""

import textwrap
from typing import TYPE_CHECKING

import numpy as np

from ehsvjax.diagnosis.bench.evidence import SIGNIFICANT
from ehsvjax.diagnosis.hypotheses.curves import quantity_unit
from ehsvjax.diagnosis.results import words
from ehsvjax.diagnosis.results.diagnosis import Diagnosis
from ehsvjax.drawing import (
    AXIS,
    COMMAND,
    MEASURED,
    MODEL,
    empty_figure,
    house_style,
    legend_above,
    plain_text,
    scale_and_unit,
    spaced,
)
from ehsvjax.quantities import PREFIXES, prefix_of

if TYPE_CHECKING:
    import matplotlib.figure

_SUSPECTS = 14
_PANELS = 3
# Score beyond which small ones are told apart on a logarithmic axis only.
_FAR = 20.0
# Of records in one panel.
_MARKERS = "os^Dv"
# Characters in a line of the title.
_TITLE_WIDTH = 110


def plot_diagnosis(diagnosis: Diagnosis) -> "matplotlib.figure.Figure":
    """Draw for each output the residual before and after, in time, in frequency and against quantities; the suspects.

    Bands hold 95% of what noise alone would give.
    """
    names = list(dict.fromkeys(name for outputs in diagnosis.misfit.by_record for name in outputs))
    missing = diagnosis.missing is not None
    with house_style():
        figure = empty_figure(width=10.0, height=4.6 * len(names) + 3.4)
        said = ": ".join(part for part in (diagnosis.verdict, spaced(words.causes(diagnosis))) if part)
        figure.suptitle(textwrap.fill(f"{words.title(diagnosis)}: {said}", _TITLE_WIDTH))
        parts = figure.subfigures(len(names) + 1, 1, height_ratios=[4.6] * len(names) + [3.4], squeeze=False)[:, 0]
        for part, name in zip(parts, names, strict=False):
            _draw_output(part, diagnosis, name)
        widths = [1.3, 1.0] if missing else [1.0]
        columns = parts[-1].subplots(1, len(widths), width_ratios=widths, squeeze=False)
        _draw_suspects(columns[0, 0], diagnosis)
        if missing:
            _draw_missing(columns[0, 1], diagnosis)
    return figure


def _draw_output(part, diagnosis: Diagnosis, name: str) -> None:
    """Draw one output, records one after the other."""
    there = [k for k, outputs in enumerate(diagnosis.misfit.by_record) if name in outputs]
    found = [diagnosis.misfit.by_record[k][name] for k in there]
    unit = diagnosis.fit.model.unit(name)
    extended = diagnosis.extended.model.name != diagnosis.fit.model.name
    grid = part.add_gridspec(2, _PANELS, height_ratios=[1.0, 1.1])
    # One above the other: dots of the one would hide those of the other.
    series = (
        grid[0, :2].subgridspec(1 + extended, 1, hspace=0.0).subplots(sharex=True, sharey=True, squeeze=False)[:, 0]
    )
    spectrum = part.add_subplot(grid[0, 2])
    factor, label = scale_and_unit(np.concatenate([m.residual for m in found]), unit)
    dots = {"ls": "none", "marker": ".", "ms": 2.0, "rasterized": True}
    begins = 0.0
    for k, m in zip(there, found, strict=True):
        record = diagnosis.extended.records[k]
        time = record.time if len(there) == 1 else begins + record.time - record.time[0]
        # In the legend once.
        of_model, of_extended, of_noise = (
            ("the model", "extended", "95% of the noise") if k == there[0] else (None, None, None)
        )
        series[0].plot(time, m.residual / factor, color=MEASURED, label=of_model, **dots)
        if extended:
            after = np.where(np.isnan(m.residual), np.nan, diagnosis.extended.residuals(record)[name])
            series[1].plot(time, after / factor, color=MODEL, label=of_extended, **dots)
        reach, ends = 1.96 * m.noise_floor / factor, time[-1] + record.sample_period
        for axes in series:
            axes.fill_between(
                [time[0], ends], -reach, reach, color=COMMAND, alpha=0.12, lw=0,
                label=of_noise if axes is series[-1] else None,
            )  # fmt: skip
            if k != there[0]:
                axes.axvline(begins, color=AXIS, lw=0.8)
        begins = ends
        shown = m.in_frequency
        spectrum.loglog(shown.frequency, shown.residual, color=MEASURED, label=of_model and "residual")
        if extended:
            spectrum.loglog(shown.frequency, shown.residual_after, color=MODEL, label=of_extended)
        spectrum.loglog(shown.frequency, shown.noise, color=COMMAND, label=of_noise and "noise")
    along = "time (s)" if len(there) == 1 else "time, records one after the other (s)"
    series[-1].set(xlabel=along)
    series[0].set(ylabel=f"residual of\n{spaced(name)} {label}")
    legend_above(*series)
    spectrum.set(xlabel="frequency (Hz)", ylabel=f"power ({unit}²/Hz)" if unit else "power (1/Hz)")
    legend_above(spectrum)
    for panel, quantity in enumerate(_most_telling([m.against for m in found])):
        axes = part.add_subplot(grid[1, panel])
        profiles = {k: m.against[quantity] for k, m in zip(there, found, strict=True) if quantity in m.against}
        across, across_label = scale_and_unit(
            np.concatenate([p.middle for p in profiles.values()]), quantity_unit(diagnosis.fit.model, quantity)
        )
        mean, mean_label = scale_and_unit(np.concatenate([p.mean for p in profiles.values()]), unit)
        for k, profile in profiles.items():
            axes.fill_between(
                profile.middle / across, -1.96 * profile.deviation / mean, 1.96 * profile.deviation / mean,
                color=COMMAND, alpha=0.15, lw=0,
            )  # fmt: skip
            marker = {"marker": _MARKERS[k % len(_MARKERS)], "ms": 4}
            axes.plot(
                profile.middle / across, profile.mean / mean, color=MEASURED, **marker,
                label=plain_text(diagnosis.records[k].name) if len(there) > 1 and not panel else None,
            )  # fmt: skip
            if extended:
                axes.plot(profile.middle / across, profile.mean_after / mean, color=MODEL, **marker)
        if len(there) > 1 and not panel:
            legend_above(axes)
        axes.axhline(0.0, color=AXIS, lw=0.8)
        axes.set(xlabel=f"{spaced(quantity)} {across_label}", ylabel=f"mean residual {mean_label}")


def _most_telling(each) -> list[str]:
    """Return the quantities against which the mean residual differs most from nothing, in some record."""

    def excess(quantity):
        profiles = [against[quantity] for against in each if quantity in against]
        return max(float(np.mean((profile.mean / profile.deviation) ** 2)) for profile in profiles)

    quantities = dict.fromkeys(quantity for against in each for quantity in against)
    return sorted(quantities, key=lambda quantity: -excess(quantity))[:_PANELS]


def _draw_suspects(axes, diagnosis: Diagnosis) -> None:
    table = diagnosis.table
    table = table[np.isfinite(table["score"].astype(float))].drop_duplicates("cause").head(_SUSPECTS)
    table = table.sort_values("score", key=lambda scores: scores.astype(float).abs())
    within = diagnosis.suspected
    colours = [MODEL if cause in within else MEASURED for cause in table["cause"]]
    scores = table["score"].astype(float).abs()
    axes.barh(range(len(table)), scores, color=colours)
    axes.set_yticks(range(len(table)), [spaced(cause) for cause in table["cause"]], fontsize=8)
    if scores.max() > _FAR:
        axes.set_xscale("symlog", linthresh=5.0)
    axes.axvline(diagnosis.significant_score, color=AXIS, lw=0.8, ls="--")
    significant = (table["p_corrected"] < SIGNIFICANT).any()
    axes.set(
        xlabel="score on the nominal model (standard deviations); dashed: beyond chance",
        title="suspects" if significant else "suspects: nothing here is significant",
    )
    axes.grid(axis="y", visible=False)


def _draw_missing(axes, diagnosis: Diagnosis) -> None:
    m = diagnosis.missing
    assert m is not None
    factor, label = scale_and_unit(m.at, m.quantity_unit)
    prefix = "" if m.relative else prefix_of(float(np.max(np.abs(m.estimate))), m.unit)
    size = 0.01 if m.relative else PREFIXES[prefix]
    unit = "%" if m.relative else f"{prefix}{m.unit}" or "–"
    low, high = (m.estimate + side * 1.96 * m.deviation for side in (-1.0, 1.0))
    axes.fill_between(m.at / factor, low / size, high / size, color=MODEL, alpha=0.2, lw=0)
    axes.plot(m.at / factor, m.estimate / size, color=MODEL, marker="o", ms=3)
    axes.axhline(0.0, color=AXIS, lw=0.8)
    # Where hardly anything was seen, the band would hide the rest.
    reach = 2.0 * float(np.max(np.abs(m.estimate))) / size
    axes.set_ylim(max(-reach, axes.get_ylim()[0]), min(reach, axes.get_ylim()[1]))
    title = "the missing term, " + ("no form assumed" if m.period is None else "as a single wave")
    axes.set(xlabel=f"{spaced(m.quantity)} {label}", ylabel=f"missing at {spaced(m.place)} ({unit})", title=title)
