"""The start search: the right track from no start, a bad one, a mirrored one, or too few data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import problem_of

from ubl_graph import (
    Beacon,
    Mission,
    Options,
    Segment,
    SoundSpeedProfile,
    Start,
    TwoWayRange,
    smooth,
)
from ubl_graph.result import Result
from ubl_graph.sim import (
    Sea,
    Truth,
    ahrs,
    constant_velocity,
    dvl,
    pressure,
    sampled,
    straight_pass,
    two_way_pings,
)
from ubl_graph.solve.lm import GtsamEngine
from ubl_graph.solve.rounds import solve

PROFILE = SoundSpeedProfile.constant(1500.0)
SPAN = (0.0, 210.0)
FOUR = (
    Beacon("B1", [-220.0, 180.0, -118.0], turnaround=0.1),
    Beacon("B2", [230.0, 210.0, -125.0], turnaround=0.1),
    Beacon("B3", [210.0, -190.0, -120.0], turnaround=0.1),
    Beacon("B4", [-200.0, -230.0, -130.0], turnaround=0.1),
)


def random_mission(seed: int) -> tuple[Mission, Truth]:
    """Three or four beacons about a random track within them, two-way pings every 5 s."""
    rng = np.random.default_rng([seed, 5])
    count = int(rng.integers(3, 5))
    bearing = rng.uniform(0.0, 2.0 * np.pi) + np.arange(count) * 2.0 * np.pi / count
    bearing += rng.uniform(-0.3, 0.3, count)
    reach = rng.uniform(150.0, 400.0, count)
    beacons = tuple(
        Beacon(f"B{i}", [r * np.sin(b), r * np.cos(b), -rng.uniform(90.0, 130.0)], turnaround=0.2)
        for i, (r, b) in enumerate(zip(reach, bearing, strict=True))
    )
    course, speed = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.5, 2.0)
    velocity = [speed * np.sin(course), speed * np.cos(course), 0.0]
    place = [*rng.uniform(-100.0, 100.0, 2), -rng.uniform(10.0, 70.0)]
    truth = sampled(rng, 2, (5e-4, 1e-6), place, velocity, SPAN)
    segment = Segment(
        two_way_range=two_way_pings(truth, beacons, np.arange(0.0, 200.0, 5.0), Sea(PROFILE), rng),
        depth=pressure(truth, np.arange(0.0, 206.0), rng),
    )
    return Mission((segment,), beacons, PROFILE), truth


def error(result: Result, truth: Truth) -> float:
    """Horizontal root-mean-square error over the nodes, m."""
    off = result.trajectory.position - truth.position(result.trajectory.t)
    return float(np.sqrt(np.mean(np.sum(off[:, :2] ** 2, axis=1))))


def with_segment(mission: Mission, **changes: object) -> Mission:
    return replace(mission, segments=(replace(mission.segments[0], **changes),))


@settings(max_examples=40)
@given(st.integers(0, 10_000))
def test_no_start_needed_with_three_or_four_beacons(seed: int):
    mission, truth = random_mission(seed)
    result = smooth(mission)
    assert result.status == "converged", result.reason
    assert error(result, truth) < 1.0


@pytest.mark.parametrize("bearing", [0.0, 90.0, 180.0, 270.0])
def test_a_start_far_off_is_found_out(bearing: float):
    mission, truth = straight_pass(seed=3)
    east, north = truth.position(0.0)[0, :2] + 500.0 * np.array(
        [np.sin(np.deg2rad(bearing)), np.cos(np.deg2rad(bearing))]
    )
    result = smooth(with_segment(mission, start=Start(0.0, east, north, sigma=15.0)))
    assert result.status == "converged"
    assert error(result, truth) < 1.0
    assert len(result.warnings) == 1
    assert "start prior lies" in result.warnings[0]


def test_a_good_start_is_kept_without_a_word():
    mission, truth = straight_pass(seed=3)
    east, north = truth.position(0.0)[0, :2] + [12.0, -9.0]
    result = smooth(with_segment(mission, start=Start(0.0, east, north, sigma=15.0)))
    assert result.warnings == ()
    assert error(result, truth) < 1.0


# --- one beacon -------------------------------------------------------------------------------

LONELY = (Beacon("B1", [0.0, 0.0, -120.0], turnaround=0.2),)
#: Passes the beacon at 150 m to port; its mirror image passes at 150 m to starboard.
PASS = constant_velocity([150.0, -150.0, -60.0], [0.0, 1.5, 0.0], SPAN)


def one_beacon(start: Start | None = None, truth: Truth = PASS, seed: int = 1) -> Mission:
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 206.0, 0.5)
    segment = Segment(
        two_way_range=two_way_pings(truth, LONELY, np.arange(0.0, 200.0, 5.0), Sea(PROFILE), rng),
        velocity=dvl(truth, t, rng),
        attitude=ahrs(truth, t),
        depth=pressure(truth, np.arange(0.0, 206.0), rng),
        start=start,
    )
    return Mission((segment,), LONELY, PROFILE)


def test_a_straight_pass_by_one_beacon_is_ambiguous():
    result = smooth(one_beacon())
    assert result.status == "unobservable"
    assert "ambiguous: another track, 30" in result.reason  # 300 m, give or take what it misses
    assert np.isfinite(result.trajectory.position).all()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("sigma", [10.0, 30.0])
def test_a_start_prior_tells_the_side(seed: int, sigma: float):
    off = sigma * np.random.default_rng([seed, 9]).standard_normal(2)
    start = Start(0.0, 150.0 + off[0], -150.0 + off[1], sigma=sigma)
    result = smooth(one_beacon(start, seed=seed))
    assert result.status == "converged", result.reason
    assert error(result, PASS) < 3.0


def test_a_turn_tells_the_side():
    def track(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """North for 100 s, then east."""
        before, after = np.minimum(t, 100.0), np.maximum(t - 100.0, 0.0)
        position = np.stack([-150.0 + 1.5 * after, -150.0 + 1.5 * before, 0.0 * t - 60.0], axis=1)
        velocity = np.stack([1.5 * (t > 100.0), 1.5 * (t <= 100.0), 0.0 * t], axis=1)
        return position, velocity

    truth = Truth(SPAN, track)
    result = smooth(one_beacon(truth=truth))
    assert result.status == "converged", result.reason
    assert error(result, truth) < 3.0


@pytest.mark.parametrize("with_other_side", [False, True])
def test_a_start_on_the_mirror_side(with_other_side: bool):
    """Believed where nothing contradicts it; found out where three beacons do."""
    if not with_other_side:
        result = smooth(one_beacon(Start(0.0, -150.0, -150.0, sigma=10.0)))
        mirrored = constant_velocity([-150.0, -150.0, -60.0], [0.0, 1.5, 0.0], SPAN)
        assert result.status == "converged"
        assert error(result, mirrored) < 3.0
        return
    rng = np.random.default_rng(1)
    others = (Beacon("B2", [120.0, 200.0, -118.0]), Beacon("B3", [-90.0, -180.0, -121.0]))
    beacons = LONELY + others
    segment = Segment(
        two_way_range=two_way_pings(PASS, beacons, np.arange(0.0, 200.0, 5.0), Sea(PROFILE), rng),
        depth=pressure(PASS, np.arange(0.0, 206.0), rng),
        start=Start(0.0, -150.0, -150.0, sigma=10.0),
    )
    result = smooth(Mission((segment,), beacons, PROFILE))
    assert result.status == "converged", result.reason
    assert error(result, PASS) < 1.0
    assert "start prior lies" in result.warnings[0]


def accelerating(seed: int) -> tuple[Mission, Truth]:
    """A vehicle that the constant-acceleration prior takes from 1 to some 8 m/s in 160 s."""
    rng = np.random.default_rng([seed, 0])
    span, place = (0.0, 165.0), rng.uniform(-80.0, 80.0, 2)
    truth = sampled(rng, 3, (1e-5, 1e-7), [*place, -60.0], [0.0, 1.2, 0.0], span)
    segment = Segment(
        two_way_range=two_way_pings(truth, FOUR, np.arange(0.0, 160.0, 5.0), Sea(PROFILE), rng),
        depth=pressure(truth, np.arange(0.0, 161.0, 2.0), rng),
    )
    options = Options(motion="constant_acceleration", vertical_jerk_psd=1e-7)
    return Mission((segment,), FOUR, PROFILE, options=options), truth


@pytest.mark.parametrize(
    ("seed", "window"),
    [
        (0, 80.0),
        (1, 80.0),
        (7, 30.0),
        (37, 30.0),
        (141, 30.0),
        (190, 30.0),
        *[(seed, 80.0) for seed in (7, 37, 141, 190)],
    ],
)
def test_no_start_needed_where_the_vehicle_accelerates(seed: int, window: float):
    mission, truth = accelerating(seed)
    mission = replace(mission, options=replace(mission.options, start_window=window))
    result = smooth(mission)
    assert result.status == "converged"
    assert error(result, truth) < 1.5


# --- too little -------------------------------------------------------------------------------


@pytest.mark.parametrize("with_depth", [True, False])
def test_a_single_ping(with_depth: bool):
    beacon = Beacon("B1", [100.0, 0.0, -120.0])
    segment = Segment(
        two_way_range=TwoWayRange("B1", 10.0, 10.3, 0.28),
        depth=pressure(PASS, np.arange(0.0, 20.0), np.random.default_rng(0))
        if with_depth
        else None,
    )
    result = smooth(Mission((segment,), (beacon,), PROFILE))
    assert result.status == "unobservable"
    assert result.reason
    for values in (result.trajectory.position, result.trajectory.covariance):
        assert np.isfinite(values).all()


@pytest.mark.parametrize("seed", range(6))
def test_without_depth_sensor(seed: int):
    """Beacons at different depths, all below: the vehicle's depth comes out of the ranges."""
    mission, truth = straight_pass(seed, options=Options(vertical_acceleration_psd=1e-6))
    result = smooth(with_segment(mission, depth=None))
    assert result.status == "converged", result.reason
    assert error(result, truth) < 1.0
    off = result.trajectory.position[:, 2] - truth.position(result.trajectory.t)[:, 2]
    sigma = np.sqrt(result.trajectory.covariance[:, 2, 2])
    assert (np.abs(off) < 5.0 * sigma).all()


