"""Held-out prediction: what a track that was found without some pings says of these.

Pings are kept out in blocks of time of a minute or more, and beacon by beacon. What is kept out
counts for nothing in a solve that begins at the answer of all data; its travel times are then
predicted, and the mean error of each beacon's pings in a block is one number. In the mean over a
minute the errors that pings share stay, as they do in a track, while those that every ping has for
itself vanish: residuals of single pings would hide the former behind the latter.

Each number comes with the covariance that the model states for it, told apart by where the noise
comes from, so that one can ask which of the sources is larger than stated.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from scipy import sparse

from ubl_graph.arrays import BoolArray, FloatArray, IntArray
from ubl_graph.errors import SolverError
from ubl_graph.factors.ranges import RangeBlock
from ubl_graph.noise_sources import STATED, NoiseSources, PingTable, pings_of
from ubl_graph.problem import Frozen
from ubl_graph.result import Result
from ubl_graph.solve.banded import descended
from ubl_graph.solved import Solved, solved_again

#: Pings that are kept out together span at least so long, s.
LEAST_BLOCK = 60.0
#: In a block a beacon is heard so often on average, or blocks are longer.
PINGS_A_BLOCK = 2.0
#: One block in so many is kept out at a time: its neighbours stay.
FOLDS = 4
#: Blocks of a problem that are predicted, at most: of longer missions a sample.
MOST_BLOCKS = 120
#: Beacons that are kept out of a block, one after the other, at most.
MOST_TURNS = 6
#: Pings of a block that are looked at one by one, at most.
MOST_PINGS = 12
#: By so much a kept-out ping's standard deviation is multiplied: it counts for nothing.
IGNORED = 1e6
#: A prediction as uncertain as this share of the travel time is none: the track is lost without
#: the pings.
LOST = 0.05

Kind = Literal["block", "turn", "beacon", "ping"]


@dataclass(frozen=True, eq=False)
class Prediction:
    """Mean errors of the predicted travel times of a block's pings, beacon by beacon.

    Attributes
    ----------
    kind : {"block", "turn", "beacon", "ping"}
        Whether all pings of the block were kept out, those of one beacon in it, or all of a
        beacon's; of the last there is one mean over a segment. "ping": as "turn" (as "block" where
        there is one beacon), and each ping by itself instead of means.
    segment : str
        Name of the segment.
    t : float
        Middle of the block, s.
    beacons : tuple of str
        Whose pings, P of them.
    count : tuple of int
        How many of each.
    error : array, shape (P,)
        Prediction minus measurement, s.
    parts : array, shape (5, P, P)
        Covariances by `noise_sources.SOURCES`, s^2; the first four are what is stated, the last is
        that of a lasting error of each beacon's travel times of `unit`.
    unit : float
        s.
    """

    kind: Kind
    segment: str
    t: float
    beacons: tuple[str, ...]
    count: tuple[int, ...]
    error: FloatArray
    parts: FloatArray
    unit: float

    @property
    def covariance(self) -> FloatArray:
        """Covariance of `error` as stated, s^2, shape (P, P)."""
        return self.parts[:STATED].sum(axis=0)

    @property
    def nis(self) -> float:
        """Squared Mahalanobis length of `error`: P on average where all sigmas are true."""
        return float(self.error @ np.linalg.solve(self.covariance, self.error))

    @property
    def whitened(self) -> FloatArray:
        """Each error by its own standard deviation, shape (P,)."""
        return self.error / np.sqrt(np.diag(self.covariance))


def held_out(result: Result) -> list[Prediction]:
    """Predict the pings of a result without them, by blocks of time and beacon by beacon.

    Parameters
    ----------
    result : Result
        Of `smooth`.

    Returns
    -------
    list of Prediction
        Empty without pings, or where there are fewer than three blocks of them. Blocks at the ends
        of a segment are not predicted: that would be extrapolation.

    Raises
    ------
    SolverError
        Where a solve fails on all data.
    """
    return [p for solved in solved_again(result) for p in predictions(solved)]


def predictions(solved: Solved) -> list[Prediction]:
    """The same of one problem; a kept-out part that leaves it singular is left out."""
    pings = pings_of(solved)
    blocks = time_blocks(pings)
    some = _sample(np.unique(blocks[blocks >= 0]))
    told = np.isin(blocks, some) & ~pings.dropped
    out: list[Prediction] = []
    for fold in range(FOLDS):
        held = np.isin(blocks, some[some % FOLDS == fold])
        with suppress(SolverError):
            rest = _Rest(solved, pings, held)
            out += rest.predictions("block", told & held, blocks)
            if len(pings.beacons) == 1:
                out += rest.predictions("ping", told & held, blocks)
    count = len(pings.beacons)
    if count > 1:
        for turn in range(min(count, MOST_TURNS)):
            held = np.isin(blocks, some) & (pings.beacon == (blocks + turn) % count)
            with suppress(SolverError):
                rest = _Rest(solved, pings, held)
                out += rest.predictions("turn", told & held, blocks)
                out += rest.predictions("ping", told & held, blocks)
        for beacon in range(count):
            held = pings.beacon == beacon
            with suppress(SolverError):
                out += _Rest(solved, pings, held).predictions("beacon", told & held, pings.chain)
    return out


def time_blocks(pings: PingTable) -> IntArray:
    """Number of the block of each ping (M,); -1 in the first and last of a segment.

    A segment is cut into equal parts of `LEAST_BLOCK` or more.
    """
    out = np.full(len(pings), -1)
    first = 0
    for chain in np.unique(pings.chain):
        mine = np.flatnonzero(pings.chain == chain)
        t = pings.t[mine]
        span = float(np.ptp(t))
        beacons = len(np.unique(pings.beacon[mine]))
        length = max(LEAST_BLOCK, span * PINGS_A_BLOCK * beacons / len(mine))
        count = int(span / length)
        if count < 3:
            continue
        number = np.minimum(((t - t.min()) * (count / span)).astype(np.int64), count - 1)
        inner = (number > 0) & (number < count - 1)
        out[mine[inner]] = first + number[inner]
        first += count
    return out


def _sample(numbers: IntArray) -> IntArray:
    """At most `MOST_BLOCKS` of them, evenly spread."""
    if len(numbers) <= MOST_BLOCKS:
        return numbers
    return numbers[np.linspace(0, len(numbers) - 1, MOST_BLOCKS).round().astype(np.int64)]


class _Rest:
    """A problem solved without some of its pings.

    Parameters
    ----------
    solved : Solved
        With all of them.
    pings : PingTable
        All of them.
    held : array of bool, shape (M,)
        Which are kept out.
    """

    def __init__(self, solved: Solved, pings: PingTable, held: BoolArray) -> None:
        self._solved, self._pings = solved, pings
        self._frozen = _ignoring(solved.frozen, pings, held)
        self._held = held

    @cached_property
    def _solution(self) -> tuple[FloatArray, NoiseSources]:
        x = descended(self._solved.equations, self._solved.x, self._frozen)
        return x, NoiseSources(self._solved, self._pings, x, self._frozen)

    def predictions(self, kind: Kind, told: BoolArray, groups: IntArray) -> list[Prediction]:
        """What it says of the pings that are `told`, group by group."""
        pings = self._pings
        if not told.any():
            return []
        x, sources = self._solution
        rows = np.flatnonzero(told)
        error, slopes = self._errors(x, rows)
        out: list[Prediction] = []
        for group in np.unique(groups[rows]):
            here = np.flatnonzero(groups[rows] == group)
            if kind == "ping":
                # As many as tell what can be told, evenly spread.
                spread = np.linspace(0, len(here) - 1, min(len(here), MOST_PINGS))
                here = here[np.unique(spread.round().astype(np.int64))]
                beacons, which = pings.beacon[rows[here]], np.arange(len(here))
            else:
                beacons, which = np.unique(pings.beacon[rows[here]], return_inverse=True)
            weight = 1.0 / pings.sigma[rows[here]] ** 2
            mean = (which == np.arange(len(beacons))[:, None]) * weight
            noise = 1.0 / mean.sum(axis=1)
            mean *= noise[:, None]
            own = -1.0 * (beacons[:, None] == np.arange(len(pings.beacons)))
            parts = sources.parts((sparse.csr_array(mean) @ slopes[here]).toarray(), own)
            parts[0] += np.diag(noise)
            sigma = np.sqrt(np.einsum("kii->i", parts[:STATED]))
            known = sigma < LOST * (mean @ np.abs(pings.time[rows[here]]))
            if not known.any():
                continue
            chain = int(pings.chain[rows[here[0]]])
            out.append(
                Prediction(
                    kind,
                    self._solved.problem.layout.chains[chain].name,
                    float(pings.t[rows[here]].mean()),
                    tuple(pings.beacons[b] for b in beacons[known]),
                    tuple(int(n) for n in np.bincount(which)[known]),
                    (mean @ error[here])[known],
                    parts[:, known][:, :, known],
                    sources.unit,
                )
            )
        return out

    def _errors(self, x: FloatArray, rows: IntArray) -> tuple[FloatArray, sparse.csr_array]:
        """Prediction minus measurement of some pings (R,), s, and its derivatives by x."""
        problem, pings = self._solved.problem, self._pings
        error = np.zeros(len(rows))
        data: list[FloatArray] = []
        places: list[tuple[IntArray, IntArray]] = []
        for number in np.unique(pings.block[rows]):
            block = problem.blocks[number]
            assert isinstance(block, RangeBlock)
            sigma = self._solved.frozen[number]
            assert sigma is not None
            residual, jacobian = block.evaluate(x, sigma)
            assert jacobian is not None
            mine = np.flatnonzero(pings.block[rows] == number)
            at = pings.row[rows[mine]]
            error[mine] = sigma[at] * residual[at, 0]
            columns = block.columns[at]
            used = columns >= 0
            data.append((sigma[at, None] * jacobian[at, 0])[used])
            places.append((np.broadcast_to(mine[:, None], columns.shape)[used], columns[used]))
        row, column = (np.concatenate(part) for part in zip(*places, strict=True))
        shape = (len(rows), problem.layout.size)
        return error, sparse.csr_array((np.concatenate(data), (row, column)), shape=shape)


def _ignoring(frozen: Frozen, pings: PingTable, held: BoolArray) -> Frozen:
    """What blocks hold, with the sigmas of some pings so wide that they count for nothing."""
    out = list(frozen)
    for number in np.unique(pings.block[held]):
        sigma = out[number]
        assert sigma is not None
        sigma = sigma.copy()
        sigma[pings.row[held & (pings.block == number)]] *= IGNORED
        out[number] = sigma
    return tuple(out)


def counted(some: Sequence[Prediction]) -> tuple[int, int]:
    """Blocks and pings of some predictions; what was kept out twice counts once."""
    kinds = {p.kind for p in some}
    kind = "block" if "block" in kinds else "beacon"
    mine = [p for p in some if p.kind == kind]
    return len({(p.segment, round(p.t)) for p in mine}), sum(sum(p.count) for p in mine)
