"""CSV files as named columns that remember their rows, and the errors that name the place.

A table file has one header line with the names of its columns. Blank lines and lines that start
with ``#`` may stand anywhere and are skipped. Text is UTF-8, with or without a byte order mark.
"""

from __future__ import annotations

import csv
import difflib
import io
import itertools
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ubl_graph.arrays import BoolArray, FloatArray, IntArray
from ubl_graph.errors import DataError
from ubl_graph.records import Source

#: How alike two names must be (difflib ratio) for one to be taken as a slip for the other.
LIKENESS = 0.75
# Few enough that the garbage collector does not wake for them: four times faster than all at once.
_ROWS_AT_ONCE = 100


def nearest(name: str, known: Iterable[str]) -> str | None:
    """Return the known name that `name` may be a slip for, whatever its case, or None."""
    by_lower = {k.lower(): k for k in known}
    near = difflib.get_close_matches(name.lower(), list(by_lower), n=1, cutoff=LIKENESS)
    return by_lower[near[0]] if near else None


def did_you_mean(name: str, known: Sequence[str], what: str = "known") -> str:
    """Remedy for an unknown name: the nearest known one, and the others where they are few."""
    near = nearest(name, known)
    if near and len(known) > 8:
        return f"did you mean '{near}'?"
    hint = f"did you mean '{near}'? " if near else ""
    shown = ", ".join(known[:20]) + (", ..." if len(known) > 20 else "")
    return f"{hint}{what}: {shown or 'none'}"


@contextmanager
def naming(
    file: str | Path | None,
    within: str = "",
    *,
    record: str | None = None,
    columns: Mapping[str, str] | None = None,
) -> Generator[None]:
    """Let errors that name no file name this one.

    Parameters
    ----------
    file : path or None
        As the user would recognise it; None where only the field's name is to be completed.
    within : str
        Put before the error's field, unless it is there: the table that is being read.
    record : str, optional
        Named where the error names no record.
    columns : mapping, optional
        Names of fields as this file has them, by the names that the records use; applied to
        errors that already name a file, too.

    Raises
    ------
    DataError
        Of the type that was caught.
    """
    try:
        yield
    except DataError as error:
        field = (columns or {}).get(error.field or "", error.field)
        if error.file is None:
            field = (field or "").removeprefix(within)
            field = (within + field).rstrip(".") or None
        elif field == error.field:
            raise
        raise type(error)(
            error.problem,
            error.remedy,
            file=file if error.file is None else error.file,
            row=error.row,
            line=error.line,
            record=error.record or (record if error.file is None else None),
            field=field,
        ) from error


def read_text(path: str | Path) -> str:
    """Return the text of a UTF-8 file.

    Raises
    ------
    DataError
        Where there is no such file, it is a folder, cannot be read, or is not UTF-8.
    """
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError as error:
        raise DataError("there is no such file", _neighbour(Path(path)), file=path) from error
    except IsADirectoryError as error:
        raise DataError("this is a folder", "name a file in it", file=path) from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise DataError(f"the file cannot be read ({reason})", file=path) from error
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(
            f"byte 0x{data[error.start]:02x} is no UTF-8 text",
            "save the file as UTF-8",
            file=path,
            line=data.count(b"\n", 0, error.start) + 1,
        ) from error


def _neighbour(path: Path) -> str:
    if not path.parent.is_dir():
        return f"there is no folder '{path.parent}' either"
    try:
        near = nearest(path.name, (p.name for p in path.parent.iterdir()))
    except OSError:
        near = None
    return f"did you mean '{near}'?" if near else ""


