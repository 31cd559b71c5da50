"""What files say of poses beyond what they say of points: attitude, covariance of a pose."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.pose_trajectory import PoseTrajectory
from ubl_graph.result import Result

#: Further columns of trajectory.csv where nodes are poses.
ATTITUDE_COLUMNS = (
    *("heading_deg", "pitch_deg", "roll_deg"),
    *("sd_heading_deg", "sd_pitch_deg", "sd_roll_deg"),
)
#: Components of a pose: position along, then rotation about the world's axes.
COMPONENTS = ("east", "north", "up", "about_east", "about_north", "about_up")
_ROWS, _COLUMNS = np.triu_indices(len(COMPONENTS))
#: Columns of pose_covariance.csv: the upper triangle, row by row; m^2, m rad, rad^2.
COVARIANCE_COLUMNS = (
    "segment",
    "t",
    *(f"cov_{COMPONENTS[i]}_{COMPONENTS[j]}" for i, j in zip(_ROWS, _COLUMNS, strict=True)),
)


def attitude_table(track: PoseTrajectory) -> FloatArray:
    """What stands in `ATTITUDE_COLUMNS`, (N, 6), degrees."""
    return np.rad2deg(np.column_stack([track.attitude, track.attitude_sigma]))


def covariance_table(track: PoseTrajectory) -> FloatArray:
    """Upper triangles of the poses' covariances, row by row, (N, 21)."""
    return track.pose_covariance[:, _ROWS, _COLUMNS]


def pose_tracks(result: Result) -> Iterator[tuple[str, PoseTrajectory]]:
    """Name and trajectory of each segment whose nodes are poses."""
    for segment in result.segments:
        if isinstance(segment.trajectory, PoseTrajectory):
            yield segment.name, segment.trajectory
