"""The servovalve against stiff integrators, closed forms and the exact symmetry of its forward reading."""

import functools

import numpy as np
import pytest

from ehsvjax.models import servovalve
from ehsvjax.record import Record
from ehsvjax.simulate import simulate
from tests.plants import held_levels, servovalve_plant

PERIOD = 1e-3  # s
AREA, SUPPLY, FLOW_GAIN = 25e-4, 140e5, 1.45e-4


def staircase(seed):
    """The paper's record: levels in +-6 mm, held 0.2 s, for 4 s."""
    return held_levels(seed, 6e-3, 20, 200)


def polygon(seed, amplitude=6e-3, count=4000, every=50):
    corners = np.random.default_rng(seed).uniform(-amplitude, amplitude, count // every + 1)
    return np.interp(np.arange(count), every * np.arange(len(corners)), corners)


def record_of(command, hold="zero", period=PERIOD):
    command = np.asarray(command, dtype=float)
    return Record(period * np.arange(len(command)), {"command": command}, hold=hold)


@functools.cache
def measured_plant(seed):
    return servovalve_plant(staircase(seed), PERIOD)


def worst(actual, expected):
    return np.abs(actual - expected).max()


# --- The plant itself ---


def test_the_two_integrators_of_the_plant_agree():
    radau = servovalve_plant(staircase(1)[:2000], PERIOD, method="Radau", rtol=1e-6)
    assert worst(radau.position, measured_plant(1).position[:2000]) < 2e-8
    assert worst(radau.spool, measured_plant(1).spool[:2000]) < 2e-9


def test_the_two_integrators_of_the_compressible_plant_agree():
    radau, lsoda = (
        servovalve_plant(staircase(1)[:600], PERIOD, hydraulic_capacitance=2e-13, method=method, rtol=1e-7)
        for method in ("Radau", "LSODA")
    )
    assert worst(radau.position, lsoda.position) < 1e-7
    assert worst(radau.load_pressure, lsoda.load_pressure) < 1e3


def test_the_plant_goes_on_where_lsoda_cannot():
    command = held_levels(np.random.default_rng([5, 602090254]), 6e-3, 25, 200)
    found = servovalve_plant(command, PERIOD).position
    assert worst(simulate(servovalve(), record_of(command))["position"], found) < 2e-6


def test_the_floor_under_the_opening_does_not_matter():
    assert worst(servovalve_plant(staircase(1), PERIOD, floor=1e-7).position, measured_plant(1).position) < 5e-8
    assert worst(servovalve_plant(staircase(1), PERIOD, floor=1e-9).position, measured_plant(1).position) < 5e-9


# --- The model against the plant ---


@pytest.mark.parametrize("seed", range(5))
def test_the_papers_record(seed):
    plant = measured_plant(seed)
    outputs = simulate(servovalve(), record_of(staircase(seed)))
    assert worst(outputs["position"], plant.position) < 2e-6  # 1e-5 is asked for
    assert worst(outputs["spool"], plant.spool) < 2e-7
    # The pressure spikes where the spool crosses its null, for less than a sample; it is close everywhere else.
    off = np.abs(outputs["load_pressure"] - plant.load_pressure)
    assert np.quantile(off, 0.98) < 0.04 * plant.load_pressure.std()
    assert np.sqrt(np.mean(off**2)) < 0.2 * plant.load_pressure.std()


@pytest.mark.parametrize(
    ("options", "command", "hold"),
    [
        ({"transfer_function": "forward"}, staircase(1) / 0.09, "zero"),
        ({"transfer_function": "return"}, staircase(1), "zero"),
        ({"open_loop": True}, 0.3 * staircase(1) * np.repeat(np.tile([1, -1], 10), 200), "zero"),
        ({}, polygon(1), "linear"),
        ({"transfer_function": "return"}, polygon(1), "linear"),
        ({"stiffness": 0.0}, staircase(1), "zero"),
        ({"stiffness": 5e5, "mass": 50.0}, staircase(1), "zero"),
        ({"leakage_coefficient": 1e-11}, staircase(1), "zero"),
        ({"flow_force": True}, staircase(1), "zero"),
        ({"flow_force": True, "spool_stiffness": 1e5}, staircase(1), "zero"),
    ],
)
def test_every_reading_and_option(options, command, hold):
    plant = servovalve_plant(command, PERIOD, hold=hold, **options)
    outputs = simulate(servovalve(**options), record_of(command, hold))
    assert plant.position.std() > 5e-3
    assert worst(outputs["position"], plant.position) < 5e-6
    assert worst(outputs["spool"], plant.spool) < 1e-6
    off = np.abs(outputs["load_pressure"] - plant.load_pressure)
    assert np.quantile(off, 0.98) < 0.04 * plant.load_pressure.std()


@pytest.mark.parametrize(
    "options",
    [
        {"hydraulic_capacitance": 1e-13},
        {"hydraulic_capacitance": 3e-13, "flow_force": True},
        {"hydraulic_capacitance": 1e-12, "leakage_coefficient": 1e-11},
    ],
)
def test_oil_compressibility(options):
    command = staircase(1)
    plant = servovalve_plant(command, PERIOD, **options)
    outputs = simulate(servovalve(**options), record_of(command))
    assert worst(outputs["position"], plant.position) < 1e-5
    assert worst(outputs["spool"], plant.spool) < 1e-6
    off = outputs["load_pressure"] - plant.load_pressure
    # The load rings at 270 Hz, at most 15 steps per cycle.
    assert np.sqrt(np.mean(off**2)) < 0.06 * plant.load_pressure.std()


def test_flow_force_leakage_and_compressibility_are_seen_at_this_accuracy():
    nominal = measured_plant(1).position
    for option in ({"flow_force": True}, {"leakage_coefficient": 1e-11}, {"hydraulic_capacitance": 1e-12}):
        assert worst(servovalve_plant(staircase(1), PERIOD, **option).position, nominal) > 3e-5


@pytest.mark.parametrize("options", [{}, {"hydraulic_capacitance": 1e-12}, {"flow_gain": 1e-4}])
def test_second_order_in_the_step(options):
    # A smooth command that keeps the valve open: no kink and no jump to spoil the order.
    time = PERIOD * np.arange(400)
    command = 1.5e-3 + 20e-3 * time + 1e-4 * np.sin(2 * np.pi * 20 * time)
    initial = {"initial_filtered": 1.5e-3}
    plant = servovalve_plant(command, PERIOD, hold="linear", rtol=1e-12, **options, **initial)
    record = record_of(command, "linear")
    # The first 50 samples hold the jerk of a load that is set off at speed.
    errors = [
        worst(
            simulate(servovalve(), record, options, initial, substeps=substeps)["position"][50:],
            plant.position[50:],
        )
        for substeps in (2, 4, 8)
    ]
    assert errors[0] < 2e-7
    assert errors[0] / errors[1] == pytest.approx(4.0, abs=0.3)
    assert errors[1] / errors[2] == pytest.approx(4.0, abs=0.3)


# --- Hydraulic lock ---


@pytest.mark.parametrize(
    ("options", "command", "initial"),
    [
        ({}, 0.09 * 0.05 + 0.5e-4, {"initial_filtered": 0.5e-4}),
        ({}, 0.09 * 0.05 - 1e-4, {"initial_filtered": -1e-4}),  # at the very edge of the dead zone
        ({"open_loop": True}, 0.9e-4, {}),
        ({"open_loop": True, "flow_force": True}, -0.9e-4, {}),
        ({"transfer_function": "return"}, 0.09 * 0.05 + 0.5e-4, {"initial_filtered": 0.09 * 0.05}),
    ],
)
def test_in_hydraulic_lock_the_position_does_not_creep(options, command, initial):
    record = record_of(np.full(4000, command))
    initial = {"initial_position": 0.05, **initial}
    model = servovalve(**options)
    outputs = simulate(model, record, initial=initial)
    # 500 N of spring are held by 500 N / 25e-4 m^2 = 2 bar of trapped oil.
    np.testing.assert_array_equal(outputs["position"], 0.05)
    np.testing.assert_allclose(outputs["load_pressure"], 2e5, rtol=1e-12)
    plant = servovalve_plant(record.inputs["command"], PERIOD, floor=1e-9, **options, **initial)
    assert worst(plant.position, 0.05) < 2e-7  # creeps through the floor under its opening


def test_in_hydraulic_lock_the_velocity_is_zero():
    def velocity_for_position(name, value, **context):
        return context["velocity"] if name == "position" else value

    record, initial = (
        record_of(np.full(4000, 0.09 * 0.05 + 0.5e-4)),
        {"initial_position": 0.05, "initial_filtered": 5e-5},
    )
    outputs = simulate(servovalve(), record, initial=initial, signal=velocity_for_position)
    np.testing.assert_array_equal(outputs["position"], 0.0)


def test_a_long_dwell_in_the_dead_zone_after_a_move():
    command = np.repeat([4e-3, 0.05e-3, -3e-3, 0.08e-3], [400, 1600, 400, 1600])
    plant = servovalve_plant(command, PERIOD, open_loop=True)
    outputs = simulate(servovalve(open_loop=True), record_of(command))
    assert worst(outputs["position"], plant.position) < 2e-6
    assert np.ptp(outputs["position"][600:2000]) == 0.0
    assert outputs["position"][1000] > 0.1  # the spring pushes back with 1 kN meanwhile


def test_lock_where_the_spring_just_balances_the_supply():
    # The pressure drop is then zero over a closed valve: nothing moves, and nothing is divided by zero.
    for supply in np.linspace(100e5, 160e5, 7).tolist():
        model = servovalve(open_loop=True, stiffness=1e6, supply_pressure=supply)
        stalled = AREA * supply / 1e6
        outputs = simulate(model, record_of(np.zeros(4000)), initial={"initial_position": stalled})
        np.testing.assert_allclose(outputs["position"], stalled, rtol=1e-12)
        np.testing.assert_allclose(outputs["load_pressure"], supply, rtol=1e-9)


# --- Closed forms ---


@pytest.mark.parametrize(("command", "opening"), [(2e-3, 1.9e-3), (-2e-3, -1.9e-3), (9e-3, 3e-3), (1e-4, 0.0)])
def test_speed_of_a_free_load(command, opening):
    # Dead zone first, then saturation; v = H xv sqrt(Ps)/A, 0.412 m/s for 1.9 mm.
    model = servovalve(open_loop=True, stiffness=0.0)
    outputs = simulate(model, record_of(np.full(4000, command)))
    speed = np.diff(outputs["position"])[-1] / PERIOD
    assert speed == pytest.approx(FLOW_GAIN * opening * np.sqrt(SUPPLY) / AREA, rel=1e-9, abs=1e-15)
    np.testing.assert_allclose(outputs["load_pressure"][-1], 0.0, atol=1.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_closed_loop_rests_at_the_edge_of_the_dead_zone(sign):
    # u - Gc x = d: x = (3 mm - 0.1 mm)/0.09.
    outputs = simulate(servovalve(), record_of(np.full(4000, sign * 3e-3)))
    assert outputs["position"][-1] == pytest.approx(sign * 2.9e-3 / 0.09, rel=1e-9)
    assert outputs["spool"][-1] == pytest.approx(sign * 1e-4, rel=1e-9)


def test_the_load_stalls_where_the_spring_balances_the_supply():
    model = servovalve(open_loop=True, stiffness=1e6)
    outputs = simulate(model, record_of(np.full(4000, 2e-3)))
    assert outputs["position"][-1] == pytest.approx(AREA * SUPPLY / 1e6, abs=1e-6)
    assert outputs["load_pressure"][-1] == pytest.approx(SUPPLY, rel=1e-4)


def test_a_constant_load_force_adds_to_the_springs():
    def with_force(name, value, **context):
        return value + 250.0 if name == "load_force" else value

    outputs = simulate(
        servovalve(open_loop=True),
        record_of(np.zeros(200)),
        initial={"initial_position": 0.05},
        signal=with_force,
    )
    # 500 N of the spring and 250 N, over 25e-4 m^2, held by the closed valve.
    np.testing.assert_allclose(outputs["load_pressure"][1:], 3e5, rtol=1e-12)
    np.testing.assert_array_equal(outputs["position"], 0.05)


@pytest.mark.parametrize("damping_ratio", [0.4, 1.0, 1.6])
def test_the_spools_step_response(damping_ratio):
    time, omega, step = PERIOD * np.arange(4000), 300.0, 2e-3
    model = servovalve(open_loop=True)
    outputs = simulate(model, record_of(np.full(4000, step)), {"damping_ratio": damping_ratio})
    root = np.sqrt(complex(damping_ratio**2 - 1.0))
    slow, fast = omega * (-damping_ratio + root), omega * (-damping_ratio - root)
    if damping_ratio == 1.0:
        expected = 1.0 - (1.0 + omega * time) * np.exp(-omega * time)
    else:
        expected = 1.0 + (fast * np.exp(slow * time) - slow * np.exp(fast * time)) / (slow - fast)
    np.testing.assert_allclose(outputs["spool"], step * np.real(expected), atol=1e-14)


# --- What the position can tell: the readings' symmetries ---


def scaled(factor):
    return {
        "feedback_gain": 0.09 * factor,
        "dead_zone": 1e-4 * factor,
        "saturation": 3e-3 * factor,
        "flow_gain": FLOW_GAIN / factor,
    }


def test_in_the_forward_reading_four_parameters_scale_together():
    model, record = servovalve(transfer_function="forward"), record_of(staircase(1) / 0.09)
    nominal, doubled = simulate(model, record), simulate(model, record, scaled(2.0))
    # Powers of two lose no digit: the positions are the same to the last bit.
    np.testing.assert_array_equal(doubled["position"], nominal["position"])
    np.testing.assert_array_equal(doubled["spool"], 2.0 * nominal["spool"])
    np.testing.assert_allclose(simulate(model, record, scaled(1.3))["position"], nominal["position"], atol=1e-11)


@pytest.mark.parametrize("transfer_function", ["valve", "return"])
def test_the_other_readings_tell_the_four_parameters_apart(transfer_function):
    model, record = servovalve(transfer_function=transfer_function), record_of(staircase(1))
    assert worst(simulate(model, record, scaled(2.0))["position"], simulate(model, record)["position"]) > 1e-2


# --- Ill-chosen parameters ---


@pytest.mark.parametrize(
    "parameters",
    [
        {"natural_frequency": 3000.0},
        {"natural_frequency": 10.0, "damping_ratio": 0.01},
        {"natural_frequency": 3000.0, "damping_ratio": 7.2},
        {"flow_gain": 1.45e-3},
        {"flow_gain": 1e-12},
        {"saturation": 1e-9},
        {"dead_zone": 1e-2},
        {"feedback_gain": 0.9, "flow_gain": 1.45e-3},
        {"mass": 1e5},
        {"mass": 1e-2},
        {"stiffness": 1e9},
        {"leakage_coefficient": 1e-9},
    ],
)
def test_ill_chosen_parameters_stay_finite(parameters):
    outputs = simulate(servovalve(), record_of(staircase(1)), parameters)
    for name, output in outputs.items():
        assert np.isfinite(output).all(), name
    # No faster than at full stroke, twice over for a load that the spring drives back.
    fastest = 2.0 * parameters.get("flow_gain", FLOW_GAIN) * 3e-3 * np.sqrt(SUPPLY) / AREA
    assert np.abs(np.diff(outputs["position"])).max() <= fastest * PERIOD


def test_oil_as_soft_as_a_spring_stays_finite():
    outputs = simulate(servovalve(), record_of(staircase(1)), {"hydraulic_capacitance": 1e-9})
    for name, output in outputs.items():
        assert np.isfinite(output).all(), name


# --- Bad input ---


def test_an_unknown_place_of_the_transfer_function():
    with pytest.raises(
        ValueError, match="expected transfer_function to be 'valve', 'forward' or 'return', got 'spool': choose one"
    ):
        unchecked(servovalve)(transfer_function="spool")


def unchecked(function):
    """Return the function as users call it, without the type checks that the tests put around it."""
    return function.__wrapped__


@pytest.mark.parametrize("transfer_function", ["forward", "return"])
def test_an_open_loop_has_its_transfer_function_in_the_valve(transfer_function):
    with pytest.raises(ValueError, match=f"expected transfer_function='valve' in open loop, got '{transfer_function}'"):
        servovalve(open_loop=True, transfer_function=transfer_function)


@pytest.mark.parametrize(
    ("constant", "value", "sentence"),
    [
        ("mass", -20.0, r"expected mass to be positive \(kg\), got -20.0"),
        ("mass", 0.0, "expected mass to be positive"),
        ("piston_area", 0.0, r"expected piston_area to be positive \(m\^2\), got 0.0"),
        ("supply_pressure", float("nan"), "expected supply_pressure to be positive"),
        ("stiffness", -1.0, r"expected stiffness to be zero or more \(N/m\), got -1.0"),
        ("hydraulic_capacitance", -1e-13, "expected hydraulic_capacitance to be zero or more"),
        ("leakage_coefficient", -1e-13, "expected leakage_coefficient to be zero or more"),
    ],
)
def test_constants_that_cannot_be(constant, value, sentence):
    with pytest.raises(ValueError, match=sentence):
        servovalve(**{constant: value})


def test_constants_of_the_flow_force_that_cannot_be():
    with pytest.raises(ValueError, match="expected spool_stiffness to be positive"):
        servovalve(flow_force=True, spool_stiffness=0.0)
