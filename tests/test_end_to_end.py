"""From a record made by an independent plant to a fit, in all the ways that `identify` offers."""

import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from scipy.optimize import least_squares

import ehsvjax
from ehsvjax import excitation, search
from tests import plants

ROOT = Path(__file__).parents[1]
PERIOD = 0.05
TRUTH = {"alpha": 0.96, "gamma": 1.23}


def _oscillator(noise_variance=0.05, seed=0, samples=400, initial=(0.3, -0.2), name="oscillator"):
    command = np.repeat(np.random.default_rng([seed, 1]).uniform(-2, 2, samples // 20), 20)
    position = plants.van_der_pol_plant(command, PERIOD, initial=initial, **TRUTH)[:, 0]
    noise = np.random.default_rng([seed, 2]).normal(0.0, noise_variance**0.5, samples)
    return ehsvjax.Record(np.arange(samples) * PERIOD, {"command": command}, {"position": position + noise}, name=name)


def _identified(record, **changes):
    options = {"key": jax.random.key(0), "population": 40, "generations": 25} | changes
    return ehsvjax.identify(ehsvjax.van_der_pol(), record, **options)


@pytest.fixture(scope="module")
def record():
    return _oscillator()


@pytest.fixture(scope="module")
def fit(record):
    return _identified(record)


@pytest.fixture(scope="module")
def valve_record():
    key = jax.random.key(5)
    command = excitation.pseudo_random_signal(key, amplitude=6e-3, hold_time=0.2, duration=2.0, sample_period=1e-3)
    motion = plants.servovalve_plant(command, 1e-3)
    rng = np.random.default_rng(3)
    return ehsvjax.Record(
        np.arange(len(command)) * 1e-3,
        {"command": command},
        {
            "position": motion.position + rng.normal(0, 1e-4, len(command)),
            "spool": motion.spool + rng.normal(0, 2e-5, len(command)),
        },
    )


def _scipy_cost(record, start):
    """Least sum of squares that SciPy finds by itself, plant and optimiser both being its own."""

    def residual(values):
        alpha, gamma, x1, x2 = values
        simulated = plants.van_der_pol_plant(record.inputs["command"], PERIOD, alpha, gamma, (x1, x2))
        return record.outputs["position"] - simulated[:, 0]

    return 2.0 * least_squares(residual, start, xtol=1e-12, ftol=1e-12, gtol=1e-12).cost


def test_fit_is_the_minimum_that_scipy_finds(record, fit):
    start = [*fit.parameters.values(), *fit.initial[0].values()]
    variance = fit.rmse["position"] ** 2
    assert np.sum(fit.residuals()["position"] ** 2) == pytest.approx(_scipy_cost(record, start), abs=0.01 * variance)
    assert fit.effort.converged
    assert fit.warnings == ()


def test_errors_are_those_that_the_bound_allows(record):
    # Sum of squares over a 2-parameter bound; 30 draws of a chi^2 with 30 degrees: 13.8..53.7 holds 99 %.
    bound = ehsvjax.cramer_rao_bound(
        ehsvjax.van_der_pol(),
        record,
        noise_variance={"position": 0.05},
        initial_values={"initial_position": 0.3, "initial_velocity": -0.2},
    )
    # The paper's sizes: what the search alone reaches is a claim about those.
    sizes = {"population": 100, "generations": 50}
    fits = [_identified(_oscillator(seed=100 + i), key=jax.random.key(i), **sizes) for i in range(30)]
    for name, true in TRUTH.items():
        statistic = sum(((f.parameters[name] - true) / bound[name]) ** 2 for f in fits)
        assert 10.0 < statistic < 66.0, (name, statistic)  # a false alarm in 1e4
        alone = sum(((f.history.best[name][-1] - true) / bound[name]) ** 2 for f in fits)
        assert alone < 1.05**2 * 66.0, (name, alone)


def test_servovalve_with_two_outputs(valve_record):
    fit = ehsvjax.identify(
        ehsvjax.servovalve(), valve_record, key=jax.random.key(0), population=40, generations=15, starts=2
    )
    model = ehsvjax.servovalve()
    bound = ehsvjax.cramer_rao_bound(model, valve_record, noise_variance={"position": 1e-8, "spool": 4e-10})
    for name, value in fit.parameters.items():
        assert abs(value - model.nominal[name]) < 5.0 * bound[name], name
    assert fit.noise_variance["position"] == pytest.approx(1e-8, rel=0.15)  # 3 sigma of a variance of 2,000 samples
    assert fit.noise_variance["spool"] == pytest.approx(4e-10, rel=0.15)
    assert "load_pressure" not in fit.rmse


def test_records_of_different_length_share_parameters(record, fit):
    other = _oscillator(seed=7, samples=300, initial=(-0.8, 0.5), name="shorter")
    both = _identified([record, other])
    assert both.initial[1]["initial_position"] == pytest.approx(-0.8, abs=0.5)
    assert both.initial[0] != both.initial[1]
    for name, true in TRUTH.items():
        assert both.parameters[name] == pytest.approx(true, rel=0.12)
    # A record that is padded by another costs what it costs alone.
    assert both.score(record).rmse["position"] == pytest.approx(fit.rmse["position"], rel=0.05)


def test_same_key_same_fit_and_nothing_compiled_twice(record, fit):
    jax.clear_caches()
    _identified(record)
    with jax.log_compiles(), _Compilations() as compilations:
        again = _identified(_oscillator(seed=1), bounds={"alpha": (0.5, 1.2)})
        same = _identified(record)
    assert compilations.names == []
    assert same.parameters == fit.parameters
    assert again.parameters != fit.parameters


class _Compilations:
    """Collects what JAX says that it compiles."""

    def __enter__(self):
        import logging

        self.names = []
        self._handler = logging.Handler()
        self._handler.emit = self._note
        self._logger = logging.getLogger("jax")
        self._logger.addHandler(self._handler)
        return self

    def __exit__(self, *_):
        self._logger.removeHandler(self._handler)

    def _note(self, message):
        text = message.getMessage()
        if text.startswith("Compiling "):
            self.names.append(text[:80])


def test_configuration_of_the_user_is_left_alone(record):
    assert not jax.config.jax_enable_x64
    _identified(record)
    assert not jax.config.jax_enable_x64


@pytest.mark.parametrize("islands", [1, 2])
def test_a_guess_joins_the_first_population(record, islands):
    """Of one generation of a few individuals the truth is the best; what is not named is nominal."""
    small = {"population": 8, "generations": 1, "starts": 1, "refine": False, "islands": islands}
    known = {"initial": {"initial_position": 0.3, "initial_velocity": -0.2}}
    found = _identified(record, start=TRUTH, **small, **known)
    assert found.parameters == pytest.approx(TRUTH, rel=1e-6)
    # Its initial conditions are in the middle of what the first readings show, and nominal.
    assert _identified(record, start=TRUTH, **small).parameters == pytest.approx(TRUTH, rel=1e-6)
    assert _identified(record, start={"gamma": 1.23}, **small, **known).parameters == pytest.approx(TRUTH, rel=1e-6)


def test_a_guess_that_cannot_be_is_refused(record):
    for start, message in (
        ({"alfa": 1.0}, "alfa"),
        ({"initial_position": 0.0}, "to be identified, alpha, gamma"),
        ({"alpha": 3.0}, "within its bounds, 0.48 to 1.44"),
        ({"alpha": float("nan")}, "start of alpha"),
    ):
        with pytest.raises(ValueError, match=message):
            _identified(record, start=start)
    with pytest.raises(ValueError, match="alpha"):
        _identified(record, start={"alpha": 0.9}, fixed={"alpha": 0.96})


def test_known_initial_conditions_and_fixed_parameters(record):
    known = {"initial_position": 0.3, "initial_velocity": -0.2}
    fit = _identified(record, initial=known, fixed={"alpha": 0.96})
    assert list(fit.parameters) == ["gamma"]
    assert fit.initial == (known,)
    part = _identified(record, initial={"initial_velocity": -0.2})
    assert part.initial[0]["initial_velocity"] == -0.2
    assert part.initial[0]["initial_position"] == pytest.approx(0.3, abs=0.5)


def test_a_constant_is_identified_once_it_has_bounds(valve_record):
    fit = ehsvjax.identify(
        ehsvjax.servovalve(),
        valve_record.select(outputs=["position"]),
        key=jax.random.key(0),
        population=20,
        generations=5,
        starts=1,
        bounds={"supply_pressure": (100e5, 200e5)},
        fixed={"flow_gain": 1.45e-4},
    )
    assert fit.parameters["supply_pressure"] == pytest.approx(140e5, rel=0.02)


def test_huber_cost_is_not_moved_by_spikes(record):
    spiky = np.array(record.outputs["position"])
    spiky[::17] += 8.0
    spoiled = ehsvjax.Record(record.time, record.inputs, {"position": spiky})
    squares, robust = _identified(spoiled), _identified(spoiled, huber=1.345)
    errors = [max(abs(f.parameters[n] / true - 1) for n, true in TRUTH.items()) for f in (squares, robust)]
    assert errors[1] < 0.5 * errors[0]
    assert errors[1] < 0.1


def test_missing_samples_carry_no_weight(record, fit):
    with_gap = np.array(record.outputs["position"])
    with_gap[100:140] = np.nan
    gappy = _identified(ehsvjax.Record(record.time, record.inputs, {"position": with_gap}))
    for name, value in fit.parameters.items():
        assert gappy.parameters[name] == pytest.approx(value, rel=0.1)
    assert np.isnan(gappy.residuals()["position"]).sum() == 40


def test_a_minimum_outside_the_bounds_is_warned_of(record):
    fit = _identified(record, bounds={"alpha": (1.0, 1.4)})
    assert fit.parameters["alpha"] == pytest.approx(1.0, abs=1e-6)
    assert any("alpha is at its lower bound" in warning for warning in fit.warnings)


def test_without_refinement_it_says_so(record, fit):
    coarse = _identified(record, refine=False)
    assert any("not refined" in warning for warning in coarse.warnings)
    assert coarse.cost >= fit.cost
    assert {n: v[-1] for n, v in coarse.history.best.items()} == pytest.approx(coarse.parameters)
    assert np.all(np.diff(coarse.history.best_cost) <= 0)


def test_saved_fit_comes_back_whole(fit, tmp_path):
    path = tmp_path / "fit.npz"
    fit.save(path)
    loaded = ehsvjax.Fit.load(path)
    assert loaded.parameters == fit.parameters
    assert loaded.model == fit.model
    assert loaded.cost == fit.cost
    assert str(loaded) == str(fit)
    np.testing.assert_array_equal(loaded.history.best_cost, fit.history.best_cost)


def test_another_record_is_predicted(fit):
    other = _oscillator(seed=9, initial=(1.0, 0.0))
    assert fit.score(other).rmse["position"] == pytest.approx(0.05**0.5, rel=0.15)
    assert fit.score(other, initial="nominal").rmse["position"] > fit.score(other).rmse["position"]
    estimated = fit.initial_of(other)
    assert estimated["initial_position"] == pytest.approx(1.0, abs=0.5)
    assert fit.score(other, estimated) == fit.score(other)
    assert fit.initial_of(fit.records[0]) == fit.initial[0]
    with pytest.raises(ValueError, match="expected an initial condition of Van der Pol oscillator, got 'alpha'; it"):
        fit.initial_of(other, {"alpha": 1.0})


SCRIPT = """
import sys, jax, numpy as np, ehsvjax
from ehsvjax import search
if sys.argv[2] == "slow":
    import time
    store = search._store
    def slow_store(*a):
        store(*a); print("generation", flush=True); time.sleep(0.2)
    search._store = slow_store
data = np.load(sys.argv[1])
record = ehsvjax.Record(data["time"], {"command": data["command"]}, {"position": data["position"]})
fit = ehsvjax.identify(ehsvjax.van_der_pol(), record, key=jax.random.key(2), population=20, generations=12,
                       tolerance=0.0, checkpoint=sys.argv[3])
print("result", {n: v.hex() for n, v in fit.parameters.items()}, [float(c).hex() for c in fit.history.best_cost])
"""


@pytest.mark.parametrize("killed_after", [1, 7])
def test_killed_run_goes_on_to_the_same_result(record, tmp_path, killed_after):
    data = tmp_path / "data.npz"
    np.savez(data, time=record.time, command=record.inputs["command"], position=record.outputs["position"])
    script = tmp_path / "run.py"
    script.write_text(textwrap.dedent(SCRIPT))
    environment = os.environ | {"PYTHONPATH": str(ROOT)}

    def command(pace, checkpoint):
        return [sys.executable, str(script), str(data), pace, str(tmp_path / checkpoint)]

    with subprocess.Popen(command("slow", "a"), stdout=subprocess.PIPE, text=True, env=environment) as process:
        for _ in range(killed_after):
            assert process.stdout.readline() == "generation\n"
        time.sleep(0.05 * killed_after)
        process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    resumed, whole = (
        subprocess.run(command("fast", name), capture_output=True, text=True, check=True, env=environment).stdout
        for name in ("a", "b")
    )
    assert "result" in whole
    assert resumed == whole


def test_a_run_goes_on_from_every_generation_to_the_same_result(record, tmp_path, monkeypatch):
    kept, store = [], search._store

    def store_and_keep(path, *rest):
        store(path, *rest)
        kept.append(shutil.copy(path, tmp_path / f"generation_{len(kept)}"))

    options = {"population": 20, "generations": 12, "tolerance": 0.0}
    whole = _identified(record, **options)
    with monkeypatch.context() as patched:
        patched.setattr(search, "_store", store_and_keep)
        _identified(record, **options, checkpoint=tmp_path / "run")
    assert len(kept) == 12
    for path in kept:
        resumed = _identified(record, **options, checkpoint=path)
        assert resumed.parameters == whole.parameters
        np.testing.assert_array_equal(resumed.history.best_cost, whole.history.best_cost)


def test_progress_bar_and_checkpoint_change_nothing(record, fit, tmp_path, capfd):
    watched = _identified(record, progress=True, checkpoint=tmp_path / "run")
    assert watched.parameters == fit.parameters
    assert "generations" in capfd.readouterr().err
    # Gone on from its end, it is the same again.
    assert _identified(record, checkpoint=tmp_path / "run").parameters == fit.parameters
    with pytest.raises(ValueError, match="expected .* to be the checkpoint of this search, got one of another"):
        _identified(_oscillator(seed=1), checkpoint=tmp_path / "run")
    (tmp_path / "other").write_text("no checkpoint")
    with pytest.raises(
        ValueError, match="other cannot be read as a checkpoint of a search .*: remove it or name a new"
    ):
        _identified(record, checkpoint=tmp_path / "other")


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"fixed": {"mass": 1.0}}, "expected a parameter of Van der Pol oscillator, got 'mass'; it has alpha, gamma"),
        ({"bounds": {"alpha": (2.0, 1.0)}}, "expected finite bounds of alpha with lower < upper"),
        ({"bounds": {"alpha": (0.5, 1.0)}, "fixed": {"alpha": 0.9}}, "either bounded or fixed, got both for alpha"),
        ({"initial": "unknown"}, "expected initial to be 'estimate', 'nominal' or known values"),
        ({"initial": {"speed": 1.0}}, "expected an initial condition of Van der Pol oscillator, got 'speed'"),
        ({"noise_variance": {"speed": 1.0}}, "expected the noise variance of each measured output"),
        ({"noise_variance": {"position": -1.0}}, "expected noise_variance of position to be positive, got -1.0"),
        ({"population": 2}, "expected population to be a whole number of at least 4, got 2"),
        ({"generations": 0}, "expected generations to be a whole number of at least 1, got 0"),
        ({"huber": -1.0}, "expected huber to be a positive number of standard deviations"),
        ({"starts": 0}, "expected starts to be a whole number from 1 to "),
        ({"tolerance": -1.0}, "expected tolerance to be zero or more"),
        ({"operators": ehsvjax.Operators(elites=0)}, "elites"),
        ({"operators": ehsvjax.Operators(immigrants=1.0)}, "expected immigrants to be a share"),
    ],
)
def test_bad_calls_are_answered(record, changes, sentence):
    with pytest.raises(ValueError, match=sentence.replace("(", r"\(")):
        _identified(record, **changes)


def test_bad_records_are_answered(record):
    with pytest.raises(ValueError, match="expected more samples than unknowns, got 4 measured samples"):
        _identified(record.slice(0.0, 0.2))
    renamed = ehsvjax.Record(record.time, record.inputs, {"height": record.outputs["position"]})
    with pytest.raises(ValueError, match="to be among those of Van der Pol oscillator, position; got height"):
        _identified(renamed)
    without_input = ehsvjax.Record(record.time, {}, record.outputs)
    with pytest.raises(ValueError, match="it lacks command"):
        _identified(without_input)


def test_initial_conditions_that_were_known_stay_known_for_another_record(record):
    fit = _identified(record, initial={"initial_velocity": -0.2})
    assert fit.estimated_initial == ("initial_position",)
    other = _oscillator(seed=9, initial=(1.0, -0.2))
    given = {"initial_position": 1.0, "initial_velocity": -0.2}
    assert fit.score(other).rmse["position"] <= fit.score(other, initial=given).rmse["position"]
    started = fit.simulate(other)["position"][:2]
    # The first step shows the velocity: x1' = alpha*x2.
    assert (started[1] - started[0]) / PERIOD == pytest.approx(-0.2, abs=0.1)
