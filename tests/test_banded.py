"""The banded solver: its equations against dense ones, its steps and answers against GTSAM's."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from problems import everything, problem_of, state_of

import ubl_graph.solve.choice
from ubl_graph import (
    Beacon,
    Depth,
    Mission,
    OneWayRange,
    Options,
    Segment,
    SoundSpeedProfile,
    Start,
    TwoWayRange,
    smooth,
)
from ubl_graph.errors import SolverError
from ubl_graph.gtsam_view import GraphView
from ubl_graph.problem import Problem
from ubl_graph.result import Result
from ubl_graph.sim import (
    Clock,
    Sea,
    Truth,
    ahrs,
    constant_velocity,
    demo_survey,
    dvl,
    fixes,
    one_way_pings,
    pressure,
    straight_pass,
    two_way_pings,
)
from ubl_graph.solve.banded import BandedDescent, BandedEngine, BandedFactor
from ubl_graph.solve.choice import choose
from ubl_graph.solve.lm import GtsamEngine
from ubl_graph.solve.marginals import Marginals, selected_inverse
from ubl_graph.solve.normal import NormalEquations, Point
from ubl_graph.solve.rounds import LARGEST_LAMBDA, Solution, confirms, solve

PROFILE = SoundSpeedProfile.constant(1495.0)
POSITION = 1e-6
COVARIANCE = 1e-6


def assert_same_covariance(a: np.ndarray, b: np.ndarray, tolerance: float = COVARIANCE) -> None:
    """Entries differ by less than 1e-6 of what their variances allow."""
    sigma = np.sqrt(np.einsum("...ii->...i", a))
    assert np.max(np.abs(a - b) / (sigma[..., :, None] * sigma[..., None, :])) < tolerance


def rounding(matrix: np.ndarray) -> float:
    """What rounding may make of an inverse, as a share of what its variances allow."""
    scale = 1.0 / np.sqrt(matrix.diagonal())
    return 50 * np.finfo(float).eps * float(np.linalg.cond(matrix * np.outer(scale, scale)))


def assert_same_result(a: Result, b: Result) -> None:
    """Everything that a user reads agrees."""
    assert a.status == b.status
    for one, other in zip(a.segments, b.segments, strict=True):
        gap = one.trajectory.position - other.trajectory.position
        assert np.abs(gap).max() < POSITION
        assert one.trajectory.joint is not None and other.trajectory.joint is not None
        assert_same_covariance(one.trajectory.joint.node, other.trajectory.joint.node)
        for name, state in one.slow.items():
            np.testing.assert_allclose(state.sigma, other.slow[name].sigma, rtol=1e-6)
            gap = np.abs(state.value - other.slow[name].value) / state.sigma
            assert gap.max() < 1e-4, name
    for name, shared in {**a.shared, **a.beacons}.items():
        other = b.shared[name] if name in b.shared else b.beacons[name]
        gap = np.abs(shared.value - other.value)
        assert (gap <= 1e-6 * np.maximum(shared.sigma, 1.0)).all(), name
        if shared.sigma.all():
            assert_same_covariance(shared.covariance, other.covariance)


def by(mission: Mission, solver: str) -> Result:
    return smooth(replace(mission, options=replace(mission.options, solver=solver)))


# ------------------------------------------------------------------------------- random graphs


@st.composite
def graphs(draw) -> tuple[Mission, Truth]:
    """Missions of every make: node spacing, spans of pings, slow states, borders, segments."""
    seed = draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    spacing = draw(st.floats(0.3, 8.0))
    turnaround = draw(st.floats(0.0, 6.0)) * spacing
    pings = draw(st.integers(6, 25))
    sent = spacing * np.arange(pings) + rng.uniform(0.0, 0.3 * spacing, pings)
    end = float(sent[-1] + turnaround + 3.0)
    beacons = tuple(
        Beacon(
            f"B{i}",
            [300.0 * np.cos(a), 300.0 * np.sin(a), -120.0 - 5.0 * i],
            sigma=2.0,
            turnaround=turnaround,
        )
        for i, a in enumerate(rng.uniform(0.0, 0.8) + np.arange(4) * np.pi / 2.0)
    )
    speed = draw(st.floats(0.0, 2.0))
    truth = constant_velocity([-20.0, 10.0, -60.0], [speed, 0.3, 0.0], (-2.0, end + 2.0))
    sea, noise = Sea(PROFILE), draw(st.sampled_from([0.0, 1.0]))
    kinds = {"two_way_range": two_way_pings(truth, beacons, sent, sea, rng, noise=noise)}
    times = np.arange(0.0, end, draw(st.floats(0.7, 4.0)))
    kinds["depth"] = pressure(truth, times, rng, noise=noise)
    if draw(st.booleans()):
        heard = np.sort(rng.uniform(1.0, end - 1.0, 8))
        clock = Clock(0.3, 2e-6)
        kinds["one_way_range"] = one_way_pings(
            truth, beacons, heard, sea, rng, clock=clock, noise=noise
        )
    if draw(st.booleans()):
        reference = draw(st.sampled_from(["bottom", "water"]))
        moved = dvl(truth, np.arange(0.0, 0.8 * end, 0.5), rng, noise=noise)
        kinds["velocity"] = replace(moved, reference=np.full(len(moved), reference))
        kinds["attitude"] = ahrs(truth, np.arange(-1.0, end + 1.0, 1.0))
    if draw(st.booleans()):
        kinds["position"] = fixes(truth, sent[::4], rng, noise=noise)
    options = Options(
        motion=draw(st.sampled_from(["constant_velocity", "constant_acceleration"])),
        loss=draw(st.sampled_from(["cauchy", "huber", "none"])),
        acceleration_psd=draw(st.sampled_from([1e-5, 2e-3, 1e-1])),
        estimate_sound_speed=draw(st.booleans()),
        estimate_beacons=draw(st.booleans()),
        estimate_current="velocity" in kinds and "water" in kinds["velocity"].reference,
    )
    return Mission((Segment("", **kinds),), beacons, PROFILE, options=options), truth


def near(problem: Problem, truth: Truth, seed: int = 0) -> np.ndarray:
    """A start within a few metres of the truth."""
    rng = np.random.default_rng(seed)
    layout = problem.layout
    t = np.concatenate([chain.t for chain in layout.chains])
    x = np.zeros(layout.size)
    layout.put(x, "position", truth.position(t) + rng.normal(size=(len(t), 3)))
    layout.put(x, "velocity", truth.velocity(t))
    return x


def with_beacons(problem: Problem, mission: Mission, x: np.ndarray) -> np.ndarray:
    for beacon in mission.beacons:
        if problem.layout.has(f"beacon {beacon.name}"):
            problem.layout.put(x, f"beacon {beacon.name}", beacon.position + 0.5)
    return x


def dense(problem: Problem, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    residual, jacobian = problem.linearize(x, problem.frozen(x))
    return (jacobian.T @ jacobian).toarray(), jacobian.T @ residual


def unbanded(equations: NormalEquations, x: np.ndarray) -> np.ndarray:
    """The assembled matrix, spread out."""
    problem = equations.problem
    band, coupling, corner = equations.matrix(equations.evaluate(x, problem.frozen(x)))
    inner, n = band.shape[1], problem.layout.size
    out = np.zeros((n, n))
    for lag, diagonal in enumerate(band):
        rows = np.arange(lag, inner)
        out[rows, rows - lag] = diagonal[: inner - lag]
    out[inner:, :inner] = coupling.T
    out[inner:, inner:] = np.tril(corner)
    return out + np.tril(out, -1).T


@given(graphs())
@settings(max_examples=40, derandomize=True, deadline=None)
def test_random_graphs_have_the_dense_equations(drawn):
    mission, truth = drawn
    problem = problem_of(mission)
    x = with_beacons(problem, mission, near(problem, truth))
    equations = NormalEquations(problem)
    matrix, gradient = dense(problem, x)
    scale = np.sqrt(np.outer(matrix.diagonal(), matrix.diagonal()))
    np.testing.assert_allclose(unbanded(equations, x) / scale, matrix / scale, atol=1e-12)
    frozen = problem.frozen(x)
    point = equations.evaluate(x, frozen)
    assert point.cost == pytest.approx(problem.cost(x, frozen), rel=1e-12)
    np.testing.assert_allclose(
        equations.gradient(point), gradient, atol=1e-9 * np.abs(gradient).max()
    )


@given(graphs())
@settings(max_examples=25, derandomize=True, deadline=None)
def test_random_graphs_have_one_answer_by_both_engines(drawn):
    mission, truth = drawn
    problem = problem_of(mission)
    x = with_beacons(problem, mission, near(problem, truth))
    ours, theirs = solve(BandedEngine(problem), x), solve(GtsamEngine(problem), x)
    assert ours.converged and theirs.converged
    assert ours.cost == pytest.approx(theirs.cost, rel=1e-9, abs=1e-9)
    a, b = (problem.layout.get(s.x, "position") for s in (ours, theirs))
    assert np.abs(a - b).max() < POSITION
    one, other = Marginals(problem, ours), Marginals(problem, theirs)
    # Six pings for eighteen unknowns are known to hundreds of metres: the two answers, a picometre
    # apart, have covariances that differ by rounding.
    tolerance = max(COVARIANCE, rounding(dense(problem, ours.x)[0]))
    for name in ("position", "velocity", *(n for n, _ in problem.layout.shared)):
        assert_same_covariance(one.of(name), other.of(name), tolerance)


@given(graphs())
@settings(max_examples=25, derandomize=True, deadline=None)
def test_random_graphs_have_the_dense_inverse(drawn):
    """Nodes, neighbours and shared unknowns; scaled, since priors of 1e5 m stand beside 1e-4 s."""
    mission, truth = drawn
    problem = problem_of(mission)
    layout = problem.layout
    x = with_beacons(problem, mission, near(problem, truth))
    solution = Solution(x, problem.frozen(x), 0.0, 0, "")
    found = Marginals(problem, solution)
    matrix, _ = dense(problem, x)
    scale = 1.0 / np.sqrt(matrix.diagonal())
    scaled = matrix * np.outer(scale, scale)
    condition = np.linalg.cond(scaled)
    assume(condition < 1e12)  # beyond, the dense inverse is no oracle
    inverse = np.linalg.inv(scaled) * np.outer(scale, scale)
    tolerance = max(COVARIANCE, 50 * np.finfo(float).eps * condition)
    names = ["position", "velocity"]
    nodes = np.arange(layout.node_count)
    columns = np.concatenate([layout.node_columns(n, nodes) for n in names], axis=1)
    sigma = np.sqrt(inverse.diagonal())[columns]
    expected = np.stack([inverse[np.ix_(c, c)] for c in columns])
    error = np.abs(found.joint(names) - expected) / (sigma[:, :, None] * sigma[:, None, :])
    assert error.max() < tolerance
    expected = np.stack([inverse[np.ix_(a, b)] for a, b in pairwise(columns)])
    error = np.abs(found.following(names) - expected)
    assert (error / (sigma[:-1, :, None] * sigma[1:, None, :])).max() < tolerance
    for name, _ in layout.shared:
        own = layout.shared_columns(name)
        expected = inverse[np.ix_(own, own)] * layout.unit(name) ** 2
        sd = np.sqrt(expected.diagonal())
        assert np.max(np.abs(found.of(name) - expected) / np.outer(sd, sd)) < tolerance


@given(
    nodes=st.integers(1, 40),
    width=st.integers(1, 7),
    span=st.sampled_from([0, 1, 2, 3, 12]),
    seed=st.integers(0, 10_000),
)
@settings(max_examples=80, derandomize=True, deadline=None)
def test_selected_inverse_of_any_band(nodes, width, span, seed):
    rng = np.random.default_rng(seed)
    n = nodes * width
    reach = int(rng.integers(1, (span + 1) * width + 1))
    lower = np.tril(rng.normal(size=(n, n)))
    lower[np.subtract.outer(np.arange(n), np.arange(n)) >= reach] = 0.0
    lower[np.diag_indices(n)] = rng.uniform(1.0, 2.0, n) * reach
    band = np.zeros((reach, n), order="F")
    for lag in range(min(reach, n)):
        band[lag, : n - lag] = lower.diagonal(-lag)
    node, following = selected_inverse(band, width)
    inverse = np.linalg.inv(lower @ lower.T).reshape(nodes, width, nodes, width)
    k = np.arange(nodes)
    np.testing.assert_allclose(node, inverse[k, :, k, :], atol=1e-12)
    np.testing.assert_allclose(following, inverse[k[:-1], :, k[1:], :], atol=1e-12)


# ------------------------------------------------------------------------------- step by step


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "options", [{}, {"motion": "constant_acceleration"}, {"loss": "none"}], ids=str
)
def test_every_step_is_gtsams(options, seed):
    """From a start far off, on data that contradict each other: refused steps and all."""
    problem = problem_of(everything(seed, **options))
    x = state_of(problem, seed)
    frozen = problem.frozen(x)
    ours, theirs = (engine(problem).begin(x, frozen) for engine in (BandedEngine, GtsamEngine))
    dampings = [ours.damping]
    for _ in range(12):
        ours.iterate()
        theirs.iterate()
        dampings.append(ours.damping)
        assert ours.damping == pytest.approx(theirs.damping)
        assert ours.cost == pytest.approx(theirs.cost, rel=1e-6)
    if "loss" in options:
        assert (np.diff(dampings) > 0.0).any(), "no step was refused"


def valley(nodes: int) -> tuple[Problem, np.ndarray]:
    """Vertical and sound speed trade against each other: beacons at one depth, no pressure sensor.

    The valley is curved, so steps are refused in the middle of it; the more pings, the more so.
    """
    rng = np.random.default_rng(1)
    t = 2.0 * np.arange(float(nodes))
    track = np.stack([300 * np.sin(t / 300), 300 * np.cos(t / 300), 0 * t - 10.0], axis=1)
    angles = np.arange(3) * 2.0 * np.pi / 3.0
    beacons = tuple(
        Beacon(f"B{i}", [800.0 * np.cos(a), 800.0 * np.sin(a), -500.0])
        for i, a in enumerate(angles)
    )
    which = np.arange(nodes - 1) % 3
    places = np.stack([b.position for b in beacons])[which]
    ways = [np.linalg.norm(track[end] - places, axis=1) for end in (slice(0, -1), slice(1, None))]
    travel = sum(ways) / 1500.0 + 1e-4 * rng.normal(size=nodes - 1)
    names = [beacons[i].name for i in which]
    pings = TwoWayRange(names, t[:-1], t[1:], travel, 1e-4)
    options = Options(acceleration_psd=2e-2)
    profile = SoundSpeedProfile.constant(1500.0)
    problem = problem_of(Mission((Segment("", pings),), beacons, profile, options=options))
    x = np.zeros(problem.layout.size)
    problem.layout.put(x, "position", track + rng.normal(size=track.shape))
    return problem, x


def test_a_refused_step_in_a_curved_valley_is_not_its_end():
    """The step that Newton would still take at the end promises next to nothing."""
    problem, x = valley(5000)
    engine = BandedEngine(problem)
    solution = solve(engine, x)
    assert solution.converged
    equations = NormalEquations(problem)
    point = equations.evaluate(solution.x, solution.frozen)
    gradient = equations.gradient(point)
    step = BandedFactor(*equations.matrix(point)).solve(-gradient)
    assert -0.5 * gradient @ step < 1e-6


class Fake:
    """Normal equations of x^2/2 in one unknown, with what a test makes of the trial's cost."""

    def __init__(self, *costs: float, curvature: float = 1.0) -> None:
        self.costs, self.curvature, self.tried = list(costs), curvature, []

    def evaluate(self, x, _):
        self.tried.append(float(x[0]))
        return Point(x, self.costs.pop(0), 50.0, np.empty(0), [])

    def gradient(self, point):
        return point.x.copy()

    def matrix(self, _):
        return np.array([[self.curvature]], order="F"), np.empty((1, 0)), np.empty((0, 0))


