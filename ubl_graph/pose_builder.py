"""The blocks of a problem whose nodes are poses.

`PoseBuilder` is a `Builder` that ties poses and twists instead of points and velocities: motion
prior, odometry, body velocities, attitude, compass, gyro. Ranges, clocks and slow states are the
same.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ubl_graph import lie
from ubl_graph.arrays import BoolArray, FloatArray, IntArray
from ubl_graph.attitude import AttitudeTrack
from ubl_graph.builder import (
    FREE_POSITION,
    ODOMETRY_PSD,
    Builder,
    SegmentModel,
)
from ubl_graph.factors import linear, pose_motion
from ubl_graph.factors.block import Block
from ubl_graph.factors.compass import CompassBlock
from ubl_graph.factors.odometry import Displacements, Preintegration
from ubl_graph.factors.poses import PoseBlock, PoseMotion, PoseNodes
from ubl_graph.factors.ranges import Antenna
from ubl_graph.factors.tips import PoseAntenna, PosesAt, TipBlock, Tips
from ubl_graph.frames import LeverArm
from ubl_graph.layout import Chain, Layout
from ubl_graph.measurements import Odometry, PositionFix
from ubl_graph.mission import Segment, Setup, Start
from ubl_graph.odometry_noise import (
    PLANAR,
    in_space,
    node_of,
    odometry_covariances,
    spanned,
    whitening_of,
)
from ubl_graph.pose_states import GYRO_STATES, ODOMETRY_STATES, odometry_sigmas
from ubl_graph.trajectory import inside, longest_interval, whitening

#: What is known of a rotation (rad) and of a turning rate (rad/s) before any measurement.
FREE_ROTATION, FREE_RATE = 30.0, 10.0
#: Velocity across the bow that a vehicle may have at first whose heading nothing tells, m/s.
SIDEWAYS = 0.5
#: Lean (sine of roll or pitch) of a vehicle that has no attitude reference.
LEANING = 0.3
#: Between attitude records the vehicle may have turned otherwise by so much, rad, and no more.
TURN_ERROR = 0.01
#: Attitude records farther from a node than this many median intervals say nothing of it,
ATTITUDE_GAPS = 5.0
#: but ones within this do, s.
LEAST_ATTITUDE_GAP = 1.0


class PoseBuilder(Builder):
    """Makes the blocks of a problem with pose nodes; see `Builder`."""

    def __init__(self, setup: Setup, layout: Layout, lasting: float = 0.0) -> None:
        super().__init__(setup, layout, lasting)
        self.planar = layout.node == "pose2"
        turning = np.full(3, self.options.angular_acceleration_psd)
        self.twist_psd = np.concatenate([self.psd, turning])

    # -- what a point node has too --

    def segment_blocks(self, chain: Chain, model: SegmentModel) -> list[Block]:
        """All that ties the nodes of one segment, but for what they share."""
        blocks = super().segment_blocks(chain, model)
        if _moves_unseen(model):
            blocks.append(self.forward(chain))
        leaning = self._leans(model.segment)
        return [*blocks, self.upright(chain)] if leaning else blocks

    def _leans(self, segment: Segment) -> bool:
        """Whether nothing tells roll and pitch of a vehicle in space."""
        known = segment.attitude is not None and len(segment.attitude) > 0
        steps = segment.odometry
        spatial = steps is not None and len(steps) > 0 and steps.dimension == 3
        return not (self.planar or known or (self.layout.still and spatial))

    def upright(self, chain: Chain) -> Block:
        """Vehicles swim upright: what holds roll and pitch that no reference tells."""
        k = chain.first + np.arange(len(chain.t))
        white = np.broadcast_to(np.eye(3) / LEANING, (len(k), 3, 3))
        ends = (self._nodes(k),)
        return PoseBlock("upright", ends, pose_motion.upright(), white, np.arange(3))

    def forward(self, chain: Chain) -> Block:
        """The bow is where the vehicle goes: what holds a heading that nothing tells."""
        columns = self.layout.node_columns("velocity", np.array([chain.first]))[:, 1:]
        sigma = np.full(columns.shape, SIDEWAYS)
        return linear.prior("forward", columns, np.zeros(columns.shape), sigma)

    def first_priors(self, chain: Chain) -> list[Block]:
        """What is known of the first node before any measurement."""
        first = np.array([chain.first])
        free = {
            "position": FREE_POSITION,
            "velocity": self.options.speed_sigma,
            "rate": FREE_RATE,
        }
        middle = np.zeros(3)
        if self.setup.beacons:
            middle = np.mean([b.position for b in self.setup.beacons], axis=0)
        blocks: list[Block] = []
        for name, size in self.layout.kinematic:
            if name == "rotation":
                blocks.append(self._free_rotation(first))
                continue
            mean = middle[None, :size] if name == "position" else np.zeros((1, size))
            blocks.append(self._node_prior(name, first, mean, free[name]))
        return blocks + self._slow_priors(chain)

    def _free_rotation(self, first: IntArray) -> Block:
        """Any rotation: by its vector of half a turn at most, which knows no full turns."""
        keep = np.array([2]) if self.planar else np.arange(3)
        white = np.eye(len(keep))[None] / FREE_ROTATION
        residual = pose_motion.attitude(np.eye(3)[None])
        return PoseBlock("rotation prior", (self._nodes(first),), residual, white, keep)

    def start_blocks(self, chain: Chain, start: Start) -> list[Block]:
        """The start prior: a fix of the reference point, and the heading where it is known."""
        times = np.array([start.t])
        poses = PosesAt(self.layout, chain, times)
        place = [start.east, start.north]
        if start.up is not None and not self.planar:
            place.append(start.up)
        size = len(place)
        covariance = start.sigma**2 * np.eye(size)[None]
        tips = self._tips(poses, LeverArm())
        blocks: list[Block] = [
            TipBlock("start prior", tips, np.arange(size), np.array([place]), covariance)
        ]
        if start.heading is not None:
            sigma = np.hypot(start.heading_sigma, self._swing(poses))
            heading = np.array([start.heading])
            blocks.append(CompassBlock(poses, heading, sigma, name="start heading"))
        return blocks

    def antenna(
        self,
        chain: Chain,
        times: FloatArray,
        attitude: AttitudeTrack,  # noqa: ARG002 - poses know their own
    ) -> Antenna:
        """The transducer at each leg's time (M, L)."""
        poses = PosesAt(self.layout, chain, times.ravel())
        off = self.layout.shared_columns("lever_arm") if self.layout.has("lever_arm") else None
        return PoseAntenna(self._tips(poses, self.setup.vehicle.transducer, off), times.shape[1])

    def fix_block(
        self,
        chain: Chain,
        rows: PositionFix,
        attitude: AttitudeTrack,  # noqa: ARG002 - poses know their own
    ) -> Block:
        """Position fixes of one dimension (horizontal ones or full ones)."""
        size = min(rows.dimension, 2 if self.planar else 3)
        tips = self._tips(PosesAt(self.layout, chain, rows.t), self.setup.vehicle.antenna)
        covariance = rows.covariances[:, :size, :size]
        return TipBlock("position", tips, np.arange(size), rows.position[:, :size], covariance)

    def depth_blocks(self, chain: Chain, model: SegmentModel) -> list[Block]:
        """Depths; a planar vehicle is held at them instead."""
        rows = model.segment.depth
        if rows is None or self.planar:
            return []
        rows = rows[inside(chain.t, rows.t)]
        if not len(rows):
            return []
        tips = self._tips(PosesAt(self.layout, chain, rows.t), self.setup.vehicle.depth_sensor)
        variance = rows.sigma[:, None, None] ** 2
        return [TipBlock("depth", tips, np.array([2]), -rows.depth[:, None], variance)]

    def silent_blocks(self, chain: Chain) -> list[Block]:
        """What joins nodes between which nothing was measured: motion, and walks."""
        span = float(chain.t[-1] - chain.t[0])
        psd = np.tile(self.twist_psd, (len(chain.t) - 1, 1))
        return [self._motion(chain, psd), *self._walk_blocks(chain, span)]

    def shared_priors(self) -> list[Block]:
        """What is known beforehand of what all nodes share."""
        blocks = super().shared_priors()
        sigmas = {"gyro_bias": self.options.gyro_bias_sigma, **odometry_sigmas(self.options)}
        common = dict(self.layout.shared)
        for name, sigma in sigmas.items():
            if name in common:
                columns = self.layout.shared_columns(name)[None]
                scaled = np.full(columns.shape, sigma / self.layout.unit(name))
                blocks.append(linear.prior(name, columns, np.zeros(columns.shape), scaled))
        return blocks

    # -- what joins poses --

    def motion_blocks(self, chain: Chain, model: SegmentModel) -> list[Block]:
        """Motion prior, odometry, body velocities, attitude, compass and gyro."""
        segment = model.segment
        blocks: list[Block] = []
        if len(chain.t) > 1:
            psd = np.tile(self.twist_psd, (len(chain.t) - 1, 1))
            for samples, current in ((model.bottom, False), (model.water, True)):
                if samples is not None:
                    rows, covered = self._way_blocks(chain, model, samples, current=current)
                    blocks += rows
                    psd[covered, :3] = np.maximum(psd[covered, :3], ODOMETRY_PSD)
            steps = segment.odometry
            if steps is not None:
                # Nodes of a regular grid need not reach to all of them.
                steps = steps[inside(chain.t, steps.t_from) & inside(chain.t, steps.t_to)]
            if steps is not None and len(steps):
                blocks.append(self._odometry(chain, steps))
                told = spanned(chain.t, steps)
                known = PLANAR if steps.dimension == 2 else np.arange(6)
                psd[np.ix_(told, known)] = np.maximum(psd[np.ix_(told, known)], ODOMETRY_PSD)
            if not self.layout.still:
                blocks.insert(0, self._motion(chain, psd))
        if model.gyro is not None:
            blocks += self._gyro_blocks(chain, model)
        if segment.attitude is not None and len(segment.attitude):
            blocks.append(self._attitude_block(chain, AttitudeTrack(segment.attitude)))
        if segment.heading is not None:
            rows = segment.heading[inside(chain.t, segment.heading.t)]
            if len(rows):
                poses = PosesAt(self.layout, chain, rows.t)
                bias = None
                if self.layout.has("heading_bias"):
                    bias = self.layout.travelling_or_shared_at("heading_bias", chain, rows.t)
                sigma = np.hypot(rows.sigma, self._swing(poses))
                blocks.append(CompassBlock(poses, rows.heading, sigma, bias))
        return blocks

    def _motion(self, chain: Chain, psd: FloatArray) -> Block:
        """White noise on the twists' change; psd (N - 1, 6) along and about the body's axes."""
        dt = np.diff(chain.t)
        k = chain.first + np.arange(len(dt))
        ends = (self._nodes(k, moving=True), self._nodes(k + 1, moving=True))
        inverse = 1.0 / np.sqrt(psd)
        white = np.einsum("mab,mi,ij->maibj", whitening(2, dt), inverse, np.eye(6))
        keep = self._kept(12)
        white = white.reshape(-1, 12, 12)[:, keep[:, None], keep[None, :]]
        return PoseMotion(ends, pose_motion.motion(dt), white, keep, dt, psd)

    def _odometry(self, chain: Chain, records: Odometry) -> Block:
        """Changes of pose from node to node."""
        ends = [chain.first + node_of(chain.t, t) for t in (records.t_from, records.t_to)]
        names = [name for name, _ in ODOMETRY_STATES if self.layout.has(name)]
        extra = self._shared(names, len(records))
        units = np.array([self.layout.unit(name) for name in names])
        dt = records.t_to - records.t_from
        keep = PLANAR if self.planar else np.arange(6)
        residual = pose_motion.odometry(records.translation, records.rotation_vector, dt, names)
        covariance = odometry_covariances(records, self.options)
        if self.planar and covariance.shape[1] == 6:
            covariance = covariance[:, PLANAR[:, None], PLANAR[None, :]]
        elif not self.planar and covariance.shape[1] == 3:
            covariance = in_space(covariance)
        white = whitening_of(covariance)
        nodes = [self._nodes(end) for end in ends]
        return PoseBlock("odometry", nodes, residual, white, keep, extra, units)

    def _way_blocks(
        self, chain: Chain, model: SegmentModel, samples: Preintegration, *, current: bool
    ) -> tuple[list[Block], BoolArray]:
        """Displacements and velocities of the DVL, and which intervals they cover.

        Gyros say how the vehicle turned within an interval where they cover it, else the attitude
        records do, where there is no gap in them that a vehicle could turn in.
        """
        t0, t1 = chain.t[:-1], chain.t[1:]
        longest = longest_interval(2, self.options.angular_acceleration_psd, TURN_ERROR)
        turned = model.gyro_water if current else model.gyro_bottom
        by_gyro = np.zeros(len(t0), dtype=np.bool_)
        blocks: list[Block] = []
        if turned is not None and model.gyro is not None:
            track = AttitudeTrack.of(model.gyro.t, model.gyro.rotations)
            by_gyro = turned.between(t0, t1).covered & model.gyro.between(t0, t1).covered
            blocks += self._displacement(chain, turned, track, by_gyro, 0.0, current, gyro=True)
        told = samples.between(t0, t1).covered & model.attitude.covers(t0, t1, longest) & ~by_gyro
        alone = self._turned_by_gyro(model)
        sigma = model.turn_sigma
        blocks += self._displacement(
            chain, samples, model.attitude, told, sigma, current, gyro=alone
        )
        keep = np.arange(2 if self.planar else 3)
        rates = samples.rates_at(chain.t)
        rows = np.flatnonzero(rates.covered)
        if len(rows):
            k = chain.first + rows
            back = np.swapaxes(self._read(model.attitude, chain.t[rows]), 1, 2)
            arm = self.setup.vehicle.dvl.body
            body = self._body_way(rates, rows, back, np.ones(len(rows)), arm, 1 if current else 0)
            extra, units = self._dvl_columns((k,) if current else (), len(rows))
            white = np.eye(len(keep)) / rates.sigma[rows, None, None]
            ends = (self._nodes(k, moving=True),)
            name = "water velocity" if current else "velocity"
            residual = pose_motion.velocity(body)
            blocks.append(PoseBlock(name, ends, residual, white, keep, extra, units))
        return blocks, by_gyro | told

    def _displacement(
        self,
        chain: Chain,
        samples: Preintegration,
        track: AttitudeTrack,
        which: BoolArray,
        turn_sigma: float,
        current: bool,
        *,
        gyro: bool,
    ) -> list[Block]:
        """Displacements of some intervals, turned back by a track."""
        rows = np.flatnonzero(which)
        if not len(rows):
            return []
        keep = np.arange(2 if self.planar else 3)
        k, dt = chain.first + rows, np.diff(chain.t)[rows]
        moved = samples.between(chain.t[:-1], chain.t[1:])
        back = np.swapaxes(self._read(track, chain.t[rows]), 1, 2)
        arm = self.setup.vehicle.dvl.body
        body = self._body_way(moved, rows, back, dt, arm, 2 if current else 0)
        biased = gyro and self.layout.has("gyro_bias")
        if biased:
            # Half of what the bias turns within the interval is there on the way.
            carried = 0.5 * dt[:, None, None] * lie.cross_matrix(body.way)
            body = body.with_error(carried[:, :, 2:] if self.planar else carried)
        extra, units = self._dvl_columns((k, k + 1) if current else (), len(rows), biased)
        ends = (self._nodes(k), self._nodes(k + 1))
        aside = turn_sigma * np.linalg.norm(body.way, axis=1)
        white = np.eye(len(keep)) / np.hypot(moved.sigma[rows], aside)[:, None, None]
        residual = pose_motion.displacement(body)
        name = "water odometry" if current else "odometry"
        return [PoseBlock(name, ends, residual, white, keep, extra, units)]

    def _body_way(
        self,
        d: Displacements,
        rows: IntArray,
        back: FloatArray,
        dt: FloatArray,
        arm: FloatArray,
        currents: int,
    ) -> pose_motion.BodyWay:
        """Preintegrated velocities turned back into the vehicle's axes."""
        way = np.einsum("mij,mj->mi", back, d.displacement[rows])
        slopes = {
            "dvl_scale": way[:, :, None],
            "dvl_misalignment": back @ d.by_misalignment[rows],
            "dvl_bias": back @ d.by_bias[rows],
        }
        parts = [slope for name, slope in slopes.items() if self.layout.has(name)]
        errors = np.concatenate([np.empty((len(rows), 3, 0)), *parts], axis=2)
        return pose_motion.BodyWay(way, errors, dt, arm, currents)

    def _turned_by_gyro(self, model: SegmentModel) -> bool:
        """Whether gyros alone turn the velocities within an interval, and their bias is unknown."""
        attitude = model.segment.attitude
        known = attitude is not None and len(attitude) > 0
        return model.gyro is not None and not known and self.layout.has("gyro_bias")

    def _dvl_columns(
        self, nodes: Sequence[IntArray], m: int, turning: bool = False
    ) -> tuple[IntArray, FloatArray]:
        """Columns and units of the DVL's errors (of the gyro's too), and of the current."""
        names = [n for n in ("dvl_scale", "dvl_misalignment", "dvl_bias") if self.layout.has(n)]
        names += ["gyro_bias"] if turning else []
        columns = [self._shared(names, m)]
        units = [np.full(dict(self.layout.shared)[n], self.layout.unit(n)) for n in names]
        for k in nodes:
            columns.append(self.layout.node_columns("current", k))
            units.append(np.full(2, self.layout.unit("current")))
        return np.concatenate(columns, axis=1), np.concatenate([np.empty(0), *units])

    def _gyro_blocks(self, chain: Chain, model: SegmentModel) -> list[Block]:
        """Turns from node to node, and turning rates at the nodes."""
        assert model.gyro is not None
        keep = np.array([2]) if self.planar else np.arange(3)
        names = [name for name, _ in GYRO_STATES if self.layout.has(name)]
        size = dict(self.layout.shared).get("gyro_bias", 0)
        units = np.full(size, self.layout.unit("gyro_bias"))
        biased = keep if size else np.empty(0, dtype=np.int64)
        blocks: list[Block] = []
        if len(chain.t) > 1:
            turns = model.gyro.between(chain.t[:-1], chain.t[1:])
            rows = np.flatnonzero(turns.covered)
            if len(rows):
                k = chain.first + rows
                residual = pose_motion.rotation_between(
                    turns.rotation[rows], turns.by_bias[rows][:, :, biased]
                )
                white = np.eye(len(keep)) / turns.sigma[rows, None, None]
                ends = (self._nodes(k), self._nodes(k + 1))
                extra = self._shared(names, len(rows))
                blocks.append(PoseBlock("gyro", ends, residual, white, keep, extra, units))
        if not self.layout.still:
            rate, sigma, there = model.gyro.rates_at(chain.t)
            rows = np.flatnonzero(there)
            if len(rows):
                residual = pose_motion.rate(rate[rows], biased)
                white = np.eye(len(keep)) / sigma[rows, None, None]
                ends = (self._nodes(chain.first + rows, moving=True),)
                extra = self._shared(names, len(rows))
                blocks.append(PoseBlock("rate", ends, residual, white, keep, extra, units))
        return blocks

    def _attitude_block(self, chain: Chain, track: AttitudeTrack) -> Block:
        """What the attitude reference reads at the nodes."""
        gaps = np.diff(track.t)
        reach = max(
            ATTITUDE_GAPS * float(np.median(gaps)) if len(gaps) else 0.0, LEAST_ATTITUDE_GAP
        )
        after = np.searchsorted(track.t, chain.t).clip(0, len(track.t) - 1)
        nearest = np.minimum(
            np.abs(track.t[after] - chain.t), np.abs(track.t[np.maximum(after - 1, 0)] - chain.t)
        )
        near = nearest <= reach
        if len(gaps):
            # Beyond its records the track is held, and says nothing of a vehicle that turns.
            near &= inside(track.t, chain.t)
        # No record counts for more than one node, where nodes are denser than records.
        own = np.zeros(len(chain.t), dtype=np.bool_)
        own[node_of(chain.t, track.t)] = True
        near &= own
        if not near.any():
            near[np.argmin(nearest)] = True
        nodes = np.flatnonzero(near)
        k = chain.first + nodes
        residual = pose_motion.attitude(self._read(track, chain.t[nodes]))
        keep = np.array([2]) if self.planar else np.arange(3)
        sigma = float(np.deg2rad(self.options.attitude_noise_deg))
        white = np.broadcast_to(np.eye(len(keep)) / sigma, (len(k), len(keep), len(keep)))
        extra = np.empty((len(k), 0), dtype=np.int64)
        units = np.empty(0)
        if self.layout.has("heading_bias"):
            travels = "heading_bias" in dict(self.layout.slow)
            extra = (
                self.layout.node_columns("heading_bias", k)
                if travels
                else self._shared(["heading_bias"], len(k))
            )
            units = np.array([self.layout.unit("heading_bias")])
        return PoseBlock("attitude", (self._nodes(k),), residual, white, keep, extra, units)

    # -- small things --

    def _read(self, track: AttitudeTrack, t: FloatArray) -> FloatArray:
        """Attitude as the reference reads it, (M, 3, 3); a planar vehicle takes the heading of it.

        Its body axes stay level however much the vehicle rolls and pitches.
        """
        rotation = track.at(t)
        if not self.planar:
            return rotation
        yaw = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
        return lie.rotation(yaw[:, None] * pose_motion.UP)

    def _nodes(self, nodes: IntArray, moving: bool = False) -> PoseNodes:
        return PoseNodes(self.layout, nodes, moving)

    def _kept(self, size: int) -> IntArray:
        """Components of a residual along and about the axes that the vehicle's space has."""
        if not self.planar:
            return np.arange(size)
        return np.concatenate([PLANAR + 6 * i for i in range(size // 6)])

    def _tips(self, poses: PosesAt, arm: LeverArm, off: IntArray | None = None) -> Tips:
        noise = np.zeros(6)
        moving = PLANAR if self.planar else np.arange(6)
        noise[moving] = self.twist_psd[moving]
        return Tips(poses, arm.body, noise, off)

    def _swing(self, poses: PosesAt) -> FloatArray:
        """Standard deviation of what the prior lets the heading do between nodes, (M,), rad."""
        return np.sqrt(self.options.angular_acceleration_psd * poses.variance_factor)

    def _shared(self, names: Sequence[str], m: int) -> IntArray:
        columns = [self.layout.shared_columns(name) for name in names]
        whole = np.concatenate([np.empty(0, dtype=np.int64), *columns])
        return np.broadcast_to(whole, (m, len(whole)))


def _moves_unseen(model: SegmentModel) -> bool:
    """Whether nothing at all says where the bow is, nor how the vehicle moves past it."""
    segment = model.segment
    told = segment.velocity is not None or segment.odometry is not None
    headed = segment.start is not None and segment.start.heading is not None
    return not (told or headed or model.heads or model.still)
