import math
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

import ehsvjax
from ehsvjax.precision.residual_noise import ResidualNoise
from ehsvjax.precision.standard_errors import _worth
from ehsvjax.summary import percent_of_fit, summary, summary_html
from tests import hand_made

# rmse: three errors of 0.1. fit: 100*(1 - sqrt(0.03/18.96)), 18.96 = 2.6^2 + 0.8^2 + 3.4^2 about the mean 5.2.
# cost: 0.03 N^2 times the period of 0.5 s. standard error: 0.03 N^2 over 3 - 1 degrees of freedom, over 1 + 4 + 16 V^2.
SUMMARY = """\
[[Model]]
    name     amplifier
    signals  command -> force, strain
    options  coupling='dc'
[[Record]]
    name     samples  missing     period  duration
    bench 7  4        1 of force  0.5 s   1.5 s
[[Fit statistics]]
    method              genetic algorithm, 10 individuals x 3 generations = 30 simulations
    refinement          7 steps by gradient, converged; 3 of 4 starts led to this minimum
    samples             3 measured
    unknowns            1 parameter
    cost, equation (9)  0.015 N^2 s
[[Outputs]]
    output  rmse    fit      noise standard deviation
    force   100 mN  96.02 %  100 mN
[[Parameters]]
    name         symbol  value  standard error      unit  bounds
    gain         k       2      +/- 0.0267 (1.34%)  N/V   0.5 .. 5
    temperature  T       293                        K     (fixed)
[[Noise that the errors count on]]
    white, of the residuals' variance: the residuals are too few to tell
[[Initial conditions]]
    name          symbol  value  unit
    initial_load  F(0)    0.5    N
[[Warnings]]
    none"""


class Page(HTMLParser):
    """Collects tags, attributes and the texts of cells and titles."""

    def __init__(self, page):
        super().__init__()
        self.tags, self.attributes, self.texts = [], [], []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [name for name, _ in attrs]

    def handle_data(self, data):
        self.texts.append(data)


def test_errors_that_linear_theory_hardly_covers_are_said():
    precision = hand_made.fit().precision()
    assert "linear theory" not in str(precision)
    wide = replace(precision, standard_errors={"gain": 0.11 * precision.values["gain"]})
    assert "linear theory: fit.profile_likelihood() for gain" in str(wide)


def test_text_is_what_a_pencil_gives():
    assert summary(hand_made.fit()) == SUMMARY


def test_a_fit_prints_its_summary():
    fit = hand_made.fit()
    assert str(fit) == repr(fit) == SUMMARY
    assert fit._repr_html_() == summary_html(fit)


def test_several_outputs_are_listed_and_their_costs_weighed():
    # Force: 0.03*0.5/0.01; strain: four errors of 1e-4, 4e-8*0.5/1e-8.
    text = summary(hand_made.fit(hand_made.record_of_both()))
    assert "3.5 s (each output over its noise variance)" in text
    assert "    force   100 mN      96.02 %  100 mN\n" in text
    assert "    strain  0.0001 m/m  95.53 %  0.0001 m/m\n" in text


@pytest.mark.parametrize(("unit", "shown"), [("N", "N^2 s"), ("", "s"), ("m/m", "(m/m)^2 s")])
def test_cost_carries_its_unit(unit, shown):
    model = hand_made.amplifier()
    signals = tuple(s._replace(unit=unit) if s.name == "force" else s for s in model.signals)
    text = summary(hand_made.fit(model=replace(model, signals=signals)))
    assert f"    cost, equation (9)  0.015 {shown}\n" in text


def test_each_record_has_its_own_initial_conditions():
    records = hand_made.record("first"), hand_made.record("second")
    fit = hand_made.fit(*records, initial=({"initial_load": 0.25}, {"initial_load": 0.75}))
    text = summary(fit)
    assert "[[Records]]" in text
    assert "    name          symbol  first  second  unit\n    initial_load  F(0)    0.25   0.75    N\n" in text
    assert "    samples             6 measured\n" in text
    estimated = summary(replace(fit, estimated_initial=("initial_load",)))
    assert "    unknowns            1 parameter, 1 initial condition of each of 2 records\n" in estimated


def test_effort_is_told_as_it_was():
    fit = hand_made.fit()
    effort = fit.effort._replace(refined=False, stopped_early=True)
    text = summary(replace(fit, effort=effort, huber=1.345))
    assert "10 individuals x 3 generations = 30 simulations; ended by its stop test\n" in text
    assert "    refinement          none\n" in text
    assert "    residuals           weighed linearly beyond 1.345 standard deviations (Huber)\n" in text
    unconverged = summary(replace(fit, effort=fit.effort._replace(converged=False)))
    assert "7 steps by gradient, not converged; 3 of 4" in unconverged


