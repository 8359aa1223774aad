"""Whether a residual depends on anything: it is innocent if it has nothing to do with any term of free form.

Noise does not know what runs along the model. So only what depends on it is misfit, however white or coloured.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.diagnosis.bench.evidence import corrected, smallest_p_values
from ehsvjax.diagnosis.bench.noise import Noise
from ehsvjax.diagnosis.bench.refits import Refits, unexplained
from ehsvjax.diagnosis.hypotheses.curves import Curve, Terms, single_waves, waves_in


class Dependence(NamedTuple):
    """Whether the residual depends on a quantity, through a place.

    Attributes:
        place: signal at which a term is added; for a sensor the output itself.
        quantity: that it depends on.
        p_value: of no dependence, this test alone.
        corrected: of all such tests together.
        explained: noise variances of the residual's sum of squares that such a term takes, more than noise would give.
        pieces: of the curve that the term was tried with.
        period: in the quantity's unit, if what shows is a term that repeats along it; else None.

    """

    place: str
    quantity: str
    p_value: float
    corrected: float
    explained: float
    pieces: int
    period: float | None


def dependences(final: Refits, noise: Noise, terms: Terms) -> tuple[Dependence, ...]:
    """Test whether a residual still depends on anything, the most significant first.

    Args:
        final: the refit whose residual is judged.
        noise: of its noise.
        terms: that it could depend on, and what they do there or near.

    """
    tests, r = _examined(final, noise, terms)
    components = [(test.basis.T @ r)[None] for test in tests]
    p_values = [float(test.p_value(c)[0]) for test, c in zip(tests, components, strict=True)]
    null = smallest_p_values([test.basis for test in tests], [test.p_value for test in tests], seed=1)
    found = [
        Dependence(
            test.curve.place, test.curve.quantity, p, corrected(p, null, len(tests)), _explained(c),
            len(test.curve.values), _period(test, c),
        )
        for test, p, c in zip(tests, p_values, components, strict=True)
    ]  # fmt: skip
    return tuple(sorted(found, key=lambda d: (d.p_value, -d.explained)))


class _Test(NamedTuple):
    """A curve, `[sample, direction]` orthonormal directions of what it can do, and those of each of its waves alone."""

    curve: Curve
    basis: Float[np.ndarray, "sample direction"]
    waves: Float[np.ndarray, "wave direction phase"]

    def p_value(self, components: Float[np.ndarray, "draw direction"]) -> Float[np.ndarray, " draw"]:
        """Judge all directions together, and each wave alone: a weak one is lost among as many directions as pieces.

        By Bonferroni's bound: half of the risk for the one, half for the waves.
        """
        together = _of_chi_square(np.sum(components**2, axis=-1), components.shape[-1])
        if not len(self.waves):
            return together
        alone = len(self.waves) * _of_chi_square(np.max(self.heights(components), axis=0), 2)
        return np.minimum(2.0 * np.minimum(together, alone), 1.0)

    def heights(self, components: Float[np.ndarray, "draw direction"]) -> Float[np.ndarray, "wave draw"]:
        """Return what each wave alone takes of the sum of squares."""
        phases = components @ np.concatenate([*self.waves], axis=1).astype(components.dtype)
        return np.sum(phases.reshape(len(components), len(self.waves), -1) ** 2, axis=-1).T


def _explained(components) -> float:
    return float(np.sum(components**2)) - components.shape[-1]


def _period(test: _Test, components) -> float | None:
    """Return the period of the strongest wave, if it alone is less likely noise than all that the curve takes."""
    if not len(test.waves):
        return None
    heights = test.heights(components)[:, 0]
    strongest = int(np.argmax(heights))
    alone = np.log(len(heights)) + _log_of_chi_square(float(heights[strongest]), 2)
    together = _log_of_chi_square(float(np.sum(components**2)), components.shape[-1])
    return float(test.curve.periods[strongest]) if alone < together else None


def _of_chi_square(value, freedom: int):
    from scipy.special import chdtrc

    return chdtrc(freedom, value)


def _log_of_chi_square(value: float, freedom: int) -> float:
    from scipy.special import gammaln

    p = float(_of_chi_square(value, freedom))
    # Far out the first term of the asymptotic series is all there is (Abramowitz and Stegun 6.5.32).
    far = (0.5 * freedom - 1.0) * np.log(0.5 * value) - 0.5 * value - gammaln(0.5 * freedom) if value > 0 else 0.0
    return float(np.log(p) if p > 0 else far)


def _examined(final: Refits, noise: Noise, terms: Terms) -> tuple[list[_Test], Float[np.ndarray, "..."]]:
    """Return the tests of curves that could show at all, and the whitened residual."""
    known, r = unexplained(final, noise.innovations)
    rows = np.split(terms.responses, np.cumsum([len(c.values) for c in terms.curves])[:-1])
    tests = []
    for curve, responses in zip(terms.curves, rows, strict=True):
        outside = noise.innovations(responses)
        norms = np.linalg.norm(outside, axis=1)
        outside -= (outside @ known) @ known.T
        basis = _basis(outside, norms)
        if basis.shape[1]:
            tests.append(_Test(curve, basis, _waves(curve, outside @ basis)))
    return tests, r


def _basis(outside, norms) -> Float[np.ndarray, "sample direction"]:
    """Return orthonormal directions of responses outside what the unknowns can do; `norms` are those with it."""
    rows = outside[norms > 0] / norms[norms > 0, None]
    vectors, values, _ = np.linalg.svd(rows.T, full_matrices=False)
    return vectors[:, values > 1e-4 * max(values[0], 1e-300)] if len(values) else np.zeros((rows.shape[1], 0))


def _waves(curve: Curve, along) -> Float[np.ndarray, "wave direction phase"]:
    """Return orthonormal directions of what each wave alone does, from what the pieces do `[piece, direction]`."""
    if not len(curve.periods):
        return np.zeros((0, along.shape[1], 2))
    alone = single_waves(waves_in(curve)) @ along
    return np.linalg.qr(np.swapaxes(alone, 1, 2))[0]
