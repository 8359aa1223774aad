"""Genetic operators: pure JAX functions `(key, arrays) -> arrays` on real-coded individuals in the unit cube.

A population is `[individual, parameter]` with every element in [0, 1]; a cost is `[individual]`, lower is
better, and one that is not finite marks a failed simulation, which can never win. The operators are those of
section 3.1 of the paper: crossover, mutation, selection, elitism and new random elements.

Crossovers, mutations and selections are made by a factory from their settings. Equal settings give the
identical function, so a compiled search that takes one as a static argument is not compiled again.

What an operator puts outside the cube is reflected back at the bound. Clipping would pile individuals up on
the bounds and make a parameter look as if its search interval were too narrow.
"""

import functools
import inspect
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from ehsvjax import draws
from ehsvjax.checks import number, refused, whole

Population = Float[Array, "individual parameter"]
Progress = Float[Array, ""] | float

# (key, mothers, fathers) -> children, row by row
Crossover = Callable[[Key[Array, ""], Population, Population], Population]
# (key, individuals, progress) -> individuals; progress = generation / generations, from 0 to 1
Mutation = Callable[[Key[Array, ""], Population, Progress], Population]
# (key, cost, count) -> indices of `count` individuals, drawn with replacement; count is static
Selection = Callable[[Key[Array, ""], Float[Array, " individual"], int], Int[Array, " count"]]

_Settings = ParamSpec("_Settings")
_Operator = TypeVar("_Operator")


def _same_for_equal_settings(factory: Callable[_Settings, _Operator]) -> Callable[_Settings, _Operator]:
    # functools.cache alone takes f(), f(0.5) and f(extent=0.5) for three different settings.
    signature = inspect.signature(factory)
    cached = functools.cache(factory)

    @functools.wraps(factory)
    def remembered(*args: _Settings.args, **kwargs: _Settings.kwargs) -> _Operator:
        settings = signature.bind(*args, **kwargs)
        settings.apply_defaults()
        try:
            return cached(*settings.args, **settings.kwargs)
        except TypeError:  # what cannot be hashed the factory refuses by itself
            return factory(*settings.args, **settings.kwargs)

    return remembered


@_same_for_equal_settings
def blend_crossover(extent: float = 0.5) -> Crossover:
    """Blend crossover (BLX-alpha): each parameter uniform on its parents' interval, widened on either side.

    It is widened by `extent` (alpha in the source) times its length.
    ValueError unless `extent` is from 0 to 1.
    Source: Eshelman & Schaffer 1993, Real-coded genetic algorithms and interval-schemata.
    """
    number("extent", extent, "from 0 to 1 (0.5 is usual)", lambda x: 0 <= x <= 1)

    def crossover(key: Key[Array, ""], mothers: Population, fathers: Population) -> Population:
        weights = draws.uniform(key, mothers.shape, mothers.dtype, -extent, 1 + extent)
        return _reflect(mothers + weights * (fathers - mothers))

    return crossover


@_same_for_equal_settings
def line_crossover(extent: float = 0.25) -> Crossover:
    """Line recombination, extended: the child is uniform on the line through its parents and beyond them.

    One random weight is shared by all parameters, so correlated parameters move together. The line reaches
    `extent` (d in the source) times the parents' distance beyond each.
    ValueError unless `extent` is from 0 to 1.
    Source: Muehlenbein & Schlierkamp-Voosen 1993, Predictive models for the breeder genetic algorithm.
    """
    number("extent", extent, "from 0 to 1 (0.25 is usual)", lambda x: 0 <= x <= 1)

    def crossover(key: Key[Array, ""], mothers: Population, fathers: Population) -> Population:
        weights = draws.uniform(key, (len(mothers), 1), mothers.dtype, -extent, 1 + extent)
        return _reflect(mothers + weights * (fathers - mothers))

    return crossover


