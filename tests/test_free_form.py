"""Terms of free form: they act as SciPy has them act, are identified in the simulation, and a plan tells them apart."""

import dataclasses

import jax
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import ehsvjax
from ehsvjax.effects.extended import extended
from ehsvjax.effects.free_form import FreeForm, attachable
from tests.hidden_plants import held_levels
from tests.small_models import DAMPING, MASS, STIFFNESS, carriage

KEY = jax.random.key(4)
PERIOD, NOISE = 0.02, 2e-4
FORCE, PLACE, WIDTH = 2.0, 0.05, 0.015
KNOTS = np.linspace(-0.1, 0.1, 9)


def bump(position):
    return -FORCE * np.exp(-0.5 * ((position - PLACE) / WIDTH) ** 2)


def plant(push, term) -> np.ndarray:
    """Return the position [time] of a carriage with a force that depends on the position, over pushes that are held."""

    def rates(time, state):
        u = push[min(int(time / PERIOD + 1e-9), len(push) - 1)]
        x, v = state
        return [v, (u + term(x) - DAMPING * v - STIFFNESS * x) / MASS]

    time = PERIOD * np.arange(len(push))
    return solve_ivp(rates, (0.0, time[-1]), [0.0, 0.0], t_eval=time, rtol=1e-7, atol=1e-9, max_step=PERIOD).y[0]


def record_of(push, seed) -> ehsvjax.Record:
    measured = plant(push, bump) + NOISE * np.random.default_rng(seed).standard_normal(len(push))
    return ehsvjax.Record(PERIOD * np.arange(len(push)), {"push": push}, {"position": measured})


@pytest.fixture(scope="module")
def found():
    """A diagnosis of slow pushes: what holds the carriage at a place is in no bank."""
    push = np.interp(np.arange(1000), np.linspace(0, 999, 6), [0.0, 4.0, -4.0, 5.0, -3.0, 4.0])
    record = record_of(push, 1)
    fit = ehsvjax.identify(carriage(), record, key=KEY, population=30, generations=20)
    return ehsvjax.diagnose(fit, record, key=KEY, progress=False)


def with_form(form, model):
    term = attachable(form, model)
    return extended(model, (term.candidate,), term.numbers, 1.0)


def test_a_term_acts_along_what_it_depends_on():
    push = held_levels(np.random.default_rng(3), 4.0, 10, 20)
    form = FreeForm("force", "position", KNOTS, 300.0 * KNOTS**3 - 0.5, False)
    model = with_form(form, carriage(max_step=0.005))
    told = [p for p in model.parameters if ".at_" in p.name]
    knots, estimate = [float(p.name.rpartition(".at_")[2]) for p in told], [p.value for p in told]
    assert np.interp(KNOTS, knots, estimate) == pytest.approx(form.estimate, abs=0.02)
    record = ehsvjax.Record(PERIOD * np.arange(len(push)), {"push": push})
    parameters = {"damping": DAMPING} | {n: model.parameter(n).value for n in model.free if n != "damping"}
    nominal = {"initial_position": 0.0, "initial_velocity": 0.0}
    shown = ehsvjax.simulate(model, record, parameters, nominal)["position"]
    assert np.ptp(shown) > 0.15
    assert shown == pytest.approx(plant(push, lambda x: np.interp(x, knots, estimate)), abs=1e-5)


def test_a_share_of_the_opening_is_one_of_the_flow_gain():
    model, time = ehsvjax.servovalve(), 1e-3 * np.arange(500)
    record = ehsvjax.Record(time, {"command": 3e-3 * np.sin(20.0 * time)})
    wider = with_form(FreeForm("opening", "opening", np.array([-1.0, 1.0]), np.full(2, 0.1), True), model)
    values = {n: model.nominal[n] for n in model.free}
    numbers = {n: wider.parameter(n).value for n in wider.free if n not in values}
    start = {p.name: p.value for p in model.initial}
    more = ehsvjax.simulate(model, record, values | {"flow_gain": 1.1 * values["flow_gain"]}, start)
    assert ehsvjax.simulate(wider, record, values | numbers, start)["position"] == pytest.approx(
        more["position"], rel=1e-5, abs=1e-9
    )


@pytest.mark.parametrize(
    ("place", "quantity"), [("force", "time"), ("force", "push"), ("force", "spool"), ("nowhere", "position")]
)
def test_what_a_model_does_not_know_there_is_no_effect_of_it(place, quantity):
    assert attachable(FreeForm(place, quantity, KNOTS, KNOTS, False), carriage()) is None
    assert attachable(FreeForm("position", "push", KNOTS, KNOTS, False), carriage()) is not None


