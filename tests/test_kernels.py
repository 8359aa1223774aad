"""What makes loops fast must change nothing: against the same functions without it, and against NumPy."""

import functools
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax import lax

from ehsvjax import kernels


def _pendulum(state, push=0.3):
    angle, rate = state
    torque = push - jnp.sin(angle) - 0.1 * rate * jnp.abs(rate)
    return angle + 0.01 * rate, rate + 0.01 * torque


def _shared(x, y):
    common = jnp.sin(x) * y + jnp.sqrt(jnp.abs(x)) - x / (1.0 + y * y)
    return {"a": common + x, "b": common * y, "c": (common, common - 1.0)}


def _branches(x, y):
    size = jnp.where(x > y, jax.nn.relu(x), jnp.clip(y, -0.5, 0.5))
    chosen = lax.cond(jnp.sum(x) > 0.0, jnp.cos, lambda v: v * v, size)
    counted = lax.fori_loop(0, 3, lambda i, v: v * 0.5 + i, chosen)
    return x, counted, counted + size, jnp.float32(2.0), x


def _tables(x, y):
    grid = jnp.linspace(-1.0, 1.0, 9)
    looked_up = jnp.interp(x, grid, grid**3)
    pair = jnp.stack([looked_up, y])
    return jnp.array([[0.5, 0.1], [-0.2, 0.4]]) @ pair, looked_up


def _solved(x, y):
    matrix = jnp.array([[2.0, 0.3], [0.3, 1.0]]) + x * jnp.eye(2)
    return jnp.linalg.solve(matrix, jnp.stack([x, y])), jnp.sort(jnp.stack([y, x]))


def _state_space(x, y):
    matrix = jnp.eye(24) * 0.9 + jnp.outer(jnp.arange(24.0), jnp.ones(24)) * 1e-3
    state = matrix @ (x * jnp.arange(24.0) + y)
    return jnp.sum(state), jnp.max(state), jnp.polyval(jnp.array([1.0, 2.0, 3.0]), x)


of_the_kernels = pytest.mark.skipif(bool(kernels._PLAIN), reason="loops run as XLA compiles them by itself")
EVERY_FUNCTION = pytest.mark.parametrize("function", [_shared, _branches, _tables, _solved, _state_space])
WRAPPERS = {"one kernel": kernels.one_kernel, "stored once": kernels.stored_once,
            "both": lambda f: kernels.one_kernel(kernels.stored_once(f))}  # fmt: skip


def _assert_close(actual, expected):
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=2e-6, atol=1e-5), actual, expected)


def test_a_compiled_program_may_be_part_of_another():
    @kernels.jit(static_argnames=("power",))
    def scaled(x, power=2):
        return 3.0 * x**power

    x = jnp.arange(3.0)
    np.testing.assert_allclose(scaled(x), [0.0, 3.0, 12.0])
    np.testing.assert_allclose(jax.jit(lambda x: 1.0 + scaled(x, power=3))(x), [1.0, 4.0, 25.0])
    np.testing.assert_allclose(jax.vmap(jax.grad(scaled))(x), [0.0, 6.0, 12.0])
    np.testing.assert_allclose(scaled.lower(x).compile()(x), [0.0, 3.0, 12.0])


@pytest.mark.parametrize("function", [_shared, _branches, _tables, _solved])
def test_a_program_that_is_compiled_sooner_gives_the_same(function):
    x, y = jnp.float32(0.7), jnp.float32(-1.3)
    _assert_close(kernels.jit(function)(x, y), jax.jit(function)(x, y))


@pytest.mark.parametrize("wrapper", WRAPPERS.values(), ids=WRAPPERS)
@EVERY_FUNCTION
def test_values_and_derivatives_are_those_of_the_function_itself(function, wrapper):
    x, y = jnp.linspace(-0.9, 0.8, 40), jnp.linspace(0.3, -0.7, 40)
    wrapped = wrapper(function)
    for transform in (
        lambda f: jax.jit(f)(x[0], y[0]),
        lambda f: jax.jit(jax.vmap(f))(x, y),
        lambda f: jax.jit(jax.vmap(jax.vmap(f, (None, 0)), (0, None)))(x, y),
        lambda f: jax.jit(functools.partial(jax.jvp, f))((x[1], y[1]), (jnp.float32(1.0), jnp.float32(-2.0))),
        lambda f: jax.jit(jax.jacrev(lambda v: f(v, y[2])))(x[2]),
    ):
        _assert_close(transform(wrapped), transform(function))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31), st.integers(2, 30))
