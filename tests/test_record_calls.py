"""Hand-made calls of records and columns: whatever is wrong in type, size or sign is one sentence of this package."""

import traceback
from pathlib import Path

import jax
import numpy as np
import pandas as pd
import pytest

import ehsvjax
from ehsvjax import Column, Record

pytestmark = pytest.mark.usefixtures("unchecked")
OWN = Path(ehsvjax.__file__).parent
TIME, COMMAND, POSITION = 0.1 * np.arange(5), np.array([0.0, 1, 1, -1, -1]), np.array([0.0, 0.1, 0.3, 0.5, 0.2])
FRAME = pd.DataFrame({"t": TIME, "u": COMMAND, "y": POSITION})
PLAIN = {"time": "t", "inputs": {"command": "u"}, "outputs": {"position": "y"}}
ODD = {
    "nothing": None,
    "text": "0.1",
    "bytes": b"0.1",
    "true": True,
    "complex": 1j,
    "nan": np.nan,
    "inf": np.inf,
    "minus": -1.0,
    "zero": 0,
    "huge": 10**400,
    "tiny": 5e-324,
    "list": [0.1],
    "ragged": [[1.0], [1.0, 2.0]],
    "mapping": {"a": 1},
    "set": {1, 2},
    "function": len,
    "object": object(),
    "array": np.ones((2, 2)),
    "texts": np.array(["a", "b", "c", "d", "e"]),
    "dates": np.arange(5).astype("datetime64[s]"),
    "empty": np.zeros(0),
    "masked": np.ma.masked_equal(np.arange(5), 3),
    "frame": FRAME,
    "series": FRAME["u"],
    "record": Record(TIME, {"command": COMMAND}),
    "$<&": "$<b>&",
}


def refused(call):
    """Whether the call is refused, and by a sentence of the package's own; what else is raised passes."""
    refusal = None
    try:
        call()
    except (ValueError, TypeError) as error:
        refusal = error
    if refusal is None:
        return False
    raised_in = Path(traceback.extract_tb(refusal.__traceback__)[-1].filename)
    assert raised_in.is_relative_to(OWN), f"{raised_in}: {refusal!r}"
    assert "\n" not in str(refusal) and len(str(refusal)) > 30, refusal
    return True


def a_record(**changes):
    return Record(**{"time": TIME, "inputs": {"command": COMMAND}, "outputs": {"position": POSITION}, **changes})


# What is called with the odd value, and the odd values that may pass.
CALLS = {
    "time": (lambda odd: a_record(time=odd), ()),
    "inputs": (lambda odd: a_record(inputs=odd), ()),
    "outputs": (lambda odd: a_record(outputs=odd), ()),
    "input": (lambda odd: a_record(inputs={"command": odd}), ("series",)),
    "output": (lambda odd: a_record(outputs={"position": odd}), ("series",)),
    "name of an input": (lambda odd: a_record(inputs=dict([(odd, COMMAND)])), ("text", "$<&")),
    "hold": (lambda odd: a_record(hold=odd), ()),
    "name": (lambda odd: a_record(name=odd), ("text", "$<&")),
    "uniform": (lambda odd: a_record(uniform=odd), ("true",)),
    "slice from": (lambda odd: a_record().slice(odd), ("minus", "zero", "tiny")),
    "slice to": (lambda odd: a_record().slice(stop=odd), ("inf",)),
    "split at": (lambda odd: a_record().split(odd), ()),
    "split fraction": (lambda odd: a_record().split(fraction=odd), ()),
    "resample": (lambda odd: a_record().resample(odd), ()),
    "inputs_known_in_gaps": (lambda odd: a_record().resample(0.1, inputs_known_in_gaps=odd), ("true",)),
    "range": (lambda odd: a_record().within(position=odd), ()),
    "condition": (lambda odd: a_record().stretches(odd), ()),
    "shortest": (lambda odd: a_record().stretches([True] * 5, shortest=odd), ("zero", "tiny")),
    "end of a range": (lambda odd: a_record().within(position=(-2.0, odd)), ("inf",)),
    "model of a check": (lambda odd: a_record().check(odd), ("nothing",)),
    "select": (lambda odd: a_record().select(outputs=odd), ("empty",)),
    "select one": (lambda odd: a_record().select(outputs=[odd]), ()),
    "frame": (lambda odd: Record.from_dataframe(odd, **PLAIN), ("frame",)),
    "time column": (lambda odd: Record.from_dataframe(FRAME, **{**PLAIN, "time": odd}), ("tiny",)),
    "inputs column": (lambda odd: Record.from_dataframe(FRAME, **{**PLAIN, "inputs": {"command": odd}}), ()),
    "input columns": (lambda odd: Record.from_dataframe(FRAME, **{**PLAIN, "inputs": odd}), ()),
    "column's name": (lambda odd: from_column(Column(odd)), ()),
    "scale": (lambda odd: from_column(Column("y", odd)), ("minus",)),
    "offset": (lambda odd: from_column(Column("y", 1.0, odd)), ("minus", "zero", "tiny")),
    "path of CSV": (lambda odd: Record.from_csv(odd, **PLAIN), ()),
    "path of Excel": (lambda odd: Record.from_excel(odd, **PLAIN), ()),
    "path of parquet": (lambda odd: Record.from_parquet(odd, **PLAIN), ()),
    "path of NPZ": (lambda odd: Record.from_npz(odd, **PLAIN), ()),
    "path of MATLAB": (lambda odd: Record.from_mat(odd, **PLAIN), ()),
}


def from_column(column):
    return Record.from_dataframe(FRAME, time="t", inputs={}, outputs={"position": column})


@pytest.mark.parametrize("place", CALLS)
def test_odd_values(place):
    call, may_pass = CALLS[place]
    for kind, odd in ODD.items():
        if place == "name of an input" and kind in ("list", "ragged", "mapping", "set", "array", "texts", "dates"):
            continue  # Python itself: no key of a dict
        if place == "name of an input" and kind in ("empty", "masked", "frame", "series", "record"):
            continue
        try:
            assert refused(lambda odd=odd: call(odd)) != (kind in may_pass), kind
        except FileNotFoundError:
            assert place.startswith("path") and kind in ("text", "$<&")


def test_odd_options_of_pandas(tmp_path):
    path = tmp_path / "x.csv"
    FRAME.to_csv(path, index=False)
    for option in (
        "sep",
        "encoding",
        "skiprows",
        "decimal",
        "header",
        "usecols",
        "names",
        "comment",
        "chunksize",
        "dtype",
    ):
        for kind, odd in ODD.items():
            if (option, kind) == ("skiprows", "huge"):
                continue  # pandas lists the rows to be skipped
            refused(lambda option=option, odd=odd: Record.from_csv(path, **PLAIN, **{option: odd}))


def test_traced_values_are_refused():
    @jax.jit
    def inside(values):
        Record(TIME, {"command": values})
        return values

    with pytest.raises(ValueError, match="input 'command' is no array"):
        inside(COMMAND)


@pytest.mark.parametrize("time", [[-1e308, 1e308], [0.0, 1e309], [np.nan, 1.0], [1.7e12, 1.7e12 + 1]])
def test_times_beyond_numbers(time):
    assert refused(lambda: Record(time, {"command": [1.0, 2.0]}))


def test_an_output_named_twice():
    with pytest.raises(ValueError, match="output 'position' is named 2 times"):
        a_record().select(outputs=["position", "position"])
