"""Effects that a user wrote, checked before anything is searched: each has to vanish, and to do something.

What the package's own effects do is tested with the package.
"""

import itertools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from ehsvjax import kernels
from ehsvjax.diagnosis.bench.workbench import Workbench
from ehsvjax.effects import BANK
from ehsvjax.effects.effect import Candidate, Effect
from ehsvjax.effects.extended import effects_of

# Of the signal's size: a smaller change is rounding.
_NOTHING = 1e-9


def check_own_effects(bench: Workbench, bank: Sequence[Effect]) -> None:
    """Refuse a user's effect that no signal takes, that fails, that is there when absent, or that does nothing.

    Raises:
        ValueError: with the name of the effect, what came, and what to do.

    """
    there = set(effects_of(bench.fit.model))
    for effect in (e for e in bank if e not in BANK):
        places = [c for c in bench.candidates if c.effect == effect]
        if not places and not any(name.partition("@")[0] == effect.name for name in there):
            signals = ", ".join(f"{s.name} ({s.kind})" for s in bench.fit.model.signals)
            needs = f" that comes with {', '.join(effect.needs)}" if effect.needs else ""
            raise ValueError(
                f"expected a signal of kind {effect.kind}{needs} for {effect.name}; {bench.fit.model.name} has "
                f"{signals}"
            )
        for candidate in places:
            _check(bench, candidate)


def _check(bench: Workbench, candidate: Candidate) -> None:
    effect, scales = candidate.effect, bench.scales[candidate.name]
    tries = [list(n.tries(scales)) for n in effect.parameters]
    empty = [n.name for n, tried in zip(effect.parameters, tries, strict=True) if not tried]
    if empty:
        raise ValueError(f"expected {effect.name} to name values of {', '.join(empty)} to try, got none")
    gone = {n.name: n.absent if n.absent is not None else t[0] for n, t in zip(effect.parameters, tries, strict=True)}
    value, without = _finite(bench, candidate, gone)
    size = float(np.max(np.abs(value)))
    if not np.max(np.abs(without - value)) <= _NOTHING * size:
        said = ", ".join(f"{n.name} = {n.absent:g}" for n in effect.parameters if n.absent is not None)
        raise ValueError(
            f"expected {effect.name} to leave {candidate.signal} as it is at {said}, where it is said to be absent; it "
            f"is changed by up to {np.max(np.abs(without - value)):.3g}"
        )
    changes = []
    for values in itertools.product(*tries):
        with_it = _finite(bench, candidate, dict(zip(gone, values, strict=True)))[1]
        changes.append(float(np.max(np.abs(with_it - value))))
    if not max(changes) > 0.0:
        raise ValueError(
            f"expected {effect.name} to change {candidate.signal} at some value that it says to try, got no change at "
            "any: make its tries larger, or see whether it returns its value"
        )


def _finite(bench: Workbench, candidate: Candidate, own) -> tuple[np.ndarray, np.ndarray]:
    """Return what `_run` returns, if what an effect makes of a signal is finite."""
    value, changed = _run(bench, candidate, own)
    if not np.all(np.isfinite(changed)):
        said = ", ".join(f"{name} = {number:g}" for name, number in own.items())
        first = changed[~np.isfinite(changed)][0]
        raise ValueError(
            f"expected finite values of {candidate.signal} from {candidate.effect.name}, got {first} at {said}: mind "
            "divisions by zero and roots of negative numbers, also where jnp.where hides them"
        )
    return value, changed


def _run(bench: Workbench, candidate: Candidate, own) -> tuple[np.ndarray, np.ndarray]:
    """Return what runs along a signal in the first record, `[time]`, and what an effect makes of it."""
    effect, signal = candidate.effect, candidate.signal
    first = bench.records[0]
    count, period = len(first), first.sample_period
    at_input = signal in bench.fit.model.inputs
    constant = effect.kind in ("parameter", "constant")
    series = first.inputs[signal] if at_input else (
        np.full(count, bench.fit.model.nominal[signal]) if constant else bench.internal.values[signal][0, :count]
    )  # fmt: skip
    context = {} if at_input or constant else bench.internal.contexts[signal]
    along = {"time": np.arange(count) * period} | {name: series[0, :count] for name, series in context.items()}
    held = {"duration": count * period, "step_size": period, "sample_period": period}
    with kernels.double_precision():
        own = {name: jnp.float64(number) for name, number in own.items()}
        value = jnp.asarray(series)
        if at_input:
            return series, np.asarray(effect.apply(own, value, along | held))
        if not effect.memory:
            applied = jax.vmap(lambda v, context: effect.apply(own, v, context | held))(value, along)
            return series, np.broadcast_to(np.asarray(applied), series.shape)

        def follow(memory, now):
            changed, memory = effect.apply(own, now[0], now[1] | held, memory)
            return tuple(jnp.asarray(m, float) for m in memory), changed

        start = tuple(jnp.float64(m) for m in effect.memory)
        return series, np.asarray(jax.lax.scan(follow, start, (value, along))[1])
