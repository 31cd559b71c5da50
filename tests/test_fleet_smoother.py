"""smooth_fleet: two engines, covariances, exact recovery, compounded odometry, honest sigmas."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from fleets import (
    CHAIN,
    MIXED_PLACES,
    MIXED_TRUTHS,
    POINT,
    SPACE,
    Sound,
    arc,
    at,
    dvl_vehicle,
    farthest_off,
    fleet_of,
    free,
    mixed,
    moving,
    posed,
    reckoning,
    start_of,
    still,
)
from test_banded import assert_same_covariance, rounding
from test_consistency import assert_consistent, squared

from ubl_graph import Beacon, Options, smooth
from ubl_graph.cooperative import FleetResult, Member, Target, smooth_fleet
from ubl_graph.cooperative.marginals import FleetMarginals
from ubl_graph.cooperative.model import FleetProblem
from ubl_graph.gtsam_view import GraphView
from ubl_graph.layout import Layout
from ubl_graph.mission import CONSTANT_SIGMA
from ubl_graph.sim import Clock, Truth, pressure
from ubl_graph.solve.banded import BandedEngine
from ubl_graph.solve.lm import GtsamEngine
from ubl_graph.solve.rounds import Solution, solve

MIXES = {
    "slant": {"kinds": ["slant"]},
    "two_way, sound speed": {"kinds": ["two_way"], "estimate_sound_speed": True},
    "one_way, cauchy": {"kinds": ["one_way"], "loss": "cauchy"},
    "all": {},
}
#: Few ranges, so that neighbouring nodes of one vehicle lie farther apart than any row reaches.
FEW = {"all, few": {"every": 9.0}}
BY_MIX = pytest.mark.parametrize("mix", MIXES.values(), ids=list(MIXES))


def solved(mix: dict[str, object]) -> tuple[FleetProblem, Solution]:
    problem, x = posed(mixed(noise=1.0, **mix))
    return problem, solve(BandedEngine(problem), x)


# ---------------------------------------------------------------------------------- the engines


@BY_MIX
def test_both_engines_end_at_the_same_place(mix: dict[str, object]):
    problem, banded = solved(mix)
    _, x = posed(mixed(noise=1.0, **mix))
    other = solve(GtsamEngine(problem), x)
    assert banded.converged and other.converged
    assert other.cost == pytest.approx(banded.cost, rel=1e-9)
    for member, own, place in zip(problem.members, problem.own, problem.layout.place, strict=True):
        one, two = (own.layout.positions(s.x[place]) for s in (banded, other))
        assert np.abs(one - two).max() < 1e-6, member.name
    for name in ("target rock", "target whale", "velocity whale"):
        columns = problem.layout.common_columns(name)
        assert np.abs(banded.x[columns] - other.x[columns]).max() < 1e-6, name


@BY_MIX
def test_the_graph_is_the_same_problem(mix: dict[str, object]):
    """Cost, gradient and Hessian of GTSAM's graph over charts are ours."""
    problem, solution = solved(mix)
    view = GraphView(problem, charts=True)
    graph, values = view.graph(solution.frozen), view.values(solution.x)
    np.testing.assert_array_equal(view.vector(values), solution.x)
    cost = problem.cost(solution.x, solution.frozen)
    assert graph.error(values) == pytest.approx(cost, rel=1e-9)
    hessian, _ = graph.linearize(values).hessian(view.ordering())
    dense = normal_matrix(problem, solution)
    scale = np.sqrt(np.outer(dense.diagonal(), dense.diagonal()))
    np.testing.assert_allclose(hessian / scale, dense / scale, atol=1e-8)


def normal_matrix(problem: FleetProblem, solution: Solution) -> np.ndarray:
    _, jacobian = problem.linearize(solution.x, solution.frozen)
    return (jacobian.T @ jacobian).toarray()


# -------------------------------------------------------------------------------- covariances


