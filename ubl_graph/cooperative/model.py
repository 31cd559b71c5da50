"""From a fleet to a least-squares problem: each vehicle's own blocks, and ranges between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.builder import FREE_POSITION, Builder, SegmentModel
from ubl_graph.cooperative.blocks import End, JoinedAntenna, PlacedBlock, placed
from ubl_graph.cooperative.fleet import Fleet, Member, Target, own_ranges, span_of
from ubl_graph.cooperative.layout import FleetLayout
from ubl_graph.cooperative.peers import PeerPings
from ubl_graph.factors import linear
from ubl_graph.factors.block import Block
from ubl_graph.factors.loss import RobustLoss
from ubl_graph.factors.ranges import FreeAntenna, PointAntenna, RangeBlock
from ubl_graph.graph import build_problem, builder_of, layout_of, model_segment
from ubl_graph.layout import Interpolation, Layout
from ubl_graph.measurements import Odometry, SlantRange
from ubl_graph.mission import Mission, Segment, Start
from ubl_graph.odometry_chain import compounded
from ubl_graph.options import Options
from ubl_graph.pings import along_distances, leg_times, travel_time_model
from ubl_graph.pose_states import odometry_sigmas
from ubl_graph.problem import LeastSquares, Problem

#: Odometry is compounded over no more than this, s: a node that stands for long joins all that
#: stand beside it in time, and the equations' band grows with it.
LONGEST_STEP = 60.0
#: Nor over more of a turn, rad, where its scale or turn bias are unknowns: over an arc these change
#: the way's length and bend, which the compound's residual takes for that of a straight way.
LARGEST_TURN = 0.1
#: A known component of a target's place or velocity is held to within this, m and m/s.
HELD = 1e-4


@dataclass(frozen=True, eq=False)
class MemberModel:
    """A vehicle with what is derived from its records once, and with its own problem.

    Attributes
    ----------
    member : Member
        The vehicle.
    mission : Mission
        Its own, without ranges to vehicles and targets; compounded odometry brings its noise along.
    model : SegmentModel
        Nodes that stand at all its ranges, whoever measured them.
    layout : Layout
        Its own unknowns.
    """

    member: Member
    mission: Mission
    model: SegmentModel
    layout: Layout

    @property
    def name(self) -> str:
        """The vehicle's name."""
        return self.member.name


@dataclass(frozen=True, eq=False)
class FleetProblem(LeastSquares):
    """The problem of vehicles that are joined by ranges.

    Attributes
    ----------
    layout : FleetLayout
        The unknowns.
    members : tuple of MemberModel
        In the layout's order.
    own : tuple of Problem
        Each vehicle's part, of its own columns.
    pings : tuple of PeerPings
        What each of the blocks of ranges between vehicles was made of; these blocks stand last.
    epochs : dict of str to float
        Time of each moving target's position, s.
    """

    layout: FleetLayout
    members: tuple[MemberModel, ...]
    own: tuple[Problem, ...]
    pings: tuple[PeerPings, ...]
    epochs: dict[str, float]

    def own_blocks(self, vehicle: int) -> slice:
        """A vehicle's own blocks among all."""
        first = sum(len(problem.blocks) for problem in self.own[:vehicle])
        return slice(first, first + len(self.own[vehicle].blocks))

    @property
    def ranges(self) -> slice:
        """The blocks of ranges between vehicles among all."""
        return slice(len(self.blocks) - len(self.pings), len(self.blocks))


def model_member(fleet: Fleet, member: Member, pings: Sequence[PeerPings]) -> MemberModel:
    """Derive nodes, attitude and odometry of one vehicle of a fleet."""
    options = fleet.options_of(member)
    segment = own_ranges(member, fleet.beacon_names)
    view = _seen_by_nodes(segment, member.name, pings)
    if _compoundable(segment, options):
        assert segment.odometry is not None
        steps = compounded(segment.odometry, _wanted(view, options), options)
        segment, view = (replace(s, odometry=steps) for s in (segment, view))
    model = replace(model_segment(view, options), segment=segment)
    mission = fleet.mission_of(member.name)
    if segment.odometry is not None and segment.odometry is not member.segment.odometry:
        mission = replace(mission, options=replace(options, odometry_noise="given"))
    clocked = any(
        p.kind == "one_way_range" and ((p.vehicle == member.name) | (p.peer == member.name)).any()
        for p in pings
    )
    return MemberModel(member, mission, model, layout_of(mission, [model], clocked=clocked))


