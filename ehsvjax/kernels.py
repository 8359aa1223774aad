"""How a time loop becomes fast on the CPU: compiled as one function, and no value computed twice.

XLA's CPU backend runs a loop as a chain of small kernel calls, at about 0.5 us a step, and fuses operations anew for
every value that a step hands on: what several of them share is computed for each. Both are put right here, for this
package's own loops alone and without a compiler flag:

- `one_kernel` marks a call so that XLA compiles it, loops included, into one native function. This is what XLA does by
  itself with loops that touch less than 1 kB (its SmallWhileLoopHoistingPass leaves the same mark).
- `stored_once` cuts a step at the values that several of its results need, and has each computed and stored once.

Measured for 1,024 individuals on one core with AVX2, ns per individual and integration step: servovalve 23 as XLA
compiles it by default, 11 in one kernel, 3.5 with shared values stored too; Van der Pol 5.8, 1.4 and 0.9.

A long function takes long to compile: `jit` asks XLA, for one program at a time, for the way that is sooner done.

On a GPU `scan` is that of `registers`. On other platforms, where a model uses an operation that such a function cannot
hold (a sort, a matrix decomposition), and where a JAX of the future lacks what this takes from its experimental parts,
everything here is the identity. So it is where the environment variable EHSVJAX_PLAIN_KERNELS is set, to find out
whether a fault is in here.
"""

import contextlib
import functools
import importlib
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

try:
    from jax.experimental.xla_metadata import set_xla_metadata
    from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var, jaxpr_as_fun

    _PLAIN = "EHSVJAX_PLAIN_KERNELS is set" if os.environ.get("EHSVJAX_PLAIN_KERNELS") else ""
except ImportError as _missing:
    ClosedJaxpr = Jaxpr = JaxprEqn = Literal = Var = Any  # type: ignore[assignment, misc]
    _PLAIN = f"JAX {jax.__version__} lacks a part ({_missing})"
if _PLAIN:
    warnings.warn(
        f"{_PLAIN}: time loops run as XLA compiles them by itself, right but several times slower", stacklevel=1
    )

# Each with the version of JAX from which on it is not asked for: XLA refuses an option that it does not know. Unless
# told otherwise LLVM takes half of the widest registers of a CPU with AVX-512; other CPUs have no wider ones.
_OPTIONS = {
    option: value
    for option, value, until in (
        ("xla_cpu_use_fusion_emitters", False, (0, 11)),
        ("xla_cpu_prefer_vector_width", 512, (0, 13)),
    )
    if jax.__version_info__ < until and not _PLAIN
}

# What recomputing a value may cost before it is stored, in operations: a store and its loads take about as long.
_WORTH_STORING = 8

# Individuals of a block: their states and the values stored in a step stay in the first-level cache.
_BLOCK = 256
# Samples that one kernel stores.
_STORED_TOGETHER = 32
# Blocks are filled up to whole vector registers, of 16 single-precision numbers at most, two at least. What is narrower
# is compiled differently, and rounds differently in the last bit.
VECTOR = 16

# Memory mappings of this process, of the 65,530 that Linux grants: without one more, XLA fails to load a program, and
# dies of it where the program is to be cached. Programs of one length of record hold some hundred.
_MAPPINGS = 40_000
_MAPPED = Path("/proc/self/maps")
# What `jit` has made: the functions whose programs can be released.
_jitted: list[Any] = []

# Primitives that XLA compiles inside one function. A sort, a scatter, or a call of a library cannot be there, nor can
# sums and matrix products, which XLA may hand to a library if they are large enough.
_COMPILED_INSIDE = frozenset(
    """
    abs acos acosh add and argmax argmin asin asinh atan atan2 atanh bitcast_convert_type broadcast_in_dim
    broadcast_to cbrt ceil clamp closed_call clz complex concatenate cond conj convert_element_type copy cos cosh
    custom_jvp_call custom_vjp_call digamma div dynamic_slice dynamic_update_slice eq erf erf_inv erfc exp exp2
    expm1 floor gather ge gt imag integer_pow iota is_finite jit le lgamma log log1p logistic lt max min mul ne
    neg nextafter not or pad pow random_bits random_split random_unwrap random_wrap real reduce_and reduce_or
    reduce_precision rem reshape rev round rsqrt scan select_n shift_left shift_right_arithmetic
    shift_right_logical sign sin sinh slice split sqrt square squeeze stack stop_gradient sub tan tanh tile
    transpose unstack while xla_metadata_value xor
    """.split()  # noqa: SIM905, a list would take a line for each
)
_FREE = frozenset(("broadcast_in_dim", "convert_element_type", "copy", "reshape", "squeeze", "stack"))
_CALLS = frozenset(("closed_call", "jit"))
_DEAR = {"div": 6, "sqrt": 8, "rsqrt": 8, "cond": 30} | dict.fromkeys(
    ("atan2", "cbrt", "cos", "erf", "exp", "expm1", "log", "log1p", "logistic", "pow", "sin", "tan", "tanh"), 20
)


