"""The recipe of a diagnosis on one screen: refit, screen, search, judge, extend, measure the gain."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from ehsvjax.diagnose.diagnosis import Alternative, Diagnosis, Excluded
from ehsvjax.diagnose.gain import gain_of
from ehsvjax.diagnose.misfit import Misfit, misfit_of
from ehsvjax.diagnose.missing import Dependence, MissingTerm, dependences, likelihood, missing_term
from ehsvjax.diagnose.noise import Whitening, noise_outside, spikes
from ehsvjax.diagnose.process_noise import CONVINCING, process_noise
from ehsvjax.diagnose.refits import Refits, padded, refit
from ehsvjax.diagnose.selection import SIGNIFICANT, Selection, candidate_numbers, plain_noise, required_gain, select
from ehsvjax.diagnose.workbench import Workbench, workbench
from ehsvjax.effects import BANK
from ehsvjax.effects.effect import UNLIMITED, Effect
from ehsvjax.effects.extended import extended
from ehsvjax.fit import Fit
from ehsvjax.models.model import Parameter
from ehsvjax.population import to_values
from ehsvjax.record import Record

QUANTISATION = "sensor_quantisation"
PROCESS_NOISE = "process_noise"
# Dependences that are followed up where something is left.
_SUSPECTS = 8
# Power of a test at the smallest size that is said to have shown: 95%.
_POWER_QUANTILE = 1.6449
# Response of a candidate and of another that are called alike.
_CONFOUNDED = 0.95
# Share of what could be explained that must be, for causes to be named although something is left.
_EXPLAINED = 0.9


def diagnose(
    fit: Fit,
    record: Record,
    validation: Record | None = None,
    *,
    key: Key[Array, ""],
    bank: Sequence[Effect] = BANK,
    progress: bool = False,
) -> Diagnosis:
    """Say what a fitted model gets wrong on a record, name the cause, extend the model and measure the gain.

    Every effect of the bank is tried at every signal of the model that takes it; see `ehsvjax.effects` for how to add
    one of yours. The first call for a model and a record's length compiles for some 20 s, further ones nothing.

    Args:
        fit: of the model, by `identify`.
        record: measured; the one that was fitted, or another.
        validation: another record, on which the gain is measured; by default the last 30% of the record are held back
            for it.
        key: random key, `jax.random.key(0)`, for the intervals of the gain.
        bank: the candidate effects.
        progress: print each stage.

    Raises:
        ValueError: for what is no fit, no record or no key, or a record that lacks an input or has no output.

    """
    _check(fit, record, validation, key, bank)
    say = _announce if progress else _silent
    say("simulating the model")
    bench, outliers = _without_spikes(workbench(fit, record, bank), fit)
    selection = select(bench, say)
    say("testing what is left")
    after = dependences(selection.bench, selection.final, selection.white, selection.seen)
    innocent = not _depends(selection, after)
    selection, shaken = _random_force(selection, innocent)
    innocent = innocent or shaken
    if innocent:
        selection = replace(selection, white=_own_noise(selection))
    misfit = misfit_of(selection, outliers, after)
    without_form = len(selection.included) > 1 and _better_without_form(selection)
    verdict, causes, alternatives = _verdict(selection, misfit, innocent, shaken, without_form)
    missing = None
    if verdict == "unexplained" or not innocent:
        missing = _missing(selection, after, without_form)
    say("measuring the gain")
    nominal, wider = (
        _as_fit(selection, _ordinary(selection, refits, included), included, record)
        for refits, included in ((selection.nominal, ()), (selection.final, selection.included))
    )
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key) if _typed(key) else key).tolist())
    gain = gain_of(selection, nominal, wider, validation, rng)
    if verdict == "unexplained" and any(g.rmse_after > g.rmse_before for g in gain.outputs.values()):
        # What was added on the way to no explanation does not predict: it is left out again.
        wider = nominal
        gain = gain_of(selection, nominal, wider, validation, rng, added=False)
    return Diagnosis(
        verdict=verdict,
        causes=causes,
        alternatives=alternatives,
        table=_table(selection),
        extended=wider,
        gain=gain,
        misfit=misfit,
        excluded=_excluded(selection, causes),
        unseen=_unseen(selection, causes),
        innocent=innocent,
        missing=missing,
        fit=fit,
        record=record,
    )


def _announce(stage: str) -> None:
    print(f"diagnose: {stage}", flush=True)


def _silent(stage: str) -> None:
    del stage


def _typed(key) -> bool:
    return jnp.issubdtype(key.dtype, jax.dtypes.prng_key)


def _check(fit, record, validation, key, bank) -> None:
    if not isinstance(fit, Fit):
        raise ValueError(f"expected a fit as identify returns it, got {type(fit).__name__}")
    for name, one in (("record", record), ("validation", validation)):
        if not isinstance(one, Record) and not (name == "validation" and one is None):
            raise ValueError(f"expected {name} to be a Record, got {type(one).__name__}: make one with Record.from_csv")
        if one is not None and not set(one.outputs) & set(fit.outputs):
            raise ValueError(
                f"expected {name} to hold an output that was fitted, {', '.join(fit.outputs)}; it has "
                f"{', '.join(one.outputs) or 'none'}"
            )
    if set(record.outputs) - set(fit.outputs):
        raise ValueError(
            f"expected a record with outputs that were fitted, {', '.join(fit.outputs)}; it also has "
            f"{', '.join(sorted(set(record.outputs) - set(fit.outputs)))}: drop them with .select, or fit them too"
        )
    if not (isinstance(key, jax.Array) and (_typed(key) or key.shape == (2,))):
        raise ValueError(f"expected key to be a random key such as jax.random.key(0), got {key!r}")
    if not bank or not all(isinstance(effect, Effect) for effect in bank):
        raise ValueError("expected bank to be a sequence of effects, such as (*ehsvjax.effects.BANK, my_effect)")


def _without_spikes(bench: Workbench, fit: Fit):
    """Return the bench without readings that stand alone, and where they are."""
    samples = bench.problem.samples
    residual = samples.outputs - bench.simulated(bench.nominal[None])[0]
    alone = spikes(residual, samples.measured, samples.outputs)
    kept = samples._replace(measured=samples.measured & ~alone)
    return replace(bench, problem=replace(bench.problem, samples=kept)), alone


def _depends(selection: Selection, tests: tuple[Dependence, ...]) -> bool:
    """Whether what is left depends on something, also if it is itself taken for coloured noise."""
    if tests[0].corrected >= SIGNIFICANT:
        return False
    own = _own_noise(selection)
    if not own.coloured:
        return True
    return dependences(selection.bench, selection.final, own, selection.seen)[0].corrected < SIGNIFICANT


def _own_noise(selection: Selection) -> Whitening:
    """Return the noise if all that is left is noise."""
    final = selection.final
    return noise_outside(final.residual[0], selection.bench.problem.samples.measured, final.slopes[0])


def _random_force(selection: Selection, innocent: bool) -> tuple[Selection, bool]:
    """Return the selection, and whether a random force explains the nominal model's residual better than any cause.

    Then it is without the causes: what they seemed to explain was the motion that the force had left behind.
    """
    bench = selection.bench
    nominal = process_noise(bench, selection.nominal)
    if nominal is None or not nominal.likelihood - nominal.of_sensor > CONVINCING:
        return selection, False
    if not innocent:
        # A term that depends on what runs along the model is a better reason than chance.
        seen, white = selection.seen, selection.white
        suspects = dependences(bench, selection.nominal, white, seen)[:_SUSPECTS]
        if missing_term(bench, selection.nominal, white, seen, suspects).likelihood > nominal.likelihood:
            return selection, False
    if not selection.included:
        return selection, True
    final = process_noise(bench, selection.final)
    assert final is not None
    numbers = sum(candidate_numbers(bench, i) for i in selection.included) - 1
    count = bench.problem.samples.measured.sum()
    # Causes that leave nothing unexplained have the first word.
    margin = CONVINCING if innocent else 0.0
    if nominal.likelihood - final.of_sensor + numbers * np.log(count) > margin:
        bare = replace(selection, included=(), final=selection.nominal, rivals=(), gains=())
        return bare, True
    return selection, False


def _missing(selection: Selection, after: tuple[Dependence, ...], without_form: bool) -> MissingTerm:
    """Return what is missing beside the causes that were found, or in the place of them all."""
    bench, white, seen = selection.bench, selection.white, selection.seen
    if without_form:
        suspects = dependences(bench, selection.nominal, white, seen)
        return missing_term(bench, selection.nominal, white, seen, suspects[:_SUSPECTS])
    return missing_term(bench, selection.final, white, seen, after[:_SUSPECTS])


def _better_without_form(selection: Selection) -> bool:
    """Whether one term of free form explains the record better than several causes together: the bank lacks it."""
    bench, white = selection.bench, selection.white
    suspects = dependences(bench, selection.nominal, white, selection.seen)[:_SUSPECTS]
    term = missing_term(bench, selection.nominal, white, selection.seen, suspects)
    r = white(selection.final.residual[0])
    numbers = sum(candidate_numbers(bench, i) for i in selection.included)
    return term.likelihood > likelihood(float(r @ r), len(r), white) - numbers * float(np.log(len(r)))


def _verdict(selection: Selection, misfit: Misfit, innocent: bool, shaken: bool, without_form: bool):
    """Return the verdict, the causes and the alternatives."""
    bench = selection.bench
    order = np.argsort([-gain for gain in selection.gains])
    groups = [
        tuple(dict.fromkeys(bench.candidates[r.candidate].name for r in selection.rivals[k])) for k in order
    ]  # fmt: skip
    coarse = tuple(
        name for name, m in misfit.outputs.items()
        if m.lattice is not None and m.lattice**2 / 12.0 > 0.5 * m.noise_floor**2
    )  # fmt: skip
    quantised = tuple(QUANTISATION if len(misfit.outputs) == 1 else f"{QUANTISATION}@{name}" for name in coarse)
    removed = float(selection.nominal.cost[0] - selection.final.cost[0])
    left = max(misfit.tests_after[0].explained, 0.0)
    explained = removed / max(removed + left, 1e-300)
    if without_form or (not innocent and (not groups or explained < _EXPLAINED)):
        return "unexplained", (), ()
    causes = tuple(group[0] for group in groups) + quantised + ((PROCESS_NOISE,) if shaken else ())
    if not causes:
        return "adequate", (), ()
    alternatives = tuple(
        Alternative(group, _settled_by(bench, group)) for group in groups if len(group) > 1
    )  # fmt: skip
    return ("ambiguous" if alternatives else "named"), causes, alternatives


def _settled_by(bench: Workbench, group: tuple[str, ...]) -> str:
    ways = {c.name: c.effect.settled_by for c in bench.candidates if c.effect.settled_by}
    return "; ".join(dict.fromkeys(f"{name}: {ways[name]}" for name in group if name in ways))


def _values(bench: Workbench, point):
    values = to_values(bench.problem.coordinates, point)
    problem = bench.problem
    parameters = {n: float(values[bench.column[n]]) for n in bench.fit.model.free}
    initial = {n: float(v[0]) for n, v in problem.known_initial.items()}
    initial |= {n: float(values[bench.column[n]]) for n in problem.free_initial}
    return parameters, initial


def _ordinary(selection: Selection, refits: Refits, included: tuple[int, ...]) -> Refits:
    """Return a refit by least squares, as `identify` fits, which coloured noise does not weight."""
    if not selection.white.coloured:
        return refits
    bench = selection.bench
    white = plain_noise(bench, np.array(list(_variances(selection, refits).values())))
    own = [j for i in included for j in bench.columns_of(bench.candidates[i])]
    columns = padded([[*bench.base_columns, *own]], refits.chosen.shape[1])
    return refit(bench, refits.points, columns, white)


def _variances(selection: Selection, refits: Refits) -> dict[str, float]:
    problem = selection.bench.problem
    return {
        name: float(np.mean(refits.residual[0][..., i][problem.samples.measured[..., i]] ** 2))
        for i, name in enumerate(problem.observed)
    }


def _as_fit(selection: Selection, refits: Refits, included: tuple[int, ...], record: Record) -> Fit:
    """Return a refit as an ordinary fit, of the nominal model or of the model with the effects found."""
    bench = selection.bench
    parameters, initial = _values(bench, refits.points[0])
    attached = tuple(bench.candidates[i] for i in included)
    numbers = {}
    for candidate in attached:
        for number in candidate.effect.parameters:
            name = candidate.parameter(number.name)
            value = bench.value(refits.points[0], name)
            scales = bench.scales[candidate.name]
            lower, upper = number.lower(scales), number.upper(scales)
            reach = 10.0 * abs(value) or bench.problem.coordinates.upper[bench.column[name]]
            lower = -reach if lower <= -UNLIMITED else min(lower, value)
            upper = reach if upper >= UNLIMITED else max(upper, value)
            parameters[name] = value
            numbers[name] = Parameter(name, name, bench.model.parameter(name).unit, value, lower, upper)
    model = bench.fit.model
    if attached:
        model = extended(model, attached, numbers, len(record) * record.sample_period)
    parameters = {name: parameters[name] for name in model.free}
    return replace(
        bench.fit,
        model=model,
        records=(record,),
        parameters=parameters,
        initial=(initial,),
        noise_variance=_variances(selection, refits),
        effort=bench.fit.effort._replace(refined=True, converged=bool(refits.converged[0])),
        warnings=_at_bounds(model, parameters),
    )


def _at_bounds(model, parameters) -> tuple[str, ...]:
    found = []
    for name, value in parameters.items():
        p = model.parameter(name)
        width = p.upper - p.lower
        for side, bound in (("lower", p.lower), ("upper", p.upper)):
            if abs(value - bound) < 1e-6 * width:
                found.append(f"{name} is at its {side} bound: widen bounds={{{name!r}: ...}} or fix it")
    return tuple(found)


class _Row(NamedTuple):
    cause: str
    signal: str
    size: float
    unit: str
    score: float
    p_value: float
    p_corrected: float
    likelihood_gain: float
    smallest_detectable: float
    confounded_with: str
    included: bool


def _table(selection: Selection):
    """Return all candidates on the nominal model, those that were included first."""
    import pandas as pd

    bench = selection.bench
    screening = selection.stages[0].screening
    responses = np.array([s.response for s in screening.ranked])
    alike = np.abs(responses @ responses.T) if len(responses) else np.zeros((0, 0))
    detectable = _detectable(selection)
    gains = dict(zip(selection.included, selection.gains, strict=True))
    rows = []
    for k, s in enumerate(screening.ranked):
        candidate = bench.candidates[s.candidate]
        number = candidate.effect.parameters[0]
        name = candidate.parameter(number.name)
        included = s.candidate in gains
        others = dict.fromkeys(
            bench.candidates[o.candidate].name
            for j, o in enumerate(screening.ranked) if j != k and alike[k, j] > _CONFOUNDED
        )  # fmt: skip
        rows.append(
            _Row(
                candidate.name,
                candidate.signal,
                bench.value(selection.final.points[0], name) if included else s.amount,
                bench.model.parameter(name).unit,
                s.score,
                s.p_value,
                s.corrected,
                gains.get(s.candidate, s.score**2),
                detectable.get(s.candidate, float("nan")),
                ", ".join(n for n in others if n != candidate.name),
                included,
            )
        )
    rows.sort(key=lambda row: (not row.included, row.p_value, -abs(row.score)))
    table = pd.DataFrame(rows, columns=list(_Row._fields))
    unseen = [bench.candidates[i] for i in screening.unseen]
    blank = [
        _Row(c.name, c.signal, np.nan, bench.model.parameter(c.parameter(c.effect.parameters[0].name)).unit, np.nan,
             np.nan, 1.0, 0.0, np.inf, "the parameters", False)
        for c in unseen
    ]  # fmt: skip
    return pd.concat([table, pd.DataFrame(blank, columns=list(_Row._fields))], ignore_index=True) if blank else table


def _detectable(selection: Selection) -> dict[int, float]:
    """Return the smallest size of each candidate, in its first number's unit, that would have been found in 95%."""
    screening = selection.stages[-1].screening
    found = {}
    for s in screening.ranked:
        if np.isfinite(s.strength) and s.strength > 0:
            needed = np.sqrt(required_gain(selection.bench, screening, s.candidate))
            found[s.candidate] = (needed + _POWER_QUANTILE) / s.strength
    return found


