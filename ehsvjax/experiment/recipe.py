"""The recipe of a plan: simulate many experiments under every explanation, search, refit the best few exactly."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from ehsvjax.checks import by_name, fits_memory, instance, several, whole
from ehsvjax.draws import check_key
from ehsvjax.excitation import sample_times
from ehsvjax.experiment.limits import Limits, as_pair
from ehsvjax.experiment.plan import Option, Pair, Plan, best_of, ranked
from ehsvjax.experiment.separation import Explained, explained, predicted, refitted_separation, separations
from ehsvjax.experiment.space import Space, as_record, kind_of, plain, realised
from ehsvjax.fit import Fit
from ehsvjax.genetic import Operators
from ehsvjax.population import cast
from ehsvjax.record import Record
from ehsvjax.search import search
from ehsvjax.unknowns import checked_variance

_POPULATION = 32
# Of the limits' range that the simulation of every explanation stays away from them.
_MARGIN = 0.05
# Separation of a pair, noise variances, that is worth half of the most that it can be worth.
_SURE = 25.0
# What breaks the limits costs this, and more by how far it does.
_BROKEN = 1.0
# Simple experiments whose separation is worked out exactly.
_SIMPLE = 3


class Question(NamedTuple):
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


def next_experiment(
    explanations: Mapping[str, Fit],
    limits: Limits,
    *,
    key: Key[Array, ""],
    can_change: Mapping[str, tuple[float, float]] | None = None,
    can_add: Mapping[str, float] | None = None,
    pairs: Sequence[Pair] | None = None,
    generations: int = 20,
) -> Plan:
    """Return the experiment that tells explanations apart best, within limits that each of them keeps.

    The genetic algorithm of this package searches experiments: kind, size, offset, pace and levels of every input, and
    the values of constants that can be changed. To first order each is judged by how many pairs of explanations it
    separates; the best and a few plain ones are then refitted exactly. A plain one that tells as much is chosen.

    Args:
        explanations: name -> fit, all to the same records; `Diagnosis.next_experiment` gives those of a diagnosis.
        limits: of the inputs, of outputs, of time.
        key: random key, `jax.random.key(0)`.
        can_change: name of a constant of the model -> (least, most) that the rig can be set to, SI.
        can_add: name of an output that could be measured too -> variance of its noise, its unit squared. It is asked
            for only where the experiment tells too little without it.
        pairs: (true, other) names of explanations that are to be told apart; by default each from every other. Where
            one contains the other, only the one that says more can be told from it.
        generations: of the search.

    Raises:
        ValueError: for fewer than two explanations, fits to different records, an input without limits, a name that the
            model does not have, or limits, variances and numbers that are none.

    """
    fits = _checked(explanations, limits)
    check_key(key)
    apart = _apart(fits, pairs)
    first = next(iter(fits.values()))
    model, so_far = first.model, first.records[0]
    whole("generations", generations, 1, 1000)
    changeable = _changeable(can_change, fits)
    added = {n: checked_variance(model, _output(model, n), v) for n, v in by_name("can_add", can_add, "").items()}
    variances = {**added, **first.noise_variance}
    watched = {name: pair for name, pair in limits.between.items() if name in model.outputs}
    outputs = tuple(name for name in model.outputs if name in variances or name in watched)
    period = so_far.sample_period
    time = sample_times((limits.duration or so_far.duration) + period, period)
    unknowns = max(len(fit.parameters) + len(fit.initial[0]) for fit in fits.values())
    sizes = f"{_POPULATION} experiments of {len(time)} samples, of which {unknowns} derivatives"
    fits_memory("limits.duration", sizes, 4.0 * _POPULATION * len(time) * len(outputs) * unknowns * len(fits))
    template = Record(
        time,
        {name: np.zeros(len(time)) for name in model.inputs},
        {name: time for name in outputs},  # stands for readings that are not yet there
        hold=so_far.hold,
        constants={**so_far.constants, **{name: first.model.nominal[name] for name in changeable}},
    )
    space = Space(
        time,
        np.array([limits.between[name] for name in model.inputs]),
        {name: np.array(pair) for name, pair in changeable.items()},
    )
    plan = None
    for measured in [first.noise_variance, variances] if added else [variances]:
        noise = {name: measured.get(name, np.inf) for name in outputs}
        question = Question(
            space,
            tuple(explained(fit, [template] * _POPULATION, noise) for fit in fits.values()),
            np.array(list(noise.values())),
            np.array([_inside(watched.get(name)) for name in outputs]),
            np.array([[(a, b) in apart for b in fits] for a in fits]),
        )
        plan = _planned(question, fits, apart, template, measured, variances, key, generations)
        if plan.chosen.probability > 0.99:
            break
    assert plan is not None
    return plan


def _planned(question: Question, fits, apart, template: Record, measured, variances, key, generations: int) -> Plan:
    """Return the plan with some outputs measured."""
    single, space = _cast(question, jnp.float32), question.space
    state, _ = search(
        jax.tree_util.Partial(_cost, single),
        key,
        unknowns=space.genes,
        population=_POPULATION,
        generations=generations,
        operators=Operators(),
        tolerance=0.0,
    )
    first = next(iter(fits.values()))
    usual = {name: template.constants[name] for name in space.constants}
    searched, simple = np.asarray(state.elites[:1], float), plain(space, usual)
    chosen = [(searched[0], False)] if state.elite_cost[0] < _BROKEN else []
    chosen += [(simple[i], True) for i in _worth_a_refit(simple, _costs(single, simple), len(space.constants))]
    if not chosen:
        raise ValueError(
            f"expected limits that some experiment keeps, got {', '.join(fits)} beyond them in all that were tried: "
            "give the inputs narrower ones, or the outputs wider ones"
        )

    def separated(record: Record, names) -> dict[Pair, float]:
        return {(a, b): refitted_separation(fits[a], fits[b], record, names, variances) for a, b in apart}

    options = []
    for genes, is_simple in chosen:
        record, words = as_record(space, genes, first.model, template)
        changed = sum(not np.isclose(record.constants[n], value) for n, value in usual.items())
        words, names = f"{words}, measure {', '.join(measured)}", tuple(measured)
        options.append(Option(words, record, names, separated(record, names), is_simple, changed))
    again, old = replace(first.records[0], outputs={}, name="again"), tuple(first.noise_variance)
    return Plan(
        chosen=best_of(options),
        options=ranked(options),
        same_again=Option("the same experiment again", again, old, separated(again, old), True, 0),
        today=separated(again, ()),
        explanations=dict(fits),
    )


def _cost(question: Question, individuals: Float[Array, "experiment gene"]) -> Float[Array, " experiment"]:
    """Return minus the share of what could be told apart of each experiment; `_BROKEN` and more beyond the limits.

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
    cost = jnp.where(worst > 0.0, _BROKEN + worst, -told / jnp.sum(question.apart))
    return jnp.where(jnp.isfinite(told), cost, jnp.inf)


