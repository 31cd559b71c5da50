"""What is derived once from a segment's records where nodes are poses, and where nodes stand."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial.transform import Rotation

from ubl_graph.arrays import FloatArray
from ubl_graph.attitude import AttitudeTrack
from ubl_graph.builder import SegmentModel
from ubl_graph.factors.gyro import GyroTrack
from ubl_graph.factors.odometry import Preintegration
from ubl_graph.measurements import Attitude, Odometry
from ubl_graph.mission import Segment
from ubl_graph.nodes import LEAST_SHARE, SAME_INSTANT, filled, grid_times, node_times
from ubl_graph.odometry_noise import node_of
from ubl_graph.options import Options
from ubl_graph.pings import leg_times
from ubl_graph.trajectory import longest_interval

#: A gap of attitude records that most vehicles turn in, s.
LONG_GAP = 60.0
#: Between nodes the interpolated heading is off by no more than this share of a reading's noise.
COMPASS_SHARE = 0.3


def model_poses(segment: Segment, options: Options) -> SegmentModel:
    """Nodes, attitude, gyro and preintegrated velocities of a segment with pose nodes.

    Where odometry records join all that was measured, nodes stand at their ends and need no
    velocities; else where those of points would, and at the ends of odometry records.
    """
    gyro = None
    if segment.angular_rate is not None and len(segment.angular_rate) > 1:
        gyro = GyroTrack(segment.angular_rate)
    attitude, heads = _attitude(segment, gyro)
    ways = _ways(segment, attitude, options)
    by_gyro: dict[str, Preintegration] = {}
    if gyro is not None:
        by_gyro = _ways(segment, AttitudeTrack.of(gyro.t, gyro.rotations), options)
    joined = _joined(segment)
    if joined is not None:
        times, still = joined, True
    else:
        times, still = _moving_times(segment, options, tuple(ways.values())), False
    return SegmentModel(
        segment,
        times,
        attitude,
        ways.get("bottom"),
        ways.get("water"),
        gyro,
        by_gyro.get("bottom"),
        by_gyro.get("water"),
        _turn_sigma(segment, gyro),
        heads,
        still,
    )


def _turn_sigma(segment: Segment, gyro: GyroTrack | None) -> float:
    """White noise of the attitude that a compass alone gives, rad."""
    compass = segment.heading
    if segment.attitude is not None or gyro is not None or compass is None or not len(compass):
        return 0.0
    return float(np.median(compass.sigma))


def _attitude(segment: Segment, gyro: GyroTrack | None) -> tuple[AttitudeTrack, bool]:
    """Attitude as the references know it, and whether the heading is known, not only turns.

    Gyros without an attitude reference begin level, and are turned to what the compass reads.
    """
    records = segment.attitude if segment.attitude is not None and len(segment.attitude) else None
    if records is not None and (gyro is None or _spans(records, segment)):
        return AttitudeTrack(records), len(records) > 1
    compass = segment.heading if segment.heading is not None and len(segment.heading) else None
    if gyro is None:
        if compass is None:
            return AttitudeTrack(None), False
        return AttitudeTrack(Attitude(compass.t, compass.heading)), True
    track = AttitudeTrack.of(gyro.t, gyro.rotations)
    if records is not None:
        # A few records say how the gyro's axes lie in the world, and it goes on from there.
        read = Rotation.from_matrix(AttitudeTrack(records).at(records.t))
        begins = (read * Rotation.from_matrix(track.at(records.t)).inv()).mean()
        return AttitudeTrack.of(gyro.t, begins * gyro.rotations), True
    if compass is None:
        return track, False
    bow = track.at(compass.t)[:, :, 0]
    off = 0.5 * np.pi - compass.heading - np.arctan2(bow[:, 1], bow[:, 0])
    turn = float(np.angle(np.exp(1j * off).mean()))
    return AttitudeTrack.of(gyro.t, Rotation.from_rotvec([0.0, 0.0, turn]) * gyro.rotations), True


def _spans(records: Attitude, segment: Segment) -> bool:
    """Whether attitude records reach over most of what was measured, without long gaps."""
    times = _measured(segment)
    middle = np.linspace(times.min(), times.max(), 101)
    return bool(AttitudeTrack(records).covers(middle[:-1], middle[1:], LONG_GAP).mean() > 0.9)


def _ways(segment: Segment, attitude: AttitudeTrack, options: Options) -> dict[str, Preintegration]:
    """Velocities integrated along an attitude, by what they are relative to."""
    out: dict[str, Preintegration] = {}
    if segment.velocity is not None:
        for reference in ("bottom", "water"):
            rows = segment.velocity[segment.velocity.reference == reference]
            if len(rows) > 1:
                out[reference] = Preintegration(rows, attitude, options.number("acceleration_psd"))
    return out


def _joined(segment: Segment) -> FloatArray | None:
    """Ends of odometry records where these join all that was measured; None where they do not."""
    records = segment.odometry
    if records is None or not len(records) or segment.velocity is not None:
        return None
    ends = ends_of(records)
    order = np.argsort(records.t_from, kind="stable")
    reached = np.maximum.accumulate(records.t_to[order])
    if (records.t_from[order][1:] > reached[:-1] + SAME_INSTANT).any():
        return None
    times = _measured(segment)
    if times.min() < ends[0] - 1e-9 or times.max() > ends[-1] + 1e-9:
        return None
    pairs = (node_of(ends, records.t_from), node_of(ends, records.t_to))
    size = len(ends)
    links = sparse.coo_array((np.ones(len(records)), pairs), shape=(size, size))
    chains, _ = csgraph.connected_components(links, directed=False)
    return ends if chains == 1 else None


def ends_of(records: Odometry) -> FloatArray:
    """Times at which odometry records begin or end, s; ones of the same instant are one."""
    times = np.unique(np.concatenate([records.t_from, records.t_to]))
    return times[np.concatenate([[True], np.diff(times) > SAME_INSTANT])]


def _measured(segment: Segment) -> FloatArray:
    """Times of all that speaks of places, s."""
    kinds = (segment.two_way_range, segment.one_way_range, segment.slant_range)
    parts = [leg_times(pings).ravel() for pings in kinds if pings is not None]
    if segment.position is not None:
        parts.append(segment.position.t)
    if segment.start is not None:
        parts.append(np.array([segment.start.t]))
    return np.concatenate(parts)


def _moving_times(
    segment: Segment, options: Options, velocities: tuple[Preintegration, ...]
) -> FloatArray:
    """Times of nodes that have velocities, s."""
    regular = options.node_spacing is not None
    if options.node_spacing is not None:
        times = grid_times(segment, options.node_spacing, velocities)
    else:
        times = node_times(segment, options, velocities)
    compass = segment.heading
    if compass is not None and len(compass) and not regular:
        # Between nodes the heading is what the motion prior thinks; it must know about as much. But
        # nodes closer than the readings are of no use: what a reading then lacks widens its sigma.
        error = COMPASS_SHARE * float(np.median(compass.sigma))
        longest = longest_interval(2, options.angular_acceleration_psd, error)
        apart: FloatArray = np.diff(np.sort(compass.t))
        times = filled(times, max(longest, float(np.median(apart)) if len(apart) else np.inf))
    if segment.odometry is None or not len(segment.odometry):
        return times
    ends = ends_of(segment.odometry)
    # A node too near to one that must be there only spoils the equations.
    after = np.searchsorted(ends, times).clip(1, max(len(ends) - 1, 1))
    gap = np.minimum(np.abs(ends[after] - times), np.abs(ends[after - 1] - times))
    least = LEAST_SHARE[2] * float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    return np.union1d(times[gap > least], ends)
