"""FleetEstimator: the online estimator of several vehicles, joined by ranges in one window.

Records come in vehicle by vehicle, late and out of order; `update` solves, and out come positions
with covariance and status. Nothing that comes in ends it: bad records are refused with a typed
error or an outcome that says why, a solver that fails is begun anew from what the window holds.
"""

from __future__ import annotations

import math
from numbers import Real
from time import perf_counter
from typing import Any

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.cooperative.fleet import Fleet
from ubl_graph.errors import TimeError
from ubl_graph.online.fleet_core import Core
from ubl_graph.online.fleet_door import Door, unknown
from ubl_graph.online.fleet_finding import Finding
from ubl_graph.online.fleet_moments import PoseMoment
from ubl_graph.online.fleet_outputs import FleetEstimate, SmoothedPose, TargetFix, heading_of
from ubl_graph.online.health import Facts, Latency, judge, sensor_report
from ubl_graph.online.outputs import Event
from ubl_graph.records import MAX_TIME

__all__ = ["FleetEstimate", "FleetEstimator", "SmoothedPose", "TargetFix"]

#: Outputs are so far apart at the least, s.
TICK = 1e-6
#: Nothing is predicted farther ahead of all records than this, s.
FARTHEST = 3600.0
#: A solver fails in many ways, and none may end the estimator.
_FAILURES = (Exception,)


