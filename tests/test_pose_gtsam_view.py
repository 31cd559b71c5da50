"""The GTSAM graph of pose nodes is the same problem, on its manifold, and ends at the same place.

GTSAM counts what is about the axes first, in the body; `result.trajectory` counts along the world's
axes first. GTSAM's own motion factors have approximate derivatives of their second half, so
gradients are compared where turns are small.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from problems import everything, everything_posed, posed_state, problem_of, state_of
from scipy.spatial.transform import Rotation
from test_pose_recovery import STEERED, beacons, rolling, screw

from ubl_graph import LeverArm, Mission, Options, Segment, SoundSpeedProfile, Vehicle, smooth
from ubl_graph.factors.poses import PoseMotion
from ubl_graph.gtsam_view import GraphView
from ubl_graph.pose_assembly import pose_trajectory
from ubl_graph.problem import Problem
from ubl_graph.sim import (
    Sea,
    ahrs,
    compass,
    dvl,
    gyro,
    odometer,
    planar_vehicle,
    pressure,
    slant_ranges,
    two_way_pings,
)
from ubl_graph.solve.banded import BandedEngine
from ubl_graph.solve.lm import GtsamEngine, parameters_of
from ubl_graph.solve.marginals import Marginals
from ubl_graph.solve.rounds import Solution, confirms, solve

NODES = pytest.mark.parametrize("node", ["pose2", "pose3"])
CASES = {
    "moving": {},
    "still": {"still": True},
    "huber, beacons known": {"estimate_beacons": False, "loss": "huber"},
    "heading bias of every node": {"heading_bias_walk_deg": 1.0, "loss": "none"},
    "still, geman-mcclure": {"still": True, "loss": "geman_mcclure"},
}
BY_CASE = pytest.mark.parametrize("options", CASES.values(), ids=list(CASES))
ABOUT_FIRST = [3, 4, 5, 0, 1, 2]


def local_slopes(view: GraphView, x: np.ndarray) -> np.ndarray:
    """Derivative of the flat vector by GTSAM's local coordinates, through GTSAM's own retract.

    Every variable is moved at once: each depends on its own coordinates alone.
    """
    values, variables = view.values(x), view.problem.layout.variables
    size, step = len(x), 1e-4
    out = np.zeros((size, size))
    for i in range(max(v.size for v in variables)):
        ends = []
        for sign in (1.0, -1.0):
            delta = gtsam.VectorValues()
            for variable, key in zip(variables, view.keys, strict=True):
                delta.insert(key, sign * step * (np.arange(variable.size) == i))
            ends.append(view.vector(values.retract(delta)))
        moved = (ends[0] - ends[1]) / (2.0 * step)
        for v in variables:
            if i < v.size:
                own = slice(v.column, v.column + v.size)
                out[own, v.column + i] = moved[own]
    return out


@NODES
@BY_CASE
def test_graph_has_the_problems_cost_and_gradient(node, options):
    """The motion factors' own derivatives are GTSAM's; all else is compared to rounding."""
    problem = problem_of(everything_posed(1, node=node, **options))
    x = posed_state(problem, 1)
    frozen = problem.frozen(x)
    view = GraphView(problem)
    graph, values = view.graph(frozen), view.values(x)
    assert graph.error(values) == pytest.approx(problem.cost(x, frozen), rel=1e-9)
    pairs = zip(problem.blocks, frozen, strict=True)
    others = [(b, held) for b, held in pairs if not isinstance(b, PoseMotion)]
    assert problem.layout.still == (len(others) == len(problem.blocks))
    problem = replace(problem, blocks=tuple(b for b, _ in others))
    assert_same_equations(problem, x, tuple(held for _, held in others), 1e-6)


def assert_same_equations(problem: Problem, x: np.ndarray, held: tuple, exact: float) -> None:
    """Gradient and Hessian in GTSAM's local coordinates, of the keys that the graph has."""
    view = GraphView(problem)
    graph, values = view.graph(held), view.values(x)
    present = set(graph.keyVector())
    hessian, minus_gradient = graph_of(graph, values, [k for k in view.keys if k in present])
    residual, jacobian = problem.linearize(x, held)
    dense = (jacobian.toarray() @ local_slopes(view, x))[:, columns_of(view, present)]
    expected = dense.T @ dense
    scale = np.sqrt(np.outer(expected.diagonal(), expected.diagonal()))
    np.testing.assert_allclose(hessian / scale, expected / scale, atol=exact)
    gradient = dense.T @ residual
    np.testing.assert_allclose(minus_gradient, -gradient, atol=exact * np.abs(gradient).max())


