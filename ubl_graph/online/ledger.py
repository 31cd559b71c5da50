"""The ledger: buffer and window kept in step as records come and time goes on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.factors.odometry import longest_gap_of
from ubl_graph.factors.ranges import RangeBlock
from ubl_graph.mission import Setup
from ubl_graph.nodes import grid, grid_spacing, slot_of
from ubl_graph.online.buffer import HELD, PINGS, Buffer, Entry
from ubl_graph.online.elimination import RowsOf
from ubl_graph.online.engines import Context, engine_of
from ubl_graph.online.equations import Point, WindowEquations
from ubl_graph.online.frame import Break, Frame, frame_of
from ubl_graph.online.window import Window
from ubl_graph.pose_states import COMPASS_SIGMA
from ubl_graph.solve.banded import BandedFactor
from ubl_graph.solve.evidence import FARTHEST, OUTLIERS

#: Kinds of records that bring unknowns along where nodes are poses.
POSE_KINDS = ("attitude", "heading", "angular_rate", "odometry")
#: Acoustic metres per second, for words and widths.
METRES = 1500.0
#: Nodes are kept longer than the lag while pings bend too much, but so many at the most.
MOST_NODES = 1200
#: What the curvature of range circles may shift a window's pings by, in their sigmas together.
MOST_BENT = 0.03
#: The window keeps so many seconds more than the lag: neighbours of the oldest records.
MARGIN = 2.0


@dataclass(frozen=True, eq=False)
class Solved:
    """Where the window was solved last: its first node then, pings, rows, equations, and point."""

    first: int
    pings: Sequence[Entry]
    ranges: Sequence[RangeBlock]
    equations: WindowEquations
    point: Point


class Ledger:
    """Buffer, window and engine.

    Parameters
    ----------
    setup : Setup
        Beacons, sound speed, vehicle and options.

    Attributes
    ----------
    located : bool
        Whether there is a position.
    rebuilds : int
        Solves that failed, or contradicted what came after, and were begun anew.
    horizontal_sigma : float
        Of the newest node, when a ping was judged last, m.
    turned : list of Entry
        Records whose fate the last solves turned; who tells of them empties it.
    is_fresh : bool
        Whether no ping has left the window: nothing is linearised for good.
    past : float
        Logarithm of what has left the window leaves of the posterior's mass, while `is_weighed`.
    is_weighed : bool
        Whether that is kept.
    """

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        self.spacing = grid_spacing(setup.options)
        self.lag = setup.options.lag
        self.buffer = Buffer()
        self.window: Window | None = None
        self.located = False
        self.rebuilds = 0
        self.kinds: set[str] = set()
        self._engine = engine_of(setup.options.engine)
        self._solved: Solved | None = None
        self._factor: BandedFactor | None = None
        # Velocities that have come, and how many had when their pace was looked at last.
        self._velocities = self._paced = 0
        self._spread = 1.0
        # Counts what may change a window's pings, nodes or rows.
        self.version = 0
        self._judging: Context | None = None
        self.horizontal_sigma = 0.0
        self.turned: list[Entry] = []
        self.is_fresh, self.is_weighed, self.past = True, False, 0.0

    def restore_window(
        self,
        first: int,
        scales: tuple[float, float],
        x: FloatArray,
        common: FloatArray,
        prior: tuple[FloatArray, FloatArray],
        breaks: dict[int, Break],
        pristine: bool,
    ) -> None:
        """Put a window together again; its rows come from the buffer.

        Parameters
        ----------
        first : int
            Number of its first node.
        scales : (float, float)
            The heading's lasting error, rad, and the longest gap that velocities bridge, s.
        x, common : array
            Unknowns of the nodes (N, W), and of what they share.
        prior : (array, array)
            Rows and right-hand sides.
        breaks : dict of int to Break
            Where the vehicle may have jumped.
        pristine : bool
            Whether its first node is the very first one.
        """
        lasting, gap = scales
        frame = frame_of(self.setup, self.kinds, lasting, gap, self.spacing)
        self.window = Window.of(frame, self.buffer, first, x, common, prior)
        self.window.breaks, self.window.is_pristine = breaks, pristine
        self._velocities = len(self.buffer.of("velocity"))
        self._paced = self._velocities

    def take_window(self, window: Window) -> None:
        """Begin with a copy of another ledger's window, whose records are in the buffer."""
        self.window = window.copied(self.buffer)
        self._velocities = len(self.buffer.of("velocity"))
        self._paced = self._velocities

    def insert(self, entry: Entry) -> None:
        """Take a record into the buffer and mark what it changes."""
        self.version += 1
        self.buffer.add(entry)
        self._velocities += entry.kind == "velocity"
        self._learn(entry)
        if self.window is None:
            if entry.kind in ("attitude", "depth", "heading", "angular_rate"):
                return
            first = slot_of(entry.begin, self.spacing)
            self.window = Window(self._frame(), self.buffer, first)
        self._touch(entry)

    def regate(self, entry: Entry, gated: bool, reason: str = "") -> None:
        """Turn an entry's fate."""
        self.version += 1
        entry.gated, entry.reason = gated, reason
        self._touch(entry)

    def _touch(self, entry: Entry) -> None:
        window = self.window
        if window is None or entry.kind in PINGS:
            return
        begin, end = entry.begin, entry.t
        if entry.kind in HELD:
            before, after = self.buffer.neighbours(entry)
            begin = entry.t if before is None else before.t
            end = entry.t if after is None else after.t
            if entry.kind != "velocity":
                # It is held where there is none before or after it.
                begin = window.begin if before is None else begin
                end = window.end if after is None else end
                around = self.buffer.around("velocity", begin, end)
                begin = min([begin, *(e.t for e in around[:1])])
                end = max([end, *(e.t for e in around[-1:])])
        window.touch(begin, end)

    def _learn(self, entry: Entry) -> None:
        """Take in the unknowns that a new kind of record asks for."""
        before = len(self.kinds)
        posed = self.setup.options.node != "point"
        if entry.kind == "one_way_range" or (posed and entry.kind in POSE_KINDS):
            self.kinds.add(entry.kind)
        if posed and entry.kind == "velocity":
            self.kinds.add(entry.values[-1])
        elif entry.kind in ("velocity", "attitude") and self.buffer.of("attitude"):
            if entry.kind == "velocity":
                self.kinds.add(entry.values[-1])
            elif not {"bottom", "water"} & self.kinds:
                self.kinds.update(e.values[-1] for e in self.buffer.of("velocity"))
        if len(self.kinds) > before and self.window is not None:
            self.window.reframe(self._frame())
            self._forget()

    def _frame(self) -> Frame:
        entries = self.buffer.of("attitude")
        lasting = float(np.median([e.values[4] for e in entries])) if entries else 0.0
        if not entries and self.setup.options.node != "point" and self.buffer.of("heading"):
            lasting = COMPASS_SIGMA
        if self.window is not None and self.window.frame.lasting > 0.0:
            lasting = self.window.frame.lasting
        return frame_of(self.setup, self.kinds, lasting, self._gap(), self.spacing)

    def _gap(self) -> float:
        times = np.array([e.t for e in self.buffer.of("velocity")])
        return longest_gap_of(np.diff(times))

    def _forget(self) -> None:
        """What was solved holds no longer."""
        self.version += 1
        self._solved = self._factor = self._judging = None
        self._engine.forget()

    def begin_at(self, t: float) -> None:
        """Let the window begin earlier, at `t` (s), if its first node is the very first one."""
        window = self.window
        if window is None or not window.is_pristine:
            return
        slot = slot_of(t, self.spacing)
        earlier = Window(window.frame, self.buffer, slot)
        earlier.extend(window.end - self.spacing)
        back = grid(slot - window.first, window.first - slot, self.spacing)
        earlier.x[: len(back)] = window.predicted(window.x[0], back)
        earlier.x[len(back) :] = window.x
        earlier.up[:] = np.concatenate([np.repeat(window.up[:1], len(back)), window.up])
        earlier.common = window.common
        self.window = earlier
        self._forget()

    def leap(self, t: float) -> None:
        """Carry what is known over a silence to `t`, s."""
        window = self.window
        assert window is not None
        while window.count > 1:
            self._drop_first()
        self.past += window.leap(slot_of(t, self.spacing))
        self._forget()

    def extend(self, t: float) -> None:
        """Make nodes up to `t`, s."""
        if self.window is not None:
            count = self.window.count
            self.window.extend(t)
            self.version += self.window.count > count

    def holds(self, entry: Entry) -> bool:
        """Whether a record lies within the window."""
        window = self.window
        return (
            window is not None
            and self.buffer.twin(entry) is entry
            and entry.begin >= window.begin - 1e-9
        )

    def absolute_since(self, t: float) -> int:
        """Pings since `t` (s), a fix counted as three."""
        pings = sum(e.begin >= t for kind in PINGS for e in self.buffer.of(kind))
        marks = ("position", "set_position")
        return pings + 3 * sum(e.t >= t for kind in marks for e in self.buffer.of(kind))

    def leaving(self, t: float) -> list[Entry]:
        """Pings, depths and fixes that `trim` would part with when the newest record is at `t`."""
        if self.window is None:
            return []
        begin, end = self.window.begin - 1e-9, self._first_kept(t) * self.spacing - 1e-9
        leaving = [e for kind in PINGS for e in self.buffer.of(kind) if begin <= e.begin < end]
        for kind in ("depth", "position", "set_position"):
            leaving += self.buffer.between(kind, begin, end)
        return leaving

    def is_due(self, t: float) -> bool:
        """Whether nodes are older than the lag when the newest record is at `t`, s."""
        return self.window is not None and self._first_kept(t) > self.window.first

    def trim(self, t: float) -> None:
        """Let go what is older than the lag when the newest record is at `t`, s."""
        window = self.window
        if window is None:
            self.buffer.trim(t - self.lag - MARGIN)
            return
        if not self.is_due(t):
            return
        while self._first_kept(t) > window.first and window.count > 2:
            if window.count < MOST_NODES and self.bends(window.begin + self.spacing - 1e-9):
                break
            self._drop_first()
        self.buffer.trim(window.begin - MARGIN)

    def bends(self, before: float) -> bool:
        """Whether pings that begin before a time (s) are too curved to be linearised for good.

        Where the vehicle may be off by s across a range R, a linearised range is off by s^2 / 2R,
        the same way for all pings of the window. Rows of the past that were linearised at places
        that turned out wrong would claim to know the bearing.
        """
        window = self.window
        if window is None or not self.located:
            return False
        leaving = [e for e in window.usable() if e.begin < before]
        if not leaving:
            return False
        count = len(window.usable())
        limit = min(MOST_BENT * _straightness(e) / math.sqrt(count) for e in leaving)
        return self.horizontal_sigma**2 > limit and self.first_variance() > limit

    def first_variance(self) -> float:
        """Horizontal variance of the first node where the window was solved last, m^2."""
        solved = self._solved
        if solved is None:
            return self.horizontal_sigma**2
        if self._factor is None:
            self._factor = solved.equations.factor(solved.point)
        size = solved.equations.size
        at = (self.window.first - solved.first) * self.window.frame.width if self.window else 0
        unit = np.zeros((2, size))
        unit[0, at] = unit[1, at + 1] = 1.0
        columns = np.stack([self._factor.solve(u) for u in unit])
        return float(np.linalg.eigvalsh(columns[:, at : at + 2])[-1])

    def _first_kept(self, t: float) -> int:
        return slot_of(t - self.lag - MARGIN, self.spacing)

    def _drop_first(self) -> None:
        window = self.window
        assert window is not None
        if window.is_first_dirty:
            self._engine.note(window.refresh())
        self.version += 1
        before = window.begin + self.spacing - 1e-9
        if self.is_weighed:
            self.past -= self._price_of_leaving(before)
        leaving = self._rows_leaving(before)
        self.is_fresh &= not leaving
        self.past += window.drop(leaving)

    def _price_of_leaving(self, before: float) -> float:
        """What pings that leave cost a posterior's mass, beside the rows that remain of them."""
        window = self.window
        assert window is not None
        total = 0.0
        for entry, r, sigma in self.whitened():
            if window.begin - 1e-9 <= entry.begin < before:
                total += price(r, sigma)
                if not entry.gated:
                    total -= 0.5 * float(window.loss.weights(np.array([r]))[0]) * r * r
        return total

    def whitened(self) -> list[tuple[Entry, float, float]]:
        """Residuals, in sigmas, of all the window's pings, gated ones too, and those sigmas, s."""
        window = self.window
        assert window is not None
        out: list[tuple[Entry, float, float]] = []
        usable, x = window.usable(gated=True), window.vector
        for block in window.ranges(usable):
            kind = [e for e in usable if e.kind == block.name]
            held = block.frozen(x)
            r = block.evaluate(x, held, jacobian=False)[0][:, 0]
            out += [(e, float(a), float(s)) for e, a, s in zip(kind, r, held, strict=True)]
        return out

    def _rows_leaving(self, before: float) -> list[RowsOf]:
        """Linearised rows of the window's pings that begin before a time, s."""
        window = self.window
        assert window is not None
        if not self.located:
            return []
        leaving = [e for e in window.usable() if e.begin < before]
        solved = self._solved
        if solved is None or any(e not in solved.pings for e in leaving):
            ranges = window.ranges(leaving)
            x = window.vector
            kinds = [[e for e in leaving if e.kind == b.name] for b in ranges]
            parts = [(b.columns, *_raw(b, x, b.frozen(x))) for b in ranges]
        else:
            kinds = [[e for e in solved.pings if e.kind == b.name] for b in solved.ranges]
            parts = [
                (self._moved(b.columns, solved), *point)
                for b, point in zip(solved.ranges, solved.point.curved, strict=True)
            ]
        rows: list[RowsOf] = []
        for some, (columns, r, slope) in zip(kinds, parts, strict=True):
            at = [i for i, e in enumerate(some) if e in leaving]
            if at:
                root = np.sqrt(window.loss.weights(r[at]))
                rows.append(RowsOf(columns[at], root * r[at], root[:, None] * slope[at]))
        return rows

    def _moved(self, columns: IntArray, solved: Solved) -> IntArray:
        """Columns of a solved window where the nodes stand now."""
        window = self.window
        assert window is not None
        w = window.frame.width
        before, after = solved.equations.nodes * w, window.count * w
        inner = columns - (window.first - solved.first) * w
        return np.where(
            columns < 0, -1, np.where(columns < before, inner, columns - before + after)
        )

    def shift(self, slots: int) -> None:
        """Move all that is known by so many nodes: the clock was set."""
        by = slots * self.spacing
        self.buffer.shift(by)
        if self.window is not None:
            self.window.shift(slots)
        self._forget()