@pytest.mark.parametrize("wild", [np.nan, np.inf, 60.0])
def test_a_trial_without_a_lower_cost_is_refused_and_a_shorter_one_tried(wild):
    fake = Fake(50.0, wild, wild, 1.0)
    descent = BandedDescent(fake, np.array([10.0]), ())
    descent.iterate()
    assert descent.cost == 1.0
    assert descent.damping == pytest.approx(1e-2)  # two refusals up, one success down
    np.testing.assert_allclose(
        fake.tried, [10.0] + [10.0 - 10.0 / (1 + k) for k in (1e-3, 1e-2, 0.1)]
    )


def test_a_step_must_keep_a_thousandth_of_its_promise():
    """It promises to lower the cost by nearly 50."""
    fake = Fake(50.0, 50.0 - 0.04, 50.0 - 0.06)
    descent = BandedDescent(fake, np.array([10.0]), ())
    descent.iterate()
    assert descent.cost == pytest.approx(50.0 - 0.06)


def test_a_refused_step_that_hardly_changes_the_cost_ends_the_iteration():
    fake = Fake(50.0, 50.0 + 1e-9)
    descent = BandedDescent(fake, np.array([10.0]), ())
    descent.iterate()
    assert (descent.cost, descent.damping) == (50.0, 1e-3)