class FleetEstimator(Door):
    """Positions of a fleet's vehicles and targets from records as they come.

    Odometry alone joins a vehicle's nodes. A range or fix makes nodes at its time, and all nodes
    of the last `lag` are solved together, ranges with the options' robust loss; what is older is
    kept as a prior, linearised where it left the window.

    Parameters
    ----------
    fleet : Fleet
        Vehicles with their options, lever arms and starts; beacons, targets and water. It is the
        configuration: its segments hold no records, these come by `add`.
    lag : float, default 300
        Length of the window, s; what comes later than that is refused.

    Raises
    ------
    ConfigurationError
        Where nodes are not poses, or of two kinds; where a segment holds records; where beacons
        are unknowns or options are left to the data. Batch smoothing (`smooth_fleet`) takes
        these.

    Notes
    -----
    What each vehicle has one of, or the fleet (odometry's scale and turning bias, heading bias,
    clock offset and drift, the sound speed, targets), is one state for the whole window, known
    beforehand as the options say and wandering from window to window by their random walks. Ranges
    between all ends share one sound speed. One-way ranges need `clock_offset_sigma`: offsets are
    against the beacons' common clock.

    A gap in the odometry is bridged by the last twist, with the noise of the options' motion prior
    (`acceleration_psd`, `angular_acceleration_psd`).

    A record that is farther ahead of all others than the lag is held back until three agree: one
    wrong stamp does not empty the window. They must be of two vehicles, unless there is but one or
    the others fall silent: a vehicle whose clock is ahead is left out until it is right, and its
    estimate says so. Where the first vehicle heard was ahead, all is begun anew from the others
    once these contradict it. A clock that is set back is not followed: its records are refused as
    late and counted; `reset` begins anew.

    A depth that would need more than 10 m/s up or down is refused until three in a row agree. The
    height of a fix counts for a planar vehicle without depths, once the fix is accepted.

    The equations have a few hundred columns: one thread solves them fastest
    (`OPENBLAS_NUM_THREADS=1`).

    Examples
    --------
    >>> from ubl_graph.cooperative import Fleet, Member
    >>> from ubl_graph import Odometry, Options, Segment, SlantRange, Start
    >>> options = Options(node="pose2")
    >>> here, there = (Start(0.0, east, 0.0, heading=0.0) for east in (0.0, 100.0))
    >>> a = Member("A", Segment(start=here), options=options)
    >>> b = Member("B", Segment(start=there), options=options)
    >>> estimator = FleetEstimator(Fleet((a, b), options=options))
    >>> for name in ("A", "B"):
    ...     _ = estimator.add(name, Odometry(0.0, 1.0, 2.0, 0.0))
    >>> estimator.add("A", SlantRange(1.0, "B", 106.0)).accepted
    True
    >>> estimator.update()
    ()
    >>> estimator.estimate("B").position.round(1).tolist()
    [103.0, 2.0, 0.0]
    """

    def __init__(self, fleet: Fleet, lag: float = 300.0) -> None:
        super().__init__(fleet, lag)
        self._latency = Latency()
        self._resets = 0
        self._last_output: dict[str, float] = {}
        self._begin()

    def _begin(self) -> None:
        self.core = Core(self.fleet, self.lag)
        self.finding = Finding(self.core)
        self._forget_clocks()
        self._notes: dict[str, dict[str, float]] = {name: {} for name in self.core.lines}
        self._rebuilt: set[str] = set()
        self.rebuilds = 0

    def reset(self) -> None:
        """Forget all records; begin anew from the starts. Output stamps go on increasing."""
        self._resets += 1
        self._begin()

    # -- solving --

    def update(self) -> tuple[Event, ...]:
        """Solve with all that has come since the last update.

        Returns
        -------
        tuple of Event
            Records that were refused by what the others expect, or came back.
        """
        begun = perf_counter()
        self.core.events = []
        self._guarded()
        self.core.forget()
        self._latency.note(perf_counter() - begun, math.inf)
        return tuple(self.core.events)

    def _guarded(self) -> None:
        """Solve; where that fails, begin anew from what the window holds."""
        try:
            self._solve()
            return
        except _FAILURES as error:
            text = " ".join(str(error).split())[:120]
        for attempt in (self.core.rebuild, self.core.restart, self._abandon):
            try:
                attempt()
                self._solve()
                break
            except _FAILURES:
                continue
        self.rebuilds += 1
        self._rebuilt = set(self.core.lines)
        until = (self.core.now or 0.0) + self.lag
        for notes in self._notes.values():
            notes[f"a solver failed: {text}"] = until

    def _abandon(self) -> None:
        """Nothing helped: forget all places, and look for them anew."""
        for name, line in self.core.lines.items():
            if line.located:
                self.finding.lost[name] = "the solver failed; looking for the position anew"
        self.core.abandon()

    def _solve(self) -> None:
        core = self.core
        core.activate()
        if self.finding.search():
            core.activate()
        if not core.window.is_changed:
            return
        core.note(core.window.solve())
        doubtful = core.doubtful()
        if doubtful:
            self._give_up(max(doubtful, key=self._sigma))
            return
        core.slide()

    def _give_up(self, name: str) -> None:
        """Look anew for the vehicle or target that is in doubt and known worst."""
        self.core.give_up(name)
        self.finding.lost[name] = "its records contradict its place; looking for it anew"

    def _sigma(self, name: str) -> float:
        """Horizontal standard deviation of a vehicle or target, m."""
        core = self.core
        if name in core.lines:
            moment = core.window.moment(name, core.lines[name].nodes[-1].t)
            return float(np.sqrt(np.linalg.eigvalsh(moment.covariance[:2, :2])[-1]))
        fix = self.finding.target(name, core.now or 0.0)
        return math.inf if fix.covariance is None else float(np.sqrt(fix.covariance[0, 0]))

    # -- out --

    def estimate(self, vehicle: str, t: float | None = None) -> FleetEstimate:
        """Where a vehicle is at a time, as far as the last update and odometry say.

        Parameters
        ----------
        vehicle : str
            Which one.
        t : float, optional
            Seconds; left out, the end of its newest odometry or node. Stamps increase from output
            to output: a time that is not after the last output's is answered just after that one.
            `smoothed` looks back.

        Raises
        ------
        DataError
            Where there is no such vehicle.
        TimeError
            Where `t` is not finite or more than an hour ahead of all records, or where there is
            neither a record nor `t`.
        """
        self._check_vehicle(vehicle)
        stamp = self._stamp(vehicle, t)
        self._last_output[vehicle] = stamp
        moment = self._moment(vehicle, stamp)
        covariance = None if moment is None else moment.covariance
        core = self.core
        clock = self._clock(vehicle)
        facts = Facts(
            stamp,
            moment is not None,
            vehicle in self._rebuilt,
            self.finding.lost.get(vehicle, clock) if moment is None else "",
            self.finding.ambiguous.get(vehicle, "") if moment is None else "",
            -math.inf,
            {**self._notes[vehicle], **({clock: math.inf} if clock else {})},
            0.0 if moment is None else self._reach(vehicle, moment.position),
            0.0,
        )
        status, reasons = judge(facts, core.gates[vehicle], covariance)
        if moment is None and facts.ambiguous:
            status, reasons = "ambiguous", (facts.ambiguous,)
        elif moment is None and vehicle in self.finding.lost:
            status = "lost"
        self._rebuilt.discard(vehicle)
        if moment is None or covariance is None:
            return FleetEstimate(stamp, None, None, None, None, None, status, reasons)
        heading, sigma = heading_of(moment)
        return FleetEstimate(
            stamp,
            moment.position,
            covariance[:3, :3],
            heading,
            sigma,
            self._velocity(vehicle, moment),
            status,
            reasons,
            moment.rotation,
            covariance,
        )

    def smoothed(self, vehicle: str, t: float) -> SmoothedPose:
        """A vehicle's pose at any time of the window, with all that the last update knew.

        Raises
        ------
        DataError
            Where there is no such vehicle.
        TimeError
            Where the time is outside the window, or the vehicle has no place.
        """
        self._check_vehicle(vehicle)
        line = self.core.lines[vehicle]
        moment = self._moment(vehicle, t) if math.isfinite(_seconds(t)) else None
        if moment is None or t < line.nodes[0].t - 1e-6:
            raise TimeError(f"'{vehicle}' has no place at {t:g} s in the window")
        return SmoothedPose.of(moment)

    def delayed(self, vehicle: str) -> list[SmoothedPose]:
        """Poses of nodes that have left the window since the last call, in order of time.

        Raises
        ------
        DataError
            Where there is no such vehicle.
        """
        self._check_vehicle(vehicle)
        out = list(self.core.smoothed[vehicle])
        self.core.smoothed[vehicle].clear()
        return out

    def target(self, name: str) -> TargetFix:
        """Where a target is.

        Raises
        ------
        DataError
            Where there is no such target.
        """
        if name not in self.fleet.target_names:
            raise unknown("target", name, self.fleet.target_names)
        return self.finding.target(name, self.core.now if self.core.now is not None else 0.0)

    def health(self) -> dict[str, Any]:
        """Counts by vehicle, sensor and reason, window and timing, ready for JSON."""
        core = self.core
        return {
            "t": core.now,
            "vehicles": {
                name: {
                    "located": line.located,
                    "nodes": len(line.nodes),
                    "odometry_records": len(line.pieces),
                    "sensors": sensor_report(core.now, core.gates[name]),
                }
                for name, line in core.lines.items()
            },
            "targets": {name: self.target(name).status for name in self.fleet.target_names},
            "window": {
                "nodes": core.window.node_count,
                "rows": len(core.window.factors),
                "prior_columns": len(core.window.prior.keys),
                "lag_s": self.lag,
            },
            "waiting": len(core.waiting),
            "held": len(self._held),
            "rebuilds": self.rebuilds,
            "resets": self._resets,
            **self._latency.summary(),
        }

    # -- inside --

    def _clock(self, vehicle: str) -> str:
        """What is wrong with a vehicle's clock; empty where nothing is known to be."""
        off = self._ahead.get(vehicle)
        return "" if off is None else f"its clock is {off:.0f} s ahead of the others'"

    def _moment(self, vehicle: str, t: float) -> PoseMoment | None:
        if not self.core.lines[vehicle].located:
            return None
        try:
            moment = self.core.window.moment(vehicle, t)
        except _FAILURES:
            return None
        sound = np.isfinite(moment.position).all() and np.isfinite(moment.covariance).all()
        return moment if sound and (moment.covariance.diagonal() >= 0.0).all() else None

    def _velocity(self, vehicle: str, moment: PoseMoment) -> FloatArray | None:
        pieces = self.core.lines[vehicle].pieces
        if not pieces:
            return None
        piece = pieces[-1]
        return moment.rotation @ piece.way / (piece.t_to - piece.t_from)

    def _reach(self, vehicle: str, position: FloatArray) -> float:
        """Distance to the nearest beacon or other vehicle that has a place, m."""
        places = [b.position for b in self.fleet.beacons]
        for name, line in self.core.lines.items():
            if name != vehicle and line.located:
                x = line.nodes[-1].x
                places.append(np.array([x[0], x[1], position[2]]))
        if not places:
            return 0.0
        return float(np.linalg.norm(np.array(places) - position, axis=1).min())

    def _stamp(self, vehicle: str, t: float | None) -> float:
        now, last = self.core.now, self._last_output.get(vehicle)
        if t is None:
            line = self.core.lines[vehicle]
            known = [line.end, line.nodes[-1].t if line.nodes else None]
            times = [one for one in known if one is not None] or [now]
            if times[0] is None:
                raise TimeError("there is no record yet; give a time, or add records first")
            t = max(one for one in times if one is not None)
        if not math.isfinite(_seconds(t)) or abs(t) > MAX_TIME:
            raise TimeError(f"{t} is no time in seconds")
        if now is not None and t > now + FARTHEST:
            raise TimeError(
                f"{t:g} s is {t - now:g} s ahead of the newest record; "
                f"nothing is predicted farther than {FARTHEST:g} s ahead"
            )
        return t if last is None or t > last else last + TICK


def _seconds(t: Any) -> float:
    if not isinstance(t, Real):
        raise TimeError(f"{t!r} is no time in seconds")
    return float(t)
