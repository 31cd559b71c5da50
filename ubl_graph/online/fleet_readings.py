"""Fixes, compass and depth of online vehicles: which node each stands at.

Fixes and readings may come many times a second; nodes are as many as ranges ask for, and some.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections.abc import Sequence

import numpy as np

from ubl_graph import lie
from ubl_graph.arrays import FloatArray
from ubl_graph.builder import heading_sigma
from ubl_graph.cooperative.fleet import Fleet
from ubl_graph.odometry_chain import INSTANT
from ubl_graph.online.buffer import Entry
from ubl_graph.online.fleet_blocks import Factor
from ubl_graph.online.fleet_line import Line, Node, turns_and_ways
from ubl_graph.online.fleet_window import Window
from ubl_graph.online.gate import Gate, limit
from ubl_graph.pose_states import COMPASS_SIGMA

#: Nodes of a vehicle are no farther apart than this share of the lag, nor than this, s.
KEEP_SHARE, KEEP = 0.2, 60.0
#: The same where readings of a compass wait for a node.
READ_SHARE, READ = 1.0 / 15.0, 20.0
#: Nodes that only fixes need are no nearer to each other than the least of these.
FIX_SHARE, FIX = 1.0 / 60.0, 5.0
#: A leg of a ping needs no node of its own where odometry adds no more than this share of the
#: ping's variance.
LEG_SHARE = 0.01
#: A depth is known at a node where a reading is so near, s.
DEPTH_NEAR = 10.0
#: Nothing goes up or down faster than this, m/s.
VERTICAL_SPEED = 10.0
#: Depths that contradict the ones before are believed once so many in a row agree.
PERSISTS = 3


class Readings:
    """Makes rows of what single vehicles measured.

    Parameters
    ----------
    fleet : Fleet
        The configuration.
    lag : float
        s.
    """

    def __init__(self, fleet: Fleet, lag: float) -> None:
        self.fleet, self.lag = fleet, lag
        self.lines = {m.name: Line(m, fleet.options_of(m)) for m in fleet.vehicles}
        self.window = Window(fleet, self.lines)
        self._readings: dict[str, list[tuple[float, float, float, Entry]]] = {
            name: [] for name in self.lines
        }
        self._heads: dict[str, dict[Node, tuple[Factor, list[tuple[float, float, float]]]]] = {
            name: {} for name in self.lines
        }
        self._doubted: dict[str, list[Entry]] = {name: [] for name in self.lines}
        self._deep: dict[str, set[Node]] = {name: set() for name in self.lines}
        self._upright: dict[str, set[Node]] = {name: set() for name in self.lines}

    def take_heading(self, name: str, entry: Entry) -> None:
        """Keep a reading of the compass until there is a node after it."""
        self._readings[name].append((entry.t, entry.values[1], entry.values[2], entry))

    def forget_readings(self, name: str) -> None:
        """Forget what a vehicle's nodes were made of."""
        self._readings[name].clear()
        self._heads[name].clear()
        self._deep[name].clear()
        self._upright[name].clear()

    def take_readings(self) -> None:
        """Make rows of compass and depth, and nodes where only odometry comes."""
        for name, line in self.lines.items():
            if line.located:
                self._keep_alive(line)
                self._take_headings(name, line)
                self._take_depths(name, line)
                self._hold_upright(name, line)

    def take_fix(self, line: Line, entry: Entry) -> None:
        """A fix stands at a node of its own time, or by odometry at one that is near."""
        t, place, covariance = entry.values[0], entry.values[1][0], entry.values[2][0]
        if line.planar:
            place, covariance = place[:2], covariance[:2, :2]
        arm = line.member.vehicle.antenna.body
        apart = min(FIX_SHARE * self.lag, FIX)
        node = line.node_near(t)
        if node is None and t > line.nodes[-1].t:
            self._thin(line, apart)
        elif node is None:
            before = line.before(t)
            after = line.nodes[line.nodes.index(before) + 1]
            node = before if t - before.t < after.t - t else after
            if abs(node.t - t) < apart:
                arm, covariance = self._carried(line, node, t, arm, covariance)
            else:
                node = None
        node = line.node_at(t) if node is None else node
        self.window.add(Factor("position", line, [node], [], (arm, place, covariance), entry=entry))

    def _thin(self, line: Line, apart: float) -> None:
        """Let the last node's fixes stand at the one before, where nothing else needs it."""
        if len(line.nodes) < 2:
            return
        last, before = line.nodes[-1], line.nodes[-2]
        own = [f for f in self.window.factors if last in f.nodes]
        kinds = {"position", "upright"}
        alone = all(f.kind in kinds for f in own) and last.held == len(own)
        near = last.t - before.t < apart
        if not (alone and near) or last in self.window.prior.nodes:
            return
        for factor in own:
            if factor.kind == "upright":
                self.window.remove(factor)
                continue
            arm, place, covariance = factor.value
            arm, covariance = self._carried(line, before, last.t, arm, covariance)
            factor.here = [before]
            factor.value = (arm, place, covariance)
            before.held += 1
        line.drop(last)

    def legs_at(
        self, line: Line, times: Sequence[float], sigma: float
    ) -> tuple[list[Node], list[FloatArray], float]:
        """Nodes at which a vehicle's transducer is at the legs of a ping.

        Parameters
        ----------
        line : Line
            The vehicle.
        times : sequence of float
            Of the legs, s, in order.
        sigma : float
            Standard deviation of the distance, m.

        Returns
        -------
        list of Node
            One node stands for all legs between which odometry is so good that its noise is none
            beside the ping's; else each leg has its own.
        list of array, shape (3,)
            Arms from each node to the transducer at the leg's time, m.
        float
            Variance of these, m^2.
        """
        last = line.node_at(times[-1])
        nodes, arms, noise = [last], [line.transducer], 0.0
        for t in reversed(times[:-1]):
            if abs(last.t - t) < INSTANT:
                node, arm, own = last, line.transducer, 0.0
            else:
                arm, covariance = self._carried(line, last, t, line.transducer, np.zeros((1, 1)))
                node, own = last, float(covariance[0, 0])
                if own > LEG_SHARE * sigma**2:
                    node, arm, own = line.node_at(t), line.transducer, 0.0
            nodes.insert(0, node)
            arms.insert(0, arm)
            noise += own
        return nodes, arms, noise

    def _carried(
        self, line: Line, node: Node, t: float, arm: FloatArray, covariance: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Arm and noise of what is there at a time, seen from a node near to it, by odometry."""
        step = line.between(sorted((node.t, t)))
        vectors, ways = turns_and_ways(step)
        turn, way = lie.rotation(vectors)[0], ways[0]
        away = way + turn @ arm if t > node.t else turn.T @ (arm - way)
        # The noise's direction is not that of the world's axes: its largest stands for all.
        noise = float(np.linalg.eigvalsh(step.covariance[0, :2, :2])[-1])
        return away, covariance + noise * np.eye(len(covariance))

    def _keep_alive(self, line: Line) -> None:
        """A vehicle of which only odometry comes has a node now and then."""
        end, apart = line.end, min(KEEP_SHARE * self.lag, KEEP)
        if self._readings[line.member.name]:
            apart = min(READ_SHARE * self.lag, READ)
        if end is not None and end - line.nodes[-1].t > apart:
            line.node_at(end).held += 1

    def _take_headings(self, name: str, line: Line) -> None:
        """Headings between two nodes become one reading at the later one, turned by odometry."""
        last = line.nodes[-1].t + INSTANT
        due = [r for r in self._readings[name] if r[0] <= last]
        if not due:
            return
        self._readings[name] = [r for r in self._readings[name] if r[0] > last]
        if "heading_bias" not in self.window.shared:
            self._share_heading_bias()
        heads = self._heads[name]
        by_node: dict[Node, list[tuple[float, float, float]]] = {}
        times = [node.t for node in line.nodes]
        entries: dict[Node, Entry] = {}
        for t, heading, sigma, entry in due:
            node = line.nodes[bisect_left(times, t - INSTANT)]
            by_node.setdefault(node, []).append((t, heading, sigma))
            entries[node] = entry
        for node, some in by_node.items():
            fresh = True
            if node in heads:
                old, before = heads[node]
                some = before + some
                fresh = False
                if old in self.window.factors:
                    self.window.remove(old)
            value = _fused(line, node, some)
            factor = Factor("heading", line, [node], [], value, "", entries[node], fresh)
            self.window.add(factor)
            heads[node] = (factor, some)
        here = set(line.nodes)
        self._heads[name] = {n: h for n, h in heads.items() if n in here}

    def _share_heading_bias(self) -> None:
        sigma = np.array(
            [heading_sigma(line.options, COMPASS_SIGMA) for line in self.lines.values()]
        )
        if (sigma > 0.0).any():
            self.window.share("heading_bias", np.zeros(len(sigma)), sigma)

    def _hold_upright(self, name: str, line: Line) -> None:
        """A vehicle in space of which planar odometry alone comes swims upright at every node."""
        if not line.leans:
            return
        held = self._upright[name]
        for node in line.nodes[1:]:
            if node not in held:
                self.window.add(Factor("upright", line, [node], [], (), fresh=False))
        self._upright[name] = set(line.nodes)

    def _take_depths(self, name: str, line: Line) -> None:
        """Depths of a vehicle in space, at its nodes."""
        if line.planar or not line.ups or line.depth_sigma is None:
            return
        deep, told = self._deep[name], np.array(line.ups)
        for node in line.nodes:
            if node in deep or np.abs(told[:, 0] - node.t).min() > DEPTH_NEAR:
                continue
            if node.t > told[-1, 0] + INSTANT:
                continue
            deep.add(node)
            depth = -float(np.interp(node.t, told[:, 0], told[:, 1]))
            self.window.add(Factor("depth", line, [node], [], (depth, line.depth_sigma)))
        self._deep[name] = deep.intersection(line.nodes)

    def take_depth(self, line: Line, gate: Gate, entry: Entry) -> str:
        """Note a depth; why it is refused, empty where it is not.

        One that its neighbours in time contradict waits until others after it agree.
        """
        if line.depth_sigma is None:
            # A depth overrules the heights of fixes.
            line.ups.clear()
        t, depth, sigma = entry.values
        doubted = self._doubted[line.member.name]
        why = _misfit(line.ups, t, -depth, sigma)
        if not why:
            doubted.clear()
            gate.accept(entry)
            line.depth_sigma = sigma
            insort(line.ups, (t, -depth))
            return ""
        entry.gated, entry.reason = True, why
        gate.refuse(entry)
        agreeing = [e for e in doubted if not _misfit([(e.t, -e.values[1])], t, -depth, sigma)]
        doubted[:] = [*agreeing, entry]
        if len(doubted) < PERSISTS:
            return why
        if len(line.ups) < PERSISTS:
            # Fewer said otherwise.
            line.ups.clear()
        for one in doubted:
            one.gated, one.reason = False, ""
            gate.change_mind(one)
            insort(line.ups, (one.t, -one.values[1]))
        line.depth_sigma = sigma
        gate.run.clear()
        doubted.clear()
        return ""


def _misfit(ups: Sequence[tuple[float, float]], t: float, up: float, sigma: float) -> str:
    """Why a height (m) cannot be, by its neighbours in time; empty where it can."""
    at = bisect_left(ups, (t, up))
    for there, other in ups[max(at - 1, 0) : at + 1]:
        apart, dt = abs(up - other), abs(t - there)
        if apart > VERTICAL_SPEED * dt + limit(1) * np.sqrt(2.0) * sigma:
            return f"{apart:.0f} m from the depth {dt:.1f} s before or after it"
    return ""


def _fused(
    line: Line, node: Node, readings: Sequence[tuple[float, float, float]]
) -> tuple[float, float]:
    """Heading at a node, and sigma, of readings before it: rad, clockwise from north."""
    ordered = sorted(readings)
    kept = [r for i, r in enumerate(ordered) if i == 0 or r[0] - ordered[i - 1][0] > 4.0 * INSTANT]
    t, heading, sigma = np.array(kept).T
    turned, drift = np.zeros(len(t)), np.zeros(len(t))
    times = [*t.tolist()]
    if node.t - times[-1] > 4.0 * INSTANT:
        times.append(node.t)
    if len(times) > 1:
        step = line.between(times)
        yaw, own = turns_and_ways(step)[0][:, 2], step.covariance
        count = len(times) - 1
        turned[:count] = np.cumsum(yaw[::-1])[::-1][: len(t)]
        drift[:count] = np.cumsum(own[::-1, -1, -1])[::-1][: len(t)]
    weight = 1.0 / (sigma**2 + drift)
    weight /= weight.sum()
    at_node = heading - turned
    off = np.remainder(at_node - at_node[-1] + np.pi, 2.0 * np.pi) - np.pi
    variance = float(1.0 / (1.0 / sigma**2).sum() + weight @ drift)
    return float(at_node[-1] + weight @ off), float(np.sqrt(variance))
