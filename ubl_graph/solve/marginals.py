"""Marginal covariances of an estimate, by block recursion on the banded normal equations.

GTSAM's own `Marginals` takes a system for indeterminate as soon as two diagonal entries of a
clique's factor differ by more than 2^12, which a clock known to a second that wanders by 1e-7 s
does; it is also slower. Here the columns are scaled to unit diagonal first, so that only what is
singular indeed fails. The tests hold both together where GTSAM can.

With A = L L' the nodes' part of the normal matrix, the factor says how a node depends on the nodes
that follow: x_k = G_k y + e_k, with y the nodes in reach, G_k = -(F_k L_kk^-1)' from the rows F_k
below L_kk, and e_k of covariance (L_kk L_kk')^-1. So covariances run backwards along the chain
(Takahashi et al. 1973; Barfoot, State Estimation for Robotics, ch. 3.2),

    cov(x_k, y) = G_k P,  cov(x_k) = G_k P G_k' + cov(e_k),  P = cov(y).

A step of this is small, and Python is slow at small steps. Steps are affine in P and can be
composed: the chain is cut into pieces of equal length, all of them are composed side by side, P is
carried over the pieces one by one, and all of them are run through side by side. What nodes share
is a border: Schur's complement adds its part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ubl_graph.arrays import BoolArray, FloatArray, IntArray
from ubl_graph.errors import SolverError
from ubl_graph.layout import Layout
from ubl_graph.problem import Problem
from ubl_graph.solve.banded import BandedFactor
from ubl_graph.solve.normal import NormalEquations, Point
from ubl_graph.solve.rounds import Solution

#: Shares of the diagonal added where the normal equations are singular to rounding. What only a
#: prior of 1e5 m holds beside a sensor of centimetres is at the edge of what double precision
#: resolves. A ridge of rounding's size then lets the factorisation pass; `unresolved` says which
#: covariances are its doing.
RIDGES = (0.0, *(10.0**k for k in range(-14, -7)))
#: Where a pivot is below this share of its diagonal, rounding may have made it.
DOUBTFUL_PIVOT = 1e-12
#: More columns in reach than this are not worth composing steps for: it takes their cube.
MOST_COMPOSED = 64
#: Nodes whose blocks are read off the factor at once: what fits the cache.
AT_ONCE = 4096


class Covariances:
    """Covariances of the unknowns of a layout: of each node, and of each node with the next.

    Parameters
    ----------
    layout : Layout
        Whose unknowns.
    node : array, shape (N, W, W)
        Of each node's columns, scaled.
    following : array, shape (N - 1, W, W)
        Of each node's columns (rows) with the next one's, scaled.
    shared : array, shape (S, S)
        Of what all nodes share, scaled.
    scale : array, shape (K,)
        What a scaled column is to be multiplied by.
    unresolved : array of bool, shape (N,)
        Nodes whose position varies so much more than their neighbours hold them that double
        precision does not tell how much: the data do not determine it.
    """

    def __init__(
        self,
        layout: Layout,
        node: FloatArray,
        following: FloatArray,
        shared: FloatArray,
        scale: FloatArray,
        unresolved: BoolArray,
    ) -> None:
        self._layout = layout
        self._node, self._following, self._shared = node, following, shared
        self._scale, self.unresolved = scale, unresolved

    def of(self, name: str) -> FloatArray:
        """Covariance of a quantity, SI: (N, size, size) per node, (size, size) if shared."""
        layout = self._layout
        if name not in dict(layout.shared):
            return self.joint([name])
        columns = layout.shared_columns(name)
        local = columns - layout.node_count * layout.node_width
        scale = self._scale[columns] * layout.unit(name)
        return scale[:, None] * self._shared[np.ix_(local, local)] * scale[None, :]

    def joint(self, names: Sequence[str]) -> FloatArray:
        """Joint covariance of some of a node's quantities, SI, in this order: (N, S, S)."""
        local, scale = self._node_columns(names)
        block = self._node[:, local[:, None], local[None, :]]
        return scale[:, :, None] * block * scale[:, None, :]

    def following(self, names: Sequence[str]) -> FloatArray:
        """Covariance of a node's quantities with the next node's, SI: (N - 1, S, S).

        Rows belong to the earlier node. Between chains it is not zero where they share unknowns.
        """
        local, scale = self._node_columns(names)
        block = self._following[:, local[:, None], local[None, :]]
        return scale[:-1, :, None] * block * scale[1:, None, :]

    def _node_columns(self, names: Sequence[str]) -> tuple[IntArray, FloatArray]:
        """Places within a node (S,), and SI scale of each node's columns (N, S)."""
        layout = self._layout
        nodes = np.arange(layout.node_count)
        columns = np.concatenate([layout.node_columns(name, nodes) for name in names], axis=1)
        units = np.concatenate(
            [np.full(layout.node_columns(n, nodes[:1]).shape[1], layout.unit(n)) for n in names]
        )
        return columns[0], self._scale[columns] * units


