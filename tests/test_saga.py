"""The main job on real pings: SAGA.1903, with the ship's GNSS as the reference."""

import csv
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import ubl_graph
from ubl_graph.evaluation import Errors, evaluate

LINES = ["S01/L01", "S01/L02", "S01/L04", "S02/L06", "S02/L07", "S02/L08", "S02/L09"]


def mission_file(folder: Path, data: Path, **changes: str) -> Path:
    """A mission file without options; `changes` are lines of [data]."""
    keys = {
        "observations": f'"{data}/SAGA.1903.kaiyo_k4-obs.csv"',
        "config": f'"{data}/SAGA.1903.kaiyo_k4-initcfg.ini"',
        "sound_speed": f'"{data}/SAGA.1903.kaiyo_k4-svp.csv"',
        "beacons": f'"{data}/SAGA.1903-garpos-solution.json"',
        "lines": json.dumps(LINES),
    } | changes
    path = folder / "mission.toml"
    rows = "\n".join(f"{k} = {v}" for k, v in keys.items())
    path.write_text(f'[mission]\nname = "SAGA.1903"\n[data]\nformat = "garpos"\n{rows}\n')
    return path


def smoothed(path: Path) -> tuple[ubl_graph.Result, dict]:
    result = ubl_graph.smooth(ubl_graph.load_mission(path))
    return result, Errors.joined(evaluate(result).values()).summary()


def test_straight_lines_with_a_profile(tmp_path, saga):
    result, errors = smoothed(mission_file(tmp_path, saga))
    assert result.status == "converged"
    assert errors["count"] == 1886
    assert errors["interior_horizontal_rmse_m"] < 0.30
    assert errors["horizontal_rmse_m"] < 0.47
    assert 0.7 < errors["interior_mean_nees_2dof"] < 3.0


def test_straight_lines_with_a_nominal_speed_and_straight_rays(tmp_path, saga):
    """The true mean speed is 1488.7 m/s."""
    result, errors = smoothed(mission_file(tmp_path, saga, sound_speed="1500.0"))
    assert not result.mission.uses_eigenrays
    assert errors["interior_horizontal_rmse_m"] < 0.42
    assert errors["interior_mean_nees_2dof"] < 4.0
    speeds = [1500.0 * np.exp(-s.slow["sound_speed"].value.mean()) for s in result.segments]
    np.testing.assert_allclose(speeds, 1488.0, atol=1.5)


def moved_observations(source: Path, target: Path, metres: float) -> None:
    """A copy of an observation file with every GNSS east and north moved."""
    with source.open() as file:
        comment, *rows = file.readlines()
    reader = csv.reader(rows)
    header = next(reader)
    columns = [header.index(n) for n in ("ant_e0", "ant_n0", "ant_e1", "ant_n1")]
    with target.open("w", newline="") as file:
        file.write(comment)
        writer = csv.writer(file)
        writer.writerow(header)
        for row in reader:
            for i in columns:
                row[i] = repr(float(row[i]) + metres)
            writer.writerow(row)


def command(*args: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "ubl_graph", *map(str, args)], capture_output=True, text=True
    )


def test_the_estimator_sees_nothing_of_the_ships_east_and_north(tmp_path, saga):
    moved = tmp_path / "moved.csv"
    moved_observations(saga / "SAGA.1903.kaiyo_k4-obs.csv", moved, 5000.0)
    lines = json.dumps(["S01/L02", "S02/L09"])
    plain = mission_file(tmp_path, saga, lines=lines)
    out = tmp_path / "a"
    assert command("smooth", plain, "-o", out, "--no-figures").returncode == 0
    shifted = mission_file(tmp_path, saga, lines=lines, observations=f'"{moved}"')
    assert command("smooth", shifted, "-o", tmp_path / "b", "--no-figures").returncode == 0
    first, second = (tmp_path / name / "trajectory.csv" for name in "ab")
    assert first.read_bytes() == second.read_bytes()
    near, far = (json.loads((tmp_path / n / "result.json").read_text()) for n in "ab")
    assert near["reference"]["horizontal_rmse_m"] < 1.0
    assert far["reference"]["horizontal_rmse_m"] == pytest.approx(5000.0 * np.sqrt(2.0), rel=1e-3)


@pytest.mark.slow
def test_all_lines_and_circles_with_the_configs_own_beacons(tmp_path, saga):
    """A-priori beacon positions are off by some 0.2 m; circles and a bend are in, too."""
    path = mission_file(tmp_path, saga)
    text = [r for r in path.read_text().splitlines() if not r.startswith(("lines", "beacons"))]
    path.write_text("\n".join(text) + "\n")
    result, errors = smoothed(path)
    assert result.status == "converged"
    assert len(result.segments) == 10
    assert errors["interior_horizontal_rmse_m"] < 0.5


@pytest.mark.slow
def test_the_whole_command_writes_what_it_says(tmp_path, saga):
    path = mission_file(tmp_path, saga)
    done = command("smooth", path, "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    names = {p.name for p in (tmp_path / "out").iterdir()}
    assert names == {
        "trajectory.csv",
        "residuals.csv",
        "slow_states.csv",
        "result.json",
        "mission.json",
        "track.png",
        "residuals.png",
        "sound_speed.png",
        "errors.png",
    }
    with (tmp_path / "out" / "trajectory.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert ",".join(rows[0]) == (
        "segment,t,east,north,up,v_east,v_north,v_up,sd_east,sd_north,sd_up,cov_east_north"
    )
    assert list(dict.fromkeys(r["segment"] for r in rows)) == LINES
