"""Whom the benchmark compares with, and the comparisons.

The rivals are GTSAM in three ways (our factors, the same as bare custom factors, its own C++
factors), scipy's least_squares, and an extended Kalman filter with a Rauch-Tung-Striebel smoother.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any
from unittest import mock

import benchmark_problems as problems
import gtsam
import numpy as np
from benchmark_problems import (
    BEACONS,
    ITERATIONS,
    PSD,
    SEED,
    SIGMA,
    SPACING,
    SPEED,
    START_ERROR,
    Case,
    circle,
)
from scipy import sparse
from scipy.optimize import least_squares

from ubl_graph.arrays import FloatArray
from ubl_graph.gtsam_view import GraphView
from ubl_graph.problem import Frozen
from ubl_graph.solve.banded import BandedDescent, BandedEngine
from ubl_graph.solve.lm import parameters_of
from ubl_graph.solve.rounds import INITIAL_LAMBDA, solve

#: At which scipy stops, and to which its linear solver works; looser ones leave its answer 0.1 mm
#: from the minimum.
SCIPY_TOLERANCE = 1e-12
#: Standard deviation of each component of the velocity at the filter's start, m/s.
FILTER_SPEED_SIGMA = 10.0
#: What is known of every pose beside its pings: rotation (rad) and place (m).
ROTATION_SIGMA, PLACE_SIGMA = 0.01, 5.0
#: Farthest that two solvers' positions of one problem may be apart, m.
POSITION_TOLERANCE = 1e-6
#: The same for covariances of the position, as a share of a block's largest entry.
COVARIANCE_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class GraphCase:
    """A graph as GTSAM's optimiser takes it.

    Attributes
    ----------
    graph : gtsam.NonlinearFactorGraph
        The factors.
    values : gtsam.Values
        The start.
    parameters : gtsam.LevenbergMarquardtParams
        Of the optimiser.
    """

    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    parameters: gtsam.LevenbergMarquardtParams

    def iterate(self) -> gtsam.LevenbergMarquardtOptimizer:
        """Some iterations of GTSAM's optimiser, ordering included."""
        optimizer = gtsam.LevenbergMarquardtOptimizer(self.graph, self.values, self.parameters)
        for _ in range(ITERATIONS):
            optimizer.iterate()
        return optimizer


def wrapped(case: Case, x: FloatArray, frozen: Frozen) -> GraphCase:
    """The problem's own graph, its range rows wrapped, each asked for alone."""
    view = GraphView(case.problem)
    return GraphCase(view.graph(frozen), view.values(x), parameters_of(view))


def plain(case: Case) -> GraphCase:
    """The same graph with each range row as the bare CustomFactor that one would write."""
    with mock.patch("ubl_graph.gtsam_view.wrapped", lambda factor, _: factor):
        return wrapped(case, case.start, case.problem.frozen(case.start))


def native(nodes: int) -> GraphCase:
    """The nearest thing to the simple problem that GTSAM's own C++ factors can say.

    A range is one-way, at the node, from a beacon that is a variable with a tight prior; the
    motion prior is the same. GTSAM's defaults are kept but for the first lambda, which is ours.
    """
    rng = np.random.default_rng(SEED)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    x, v, b = (gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.V, gtsam.symbol_shorthand.B)
    tight = gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)
    for j, beacon in enumerate(BEACONS):
        values.insert(b(j), np.array(beacon.position))
        graph.add(gtsam.PriorFactorPoint3(b(j), np.array(beacon.position), tight))
    wide = gtsam.noiseModel.Isotropic.Sigma(3, 10.0)
    graph.add(gtsam.PriorFactorVector(v(0), np.zeros(3), wide))
    sigma = 0.5 * SPEED * SIGMA
    noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma)
    psd = np.full(3, PSD)
    for k, place in enumerate(circle(SPACING * np.arange(nodes))[0]):
        values.insert(x(k), place + START_ERROR * rng.normal(size=3))
        values.insert(v(k), np.zeros(3))
        j = k % len(BEACONS)
        measured = np.linalg.norm(place - BEACONS[j].position) + sigma * rng.normal()
        graph.add(gtsam.RangeFactor3(x(k), b(j), measured, noise))
        if k:
            ends = [gtsam.StateData(x(i), v(i), SPACING * i) for i in (k - 1, k)]
            graph.add(gtsam.WnoaMotionFactorPoint3(*ends, psd))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setlambdaInitial(INITIAL_LAMBDA)
    return GraphCase(graph, values, parameters)


