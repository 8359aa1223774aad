"""What `diagnose` promises its callers: a table, a fit, a text, a page, refusals that help, nothing compiled twice."""

import dataclasses
import inspect
import re

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import ehsvjax
from ehsvjax.diagnosis import Alternative
from ehsvjax.effects import BANK, amplitude, attach, effects_of
from ehsvjax.quantities import quantity
from tests.compilations import compilations

# One process compiles.
pytestmark = pytest.mark.xdist_group("diagnoses of the oscillator")
PERIOD, SAMPLES, HELD = 0.05, 600, 20
TIME = np.arange(SAMPLES) * PERIOD
TRUTH = {"alpha": 0.96, "gamma": 1.23}
NOISE = 0.01
BIAS = 0.1
KEY = jax.random.key(3)
# A name that a page must not take for markup.
NAME = "bench <script>alert(1)</script>"
# Without the types that are checked under test only: what a user calls.
diagnose = inspect.unwrap(ehsvjax.diagnose)


def oscillate(command, cogging=0.0):
    """Simulate x1' = alpha*x2, x2' = -x1 + gamma*(1 - x1^2)*x2 + u - cogging*sin(5*x1); x1 [time]."""
    state, positions = np.zeros(2), []
    times = np.arange(HELD + 1) * PERIOD
    for u in command[::HELD]:

        def derivative(t, y, u=u):
            force = u - cogging * np.sin(5.0 * y[0])
            return TRUTH["alpha"] * y[1], -y[0] + TRUTH["gamma"] * (1.0 - y[0] ** 2) * y[1] + force

        found = solve_ivp(derivative, times[[0, -1]], state, t_eval=times, rtol=1e-9, atol=1e-9)
        positions.append(found.y[0, :-1])
        state = found.y[:, -1]
    return np.concatenate(positions)


def measured(seed, bias=0.0, noise=NOISE, name="bench", missing=(), **effects):
    rng = np.random.default_rng(seed)
    command = np.repeat(rng.uniform(-1.0, 1.0, SAMPLES // HELD), HELD)
    position = oscillate(command, **effects) + bias + rng.normal(0.0, noise, SAMPLES)
    position[list(missing)] = np.nan
    return ehsvjax.Record(TIME, {"command": command}, {"position": position}, name=name)


def identified(record):
    return ehsvjax.identify(ehsvjax.van_der_pol(), record, key=KEY, population=40, generations=15)


@pytest.fixture(scope="module")
def record():
    return measured(0, BIAS, name=NAME)


@pytest.fixture(scope="module")
def fit(record):
    return identified(record)


@pytest.fixture(scope="module")
def settings():
    """What a user may have set, as it was before the first diagnosis."""
    return global_settings()


def global_settings():
    return dict(jax.config.values), dict(matplotlib.rcParams), np.geterr(), np.random.get_state()[1].tolist()  # noqa: NPY002


@pytest.fixture(scope="module")
def diagnosis(settings, fit, record):
    del settings
    return ehsvjax.diagnose(fit, record, key=KEY)


# --- Refusals: before anything is compiled ---

COMMAND, POSITION = {"command": np.sign(np.sin(TIME))}, {"position": np.cos(TIME)}
UNMEASURED = ehsvjax.Record(TIME, COMMAND)
OTHER_OUTPUT = ehsvjax.Record(TIME, COMMAND, {"speed": np.sin(TIME)}, name="tacho")
MORE_OUTPUTS = ehsvjax.Record(TIME, COMMAND, POSITION | {"speed": np.sin(TIME)})
OTHER_INPUT = ehsvjax.Record(TIME, {"voltage": np.sign(np.sin(TIME))}, POSITION, name="bench 2")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"fit": None}, "expected a fit as identify returns it, got NoneType"),
        ({"fit": ehsvjax.van_der_pol()}, "expected a fit as identify returns it, got Model"),
        ({"records": TIME}, "expected records to be a Record or a sequence of Records, got"),
        ({"records": None}, "expected records to be a Record or a sequence of Records, got None: make one with"),
        ({"records": []}, r"expected records to be a Record or a sequence of Records, got \[\]: make one with"),
        ({"records": UNMEASURED}, "expected record to hold an output that was fitted, position; it has none"),
        ({"records": OTHER_OUTPUT}, "expected tacho to hold an output that was fitted, position; it has speed"),
        ({"records": MORE_OUTPUTS}, r"that were fitted, position; record also has speed: drop them with \.select"),
        ({"records": OTHER_INPUT}, "expected bench 2 to hold the inputs of .*, command; it lacks command"),
        ({"validation": "bench"}, "expected validation to be a Record or a sequence of Records, got 'bench': make one"),
        ({"validation": UNMEASURED}, "expected record to hold an output that was fitted, position; it has none"),
        ({"validation": OTHER_INPUT}, "expected bench 2 to hold the inputs of .*, command; it lacks command"),
        ({"key": 0}, r"expected key to be a random key such as jax\.random\.key\(0\), got 0"),
        ({"key": None}, r"expected key to be a random key such as jax\.random\.key\(0\), got None"),
        ({"key": jax.random.split(KEY, 3)}, r"expected key to be a random key such as jax\.random\.key\(0\), got"),
        ({"key": jnp.zeros(2)}, r"expected key to be a random key such as jax\.random\.key\(0\), got"),
        ({"bank": ()}, "(?=.*got)expected bank to be a sequence of effects, such as"),
        ({"bank": (*BANK, "sensor_bias")}, "(?=.*got)expected bank to be a sequence of effects, such as"),
        ({"bank": BANK[0]}, "(?=.*got)expected bank to be a sequence of effects, such as"),
        ({"bank": "coulomb_friction"}, "(?=.*got)expected bank to be a sequence of effects, such as"),
    ],
)
def test_what_cannot_be_diagnosed_is_refused_before_anything_is_compiled(fit, record, changes, said):
    arguments = {"fit": fit, "records": record, "validation": None, "key": KEY, "bank": BANK} | changes
    with compilations() as compiled, pytest.raises(ValueError, match=said):
        diagnose(**arguments)
    assert compiled == []


