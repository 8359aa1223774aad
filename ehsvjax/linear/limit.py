"""From steps that become ever shorter to continuous time.

With F and G the derivatives of a step of length h by the state and by what acts, x' = A x + B u is the limit of
(F - I) / h and G / h. What such a step leaves nothing of is no state but follows at once (singular perturbation,
Kokotovic 1976): the load pressure of stiff oil, a velocity in hydraulic lock.
"""

import itertools
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from ehsvjax.linear.steps import Step

# Of a step: what moves changes by this share of itself at most, what follows at once is down to this.
_SHORT, _GONE = 0.02, 0.01
_HALVINGS = 60
# Steps, each half of the one before, from which the limit is extrapolated.
_LEVELS = 5
# Times by which a number has to exceed what its last digits are off to be told from zero.
_DOUBT = 1e4
# A state that is this share of others is none of its own.
_DEPENDENT = 1e-6

Matrices = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def continuous(step_of: Callable[[float], Step], longest: float) -> tuple[list[int], Matrices]:
    """Return the places of the states that move, and A, B, C, D of these alone, in their units.

    Args:
        step_of: step size, s -> the step to first order.
        longest: step size to begin with, s.

    """
    import scipy.linalg

    step_size = longest
    for _ in range(_HALVINGS):
        decay = np.linalg.eigvals(step_of(step_size).by_state)
        if np.all((np.abs(decay - 1.0) <= _SHORT) | (np.abs(decay) <= _GONE)):
            break
        step_size *= 0.5
    sizes = [step_size * 0.5**level for level in range(_LEVELS)]
    steps = [step_of(size) for size in sizes]
    # States of unlike units become comparable.
    change = steps[0].by_state - np.eye(len(steps[0].by_state))
    _, (unit, _) = scipy.linalg.matrix_balance(change, permute=False, separate=True)
    _, basis, moving = _schur(steps[0], unit)
    kept = _independent(basis[:, :moving])
    levels = [_reduced(step, unit, size, kept) for step, size in zip(steps, sizes, strict=True)]
    a, b, c, d = (_limit(list(each)) for each in zip(*levels, strict=True))
    unit = unit[kept]
    return kept, (a * unit[:, None] / unit, b * unit[:, None], c / unit, d)


def _schur(step: Step, unit: Float[np.ndarray, " state"]):
    """Return Schur's form of a step by its state, the basis in which it has it, and how many of it move, in front."""
    import scipy.linalg

    return scipy.linalg.schur(
        step.by_state * unit / unit[:, None], output="real", sort=lambda real, imag: np.hypot(real - 1.0, imag) <= 0.5
    )


def _reduced(step: Step, unit: Float[np.ndarray, " state"], step_size: float, kept: list[int]) -> Matrices:
    """Return (F - I)/h, G/h, C and D of the states that are kept, counted in units, the others having followed at once.

    With Schur's form and Sylvester's equation: x = Q1 s + W f, where s moves and f is gone after a step.
    """
    import scipy.linalg

    form, basis, moving = _schur(step, unit)
    by_acting, seen = step.by_acting / unit[:, None], step.outputs_by_state * unit
    slow, fast = basis[:, :moving], basis[:, moving:]
    lasting, decaying = form[:moving, :moving], form[moving:, moving:]
    mixed = scipy.linalg.solve_sylvester(lasting, -decaying, -form[:moving, moving:])
    at_once = (slow @ mixed + fast) @ np.linalg.solve(np.eye(len(decaying)) - decaying, fast.T @ by_acting)
    to_kept, from_kept = slow[kept], np.linalg.inv(slow[kept])
    return (
        to_kept @ (lasting - np.eye(moving)) @ from_kept / step_size,
        to_kept @ (slow.T - mixed @ fast.T) @ by_acting / step_size,
        seen @ slow @ from_kept,
        step.outputs_by_acting + seen @ at_once,
    )


def _independent(slow: Float[np.ndarray, "state moving"]) -> list[int]:
    """Return the first states whose values tell those of all that move."""
    kept: list[int] = []
    for i, row in enumerate(slow):
        others = slow[kept]
        left = row - row @ np.linalg.pinv(others) @ others if kept else row
        if len(kept) < slow.shape[1] and np.linalg.norm(left) > _DEPENDENT:
            kept.append(i)
    return kept


def _limit(levels: list[Float[np.ndarray, "..."]]) -> Float[np.ndarray, "..."]:
    """Return the limit of what is known at steps each half of the one before; what is not told from zero there is zero.

    The last steps alone, extrapolated by an order less, say how well it is known.
    """
    limit, coarser = _extrapolated(levels), _extrapolated(levels[1:])
    return np.where(np.abs(limit) > _DOUBT * np.abs(limit - coarser), limit, 0.0)


def _extrapolated(levels: list[Float[np.ndarray, "..."]]) -> Float[np.ndarray, "..."]:
    """Return what numbers tend to that are known at steps each half of the one before (Richardson 1911)."""
    for order in range(1, len(levels)):
        levels = [b + (b - a) / (2.0**order - 1.0) for a, b in itertools.pairwise(levels)]
    return levels[0]
