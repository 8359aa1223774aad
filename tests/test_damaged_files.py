"""A few hundred damaged files of every kind that is read; benchmarks/damaged_files.py has thousands."""

import numpy as np
import pytest
from scipy.io import savemat

from benchmarks.damaged_files import COLUMNS, KINDS, frame, outcome, signals, write_hdf5
from ehsvjax import Record
from ehsvjax.mat5 import check_elements
from tests.test_columns import PLAIN, refusal

FILES = 30


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Hold a sound file of each kind, to be damaged or to be mistaken for another."""
    place = tmp_path_factory.mktemp("whole")
    for kind in KINDS:
        KINDS[kind].write(place / f"whole{KINDS[kind].suffix}")
        (place / f"whole{KINDS[kind].suffix}").rename(place / kind)
    return place


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_are_refused_in_a_sentence_or_read_as_they_were(kind, folder):
    found = [outcome(kind, number, 0, folder) for number in range(FILES)]
    wrong = [(number, *one) for number, one in enumerate(found) if one[0] in ("raw", "nonsense")]
    assert not wrong
    assert sum(what == "refused" for what, _ in found) > FILES / 3  # the mutations do harm


def test_a_sound_file_is_read_as_it_was_written(folder):
    for kind in KINDS.keys() - {"fit", "checkpoint"}:  # which have tests of their own
        for read, written in zip(KINDS[kind].read(folder / kind), signals().values(), strict=True):
            np.testing.assert_array_equal(read, written, err_msg=kind)


# What SciPy and HDF5 do not look at themselves


@pytest.fixture
def mat(tmp_path):
    """Write three vectors and a cell, uncompressed, and return the path."""
    path = tmp_path / "run.mat"
    cell = np.array([np.arange(3.0), "text"], dtype=object)
    savemat(path, {"t": np.arange(5.0), "u": np.ones(5), "y": np.arange(5.0), "c": cell})
    return path


@pytest.mark.parametrize("kind", [0, 8, 10, 11, 14, 15, 19, 20, 4000])
def test_types_that_scipy_would_follow_out_of_its_memory(kind, mat):
    content = bytearray(mat.read_bytes())
    place = content.index(np.arange(5.0).tobytes()) - 8
    assert int.from_bytes(content[place : place + 4], "little") == 9  # of float64
    content[place : place + 4] = kind.to_bytes(4, "little")
    with pytest.raises(ValueError):
        check_elements(bytes(content))
    mat.write_bytes(content)
    assert "cannot be read as a MATLAB file" in refusal(Record.from_mat, mat, **PLAIN)


def test_sizes_beyond_the_file_are_refused_before_memory_is_asked_for(mat):
    content = bytearray(mat.read_bytes())
    place = content.index((1).to_bytes(4, "little") + (2).to_bytes(4, "little"), content.index(b"\x01\x00\x01\x00y"))
    content[place : place + 8] = (40_000).to_bytes(4, "little") * 2
    mat.write_bytes(content)
    assert "an array of sizes (40000, 40000)" in refusal(Record.from_mat, mat, **PLAIN)


def test_values_that_the_index_of_hdf5_has_lost_are_no_zeros(tmp_path):
    path = tmp_path / "run.mat"
    write_hdf5(path, compression="gzip")
    content = bytearray(path.read_bytes())
    place = content.index(b"TREE\x01\x00\x01\x00")  # the index of the chunks of the first array
    end = content.index((1).to_bytes(8, "little") + (60).to_bytes(8, "little"), place)
    content[end : end + 24] = bytes(24)  # how far its only chunk reaches
    path.write_bytes(content)
    sentence = refusal(Record.from_mat, path, time="t", inputs={"command": "u"}, outputs={"position": "y"})
    assert "cannot be read as a MATLAB v7.3 (HDF5) file" in sentence


# Texts


def test_rows_that_are_cut_off_are_refused(tmp_path):
    path = tmp_path / "run.csv"
    whole = frame().to_csv(index=False).encode()
    path.write_bytes(whole[: whole.rindex(b",")])
    sentence = refusal(Record.from_csv, path, **COLUMNS)
    assert f"{path} has a row with fewer fields than columns, '0.118," in sentence and "cut off" in sentence


@pytest.mark.parametrize(
    ("text", "options"),
    [
        ("t,u,y\n0,1,2\n1,1,\n2,1,3\n", {}),  # an empty field is a missing value
        ("0 1 2\n1 1 nan\n2 1 3\n", {"sep": r"\s+", "names": ["t", "u", "y"]}),
        ("run 7\n\nt;u;y\n0;1;2\n1;1;\n2;1;3\n", {"sep": ";", "skiprows": 1}),
        ("# run 7\nt,u,y\n0,1,2\n1,1,\n# a pause\n2,1,3\nend\n", {"comment": "#", "skipfooter": 1, "engine": "python"}),
        ('t,u,y,note\n0,1,2,"a, b"\n1,1,,\n2,1,3,\n', {}),
    ],
)
def test_rows_with_missing_values_are_whole(text, options, tmp_path):
    path = tmp_path / "run.csv"
    path.write_text(text)
    record = Record.from_csv(path, **PLAIN, **options)
    np.testing.assert_array_equal(record.outputs["position"], [2.0, np.nan, 3.0])
