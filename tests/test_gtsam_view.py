"""The GTSAM graph is the same problem: cost, gradient, Hessian; GTSAM's own factors as oracles."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import everything, problem_of, state_of

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.beacon import Beacon
from ubl_graph.factors import linear
from ubl_graph.factors.loss import RobustLoss
from ubl_graph.gtsam_view import GraphView, jacobian_factor
from ubl_graph.layout import Chain, Layout
from ubl_graph.measurements import Depth, TwoWayRange
from ubl_graph.mission import Mission, Segment
from ubl_graph.options import Options
from ubl_graph.problem import Problem
from ubl_graph.solve.lm import GtsamEngine
from ubl_graph.solve.marginals import Marginals
from ubl_graph.solve.rounds import solve

X, V = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.V
CASES = [
    {},
    {"motion": "constant_acceleration"},
    {"estimate_beacons": False, "loss": "huber"},
    {"loss": "geman_mcclure"},
    {"loss": "dcs", "rays": "straight"},
    {"loss": "none", "estimate_sound_speed": False},
]


@pytest.mark.parametrize("options", CASES, ids=str)
def test_graph_has_the_problems_cost_gradient_and_hessian(options):
    problem = problem_of(everything(1, **options))
    x = state_of(problem, 1)
    frozen = problem.frozen(x)
    view = GraphView(problem)
    graph, values = view.graph(frozen), view.values(x)
    np.testing.assert_array_equal(view.vector(values), x)
    assert graph.error(values) == pytest.approx(problem.cost(x, frozen), rel=1e-10)
    hessian, minus_gradient = graph.linearize(values).hessian(view.ordering())
    residual, jacobian = problem.linearize(x, frozen)
    dense = (jacobian.T @ jacobian).toarray()
    scale = np.sqrt(np.outer(dense.diagonal(), dense.diagonal()))
    np.testing.assert_allclose(hessian / scale, dense / scale, atol=1e-9)
    gradient = jacobian.T @ residual
    np.testing.assert_allclose(
        minus_gradient, -gradient, rtol=1e-7, atol=1e-7 * np.abs(gradient).max()
    )


def test_callbacks_see_their_own_keys_only():
    """What keeps LM linear: a plain CustomFactor is handed all values at each callback."""
    problem = problem_of(everything(2, estimate_beacons=False))
    x = state_of(problem, 2)
    view = GraphView(problem)
    sizes: list[int] = []
    block = next(b for b in problem.blocks if b.name == "two_way_range")
    original = view._callback

    def spying(*args):
        inner = original(*args)

        def callback(factor, values, jacobians):
            sizes.append(values.size())
            return inner(factor, values, jacobians)

        return callback

    view._callback = spying
    graph = view.graph(problem.frozen(x))
    gtsam.LevenbergMarquardtOptimizer(graph, view.values(x)).iterate()
    assert len(sizes) >= 2 * len(block)
    assert max(sizes) <= 12 < problem.layout.node_count


@given(n=st.integers(1, 9), rows=st.integers(1, 9), seed=st.integers(0, 10_000))
@settings(max_examples=60, derandomize=True, deadline=None)
def test_jacobian_factor_of_any_number_of_keys_is_exact(n, rows, seed):
    rng = np.random.default_rng(seed)
    sizes = rng.integers(1, 4, n)
    blocks = [np.asfortranarray(rng.normal(size=(rows, s))) for s in sizes]
    b = rng.normal(size=rows)
    keys = [gtsam.symbol("x", i) for i in range(n)]
    factor = jacobian_factor(keys, blocks, b, gtsam.noiseModel.Unit.Create(rows))
    x = [rng.normal(size=s) for s in sizes]
    values = gtsam.VectorValues()
    for key, value in zip(keys, x, strict=True):
        values.insert(key, value)
    r = sum(block @ v for block, v in zip(blocks, x, strict=True)) - b
    # The error of a Gaussian factor may lack a constant (what no choice of x can mend).
    whole = np.hstack(blocks)
    least = b - whole @ np.linalg.lstsq(whole, b, rcond=None)[0]
    zero = gtsam.VectorValues()
    for key, size in zip(keys, sizes, strict=True):
        zero.insert(key, np.zeros(size))
    gained = factor.error(values) - factor.error(zero)
    assert gained == pytest.approx(0.5 * r @ r - 0.5 * b @ b, rel=1e-9, abs=1e-9)
    assert factor.error(zero) >= 0.5 * (b @ b - least @ least) - 1e-9


@pytest.mark.parametrize("seed", range(4))
def test_motion_block_is_gtsams_own_wnoa_factor(seed):
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.1, 20.0, 6))
    layout = Layout((Chain("", 0, t),), 2)
    psd = rng.uniform(1e-4, 1.0, 3)
    block = linear.motion(layout, layout.chains[0], np.tile(psd, (5, 1)))
    problem = Problem(layout, (block,), RobustLoss("none"), (1.0, 1.0))
    x = rng.normal(size=layout.size) * 10.0
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    position, velocity = layout.get(x, "position"), layout.get(x, "velocity")
    for k in range(6):
        values.insert(X(k), position[k])
        values.insert(V(k), velocity[k])
    for k in range(5):
        ends = [gtsam.StateData(X(i), V(i), t[i]) for i in (k, k + 1)]
        graph.add(gtsam.WnoaMotionFactorPoint3(*ends, psd))
    assert problem.cost(x, (None,)) == pytest.approx(graph.error(values), rel=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_interpolated_position_is_gtsams_own(seed):
    """GTSAM's interpolated factor around a prior at a time between two nodes."""
    rng = np.random.default_rng(seed)
    t = np.array([3.0, 3.0 + rng.uniform(1.0, 20.0)])
    time = rng.uniform(t[0] + 0.1, t[1] - 0.1)
    layout = Layout((Chain("", 0, t),), 2)
    psd = rng.uniform(1e-4, 1.0, 3)
    x = rng.normal(size=layout.size) * 10.0
    values = gtsam.Values()
    for k in range(2):
        values.insert(X(k), layout.get(x, "position")[k])
        values.insert(V(k), layout.get(x, "velocity")[k])
    measured, sigma = rng.normal(size=3), 0.3
    inner = gtsam.PriorFactorPoint3(X(7), measured, gtsam.noiseModel.Isotropic.Sigma(3, sigma))
    states = {gtsam.StateData(X(k), V(k), t[k]) for k in range(2)}
    between = {gtsam.StateData(X(7), V(7), time)}
    place = layout.positions_at(layout.chains[0], np.array([time]))
    for fixed in (True, False):
        factor = gtsam.WnoaInterpFactorPoint3(inner, states, between, psd, fixed)
        extra = 0.0 if fixed else psd * ((time - t[0]) * (t[1] - time) / (t[1] - t[0])) ** 3 / 3.0
        covariance = np.diag(sigma**2 + extra * np.ones(3))[None]
        block = linear.position_fix(place, np.zeros((1, 3)), measured[None], covariance)
        r, _ = block.evaluate(x)
        if fixed:
            assert 0.5 * np.vdot(r, r) == pytest.approx(factor.error(values), rel=1e-7)
        else:
            ours = block.matrix[0]
            theirs = factor.linearize(values).jacobian()[0]
            np.testing.assert_allclose(np.linalg.svd(ours)[1], np.linalg.svd(theirs)[1], rtol=1e-5)


