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
from ubl_graph.measurements import OneWayRange, TwoWayRange
from ubl_graph.mission import Mission, Segment, Start
from ubl_graph.nodes import node_times, order_of
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
    if segment.velocity is not None:
        for reference in ("bottom", "water"):
            rows = segment.velocity[segment.velocity.reference == reference]
            if len(rows) > 1:
                by_reference[reference] = Preintegration(rows, attitude, options.acceleration_psd)
    times = node_times(segment, options, tuple(by_reference.values()))
    return SegmentModel(
        segment, times, attitude, by_reference.get("bottom"), by_reference.get("water")
    )


def build_problem(mission: Mission, models: Sequence[SegmentModel]) -> Problem:
    """The least-squares problem of some segments of a mission, all unknowns in one layout."""
    layout = _layout(mission, models)
    builder = _Builder(mission, layout)
    blocks: list[Block] = []
    for chain, model in zip(layout.chains, models, strict=True):
        blocks += builder.segment_blocks(chain, model)
    blocks += builder.shared_priors(models)
    blocks = [b for b in blocks if len(b.columns)]
    options = mission.options
    psd = (options.horizontal_psd, options.vertical_psd)
    return Problem(layout, tuple(blocks), RobustLoss(options.loss), psd)


def travel_time_model(mission: Mission) -> TravelTimeModel:
    """Travel times as the mission's options ask for them.

    Where no direct ray exists the straight line stands in, so that a solver's trial step may
    wander; the result's residual table says where that is so in the end.
    """
    profile = mission.sound_speed
    if mission.uses_eigenrays:
        return partial(eigenray, profile, missing="straight")

    def along_lines(a: FloatArray, b: FloatArray) -> TravelTimes:
        return straight(profile, a, b)

    return along_lines


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
    shared: list[tuple[str, int]] = []
    if any(model.bottom is not None or model.water is not None for model in models):
        sigmas = _dvl_sigmas(options, models)
        shared += [(name, size) for name, size in DVL_STATES if sigmas[name][-1] > 0.0]
    if options.estimate_beacons:
        shared += [(f"beacon {b.name}", 3) for b in mission.beacons]
    return Layout(tuple(chains), order_of(options), tuple(slow), tuple(shared))


def _dvl_sigmas(options: Options, models: Sequence[SegmentModel]) -> dict[str, FloatArray]:
    """Prior standard deviations of the DVL's errors, and of the heading reference's.

    Lasting errors of roll and pitch turn the odometry as a misalignment about forward and left
    does, so its states carry both.
    """
    attitudes = [m.segment.attitude for m in models if m.segment.attitude is not None]
    lasting = max((float(np.median(a.sigma)) for a in attitudes), default=0.0)
    mounting = float(np.deg2rad(options.dvl_misalignment_sigma_deg))
    level = float(np.hypot(mounting, lasting))
    return {
        "dvl_scale": np.array([options.dvl_scale_sigma]),
        "dvl_misalignment": np.array([level, level, mounting]),
        "dvl_bias": np.full(3, options.dvl_bias_sigma),
        "heading_bias": np.array([lasting]),
    }


