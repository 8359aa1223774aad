"""The next experiment: commands keep their limits, separations are those of an independent refit, the plan is kept."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

import ehsvjax
from ehsvjax import Limits, next_experiment
from ehsvjax.experiment import commands
from ehsvjax.experiment.commands import Reach
from ehsvjax.experiment.plan import Option, best_of, told_apart
from ehsvjax.experiment.separation import as_said, as_said_so_far, explained, predicted, refitted_cost, separations
from tests.hidden_plants import held_levels
from tests.small_models import MASS, STIFFNESS, carriage, carriage_plant

KEY = jax.random.key(2)
PERIOD, NOISE = 0.02, 1e-3
SOFT, HARD = "as given", "stiffer"
STIFFER = 1.02 * STIFFNESS
LIMITS = Limits(push=(-4.0, 4.0), position=(-0.3, 0.3))


def push(seed, size):
    return held_levels(np.random.default_rng(seed), size, 20, 20)


def stroke(values, name="bench", noise=NOISE):
    position = carriage_plant(values, PERIOD)[:, 0]
    measured = position + noise * np.random.default_rng(9).standard_normal(len(values))
    return ehsvjax.Record(PERIOD * np.arange(len(values)), {"push": values}, {"position": measured}, name=name)


@pytest.fixture(scope="module")
def fits():
    """Two carriages that differ by 2% of their stiffness, fitted to a small motion of the softer one."""
    record = stroke(push(1, 0.5))
    return {
        name: ehsvjax.identify(
            carriage(stiffness), record, key=KEY, population=20, generations=10, initial="nominal",
            noise_variance={"position": NOISE**2},
        )
        for name, stiffness in ((SOFT, STIFFNESS), (HARD, STIFFER))
    }  # fmt: skip


@pytest.fixture(scope="module")
def plan(fits):
    return next_experiment(fits, LIMITS, key=KEY, generations=4)


def by_scipy(fits, new, true=STIFFNESS, other=STIFFER, **constants):
    """The same separation by SciPy's linear systems and least squares, the damping refitted."""
    damping = fits[SOFT if true == STIFFNESS else HARD].parameters["damping"]
    pushes = [fits[SOFT].records[0].inputs["push"], *new]
    shown = [carriage_plant(u, PERIOD, stiffness=true, damping=damping, **constants)[:, 0] for u in pushes]

    def left(x):
        refitted = [carriage_plant(u, PERIOD, stiffness=other, damping=x[0], **constants)[:, 0] for u in pushes]
        return (np.concatenate(refitted) - np.concatenate(shown)) / NOISE

    return 2.0 * least_squares(left, [damping]).cost


@given(
    genes=st.lists(st.floats(0.0, 1.0), min_size=commands.GENES, max_size=commands.GENES),
    lower=st.floats(-1e3, 1e3),
    width=st.floats(1e-3, 1e3),
)
@settings(max_examples=60, deadline=None)
def test_every_command_keeps_its_limits_and_has_words(genes, lower, width):
    time, upper = 1e-2 * np.arange(200), lower + width
    reach = Reach(lower, upper, np.inf)
    made = commands.realised(np.array(genes), time, reach)
    assert made.shape == time.shape and np.isfinite(made).all()
    assert lower - 1e-9 * abs(lower) - 1e-9 * width <= made.min() and made.max() <= upper + 1e-9 * (abs(upper) + width)
    words = commands.described(np.array(genes), time, reach, lambda value: f"{value:.3g}")
    assert any(word in words for word in (*commands.KINDS, "steps of"))


@pytest.mark.parametrize("kind", commands.KINDS)
def test_every_kind_of_command_moves(kind):
    genes = np.full(commands.GENES, 0.4)
    genes[0], genes[1] = (commands.KINDS.index(kind) + 0.5) / len(commands.KINDS), 1.0
    genes[5:] = np.linspace(0.0, 1.0, commands.GENES - 5)
    made = commands.realised(genes, 1e-2 * np.arange(2000), Reach(-2.0, 4.0, np.inf))
    assert made.min() < -1.0 and made.max() > 3.0