def test_lambda_has_an_end():
    fake = Fake(50.0, *[np.nan] * 40)
    descent = BandedDescent(fake, np.array([10.0]), ())
    descent.iterate()
    assert descent.cost == 50.0
    assert descent.damping == pytest.approx(LARGEST_LAMBDA)
    assert descent.gain() == pytest.approx(50.0)


def test_where_the_factorisation_fails_lambda_grows():
    fake = Fake(50.0, 1.0, curvature=-0.5)
    descent = BandedDescent(fake, np.array([10.0]), ())
    descent.iterate()
    assert descent.cost == 1.0
    assert descent.damping == pytest.approx(0.1)  # 1 is the first that outweighs the curvature


def test_a_matrix_that_is_not_positive_definite_is_refused():
    band = np.asfortranarray([[1.0, 1.0], [2.0, 0.0]])
    with pytest.raises(np.linalg.LinAlgError):
        BandedFactor(band, np.empty((2, 0)), np.empty((0, 0)))
    band = np.asfortranarray([[1.0, 1.0]])
    with pytest.raises(np.linalg.LinAlgError):
        BandedFactor(band, np.asfortranarray([[2.0], [0.0]]), np.ones((1, 1)))


# ----------------------------------------------------------------------------- whole missions


def long_pings() -> Mission:
    """Replies that come six pings later, two segments that share beacons."""
    rng = np.random.default_rng(4)
    truth = constant_velocity([-60.0, 20.0, -60.0], [0.8, 0.2, 0.0], (0.0, 200.0))
    beacons = tuple(
        Beacon(f"B{i}", place, sigma=1.0, turnaround=14.0 + i)
        for i, place in enumerate(
            ([150.0, 100.0, -120.0], [-150.0, 90.0, -118.0], [10.0, -160.0, -122.0])
        )
    )
    segments = []
    for name, first in (("A", 0.0), ("B", 110.0)):
        sent = first + np.arange(0.0, 60.0, 2.5)
        pings = two_way_pings(truth, beacons, sent, Sea(PROFILE), rng)
        levels = pressure(truth, np.arange(first, first + 80.0, 3.0), rng)
        segments.append(Segment(name, pings, depth=levels))
    return Mission(tuple(segments), beacons, PROFILE, options=Options(estimate_beacons=True))


