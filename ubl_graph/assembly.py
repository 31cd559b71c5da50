"""From a solver's flat vector to a SegmentResult: trajectory, slow states, residuals, status."""

from __future__ import annotations

import numpy as np

from ubl_graph.arrays import BoolArray, FloatArray, IntArray
from ubl_graph.builder import SegmentModel
from ubl_graph.factors.block import LinearBlock
from ubl_graph.factors.ranges import RangeBlock
from ubl_graph.layout import KINEMATIC, Chain
from ubl_graph.measurements import SlantRange
from ubl_graph.mission import Mission
from ubl_graph.options import Options
from ubl_graph.pings import Pings, measured_times
from ubl_graph.pose_assembly import pose_trajectory
from ubl_graph.problem import LeastSquares, Problem
from ubl_graph.result import Hypothesis, RangeResiduals, SegmentResult, Shared, SlowState, Status
from ubl_graph.solve.marginals import Covariances
from ubl_graph.solve.rounds import Solution
from ubl_graph.trajectory import NodeCovariance, Trajectory

#: Where half of the nodes are known worse than this share of the typical slant range, the
#: linearised covariance means nothing and the track counts as not observed.
UNOBSERVED_SHARE = 0.5
#: The same where there are no ranges to compare with, m.
UNOBSERVED_SIGMA = 1000.0


def assemble_segment(
    problem: Problem,
    solution: Solution,
    marginals: Covariances,
    chain: Chain,
    model: SegmentModel,
    rival: str | None,
    rival_track: FloatArray | None,
    number: int,
    solver: str,
    runner_up: float | None,
    options: Options,
    limit: float | None = None,
    hypotheses: tuple[Hypothesis, ...] = (),
    pruned: float = 0.0,
) -> SegmentResult:
    """Everything that a user reads of one segment.

    Parameters
    ----------
    problem, solution, marginals
        Solved, with covariances.
    chain, model
        The segment's nodes and records.
    rival : str or None
        What to say of another track that fits as well.
    rival_track : array or None
        Its positions at all nodes, where it is one track.
    number : int
        Of the problem among those of the mission.
    solver : str
        What solved it.
    runner_up : float or None
        How much dearer the next best track elsewhere is.
    options : Options
        Of the mission.
    limit : float, optional
        Standard deviation beyond which a position counts as not observed, m; left out, half the
        typical range.
    hypotheses : tuple of Hypothesis
        Tracks that the data allow.
    pruned : float
        Weight of those that were left out.
    """
    layout = problem.layout
    trajectory = trajectory_of(problem, solution, marginals, chain, options)
    slow = {name: _slow_state(problem, solution, marginals, chain, name) for name, _ in layout.slow}
    residuals = _range_residuals(problem, solution, chain, model)
    if limit is None:
        limit = _unobserved_sigma(residuals, slow.get("clock_offset"))
    unresolved = marginals.unresolved[chain.nodes]
    status, reason = _status(solution, trajectory, limit, unresolved, rival)
    chi_square, dof = chi_square_of(problem, solution)
    return SegmentResult(
        chain.name,
        trajectory,
        slow,
        residuals,
        status,
        reason,
        number,
        solver,
        solution.cost,
        solution.iterations,
        chi_square,
        dof,
        None if rival_track is None else rival_track[chain.nodes],
        runner_up,
        hypotheses,
        pruned,
    )


def trajectory_of(
    problem: Problem, solution: Solution, marginals: Covariances, chain: Chain, options: Options
) -> Trajectory:
    """The trajectory of a segment, of points or of poses, with covariances."""
    if problem.layout.node == "point":
        return _point_trajectory(problem, solution, marginals, chain)
    return pose_trajectory(problem, solution.x, marginals, chain, options)


def _point_trajectory(
    problem: Problem, solution: Solution, marginals: Covariances, chain: Chain
) -> Trajectory:
    """The trajectory of a chain of point nodes."""
    layout = problem.layout
    states = KINEMATIC[: layout.order]
    following = slice(chain.nodes.start, chain.nodes.stop - 1)
    joint = NodeCovariance(
        marginals.joint(states)[chain.nodes], marginals.following(states)[following]
    )
    return Trajectory(
        chain.t,
        layout.get(solution.x, "position")[chain.nodes],
        layout.get(solution.x, "velocity")[chain.nodes],
        layout.get(solution.x, "acceleration")[chain.nodes] if layout.order == 3 else None,
        np.ascontiguousarray(joint.node[:, :3, :3]),
        problem.psd,
        joint,
    )


def shared_of(
    problem: Problem,
    solution: Solution,
    marginals: Covariances,
    expected: FloatArray | None = None,
) -> dict[str, Shared]:
    """Estimates of what all nodes share.

    Parameters
    ----------
    problem, solution, marginals
        Solved, with covariances.
    expected : array, optional
        What `shared_covariance` said at the start.
    """
    layout, out, first = problem.layout, dict[str, Shared](), 0
    for name, size in layout.shared:
        own = slice(first, first + size)
        first += size
        prior = prior_sigma(problem, layout.shared_columns(name), layout.unit(name))
        promised = None if expected is None else expected[own, own]
        out[name] = Shared(layout.get(solution.x, name), marginals.of(name), prior, promised)
    return out


