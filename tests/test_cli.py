"""The command as a user meets it: good input, and every kind of bad input."""

import csv
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

BEACONS = {"B1": (0.0, 0.0, -400.0), "B2": (500.0, 100.0, -420.0), "B3": (100.0, 600.0, -380.0)}


def command(*args: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "ubl_graph", *map(str, args)],
        capture_output=True,
        text=True,
        cwd=cwd,
    )


def write(path: Path, header: str, rows: list[list]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header.split(","))
        writer.writerows(rows)


def pings() -> list[list]:
    """Noiseless two-way pings of a vehicle at 1 m/s, 20 m deep, speed of sound 1500 m/s."""
    rows = []
    for k, t in enumerate(np.arange(0.0, 150.0, 3.0)):
        name = f"B{k % 3 + 1}"

        def flight(at, name=name):
            return np.linalg.norm(np.subtract([at - 50.0, 0.5 * at, -20.0], BEACONS[name])) / 1500.0

        receive = t
        for _ in range(20):
            receive = t + flight(t) + flight(receive) + 0.1
        rows.append([name, t, receive, flight(t) + flight(receive), 1e-4])
    return rows


@pytest.fixture
def dive(tmp_path: Path) -> Path:
    """A small sound mission; tests spoil one thing in it."""
    write(tmp_path / "ranges.csv", "beacon,t_transmit,t_receive,travel_time,sigma", pings())
    depth = [[t, 20.0, 0.05] for t in np.arange(0.0, 152.0, 1.0)]
    write(tmp_path / "depth.csv", "t,depth,sigma", depth)
    beacons = "".join(
        f'[[beacon]]\nname = "{n}"\nposition = {{ east = {e}, north = {m}, up = {u} }}\n'
        for n, (e, m, u) in BEACONS.items()
    )
    (tmp_path / "dive.toml").write_text(
        f'[mission]\nname = "dive"\n{beacons}[sound_speed]\nconstant = 1500.0\n'
        '[data]\ntwo_way_range = "ranges.csv"\ndepth = "depth.csv"\n'
    )
    return tmp_path


