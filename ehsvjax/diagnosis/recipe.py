"""The recipe of a diagnosis on one screen: refit, screen, search, judge, extend, measure the gain."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from ehsvjax.checks import flag
from ehsvjax.diagnosis.bench.progress import Progress
from ehsvjax.diagnosis.bench.progress import bar as progress_bar
from ehsvjax.diagnosis.bench.setup import workbench
from ehsvjax.diagnosis.bench.workbench import Workbench, with_readings
from ehsvjax.diagnosis.decision.examination import Examination, examine
from ehsvjax.diagnosis.decision.search import forward, select
from ehsvjax.diagnosis.decision.verdict import UNEXPLAINED, Verdict, may_be_unknown, verdict_of
from ehsvjax.diagnosis.hypotheses.own_effects import check_own_effects
from ehsvjax.diagnosis.hypotheses.process_noise import ProcessNoise
from ehsvjax.diagnosis.results.causes import causes_of
from ehsvjax.diagnosis.results.diagnosis import Diagnosis
from ehsvjax.diagnosis.results.explanations import explanations_of
from ehsvjax.diagnosis.results.extension import as_fit
from ehsvjax.diagnosis.results.gain import gain_of
from ehsvjax.diagnosis.results.misfit import misfit_of
from ehsvjax.diagnosis.results.suspects import excluded_by, table_of, unseen_by
from ehsvjax.doubts import mistaken_columns
from ehsvjax.draws import check_key
from ehsvjax.effects import BANK
from ehsvjax.effects.effect import Effect
from ehsvjax.fit import Fit
from ehsvjax.population import stack_records
from ehsvjax.readings import spikes
from ehsvjax.record import Record, checked_records
from ehsvjax.simulate import input_array

# Fewer cannot tell noise from misfit.
_LEAST_SAMPLES = 100


def diagnose(
    fit: Fit,
    records: Record | Sequence[Record],
    validation: Record | Sequence[Record] | None = None,
    *,
    key: Key[Array, ""],
    bank: Sequence[Effect] | None = None,
    progress: bool | None = None,
) -> Diagnosis:
    """Say what a fitted model gets wrong on records, name the cause, extend the model and measure the gain.

    Every effect of the bank is tried at every signal of the model that takes it; see `ehsvjax.effects` for how to add
    one of yours. The first call for a model and a record's length compiles for some 10 s, further ones nothing.

    Several records share the parameters of the model and the causes; each has its own length, sample period, outputs,
    known constants, initial conditions and noise, and of a cause that goes by its clock, a drift or a periodic force,
    its own amplitudes. Where they leave something together, each is asked by itself; if that explains every one,
    `alone` has what each says, and only what all of them say is named. Priors of the fit are left aside: the records
    alone are asked.

    Args:
        fit: of the model, by `identify`.
        records: measured, one or several; those that were fitted, or others.
        validation: other records, on which the gain is measured; by default each of several records is predicted from
            the others, and the last 30% of a single one are held back.
        key: random key, `jax.random.key(0)`, for the intervals of the gain.
        bank: the candidate effects; by default `ehsvjax.effects.BANK`.
        progress: show a bar with the stage and the time that is left; by default in a terminal or a notebook.

    Raises:
        ValueError: for what is no fit, no record or no key, a record that lacks an input, has no output or is short,
            columns of which another sign, unit or order explains what the fit does not, an effect of yours that fits no
            signal of the model, or one that is in the bank twice.

    """
    bank = _check_bank(BANK if bank is None else bank)
    measured = checked_records(records)
    unseen = () if validation is None else checked_records(validation, "validation")
    _check(fit, measured, unseen, key, progress)
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())
    # What a trial cannot simulate is infinite or no number, and never wins: nobody need be warned of it.
    with progress_bar(progress) as say, np.errstate(over="ignore", invalid="ignore"):
        return _diagnosed(fit, measured, unseen, bank, rng, say)


def _diagnosed(
    fit: Fit,
    records: tuple[Record, ...],
    validation: tuple[Record, ...],
    bank: tuple[Effect, ...],
    rng,
    say: Progress,
) -> Diagnosis:
    say("simulating the model", 0.0)
    # The records alone are asked: what was believed of the model may be what is wrong with it.
    bench = workbench(replace(fit, model=fit.model.without_priors()), records, bank)
    check_own_effects(bench, bank)
    bench, outliers = _without_spikes(bench)
    each_alone = cache(lambda: _each_alone(fit, records, bank, rng, say))
    looks = forward(bench, say)
    if looks[-1].leaves_something and any(not one.suspected for one in each_alone()):
        # Nothing that all share would be confirmed: what they leave together is weighed against nothing at all.
        looks = looks[:1]
    say("refitting the rivals", 0.5)
    selection = select(bench, looks)
    say("testing what is left", 0.8)
    examined = examine(selection)
    nominal = as_fit(examined.selection, selection.nominal, ())
    wider, gain, verdict = _judged(examined, nominal, validation, rng)
    alone = () if _explained(verdict.word, examined.innocent, examined.chance) else each_alone()
    disagree = bool(alone) and not _confirmed(verdict, alone)
    worse = gain.worse and may_be_unknown(examined.innocent, examined.chance)
    if selection.included and (disagree or worse or verdict is UNEXPLAINED):
        # What explains a part and predicts worse than nothing, stands for what single records have, or has not earned
        # its place beside what is missing, is left out again, and all is judged anew.
        examined = examine(selection.without_causes())
        wider, gain, verdict = _judged(examined, nominal, validation, rng)
    if disagree:
        verdict = UNEXPLAINED
    say("measuring the gain", 0.95)
    selection = examined.selection
    suspected = tuple(dict.fromkeys(name for group in verdict.groups for name in group))
    return Diagnosis(
        verdict=verdict.word,
        causes=causes_of(selection, verdict, examined.chance, wider),
        alternatives=verdict.alternatives,
        table=table_of(selection),
        significant_score=selection.stages[0].screening.threshold,
        extended=wider,
        gain=gain,
        misfit=misfit_of(examined, outliers),
        excluded=() if verdict.word == "unexplained" else excluded_by(selection, suspected),
        unseen=unseen_by(selection, suspected),
        innocent=examined.innocent,
        undecided=examined.undecided,
        missing=examined.missing,
        process_noise=None if disagree else examined.chance,
        integration=selection.integration,
        fit=fit,
        records=records,
        explanations=explanations_of(selection, verdict),
        alone=alone,
    )


def _explained(word: str, innocent: bool, chance: ProcessNoise | None) -> bool:
    """Whether nothing is left that the bank may lack."""
    return word != UNEXPLAINED.word and not may_be_unknown(innocent, chance)


def _each_alone(
    fit: Fit, records: tuple[Record, ...], bank: tuple[Effect, ...], rng: np.random.Generator, say: Progress
) -> tuple[Diagnosis, ...]:
    """Diagnose each of several by itself; return nothing if one of them is not explained by itself either."""
    found: list[Diagnosis] = []
    if len(records) == 1:
        return ()
    for record in records:
        one = _diagnosed(fit, (record,), (), bank, rng, say)
        if not _explained(one.verdict, one.innocent, one.process_noise):
            return ()
        found.append(one)
    return tuple(found)


def _confirmed(verdict: Verdict, alone: Sequence[Diagnosis]) -> bool:
    """Whether each record by itself has every cause that all share, or what could be there instead."""
    return bool(verdict.groups) and all(one.suspected & set(group) for one in alone for group in verdict.groups)


def _judged(examined: Examination, nominal: Fit, validation: tuple[Record, ...], rng: np.random.Generator):
    """Return the extended model's fit, its gain, and the verdict."""
    selection, wider = examined.selection, nominal
    if selection.included:
        wider = as_fit(selection, selection.final, selection.included)
    gain = gain_of(selection, nominal, wider, validation, rng)
    return wider, gain, verdict_of(examined, gain.predicted_by)


