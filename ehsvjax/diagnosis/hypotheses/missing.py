"""What acts where, without a form assumed: missing terms at a signal as functions of what runs along the model.

A curve of straight pieces, or a single wave, is estimated while it acts in the simulation, together with the model's
own unknowns, and returned as smooth as the record says, with its band.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ehsvjax.diagnosis.bench.evidence import INSEPARABLE
from ehsvjax.diagnosis.bench.noise import Noise
from ehsvjax.diagnosis.bench.refits import Refits, refit, span, unexplained
from ehsvjax.diagnosis.bench.workbench import Workbench
from ehsvjax.diagnosis.hypotheses.curves import (
    TIME,
    Curve,
    along_records,
    bench_with,
    outputs_with,
    probe_at,
    quantity_unit,
    slopes_with,
    straight_along,
    wave_along,
)
from ehsvjax.diagnosis.hypotheses.dependence import Dependence
from ehsvjax.diagnosis.hypotheses.smoothing import Smooth, of_one_wave, smoothed
from ehsvjax.effects.free_form import FreeForm

# For each knot of the smooth curve.
_SAMPLES_PER_KNOT = 50
# Curves that are drawn with many pieces, of which one is returned.
_FINALISTS = 3
# Steps of the estimate of a curve, dampings of each that are simulated, and what the last one gains at most.
_STEPS = 8
_DAMPINGS = (0.0, 1e-4, 1e-2, 0.3, 10.0)
_SETTLED, _SETTLED_SHARE = 0.1, 1e-3
# Times that the least of equal terms is reweighted, and share of its height that counts as nothing in it.
_REWEIGHTED, _NOTHING = 30, 1e-3
# Share of what a term explains that straight pieces may lack of it.
_LACKED = 0.01
# Share of the strongest response of combined pieces below which a record shows nothing, and of their own one outside
# of what the unknowns can do, below which it is the unknowns'.
_SHOWN, _OWN = 1e-4, 0.01
# Share of the strongest response below which combined ones are rounding.
_INDEPENDENT = 1e-9


class MissingTerm(NamedTuple):
    """A missing term, estimated without assuming its form.

    Attributes:
        place: signal at which it acts, and `unit` its unit.
        quantity: that it depends on, and `quantity_unit`.
        at: `[knot]` values of the quantity.
        estimate: `[knot]` what is missing there, in the unit of the place.
        deviation: `[knot]` standard deviation of the estimate.
        series: `[time]` the term along the records, one after the other.
        relative: whether the estimate is a share of the value at the place.
        period: in the quantity's unit, if the term is a single wave along it; else None.
        explained: share of the residual's sum of squares above the noise that it takes.
        pieces: effective number of them, for smooth as it is; a single wave counts as three.
        residual: `[record, time, signal]` what the records are with it, less what is simulated.
        form: the term alone, as something that may act in other records: along the motion that was measured, where it
            was, and not along that of a model that lacks the term.
        alike: other terms, at other places or along other quantities, that explain the records as well.

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
    period: float | None
    explained: float
    pieces: float
    residual: Float[np.ndarray, "record time signal"]
    form: FreeForm
    alike: tuple[FreeForm, ...]


