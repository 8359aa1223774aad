"""What may be there instead of a cause, with tables of gains in the place of refits."""

from types import SimpleNamespace

import numpy as np
import pytest

from ehsvjax.diagnosis.decision import rivals, search

REQUIRED = 16.0


def refits(name, cost=0.0):
    return SimpleNamespace(points=[name], residual=[name], cost=np.array([cost]))


@pytest.fixture
def ranked(monkeypatch, unchecked):
    """Rank rivals of `own`, the first, by what each gains over another, or over nothing at all."""

    def rank(names, gains, against=None):
        def gained(left, more):
            if left == more:
                return 0.0
            return gains[left, more] if (left, more) in gains else -gains[more, left]

        def unused(bench, sets, *_):
            return SimpleNamespace(against=lambda k, j: (against or {}).get((sets[k][-1], sets[j][-1]), 0.0))

        monkeypatch.setattr(rivals, "refit_set", lambda *_: refits("nothing"))
        monkeypatch.setattr(rivals, "price", lambda *_: 4.0)
        monkeypatch.setattr(rivals, "predicted", unused)
        stage = SimpleNamespace(
            trials=SimpleNamespace(bench=None),
            noise=SimpleNamespace(gained=gained),
            included=(names[0],),
            required_gain=lambda candidate: REQUIRED,
        )
        found = rivals._ranked(stage, names[0], {name: refits(name) for name in names})
        return [(rival.candidate, rival.deficit) for rival in found]

    return rank


def test_what_chance_could_gain_as_well_is_no_rival_of_what_surely_gains_more(ranked):
    """What is left along a cubic sensor's response is no noise: 100 variances of noise are worth 6, and so is nothing.

    The backlash that gains 47 of 48 along its own was given up for it.
    """
    gains = {("nothing", "backlash"): 47.0, ("nothing", "cubic"): 6.0, ("backlash", "cubic"): 3.0}
    assert ranked(("backlash", "cubic"), gains) == [("backlash", 0.0)]


def test_what_gains_as_little_as_the_cause_is_its_rival(ranked):
    gains = {("nothing", "lag"): 18.0, ("nothing", "delay"): 12.0, ("delay", "lag"): 6.0}
    assert ranked(("lag", "delay"), gains) == [("lag", 0.0), ("delay", 6.0)]


def test_the_best_of_several_takes_the_place(ranked):
    gains = {
        **{("nothing", name): gain for name, gain in (("lag", 30.0), ("delay", 40.0), ("hold", 50.0))},
        ("lag", "delay"): 10.0,
        ("lag", "hold"): 20.0,
        ("delay", "hold"): 10.0,
    }
    assert ranked(("lag", "delay", "hold"), gains) == [("hold", 0.0), ("delay", 10.0), ("lag", 20.0)]
    # Data that were not used speak against the best: the next one does.
    spoken = ranked(("lag", "delay", "hold"), gains, {("hold", "lag"): 10.0, ("hold", "delay"): 10.0})
    assert spoken == [("delay", 0.0), ("lag", 10.0)]


def test_of_which_each_is_better_than_another_none_takes_the_place(ranked):
    names = ("lag", "delay", "hold")
    gains = {("nothing", name): 40.0 for name in names}
    gains |= {("lag", "delay"): 5.0, ("delay", "hold"): 5.0, ("hold", "lag"): 5.0}
    found = ranked(names, gains)
    assert found[0] == ("lag", 0.0)
    assert {name for name, _ in found} == set(names)


@pytest.fixture
def in_the_place_of_two(monkeypatch, unchecked):
    """Put a rival of the first cause into the place of two, where without the second the fit is so much worse."""

    def put(worse, against=0.0, deficit=2.0, dearer=0.0):
        tried = []

        def refit_sets(trials, starts, sets, noise, race):
            tried.extend(sets)
            return SimpleNamespace(residual=[worse] * len(sets), of=lambda some: refits(worse))

        monkeypatch.setattr(search, "refit_sets", refit_sets)
        monkeypatch.setattr(search, "predicted", lambda *_: SimpleNamespace(against=lambda k, j: against))
        monkeypatch.setattr(search, "price", lambda bench, candidate, point: dearer if candidate == "areas" else 0.0)
        monkeypatch.setattr(search, "_look", lambda trials, included, *_: included)
        stage = SimpleNamespace(
            trials=SimpleNamespace(bench=None),
            noise=SimpleNamespace(gained=lambda left, more: left - more),
            included=("bias", "dead zone", "backlash"),
            current=refits(0.0),
            required_gain=lambda candidate: REQUIRED,
            leaves_something=False,
        )
        one = rivals.Rival("areas", deficit, refits("areas"))
        groups = tuple((rivals.Rival(name, 0.0, refits(0.0)),) for name in stage.included[1:])
        weighed = SimpleNamespace(stage=stage, rivals=((rivals.Rival("bias", 0.0, refits(0.0)), one), *groups))
        return search._instead_of_what_is_there(weighed), tried

    return put


def test_one_takes_the_place_of_two_where_the_record_can_do_without_the_other(in_the_place_of_two):
    """A bias and a dead zone explain what a rod's two areas do, at one voltage; beside the areas neither is needed."""
    found, tried = in_the_place_of_two(10.0)
    assert sorted(tried) == [("areas", "backlash"), ("areas", "dead zone")]
    assert found in tried


@pytest.mark.parametrize(
    "so",
    [
        pytest.param({"worse": 20.0}, id="more is lost than chance would gain with the other cause"),
        pytest.param({"dearer": 8.0}, id="its numbers cost more than that leaves"),
        pytest.param({"against": 10.0}, id="data that were not used speak against it"),
        pytest.param({"deficit": 30.0}, id="it is too far behind to be asked"),
    ],
)
def test_else_it_does_not(in_the_place_of_two, so):
    assert in_the_place_of_two(**{"worse": 10.0} | so)[0] is None
