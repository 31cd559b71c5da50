"""Whole simulated missions with their truth."""

from __future__ import annotations

import numpy as np

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.beacon import Beacon
from ubl_graph.frames import LeverArm
from ubl_graph.measurements import ATTITUDE_SIGMA
from ubl_graph.mission import Mission, Segment, Setup, Start, Vehicle
from ubl_graph.options import Options
from ubl_graph.sim import pose_sensors, sensors
from ubl_graph.sim.tracks import Angle, Truth, constant_velocity, lawn_mower, wander

#: Pings end so long before the track does that every reply still finds the vehicle, s.
LAST_REPLY = 5.0
#: A vehicle whose heading reference is bad, off by degrees and wandering, and whose other sensors
#: are good: a measured sound speed, a DVL aligned with the reference.
DRIFTING = Options(
    heading_bias_sigma_deg=2.0,
    heading_bias_walk_deg=0.5,
    attitude_noise_deg=0.05,
    dvl_misalignment_sigma_deg=0.0,
    sound_speed_sigma=1e-3,
)

#: A surface vehicle with a compass off by degrees, and odometry whose turn is that of a cheap gyro.
PLANAR = Options(
    node="pose2",
    heading_bias_sigma_deg=3.0,
    odometry_noise="growing",
    odometry_turn_bias_sigma_deg=0.01,
)


def straight_pass(
    seed: int = 1,
    *,
    duration: float = 240.0,
    ping_interval: float = 4.0,
    noise: float = 1.0,
    options: Options | None = None,
) -> tuple[Mission, Truth]:
    """Simulate the smallest sensible mission: a straight pass through four beacons without DVL.

    Parameters
    ----------
    seed : int
        Of the noise.
    duration : float
        Length of the mission, s.
    ping_interval : float
        Between two-way pings, s; the beacons are asked in turn.
    noise : float
        Multiplies all noise; 0 gives exact measurements.
    options : Options, optional
        Of the mission.

    Returns
    -------
    Mission, Truth
        Depth every second, no start; the mission carries the truth at the pings as reference.
    """
    rng = np.random.default_rng(seed)
    truth = constant_velocity([-200.0, -40.0, -60.0], [1.5, 0.5, 0.0], (0.0, duration + LAST_REPLY))
    beacons = tuple(
        Beacon(name, position, turnaround=0.2)
        for name, position in {
            "B1": [-150.0, 150.0, -118.0],
            "B2": [170.0, 190.0, -122.0],
            "B3": [190.0, -130.0, -120.0],
            "B4": [-160.0, -170.0, -124.0],
        }.items()
    )
    profile = SoundSpeedProfile.constant(1490.0)
    sent = np.arange(0.0, duration, ping_interval)
    pings = sensors.two_way_pings(truth, beacons, sent, sensors.Sea(profile), rng, noise=noise)
    depth = sensors.pressure(truth, np.arange(0.0, duration + 1.0), rng, noise=noise)
    segment = Segment(two_way_range=pings, depth=depth, reference=truth.reference(sent))
    options = Options() if options is None else options
    mission = Mission((segment,), beacons, profile, options=options, name="straight pass")
    return mission, truth


