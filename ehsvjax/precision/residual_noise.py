"""What noise the residuals are: white or coloured, and what that does to the errors of the parameters.

White residuals have independent errors; correlated ones tell the same thing several times, so that the errors of slow
parameters are larger than the Fisher information says. The estimate stays what it is (least squares), its covariance
becomes the sandwich B S B with S = J^T Sigma J (Huber 1967; White 1980). As J does not depend on the noise, Sigma is
all that has to be estimated: by an autoregression, whose order the Bayes criterion chooses.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

_LAGS = 20
SUSPICION = 0.01
"""p-value below which residuals are taken to be correlated."""
# Samples below which no test of colour means anything.
_FEW = 50


class ResidualNoise(NamedTuple):
    """The noise that the residuals of one output look like.

    Attributes:
        p_value: of the Ljung-Box test of white noise, 20 lags; NaN where the samples are too few for it.
        coefficients: a of the autoregression r[t] = a[0] r[t-1] + ... + e[t]; empty for white noise.
        variance: of the standardised residuals.
        innovation_variance: of e; the variance itself for white noise.

    """

    p_value: float
    coefficients: Float[np.ndarray, " order"]
    variance: float
    innovation_variance: float

    @property
    def correlation_samples(self) -> float:
        """Samples that tell as much as one independent sample would about a constant."""
        return self.innovation_variance / (self.variance * (1.0 - np.sum(self.coefficients)) ** 2)

    def spectrum(self, count: int) -> Float[np.ndarray, " frequency"]:
        """Return the power at `count` frequencies of the unit circle, the variance at each for white noise."""
        filter_ = np.concatenate([[1.0], -self.coefficients])
        return self.innovation_variance / np.abs(np.fft.fft(filter_, count)) ** 2


def residual_noise(
    residuals: Float[np.ndarray, "record time"],
    measured: Bool[np.ndarray, "record time"],
    colour: str,
    absorbed: Float[np.ndarray, " lag"] | None = None,
    taken: float = 0.0,
    highest: int | None = None,
) -> ResidualNoise:
    """Return the noise of one output's standardised residuals; zero where nothing is measured.

    Args:
        residuals: standardised.
        measured: where there is a sample.
        colour: "white", "coloured" or "auto".
        absorbed: what the fit took of the autocovariance, see `absorbed_by_the_fit`; None for nothing.
        taken: samples' worth of it that the fit took: what is left says as much less of the autocovariance.
        highest: the order of the autoregression at most, zero for white noise; None for any that the record can tell.

    """
    count = int(measured.sum())
    covariance = autocovariance(residuals, measured)
    covariance = covariance if absorbed is None else covariance + absorbed
    # Where a share s was taken, correlations vary by 1/(1 - s) more than those of as many samples as are left.
    count = max(int(count * (1.0 - taken / max(count, 1)) ** 2), 1)
    p_value = _ljung_box(covariance, count)
    white = ResidualNoise(p_value, np.zeros(0), float(covariance[0]), float(covariance[0]))
    if colour == "white" or covariance[0] == 0 or (colour == "auto" and not p_value < SUSPICION):
        return white
    lags = None if highest is None else highest + 1
    coefficients, innovation_variance = _autoregression(covariance[:lags], count)
    return white._replace(coefficients=coefficients, innovation_variance=innovation_variance)


def meat(
    jacobian: Float[np.ndarray, "record time parameter"], noise: ResidualNoise
) -> Float[np.ndarray, "parameter parameter"]:
    """Return J^T Sigma J over the records, for one output; rows of J without a sample are zero."""
    flat = jacobian.reshape(int(np.prod(jacobian.shape[:-1])), jacobian.shape[-1])
    return flat.T @ _correlated(jacobian, noise).reshape(flat.shape)


def _correlated(
    jacobian: Float[np.ndarray, "record time parameter"], noise: ResidualNoise
) -> Float[np.ndarray, "record time parameter"]:
    """Return Sigma J. A Toeplitz matrix is a convolution: twice the length, so that it does not wrap round."""
    if not len(noise.coefficients):
        return noise.variance * jacobian
    from scipy.fft import irfft, next_fast_len, rfft

    length = jacobian.shape[1]
    size = next_fast_len(2 * length, real=True)
    power = noise.spectrum(size)[: size // 2 + 1, None]
    return irfft(power * rfft(jacobian, size, axis=1), size, axis=1)[:, :length]


def absorbed_by_the_fit(
    basis: Float[np.ndarray, "record time direction"],
    measured: Bool[np.ndarray, "record time"],
    noise: ResidualNoise,
    inside: Float[np.ndarray, "direction direction"],
) -> Float[np.ndarray, " lag"]:
    """Return how far the autocovariance of residuals lies below the noise's, as parameters were fitted to it.

    With H = Q Q^T the residuals have the covariance (I - H) Sigma (I - H). A noise so slow that it is like few
    independent samples loses more than the parameters' share of the samples.

    Args:
        basis: Q of one output, whose columns are orthonormal over all outputs; rows without a sample are zero.
        measured: where there is a sample.
        noise: of this output.
        inside: Q^T Sigma Q over all outputs.

    """
    through = np.where(measured[..., None], _correlated(basis, noise), 0.0)
    return _products(basis, through, measured) + _products(through - basis @ inside, basis, measured)


def _ljung_box(covariance: Float[np.ndarray, " lag"], count: int) -> float:
    """Return the p-value of white noise (Ljung & Box 1978); NaN for few samples, or none that differ."""
    from scipy.special import chdtrc

    lags = min(_LAGS, len(covariance) - 1)
    if count < _FEW or lags < 1 or covariance[0] == 0:
        return float("nan")
    correlation = covariance[1 : lags + 1] / covariance[0]
    statistic = count * (count + 2) * np.sum(correlation**2 / (count - np.arange(1, lags + 1)))
    return float(chdtrc(lags, statistic))


def _lags_tried(count: int) -> int:
    """Return the lags worth estimating: 10 log10(n), as usual, but at most an eighth of the samples."""
    return int(max(1, min(_LAGS * 2, 10 * np.log10(max(count, 2)), count // 8)))


def autocovariance(
    series: Float[np.ndarray, "record time *sequence"], measured: Bool[np.ndarray, "record time"]
) -> Float[np.ndarray, " lag"]:
    """Return the mean product of a series and itself later, summed over the sequences, for the lags worth estimating.

    Args:
        series: zero where nothing is measured.
        measured: where there is a sample.

    """
    return _products(series, series, measured)


def _products(first, second, measured) -> Float[np.ndarray, " lag"]:
    """Return the mean product of two sequences, the second later by each lag; zero where nothing is measured."""
    length, lags = measured.shape[1], _lags_tried(int(measured.sum()))
    # Slices in time are then in one piece, and are multiplied where they lie.
    first, second = np.ascontiguousarray(first), np.ascontiguousarray(second)
    covariance = []
    for lag in range(min(lags, length - 1) + 1):
        pairs = np.sum(measured[:, : length - lag] & measured[:, lag:])
        # Over all samples, not over the pairs: the sequence then stays positive definite where nothing is missing.
        share = pairs / max(np.sum(measured), 1) if measured.all() else 1.0
        product = sum(np.vdot(a[: length - lag], b[lag:]) for a, b in zip(first, second, strict=True))
        covariance.append(product / max(pairs, 1) * share)
    return np.array(covariance)


def _autoregression(covariance: Float[np.ndarray, " lag"], count: int):
    """Return the coefficients and innovation variance of the order that the Bayes criterion chooses (Levinson)."""
    coefficients, variance = np.zeros(0), covariance[0]
    best = (count * np.log(variance), coefficients, variance)
    for order in range(1, len(covariance)):
        reflection = (covariance[order] - coefficients @ covariance[order - 1 : 0 : -1]) / variance
        if not abs(reflection) < 1.0:
            break  # missing samples can make the sequence no autocovariance
        coefficients = np.concatenate([coefficients - reflection * coefficients[::-1], [reflection]])
        variance = variance * (1.0 - reflection**2)
        criterion = count * np.log(variance) + order * np.log(count)
        if criterion < best[0]:
            best = (criterion, coefficients, variance)
    return best[1], float(best[2])
