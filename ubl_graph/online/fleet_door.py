"""The door of an online fleet: what comes in is checked, then judged by its stamps."""

from __future__ import annotations

import difflib
import math
from dataclasses import fields

import numpy as np

from ubl_graph.arrays import BoolArray
from ubl_graph.cooperative.fleet import Fleet
from ubl_graph.errors import ConfigurationError, DataError
from ubl_graph.measurements import (
    Depth,
    Heading,
    Odometry,
    OneWayRange,
    PositionFix,
    SlantRange,
    TwoWayRange,
)
from ubl_graph.odometry_chain import INSTANT
from ubl_graph.online.buffer import Entry, entry_of
from ubl_graph.online.fleet_core import Core
from ubl_graph.online.outputs import Outcome
from ubl_graph.records import Records

#: Kinds of records that are taken.
TAKEN = (Odometry, PositionFix, Heading, Depth, TwoWayRange, OneWayRange, SlantRange)
#: Records that are farther ahead of all others than the lag count once so many agree.
AGREED = 3
#: Records that are held back at the most.
MOST_HELD = 100


class Door:
    """Takes records in.

    Parameters
    ----------
    fleet : Fleet
        The configuration.
    lag : float
        Length of the window, s.

    Raises
    ------
    ConfigurationError
        Where batch smoothing alone takes such a fleet.
    """

    core: Core

    def __init__(self, fleet: Fleet, lag: float) -> None:
        self.fleet, self.lag = fleet, float(lag)
        self._check_fleet()
        self._names = frozenset(fleet.names)
        self._held: list[tuple[str, Entry]] = []

    def add(self, vehicle: str, records: Records) -> Outcome:
        """Take records of a vehicle in. Odometry is kept; the rest counts from the next `update`.

        Parameters
        ----------
        vehicle : str
            Who measured.
        records : Records
            One record or several of a kind; several are taken one by one.

        Returns
        -------
        Outcome
            Of several: whether all were accepted, and the last reason why one was not.

        Raises
        ------
        DataError
            Where the vehicle or the other end of a range is unknown or the vehicle itself, or the
            kind is none that is taken; the estimate is untouched.
        """
        self._check(vehicle, records)
        if isinstance(records, Odometry):
            return self._add_odometry(vehicle, records)
        outcome = Outcome(True)
        rows = [records] if len(records) == 1 else [records[i] for i in range(len(records))]
        for row in rows:
            one = self._admit(vehicle, entry_of(row))
            outcome = one if not one.accepted or outcome.accepted else outcome
        return outcome

    def _add_odometry(self, vehicle: str, records: Odometry) -> Outcome:
        core, line = self.core, self.core.lines[vehicle]
        gate = core.gates[vehicle]["odometry"]
        if len(records) > 1:
            records = records[np.argsort(records.t_to, kind="stable")]
        begin = max(core.horizon, line.nodes[0].t if line.nodes else -math.inf)
        late, ahead = records.t_to <= begin, self._leaps(records)
        reason = ""
        if late.any():
            gate.rejected["late"] += int(late.sum())
            reason = self._too_old(float(records.t_to[late].min()))
        now = records[~late & ~ahead] if late.any() or ahead.any() else records
        if len(now):
            for why, t in zip(line.take(now), now.t_to.tolist(), strict=True):
                if why:
                    gate.rejected[why] += 1
                    reason = why
                else:
                    gate.accepted += 1
                    gate.times.append(t)
            self._advance(float(now.t_to[-1]))
        final = True
        for i in np.flatnonzero(ahead).tolist():
            outcome = self._hold(vehicle, entry_of(records[i]))
            final &= outcome.final
            reason = outcome.reason or reason
        return Outcome(not reason, reason, final)

    def _leaps(self, records: Odometry) -> BoolArray:
        """Which records, in order of time, are more than the lag ahead of all before them."""
        now = self.core.now
        if now is None:
            return np.zeros(len(records), dtype=np.bool_)
        reached = np.maximum.accumulate(np.append(now, records.t_to[:-1]))
        leaps: BoolArray = records.t_to > reached + self.lag
        return np.logical_or.accumulate(leaps)

    def _too_old(self, t: float) -> str:
        age = (self.core.now or 0.0) - t
        return f"{age:.1f} s old, the window begins {self.lag:g} s back"

    def _admit(self, vehicle: str, entry: Entry) -> Outcome:
        """Judge a record by its stamps."""
        core = self.core
        gate = core.gates[vehicle][entry.kind]
        if core.now is not None and entry.t > core.now + self.lag:
            return self._hold(vehicle, entry)
        if core.now is not None and entry.begin < core.horizon:
            gate.rejected["late"] += 1
            return Outcome(False, self._too_old(entry.begin))
        line = core.lines[vehicle]
        if line.nodes and entry.begin < line.nodes[0].t - INSTANT:
            gate.rejected["late"] += 1
            return Outcome(False, f"before the first place of '{vehicle}', {line.nodes[0].t:g} s")
        key = (vehicle, *entry.key)
        twin = core.keys.get(key)
        if twin is not None:
            gate.rejected["duplicate"] += 1
            same = twin.equals(entry)
            return Outcome(False, "duplicate" if same else "another record of that time is there")
        core.keys[key] = entry
        self._advance(entry.t)
        if entry.kind == "depth":
            gate.accept(entry)
            core.take_up(line, entry.t, -entry.values[1], entry.values[2])
            return Outcome(True)
        if entry.kind == "position" and entry.values[1].shape[1] == 3 and line.planar:
            core.take_up(line, entry.t, float(entry.values[1][0, 2]), None)
        core.queue.append((vehicle, entry))
        return Outcome(True)

    def _hold(self, vehicle: str, entry: Entry) -> Outcome:
        """Keep a record that is far ahead until others agree."""
        self._held.append((vehicle, entry))
        del self._held[:-MOST_HELD]
        near = [one for one in self._held if abs(one[1].t - entry.t) <= self.lag]
        if len(near) < AGREED:
            self.core.gates[vehicle][entry.kind].rejected["ahead"] += 1
            now = self.core.now or 0.0
            return Outcome(False, f"held back: {entry.t - now:.0f} s ahead of all others", False)
        for name, one in near:
            if one is not entry:
                self.core.gates[name][one.kind].rejected["ahead"] -= 1
        self._held = []
        self.core.now = max(one.t for _, one in near)
        for name, one in sorted(near, key=lambda pair: pair[1].t):
            assert isinstance(one.record, Records)
            self.add(name, one.record)
        return Outcome(True)

    def _advance(self, t: float) -> None:
        if self.core.now is None or t > self.core.now:
            if self.core.now is None:
                self.core.window.epoch = t
            self.core.now = t

    def _check_vehicle(self, vehicle: str) -> None:
        if vehicle not in self.core.lines:
            raise unknown("vehicle", vehicle, self.fleet.vehicle_names)

    def _check(self, vehicle: str, records: Records) -> None:
        self._check_vehicle(vehicle)
        if not isinstance(records, TAKEN):
            raise DataError(
                f"{type(records).__name__} is nothing that vehicles joined by odometry take",
                "give Odometry, PositionFix, Heading, Depth or ranges; batch smoothing takes more",
            )
        for f in fields(records):
            column = getattr(records, f.name)
            # Records that were made without checks are no excuse.
            if isinstance(column, np.ndarray) and column.dtype.kind == "f":
                sound = np.isfinite(column).reshape(len(column), -1).all(axis=1)
                if not sound.all():
                    i = int(np.argmin(sound))
                    raise records.error(i, f.name, f"{column[i]} is not finite", "drop or mend it")
        if isinstance(records, (TwoWayRange, OneWayRange, SlantRange)):
            self._check_ends(vehicle, records)

    def _check_ends(self, vehicle: str, records: TwoWayRange | OneWayRange | SlantRange) -> None:
        for i, peer in enumerate(records.beacon.tolist()):
            if peer == vehicle:
                raise records.error(
                    i,
                    "beacon",
                    f"a range of vehicle '{vehicle}' to itself",
                    "name the vehicle, beacon or target at its other end",
                )
            if peer not in self._names:
                raise records.error(i, "beacon", str(unknown("end", peer, self.fleet.names)))

    def _check_fleet(self) -> None:
        if not math.isfinite(self.lag) or self.lag <= 0.0:
            raise ConfigurationError(f"a lag of {self.lag} s", "give seconds, more than zero")
        batch = "batch smoothing (smooth_fleet) takes it"
        kinds = {m.options.node for m in self.fleet.vehicles}
        if "point" in kinds or len(kinds) > 1:
            raise ConfigurationError(
                f"nodes of {' and '.join(sorted(kinds))}: online fleets have poses of one kind, "
                "joined by odometry",
                f"set node = 'pose2' or 'pose3' for all vehicles; {batch}",
                field="options.node",
            )
        if self.fleet.options.estimate_beacons:
            raise ConfigurationError(
                "online fleets know their beacons", batch, field="options.estimate_beacons"
            )
        for member in self.fleet.vehicles:
            if member.segment.records():
                raise ConfigurationError(
                    f"vehicle '{member.name}' has records in its segment",
                    "leave them out and add them one by one, or smooth them in a batch",
                    field="vehicle",
                )
        self.fleet.options.require_settled()


def unknown(what: str, name: str, known: tuple[str, ...]) -> DataError:
    """Build the error that names something which is not there, and what may have been meant."""
    near = difflib.get_close_matches(str(name), known, n=1)
    hint = f"did you mean '{near[0]}'? " if near else ""
    return DataError(f"unknown {what} '{name}'", f"{hint}known: {', '.join(known) or 'none'}")
