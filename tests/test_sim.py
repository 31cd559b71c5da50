"""Simulated tracks and sensors agree with cases computed by hand, and with the smoother's signs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ubl_graph import (
    Beacon,
    ConfigurationError,
    DataError,
    LeverArm,
    Mission,
    Options,
    Segment,
    SoundSpeedProfile,
    Start,
    TimeError,
    UnobservableError,
    Vehicle,
    evaluate,
    smooth,
)
from ubl_graph.acoustics import eigenray
from ubl_graph.baselines import dead_reckoning
from ubl_graph.evaluation import errors_of
from ubl_graph.sim import (
    Clock,
    DvlErrors,
    Sea,
    Truth,
    ahrs,
    compass,
    constant_acceleration,
    constant_velocity,
    demo_survey,
    drifting_heading,
    dvl,
    fixes,
    gyro,
    lawn_mower,
    odometer,
    one_way_pings,
    planar_vehicle,
    pressure,
    sampled,
    slant_ranges,
    straight_pass,
    two_way_pings,
    wander,
)
from ubl_graph.trajectory import process_noise

SEA = Sea(SoundSpeedProfile.constant(1500.0))
SPAN = (0.0, 100.0)


def quiet() -> np.random.Generator:
    return np.random.default_rng(0)


def still(place: list[float]) -> Truth:
    return constant_velocity(place, [0.0, 0.0, 0.0], SPAN)


# --- tracks ---------------------------------------------------------------------------------


def test_acceleration_by_hand():
    truth = constant_acceleration([1.0, 2.0, -3.0], [0.5, 0.0, 0.0], [0.0, 0.2, 0.0], (10.0, 30.0))
    np.testing.assert_allclose(truth.position(20.0), [[6.0, 12.0, -3.0]])
    np.testing.assert_allclose(truth.velocity(20.0), [[0.5, 2.0, 0.0]])
    np.testing.assert_allclose(truth.heading(20.0), np.arctan2(0.5, 2.0))


def test_outside_the_span():
    with pytest.raises(TimeError, match=r"t = 100\.5 s is outside"):
        still([0.0, 0.0, 0.0]).position([1.0, 100.5])


def test_attitude_given_or_course():
    truth = constant_velocity([0.0, 0.0, 0.0], [-1.0, 0.0, 0.0], SPAN)
    np.testing.assert_allclose(np.rad2deg(truth.heading([0.0, 5.0])), 270.0)
    turned = truth.with_attitude(0.3, 0.1, lambda t: 0.01 * t)
    assert turned.heading(1.0) == 0.3
    assert turned.pitch(1.0) == 0.1
    np.testing.assert_allclose(turned.roll([1.0, 2.0]), [0.01, 0.02])


def test_lawn_mower_by_hand():
    truth = lawn_mower([100.0, 50.0], depth=30.0, lines=2, length=200.0, spacing=40.0, speed=2.0)
    line, turn = 100.0, np.pi * 20.0 / 2.0
    assert truth.span == (0.0, pytest.approx(2.0 * line + turn))
    # North along the western line, round to starboard, south along the eastern one.
    t = [0.0, 50.0, 100.0, 100.0 + turn / 2.0, 100.0 + turn, truth.span[1]]
    expected = [[80, -50], [80, 50], [80, 150], [100, 170], [120, 150], [120, -50]]
    np.testing.assert_allclose(truth.position(t)[:, :2], expected, atol=1e-9)
    np.testing.assert_allclose(truth.position(t)[:, 2], -30.0)
    np.testing.assert_allclose(np.rad2deg(truth.heading([10.0, t[3], t[5]])), [0.0, 90.0, 180.0])


@pytest.mark.parametrize("run_in", [0.0, 75.0])
def test_lawn_mower_is_smooth_at_constant_speed(run_in: float):
    truth = lawn_mower([0.0, 0.0], depth=10.0, lines=5, course=0.7, run_in=run_in)
    t = np.linspace(*truth.span, 20_001)
    np.testing.assert_allclose(np.linalg.norm(truth.velocity(t), axis=1), 1.5)
    h = 1e-4
    middle = t[1:-1]
    slope = (truth.position(middle + h) - truth.position(middle - h)) / (2.0 * h)
    np.testing.assert_allclose(slope, truth.velocity(middle), atol=1e-5)  # half a turn's step
    assert np.diff(np.unwrap(truth.heading(t))).max() < 1.5 / 25.0 * (t[1] - t[0]) * 1.001


def test_lawn_mower_needs_sizes():
    with pytest.raises(ConfigurationError, match="positive"):
        lawn_mower([0.0, 0.0], depth=10.0, spacing=0.0)


@pytest.mark.parametrize("order", [2, 3])
def test_sampled_tracks_have_the_priors_covariance(order: int):
    psd = (2e-2, 5e-3)
    ends = []
    for seed in range(400):
        truth = sampled(
            np.random.default_rng(seed), order, psd, np.zeros(3), np.ones(3), (0.0, 9.0), step=1.0
        )
        ends.append(np.stack([truth.position(9.0)[0] - 9.0, truth.velocity(9.0)[0] - 1.0]))
    found = np.einsum("nia,nja->aij", ends, ends) / len(ends)
    expected = process_noise(order, 9.0)[0][:2, :2]
    for axis, density in enumerate([psd[0], psd[0], psd[1]]):
        np.testing.assert_allclose(found[axis], density * expected, rtol=0.25)


def test_sampled_is_repeatable_and_starts_where_told():
    def draw(seed: int) -> Truth:
        rng = np.random.default_rng(seed)
        return sampled(rng, 3, (1e-5, 1e-6), [1, 2, -3], [1, 0, 0], SPAN, acceleration=[0, 0.1, 0])

    np.testing.assert_array_equal(draw(4).position(50.0), draw(4).position(50.0))
    assert (draw(4).position(50.0) != draw(5).position(50.0)).all()
    np.testing.assert_array_equal(draw(4).position(0.0), [[1.0, 2.0, -3.0]])
    np.testing.assert_array_equal(draw(4).velocity(0.0), [[1.0, 0.0, 0.0]])


def test_wander_spreads_as_asked():
    values = np.array(
        [
            wander(np.random.default_rng(s), 3.0, 0.5, SPAN)(np.array([0.0, 100.0]))
            for s in range(500)
        ]
    )
    np.testing.assert_allclose(values.std(axis=0), [3.0, np.hypot(3.0, 5.0)], rtol=0.1)


# --- ranges ---------------------------------------------------------------------------------


def test_two_way_at_rest_by_hand():
    beacon = Beacon("B", [300.0, 400.0, 0.0], turnaround=0.25)
    pings = two_way_pings(still([0.0, 0.0, 0.0]), [beacon], [10.0], SEA, quiet(), noise=0.0)
    np.testing.assert_allclose(pings.travel_time, 2.0 / 3.0, rtol=1e-14)
    np.testing.assert_allclose(pings.t_receive, 10.0 + 2.0 / 3.0 + 0.25, rtol=1e-14)


def test_two_way_towards_the_beacon_by_hand():
    """At 3 m/s towards a beacon 1500 m away at transmit: 1 s out, 1497 / 1503 s back."""
    truth = constant_velocity([0.0, 0.0, 0.0], [3.0, 0.0, 0.0], SPAN)
    beacon = Beacon("B", [1500.0, 0.0, 0.0])
    pings = two_way_pings(truth, [beacon], [0.0], SEA, quiet(), noise=0.0)
    np.testing.assert_allclose(pings.travel_time, 1.0 + 1497.0 / 1503.0, atol=1e-12)


def test_round_robin_scale_and_lever():
    """The transducer 2 m forward of a vehicle heading east; travel times longer by 1 %."""
    beacons = [Beacon("A", [302.0, 0.0, 0.0]), Beacon("B", [2.0, 600.0, 0.0])]
    truth = still([0.0, 0.0, 0.0]).with_attitude(np.pi / 2.0)
    sea = Sea(SEA.profile, log_scale=lambda t: np.full(t.shape, np.log(1.01)))
    pings = two_way_pings(
        truth, beacons, [0.0, 5.0, 10.0], sea, quiet(), arm=LeverArm(forward=2.0), noise=0.0
    )
    assert pings.beacon.tolist() == ["A", "B", "A"]
    np.testing.assert_allclose(pings.travel_time, 1.01 * np.array([0.4, 0.8, 0.4]), rtol=1e-12)


def test_two_way_eigenrays_satisfy_the_definition():
    profile = SoundSpeedProfile([0.0, 50.0, 200.0], [1520.0, 1495.0, 1500.0])
    truth = constant_velocity([0.0, 0.0, -40.0], [2.0, 1.0, -0.1], SPAN)
    beacon = Beacon("B", [400.0, -200.0, -180.0], turnaround=0.4)
    pings = two_way_pings(
        truth, [beacon], np.arange(0.0, 90.0, 10.0), Sea(profile, "eigenray"), quiet(), noise=0.0
    )
    legs = [
        eigenray(profile, truth.position(t), beacon.position).time
        for t in (pings.t_transmit, pings.t_receive)
    ]
    np.testing.assert_allclose(pings.t_receive - pings.t_transmit, sum(legs) + 0.4, atol=1e-12)


def test_noise_and_outliers():
    truth, beacon = still([0.0, 0.0, 0.0]), Beacon("B", [750.0, 0.0, 0.0])
    sent = np.linspace(0.0, 90.0, 4000)
    pings = two_way_pings(truth, [beacon], sent, SEA, quiet(), sigma=2e-4, outliers=0.1)
    late = pings.travel_time - 1.0
    caught = late > 1.5e-3
    assert 0.08 < caught.mean() < 0.12
    assert late.max() < 2.1e-2
    assert late[~caught].std() == pytest.approx(2e-4, rel=0.05)
    assert (pings.sigma == 2e-4).all()


@given(offset=st.floats(-20.0, 20.0), drift=st.floats(-1e-4, 1e-4), speed=st.floats(-5.0, 5.0))
def test_one_way_satisfies_the_estimators_model(offset: float, drift: float, speed: float):
    """t_receive - t_transmit = tau(p(t_receive)) + offset(t_receive), as stamped."""
    truth = constant_velocity([100.0, 0.0, 0.0], [speed, 1.0, 0.0], (-100.0, 300.0))
    beacon, clock = Beacon("B", [0.0, 600.0, -50.0]), Clock(offset, drift)
    sent = np.arange(30.0, 90.0, 7.0)
    pings = one_way_pings(truth, [beacon], sent, SEA, quiet(), clock=clock, noise=0.0)
    tau = np.linalg.norm(truth.position(pings.t_receive) - beacon.position, axis=1) / 1500.0
    np.testing.assert_allclose(pings.travel_time, tau + clock.at(pings.t_receive), atol=1e-11)
    np.testing.assert_array_equal(pings.t_transmit, sent)


# --- the other sensors ------------------------------------------------------------------------


def test_dvl_by_hand():
    """Heading east at 2 m/s over the ground, in a current of 0.5 m/s to the south."""
    truth = constant_velocity([0.0, 0.0, 0.0], [2.0, 0.0, 0.1], SPAN)
    rng = quiet()
    bottom = dvl(truth, [1.0], rng, noise=0.0)
    water = dvl(truth, [1.0], rng, reference="water", current=(0.0, -0.5), noise=0.0)
    found = [[float(v[0]) for v in (r.forward, r.right, r.down)] for r in (bottom, water)]
    np.testing.assert_allclose(found, [[2.0, 0.0, -0.1], [2.0, -0.5, -0.1]], atol=1e-12)


def test_dvl_swings_with_its_lever_arm():
    """2 m ahead of a vehicle that turns to starboard at 0.1 rad/s: 0.2 m/s to starboard."""
    truth = still([0.0, 0.0, 0.0]).with_attitude(lambda t: 0.1 * t)
    rows = dvl(truth, [0.0, 40.0, 100.0], quiet(), arm=LeverArm(forward=2.0), noise=0.0)
    np.testing.assert_allclose(rows.right, 0.2, rtol=1e-3)
    np.testing.assert_allclose(rows.forward[1], 0.0, atol=1e-7)


@given(st.integers(0, 2**32 - 1))
def test_dvl_errors_satisfy_their_definition(seed: int):
    rng = np.random.default_rng(seed)
    scale, misalignment, bias = 0.01 * rng.normal(), 0.05 * rng.normal(size=3), rng.normal(size=3)
    true = rng.normal(size=(5, 3))
    v = DvlErrors(scale, tuple(misalignment), tuple(bias)).measured(true)
    np.testing.assert_allclose((1.0 + scale) * v + np.cross(misalignment, v) + bias, true)


def test_depth_and_fix_with_lever_arms_by_hand():
    """Bow up by 30 degrees, heading north: a sensor 2 m ahead is 1 m above the reference point."""
    truth = still([10.0, 20.0, -30.0]).with_attitude(0.0, np.deg2rad(30.0))
    arm = LeverArm(forward=2.0)
    depth = pressure(truth, [5.0], quiet(), arm=arm, noise=0.0)
    np.testing.assert_allclose(depth.depth, 29.0)
    fix = fixes(truth, [5.0], quiet(), arm=arm, noise=0.0, horizontal=False)
    np.testing.assert_allclose(fix.position, [[10.0, 20.0 + np.sqrt(3.0), -29.0]])
    assert fixes(truth, [5.0], quiet()).dimension == 2


def test_attitude_with_an_error():
    truth = still([0.0, 0.0, 0.0]).with_attitude(1.0, 0.1, -0.2)
    rows = ahrs(truth, [0.0, 1.0], error=(0.01, 0.02, 0.03))
    found = [rows.heading, rows.pitch, rows.roll]
    np.testing.assert_allclose(found, np.repeat([[1.01], [0.12], [-0.17]], 2, axis=1))


# --- missions and dead reckoning ----------------------------------------------------------------


def test_straight_pass_is_repeatable():
    a, b, c = (straight_pass(seed)[0].segments[0].two_way_range for seed in (1, 1, 2))
    np.testing.assert_array_equal(a.travel_time, b.travel_time)
    assert (a.travel_time != c.travel_time).all()


def test_demo_beats_dead_reckoning():
    mission, _ = demo_survey()
    reckoned = errors_of(dead_reckoning(mission)[""], mission.segments[0].reference)
    result = smooth(mission)
    smoothed = evaluate(result)[""]
    assert result.status == "converged"
    assert reckoned.horizontal.max() > 20.0
    assert smoothed.summary()["horizontal_rmse_m"] < 1.0
    assert result.residuals.down_weighted.sum() >= 3
    assert len(reckoned.t) == len(smoothed.t) == len(mission.segments[0].reference.t)


def reckonable(start: Start | None) -> tuple[Mission, Truth]:
    truth = lawn_mower([0.0, 0.0], depth=40.0, lines=3, length=100.0)
    t = np.arange(0.0, truth.span[1], 0.05)
    arm = LeverArm(forward=0.5, right=0.3)
    rng = quiet()
    segment = Segment(
        velocity=dvl(truth, t, rng, arm=arm, noise=0.0),
        attitude=ahrs(truth, t),
        depth=pressure(truth, t[::20], rng, noise=0.0),
        position=fixes(truth, [1.0], rng),
        start=start,
    )
    vehicle = Vehicle(dvl=arm)
    return Mission((segment,), (), SEA.profile, vehicle), truth


@pytest.mark.parametrize("t_start", [0.0, 130.0])
def test_dead_reckoning_is_exact_without_errors(t_start: float):
    east, north = lawn_mower([0.0, 0.0], depth=40.0, lines=3, length=100.0).position(t_start)[0, :2]
    mission, truth = reckonable(Start(t_start, east, north, sigma=5.0))
    track = dead_reckoning(mission)[""]
    # Where a turn begins and ends the velocity's slope jumps, within a sample.
    np.testing.assert_allclose(track.position, truth.position(track.t), atol=3e-3)
    np.testing.assert_allclose(track.velocity, truth.velocity(track.t), atol=0.02)
    sigma = np.sqrt(track.covariance[:, 0, 0])
    assert sigma.min() == pytest.approx(5.0, abs=1e-6)
    assert np.argmin(sigma) == np.argmin(np.abs(track.t - t_start))
    assert np.linalg.eigvalsh(track.covariance).min() > 0.0


def test_dead_reckoning_from_a_start_given_apart():
    mission, truth = reckonable(None)
    east, north = truth.position(0.0)[0, :2]
    track = dead_reckoning(mission, {"": Start(0.0, east + 7.0, north, sigma=5.0)})[""]
    np.testing.assert_allclose(track.position[:, 0] - 7.0, truth.position(track.t)[:, 0], atol=3e-3)


def test_dead_reckoning_needs_a_start_and_velocities():
    with pytest.raises(UnobservableError, match="the mission has no start"):
        dead_reckoning(reckonable(None)[0])
    with pytest.raises(DataError, match="no velocities over the bottom"):
        dead_reckoning(straight_pass()[0])


# --- vehicles that carry a heading ----------------------------------------------------------


def circling(rate: float = 0.05) -> Truth:
    """Level, at 2 m/s, turning clockwise at `rate` rad/s, a bias of 0.1 rad that grows."""

    def motion(t):
        angle, radius = rate * t, 2.0 / rate
        place = radius * np.stack([1.0 - np.cos(angle), np.sin(angle), 0.0 * t], axis=1)
        return place, 2.0 * np.stack([np.sin(angle), np.cos(angle), 0.0 * t], axis=1)

    return Truth(SPAN, motion).with_heading_bias(lambda t: 0.1 + 1e-3 * t)


def test_heading_bias_is_what_compass_and_ahrs_read_too_far():
    truth, t = circling(), [0.0, 10.0, 20.0]
    np.testing.assert_allclose(truth.heading_bias(t), [0.1, 0.11, 0.12])
    assert still([0.0, 0.0, 0.0]).heading_bias(1.0) == 0.0
    read = np.add(truth.heading(t), [0.1, 0.11, 0.12])
    np.testing.assert_allclose(compass(truth, t, quiet(), noise=0.0).heading, read)
    np.testing.assert_allclose(ahrs(truth, t).heading, read)
    np.testing.assert_allclose(ahrs(truth, t, error=(0.2, 0.0, 0.0)).heading, read + 0.2)


def test_white_noise_of_compass_and_ahrs():
    truth, t = circling(), np.linspace(0.0, 100.0, 4000)
    bare = ahrs(truth, t)
    noisy = ahrs(truth, t, rng=quiet(), white=0.02, sigma=0.5)
    for name in ("heading", "pitch", "roll"):
        assert np.std(getattr(noisy, name) - getattr(bare, name)) == pytest.approx(0.02, rel=0.05)
    assert (noisy.sigma == 0.5).all()
    heading = compass(truth, t, quiet(), sigma=0.03)
    assert np.std(heading.heading - bare.heading) == pytest.approx(0.03, rel=0.05)
    assert (heading.sigma == 0.03).all()


def test_gyros_by_hand():
    truth = circling().with_attitude(lambda t: 0.05 * t, 0.1, lambda t: 0.3 * t)
    t = np.array([0.0, 0.5, 3.0])
    # Yaw, pitch and roll rates in body axes (Rz Ry Rx): p = roll' - yaw' sin(pitch), and so on.
    roll = 0.3 * t
    expected = np.stack(
        [
            0.3 - 0.05 * np.sin(0.1) + 0.0 * t,
            0.05 * np.cos(0.1) * np.sin(roll),
            0.05 * np.cos(0.1) * np.cos(roll),
        ],
        axis=1,
    )
    rates = gyro(truth, t, quiet(), noise=0.0)
    found = np.stack([rates.about_forward, rates.about_right, rates.about_down], axis=1)
    # At the track's first instant the difference is one-sided.
    np.testing.assert_allclose(found, expected, atol=2e-5)
    biased = gyro(truth, t, quiet(), noise=0.0, bias=(0.0, 0.0, 0.01))
    np.testing.assert_allclose(biased.about_down - rates.about_down, 0.01)
    flat = gyro(circling(), t, quiet(), noise=0.0, planar=True)
    np.testing.assert_allclose(flat.about_down, 0.05, atol=1e-9)
    noisy = gyro(circling(), np.linspace(0.0, 90.0, 4000), quiet(), sigma=2e-3)
    assert np.std(noisy.about_right) == pytest.approx(2e-3, rel=0.05)


@pytest.mark.parametrize("planar", [False, True])
def test_odometry_composes_to_the_track(planar: bool):
    truth = circling()
    if not planar:
        truth = truth.with_attitude(
            lambda t: 0.05 * t, lambda t: 0.2 * np.sin(t), lambda t: 0.3 * np.cos(t)
        )
    t = np.arange(0.0, 40.0)
    steps = odometer(truth, t, quiet(), Options(), noise=0.0, planar=planar)
    assert steps.dimension == (2 if planar else 3)
    place, turn = truth.position(0.0)[0], Rotation.from_matrix(truth.rotation(0.0)[0])
    for way, about in zip(steps.translation, steps.rotation_vector, strict=True):
        place, turn = place + turn.apply(way), turn * Rotation.from_rotvec(about)
    np.testing.assert_allclose(place, truth.position(t[-1])[0], atol=1e-9)
    np.testing.assert_allclose(turn.as_matrix(), truth.rotation(t[-1])[0], atol=1e-9)


def test_odometrys_lasting_errors_by_hand():
    """Straight north at 2 m/s: read short by the scale, turned clockwise by half of the gyro's."""
    truth = constant_velocity([0.0, 0.0, 0.0], [0.0, 2.0, 0.0], SPAN)
    steps = odometer(
        truth, [0.0, 5.0], quiet(), Options(), scale=0.25, turn_bias=0.02, noise=0.0, planar=True
    )
    assert steps.about_down[0] == pytest.approx(0.1)
    np.testing.assert_allclose(steps.forward, 8.0 * np.cos(0.05))
    np.testing.assert_allclose(steps.right, 8.0 * np.sin(0.05))


