"""The normal equations of a problem, as a symmetric band with a border.

The nodes' unknowns stand in the order of time, so what a residual row joins lies near the
diagonal; what all nodes share is the border. With r the weighted residuals and J their Jacobian,

    J'J = [ A  C ]     A: banded, over the nodes' columns
          [ C' D ]     C, D: coupling and corner of the shared columns

Rows of linear blocks never change: their part of J'J is assembled once. A nonlinear row adds the
products of its Jacobian's entries at places that are worked out once, too. All three parts live in
one flat store, band first, so that a place is one number.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.factors.block import Block
from ubl_graph.problem import Frozen, LeastSquares

#: Products that are formed at a time: enough to keep numpy busy, small enough for the cache.
CHUNK = 1 << 16


@dataclass(frozen=True)
class Shape:
    """Sizes of a banded matrix with a border, and where its entries stand in the flat store.

    Attributes
    ----------
    inner : int
        Columns of all nodes.
    border : int
        Columns that all nodes share.
    reach : int
        Diagonals of the lower triangle that the band needs, the main one included.
    """

    inner: int
    border: int
    reach: int

    @property
    def band_size(self) -> int:
        """Entries of the band."""
        return self.inner * self.reach

    @property
    def size(self) -> int:
        """Entries of band, coupling and corner."""
        return self.band_size + (self.inner + self.border) * self.border

    def place(self, i: IntArray, j: IntArray) -> IntArray:
        """Where the entries (i, j) of the lower triangle stand; `size` for a padded column."""
        high, low = np.maximum(i, j), np.minimum(i, j)
        place = low * (self.reach - 1)
        place += high
        if self.border:
            shared = high - self.inner
            coupling = self.band_size + low + shared * self.inner
            place = np.where(shared >= 0, coupling, place)
            corner = self.band_size + self.inner * self.border
            corner = corner + shared + (low - self.inner) * self.border
            place = np.where(low >= self.inner, corner, place)
        return place if low.min() >= 0 else np.where(low < 0, self.size, place)

    def split(self, store: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Views of the store: band (reach, inner), coupling (inner, border), corner."""
        edge = self.band_size + self.inner * self.border
        band = store[: self.band_size].reshape((self.reach, self.inner), order="F")
        coupling = store[self.band_size : edge].reshape((self.inner, self.border), order="F")
        corner = store[edge : self.size].reshape((self.border, self.border), order="F")
        return band, coupling, corner


def shape_of(problem: LeastSquares) -> Shape:
    """Sizes that a problem's rows ask for."""
    layout = problem.layout
    inner = layout.inner
    reach = 1
    for block in problem.blocks:
        # Columns first: numpy runs along the rows then.
        columns = np.ascontiguousarray(block.columns.T)
        inside = (columns >= 0) & (columns < inner)
        highest = np.max(columns, axis=0, where=inside, initial=-1)
        lowest = np.min(columns, axis=0, where=inside, initial=inner)
        reach = max(reach, int((highest - lowest).max()) + 1)
    return Shape(inner, layout.size - inner, reach)


@dataclass(frozen=True, eq=False)
class Point:
    """A problem evaluated at some x: what a step and a covariance need.

    Attributes
    ----------
    x : array
        The flat vector.
    cost : float
        Sum of rho(r) over robust rows and r^2/2 over the others.
    quadratic : float
        Half the sum of the squared weighted residuals.
    linear : array
        Residuals of the linear rows.
    curved : list of (residuals (M, R), Jacobians (M, R, C))
        Of the other blocks, weighted by the loss.
    """

    x: FloatArray
    cost: float
    quadratic: float
    linear: FloatArray
    curved: list[tuple[FloatArray, FloatArray]]