@_same_for_equal_settings
def simulated_binary_crossover(distribution_index: float = 2.0, probability: float = 0.5) -> Crossover:
    """SBX, simulated binary crossover: one of the two children of the source, drawn at random.

    The spread factor b, the distance of the children over that of the parents, has the density (n + 1)/2 b^n
    up to 1 and (n + 1)/2 b^-(n + 2) beyond; the larger n = `distribution_index`, the nearer the child to a
    parent. Each parameter takes part with `probability` and is otherwise inherited as it is.
    ValueError unless the index is finite and at least 0 and the probability is from 0 to 1.
    Source: Deb & Agrawal 1995, Simulated binary crossover for continuous search space.
    """
    number("distribution_index", distribution_index, "finite and at least 0", lambda x: x >= 0)
    number("probability", probability, "from 0 to 1", lambda x: 0 <= x <= 1)

    def crossover(key: Key[Array, ""], mothers: Population, fathers: Population) -> Population:
        key_child, key_parameters = draws.split(key, 2)
        first_child = draws.uniform(key_child, (len(mothers), 1)) < 0.5
        near, far = jnp.where(first_child, mothers, fathers), jnp.where(first_child, fathers, mothers)
        part, uniform = draws.uniform(key_parameters, (2, *mothers.shape), mothers.dtype)
        power = jnp.where(uniform <= 0.5, 2 * uniform, 1 / (2 * (1 - uniform)))
        spread = power ** (1 / (distribution_index + 1))
        return _reflect(near + jnp.where(part < probability, (1 - spread) / 2, 0) * (far - near))

    return crossover


@_same_for_equal_settings
def differential_crossover(weight: float = 0.5) -> Crossover:
    """Differential recombination: the child is the mother plus a share of the difference of two fathers.

    The share is uniform between half of `weight` (F in the source, from 0 to 1) and one and a half times it, one for
    all parameters; the second father is that of the row before. As differences of a population have the population's
    own covariance, the steps follow a narrow valley whichever way it lies, and shrink as it is settled.
    ValueError unless 0 < weight <= 1.
    Source: Storn & Price 1997, Differential evolution, with the dither of Das, Konar & Chakraborty 2005.
    """
    number("weight", weight, "above 0 and at most 1 (0.5 is usual)", lambda x: 0 < x <= 1)

    def crossover(key: Key[Array, ""], mothers: Population, fathers: Population) -> Population:
        share = draws.uniform(key, (len(mothers), 1), mothers.dtype, 0.5 * weight, 1.5 * weight)
        return _reflect(mothers + share * (fathers - jnp.roll(fathers, 1, axis=0)))

    return crossover


@_same_for_equal_settings
def gaussian_mutation(
    deviation: float = 0.1, probability: float | None = None, final_deviation: float | None = None
) -> Mutation:
    """Gaussian mutation: its standard deviation shrinks geometrically from `deviation` to `final_deviation`.

    Deviations are fractions of the search interval; `final_deviation` None is a hundredth of `deviation`.
    Each parameter mutates with `probability`; None is 1 / number of parameters, so one per individual.
    ValueError unless 0 < final_deviation <= deviation <= 1 and the probability is from 0 to 1.
    Source: Baeck & Schwefel 1993, An overview of evolutionary algorithms for parameter optimization.
    """
    number("deviation", deviation, "above 0 and at most 1 (the whole search interval)", lambda x: 0 < x <= 1)
    final = deviation / 100 if final_deviation is None else final_deviation
    at_most = f"above 0 and at most the deviation {deviation}"
    number("final_deviation", final, at_most, lambda x: 0 < x <= deviation)
    _check_probability(probability)

    def mutation(key: Key[Array, ""], individuals: Population, progress: Progress) -> Population:
        which, uniform = draws.uniform(key, (2, *individuals.shape), individuals.dtype)
        deviation_now = deviation * (final / deviation) ** jnp.asarray(progress, individuals.dtype)
        steps = deviation_now * draws.normal_from(uniform)
        return _reflect(individuals + jnp.where(which < _share(probability, individuals), steps, 0))

    return mutation


@_same_for_equal_settings
def polynomial_mutation(distribution_index: float = 20.0, probability: float | None = None) -> Mutation:
    """Polynomial mutation: a step d within one search interval, of density (n + 1)/2 (1 - |d|)^n.

    n is `distribution_index`; the mean |d| is 1/(n + 2), whatever the progress. Each parameter mutates with
    `probability`; None is 1 / number of parameters, so one per individual.
    ValueError unless the index is finite and at least 0 and the probability is from 0 to 1.
    Source: Deb & Goyal 1996, A combined genetic adaptive search (GeneAS) for engineering design.
    """
    number("distribution_index", distribution_index, "finite and at least 0", lambda x: x >= 0)
    _check_probability(probability)

    def mutation(key: Key[Array, ""], individuals: Population, progress: Progress) -> Population:
        which, uniform = draws.uniform(key, (2, *individuals.shape), individuals.dtype)
        exponent = 1 / (distribution_index + 1)
        steps = jnp.where(uniform < 0.5, (2 * uniform) ** exponent - 1, 1 - (2 * (1 - uniform)) ** exponent)
        return _reflect(individuals + jnp.where(which < _share(probability, individuals), steps, 0))

    return mutation