@pytest.mark.parametrize("mix", (MIXES | FEW).values(), ids=list(MIXES | FEW))
def test_covariances_are_the_dense_inverse(mix: dict[str, object]):
    problem, solution = solved(mix)
    matrix = normal_matrix(problem, solution)
    scale = 1.0 / np.sqrt(matrix.diagonal())
    inverse = scale[:, None] * np.linalg.inv(matrix * np.outer(scale, scale)) * scale
    marginals, tolerance = FleetMarginals(problem, solution), max(1e-6, rounding(matrix))
    for i, (member, place) in enumerate(zip(problem.members, problem.layout.place, strict=True)):
        layout, found = member.layout, marginals.vehicle(i)
        assert not found.unresolved.any()
        names = [name for name, _ in (*layout.kinematic, *layout.slow)]
        nodes = np.arange(layout.node_count)
        columns = np.concatenate([layout.node_columns(n, nodes) for n in names], axis=1)
        unit = np.concatenate(
            [np.full(layout.node_columns(n, nodes[:1]).shape[1], layout.unit(n)) for n in names]
        )
        where = place[columns]
        units = np.outer(unit, unit)
        expected = units * inverse[where[:, :, None], where[:, None, :]]
        assert_same_covariance(expected, found.joint(names), tolerance)
        cross = units * inverse[where[:-1, :, None], where[1:, None, :]]
        sigma = np.sqrt(np.einsum("nii->ni", expected))
        gap = np.abs(cross - found.following(names))
        assert (gap < tolerance * sigma[:-1, :, None] * sigma[1:, None, :]).all()
        for name, _ in layout.shared:
            own = place[layout.shared_columns(name)]
            expected = layout.unit(name) ** 2 * inverse[np.ix_(own, own)]
            assert_same_covariance(expected, found.of(name), tolerance)
    names = ["target rock", "target whale", "velocity whale"]
    if problem.layout.has("sound_speed"):
        names.append("sound_speed")
    parts = [problem.layout.common_columns(n) for n in names]
    units = np.concatenate(
        [np.full(len(c), Layout.unit(n)) for c, n in zip(parts, names, strict=True)]
    )
    own = np.concatenate(parts)
    assert_same_covariance(
        np.outer(units, units) * inverse[np.ix_(own, own)], marginals.common(names), tolerance
    )


@BY_MIX
def test_covariances_of_targets_are_gtsams(mix: dict[str, object]):
    problem, solution = solved(mix)
    view = GraphView(problem, charts=True)
    gtsams = gtsam.Marginals(view.graph(solution.frozen), view.values(solution.x))
    marginals = FleetMarginals(problem, solution)
    seen = 0
    for key, variable in zip(view.keys, problem.layout.variables, strict=True):
        if variable.name.startswith(("target", "velocity whale")):
            seen += 1
            found = marginals.common([variable.name])
            assert_same_covariance(gtsams.marginalCovariance(key), found, 1e-5)
    assert seen == 3


# ----------------------------------------------------------------------------- exact recovery


@pytest.mark.parametrize("kinds", [["slant"], ["one_way"], ["slant", "two_way", "one_way"]])
@pytest.mark.parametrize("loss", ["none", "cauchy"])
def test_exact_ranges_give_a_mixed_fleet_its_tracks_and_targets(kinds: list[str], loss: str):
    fleet = mixed(kinds=kinds, loss=loss)
    fleet = free(fleet)
    result = smooth_fleet(fleet)
    assert result.status == "converged", result.reason
    assert result.warnings == ()
    assert max(farthest_off(result, MIXED_TRUTHS).values()) < 1e-3
    for name, target in result.targets.items():
        assert np.abs(target.position - MIXED_PLACES[name](0.0)).max() < 1e-3
        there, _ = target.at([50.0])
        assert np.abs(there[0] - MIXED_PLACES[name](50.0)).max() < 1e-3
    assert result.residuals is not None
    assert np.abs(result.residuals.residual).max() < 1e-6
    assert result.residuals.found.all()


# ------------------------------------------------------------------ followers, targets, replies

SPAN = (0.0, 400.0)
TIMES = np.arange(10.0, 390.0, 10.0)
TRUTHS = {
    "a": arc([0.0, 0.0, -20.0], 0.4, SPAN, turn=0.004),
    "b": arc([400.0, -100.0, -20.0], -0.8, SPAN, turn=-0.005),
    "c": arc([-300.0, 300.0, -20.0], 2.0, SPAN, turn=0.006),
    "d": arc([200.0, 500.0, -35.0], 3.0, SPAN, turn=-0.003),
}
ROCK = still(250.0, 250.0, -60.0)
WHALE = moving([-200.0, 400.0, -50.0], [0.9, -0.5, 0.0])


