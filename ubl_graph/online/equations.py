"""Normal equations of a window, assembled from small dense pieces.

As in `ubl_graph.solve.normal` the matrix is a band with a border. A window lives for one solve
only, so nothing pays that is worked out once and used often: rows come as dense blocks over a few
neighbouring nodes and are added to the band side by side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.factors.loss import RobustLoss
from ubl_graph.factors.ranges import RangeBlock
from ubl_graph.solve.banded import BandedFactor


@lru_cache(maxsize=64)
def _places(width: int, reach: int, inside: int, j: int) -> tuple[IntArray, IntArray, IntArray]:
    """Of a dense block over `inside` columns, what node `j` of it adds to its row of the band.

    Returns
    -------
    place : array of int
        In the node's row of the store.
    a, b : array of int
        Row and column of the block, the lower triangle of the node's columns.
    """
    b, a = np.nonzero(np.arange(inside)[None, :] >= np.arange(j * width, (j + 1) * width)[:, None])
    return b * (reach - 1) + a - j * width, a, b + j * width


class LinearRows:
    """The intervals' rows of a window, and their normal matrix, kept from solve to solve.

    Parameters
    ----------
    width, border : int
        Columns of a node, and of what all nodes share.
    height : int
        Rows of an interval.

    Attributes
    ----------
    rows : array, shape (N - 1, H, C)
        Of each interval, over two nodes and what is shared.
    targets : array, shape (N - 1, H)
        Their right-hand sides.
    """

    def __init__(self, width: int, border: int, height: int) -> None:
        self._width, self._border = width, border
        size = 2 * width + border
        self.rows, self.targets = np.zeros((1, height, size)), np.zeros((1, height))
        self._products = np.zeros((1, size, size))
        self._span = 2
        self._band = np.zeros((2, width * self.reach))
        self._old: set[int] = {0, 1}

    @property
    def nodes(self) -> int:
        """Nodes, one more than intervals."""
        return len(self.rows) + 1

    @property
    def reach(self) -> int:
        """Diagonals of the band."""
        return self._span * self._width

    def append(self, count: int) -> None:
        """Add empty intervals at the end."""
        for name in ("rows", "targets", "_products"):
            old = getattr(self, name)
            setattr(self, name, np.concatenate([old, np.zeros((count, *old.shape[1:]))]))
        more = np.zeros((count, self._band.shape[1]))
        self._band = np.concatenate([self._band, more])

    def put(self, at: slice, rows: FloatArray, targets: FloatArray) -> None:
        """Replace the rows of some intervals."""
        self.rows[at], self.targets[at] = rows, targets
        self._products[at] = np.swapaxes(rows, 1, 2) @ rows
        self._old.update(range(at.start, at.stop + 1))

    def drop(self) -> None:
        """Forget the first interval."""
        self.rows, self.targets = self.rows[1:], self.targets[1:]
        self._products, self._band = self._products[1:], self._band[1:]
        self._old = {k - 1 for k in self._old if k} | {0}

    def normal(self, span: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Normal matrix: band by node (N, W * reach), coupling (border, N, W), corner.

        Parameters
        ----------
        span : int
            Neighbouring nodes that a row of the whole problem joins.
        """
        if span > self._span:
            self._span = span
            self._band = np.zeros((self.nodes, self._width * self.reach))
            self._old = set(range(self.nodes))
        if self._old:
            self._assemble(np.array(sorted(self._old)))
            self._old.clear()
        w, inside = self._width, 2 * self._width
        coupling = np.zeros((self._border, self.nodes, w))
        if self._border:
            shared = self._products[:, inside:, :inside].transpose(1, 0, 2)
            coupling[:, :-1] += shared[:, :, :w]
            coupling[:, 1:] += shared[:, :, w:]
        return self._band, coupling, self._products[:, inside:, inside:].sum(axis=0)

    def _assemble(self, nodes: IntArray) -> None:
        """Add up the rows of some nodes anew."""
        fresh = np.zeros((len(nodes), self._band.shape[1]))
        for j, some in enumerate((nodes < self.nodes - 1, nodes > 0)):
            place, a, b = _places(self._width, self.reach, 2 * self._width, j)
            fresh[np.flatnonzero(some)[:, None], place] += self._products[nodes[some] - j][:, a, b]
        self._band[nodes] = fresh


@dataclass(frozen=True, eq=False)
class Point:
    """A window evaluated at x.

    Attributes
    ----------
    x : array
        The flat vector.
    cost : float
        Sum of the losses.
    linear, prior : array
        Residuals of the intervals' rows and of the prior's.
    curved : list of (residuals (M,), Jacobians (M, C))
        Of the range blocks, whitened, without the loss.
    """

    x: FloatArray
    cost: float
    linear: FloatArray
    prior: FloatArray
    curved: list[tuple[FloatArray, FloatArray]]


