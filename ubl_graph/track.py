"""A track at a segment's nodes as a solver's start: to and from the flat vector, and mirrored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from ubl_graph import lie
from ubl_graph.arrays import FloatArray
from ubl_graph.builder import SegmentModel
from ubl_graph.factors.poses import PoseNodes
from ubl_graph.layout import Chain, Layout
from ubl_graph.mission import Mission, Segment
from ubl_graph.trajectory import Trajectory

#: A track moved by less is the same one, m.
LEAST_MOVE = 1.0
#: Standard deviations of a known point that rule out a track: a cost of 50, odds of 1e21.
RULED_OUT = 10.0
#: Beacons that spread across a line by no more than this share of what they spread along it are in
#: line: what tells their two sides apart is small, and for the solver to judge.
IN_LINE = 0.1
#: Two courses are one where the sine of the angle between them is no larger than this.
ALONG = 0.05
#: Crossings of the line through the beacons that are looked at, at most.
MOST_FOLDS = 8


@dataclass(frozen=True, eq=False)
class Track:
    """A start for one segment.

    Attributes
    ----------
    position, velocity, acceleration : array, shape (N, 3)
        At the nodes; m, m/s, m/s^2.
    scale, clock : array, shape (N,)
        Log scale of the travel times, clock offset (s).
    cost : float
        Of the way through the windows.
    rotation : array, shape (N, 3, 3), optional
        `world_R_body` at the nodes; poses have one.
    errors : dict of str to float
        Of the odometry, as far as the search found them; states by the name of what is shared.
    """

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    scale: FloatArray
    clock: FloatArray
    cost: float
    rotation: FloatArray | None = None
    errors: dict[str, float] = field(default_factory=dict[str, float])


def place(layout: Layout, chain: Chain, track: Track, x: FloatArray) -> None:
    """Write a track into the flat vector `x`, in place."""
    nodes = chain.first + np.arange(len(chain.t))
    values: dict[str, FloatArray] = {
        "position": track.position,
        "velocity": track.velocity,
        "acceleration": track.acceleration,
        "sound_speed": track.scale[:, None],
        "clock_offset": track.clock[:, None],
    }
    if layout.node != "point":
        values |= _pose_values(layout, chain, track)
    for name, value in values.items():
        if layout.has(name):
            x[layout.node_columns(name, nodes)] = value / layout.unit(name)


def _pose_values(layout: Layout, chain: Chain, track: Track) -> dict[str, FloatArray]:
    """What pose nodes hold of a track: places, rotations, and velocities in the body's axes."""
    rotation = track.rotation
    if rotation is None:
        rotation = along_course(track.velocity)
    vector = lie.rotation_vector(rotation)
    velocity = np.einsum("nji,nj->ni", rotation, track.velocity)
    rate = np.zeros_like(velocity)
    if len(chain.t) > 1:
        turns = lie.rotation_vector(np.swapaxes(rotation[:-1], 1, 2) @ rotation[1:])
        rate[:-1] = turns / np.diff(chain.t)[:, None]
        rate[-1] = rate[-2]
    if layout.node == "pose2":
        return {
            "position": track.position[:, :2],
            "rotation": np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])[:, None],
            "velocity": velocity[:, :2],
            "rate": rate[:, 2:],
        }
    return {"rotation": vector, "velocity": velocity, "rate": rate}


def along_course(velocity: FloatArray) -> FloatArray:
    """Level rotations with the bow along the course of velocities (N, 3); east where there is none.

    Returns
    -------
    array, shape (N, 3, 3)
    """
    yaw = np.arctan2(velocity[:, 1], velocity[:, 0])
    return lie.rotation(yaw[:, None] * np.array([0.0, 0.0, 1.0]))


def track_of(layout: Layout, chain: Chain, x: FloatArray) -> Track:
    """Read a track back from the flat vector `x`: the inverse of `place`."""

    def read(name: str, width: int) -> FloatArray:
        if layout.has(name):
            return layout.get(x, name)[chain.nodes]
        return np.zeros((len(chain.t), width))

    rotation = None
    velocity = read("velocity", 3)
    if layout.node != "point":
        nodes = PoseNodes(layout, chain.first + np.arange(len(chain.t))).at(x)
        rotation = nodes.rotation
        velocity = np.einsum("nij,nj->ni", rotation, nodes.twist[:, :3])
    return Track(
        layout.positions(x)[chain.nodes],
        velocity,
        read("acceleration", 3),
        read("sound_speed", 1)[:, 0],
        read("clock_offset", 1)[:, 0],
        0.0,
        rotation,
    )


