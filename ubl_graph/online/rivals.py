"""Rivals: other tracks that fit, carried beside the estimator's own until one of them wins.

Each is a window of its own that takes in the same records and gates pings by its own track. Its
weight is its posterior probability among those carried: the mass about its window's minimum, by
Laplace's approximation, with what has left the window since the tracks parted. A rival is let go
when its weight falls below `KEPT`. The heaviest takes the track's place when that is the wrong one
by odds of 20 to 1: a position that changes sides at every ping serves nobody.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.hypotheses import APART, COVERED_SIGMAS, HOLDS, KEPT
from ubl_graph.online.buffer import PINGS, Entry
from ubl_graph.online.frame import CLOCK_STEP
from ubl_graph.online.gate import limit
from ubl_graph.online.keeper import Keeper, Rival
from ubl_graph.online.outputs import Place, sound
from ubl_graph.online.revision import Reviser
from ubl_graph.online.search import Found
from ubl_graph.online.state import Moment
from ubl_graph.trajectory import Trajectory

#: So many tracks are carried beside the estimator's own at the most: each costs as much as it.
MOST_CARRIED = 3
#: By chance the pings to one beacon speak for either side of a vehicle that keeps its course: the
#: noise of its odometry is taken for a shape. The logarithm of the odds then scatters by no more
#: than the root of their number; what lies within so many times that says nothing.
CHANCE = 2.0


class Rivals(Keeper):
    """Carries other tracks that fit."""

    def settle(self) -> None:
        """Decide on the records that leave the windows, and let them move on."""
        super().settle()
        now = self.clock.now
        assert now is not None
        for rival in list(self.rivals):
            self._each(rival, lambda tracker: _settled(tracker, now))

    def spawn(self, found: Found) -> None:
        """Carry on all tracks that a search found, each in a window of its own.

        None of the pings may have left the window: what was linearised about one track does not
        hold for another.
        """
        assert found.result is not None
        window = self.tracker.window
        assert window is not None
        if not self.rivals:
            self.tracker.is_weighed, self.tracker.past = True, 0.0
            self.state.weighed_pings = len(window.usable())
        for number, hypothesis in enumerate(found.result.segments[0].hypotheses):
            if len(self.rivals) == MOST_CARRIED:
                break
            carried = [self.tracker, *(r.tracker for r in self.rivals)]
            if not any(is_on(tracker, hypothesis.trajectory) for tracker in carried):
                self._try(found.track(number))
        self.weigh("a better track was found")

    def _try(self, found: Found) -> None:
        """Carry a track, if it leads to another place than those that are carried already."""
        try:
            twin = copied(self.tracker)
            twin.adopt(found, anew=True)
        except Exception:
            return  # a solver that fails here has found nothing
        carried = [self.tracker, *(r.tracker for r in self.rivals)]
        if all(farthest(twin, other) > APART for other in carried):
            twin.turned = []
            self.rivals.append(Rival(twin))

    def follow(self, entry: Entry) -> None:
        """Take a record into the rivals' windows; a ping or fix is judged by each."""
        self.state.weighed_pings += bool(self.rivals) and entry.kind in PINGS
        for rival in list(self.rivals):
            self._each(rival, lambda tracker, r=rival: self._taken(r, tracker, entry))

    def _taken(self, rival: Rival, tracker: Reviser, entry: Entry) -> None:
        now = self.clock.now
        assert now is not None
        if entry.kind in PINGS or entry.kind in ("position", "set_position"):
            own = replace(entry, gated=False, reason="")
            tracker.insert(own)
            tracker.extend(now)
            away, dof = tracker.judge(own)
            rival.agrees = bool(away <= limit(dof))
            if entry.kind in PINGS and not rival.agrees:
                # Fixes always count here: a track that they contradict pays for it.
                tracker.regate(own, True, f"gated: {away:.1f} sigma from what is expected")
            tracker.solve(afar=tracker.is_wide)
        else:
            tracker.insert(replace(entry))
            tracker.extend(now)

    def regate_rivals(self, entry: Entry) -> None:
        """Let a record of motion that counts again count in the rivals' windows, too."""
        for rival in self.rivals:
            twin = rival.tracker.buffer.twin(entry)
            if twin is not None:
                rival.tracker.regate(twin, entry.gated)

    def set_rivals_back(self, taken: Sequence[Entry], slots: int, joint: int) -> None:
        """Move the rivals back with the clock, by so many nodes.

        Parameters
        ----------
        taken : sequence of Entry
            Records behind the step that were taken before it, and come again.
        slots : int
            How many nodes.
        joint : int
            Number of the interval in which the clock was set.
        """
        for rival in list(self.rivals):
            self._each(rival, lambda tracker: _set_back(tracker, taken, slots, joint))

    def weigh(self, note: str) -> None:
        """Weigh the tracks; let go what is too unlikely, and leave one that no longer holds.

        `note`: what to say then.
        """
        if not self.rivals:
            return
        own = self.guarded(self.tracker.log_mass)
        if own is None:
            self.forget_rivals()
            return
        masses = [own]
        for rival in list(self.rivals):
            mass = self._each(rival, lambda tracker: tracker.log_mass())
            if mass is not None:
                masses.append(mass)
        weights = _weights(np.array(masses), self.state.weighed_pings)
        for rival, weight in zip(self.rivals, weights[1:], strict=True):
            rival.weight = float(weight)
        self.rivals.sort(key=lambda r: -r.weight)
        if self.rivals and weights[0] <= 1.0 - HOLDS:
            self._go_over(float(weights[0]), note)
        self._let_go()
        self._tell()

    def _go_over(self, weight: float, note: str) -> None:
        """Let the heaviest rival and the estimator's own track change places."""
        before, rival = self.tracker, self.rivals[0]
        self.tracker, rival.tracker = rival.tracker, before
        rival.weight, rival.agrees = weight, False
        self.tracker.located = True
        turned = [
            (e, before.buffer.twin(e)) for kind in PINGS for e in self.tracker.buffer.of(kind)
        ]
        self.tracker.turned = [e for e, old in turned if old is None or old.gated != e.gated]
        self.regated()
        self.after_rebuild(note)
        self.state.moment = None

    def _let_go(self) -> None:
        kept: list[Rival] = []
        for rival in self.rivals:
            others = [self.tracker, *(r.tracker for r in kept)]
            same = any(farthest(rival.tracker, other) <= APART for other in others)
            if rival.weight >= KEPT and not same:
                kept.append(rival)
        self.rivals = kept
        if not kept:
            self.forget_rivals()

    def _tell(self) -> None:
        self.state.rival = None
        self.state.ambiguous = ""
        if self.rivals:
            first = self.rivals[0]
            away = farthest(first.tracker, self.tracker)
            self.state.ambiguous = (
                f"ambiguous: another track, up to {away:.0f} m away, fits as well "
                f"(weight {first.weight:.2g})"
            )

    def forget_rivals(self) -> None:
        """Carry the estimator's own track alone."""
        self.rivals = []
        self.tracker.is_weighed, self.tracker.past = False, 0.0
        self.state.weighed_pings = 0

    def _each(self, rival: Rival, work: Callable[[Reviser], Any]) -> Any:
        """What `work` gives; a rival whose solver fails is let go, and None comes back."""
        try:
            return work(rival.tracker)
        except Exception:
            self.rivals.remove(rival)
        return None

    # -- what they say --

    def places(self, moment: Moment) -> tuple[Place, ...]:
        """Where the vehicle may be at a moment of the estimator's own track, that first.

        Empty where there is but one such place.
        """
        others = self._others(moment)
        if not others:
            return ()
        weight = 1.0 - sum(w for w, _ in others)
        return tuple(
            Place(m.mean[:3], m.mean[3:], m.covariance, w) for w, m in [(weight, moment), *others]
        )

    def _others(self, moment: Moment) -> list[tuple[float, Moment]]:
        """Weight and moment of each rival."""
        if self.state.ambiguous and not self.rivals and self.state.rival is not None:
            mean = moment.mean.copy()
            mean[:3] += self.state.rival
            return [(self.state.rival_weight, replace(moment, mean=mean))]
        others: list[tuple[float, Moment]] = []
        for rival in list(self.rivals):
            other = self._each(rival, lambda tracker: tracker.moment(moment.t))
            if other is not None and sound(other):
                others.append((rival.weight, other))
        return others

    def ambiguity(self, positions: FloatArray, times: FloatArray) -> FloatArray | None:
        """What other places add to the covariances at (M, 3) and times (M,): (M, 3, 3).

        The second moment about the place that is given, each place by its weight.
        """
        if not self.rivals:
            return super().ambiguity(positions, times)
        wide = np.zeros((len(positions), 3, 3))
        for rival in list(self.rivals):
            track = self._each(rival, lambda tracker: tracker.trajectory())
            if track is None:
                continue
            inside = (times >= track.t[0]) & (times <= track.t[-1])
            gap = np.zeros_like(positions)
            gap[inside] = track.at(times[inside]).position - positions[inside]
            for k in np.flatnonzero(~inside):
                gap[k] = rival.tracker.moment(float(times[k])).mean[:3] - positions[k]
            wide += rival.weight * (gap[:, :, None] * gap[:, None, :])
        return wide


