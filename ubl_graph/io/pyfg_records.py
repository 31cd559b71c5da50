"""The poses of a PyFG file in their order, and their edges, ranges and priors as records.

The file's body axes x, y, z are taken as forward, left, up, and its world's as east, north, up.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ubl_graph.arrays import BoolArray, FloatArray, IntArray
from ubl_graph.errors import ConfigurationError, DataError
from ubl_graph.io.pyfg_graph import PyfgGraph, Rows
from ubl_graph.lie import cross_matrix
from ubl_graph.measurements import Heading, Odometry, PositionFix, SlantRange
from ubl_graph.records import Source

#: A start belongs to the pose whose time is so near, s: decimals in two files.
START_TOLERANCE = 1e-6
#: Position and heading of a prior that are less correlated are so by rounding alone.
_UNCORRELATED = 1e-9
#: Forward, left, up to forward, right, down, for vectors and rotation vectors.
_FRD: FloatArray = np.array([1.0, -1.0, -1.0])


class _Lines(Source):
    """Lines of a PyFG file: there are no rows to count beside them."""

    def __getitem__(self, index: Any) -> _Lines:
        return _Lines(self.file, self.row[index], self.line[index])

    def error(self, index: int, field: str | None, problem: str, remedy: str = "") -> DataError:
        return DataError(
            problem, remedy, file=self.file, line=int(self.line[index]), field=field or None
        )


class Track:
    """The poses in their order, cut where no edge joins neighbours.

    Parameters
    ----------
    graph : PyfgGraph
        Of one vehicle.
    t : array, shape (N,)
        Times of the poses, s.

    Attributes
    ----------
    run : array, shape (N,)
        Number of the run that each pose belongs to.
    edges : array, shape (M, 2)
        Poses of each edge.
    """

    def __init__(self, graph: PyfgGraph, t: FloatArray) -> None:
        self.graph, self.t = graph, t
        numbers = {name: i for i, name in enumerate(graph.poses.first)}
        self.edges = _numbers([[numbers[a], numbers[b]] for a, b in graph.pose_edges.name.tolist()])
        self.edges = self.edges.reshape(-1, 2)
        joined = np.zeros(len(t) - 1, dtype=np.bool_)
        neighbours = np.abs(self.edges[:, 0] - self.edges[:, 1]) == 1
        joined[self.edges[neighbours].min(axis=1)] = True
        self.run = _numbers(np.concatenate([[0], np.cumsum(~joined)]))
        self._check_runs()
        # A name that is no pose's is a landmark's, whichever of the two stands first.
        pairs = graph.ranges.name.tolist()
        ends = [(numbers[a], b) if a in numbers else (numbers[b], a) for a, b in pairs]
        self._ranging = _numbers([pose for pose, _ in ends])
        self._beacons = np.array([name for _, name in ends], dtype=np.str_)
        self._prior = _numbers([numbers[name] for name in graph.pose_priors.first])
        self._heading, self._heading_sigma = _headings(graph)

    def _check_runs(self) -> None:
        across = self.run[self.edges[:, 0]] != self.run[self.edges[:, 1]]
        if not across.any():
            return
        i = int(np.argmax(across))
        names = self.graph.poses.first
        ends = sorted(self.edges[i].tolist())
        gap = int(np.searchsorted(self.run, self.run[ends[0]], side="right"))
        raise self.graph.error(
            "pose_edges",
            i,
            f"the edge bridges a gap: none joins '{names[gap - 1]}' and '{names[gap]}', which "
            "follow one another in the file",
            "let poses stand along the track, and join neighbours",
        )

    def pose_at(self, t: float) -> int:
        """Number of the pose at a time (s)."""
        i = int(np.argmin(np.abs(self.t - t)))
        if abs(self.t[i] - t) > START_TOLERANCE:
            raise ConfigurationError(
                f"there is no pose at {t} s",
                f"the nearest is '{self.graph.poses.first[i]}' at {self.t[i]} s"
                + ("" if self.graph.poses.t.any() else " (stamps are zero: poses are counted)"),
                field="start.t",
            )
        return i

    def odometry(self, run: int) -> Odometry | None:
        """Edges within a run; such as lead back in time are turned round."""
        mask = self.run[self.edges[:, 0]] == run
        if not mask.any():
            return None
        rows, planar = self.graph.pose_edges, self.graph.dimension == 2
        position, turn = rows.position[mask], rows.rotation_vector[mask]
        covariance = rows.covariance[mask]
        if planar:
            position = np.column_stack([position, np.zeros(len(position))])
            # Whole turns are none; what is within half of one stays as it stands.
            wrapped = np.remainder(turn + np.pi, 2.0 * np.pi) - np.pi
            turn = np.where(np.abs(turn) > np.pi, wrapped, turn)
        ends = self.edges[mask]
        back = ends[:, 0] > ends[:, 1]
        if back.any():
            position, turn, covariance = position.copy(), turn.copy(), covariance.copy()
            position[back], turn[back], covariance[back] = reversed_edges(
                position[back], turn[back], covariance[back]
            )
        signs = _FRD if planar else np.tile(_FRD, 2)
        forward, right, down = (position * _FRD).T
        about_forward, about_right, about_down = (turn * _FRD).T
        spatial = (down, about_forward, about_right)
        return Odometry(
            self.t[ends.min(axis=1)],
            self.t[ends.max(axis=1)],
            forward,
            right,
            *((None, None, None) if planar else spatial),
            about_down,
            covariance * np.outer(signs, signs),
            self._source(rows, mask),
        )

    def slant_range(self, run: int) -> SlantRange | None:
        """Ranges from the poses of a run."""
        mask = self.run[self._ranging] == run
        if not mask.any():
            return None
        rows = self.graph.ranges
        return SlantRange(
            self.t[self._ranging[mask]],
            self._beacons[mask],
            rows.distance[mask],
            np.sqrt(rows.variance[mask]),
            self._source(rows, mask),
        )

    def position(self, run: int) -> PositionFix | None:
        """Positions of the priors on poses of a run, with their covariances."""
        mask = self.run[self._prior] == run
        if not mask.any():
            return None
        rows, d = self.graph.pose_priors, self.graph.dimension
        return PositionFix(
            self.t[self._prior[mask]],
            *rows.position[mask].T,
            covariance=rows.covariance[mask][:, :d, :d],
            source=self._source(rows, mask),
        )

    def heading(self, run: int) -> Heading | None:
        """Headings of the same priors, but for those that know none (sigma over half a turn)."""
        mask = (self.run[self._prior] == run) & (self._heading_sigma <= np.pi)
        if not mask.any():
            return None
        return Heading(
            self.t[self._prior[mask]],
            self._heading[mask],
            self._heading_sigma[mask],
            self._source(self.graph.pose_priors, mask),
        )

    def _source(self, rows: Rows, mask: BoolArray) -> Source | None:
        if self.graph.file is None:
            return None
        return _Lines(self.graph.file, rows.line[mask], rows.line[mask])


def _numbers(values: Any) -> IntArray:
    return np.array(values, dtype=np.int64)


def _headings(graph: PyfgGraph) -> tuple[FloatArray, FloatArray]:
    """Headings of the priors on poses and their standard deviations, rad, shape (M,)."""
    rows, d = graph.pose_priors, graph.dimension
    matrix = Rotation.from_rotvec(rows.rotation_vector).as_matrix()
    east, north = matrix[:, 0, 0], matrix[:, 1, 0]
    level = east**2 + north**2
    upright = level < 1e-12
    if upright.any():
        i = int(np.argmax(upright))
        problem = "the bow points up or down: it has no heading"
        raise graph.error("pose_priors", i, problem, "take the prior out")
    # The bow R e1 moves by R (turn x e1) = R (0, turn_up, -turn_left).
    by_left = (east * matrix[:, 1, 2] - north * matrix[:, 0, 2]) / level
    by_up = (north * matrix[:, 0, 1] - east * matrix[:, 1, 1]) / level
    slopes = np.stack([np.zeros(len(rows)), by_left, by_up], axis=1)[:, 2 if d == 2 else 0 :]
    variance = np.einsum("mi,mij,mj->m", slopes, rows.covariance[:, d:, d:], slopes)
    shared = np.abs(np.einsum("mij,mj->mi", rows.covariance[:, :d, d:], slopes))
    places = np.diagonal(rows.covariance, axis1=1, axis2=2)[:, :d]
    correlated = (shared > _UNCORRELATED * np.sqrt(places * variance[:, None])).any(axis=1)
    if correlated.any():
        raise graph.error(
            "pose_priors",
            int(np.argmax(correlated)),
            "position and heading of the prior are correlated",
            "a mission takes them apart: set these covariances to 0",
        )
    return np.arctan2(east, north), np.sqrt(variance)


def reversed_edges(
    position: FloatArray, turn: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The first poses of edges as seen from the second, with covariances of first order.

    Parameters
    ----------
    position : array, shape (M, 3)
        The second pose as seen from the first, m.
    turn : array, shape (M, 3)
        Its rotation vector, rad.
    covariance : array, shape (M, 6, 6) or (M, 3, 3)
        Over position in the first pose's axes and turn in the second's, or over x, y and the turn
        about z; m^2, m rad and rad^2.

    Returns
    -------
    tuple of array
        The same of the edges turned round.
    """
    back = np.swapaxes(Rotation.from_rotvec(turn).as_matrix(), 1, 2)
    place = -np.einsum("mij,mj->mi", back, position)
    # With p + n and R Exp(m): R' becomes Exp(-m) R' = R' Exp(-R m), and -R' p moves by
    # -R' n - m x (-R' p) = -R' n + place x m.
    slope = np.zeros((len(position), 6, 6))
    slope[:, :3, :3] = -back
    slope[:, 3:, 3:] = -np.swapaxes(back, 1, 2)
    slope[:, :3, 3:] = cross_matrix(place)
    if covariance.shape[1] == 3:
        slope = slope[:, [[0], [1], [5]], [0, 1, 5]]
    return place, -turn, slope @ covariance @ np.swapaxes(slope, 1, 2)
