"""Columns read from data frames and CSV, NPZ and MATLAB files, and what is refused in them."""

import os
import pickle

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from ehsvjax.columns import Column, pick, unknown_name, vector
from ehsvjax.matlab import mat_table
from ehsvjax.readers import frame_table
from ehsvjax.record import Record

COUNT = 50
TIME_MS = 2.0 * np.arange(COUNT)
COMMAND_MV = np.random.default_rng(1).uniform(-10.0, 10.0, COUNT)
POSITION_V = np.random.default_rng(2).uniform(0.0, 10.0, COUNT)
POSITION_V[7] = np.nan
RAW = {"t_ms": TIME_MS, "valve_cmd_mV": COMMAND_MV, "position_V": POSITION_V, "spare": np.zeros(COUNT)}
WANTED = {
    "time": Column("t_ms", scale=1e-3, offset=5.0),
    "inputs": {"command": Column("valve_cmd_mV", 0.001)},
    "outputs": {"position": Column("position_V", scale=0.02, offset=-0.1), "raw": "position_V"},
}
PLAIN = {"time": "t", "inputs": {"command": "u"}, "outputs": {"position": "y"}}


@pytest.fixture
def csv(tmp_path):
    """Write a text to a file and return its path."""
    path = tmp_path / "run 7.csv"
    return lambda text: (path.write_text(text), path)[1]


@pytest.fixture
def npz(tmp_path):
    """Write arrays to an NPZ file and return its path."""
    path = tmp_path / "run 7.npz"
    return lambda **arrays: (np.savez(path, **arrays), path)[1]


@pytest.fixture
def mat(tmp_path):
    """Write variables to a MATLAB file and return its path."""
    path = tmp_path / "run 7.mat"
    return lambda **variables: (savemat(path, variables), path)[1]


def refusal(function, *args, kind=ValueError, **kwargs):
    with pytest.raises(kind) as refused:
        function(*args, **kwargs)
    sentence = str(refused.value)
    assert "\n" not in sentence
    return sentence


# Round trips: scale and offset worked out here, element by element


def check(record, name):
    np.testing.assert_allclose(record.time, [5.0 + 0.002 * k for k in range(COUNT)], rtol=1e-14)
    np.testing.assert_allclose(record.inputs["command"], COMMAND_MV / 1000, rtol=1e-14)
    np.testing.assert_allclose(record.outputs["position"], (POSITION_V - 5.0) / 50, rtol=0, atol=1e-16)
    np.testing.assert_array_equal(record.outputs["raw"], POSITION_V)
    assert np.flatnonzero(np.isnan(record.outputs["position"])).tolist() == [7]
    assert (record.name, record.hold) == (name, "linear")
    assert list(record.outputs) == ["position", "raw"]


def test_data_frame():
    check(Record.from_dataframe(pd.DataFrame(RAW), **WANTED, hold="linear"), "record")


def test_csv(csv):
    path = csv(pd.DataFrame(RAW).to_csv(index=False))
    check(Record.from_csv(path, **WANTED, hold="linear"), "run 7")
    check(Record.from_csv(os.fspath(path), **WANTED, hold="linear", name="valve A"), "valve A")


def test_npz(npz):
    check(Record.from_npz(npz(**RAW), **WANTED, hold="linear"), "run 7")


@pytest.mark.parametrize("shape", [(COUNT, 1), (1, COUNT)])
def test_mat(mat, shape):
    path = mat(**{name: values.reshape(shape) for name, values in RAW.items()})
    check(Record.from_mat(path, **WANTED, hold="linear"), "run 7")


