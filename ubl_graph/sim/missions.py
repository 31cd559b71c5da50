"""Whole simulated missions with their truth."""

from __future__ import annotations

import numpy as np

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.beacon import Beacon
from ubl_graph.frames import LeverArm
from ubl_graph.measurements import ATTITUDE_SIGMA
from ubl_graph.mission import Mission, Segment, Start, Vehicle
from ubl_graph.options import Options
from ubl_graph.sim import sensors
from ubl_graph.sim.tracks import Truth, constant_velocity, lawn_mower

#: Pings end so long before the track does that every reply still finds the vehicle, s.
LAST_REPLY = 5.0


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
    misalignment = np.deg2rad(options.dvl_misalignment_sigma_deg) * rng.standard_normal(3)
    bias = options.dvl_bias_sigma * rng.standard_normal(3)
    errors = sensors.DvlErrors(
        float(options.dvl_scale_sigma * rng.standard_normal()),
        (float(misalignment[0]), float(misalignment[1]), float(misalignment[2])),
        (float(bias[0]), float(bias[1]), float(bias[2])),
    )
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
