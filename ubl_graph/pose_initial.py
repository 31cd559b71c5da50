"""A start for pose nodes, found from the data alone.

Where a reference tells the heading the search for points serves, and the reference gives the
attitude. Where odometry or gyros know only how the vehicle turned, its whole reckoned track is laid
over the ranges from starts all around (`ubl_graph.pose_starts`). Where nothing is known of the
attitude the bow lies along the course.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from ubl_graph import lie
from ubl_graph.arrays import FloatArray
from ubl_graph.builder import FREE_POSITION, SegmentModel, heading_sigma
from ubl_graph.initial import Starts, find_starts
from ubl_graph.measurements import Odometry, OneWayRange, SlantRange
from ubl_graph.mission import Mission
from ubl_graph.nodes import NOMINAL_SPEED
from ubl_graph.odometry_noise import PLANAR, node_of, odometry_covariances
from ubl_graph.pings import Pings, leg_times, measured_times
from ubl_graph.pose_nodes import ends_of
from ubl_graph.pose_starts import PoseStart, find_pose_starts
from ubl_graph.pose_states import COMPASS_SIGMA, lasting_heading_error, odometry_sigmas
from ubl_graph.pose_windows import Anchors, ReckonedTrack, TrackRanges, Unknowns
from ubl_graph.track import Track

#: So many answers are solved in full, the best first.
MOST_STARTS = 6
#: An answer whose cost is higher by more than this is not solved.
WORTH_SOLVING = 1e3
#: A heading reference that may be off by more than this does not lead the search, rad.
TRUSTED_HEADING = float(np.deg2rad(10.0))
#: The search lets odometry be off by no more: a wide scale would drive it backwards.
WIDEST_SCALE = 0.1
#: No reading of it counts for more than this, rad.
LEAST_HEADING = float(np.deg2rad(1.0))
#: Compass readings that the search looks at; more are thinned out evenly.
MOST_READINGS = 50
#: What is not known of an anchor.
UNKNOWN = np.inf


@dataclass(frozen=True, eq=False)
class Reckoned:
    """Poses at the nodes in a frame of their own, with what the odometry adds to their variance.

    Attributes
    ----------
    rotation : array, shape (N, 3, 3)
        Body axes to the frame's.
    position : array, shape (N, 3)
        m.
    place, heading : array, shape (N,)
        Variance of each horizontal component (m^2) and of the heading (rad^2).
    unknowns : Unknowns
        What may be wrong with it.
    """

    rotation: FloatArray
    position: FloatArray
    place: FloatArray
    heading: FloatArray
    unknowns: Unknowns


def find_pose_tracks(mission: Mission, model: SegmentModel) -> Starts:
    """Search a segment's start.

    Parameters
    ----------
    mission : Mission
        Beacons, sound speed, options.
    model : SegmentModel
        The segment, of pose nodes.

    Returns
    -------
    Starts

    Raises
    ------
    UnobservableError
        Where nothing says where the vehicle is.
    """
    velocities = model.bottom is not None or model.water is not None
    trusted = model.heads and _heading_sigma(mission, model) <= TRUSTED_HEADING
    reckoned = None
    if len(model.t) > 1 and not (trusted and velocities):
        reckoned = _reckoned(mission, model)
    if reckoned is None:
        found = find_starts(mission, model)
        if not model.heads:
            return found
        rotation = model.attitude.at(model.t)
        return replace(found, tracks=tuple(replace(t, rotation=rotation) for t in found.tracks))
    track = ReckonedTrack(
        model.t, reckoned.position, _yaw(reckoned.rotation), reckoned.place, reckoned.heading
    )
    ranges = _ranges(mission, model, reckoned)
    anchors = _anchors(mission, model)
    starts = find_pose_starts(track, ranges, reckoned.unknowns, anchors)
    dearest = starts[0].cost + WORTH_SOLVING
    tracks = [_track(model, reckoned, s) for s in starts[:MOST_STARTS] if s.cost <= dearest]
    runner_up = starts[1].cost - starts[0].cost if len(starts) > 1 else None
    return Starts(tuple(tracks), None, runner_up)


def reckoned_track(mission: Mission, model: SegmentModel) -> Track | None:
    """Where odometry leads from a start whose place and heading are known.

    Parameters
    ----------
    mission, model
        As for `find_pose_tracks`.

    Returns
    -------
    ubl_graph.track.Track or None
        None where the start does not say enough, or there is no odometry.
    """
    start = model.segment.start
    if mission.options.node == "point" or start is None or start.heading is None:
        return None
    placed = start.up is not None or mission.options.node == "pose2"
    if not placed or start.heading_sigma > TRUSTED_HEADING or len(model.t) < 2:
        return None
    reckoned = _reckoned(mission, model)
    if reckoned is None:
        return None
    then = np.array([start.t])
    rotation, position = _onto(then, model.t, reckoned.rotation, reckoned.position)
    turn = 0.5 * np.pi - start.heading - float(_yaw(rotation)[0])
    turned = lie.rotation(turn * np.array([[0.0, 0.0, 1.0]]))[0]
    place = np.array([start.east, start.north, start.up or 0.0])
    way = (reckoned.position - position[0]) @ turned.T + place
    yaw = np.unwrap(_yaw(reckoned.rotation)) + turn
    return _track(model, reckoned, PoseStart(way, yaw, 0.0, 0.0, 0.0, 0.0))


def find_tracks(mission: Mission, model: SegmentModel) -> Starts:
    """Search a segment's start, whatever its nodes are: `find_starts` or `find_pose_tracks`."""
    find = find_starts if mission.options.node == "point" else find_pose_tracks
    return find(mission, model)


