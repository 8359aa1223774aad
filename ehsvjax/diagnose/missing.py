"""What acts where, without a form assumed: missing terms at a signal as functions of what runs along the model.

At a place (a force, an opening, a sensor) a term is added that depends on one quantity (velocity, position, spool,
time, ...) by a curve of straight pieces. The responses of the outputs to each piece are simulated. If the residual has
nothing to do with any of them, it is innocent: what is left does not depend on the input. If it has, the curve itself
is estimated, with its band.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.diagnose.noise import Whitening
from ehsvjax.diagnose.refits import Refits, bounds_of, span
from ehsvjax.diagnose.significance import INSEPARABLE, corrected, smallest_p_values
from ehsvjax.diagnose.workbench import Workbench
from ehsvjax.models.model import Model

# Pieces of a curve in the tests; along an output, where a term may repeat over short distances, also this many, if
# there are so many samples for each.
_COARSE, _CLOSE = 8, 24
_SAMPLES_PER_PIECE = 60
_FINE = (8, 14, 24, 40)
_PROBE = 1e-3
# Steps of the estimate of a curve, dampings of each that are simulated, and what the last one gains at most.
_STEPS = 8
_DAMPINGS = (0.0, 1e-4, 1e-2, 0.3)
_SETTLED, _SETTLED_SHARE = 0.1, 1e-3
# Of the smooth estimate: samples for each knot, and logarithms of the least and the largest weight of roughness.
_SAMPLES_PER_KNOT = 50
_LOG_SMOOTHNESS = (-25.0, 10.0)
# Of an unknown's coordinate, for its derivative.
_DIFFERENCE = 1e-6
# Share of the strongest response of combined pieces below which a record shows nothing.
_SHOWN = 1e-4
TIME = "time"


class Dependence(NamedTuple):
    """Whether the residual depends on a quantity, through a place.

    Attributes:
        place: signal at which a term is added; for a sensor the output itself.
        quantity: that it depends on.
        p_value: of no dependence, this test alone.
        corrected: of all such tests together.
        explained: noise variances of the residual's sum of squares that such a term takes, more than noise would give.
        pieces: of the curve that the term was tried with.

    """

    place: str
    quantity: str
    p_value: float
    corrected: float
    explained: float
    pieces: int


class MissingTerm(NamedTuple):
    """A missing term, estimated without assuming its form.

    Attributes:
        place: signal at which it acts, and `unit` its unit.
        quantity: that it depends on, and `quantity_unit`.
        at: `[knot]` values of the quantity.
        estimate: `[knot]` what is missing there, in the unit of the place.
        deviation: `[knot]` standard deviation of the estimate.
        series: `[time]` the term along the record.
        relative: whether the estimate is a share of the value at the place.
        explained: share of the residual's sum of squares above the noise that it takes.
        pieces: effective number of them, for smooth as it is.
        likelihood: twice its logarithm with this term, less Bayes' price for its pieces; for one output.
        alike: other places and quantities, by whose curves the record is explained as well, `(place, quantity)`.

    """

    place: str
    unit: str
    quantity: str
    quantity_unit: str
    at: Float[np.ndarray, " knot"]
    estimate: Float[np.ndarray, " knot"]
    deviation: Float[np.ndarray, " knot"]
    series: Float[np.ndarray, " time"]
    relative: bool
    explained: float
    pieces: float
    likelihood: float
    alike: tuple[tuple[str, str], ...]


class _Curve(NamedTuple):
    """Straight pieces along one quantity at one place: `[piece, time]`, and the knots."""

    place: str
    quantity: str
    knots: Float[np.ndarray, " knot"]
    pieces: Float[np.ndarray, "piece time"]
    relative: bool


def quantities(bench: Workbench) -> dict[str, Float[np.ndarray, " time"]]:
    """Return what runs along the nominal model and varies, each once: the inputs, outputs, signals, their contexts."""
    record_time = np.arange(bench.problem.samples.inputs.shape[1]) * float(bench.problem.samples.sample_period[0])
    inputs = bench.problem.samples.inputs[0]
    found = {TIME: record_time}
    found |= {name: inputs[:, k] for k, name in enumerate(bench.fit.model.inputs)}
    # The outputs first: of two names for one motion that of the sensor is the one that people know.
    found |= {name: bench.internal.values[name] for name in bench.problem.observed if name in bench.internal.values}
    found |= dict(bench.internal.values)
    for context in bench.internal.contexts.values():
        for name, series in context.items():
            found.setdefault(name, series)
    kept: dict[str, np.ndarray] = {}
    for name, series in found.items():
        if not np.all(np.isfinite(series)) or np.ptp(series) <= 1e-9 * (np.max(np.abs(series)) + 1e-300):
            continue
        alike = (abs(np.corrcoef(series, other)[0, 1]) > 0.9999 for other in kept.values())
        if not any(alike):
            kept[name] = series
    return kept


def curve_responses(
    bench: Workbench, point: Float[np.ndarray, " parameter"], seen: Mapping[str, Float[np.ndarray, " time"]]
) -> Float[np.ndarray, "response record time signal"]:
    """Return what each piece of every curve does to the outputs of a point."""
    return _responses(bench, point, _tested(bench, seen))


def strongest_dependence(
    bench: Workbench, current: Refits, white: Whitening, seen: Mapping[str, Float[np.ndarray, " time"]]
) -> float:
    """Return the noise variances that a term of free form takes of a residual, more than noise would give."""
    _, bases, r = _examined(bench, current, white, seen)
    return max(float(np.sum((q.T @ r) ** 2)) - q.shape[1] for q in bases)


def dependences(
    bench: Workbench, final: Refits, white: Whitening, seen: Mapping[str, Float[np.ndarray, " time"]]
) -> tuple[Dependence, ...]:
    """Test whether a residual still depends on anything, the most significant first.

    Args:
        bench: the trials' workbench.
        final: the refit whose residual is judged.
        white: of its noise.
        seen: the quantities.

    """
    curves, bases, r = _examined(bench, final, white, seen)
    p_values = [float(_p_value((q.T @ r)[None])[0]) for q in bases]
    null = smallest_p_values(bases, [_p_value] * len(bases), seed=1)
    found = [
        Dependence(
            curve.place, curve.quantity, p, corrected(p, null, len(curves)),
            float(np.sum((q.T @ r) ** 2)) - q.shape[1], len(curve.pieces),
        )
        for curve, q, p in zip(curves, bases, p_values, strict=True)
    ]  # fmt: skip
    return tuple(sorted(found, key=lambda d: (d.p_value, -d.explained)))


def _examined(bench: Workbench, final: Refits, white: Whitening, seen):
    """Return the curves that could show at all, orthonormal directions of each, and the residual, all whitened."""
    curves = _tested(bench, seen)
    known, r = _unexplained(final, white)
    changes = white(_responses(bench, final.points[0], curves))
    rows = np.split(changes, np.cumsum([len(c.pieces) for c in curves])[:-1])
    shown = [(curve, q) for curve, part in zip(curves, rows, strict=True) if (q := _outside(known, part)).shape[1]]
    return [curve for curve, _ in shown], [q for _, q in shown], r


def _p_value(components: Float[np.ndarray, "draw direction"]) -> Float[np.ndarray, " draw"]:
    from scipy.special import chdtrc

    return chdtrc(components.shape[-1], np.sum(components**2, axis=-1))


def missing_term(
    bench: Workbench,
    final: Refits,
    white: Whitening,
    seen: Mapping[str, Float[np.ndarray, " time"]],
    suspects: Sequence[Dependence],
) -> MissingTerm:
    """Estimate the term that takes most of what is left, at the place and along the quantity that explain most.

    Places and quantities are compared by curves with as many pieces as they deserve (Bayes criterion). The estimate
    that is returned has many pieces and is as smooth as the record says.

    Each suspect is estimated, put into the simulation, and estimated again, for a large term is not linear: the one
    that then leaves least is it. Some make the same record by algebra (a load that depends on the opening alone is a
    change of the opening): among those that explain alike, the one at whose place the quantity is at home.
    """
    known, r = _unexplained(final, white)

    def attempted(place, quantity, pieces):
        return _settled(bench, final, white, _curve(bench, place, quantity, seen, pieces))

    def with_price(attempt):
        return attempt.left + len(attempt.coefficients) * np.log(len(r))

    attempts = [attempted(s.place, s.quantity, max(s.pieces, _FINE[0])) for s in suspects]
    least = min(with_price(a) for a in attempts)
    alike = [a for a in attempts if with_price(a) < least + INSEPARABLE]
    first = min(alike, key=lambda a: (a.curve.place != a.curve.quantity, with_price(a)))
    place, quantity = first.curve[:2]
    best = min([first, *(attempted(place, quantity, pieces) for pieces in _FINE)], key=with_price)
    knots = max(len(best.coefficients), len(r) // _SAMPLES_PER_KNOT)
    finest = min(attempted(place, quantity, knots), best, key=lambda a: a.left)
    curve, probe = finest.curve, _probe(bench, place)
    smooth = _smoothed(finest)
    estimate, deviation = smooth.coefficients * probe, smooth.deviation * probe
    excess = float(r @ r) - (len(r) - known.shape[1])
    taken = float(r @ r) - smooth.left - smooth.pieces
    return MissingTerm(
        place=place,
        unit="" if curve.relative else bench.fit.model.unit(place),
        quantity=quantity,
        quantity_unit=quantity_unit(bench.fit.model, quantity),
        at=curve.knots,
        estimate=estimate,
        deviation=deviation,
        series=estimate @ curve.pieces,
        relative=curve.relative,
        explained=float(np.clip(taken / max(excess, 1e-300), 0.0, 1.0)),
        pieces=smooth.pieces,
        likelihood=likelihood(smooth.left, len(r), white) - smooth.pieces * float(np.log(len(r))),
        alike=tuple(dict.fromkeys(a.curve[:2] for a in alike if a.curve[:2] != (place, quantity))),
    )


def likelihood(left: float, count: int, white: Whitening) -> float:
    """Return twice the logarithm of the likelihood of whitened residuals with this sum of squares, at its best."""
    return -float(count * np.log(white.noises[0].innovation_variance * left / count)) - count


class _Attempt(NamedTuple):
    """A curve, where it has settled.

    Attributes:
        curve: its pieces.
        coefficients: in probes.
        left: the sum of squares of the whitened residual that it leaves.
        residual: that residual.
        responses: whitened, of each piece, outside of what the refitted unknowns can do.

    """

    curve: _Curve
    coefficients: Float[np.ndarray, " piece"]
    left: float
    residual: Float[np.ndarray, " sample"]
    responses: Float[np.ndarray, "piece sample"]


def _settled(bench: Workbench, final: Refits, white: Whitening, curve: _Curve) -> _Attempt:
    """Estimate a curve together with the refitted unknowns, by Levenberg-Marquardt steps of several dampings each."""
    samples = bench.problem.samples
    own = np.flatnonzero(final.chosen[0] >= 0)
    columns = final.chosen[0][own]
    lower, upper = bounds_of(bench)
    point, coefficients = final.points[0].copy(), np.zeros(len(curve.pieces))
    rows = np.concatenate([white(final.slopes[0][own]), white(_responses(bench, final.points[0], [curve]))])
    r = white(final.residual[0])
    left = float(r @ r)
    for step in range(_STEPS):
        if step:
            rows = white(_slopes(bench, point, columns, coefficients, curve))
        points, curves = [], []
        for change in _damped_steps(rows, r):
            moved = point.copy()
            moved[columns] = np.clip(point[columns] + change[: len(own)], lower[columns], upper[columns])
            points.append(moved)
            curves.append(coefficients + change[len(own) :])
        residuals = white(samples.outputs - _with_curve(bench, np.stack(points), np.stack(curves), curve))
        costs = np.nan_to_num(np.sum(residuals**2, axis=1), nan=np.inf)
        best = int(np.argmin(costs))
        gain = left - costs[best]
        if gain > 0:
            point, coefficients, r, left = points[best], curves[best], residuals[best], float(costs[best])
        if not gain > max(_SETTLED, _SETTLED_SHARE * left):
            break
    known = span(rows[: len(own)])
    responses = rows[len(own) :] - (rows[len(own) :] @ known) @ known.T
    return _Attempt(curve, coefficients, left, r - known @ (known.T @ r), responses)


class _Smooth(NamedTuple):
    """A smooth curve: coefficients and deviations, in probes, its effective pieces, the sum of squares it leaves."""

    coefficients: Float[np.ndarray, " piece"]
    deviation: Float[np.ndarray, " piece"]
    pieces: float
    left: float


def _smoothed(attempt: _Attempt) -> _Smooth:
    """Return a curve as smooth as the record says.

    Second derivatives are a priori normal numbers, whose variance has the largest marginal likelihood (Wahba 1985; the
    same as restricted maximum likelihood). What refitted unknowns could do instead, such as a constant share of the
    flow, cannot be told and is left out.
    """
    from scipy.optimize import minimize_scalar

    knots = attempt.curve.knots
    # A misfit that is left counts as noise.
    variance = max(attempt.left / len(attempt.residual), 1.0)
    information = attempt.responses @ attempt.responses.T / variance
    along = attempt.responses @ attempt.residual / variance + information @ attempt.coefficients
    apart = np.diff((knots - knots[0]) / (knots[-1] - knots[0]))
    slopes = np.diff(np.eye(len(knots)), axis=0) / apart[:, None]
    curvatures = np.diff(slopes, axis=0) / np.sqrt(0.5 * (apart[1:] + apart[:-1]))[:, None]
    roughness = curvatures.T @ curvatures
    scale = float(np.trace(information) / np.trace(roughness))

    def solved(log_share):
        values, vectors = np.linalg.eigh(information + np.exp(log_share) * scale * roughness)
        told = values > _SHOWN**2 * values[-1]
        covariance = (vectors[:, told] / values[told]) @ vectors[:, told].T
        return covariance, float(np.sum(np.log(values[told])))

    def cost(log_share):
        covariance, volume = solved(log_share)
        return volume - len(curvatures) * log_share - float(along @ covariance @ along)

    shares = np.linspace(*_LOG_SMOOTHNESS, 25)
    start = shares[int(np.argmin([cost(share) for share in shares]))]
    width = shares[1] - shares[0]
    best = minimize_scalar(cost, bounds=(start - width, start + width), method="bounded").x
    covariance, _ = solved(best)
    coefficients = covariance @ along
    residual = attempt.residual - (coefficients - attempt.coefficients) @ attempt.responses
    return _Smooth(
        coefficients,
        np.sqrt(np.maximum(np.diag(covariance), 0.0)),
        float(np.sum(covariance * information)),
        # What the unknowns took beside the curve stays taken.
        attempt.left + float(residual @ residual - attempt.residual @ attempt.residual),
    )


def _slopes(bench: Workbench, point, columns, coefficients, curve: _Curve):
    """Return the derivatives of the outputs by unknowns and by a curve's coefficients, while the curve acts."""
    count = 1 + len(columns) + len(coefficients)
    points, curves = np.repeat(point[None], count, axis=0), np.repeat(coefficients[None], count, axis=0)
    unknowns = np.arange(len(columns))
    points[1 + unknowns, columns] += _DIFFERENCE
    curves[1 + len(columns) :] += np.eye(len(coefficients))
    outputs = _with_curve(bench, points, curves, curve)
    slopes = outputs[1:] - outputs[0]
    slopes[: len(columns)] /= _DIFFERENCE
    return slopes


