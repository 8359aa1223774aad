"""Fits and diagnoses come back whole, in another process too; what cannot come back says why."""

import base64
import inspect
import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

import ehsvjax
from ehsvjax import Fit, Record, storage
from ehsvjax.diagnosis import Diagnosis
from ehsvjax.effects import BANK, Effect, amplitude, attach, effects_of
from ehsvjax.effects.effect import constant
from tests import hand_made
from tests.hidden_records import Hidden, records

ROOT = Path(__file__).parents[1]
# One process compiles for one model.
of_the_oscillator = pytest.mark.xdist_group("diagnoses of the oscillator")
TIME = np.arange(40) * 1e-3
RECORD = Record(TIME, {"command": np.full(40, 3e-3)}, {"position": 0.01 * np.sin(TIME)})
OWN = Effect(
    "suction", "force", (amplitude("size", "{value}", constant(1e-3)),), lambda own, force, context: force + own["size"]
)
BOTH_STOPS = {
    "end_stop.positive_end": (0.01, 1.0),
    "end_stop.positive_stiffness": (1e6, 1e8),
    "end_stop.negative_end": (0.01, 1.0),
    "end_stop.negative_stiffness": (1e6, 1e8),
}


def _fit_of(model, record=RECORD):
    """Return a fit with every value in the middle of its bounds."""
    parameters = {name: 0.5 * (model.parameter(name).lower + model.parameter(name).upper) for name in model.free}
    return hand_made.fit(
        record,
        model=model,
        parameters=parameters,
        initial=({p.name: p.value for p in model.initial},),
        noise_variance={"position": 1e-8},
        history=hand_made.fit().history._replace(best={name: np.full(3, v) for name, v in parameters.items()}),
    )


def _attached(model, bounds, bank=BANK):
    return attach(model, bounds, duration=0.04, bank=bank)


def _twice(model):
    return _attached(
        _attached(model, {"sensor_bias@position.bias": (-1.0, 1.0)}), {"viscous_friction.coefficient": (0, 9)}
    )


MODELS = {
    "servovalve": lambda: ehsvjax.servovalve(transfer_function="forward", mass=7.0),
    "oscillator": ehsvjax.van_der_pol,
    "finer step": lambda: replace(ehsvjax.servovalve(), max_step=2.5e-5),
    "one effect": lambda: _attached(ehsvjax.servovalve(), {"sensor_bias@spool.bias": (-1e-3, 1e-3)}),
    "both end stops": lambda: _attached(ehsvjax.servovalve(), BOTH_STOPS),
    "one effect at two signals": lambda: _attached(
        ehsvjax.servovalve(), {"sensor_bias@spool.bias": (-1e-3, 1e-3), "sensor_bias@position.bias": (-1e-3, 1e-3)}
    ),
    "extended twice": lambda: _twice(ehsvjax.servovalve()),
}


@pytest.mark.parametrize("kind", MODELS)
def test_a_model_of_the_package_comes_back_with_its_effects(kind, tmp_path):
    fit = _fit_of(MODELS[kind]())
    fit.save(tmp_path / "fit")
    loaded = Fit.load(tmp_path / "fit")
    # Equal, functions included: nothing is compiled again.
    assert loaded.model == fit.model
    assert effects_of(loaded.model) == effects_of(fit.model)
    assert loaded.parameters == fit.parameters
    assert loaded.initial == fit.initial
    assert loaded.effort == fit.effort
    np.testing.assert_array_equal(loaded.records[0].outputs["position"], RECORD.outputs["position"])
    np.testing.assert_array_equal(loaded.history.median_cost, fit.history.median_cost)


def test_a_loaded_model_simulates_the_same(tmp_path):
    fit = _fit_of(_twice(ehsvjax.servovalve()))
    fit.save(tmp_path / "fit")
    loaded = Fit.load(tmp_path / "fit")
    np.testing.assert_array_equal(loaded.simulate(loaded.records[0])["position"], fit.simulate(RECORD)["position"])


def test_a_model_of_your_own_is_handed_over(tmp_path):
    fit = hand_made.fit()
    fit.save(tmp_path / "fit")
    with pytest.raises(ValueError, match=r"'amplifier', a model that is not of this package: hand it over, \.load"):
        Fit.load(tmp_path / "fit")
    loaded = Fit.load(tmp_path / "fit", hand_made.amplifier())
    assert loaded.model == fit.model
    assert str(loaded) == str(fit)
    with pytest.raises(ValueError, match="parameters are gain, temperature; those of the model are .*: hand over"):
        Fit.load(tmp_path / "fit", ehsvjax.van_der_pol())