def start_vector(mission: Mission, layout: Layout, tracks: Sequence[Track]) -> FloatArray:
    """The flat vector that a solver starts at: the tracks, beacons where they are, else zero."""
    x = np.zeros(layout.size)
    for chain, track in zip(layout.chains, tracks, strict=True):
        place(layout, chain, track, x)
        for name, value in track.errors.items():
            if name in dict(layout.shared):
                layout.put(x, name, np.array([value]))
    for beacon in mission.beacons:
        if layout.has(f"beacon {beacon.name}"):
            layout.put(x, f"beacon {beacon.name}", beacon.position)
    return x


def carried(old: Layout, x: FloatArray, new: Layout) -> FloatArray:
    """An estimate in another layout of the same segments, whose nodes may stand elsewhere.

    What travels with the nodes is interpolated, what all of them share stays.
    """
    out = np.zeros(new.size)
    for before, after in zip(old.chains, new.chains, strict=True):
        track = track_of(old, before, x)
        if not np.array_equal(before.t, after.t):
            track = _resampled(track, before.t, after.t)
        place(new, after, track, out)
    for name, _ in new.shared:
        out[new.shared_columns(name)] = x[old.shared_columns(name)]
    return out


def _resampled(track: Track, old: FloatArray, new: FloatArray) -> Track:
    """A track at other times of its span."""
    none = np.zeros((len(old), 3, 3))
    acceleration = track.acceleration if track.acceleration.any() else None
    path = Trajectory(old, track.position, track.velocity, acceleration, none, (0.0, 0.0))
    states = path.at(new)
    return replace(
        track,
        position=states.position,
        velocity=states.velocity,
        acceleration=np.stack([np.interp(new, old, a) for a in track.acceleration.T], axis=1),
        scale=np.interp(new, old, track.scale),
        clock=np.interp(new, old, track.clock),
        rotation=None if track.rotation is None else _turned_over(track.rotation, old, new),
    )


def _turned_over(rotation: FloatArray, old: FloatArray, new: FloatArray) -> FloatArray:
    """Rotations at other times."""
    if len(old) == 1:
        return np.repeat(rotation, len(new), axis=0)
    return Slerp(old, Rotation.from_matrix(rotation))(np.clip(new, old[0], old[-1])).as_matrix()


def mirror_images(mission: Mission, model: SegmentModel, track: Track) -> list[Track]:
    """Tracks that the ranges to a single beacon, or to beacons in line, cannot tell from this one.

    Without odometry they fit as well, but for what is known of points, when reflected in a vertical
    plane: the one through all beacons, or through a single one along the mean course, or through
    the start where a prior holds that. Odometry knows the heading, but not on which side of the
    beacons a straight track went by: there the track is moved across to the other side. Windows
    find such images too, but on a valley of answers only by luck.

    Parameters
    ----------
    mission, model
        Whose ranges.
    track : Track
        To reflect.

    Returns
    -------
    list of Track
        Empty where beacons stand all around, or where there are none.
    """
    segment, beacons = model.segment, _in_line(mission, model)
    if beacons is None:
        return []
    point = beacons.mean(axis=0)
    axes = _mirrors(model, track, beacons)
    if _has_odometry(model):
        images = [_beyond(track, point, axis) for axis in axes]
        return [image for image in images if _is_conceivable(segment, track, image)]
    images = [_reflected(track, point, axis) for axis in axes]
    if len(beacons) > 1:
        images += [f for image in images for f in _folded(track, image, point, axes[0])]
    return images


def _folded(track: Track, image: Track, point: FloatArray, axis: FloatArray) -> list[Track]:
    """A track that turns into its image where it comes to the mirror, once for each such place.

    Where it crosses the line through the beacons the ranges would be the same had it turned back.
    """
    side = (track.position[:, :2] - point) @ np.array([-axis[1], axis[0]])
    crossings = np.flatnonzero(np.diff(np.sign(side)) != 0) + 1
    if len(crossings) > MOST_FOLDS:
        crossings = crossings[np.linspace(0, len(crossings) - 1, MOST_FOLDS).astype(int)]
    folded: list[Track] = []
    for k in crossings:
        parts: dict[str, FloatArray] = {}
        for name in ("position", "velocity", "acceleration", "rotation"):
            here, there = getattr(track, name), getattr(image, name)
            if here is not None:
                parts[name] = np.concatenate([here[:k], there[k:]])
        folded.append(replace(track, **parts))
    return folded


def _mirrors(model: SegmentModel, track: Track, beacons: FloatArray) -> list[FloatArray]:
    """Lines through beacons in line (B, 2) to mirror a track in: directions (2,)."""
    if len(beacons) > 1:
        return [_principal(beacons - beacons.mean(axis=0))]
    way = track.position[-1, :2] - track.position[0, :2]
    axes = [way] if np.linalg.norm(way) > LEAST_MOVE else []
    if _has_odometry(model):
        # There and back again, the way as a whole says nothing of the course.
        steps = np.diff(track.position[:, :2], axis=0)
        course = _principal(steps) if len(steps) else np.zeros(2)
        if not axes or abs(course[0] * way[1] - course[1] * way[0]) > ALONG * np.linalg.norm(way):
            axes.append(course)
    elif model.segment.start is not None:
        start = np.array([model.segment.start.east, model.segment.start.north])
        axes.append(start - beacons[0])
    return [axis for axis in axes if axis.any()]