def _seen_by_nodes(segment: Segment, name: str, pings: Sequence[PeerPings]) -> Segment:
    """A segment with all ranges that a vehicle has a part in, for the sake of their times."""
    own = segment.slant_range
    found = [p.times_of(name) for p in pings]
    if own is not None:
        found.append((own.t, own.sigma))
    times = np.concatenate([np.empty(0), *(t for t, _ in found)])
    if len(times):
        sigmas = np.concatenate([s for _, s in found])
        return replace(segment, slant_range=SlantRange(times, "", 1.0, sigmas.clip(1e-6, 1e4)))
    if {"two_way_range", "one_way_range", "position"} & segment.records().keys():
        return segment
    start = segment.start
    if start is None:
        # Nothing says where it is; but it went somewhere.
        span = span_of(segment) or (0.0, 0.0)
        start = Start(span[0], 0.0, 0.0, sigma=FREE_POSITION)
    once = SlantRange(start.t, "", 1.0, float(np.clip(start.sigma, 1e-6, 1e4)))
    return replace(segment, start=start, slant_range=once)


def _compoundable(segment: Segment, options: Options) -> bool:
    """Whether odometry alone says how the vehicle moves between ranges and fixes."""
    others = {"velocity", "attitude", "heading", "angular_rate"}
    if options.node == "pose3":
        others.add("depth")
    present = segment.records().keys()
    if segment.odometry is None or "odometry" not in present or others & present:
        return False
    # What holds a vehicle in space upright, where its odometry is planar, stands at each node.
    return options.node != "pose3" or segment.odometry.dimension == 3


def _wanted(view: Segment, options: Options) -> FloatArray:
    """Times at which a vehicle that odometry moves needs a node, s."""
    assert view.odometry is not None
    times = [np.array([view.odometry.t_from.min(), view.odometry.t_to.max()])]
    for kind in ("two_way_range", "one_way_range", "slant_range"):
        rows = getattr(view, kind)
        if rows is not None:
            times.append(leg_times(rows).ravel())
    if view.position is not None:
        times.append(view.position.t)
    if view.start is not None:
        times.append(np.array([view.start.t]))
    if any(odometry_sigmas(options).values()):
        times.append(_turns(view.odometry))
    wanted = np.unique(np.concatenate(times))
    gaps: FloatArray = np.diff(wanted)
    more = [
        np.linspace(wanted[i], wanted[i + 1], int(np.ceil(gaps[i] / LONGEST_STEP)) + 1)[1:-1]
        for i in np.flatnonzero(gaps > LONGEST_STEP)
    ]
    return np.unique(np.concatenate([wanted, *more]))


def _turns(records: Odometry) -> FloatArray:
    """Times at which the heading has changed by `LARGEST_TURN` since the last one, s."""
    order = np.argsort(records.t_to, kind="stable")
    heading = np.cumsum(records.rotation_vector[order, 2])
    last, found = 0.0, list[int]()
    for i, now in enumerate(heading.tolist()):
        if abs(now - last) > LARGEST_TURN:
            found.append(i)
            last = now
    return records.t_to[order[found]]


def build_fleet(
    fleet: Fleet,
    members: Sequence[MemberModel],
    pings: Sequence[PeerPings],
    targets: dict[str, FloatArray],
) -> FleetProblem:
    """The least-squares problem of a fleet.

    Parameters
    ----------
    fleet : Fleet
        Of which vehicles.
    members : sequence of MemberModel
        In the fleet's order.
    pings : sequence of PeerPings
        Ranges between them.
    targets : dict of str to array, shape (3,)
        Where the search puts each target: the middle of the prior of those of which nothing is
        said.
    """
    common: list[tuple[str, int]] = []
    scaled = bool(pings) and fleet.options.estimate_sound_speed
    if scaled:
        common.append(("sound_speed", 1))
    for target in fleet.targets:
        common.append((f"target {target.name}", 3))
        if target.moves:
            common.append((f"velocity {target.name}", 3))
    layout = FleetLayout.of([m.layout for m in members], common)
    own = tuple(_own_problem(m) for m in members)
    blocks: list[Block] = []
    for problem, place in zip(own, layout.place, strict=True):
        blocks += [PlacedBlock(block, place) for block in problem.blocks]
    blocks += _common_priors(fleet, layout, targets)
    epochs = {t.name: reference_time(t, pings) for t in fleet.targets if t.moves}
    blocks += [_range_block(fleet, layout, members, p, epochs, scaled=scaled) for p in pings]
    loss = RobustLoss(fleet.options.loss)
    return FleetProblem(layout, tuple(blocks), loss, tuple(members), own, tuple(pings), epochs)


def _own_problem(member: MemberModel) -> Problem:
    """A vehicle's own blocks; what is known of beacons is said once for all vehicles."""
    problem = build_problem(member.mission, [member.model], member.layout)
    blocks = tuple(b for b in problem.blocks if b.name != "beacon prior")
    return replace(problem, blocks=blocks)


