"""The engine `isam2`: GTSAM's incremental fixed-lag smoother kept in step with the window.

An interval's linear rows are one factor, replaced where a late record changes them; a ping is one
wrapped custom factor (`ubl_graph.gtsam_view`). Beacons that are not estimated are constants: keys
that live for ever make the smoother slow. After a failure, or where the window was begun anew, the
smoother is filled from the window again: its prior, intervals and pings.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.errors import SolverError
from ubl_graph.factors.block import LinearBlock
from ubl_graph.factors.ranges import RangeBlock
from ubl_graph.gtsam_view import GraphView, keys_of
from ubl_graph.online.buffer import PINGS, Entry
from ubl_graph.online.engines import Context
from ubl_graph.online.equations import Point
from ubl_graph.online.window import Window
from ubl_graph.problem import Problem

#: Node numbers under GTSAM's keys begin here: a key has no room for a sign.
OFFSET = 1 << 48
#: A variable is linearised anew when it has moved by this, in its column's unit.
RELINEARIZE = 1e-4
#: Updates after new factors, until nothing moves by more than this.
SETTLED, MOST_UPDATES = 1e-6, 10


@dataclass
class _Held:
    """A ping's factor in the smoother."""

    entry: Entry
    slot: int


class Isam2Engine:
    """Keeps `gtsam.IncrementalFixedLagSmoother` in step with a window."""

    def __init__(self) -> None:
        self._smoother: gtsam.IncrementalFixedLagSmoother | None = None
        self._changed: set[int] = set()
        self._intervals: dict[int, int] = {}
        self._pings: list[_Held] = []
        self._nodes: range = range(0)

    def note(self, changed: set[int]) -> None:
        """Take note of intervals whose rows were made anew."""
        self._changed |= changed

    def forget(self) -> None:
        """Begin anew with the next window."""
        self._smoother = None

    def solve(
        self,
        window: Window,
        context: Context,
        x: FloatArray,
        most: int,  # noqa: ARG002 - the protocol's form
    ) -> Point:
        """Bring the smoother up to date and read the nodes off it.

        Raises
        ------
        SolverError
            Where GTSAM gives up, with a fresh smoother too.
        """
        fresh = self._smoother is None
        try:
            found = self._updated(window, context, x)
        except (RuntimeError, IndexError) as error:
            self.forget()
            if fresh:
                text = " ".join(str(error).split())[:160]
                raise SolverError(f"GTSAM's smoother gave up: {text}") from error
            try:
                found = self._updated(window, context, x)
            except (RuntimeError, IndexError) as again:
                self.forget()
                text = " ".join(str(again).split())[:160]
                raise SolverError(f"GTSAM's smoother gave up: {text}") from again
        if not np.isfinite(found).all():
            self.forget()
            raise SolverError("GTSAM's smoother ended in values that are not finite")
        return context.equations.evaluate(found)

    def _updated(self, window: Window, context: Context, x: FloatArray) -> FloatArray:
        if self._smoother is None:
            self._begin(window)
        assert self._smoother is not None
        smoother = self._smoother
        view = _View(window)
        graph, places = gtsam.NonlinearFactorGraph(), list[tuple[str, int]]()
        remove: list[int] = []
        self._renew_intervals(window, view, graph, places, remove)
        held = self._renew_pings(window, context, graph, remove)
        values = view.new_values(x, self._nodes)
        stamps = view.stamps()
        # Nodes older than the window's first one are to leave, and no other.
        smoother.setSmootherLag(window.count - 1 + 0.5)
        smoother.update(graph, values, stamps, remove)  # pyright: ignore[reportArgumentType]
        slots = list(smoother.getISAM2Result().getNewFactorsIndices())
        for (_, k), slot in zip(places, slots, strict=False):
            self._intervals[k] = slot
        for one, slot in zip(held, slots[len(places) :], strict=True):
            one.slot = slot
        self._pings += held
        self._nodes = range(window.first, window.first + window.count)
        self._intervals = {k: s for k, s in self._intervals.items() if k >= window.first}
        self._changed.clear()
        found = view.vector(smoother.calculateEstimate())
        for _ in range(MOST_UPDATES):
            smoother.update()
            before, found = found, view.vector(smoother.calculateEstimate())
            if np.abs(found - before).max() < SETTLED:
                break
        return found

    def _begin(self, window: Window) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(RELINEARIZE)
        # Cholesky takes a free position beside a sensor of centimetres for indeterminate.
        parameters.setFactorization("QR")
        parameters.relinearizeSkip = 1
        parameters.findUnusedFactorSlots = True
        self._smoother = gtsam.IncrementalFixedLagSmoother(float(window.count), parameters)
        self._intervals, self._pings, self._nodes = {}, [], range(0)
        self._changed = set(range(window.first, window.first + window.count - 1))

    def _renew_intervals(
        self,
        window: Window,
        view: _View,
        graph: gtsam.NonlinearFactorGraph,
        places: list[tuple[str, int]],
        remove: list[int],
    ) -> None:
        """Factors of changed intervals, and of the prior where the smoother is new."""
        inside = range(window.first, window.first + window.count - 1)
        for k in sorted(self._changed & set(inside)):
            if k in self._intervals:
                remove.append(self._intervals.pop(k))
            view.add_linear(graph, window.interval_row(k))
            places.append(("interval", k))
        if not self._nodes:
            view.add_linear(graph, window.prior_row())
            places.append(("prior", -1))

    def _renew_pings(
        self,
        window: Window,
        context: Context,
        graph: gtsam.NonlinearFactorGraph,
        remove: list[int],
    ) -> list[_Held]:
        """Factors of pings that came, and removal of those that were gated or changed."""
        count = {id(e) for e in context.pings}
        stay: list[_Held] = []
        for one in self._pings:
            if one.entry.begin < window.begin - 1e-9:
                continue  # its factor went into the past with the node
            if id(one.entry) in count:
                stay.append(one)
            else:
                remove.append(one.slot)
        self._pings = stay
        known = {id(one.entry) for one in stay}
        held: list[_Held] = []
        for kind in PINGS:
            come = [e for e in context.pings if e.kind == kind and id(e) not in known]
            if not come:
                continue
            blocks: list[RangeBlock] = window.ranges(come)
            frozen = tuple(b.frozen(window.vector) for b in blocks)
            options = window.frame.setup.options
            psd = (options.horizontal_psd, options.vertical_psd)
            problem = Problem(window.layout, tuple(blocks), window.loss, psd)
            view = GraphView(problem, OFFSET + window.first, charts=True)
            for factor in _factors(view.graph(frozen)):
                graph.add(factor)
            held += [_Held(e, -1) for e in come]
        return held


