"""The problems that a result came from, built anew and at their solutions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.builder import SegmentModel
from ubl_graph.graph import build_problem, model_segment
from ubl_graph.initial import START_LIMIT
from ubl_graph.layout import Layout
from ubl_graph.mission import Segment
from ubl_graph.pose_trajectory import PoseTrajectory
from ubl_graph.problem import Frozen, Problem
from ubl_graph.result import Result, SegmentResult
from ubl_graph.solve.banded import descended
from ubl_graph.solve.normal import NormalEquations
from ubl_graph.track import Track, place


@dataclass(frozen=True, eq=False)
class Solved:
    """A problem at its solution.

    Attributes
    ----------
    problem : Problem
    models : tuple of SegmentModel
        Of its segments.
    equations : NormalEquations
        Of the problem.
    x : array
        The solution, flat vector.
    frozen : tuple
        What the solve held.
    """

    problem: Problem
    models: tuple[SegmentModel, ...]
    equations: NormalEquations
    x: FloatArray
    frozen: Frozen


def solved_again(result: Result) -> Iterator[Solved]:
    """The problems of a result, one after the other.

    Raises
    ------
    SolverError
        Where a cost is not finite.
    """
    mission = result.mission
    pairs = list(zip(mission.segments, result.segments, strict=True))
    for number in dict.fromkeys(s.problem for s in result.segments):
        mine = [(segment, s) for segment, s in pairs if s.problem == number]
        models = tuple(
            model_segment(_as_solved(segment, solved), mission.options) for segment, solved in mine
        )
        problem = build_problem(mission, models)
        x = _vector(result, problem.layout, [solved for _, solved in mine])
        equations = NormalEquations(problem)
        x = descended(equations, x, problem.frozen(x))
        yield Solved(problem, models, equations, x, problem.frozen(x))


def _as_solved(segment: Segment, solved: SegmentResult) -> Segment:
    """A segment without the start prior where the smoother left that out."""
    start, track = segment.start, solved.trajectory
    if start is None:
        return segment
    k = int(np.argmin(np.abs(track.t - start.t)))
    off = np.hypot(*(track.position[k, :2] - [start.east, start.north]))
    return replace(segment, start=None) if off >= START_LIMIT * start.sigma else segment


def _vector(result: Result, layout: Layout, solved: Sequence[SegmentResult]) -> FloatArray:
    """The flat vector of some segments of a result."""
    x = np.zeros(layout.size)
    for chain, segment in zip(layout.chains, solved, strict=True):
        track, none = segment.trajectory, np.zeros(len(chain.t))
        still = np.zeros_like(track.position)
        acceleration = still if track.acceleration is None else track.acceleration
        rotation = track.rotation if isinstance(track, PoseTrajectory) else None
        start = Track(track.position, track.velocity, acceleration, none, none, 0.0, rotation)
        place(layout, chain, start, x)
        nodes = chain.first + np.arange(len(chain.t))
        for name, state in segment.slow.items():
            x[layout.node_columns(name, nodes)] = state.value / layout.unit(name)
    for name, _ in layout.shared:
        is_beacon = name.startswith("beacon ")
        known = result.beacons[name.removeprefix("beacon ")] if is_beacon else result.shared[name]
        layout.put(x, name, known.value)
    return x
