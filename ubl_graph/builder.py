"""The blocks of a problem, made of records: priors, motion, odometry, depth, fixes, ranges.

`Builder.segment_blocks` reads like the list of what ties a vehicle's states together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.attitude import AttitudeTrack
from ubl_graph.factors import linear
from ubl_graph.factors.block import Block
from ubl_graph.factors.gyro import GyroTrack
from ubl_graph.factors.odometry import DVL_STATES, Preintegration, node_velocity, odometry
from ubl_graph.factors.ranges import (
    Antenna,
    Arm,
    FixedAntenna,
    FreeAntenna,
    PointAntenna,
    RangeBlock,
)
from ubl_graph.layout import Chain, Interpolation, Layout
from ubl_graph.measurements import OneWayRange, PositionFix, SlantRange
from ubl_graph.mission import Segment, Setup, Start
from ubl_graph.nodes import NOMINAL_SPEED
from ubl_graph.options import Options
from ubl_graph.pings import (
    Pings,
    along_distances,
    kind_of,
    leg_times,
    measured_times,
    travel_time_model,
)
from ubl_graph.trajectory import inside, interpolation_variance

#: What is known of a position before any measurement: within this of the beacons' middle, m.
#: It keeps the normal equations regular where the data leave a direction open; a standard
#: deviation of its size in the result says just that.
FREE_POSITION = 1e5
#: The same for the acceleration, m/s^2.
FREE_ACCELERATION = 100.0
#: Noise density of the motion prior where odometry joins the nodes, m^2/s^3 or m^2/s^5: there
#: the prior has nothing to say, and a vehicle that turns must not be pulled straight.
ODOMETRY_PSD = 1.0
#: s
HOUR = 3600.0
#: Of the names of what each beacon's ranges are off by.
RANGE_BIAS = "range_bias "


@dataclass(frozen=True, eq=False)
class SegmentModel:
    """A segment with what is derived from its records once: nodes, attitude, odometry.

    Attributes
    ----------
    segment : Segment
        The records.
    t : array, shape (N,)
        Node times, s.
    attitude : AttitudeTrack
        Held attitude.
    bottom, water : Preintegration, optional
        DVL velocities by reference.
    gyro : GyroTrack, optional
        Integrated rates, for pose nodes.
    gyro_bottom, gyro_water : Preintegration, optional
        The same velocities, turned by the gyro alone.
    turn_sigma : float
        White noise of the attitude by which velocities are turned, rad, where the nodes' attitude
        does not have it in common.
    heads : bool
        Whether `attitude` knows the heading, not only the turns.
    still : bool
        Whether odometry records join all nodes, which then need no velocities.
    """

    segment: Segment
    t: FloatArray
    attitude: AttitudeTrack
    bottom: Preintegration | None
    water: Preintegration | None
    gyro: GyroTrack | None = None
    gyro_bottom: Preintegration | None = None
    gyro_water: Preintegration | None = None
    turn_sigma: float = 0.0
    heads: bool = True
    still: bool = False


def shared_states(setup: Setup, lasting: float | None) -> tuple[tuple[str, int], ...]:
    """Name and size of what all nodes share.

    Parameters
    ----------
    setup : Setup
        Beacons and options.
    lasting : float or None
        Standard deviation of the heading reference's lasting error, rad; None without odometry.
    """
    shared: list[tuple[str, int]] = []
    if lasting is not None:
        sigmas = dvl_sigmas(setup.options, lasting)
        if heading_walks(setup.options, lasting):
            sigmas["heading_bias"] = np.zeros(1)
        shared += [(name, size) for name, size in DVL_STATES if sigmas[name][-1] > 0.0]
    if setup.options.lever_arm_sigma > 0.0:
        shared.append(("lever_arm", 3))
    if setup.options.range_bias_sigma > 0.0:
        shared += [(f"{RANGE_BIAS}{b.name}", 1) for b in setup.beacons]
    if setup.options.estimate_beacons:
        shared += [(f"beacon {b.name}", 3) for b in setup.beacons]
    return tuple(shared)


def heading_sigma(options: Options, lasting: float) -> float:
    """Standard deviation of the heading bias, rad: as asked for, or the reference's own."""
    given = options.heading_bias_sigma_deg
    return lasting if given is None else float(np.deg2rad(given))