def _heading_sigma(mission: Mission, model: SegmentModel) -> float:
    """What the heading reference may lastingly be off by, rad."""
    return heading_sigma(mission.options, lasting_heading_error([model.segment]))


def _reckoned(mission: Mission, model: SegmentModel) -> Reckoned | None:
    """The track as odometry or gyros and velocities know it; None where neither does."""
    options, segment = mission.options, model.segment
    up = 0.0
    if options.node == "pose3" and segment.depth is None:
        up = FREE_POSITION
    range_scale = mission.sound_speed_sigma if options.estimate_sound_speed else 0.0
    if segment.odometry is not None and len(segment.odometry):
        sigmas = odometry_sigmas(options)
        unknowns = Unknowns(
            turn_bias=sigmas["odometry_turn_bias"],
            scale=min(sigmas["odometry_scale"], WIDEST_SCALE),
            range_scale=range_scale,
            up=up,
        )
        ends = ends_of(segment.odometry)
        rotation, position = _onto(model.t, ends, *compose(ends, segment.odometry))
        place, heading = (
            np.interp(model.t, ends, grown) for grown in _growth(ends, segment.odometry, mission)
        )
        return Reckoned(rotation, position, place, heading, unknowns)
    samples = model.bottom or model.water
    if samples is None or not (model.gyro is not None or model.heads):
        return None
    first = np.full(len(model.t), model.t[0])
    moved = samples.between(first, model.t)
    turned = np.zeros(len(model.t))
    if model.gyro is not None and not model.heads:
        turned = model.gyro.between(first, model.t).sigma ** 2
    unknowns = Unknowns(
        turn_bias=0.0 if model.heads else options.gyro_bias_sigma,
        scale=min(options.dvl_scale_sigma, WIDEST_SCALE),
        range_scale=range_scale,
        up=up,
    )
    rotation = model.attitude.at(model.t)
    return Reckoned(rotation, moved.displacement, moved.sigma**2, turned, unknowns)