def one_way_only() -> Mission:
    rng = np.random.default_rng(5)
    truth = constant_velocity([-60.0, 20.0, -60.0], [0.8, 0.2, 0.0], (0.0, 200.0))
    mission, _ = straight_pass()
    heard = one_way_pings(
        truth,
        mission.beacons,
        np.arange(2.0, 190.0, 3.0),
        Sea(PROFILE),
        rng,
        clock=Clock(0.4, -1e-6),
    )
    levels = pressure(truth, np.arange(0.0, 195.0), rng)
    return Mission((Segment("", one_way_range=heard, depth=levels),), mission.beacons, PROFILE)


SCENARIOS = {
    "straight pass": lambda: straight_pass(3)[0],
    "jerk": lambda: straight_pass(3, options=Options(motion="constant_acceleration"))[0],
    "no noise": lambda: straight_pass(3, noise=0.0)[0],
    "thinned nodes": lambda: straight_pass(3, options=Options(acceleration_psd=1e-6))[0],
    "survey over one beacon": lambda: demo_survey(2)[0],
    "long pings": long_pings,
    "one way": one_way_only,
    "outliers": lambda: _spoilt(straight_pass(3)[0]),
}


def _spoilt(mission: Mission) -> Mission:
    pings = mission.segments[0].two_way_range
    late = np.where(np.arange(len(pings)) % 9 == 0, 8e-3, 0.0)
    spoilt = replace(pings, travel_time=pings.travel_time + late)
    return replace(mission, segments=(replace(mission.segments[0], two_way_range=spoilt),))


