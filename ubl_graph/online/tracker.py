"""The tracker: the window solved and read.

It knows nothing of clocks, time-outs and outputs; that is the estimator's business.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.builder import SegmentModel
from ubl_graph.factors.ranges import RangeBlock
from ubl_graph.mission import Segment, Start
from ubl_graph.online.buffer import PINGS, Entry, columns_of
from ubl_graph.online.engines import Context
from ubl_graph.online.equations import Point
from ubl_graph.online.gate import distance, limit
from ubl_graph.online.ledger import Ledger, Solved, price
from ubl_graph.online.lm import minimise
from ubl_graph.online.pose_gap import place_of, pose_gap
from ubl_graph.online.rows import LEVEL, attitude_over
from ubl_graph.online.state import Moment, moment_at, tail_covariance, trajectory_of
from ubl_graph.online.window import Window
from ubl_graph.pose_trajectory import PoseStates
from ubl_graph.solve.banded import BandedFactor
from ubl_graph.solve.rounds import GRADUATION
from ubl_graph.trajectory import Trajectory

#: Steps of a solve at a ping; the next one goes on where it ends.
STEPS = 8
#: Steps of a solve from afar.
STEPS_AFAR = 60
#: Where a ping is expected this much less sharply than it measures, it pulls from its convex side.
WIDE = 20.0
#: A standard deviation that takes a row out of the equations, as a multiple of its own.
MUTED = 1e9
#: Rows of poses are made anew so often in a solve at the most; steps that would raise the cost by
#: more than this are halved so often.
ROUNDS, SLACK, HALVINGS = 12, 0.05, 6
#: After so many velocities their pace is looked at again.
LOOK_AT_PACE = 20

Solver = Callable[[Window, Context, FloatArray, int], Point]


class Tracker(Ledger):
    """Buffer, window and engine; solves what the ledger holds."""

    def judge(self, entry: Entry) -> tuple[float, int]:
        """Solve without a ping or fix that is in the buffer, and compare it with what is expected.

        The window stands solved without it afterwards.

        Returns
        -------
        float, int
            Mahalanobis distance and number of components.
        """
        if entry.kind not in PINGS:
            return self._judge_fix(entry)
        window = self._refreshed()
        self._spread = 1.0
        context = self._context(window)
        if not any(e is entry for e in context.pings):
            return 0.0, 1
        block, row = _place_of(entry, context.pings, context.ranges)
        frozen = context.equations.frozen
        muted = [held.copy() for held in frozen]
        muted[block][row] *= MUTED
        context.equations.frozen = muted
        x = window.vector
        point = context.equations.evaluate(x)
        factor = context.equations.factor(point)
        context.equations.frozen = frozen
        if window.is_touched:
            # Only linear rows have changed: one step is all but exact, and the solve goes on.
            x = x + factor.solve(-context.equations.gradient(point))
            for _ in range(ROUNDS):
                if not self._relinearised(x):
                    break
                # Those of poses are linear only where they were made.
                context = self._context(window, x)
                frozen = context.equations.frozen
                context.equations.frozen = muted
                point = context.equations.evaluate(x)
                factor = context.equations.factor(point)
                x = x + factor.solve(-context.equations.gradient(point))
                context.equations.frozen = frozen
            window.put(x)
            # What was solved last stands elsewhere now; nothing may be linearised by it.
            self._solved = self._factor = None
            point = context.equations.evaluate(x)
        else:
            point = context.equations.whitened_anew(point, block, row, MUTED)
        self._judging = replace(context, start=point)
        r, slope = (part[row] for part in point.curved[block])
        columns = context.ranges[block].columns[row]
        places = np.where(columns < 0, len(x), columns)
        line: FloatArray = np.zeros(len(x) + 1)
        np.add.at(line, places, slope)
        line = line[:-1]
        self._spread = 1.0 + float(np.einsum("i,i->", line, factor.solve(line)))
        last = tail_covariance(factor, window.frame.width, window.count * window.frame.width)
        self.horizontal_sigma = float(np.sqrt(np.linalg.eigvalsh(last[:2, :2])[-1]))
        return abs(float(r)) / np.sqrt(self._spread), 1

    def _context(self, window: Window, x: FloatArray | None = None) -> Context:
        """Rows and equations of all pings that count; `x`: where they are looked at."""
        pings = window.usable()
        ranges = window.ranges(pings)
        equations = window.equations(ranges)
        x = window.vector if x is None else x
        equations.frozen = [b.frozen(x) for b in ranges]
        return Context(window.first, self.version, pings, ranges, equations)

    def _judge_fix(self, entry: Entry) -> tuple[float, int]:
        """The same for a fix: its gap to the track is linear in the unknowns."""
        self._spread = 1.0
        self.regate(entry, True)
        self.solve()
        gap, covariance = self._fix_gap(entry)
        self.regate(entry, False)
        return distance(gap, covariance), len(gap)

    def _fix_gap(self, entry: Entry) -> tuple[FloatArray, FloatArray]:
        """From the track as it was solved last to a fix: gap (d,), m, and its covariance.

        Where a heading was set, too, its gap (rad) is the last component.
        """
        moment = self.moment(entry.t)
        self.horizontal_sigma = float(np.sqrt(np.linalg.eigvalsh(moment.covariance[:2, :2])[-1]))
        if moment.rotation is not None:
            return pose_gap(entry, moment, self.setup)
        lever = np.zeros(3)
        if isinstance(entry.record, Start):
            place, covariance = place_of(entry.record)
        else:
            place, covariance = entry.values[1][0], entry.values[2][0]
            track = attitude_over(self.buffer, entry.t, entry.t)
            arm = self.setup.vehicle.antenna
            if track is not None:
                lever = track.lever(arm, np.array([entry.t]))[0]
            elif not arm.is_zero:
                # Without attitude it does not count, and there is nothing to be judged.
                return np.zeros(len(place)), covariance
        d = len(place)
        return place - (moment.mean[:3] + lever)[:d], covariance + moment.covariance[:d, :d]

    @property
    def is_wide(self) -> bool:
        """Whether the ping judged last measures far more sharply than it was expected."""
        return self._spread > WIDE**2

    def solve(self, afar: bool = False) -> None:
        """Solve the window from where it is; `afar`: from the convex side of the loss."""
        window = self._refreshed()
        judged, self._judging = self._judging, None
        if judged is None or judged.version != self.version:
            judged = self._context(window)
        context, x = judged, window.vector
        if afar and context.ranges:
            frozen = context.equations.frozen
            for width in GRADUATION:
                context.equations.frozen = [width * held for held in frozen]
                context, point = self._settled(window, context, x, STEPS_AFAR, self._plainly)
                x = point.x
            context.equations.frozen = [b.frozen(x) for b in context.ranges]
            context = replace(context, start=None)
        most = STEPS_AFAR if afar else STEPS
        context, point = self._settled(window, context, x, most, self._engine.solve)
        window.put(point.x)
        self._keep(context, point)

    def _settled(
        self, window: Window, context: Context, x: FloatArray, most: int, solver: Solver
    ) -> tuple[Context, Point]:
        """Solve, with the rows of poses made anew until these stay where they were made.

        Steps that would raise the cost are halved. What was solved comes with the answer.
        """
        if not window.frame.is_posed:
            return context, solver(window, context, x, most)
        if self._relinearised(x):
            context = self._renewed(window, context)
        least = context.equations.evaluate(x, jacobian=False).cost
        for _ in range(ROUNDS):
            point = solver(window, context, x, most)
            if not self._relinearised(point.x):
                return context, point
            context = self._renewed(window, context)
            goal, cost = point.x, context.equations.evaluate(point.x, jacobian=False).cost
            for _ in range(HALVINGS):
                if cost <= least + SLACK:
                    break
                goal = 0.5 * (x + goal)
                self._relinearised(goal)
                context = self._renewed(window, context)
                cost = context.equations.evaluate(goal, jacobian=False).cost
            x, least = goal, min(cost, least)
        return context, context.equations.evaluate(x)

    def _relinearised(self, x: FloatArray) -> bool:
        """Make anew the rows of poses that `x` has left; whether there are any."""
        window = self.window
        assert window is not None
        changed = window.relinearise(x)
        if changed:
            self._engine.note(changed)
            self.version += 1
        return bool(changed)

    def _renewed(self, window: Window, context: Context) -> Context:
        """The same with the window's rows as they are now."""
        equations = window.equations(context.ranges)
        equations.frozen = context.equations.frozen
        return replace(context, version=self.version, equations=equations, start=None)

    @staticmethod
    def _plainly(window: Window, context: Context, x: FloatArray, most: int) -> Point:  # noqa: ARG004 - as engines
        """Minimise, whatever the engine."""
        return minimise(context.equations, x, most)

    def _keep(self, context: Context, point: Point) -> None:
        window = self.window
        assert window is not None
        self._solved = Solved(window.first, context.pings, context.ranges, context.equations, point)
        self._factor = None

    def cost_from(self, x: FloatArray) -> tuple[float, FloatArray]:
        """What the window would cost, all pings counted, solved from `x`; and where that ends."""
        window = self._refreshed()
        with self._opened():
            ranges = window.ranges(window.usable())
            equations = window.equations(ranges)
            equations.frozen = [b.frozen(x) for b in ranges]
            context = Context(window.first, self.version, window.usable(), ranges, equations)
            _, point = self._settled(window, context, x, STEPS_AFAR, self._plainly)
        return point.cost, point.x

    def _refreshed(self) -> Window:
        window = self.window
        assert window is not None
        news = self._velocities - self._paced
        if news >= LOOK_AT_PACE or (news and self._velocities < 2 * LOOK_AT_PACE):
            self._paced = self._velocities
            gap = self._gap()
            if abs(gap - window.frame.gap) > 1e-3 * gap:
                window.regap(gap)
        if window.is_dirty:
            self._engine.note(window.refresh())
        self._relinearised(window.vector)
        return window

    @property
    def is_stale(self) -> bool:
        """Whether records have come since the last solve."""
        return self.window is not None and (self.window.is_touched or self._solved is None)

    def factor(self) -> BandedFactor:
        """Factor of the normal matrix where the window was solved last."""
        assert self.window is not None
        solved, window = self._solved, self.window
        fits = (
            solved is not None
            and solved.first == window.first
            and solved.equations.nodes == window.count
        )
        if not fits:
            self._evaluate()
        if self._factor is None:
            assert self._solved is not None
            self._factor = self._solved.equations.factor(self._solved.point)
        return self._factor

    def _evaluate(self) -> None:
        """The equations where the window stands, for covariances."""
        window = self._refreshed()
        context = self._context(window)
        self._keep(context, context.equations.evaluate(window.vector))

    def recent(self, t: float) -> Moment | None:
        """Position and velocity at `t` (s), not before the last node of the last solve but one.

        What has come since is not in it: it takes no solve. None where there was none.
        """
        window, solved = self.window, self._solved
        if window is None or solved is None:
            return None
        if self._factor is None:
            self._factor = solved.equations.factor(solved.point)
        last = solved.first + solved.equations.nodes - 1
        ends = window.x[last - 1 - window.first : last + 1 - window.first]
        up = window.up[last - 1 - window.first : last + 1 - window.first]
        return moment_at(window.frame, self._factor, ends, up, last * self.spacing, t)

    def moment(self, t: float) -> Moment:
        """Position and velocity at `t` (s), in the window or ahead of it."""
        window = self.window
        assert window is not None
        factor = self.factor()
        if t >= window.end - self.spacing:
            ends, up = window.x[-2:], window.up[-2:]
            return moment_at(window.frame, factor, ends, up, window.end, t)
        states = trajectory_of(window, factor).at(max(t, window.begin))
        covariance = np.zeros((6, 6))
        covariance[:3, :3], covariance[3:, 3:] = states.covariance[0], states.velocity_covariance[0]
        mean = np.concatenate([states.position[0], states.velocity[0]])
        if isinstance(states, PoseStates):
            return Moment(t, mean, covariance, states.rotation[0], states.pose_covariance[0])
        return Moment(t, mean, covariance)

    def log_mass(self) -> float:
        """Logarithm of the posterior's mass about the window's track, but for a constant.

        Laplace's approximation over the window, and what has left it since `is_weighed`. Pings
        have normal noise there or are outliers, as for `ubl_graph.solve.evidence`.
        """
        if self.is_stale:
            self.solve()
        factor = self.factor()
        assert self._solved is not None
        point = self._solved.point
        squares = float(np.sum(point.linear**2) + np.sum(point.prior**2))
        pings = sum(price(r, sigma) for _, r, sigma in self.whitened())
        pivots = np.concatenate([factor.band[0], factor.corner.diagonal()])
        return self.past - 0.5 * squares - pings - float(np.log(pivots).sum())

    def trajectory(self) -> Trajectory:
        """The whole window with covariances."""
        assert self.window is not None
        return trajectory_of(self.window, self.factor())

    def residuals(self, pings: Sequence[Entry] | None = None) -> list[tuple[Entry, float]]:
        """Whitened residuals of some pings, or of all in the window, gated ones too."""
        window = self._refreshed()
        with self._opened():
            usable = window.usable()
            if pings is not None:
                usable = [e for e in usable if e in pings]
            x = window.vector
            out: list[tuple[Entry, float]] = []
            for block in window.ranges(usable):
                kind = [e for e in usable if e.kind == block.name]
                r, _ = block.evaluate(x, block.frozen(x), jacobian=False)
                out += [(e, float(v)) for e, v in zip(kind, r[:, 0], strict=True)]
        return out

    @contextmanager
    def _opened(self) -> Generator[None]:
        """Count gated pings in for a while."""
        gated = [e for kind in PINGS for e in self.buffer.of(kind) if e.gated]
        self.version += bool(gated)
        for entry in gated:
            entry.gated = False
        try:
            yield
        finally:
            for entry in gated:
                entry.gated = True

    def _residuals_kept(self, pings: Sequence[Entry]) -> list[tuple[Entry, float]]:
        """Whitened residuals of some pings, from the last solve where it holds them all."""
        solved = self._solved
        if solved is None or any(e not in solved.pings for e in pings):
            return self.residuals(pings)
        out: list[tuple[Entry, float]] = []
        for block, (r, _) in zip(solved.ranges, solved.point.curved, strict=True):
            kind = [e for e in solved.pings if e.kind == block.name]
            out += [(e, float(v)) for e, v in zip(kind, r, strict=True) if e in pings]
        return out

    def _depth_residuals(self, entries: Sequence[Entry]) -> list[tuple[Entry, float]]:
        """Whitened residuals of depths."""
        window = self.window
        assert window is not None
        some = [e for e in entries if e.kind == "depth" and window.begin <= e.t <= window.end]
        arm = self.setup.vehicle.depth_sensor
        if not some:
            return []
        times = np.array([e.t for e in some])
        track = None
        if not arm.is_zero:
            track = attitude_over(self.buffer, float(times.min()), float(times.max()))
            if track is None:
                return []
        layout = window.layout
        if window.frame.is_posed:
            builder = window.frame.builder(layout)
            segment = Segment(depth=columns_of("depth", some))
            model = SegmentModel(segment, window.times, LEVEL, None, None)
            rows = builder.depth_blocks(layout.chains[0], model)
            values = rows[0].evaluate(window.vector, jacobian=False)[0][:, 0] if rows else []
            return [(e, float(r)) for e, r in zip(some, values, strict=False)]
        at = layout.positions_at(layout.chains[0], times)
        up = (window.vector[at.columns[:, :, 2]] * at.weights).sum(axis=1)
        lever = np.zeros(len(times)) if track is None else track.lever(arm, times)[:, 2]
        return [
            (e, float(u + a + e.values[1]) / e.values[2])
            for e, u, a in zip(some, up, lever, strict=True)
        ]

    def chi_square(self) -> tuple[float, int]:
        """Sum of the weighted squared residuals of the window's pings, and how many there are."""
        if self._solved is None or self.window is None:
            return 0.0, 0
        total, count = 0.0, 0
        for r, _ in self._solved.point.curved:
            total += float(np.sum(self.window.loss.weights(r) * r * r))
            count += len(r)
        return total, count

    def solved_at(self, t: float) -> Moment:
        """Solve the window and say where that leaves the vehicle at `t`, s."""
        self.solve()
        return self.moment(t)

    def _judged(self, residuals: Sequence[tuple[Entry, float]]) -> bool:
        """Gate records by their residuals where the window stands; whether a fate turned."""
        turned = False
        for entry, r in residuals:
            bad = abs(r) > limit(1)
            if bad != entry.gated:
                self.regate(entry, bad, f"{abs(r):.1f} sigma from the track" if bad else "")
                self.turned.append(entry)
                turned = True
        return turned

    def rebuild(self) -> None:
        """Begin anew from the buffer and the prior of what is older: rows, engine, solution.

        Raises
        ------
        SolverError
            Where that fails, too.
        """
        window = self.window
        assert window is not None
        self.rebuilds += 1
        self._forget()
        window.touch_all()
        if not np.isfinite(window.vector).all():
            window.put(np.zeros_like(window.vector))
            self.located = False
            return
        self.solve(afar=True)

    def decide(self, t: float) -> None:
        """Judge the records that will leave by the track as it is now; solve again if that matters.

        `turned` tells whose fate turned.
        """
        leaving = [e for e in self.leaving(t) if e.kind in PINGS or e.kind == "depth"]
        if not leaving:
            return
        pings = [e for e in leaving if e.kind in PINGS]
        depths = self._depth_residuals(leaving)
        turned = self._judged([*self._residuals_kept(pings), *depths])
        if turned:
            self.solve()


def _place_of(
    entry: Entry, pings: Sequence[Entry], ranges: Sequence[RangeBlock]
) -> tuple[int, int]:
    """Block and row of a ping."""
    block = next(i for i, b in enumerate(ranges) if b.name == entry.kind)
    return block, [e for e in pings if e.kind == entry.kind].index(entry)
