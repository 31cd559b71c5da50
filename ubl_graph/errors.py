"""The exceptions of ubl_graph: one small tree, every message says where and what to do.

::

    UblGraphError
    ├── DataError             a measurement, a file or a field of a file is wrong
    ├── ConfigurationError    an option or a combination of options is wrong
    ├── TimeError             times do not fit: out of order, outside the trajectory
    ├── NoDirectRayError      no direct acoustic path joins two points
    ├── UnobservableError     the data do not determine what was asked for
    └── SolverError           a solver failed where the data are sound
"""

from __future__ import annotations

from pathlib import Path


class UblGraphError(Exception):
    """Base of every error that ubl_graph raises on purpose; its text is one line."""


class DataError(UblGraphError):
    """A measurement, a file, or a field of a file is wrong.

    Parameters
    ----------
    problem : str
        What is wrong, with the offending value.
    remedy : str, optional
        What the user can do about it.
    file : path, optional
        The file it was found in.
    row : int, optional
        Data row of the file, counted from 1 without header and comment lines.
    line : int, optional
        Line of the file, counted from 1.
    record : str, optional
        For records made in Python instead of read from a file: kind and index, counted from 0.
    field : str, optional
        Column or key.
    """

    def __init__(
        self,
        problem: str,
        remedy: str = "",
        *,
        file: str | Path | None = None,
        row: int | None = None,
        line: int | None = None,
        record: str | None = None,
        field: str | None = None,
    ) -> None:
        self.problem, self.remedy = problem, remedy
        self.file, self.row, self.line, self.record, self.field = file, row, line, record, field
        super().__init__(self._text())

    def _text(self) -> str:
        place: list[str] = []
        if self.file is not None:
            place.append(str(self.file))
        if self.row is not None:
            place.append(
                f"row {self.row}" + (f" (line {self.line})" if self.line is not None else "")
            )
        elif self.line is not None:
            place.append(f"line {self.line}")
        if self.record is not None:
            place.append(self.record)
        if self.field is not None:
            place.append(f"field '{self.field}'")
        text = (", ".join(place) + ": " if place else "") + self.problem
        return text + (f"; {self.remedy}" if self.remedy else "")


class ConfigurationError(DataError):
    """An option, a key of a mission file, or a combination of options is wrong."""


class TimeError(UblGraphError):
    """Times do not fit: out of order, or outside the span asked for."""


class NoDirectRayError(UblGraphError):
    """No direct acoustic path joins two points in the given sound-speed profile."""


class UnobservableError(UblGraphError):
    """The data do not determine what was asked for."""


class SolverError(UblGraphError):
    """A solver failed although its input was sound."""
