"""How figures are drawn: colours and style, units with prefixes, legends, PNG; pyplot's global state is left alone."""

import base64
import functools
import io
import math
from typing import TYPE_CHECKING

import numpy as np

from ehsvjax.quantities import PREFIXES, prefix_of
from ehsvjax.record import Record

if TYPE_CHECKING:
    import matplotlib.figure

MEASURED, MODEL, TRUE, COMMAND, AXIS = "#9aa5b1", "#c2410c", "#1f2933", "#2563a8", "#616e7c"

_STYLE = {
    "font.size": 10,
    "axes.labelsize": 10,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": AXIS,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.xmargin": 0.01,
    "grid.color": "#e4e7eb",
    "grid.linewidth": 0.8,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "lines.linewidth": 1.4,
}


def empty_figure(width: float, height: float):
    """Return an empty figure that a notebook shows without pyplot."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    figure._repr_png_ = functools.partial(to_png, figure)  # type: ignore[attr-defined]
    return figure


def house_style():
    """Return a context in which figures are drawn alike."""
    import matplotlib

    return matplotlib.rc_context(_STYLE)


def legend_above(axes, *below) -> None:
    """Put the legend of the axes, and of those below, above their right end, where no data can lie."""
    entries = [entry for one in (axes, *below) for entry in zip(*one.get_legend_handles_labels(), strict=True)]
    handles, labels = zip(*entries, strict=True)
    axes.legend(handles, labels, loc="lower right", bbox_to_anchor=(1.0, 0.97), ncols=3, borderaxespad=0.0,
                markerscale=3, columnspacing=1.2, handlelength=1.6)  # fmt: skip


def share_time(axes, record: Record) -> None:
    """Give axes that stand above each other the record's time, written below the last."""
    for upper in axes[:-1]:
        upper.sharex(axes[-1])
        upper.tick_params(labelbottom=False)
    axes[-1].set(xlabel="time (s)", xlim=(record.time[0], record.time[-1] + record.duration / (len(record) - 1)))


def scale_and_unit(values, unit: str) -> tuple[float, str]:
    """Return what to divide by, and the unit as it then reads in a label: metres of a few thousandths are in mm."""
    finite = np.abs(values[np.isfinite(values)])
    prefix = prefix_of(float(np.max(finite, initial=0.0)), unit)
    return PREFIXES[prefix], plain_text(f"({prefix}{unit})") if unit else "(–)"


def scale_to_order_of_one(value: float, unit: str) -> tuple[float, str]:
    """Return as `scale_and_unit`; where no prefix helps, a power of ten stands in the label instead of at the axis."""
    factor, label = scale_and_unit(np.array([value]), unit)
    size = abs(value) / factor
    if not 0.0 < size < math.inf or 1e-3 <= size < 1e4:
        return factor, label
    power = math.floor(math.log10(size))
    return factor * 10.0**power, f"($10^{{{power}}}$ {plain_text(unit)})"


def spaced(name: str) -> str:
    """Return a name as words."""
    return plain_text(name.replace("_", " "))


def plain_text(text: str) -> str:
    """Return a user's text as matplotlib draws it letter by letter, on one line: a dollar would begin a formula."""
    return " ".join(text.splitlines()).replace("$", r"\$")


def to_png(figure: "matplotlib.figure.Figure", dots_per_inch: float = 110.0) -> bytes:
    """Return a figure as the bytes of a PNG file, in a palette of 64 colours, which makes it three times smaller."""
    from PIL import Image

    drawn, small = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png", dpi=dots_per_inch)
    Image.open(drawn).convert("RGB").quantize(64).save(small, format="png", optimize=True)
    return small.getvalue()


def embedded(png: bytes) -> str:
    """Return a PNG file as an address that an HTML page can hold itself."""
    return f"data:image/png;base64,{base64.b64encode(png).decode()}"
