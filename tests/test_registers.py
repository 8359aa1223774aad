"""The loop of a GPU's threads, interpreted by JAX on the CPU, against `lax.scan` and the CPU's own kernels."""

import contextlib
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax import lax

import ehsvjax
from ehsvjax import kernels, registers
from ehsvjax.effects import BANK, candidates, extended
from ehsvjax.effects.internal import contexts_of
from ehsvjax.effects.of_model import effects_for
from ehsvjax.models.model import Parameter
from ehsvjax.population import cast, population_cost, residuals
from ehsvjax.unknowns import problem_of

interpreted = functools.partial(registers.scan, interpret=True)
SAMPLES = 21
RNG = np.random.default_rng(3)
PUSH = RNG.normal(size=(2, SAMPLES)).astype(np.float32)
READINGS = {"x": RNG.normal(size=SAMPLES).astype(np.float32), "measured": RNG.uniform(size=SAMPLES) > 0.3}
INDIVIDUALS = RNG.uniform(0.5, 1.0, (37, 2)).astype(np.float32)  # more than one block, and not a multiple


def _trajectory(scan, individual, push, count=3):
    """Return a sum of squares, a count of turns, and what is kept of each sample, of an oscillator with a stop."""
    damping, start = individual[0], 2.0 * individual[1]

    def moved(k, state):
        x, v = state
        rate = -damping * v - jnp.clip(x, -0.5, 0.5 + 0.1 * damping)
        return x + 0.1 * v, v + 0.1 * rate

    def body(carry, sample):
        state, total, turns = carry
        force, reading = sample
        total = total + jnp.where(reading["measured"], (reading["x"] - state[0]) ** 2, 0.0)
        x, v = lax.fori_loop(0, count, moved, state)
        turned = turns + (v * state[1] < 0.0)
        return ((x, v + force), total, turned), {"x": state[0], "fast": jnp.abs(v) > 1.0}

    first = (start, jnp.zeros_like(start)), jnp.zeros_like(start), jnp.int32(0)
    readings = {name: values[: len(push)] for name, values in READINGS.items()}
    (_, total, turns), kept = scan(body, first, (push, readings))
    return total, turns, kept


def _same(run, *args, atol=1e-5):
    """Check that what runs with either scan gives the same."""
    expected, actual = (jax.jit(functools.partial(run, scan))(*args) for scan in (lax.scan, interpreted))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=atol), actual, expected)
    assert jax.tree.map(jnp.shape, actual) == jax.tree.map(jnp.shape, expected)


def test_one_trajectory_is_that_of_jax():
    _same(lambda scan, individual: _trajectory(scan, individual, PUSH[0]), INDIVIDUALS[0])


def test_individuals_side_by_side_are_each_its_own():
    _same(lambda scan, rows: jax.vmap(lambda row: _trajectory(scan, row, PUSH[0]))(rows), INDIVIDUALS)


def test_records_of_each_individual_have_samples_of_their_own():
    def run(scan, rows, pushes):
        return jax.vmap(lambda row: jax.vmap(lambda push: _trajectory(scan, row, push))(pushes))(rows)

    _same(run, INDIVIDUALS, PUSH)


def test_a_count_of_steps_may_be_data():
    _same(lambda scan, rows, n: jax.vmap(lambda row: _trajectory(scan, row, PUSH[0], n))(rows), INDIVIDUALS, 5)


@pytest.mark.parametrize("derivative", [jax.jacfwd, lambda f: lambda x: jax.jvp(f, (x,), (jnp.ones_like(x),))])
def test_derivatives_are_those_of_jax(derivative):
    def run(scan, rows):
        def of_real(row):
            total, _, kept = _trajectory(scan, row, PUSH[0])
            return total, kept["x"]

        return jax.vmap(derivative(of_real))(rows), derivative(jax.vmap(of_real))(rows)

    _same(run, INDIVIDUALS, atol=1e-4)


def test_derivatives_by_a_record_are_those_of_jax():
    def run(scan, push):
        return jax.jacfwd(lambda push: _trajectory(scan, INDIVIDUALS[0], push)[0])(push)

    _same(run, PUSH[0, :5])


def test_a_second_derivative_too():
    def run(scan, row):
        return jax.jacfwd(jax.jacfwd(lambda row: _trajectory(scan, row, PUSH[0])[0]))(row)

    _same(run, INDIVIDUALS[0], atol=1e-3)


@settings(max_examples=20, deadline=None)
@given(st.tuples(*[st.sampled_from([0.3, -2.0, np.nan, np.inf])] * 3))
def test_nan_is_not_lost_between_bounds(values):
    """Triton's least and greatest of two are the number where the other is NaN: a failed simulation would win."""

    def body(carry, sample):
        x, low, high = carry
        found = jnp.clip(x, low, high), jnp.maximum(x, low), jnp.minimum(low, x)
        inner = lax.cond(sample > 0.0, lambda: jnp.maximum(x, low), lambda: x)
        return carry, (*found, inner, lax.fori_loop(0, 2, lambda _, y: jnp.minimum(y, low), x))

    carry = tuple(jnp.float32(value) for value in values)
    traced = jax.make_jaxpr(body)(carry, jnp.float32(1.0))
    evaluated = functools.partial(registers._evaluate, traced.jaxpr, traced.consts)
    inside = str(jax.make_jaxpr(evaluated)(*carry, jnp.float32(1.0)))
    assert not any(f" = {name} " in inside for name in ("max", "min", "clamp"))
    expected = jax.tree.leaves(body(carry, jnp.float32(1.0)))
    np.testing.assert_array_equal(evaluated(*carry, jnp.float32(1.0)), expected)


