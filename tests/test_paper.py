import math
import re
from dataclasses import replace

import jax
import numpy as np
import pandas as pd
import pytest

import ehsvjax
from ehsvjax import __main__ as demo
from ehsvjax import paper, report
from tests import hand_made, plants


def identified(experiment, variance, found, by_search=None):
    """Return an identification as if it had been made: the truth of its record, and parameters as given."""
    model, record = {
        "oscillator": (ehsvjax.van_der_pol(), paper.van_der_pol_record),
        "valve": (ehsvjax.servovalve(), paper.servovalve_record),
    }[experiment]
    key = jax.random.key(3)
    fit = hand_made.fit(
        record(key, variance),
        model=model,
        parameters=found,
        initial=({p.name: 0.0 for p in model.initial},),
        noise_variance={"position": variance},
    )
    best = {name: np.array([0.0, value]) for name, value in (by_search or found).items()}
    bound = {name: 0.01 * abs(value) for name, value in found.items()}
    return paper.Identification(
        replace(fit, history=fit.history._replace(best=best)), variance, record(key, 0.0), bound
    )


@pytest.fixture(scope="module")
def oscillator():
    return [identified("oscillator", variance, paper.VAN_DER_POL_TRUTH) for variance in paper.PAPER_TABLE_1]


@pytest.fixture(scope="module")
def valve():
    return [identified("valve", variance, paper.SERVOVALVE_TRUTH) for variance in paper.PAPER_TABLE_2]


def test_records_come_from_the_paper_equations():
    record = paper.van_der_pol_record(jax.random.key(0), 0.0)
    plant = plants.van_der_pol_plant(record.inputs["command"], 0.02)
    np.testing.assert_allclose(record.outputs["position"], plant[:, 0], atol=1e-6)

    record = paper.servovalve_record(jax.random.key(0), 0.0)
    plant = plants.servovalve_plant(record.inputs["command"], 1e-3)
    np.testing.assert_allclose(record.outputs["position"], plant.position, atol=1e-6)


@pytest.mark.parametrize(
    ("make", "variance", "samples", "held", "amplitude"),
    [(paper.van_der_pol_record, 0.1, 2000, 50, 2.0), (paper.servovalve_record, 1e-5, 4000, 200, 6e-3)],
)
def test_records_are_those_that_are_announced(make, variance, samples, held, amplitude):
    clean, noisy, other = (
        make(jax.random.key(0), 0.0),
        make(jax.random.key(0), variance),
        make(jax.random.key(1), variance),
    )
    command = clean.inputs["command"].reshape(-1, held)
    assert len(clean) == samples
    np.testing.assert_array_equal(command, command[:, :1] * np.ones(held))
    assert 0.8 * amplitude < np.abs(command).max() <= amplitude
    # A uniform level has a variance of a third of its amplitude squared.
    assert np.var(command) == pytest.approx(amplitude**2 / 3, rel=0.5)
    np.testing.assert_array_equal(other.inputs["command"], clean.inputs["command"])
    for record in (noisy, other):
        noise = record.outputs["position"] - clean.outputs["position"]
        assert np.var(noise) == pytest.approx(variance, rel=5 * math.sqrt(2 / samples))
        assert abs(np.mean(noise)) < 5 * math.sqrt(variance / samples)
    assert not np.array_equal(noisy.outputs["position"], other.outputs["position"])
    np.testing.assert_array_equal(make(jax.random.key(0), variance).outputs["position"], noisy.outputs["position"])


@pytest.mark.parametrize("variance", [-0.1, math.nan, math.inf])
def test_noise_variance_must_be_one(variance):
    with pytest.raises(ValueError, match="expected noise_variance to be zero or more, got"):
        paper.van_der_pol_record(jax.random.key(0), variance)


def test_misprint_of_the_flow_gain_is_one():
    found = [row["flow_gain"] for row in paper.PAPER_TABLE_2.values()]
    assert all(0.5 <= value / paper.SERVOVALVE_TRUTH["flow_gain"] <= 1.5 for value in found)
    assert all(value / paper.PRINTED_FLOW_GAIN > 10 for value in found)


