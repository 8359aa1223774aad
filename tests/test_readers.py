"""Excel, parquet, MATLAB -v7.3, dates as time, text from other countries; what is said when a file cannot be had."""

import datetime
import errno
import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from ehsvjax import Column, Record, files
from ehsvjax.clock import seconds_of
from ehsvjax.files import reading
from tests.test_columns import PLAIN, RAW, WANTED, check, refusal

h5py = pytest.importorskip("h5py")
pytest.importorskip("openpyxl")
pytest.importorskip("pyarrow")
SMALL = pd.DataFrame({"t": [0.0, 0.5, 1.0], "u": [1.0, 2.0, 3.0], "y": [4.0, np.nan, 6.0]})


def test_excel(tmp_path):
    path = tmp_path / "run 7.xlsx"
    with pd.ExcelWriter(path) as workbook:
        pd.DataFrame({"remarks": ["none"]}).to_excel(workbook, sheet_name="notes")
        pd.DataFrame(RAW).to_excel(workbook, sheet_name="data", index=False, startrow=2)
    record = Record.from_excel(path, **WANTED, hold="linear", sheet_name="data", skiprows=2)
    np.testing.assert_allclose(record.outputs["raw"], RAW["position_V"], rtol=1e-14)  # Excel keeps 15 digits
    check(replace(record, outputs={**record.outputs, "raw": RAW["position_V"]}), "run 7")
    assert "unknown column 't_ms' in" in refusal(Record.from_excel, path, **{**WANTED, "inputs": {}, "outputs": {}})
    sentence = refusal(Record.from_excel, path, **WANTED, sheet_name="Data")
    assert f"{path} cannot be read as an Excel workbook" in sentence and "check sheet_name" in sentence
    sentence = refusal(Record.from_excel, path, **WANTED, sheet_name=None, kind=TypeError)
    assert sentence.startswith("expected one pandas data frame, got dict")
    with pytest.raises(TypeError, match=r"'sheet': pandas.read_excel has no such, did you mean 'sheet_name'\?"):
        Record.from_excel(path, **WANTED, sheet="data")


def test_parquet(tmp_path):
    path = tmp_path / "run 7.parquet"
    pd.DataFrame(RAW).set_index("t_ms").to_parquet(path)  # a column all the same
    check(Record.from_parquet(path, **WANTED, hold="linear"), "run 7")
    check(Record.from_dataframe(pd.DataFrame(RAW).set_index("t_ms"), **WANTED, hold="linear"), "record")
    assert "unknown column 'x' in" in refusal(Record.from_parquet, path, time="x", inputs={}, outputs={})


