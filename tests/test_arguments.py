"""Every argument of a fit that is wrong in type, size, sign or name ends in one sentence, before anything is traced."""

import functools
import json
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import ehsvjax
from ehsvjax import identify as recipe
from tests.test_failure import GROWTH, _fit, _record

ROOT = Path(__file__).parents[1]
KEY = jax.random.key(0)

# What is passed, and words of the sentence that answers. The model's free parameters are rate and gain.
IDENTIFY = [
    ({"model": None}, "expected model to be a Model, got None: take ehsvjax.servovalve"),
    ({"model": "servovalve"}, "expected model to be a Model, got 'servovalve': take ehsvjax.servovalve"),
    (
        {"records": "valve.csv"},
        "expected records to be a Record or a sequence of Records, got 'valve.csv': make one with",
    ),
    ({"records": None}, "expected records to be a Record or a sequence of Records, got None: make one with"),
    ({"records": []}, "expected records to be a Record or a sequence of Records, got []: make one with"),
    ({"records": [_record(), np.ones(3)]}, "expected records to be a Record or a sequence of Records, got [Record"),
    ({"key": 0}, "expected key to be a random key such as jax.random.key(0), got 0"),
    ({"key": None}, "expected key to be a random key"),
    *(
        ({name: value}, f"expected {name} to be a whole number {reach}, got {value!r}: ")
        for name, reach in (
            ("population", "of at least 4"),
            ("generations", "of at least 1"),
            ("starts", "from 1 to 100"),
            ("islands", "of at least 1"),
        )
        for value in (0, -5, 2.5, "10", None, True, np.nan)
    ),
    *(({"refine": value}, f"expected refine to be True or False, got {value!r}") for value in ("no", None, 1)),
    ({"progress": "yes"}, "expected progress to be True or False, got 'yes'"),
    ({"bounds": [0.1, 1.0]}, "expected bounds to be a mapping from names, such as"),
    ({"bounds": np.ones(2)}, "expected bounds to be a mapping from names, such as"),
    ({"bounds": {1: (0.1, 1.0)}}, "expected bounds to be a mapping from names, such as"),
    ({"bounds": {"rte": (-2.0, -1.0)}}, "expected a parameter of growth, got 'rte'; it has rate, gain, cubic, start"),
    *(
        ({"bounds": {"gain": value}}, "expected bounds of gain as (lower, upper), got")
        for value in (None, 1.0, "12", (1.0,), (1.0, 2.0, 3.0), ("1", "2"), (None, 1.0))
    ),
    *(
        ({"bounds": {"gain": value}}, "expected finite bounds of gain with lower < upper, got")
        for value in ((0.1, np.nan), (0.1, np.inf))
    ),
    ({"bounds": {"gain": (2.0, 1.0)}}, "expected finite bounds of gain with lower < upper, got (2.0, 1.0)"),
    ({"fixed": "rate"}, "expected fixed to be a mapping from names, such as"),
    ({"fixed": {"gain": "1.0"}}, "expected gain to be a finite number, got '1.0'"),
    ({"fixed": {"gain": None}}, "expected gain to be a finite number, got None"),
    ({"fixed": {"gain": True}}, "expected gain to be a finite number, got True"),
    ({"fixed": {"gain": np.ones(2)}}, "expected gain to be a finite number, got"),
    ({"fixed": {"gain": np.nan}}, "expected gain to be a finite number, got nan: give its value, SI"),
    *(
        ({"initial": value}, "expected initial to be 'estimate', 'nominal' or known values by name, got")
        for value in (None, 0.0, "guess")
    ),
    ({"initial": {"strat": 0.0}}, "expected an initial condition of growth, got 'strat'; it has start"),
    ({"initial": {"start": "0"}}, "expected start to be a finite number, got '0'"),
    ({"initial": {"start": None}}, "expected start to be a finite number, got None"),
    ({"initial": [0.0]}, "expected initial conditions to be a mapping from names, such as"),
    ({"noise_variance": 1e-4}, "expected noise_variance to be a mapping from names, such as"),
    ({"noise_variance": {"height": 1e-4}}, "expected the noise variance of each measured output of growth, level; got"),
    *(
        (
            {"noise_variance": {"level": value}},
            f"expected noise_variance of level to be {wanted}, got {value!r}: give it in (m)^2",
        )
        for wanted, values in (("positive", (0, -1.0)), ("a finite number", (np.nan, np.inf, "1e-4", None, True)))
        for value in values
    ),
    *(
        (
            {"huber": value},
            "expected huber to be a positive number of standard deviations or None, got",
        )
        for value in (0, -1.0, np.nan, "1.345", True, np.ones(2))
    ),
    ({"operators": None}, "expected operators to be an Operators, got None: take"),
    ({"operators": ehsvjax.Operators(selection="best")}, "expected selection to be a function, such as"),
    ({"operators": ehsvjax.Operators(elites=True)}, "expected elites to be a whole number from 1 to 99, got True"),
    ({"operators": ehsvjax.Operators(immigrants="few")}, "expected immigrants to be a share of the population"),
    *(
        ({"tolerance": value}, f"expected tolerance to be zero or more noise variances, got {value!r}")
        for value in (np.nan, -1.0, "0.1", None, np.inf)
    ),
    ({"devices": "cpu"}, "expected devices to be some of jax.devices(), got"),
    ({"devices": 2}, "expected devices to be some of jax.devices(), got"),
    ({"devices": []}, "expected devices to be some of jax.devices(), got"),
    ({"checkpoint": 5}, "expected checkpoint to be the path of a file, got 5"),
    ({"checkpoint": ROOT / "nowhere" / "run"}, "expected the folder of"),
    ({"checkpoint": ROOT}, "to be a file to write, got a folder: name a file in it"),
    ({"checkpoint": ""}, "expected checkpoint to be the path of a file, got ''"),
]