def drifting_mission(loss: str = "cauchy") -> tuple[Mission, np.ndarray]:
    """A vehicle on a straight line between four beacons, and its true node positions."""
    beacons = tuple(
        Beacon(f"B{i}", [600.0 * np.cos(a), 600.0 * np.sin(a), -500.0])
        for i, a in enumerate(np.arange(4) * np.pi / 2)
    )
    t = np.arange(0.0, 200.0, 5.0)

    def position(times):
        return np.stack([1.0 * times - 90.0, 0.3 * times, 0 * times - 10.0], axis=-1)

    which = np.arange(len(t)) % 4
    receive = t + 1.0
    for _ in range(30):
        out, back = (
            np.linalg.norm(position(at) - [beacons[i].position for i in which], axis=1)
            for at in (t, receive)
        )
        receive = t + (out + back) / 1500.0 + 0.2
    pings = TwoWayRange([beacons[i].name for i in which], t, receive, receive - t - 0.2, 1e-4)
    times = np.unique(np.concatenate([t, receive]))
    segment = Segment("", pings, depth=Depth(times, 10.0, 0.05))
    # A wide speed prior: the default one pulls the line's uncertain ends by some 0.2 mm.
    options = Options(estimate_sound_speed=False, loss=loss, speed_sigma=1e3)
    return Mission((segment,), beacons, SoundSpeedProfile.constant(1500.0), options=options), times


