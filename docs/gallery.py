"""Draws what every effect of the bank does to a step, to a sweep, and what a fit without it leaves of a record.

`python docs/gallery.py FOLDER` writes the pictures and their page there, as `make docs` does.
"""

import sys
from pathlib import Path
from typing import NamedTuple

import jax
import matplotlib.pyplot as plt
import numpy as np

import ehsvjax
from ehsvjax import effects, excitation
from ehsvjax.effects.internal import contexts_of

WITHOUT, WITH, LEFT = "0.55", "C0", "C3"
# Points of a curve that are drawn.
DRAWN = 500


class Bench(NamedTuple):
    """A model, and what is done to it.

    Attributes:
        model: the nominal one.
        signals: name -> inputs `[time]`: a step, a sweep, a record to fit.
        noise: standard deviation of the output's noise, in its unit.
        shown: (output, its name on an axis, its scale there).
        said: what it is, for the page.
        step_until: s of the step that are drawn.

    """

    model: ehsvjax.Model
    signals: dict[str, np.ndarray]
    period: float
    noise: float
    shown: tuple[str, str, float]
    said: str
    step_until: float


def signals_of(amplitude: float, hold_time: float, highest: float, duration: float, period: float) -> dict:
    """Return a step up and down, a sweep to the highest frequency (Hz), and held levels."""
    count = round(duration / period)
    step = np.zeros(count)
    step[count // 20 : count // 5] = 0.5 * amplitude
    usual = {"amplitude": amplitude, "duration": duration, "sample_period": period}
    sweep = excitation.chirp(start_frequency=highest / 20.0, stop_frequency=highest, method="logarithmic", **usual)
    levels = excitation.pseudo_random_signal(jax.random.key(4), hold_time=hold_time, **usual)
    return {"step": step, "sweep": sweep, "record": levels}


def tank() -> ehsvjax.Model:
    """Return a tank that a valve fills and empties: it has a displacement, and something stored."""

    def rates(parameters, state, inputs, signal):
        level, lift = state["level"], signal("lift", signal("command", inputs["command"]))
        filling = parameters["gain"] * lift - level / parameters["time_constant"]
        return {"level": signal("filling", filling, level=level)}

    return ehsvjax.Model(
        name="tank",
        parameters=(
            ehsvjax.Parameter("gain", "b", "1/s", 10.0, 1.0, 100.0, "log"),
            ehsvjax.Parameter("time_constant", "T", "s", 2.0, 0.2, 20.0, "log"),
        ),
        initial=(ehsvjax.Parameter("initial_level", "h(0)", "m", 0.0, -0.1, 0.1, output="level"),),
        signals=(
            ehsvjax.Signal("command", "input", "m"),
            ehsvjax.Signal("lift", "displacement", "m"),
            ehsvjax.Signal("filling", "storage", "m/s"),
            ehsvjax.Signal("level", "sensor", "m"),
        ),
        start=lambda parameters, initial, inputs: {"level": initial["initial_level"]},
        stepper=ehsvjax.runge_kutta_4(rates),
        measure=lambda parameters, state, inputs, signal: {"level": signal("level", state["level"])},
        max_step=0.025,
    )


def benches() -> tuple[Bench, ...]:
    """Return the models on which the effects are shown, each kind of signal at the first that has it."""
    return (
        Bench(ehsvjax.servovalve(), signals_of(6e-3, 0.1, 20.0, 2.0, 1e-3), 1e-3, 1e-4,
              ("position", "position, mm", 1e3), "the servovalve", 0.7),
        Bench(ehsvjax.van_der_pol(), signals_of(2.0, 1.0, 2.0, 40.0, 0.02), 0.02, 0.01,
              ("position", "position", 1.0), "the Van der Pol oscillator", 20.0),
        Bench(tank(), signals_of(0.01, 1.0, 2.0, 40.0, 0.05), 0.05, 1e-4,
              ("level", "level, mm", 1e3), "a tank that a valve fills", 16.0),
    )  # fmt: skip


# Sizes at which the effects are shown, SI, by the name of the effect, where it is needed with its kind.
SIZES: dict[str, dict[str, float]] = {
    "input_gain": {"error": 0.05},
    "input_bias": {"bias": 1e-4},
    "transport_delay": {"delay": 2e-3},
    "input_hold": {"share": 1.0},
    "band_limited_input": {"share": 1.0},
    "input_lag": {"time_constant": 2e-3},
    "input_dead_zone": {"half_width": 3e-4},
    "input_saturation": {"limit": 4e-3},
    "input_hysteresis": {"half_width": 1.5e-4},
    "sensor_gain": {"error": 0.02},
    "sensor_bias": {"bias": 1e-3},
    "sensor_asymmetry": {"error": 0.03},
    "sensor_drift": {"drift": 1e-3},
    "sensor_hum": {"cosine": 0.0, "sine": 5e-4, "frequency": 60.0},
    "sensor_cubic": {"coefficient": 10.0},
    "sensor_saturation": {"limit": 0.03},
    "sensor_lag": {"time_constant": 3e-3},
    "sensor_backlash": {"half_width": 5e-4},
    "structural_flexibility": {"compliance": 1e-7},
    "torque_motor_hysteresis": {"half_width": 1e-4},
    "feedback_backlash": {"half_width": 5e-4},
    "null_bias": {"bias": 1e-4},
    "asymmetric_dead_zone": {"asymmetry": 0.5},
    "spool_rate_limit": {"limit": 0.3},
    "null_leakage": {"ratio": 0.3},
    "flow_gain_rounding": {"width": 1e-4},
    "flow_gain_curvature": {"curvature": 0.2},
    "flow_gain_drift": {"drift": 0.1},
    "supply_droop": {"resistance": 1e9},
    "supply_pulsation": {"cosine": 0.0, "sine": 1e6, "frequency": 60.0},
    "return_pressure": {"pressure": 1e6},
    "area_asymmetry": {"asymmetry": 0.2},
    "area_ratio": {"error": -0.3},
    "cross_piston_leakage": {"coefficient": 2e-11},
    "oil_compressibility": {"capacitance": 3e-12},
    "constant_load": {"force": 3e3},
    "viscous_friction": {"coefficient": 5e3},
    "hardening_spring": {"coefficient": 1e8},
    "harmonic_load": {"cosine": 0.0, "sine": 2e3, "frequency": 60.0},
    "end_stop positive": {"positive_end": 0.02, "positive_stiffness": 1e7},
    "end_stop negative": {"negative_end": 0.02, "negative_stiffness": 1e7},
    "coulomb_friction friction": {"force": 3e3},
    "stribeck_friction friction": {"force": 3e3, "velocity": 0.05},
    "constant_force": {"force": 0.1},
    "coulomb_friction force": {"force": 0.1},
    "stribeck_friction force": {"force": 0.2, "velocity": 0.5},
    "elastic_friction": {"stiffness": 0.4, "length": 0.3, "softening": 0.0},
    "one_way_damping": {"coefficient": 0.1},
    "linear_damping": {"coefficient": 0.1},
    "quadratic_damping": {"coefficient": 0.05},
    "rayleigh_damping": {"coefficient": 0.02},
    "linear_stiffness": {"coefficient": 0.05},
    "quadratic_stiffness": {"coefficient": 0.05},
    "cubic_stiffness": {"coefficient": 0.02},
    "quintic_stiffness": {"coefficient": 0.01},
    "harmonic_force": {"cosine": 0.1, "sine": 0.0, "frequency": 2.5},
    "parametric_excitation": {"cosine": 0.1, "sine": 0.0, "frequency": 2.5},
    "asymmetric_damping": {"offset": 0.1},
    "damping_threshold": {"threshold": 1.1},
    "displacement_bias": {"bias": 5e-4},
    "displacement_gain": {"error": 0.1},
    "dead_zone": {"half_width": 1e-3},
    "backlash": {"half_width": 1e-3},
    "saturation": {"limit": 7e-3},
    "hard_limit positive": {"positive_limit": 0.05},
    "hard_limit negative": {"negative_limit": 0.05},
    "parameter_drift": {"drift": 0.2},
}

SAID = """
What a model may lack, one by one: what each effect of `ehsvjax.effects.BANK` does to a step and to a sweep, and what a
fit of the model without it leaves of a record of held levels. Blue is with the effect, grey without; red is the
difference, and of the record what the fit leaves. The grey band is two standard deviations of the noise: what stays
within it is not seen. An effect that a fit takes up into its parameters leaves little and bends them, which is worse.

`diagnose` tries all of them at every signal that takes them; besides these, every constant that may have been given
wrong, and an input that a sensor shows at once.
"""

# In the order of the page: what each kind of signal is.
KINDS = {
    "input": "At an input", "drive": "At the drive of the torque motor", "feedback": "At the feedback",
    "spool": "At the spool", "rate": "At the rate of the spool", "opening": "At the opening of the orifices",
    "supply": "At the supply pressure", "area": "At the piston's area", "area_ratio": "At the ratio of its areas",
    "leakage": "At the leakage", "capacitance": "At the hydraulic capacitance", "load": "At a load, which resists",
    "friction": "At a friction, the size of a force against the velocity", "force": "At a force, which drives",
    "damping": "At the oscillator's damping", "displacement": "At a displacement, any other length",
    "storage": "At what is stored", "parameter": "At a parameter, as time passes", "sensor": "At a sensor",
}  # fmt: skip


def title_of(effect: effects.Effect) -> str:
    """Return the name under which an effect is shown: with its kind, or its side, where the name alone would not do."""
    namesakes = [one for one in effects.BANK if one.name == effect.name]
    if len(namesakes) == 1:
        return effect.name
    if len({one.kind for one in namesakes}) > 1:
        return f"{effect.name} {effect.kind}"
    return f"{effect.name} {effect.parameters[0].name.partition('_')[0]}"


class Shown(NamedTuple):
    """One effect on its bench: outputs with and without it, and what a fit without it leaves and becomes."""

    candidate: effects.Candidate
    bench: Bench
    with_it: dict[str, np.ndarray]
    without: dict[str, np.ndarray]
    left: np.ndarray
    fit: ehsvjax.Fit


def everything(bench: Bench, bank) -> tuple[ehsvjax.Model, tuple[effects.Candidate, ...], dict[str, float]]:
    """Return the model with some effects attached, those, and the values with which none is there."""
    model, output = bench.model, bench.shown[0]
    found = effects.candidates(model, bank, contexts_of(model), (output,))
    # One place is enough to show what it does.
    once = {title_of(c.effect): c for c in found}
    candidates = tuple(c for c in found if once[title_of(c.effect)] is c)
    absent = {
        c.parameter(p.name): SIZES[title_of(c.effect)][p.name] if p.absent is None else p.absent
        for c in candidates for p in c.effect.parameters
    }  # fmt: skip
    numbers = {name: ehsvjax.Parameter(name, name, "", value, -1e31, 1e31) for name, value in absent.items()}
    duration = len(bench.signals["step"]) * bench.period
    return effects.extended(model, candidates, numbers, duration), candidates, absent


def shown_on(bench: Bench, bank) -> list[Shown]:
    """Return what effects do on a bench: one program simulates all of them, one identifies."""
    if not bank:
        return []
    full, candidates, absent = everything(bench, bank)
    output, (name,) = bench.shown[0], bench.model.inputs
    time = bench.period * np.arange(len(bench.signals["step"]))
    records = {what: ehsvjax.Record(time, {name: series}) for what, series in bench.signals.items()}
    noise = bench.noise * np.random.default_rng(0).standard_normal(len(time))

    def simulated(values):
        return {what: ehsvjax.simulate(full, record, values)[output] for what, record in records.items()}

    truth = {parameter: bench.model.nominal[parameter] for parameter in bench.model.free}
    without, found = simulated(absent), []
    for candidate in candidates:
        sizes = SIZES[title_of(candidate.effect)]
        with_it = simulated(absent | {candidate.parameter(number): value for number, value in sizes.items()})
        measured = ehsvjax.Record(time, records["record"].inputs, {output: with_it["record"] + noise})
        fit = ehsvjax.identify(bench.model, measured, key=jax.random.key(0), population=30, generations=10, start=truth)
        found.append(Shown(candidate, bench, with_it, without, fit.residuals(measured)[output], fit))
        print(".", end="", flush=True)
    return found


def draw(shown: Shown, folder: Path, name: str) -> None:
    """Write three pictures: the step, the sweep, what is left."""
    bench = shown.bench
    _, label, scale = bench.shown
    time = bench.period * np.arange(len(shown.left))
    for what in ("step", "sweep", "record"):
        figure, axes = plt.subplots(2, sharex=True, figsize=(3.6, 2.7), height_ratios=(3, 2))
        figure.subplots_adjust(0.17, 0.15, 0.97, 0.92, hspace=0.12)
        part = slice(0, round(bench.step_until / bench.period) if what == "step" else None)
        part = slice(0, part.stop, max(1, (part.stop or len(time)) // DRAWN))
        axes[0].plot(time[part], scale * shown.without[what][part], WITHOUT, lw=1.6)
        axes[0].plot(time[part], scale * shown.with_it[what][part], WITH, lw=1.0)
        axes[0].set_ylabel(label)
        if what == "record":
            axes[1].axhspan(-2 * scale * bench.noise, 2 * scale * bench.noise, color="0.88")
            axes[1].plot(time[part], scale * shown.left[part], LEFT, lw=0.7)
            axes[1].set_ylabel("left by a fit")
        else:
            axes[1].plot(time[part], scale * (shown.with_it[what] - shown.without[what])[part], LEFT, lw=1.0)
            axes[1].set_ylabel("difference")
        axes[0].set_title({"step": "a step", "sweep": "a sweep", "record": "a record, and what a fit leaves"}[what])
        axes[1].set_xlabel("time, s")
        figure.align_ylabels()
        figure.savefig(folder / f"{name}_{what}.svg")
        plt.close(figure)


def words(shown: Shown) -> list[str]:
    """Return the sentences of one effect."""
    candidate, bench, fit = shown.candidate, shown.bench, shown.fit
    effect, sizes = candidate.effect, SIZES[title_of(candidate.effect)]
    numbers = ", ".join(
        f"`{p.name}` {sizes[p.name]:g} {candidate.unit(p, bench.model)}".rstrip() for p in effect.parameters
    )
    scale, unit = bench.shown[2], bench.shown[1].partition(", ")[2]
    rms = float(np.sqrt(np.mean(shown.left**2)))
    left = f"{scale * rms:.2g} {unit}".strip() + f" rms, {rms / bench.noise:.2g} times the noise"
    left = "no more than the noise" if rms < 1.05 * bench.noise else left
    moved = {name: value / bench.model.nominal[name] - 1.0 for name, value in fit.parameters.items()}
    most = sorted((name for name in moved if abs(moved[name]) > 0.01), key=lambda name: -abs(moved[name]))[:3]
    bent = ", ".join(f"`{name}` {100 * moved[name]:+.0f}%" for name in most)
    bent = f"its parameters give way: {bent}" if bent else "no parameter gives way"
    return [
        f"{effect.says[0].upper()}{effect.says[1:]}.",
        "",
        f"- Shown at `{candidate.signal}` of {bench.said}: {numbers}.",
        f"- A fit without it leaves {left}; {bent}.",
        f"- What settles it: {effect.settled_by}.",
    ]  # fmt: skip


def page(every: list[Shown]) -> str:
    """Return the page, by kind of signal."""
    lines = [
        "# Gallery of effects",
        SAID,
    ]
    for kind, heading in KINDS.items():
        lines += [f"## {heading}", ""]
        for shown in (one for one in every if one.candidate.effect.kind == kind):
            title = title_of(shown.candidate.effect)
            name = title.replace(" ", "_")
            lines += [f"### {title}", "", *words(shown), "", "::::{container} strips"]
            for what in ("step", "sweep", "record"):
                lines += [f":::{{image}} {name}_{what}.svg", f":alt: {title}: {what}", ":loading: lazy", ":::"]
            lines += ["::::", ""]
    return "\n".join(lines)


def main(folder: Path) -> None:
    """Draw everything, and write the page."""
    folder.mkdir(parents=True, exist_ok=True)
    plt.rcParams.update({"font.size": 8, "axes.titlesize": 8, "svg.fonttype": "none", "axes.spines.top": False,
                         "axes.spines.right": False, "figure.facecolor": "white"})  # fmt: skip
    left, every = list(effects.BANK), []
    for bench in benches():
        kinds = {signal.kind for signal in bench.model.signals} | (
            {"parameter"} if "oscillator" in bench.said else set()
        )
        every += shown_on(bench, tuple(effect for effect in left if effect.kind in kinds))
        left = [effect for effect in left if effect.kind not in kinds]
    assert not left, [effect.name for effect in left]
    for shown in every:
        draw(shown, folder, title_of(shown.candidate.effect).replace(" ", "_"))
    (folder / "index.md").write_text(page(every))
    print(f" {len(every)} effects drawn")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
