"""A real servovalve in open loop, where its records are at hand: fit one run, predict another and other voltages."""

import os
from pathlib import Path

import jax
import numpy as np
import pytest

import ehsvjax

FOLDER = Path(os.environ.get("EHSVJAX_DATA", Path(__file__).parents[2] / "shared" / "data")) / "festo"
pytestmark = pytest.mark.skipif(not FOLDER.exists(), reason="the measured records are not at hand")

SETTINGS = {
    "population": 20,
    "generations": 10,
    "starts": 1,
    "huber": 1.345,
    "bounds": {"flow_gain": (5e-6, 5e-4), "damping_ratio": (0.3, 3.0), "natural_frequency": (10.0, 1000.0)},
    "fixed": {"dead_zone": 0.0, "saturation": 1e-3},
    "initial": {"initial_filtered": 0.0, "initial_filtered_rate": 0.0},
}


def _read(name, offset=0.0):
    """A run as measured, 1 V as 0.1 mm of the valve's stroke and 20 mm of the piston's."""
    return ehsvjax.Record.from_csv(
        FOLDER / f"{name}.csv",
        time="t_s",
        inputs={"command": ehsvjax.Column("valve_cmd_V", scale=1e-4)},
        outputs={"position": ehsvjax.Column("position_raw_V", scale=0.02, offset=offset)},
    )


def _valve():
    """The valve and its cylinder, of one area: the mean of the two that its rod leaves."""
    piston, rod = np.pi / 4 * 0.016**2, np.pi / 4 * 0.010**2
    return ehsvjax.servovalve(
        open_loop=True, piston_area=piston - rod / 2, supply_pressure=4.35e6, mass=1.0, stiffness=0.0
    )


def _stroke_out(name):
    """The stroke out from rest until the piston is about to meet the end of the sensor."""
    record = _read(name)
    return record.slice(0.0, record.time[np.flatnonzero(record.outputs["position"] > 0.195)[0]])


def test_one_run_predicts_a_repeat_and_other_voltages():
    model = _valve()
    fit = ehsvjax.identify(model, _stroke_out("pA_3V_s01"), key=jax.random.key(0), **SETTINGS)
    assert fit.fit_percent["position"] > 97.0
    # The stroke takes 0.155 m/s at 3 V, as a straight line through the measured positions shows.
    slope = fit.parameters["flow_gain"] * 3e-4 * np.sqrt(4.35e6) / model.nominal["piston_area"]
    assert slope == pytest.approx(0.155, rel=0.03)
    for name, least in (("pA_3V_s02", 96.0), ("pA_2V_s01", 94.0), ("pA_4V_s01", 94.0)):
        assert fit.score(_stroke_out(name)).fit_percent["position"] > least, name


STOPS = {
    "end_stop.positive_end": (0.194, 0.22),
    "end_stop.positive_stiffness": (1e6, 3e7),
    "end_stop.negative_end": (0.0, 0.01),
    "end_stop.negative_stiffness": (1e6, 3e7),
}


def _out_and_back(name):
    """A run from stop to stop without most of the time that it waits there; nothing is measured at the upper one."""
    record = _read(name, offset=-0.0055)
    command, position = record.inputs["command"], record.outputs["position"]
    position = np.where(position > 0.194, np.nan, position)

    def mostly(so):
        return np.convolve(so, np.ones(31), "same") > 15

    arrives, leaves = np.flatnonzero(mostly(np.isnan(position)))[[0, -1]]
    position[arrives:leaves] = np.nan
    turned = np.flatnonzero(command < 0)[0]
    back = leaves + np.flatnonzero(mostly(position < 0.003)[leaves:])[0]
    kept = np.r_[: arrives + 100, turned - 150 : back + 200]
    return ehsvjax.Record(np.arange(len(kept)) * 1e-3, {"command": command[kept]}, {"position": position[kept]})


@pytest.mark.thorough
def test_of_one_run_out_and_back_two_areas_or_a_load_are_in_the_answer_and_other_voltages_are_predicted():
    """A rod makes the areas two; any bias, with a dead zone beside it, explains one voltage and predicts no other."""
    one_run = _out_and_back("pA_3V_s01")
    stopped = ehsvjax.effects.attach(_valve(), STOPS, duration=one_run.time[-1], bank=ehsvjax.effects.BANK)
    hardness = {name: 1e7 for name in STOPS if name.endswith("stiffness")}
    settings = SETTINGS | {
        "population": 40,
        "generations": 20,
        "starts": 2,
        "fixed": SETTINGS["fixed"] | hardness,
        "initial": SETTINGS["initial"] | {"initial_position": 0.0},
    }
    fit = ehsvjax.identify(stopped, one_run, key=jax.random.key(0), **settings)
    found = ehsvjax.diagnose(fit, one_run, key=jax.random.key(1))
    groups = [set(group.causes) for group in found.alternatives] + [{name} for name in found.names]
    (areas,) = (group for group in groups if {"area_asymmetry", "constant_load"} & group)
    assert areas <= {"area_asymmetry", "area_ratio", "constant_load"}, str(found)
    for name, least in (("pA_2V_s01", 94.0), ("pA_4V_s01", 95.0)):
        assert found.extended.score(_out_and_back(name)).fit_percent["position"] > least, str(found)
