"""Finding a position where none is known: the smoother over what the buffer holds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.errors import UblGraphError
from ubl_graph.hypotheses import ANOTHER
from ubl_graph.layout import KINEMATIC
from ubl_graph.measurements import PositionFix
from ubl_graph.mission import Mission, Segment, Setup, Start
from ubl_graph.nodes import grid, slot_of
from ubl_graph.online.buffer import PINGS, Buffer, Entry, columns_of, fixes_of, odometry_of
from ubl_graph.online.grid_odometry import on_grid
from ubl_graph.online.pose_search import put_track
from ubl_graph.online.pose_state import poses_of, put_poses
from ubl_graph.online.window import Window
from ubl_graph.pose_trajectory import PoseTrajectory
from ubl_graph.result import Result
from ubl_graph.smoother import smooth

#: No vehicle of ours, towed or under a ship, is faster, m/s.
FASTEST = 15.0


@dataclass(frozen=True, eq=False)
class Found:
    """What a search says.

    Attributes
    ----------
    result : Result or None
        Of the smoother; None where it could not run.
    reason : str
        Why the position is not known, or not unique; empty where it is.
    ambiguous : bool
        Whether another track fits as well.
    """

    result: Result | None
    reason: str = ""
    ambiguous: bool = False

    @property
    def usable(self) -> bool:
        """Whether there is a position to go on with."""
        return self.result is not None and (self.ambiguous or not self.reason)

    @property
    def is_open(self) -> bool:
        """Whether the tracks that fit are no several places: it can be turned about a beacon."""
        return self.ambiguous and not self.reason.startswith(ANOTHER)

    def track(self, number: int) -> Found:
        """The same with another one of the hypotheses in place of the best."""
        assert self.result is not None
        segment = self.result.segments[0]
        other = segment.hypotheses[number].trajectory
        segments = (replace(segment, trajectory=other), *self.result.segments[1:])
        return replace(self, result=replace(self.result, segments=segments))

    @property
    def rival(self) -> FloatArray | None:
        """How far away the other track ends, east, north, up, m; None where it is not one place."""
        if self.result is None or len(self.result.segments[0].hypotheses) < 2:
            return None
        answer, other = self.result.segments[0].hypotheses[:2]
        return other.trajectory.position[-1] - answer.trajectory.position[-1]

    @property
    def rival_weight(self) -> float:
        """Weight of the other track among those that were found; 0 where there is none."""
        if self.result is None or len(self.result.segments[0].hypotheses) < 2:
            return 0.0
        return self.result.segments[0].hypotheses[1].weight


def search(
    setup: Setup, buffer: Buffer, spacing: float, begin: float, start: Start | None = None
) -> Found:
    """Look for the position in all that the buffer holds, gated pings too.

    Parameters
    ----------
    setup : Setup
        Beacons, sound speed, vehicle, options.
    buffer : Buffer
        The records.
    spacing : float
        Of the nodes, s.
    begin : float
        Records from before this are not looked at (but for the attitude that held then), s.
    start : Start, optional
        What is known of the position beforehand.
    """
    segment = _segment(setup, buffer, begin, start)
    options = replace(setup.options, node_spacing=spacing, solver="banded")
    if setup.options.node != "point":
        segment = _posed(segment, setup, buffer, spacing, begin)
        # What was laid onto the grid holds the options' noise already.
        options = replace(options, odometry_noise="given")
    try:
        mission = Mission((segment,), setup.beacons, setup.sound_speed, setup.vehicle, options)
        with np.errstate(over="ignore", invalid="ignore"):
            result = smooth(mission)
    except UblGraphError as error:
        return Found(None, f"no position yet: {error}")
    found = result.segments[0]
    speed = float(np.median(np.linalg.norm(found.trajectory.velocity[:, :2], axis=1)))
    if speed > FASTEST:
        return Found(None, f"no position yet: the ranges ask for {speed:.0f} m/s")
    if found.status == "converged":
        return Found(result)
    return Found(result, found.reason, found.reason.startswith("ambiguous"))


def _segment(setup: Setup, buffer: Buffer, begin: float, start: Start | None) -> Segment:
    """The buffer as a segment; what cannot be used without an attitude is left out."""
    parts: dict[str, object] = {}
    for kind in (*PINGS, "velocity", "attitude", "depth"):
        some = [
            e
            for e in buffer.of(kind)
            if (kind in PINGS or not e.gated) and (kind == "attitude" or e.begin >= begin - 1e-9)
        ]
        if some:
            parts[kind] = columns_of(kind, some)
    vehicle = setup.vehicle
    if "attitude" not in parts and setup.options.node == "point":
        parts.pop("velocity", None)
        if not vehicle.depth_sensor.is_zero:
            parts.pop("depth", None)
    marks = [e.record for e in buffer.of("set_position") if not e.gated and e.t >= begin]
    if start is None and marks and isinstance(marks[-1], Start):
        start = marks[-1]
    fixes = _horizontal([e for e in buffer.of("position") if not e.gated and e.t >= begin])
    bare = setup.options.node != "point" or vehicle.antenna.is_zero
    if fixes is not None and ("attitude" in parts or bare):
        parts["position"] = fixes
    return Segment(start=start, **parts)  # pyright: ignore[reportArgumentType]


def _posed(segment: Segment, setup: Setup, buffer: Buffer, spacing: float, begin: float) -> Segment:
    """A segment with what only poses can use; odometry is laid onto the grid of nodes."""
    heading, rates = (
        [e for e in buffer.of(kind) if not e.gated and e.t >= begin - 1e-9]
        for kind in ("heading", "angular_rate")
    )
    steps = [e for e in buffer.of("odometry") if not e.gated and e.begin >= begin - 1e-9]
    odometry = None
    if steps:
        first = slot_of(steps[0].begin, spacing)
        times = grid(first, slot_of(steps[-1].t, spacing) + 2 - first, spacing)
        odometry = on_grid(odometry_of(steps), times, setup.options)
    return replace(
        segment,
        heading=columns_of("heading", heading) if heading else None,
        angular_rate=columns_of("angular_rate", rates) if rates else None,
        odometry=odometry,
    )


def _horizontal(entries: list[Entry]) -> PositionFix | None:
    """All fixes as one batch: full ones where all are, else the horizontal part of each."""
    fixes = fixes_of(entries)
    if len(fixes) < 2:
        return fixes[0] if fixes else None
    return PositionFix.unchecked(
        t=np.concatenate([f.t for f in fixes]),
        east=np.concatenate([f.east for f in fixes]),
        north=np.concatenate([f.north for f in fixes]),
        covariance=np.concatenate([f.covariances[:, :2, :2] for f in fixes]),
    )


def placed(window: Window, found: Found, first_node: int | None = None) -> FloatArray:
    """The found track on the window's nodes, as a flat vector; beyond its ends it is carried on.

    Parameters
    ----------
    window : Window
        Whose nodes.
    found : Found
        Usable.
    first_node : int, optional
        Nodes before this number stay where they are.
    """
    assert found.result is not None
    segment = found.result.segments[0]
    track = segment.trajectory
    layout, frame = window.layout, window.frame
    vector = window.vector
    nodes = vector[: window.count * frame.width].reshape(window.count, -1)
    if isinstance(track, PoseTrajectory):
        # Nodes that odometry joins stand where its records end.
        at = np.abs(track.t[None] - window.times[:, None]).argmin(axis=1)
        beyond = put_track(window, nodes, track)
    else:
        first = round(float(track.t[0]) / frame.spacing) - window.first
        at = np.clip(np.arange(window.count) - first, 0, len(track.t) - 1)
        states = {"position": track.position, "velocity": track.velocity}
        if track.acceleration is not None:
            states["acceleration"] = track.acceleration
        for name in KINEMATIC[: frame.order]:
            layout.put(vector, name, states[name][at])
        beyond = (np.arange(window.count, dtype=np.float64) - first - at) * frame.spacing
    for name, slow in segment.slow.items():
        if layout.has(name):
            layout.put(vector, name, slow.value[at])
    known = {**found.result.shared, **{f"beacon {n}": b for n, b in found.result.beacons.items()}}
    for name, shared in known.items():
        if layout.has(name):
            layout.put(vector, name, shared.value)
    for k in np.flatnonzero(beyond):
        nodes[k] = window.predicted(nodes[k], beyond[k : k + 1])[0]
    if frame.is_posed:
        put_poses(frame, nodes, poses_of(frame, nodes, window.up), window.x)
    if first_node is not None:
        nodes[: first_node - window.first] = window.x[: first_node - window.first]
    return vector