@pytest.mark.parametrize(
    ("run", "truth", "population", "generations"),
    [
        (paper.identify_van_der_pol, paper.VAN_DER_POL_TRUTH, 100, 50),
        (paper.identify_servovalve, paper.SERVOVALVE_TRUTH, 50, 20),
    ],
)
def test_identifications_have_the_paper_sizes_and_bounds(run, truth, population, generations, monkeypatch):
    asked = {}

    def identify(model, records, **settings):
        asked.update(settings, model=model, record=records)
        return hand_made.fit()

    monkeypatch.setattr(paper, "identify", identify)
    monkeypatch.setattr(paper, "cramer_rao_bound", lambda model, record, noise_variance, parameters: parameters)
    made = run(jax.random.key(0), 1e-4)
    assert made.bound == truth  # taken where it is the bound of that experiment
    assert (asked["population"], asked["generations"]) == (population, generations)
    assert asked["bounds"] == {name: (pytest.approx(0.5 * v), pytest.approx(1.5 * v)) for name, v in truth.items()}
    assert set(asked["bounds"]) == set(asked["model"].free)
    noise = asked["record"].outputs["position"] - made.noise_free.outputs["position"]
    assert np.std(noise) == pytest.approx(1e-2, rel=0.1)


def test_search_alone_is_what_identify_leaves_without_refinement():
    key = jax.random.key(5)
    made = paper.identify_van_der_pol(key, 0.05, population=8, generations=4)
    _, search_key = jax.random.split(key)
    alone = ehsvjax.identify(
        ehsvjax.van_der_pol(), made.fit.records[0], key=search_key, population=8, generations=4, refine=False
    )
    assert made.by_search == alone.parameters
    for name, true in paper.VAN_DER_POL_TRUTH.items():
        assert abs(made.fit.parameters[name] - true) < 5 * made.bound[name]
        assert 1e-3 * true < made.bound[name] < 3e-2 * true


def test_tables_hold_the_paper_and_the_errors_of_everyone(valve):
    found = paper.SERVOVALVE_TRUTH | {"damping_ratio": 0.756}
    by_search = paper.SERVOVALVE_TRUTH | {"natural_frequency": 285.0}
    made = identified("valve", 1e-7, found, by_search)
    table = paper.table_2([valve[0], made])
    rows = ["paper", "GA alone", "GA and refinement", "Cramér-Rao bound"]
    assert table.index.tolist() == [(variance, row) for variance in (1e-8, 1e-7) for row in rows]
    assert table.loc[(1e-7, "paper"), ("saturation", "value")] == 2.0e-3
    assert table.loc[(1e-7, "paper"), ("saturation", "error %")] == pytest.approx(-100 / 3)
    assert table.loc[(1e-8, "paper"), ("damping_ratio", "error %")] == pytest.approx(-7.6806, abs=1e-4)
    assert table.loc[(1e-8, "paper"), ("flow_gain", "error %")] == pytest.approx(-2.7586, abs=1e-4)
    assert table.loc[(1e-7, "GA alone"), ("natural_frequency", "error %")] == pytest.approx(-5.0)
    assert table.loc[(1e-7, "GA alone"), ("damping_ratio", "error %")] == 0.0
    assert table.loc[(1e-7, "GA and refinement"), ("damping_ratio", "error %")] == pytest.approx(5.0)
    assert table.loc[(1e-7, "Cramér-Rao bound"), ("damping_ratio", "value")] == pytest.approx(0.00756)
    assert table.loc[(1e-7, "Cramér-Rao bound"), ("damping_ratio", "error %")] == pytest.approx(1.05)


def test_table_1_holds_the_oscillator(oscillator):
    table = paper.table_1(oscillator)
    assert table.loc[(0.1, "paper"), ("gamma", "value")] == 1.1337
    assert table.loc[(0.1, "paper"), ("gamma", "error %")] == pytest.approx(-7.8293, abs=1e-4)


