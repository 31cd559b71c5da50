"""The records of the last lag, by kind and in order of time, whatever order they came in."""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ubl_graph.measurements import (
    Odometry,
    OneWayRange,
    PositionFix,
    SlantRange,
    TwoWayRange,
)
from ubl_graph.mission import RECORD_KINDS, Start
from ubl_graph.records import Records

#: Kinds that hold ranges.
PINGS = ("two_way_range", "one_way_range", "slant_range")
#: Kinds that say where the vehicle is, each in the frame of the beacons.
ABSOLUTE = (*PINGS, "position", "set_position")
#: All kinds: those of a mission, and the positions set by hand.
KINDS = (*RECORD_KINDS, "set_position")
_KIND_OF = {made: kind for kind, (made, _) in RECORD_KINDS.items()}
#: Columns of the kinds whose records are all numbers, but for the covariance of odometry.
_COLUMNS: dict[str, tuple[str, ...]] = {
    "velocity": ("t", "forward", "right", "down", "sigma", "reference"),
    "attitude": ("t", "heading", "pitch", "roll", "sigma"),
    "depth": ("t", "depth", "sigma"),
    "two_way_range": ("beacon", "t_transmit", "t_receive", "travel_time", "sigma"),
    "one_way_range": ("beacon", "t_transmit", "t_receive", "sigma"),
    "slant_range": ("beacon", "t", "distance", "sigma"),
    "heading": ("t", "heading", "sigma"),
    "angular_rate": ("t", "about_forward", "about_right", "about_down", "sigma"),
    "odometry": (
        *("t_from", "t_to", "forward", "right", "down"),
        *("about_forward", "about_right", "about_down", "covariance"),
    ),
}
#: Kinds whose last record before a window says what holds where it begins.
HELD = ("velocity", "attitude", "heading", "angular_rate")
#: Neighbours are looked for among so many entries.
LOOK = 50
_TIMES = frozenset({"t", "t_transmit", "t_receive", "t_from", "t_to"})


@dataclass(slots=True, eq=False)
class Entry:
    """One record and its fate.

    Attributes
    ----------
    kind : str
        "two_way_range", ..., or "set_position".
    record : Records or Start
        As it was given.
    values : tuple
        Its columns, times on the window's clock.
    t : float
        When it was complete (a ping's receive time), s.
    begin : float
        The earliest time that it speaks of (a two-way ping's transmit time), s.
    gated : bool
        Left out of the estimate.
    reason : str
        Why.
    """

    kind: str
    record: Records | Start
    values: tuple[Any, ...]
    t: float
    begin: float
    gated: bool = False
    reason: str = ""

    @property
    def key(self) -> tuple[Any, ...]:
        """What makes a duplicate."""
        if self.kind == "slant_range":
            return (self.kind, *self.values[:2])
        if self.kind in PINGS:
            return (self.kind, *self.values[:3])
        if self.kind == "odometry":
            return (self.kind, *self.values[:2])
        if self.kind == "velocity":
            return (self.kind, self.t, self.values[-1])
        return (self.kind, self.t)

    @property
    def stream(self) -> tuple[str, str]:
        """Whose records come in order: a sensor's, a beacon's, a velocity's by reference."""
        if self.kind in PINGS:
            return (self.kind, self.values[0])
        return (self.kind, self.values[-1] if self.kind == "velocity" else "")

    def equals(self, other: Entry) -> bool:
        """Whether another entry says the same."""
        if isinstance(self.record, Start):
            return self.record == other.record
        pairs = zip(self.values, other.values, strict=True)
        return all(np.array_equal(a, b) for a, b in pairs)


def entry_of(record: Records | Start) -> Entry:
    """The entry of a record of one row, or of a position set by hand."""
    if isinstance(record, Start):
        return Entry("set_position", record, (), record.t, record.t)
    kind = _KIND_OF[type(record)]
    if isinstance(record, PositionFix):
        t = float(record.t[0])
        return Entry(kind, record, (t, record.position, record.covariances), t, t)
    values = tuple(_plain(getattr(record, name)) for name in _COLUMNS[kind])
    if isinstance(record, Odometry):
        return Entry(kind, record, values, values[1], values[0])
    if isinstance(record, SlantRange):
        return Entry(kind, record, values, values[1], values[1])
    if isinstance(record, OneWayRange):
        return Entry(kind, record, values, values[2], values[2])
    if isinstance(record, TwoWayRange):
        return Entry(kind, record, values, values[2], values[1])
    return Entry(kind, record, values, values[0], values[0])


def _plain(column: Any) -> Any:
    """The one value of a column, a matrix as it is; None where there is no column."""
    if column is None or column.ndim > 1:
        return None if column is None else column[0]
    return column[0].item()


def _time(entry: Entry) -> float:
    return entry.t


