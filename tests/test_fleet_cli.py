"""The command on a fleet: what it prints and writes, and every kind of bad input."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from fleet_page import COMMAND, EXAMPLE, PRINTED, write_example

from ubl_graph.cli import main
from ubl_graph.errors import DataError
from ubl_graph.io import fleet_result_files


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """The page's example, in the working folder; tests spoil one thing in it."""
    write_example(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def run(monkeypatch, capsys):
    """Run the command in this process: exit code, standard output, standard error."""

    def run(*args: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["ubl-graph", *args])
        with pytest.raises(SystemExit) as ended:
            main()
        done = capsys.readouterr()
        return int(ended.value.code or 0), done.out, done.err

    return run


def files(folder: Path) -> set[str]:
    return {str(p.relative_to(folder)) for p in folder.rglob("*")}


def test_the_example_of_the_page_prints_what_the_page_says(folder):
    program, *args = COMMAND.split()
    assert program == "ubl-graph"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-m", "ubl_graph", *args],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert [text.rstrip() for text in done.stdout.splitlines()] == PRINTED.splitlines()
    result = json.loads((folder / "out" / "result.json").read_text())
    assert result["status"] == "converged"
    assert {"auv", "boat", "map.png", "targets.csv"} <= files(folder / "out")


def test_solver_and_figures(folder, run):
    code, out, err = run("smooth", "fleet.toml", "-o", "out", "--no-figures", "--solver", "gtsam")
    assert (code, err) == (0, "")
    assert "status: converged" in out
    assert json.loads((folder / "out" / "result.json").read_text())["solver"] == "gtsam"
    assert not [name for name in files(folder) if name.endswith(".png")]
    code, out, err = run("smooth", "fleet.toml", "-o", "new", "--solver", "magic")
    assert code == 2
    assert len(err.splitlines()) == 1
    assert "'magic'" in err
    assert not (folder / "new").exists()


def test_what_is_unobservable_is_said_and_written(folder, run):
    text = EXAMPLE["fleet.toml"].replace(
        "[[target]]",
        '[[vehicle]]\nname = "glider"\n[vehicle.options]\nnode = "pose2"\n[vehicle.data]\n'
        'odometry = "auv-odometry.csv"\n[[vehicle]]\nname = "idle"\n'
        '[[target]]\nname = "never"\n[[target]]',
        1,
    )
    (folder / "fleet.toml").write_text(text)
    code, out, _err = run("smooth", "fleet.toml", "-o", "out", "--no-figures")
    assert code == 0
    assert "status: unobservable (" in out
    assert "glider: nothing ties it to the map" in out
    assert "target never: no vehicle ranged it" in out
    rows = {line.split()[0]: line.split()[-1] for line in out.splitlines() if line}
    assert rows["boat"] == rows["auv"] == rows["wreck"] == "converged"
    assert rows["glider"] == rows["idle"] == rows["never"] == "unobservable"
    result = json.loads((folder / "out" / "result.json").read_text())
    assert result["status"] == "unobservable"
    assert result["vehicles"]["auv"]["status"] == "converged"


@pytest.mark.parametrize("kind", ["a beacon", "one-way ranges"])
def test_slow_states_of_compounded_vehicles_are_written_at_every_node(folder, run, kind):
    text, ranges = EXAMPLE["fleet.toml"], EXAMPLE["ranges.csv"]
    if kind == "a beacon":
        text += '[[beacon]]\nname = "B1"\nposition = { east = 0.0, north = -100.0, up = -60.0 }\n'
        ranges += "auv,B1,12,12.2,.2832\nauv,B1,32,32.2,.2200\nauv,B1,52,52.2,.1700\n"
    else:
        text = text.replace("two_way_range", "one_way_range")
        ranges = "\n".join(",".join(r.split(",")[:4]) for r in ranges.splitlines()) + "\n"
    (folder / "fleet.toml").write_text(text)
    (folder / "ranges.csv").write_text(ranges)
    code, _, _ = run("smooth", "fleet.toml", "-o", "out")
    assert code == 0
    tables = [
        (folder / "out" / "auv" / name).read_text().splitlines()
        for name in ("trajectory.csv", "slow_states.csv")
    ]
    assert len(tables[0]) == len(tables[1]) > 5
    drawn = "sound_speed.png" if kind == "a beacon" else "clock_offset.png"
    assert drawn in {path.name for path in (folder / "out" / "auv").iterdir()}


THIRD = EXAMPLE["ranges.csv"].splitlines()[3]
BAD = {
    "unknown end": ("ranges.csv", THIRD, THIRD.replace("auv,boat", "auv,baot"), "row 3 (line 4)"),
    "range to itself": ("ranges.csv", THIRD, THIRD.replace("auv,boat", "auv,auv"), "to itself"),
    "row error": ("ranges.csv", THIRD, THIRD + "0,1", "row 3 (line 4)"),
    "missing column": ("ranges.csv", "vehicle,peer", "vehicle,other", "'peer' is missing"),
    "missing file": ("fleet.toml", '"ranges.csv"', '"range.csv"', "range.csv"),
    "clocks hours apart": ("ranges.csv", THIRD, "auv,boat,7245,7245.2,0.2", "seem to differ by"),
    "named twice": ("fleet.toml", 'name = "auv"', 'name = "boat"', "'boat' is there twice"),
    "target named as beacon": (
        *("fleet.toml", "[[target]]"),
        '[[beacon]]\nname = "wreck"\nposition = { east = 0, north = 0, up = 0 }\n[[target]]',
        "'wreck' is there twice",
    ),
    "unknown key": ("fleet.toml", "odometry =", "odometri =", "did you mean 'odometry'?"),
    "no TOML": ("fleet.toml", "[[target]]", "[[target", "no TOML"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line_and_nothing_is_written(folder, run, case):
    file, old, new, words = BAD[case]
    text = EXAMPLE[file]
    assert old in text
    (folder / file).write_text(text.replace(old, new, 1))
    before = files(folder)
    code, out, err = run("smooth", "fleet.toml", "-o", "out")
    assert code == 2
    assert out == ""
    assert len(err.splitlines()) == 1
    assert err.startswith(
        f"ubl-graph: {file if file != 'fleet.toml' or case != 'missing file' else ''}"
    )
    assert words in err
    assert files(folder) == before


def test_an_output_that_is_a_file_is_refused_before_the_work(folder, run):
    (folder / "out").write_text("mine")
    code, _out, err = run("smooth", "fleet.toml", "-o", "out")
    assert code == 2
    assert err == "ubl-graph: out: the output is a file, not a folder; name a folder\n"
    assert (folder / "out").read_text() == "mine"


def test_a_failure_while_writing_leaves_the_folder_as_it_was(folder, run, monkeypatch):
    (folder / "out" / "auv").mkdir(parents=True)
    (folder / "out" / "auv" / "trajectory.csv").write_text("old")
    before = files(folder)

    def broken(_fleet):
        raise DataError("the disk is full")

    monkeypatch.setattr(fleet_result_files, "resolved_fleet", broken)
    code, out, err = run("smooth", "fleet.toml", "-o", "out", "--no-figures")
    assert (code, out, err) == (2, "", "ubl-graph: the disk is full\n")
    assert files(folder) == before
    assert (folder / "out" / "auv" / "trajectory.csv").read_text() == "old"


@pytest.mark.usefixtures("folder")
def test_live_refuses_a_fleet(run):
    code, out, err = run("live", "fleet.toml")
    assert (code, out) == (2, "")
    assert err.startswith("ubl-graph: fleet.toml, field 'vehicle': the file is of a fleet")
    assert "FleetEstimator" in err
    assert len(err.splitlines()) == 1


def test_batch_names_a_fleet_as_failed(folder, run):
    code, _out, err = run("batch", "fleet.toml", "-o", "out", "--workers", "1")
    assert code == 1
    assert err.startswith("ubl-graph: fleet.toml, field 'vehicle': the file is of a fleet")
    assert "`ubl-graph smooth`" in err
    assert len(err.splitlines()) == 1
    (row,) = json.loads((folder / "out" / "batch.json").read_text())["missions"]
    assert row["status"] == "failed"
    assert files(folder / "out") == {"batch.csv", "batch.json"}
