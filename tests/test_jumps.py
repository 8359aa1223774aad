"""Readings beside a jump that nothing places before or behind them carry no weight; all others do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import ehsvjax
from ehsvjax.diagnosis.bench.jumps import without_jumps
from ehsvjax.diagnosis.bench.noise import plain_noise
from ehsvjax.diagnosis.bench.refits import padded, refit
from ehsvjax.diagnosis.bench.setup import workbench
from ehsvjax.effects import BANK
from ehsvjax.models.model import Model, Parameter, Signal
from ehsvjax.population import to_unit
from tests.plants import servovalve_plant

PERIOD, SAMPLES, NOISE = 0.02, 200, 0.01


def _rates(parameters, state, inputs, signal):
    return {"level": parameters["rate"] * signal("pump", inputs["pump"])}


def _start(parameters, initial, inputs):
    return {"level": 0.0}


def _measure(parameters, state, inputs, signal):
    level, edge = state["level"], parameters["edge"]
    # The float tells of the edge smoothly, the switch by when it closes.
    return {
        "float": signal("float", level - 0.5 * edge),
        "switch": signal("switch", jnp.where(level > edge, 1.0, 0.0)),
    }


def _switch() -> Model:
    return Model(
        name="switch",
        parameters=(
            Parameter("edge", "e", "m", 1.0, 0.5, 1.5),
            Parameter("rate", "r", "m/s", 1.0, 1.0, 1.0, fixed=True, certain=True),
        ),
        initial=(),
        signals=(Signal("pump", "input", ""), Signal("float", "sensor", "m"), Signal("switch", "sensor", "V")),
        start=_start,
        stepper=ehsvjax.runge_kutta_4(_rates),
        measure=_measure,
        max_step=PERIOD,
    )


@pytest.mark.parametrize(("before", "beside"), [(3e-4, [50]), (3e-3, [50]), (0.5 * PERIOD, [])])
def test_a_reading_within_the_error_of_a_jump_carries_no_weight(before, beside):
    # The level rises by 1 m/s: it passes the edge so long before sample 50. The edge is known to some 1.4 mm.
    time, edge = PERIOD * np.arange(SAMPLES), 50 * PERIOD - before
    rng = np.random.default_rng(4)
    noise = NOISE * rng.standard_normal((2, SAMPLES))
    outputs = {"float": time - 0.5 * edge + noise[0], "switch": (time > edge) + noise[1]}
    record = ehsvjax.Record(time, {"pump": np.ones(SAMPLES)}, outputs)
    fit = ehsvjax.identify(_switch(), record, key=jax.random.key(0), population=20, generations=10)
    bench = workbench(fit, [record], BANK)
    noise = plain_noise(np.full(2, NOISE**2), bench.problem.samples.measured)
    # Where the edge is, and not where chance has put the fit.
    point = bench.nominal.copy()
    point[bench.column["edge"]] = edge - 0.5
    current = refit(bench, point[None], padded([bench.base_columns]), noise, iterations=1)
    left = without_jumps(bench, current, noise).problem.samples.measured
    dropped = bench.problem.samples.measured & ~left
    assert np.flatnonzero(dropped[0, :, 1]).tolist() == beside
    assert not dropped[0, :, 0].any()


def test_a_reading_just_behind_a_jump_that_the_steps_smear_carries_no_weight():
    """The spool leaves its dead zone 2.7 us before a sample: the load pressure has jumped, in steps of 0.25 ms hardly.

    The unknowns are known so well that their errors alone do not place the jump behind the sample.
    """
    noise_of, behind = {"position": 1e-6, "load_pressure": 5e4}, 103

    def command(level):
        return np.repeat([-1e-3, level, -1.5e-3, 1e-3], 100)

    def past_the_edge(level):
        # At so many metres a second it is 0.5 um beyond the edge 2.7 us later.
        return servovalve_plant(command(level)[: behind + 1], 1e-3).spool[behind] - (1e-4 + 5e-7)

    level = brentq(past_the_edge, -9e-4, 4e-3, xtol=1e-12)
    motion = servovalve_plant(command(level), 1e-3)
    rng = np.random.default_rng(1)
    outputs = {n: getattr(motion, n) + s * rng.standard_normal(400) for n, s in noise_of.items()}
    record = ehsvjax.Record(1e-3 * np.arange(400), {"command": command(level)}, outputs)
    model = ehsvjax.servovalve()
    off = np.abs(ehsvjax.simulate(model, record)["load_pressure"] - motion.load_pressure) / noise_of["load_pressure"]
    assert off[behind] > 5.0
    fit = ehsvjax.identify(model, record, key=jax.random.key(0), population=50, generations=20)
    bench = workbench(fit, [record], BANK)
    noise = plain_noise(np.array([noise_of[n] ** 2 for n in outputs]), bench.problem.samples.measured)
    # At the truth, and not where this reading has put the fit.
    point = bench.nominal.copy()
    truth = to_unit(bench.problem.coordinates, np.array([model.nominal.get(n, 0.0) for n in bench.problem.names]))
    point[bench.base_columns] = truth[bench.base_columns]
    current = refit(bench, point[None], padded([bench.base_columns]), noise, iterations=1)
    dropped = bench.problem.samples.measured & ~without_jumps(bench, current, noise).problem.samples.measured
    assert behind in np.flatnonzero(dropped[0, :, 1]) and dropped[0, :, 1].sum() < 12
    assert not dropped[0, :, 0].any()
