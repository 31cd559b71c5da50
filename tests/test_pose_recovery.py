"""Exact measurements give vehicles that carry a heading their exact truth back: every sign again.

The motions are ones that the prior has no quarrel with (a constant twist: screws about the
vertical), or the prior is wide; priors that would pull are widened in `FREE`. See
`tests/test_recovery.py`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ubl_graph import (
    Beacon,
    LeverArm,
    Mission,
    Options,
    Segment,
    SoundSpeedProfile,
    Start,
    Vehicle,
    smooth,
)
from ubl_graph.result import Result
from ubl_graph.sim import (
    Clock,
    DvlErrors,
    Sea,
    Truth,
    ahrs,
    compass,
    dvl,
    fixes,
    gyro,
    odometer,
    one_way_pings,
    pressure,
    slant_ranges,
    two_way_pings,
)

PLACE, ANGLE = 1e-4, 1e-5
SPAN = (-2.0, 128.0)
PINGS = np.arange(1.0, 120.0, 3.0)
PROFILE = SoundSpeedProfile.constant(1500.0)
FREE = Options(
    node="pose3",
    speed_sigma=1e5,
    clock_drift_sigma=1e-3,
    heading_bias_sigma_deg=60.0,
    attitude_noise_deg=0.05,
    gyro_bias_sigma=1.0,
    dvl_scale_sigma=1.0,
    dvl_misalignment_sigma_deg=0.0,
    dvl_bias_sigma=0.0,
    current_sigma=1e3,
    odometry_scale_sigma=0.1,
    odometry_way_noise=2e-3,
    odometry_time_noise=1e-4,
    odometry_way_turn_noise_deg=1e-2,
    odometry_time_turn_noise_deg=1e-3,
    estimate_sound_speed=False,
)
#: A vehicle that is steered and rolls, not one that wanders by chance.
STEERED = {"angular_acceleration_psd": 1e3, "acceleration_psd": 10.0}
ARMS = Vehicle(
    transducer=LeverArm(forward=1.2, right=-0.4, down=0.6),
    dvl=LeverArm(forward=-0.9, right=0.2, down=0.3),
    depth_sensor=LeverArm(forward=0.7, right=0.1, down=-0.5),
    antenna=LeverArm(forward=-0.3, right=0.5, down=-1.1),
)


def screw(
    up: float = -60.0,
    climb: float = 0.02,
    pitch: float = 0.1,
    roll: float = -0.15,
    turn: float = 0.024,
) -> Truth:
    """A constant twist: a circle at 1.2 m/s (of 50 m), the bow not along the course, and climbing.

    `turn` is the rate of the heading, rad/s.
    """
    radius, drift = 1.2 / turn, 0.2

    def motion(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        course = 0.3 + turn * t
        place = np.stack(
            [-radius * np.cos(course), radius * np.sin(course), up + climb * (t - SPAN[0])], axis=1
        )
        speed = turn * radius * np.stack([np.sin(course), np.cos(course)], axis=1)
        return place, np.column_stack([speed, np.full(len(t), climb)])

    return Truth(SPAN, motion, lambda t: (0.3 + drift + turn * t) % (2.0 * np.pi), pitch, roll)


def rolling(up: float = -60.0) -> Truth:
    """The same circle by a vehicle that rolls and pitches in waves."""
    return replace(
        screw(up, climb=0.0),
        pitch_is=lambda t: 0.05 + 0.08 * np.sin(0.6 * t),
        roll_is=lambda t: 0.15 * np.sin(0.9 * t + 1.0),
    )


def beacons(depth: float = 118.0, count: int = 3) -> tuple[Beacon, ...]:
    places = ([-80.0, 60.0], [90.0, 70.0], [20.0, -95.0])[:count]
    return tuple(
        Beacon(f"B{i}", [*place, -depth - 4.0 * i * (depth > 0.0)], turnaround=0.2)
        for i, place in enumerate(places)
    )


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def solved(
    segment: Segment,
    options: Options,
    vehicle: Vehicle | None = None,
    places: tuple[Beacon, ...] | None = None,
) -> Result:
    vehicle = Vehicle() if vehicle is None else vehicle
    places = beacons() if places is None else places
    result = smooth(Mission((segment,), places, PROFILE, vehicle, options))
    assert result.status == "converged", result.reason
    return result


def off(result: Result, truth: Truth, between: bool = True) -> tuple[float, float]:
    """Largest distance (m) and angle (rad) from the truth at the nodes, and anywhere between."""
    track = result.segments[0].trajectory
    times = track.t
    if between:
        some = np.random.default_rng(3).uniform(track.t[0], track.t[-1], 200)
        times = np.concatenate([times, some])
    states = track.at(times)
    turned = Rotation.from_matrix(np.swapaxes(truth.rotation(times), 1, 2) @ states.rotation)
    return float(np.abs(states.position - truth.position(times)).max()), float(
        turned.magnitude().max()
    )


def assert_recovered(
    result: Result, truth: Truth, between: bool = True, within: float = PLACE
) -> None:
    place, angle = off(result, truth, between)
    assert place < within
    assert angle < ANGLE


@pytest.mark.parametrize("kind", ["two_way", "one_way", "slant"])
@pytest.mark.parametrize("node", ["pose2", "pose3"])
def test_ranges_alone_with_a_lever_arm(node: str, kind: str):
    """The motion prior joins the nodes; an attitude reference tells how the vehicle lies."""
    truth = screw() if node == "pose3" else screw(climb=0.0, pitch=0.0, roll=0.0)
    arm, depths = ARMS.transducer, np.arange(-1.0, 125.0)
    clock, sea = Clock(0.3, 4e-6), Sea(PROFILE)
    makers = {
        "two_way": lambda: two_way_pings(truth, beacons(), PINGS, sea, rng(), arm=arm, noise=0.0),
        "slant": lambda: slant_ranges(truth, beacons(), PINGS + 0.7, rng(), arm=arm, noise=0.0),
        "one_way": lambda: one_way_pings(
            truth, beacons(), PINGS, sea, rng(), clock=clock, arm=arm, noise=0.0
        ),
    }
    segment = Segment(
        attitude=ahrs(truth, np.arange(-2.0, 127.9, 0.05)),
        depth=pressure(truth, depths, rng(), arm=ARMS.depth_sensor, noise=0.0),
        **{f"{kind}_range": makers[kind]()},
    )
    options = replace(FREE, node=node, heading_bias_sigma_deg=0.0, angular_acceleration_psd=1e-4)
    result = solved(segment, options, ARMS)
    assert_recovered(result, truth)
    track = result.segments[0].trajectory
    np.testing.assert_allclose(track.velocity, truth.velocity(track.t), atol=1e-4)
    assert result.residuals is not None
    np.testing.assert_allclose(result.residuals.residual, 0.0, atol=1e-7)
    if kind == "one_way":
        offset = result.segments[0].slow["clock_offset"]
        np.testing.assert_allclose(offset.value[:, 0], clock.at(offset.t), atol=1e-7)


def dvl_segment(
    truth: Truth, vehicle: Vehicle, bias: float = 0.0, errors: DvlErrors | None = None
) -> Segment:
    """DVL and attitude reference at 50 Hz, pings, depths and two fixes, of exact sensors."""
    fine = np.arange(-1.0, 125.0, 0.02)
    return Segment(
        two_way_range=two_way_pings(
            truth, beacons(), PINGS, Sea(PROFILE), rng(), arm=vehicle.transducer, noise=0.0
        ),
        velocity=dvl(truth, fine, rng(), errors=errors, arm=vehicle.dvl, noise=0.0),
        attitude=ahrs(truth, fine, error=(bias, 0.0, 0.0)),
        depth=pressure(truth, np.arange(0.0, 124.0), rng(), arm=vehicle.depth_sensor, noise=0.0),
        position=fixes(
            truth, [30.0, 71.0], rng(), arm=vehicle.antenna, noise=0.0, horizontal=False
        ),
    )


def test_dvl_with_lever_arms_everywhere_on_a_vehicle_that_rolls():
    truth = rolling()
    errors = DvlErrors(scale=5e-3)
    result = solved(dvl_segment(truth, ARMS, errors=errors), replace(FREE, **STEERED), ARMS)
    assert_recovered(result, truth, between=False)
    np.testing.assert_allclose(result.shared["dvl_scale"].value, 5e-3, atol=1e-5)
    np.testing.assert_allclose(result.shared["heading_bias"].value, 0.0, atol=ANGLE)


@pytest.mark.parametrize("degrees", [2.0, 25.0])
def test_a_large_heading_bias_is_found_to_all_orders(degrees: float):
    """Point nodes take it to first order; poses turn by all of it."""
    truth, bias = rolling(), float(np.deg2rad(degrees))
    result = solved(dvl_segment(truth, ARMS, bias), replace(FREE, **STEERED), ARMS)
    assert_recovered(result, truth, between=False)
    np.testing.assert_allclose(result.shared["heading_bias"].value, bias, atol=ANGLE)


def test_a_planar_vehicle_with_dvl_that_rolls_after_all():
    """Roll and pitch carry its lever arms, which it has none of here, and nothing else."""
    truth = rolling()
    segment = dvl_segment(truth, Vehicle(), bias=0.1)
    result = solved(segment, replace(FREE, node="pose2", **STEERED))
    track = result.segments[0].trajectory
    assert np.abs(track.position - truth.position(track.t)).max() < PLACE
    turned = np.angle(np.exp(1j * (track.attitude[:, 0] - truth.heading(track.t))))
    assert np.abs(turned).max() < ANGLE
    np.testing.assert_allclose(result.shared["heading_bias"].value, 0.1, atol=ANGLE)


@pytest.mark.parametrize("node", ["pose2", "pose3"])
def test_gyro_and_compass_with_their_biases(node: str):
    """Neither knows its own bias; DVL and ranges tell the compass's, the compass the gyro's.

    The gyro alone turns the velocities within an interval, and its bias with them. Nothing but the
    gyro's prior speaks of a roll about the course, so biases of roll and pitch are another test's.
    """
    truth = screw(climb=0.0, pitch=0.0, roll=0.0).with_heading_bias(0.07)
    fine = np.arange(-1.0, 120.0, 0.02)
    bias = (0.0, 0.0, 4e-4)
    segment = Segment(
        two_way_range=two_way_pings(truth, beacons(), PINGS, Sea(PROFILE), rng(), noise=0.0),
        velocity=dvl(truth, fine, rng(), noise=0.0),
        heading=compass(truth, np.arange(0.0, 120.0), rng(), noise=0.0),
        angular_rate=gyro(truth, fine, rng(), bias=bias, noise=0.0, planar=node == "pose2"),
        depth=pressure(truth, np.arange(0.0, 120.0), rng(), noise=0.0),
    )
    result = solved(segment, replace(FREE, node=node, gyro_bias_sigma=5e-3, **STEERED))
    # The bias turns the way to first order.
    assert_recovered(result, truth, within=5e-4)
    np.testing.assert_allclose(result.shared["heading_bias"].value, 0.07, atol=ANGLE)
    np.testing.assert_allclose(result.shared["gyro_bias"].value[-1], -bias[2], atol=1e-7)


def test_a_gyro_beside_an_attitude_reference():
    """The reference tells the gyro's biases about all three axes."""
    truth, bias = screw(), (2e-4, -1e-3, 4e-4)
    fine = np.arange(-1.0, 125.0, 0.02)
    segment = replace(
        dvl_segment(truth, ARMS, bias=0.1),
        angular_rate=gyro(truth, fine, rng(), bias=bias, noise=0.0),
    )
    result = solved(segment, replace(FREE, **STEERED), ARMS)
    assert_recovered(result, truth, within=5e-4)
    np.testing.assert_allclose(result.shared["heading_bias"].value, 0.1, atol=ANGLE)
    found = result.shared["gyro_bias"].value * [1.0, -1.0, -1.0]
    np.testing.assert_allclose(found, bias, atol=1e-6)


