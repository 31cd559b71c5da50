"""Missions in which everything that can be calibrated errs, each error drawn from its prior."""

from dataclasses import replace

import numpy as np

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.beacon import Beacon
from ubl_graph.frames import LeverArm
from ubl_graph.measurements import Attitude
from ubl_graph.mission import Mission, Segment, Start, Vehicle
from ubl_graph.options import Options
from ubl_graph.records import Records
from ubl_graph.sim import (
    Clock,
    DvlErrors,
    Sea,
    Truth,
    ahrs,
    constant_velocity,
    dvl,
    fixes,
    lawn_mower,
    one_way_pings,
    pressure,
    two_way_pings,
)

#: What is drawn, and what an estimator knows of it.
OPTIONS = Options(
    loss="none",
    solver="banded",
    estimate_beacons=True,
    sound_speed_sigma=3e-3,
    sound_speed_walk=0.0,
    range_bias_sigma=1.0,
    lever_arm_sigma=0.5,
    clock_offset_sigma=0.01,
    clock_drift_sigma=1e-5,
    dvl_scale_sigma=0.02,
    dvl_misalignment_sigma_deg=2.0,
    dvl_bias_sigma=0.05,
    heading_bias_sigma_deg=1.0,
)
#: Standard deviation of each beacon's place, m.
SURVEY = 3.0
PROFILE = SoundSpeedProfile.constant(1500.0)
HEARD = {"A": [60.0, 80.0, -150.0], "B": [-90.0, -20.0, -140.0], "C": [30.0, -110.0, -155.0]}


def suitable():
    """Lines and turns at changing speed, rolling and pitching: it shows all that sensors err by."""
    lines = lawn_mower([0.0, 0.0], depth=20.0, lines=4, length=160.0, spacing=50.0, speed=2.0)

    def hurried(t):
        then = np.clip(t + 8.0 * np.sin(0.08 * t), *lines.span)
        pace = 1.0 + 0.64 * np.cos(0.08 * t)
        position, velocity = lines.motion(then)
        return position, pace[:, None] * velocity

    return Truth(lines.span, hurried).with_attitude(
        pitch=lambda t: np.deg2rad(6.0) * np.sin(0.21 * t),
        roll=lambda t: np.deg2rad(9.0) * np.sin(0.13 * t + 1.0),
    )


def surveyed(seed, track=None, beacons=HEARD, shown=True):
    """A mission over beacons, and what errs in it, by the states' names.

    Where not all is to be shown the vehicle has no fixes, and hears broadcasts alone.
    """
    rng = np.random.default_rng(seed)
    options = OPTIONS
    track = track or suitable()
    end = track.span[1] - 5.0
    truth = {
        "dvl_scale": options.dvl_scale_sigma * rng.standard_normal(1),
        "dvl_misalignment": np.deg2rad(options.dvl_misalignment_sigma_deg) * rng.standard_normal(3),
        "dvl_bias": options.dvl_bias_sigma * rng.standard_normal(3),
        "heading_bias": np.deg2rad(options.heading_bias_sigma_deg) * rng.standard_normal(1),
        "lever_arm": options.lever_arm_sigma * rng.standard_normal(3),
        "sound_speed": options.sound_speed_sigma * rng.standard_normal(1),
        "clock_offset": options.clock_offset_sigma * rng.standard_normal(1),
        "clock_drift": options.clock_drift_sigma * rng.standard_normal(1),
    }
    places = {n: np.array(p) + SURVEY * rng.standard_normal(3) for n, p in beacons.items()}
    truth |= {f"beacon {n}": p for n, p in places.items()}
    truth |= {f"range_bias {n}": options.range_bias_sigma * rng.standard_normal(1) for n in beacons}
    there = [Beacon(n, p, turnaround=0.2) for n, p in places.items()]
    said = tuple(Beacon(n, p, SURVEY, turnaround=0.2) for n, p in beacons.items())
    forward, left, up = truth["lever_arm"]
    arm = LeverArm(forward=float(forward), right=-float(left), down=-float(up))
    sea = Sea(PROFILE, log_scale=float(truth["sound_speed"][0]))
    begin = track.span[0]
    clock = Clock(
        float(truth["clock_offset"][0] - truth["clock_drift"][0] * begin),
        float(truth["clock_drift"][0]),
    )
    asked = two_way_pings(track, there, np.arange(begin + 1.0, end, 2.0), sea, rng, arm=arm)
    heard = one_way_pings(
        track, there, np.arange(begin + 2.0, end, 4.0), sea, rng, clock=clock, arm=arm
    )
    bias = {n: float(truth[f"range_bias {n}"][0]) / 1500.0 for n in beacons}
    by_ping = [np.array([bias[str(n)] for n in rows.beacon]) for rows in (asked, heard)]
    errors = DvlErrors(
        float(truth["dvl_scale"][0]),
        tuple(float(v) for v in truth["dvl_misalignment"]),
        tuple(float(v) for v in truth["dvl_bias"]),
    )
    motion = np.arange(begin, end, 0.5)
    attitude: Records = ahrs(track, motion, error=(float(truth["heading_bias"][0]), 0.0, 0.0))
    assert isinstance(attitude, Attitude)
    first = track.position(begin)[0]
    replies = replace(asked, travel_time=asked.travel_time + 2.0 * by_ping[0])
    segment = Segment(
        two_way_range=replies if shown else None,
        one_way_range=replace(heard, t_receive=heard.t_receive + by_ping[1]),
        velocity=dvl(track, motion, rng, errors=errors),
        attitude=replace(attitude, sigma=np.full(len(motion), 1e-5)),
        depth=pressure(track, np.arange(begin, end), rng),
        position=fixes(track, np.arange(begin, end, 5.0), rng, sigma=0.3) if shown else None,
        start=None if shown else Start(begin, *first[:2], sigma=50.0),
    )
    mission = Mission((segment,), said, PROFILE, Vehicle(), options, name="surveyed")
    return mission, truth


def hovering(seed):
    """The same by a vehicle that stands level far abeam of one beacon."""
    track = constant_velocity([400.0, 300.0, -20.0], [1e-9, 0.0, 0.0], (0.0, 65.0))
    return surveyed(seed, track, {"A": HEARD["A"]}, shown=False)
