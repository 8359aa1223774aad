"""The trials' workbench: what it simulates side by side, against JAX's own derivatives."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import lsim

import ehsvjax
from benchmarks.real_models import damper
from ehsvjax.diagnosis.bench.noise import plain_noise
from ehsvjax.diagnosis.bench.parts import parts_at
from ehsvjax.diagnosis.bench.refits import not_made_up_for, padded, refit
from ehsvjax.diagnosis.bench.setup import workbench
from ehsvjax.diagnosis.bench.workbench import _simulated, prepared, settled
from ehsvjax.diagnosis.decision import search
from ehsvjax.diagnosis.decision.rivals import Rival, rivals_again
from ehsvjax.diagnosis.decision.search import _best_of, _from_nominal_starts_too, _look, _settled, _weighed
from ehsvjax.diagnosis.decision.stage import Stage
from ehsvjax.diagnosis.decision.trials import refit_screened, refit_set, refit_sets, trials_of
from ehsvjax.diagnosis.hypotheses.curves import bench_with, outputs_with, probe_at, quantities, straight_along
from ehsvjax.diagnosis.hypotheses.process_noise import process_noise
from ehsvjax.diagnosis.hypotheses.screening import Screened, Screening
from ehsvjax.effects import BANK
from ehsvjax.effects.effect import PROBED
from ehsvjax.population import cast, simulated
from tests.compilations import compilations
from tests.hidden_plants import servovalve_with
from tests.small_models import carriage, carriage_plant, record_of

# One process compiles; records are as long as those of test_diagnose.py.
pytestmark = pytest.mark.xdist_group("diagnoses of the oscillator")
PERIOD, SAMPLES = 0.05, 600


def bench_of(limit: float):
    """Return the workbench of a record in whose plant the command ends at a limit."""
    model = ehsvjax.van_der_pol()
    command = np.repeat(np.random.default_rng(6).uniform(-1.0, 1.0, 30), 20)
    time = PERIOD * np.arange(SAMPLES)
    acting = ehsvjax.Record(time, {"command": np.clip(command, -limit, limit)})
    position = ehsvjax.simulate(model, acting, {"alpha": 0.96, "gamma": 1.23})["position"]
    noisy = position + 0.01 * np.random.default_rng(7).standard_normal(SAMPLES)
    record = ehsvjax.Record(time, {"command": command}, {"position": noisy})
    fit = ehsvjax.identify(model, record, key=jax.random.key(0), population=50, generations=20)
    return workbench(fit, [record], BANK)


@pytest.fixture(scope="module")
def bench():
    return bench_of(np.inf)


def test_a_probe_moves_an_output_by_a_little_where_a_force_moves_it_once_and_for_all():
    # A carriage that follows its push at once: a force that is held shifts it, and moves it no more.
    slow = 10.0 * np.sin(0.05 * np.arange(SAMPLES))
    position = carriage_plant(slow, 0.5)[:, 0]
    record = record_of(0.5, {"push": slow}, {"position": position}, {"position": 1e-4}, 5, hold="linear")
    fit = ehsvjax.identify(carriage(), record, key=jax.random.key(0), population=20, generations=5)
    bench = workbench(fit, [record], BANK)
    added = np.zeros((2, *bench.disturbances.shape))
    added[1, ..., bench.places.index("force")] = bench.probes["force"]
    without, with_it = bench.simulated(np.repeat(bench.nominal[None], 2, axis=0), added)
    assert np.std(with_it - without) < 0.5 * abs(np.mean(with_it - without))
    assert np.sqrt(np.mean((with_it - without) ** 2)) == pytest.approx(PROBED * np.std(without), rel=0.01)


def test_derivatives_are_those_of_jax_at_effects_present_and_absent(bench):
    names = [c.name for c in bench.candidates]
    present, absent = (names.index(n) for n in ("rayleigh_damping", "cubic_stiffness"))
    columns = bench.columns_with([present, absent])
    point = bench.nominal.copy()
    point[bench.columns_of(bench.candidates[present])] = 3.0
    outputs, slopes = bench.linearised(point[None], np.array([[*columns, -1, -1]]))
    with jax.enable_x64(True):
        problem = cast(bench.problem, jnp.float64)
        here = jnp.asarray(point)
        along = jax.jit(lambda way: jax.jvp(lambda p: simulated(problem, p), (here,), (way,)))
        expected = [along(jnp.eye(len(point))[j]) for j in columns]
    np.testing.assert_allclose(outputs[0], expected[0][0], rtol=0, atol=1e-12)
    for found, (_, slope) in zip(slopes[:, 0], expected, strict=False):
        np.testing.assert_allclose(found, slope, rtol=0, atol=1e-3 * np.max(np.abs(slope)))
    assert slopes.shape[0] == len(columns) + 2
    assert not slopes[len(columns) :].any()


def test_points_are_simulated_alike_alone_and_among_many(bench):
    rng = np.random.default_rng(8)
    points = np.repeat(bench.nominal[None], 37, axis=0)
    points[:, bench.base_columns] *= rng.uniform(0.98, 1.02, (37, len(bench.base_columns)))
    added = 1e-3 * rng.standard_normal((37, 1, SAMPLES, len(bench.places)))
    together = bench.simulated(points, added)
    for i in (0, 15, 16, 36):
        np.testing.assert_array_equal(bench.simulated(points[i : i + 1], added[i : i + 1])[0], together[i])


def with_each_effect(bench):
    """Return a point for each candidate, with it alone, as large as it is tried first."""
    points = np.repeat(bench.nominal[None], len(bench.candidates), axis=0)
    for point, candidate in zip(points, bench.candidates, strict=True):
        for number, j in bench.unknowns_of(candidate):
            tried = number.tries(bench.scales[candidate.name])
            point[j] = bench.coordinate(tried[0], j)
    return points


def differ_by_rounding_alone(bench):
    """Whether effects that are skipped where they are absent leave what they leave where all are computed."""
    points = with_each_effect(bench)
    with jax.enable_x64(True):
        problem = cast(bench.problem, jnp.float64)
        every = np.asarray(jax.jit(jax.vmap(lambda point: simulated(problem, point)))(jnp.asarray(points)))
    for point, expected in zip(points, every, strict=True):
        # The corners of edges that are rounded have a width of a nanometre where they are sharp.
        np.testing.assert_allclose(bench.simulated(point[None])[0], expected, rtol=0, atol=1e-7 * np.std(expected))
    # And each does something, were it only a little.
    assert (np.max(np.abs(every - bench.simulated(bench.nominal[None])), axis=(1, 2, 3)) > 0).all()


def test_effects_that_are_absent_are_skipped_and_those_that_act_are_not(bench):
    differ_by_rounding_alone(bench)


@pytest.mark.thorough
def test_at_a_servovalve_too_effects_are_skipped_only_where_they_are_absent():
    bench = workbench(*valve_fitted(max_step=2.5e-4), BANK)
    differ_by_rounding_alone(bench)


def valve_fitted(max_step):
    """Return a fit of a servovalve with a step of the user's, and its records."""
    model = replace(ehsvjax.servovalve(), max_step=max_step)
    command = np.repeat(np.random.default_rng(3).uniform(-5e-3, 5e-3, 10), 30)
    record = ehsvjax.Record(1e-3 * np.arange(300), {"command": command})
    position = ehsvjax.simulate(model, record)["position"]
    noisy = position + 1e-4 * np.random.default_rng(4).standard_normal(300)
    record = replace(record, outputs={"position": noisy})
    return ehsvjax.identify(model, record, key=jax.random.key(0), population=16, generations=2), [record]


