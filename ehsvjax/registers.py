"""How a time loop becomes fast on a GPU: one kernel, a thread for each individual, the state in its registers.

XLA launches a kernel or more for every step of a loop, at 30 to 40 us a step, and carries the state through the GPU's
memory in between. Here the loop is inside the kernel (Pallas, lowered to Triton): an individual's state, its parameters
and its sum of squares never leave its thread, and the record is read from the cache that all threads share.

Axis legend: lane, the individuals, and for a derivative its directions beside them; time.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jax.custom_derivatives import SymbolicZero
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal

# Lanes of a block, and its warps of 32 threads.
_LANES, _WARPS = 32, 1

# Primitives that Triton compiles, if they are of scalars.
_COMPILED_INSIDE = frozenset(
    """
    abs acos acosh add add_any and asin asinh atan atan2 atanh broadcast_in_dim cbrt ceil clamp closed_call cond
    convert_element_type copy cos cosh custom_jvp_call div eq exp exp2 expm1 floor ge gt integer_pow is_finite jit le
    log log1p logistic lt max min mul ne neg nextafter not or pow rem reshape rsqrt scan select_n sign sin sinh sqrt
    square squeeze stop_gradient sub tan tanh while xor
    """.split()  # noqa: SIM905, a list would take a line for each
)
_CALLS = frozenset(("closed_call", "custom_jvp_call", "jit"))


class _Step(NamedTuple):
    """One step of scalars, `(constants, carry, sample) -> (carry, kept)`: its jaxpr, and the length of the carry."""

    jaxpr: Jaxpr
    carried: int

    def __call__(self, constants: Sequence[Any], carry: Sequence[Any], sample: Sequence[Any]) -> tuple[list, list]:
        results = _evaluate(self.jaxpr, constants, *carry, *sample)
        return results[: self.carried], results[self.carried :]


def scan(body: Callable, carry: Any, samples: Any, interpret: bool = False) -> tuple[Any, Any]:
    """Scan as `lax.scan` does, in one kernel for all individuals that `vmap` sets side by side.

    Where the body holds more of an individual than scalars, or what Triton does not know, it is `lax.scan` itself.

    Args:
        body: `(carry, sample) -> (carry, kept)`.
        carry: pytree of scalars.
        samples: pytree of arrays `[time]`.
        interpret: let JAX interpret the kernel, slowly and on any device.

    """
    start, carry_structure = jax.tree.flatten(jax.tree.map(jnp.asarray, carry))
    columns, sample_structure = jax.tree.flatten(samples)

    def flat(start, sample):
        carry = jax.tree.unflatten(carry_structure, start)
        return body(carry, jax.tree.unflatten(sample_structure, sample))

    sample = [jax.ShapeDtypeStruct(column.shape[1:], column.dtype) for column in columns]
    traced, (_, kept) = jax.make_jaxpr(flat, return_shape=True)(start, sample)
    if not columns or not start or not _compiles_inside(traced.jaxpr):
        return lax.scan(body, carry, samples)
    step = _Step(traced.jaxpr, len(start))
    last, series = _loop(step, interpret)(list(traced.consts), start, columns)
    return jax.tree.unflatten(carry_structure, last), jax.tree.unflatten(jax.tree.structure(kept), series)


def _compiles_inside(jaxpr: Jaxpr) -> bool:
    variables: list[Any] = [*jaxpr.constvars, *jaxpr.invars]
    for equation in jaxpr.eqns:
        variables += [*equation.invars, *equation.outvars]
    return (
        not jaxpr.effects
        and all(variable.aval.shape == () for variable in variables)
        and all(equation.primitive.name in _COMPILED_INSIDE for equation in jaxpr.eqns)
        and all(_compiles_inside(inner.jaxpr) for equation in jaxpr.eqns for inner in _inner(equation).values())
    )


def _inner(equation: JaxprEqn) -> dict[Any, ClosedJaxpr]:
    """Return the jaxprs in an equation's parameters, by the parameter's name, with a place where it holds several."""
    found = {}
    for name, value in equation.params.items():
        several = isinstance(value, tuple | list)
        for place, one in enumerate(value if several else (value,)):
            if isinstance(one, ClosedJaxpr):
                found[(name, place if several else None)] = one
    return found


def _loop(step: _Step, interpret: bool) -> Callable:
    """Return `(constants, carry, columns) -> (carry, kept)`, lists; its derivative is such a loop too."""
    on_lanes = _on_lanes(step, interpret)

    @jax.custom_jvp
    def loop(constants, start, columns):
        last, kept = on_lanes(constants, [leaf[None] for leaf in start], columns)
        return [leaf[0] for leaf in last], [leaf[:, 0] for leaf in kept]

    @functools.partial(loop.defjvp, symbolic_zeros=True)
    def differential(primals, tangents):
        constants, start, columns = primals
        (moving, by_moving), (driven, by_driven) = (_moving(t) for t in (tangents[0], tangents[2]))
        real = [i for i, leaf in enumerate(start) if _is_real(leaf)]
        by_real = [
            jnp.zeros_like(start[i]) if isinstance(tangents[1][i], SymbolicZero) else tangents[1][i] for i in real
        ]

        def body(both, samples):
            (carry, by_carry), (sample, by_sample) = both, samples

            def moved(given, carried, read):
                return step(
                    _placed(constants, moving, given), _placed(carry, real, carried), _placed(sample, driven, read)
                )

            at = [constants[i] for i in moving], [carry[i] for i in real], [sample[i] for i in driven]
            (carry, _), (by_carry, by_kept) = jax.jvp(moved, at, (by_moving, by_carry, by_sample))
            return (carry, [by_carry[i] for i in real]), [tangent for tangent in by_kept if _is_real(tangent)]

        (_, by_last), by_kept = scan(body, (start, by_real), (columns, by_driven), interpret=interpret)
        # A loop of its own: the values may not depend on how many directions there are.
        last, kept = loop(constants, start, columns)
        places = [i for i, leaf in enumerate(kept) if _is_real(leaf)]
        return (last, kept), (_placed(_standing(last), real, by_last), _placed(_standing(kept), places, by_kept))

    return loop


def _moving(tangents: Sequence[Any]) -> tuple[list[int], list[Any]]:
    """Return which tangents are not zero throughout, and these."""
    places = [i for i, tangent in enumerate(tangents) if not isinstance(tangent, SymbolicZero)]
    return places, [tangents[i] for i in places]


def _is_real(leaf) -> bool:
    return jnp.issubdtype(leaf.dtype, jnp.floating)


def _placed(values: Sequence[Any], places: Sequence[int], others: Sequence[Any]) -> list[Any]:
    """Return the values with others in some places."""
    return [others[places.index(i)] if i in places else value for i, value in enumerate(values)]


def _standing(values: Sequence[Any]) -> list[Any]:
    """Return the tangents of counts and truth values, which have none."""
    return [np.zeros(jnp.shape(value), jax.dtypes.float0) for value in values]


def _on_lanes(step: _Step, interpret: bool) -> Callable:
    """Return the loop of a carry `[lane]`, with constants `[lane]` or the same for all; `vmap` makes more lanes."""

    @custom_vmap
    def loop(constants, start, columns):
        return _in_kernel(step, constants, start, columns, interpret)

    @loop.def_vmap
    def side_by_side(count, batched, constants, start, columns):
        given, own = (constants, start, columns), tuple(batched)
        if any(batched[2]):
            # Records, each with samples of its own: few, one kernel after another.
            each = [
                loop(*jax.tree.map(lambda leaf, own, k=k: leaf[k] if own else leaf, given, own)) for k in range(count)
            ]
            results = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
            return results, jax.tree.map(lambda _: True, results)
        lanes = start[0].shape[-1]

        def in_a_row(leaf, own):
            leaf = leaf if own else jnp.broadcast_to(leaf, (count, *leaf.shape))
            return jnp.broadcast_to(leaf.reshape(count, -1), (count, lanes)).reshape(-1)

        constants = [
            in_a_row(leaf, own) if own or leaf.ndim else leaf for leaf, own in zip(constants, batched[0], strict=True)
        ]
        last, kept = loop(constants, jax.tree.map(in_a_row, start, batched[1]), columns)
        last = [leaf.reshape(count, lanes) for leaf in last]
        kept = [jnp.moveaxis(leaf.reshape(-1, count, lanes), 1, 0) for leaf in kept]
        return (last, kept), jax.tree.map(lambda _: True, (last, kept))

    return loop


def _in_kernel(step: _Step, constants, start, columns, interpret: bool) -> tuple[list, list]:
    """Return the last carry `[lane]`, and what is kept `[time, lane]`."""
    given, count = [*constants, *start], len(columns[0])
    alike = [leaf.ndim == 0 for leaf in given]
    lanes = len(start[0])
    blocks = -(-lanes // _LANES)
    # Memory has no single bits.
    stored = [column.astype(jnp.int8) if column.dtype == bool else column for column in columns]

    def kernel(*refs):
        given_refs, refs = refs[: len(given)], refs[len(given) :]
        column_refs, result_refs = refs[: len(columns)], refs[len(columns) :]
        values = [ref[0] if one else ref[...] for ref, one in zip(given_refs, alike, strict=True)]
        shared, own = values[: len(constants)], values[len(constants) :]

        def one_sample(time, carry):
            sample = [ref[time].astype(column.dtype) for ref, column in zip(column_refs, columns, strict=True)]
            of_lane = jax.vmap(
                lambda constants, carry: step(constants, carry, sample),
                in_axes=([None if leaf.ndim == 0 else 0 for leaf in shared], 0),
            )
            carry, kept = of_lane(shared, carry)
            for ref, leaf in zip(result_refs[len(carry) :], kept, strict=True):
                ref[time, :] = leaf
            return carry

        last = lax.fori_loop(0, count, one_sample, own)
        for ref, leaf in zip(result_refs, last, strict=False):
            ref[...] = leaf

    def block(*shape):
        return pl.BlockSpec((*shape, _LANES), lambda i: (*(0 for _ in shape), i))

    def whole(size):
        return pl.BlockSpec((size,), lambda i: (0,))

    types: list[Any] = [variable.aval for variable in step.jaxpr.outvars]
    carried, kept = types[: step.carried], types[step.carried :]
    filled = [
        leaf.reshape(1) if one else jnp.pad(leaf, (0, blocks * _LANES - lanes), mode="edge")
        for leaf, one in zip(given, alike, strict=True)
    ]
    results = pl.pallas_call(
        kernel,
        grid=(blocks,),
        in_specs=[*(whole(1) if one else block() for one in alike), *(whole(count) for _ in stored)],
        out_specs=[*(block() for _ in carried), *(block(count) for _ in kept)],
        out_shape=[
            *(jax.ShapeDtypeStruct((blocks * _LANES,), aval.dtype) for aval in carried),
            *(jax.ShapeDtypeStruct((count, blocks * _LANES), aval.dtype) for aval in kept),
        ],
        compiler_params=triton.CompilerParams(num_warps=_WARPS),
        interpret=interpret,
    )(*filled, *stored)
    return [r[:lanes] for r in results[: step.carried]], [r[:, :lanes] for r in results[step.carried :]]


def _evaluate(jaxpr: Jaxpr, constants: Sequence[Any], *args) -> list[Any]:
    """Evaluate a jaxpr as JAX does on every device: Triton's least of a number and a NaN is the number, not NaN."""
    values = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*constants, *args], strict=True))

    def value(atom):
        return atom.val if isinstance(atom, Literal) else values[atom]

    for equation in jaxpr.eqns:
        operands, inner, name = [value(atom) for atom in equation.invars], _inner(equation), equation.primitive.name
        if name in _NAN_LOST and _is_real(equation.outvars[0].aval):
            results = [_NAN_LOST[name](*operands)]
        elif name in _CALLS:
            (called,) = inner.values()
            results = _evaluate(called.jaxpr, called.consts, *operands)
        else:
            params = dict(equation.params)
            for (parameter, place), one in inner.items():
                with_nan = jax.make_jaxpr(functools.partial(_evaluate, one.jaxpr, one.consts))(*one.in_avals)
                several = place is not None
                params[parameter] = tuple(_placed(params[parameter], [place], [with_nan])) if several else with_nan
            found = equation.primitive.bind(*operands, **params)
            results = found if equation.primitive.multiple_results else [found]
        values.update(zip(equation.outvars, results, strict=True))
    return [value(atom) for atom in jaxpr.outvars]


def _greatest(a, b):
    return lax.select(lax.bitwise_or(lax.ge(a, b), lax.ne(a, a)), a, b)


def _least(a, b):
    return lax.select(lax.bitwise_or(lax.le(a, b), lax.ne(a, a)), a, b)


_NAN_LOST: dict[str, Callable] = {
    "max": _greatest,
    "min": _least,
    "clamp": lambda least, a, most: _least(_greatest(a, least), most),
}
