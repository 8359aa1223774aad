"""The rivals of generations_per_second.py: each searches the same unit cube with its own genetic algorithm.

Every function returns `(step, best)`: `step()` runs one more generation of `population` individuals, `best()` gives the
least cost found so far. All but the two that are named for it simulate with this package's compiled cost, so that the
optimisers are compared, and not the simulations.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ehsvjax.population import to_values

Search = tuple[Callable[[], Any], Callable[[], float]]
VectorCost = Callable[[np.ndarray], np.ndarray]


def differential_evolution(cost: VectorCost, unknowns: int, population: int, seed: int) -> Search:
    """SciPy's differential evolution, the whole population evaluated in one call."""
    from scipy.optimize._differentialevolution import DifferentialEvolutionSolver

    solver = DifferentialEvolutionSolver(
        lambda x: cost(np.atleast_2d(x.T)),
        [(0.0, 1.0)] * unknowns,
        popsize=max(1, round(population / unknowns)),
        init=np.random.default_rng(seed).random((population, unknowns)),
        vectorized=True,
        updating="deferred",
        polish=False,
        rng=seed,
    )
    return lambda: next(solver), lambda: float(solver.population_energies[0])


def pymoo_ga(cost: VectorCost, unknowns: int, population: int, seed: int) -> Search:
    """Pymoo's GA with its default operators (simulated binary crossover, polynomial mutation)."""
    from pymoo.algorithms.soo.nonconvex.ga import GA
    from pymoo.core.problem import Problem

    class Cube(Problem):
        def __init__(self):
            super().__init__(n_var=unknowns, n_obj=1, xl=0.0, xu=1.0)

        def _evaluate(self, x, out, *args, **kwargs):
            out["F"] = cost(x)[:, None]

    algorithm = GA(pop_size=population, eliminate_duplicates=False)
    algorithm.setup(Cube(), termination=("n_gen", 1_000_000), seed=seed, verbose=False)
    return algorithm.next, lambda: float(algorithm.opt.get("F").min())


def pycma(cost: VectorCost, unknowns: int, population: int, seed: int) -> Search:
    """Run CMA-ES of pycma, not a genetic algorithm but the usual yardstick, with this population size."""
    import cma

    options = {"popsize": population, "bounds": [0.0, 1.0], "seed": seed + 1, "verbose": -9}
    strategy = cma.CMAEvolutionStrategy(unknowns * [0.5], 0.3, options)
    best = [np.inf]

    def step():
        individuals = strategy.ask()
        costs = cost(np.array(individuals))
        strategy.tell(individuals, costs.tolist())
        best[0] = min(best[0], float(costs.min()))

    return step, lambda: best[0]


def evosax_ga(cost: Callable[[jax.Array], jax.Array], unknowns: int, population: int, seed: int) -> Search:
    """Run evosax's SimpleGA, asking, costing and telling in one jitted call; `cost` is traced."""
    from evosax.algorithms import SimpleGA

    algorithm = SimpleGA(population_size=population, solution=jnp.zeros(unknowns))
    params = algorithm.default_params
    key = jax.random.key(seed)
    first = jax.random.uniform(key, (population, unknowns))
    costs = jax.jit(cost)(first)
    state = algorithm.init(key, first, costs, params)
    held = [state, key, float(jnp.min(costs))]

    @jax.jit
    def generation(state, key):
        key, ask_key, tell_key = jax.random.split(key, 3)
        individuals, state = algorithm.ask(ask_key, state, params)
        costs = cost(jnp.clip(individuals, 0.0, 1.0))
        state, _ = algorithm.tell(tell_key, individuals, costs, state, params)
        return state, key, jnp.min(costs)

    def step():
        held[0], held[1], least = generation(held[0], held[1])
        held[2] = min(held[2], float(least))

    return step, lambda: held[2]


def van_der_pol_motion(values, command: Callable) -> Callable:
    """Return equation (10) of the paper as diffrax takes it, for `[alpha, gamma, ...]` and a command of the time."""

    def motion(t, y, args):
        del args
        return jnp.stack([values[0] * y[1], -y[0] + values[1] * (1.0 - y[0] ** 2) * y[1] + command(t)])

    return motion