def graph_of(graph, values, keys) -> tuple[np.ndarray, np.ndarray]:
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    return graph.linearize(values).hessian(ordering)


def columns_of(view: GraphView, keys: set[int]) -> np.ndarray:
    """Columns of the variables under some keys."""
    held = zip(view.problem.layout.variables, view.keys, strict=True)
    return np.concatenate([v.column + np.arange(v.size) for v, key in held if key in keys])


@NODES
def test_motion_factors_have_the_same_equations_where_turns_are_small(node):
    problem = problem_of(everything_posed(2, node=node, node_spacing=4.0))
    x = posed_state(problem, 2, turning=0.0)
    block = next(b for b in problem.blocks if isinstance(b, PoseMotion))
    assert_same_equations(replace(problem, blocks=(block,)), x, (None,), 2e-3)


@NODES
@BY_CASE
def test_values_know_all_of_the_flat_vector(node, options):
    problem = problem_of(everything_posed(3, node=node, **options))
    x = posed_state(problem, 3)
    layout, view = problem.layout, GraphView(problem)
    np.testing.assert_allclose(view.vector(view.values(x)), x, rtol=1e-12, atol=1e-12)
    # A turn more is the same pose.
    name, turns = "rotation", layout.get(x, "rotation")
    length = np.linalg.norm(turns, axis=1, keepdims=True)
    y = x.copy()
    layout.put(y, name, turns * (1.0 + 2.0 * np.pi / length))
    back = view.vector(view.values(y))
    np.testing.assert_allclose(back, x, atol=1e-8)
    frozen = problem.frozen(x)
    assert problem.cost(y, frozen) == pytest.approx(problem.cost(x, frozen), rel=1e-9)


def assert_same_graphs(one, two, values) -> None:
    """Errors first, as an optimiser asks; then the rows' own systems."""
    assert one.error(values) == pytest.approx(two.error(values), rel=1e-11)
    pairs = zip(
        (one.at(i) for i in range(one.size() - two.size(), one.size())),
        (two.at(i) for i in range(two.size())),
        strict=True,
    )
    for batched, alone in pairs:
        assert batched.error(values) == pytest.approx(alone.error(values), rel=1e-9, abs=1e-12)
        assert list(batched.keys()) == list(alone.keys())
        systems = [factor.linearize(values).augmentedJacobian() for factor in (batched, alone)]
        scale = np.abs(systems[1]).max(initial=1e-12)
        np.testing.assert_allclose(systems[0] / scale, systems[1] / scale, atol=1e-9)


@pytest.mark.parametrize("node", ["point", "pose2", "pose3"])
@BY_CASE
def test_rows_evaluated_together_are_the_rows(node, options):
    if node == "point":
        kept = {k: v for k, v in options.items() if k != "still"}
        problem = problem_of(everything(1, **kept))
        at = state_of
    else:
        problem = problem_of(everything_posed(1, node=node, **options))
        at = posed_state
    x, y = at(problem, 1), at(problem, 2)
    frozen, view = problem.frozen(x), GraphView(problem)
    batched, alone = view.graph(frozen, batched=True), view.graph(frozen)
    assert batched.size() == alone.size() + 1
    for place in (x, y, x):
        assert_same_graphs(batched, alone, view.values(place))
    # Asked for rows at a point whose error was not asked for.
    last = batched.size() - 1
    systems = [g.at(g.size() - 1).linearize(view.values(y)) for g in (batched, alone)]
    np.testing.assert_allclose(*(s.augmentedJacobian() for s in systems), atol=1e-9)
    assert batched.at(last).error(view.values(y)) == pytest.approx(
        alone.at(last - 1).error(view.values(y))
    )