class WindowEquations:
    """Cost, gradient and normal matrix of a window.

    `frozen`, the standard deviations of the range rows, may be set; at first they are the
    measurements' own.

    Parameters
    ----------
    width, border : int
        Columns of a node, and of what all nodes share.
    linear : LinearRows
        Intervals' rows.
    prior : (array, shape (P, K), array, shape (P,))
        Rows over the first nodes and what is shared, and their right-hand sides.
    ranges : sequence of RangeBlock
        Over the window's columns.
    loss : RobustLoss
        Of the range rows.
    """

    def __init__(
        self,
        width: int,
        border: int,
        linear: LinearRows,
        prior: tuple[FloatArray, FloatArray],
        ranges: Sequence[RangeBlock],
        loss: RobustLoss,
    ) -> None:
        self._width, self._border = width, border
        self._linear, self._loss = linear, loss
        self._prior, self._prior_target = prior
        self.nodes = linear.nodes
        self._ranges = ranges
        self.frozen: Sequence[FloatArray] = [b.sigma for b in ranges]
        self._pieces = [_Piece(b.columns, width, self.nodes, border) for b in ranges]
        self._prior_nodes = (self._prior.shape[1] - border) // width
        span = max([2, self._prior_nodes, *(p.span for p in self._pieces)])
        band, coupling, corner = linear.normal(span)
        self._reach = linear.reach
        # Pieces near the end may reach beyond it with zeros.
        padded = self.nodes + self._reach // width
        self._constant = [
            np.zeros((padded, width * self._reach)),
            np.zeros((border, padded, width)),
            corner,
        ]
        self._constant[0][: self.nodes] = band
        self._constant[1][:, : self.nodes] = coupling
        self._add(
            self._constant,
            np.zeros(1, dtype=np.int64),
            (self._prior.T @ self._prior)[None],
            self._prior_nodes,
        )

    @property
    def inner(self) -> int:
        """Columns of all nodes."""
        return self.nodes * self._width

    @property
    def size(self) -> int:
        """Columns in all."""
        return self.inner + self._border

    def evaluate(self, x: FloatArray, jacobian: bool = True) -> Point:
        """Evaluate all rows at `x`; without `jacobian` the range rows' Jacobians are empty."""
        nodes, shared = self._parts(x)
        ends = np.concatenate(
            [
                nodes[:-1],
                nodes[1:],
                np.broadcast_to(shared, (self.nodes - 1, self._border)),
            ],
            axis=1,
        )
        linear = (self._linear.rows @ ends[:, :, None])[:, :, 0] - self._linear.targets
        first = np.concatenate([nodes[: self._prior_nodes].ravel(), shared])
        prior = self._prior @ first - self._prior_target
        cost = 0.5 * (np.einsum("kr,kr->", linear, linear) + np.einsum("r,r->", prior, prior))
        curved: list[tuple[FloatArray, FloatArray]] = []
        for block, held in zip(self._ranges, self.frozen, strict=True):
            r, slope = block.evaluate(x, held, jacobian=jacobian)
            cost += self._loss.cost(r).sum()
            curved.append((r[:, 0], np.empty((0, 0)) if slope is None else slope[:, 0]))
        return Point(x, float(cost), linear, prior, curved)

    def whitened_anew(self, point: Point, block: int, row: int, by: float) -> Point:
        """A point with one range row's standard deviation divided by a factor."""
        curved = [(r.copy(), slope.copy()) for r, slope in point.curved]
        r, slope = curved[block]
        before = float(self._loss.cost(r[row : row + 1])[0])
        r[row] *= by
        slope[row] *= by
        cost = point.cost - before + float(self._loss.cost(r[row : row + 1])[0])
        return Point(point.x, cost, point.linear, point.prior, curved)

    def gradient(self, point: Point) -> FloatArray:
        """Derivative of the cost, shape (n,)."""
        total = np.zeros(self.inner + self._border)
        nodes, shared = self._parts(total)
        by_interval = (point.linear[:, None, :] @ self._linear.rows)[:, 0]
        w = self._width
        nodes[:-1] += by_interval[:, :w]
        nodes[1:] += by_interval[:, w : 2 * w]
        shared += by_interval[:, 2 * w :].sum(axis=0)
        first = point.prior @ self._prior
        nodes[: self._prior_nodes] += first[: self._prior_nodes * w].reshape(-1, w)
        shared += first[self._prior_nodes * w :]
        for piece, (r, slope) in zip(self._pieces, point.curved, strict=True):
            weighted = (self._loss.weights(r) * r)[:, None] * slope
            total += np.bincount(piece.columns, weighted.ravel(), minlength=len(total) + 1)[:-1]
        return total

    def factor(self, point: Point, newton: bool = False, damping: float = 0.0) -> BandedFactor:
        """Factor of the normal matrix at a point.

        Parameters
        ----------
        point : Point
            With Jacobians.
        newton : bool
            Weigh range rows by the loss' second derivative where that is positive, as Newton's
            method would, instead of by re-weighted least squares.
        damping : float
            Share of the diagonal that is added to it.

        Raises
        ------
        numpy.linalg.LinAlgError
            Where the matrix is not positive definite, or not finite.
        """
        store = [part.copy() for part in self._constant]
        for piece, (r, slope) in zip(self._pieces, point.curved, strict=True):
            weight = self._loss.curvature(r) if newton else self._loss.weights(r)
            first, products = piece.products(np.sqrt(weight)[:, None] * slope)
            self._add(store, first, products, piece.span)
        band, coupling, corner = self._views(store)
        band[0] *= 1.0 + damping
        corner[np.diag_indices_from(corner)] *= 1.0 + damping
        if not (np.isfinite(band[0]).all() and np.isfinite(corner).all()):
            raise np.linalg.LinAlgError("the normal equations are not finite")
        return BandedFactor(band, coupling, corner)

    def _parts(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Views of a flat vector: nodes (N, W), shared."""
        return x[: self.inner].reshape(self.nodes, self._width), x[self.inner :]

    def _views(self, store: list[FloatArray]) -> tuple[FloatArray, FloatArray, FloatArray]:
        band, coupling, corner = store
        inner = self.inner
        return (
            band.ravel()[: inner * self._reach].reshape((self._reach, inner), order="F"),
            coupling.reshape(self._border, coupling.shape[1] * self._width)[:, :inner].T,
            corner,
        )

    def _add(
        self, store: list[FloatArray], first: IntArray, products: FloatArray, span: int
    ) -> None:
        """Add symmetric blocks (U, span W + border, same) over nodes from `first` (U,) on."""
        band, coupling, corner = store
        w, inside = self._width, span * self._width
        for j in range(span):
            place, a, b = _places(w, self._reach, inside, j)
            band[(first + j)[:, None], place] += products[:, a, b]
            if self._border:
                block = products[:, inside:, j * w : (j + 1) * w].transpose(1, 0, 2)
                coupling[:, first + j] += block
        if self._border:
            corner += products[:, inside:, inside:].sum(axis=0)


class _Piece:
    """Range rows of a block as dense rows over the nodes that each of them reaches.

    Parameters
    ----------
    columns : array of int, shape (M, C)
        -1 pads.
    width, nodes, border : int
        Of the window.
    """

    def __init__(self, columns: IntArray, width: int, nodes: int, border: int) -> None:
        inner = nodes * width
        inside = (columns >= 0) & (columns < inner)
        node = columns // width
        first = np.where(inside, node, nodes).min(axis=1)
        last = np.where(inside, node, 0).max(axis=1)
        self.span = int((last - first).max()) + 1
        size = self.span * width + border
        local = np.where(
            columns < inner,
            columns - first[:, None] * width,
            columns - inner + self.span * width,
        )
        local = np.where(columns < 0, size, local)
        #: Columns of all entries, pads behind the last one.
        self.columns = np.where(columns < 0, inner + border, columns).ravel()
        # Rows in the order of their first node, so that those of one node can be summed.
        self._order = np.argsort(first, kind="stable")
        self._starts = np.flatnonzero(np.diff(first[self._order], prepend=-1))
        self._first = first[self._order][self._starts]
        self._size = size
        self._places = (np.arange(len(columns))[:, None] * (size + 1) + local).ravel()

    def products(self, slope: FloatArray) -> tuple[IntArray, FloatArray]:
        """Sums of J'J by first node: nodes (U,), blocks (U, size, size)."""
        rows = len(slope)
        dense: Any = np.bincount(self._places, slope.ravel(), minlength=rows * (self._size + 1))
        dense = dense.reshape(rows, self._size + 1)[self._order, :-1]
        if len(self._starts) == rows:
            return self._first, dense[:, :, None] * dense[:, None, :]
        blocks = np.empty((len(self._starts), self._size, self._size))
        ends = [*self._starts[1:], rows]
        for k, (begin, end) in enumerate(zip(self._starts, ends, strict=True)):
            some = dense[begin:end]
            np.matmul(some.T, some, out=blocks[k])
        return self._first, blocks