def sound(noise: float = 0.0, seed: int = 0, **settings: object) -> Sound:
    places = {**{n: at(t) for n, t in TRUTHS.items()}, "rock": ROCK, "whale": WHALE}
    return Sound(places, np.random.default_rng(seed), noise, **settings)


def master(name: str, heard: Sound, **settings: object) -> Member:
    start = start_of(TRUTHS[name])
    return reckoning(name, TRUTHS[name], heard, start=start, fix_every=20.0, **settings)


def submerged(name: str, heard: Sound) -> Member:
    """A vehicle with odometry and depth, and neither start nor fix."""
    depth = pressure(TRUTHS[name], TIMES, heard.rng, noise=heard.noise)
    return reckoning(name, TRUTHS[name], heard, depth=depth)


def test_followers_without_a_start_are_found_one_by_the_other():
    """ "c" ranges the masters, and "d" only "c" and one master that passes on the other side."""
    heard = sound()
    for i, t in enumerate(TIMES):
        heard.slant(("c", "ab"[i % 2]), float(t))
        heard.slant(("d", "ca"[i % 2]), float(t) + 4.0)
    members = [master("a", heard), master("b", heard), submerged("c", heard), submerged("d", heard)]
    for some in (members, members[::-1]):
        result = smooth_fleet(fleet_of(some))
        assert result.status == "converged", result.reason
        assert max(farthest_off(result, TRUTHS).values()) < 1e-3


def test_a_follower_of_point_nodes_is_found_by_ranges_that_the_masters_measured():
    heard = sound()
    for i, t in enumerate(TIMES):
        heard.slant(("ab"[i % 2], "c"), float(t))
    follower = dvl_vehicle("c", TRUTHS["c"], heard, options=exact(POINT))
    result = smooth_fleet(fleet_of([follower, master("a", heard), master("b", heard)]))
    assert result.status == "converged", result.reason
    assert farthest_off(result, TRUTHS_ABC)["c"] < 0.02


TRUTHS_ABC = {name: TRUTHS[name] for name in "abc"}


def exact(options: Options) -> Options:
    """Options whose priors on a turning vehicle's motion weigh nothing."""
    return replace(options, acceleration_psd=10.0)


@pytest.mark.parametrize(("wait", "allowed"), [(0.3, 5e-3), (2.0, 2e-2), (5.0, 5e-2)])
def test_answers_of_vehicles_in_motion(wait: float, allowed: float):
    """What the halves of a travel time differ by while both move is centimetres at the worst."""
    heard = sound()
    for i, t in enumerate(TIMES):
        heard.two_way(("c", "ab"[i % 2]), float(t), wait)
        heard.two_way(("ab"[i % 2], "whale"), float(t) + 2.0, wait)
    whale = Target("whale", [0.0, 0.0, -50.0], sigma=[1e5, 1e5, 0.0], velocity_sigma=[50, 50, 0])
    fleet = fleet_of(
        [master("a", heard), master("b", heard), submerged("c", heard)], targets=[whale]
    )
    result = smooth_fleet(fleet)
    assert result.status == "converged", result.reason
    assert max(farthest_off(result, TRUTHS_ABC).values()) < allowed
    found = result.targets["whale"]
    assert found.t == pytest.approx(TIMES[0] + 2.0, abs=1.0)
    there, _ = found.at([0.0, 300.0])
    assert np.linalg.norm(there - [WHALE(0.0), WHALE(300.0)], axis=1).max() < 2.0 * allowed
    assert found.velocity == pytest.approx([0.9, -0.5, 0.0], abs=1e-4)