def demo_survey(seed: int = 1) -> tuple[Mission, Truth]:
    """Simulate an AUV's lawn-mower survey over a single beacon: the built-in mission.

    A kilometre and a half of run-in, then six lines; DVL and heading reference with errors drawn
    from the options' standard deviations, pings every 10 s of which one in fifty comes by a
    detour, and a start that is some 12 m off. Dead reckoning carries the start's error and adds
    its own; one beacon removes both.

    Parameters
    ----------
    seed : int
        Of all errors and noise.

    Returns
    -------
    Mission, Truth
        About 50 minutes; the mission carries the truth at the pings as reference.
    """
    rng = np.random.default_rng(seed)
    options = Options()
    truth = lawn_mower(
        [0.0, 0.0],
        depth=160.0,
        lines=6,
        length=400.0,
        spacing=60.0,
        speed=1.5,
        course=float(np.deg2rad(35.0)),
        run_in=1500.0,
    )
    end = truth.span[1] - LAST_REPLY
    beacons = (Beacon("B1", [20.0, -15.0, -200.0], turnaround=0.35),)
    vehicle = Vehicle(
        transducer=LeverArm(forward=0.8, down=-0.3),
        dvl=LeverArm(forward=-0.6, down=0.2),
        depth_sensor=LeverArm(forward=0.2),
    )
    profile = SoundSpeedProfile(
        np.array([0.0, 30.0, 60.0, 150.0, 250.0]),
        np.array([1522.0, 1521.0, 1502.0, 1494.0, 1492.0]),
    )
    sea = sensors.Sea(profile, "eigenray", log_scale=float(8e-4 * rng.standard_normal()))
    errors = _dvl_errors(rng, options)
    heading_error = float(ATTITUDE_SIGMA * rng.standard_normal())
    sent = np.arange(2.0, end, 10.0)
    bearing = rng.uniform(0.0, 2.0 * np.pi)
    east, north, _ = truth.position(0.0)[0] + 12.0 * np.array(
        [np.sin(bearing), np.cos(bearing), 0.0]
    )
    segment = Segment(
        two_way_range=sensors.two_way_pings(
            truth, beacons, sent, sea, rng, arm=vehicle.transducer, outliers=0.02
        ),
        velocity=sensors.dvl(truth, np.arange(0.0, end, 0.25), rng, errors=errors, arm=vehicle.dvl),
        attitude=sensors.ahrs(truth, np.arange(0.0, end, 0.5), error=(heading_error, 0.0, 0.0)),
        depth=sensors.pressure(truth, np.arange(0.0, end), rng, arm=vehicle.depth_sensor),
        start=Start(0.0, float(east), float(north), sigma=10.0),
        reference=truth.reference(sent),
    )
    mission = Mission((segment,), beacons, profile, vehicle, options, name="demo survey")
    return mission, truth


def drifting_heading(
    seed: int = 1,
    *,
    options: Options = DRIFTING,
    heading_bias_deg: float | None = 2.0,
    run_in: float = 1500.0,
    lines: int = 8,
    start_sigma: float = 3.0,
    ping_interval: float = 15.0,
    dvl_interval: float = 0.5,
) -> tuple[Mission, Truth]:
    """Simulate an AUV with a bad heading reference over a single beacon.

    It comes from a mile away, where its position was known, and mows the lawn about the
    beacon, rolling and pitching. All that errs is drawn from what the options expect: the heading
    bias and its walk, white noise of the attitude, the DVL's scale, misalignment and bias, the
    sound speed and its walk. All sensors sit at the reference point.

    Ranges to one beacon, and odometry with an unknown heading, stay the same when all is turned
    about the beacon: the start alone tells the constant part of the heading bias, to its sigma over
    its distance; ranges tell how the bias wanders.

    Parameters
    ----------
    seed : int
        Of all errors and noise.
    options : Options
        Of the mission.
    heading_bias_deg : float or None
        Heading bias at the start, degrees; None draws it.
    run_in : float
        Straight way to the first line, m.
    lines : int
        Number of lines, 250 m long, 40 m apart.
    start_sigma : float
        Standard deviation of the start, and of its error, m.
    ping_interval, dvl_interval : float
        Between two-way pings, and between velocities and attitudes, s; depth comes every second.

    Returns
    -------
    Mission, Truth
        Some 44 minutes; the mission carries the truth at the pings as reference, the truth the
        heading bias.
    """
    rng = np.random.default_rng(seed)
    track = lawn_mower(
        [15.0, -10.0],
        depth=80.0,
        lines=lines,
        length=250.0,
        spacing=40.0,
        speed=1.5,
        course=float(np.deg2rad(35.0)),
        run_in=run_in,
    )
    truth = track.with_attitude(
        pitch=lambda t: np.deg2rad(1.0 + 1.5 * np.sin(0.48 * t)),
        roll=lambda t: np.deg2rad(3.0 * np.sin(0.37 * t)),
    ).with_heading_bias(_heading_bias(rng, options, heading_bias_deg, track.span))
    end = truth.span[1] - LAST_REPLY
    beacons = (Beacon("B1", [0.0, 0.0, -120.0], turnaround=0.2),)
    profile = SoundSpeedProfile.constant(1500.0)
    expected = Setup(sound_speed=profile, options=options).sound_speed_sigma
    walk = options.number("sound_speed_walk")
    sea = sensors.Sea(profile, log_scale=wander(rng, expected, walk, truth.span))
    white = float(np.deg2rad(options.attitude_noise_deg))
    sent, motion = np.arange(2.0, end, ping_interval), np.arange(0.0, end, dvl_interval)
    east, north, _ = truth.position(0.0)[0] + start_sigma * rng.standard_normal(3)
    segment = Segment(
        two_way_range=sensors.two_way_pings(
            truth, beacons, sent, sea, rng, sigma=options.number("travel_time_sigma")
        ),
        velocity=sensors.dvl(truth, motion, rng, errors=_dvl_errors(rng, options)),
        attitude=sensors.ahrs(truth, motion, sigma=white, rng=rng, white=white),
        depth=sensors.pressure(truth, np.arange(0.0, end), rng),
        start=Start(0.0, float(east), float(north), sigma=start_sigma),
        reference=truth.reference(sent),
    )
    mission = Mission((segment,), beacons, profile, options=options, name="drifting heading")
    return mission, truth