@pytest.mark.parametrize("way", ["dataframe", "csv", "npz", "mat"])
def test_what_a_record_exports_reads_back(way, tmp_path):
    command, position = np.random.default_rng(3).standard_normal((2, 30))
    position[4] = np.nan
    record = Record(0.1 * np.arange(30), {"command": command}, {"position": position})
    frame, path = record.to_dataframe(), tmp_path / "file"
    assert list(frame.columns) == ["time", "command", "position"]
    arrays = {name: frame[name].to_numpy() for name in frame.columns}
    if way == "csv":
        record.to_csv(path)
    elif way != "dataframe":
        with open(path, "wb") as file:
            np.savez(file, **arrays) if way == "npz" else savemat(file, arrays)
    read = getattr(Record, f"from_{way}")
    source = frame if way == "dataframe" else path
    again = read(source, time="time", inputs={"command": "command"}, outputs={"position": "position"})
    np.testing.assert_array_equal(again.time, record.time)
    np.testing.assert_array_equal(again.inputs["command"], command)
    np.testing.assert_array_equal(again.outputs["position"], position)


@settings(deadline=None, max_examples=60)
@given(
    st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=20),
    st.floats(1e-6, 1e6).flatmap(lambda size: st.sampled_from([size, -size])),
    st.floats(-1e6, 1e6),
)
def test_si_value_is_scale_times_raw_plus_offset(raw, scale, offset):
    picked = pick({"u": raw}, "table", time=0.5, inputs={"command": Column("u", scale, offset)}, outputs={})
    assert picked.inputs["command"].tolist() == [scale * value + offset for value in raw]
    assert picked.time.tolist() == [0.5 * k for k in range(len(raw))]


def test_a_sample_period_stands_for_a_time_column():
    frame = pd.DataFrame({"u": [1, 2, 3], "y": [0.0, 1.0, 4.0]})
    record = Record.from_dataframe(frame, **{**PLAIN, "time": 0.25})
    np.testing.assert_array_equal(record.time, [0.0, 0.25, 0.5])


@pytest.mark.parametrize("period", [0.0, -0.1, np.inf, np.nan])
def test_a_sample_period_is_positive(period):
    frame = pd.DataFrame({"u": [1, 2, 3], "y": [0.0, 1.0, 4.0]})
    sentence = refusal(Record.from_dataframe, frame, **{**PLAIN, "time": period})
    assert sentence.startswith(f"time={period} is not a sample period: give a positive number of seconds")
    sentence = refusal(Record.from_dataframe, frame, time=0.1, inputs={}, outputs={})
    assert "needs an input or an output to count the samples of" in sentence


# What is refused in any table


def test_unknown_columns_are_listed_and_the_nearest_named():
    frame = pd.DataFrame({"t": [0, 1], "valve_cmd_V": [0, 1], "position_V": [0, 1]})
    sentence = refusal(Record.from_dataframe, frame, time="t", inputs={"command": "valve_cmd"}, outputs={})
    assert sentence == (
        "unknown column 'valve_cmd' in the data frame (did you mean 'valve_cmd_V'?); "
        "known: 't', 'valve_cmd_V', 'position_V'"
    )


def test_unknown_name():
    assert str(unknown_name("output", "zzz", ["position"])) == "unknown output 'zzz'; known: 'position'"
    assert str(unknown_name("output", "zzz", [])) == "unknown output 'zzz'; known: none"
    many = str(unknown_name("column", "zzz", [f"x{k}" for k in range(100)], "run.csv"))
    assert many.startswith("unknown column 'zzz' in run.csv; known: 'x0', ")
    assert many.endswith("'x29' and 70 more")


@pytest.mark.parametrize(("scale", "offset"), [(0.0, 0.0), (np.nan, 0.0), (np.inf, 0.0), (1.0, np.nan)])
def test_a_conversion_is_finite_and_not_zero(scale, offset):
    inputs = {"command": Column("u", scale, offset)}
    sentence = refusal(pick, {"u": [1.0]}, "x.csv", time=1.0, inputs=inputs, outputs={})
    assert sentence.startswith(f"column 'u' of x.csv has scale {scale}, offset {offset}: give finite numbers")