def _weights(masses: FloatArray, pings: int) -> FloatArray:
    """Posterior weights by logarithms of masses, but for what may be chance (`CHANCE`)."""
    behind = masses - masses.max()
    weights: FloatArray = np.exp(np.minimum(behind + CHANCE * pings**0.5, 0.0))
    return weights / weights.sum()


def _settled(tracker: Reviser, now: float) -> None:
    if tracker.is_due(now):
        tracker.decide(now)
        tracker.turned = []
    tracker.trim(now)


def _set_back(tracker: Reviser, taken: Sequence[Entry], slots: int, joint: int) -> None:
    for entry in taken:
        twin = tracker.buffer.twin(entry)
        if twin is not None:
            tracker.buffer.remove(twin)
    tracker.shift(slots=-slots)
    assert tracker.window is not None
    tracker.window.touch_all()
    tracker.window.breaks[joint] = CLOCK_STEP


def copied(tracker: Reviser) -> Reviser:
    """A tracker with the same records and window, which goes its own way."""
    twin = Reviser(tracker.setup)
    for entry in tracker.buffer.all():
        twin.buffer.add(replace(entry))
    twin.kinds, twin.located = set(tracker.kinds), tracker.located
    twin.horizontal_sigma = tracker.horizontal_sigma
    twin.is_fresh, twin.is_weighed, twin.past = tracker.is_fresh, tracker.is_weighed, tracker.past
    window = tracker.window
    assert window is not None
    twin.take_window(window)
    return twin


def is_on(tracker: Reviser, track: Trajectory) -> bool:
    """Whether a tracker follows a track already: half of what sets two hypotheses apart."""
    window = tracker.window
    assert window is not None
    times = window.times
    here = np.stack([np.interp(track.t, times, axis) for axis in window.x[:, :2].T], axis=1)
    sigma = np.sqrt(np.linalg.eigvalsh(track.covariance[:, :2, :2])[:, -1])
    gap = np.linalg.norm(track.position[:, :2] - here, axis=1)
    return bool((gap <= np.maximum(APART, 0.5 * COVERED_SIGMAS * sigma)).all())


def farthest(one: Reviser, other: Reviser) -> float:
    """How far two trackers' tracks are from each other where they are farthest, m."""
    a, b = one.window, other.window
    assert a is not None
    assert b is not None
    first, last = max(a.first, b.first), min(a.first + a.count, b.first + b.count)
    if last <= first:
        return float("inf")
    ways = 2 if a.frame.is_planar else 3
    gap = (
        a.x[first - a.first : last - a.first, :ways] - b.x[first - b.first : last - b.first, :ways]
    )
    return float(np.linalg.norm(gap, axis=1).max())
