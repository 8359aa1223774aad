"""Wrong values for every argument of records, identifications, fits and diagnoses."""

import functools
import tempfile
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np

import ehsvjax
from benchmarks.damaged_arguments import (
    CHOICE,
    FLAG,
    FUNCTION,
    KEY,
    MAPPING,
    NAME,
    NAN,
    NOT_ANYTHING,
    NOT_FINITE,
    NOT_NEGATIVE,
    NUMBER,
    PATH,
    POSITIVE,
    SHARE,
    THING,
    TIME,
    WHOLE,
    bounds_of,
    priors_of,
    ties_of,
    values_of,
    without,
)
from benchmarks.damaged_calls import Call, damaged
from benchmarks.damaged_models import tank, tank_fit, tank_record
from ehsvjax import effects


def calls() -> Iterator[Call]:
    """Yield a right call of each, and one for each wrong value of each argument."""
    for room in (of_records, of_fits, of_experiments):
        yield from room()


def of_records() -> Iterator[Call]:
    """Yield calls that make and change records."""
    record = tank_record()
    series = NOT_ANYTHING | {
        "text": "u", "number": 3.0, "list": [], "short": {"command": [1.0, 2.0]},
        "texts": {"command": ["a"] * len(record)},
        "NaN": {"command": np.full(len(record), NAN)}, "complex": {"command": np.full(len(record), 1j)},
        "number as name": {3: record.inputs["command"]}, "no name": {"": record.inputs["command"]},
        "None in it": {"command": None},
    }  # fmt: skip
    times = NOT_ANYTHING | {
        "text": "t", "number": 3.0, "empty": [], "one": [0.0], "backwards": record.time[::-1], "NaN": record.time * NAN,
        "constant": record.time * 0.0, "two axes": np.ones((4, 2)), "complex": record.time * 1j,
    }  # fmt: skip
    yield from damaged("Record", ehsvjax.Record, {
        "time": (record.time, times), "inputs": (dict(record.inputs), series),
        "outputs": (dict(record.outputs), series),
        "hold": ("zero", CHOICE), "name": ("a", without(NAME, "empty", "blank", "blanks around it", "line break")),
        "uniform": (True, FLAG),
    })  # fmt: skip
    yield from damaged("Record.slice", record.slice,
        {"start": (0.0, without(NUMBER, "-inf", "True")), "stop": (2.0, without(NUMBER, "inf", "True"))})  # fmt: skip
    yield from damaged("Record.split", record.split, {"at": (1.0, NUMBER)})
    yield from damaged("Record.split by fraction", lambda fraction: record.split(fraction=fraction),
        {"fraction": (0.5, SHARE | {"zero": 0.0})})  # fmt: skip
    yield from damaged("Record.resample", record.resample, {"sample_period": (0.02, TIME | {"tiny": 1e-300})})
    yield from damaged("Record.select", record.select, {"outputs": (["level"], without(THING, "list"))})
    frame = record.to_dataframe()
    columns = {"None": None, "text": "u", "number": 3.0, "list": ["level"], "unknown": {"a": "b"}, "wrong": {"a": 3.0}}
    read = {"time": ("time", {"None": None, "unknown": "t", "list": [], **NOT_FINITE, "negative": -1.0, "zero": 0.0}),
            "inputs": ({"command": "command"}, columns), "outputs": ({"level": "level"}, columns)}  # fmt: skip
    yield from damaged("Record.from_dataframe", ehsvjax.Record.from_dataframe, {"frame": (frame, THING), **read})
    table = Path(tempfile.mkdtemp()) / "tank.csv"
    frame.to_csv(table, index=False)
    yield from damaged("Record.from_csv", ehsvjax.Record.from_csv, {"path": (table, PATH | {"None": None}), **read})

    def with_column(**fields):
        return ehsvjax.Record.from_dataframe(
            frame, time="time", inputs={"command": "command"}, outputs={"level": ehsvjax.Column(**fields)}
        )

    yield from damaged("Column", with_column, {
        "name": ("level", NAME), "scale": (1.0, NUMBER | {"zero": 0.0}), "offset": (0.0, NUMBER),
    })  # fmt: skip