def test_columns_are_named_by_strings_in_a_mapping(unchecked):
    table = {"u": [1.0, 2.0]}
    sentence = refusal(pick, table, "x.csv", kind=TypeError, time=1.0, inputs={"a": 3}, outputs={})
    assert sentence == "expected a column name or a Column(name, scale, offset), got 3"
    sentence = refusal(pick, table, "x.csv", kind=TypeError, time=None, inputs={"a": "u"}, outputs={})
    assert sentence == "expected a column name or a Column(name, scale, offset), got None"
    sentence = refusal(pick, table, "x.csv", kind=TypeError, time=1.0, inputs=["u"], outputs={})
    assert sentence == "expected inputs as a mapping from signal name to column, got ['u']"


def test_numeric_text_is_not_converted_silently():
    sentence = refusal(vector, "column 'u'", np.array(["1.5", "2.5"]))
    assert sentence.startswith("column 'u' holds '1.5' at sample 0 (dtype <U3): expected real numbers; use ")


# Data frames


def test_nullable_columns_and_integer_names():
    frame = pd.DataFrame(
        {
            0: pd.array([0, 1, 2], dtype="Int64"),
            1: [True, False, True],
            "y": pd.array([0.5, None, 2.5], dtype="Float64"),
            "count": pd.array([5, 6, None], dtype="Int64"),
        }
    )
    outputs = {"position": "y", "count": "count"}
    record = Record.from_dataframe(frame, time="0", inputs={"command": "0"}, outputs=outputs)
    np.testing.assert_array_equal(record.outputs["position"], [0.5, np.nan, 2.5])
    np.testing.assert_array_equal(record.outputs["count"], [5.0, 6.0, np.nan])
    np.testing.assert_array_equal(record.inputs["command"], [0.0, 1.0, 2.0])
    sentence = refusal(Record.from_dataframe, frame, time="0", inputs={"command": "1"}, outputs={})
    assert sentence.startswith("column '1' of the data frame holds 'True' at sample 0 (dtype bool)")


def test_repeated_names_in_a_data_frame():
    frame = pd.DataFrame(np.eye(3), columns=["t", "u", "u"])
    sentence = refusal(frame_table, frame)
    assert sentence == "column 'u' stands more than once in the data frame: rename all but one"


def test_objects_and_dates_in_a_data_frame():
    frame = pd.DataFrame({"t": pd.to_datetime(["2020-01-01", "2020-01-02"]), "u": [{}, []], "y": [1.0, 2.0]})
    sentence = refusal(Record.from_dataframe, frame, **PLAIN)
    assert sentence.startswith("column 'u' of the data frame holds '{}' at sample 0 (dtype object): expected")
    sentence = refusal(Record.from_dataframe, frame, time=1.0, inputs={}, outputs={"position": "t"})
    assert "column 't' of the data frame holds '2020-01-01T" in sentence
    assert "convert the dates to seconds" in sentence


# CSV


def test_options_go_to_pandas(csv):
    path = csv("# a comment\nt;u;y\ns;V;m\n0,0;1;2,5\n0,5;1;3,5\n1,0;1;--\n")
    record = Record.from_csv(path, **PLAIN, sep=";", decimal=",", comment="#", skiprows=[2], na_values="--")
    np.testing.assert_array_equal(record.time, [0.0, 0.5, 1.0])
    np.testing.assert_array_equal(record.outputs["position"], [2.5, 3.5, np.nan])
    record = Record.from_csv(csv("0 1 5\n1 1 6\n"), **PLAIN, sep=" ", header=None, names=["t", "u", "y"])
    np.testing.assert_array_equal(record.outputs["position"], [5.0, 6.0])
    with pytest.raises(TypeError, match="unexpected keyword argument 'separator'"):
        Record.from_csv(path, **PLAIN, separator=";")