class Buffer:
    """Entries by kind, in order of `t`."""

    def __init__(self) -> None:
        self._entries: dict[str, list[Entry]] = {kind: [] for kind in KINDS}
        self._keys: dict[tuple[Any, ...], Entry] = {}

    def __len__(self) -> int:
        return len(self._keys)

    def add(self, entry: Entry) -> None:
        """Put an entry in its place."""
        insort(self._entries[entry.kind], entry, key=_time)
        self._keys[entry.key] = entry

    def remove(self, entry: Entry) -> None:
        """Take an entry out."""
        self._entries[entry.kind].remove(entry)
        self._forget(entry)

    def _forget(self, entry: Entry) -> None:
        """Take an entry's stamps off the list, if they are its own."""
        if self._keys.get(entry.key) is entry:
            del self._keys[entry.key]

    def twin(self, entry: Entry) -> Entry | None:
        """The entry that has the same stamps."""
        return self._keys.get(entry.key)

    def of(self, kind: str) -> list[Entry]:
        """All entries of a kind."""
        return self._entries[kind]

    def all(self) -> Iterator[Entry]:
        """All entries, kind by kind."""
        for entries in self._entries.values():
            yield from entries

    def between(self, kind: str, begin: float, end: float) -> list[Entry]:
        """Entries of a kind with begin <= t < end."""
        entries = self._entries[kind]
        return entries[
            bisect_left(entries, begin, key=_time) : bisect_left(entries, end, key=_time)
        ]

    def reaching(self, kind: str, begin: float) -> list[Entry]:
        """Entries of a kind that end after `begin`, s."""
        entries = self._entries[kind]
        return entries[bisect_right(entries, begin, key=_time) :]

    def around(self, kind: str, begin: float, end: float) -> list[Entry]:
        """The same with one more entry on either side, gated ones left out."""
        entries = self._entries[kind]
        first, last = bisect_left(entries, begin, key=_time), bisect_right(entries, end, key=_time)
        while first > 0:
            first -= 1
            if not entries[first].gated:
                break
        while last < len(entries):
            last += 1
            if not entries[last - 1].gated:
                break
        return [e for e in entries[first:last] if not e.gated]

    def neighbours(self, entry: Entry) -> tuple[Entry | None, Entry | None]:
        """The nearest good entries of the same sensor before and after one, itself left out."""
        entries = self._entries[entry.kind]
        at = bisect_left(entries, entry.t, key=_time)

        def fits(e: Entry) -> bool:
            return not e.gated and e is not entry and e.stream == entry.stream

        before = next(filter(fits, reversed(entries[max(at - LOOK, 0) : at])), None)
        return before, next(filter(fits, entries[at : at + LOOK]), None)

    def trim(self, begin: float) -> list[Entry]:
        """Drop what ended before `begin`, but for each kind's last record there; what was dropped.

        The last velocity, attitude or turn before a window says what holds where it begins.
        """
        dropped: list[Entry] = []
        for kind, entries in self._entries.items():
            spare = 1 if kind in HELD else 0
            stop = bisect_left(entries, begin, key=_time) - spare
            if stop > 0:
                dropped += entries[:stop]
                del entries[:stop]
        for entry in dropped:
            self._forget(entry)
        return dropped

    def shift(self, by: float) -> None:
        """Move all times by so many seconds: the clock was set."""
        self._keys.clear()
        for entry in self.all():
            entry.t += by
            entry.begin += by
            if isinstance(entry.record, Start):
                entry.record = replace(entry.record, t=entry.t)
            names = _COLUMNS.get(entry.kind, ("t",))
            entry.values = (
                tuple(
                    v + by if n in _TIMES else v for n, v in zip(names, entry.values, strict=False)
                )
                + entry.values[len(names) :]
            )
            self._keys[entry.key] = entry


def columns_of(kind: str, entries: list[Entry]) -> Any:
    """Records of one kind (no fixes, no odometry) from their entries, on the window's clock."""
    columns = zip(*(e.values for e in entries), strict=True)
    made = RECORD_KINDS[kind][0]
    return made.unchecked(**{n: np.array(c) for n, c in zip(_COLUMNS[kind], columns, strict=True)})


def odometry_of(entries: list[Entry]) -> list[Odometry]:
    """Odometry from its entries, that of each shape apart: planar or not, with noise or without."""
    names = _COLUMNS["odometry"]
    shapes: dict[tuple[Any, ...], list[Entry]] = {}
    for entry in entries:
        shape = tuple(None if v is None else np.shape(v) for v in entry.values)
        shapes.setdefault(shape, []).append(entry)
    return [
        Odometry.unchecked(
            **{
                name: np.array(column)
                for name, column in zip(
                    names, zip(*(e.values for e in some), strict=True), strict=True
                )
                if column[0] is not None
            }
        )
        for some in shapes.values()
    ]


def fixes_of(entries: list[Entry]) -> list[PositionFix]:
    """Fixes from their entries, horizontal and full ones apart."""
    out: list[PositionFix] = []
    for dimension in (2, 3):
        some = [e.values for e in entries if e.values[1].shape[1] == dimension]
        if some:
            t, place, covariance = zip(*some, strict=True)
            place = np.concatenate(place)
            out.append(
                PositionFix.unchecked(
                    t=np.array(t),
                    east=place[:, 0],
                    north=place[:, 1],
                    up=place[:, 2] if dimension == 3 else None,
                    covariance=np.concatenate(covariance),
                )
            )
    return out