@dataclass(frozen=True, eq=False)
class Table:
    """A CSV file's cells by column, as text.

    Attributes
    ----------
    columns : dict of str to sequence of str
        Cells of each column, stripped of white space, in the order of the file.
    source : Source
        File name, and row and line of every data row.
    """

    columns: Mapping[str, Sequence[str]]
    source: Source

    def __len__(self) -> int:
        return len(self.source.row)

    def __contains__(self, name: object) -> bool:
        return name in self.columns

    @property
    def file(self) -> str:
        """File name as the user gave it."""
        return self.source.file

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns that have one, in order."""
        return tuple(name for name in self.columns if name)

    def require(self, *names: str) -> None:
        """Raise a `DataError` for the first of `names` that is no column of this table."""
        for name in names:
            if name not in self.columns:
                raise DataError(
                    f"the column '{name}' is missing",
                    did_you_mean(name, self.names, "columns found"),
                    file=self.file,
                    field=name,
                )

    def text(self, name: str) -> np.ndarray[tuple[int], np.dtype[np.str_]]:
        """Return a column as an array of words, shape (M,).

        Raises
        ------
        DataError
            Where the column is missing, or a cell is empty.
        """
        self.require(name)
        cells = self.columns[name]
        if "" in cells:
            raise self.source.error(cells.index(""), name, "the value is missing")
        return np.array(cells, dtype=np.str_)

    def numbers(self, name: str) -> FloatArray:
        """Return a column as numbers, shape (M,); "nan" and "inf" pass, for the records to judge.

        Raises
        ------
        DataError
            Where the column is missing, or a cell holds no number.
        """
        self.require(name)
        cells = self.columns[name]
        try:
            # Python reads 1_5 as 15; no instrument writes it, so it is a damaged cell.
            if "_" in "".join(cells):
                raise ValueError
            return np.fromiter(map(float, cells), dtype=np.float64, count=len(cells))
        except ValueError:
            bad = next(i for i, cell in enumerate(cells) if not _is_number(cell))
            problem = f"{shortened(cells[bad])} is not a number" if cells[bad] else None
            raise self.source.error(bad, name, problem or "the value is missing") from None

    def finite(self, name: str) -> FloatArray:
        """Return a column as numbers, refusing "nan" and "inf" as well."""
        values = self.numbers(name)
        bad = ~np.isfinite(values)
        if bad.any():
            i = int(np.argmax(bad))
            raise self.source.error(
                i, name, f"{values[i]} is not a finite number", "drop or mend it"
            )
        return values

    def where(self, mask: BoolArray) -> Table:
        """Return the rows in which `mask`, shape (M,), is true."""
        chosen = np.flatnonzero(mask).tolist()
        columns = {n: tuple(c[i] for i in chosen) for n, c in self.columns.items()}
        return Table(columns, self.source[mask])

    def lower(self) -> Table:
        """Return the same table with the names of its columns in lower case."""
        return Table({n.lower(): c for n, c in self.columns.items()}, self.source)


def read_table(path: str | Path) -> Table:
    """Read a CSV file.

    Parameters
    ----------
    path : path
        Errors name the file as it is written here.

    Returns
    -------
    Table
        At least one row.

    Raises
    ------
    DataError
        Where the file cannot be read, is empty, has no header or nothing below it, names a column
        twice, or has a row with more or fewer values than the header has names.
    """
    lines, numbers = _content(read_text(path), path)
    source = Source(
        str(path), np.arange(1, len(lines), dtype=np.int64), np.array(numbers[1:], dtype=np.int64)
    )
    reader = csv.reader(lines, skipinitialspace=True, strict=True)
    try:
        header = [name.strip() for name in next(reader)]
        _check_header(header, path, int(numbers[0]))
        cells = _transposed(reader, len(header), source)
    except csv.Error as error:
        line = int(numbers[_first_torn(lines)])
        raise DataError(f"the row cannot be read ({error})", file=path, line=line) from error
    if len(source.row) == 0:
        raise DataError("there is no row below the header", "the data are empty", file=path)
    return Table(dict(zip(header, cells, strict=True)), source)


def _content(text: str, path: str | Path) -> tuple[list[str], IntArray]:
    lines = io.StringIO(text, newline=None).read().split("\n")
    kept = [i for i, line in enumerate(lines) if line and not line.isspace()]
    kept = [i for i in kept if not lines[i].lstrip().startswith("#")]
    if not kept:
        raise DataError("the file is empty", "the first line must name the columns", file=path)
    return [lines[i] for i in kept], np.array(kept, dtype=np.int64) + 1


def _transposed(reader: Any, width: int, source: Source) -> list[list[str]]:
    columns: list[list[str]] = [[] for _ in range(width)]
    done = 0
    while rows := list(itertools.islice(reader, _ROWS_AT_ONCE)):
        if reader.line_num != done + len(rows) + 1:
            raise csv.Error("a quoted value does not end on its line")
        _check_widths(rows, width, source[done : done + len(rows)])
        for column, cells in zip(columns, zip(*rows, strict=True), strict=True):
            column.extend(map(str.strip, cells))
        done += len(rows)
    return columns


def _first_torn(lines: list[str]) -> int:
    """Index of the first line that is no row by itself."""
    for i, line in enumerate(lines):
        try:
            list(csv.reader([line], skipinitialspace=True, strict=True))
        except csv.Error:
            return i
    return len(lines) - 1


def _check_header(header: list[str], path: str | Path, line: int) -> None:
    if all(_is_number(name) for name in header):
        raise DataError(
            "the first line holds numbers",
            "it must name the columns, separated by commas",
            file=path,
            line=int(line),
        )
    for name in header:
        if name and header.count(name) > 1:
            raise DataError(
                f"the column '{name}' is there twice", file=path, line=int(line), field=name
            )


def _check_widths(rows: list[list[str]], width: int, source: Source) -> None:
    if set(map(len, rows)) == {width}:
        return
    bad = next(i for i, row in enumerate(rows) if len(row) != width)
    found = len(rows[bad])
    raise DataError(
        f"the row has {found} value{'s' if found > 1 else ''}, the header names {width}",
        "separate values by commas, decimals by points",
        file=source.file,
        row=int(source.row[bad]),
        line=int(source.line[bad]),
    )


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell


def shortened(value: object) -> str:
    """Return `value` for a message: quoted where it is text, on one line, at most 40 characters."""
    text = " ".join((repr(value) if isinstance(value, str) else str(value)).split())
    return text if len(text) <= 40 else text[:37] + "..."
