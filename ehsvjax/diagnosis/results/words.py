"""A diagnosis in sentences."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ehsvjax.diagnosis.bench.evidence import SIGNIFICANT
from ehsvjax.diagnosis.decision.verdict import PROCESS_NOISE, UNKNOWN
from ehsvjax.diagnosis.hypotheses.curves import quantity_unit
from ehsvjax.diagnosis.results.causes import Cause, Size, how_sure
from ehsvjax.diagnosis.results.with_term import terms_that_act
from ehsvjax.fit import EXPLAINS_NOTHING, at_bound, at_bounds
from ehsvjax.models.model import Parameter
from ehsvjax.quantities import quantity

if TYPE_CHECKING:
    from ehsvjax.diagnosis.results.diagnosis import Diagnosis

# Excluded effects that are printed, and such as come near.
_NAMED, _NEAREST = 10, 3
_MORE_THAN_ALL = "; above 100, as the noise happens to be less there than it is estimated"


def sentences(diagnosis: "Diagnosis") -> list[str]:
    """Return the diagnosis as lines of text, what matters first."""
    lines = [f"{title(diagnosis)}: {verdict(diagnosis)}", ""]
    lines += [f"  {line}" for line in (*misfit_lines(diagnosis), *cause_lines(diagnosis), *gain_lines(diagnosis))]
    lines += [f"  {line}" for line in (*next_lines(diagnosis), integration_line(diagnosis))]
    return lines


def title(diagnosis: "Diagnosis") -> str:
    """Return what was diagnosed on which records."""
    names = [record.name for record in diagnosis.records]
    return f"{diagnosis.fit.model.name} on {' and '.join(filter(None, [', '.join(names[:-1]), names[-1]]))}"


def integration_line(diagnosis: "Diagnosis") -> str:
    """Return at which step all was simulated, and what that is worth."""
    step, left_out, worth = diagnosis.integration
    readings = " and ".join(f"{count} of {name}" for name, count in left_out.items() if count)
    unknown = f"; readings that it cannot know, as beside a jump, carry no weight: {readings}" if readings else ""
    much = "" if worth < 1.0 else ": more than it should; simulate the model with a method for stiff equations"
    return (
        f"simulated in steps of {quantity(step, 's')}: at half of it no comparison changes by more than "
        f"{max(worth, 0.01):.2g} variances of what is left{much}{unknown}"
    )


def verdict(diagnosis: "Diagnosis") -> str:
    """Return the verdict in a sentence: which causes, how sure, what they explain, what is left."""
    if diagnosis.verdict == "adequate":
        coloured = any(m.coloured for outputs in diagnosis.misfit.by_record for m in outputs.values())
        chance = " It is correlated: whether it is chance, a repeat of the experiment tells." if coloured else ""
        return f"adequate. What the model leaves is noise: it depends on nothing that runs along the model.{chance}"
    if diagnosis.verdict == "named":
        return f"{_stated(diagnosis)}.{_explained(diagnosis)}{_left(diagnosis)}"
    if diagnosis.verdict == "ambiguous":
        return (
            f"ambiguous: {_stated(diagnosis)}: {these(diagnosis)} cannot tell.{_explained(diagnosis)}{_left(diagnosis)}"
        )
    if diagnosis.alone:
        each = "; ".join(f"{one.record.name} by itself: {_in_short(one)}" for one in diagnosis.alone)
        return f"the records disagree. Nothing explains them together, and each by itself is explained. {each}."
    better = "a single term explains the record better than several effects of the bank together"
    why = better if diagnosis.innocent else "no effect of the bank has earned its place"
    return f"unexplained. Something is missing, and {why}.{_or_chance(diagnosis)}"


def _in_short(diagnosis: "Diagnosis") -> str:
    """Return the verdict on a record that is explained, without what was gained."""
    stated = _stated(diagnosis)
    return f"ambiguous, {stated}" if diagnosis.verdict == "ambiguous" else stated or diagnosis.verdict


def _explained(diagnosis: "Diagnosis") -> str:
    """Return which share of what was wrong the causes explain, on which data, where chance could not."""
    shares = {n: g.share_removed for n, g in diagnosis.gain.outputs.items() if g.share_interval[0] > 0.0}
    if not shares:
        return ""
    each = [f"{100 * min(share, 1.0):.0f}%" + (f" ({name})" if len(diagnosis.gain.outputs) > 1 else "")
            for name, share in shares.items()]  # fmt: skip
    fitted = diagnosis.gain.left_open
    on = (
        "data that were fitted"
        if all(fitted)
        else "data of which some were fitted"
        if any(fitted)
        else "data that were not used"
    )
    return f" {' and '.join(each)} of what was wrong is explained, on {on}."


def _left(diagnosis: "Diagnosis") -> str:
    """Return what no cause explains."""
    left = diagnosis.left
    if left.innocent:
        return ""
    seen = f"it depends on {left.quantity}, as if a term were missing at {left.place}"
    return f" Something is left that no candidate explains: {seen}.{_or_chance(diagnosis)}"


def _or_chance(diagnosis: "Diagnosis") -> str:
    return " Or it is chance: a repeat of the experiment tells." if diagnosis.undecided else ""


def causes(diagnosis: "Diagnosis") -> str:
    """Return the names of the causes, each with what it cannot be told from; none if nothing is named."""
    return _joined(diagnosis, lambda name, probability: name)


def _stated(diagnosis: "Diagnosis") -> str:
    """Return the causes, each with how large and how sure, and with what it cannot be told from."""
    sizes = {cause.name: _brief(diagnosis, cause) for cause in diagnosis.causes}

    def stated(name, probability):
        return f"{name} ({', '.join(filter(None, [sizes.get(name), how_sure(probability)]))})"

    return _joined(diagnosis, stated)


def _joined(diagnosis: "Diagnosis", said: Callable[[str, float], str]) -> str:
    groups = [" or ".join(map(said, a.causes, a.probabilities)) for a in diagnosis.alternatives]
    within = {name for a in diagnosis.alternatives for name in a.causes}
    alone = [said(cause.name, cause.probability) for cause in diagnosis.causes if cause.name not in within]
    return ("; and " if groups else " and ").join([*alone, *groups])


def _brief(diagnosis: "Diagnosis", cause: Cause) -> str:
    """Return the first number of a cause; none where each record has its own."""
    if not cause.sizes or cause.sizes[0].record is not None:
        return ""
    if own := _of_model(diagnosis, cause):
        return quantity(own[1], own[0].unit) + _or_beyond(cause.sizes[0])
    waves = {size.number: size.value for size in cause.sizes}
    if {"cosine", "sine"} <= set(waves):
        return quantity(np.hypot(waves["cosine"], waves["sine"]), cause.sizes[0].unit)
    return quantity(cause.sizes[0].value, cause.sizes[0].unit) + _or_beyond(cause.sizes[0])


def _or_beyond(size: Size) -> str:
    """Return in which direction a size would go on, where the end of what makes sense holds it."""
    return {"lower": " or less", "upper": " or more", None: ""}[size.bound]


def misfit_lines(diagnosis: "Diagnosis") -> list[str]:
    """Return what the nominal model gets wrong, a line for each output."""
    lines = [warning for warning in diagnosis.fit.warnings if warning.startswith(EXPLAINS_NOTHING)]
    # What was fitted to these very records is refitted to where it was.
    as_fitted = set(diagnosis.records) == set(diagnosis.fit.records)
    for record, name, m in _of_each(_names(diagnosis), diagnosis.misfit.by_record):
        unit = diagnosis.fit.model.unit(name)
        kind = "coloured" if m.coloured else "white"
        before, rmse, noise = (quantity(x, unit, digits=4) for x in (m.rmse_predicted, m.rmse, m.noise_floor))
        predicted = "" if as_fitted else f"rmse {before} as it was fitted; refitted "
        lines.append(
            f"{record}{name}: {predicted}rmse {rmse}, of which the noise ({kind}) is {noise}: "
            f"{100 * m.above_noise:.1f}% of the squared error is misfit"
        )
        if m.outliers.any():
            alone = int(m.outliers.sum())
            lines.append(
                f"  {alone} readings stand alone; they were left out"
                if alone > 1
                else "  1 reading stands alone; it was left out"
            )
        if m.lattice is not None:
            share = min(m.lattice**2 / 12.0 / m.noise_floor**2, 1.0)
            lines.append(
                f"  the readings lie on a lattice of {quantity(m.lattice, unit)}: {100 * share:.0f}% of the noise"
            )
    known = [p.name for p in diagnosis.fit.model.parameters if p.prior]
    if known:
        lines.append(f"what was known beforehand, of {', '.join(known)}, was left aside: the records alone were asked")
    if diagnosis.verdict != "adequate" and diagnosis.misfit.tests:
        first = diagnosis.misfit.tests[0]
        repeating = _repeating(first.period, quantity_unit(diagnosis.fit.model, first.quantity))
        lines.append(
            f"the residual depends on {first.quantity}{repeating}, as if a term were missing at {first.place}: p "
            f"{_p(first.corrected)} for all {len(diagnosis.misfit.tests)} tests together"
        )
    return lines


def cause_lines(diagnosis: "Diagnosis") -> list[str]:
    """Return the causes with their sizes, or the missing term."""
    lines = [_cause_line(diagnosis, cause) for cause in diagnosis.causes]
    lines += _held_beside(diagnosis)
    if diagnosis.verdict == "unexplained":
        lines += _not_sure(diagnosis)
    m = diagnosis.missing
    if m is not None:
        unit = "of its value" if m.relative else m.unit
        peak = int(np.argmax(np.abs(m.estimate)))
        # Several causes may stand for one that the bank lacks.
        instead = not diagnosis.leaves_something
        along = f"as a function of {m.quantity}{_repeating(m.period, m.quantity_unit)}"
        lines.append(
            f"{'one term of another form would explain it as well,' if instead else 'missing'} at {m.place}, {along}: "
            f"up to {quantity(m.estimate[peak], unit, m.deviation[peak])} at {quantity(m.at[peak], m.quantity_unit)}"
            f"; it takes {100 * m.explained:.0f}% of what is left (see .missing and .plot())"
        )
        if m.alike:
            others = " or ".join(map(str, m.alike))
            lines.append(f"{others} would explain as much")
    return lines


def _held_beside(diagnosis: "Diagnosis") -> list[str]:
    """Return which parameters run to a bound beside the causes, which may then stand for what is beyond it."""
    free = {*diagnosis.fit.model.free} - {*diagnosis.names} if diagnosis.causes else ()
    held = at_bounds(diagnosis.extended.model, diagnosis.extended.parameters)
    beside = " beside the causes, which may stand for what is beyond it"
    return [at_bound(name, side, beside) for name, side in held if name in free]


def _not_sure(diagnosis: "Diagnosis") -> list[str]:
    """Return what comes nearest where no cause is sure: what the extended model has, and what scores most."""
    table = diagnosis.table.drop_duplicates("cause")
    tried = ", ".join(table.loc[table["included"], "cause"])
    near = table[~table["included"] & (table["p_corrected"] < SIGNIFICANT)].head(_NEAREST)
    scores = [f"{cause} ({score:.1f})" for cause, score in zip(near["cause"], near["score"].abs(), strict=True)]
    lines = [f"the best of the bank together: {tried}; the extended model has them"] if tried else []
    if scores and not tried:
        lines.append(f"nearest in the bank, none of them sure: {', '.join(scores)} standard deviations")
    return lines


def _cause_line(diagnosis: "Diagnosis", cause: Cause) -> str:
    """Return a cause with its numbers and their errors, how sure it is, what it is needed for, and by which records."""
    numbers = ", ".join(
        filter(None, [_number_words(cause, name) for name in dict.fromkeys(s.number for s in cause.sizes)])
    )
    said = [_given(diagnosis, cause) or f"{cause.name} at {cause.signal}{': ' if numbers else ''}{numbers}"]
    said.append(how_sure(cause.probability))
    if np.isfinite(cause.gain):
        said.append(f"it gains {cause.gain:.4g} times what chance would")
    if cause.name != PROCESS_NOISE and any({cause.name, UNKNOWN} <= {*a.causes} for a in diagnosis.alternatives):
        said.append("data that were not used are predicted about as well without it")
    # No other record tells what each has for itself.
    elif cause.share > 0.0 and not (cause.of_run and len(diagnosis.records) > 1):
        said.append(
            f"without it {100 * min(cause.share, 1.0):.0f}% of what was wrong comes back, on data that were not used"
        )
    if cause.of_run:
        said.append(
            f"of {'this run' if len(diagnosis.records) == 1 else 'these runs'}, nothing that another would have"
        )
    elif len(diagnosis.records) > len(cause.records):
        said.append(
            f"{' and '.join(cause.records) or 'no single record'} {'want' if len(cause.records) > 1 else 'wants'} it"
        )
    if cause.contradicted_by:
        said.append(f"{' and '.join(cause.contradicted_by)} would do better without it")
    return "; ".join(said)


def _number_words(cause: Cause, number: str) -> str:
    """Return one number of a cause with its standard error, of each record where each has its own."""
    each = [size for size in cause.sizes if size.number == number]
    values = ", ".join(
        quantity(s.value, s.unit, s.standard_error, 4)
        + _or_beyond(s)
        + (f" in {s.record}" if s.record is not None else "")
        for s in each
    )
    return f"{number} {values}"


def _given(diagnosis: "Diagnosis", cause: Cause) -> str:
    """Return what a constant is instead of what was given, or a parameter beyond its bound; nothing of other causes."""
    own = _of_model(diagnosis, cause)
    if own is None:
        return ""
    given, value, error = own
    there, before = quantity(value, given.unit, error, 4), quantity(given.value, given.unit, digits=4)
    fit, where = diagnosis.fit, "that was given"
    if given.name in fit.model.free:
        held = given.name in dict(at_bounds(fit.model, fit.parameters))
        where = "at which its bound holds it" if held else "where it changes nothing"
    return f"{cause.name}: {there}{_or_beyond(cause.sizes[0])} instead of the {before} {where}"


def _of_model(diagnosis: "Diagnosis", cause: Cause) -> tuple[Parameter, float, float] | None:
    """Return the model's number that a cause says is another, what it is and its error; None for other causes."""
    given = next((p for p in diagnosis.extended.model.parameters if p.name == cause.name), None)
    if given is None or not cause.sizes or cause.sizes[0].number not in ("error", "value"):
        return None
    size = cause.sizes[0]
    factor, offset = (given.value, given.value) if size.number == "error" else (1.0, 0.0)
    return given, offset + factor * size.value, factor * size.standard_error


