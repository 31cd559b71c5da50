"""Exact measurements give back the exact truth: every sensor's sign, lever arm and time stamp.

The data are free of noise while their stated sigmas are the defaults. Motions are ones that the
prior has no quarrel with (straight lines for WNOA, parabolas for WNOJ), so nothing but the priors
on first-node quantities could pull the estimate off. Those are widened in `FREE`: a velocity of
1.5 m/s against the default `speed_sigma` of 10 m/s, or a clock drift of 4 ppm against 10 ppm,
would shift the answer by some millimetres, as a prior should.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ubl_graph import Beacon, LeverArm, Mission, Options, Segment, SoundSpeedProfile, Start, Vehicle
from ubl_graph import smooth as smooth_mission
from ubl_graph.result import Result
from ubl_graph.sim import (
    Clock,
    DvlErrors,
    Sea,
    Truth,
    ahrs,
    constant_acceleration,
    constant_velocity,
    dvl,
    fixes,
    one_way_pings,
    pressure,
    sampled,
    two_way_pings,
)

TOLERANCE = 1e-4
SPAN = (-2.0, 208.0)
PINGS = np.arange(1.0, 200.0, 4.0)
BEACONS = (
    Beacon("B1", [-160.0, 150.0, -118.0], turnaround=0.3),
    Beacon("B2", [220.0, 190.0, -125.0], turnaround=0.2),
    Beacon("B3", [190.0, -170.0, -112.0], turnaround=0.1),
    Beacon("B4", [-170.0, -200.0, -130.0], turnaround=0.25),
)
CONSTANT = SoundSpeedProfile.constant(1500.0)
LAYERED = SoundSpeedProfile([0.0, 40.0, 80.0, 200.0], [1518.0, 1510.0, 1494.0, 1496.0])
FREE = Options(
    speed_sigma=1e5,
    clock_drift_sigma=1e-3,
    dvl_scale_sigma=1.0,
    dvl_misalignment_sigma_deg=0.0,
    dvl_bias_sigma=0.0,
    current_sigma=1e3,
)
VEHICLE = Vehicle(
    transducer=LeverArm(forward=1.2, right=-0.4, down=0.6),
    dvl=LeverArm(forward=-0.9, right=0.2, down=0.3),
    depth_sensor=LeverArm(forward=0.7, right=0.1, down=-0.5),
    antenna=LeverArm(forward=-0.3, down=-1.1),
)
LINE = constant_velocity([-140.0, -60.0, -60.0], [1.3, 0.6, 0.02], SPAN)
PARABOLA = constant_acceleration([-140.0, 20.0, -60.0], [1.6, 0.9, 0.0], [-2e-3, -9e-3, 1e-4], SPAN)
TRACKS = {"constant_velocity": LINE, "constant_acceleration": PARABOLA}


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def two_way(truth: Truth, sea: Sea, times: np.ndarray = PINGS, arm: LeverArm | None = None):
    return two_way_pings(truth, BEACONS, times, sea, rng(), arm=arm, noise=0.0)


def depth(truth: Truth, arm: LeverArm | None = None):
    return pressure(truth, np.arange(0.0, 205.0), rng(), arm=arm, noise=0.0)


def start(truth: Truth) -> Start:
    east, north, up = truth.position(PINGS[0])[0]
    return Start(float(PINGS[0]), east, north, up, sigma=10.0)


def solved(
    segment: Segment,
    options: Options = FREE,
    profile: SoundSpeedProfile = CONSTANT,
    vehicle: Vehicle | None = None,
) -> Result:
    vehicle = Vehicle() if vehicle is None else vehicle
    result = smooth_mission(Mission((segment,), BEACONS, profile, vehicle, options))
    assert result.status == "converged", result.reason
    assert result.warnings == ()
    return result


def assert_recovered(result: Result, truth: Truth) -> None:
    """Nodes and 500 times anywhere between them."""
    track = result.segments[0].trajectory
    t = np.sort(np.random.default_rng(3).uniform(track.t[0], track.t[-1], 500))
    off_nodes = np.abs(track.position - truth.position(track.t)).max()
    off_between = np.abs(track.at(t).position - truth.position(t)).max()
    assert off_nodes < TOLERANCE
    assert off_between < TOLERANCE
    np.testing.assert_allclose(track.at(t).velocity, truth.velocity(t), atol=1e-4)


@pytest.mark.parametrize("motion", TRACKS)
@pytest.mark.parametrize("rays", ["straight", "eigenray"])
@pytest.mark.parametrize("with_start", [False, True])
@pytest.mark.parametrize("loss", ["cauchy", "none"])
def test_two_way(motion: str, rays: str, with_start: bool, loss: str):
    truth = TRACKS[motion]
    segment = Segment(
        two_way_range=two_way(truth, Sea(LAYERED, rays)),
        depth=depth(truth),
        start=start(truth) if with_start else None,
    )
    result = solved(segment, replace(FREE, motion=motion, rays=rays, loss=loss), LAYERED)
    assert_recovered(result, truth)
    assert result.residuals is not None
    np.testing.assert_allclose(result.residuals.residual, 0.0, atol=1e-7)
    np.testing.assert_allclose(result.segments[0].slow["sound_speed"].value, 0.0, atol=1e-6)


@pytest.mark.parametrize("motion", TRACKS)
@pytest.mark.parametrize("rays", ["straight", "eigenray"])
def test_one_way_with_clock(motion: str, rays: str):
    truth, clock = TRACKS[motion], Clock(offset=0.31, drift=4e-6)
    heard = one_way_pings(truth, BEACONS, PINGS, Sea(LAYERED, rays), rng(), clock=clock, noise=0.0)
    segment = Segment(one_way_range=heard, depth=depth(truth))
    result = solved(segment, replace(FREE, motion=motion, rays=rays), LAYERED)
    assert_recovered(result, truth)
    slow = result.segments[0].slow
    offset = slow["clock_offset"]
    np.testing.assert_allclose(offset.value[:, 0], clock.at(offset.t), atol=1e-7)
    np.testing.assert_allclose(slow["clock_drift"].value, clock.drift, atol=1e-9)


def test_one_way_and_two_way_together():
    clock, sea = Clock(offset=-0.7, drift=-2e-5), Sea(CONSTANT)
    segment = Segment(
        two_way_range=two_way(LINE, sea, PINGS[::3]),
        one_way_range=one_way_pings(
            LINE, BEACONS, PINGS[:-1] + 2.2, sea, rng(), clock=clock, noise=0.0
        ),
        depth=depth(LINE),
    )
    result = solved(segment)
    assert_recovered(result, LINE)
    np.testing.assert_allclose(result.segments[0].slow["clock_drift"].value, -2e-5, atol=1e-9)


@pytest.mark.parametrize("motion", TRACKS)
def test_lever_arms_under_a_turning_attitude(motion: str):
    truth = TRACKS[motion].with_attitude(lambda t: 0.4 + 0.02 * t, 0.1, -0.05)
    t = np.arange(0.0, 206.0, 0.5)
    segment = Segment(
        two_way_range=two_way(truth, Sea(LAYERED, "eigenray"), arm=VEHICLE.transducer),
        depth=depth(truth, VEHICLE.depth_sensor),
        attitude=ahrs(truth, t),
        position=fixes(truth, PINGS[3::9], rng(), arm=VEHICLE.antenna, noise=0.0, horizontal=False),
    )
    result = solved(segment, replace(FREE, motion=motion), LAYERED, VEHICLE)
    assert_recovered(result, truth)


def test_sound_speed_scale():
    """A sound speed off by 0.4 % is found; its prior is widened so as not to hold it back."""
    segment = Segment(two_way_range=two_way(LINE, Sea(CONSTANT, log_scale=4e-3)), depth=depth(LINE))
    result = solved(segment, replace(FREE, sound_speed_sigma=1.0))
    assert_recovered(result, LINE)
    np.testing.assert_allclose(result.segments[0].slow["sound_speed"].value, 4e-3, atol=1e-7)


SWINGING = LINE.with_attitude(lambda t: 0.4 + 0.02 * t, 0.05, 0.02)
DVL_TIMES = np.arange(0.0, 206.0, 0.5)
ATTITUDE_TIMES = np.arange(-1.0, 207.0, 0.5)


@pytest.mark.parametrize(
    "errors",
    [
        DvlErrors(scale=5e-3),
        DvlErrors(scale=5e-3, bias=(3e-3, -2e-3, 1e-3)),
        DvlErrors(5e-3, (2e-3, -4e-3, 9e-3), (3e-3, -2e-3, 1e-3)),
    ],
)
def test_dvl_with_its_errors(errors: DvlErrors):
    """A steady course under a turning heading tells scale, misalignment and bias apart.

    A parabola under the constant-acceleration prior would do so too, were there not the fixed
    1 m/s^2 prior on the first acceleration: beside odometry, where the motion prior is wide open,
    it pulls by a fifth of a millimetre.
    """
    options = replace(
        FREE,
        dvl_bias_sigma=1.0 if any(errors.bias) else 0.0,
        dvl_misalignment_sigma_deg=60.0 if any(errors.misalignment) else 0.0,
    )
    segment = Segment(
        two_way_range=two_way(SWINGING, Sea(CONSTANT), arm=VEHICLE.transducer),
        depth=depth(SWINGING, VEHICLE.depth_sensor),
        velocity=dvl(SWINGING, DVL_TIMES, rng(), errors=errors, arm=VEHICLE.dvl, noise=0.0),
        attitude=ahrs(SWINGING, ATTITUDE_TIMES),
    )
    result = solved(segment, options, vehicle=VEHICLE)
    assert_recovered(result, SWINGING)
    np.testing.assert_allclose(result.shared["dvl_scale"].value, errors.scale, atol=1e-6)
    if any(errors.bias):
        np.testing.assert_allclose(result.shared["dvl_bias"].value, errors.bias, atol=2e-6)
    if any(errors.misalignment):
        found = result.shared["dvl_misalignment"].value
        np.testing.assert_allclose(found, errors.misalignment, atol=2e-6)


def test_dvl_with_a_lever_arm_as_long_as_the_attitude():
    """Attitude begins and ends with the DVL: the velocity at the ends is as good as elsewhere."""
    segment = Segment(
        two_way_range=two_way(SWINGING, Sea(CONSTANT)),
        depth=depth(SWINGING),
        velocity=dvl(SWINGING, DVL_TIMES, rng(), arm=VEHICLE.dvl, noise=0.0),
        attitude=ahrs(SWINGING, DVL_TIMES),
    )
    assert_recovered(solved(segment, vehicle=Vehicle(dvl=VEHICLE.dvl)), SWINGING)


def test_dvl_with_scale_around_one_beacon():
    """One beacon and a start; a scale error of half a per cent comes out of the ranges."""
    beacon = (Beacon("B1", [20.0, 80.0, -118.0], turnaround=0.3),)
    segment = Segment(
        two_way_range=two_way_pings(SWINGING, beacon, PINGS, Sea(CONSTANT), rng(), noise=0.0),
        depth=depth(SWINGING),
        velocity=dvl(SWINGING, DVL_TIMES, rng(), errors=DvlErrors(5e-3), noise=0.0),
        attitude=ahrs(SWINGING, ATTITUDE_TIMES),
        start=start(SWINGING),
    )
    result = smooth_mission(Mission((segment,), beacon, CONSTANT, options=FREE))
    assert result.status == "converged", result.reason
    assert_recovered(result, SWINGING)
    np.testing.assert_allclose(result.shared["dvl_scale"].value, 5e-3, atol=1e-6)


def test_water_track_with_current():
    """On a steady course a scale error looks like a current, so the scale counts as known."""
    options = replace(FREE, estimate_current=True, dvl_scale_sigma=0.0, dvl_bias_sigma=100.0)
    current, bias = (0.22, -0.35), (3e-3, -2e-3, 1e-3)
    segment = Segment(
        two_way_range=two_way(SWINGING, Sea(CONSTANT)),
        depth=depth(SWINGING),
        velocity=dvl(
            SWINGING,
            DVL_TIMES,
            rng(),
            errors=DvlErrors(bias=bias),
            reference="water",
            current=current,
            noise=0.0,
        ),
        attitude=ahrs(SWINGING, ATTITUDE_TIMES),
    )
    result = solved(segment, options)
    assert_recovered(result, SWINGING)
    found = result.segments[0].slow["current"].value
    np.testing.assert_allclose(found, np.tile(current, (len(found), 1)), atol=1e-5)
    np.testing.assert_allclose(result.shared["dvl_bias"].value, bias, atol=1e-5)


@pytest.mark.parametrize("motion", TRACKS)
@pytest.mark.parametrize("horizontal", [True, False])
def test_position_fixes_alone(motion: str, horizontal: bool):
    truth = TRACKS[motion]
    where = fixes(truth, np.arange(0.0, 205.0, 5.0), rng(), noise=0.0, horizontal=horizontal)
    segment = Segment(position=where, depth=depth(truth))
    # 2 m fixes against the 1 m/s^2 prior on the acceleration: five orders below the tolerance.
    assert_recovered(solved(segment, replace(FREE, motion=motion)), truth)


@pytest.mark.parametrize("interval", [0.125, 0.25])
def test_interleaved_pings(interval: float):
    """Replies come while two or more later pings are already under way."""
    times = np.arange(0.0, 40.0, interval)
    pings = two_way(LINE, Sea(CONSTANT), times)
    assert (pings.t_receive[:-2] > pings.t_transmit[2:]).any()
    segment = Segment(two_way_range=pings, depth=depth(LINE))
    assert_recovered(solved(segment), LINE)


def test_pings_that_span_many_nodes():
    """Beacons that wait 15 s: each ping spans some fifteen nodes of the others' ends."""
    slow = tuple(replace(b, turnaround=15.0 + i) for i, b in enumerate(BEACONS))
    pings = two_way_pings(
        LINE, slow, np.arange(0.0, 185.0, 2.0), Sea(LAYERED, "eigenray"), rng(), noise=0.0
    )
    segment = Segment(two_way_range=pings, depth=depth(LINE))
    # A loose prior does not let nodes be left out.
    result = solved(segment, replace(FREE, acceleration_psd=0.1), LAYERED)
    t = result.segments[0].trajectory.t
    inside = np.searchsorted(t, pings.t_receive) - np.searchsorted(t, pings.t_transmit)
    assert np.median(inside) > 10
    assert_recovered(result, LINE)