def test_any_expression_graph_keeps_its_values(seed, operations):
    rng = np.random.default_rng(seed)
    choices = [(int(rng.integers(4)), *map(int, rng.integers(0, 3 + i, 2))) for i in range(operations)]
    outputs = rng.integers(0, 3 + operations, 4)

    def function(x, y, z):
        values = [x, y, z]
        for kind, i, j in choices:
            a, b = values[i], values[j]
            values.append([a + b, jnp.sin(a) * b, a - 0.5 * b, a / (2.0 + b * b)][kind])
        return [values[i] for i in outputs]

    arguments = [jnp.float32(v) for v in rng.uniform(-1, 1, 3)]
    _assert_close(jax.jit(kernels.stored_once(function))(*arguments), function(*arguments))


@of_the_kernels
def test_what_several_results_need_is_computed_once():
    def function(x):
        root = jnp.sqrt(1.0 + x * x)
        return [root + i for i in range(5)]

    traced = jax.make_jaxpr(kernels.stored_once(function))(jnp.float32(0.5))
    calls = [str(equation) for equation in traced.eqns if equation.primitive.name == "jit"]
    assert len(calls) == 6  # the root, and each result
    assert sum("sqrt" in call for call in calls) == 1


@of_the_kernels
def test_what_is_cheap_is_not_stored():
    traced = jax.make_jaxpr(kernels.stored_once(lambda x: (x + 1.0, (x + 1.0) * 2.0)))(jnp.float32(0.5))
    assert sum(equation.primitive.name == "jit" for equation in traced.eqns) == 2


@of_the_kernels
def test_loop_is_one_native_function():
    def simulate(angle):
        return lax.fori_loop(0, 1000, lambda _, state: _pendulum(state), (angle, 0.0 * angle))[0]

    angles = jnp.linspace(-1.0, 1.0, 64)
    compiled = jax.jit(lambda a: 1.0 + kernels.one_kernel(jax.vmap(simulate))(a)).lower(angles).compile()
    entry = compiled.as_text().split("ENTRY")[1]
    assert 'xla_cpu_small_call="true"' in entry
    assert " while(" not in entry
    np.testing.assert_allclose(compiled(angles), 1.0 + jax.vmap(simulate)(angles), rtol=1e-5)


@pytest.mark.parametrize("count", [1, 2, 7, 8, 31, 32, 33, 64, 97, 200])
@pytest.mark.parametrize("keeps", [True, False])
def test_scan_is_that_of_jax(count, keeps):
    def body(state, push):
        state = _pendulum(state, push)
        return state, {"angle": state[0], "both": jnp.stack(state)} if keeps else None

    pushes = jnp.sin(jnp.arange(count) * 0.1)
    start = (jnp.float32(0.2), jnp.float32(0.0))
    _assert_close(jax.jit(functools.partial(kernels.scan, body))(start, pushes), lax.scan(body, start, pushes))


@pytest.mark.parametrize("count", [1, 3, 15, 16, 17, 100, 255, 256, 257, 600])
def test_blocks_do_not_show(count):
    rows = jnp.asarray(np.random.default_rng(count).uniform(-1, 1, (count, 3)), jnp.float32)

    def cost(row):
        return lax.fori_loop(0, 20, lambda _, s: _pendulum(s, row[2]), (row[0], row[1]))[0]

    blocked = jax.jit(functools.partial(kernels.in_blocks, jax.vmap(cost)))(rows)
    assert blocked.shape == (count,)
    np.testing.assert_allclose(blocked, jax.vmap(cost)(rows), rtol=1e-5, atol=1e-6)
    # An individual costs the same to the last bit wherever it stands, so that the order does not matter.
    if count > 16:
        np.testing.assert_array_equal(
            jax.jit(functools.partial(kernels.in_blocks, jax.vmap(cost)))(rows[::-1]), blocked[::-1]
        )


