"""Missions that exercise every block at once, for tests of residuals and of the GTSAM view."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.beacon import Beacon
from ubl_graph.factors.poses import PoseNodes
from ubl_graph.frames import LeverArm, world_R_body
from ubl_graph.graph import build_problem, model_segment
from ubl_graph.measurements import (
    AngularRate,
    Attitude,
    Depth,
    Heading,
    Odometry,
    OneWayRange,
    PositionFix,
    SlantRange,
    TwoWayRange,
    Velocity,
)
from ubl_graph.mission import Mission, Segment, Start, Vehicle
from ubl_graph.options import Options
from ubl_graph.problem import Problem

PROFILE = SoundSpeedProfile(
    [0.0, 50.0, 200.0, 900.0, 1500.0], [1510.0, 1507.0, 1496.0, 1481.0, 1487.0]
)
BEACONS = (
    Beacon("B1", [0.0, 0.0, -1000.0], 1.0),
    Beacon("B2", [600.0, -200.0, -1100.0], [1.0, 2.0, 0.0]),
)


def everything(seed: int = 0, **options) -> Mission:
    """All record kinds, lever arms, unknown beacons, current and clock; nothing is consistent."""
    rng = np.random.default_rng(seed)
    n = 12
    t = np.sort(rng.uniform(0.0, 100.0, n))
    flight = rng.uniform(1.3, 1.8, n)
    names = rng.choice(["B1", "B2"], n)
    heard = np.sort(rng.uniform(5.0, 95.0, 8))
    dvl = np.arange(0.0, 100.1, 0.5)
    dvl = dvl[(dvl < 40.0) | (dvl > 55.0)]
    water = np.arange(30.0, 70.0, 1.0)
    velocity = Velocity(
        np.concatenate([dvl, water]),
        1.0 + 0.1 * rng.normal(size=len(dvl) + len(water)),
        0.1 * rng.normal(size=len(dvl) + len(water)),
        0.05 * rng.normal(size=len(dvl) + len(water)),
        0.02,
        np.repeat(["bottom", "water"], [len(dvl), len(water)]),
    )
    ahrs = np.arange(-1.0, 102.0, 1.0)
    attitude = Attitude(ahrs, 0.02 * ahrs, 0.1 * np.sin(ahrs / 5.0), 0.1 * np.cos(ahrs / 7.0))
    fix_t = np.array([3.0, 50.0, 97.0])
    fixes = rng.normal(size=(3, 3))
    covariance = np.array([[2.0, 0.5, 0.1], [0.5, 1.0, 0.0], [0.1, 0.0, 3.0]])
    segment = Segment(
        "",
        TwoWayRange(names, t, t + flight + 0.3, flight, 2e-4),
        OneWayRange("B1", heard - 0.71, heard, 3e-4),
        velocity,
        attitude,
        Depth(np.arange(0.0, 100.0, 7.0), 5.0 + rng.normal(size=15), 0.1),
        PositionFix(fix_t, *fixes.T, covariance=covariance),
        Start(0.0, 100.0, 50.0, -5.0, 3.0),
    )
    vehicle = Vehicle(
        LeverArm(0.3, -0.2, 0.5),
        LeverArm(-1.0, 0.4, 0.6),
        LeverArm(0.5, 0.1, -0.3),
        LeverArm(0.0, 0.2, -1.0),
    )
    settings = Options(**{"estimate_beacons": True, "estimate_current": True, **options})
    return Mission((segment,), BEACONS, PROFILE, vehicle, settings)


def everything_posed(
    seed: int = 0,
    *,
    node: str = "pose3",
    still: bool = False,
    without: str = "",
    **options,
) -> Mission:
    """The same for pose nodes, with compass, gyros, distances and odometry; nothing is consistent.

    With `still` odometry joins all nodes, which then have no velocities; one kind of records may
    be left out.
    """
    options = {"odometry_turn_bias_sigma_deg": 0.05, "node": node, **options}
    mission = everything(seed, **options)
    rng = np.random.default_rng([seed, 1])
    heard = np.sort(rng.uniform(1.0, 99.0, 7))
    read = np.sort(rng.uniform(0.0, 100.0, 9))
    rates = np.arange(-1.0, 102.0, 0.5)
    ends = np.arange(0.0, 105.0, 5.0) if still else np.array([7.0, 13.0, 20.0, 44.0, 52.0])
    planar = node == "pose2"
    segment = replace(
        mission.segments[0],
        slant_range=SlantRange(heard, "B1", rng.uniform(900.0, 1100.0, 7), 0.5),
        heading=Heading(read, rng.uniform(-np.pi, np.pi, 9), 0.03),
        angular_rate=AngularRate(rates, *(0.03 * rng.normal(size=(3, len(rates)))), 2e-3),
        odometry=odometry_between(rng, ends, planar),
        start=replace(mission.segments[0].start, heading=0.3, heading_sigma=0.05),
    )
    left_out = {"velocity": still, without: bool(without)}
    segment = replace(segment, **{kind: None for kind, out in left_out.items() if out})
    return replace(mission, segments=(segment,))


def odometry_between(rng: np.random.Generator, ends: np.ndarray, planar: bool) -> Odometry:
    """Some changes of pose, with covariances whose components have to do with one another."""
    count, size = len(ends) - 1, 3 if planar else 6
    root = np.tril(rng.normal(size=(count, size, size)), -1) + 3.0 * np.eye(size)
    root *= np.array([0.02] * (size - 1 if planar else 3) + [0.005] * (1 if planar else 3))[:, None]
    way, turn = rng.normal(size=(2, count, 3)) * [[[4.0]], [[0.1]]]
    if planar:
        return Odometry(
            ends[:-1],
            ends[1:],
            way[:, 0],
            way[:, 1],
            about_down=turn[:, 2],
            covariance=root @ np.swapaxes(root, 1, 2),
        )
    return Odometry(ends[:-1], ends[1:], *way.T, *turn.T, covariance=root @ np.swapaxes(root, 1, 2))


def posed_state(problem: Problem, seed: int = 0, turning: float = 0.3) -> np.ndarray:
    """A flat vector near the beacons whose poses lie near what `everything` says of the attitude.

    `turning` is the standard deviation (rad) of what they are turned by.
    """
    x = state_of(problem, seed)
    rng = np.random.default_rng([seed, 2])
    layout = problem.layout
    t = np.concatenate([chain.t for chain in layout.chains])
    near = world_R_body(0.02 * t, 0.1 * np.sin(t / 5.0), 0.1 * np.cos(t / 7.0))
    off = Rotation.from_rotvec(turning * rng.normal(size=(len(t), 3)))
    rotation = Rotation.from_matrix(near) * off
    if layout.node == "pose2":
        bow = rotation.as_matrix()[:, :, 0]
        layout.put(x, "rotation", np.arctan2(bow[:, 1], bow[:, 0])[:, None])
    else:
        layout.put(x, "rotation", rotation.as_rotvec())
    if layout.has("rate"):
        rate = layout.get(x, "rate")
        layout.put(x, "rate", 0.03 * rng.normal(size=rate.shape))
    return x


def nodes_of(problem: Problem, x: np.ndarray):
    """The poses of all nodes."""
    layout = problem.layout
    return PoseNodes(layout, np.arange(layout.node_count), not layout.still).at(x)


def problem_of(mission: Mission) -> Problem:
    """The problem of all segments together."""
    return build_problem(mission, [model_segment(s, mission.options) for s in mission.segments])


def state_of(problem: Problem, seed: int = 0) -> np.ndarray:
    """A flat vector near the beacons, every component away from zero."""
    rng = np.random.default_rng(seed)
    layout = problem.layout
    x = rng.normal(size=layout.size)
    nodes = layout.node_count
    place = [150.0, 80.0, -6.0] + rng.normal(size=(nodes, 3)) * [30.0, 30.0, 1.0]
    layout.put(x, "position", place[:, : layout.get(x, "position").shape[1]])
    for beacon in BEACONS:
        if layout.has(f"beacon {beacon.name}"):
            layout.put(x, f"beacon {beacon.name}", beacon.position + rng.normal(size=3))
    return x
