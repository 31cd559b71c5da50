"""Attitude over time, held at what the heading reference says."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from ubl_graph.arrays import BoolArray, FloatArray
from ubl_graph.frames import LeverArm, world_R_body
from ubl_graph.measurements import Attitude


class AttitudeTrack:
    """Rotation of the vehicle at any time, by spherical interpolation of attitude records.

    Before the first and after the last record the attitude is held.

    Parameters
    ----------
    records : Attitude, optional
        None or empty: the body axes stay aligned with the world's (only for vehicles without
        lever arms and body velocities, which `Mission` sees to).
    """

    def __init__(self, records: Attitude | None) -> None:
        self.is_known = records is not None and len(records) > 0
        if records is None or len(records) == 0:
            records = Attitude(0.0, np.pi / 2)  # heading east: forward-left-up is east-north-up
        order = np.argsort(records.t)
        self.t: FloatArray = records.t[order]
        self._rotations = Rotation.from_matrix(
            world_R_body(records.heading, records.pitch, records.roll)[order]
        )
        self._slerp = Slerp(self.t, self._rotations) if len(self.t) > 1 else None

    @classmethod
    def of(cls, t: FloatArray, rotations: Rotation) -> AttitudeTrack:
        """A track of rotations `world_R_body` at times (M,), s, strictly increasing."""
        track = cls(None)
        track.is_known = True
        track.t, track._rotations = t, rotations
        track._slerp = Slerp(t, rotations) if len(t) > 1 else None
        return track

    def at(self, times: FloatArray) -> FloatArray:
        """`world_R_body` at times (M,), shape (M, 3, 3)."""
        times = np.atleast_1d(times)
        if self._slerp is None:
            return np.broadcast_to(self._rotations.as_matrix()[0], (len(times), 3, 3))
        return self._slerp(np.clip(times, self.t[0], self.t[-1])).as_matrix()

    def covers(self, t0: FloatArray, t1: FloatArray, longest: float) -> BoolArray:
        """Whether records reach over the intervals from `t0` to `t1` (M,), s.

        That is, without a gap of more than `longest` (s): what a vehicle does in a longer one, and
        beyond the ends, nobody measured.
        """
        inside = (t0 >= self.t[0] - 1e-6) & (t1 <= self.t[-1] + 1e-6) & self.is_known
        gaps = np.diff(self.t)
        closed = np.concatenate([[0.0], np.cumsum(np.where(gaps > longest, gaps, 0.0))])
        missing = np.interp(t1, self.t, closed) - np.interp(t0, self.t, closed)
        return inside & (missing < 1e-6)

    def lever(self, arm: LeverArm, times: FloatArray) -> FloatArray:
        """Lever arm in world axes at times (M,), shape (M, 3), metres."""
        if arm.is_zero:
            return np.zeros((len(times), 3))
        return self.at(times) @ arm.body

    def lever_rate(self, arm: LeverArm, times: FloatArray, step: float = 0.05) -> FloatArray:
        """Velocity of a lever arm's tip by rotation, (M, 3), m/s, by central difference."""
        if arm.is_zero:
            return np.zeros((len(times), 3))
        # The attitude is held beyond its records: no difference may reach out there.
        before, after = (np.clip(t, self.t[0], self.t[-1]) for t in (times - step, times + step))
        span = (after - before)[:, None]
        moved = self.lever(arm, after) - self.lever(arm, before)
        return np.divide(moved, span, out=np.zeros_like(moved), where=span > 0.0)
