"""A PyFG file as a mission of one vehicle: landmarks become beacons, edges become records.

The file's axes are kept: the world's x, y, z are taken as east, north, up, and the body's as
forward, left, up, whatever the vehicle's bow is called there. What the poses' vertices hold serves
nothing: a file does not say whether it is a guess, composed odometry or the truth.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.beacon import Beacon
from ubl_graph.errors import DataError
from ubl_graph.io.pyfg_graph import PyfgGraph
from ubl_graph.io.pyfg_records import Track
from ubl_graph.options import Node
from ubl_graph.segment import Segment, Start

#: Options of a pyfg mission where the user gives none: no compass, so none that reads too far;
#: ranges in metres, whose scale is right; and edges whose covariance is most often a constant, one
#: that does not know how far the vehicle went.
PYFG_OPTIONS: dict[str, Any] = {
    "heading_bias_sigma_deg": 0.0,
    "estimate_sound_speed": False,
    "odometry_noise": "both",
}
#: Standard deviation of a planar file's beacons in height where beacons are estimated, m: held.
PLANAR_SIGMA = 1e-3
_REMEDY = "take such lines out"


def pyfg_node(graph: PyfgGraph) -> Node:
    """Kind of node that the vertices ask for: "pose2" or "pose3"."""
    return "pose2" if graph.dimension == 2 else "pose3"


def pyfg_beacons(graph: PyfgGraph, estimate: bool) -> tuple[Beacon, ...]:
    """Landmarks as beacons, in the order of the file.

    Parameters
    ----------
    graph : PyfgGraph
    estimate : bool
        Whether beacons will be estimated. Then a prior's mean and standard deviations are those of
        the beacon; else the vertices' positions are held and priors have nothing to say.

    Returns
    -------
    tuple of Beacon
        A planar file's beacons are at up 0.

    Raises
    ------
    DataError
        Where beacons are estimated, and a landmark has two priors or one whose axes are correlated.
    """
    priors = _landmark_priors(graph) if estimate else {}
    planar = graph.dimension == 2
    beacons: list[Beacon] = []
    for i, name in enumerate(graph.landmarks.first):
        position, sigma = priors.get(name, (graph.landmarks.position[i], np.zeros(graph.dimension)))
        if planar:
            position = np.append(position, 0.0)
            sigma = np.append(sigma, PLANAR_SIGMA if estimate else 0.0)
        beacons.append(Beacon(name, position, sigma))
    return tuple(beacons)


def _landmark_priors(graph: PyfgGraph) -> dict[str, tuple[FloatArray, FloatArray]]:
    rows = graph.landmark_priors
    found: dict[str, tuple[FloatArray, FloatArray]] = {}
    for i, name in enumerate(rows.first):
        if name in found:
            raise graph.error(
                "landmark_priors", i, f"a second prior on '{name}'", "a beacon takes one"
            )
        variances = np.diagonal(rows.covariance[i])
        if np.count_nonzero(rows.covariance[i]) > graph.dimension:
            raise graph.error(
                "landmark_priors",
                i,
                "the axes are correlated",
                "a beacon takes one sigma an axis: set the covariances to 0",
            )
        found[name] = rows.position[i], np.sqrt(variances)
    return found


def pyfg_segments(graph: PyfgGraph, start: Start | None = None) -> tuple[Segment, ...]:
    """Edges, ranges and priors as records, a segment for each run of poses that edges join.

    Parameters
    ----------
    graph : PyfgGraph
        Of one vehicle. Poses stand along its track.
    start : Start, optional
        At the time of one of the poses; goes to the segment that holds it.

    Returns
    -------
    tuple of Segment
        In the order of the file, each named after its first pose; a single one has no name. Times
        are the poses' stamps, or the poses' numbers in the file from 0 where all stamps are zero.

    Raises
    ------
    DataError
        Where the file holds what a mission of one vehicle cannot take (several robots, ranges
        between poses or between landmarks, landmarks seen from poses), its stamps do not increase,
        an edge joins two runs, nothing says where a run is, or position and heading of a prior are
        correlated.
    ConfigurationError
        Where no pose is at the time of the start.
    """
    _check_one_vehicle(graph)
    track = Track(graph, _times(graph))
    started = None if start is None else track.pose_at(start.t)
    segments: list[Segment] = []
    for run in range(int(track.run[-1]) + 1):
        first, size = int(np.argmax(track.run == run)), int((track.run == run).sum())
        segment = Segment(
            name=graph.poses.first[first] if track.run[-1] else "",
            odometry=track.odometry(run),
            slant_range=track.slant_range(run),
            position=track.position(run),
            heading=track.heading(run),
        )
        if segment.slant_range is None and segment.position is None:
            raise _unlocated(graph, first, size)
        if start is not None and started is not None and track.run[started] == run:
            segment = replace(segment, start=replace(start, t=float(track.t[started])))
        segments.append(segment)
    return tuple(segments)


def _check_one_vehicle(graph: PyfgGraph) -> None:
    names = graph.poses.first
    if not names:
        raise DataError("there is no pose", "a mission needs VERTEX_SE lines", file=graph.file)
    if len(graph.robots) > 1:
        other = next(i for i, n in enumerate(names) if n.rstrip("0123456789") != graph.robots[0])
        raise graph.error(
            "poses",
            other,
            f"a mission is of one vehicle, and '{names[other]}' is of another than '{names[0]}'",
            "give each vehicle a file of its own",
        )
    if len(graph.landmark_edges):
        raise graph.error(
            "landmark_edges",
            0,
            "a mission takes ranges to landmarks, no positions of them seen from the vehicle",
            _REMEDY,
        )
    poses = set(names)
    for i, (a, b) in enumerate(graph.ranges.name.tolist()):
        if (a in poses) == (b in poses):
            what = "poses" if a in poses else "landmarks"
            raise graph.error(
                "ranges",
                i,
                f"a range between two {what} ('{a}' and '{b}'): a mission of one vehicle takes "
                "those between pose and landmark",
                _REMEDY,
            )


def _times(graph: PyfgGraph) -> FloatArray:
    """Times of the poses, s, shape (N,)."""
    t = graph.poses.t
    if not t.any():
        return np.arange(len(t), dtype=np.float64)
    back = np.diff(t) <= 0.0
    if back.any():
        i = int(np.argmax(back)) + 1
        names = graph.poses.first
        raise graph.error(
            "poses",
            i,
            f"the stamp {t[i]} s of '{names[i]}' is not after that of '{names[i - 1]}'",
            "let poses stand along the track with increasing stamps, or give all stamp 0",
            "t",
        )
    return t


def _unlocated(graph: PyfgGraph, first: int, size: int) -> DataError:
    names = graph.poses.first
    if size == 1:
        problem = f"nothing is known of '{names[first]}': no edge, range or prior"
        if len(names) > 1:
            problem = f"no range or prior says where '{names[first]}' is, and no edge joins it"
    else:
        last = names[first + size - 1]
        problem = f"no range or prior says where the poses '{names[first]}' to '{last}' are"
    return graph.error("poses", first, problem, "take it out, or join it by an edge")