def _of_each(names: Sequence[str], by_record: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, Any]]:
    """Return what there is of each output in each record, with the names of both; of a single record without."""
    said = [f"{name}, " if name else "" for name in names]
    return [(name, output, m) for name, outputs in zip(said, by_record, strict=True) for output, m in outputs.items()]


def _names(diagnosis: "Diagnosis") -> list[str]:
    return _told(record.name for record in diagnosis.records)


def _told(names: Iterable[str]) -> list[str]:
    """Return the names of records as a line tells them: a single one needs none."""
    names = list(names)
    return names if len(names) > 1 else [""]


def gain_lines(diagnosis: "Diagnosis") -> list[str]:
    """Return what the extension gains, a line for each output."""
    lines, gain = [], diagnosis.gain
    others = "the other records leave" if len(gain.records) > 1 else "the rest leaves"
    fitted = f"(fitted with all, as {others} open how large the causes are)"
    names = [
        f"{name} {fitted}".strip() if left_open else name
        for name, left_open in zip(_told(gain.records), gain.left_open, strict=True)
    ]
    for record, name, g in _of_each(names, gain.by_record):
        unit = diagnosis.fit.model.unit(name)
        before, after, noise = (quantity(x, unit, digits=4) for x in (g.rmse_before, g.rmse_after, g.noise_floor))
        if diagnosis.extended.model.name == diagnosis.fit.model.name:
            lines.append(f"on {diagnosis.gain.on}: {record}{name} rmse {before}, noise {noise}")
            continue
        line = (
            f"on {diagnosis.gain.on}: {record}{name} rmse {before} -> {after} (noise {noise}), "
            f"fit {g.fit_before:.2f} -> {g.fit_after:.2f}%"
        )
        if np.isfinite(g.share_removed):
            low, high = g.share_interval
            share = round(100 * g.share_removed, 1)
            line += (
                f"; {share:.1f}% of the removable error removed "
                f"(95%: {100 * low:.1f} to {100 * high:.1f}{_MORE_THAN_ALL if share > 100.0 else ''})"
            )
        lines.append(line)
    return lines