# fmt: off
CSV_REFUSED = [
    ("t,u,y\n0,0,0\n1,off,1\n2,0,2\n", "column 'u' of {} holds 'off' at sample 1", "na_values"),
    ("t,u,y\ns,V,m\n0,0,0\n1,1,1\n", "column 'u' of {} holds 'V' at sample 0", "skiprows"),
    ('t,u,y\n0,"0,5",0\n1,"0,7",1\n', "column 'u' of {} holds '0,5' at sample 0", "decimal"),
    ("t,u,y\n0,1+2j,0\n1,1,1\n", "column 'u' of {} holds '1+2j' at sample 0", "expected real numbers"),
    ("t,u,y\n0,True,0\n1,False,1\n", "column 'u' of {} holds 'True' at sample 0", "astype(float)"),
    ("t,u,y\n", "column 'u' of {} is empty", "check the column"),
    ("t,u,y\n0,,0\n1,,1\n", "input 'command' is empty, all 2 samples are NaN", "check the name"),
    ("t,u,y\n0,1,0\n1,,1\n", "input 'command' is nan at sample 1", "fill the gap"),
    ("t,u,y\n0,1,0\n1,1,-inf\n", "output 'position' is -inf at sample 1", "set it to NaN"),
    ("t,u,y,u\n0,1,2,3\n1,1,1,1\n", "column 'u' stands more than once in {}", "rename one"),
    ("t;u;y\n0;1;2\n", "unknown column 'u' in {}", "known: 't;u;y'"),
    ("t,u,y\n0,1,2,3\n1,1,3,3\n", "the rows of {} have more fields than its header", "header=0, names="),
    ("", "{} cannot be read as a text file with columns (it is empty)", "check that its export"),
    ("\n\n", "{} holds no columns", "check skiprows"),
    ("t,u,y\n0,1,2\n1,1,3\n3,1,4\n4,1,4\n", "time is not uniform", "sample 2 comes 2 s after sample 1"),
]
# fmt: on


@pytest.mark.parametrize(("text", "fault", "remedy"), CSV_REFUSED, ids=[case[1] for case in CSV_REFUSED])
def test_csv_refused_with_one_sentence(text, fault, remedy, csv):
    path = csv(text)
    sentence = refusal(Record.from_csv, path, **PLAIN)
    assert sentence.startswith(fault.format(path))
    assert remedy in sentence


def test_names_that_look_repeated_can_be_given(csv):
    path = csv("t,u,u.1\n0,1,5\n1,1,6\n")
    wanted = {"time": "t", "inputs": {"command": "u"}, "outputs": {"position": "u.1"}}
    assert "(or has a neighbour named 'u.1')" in refusal(Record.from_csv, path, **wanted)
    record = Record.from_csv(path, **wanted, header=0, names=["t", "u", "u.1"])
    np.testing.assert_array_equal(record.outputs["position"], [5.0, 6.0])


def test_delimiters_at_the_end_of_rows_shift_no_column(csv):
    record = Record.from_csv(csv("t,u,y\n0,1,5,\n1,1,6,\n2,1,7,\n"), **PLAIN)
    np.testing.assert_array_equal(record.time, [0.0, 1.0, 2.0])
    np.testing.assert_array_equal(record.outputs["position"], [5.0, 6.0, 7.0])


def test_non_uniform_file_can_be_resampled(csv):
    path = csv("t,u,y\n0,1,2\n1,1,3\n3,2,5\n4,2,6\n")
    record = Record.from_csv(path, **PLAIN, uniform=False).resample(1.0)
    np.testing.assert_allclose(record.outputs["position"], [2.0, 3.0, 4.0, 5.0, 6.0], atol=1e-5)


@pytest.mark.parametrize("read", [Record.from_csv, Record.from_npz, Record.from_mat])
def test_missing_and_empty_files(read, tmp_path):
    with pytest.raises(FileNotFoundError):
        read(tmp_path / "nowhere", **PLAIN)
    (tmp_path / "empty").touch()
    sentence = refusal(read, tmp_path / "empty", **PLAIN)
    assert f"{tmp_path / 'empty'} cannot be read as" in sentence and "(it is empty)" in sentence


# NPZ


