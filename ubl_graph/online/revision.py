"""The track put in question: found anew, compared with another, let jump."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.mission import Start
from ubl_graph.nodes import slot_of
from ubl_graph.online.buffer import Entry
from ubl_graph.online.frame import Break
from ubl_graph.online.gate import distance, limit
from ubl_graph.online.ledger import MARGIN, METRES
from ubl_graph.online.pose_search import is_headed, seeded
from ubl_graph.online.search import Found, placed, search
from ubl_graph.online.tracker import STEPS_AFAR, Tracker
from ubl_graph.solve.rounds import GRADUATION

#: A track found anew replaces the present one where its cost is lower by more than this.
BETTER_COST = 3.0
#: Tracks that end nearer to each other than this are one, m.
SAME_PLACE = 20.0
#: So many of the pings since a jump must agree with the track behind it, as a share.
AGREEING = 0.6
#: What a jump must save, in cost: its own price, and odds of thousands to one.
BREAK_COST = 12.0
#: Nearest to which the vehicle may have stepped at a break, m, in multiples of what was refused.
LEAST_STEP, STEP_FACTOR = 10.0, 3.0


class Reviser(Tracker):
    """A tracker that can begin anew elsewhere."""

    def search(self, start: Start | None = None) -> Found:
        """Look for the position in all that the buffer holds."""
        window = self.window
        assert window is not None
        begin = window.begin
        if not self.is_fresh:
            begin = max(begin, window.end - self.spacing - self.lag - MARGIN)
        return search(self.setup, self.buffer, self.spacing, begin, start)

    def begin_at_fixes(self) -> bool:
        """Put poses where fixes and a heading reference say; False where the heading is unknown."""
        window = self._refreshed()
        if not is_headed(self.buffer):
            return False
        window.put(seeded(window, self.buffer))
        window.touch_all()
        self._forget()
        return True

    def adopt(self, found: Found, anew: bool = False) -> bool:
        """Go on from a found track where that fits better than the present one; whether it did.

        `anew`: there is no present one to trust.
        """
        window = self._refreshed()
        cost, x = self.cost_from(placed(window, found))
        if not anew and cost > self.cost_from(window.vector)[0] - BETTER_COST:
            return False
        window.put(x)
        self._engine.forget()
        self.located = True
        self._judged(self.residuals())
        self.solve()
        return True

    def excludes(self, found: Found) -> bool:
        """Whether the window's cost speaks against the other track that a search found."""
        window = self._refreshed()
        present, here = self.cost_from(window.vector)
        cost, there = self.cost_from(placed(window, found.track(1)))
        end = slice((window.count - 1) * window.frame.width, None)
        gap = float(np.hypot(*(there[end] - here[end])[:2]))
        return cost > present + BETTER_COST or gap < SAME_PLACE

    def break_at(self, refused: Sequence[Entry]) -> bool:
        """Let the vehicle have jumped before some refused pings; whether that explains them.

        The track behind the jump is looked for from where it is and from nothing; it is taken
        where it lowers the cost of all pings by more than a jump is worth, and most pings since
        then agree with it.
        """
        window = self._refreshed()
        saved, breaks = window.vector, dict(window.breaks)
        begin = max(min(e.begin for e in refused), window.begin)
        present, _ = self.cost_from(saved)
        sizes = [abs(r) * self._metres(e) for e, r in self.residuals(refused)]
        slot = max(slot_of(begin, self.spacing) - 1, window.first)
        window.breaks[slot] = Break(max(LEAST_STEP, STEP_FACTOR * max(sizes, default=0.0)))
        window.touch(slot * self.spacing, slot * self.spacing)
        guesses = [saved]
        found = search(self.setup, self.buffer, self.spacing, begin)
        if found.usable:
            guesses.append(placed(window, found, slot + 1))
        cost, x = min((self.cost_from(self._from_afar(g)) for g in guesses), key=lambda c: c[0])
        window.put(x)
        since = [abs(r) < limit(1) for e, r in self.residuals() if e.begin >= begin]
        if cost < present - BREAK_COST and np.mean(since) >= AGREEING:
            self.rebuilds += 1
            self._forget()
            self._judged(self.residuals())
            self.solve()
            return True
        window.put(saved)
        window.breaks = breaks
        window.touch(slot * self.spacing, slot * self.spacing)
        self._forget()
        return False

    def jump_to(self, marks: Sequence[Entry], anyway: bool = False) -> bool:
        """Let the vehicle have jumped to where refused fixes say; whether they agree on it.

        `anyway`: someone said so, and whether the pings since agree does not matter.
        """
        window = self._refreshed()
        saved, breaks = window.vector, dict(window.breaks)
        begin = max(min(e.t for e in marks), window.begin)
        slot = max(slot_of(begin, self.spacing) - 1, window.first)
        window.breaks[slot] = self._jump_to_marks(marks)
        window.touch(slot * self.spacing, slot * self.spacing)
        for entry in marks:
            self.regate(entry, False)
        self.solve(afar=True)
        agree = [distance(*g) <= limit(len(g[0])) for g in map(self._fix_gap, marks)]
        since = [abs(r) < limit(1) for e, r in self.residuals() if e.begin >= begin]
        if anyway or (np.mean(agree) >= AGREEING and np.mean(since or [1.0]) >= AGREEING):
            self.rebuilds += 1
            self._judged(self.residuals())
            self.solve()
            return True
        for entry in marks:
            self.regate(entry, True, entry.reason)
        window.put(saved)
        window.breaks = breaks
        window.touch(slot * self.spacing, slot * self.spacing)
        self._forget()
        return False

    def _jump_to_marks(self, marks: Sequence[Entry]) -> Break:
        """The jump that takes the vehicle to where fixes, or someone, say that it is."""
        far, turned = LEAST_STEP, Break.rotation
        for entry in marks:
            gap = self._fix_gap(entry)[0]
            headed = isinstance(entry.record, Start) and entry.record.heading is not None
            if headed:
                gap, turned = gap[:-1], max(turned, STEP_FACTOR * abs(float(gap[-1])))
            far = max(far, STEP_FACTOR * float(np.linalg.norm(gap)))
        return Break(far, rotation=turned)

    def _from_afar(self, x: FloatArray) -> FloatArray:
        """Approach the window's least cost from the loss' convex side, all pings counted."""
        window = self._refreshed()
        with self._opened():
            context = self._context(window)
            for width in GRADUATION:
                context.equations.frozen = [width * b.frozen(x) for b in context.ranges]
                context, point = self._settled(window, context, x, STEPS_AFAR, self._plainly)
                x = point.x
        return x

    @staticmethod
    def _metres(entry: Entry) -> float:
        """Metres of a sigma of a ping."""
        legs = 2.0 if entry.kind == "two_way_range" else 1.0
        return entry.values[-1] * METRES / legs