def held(nodes: int, ranges: bool) -> GraphCase:
    """Poses with GTSAM's own motion factors, each held by a loose prior, with or without pings.

    The priors, GTSAM's own, determine the poses where there are no pings.
    """
    case = problems.posed(nodes)
    frozen, problem = case.problem.frozen(case.start), case.problem
    if not ranges:
        kept = [i for i, block in enumerate(problem.blocks) if not block.robust]
        problem = replace(problem, blocks=tuple(problem.blocks[i] for i in kept))
        frozen = tuple(frozen[i] for i in kept)
    view = GraphView(problem)
    graph, values = view.graph(frozen, batched=ranges), view.values(case.start)
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([ROTATION_SIGMA] * 3 + [PLACE_SIGMA] * 3))
    for k in range(nodes):
        key = gtsam.symbol("x", k)
        graph.add(gtsam.PriorFactorPose3(key, values.atPose3(key), noise))
    return GraphCase(graph, values, parameters_of(view))


def marginals(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, nodes: int) -> FloatArray:
    """Covariances of position and of velocity of every node by gtsam.Marginals, (N, 2, 3, 3).

    The two blocks only: their joint covariance would take GTSAM far longer.
    """
    symbols = (gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.V)
    found = gtsam.Marginals(graph, values)
    return np.array([[found.marginalCovariance(s(k)) for s in symbols] for k in range(nodes)])


def by_scipy(case: Case) -> FloatArray:
    """Minimise by scipy.optimize.least_squares with the problem's sparse Jacobian: flat vector."""
    frozen = case.problem.frozen(case.start)
    last: list[tuple[FloatArray, FloatArray, sparse.csr_array]] = []

    def linearized(x: FloatArray) -> tuple[FloatArray, FloatArray, sparse.csr_array]:
        # scipy asks for the residuals and, if it takes the step, for the Jacobian there.
        if not last or not np.array_equal(last[0][0], x):
            last[:] = [(x.copy(), *case.problem.linearize(x, frozen))]
        return last[0]

    found = least_squares(
        lambda x: linearized(x)[1],
        case.start,
        jac=lambda x: linearized(x)[2],
        method="trf",
        x_scale="jac",
        tr_solver="lsmr",
        tr_options={"atol": SCIPY_TOLERANCE, "btol": SCIPY_TOLERANCE, "maxiter": 20 * case.nodes},
        ftol=SCIPY_TOLERANCE,
        xtol=SCIPY_TOLERANCE,
        gtol=SCIPY_TOLERANCE,
    )
    return found.x


def filtered(case: Case) -> tuple[FloatArray, FloatArray]:
    """Extended Kalman filter with a Rauch-Tung-Striebel smoother on the simple problem.

    A reply is worked in when it is heard. Where the vehicle was when it pinged is no longer in the
    state; p - v dt stands in for it, so the model is an approximate one.

    Returns
    -------
    array, shape (N, 6)
        Smoothed positions (m) and velocities (m/s).
    array, shape (N, 6, 6)
        Their covariances.
    """
    step = np.kron([[1.0, SPACING], [0.0, 1.0]], np.eye(3))
    moments = [[SPACING**3 / 3.0, SPACING**2 / 2.0], [SPACING**2 / 2.0, SPACING]]
    noise = PSD * np.kron(moments, np.eye(3))
    mean, cov, ahead, ahead_cov = _forward(case, step, noise)
    # All gains at once; only the recursion itself has to go node by node.
    gain = np.swapaxes(np.linalg.solve(ahead_cov[1:], step @ cov[:-1]), 1, 2)
    for k in range(case.nodes - 2, -1, -1):
        mean[k] += gain[k] @ (mean[k + 1] - ahead[k + 1])
        cov[k] += gain[k] @ (cov[k + 1] - ahead_cov[k + 1]) @ gain[k].T
    return mean, cov


