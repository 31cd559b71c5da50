"""FixedLagEstimator: the online estimator's front door.

Records come in one by one, late and out of order; out comes a position with covariance and status.
Nothing that comes in ends it: bad records are refused with a typed error or an outcome that says
why, a solver that fails is begun anew from the records of the last lag.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.arrays import FloatArray
from ubl_graph.beacon import Beacon
from ubl_graph.errors import DataError, TimeError
from ubl_graph.frames import GeodeticOrigin
from ubl_graph.measurements import (
    AngularRate,
    Heading,
    Odometry,
    OneWayRange,
    SlantRange,
    TwoWayRange,
    Velocity,
)
from ubl_graph.mission import Mission, Setup, Start, Vehicle
from ubl_graph.nodes import grid_options
from ubl_graph.online.buffer import entry_of
from ubl_graph.online.core import FARTHEST, Core
from ubl_graph.online.health import judge, sensor_report
from ubl_graph.online.outputs import Estimate, Event, Outcome, sound
from ubl_graph.options import Options
from ubl_graph.records import MAX_TIME, Records
from ubl_graph.trajectory import States, Trajectory

#: Outputs are so far apart at the least, s.
TICK = 1e-6

__all__ = ["Estimate", "Event", "FixedLagEstimator", "Outcome"]


class FixedLagEstimator:
    """Position, velocity and covariance from records as they come.

    Parameters
    ----------
    options : Options, optional
        `lag`, `engine`, noise and motion.
    beacons : sequence of Beacon
        Every beacon that ranges may name.
    sound_speed : SoundSpeedProfile, optional
        Left out: 1500 m/s.
    vehicle : Vehicle, optional
        Lever arms.
    start : Start, optional
        What is known of the position at one time.
    origin : GeodeticOrigin, optional
        Where the local frame sits on the Earth.

    Examples
    --------
    >>> from ubl_graph import Beacon, Depth, FixedLagEstimator, Options, PositionFix
    >>> estimator = FixedLagEstimator(Options(lag=60.0))
    >>> estimator.add(PositionFix(0.0, 10.0, 20.0, -5.0, sigma=1.0)).accepted
    True
    >>> estimator.estimate().position.round(3).tolist()
    [10.0, 20.0, -5.0]
    """

    def __init__(
        self,
        options: Options | None = None,
        beacons: Sequence[Beacon] = (),
        sound_speed: SoundSpeedProfile | None = None,
        vehicle: Vehicle | None = None,
        start: Start | None = None,
        origin: GeodeticOrigin | None = None,
    ) -> None:
        setup = Setup(
            tuple(beacons),
            SoundSpeedProfile.constant(1500.0) if sound_speed is None else sound_speed,
            Vehicle() if vehicle is None else vehicle,
            Options() if options is None else options,
            start,
            origin=origin,
        )
        self._begin(setup)

    @classmethod
    def of(cls, setup: Setup | Mission) -> FixedLagEstimator:
        """The estimator for a setup (`load_setup`), or for a mission's records."""
        made = cls.__new__(cls)
        if isinstance(setup, Mission):
            lone = setup.segments[0] if len(setup.segments) == 1 else None
            setup = replace(setup.setup, start=None if lone is None else lone.start)
        made._begin(setup)
        return made

    def _begin(self, setup: Setup) -> None:
        setup.options.require_settled()
        self.setup = setup
        self.core = Core(_workable(setup))

    # -- in --

    def add(self, record: Records) -> Outcome:
        """Take a record in.

        Parameters
        ----------
        record : Records
            One record or several of a kind; several are taken one by one.

        Returns
        -------
        Outcome
            Of several: whether all were accepted, and the last reason why one was not.

        Raises
        ------
        DataError
            Where a range names an unknown beacon, a velocity needs what the options leave out, or
            nodes that are points cannot use the record; the estimate is untouched.
        """
        self._check(record)
        self.core.events = []
        outcome = Outcome(True)
        rows = [record] if len(record) == 1 else [record[i] for i in range(len(record))]
        for row in rows:
            one = self.core.admit(entry_of(row))
            outcome = one if not one.accepted or outcome.accepted else outcome
        # What became of the record itself the outcome says.
        others = tuple(e for e in self.core.events if not any(e.record is r for r in rows))
        return replace(outcome, others=others)

    def set_position(
        self,
        t: float,
        east: float,
        north: float,
        up: float | None = None,
        sigma: float = 10.0,
        heading: float | None = None,
        heading_sigma: float = 0.1,
    ) -> Outcome:
        """Say where the vehicle's reference point is at a time: seconds, metres.

        Parameters
        ----------
        t, east, north, up, sigma : float
            As of `Start`.
        heading, heading_sigma : float, optional
            Where nodes are poses: clockwise from true north, rad, and its standard deviation.

        Raises
        ------
        ConfigurationError
            Where a number is not finite, a sigma is not positive, or points are given a heading.
        """
        start = Start(t, east, north, up, sigma, heading, heading_sigma)
        self.setup.check_start(start)
        self.core.events = []
        outcome = self.core.admit(entry_of(start))
        return Outcome(outcome.accepted, outcome.reason, outcome.final, tuple(self.core.events))

    def flush(self) -> tuple[Event, ...]:
        """The end of the stream: what is held back is refused for good."""
        now = self.core.clock.now
        events = [
            Event(
                "rejected", f"held back: {e.t - (now or 0.0):g} s ahead to the end", e.record, True
            )
            for e in self.core.clock.held
        ]
        for entry in self.core.clock.held:
            self.core.gates[entry.kind].rejected["ahead"] += 1
        self.core.clock.held = []
        return tuple(events)

    def reset(self) -> None:
        """Forget all records and the position; begin anew. Output stamps go on increasing."""
        last, resets, latency = self.core.state.last_output, self.core.resets, self.core.latency
        self.core = Core(_workable(self.setup))
        self.core.state.last_output, self.core.resets = last, resets + 1
        self.core.latency = latency

    # -- out --

    def estimate(self, t: float | None = None) -> Estimate:
        """Where the vehicle is at a time, as far as all records say up to now.

        Parameters
        ----------
        t : float, optional
            Seconds; left out, the time of the newest record. Stamps increase from output to output:
            a time that is not after the last output's is answered just after that one. `smoothed`
            looks back.

        Raises
        ------
        TimeError
            Where `t` is not finite or more than an hour ahead of all records, or where there is
            neither a record nor `t`.
        """
        stamp = self._stamp(t)
        self.core.state.last_output = stamp
        located = self.core.state.located
        moment = self.core.guarded(lambda: self.core.moment(stamp)) if located else None
        if moment is not None and not sound(moment):
            moment = None
        if stamp == self.core.state.solved_at:
            self.core.state.moment = moment
        covariance = None if moment is None else self.core.widened(moment)
        status, reasons = judge(self.core.facts(stamp, moment), self.core.gates, covariance)
        self.core.state.rebuilt = False
        if moment is None:
            return Estimate(stamp, None, None, None, status, reasons)
        position, velocity, pose = moment.mean[:3], moment.mean[3:], moment.pose_covariance
        if pose is not None and covariance is not None:
            # What another place adds it adds here, too.
            pose = pose.copy()
            pose[:3, :3] = covariance[:3, :3]
        return Estimate(
            stamp,
            position,
            velocity,
            covariance,
            status,
            reasons,
            moment.rotation,
            pose,
            self.core.places(moment),
        )

    def smoothed(self, t: float | FloatArray) -> States:
        """Position and velocity in the window, with all that has come since.

        Parameters
        ----------
        t : float or array, shape (M,)
            Seconds, within the window.

        Raises
        ------
        TimeError
            Where a time is outside the window, or there is no position yet.
        """
        states = self.window().at(t)
        wide = self.core.ambiguity(states.position, states.t)
        return states if wide is None else replace(states, covariance=states.covariance + wide)

    def window(self) -> Trajectory:
        """The trajectory of the window.

        Raises
        ------
        TimeError
            Where there is no position yet.
        """
        if not self.core.state.located:
            raise TimeError("there is no position yet")
        self.core.refresh()
        found: Trajectory | None = self.core.guarded(self.core.tracker.trajectory)
        if found is None:
            raise TimeError("there is no position any more: the window's solver failed twice")
        return found

    def health(self) -> dict[str, Any]:
        """Status, counts by sensor and reason, window and timing, ready for JSON."""
        now, state = self.core.clock.now, self.core.state
        window = self.core.tracker.window
        moment = (
            self.core.guarded(lambda: self.core.moment(now))
            if state.located and now is not None
            else None
        )
        covariance = None if moment is None or not sound(moment) else self.core.widened(moment)
        t = 0.0 if now is None else now
        status, reasons = judge(self.core.facts(t, moment), self.core.gates, covariance)
        return {
            "t": now,
            "status": status,
            "reasons": list(reasons),
            "sensors": sensor_report(now, self.core.gates),
            "held": len(self.core.clock.held),
            "window": {
                "nodes": 0 if window is None else window.count,
                "begin_s": None if window is None else window.begin,
                "records": len(self.core.tracker.buffer),
                "lag_s": self.setup.options.lag,
                "spacing_s": self.core.tracker.spacing,
            },
            "engine": self.setup.options.engine,
            "rebuilds": self.core.tracker.rebuilds,
            "resets": self.core.resets,
            "clock_steps": state.clock_steps,
            **self.core.latency.summary(),
        }

    def checkpoint(self, path: str | Path) -> None:
        """Write all that is known to a file, at once or not at all.

        Raises
        ------
        DataError
            Where the file cannot be written.
        """
        from ubl_graph.online.checkpoint import write

        write(self, Path(path))

    @classmethod
    def restore(cls, path: str | Path) -> FixedLagEstimator:
        """Read a checkpoint and go on from it.

        Raises
        ------
        DataError
            Where the file cannot be read, or is no checkpoint.
        """
        from ubl_graph.online.checkpoint import read

        return read(cls, Path(path))

    # -- inside --

    def _check(self, record: Records) -> None:
        if not isinstance(record, Records):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise DataError(
                f"{type(record).__name__} is no measurement record",
                "give a TwoWayRange, a Velocity or another record of ubl_graph.measurements",
            )
        if isinstance(record, (TwoWayRange, OneWayRange, SlantRange)):
            self.setup.check_beacons(record)
        if isinstance(record, (Heading, AngularRate, Odometry)):
            self.setup.check_pose(record)
        if isinstance(record, Velocity):
            self.setup.check_current(record)

    def _stamp(self, t: float | None) -> float:
        now, last = self.core.clock.now, self.core.state.last_output
        if t is None:
            if now is None:
                raise TimeError("there is no record yet; give a time, or add records first")
            t = now
        if not math.isfinite(t) or abs(t) > MAX_TIME:
            raise TimeError(f"{t} is no time in seconds")
        if now is not None and t > now + FARTHEST:
            raise TimeError(
                f"{t:g} s is {t - now:g} s ahead of the newest record; "
                f"nothing is predicted farther than {FARTHEST:g} s ahead"
            )
        return t if last is None or t > last else last + TICK


def _workable(setup: Setup) -> Setup:
    """The setup with no less motion noise than the nodes of the window can bear."""
    return replace(setup, options=grid_options(setup.options))
