"""The experiments that tell most with some sensors and so many records: searched to first order, then exactly.

Many are simulated under every explanation at once; the best and a few plain ones are refitted.
"""

import itertools
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ehsvjax.checks import fits_memory
from ehsvjax.excitation import sample_times
from ehsvjax.experiment.commands import OWN, Reach
from ehsvjax.experiment.limits import Limits
from ehsvjax.experiment.plan import Option, Pair
from ehsvjax.experiment.separation import Explained, as_said, explained, predicted, refitted_cost, separations
from ehsvjax.experiment.space import Space, as_records, kind_of, plain, realised
from ehsvjax.fit import Fit
from ehsvjax.genetic import Operators
from ehsvjax.population import cast
from ehsvjax.record import Record
from ehsvjax.search import costs_of, search

_POPULATION, _OPERATORS = 32, Operators()
# Of the limits' range that the simulation of every explanation stays away from them.
_MARGIN = 0.05
# Separation of a pair, noise variances, that is worth half of the most that it can be worth.
_SURE = 25.0
# What breaks the limits costs this, and more by how far it does.
_BROKEN = 1.0
# Simple experiments whose separation is worked out exactly.
_SIMPLE = 3


class Question(NamedTuple):
    """What is asked.

    Attributes:
        fits: name -> explanation.
        apart: (true, other) names of those to be told apart.
        limits: that every one of them keeps.
        changeable: name -> least and most of each constant that can be changed.
        own: record of the user's own signals, at the period of the records so far.
        variances: of the noise of each output that is measured or could be.
        said_so_far: name -> the records so far as each explanation says.
        generations: of a search.

    """

    fits: dict[str, Fit]
    apart: list[Pair]
    limits: Limits
    changeable: dict[str, tuple[float, float]]
    own: Record | None
    variances: dict[str, float]
    said_so_far: dict[str, list[Record]]
    generations: int


class Separable(NamedTuple):
    """Everything that a separation is computed from: the experiments there are, and the explanations.

    Attributes:
        space: the experiments.
        explanations: each made ready.
        noise_variance: `[signal]` of the outputs; +inf for one that is watched and not measured.
        watched: `[signal, 2]` limits of the outputs, with their margin.
        apart: `[true, other]` which explanations are to be told apart.

    """

    space: Space
    explanations: tuple[Explained, ...]
    noise_variance: Float[Any, " signal"]
    watched: Float[Any, "signal 2"]
    apart: Bool[Any, "true other"]


def options_of(question: Question, measured: Sequence[str], count: int, key) -> list[Option]:
    """Return the best experiments of so many records with some outputs measured, what they tell worked out exactly."""
    first = next(iter(question.fits.values()))
    model, so_far = first.model, first.records[0]
    period = so_far.sample_period
    time = sample_times((question.limits.duration or so_far.duration) / count + period, period)
    usual = {n: so_far.constants.get(n, model.nominal[n]) for n in question.changeable}
    template = Record(
        time, {name: np.zeros(len(time)) for name in model.inputs},
        hold=so_far.hold, constants={**so_far.constants, **usual},
    )  # fmt: skip
    told = _separable(question, [template] * count, measured)
    space = told.space
    single = _cast(told, jnp.float32)
    simple = plain(space, usual, count)
    cost = jax.tree_util.Partial(_cost, single)
    costs = costs_of(cost, simple, _POPULATION, _OPERATORS)
    state, _ = search(
        cost,
        key,
        unknowns=count * space.genes,
        population=_POPULATION,
        generations=question.generations,
        operators=_OPERATORS,
        tolerance=0.0,
    )
    chosen = [(np.asarray(state.elites[0], float), False)] if state.elite_cost[0] < _BROKEN else []
    chosen += [(simple[i], True) for i in _worth_a_refit(space, simple, costs)]
    options = []
    for genes, is_simple in chosen:
        records, words = as_records(space, genes, model, template)
        changed = sum(not np.isclose(record.constants[n], value) for n, value in usual.items() for record in records)
        changed += count - 1 + sum(name not in first.noise_variance for name in measured)
        words = f"{words}, measure {', '.join(measured)}"
        options.append(
            Option(words, records, tuple(measured), separated(question, records, measured), is_simple, changed)
        )
    return options