def test_another_step_is_no_other_program():
    workbench(*valve_fitted(1e-4), BANK)
    longer = valve_fitted(2.5e-4)
    # A bench simulates while it is made.
    with compilations() as compiled:
        bench = workbench(*longer, BANK)
        bench.simulated(bench.nominal[None])
    assert f"jit({_simulated.__name__})" not in compiled


@pytest.mark.parametrize("place", ["force", "position"])
def test_a_curve_that_always_acts_leaves_what_it_leaves_among_others(bench, place):
    curve = straight_along(bench, place, "position", quantities(bench), 9)
    # Thirty thousandths of the signal's unit, in probes.
    coefficients = np.random.default_rng(9).uniform(-0.03, 0.03, 9) / probe_at(bench, place)
    points = bench.nominal[None]
    readings = bench.problem.samples.outputs
    expected = readings - outputs_with(bench, points, coefficients[None], curve)[0]
    acting = bench_with(bench, curve, coefficients)
    found = acting.problem.samples.outputs - acting.simulated(points)[0]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)
    # A second curve comes on top of the first.
    gone = bench_with(acting, curve, -coefficients)
    left = readings - bench.simulated(points)[0]
    np.testing.assert_allclose(gone.problem.samples.outputs - gone.simulated(points)[0], left, rtol=0, atol=1e-12)
    assert np.max(np.abs(expected - left)) > 0.01


