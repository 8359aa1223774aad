"""Directions that a record does not fix, what is fixed all the same, and what would fix them."""

from dataclasses import replace

import jax
import numpy as np
import pytest

import ehsvjax
from ehsvjax import excitation
from ehsvjax.precision.standard_errors import linearised, precision_of
from ehsvjax.unknowns import problem_of
from tests import plants

PERIOD = 1e-3
TIED = {"dead_zone", "saturation", "flow_gain", "feedback_gain"}
VARIANCE = {"position": 1e-8}


def _command(amplitude, duration=1.5, hold_time=0.1):
    return excitation.pseudo_random_signal(
        jax.random.key(6), amplitude=amplitude, hold_time=hold_time, duration=duration, sample_period=PERIOD
    )


def _experiment(amplitude, **options):
    command = _command(amplitude, **options)
    return ehsvjax.Record(np.arange(len(command)) * PERIOD, {"command": command})


FORWARD = ehsvjax.servovalve(transfer_function="forward")


@pytest.fixture(scope="module")
def forward():
    return ehsvjax.design(FORWARD, _experiment(0.05), noise_variance=VARIANCE)


def test_four_parameters_tied_by_the_controller_in_the_forward_path_are_named(forward):
    (direction,) = forward.unfixed
    assert direction.structural and np.isinf(direction.deviation)
    assert set(direction.weights) == TIED
    # (Gc, d, S, H) -> (c Gc, c d, c S, H/c) leaves the position as it is.
    signs = {name: np.sign(weight) for name, weight in direction.weights.items()}
    assert signs["feedback_gain"] == signs["dead_zone"] == signs["saturation"] == -signs["flow_gain"]
    np.testing.assert_allclose(np.abs(list(direction.weights.values())), 0.5, rtol=1e-3)
    assert "tells them apart" in direction.remedy
    assert {name for name, error in forward.standard_errors.items() if np.isinf(error)} == TIED
    assert np.isfinite(forward.standard_errors["damping_ratio"])
    assert not any(set(pair) & TIED for pair in forward.correlations)


def test_product_and_ratios_that_are_fixed_have_the_errors_of_a_model_with_one_of_the_four_known(forward):
    assert len(forward.combinations) == 3
    for combination in forward.combinations:
        assert set(combination.exponents) <= TIED
        # Invariant under the transformation that the position does not show.
        powers = [-e if name == "flow_gain" else e for name, e in combination.exponents.items()]
        assert sum(powers) == pytest.approx(0.0, abs=1e-6)
        # With all others of the combination known, it has the error of the one that is left.
        free, *others = combination.exponents
        known = FORWARD.with_bounds(fixed={name: FORWARD.nominal[name] for name in others})
        error = ehsvjax.design(known, _experiment(0.05), noise_variance=VARIANCE).standard_errors[free]
        assert combination.percent == pytest.approx(100 * error / FORWARD.nominal[free], rel=1e-3)


def test_a_fit_says_the_same_as_the_design(forward):
    command = _command(0.05)
    time = np.arange(len(command)) * PERIOD
    # The position that the valve would show, of a plant with the controller in the forward path: the spool's loop is
    # the same for u' = Gc*u, so that the independent plant serves.
    motion = plants.servovalve_plant(0.09 * command, PERIOD)
    noise = np.random.default_rng(4).normal(0.0, 1e-4, len(command))
    record = ehsvjax.Record(time, {"command": command}, {"position": motion.position + noise})
    fit = ehsvjax.identify(FORWARD, record, key=jax.random.key(0), population=50, generations=20)
    precision = fit.precision()
    (direction,) = precision.unfixed
    assert set(direction.weights) == TIED and direction.structural
    assert {c.name for c in precision.combinations} == {c.name for c in forward.combinations}
    for found, expected in zip(precision.combinations, forward.combinations, strict=True):
        assert abs(found.value - expected.value) < 5.0 * found.standard_error
        assert found.percent == pytest.approx(expected.percent, rel=0.3)
    text = str(fit)
    assert "not fixed" in text
    assert all(combination.name in text for combination in precision.combinations)


@pytest.fixture(scope="module")
def gentle():
    return ehsvjax.design(ehsvjax.servovalve(), _experiment(1.5e-3), noise_variance=VARIANCE)


def test_a_saturation_that_is_never_reached_is_said_with_the_amplitude_that_would(gentle):
    (direction,) = gentle.unfixed
    assert list(direction.weights) == ["saturation"] and not direction.structural
    assert np.isinf(gentle.standard_errors["saturation"])
    assert gentle.combinations == ()
    words = direction.remedy
    amplitude = float(words.split("command up to ")[1].split(")")[0])
    better = ehsvjax.design(ehsvjax.servovalve(), _experiment(amplitude), noise_variance=VARIANCE)
    assert better.standard_errors["saturation"] / 3e-3 < 0.2
    # The plant's own spool: at the record's amplitude it stays below the stop, at the other it does not.
    assert np.max(np.abs(plants.servovalve_plant(_command(1.5e-3), PERIOD).spool)) < 3e-3 + 1e-4
    assert np.max(np.abs(plants.servovalve_plant(_command(amplitude), PERIOD).spool)) > 3e-3 + 1e-4
    assert "saturation" in str(gentle) and "not fixed" in str(gentle)


