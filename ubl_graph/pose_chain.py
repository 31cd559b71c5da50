"""A track of odometry laid over a chain of knots: residuals of many answers at once.

Odometry says how a track is shaped, not where it lies. The track is cut into windows within
which its shape holds; at each joint stands a knot: where the joint is, P_c, and how far the
track is turned there, a_c. Seen from a knot, a point of the track is at

    p(t) = P_c + (1 + s) exp(i a_c) int_{t_c}^t exp(i b (u - t_c)) dz(u),

with dz the odometry's steps in the horizontal plane (complex numbers, east + i north), s its
scale error and b what it turns too far clockwise, rad/s. The two views of a point from the knots
around it are blended linearly in time, and that they agree at the joints is a residual, as sure
as the odometry is over the window. Ranges read |p - beacon| exp(g).
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.factors.loss import WIDTHS
from ubl_graph.pose_windows import (
    Anchors,
    ReckonedTrack,
    TrackRanges,
    Unknowns,
    cut,
    drift_between,
    select,
)

ComplexArray = NDArray[np.complex128]
Sums = tuple[ComplexArray, ComplexArray]

#: Columns shared by all windows, and how many a knot has: east, north, up, turn.
TURN_BIAS, SCALE, RANGE_SCALE = 0, 1, 2
SHARED, KNOT = 3, 4
#: The knots at its ends take up all but this share of a window's drift.
DRIFT_LEFT = 0.25
#: Odometry is never believed better than this at a joint: m, rad.
LEAST_DRIFT, LEAST_TURN = 1e-3, 1e-5
#: Cauchy width in sigmas, 95 % efficient on normal noise.
WIDTH = WIDTHS["cauchy"]


@dataclass(frozen=True, eq=False)
class Points:
    """Q points that the track carries along, in order of time.

    Attributes
    ----------
    window : array, shape (Q,)
        The window that a point lies in.
    share : array, shape (Q,)
        How far it lies from the window's first knot to its second, in time.
    step, mark : array, shape (Q,)
        The node before it, and that node's rank among the chain's marks.
    fraction : array, shape (Q,)
        How far it lies from that node to the next.
    offset : complex array, shape (Q,)
        What the chord between these two misses it by (lever arm), m.
    up, yaw, elapsed : array, shape (Q,)
        By the track: m, rad, s since its beginning.
    """

    window: IntArray
    share: FloatArray
    step: IntArray
    mark: IntArray
    fraction: FloatArray
    offset: ComplexArray
    up: FloatArray
    yaw: FloatArray
    elapsed: FloatArray

    def within(self, windows: int) -> Points:
        """Those of the first windows."""
        return select(self, slice(0, int(np.searchsorted(self.window, windows))))


@dataclass(frozen=True, eq=False)
class View:
    """Q points as S answers see them from a knot, with derivatives of the horizontal place."""

    place: ComplexArray
    up: FloatArray
    yaw: FloatArray
    lasted: FloatArray
    by_bias: ComplexArray
    by_scale: ComplexArray
    by_turn: ComplexArray


@dataclass(frozen=True, eq=False)
class Rows:
    """Whitened residuals (S, R), Jacobians over a window's 11 columns, and the windows (R,)."""

    residual: FloatArray
    jacobian: FloatArray
    window: IntArray