def planar_vehicle(
    seed: int = 1,
    *,
    options: Options = PLANAR,
    duration: float = 600.0,
    step: float = 1.0,
    noise: float = 1.0,
) -> tuple[Mission, Truth]:
    """Simulate a surface vehicle that moves in a plane: odometry, compass, ranges to three beacons.

    All that errs is drawn from what the options expect: noise of the odometry that grows with way
    and time, its scale, what its gyro turns too far, what the compass reads too far.

    Parameters
    ----------
    seed : int
        Of all errors and noise.
    options : Options
        Of the mission; nodes must be poses.
    duration : float
        At the most, s; all of the track is 657 s.
    step : float
        Between odometry's stamps, s; every fifth has a range, every fourth a heading.
    noise : float
        Multiplies all white noise; 0 leaves the lasting errors alone.

    Returns
    -------
    Mission, Truth
        All is at up = 0; the mission carries the truth at the ranges as reference.
    """
    rng = np.random.default_rng(seed)
    track = lawn_mower(
        [0.0, 0.0],
        depth=0.0,
        lines=5,
        length=120.0,
        spacing=30.0,
        speed=1.2,
        course=float(np.deg2rad(20.0)),
    )
    truth = track.with_heading_bias(_heading_bias(rng, options, None, track.span))
    scale = options.odometry_scale_sigma * float(rng.standard_normal())
    turn_bias_sigma = float(np.deg2rad(options.odometry_turn_bias_sigma_deg))
    turn_bias = turn_bias_sigma * float(rng.standard_normal())
    times = np.arange(0.0, min(duration, truth.span[1]), step)
    beacons = tuple(
        Beacon(name, position)
        for name, position in {
            "B1": [-90.0, 60.0, 0.0],
            "B2": [110.0, 40.0, 0.0],
            "B3": [10.0, -120.0, 0.0],
        }.items()
    )
    start = truth.position(0.0)[0] + noise * 2.0 * rng.standard_normal(3)
    segment = Segment(
        slant_range=sensors.slant_ranges(truth, beacons, times[::5], rng, sigma=0.3, noise=noise),
        heading=pose_sensors.compass(truth, times[::4], rng, noise=noise),
        odometry=pose_sensors.odometer(
            truth,
            times,
            rng,
            options,
            scale=scale,
            turn_bias=turn_bias,
            noise=noise,
            planar=True,
        ),
        start=Start(0.0, float(start[0]), float(start[1]), 0.0, sigma=2.0),
        reference=truth.reference(times[::5]),
    )
    profile = SoundSpeedProfile.constant(1500.0)
    mission = Mission((segment,), beacons, profile, options=options, name="planar vehicle")
    return mission, truth


def _heading_bias(
    rng: np.random.Generator, options: Options, fixed_deg: float | None, span: tuple[float, float]
) -> Angle:
    """What a heading reference reads too far clockwise, rad, as the options expect it."""
    sigma_deg = options.heading_bias_sigma_deg
    sigma = ATTITUDE_SIGMA if sigma_deg is None else float(np.deg2rad(sigma_deg))
    first = sigma * float(rng.standard_normal())
    if fixed_deg is not None:
        first = float(np.deg2rad(fixed_deg))
    walk = float(np.deg2rad(options.heading_bias_walk_deg)) / 60.0  # per sqrt(hour)
    strayed = wander(rng, 0.0, walk, span)
    return lambda t: first + strayed(t)


def _dvl_errors(rng: np.random.Generator, options: Options) -> sensors.DvlErrors:
    """Errors of a DVL as the options expect them."""
    misalignment = np.deg2rad(options.dvl_misalignment_sigma_deg) * rng.standard_normal(3)
    bias = options.dvl_bias_sigma * rng.standard_normal(3)
    return sensors.DvlErrors(
        float(options.dvl_scale_sigma * rng.standard_normal()),
        (float(misalignment[0]), float(misalignment[1]), float(misalignment[2])),
        (float(bias[0]), float(bias[1]), float(bias[2])),
    )
