"""Plaza2: a mower on a flat field among four range radios, with RTK GNSS as the truth.

The radios read 7 % long, and the odometry turns without end: by -0.00054 rad (counter-clockwise) a
step of 0.1 s too much, standing or not. "Calibrated" ranges are divided by one factor for all. Data
of Djugash, Hamner and Roth (2009), as GTSAM ships them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import gtsam
import numpy as np
import pytest
from scipy.io import loadmat

from ubl_graph import (
    Beacon,
    Mission,
    Odometry,
    Options,
    Segment,
    SlantRange,
    SoundSpeedProfile,
    Start,
    lie,
    smooth,
)
from ubl_graph.result import Result

#: All ranges are too long by this factor; a factor of 1.068 or 1.071 does as well.
LONG = 1.07
#: Ranges scatter about the truth by 0.52 m once they are calibrated.
RANGE_SIGMA = 0.5
#: What a cheap gyro may turn too far, degrees per second.
TURN_BIAS = {"odometry_turn_bias_sigma_deg": 0.5}
#: Metres, whose scale is right.
CALIBRATED = {"estimate_sound_speed": False}
#: One factor for all ranges, known to a tenth beforehand.
COMMON_SCALE = {"sound_speed_sigma": 0.1, "sound_speed_walk": 0.0}
BEACONS = ("0", "1", "5", "6")


@dataclass(frozen=True)
class Plaza:
    """Times (s), true track, dead reckoning by step, ranges, beacons."""

    t: np.ndarray
    truth: np.ndarray
    way: np.ndarray
    turn: np.ndarray
    ranges: np.ndarray
    beacons: tuple[Beacon, ...]


@cache
def plaza() -> Plaza:
    data = loadmat(gtsam.findExampleDataFile("Plaza2_.mat"))
    truth, ranges = data["GT"].copy(), data["TD"].copy()
    ranges[:, 0] -= truth[0, 0]
    truth[:, 0] -= truth[0, 0]
    # The column of the heading looks backward.
    truth[:, 3] += np.pi
    beacons = tuple(Beacon(str(int(n)), [east, north, 0.0]) for n, east, north in data["TL"])
    return Plaza(truth[:, 0], truth[:, 1:4], data["DR"][:, 1], data["DR"][:, 2], ranges, beacons)


def mission(divisor: float, only: str | None = None, **options) -> Mission:
    """The mower's mission with all ranges divided by a number, of all beacons or of one."""
    p = plaza()
    # A step is an arc: so far ahead while it turns so much.
    none = np.zeros_like(p.way)
    rotation, way = lie.exponential(np.stack([p.way, none, none, none, none, p.turn], axis=1))
    assert np.allclose(lie.rotation_vector(rotation)[:, 2], p.turn)
    odometry = Odometry(p.t[:-1], p.t[1:], way[:, 0], -way[:, 1], about_down=-p.turn)
    rows = p.ranges if only is None else p.ranges[p.ranges[:, 2] == float(only)]
    names = [str(int(n)) for n in rows[:, 2]]
    ranges = SlantRange(rows[:, 0], names, rows[:, 3] / divisor, RANGE_SIGMA)
    east, north, yaw = p.truth[0]
    start = Start(
        0.0,
        east,
        north,
        sigma=0.1,
        heading=float(np.pi / 2 - yaw) % (2 * np.pi),
        heading_sigma=0.01,
    )
    segment = Segment(odometry=odometry, slant_range=ranges, start=start)
    water = SoundSpeedProfile.constant(1500.0)
    return Mission((segment,), p.beacons, water, options=Options(node="pose2", **options))


@cache
def calibrated() -> Result:
    return smooth(mission(LONG, **CALIBRATED, **TURN_BIAS))


