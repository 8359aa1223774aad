"""Gradient refinement with optax, in the unit cube, until the sum of squares is as good as at its minimum."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ehsvjax import kernels
from ehsvjax.checks import number, positive, refused, whole
from ehsvjax.population import Problem, huber_weight, population_cost, prior_residuals, residuals, robust_square


class Refined(NamedTuple):
    """Where each start has led.

    Attributes:
        individual: the best point found, in the unit cube.
        cost: its cost, as `population_cost` counts it.
        remaining: by how much the next step would lower the cost, to first order.
        information: `J^T W J` there, J the standardised residuals by the coordinates: the Fisher information.
        residuals: standardised, there; zero where there is no sample.
        iterations: how many steps were taken.
        converged: whether `remaining` fell below the tolerance.

    """

    individual: Float[Array, "individual parameter"]
    cost: Float[Array, " individual"]
    remaining: Float[Array, " individual"]
    information: Float[Array, "individual parameter parameter"]
    residuals: Float[Any, "individual record time signal"]
    iterations: Int[Array, " individual"]
    converged: Bool[Array, " individual"]


class LevenbergMarquardtState(NamedTuple):
    """The last point that was accepted, what was measured there, and the next step from it: its damping and its gain.

    The gain is the decrease of twice the value that the step promises, to first order.
    """

    point: Float[Array, " parameter"]
    value: Float[Array, ""]
    gradient: Float[Array, " parameter"]
    information: Float[Array, "parameter parameter"]
    damping: Float[Array, ""]
    growth: Float[Array, ""]
    gain: Float[Array, ""]


def levenberg_marquardt(damping: float = 1e-4, shrink: float = 0.1) -> optax.GradientTransformationExtraArgs:
    """Levenberg-Marquardt as an optax transformation, on the unit cube.

    Its `update` takes besides the gradient the `value` and the `information` (Gauss-Newton Hessian) at the parameters.
    A step that did not lower the value is taken back: the update then leads from the last accepted point along a step
    with more damping. Coordinates at a bound that the gradient pushes outwards are held there, the others move freely
    (projected Gauss-Newton, Bertsekas 1982). Damping is relative to the diagonal (Marquardt 1963); it grows by 2, 4, 8,
    ... for steps in a row that did not lower the value (Nielsen 1999), so that a kink of the cost is soon recognised.

    Args:
        damping: of the first step.
        shrink: factor of the damping after a step that lowered the value.

    Raises:
        ValueError: unless the damping is positive and the factor is between 0 and 1.

    """
    positive("damping", damping)
    number("shrink", shrink, "between 0 and 1 (0.1 is usual)", lambda x: 0.0 < x < 1.0)

    def init(params):
        size = params.shape[0]
        return LevenbergMarquardtState(
            point=params,
            value=jnp.asarray(jnp.inf, params.dtype),
            gradient=jnp.zeros_like(params),
            information=jnp.eye(size, dtype=params.dtype),
            damping=jnp.asarray(damping / shrink, params.dtype),
            growth=jnp.asarray(2.0, params.dtype),
            gain=jnp.asarray(jnp.inf, params.dtype),
        )

    def update(gradient, state, params, *, value, information, **unused):
        del unused
        # Written so that a NaN is not an improvement.
        better = value < state.value
        two = jnp.full_like(state.growth, 2.0)
        fresh = LevenbergMarquardtState(params, value, gradient, information, state.damping * shrink, two, state.gain)
        stale = state._replace(damping=state.damping * state.growth, growth=2.0 * state.growth)
        state = jax.tree.map(functools.partial(jnp.where, better), fresh, stale)
        step = gauss_newton_step(state.point, state.gradient, state.information, state.damping)
        state = state._replace(gain=-jnp.dot(state.gradient, step))
        return jnp.clip(state.point + step, 0.0, 1.0) - params, state

    return optax.GradientTransformationExtraArgs(init, update)


def gauss_newton_step(
    point: Float[Array, " parameter"],
    gradient: Float[Array, " parameter"],
    information: Float[Array, "parameter parameter"],
    damping: float | Float[Array, ""] = 0.0,
) -> Float[Array, " parameter"]:
    """Return the damped Gauss-Newton step within the coordinates that are free to move.

    What the data do not fix is left alone: directions (eigenvalues of the scaled information at rounding level), and
    coordinates of which nothing but rounding shows, which would go from one bound to the other however much is damped.
    """
    eps = jnp.finfo(point.dtype).eps
    pushed_out = ((point <= 0.0) & (gradient > 0.0)) | ((point >= 1.0) & (gradient < 0.0))
    diagonal = jnp.diagonal(information)
    shows = diagonal > eps**2 * jnp.max(diagonal)
    scale = jnp.where(pushed_out | ~shows, 0.0, lax.rsqrt(jnp.where(shows, diagonal, 1.0)))
    scaled = information * scale[:, None] * scale[None, :]
    values, vectors = jnp.linalg.eigh(scaled)
    fixed_by_data = values > len(point) * eps * values[-1]
    inverse = jnp.where(fixed_by_data, 1.0 / (jnp.where(fixed_by_data, values, 1.0) + damping), 0.0)
    return -scale * (vectors @ (inverse * (vectors.T @ (scale * gradient))))


@kernels.jit(static_argnames=("optimizer", "iterations"))
def refine(
    problem: Problem,
    starts: Float[Array, "individual parameter"],
    tolerance: float | Float[Array, ""] = 1e-3,
    *,
    held: Bool[Array, "individual parameter"] | None = None,
    optimizer: optax.GradientTransformation | None = None,
    iterations: int = 60,
) -> Refined:
    """Refine every start by itself until a further step would gain less than `tolerance` noise variances.

    The noise variance is the mean square of the residuals at the point itself, so that a model that does not fit well
    is not polished beyond what its misfit makes meaningful. Where the cost has a kink (a saturation just reached), the
    full Gauss-Newton step promises more than there is; what counts is what the damped step would gain.

    Args:
        problem: the problem, in the precision in which to work; float64 for a tolerance that small.
        starts: points of the unit cube.
        tolerance: in noise variances.
        held: coordinates that each start keeps; None holds none.
        optimizer: any optax optimizer; it is given `value`, `information`, `grad` and `value_fn` too, so that
            `optax.lbfgs()` works. None: `levenberg_marquardt()`.
        iterations: at most this many steps.

    Raises:
        ValueError: for starts that are no points of the problem's unit cube, or no number of steps.

    """
    whole("iterations", iterations, 1, 10**6)
    if np.shape(starts)[1:] != (problem.unknowns,):
        raise refused(
            "starts", f"an array [individual, {problem.unknowns}]", np.shape(starts), "one row for each start"
        )
    optimizer = optax.with_extra_args_support(levenberg_marquardt() if optimizer is None else optimizer)

    def value_fn(params, information=None):
        # optax hands a line search's function those extra arguments that it names.
        del information
        return 0.5 * population_cost(problem, params[None])[0]

    def start_from(start):
        size = start.shape[0]
        nowhere = Refined(
            individual=start,
            cost=jnp.asarray(jnp.inf, start.dtype),
            remaining=jnp.asarray(jnp.inf, start.dtype),
            information=jnp.zeros((size, size), start.dtype),
            residuals=jnp.zeros(problem.samples.outputs.shape, start.dtype),
            iterations=jnp.int32(0),
            converged=jnp.bool_(False),
        )
        return _State(start, optimizer.init(start), nowhere, jnp.zeros_like(start))

    def unfinished(state):
        return (state.best.iterations < iterations) & ~state.best.converged

    def advance(state, measured):
        cost, gradient, information, r = measured
        better = cost < state.best.cost
        here = state.best._replace(individual=state.point, cost=cost, information=information, residuals=r)
        best, gradient_at_best = jax.tree.map(
            functools.partial(jnp.where, better), (here, gradient), (state.best, state.gradient_at_best)
        )
        updates, optimizer_state = optimizer.update(
            gradient,
            state.optimizer_state,
            state.point,
            value=0.5 * cost,
            grad=gradient,
            value_fn=value_fn,
            information=information,
        )
        point = optax.projections.projection_box(optax.apply_updates(state.point, updates), 0.0, 1.0)
        if isinstance(optimizer_state, LevenbergMarquardtState):
            remaining = optimizer_state.gain
        else:
            step = gauss_newton_step(best.individual, gradient_at_best, best.information)
            remaining = -jnp.dot(gradient_at_best, step)
        enough = tolerance * best.cost / jnp.sum(problem.samples.measured)
        best = best._replace(
            remaining=remaining,
            iterations=state.best.iterations + 1,
            converged=(remaining <= enough) & jnp.isfinite(best.cost),
        )
        following = _State(point, optimizer_state, best, gradient_at_best)
        return jax.tree.map(functools.partial(jnp.where, unfinished(state)), following, state)

    def body(states):
        cost, gradient, information, r = cost_gradient_information(problem, states.point)
        if held is not None:
            # A coordinate of which nothing shows is not moved.
            gradient = jnp.where(held, 0.0, gradient)
            information = jnp.where(held[:, :, None] | held[:, None, :], 0.0, information)
        measured = cost, gradient, information, r
        return jax.vmap(advance)(states, measured)

    states = jax.vmap(start_from)(starts)
    return lax.while_loop(lambda states: jnp.any(unfinished(states)), body, states).best


class _State(NamedTuple):
    """Of one start: the point to be measured next, the optimizer's state, and the best point so far."""

    point: Float[Array, " parameter"]
    optimizer_state: optax.OptState
    best: Refined
    gradient_at_best: Float[Array, " parameter"]