@pytest.mark.parametrize("name", SCENARIOS)
def test_missions_have_one_answer_by_both_solvers(name):
    mission = SCENARIOS[name]()
    banded, theirs, auto = (by(mission, solver) for solver in ("banded", "gtsam", "auto"))
    assert banded.status == "converged", banded.reason
    assert_same_result(banded, theirs)
    assert_same_result(banded, auto)
    assert {s.solver for s in banded.segments} == {"banded"}
    assert {s.solver for s in theirs.segments} == {"gtsam"}
    assert {s.solver for s in auto.segments} == {"banded, confirmed by gtsam"}


def test_saga_has_one_answer_by_both_solvers(tmp_path, saga):
    from test_saga import mission_file

    from ubl_graph import load_mission

    mission = load_mission(mission_file(tmp_path, saga))
    assert_same_result(by(mission, "banded"), by(mission, "gtsam"))


def test_above_5000_nodes_auto_is_banded(monkeypatch):
    mission, _ = straight_pass()
    monkeypatch.setattr(ubl_graph.solve.choice, "GTSAM_NODES", 30)
    assert smooth(mission).segments[0].solver == "banded"


def test_a_better_answer_of_gtsam_is_taken(monkeypatch):
    """A fault in the scout: it calls its start the answer."""

    class Idle(BandedEngine):
        def begin(self, x, frozen):
            descent = super().begin(x, frozen)
            descent.iterate = lambda: None
            return descent

    mission, _ = straight_pass()
    right = by(mission, "gtsam")
    monkeypatch.setattr(ubl_graph.solve.choice, "BandedEngine", Idle)
    found = smooth(mission)
    assert found.segments[0].solver == "gtsam"
    np.testing.assert_allclose(found.trajectory.position, right.trajectory.position, atol=1e-4)