def next_lines(diagnosis: "Diagnosis") -> list[str]:
    """Return what to do next, and what the record excludes."""
    lines = [
        f"to tell {' from '.join(a.causes)}: {a.settled_by}" for a in diagnosis.alternatives if a.settled_by
    ]  # fmt: skip
    terms = terms_that_act(diagnosis)
    if diagnosis.explanations or len(terms) > 1:
        limits = ", ".join(f"{name}=(least, most)" for name in diagnosis.fit.model.inputs)
        lines.append(f"the record that would tell: .next_experiment(ehsvjax.Limits({limits}), key=key)")
    if diagnosis.alone:
        lines.append("ask what changed between these records; what each says by itself: .alone")
    elif diagnosis.verdict == "unexplained":
        lines.append("write an effect of that form (ehsvjax.effects.Effect) and diagnose again with it in the bank")
    if diagnosis.missing is not None and any(form is diagnosis.missing.form for form, _ in terms):
        lines.append("what is missing, identified as it is in the simulation: .with_missing_term(key=key)")
    if diagnosis.verdict == "adequate":
        said = "; ".join(f"{e.cause} above {quantity(e.above, e.unit, digits=2)}" for e in diagnosis.excluded[:_NAMED])
        more = len(diagnosis.excluded) - _NAMED
        lines.append(
            f"excluded, as it would be found in 95% of such records: {said}"
            + (f"; and {more} more (see .excluded)" if more > 0 else "")
        )
        if diagnosis.unseen:
            lines.append(f"{these(diagnosis)} cannot show: {', '.join(diagnosis.unseen)}")
    return lines


def these(diagnosis: "Diagnosis") -> str:
    """Return the records in words."""
    return "this record" if len(diagnosis.records) == 1 else "these records"


def _repeating(period: float | None, unit: str) -> str:
    return "" if period is None else f", repeating every {quantity(period, unit)}"


def _p(p: float) -> str:
    return f"= {p:.2g}" if p > 1e-12 else "< 1e-12"