def off(result: Result) -> float:
    """Absolute trajectory error: horizontal rms distance from the truth, m."""
    p = plaza()
    assert result.status == "converged", result.reason
    assert np.array_equal(result.trajectory.t, p.t)
    gap = result.trajectory.position[:, :2] - p.truth[:, :2]
    return float(np.sqrt(np.mean(np.sum(gap**2, axis=1))))


def test_the_data_are_what_the_docs_say():
    p = plaza()
    place = np.stack([np.interp(p.ranges[:, 0], p.t, p.truth[:, c]) for c in (0, 1)], axis=1)
    sites = {float(b.name): b.position[:2] for b in p.beacons}
    site = np.array([sites[n] for n in p.ranges[:, 2]])
    long = p.ranges[:, 3] / np.linalg.norm(place - site, axis=1)
    assert np.median(long) == pytest.approx(1.07, abs=0.002)
    for name in sites:
        mine = p.ranges[:, 2] == name
        assert 1.06 < np.median(long[mine]) < 1.08
    # By step of 0.1 s, the odometry's turns less the true ones.
    true = np.angle(np.exp(1j * np.diff(p.truth[:, 2])))
    assert (p.turn - true).sum() / p.t[-1] * 0.1 == pytest.approx(-5.4e-4, abs=0.3e-4)


def test_calibrated_ranges():
    assert off(calibrated()) <= 0.28


def test_the_headings_are_the_true_ones():
    track = calibrated().segments[0].trajectory
    course = np.pi / 2 - plaza().truth[:, 2]
    error = np.angle(np.exp(1j * (track.attitude[:, 0] - course)))
    assert np.sqrt(np.mean(error**2)) < np.deg2rad(3.0)
    assert abs(np.median(error)) < np.deg2rad(1.0)


def test_the_turn_bias_is_what_is_turned_too_far_clockwise():
    """-0.00054 rad a step of 0.1 s, counter-clockwise, are +0.0054 rad/s clockwise."""
    p, bias = plaza(), calibrated().shared["odometry_turn_bias"]
    true = np.angle(np.exp(1j * np.diff(p.truth[:, 2])))
    known = -(p.turn - true).sum() / p.t[-1]
    assert 0.005 < known < 0.006
    assert bias.value[0] == pytest.approx(known, abs=4.0 * bias.sigma[0] + 1e-4)


def test_raw_ranges_with_their_common_scale():
    result = smooth(mission(1.0, **COMMON_SCALE, **TURN_BIAS))
    assert off(result) <= 0.32
    scale = result.segments[0].slow["sound_speed"]
    assert np.ptp(scale.value) < 1e-3
    assert scale.value[0, 0] == pytest.approx(np.log(LONG), abs=0.005)
    assert scale.sigma.max() < 0.003


def test_raw_ranges_at_their_word_are_metres_off():
    """Least squares without the scale: more than ten times what is allowed with it."""
    result = smooth(mission(1.0, loss="none", **CALIBRATED))
    assert off(result) > 10.0 * 0.28
    assert any("chi-square" in w for w in result.warnings)


@pytest.mark.slow
def test_one_beacon():
    """Start known; the turn bias is a state, and found whichever beacon was heard."""
    results = {b: smooth(mission(LONG, b, **CALIBRATED, **TURN_BIAS)) for b in BEACONS}
    errors = {b: off(result) for b, result in results.items()}
    assert max(errors.values()) <= 4.2, errors
    assert np.mean(list(errors.values())) <= 3.0, errors
    for result in results.values():
        bias = result.shared["odometry_turn_bias"]
        assert bias.value[0] == pytest.approx(0.0054, abs=4.0 * bias.sigma[0])


@pytest.mark.slow
def test_one_beacon_without_the_turn_bias():
    """8 to 36 m: what the state is good for."""
    known = {"odometry_turn_bias_sigma_deg": 0.0}
    result = smooth(mission(LONG, BEACONS[0], **CALIBRATED, **known))
    assert "odometry_turn_bias" not in result.shared
    assert result.status != "converged" or off(result) > 8.0