class _Builder:
    """Blocks of one problem."""

    def __init__(self, mission: Mission, layout: Layout) -> None:
        self.mission, self.layout, self.options = mission, layout, mission.options
        self.travel_times = travel_time_model(mission)
        self.psd = np.array(
            [self.options.horizontal_psd, self.options.horizontal_psd, self.options.vertical_psd]
        )

    def segment_blocks(self, chain: Chain, model: SegmentModel) -> list[Block]:
        segment = model.segment
        blocks: list[Block] = self._start_priors(chain, segment)
        blocks += self._motion_blocks(chain, model)
        blocks += self._slow_blocks(chain)
        if segment.depth is not None:
            blocks.append(self._depth_block(chain, model))
        if segment.position is not None:
            blocks.append(self._fix_block(chain, model))
        if segment.two_way_range is not None and len(segment.two_way_range):
            pings = segment.two_way_range
            times = np.stack([pings.t_transmit, pings.t_receive], axis=1)
            blocks.append(self._range_block("two_way_range", chain, model, pings, times))
        if segment.one_way_range is not None and len(segment.one_way_range):
            pings = segment.one_way_range
            times = pings.t_receive[:, None]
            blocks.append(self._range_block("one_way_range", chain, model, pings, times))
        return blocks

    def shared_priors(self, models: Sequence[SegmentModel]) -> list[Block]:
        blocks: list[Block] = []
        for name, sigma in _dvl_sigmas(self.options, models).items():
            if self.layout.has(name):
                columns = self.layout.shared_columns(name)[None]
                sigma = np.array(sigma / self.layout.unit(name))
                blocks.append(linear.prior(name, columns, np.zeros(columns.shape), sigma))
        if self.options.estimate_beacons:
            for beacon in self.mission.beacons:
                columns = self.layout.shared_columns(f"beacon {beacon.name}")[None]
                sigma = np.where(beacon.sigma > 0.0, beacon.sigma, FREE_POSITION)
                blocks.append(linear.prior("beacon", columns, beacon.position[None], sigma[None]))
        return blocks

    def _start_priors(self, chain: Chain, segment: Segment) -> list[Block]:
        """What is known of the first node, and the start prior where there is one."""
        first = np.array([chain.first])
        middle = np.zeros(3)
        if self.mission.beacons:
            middle = np.mean([b.position for b in self.mission.beacons], axis=0)
        blocks: list[Block] = [
            self._node_prior("position", first, middle[None], FREE_POSITION),
            self._node_prior("velocity", first, np.zeros((1, 3)), self.options.speed_sigma),
        ]
        if self.layout.order == 3:
            blocks.append(
                self._node_prior("acceleration", first, np.zeros((1, 3)), FREE_ACCELERATION)
            )
        if segment.start is not None:
            blocks.append(self._start_block(chain, segment.start))
        return blocks

    def _start_block(self, chain: Chain, start: Start) -> Block:
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
        arm = self.mission.vehicle.dvl
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

    def _slow_blocks(self, chain: Chain) -> list[Block]:
        options, layout = self.options, self.layout
        blocks: list[Block] = []
        first = np.array([chain.first])
        initial = {
            "sound_speed": (self.mission.sound_speed_sigma, options.sound_speed_walk),
            "current": (options.current_sigma, options.current_walk),
        }
        span = max(float(chain.t[-1] - chain.t[0]), 1.0)
        for name, (sigma, walk) in initial.items():
            if layout.has(name):
                size = layout.node_columns(name, first).shape[1]
                blocks.append(self._node_prior(name, first, np.zeros((1, size)), max(sigma, 1e-9)))
                # A walk of zero means a constant; a thousandth of the prior over the whole span
                # is as good and keeps the equations regular.
                walk = max(walk, 1e-3 * max(sigma, 1e-9) / np.sqrt(span))
                blocks.append(linear.random_walk(layout, chain, name, walk))
        if layout.has("clock_offset"):
            sigmas = {
                "clock_offset": options.clock_offset_sigma,
                "clock_drift": options.clock_drift_sigma,
            }
            for name, sigma in sigmas.items():
                blocks.append(self._node_prior(name, first, np.zeros((1, 1)), max(sigma, 1e-15)))
            walks = max(options.clock_walk, 1e-10), max(options.clock_drift_walk, 1e-13)
            blocks.append(linear.clock_walk(layout, chain, *walks))
        return blocks

    def _depth_block(self, chain: Chain, model: SegmentModel) -> Block:
        assert model.segment.depth is not None
        rows = model.segment.depth
        rows = rows[inside(chain.t, rows.t)]
        lever = model.attitude.lever(self.mission.vehicle.depth_sensor, rows.t)
        position = self.layout.positions_at(chain, rows.t)
        variance = rows.sigma**2 + self.psd[2] * self._variance(position)
        return linear.depth(position, lever[:, 2], rows.depth, np.sqrt(variance))

    def _fix_block(self, chain: Chain, model: SegmentModel) -> Block:
        assert model.segment.position is not None
        rows = model.segment.position
        lever = model.attitude.lever(self.mission.vehicle.antenna, rows.t)
        position = self.layout.positions_at(chain, rows.t)
        extra = np.eye(rows.dimension) * self.psd[: rows.dimension]
        covariance = rows.covariances + self._variance(position)[:, None, None] * extra
        return linear.position_fix(position, lever, rows.position, covariance)

    def _range_block(
        self,
        name: str,
        chain: Chain,
        model: SegmentModel,
        pings: TwoWayRange | OneWayRange,
        times: FloatArray,
    ) -> Block:
        """`times` (M, L): when the vehicle is at each leg's end."""
        legs_at = times.ravel()
        lever = model.attitude.lever(self.mission.vehicle.transducer, legs_at)
        position = self.layout.positions_at(chain, legs_at)
        legs = Legs(position, lever.reshape(*times.shape, 3), self.psd, self._variance(position))
        which = self.mission.beacon_numbers(pings.beacon)
        beacon_columns = None
        if self.options.estimate_beacons:
            each = [self.layout.shared_columns(f"beacon {n}") for n in self.mission.beacon_names]
            beacon_columns = np.stack(each)[which]
        sound_speed = clock = None
        if self.layout.has("sound_speed"):
            sound_speed = self.layout.slow_at("sound_speed", chain, legs_at)
        if name == "one_way_range":
            clock = self.layout.slow_at("clock_offset", chain, legs_at)
        return RangeBlock(
            name,
            chain.name,
            self.travel_times,
            legs,
            np.stack([b.position for b in self.mission.beacons])[which],
            pings.travel_time,
            pings.sigma,
            sound_speed,
            clock,
            beacon_columns,
        )

    def _variance(self, position: Interpolation) -> FloatArray:
        """Interpolation variance at unit density, zero for a chain of one node."""
        return interpolation_variance(self.layout.order, position.dt, position.s)
