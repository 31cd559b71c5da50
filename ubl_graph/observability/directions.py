"""Rank of a design matrix or of a graph, and what is left open, in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ubl_graph.arrays import ArrayLike, FloatArray, IntArray
from ubl_graph.assembly import direction
from ubl_graph.observability.dilution import SINGULAR

#: A state takes part in an open direction with at least this share of its length.
PART = 0.1


@dataclass(frozen=True, eq=False)
class Rank:
    """How many of a problem's unknowns its rows tell, and what they leave open.

    Attributes
    ----------
    singular_values : array, shape (K,)
        Of the design matrix in the scale that was asked for, falling.
    rank : int
        How many of them count.
    unobserved : tuple of str
        What is left open, in words: "position along 0/180 degrees".
    """

    singular_values: FloatArray
    rank: int
    unobserved: tuple[str, ...]

    @property
    def deficiency(self) -> int:
        """Unknowns minus rank."""
        return len(self.singular_values) - self.rank


def rank(
    design: ArrayLike,
    states: Mapping[str, Sequence[int]],
    *,
    scale: ArrayLike | None = None,
    least: float | None = None,
) -> Rank:
    """Rank of a design matrix, and its unobserved directions in words.

    Parameters
    ----------
    design : array, shape (M, K)
        Derivatives of M measurements by K unknowns.
    states : mapping of str to sequence of int
        Columns by the name of what they hold; of a vector east, north and maybe up.
    scale : array, shape (K,), optional
        What counts as one of each unknown. Left out, all columns are scaled to unit length: a
        matter of geometry alone.
    least : float, optional
        Singular values up to this do not count. Left out, 1e-10 of the largest.

    Examples
    --------
    Two ranges to beacons due north say nothing of east:

    >>> rank([[0.0, 1.0], [0.0, 1.0]], {"position": [0, 1]}).unobserved
    ('position along 90/270 degrees',)
    """
    matrix = np.asarray(design, dtype=np.float64)
    if scale is None:
        length = np.sqrt((matrix**2).sum(axis=0))
        factor: FloatArray = 1.0 / np.where(length > 0.0, length, 1.0)
    else:
        factor = np.asarray(scale, dtype=np.float64)
    *_, values, rows = np.linalg.svd(matrix * factor, full_matrices=True)
    values = np.concatenate([values, np.zeros(matrix.shape[1] - len(values))])
    limit = SINGULAR * float(values[0]) if least is None else least
    found = int((values > limit).sum())
    lost = rows[found:]
    words = [
        text
        for name, columns in states.items()
        for text in _in_words(name, lost[:, list(columns)], factor[list(columns)])
    ]
    return Rank(values, found, tuple(words))


def _in_words(name: str, lost: FloatArray, factor: FloatArray) -> list[str]:
    """How a state takes part in the directions (D, size) that are open."""
    _, shares, axes = np.linalg.svd(lost, full_matrices=False)
    open_ = [axis * factor for share, axis in zip(shares, axes, strict=True) if share > PART]
    if not open_ or len(factor) == 1:
        return [name] if open_ else []
    if len(open_) == len(factor):
        return [f"{name} in every direction"]
    return [f"{name} {direction(np.append(axis, np.zeros(3 - len(axis))))}" for axis in open_]


def reduced(jacobian: sparse.csr_array, turn: IntArray) -> FloatArray:
    """Eliminate unknowns group by group, by orthogonal transformations.

    What is left is a square root of Schur's complement: J'J of the remaining unknowns with all
    others free. Normal equations would square the spread of the singular values, and the motion
    prior between near nodes is a billion times what a ping says.

    Parameters
    ----------
    jacobian : sparse array, shape (M, n)
        Whitened rows. Each group has to be determined by the rows that touch it, given the rest.
    turn : array of int, shape (n,)
        When each column is eliminated; -1 for those that stay, which are as many as can be dense.

    Returns
    -------
    array, shape (R, K)
        Columns in the order in which they stand in the Jacobian; R <= K.
    """
    last = int(turn.max(initial=-1)) + 1
    when = np.where(turn < 0, last, turn)
    starts = jacobian.indptr
    # A row waits for the first of its columns to be eliminated.
    filled = np.flatnonzero(np.diff(starts) > 0)
    rows = len(starts) - 1
    first = np.full(rows, last)
    first[filled] = np.minimum.reduceat(when[jacobian.indices], starts[filled])
    order = np.argsort(first, kind="stable")
    bounds = np.searchsorted(first[order], np.arange(last + 2))
    waiting: list[list[_Rows]] = [[] for _ in range(last + 1)]
    for step in range(last + 1):
        own = order[bounds[step] : bounds[step + 1]]
        parts = waiting[step]
        if len(own):
            parts.append(_dense(jacobian[own]))
        columns = np.unique(np.concatenate([np.flatnonzero(when == step), *(p[0] for p in parts)]))
        columns = columns[np.argsort(when[columns], kind="stable")]
        matrix = _stacked(parts, columns)
        if step == last:
            return _triangle(matrix)
        count = int((when[columns] == step).sum())
        rest = _triangle(matrix)[count:, count:]
        if len(rest):
            columns = columns[count:]
            waiting[int(when[columns].min())].append((columns, rest))
    raise AssertionError("the last step returns")


#: Columns (C,), and rows (R, C) over them.
_Rows = tuple[IntArray, FloatArray]


def _dense(rows: sparse.csr_array) -> _Rows:
    """Sparse rows over the columns that they touch."""
    columns = np.unique(rows.indices).astype(np.int64)
    return columns, rows[:, columns].toarray()


def _triangle(matrix: FloatArray) -> FloatArray:
    """R of a QR decomposition."""
    return np.asarray(np.linalg.qr(matrix, mode="r")) if len(matrix) else matrix


def _stacked(parts: list[_Rows], columns: IntArray) -> FloatArray:
    """All rows over all columns."""
    place = {int(c): i for i, c in enumerate(columns)}
    matrix = np.zeros((sum(len(rows) for _, rows in parts), len(columns)))
    at = 0
    for own, rows in parts:
        matrix[at : at + len(rows), [place[int(c)] for c in own]] = rows
        at += len(rows)
    return matrix
