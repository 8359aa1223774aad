"""The frequencies at which a residual is strongest: where harmonic effects are looked for."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ehsvjax.diagnose.refits import Refits
from ehsvjax.diagnose.workbench import Workbench
from ehsvjax.effects.effect import Scales

# Frequencies that are tried, of the residual and of its product with a motion.
_PEAKS = 3


def with_frequencies(bench: Workbench, current: Refits) -> Workbench:
    """Return the bench with the frequencies at which a residual, and its product with a motion, are strongest."""
    measured = bench.problem.samples.measured[0, :, 0]
    period = float(bench.problem.samples.sample_period[0])
    residual = np.where(measured, current.residual[0, 0, :, 0], 0.0)
    motion = bench.problem.samples.outputs[0, :, 0] * measured
    plain = _peaks(residual, period, _PEAKS)
    modulated = plain + _peaks(residual * motion, period, _PEAKS) + _peaks(
        residual * np.gradient(motion), period, _PEAKS
    )  # fmt: skip
    scales: dict[str, Scales] = {
        name: {**own, "frequencies": plain, "modulations": modulated} for name, own in bench.scales.items()
    }
    return replace(bench, scales=scales)


def _peaks(series: Float[np.ndarray, " time"], period: float, count: int) -> tuple[float, ...]:
    """Return the frequencies of the largest peaks of a series' spectrum, rad/s, by an oversampled periodogram."""
    length = len(series)
    size = 8 * length
    power = np.abs(np.fft.rfft((series - series.mean()) * np.hanning(length), size)) ** 2
    frequency = 2.0 * np.pi * np.fft.rfftfreq(size, period)
    inside = (frequency > 3.0 / (length * period)) & (frequency < 2.0 / period)
    peak = np.zeros(len(power), bool)
    peak[1:-1] = (power[1:-1] >= power[:-2]) & (power[1:-1] > power[2:]) & inside[1:-1]
    found: list[float] = []
    for j in np.flatnonzero(peak)[np.argsort(-power[peak])]:
        # Side lobes of a stronger peak are no peaks.
        if all(abs(frequency[j] - f) > 12.0 / (length * period) for f in found):
            found.append(float(frequency[j]))
        if len(found) == count:
            break
    return tuple(found) or (2.0 * np.pi / (length * period),)
