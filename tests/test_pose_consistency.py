"""The covariances of poses are true: NEES of runs drawn from the smoother's own model.

As in `tests/test_consistency.py`: the mean NEES of independent runs lies within two-sided 99.9 %
bounds, for positions, rotations, velocities, and the errors of compass, gyro and odometry.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Literal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp
from test_consistency import BEACONS, PROFILE, assert_consistent, bounds, squared

from ubl_graph import Attitude, LeverArm, Mission, Options, Segment, Start, Vehicle, smooth
from ubl_graph.mission import CONSTANT_SIGMA
from ubl_graph.pose_trajectory import PoseTrajectory, mariners_angles
from ubl_graph.result import Result
from ubl_graph.sim import (
    DRIFTING,
    PLANAR,
    Sea,
    Truth,
    compass,
    drifting_heading,
    dvl,
    gyro,
    lawn_mower,
    odometer,
    planar_vehicle,
    pressure,
    slant_ranges,
    two_way_pings,
    wander,
)

#: NEES by what it is of, with its degrees of freedom.
Judged = dict[tuple[str, int], float]
DURATION = 120.0
ARM = LeverArm(1.2, -0.4, 0.6)
WNOA = Options(
    node="pose3",
    loss="none",
    vertical_acceleration_psd=1e-3,
    angular_acceleration_psd=3e-7,
    heading_bias_sigma_deg=1.0,
    solver="banded",
)
CHAIN = replace(PLANAR, loss="none", solver="banded", estimate_sound_speed=False)
GYRO = replace(
    WNOA,
    node="pose2",
    heading_bias_sigma_deg=3.0,
    angular_acceleration_psd=1e-4,
    gyro_bias_sigma=2e-3,
    dvl_misalignment_sigma_deg=0.0,
)


def drawn(rng: np.random.Generator, options: Options, span: tuple[float, float]) -> Truth:
    """A track from the motion prior on poses: the twist's change is white in the body's axes."""
    step, planar = 0.02, options.node == "pose2"
    grid = np.arange(span[0], span[1] + step, step)
    density = np.array([options.horizontal_psd] * 2 + [options.vertical_psd])
    density = np.concatenate([density, np.full(3, options.angular_acceleration_psd)])
    if planar:
        density[2:5] = 0.0
    walk = np.sqrt(density * step) * rng.standard_normal((len(grid), 6))
    twist = np.array([1.2, 0.1, 0.0, 0.0, 0.0, 0.01]) + np.cumsum(walk, axis=0)
    turns = Rotation.from_rotvec(step * twist[:, 3:])
    at = Rotation.from_rotvec([0.0, 0.0, rng.uniform(0.0, 2.0 * np.pi)])
    place = np.array([*rng.uniform(-60.0, 60.0, 2), -60.0])
    rotations, places = np.empty((len(grid), 4)), np.empty((len(grid), 3))
    for k in range(len(grid)):
        rotations[k], places[k] = at.as_quat(), place
        place = place + step * at.apply(twist[k, :3])
        at = at * turns[k]
    slerp = Slerp(grid, Rotation.from_quat(rotations))
    speeds = Rotation.from_quat(rotations).apply(twist[:, :3])

    def interpolated(values: np.ndarray, t: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(t, grid, column) for column in values.T], axis=1)

    def angle(i: int) -> Callable[[np.ndarray], np.ndarray]:
        return lambda t: mariners_angles(slerp(t).as_matrix())[:, i]

    return Truth(
        span,
        lambda t: (interpolated(places, t), interpolated(speeds, t)),
        *(angle(i) for i in range(3)),
    )


def judged(result: Result, truth: Truth, space: tuple[int, ...], *, between: bool = True) -> Judged:
    """NEES of pose and velocity at the middle, the end and between nodes.

    `space` are the components of a pose that count. Between nodes only a truth that was drawn from
    the prior is what the covariance speaks of.
    """
    assert result.status == "converged", result.reason
    track = result.segments[0].trajectory
    assert isinstance(track, PoseTrajectory)
    middle = len(track.t) // 2
    longest = middle + int(np.argmax(np.diff(track.t[middle : middle + 6])))
    times = {
        "middle": track.t[middle],
        "end": track.t[-1],
        "between nodes": 0.5 * (track.t[longest] + track.t[longest + 1]),
    }
    if not between:
        del times["between nodes"]
    out: Judged = {}
    for place, time in times.items():
        states = track.at(time)
        off = states.position - truth.position(time)
        relative = states.rotation[0] @ truth.rotation(time)[0].T
        turned = Rotation.from_matrix(relative).as_rotvec()
        error = np.concatenate([off[0], turned])
        covariance = states.pose_covariance[0]
        turns = [i for i in space if i >= 3]
        for what, axes in (
            ("horizontal", [0, 1]),
            ("position", [i for i in space if i < 3]),
            ("rotation", turns),
            ("pose", list(space)),
        ):
            kept = np.ix_(axes, axes)
            out[f"{what}, {place}", len(axes)] = squared(error[axes], covariance[kept])
        if not track.still:
            axes = [i for i in space if i < 3]
            speed = (states.velocity - truth.velocity(time))[0, axes]
            spread = states.velocity_covariance[0][np.ix_(axes, axes)]
            out[f"velocity, {place}", len(axes)] = squared(speed, spread)
    return out


def check(runs: list[Judged], what: str) -> None:
    for name, dof in runs[0]:
        assert_consistent([run[name, dof] for run in runs], dof, f"{what}, {name}")


def shared(result: Result, **truth: float | np.ndarray) -> Judged:
    """NEES of what all nodes share."""
    out: Judged = {}
    for name, true in truth.items():
        found = result.shared[name]
        off = found.value - np.atleast_1d(true)
        out[name, len(off)] = squared(off, found.covariance)
    return out


SPACE, PLANE = (0, 1, 2, 3, 4, 5), (0, 1, 5)


def swimmer(seed: int) -> Judged:
    """Pings, depths and attitudes of a vehicle in space; the prior alone joins its nodes."""
    rng = np.random.default_rng([seed, 11])
    span = (0.0, DURATION + 5.0)
    truth = drawn(rng, WNOA, span)
    t = np.arange(0.0, DURATION + 2.0, 0.5)
    bias = float(np.deg2rad(WNOA.heading_bias_sigma_deg)) * rng.standard_normal()
    white = float(np.deg2rad(WNOA.attitude_noise_deg))
    read = Rotation.from_rotvec([0.0, 0.0, -bias]) * Rotation.from_matrix(truth.rotation(t))
    read = read * Rotation.from_rotvec(white * rng.standard_normal((len(t), 3)))
    scale = wander(rng, CONSTANT_SIGMA, WNOA.number("sound_speed_walk"), span)
    sea = Sea(PROFILE, log_scale=scale)
    segment = Segment(
        two_way_range=two_way_pings(
            truth, BEACONS, np.arange(0.0, DURATION, 5.0), sea, rng, arm=ARM
        ),
        depth=pressure(truth, np.arange(0.0, DURATION + 1.0, 2.0), rng),
        attitude=Attitude(t, *mariners_angles(read.as_matrix()).T),
    )
    mission = Mission((segment,), BEACONS, PROFILE, Vehicle(transducer=ARM), WNOA)
    result = smooth(mission)
    return judged(result, truth, SPACE) | shared(result, heading_bias=bias)


def turning(seed: int) -> Judged:
    """Pings, DVL, gyro and compass of a vehicle in a plane."""
    rng = np.random.default_rng([seed, 12])
    span = (0.0, DURATION + 5.0)
    truth = drawn(rng, GYRO, span)
    bias = float(np.deg2rad(GYRO.heading_bias_sigma_deg)) * rng.standard_normal()
    truth = truth.with_heading_bias(bias)
    drift = GYRO.gyro_bias_sigma * rng.standard_normal()
    fine = np.arange(0.0, DURATION + 2.0, 0.1)
    scale = wander(rng, CONSTANT_SIGMA, GYRO.number("sound_speed_walk"), span)
    sea = Sea(PROFILE, log_scale=scale)
    velocity = dvl(truth, fine, rng)
    # What a DVL that knows nothing of its errors says, with a scale and a bias.
    dvl_scale = GYRO.dvl_scale_sigma * rng.standard_normal()
    off = GYRO.dvl_bias_sigma * rng.standard_normal(2)
    velocity = replace(
        velocity,
        forward=(velocity.forward - off[0]) / (1.0 + dvl_scale),
        right=(velocity.right - off[1]) / (1.0 + dvl_scale),
    )
    segment = Segment(
        two_way_range=two_way_pings(
            truth, BEACONS, np.arange(0.0, DURATION, 5.0), sea, rng, arm=ARM
        ),
        depth=pressure(truth, np.arange(0.0, DURATION + 1.0, 2.0), rng, noise=0.0),
        velocity=velocity,
        heading=compass(truth, np.arange(0.0, DURATION, 1.0), rng),
        angular_rate=gyro(truth, fine, rng, bias=(0.0, 0.0, drift), planar=True),
    )
    mission = Mission((segment,), BEACONS, PROFILE, Vehicle(transducer=ARM), GYRO)
    result = smooth(mission)
    return judged(result, truth, PLANE) | shared(result, heading_bias=bias, gyro_bias=-drift)


def odometry(seed: int, node: Literal["pose2", "pose3"]) -> Judged:
    """Odometry whose noise grows, with its errors, a compass, a start and ranges."""
    rng, in_space = np.random.default_rng([seed, 13]), node == "pose3"
    options = replace(CHAIN, node=node)
    bias = float(np.deg2rad(options.heading_bias_sigma_deg)) * rng.standard_normal()
    turn_sigma = float(np.deg2rad(options.odometry_turn_bias_sigma_deg))
    turn_bias = turn_sigma * float(rng.standard_normal())
    scale = options.odometry_scale_sigma * float(rng.standard_normal())
    truth = lawn_mower([0.0, 0.0], depth=60.0, lines=3, length=120.0, spacing=40.0, speed=1.2)
    truth = truth.with_heading_bias(bias)
    if in_space:
        truth = truth.with_attitude(
            pitch=lambda t: 0.05 + 0.08 * np.sin(0.6 * t), roll=lambda t: 0.15 * np.sin(0.9 * t)
        )
    t = np.arange(0.0, 280.0)
    east, north, up = truth.position(0.0)[0] + 2.0 * rng.standard_normal(3)
    segment = Segment(
        odometry=odometer(
            truth, t, rng, options, scale=scale, turn_bias=turn_bias, planar=not in_space
        ),
        slant_range=slant_ranges(truth, BEACONS, t[::5], rng, arm=ARM),
        heading=compass(truth, t[::4], rng),
        depth=pressure(truth, t[::3], rng, noise=1.0 if in_space else 0.0),
        start=Start(0.0, east, north, up, 2.0),
    )
    mission = Mission((segment,), BEACONS, PROFILE, Vehicle(transducer=ARM), options)
    result = smooth(mission)
    space = SPACE if in_space else PLANE
    return judged(result, truth, space, between=False) | shared(
        result, heading_bias=bias, odometry_scale=scale, odometry_turn_bias=turn_bias
    )


def planar(seed: int) -> Judged:
    """Odometry in a plane."""
    return odometry(seed, "pose2")


def spatial(seed: int) -> Judged:
    """Odometry in space."""
    return odometry(seed, "pose3")


def drifting(seed: int) -> Judged:
    """The AUV whose heading reference is off and wanders, over a single beacon.

    Position, heading and bias. Roll and pitch are read between two records of the reference, whose
    mean is less noisy than the one that is taken for it; velocities are smoother than the prior's.
    """
    options = replace(DRIFTING, loss="none", solver="banded", node="pose3")
    mission, truth = drifting_heading(seed, options=options, heading_bias_deg=None)
    result = smooth(mission)
    places = judged(result, truth, SPACE, between=False)
    headings = judged(result, truth, PLANE, between=False)
    out = {key: v for key, v in places.items() if key[0].startswith(("horizontal", "position"))}
    out |= {key: v for key, v in headings.items() if key[0].startswith("rotation")}
    bias = result.segments[0].slow["heading_bias"]
    for name, i in (("start", 0), ("middle", len(bias.t) // 2), ("end", -1)):
        off = (bias.value[i, 0] - truth.heading_bias(bias.t)[i]) / bias.sigma[i, 0]
        out[f"heading bias, {name}", 1] = float(off**2)
    return out


@cache
def runs(kind: Callable[[int], Judged], count: int) -> list[Judged]:
    return [kind(seed) for seed in range(count)]


def test_motion_prior_on_poses():
    check(runs(swimmer, 15), "pose3")


def test_gyro_compass_and_dvl():
    check(runs(turning, 15), "pose2 with gyro")


def test_planar_odometry():
    check(runs(planar, 15), "pose2, odometry")


def test_spatial_odometry():
    check(runs(spatial, 12), "pose3, odometry")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "count"),
    [(swimmer, 100), (turning, 100), (planar, 100), (spatial, 100), (drifting, 50)],
)
def test_many_runs(kind: Callable[[int], Judged], count: int):
    check(runs(kind, count), kind.__name__)


def test_a_heading_taken_at_its_word_is_found_out():
    """The test has teeth: without the bias as a state NEES explodes."""
    high = []
    for seed in range(6):
        options = replace(PLANAR, loss="none", heading_bias_sigma_deg=0.0, solver="banded")
        fresh = replace(PLANAR, loss="none", solver="banded")
        mission, truth = planar_vehicle(seed, options=fresh, duration=200.0)
        result = smooth(replace(mission, options=options))
        high.append(judged(result, truth, PLANE)["rotation, middle", 1])
    assert np.mean(high) > 2.0 * bounds(6, 1)[1]
