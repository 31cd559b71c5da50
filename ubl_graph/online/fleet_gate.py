"""The gate of an online fleet: whether a new row is near enough to what the window expects of it.

What both ends of a range are expected to be, and how well that is known, comes from the window as
it is without the new rows, whose nodes stand where odometry leads.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.online.fleet_blocks import Factor
from ubl_graph.online.fleet_system import Point, System, lower_solved
from ubl_graph.online.gate import limit

#: What is left of a direction that the new rows alone know.
ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class Verdict:
    """What the gate said of a factor: its Mahalanobis distance, and components."""

    factor: Factor
    distance: float
    components: int

    @property
    def accepted(self) -> bool:
        """Whether it is near enough to what was expected."""
        return self.distance <= limit(self.components)


def judged(system: System, point: Point) -> tuple[list[Verdict], FloatArray | None]:
    """Distances of the rows that have not been judged yet from what the others expect.

    With A = J H^-1 J' of the new rows, where H holds them too, their covariance as the others
    expect them is (1 - A)^-1 by Woodbury's identity: one factor serves the gate and the first step.

    Returns
    -------
    list of Verdict
    array or None
        Factor of H; None where there is nothing new.
    """
    fresh: list[tuple[Factor, FloatArray, FloatArray, IntArray]] = []
    for part in point.parts:
        for i in np.flatnonzero(part.rows.fresh).tolist():
            factor = part.rows.of[i]
            assert isinstance(factor, Factor)
            columns = part.rows.block.columns[i]
            fresh.append((factor, part.residual[i], part.slope[i], columns))
    if not fresh:
        return [], None
    lower = system.factored(system.normal(point, newton=False, unjudged=True))
    ends = np.cumsum([0, *(len(residual) for _, residual, _, _ in fresh)])
    right = np.zeros((system.size + 1, ends[-1]))
    for (_, _, slope, columns), at in zip(fresh, ends[:-1].tolist(), strict=True):
        np.add.at(right[:, at : at + len(slope)], columns, slope.T)
    half = lower_solved(lower, right[:-1])
    values, vectors = np.linalg.eigh(half.T @ half)
    expected = (vectors / np.maximum(1.0 - values, ROUNDING)) @ vectors.T
    verdicts: list[Verdict] = []
    for (factor, residual, _, _), at in zip(fresh, ends[:-1].tolist(), strict=True):
        own = slice(at, at + len(residual))
        squared = float(residual @ np.linalg.solve(expected[own, own], residual))
        verdicts.append(Verdict(factor, float(np.sqrt(max(squared, 0.0))), len(residual)))
    return verdicts, lower