class Marginals(Covariances):
    """Covariances of the unknowns at a solution.

    Parameters
    ----------
    problem : Problem
        What was solved.
    solution : Solution
        Where it ended.

    Raises
    ------
    SolverError
        Where the normal equations are not finite or an unknown enters no residual.
    """

    def __init__(self, problem: Problem, solution: Solution) -> None:
        layout = problem.layout
        equations = NormalEquations(problem)
        point = equations.evaluate(solution.x, solution.frozen)
        found = _invert(equations, point, RIDGES)
        unresolved: BoolArray = np.zeros(layout.node_count, dtype=np.bool_)
        if found.doubtful:
            # What a larger ridge lowers, the ridge has made, or rounding has.
            own = layout.node_columns("position", np.zeros(1, dtype=np.int64))[0]
            ridge = max(10.0 * found.ridge, DOUBTFUL_PIVOT)
            larger = _invert(equations, point, [ridge]).node[:, own, own].sum(axis=1)
            unresolved = larger < 0.5 * found.node[:, own, own].sum(axis=1)
        super().__init__(layout, found.node, found.following, found.shared, found.scale, unresolved)


def shared_covariance(problem: Problem, x: FloatArray) -> FloatArray:
    """Covariance of what all nodes share, SI, as it would be at `x`: nothing is solved for.

    Parameters
    ----------
    problem : Problem
        Of which unknowns.
    x : array
        Flat vector; a start, most often.

    Returns
    -------
    array, shape (S, S)
        In the order of `layout.shared`.

    Raises
    ------
    SolverError
        As `Marginals` does.
    """
    layout = problem.layout
    equations = NormalEquations(problem)
    point = equations.evaluate(x, problem.frozen(x))
    factor, scale, _ = scaled_factor(equations, point, RIDGES)
    units = [np.full(size, layout.unit(name)) for name, size in layout.shared]
    outer = scale[layout.inner :] * np.concatenate([np.empty(0), *units])
    return outer[:, None] * factor.inverse_corner() * outer


@dataclass(frozen=True, eq=False)
class _Inverse:
    """Blocks of the scaled inverse, and how far to trust them."""

    node: FloatArray
    following: FloatArray
    shared: FloatArray
    scale: FloatArray
    ridge: float
    doubtful: bool


def _invert(equations: NormalEquations, point: Point, ridges: Sequence[float]) -> _Inverse:
    """Invert with the first ridge that lets the factorisation pass."""
    factor, scale, ridge = scaled_factor(equations, point, ridges)
    width = equations.problem.layout.node_width
    node, following = selected_inverse(factor.band, width)
    shared = np.empty((0, 0))
    pivots = factor.band[0]
    if len(factor.corner):
        # The columns of A^-1 C say how much of each shared unknown's error a node takes over.
        share = factor.solve_transposed(factor.coupling).reshape(-1, width, len(factor.corner))
        shared = factor.inverse_corner()
        taken = share @ shared
        node += taken @ np.swapaxes(share, 1, 2)
        following += taken[:-1] @ np.swapaxes(share[1:], 1, 2)
        pivots = np.append(pivots, factor.corner.diagonal())
    doubtful = ridge > 0.0 or float(pivots.min()) ** 2 < DOUBTFUL_PIVOT
    return _Inverse(node, following, shared, scale, ridge, doubtful)


def scaled_factor(
    equations: NormalEquations, point: Point, ridges: Sequence[float]
) -> tuple[BandedFactor, FloatArray, float]:
    """Factor of the normal matrix scaled to unit diagonal, the columns' scale, and the ridge."""
    for ridge in ridges:
        band, coupling, corner = equations.matrix(point)
        diagonal = np.concatenate([band[0], corner.diagonal()])
        if not np.isfinite(diagonal).all() or (diagonal <= 0.0).any():
            raise SolverError("the covariances cannot be computed: an unknown enters no residual")
        scale: FloatArray = 1.0 / np.sqrt(diagonal)
        inner = band.shape[1]
        for lag in range(len(band)):
            band[lag, : inner - lag] *= scale[: inner - lag] * scale[lag:inner]
        coupling *= scale[:inner, None] * scale[inner:]
        corner *= scale[inner:, None] * scale[inner:]
        band[0] += ridge
        corner[np.diag_indices_from(corner)] += ridge
        try:
            return BandedFactor(band, coupling, corner), scale, ridge
        except np.linalg.LinAlgError:
            continue
    raise SolverError("the covariances cannot be computed: the normal equations are singular")