def _own_oscillator():
    """Return a model that bears the name of one of the package."""

    def derivative(parameters, state, inputs, signal):
        force = signal("force", parameters["gamma"] * inputs["command"], position=state["x1"], velocity=state["x2"])
        return {"x1": parameters["alpha"] * state["x2"], "x2": force - signal("damping", state["x1"])}

    return replace(ehsvjax.van_der_pol(), stepper=ehsvjax.runge_kutta_4(derivative))


def test_a_model_that_only_bears_the_name_of_one_of_the_package_is_not_taken_for_it(tmp_path):
    own = _own_oscillator()
    _fit_of(own).save(tmp_path / "fit")
    with pytest.raises(ValueError, match="not of this package"):
        Fit.load(tmp_path / "fit")
    assert Fit.load(tmp_path / "fit", own).model == own


@pytest.mark.parametrize("own_model", [False, True])
def test_an_effect_of_your_own_is_handed_over(own_model, tmp_path):
    base = _own_oscillator() if own_model else None
    bank = (*BANK, OWN)
    model = _attached(base or ehsvjax.van_der_pol(), {"suction.size": (0.0, 1.0)}, bank)
    fit = _fit_of(model)
    fit.save(tmp_path / "fit")
    with pytest.raises(ValueError, match="an effect 'suction' on signals of kind 'force' .*: hand it over"):
        Fit.load(tmp_path / "fit", base)
    # The model as it was fitted, or without its effects.
    for handed in (base, model):
        assert Fit.load(tmp_path / "fit", handed, bank).model == model


def _version_1(fit, path):
    """Write a fit as the first version did."""
    (record,) = fit.records
    arrays = {f"history/{name}": leaf for name, leaf in fit.history._asdict().items() if name != "best"}
    arrays |= {f"history/best/{name}": leaf for name, leaf in fit.history.best.items()}
    arrays |= {"record0/time": record.time}
    arrays |= {f"record0/inputs/{name}": values for name, values in record.inputs.items()}
    arrays |= {f"record0/outputs/{name}": values for name, values in record.outputs.items()}
    old = ("name", "symbol", "unit", "value", "lower", "upper", "scale", "fixed", "output")
    facts = {
        "model": fit.model.name,
        "options": dict(fit.model.options),
        "unknowns": {
            p.name: {key: getattr(p, key) for key in old} for p in (*fit.model.parameters, *fit.model.initial)
        },
        "records": [(record.name, record.hold)],
        "parameters": fit.parameters,
        "initial": fit.initial,
        "noise_variance": fit.noise_variance,
        "effort": fit.effort._asdict(),
        "warnings": fit.warnings,
        "huber": fit.huber,
        "estimated_initial": fit.estimated_initial,
        "noise_variance_given": fit.noise_variance_given,
    }
    with open(path, "wb") as file:
        np.savez_compressed(file, facts=np.array(json.dumps(facts)), **arrays)
    return path


@pytest.mark.parametrize("model", [ehsvjax.van_der_pol, ehsvjax.servovalve])
def test_a_file_of_the_first_version_loads(model, tmp_path):
    fit = _fit_of(model())
    loaded = Fit.load(_version_1(fit, tmp_path / "fit"))
    assert loaded.model == fit.model
    assert loaded.parameters == fit.parameters
    np.testing.assert_array_equal(loaded.history.best_cost, fit.history.best_cost)


def test_what_a_file_of_the_first_version_cannot_say_is_said(tmp_path):
    fit = _fit_of(MODELS["one effect"]())
    with pytest.raises(
        ValueError, match="handed over, 'servovalve with .*', got none, and which effects act where was"
    ):
        Fit.load(_version_1(fit, tmp_path / "fit"))
    assert Fit.load(tmp_path / "fit", fit.model).model == fit.model
    own = hand_made.fit()
    with pytest.raises(ValueError, match="handed over, 'amplifier', got none"):
        Fit.load(_version_1(own, tmp_path / "fit"))
    assert Fit.load(tmp_path / "fit", own.model).model == own.model


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"parameters": {"alpha": float("nan"), "gamma": 1.0}}, "a number in it is none"),
        ({"parameters": {"alpha": 1.0}}, "the values are of alpha, the free parameters alpha, gamma"),
        ({"noise_variance": {"position": -1.0}}, "a number in it is none"),
        ({"initial": ({},)}, "initial conditions are not those"),
        ({"history": hand_made.fit().history._replace(best_cost=np.ones(7))}, "history is not one of 3 generations"),
    ],
)
def test_a_file_of_the_first_version_that_contradicts_itself_is_refused(changes, said, tmp_path):
    fit = replace(_fit_of(ehsvjax.van_der_pol()), **changes)
    with pytest.raises(ValueError, match=f"fit cannot be read as a fit .*{said}.*: take another copy"):
        Fit.load(_version_1(fit, tmp_path / "fit"))