def _forward(
    case: Case, step: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Filtered means and covariances at all nodes, and the predicted ones."""
    pings = case.mission.segments[0].two_way_range
    assert pings is not None
    sites = np.array([b.position for b in BEACONS])[case.mission.beacon_numbers(pings.beacon)]
    measured = SPEED * pings.travel_time
    variance = (SPEED * SIGMA) ** 2
    # Both legs' ends as rows of one matrix times the state: (p, p - v dt).
    ends = np.kron([[1.0, 0.0], [1.0, -SPACING]], np.eye(3))
    m = np.concatenate([case.positions(case.start)[0], np.zeros(3)])
    c = np.diag(np.repeat([START_ERROR**2, FILTER_SPEED_SIGMA**2], 3))
    mean, cov = np.empty((case.nodes, 6)), np.empty((case.nodes, 6, 6))
    ahead, ahead_cov = np.empty_like(mean), np.empty_like(cov)
    mean[0], cov[0], ahead[0], ahead_cov[0] = m, c, m, c
    for k in range(1, case.nodes):
        m, c = step @ m, step @ c @ step.T + noise
        ahead[k], ahead_cov[k] = m, c
        to = (ends @ m).reshape(2, 3) - sites[k - 1]
        distance = np.sqrt((to * to).sum(axis=1))
        row = (to / distance[:, None]).ravel() @ ends
        with_row = c @ row
        gain = with_row / (row @ with_row + variance)
        m = m + gain * (measured[k - 1] - distance.sum())
        c = c - np.outer(gain, with_row)
        mean[k], cov[k] = m, c
    return mean, cov, ahead, ahead_cov


@dataclass(frozen=True)
class Pair:
    """One comparison.

    Attributes
    ----------
    name : str
        As in the file that `benchmark.py --json` writes.
    nodes : int
        Of the problem, as it was asked for.
    ours_s, theirs_s : float
        Median times, s.
    difference : float, optional
        Largest distance between positions, m, or relative difference of covariances. Left out
        where the two do not solve the same problem.
    tolerance : float
        What the difference may be.
    note : str
        For the table.
    """

    name: str
    nodes: int
    ours_s: float
    theirs_s: float
    difference: float | None = None
    tolerance: float = POSITION_TOLERANCE
    note: str = ""

    @property
    def ratio(self) -> float:
        """Our time over theirs."""
        return self.ours_s / self.theirs_s

    @property
    def agrees(self) -> bool:
        """Whether both gave the same answer; what is not a number does not."""
        return self.difference is None or self.difference <= self.tolerance


def race(repeats: int, **runners: Callable[[], Any]) -> tuple[dict[str, float], dict[str, Any]]:
    """Run all in turns: median seconds and last outcome of each."""
    seconds: dict[str, list[float]] = {name: [] for name in runners}
    outcomes: dict[str, Any] = {}
    for _ in range(repeats):
        for name, run in runners.items():
            outcomes.pop(name, None)  # what the last run left is freed off the clock
            begin = time.perf_counter()
            outcomes[name] = run()
            seconds[name].append(time.perf_counter() - begin)
    return {name: float(np.median(times)) for name, times in seconds.items()}, outcomes


def compare_simple(nodes: int, repeats: int) -> list[Pair]:
    """Banded, and GTSAM with our factors and with its own, on the simple problem."""
    case = problems.simple(nodes)
    graph = wrapped(case, case.start, case.problem.frozen(case.start))
    seconds, found = race(
        repeats,
        banded=lambda: problems.banded(case)[0],
        wrapped=graph.iterate,
        native=native(nodes).iterate,
    )
    check_steps(*found.values())
    apart = farthest(case.positions(found["banded"].vector()), positions(found["wrapped"], nodes))
    ours, ours_in_gtsam, theirs = seconds.values()
    return [
        Pair("banded_vs_native", nodes, ours, theirs),
        Pair("banded_vs_wrapped_gtsam", nodes, ours, ours_in_gtsam, apart),
        Pair("gtsam_vs_native", nodes, ours_in_gtsam, theirs),
    ]


def compare_plain(nodes: int, repeats: int) -> Pair:
    """Our factors in GTSAM's optimiser, wrapped and as bare custom factors."""
    case = problems.simple(nodes)
    graph = wrapped(case, case.start, case.problem.frozen(case.start))
    seconds, found = race(repeats, wrapped=graph.iterate, plain=plain(case).iterate)
    check_steps(*found.values())
    apart = farthest(*(positions(optimizer, nodes) for optimizer in found.values()))
    return Pair("gtsam_vs_plain_custom", nodes, *seconds.values(), difference=apart)


def compare_full(nodes: int, repeats: int) -> Pair:
    """The full mission: banded, and GTSAM's optimiser with the same factors."""
    case = problems.full(nodes)
    graph = wrapped(case, case.start, case.problem.frozen(case.start))
    seconds, found = race(repeats, banded=lambda: problems.banded(case)[0], wrapped=graph.iterate)
    check_steps(*found.values())
    apart = farthest(
        case.positions(found["banded"].vector()), positions(found["wrapped"], case.nodes)
    )
    share = problems.share_between_nodes(case.problem)
    note = f"{share:.0%} of the pings' ends between nodes"
    return Pair("full_vs_wrapped_gtsam", nodes, *seconds.values(), difference=apart, note=note)


def compare_poses(nodes: int, repeats: int) -> Pair:
    """GTSAM's optimiser on poses: with one ping a node, and the same without."""
    graphs = {name: held(nodes, ranges=name == "with_pings") for name in ("with_pings", "without")}
    seconds, found = race(repeats, **{name: g.iterate for name, g in graphs.items()})
    check_steps(*found.values())
    return Pair("poses_with_vs_without_pings", nodes, *seconds.values())


def compare_marginals(nodes: int, repeats: int) -> Pair:
    """Covariances of all nodes: 6x6 by the banded recursion, two 3x3 by gtsam.Marginals."""
    case = problems.simple(nodes)
    solution = solve(BandedEngine(case.problem), case.start)
    graph = wrapped(case, solution.x, solution.frozen)
    seconds, found = race(
        repeats,
        banded=lambda: problems.covariances(case, solution),
        gtsam=lambda: marginals(graph.graph, graph.values, nodes),
    )
    ours, theirs = found["banded"][:, :3, :3], found["gtsam"][:, 0]
    off = np.max(np.abs(ours - theirs), axis=(1, 2)) / np.max(np.abs(theirs), axis=(1, 2))
    times = tuple(seconds.values())
    return Pair("marginals_vs_gtsam", nodes, *times, float(off.max()), COVARIANCE_TOLERANCE)


def compare_scipy(nodes: int, repeats: int) -> Pair:
    """Both to the minimum: banded, and scipy's trust region on the same residuals."""
    case = problems.simple(nodes)
    seconds, found = race(
        repeats,
        banded=lambda: solve(BandedEngine(case.problem), case.start).x,
        scipy=lambda: by_scipy(case),
    )
    apart = farthest(*(case.positions(x) for x in found.values()))
    return Pair("banded_vs_scipy", nodes, *seconds.values(), difference=apart)


def compare_kalman(nodes: int, repeats: int) -> Pair:
    """Estimate and covariances: banded, and the filter with its smoother."""
    case = problems.simple(nodes)

    def ours() -> FloatArray:
        solution = problems.banded_solution(case)
        problems.covariances(case, solution)
        return case.positions(solution.x)

    seconds, found = race(repeats, banded=ours, kalman=lambda: filtered(case)[0][:, :3])
    rms = ", ".join(f"{case.rms(places):.3f}" for places in found.values())
    return Pair("banded_vs_kalman", nodes, *seconds.values(), note=f"rms error {rms} m")


def check_steps(*runs: Any) -> None:
    """Make sure that all runs solved equally many systems: a rejected step costs one more.

    Raises
    ------
    RuntimeError
        Where they ended with different lambdas.
    """
    lambdas = [run.damping if isinstance(run, BandedDescent) else run.lambda_() for run in runs]
    if not np.allclose(lambdas, lambdas[0], rtol=1e-6, atol=0.0):
        raise RuntimeError(f"the runs took different steps: their lambdas ended at {lambdas}")


def positions(optimizer: gtsam.LevenbergMarquardtOptimizer, nodes: int) -> FloatArray:
    """Node positions where an optimiser is, (N, 3), m."""
    values = optimizer.values()
    return np.array([values.atPoint3(gtsam.symbol_shorthand.X(k)) for k in range(nodes)])


def farthest(a: FloatArray, b: FloatArray) -> float:
    """Largest distance between positions (N, 3), m."""
    return float(np.max(np.linalg.norm(a - b, axis=1)))
