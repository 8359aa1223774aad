"""Several records in one diagnosis: of unlike length, period, noise and conditions, from independent plants."""

import html
from dataclasses import replace

import jax
import numpy as np
import pytest

import ehsvjax
from ehsvjax.diagnosis import Diagnosis, diagnose
from ehsvjax.diagnosis.decision import search
from tests.hidden_plants import held_levels, servovalve_with, van_der_pol_with
from tests.small_models import STIFFNESS, carriage, carriage_plant, record_of

KEY = jax.random.key(4)
COEFFICIENT = 4e-3
FORCE, FREQUENCY = 0.1, 2.0
of_the_oscillator = pytest.mark.xdist_group("diagnoses of the oscillator")
of_the_servovalve = pytest.mark.xdist_group("diagnoses of the servovalve")


def oscillation(seed, levels, held, period, noise, name, **effects):
    """A record of an oscillator with these effects."""
    rng = np.random.default_rng(seed)
    command = held_levels(rng, 1.0, levels, held)
    position = van_der_pol_with([effects], command[None], period)["position"][0]
    measured = position + noise * rng.standard_normal(len(command))
    return ehsvjax.Record(period * np.arange(len(command)), {"command": command}, {"position": measured}, name=name)


def valve_stroke(seed, supply_pressure, name, **effects):
    """A record of a servovalve at a supply pressure that is known of it."""
    command = held_levels(np.random.default_rng(seed), 6e-3, 15, 100)
    planned = ehsvjax.Record(1e-3 * np.arange(len(command)), {"command": command}, name=name)
    return run(planned.at(supply_pressure=supply_pressure), seed, **effects)


def run(planned, seed, **effects):
    """What a servovalve shows in an experiment that is planned."""
    command = planned.inputs["command"]
    position = servovalve_with([effects], command[None], 1e-3, **planned.constants)["position"][0]
    measured = position + 1e-4 * np.random.default_rng([seed, 1]).standard_normal(len(command))
    return replace(planned, outputs={"position": measured})


def fitted(model, records):
    return ehsvjax.identify(model, records, key=KEY, population=50, generations=20)


@pytest.fixture(scope="module")
def bent():
    """A spring that stiffens, in a long record and in a short one, noisier and of another period."""
    effects = {"cubic_stiffness": {"coefficient": COEFFICIENT}}
    records = [
        oscillation(1, 30, 50, 0.02, 1e-2, "long", **effects),
        oscillation(2, 15, 40, 0.025, 4e-2, "short", **effects),
    ]
    return records, diagnose(fitted(ehsvjax.van_der_pol(), records), records, key=KEY)


@of_the_oscillator
def test_records_of_unlike_length_period_and_noise_share_their_cause(bent):
    records, found = bent
    assert (found.verdict, found.names, found.alone) == ("named", ("cubic_stiffness",), ()), str(found)
    error = found.extended.precision().standard_errors["cubic_stiffness.coefficient"]
    assert abs(found.extended.parameters["cubic_stiffness.coefficient"]) == pytest.approx(COEFFICIENT, abs=4 * error)
    assert found.records == tuple(records) and found.extended.records == tuple(records)
    for record, outputs, noise in zip(records, found.misfit.by_record, (1e-2, 4e-2), strict=True):
        assert outputs["position"].noise_floor == pytest.approx(noise, rel=0.1), record.name
        assert len(outputs["position"].residual) == len(record)


@of_the_oscillator
def test_each_record_is_predicted_from_the_others(bent):
    _, found = bent
    assert found.gain.on == "each record, predicted from the others" and found.gain.records == ("long", "short")
    for outputs, noise in zip(found.gain.by_record, (1e-2, 4e-2), strict=True):
        assert outputs["position"].rmse_after == pytest.approx(noise, rel=0.2)
        assert outputs["position"].rmse_before > outputs["position"].rmse_after
    said = str(found)
    assert said.startswith("Van der Pol oscillator on long and short: cubic_stiffness (")
    assert "long, position: " in said and "short, position: " in said


