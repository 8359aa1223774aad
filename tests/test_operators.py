"""Genetic operators against closed forms, and the contract that all of them keep."""

import functools
import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import stats

from ehsvjax import operators

INDIVIDUALS, PARAMETERS = 5, 3
DRAWS = 20_000
LEAST_P = 1e-4  # keys are fixed, so a test passes or fails for ever

# Most programs here run once and take far longer to compile than to run.
quick_jit = functools.partial(
    jax.jit,
    compiler_options={"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True},
)


def _mutating_mothers(mutation):
    return lambda key, mothers, fathers: mutation(key, mothers, 0.3)


def _selecting_by_first_parameter(selection):
    return lambda key, mothers, fathers: selection(key, mothers[:, 0], 50)


# Every operator that changes individuals, as (key, mothers, fathers) -> individuals
RENEWALS = {
    "blend": operators.blend_crossover(1.0),
    "line": operators.line_crossover(1.0),
    "simulated_binary": operators.simulated_binary_crossover(),
    "differential": operators.differential_crossover(1.0),
    "gaussian": _mutating_mothers(operators.gaussian_mutation(1.0, 0.5, 0.8)),
    "polynomial": _mutating_mothers(operators.polynomial_mutation(1.0, 0.5)),
    "immigrants": lambda key, mothers, fathers: operators.immigrants(key, mothers, 1),
    "elitism": lambda key, mothers, fathers: operators.elitism(
        key, mothers, mothers[:, 0], fathers[:1], fathers[:1, 0]
    )[0],
}
SELECTIONS = {
    "tournament": operators.tournament_selection(),
    "rank": operators.rank_selection(),
    "roulette": operators.roulette_selection(),
}
OPERATORS = RENEWALS | {name: _selecting_by_first_parameter(select) for name, select in SELECTIONS.items()}
OVER_KEYS = {name: quick_jit(jax.vmap(operator, (0, None, None))) for name, operator in OPERATORS.items()}

SEEDS = st.integers(0, 2**32 - 1)
IN_CUBE = st.sampled_from([0.0, 1.0]) | st.floats(0.0, 1.0, width=32)
POPULATIONS = hnp.arrays(np.float32, (INDIVIDUALS, PARAMETERS), elements=IN_CUBE)
COST = st.sampled_from([0.0, 1.0, np.nan, np.inf, -np.inf]) | st.floats(width=32)


def _repeated(row):
    return jnp.tile(jnp.asarray(row), (DRAWS, 1))


def _drawn(operator, *arguments):
    """Children or mutants of the same parents, many times, in double precision."""
    return np.asarray(quick_jit(operator)(jax.random.key(0), *arguments), np.float64)


def _selected(selection, cost, count, seed=0):
    return np.asarray(
        quick_jit(selection, static_argnames="count")(jax.random.key(seed), jnp.asarray(cost), count=count)
    )


def _frequencies(selection, cost, seed=0):
    return np.bincount(_selected(selection, cost, DRAWS, seed), minlength=len(cost))


def _assert_drawn_from(frequencies, probabilities):
    frequencies, probabilities = np.asarray(frequencies), np.asarray(probabilities)
    possible = probabilities > 0
    assert not frequencies[~possible].any()
    expected = frequencies.sum() * probabilities[possible] / probabilities.sum()
    assert stats.chisquare(frequencies[possible], expected).pvalue > LEAST_P


def _assert_valid(name, result, population):
    result = np.asarray(result)
    if name in SELECTIONS:
        assert result.shape == (50,)
        assert np.issubdtype(result.dtype, np.integer)
        assert ((result >= 0) & (result < len(population))).all()
    else:
        assert result.shape == population.shape
        assert result.dtype == population.dtype
        assert ((result >= 0) & (result <= 1)).all()  # false for NaN, too


# The contract of all operators


@pytest.mark.parametrize("name", OPERATORS)
def test_contract_of_all_operators(name):
    operator, compiled = OPERATORS[name], jax.jit(OPERATORS[name])
    mothers, fathers = jax.random.uniform(jax.random.key(1), (2, INDIVIDUALS, PARAMETERS))
    keys = jax.random.split(jax.random.key(2), 4000)
    result = compiled(keys[0], mothers, fathers)
    _assert_valid(name, result, mothers)
    np.testing.assert_array_equal(compiled(keys[0], mothers, fathers), result)
    np.testing.assert_allclose(operator(keys[0], mothers, fathers), result, atol=1e-5)
    over_keys = OVER_KEYS[name](keys, mothers, fathers)
    np.testing.assert_allclose(over_keys[0], result, atol=1e-5)
    np.testing.assert_allclose(over_keys[-1], compiled(keys[-1], mothers, fathers), atol=1e-5)
    assert len(np.unique(over_keys, axis=0)) > 1


@pytest.mark.parametrize(("shape", "double"), [((1, 1), False), ((2, 1), False), ((5, 3), True)])
def test_contract_of_all_operators_for_small_populations_and_in_double_precision(shape, double):
    apply_all = quick_jit(lambda *arrays: {name: operator(*arrays) for name, operator in OPERATORS.items()})
    with jax.enable_x64(double):
        mothers, fathers = jax.random.uniform(jax.random.key(1), (2, *shape), jnp.float64 if double else jnp.float32)
        for name, result in apply_all(jax.random.key(0), mothers, fathers).items():
            _assert_valid(name, result, mothers)


@pytest.mark.parametrize("name", [*RENEWALS, "simulated_binary_boldest"])
@settings(max_examples=60, deadline=None)
@given(seed=SEEDS, mothers=POPULATIONS, fathers=POPULATIONS)
def test_bounds_are_kept(name, seed, mothers, fathers):
    operator = RENEWALS.get(name) or operators.simulated_binary_crossover(0.0, 1.0)
    _assert_valid(name, jax.jit(operator)(jax.random.key(seed), mothers, fathers), mothers)


@pytest.mark.parametrize("name", ["blend", "line", "simulated_binary", "gaussian", "polynomial"])
def test_individuals_and_parameters_vary_alike_and_independently(name):
    # Equal parents in all places: no place has a distribution of its own, and no two places move together;
    # nor do two parameters, but on the line.
    mothers, fathers = jnp.tile(jnp.asarray([[[0.35, 0.4, 0.45]], [[0.55, 0.6, 0.65]]]), (1, INDIVIDUALS, 1))
    children = np.asarray(OVER_KEYS[name](jax.random.split(jax.random.key(3), 4000), mothers, fathers))
    for parameter in range(PARAMETERS):
        first, last = children[:, 0, parameter], children[:, -1, parameter]
        assert stats.ks_2samp(first, last).pvalue > LEAST_P
        assert stats.spearmanr(first, last).pvalue > LEAST_P
    offset = np.abs(children[:, 0] - np.array([0.45, 0.5, 0.55]))
    assert (stats.spearmanr(offset[:, 0], offset[:, 1]).pvalue > LEAST_P) == (name != "line")


# Crossover


def test_blend_crossover_is_uniform_on_the_widened_interval():
    # Parents 0.4 and 0.6, extent 0.5: uniform on [0.3, 0.7], mean 0.5, variance 0.4^2 / 12.
    first, second = _drawn(operators.blend_crossover(0.5), _repeated([0.4, 0.6]), _repeated([0.6, 0.4])).T
    for child in (first, second):
        assert stats.kstest(child, stats.uniform(0.3, 0.4).cdf).pvalue > LEAST_P
        assert abs(child.mean() - 0.5) < 5 * math.sqrt(0.4**2 / 12 / DRAWS)
        np.testing.assert_allclose(child.var(), 0.4**2 / 12, rtol=0.03)
    assert stats.pearsonr(first, second).pvalue > LEAST_P


def test_line_crossover_moves_all_parameters_by_one_uniform_weight():
    mother, father = np.array([0.4, 0.7, 0.5]), np.array([0.6, 0.3, 0.4])
    children = _drawn(operators.line_crossover(0.25), _repeated(mother), _repeated(father))
    weights = (children - mother) / (father - mother)
    np.testing.assert_allclose(weights, np.tile(weights[:, :1], 3), atol=3e-6)
    assert stats.kstest(weights[:, 0], stats.uniform(-0.25, 1.5).cdf).pvalue > LEAST_P


@pytest.mark.parametrize("distribution_index", [2.0, 8.0])
def test_simulated_binary_crossover_has_the_spread_factor_of_its_source(distribution_index):
    crossover = operators.simulated_binary_crossover(distribution_index, 1.0)
    offset = _drawn(crossover, _repeated([0.49]), _repeated([0.51]))[:, 0] - 0.5

    def cumulative(spread):
        spread = np.maximum(spread, 1e-30)
        power = distribution_index + 1
        return np.where(spread <= 1, spread**power / 2, 1 - spread**-power / 2)

    assert stats.kstest(np.abs(offset) / 0.01, cumulative).pvalue > LEAST_P
    assert stats.binomtest(int((offset > 0).sum()), DRAWS).pvalue > LEAST_P
    assert abs(offset.mean()) < 5 * offset.std() / math.sqrt(DRAWS)  # the mean of the parents is preserved


def test_simulated_binary_crossover_inherits_the_parameters_that_take_no_part():
    mothers, fathers = _repeated([0.4, 0.45]), _repeated([0.6, 0.55])
    children = _drawn(operators.simulated_binary_crossover(2.0, 0.3), mothers, fathers)
    from_mother, from_father = children == np.asarray(mothers), children == np.asarray(fathers)
    inherited = int((from_mother | from_father).sum())
    assert stats.binomtest(inherited, 2 * DRAWS, 0.7).pvalue > LEAST_P
    assert not (from_mother[:, 0] & from_father[:, 1]).any()  # one child: all its parameters from one side


def test_differential_crossover_adds_one_uniform_share_of_the_difference_of_two_fathers():
    mother, father, other = np.array([[0.5, 0.6], [0.6, 0.5], [0.4, 0.45]])
    fathers = jnp.tile(jnp.asarray([other, father]), (DRAWS // 2, 1))
    children = _drawn(operators.differential_crossover(0.5), _repeated(mother), fathers)[1::2]
    shares = (children - mother) / (father - other)
    np.testing.assert_allclose(shares[:, 0], shares[:, 1], atol=3e-6)
    assert stats.kstest(shares[:, 0], stats.uniform(0.25, 0.5).cdf).pvalue > LEAST_P


# Mutation


@pytest.mark.parametrize(
    ("setting", "progress", "deviation"),
    [((0.08, 1.0, 0.005), 0.0, 0.08), ((0.08, 1.0, 0.005), 0.5, 0.02), ((0.2, 1.0), 1.0, 0.002)],
)
def test_gaussian_mutation_shrinks_geometrically(setting, progress, deviation):
    mutants = _drawn(operators.gaussian_mutation(*setting), _repeated([0.5]), progress)[:, 0]
    assert stats.kstest(mutants, stats.norm(0.5, deviation).cdf).pvalue > LEAST_P
    np.testing.assert_allclose(mutants.std(), deviation, rtol=0.03)


@pytest.mark.parametrize("bound", [0.0, 1.0])
def test_mutants_are_reflected_at_a_bound_rather_than_piled_up_on_it(bound):
    mutants = _drawn(operators.gaussian_mutation(0.08, 1.0, 0.005), _repeated([bound]), 0.0)[:, 0]
    assert stats.kstest(np.abs(mutants - bound), stats.halfnorm(scale=0.08).cdf).pvalue > LEAST_P


@pytest.mark.parametrize("distribution_index", [4.0, 20.0])
def test_polynomial_mutation_has_the_distribution_of_its_source(distribution_index):
    mutants = _drawn(operators.polynomial_mutation(distribution_index, 1.0), _repeated([0.5]), 0.7)[:, 0]

    def step_below(step):
        tail = (1 - np.minimum(np.abs(step), 1)) ** (distribution_index + 1) / 2
        return np.where(step < 0, tail, 1 - tail)

    def cumulative(value):  # a step beyond -0.5 or 0.5 is reflected at the bound
        return step_below(value - 0.5) - step_below(-value - 0.5) + 1 - step_below(1.5 - value)

    assert stats.kstest(mutants, cumulative).pvalue > LEAST_P


@pytest.mark.parametrize("make", [operators.gaussian_mutation, operators.polynomial_mutation])
@pytest.mark.parametrize(("probability", "expected"), [(None, 0.25), (0.6, 0.6)])
def test_mutation_probability(make, probability, expected):
    individuals = _repeated([0.2, 0.4, 0.6, 0.8])
    steps = _drawn(make(probability=probability), individuals, 0.0) - np.asarray(individuals)
    mutated = steps[steps != 0]
    assert stats.binomtest(len(mutated), steps.size, expected).pvalue > LEAST_P
    assert stats.binomtest(int((mutated > 0).sum()), len(mutated)).pvalue > LEAST_P  # whether and how far: apart


# Selection. Costs are in no order, so the probabilities must follow the cost, not the place.


@pytest.mark.parametrize("size", [2, 5])
def test_tournament_selection_probabilities(size):
    cost = np.array([4.0, -1.0, np.nan, 3.0, 10.0, 2.5, 1e30], np.float32)
    rank = np.array([3, 0, 6, 2, 4, 1, 5])
    probabilities = ((7 - rank) ** size - (6 - rank) ** size) / 7**size
    _assert_drawn_from(_frequencies(operators.tournament_selection(size), cost), probabilities)


@pytest.mark.parametrize("pressure", [1.8, 2.0])
def test_rank_selection_probabilities(pressure):
    # Five finite costs; the two equal ones share ranks 1 and 2, and the last of five has rank 4.
    cost = np.array([4.0, 7.0, np.inf, 4.0, 1e30, -3.0, np.nan], np.float32)
    rank = np.array([1.5, 3, 0, 1.5, 4, 0, 0])
    copies = (pressure - (2 * pressure - 2) * rank / 4) * [1, 1, 0, 1, 1, 1, 0]
    _assert_drawn_from(_frequencies(operators.rank_selection(pressure), cost), copies / 5)


def test_roulette_selection_probabilities():
    # Excess 8, 0, none, 2, 1e30, 4, 0; those above zero in order 2, 4, 8, 1e30: lower median 4.
    cost = np.array([5.0, -3.0, np.nan, -1.0, 1e30, 1.0, -3.0], np.float32)
    fitness = np.array([1 / 3, 1, 0, 2 / 3, 0, 1 / 2, 1])
    _assert_drawn_from(_frequencies(operators.roulette_selection(), cost), fitness / fitness.sum())


@settings(max_examples=25, deadline=None)
@given(exponent=st.integers(-30, 30), sign=st.sampled_from([-1, 0, 1]))
def test_roulette_selection_knows_no_unit_of_cost(exponent, sign):
    cost = np.array([5.0, 3.0, 9.0, 4.0, 3.5], np.float32)
    other = cost * np.float32(2.0**exponent) + np.float32(sign * 2.0 ** (exponent + 4))  # exact in float32
    roulette = operators.roulette_selection()
    np.testing.assert_array_equal(_selected(roulette, cost, 50), _selected(roulette, other, 50))


@pytest.mark.parametrize("name", SELECTIONS)
@pytest.mark.parametrize("value", [0.0, -7.5, np.nan, np.inf, -np.inf])
def test_equal_costs_are_equally_likely(name, value):
    _assert_drawn_from(_frequencies(SELECTIONS[name], np.full(7, value, np.float32)), np.full(7, 1 / 7))


@pytest.mark.parametrize("name", SELECTIONS)
@settings(max_examples=100, deadline=None)
@given(seed=SEEDS, cost=hnp.arrays(np.float32, INDIVIDUALS, elements=COST))
def test_failed_individuals_are_never_selected_while_one_succeeded(name, seed, cost):
    # 256 rivals of 5: a tournament without a finite one is out of the question.
    selection = operators.tournament_selection(256) if name == "tournament" else SELECTIONS[name]
    indices = _selected(selection, cost, 50, seed)
    assert ((indices >= 0) & (indices < INDIVIDUALS)).all()
    if np.isfinite(cost).any():
        assert np.isfinite(cost[indices]).all()


# Elitism, immigrants, failed costs

COARSE_POPULATIONS = hnp.arrays(np.float32, (3, 2), elements=st.sampled_from([0.0, 0.5, 1.0]))


def _coarse_cost(population):
    """Cost by parameters, so that copies of an individual have the same cost; those at 1, 1 fail."""
    cost = population @ np.array([2.0, 5.0], np.float32)
    return np.where(cost == 7, np.inf, cost).astype(np.float32)


def _rows(population, cost):
    return np.column_stack([population, cost]).tolist()


@pytest.mark.parametrize("elites_number", [1, 2, 3])
@settings(max_examples=100, deadline=None)
@given(seed=SEEDS, population=COARSE_POPULATIONS, others=COARSE_POPULATIONS)
def test_elite_is_never_lost_and_only_absent_elites_replace(elites_number, seed, population, others):
    elites = others[:elites_number]
    cost, elite_cost = _coarse_cost(population), _coarse_cost(elites)
    after, cost_after = quick_jit(operators.elitism)(jax.random.key(seed), population, cost, elites, elite_cost)
    rows_before, rows = _rows(population, cost), _rows(after, cost_after)
    elite_rows = _rows(elites, elite_cost)
    succeeded = [elite for elite in elite_rows if math.isfinite(elite[-1])]
    assert all(elite in rows for elite in succeeded)
    replacing = [row for before, row in zip(rows_before, rows, strict=True) if before != row]
    assert sorted(replacing) == sorted(elite for elite in succeeded if elite not in rows_before)


def test_elite_replaces_any_other_individual_equally_often():
    # Elites: one absent, one present in place 1, which may not be replaced.
    population = jnp.asarray([[0.1, 0.1], [0.2, 0.2], [0.3, 0.3], [0.4, 0.4]])
    cost = jnp.asarray([1.0, 2.0, jnp.nan, 4.0])
    elites, elite_cost = jnp.asarray([[0.9, 0.9], [0.2, 0.2]]), jnp.asarray([0.5, 2.0])
    keys = jax.random.split(jax.random.key(0), 6000)
    after, cost_after = quick_jit(jax.vmap(operators.elitism, in_axes=(0, None, None, None, None)))(
        keys, population, cost, elites, elite_cost
    )
    replaced = (np.asarray(after) == np.asarray(elites[0])).all(axis=2)
    np.testing.assert_array_equal(replaced.sum(axis=1), 1)
    np.testing.assert_array_equal(np.asarray(cost_after)[replaced], 0.5)
    _assert_drawn_from(replaced.sum(axis=0), np.array([1, 0, 1, 1]) / 3)


def test_failed_costs_in_elitism():
    # The first elite has the parameters of a failed individual and comes in; the elites that failed do not.
    population, cost = jnp.asarray([[0.1], [0.2], [0.3]]), jnp.asarray([1.0, 2.0, jnp.nan])
    elites, elite_cost = jnp.asarray([[0.3], [0.4], [0.5]]), jnp.asarray([0.5, jnp.inf, jnp.nan])
    after, cost_after = quick_jit(operators.elitism)(jax.random.key(0), population, cost, elites, elite_cost)
    replaced = np.asarray(cost_after) == 0.5
    assert replaced.sum() == 1
    np.testing.assert_array_equal(after, np.where(replaced[:, None], 0.3, population).astype(np.float32))
    np.testing.assert_array_equal(cost_after, np.where(replaced, 0.5, cost))


def test_more_elites_than_individuals_are_refused():
    elites = jnp.zeros((3, 2))
    with pytest.raises(ValueError, match="got 3 elites and 2 individuals: keep fewer elites or enlarge"):
        operators.elitism(jax.random.key(0), elites[:2], jnp.zeros(2), elites, jnp.zeros(3))


def test_immigrants_replace_any_individual_equally_often_by_uniform_ones():
    population = jnp.full((4, 2), 0.5)
    keys = jax.random.split(jax.random.key(0), 4000)
    after = quick_jit(jax.vmap(lambda key: operators.immigrants(key, population, 2)))(keys)
    replaced = np.asarray((after != 0.5).any(axis=2))
    np.testing.assert_array_equal(replaced.sum(axis=1), 2)
    pairs = replaced @ np.array([1, 2, 4, 8])  # each pair of places has a number of its own
    _assert_drawn_from(np.bincount(pairs, minlength=16)[[3, 5, 6, 9, 10, 12]], np.full(6, 1 / 6))
    values = np.asarray(after)[replaced]
    for value in values.T:
        assert stats.kstest(value, stats.uniform.cdf).pvalue > LEAST_P
    assert stats.pearsonr(*values.T).pvalue > LEAST_P


@pytest.mark.parametrize("count", [-1, 4])
def test_wrong_number_of_immigrants_is_refused(count):
    with pytest.raises(
        ValueError, match=f"expected count to be a whole number from 0 to 3, got {count}: at most the number of"
    ):
        operators.immigrants(jax.random.key(0), jnp.zeros((3, 2)), count)


def test_failed_costs_become_infinite():
    cost = jnp.asarray([1.0, jnp.nan, -jnp.inf, jnp.inf, -2.0])
    np.testing.assert_array_equal(operators.finite_or_inf(cost), [1.0, np.inf, np.inf, np.inf, -2.0])


# Settings


@pytest.mark.parametrize(
    ("make", "name", "wrong", "wanted"),
    [
        ("blend_crossover", "extent", [-0.1, 1.5, math.nan], "from 0 to 1 (0.5 is usual)"),
        ("line_crossover", "extent", [-0.1, 1.5], "from 0 to 1 (0.25 is usual)"),
        ("differential_crossover", "weight", [0.0, 1.1], "above 0 and at most 1 (0.5 is usual)"),
        ("simulated_binary_crossover", "distribution_index", [-1.0, math.inf], "finite and at least 0"),
        ("simulated_binary_crossover", "probability", [-0.1, 1.1], "from 0 to 1"),
        ("gaussian_mutation", "deviation", [0.0, 1.2], "above 0 and at most 1 (the whole search interval)"),
        ("gaussian_mutation", "final_deviation", [0.0, 0.2], "above 0 and at most the deviation 0.1"),
        ("gaussian_mutation", "probability", [-0.1, 1.1], "None or from 0 to 1"),
        ("polynomial_mutation", "distribution_index", [-1.0, math.inf], "finite and at least 0"),
        ("polynomial_mutation", "probability", [-0.1, 1.1], "None or from 0 to 1"),
        ("tournament_selection", "size", [0, -2], "a whole number from 1 to 1000 (2 is usual)"),
        ("rank_selection", "pressure", [0.5, 2.5], "from 1 to 2 (1.8 is usual)"),
    ],
)
def test_wrong_settings_are_refused(make, name, wrong, wanted):
    for value in wrong:
        with pytest.raises(ValueError, match=re.escape(f"expected {name} to be {wanted}, got {value}")):
            getattr(operators, make)(**{name: value})


def test_equal_settings_give_the_same_function_so_that_nothing_is_compiled_again():
    traced = []

    def search(key, mutation, progress):
        traced.append(mutation)
        return mutation(key, jnp.full((2, 2), 0.5), progress)

    compiled = quick_jit(search, static_argnums=1)
    make = operators.gaussian_mutation
    same = [make(), make(0.1), make(deviation=0.1, final_deviation=None)]
    for generation, mutation in enumerate([*same, make(0.2)]):
        compiled(jax.random.key(0), mutation, generation / 4)
    assert traced == [make(), make(0.2)]
    assert operators.roulette_selection() is operators.roulette_selection()