@pytest.mark.parametrize(
    ("effort", "words"),
    [
        ({"step_size": 2.5e-4, "arithmetic": 0.0096, "left_out": 53},
         "steps of 250 µs; worth 0.0096 noise variances; 53 readings that it cannot know left out"),
        ({"step_size": 0.02, "arithmetic": 3e-9}, "steps of 20 ms; worth less than 0.001 noise variances"),
        ({"step_size": 7.8125e-7, "arithmetic": 312.4, "left_out": 1},
         "steps of 781 ns; worth 3.1e+02 noise variances; 1 reading that it cannot know left out"),
        ({"step_size": 1.0, "arithmetic": math.inf},
         "steps of 1 s; worth more than can be said, half a step is not finite"),
        ({"step_size": 5e-6}, "steps of 5 µs"),
    ],
)  # fmt: skip
def test_the_step_of_the_integration_and_what_it_is_worth_are_said(effort, words):
    fit = hand_made.fit()
    text = summary(replace(fit, effort=fit.effort._replace(**effort)))
    assert f"    integration         {words}\n" in text


def test_a_fit_that_a_diagnosis_extended_was_not_searched_for():
    fit = hand_made.fit()
    effort = fit.effort._replace(population=0, generations=0, simulations=0, iterations=0, starts=1, starts_agreeing=1)
    text = summary(replace(fit, effort=effort))
    assert (
        "    method              refitted by a diagnosis, from the fit that it extends: by gradient, converged\n"
        in text
    )
    assert not any(words in text for words in ("genetic", "individuals", "refinement", "0 steps", "starts led"))


def test_warnings_stand_one_below_the_other():
    text = summary(hand_made.fit(warnings=("gain is at its upper bound", "not refined")))
    assert text.endswith("[[Warnings]]\n    gain is at its upper bound\n    not refined")


def test_html_tells_the_same_as_the_text():
    fit = hand_made.fit(hand_made.record_of_both())
    text = summary(fit)
    texts = Page(summary_html(fit)).texts
    assert all(part in text for part in texts)
    assert "".join("".join(texts).split()) == "".join(text.replace("[[", "").replace("]]", "").split())


def test_html_escapes_what_users_write():
    hostile = '<script>alert("1")</script>&amp;'
    model = hand_made.amplifier()
    parameters = (model.parameters[0]._replace(symbol="<b>k</b>", unit="<i>"), *model.parameters[1:])
    fit = hand_made.fit(
        hand_made.record(hostile), model=replace(model, parameters=parameters, name="<h1>"), warnings=("a < b",)
    )
    page = Page(summary_html(fit))
    assert set(page.tags) <= {"div", "p", "b", "table", "tr", "th", "td"}
    assert set(page.attributes) <= {"style"}
    assert {hostile, "<b>k</b>", "<i>", "<h1>", "a < b"} <= set(page.texts)


def test_a_model_that_explains_nothing_has_its_warnings_first():
    text = summary(hand_made.fit(warnings=("the model explains nothing of force: fit -3 %", "not refined")))
    assert text.startswith(
        "[[Warnings]]\n    the model explains nothing of force: fit -3 %\n    not refined\n[[Model]]"
    )
    assert text.count("[[Warnings]]") == 1


@pytest.mark.parametrize(
    ("percent", "shown"),
    [(96.024, "96.02 %"), (-73.0, "-73.00 %"), (-1.2e9, "below -1000 %"), (-math.inf, "not finite")],
)
def test_a_fit_is_said_in_numbers_that_can_be_meant(percent, shown):
    assert percent_of_fit(percent) == shown


def test_errors_beyond_measure_are_said_to_be():
    precision = replace(hand_made.fit().precision(), standard_errors={"gain": 1e9})
    assert "(over 1000%)" in str(precision)


def test_a_name_with_a_new_line_stays_in_its_row():
    text = summary(hand_made.fit(hand_made.record("bench\n7 $x_1$")))
    assert "    bench 7 $x_1$  4 " in text


def _noise(coefficients, variance=1.0):
    coefficients = np.array(coefficients)
    # Of an autoregression of first order.
    return ResidualNoise(0.0, coefficients, variance, variance * (1.0 - float(np.sum(coefficients**2))))


@pytest.mark.parametrize(
    ("coefficient", "words"),
    [
        (0.9, "19 samples (190 ms) tell as much as one"),
        (-0.9, "whose swings cancel: of a constant one sample tells as much as 19 with white noise"),
        (0.9999, "which all 500 samples together do not average out"),
    ],
)
def test_what_samples_tell_under_coloured_noise_is_a_number_that_can_be_meant(coefficient, words):
    assert _worth(_noise([coefficient]), 0.01, 500) == words


def test_a_model_is_printed_as_tables():
    text = str(ehsvjax.servovalve(open_loop=True))
    rows = [line.split() for line in text.splitlines()]
    assert ["signals", "command", "->", "position,", "spool,", "load_pressure"] in rows
    assert ["dead_zone", "d", "0.0001", "m", "5e-05", "..", "0.00015"] in rows
    assert ["mass", "M", "20", "kg", "(fixed)"] in rows
    assert ["initial_position", "x(0)", "0", "m", "-0.2", "..", "0.2"] in rows
    assert ["load_friction", "friction", "N"] in rows
    assert max(map(len, text.splitlines())) < 100


def test_a_model_is_shown_as_tables_whose_names_are_escaped():
    html = replace(ehsvjax.van_der_pol(), name="<oscillator>")._repr_html_()
    assert html.count("<table") == 4 and "&lt;oscillator&gt;" in html and "<oscillator>" not in html