def test_clocks_of_both_ends_are_found():
    clocks = {"a": Clock(0.0, 0.0), "b": Clock(-7.0, 2e-6), "c": Clock(31.0, -4e-6)}
    heard = sound(clocks=clocks)
    for i, t in enumerate(np.arange(50.0, 350.0, 10.0)):
        heard.one_way(("cb"[i % 2], "a"), float(t))
        heard.one_way(("c", "b"), float(t) + 3.0)
        heard.one_way(("b", "c"), float(t) + 6.0)
    known = replace(CHAIN, clock_offset_sigma=1e-9, clock_drift_sigma=1e-12)
    fleet = fleet_of(
        [
            master("a", heard, options=known),
            master("b", heard),
            submerged_started("c", heard),
        ],
        loss="cauchy",
    )
    result = smooth_fleet(fleet)
    assert result.status == "converged", result.reason
    assert max(farthest_off(result, TRUTHS_ABC).values()) < 1e-3
    for name in "bc":
        offset = result.vehicles[name].segments[0].slow["clock_offset"]
        np.testing.assert_allclose(offset.value[:, 0], clocks[name].at(offset.t), atol=1e-6)


def submerged_started(name: str, heard: Sound) -> Member:
    """The same with a rough start."""
    start = start_of(TRUTHS[name], sigma=20.0, heading_sigma=0.1)
    return reckoning(name, TRUTHS[name], heard, start=start)


# ------------------------------------------------------------------------- one vehicle alone

BEACONS = (
    Beacon("B1", [300.0, 100.0, -80.0], turnaround=0.3),
    Beacon("B2", [-200.0, 250.0, -60.0], turnaround=0.3),
    Beacon("B3", [100.0, -250.0, -90.0], turnaround=0.3),
)


def to_beacons(noise: float, kind: str, truth: Truth = TRUTHS["a"], every: float = 13.0) -> Sound:
    places = {"a": at(truth), **{b.name: still(*b.position) for b in BEACONS}}
    heard = Sound(places, np.random.default_rng(4), noise)
    for i, t in enumerate(np.arange(3.0, 390.0, every)):
        getattr(heard, kind)(("a", BEACONS[i % 3].name), float(t))
    return heard


@pytest.mark.parametrize("kind", ["slant", "two_way", "one_way"])
@pytest.mark.parametrize("loss", ["none", "cauchy"])
def test_one_vehicle_with_beacons_is_its_mission(kind: str, loss: str):
    heard = to_beacons(1.0, kind)
    start = start_of(TRUTHS["a"], heading_sigma=None)
    options = replace(POINT, estimate_sound_speed=True, dvl_scale_sigma=3e-3)
    member = dvl_vehicle("a", TRUTHS["a"], heard, start=start, options=options)
    result = smooth_fleet(fleet_of([member], beacons=BEACONS, loss=loss))
    alone = smooth(result.fleet.mission_of("a"))
    found = result.vehicles["a"]
    assert (found.status, alone.status) == ("converged", "converged")
    np.testing.assert_array_equal(found.trajectory.t, alone.trajectory.t)
    assert np.abs(found.trajectory.position - alone.trajectory.position).max() < 1e-6
    assert_same_covariance(alone.trajectory.covariance, found.trajectory.covariance, 1e-5)
    assert result.cost == pytest.approx(sum(s.cost for s in alone.segments), rel=1e-9)
    assert found.residuals is not None and alone.residuals is not None
    np.testing.assert_allclose(found.residuals.residual, alone.residuals.residual, atol=1e-8)
    np.testing.assert_allclose(
        found.shared["dvl_scale"].value, alone.shared["dvl_scale"].value, atol=1e-8
    )


# ---------------------------------------------------------------------- compounded odometry

ERRORS = {
    "white noise": CHAIN,
    "scale": replace(CHAIN, odometry_scale_sigma=0.01),
    "turn bias": replace(CHAIN, odometry_turn_bias_sigma_deg=0.03),
    "in space": SPACE,
}


@pytest.mark.parametrize("turn", [0.0, 0.004, 0.1])
@pytest.mark.parametrize("options", ERRORS.values(), ids=list(ERRORS))
def test_compounded_odometry_is_odometry(options: Options, turn: float):
    """A fleet of one compounds; `smooth` has a node at each record. Ranges are a minute apart."""
    truth = arc([0.0, 0.0, -20.0], 0.4, SPAN, turn=turn)
    heard = to_beacons(0.0, "slant", truth, every=50.0)
    member = reckoning("a", truth, heard, start=start_of(truth), options=options)
    result = smooth_fleet(fleet_of([member], beacons=BEACONS))
    alone = smooth(result.fleet.mission_of("a")).trajectory
    found = result.vehicles["a"].trajectory.at(alone.t)
    assert np.abs(found.position - alone.position).max() < 1e-6
    axes = 2 if options.node == "pose2" else 3
    at_ranges = np.isin(alone.t, member.segment.slant_range.t)
    assert at_ranges.sum() == 8
    for rows in (at_ranges, ~at_ranges):
        assert_same_covariance(
            alone.covariance[rows, :axes, :axes], found.covariance[rows, :axes, :axes], 0.01
        )


