"""What becomes of damaged files? Thousands of them, of every kind that is read, each told in one sentence or counted.

    python benchmarks/damaged_files.py [--files 10000] [--seed 0] [--kinds csv npz ...]

A file is written, harmed in one of the ways of benchmarks/mutations.py (or replaced by a file of another kind) and read
in a process apart. What comes of it:

refused     ValueError, TypeError, OSError or ImportError, raised by this package, in one line.
as it was   read, with the numbers of the file before it was harmed.
undetected  read with other numbers, and nothing in the file says that they are wrong: another digit of a text, a bit
            of a format without checksums (MATLAB -v6, HDF5 without filters, parquet without page checksums).
nonsense    read with other numbers although the file shows it: one whose numbers are all under a checksum (NPZ, Excel,
            MATLAB -v7 and -v7.3 as MATLAB writes them, parquet with page checksums, fits, checkpoints), or a text whose
            lines, split at commas and each with as many fields as the header, are not the numbers that were read.
raw         any other error.
crash       the process died, or was silent for 60 s.
"""

import argparse
import csv
import io
import json
import os
import selectors
import subprocess
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).parents[1]))

import ehsvjax
from benchmarks import mutations

OUTCOMES = ("refused", "as it was", "undetected", "nonsense", "raw", "crash")
HEADER = ["t [s]", "u [V]", "y [µm]"]
COLUMNS = {"time": HEADER[0], "inputs": {"command": HEADER[1]}, "outputs": {"position": HEADER[2]}}
FIELDS = {"time": "t", "inputs": {"command": "u"}, "outputs": {"position": "y"}}
OWN = Path(ehsvjax.__file__).parent


class Kind(NamedTuple):
    """How a kind of file is written and read, and whether all its numbers are under checksums."""

    suffix: str
    write: Callable[[Path], object]
    read: Callable[[Path], list[np.ndarray]]
    checked: bool


def signals() -> dict[str, np.ndarray]:
    """Return 60 samples, one of them missing."""
    random = np.random.default_rng(1)
    position = np.round(random.normal(0.0, 50.0, 60), 4)
    position[7] = np.nan
    return {"t": np.round(0.002 * np.arange(60), 3), "u": np.round(random.uniform(-9.0, 9.0, 60), 4), "y": position}


def frame() -> pd.DataFrame:
    return pd.DataFrame(dict(zip(HEADER, signals().values(), strict=True)))


def write_hdf5(path: Path, **options: Any) -> None:
    """Write a MATLAB -v7.3 file: HDF5 behind 512 bytes of MATLAB's."""
    import h5py

    with h5py.File(path, "w", userblock_size=512, libver="earliest") as file:
        for name, values in signals().items():
            dataset = file.create_dataset(name, data=values[None, :], **options)
            dataset.attrs["MATLAB_class"] = np.bytes_("double")
    content = path.read_bytes()
    path.write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM" + content[128:])


def write_mat(path: Path, compressed: bool) -> None:
    from scipy.io import savemat
    from scipy.sparse import csc_array

    cell = np.array([np.arange(5.0), "text"], dtype=object)
    more = {"log": {"deep": {"x": np.arange(4.0) * 1j}}, "cell": cell, "sparse": csc_array(np.eye(5))}
    savemat(path, signals() | more, do_compression=compressed)


def write_parquet(path: Path, checked: bool) -> None:
    import pyarrow
    from pyarrow import parquet

    parquet.write_table(pyarrow.Table.from_pandas(frame()), path, write_page_checksum=checked)


def write_checkpoint(path: Path) -> None:
    path.unlink(missing_ok=True)
    read_checkpoint(path)


def arrays_of(record: ehsvjax.Record) -> list[np.ndarray]:
    return [record.time, *record.inputs.values(), *record.outputs.values()]


def reader(name: str, columns: dict) -> Callable[[Path], list[np.ndarray]]:
    return lambda path: arrays_of(getattr(ehsvjax.Record, name)(path, **columns))


