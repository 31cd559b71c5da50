"""What vehicles with pose nodes have for unknowns beside their poses, and what is held."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.builder import heading_sigma, heading_walks, shared_states
from ubl_graph.mission import Segment, Setup
from ubl_graph.options import Options

#: Lasting error of a compass where nothing says it, rad.
COMPASS_SIGMA = float(np.deg2rad(5.0))


#: States that all nodes share, by the records that ask for them.
GYRO_STATES = (("gyro_bias", 3),)


ODOMETRY_STATES = (("odometry_scale", 1), ("odometry_turn_bias", 1))


def pose_states(
    setup: Setup, kinds: set[str], lasting: float
) -> tuple[tuple[tuple[str, int], ...], tuple[tuple[str, int], ...]]:
    """Slow states that poses carry beside those of points, and what all nodes share.

    Parameters
    ----------
    setup : Setup
        Beacons and options.
    kinds : set of str
        Record kinds that there are.
    lasting : float
        Standard deviation of the heading reference's lasting error, rad.
    """
    options = setup.options
    slow: list[tuple[str, int]] = []
    shared = [
        state
        for state in shared_states(setup, lasting if "velocity" in kinds else None)
        if state[0] != "heading_bias"
    ]
    if {"attitude", "heading"} & kinds and heading_sigma(options, lasting) > 0.0:
        (slow if heading_walks(options, lasting) else shared).append(("heading_bias", 1))
    if "angular_rate" in kinds and options.gyro_bias_sigma > 0.0:
        shared.append(("gyro_bias", 3 if options.node == "pose3" else 1))
    if "odometry" in kinds:
        sigmas = odometry_sigmas(options)
        shared += [(name, size) for name, size in ODOMETRY_STATES if sigmas[name] > 0.0]
    return tuple(slow), tuple(shared)


def odometry_sigmas(options: Options) -> dict[str, float]:
    """Prior standard deviations of the odometry's errors."""
    return {
        "odometry_scale": options.odometry_scale_sigma,
        "odometry_turn_bias": float(np.deg2rad(options.odometry_turn_bias_sigma_deg)),
    }


def lasting_heading_error(segments: Sequence[Segment]) -> float:
    """Standard deviation of the heading references' lasting error, rad."""
    attitudes = [s.attitude for s in segments if s.attitude is not None and len(s.attitude)]
    if attitudes:
        return max(float(np.median(a.sigma)) for a in attitudes)
    compass = any(s.heading is not None and len(s.heading) for s in segments)
    return COMPASS_SIGMA if compass else 0.0


def held_up(setup: Setup, segment: Segment, t: FloatArray) -> FloatArray:
    """Up at which a planar vehicle stays, (N,), m: as its depths, fixes or start say."""
    if segment.depth is not None and len(segment.depth):
        depth = segment.depth[np.argsort(segment.depth.t)]
        return -np.interp(t, depth.t, depth.depth) - setup.vehicle.depth_sensor.body[2]
    fixes = segment.position
    if fixes is not None and len(fixes) and fixes.up is not None:
        fixes = fixes[np.argsort(fixes.t)]
        return np.interp(t, fixes.t, fixes.up) - setup.vehicle.antenna.body[2]
    if segment.start is not None and segment.start.up is not None:
        return np.full(len(t), segment.start.up)
    return np.zeros(len(t))


def known_up(segment: Segment) -> bool:
    """Whether anything says at which up a planar vehicle stays (`held_up`)."""
    fixes, start = segment.position, segment.start
    return (
        (segment.depth is not None and len(segment.depth) > 0)
        or (fixes is not None and len(fixes) > 0 and fixes.up is not None)
        or (start is not None and start.up is not None)
    )