def _factors(graph: gtsam.NonlinearFactorGraph) -> list[gtsam.NonlinearFactor]:
    return [graph.at(i) for i in range(graph.size())]


class _View:
    """A window under GTSAM's keys: node k bears its own number."""

    def __init__(self, window: Window) -> None:
        self._window = window
        options = window.frame.setup.options
        psd = (options.horizontal_psd, options.vertical_psd)
        self._layout = window.layout
        self._graph_view = GraphView(
            Problem(self._layout, (), window.loss, psd), OFFSET + window.first, charts=True
        )
        self.keys = keys_of(self._layout, OFFSET + window.first)

    def add_linear(self, graph: gtsam.NonlinearFactorGraph, block: LinearBlock) -> None:
        """Add a linear block's factors."""
        self._graph_view.add_linear(graph, block)

    def new_values(self, x: FloatArray, known: range) -> gtsam.Values:
        """Values of variables that the smoother does not have yet."""
        values = gtsam.Values()
        for key, variable in zip(self.keys, self._layout.variables, strict=True):
            shared = variable.name in dict(self._layout.shared)
            there = bool(known) if shared else self._window.first + variable.index in known
            if not there:
                values.insert(key, x[variable.column : variable.column + variable.size])
        return values

    def stamps(self) -> dict[int, float]:
        """Every variable's time stamp: its node's number; what is shared never ages."""
        shared = dict(self._layout.shared)
        last = float(self._window.first + self._window.count - 1)
        return {
            key: last if v.name in shared else float(self._window.first + v.index)
            for key, v in zip(self.keys, self._layout.variables, strict=True)
        }

    def vector(self, values: gtsam.Values) -> FloatArray:
        """The window's flat vector."""
        return self._graph_view.vector(values)
