"""Tables out of data frames and files: CSV, Excel, parquet and NPZ; those of MATLAB are in `ehsvjax.matlab`.

A table is what `ehsvjax.columns.pick` takes. Checksums that a file has are compared, pickled content is never loaded.
"""

import csv
import difflib
import inspect
import io
import re
import warnings
import zipfile
from collections.abc import Callable
from functools import partial
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from ehsvjax.columns import other_separator
from ehsvjax.files import needed, reading

if TYPE_CHECKING:
    import pandas


def frame_table(frame: "pandas.DataFrame", source: str = "the data frame") -> dict[str, np.ndarray]:
    """Columns of a data frame by name; a name that is no string, as with header=None, by its str().

    An index that has a name is a column too. Raises ValueError where two columns have one name, TypeError for
    anything but a data frame.
    """
    import pandas

    if not isinstance(frame, pandas.DataFrame):
        raise TypeError(f"expected one pandas data frame, got {type(frame).__name__}: convert it or name one of them")
    named = [place for place, level in enumerate(frame.index.names) if level is not None]
    names = [str(label) for label in [*(frame.index.names[place] for place in named), *frame.columns]]
    _refuse_repeated(names, f"{source}: rename all but one")
    levels = [frame.index.get_level_values(place).to_numpy() for place in named]
    columns = [frame.iloc[:, index].to_numpy() for index in range(frame.shape[1])]
    return dict(zip(names, [*levels, *columns], strict=True))


def csv_table(path: str | PathLike[str], **options: Any) -> dict[str, np.ndarray]:
    """Columns of a text file by the names in its header; `options` go to `pandas.read_csv`.

    Raises ValueError for a file that cannot be read, a repeated name, or rows that are longer or shorter than the
    header; TypeError for an option that pandas does not have.
    """
    import pandas

    _check_options(pandas.read_csv, options)
    options = {"index_col": False, **options}
    remedy = (
        "check the options, such as sep=';', decimal=',', encoding='latin-1' or 'utf-16' (where it is not UTF-8), "
        "skiprows and comment, or export the file again"
    )
    fault, short = "", None
    with reading(path, "a text file with columns", remedy):
        try:
            with warnings.catch_warnings():
                # by default pandas takes the surplus fields for an index and shifts every column
                warnings.filterwarnings("error", "Length of header", pandas.errors.ParserWarning)
                frame = pandas.read_csv(path, **options)
            short = _short_row(path, frame, options)
        except pandas.errors.ParserWarning:
            header = pandas.read_csv(path, **{**options, "nrows": 0}).columns
            names = "name them all (header=0, names=[...])"
            fault = f"the rows of {path} have more fields than its header: {other_separator(str(header[0])) or names}"
        except pandas.errors.EmptyDataError:
            fault = f"{path} holds no columns: check skiprows and comment, or the export"
    if fault:
        raise ValueError(fault)
    if short is not None:
        raise ValueError(
            f"{path} has a row with fewer fields than columns, {short!r}: was the file cut off? A missing value is an "
            "empty field between separators; skipfooter leaves out last rows"
        )
    return _file_table(frame, path, options)


def excel_table(path: str | PathLike[str], **options: Any) -> dict[str, np.ndarray]:
    """Columns of a sheet of an Excel workbook (.xlsx) by the names in its header; `options` go to `pandas.read_excel`.

    Raises ValueError for a file that cannot be read or a repeated name, TypeError for an option that pandas does not
    have, ImportError without openpyxl.
    """
    import pandas

    _check_options(pandas.read_excel, options)
    needed("openpyxl", "reading Excel")
    with reading(path, "an Excel workbook", "check sheet_name and skiprows, or save it again as .xlsx or CSV"):
        with zipfile.ZipFile(path) as archive:  # openpyxl reads some parts without comparing their checksums
            damaged = archive.testzip()
        if damaged is None:
            frame = pandas.read_excel(path, **{"engine": "openpyxl", **options})
    if damaged is not None:
        raise ValueError(f"{path} is damaged, the checksum of {damaged} is another: copy or export the workbook again")
    return _file_table(frame, path, options)