def v73(path, **arrays):
    """Write a file as MATLAB -v7.3 does: arrays transposed, structs as groups, cells as references, classes by name."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in arrays.items():
            dataset = file.create_dataset(name, data=value)
            dataset.attrs["MATLAB_class"] = np.bytes_("double")
    with open(path, "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")
    return path


@pytest.mark.parametrize("shape", [(1, -1), (-1, 1)])
def test_matlab_7_3(shape, tmp_path):
    path = v73(tmp_path / "run 7.mat", **{name: np.reshape(values, shape) for name, values in RAW.items()})
    check(Record.from_mat(path, **WANTED, hold="linear"), "run 7")


def test_structs_cells_and_texts_of_matlab_7_3(tmp_path):
    path = v73(tmp_path / "run.mat", **{"data/t": [[0.0, 1.0, 2.0]], "#refs#/a": [[5.0, 6.0, 8.0]]})
    with h5py.File(path, "r+") as file:
        file["cell"] = np.array([[file["#refs#/a"].ref]], dtype=h5py.ref_dtype)
        for name, kind, values in (
            ("note", "char", np.array([[111], [112]], np.uint16)),
            ("on", "logical", np.array([[1, 0, 1]], np.uint8)),
            ("none", "double", np.array([0, 0], np.uint64)),
            ("when", "datetime", np.array([[1, 2, 3]], np.uint32)),
            ("wide", "double", np.ones((2, 3))),
            ("wave", "double", np.ones((1, 3), [("real", float), ("imag", float)])),
            ("odd", "double", np.ones((1, 3), np.longdouble)),
        ):
            file[name] = values
            file[name].attrs["MATLAB_class"] = np.bytes_(kind)
        file["none"].attrs["MATLAB_empty"] = 1
        file["when"].attrs["MATLAB_object_decode"] = 3
    record = Record.from_mat(path, time="data.t", inputs={}, outputs={"position": "cell.0"})
    np.testing.assert_array_equal(record.outputs["position"], [5.0, 6.0, 8.0])
    for name, fault in (
        ("note", "holds 'op' at sample 0"),
        ("on", "holds 'True' at sample 0"),
        ("none", "is empty"),
        ("when", "holds 'a datetime of MATLAB'"),
        ("wide", "has shape (3, 2)"),
        ("wave", "holds '(1+1j)' at sample 0"),
    ):
        assert f"column {name!r} of {path} {fault}" in refusal(
            Record.from_mat, path, time="data.t", inputs={}, outputs={"position": name}
        )
    assert "an array of class double whose numbers are stored as" in refusal(
        Record.from_mat, path, time="odd", inputs={}, outputs={}
    )
    sentence = refusal(Record.from_mat, path, time="x", inputs={}, outputs={})
    assert "'#refs#" not in sentence and "known: 'cell.0', 'data.t', " in sentence


@pytest.mark.parametrize(
    ("library", "read", "purpose"),
    [
        ("openpyxl", Record.from_excel, "reading Excel"),
        ("pyarrow.parquet", Record.from_parquet, "reading parquet"),
        ("h5py", Record.from_mat, "reading MATLAB -v7.3"),
    ],
)
def test_what_is_not_installed_is_named(library, read, purpose, tmp_path, monkeypatch):
    path = v73(tmp_path / "run.mat", t=[[1.0, 2.0]])
    monkeypatch.setitem(sys.modules, library, None)
    sentence = refusal(read, path, **PLAIN, kind=ImportError)
    assert sentence.startswith(f"{purpose} needs {library.split('.')[0]}, which is not installed: pip install")


# Dates and clock times

START = pd.Timestamp("2024-03-31T00:59:59.25")  # a second before clocks were put forward
STAMPS = START + pd.to_timedelta([0, 500, 1000], unit="ms")


@pytest.mark.parametrize(
    "stamps",
    [
        STAMPS,
        STAMPS.tz_localize("UTC").tz_convert("Europe/Berlin"),
        STAMPS.to_numpy("datetime64[ns]"),
        [stamp.to_pydatetime() for stamp in STAMPS],
        [stamp.isoformat() for stamp in STAMPS],
        [f"{stamp:%Y-%m-%d %H:%M:%S.%f}" for stamp in STAMPS],
        [stamp.isoformat() for stamp in STAMPS.tz_localize("UTC").tz_convert("Europe/Berlin")],
        [f"{stamp:%H:%M:%S.%f}" for stamp in STAMPS],
        [stamp.time() for stamp in STAMPS],
        pd.to_timedelta([0, 500, 1000], unit="ms"),
        np.array([0, 500, 1000], dtype="timedelta64[ms]"),
        [datetime.timedelta(milliseconds=500 * k) for k in range(3)],
    ],
)
def test_dates_and_clock_times_are_seconds_from_the_first(stamps):
    record = Record.from_dataframe(SMALL.assign(t=stamps), **PLAIN)
    np.testing.assert_array_equal(record.time, [0.0, 0.5, 1.0])
    record = Record.from_dataframe(SMALL.assign(t=stamps), **{**PLAIN, "time": Column("t", offset=5.0)})
    np.testing.assert_array_equal(record.time, [5.0, 5.5, 6.0])
    sentence = refusal(Record.from_dataframe, SMALL.assign(t=stamps), **{**PLAIN, "time": Column("t", 1e-3)})
    assert "holds dates or times, counted in s already: leave out its scale of 0.001" in sentence


def test_stamps_are_exact_to_a_nanosecond():
    stamps = np.datetime64("2024-01-01T12:00:00", "ns") + np.arange(0, 86_400_000_000_007, 1_000_000_001)
    np.testing.assert_array_equal(seconds_of(stamps), 1_000_000_001 * np.arange(len(stamps)) / 1e9)


def test_time_differences_keep_their_start():
    np.testing.assert_array_equal(seconds_of(np.array([7, 8], dtype="timedelta64[s]")), [7.0, 8.0])


@pytest.mark.parametrize(
    "values",
    [
        np.arange(3.0),
        ["0", "1", "2"],
        ["2020", "2021"],
        ["5 m", "6 m"],
        ["01.02.2024 10:00:00", "01.02.2024 10:00:01"],
        ["0.5-1.5-2", "a-b-c"],
        [None, 3],
        [["12:00:00"]],
        [],
        ["12:61:00:99"],
    ],
)
def test_what_is_no_time_is_left_to_be_refused(values):
    assert seconds_of(np.array(values, dtype=object if isinstance(values, list) else None)) is None


def test_a_missing_stamp_is_named(tmp_path):
    (tmp_path / "x.csv").write_text("t,u,y\n2024-01-01 10:00:00,1,2\n,1,3\n2024-01-01 10:00:02,1,4\n")
    assert refusal(Record.from_csv, tmp_path / "x.csv", **PLAIN).startswith("time is nan at sample 1")


@pytest.mark.parametrize("way", ["csv", "excel", "parquet"])
def test_dates_in_files(way, tmp_path):
    path, table = tmp_path / "file", SMALL.assign(t=STAMPS)
    if way == "excel":
        path = path.with_suffix(".xlsx")
    {"csv": table.to_csv, "excel": table.to_excel, "parquet": table.to_parquet}[way](path, index=False)
    record = getattr(Record, f"from_{way}")(path, **PLAIN)
    np.testing.assert_allclose(record.time, [0.0, 0.5, 1.0], rtol=0, atol=1e-9)


# Text from elsewhere: each sentence names the argument with which the file is read


@pytest.mark.parametrize(
    ("content", "said", "options"),
    [
        (b"t;u;y\n0,0;1;4\n0,5;2;\n1,0;3;6\n", "sep=';', and decimal=','", {"sep": ";", "decimal": ","}),
        (b"t;u;y\n0;1;4\n0.5;2;\n1;3;6\n", "sep=';'", {"sep": ";"}),
        (b"t\tu\ty\n0\t1\t4\n0.5\t2\t\n1\t3\t6\n", r"sep='\t'", {"sep": "\t"}),
        ("t,u,y,µ\n0,1,4,\n0.5,2,,\n1,3,6,\n".encode("latin-1"), "encoding='latin-1'", {"encoding": "latin-1"}),
        ("t,u,y\n0,1,4\n0.5,2,\n1,3,6\n".encode("utf-16"), "'utf-16'", {"encoding": "utf-16"}),
        (b"t,u,y\ns,V,m\n0,1,4\n0.5,2,\n1,3,6\n", "skiprows=[1]", {"skiprows": [1]}),
        (
            b'"t";"u";"y"\n"s";"V";"m"\n0,0;1;4\n0,5;2;\n1,0;3;6\n',
            "sep=';'",
            {"sep": ";", "decimal": ",", "skiprows": [1]},
        ),
        (b"t;u;y\n0,0;1,0;4\n0,5;2,0;\n1,0;3,0;6\n", "sep=';'", {"sep": ";", "decimal": ","}),
        (
            b"t,u,y\n31.01.2024 23:59:59.5,1,4\n01.02.2024 00:00:00,2,\n01.02.2024 00:00:00.5,3,6\n",
            "parse_dates=",
            {"parse_dates": ["t"], "date_format": {"t": "%d.%m.%Y %H:%M:%S.%f"}},
        ),
    ],
)
def test_the_sentence_names_the_argument_that_helps(content, said, options, tmp_path):
    path = tmp_path / "run.csv"
    path.write_bytes(content)
    assert said in refusal(Record.from_csv, path, **PLAIN)
    if "parse_dates" in options:
        content = content.replace(b"00:00:00,2", b"00:00:00.0,2")  # strptime's %f is strict
        path.write_bytes(content)
    record = Record.from_csv(path, **PLAIN, **options)
    np.testing.assert_array_equal(record.time, SMALL["t"])
    np.testing.assert_array_equal(record.outputs["position"], SMALL["y"])


def test_decimal_commas_alone(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("t;u;y\n0,0;1,5;4\n0,5;2,5;\n1,0;3,5;6\n")
    assert "holds '1,5' at sample 0" in (sentence := refusal(Record.from_csv, path, **PLAIN, sep=";"))
    assert sentence.endswith("decimal=',' reads a decimal comma")


def test_a_byte_order_mark_and_strange_names_survive(tmp_path):
    names = ["t", "$u_1$ <b>&", "位置 µ°"]
    path = tmp_path / "run $x$.csv"
    SMALL.set_axis(names, axis="columns").to_csv(path, index=False, encoding="utf-8-sig")
    record = Record.from_csv(path, time="t", inputs={names[1]: names[1]}, outputs={names[2]: names[2]})
    assert (list(record.inputs), list(record.outputs), record.name) == (names[1:2], names[2:], "run $x$")
    assert all(name in repr(record) for name in names[1:])


# Files that cannot be had

READERS = [Record.from_csv, Record.from_npz, Record.from_mat, Record.from_excel, Record.from_parquet]


@pytest.mark.parametrize("read", READERS)
def test_no_file_a_folder_and_no_path(read, tmp_path, unchecked):
    sentence = refusal(read, tmp_path / "nowhere", **PLAIN, kind=FileNotFoundError)
    assert sentence.startswith(f"{tmp_path / 'nowhere'} cannot be opened (no such file or directory): check its name")
    assert "(is a directory)" in refusal(read, tmp_path, **PLAIN, kind=IsADirectoryError)
    for path in (3, None, b"x", SMALL, ["x"]):
        sentence = refusal(read, path, **PLAIN)
        assert sentence.startswith("expected path to be the path of ") and "give a string or a pathlib.Path" in sentence
    assert "expected path to be the path of " in refusal(read, "a\0b", **PLAIN)
    assert "cannot be opened (file name too long)" in refusal(read, "x" * 5000, **PLAIN, kind=OSError)


def test_a_file_that_may_not_be_read(tmp_path, monkeypatch):
    def forbidden(path, mode):
        raise PermissionError(errno.EACCES, "Permission denied", path)

    monkeypatch.setattr(files, "open", forbidden, raising=False)  # root may read everything
    assert "permission denied" in refusal(Record.from_csv, tmp_path / "x.csv", **PLAIN, kind=PermissionError)


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        EOFError("x"),
        RecursionError("too\ndeep"),
        OverflowError("y" * 1000),
        OSError(22, "Invalid"),
        KeyError("z"),
    ],
)
def test_whatever_is_raised_becomes_one_line(error, tmp_path):
    (tmp_path / "file").write_bytes(b"x")
    with pytest.raises(ValueError) as refused, reading(tmp_path / "file", "a fit", "save it again"):
        raise error
    sentence = str(refused.value)
    assert sentence.startswith(f"{tmp_path / 'file'} cannot be read as a fit ({type(error).__name__}")
    assert sentence.endswith("): save it again") and "\n" not in sentence and len(sentence) < 500


def test_interrupts_pass(tmp_path):
    (tmp_path / "file").write_bytes(b"x")
    with pytest.raises(KeyboardInterrupt), reading(tmp_path / "file", "a fit", "save it again"):
        raise KeyboardInterrupt