def test_unknowns_beside_a_curve_make_up_for_what_they_can(bench):
    noise = plain_noise(np.array([1e-4]), bench.problem.samples.measured)
    curve = straight_along(bench, "force", "position", quantities(bench), 9)
    # A stiffness that the plant has not: the unknowns lessen what it does, and cannot undo it.
    acting = bench_with(bench, curve, 20.0 * curve.knots)
    start, columns = bench.nominal[None], padded([bench.base_columns])
    free, beside = (refit(b, start, columns, noise, race=False) for b in (bench, acting))
    at_once = noise.scaled(acting.problem.samples.outputs - acting.simulated(start)[0])
    assert free.cost[0] <= beside.cost[0] < float(at_once @ at_once)


def test_nothing_is_known_of_a_disturbance_that_lets_the_model_run_away(bench):
    (stiffness,) = bench.columns_of(next(c for c in bench.candidates if c.name == "cubic_stiffness"))

    def at(coefficient):
        point = bench.nominal.copy()
        point[stiffness] = coefficient
        return point

    def survived(coefficient):
        return np.isfinite(parts := parts_at(bench, at(coefficient), "force").responses).all(axis=(1, 2, 3)) & (
            np.abs(parts).max(axis=(1, 2, 3)) > 0.0
        )

    # A spring that softens until the record's own motion almost runs away from it: some pushes are survived.
    hard, soft = 0.0, -1e6
    for _ in range(60):
        middle = 0.5 * (hard + soft)
        share = survived(middle).mean()
        if 0.0 < share < 1.0:
            break
        hard, soft = (middle, soft) if share == 1.0 else (hard, middle)
    else:
        pytest.fail("no spring that softens so much is found")
    assert np.isfinite(bench.sketched(at(middle)[None])).all()
    assert np.isfinite(parts_at(bench, at(middle), "force").responses).all()
    noise = plain_noise(np.array([1e-4]), bench.problem.samples.measured)
    there = refit(bench, at(middle)[None], padded([bench.base_columns]), noise, iterations=1)
    found = process_noise(bench, there, noise)
    assert found is None or np.isfinite(found.likelihood)


def test_a_set_that_cannot_be_simulated_does_not_get_the_refit_of_another():
    bench = bench_of(0.7)
    trials = trials_of(bench, lambda stage: None)
    noise = plain_noise(np.array([1e-4]), bench.problem.samples.measured)
    lost = np.full_like(bench.nominal, np.nan)
    found = refit_sets(trials, [[bench.nominal], [lost]], [(), (0,)], noise)
    assert np.isfinite(found.cost[0]) and found.cost[1] == np.inf
    assert set(trials.reached) == {frozenset()}


def test_a_limit_is_found_from_where_it_hardly_acts_yet_beside_a_rival():
    bench = bench_of(0.7)
    names = [c.name for c in bench.candidates]
    limit, rival = names.index("input_saturation"), names.index("input_gain")
    trials = trials_of(bench, lambda stage: None)
    noise = plain_noise(np.array([1e-4]), bench.problem.samples.measured)
    without = refit_sets(trials, [[bench.nominal]], [()], noise)
    (column,) = bench.columns_of(bench.candidates[limit])
    start = without.points[0].copy()
    start[column] = bench.coordinate(0.999 * np.max(np.abs(bench.problem.samples.inputs)), column)
    some = [
        Screened(i, 5.0, 1e-6, 1e-4, p, np.zeros(SAMPLES), (), False, 0.0)
        for i, p in ((limit, start), (rival, without.points[0]))
    ]
    found = refit_screened(trials, some, (), noise, without)
    assert bench.value(found.points[0], column) == pytest.approx(0.7, rel=0.02)
    assert found.cost[0] < 1.2 * SAMPLES < found.cost[1] < without.cost[0]