FIT = [
    (lambda fit: fit.simulate("valve.csv"), "expected record to be a Record, got 'valve.csv'"),
    (lambda fit: fit.residuals(5), "expected record to be a Record, got 5"),
    (lambda fit: fit.score([_record()]), "expected record to be a Record, got [Record"),
    (
        lambda fit: fit.simulate(_record(), None),
        "expected initial to be 'estimate', 'nominal' or values by name, got None",
    ),
    (
        lambda fit: fit.simulate(_record(), 0.0),
        "expected initial to be 'estimate', 'nominal' or values by name, got 0.0",
    ),
    (
        lambda fit: fit.simulate(_record(), "zero"),
        "expected initial to be 'estimate', 'nominal' or values by name, got 'zero'",
    ),
    (lambda fit: fit.simulate(_record(), {"strat": 1.0}), "expected an initial condition of growth, got 'strat'"),
    (lambda fit: fit.simulate(_record(), {"start": "1"}), "expected start to be a finite number, got '1'"),
    (
        lambda fit: fit.simulate(_record(), {"start": np.nan}),
        "expected start to be a finite number, got nan: give its value, SI",
    ),
    (lambda fit: fit.plot("valve.csv"), "expected record to be a Record, got 'valve.csv'"),
    (lambda fit: fit.bands("valve.csv"), "expected record to be a Record, got 'valve.csv'"),
    *(
        (lambda fit, level=level: fit.bands(level=level), "a confidence level between 0 and 1")
        for level in (0.0, 1.0, 95, -0.5, "0.95", None, np.nan, True)
    ),
    *(
        (lambda fit, start=start: fit.bands(initial=start), words)
        for start, words in (
            (None, "expected initial to be 'estimate', 'nominal' or values by name, got None"),
            ({"strat": 1.0}, "expected an initial condition of growth, got 'strat'"),
        )
    ),
    (lambda fit: fit.score(None), "expected record to be a Record, got None"),
    (lambda fit: fit.save(None), "expected path to be the path of a file, got None"),
    (lambda fit: fit.save(ROOT), "to be a file to write, got a folder: name a file in it"),
    (lambda fit: fit.bootstrap(KEY, 10**15), "expected a bootstrap that fits into this machine's memory of"),
    (lambda fit: fit.precision("pink"), "expected noise to be 'auto', 'white' or 'coloured', got 'pink'"),
    (lambda fit: fit.precision(None), "expected noise to be 'auto', 'white' or 'coloured', got None"),
    (lambda fit: fit.precision(["white"]), "expected noise to be 'auto', 'white' or 'coloured', got ['white']"),
    (lambda fit: fit.precision().intervals("0.95"), "a confidence level between 0 and 1"),
    (
        lambda fit: fit.profile_likelihood("rate"),
        "expected names to be names of parameters, got 'rate': give them in a list, [name, ...]",
    ),
    (
        lambda fit: fit.profile_likelihood(5),
        "expected names to be names of parameters, got 5: give them in a list, [name, ...]",
    ),
    (lambda fit: fit.profile_likelihood([]), "expected names of parameters, of rate, gain; got none"),
    (lambda fit: fit.profile_likelihood(["rte"]), "expected parameters that were identified, rate, gain; got 'rte'"),
    (lambda fit: fit.profile_likelihood(level=2), "a confidence level between 0 and 1"),
    (lambda fit: fit.bootstrap(0), "expected key to be a random key"),
    (lambda fit: fit.bootstrap(KEY, "many"), "expected draws to be a whole number of at least 2, got 'many'"),
    (lambda fit: fit.bootstrap(KEY, 1), "expected draws to be a whole number of at least 2, got 1"),
    (lambda fit: fit.bootstrap(KEY, 2.5), "expected draws to be a whole number of at least 2, got 2.5"),
    (lambda fit: fit.bootstrap(KEY, kind="bayes"), "expected kind to be 'parametric' or 'block', got 'bayes'"),
    (lambda fit: fit.bootstrap(KEY, kind=None), "expected kind to be 'parametric' or 'block', got None"),
]