def heading_walk(options: Options) -> float:
    """Random walk of the heading bias, rad per sqrt(s)."""
    return float(np.deg2rad(options.heading_bias_walk_deg)) / HOUR**0.5


def heading_walks(options: Options, lasting: float) -> bool:
    """Whether the heading bias wanders: then every node has its own."""
    return heading_sigma(options, lasting) > 0.0 and options.heading_bias_walk_deg > 0.0


def dvl_sigmas(options: Options, lasting: float) -> dict[str, FloatArray]:
    """Prior standard deviations of the DVL's errors, and of the heading reference's.

    Lasting errors of roll and pitch turn the odometry as a misalignment about forward and left
    does, so its states carry both.
    """
    mounting = float(np.deg2rad(options.dvl_misalignment_sigma_deg))
    level = float(np.hypot(mounting, lasting))
    return {
        "dvl_scale": np.array([options.dvl_scale_sigma]),
        "dvl_misalignment": np.array([level, level, mounting]),
        "dvl_bias": np.full(3, options.dvl_bias_sigma),
        "heading_bias": np.array([heading_sigma(options, lasting)]),
    }


class Builder:
    """Makes the blocks of one problem.

    Parameters
    ----------
    setup : Setup
        Beacons, sound speed, vehicle and options.
    layout : Layout
        The unknowns.
    lasting : float
        Standard deviation of the heading reference's lasting error, rad.
    """

    def __init__(self, setup: Setup, layout: Layout, lasting: float = 0.0) -> None:
        self.setup, self.layout, self.options = setup, layout, setup.options
        self.lasting = lasting
        self.travel_times = travel_time_model(setup)
        self.psd = np.array(
            [self.options.horizontal_psd, self.options.horizontal_psd, self.options.vertical_psd]
        )

    def segment_blocks(self, chain: Chain, model: SegmentModel) -> list[Block]:
        """All that ties the nodes of one segment, but for what they share."""
        segment = model.segment
        blocks: list[Block] = self.first_priors(chain)
        if segment.start is not None:
            blocks += self.start_blocks(chain, segment.start)
        blocks += self.linear_blocks(chain, model, max(float(chain.t[-1] - chain.t[0]), 1.0))
        for pings in (segment.two_way_range, segment.one_way_range, segment.slant_range):
            if pings is not None and len(pings):
                blocks.append(self.range_block(chain, pings, model.attitude))
        return blocks

    def linear_blocks(self, chain: Chain, model: SegmentModel, span: float) -> list[Block]:
        """Motion, odometry, slow states' walks, depth and fixes.

        Parameters
        ----------
        chain, model
            Nodes, and the records between them.
        span : float
            Time over which a slow state that does not walk counts as constant, s.
        """
        blocks = self.motion_blocks(chain, model)
        if len(chain.t) > 1:
            blocks += self._walk_blocks(chain, span)
        blocks += self.depth_blocks(chain, model)
        if model.segment.position is not None:
            blocks.append(self.fix_block(chain, model.segment.position, model.attitude))
        return blocks

    def silent_blocks(self, chain: Chain) -> list[Block]:
        """What joins nodes between which nothing was measured: motion, and walks."""
        psd = np.tile(self.psd, (len(chain.t) - 1, 1))
        span = float(chain.t[-1] - chain.t[0])
        return [linear.motion(self.layout, chain, psd), *self._walk_blocks(chain, span)]

    def first_priors(self, chain: Chain) -> list[Block]:
        """What is known of the first node before any measurement."""
        first = np.array([chain.first])
        middle = np.zeros(3)
        if self.setup.beacons:
            middle = np.mean([b.position for b in self.setup.beacons], axis=0)
        blocks: list[Block] = [
            self._node_prior("position", first, middle[None], FREE_POSITION),
            self._node_prior("velocity", first, np.zeros((1, 3)), self.options.speed_sigma),
        ]
        if self.layout.order == 3:
            blocks.append(
                self._node_prior("acceleration", first, np.zeros((1, 3)), FREE_ACCELERATION)
            )
        return blocks + self._slow_priors(chain)

    def _slow_priors(self, chain: Chain) -> list[Block]:
        """What is known of the slow states at the first node."""
        first = np.array([chain.first])
        return [
            self._node_prior(name, first, np.zeros((1, size)), self._slow_sigma(name))
            for name, size in self.layout.slow
        ]

    def _slow_sigma(self, name: str) -> float:
        """Standard deviation of a slow state at the first node, SI."""
        options = self.options
        least = 1e-15 if name.startswith("clock") else 1e-9
        sigmas = {
            "sound_speed": self.setup.sound_speed_sigma,
            "current": options.current_sigma,
            "clock_offset": options.clock_offset_sigma,
            "clock_drift": options.clock_drift_sigma,
            "heading_bias": heading_sigma(options, self.lasting),
        }
        return max(sigmas[name], least)

    def shared_priors(self) -> list[Block]:
        """What is known beforehand of what all nodes share."""
        blocks: list[Block] = []
        common = dict(self.layout.shared)
        for name, sigma in dvl_sigmas(self.options, self.lasting).items():
            if name in common:
                columns = self.layout.shared_columns(name)[None]
                sigma = np.array(sigma / self.layout.unit(name))
                blocks.append(linear.prior(name, columns, np.zeros(columns.shape), sigma))
        for name, size in self.layout.shared:
            sigma = {"lever_arm": self.options.lever_arm_sigma}.get(name)
            if name.startswith(RANGE_BIAS):
                sigma = self.options.range_bias_sigma
            if sigma is not None:
                columns = self.layout.shared_columns(name)[None]
                blocks.append(
                    linear.prior(name.strip(), columns, np.zeros((1, size)), np.array(sigma))
                )
        if self.options.estimate_beacons:
            for beacon in self.setup.beacons:
                columns = self.layout.shared_columns(f"beacon {beacon.name}")[None]
                sigma = np.where(beacon.sigma > 0.0, beacon.sigma, FREE_POSITION)
                blocks.append(linear.prior("beacon", columns, beacon.position[None], sigma[None]))
        return blocks

    def start_blocks(self, chain: Chain, start: Start) -> list[Block]:
        """The start prior: a fix of the reference point itself."""
        position = self.layout.positions_at(chain, np.array([start.t]))
        place = (
            [start.east, start.north] if start.up is None else [start.east, start.north, start.up]
        )
        size = len(place)
        variance = start.sigma**2 + self.psd[:size] * self._variance(position)
        block = linear.position_fix(
            position, np.zeros((1, 3)), np.array([place]), np.diag(variance)[None]
        )
        return [replace(block, name="start prior")]

    def _node_prior(
        self, name: str, nodes: IntArray, mean: FloatArray, sigma: float
    ) -> linear.LinearBlock:
        columns = self.layout.node_columns(name, nodes)
        unit = self.layout.unit(name)
        return linear.prior(name, columns, mean / unit, np.array(sigma / unit))

    def motion_blocks(self, chain: Chain, model: SegmentModel) -> list[Block]:
        """Motion prior and odometry."""
        if len(chain.t) == 1:
            return []
        blocks: list[Block] = []
        psd = np.tile(self.psd, (len(chain.t) - 1, 1))
        arm = self.setup.vehicle.dvl
        walk = heading_walk(self.options)
        for samples, current in ((model.bottom, False), (model.water, True)):
            if samples is None:
                continue
            lever = model.attitude.lever(arm, chain.t)
            rate = model.attitude.lever_rate(arm, chain.t)
            rows, covered = odometry(
                self.layout, chain, samples, lever, current=current, heading_walk=walk
            )
            velocity = node_velocity(self.layout, chain, samples, rate, current=current)
            blocks += [rows, velocity]
            psd[covered] = np.maximum(psd[covered], ODOMETRY_PSD)
        return [linear.motion(self.layout, chain, psd), *blocks]

    def _walk_blocks(self, chain: Chain, span: float) -> list[Block]:
        """How the slow states wander from node to node."""
        options, layout = self.options, self.layout
        blocks: list[Block] = []
        walks = {
            "sound_speed": options.number("sound_speed_walk"),
            "current": options.current_walk,
            "heading_bias": heading_walk(options),
        }
        travelling = dict(layout.slow)
        for name, walk in walks.items():
            if name in travelling:
                # A walk of zero means a constant; a thousandth of the prior over the whole span
                # is as good and keeps the equations regular.
                least = 1e-3 * self._slow_sigma(name) / np.sqrt(span)
                blocks.append(linear.random_walk(layout, chain, name, max(walk, least)))
        if layout.has("clock_offset"):
            clock = max(options.clock_walk, 1e-10), max(options.clock_drift_walk, 1e-13)
            blocks.append(linear.clock_walk(layout, chain, *clock))
        return blocks

    def depth_blocks(self, chain: Chain, model: SegmentModel) -> list[Block]:
        """Depths."""
        rows = model.segment.depth
        if rows is None:
            return []
        rows = rows[inside(chain.t, rows.t)]
        lever = model.attitude.lever(self.setup.vehicle.depth_sensor, rows.t)
        position = self.layout.positions_at(chain, rows.t)
        variance = rows.sigma**2 + self.psd[2] * self._variance(position)
        return [linear.depth(position, lever[:, 2], rows.depth, np.sqrt(variance))]

    def fix_block(self, chain: Chain, rows: PositionFix, attitude: AttitudeTrack) -> Block:
        """Position fixes of one dimension (horizontal ones or full ones)."""
        lever = attitude.lever(self.setup.vehicle.antenna, rows.t)
        position = self.layout.positions_at(chain, rows.t)
        extra = np.eye(rows.dimension) * self.psd[: rows.dimension]
        covariance = rows.covariances + self._variance(position)[:, None, None] * extra
        return linear.position_fix(position, lever, rows.position, covariance)

    def antenna(self, chain: Chain, times: FloatArray, attitude: AttitudeTrack) -> Antenna:
        """The transducer at each leg's time (M, L)."""
        position = self.layout.positions_at(chain, times.ravel())
        lever = attitude.lever(self.setup.vehicle.transducer, times.ravel())
        arm = None
        if self.layout.has("lever_arm"):
            rotation = attitude.at(times.ravel()).reshape(*times.shape, 3, 3)
            arm = Arm(self.layout.shared_columns("lever_arm"), rotation)
        return PointAntenna(
            position, lever.reshape(*times.shape, 3), self.psd, self._variance(position), arm
        )

    def range_block(self, chain: Chain, pings: Pings, attitude: AttitudeTrack) -> RangeBlock:
        """Residuals of pings.

        Parameters
        ----------
        chain : Chain
            Nodes that span the pings.
        pings : TwoWayRange, OneWayRange or SlantRange
            M records.
        attitude : AttitudeTrack
            Held attitude, for lever arms on point nodes.
        """
        times = leg_times(pings)
        legs_at = times.ravel()
        which = self.setup.beacon_numbers(pings.beacon)
        there: Antenna
        if self.options.estimate_beacons:
            each = [self.layout.shared_columns(f"beacon {n}") for n in self.setup.beacon_names]
            there = FreeAntenna(np.stack(each)[which], times.shape[1])
        else:
            places = np.stack([b.position for b in self.setup.beacons])[which]
            there = FixedAntenna(places, times.shape[1])
        sound_speed = None
        offsets: list[Interpolation] = []
        if self.layout.has("sound_speed"):
            sound_speed = self.layout.slow_at("sound_speed", chain, legs_at)
        if isinstance(pings, OneWayRange):
            offsets.append(self.layout.slow_at("clock_offset", chain, legs_at))
        if self.options.range_bias_sigma > 0.0:
            offsets.append(self._range_bias(pings.beacon, times.shape[1]))
        measured, sigma = measured_times(pings)
        return RangeBlock(
            kind_of(pings),
            chain.name,
            along_distances if isinstance(pings, SlantRange) else self.travel_times,
            self.antenna(chain, times, attitude),
            there,
            measured,
            sigma,
            sound_speed,
            Interpolation.together(offsets) if offsets else None,
        )

    def _range_bias(self, beacons: FloatArray, legs: int) -> Interpolation:
        """What each ping's beacon makes its travel time too long by (M rows)."""
        columns = np.stack([self.layout.shared_columns(f"{RANGE_BIAS}{n}") for n in beacons])
        none = np.zeros(len(beacons))
        weights = np.full((len(beacons), 1), legs / NOMINAL_SPEED)
        return Interpolation(columns[:, None], weights, none, none)

    def _variance(self, position: Interpolation) -> FloatArray:
        """Interpolation variance at unit density, zero for a chain of one node."""
        return interpolation_variance(self.layout.order, position.dt, position.s)
