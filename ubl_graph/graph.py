"""From a mission to a Problem: nodes, unknowns and blocks.

`build_problem` reads like the list of what ties a vehicle's states together: priors, motion,
odometry, depth, fixes, ranges, slow states.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ubl_graph.acoustics import TravelTimes, eigenray, straight
from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.attitude import AttitudeTrack
from ubl_graph.factors import linear
from ubl_graph.factors.block import Block
from ubl_graph.factors.loss import RobustLoss
from ubl_graph.factors.odometry import DVL_STATES, Preintegration, node_velocity, odometry
from ubl_graph.factors.ranges import Legs, RangeBlock, TravelTimeModel
from ubl_graph.layout import Chain, Interpolation, Layout
from ubl_graph.measurements import OneWayRange, PositionFix, TwoWayRange
from ubl_graph.mission import Mission, Segment, Setup, Start
from ubl_graph.nodes import grid_times, node_times, order_of
from ubl_graph.options import Options
from ubl_graph.problem import Problem
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
    """

    segment: Segment
    t: FloatArray
    attitude: AttitudeTrack
    bottom: Preintegration | None
    water: Preintegration | None


def model_segment(segment: Segment, options: Options) -> SegmentModel:
    """Derive nodes, attitude and preintegrated odometry of a segment."""
    attitude = AttitudeTrack(segment.attitude)
    by_reference: dict[str, Preintegration] = {}
    psd = options.number("acceleration_psd")
    if segment.velocity is not None:
        for reference in ("bottom", "water"):
            rows = segment.velocity[segment.velocity.reference == reference]
            if len(rows) > 1:
                by_reference[reference] = Preintegration(rows, attitude, psd)
    odometry = tuple(by_reference.values())
    if options.node_spacing is None:
        times = node_times(segment, options, odometry)
    else:
        times = grid_times(segment, options.node_spacing, odometry)
    return SegmentModel(
        segment, times, attitude, by_reference.get("bottom"), by_reference.get("water")
    )


def build_problem(mission: Mission, models: Sequence[SegmentModel]) -> Problem:
    """The least-squares problem of some segments of a mission, all unknowns in one layout."""
    layout = _layout(mission, models)
    builder = Builder(mission.setup, layout)
    blocks: list[Block] = []
    for chain, model in zip(layout.chains, models, strict=True):
        blocks += builder.segment_blocks(chain, model)
    blocks += builder.shared_priors(_lasting(models))
    blocks = [b for b in blocks if len(b.columns)]
    options = mission.options
    psd = (options.horizontal_psd, options.vertical_psd)
    return Problem(layout, tuple(blocks), RobustLoss(options.loss), psd)


def travel_time_model(setup: Setup) -> TravelTimeModel:
    """Travel times as the options ask for them.

    Where no direct ray exists the straight line stands in, so that a solver's trial step may
    wander; the result's residual table says where that is so in the end.
    """
    profile = setup.sound_speed
    if setup.uses_eigenrays:
        return partial(eigenray, profile, missing="straight")

    def along_lines(a: FloatArray, b: FloatArray) -> TravelTimes:
        return straight(profile, a, b)

    return along_lines


def leg_times(pings: TwoWayRange | OneWayRange) -> FloatArray:
    """When the vehicle is at each leg's end, s: (M, 2), or (M, 1) for one-way ranges."""
    if isinstance(pings, OneWayRange):
        return pings.t_receive[:, None]
    return np.stack([pings.t_transmit, pings.t_receive], axis=1)


def _layout(mission: Mission, models: Sequence[SegmentModel]) -> Layout:
    options = mission.options
    chains: list[Chain] = []
    first = 0
    for model in models:
        chains.append(Chain(model.segment.name, first, model.t))
        first += len(model.t)
    records = [model.segment.records() for model in models]
    has_ranges = any({"two_way_range", "one_way_range"} & r.keys() for r in records)
    slow: list[tuple[str, int]] = []
    if options.estimate_sound_speed and has_ranges:
        slow.append(("sound_speed", 1))
    if any("one_way_range" in r for r in records):
        slow += [("clock_offset", 1), ("clock_drift", 1)]
    if any(model.water is not None for model in models):
        slow.append(("current", 2))
    odometry = any(model.bottom is not None or model.water is not None for model in models)
    shared = shared_states(mission.setup, _lasting(models) if odometry else None)
    return Layout(tuple(chains), order_of(options), tuple(slow), shared)


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
        sigmas = _dvl_sigmas(setup.options, lasting)
        shared += [(name, size) for name, size in DVL_STATES if sigmas[name][-1] > 0.0]
    if setup.options.estimate_beacons:
        shared += [(f"beacon {b.name}", 3) for b in setup.beacons]
    return tuple(shared)


