"""Compass readings of pose nodes: one angle each, at any time."""

from __future__ import annotations

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.factors.block import ALL_ROWS, CurvedBlock
from ubl_graph.factors.tips import PosesAt
from ubl_graph.layout import Interpolation


class CompassBlock(CurvedBlock):
    """Whitened heading residuals: heading of the pose plus bias minus reading, one component.

    Parameters
    ----------
    poses : PosesAt
        M poses at the readings' times.
    measured, sigma : array, shape (M,)
        Heading, clockwise from true north, and its standard deviation, rad.
    bias : Interpolation, optional
        Of what the reference reads too far clockwise (M rows, one component), rad.
    name : str
        What the block is.
    """

    def __init__(
        self,
        poses: PosesAt,
        measured: FloatArray,
        sigma: FloatArray,
        bias: Interpolation | None = None,
        name: str = "heading",
    ) -> None:
        self.name = name
        self._poses, self._measured, self._sigma, self._bias = poses, measured, sigma, bias
        parts = [poses.columns]
        if bias is not None:
            parts.append(bias.columns[:, :, 0])
        self.columns = np.concatenate(parts, axis=1)

    def log_det(self) -> float:
        """Sum of the logarithms of what whitens the rows."""
        return -float(np.log(self._sigma).sum())

    def evaluate(
        self,
        x: FloatArray,
        frozen: FloatArray | None = None,  # noqa: ARG002 - the protocol's form
        rows: slice = ALL_ROWS,
        jacobian: bool = True,
    ) -> tuple[FloatArray, FloatArray | None]:
        """Whitened residuals (m, 1) of `rows` at `x` and Jacobians (m, 1, C)."""
        _, rotation, slopes = self._poses.at(x, rows)
        east, north = rotation[:, 0, 0], rotation[:, 1, 0]
        off = 0.5 * np.pi - np.arctan2(north, east) - self._measured[rows]
        if self._bias is not None:
            columns, weights = self._bias.columns[rows][:, :, 0], self._bias.weights[rows]
            off = off + (x[columns] * weights).sum(axis=1)
        inverse = 1.0 / self._sigma[rows]
        residual = (np.remainder(off + np.pi, 2.0 * np.pi) - np.pi) * inverse
        if not jacobian:
            return residual[:, None], None
        # The bow R e1 moves by R (turn x e1) = R (0, turn_up, -turn_left).
        level = east**2 + north**2
        by_left = -(east * -rotation[:, 1, 2] + north * rotation[:, 0, 2]) / level
        by_up = -(east * rotation[:, 1, 1] - north * rotation[:, 0, 1]) / level
        left = np.zeros((len(off), 1, 6))
        left[:, 0, 4], left[:, 0, 5] = by_left, by_up
        parts = [slopes.to_columns(left)]
        if self._bias is not None:
            parts.append(self._bias.weights[rows][:, None, :])
        return residual[:, None], np.concatenate(parts, axis=2) * inverse[:, None, None]