def test_rows_are_evaluated_together_once_an_iteration(monkeypatch):
    """And never one by one, while an optimiser runs."""
    problem = problem_of(everything_posed(2))
    x = posed_state(problem, 2, turning=0.01)
    view = GraphView(problem)
    block = next(b for b in problem.blocks if b.name == "attitude")
    asked, evaluate = [], block.evaluate

    def spying(x, frozen=None, rows=slice(None), jacobian=True):
        asked.append(rows)
        return evaluate(x, frozen, rows, jacobian)

    graph = view.graph(problem.frozen(x), batched=True)
    monkeypatch.setattr(block, "evaluate", spying)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, view.values(x), parameters_of(view))
    optimizer.iterate()
    assert asked
    assert all(rows == slice(None) for rows in asked)


# -- both engines on whole missions --


@cache
def missions() -> dict[str, Mission]:
    """Missions with noise whose motion GTSAM's approximate derivatives must cope with."""
    rng = np.random.default_rng(8)
    profile, sea = SoundSpeedProfile.constant(1500.0), Sea(SoundSpeedProfile.constant(1500.0))
    arm, fine, pings = LeverArm(1.2, -0.4, 0.6), np.arange(-1.0, 90.0, 0.25), np.arange(1.0, 85, 3)
    truth = rolling()
    common = {
        "two_way_range": two_way_pings(truth, beacons(), pings, sea, rng, arm=arm),
        "depth": pressure(truth, np.arange(0.0, 88.0, 2.0), rng),
    }
    attitude = ahrs(truth, fine, error=(0.03, 0.0, 0.0), rng=rng, white=2e-3)
    vehicle = Vehicle(transducer=arm)
    velocity = dvl(truth, fine, rng)
    ends = np.arange(0.0, 88.5, 1.5)
    growing = Options(node="pose3", odometry_noise="growing", heading_bias_sigma_deg=3.0)

    def mission(options: Options, **records) -> Mission:
        return Mission((Segment(**records),), beacons(), profile, vehicle, options)

    spatial = Options(node="pose3", heading_bias_sigma_deg=3.0, **STEERED)
    flat = screw(climb=0.0, pitch=0.0, roll=0.0)
    rates = gyro(flat, fine, rng, planar=True)
    planar = replace(spatial, node="pose2", heading_bias_walk_deg=0.5)
    hard = screw(turn=0.5)
    hard_pings = {
        "two_way_range": two_way_pings(hard, beacons(), pings, sea, rng, arm=arm),
        "depth": pressure(hard, np.arange(0.0, 88.0, 2.0), rng),
        "attitude": ahrs(hard, fine, rng=rng, white=2e-3),
    }
    hardly = Options(node="pose3", angular_acceleration_psd=1e-2, heading_bias_sigma_deg=0.0)
    return {
        "pose3, hard turns": mission(hardly, **hard_pings),
        "pose2, hard turns": mission(replace(hardly, node="pose2"), **hard_pings),
        "pose3, dvl and attitude": mission(spatial, velocity=velocity, attitude=attitude, **common),
        "pose3, motion prior alone": mission(
            Options(node="pose3", loss="none", acceleration_psd=0.02, angular_acceleration_psd=0.1),
            attitude=attitude,
            **common,
        ),
        "pose3, odometry": mission(
            growing,
            odometry=odometer(truth, ends, rng, growing),
            slant_range=slant_ranges(truth, beacons(), ends[::2], rng, arm=arm),
            heading=compass(truth, ends[::3], rng),
            depth=common["depth"],
        ),
        "pose2, dvl, gyro and compass": mission(
            planar,
            two_way_range=two_way_pings(flat, beacons(), pings, sea, rng, arm=arm),
            velocity=dvl(flat, fine, rng),
            heading=compass(flat, np.arange(0.0, 88.0), rng),
            angular_rate=rates,
            depth=pressure(flat, np.arange(0.0, 88.0, 2.0), rng),
        ),
        "pose2, odometry": planar_vehicle(4, duration=120.0)[0],
    }


NAMES = (
    "pose3, hard turns",
    "pose2, hard turns",
    "pose3, dvl and attitude",
    "pose3, motion prior alone",
    "pose3, odometry",
    "pose2, dvl, gyro and compass",
    "pose2, odometry",
)