def odometry_segment(
    truth: Truth, options: Options, planar: bool, scale: float, turn_bias: float, **more
) -> Segment:
    ends = np.arange(0.0, 121.0, 1.5)
    return Segment(
        slant_range=slant_ranges(truth, beacons(), ends[::2], rng(), sigma=0.05, noise=0.0),
        odometry=odometer(
            truth,
            ends,
            rng(),
            options,
            scale=scale,
            turn_bias=turn_bias,
            noise=0.0,
            planar=planar,
        ),
        **more,
    )


@pytest.mark.parametrize("node", ["pose2", "pose3"])
def test_an_odometry_chain_with_scale_and_turn_bias(node: str):
    """Nothing but odometry and ranges: the start is searched."""
    truth = rolling() if node == "pose3" else screw(climb=0.0, pitch=0.0, roll=0.0)
    options = replace(FREE, node=node, odometry_turn_bias_sigma_deg=0.3)
    depths = pressure(truth, np.arange(0.0, 120.0, 3.0), rng(), noise=0.0)
    planar = node == "pose2"
    segment = odometry_segment(truth, options, planar, 0.02, 3e-3, depth=depths)
    result = solved(segment, options)
    assert_recovered(result, truth, between=False)
    np.testing.assert_allclose(result.shared["odometry_scale"].value, 0.02, atol=1e-6)
    np.testing.assert_allclose(result.shared["odometry_turn_bias"].value, 3e-3, atol=1e-6)