def test_a_separation_is_that_of_an_independent_refit(fits):
    bigger = push(5, 4.0)
    new = dataclasses.replace(stroke(bigger), outputs={})
    for (true, other), values in {(SOFT, HARD): (STIFFNESS, STIFFER), (HARD, SOFT): (STIFFER, STIFFNESS)}.items():
        records = [*as_said_so_far(fits[true]), *as_said(fits[true], [new], ["position"])]
        found = refitted_cost(fits[other], records, {"position": NOISE**2})
        assert found == pytest.approx(by_scipy(fits, [bigger], *values), rel=1e-2)
        today = refitted_cost(fits[other], records, {"position": NOISE**2}, of_new=[])
        assert today == pytest.approx(by_scipy(fits, [], *values), rel=1e-2, abs=1e-3)


def test_to_first_order_a_separation_is_what_a_new_record_adds(fits):
    pushes = [push(5, 4.0), push(6, 1.0)]
    templates = [stroke(values) for values in pushes]
    with jax.enable_x64(True):
        soft, hard = (
            predicted(
                jax.tree.map(jnp.asarray, explained(fits[name], templates[:1], 2, {"position": NOISE**2})),
                jnp.asarray(np.stack(pushes)[:, None, :, None]),
                {},
            )
            for name in (SOFT, HARD)
        )
        found = np.asarray(separations(soft, hard, jnp.array([NOISE**2])))
    for one, values in zip(found, pushes, strict=True):
        assert one == pytest.approx(by_scipy(fits, [values]) - by_scipy(fits, []), rel=0.1)


def test_measured_records_come_apart_as_was_said(fits):
    """The softer plant, run, speaks for the softer model by the separation, give or take the noise along it."""
    bigger = push(5, 4.0)
    said = by_scipy(fits, [bigger])
    records = [fits[SOFT].records[0], stroke(bigger, "new")]
    cost = {name: refitted_cost(fit, records, {"position": NOISE**2}) for name, fit in fits.items()}
    assert said > 100.0
    assert cost[HARD] - cost[SOFT] == pytest.approx(said, abs=8.0 * said**0.5)


@pytest.mark.parametrize("separation", [4.0, 16.0, 36.0, 80.0])
def test_the_probability_of_being_told_apart_is_that_of_draws(separation):
    along = separation**0.5 + np.random.default_rng(3).standard_normal(100_000)
    gains = along**2 - (along - separation**0.5) ** 2
    assert told_apart(separation) == pytest.approx(np.mean(gains > 9.0), abs=0.005)
    assert told_apart(0.0) == 0.0


def test_a_plan_tells_more_than_the_same_again_and_keeps_the_limits(fits, plan):
    chosen, again = (min(option.separations.values()) for option in (plan.chosen, plan.same_again))
    assert chosen > 2.0 * again > 2.0 * max(plan.today.values())
    assert plan.chosen.probability > plan.same_again.probability
    for name in fits:
        (shown,) = plan.predicted(name)
        position = shown.outputs["position"]
        assert np.abs(position).max() < 0.3
    assert plan.record.outputs == {} and np.array_equal(plan.command, plan.record.inputs["push"])
    assert np.abs(plan.command).max() <= 4.0
    said = str(plan)
    assert said.startswith("Next: push: ") and f"{SOFT} against {HARD}" in said and "the same experiment again" in said
    for pair, separation in plan.chosen.separations.items():
        one, other = ({SOFT: STIFFNESS, HARD: STIFFER}[name] for name in pair)
        assert separation == pytest.approx(by_scipy(fits, [plan.command], one, other), rel=0.02)


def test_the_search_is_at_least_as_good_as_every_plain_experiment(plan):
    searched = next(option for option in plan.options if not option.simple)
    assert searched.total > 0.8 * max(option.total for option in plan.options)


def test_explanations_that_nothing_tells_apart_do_not_stand_in_the_way_of_others(fits):
    """The same carriage under two names, and the stiffer one: the plan tells the two from the third."""
    twice = {SOFT: fits[SOFT], "by another name": fits[SOFT], HARD: fits[HARD]}
    found = next_experiment(twice, LIMITS, key=KEY, generations=2)
    apart = {pair: separation for pair, separation in found.chosen.separations.items() if HARD in pair}
    assert min(apart.values()) > 100.0 and found.chosen.separations[SOFT, "by another name"] < 1e-3
    assert found.chosen.probability == pytest.approx(2.0 / 3.0, abs=0.01)
    assert str(found).count("the noise hides it") == 1


def test_a_plan_says_why_two_explanations_stay_together(fits):
    """One that the other can become; and one that differs by less than the noise."""
    moved = dataclasses.replace(fits[SOFT], parameters={"damping": 1.2 * fits[SOFT].parameters["damping"]})
    found = next_experiment({SOFT: fits[SOFT], "more damped": moved}, LIMITS, key=KEY, generations=2)
    assert max(found.chosen.separations.values()) < 1.0
    assert str(found).count("the parameters of one can do what the other does") == 1