@of_the_oscillator
def test_several_records_are_drawn_reported_and_kept(bent, tmp_path):
    records, found = bent
    panels = found.plot().axes
    assert "records one after the other" in panels[1].get_xlabel()
    named = [text.get_text() for axes in panels if axes.get_legend() for text in axes.get_legend().get_texts()]
    assert {"long", "short"} <= set(named)
    found.report(tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "on long and short" in page and "these records" in page and page.count("measured and simulated by") == 2
    found.save(tmp_path / "found.npz")
    again = Diagnosis.load(tmp_path / "found.npz")
    assert str(again) == str(found) and [r.name for r in again.records] == [r.name for r in records]
    assert again.extended.records[0] is again.records[0]


@of_the_oscillator
def test_a_list_of_one_is_that_record(bent):
    records, _ = bent
    fit = fitted(ehsvjax.van_der_pol(), records[0])
    one, listed = diagnose(fit, records[0], key=KEY), diagnose(fit, records[:1], [records[1]], key=KEY)
    assert one.names == listed.names and one.table.equals(listed.table)
    assert listed.gain.on == "short, which was not used"
    assert "as it was fitted" not in str(one)
    # How the fit predicts what it has not seen is said before anything is refitted.
    other = diagnose(fit, records[1], key=KEY)
    predicted = fit.score(records[1]).rmse["position"]
    assert other.misfit.outputs["position"].rmse_predicted == pytest.approx(predicted, rel=1e-3)
    assert f"rmse {predicted:.4g} as it was fitted; refitted rmse" in str(other)


@of_the_oscillator
def test_a_periodic_force_has_an_amplitude_of_its_own_in_every_record():
    shaken = {"harmonic_force": {"force": FORCE, "frequency": FREQUENCY, "phase": 0.7}}
    records = [
        oscillation(3, 30, 50, 0.02, 1e-2, "shaken", **shaken),
        oscillation(4, 30, 50, 0.02, 1e-2, "quiet"),
    ]
    found = diagnose(fitted(ehsvjax.van_der_pol(), records), records, key=KEY)
    assert found.names == ("harmonic_force",), str(found)
    assert found.extended.parameters["harmonic_force.frequency"] == pytest.approx(FREQUENCY, rel=1e-2)
    sizes = [
        np.hypot(*(record.constants[f"harmonic_force.{part}"] for part in ("cosine", "sine")))
        for record in found.extended.records
    ]
    assert sizes == [pytest.approx(FORCE, rel=0.1), pytest.approx(0.0, abs=0.1 * FORCE)]
    # The extended model simulates each as it was, and what is of a run is absent in any other.
    for record in found.extended.records:
        assert found.extended.score(record).rmse["position"] == pytest.approx(1e-2, rel=0.1)
    assert found.extended.score(records[0]).rmse["position"] > 2e-2


@of_the_oscillator
def test_what_one_record_alone_has_is_named_of_that_record(tmp_path, monkeypatch):
    """Together a parameter that changed, certain, and a random force stood for it; their rivals took half an hour."""
    weighed, weigh = [], search.rivals_of_all

    def watched(stage):
        weighed.append((len(stage.trials.bench.records), stage.included))
        return weigh(stage)

    monkeypatch.setattr(search, "rivals_of_all", watched)
    limited = {"input_saturation": {"limit": 0.6}}
    records = [
        oscillation(1, 15, 50, 0.02, 1e-2, "plain"),
        oscillation(2, 15, 50, 0.02, 1e-2, "limited", **limited),
    ]
    found = diagnose(fitted(ehsvjax.van_der_pol(), records), records, key=KEY)
    assert (found.verdict, found.names, found.alternatives) == ("unexplained", (), ()), str(found)
    assert [(one.verdict, one.names) for one in found.alone] == [("adequate", ()), ("named", ("input_saturation",))]
    assert [one.records for one in found.alone] == [(record,) for record in records]
    assert [included for count, included in weighed if count == 2] == [()]
    assert found.alone[1].extended.parameters["input_saturation.limit"] == pytest.approx(0.6, rel=0.02)
    said = str(found).splitlines()[0]
    assert "the records disagree" in said and "plain by itself: adequate; limited by itself: input_saturation (" in said
    found.report(tmp_path / "page.html")
    assert "limited by itself: input_saturation" in (tmp_path / "page.html").read_text()
    found.save(tmp_path / "found.npz")
    again = Diagnosis.load(tmp_path / "found.npz")
    assert str(again) == str(found) and str(again.alone[1]) == str(found.alone[1])


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("held", [("position", "velocity"), ("velocity", "position")])
def test_a_record_may_hold_outputs_that_another_does_not(held):
    push = held_levels(np.random.default_rng(8), 20.0, 12, 50)
    noise = {"position": 2e-3, "velocity": 2e-2}
    states = dict(zip(noise, carriage_plant(push, 0.02, stiffness=1.3 * STIFFNESS).T, strict=True))
    records = [
        record_of(0.02, {"push": push}, {n: states[n] for n in some}, noise, seed, f"bench {seed}")
        for seed, some in enumerate([held[:1], held])
    ]
    found = diagnose(fitted(carriage(), records), records, key=KEY)
    assert "stiffness" in found.names, str(found)
    assert [set(outputs) for outputs in found.misfit.by_record] == [set(held[:1]), set(held)]
    assert [set(outputs) for outputs in found.gain.by_record] == [set(held[:1]), set(held)]
    for outputs in found.misfit.by_record:
        for name, output in outputs.items():
            assert output.noise_floor == pytest.approx(noise[name], rel=0.15)


@pytest.mark.thorough
@of_the_servovalve
def test_what_each_record_has_for_itself_competes_with_what_all_share():
    # A bias that both share explains a part of two drifts, and a friction some more: these came before the drift, and
    # their rivals' refits had no end.
    drift, records = {"drift": 3.745e-4}, []
    for k, (count, supply_pressure) in enumerate([(25, 140e5), (15, 70e5)]):
        command = held_levels(np.random.default_rng([6, k]), 6e-3, count, 200)
        planned = ehsvjax.Record(1e-3 * np.arange(len(command)), {"command": command}, name=("first", "second")[k])
        records.append(run(planned.at(supply_pressure=supply_pressure), 774486673, sensor_drift=drift))
    found = diagnose(fitted(ehsvjax.servovalve(), records), records, key=KEY)
    assert (found.verdict, found.names) == ("named", ("sensor_drift",)), str(found)
    assert [size.record for size in found.causes[0].sizes] == ["first", "second"]


@pytest.mark.thorough
@of_the_servovalve
def test_what_one_record_cannot_tell_the_experiment_that_is_planned_from_it_settles(tmp_path):
    load = {"constant_load": {"force": 800.0}}
    full = valve_stroke(5, 140e5, "full", **load)
    alone = diagnose(fitted(ehsvjax.servovalve(), full), full, key=KEY)
    assert {one.cause for one in alone.explanations} == set(alone.alternatives[0].causes)
    plan = alone.next_experiment(
        ehsvjax.Limits(command=(-6e-3, 6e-3), position=(-0.2, 0.2)), key=KEY,
        can_change={"supply_pressure": (70e5, 140e5)}, generations=3,
    )  # fmt: skip
    assert max(plan.today.values()) < 9.0 and min(plan.chosen.separations.values()) > 100.0, str(plan)
    alone.report(tmp_path / "page.html", plan)
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert html.escape(str(plan)) in page and page.count("<img") == 3
    both = [full, run(plan.record, 6, **load)]
    together = diagnose(fitted(ehsvjax.servovalve(), both), both, key=KEY)
    assert alone.verdict == "ambiguous" and "constant_load" in alone.alternatives[0].causes, str(alone)
    assert (together.verdict, together.names) == ("named", ("constant_load",)), str(together)
    assert together.extended.parameters["constant_load.force"] == pytest.approx(800.0, rel=0.1)


@pytest.mark.thorough
@of_the_servovalve
def test_what_each_record_alone_leaves_open_is_no_evidence_against_a_cause():
    """Friction is a smaller flow gain at one supply pressure: no record predicts the other, and both fix its size."""
    rubs = {"coulomb_friction": {"force": 650.0}}
    records = [valve_stroke(7, 140e5, "full", **rubs), valve_stroke(8, 70e5, "half", **rubs)]
    found = diagnose(fitted(ehsvjax.servovalve(), records), records, key=KEY)
    assert "coulomb_friction" in found.suspected and found.innocent, str(found)
    assert any(found.gain.left_open) and "(fitted with all, as the other records leave open" in str(found)
    # What is fitted is not predicted.
    assert not (all(found.gain.left_open) and any(found.gain.predicted_by)), str(found)
    assert "on data that were not used" not in str(found).splitlines()[0]
    for outputs in found.gain.by_record:
        assert outputs["position"].rmse_after < 0.9 * outputs["position"].rmse_before, str(found)