class Chain:
    """Residuals of a track cut into windows.

    An answer is a vector of turn bias (rad/s), scale, range scale, and of each knot east, north,
    up (m) and turn (rad).

    Parameters
    ----------
    track : ReckonedTrack
    ranges : TrackRanges
    unknowns : Unknowns
    anchors : Anchors
    """

    def __init__(
        self, track: ReckonedTrack, ranges: TrackRanges, unknowns: Unknowns, anchors: Anchors
    ) -> None:
        self.track, self.unknowns = track, unknowns
        self.yaw = np.unwrap(track.yaw)
        self.z = track.position[:, 0] + 1j * track.position[:, 1]
        self.chord = np.diff(self.z)
        self.ranges: TrackRanges = select(ranges, np.argsort(ranges.t, kind="stable"))
        self.anchors: Anchors = select(anchors, np.argsort(anchors.t, kind="stable"))
        self.joints = cut(track, self.ranges)
        self.windows = len(self.joints) - 1
        drift, turn = drift_between(track, self.joints[:-1], self.joints[1:])
        self.drift, self.turn_drift = np.maximum(drift, LEAST_DRIFT), np.maximum(turn, LEAST_TURN)
        times = [self.ranges.t, self.anchors.t, track.t[self.joints[1:]]]
        steps = [
            np.clip(np.searchsorted(track.t, t, "right") - 1, 0, len(track.t) - 2) for t in times
        ]
        self._gather(np.unique(np.concatenate([*steps, self.joints])))
        self.sighted, self.anchored, self.joined = (
            self._points(t, step) for t, step in zip(times, steps, strict=True)
        )
        self.sighted.up[:] = self.ranges.antenna[:, 2]
        antenna = self.ranges.antenna[:, 0] + 1j * self.ranges.antenna[:, 1]
        s = self.sighted
        s.offset[:] = antenna - (self.z[s.step] + s.fraction * self.chord[s.step])
        # A joint is the end of its window, not the beginning of the next.
        self.joined.window[:] = np.arange(self.windows)
        self.weight = 1.0 / np.hypot(self.ranges.sigma, DRIFT_LEFT * drift[s.window])

    def _points(self, t: FloatArray, step: IntArray) -> Points:
        track, begins = self.track, self.track.t[self.joints]
        window = np.clip(np.searchsorted(begins, t, "right") - 1, 0, self.windows - 1)
        return Points(
            window=window,
            share=(t - begins[window]) / (begins[window + 1] - begins[window]),
            step=step,
            mark=np.searchsorted(self.marks, step),
            fraction=(t - track.t[step]) / (track.t[step + 1] - track.t[step]),
            offset=np.zeros(len(t), dtype=np.complex128),
            up=np.interp(t, track.t, track.position[:, 2]),
            yaw=np.interp(t, track.t, self.yaw),
            elapsed=t - track.t[0],
        )

    def _gather(self, marks: IntArray) -> None:
        """Sum the steps from mark to mark, and say when the turn bias meets each sum.

        Within so short a piece the bias turns all steps as it does in their middle.
        """
        self.marks, self.joint_marks = marks, np.searchsorted(marks, self.joints)
        elapsed = self.track.t - self.track.t[0]
        self.mark_elapsed = elapsed[self.marks]
        begin = self.marks[:-1]
        length = np.abs(self.chord) + 1e-9
        total = np.add.reduceat(length, begin)
        self.piece = np.add.reduceat(self.chord, begin)
        self.piece_elapsed = np.add.reduceat(length * elapsed[:-1], begin) / total

    def predict(self, theta: FloatArray, windows: int) -> FloatArray:
        """Lengthen answers (S, columns) up to so many windows, as odometry goes on."""
        have = (theta.shape[1] - SHARED) // KNOT
        for w in range(have - 1, windows):
            at = self._at_joint(w)
            view = self.view(theta, at, at.window)
            knot = [view.place.real, view.place.imag, view.up, view.yaw - at.yaw]
            theta = np.concatenate([theta, *knot], axis=1)
        return theta

    def _at_joint(self, window: int) -> Points:
        return select(self.joined, slice(window, window + 1))

    def view(
        self, theta: FloatArray, points: Points, knot: IntArray, sums: Sums | None = None
    ) -> View:
        """Points as seen from the knots named for each; `sums` saves summing the way anew."""
        bias, scale = theta[:, TURN_BIAS, None], 1.0 + theta[:, SCALE, None]
        column = SHARED + KNOT * knot
        origin = theta[:, column] + 1j * theta[:, column + 1]
        mark, at_knot = points.mark, self.joint_marks[knot]
        total, slope = self._sums(theta, points) if sums is None else sums
        begun, knot_begun = self.mark_elapsed[mark], self.mark_elapsed[at_knot]
        turned = np.exp(1j * bias * begun)
        piece = points.fraction * self.chord[points.step] * turned
        way = total[:, mark] + piece - total[:, at_knot]
        way_slope = slope[:, mark] + 1j * begun * piece - slope[:, at_knot]
        facing = np.exp(1j * (theta[:, column + 3] - bias * knot_begun))
        by_scale = facing * way
        lever = facing * turned * points.offset
        seen = scale * by_scale + lever
        lasted = points.elapsed - knot_begun
        return View(
            place=origin + seen,
            up=theta[:, column + 2] + points.up - self.track.position[self.joints[knot], 2],
            yaw=points.yaw + theta[:, column + 3] + bias * lasted,
            lasted=lasted,
            by_bias=scale * (facing * way_slope - 1j * knot_begun * by_scale)
            + 1j * (begun - knot_begun) * lever,
            by_scale=by_scale,
            by_turn=1j * seen,
        )

    def _sums(self, theta: FloatArray, points: Points) -> Sums:
        """Way from the track's beginning to each mark, turned by the bias, and its derivative.

        Only to the end of the last point's window.
        """
        count = self.joint_marks[points.window.max(initial=0) + 1]
        pieces = self.piece[:count] * np.exp(
            1j * theta[:, TURN_BIAS, None] * self.piece_elapsed[:count]
        )
        way = np.zeros((2, len(theta), count + 1), dtype=np.complex128)
        np.cumsum(pieces, axis=1, out=way[0, :, 1:])
        np.cumsum(1j * self.piece_elapsed[:count] * pieces, axis=1, out=way[1, :, 1:])
        return way[0], way[1]

    def _blend(self, theta: FloatArray, points: Points) -> tuple[View, ComplexArray]:
        """Points seen from both knots; derivatives of the place over the 11 columns, ups apart."""
        sums = self._sums(theta, points)
        one = self.view(theta, points, points.window, sums)
        two = self.view(theta, points, points.window + 1, sums)
        near, far = 1.0 - points.share, points.share
        slopes = np.zeros((*one.place.shape, SHARED + 2 * KNOT), dtype=np.complex128)
        slopes[..., TURN_BIAS] = near * one.by_bias + far * two.by_bias
        slopes[..., SCALE] = near * one.by_scale + far * two.by_scale
        for view, share, knot in ((one, near, SHARED), (two, far, SHARED + KNOT)):
            slopes[..., knot] = share
            slopes[..., knot + 1] = 1j * share
            slopes[..., knot + 3] = share * view.by_turn
        middle = {
            name: near * getattr(one, name) + far * getattr(two, name)
            for name in one.__dataclass_fields__
        }
        return View(**middle), slopes

    def range_rows(self, theta: FloatArray, windows: int) -> Rows:
        """Ranges of the first windows."""
        points = self.sighted.within(windows)
        m = len(points.window)
        beacon, weight = self.ranges.beacon[:m], self.weight[:m]
        view, slopes = self._blend(theta, points)
        gap = view.place - (beacon[:, 0] + 1j * beacon[:, 1])
        climb = view.up - beacon[:, 2]
        distance = np.sqrt(np.abs(gap) ** 2 + climb**2) + 1e-9
        factor = np.exp(theta[:, RANGE_SCALE, None])
        model = factor * distance
        jacobian = (np.conj(gap)[..., None] * slopes).real
        for knot, share in ((SHARED, 1.0 - points.share), (SHARED + KNOT, points.share)):
            jacobian[..., knot + 2] = climb * share
        jacobian *= (factor / distance * weight)[..., None]
        jacobian[..., RANGE_SCALE] = model * weight
        return Rows((model - self.ranges.distance[:m]) * weight, jacobian, points.window)

    def anchor_rows(self, theta: FloatArray, windows: int) -> Rows:
        """Anchors of the first windows, four rows each."""
        points, a = self.anchored.within(windows), self.anchors
        count = len(points.window)
        view, slopes = self._blend(theta, points)
        known = np.concatenate([a.sigma[:count], a.yaw_sigma[:count, None]], axis=1)
        target = np.concatenate([a.position[:count], a.yaw[:count, None]], axis=1)
        target = np.where(np.isfinite(known), target, 0.0)
        off = np.stack([view.place.real, view.place.imag, view.up, view.yaw], axis=-1) - target
        off[..., 3] = np.angle(np.exp(1j * off[..., 3]))
        jacobian = np.zeros((len(theta), count, KNOT, SHARED + 2 * KNOT))
        jacobian[:, :, 0], jacobian[:, :, 1] = slopes.real, slopes.imag
        jacobian[:, :, 3, TURN_BIAS] = view.lasted
        for knot, share in ((SHARED, 1.0 - points.share), (SHARED + KNOT, points.share)):
            jacobian[:, :, 2, knot + 2] = jacobian[:, :, 3, knot + 3] = share
        return _stacked(off / known, jacobian / known[..., None], points.window)

    def joint_rows(self, theta: FloatArray, windows: int) -> Rows:
        """Agreement at the ends of the first windows, four rows each."""
        points = self.joined.within(windows)
        view = self.view(theta, points, points.window)
        sigma = np.repeat(self.drift[:windows, None], KNOT, axis=1)
        sigma[:, 3] = self.turn_drift[:windows]
        off = np.stack([view.place.real, view.place.imag, view.up, view.yaw - points.yaw], axis=-1)
        off -= theta[:, SHARED + KNOT :].reshape(len(theta), windows, KNOT)
        jacobian = np.zeros((len(theta), windows, KNOT, SHARED + 2 * KNOT))
        for column, slope in (
            (TURN_BIAS, view.by_bias),
            (SCALE, view.by_scale),
            (SHARED + 3, view.by_turn),
        ):
            jacobian[:, :, 0, column], jacobian[:, :, 1, column] = slope.real, slope.imag
        jacobian[:, :, 3, TURN_BIAS] = view.lasted
        axis = np.arange(KNOT)
        jacobian[:, :, axis, SHARED + axis] = 1.0
        jacobian[:, :, axis, SHARED + KNOT + axis] = -1.0
        return _stacked(off / sigma, jacobian / sigma[..., None], points.window)

    def poses(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Position (N, 3) in the world and yaw (N,) of every node, by one answer."""
        nodes = np.arange(len(self.track.t))
        fine = copy(self)
        fine._gather(nodes)
        view, _ = fine._blend(
            theta[None], fine._points(self.track.t, nodes[:-1].take(nodes, mode="clip"))
        )
        place = view.place[0]
        return np.stack([place.real, place.imag, view.up[0]], axis=1), view.yaw[0]


def _stacked(residual: FloatArray, jacobian: FloatArray, window: IntArray) -> Rows:
    """Rows in groups of one per component as single ones."""
    answers, groups, size, columns = jacobian.shape
    return Rows(
        residual.reshape(answers, groups * size),
        jacobian.reshape(answers, groups * size, columns),
        np.repeat(window, size),
    )
