"""Blocks of a fleet's rows: one of each kind, of all vehicles' odometry, ranges and readings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ubl_graph.arrays import BoolArray, FloatArray
from ubl_graph.cooperative.blocks import End, JoinedAntenna
from ubl_graph.cooperative.fleet import Fleet
from ubl_graph.factors import pose_motion
from ubl_graph.factors.block import Block
from ubl_graph.factors.compass import CompassBlock
from ubl_graph.factors.poses import PoseBlock
from ubl_graph.factors.ranges import Antenna, FixedAntenna, RangeBlock
from ubl_graph.factors.tips import PoseAntenna, TipBlock
from ubl_graph.layout import Interpolation, Layout
from ubl_graph.online.buffer import PINGS, Entry
from ubl_graph.online.fleet_line import Line, Node
from ubl_graph.online.fleet_rows import (
    NodePoses,
    NodeTips,
    PlanarOdometry,
    TargetAntenna,
    nodes_of,
    summed,
)
from ubl_graph.pings import along_distances, travel_time_model
from ubl_graph.pose_builder import LEANING
from ubl_graph.pose_states import ODOMETRY_STATES

#: Names of targets' states begin so.
TARGET = "target "


@dataclass(slots=True, eq=False)
class Factor:
    """A record, or several of a sensor, as rows of the window.

    Attributes
    ----------
    kind : str
        A range's kind, "position", "heading", "depth", "start heading" or "upright".
    line : Line
        Whose it is.
    here, there : list of Node
        The vehicle's, and those of a vehicle at the other end.
    value : tuple
        Of a range: travel time and sigma (s), times of the legs there (s), arms to the transducers
        at all legs (m). Of a fix: arm, place, covariance. Else: value and sigma.
    peer : str
        Name of the other end.
    entry : Entry, optional
        The record.
    fresh : bool
        Whether it has not been judged yet.
    """

    kind: str
    line: Line
    here: list[Node]
    there: list[Node]
    value: tuple[Any, ...]
    peer: str = ""
    entry: Entry | None = None
    fresh: bool = True

    @property
    def nodes(self) -> list[Node]:
        """All nodes that it sees."""
        return self.here + self.there


@dataclass(frozen=True, eq=False)
class Rows:
    """A block, and what its rows are of: factors, or nodes whose steps they are."""

    block: Block
    of: Sequence[Factor] | Sequence[Node]

    @property
    def fresh(self) -> BoolArray:
        """Which rows have not been judged yet, (M,)."""
        return np.array([isinstance(o, Factor) and o.fresh for o in self.of], dtype=np.bool_)


class Blocks:
    """Makes the blocks of a window.

    Parameters
    ----------
    fleet : Fleet
        Beacons, water, options.
    lines : mapping of str to Line
        All vehicles.
    layout : Layout
        Of all their nodes.
    epoch : float
        Time of clocks' offsets and of moving targets' positions, s.
    """

    def __init__(
        self, fleet: Fleet, lines: Mapping[str, Line], layout: Layout, epoch: float
    ) -> None:
        self._fleet, self._lines, self.layout, self._epoch = fleet, lines, layout, epoch
        self._vehicle = {name: i for i, name in enumerate(lines)}
        self._beacons = {b.name: b.position for b in fleet.beacons}

    def rows(self, factors: Sequence[Factor]) -> list[Rows]:
        """All blocks, odometry first."""
        by_kind: dict[str, list[Factor]] = {}
        for factor in factors:
            key = factor.kind
            if key == "position":
                key += str(len(factor.value[1]))
            by_kind.setdefault(key, []).append(factor)
        return [*self._odometry(), *(self._made(k, some) for k, some in by_kind.items())]

    def _odometry(self) -> list[Rows]:
        nodes: list[Node] = []
        owner: list[int] = []
        for i, line in enumerate(self._lines.values()):
            nodes += line.nodes[1:]
            owner += [i] * max(len(line.nodes) - 1, 0)
        if not nodes:
            return []
        steps = [node.step for node in nodes if node.step is not None]
        assert len(steps) == len(nodes)
        numbers = np.array([node.number for node in nodes])
        names = [name for name, _ in ODOMETRY_STATES if self.layout.has(name)]
        owners = np.array(owner)
        extra = np.array([self.layout.shared_columns(name)[owners] for name in names]).T
        units = np.array([self.layout.unit(name) for name in names])
        extra = extra.astype(np.int64).reshape(len(steps), len(names))
        ways, turns = np.array([s.way for s in steps]), np.array([s.turn for s in steps])
        dt, white = np.array([s.dt for s in steps]), np.array([s.white for s in steps])
        ends = [nodes_of(self.layout, numbers + by) for by in (-1, 0)]
        block: Block
        if self.layout.node == "pose2":
            columns = np.concatenate([ends[0].columns, ends[1].columns, extra], axis=1)
            block = PlanarOdometry(columns, ways[:, :2], turns[:, 2], dt, white, names, units)
        else:
            residual = pose_motion.odometry(ways, turns, dt, names)
            block = PoseBlock("odometry", ends, residual, white, np.arange(6), extra, units)
        return [Rows(block, nodes)]

    def _made(self, kind: str, factors: list[Factor]) -> Rows:
        if kind in PINGS:
            return Rows(self._ranges(kind, factors), factors)
        makers: dict[str, Callable[[list[Factor], NodePoses], Block]] = {
            "position2": self._fixes,
            "position3": self._fixes,
            "heading": self._headings,
            "start heading": self._headings,
            "depth": self._depths,
            "upright": self._upright,
        }
        numbers = np.array([f.here[0].number for f in factors])
        return Rows(makers[kind](factors, NodePoses(self.layout, numbers)), factors)

    def _fixes(self, factors: list[Factor], poses: NodePoses) -> Block:
        arms, places, covariances = (
            np.array(c) for c in zip(*(f.value for f in factors), strict=True)
        )
        tips = NodeTips(poses, arms)
        return TipBlock("position", tips, np.arange(places.shape[1]), places, covariances)

    def _headings(self, factors: list[Factor], poses: NodePoses) -> Block:
        measured, sigma = np.array([f.value[:2] for f in factors]).T
        bias: Interpolation | None = None
        if factors[0].kind == "heading" and self.layout.has("heading_bias"):
            owner = [self._vehicle[f.line.member.name] for f in factors]
            columns = self.layout.shared_columns("heading_bias")[owner][:, None]
            bias = summed(columns, np.full(columns.shape, self.layout.unit("heading_bias")))
        return CompassBlock(poses, measured, sigma, bias)

    def _depths(self, factors: list[Factor], poses: NodePoses) -> Block:
        depth, sigma = np.array([f.value for f in factors]).T
        arms = np.array([f.line.depth_arm for f in factors])
        variance = sigma[:, None, None] ** 2
        return TipBlock("depth", NodeTips(poses, arms), np.array([2]), -depth[:, None], variance)

    def _upright(self, factors: list[Factor], poses: NodePoses) -> Block:
        white = np.broadcast_to(np.eye(3) / LEANING, (len(factors), 3, 3))
        return PoseBlock("upright", poses.nodes, pose_motion.upright(), white, np.arange(3))

    def _ranges(self, kind: str, factors: list[Factor]) -> Block:
        layout, m = self.layout, len(factors)
        legs = len(factors[0].here)
        measured, sigma = np.array([f.value[:2] for f in factors]).T
        sound = clock = None
        if layout.has("sound_speed"):
            columns = np.tile(layout.shared_columns("sound_speed"), (m * legs, 1))
            sound = summed(columns, np.full((m * legs, 1), layout.unit("sound_speed")))
        if kind == "one_way_range":
            clock = self._clocks(factors)
        return RangeBlock(
            kind,
            "",
            along_distances if kind == "slant_range" else travel_time_model(self._fleet.setup),
            self._antenna([f.here for f in factors], [f.value[3][:legs] for f in factors]),
            self._others(factors, legs),
            measured,
            sigma,
            sound,
            clock,
        )

    def _antenna(
        self, nodes: Sequence[Sequence[Node]], arms: Sequence[Sequence[FloatArray]]
    ) -> PoseAntenna:
        """Transducers of vehicles at the legs' nodes."""
        numbers = np.array([[node.number for node in each] for each in nodes]).ravel()
        poses = NodePoses(self.layout, numbers)
        return PoseAntenna(NodeTips(poses, np.array(arms).reshape(-1, 3)), len(nodes[0]))

    def _others(self, factors: list[Factor], legs: int) -> Antenna:
        """What is at the other ends."""
        ends: list[End] = []
        groups: dict[str, list[int]] = {}
        for i, factor in enumerate(factors):
            groups.setdefault(self._sort_of(factor.peer), []).append(i)
        for sort, rows in groups.items():
            some = [factors[i] for i in rows]
            antenna: Antenna
            if sort == "beacon":
                places = np.array([self._beacons[f.peer] for f in some])
                antenna = FixedAntenna(places, legs)
            elif sort == "vehicle":
                arms = [f.value[3][legs:] for f in some]
                antenna = self._antenna([f.there for f in some], arms)
            else:
                columns = np.stack([self.layout.shared_columns(TARGET + f.peer) for f in some])
                later = np.array([f.value[2] for f in some]) - self._epoch
                antenna = TargetAntenna(columns, later)
            ends.append(End(np.array(rows), antenna))
        if len(ends) == 1:
            return ends[0].antenna
        return JoinedAntenna(ends, len(factors), legs)

    def _sort_of(self, peer: str) -> str:
        if peer in self._beacons:
            return "beacon"
        if peer in self._lines:
            return "vehicle"
        return "moving" if len(self.layout.shared_columns(TARGET + peer)) == 6 else "resting"

    def _clocks(self, factors: list[Factor]) -> Interpolation:
        """Offset of the hearing clock less that of the sending one, at the times they read."""
        offset, drift = (self.layout.shared_columns(f"clock_{n}") for n in ("offset", "drift"))
        units = [self.layout.unit(f"clock_{n}") for n in ("offset", "drift")]
        columns = np.full((len(factors), 4), -1, dtype=np.int64)
        weights = np.zeros((len(factors), 4))
        for row, factor in enumerate(factors):
            ends = [(factor.line.member.name, factor.here[0].t, 1.0)]
            if factor.there:
                ends.append((factor.peer, factor.there[0].t, -1.0))
            for k, (name, t, sign) in enumerate(ends):
                i = self._vehicle[name]
                columns[row, 2 * k : 2 * k + 2] = offset[i], drift[i]
                weights[row, 2 * k] = sign * units[0]
                weights[row, 2 * k + 1] = sign * units[1] * (t - self._epoch)
        return summed(columns, weights)
