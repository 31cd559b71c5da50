"""Nodes of a window carried ahead by its motion prior."""

from __future__ import annotations

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.online.frame import Frame
from ubl_graph.online.pose_state import moved_on, poses_of, put_poses
from ubl_graph.trajectory import transition


def predicted(frame: Frame, node: FloatArray, dt: FloatArray) -> FloatArray:
    """A node's unknowns (W,) carried ahead by times `dt` (M,), s: (M, W)."""
    out = node @ np.swapaxes(transitions(frame, dt), 1, 2)
    if frame.is_posed:
        some = np.repeat(node[None], len(dt), axis=0)
        poses = poses_of(frame, some, np.zeros(len(dt)))
        put_poses(frame, out, moved_on(poses, dt), None)
    return out


def transitions(frame: Frame, dt: FloatArray) -> FloatArray:
    """Transition of a node's unknowns over times `dt` (M,), s: (M, W, W)."""
    n = frame.order
    out = np.broadcast_to(np.eye(frame.width), (len(dt), frame.width, frame.width)).copy()
    phi = transition(n, dt)
    for axis in range(0 if frame.is_posed else 3):
        own = axis + 3 * np.arange(n)
        out[:, own[:, None], own[None, :]] = phi
    slow = dict(frame.slow)
    if "clock_drift" in slow:
        layout = frame.layout(np.zeros(1))
        offset, drift = (
            int(layout.node_columns(name, np.zeros(1, dtype=np.int64))[0, 0])
            for name in ("clock_offset", "clock_drift")
        )
        out[:, offset, drift] = dt * layout.unit("clock_drift") / layout.unit("clock_offset")
    return out