@pytest.mark.parametrize(
    "body",
    [
        lambda carry, sample: (jnp.sort(jnp.stack([carry, sample]))[0], None),
        lambda carry, sample: (lax.erf_inv(carry), None),
        lambda carry, sample: (jax.lax.lgamma(carry), None),
    ],
)
def test_what_a_thread_cannot_hold_is_a_loop_of_jax(body):
    jaxpr = str(jax.make_jaxpr(lambda x: registers.scan(body, x, jnp.asarray(PUSH[0])))(jnp.float32(0.5)))
    assert "pallas_call" not in jaxpr
    assert "scan" in jaxpr


def test_a_state_that_is_an_array_is_a_loop_of_jax():
    def run(start):
        return registers.scan(lambda state, u: (0.5 * state + u, state[0]), start, jnp.asarray(PUSH[0]))

    assert "pallas_call" not in str(jax.make_jaxpr(run)(jnp.ones(3)))


@pytest.fixture
def on_a_gpu(monkeypatch):
    """Take the ways of a GPU, its kernels interpreted."""
    monkeypatch.setattr(kernels, "in_registers", lambda: True)
    monkeypatch.setattr(kernels, "_shaped", lambda: False)
    monkeypatch.setattr(registers, "scan", interpreted)


def _records(names, seed):
    rng = np.random.default_rng(seed)
    for count, hold in ((120, "band-limited"), (80, "linear")):
        time = 2e-3 * np.arange(count)
        readings = {name: 1e-2 * rng.normal(size=count) for name in names}
        readings[names[0]][7:11] = np.nan
        yield ehsvjax.Record(time, {"command": 1e-3 * np.sin(40.0 * time + count)}, readings, hold=hold)


@pytest.mark.parametrize(
    ("model", "outputs", "huber"),
    [
        (ehsvjax.van_der_pol(), ["position"], 1.5),
        (ehsvjax.servovalve(leakage_coefficient=1e-12), ["position", "spool"], None),
    ],
    ids=["van_der_pol", "servovalve"],
)
def test_costs_and_residuals_are_those_of_the_cpu(model, outputs, huber, request):
    records = list(_records(outputs, 5))
    problem = cast(problem_of(model, records, noise_variance=dict.fromkeys(outputs, 1e-4), huber=huber), jnp.float32)
    rows = 0.3 + 0.4 * jax.random.uniform(jax.random.key(1), (34, problem.unknowns))

    def all_of_it():
        # Other functions each time: what JAX has traced already, it does not trace again.
        costs = jax.jit(lambda problem, rows: population_cost(problem, rows))(problem, rows)
        readings = jax.jit(lambda problem, row: residuals(problem, row))(problem, rows[0])
        slopes = jax.jit(lambda problem, row: jax.jacfwd(residuals, argnums=1)(problem, row))(problem, rows[0])
        gradient = jax.jit(lambda problem, rows: jax.jacfwd(lambda r: population_cost(problem, r).sum())(rows))
        return costs, readings, slopes, gradient(problem, rows[:2])

    expected = all_of_it()
    request.getfixturevalue("on_a_gpu")
    for name, actual, wanted in zip(("costs", "residuals", "slopes", "gradient"), all_of_it(), expected, strict=True):
        scale = float(jnp.max(jnp.abs(wanted)))
        np.testing.assert_allclose(actual, wanted, rtol=1e-4, atol=1e-5 * scale, err_msg=name)


def test_a_simulation_that_fails_costs_infinity(on_a_gpu):
    record = next(iter(_records(["position"], 5)))
    problem = cast(problem_of(ehsvjax.van_der_pol(), [record], noise_variance={"position": 1e-4}), jnp.float32)
    rows = jnp.full((3, problem.unknowns), 0.5).at[1].set(jnp.nan)
    costs = population_cost(problem, rows)
    assert np.isinf(costs[1])
    assert np.isfinite(costs[jnp.array([0, 2])]).all()


@pytest.mark.parametrize(
    ("model", "every_so_many"),
    [
        (ehsvjax.servovalve(), 8),
        pytest.param(ehsvjax.servovalve(), 1, marks=pytest.mark.thorough),
        pytest.param(ehsvjax.van_der_pol(), 1, marks=pytest.mark.thorough),
    ],
)
def test_effects_stay_in_registers_and_are_known_to_triton(model, every_so_many, on_a_gpu, monkeypatch):
    monkeypatch.setattr(registers, "scan", interpreted.func)
    bank = (*BANK, *effects_for(model))
    every = candidates(model, bank, contexts_of(model), model.outputs)[::every_so_many]
    numbers = {}
    for candidate in every:
        for number in candidate.effect.parameters:
            name = candidate.parameter(number.name)
            numbers[name] = Parameter(name, name, candidate.unit(number, model), 0.015, 0.01, 0.02)
    record = next(iter(_records(["position"], 5)))
    extension = extended(model, every, numbers, float(record.time[-1]))
    problem = cast(problem_of(extension, [record], noise_variance={"position": 1e-4}), jnp.float32)
    rows = jnp.full((40, problem.unknowns), 0.5)
    with _gpu_described():
        traced = jax.jit(lambda rows: population_cost(problem, rows)).trace(rows)
        assert "pallas_call" in str(traced.jaxpr)
        assert "__gpu$xla.gpu.triton" in traced.lower(lowering_platforms=("cuda",)).as_text()


def _gpu_described():
    """Describe the GPU that is not there to a JAX that asks what it is."""
    if jax.__version_info__ < (0, 11):
        return contextlib.nullcontext()
    gpu = jax.sharding.AbstractDevice("NVIDIA H100 80GB HBM3", 132, "gpu")
    return jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), (), abstract_device=gpu))