def test_saturation_not_reached_and_the_four_tied_are_told_apart():
    found = ehsvjax.design(FORWARD, _experiment(0.015), noise_variance=VARIANCE)
    structural, practical = found.unfixed
    assert structural.structural and set(structural.weights) == TIED
    assert not practical.structural and list(practical.weights) == ["saturation"]
    assert "times the amplitude" in practical.remedy
    assert {n for c in found.combinations for n in c.exponents} == TIED - {"saturation"}


def test_with_the_spool_measured_nothing_is_tied():
    found = ehsvjax.design(FORWARD, _experiment(0.05), noise_variance={"position": 1e-8, "spool": 1e-10})
    assert found.unfixed == ()
    assert all(np.isfinite(error) for error in found.standard_errors.values())


def test_design_is_the_bound_and_needs_no_outputs():
    experiment = _experiment(6e-3)
    found = ehsvjax.design(ehsvjax.servovalve(), experiment, noise_variance=VARIANCE)
    filled = ehsvjax.Record(experiment.time, experiment.inputs, {"position": np.sin(experiment.time)})
    bound = ehsvjax.cramer_rao_bound(ehsvjax.servovalve(), filled, noise_variance=VARIANCE)
    for name, error in found.standard_errors.items():
        assert error == pytest.approx(bound[name], rel=1e-6)
    # Half of the readings, at random, tell half as much, whatever they read.
    read = np.where(np.random.default_rng(1).random(len(experiment)) < 0.5, experiment.time, np.nan)
    half = replace(experiment, outputs={"position": read})
    for name, error in ehsvjax.design(ehsvjax.servovalve(), half, noise_variance=VARIANCE).standard_errors.items():
        assert error == pytest.approx(2.0**0.5 * bound[name], rel=0.1)
    # A sensor may be there in one record only.
    one, two = (
        ehsvjax.design(ehsvjax.servovalve(), records, noise_variance=known).standard_errors
        for records, known in (([filled, filled], VARIANCE), ([filled, experiment], {**VARIANCE, "spool": 1e-10}))
    )
    for name, error in one.items():
        assert error == pytest.approx(bound[name] / 2.0**0.5, rel=1e-4)
        assert two[name] < error
    with pytest.raises(ValueError, match="got 'pressure'"):
        ehsvjax.design(ehsvjax.servovalve(), experiment, noise_variance={"pressure": 1.0})


def _of_two_inputs(output):
    """Return a model without a state that shows what `output(parameters, inputs)` says, of four parameters."""
    bounds = {"first": (-5.0, 5.0), "second": (-5.0, 5.0), "third": (0.1, 10.0), "fourth": (0.1, 10.0)}
    return ehsvjax.Model(
        name="static",
        parameters=tuple(ehsvjax.Parameter(name, name, "", 1.0, *ends) for name, ends in bounds.items()),
        initial=(),
        signals=(ehsvjax.Signal("u", "input", ""), ehsvjax.Signal("w", "input", ""), ehsvjax.Signal("y", "sensor", "")),
        start=lambda parameters, initial, inputs: {"x": 0.0},
        stepper=ehsvjax.runge_kutta_4(lambda parameters, state, inputs, signal: {"x": 0.0 * state["x"]}),
        measure=lambda parameters, state, inputs, signal: {"y": signal("y", output(parameters, inputs))},
        max_step=1.0,
    )


STATIC = ehsvjax.Record(
    np.arange(50.0), {"u": np.where(np.arange(50) % 2, 1.0, -1.0), "w": np.where(np.arange(50) % 4 < 2, 1.0, -1.0)}
)


def test_a_sum_and_a_product_that_show_are_named_apart():
    model = _of_two_inputs(lambda p, i: (p["first"] + p["second"]) * i["u"] + p["third"] * p["fourth"] ** 2 * i["w"])
    found = ehsvjax.design(model, STATIC, noise_variance={"y": 1.0})
    assert [direction.structural for direction in found.unfixed] == [True, True]
    assert {frozenset(d.weights) for d in found.unfixed} == {
        frozenset(("first", "second")),
        frozenset(("third", "fourth")),
    }
    by_name = {frozenset(c.exponents): c for c in found.combinations}
    total, product = by_name[frozenset(("first", "second"))], by_name[frozenset(("third", "fourth"))]
    assert list(total.exponents.values()) == pytest.approx([1.0, 1.0])
    assert total.value == pytest.approx(2.0)
    # u and w are orthogonal: each has the error of a mean of 50.
    assert total.standard_error == pytest.approx(50**-0.5, rel=1e-6)
    assert product.exponents["fourth"] / product.exponents["third"] == pytest.approx(2.0)
    assert product.percent / abs(product.exponents["third"]) == pytest.approx(100 * 50**-0.5, rel=1e-6)