@_same_for_equal_settings
def tournament_selection(size: int = 2) -> Selection:
    """Tournament selection: the best of `size` individuals drawn with replacement.

    Of N individuals, rank r = 0 (best) to N - 1 is selected with probability
    ((N - r)^size - (N - r - 1)^size) / N^size.
    ValueError unless `size` is a whole number from 1 to 1000.
    Source: Goldberg & Deb 1991, A comparative analysis of selection schemes used in genetic algorithms.
    """
    number("size", size, "a whole number from 1 to 1000 (2 is usual)", lambda x: 1 <= x <= 1000 and x % 1 == 0)

    def selection(key: Key[Array, ""], cost: Float[Array, " individual"], count: int) -> Int[Array, " count"]:
        rivals = draws.integers(key, (count, int(size)), len(cost))
        winners = jnp.argmin(finite_or_inf(cost)[rivals], axis=1, keepdims=True)
        return jnp.take_along_axis(rivals, winners, axis=1)[:, 0]

    return selection


@_same_for_equal_settings
def rank_selection(pressure: float = 1.8) -> Selection:
    """Linear ranking: the expected number of copies falls linearly with the rank.

    It falls from `pressure` for the best to 2 - `pressure` for the worst. Only finite costs are ranked, equal
    ones with the mean of their ranks, and a failed individual is selected only where all failed: then all are
    equally likely.
    ValueError unless `pressure` is from 1 (no preference) to 2.
    Source: Baker 1985, Adaptive selection methods for genetic algorithms.
    """
    number("pressure", pressure, "from 1 to 2 (1.8 is usual)", lambda x: 1 <= x <= 2)

    def selection(key: Key[Array, ""], cost: Float[Array, " individual"], count: int) -> Int[Array, " count"]:
        ranked = jnp.isfinite(cost)
        cost = finite_or_inf(cost)
        ascending = jnp.sort(cost)
        better = jnp.searchsorted(ascending, cost, side="left")
        not_worse = jnp.searchsorted(ascending, cost, side="right")
        mean_rank = ((better + not_worse - 1) / 2).astype(cost.dtype)
        from_best = mean_rank / jnp.maximum(ranked.sum() - 1, 1).astype(cost.dtype)
        copies = pressure * (1 - from_best) + (2 - pressure) * from_best
        return _spin_wheel(key, jnp.where(ranked, copies, 0), count)

    return selection


