"""The search for vehicles and targets that have no place yet."""

from __future__ import annotations

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.cooperative.fleet import Target
from ubl_graph.errors import SolverError
from ubl_graph.online.buffer import PINGS, Entry
from ubl_graph.online.fleet_blocks import TARGET
from ubl_graph.online.fleet_core import Core
from ubl_graph.online.fleet_finder import (
    MOST_RECORDS,
    Found,
    Reading,
    Seen,
    distance_of,
    find_target,
    find_vehicle,
    known_of,
    legs_of,
    target_residuals,
)
from ubl_graph.online.fleet_line import Line
from ubl_graph.online.fleet_outputs import TargetFix
from ubl_graph.online.fleet_place import DELTA

#: Past ranges to a target without a place that are remembered.
MOST_REMEMBERED = 200


class Finding:
    """Looks for what has no place.

    Parameters
    ----------
    core : Core
        Whose records wait.

    Attributes
    ----------
    lost, ambiguous : dict of str to str
        By name, why there is no place any more, and why it is not unique.
    """

    def __init__(self, core: Core) -> None:
        self._core = core
        self.lost: dict[str, str] = {}
        self.ambiguous: dict[str, str] = {}
        self._found: dict[str, Found] = {}
        self._looked: dict[str, int] = {}
        self._remembered: dict[str, list[tuple[Entry, Seen]]] = {
            name: [] for name in core.fleet.target_names
        }
        core.past = self._remember

    def search(self) -> bool:
        """Look for all that has new records waiting; whether something was found."""
        core = self._core
        found = False
        for name, line in core.lines.items():
            if not line.located and self._is_new(name):
                found |= self._vehicle(name, line)
        for target in core.fleet.targets:
            if not core.has_place(target.name) and self._is_new(target.name):
                found |= self._target(target)
        return found

    def _is_new(self, name: str) -> bool:
        """Whether other records wait for something than when it was looked for last."""
        mine = [id(e) for n, e in self._core.waiting if name in (n, e.values[0])]
        mine += [id(e) for e, _ in self._remembered.get(name, [])]
        if not mine and name in self._remembered:
            return False
        state = hash(tuple(mine))
        new = self._looked.get(name) != state
        self._looked[name] = state
        return new

    def _vehicle(self, name: str, line: Line) -> bool:
        core = self._core
        fixes: list[Reading] = []
        heads: list[Reading] = []
        for owner, e in core.waiting:
            if owner == name and e.kind == "position":
                place, covariance = e.values[1][0, :2], e.values[2][0, :2, :2]
                fixes.append(Reading(e.t, place, float(np.sqrt(np.trace(covariance) / 2.0))))
            elif owner == name and e.kind == "heading":
                heads.append(Reading(e.t, np.array([e.values[1]]), e.values[2]))
        start = line.member.segment.start
        if start is not None and (name in self.lost or start.t < core.horizon):
            # It has been elsewhere since.
            start = None
        found = find_vehicle(line, start, self._seen_by(name), fixes, heads)
        self._tell(name, found)
        if found.status != "ok" or found.place is None:
            return False
        east, north, yaw = found.place.value
        x = np.array([east, north, yaw])
        if not line.planar:
            x = np.array([east, north, line.up_at(np.array([found.t]))[0], 0.0, 0.0, yaw])
        node = core.window.locate(line, found.t, x)
        core.settle(line, node)
        if start is not None:
            core.anchor(line, start)
        return True

    def _seen_by(self, name: str) -> list[Seen]:
        """Ranges between a vehicle without a place and what has one."""
        core = self._core
        out: list[Seen] = []
        for owner, e in core.waiting:
            if e.kind not in PINGS or name not in (owner, e.values[0]):
                continue
            other = e.values[0] if owner == name else owner
            _, _, here, there = legs_of(e)
            mine, theirs = (here, there) if owner == name else (there, here)
            place = self._place(other, float(np.mean(theirs)))
            if place is None:
                continue
            distance, sigma = distance_of(core.fleet, e, self._clocks(owner, e))
            out.append(Seen(float(np.mean(mine)), *place, distance, sigma))
        return out[-MOST_RECORDS:]

    def _place(self, name: str, t: float) -> tuple[FloatArray, float] | None:
        """Where a beacon, vehicle or target is at a time, and its variance; None where unknown."""
        core = self._core
        for beacon in core.fleet.beacons:
            if beacon.name == name:
                return beacon.position, 0.0
        if name in core.lines:
            line = core.lines[name]
            if not line.located or t < line.nodes[0].t:
                return None
            try:
                moment = core.window.moment(name, t)
            except SolverError:
                return None
            arm = moment.rotation @ line.member.vehicle.transducer.body
            variance = float(np.linalg.eigvalsh(moment.covariance[:3, :3])[-1])
            return moment.position + arm, variance
        fix = self.target(name, t)
        if fix.status != "ok" or fix.position is None or fix.covariance is None:
            return None
        return fix.position, float(np.linalg.eigvalsh(fix.covariance)[-1])

    def _clocks(self, name: str, entry: Entry) -> tuple[float, float]:
        """What a one-way range's clocks add to it, as far as is known: mean and sigma, s."""
        if entry.kind != "one_way_range":
            return 0.0, 0.0
        core, names = self._core, list(self._core.lines)
        own = [n for n in (name, entry.values[0]) if n in core.lines]
        solution = core.window.solution
        if solution is None or not solution.layout.has("clock_offset"):
            sigmas = [core.lines[n].options.clock_offset_sigma for n in own]
            return 0.0, float(np.linalg.norm(sigmas))
        layout = solution.layout
        columns: list[int] = []
        weights: list[float] = []
        for sign, n, t in zip((1.0, -1.0), own, (entry.values[2], entry.values[1]), strict=False):
            for state, by in (("clock_offset", 1.0), ("clock_drift", t - solution.epoch)):
                columns.append(int(layout.shared_columns(state)[names.index(n)]))
                weights.append(sign * by * layout.unit(state))
        where, weight = np.array(columns), np.array(weights)
        variance = float(weight @ solution.covariance(where) @ weight)
        return float(weight @ solution.x[where]), float(np.sqrt(max(variance, 0.0)))

    # -- targets --

    def _remember(self, name: str, entry: Entry) -> None:
        """Keep what a range to a target without a place says that leaves the window."""
        peer = entry.values[0]
        if entry.kind not in PINGS or peer not in self._remembered:
            return
        seen = self._target_range(name, entry)
        if seen is not None:
            self._remembered[peer].append((entry, seen))
            del self._remembered[peer][:-MOST_REMEMBERED]

    def _target_range(self, name: str, entry: Entry) -> Seen | None:
        _, _, here, there = legs_of(entry)
        place = self._place(name, float(np.mean(here)))
        if place is None:
            return None
        distance, sigma = distance_of(self._core.fleet, entry, self._clocks(name, entry))
        return Seen(float(np.mean(there)), *place, distance, sigma)

    def _target(self, target: Target) -> bool:
        core = self._core
        epoch = core.window.epoch
        waiting = [
            self._target_range(n, e)
            for n, e in core.waiting
            if e.kind in PINGS and e.values[0] == target.name
        ]
        now = [seen for seen in waiting if seen is not None]
        past = [seen for _, seen in self._remembered[target.name]]
        found = find_target(target, past + now, epoch)
        self._tell(target.name, found)
        if found.status != "ok" or found.place is None:
            return False
        name = TARGET + target.name
        mean, sigma, phi = known_of(target, epoch)
        core.window.share(name, mean, sigma)
        keys = [(name, i) for i in range(len(mean))]
        core.window.prior.evolve(keys, phi)
        if past:
            # What is past comes in as a prior; what waits becomes rows of the window.
            x = found.place.value
            residuals = target_residuals(target, past, epoch)
            at = residuals(x[None])[0, : len(past)]
            trials = x + DELTA * np.eye(len(x))
            slope = (residuals(trials)[:, : len(past)] - at).T / DELTA
            core.window.prior.learn(keys, slope, slope @ x - at)
        core.window.shared[name] = found.place.value.copy()
        self._remembered[target.name].clear()
        return True

    def _tell(self, name: str, found: Found) -> None:
        self._found[name] = found
        self.ambiguous.pop(name, None)
        if found.status == "ambiguous":
            self.ambiguous[name] = found.reason
        if found.status == "ok":
            self.lost.pop(name, None)

    def target(self, name: str, t: float) -> TargetFix:
        """Where a target is at a time (s)."""
        core, state = self._core, TARGET + name
        solution = core.window.solution
        if state in core.window.shared and solution is not None and solution.layout.has(state):
            columns = solution.layout.shared_columns(state)
            x, covariance = solution.x[columns], solution.covariance(columns)
            later = t - solution.epoch
            velocity, own = np.zeros(3), np.zeros((3, 3))
            position, spread = x[:3].copy(), covariance[:3, :3]
            if len(x) == 6:
                velocity, own = x[3:], covariance[3:, 3:]
                position = position + later * velocity
                cross = later * (covariance[:3, 3:] + covariance[3:, :3])
                spread = spread + cross + later**2 * own
            return TargetFix(name, t, position, spread, velocity, own, "ok")
        found = self._found.get(name)
        if found is None or found.place is None:
            reason = "waiting for ranges" if found is None else found.reason
            lost = self.lost.get(name, "")
            return TargetFix(
                name, t, None, None, None, None, "lost" if lost else "initialising", lost or reason
            )
        value, covariance = found.place.value, found.place.covariance
        size = len(value)
        rival = None if found.place.rival is None else found.place.rival[:3]
        return TargetFix(
            name,
            t,
            value[:3],
            covariance[:3, :3],
            value[3:] if size == 6 else np.zeros(3),
            covariance[3:, 3:] if size == 6 else np.zeros((3, 3)),
            "ambiguous" if found.status == "ambiguous" else "initialising",
            found.reason or "its ranges are not in the window yet",
            rival,
        )