def test_attached_numbers_have_the_units_of_the_table(diagnosis):
    bounds = {"cubic_stiffness.coefficient": (-1.0, 1.0), "transport_delay.delay": (0.0, 1.0)}
    model = attach(ehsvjax.van_der_pol(), bounds, duration=30.0, bank=BANK)
    units = dict(zip(diagnosis.table["cause"], diagnosis.table["unit"], strict=True))
    for name in bounds:
        assert model.parameter(name).unit == units[name.rpartition(".")[0]], name


# --- One hidden effect: what is returned ---


def test_the_cause_is_named(diagnosis):
    assert diagnosis.verdict == "named", str(diagnosis)
    assert diagnosis.names == ("sensor_bias",)
    assert diagnosis.alternatives == ()
    assert diagnosis.innocent
    assert diagnosis.missing is None


def test_a_cause_says_how_sure_how_large_and_what_it_explains(diagnosis):
    (cause,) = diagnosis.causes
    assert cause.signal == "position" and cause.probability > 0.99 and not cause.of_run
    (size,) = cause.sizes
    assert (size.number, size.unit, size.record) == ("bias", "", None)
    assert size.value == diagnosis.extended.parameters["sensor_bias.bias"]
    assert abs(size.value - BIAS) < 4.0 * size.standard_error
    # Found by differentiation of another program, in white noise.
    assert size.standard_error == pytest.approx(diagnosis.extended.standard_errors["sensor_bias.bias"], rel=0.3)
    assert cause.share == pytest.approx(1.0, abs=0.02)
    assert cause.records == (NAME,) and cause.contradicted_by == ()
    assert diagnosis.left.innocent and diagnosis.left.share["position"] == pytest.approx(0.0, abs=0.02)


def test_the_table_has_every_effect_that_the_model_can_have(diagnosis):
    kinds = {s.kind for s in ehsvjax.van_der_pol().signals} | {"parameter"}
    possible = {e.name for e in BANK if e.kind in kinds and set(e.needs) <= {"position", "velocity", "time"}}
    # An input that reaches the sensor by itself bears the name of the input, which no bank knows.
    possible |= {"feedthrough_of_command"}
    assert {cause.partition("@")[0] for cause in diagnosis.table["cause"]} == possible
    assert {"parameter_drift@alpha", "parameter_drift@gamma"} <= set(diagnosis.table["cause"])