@pytest.mark.parametrize("node", ["pose2", "pose3"])
def test_a_start_with_its_heading_and_one_beacon(node: str):
    """The start's heading says how the track lies about the lone beacon."""
    truth = screw(climb=0.0, pitch=0.0, roll=0.0)
    options = replace(FREE, node=node)
    east, north, up = truth.position(0.0)[0]
    start = Start(0.0, east, north, up, 0.1, float(truth.heading(0.0)[0]) - 4.0 * np.pi, 1e-3)
    depths = pressure(truth, np.arange(0.0, 120.0, 3.0), rng(), noise=0.0)
    one = beacons(count=1)
    segment = odometry_segment(truth, options, node == "pose2", 0.0, 0.0, start=start, depth=depths)
    segment = replace(
        segment, slant_range=slant_ranges(truth, one, np.arange(0.0, 120.0, 3.0), rng(), noise=0.0)
    )
    assert_recovered(solved(segment, options, places=one), truth, between=False)


# -- pose2 and pose3 say the same of a vehicle that moves in a plane --


def agreeing(segments: dict[str, Segment], options: Options, places: tuple[Beacon, ...]) -> float:
    """Largest distance between both kinds' nodes, m; headings agree as well."""
    tracks = {
        node: solved(segment, replace(options, node=node), places=places).segments[0].trajectory
        for node, segment in segments.items()
    }
    one, two = tracks["pose2"], tracks["pose3"]
    np.testing.assert_array_equal(one.t, two.t)
    apart = one.attitude[:, 0] - two.attitude[:, 0]
    np.testing.assert_allclose(np.exp(1j * apart), 1.0, atol=1e-7)
    np.testing.assert_allclose(one.covariance[:, :2, :2], two.covariance[:, :2, :2], rtol=1e-4)
    return float(np.abs(one.position - two.position).max())