def jit(function: Callable | None = None, **static) -> Callable:
    """Return the function as `jax.jit` compiles it, but sooner, and for the widest registers of a CPU.

    Measured: with XLA's older way to fuse operations the search of a servovalve takes 1.2 s to compile instead of 1.6,
    its refinement 1.7 instead of 2.6, a bench of all effects 4.6 instead of 6.1; with AVX-512 a servovalve's step takes
    2.1 ns instead of 2.7, an oscillator's as long. Results differ in rounding at most. They are options of a whole
    program: called within another, the function is compiled as that one is.

    Args:
        function: to be compiled; none: a decorator is returned.
        static: `static_argnames` or `static_argnums`, as of `jax.jit`.

    """
    if function is None:
        return functools.partial(jit, **static)
    alone, within = jax.jit(function, compiler_options=_OPTIONS, **static), jax.jit(function, **static)
    _jitted.append(alone)
    count = getattr(alone, "_cache_size", lambda: 0)

    @functools.wraps(function)
    def called(*args, **kwargs):
        if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((args, kwargs))):
            return within(*args, **kwargs)
        programs = count()
        results = alone(*args, **kwargs)
        if count() > programs:
            _release_programs()
        return results

    called.lower = alone.lower  # type: ignore[attr-defined]
    return called


def _release_programs() -> None:
    """Forget the programs of all that `jit` has made, once this process holds many memory mappings.

    A loop over hundreds of records, each of a length of its own, comes there; what is used again is compiled again.
    """
    if _MAPPED.exists() and len(_MAPPED.read_bytes().splitlines()) > _MAPPINGS:
        for function in _jitted:
            function.clear_cache()


@contextlib.contextmanager
def double_precision() -> Iterator[None]:
    """Compute in float64, and on the CPU where there is a GPU too.

    In float64 a few simulations run at a time, and each waits for its own last step: measured for a servovalve's 16,000
    steps, 1.6 ms on a CPU and 10 ms on an H200, and for a whole diagnosis 2.3 s and 44 s.
    """
    with jax.enable_x64(True), contextlib.ExitStack() as placed:
        if _platform() != "cpu":
            with contextlib.suppress(RuntimeError):  # there is none: JAX_PLATFORMS names others alone
                placed.enter_context(jax.default_device(jax.local_devices(backend="cpu")[0]))
        yield


def one_kernel(function: Callable) -> Callable:
    """Return the function compiled, wherever it is called in a compiled program, as one native function.

    The function takes and returns arrays; Python values belong into a closure.
    """
    compiled = jax.jit(function)

    def called(*args):
        # The call is traced once, for the question and for the use.
        if not _shaped() or not _compiles_inside(jax.make_jaxpr(compiled)(*args).jaxpr):
            return function(*args)
        # XLA aborts on a kernel with a parameter that nothing reads; the call inside reads them all.
        return _outlined(jax.jit(_outlined(compiled)), xla_cpu_small_call="true")(*args)

    return called


def _outlined(compiled: Callable, **marks: str) -> Callable:
    """Return the jitted function as a call that XLA does not dissolve in its surroundings."""
    return lambda *args: set_xla_metadata(compiled(*args), inlineable="false", **marks)