def test_the_table_has_the_columns_that_are_promised(diagnosis):
    table = diagnosis.table
    promised = """cause signal size unit score p_value p_corrected likelihood_gain smallest_detectable confounded_with
    included"""
    assert set(promised.split()) <= set(table.columns)
    numbers = table[["p_value", "p_corrected"]].dropna()
    assert ((numbers >= 0.0) & (numbers <= 1.0)).all(axis=None)
    assert (numbers["p_corrected"] >= numbers["p_value"] - 1e-12).all()
    assert (table["likelihood_gain"] >= 0.0).all()
    assert (table["smallest_detectable"].dropna() > 0.0).all()
    assert set(table["signal"]) == {"command", "damping", "force", "position", "alpha", "gamma"}


def test_the_table_begins_with_the_cause(diagnosis):
    first = diagnosis.table.iloc[0]
    assert first["cause"] == "sensor_bias" and first["signal"] == "position" and first["included"]
    assert first["size"] == pytest.approx(BIAS, abs=0.01)
    assert first["p_corrected"] < 1e-6
    assert first["likelihood_gain"] > 100.0
    assert 0.0 < first["smallest_detectable"] < BIAS
    assert diagnosis.table["included"].sum() == 1


def test_units_of_the_table_are_the_models(diagnosis):
    units = dict(zip(diagnosis.table["cause"], diagnosis.table["unit"], strict=True))
    assert units["transport_delay"] == "s"
    assert units["sensor_bias"] == ""  # the oscillator's position has none
    assert units["cubic_stiffness"] == ""


def test_the_extended_fit_is_a_fit_that_holds_the_truth(diagnosis, record):
    extended = diagnosis.extended
    assert isinstance(extended, ehsvjax.Fit)
    errors = extended.precision().standard_errors
    for name, true in {**TRUTH, "sensor_bias.bias": BIAS}.items():
        assert abs(extended.parameters[name] - true) < 5.0 * errors[name], name
    assert extended.rmse["position"] == pytest.approx(NOISE, rel=0.12)  # 4 sigma of 600 samples
    simulated = extended.simulate(record)["position"]
    clean = oscillate(record.inputs["command"]) + BIAS
    assert np.sqrt(np.mean((simulated - clean) ** 2)) < 0.3 * NOISE
    assert extended.warnings == ()
    assert "sensor_bias.bias" in str(extended)


def test_the_gain_is_measured_down_to_the_noise_on_what_was_held_back(diagnosis):
    gain = diagnosis.gain.outputs["position"]
    assert "held back" in diagnosis.gain.on
    assert gain.noise_floor == pytest.approx(NOISE, rel=0.12)
    assert gain.rmse_after == pytest.approx(NOISE, rel=0.3)  # 180 samples, six unknowns from the others
    assert gain.rmse_before > 2.0 * gain.rmse_after
    assert gain.fit_before < gain.fit_after < 100.0
    low, high = gain.share_interval
    assert 0.8 < low <= gain.share_removed <= high < 1.2


@pytest.mark.parametrize("share", [0.97, 1.053])
def test_more_than_all_of_an_error_is_said_to_be_chance(diagnosis, share):
    (before,) = diagnosis.gain.by_record
    one = before["position"]._replace(share_removed=share)
    text = str(dataclasses.replace(diagnosis, gain=diagnosis.gain._replace(by_record=({"position": one},))))
    assert f"{100 * share:.1f}% of the removable error removed" in text
    assert ("as the noise happens to be less there" in text) == (share > 1.0)


