"""What is known of a segment's track but for its place: displacements, depth, and sightings."""

from __future__ import annotations

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.builder import SegmentModel
from ubl_graph.factors.odometry import Preintegration
from ubl_graph.mission import Mission
from ubl_graph.windows import Sightings


class DeadReckoning:
    """What is known of a segment's track but for its place: displacements, depth, sightings."""

    def __init__(self, mission: Mission, model: SegmentModel) -> None:
        self.mission, self.model = mission, model
        # Velocities say nothing of the way where nobody knows the heading.
        self.odometry: Preintegration | None = None
        if model.heads:
            self.odometry = model.bottom or model.water
        depth = model.segment.depth
        self.depth = None if depth is None or not len(depth) else depth[np.argsort(depth.t)]
        self.sightings = self._sightings()

    def covers(self, begin: float, end: float) -> bool:
        """Whether odometry knows the way from `begin` to `end`, but for a twentieth of it."""
        if self.odometry is None:
            return False
        return self.odometry.missing(begin, end) <= 0.05 * (end - begin) + 1e-6

    def breaks(self) -> FloatArray:
        """Times at which odometry begins or ends, s; no window may span one."""
        return np.empty(0) if self.odometry is None else self.odometry.breaks()

    def offset(self, t: FloatArray) -> FloatArray:
        """Displacement since the first node (and the up where depth is known), (M, 3), m."""
        if not len(t):
            return np.empty((0, 3))
        if self.odometry is None:
            moved = np.zeros((len(t), 3))
        else:
            moved = self.odometry.between(np.full(len(t), self.model.t[0]), t).displacement
        if self.depth is not None:
            arm = self.mission.vehicle.depth_sensor
            lever = self.model.attitude.lever(arm, t)[:, 2]
            moved[:, 2] = -np.interp(t, self.depth.t, self.depth.depth) - lever
        return moved

    def _sightings(self) -> Sightings:
        segment = self.model.segment
        sites = np.array([b.position for b in self.mission.beacons]).reshape(-1, 3)
        parts: list[list[FloatArray]] = []
        for pings, one_way in ((segment.two_way_range, False), (segment.one_way_range, True)):
            if pings is None or not len(pings):
                continue
            first = pings.t_receive if one_way else pings.t_transmit
            share = np.array([1.0, 0.0 if one_way else 1.0])
            beacon = sites[self.mission.beacon_numbers(pings.beacon)]
            m = len(pings)
            parts.append(
                [
                    np.stack([first, pings.t_receive], axis=1),
                    np.tile(share, (m, 1)),
                    beacon,
                    pings.travel_time,
                    pings.sigma,
                    np.full(m, float(one_way)),
                ]
            )
        slant = segment.slant_range
        if slant is not None and len(slant):
            # Distances as the times that they would take through this water.
            speed = float(np.mean(self.mission.sound_speed.speed))
            m = len(slant)
            parts.append(
                [
                    np.stack([slant.t, slant.t], axis=1),
                    np.tile([1.0, 0.0], (m, 1)),
                    sites[self.mission.beacon_numbers(slant.beacon)],
                    slant.distance / speed,
                    slant.sigma / speed,
                    np.zeros(m),
                ]
            )
        empty = [np.empty((0, 2)), np.empty((0, 2)), np.empty((0, 3)), *[np.empty(0)] * 3]
        t, share, beacon, measured, sigma, clock = (
            (np.concatenate(column) for column in zip(*parts, strict=True)) if parts else empty
        )
        order = np.argsort(t[:, 0], kind="stable")
        t, share, beacon, measured, sigma, clock = (
            a[order] for a in (t, share, beacon, measured, sigma, clock)
        )
        arm = self.mission.vehicle.transducer
        offset = (self.offset(t.ravel()) + self.model.attitude.lever(arm, t.ravel())).reshape(
            -1, 2, 3
        )
        return Sightings(t, share, offset, beacon, measured, sigma, clock, *self._fixes())

    def _fixes(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Fixes, the start prior among them: times, positions, displacements, sigmas.

        Their loss in a window is Cauchy's, so a start that contradicts the pings does not
        outweigh them all; where the pings leave a valley it picks the place in it.
        """
        t, position, sigma = [np.empty(0)], [np.empty((0, 3))], [np.empty((0, 3))]
        lever = [np.empty((0, 3))]
        start, fixes = self.model.segment.start, self.model.segment.position
        if start is not None:
            up = np.inf if start.up is None else start.sigma
            t.append(np.array([start.t]))
            position.append(np.array([[start.east, start.north, start.up or 0.0]]))
            sigma.append(np.array([[start.sigma, start.sigma, up]]))
            lever.append(np.zeros((1, 3)))
        if fixes is not None and len(fixes):
            d = fixes.dimension
            place, spread = np.zeros((len(fixes), 3)), np.full((len(fixes), 3), np.inf)
            place[:, :d] = fixes.position
            spread[:, :d] = np.sqrt(np.einsum("mii->mi", fixes.covariances))
            t.append(fixes.t)
            position.append(place)
            sigma.append(spread)
            lever.append(self.model.attitude.lever(self.mission.vehicle.antenna, fixes.t))
        columns = [np.concatenate(c) for c in (t, position, sigma, lever)]
        order = np.argsort(columns[0], kind="stable")
        times, places, spreads, levers = (c[order] for c in columns)
        return times, places, self.offset(times) + levers, spreads
