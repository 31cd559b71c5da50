"""The core: judges records by their stamps, then by their values, and solves."""

from __future__ import annotations

import math
from itertools import pairwise
from time import perf_counter

import numpy as np

from ubl_graph.online.buffer import ABSOLUTE, PINGS, Entry, entry_of
from ubl_graph.online.clock import MOST_HELD
from ubl_graph.online.finder import Finder
from ubl_graph.online.frame import CLOCK_STEP
from ubl_graph.online.gate import REOPENS, Gate, limit, step_distance
from ubl_graph.online.outputs import Event, Outcome

#: Without a ping the window is solved and moved on after so many seconds of records.
LONGEST_REST = 5.0
#: A position farther ahead of all records than this is no prediction, s.
FARTHEST = 3600.0
#: Before a silence's end records may be out of order by so much, s.
LEAP_SLACK = 5.0
#: After a silence of so many seconds and intervals of the most frequent sensor the clock is in
#: doubt.
SILENCE, SILENCE_INTERVALS = 1.0, 5.0
#: Vertical acceleration noise of a vehicle that begins to dive, m^2/s^3.
DIVE_PSD = 0.05
#: Vertical speed (m/s), and sudden step (m), of a vehicle whose height follows its depth sensor.
HEAVE = 0.5


class Core(Finder):
    """Takes records in."""

    def admit(self, entry: Entry) -> Outcome:
        """Judge a record by its stamps, then by its values."""
        if self.start is not None and entry.kind != "set_position":
            self._begin_from(entry)
        self._begin_clock(entry)
        if self.clock.is_far(entry, self.gates[entry.kind].interval):
            return self._held_back(entry)
        if self._is_behind(entry):
            return Outcome(not entry.gated, entry.reason, not entry.gated)
        twin = self.tracker.buffer.twin(entry)
        if twin is not None:
            return self._refused(
                entry, "duplicate", f"duplicate: a record of {entry.t:g} s is there"
            )
        age = self.clock.age(entry)
        if age > self.setup.options.lag:
            lag = self.setup.options.lag
            text = f"too old: {age:.1f} s before the newest record, the lag is {lag:g} s"
            return self._refused(entry, "too old", text)
        self._note_silence(entry)
        self.clock.tick(entry)
        outcome = self._take(entry)
        for due in self.clock.due():
            self._take_event(due)
        return outcome

    def _begin_from(self, entry: Entry) -> None:
        """Take the start prior in before the first record, if it is of the same time."""
        start, self.start = self.start, None
        assert start is not None
        if -self.setup.options.lag <= entry.begin - start.t <= FARTHEST:
            self.admit(entry_of(start))
            return
        note = (
            f"the start prior is {abs(entry.begin - start.t):g} s from the first record: left out"
        )
        self.noted(note, math.inf)

    def _note_silence(self, entry: Entry) -> None:
        """Say so where time went on with nothing heard: perhaps it was the clock alone."""
        now = self.clock.now
        if now is None:
            return
        ahead = entry.t - now
        intervals = [gate.interval for gate in self.gates.values() if gate.last is not None]
        usual = min((i for i in intervals if i is not None), default=math.inf)
        if ahead > max(SILENCE, SILENCE_INTERVALS * usual):
            note = f"nothing was heard for {ahead:.3g} s, or the clock was set ahead"
            self.noted(note, entry.t + self.setup.options.lag / 4.0)

    def _refused(self, entry: Entry, kind: str, reason: str) -> Outcome:
        self.gates[entry.kind].rejected[kind] += 1
        entry.reason = kind
        # Should the clock prove to have been set back, it will count after all.
        return Outcome(False, reason, final=entry not in self.clock.behind)

    def _held_back(self, entry: Entry) -> Outcome:
        """A record from far ahead: kept until its time comes, or until others confirm it."""
        now = self.clock.now
        assert now is not None
        ahead = entry.t - now
        if any(e.key == entry.key for e in self.clock.held):
            text = f"duplicate: there is a record of {entry.t:g} s that waits for its time"
            return self._refused(entry, "duplicate", text)
        run = self.clock.hold(entry)
        for old in self.clock.overflow():
            self.gates[old.kind].rejected["ahead"] += 1
            text = f"held back: its time did not come, and {MOST_HELD} more wait for theirs"
            self.events.append(Event("rejected", text, old.record, True))
        if not run:
            text = f"held back: {ahead:g} s ahead of the newest record; it waits for its time"
            return Outcome(False, text, final=False)
        note = f"the clock was set ahead by {ahead:g} s, or all sensors were silent"
        self.noted(note, run[-1].t + self.setup.options.lag)
        outcome = Outcome(True)
        for one in run:
            self.clock.tick(one)
            if one is entry:
                outcome = self._take(one)
            else:
                self._take_event(one)
        return outcome

    def _take_event(self, entry: Entry) -> None:
        """Take a record that was refused before."""
        if self.tracker.buffer.twin(entry) is not None:
            return
        outcome = self._take(entry)
        if outcome.accepted:
            self.events.append(Event("readmitted", "its time has come", entry.record, False))

    def _is_behind(self, entry: Entry) -> bool:
        """Whether a record proves that the clock was set back; then it has been taken."""
        clock = self.clock
        twin = self.tracker.buffer.twin(entry)
        if twin is not None and twin.equals(entry):
            return False  # sent once more, which says nothing of the clock
        gate = self.gates[entry.kind]
        too_old = clock.age(entry) > self.setup.options.lag
        strange = too_old or clock.is_strange(entry, gate.interval)
        run = clock.suspect(entry, strange, self._rate() if strange else 0.0)
        clock.note(entry)
        if not run:
            return False
        self._set_back(run)
        return True

    def _rate(self) -> float:
        """Records of all sensors that usually come, 1/s."""
        now = self.clock.now
        assert now is not None
        rate = 0.0
        for gate in self.gates.values():
            if len(gate.times) > 2 and now - min(gate.times) > 0.0:
                rate += (len(gate.times) - 1) / max(max(gate.times) - min(gate.times), 1e-3)
        return rate

    def _begin_clock(self, entry: Entry) -> None:
        """See that outputs of another time do not stop those of the first record's."""
        last = self.state.last_output
        if self.clock.now is None and last is not None and last - entry.t > self.setup.options.lag:
            self.state.last_output = None

    def _set_back(self, run: list[Entry]) -> None:
        """Move what is known back with the clock, and take the run of records behind it."""
        clock, tracker = self.clock, self.tracker
        assert clock.now is not None
        refused: list[Entry] = []
        taken: list[Entry] = []
        for entry in run:
            if tracker.buffer.twin(entry) is entry:
                tracker.buffer.remove(entry)
                taken.append(entry)
            else:
                self.gates[entry.kind].rejected[entry.reason] -= 1
                refused.append(entry)
        first = min(e.begin for e in run)
        slots = math.ceil((clock.now - first) / tracker.spacing)
        by = -slots * tracker.spacing
        tracker.shift(slots=-slots)
        for gate in self.gates.values():
            gate.shift(by)
        step = clock.now - first
        self.state.shift(by)
        clock.shift(by)
        if step > self.setup.options.lag:
            # Outputs begin anew on the new clock: they would have to wait for ever.
            self.state.last_output = None
        assert clock.now is not None
        self.noted(f"the clock was set back by {step:.3g} s", clock.now + self.setup.options.lag)
        joint = math.floor((clock.now + 1e-9) / tracker.spacing)
        if tracker.window is not None:
            tracker.window.touch_all()
            tracker.window.breaks[joint] = CLOCK_STEP
        self.set_rivals_back(taken, slots, joint)
        self.state.clock_steps += 1
        for entry in sorted(run, key=lambda e: e.t):
            entry.gated, entry.reason = False, ""
            clock.tick(entry)
            if any(entry is e for e in refused):
                self._take_event(entry)
            else:
                self._take(entry)

    def _take(self, entry: Entry) -> Outcome:
        self._leap_to(entry)
        if entry.kind in ABSOLUTE:
            return self._take_absolute(entry)
        gate = self.gates[entry.kind]
        away, dof = self._distance(entry)
        if away > limit(dof):
            entry.gated, entry.reason = True, f"gated: {away:.1f} sigma from what is expected"
            self.tracker.insert(entry)
            gate.refuse(entry)
            self._reopen_motion(gate)
        else:
            self.tracker.insert(entry)
            gate.accept(entry)
        self.follow(entry)
        self._advance()
        return Outcome(not entry.gated, entry.reason, not entry.gated)

    def _leap_to(self, entry: Entry) -> None:
        window = self.tracker.window
        if window is not None and entry.begin < window.begin:
            for tracker in (self.tracker, *(r.tracker for r in self.rivals)):
                tracker.begin_at(entry.begin)
        now = self.clock.now
        assert now is not None
        # The replies of other pings may have begun their flight as early as this one's.
        begin = min(entry.begin, now) - LEAP_SLACK - (entry.t - entry.begin)
        if window is not None and begin - window.end > self.setup.options.lag:
            self.guarded(lambda: self.tracker.leap(begin))
            for rival in list(self.rivals):
                self._each(rival, lambda tracker: tracker.leap(begin))

    def _advance(self) -> None:
        """Move the window on where there was no ping for a while."""
        now = self.clock.now
        assert now is not None
        self.tracker.extend(now)
        if now - self.state.solved_at < LONGEST_REST and now >= self.state.solved_at:
            return
        self.state.solved_at = now
        self.settle()
        self.refresh()
        self.state.moment = None

    def _distance(self, entry: Entry) -> tuple[float, int]:
        """Mahalanobis distance of a record of motion or depth from what is expected."""
        if entry.kind != "depth":
            before, after = self.tracker.buffer.neighbours(entry)
            near = before if before is not None else after
            return (0.0, 3) if near is None else step_distance(entry, near)
        if self.setup.options.node == "pose2":
            return self._depth_step(entry)
        m = self.recent()
        if m is None or self.state.waiting:
            return 0.0, 1
        dt = entry.t - m.t
        known = (
            m.covariance[2, 2]
            + 2.0 * dt * m.covariance[2, 5]
            + dt * dt * m.covariance[5, 5]
            + entry.values[2] ** 2
        )
        cube = abs(dt) ** 3 / 3.0
        psd = self.setup.options.vertical_psd
        variance = known + max(psd, DIVE_PSD) * cube
        arm = self.setup.vehicle.depth_sensor
        slack = 0.0 if arm.is_zero else float(np.linalg.norm(arm.body))
        away = max(abs(m.mean[2] + dt * m.mean[5] + entry.values[1]) - slack, 0.0)
        if self.setup.options.is_constant_velocity:
            # What a dive would excuse once the motion prior does not expect again and again.
            self.gates["depth"].surprises.append(away * away / max(known + psd * cube, 1e-12))
        return away / math.sqrt(max(variance, 1e-12)), 1

    def _depth_step(self, entry: Entry) -> tuple[float, int]:
        """Distance of a depth from the sensor's last one: a planar vehicle is held at them."""
        before, after = self.tracker.buffer.neighbours(entry)
        near = before if before is not None else after
        if near is None:
            return 0.0, 1
        dt = abs(entry.t - near.t)
        variance = entry.values[2] ** 2 + near.values[2] ** 2 + (HEAVE * dt) ** 2 + HEAVE**2
        return abs(entry.values[1] - near.values[1]) / math.sqrt(variance), 1

    def _reopen_motion(self, gate: Gate) -> None:
        """A sensor of motion that is refused again and again, and agrees with itself, is right."""
        run = gate.run[-REOPENS:]
        if len(run) < REOPENS:
            return
        if run[0].kind != "depth":
            steps = [step_distance(b, a) for a, b in pairwise(run)]
            if any(away > limit(dof) for away, dof in steps):
                return
        else:
            spread = np.ptp([e.values[1] for e in run])
            times = np.ptp([e.t for e in run])
            if spread > 5.0 * max(e.values[2] for e in run) + times:
                return
            self.noted("depth: the estimate was moved to what the sensor says", run[-1].t + 10.0)
        for entry in run:
            self.tracker.regate(entry, False)
            self.regate_rivals(entry)
        self.readmitted(run, "five in a row agree with each other")

    def _take_absolute(self, entry: Entry) -> Outcome:
        begin = perf_counter()
        now = self.clock.now
        assert now is not None
        gate = self.gates[entry.kind]
        since = now - self.state.solved_at
        self.state.solved_at = now
        self.settle()
        self.tracker.insert(entry)
        self.tracker.extend(now)
        if not self.state.located or self.state.waiting:
            gate.accept(entry)
            self.find(now)
        else:
            self.follow(entry)
            self._judge_absolute(entry, gate)
            self.weigh("another track fits better")
            self.confirm(now)
        self.state.moment = None
        self.latency.note(perf_counter() - begin, since)
        return Outcome(not entry.gated, entry.reason, not entry.gated)

    def _judge_absolute(self, entry: Entry, gate: Gate) -> None:
        """Judge a ping or fix with the window solved without it, then solve with it."""
        judged = self.guarded(lambda: self.tracker.judge(entry))
        if judged is None:
            gate.accept(entry)
            return
        away, dof = judged
        if entry.kind in PINGS and self.is_lost():
            # So vague a track has many ways to meet the pings: look for all of them.
            gate.accept(entry)
            self.state.waiting = "the position was lost; looking for it anew"
            self.state.lost_at = entry.begin
            self.find(entry.t)
            return
        elsewhere = any(rival.agrees for rival in self.rivals)
        if away > limit(dof) and elsewhere and entry.kind not in PINGS:
            # It tells for another track: this one pays for the difference.
            gate.accept(entry)
            self.tracker.regate(entry, False)
            self.guarded(self.tracker.solve)
            return
        if away > limit(dof) and entry.kind == "set_position":
            # Who sets a position knows better than the track.
            gate.accept(entry)
            self.forget_rivals()
            if self.guarded(lambda: self.tracker.jump_to([entry], anyway=True)):
                self.after_rebuild("the position was set")
                self.regated()
            return
        if away > limit(dof):
            self.tracker.regate(entry, True, f"gated: {away:.1f} sigma from what is expected")
            gate.refuse(entry)
            if not elsewhere:
                self.reopen(gate, entry.t)
            return
        gate.accept(entry, away * away / dof)
        self.guarded(lambda: self.tracker.solve(afar=self.tracker.is_wide))
