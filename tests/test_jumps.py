"""Readings beside a jump that nothing places before or behind them carry no weight; all others do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ehsvjax
from ehsvjax.diagnosis.bench.jumps import without_jumps
from ehsvjax.diagnosis.bench.noise import plain_noise
from ehsvjax.diagnosis.bench.refits import padded, refit
from ehsvjax.diagnosis.bench.setup import workbench
from ehsvjax.effects import BANK
from ehsvjax.models.model import Model, Parameter, Signal

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
    current = refit(bench, point[None], padded([bench.base_columns], len(bench.base_columns)), noise, iterations=1)
    left = without_jumps(bench, current, noise).problem.samples.measured
    dropped = bench.problem.samples.measured & ~left
    assert np.flatnonzero(dropped[0, :, 1]).tolist() == beside
    assert not dropped[0, :, 0].any()