class NormalEquations:
    """Assembles J'J and J'r of a problem.

    Parameters
    ----------
    problem : LeastSquares
        Whose equations.
    """

    def __init__(self, problem: LeastSquares) -> None:
        self.problem = problem
        self.shape = shape_of(problem)
        zero = np.zeros(problem.layout.size)
        self._linear = [_LinearRows(b, zero) for b in problem.blocks if b.linear]
        curved = [b for b in problem.blocks if not b.linear]
        self._products = [_Products(b.columns, *_all_entries(b), self.shape) for b in curved]
        # Pads point at an extra entry that nobody reads.
        self._columns = [np.where(b.columns < 0, len(zero), b.columns).ravel() for b in curved]

    def of(self, problem: LeastSquares) -> NormalEquations:
        """Those of a problem that differs in its loss alone: structure and memory are shared."""
        _ = self._matrix, self._transposed, self._target, self._store
        other = copy(self)
        other.problem = problem
        return other

    def evaluate(self, x: FloatArray, frozen: Frozen) -> Point:
        """Evaluate all rows at `x`."""
        loss = self.problem.loss
        linear = self._matrix @ x - self._target
        cost = quadratic = 0.5 * dot(linear, linear)
        curved: list[tuple[FloatArray, FloatArray]] = []
        for block, held in zip(self.problem.blocks, frozen, strict=True):
            if block.linear:
                continue
            r, jacobian = block.evaluate(x, held)
            assert jacobian is not None
            if block.robust and loss.name != "none":
                cost += float(loss.cost(r).sum())
                root = np.sqrt(loss.weights(r))
                r, jacobian = root * r, root[:, :, None] * jacobian
                quadratic += 0.5 * dot(r, r)
            else:
                half = 0.5 * dot(r, r)
                cost, quadratic = cost + half, quadratic + half
            curved.append((r, jacobian))
        return Point(x, cost, quadratic, linear, curved)

    def gradient(self, point: Point) -> FloatArray:
        """J'r at a point, shape (n,)."""
        n = self.problem.layout.size
        total = self._transposed @ point.linear
        for (r, jacobian), columns in zip(point.curved, self._columns, strict=True):
            parts = (jacobian * r[:, :, None]).sum(axis=1)
            total += np.bincount(columns, parts.ravel(), minlength=n + 1)[:n]
        return total

    def matrix(self, point: Point) -> tuple[FloatArray, FloatArray, FloatArray]:
        """J'J at a point: band (reach, inner) in LAPACK's lower form, coupling, corner's lower.

        The arrays are the caller's to overwrite, and the next call's to fill anew: fresh memory
        would cost more than the sums.
        """
        store = self._store
        np.copyto(store, self._constant)
        for products, (_, jacobian) in zip(self._products, point.curved, strict=True):
            if jacobian.shape[1] == 1:
                products.add(store, _entries(jacobian))
            else:
                products.add_all(store, jacobian)
        return self.shape.split(store)

    @cached_property
    def _constant(self) -> FloatArray:
        """J'J of the linear rows in a flat store, one entry more for pads."""
        store = np.zeros(self.shape.size + 1)
        for block in self._linear:
            block.add(store, self.shape)
        return store

    @cached_property
    def _store(self) -> FloatArray:
        return np.empty_like(self._constant)

    @cached_property
    def _target(self) -> FloatArray:
        return np.concatenate([block.target for block in self._linear])

    @cached_property
    def _matrix(self) -> sparse.csr_array:
        """Jacobian of the linear rows; its structure is read off the blocks, nothing is sorted."""
        ends = np.concatenate([[0], np.cumsum(np.concatenate([b.counts() for b in self._linear]))])
        return sparse.csr_array(
            (
                np.concatenate([block.data.ravel() for block in self._linear]),
                np.concatenate([block.indices() for block in self._linear]),
                ends,
            ),
            shape=(len(ends) - 1, self.problem.layout.size),
        )

    @cached_property
    def _transposed(self) -> sparse.csc_array:
        return self._matrix.T


def dot(a: FloatArray, b: FloatArray) -> float:
    """Sum of the products of two arrays of one shape.

    Not by BLAS: for a sum of microseconds that wakes threads, and waits for them on a busy machine.
    """
    return float(np.einsum("i,i->", a.ravel(), b.ravel()))


