"""Blocks of a fleet: a vehicle's own at their places among all, and ranges between vehicles.

A vehicle's block knows its own columns alone; `PlacedBlock` shows it those. `JoinedAntenna` makes
one end of many ranges out of the antennas of several vehicles, so that all ranges of a kind are one
block, whoever measured them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.factors.block import ALL_ROWS, Block
from ubl_graph.factors.ranges import Antenna


class PlacedBlock:
    """A vehicle's block as one of the fleet's.

    Parameters
    ----------
    block : Block
        Of the vehicle's own columns.
    place : array of int
        Where these stand in the fleet's flat vector.
    """

    def __init__(self, block: Block, place: IntArray) -> None:
        self.block, self._place = block, place
        self.columns = placed(block.columns, place)

    @property
    def name(self) -> str:
        """The block's own."""
        return self.block.name

    @property
    def linear(self) -> bool:
        """As the block is."""
        return self.block.linear

    @property
    def robust(self) -> bool:
        """As the block is."""
        return self.block.robust

    @property
    def log_det(self) -> Callable[[], float] | None:
        """The block's own."""
        return self.block.log_det

    def frozen(self, x: FloatArray) -> FloatArray | None:
        """What the block holds fixed while a solve runs."""
        return self.block.frozen(x[self._place])

    def evaluate(
        self,
        x: FloatArray,
        frozen: FloatArray | None = None,
        rows: slice = ALL_ROWS,
        jacobian: bool = True,
    ) -> tuple[FloatArray, FloatArray | None]:
        """Whitened residuals (m, R) of `rows` at the fleet's `x`, and Jacobians (m, R, C)."""
        return self.block.evaluate(x[self._place], frozen, rows, jacobian)


def placed(columns: IntArray, place: IntArray) -> IntArray:
    """A vehicle's own columns as the fleet's; pads stay -1."""
    return np.where(columns >= 0, place[columns], -1)


@dataclass(frozen=True, eq=False)
class End:
    """One end of some of the ranges: a vehicle's antenna, or a target's place.

    Attributes
    ----------
    rows : array of int, shape (P,)
        Which ranges, increasing.
    antenna : Antenna
        Where it is at each of these.
    place : array of int, optional
        Where the columns that it speaks of stand in the fleet's vector; left out, they are those.
    """

    rows: IntArray
    antenna: Antenna
    place: IntArray | None = None

    @property
    def columns(self) -> IntArray:
        """Columns of the fleet's vector, (P, W); -1 pads."""
        own = self.antenna.columns
        return own if self.place is None else placed(own, self.place)


class JoinedAntenna:
    """One end of M ranges, of which each is at one of several vehicles or targets (`Antenna`).

    Parameters
    ----------
    ends : sequence of End
        That have all the rows between them.
    count : int
        Ranges M.
    legs : int
        Legs L of a range.
    """

    def __init__(self, ends: Sequence[End], count: int, legs: int) -> None:
        self._ends, self._count, self.legs = tuple(ends), count, legs
        width = max((end.columns.shape[1] for end in ends), default=0)
        self.columns = np.full((count, width), -1, dtype=np.int64)
        for end in ends:
            own = end.columns
            self.columns[end.rows, : own.shape[1]] = own

    def positions(self, x: FloatArray, rows: slice) -> tuple[FloatArray, list[_Seen]]:
        """Positions (m, L, 3) of the ranges `rows` at `x`, m, and what gives their derivatives."""
        first, last, _ = rows.indices(self._count)
        out = np.empty((last - first, self.legs, 3))
        seen: list[_Seen] = []
        for end in self._ends:
            low, high = np.searchsorted(end.rows, (first, last))
            if low == high:
                continue
            own = slice(int(low), int(high))
            position, terms = end.antenna.positions(x if end.place is None else x[end.place], own)
            among = end.rows[own] - first
            out[among] = position
            seen.append(_Seen(end.antenna, own, among, terms))
        return out, seen

    def slopes(self, gradient: FloatArray, terms: list[_Seen], rows: slice) -> FloatArray:  # noqa: ARG002 - the protocol's form
        """Derivatives (m, W) by the columns, given those by the positions (m, L, 3)."""
        out = np.zeros((len(gradient), self.columns.shape[1]))
        for part in terms:
            own = part.antenna.slopes(gradient[part.among], part.terms, part.own)
            out[part.among, : own.shape[1]] = own
        return out

    def variance(self, gradient: FloatArray, terms: list[_Seen]) -> FloatArray:
        """Variance of the motion between the nodes along the gradients, (M,)."""
        out = np.zeros(len(gradient))
        for part in terms:
            out[part.among] = part.antenna.variance(gradient[part.among], part.terms)
        return out


@dataclass(frozen=True, eq=False)
class _Seen:
    """What one end gave for some rows: its own rows, theirs among those asked for, and terms."""

    antenna: Antenna
    own: slice
    among: IntArray
    terms: Any
