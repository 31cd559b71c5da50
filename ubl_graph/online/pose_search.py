"""Tracks of poses on a window: one that was found, or one made of fixes and a reference."""

from __future__ import annotations

import numpy as np

from ubl_graph import lie
from ubl_graph.arrays import FloatArray
from ubl_graph.attitude import AttitudeTrack
from ubl_graph.measurements import Attitude
from ubl_graph.mission import Start
from ubl_graph.online.buffer import Buffer, columns_of
from ubl_graph.online.pose_state import put_poses
from ubl_graph.online.window import Window
from ubl_graph.pose_path import Poses
from ubl_graph.pose_trajectory import PoseTrajectory

#: Kinds of records that move in the body's axes: without a heading they say not where to.
BODILY = ("velocity", "odometry")
#: Kinds that know the heading.
HEADED = ("attitude", "heading")


def put_track(window: Window, nodes: FloatArray, track: PoseTrajectory) -> FloatArray:
    """Put a found track into nodes (N, W) of a window; how far beyond its ends each is, (N,), s."""
    times = window.times
    inside = np.clip(times, track.t[0], track.t[-1])
    states = track.at(inside)
    body = np.einsum("nji,nj->ni", states.rotation, states.velocity)
    rate = np.stack([np.interp(inside, track.t, axis) for axis in track.rate.T], axis=1)
    put_poses(window.frame, nodes, _poses(states.position, states.rotation, body, rate), None)
    return times - inside


def is_headed(buffer: Buffer) -> bool:
    """Whether anything in the buffer tells the heading, or nothing there asks for it."""
    if any(buffer.of(kind) for kind in HEADED) or _set_headings(buffer):
        return True
    return not any(buffer.of(kind) for kind in BODILY)


def seeded(window: Window, buffer: Buffer) -> FloatArray:
    """A window's flat vector where fixes and heading reference say that the vehicle is."""
    vector, times = window.vector, window.times
    nodes = vector[: window.count * window.frame.width].reshape(window.count, -1)
    rotation = _reference(buffer).at(times)
    marks = sorted([*buffer.of("position"), *buffer.of("set_position")], key=lambda e: e.t)
    places = np.zeros((len(marks), 3))
    for i, entry in enumerate(marks):
        start = entry.record
        if isinstance(start, Start):
            places[i] = start.east, start.north, start.up or 0.0
        else:
            place = entry.values[1][0]
            places[i, : len(place)] = place
    t = np.array([e.t for e in marks])
    position = np.stack([np.interp(times, t, axis) for axis in places.T], axis=1)
    velocity = np.gradient(position, times, axis=0)
    body = np.einsum("nji,nj->ni", rotation, velocity)
    rate = np.zeros_like(body)
    turns = lie.rotation_vector(np.swapaxes(rotation[:-1], 1, 2) @ rotation[1:])
    rate[:-1] = turns / window.frame.spacing
    put_poses(window.frame, nodes, _poses(position, rotation, body, rate), window.x)
    return vector


def _reference(buffer: Buffer) -> AttitudeTrack:
    """Attitude as reference, compass or who set a heading say it."""
    if buffer.of("attitude"):
        return AttitudeTrack(columns_of("attitude", buffer.of("attitude")))
    if buffer.of("heading"):
        rows = columns_of("heading", buffer.of("heading"))
        return AttitudeTrack(Attitude(rows.t, rows.heading))
    headings = _set_headings(buffer)
    if headings:
        return AttitudeTrack(Attitude(0.0, headings[-1]))
    return AttitudeTrack(None)


def _set_headings(buffer: Buffer) -> list[float]:
    starts = [e.record for e in buffer.of("set_position")]
    return [s.heading for s in starts if isinstance(s, Start) and s.heading is not None]


def _poses(position: FloatArray, rotation: FloatArray, body: FloatArray, rate: FloatArray) -> Poses:
    slope = lie.rotation_slope(lie.rotation_vector(rotation))
    return Poses(position, rotation, slope, np.concatenate([body, rate], axis=1))