def _with_curve(bench: Workbench, points, coefficients, curve: _Curve):
    """Return the outputs of points with a curve acting at its place."""
    shape = bench.problem.samples.outputs.shape
    series = _probe(bench, curve.place) * (coefficients @ curve.pieces)
    if curve.place not in bench.places:
        outputs = bench.simulated(points)
        outputs[:, 0, :, bench.problem.observed.index(curve.place)] += series
        return outputs
    added = np.zeros((len(points), *shape[:2], len(bench.places)))
    size = bench.internal.values[curve.place] if curve.relative else 1.0
    added[:, 0, :, bench.places.index(curve.place)] = series * size
    return bench.simulated(points, added)


def _curve(bench, place, quantity, seen, pieces) -> _Curve:
    (curve,) = _curves(bench, place, {quantity: seen[quantity]}, pieces)
    return curve


def _tested(bench, seen) -> list[_Curve]:
    """Return the curves of all tests."""
    coarse = [c for place in _places(bench) for c in _curves(bench, place, seen, _COARSE)]
    pieces = min(_CLOSE, bench.problem.samples.outputs.shape[1] // _SAMPLES_PER_PIECE)
    if pieces <= _COARSE:
        return coarse
    outputs = {name: seen[name] for name in bench.problem.observed if name in seen}
    return coarse + [c for place in bench.places for c in _curves(bench, place, outputs, pieces)]


def _places(bench: Workbench) -> tuple[str, ...]:
    return (*bench.places, *bench.problem.observed)


def _curves(bench, place, seen, pieces) -> list[_Curve]:
    """Return curves of straight pieces along every quantity at a place."""
    kinds = {s.name: s.kind for s in bench.fit.model.signals}
    relative = kinds[place] == "opening"
    found = []
    for name, series in seen.items():
        knots = np.unique(np.quantile(series, np.linspace(0.0, 1.0, pieces)))
        if len(knots) < 4:
            # Held levels, of which most samples have the same: spread over the range.
            knots = np.linspace(series.min(), series.max(), pieces)
        hats = np.stack([np.interp(series, knots, np.eye(len(knots))[k]) for k in range(len(knots))])
        found.append(_Curve(place, name, knots, hats, relative))
    return found


def _probe(bench: Workbench, place: str) -> float:
    """Return the size of a small disturbance at a place: a share of its value where it has one."""
    kinds = {s.name: s.kind for s in bench.fit.model.signals}
    if kinds[place] == "opening" or place in bench.problem.observed:
        return _PROBE
    largest = float(np.max(np.abs(bench.internal.values[place])))
    return _PROBE * largest if largest > 0 else _PROBE


def _responses(bench: Workbench, point, curves: Sequence[_Curve]) -> Float[np.ndarray, "piece record time signal"]:
    """Return what each piece of curves, as large as a probe, does to the outputs."""
    samples = bench.problem.samples
    inside = [c for c in curves if c.place in bench.places]
    added = np.zeros((1 + sum(len(c.pieces) for c in inside), *samples.outputs.shape[:2], len(bench.places)))
    row = 1
    for curve in inside:
        size = bench.internal.values[curve.place] if curve.relative else 1.0
        place = bench.places.index(curve.place)
        added[row : row + len(curve.pieces), 0, :, place] = _probe(bench, curve.place) * curve.pieces * size
        row += len(curve.pieces)
    outputs = bench.simulated(np.repeat(point[None], len(added), axis=0), added) if inside else None
    changes, row = [], 1
    for curve in curves:
        if curve.place in bench.places:
            assert outputs is not None
            changes.append(outputs[row : row + len(curve.pieces)] - outputs[0])
            row += len(curve.pieces)
        else:
            sensed = np.zeros((len(curve.pieces), *samples.outputs.shape))
            sensed[:, 0, :, bench.problem.observed.index(curve.place)] = _PROBE * curve.pieces
            changes.append(sensed)
    return np.concatenate(changes)


def _unexplained(final: Refits, white: Whitening):
    known = span(white(final.slopes[0]))
    r = white(final.residual[0])
    return known, r - known @ (known.T @ r)


def _outside(known, responses) -> Float[np.ndarray, "sample independent"]:
    """Return an orthonormal basis of the responses outside what the unknowns can do."""
    norms = np.linalg.norm(responses, axis=1)
    rows = responses[norms > 0] / norms[norms > 0, None]
    rows = rows - (rows @ known) @ known.T
    vectors, values, _ = np.linalg.svd(rows.T, full_matrices=False)
    return vectors[:, values > 1e-4 * max(values[0], 1e-300)] if len(values) else np.zeros((rows.shape[1], 0))


def _decomposed(rows):
    """Return the singular vectors and values of responses of unit length, and these lengths' inverses."""
    norms = np.linalg.norm(rows, axis=1)
    scale = np.where(norms > 0, 1.0 / np.where(norms > 0, norms, 1.0), 0.0)
    return *np.linalg.svd((rows * scale[:, None]).T, full_matrices=False), scale


def _damped_steps(rows, r) -> list[Float[np.ndarray, " direction"]]:
    """Return Levenberg-Marquardt steps of several dampings; what the record does not show at all stays where it is."""
    vectors, values, others, scale = _decomposed(rows)
    along = vectors.T @ r
    shown = values > _SHOWN * values[0]
    return [scale * (others.T @ (np.where(shown, values / (values**2 + d + 1e-300), 0.0) * along)) for d in _DAMPINGS]


def quantity_unit(model: Model, name: str) -> str:
    """Return the unit of something that runs along a model, a signal or what comes with one."""
    units = {TIME: "s"} | {s.name: s.unit for s in model.signals}
    # A dimensionless model has no units but that of time.
    if model.unit(model.outputs[0]):
        units = {"velocity": "m/s", "flow": "m^3/s", "load_force": "N"} | units
    return units.get(name, "")