@given(
    genes=st.lists(st.floats(0.0, 1.0), min_size=commands.GENES, max_size=commands.GENES),
    rate=st.floats(1e-2, 1e2),
    middle=st.floats(-3.0, 3.0),
)
@settings(max_examples=30, deadline=None)
def test_no_input_runs_faster_than_its_limit_and_each_starts_from_rest(genes, rate, middle):
    time, reach = 1e-2 * np.arange(200), Reach(middle - 1.0, middle + 1.0, rate)
    made = commands.realised(np.array(genes), time, reach)
    rest = np.clip(0.0, reach.lower, reach.upper)
    assert np.abs(np.diff(made, prepend=rest)).max() <= rate * 1e-2 * (1.0 + 1e-9)
    assert reach.lower - 1e-9 <= made.min() and made.max() <= reach.upper + 1e-9


def test_a_limit_of_the_rate_is_kept_and_told(fits):
    limits = Limits(push=(-4.0, 4.0), position=(-0.3, 0.3), rates={"push": 5.0})
    found = next_experiment(fits, limits, key=KEY, generations=2)
    assert all(np.abs(np.diff(o.records[0].inputs["push"])).max() <= 5.0 * PERIOD * 1.0001 for o in found.options)
    assert "no faster than 5 N a second" in found.chosen.words


def test_what_was_set_on_the_rig_stays_set(fits):
    """A mass that the records so far were told, and the model does not have, is that of the next one."""
    loaded = {n: dataclasses.replace(f, records=(f.records[0].at(mass=1.4 * MASS),)) for n, f in fits.items()}
    found = next_experiment(loaded, LIMITS, key=KEY, generations=2)
    assert all(r.constants == {"mass": 1.4 * MASS} for option in found.options for r in option.records)
    expected = by_scipy(loaded, [found.command], mass=1.4 * MASS)
    assert found.chosen.separations[SOFT, HARD] == pytest.approx(expected, rel=0.03)


def test_a_signal_of_ones_own_is_tried_as_it_is(fits):
    """A push that shakes the carriage at its resonance, shorter than the experiment and at another period."""
    time = 0.01 * np.arange(400)
    own = ehsvjax.Record(time, {"push": 0.5 + 2.0 * np.sin((STIFFNESS / 2.0) ** 0.5 * time)})
    found = next_experiment(fits, LIMITS, key=KEY, own=own, generations=2)
    (tried,) = [o for o in found.options if o.simple and commands.OWN in o.words]
    again = np.resize(own.inputs["push"][::2], len(found.command))
    np.testing.assert_allclose(tried.records[0].inputs["push"], again, atol=1e-6)


def test_several_records_share_the_time_where_one_tells_too_little(fits):
    """Nothing tells the softer carriage from itself; what two records tell of the others is what SciPy says."""
    twice = {SOFT: fits[SOFT], HARD: fits[HARD], "by another name": fits[SOFT]}
    found = next_experiment(twice, LIMITS, key=KEY, records=2, generations=2)
    shared = [option for option in found.options if len(option.records) == 2]
    assert shared and max(o.probability for o in found.options if len(o.records) == 1) < 0.99
    for option in shared:
        assert sum(len(record) for record in option.records) == pytest.approx(len(fits[SOFT].records[0]), abs=2)
        assert "record 1: push: " in option.words and "record 2: push: " in option.words
        pushes = [record.inputs["push"] for record in option.records]
        assert option.separations[SOFT, HARD] == pytest.approx(by_scipy(fits, pushes), rel=0.03)
    assert [record.name for record in shared[0].records] == ["next 1", "next 2"]
    found.plot()


def test_the_errors_that_are_promised_are_those_that_come(fits, plan):
    """A fit to both records, of the softer plant run again, has the standard errors that the plan says."""
    said = plan.precision(SOFT).standard_errors
    new = dataclasses.replace(stroke(plan.command, "new"), time=plan.record.time)
    both = ehsvjax.identify(
        carriage(), [fits[SOFT].records[0], new], key=KEY, population=20, generations=10, initial="nominal",
        noise_variance={"position": NOISE**2},
    )  # fmt: skip
    found = both.precision().standard_errors
    assert said["damping"] == pytest.approx(found["damping"], rel=0.1)
    assert said["damping"] < 0.5 * fits[SOFT].precision().standard_errors["damping"]
    with pytest.raises(ValueError, match="expected one of as given, stiffer"):
        plan.precision("softer")


