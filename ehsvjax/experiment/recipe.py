"""The recipe of a plan: what is asked, the experiments that tell most, and the plainest of those that tell enough."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Array, Key

from ehsvjax.checks import by_name, instance, several, whole
from ehsvjax.draws import check_key
from ehsvjax.experiment.limits import Limits, as_pair, check_limits
from ehsvjax.experiment.options import Question, options_of, separated
from ehsvjax.experiment.plan import Option, Pair, Plan, best_of, ranked
from ehsvjax.experiment.separation import as_said_so_far
from ehsvjax.fit import Fit
from ehsvjax.record import Record
from ehsvjax.unknowns import checked_variance

# Probability of telling a pair apart at which nothing more is asked for.
_CERTAIN = 0.99


def next_experiment(
    explanations: Mapping[str, Fit],
    limits: Limits,
    *,
    key: Key[Array, ""],
    can_change: Mapping[str, tuple[float, float]] | None = None,
    can_add: Mapping[str, float] | None = None,
    records: int = 1,
    own: Record | None = None,
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
        records: how many records may share the time, each from rest and with constants of its own: asked for only where
            one record tells too little.
        own: a record whose inputs are tried as well, as they are and scaled; a shorter one repeats itself.
        pairs: (true, other) names of explanations that are to be told apart; by default each from every other. Where
            one contains the other, only the one that says more can be told from it.
        generations: of the search.

    Raises:
        ValueError: for fewer than two explanations, fits to different records, an input without limits, a name that the
            model does not have, or limits, variances and numbers that are none.

    """
    fits = _checked(explanations)
    check_limits(limits, next(iter(fits.values())).model)
    check_key(key)
    apart = _apart(fits, pairs)
    first = next(iter(fits.values()))
    whole("generations", generations, 1, 1000)
    most_records = whole("records", records, 1, 10)
    changeable = _changeable(can_change, fits)
    added = {
        n: checked_variance(first.model, _output(first.model, n), v) for n, v in by_name("can_add", can_add, "").items()
    }
    variances = {**added, **first.noise_variance}
    question = Question(
        fits=fits,
        apart=apart,
        limits=limits,
        changeable=changeable,
        own=_own(own, first),
        variances=variances,
        said_so_far={name: as_said_so_far(fit) for name, fit in fits.items()},
        generations=generations,
    )
    options: list[Option] = []
    for measured, count in itertools.product(
        dict.fromkeys((tuple(first.noise_variance), tuple(variances))), dict.fromkeys((1, most_records))
    ):
        options += options_of(question, measured, count, key)
        if options and best_of(options).probability > _CERTAIN:
            break
    if not options:
        raise ValueError(
            f"expected limits that some experiment keeps, got {', '.join(fits)} beyond them in all that were tried: "
            "give the inputs narrower ones, or the outputs wider ones"
        )
    again, old = replace(first.records[0], outputs={}, name="again"), tuple(first.noise_variance)
    return Plan(
        chosen=best_of(options),
        options=ranked(options),
        same_again=Option("the same experiment again", (again,), old, separated(question, (again,), old), True, 0),
        today=separated(question, (again,), ()),
        explanations=dict(fits),
        noise_variance=variances,
    )


def _checked(explanations) -> dict[str, Fit]:
    fits = by_name("explanations", explanations, "{'nothing': fit, 'coulomb_friction': other_fit}")
    several("explanations", tuple(fits.values()), Fit, "fits as identify returns them")
    if len(fits) < 2:
        raise ValueError(f"expected two explanations or more to tell apart, got {', '.join(fits) or 'none'}")
    first = next(iter(fits.values()))
    for name, fit in fits.items():
        if len(fit.records) != len(first.records) or any(
            len(a) != len(b) for a, b in zip(fit.records, first.records, strict=True)
        ):
            raise ValueError(f"expected explanations that were fitted to the same records; those of {name} are others")
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


def _own(own, first: Fit) -> Record | None:
    """Return a record of the user's own signals, at the period of the records so far."""
    if own is None:
        return None
    instance(
        "own", own, Record, "make one with the inputs that you would try: ehsvjax.Record(time, {'command': values})"
    )
    missing = [name for name in first.model.inputs if name not in own.inputs]
    if missing:
        raise ValueError(f"expected own to have every input of {first.model.name}, got none of {', '.join(missing)}")
    still = [name for name in first.model.inputs if np.ptp(own.inputs[name]) == 0.0]
    if still:
        raise ValueError(f"expected inputs of own that move, got {', '.join(still)} that stand still")
    return own.resample(first.records[0].sample_period)


def _output(model, name: str) -> str:
    if name not in model.outputs:
        raise ValueError(f"expected can_add of outputs of {model.name}, {', '.join(model.outputs)}; got {name!r}")
    return name