def read_fit(path: Path) -> list[np.ndarray]:
    """Return all numbers and texts of a fit."""
    from tests.hand_made import amplifier

    fit = ehsvjax.Fit.load(path, amplifier())
    facts = (fit.parameters, fit.initial, fit.noise_variance, fit.effort, fit.warnings, fit.huber, fit.model.parameters)
    history = [*fit.history[:-1], *fit.history.best.values()]
    return [np.array(repr(facts)), *history, *(array for record in fit.records for array in arrays_of(record))]


def read_checkpoint(path: Path) -> list[np.ndarray]:
    """Go on with a search from its checkpoint, which is written if there is none."""
    import jax

    from ehsvjax.search import search

    sizes = {"unknowns": 2, "population": 8, "generations": 3}
    cost = jax.tree_util.Partial(sum_of_squares)
    key = jax.random.key(0)
    both = search(cost, key, **sizes, operators=ehsvjax.Operators(), tolerance=0.0, checkpoint=path)
    plain = [
        jax.random.key_data(a) if jax.dtypes.issubdtype(a.dtype, jax.dtypes.prng_key) else a
        for a in jax.tree.leaves(both)
    ]
    return [np.asarray(array) for array in plain]


def sum_of_squares(population):
    return (population**2).sum(axis=1)


def write_fit(path: Path) -> None:
    from tests.hand_made import fit

    fit().save(path)


KINDS = {
    "csv": Kind(".csv", lambda path: frame().to_csv(path, index=False), reader("from_csv", COLUMNS), False),
    "npz": Kind(".npz", lambda path: np.savez(path, **signals()), reader("from_npz", FIELDS), True),
    "npz, compressed": Kind(
        ".npz", lambda path: np.savez_compressed(path, **signals()), reader("from_npz", FIELDS), True
    ),
    "mat -v6": Kind(".mat", lambda path: write_mat(path, False), reader("from_mat", FIELDS), False),
    "mat -v7": Kind(".mat", lambda path: write_mat(path, True), reader("from_mat", FIELDS), True),
    "mat -v7.3": Kind(".mat", lambda path: write_hdf5(path, compression="gzip"), reader("from_mat", FIELDS), True),
    "mat -v7.3, plain": Kind(".mat", write_hdf5, reader("from_mat", FIELDS), False),
    "xlsx": Kind(".xlsx", lambda path: frame().to_excel(path, index=False), reader("from_excel", COLUMNS), True),
    "parquet": Kind(".parquet", lambda path: write_parquet(path, True), reader("from_parquet", COLUMNS), True),
    "parquet, plain": Kind(".parquet", lambda path: write_parquet(path, False), reader("from_parquet", COLUMNS), False),
    "fit": Kind(".npz", write_fit, read_fit, True),
    "checkpoint": Kind(".npz", write_checkpoint, read_checkpoint, True),
}


def outcome(kind: str, number: int, seed: int, folder: Path, kinds: Sequence[str] = tuple(KINDS)) -> tuple[str, str]:
    """Harm the file of that number, or take one of another of the kinds; read it and say what came of it, and how."""
    random = np.random.default_rng([seed, list(KINDS).index(kind), number])
    ways = mutations.ANY + (mutations.OF_TEXT if kind == "csv" else ()) + (None,)
    way = ways[number % len(ways)]
    others = [other for other in kinds if other != kind]
    if way is None:
        name, harmed = "of another kind", (folder / others[random.integers(len(others))]).read_bytes()
    else:
        name, harmed = way.__name__, way(random, (folder / kind).read_bytes())
    path = folder / f"harmed{KINDS[kind].suffix}"
    path.write_bytes(harmed)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            arrays = KINDS[kind].read(path)
    except BaseException as error:
        is_own = Path(traceback.extract_tb(error.__traceback__)[-1].filename).is_relative_to(OWN)
        plain = type(error).__module__ == "builtins" and isinstance(
            error, ValueError | TypeError | OSError | ImportError
        )
        said = is_own and plain and not isinstance(error, UnicodeError) and "\n" not in str(error)
        return "refused" if said else "raw", f"{name}: {type(error).__name__}: {str(error)[:300]}"
    if same(arrays, KINDS[kind].read(folder / kind)):
        return "as it was", name
    if kind == "csv":
        says = numbers_of(harmed)
        return "undetected" if says is not None and same(arrays, says) else "nonsense", name
    return "nonsense" if KINDS[kind].checked else "undetected", name