def test_what_no_effect_explains_is_identified_where_it_acts(found):
    """A motion that is 20 mm off does not tell where a bump of 15 mm lies; the term in the simulation does."""
    assert found.verdict == "unexplained" and found.missing.form[:2] == ("force", "position")
    assert ".with_missing_term(key=key)" in str(found)
    wider = found.with_missing_term(key=KEY)
    assert wider.parameters["damping"] == pytest.approx(DAMPING, rel=0.05)
    # Another record, faster, of another plant's integration.
    other = record_of(held_levels(np.random.default_rng(5), 4.0, 20, 20), 6)
    before, after = (
        np.std(fit.simulate(other)["position"] - other.outputs["position"]) for fit in (found.extended, wider)
    )
    assert after < 0.2 * before
    names = [n for n in wider.parameters if ".at_" in n]
    at = [float(n.rpartition(".at_")[2]) for n in names]
    visited = found.records[0].outputs["position"]
    told = np.interp(visited, at, [wider.parameters[n] for n in names])
    assert np.corrcoef(told, bump(visited))[0, 1] > 0.98
    before = np.interp(visited, found.missing.at, found.missing.estimate)
    assert np.std(told - bump(visited)) < 0.5 * np.std(before - bump(visited))


def test_a_fit_with_a_term_and_what_else_it_may_be_come_back_from_files(found, tmp_path):
    sensor = FreeForm("position", "push", KNOTS, KNOTS, False)
    either = dataclasses.replace(found, missing=found.missing._replace(alike=(sensor,)))
    either.save(tmp_path / "diagnosis.npz")
    again = ehsvjax.Diagnosis.load(tmp_path / "diagnosis.npz", carriage())
    assert str(again) == str(either) and str(again.missing.alike[0]) == str(sensor)
    wider = found.with_missing_term(key=KEY)
    wider.save(tmp_path / "fit.npz")
    same = ehsvjax.Fit.load(tmp_path / "fit.npz", carriage())
    assert same.parameters == wider.parameters
    before, after = (fit.simulate(fit.records[0])["position"] for fit in (wider, same))
    assert np.array_equal(before, after)


@pytest.mark.parametrize("value", [0.05, -0.0123456, 12345.6, 3e-9, 0.0])
def test_the_numbers_of_a_term_say_where_it_acts(value):
    form = FreeForm("force", "position", np.array([value, 1e6]), np.ones(2), False)
    name, _ = attachable(form, carriage()).numbers
    assert float(name.rpartition(".at_")[2]) == pytest.approx(value, rel=1e-4)


def test_knots_lie_where_a_form_bends_and_what_is_nothing_stays_so():
    """A notch that is a thirtieth of the range wide."""
    at = np.linspace(-3.0, 3.0, 301)
    form = FreeForm("force", "position", at, np.exp(-0.5 * ((at - 1.0) / 0.2) ** 2), False)
    numbers = attachable(form, carriage()).numbers.values()
    knots = np.array([float(p.name.rpartition(".at_")[2]) for p in numbers])
    assert np.max(np.abs(np.interp(at, knots, [p.value for p in numbers]) - form.estimate)) < 0.03
    assert len(knots) < 17 and {-3.0, 3.0} < set(knots.tolist())
    assert [p.name for p in numbers if p.fixed] == [p.name for p in numbers if abs(p.value) < 0.05]


def test_what_leaves_nothing_has_no_missing_term(found):
    with pytest.raises(ValueError, match=r"expected a diagnosis that leaves something, got 'adequate'"):
        dataclasses.replace(found, missing=None, verdict="adequate").with_missing_term(key=KEY)
    by_time = found.missing._replace(form=found.missing.form._replace(quantity="time"))
    with pytest.raises(ValueError, match=r"a term at force, as a function of time: write an effect"):
        dataclasses.replace(found, missing=by_time).with_missing_term(key=KEY)


def test_a_plan_tells_apart_what_a_missing_term_may_be(found):
    """At rest a force that depends on the position is an error of the sensor; where it moves, it is not."""
    term = found.missing
    without = term.at - term.estimate / STIFFNESS
    shown = np.linspace(without.min(), without.max(), 40)
    sensor = FreeForm("position", "position", shown, np.interp(shown, without, term.at) - shown, False)
    either = dataclasses.replace(found, missing=term._replace(alike=(sensor,)))
    assert "the record that would tell: .next_experiment" in str(either)
    plan = either.next_experiment(ehsvjax.Limits(push=(-6.0, 6.0)), key=KEY, generations=3)
    force, other = plan.explanations
    assert (force, other) == (str(term.form), str(sensor))
    assert plan.chosen.separations[force, other] > 2.0 * plan.today[force, other]
    truth = plant(np.asarray(plan.record.inputs["push"]), bump)
    off = {name: np.std(plan.predicted(name)[0].outputs["position"] - truth) for name in plan.explanations}
    assert off[force] < 0.2 * off[other]


def test_one_form_alone_leaves_nothing_to_tell_apart(found):
    with pytest.raises(ValueError, match=r"expected a diagnosis with causes that the records cannot tell apart"):
        found.next_experiment(ehsvjax.Limits(push=(-6.0, 6.0)), key=KEY)


def test_limits_are_refused_before_any_form_is_identified(found, monkeypatch):
    monkeypatch.setattr("ehsvjax.experiment.questions.with_term", lambda *_: pytest.fail("identified first"))
    sensor = FreeForm("position", "position", np.array([-1.0, 1.0]), np.zeros(2), False)
    either = dataclasses.replace(found, missing=found.missing._replace(alike=(sensor,)))
    with pytest.raises(ValueError, match=r"expected limits of every input, got none of push"):
        either.next_experiment(ehsvjax.Limits(position=(-1.0, 1.0)), key=KEY)
