"""Where the variance of an estimate comes from: ranges, motion, the medium, or something else.

With A_k the part of the normal matrix that the rows of source k make, and P the inverse of their
sum, the noise of that source alone gives the estimate the covariance P A_k P. The parts add up to
P; were the noise of a source s_k times what is stated, the estimate left as it is, its covariance
would be the sum of s_k P A_k P. An error that all travel times of a beacon have in common is no
row's noise, but moves the estimate likewise.

Source: Helmert's estimation of variance components, as in Koch, Parameter Estimation and Hypothesis
Testing in Linear Models, ch. 3.6.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ubl_graph.arrays import BoolArray, FloatArray, IntArray
from ubl_graph.factors.ranges import RangeBlock
from ubl_graph.pings import leg_times
from ubl_graph.problem import Frozen
from ubl_graph.solve.marginals import RIDGES, scaled_factor
from ubl_graph.solved import Solved

Source = Literal["ranges", "motion", "medium", "other", "beacons"]
#: What `NoiseSources.parts` tells apart. The first four add up to what is stated.
SOURCES: tuple[Source, ...] = ("ranges", "motion", "medium", "other", "beacons")
STATED = 4
#: A ping whose weight in the solve of all data is below this is an outlier beyond doubt.
DROPPED = 0.1
#: Nodes of a problem that are asked where their variance comes from.
NODES = 40


@dataclass(frozen=True, eq=False)
class PingTable:
    """All pings of a problem.

    Attributes
    ----------
    block, row : array of int, shape (M,)
        Where the ping's residual stands: number of the block among the problem's, and row there.
    chain : array of int, shape (M,)
        Number of the chain.
    t : array, shape (M,)
        Middle of the ping, s.
    beacon : array of int, shape (M,)
        Place among `beacons`.
    time, sigma : array, shape (M,)
        Measured travel time and its standard deviation, s.
    dropped : array of bool, shape (M,)
        Outliers beyond doubt.
    beacons : tuple of str
        Names.
    """

    block: IntArray
    row: IntArray
    chain: IntArray
    t: FloatArray
    beacon: IntArray
    time: FloatArray
    sigma: FloatArray
    dropped: BoolArray
    beacons: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.t)


def pings_of(solved: Solved) -> PingTable:
    """The pings of a solved problem, in the order of its blocks' rows."""
    problem = solved.problem
    names = [chain.name for chain in problem.layout.chains]
    numbers: list[IntArray] = [np.empty((3, 0), dtype=np.int64)]
    values: list[FloatArray] = [np.empty((3, 0))]
    heard: list[FloatArray] = [np.empty(0, dtype=str)]
    dropped: list[BoolArray] = [np.empty(0, dtype=np.bool_)]
    for number, (block, sigma) in enumerate(zip(problem.blocks, solved.frozen, strict=True)):
        if not isinstance(block, RangeBlock):
            continue
        assert sigma is not None
        chain = names.index(block.chain)
        records = getattr(solved.models[chain].segment, block.name)
        residual = block.evaluate(solved.x, sigma, jacobian=False)[0][:, 0]
        count = len(records)
        numbers.append(np.stack([np.full(count, number), np.arange(count), np.full(count, chain)]))
        values.append(np.stack([leg_times(records).mean(axis=1), block.measured, sigma]))
        heard.append(np.asarray(records.beacon).astype(str))
        dropped.append(problem.loss.weights(residual) < DROPPED)
    beacons, beacon = np.unique(np.concatenate(heard), return_inverse=True)
    (block, row, chain), (t, time, sigma) = (
        np.concatenate(part, axis=1) for part in (numbers, values)
    )
    return PingTable(
        block,
        row,
        chain,
        t,
        beacon,
        time,
        sigma,
        np.concatenate(dropped),
        tuple(str(name) for name in beacons),
    )


class NoiseSources:
    """Covariances at a point, told apart by the source of the noise.

    Parameters
    ----------
    solved : Solved
        The problem.
    pings : PingTable
        Its pings.
    x : array
        Flat vector of a minimum.
    frozen : tuple
        What was held there.

    Raises
    ------
    SolverError
        Where the normal equations are singular.
    """

    def __init__(self, solved: Solved, pings: PingTable, x: FloatArray, frozen: Frozen) -> None:
        problem = solved.problem
        point = solved.equations.evaluate(x, frozen)
        self._factor, self._scale, _ = scaled_factor(solved.equations, point, RIDGES)
        _, self._rows = problem.linearize(x, frozen)
        self._unit = float(np.median(pings.sigma)) if len(pings) else 0.0
        sources: list[IntArray] = []
        lasting: list[FloatArray] = []
        for number, (block, held) in enumerate(zip(problem.blocks, frozen, strict=True)):
            residual = block.evaluate(x, held, jacobian=False)[0]
            sources.append(np.full(residual.size, SOURCES.index(source_of(block.name))))
            by_beacon = np.zeros((residual.size, len(pings.beacons)))
            if isinstance(block, RangeBlock):
                assert held is not None
                mine = pings.block == number
                rows = pings.row[mine]
                root = np.sqrt(problem.loss.weights(residual[rows, 0]))
                by_beacon[rows, pings.beacon[mine]] = root / held[rows]
            lasting.append(by_beacon)
        self._source = np.concatenate(sources)
        self._lasting = np.concatenate(lasting)

    @property
    def unit(self) -> float:
        """Lasting error of a beacon's travel times that the part `beacons` stands for, s."""
        return self._unit

    def parts(self, along: FloatArray, own: FloatArray | float = 0.0) -> FloatArray:
        """Covariance of A x, told apart by source.

        Parameters
        ----------
        along : array, shape (P, U)
            A, by the U columns of the flat vector.
        own : array, shape (P, B)
            What a lasting error of each beacon adds besides, for a unit of it.

        Returns
        -------
        array, shape (5, P, P)
            In the order of `SOURCES`.
        """
        gain = self._scale[:, None] * self._factor.solve(self._scale[:, None] * along.T)
        moved = self._rows @ gain
        off = self._unit * ((self._lasting.T @ moved).T + own)
        by_rows = [moved[self._source == k] for k in range(STATED)]
        return np.stack([*(part.T @ part for part in by_rows), off @ off.T])


def source_of(name: str) -> Source:
    """Where the noise of a block of residuals comes from, by the block's name."""
    if name.endswith("_range"):
        return "ranges"
    if name in ("sound_speed walk", "clock walk"):
        return "medium"
    if name.endswith((" prior", " walk")) or name in ("depth", "position"):
        return "other"
    return "motion"


def track_shares(solved: Solved, pings: PingTable) -> FloatArray:
    """How much of the horizontal variance at some nodes comes from each source, (M, 5).

    The first four add up to 1.
    """
    layout = solved.problem.layout
    sources = NoiseSources(solved, pings, solved.x, solved.frozen)
    count = layout.node_count
    out: list[FloatArray] = []
    for node in np.unique(np.linspace(0, count - 1, min(count, NODES)).round().astype(np.int64)):
        along = np.zeros((2, layout.size))
        along[[0, 1], layout.node_columns("position", np.array([node]))[0, :2]] = 1.0
        parts = sources.parts(along)
        stated = parts[:STATED].sum(axis=0)
        out.append(0.5 * np.trace(np.linalg.solve(stated[None], parts), axis1=1, axis2=2))
    return np.array(out)
