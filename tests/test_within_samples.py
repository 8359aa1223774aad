"""What delays, lags and holds of an input do between its samples: against SciPy's linear systems in fine steps."""

import numpy as np
import pytest
from scipy.signal import lfilter, lsim

from ehsvjax import Model, Parameter, Record, Signal, runge_kutta_4, servovalve, simulate
from ehsvjax.effects import BANK, attach

# So quick that much happens within a sample: frequency times period is 0.7, as of a good valve at 1 kHz.
FREQUENCY, DAMPING, PERIOD, FINER = 14.0, 0.6, 0.05, 400


def _start(parameters, initial, inputs):
    del parameters, initial, inputs
    return {"x": 0.0, "v": 0.0}


def _rates(parameters, state, inputs, signal):
    pull = parameters["frequency"] ** 2 * (signal("push", inputs["push"]) - state["x"])
    return {"x": state["v"], "v": pull - 2.0 * DAMPING * parameters["frequency"] * state["v"]}


def _outputs(parameters, state, inputs, signal):
    del parameters, inputs
    return {"position": signal("position", state["x"])}


VALVE = Model(
    name="quick valve",
    parameters=(Parameter("frequency", "w", "rad/s", FREQUENCY, 5.0, 50.0),),
    initial=(),
    signals=(Signal("push", "input", ""), Signal("position", "sensor", "")),
    start=_start,
    stepper=runge_kutta_4(_rates),
    measure=_outputs,
    max_step=PERIOD / 8,
)
PUSH = np.random.default_rng(3).uniform(-1.0, 1.0, 200)


def drawn(push, hold):
    """Return the push at the beginning and at the end of every fine step."""
    fraction = np.arange(FINER) / FINER
    end = np.append(push[1:], push[-1]) if hold == "linear" else push
    start = (push[:, None] + (end - push)[:, None] * fraction).ravel()
    return start, start + np.repeat(end - push, FINER) / FINER


def response(begin, end):
    """Return the valve's position [time] at the samples, to the mean of an input in every fine step."""
    step = PERIOD / FINER
    system = [[0.0, 1.0], [-(FREQUENCY**2), -2.0 * DAMPING * FREQUENCY]], [[0.0], [FREQUENCY**2]], [[1.0, 0.0]], [[0.0]]
    time = step * np.arange(len(begin) + 1)
    held = lsim(system, np.append(0.5 * (begin + end), 0.0), time, interp=False)[1]
    return held[: len(begin) : FINER]


def delayed(begin, end, delay):
    late = round(delay / PERIOD * FINER)
    return tuple(np.concatenate([np.zeros(late), one])[: len(one)] for one in (begin, end))


def lagged(begin, end, time_constant):
    decay = np.exp(-PERIOD / FINER / time_constant)
    after = lfilter([1.0 - decay], [1.0, -decay], 0.5 * (begin + end))
    return np.append(0.0, after[:-1]), after


def off(effect, size, truth, hold):
    """Return by what share of it the model misses what an effect does to the true position."""
    bounds = {effect: (-1.0 if effect == "input_hold.share" else 0.0, 3.0)}
    record = Record(PERIOD * np.arange(len(PUSH)), {"push": PUSH}, hold=hold)
    found = simulate(attach(VALVE, bounds, duration=10.0, bank=BANK), record, {effect: size})["position"]
    moved = np.sqrt(np.mean((truth - response(*drawn(PUSH, hold))) ** 2))
    assert moved > 2e-3
    return np.sqrt(np.mean((found - truth) ** 2)) / moved


@pytest.mark.parametrize("hold", ["zero", "linear"])
@pytest.mark.parametrize(
    ("effect", "samples", "plant"),
    [
        *(("transport_delay.delay", samples, delayed) for samples in (0.08, 0.5, 2.3, 3.0)),
        *(("input_lag.time_constant", samples, lagged) for samples in (0.05, 0.3, 5.0, 40.0)),
    ],
)
def test_an_input_is_late_within_its_samples(effect, samples, plant, hold):
    truth = response(*plant(*drawn(PUSH, hold), samples * PERIOD))
    # By its mean in every sample alone a delay of 0.08 samples is wrong by half of what it does.
    assert off(effect, samples * PERIOD, truth, hold) < 0.005


@pytest.mark.parametrize(("declared", "share", "truth"), [("zero", 1.0, "linear"), ("linear", -1.0, "zero")])
def test_an_input_runs_otherwise_within_its_samples(declared, share, truth):
    assert off("input_hold.share", share, response(*drawn(PUSH, truth)), declared) < 0.005


@pytest.mark.parametrize("declared", ["zero", "linear"])
def test_an_input_keeps_to_a_band_within_its_samples(declared):
    frequencies, phases = np.random.default_rng(5).uniform([[0.02], [0.0]], [[0.65], [2.0]], (2, 12)) * np.pi

    def push(samples):
        return np.sin(samples[:, None] * frequencies + phases).sum(axis=1)

    fine = np.arange(200 * FINER + 1) / FINER
    truth = response(push(fine[:-1]), push(fine[1:]))
    record = Record(PERIOD * np.arange(200), {"push": push(np.arange(200.0))}, hold=declared)
    model = attach(VALVE, {"band_limited_input.share": (-1.0, 3.0)}, duration=10.0, bank=BANK)
    held, smooth = (simulate(model, record, {"band_limited_input.share": share})["position"] for share in (0.0, 1.0))
    # What comes before a record and after it is not known: its first samples and its last are not compared.
    inside = slice(40, -20)
    off_by, moved = (np.sqrt(np.mean((each - truth)[inside] ** 2)) / np.std(truth[inside]) for each in (smooth, held))
    assert moved > 0.02
    # As the smooth curve itself: right to 0.2 % up to 0.65 of half the sample rate.
    assert off_by < 0.002


@pytest.mark.parametrize("hold", ["zero", "linear"])
def test_a_servovalve_needs_no_finer_steps_for_a_delayed_command(hold):
    """Its step draws the command as a straight line: that line has the mean and the change of what the command does."""
    command = np.repeat(np.random.default_rng(4).uniform(-3e-3, 3e-3, 20), 50)
    record = Record(1e-3 * np.arange(len(command)), {"command": command}, hold=hold)
    valve = attach(servovalve(), {"transport_delay.delay": (0.0, 0.01)}, duration=1.0, bank=BANK)

    def error_of_a_step(delay):
        coarse, fine = (
            simulate(valve, record, {"transport_delay.delay": delay}, substeps=substeps)["position"]
            for substeps in (4, 64)
        )
        return np.sqrt(np.mean((coarse - fine) ** 2))

    assert error_of_a_step(2.37e-3) < 2.0 * error_of_a_step(0.0)
