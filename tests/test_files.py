"""Files are written whole or not at all, and one whose content was altered is refused in one sentence."""

import resource
import threading
import zipfile

import numpy as np
import pytest

from ehsvjax.files import reading, written_whole
from ehsvjax.sealed import read_sealed, write_sealed
from tests import hand_made

WHAT, REMEDY = "a table of numbers", "export it again"


def _written(path, content):
    with written_whole(path) as file:
        file.write(content)


def _names(folder):
    return sorted(p.name for p in folder.iterdir())


def _failing(path):
    with written_whole(path) as file:
        file.write(b"half of the new")
        raise RuntimeError


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "table"
    _written(path, b"old")
    with pytest.raises(RuntimeError):
        _failing(path)
    assert path.read_bytes() == b"old"
    assert _names(tmp_path) == ["table"]


def test_a_full_disk_keeps_the_fit_that_was_there(tmp_path):
    path = tmp_path / "fit.npz"
    hand_made.fit().save(path)
    before = path.read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.raises(OSError, match="fit.npz"):
            hand_made.fit().save(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == before
    assert _names(tmp_path) == ["fit.npz"]


def test_threads_that_write_one_file_at_once_leave_a_whole_one(tmp_path):
    contents = [bytes([65 + i]) * 100_000 for i in range(4)]
    failed = []

    def write(content):
        try:
            for _ in range(20):
                _written(tmp_path / "one", content)
        except OSError as error:
            failed.append(error)

    threads = [threading.Thread(target=write, args=(content,)) for content in contents]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failed == []
    assert (tmp_path / "one").read_bytes() in contents
    assert _names(tmp_path) == ["one"]


def test_a_link_stays_a_link_and_permissions_stay(tmp_path):
    target, link = tmp_path / "target", tmp_path / "link"
    _written(target, b"old")
    target.chmod(0o640)
    link.symlink_to(target)
    _written(link, b"new")
    assert link.is_symlink()
    assert target.read_bytes() == b"new"
    assert target.stat().st_mode & 0o777 == 0o640


def test_what_is_no_ordinary_file_is_not_replaced(tmp_path):
    _written("/dev/null", b"anything")
    with open("/dev/null", "rb") as file:
        assert file.read() == b""
    with pytest.raises(FileNotFoundError, match="expected the folder of .* make .*missing first"):
        _written(tmp_path / "missing" / "table", b"")


@pytest.mark.parametrize("error", [zipfile.BadZipFile("two\nlines"), EOFError(), MemoryError("much"), OSError("odd")])
def test_whatever_a_library_raises_becomes_one_sentence(error, tmp_path):
    (tmp_path / "a.csv").write_bytes(b"x")
    said = r"a.csv cannot be read as a table of numbers \(.*\): export it again"
    with pytest.raises(ValueError, match=said) as refused, reading(tmp_path / "a.csv", WHAT, REMEDY):
        raise error
    assert "\n" not in str(refused.value)
    nowhere = reading(tmp_path / "nowhere.csv", WHAT, REMEDY)
    with pytest.raises(FileNotFoundError, match="nowhere.csv cannot be opened"), nowhere:
        pytest.fail("read")


def _sealed(path, **changed):
    arrays = {"a": np.arange(3.0), "b": np.array([True])} | changed
    write_sealed(path, "table", {"name": "bench"}, arrays)
    return path


def test_a_sealed_file_comes_back(tmp_path):
    facts, arrays = read_sealed(_sealed(tmp_path / "t"), "table", WHAT, REMEDY)
    assert facts == {"name": "bench"}
    np.testing.assert_array_equal(arrays["a"], np.arange(3.0))
    assert arrays["b"].dtype == bool


@pytest.mark.parametrize(
    "changed", [{"array/a": np.arange(3.0) + 1e-9}, {"array/a": np.arange(3)}, {"array/c": np.ones(1)}]
)
def test_altered_content_is_refused(tmp_path, changed):
    with np.load(_sealed(tmp_path / "t")) as file:
        everything = dict(file.items())
    # Written anew by NumPy: every checksum of the archive is right.
    with open(tmp_path / "t", "wb") as file:
        np.savez(file, **everything | changed)
    with pytest.raises(ValueError, match=r"t cannot be read as a table .* \(its content was altered.*: export it"):
        read_sealed(tmp_path / "t", "table", WHAT, REMEDY)


def test_a_text_that_says_another_thing_is_refused(tmp_path):
    with np.load(_sealed(tmp_path / "t")) as file:
        everything = dict(file.items())
    for old, new, said in (
        (b"bench", b"benck", "altered"),
        (b'"version": 2', b'"version": 3', "layout 3"),
        (b'"table"', b'"chair"', "altered"),
    ):
        content = everything["content"].tobytes().replace(old, new)
        with open(tmp_path / "t", "wb") as file:
            np.savez(file, **everything | {"content": np.frombuffer(content, np.uint8)})
        with pytest.raises(ValueError, match=said):
            read_sealed(tmp_path / "t", "table", WHAT, REMEDY)


def test_a_file_of_another_kind_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"t cannot be read as a table of numbers \(it holds a table\): export"):
        read_sealed(_sealed(tmp_path / "t"), "fit", WHAT, REMEDY)


def _read(path):
    """Return the content, or the sentence of a refusal."""
    try:
        return read_sealed(path, "table", WHAT, REMEDY)
    except ValueError as refused:
        return str(refused)


def test_no_byte_can_be_altered_without_a_sentence_or_the_same_content(tmp_path):
    whole = _sealed(tmp_path / "t").read_bytes()
    rng = np.random.default_rng(0)
    for place in rng.choice(len(whole), 300, replace=False):
        damaged = bytearray(whole)
        damaged[place] ^= int(rng.integers(1, 256))
        (tmp_path / "t").write_bytes(bytes(damaged[: place if rng.random() < 0.1 else None]))
        found = _read(tmp_path / "t")
        if isinstance(found, str):
            assert found.startswith(f"{tmp_path / 't'} cannot be read as a table of numbers (")
        else:
            assert found.facts == {"name": "bench"}
            np.testing.assert_array_equal(found.arrays["a"], np.arange(3.0))
