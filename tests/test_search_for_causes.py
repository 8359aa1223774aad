"""The order of the search for causes: what is looked for beside what, with sets of names in the place of refits."""

from types import SimpleNamespace
from typing import NamedTuple

import pytest

from ehsvjax.diagnosis.decision import search


def stage_of(included):
    refitted = SimpleNamespace(points=[None])
    trials = SimpleNamespace(bench=None)
    return SimpleNamespace(
        trials=trials, included=included, current=refitted, noise=None, leaves_something=False
    )  # fmt: skip


@pytest.fixture
def searched(monkeypatch, unchecked):
    """Search where `adds` says what explains most beside a set, `weighs` what becomes of it and what is needless."""

    def search_with(adds, weighs):
        looked = []

        def next_effect(stage):
            looked.append(frozenset(stage.included))
            more = adds.get(frozenset(stage.included))
            return None if more is None else stage_of((*stage.included, more))

        def weighed(stage, nominal):
            included, needless = weighs.get(frozenset(stage.included), (stage.included, None))
            rest = {"nominal": None, "rivals": (), "needs": (), "unused": None, "worth": 0.0}
            return SimpleNamespace(stage=stage_of(tuple(included)), needless=needless, **rest)

        for name, stub in {
            "trials_of": lambda bench, progress: SimpleNamespace(bench=bench),
            "plain_noise": lambda variance, measured: None,
            "refit_set": lambda trials, start, included, noise: included,
            "_look": lambda trials, included, current, noise: stage_of(included),
            "_next_effect": next_effect,
            "_weighed": weighed,
            "_integration": lambda begun, ended, worth: None,
        }.items():
            monkeypatch.setattr(search, name, stub)
        samples = SimpleNamespace(measured=None)
        bench = SimpleNamespace(nominal=None, problem=SimpleNamespace(noise_variance=None, samples=samples))
        looks = search.forward(bench, lambda stage, done: None)
        return set(search.select(bench, looks).included), looked

    return search_with


def sets(**named):
    return {frozenset(name.split("_")) if name != "nothing" else frozenset(): value for name, value in named.items()}


def test_beside_what_was_swapped_in_the_rest_is_looked_for(searched):
    """Friction stood for a dead zone: beside it nothing gained enough, beside the dead zone the flow gain does."""
    found, _ = searched(
        sets(nothing="area", area="friction", area_dead="gain"), sets(area_friction=(("area", "dead"), None))
    )
    assert found == {"area", "dead", "gain"}


def test_what_is_needless_beside_a_later_cause_is_not_looked_for_again(searched):
    found, looked = searched(
        sets(nothing="area", area="friction", area_dead="gain"),
        sets(area_friction=(("area", "dead"), None), area_dead_gain=(("area", "dead", "gain"), "gain")),
    )
    assert found == {"area", "dead"}
    assert looked.count(frozenset({"area", "dead"})) == 1


def test_where_nothing_is_swapped_nothing_is_looked_for_twice(searched):
    found, looked = searched(sets(nothing="area", area="dead"), {})
    assert found == {"area", "dead"}
    assert len(looked) == len(set(looked))


def test_a_search_that_goes_round_ends(searched):
    """Each cause is swapped for the other, and beside each something needless turns up."""
    swaps = {frozenset({f"a{k}"}): ((f"a{k + 1}",), None) for k in range(50)}
    found, _ = searched({frozenset(): "a0", **{frozenset({f"a{k}"}): "b" for k in range(1, 50)}}, swaps | {
        frozenset({f"a{k}", "b"}): ((f"a{k + 1}", "b"), "b") for k in range(1, 50)})  # fmt: skip
    assert len(found) == 1


def test_rivals_of_which_each_is_better_under_the_noise_of_the_other_are_looked_at_once(monkeypatch, unchecked):
    """Where nothing explains the records many are as bad, and to look at each again takes most of a diagnosis."""
    looked = []
    bench = SimpleNamespace(problem=SimpleNamespace(substeps=1))

    class Looked(NamedTuple):
        trials: object
        included: tuple
        current: object
        noise: object

    def look(trials, included, current, noise, substeps):
        looked.append(included)
        return Looked(trials, included, current, noise)

    def swapped(stage, *_):
        return ("b",) if stage.included == ("a",) else ("a",), stage.current, ()

    for name, stub in {
        "_from_nominal_starts_too": lambda stage: stage.current,
        "refit_set": lambda trials, start, included, noise: SimpleNamespace(points=[None]),
        "rivals_of_all": swapped,
        "rivals_again": swapped,
        "_compared": lambda final, nominal, rivals: [],
        "_settled_for_all": lambda bench, compared, noise: (bench, 0.0),
        "_look": look,
        "_needs": lambda stage, nominal: ((), None),
        "_needless": lambda included, needs, unused: None,
    }.items():
        monkeypatch.setattr(search, name, stub)
    trials = SimpleNamespace(bench=bench)
    trials._replace = lambda bench: trials
    weighed = search._weighed(Looked(trials, ("a",), None, None), SimpleNamespace(points=[None]))
    assert looked == [("b",)]
    assert weighed.stage.included == ("a",)


@pytest.mark.parametrize(("gained", "chosen"), [(5.0, "dead zone"), (-50.0, "dead zone"), (50.0, "change of gain")])
def test_what_all_records_share_comes_before_what_each_has_for_itself(monkeypatch, unchecked, gained, chosen):
    """Unless that explains more than chance would have it: it fits whatever each record is."""
    names = ("change of gain", "dead zone")
    bench = SimpleNamespace(of_each=lambda candidate: candidate == 0)

    def best_of(stage, hopeful):
        (one,) = hopeful
        return SimpleNamespace(name=names[one.candidate], current=SimpleNamespace(residual=[one.candidate]))

    monkeypatch.setattr(search, "_best_of", best_of)
    stage = SimpleNamespace(
        trials=SimpleNamespace(bench=bench),
        included=(),
        screening=SimpleNamespace(ranked=[SimpleNamespace(candidate=k, corrected=0.0) for k in (0, 1)]),
        noise=SimpleNamespace(gained=lambda before, after: gained if (before, after) == (1, 0) else -gained),
    )
    assert search._next_effect(stage).name == chosen
