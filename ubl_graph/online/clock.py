"""What stamps say of the clock: late records, far ones, and clocks that were set.

The policy. A record older than the lag is refused. One that lies more than the lag ahead of all
others is held back until its time comes; five such in a row, near each other and with none from
the present in between, mean that the clock was set ahead or that all sensors were silent: they are
taken, and the time in between counts as silence. Records that come behind the newest one are late,
and welcome. But five in a row that fall where their sensors have been already, or that are too old,
each sensor's in order of time, mean that the clock was set back: what is known moves back with it,
so that time goes on.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from ubl_graph.online.buffer import Entry

#: Records in a row that prove a clock set ahead.
AHEAD = 5
#: Records in a row that prove a clock set back.
BEHIND = 5
#: Lateness that needs no explanation, s.
LATE = 1.0
#: Nearer to its sensor's neighbour than this share of the usual interval a late record overlaps.
OVERLAP = 0.45
#: Records held back at the most.
MOST_HELD = 1000


@dataclass
class Clock:
    """The newest time, what is held back, and what seems to come from a clock set back.

    Attributes
    ----------
    now : float or None
        Time of the newest record, s.
    held : list of Entry
        Records from far ahead.
    behind : list of Entry
        The last records in a row that overlap with earlier ones, or are too old.
    """

    lag: float
    now: float | None = None
    held: list[Entry] = field(default_factory=list[Entry])
    behind: list[Entry] = field(default_factory=list[Entry])
    _ahead_run: list[Entry] = field(default_factory=list[Entry])

    def is_far(self, entry: Entry) -> bool:
        """Whether a record lies too far ahead to be believed at once."""
        return self.now is not None and entry.t > self.now + self.lag

    def age(self, entry: Entry) -> float:
        """How much older a record's beginning is than the newest record, s."""
        return 0.0 if self.now is None else self.now - entry.begin

    def hold(self, entry: Entry) -> list[Entry]:
        """Hold a record back; the records to take where that proves a clock set ahead."""
        if self._ahead_run and abs(entry.t - self._ahead_run[-1].t) > self.lag:
            self._ahead_run.clear()
        self._ahead_run.append(entry)
        self.held.append(entry)
        if len(self._ahead_run) < AHEAD:
            del self.held[:-MOST_HELD]
            return []
        run, self._ahead_run = self._ahead_run, []
        self.held = [e for e in self.held if e not in run]
        return sorted(run, key=lambda e: e.t)

    def tick(self, entry: Entry) -> None:
        """Take the time of a record that is believed."""
        self._ahead_run.clear()
        self.now = entry.t if self.now is None else max(self.now, entry.t)

    def due(self) -> list[Entry]:
        """Held records whose time has come, taken off the list."""
        due = [e for e in self.held if self.now is not None and e.t <= self.now]
        if due:
            self.held = [e for e in self.held if e not in due]
        return due

    def overlaps(self, entry: Entry, neighbours: list[float], interval: float | None) -> bool:
        """Whether a late record falls where its sensor has been already.

        Parameters
        ----------
        entry : Entry
            Just come, not in the buffer yet.
        neighbours : list of float
            Times of the sensor's records next to it, s.
        interval : float or None
            The sensor's usual interval, s.
        """
        if self.now is None or self.now - entry.t < LATE or interval is None:
            return False
        return any(abs(entry.t - t) < OVERLAP * interval for t in neighbours)

    def suspect(self, entry: Entry, strange: bool) -> list[Entry]:
        """Note a record, strange or not; the run of strange ones that proves a clock set back."""
        if not strange:
            self.behind.clear()
            return []
        last = next((e for e in reversed(self.behind) if e.kind == entry.kind), None)
        if last is not None and last.t >= entry.t:
            self.behind.clear()
        self.behind.append(entry)
        if len(self.behind) < BEHIND:
            return []
        run, self.behind = self.behind, []
        return run
