"""What was known and another in each record: simulated, identified, scored and kept as it is said."""

import copy
import pickle

import jax
import numpy as np
import pytest

import ehsvjax
from ehsvjax.effects import BANK, attach
from ehsvjax.record_checks import checked_constants
from tests.small_models import DAMPING, STIFFNESS, carriage, carriage_plant, record_of

KEY = jax.random.key(0)
PERIOD = 0.02
PUSH = np.repeat(np.random.default_rng(3).uniform(-20.0, 20.0, 30), 20)
NOISE = {"position": 2e-3}


def recorded(stiffness: float, seed: int) -> ehsvjax.Record:
    """A record of the plant with another spring, in which nothing says so."""
    position = carriage_plant(PUSH, PERIOD, stiffness=stiffness, damping=DAMPING)[:, 0]
    return record_of(PERIOD, {"push": PUSH}, {"position": position}, NOISE, seed)


@pytest.fixture(scope="module")
def records():
    """One on the spring that the model has, one on a spring half as stiff, which is known."""
    return [recorded(STIFFNESS, 1), recorded(0.5 * STIFFNESS, 2).at(stiffness=0.5 * STIFFNESS)]


@pytest.fixture(scope="module")
def fit(records):
    return ehsvjax.identify(carriage(), records, key=KEY, population=40, generations=15)


def test_a_simulation_has_what_is_known_of_the_record():
    record = recorded(0.5 * STIFFNESS, 2)
    values = {"damping": DAMPING}
    plant = carriage_plant(PUSH, PERIOD, stiffness=0.5 * STIFFNESS, damping=DAMPING)[:, 0]
    found = ehsvjax.simulate(carriage(), record.at(stiffness=0.5 * STIFFNESS), values)["position"]
    np.testing.assert_allclose(found, plant, atol=1e-6)
    assert np.max(np.abs(ehsvjax.simulate(carriage(), record, values)["position"] - plant)) > 0.1
    # It holds whatever is said elsewhere, as a fit's own value of it.
    said = values | {"stiffness": STIFFNESS}
    np.testing.assert_array_equal(
        ehsvjax.simulate(carriage(), record.at(stiffness=0.5 * STIFFNESS), said)["position"], found
    )


def test_records_at_different_conditions_are_fitted_by_one_model(fit, records):
    assert fit.parameters["damping"] == pytest.approx(DAMPING, abs=4.0 * fit.precision().standard_errors["damping"])
    assert fit.rmse["position"] == pytest.approx(NOISE["position"], rel=0.1)
    for record in records:
        assert fit.score(record).rmse["position"] == pytest.approx(NOISE["position"], rel=0.15)
    assert " at " not in repr(records[0]) and f"at stiffness = {0.5 * STIFFNESS:g}" in repr(records[1])
    assert "[[Known of a record]]" in str(fit) and f"{0.5 * STIFFNESS:g}" in str(fit)


def test_without_it_no_one_model_fits_both(records):
    unsaid = ehsvjax.identify(carriage(), [recorded(STIFFNESS, 1), recorded(0.5 * STIFFNESS, 2)], key=KEY,
                              population=40, generations=15)  # fmt: skip
    assert unsaid.rmse["position"] > 10.0 * NOISE["position"]


def test_a_parameter_may_be_known_in_one_record_and_identified_from_another(records):
    free = {"stiffness": (10.0, 200.0)}
    both = ehsvjax.identify(carriage(), records, key=KEY, population=40, generations=15, bounds=free)
    assert both.parameters["stiffness"] == pytest.approx(STIFFNESS, rel=0.01)
    with pytest.raises(ValueError, match="a record that stiffness can be identified from.*fix it"):
        ehsvjax.identify(carriage(), records[1], key=KEY, bounds=free)


def test_it_stays_with_a_record_that_is_cut_copied_resampled_or_saved(fit, records, tmp_path):
    known = {"stiffness": 0.5 * STIFFNESS}
    record = records[1]
    copies = (copy.deepcopy(record), pickle.loads(pickle.dumps(record)))
    parts = (record.slice(0.0, 3.0), *record.split(fraction=0.5), record.resample(2.0 * PERIOD))
    kept = (record.at(damping=2.0).slice(), record.select(outputs=["position"]), *parts, *copies)
    assert all(r.constants["stiffness"] == known["stiffness"] for r in kept)
    assert records[0].constants == {} and kept[0].constants == {**known, "damping": 2.0}
    fit.save(tmp_path / "fit.npz")
    again = ehsvjax.Fit.load(tmp_path / "fit.npz", carriage())
    assert [dict(r.constants) for r in again.records] == [{}, known]
    assert str(again) == str(fit)


def test_a_constant_that_the_model_does_not_have_is_refused(records):
    said = "constants of bench to be parameters of carriage, damping, mass, .*got 'stiffnes': mind the spelling"
    with pytest.raises(ValueError, match=said):
        ehsvjax.simulate(carriage(), records[0].at(stiffnes=20.0))
    with pytest.raises(ValueError, match=said):
        ehsvjax.identify(carriage(), [records[0].at(stiffnes=20.0), records[1]], key=KEY)


@pytest.mark.parametrize(
    ("constants", "said"),
    [
        ({"stiffness": np.nan}, "stiffness.*nan.*give its value, SI"),
        ({"stiffness": "20"}, "stiffness.*'20'.*give its value, SI"),
        ({3: 20.0}, "constants"),
        ([20.0], "constants"),
    ],
)
def test_what_cannot_be_known_is_refused(constants, said):
    with pytest.raises(ValueError, match=said):
        checked_constants(constants)


def test_what_is_of_a_run_is_absent_in_any_other():
    """A sensor that drifted while one record was taken does not drift from the start of the next."""
    drifting, other = recorded(40.0, 1), recorded(40.0, 2)
    drift = 0.05 * drifting.time / drifting.time[-1]
    drifting = ehsvjax.Record(drifting.time, drifting.inputs, {"position": drifting.outputs["position"] + drift})
    duration = len(drifting) * drifting.sample_period
    model = attach(carriage(), {"sensor_drift@position.drift": (-0.2, 0.2)}, duration=duration, bank=BANK)
    fit = ehsvjax.identify(model, drifting, key=KEY, population=20, generations=5)
    assert fit.parameters["sensor_drift@position.drift"] == pytest.approx(0.05, abs=0.005)
    assert fit.score(other).rmse["position"] == pytest.approx(fit.score(drifting).rmse["position"], rel=0.1)
    assert fit.parameters_of(other)["sensor_drift@position.drift"] == 0.0
    assert fit.parameters_of(drifting) == fit.parameters