@pytest.mark.parametrize("noise", ["given", "growing", "both"])
def test_noise_of_compounded_odometry_counts_once(noise: str):
    truth = arc([0.0, 0.0, -20.0], 0.4, SPAN, turn=0.01)
    heard = to_beacons(0.0, "slant", truth, every=50.0)
    options = replace(CHAIN, odometry_noise=noise)
    member = reckoning("a", truth, heard, start=start_of(truth), options=options)
    odometry = replace(member.segment.odometry, covariance=np.diag([0.03, 0.02, 0.001]) ** 2)
    member = replace(member, segment=replace(member.segment, odometry=odometry))
    result = smooth_fleet(fleet_of([member], beacons=BEACONS))
    alone = smooth(result.fleet.mission_of("a")).trajectory
    found = result.vehicles["a"].trajectory.at(alone.t)
    assert_same_covariance(alone.covariance[:, :2, :2], found.covariance[:, :2, :2], 0.01)


def test_a_result_holds_the_mission_as_it_was_given():
    heard = to_beacons(0.0, "slant", every=50.0)
    member = reckoning("a", TRUTHS["a"], heard, start=start_of(TRUTHS["a"]))
    result = smooth_fleet(fleet_of([member], beacons=BEACONS))
    mission = result.vehicles["a"].mission
    assert mission.options.odometry_noise == CHAIN.odometry_noise
    assert mission.segments[0].odometry is member.segment.odometry


# --------------------------------------------------------------------------- honest covariances

RUNS = 50
#: What starts are drawn from: m, rad.
START, HEADING = 3.0, 0.02
NEES = dict[tuple[str, int], float]


def drawn(name: str, heard: Sound, options: Options = CHAIN, **settings: object) -> Member:
    """A vehicle whose start and odometry err as their sigmas say; a plane's up is known."""
    truth, rng = TRUTHS[name], heard.rng
    off = np.append(START * rng.standard_normal(3), HEADING * rng.standard_normal())
    off[2] *= options.node != "pose2"
    start = start_of(truth, sigma=START, heading_sigma=HEADING, off=off)
    return reckoning(name, truth, heard, options=options, start=start, **settings)


def vehicles_nees(result: FleetResult, time: float) -> NEES:
    """Of each vehicle's position at a time."""
    assert result.status == "converged", result.reason
    out: NEES = {}
    for name, found in result.vehicles.items():
        size = 2 if found.mission.options.node == "pose2" else 3
        state = found.trajectory.at([time])
        error = (state.position - TRUTHS[name].position(time))[0, :size]
        out[f"{name} at {time:g} s", size] = squared(error, state.covariance[0, :size, :size])
    return out


def slant_run(seed: int) -> NEES:
    """One with fixes, three without, one of them in space; a target ranged by all."""
    rng = np.random.default_rng([seed, 1])
    heard = sound(1.0)
    heard.rng = rng
    pairs = [("b", "a"), ("c", "b"), ("d", "a"), ("c", "d"), ("b", "d"), ("a", "c")]
    for i, t in enumerate(np.arange(8.0, 390.0, 8.0)):
        heard.slant(pairs[i % len(pairs)], float(t))
        heard.slant(("abcd"[i % 4], "rock"), float(t) + 3.5)
    depth = pressure(TRUTHS["d"], np.arange(0.0, 390.0, 10.0), rng)
    members = [
        drawn("a", heard, fix_every=40.0, fix_sigma=0.5),
        drawn("b", heard),
        drawn("c", heard),
        drawn("d", heard, SPACE, step=4.0, depth=depth),
    ]
    said = ROCK(0.0) + np.array([0.0, 0.0, 0.5 * rng.standard_normal()])
    fleet = fleet_of(members, targets=[Target("rock", said, sigma=[1e5, 1e5, 0.5])])
    result = smooth_fleet(fleet)
    target = result.targets["rock"]
    of_target: NEES = {("target", 3): squared(target.position - ROCK(0.0), target.covariance)}
    return vehicles_nees(result, 201.3) | vehicles_nees(result, 390.0) | of_target


