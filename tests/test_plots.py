import math
from dataclasses import replace

import jax
import matplotlib.pyplot
import numpy as np
import pytest
from matplotlib.colors import to_hex

from ehsvjax.drawing import to_png
from ehsvjax.plots import plot_fit, plot_identification, plot_pressure_flow, quantity
from tests import hand_made

TRUE_FORCE = np.array([2.4, 4.4, 6.4, 8.4])


def lines(axes):
    """Label -> y values of the lines that have a label."""
    return {line.get_label(): line.get_ydata() for line in axes.lines if not line.get_label().startswith("_")}


def test_fit_shows_each_output_its_residual_and_the_search():
    figure = hand_made.fit(hand_made.record_of_both()).plot()
    force, force_residual, strain, strain_residual, search = figure.axes
    np.testing.assert_allclose(lines(force)["measured (1 missing)"], [2.6, 4.4, np.nan, 8.6])
    np.testing.assert_allclose(lines(force)["model"], [2.5, 4.5, 6.5, 8.5])
    np.testing.assert_allclose(lines(force_residual)["measured − model"], [100, -100, np.nan, 100])  # mN
    np.testing.assert_allclose(lines(strain)["model"], [2.5e-3, 4.5e-3, 6.5e-3, 8.5e-3])
    np.testing.assert_allclose(lines(strain_residual)["measured − model"], 1e-4)
    np.testing.assert_array_equal(lines(search)["best so far"], [50.0, 9.0, 3.1])
    np.testing.assert_array_equal(lines(search)["median of the generation"], [np.nan, 80.0, 12.0])
    assert search.get_yscale() == "log"
    assert force.get_title(loc="left") == "fit 96.02 %, rmse 100 mN"


def test_every_axis_of_a_fit_says_its_unit():
    figure = hand_made.fit(hand_made.record_of_both()).plot()
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert labels == ["force\n(N)", "residual\n(mN)", "strain\n(m/m)", "residual\n(m/m)", "cost\n(noise variances)"]
    assert [axes.get_xlabel() for axes in figure.axes] == ["", "", "", "time (s)", "generation"]


def test_a_fit_draws_its_first_record_by_default():
    assert hand_made.fit(hand_made.record("bench 7")).plot().get_suptitle() == "amplifier: bench 7"


def test_a_record_without_output_is_refused():
    with pytest.raises(ValueError, match="expected bench 7 to hold an output to draw, got none"):
        plot_fit(hand_made.fit(), replace(hand_made.record(), outputs={}))


def test_identification_puts_fits_side_by_side():
    fits = [hand_made.fit(hand_made.record(name)) for name in ("quiet", "noisy")]
    figure = plot_identification(fits, [{"force": TRUE_FORCE}, {}])
    assert len(figure.axes) == 6
    command, output, error = figure.axes[::2]  # those of the first of two columns
    np.testing.assert_allclose(command.lines[0].get_ydata(), [1.0, 2.0, 3.0, 4.0])
    assert command.lines[0].get_drawstyle() == "steps-post"
    np.testing.assert_allclose(lines(output)["noise-free"], TRUE_FORCE)
    # In mN, as the residual is.
    np.testing.assert_allclose(lines(error)["noise-free − model"], -100.0)
    assert command.get_title(loc="left") == "quiet"
    assert [axes.get_ylabel() for axes in (command, output, error)] == ["command\n(V)", "force\n(N)", "residual\n(mN)"]
    assert sum("noise-free" in lines(axes) for axes in figure.axes) == 1


def test_identification_draws_what_the_first_record_holds():
    both = hand_made.record_of_both()
    fit = hand_made.fit(replace(both, outputs={"strain": both.outputs["strain"]}), hand_made.record())
    assert plot_identification(fit).axes[1].get_ylabel() == "strain\n(m/m)"


def test_identification_takes_one_fit_and_its_truth_as_they_are():
    figure = plot_identification(hand_made.fit(), {"force": TRUE_FORCE})
    assert len(figure.axes) == 3


def test_inputs_drawn_as_they_run_between_samples():
    ramp = replace(hand_made.record(), hold="linear")
    assert plot_identification(hand_made.fit(ramp)).axes[0].lines[0].get_drawstyle() == "default"


def test_identification_wants_a_truth_for_each_fit():
    with pytest.raises(ValueError, match="expected noise_free for each of 2 fits, got 1"):
        plot_identification([hand_made.fit(), hand_made.fit()], [{"force": TRUE_FORCE}])


def test_pressure_flow_curves_pass_the_points_of_the_square_root():
    axes = plot_pressure_flow().axes[0]
    curves = [line for line in axes.lines if len(line.get_xdata()) > 2]
    assert len(curves) == 10
    by_opening = {}
    for curve in curves:
        pressure, flow = curve.get_xdata(), curve.get_ydata()
        middle = np.interp(0.0, pressure, flow)
        by_opening[round(middle, 6)] = flow[0] if middle > 0 else flow[-1], flow[-1] if middle > 0 else flow[0]
    assert sorted(by_opening) == [-1.0, -0.8, -0.6, -0.4, -0.2, 0.2, 0.4, 0.6, 0.8, 1.0]
    for opening, (helped, stalled) in by_opening.items():
        assert helped == pytest.approx(opening * math.sqrt(2), rel=1e-5)
        assert stalled == pytest.approx(0.0, abs=1e-3)