def test_a_plan_is_drawn(plan):
    figure = plan.plot()
    labels = [axes.get_ylabel().split("\n")[0] for axes in figure.axes]
    assert labels == ["push", "position", "difference"]


def test_the_same_key_gives_the_same_plan(fits, plan):
    again = next_experiment(fits, LIMITS, key=KEY, generations=4)
    assert again.chosen.words == plan.chosen.words and np.array_equal(again.command, plan.command)


def test_a_plain_experiment_that_tells_enough_is_chosen():
    record = stroke(push(1, 1.0))

    def option(least, simple, changed=0):
        return Option("", (record,), ("position",), {("a", "b"): least}, simple, changed)

    searched, plain = option(500.0, False), option(70.0, True)
    assert best_of([searched, plain]) is plain
    changed = option(400.0, True, changed=1)
    assert best_of([searched, changed, plain]) is plain and best_of([searched, changed]) is changed
    assert best_of([option(50.0, False), option(30.0, True)]).simple is False
    assert best_of([option(50.0, False), option(45.0, True)]).simple is True


@pytest.mark.usefixtures("unchecked")
def test_limits_say_what_they_are_not():
    with pytest.raises(ValueError, match=r"expected push between \(least, most\), the lower one first"):
        Limits(push=(4.0, -4.0))
    with pytest.raises(ValueError, match="give two numbers"):
        Limits(push=4.0)
    with pytest.raises(ValueError, match="duration"):
        Limits(duration=0.0, push=(-1.0, 1.0))
    with pytest.raises(ValueError, match="rate of push"):
        Limits(push=(-1.0, 1.0), rates={"push": 0.0})
    assert repr(Limits(push=(-1.0, 1.0), rates={"push": 2.0})) == "Limits(push=(-1.0, 1.0), rates={'push': 2.0})"
    assert repr(Limits(push=(-1.0, 1.0), duration=2.0)) == "Limits(push=(-1.0, 1.0), duration=2.0)"


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"explanations": {}}, "two explanations or more"),
        ({"limits": Limits(position=(-1.0, 1.0))}, "limits of every input, got none of push"),
        ({"limits": Limits(push=(-1.0, 1.0), pull=(0.0, 1.0))}, "got 'pull'"),
        ({"limits": (-1.0, 1.0)}, "expected limits"),
        ({"can_change": {"weight": (1.0, 2.0)}}, "expected can_change of parameters of carriage"),
        ({"can_change": {"mass": 2.0}}, "give two numbers"),
        ({"can_change": {"damping": (1.0, 2.0)}}, "got damping, which is identified"),
        ({"limits": Limits(push=(30.0, 40.0), position=(-0.3, 0.3)), "generations": 1}, "limits that some experiment"),
        ({"can_add": {"force": 1.0}}, "expected can_add of outputs of carriage"),
        ({"can_add": {"velocity": -1.0}}, "noise_variance of velocity"),
        ({"pairs": [(SOFT, "harder")]}, "pairs of two explanations"),
        ({"pairs": []}, "a pair of explanations"),
        ({"generations": 0}, "generations"),
        ({"records": 0}, "records"),
        ({"own": np.zeros(5)}, "expected own"),
        (
            {"own": ehsvjax.Record(np.arange(5.0), {"pull": np.arange(5.0)})},
            "every input of carriage, got none of push",
        ),
        ({"own": ehsvjax.Record(np.arange(5.0), {"push": np.zeros(5)})}, "push that stand still"),
        ({"limits": Limits(push=(-1.0, 1.0), rates={"position": 1.0})}, "expected rates of inputs of carriage, push"),
        ({"key": 3}, "key"),
    ],
)
def test_what_cannot_be_meant_is_refused(fits, given, message):
    arguments = {"explanations": fits, "limits": LIMITS, "key": KEY} | given
    with pytest.raises(ValueError, match=message):
        next_experiment(arguments.pop("explanations"), arguments.pop("limits"), **arguments)


def test_explanations_of_other_records_are_refused(fits):
    other = dataclasses.replace(fits[HARD], records=(stroke(push(1, 0.5)[:200]),))
    with pytest.raises(ValueError, match="fitted to the same records; those of stiffer are others"):
        next_experiment({SOFT: fits[SOFT], HARD: other}, LIMITS, key=KEY)