def two_way_run(seed: int) -> NEES:
    """Travel times in a sea whose sound speed is off, and a target that moves."""
    rng = np.random.default_rng([seed, 2])
    heard = sound(1.0, log_scale=CONSTANT_SIGMA * rng.standard_normal())
    heard.rng = rng
    pairs = [("b", "a"), ("c", "b"), ("c", "a"), ("a", "b"), ("b", "c")]
    for i, t in enumerate(np.arange(8.0, 380.0, 9.0)):
        heard.two_way(pairs[i % len(pairs)], float(t), sigma=1e-3)
        heard.two_way(("abc"[i % 3], "whale"), float(t) + 3.5, sigma=1e-3)
    members = [
        drawn("a", heard, fix_every=40.0, fix_sigma=0.5),
        drawn("b", heard),
        drawn("c", heard),
    ]
    said = WHALE(0.0) + np.array([0.0, 0.0, 0.5 * rng.standard_normal()])
    whale = Target("whale", said, sigma=[1e5, 1e5, 0.5], velocity_sigma=[20.0, 20.0, 0.0], t=0.0)
    result = smooth_fleet(fleet_of(members, targets=[whale], estimate_sound_speed=True))
    found = result.targets["whale"]
    there, covariance = found.at([200.0])
    speed = result.shared["sound_speed"]
    error = speed.value - heard.log_scale
    way = np.array([0.9, -0.5]) - found.velocity[:2]
    return vehicles_nees(result, 201.3) | {
        ("target", 3): squared(there[0] - WHALE(200.0), covariance[0]),
        ("velocity", 2): squared(way, found.velocity_covariance[:2, :2]),
        ("sound speed", 1): squared(error, speed.covariance),
    }


def one_way_run(seed: int) -> NEES:
    """Broadcasts between clocks that are drawn; the first vehicle's is the fleet's."""
    rng = np.random.default_rng([seed, 3])
    clocks = {n: Clock(2.0 * rng.standard_normal(), 1e-5 * rng.standard_normal()) for n in "bc"}
    heard = sound(1.0, clocks=clocks)
    heard.rng = rng
    pairs = [("b", "a"), ("c", "b"), ("c", "a"), ("a", "b"), ("b", "c")]
    for i, t in enumerate(np.arange(20.0, 380.0, 7.0)):
        heard.one_way(pairs[i % len(pairs)], float(t), sigma=1e-3)
        heard.one_way(("bc"[i % 2], "rock"), float(t) + 3.5, sigma=1e-3)
    options = replace(CHAIN, clock_offset_sigma=2.0, clock_drift_sigma=1e-5)
    known = replace(CHAIN, clock_offset_sigma=1e-9, clock_drift_sigma=1e-12)
    members = [
        drawn("a", heard, known, fix_every=40.0, fix_sigma=0.5),
        drawn("b", heard, options),
        drawn("c", heard, options),
    ]
    said = ROCK(0.0) + np.array([0.0, 0.0, 0.5 * rng.standard_normal()])
    result = smooth_fleet(fleet_of(members, targets=[Target("rock", said, [1e5, 1e5, 0.5])]))
    target = result.targets["rock"]
    out = vehicles_nees(result, 201.3)
    out["target", 3] = squared(target.position - ROCK(0.0), target.covariance)
    for name, clock in clocks.items():
        offset = result.vehicles[name].segments[0].slow["clock_offset"]
        middle = len(offset.t) // 2
        error = offset.value[middle, 0] - clock.at(offset.t[middle])
        out[f"clock of {name}", 1] = float(error / offset.sigma[middle, 0]) ** 2
    return out


@pytest.mark.slow
@pytest.mark.parametrize("run", [slant_run, two_way_run, one_way_run])
def test_covariances_are_true(run: Callable[[int], NEES]):
    """Mean NEES of independent runs, of each vehicle, the target, clocks and sound speed."""
    runs = [run(seed) for seed in range(RUNS)]
    for what, dof in runs[0]:
        assert_consistent([r[what, dof] for r in runs], dof, what)