def _lasting(models: Sequence[SegmentModel]) -> float:
    """Standard deviation of the heading references' lasting error, rad."""
    attitudes = [m.segment.attitude for m in models if m.segment.attitude is not None]
    return max((float(np.median(a.sigma)) for a in attitudes), default=0.0)


def _dvl_sigmas(options: Options, lasting: float) -> dict[str, FloatArray]:
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
        "heading_bias": np.array([lasting]),
    }


class Builder:
    """Makes the blocks of one problem.

    Parameters
    ----------
    setup : Setup
        Beacons, sound speed, vehicle and options.
    layout : Layout
        The unknowns.
    """

    def __init__(self, setup: Setup, layout: Layout) -> None:
        self.setup, self.layout, self.options = setup, layout, setup.options
        self.travel_times = travel_time_model(setup)
        self.psd = np.array(
            [self.options.horizontal_psd, self.options.horizontal_psd, self.options.vertical_psd]
        )

    def segment_blocks(self, chain: Chain, model: SegmentModel) -> list[Block]:
        """All that ties the nodes of one segment, but for what they share."""
        segment = model.segment
        blocks: list[Block] = self.first_priors(chain)
        if segment.start is not None:
            blocks.append(self.start_block(chain, segment.start))
        blocks += self.linear_blocks(chain, model, max(float(chain.t[-1] - chain.t[0]), 1.0))
        for pings in (segment.two_way_range, segment.one_way_range):
            if pings is not None and len(pings):
                lever = self.transducer_levers(model.attitude, pings)
                blocks.append(self.range_block(chain, pings, lever))
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
        blocks = self._motion_blocks(chain, model)
        if len(chain.t) > 1:
            blocks += self._walk_blocks(chain, span)
        if model.segment.depth is not None:
            blocks.append(self._depth_block(chain, model))
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
        for name, size in self.layout.slow:
            blocks.append(
                self._node_prior(name, first, np.zeros((1, size)), self._slow_sigma(name))
            )
        return blocks

    def _slow_sigma(self, name: str) -> float:
        """Standard deviation of a slow state at the first node, SI."""
        options = self.options
        least = 1e-15 if name.startswith("clock") else 1e-9
        sigmas = {
            "sound_speed": self.setup.sound_speed_sigma,
            "current": options.current_sigma,
            "clock_offset": options.clock_offset_sigma,
            "clock_drift": options.clock_drift_sigma,
        }
        return max(sigmas[name], least)

    def shared_priors(self, lasting: float) -> list[Block]:
        """What is known beforehand of what all nodes share.

        Parameters
        ----------
        lasting : float
            Standard deviation of the heading reference's lasting error, rad.
        """
        blocks: list[Block] = []
        for name, sigma in _dvl_sigmas(self.options, lasting).items():
            if self.layout.has(name):
                columns = self.layout.shared_columns(name)[None]
                sigma = np.array(sigma / self.layout.unit(name))
                blocks.append(linear.prior(name, columns, np.zeros(columns.shape), sigma))
        if self.options.estimate_beacons:
            for beacon in self.setup.beacons:
                columns = self.layout.shared_columns(f"beacon {beacon.name}")[None]
                sigma = np.where(beacon.sigma > 0.0, beacon.sigma, FREE_POSITION)
                blocks.append(linear.prior("beacon", columns, beacon.position[None], sigma[None]))
        return blocks

    def start_block(self, chain: Chain, start: Start) -> Block:
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
        return replace(block, name="start prior")

    def _node_prior(
        self, name: str, nodes: IntArray, mean: FloatArray, sigma: float
    ) -> linear.LinearBlock:
        columns = self.layout.node_columns(name, nodes)
        unit = self.layout.unit(name)
        return linear.prior(name, columns, mean / unit, np.array(sigma / unit))

    def _motion_blocks(self, chain: Chain, model: SegmentModel) -> list[Block]:
        if len(chain.t) == 1:
            return []
        blocks: list[Block] = []
        psd = np.tile(self.psd, (len(chain.t) - 1, 1))
        arm = self.setup.vehicle.dvl
        for samples, current in ((model.bottom, False), (model.water, True)):
            if samples is None:
                continue
            lever = model.attitude.lever(arm, chain.t)
            rate = model.attitude.lever_rate(arm, chain.t)
            rows, covered = odometry(self.layout, chain, samples, lever, current=current)
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
        }
        for name, walk in walks.items():
            if layout.has(name):
                # A walk of zero means a constant; a thousandth of the prior over the whole span
                # is as good and keeps the equations regular.
                least = 1e-3 * self._slow_sigma(name) / np.sqrt(span)
                blocks.append(linear.random_walk(layout, chain, name, max(walk, least)))
        if layout.has("clock_offset"):
            clock = max(options.clock_walk, 1e-10), max(options.clock_drift_walk, 1e-13)
            blocks.append(linear.clock_walk(layout, chain, *clock))
        return blocks

    def _depth_block(self, chain: Chain, model: SegmentModel) -> Block:
        assert model.segment.depth is not None
        rows = model.segment.depth
        rows = rows[inside(chain.t, rows.t)]
        lever = model.attitude.lever(self.setup.vehicle.depth_sensor, rows.t)
        position = self.layout.positions_at(chain, rows.t)
        variance = rows.sigma**2 + self.psd[2] * self._variance(position)
        return linear.depth(position, lever[:, 2], rows.depth, np.sqrt(variance))

    def fix_block(self, chain: Chain, rows: PositionFix, attitude: AttitudeTrack) -> Block:
        """Position fixes of one dimension (horizontal ones or full ones)."""
        lever = attitude.lever(self.setup.vehicle.antenna, rows.t)
        position = self.layout.positions_at(chain, rows.t)
        extra = np.eye(rows.dimension) * self.psd[: rows.dimension]
        covariance = rows.covariances + self._variance(position)[:, None, None] * extra
        return linear.position_fix(position, lever, rows.position, covariance)

    def transducer_levers(
        self, attitude: AttitudeTrack, pings: TwoWayRange | OneWayRange
    ) -> FloatArray:
        """Reference point to transducer at each leg's end, world axes, m: (M, L, 3)."""
        times = leg_times(pings)
        lever = attitude.lever(self.setup.vehicle.transducer, times.ravel())
        return lever.reshape(*times.shape, 3)

    def range_block(
        self, chain: Chain, pings: TwoWayRange | OneWayRange, lever: FloatArray
    ) -> RangeBlock:
        """Residuals of pings.

        Parameters
        ----------
        chain : Chain
            Nodes that span the pings.
        pings : TwoWayRange or OneWayRange
            M records.
        lever : array, shape (M, L, 3)
            From `transducer_levers`.
        """
        legs_at = leg_times(pings).ravel()
        position = self.layout.positions_at(chain, legs_at)
        legs = Legs(position, lever, self.psd, self._variance(position))
        which = self.setup.beacon_numbers(pings.beacon)
        beacon_columns = None
        if self.options.estimate_beacons:
            each = [self.layout.shared_columns(f"beacon {n}") for n in self.setup.beacon_names]
            beacon_columns = np.stack(each)[which]
        sound_speed = clock = None
        if self.layout.has("sound_speed"):
            sound_speed = self.layout.slow_at("sound_speed", chain, legs_at)
        one_way = isinstance(pings, OneWayRange)
        if one_way:
            clock = self.layout.slow_at("clock_offset", chain, legs_at)
        return RangeBlock(
            "one_way_range" if one_way else "two_way_range",
            chain.name,
            self.travel_times,
            legs,
            np.stack([b.position for b in self.setup.beacons])[which],
            pings.travel_time,
            pings.sigma,
            sound_speed,
            clock,
            beacon_columns,
        )

    def _variance(self, position: Interpolation) -> FloatArray:
        """Interpolation variance at unit density, zero for a chain of one node."""
        return interpolation_variance(self.layout.order, position.dt, position.s)
