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


def _dropped(pump, edge):
    """Readings of float and switch that carry no weight, with the edge as it is; it is known to some 1.4 mm."""
    level = PERIOD * np.r_[0.0, np.cumsum(pump)[:-1]]
    rng = np.random.default_rng(4)
    noise = NOISE * rng.standard_normal((2, SAMPLES))
    outputs = {"float": level - 0.5 * edge + noise[0], "switch": (level > edge) + noise[1]}
    record = ehsvjax.Record(PERIOD * np.arange(SAMPLES), {"pump": pump}, outputs)
    fit = ehsvjax.identify(_switch(), record, key=jax.random.key(0), population=20, generations=10)
    bench = workbench(fit, [record], BANK)
    noise = plain_noise(np.full(2, NOISE**2), bench.problem.samples.measured)
    # Where the edge is, and not where chance has put the fit.
    point = bench.nominal.copy()
    point[bench.column["edge"]] = edge - 0.5
    current = refit(bench, point[None], padded([bench.base_columns]), noise, iterations=1)
    left = without_jumps(bench, current, noise).problem.samples.measured
    dropped = bench.problem.samples.measured & ~left
    return [np.flatnonzero(dropped[0, :, i]).tolist() for i in range(2)]


@pytest.mark.parametrize(("before", "beside"), [(3e-4, [50]), (3e-3, [50]), (0.5 * PERIOD, [])])
def test_a_reading_within_the_error_of_a_jump_carries_no_weight(before, beside):
    # The level rises by 1 m/s: it passes the edge so long before sample 50.
    assert _dropped(np.ones(SAMPLES), 50 * PERIOD - before) == [[], beside]


@pytest.mark.parametrize(("above", "open_ones"), [(3e-4, range(50, 57)), (0.5 * PERIOD, [])])
def test_readings_at_rest_that_may_be_on_either_side_carry_no_weight(above, open_ones):
    """A friction's sign where a piston rests: all of them change together, and a cause by which they do was named."""
    pump = np.ones(SAMPLES)
    pump[50:56] = 0.0
    assert _dropped(pump, 50 * PERIOD + above) == [[], list(open_ones)]


def test_unknowns_that_make_up_for_each_other_do_so_at_their_bounds_too():
    """Cut there one by one, they left readings of what rises smoothly without weight."""
    time, pump = PERIOD * np.arange(SAMPLES), {"pump": np.where(np.arange(SAMPLES) > 190, 1.0, 0.0)}
    model = Model(
        name="two rates",
        parameters=(Parameter("one", "a", "m/s", 0.7, 0.0, 1.0), Parameter("other", "b", "m/s", 0.26, 0.0, 1.0)),
        initial=(),
        signals=(Signal("pump", "input", ""), Signal("float", "sensor", "m")),
        start=_start,
        stepper=ehsvjax.runge_kutta_4(
            lambda parameters, state, inputs, signal: {
                "level": inputs["pump"] * (parameters["one"] + (1.0 + 0.5 * state["level"]) * parameters["other"])
            }
        ),
        measure=lambda parameters, state, inputs, signal: {"float": signal("float", state["level"])},
        max_step=PERIOD,
    )
    record = ehsvjax.Record(time, pump, {"float": time})
    clean = ehsvjax.simulate(model, record, model.nominal)["float"]
    noisy = clean + 1e-3 * np.random.default_rng(5).standard_normal(SAMPLES)
    record = ehsvjax.Record(time, pump, {"float": noisy})
    fit = ehsvjax.identify(model, record, key=jax.random.key(0), population=20, generations=10)
    bench = workbench(fit, [record], BANK)
    point = bench.nominal.copy()
    point[[bench.column["one"], bench.column["other"]]] = [0.7, 0.26]
    noise = plain_noise(np.full(1, 1e-6), bench.problem.samples.measured)
    current = refit(bench, point[None], padded([bench.base_columns]), noise, iterations=1)
    assert without_jumps(bench, current, noise) is bench


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
