"""The noise of records that a model does not explain yet: correlated noise told from misfit, and what gains count in.

A residual is noise and misfit together. What candidate causes could have done lies in the space of their responses, so
that noise is judged by what is left of the residual outside that space: a model's misfit is then not taken for coloured
noise, nor coloured noise for a misfit.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ehsvjax.diagnosis.bench.evidence import SIGNIFICANT
from ehsvjax.diagnosis.bench.parts import PARTS
from ehsvjax.precision.residual_noise import (
    ResidualNoise,
    autocovariance,
    meat,
    residual_noise,
)

# Directions of the candidates' responses below this share of the largest are counted as noise.
_NEGLIGIBLE = 1e-3
# Rounds of an estimate of coloured noise at most, the share by which the last one changes it, and the share of the
# change before that each may have.
_ROUNDS, _SETTLED, _SETTLING = 100, 1e-3, 0.95
# Samples of which all responses are made unit vectors at a time.
_AT_ONCE = 16384
# Standard errors of the correlation of neighbouring parts that chance seldom exceeds (one-sided, 10%).
_LASTS = 1.28


class Noise(NamedTuple):
    """What a model leaves if it is right: of each output in each record, white or an autoregression.

    Refits are by least squares, which no noise deceives; what differs between two of them counts in the variance of
    what is left along that difference. Only tests of whether noise alone is left ask for innovations.

    Attributes:
        of: `[record][signal]` the noise of each output, in its unit.
        measured: `[record, time, signal]` readings that count.

    """

    of: tuple[tuple[ResidualNoise, ...], ...]
    measured: Bool[np.ndarray, "record time signal"]

    def scaled(self, series: Float[np.ndarray, "*batch record time signal"]) -> Float[np.ndarray, "*batch sample"]:
        """Return the readings that count in deviations of the noise, one output after the other."""
        return np.moveaxis(series / np.sqrt(self.variances)[:, None], -1, -3)[..., self._in_turn]

    def innovations(self, series: Float[np.ndarray, "*batch record time signal"]) -> Float[np.ndarray, "*batch sample"]:
        """Return what is new in each reading, in its deviations: white and of variance one, if the series is noise.

        A reading needs those before it.
        """
        from scipy.signal import lfilter  # slow to import

        parts, known = [], self.known
        for i, k in np.ndindex(self.measured.shape[-1], self.measured.shape[0]):
            noise, whitened = self.of[k][i], series[..., k, :, i]
            order = len(noise.coefficients)
            if order and whitened.size:
                first = whitened[..., :order] @ _first_innovations(noise).T
                whitened = lfilter(np.concatenate([[1.0], -noise.coefficients]), 1.0, whitened, axis=-1)
                whitened[..., :order] = first
            # A copy, of which no other is needed: of all responses of a long record each is large.
            picked = whitened[..., known[k, :, i]].astype(float, copy=False)
            picked /= np.sqrt(noise.innovation_variance)
            parts.append(picked)
        return np.concatenate(parts, axis=-1) if len(parts) > 1 else parts[0]

    def gained(
        self, left: Float[np.ndarray, "record time signal"], more: Float[np.ndarray, "record time signal"]
    ) -> float:
        """Return twice the logarithm of the likelihood ratio of one explanation and another.

        Args:
            left: measured minus simulated, by the other; in the outputs' units. What is not finite is infinitely worse.
            more: by the one.

        """
        squares = [float(np.nan_to_num(r @ r, nan=np.inf)) for r in map(self.scaled, (left, more))]
        if not all(map(np.isfinite, squares)):
            return 0.0 if squares[0] == squares[1] else squares[0] - squares[1]
        return self.as_gain(squares[0] - squares[1], left, more)

    def as_gain(
        self,
        squares: float,
        left: Float[np.ndarray, "record time signal"],
        more: Float[np.ndarray, "record time signal"],
    ) -> float:
        """Return what a difference of two explanations' scaled squares says of them, as `gained` counts.

        A variance that is known of a few parts only may be larger by chance: the likelihood ratio is then Student's.
        """
        gain, parts = self.in_variances(squares, left, more)
        return gain if np.isinf(parts) else float(np.copysign(parts * np.log1p(abs(gain) / parts), gain))

    def in_variances(
        self,
        squares: float,
        left: Float[np.ndarray, "record time signal"],
        more: Float[np.ndarray, "record time signal"],
    ) -> tuple[float, float]:
        """Return a difference of two explanations' scaled squares in variances of what is left along what they differ
        by, and of how many parts these are known.

        There the better one leaves the noise, or, if it is surely more, what differs from part to part of the records.
        Where more is left, whatever is flexible gains by it, and what it gains in one part it loses in another (Wald's
        test with the covariance of White 1982, "Maximum likelihood estimation of misspecified models", and for rivals
        Vuong 1989, "Likelihood ratio tests for model selection and non-nested hypotheses", with parts for samples, as
        what is left is correlated).
        """
        both = self.scaled(left), self.scaled(more)
        change = both[0] - both[1]
        if not change.any():
            return 0.0, np.inf
        variance, parts = self.left_along(change, min(both, key=lambda r: float(r @ r)))
        return squares / variance, parts

    def left_along(
        self, direction: Float[np.ndarray, " sample"], left: Float[np.ndarray, " sample"]
    ) -> tuple[float, float]:
        """Return the variance of what an explanation leaves, along a direction, and of how many parts it is known.

        That of the noise, which is known, or, if it is more and not by chance, as it differs from part to part of the
        records: of a sum of squares of as many independent parts as the direction lies in (Satterthwaite 1946). Misfit
        lasts: parts that are like their neighbours, and not by chance, count as a first-order autoregression's do
        (Andrews & Monahan 1992, "An improved heteroskedasticity and autocorrelation consistent covariance matrix
        estimator"), so that the variance is no other with shorter parts. Both arguments are of scaled readings.
        """
        from scipy.special import chdtrc

        of_noise = self.along(direction)
        part_of, squares = self._part_of, float(direction @ direction)
        shares = np.bincount(part_of, direction**2) / squares
        parts = 1.0 / float(shares @ shares)
        sums = np.bincount(part_of, direction * left, minlength=PARTS * len(self.measured)).reshape(-1, PARTS)
        own = float(np.sum(sums**2))
        between = own / squares
        if not chdtrc(parts, parts * between / of_noise) < SIGNIFICANT:
            return of_noise, np.inf
        alike = float(np.sum(sums[:, 1:] * sums[:, :-1])) / own
        if alike * np.sqrt(parts) > _LASTS:
            between *= min((1.0 + alike) / (1.0 - alike), parts)
        return between, parts

    def of_record(self, record: int) -> "Noise":
        """Return the noise with the readings of one record alone."""
        there = np.arange(len(self.measured)) == record
        return self._replace(measured=self.measured & there[:, None, None])

    def along(self, directions: Float[np.ndarray, "*direction sample"]) -> float:
        """Return the variance of scaled noise along directions of scaled readings, their mean: one for white noise."""
        if not self.coloured:
            return 1.0
        flat = directions.reshape(-1, directions.shape[-1])
        series = np.zeros((*self._in_turn.shape, len(flat)))
        series[self._in_turn] = flat.T
        through = sum(
            float(np.trace(meat(series[i, k][None], noise))) / noise.variance
            for k, of_record in enumerate(self.of) for i, noise in enumerate(of_record)
        )  # fmt: skip
        return through / float(np.sum(flat**2))

    @property
    def known(self) -> Bool[np.ndarray, "record time signal"]:
        """Readings whose innovation can be computed: those before them are measured too."""
        known = self.measured.copy()
        for k, i in np.ndindex(*_channels(known)):
            coefficients = self.of[k][i].coefficients
            order = len(coefficients)
            for lag in range(1, order + 1):
                if coefficients[lag - 1] != 0.0:
                    known[k, lag:, i] &= self.measured[k, :-lag, i]
            # The first samples are made white together.
            known[k, :order, i] &= self.measured[k, :order, i].all()
        return known

    @property
    def variances(self) -> Float[np.ndarray, "record signal"]:
        """Of each output's noise, in its unit squared."""
        return np.array([[noise.variance for noise in of_record] for of_record in self.of])

    @property
    def innovation_variances(self) -> Float[np.ndarray, "record signal"]:
        """Of the innovations of each output, in its unit squared: of what a sample tells alone."""
        return np.array([[noise.innovation_variance for noise in of_record] for of_record in self.of])

    def variance_of(self, signal: int) -> float:
        """Return the variance of one output's noise, the mean over the records."""
        counts = self.measured[..., signal].sum(axis=1)
        return float(np.average(self.variances[:, signal], weights=np.maximum(counts, 1e-9)))

    @property
    def log_units(self) -> float:
        """Sum of the logarithms of the innovations' variances: what likelihoods of innovations leave out."""
        return float(np.sum(self.known.sum(axis=1) * np.log(self.innovation_variances)))

    @property
    def coloured(self) -> bool:
        """Whether any output's noise is correlated."""
        return any(len(noise.coefficients) for of_record in self.of for noise in of_record)

    @property
    def _in_turn(self) -> Bool[np.ndarray, "signal record time"]:
        return np.moveaxis(self.measured, -1, 0)

    @property
    def _part_of(self) -> Int[np.ndarray, " sample"]:
        """The part of its record in which each scaled reading lies, counted on from record to record."""
        counted = np.cumsum(self.measured.any(axis=-1), axis=1)
        within = np.maximum(counted - 1, 0) * PARTS // np.maximum(counted[:, -1:], 1)
        return np.broadcast_to(within + PARTS * np.arange(len(within))[:, None], self._in_turn.shape)[self._in_turn]


def _first_innovations(noise: ResidualNoise) -> Float[np.ndarray, "sample sample"]:
    """Return what makes the first samples of an autoregression, which none come before, white like the others."""
    order = len(noise.coefficients)
    covariance = np.real(np.fft.ifft(noise.spectrum(8192)))[:order]
    toeplitz = covariance[np.abs(np.subtract.outer(np.arange(order), np.arange(order)))]
    root = np.linalg.cholesky(toeplitz + 1e-12 * covariance[0] * np.eye(order))
    return np.sqrt(noise.innovation_variance) * np.linalg.inv(root)


def plain_noise(
    variances: Float[np.ndarray, "*record signal"], measured: Bool[np.ndarray, "record time signal"]
) -> Noise:
    """Return white noise of these variances, in the outputs' units squared: least squares as `identify` does them."""
    return Noise(tuple(tuple(map(_white, row)) for row in np.broadcast_to(variances, _channels(measured))), measured)


def _white(variance: float) -> ResidualNoise:
    return ResidualNoise(float("nan"), np.zeros(0), float(variance), float(variance))


def _channels(measured) -> tuple[int, int]:
    """Return the numbers of records and of signals."""
    return measured.shape[0], measured.shape[-1]


def noise_outside(
    residual: Float[np.ndarray, "record time signal"],
    measured: Bool[np.ndarray, "record time signal"],
    responses: Sequence[Float[np.ndarray, "_ record time signal"]],
) -> Noise:
    """Return the noise that is left of a residual outside the space of some responses.

    Args:
        residual: in the outputs' units; anything where nothing is measured.
        measured: where there is a sample.
        responses: of all that may have acted, each of so many: the model's sensitivities, the candidates' responses.

    """
    # An output that a record does not hold has no noise there.
    channels = [(k, i) for k, i in np.ndindex(*_channels(measured)) if measured[k, :, i].any()]
    deviation = np.ones(_channels(measured))
    for k, i in channels:
        deviation[k, i] = _deviation(residual[k, :, i][measured[k, :, i]])
    standardised = np.where(measured, residual, 0.0) / deviation[:, None]
    basis = _basis(responses, measured, deviation)
    left = standardised - _combined(basis, np.tensordot(standardised.swapaxes(1, 2), basis, 3))
    # Directions that were taken of each output, a share of one where it is in several.
    taken = {(k, i): float(np.vdot(basis[k, i], basis[k, i])) for k, i in channels}
    noises = {
        (k, i): _white(float(np.sum(left[k, :, i] ** 2)) / max(float(measured[k, :, i].sum()) - taken[k, i], 1.0))
        for k, i in channels
    }
    # What was taken of the noise depends on the noise, first taken to be white. Of slow noise most lies inside the
    # space: each round finds a part of what the last one missed. What does not settle, round by round, is misfit
    # outside the space that looks like ever slower noise. An autoregression's order only falls on the way: a change by
    # which it does may be of any size.
    noises = _completed(_of(noises, measured), basis, left, taken)
    last = dict.fromkeys(channels, np.inf)
    for _ in range(_ROUNDS):
        before, orders = noises, {c: len(noise.coefficients) for c, noise in noises.items()}
        found = _completed(_of(noises, measured), basis, left, taken, orders)
        changes = {c: abs(found[c].variance - noises[c].variance) for c in channels}
        simpler = {c: len(found[c].coefficients) < orders[c] for c in channels}
        followed = {c: simpler[c] or changes[c] <= _SETTLING * last[c] for c in channels}
        noises = {c: found[c] if followed[c] else noises[c] for c in channels}
        last = {c: np.inf if simpler[c] else changes[c] if followed[c] else 0.0 for c in channels}
        if all(_alike(noises[c], before[c]) for c in channels):
            break
    return _of({c: _times(noise, float(deviation[c]) ** 2) for c, noise in noises.items()}, measured)


def _of(noises: Mapping[tuple[int, int], ResidualNoise], measured) -> Noise:
    """Return the noise of channels `(record, signal)`."""
    records, signals = _channels(measured)
    return Noise(
        tuple(tuple(noises.get((k, i), _white(1.0)) for i in range(signals)) for k in range(records)), measured
    )  # fmt: skip


def _times(noise: ResidualNoise, square: float) -> ResidualNoise:
    return noise._replace(variance=noise.variance * square, innovation_variance=noise.innovation_variance * square)


def _completed(
    noise: Noise,
    basis: Float[np.ndarray, "record signal time direction"],
    left: Float[np.ndarray, "record time signal"],
    taken: Mapping[tuple[int, int], float],
    orders: Mapping[tuple[int, int], int] | None = None,
) -> dict[tuple[int, int], ResidualNoise]:
    """Return the noise of each channel in `taken`, from what is left of it and what was taken, as a noise tells it.

    Each is an autoregression of its order in `orders` at most; of any without them.

    By generalised least squares and its covariance: a step of restricted maximum likelihood (Patterson & Thompson 1971,
    "Recovery of inter-block information when block sizes are unequal"; Dempster, Laird & Rubin 1977, "Maximum
    likelihood from incomplete data via the EM algorithm"). Only readings whose innovation is known tell anything.
    """
    known, innovations = noise.known, noise.innovations(np.moveaxis(basis, (3, 1), (0, 3)))
    information, turned = np.linalg.eigh(innovations @ innovations.T)
    along = innovations @ noise.innovations(left)
    del innovations  # of a long record a large part of all memory
    told = information > _NEGLIGIBLE**2 * np.max(information, initial=0.0)
    root = turned[:, told] / np.sqrt(information[told])
    whole = np.where(known, left - _combined(basis, root @ (root.T @ along)), 0.0)

    def completed(k, i):
        here, unsure = known[k : k + 1, :, i], basis[k, i] @ root
        unsure[~known[k, :, i]] = 0.0
        absorbed, highest = autocovariance(unsure[None], here), None if orders is None else orders[k, i]
        return residual_noise(whole[k : k + 1, :, i], here, "auto", absorbed, taken[k, i], highest)

    return {(k, i): completed(k, i) for k, i in taken}


def _combined(basis, coefficients) -> Float[np.ndarray, "record time signal"]:
    return (basis @ coefficients).swapaxes(1, 2)


def _alike(noise: ResidualNoise, before: ResidualNoise) -> bool:
    """Whether two estimates of a noise are the same, for all that is made of them."""
    pairs = ((noise.variance, before.variance), (noise.correlation_samples, before.correlation_samples))
    return all(abs(now - then) <= _SETTLED * abs(then) for now, then in pairs)


def _basis(responses, measured, deviation) -> Float[np.ndarray, "record signal time direction"]:
    """Return orthonormal directions of the responses' space, the strongest; at most half as many as samples.

    Of a long record all responses as unit vectors would take more memory than all else: they are made piece by piece.
    """
    time = measured.shape[1]
    pieces = [slice(first, first + _AT_ONCE) for first in range(0, time, _AT_ONCE)]

    def standardised(piece: slice) -> Float[np.ndarray, "response sample"]:
        block = np.concatenate([some[:, :, piece] for some in responses], dtype=float)
        block[:, ~measured[:, piece]] = 0.0
        block /= deviation[:, None]
        return block.reshape(len(block), -1)

    norms = np.sqrt(sum(np.einsum("ij,ij->i", block, block) for block in map(standardised, pieces)))

    def unit(piece: slice) -> Float[np.ndarray, "response sample"]:
        block = standardised(piece)
        block /= np.where(norms > 0, norms, 1.0)[:, None]
        return block

    # There are many more samples than responses: their products are quicker decomposed.
    squares, combinations = np.linalg.eigh(sum(block @ block.T for block in map(unit, pieces)))
    order = np.argsort(-squares)[: measured.size // 2]
    kept = order[squares[order] > _NEGLIGIBLE**2 * np.max(squares, initial=0.0)]
    root = combinations[:, kept] / np.sqrt(squares[kept])
    records, signals = _channels(measured)
    basis = np.empty((records, signals, time, len(kept)))
    for piece in pieces:
        vectors = unit(piece).T @ root
        basis[:, :, piece] = vectors.reshape(records, -1, signals, len(kept)).swapaxes(1, 2)
    return basis


def _deviation(values) -> float:
    found = float(np.std(values)) if len(values) else 1.0
    return found if found > 0 else 1.0