def test_two_segments_stay_apart():
    parts = []
    for name, track in (("one", LINE), ("two", PARABOLA)):
        parts.append(Segment(name, two_way_range=two_way(track, Sea(CONSTANT)), depth=depth(track)))
    options = replace(FREE, motion="constant_acceleration")
    result = smooth_mission(Mission(tuple(parts), BEACONS, CONSTANT, options=options))
    for track, solved_segment in zip((LINE, PARABOLA), result.segments, strict=True):
        t = solved_segment.trajectory.t
        off = solved_segment.trajectory.position - track.position(t)
        assert np.abs(off).max() < TOLERANCE


def test_a_wandering_track_is_recovered_at_the_pings_to_centimetres():
    """Where the prior is not exact (a drawn track) exact pings every second still hold it."""
    truth = sampled(rng(), 2, (2e-4, 1e-5), [-140.0, -60.0, -60.0], [1.3, 0.6, 0.0], SPAN)
    pings = two_way(truth, Sea(CONSTANT), np.arange(0.0, 200.0))
    result = solved(Segment(two_way_range=pings, depth=depth(truth)))
    track = result.segments[0].trajectory
    off = track.position - truth.position(track.t)
    assert np.abs(off[10:-10]).max() < 0.05


def test_heading_bias_of_a_vehicle_that_rolls():
    """The reference reads two degrees too far clockwise; rolling tells it from a misalignment."""
    truth = SWINGING.with_attitude(
        lambda t: 0.02 * t, pitch=lambda t: 0.05 * np.sin(t / 3.0), roll=lambda t: 0.1 * np.sin(t)
    )
    bias = float(np.deg2rad(2.0))
    times = np.arange(DVL_TIMES[0], DVL_TIMES[-1], 0.05)
    segment = Segment(
        two_way_range=two_way(truth, Sea(CONSTANT)),
        depth=depth(truth),
        velocity=dvl(truth, times, rng(), noise=0.0),
        attitude=replace(ahrs(truth, times, error=(bias, 0.0, 0.0)), sigma=1.0),
    )
    result = solved(segment, replace(FREE, dvl_misalignment_sigma_deg=0.0))
    # Two degrees, to first order: the second is 0.6 mm on the metre.
    np.testing.assert_allclose(result.shared["heading_bias"].value, bias, rtol=1e-3)


@pytest.mark.parametrize("offset", [0.2, -8.0, 12.0, 45.0])
def test_clocks_that_differ_by_up_to_a_minute(offset: float):
    clock = Clock(offset=offset, drift=0.0)
    truth = TRACKS["constant_velocity"]
    sent = PINGS - offset  # by the beacons' clock
    heard = one_way_pings(truth, BEACONS, sent, Sea(CONSTANT), rng(), clock=clock, noise=0.0)
    result = solved(Segment(one_way_range=heard, depth=depth(truth)), Options())
    assert_recovered(result, truth)


def test_default_options_pull_a_noiseless_track_by_less_than_a_tenth_of_a_millimetre():
    for motion, truth in TRACKS.items():
        segment = Segment(two_way_range=two_way(truth, Sea(CONSTANT)), depth=depth(truth))
        assert_recovered(solved(segment, Options(motion=motion)), truth)