@pytest.mark.parametrize("planar", [False, True])
def test_odometrys_noise_grows_with_way_and_time(planar: bool):
    options = Options(
        odometry_way_noise=0.03,
        odometry_time_noise=0.02,
        odometry_way_turn_noise_deg=0.2,
        odometry_time_turn_noise_deg=0.3,
    )
    for speed, dt in ((0.0, 4.0), (2.0, 0.5)):
        truth = constant_velocity([0.0, 0.0, 0.0], [speed, 0.0, 0.0], (0.0, 3e4))
        t = dt * np.arange(6001)
        steps = odometer(truth, t, quiet(), options, planar=planar)
        along = np.sqrt(0.03**2 * speed * dt + 0.02**2 * dt)
        about = np.deg2rad(np.sqrt(0.2**2 * speed * dt + 0.3**2 * dt))
        moved, turned = steps.translation - [speed * dt, 0.0, 0.0], steps.rotation_vector
        if planar:
            moved, turned = moved[:, :2], turned[:, 2:]
        np.testing.assert_allclose(moved.std(axis=0), along, rtol=0.05)
        np.testing.assert_allclose(turned.std(axis=0), about, rtol=0.05)


def test_slant_ranges_by_hand():
    truth = constant_velocity([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], SPAN)
    beacons = (Beacon("B1", [10.0, 3.0, 0.0]), Beacon("B2", [0.0, 0.0, -4.0]))
    ranges = slant_ranges(truth, beacons, [6.0, 3.0], quiet(), noise=0.0)
    assert ranges.beacon.tolist() == ["B1", "B2"]
    np.testing.assert_allclose(ranges.distance, [5.0, 5.0])
    noisy = slant_ranges(truth, beacons[:1], np.linspace(0.0, 9.0, 4000), quiet(), sigma=0.2)
    off = noisy.distance - np.hypot(10.0 - np.linspace(0.0, 9.0, 4000), 3.0)
    assert np.std(off) == pytest.approx(0.2, rel=0.05)


