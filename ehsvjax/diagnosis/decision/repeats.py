"""Whether what is left is the same each time that an experiment is made: chance does not repeat itself."""

import itertools

import numpy as np
from jaxtyping import Float

from ehsvjax.diagnosis.bench.noise import Noise
from ehsvjax.diagnosis.bench.parts import PARTS
from ehsvjax.diagnosis.bench.workbench import Workbench

# Standard deviations by which the products of chance differ from nothing.
_SAME = 3.0


def repeats_itself(bench: Workbench, residual: Float[np.ndarray, "record time signal"], noise: Noise) -> bool | None:
    """Return whether residuals of records with the same inputs are alike; None if no two have the same.

    Of independent residuals the products have no mean, however correlated each is in time; how far their sum may be
    from zero is told by how it differs from part to part.
    """
    sums = [
        np.array([part.sum() for part in np.array_split(_products(residual, noise, j, k), PARTS)])
        for j, k in itertools.combinations(range(len(bench.records)), 2)
        if _same_experiment(bench, j, k)
    ]
    if not sums:
        return None
    each = np.concatenate(sums)
    return bool(np.sum(each) > _SAME * np.sqrt(np.sum(each**2)))


def _products(residual, noise: Noise, j: int, k: int) -> Float[np.ndarray, " time"]:
    """Return the products of what two records leave at each time, in variances of their noise."""
    both = noise.measured[j] & noise.measured[k]
    scales = np.sqrt(noise.variances[j] * noise.variances[k])
    return np.sum(np.where(both, residual[j] * residual[k], 0.0) / scales, axis=-1)


def _same_experiment(bench: Workbench, j: int, k: int) -> bool:
    one, other = bench.records[j], bench.records[k]
    if len(one) != len(other) or one.constants != other.constants or one.sample_period != other.sample_period:
        return False
    return all(np.allclose(one.inputs[name], other.inputs[name]) for name in bench.fit.model.inputs)
