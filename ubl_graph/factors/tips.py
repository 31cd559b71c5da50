"""Poses at any times, points fixed to the vehicle, and what was measured of these.

Ranges, fixes and depths see points; `PoseAntenna` is the range residual's view of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from ubl_graph import lie
from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.factors.block import ALL_ROWS, CurvedBlock
from ubl_graph.factors.poses import PoseNodes
from ubl_graph.layout import Chain, Layout
from ubl_graph.pose_path import Poses, between, path_weights, still_weights
from ubl_graph.trajectory import bridge_variance, interpolation_variance, locate


class PosesAt:
    """Poses at any times of a chain, M of them.

    Parameters
    ----------
    layout, chain
        Whose nodes.
    times : array, shape (M,)
        Within the chain, s.

    Attributes
    ----------
    columns : array of int, shape (M, C)
        Columns that each pose is made of.
    variance_factor : array, shape (M,)
        Variance between the nodes at unit density, s^3.
    """

    def __init__(self, layout: Layout, chain: Chain, times: FloatArray) -> None:
        k, dt, s = locate(chain.t, times)
        self._still = layout.still
        self._at_nodes = bool(((s == 0.0) | (s == 1.0)).all())
        first = chain.first + k
        if self._at_nodes:
            nodes = first + (s == 1.0) if len(chain.t) > 1 else first
            self._ends = (PoseNodes(layout, nodes, moving=False),)
        else:
            self._ends = (PoseNodes(layout, first), PoseNodes(layout, first + 1))
        self.columns = np.concatenate([end.columns for end in self._ends], axis=1)
        within = bridge_variance if layout.still else partial(interpolation_variance, 2)
        self.variance_factor = within(dt, s)
        if layout.still:
            self._weights = still_weights(s)
        else:
            self._weights = path_weights(dt, s)

    def at(
        self, x: FloatArray, rows: slice = ALL_ROWS
    ) -> tuple[FloatArray, FloatArray, PoseSlopes]:
        """Positions (m, 3), rotations (m, 3, 3), and what gives their derivatives."""
        ends = [end.at(x, rows) for end in self._ends]
        if self._at_nodes:
            pose = ends[0]
            own = np.zeros((len(pose.position), 6, 12))
            own[:, :, :6] = np.eye(6)
            return pose.position, pose.rotation, PoseSlopes(self, ends, [own])
        way = between(ends[0], ends[1], self._weights[rows])
        position, rotation = way.position, way.rotation
        first, second = way.slopes()
        return position, rotation, PoseSlopes(self, ends, [first, second])

    def to_columns(
        self, poses: Sequence[Poses], slopes: Sequence[FloatArray], left: FloatArray
    ) -> FloatArray:
        """Derivatives by the columns of what depends on the poses by `left` (m, R, 6)."""
        parts = [
            end.to_columns(pose, left @ slope)
            for end, pose, slope in zip(self._ends, poses, slopes, strict=True)
        ]
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=2)


@dataclass(frozen=True, eq=False)
class PoseSlopes:
    """How poses between nodes move and turn, in their own axes, as the nodes do.

    Attributes
    ----------
    of : PosesAt
        Which poses.
    ends : list of Poses
        The nodes.
    by_end : list of array, shape (m, 6, 12)
        Derivatives by the motions of each node.
    """

    of: PosesAt
    ends: list[Poses]
    by_end: list[FloatArray]

    def to_columns(self, left: FloatArray) -> FloatArray:
        """Derivatives (m, R, C) of what changes by `left` (m, R, 6) as the poses move and turn."""
        return self.of.to_columns(self.ends, self.by_end, left)


class TipTerms(NamedTuple):
    """What gives the derivatives of points fixed to the vehicle.

    Attributes
    ----------
    rotation : array, shape (m, 3, 3)
        `world_R_body`.
    slopes : PoseSlopes
        Of the poses.
    cross : array, shape (3, 3) or (m, 3, 3)
        The cross-product matrix of the arm, or of each, body axes.
    """

    rotation: FloatArray
    slopes: PoseSlopes
    cross: FloatArray


class Tips:
    """Points fixed to the vehicle, at any times.

    Parameters
    ----------
    poses : PosesAt
        M poses of the vehicle.
    arm : array, shape (3,)
        Reference point to the point, body axes, m.
    psd : array, shape (6,)
        Noise density of the motion along and about the body's axes.
    off : array of int, shape (3,), optional
        Where what `arm` is off by (body axes, m) stands in the flat vector.
    """

    def __init__(
        self, poses: PosesAt, arm: FloatArray, psd: FloatArray, off: IntArray | None = None
    ) -> None:
        self._poses, self._arm, self._off = poses, arm, off
        self._cross = lie.cross_matrix(arm[None])[0]
        self._has_arm = off is not None or bool(arm.any())
        noise = np.diag(psd[:3]) + self._cross @ np.diag(psd[3:]) @ self._cross.T
        self._noise = poses.variance_factor[:, None, None] * noise
        level = np.array([0.5 * (noise[0, 0] + noise[1, 1])] * 2 + [noise[2, 2]])
        self._level = poses.variance_factor[:, None] * level
        self.columns = poses.columns
        if off is not None:
            columns = np.broadcast_to(off, (len(poses.columns), 3))
            self.columns = np.concatenate([poses.columns, columns], axis=1)

    def at(self, x: FloatArray, rows: slice) -> tuple[FloatArray, TipTerms]:
        """Points (m, 3), m, and what gives their derivatives."""
        position, rotation, slopes = self._poses.at(x, rows)
        cross = self._cross
        if self._has_arm:
            arm = self._arm if self._off is None else self._arm + x[self._off]
            cross = cross if self._off is None else lie.cross_matrix(arm[None])[0]
            position = position + rotation @ arm
        return position, TipTerms(rotation, slopes, cross)

    def slopes(self, left: FloatArray, terms: TipTerms) -> FloatArray:
        """Derivatives (m, R, C) of what changes by `left` (m, R, 3) as the points move."""
        moved = left @ terms.rotation
        turned = -moved @ terms.cross if self._has_arm else np.zeros_like(moved)
        by_poses = terms.slopes.to_columns(np.concatenate([moved, turned], axis=2))
        return by_poses if self._off is None else np.concatenate([by_poses, moved], axis=2)

    def variance(self, terms: TipTerms) -> FloatArray:
        """Covariance of the points' motion between the nodes, world axes, (M, 3, 3), m^2."""
        rotation = terms.rotation
        return rotation @ self._noise @ np.swapaxes(rotation, 1, 2)

    @property
    def level_variance(self) -> FloatArray:
        """Variance of the motion between nodes of a level vehicle, (M, 3), m^2."""
        return self._level