def test_the_misfit_is_in_finite_numbers(diagnosis):
    misfit = diagnosis.misfit.outputs["position"]
    assert misfit.noise_floor == pytest.approx(NOISE, rel=0.12)
    assert misfit.rmse > 2.0 * misfit.noise_floor
    assert misfit.above_noise == pytest.approx(1.0 - (misfit.noise_floor / misfit.rmse) ** 2)
    assert np.isfinite(misfit.residual).all() and len(misfit.residual) == SAMPLES
    assert np.isfinite(misfit.in_time).all() and np.isfinite(misfit.in_frequency).all()
    for profile in misfit.against.values():
        assert np.isfinite(profile).all()
        # A constant offset lies in every bin; the extended model leaves none.
        assert np.sqrt(np.mean((profile.mean / profile.deviation) ** 2)) > 4.0
        assert np.sqrt(np.mean((profile.mean_after / profile.deviation) ** 2)) < 2.0
    assert {"time", "command", "position"} <= set(misfit.against)
    assert misfit.whiteness < 1e-6 and not misfit.coloured and not misfit.outliers.any() and misfit.lattice is None
    assert diagnosis.misfit.tests[0].corrected < 1e-6
    assert diagnosis.misfit.tests_after[0].corrected > 1e-3


def test_what_is_printed_says_the_cause_and_its_numbers_are_attributes(diagnosis):
    text = str(diagnosis)
    assert text == repr(diagnosis)
    first, *_ = text.splitlines()
    assert "Van der Pol" in first and NAME in first and "sensor_bias" in first
    misfit, gain = diagnosis.misfit.outputs["position"], diagnosis.gain.outputs["position"]
    numbers = [
        f"rmse {misfit.rmse:.4g}",
        f"{misfit.noise_floor:.4g}",
        f"{100 * misfit.above_noise:.1f}%",
        f"{len(diagnosis.misfit.tests)} tests",
        f"bias {diagnosis.extended.parameters['sensor_bias.bias']:.4g}",
        f"{diagnosis.table['likelihood_gain'].iloc[0]:.4g} times what",
        f"rmse {gain.rmse_before:.4g} -> {gain.rmse_after:.4g}",
        f"noise {gain.noise_floor:.4g}",
        f"fit {gain.fit_before:.2f} -> {gain.fit_after:.2f}%",
        f"{100 * gain.share_removed:.1f}%",
        *(f"{100 * share:.1f}" for share in gain.share_interval),
    ]
    assert [number for number in numbers if number not in text] == []
    assert diagnosis.gain.on in text
    assert "nan" not in text and "inf" not in text


def test_what_is_printed_has_no_gap_where_a_unit_is_none(diagnosis):
    assert re.findall(r"\S+ [,;.)]|\S  \S+", str(diagnosis)) == []


def test_causes_that_cannot_be_told_apart_are_told_as_such(diagnosis):
    either = Alternative(("sensor_bias", "input_bias"), "", (0.7, 0.3))
    first = diagnosis.causes[0]._replace(probability=0.7)
    causes = (first, first._replace(name="sensor_lag", sizes=(), probability=0.999))
    unsure = dataclasses.replace(diagnosis, verdict="ambiguous", causes=causes, alternatives=(either,))
    size = f"{first.sizes[0].value:.3g}"
    said = (
        f"ambiguous: sensor_lag (certain); and sensor_bias ({size}, 70%) or input_bias (30%): this record cannot tell."
    )
    assert said in str(unsure)
    title = " ".join(unsure.plot().get_suptitle().split())
    assert title.endswith(": ambiguous: sensor lag; and sensor bias or input bias")


def test_a_parameter_that_runs_to_its_bound_beside_the_causes_is_told(diagnosis):
    name = diagnosis.fit.model.free[0]
    at_bound = diagnosis.extended.parameters | {name: diagnosis.fit.model.parameter(name).lower}
    held = dataclasses.replace(diagnosis, extended=dataclasses.replace(diagnosis.extended, parameters=at_bound))
    said = f"{name} is at its lower bound beside the causes, which may stand for what is beyond it: widen"
    assert said in str(held) and said not in str(diagnosis)


@pytest.mark.parametrize(
    ("innocent", "why"),
    [(True, "a single term explains the record better than several effects of the bank together"),
     (False, "no effect of the bank has earned its place")],
)  # fmt: skip
def test_why_it_is_unexplained_is_said(diagnosis, innocent, why):
    unexplained = dataclasses.replace(diagnosis, verdict="unexplained", causes=(), innocent=innocent)
    assert f"unexplained. Something is missing, and {why}." in str(unexplained)