def of_fits() -> Iterator[Call]:
    """Yield calls that identify, ask a fit, and diagnose."""
    model, record, fit = tank(), tank_record(), tank_fit()
    initial = without(CHOICE, "list") | {
        "unknown": {"nobody": 1.0},
        "NaN in it": {"start": NAN},
        "text in it": {"start": "0"},
    }
    variances = values_of("level") | {"zero": {"level": 0.0}, "negative": {"level": -1.0}}
    yield from damaged("identify", ehsvjax.identify, {
        "model": (model, THING), "records": (record, THING), "key": (jax.random.key(0), KEY),
        "population": (4, WHOLE), "generations": (1, WHOLE), "bounds": ({"gain": (1.0, 3.0)}, bounds_of("gain")),
        "fixed": ({"lag": 1.0}, values_of("lag")), "initial": ("estimate", initial), "refine": (False, FLAG),
        "start": ({"gain": 2.0}, values_of("gain") | {"outside": {"gain": 99.0}}),
        "priors": ({"gain": (2.0, 0.5)}, priors_of("gain")),
        "tied": (None, ties_of("gain")),
        "noise_variance": ({"level": 1e-4}, variances), "huber": (1.5, without(POSITIVE, "None")),
        "operators": (ehsvjax.Operators(), THING), "tolerance": (0.01, NOT_NEGATIVE), "starts": (1, WHOLE),
        "islands": (1, WHOLE), "devices": (None, without(THING, "None")), "progress": (False, FLAG),
        "checkpoint": (None, PATH),
    })  # fmt: skip

    def with_operators(**fields):
        operators = ehsvjax.Operators(**fields)
        return ehsvjax.identify(model, record, key=jax.random.key(0), population=4, generations=1, refine=False,
                                operators=operators)  # fmt: skip

    for function in (ehsvjax.design, ehsvjax.cramer_rao_bound):
        plan = functools.partial(function, model, record, noise_variance={"level": 1e-4})
        yield from damaged(f"{function.__name__} from", plan, {"initial": ("estimate", initial)})

    own = ehsvjax.Operators()
    yield from damaged("Operators", with_operators, {
        "selection": (own.selection, FUNCTION), "crossover": (own.crossover, FUNCTION),
        "mutation": (own.mutation, FUNCTION),
        "elites": (1, WHOLE), "immigrants": (0.02, SHARE),
    })  # fmt: skip
    new = {"initial": ("nominal", initial)}
    for method in ("simulate", "residuals", "score", "initial_of"):
        # What starts nominally needs no record; residuals are by default those of the first.
        optional = without(THING, "None") if method == "residuals" else {} if method == "initial_of" else THING
        yield from damaged(f"Fit.{method}", getattr(fit, method), {"record": (record, optional), **new})
    noise, level = {"noise": ("white", CHOICE)}, {"level": (0.95, SHARE | {"zero": 0.0, "one": 1.0})}
    yield from damaged("Fit.precision", fit.precision, noise)
    yield from damaged("Precision.intervals", fit.precision().intervals, level)
    at = {"at": ({"command": 0.5}, values_of("command")), "initial": ({"start": 0.0}, values_of("start"))}
    yield from damaged("Fit.linearise", fit.linearise, at | noise)
    names = {"text": "gain", "number": 3.0, "numbers": [1.0], "unknown": ["nobody"], "empty": [], "object": object()}
    yield from damaged("Fit.profile_likelihood", fit.profile_likelihood, {"names": (["gain"], names), **level, **noise})
    yield from damaged("Fit.bootstrap", fit.bootstrap, {
        "key": (jax.random.key(0), KEY), "draws": (2, WHOLE), "kind": ("parametric", CHOICE), **noise,
    })  # fmt: skip
    yield from damaged("Fit.bands", fit.bands, {"record": (record, without(THING, "None")), **new, **level, **noise})
    yield from damaged("Fit.plot", fit.plot, {"record": (record, without(THING, "None"))})
    folder = Path(tempfile.mkdtemp())
    fit.save(folder / "fit.npz")
    yield from damaged("Fit.save", fit.save, {"path": (folder / "again.npz", PATH | {"None": None})})
    yield from damaged("Fit.load", ehsvjax.Fit.load,
        {"path": (folder / "fit.npz", PATH | {"None": None}), "model": (model, THING)})  # fmt: skip
    for wrong, argument in ((THING, "fit"), (THING, "records"), (without(THING, "None"), "validation"), (KEY, "key"),
                            (THING, "bank"), (without(FLAG, "None"), "progress")):  # fmt: skip
        right = {"fit": fit, "records": record, "validation": None, "key": jax.random.key(0), "bank": effects.BANK}
        for label, value in wrong.items():
            yield Call(
                "diagnose", argument, label, lambda a=argument, v=value, r=right: ehsvjax.diagnose(**{**r, a: v})
            )


def of_experiments() -> Iterator[Call]:
    """Yield calls that plan a next experiment."""
    pair = {"one number": 1.0, "three numbers": (0.0, 1.0, 2.0), "text": "ab", "texts": ("a", "b"), "NaN": (0.0, NAN),
            "upside down": (1.0, -1.0), "None": None}  # fmt: skip
    yield from damaged("Limits", ehsvjax.Limits, {
        "command": ((-1.0, 1.0), pair), "duration": (3.0, without(TIME, "None", "huge")),
    })  # fmt: skip
    fit = tank_fit()
    fits = MAPPING | {"empty": {}, "one": {"as it is": fit}, "texts in it": {"a": "fit", "b": "fit"}}
    pairs = {"text": "ab", "number": 3.0, "unknown": [("a", "c")], "itself": [("a", "a")], "empty": [],
             "three": [("a", "b", "c")], "numbers": [1.0, 2.0]}  # fmt: skip
    right = {
        "explanations": {"a": fit, "b": fit}, "limits": ehsvjax.Limits(command=(-1.0, 1.0)), "key": jax.random.key(0),
        "can_change": {"lag": (0.5, 1.0)}, "can_add": None, "pairs": None, "generations": 1,
    }  # fmt: skip
    for argument, wrong in (
        ("explanations", fits), ("limits", THING | {"huge": ehsvjax.Limits(command=(-1.0, 1.0), duration=1e12)}),
        ("key", KEY), ("can_change", bounds_of("lag")), ("can_add", values_of("level") | {"zero": {"level": 0.0}}),
        ("pairs", pairs), ("generations", WHOLE),
    ):  # fmt: skip
        for label, value in wrong.items():
            yield Call(
                "next_experiment", argument, label,
                lambda a=argument, v=value: ehsvjax.next_experiment(**{**right, a: v}),
            )  # fmt: skip