VARIANCE = {"level": 1e-4}
DESIGN = [
    ({"model": None}, "expected model to be a Model, got None"),
    ({"records": "plan"}, "expected records to be a Record or a sequence of Records, got 'plan'"),
    ({"noise_variance": 1e-4}, "expected noise_variance to be a mapping from names, such as"),
    ({"noise_variance": {}}, "level; got none"),
    ({"noise_variance": {"level": 0.0}}, "expected noise_variance of level to be positive"),
    ({"parameters": {"rte": 1.0}}, "expected a parameter of growth, got 'rte'; it has rate, gain, cubic, start"),
    ({"parameters": {"rate": "1"}}, "expected rate to be a finite number, got '1'"),
    ({"parameters": [1.0]}, "expected parameters to be a mapping from names, such as"),
    ({"initial_values": {"strat": 1.0}}, "expected a parameter of growth, got 'strat'; it has rate, gain, cubic"),
    ({"initial_values": {"start": None}}, "expected start to be a finite number, got None"),
    ({"initial": 5}, "expected initial to be 'estimate', 'nominal' or known values by name, got 5"),
]


def _identified(changes):
    options = {"model": GROWTH, "records": _record(), "key": KEY} | changes
    return ehsvjax.identify(options.pop("model"), options.pop("records"), **options)


def _planned(plan, changes):
    options = {"model": GROWTH, "records": _record(), "noise_variance": VARIANCE} | changes
    return plan(options.pop("model"), options.pop("records"), **options)


def _mixed():
    bounds = {"rate": np.array([-2.0, -1.0]), "gain": [np.float32(0.5), 2]}
    model = GROWTH.with_bounds(bounds, {"cubic": jax.numpy.zeros(())})
    return model.parameter("rate").upper + model.parameter("gain").upper


CALLS = [
    *((functools.partial(_identified, changes), words) for changes, words in IDENTIFY),
    *((lambda call=call: call(_fit()), words) for call, words in FIT),
    *(
        (functools.partial(_planned, plan, changes), words)
        for plan in (ehsvjax.design, ehsvjax.cramer_rao_bound)
        for changes, words in DESIGN
    ),
    (lambda: _mixed(), "1.0"),
]


def _answers():
    """Make every call as a user does, without the checks of shapes that tests have; print what it ends in."""
    recipe.search = recipe.compile_refinement = None  # whoever comes to them has not been answered
    for call, _ in CALLS:
        try:
            answer = f"nothing: {call()}"
        except Exception as raised:
            answer = f"{type(raised).__name__}: {raised}"
        print(json.dumps(answer))


if __name__ == "__main__":
    _answers()


@pytest.fixture(scope="module")
def answers():
    run = subprocess.run(
        [sys.executable, "-m", "tests.test_arguments"], capture_output=True, text=True, check=True, cwd=ROOT
    )
    return [json.loads(line) for line in run.stdout.splitlines()]


@pytest.mark.parametrize("i", range(len(CALLS) - 1))
def test_a_wrong_call_is_answered_in_one_sentence_before_anything_is_traced(i, answers):
    words = CALLS[i][1]
    kind, _, sentence = answers[i].partition(": ")
    assert kind in ("ValueError", "FileNotFoundError", "IsADirectoryError")
    assert sentence.startswith("expected ") and words in sentence
    assert "\n" not in answers[i]


def test_numbers_of_every_kind_are_taken(answers):
    assert answers[-1] == "nothing: 1.0"
