"""The paper's figures and tables on one page that needs no other file, written by Jinja2 with every text escaped."""

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

import ehsvjax.paper as paper
from ehsvjax.drawing import embedded, to_png
from ehsvjax.files import written_whole
from ehsvjax.models import Model, servovalve, van_der_pol
from ehsvjax.paper import Identification
from ehsvjax.plots import plot_identification, plot_pressure_flow


def write_report(
    out_dir: str | os.PathLike[str],
    van_der_pol_identifications: Sequence[Identification],
    servovalve_identifications: Sequence[Identification],
) -> Path:
    """Write figures 1, 4 and 5 (PNG), tables 1 and 2 (CSV), and report.html, which holds them all; return its path.

    Figure 4 shows the identification of the oscillator with the most noise, figure 5 those of the servovalve with more
    than the least.

    Args:
        out_dir: folder, made if need be.
        van_der_pol_identifications, servovalve_identifications: the lines of the tables, noise variances increasing.

    Raises:
        ValueError: if one of the two is empty, or for a noise variance that the paper's table does not have.

    """
    if not van_der_pol_identifications or not servovalve_identifications:
        raise ValueError("expected at least one identification of each model, got none")
    out = Path(out_dir)
    table_1 = paper.table_1(van_der_pol_identifications)
    table_2 = paper.table_2(servovalve_identifications)
    pictures = {
        "figure_1": to_png(plot_pressure_flow(), 160.0),
        "figure_4": to_png(_identification_figure(van_der_pol_identifications[-1:]), 160.0),
        "figure_5": to_png(_identification_figure(servovalve_identifications[-2:]), 160.0),
    }
    page = _page(
        pictures,
        table_1=_rows(table_1, van_der_pol(), paper.VAN_DER_POL_TRUTH),
        table_2=_rows(table_2, servovalve(), paper.SERVOVALVE_TRUTH),
        van_der_pol=van_der_pol_identifications,
        servovalve=servovalve_identifications,
        beyond_noise=_beyond_noise(table_2, servovalve()),
        flow_gain=_flow_gain_range(),
    )
    out.mkdir(parents=True, exist_ok=True)
    for name, picture in pictures.items():
        _write(out / f"{name}.png", picture)
    for name, table in (("table_1", table_1), ("table_2", table_2)):
        flat = table.set_axis([" ".join(column) for column in table.columns], axis="columns")
        _write(out / f"{name}.csv", flat.to_csv(float_format="%.6g").encode())
    report = out / "report.html"
    _write(report, page.encode())
    return report


def _write(path: Path, content: bytes) -> None:
    with written_whole(path) as file:
        file.write(content)


def _identification_figure(identifications: Sequence[Identification]):
    return plot_identification([i.fit for i in identifications], [i.noise_free.outputs for i in identifications])


def _page(pictures: Mapping[str, bytes], **context: Any) -> str:
    environment = Environment(loader=PackageLoader("ehsvjax", "."), autoescape=True, undefined=StrictUndefined)
    environment.filters |= {"number": _number, "signed": _signed, "percent": _percent, "unit": _unit, "symbol": _symbol}
    images = {name: embedded(png) for name, png in pictures.items()}
    return environment.get_template("report.html").render(images=images, **context)


def _rows(table: pd.DataFrame, model: Model, truth: Mapping[str, float]) -> dict[str, Any]:
    """Return what the template needs of a table: its parameters, and (variance, [(row, [(value, error)])])."""
    groups = []
    for variance in table.index.unique(0):
        rows = [
            (row, [(values[name, "value"], values[name, "error %"]) for name in truth])
            for row, values in table.loc[variance].iterrows()
        ]
        groups.append((variance, rows))
    return {"parameters": [(model.parameter(name), true) for name, true in truth.items()], "groups": groups}


def _beyond_noise(table: pd.DataFrame, model: Model, least: float = 10.0) -> list[dict[str, Any]]:
    """Return the paper's errors of more than `least` standard deviations of what the record allows, largest first."""
    found = [
        {
            "parameter": model.parameter(name),
            "variance": variance,
            "error": table.loc[(variance, "paper"), (name, "error %")],
            "bound": table.loc[(variance, paper.BOUND), (name, "error %")],
        }
        for variance in table.index.unique(0)
        for name in table.columns.unique(0)
    ]
    found = [entry | {"ratio": abs(entry["error"]) / entry["bound"]} for entry in found]
    return sorted((entry for entry in found if entry["ratio"] > least), key=lambda entry: -entry["ratio"])


def _flow_gain_range() -> dict[str, Any]:
    """Return the interval in which the true flow gain must lie for the printed ones to be within +-50% of it."""
    found = [row["flow_gain"] for row in paper.PAPER_TABLE_2.values()]
    return {
        "printed": paper.PRINTED_FLOW_GAIN,
        "used": paper.SERVOVALVE_TRUTH["flow_gain"],
        "found": found,
        "lower": max(found) / 1.5,
        "upper": min(found) / 0.5,
    }


def _number(value: float, digits: int = 4) -> Markup:
    """Return a number as people write it, 1.45 x 10^-4."""
    if value == 0 or 1e-2 <= abs(value) < 1e5:
        return Markup(f"{value:.{digits}g}".replace("-", "−"))
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    power = str(int(exponent)).replace("-", "−")
    mantissa = mantissa.rstrip("0").rstrip(".").replace("-", "−")
    return (
        Markup(f"10<sup>{power}</sup>") if mantissa == "1" else Markup(f"{mantissa}&#8239;×&#8239;10<sup>{power}</sup>")
    )


def _signed(error: float) -> str:
    small = round(error, 4)
    return (f"{error:+.1f} %" if abs(error) >= 1 else f"{small:+.2g} %" if small else "0 %").replace("-", "−")


def _percent(deviation: float) -> str:
    return f"±{deviation:.0f} %" if deviation >= 10 else f"±{deviation:.2g} %"


def _unit(unit: str) -> Markup:
    """Return a unit with its exponents raised."""

    def raised(exponent: re.Match[str]) -> str:
        return f"<sup>{exponent[1].replace('-', '−')}</sup>"

    return Markup(re.sub(r"\^(-?[\d.]+)", raised, str(escape(unit)))) if unit else Markup("–")


def _symbol(symbol: str) -> Markup:
    """Return a symbol with what follows its first letter lowered."""
    return escape(symbol[:1]) + Markup("<sub>{}</sub>").format(symbol[1:]) if symbol[1:] else escape(symbol)