def test_tables_know_the_paper_variances_only():
    made = identified("oscillator", 0.2, paper.VAN_DER_POL_TRUTH)
    with pytest.raises(ValueError, match=r"expected noise variances of the paper, 0.05, 0.1, got 0.2"):
        paper.table_1([made])


def test_table_text_fits_a_terminal(valve):
    text = paper.table_text(paper.table_2(valve), ehsvjax.servovalve(), paper.SERVOVALVE_TRUTH)
    assert max(map(len, text.splitlines())) <= 100
    row = next(line for line in text.splitlines() if line.startswith("  paper")).split()
    assert row == ["paper", "9.92e-05", "0.003", "0.000141", "0.0919", "0.6647", "296.35"]
    assert "noise variance 1e-07 m²" in text


def needs_no_other_file(page):
    # An embedded picture may spell anything.
    text = re.sub(r'src="data:[^"]*"', "", page)
    return not any(outside in text for outside in ("http", "<script", "<link", "@import"))


def test_demo_writes_what_it_says(oscillator, valve, monkeypatch, tmp_path, capsys):
    made = {i.noise_variance: i for i in (*oscillator, *valve)}
    for name in ("identify_van_der_pol", "identify_servovalve"):
        monkeypatch.setattr(paper, name, lambda key, variance, progress: made[variance])
    out = tmp_path / "new" / "out"
    demo.main(["--out", str(out)])
    assert sorted(path.name for path in out.iterdir()) == [
        *("diagnosis.html", "diagnosis.png", "figure_1.png", "figure_4.png", "figure_5.png"),
        *("next_experiment.png", "report.html", "table_1.csv", "table_2.csv"),
    ]
    printed = capsys.readouterr().out
    assert str(out / "report.html") in printed
    assert "torque_motor_hysteresis" in printed
    assert "Next: command: " in printed and "coulomb_friction against nothing more" in printed
    assert max(len(line) for line in printed.splitlines() if str(out) not in line) <= 100

    table = pd.read_csv(out / "table_2.csv")
    assert len(table) == 12
    assert table.loc[4, "saturation error %"] == pytest.approx(-33.3333)

    page = (out / "diagnosis.html").read_text(encoding="utf-8")
    assert page.count('src="data:image/png;base64,') == 3
    assert needs_no_other_file(page)
    page = (out / "report.html").read_text(encoding="utf-8")
    assert page.count('src="data:image/png;base64,') == 3
    assert needs_no_other_file(page)
    for told in (
        "10<sup>−5</sup> as the real one",
        "1.41&#8239;×&#8239;10<sup>−4</sup>",
        "Equation (3)",
        "Initial state",
    ):
        assert told in page
    # 33.3% at the bound of 1% given here.
    assert "<td>−33.3 %</td><td>±1 %</td><td>33</td>" in page


def test_report_wants_both_models(tmp_path, valve):
    with pytest.raises(ValueError, match="expected at least one identification of each model, got none"):
        report.write_report(tmp_path, [], valve)


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (0.0, "0"),
        (0.72, "0.72"),
        (-327.6, "−327.6"),
        (1e-5, "10<sup>−5</sup>"),
        (9.92e-5, "9.92&#8239;×&#8239;10<sup>−5</sup>"),
        (-2e7, "−2&#8239;×&#8239;10<sup>7</sup>"),
    ],
)
def test_numbers_are_written_as_people_do(value, shown):
    assert report._number(value) == shown


@pytest.mark.parametrize(
    ("error", "shown"), [(0.0, "0 %"), (-33.333, "−33.3 %"), (0.0625, "+0.062 %"), (1e-7, "0 %"), (0.11, "+0.11 %")]
)
def test_errors_carry_their_sign(error, shown):
    assert report._signed(error) == shown


def test_units_and_symbols_are_set_and_escaped():
    assert report._unit("m^2.5 kg^-0.5") == "m<sup>2.5</sup> kg<sup>−0.5</sup>"
    assert report._unit("") == "–"
    assert report._unit("<b>") == "&lt;b&gt;"
    assert report._symbol("Gc") == "G<sub>c</sub>"
    assert report._symbol("<") == "&lt;"