def _excluded(selection: Selection, causes: tuple[str, ...]) -> tuple[Excluded, ...]:
    bench = selection.bench
    least: dict[str, Excluded] = {}
    for i, above in _detectable(selection).items():
        candidate = bench.candidates[i]
        number = candidate.effect.parameters[0]
        # A size beyond what makes sense is not excluded, it is not seen.
        if candidate.name in causes or above > number.upper(bench.scales[candidate.name]):
            continue
        unit = bench.model.parameter(candidate.parameter(number.name)).unit
        if candidate.name not in least or above < least[candidate.name].above:
            least[candidate.name] = Excluded(candidate.name, float(above), unit)
    return tuple(sorted(least.values(), key=lambda e: [c.name for c in bench.candidates].index(e.cause)))


def _unseen(selection: Selection, causes: tuple[str, ...]) -> tuple[str, ...]:
    bench = selection.bench
    known = {e.cause for e in _excluded(selection, causes)} | set(causes)
    limits = {c.name for c in bench.candidates if any(p.absent == UNLIMITED for p in c.effect.parameters)}
    seen = {bench.candidates[s.candidate].name for s in selection.stages[-1].screening.ranked} & limits
    names = dict.fromkeys(c.name for c in bench.candidates)
    return tuple(name for name in names if name not in known | seen)
