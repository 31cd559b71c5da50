"""Dead reckoning: from the start along the DVL's velocity over the bottom, without any range."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.attitude import AttitudeTrack
from ubl_graph.errors import DataError, UnobservableError
from ubl_graph.factors.odometry import Preintegration
from ubl_graph.mission import Mission, Segment, Start
from ubl_graph.options import Options
from ubl_graph.trajectory import Trajectory


def dead_reckoning(
    mission: Mission, starts: Mapping[str, Start] | None = None
) -> dict[str, Trajectory]:
    """Reckon every segment of a mission from its start by DVL, attitude and depth.

    Parameters
    ----------
    mission : Mission
        Only velocities over the bottom, attitude, depth and start are used.
    starts : mapping of str to Start, optional
        Where segments start, by segment name; goes before the mission's own start priors.

    Returns
    -------
    dict of str to Trajectory
        By segment name, with a node at each velocity. The covariance is that of the start, of
        the white noise, and of the DVL's errors as the options expect them.

    Raises
    ------
    DataError
        Where a segment has fewer than two velocities over the bottom.
    UnobservableError
        Where a segment has no start.
    """
    starts = {} if starts is None else starts
    return {
        segment.name: _reckon(mission, segment, starts.get(segment.name, segment.start))
        for segment in mission.segments
    }


def _reckon(mission: Mission, segment: Segment, start: Start | None) -> Trajectory:
    where = f"segment '{segment.name}'" if segment.name else "the mission"
    rows = segment.velocity
    rows = None if rows is None else rows[rows.reference == "bottom"]
    if rows is None or len(rows) < 2:
        raise DataError(
            f"{where} has no velocities over the bottom",
            "dead reckoning needs a DVL's bottom track",
        )
    if start is None:
        raise UnobservableError(f"{where} has no start; dead reckoning has to begin somewhere")
    options, arm = mission.options.settled, mission.vehicle.dvl
    attitude = AttitudeTrack(segment.attitude)
    samples = Preintegration(rows, attitude, options.number("acceleration_psd"))
    t = samples.t
    # Outside the samples the integral stands still; the first or last velocity bridges to there.
    nearest = float(np.clip(start.t, t[0], t[-1]))
    begin = np.full(len(t), nearest)
    moved = samples.between(begin, t)
    at = np.array([start.t])
    bridge = samples.rates_at(np.array([nearest])).displacement[0] * (nearest - start.t)
    lever = attitude.lever(arm, t) - attitude.lever(arm, at)
    position = moved.displacement + bridge - lever
    position += [start.east, start.north, 0.0 if start.up is None else start.up]
    velocity = samples.rates_at(t).displacement - attitude.lever_rate(arm, t)
    noise = samples.between(np.minimum(begin, t), np.maximum(begin, t)).sigma ** 2
    covariance = (start.sigma**2 + noise)[:, None, None] * np.eye(3)
    covariance += _by_errors(
        options, moved.displacement, moved.by_misalignment, moved.by_bias, segment
    )
    depth = segment.depth
    if depth is not None and len(depth):
        depth = depth[np.argsort(depth.t)]
        up = attitude.lever(mission.vehicle.depth_sensor, t)[:, 2]
        position[:, 2] = -np.interp(t, depth.t, depth.depth) - up
        covariance[:, 2, :] = covariance[:, :, 2] = 0.0
        covariance[:, 2, 2] = np.interp(t, depth.t, depth.sigma) ** 2
    psd = options.number("acceleration_psd")
    return Trajectory(t, position, velocity, None, covariance, (psd, psd))


def _by_errors(
    options: Options,
    by_scale: FloatArray,
    by_misalignment: FloatArray,
    by_bias: FloatArray,
    segment: Segment,
) -> FloatArray:
    """Covariance (M, 3, 3), m^2, by the DVL's scale, misalignment and bias."""
    angle = np.deg2rad(options.dvl_misalignment_sigma_deg)
    if segment.attitude is not None and len(segment.attitude):
        angle = np.hypot(angle, np.median(segment.attitude.sigma))
    slopes = np.concatenate(
        [
            options.dvl_scale_sigma * by_scale[:, :, None],
            angle * by_misalignment,
            options.dvl_bias_sigma * by_bias,
        ],
        axis=2,
    )
    return slopes @ np.swapaxes(slopes, 1, 2)