def price(residual: float, sigma: float) -> float:
    """What a ping costs the logarithm of a posterior's mass: normal noise, or an outlier's share.

    As `ubl_graph.solve.evidence` tells them, with a fixed share of outliers.

    Parameters
    ----------
    residual : float
        In standard deviations.
    sigma : float
        Standard deviation, s.
    """
    usual = 0.5 * residual**2 + math.log(math.sqrt(2.0 * math.pi) * sigma / (1.0 - OUTLIERS))
    return min(usual, math.log(2.0 * FARTHEST / OUTLIERS))


def _straightness(entry: Entry) -> float:
    """Twice the range times its standard deviation, m^2."""
    if entry.kind == "slant_range":
        distance, sigma = entry.values[2:4]
        return 2.0 * max(distance, 10.0) * sigma
    legs = 2.0 if entry.kind == "two_way_range" else 1.0
    flight = abs(entry.values[3]) if legs == 2.0 else abs(entry.values[2] - entry.values[1])
    reach = max(METRES * flight / legs, 10.0)
    return 2.0 * reach * METRES * entry.values[-1] / legs


def _raw(block: RangeBlock, x: FloatArray, held: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Whitened residuals (M,) and Jacobians (M, C) of a block."""
    r, slope = block.evaluate(x, held)
    assert slope is not None
    return r[:, 0], slope[:, 0]