def prior_sigma(problem: Problem, columns: IntArray, unit: float) -> FloatArray | None:
    """Standard deviations, SI, of the prior on some columns (size,); None where there is none."""
    for block in problem.blocks:
        if isinstance(block, LinearBlock) and block.name.endswith(" prior"):
            row = (
                np.flatnonzero((block.columns == columns).all(axis=1))
                if (block.columns.shape[1] == len(columns))
                else np.empty(0)
            )
            if len(row):
                return unit / np.diagonal(block.matrix[int(row[0])])
    return None


def beacons_of(mission: Mission, shared: dict[str, Shared]) -> dict[str, Shared]:
    """Every beacon's position: estimated where it was an unknown, else as given."""
    return {
        b.name: shared.get(f"beacon {b.name}", Shared(b.position, np.zeros((3, 3))))
        for b in mission.beacons
    }


def _slow_state(
    problem: Problem, solution: Solution, marginals: Covariances, chain: Chain, name: str
) -> SlowState:
    variance = np.einsum("nii->ni", marginals.of(name)[chain.nodes])
    layout = problem.layout
    first = layout.node_columns(name, np.array([chain.first]))[0]
    prior = prior_sigma(problem, first, layout.unit(name))
    return SlowState(chain.t, layout.get(solution.x, name)[chain.nodes], np.sqrt(variance), prior)


def _range_residuals(
    problem: Problem, solution: Solution, chain: Chain, model: SegmentModel
) -> RangeResiduals | None:
    parts: list[RangeResiduals] = []
    for block, frozen in zip(problem.blocks, solution.frozen, strict=True):
        if not isinstance(block, RangeBlock) or block.chain != chain.name:
            continue
        pings: Pings = getattr(model.segment, block.name)
        assert frozen is not None
        whitened, _ = block.evaluate(solution.x, frozen, jacobian=False)
        at_once = isinstance(pings, SlantRange)
        parts.append(
            RangeResiduals(
                np.full(len(pings), block.name.removesuffix("_range")),
                pings.beacon,
                pings.t if at_once else pings.t_transmit,
                pings.t if at_once else pings.t_receive,
                measured_times(pings)[0],
                frozen,
                whitened[:, 0] * frozen,
                problem.loss.weights(whitened[:, 0]),
                block.found(solution.x),
            )
        )
    return RangeResiduals.joined(parts) if parts else None


def _unobserved_sigma(residuals: RangeResiduals | None, clock: SlowState | None) -> float:
    """Standard deviation (m) beyond which a track counts as not observed."""
    if residuals is None:
        return UNOBSERVED_SIGMA
    one_way = residuals.kind == "one_way"
    offset = 0.0 if clock is None else float(np.median(clock.value))
    ways = np.where(residuals.kind == "two_way", 2.0, 1.0)
    flight = (residuals.travel_time - np.where(one_way, offset, 0.0)) / ways
    return UNOBSERVED_SHARE * 1500.0 * float(np.median(np.abs(flight)))


def _status(
    solution: Solution,
    trajectory: Trajectory,
    limit: float,
    unresolved: BoolArray,
    rival: str | None,
) -> tuple[Status, str]:
    values, vectors = np.linalg.eigh(trajectory.covariance)
    sigma = np.sqrt(np.maximum(values[:, -1], 0.0))
    open_ = unresolved | (sigma > limit)
    if 2 * open_.sum() >= len(sigma):
        # The middle one of those that are open.
        nodes = np.flatnonzero(open_)
        node = int(nodes[np.argsort(sigma[nodes])[len(nodes) // 2]])
        rounding = ", which double precision does not resolve" if unresolved[node] else ""
        return "unobservable", (
            f"the data do not determine the track {direction(vectors[node, :, -1])} "
            f"(standard deviation {sigma[node]:.0f} m at half of the nodes or more{rounding})"
        )
    if rival is not None:
        return "unobservable", rival
    if not solution.converged:
        return "not converged", solution.trouble
    return "converged", ""


def direction(axis: FloatArray) -> str:
    """A direction in words: along the vertical, or its bearing."""
    if abs(axis[2]) > 0.9:
        return "vertically"
    bearing = round(float(np.rad2deg(np.arctan2(axis[0], axis[1])))) % 180
    return f"along {bearing}/{bearing + 180} degrees"


def chi_square_of(problem: LeastSquares, solution: Solution) -> tuple[float, int]:
    """Weighted sum of squared whitened residuals, and rows minus unknowns."""
    total, rows = 0.0, 0
    for block, frozen in zip(problem.blocks, solution.frozen, strict=True):
        r, _ = block.evaluate(solution.x, frozen, jacobian=False)
        weights = problem.loss.weights(r) if block.robust else 1.0
        total += float(np.sum(weights * r * r))
        rows += r.size
    return total, rows - problem.layout.size