def _common_priors(
    fleet: Fleet, layout: FleetLayout, targets: dict[str, FloatArray]
) -> list[Block]:
    """What is known beforehand of what belongs to no vehicle."""
    blocks: list[Block] = []

    def know(name: str, mean: FloatArray, sigma: FloatArray) -> None:
        columns = layout.common_columns(name)[None]
        unit = Layout.unit(name)
        blocks.append(linear.prior(name.split()[0], columns, mean[None] / unit, sigma[None] / unit))

    for beacon in fleet.beacons:
        if layout.has(f"beacon {beacon.name}"):
            sigma = np.where(beacon.sigma > 0.0, beacon.sigma, FREE_POSITION)
            know(f"beacon {beacon.name}", beacon.position, sigma)
    if layout.has("sound_speed"):
        sigma = max(fleet.setup.sound_speed_sigma, 1e-9)
        know("sound_speed", np.zeros(1), np.array([sigma]))
    for target in fleet.targets:
        mean = targets[target.name] if target.position is None else target.position
        know(f"target {target.name}", mean, np.maximum(target.sigma, HELD))
        if target.moves:
            know(f"velocity {target.name}", np.zeros(3), np.maximum(target.velocity_sigma, HELD))
    return blocks


def reference_time(target: Target, pings: Sequence[PeerPings]) -> float:
    """Time of a moving target's position, s: as given, or the first range's."""
    if target.t is not None:
        return target.t
    return min(
        (float(p.there[p.peer == target.name].min(initial=np.inf)) for p in pings),
        default=0.0,
    )


def _range_block(
    fleet: Fleet,
    layout: FleetLayout,
    members: Sequence[MemberModel],
    pings: PeerPings,
    epochs: dict[str, float],
    *,
    scaled: bool,
) -> RangeBlock:
    """All ranges of one kind between vehicles and to targets."""
    count, legs = pings.here.shape
    here: list[End] = []
    there: list[End] = []
    for i, member in enumerate(members):
        for who, at, ends in (
            (pings.vehicle, pings.here, here),
            (pings.peer, pings.there, there),
        ):
            rows = np.flatnonzero(who == member.name)
            if len(rows):
                antenna = _builder(member).antenna(
                    member.layout.chains[0], at[rows], member.model.attitude
                )
                ends.append(End(rows, antenna, layout.place[i]))
    for target in fleet.targets:
        rows = np.flatnonzero(pings.peer == target.name)
        if len(rows):
            there.append(_target_end(layout, target, rows, pings.there[rows], epochs))
    speed = clock = None
    if scaled:
        columns = np.broadcast_to(layout.common_columns("sound_speed"), (count * legs, 1, 1))
        weights = np.full((count * legs, 1), Layout.unit("sound_speed"))
        speed = _constant(columns, weights)
    if pings.kind == "one_way_range":
        clock = _clocks(layout, members, pings)
    return RangeBlock(
        pings.kind,
        "",
        along_distances if pings.kind == "slant_range" else travel_time_model(fleet.setup),
        JoinedAntenna(here, count, legs),
        JoinedAntenna(there, count, legs),
        pings.measured,
        pings.sigma,
        speed,
        clock,
    )


def _builder(member: MemberModel) -> Builder:
    return builder_of(member.mission, [member.model], member.layout)


def _target_end(
    layout: FleetLayout, target: Target, rows: IntArray, at: FloatArray, epochs: dict[str, float]
) -> End:
    """A target's place at each leg (at `at`, s) of the ranges `rows` to it."""
    place = layout.common_columns(f"target {target.name}")
    if not target.moves:
        columns = np.broadcast_to(place, (len(rows), 3))
        return End(rows, FreeAntenna(columns, at.shape[1]))
    later = at.ravel() - epochs[target.name]
    both = np.stack([place, layout.common_columns(f"velocity {target.name}")])
    columns = np.broadcast_to(both, (len(later), 2, 3))
    weights = np.stack([np.ones_like(later), later], axis=1)
    still = np.zeros((*at.shape, 3))
    return End(
        rows, PointAntenna(_constant(columns, weights), still, np.zeros(3), np.zeros(at.size))
    )


def _clocks(layout: FleetLayout, members: Sequence[MemberModel], pings: PeerPings) -> Interpolation:
    """The clock of who heard less that of who sent; targets and beacons keep the fleet's time."""
    count = len(pings)
    columns = np.full((count, 4, 1), -1, dtype=np.int64)
    weights = np.zeros((count, 4))
    for i, member in enumerate(members):
        for who, at, sign, where in (
            (pings.vehicle, pings.here, 1.0, slice(0, 2)),
            (pings.peer, pings.there, -1.0, slice(2, 4)),
        ):
            rows = np.flatnonzero(who == member.name)
            if len(rows):
                chain = member.layout.chains[0]
                part = member.layout.slow_at("clock_offset", chain, at[rows, 0])
                columns[rows, where] = placed(part.columns, layout.place[i])
                weights[rows, where] = sign * part.weights
    return _constant(columns, weights)


def _constant(columns: IntArray, weights: FloatArray) -> Interpolation:
    """A weighted sum that no interval between nodes has a part in."""
    none = np.zeros(len(weights))
    return Interpolation(columns, weights, none, none)