class _Products:
    """Where the products of a block's Jacobian entries go.

    Parameters
    ----------
    columns : array of int, shape (M, C)
        The block's columns.
    rows, places : array of int, shape (E,)
        Row and place (of R and of C) of the entries that are not always zero.
    shape : Shape
        Of the matrix.
    """

    def __init__(self, columns: IntArray, rows: IntArray, places: IntArray, shape: Shape) -> None:
        # Every pair of entries of one row, once.
        a, b = np.tril_indices(len(rows))
        same = rows[a] == rows[b]
        self._a, self._b = a[same], b[same]
        by_place = np.ascontiguousarray(columns.T)
        # A mission of 100 000 nodes with all kinds of states has 50 million places: halve them.
        kind = np.int32 if shape.size < np.iinfo(np.int32).max else np.int64
        self._target = np.empty((len(self._a), columns.shape[0]), dtype=kind)
        self._step = max(1, CHUNK // max(columns.shape[0], 1))
        none = np.empty(0, dtype=np.int64)
        twice: list[tuple[IntArray, IntArray]] = [(none, none)]
        for some in self._portions():
            a, b = self._a[some], self._b[some]
            i, j = by_place[places[a]], by_place[places[b]]
            self._target[some] = shape.place(i, j)
            # Two places of a row that are the same column (legs that share a node) make a cross
            # product count twice: (a + b)^2 = a^2 + 2 a b + b^2.
            pair, row = np.nonzero((i == j) & (i >= 0) & (a != b)[:, None])
            twice.append((pair + some.start, row))
        pair, self._row_twice = (np.concatenate(part) for part in zip(*twice, strict=True))
        self._a_twice, self._b_twice = self._a[pair], self._b[pair]
        self._pa_twice, self._pb_twice = places[self._a_twice], places[self._b_twice]
        self._target_twice = self._target[pair, self._row_twice].astype(np.intp)

    def _portions(self) -> Iterator[slice]:
        """Pairs, as many at a time as the cache holds."""
        for first in range(0, len(self._a), self._step):
            yield slice(first, first + self._step)

    def add(self, store: FloatArray, entries: FloatArray) -> None:
        """Add the products of (E, M) entries to the store."""
        for some in self._portions():
            product = entries[self._a[some]]
            product *= entries[self._b[some]]
            target = self._target[some].astype(np.intp)
            np.add.at(store, target.ravel(), product.ravel())
        row = self._row_twice
        again = entries[self._a_twice, row] * entries[self._b_twice, row]
        np.add.at(store, self._target_twice, again)

    def add_all(self, store: FloatArray, jacobian: FloatArray) -> None:
        """Add J'J of rows with several components, (M, R, C): those of one row are one product."""
        size = max(1, CHUNK // max(len(self._a), 1))
        for first in range(0, len(jacobian), size):
            some = slice(first, first + size)
            gram = np.swapaxes(jacobian[some], 1, 2) @ jacobian[some]
            target = self._target[:, some].T.astype(np.intp)
            np.add.at(store, target.ravel(), gram[:, self._a, self._b].ravel())
        row = self._row_twice
        if len(row):
            again = (jacobian[row, :, self._pa_twice] * jacobian[row, :, self._pb_twice]).sum(
                axis=1
            )
            np.add.at(store, self._target_twice, again)


def _entries(jacobian: FloatArray) -> FloatArray:
    """(M, R, C) Jacobians as (R C, M), row by row contiguous."""
    return np.ascontiguousarray(jacobian.reshape(len(jacobian), -1).T)


def _all_entries(block: Block) -> tuple[IntArray, IntArray]:
    """Row and place of every entry of a block, whose components are added up beforehand."""
    width = block.columns.shape[1]
    return np.zeros(width, dtype=np.int64), np.arange(width)


class _LinearRows:
    """A linear block's entries that are not always zero.

    Attributes
    ----------
    target : array, shape (M R,)
        Right-hand sides.
    columns : array of int, shape (M, C)
        The block's.
    rows, places : array of int, shape (E,)
        Row and place of the entries.
    data : array, shape (M, E)
        Their values.
    components : int
        Rows R of one residual.
    """

    def __init__(self, block: Block, zero: FloatArray) -> None:
        residual, matrix = block.evaluate(zero)
        assert matrix is not None
        self.target: FloatArray = -residual.ravel()
        self.columns = block.columns
        self.rows, self.places = np.nonzero((matrix != 0.0).any(axis=0))
        self.data: FloatArray = matrix[:, self.rows, self.places]
        self.components = matrix.shape[1]

    def counts(self) -> IntArray:
        """Entries of each row of the matrix, shape (M R,)."""
        return np.tile(np.bincount(self.rows, minlength=self.components), len(self.data))

    def indices(self) -> IntArray:
        """Columns of the entries; a pad's coefficient is zero, wherever it points."""
        columns = self.columns[:, self.places].ravel()
        return np.maximum(columns, 0, out=columns)

    def add(self, store: FloatArray, shape: Shape) -> None:
        """Add J'J to the store."""
        step = max(1, CHUNK // max(len(self.rows), 1))
        for first in range(0, len(self.data), step):
            some = slice(first, first + step)
            products = _Products(self.columns[some], self.rows, self.places, shape)
            products.add(store, np.ascontiguousarray(self.data[some].T))