class PoseAntenna:
    """Transducer on pose nodes at the L legs of M pings (`ranges.Antenna`).

    Parameters
    ----------
    tips : Tips
        The transducer at each leg's time, rows ping after ping (M * L).
    legs : int
        Legs L of a ping.
    """

    def __init__(self, tips: Tips, legs: int) -> None:
        self.legs, self._tips = legs, tips
        self.columns = tips.columns.reshape(-1, legs * tips.columns.shape[1])

    def positions(self, x: FloatArray, rows: slice) -> tuple[FloatArray, TipTerms]:
        """Positions (m, L, 3) at `x`, m."""
        every = slice(
            None if rows.start is None else rows.start * self.legs,
            None if rows.stop is None else rows.stop * self.legs,
        )
        tips, terms = self._tips.at(x, every)
        return tips.reshape(-1, self.legs, 3), terms

    def slopes(
        self,
        gradient: FloatArray,
        terms: TipTerms,
        rows: slice,  # noqa: ARG002 - the protocol's form
    ) -> FloatArray:
        """Derivatives (m, W) by the columns, given those by the positions (m, L, 3)."""
        slopes = self._tips.slopes(gradient.reshape(-1, 1, 3), terms)
        return slopes.reshape(len(gradient), -1)

    def variance(self, gradient: FloatArray, terms: TipTerms) -> FloatArray:
        """Variance of the motion between the nodes along the gradients, (M,)."""
        along = gradient.reshape(-1, 3)
        variance = np.einsum("mi,mij,mj->m", along, self._tips.variance(terms), along)
        return variance.reshape(-1, self.legs).sum(axis=1)


class TipBlock(CurvedBlock):
    """Whitened residuals of points fixed to the vehicle: what was measured of their places.

    Parameters
    ----------
    name : str
        What the block is.
    tips : Tips
        M points.
    components : array of int, shape (R,)
        Which of east, north and up were measured.
    measured : array, shape (M, R)
        m.
    covariance : array, shape (M, R, R)
        m^2; that of the motion between the nodes is added.
    """

    def __init__(
        self,
        name: str,
        tips: Tips,
        components: IntArray,
        measured: FloatArray,
        covariance: FloatArray,
    ) -> None:
        self.name, self.columns = name, tips.columns
        self._tips, self._components = tips, components
        self._measured = measured
        diagonal = np.arange(len(components))
        whole = covariance.copy()
        whole[:, diagonal, diagonal] += tips.level_variance[:, components]
        self._whitening = np.linalg.inv(np.linalg.cholesky(whole))

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
        tips, terms = self._tips.at(x, rows)
        keep = self._components
        whitening = self._whitening[rows]
        value = tips[:, keep] - self._measured[rows]
        residual = np.einsum("mij,mj->mi", whitening, value)
        if not jacobian:
            return residual, None
        left = np.zeros((len(tips), len(keep), 3))
        left[:, np.arange(len(keep)), keep] = 1.0
        return residual, whitening @ self._tips.slopes(left, terms)