def missing_term(
    bench: Workbench,
    final: Refits,
    noise: Noise,
    seen: Mapping[str, Float[np.ndarray, "record time"]],
    suspects: Sequence[Dependence],
) -> tuple[MissingTerm, Curve]:
    """Estimate the term that takes most of what is left, at the place and along the quantity that explain most.

    Returns it, and the curve of which it is made.

    Each suspect is estimated, put into the simulation, and estimated again, for a large term is not linear. Those for
    which there is most evidence are drawn with many pieces. Some make the same record by algebra (a load that depends
    on the opening alone is a change of the opening): among those that explain alike, the one at whose place the
    quantity is at home.
    """
    known, r = unexplained(final, noise.scaled)
    knots = len(r) // _SAMPLES_PER_KNOT

    def drawn(suspect):
        if suspect.period is not None:
            curve = wave_along(bench, suspect.place, suspect.quantity, seen, suspect.period)
        else:
            curve = straight_along(bench, suspect.place, suspect.quantity, seen, suspect.pieces)
        return _drawn(bench, final, noise, curve, final.points[0], np.zeros(len(curve.values)))

    def drawn_finely(coarse):
        start = coarse.settled
        fine = straight_along(bench, *start.curve[:2], seen, max(len(start.coefficients), knots))
        begun = np.interp(fine.knots, start.curve.knots, start.coefficients @ start.curve.values)
        return min(coarse, _drawn(bench, final, noise, fine, start.point, begun), key=_cost)

    every = sorted((drawn(s) for s in suspects), key=_cost)
    different: dict[tuple[str, str], _Drawn] = {}
    for d in every:
        different.setdefault(d.settled.curve[:2], d)
    # Few pieces say little of a narrow term: what is at home has its chance as well.
    ranked = list(different.values())
    finalists = [drawn_finely(d) for d in [*ranked[:_FINALISTS], *filter(_at_home, ranked[_FINALISTS:])]]
    alike = _alike(finalists)
    # Whatever moves is a function of time: that is the last of all reasons.
    best = min(alike, key=lambda d: (not _at_home(d), d.settled.curve.quantity == TIME, d.cost))
    others: dict[tuple[str, str], _Drawn] = {}
    for d in (*alike, *_alike(every)):
        others.setdefault(d.settled.curve[:2], d)
    curve, smooth = best.settled.curve, best.smooth
    coefficients, form = _least_of(bench, best), _form_of(bench, best)
    probe = probe_at(bench, curve.place)
    variances = np.sum(curve.values * (smooth.covariance @ curve.values), axis=0)
    excess = float(r @ r) - (len(r) - known.shape[1])
    taken = float(r @ r) - best.left - smooth.pieces
    found = MissingTerm(
        place=curve.place,
        unit="" if curve.relative else bench.fit.model.unit(curve.place),
        quantity=curve.quantity,
        quantity_unit=quantity_unit(bench.fit.model, curve.quantity),
        at=curve.knots,
        estimate=probe * coefficients @ curve.values,
        deviation=probe * np.sqrt(variances),
        series=probe * along_records(curve, coefficients)[bench.present],
        relative=curve.relative,
        period=float(curve.periods[0]) if len(curve.periods) else None,
        explained=float(np.clip(taken / max(excess, 1e-300), 0.0, 1.0)),
        pieces=smooth.pieces,
        residual=best.residual,
        form=form,
        alike=tuple(_form_of(bench, d) for where, d in others.items() if where != curve[:2]),
    )
    return found, curve


def told_by(bench: Workbench, final: Refits, noise: Noise, curve: Curve) -> Workbench:
    """Return the bench with a curve that acts as the readings of this noise tell it, and no others."""
    drawn = _drawn(bench, final, noise, curve, final.points[0], np.zeros(len(curve.values)))
    return bench_with(bench, curve, drawn.smooth.coefficients)