@pytest.mark.parametrize("seed", range(3))
def test_one_beacon_without_odometry_is_never_called_converged(seed: int):
    """A start tells the place, not the side to which the track leaves it."""
    rng = np.random.default_rng(seed)
    east, north = rng.uniform(-400.0, -200.0), rng.uniform(80.0, 250.0)
    truth = constant_velocity([east, north, -20.0], [1.5, 0.0, 0.0], (0.0, 415.0))
    beacon = Beacon("B1", [0.0, 0.0, -200.0], turnaround=0.1)
    segment = Segment(
        two_way_range=two_way_pings(
            truth, (beacon,), np.arange(0.0, 410.0, 5.0), Sea(PROFILE), rng
        ),
        depth=pressure(truth, np.arange(0.0, 412.0), rng),
        start=Start(0.0, east, north, sigma=20.0),
    )
    result = smooth(Mission((segment,), (beacon,), PROFILE))
    assert result.status == "unobservable"
    assert "ambiguous" in result.reason


@pytest.mark.parametrize(("begin", "end"), [(100.0, 210.0), (0.0, 90.0), (60.0, 120.0)])
def test_odometry_that_begins_late_or_ends_early(begin: float, end: float):
    """Without bottom lock on the way down the vehicle moves all the same."""
    rng = np.random.default_rng(4)
    truth = constant_velocity([-150.0, -150.0, -60.0], [1.1, 1.4, 0.0], SPAN)
    t = np.arange(begin, end, 0.5)
    segment = Segment(
        two_way_range=two_way_pings(truth, FOUR, np.arange(0.0, 200.0, 5.0), Sea(PROFILE), rng),
        velocity=dvl(truth, t[t < 206.0], rng),
        attitude=ahrs(truth, np.arange(0.0, 206.0)),
        depth=pressure(truth, np.arange(0.0, 206.0), rng),
    )
    result = smooth(Mission((segment,), FOUR, PROFILE))
    assert result.status == "converged", result.reason
    assert error(result, truth) < 0.5


@pytest.mark.parametrize("seed", range(6))
def test_outliers_do_not_choose_the_minimum(seed: int):
    """A tenth of the pings up to 20 ms long: no dearer an answer than from the clean track."""
    mission, _ = random_mission(seed)
    pings = mission.segments[0].two_way_range
    assert pings is not None
    pings = replace(pings, t_receive=pings.t_receive + 0.03)
    clean = smooth(with_segment(mission, two_way_range=pings))
    rng = np.random.default_rng([seed, 3])
    late = rng.uniform(0.5e-3, 20e-3, len(pings)) * (rng.random(len(pings)) < 0.1)
    mission = with_segment(
        mission, two_way_range=replace(pings, travel_time=pings.travel_time + late)
    )
    result = smooth(mission)
    assert result.status == "converged", result.reason
    problem = problem_of(mission)
    x = np.zeros(problem.layout.size)
    for name in ("position", "velocity"):
        problem.layout.put(x, name, getattr(clean.trajectory, name))
    problem.layout.put(x, "sound_speed", clean.segments[0].slow["sound_speed"].value)
    assert result.segments[0].cost <= solve(GtsamEngine(problem), x).cost + 1e-3
