"""Whether a residual depends on anything: it is innocent if it has nothing to do with any term of free form.

Noise does not know what runs along the model. So only what depends on it is misfit, however white or coloured.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.diagnose.curves import curve_responses, curves_of_tests
from ehsvjax.diagnose.noise import Whitening
from ehsvjax.diagnose.refits import Refits, unexplained
from ehsvjax.diagnose.significance import corrected, smallest_p_values
from ehsvjax.diagnose.workbench import Workbench


class Dependence(NamedTuple):
    """Whether the residual depends on a quantity, through a place.

    Attributes:
        place: signal at which a term is added; for a sensor the output itself.
        quantity: that it depends on.
        p_value: of no dependence, this test alone.
        corrected: of all such tests together.
        explained: noise variances of the residual's sum of squares that such a term takes, more than noise would give.
        pieces: of the curve that the term was tried with.

    """

    place: str
    quantity: str
    p_value: float
    corrected: float
    explained: float
    pieces: int


def dependences(
    bench: Workbench, final: Refits, white: Whitening, seen: Mapping[str, Float[np.ndarray, " time"]]
) -> tuple[Dependence, ...]:
    """Test whether a residual still depends on anything, the most significant first.

    Args:
        bench: the trials' workbench.
        final: the refit whose residual is judged.
        white: of its noise.
        seen: the quantities.

    """
    curves, bases, r = _examined(bench, final, white, seen)
    p_values = [float(_p_value((q.T @ r)[None])[0]) for q in bases]
    null = smallest_p_values(bases, [_p_value] * len(bases), seed=1)
    found = [
        Dependence(
            curve.place, curve.quantity, p, corrected(p, null, len(curves)),
            float(np.sum((q.T @ r) ** 2)) - q.shape[1], len(curve.pieces),
        )
        for curve, q, p in zip(curves, bases, p_values, strict=True)
    ]  # fmt: skip
    return tuple(sorted(found, key=lambda d: (d.p_value, -d.explained)))


def strongest_dependence(
    bench: Workbench, current: Refits, white: Whitening, seen: Mapping[str, Float[np.ndarray, " time"]]
) -> float:
    """Return the noise variances that a term of free form takes of a residual, more than noise would give."""
    _, bases, r = _examined(bench, current, white, seen)
    return max(float(np.sum((q.T @ r) ** 2)) - q.shape[1] for q in bases)


def _examined(bench: Workbench, final: Refits, white: Whitening, seen):
    """Return the curves that could show at all, orthonormal directions of each, and the residual, all whitened."""
    curves = curves_of_tests(bench, seen)
    known, r = unexplained(final, white)
    changes = white(curve_responses(bench, final.points[0], curves))
    rows = np.split(changes, np.cumsum([len(c.pieces) for c in curves])[:-1])
    shown = [(curve, q) for curve, part in zip(curves, rows, strict=True) if (q := _outside(known, part)).shape[1]]
    return [curve for curve, _ in shown], [q for _, q in shown], r


def _outside(known, responses) -> Float[np.ndarray, "sample independent"]:
    """Return an orthonormal basis of the responses outside what the unknowns can do."""
    norms = np.linalg.norm(responses, axis=1)
    rows = responses[norms > 0] / norms[norms > 0, None]
    rows = rows - (rows @ known) @ known.T
    vectors, values, _ = np.linalg.svd(rows.T, full_matrices=False)
    return vectors[:, values > 1e-4 * max(values[0], 1e-300)] if len(values) else np.zeros((rows.shape[1], 0))


def _p_value(components: Float[np.ndarray, "draw direction"]) -> Float[np.ndarray, " draw"]:
    from scipy.special import chdtrc

    return chdtrc(components.shape[-1], np.sum(components**2, axis=-1))