def parquet_table(path: str | PathLike[str]) -> dict[str, Callable[[], np.ndarray]]:
    """Columns of a parquet file by name, each read when it is called.

    Raises ValueError for a file that cannot be read or a repeated name, ImportError without pyarrow.
    """
    parquet = needed("pyarrow.parquet", "reading parquet")
    boundary = partial(reading, path, "a parquet file", "write or copy it again")

    def read(name: str) -> np.ndarray:
        with boundary(), parquet.ParquetFile(path, page_checksum_verification=True) as file:
            table = file.read(columns=[name])
            table.validate(full=True)
            return table[name].to_numpy()

    with boundary(), parquet.ParquetFile(path) as file:
        names = file.schema_arrow.names
    return _table(names, read, path)


def npz_table(path: str | PathLike[str]) -> dict[str, Callable[[], np.ndarray]]:
    """Arrays, by name, of an archive that `numpy.savez` wrote, each read when it is called; pickled content never is.

    Raises ValueError where it is no such archive.
    """

    def read(name: str) -> np.ndarray:
        what = f"an NPZ archive in which {name!r} is an array of numbers"
        with (
            reading(path, what, "pickled content is never loaded, save it as numbers"),
            zipfile.ZipFile(path) as archive,
        ):
            # the whole member at once, so that its checksum is compared whatever the array's header says
            return np.lib.format.read_array(io.BytesIO(archive.read(f"{name}.npy")), allow_pickle=False)

    remedy = "write one with numpy.savez(path, name=array, ...)"
    with reading(path, "an NPZ archive", remedy), zipfile.ZipFile(path) as archive:
        names = [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]
    return _table(names, read, path)


def _table(names: list[str], read: Callable[[str], np.ndarray], path: str | PathLike[str]) -> dict:
    _refuse_repeated(names, f"{path}: rename all but one")
    return {name: partial(read, name) for name in names}


def _file_table(frame: Any, path: str | PathLike[str], options: dict[str, Any]) -> dict[str, np.ndarray]:
    """The columns of what pandas made of a file."""
    # pandas renames the second 'x' to 'x.1'; names= says that the names are meant as they are
    columns = getattr(frame, "columns", ())
    repeated = [name for name in columns if f"{name}.1" in columns]
    if repeated and "names" not in options:
        raise ValueError(
            f"column {str(repeated[0])!r} stands more than once in {path} (or has a neighbour named "
            f"'{repeated[0]}.1'): rename one, or name all columns with header=0, names=[...]"
        )
    return frame_table(frame, str(path))


def _refuse_repeated(names: list[str], where: str) -> None:
    repeated = next((name for name in names if names.count(name) > 1), None)
    if repeated is not None:
        raise ValueError(f"column {repeated!r} stands more than once in {where}")


def _check_options(function: Callable, options: dict[str, Any]) -> None:
    known = list(inspect.signature(function).parameters)[1:]
    for name in options:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f", did you mean {near[0]!r}?" if near else ""
            raise TypeError(
                f"got an unexpected keyword argument {name!r}: pandas.{function.__name__} has no such{hint}"
            )


def _short_row(path: str | PathLike[str], frame: "pandas.DataFrame", options: dict[str, Any]) -> str | None:
    """The first row with fewer fields than there are columns, which pandas fills up with NaN."""
    import pandas

    separator = options.get("sep", options.get("delimiter", ","))
    if not isinstance(separator, str) or "usecols" in options or frame.empty or frame.iloc[:, -1].notna().all():
        return None
    pattern = re.escape(separator) if len(separator) == 1 else separator
    alike = ("skiprows", "skipfooter", "nrows", "comment", "encoding", "encoding_errors", "compression", "engine")
    lines = pandas.read_csv(
        path,
        **{name: options[name] for name in alike if name in options},
        sep="\x1f",  # stands in no text, so that each line is one field
        names=["line"],
        header=None,
        dtype=str,
        quoting=csv.QUOTE_NONE,
        keep_default_na=False,
    )["line"]
    full = lines.str.strip(" ").str.count(pattern) >= frame.shape[1] - 1
    begun = full.cummax()  # what stands above the header may be shorter
    return next(iter(lines[begun & ~full]), None)
