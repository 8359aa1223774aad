"""A fit as pandas tables: for a report (`to_latex`, `to_clipboard`), a spreadsheet, or another program."""

from collections.abc import Mapping

import pandas as pd

from ehsvjax.fit import Fit
from ehsvjax.record import Record
from ehsvjax.score import differences


def parameter_table(fit: Fit) -> pd.DataFrame:
    """Return all parameters of a fit's model in SI units, one row each: those that were identified, and constants.

    A standard error is +inf where the records do not fix the parameter; it is missing where nothing was identified, or
    no error can be told.
    """
    try:
        errors = fit.standard_errors
    except ValueError:
        errors = {}
    parameters, values = fit.model.parameters, fit.tied | fit.parameters
    return pd.DataFrame(
        {
            "symbol": [p.symbol for p in parameters],
            "value": [values.get(p.name, p.value) for p in parameters],
            "standard_error": [errors.get(p.name, float("nan")) for p in parameters],
            "unit": [p.unit for p in parameters],
            "lower": [p.lower if p.name in fit.parameters else float("nan") for p in parameters],
            "upper": [p.upper if p.name in fit.parameters else float("nan") for p in parameters],
            "identified": [p.name in fit.parameters for p in parameters],
        },
        index=pd.Index([p.name for p in parameters], name="parameter"),
    )


def simulation_table(fit: Fit, record: Record, initial: Mapping[str, float] | str) -> pd.DataFrame:
    """Return a record in SI units with what the fit simulates and what it leaves, beside each output that it holds."""
    simulated = fit.simulate(record, initial)
    columns = {"time": record.time, **record.inputs}
    for name, series in simulated.items():
        measured = record.outputs.get(name)
        if measured is not None:
            columns[name] = measured
        columns[f"{name}, simulated"] = series
        if measured is not None:
            columns[f"{name}, left"] = differences(measured, series)
    return pd.DataFrame(columns)
