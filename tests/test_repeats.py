"""Chance or not: what a repeat of the experiment leaves again is not chance, however little the bank knows of it."""

import jax
import numpy as np
import pytest

import ehsvjax
from ehsvjax.diagnosis import recipe
from ehsvjax.diagnosis.decision.prediction import Predicted
from ehsvjax.diagnosis.decision.verdict import PROCESS_NOISE, UNKNOWN, verdict_of
from ehsvjax.diagnosis.hypotheses.process_noise import ProcessNoise
from ehsvjax.diagnosis.results.explanations import explanations_of
from ehsvjax.diagnosis.results.gain import gain_of
from tests.small_models import carriage, carriage_plant, record_of

PERIOD, SAMPLES, KEY = 0.02, 1500, jax.random.key(0)
PUSH = np.repeat(np.random.default_rng(3).uniform(-10.0, 10.0, SAMPLES // 20), 20)


def shaken(force, seed):
    """A record of a carriage with a further force [time]."""
    position = carriage_plant(PUSH + force, PERIOD)[:, 0]
    return record_of(PERIOD, {"push": PUSH}, {"position": position}, {"position": 0.002}, seed, f"run {seed}")


def random_force(seed):
    return 2.0 * np.random.default_rng([8, seed]).standard_normal(SAMPLES)


def diagnosed(records):
    fit = ehsvjax.identify(carriage(), records, key=KEY, population=20, generations=5)
    return ehsvjax.diagnose(fit, records, key=KEY)


def test_one_record_does_not_tell_chance_from_what_the_bank_lacks():
    found = diagnosed([shaken(random_force(1), 1)])
    assert (found.verdict, found.names) == ("ambiguous", (PROCESS_NOISE,)), str(found)
    assert found.alternatives[0].causes == (PROCESS_NOISE, UNKNOWN)
    assert "the same experiment again" in str(found)


@pytest.mark.parametrize("chance", [True, False])
def test_a_repeat_of_the_experiment_settles_it(chance):
    # A disturbance that no effect of the bank is, the same in both runs, or another.
    records = [shaken(random_force(seed if chance else 1), seed) for seed in (1, 2)]
    found = diagnosed(records)
    if chance:
        assert (found.verdict, found.names) == ("named", (PROCESS_NOISE,)), str(found)
    else:
        assert PROCESS_NOISE not in found.suspected, str(found)
        assert found.verdict != "adequate", str(found)


def test_what_leaves_something_and_predicts_nothing_may_stand_for_what_the_bank_lacks(monkeypatch):
    given = []
    monkeypatch.setattr(recipe, "verdict_of", lambda *all_of_it: given.append(all_of_it) or verdict_of(*all_of_it))
    found = diagnosed([shaken(3.0, 1)])
    ((examined, predicted_by),) = given
    assert predicted_by == found.gain.predicted_by and found.innocent, str(found)
    assert 0.99 < predicted_by[0] <= 1.0
    # What is fitted, as the rest leaves it open, is not predicted.
    with monkeypatch.context() as patched:
        patched.setattr(Predicted, "left_open", lambda *_: True)
        fits = found.fit, found.extended
        assert gain_of(examined.selection, *fits, (), np.random.default_rng(0)).predicted_by == (0.0,)
    left = examined._replace(innocent=False)
    sure, half, unsure = (verdict_of(left, told) for told in ((1.0,), (0.5,), (0.0,)))
    for group, open_group in zip(sure.groups, unsure.groups, strict=True):
        assert UNKNOWN not in group
        assert open_group == {name: p / 2.0 for name, p in group.items()} | {UNKNOWN: 0.5}
    assert unsure.word == "ambiguous" and "another record" in unsure.alternatives[0].settled_by
    # What explains half of what was wrong may be a part of what all of it is.
    assert [group[UNKNOWN] for group in half.groups] == [pytest.approx(1.0 / 3.0)] * len(sure.groups)
    assert [sum(group.values()) for group in half.groups] == [pytest.approx(1.0)] * len(sure.groups)
    assert verdict_of(examined, (0.0,)) == verdict_of(examined, (1.0,))
    # So may a force that no repeat has shown to be chance.
    for settled in (False, True):
        force = ProcessNoise("force", 1.0, 10.0, 0.0, settled)
        cause, _ = verdict_of(examined._replace(chance=force), (0.0,)).groups
        assert (UNKNOWN in cause) == (not settled)
    # What the bank lacks is no model that an experiment could be planned to tell from the cause.
    alone = unsure._replace(groups=({found.names[0]: 0.5, UNKNOWN: 0.5},))
    assert explanations_of(examined.selection, alone) == ()
