"""A search is known by what it computes: by its equations and numbers, in every process, whatever it is called."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import ehsvjax
from ehsvjax import genetic, operators, search
from ehsvjax.population import cast, population_cost
from ehsvjax.unknowns import problem_of

ROOT = Path(__file__).parents[1]
TIME = np.arange(60) * 1e-3
RECORD = ehsvjax.Record(TIME, {"command": np.full(60, 1e-3)}, {"position": np.sin(TIME)})


def _fingerprint(model=None, record=RECORD, chosen=genetic.Operators(), generations=9, tolerance=0.01):  # noqa: B008
    problem = cast(problem_of(model or ehsvjax.van_der_pol(), [record]), jnp.float32)
    state, _ = genetic.init(jax.random.key(0), 8, problem.unknowns, 4, chosen.elites)
    return search._fingerprint(Partial(population_cost, problem), chosen, state, generations, tolerance)


def test_models_that_differ_in_their_equations_alone_are_told_apart():
    placements = [ehsvjax.servovalve(transfer_function=place) for place in ("valve", "forward", "return")]
    found = {_fingerprint(model) for model in placements}
    assert len(found) == 3
    assert _fingerprint(ehsvjax.servovalve()) in found


def _oscillator(pull):
    def derivative(parameters, state, inputs, signal):
        driven = signal("force", inputs["command"], position=state["x1"], velocity=state["x2"])
        return {"x1": parameters["alpha"] * state["x2"], "x2": pull(signal("damping", state["x1"])) + driven}

    base = ehsvjax.van_der_pol()
    return replace(base, stepper=ehsvjax.runge_kutta_4(derivative))


def test_an_edited_equation_is_another_model_and_another_name_is_not():
    first = _fingerprint(_oscillator(lambda x: -x))
    assert first != _fingerprint(_oscillator(lambda x: -1.01 * x))
    assert first != _fingerprint(_oscillator(jnp.sin))
    measured = np.linspace(0.0, 1.0, 3)
    assert _fingerprint(_oscillator(lambda x: -jnp.interp(x, measured, measured))) != _fingerprint(
        _oscillator(lambda x: -jnp.interp(x, measured, measured**2))
    )

    def renamed(x):
        # Elsewhere, under another name, after another line.
        return -x

    assert first == _fingerprint(_oscillator(renamed))


def _shrinking(share):
    def mutation(key, individuals, progress):
        return individuals * share

    return mutation


@pytest.fixture(scope="module")
def known():
    assert _fingerprint() == _fingerprint()
    return {_fingerprint(), _fingerprint(chosen=genetic.Operators(mutation=_shrinking(0.7)))}


CHANGES = {
    "mutation": {"chosen": genetic.Operators(mutation=_shrinking(0.8))},
    "selection": {"chosen": genetic.Operators(selection=operators.tournament_selection(3))},
    "elites": {"chosen": genetic.Operators(elites=1)},
    "immigrants": {"chosen": genetic.Operators(immigrants=0.5)},
    "generations": {"generations": 10},
    "tolerance": {"tolerance": 0.0},
    "data": {"record": replace(RECORD, outputs={"position": np.cos(TIME)})},
    "bounds": {"model": ehsvjax.van_der_pol().with_bounds({"alpha": (0.5, 1.0)})},
    "step": {"model": replace(ehsvjax.van_der_pol(), max_step=1e-4)},
}


@pytest.mark.parametrize("what", CHANGES)
def test_what_changes_the_result_changes_the_fingerprint(what, known):
    assert _fingerprint(**CHANGES[what]) not in known


PROCESS = """
import ehsvjax
from tests import test_fingerprint as here
print("said", here._fingerprint(), here._fingerprint(ehsvjax.servovalve()))
"""


def test_every_process_gives_the_same():
    said = [
        subprocess.run(
            [sys.executable, "-c", PROCESS],
            capture_output=True, text=True, check=True, cwd=ROOT, env=os.environ | {"PYTHONHASHSEED": seed},
        ).stdout.splitlines()[-1]
        for seed in ("1", "2")
    ]  # fmt: skip
    assert said[0] == said[1]
    assert said[0] == f"said {_fingerprint()} {_fingerprint(ehsvjax.servovalve())}"
