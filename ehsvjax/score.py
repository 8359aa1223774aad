"""How well outputs are reproduced: where a reading is missing, and where the simulation failed, are two things."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.record import Record


class Score(NamedTuple):
    """How well outputs are reproduced, by name of the output.

    A missing reading counts for nothing; one that the simulation fails to reach makes rmse and cost +inf and the fit
    -inf.

    Attributes:
        rmse: root of the mean squared error, in the output's unit.
        fit_percent: 100*(1 - ||y - ym|| / ||y - mean(y)||), MATLAB's fit: 100 is perfect, 0 no better than the mean.
        cost: equation (9) of the paper, the integral of the squared error, in the output's unit squared times s.

    """

    rmse: dict[str, float]
    fit_percent: dict[str, float]
    cost: dict[str, float]


def differences(
    measured: Float[np.ndarray, " time"], simulated: Float[np.ndarray, " time"]
) -> Float[np.ndarray, " time"]:
    """Return measured minus simulated: NaN where nothing was measured, +inf where the simulation is not finite."""
    return np.where(np.isnan(measured) | np.isfinite(simulated), measured - simulated, np.inf)


def score_of(records: Sequence[Record], residuals: Sequence[Mapping[str, Float[np.ndarray, "..."]]]) -> Score:
    """Return the score of each output over records; a missing reading counts for nothing."""
    names = dict.fromkeys(name for record in records for name in record.outputs)
    rmse, fit_percent, cost = {}, {}, {}
    for name in names:
        pairs = [(r, e[name]) for r, e in zip(records, residuals, strict=True) if name in r.outputs]
        errors = np.concatenate([error for _, error in pairs])
        about_mean = np.concatenate([r.outputs[name] - np.nanmean(r.outputs[name]) for r, _ in pairs])
        rmse[name] = float(np.sqrt(np.nanmean(errors**2)))
        with np.errstate(divide="ignore"):  # readings that are all alike leave no variation to explain
            relative = np.sqrt(np.nansum(errors**2) / np.nansum(about_mean**2))
        fit_percent[name] = float(100.0 * (1.0 - relative))
        cost[name] = float(sum(np.nansum(error**2) * r.sample_period for r, error in pairs))
    return Score(rmse, fit_percent, cost)