def test_a_single_cause_that_the_record_can_do_without_is_needless(bench):
    # What was found before readings beside a jump were left out may have been these readings.
    cause = [c.name for c in bench.candidates].index("input_saturation")
    trials = trials_of(bench, lambda stage: None)
    noise = plain_noise(np.array([1e-4]), bench.problem.samples.measured)
    nominal, found = (refit_sets(trials, [[bench.nominal]], [some], noise) for some in ((), (cause,)))
    weighed = _weighed(_look(trials, (cause,), found, noise), nominal)
    assert weighed.stage.included == (weighed.needless,), weighed.needs


def test_a_look_begins_at_the_nominal_models_step_whatever_was_tried_before(bench):
    """A wave that needed many steps a sample left them to all that was tried after it."""
    trials = trials_of(bench, lambda stage: None)
    noise = plain_noise(np.array([1e-4]), bench.problem.samples.measured)
    problem = trials.begun.problem
    fine = replace(trials.begun, problem=replace(problem, substeps=np.int32(16 * problem.substeps)))
    after = trials._replace(bench=fine)
    nominal = refit_sets(after, [[bench.nominal]], [()], noise)
    assert _look(after, (), nominal, noise).trials.bench.problem.substeps == problem.substeps
    # What is compared with what needs more has as many.
    as_fine = int(fine.problem.substeps)
    assert _look(after, (), nominal, noise, as_fine).trials.bench.problem.substeps == as_fine


def test_what_has_taken_one_causes_place_is_no_rival_of_another(bench):
    """Else an explanation has it twice, and no such model can be made."""
    names = [c.name for c in bench.candidates]
    one, other = names.index("cubic_stiffness"), names.index("rayleigh_damping")
    trials = trials_of(bench, lambda stage: None)
    noise = plain_noise(np.array([1e-4]), bench.problem.samples.measured)
    both = refit_sets(trials, [[bench.nominal]], [(one, other)], noise)
    groups = ((Rival(one, 0.0, both), Rival(other, 1.0, both)), (Rival(other, 0.0, both), Rival(one, 1.0, both)))
    included, _, found = rivals_again(_look(trials, (one, other), both, noise), groups)
    assert [[rival.candidate for rival in group] for group in found] == [[cause] for cause in included]


def test_sketches_follow_a_model_to_where_it_is_stiff():
    """A dashpot of 1 kN s/m behind a spring of 1.6 kN/mm settles in 0.6 ms; the one that was fitted in 60."""
    time = np.arange(400) / 128.0
    displacement = 0.02 * np.sin(np.pi * time)
    exact = lsim(([1e5, 0.0], [1e5 / 1.6e6, 1.0]), displacement, time)[1]
    noise = 50.0
    force = exact + noise * np.random.default_rng(2).standard_normal(400)
    record = ehsvjax.Record(time, {"displacement": displacement}, {"force": force}, hold="linear")
    fit = ehsvjax.identify(damper(), record, key=jax.random.key(0), population=20, generations=10)
    stands = prepared(workbench(fit, [record], BANK))
    stiff = stands.nominal.copy()
    stiff[stands.column["damping"]] = 0.0
    followed = settled(stands, stands.stepped(stiff[None]), np.array([noise**2]))
    off = np.abs(followed.sketched(stiff[None]) - followed.simulated(stiff[None]))
    assert np.mean(off > noise) < 0.3
    assert settled(followed, followed.stepped(stiff[None]), np.array([noise**2])) is followed


