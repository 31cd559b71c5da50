"""The online estimator against the whole mission's batch, and against a plain Kalman filter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from online import records_of, run, survey, until, with_options

from ubl_graph import (
    Beacon,
    FixedLagEstimator,
    LeverArm,
    Mission,
    Options,
    PositionFix,
    Segment,
    SoundSpeedProfile,
    Vehicle,
    smooth,
)
from ubl_graph.online.buffer import entry_of
from ubl_graph.sim import (
    Clock,
    Sea,
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
from ubl_graph.trajectory import process_noise, transition

ENGINES = ("lm", "isam2")
PROFILE = SoundSpeedProfile.constant(1500.0)
EXACT = 1e-9


def linear_mission(
    seed: int = 0,
    *,
    odometry: bool = True,
    water: bool = False,
    duration: float = 60.0,
    vehicle: Vehicle | None = None,
    **options,
) -> Mission:
    """Fixes, depth and perhaps DVL: no residual is curved. A fix begins and ends it."""
    rng = np.random.default_rng(seed)
    truth = constant_velocity([10.0, -5.0, -30.0], [1.2, 0.4, 0.02], (0.0, duration + 5.0))
    arms = Vehicle() if vehicle is None else vehicle
    last = duration - 1.7
    parts = {}
    if odometry:
        reference = {"reference": "water", "current": (0.2, -0.1)} if water else {}
        parts["velocity"] = dvl(
            truth, np.arange(0.3, last + 1e-9, 0.2), rng, arm=arms.dvl, **reference
        )
        parts["attitude"] = ahrs(truth, np.arange(0.0, last, 0.5))
    segment = Segment(
        position=fixes(truth, np.arange(0.3, last + 1e-9, 2.0), rng, arm=arms.antenna),
        depth=pressure(truth, np.arange(0.5, last, 0.7), rng, arm=arms.depth_sensor),
        **parts,
    )
    options = Options(
        loss="none",
        lag=10.0,
        node_spacing=1.0,
        solver="banded",
        estimate_current=water,
        **options,
    )
    return Mission((segment,), (), PROFILE, arms, options=options)


def assert_same_window(estimator: FixedLagEstimator, mission: Mission, metres: float) -> None:
    """The window's nodes are the batch's: positions, velocities, and covariances of both."""
    window = estimator.window()
    whole = smooth(mission).segments[0].trajectory
    first = int(np.searchsorted(whole.t, window.t[0] - 1e-9))
    count = min(len(window.t), len(whole.t) - first)
    # The nodes left the batch's beginning behind, and reach its last one.
    assert first > 20
    assert first + count == len(whole.t)
    own, other = slice(0, count), slice(first, first + count)
    assert np.array_equal(window.t[own], whole.t[other])
    assert np.abs(window.position[own] - whole.position[other]).max() < metres
    assert np.abs(window.velocity[own] - whole.velocity[other]).max() < metres
    if window.acceleration is not None:
        assert np.abs(window.acceleration[own] - whole.acceleration[other]).max() < metres
    mine, batch = window.joint.node[own], whole.joint.node[other]
    scale = np.sqrt(np.einsum("kii->ki", batch))
    gap = np.abs(mine - batch) / (scale[:, :, None] * scale[:, None, :])
    assert gap.max() < max(1e-6, metres)
    newest, at = estimator.estimate(float(whole.t[-1])), whole.at(whole.t[-1:])
    assert np.abs(newest.position - at.position[0]).max() < metres
    assert np.abs(newest.velocity - at.velocity[0]).max() < metres


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("motion", ["constant_velocity", "constant_acceleration"])
@pytest.mark.parametrize("odometry", [False, True])
def test_a_linear_mission_ends_as_the_batch_does(engine, motion, odometry):
    mission = linear_mission(odometry=odometry, engine=engine, motion=motion)
    result = run(mission, records_of(mission.segments[0]), at_every=("position",))
    assert all(o.accepted for o in result.outcomes)
    # With jerk noise of 1e-5 neighbours know each other's place 1e7 times better than fixes know
    # it; of 16 digits the normal equations on either side keep 9, some 1e-8 m.
    assert_same_window(result.estimator, mission, EXACT if motion == "constant_velocity" else 2e-8)


@pytest.mark.parametrize("engine", ENGINES)
def test_lever_arms_and_a_slow_current_keep_it_exact(engine):
    arms = Vehicle(
        dvl=LeverArm(-0.6, 0.1, 0.2), depth_sensor=LeverArm(0.5), antenna=LeverArm(0.0, 0.3, -1.0)
    )
    mission = linear_mission(3, water=True, vehicle=arms, engine=engine)
    result = run(mission, records_of(mission.segments[0]), at_every=())
    assert all(o.accepted for o in result.outcomes)
    assert_same_window(result.estimator, mission, EXACT)


def far_mission(seed: int, *, one_way: bool, unknown: bool, **options) -> Mission:
    """Pings from so far away that their curvature is small, beside fixes, depth and DVL."""
    rng = np.random.default_rng(seed)
    truth = constant_velocity([0.0, 0.0, -30.0], [1.2, 0.4, 0.0], (0.0, 70.0))
    sigma = 1.0 if unknown else 0.0
    places = [[4e3, 500.0, -100.0], [-900.0, 4e3, -90.0], [-3e3, -2.5e3, -110.0]]
    beacons = tuple(Beacon(f"B{i}", p, sigma, turnaround=0.1) for i, p in enumerate(places))
    sea = Sea(PROFILE, log_scale=1e-4)
    sent = np.arange(1.0, 38.0, 1.5)
    pings = (
        {"one_way_range": one_way_pings(truth, beacons, sent, sea, rng, clock=Clock(0.1, 1e-6))}
        if one_way
        else {"two_way_range": two_way_pings(truth, beacons, sent, sea, rng)}
    )
    segment = Segment(
        **pings,
        position=fixes(truth, np.arange(0.3, 60.0, 2.0), rng, sigma=1.0),
        velocity=dvl(truth, np.arange(0.3, 58.3, 0.5), rng),
        attitude=ahrs(truth, np.arange(0.0, 58.0, 0.5)),
        depth=pressure(truth, np.arange(0.5, 58.0), rng),
    )
    options = Options(
        loss="none",
        lag=15.0,
        node_spacing=1.0,
        solver="banded",
        estimate_beacons=unknown,
        sound_speed_sigma=1e-4,
        **options,
    )
    return Mission((segment,), beacons, PROFILE, options=options)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(
    ("one_way", "unknown"), [(False, False), (True, False), (False, True), (True, True)]
)
def test_far_beacons_clocks_and_unknown_beacons_end_as_in_the_batch(engine, one_way, unknown):
    # A ping that has left the window stays linearised where the vehicle, or the beacon, was thought
    # to be then. An offset d from the final answer leaves d^2 / 2R of it: 2 m at 4 km, 0.5 mm.
    mission = far_mission(1, one_way=one_way, unknown=unknown, engine=engine)
    result = run(mission, records_of(mission.segments[0]), at_every=())
    assert all(o.accepted for o in result.outcomes)
    assert_same_window(result.estimator, mission, 2e-3)


@pytest.mark.parametrize("engine", ENGINES)
def test_it_equals_a_kalman_filter(engine):
    rng = np.random.default_rng(5)
    options = Options(lag=5.0, engine=engine, speed_sigma=5.0, acceleration_psd=0.02)
    estimator = FixedLagEstimator(options)
    times = np.arange(0.0, 40.0)
    track = np.cumsum(rng.normal(0.5, 0.3, (len(times), 3)), axis=0)
    sigma = 0.8
    phi, noise = transition(2, 1.0)[0], 0.02 * process_noise(2, 1.0)[0]
    gain_of = np.array([[1.0, 0.0]])
    # One filter for three axes. The first fix is all that is known of the first position.
    mean, covariance = np.zeros((2, 3)), np.diag([1e8**2, 5.0**2])
    for k, t in enumerate(times):
        seen = track[k] + sigma * rng.standard_normal(3)
        outcome = estimator.add(PositionFix(t, *seen, sigma=sigma))
        assert outcome.accepted
        if k == 0:
            mean, covariance = np.array([seen, np.zeros(3)]), np.diag([sigma**2, 5.0**2])
        else:
            mean, covariance = phi @ mean, phi @ covariance @ phi.T + noise
            gain = covariance @ gain_of.T / (covariance[0, 0] + sigma**2)
            mean = mean + gain * (seen - mean[0])
            keep = np.eye(2) - gain @ gain_of
            covariance = keep @ covariance @ keep.T + sigma**2 * gain @ gain.T
        said = estimator.estimate(float(t))
        assert np.abs(said.position - mean[0]).max() < EXACT
        assert np.abs(said.velocity - mean[1]).max() < EXACT
        assert np.abs(said.covariance - np.kron(covariance, np.eye(3))).max() < EXACT


@pytest.mark.parametrize("engine", ENGINES)
def test_the_last_estimate_of_a_survey_is_the_batchs(engine):
    mission, _ = survey(3, lines=2, length=100.0, dvl_rate=2.0, lag=40.0, engine=engine)
    assert_near_the_batch(mission, [60.0, 110.0, 170.0])


@pytest.mark.parametrize("engine", ENGINES)
def test_the_last_estimate_of_a_straight_pass_is_the_batchs(engine):
    mission, _ = straight_pass(2, options=Options(lag=80.0, engine=engine))
    assert_near_the_batch(mission, [100.0, 170.0, 239.0])


@pytest.mark.slow
def test_the_last_estimate_of_the_demo_survey_is_the_batchs():
    mission, _ = demo_survey(2)
    assert_near_the_batch(mission, [1200.0, 1900.0, 2900.0])


def assert_near_the_batch(mission: Mission, times: list[float]) -> None:
    """At the last ping before each of some times it is within a share of the batch's sigma.

    The batch on the same grid differs by what was linearised when nodes left. The batch on nodes of
    its own differs from both by more: its last node is the ping itself, and of the DVL's samples
    around it each counts the part between nodes.
    """
    segment = mission.segments[0]
    records = records_of(segment)
    result = run(mission, records)
    said = {e.t: e for e in result.estimates}
    stamps = np.array(sorted(said))
    for t in times:
        t = float(stamps[stamps <= t][-1])
        # What has the ping's own stamp and is taken after it is not in the estimate yet.
        part = replace(mission, segments=(until(segment, t),))
        assert entry_of(records_of(part.segments[0])[-1]).kind == "two_way_range"
        for spacing, share in ((None, 0.4), (1.0, 0.1)):
            whole = smooth(with_options(part, node_spacing=spacing)).segments[0].trajectory
            at = whole.at(min(t, whole.t[-1]))
            sigma = np.sqrt(np.diagonal(at.covariance[0]))
            gap = (said[t].position - at.position[0]) / sigma
            assert np.abs(gap).max() < share, (t, spacing, gap)
            spread = np.sqrt(np.diagonal(said[t].covariance)[:3]) / sigma
            assert np.abs(spread - 1.0).max() < share, (t, spacing, spread)


@pytest.mark.parametrize("engine", ENGINES)
def test_covariances_are_symmetric_positive_and_the_same_from_every_side(engine):
    mission, _ = survey(2, lines=1, length=120.0, dvl_rate=2.0, lag=30.0, engine=engine)
    result = run(mission, records_of(mission.segments[0]))
    estimator = result.estimator
    for e in result.estimates:
        if e.position is None:
            continue
        assert e.covariance.shape == (6, 6)
        assert np.array_equal(e.covariance, e.covariance.T)
        assert np.linalg.eigvalsh(e.covariance)[0] > 0.0
    last = result.estimates[-1]
    for t in (estimator.window().t[-1], last.t + 0.123):
        said = estimator.estimate(float(t))
        if said.t > estimator.window().t[-1]:
            continue
        back = estimator.smoothed(said.t)
        assert np.abs(said.position - back.position[0]).max() < EXACT
        assert np.abs(said.velocity - back.velocity[0]).max() < EXACT
        assert np.abs(said.covariance[:3, :3] - back.covariance[0]).max() < EXACT
        assert np.abs(said.covariance[3:, 3:] - back.velocity_covariance[0]).max() < EXACT


@pytest.mark.parametrize("motion", ["constant_velocity", "constant_acceleration"])
def test_ahead_of_the_data_uncertainty_grows_by_the_closed_form(motion):
    options = {"vertical_acceleration_psd": 0.01, "vertical_jerk_psd": 1e-4}
    mission = linear_mission(2, motion=motion, **options)
    estimator = run(mission, records_of(mission.segments[0]), at_every=()).estimator
    window = estimator.window()
    end = float(window.t[-1])
    order = window.order
    o = mission.options
    psd = np.diag([o.horizontal_psd, o.horizontal_psd, o.vertical_psd])
    parts = [window.position[-1], window.velocity[-1]]
    if order == 3:
        parts.append(window.acceleration[-1])
    state, joint = np.concatenate(parts), window.joint.node[-1]
    for ahead in (0.5, 5.0, 60.0, 1200.0):
        said = estimator.estimate(end + ahead)
        phi = np.kron(transition(order, ahead)[0], np.eye(3))
        grown = phi @ joint @ phi.T + np.kron(process_noise(order, ahead)[0], psd)
        scale = np.sqrt(np.diagonal(grown)[:6])
        gap = (said.covariance - grown[:6, :6]) / (scale[:, None] * scale[None, :])
        assert np.abs(gap).max() < EXACT
        assert np.abs(said.position - (phi @ state)[:3]).max() < 1e-9 * max(1.0, ahead)
