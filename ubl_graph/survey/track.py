"""The track of a vehicle whose fixes say where it is at every ping."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from ubl_graph.arrays import BoolArray, FloatArray, IntArray
from ubl_graph.attitude import AttitudeTrack
from ubl_graph.mission import Segment, Vehicle
from ubl_graph.nodes import SAME_INSTANT

#: Between fixes this near each other a cubic follows a vehicle, s: a ship that heaves every 6 s by
#: a metre is met within 2 cm from fixes every second.
LONGEST_GAP = 2.0


class FixTrack:
    """Where the transducer is, by position fixes, depth and attitude alone.

    At a fix's own time the fix counts as it is. Between two fixes that are near each other a cubic
    spline goes through those around. What fixes err by is taken as independent from ping to ping.

    Parameters
    ----------
    segment : Segment
        Its fixes, and where these have no `up` its depths.
    vehicle : Vehicle
        Lever arms.
    """

    def __init__(self, segment: Segment, vehicle: Vehicle) -> None:
        self._attitude = AttitudeTrack(segment.attitude)
        self._arm = vehicle.transducer
        fixes, depth = segment.position, segment.depth
        self._axes: list[_Samples] = []
        if fixes is None or not len(fixes):
            return
        at = fixes.position - self._attitude.lever(vehicle.antenna, fixes.t)[:, : fixes.dimension]
        variance = np.einsum("mii->mi", fixes.covariances)
        self._axes.append(_Samples(fixes.t, at, variance))
        if fixes.dimension == 3:
            return
        if depth is None or not len(depth):
            self._axes.clear()
            return
        lever = self._attitude.lever(vehicle.depth_sensor, depth.t)[:, 2]
        up = -(depth.depth + lever)
        self._axes.append(_Samples(depth.t, up[:, None], depth.sigma[:, None] ** 2))

    def at(self, times: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Transducer at times (N,): positions (N, 3), variances (N, 3), and where they are known.

        Where they are not, positions are zero.
        """
        position, variance = np.zeros((len(times), 3)), np.zeros((len(times), 3))
        known = np.full(len(times), bool(self._axes))
        first = 0
        for samples in self._axes:
            axes = slice(first, first + samples.size)
            position[:, axes], variance[:, axes], there = samples.at(times)
            known &= there
            first += samples.size
        position += self._attitude.lever(self._arm, times)
        return position, variance, known


class _Samples:
    """Some axes of a track, sampled: values and variances (M, D) at times (M,)."""

    def __init__(self, t: FloatArray, values: FloatArray, variances: FloatArray) -> None:
        self._t, first = np.unique(t, return_index=True)
        self._values, self._variances = values[first], variances[first]
        self.size = values.shape[1]

    def at(self, times: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Values and variances (N, D) at times (N,), and whether samples are near enough (N,)."""
        t, last = self._t, len(self._t) - 1
        after = np.clip(np.searchsorted(t, times), 1, max(last, 1)).clip(0, last)
        before = np.maximum(after - 1, 0)
        gap = np.maximum(t[after] - t[before], SAME_INSTANT)
        share = np.clip((times - t[before]) / gap, 0.0, 1.0)[:, None]
        variances = (1.0 - share) * self._variances[before] + share * self._variances[after]
        nearest = np.where(share[:, 0] < 0.5, before, after)
        exact = np.abs(times - t[nearest]) <= SAME_INSTANT
        between = (times >= t[before]) & (times <= t[after]) & (gap <= LONGEST_GAP) & ~exact
        values = np.where(exact[:, None], self._values[nearest], 0.0)
        variances = np.where(exact[:, None], self._variances[nearest], variances)
        run = np.concatenate([[0], np.cumsum(np.diff(t) > LONGEST_GAP)])
        self._fill(values, times, between, run[before])
        return values, variances, exact | between

    def _fill(
        self, values: FloatArray, times: FloatArray, between: BoolArray, runs: IntArray
    ) -> None:
        """Interpolate where no sample is, run by run of samples without a gap, in place."""
        ends = np.flatnonzero(np.diff(self._t) > LONGEST_GAP) + 1
        bounds = np.concatenate([[0], ends, [len(self._t)]])
        for run in np.unique(runs[between]):
            mine = slice(int(bounds[run]), int(bounds[run + 1]))
            these = between & (runs == run)
            values[these] = CubicSpline(self._t[mine], self._values[mine])(times[these])