def test_elsewhere_than_on_the_cpu_everything_is_the_function_itself(monkeypatch):
    monkeypatch.setattr(kernels, "_shaped", lambda: False)
    x, y = jnp.float32(0.3), jnp.float32(-0.4)
    for wrapper in WRAPPERS.values():
        assert "xla_metadata" not in str(jax.make_jaxpr(wrapper(_shared))(x, y))
    rows = jnp.ones((40, 2))
    assert "xla_metadata" not in str(jax.make_jaxpr(functools.partial(kernels.in_blocks, lambda r: r[:, 0]))(rows))


@of_the_kernels
def test_device_that_the_user_chose_is_heeded():
    assert kernels._shaped()
    with jax.default_device(jax.devices("cpu")[0]):
        assert kernels._shaped()


def test_double_precision_stays_on_the_cpu(monkeypatch):
    with kernels.double_precision():
        assert jnp.asarray(1.0).dtype == jnp.float64
        assert jax.config.jax_default_device is None
    monkeypatch.setattr(kernels, "_platform", lambda: "gpu")
    with kernels.double_precision():
        assert jnp.asarray(1.0).dtype == jnp.float64
        assert jax.config.jax_default_device == jax.local_devices(backend="cpu")[0]
    assert jax.config.jax_default_device is None

    def absent(backend):
        raise RuntimeError(f"Unknown backend {backend}")

    monkeypatch.setattr(jax, "local_devices", absent)
    with kernels.double_precision():
        assert jnp.asarray(1.0).dtype == jnp.float64
        assert jax.config.jax_default_device is None
    assert jnp.asarray(1.0).dtype == jnp.float32


_IN_ANOTHER_PROCESS = """
import sys, warnings
if "lacking" in sys.argv:
    sys.modules["jax.experimental.xla_metadata"] = None
with warnings.catch_warnings(record=True) as said:
    warnings.simplefilter("always")
    import jax, numpy as np
    import ehsvjax
    from ehsvjax import kernels
    model = ehsvjax.van_der_pol()
    record = ehsvjax.Record(0.05 * np.arange(200), {"command": np.sin(np.arange(200.0) // 20)})
    position = ehsvjax.simulate(model, record)["position"]
    record = ehsvjax.Record(record.time, record.inputs, {"position": position + 0.01 * np.cos(7.0 * np.arange(200))})
    fit = ehsvjax.identify(model, record, key=jax.random.key(0), population=16, generations=4)
print(sum("as XLA compiles them by itself" in str(w.message) for w in said))
print(repr(fit.cost))
"""


def test_without_the_kernels_all_is_the_same_but_slower():
    def run(*arguments, **environment):
        command = [sys.executable, "-c", _IN_ANOTHER_PROCESS, *arguments]
        done = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, check=True)
        return done.stdout.split()

    warned, cost = run(EHSVJAX_PLAIN_KERNELS="")
    assert warned == "0"
    for plain in (run("lacking"), run(EHSVJAX_PLAIN_KERNELS="1")):
        assert plain[0] == "1"
        assert float(plain[1]) == pytest.approx(float(cost), rel=1e-6)


@pytest.mark.skipif(not os.path.exists("/proc/self/maps"), reason="memory mappings are counted on Linux alone")
def test_a_loop_over_records_of_many_lengths_keeps_to_its_memory_mappings(monkeypatch):
    def mappings():
        with open("/proc/self/maps", "rb") as file:
            return len(file.readlines())

    def most_beyond_the_start(more):
        start = most = mappings()
        monkeypatch.setattr(kernels, "_MAPPINGS", start + more)
        total = kernels.jit(lambda values: jnp.sin(values).cumsum()[-1] + jnp.cos(values) @ values)
        for length in range(1, 40):
            values = np.linspace(0.0, 1.0, length, dtype=np.float32)
            np.testing.assert_allclose(total(values), np.sin(values).sum() + np.cos(values) @ values, rtol=1e-5)
            most = max(most, mappings())
        return most - start

    assert most_beyond_the_start(10_000) > 80
    assert most_beyond_the_start(40) < 60
