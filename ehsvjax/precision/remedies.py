"""What would fix a direction that a record does not: nothing of this kind, another amplitude, or a longer record."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ehsvjax.population import Problem
from ehsvjax.precision.directions import Direction, Spectrum, named, parameter_root, spectrum
from ehsvjax.precision.sensitivities import ROUNDING, Sensitivities, sensitivities

# Amplitudes of the inputs that are tried, in those of the record.
_AMPLITUDES = (0.1, 0.3, 1.25, 1.5, 2.0, 3.0, 5.0, 10.0)
# A direction counts as fixed by another amplitude once it is known to this share.
_WELL_FIXED = 0.2
# Changes of the sum of squares, in noise variances, that are none.
_NO_CHANGE = 1e-6
# Times its length to which a record can be meant to be prolonged.
_LONGEST = 1000.0


def unfixed_directions(problem: Problem, found: Sensitivities, here: Spectrum) -> tuple[Direction, ...]:
    """Name the directions that are not fixed: those that no record of this kind fixes, then those that another would.

    A record of this kind has the same outputs and inputs of other amplitudes; what none of them shows is structural.
    """
    if not here.unfixed.shape[1]:
        return ()
    others: dict[float, Spectrum] = {}
    roots = [parameter_root(found)]
    for amplitude in _AMPLITUDES:
        samples = problem.samples._replace(inputs=problem.samples.inputs * amplitude)
        root = parameter_root(sensitivities(replace(problem, samples=samples), found.values))
        if np.all(np.isfinite(root)):
            roots.append(root)
            others[amplitude] = spectrum(root)
    never = _shown_by_none(roots)
    structural = [
        Direction(
            named(found.names, vector),
            float("inf"),
            structural=True,
            remedy=_structural_remedy(vector, _exchangeable(problem, found, vector)),
        )
        for vector in _sparse(never).T
    ]
    practical = []
    for vector in _besides(never, here.unfixed).T:
        apart = vector - never @ (never.T @ vector)
        apart /= np.linalg.norm(apart)
        remedy = _remedy(problem, here, others, apart)
        if _exchangeable(problem, found, vector):
            remedy += "; exchanged, the two give the same outputs"
        practical.append(Direction(named(found.names, vector), here.along(apart), remedy=remedy))
    return (*structural, *practical)


def _shown_by_none(
    roots: Sequence[Float[np.ndarray, "parameter parameter"]],
) -> Float[np.ndarray, "parameter direction"]:
    balanced = [root / max(np.linalg.norm(root), np.finfo(float).tiny) for root in roots]
    values, vectors = np.linalg.svd(np.concatenate(balanced))[1:]
    return vectors[values <= ROUNDING * values[0]].T


def _besides(
    never: Float[np.ndarray, "parameter never"], unfixed: Float[np.ndarray, "parameter unfixed"]
) -> Float[np.ndarray, "parameter chosen"]:
    """Return directions of few parameters that span, together with those of no record, what is not fixed."""
    basis, chosen = never, []
    for vector in sorted(_sparse(unfixed).T, key=lambda v: np.sum(np.abs(v) > 1e-3)):
        apart = vector - basis @ (basis.T @ vector)
        if np.linalg.norm(apart) > 1e-3 and basis.shape[1] < unfixed.shape[1]:
            chosen.append(vector)
            basis = np.column_stack([basis, apart / np.linalg.norm(apart)])
    return np.array(chosen).T.reshape(len(unfixed), len(chosen))


def _sparse(vectors: Float[np.ndarray, "parameter direction"]) -> Float[np.ndarray, "parameter direction"]:
    """Return a basis of the same space with as few parameters in each direction as elimination leaves."""
    rows = vectors.T.copy()
    for k in range(len(rows) if len(rows) > 1 else 0):
        row, pivot = (int(i) for i in np.unravel_index(np.argmax(np.abs(rows[k:])), rows[k:].shape))
        rows[[k, k + row]] = rows[[k + row, k]]
        rows[k] /= rows[k, pivot]
        others = np.arange(len(rows)) != k
        rows[others] -= np.outer(rows[others, pivot], rows[k])
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).T


def _exchangeable(problem: Problem, found: Sensitivities, vector) -> bool:
    """Return whether two parameters, the only ones of a direction, can change places without any output showing it."""
    pair = np.flatnonzero(np.abs(vector) > 1e-3)
    if len(pair) != 2:
        return False
    apart, exchanged = (np.array(found.values, float) for _ in range(2))
    # Equal values would change nothing whatever the model.
    values = np.array([1.0, 1.1]) * found.values[pair]
    apart[pair], exchanged[pair] = values, values[::-1]
    one, other = (sensitivities(problem, point).simulated for point in (apart, exchanged))
    difference = (one - other) / np.sqrt(problem.noise_variance)
    return bool(np.sum(difference[found.measured] ** 2) < _NO_CHANGE)


def _structural_remedy(vector, exchangeable: bool) -> str:
    if np.sum(np.abs(vector) > 1e-3) == 1:
        return "no record of these outputs shows it; fix it, or measure another output"
    same = ": exchanged, the two give the same outputs" if exchangeable else ""
    return f"no record of these outputs tells them apart{same}; fix one of them, or measure another output"


def _remedy(problem: Problem, here: Spectrum, others: Mapping[float, Spectrum], vector) -> str:
    """Return the least change of amplitude that fixes a direction, of those tried; or how much longer it would take."""
    peaks = np.max(np.abs(problem.samples.inputs), axis=(0, 1))
    for amplitude in sorted(others, key=lambda a: abs(np.log(a))):
        deviation = others[amplitude].along(vector)
        if deviation < _WELL_FIXED:
            inputs = ", ".join(
                f"{name} up to {amplitude * peak:.3g}"
                for name, peak in zip(problem.equations.inputs, peaks, strict=True)
            )
            return (
                f"this record does not show it; at {amplitude:g} times the amplitude ({inputs}) it would be fixed to "
                f"{100 * deviation:.2g}%"
            )
    if np.isfinite(here.along(vector)):
        times = (here.along(vector) / _WELL_FIXED) ** 2
        if times > _LONGEST:
            return (
                "this record hardly shows it, nor would another amplitude or length; fix it, or measure another output"
            )
        return f"this record hardly shows it, nor would another amplitude; {times:.2g} times its length would, to 20%"
    return "neither this record nor another amplitude shows it; fix it, or measure another output"
