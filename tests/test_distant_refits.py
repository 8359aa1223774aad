"""Refits of a servovalve from far off and on machines of any size: one valley, and derivatives that are right."""

from collections import Counter
from dataclasses import replace

import jax
import numpy as np
import pytest

import ehsvjax
from ehsvjax.diagnosis.bench.evidence import INSEPARABLE
from ehsvjax.diagnosis.bench.noise import plain_noise
from ehsvjax.diagnosis.bench.refits import padded, refit
from ehsvjax.diagnosis.bench.setup import workbench
from ehsvjax.diagnosis.bench.workbench import Workbench
from ehsvjax.diagnosis.decision.trials import refit_sets, trials_of
from ehsvjax.diagnosis.hypotheses.screening import responses_at, screen
from ehsvjax.effects import BANK
from tests.plants import Valve, held_levels, servovalve_plant

# One process compiles.
pytestmark = pytest.mark.xdist_group("diagnoses of the servovalve")
KEY = jax.random.key(1)
SAMPLES = 2000
TIME = 1e-3 * np.arange(SAMPLES)
COMMAND = held_levels(1, 6e-3, SAMPLES // 200, 200)


def bench_of(model, position, noise, **bounds):
    noisy = position + noise * np.random.default_rng(1001).standard_normal(SAMPLES)
    record = ehsvjax.Record(TIME, {"command": COMMAND}, {"position": noisy})
    fit = ehsvjax.identify(model, record, key=KEY, population=50, generations=20, bounds=bounds)
    return workbench(fit, [record], BANK)


# --- A constant that is another than was given: along the flow gain over the constant all but nothing changes ---

SHARES = (0.02, 0.1, 0.2, 0.35, 0.5, 0.7, 1.0)


@pytest.fixture(scope="module")
def starved():
    position = servovalve_plant(COMMAND, 1e-3, supply_pressure=70e5).position
    return bench_of(ehsvjax.servovalve(), position, 1e-4, flow_gain=(3e-5, 5e-4))


@pytest.fixture(scope="module")
def led(starved):
    """Where a supply pressure at half of what was given is led to."""
    return led_to(starved, "supply_pressure")


def led_to(bench, constant):
    """Return the refit without a wrong constant, that from shares of its linear estimate, and its column."""
    noise = plain_noise(np.array([1e-8]), bench.problem.samples.measured)
    trials = trials_of(bench, lambda stage, done: None)
    current = refit_sets(trials, [[bench.nominal]], [()], noise)
    tried = responses_at(bench, current, (), noise, trials.waves)
    names = {bench.candidates[s.candidate].name: s for s in screen(bench, current, tried, noise, 1).ranked}
    screened = names[constant]
    (column,) = bench.columns_of(bench.candidates[screened.candidate])
    starts = np.repeat(screened.start[None], len(SHARES), axis=0)
    starts[:, column] = np.clip(np.array(SHARES) * screened.start[column], *(b[column] for b in bench.bounds))
    columns = padded([bench.columns_with((screened.candidate,))] * len(starts))
    return current, refit(bench, starts, columns, noise, race=False), column


def test_every_start_leads_to_the_same_minimum(led):
    current, found, _ = led
    # One may still be on its way along the valley when its steps are used up.
    assert np.ptp(found.cost[found.converged]) < 1.0 and found.converged.sum() >= len(SHARES) - 1, found.cost
    assert np.ptp(found.cost) < INSEPARABLE, found.cost
    # Noise alone is left, and it was worth something to find.
    assert np.max(found.cost) < SAMPLES + 4.0 * (2 * SAMPLES) ** 0.5
    assert current.cost[0] - np.max(found.cost) > 25.0


def test_the_supply_pressure_is_that_of_the_plant(led, starved):
    _, found, column = led
    errors = [starved.value(point, column) for point in found.points]
    np.testing.assert_allclose(errors, -0.5, atol=0.1)


@pytest.mark.parametrize(("constant", "factor"), [("piston_area", 1.94), ("supply_pressure", 1.8)])
def test_no_start_stops_in_the_valley_of_a_constant_that_is_almost_twice_what_was_given(constant, factor):
    position = servovalve_plant(COMMAND, 1e-3, **{constant: factor * getattr(Valve(), constant)}).position
    bench = bench_of(ehsvjax.servovalve(), position, 1e-4, flow_gain=(3e-5, 6e-4))
    for blamed in ("piston_area", "supply_pressure"):
        _, found, _ = led_to(bench, blamed)
        assert found.converged.all()
        assert np.ptp(found.cost) < 0.5 * INSEPARABLE, (blamed, found.cost)


def test_most_of_the_way_to_a_minimum_is_gone_at_a_longer_step(starved, monkeypatch):
    noise = plain_noise(np.array([1e-8]), starved.problem.samples.measured)
    start = starved.nominal[None].copy()
    start[0, starved.base_columns] += 0.02
    columns = padded([starved.base_columns])
    simulated, found, spent = Workbench.simulated, {}, Counter()

    def counted(bench, points, *others):
        spent[int(bench.problem.substeps)] += len(points)
        return simulated(bench, points, *others)

    monkeypatch.setattr(Workbench, "simulated", counted)
    for steps in (32, 64):
        spent.clear()
        fine = replace(starved, problem=replace(starved.problem, substeps=np.int32(steps)))
        found[steps] = refit(fine, start, columns, noise).cost[0], spent[steps]
    (cost, simulations), (same_cost, fewer) = found[32], found[64]
    assert same_cost == pytest.approx(cost, abs=1.0)
    assert fewer < 0.5 * simulations, found


def test_no_unknown_leaves_its_bounds_on_the_way(led, starved):
    _, found, _ = led
    own = found.chosen[0][found.chosen[0] >= 0]
    lower, upper = (bound[own] for bound in starved.bounds)
    assert np.all(found.points[:, own] >= lower) and np.all(found.points[:, own] <= upper)


# --- Derivatives along forces, on machines of any size ---

MACHINES = ((25e-4, 20.0, 140e5), (25e-3, 200.0, 140e5), (0.1, 500.0, 350e5))


@pytest.mark.parametrize(("area", "mass", "supply"), MACHINES)
def test_derivatives_along_forces_are_right_on_a_machine_of_any_size(area, mass, supply):
    # As fast as the paper's.
    scale = area / 25e-4 * (140e5 / supply) ** 0.5
    model = ehsvjax.servovalve(piston_area=area, mass=mass, supply_pressure=supply)
    model = model.with_bounds(bounds={"flow_gain": (1e-5 * scale, 1e-3 * scale)})
    position = ehsvjax.simulate(
        model, ehsvjax.Record(TIME, {"command": COMMAND}), {"flow_gain": 1.45e-4 * scale}
    )["position"]  # fmt: skip
    bench = bench_of(model, position, 1e-5)
    forces = [c for c in bench.candidates if c.name in ("constant_load", "viscous_friction", "hardening_spring")]
    assert len(forces) == 3
    every = np.arange(len(bench.nominal))
    _, slopes = bench.linearised(bench.nominal[None], every[None])
    for candidate in forces:
        (j,) = bench.columns_of(candidate)
        # So small that they act in proportion, so large that no rounding shows.
        unit = bench.problem.coordinates.upper[j]
        largest = {"constant_load": 1.0, "viscous_friction": 2.0, "hardening_spring": 1e4}[candidate.name]
        size = 1e-3 * area * supply * largest / unit
        either = np.stack([bench.nominal, bench.nominal])
        either[:, j] += [size, -size]
        ahead, behind = bench.simulated(either)
        expected = (ahead - behind) / (2.0 * size)
        off = np.linalg.norm(slopes[j, 0] - expected) / np.linalg.norm(expected)
        assert off < 1e-3, (candidate.name, off)
