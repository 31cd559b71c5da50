"""The finder: a position where there is none, a better one where the pings contradict it."""

from __future__ import annotations

import math

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.mission import Start
from ubl_graph.online.buffer import ABSOLUTE, PINGS, Entry
from ubl_graph.online.gate import REOPENS, Gate, distance, limit
from ubl_graph.online.outputs import Event
from ubl_graph.online.pose_gap import with_heading
from ubl_graph.online.rivals import Rivals
from ubl_graph.online.search import Found

#: A track found first is put to the test so long after, s, and when the window is full.
CONFIRMED_AFTER = (2.5, 5.0, 10.0, 20.0, 40.0)
#: A lone beacon's track is put to the test again after such a part of its age.
LOOKS = 4.0
#: Tracks nearer to each other than this are one, m.
APART = 20.0
#: Fixes that leave the position open by more than this say nothing, m.
FREE_SIGMA = 1e4
#: Pings that a lost position is looked for with; a fix counts as three.
ENOUGH = 6


class Finder(Rivals):
    """Looks for the position, and puts it in question."""

    def find(self, now: float) -> None:
        """Look for the position where there is none, or none to trust."""
        state, tracker = self.state, self.tracker
        absolute = sum(len(tracker.buffer.of(kind)) for kind in ABSOLUTE)
        if absolute > 12 and now - state.searched_at < self.pause and now >= state.searched_at:
            return
        if state.located and tracker.absolute_since(state.lost_at) < ENOUGH:
            # What was known misleads where it no longer holds: a few pings are no match for it.
            return
        state.searched_at = now
        if not state.located and self._located_by_fixes(now):
            return
        found = tracker.search(self._prior(now))
        if not found.usable:
            if not state.located:
                state.waiting = found.reason
            return
        again = state.located
        self.forget_rivals()
        adopted = self.guarded(lambda: tracker.adopt(found, anew=True))
        if not adopted:
            return
        self._begin_track(now)
        self._doubt(found)
        self.regated()
        if tracker.is_fresh and not found.is_open:
            self._carry(found)
        if again:
            self.after_rebuild("the position was found anew")

    def _begin_track(self, now: float) -> None:
        state = self.state
        self.tracker.located = state.located = True
        state.waiting, state.located_at = "", now
        state.confirm = [now + s for s in CONFIRMED_AFTER if s < self.setup.options.lag]
        state.confirm.append(now + self.setup.options.lag)

    def _located_by_fixes(self, now: float) -> bool:
        """Begin without pings: fixes are linear, there is nothing to be looked for."""
        if any(self.tracker.buffer.of(kind) for kind in PINGS):
            return False
        if self.setup.options.node != "point" and not self.guarded(self.tracker.begin_at_fixes):
            return False
        moment = self.guarded(lambda: self.tracker.solved_at(now))
        if moment is None or not moment.covariance[:2, :2].diagonal().max() < FREE_SIGMA**2:
            return False
        self._begin_track(now)
        return True

    def _prior(self, now: float) -> Start | None:
        """What is known of the position where it was lost, beyond what a search looks at."""
        if not self.state.located or self.tracker.is_fresh:
            # All of it came from the records that are searched: it would count twice.
            return None
        moment = self.recent()
        if moment is None:
            return None
        dt = now - moment.t
        sigma = math.sqrt(max(float(np.linalg.eigvalsh(moment.covariance[:2, :2])[-1]), 0.0))
        drift = math.sqrt(max(float(np.trace(moment.covariance[3:5, 3:5])), 0.0)) * abs(dt)
        sigma = math.hypot(sigma, drift)
        if not 0.0 < sigma < 1e4:
            return None
        east, north, up = moment.mean[:3] + dt * moment.mean[3:]
        start = Start(now, float(east), float(north), float(up), sigma)
        return start if moment.rotation is None else with_heading(start, moment, dt)

    def _carry(self, found: Found) -> None:
        """Carry all tracks that a search found; their weights say what is doubtful."""
        self.state.ambiguous, self.state.rival = "", None
        self.spawn(found)

    def _is_due(self, now: float) -> bool:
        """Whether the track is to be put to the test."""
        state, tracker = self.state, self.tracker
        if state.confirm and now >= state.confirm[0]:
            return True
        since, pause = now - state.searched_at, self.setup.options.lag / 8.0
        if self.rivals or since < pause:
            return False
        if state.ambiguous:
            return True
        # Two tracks about one beacon may part while nothing is linearised for good.
        if not tracker.is_fresh or since < max(pause, (now - state.located_at) / LOOKS):
            return False
        return len({e.values[0] for kind in PINGS for e in tracker.buffer.of(kind)}) == 1

    def confirm(self, now: float) -> None:
        """Put a young or ambiguous track to the test: a search may find a better one."""
        state, tracker = self.state, self.tracker
        if not state.located or not self._is_due(now):
            return
        state.confirm = [t for t in state.confirm if t > now]
        if self.rivals and not tracker.is_fresh:
            return
        state.searched_at = now
        found = tracker.search()
        if not found.usable:
            return
        if tracker.is_fresh and not found.is_open:
            self._carry(found)
            return
        if self.guarded(lambda: tracker.adopt(found)):
            self.after_rebuild("a better track was found")
            self.regated()
        elif not found.ambiguous and (gap := self._apart(found)) is not None:
            away = float(np.hypot(*gap[:2]))
            state.ambiguous = f"ambiguous: the last pings alone ask for a place {away:.0f} m away"
            state.rival, state.rival_weight = gap, 0.5
            return
        self._doubt(found)

    def _doubt(self, found: Found) -> None:
        """Take note of whether a found track is the only one.

        The search looks at the last lag alone. Where a fix or a start has told on which side the
        vehicle is, another track counts only if the window's past does not speak against it.
        Without one the past knows no better: it was linearised about the track that is in doubt.
        """
        doubtful = found.ambiguous
        anchors = sum(self.gates[kind].accepted for kind in ("position", "set_position"))
        if doubtful and anchors and found.rival is not None:
            doubtful = not self.guarded(lambda: self.tracker.excludes(found))
        elif doubtful and anchors:
            doubtful = bool(self.state.ambiguous)
        self.state.ambiguous = found.reason if doubtful else ""
        self.state.rival = found.rival if doubtful else None
        self.state.rival_weight = found.rival_weight

    def _apart(self, found: Found) -> FloatArray | None:
        """How far a found track ends from the present one, m; None where its sigmas cover that."""
        assert found.result is not None
        track = found.result.segments[0].trajectory
        moment = self.guarded(lambda: self.tracker.moment(float(track.t[-1])))
        if moment is None:
            return None
        gap = track.position[-1] - moment.mean[:3]
        spread = track.covariance[-1][:2, :2] + moment.covariance[:2, :2]
        near = distance(gap[:2], spread) < 2.0 * limit(2) or float(np.hypot(*gap[:2])) < APART
        return None if near else gap

    def reopen(self, gate: Gate, now: float) -> None:
        """See, after many refusals, whether the vehicle stands elsewhere, as they say."""
        state = self.state
        if not gate.is_doubtful or 0.0 <= now - state.doubted_at < self.pause:
            return
        state.doubted_at = now
        here = [e for e in list(gate.refused)[-2 * REOPENS :] if self.tracker.holds(e)]
        here = [e for e in here if e.gated]
        if len(here) < REOPENS - 1:
            return
        pings = here[0].kind in PINGS
        jump = self.tracker.break_at if pings else self.tracker.jump_to
        if not self.guarded(lambda: jump(here)):
            return
        self.forget_rivals()
        told = "pings" if pings else "fixes"
        self.after_rebuild(f"the {told} contradicted the track")
        if not pings:
            self.readmitted(here, "the track was begun anew and agrees")
        self.regated()
        gate.recent.clear()

    def readmitted(self, entries: list[Entry], reason: str) -> None:
        """Tell of records that count again."""
        for entry in entries:
            if not entry.gated:
                self.gates[entry.kind].change_mind(entry)
                self.events.append(Event("readmitted", reason, entry.record, False))

    @property
    def pause(self) -> float:
        """Time between searches, s: they take as long as a hundred solves."""
        return max(1.0, self.setup.options.lag / 16.0)