def _check(fit, records, validation, key, progress) -> None:
    if not isinstance(fit, Fit):
        raise ValueError(f"expected a fit as identify returns it, got {type(fit).__name__}")
    for one in (*records, *validation):
        if not set(one.outputs) & set(fit.outputs):
            raise ValueError(
                f"expected {one.name} to hold an output that was fitted, {', '.join(fit.outputs)}; it has "
                f"{', '.join(one.outputs) or 'none'}"
            )
        input_array(fit.model, one)
    check_key(key)
    if progress is not None:
        flag("progress", progress)
    for record in records:
        if set(record.outputs) - set(fit.outputs):
            raise ValueError(
                f"expected records with outputs that were fitted, {', '.join(fit.outputs)}; {record.name} also has "
                f"{', '.join(sorted(set(record.outputs) - set(fit.outputs)))}: drop them with .select, or fit them too"
            )
        measured = min(int(np.isfinite(values).sum()) for values in record.outputs.values())
        if measured < _LEAST_SAMPLES:
            raise ValueError(
                f"expected at least {_LEAST_SAMPLES} measured samples of every output of {record.name}, to tell noise "
                f"from misfit; got {measured}"
            )
    stack_records(fit.model, records)


def _check_columns(bench: Workbench, simulated: Float[np.ndarray, "record time signal"]) -> None:
    """Refuse records of which a column is mistaken: whatever were found would stand for that."""
    for record, outputs in zip(bench.records, simulated, strict=True):
        named = dict(zip(bench.problem.observed, outputs[: len(record)].T, strict=True))
        if found := mistaken_columns(bench.fit, record, named):
            raise ValueError(
                f"expected columns of {record.name} as the model means them: {found}; see to Column(..., scale=...), "
                "and identify again"
            )


def _check_bank(bank) -> tuple[Effect, ...]:
    """Return the bank as a tuple."""
    expected = "expected bank to be a sequence of effects, such as (*ehsvjax.effects.BANK, my_effect)"
    if not isinstance(bank, Iterable):
        raise ValueError(f"{expected}; got {type(bank).__name__}")
    bank = tuple(bank)
    others = [type(effect).__name__ for effect in bank if not isinstance(effect, Effect)]
    if others or not bank:
        raise ValueError(f"{expected}; got {', '.join(others) or 'none'} in it")
    numbers = [(e.name, e.kind, p.name) for e in bank for p in e.parameters]
    twice = sorted({name for name, kind, number in numbers if numbers.count((name, kind, number)) > 1})
    if twice:
        raise ValueError(
            f"expected every effect of the bank once, got {', '.join(twice)} twice: give yours other names"
        )
    return bank


def _without_spikes(bench: Workbench) -> tuple[Workbench, Bool[np.ndarray, "record time signal"]]:
    """Return the bench without readings that stand alone, and where they are."""
    samples = bench.problem.samples
    simulated = bench.simulated(bench.nominal[None])[0]
    _check_columns(bench, simulated)
    alone = spikes(samples.outputs - simulated, samples.measured, samples.outputs)
    return with_readings(bench, samples.measured & ~alone), alone