def diffrax_cost(case, solver: str) -> Callable[[jax.Array], jax.Array]:
    """Return the Van der Pol cost of a population by diffrax, by a solver at the same step, vmapped; to be traced."""
    import diffrax

    problem, record = case.problem, case.record
    period = record.sample_period
    times, command = jnp.asarray(record.time, jnp.float32), jnp.asarray(record.inputs["command"], jnp.float32)
    measured = jnp.asarray(record.outputs["position"], jnp.float32)

    def held(t):
        return command[jnp.minimum((t / period + 1e-3).astype(jnp.int32), len(command) - 1)]

    def one(individual):
        values = to_values(problem.coordinates, individual)
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(van_der_pol_motion(values, held)), getattr(diffrax, solver)(), times[0], times[-1],
            period / problem.grid.substeps, values[2:],
            saveat=diffrax.SaveAt(ts=times), stepsize_controller=diffrax.ConstantStepSize(),
            max_steps=len(record) * problem.grid.substeps + 16,
        )  # fmt: skip
        cost = jnp.sum((measured - solution.ys[:, 0]) ** 2) / problem.noise_variance[0]
        return jnp.where(jnp.isfinite(cost), cost, jnp.inf)

    return jax.vmap(one)


def numpy_cost(case) -> VectorCost:
    """Return the Van der Pol cost of a population in NumPy, vectorised over it, Runge-Kutta 4 at the same step."""
    problem, record = case.problem, case.record
    h = record.sample_period / problem.grid.substeps
    command, measured = record.inputs["command"], record.outputs["position"]

    def cost(individuals):
        alpha, gamma, p, q = np.asarray(to_values(problem.coordinates, jnp.asarray(individuals, jnp.float32)), float).T
        total = np.zeros(len(individuals))
        for u, y in zip(command, measured, strict=True):
            total += (y - p) ** 2
            for _ in range(problem.grid.substeps):
                k1p, k1q = alpha * q, u - p + gamma * (1.0 - p * p) * q
                p2, q2 = p + 0.5 * h * k1p, q + 0.5 * h * k1q
                k2p, k2q = alpha * q2, u - p2 + gamma * (1.0 - p2 * p2) * q2
                p3, q3 = p + 0.5 * h * k2p, q + 0.5 * h * k2q
                k3p, k3q = alpha * q3, u - p3 + gamma * (1.0 - p3 * p3) * q3
                p4, q4 = p + h * k3p, q + h * k3q
                k4p, k4q = alpha * q4, u - p4 + gamma * (1.0 - p4 * p4) * q4
                p = p + h / 6.0 * (k1p + 2.0 * (k2p + k3p) + k4p)
                q = q + h / 6.0 * (k1q + 2.0 * (k2q + k3q) + k4q)
        return total / float(problem.noise_variance[0])

    return cost


def odeint_cost(case) -> VectorCost:
    """Return the Van der Pol cost in a Python loop over individuals, each by SciPy's odeint."""
    from scipy.integrate import odeint

    problem, record = case.problem, case.record
    command, measured, period = record.inputs["command"], record.outputs["position"], record.sample_period
    # The command is constant for many samples: one call of odeint for each piece, which it is built for.
    starts = np.flatnonzero(np.diff(command, prepend=np.nan) != 0)
    pieces = list(zip(starts, [*starts[1:], len(command)], strict=True))

    def field(state, t, alpha, gamma, u):
        return [alpha * state[1], u - state[0] + gamma * (1.0 - state[0] ** 2) * state[1]]

    def one(alpha, gamma, p, q):
        total, state = 0.0, np.array([p, q])
        for begin, end in pieces:
            times = np.arange(end - begin + 1) * period
            path = odeint(field, state, times, args=(alpha, gamma, command[begin]), rtol=1e-6, atol=1e-6)
            total += float(np.sum((measured[begin:end] - path[:-1, 0]) ** 2))
            state = path[-1]
        return total / float(problem.noise_variance[0])

    def cost(individuals):
        values = np.asarray(to_values(problem.coordinates, jnp.asarray(individuals, jnp.float32)), float)
        return np.array([one(*row) for row in values])

    return cost
