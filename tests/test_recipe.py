"""The recipe of a diagnosis: what it takes, what it shows while it runs, what the fits say that it returns."""

import contextlib

import jax
import numpy as np
import pytest

import ehsvjax
from ehsvjax.diagnosis import diagnose, recipe
from ehsvjax.diagnosis.bench.progress import bar
from ehsvjax.diagnosis.results.gain import _gain
from tests.plants import held_levels
from tests.small_models import STIFFNESS, carriage, carriage_plant, record_of

# One process compiles.
pytestmark = pytest.mark.xdist_group("diagnoses of a carriage")
KEY = jax.random.key(0)
PERIOD, SAMPLES = 0.02, 1200
NOISE = {"position": 2e-3, "velocity": 2e-2}


def measured(seed, outputs=("position",), name="bench"):
    push = held_levels(seed, 20.0, SAMPLES // 20, 20)
    both = carriage_plant(push, PERIOD, stiffness=1.2 * STIFFNESS)
    clean = {name: both[:, i] for i, name in enumerate(NOISE) if name in outputs}
    return record_of(PERIOD, {"push": push}, clean, NOISE, seed, name=name)


class Watched:
    """A fit by Huber's cost, diagnosed and validated on more outputs than were fitted, with the stages of that."""

    def __init__(self, monkeypatch):
        self.record, self.validation = measured(5), measured(6, tuple(NOISE), name="the other day")
        self.fit = ehsvjax.identify(carriage(), self.record, key=KEY, population=40, generations=15, huber=1.345)
        self.stages: list[tuple[str, float]] = []

        @contextlib.contextmanager
        def noting(shown):
            del shown
            yield lambda stage, done: self.stages.append((stage, done))

        monkeypatch.setattr(recipe, "progress_bar", noting)
        self.found = diagnose(self.fit, self.record, self.validation, key=KEY)


@pytest.fixture(scope="module")
def watched():
    with pytest.MonkeyPatch.context() as monkeypatch:
        return Watched(monkeypatch)


# --- Validation ---


def test_a_validation_record_may_hold_outputs_that_were_not_fitted(watched):
    assert watched.found.gain.on == "the other day, which was not used"
    assert set(watched.found.gain.outputs) == {"position"}
    gain = watched.found.gain.outputs["position"]
    # Of 1,200 readings the root mean square is known to 2%.
    assert gain.rmse_after == pytest.approx(NOISE["position"], rel=0.1)
    assert gain.rmse_before > 5.0 * gain.rmse_after


def test_a_simulation_of_the_validation_that_is_not_finite_is_infinitely_wrong():
    rng = np.random.default_rng(0)
    readings = rng.standard_normal(400)
    readings[7] = np.nan
    before, after = 0.5 * rng.standard_normal(400), 0.1 * rng.standard_normal(400)
    fine = _gain(before, after, readings, 0.01, rng)
    assert np.isfinite([fine.rmse_before, fine.rmse_after]).all()
    for nothing in (np.nan, np.inf):
        failing = after.copy()
        failing[200:] = nothing
        found = _gain(before, failing, readings, 0.01, rng)
        assert found.rmse_after == np.inf and found.fit_after == -np.inf
        assert found.rmse_before == fine.rmse_before
        assert np.isnan(found.share_removed)
        assert _gain(failing, after, readings, 0.01, rng).rmse_before == np.inf


def test_an_error_where_nothing_was_measured_counts_for_nothing():
    readings, after = np.arange(10.0), np.ones(10)
    readings[3] = after[3] = np.nan
    assert _gain(after, after, readings, 0.01, np.random.default_rng(0)).rmse_after == 1.0


# --- What the extended fit says of itself ---


def test_the_extended_fit_does_not_claim_a_cost_that_it_has_not(watched):
    assert watched.fit.huber == 1.345
    assert watched.found.extended.huber is None
    assert "Huber" in str(watched.fit) and "Huber" not in str(watched.found.extended)


def test_effort_and_history_of_the_extended_fit_are_its_own(watched):
    own, before = watched.found.extended.effort, watched.fit.effort
    assert before.simulations > 0 and len(watched.fit.history.best_cost) > 0
    assert own.population == own.generations == own.simulations == 0 and own.refined
    assert own.starts == 1 and own.step_size == watched.found.integration.step_size
    history = watched.found.extended.history
    assert len(history.best_cost) == len(history.spread) == 0 and history.best == {}
    # It prints, and draws, all the same.
    assert str(watched.found.extended) and watched.found.extended.plot() is not None


# --- Progress ---


def test_stages_are_told_and_their_shares_only_grow(watched):
    names, shares = zip(*watched.stages, strict=True)
    assert names[0] == "simulating the model" and shares[0] == 0.0
    assert names[-1] == "measuring the gain" and shares[-1] < 1.0
    assert list(shares) == sorted(shares)
    assert any(name.startswith("refitting the model with ") for name in names)
    assert len(set(names)) > 4


def test_a_bar_is_shown_when_it_is_asked_for_and_takes_nothing_back(capsys):
    with bar(True) as say:
        say("looking", 0.4)
        say("looking again", 0.2)
        say("judging", 0.9)
    shown = capsys.readouterr()
    assert shown.out == ""
    assert "diagnose: looking" in shown.err and "diagnose: judging" in shown.err
    percents = [int(part.split("|")[-1].strip()) for part in shown.err.split("%")[:-1]]
    assert percents == sorted(percents) and percents[-1] == 90


@pytest.mark.parametrize("shown", [False, None])
def test_nothing_is_shown_unless_it_is_asked_for_or_somebody_looks(shown, capsys):
    # Under test nobody looks: neither a terminal nor a notebook.
    with bar(shown) as say:
        say("looking", 0.5)
    both = capsys.readouterr()
    assert (both.out, both.err) == ("", "")


@pytest.mark.parametrize("progress", [True, False])
def test_a_diagnosis_shows_its_bar_as_it_is_told(watched, progress, capsys, monkeypatch):
    def stop(bench, say):
        say("searching", 0.5)
        raise KeyboardInterrupt

    monkeypatch.setattr(recipe, "forward", stop)
    with pytest.raises(KeyboardInterrupt):
        diagnose(watched.fit, watched.record, key=KEY, progress=progress)
    assert ("diagnose: searching" in capsys.readouterr().err) == progress
