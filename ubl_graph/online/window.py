"""A window of nodes on a regular grid: unknowns, rows, pings, and the prior that the past left.

Node k stands at k times the grid's spacing. What the records between two nodes say is held as
rows of that interval and made anew where a late record falls into it. A node that leaves the window
is eliminated by QR from all rows that touch it (a square root keeps what is weakly known, a
difference of normal equations does not); what remains is the prior of the nodes behind it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy, deepcopy
from dataclasses import replace

import numpy as np

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.attitude import AttitudeTrack
from ubl_graph.factors.block import LinearBlock
from ubl_graph.factors.loss import RobustLoss
from ubl_graph.factors.ranges import RangeBlock
from ubl_graph.layout import Layout
from ubl_graph.nodes import grid, slot_of
from ubl_graph.online.buffer import PINGS, Buffer, Entry, columns_of
from ubl_graph.online.elimination import (
    NearRows,
    RowsOf,
    columns_among,
    columns_known,
    embedded,
    leapt,
    near_rows,
    without_first,
)
from ubl_graph.online.equations import LinearRows, WindowEquations
from ubl_graph.online.forecast import predicted
from ubl_graph.online.frame import Break, Frame
from ubl_graph.online.pose_rows import linearised, tolerances
from ubl_graph.online.pose_state import (
    heights_of,
    is_turned,
    leap_block,
)
from ubl_graph.online.rows import LEVEL, attitude_over, interval_rows, triangle
from ubl_graph.pose_builder import PoseBuilder


class Window:
    """The nodes of the last lag.

    Parameters
    ----------
    frame : Frame
        What the unknowns are.
    buffer : Buffer
        The records.
    first : int
        Number of the first node.

    Attributes
    ----------
    first, count : int
        Number of the first node, and how many nodes there are (two at the least).
    x : array, shape (N, W)
        Nodes' unknowns in the layout's units.
    common : array, shape (B,)
        What all nodes share.
    up : array, shape (N,)
        Where planar nodes are held, m; zero for others.
    made_at : array, shape (N - 1, C)
        Where the rows of each interval of poses were made: two nodes, and what they share.
    breaks : dict of int to Break
        Intervals in which the vehicle may have jumped.
    is_pristine : bool
        Whether the first node is the very first one.
    """

    def __init__(self, frame: Frame, buffer: Buffer, first: int) -> None:
        self.frame, self._buffer = frame, buffer
        self.first, self.count = first, 2
        self.breaks: dict[int, Break] = {}
        self.is_pristine = True
        self.x = np.zeros((2, frame.width))
        self.common = np.zeros(frame.border)
        self.up = np.zeros(2)
        self.made_at = np.zeros((1, frame.interval))
        self.linear = LinearRows(frame.width, frame.border, frame.height)
        self._dirty: set[int] = {first}
        self._touched = True
        self._prior, self._prior_target = self._first_prior()
        self.loss = RobustLoss(frame.setup.options.loss)

    @classmethod
    def of(
        cls,
        frame: Frame,
        buffer: Buffer,
        first: int,
        x: FloatArray,
        common: FloatArray,
        prior: tuple[FloatArray, FloatArray],
    ) -> Window:
        """A window from its parts; its rows are made of the buffer's records."""
        window = cls(frame, buffer, first)
        window.linear.append(len(x) - 2)
        window.x, window.common, window.count = x, common, len(x)
        window.up = np.zeros(len(x))
        window.made_at = np.zeros((len(x) - 1, frame.interval))
        window._prior, window._prior_target = prior
        window.touch_all()
        return window

    def copied(self, buffer: Buffer) -> Window:
        """The same window, rows and all, over another buffer of the same records."""
        twin = copy(self)
        twin._buffer = buffer
        twin.x, twin.common, twin.up = self.x.copy(), self.common.copy(), self.up.copy()
        twin.made_at, twin.linear = self.made_at.copy(), deepcopy(self.linear)
        twin.breaks, twin._dirty = dict(self.breaks), set(self._dirty)
        return twin

    def restore_poses(self, up: FloatArray, made_at: FloatArray, dirty: Iterable[int]) -> None:
        """Put planar nodes where they were held, and rows of poses where they were made.

        Parameters
        ----------
        up : array, shape (N,)
            m.
        made_at : array, shape (N - 1, C)
            As the attribute.
        dirty : iterable of int
            Intervals that waited for their rows.
        """
        self.up = up
        for k, stands in enumerate(made_at):
            made = interval_rows(self.frame, self._buffer, self.first + k, 1, self.breaks, stands)
            self.linear.put(slice(k, k + 1), *made)
        self.made_at, self._dirty = made_at, set(dirty)

    # -- what it is --

    @property
    def times(self) -> FloatArray:
        """Node times, s."""
        return grid(self.first, self.count, self.frame.spacing)

    @property
    def end(self) -> float:
        """Time of the last node, s."""
        return self.frame.spacing * (self.first + self.count - 1)

    @property
    def begin(self) -> float:
        """Time of the first node, s."""
        return self.frame.spacing * self.first

    @property
    def layout(self) -> Layout:
        """Columns of the nodes as they are now."""
        return self.frame.layout(self.times, self.up)

    @property
    def last_position(self) -> FloatArray:
        """East, north, up of the last node, (3,), m."""
        if self.frame.is_planar:
            return np.array([*self.x[-1, :2], self.up[-1]])
        return self.x[-1, :3]

    @property
    def vector(self) -> FloatArray:
        """All unknowns, flat."""
        return np.concatenate([self.x.ravel(), self.common])

    def put(self, vector: FloatArray) -> None:
        """Take over a solver's answer, a flat vector."""
        self._touched = False
        inner = self.count * self.frame.width
        self.x, self.common = vector[:inner].reshape(self.count, -1).copy(), vector[inner:].copy()

    @property
    def prior(self) -> tuple[FloatArray, FloatArray]:
        """Rows (P, K) over the first nodes and what is shared, and their right-hand sides."""
        return self._prior, self._prior_target

    @property
    def is_dirty(self) -> bool:
        """Whether intervals wait for their rows."""
        return bool(self._dirty)

    @property
    def dirty(self) -> list[int]:
        """Numbers of the intervals that wait for their rows."""
        return sorted(self._dirty)

    @property
    def is_first_dirty(self) -> bool:
        """Whether the first interval waits for its rows."""
        return self.first in self._dirty

    @property
    def is_touched(self) -> bool:
        """Whether records have come since a solver put its answer: nodes may have to move."""
        return self._touched

    # -- how it changes --

    def touch(self, begin: float, end: float) -> None:
        """Records from `begin` to `end` (s) have changed: their intervals are made anew."""
        h = self.frame.spacing
        low = max(slot_of(begin, h), self.first)
        high = min(slot_of(end, h), self.first + self.count - 2)
        self._dirty.update(range(low, high + 1))
        self._touched = True

    def touch_all(self) -> None:
        """All intervals are made anew."""
        self._dirty.update(range(self.first, self.first + self.count - 1))
        self._touched = True

    def extend(self, t: float) -> None:
        """Add nodes until one stands behind `t` (s), where the motion prior expects them."""
        more = slot_of(t, self.frame.spacing) + 2 - self.first - self.count
        if more <= 0:
            return
        last = self.first + self.count - 1
        dt = grid(1, more, self.frame.spacing)
        self.x = np.concatenate([self.x, self.predicted(self.x[-1], dt)])
        self.up = np.concatenate([self.up, np.repeat(self.up[-1:], more)])
        self.made_at = np.concatenate([self.made_at, np.zeros((more, self.frame.interval))])
        self.linear.append(more)
        self._dirty.update(range(last, last + more))
        self.count += more

    def predicted(self, node: FloatArray, dt: FloatArray) -> FloatArray:
        """A node's unknowns (W,) carried ahead by times `dt` (M,), s: (M, W)."""
        return predicted(self.frame, node, dt)

    def refresh(self, x: FloatArray | None = None) -> set[int]:
        """Make the rows of changed intervals anew; which they were.

        Rows of poses are made where the flat vector `x` stands, or else the window.
        """
        changed = set(self._dirty)
        if not changed:
            return changed
        x = self.vector if x is None else x
        self._hold_up()
        w, inner = self.frame.width, self.count * self.frame.width
        for begin, count in _runs(self._dirty):
            low = begin - self.first
            stands = np.concatenate([x[low * w : (low + count + 1) * w], x[inner:]])
            rows, targets = interval_rows(
                self.frame, self._buffer, begin, count, self.breaks, stands
            )
            at = slice(low, low + count)
            self.linear.put(at, rows, targets)
            self.made_at[at] = self._ends(x)[at]
        self._dirty.clear()
        return changed

    def relinearise(self, x: FloatArray) -> set[int]:
        """Make anew the rows of poses that the flat vector `x` has left; which they were."""
        if not self.frame.is_posed:
            return set()
        w = self.frame.width
        place = 2 if self.frame.is_planar else 3
        strayed = self._ends(x) - self.made_at
        strayed[:, w : w + place] -= strayed[:, :place]
        strayed[:, :place] = 0.0
        far = (np.abs(strayed) > tolerances(self.frame)).any(axis=1)
        self._dirty.update(self.first + np.flatnonzero(far))
        return self.refresh(x)

    def _ends(self, x: FloatArray) -> FloatArray:
        """Each interval's two nodes, and what they share, out of a flat vector: (N - 1, C)."""
        inner = self.count * self.frame.width
        nodes = x[:inner].reshape(self.count, -1)
        shared = np.broadcast_to(x[inner:], (self.count - 1, self.frame.border))
        return np.concatenate([nodes[:-1], nodes[1:], shared], axis=1)

    def _hold_up(self) -> None:
        """Hold planar nodes where the depth sensor says, or else fixes, or who set a position."""
        heights = heights_of(self._buffer, self.frame.setup.vehicle)
        if not self.frame.is_planar or not len(heights):
            return
        t, up = heights.T
        fresh = (self.times >= t[0]) | self.is_pristine
        self.up[fresh] = np.interp(self.times[fresh], t, up)

    def drop(self, pings: Sequence[RowsOf]) -> float:
        """Eliminate the first node.

        Parameters
        ----------
        pings : sequence of RowsOf
            The rows of pings that touch its interval.

        Returns
        -------
        float
            Logarithm of what integrating it out leaves of the posterior's mass, but for a constant.
        """
        self.is_pristine = False
        frame = self.frame
        parts = [self._prior_rows(), NearRows(self.linear.rows[0], self.linear.targets[0], 2)]
        parts += [near_rows(rows, self.x, self.common) for rows in pings]
        self._prior, self._prior_target, log_mass = without_first(parts, frame.width, frame.border)
        self.first, self.count = self.first + 1, self.count - 1
        self.x, self.up, self.made_at = self.x[1:], self.up[1:], self.made_at[1:]
        self.linear.drop()
        self._dirty.discard(self.first - 1)
        self.breaks.pop(self.first - 1, None)
        return log_mass

    def leap(self, slot: int) -> float:
        """Carry the prior of a single node that is left to one far ahead, nothing in between.

        Returns
        -------
        float
            As `drop` does.
        """
        frame, ahead = self.frame, (slot - self.first) * self.frame.spacing
        start = self.predicted(self.x[0], np.array([ahead]))[0]
        layout = frame.layout(np.array([0.0, ahead]))
        blocks = frame.builder(layout).silent_blocks(layout.chains[0])
        if frame.is_posed:
            ends, up = np.stack([self.x[0], start]), np.repeat(self.up[:1], 2)
            blocks = [block for block in blocks if block.linear]
            blocks.append(leap_block(frame, ends, up, ahead))
        self._prior, self._prior_target, log_mass = leapt(
            self._prior_rows(), blocks, frame.width, layout.size
        )
        self.first, self.count = slot, 2
        self.up, self.made_at = np.repeat(self.up[:1], 2), np.zeros((1, frame.interval))
        self.x = np.stack([start, self.predicted(start, np.array([frame.spacing]))[0]])
        self.linear = LinearRows(frame.width, frame.border, frame.height)
        self.breaks.clear()
        self._dirty = {slot}
        return log_mass

    def shift(self, slots: int) -> None:
        """Move all nodes by so many places: the clock was set."""
        self.first += slots
        self._dirty = {k + slots for k in self._dirty}
        self.breaks = {k + slots: jump for k, jump in self.breaks.items()}

    def reframe(self, frame: Frame) -> None:
        """Take in further unknowns, with what is known of them beforehand."""
        before, after = self.layout, frame.layout(self.times)
        old_x, old_prior, old_target = self.vector, self._prior, self._prior_target
        old_nodes = (old_prior.shape[1] - self.frame.border) // self.frame.width
        vector = np.zeros(after.size)
        names = [name for name, _ in (*before.kinematic, *self.frame.slow)]
        for name in (*names, *(name for name, _ in self.frame.shared)):
            after.put(vector, name, before.get(old_x, name))
        first, shared = (
            columns_among(before, old_nodes),
            columns_among(after, old_nodes),
        )
        size = old_nodes * frame.width + frame.border
        rows = np.zeros((len(old_prior), size + 1))
        rows[:, [shared[key] for key in first]] = old_prior[:, list(first.values())]
        rows[:, -1] = old_target
        self.frame = frame
        fresh = [
            embedded(block, after, old_nodes)
            for block in self._prior_blocks()
            if not set(np.unique(block.columns)) & columns_known(before, after)
        ]
        stacked = np.concatenate([rows, *fresh])
        if len(stacked) > size:
            stacked = triangle(stacked)[:size]
        self._prior, self._prior_target = stacked[:, :-1], stacked[:, -1]
        self.put(vector)
        self.linear = LinearRows(frame.width, frame.border, frame.height)
        self.linear.append(self.count - 2)
        self.made_at = np.zeros((self.count - 1, frame.interval))
        self.touch_all()

    def regap(self, gap: float) -> None:
        """Let velocities join over another gap (s)."""
        self.frame = replace(self.frame, gap=gap)
        self.touch_all()

    # -- what a solver sees --

    def ranges(self, pings: Sequence[Entry]) -> list[RangeBlock]:
        """Residuals of pings, two-way and one-way, over the window's columns."""
        layout = self.layout
        builder = self.frame.builder(layout)
        out: list[RangeBlock] = []
        for kind in PINGS:
            some = [e for e in pings if e.kind == kind]
            if some:
                records = columns_of(kind, some)
                attitude = self._attitude_of(some)
                out.append(builder.range_block(layout.chains[0], records, attitude))
        return out

    def usable(self, *, gated: bool = False) -> list[Entry]:
        """Pings that count: inside the window, with an attitude where that is needed.

        `gated`: those too that a gate refused.
        """
        bare = self.frame.is_posed or self.frame.setup.vehicle.transducer.is_zero
        if not bare and not self._buffer.of("attitude"):
            return []
        begin, end = self.begin - 1e-9, self.end + 1e-9
        return [
            e
            for kind in PINGS
            for e in self._buffer.of(kind)
            if (gated or not e.gated) and e.begin >= begin and e.t <= end
        ]

    def equations(self, ranges: Sequence[RangeBlock]) -> WindowEquations:
        """The window's equations with some range blocks."""
        frame = self.frame
        return WindowEquations(
            frame.width, frame.border, self.linear, self.prior, ranges, self.loss
        )

    def interval_row(self, k: int) -> LinearBlock:
        """The rows of the interval after node number `k` as a block over the window's columns."""
        at, w = k - self.first, self.frame.width
        columns = np.concatenate([at * w + np.arange(2 * w), self._shared_columns()])
        size = self.frame.interval
        rows, targets = self.linear.rows[at, :size], self.linear.targets[at, :size]
        return LinearBlock("interval", columns[None], rows[None], targets[None])

    def prior_row(self) -> LinearBlock:
        """The prior's rows as a block over the window's columns."""
        nodes = (self._prior.shape[1] - self.frame.border) // self.frame.width
        own = np.arange(nodes * self.frame.width)
        columns = np.concatenate([own, self._shared_columns()])
        return LinearBlock("past", columns[None], self._prior[None], self._prior_target[None])

    def _shared_columns(self) -> IntArray:
        return self.count * self.frame.width + np.arange(self.frame.border)

    # -- inside --

    def _attitude_of(self, some: Sequence[Entry]) -> AttitudeTrack:
        """Held attitude over some pings, for the transducer's lever arm."""
        if self.frame.is_posed or self.frame.setup.vehicle.transducer.is_zero:
            return LEVEL
        track = attitude_over(self._buffer, min(e.begin for e in some), max(e.t for e in some))
        assert track is not None
        return track

    def _prior_blocks(self) -> list[LinearBlock]:
        """What is known of the first node and of what is shared before any measurement."""
        builder, x = self.frame.builder(self.layout), self.vector
        chain = self.layout.chains[0]
        blocks = [*builder.first_priors(chain), *builder.shared_priors()]
        if isinstance(builder, PoseBuilder) and not is_turned(self._buffer):
            blocks.append(builder.forward(chain))
        return [linearised(b, x) for b in blocks]

    def _first_prior(self) -> tuple[FloatArray, FloatArray]:
        rows = np.concatenate([embedded(b, self.layout, 1) for b in self._prior_blocks()])
        return rows[:, :-1], rows[:, -1]

    def _prior_rows(self) -> NearRows:
        nodes = (self._prior.shape[1] - self.frame.border) // self.frame.width
        return NearRows(self._prior, self._prior_target, nodes)


def _runs(numbers: Iterable[int]) -> list[tuple[int, int]]:
    """Runs of consecutive numbers: first and count of each."""
    runs: list[tuple[int, int]] = []
    for k in sorted(numbers):
        if runs and k == runs[-1][0] + runs[-1][1]:
            runs[-1] = (runs[-1][0], runs[-1][1] + 1)
        else:
            runs.append((k, 1))
    return runs