@_same_for_equal_settings
def roulette_selection() -> Selection:
    """Roulette: selection in proportion to a fitness, here s/(s + J - J_best) for the cost J.

    s is the (lower) median of J - J_best over the finite costs worse than the best. So, whatever the unit,
    sign or range of the costs, the best has fitness 1, the typical individual 1/2, one with twice its excess
    cost 1/3 and a failed one 0. Where all costs are equal or all failed, all are equally likely.
    Source: Koza 1992, Genetic Programming (adjusted fitness 1/(1 + excess)); the median as unit is added.
    """

    def selection(key: Key[Array, ""], cost: Float[Array, " individual"], count: int) -> Int[Array, " count"]:
        excess = cost - jnp.min(finite_or_inf(cost))
        worse = (excess > 0) & (excess < jnp.inf)
        median = jnp.sort(jnp.where(worse, excess, jnp.inf))[(worse.sum() - 1) // 2]
        fitness = jnp.where(worse, median / (median + excess), jnp.where(excess == 0, 1, 0))
        return _spin_wheel(key, fitness, count)

    return selection


def elitism(
    key: Key[Array, ""],
    population: Population,
    cost: Float[Array, " individual"],
    elites: Float[Array, "elite parameter"],
    elite_cost: Float[Array, " elite"],
) -> tuple[Population, Float[Array, " individual"]]:
    """Put every elite into the population and cost: an absent one replaces an individual chosen at random.

    An elite is present if an individual has its parameters and its cost. Absent elites replace distinct
    individuals, never one that stands for a present elite; an elite that failed replaces nobody. The elites
    are to be the best so far, this population included, or a better newcomer could be replaced.
    ValueError if there are more elites than individuals, or shapes that do not go together.
    Source: the paper, section 3.1 (iv), with one elite.
    """
    draws.check_key(key)
    individuals, parameters = _rows("population", population)
    if _rows("elites", elites)[1] != parameters:
        raise refused("elites", f"rows of {parameters} parameters, as the population's", elites)
    for name, costs, count in (("cost", cost, individuals), ("elite_cost", elite_cost, len(elites))):
        if getattr(costs, "shape", None) != (count,):
            raise refused(name, f"an array of {count} costs, one for each row", costs)
    if len(elites) > individuals:
        raise ValueError(
            f"expected at most as many elites as individuals, got {len(elites)} elites "
            f"and {individuals} individuals: keep fewer elites or enlarge the population"
        )
    same = (elites[:, None, :] == population[None, :, :]).all(axis=2) & (elite_cost[:, None] == cost[None, :])
    present = same.any(axis=1)
    # Of a present elite one copy is kept: if all were, there could be too few places for the absent ones.
    numbers = jnp.arange(individuals)[None, :]
    kept = jnp.any(present[:, None] & (same.argmax(axis=1)[:, None] == numbers), axis=0)
    places = jnp.argsort(jnp.where(kept, 2, draws.uniform(key, (individuals,))))
    absent = ~present & jnp.isfinite(elite_cost)
    place = places[jnp.cumsum(absent) - 1]
    # Chosen by each individual, not scattered by each elite, which takes longer to compile.
    comes = absent[:, None] & (place[:, None] == numbers)
    replaced, elite = comes.any(axis=0), comes.argmax(axis=0)
    return jnp.where(replaced[:, None], elites[elite], population), jnp.where(replaced, elite_cost[elite], cost)


def immigrants(key: Key[Array, ""], population: Population, count: int) -> Population:
    """Replace `count` (static) individuals, chosen at random, by uniform random ones.

    Their costs are unknown as yet and an elite may be among those replaced: evaluate, then apply elitism.
    ValueError unless `count` is from 0 to the number of individuals.
    Source: the paper, section 3.1.
    """
    draws.check_key(key)
    individuals, parameters = _rows("population", population)
    whole("count", count, 0, individuals, "at most the number of individuals")
    uniform = draws.uniform(key, (individuals + count * parameters,), population.dtype)
    place = jnp.argsort(uniform[:individuals])[:count]
    return population.at[place].set(uniform[individuals:].reshape(count, parameters))


def finite_or_inf(cost: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Cost with all that is not finite (NaN, -inf) made +inf, so that a failed simulation never wins."""
    return jnp.where(jnp.isfinite(cost), cost, jnp.inf)


def _reflect(values: Population) -> Population:
    # Repeated reflection at 0 and 1 is the distance to the nearest even number. Every operation is exact,
    # but a compiler may round `values` differently in the two places: hence the minimum.
    return jnp.minimum(jnp.abs(values - 2 * jnp.round(values / 2)), 1)


def _share(probability: float | None, individuals: Population) -> float:
    """Return the share of the parameters that mutate."""
    return 1 / individuals.shape[1] if probability is None else probability


def _spin_wheel(key: Key[Array, ""], weights: Float[Array, " individual"], count: int) -> Int[Array, " count"]:
    # Weights of zero go last, out of reach: between others, a rounded cumulative sum could let one win.
    weights = jnp.where(weights.any(), weights, 1)
    order = jnp.argsort(-weights)
    cumulative = jnp.cumsum(weights[order])
    spins = draws.uniform(key, (count,), weights.dtype) * cumulative[-1]
    positions = jnp.searchsorted(cumulative, spins, side="right")
    return order[jnp.minimum(positions, jnp.count_nonzero(weights) - 1)]


def _rows(name: str, values: object) -> tuple[int, int]:
    """Return the shape of rows of parameters."""
    shape: tuple[int, ...] = getattr(values, "shape", ())
    if len(shape) != 2:
        raise refused(name, "an array [individual, parameter]", values)
    return shape[0], shape[1]


def _check_probability(probability: float | None) -> None:
    if probability is not None:
        number("probability", probability, "None or from 0 to 1", lambda x: 0 <= x <= 1)
