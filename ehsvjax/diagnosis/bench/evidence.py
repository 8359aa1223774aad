"""The one currency: noise variances by which explanations differ, what chance can do to them, how sure that makes one.

The thresholds by which explanations are named, told apart, and priced stand here.
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

INSEPARABLE = 3.0**2
"""Likelihood ratio (noise variances) of two refits within which they explain a record alike.

Where the true cause can be expected to be 5^2 better than a rival, chance brings the refits as near as 3^2 in 2% of
all records (3.5^2 in 7%); a rival that is 3^2 better than the true cause is as rare as three standard deviations.
"""
SIGNIFICANT = 0.002
"""Corrected p-value of a whole search below which something is taken to be there."""
PER_NUMBER = 4.0
"""Noise variances that each number of an effect must bring, so that more numbers are no advantage."""
_DRAWS = 20_000
# Draws below which a share of all draws says little.
_FEW = 20


def smallest_p_values(
    bases: Sequence[Float[np.ndarray, "sample _"]],
    p_values: Sequence[Callable[[Float[np.ndarray, "draw _"]], Float[np.ndarray, " draw"]]],
    seed: int,
) -> Float[np.ndarray, " draw"]:
    """Return the smallest of all tests' p-values in each of many draws of noise, ascending.

    Args:
        bases: of each test, the orthonormal directions along which it looks at whitened residuals. Tests of like
            directions are correlated: all look at the same draw.
        p_values: of each test, from the components of noise along its directions.
        seed: of the draws.

    """
    from scipy.linalg import qr

    smallest = np.ones(_DRAWS)
    if not len(bases):
        return smallest
    # In place: of a long record every copy of them is large.
    every = np.concatenate([basis.T for basis in bases]).T
    _, spread = qr(every, mode="raw", overwrite_a=True, check_finite=False)
    # Single precision is far more than draws are worth, and half the time.
    noise = np.random.default_rng(seed).standard_normal((_DRAWS, len(spread)), dtype=np.float32)
    components = noise @ np.asarray(spread, np.float32)
    edges = np.cumsum([basis.shape[1] for basis in bases])[:-1]
    for part, p_value in zip(np.split(components, edges, axis=1), p_values, strict=True):
        smallest = np.minimum(smallest, p_value(part))
    return np.sort(smallest)


def corrected(p: float, smallest: Float[np.ndarray, " draw"], tests: int) -> float:
    """Return how often the best of all tests is as good under noise alone; beyond the draws by Bonferroni's bound."""
    share = float(np.searchsorted(smallest, p, side="right")) / len(smallest)
    few = _FEW / len(smallest)
    return share if share >= few else min(tests * p, few)


def probabilities(deficits: Sequence[float]) -> Float[np.ndarray, " explanation"]:
    """Return how probable each of several explanations is, from how far it is behind the best, in noise variances.

    Prices are part of a deficit, as logarithms of what is known beforehand; twice the logarithm of a likelihood ratio
    is what is left of it (Bayes' theorem at the refits).
    """
    weights = np.exp(-0.5 * (np.asarray(deficits, dtype=float) - np.min(deficits)))
    return weights / np.sum(weights)