def test_model_and_measurement_keep_their_colours():
    fit = hand_made.fit()
    colours = [
        {line.get_label().split()[0]: to_hex(line.get_color()) for line in figure.axes[i].lines}
        for figure, i in ((plot_fit(fit, fit.records[0]), 0), (plot_identification(fit), 1))
    ]
    assert colours[0] == colours[1]
    assert len(set(colours[0].values())) == 2


def test_no_global_state_is_left():
    before = dict(matplotlib.rcParams), matplotlib.get_backend()
    fit = hand_made.fit()
    for figure in (plot_fit(fit, fit.records[0]), plot_identification(fit), plot_pressure_flow()):
        assert to_png(figure, 30.0).startswith(b"\x89PNG")
    assert (dict(matplotlib.rcParams), matplotlib.get_backend()) == before
    assert matplotlib.pyplot.get_fignums() == []


def test_notebooks_find_a_picture_in_the_figure():
    assert plot_pressure_flow()._repr_png_() == to_png(plot_pressure_flow())


@pytest.mark.parametrize(
    ("value", "unit", "shown"),
    [
        (3.15e-3, "m", "3.15 mm"),
        (0.99996, "m", "1 m"),
        (14e6, "Pa", "14 MPa"),
        (4.2e-11, "m", "0.042 nm"),
        (0.0, "N", "0 N"),
        (2.5e-3, "rad/s", "0.0025 rad/s"),
        (0.25, "", "0.25"),
    ],
)
def test_quantities_take_the_prefix_that_reads_best(value, unit, shown):
    assert quantity(value, unit) == shown


_HOSTILE = r"a_b $x^{ <b>&\frac{1}{ \n$$$"


def _with_hostile_names():
    """Return a fit whose every name and unit a formula or a tag could be read into, and its record's a new line."""
    model = hand_made.amplifier()
    record = hand_made.record(f"{_HOSTILE}\n{_HOSTILE}")

    def renamed(part):
        return part._replace(name=f"{part.name} {_HOSTILE}", unit=f"{part.unit}$_{{<")

    def measure(parameters, state, inputs, signal):
        plain = {name.split()[0]: value for name, value in parameters.items()}
        given = {name.split()[0]: value for name, value in inputs.items()}
        outputs = model.measure(plain, state, given, lambda name, value: signal(f"{name} {_HOSTILE}", value))
        return {f"{name} {_HOSTILE}": value for name, value in outputs.items()}

    def start(parameters, initial, inputs):
        return model.start(parameters, {name.split()[0]: value for name, value in initial.items()}, inputs)

    hostile = replace(
        model,
        name=_HOSTILE,
        parameters=tuple(renamed(p)._replace(symbol=_HOSTILE) for p in model.parameters),
        initial=tuple(renamed(p) for p in model.initial),
        signals=tuple(renamed(s) for s in model.signals),
        start=start,
        measure=measure,
    )
    force = f"force {_HOSTILE}"
    record = replace(
        record,
        inputs={f"command {_HOSTILE}": record.inputs["command"]},
        outputs={force: np.append(record.outputs["force"][:3], 8.6)},
    )
    return hand_made.fit(
        record,
        model=hostile,
        parameters={f"gain {_HOSTILE}": 2.0},
        initial=({f"initial_load {_HOSTILE}": 0.5},),
        noise_variance={force: 0.01},
        history=hand_made.fit().history._replace(best={f"gain {_HOSTILE}": np.array([3.0, 2.2, 2.1])}),
    )


def test_any_name_is_drawn_letter_by_letter():
    fit = _with_hostile_names()
    figures = {
        "fit": fit.plot(),
        "identification": plot_identification(fit, {fit.outputs[0]: TRUE_FORCE}),
        "profiles": fit.profile_likelihood().plot(),
        "precision": fit.precision().plot(),
        "bootstrap": fit.bootstrap(jax.random.key(0), draws=4).plot(fit.profile_likelihood()),
    }
    for name, figure in figures.items():
        assert to_png(figure, 30.0).startswith(b"\x89PNG"), name
    drawn = figures["fit"].get_suptitle()
    assert "\n" not in drawn and drawn.count("$") == drawn.count(r"\$") == 3 * _HOSTILE.count("$")


def test_any_name_is_printed_on_its_line():
    fit = _with_hostile_names()
    text = str(fit)
    assert all(line.startswith(("[[", "    ")) for line in text.splitlines())
    assert "&lt;b&gt;" in fit._repr_html_()
    assert str(fit.profile_likelihood()).count("\n") == 1
    assert str(fit.bootstrap(jax.random.key(0), draws=4)).count("\n") == 1


def test_a_history_that_failed_at_first_is_drawn():
    history = hand_made.fit().history._replace(best_cost=np.array([np.inf, 9.0, 3.1]))
    assert to_png(hand_made.fit(history=history).plot(), 30.0).startswith(b"\x89PNG")


def test_a_fit_that_was_not_searched_for_has_no_empty_panel():
    none = np.zeros(0)
    searched = hand_made.fit()
    fit = hand_made.fit(
        history=searched.history._replace(**dict.fromkeys(searched.history._fields[:-1], none), best={})
    )
    titles = [[axes.get_title(loc="left") for axes in one.plot().axes] for one in (searched, fit)]
    assert titles[0] == [*titles[1], "genetic search"]
    assert to_png(fit.plot(), 30.0).startswith(b"\x89PNG")
