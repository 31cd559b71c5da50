"""The core of an online fleet: from records to rows of the window, judged, solved, moved on."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.builder import heading_walk
from ubl_graph.cooperative.fleet import Fleet
from ubl_graph.mission import Start
from ubl_graph.nodes import NOMINAL_SPEED
from ubl_graph.odometry_chain import INSTANT
from ubl_graph.online.buffer import ABSOLUTE, KINDS, PINGS, Entry
from ubl_graph.online.fleet_blocks import TARGET, Factor
from ubl_graph.online.fleet_finder import legs_of
from ubl_graph.online.fleet_gate import Verdict
from ubl_graph.online.fleet_line import Line, Node, moved
from ubl_graph.online.fleet_outputs import SmoothedPose
from ubl_graph.online.fleet_readings import Readings
from ubl_graph.online.fleet_window import Window
from ubl_graph.online.gate import Gate
from ubl_graph.online.outputs import Event
from ubl_graph.pose_states import odometry_sigmas

#: States that wander are moved on so often in a lag.
EPOCHS = 10
#: Smoothed poses that wait to be fetched, of each vehicle.
MOST_SMOOTHED = 100_000


class Core(Readings):
    """Takes records in.

    Parameters
    ----------
    fleet : Fleet
        The configuration.
    lag : float
        s.
    """

    def __init__(self, fleet: Fleet, lag: float) -> None:
        super().__init__(fleet, lag)
        self.now: float | None = None
        self.gates = {
            name: {kind: Gate() for kind in KINDS}
            for name in (*fleet.vehicle_names, *fleet.target_names)
        }
        self.queue: list[tuple[str, Entry]] = []
        self.waiting: list[tuple[str, Entry]] = []
        self.keys: dict[tuple[Any, ...], Entry] = {}
        self.refused: deque[tuple[str, Entry]] = deque()
        self.smoothed: dict[str, deque[SmoothedPose]] = {
            name: deque(maxlen=MOST_SMOOTHED) for name in self.lines
        }
        self.events: list[Event] = []
        #: What is told of a record that waited until it was too old.
        self.past: Callable[[str, Entry], None] = lambda _name, _entry: None
        self._begin()

    @property
    def horizon(self) -> float:
        """What is older is past, s."""
        return -np.inf if self.now is None else self.now - self.lag

    def _begin(self) -> None:
        """States that all nodes share, and vehicles that know where they start."""
        self._share_known()
        for line in self.lines.values():
            start = line.member.segment.start
            if start is not None and start.heading is not None:
                self._start(line, start)

    def _share_known(self) -> None:
        options = [line.options for line in self.lines.values()]
        if self.fleet.options.estimate_sound_speed:
            sigma = self.fleet.setup.sound_speed_sigma
            if sigma > 0.0:
                self.window.share("sound_speed", np.zeros(1), np.full(1, sigma))
        sigmas = [odometry_sigmas(o) for o in options]
        for name in sigmas[0]:
            own = np.array([s[name] for s in sigmas])
            if (own > 0.0).any():
                self.window.share(name, np.zeros(len(own)), own)

    def _start(self, line: Line, start: Start) -> None:
        """Put a vehicle where it says that it starts."""
        assert start.heading is not None
        yaw = 0.5 * np.pi - start.heading
        place = [start.east, start.north]
        if line.planar:
            x = np.array([*place, yaw])
        else:
            x = np.array([*place, start.up or 0.0, 0.0, 0.0, yaw])
            place += [] if start.up is None else [start.up]
        node = self.window.locate(line, start.t, x)
        covariance = start.sigma**2 * np.eye(len(place))
        value = (np.zeros(3), np.array(place), covariance)
        self.window.add(Factor("position", line, [node], [], value, fresh=False))
        heading = (start.heading, start.heading_sigma)
        self.window.add(Factor("start heading", line, [node], [], heading, fresh=False))
        self.settle(line, node)

    def anchor(self, line: Line, start: Start) -> None:
        """Hold a vehicle that has been placed by what its start says of the position."""
        place = np.array([start.east, start.north])
        value = (np.zeros(3), place, start.sigma**2 * np.eye(2))
        node = line.node_at(start.t)
        self.window.add(Factor("position", line, [node], [], value, fresh=False))

    def settle(self, line: Line, node: Node) -> None:
        """Vehicles in space swim upright; the first node has nothing else to say so."""
        if not line.planar:
            self.window.add(Factor("upright", line, [node], [], (), fresh=False))

    # -- records into rows --

    def activate(self) -> None:
        """Make rows of what has come and of what waited, where both ends have a place."""
        todo = deque(sorted(self.waiting + self.queue, key=lambda one: one[1].t))
        kept: list[tuple[str, Entry]] = []
        self.queue = []
        try:
            while todo:
                name, entry = todo.popleft()
                if entry.begin < self.horizon - INSTANT:
                    self.too_late(name, entry)
                elif not self._take(name, entry):
                    kept.append((name, entry))
        finally:
            # Whatever goes wrong with one record, the others are not lost.
            self.waiting = kept + list(todo)
        self.take_readings()

    def too_late(self, name: str, entry: Entry) -> None:
        """Note a record that waited until it was too old."""
        self.gates[name][entry.kind].rejected["late"] += 1
        self.past(name, entry)

    def _take(self, name: str, entry: Entry) -> bool:
        line = self.lines[name]
        if entry.kind in PINGS:
            return self._take_range(line, entry)
        if not line.located:
            return False
        if entry.t < line.nodes[0].t - INSTANT:
            self.too_late(name, entry)
        elif entry.kind == "position":
            self.take_fix(line, entry)
        else:
            self.take_heading(name, entry)
        return True

    def has_place(self, name: str) -> bool:
        """Whether a beacon, vehicle or target has a place."""
        if name in self.lines:
            return self.lines[name].located
        return name in self.fleet.beacon_names or TARGET + name in self.window.shared

    def _take_range(self, line: Line, entry: Entry) -> bool:
        peer = entry.values[0]
        if not (line.located and self.has_place(peer)):
            return False
        measured, sigma, here, there = legs_of(entry)
        other = self.lines.get(peer)
        for one, times in ((line, here), (other, there)):
            if one is not None and min(times) < one.nodes[0].t - INSTANT:
                self.too_late(line.member.name, entry)
                return True
        if entry.kind == "one_way_range" and "clock_offset" not in self.window.shared:
            self._share_clocks()
        distance = sigma * NOMINAL_SPEED / len(here)
        here_nodes, arms, noise = self.legs_at(line, here, distance)
        there_nodes: list[Node] = []
        if other is not None:
            there_nodes, more, noise_there = self.legs_at(other, there, distance)
            arms, noise = arms + more, noise + noise_there
        value = (measured, float(np.hypot(sigma, np.sqrt(noise) / NOMINAL_SPEED)), there, arms)
        self.window.add(Factor(entry.kind, line, here_nodes, there_nodes, value, peer, entry))
        return True

    def _share_clocks(self) -> None:
        for name in ("clock_offset", "clock_drift"):
            sigma = np.array([getattr(li.options, name + "_sigma") for li in self.lines.values()])
            self.window.share(name, np.zeros(len(sigma)), sigma)

    # -- judging and moving on --

    def note(self, verdicts: Sequence[Verdict]) -> None:
        """Count what passed and what did not."""
        for verdict in verdicts:
            factor, entry = verdict.factor, verdict.factor.entry
            if entry is None:
                continue
            name = factor.line.member.name
            owners = [name]
            if factor.peer in self.fleet.target_names:
                # A wrong place of the target is not the vehicle's fault.
                owners = [factor.peer] if not verdict.accepted else [name, factor.peer]
            elif factor.peer in self.lines:
                owners.append(factor.peer)
            if verdict.accepted:
                surprise = verdict.distance**2 / verdict.components
                for owner in owners:
                    self.gates[owner][entry.kind].accept(entry, surprise)
                continue
            entry.gated = True
            entry.reason = f"{verdict.distance:.1f} standard deviations from what is expected"
            self.refused.append((name, entry))
            self.events.append(Event("rejected", entry.reason, entry.record, False))
            for owner in owners:
                self.gates[owner][entry.kind].refuse(entry)

    def doubtful(self) -> list[str]:
        """Vehicles and targets of which so many records were refused that they are in doubt."""
        return [
            name
            for name, gates in self.gates.items()
            if self.has_place(name) and any(gates[kind].is_doubtful for kind in ABSOLUTE)
        ]

    def give_up(self, name: str) -> None:
        """Take a vehicle or target out of the window: it is to be found anew."""
        if name in self.lines:
            line = self.lines[name]
            self.window.marginalise(line.nodes)
            self.forget_readings(name)
        else:
            self.window.marginalise((), [TARGET + name])
        for gate in self.gates[name].values():
            gate.run.clear()
            gate.recent.clear()
            gate.refused.clear()
        again = [(n, e) for n, e in self.refused if name in (n, e.values[0])]
        self.refused = deque((n, e) for n, e in self.refused if name not in (n, e.values[0]))
        for owner, entry in again:
            entry.gated = False
            # Its refusals say nothing of those whom it ranged.
            for other in {owner, entry.values[0]} & self.gates.keys():
                self.gates[other][entry.kind].run.clear()
                self.gates[other][entry.kind].recent.clear()
            self.events.append(
                Event("readmitted", f"'{name}' is looked for anew", entry.record, False)
            )
        self.waiting += again

    # -- beginning anew --

    def rebuild(self) -> None:
        """Put all nodes where odometry leads from their vehicle's first one."""
        for line in self.lines.values():
            for node in line.nodes[1:]:
                node.step = None
            line.refresh()
            for before, node in pairwise(line.nodes):
                assert node.step is not None
                node.x = moved(before.x, node.step.way, node.step.turn)

    def restart(self) -> None:
        """Forget the past but for where each vehicle's first node was known to be."""
        self.window.restart()
        self.rebuild()

    def abandon(self) -> None:
        """Forget all places; the records of the window wait for new ones."""
        held = [(f.line.member.name, f.entry) for f in self.window.factors]
        self.waiting += [(name, entry) for name, entry in held if entry is not None]
        for name, line in self.lines.items():
            line.nodes = []
            self.forget_readings(name)
        past = self.window
        self.window = Window(self.fleet, self.lines)
        self.window.epoch = past.epoch
        self._share_known()

    def slide(self) -> None:
        """Let what is older than the lag leave the solved window."""
        leaving = self.window.leaving(self.horizon)
        if leaving and self.window.can_leave:
            for name, nodes in leaving.items():
                moments = self.window.moments(nodes, self.lines[name])
                self.smoothed[name].extend(SmoothedPose.of(m) for m in moments)
            self.window.marginalise([node for nodes in leaving.values() for node in nodes])
        if self.horizon - self.window.epoch > self.lag / EPOCHS:
            self.window.move_epoch(self.horizon, self._walks())
        # Not before: nodes that are left over may be next to ones that leave.
        self.window.tidy()

    def forget(self) -> None:
        """Drop records that are past."""
        horizon = self.horizon
        for line in self.lines.values():
            line.forget(line.nodes[0].t if line.nodes else horizon)
        self.keys = {key: e for key, e in self.keys.items() if e.t >= horizon}
        while self.refused and self.refused[0][1].begin < horizon:
            self.refused.popleft()

    def _walks(self) -> dict[str, FloatArray]:
        """Random walks of the states that all nodes share, by component."""
        options = [line.options for line in self.lines.values()]
        whole = {
            "sound_speed": [self.fleet.options.number("sound_speed_walk")],
            "heading_bias": [heading_walk(o) for o in options],
            "clock_offset": [o.clock_walk for o in options],
            "clock_drift": [o.clock_drift_walk for o in options],
        }
        return {
            name: np.array(walk)
            for name, walk in whole.items()
            if name in self.window.shared and (any(walk) or name.startswith("clock"))
        }