def test_drifting_heading_is_what_it_says():
    one, truth = drifting_heading(3)
    again, _ = drifting_heading(3)
    other, _ = drifting_heading(4)
    attitude = one.segments[0].attitude
    np.testing.assert_array_equal(attitude.heading, again.segments[0].attitude.heading)
    assert not np.array_equal(attitude.heading, other.segments[0].attitude.heading)
    assert one.options.heading_bias_sigma_deg == 2.0
    assert one.options.heading_bias_walk_deg == 0.5
    assert np.rad2deg(truth.heading_bias(0.0)[0]) == pytest.approx(2.0)
    off = attitude.heading - truth.heading(attitude.t) - truth.heading_bias(attitude.t)
    off = (off + np.pi) % (2.0 * np.pi) - np.pi
    assert np.rad2deg(off.std()) == pytest.approx(one.options.attitude_noise_deg, rel=0.05)
    # It rolls, comes from far away, and passes over the beacon.
    assert np.abs(truth.roll(attitude.t)).max() > 0.05
    away = np.hypot(*(one.segments[0].reference.position[:, :2]).T)
    assert away.max() > 1500.0
    assert away.min() < 40.0


def test_drifting_heading_draws_what_the_options_expect():
    runs = [drifting_heading(s, heading_bias_deg=None, lines=1, run_in=1000.0) for s in range(200)]
    first = np.rad2deg([truth.heading_bias(0.0)[0] for _, truth in runs])
    assert np.std(first) == pytest.approx(2.0, rel=0.15)
    assert abs(np.mean(first)) < 4.0 * 2.0 / np.sqrt(200)
    walked = np.rad2deg([truth.heading_bias(t := 800.0)[0] for _, truth in runs]) - first
    assert np.std(walked) == pytest.approx(0.5 * np.sqrt(t / 3600.0), rel=0.15)
    start = [m.segments[0].start for m, _ in runs]
    off = [s.east - truth.position(0.0)[0, 0] for s, (_, truth) in zip(start, runs, strict=True)]
    assert np.std(off) == pytest.approx(start[0].sigma, rel=0.15)


def test_planar_vehicle_is_planar():
    mission, truth = planar_vehicle(2)
    segment = mission.segments[0]
    assert mission.options.node == "pose2"
    assert segment.odometry.dimension == 2
    assert segment.odometry.covariance is None
    assert all(b.position[2] == 0.0 for b in mission.beacons)
    assert (truth.position(segment.slant_range.t)[:, 2] == 0.0).all()
    exact, _ = planar_vehicle(2, noise=0.0)
    ranges = exact.segments[0].slant_range
    places = np.stack([b.position for b in mission.beacons])[mission.beacon_numbers(ranges.beacon)]
    np.testing.assert_allclose(
        ranges.distance, np.linalg.norm(truth.position(ranges.t) - places, axis=1)
    )
    heading = exact.segments[0].heading
    off = np.exp(1j * (heading.heading - truth.heading(heading.t)))
    np.testing.assert_allclose(off, np.exp(1j * truth.heading_bias(heading.t)))
    assert np.abs(truth.heading_bias(0.0)) > 1e-3