def test_what_was_not_there_is_excluded_or_said_to_be_unseen(diagnosis):
    excluded = {e.cause: e.above for e in diagnosis.excluded}
    assert "sensor_bias" not in excluded and "sensor_bias" not in diagnosis.unseen
    assert all(0.0 < above < np.inf for above in excluded.values())
    assert excluded["transport_delay"] < 0.1
    assert not set(excluded) & set(diagnosis.unseen)


def test_the_page_needs_no_other_file_and_takes_no_name_for_markup(diagnosis, tmp_path):
    diagnosis.report(tmp_path / "new" / "diagnosis.html")
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["diagnosis.html"]
    page = (tmp_path / "new" / "diagnosis.html").read_text(encoding="utf-8")
    loaded = re.findall(r"""(?:src|href|srcset|poster|data)\s*=\s*["']?([^"'\s>]*)""", page)
    assert len(loaded) >= 2 and all(address.startswith("data:image/png;base64,") for address in loaded)
    assert not re.search(r"<(script|link|iframe|object|embed|base)\b|@import|url\(", page, re.IGNORECASE)
    assert "bench &lt;script&gt;alert(1)&lt;/script&gt;" in page
    for cause in diagnosis.table["cause"]:
        assert f"<td>{cause}</td>" in page, cause
    first = diagnosis.table.iloc[0]
    assert f'<td class="number">{quantity(first["size"], first["unit"])}</td>' in page
    assert "<b>named</b>: sensor_bias" in page
    for tag in ("html", "head", "body", "table", "tr", "td", "ul", "li", "pre", "p"):
        assert len(re.findall(rf"<{tag}[ >]", page)) == page.count(f"</{tag}>"), tag


def test_every_axis_of_the_picture_says_what_it_shows(diagnosis):
    figure = diagnosis.plot()
    assert figure.get_suptitle().endswith(": named: sensor bias")
    assert len(figure.axes) == 7
    assert "suspects" in [axes.get_title(loc="left") for axes in figure.axes]
    labels = [axes.get_xlabel() for axes in figure.axes]
    assert "time (s)" in labels and "frequency (Hz)" in labels and "score on the nominal model" in labels[-1]
    series, series_after, spectrum, *profiles, suspects = figure.axes
    assert series_after.get_xlabel() == "time (s)" and series_after.get_ylim() == series.get_ylim()
    assert series.get_ylabel() == "residual of\nposition (–)" and spectrum.get_ylabel() == "power (1/Hz)"
    assert profiles[0].get_ylabel() == "mean residual (–)"
    assert all(re.search(r"\(.+\)", axes.get_xlabel()) for axes in figure.axes if axes is not series)
    assert suspects.get_yticklabels()[-1].get_text() == "sensor bias"
    lengths = [bar.get_width() for bar in suspects.patches]
    assert lengths == sorted(lengths) and lengths[-1] > suspects.lines[0].get_xdata()[0] > 3.0
    # What the extended model leaves lies beside what the model leaves, wherever the misfit is shown.
    assert [text.get_text() for text in spectrum.get_legend().get_texts()] == ["residual", "extended", "noise"]
    for axes in profiles:
        model, extended, _ = axes.lines
        assert np.abs(extended.get_ydata()).max() < 0.3 * np.abs(model.get_ydata()).max()
    assert [text.get_text() for text in series.get_legend().get_texts()] == [
        "the model",
        "extended",
        "95% of the noise",
    ]


def test_a_picture_is_not_left_in_pyplot(diagnosis):
    import matplotlib.pyplot

    before = matplotlib.pyplot.get_fignums()
    diagnosis.plot()
    assert matplotlib.pyplot.get_fignums() == before


# --- Diagnosed again ---


def test_the_extended_fit_is_adequate_on_the_same_record(diagnosis, record):
    assert effects_of(diagnosis.extended.model) == ("sensor_bias",)
    again = ehsvjax.diagnose(diagnosis.extended, record, key=KEY)
    assert again.verdict == "adequate", str(again)
    assert "suspects: nothing here is significant" in [axes.get_title(loc="left") for axes in again.plot().axes]
    assert again.names == () and again.innocent and again.missing is None
    assert not again.table["included"].any()
    assert effects_of(again.extended.model) == ("sensor_bias",)
    assert again.extended.parameters["sensor_bias.bias"] == pytest.approx(BIAS, abs=0.01)
    assert again.misfit.outputs["position"].above_noise < 0.1
    assert "adequate" in str(again) and "excluded" in str(again)


