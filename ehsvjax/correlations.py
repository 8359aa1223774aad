"""Correlations of what a model leaves: with itself, which noise has none of, and with what drove the model."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.precision.standard_errors import quantile_of

# Lags of which a band counts the products of two correlations.
_BAND_LAGS = 200


class Correlation(NamedTuple):
    """Correlations by lag in samples, and the half width of the band that holds them by chance."""

    lags: Float[np.ndarray, " lag"]
    values: Float[np.ndarray, " lag"]
    band: float


def with_itself(residual: Float[np.ndarray, " time"], lags: int, level: float = 0.99) -> Correlation:
    """Return the autocorrelation of a residual at 1 to `lags`, with the band of white noise; NaN is missing."""
    after, standard = np.arange(1, lags + 1), _standardised(residual)
    values = np.array([_mean_product(standard, standard, int(lag)) for lag in after])
    return Correlation(after.astype(float), values, quantile_of(level) / np.isfinite(residual).sum() ** 0.5)


def with_input(
    residual: Float[np.ndarray, " time"], driving: Float[np.ndarray, " time"], lags: int, level: float = 0.99
) -> Correlation:
    """Return the correlation of a residual with an input `lag` samples before, from -`lags` to `lags`.

    A residual after the input (lag above 0) is dynamics that the model lacks; one before it is feedback, or a delay
    that the model has too much of. Both may be correlated in themselves, which widens the band (Bartlett 1935).
    """
    every, left, drive = np.arange(-lags, lags + 1), _standardised(residual), _standardised(driving)
    values = np.array([_mean_product(left, drive, int(lag)) for lag in every])
    reach = min(_BAND_LAGS, len(residual) // 4)
    products = [_mean_product(left, left, k) * _mean_product(drive, drive, k) for k in range(1, reach + 1)]
    variance = max(1.0 + 2.0 * float(np.sum(products)), 1.0) / float(np.isfinite(residual).sum())
    return Correlation(every.astype(float), values, quantile_of(level) * variance**0.5)


def _standardised(series: np.ndarray) -> np.ndarray:
    return (series - np.nanmean(series)) / (np.nanstd(series) or 1.0)


def _mean_product(after: np.ndarray, before: np.ndarray, lag: int) -> float:
    """Return the correlation of one standardised series with another, `lag` samples before it."""
    if lag < 0:
        after, before, lag = before, after, -lag
    pairs = after[lag:] * before[: len(before) - lag]
    # Over all samples, not over the pairs: where nothing is missing the sequence is then positive definite.
    return float(np.nanmean(pairs)) * len(pairs) / len(after)
