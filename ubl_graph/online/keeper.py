"""The keeper: window, gates and memory of an estimator in step; no failing solver ends it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.mission import Setup, Start
from ubl_graph.online.buffer import ABSOLUTE, KINDS
from ubl_graph.online.clock import Clock
from ubl_graph.online.gate import Gate
from ubl_graph.online.health import LOST_LEAST, LOST_SHARE, Facts, Latency
from ubl_graph.online.ledger import METRES
from ubl_graph.online.outputs import Event, Memory
from ubl_graph.online.revision import Reviser
from ubl_graph.online.state import Moment

#: What can go wrong in a solve.
_FAILURES = (Exception,)


@dataclass(eq=False)
class Rival:
    """Another track that fits.

    Attributes
    ----------
    tracker : Reviser
        Its buffer and window.
    weight : float
        Posterior probability among the tracks carried.
    agrees : bool
        Whether it took the last ping or fix.
    """

    tracker: Reviser
    weight: float = 0.0
    agrees: bool = True


class Keeper:
    """What an estimator consists of.

    Parameters
    ----------
    setup : Setup
        Beacons, sound speed, vehicle and options.

    Attributes
    ----------
    tracker : Reviser
        Buffer, window and engine.
    clock : Clock
        The newest time.
    gates : dict of str to Gate
        By sensor.
    state : Memory
        What else is remembered.
    events : list of Event
        What became of earlier records since the list was emptied last.
    latency : Latency
        How long updates take.
    rivals : list of Rival
        Other tracks that fit, heaviest first.
    """

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        self.tracker = Reviser(setup)
        self.clock = Clock(setup.options.lag)
        self.gates = {kind: Gate() for kind in KINDS}
        self.state = Memory()
        self.events: list[Event] = []
        self.latency = Latency()
        self.resets = 0
        self.rivals: list[Rival] = []
        self.start: Start | None = setup.start

    def refresh(self) -> None:
        """Solve where records have come since the last solve."""
        if self.state.located and not self.state.waiting and self.tracker.is_stale:
            self.guarded(self.tracker.solve)

    def settle(self) -> None:
        """Decide on the records that leave the window, and let it move on."""
        now = self.clock.now
        assert now is not None
        if self.tracker.window is None:
            self.tracker.trim(now)
        if not self.tracker.is_due(now):
            return
        if self.state.located and not self.state.waiting:
            self.guarded(lambda: self.tracker.decide(now))
            self.regated()
        elif not self.state.located:
            for entry in self.tracker.leaving(now):
                if entry.kind in ABSOLUTE:
                    text = "too old: it left the window before a position was found"
                    self.events.append(Event("rejected", text, entry.record, True))
        self.guarded(lambda: self.tracker.trim(now))

    def recent(self) -> Moment | None:
        """The state when the window was solved last, for cheap predictions."""
        state = self.state
        if state.moment is None and state.located and math.isfinite(state.solved_at):
            state.moment = self.guarded(lambda: self.tracker.recent(state.solved_at))
        return state.moment

    def guarded(self, work: Callable[[], Any]) -> Any:
        """What `work` gives; where a solver fails the window is rebuilt, and None comes back."""
        try:
            return work()
        except _FAILURES as error:
            text = " ".join(str(error).split())[:120]
        try:
            self.tracker.rebuild()
            self.after_rebuild(f"a solver failed: {text}")
            return work()
        except _FAILURES:
            self.state.waiting = "the solver failed twice; looking for the position anew"
            self.state.lost_at = -math.inf
            self.state.rebuilt = True
        return None

    def is_lost(self) -> bool:
        """Whether the newest node was known too badly when the last ping came."""
        window = self.tracker.window
        assert window is not None
        sigma = self.tracker.horizontal_sigma
        if sigma <= LOST_LEAST:
            return False
        return not sigma <= max(LOST_LEAST, LOST_SHARE * self._reach(window.last_position))

    def _reach(self, position: FloatArray | None) -> float:
        """Distance to the beacons, m: by the position, but no farther than the pings say."""
        if position is None or not self.setup.beacons:
            return 0.0
        places = np.array([b.position for b in self.setup.beacons])
        away = float(np.median(np.linalg.norm(places - position, axis=1)))
        pings = self.tracker.buffer.of("two_way_range")
        if not pings:
            return away
        return min(away, METRES / 2.0 * float(np.median([e.values[3] for e in pings[-20:]])))

    def moment(self, t: float) -> Moment:
        """Position and velocity at `t`, s, with all records that have come."""
        self.refresh()
        return self.tracker.moment(t)

    def widened(self, moment: Moment) -> FloatArray:
        """Covariance, another place that fits as well included."""
        wide = self.ambiguity(moment.mean[None, :3], np.array([moment.t]))
        if wide is None:
            return moment.covariance
        covariance = moment.covariance.copy()
        covariance[:3, :3] += wide[0]
        return covariance

    def ambiguity(
        self,
        positions: FloatArray,
        times: FloatArray,  # noqa: ARG002 - who carries other tracks asks them
    ) -> FloatArray | None:
        """What another place that fits as well adds to the covariances at (M, 3): (M, 3, 3)."""
        state = self.state
        if not state.ambiguous:
            return None
        gap = state.rival
        if gap is not None:
            wide = state.rival_weight * np.outer(gap, gap)
            return np.broadcast_to(wide, (len(positions), 3, 3))
        middle = np.mean([b.position[:2] for b in self.setup.beacons] or [np.zeros(2)], axis=0)
        # Turned about the beacon by any angle.
        away = ((positions[:, :2] - middle) ** 2).sum(axis=1)
        return away[:, None, None] * np.diag([1.0, 1.0, 0.0])

    def facts(self, t: float, moment: Moment | None) -> Facts:
        """What the status at `t` (s) is judged by."""
        state = self.state
        chi_square, pings = self.tracker.chi_square()
        return Facts(
            t,
            state.located,
            state.rebuilt,
            state.waiting,
            state.ambiguous,
            state.located_at + self.setup.options.lag,
            state.notes,
            self._reach(None if moment is None else moment.mean[:3]),
            chi_square / pings if pings >= 10 else 0.0,
        )

    def after_rebuild(self, note: str) -> None:
        """Tell that the track was begun anew, and why."""
        now = self.clock.now
        assert now is not None
        self.state.rebuilt = True
        self.noted(note, now + self.setup.options.lag / 2.0)

    def noted(self, note: str, until: float) -> None:
        """Say something with the status until a time, s."""
        self.state.notes[note] = until
        self.state.notes = dict(list(self.state.notes.items())[-5:])

    def regated(self) -> None:
        """Tell of pings whose fate turned when the track did."""
        for entry in self.tracker.turned:
            self.gates[entry.kind].change_mind(entry)
            kind = "rejected" if entry.gated else "readmitted"
            reason = f"gated: {entry.reason}" if entry.gated else "it agrees with the track"
            self.events.append(Event(kind, reason, entry.record, False))
        self.tracker.turned = []