def test_a_scout_that_does_not_see_all_is_found_out(monkeypatch):
    """A fault in the scout: half of the pings count for nothing, in its cost as well."""

    class Blind(BandedEngine):
        def begin(self, x, frozen):
            wide = tuple(
                None if f is None else np.where(np.arange(len(f)) % 2, f, 1e3 * f) for f in frozen
            )
            return super().begin(x, wide)

    mission, _ = straight_pass(3)
    right = by(mission, "gtsam")
    monkeypatch.setattr(ubl_graph.solve.choice, "BandedEngine", Blind)
    found = smooth(mission)
    assert found.segments[0].solver == "gtsam"
    np.testing.assert_allclose(found.trajectory.position, right.trajectory.position, atol=1e-3)


def test_an_engine_that_cannot_move_confirms_nothing():
    problem, x = valley(50)
    frozen = problem.frozen(x)
    begin = BandedEngine(problem).begin(x, frozen)

    class Stuck(GtsamEngine):
        def begin(self, x, frozen):
            descent = super().begin(x, frozen)

            class Held:
                cost, damping, gain = descent.cost, 1e10, descent.gain

                def iterate(self):
                    pass

            return Held()

    assert not confirms(Stuck(problem), Solution(x, frozen, begin.cost, 1, ""))
    assert not confirms(GtsamEngine(problem), Solution(x, frozen, begin.cost, 1, ""))
    solution = solve(BandedEngine(problem), x)
    assert confirms(GtsamEngine(problem), solution)
    assert confirms(Stuck(problem), solution)  # there is nothing to move for
    assert not confirms(GtsamEngine(problem), replace(solution, cost=0.99 * solution.cost))


def test_an_unconverged_answer_stands_as_it_is():
    mission, _ = straight_pass(3, options=Options(max_iterations=2))
    for solver in ("auto", "banded"):
        (segment,) = by(mission, solver).segments
        assert (segment.status, segment.iterations, segment.solver) == (
            "not converged",
            2,
            "banded",
        )


def test_gtsam_failing_to_confirm_is_said_and_the_answer_stands(monkeypatch):
    class Failing(GtsamEngine):
        def begin(self, *_):
            raise SolverError("GTSAM gave up: injected")

    mission, _ = straight_pass()
    monkeypatch.setattr(ubl_graph.solve.choice, "GtsamEngine", Failing)
    found = smooth(mission)
    assert found.status == "converged"
    assert found.segments[0].solver == "banded"
    assert "could not confirm" in found.warnings[0] and "injected" in found.warnings[0]


# ------------------------------------------------------------------------------------- limits


def many_beacons(count: int) -> Mission:
    rng = np.random.default_rng(0)
    truth = constant_velocity([-60.0, 20.0, -60.0], [0.8, 0.2, 0.0], (0.0, 130.0))
    places = np.column_stack([rng.uniform(-200.0, 200.0, (count, 2)), np.full(count, -120.0)])
    beacons = tuple(Beacon(f"B{i}", p, sigma=1.0, turnaround=0.3) for i, p in enumerate(places))
    pings = two_way_pings(truth, beacons, np.arange(0.0, 120.0, 2.0), Sea(PROFILE), rng)
    levels = pressure(truth, np.arange(0.0, 120.0), rng)
    options = Options(estimate_beacons=True)
    return Mission((Segment("", pings, depth=levels),), beacons, PROFILE, options=options)


