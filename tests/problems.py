"""Missions that exercise every block at once, for tests of residuals and of the GTSAM view."""

from __future__ import annotations

import numpy as np

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.beacon import Beacon
from ubl_graph.frames import LeverArm
from ubl_graph.graph import build_problem, model_segment
from ubl_graph.measurements import Attitude, Depth, OneWayRange, PositionFix, TwoWayRange, Velocity
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
    layout.put(x, "position", place)
    for beacon in BEACONS:
        if layout.has(f"beacon {beacon.name}"):
            layout.put(x, f"beacon {beacon.name}", beacon.position + rng.normal(size=3))
    return x