def compose(t: FloatArray, records: Odometry) -> tuple[FloatArray, FloatArray]:
    """Poses at the records' ends `t` (N,) in the axes of the first: (N, 3, 3), (N, 3).

    Of several records that lead to a pose the one from its nearest predecessor counts. Over a gap
    the vehicle goes on as it went.
    """
    first, last = node_of(t, records.t_from), node_of(t, records.t_to)
    order = np.lexsort((first, last))
    came_from, record = np.full(len(t), -1), np.full(len(t), -1)
    came_from[last[order]], record[last[order]] = first[order], order
    turns = lie.rotation(records.rotation_vector)
    rotation, position = np.zeros((len(t), 3, 3)), np.zeros((len(t), 3))
    rotation[0] = np.eye(3)
    for k in range(1, len(t)):
        if came_from[k] < 0:
            rotation[k] = rotation[k - 1]
            if k > 1:
                pace = (position[k - 1] - position[k - 2]) / (t[k - 1] - t[k - 2])
                position[k] = position[k - 1] + pace * (t[k] - t[k - 1])
            continue
        before = rotation[came_from[k]]
        rotation[k] = before @ turns[record[k]]
        position[k] = position[came_from[k]] + before @ records.translation[record[k]]
    return rotation, position


def _onto(
    t: FloatArray, ends: FloatArray, rotation: FloatArray, position: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Poses at other times `t`: between the ends of records, and beyond them as it went there."""
    if len(t) == len(ends) and (t == ends).all():
        return rotation, position
    within = np.clip(t, ends[0], ends[-1])
    turned = Slerp(ends, Rotation.from_matrix(rotation))(within).as_matrix()
    placed = _interpolated(ends, position, within)
    first, last = (np.diff(position, axis=0)[i] / np.diff(ends)[i] for i in (0, -1))
    beyond = (t - within)[:, None]
    return turned, placed + np.where(beyond < 0.0, beyond * first, beyond * last)


def _growth(t: FloatArray, records: Odometry, mission: Mission) -> tuple[FloatArray, FloatArray]:
    """Variance of place (m^2) and heading (rad^2) that odometry has added by each node, (N,)."""
    covariance = odometry_covariances(records, mission.options)
    if covariance.shape[1] == 6:
        covariance = covariance[:, PLANAR[:, None], PLANAR[None, :]]
    sums = np.zeros((2, len(t)))
    node = node_of(t, records.t_to)
    # Of several records into a node the best counts; it is a search, not an estimate.
    best = np.full((2, len(t)), np.inf)
    np.minimum.at(best[0], node, 0.5 * (covariance[:, 0, 0] + covariance[:, 1, 1]))
    np.minimum.at(best[1], node, covariance[:, 2, 2])
    sums = np.cumsum(np.where(np.isfinite(best), best, 0.0), axis=1)
    return sums[0], sums[1]


def _ranges(mission: Mission, model: SegmentModel, reckoned: Reckoned) -> TrackRanges:
    """All ranges as distances at one instant each."""
    segment = model.segment
    sites = np.array([b.position for b in mission.beacons]).reshape(-1, 3)
    arm = mission.vehicle.transducer.body
    speed = float(np.mean(mission.sound_speed.speed))
    parts: list[tuple[FloatArray, ...]] = []
    two_way_or_slant = (segment.two_way_range, segment.slant_range)
    timed: list[Pings] = [p for p in two_way_or_slant if p is not None and len(p)]
    if not timed and segment.one_way_range is not None and len(segment.one_way_range):
        timed.append(segment.one_way_range)
    for pings in timed:
        measured, sigma = measured_times(pings)
        ways = 1.0 if isinstance(pings, (SlantRange, OneWayRange)) else 2.0
        metres = (NOMINAL_SPEED if isinstance(pings, SlantRange) else speed) / ways
        t = leg_times(pings).mean(axis=1)
        antenna = _interpolated(model.t, reckoned.position + reckoned.rotation @ arm, t)
        beacon = sites[mission.beacon_numbers(pings.beacon)]
        if isinstance(pings, OneWayRange):
            # Clocks may differ: what is common to all is not known.
            sigma = np.hypot(sigma, mission.options.clock_offset_sigma)
        parts.append((t, antenna, beacon, metres * measured, metres * sigma))
    if not parts:
        none = np.empty((0, 3))
        return TrackRanges(none[:, 0], none, none, none[:, 0], none[:, 0])
    t, antenna, beacon, distance, sigma = (
        np.concatenate(column) for column in zip(*parts, strict=True)
    )
    return TrackRanges(t, antenna, beacon, distance, sigma)


def _anchors(mission: Mission, model: SegmentModel) -> Anchors:
    """Start, fixes and compass readings."""
    segment = model.segment
    rows: list[tuple[float, list[float], list[float], float, float]] = []
    start = segment.start
    if start is not None:
        up = (0.0, UNKNOWN) if start.up is None else (start.up, start.sigma)
        heading = (0.0, UNKNOWN)
        if start.heading is not None:
            heading = (0.5 * np.pi - start.heading, start.heading_sigma)
        place = [start.east, start.north, up[0]]
        rows.append((start.t, place, [start.sigma, start.sigma, up[1]], *heading))
    if segment.position is not None:
        sigmas = np.sqrt(np.einsum("mii->mi", segment.position.covariances))
        flat = segment.position.dimension == 2
        for t, place, sigma in zip(
            segment.position.t, segment.position.position, sigmas, strict=True
        ):
            up = [0.0] if flat else []
            unknown = [UNKNOWN] if flat else []
            rows.append((t, [*place, *up], [*sigma, *unknown], 0.0, UNKNOWN))
    if segment.heading is not None and len(segment.heading):
        many = np.linspace(0, len(segment.heading) - 1, MOST_READINGS).astype(int)
        compass = segment.heading[np.unique(many)]
        given = mission.options.heading_bias_sigma_deg
        lasting = COMPASS_SIGMA if given is None else float(np.deg2rad(given))
        for t, heading, sigma in zip(compass.t, compass.heading, compass.sigma, strict=True):
            yaw_sigma = float(np.hypot(sigma, lasting))
            rows.append((t, [0.0] * 3, [UNKNOWN] * 3, 0.5 * np.pi - heading, yaw_sigma))
    attitude = segment.attitude
    if attitude is not None and len(attitude):
        many = np.unique(np.linspace(0, len(attitude) - 1, MOST_READINGS // 5).astype(int))
        for t, heading in zip(attitude.t[many], attitude.heading[many], strict=True):
            sigma = max(_heading_sigma(mission, model), LEAST_HEADING)
            rows.append((t, [0.0] * 3, [UNKNOWN] * 3, 0.5 * np.pi - heading, sigma))
    rows = [row for row in rows if model.t[0] <= row[0] <= model.t[-1]]
    if not rows:
        return Anchors.none()
    t, place, sigma, yaw, yaw_sigma = (np.array(column) for column in zip(*rows, strict=True))
    return Anchors(t, place, sigma, yaw, yaw_sigma)


def _track(model: SegmentModel, reckoned: Reckoned, start: PoseStart) -> Track:
    """Node states of an answer."""
    turn = start.yaw - _yaw(reckoned.rotation)
    rotation = lie.rotation(turn[:, None] * np.array([0.0, 0.0, 1.0])) @ reckoned.rotation
    velocity = np.gradient(start.position, model.t, axis=0)
    count = len(model.t)
    errors = {"odometry_scale": start.scale, "odometry_turn_bias": start.turn_bias}
    if model.segment.odometry is None:
        errors = {"dvl_scale": start.scale}
    return Track(
        start.position,
        velocity,
        np.zeros((count, 3)),
        np.full(count, start.range_scale),
        np.zeros(count),
        start.cost,
        rotation,
        errors,
    )


def _yaw(rotation: FloatArray) -> FloatArray:
    """Counter-clockwise from the first axis, (N,), rad."""
    return np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])


def _interpolated(nodes: FloatArray, values: FloatArray, t: FloatArray) -> FloatArray:
    return np.stack([np.interp(t, nodes, column) for column in values.T], axis=1)