def selected_inverse(factor: FloatArray, width: int) -> tuple[FloatArray, FloatArray]:
    """Blocks of (L L')^-1 on the diagonal and right of it.

    Parameters
    ----------
    factor : array, shape (reach, n)
        L in lower band storage: factor[i - j, j] = L[i, j].
    width : int
        Columns of a node.

    Returns
    -------
    array, shape (N, width, width)
        Covariance of each node.
    array, shape (N - 1, width, width)
        Covariance of each node (rows) with the next one (columns).
    """
    count = factor.shape[1] // width
    composed = factor.shape[0] <= MOST_COMPOSED
    length = max(1, round(np.sqrt(count / 2.0))) if composed else count
    pieces = -(-count // length)
    # Nodes that only fill up the first piece stand before all others and change nothing.
    extra = pieces * length - count
    gain, noise = (
        blocks.reshape(pieces, length, width, -1) for blocks in _backward(factor, width, extra)
    )
    size = gain.shape[-1]
    beyond = _carried(*_composed(gain, noise)) if composed else np.zeros((1, size, size))
    # Each node's own covariance takes the place of its noise, which is not needed any more.
    node, following = noise, np.empty_like(noise)
    for k in range(length - 1, -1, -1):
        cross = gain[:, k] @ beyond
        here = cross @ np.swapaxes(gain[:, k], 1, 2) + noise[:, k]
        node[:, k] = 0.5 * (here + np.swapaxes(here, 1, 2))
        following[:, k] = cross[:, :, :width]
        beyond = _shifted(node[:, k], cross, beyond)
    return (
        node.reshape(-1, width, width)[extra:],
        following.reshape(-1, width, width)[extra:-1],
    )


def _backward(factor: FloatArray, width: int, extra: int) -> tuple[FloatArray, FloatArray]:
    """How each node depends on those that follow, behind `extra` empty nodes.

    Returns
    -------
    array, shape (extra + N, W, S)
        Gains G_k, of the S columns of the nodes in reach.
    array, shape (extra + N, W, W)
        Covariance of what they do not say.
    """
    reach, n = factor.shape
    count = n // width
    size = max(1, -(-(reach - 1) // width)) * width
    gain = np.zeros((extra + count, width, size))
    noise = np.zeros((extra + count, width, width))
    for first in range(0, count, AT_ONCE):
        nodes = min(AT_ONCE, count - first)
        there = slice(extra + first, extra + first + nodes)
        part = factor[:, first * width : (first + nodes) * width]
        block = np.zeros((nodes, width + size, width))
        for column in range(width):
            rows = min(reach, width + size - column)
            block[:, column : column + rows, column] = part[:rows, column::width].T
        inverse = _inverse_lower(block[:, :width])
        gain[there] = -np.swapaxes(block[:, width:] @ inverse, 1, 2)
        noise[there] = np.swapaxes(inverse, 1, 2) @ inverse
    return gain, noise


def _inverse_lower(lower: FloatArray) -> FloatArray:
    """Inverses of many small lower triangular matrices (N, W, W), row by row."""
    inverse = np.zeros_like(lower)
    for row in range(lower.shape[1]):
        own = 1.0 / lower[:, row, row]
        inverse[:, row, row] = own
        if row:
            before = np.einsum("nk,nkj->nj", lower[:, row, :row], inverse[:, :row, :row])
            inverse[:, row, :row] = -own[:, None] * before
    return inverse


def _composed(gain: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Each piece as one step: P at its first node is M P' M' + Q of P' beyond its last node."""
    pieces, length, width, size = gain.shape
    through = np.broadcast_to(np.eye(size), (pieces, size, size))
    added = np.zeros((pieces, size, size))
    for k in range(length - 1, -1, -1):
        g = gain[:, k]
        cross = g @ added
        here = cross @ np.swapaxes(g, 1, 2) + noise[:, k]
        through = np.concatenate([g @ through, through[:, : size - width]], axis=1)
        added = _shifted(here, cross, added)
    return through, added


def _carried(through: FloatArray, added: FloatArray) -> FloatArray:
    """P beyond the last node of each piece, from the last piece backwards: (pieces, S, S)."""
    beyond = np.zeros_like(added)
    for k in range(len(added) - 1, 0, -1):
        p = through[k] @ beyond[k] @ through[k].T + added[k]
        beyond[k - 1] = 0.5 * (p + p.T)
    return beyond


def _shifted(here: FloatArray, cross: FloatArray, beyond: FloatArray) -> FloatArray:
    """P one node earlier: the node comes in, the farthest one drops out."""
    width, size = here.shape[1], beyond.shape[1]
    keep = size - width
    out = np.empty_like(beyond)
    out[:, :width, :width] = here
    if keep:
        out[:, :width, width:] = cross[:, :, :keep]
        out[:, width:, :width] = np.swapaxes(cross[:, :, :keep], 1, 2)
        out[:, width:, width:] = beyond[:, :keep, :keep]
    return out