def same(one: list[np.ndarray], other: list[np.ndarray]) -> bool:
    """Whether all arrays are alike, to the rounding of reading decimals."""
    if len(one) != len(other):
        return False
    pairs = list(zip(one, other, strict=True))
    if any(a.shape != b.shape for a, b in pairs):
        return False
    return all(
        np.allclose(a, b, rtol=1e-14, atol=0.0, equal_nan=True) if a.dtype.kind == "f" else np.array_equal(a, b)
        for a, b in pairs
    )


def numbers_of(content: bytes) -> list[np.ndarray] | None:
    """Return what a text says if one reads it strictly, field by field; None if it cannot be read so."""
    missing = {"": "nan", "n/a": "nan"}
    try:
        rows = [row for row in csv.reader(io.StringIO(content.decode("utf-8-sig"), newline=None)) if row]
        if rows[0] != HEADER or any(len(row) != len(HEADER) for row in rows):
            return None
        values = np.array([[float(missing.get(field, field)) for field in row] for row in rows[1:]])
    except (ValueError, IndexError, csv.Error):
        return None
    return list(values.T)


def work(kind: str, first: int, last: int, seed: int, folder: Path) -> None:
    """Print one line of JSON before and one after each file."""
    for number in range(first, last):
        print(json.dumps([number]), flush=True)
        print(json.dumps([number, *outcome(kind, number, seed, folder)]), flush=True)


def outcomes(kind: str, count: int, seed: int, folder: Path) -> list[tuple[str, str]]:
    """Return what came of each file, read in a process that is begun anew behind a file that killed it."""
    found: list[tuple[str, str]] = []
    while len(found) < count:
        begin = [sys.executable, __file__, "--worker", kind, str(len(found)), str(count)]
        begin += ["--seed", str(seed), "--folder", str(folder)]
        with subprocess.Popen(begin, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
            found += list(_lines(process))
            process.kill()
        if len(found) < count:
            found.append(("crash", f"number {len(found)}, exit status {process.returncode}"))
    return found


def _lines(process: subprocess.Popen):
    """Yield outcomes as they come, until the process ends or is silent for 60 s."""
    assert process.stdout is not None
    selector = selectors.DefaultSelector()
    selector.register(process.stdout, selectors.EVENT_READ)
    rest = b""
    while selector.select(timeout=60.0):
        chunk = os.read(process.stdout.fileno(), 1 << 16)
        if not chunk:
            return
        *lines, rest = (rest + chunk).split(b"\n")
        for line in lines:
            if len(said := json.loads(line)) == 3:
                yield tuple(said[1:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--worker", nargs=3, help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        kind, first, last = options.worker
        return work(kind, int(first), int(last), options.seed, options.folder)

    rows, bad = [], []
    with tempfile.TemporaryDirectory() as folder:
        for kind in KINDS:  # of all kinds, to be mistaken for each other
            with_suffix = Path(folder) / f"whole{KINDS[kind].suffix}"
            KINDS[kind].write(with_suffix)
            with_suffix.replace(Path(folder) / kind)
        for place, kind in enumerate(options.kinds):
            count = options.files // len(options.kinds) + (place < options.files % len(options.kinds))
            found = outcomes(kind, count, options.seed, Path(folder))
            counts = {name: sum(one == name for one, _ in found) for name in OUTCOMES}
            rows.append({"kind": kind, "files": count, **counts})
            print(rows[-1], flush=True)
            bad += [f"{kind}, number {i}: {one}, {how}" for i, (one, how) in enumerate(found) if one in OUTCOMES[3:]]
    table = pd.DataFrame(rows)
    print(pd.concat([table, table.sum(numeric_only=True).to_frame().T.assign(kind="all")]).to_string(index=False))
    for line in bad[:40]:
        print(line)


if __name__ == "__main__":
    main()