def unanchored(model: SegmentModel) -> str | None:
    """Why a segment's track cannot be unique, whatever its covariance says; None where it can.

    Ranges to one beacon stay the same when the whole track is turned about it or mirrored. Without
    odometry, which knows the heading, one known point still leaves the mirror image; two do not.
    """
    segment = model.segment
    steps = segment.odometry is not None and len(segment.odometry) > 0
    if _lone_beacon(model) is None or _has_odometry(model) or (steps and model.heads):
        return None
    fixes = 0 if segment.position is None else len(segment.position)
    anchors = fixes + (segment.start is not None)
    if steps or (model.gyro is not None and (model.bottom or model.water)):
        # It knows its own turns: nothing can be mirrored, and any known point will do.
        if anchors:
            return None
        return (
            "ambiguous: one beacon was heard and nothing tells the heading, so the whole track can "
            "be turned about the beacon without changing a range; a start, a compass, a fix or a "
            "second beacon would tell"
        )
    if anchors >= 2:
        return None
    turned = "be turned about the beacon"
    mirrored = "be mirrored in the line through the beacon and the known point"
    how = mirrored if anchors else turned
    return (
        f"ambiguous: one beacon was heard and there is no odometry, so the whole track can {how} "
        "without changing a range; velocities and heading, a second beacon or two fixes would tell"
    )


def _lone_beacon(model: SegmentModel) -> str | None:
    """Name of the only beacon heard, None where there are others or none."""
    heard = _heard(model)
    return heard.pop() if len(heard) == 1 else None


def _heard(model: SegmentModel) -> set[str]:
    """Names of the beacons heard."""
    segment = model.segment
    kinds = (segment.two_way_range, segment.one_way_range, segment.slant_range)
    return {str(name) for r in kinds if r is not None for name in r.beacon}


def _in_line(mission: Mission, model: SegmentModel) -> FloatArray | None:
    """East and north (B, 2) of the beacons heard; None where they do not stand in a line."""
    heard = _heard(model)
    places = np.array([b.position[:2] for b in mission.beacons if b.name in heard])
    if not len(places):
        return None
    middle = places.mean(axis=0)
    if np.abs(places - middle).max() < LEAST_MOVE:
        return middle[None]
    spread = np.linalg.svd(places - middle, compute_uv=False)
    return places if spread[1] <= IN_LINE * spread[0] else None


def _principal(vectors: FloatArray) -> FloatArray:
    """Unit vector (2,) along which most of some vectors (M, 2) lie."""
    return np.linalg.svd(vectors, full_matrices=False)[2][0]


def _has_odometry(model: SegmentModel) -> bool:
    return model.heads and (model.bottom is not None or model.water is not None)


def _is_conceivable(segment: Segment, track: Track, image: Track) -> bool:
    """Whether a moved track is another one, and no known point alone rules it out."""
    moved = float(np.linalg.norm(image.position[0] - track.position[0]))
    known = [np.inf]
    if segment.start is not None:
        known.append(segment.start.sigma)
    if segment.position is not None and len(segment.position):
        known.append(float(np.sqrt(segment.position.covariances[:, 0, 0].min())))
    return LEAST_MOVE < moved < RULED_OUT * min(known)


def _beyond(track: Track, point: FloatArray, axis: FloatArray) -> Track:
    """Move a track across its course (east, north) to the other side of a point."""
    across = np.array([-axis[1], axis[0]]) / np.linalg.norm(axis)
    position = track.position.copy()
    position[:, :2] -= 2.0 * float(((position[:, :2] - point) @ across).mean()) * across
    return replace(track, position=position)


def _reflected(track: Track, point: FloatArray, axis: FloatArray) -> Track:
    """Reflect a track in the vertical plane through a point along an axis (east, north)."""
    unit = axis / np.linalg.norm(axis)
    mirror = np.eye(3)
    mirror[:2, :2] = 2.0 * np.outer(unit, unit) - np.eye(2)
    centre = np.array([*point, 0.0])
    rotation = track.rotation
    if rotation is not None:
        # The bow is mirrored; the vehicle cannot be.
        bow = rotation[:, :, 0]
        after = bow @ mirror
        turn = np.arctan2(after[:, 1], after[:, 0]) - np.arctan2(bow[:, 1], bow[:, 0])
        rotation = lie.rotation(turn[:, None] * np.array([0.0, 0.0, 1.0])) @ rotation
    return replace(
        track,
        rotation=rotation,
        position=(track.position - centre) @ mirror + centre,
        velocity=track.velocity @ mirror,
        acceleration=track.acceleration @ mirror,
    )
