"""The door of an online fleet: what comes in is checked, then judged by its stamps."""

from __future__ import annotations

import difflib
import math
from collections.abc import Sequence
from dataclasses import fields
from numbers import Real

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
#: Records that are farther ahead of all others than the lag count once so many agree, of two
#: vehicles at the least.
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
        if not isinstance(lag, Real) or not math.isfinite(lag) or lag <= 0.0:
            raise ConfigurationError(f"a lag of {lag!r} s", "give seconds, more than zero")
        self.fleet, self.lag = fleet, float(lag)
        self._check_fleet()
        self._names = frozenset(fleet.names)
        self._forget_clocks()

    def _begin(self) -> None:
        """Forget all records; begin anew from the starts."""
        raise NotImplementedError

    def _forget_clocks(self) -> None:
        """Nothing has been heard."""
        #: Records that are held back.
        self._held: list[tuple[str, Entry]] = []
        #: Records that are far behind the only vehicle that has been believed.
        self._behind: list[tuple[str, Entry]] = []
        #: Vehicles of which a record was believed, and the first stamp of all.
        self._believed: set[str] = set()
        self._first = math.inf
        #: By vehicle, how far its clock is ahead of the others', s.
        self._ahead: dict[str, float] = {}
        #: Those of them that others have contradicted: they have no say till they are right.
        self._wrong: set[str] = set()
        #: Who spoke last, its first stamp that was held back since another did, and calls since.
        self._speaker, self._alone, self._calls = "", math.inf, 0

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
        if not len(records):
            return Outcome(True)
        if vehicle not in self._wrong:
            if vehicle != self._speaker:
                self._speaker, self._alone, self._calls = vehicle, math.inf, 0
            self._calls += math.isfinite(self._alone)
        return self._add(vehicle, records)

    def _add(self, vehicle: str, records: Records) -> Outcome:
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
        if records.t_to[-1] <= core.horizon:
            last = records[max(len(records) - AGREED, 0) :]
            entries = [entry_of(last[i]) for i in range(len(last))]
            if self._outvotes(vehicle, entries):
                return self._add_odometry(vehicle, records)
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
            self._advance(vehicle, float(now.t_to[0]), float(now.t_to[-1]))
        held, final = "", True
        for i in np.flatnonzero(ahead).tolist():
            if core.now is not None and records.t_to[i] <= core.now + self.lag:
                # Those before it agreed.
                outcome = self._add_odometry(vehicle, records[i:])
                held, final = outcome.reason, outcome.final
                break
            outcome = self._hold(vehicle, entry_of(records[i]))
            held, final = outcome.reason, outcome.final
        return Outcome(not (held or reason), held or reason, final)

    def _leaps(self, records: Odometry) -> BoolArray:
        """Which records, in order of time, are more than the lag ahead of all before them."""
        now = float(records.t_to[0]) if self.core.now is None else self.core.now
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
            if entry.t < core.horizon and self._outvotes(vehicle, [entry]):
                return self._admit(vehicle, entry)
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
        self._advance(vehicle, entry.t, entry.t)
        if entry.kind == "depth":
            why = core.take_depth(line, gate, entry)
            return Outcome(not why, why, not why)
        full = entry.kind == "position" and entry.values[1].shape[1] == 3
        if full and line.planar and not line.located:
            # Nothing can judge the fix yet; the search needs its height.
            line.take_up(entry.t, float(entry.values[1][0, 2]))
        core.queue.append((vehicle, entry))
        return Outcome(True)

    def _hold(self, vehicle: str, entry: Entry) -> Outcome:
        """Keep a record that is far ahead until others agree."""
        if vehicle == self._speaker:
            self._alone = min(self._alone, entry.t)
        self._held.append((vehicle, entry))
        del self._held[:-MOST_HELD]
        near = [one for one in self._held if abs(one[1].t - entry.t) <= self.lag]
        if not self._agree(vehicle, entry, near):
            self.core.gates[vehicle][entry.kind].rejected["ahead"] += 1
            off = entry.t - (self.core.now or 0.0)
            if vehicle in self._ahead or len(near) >= AGREED:
                self._ahead[vehicle] = off
                return Outcome(False, f"its clock is {off:.0f} s ahead of the others'", False)
            return Outcome(False, f"held back: {off:.0f} s ahead of all others", False)
        for name, one in near:
            if one is not entry:
                self.core.gates[name][one.kind].rejected["ahead"] -= 1
        self._held = []
        self.core.now = max(one.t for _, one in near)
        for name, one in sorted(near, key=lambda pair: pair[1].t):
            assert isinstance(one.record, Records)
            self._add(name, one.record)
        return Outcome(True)

    def _agree(self, vehicle: str, entry: Entry, near: Sequence[tuple[str, Entry]]) -> bool:
        """Whether records that are far ahead are believed: one clock alone is not."""
        if len(near) < AGREED:
            return False
        if len({name for name, _ in near}) > 1:
            return True
        if vehicle in self._wrong:
            return False
        if (self._believed | {name for name, _ in self._held}) - self._wrong == {vehicle}:
            return True
        # The others are silent, and it has gone on alone for longer than the lag.
        return entry.t - self._alone > self.lag and self._calls >= AGREED

    def _outvotes(self, vehicle: str, entries: Sequence[Entry]) -> bool:
        """Whether records that are far behind show that the only clock believed is ahead.

        Two vehicles do; one does with so many records as agree, unless the other has gone on for
        longer than the lag. All is begun anew from them then.
        """
        if len(self._believed) != 1 or vehicle in self._believed:
            return False
        own = [(vehicle, entry) for entry in entries]
        near = [one for one in self._behind if abs(one[1].t - entries[-1].t) <= self.lag]
        together = [*near, *own]
        now = self.core.now or 0.0
        young = now - self._first <= self.lag
        if len({name for name, _ in together}) < 2 and not (young and len(together) >= AGREED):
            self._behind = [*self._behind, *own][-MOST_HELD:]
            return False
        (wrong,) = self._believed
        self._begin()
        self._ahead[wrong] = now - entries[-1].t
        self._wrong.add(wrong)
        for name, one in sorted(near, key=lambda pair: pair[1].t):
            assert isinstance(one.record, Records)
            self._add(name, one.record)
        return True

    def _advance(self, vehicle: str, begin: float, t: float) -> None:
        """Note that records of a vehicle, of a time span (s), are believed."""
        self._believed.add(vehicle)
        self._alone, self._calls = math.inf, 0
        self._first = min(self._first, begin)
        self._ahead.pop(vehicle, None)
        self._wrong = set(self._ahead)
        if len(self._believed) > 1:
            self._behind.clear()
        if self.core.now is None or t > self.core.now:
            if self.core.now is None:
                self.core.window.epoch = t
            self.core.now = t

    def _check_vehicle(self, vehicle: object) -> None:
        if vehicle not in self.fleet.vehicle_names:
            raise unknown("vehicle", str(vehicle), self.fleet.vehicle_names)

    def _check(self, vehicle: str, records: Records) -> None:
        self._check_vehicle(vehicle)
        if not isinstance(records, TAKEN):
            raise DataError(
                f"{type(records).__name__} is nothing that vehicles joined by odometry take",
                "give Odometry, PositionFix, Heading, Depth or ranges; batch smoothing takes more",
            )
        # No rows have no shape to be looked at by.
        for f in fields(records) if len(records) else ():
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
