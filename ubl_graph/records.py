"""What all measurement records share: columns, checks at the door, and where they came from."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Self

import numpy as np

from ubl_graph.arrays import BoolArray, FloatArray, IntArray, frozen
from ubl_graph.errors import DataError

#: Times beyond this are not seconds since an epoch (they may be nanoseconds), s.
MAX_TIME = 1e11
#: Correlations of which the least eigenvalue is no larger are singular but for rounding.
SINGULAR = 1e-14


@dataclass(frozen=True)
class Source:
    """Where records came from, so that an error found later can still name the place.

    Attributes
    ----------
    file : str
        File name as the user gave it.
    row : array, shape (M,)
        Data row of each record, counted from 1.
    line : array, shape (M,)
        Line of the file of each record, counted from 1.
    """

    file: str
    row: IntArray
    line: IntArray

    def __getitem__(self, index: Any) -> Source:
        return Source(self.file, self.row[index], self.line[index])

    def error(self, index: int, field: str | None, problem: str, remedy: str = "") -> DataError:
        """Build the error that names the file, row and line of record `index`."""
        return DataError(
            problem,
            remedy,
            file=self.file,
            row=int(self.row[index]),
            line=int(self.line[index]),
            field=field,
        )


@dataclass(frozen=True, eq=False)
class Records:
    """Base of the record classes: broadcasting, checks, selection."""

    #: Legal range of each numeric column; others need only be finite.
    LIMITS: ClassVar[dict[str, tuple[float, float, str]]] = {}
    #: Columns that hold words.
    TEXT: ClassVar[frozenset[str]] = frozenset({"beacon", "reference"})

    def __post_init__(self) -> None:
        columns = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "source"}
        arrays = {n: _by_record(n, v) for n, v in columns.items() if v is not None}
        lengths = {len(a) for a in arrays.values()} - {1}
        if len(lengths) > 1:
            sizes = ", ".join(f"{n}: {len(a)}" for n, a in arrays.items())
            raise DataError(
                f"{type(self).__name__} columns of different length ({sizes})",
                "give one value per record, or one for all",
            )
        size = lengths.pop() if lengths else 1
        for name, array in arrays.items():
            whole = len(array) == size
            full = array if whole else np.broadcast_to(array, (size, *array.shape[1:]))
            object.__setattr__(self, name, self._column(name, full))
        self._check()

    def _column(self, name: str, values: Any) -> Any:
        if name in self.TEXT:
            return frozen(values, np.str_)
        try:
            if values.dtype.kind in "US":
                raise TypeError("numbers written as text")
            column = frozen(values)
        except (TypeError, ValueError) as error:
            raise DataError(
                f"{type(self).__name__} takes numbers here", "give floats", field=name
            ) from error
        if column.ndim != (3 if name == "covariance" else 1):
            raise DataError(
                f"{type(self).__name__} takes one value per record here, not shape {column.shape}",
                field=name,
            )
        broken: Any = ~np.isfinite(column)
        self._forbid(
            broken if column.ndim == 1 else broken.any(axis=(1, 2)),
            name,
            column,
            " is not a finite number",
            "drop or mend it",
        )
        if name == "t" or name.startswith("t_"):
            self._forbid(np.abs(column) > MAX_TIME, name, column, " s is no time in seconds")
        if name in self.LIMITS:
            low, high, unit = self.LIMITS[name]
            self._forbid(
                (column < low) | (column > high),
                name,
                column,
                f" {unit} is outside {low:g} to {high:g} {unit}",
                "check the unit",
            )
        return column

    def _forbid(
        self, bad: BoolArray, name: str, values: Any, problem: str, remedy: str = "check the unit"
    ) -> None:
        if bad.any():
            i = int(np.argmax(bad))
            value = values[i] if np.ndim(values[i]) == 0 else values[i].tolist()
            raise self.error(i, name, f"{value}{problem}", remedy)

    def _check(self) -> None:
        """Check across columns; overridden where a kind has such rules."""

    def _check_covariance(self, sizes: dict[int, str], remedy: str) -> None:
        """Refuse covariances of another size, and such as are none.

        Parameters
        ----------
        sizes : dict of int to str
            Sizes that are right, and what each is for.
        remedy : str
            For a matrix that is no covariance.
        """
        covariance: FloatArray = getattr(self, "covariance")  # noqa: B009 - not all kinds have it
        if covariance.shape[1:] not in [(d, d) for d in sizes]:
            raise self.error(
                0,
                "covariance",
                f"shape {covariance.shape[1:]} for {' or '.join(sizes.values())}",
                f"give {' or '.join(f'{d} x {d}' for d in sizes)}",
            )
        asymmetric = np.abs(covariance - np.swapaxes(covariance, 1, 2)) > 1e-9 * np.abs(
            covariance
        ).max(axis=(1, 2), keepdims=True)
        # Of the correlations: metres and radians are of no common size.
        variances = np.diagonal(covariance, axis1=1, axis2=2)
        sigmas = np.sqrt(np.where(variances > 0.0, variances, 1.0))
        correlations = covariance / (sigmas[:, :, None] * sigmas[:, None, :])
        wrong = asymmetric.any(axis=(1, 2)) | (np.linalg.eigvalsh(correlations)[:, 0] <= SINGULAR)
        if wrong.any():
            raise self.error(
                int(np.argmax(wrong)),
                "covariance",
                "the covariance is not symmetric and positive definite",
                remedy,
            )

    @classmethod
    def unchecked(cls, **columns: Any) -> Self:
        """Make records of columns that passed the checks before; nothing is checked or copied.

        Parameters
        ----------
        **columns : array
            Every column without a default; what is left out is None.
        """
        made = object.__new__(cls)
        for f in fields(cls):
            object.__setattr__(made, f.name, columns.get(f.name))
        return made

    @property
    def _source(self) -> Source | None:
        return getattr(self, "source", None)

    def error(self, index: int, field: str | None, problem: str, remedy: str = "") -> DataError:
        """Build the error that names record `index`, by file and row where these are known."""
        return record_error(type(self), self._source, index, field, problem, remedy)

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))

    def __getitem__(self, index: Any) -> Self:
        """Select by integer, slice, mask or index array; the result is again a record object."""
        if isinstance(index, (int, np.integer)):
            index = np.atleast_1d(np.arange(len(self))[index])
        chosen: dict[str, Any] = {}
        for f in fields(self):
            value = getattr(self, f.name)
            chosen[f.name] = None if value is None else value[index]
        return replace(self, **chosen)

    def duplicates(self, *columns: str) -> int | None:
        """Index of the first record that repeats an earlier one in `columns`, or None."""
        keys = np.rec.fromarrays([getattr(self, c) for c in columns])
        _, first = np.unique(keys, return_index=True)
        if len(first) == len(self):
            return None
        return int(np.setdiff1d(np.arange(len(self)), first)[0])


def _by_record(name: str, values: Any) -> Any:
    """A column as an array of which the first axis counts records; one matrix is one for all."""
    array = np.atleast_1d(np.asarray(values))
    return array[None] if name == "covariance" and array.ndim == 2 else array


def record_error(
    kind: type[Records],
    source: Source | None,
    index: int,
    field: str | None,
    problem: str,
    remedy: str,
) -> DataError:
    """Build the error that names record `index` of a kind, by file and row where these are known.

    Parameters
    ----------
    kind : type
        Class of the records.
    source : Source or None
        Where they came from.
    index : int
        Of the record, from 0.
    field, problem, remedy : str
        As in `DataError`.
    """
    if source is not None:
        return source.error(index, field, problem, remedy)
    return DataError(problem, remedy, record=f"{kind.__name__}[{index}]", field=field)