class Trap:
    """Leave a file behind when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (os.fspath(self.path), "w")


def test_pickled_content_is_never_loaded(npz, tmp_path):
    trap = np.array([Trap(tmp_path / "sprung")] * 3, dtype=object)
    path = npz(t=np.arange(3.0), u=trap, y=np.arange(3.0))
    sentence = refusal(Record.from_npz, path, **PLAIN)
    assert sentence.startswith(f"{path} cannot be read as an NPZ archive in which 'u' is an array of numbers")
    assert "pickled content is never loaded, save it as numbers" in sentence
    record = Record.from_npz(path, time="t", inputs={}, outputs={"position": "y"})  # nor when not asked for
    assert len(record) == 3
    assert not (tmp_path / "sprung").exists()
    with np.load(path, allow_pickle=True) as archive:  # the trap does work
        archive["u"][0].close()
    assert (tmp_path / "sprung").exists()


def test_files_that_are_no_archive(tmp_path):
    np.save(tmp_path / "array.npy", np.arange(3.0))
    (tmp_path / "pickle").write_bytes(pickle.dumps({"t": 1}))
    for name in ("array.npy", "pickle"):
        sentence = refusal(Record.from_npz, tmp_path / name, **PLAIN)
        assert f"{name} cannot be read as an NPZ archive" in sentence and "write one with numpy.savez" in sentence


def test_npz_arrays_have_one_dimension(npz):
    path = npz(t=np.arange(3.0), u=np.ones((3, 1)), y=np.arange(3.0))
    assert "column 'u' of" in refusal(Record.from_npz, path, **PLAIN)
    assert "has shape (3, 1): expected 1-D" in refusal(Record.from_npz, path, **PLAIN)


# MATLAB


def test_structs_by_dotted_name(mat):
    channel = np.empty(2, dtype=object)
    channel[:] = [{"values": POSITION_V}, {"values": COMMAND_MV}]
    path = mat(data={"time": TIME_MS, "deep": {"valve": COMMAND_MV}}, signals=channel, note="a text")
    names = ["data.time", "data.deep.valve", "signals.0.values", "signals.1.values", "note"]
    assert list(mat_table(path)) == names
    record = Record.from_mat(
        path,
        time=Column("data.time", 1e-3),
        inputs={"command": "data.deep.valve", "copy": "signals.1.values"},
        outputs={"position": "signals.0.values"},
    )
    np.testing.assert_array_equal(record.inputs["command"], COMMAND_MV)
    np.testing.assert_array_equal(record.inputs["copy"], COMMAND_MV)
    np.testing.assert_array_equal(record.outputs["position"], POSITION_V)
    sentence = refusal(Record.from_mat, path, time="data.tme", inputs={}, outputs={})
    assert "unknown column 'data.tme' in " in sentence and "did you mean 'data.time'?" in sentence


@pytest.mark.parametrize(
    ("values", "fault"),
    [
        (np.ones((COUNT, 2)), "has shape (50, 2): expected 1-D"),
        ("open", "holds 'open' at sample 0 (dtype <U4): expected real numbers"),
        (COMMAND_MV * 1j, "(dtype complex128): expected real numbers; take its real part"),
        (np.zeros((0, 0)), "is empty: expected one number per sample"),
    ],
)
def test_mat_variables_that_are_no_vectors(values, fault, mat):
    path = mat(t=TIME_MS, x=values)
    sentence = refusal(Record.from_mat, path, time="t", inputs={"command": "x"}, outputs={})
    assert sentence.startswith(f"column 'x' of {path} ")
    assert fault in sentence


def test_mat_files_of_another_kind(tmp_path):
    hdf5 = tmp_path / "new.mat"
    hdf5.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(512))
    sentence = refusal(Record.from_mat, hdf5, **PLAIN)
    assert (
        sentence.startswith(f"{hdf5} cannot be read as a MATLAB v7.3 (HDF5) file")
        and "save(file, ..., '-v7')" in sentence
    )
    text = tmp_path / "text.mat"
    text.write_text("this is no MATLAB file, but long enough to look at. " * 10)
    assert f"{text} cannot be read as a MATLAB file" in refusal(Record.from_mat, text, **PLAIN)
