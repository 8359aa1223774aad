"""The public face as a typed program would use it: read by the type checker in its strict mode, never run."""

from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.figure
import numpy as np
import pandas as pd
from scipy.signal import StateSpace

import ehsvjax
from ehsvjax.effects import BANK, attach, effects_of


def records(folder: Path) -> list[ehsvjax.Record]:
    """Read and prepare records."""
    read = ehsvjax.Record.from_csv(
        folder / "valve.csv",
        time="t_s",
        inputs={"command": ehsvjax.Column("command_V", scale=0.6e-3)},
        outputs={"position": ehsvjax.Column("position_V", scale=0.02)},
    )
    level = ehsvjax.excitation.pseudo_random_signal(
        jax.random.key(0), amplitude=1e-3, hold_time=0.1, duration=1.0, sample_period=1e-3
    )
    made = ehsvjax.Record(1e-3 * np.arange(len(level)), {"command": level}, hold="zero", name="made")
    made.to_csv(folder / "command.csv")
    checked: str = str(read.check(ehsvjax.servovalve()))
    drawn: matplotlib.figure.Figure = read.plot()
    del checked, drawn
    return [read.at(supply_pressure=70e5).within(position=(-0.1, 0.1)).slice(0.0, 1.0), made]


def fitted(some: list[ehsvjax.Record]) -> ehsvjax.Fit:
    """Identify and look at what came."""
    model = ehsvjax.servovalve(piston_area=25e-4).with_bounds({"flow_gain": (1e-5, 1e-3)})
    fit = ehsvjax.identify(
        model, some, key=jax.random.key(0), start={"flow_gain": 1e-4}, operators=ehsvjax.Operators(), progress=False
    )
    precision: ehsvjax.Precision = fit.precision()
    profiles: ehsvjax.ProfileLikelihood = fit.profile_likelihood()
    draws: ehsvjax.Bootstrap = fit.bootstrap(jax.random.key(1))
    bands: dict[str, ehsvjax.Band] = fit.bands(some[0])
    figures: list[matplotlib.figure.Figure] = [
        fit.plot(), fit.plot_residuals(), precision.plot(), profiles.plot(), draws.plot(profiles),
        ehsvjax.compare([fit], some).plot(),
    ]  # fmt: skip
    table: pd.DataFrame = fit.table
    series: pd.DataFrame = fit.to_dataframe(some[0])
    simulated: np.ndarray = fit.simulate(some[0])["position"]
    linear = fit.linearise({"command": 2e-3})
    system: StateSpace = linear.system
    bound: dict[str, float] = ehsvjax.cramer_rao_bound(model, some, noise_variance={"position": 1e-8})
    planned: ehsvjax.Precision = ehsvjax.design(model, some, noise_variance={"position": 1e-8})
    fit.save("fit.npz")
    del bands, figures, table, series, simulated, system, bound, planned
    return ehsvjax.Fit.load("fit.npz")


def diagnosed(fit: ehsvjax.Fit, some: list[ehsvjax.Record]) -> ehsvjax.Record:
    """Find what is wrong, and what to do next."""
    diagnosis: ehsvjax.Diagnosis = ehsvjax.diagnose(fit, some, key=jax.random.key(2), bank=BANK)
    figure: matplotlib.figure.Figure = diagnosis.plot()
    diagnosis.report("diagnosis.html")
    better: ehsvjax.Fit | None = diagnosis.extended
    for cause in diagnosis.causes:
        name: str = cause.name
        probability: float = cause.probability
        del name, probability
    limits = ehsvjax.Limits(command=(-8e-3, 8e-3), position=(-0.1, 0.1), duration=5.0)
    plan: ehsvjax.Plan = diagnosis.next_experiment(
        limits, key=jax.random.key(3), can_change={"supply_pressure": (70e5, 210e5)}
    )
    drawn: matplotlib.figure.Figure = plan.plot()
    diagnosis.save("diagnosis.npz")
    del figure, better, drawn
    return plan.record


def of_my_own() -> ehsvjax.Model:
    """Write a model and an effect."""

    def rate(
        parameters: dict[str, jax.Array], state: dict[str, jax.Array], inputs: dict[str, jax.Array], signal: object
    ) -> dict[str, jax.Array]:
        del signal
        return {"level": inputs["push"] - parameters["leak"] * jnp.sqrt(state["level"])}

    model = ehsvjax.Model(
        name="tank",
        parameters=(ehsvjax.Parameter("leak", "k", "1/s", 1.0, 0.1, 10.0, "log"),),
        initial=(),
        signals=(ehsvjax.Signal("push", "input", "1/s"), ehsvjax.Signal("level", "sensor", "m")),
        start=lambda parameters, initial, inputs: {"level": 1.0},
        stepper=ehsvjax.runge_kutta_4(rate),
        measure=lambda parameters, state, inputs, signal: {"level": signal("level", state["level"])},
        max_step=0.1,
    )
    extended: ehsvjax.Model = attach(model, {"sensor_bias.bias": (-1.0, 1.0)}, duration=1.0, bank=BANK)
    assert effects_of(extended) == ("sensor_bias",)
    return extended.with_ties({"leak": lambda parameters: 2.0 * parameters["leak"]})
