"""How far a simulation's own arithmetic is off, measured at every reading against the noise there.

A trajectory is stepped again at half and at a quarter of its step; what changes is the error of the first (Richardson
1911). Where an output all but jumps (a load pressure as the spool leaves its dead zone), no step of useful length knows
the few readings beside the jump: they carry no weight, as if they were missing. Where too many are off, the step is
halved. What is left in doubt is worth so little that no comparison of two explanations rests on it.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ehsvjax import kernels
from ehsvjax.population import Problem, cast, simulated

# Noise variances that the arithmetic of one simulation may be worth: what it adds to the difference of two sums of
# squares then has a deviation of .6 if their errors have nothing in common, and hardly any if they are alike.
_WORTH = 0.05
LEFT_OUT = 0.05
"""Share of an output's readings that are left out before the step is halved."""
ROUGHLY = 0.3
"""The same where it is still far from the minimum: a step of a quarter would take four times as long."""
# Of the outputs' own deviation: a noise below this is none that a sensor has, and no arithmetic is asked for it.
_LEAST_NOISE = 1e-4
# Steps a sample that are tried however long a record is; and of all records together, with which a diagnosis takes
# minutes: more are tried only within that.
_STEPS_OF_A_SAMPLE, _MOST_STEPS = 64, 2**20

OutputsAt = Callable[[int], Float[np.ndarray, "individual record time signal"]]
"""Outputs of some simulations at so many integration steps per sample."""


def finest(problem: Problem) -> bool:
    """Whether a problem is stepped as finely as is tried."""
    count, samples = np.shape(problem.samples.inputs)[:2]
    finer = 2 * int(problem.substeps)
    return finer > _STEPS_OF_A_SAMPLE and finer * count * samples > _MOST_STEPS


class Arithmetic(NamedTuple):
    """The step that a simulation needs, and what it does not know even then.

    Attributes:
        substeps: integration steps per sample.
        known: `[record, time, signal]` readings of which the simulation knows what it would show.
        worth: noise variances by which all other readings' sum of squares is off.

    """

    substeps: int
    known: Bool[np.ndarray, "record time signal"]
    worth: float


def outputs_of(
    problem: Problem, individual: Float[np.ndarray, " parameter"]
) -> Float[np.ndarray, "record time signal"]:
    """Return the outputs of one individual, in their units, in float64."""
    with kernels.double_precision():
        return np.asarray(_outputs(cast(problem, jnp.float64), np.asarray(individual, np.float64)))


_outputs = kernels.jit(simulated)


def settled_at(problem: Problem, individual: Float[np.ndarray, " parameter"], left_out: float = LEFT_OUT) -> Problem:
    """Return the problem settled for one individual, under its own noise."""
    return settled(problem, _outputs_at(problem, individual), problem.noise_variance, left_out)


def arithmetic_at(problem: Problem, individual: Float[np.ndarray, " parameter"]) -> Arithmetic:
    """Return what the arithmetic of one individual needs, under the problem's own noise."""
    return arithmetic(problem, _outputs_at(problem, individual), problem.noise_variance)


def _outputs_at(problem: Problem, individual) -> OutputsAt:
    return lambda substeps: outputs_of(replace(problem, substeps=np.int32(substeps)), individual)[None]


def settled(
    problem: Problem,
    outputs_at: OutputsAt,
    noise_variance: Float[np.ndarray, "*record signal"],
    left_out: float = LEFT_OUT,
) -> Problem:
    """Return the problem at a step at which some simulations are as good as exact; itself if it is there already.

    Readings that no such step knows are no longer measured.
    """
    found = arithmetic(problem, outputs_at, noise_variance, left_out)
    if found.substeps == problem.substeps and np.array_equal(found.known, problem.samples.measured):
        return problem
    known = problem.samples._replace(measured=found.known)
    return replace(problem, samples=known, substeps=np.int32(found.substeps))


def arithmetic(
    problem: Problem,
    outputs_at: OutputsAt,
    noise_variance: Float[np.ndarray, "*record signal"],
    left_out: float = LEFT_OUT,
) -> Arithmetic:
    """Return the step at which some simulations are as good as exact, for all of them together.

    Args:
        problem: what is simulated; the step is not made longer than it is there.
        outputs_at: simulates, in the outputs' units.
        noise_variance: of each output, in its unit squared, one for all records or one for each.
        left_out: share of each output's readings that are left out before the step is halved.

    """
    readings, measured, here = problem.samples.outputs, problem.samples.measured, int(problem.substeps)
    spread = np.array([np.var(readings[..., i][measured[..., i]]) for i in range(readings.shape[-1])])
    variance = np.maximum(np.asarray(noise_variance)[..., None, :], _LEAST_NOISE**2 * spread)
    at = cache(outputs_at)
    while True:
        # Comparisons of a failed simulation with anything are NaN: nothing is known there.
        with np.errstate(invalid="ignore", over="ignore"):
            off = np.maximum(*(np.max(np.abs(at(k * here) - at(here)), axis=0) for k in (2, 4)))
            squares = np.where(np.isfinite(off), off**2 / variance, np.inf)[measured]
        order = np.argsort(squares)
        below = np.cumsum(squares[order])
        kept = int(np.searchsorted(below, _WORTH, side="right"))
        known = np.zeros_like(measured)
        known.flat[np.flatnonzero(measured)[order[:kept]]] = True
        if few(measured & ~known, measured, left_out):
            break
        if finest(replace(problem, substeps=here)):
            # Arithmetic is worth more than it should be everywhere: to leave out some of it would hide that.
            known, kept = measured, len(order)
            break
        here *= 2
    return Arithmetic(here, known, float(below[kept - 1]) if kept else 0.0)


def few(
    some: Bool[np.ndarray, "record time signal"], measured: Bool[np.ndarray, "record time signal"], share: float
) -> bool:
    """Whether some readings are at most this share of those of each output."""
    return bool(np.all(some.sum(axis=(0, 1)) <= share * measured.sum(axis=(0, 1))))