def test_arithmetic_is_asked_for_what_is_left_along_it_and_for_no_less_than_the_noise(bench):
    point, samples = bench.nominal[None], bench.problem.samples
    coarse = replace(bench, problem=replace(bench.problem, substeps=np.int32(1)))
    exact, here = (bench.simulated(point, substeps=n)[0] for n in (64, 1))
    off = here - exact
    # Its sum of squares is 25 times that of which nothing is asked.
    noise = plain_noise(np.array([float(np.sum(off**2)) / (25.0 * 0.05)]), samples.measured)

    def steps(left):
        readings = replace(coarse.problem, samples=samples._replace(outputs=here + left))
        return int(_settled(replace(coarse, problem=readings), point, noise).problem.substeps)

    rng = np.random.default_rng(0)
    white = np.sqrt(noise.variances[0]) * rng.standard_normal(off.shape)
    assert steps(white) > 1
    # What is left beside it asks for no less; what is left in its direction, part by part, does.
    assert steps(white + 30.0 * np.sqrt(noise.variances[0]) * (np.arange(SAMPLES) == 7)[:, None]) == steps(white)
    signs = np.repeat(rng.choice([-1.0, 1.0], 20), SAMPLES // 20)[:, None]
    assert steps(white + 1e3 * signs * off) == 1


@pytest.mark.parametrize(("steep", "found"), [(True, False), (False, True)])
def test_what_half_the_step_takes_away_is_no_gain(bench, monkeypatch, unchecked, steep, found):
    """Friction steeper than the step explained how a random force had shaken a ball that nothing holds."""
    coarse = replace(bench, problem=replace(bench.problem, substeps=np.int32(2)))
    candidate = [c.name for c in bench.candidates].index("stribeck_friction")
    force, velocity = bench.columns_of(bench.candidates[candidate])
    point = bench.nominal.copy()
    point[force], point[velocity] = bench.coordinate(0.5, force), bench.bounds[0 if steep else 1][velocity]
    # The arithmetic of the step makes these readings: where it is steep, those of none that is shorter.
    readings = coarse.simulated(point[None])[0] + 1e-4 * np.random.default_rng(2).standard_normal((1, SAMPLES, 1))
    samples = bench.problem.samples._replace(outputs=readings)
    trials = trials_of(replace(coarse, problem=replace(coarse.problem, samples=samples)), lambda *_: None)
    noise = plain_noise(np.array([1e-8]), samples.measured)
    current = refit_set(trials, bench.nominal, (), noise)
    screened = Screened(candidate, 5.0, 1e-6, 1e-4, point, np.zeros(SAMPLES), (), False, 0.0)
    assert refit_screened(trials, [screened], (), noise, current).cost[0] < 0.1 * current.cost[0]
    monkeypatch.setattr(search, "_look", lambda *_: SimpleNamespace(leaves_something=False))
    best = _best_of(Stage(trials, (), current, noise, Screening((screened,), (), 3.0)), [screened])
    assert (best is not None) == found


def test_what_unknowns_make_up_for_is_nothing_to_them(bench):
    trials = trials_of(bench, lambda *_: None)
    plain = plain_noise(bench.problem.noise_variance, bench.problem.samples.measured)
    refitted = refit_set(trials, bench.nominal, (), plain)
    beside = np.random.default_rng(1).standard_normal(refitted.residual[0].shape)
    basis = np.linalg.qr(plain.scaled(refitted.slopes[0][: len(bench.base_columns)]).T)[0]
    scaled = plain.scaled(beside)
    expected = scaled - basis @ (basis.T @ scaled)
    moved = beside + np.tensordot(np.linspace(-3.0, 2.0, len(refitted.slopes[0])), refitted.slopes[0], 1)
    np.testing.assert_allclose(plain.scaled(not_made_up_for(moved, refitted, plain.scaled)), expected, atol=1e-6)


def test_a_start_that_ran_to_where_a_limit_hides_it_is_left_for_the_nominal_one():
    """A spool that begins far beyond its stop, and a position to match: of such a record "something is left"."""
    command = np.repeat(np.random.default_rng(3).choice([-6e-3, 6e-3], 13), 48)[:SAMPLES]
    position = servovalve_with([{}], command[None], 1e-3)["position"][0]
    noisy = position + 1e-4 * np.random.default_rng(4).standard_normal(SAMPLES)
    record = ehsvjax.Record(1e-3 * np.arange(SAMPLES), {"command": command}, {"position": noisy})
    fit = ehsvjax.identify(ehsvjax.servovalve(), record, key=jax.random.key(0), population=50, generations=20)
    of_valve = workbench(fit, [record], [effect for effect in BANK if effect.name == "constant_load"])
    noise = plain_noise(of_valve.problem.noise_variance, of_valve.problem.samples.measured)
    trials = trials_of(of_valve, lambda *_: None)
    point = of_valve.nominal.copy()
    point[[of_valve.column[f"{name}[0]"] for name in ("initial_filtered", "initial_filtered_rate")]] = 0.0
    there = refit_set(trials, point, (), noise)
    assert there.cost[0] > 1.1 * SAMPLES
    stage = Stage(trials, (), there, noise, Screening((), (), 0.0))
    assert _from_nominal_starts_too(stage).cost[0] < there.cost[0] - 50.0