def _form_of(bench: Workbench, drawn: "_Drawn") -> FreeForm:
    """Return a term as it acts, along what was measured of the motion, where that is what it depends on."""
    curve, samples = drawn.settled.curve, bench.problem.samples
    coefficients = probe_at(bench, curve.place) * _least_of(bench, drawn)
    if curve.quantity not in bench.problem.observed:
        return FreeForm(curve.place, curve.quantity, curve.knots, coefficients @ curve.values, curve.relative)
    output = bench.problem.observed.index(curve.quantity)
    known, series = samples.measured[..., output], along_records(curve, coefficients)
    acting = series[known]
    # What a sensor adds depends on what is there without it.
    added = series if curve.place == curve.quantity else 0.0
    along = (samples.outputs[..., output] - added)[known]
    parts = np.array_split(np.argsort(along), max(len(along) // _SAMPLES_PER_KNOT, 2))
    at, first = np.unique([along[part].mean() for part in parts], return_index=True)
    estimate = np.array([acting[part].mean() for part in parts])[first]
    return FreeForm(curve.place, curve.quantity, at, estimate, curve.relative)


def _least_of(bench: Workbench, drawn: "_Drawn") -> Float[np.ndarray, " piece"]:
    """Return the coefficients of a smooth curve, in probes, the least of those that explain the records as well."""
    curve, smooth, free = drawn.settled.curve, drawn.smooth, drawn.settled.free
    term, lines = (along_records(curve, of)[..., bench.present] for of in (smooth.coefficients, free))
    return smooth.coefficients + _least(term, lines) @ free


def _least(term, free) -> Float[np.ndarray, " line"]:
    """Return how much of what the unknowns make up for makes a term the least: a bump stands on nothing then.

    The least sum of absolute values along the record, by reweighted least squares.
    """
    amounts = np.zeros(len(free))
    for _ in range(_REWEIGHTED):
        size = np.abs(term + amounts @ free)
        weights = 1.0 / np.sqrt(np.maximum(size, _NOTHING * np.max(size) + 1e-300))
        amounts = -np.linalg.lstsq((free * weights).T, term * weights, rcond=None)[0]
    return amounts


class _Settled(NamedTuple):
    """A curve, where it has settled.

    Attributes:
        curve: its pieces.
        point: `[parameter]` of the unknowns beside it.
        coefficients: in probes.
        left: the sum of squares of the scaled residual that it leaves.
        readings: that residual with what the curve explains, outside of what the refitted unknowns can do.
        responses: of each piece, the same.
        free: straight lines that the unknowns make up for: any amount of them explains the record as well.

    """

    curve: Curve
    point: Float[np.ndarray, " parameter"]
    coefficients: Float[np.ndarray, " piece"]
    left: float
    readings: Float[np.ndarray, " sample"]
    responses: Float[np.ndarray, "piece sample"]
    free: Float[np.ndarray, "line piece"]


class _Drawn(NamedTuple):
    """A settled curve, smooth: what it leaves, and what would be left without it less the evidence for it."""

    settled: _Settled
    smooth: Smooth
    residual: Float[np.ndarray, "record time signal"]
    left: float
    cost: float


def _drawn(bench: Workbench, final: Refits, noise: Noise, curve: Curve, point, coefficients) -> _Drawn:
    settled = _settled(bench, final, noise, curve, point, coefficients)
    responses, readings = settled.responses, settled.readings
    if len(curve.periods):
        smooth = of_one_wave(responses, readings)
    else:
        smooth = smoothed(curve.knots, responses, readings, noise.along(responses))
    # What the unknowns took beside the curve stays taken.
    beside = settled.left - float(np.sum((readings - settled.coefficients @ responses) ** 2))
    without = beside + float(readings @ readings)
    # What the record hardly tells may have gone so far that the smooth curve is another one once it is simulated.
    beside_it = _refitted_beside(bench_with(bench, curve, smooth.coefficients), final, noise, settled.point)
    left = float(beside_it.cost[0])
    cost = without - smooth.evidence + max(left - beside - smooth.left, 0.0)
    return _Drawn(settled, smooth, beside_it.residual[0], left, cost)


def _refitted_beside(acting: Workbench, final: Refits, noise: Noise, point) -> Refits:
    """Return the refit of the unknowns beside a curve that acts, the better of those from two points."""
    starts = np.stack([point, final.points[0]])
    both = refit(acting, starts, np.repeat(final.chosen, 2, axis=0), noise, race=False)
    return both.of([int(np.argmin(both.cost))])


def _cost(drawn: _Drawn) -> float:
    return drawn.cost


def _at_home(drawn: _Drawn) -> bool:
    return drawn.settled.curve.place == drawn.settled.curve.quantity


def _alike(some: Sequence[_Drawn]) -> list[_Drawn]:
    """Return those that explain a record as well as the best of them.

    A term that is far above the noise shows what straight pieces between knots lack of it; nothing below tells places
    apart.
    """
    best = min(some, key=_cost)
    above = best.left - (len(best.settled.readings) - best.smooth.pieces)
    lacking = min(above, _LACKED * best.smooth.evidence)
    return [d for d in some if d.cost <= best.cost + max(INSEPARABLE, lacking)]


def _settled(bench: Workbench, final: Refits, noise: Noise, curve: Curve, point, coefficients) -> _Settled:
    """Estimate a curve together with the refitted unknowns, by Levenberg-Marquardt steps of several dampings each."""
    measured = bench.problem.samples.outputs
    columns = final.chosen[0][final.chosen[0] >= 0]
    lower, upper = bench.bounds
    r = noise.scaled(measured - outputs_with(bench, point[None], coefficients[None], curve)[0])
    left = float(np.nan_to_num(r @ r, nan=np.inf))
    for _ in range(_STEPS):
        rows = noise.scaled(slopes_with(bench, point, columns, coefficients, curve))
        unknowns, pieces = rows[: len(columns)], rows[len(columns) :]
        points, curves = [], []
        # In coordinates of what they span, as there are many more samples than pieces.
        spanned = np.asarray(np.linalg.qr(np.vstack([rows, r]).T, mode="r")).T
        for of_unknowns, of_pieces in _damped_steps(spanned[: len(columns)], spanned[len(columns) : -1], spanned[-1]):
            moved = point.copy()
            moved[columns] = np.clip(point[columns] + of_unknowns, lower[columns], upper[columns])
            points.append(moved)
            curves.append(coefficients + of_pieces)
        residuals = noise.scaled(measured - outputs_with(bench, np.stack(points), np.stack(curves), curve))
        with np.errstate(over="ignore"):  # a step too far may lead anywhere
            costs = np.nan_to_num(np.sum(residuals**2, axis=1), nan=np.inf)
        # The most damped of those as good: what the record hardly tells is not to wander.
        best = int(np.flatnonzero(costs <= np.min(costs) + _SETTLED)[-1])
        gain = left - costs[best]
        if gain > 0:
            point, coefficients, r, left = points[best], curves[best], residuals[best], float(costs[best])
        if not gain > max(_SETTLED, _SETTLED_SHARE * left):
            break
    known = span(unknowns)
    responses = _outside(pieces, known)
    readings = r - known @ (known.T @ r) + coefficients @ responses
    return _Settled(curve, point, coefficients, left, readings, responses, _free(curve, pieces, known))


def _damped_steps(unknowns, pieces, r) -> list[tuple[Float[np.ndarray, " unknown"], Float[np.ndarray, " piece"]]]:
    """Return Levenberg-Marquardt steps of several dampings each, from scaled responses.

    What the unknowns can do is theirs, and a curve stays where it is in whatever the record does not show beside them:
    a change that both can make would be shared, and the curve wander.
    """
    outside = _decomposed(_outside(pieces, span(unknowns)), np.linalg.norm(pieces, axis=1))
    inside = _decomposed(unknowns, np.linalg.norm(unknowns, axis=1))
    steps = []
    for damping in _DAMPINGS:
        of_pieces = _damped(outside, r, damping)
        steps.append((_damped(inside, r - of_pieces @ pieces, damping), of_pieces))
    return steps


def _outside(pieces, known) -> Float[np.ndarray, "piece sample"]:
    """Return responses outside of what the unknowns can do, and nothing of combinations that hardly reach beyond it."""
    norms = np.linalg.norm(pieces, axis=1)
    scaled = pieces[norms > 0] / norms[norms > 0, None]
    combinations, sines = _angles(scaled, known)
    own = combinations[sines > _OWN] @ scaled
    responses = np.zeros_like(pieces)
    responses[norms > 0] = norms[norms > 0, None] * (scaled @ own.T @ (own - (own @ known) @ known.T))
    return responses


def _free(curve: Curve, pieces, known) -> Float[np.ndarray, "line piece"]:
    """Return the straight lines along a curve that the unknowns make up for; no single wave has any."""
    if len(curve.periods):
        return np.zeros((0, len(curve.values)))
    straight = np.stack([np.ones(len(curve.knots)), (curve.knots - curve.knots.mean()) / np.ptp(curve.knots)])
    combinations, sines = _angles(straight @ pieces, known)
    return combinations[sines <= _OWN] @ straight


def _angles(responses, known) -> tuple[Float[np.ndarray, "direction response"], Float[np.ndarray, " direction"]]:
    """Return combinations of responses that are orthonormal, and how far each reaches beyond what the unknowns can do.

    As the sines of the principal angles between both (Bjorck and Golub 1973).
    """
    left, values, right = np.linalg.svd(responses, full_matrices=False)
    shown = values > _INDEPENDENT * values[0]
    turned, cosines, _ = np.linalg.svd(right[shown] @ known)
    sines = np.ones(len(turned))
    sines[: len(cosines)] = np.sqrt(np.maximum(1.0 - cosines**2, 0.0))
    return turned.T @ (left[:, shown] / values[shown]).T, sines


def _decomposed(responses, norms):
    """Return singular vectors and values of responses in units of these norms, and the units."""
    scale = np.where(norms > 0, 1.0 / np.where(norms > 0, norms, 1.0), 0.0)
    return *np.linalg.svd((responses * scale[:, None]).T, full_matrices=False), scale


def _damped(decomposed, r, damping: float) -> Float[np.ndarray, " direction"]:
    """Return damped least squares of decomposed responses; what is not shown at all stays where it is."""
    vectors, values, others, scale = decomposed
    shown = values > _SHOWN * values[0]
    return scale * (others.T @ (np.where(shown, values / (values**2 + damping + 1e-300), 0.0) * (vectors.T @ r)))