_judged = jax.jit(_cost)


def _costs(question: Question, genes: Float[np.ndarray, "experiment gene"]) -> Float[np.ndarray, " experiment"]:
    """Return the costs of any number of experiments, in populations of one size, the last filled up."""
    filled = np.concatenate([genes, np.repeat(genes[-1:], -len(genes) % _POPULATION, axis=0)]).astype(np.float32)
    parts = np.split(filled, len(filled) // _POPULATION)
    return np.concatenate([np.asarray(_judged(question, jnp.asarray(part))) for part in parts])[: len(genes)]


def _worth_a_refit(genes, costs, constants: int) -> list[int]:
    """Return the best few experiments that keep the limits, of different kinds, one with all constants as so far."""
    order = [i for i in np.argsort(costs).tolist() if costs[i] < _BROKEN]
    best: dict[int, int] = {}
    for i in order:
        best.setdefault(kind_of(genes[i]), i)
    # The first of them are those with the constants as they were.
    usual = [i for i in order if i < len(genes) // (1 + 2 * constants)]
    return list(dict.fromkeys([*list(best.values())[:_SIMPLE], *usual[:1]]))


def _cast(question: Question, dtype) -> Question:
    """Return the question with its arrays on the device, in this precision."""

    def converted(tree):
        return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), tree)

    return Question(
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


def _checked(explanations, limits) -> dict[str, Fit]:
    fits = by_name("explanations", explanations, "{'nothing': fit, 'coulomb_friction': other_fit}")
    several("explanations", tuple(fits.values()), Fit, "fits as identify returns them")
    if len(fits) < 2:
        raise ValueError(f"expected two explanations or more to tell apart, got {', '.join(fits) or 'none'}")
    instance("limits", limits, Limits, "make them by ehsvjax.Limits(command=(-5e-3, 5e-3))")
    first = next(iter(fits.values()))
    for name, fit in fits.items():
        if len(fit.records) != len(first.records) or any(
            len(a) != len(b) for a, b in zip(fit.records, first.records, strict=True)
        ):
            raise ValueError(f"expected explanations that were fitted to the same records; those of {name} are others")
    model = first.model
    for name in limits.between:
        if name not in (*model.inputs, *model.outputs):
            raise ValueError(
                f"expected limits of inputs and outputs of {model.name}, {', '.join((*model.inputs, *model.outputs))}; "
                f"got {name!r}"
            )
    missing = [name for name in model.inputs if name not in limits.between]
    if missing:
        raise ValueError(
            f"expected limits of every input, got none of {', '.join(missing)}: Limits({missing[0]}=(...))"
        )
    return fits


def _apart(fits, pairs) -> list[Pair]:
    if pairs is None:
        return list(itertools.permutations(fits, 2))
    found = several("pairs", pairs, tuple, "give pairs of names, [('sensor_lag', 'input_lag')]")
    for pair in found:
        if len(pair) != 2 or pair[0] == pair[1] or not set(pair) <= set(fits):
            raise ValueError(f"expected pairs of two explanations, of {', '.join(fits)}; got {pair}")
    if not found:
        raise ValueError("expected a pair of explanations to tell apart, got none")
    return list(found)


def _changeable(can_change, fits) -> dict[str, tuple[float, float]]:
    found = {}
    for name, pair in by_name("can_change", can_change, "{'supply_pressure': (70e5, 210e5)}").items():
        for fit in fits.values():
            if name in fit.model.free:
                raise ValueError(f"expected can_change of constants, got {name}, which is identified: fix it")
            if name not in fit.model.nominal:
                raise ValueError(
                    f"expected can_change of parameters of {fit.model.name}, {', '.join(fit.model.nominal)}; "
                    f"got {name!r}"
                )
        found[name] = as_pair(name, pair)
    return found


def _output(model, name: str) -> str:
    if name not in model.outputs:
        raise ValueError(f"expected can_add of outputs of {model.name}, {', '.join(model.outputs)}; got {name!r}")
    return name
