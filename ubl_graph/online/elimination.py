"""Elimination of nodes: rows over the first nodes and what is shared, and what they leave.

By QR of all rows that touch a node: a square root keeps what is weakly known, a difference of
normal equations does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.factors.block import Block, LinearBlock
from ubl_graph.layout import Layout
from ubl_graph.online.rows import triangle


@dataclass(frozen=True, eq=False)
class RowsOf:
    """Linearised rows of pings, weighted by the loss.

    Attributes
    ----------
    columns : array of int, shape (M, C)
        Of the window; -1 pads.
    residual : array, shape (M,)
        Where the window stands.
    slope : array, shape (M, C)
        Its derivatives.
    """

    columns: IntArray
    residual: FloatArray
    slope: FloatArray


class NearRows(NamedTuple):
    """Rows over the first nodes and what is shared.

    Attributes
    ----------
    rows : array, shape (P, K)
        Whitened; the nodes' columns first.
    target : array, shape (P,)
        Right-hand sides.
    nodes : int
        How many nodes they reach.
    """

    rows: FloatArray
    target: FloatArray
    nodes: int


class Left(NamedTuple):
    """What eliminating nodes leaves.

    Attributes
    ----------
    rows, target : array, shape (P, K) and (P,)
        Rows over what remains, and right-hand sides.
    log_mass : float
        Logarithm of what integrating them out leaves of the posterior's mass, but for a constant.
    """

    rows: FloatArray
    target: FloatArray
    log_mass: float


def without_first(parts: Sequence[NearRows], width: int, border: int) -> Left:
    """Eliminate the first node, of `width` unknowns, from rows; `border` unknowns are shared."""
    nodes = max(part.nodes for part in parts)
    size = nodes * width + border
    stacked: list[FloatArray] = []
    for rows, target, reach in parts:
        whole = np.zeros((len(rows), size + 1))
        whole[:, : reach * width] = rows[:, : reach * width]
        whole[:, nodes * width : size] = rows[:, reach * width :]
        whole[:, -1] = target
        stacked.append(whole)
    return _left(np.concatenate(stacked), width, size)


def leapt(prior: NearRows, blocks: Sequence[Block], width: int, size: int) -> Left:
    """Carry the prior of a single node to another one by linear blocks between the two.

    Parameters
    ----------
    prior : NearRows
        Of the node.
    blocks : sequence of LinearBlock
        Over both nodes and what is shared.
    width, size : int
        Unknowns of a node, and of both with what is shared.
    """
    whole = np.zeros((len(prior.rows), size + 1))
    whole[:, :width] = prior.rows[:, :width]
    whole[:, 2 * width : size] = prior.rows[:, width:]
    whole[:, -1] = prior.target
    return _left(np.concatenate([whole, *(_dense(block, size) for block in blocks)]), width, size)


def _left(stacked: FloatArray, width: int, size: int) -> Left:
    # What stands below the node's own rows does not speak of it.
    whole = triangle(stacked)
    rest = whole[width:size, width:]
    return Left(rest[:, :-1], rest[:, -1], _left_mass(whole, width, size))


def near_rows(pings: RowsOf, nodes: FloatArray, common: FloatArray) -> NearRows:
    """Linearised pings as rows over the first nodes and what is shared.

    Parameters
    ----------
    pings : RowsOf
        Over the window's columns.
    nodes : array, shape (N, W)
        Where the window stands.
    common : array, shape (B,)
        What its nodes share.
    """
    w, b, inner = nodes.shape[1], len(common), nodes.size
    columns, slope = pings.columns, pings.slope
    inside = (columns >= 0) & (columns < inner)
    reach = int(np.where(inside, columns, 0).max(initial=0)) // w + 1
    local = np.where(columns < inner, columns, columns - inner + reach * w)
    local = np.where(columns < 0, reach * w + b, local)
    m = len(slope)
    size = reach * w + b + 1
    flat = (np.arange(m)[:, None] * size + local).ravel()
    sums: Any = np.bincount(flat, slope.ravel(), minlength=m * size)
    whole = sums.reshape(m, size)[:, :-1]
    x = np.concatenate([nodes[:reach].ravel(), common])
    return NearRows(whole, whole @ x - pings.residual, reach)


def columns_among(layout: Layout, nodes: int) -> dict[tuple[str, int, int], int]:
    """Place in a prior's row of each column of the first nodes and of what is shared."""
    places: dict[tuple[str, int, int], int] = {}
    behind = (layout.node_count - nodes) * layout.node_width
    for variable in layout.variables:
        inside = variable.column < nodes * layout.node_width
        if inside or variable.name in dict(layout.shared):
            at = variable.column - (0 if inside else behind)
            for i in range(variable.size):
                places[variable.name, variable.index, i] = at + i
    return places


def columns_known(before: Layout, after: Layout) -> set[int]:
    """Columns of the new layout's first node and shared states that the old one had."""
    names = {v.name for v in before.variables}
    taken: set[int] = set()
    for v in after.variables:
        if v.name in names:
            taken.update(range(v.column, v.column + v.size))
    return taken


def embedded(block: LinearBlock, layout: Layout, nodes: int) -> FloatArray:
    """Rows of a block over the first nodes and what is shared, right-hand side behind them."""
    rows = _dense(block, layout.size)
    inner = layout.node_count * layout.node_width
    return np.delete(rows, np.s_[nodes * layout.node_width : inner], axis=1)


def _left_mass(whole: FloatArray, width: int, size: int) -> float:
    """Logarithm of the integral over the first `width` of `size` columns, by the triangle of rows.

    The last column holds right-hand sides; what stands below all others is the least residual.
    """
    residual = float(np.sum(whole[size:, size] ** 2))
    pivots = np.abs(np.diagonal(whole)[:width])
    return -0.5 * residual - float(np.log(np.maximum(pivots, np.finfo(float).tiny)).sum())


def _dense(block: Block, size: int) -> FloatArray:
    """Rows of a linear block over all columns, right-hand side behind them."""
    assert isinstance(block, LinearBlock)
    m, r, _ = block.matrix.shape
    out = np.zeros((m, r, size + 2))
    columns = np.where(block.columns < 0, size + 1, block.columns)
    out[np.arange(m)[:, None, None], np.arange(r)[None, :, None], columns[:, None, :]] = (
        block.matrix
    )
    out[:, :, size] = block.target
    return out[:, :, : size + 1].reshape(m * r, -1)