def test_parameters_that_show_alike_but_weakly_are_not_fixed_and_a_longer_record_is_asked_for():
    model = _of_two_inputs(lambda p, i: p["first"] * i["u"] + p["third"] * i["w"]).with_bounds(
        fixed={"second": 1.0, "fourth": 1.0}
    )
    found = ehsvjax.design(model, STATIC, noise_variance={"y": 200.0})
    assert set(found.standard_errors) == {"first", "third"}
    (direction,) = found.unfixed
    # 50 samples of variance 200: 200% of the third, 20% of the width of the first.
    assert list(direction.weights) == ["third"] and not direction.structural
    assert direction.deviation == pytest.approx(2.0, rel=1e-6)
    assert np.isinf(found.standard_errors["third"]) and np.isfinite(found.standard_errors["first"])
    assert "times the amplitude" in direction.remedy or "times its length" in direction.remedy


@pytest.mark.parametrize(
    ("output", "bounds", "name", "value"),
    [
        (lambda p, i: p["first"] * p["second"] * i["u"], (-5.0, 5.0), "first x second", 3.0),
        (lambda p, i: (p["first"] + p["second"]) * i["u"], (0.1, 5.0), "first + second", 3.5),
    ],
    ids=["product whose bounds hold zero", "sum of positive ones"],
)
def test_exchangeable_parameters_are_said_to_be_and_what_of_them_is_fixed(output, bounds, name, value):
    model = _of_two_inputs(output).with_bounds({"first": bounds, "second": bounds}, {"third": 1.0, "fourth": 1.0})
    found = ehsvjax.design(model, STATIC, noise_variance={"y": 1.0}, parameters={"first": 1.5, "second": 2.0})
    assert all(np.isinf(error) for error in found.standard_errors.values())
    (direction,) = found.unfixed
    assert set(direction.weights) == {"first", "second"}
    assert "exchanged, the two give the same outputs" in direction.remedy
    (combination,) = found.combinations
    assert set(combination.name.split()) == set(name.split()) and combination.value == pytest.approx(value)
    # The record shows it alone, as a gain of u: the error of a mean of 50.
    assert combination.standard_error == pytest.approx(50**-0.5, rel=1e-6)


def test_parameters_that_cannot_be_exchanged_are_not_said_to_be():
    model = _of_two_inputs(lambda p, i: p["third"] * p["fourth"] ** 2 * i["w"])
    found = ehsvjax.design(model.with_bounds(fixed={"first": 1.0, "second": 1.0}), STATIC, noise_variance={"y": 1.0})
    assert found.unfixed and not any("exchanged" in direction.remedy for direction in found.unfixed)


def _precision_under(coefficient, output, variance, samples=400):
    """Return the precision of a fit whose residuals are an autoregression of that coefficient."""
    rng = np.random.default_rng(8)
    inputs = {name: np.repeat(rng.choice([-1.0, 1.0], samples // 40), 40) for name in ("u", "w")}
    noise = np.zeros(samples)
    for k in range(1, samples):
        noise[k] = coefficient * noise[k - 1] + rng.normal(0.0, variance**0.5)
    model = _of_two_inputs(output).with_bounds(fixed={"third": 1.0, "fourth": 1.0})
    record = ehsvjax.Record(np.arange(float(samples)), inputs)
    clean = ehsvjax.simulate(model, record)["y"]
    problem = problem_of(model, [replace(record, outputs={"y": clean + noise})], noise_variance={"y": variance})
    point = np.array([1.0, 1.0])
    return precision_of(model, problem, linearised(problem, point, noise_variance_given=False))


def test_what_is_fixed_all_the_same_has_the_errors_of_the_noise_there_is():
    # The gain of u as one number, and as a sum of two that nothing tells apart.
    alone = _precision_under(0.9, lambda p, i: p["first"] * i["u"] + p["second"] * i["w"], 1e-4)
    tied = _precision_under(0.9, lambda p, i: (p["first"] + p["second"]) * i["u"] + 0.0 * i["w"], 1e-4)
    (combination,) = tied.combinations
    assert alone.coloured and tied.coloured
    assert combination.standard_error == pytest.approx(alone.standard_errors["first"], rel=0.2)


def test_what_coloured_noise_leaves_open_is_said_too():
    # White noise of that size would fix the gains; slow noise does not, and that is then no mystery.
    found = _precision_under(0.97, lambda p, i: p["first"] * i["u"] + p["second"] * i["w"], 400.0)
    open_ = {name for name, error in found.standard_errors.items() if np.isinf(error)}
    assert open_
    assert open_ <= {name for direction in found.unfixed for name in direction.weights}


def test_a_parameter_with_an_error_of_its_own_is_given_no_other():
    # A direction that is open but for a little of the third: its own error is known.
    model = _of_two_inputs(lambda p, i: (p["fourth"] + 0.05 * p["third"]) * i["u"] + p["third"] * i["w"])
    model = model.with_bounds(fixed={"first": 1.0, "second": 1.0})
    found = ehsvjax.design(model, STATIC, noise_variance={"y": 60.0})
    stated = {name for name, error in found.standard_errors.items() if np.isfinite(error)}
    assert not any(next(iter(c.exponents)) in stated for c in found.combinations)
