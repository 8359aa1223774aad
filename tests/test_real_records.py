"""Measured records of rigs with faults of their own, where they are at hand: what is known to be there is found."""

import jax
import pytest

import ehsvjax
from benchmarks.real_records import AT_HAND, RIGS, judged
from ehsvjax.diagnosis.decision.verdict import UNKNOWN
from ehsvjax.effects import BANK, attach

pytestmark = pytest.mark.skipif(not AT_HAND, reason="the measured records are not at hand")


def diagnosed(name):
    """Return the rig and the diagnosis of its records."""
    rig = RIGS[name]()
    fit = ehsvjax.identify(rig.model, list(rig.records), key=jax.random.key(0), population=40, generations=10)
    return rig, ehsvjax.diagnose(fit, list(rig.records), key=jax.random.key(1))


def test_a_lag_or_hysteresis_of_two_sweeps_is_found_and_predicts_each_from_the_other():
    rig, found = diagnosed("leakage")
    assert judged(rig, found) == "right", str(found)
    assert {"input_hysteresis", "sensor_lag"} <= {name for a in found.alternatives for name in a.causes}
    for gain in found.gain.by_record:
        assert gain["flow"].rmse_after < min(0.0153, gain["flow"].rmse_before)


def test_a_tank_that_overflows_is_found_and_another_record_predicted():
    rig, found = diagnosed("tanks")
    assert judged(rig, found).startswith("right"), str(found)
    (other,) = rig.others
    assert found.extended.score(other).rmse["level"] < 0.45 < found.fit.score(other).rmse["level"]
    # A sensor whose bend would turn back before its end is none: what stands there is said to be held.
    held = {cause.name for cause in found.causes if any(size.bound for size in cause.sizes)}
    assert held == {"sensor_cubic"} and "1/(V)^2 or more" in str(found)
    # Of what the bank has; something is left of which it may be a part: the sensor ends, and the bank bends it.
    (group,) = [
        dict(zip(a.causes, a.probabilities, strict=True)) for a in found.alternatives if found.names[0] in a.causes
    ]
    assert found.causes[0].probability > 0.95 * (1.0 - group[UNKNOWN])


@pytest.mark.thorough
def test_dry_friction_comes_before_the_gap_and_another_amplitude_is_predicted():
    rig, found = diagnosed("damper")
    assert judged(rig, found).startswith("right"), str(found)
    assert found.names[0] == "coulomb_friction"
    assert any("dead_zone" in names for names in (found.names, *(a.causes for a in found.alternatives)))
    (other,) = rig.others
    assert found.extended.score(other).fit_percent["force"] > 84.0


@pytest.mark.thorough
def test_causes_are_not_priced_for_a_term_in_what_they_leave_that_is_not_worth_its_own_price():
    """Of the drive, a curve of some seventy pieces gains little beside its causes, and as little in their place."""
    rig, found = diagnosed("drive")
    assert judged(rig, found).startswith("right"), str(found)
    assert found.names[0] == "coulomb_friction"
    (other,) = rig.others
    assert found.extended.score(other).rmse["motor_force"] < 5.0 < found.fit.score(other).rmse["motor_force"]


@pytest.mark.thorough
def test_slow_misfit_is_not_taken_for_noise():
    """Of the tanks' other record alone, what is left is ten times the noise that is seen elsewhere."""
    rig = RIGS["tanks"]()
    (record,) = rig.others
    fit = ehsvjax.identify(rig.model, record, key=jax.random.key(0), population=40, generations=10)
    found = ehsvjax.diagnose(fit, record, key=jax.random.key(1))
    assert found.verdict != "adequate" and not found.innocent, str(found)


def test_what_was_of_one_sweep_is_not_predicted_of_the_other():
    rig = RIGS["leakage"]()
    one, other = rig.records
    fit = ehsvjax.identify(rig.model, one, key=jax.random.key(0), population=40, generations=10)
    found = ehsvjax.diagnose(fit, one, key=jax.random.key(1))
    assert {"input_hysteresis", "sensor_lag"} <= {*found.names, *(c for a in found.alternatives for c in a.causes)}
    assert found.extended.score(other).rmse["flow"] < fit.score(other).rmse["flow"], str(found)
    # A drift of the flow gain, without which the end of the sweep is predicted as well, beside a rest along time.
    for drift in (cause.name for cause in found.causes if cause.of_run):
        assert any({drift, UNKNOWN} <= {*a.causes} for a in found.alternatives), str(found)
        assert "data that were not used are predicted about as well without it" in str(found)


@pytest.mark.thorough
def test_a_constant_force_beside_slow_misfit_is_not_taken_for_its_drift():
    """Of a part of the drive's record what is left is all but a random walk, in which a constant is nothing.

    A damping that is less one way, which the bank then lacks, explains more than a constant force.
    """
    rig = RIGS["drive"]()
    (train,) = rig.records
    record, _ = train.split(fraction=0.6)
    fit = ehsvjax.identify(rig.model, record, key=jax.random.key(0), population=40, generations=10)
    bank = [effect for effect in BANK if effect.name != "one_way_damping"]
    found = ehsvjax.diagnose(fit, record, key=jax.random.key(1), bank=bank)
    assert {"coulomb_friction", "constant_force"} <= {*found.names}, str(found)


def test_two_runs_of_the_drive_have_the_same_damping_that_is_less_one_way_and_less_offset_than_was_published():
    """Published is an offset of 3.16 N; fitted to each run alone, beside the damping hardly any is left."""
    rig = RIGS["drive"]()
    bounds = {
        "coulomb_friction.force": (0.0, 60.0),
        "constant_force.force": (-20.0, 20.0),
        "one_way_damping.coefficient": (-150.0, 150.0),
        "sensor_gain@motor_force.error": (-0.3, 0.3),
    }
    fits = []
    for run in (*rig.records, *rig.others):
        model = attach(rig.model, bounds, duration=float(run.time[-1]), bank=BANK)
        fits.append(ehsvjax.identify(model, run, key=jax.random.key(0), population=60, generations=20))
    train, pulses = (fit.parameters["one_way_damping.coefficient"] for fit in fits)
    error, other = (fit.standard_errors["one_way_damping.coefficient"] for fit in fits)
    assert abs(train - pulses) < 3.0 * (error**2 + other**2) ** 0.5
    assert train + 8.0 * error < 0.0 and pulses + 8.0 * other < 0.0
    assert all(abs(fit.parameters["constant_force.force"]) < 1.6 for fit in fits)


@pytest.mark.thorough
def test_dry_friction_of_a_stiff_drive_is_found_from_its_position_alone():
    """Of the drive a hysteresis of the reference does nearly the same; the friction is known to be 20.4 N."""
    rig = RIGS["drive"]()
    (train,) = rig.records
    record = train.slice(stop=10.0).select(outputs=["position"])
    fit = ehsvjax.identify(rig.model, record, key=jax.random.key(0), population=40, generations=10)
    found = ehsvjax.diagnose(fit, record, key=jax.random.key(1))
    assert found.names[0] == "coulomb_friction", str(found)
    assert found.extended.parameters["coulomb_friction.force"] == pytest.approx(20.4, rel=0.05)