def cost_gradient_information(problem: Problem, individuals: Float[Array, "individual parameter"]):
    """Return the cost, half its gradient, the Gauss-Newton information and the residuals of every individual.

    By forward differentiation: one simulation with a tangent for every unknown, all in one pass. The tangents' axis is
    the first of each array and the individuals stay side by side, as in the cost: five times as fast as the other way.
    With a Huber cost a residual weighs by its derivative over itself (iteratively reweighted least squares).
    """
    count, unknowns = individuals.shape
    every = jax.vmap(functools.partial(residuals, problem))

    def along(direction):
        return jax.jvp(every, (individuals,), (jnp.broadcast_to(direction, individuals.shape),))

    r, jacobian = jax.vmap(along, out_axes=(None, 0))(jnp.eye(unknowns, dtype=individuals.dtype))
    weighted = jacobian * huber_weight(r, problem.huber)[None]
    flat, weighted = (leaf.reshape(unknowns, count, -1) for leaf in (jacobian, weighted))
    gradient = jnp.einsum("pit,it->ip", weighted, r.reshape(count, -1))
    information = jnp.einsum("pit,qit->ipq", weighted, flat)
    cost = jnp.sum(robust_square(r, problem.huber).reshape(count, -1), axis=1)
    if problem.priors is not None:
        # Each depends on its own coordinate alone.
        off, slope = jax.jvp(functools.partial(prior_residuals, problem), (individuals,), (jnp.ones_like(individuals),))
        cost, gradient = cost + jnp.sum(off**2, axis=1), gradient + slope * off
        information = information + jax.vmap(jnp.diag)(slope**2)
    return jnp.where(jnp.isnan(cost), jnp.inf, cost), gradient, information, r