#: How near both engines end, m, and their covariances, relative, where it is not 1e-6: there the
#: motion factor speaks, whose derivatives GTSAM approximates. Hard turns are 1.3 rad an interval.
EXACT = {
    "pose3, hard turns": (5e-4, 0.05),
    "pose3, motion prior alone": (5e-6, 1e-5),
    "pose3, dvl and attitude": (5e-6, 1e-5),
}


@cache
def both(name: str) -> tuple[Problem, np.ndarray, Solution, Solution]:
    """A mission's problem, a start near its answer, and where either engine ends from there."""
    mission = missions()[name]
    problem = problem_of(mission)
    layout, rng = problem.layout, np.random.default_rng(9)
    found = smooth(replace(mission, options=replace(mission.options, solver="banded")))
    assert found.status == "converged", found.reason
    track = found.segments[0].trajectory
    x = np.zeros(layout.size)
    place = track.position + 0.3 * rng.normal(size=track.position.shape)
    off = Rotation.from_rotvec(0.02 * rng.normal(size=(len(track.t), 3)))
    turned = Rotation.from_matrix(track.rotation) * off
    velocity = np.einsum("nji,nj->ni", track.rotation, track.velocity)
    planar = layout.node == "pose2"
    bow = turned.as_matrix()[:, :, 0]
    values = {
        "position": place[:, :2] if planar else place,
        "rotation": np.arctan2(bow[:, 1], bow[:, 0])[:, None] if planar else turned.as_rotvec(),
        "velocity": velocity[:, :2] if planar else velocity,
        "rate": track.rate[:, 2:] if planar else track.rate,
    }
    for state, value in values.items():
        if layout.has(state):
            layout.put(x, state, value)
    ends = [solve(engine(problem), x) for engine in (BandedEngine, GtsamEngine)]
    return problem, x, *ends


@pytest.mark.parametrize("name", NAMES)
def test_both_engines_end_at_the_same_place(name):
    problem, _, banded, theirs = both(name)
    assert banded.converged, banded.trouble
    assert theirs.converged, theirs.trouble
    layout = problem.layout
    apart = layout.positions(banded.x) - layout.positions(theirs.x)
    close, _ = EXACT.get(name, (1e-6, 1e-6))
    assert np.abs(apart).max() < close
    # The exact derivatives end lower, if anything.
    assert theirs.cost - banded.cost > -1e-9
    assert banded.cost == pytest.approx(theirs.cost, rel=1e-9 if close == 1e-6 else 1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_gtsam_confirms_the_banded_solver(name):
    problem, _, banded, _ = both(name)
    assert confirms(GtsamEngine(problem), banded)
    result = smooth(missions()[name])
    assert result.status == "converged"
    assert result.segments[0].solver == "banded, confirmed by gtsam"


@pytest.mark.parametrize("name", NAMES)
def test_covariances_are_those_of_gtsams_marginals(name):
    """Carried from its body's axes, about them first, to the world's axes, along them first."""
    problem, _, banded, _ = both(name)
    view, layout = GraphView(problem), problem.layout
    graph, values = view.graph(banded.frozen), view.values(banded.x)
    mission = missions()[name]
    chain, marginals = layout.chains[0], Marginals(problem, banded)
    track = pose_trajectory(problem, banded.x, marginals, chain, mission.options)
    np.testing.assert_array_equal(track.position, layout.positions(banded.x))
    theirs = gtsam.Marginals(graph, values)
    planar = layout.node == "pose2"
    held = [0, 1, 5] if planar else [0, 1, 2, 3, 4, 5]
    for k in range(0, layout.node_count, 7):
        body = theirs.marginalCovariance(gtsam.symbol("x", k))
        if not planar:
            body = body[np.ix_(ABOUT_FIRST, ABOUT_FIRST)]
        turn = np.zeros((6, 6))
        turn[:3, :3] = turn[3:, 3:] = track.rotation[k]
        turn = turn[np.ix_(held, held)]
        expected = turn @ body @ turn.T
        found = track.pose_covariance[k][np.ix_(held, held)]
        sigma = np.sqrt(np.diag(expected))
        gap = np.abs(found - expected) / np.outer(sigma, sigma)
        assert gap.max() < EXACT.get(name, (1e-6, 1e-6))[1]