def in_blocks(function: Callable, rows: Float[Array, "individual parameter"]) -> Float[Array, "individual ..."]:
    """Apply a function that treats rows alike, `[n, parameter] -> [n, ...]`, in blocks that stay in the cache.

    The last row is repeated to fill the last block.
    """
    count = len(rows)
    if not _shaped() or count == 1:
        return one_kernel(function)(rows)
    blocks = -(-count // _BLOCK)
    width = max(2, -(-count // (blocks * VECTOR))) * VECTOR
    rows = filled_up(rows, blocks * width)
    if blocks == 1:
        return one_kernel(function)(rows)[:count]
    kernel = one_kernel(lambda blocks: lax.map(function, blocks))
    results = kernel(rows.reshape(blocks, width, -1))
    return results.reshape(blocks * width, *results.shape[2:])[:count]


def filled_up(rows: Float[Array, "individual parameter"], multiple: int) -> Float[Array, "filled parameter"]:
    """Return the rows with the last one repeated until their number is a multiple of this."""
    filling = jnp.broadcast_to(rows[-1:], (-len(rows) % multiple, rows.shape[1]))
    return jnp.concatenate([rows, filling])


def scan(body: Callable, carry: Any, samples: Any) -> tuple[Any, Any]:
    """Scan as `lax.scan` does, in one kernel; where something is kept of each sample, in one kernel for some of them.

    An array in which each step of a native function stores a sample is copied at each step: short it has to be.
    """
    if in_registers():
        return _registers().scan(body, carry, samples)
    kept = jax.eval_shape(lambda carry, samples: lax.scan(body, carry, samples)[1], carry, samples)
    whole = one_kernel(lambda carry, samples: lax.scan(body, carry, samples))
    if not _shaped() or not jax.tree.leaves(kept):
        return whole(carry, samples)
    count = len(jax.tree.leaves(kept)[0])
    size = max((n for n in range(8, _STORED_TOGETHER + 1) if count % n == 0), default=_STORED_TOGETHER)
    head = count - count % size
    carry, first = lax.scan(whole, carry, jax.tree.map(lambda s: s[:head].reshape(-1, size, *s.shape[1:]), samples))
    first = jax.tree.map(lambda k: k.reshape(head, *k.shape[2:]), first)
    if head == count:
        return carry, first
    carry, last = whole(carry, jax.tree.map(lambda s: s[head:], samples))
    return carry, jax.tree.map(lambda a, b: jnp.concatenate([a, b]), first, last)


def stored_once(function: Callable) -> Callable:
    """Return the function with every value that several of its results need computed once and stored.

    Meant for one step of one individual, whose values are scalars that become arrays under `vmap`.
    """

    def called(*args):
        if not _shaped():
            return function(*args)
        leaves, structure = jax.tree.flatten(args)
        traced, results = jax.make_jaxpr(
            lambda *leaves: function(*jax.tree.unflatten(structure, leaves)), return_shape=True
        )(*leaves)
        flat = jax.make_jaxpr(functools.partial(_evaluate, traced.jaxpr, traced.consts))(*leaves)
        if flat.jaxpr.effects:
            return function(*args)
        return jax.tree.unflatten(jax.tree.structure(results), _evaluate_stored(flat.jaxpr, flat.consts, leaves))

    return called


def _shaped() -> bool:
    """Whether loops are shaped for the CPU: on one, with a JAX that has what it takes."""
    return not _PLAIN and _platform() == "cpu"


def in_registers() -> bool:
    """Whether `scan` keeps each individual in the registers of a thread of its own, as on a GPU: see `registers`."""
    return not _PLAIN and _platform() in ("cuda", "gpu") and _registers() is not None


@functools.cache
def _registers() -> Any:
    # Where it is needed alone: importing Pallas takes time.
    try:
        return importlib.import_module("ehsvjax.registers")
    except ImportError as missing:
        warnings.warn(f"time loops run as XLA compiles them by itself, right but slow: {missing}", stacklevel=2)
        return None


def _platform() -> str:
    device = jax.config.jax_default_device  # type: ignore[attr-defined]
    return getattr(device, "platform", device) or jax.default_backend()


def _compiles_inside(jaxpr: Jaxpr) -> bool:
    return not jaxpr.effects and all(
        equation.primitive.name in _COMPILED_INSIDE
        and all(_compiles_inside(inner) for inner in _inner_jaxprs(equation.params))
        for equation in jaxpr.eqns
    )


def _inner_jaxprs(params: dict[str, Any]) -> list[Jaxpr]:
    found = []
    for value in params.values():
        for one in value if isinstance(value, tuple | list) else (value,):
            inner = getattr(one, "jaxpr", one)
            if isinstance(inner, Jaxpr):
                found.append(inner)
    return found


def _evaluate(jaxpr: Jaxpr, consts: Sequence[Any], *args) -> list[Any]:
    """Evaluate a jaxpr with the calls in it dissolved."""
    values = dict(zip(jaxpr.constvars, consts, strict=True)) | dict(zip(jaxpr.invars, args, strict=True))
    for equation in jaxpr.eqns:
        operands = [_value(v, values) for v in equation.invars]
        if equation.primitive.name in _CALLS:
            inner = equation.params["jaxpr"] if "jaxpr" in equation.params else equation.params["call_jaxpr"]
            results = _evaluate(inner.jaxpr, inner.consts, *operands)
        else:
            variables = [v for v in equation.invars if isinstance(v, Var)]
            results = _function(jaxpr, [equation], variables, equation.outvars)(*(values[v] for v in variables))
        values.update(zip(equation.outvars, results, strict=True))
    return [_value(v, values) for v in jaxpr.outvars]


def _function(jaxpr: Jaxpr, equations: Sequence[JaxprEqn], operands: Sequence[Var], results: Sequence[Var]) -> Callable:
    """Return some equations of a jaxpr as a function of some variables to a list of others."""
    part = jaxpr.replace(constvars=(), invars=list(operands), outvars=list(results), eqns=list(equations))
    return jaxpr_as_fun(ClosedJaxpr(part, ()))


def _value(atom: Var | Literal, values: dict[Var, Any]) -> Any:
    return atom.val if isinstance(atom, Literal) else values[atom]


class _Graph(NamedTuple):
    """Which equation of a jaxpr makes a variable, and which equations read it."""

    jaxpr: Jaxpr
    equations: Sequence[JaxprEqn]
    maker: dict[Var, int]
    readers: dict[Var, list[int]]


def _graph_of(jaxpr: Jaxpr) -> _Graph:
    maker: dict[Var, int] = {}
    readers: dict[Var, list[int]] = {}
    for i, equation in enumerate(jaxpr.eqns):
        maker.update((result, i) for result in equation.outvars)
        for operand in equation.invars:
            if isinstance(operand, Var):
                readers.setdefault(operand, []).append(i)
    return _Graph(jaxpr, jaxpr.eqns, maker, readers)


def _evaluate_stored(jaxpr: Jaxpr, consts: Sequence[Any], args: Sequence[Any]) -> list[Any]:
    """Evaluate a jaxpr by one call for each variable that is stored, each of which returns that variable alone."""
    graph = _graph_of(jaxpr)
    stored = _worth_storing(graph, {v for v in jaxpr.outvars if isinstance(v, Var) and v in graph.maker})
    values = dict(zip(jaxpr.constvars, consts, strict=True)) | dict(zip(jaxpr.invars, args, strict=True))
    for equation in jaxpr.eqns:
        for variable in equation.outvars:
            if variable in stored:
                values[variable] = _call_for(graph, variable, values)
    return [_value(v, values) for v in jaxpr.outvars]


def _call_for(graph: _Graph, variable: Var, values: dict[Var, Any]) -> Any:
    """Return the variable by a call of its own, from the values that there are already."""
    needed, operands, waiting = {graph.maker[variable]}, dict[Var, None](), [graph.maker[variable]]
    while waiting:
        for operand in graph.equations[waiting.pop()].invars:
            if isinstance(operand, Literal):
                continue
            if operand in values:
                operands[operand] = None
            elif graph.maker[operand] not in needed:
                needed.add(graph.maker[operand])
                waiting.append(graph.maker[operand])

    expression = _function(graph.jaxpr, [graph.equations[i] for i in sorted(needed)], list(operands), [variable])
    return _outlined(jax.jit(expression))(*(values[v] for v in operands))[0]


def _worth_storing(graph: _Graph, results: set[Var]) -> set[Var]:
    """Return the results, and what is worth storing besides: the most wasteful first, until none is left.

    A variable in the expressions of n stored ones is computed n times: storing it saves n - 1 times what its own
    expression costs.
    """
    stored = set(results)
    costs = [_cost(equation) for equation in graph.equations]
    while True:
        most, best = 0, None
        users = _users(graph, stored)
        expressions = _expressions(graph, stored)
        for i, equation in enumerate(graph.equations):
            for variable in equation.outvars:
                count = len(users[variable])
                if variable in stored or count < 2:
                    continue
                cost = sum(costs[j] for j in expressions[i])
                if cost >= _WORTH_STORING and (count - 1) * cost > most:
                    most, best = (count - 1) * cost, variable
        if best is None:
            return stored
        stored.add(best)


def _cost(equation: JaxprEqn) -> int:
    """Operations of one equation, roughly."""
    name = equation.primitive.name
    return 0 if name in _FREE else _DEAR.get(name, 1)


def _users(graph: _Graph, stored: set[Var]) -> dict[Var, set[Var]]:
    """Return the stored variables in whose expressions each variable is."""
    users: dict[Var, set[Var]] = {}
    for equation in reversed(graph.equations):
        for variable in equation.outvars:
            users[variable] = set()
            for reader in graph.readers.get(variable, ()):
                for result in graph.equations[reader].outvars:
                    users[variable] |= {result} if result in stored else users[result]
    return users


def _expressions(graph: _Graph, stored: set[Var]) -> list[set[int]]:
    """Return the equations that compute what each equation makes, from what is stored."""
    expressions: list[set[int]] = []
    for i, equation in enumerate(graph.equations):
        within = {i}
        for operand in equation.invars:
            if isinstance(operand, Var) and operand in graph.maker and operand not in stored:
                within |= expressions[graph.maker[operand]]
        expressions.append(within)
    return expressions