def test_a_sound_mission_is_smoothed(dive):
    done = command("smooth", "dive.toml", "-o", "out", cwd=dive)
    assert done.returncode == 0, done.stderr
    assert "status: converged" in done.stdout
    result = json.loads((dive / "out" / "result.json").read_text())
    assert result["status"] == "converged"
    assert result["pings"] == {
        n: {"used": 50 // 3 + (n < "B3"), "down_weighted": 0} for n in BEACONS
    }
    with (dive / "out" / "trajectory.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {r["segment"] for r in rows} == {""}
    t, east, north = (np.array([float(r[c]) for r in rows]) for c in ("t", "east", "north"))
    np.testing.assert_allclose(east, t - 50.0, atol=0.05)
    np.testing.assert_allclose(north, 0.5 * t, atol=0.05)
    assert {"track.png", "residuals.png", "sound_speed.png"} <= {
        p.name for p in (dive / "out").iterdir()
    }


def test_a_second_run_gives_the_same_bytes(dive):
    for folder in "ab":
        assert (
            command("smooth", "dive.toml", "-o", folder, "--no-figures", cwd=dive).returncode == 0
        )
    for name in ("trajectory.csv", "residuals.csv", "slow_states.csv", "mission.json"):
        assert (dive / "a" / name).read_bytes() == (dive / "b" / name).read_bytes()


def spoil(path: Path, row: int, column: str, value: str) -> None:
    with path.open() as file:
        rows = list(csv.DictReader(file))
    rows[row][column] = value
    write(path, ",".join(rows[0]), [list(r.values()) for r in rows])


def edit(dive: Path, old: str, new: str) -> None:
    text = (dive / "dive.toml").read_text()
    assert old in text
    (dive / "dive.toml").write_text(text.replace(old, new))


BAD = {
    "missing mission file": (lambda d: (d / "dive.toml").unlink(), ["dive.toml"]),
    "missing data file": (lambda d: (d / "ranges.csv").unlink(), ["ranges.csv"]),
    "missing column": (
        lambda d: write(d / "ranges.csv", "beacon,t_transmit,travel_time", [["B1", 0, 1]]),
        ["ranges.csv", "t_receive"],
    ),
    "not a number": (
        lambda d: spoil(d / "ranges.csv", 4, "travel_time", "NaN"),
        ["ranges.csv", "row 5", "travel_time"],
    ),
    "text": (
        lambda d: spoil(d / "depth.csv", 2, "depth", "deep"),
        ["depth.csv", "row 3", "depth", "deep"],
    ),
    "negative travel time": (
        lambda d: spoil(d / "ranges.csv", 6, "travel_time", "-0.4"),
        ["ranges.csv", "row 7", "travel_time", "-0.4"],
    ),
    "absurd travel time": (
        lambda d: spoil(d / "ranges.csv", 6, "travel_time", "61"),
        ["ranges.csv", "row 7", "travel_time", "61"],
    ),
    "receive before transmit": (
        lambda d: spoil(d / "ranges.csv", 8, "t_receive", "3.0"),
        ["ranges.csv", "row 9", "t_receive"],
    ),
    "unknown beacon": (
        lambda d: spoil(d / "ranges.csv", 3, "beacon", "B01"),
        ["ranges.csv", "row 4", "beacon", "'B01'", "did you mean 'B1'"],
    ),
    "duplicate": (
        lambda d: write(
            d / "ranges.csv",
            "beacon,t_transmit,t_receive,travel_time,sigma",
            pings() + pings()[2:3],
        ),
        ["ranges.csv", "row 51", "duplicate"],
    ),
    "empty data": (
        lambda d: write(d / "ranges.csv", "beacon,t_transmit,t_receive,travel_time", []),
        ["ranges.csv"],
    ),
    "empty file": (lambda d: (d / "ranges.csv").write_text(""), ["ranges.csv", "empty"]),
    "unknown key": (
        lambda d: edit(d, "[data]", "[options]\nacceleration = 1.0\n[data]"),
        ["dive.toml", "acceleration"],
    ),
    "bad option": (
        lambda d: edit(d, "[data]", '[options]\nloss = "l2"\n[data]'),
        ["dive.toml", "loss", "cauchy"],
    ),
    "no TOML": (lambda d: (d / "dive.toml").write_text("[mission\n"), ["dive.toml", "line 1"]),
    "water track without current": (
        lambda d: (
            write(
                d / "dvl.csv",
                "t,forward,right,down,reference",
                [[t, 1, 0, 0, "water"] for t in range(99)],
            ),
            write(d / "ahrs.csv", "t,heading,pitch,roll", [[t, 90, 0, 0] for t in range(99)]),
            edit(d, "[data]", '[data]\nvelocity = "dvl.csv"\nattitude = "ahrs.csv"'),
        ),
        ["dvl.csv", "row 1", "reference", "estimate_current"],
    ),
    "lever arm without attitude": (
        lambda d: edit(d, "[data]", "[vehicle]\ntransducer = { forward = 1.0 }\n[data]"),
        ["dive.toml", "transducer", "attitude"],
    ),
}


@pytest.mark.parametrize(("harm", "named"), BAD.values(), ids=BAD)
def test_bad_input_is_one_line_and_leaves_nothing(dive, harm, named):
    harm(dive)
    before = sorted(p.name for p in dive.iterdir())
    done = command("smooth", "dive.toml", "-o", "out", cwd=dive)
    assert done.returncode == 2
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert "Traceback" not in done.stderr
    for text in named:
        assert text in done.stderr
    assert sorted(p.name for p in dive.iterdir()) == before


def test_the_solver_is_the_command_lines_then_the_files(dive):
    """The answer is the same; result.json and mission.json say who gave it."""
    with (dive / "dive.toml").open("a") as file:
        file.write('[options]\nsolver = "banded"\n')
    tracks = {}
    for name, solver in {
        "gtsam": "gtsam",
        "auto": "banded, confirmed by gtsam",
        "": "banded",
    }.items():
        folder = dive / f"out-{name}"
        arguments = ["--solver", name] if name else []
        done = command("smooth", dive / "dive.toml", "-o", folder, "--no-figures", *arguments)
        assert done.returncode == 0, done.stderr
        assert json.loads((folder / "result.json").read_text())["segments"][0]["solver"] == solver
        options = json.loads((folder / "mission.json").read_text())["options"]
        assert options["solver"] == (name or "banded")
        tracks[name] = np.loadtxt(
            folder / "trajectory.csv", delimiter=",", skiprows=1, usecols=range(2, 9)
        )
    np.testing.assert_allclose(tracks["gtsam"], tracks[""], atol=2e-6)
    np.testing.assert_array_equal(tracks["auto"], tracks[""])


@pytest.mark.parametrize("name", ["lapack", "BANDED", ""])
def test_an_unknown_solver_is_refused(dive, name):
    done = command("smooth", dive / "dive.toml", "-o", dive / "out", "--solver", name)
    assert done.returncode == 2
    (line,) = done.stderr.strip().splitlines()
    assert f"'{name}' is not one of auto, gtsam, banded" in line
    assert not (dive / "out").exists()


def test_an_output_that_is_a_file_is_refused_and_kept(dive):
    (dive / "out").write_text("mine")
    done = command("smooth", "dive.toml", "-o", "out", cwd=dive)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert (dive / "out").read_text() == "mine"


def test_other_files_in_the_output_folder_stay(dive):
    (dive / "out").mkdir()
    (dive / "out" / "notes.txt").write_text("mine")
    assert command("smooth", "dive.toml", "-o", "out", "--no-figures", cwd=dive).returncode == 0
    assert (dive / "out" / "notes.txt").read_text() == "mine"
    assert (dive / "out" / "result.json").exists()


def test_demo_beats_dead_reckoning(tmp_path):
    done = command("demo", "-o", "demo", "--no-figures", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    reckoned = next(r for r in done.stdout.splitlines() if r.startswith("dead reckoning"))
    smoothed = next(r for r in done.stdout.splitlines() if r.startswith("smoothed"))
    assert float(smoothed.split()[1]) < 0.2 * float(reckoned.split()[2])


def test_version_and_help():
    assert command("--version").stdout.startswith("ubl-graph ")
    assert "ubl-graph smooth dive.toml -o dive-out" in command("smooth", "--help").stdout