def test_what_is_no_fit_says_so(tmp_path):
    path = tmp_path / "fit"
    with pytest.raises(FileNotFoundError):
        Fit.load(path)
    np.savez(open(path, "wb"), numbers=np.ones(3))  # noqa: SIM115
    with pytest.raises(ValueError, match=r"fit cannot be read as a fit .* another file: it holds numbers\): take"):
        Fit.load(path)
    for content in (b"", b"text", b"PK\x03\x04", b"\x80\x04."):
        path.write_bytes(content)
        remedy = "take another copy" if content else "check that its export, copy"
        with pytest.raises(ValueError, match=rf"fit cannot be read as a fit written by Fit.save \(.*\): {remedy}"):
            Fit.load(path)


@pytest.mark.parametrize("handed", [{"model": "servovalve"}, {"bank": 3}, {"bank": ["sensor_bias"]}])
def test_what_is_no_model_or_no_effect_is_refused(handed, tmp_path):
    hand_made.fit().save(tmp_path / "fit")
    for load in (storage.load_fit, storage.load_diagnosis):
        with pytest.raises(ValueError, match=r"expected (model|bank.*) to be an? .*(Model|Effects?), got .*: hand"):
            inspect.unwrap(load)(tmp_path / "fit", **handed)


PROCESS = """
import sys
from ehsvjax.diagnosis import Diagnosis
diagnosis = Diagnosis.load(sys.argv[1])
diagnosis.report(sys.argv[2])
print(diagnosis)
print(diagnosis.extended.model.name, sorted(diagnosis.extended.simulate(diagnosis.record)["position"].tolist())[:3])
"""


@pytest.fixture(scope="module")
def diagnosis():
    hidden = Hidden("van_der_pol", "white", 1e-3, ("sensor_bias",), 5)
    (made,) = records([hidden], samples=300)
    record = Record(made.time, {"command": made.command}, {"position": made.position}, name="<bench>")
    key = jax.random.key(0)
    fit = ehsvjax.identify(ehsvjax.van_der_pol(), record, key=key, population=40, generations=15)
    return ehsvjax.diagnose(fit, record, key=key)


@pytest.fixture(scope="module")
def saved(diagnosis, tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "diagnosis.npz"
    diagnosis.save(path)
    return path


@of_the_oscillator
def test_a_diagnosis_prints_and_draws_the_same_in_another_process(diagnosis, saved, tmp_path):
    said = subprocess.run(
        [sys.executable, "-c", PROCESS, str(saved), str(tmp_path / "there.html")],
        capture_output=True, text=True, check=True,
        env=os.environ | {"PYTHONPATH": str(ROOT), "JAX_NUM_CPU_DEVICES": "2"},
    ).stdout  # fmt: skip
    simulated = sorted(diagnosis.extended.simulate(diagnosis.record)["position"].tolist())[:3]
    assert said == f"{diagnosis}\n{diagnosis.extended.model.name} {simulated}\n"
    diagnosis.report(tmp_path / "here.html")
    here, there = ((tmp_path / f"{name}.html").read_text() for name in ("here", "there"))
    pictures = re.findall(r"base64,([A-Za-z0-9+/=]+)", there)
    assert len(pictures) == 2
    assert all(base64.b64decode(picture).startswith(b"\x89PNG") for picture in pictures)
    assert there == here


@of_the_oscillator
def test_a_loaded_diagnosis_holds_its_parts_once(diagnosis, saved):
    loaded = Diagnosis.load(saved)
    assert loaded.extended.records[0] is loaded.record
    assert loaded.fit.records[0] is loaded.record
    assert (loaded.extended.model is loaded.fit.model) == (diagnosis.extended.model is diagnosis.fit.model)
    assert loaded.table.equals(diagnosis.table)
    assert list(loaded.table.dtypes) == list(diagnosis.table.dtypes)
    assert loaded.extended.model == diagnosis.extended.model


@of_the_oscillator
def test_the_fit_of_an_extended_model_comes_back(diagnosis, tmp_path):
    assert effects_of(diagnosis.extended.model)
    diagnosis.extended.save(tmp_path / "extended")
    loaded = Fit.load(tmp_path / "extended")
    assert loaded.model == diagnosis.extended.model
    assert loaded.rmse == diagnosis.extended.rmse


@of_the_oscillator
def test_a_fit_is_no_diagnosis_and_a_diagnosis_no_fit(saved, tmp_path):
    hand_made.fit().save(tmp_path / "fit")
    with pytest.raises(ValueError, match=r"cannot be read as a diagnosis .* \(it holds a Fit\)"):
        Diagnosis.load(tmp_path / "fit")
    with pytest.raises(ValueError, match=r"cannot be read as a fit .* \(it holds a Diagnosis\)"):
        Fit.load(saved)