def test_both_agree_with_dvl_in_a_plane():
    """Noise on all that a plane has; beacons lie in it, so that no range pulls out of it."""
    truth, noisy = screw(up=0.0, climb=0.0, pitch=0.0, roll=0.0), np.random.default_rng(5)
    samples, flat = np.arange(-1.0, 125.0, 0.5), beacons(depth=0.0)
    velocity = dvl(truth, samples, noisy)
    reference = ahrs(truth, samples, error=(0.03, 0.0, 0.0))
    heading = reference.heading + 1e-3 * noisy.normal(size=len(samples))
    segment = Segment(
        two_way_range=two_way_pings(truth, flat, PINGS, Sea(PROFILE), noisy),
        velocity=replace(velocity, down=np.zeros(len(samples))),
        attitude=replace(reference, heading=heading),
        depth=pressure(truth, np.arange(0.0, 124.0), noisy, noise=0.0),
    )
    options = Options(heading_bias_sigma_deg=2.0, solver="banded")
    apart = agreeing({"pose2": segment, "pose3": segment}, options, flat)
    assert apart < 1e-6


def test_both_agree_with_odometry_in_a_plane():
    truth, noisy = screw(up=0.0, climb=0.0, pitch=0.0, roll=0.0), np.random.default_rng(6)
    options = Options(odometry_noise="growing", odometry_turn_bias_sigma_deg=0.1, solver="banded")
    ends, flat = np.arange(0.0, 121.0, 1.5), beacons(depth=0.0)
    records = odometer(truth, ends, noisy, options, scale=0.01, turn_bias=1e-3, planar=True)
    none = np.zeros(len(records))
    in_space = replace(records, down=none, about_forward=none, about_right=none)
    assert (records.dimension, in_space.dimension) == (2, 3)
    common = {
        "slant_range": slant_ranges(truth, flat, ends[::2], noisy),
        "depth": pressure(truth, ends, noisy, noise=0.0),
        "heading": compass(truth, ends[::3], noisy),
    }
    apart = agreeing(
        {
            "pose2": Segment(odometry=records, **common),
            "pose3": Segment(odometry=in_space, **common),
        },
        options,
        flat,
    )
    assert apart < 1e-6
