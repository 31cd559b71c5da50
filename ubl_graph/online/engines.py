"""Engines: what finds the least cost of a window."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from ubl_graph.arrays import FloatArray
from ubl_graph.factors.ranges import RangeBlock
from ubl_graph.online.buffer import Entry
from ubl_graph.online.equations import Point, WindowEquations
from ubl_graph.online.lm import minimise
from ubl_graph.online.window import Window
from ubl_graph.options import OnlineEngine


@dataclass(frozen=True, eq=False)
class Context:
    """What is solved: first node, version of the window, pings, rows by kind, equations, start."""

    first: int
    version: int
    pings: Sequence[Entry]
    ranges: Sequence[RangeBlock]
    equations: WindowEquations
    start: Point | None = None


class Engine(Protocol):
    """Solves windows, one after another."""

    def solve(self, window: Window, context: Context, x: FloatArray, most: int) -> Point:
        """Where the window's cost is least, searched from `x` in `most` steps at the most."""
        ...

    def note(self, changed: set[int]) -> None:
        """Take note of intervals whose rows were made anew."""
        ...

    def forget(self) -> None:
        """Begin anew with the next window."""
        ...


class LmEngine:
    """Solves each window by itself, from where the last one ended."""

    def solve(
        self,
        window: Window,  # noqa: ARG002 - the protocol's form
        context: Context,
        x: FloatArray,
        most: int,
    ) -> Point:
        """Minimise the equations' cost."""
        return minimise(context.equations, x, most, context.start)

    def note(self, changed: set[int]) -> None:
        """Nothing is kept from window to window."""

    def forget(self) -> None:
        """Nothing is kept from window to window."""


def engine_of(name: OnlineEngine) -> Engine:
    """The engine that the option `engine` names."""
    if name == "isam2":
        from ubl_graph.online.isam2 import Isam2Engine

        return Isam2Engine()
    return LmEngine()