def test_a_clock_that_nothing_observes_has_a_covariance_all_the_same():
    """Robust weights of nonsense pings leave the clock to its wide prior and its tight walk."""
    problem = problem_of(everything(4))
    solution = solve(GtsamEngine(problem), state_of(problem, 4), max_iterations=3)
    marginals = Marginals(problem, solution)
    assert np.isfinite(marginals.of("position")).all()
    assert np.sqrt(marginals.of("clock_offset")).max() > 1e-3


def test_gtsam_lm_ends_where_the_gradient_of_our_cost_vanishes():
    mission, _ = drifting_mission()
    problem = problem_of(mission)
    rng = np.random.default_rng(0)
    x = np.zeros(problem.layout.size)
    t = problem.layout.chains[0].t
    truth = np.stack([t - 90.0, 0.3 * t, 0 * t - 10.0], axis=1)
    problem.layout.put(x, "position", truth + rng.normal(size=truth.shape) * [20.0, 20.0, 0.1])
    solution = solve(GtsamEngine(problem), x)
    assert solution.converged
    residual, jacobian = problem.linearize(solution.x, solution.frozen)
    hessian = (jacobian.T @ jacobian).toarray()
    step = np.linalg.solve(hessian, jacobian.T @ residual)
    assert np.abs(step).max() < 1e-6
    np.testing.assert_allclose(problem.layout.get(solution.x, "position"), truth, atol=1e-4)


def test_marginals_are_the_inverse_of_the_normal_matrix():
    problem = problem_of(everything(4, loss="none", clock_offset_sigma=1e-3))
    x = state_of(problem, 4)
    solution = solve(GtsamEngine(problem), x, max_iterations=3)
    marginals = Marginals(problem, solution)
    _, jacobian = problem.linearize(solution.x, solution.frozen)
    dense = (jacobian.T @ jacobian).toarray()
    scale = 1.0 / np.sqrt(dense.diagonal())
    covariance = np.linalg.inv(dense * scale * scale[:, None]) * scale * scale[:, None]
    layout = problem.layout
    for name in ("position", "velocity", "sound_speed", "current", "dvl_scale", "beacon B2"):
        unit = layout.unit(name)
        found = marginals.of(name)
        columns = layout._columns(name)
        if found.ndim == 2:
            expected = covariance[np.ix_(columns, columns)] * unit**2
        else:
            expected = np.stack([covariance[np.ix_(c, c)] for c in columns]) * unit**2
        np.testing.assert_allclose(found, expected, rtol=2e-4, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("motion", ["constant_velocity", "constant_acceleration"])
def test_marginals_are_gtsams_own_where_it_can_compute_them(motion):
    mission, _ = drifting_mission()
    options = replace(mission.options, motion=motion, estimate_sound_speed=True)
    problem = problem_of(replace(mission, options=options))
    layout = problem.layout
    x = np.zeros(layout.size)
    t = layout.chains[0].t
    layout.put(x, "position", np.stack([t - 90.0, 0.3 * t, 0 * t - 10.0], axis=1))
    solution = solve(GtsamEngine(problem), x)
    ours = Marginals(problem, solution)
    view = GraphView(problem)
    theirs = gtsam.Marginals(view.graph(solution.frozen), view.values(solution.x))
    for letter, name in (("x", "position"), ("v", "velocity"), ("g", "sound_speed")):
        unit = layout.unit(name) ** 2
        for k, block in enumerate(ours.of(name)):
            expected = unit * theirs.marginalCovariance(gtsam.symbol(letter, k))
            np.testing.assert_allclose(block, expected, rtol=1e-6, atol=1e-8 * expected.max())