def test_the_same_key_and_record_give_the_same_result(diagnosis, fit, record, capsys):
    assert capsys.readouterr() == ("", "")
    again = ehsvjax.diagnose(fit, record, key=KEY, progress=True)
    shown = capsys.readouterr()
    assert shown.out == "" and "diagnose: refitting the rivals" in shown.err and "measuring the gain" in shown.err
    assert again.table.equals(diagnosis.table)
    assert str(again) == str(diagnosis)
    assert again.gain == diagnosis.gain
    assert again.extended.parameters == diagnosis.extended.parameters
    assert again.excluded == diagnosis.excluded and again.unseen == diagnosis.unseen


def test_settings_of_the_user_are_left_alone(settings, diagnosis, tmp_path):
    diagnosis.report(tmp_path / "diagnosis.html")
    for before, after in zip(settings, global_settings(), strict=True):
        assert after == before


def test_a_diagnosis_cannot_be_changed(diagnosis):
    with pytest.raises(dataclasses.FrozenInstanceError):
        diagnosis.verdict = "adequate"


def test_another_record_of_the_same_length_compiles_nothing_and_may_miss_samples(diagnosis):
    del diagnosis  # has compiled everything
    with compilations() as compiled:
        jax.jit(lambda x: 3 * x)(1.0)
    assert compiled, "compilations are seen"
    gap = [5, *range(100, 130), 300]
    other = measured(8, bias=-0.2, noise=0.02, name="other", missing=gap)
    own = identified(other)
    with compilations() as compiled:
        found = ehsvjax.diagnose(own, other, key=jax.random.key(9))
    assert compiled == []
    assert found.names == ("sensor_bias",), str(found)
    assert found.extended.parameters["sensor_bias.bias"] == pytest.approx(-0.2, abs=0.02)
    misfit = found.misfit.outputs["position"]
    assert np.flatnonzero(np.isnan(misfit.residual)).tolist() == gap
    assert np.isfinite(misfit.rmse) and misfit.noise_floor == pytest.approx(0.02, rel=0.12)


def test_the_gain_is_measured_on_a_validation_record_that_may_miss_samples(diagnosis, fit, record):
    validation = measured(21, BIAS, name="the other day", missing=range(40, 60))
    found = ehsvjax.diagnose(fit, record, validation, key=KEY)
    assert "the other day" in found.gain.on
    gain = found.gain.outputs["position"]
    assert gain.rmse_after == pytest.approx(NOISE, rel=0.2)
    assert gain.rmse_after == pytest.approx(diagnosis.extended.score(validation).rmse["position"], rel=1e-3)
    assert gain.rmse_before > 2.0 * gain.rmse_after
    assert found.table.equals(diagnosis.table)


def test_a_record_that_misses_its_end_is_diagnosed(diagnosis):
    del diagnosis  # has compiled everything
    record = measured(11, BIAS, missing=range(400, SAMPLES))
    found = ehsvjax.diagnose(identified(record), record, key=KEY)
    assert found.names == ("sensor_bias",), str(found)


# --- An effect of one's own ---


def test_an_effect_of_ones_own_is_found():
    cogging = ehsvjax.Effect(
        "cogging",
        "force",
        (amplitude("depth", "{value}", lambda scales: 1e-3),),
        lambda own, force, context: force - own["depth"] * jnp.sin(5.0 * context["position"]),
        needs=("position",),
        says="the magnets hold the motion at places",
        settled_by="turn it by hand",
    )
    record = measured(2, cogging=0.15)
    found = ehsvjax.diagnose(identified(record), record, key=KEY, bank=(*BANK, cogging))
    assert found.names == ("cogging",), str(found)
    extended = found.extended
    assert abs(extended.parameters["cogging.depth"] - 0.15) < 5.0 * extended.standard_errors["cogging.depth"]
    assert found.gain.outputs["position"].rmse_after == pytest.approx(NOISE, rel=0.3)
