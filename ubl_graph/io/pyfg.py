"""PyFG as text: range-aided SLAM, one vertex, prior or edge a line.

A line is a token and words between blanks: a stamp, the names of one or two vertices, numbers, and
the upper triangle of a covariance, row by row. `TOKENS` says what each token's line holds.
`read_pyfg` keeps all that a file says, bit by bit, and refuses what it does not know.
"""

from __future__ import annotations

import io
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ubl_graph.errors import DataError
from ubl_graph.io.pyfg_graph import (
    CLASSES,
    TOKENS,
    Layout,
    PointRows,
    PoseRows,
    PyfgGraph,
    RangeRows,
    Rows,
)
from ubl_graph.io.tables import did_you_mean, read_text, shortened

__all__ = [
    "TOKENS",
    "PointRows",
    "PoseRows",
    "PyfgGraph",
    "RangeRows",
    "Rows",
    "read_pyfg",
    "write_pyfg",
]


def read_pyfg(path: str | Path) -> PyfgGraph:
    """Read a PyFG file.

    Parameters
    ----------
    path : path
        Lines may stand in any order, vertices before or after the edges that name them. Blank lines
        are skipped.

    Returns
    -------
    PyfgGraph
        In the order of the file, kind by kind.

    Raises
    ------
    DataError
        Where the file cannot be read or is empty, a token is unknown, a line has too few or too
        many words or one that is no number, planar and spatial lines are mixed, or the content is
        none that a `PyfgGraph` takes; it names file and line.
    """
    text = io.StringIO(read_text(path), newline=None).read()
    rows = _Reader(str(path))
    for number, line in enumerate(text.split("\n"), start=1):
        words = line.split()
        if words:
            rows.take(words, number)
    return rows.graph()


class _Reader:
    """Lines by their tokens, as numbers."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.lines: dict[str, list[tuple[int, list[str], list[float]]]] = {}
        #: The first token that is planar or spatial, and its line.
        self.decided: tuple[str, int] | None = None

    def take(self, words: list[str], number: int) -> None:
        token = words[0]
        if token not in TOKENS:
            problem = f"unknown token {shortened(token)}"
            raise self._error(number, problem, did_you_mean(token, tuple(TOKENS)))
        layout = TOKENS[token]
        self._check_dimension(token, number)
        columns = layout.columns
        if len(words) != 1 + len(columns):
            values = ", ".join((*(("t",) if layout.stamped else ()), *layout.names, *layout.values))
            noise = len(columns) - len(values.split(", "))
            triangle = f" and {noise} of covariance" if noise > 1 else " and variance" * noise
            raise self._error(
                number,
                f"{len(words) - 1} words after {token}, not {len(columns)}",
                f"they are {values}{triangle}; is the line cut short?",
            )
        at = 1 + layout.stamped
        names = words[at : at + len(layout.names)]
        numbers = [
            self._number(word, column, number)
            for word, column in zip(words[1:], columns, strict=True)
            if column not in layout.names
        ]
        self.lines.setdefault(token, []).append((number, names, numbers))

    def graph(self) -> PyfgGraph:
        if not self.lines:
            raise DataError(
                "the file is empty", "a PyFG file begins with VERTEX lines", file=self.file
            )
        parts: dict[str, Any] = {
            TOKENS[token].kind: _rows(TOKENS[token], lines) for token, lines in self.lines.items()
        }
        dimension = TOKENS[self.decided[0]].dimension if self.decided else 2
        return PyfgGraph(dimension=dimension or 2, file=self.file, **parts)

    def _check_dimension(self, token: str, number: int) -> None:
        dimension = TOKENS[token].dimension
        if dimension is None:
            return
        if self.decided is None:
            self.decided = token, number
        first, line = self.decided
        if TOKENS[first].dimension != dimension:
            raise self._error(
                number,
                f"{token} after {first} (line {line})",
                "a file is planar (SE2, XY) or spatial (SE3, XYZ) as a whole",
            )

    def _number(self, word: str, column: str, line: int) -> float:
        try:
            # Python reads 1_5 as 15; no program writes it, so it is a damaged word.
            if "_" in word:
                raise ValueError
            return float(word)
        except ValueError:
            raise DataError(
                f"{shortened(word)} is not a number",
                "drop or mend the line",
                file=self.file,
                line=line,
                field=column,
            ) from None

    def _error(self, line: int, problem: str, remedy: str) -> DataError:
        return DataError(problem, remedy, file=self.file, line=line)


def _rows(layout: Layout, lines: list[tuple[int, list[str], list[float]]]) -> Rows:
    numbers = np.array([n for _, _, n in lines], dtype=np.float64)
    t, rest = (numbers[:, 0], numbers[:, 1:]) if layout.stamped else (0.0, numbers)
    width, size = len(layout.values), len(layout.noise)
    covariance = np.zeros((len(lines), size, size))
    i, j = np.triu_indices(size)
    covariance[:, i, j] = covariance[:, j, i] = rest[:, width:]
    return CLASSES[layout.kind](
        [names for _, names, _ in lines],
        rest[:, :width],
        covariance,
        t,
        [number for number, _, _ in lines],
    )


def write_pyfg(path: str | Path, graph: PyfgGraph) -> None:
    """Write a PyFG file; what `read_pyfg` finds in it equals `graph`, bit by bit.

    Parameters
    ----------
    path : path
        Replaced where it is there; untouched if the writing fails.
    graph : PyfgGraph
        Written kind by kind, vertices first, each in its order.

    Raises
    ------
    DataError
        Where the file cannot be written.
    """
    path = Path(path)
    try:
        stage = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
        try:
            with (stage / path.name).open("w", encoding="utf-8", newline="\n") as file:
                file.writelines(f"{line}\n" for line in _lines(graph))
            (stage / path.name).replace(path)
        finally:
            shutil.rmtree(stage, ignore_errors=True)
    except OSError as error:
        raise DataError(
            f"the file cannot be written ({error.strerror or error})",
            "name a file in a folder you may write",
            file=path,
        ) from error


def _lines(graph: PyfgGraph) -> Iterator[str]:
    for token, layout in graph.layouts():
        rows: Rows = getattr(graph, layout.kind)
        i, j = np.triu_indices(len(layout.noise))
        columns = (rows.t, rows.name, rows.values, rows.covariance[:, i, j])
        for t, names, values, noise in zip(*(c.tolist() for c in columns), strict=True):
            stamp = [repr(t)] if layout.stamped else []
            yield " ".join([token, *stamp, *names, *map(repr, [*values, *noise])])
