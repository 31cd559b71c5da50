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
from ubl_graph.pose_trajectory import PoseStates, PoseTrajectory
from ubl_graph.problem import Frozen, Problem
from ubl_graph.result import Result, SegmentResult
from ubl_graph.solve.banded import descended
from ubl_graph.solve.normal import NormalEquations
from ubl_graph.track import Track, place
from ubl_graph.trajectory import Trajectory

#: Problems of more nodes are asked in so many excerpts, of this many nodes together.
LONG, EXCERPTS = 4000, 4


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
        segments = [_as_solved(segment, solved) for segment, solved in mine]
        yield _solved(result, segments, [solved for _, solved in mine])


def _solved(result: Result, segments: Sequence[Segment], solved: Sequence[SegmentResult]) -> Solved:
    """The problem of some segments, or of excerpts of them, from where their tracks were."""
    mission = result.mission
    models = tuple(model_segment(segment, mission.options) for segment in segments)
    problem = build_problem(mission, models)
    x = _vector(result, problem.layout, solved)
    equations = NormalEquations(problem)
    x = descended(equations, x, problem.frozen(x))
    return Solved(problem, models, equations, x, problem.frozen(x))


def excerpts(result: Result, solved: Solved) -> Iterator[Solved]:
    """A problem in parts of which each can be asked much: itself, or excerpts of a long one.

    Excerpts are of single segments, evenly spread, with the records that lie within; what all nodes
    share is an unknown of each.

    Parameters
    ----------
    result : Result
        Whose problem.
    solved : Solved
        The problem at its solution.

    Raises
    ------
    SolverError
        Where a cost is not finite.
    """
    if solved.problem.layout.node_count <= LONG:
        yield solved
        return
    total = solved.problem.layout.node_count
    by_name = {s.name: s for s in result.segments}
    for model in solved.models:
        nodes = len(model.t)
        share = max(round(EXCERPTS * nodes / total), 1)
        length = LONG // EXCERPTS
        if nodes <= share * length:
            share, length = 1, nodes
        for first in np.linspace(0, nodes - length, share).astype(int):
            span = float(model.t[first]), float(model.t[first + length - 1])
            yield _solved(result, [_cut(model.segment, span)], [by_name[model.segment.name]])


def _cut(segment: Segment, span: tuple[float, float]) -> Segment:
    """The records of a segment that lie within a span of time, s."""
    changes: dict[str, object] = {"reference": None}
    for kind, rows in segment.records().items():
        # A broadcast's transmit time is by another clock.
        own = ("t", "t_from", "t_to", "t_receive", *(["t_transmit"] * (kind == "two_way_range")))
        columns = [getattr(rows, c) for c in own if hasattr(rows, c)]
        inside = np.all([(c >= span[0]) & (c <= span[1]) for c in columns], axis=0)
        changes[kind] = rows[inside] if inside.any() else None
    start = segment.start
    if start is not None and not span[0] <= start.t <= span[1]:
        changes["start"] = None
    return replace(segment, **changes)  # pyright: ignore[reportArgumentType] - by name of the kind


def _as_solved(segment: Segment, solved: SegmentResult) -> Segment:
    """A segment without the start prior where the smoother left that out."""
    start, track = segment.start, solved.trajectory
    if start is None:
        return segment
    k = int(np.argmin(np.abs(track.t - start.t)))
    off = np.hypot(*(track.position[k, :2] - [start.east, start.north]))
    return replace(segment, start=None) if off >= START_LIMIT * start.sigma else segment


def _track_at(track: Trajectory, t: FloatArray) -> Track:
    """A track at some times (M,), its own nodes' or others."""
    none, still = np.zeros(len(t)), np.zeros((len(t), 3))
    posed = isinstance(track, PoseTrajectory)
    if np.array_equal(t, track.t):
        acceleration = still if track.acceleration is None else track.acceleration
        rotation = track.rotation if posed else None
        return Track(track.position, track.velocity, acceleration, none, none, 0.0, rotation)
    states = track.at(t)
    rotation = states.rotation if isinstance(states, PoseStates) else None
    return Track(states.position, states.velocity, still, none, none, 0.0, rotation)


def _vector(result: Result, layout: Layout, solved: Sequence[SegmentResult]) -> FloatArray:
    """The flat vector of some segments of a result."""
    x = np.zeros(layout.size)
    for chain, segment in zip(layout.chains, solved, strict=True):
        place(layout, chain, _track_at(segment.trajectory, chain.t), x)
        nodes = chain.first + np.arange(len(chain.t))
        for name, state in segment.slow.items():
            values = [np.interp(chain.t, state.t, component) for component in state.value.T]
            x[layout.node_columns(name, nodes)] = np.stack(values, axis=1) / layout.unit(name)
    for name, _ in layout.shared:
        is_beacon = name.startswith("beacon ")
        known = result.beacons[name.removeprefix("beacon ")] if is_beacon else result.shared[name]
        layout.put(x, name, known.value)
    return x
