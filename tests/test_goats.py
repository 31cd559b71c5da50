"""GOATS, dives 15 and 16: an AUV with odometry and acoustic ranges to three beacons, as PyFG.

There is no ground truth. What is judged is a beacon that was left out: how far its ranges are from
what the track says that the others gave. Nothing is told but the file: the start is found, options
are the defaults. Dive 16 served the choice of none of them.
"""

from __future__ import annotations

import csv
import json
from functools import cache
from itertools import pairwise
from pathlib import Path

import gtsam
import numpy as np
import pytest
from typer.testing import CliRunner

from ubl_graph import load_mission, smooth
from ubl_graph.cli import app
from ubl_graph.io.pyfg import PyfgGraph, read_pyfg
from ubl_graph.result import Result

#: Medians of the absolute prediction errors, m.
LIMITS = {"L0": 4.0, "L1": 2.4, "L2": 2.7}


def file_of(dive: int) -> Path:
    return Path(gtsam.findExampleDataFile(f"goats_{dive}.pyfg"))


@cache
def graph_of(dive: int) -> PyfgGraph:
    return read_pyfg(file_of(dive))


def smoothed(folder: Path, text: str) -> Result:
    """Smooth a PyFG file by a mission file that says nothing else."""
    (folder / "goats.pyfg").write_text(text)
    (folder / "goats.toml").write_text('[data]\nformat = "pyfg"\nfile = "goats.pyfg"\n')
    return smooth(load_mission(folder / "goats.toml"))


def without(text: str, beacon: str) -> str:
    """The file without the ranges to a beacon, which stays where it is."""
    lines = text.splitlines(keepends=True)
    return "".join(x for x in lines if not (x.startswith("EDGE_RANGE") and beacon in x.split()))


@pytest.mark.parametrize("beacon", LIMITS)
def test_a_beacon_that_was_left_out_is_predicted(beacon, tmp_path):
    graph = graph_of(15)
    result = smoothed(tmp_path, without(file_of(15).read_text(), beacon))
    assert result.status == "converged", result.reason
    assert beacon not in result.residuals.beacon
    gone = [n == beacon for n in graph.ranges.second]
    poses = [n for n, left in zip(graph.ranges.first, gone, strict=True) if left]
    at = [graph.poses.first.index(n) for n in poses]
    assert len(at) > 200
    gap = result.trajectory.position[at] - result.beacons[beacon].value
    error = np.linalg.norm(gap, axis=1) - graph.ranges.distance[gone]
    assert np.median(np.abs(error)) <= LIMITS[beacon]


@pytest.mark.parametrize("dive", [15, 16])
def test_all_beacons_from_no_start(dive, tmp_path):
    result = smoothed(tmp_path, file_of(dive).read_text())
    assert result.status == "converged", result.reason
    assert len(result.trajectory.t) == len(graph_of(dive).poses)
    # The declared 0.75 m is too small, and that is said.
    assert any("down-weighted" in w and "sound speed" not in w for w in result.warnings)


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    """What `ubl-graph smooth` leaves of dive 15."""
    folder = tmp_path_factory.mktemp("goats")
    text = f'[mission]\nname = "goats 15"\n[data]\nformat = "pyfg"\nfile = "{file_of(15)}"\n'
    (folder / "goats.toml").write_text(text)
    called = CliRunner().invoke(
        app, ["smooth", str(folder / "goats.toml"), "-o", str(folder / "out")]
    )
    assert called.exit_code == 0, called.output
    assert "heading sd, deg" in called.output and "next best, cost" in called.output
    return folder / "out"


def columns(path: Path) -> dict[str, np.ndarray]:
    with path.open() as file:
        rows = list(csv.DictReader(file))
    return {k: np.array([float(r[k]) for r in rows]) for k in rows[0] if k != "segment"}


def test_one_row_a_pose_in_file_order(written):
    """Row by row: the pose's number, its way to the next one, and its ranges are the file's."""
    graph, rows = graph_of(15), columns(written / "trajectory.csv")
    assert len(rows["t"]) == len(graph.poses) == 473
    assert np.array_equal(rows["t"], np.arange(473))
    place = np.stack([rows["east"], rows["north"]], axis=1)
    yaw = np.pi / 2 - np.deg2rad(rows["heading_deg"])
    poses = [gtsam.Pose2(*p, a) for p, a in zip(place, yaw, strict=True)]
    steps = [a.between(b) for a, b in pairwise(poses)]
    assert graph.pose_edges.first == graph.poses.first[:-1]
    told = graph.pose_edges.values
    way = np.array([[s.x(), s.y()] for s in steps])
    turn = np.array([s.theta() for s in steps]) - told[:, 2]
    assert np.abs(way - told[:, :2]).max() < 1.0
    assert np.abs(np.angle(np.exp(1j * turn))).max() < np.deg2rad(2.0)
    at = [graph.poses.first.index(n) for n in graph.ranges.first]
    sites = dict(zip(graph.landmarks.first, graph.landmarks.position, strict=True))
    site = np.array([sites[n] for n in graph.ranges.second])
    error = np.linalg.norm(place[at] - site, axis=1) - graph.ranges.distance
    assert np.median(np.abs(error)) < 1.5


def test_the_folder_tells_the_whole_story(written):
    names = {path.name for path in written.iterdir()}
    assert names == {
        *("trajectory.csv", "pose_covariance.csv", "residuals.csv", "result.json", "mission.json"),
        *("track.png", "heading.png", "residuals.png"),
    }
    told = json.loads((written / "result.json").read_text())
    assert (told["node"], told["status"]) == ("pose2", "converged")
    (segment,) = told["segments"]
    assert segment["odometry_noise"] == "both"
    assert "runner_up" in segment
    assert set(told["shared_states"]) == {"odometry_scale", "odometry_turn_bias"}
    assert set(told["pings"]) == set(LIMITS)
    options = json.loads((written / "mission.json").read_text())["options"]
    assert (options["node"], options["odometry_noise"]) == ("pose2", "both")
    assert options["estimate_sound_speed"] is False
    assert all(0.0 < sd < 10.0 for sd in columns(written / "trajectory.csv")["sd_heading_deg"])