@pytest.mark.parametrize("solver", ["auto", "banded"])
def test_a_wide_border_goes_to_gtsam_and_the_result_says_so(solver):
    result = by(many_beacons(22), solver)
    assert result.status == "converged"
    assert result.segments[0].solver == "gtsam"
    (warning,) = [w for w in result.warnings if "GTSAM solves it" in w]
    assert "66 unknowns are shared by all nodes" in warning


@pytest.mark.parametrize("solver", ["auto", "gtsam", "banded"])
def test_what_no_memory_holds_is_a_typed_error(monkeypatch, solver):
    monkeypatch.setattr(ubl_graph.solve.choice, "MOST_ENTRIES", 1000)
    with pytest.raises(SolverError, match=r"nodes.* would take .* GB.*divide the segment"):
        by(straight_pass()[0], solver)


def test_up_to_the_limit_the_border_is_the_banded_solvers():
    problem = problem_of(many_beacons(21))
    choice = choose(problem, "auto")
    assert choice.scout.name == "banded" and choice.last.name == "gtsam" and not choice.note


def test_gtsams_elimination_needs_no_stack():
    """20 000 variables in a chain, in a thread whose stack would hold some 2 000 small frames."""
    code = """
import threading
import numpy as np
from ubl_graph import Depth, Mission, Options, PositionFix, Segment, SoundSpeedProfile
from ubl_graph.graph import build_problem, model_segment
from ubl_graph.solve.lm import GtsamEngine

t = np.arange(0.0, 100_000.0, 10.0)
fixes = PositionFix(t, 1.0 * t, 0.0 * t, 0.0 * t - 5.0, sigma=1.0)
mission = Mission((Segment(position=fixes),), (), SoundSpeedProfile.constant(1500.0))
problem = build_problem(mission, [model_segment(mission.segments[0], mission.options)])
assert problem.layout.node_count == 10_000

def run():
    x = np.zeros(problem.layout.size)
    descent = GtsamEngine(problem).begin(x, problem.frozen(x))
    descent.iterate()
    print(descent.cost < 1e-3 * problem.cost(x, problem.frozen(x)))

threading.stack_size(256 * 1024)
thread = threading.Thread(target=run)
thread.start()
thread.join()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip()) == (0, "True"), done.stderr[-500:]


# ------------------------------------------------------------------------------ nothing to see

LINE = constant_velocity([-100.0, 80.0, -10.0], [1.0, 0.0, 0.0], (-5.0, 300.0))
ABOVE = constant_velocity([-100.0, 0.0, -10.0], [1.0, 0.0, 0.0], (-5.0, 300.0))
TOWARDS = constant_velocity([100.0, 0.0, -500.0], [1.0, 0.0, 0.0], (-5.0, 300.0))
LONE = (Beacon("B", [0.0, 0.0, -500.0], turnaround=0.5),)
UNSURVEYED = tuple(
    Beacon(name, [east, 0.0, -500.0], sigma=0.0, turnaround=0.5)
    for name, east in (("B", 0.0), ("C", 300.0))
)
PAIR = (*LONE, Beacon("C", [300.0, 0.0, -500.0], turnaround=0.5))


def starved(
    truth: Truth,
    beacons: tuple[Beacon, ...],
    pings: int,
    *,
    start: bool = False,
    odometry: bool = False,
    depth: bool = True,
    **options,
) -> Mission:
    rng = np.random.default_rng(0)
    sent = 5.0 * np.arange(pings)
    heard = two_way_pings(truth, beacons, sent, Sea(PROFILE), rng, noise=0.0)
    kinds = {"two_way_range": heard}
    times = np.arange(-1.0, sent[-1] + 4.0, 0.5)
    if depth:
        kinds["depth"] = pressure(truth, times, rng, noise=0.0)
    if odometry:
        kinds["velocity"] = dvl(truth, times, rng, noise=0.0)
        kinds["attitude"] = ahrs(truth, times)
    if start:
        east, north, up = truth.position(0.0)[0]
        kinds["start"] = Start(0.0, east, north, up, sigma=5.0)
    return Mission((Segment("", **kinds),), beacons, PROFILE, options=Options(**options))


SINGULAR = {
    "one ping": (starved(LINE, LONE, 1, depth=False), "along"),
    "one ping and a start": (starved(LINE, LONE, 1, start=True, depth=False), "along"),
    "two pings": (starved(LINE, LONE, 2, depth=False), "vertically"),
    "no start": (starved(LINE, LONE, 40), "along"),
    "no start, no depth": (starved(LINE, LONE, 40, depth=False), "along"),
    "over the beacon": (starved(ABOVE, LONE, 40, start=True), "along 0/180"),
    "over the beacon, DVL": (starved(ABOVE, LONE, 40, odometry=True), "along 0/180"),
    "beacon ahead": (starved(TOWARDS, LONE, 40, start=True), "along 0/180"),
    "beacon ahead, DVL": (starved(TOWARDS, LONE, 40, odometry=True), "along 0/180"),
    "beacons in line": (starved(LINE, PAIR, 40, odometry=True), "along 0/180"),
    "unknown beacons": (
        starved(
            LINE, tuple(replace(b, sigma=np.zeros(3)) for b in PAIR), 40, estimate_beacons=True
        ),
        "along",
    ),
}


@pytest.mark.parametrize("motion", ["constant_velocity", "constant_acceleration"])
@pytest.mark.parametrize("sigma", [1e-5, 1e-6, 1e-7, 1e-9])
@pytest.mark.parametrize("name", ["unknown beacons", "over the beacon, DVL", "no start"])
def test_what_rounding_hides_is_not_observed_either(name, sigma, motion):
    """The more exact the pings, the fewer digits are left for what they do not tell."""
    mission, _ = SINGULAR[name]
    (segment,) = mission.segments
    pings = replace(segment.two_way_range, sigma=np.full(len(segment.two_way_range), sigma))
    options = replace(mission.options, motion=motion)
    segment = replace(segment, two_way_range=pings)
    for solver in ("gtsam", "banded"):
        result = by(replace(mission, segments=(segment,), options=options), solver)
        assert result.status == "unobservable"
        assert np.isfinite(result.trajectory.covariance).all()


@pytest.mark.parametrize("solver", ["gtsam", "banded"])
@pytest.mark.parametrize("name", SINGULAR)
def test_what_is_not_observed_is_said_with_its_direction(name, solver):
    mission, direction = SINGULAR[name]
    result = by(mission, solver)
    assert result.status == "unobservable"
    assert direction in result.reason, result.reason
    track = result.segments[0].trajectory
    for values in (track.position, track.velocity, track.covariance):
        assert np.isfinite(values).all()
    sigma = np.sqrt(np.linalg.eigvalsh(track.covariance)[:, -1])
    assert np.median(sigma) > 100.0 or "another track" in result.reason


def test_marginals_are_gtsams_with_neighbours():
    """The joint covariance of two neighbours, which GTSAM computes by other means."""
    mission, truth = straight_pass(2, options=Options(estimate_sound_speed=False))
    problem = problem_of(mission)
    solution = solve(BandedEngine(problem), near(problem, truth))
    found = Marginals(problem, solution)
    view = GraphView(problem)
    theirs = gtsam.Marginals(view.graph(solution.frozen), view.values(solution.x))
    nodes, pairs = found.joint(["position", "velocity"]), found.following(["position", "velocity"])
    for k in range(0, problem.layout.node_count - 1, 7):
        keys = [gtsam.symbol(c, i) for i in (k, k + 1) for c in "xv"]
        joint = theirs.jointMarginalCovariance(gtsam.KeyVector(keys))
        whole = np.block([[joint.at(a, b) for b in keys] for a in keys])
        ours = np.block([[nodes[k], pairs[k]], [pairs[k].T, nodes[k + 1]]])
        assert_same_covariance(whole, ours)


def test_nothing_but_fixes_needs_no_ranges():
    """No block but linear ones; no beacon at all."""
    t = np.arange(0.0, 50.0, 5.0)
    heard = OneWayRange("B", t, t + 0.5, 1e-4)[:0]
    levels = Depth(t, 0.0 * t + 5.0, 0.1)
    fix = fixes(LINE, t, np.random.default_rng(0))
    mission = Mission(
        (Segment("", one_way_range=heard, depth=levels, position=fix),), LONE, PROFILE
    )
    assert_same_result(by(mission, "banded"), by(mission, "gtsam"))
