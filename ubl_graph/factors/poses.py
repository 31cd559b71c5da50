"""Poses of nodes and between them, with derivatives, and blocks of residuals made of them.

A planar pose is computed as one in space whose up, roll and pitch are held, so every residual of
poses is written once. Derivatives are taken by what moves and turns a pose in its own axes (12 a
node: moved, turned, velocity, rate of three each, forward-left-up) and carried to the columns at
the end.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ubl_graph import lie
from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.factors.block import ALL_ROWS, CurvedBlock
from ubl_graph.layout import POSE_PLACES, Layout
from ubl_graph.pose_path import Poses

#: Derivatives of a residual by 12 a node.
MOVED, TURNED, ALONG, ABOUT = (slice(3 * i, 3 * i + 3) for i in range(4))


class PoseNodes:
    """The poses of some nodes, one a row: out of the flat vector, and derivatives back to it.

    Parameters
    ----------
    layout : Layout
        Of pose nodes.
    nodes : array of int, shape (M,)
        Their numbers.
    moving : bool
        Whether their velocities and rates are looked at too.
    """

    def __init__(self, layout: Layout, nodes: IntArray, moving: bool = True) -> None:
        width = layout.kinematic_width if moving else layout.pose_width
        self.columns = layout.motion_columns(nodes)[:, :width]
        self._places = POSE_PLACES[layout.node][:width]
        self._up = layout.up_of(nodes)

    def at(self, x: FloatArray, rows: slice = ALL_ROWS) -> Poses:
        """The poses of `rows` at the flat vector `x`."""
        columns = self.columns[rows]
        whole = np.zeros((len(columns), 12))
        whole[:, self._places] = x[columns]
        whole[:, 2] += self._up[rows]
        vector = whole[:, TURNED]
        return Poses(
            whole[:, MOVED], lie.rotation(vector), lie.rotation_slope(vector), whole[:, 6:]
        )

    def to_columns(self, poses: Poses, slopes: FloatArray) -> FloatArray:
        """Derivatives by the columns, (m, R, C), of those by motions in the body, (m, R, 12)."""
        out = slopes.copy()
        out[:, :, MOVED] = slopes[:, :, MOVED] @ np.swapaxes(poses.rotation, 1, 2)
        out[:, :, TURNED] = slopes[:, :, TURNED] @ poses.slope
        return out[:, :, self._places]


#: Of poses at the ends, further unknowns (m, E) in SI and rows: the residuals (m, R), their
#: derivatives by the motions of each end (m, R, 12), and by the further unknowns (m, R, E).
PoseResidual = Callable[
    [Sequence[Poses], FloatArray, slice], tuple[FloatArray, list[FloatArray], FloatArray]
]


class PoseBlock(CurvedBlock):
    """Whitened residuals of poses at nodes.

    Parameters
    ----------
    name : str
        What the block is.
    ends : sequence of PoseNodes
        Poses that a row sees, M rows each.
    residual : callable
        Gives residuals and derivatives.
    whitening : array, shape (M, R, R)
        W with W cov W' = 1, of the components that count.
    components : array of int, shape (R,)
        Which components of the residual count: a planar vehicle has fewer.
    extra : array of int, shape (M, E), optional
        Columns of further unknowns.
    units : array, shape (E,), optional
        SI value of one in each of those columns.
    """

    def __init__(
        self,
        name: str,
        ends: Sequence[PoseNodes],
        residual: PoseResidual,
        whitening: FloatArray,
        components: IntArray,
        extra: IntArray | None = None,
        units: FloatArray | None = None,
    ) -> None:
        self.name = name
        self._ends, self._residual = ends, residual
        self._whitening, self._components = whitening, components
        m = len(whitening)
        self._extra = np.empty((m, 0), dtype=np.int64) if extra is None else extra
        self._units = np.ones(self._extra.shape[1]) if units is None else units
        self.columns = np.concatenate([*(end.columns for end in ends), self._extra], axis=1)

    def log_det(self) -> float:
        """Sum of the logarithms of what whitens the rows."""
        return float(np.linalg.slogdet(self._whitening)[1].sum())

    def evaluate(
        self,
        x: FloatArray,
        frozen: FloatArray | None = None,  # noqa: ARG002 - the protocol's form
        rows: slice = ALL_ROWS,
        jacobian: bool = True,
    ) -> tuple[FloatArray, FloatArray | None]:
        """Whitened residuals (m, R) of `rows` at `x` and Jacobians (m, R, C)."""
        poses = [end.at(x, rows) for end in self._ends]
        extra = x[self._extra[rows]] * self._units
        value, slopes, by_extra = self._residual(poses, extra, rows)
        whitening, keep = self._whitening[rows], self._components
        residual = np.einsum("mij,mj->mi", whitening, value[:, keep])
        if not jacobian:
            return residual, None
        parts = [
            end.to_columns(pose, slope[:, keep])
            for end, pose, slope in zip(self._ends, poses, slopes, strict=True)
        ]
        parts.append(by_extra[:, keep] * self._units)
        return residual, whitening @ np.concatenate(parts, axis=2)


class PoseMotion(PoseBlock):
    """The motion prior between nodes: rows that GTSAM has a factor for.

    Attributes
    ----------
    dt : array, shape (M,)
        Between the nodes, s.
    psd : array, shape (M, 6)
        Noise density along and about the body's axes.
    """

    dt: FloatArray
    psd: FloatArray

    def __init__(
        self,
        ends: Sequence[PoseNodes],
        residual: PoseResidual,
        whitening: FloatArray,
        components: IntArray,
        dt: FloatArray,
        psd: FloatArray,
    ) -> None:
        super().__init__("motion", ends, residual, whitening, components)
        self.dt, self.psd = dt, psd