def _separable(question: Question, records: Sequence[Record], measured: Sequence[str]) -> Separable:
    """Make ready what all experiments are alike in: those of as many records as are given."""
    fits, limits, time = question.fits, question.limits, records[0].time
    model = next(iter(fits.values())).model
    watched = {name: pair for name, pair in limits.between.items() if name in model.outputs}
    outputs = tuple(name for name in model.outputs if name in question.variances or name in watched)
    unknowns = max(len(fit.parameters) + len(records) * len(fit.initial[0]) for fit in fits.values())
    sizes = f"{_POPULATION} experiments of {len(records)} x {len(time)} samples, of which {unknowns} derivatives"
    samples = len(records) * len(time) * len(outputs)
    fits_memory("limits.duration", sizes, 4.0 * _POPULATION * samples * unknowns * len(fits))
    # Their times stand for readings that are not yet there.
    to_be_read = [replace(record, outputs=dict.fromkeys(outputs, time)) for record in records]
    lower, upper = np.array([limits.between[name] for name in model.inputs]).T
    rates = np.array([limits.rates.get(name, math.inf) for name in model.inputs])
    own = question.own
    signals = None if own is None else np.array([np.resize(own.inputs[n], len(time)) for n in model.inputs])
    noise = {name: question.variances[name] if name in measured else np.inf for name in outputs}
    with ThreadPoolExecutor() as pool:
        ready = tuple(pool.map(lambda fit: explained(fit, to_be_read, _POPULATION, noise), fits.values()))
    return Separable(
        Space(
            time, Reach(lower, upper, rates, signals), {n: np.array(pair) for n, pair in question.changeable.items()}
        ),
        ready,
        np.array(list(noise.values())),
        np.array([_inside(watched.get(name)) for name in outputs]),
        np.array([[(a, b) in question.apart for b in fits] for a in fits]),
    )


def separated(question: Question, new: Sequence[Record], outputs: Sequence[str]) -> dict[Pair, float]:
    """Return for each pair what the records so far and new ones, of which some outputs are measured, tell exactly."""
    fits, variances = question.fits, question.variances
    said = {a: as_said(fits[a], new, tuple(variances)) for a in dict.fromkeys(a for a, _ in question.apart)}

    def by(other: str) -> dict[Pair, float]:
        return {
            (a, b): refitted_cost(fits[b], [*question.said_so_far[a], *said[a]], variances, outputs)
            for a, b in question.apart
            if b == other
        }

    with ThreadPoolExecutor() as pool:
        found = {
            pair: cost
            for each in pool.map(by, dict.fromkeys(b for _, b in question.apart))
            for pair, cost in each.items()
        }
    return {pair: found[pair] for pair in question.apart}


def _cost(question: Separable, individuals: Float[Array, "experiment gene"]) -> Float[Array, " experiment"]:
    """Return minus the share of what could be told apart of each experiment; `_BROKEN` and more beyond the limits,
    or where an output does not move.

    A pair counts by its separation over that and the one at which it is all but sure: two explanations that no
    experiment tells apart do not stand in the way of the others.
    """
    inputs, constants = realised(question.space, individuals)
    every = [predicted(one, inputs, constants) for one in question.explanations]
    pairs = itertools.permutations(range(len(every)), 2)
    each = {(a, b): jnp.maximum(separations(every[a], every[b], question.noise_variance), 0.0) for a, b in pairs}
    told = sum(jnp.where(question.apart[pair], d / (d + _SURE), 0.0) for pair, d in each.items())
    lower, upper = question.watched.T[:, None, None]
    beyond = [jnp.max(jnp.maximum(lower - one.outputs, one.outputs - upper), axis=(1, 2)) for one in every]
    worst = jnp.max(jnp.stack(beyond), axis=0)
    still = sum(jnp.any(jnp.ptp(one.outputs, axis=1) == 0.0, axis=1) for one in every)
    cost = jnp.where((worst > 0.0) | (still > 0), _BROKEN + worst + still, -told / jnp.sum(question.apart))
    return jnp.where(jnp.isfinite(told), cost, jnp.inf)


def _worth_a_refit(space: Space, genes, costs) -> list[int]:
    """Return experiments that keep the limits: the best few of different kinds, one as so far, the user's own."""
    order = [i for i in np.argsort(costs).tolist() if costs[i] < _BROKEN]
    best: dict[int, int] = {}
    for i in order:
        best.setdefault(kind_of(space, genes[i]), i)
    # The first of them are those with the constants as they were.
    usual = [i for i in order if i < len(genes) // (1 + 2 * len(space.constants))]
    own = best.get(space.inputs.kinds.index(OWN)) if OWN in space.inputs.kinds else None
    return list(dict.fromkeys([*list(best.values())[:_SIMPLE], *usual[:1], *([] if own is None else [own])]))


def _cast(question: Separable, dtype) -> Separable:
    """Return the question with its arrays on the device, in this precision."""

    def converted(tree):
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), tree)

    return Separable(
        space=converted(question.space),
        explanations=tuple(
            Explained(cast(one.problem, dtype), *converted(one[1:])) for one in question.explanations
        ),
        noise_variance=converted(question.noise_variance),
        watched=converted(question.watched),
        apart=jnp.asarray(question.apart),
    )  # fmt: skip


def _inside(pair) -> tuple[float, float]:
    if pair is None:
        return -np.inf, np.inf
    margin = _MARGIN * (pair[1] - pair[0])
    return pair[0] + margin, pair[1] - margin
