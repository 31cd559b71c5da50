"""What stamps say of the clock: late records, far ones, and clocks that were set.

The policy. A record older than the lag is refused. One that lies more than the lag (and more than
three of its sensor's usual intervals) ahead of all others is held back until its time comes; five
such in a row, with none from the present in between, mean that the clock was set ahead or that all
sensors were silent: they are taken, and the time in between counts as silence. Records that come
behind the newest one are late, and welcome. But where ten in a row fall behind what their own
sensors have sent already, or are too old, in order of time and as dense as records come, the clock
was set back: what is known moves back with it, so that time goes on.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from ubl_graph.online.buffer import Entry

#: Records in a row that prove a clock set ahead.
AHEAD = 5
#: Records in a row that prove a clock set back.
BEHIND = 10
#: What a record may fall behind its own sensor's newest one in good order, s, and in intervals.
OUT_OF_ORDER, OUT_OF_ORDER_INTERVALS = 0.25, 1.5
#: Records of different sensors may be so much out of order, s.
JITTER = 0.5
#: A run of records may be so many times less dense than records usually are.
SPARSER = 3.0
#: A sensor's records may be so many usual intervals apart, however short the lag.
FAR_INTERVALS = 3.0
#: Records held back at the most.
MOST_HELD = 1000


@dataclass
class Clock:
    """The newest time, what is held back, and what seems to come from a clock set back.

    Attributes
    ----------
    now : float or None
        Time of the newest record, s.
    newest : dict
        Newest time by sensor (by beacon, by reference of velocities), s.
    held : list of Entry
        Records from far ahead.
    ahead : list of Entry
        The last held records in a row, near each other.
    behind : list of Entry
        The last records in a row that fall behind their own sensors.
    """

    lag: float
    now: float | None = None
    newest: dict[tuple[str, str], float] = field(default_factory=dict[tuple[str, str], float])
    held: list[Entry] = field(default_factory=list[Entry])
    behind: list[Entry] = field(default_factory=list[Entry])
    ahead: list[Entry] = field(default_factory=list[Entry])

    def is_far(self, entry: Entry, interval: float | None) -> bool:
        """Whether a record lies too far ahead to be believed at once.

        `interval`: its sensor's usual one, s.
        """
        far = max(self.lag, FAR_INTERVALS * (interval or 0.0))
        return self.now is not None and entry.t > self.now + far

    def age(self, entry: Entry) -> float:
        """How much older a record's beginning is than the newest record, s."""
        return 0.0 if self.now is None else self.now - entry.begin

    def hold(self, entry: Entry) -> list[Entry]:
        """Hold a record back; the records to take where that proves a clock set ahead."""
        if self.ahead and entry.t < self.ahead[-1].t - self.lag:
            self.ahead.clear()
        self.ahead.append(entry)
        self.held.append(entry)
        if len(self.ahead) < AHEAD:
            return []
        run, self.ahead = self.ahead, []
        self.held = [e for e in self.held if e not in run]
        return sorted(run, key=lambda e: e.t)

    def overflow(self) -> list[Entry]:
        """The oldest held records where there are too many, taken off the list."""
        over = self.held[:-MOST_HELD]
        self.held = self.held[len(over) :]
        return over

    def tick(self, entry: Entry) -> None:
        """Take the time of a record that is believed."""
        self.ahead.clear()
        self.now = entry.t if self.now is None else max(self.now, entry.t)

    def due(self) -> list[Entry]:
        """Held records whose time has come, taken off the list."""
        due = [e for e in self.held if self.now is not None and e.t <= self.now]
        if due:
            self.held = [e for e in self.held if e not in due]
        return due

    def note(self, entry: Entry) -> None:
        """Note the newest record of a sensor (of each beacon, of each reference)."""
        stream = entry.stream
        self.newest[stream] = max(self.newest.get(stream, entry.t), entry.t)

    def is_strange(self, entry: Entry, interval: float | None) -> bool:
        """Whether a record falls behind what its own sensor has sent already."""
        newest = self.newest.get(entry.stream)
        order = max(OUT_OF_ORDER, OUT_OF_ORDER_INTERVALS * (interval or 0.0))
        return newest is not None and entry.t < newest - order

    def suspect(self, entry: Entry, strange: bool, rate: float) -> list[Entry]:
        """Note a record, strange or not; the run of strange ones that proves a clock set back.

        Parameters
        ----------
        entry : Entry
            Just come.
        strange : bool
            By `is_strange`.
        rate : float
            Records of all sensors that usually come, 1/s.
        """
        if not strange:
            self.behind.clear()
            return []
        if self.behind:
            same = [e.t for e in self.behind if e.stream == entry.stream]
            if entry.t < self.behind[-1].t - JITTER or (same and entry.t <= same[-1]):
                self.behind.clear()
        self.behind.append(entry)
        if len(self.behind) < BEHIND:
            return []
        span = self.behind[-1].t - self.behind[0].t
        if span > SPARSER * BEHIND / max(rate, 1e-9):
            del self.behind[0]
            return []
        run, self.behind = self.behind, []
        return run

    def shift(self, by: float) -> None:
        """Move what is remembered by so many seconds: the clock was set."""
        self.newest = {stream: t + by for stream, t in self.newest.items()}
        if self.now is not None:
            self.now += by
