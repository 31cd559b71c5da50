"""`ubl-graph batch`: many missions as a user meets them, sound and spoiled."""

import csv
import json
import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path

import fleet
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ubl_graph import load_mission, smooth
from ubl_graph.batch import folder_names, smooth_batch
from ubl_graph.errors import ConfigurationError, DataError
from ubl_graph.study import SerialExecutor

#: What does not depend on when and for how long it was computed.
LASTING = ("trajectory.csv", "residuals.csv", "slow_states.csv", "mission.json")


def command(*args: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "ubl_graph", *map(str, args)],
        capture_output=True,
        text=True,
        cwd=cwd,
    )


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / "batch.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def contents(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in LASTING}


@pytest.fixture(scope="module")
def dives(tmp_path_factory):
    """Three sound missions in one folder; two of them bear the same name."""
    folder = tmp_path_factory.mktemp("dives")
    names = {"d1": "survey", "d2": "survey", "d3": ""}
    for seed, (stem, name) in enumerate(names.items(), start=1):
        fleet.write_mission(folder, stem, seed=seed, name=name)
    return folder


@pytest.fixture(scope="module")
def batch(dives):
    """All three smoothed in one go by two processes, with figures."""
    files = [f"{stem}.toml" for stem in ("d1", "d2", "d3")]
    return command("batch", *files, "-o", "out", "--workers", "2", cwd=dives), dives / "out"


# Sound missions


def test_each_mission_gets_what_smooth_gives(dives, batch):
    done, out = batch
    assert (done.returncode, done.stderr) == (0, "")
    for stem in ("d1", "d2", "d3"):
        alone = dives / f"alone-{stem}"
        assert command("smooth", dives / f"{stem}.toml", "-o", alone).returncode == 0
        assert contents(out / stem) == contents(alone)
        assert {p.name for p in (out / stem).iterdir()} == {p.name for p in alone.iterdir()}
        assert (out / stem / "track.png").read_bytes().startswith(b"\x89PNG")
        assert (out / stem).stat().st_mode == alone.stat().st_mode


def test_the_table_sums_up_what_the_missions_files_say(batch):
    done, out = batch
    rows = table(out)
    assert [(r["mission"], r["folder"], r["file"]) for r in rows] == [
        ("survey", "d1", "d1.toml"),
        ("survey", "d2", "d2.toml"),
        ("d3", "d3", "d3.toml"),
    ]
    for row in rows:
        folder = out / row["folder"]
        with (folder / "residuals.csv").open() as file:
            weights = [float(r["weight"]) for r in csv.DictReader(file)]
        with (folder / "trajectory.csv").open() as file:
            sd = [max(float(r["sd_east"]), float(r["sd_north"])) for r in csv.DictReader(file)]
        result = json.loads((folder / "result.json").read_text())
        assert (row["status"], row["reason"]) == (result["status"], result["reason"])
        assert (int(row["segments"]), int(row["pings"])) == (1, len(weights))
        share = sum(w < 0.5 for w in weights) / len(weights)
        assert float(row["down_weighted_share"]) == pytest.approx(share, abs=1e-6)
        assert float(row["median_sd_m"]) == pytest.approx(np.median(sd), abs=2e-6)
        assert (row["horizontal_rmse_m"], row["error"]) == ("", "")
        assert 0.0 < float(row["seconds"]) < 600.0
        (printed,) = (r for r in done.stdout.splitlines() if r.startswith(row["folder"]))
        assert printed.split()[1:3] == [row["segments"], row["pings"]]
        assert printed.split()[4] == f"{np.median(sd):.2f}"
        assert printed.split()[-1] == "converged"


def test_the_tables_agree_and_the_document_is_json(batch):
    _, out = batch
    document = json.loads((out / "batch.json").read_text())
    assert set(document["versions"]) >= {"ubl-graph", "numpy", "gtsam"}
    for row, line in zip(document["missions"], table(out), strict=True):
        assert list(row) == list(line)
        for key, value in row.items():
            shown = "; ".join(value) if isinstance(value, list) else value
            assert line[key] == ("" if shown is None else str(shown))


def test_the_error_against_the_reference_is_in_the_table(saga, tmp_path):
    (tmp_path / "line.toml").write_text(
        f'[data]\nformat = "garpos"\nobservations = "{saga}/SAGA.1903.kaiyo_k4-obs.csv"\n'
        f'config = "{saga}/SAGA.1903.kaiyo_k4-initcfg.ini"\n'
        f'sound_speed = "{saga}/SAGA.1903.kaiyo_k4-svp.csv"\n'
        f'beacons = "{saga}/SAGA.1903-garpos-solution.json"\nlines = ["S02/L06"]\n'
    )
    done = command("batch", "line.toml", "-o", "out", "--no-figures", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (row,) = table(tmp_path / "out")
    result = json.loads((tmp_path / "out" / "line" / "result.json").read_text())
    expected = result["reference"]["horizontal_rmse_m"]
    assert float(row["horizontal_rmse_m"]) == pytest.approx(expected, abs=1e-6)
    assert f"{expected:.2f}" in done.stdout


def test_figures_and_solver_are_for_all(dives, tmp_path):
    files = [dives / "d1.toml", dives / "d2.toml"]
    done = command("batch", *files, "-o", tmp_path, "--no-figures", "--solver", "gtsam")
    assert done.returncode == 0, done.stderr
    for stem in ("d1", "d2"):
        assert not list((tmp_path / stem).glob("*.png"))
        result = json.loads((tmp_path / stem / "result.json").read_text())
        assert result["segments"][0]["solver"] == "gtsam"


def test_missions_whose_files_share_a_name_get_distinct_folders(tmp_path):
    for part, seed in (("a", 1), ("b", 2)):
        fleet.write_mission(tmp_path / part, "mission", seed=seed)
    rows = smooth_batch(
        [tmp_path / "a" / "mission.toml", tmp_path / "b" / "mission.toml"],
        tmp_path / "out",
        executor=SerialExecutor(),
        figures=False,
    )
    assert [r.folder for r in rows] == ["a-mission", "b-mission"]
    tracks = [(tmp_path / "out" / r.folder / "trajectory.csv").read_bytes() for r in rows]
    assert tracks[0] != tracks[1]


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["a", "b", "A", "a-b"]),
            st.sampled_from(["m.toml", "M.toml", "m-2.toml", "b-m.toml", "batch.csv.toml"]),
        ),
        unique=True,
    )
)
def test_folder_names_are_unique_even_where_case_counts_for_nothing(parts):
    files = [Path(*part) for part in parts]
    names = folder_names(files)
    assert len({*(n.casefold() for n in names), "batch.csv", "batch.json"}) == len(files) + 2
    for file, name in zip(files, names, strict=True):
        assert file.stem in name
        assert Path(name).name == name


def test_missions_and_results_can_be_sent(dives):
    mission = load_mission(dives / "d1.toml")
    again = pickle.loads(pickle.dumps(mission))
    result, same = smooth(mission), smooth(again)
    sent = pickle.loads(pickle.dumps(result))
    times = np.linspace(result.trajectory.t[0], result.trajectory.t[-1], 17)
    for other in (same, sent):
        expected, found = result.trajectory.at(times), other.trajectory.at(times)
        np.testing.assert_array_equal(found.position, expected.position)
        np.testing.assert_array_equal(found.covariance, expected.covariance)


# A cluster


def test_a_cluster_gives_the_same_files_without_seeing_the_disk(dives, batch, tmp_path):
    """Its workers stand in another folder, where the names of the mission files mean nothing."""
    _, out = batch
    (tmp_path / "cluster").mkdir()
    with fleet.cluster(tmp_path / "cluster") as (address, _):
        where = ("-o", tmp_path / "out", "--scheduler", address)
        done = command("batch", "d1.toml", "d2.toml", "nothing.toml", *where, cwd=dives)
    assert done.returncode == 1
    assert done.stderr.splitlines() == [
        "ubl-graph: nothing.toml: there is no such file",
    ]
    for stem in ("d1", "d2"):
        assert contents(tmp_path / "out" / stem) == contents(out / stem)
        same = (tmp_path / "out" / stem / "track.png").read_bytes()
        assert same == (out / stem / "track.png").read_bytes()
    timeless = [{k: v for k, v in r.items() if k != "seconds"} for r in table(out)[:2]]
    found = [{k: v for k, v in r.items() if k != "seconds"} for r in table(tmp_path / "out")[:2]]
    assert found == timeless


def test_a_scheduler_that_does_not_answer_leaves_nothing(dives, tmp_path):
    done = command(
        *("batch", dives / "d1.toml", "-o", tmp_path / "out", "--scheduler", "foo://bar")
    )
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert "'foo://bar': no dask scheduler answers" in line
    assert "like tcp://" in line
    assert not (tmp_path / "out").exists()


# Missions that fail


def test_a_mission_that_fails_is_named_and_ends_nothing(tmp_path):
    for stem in ("sound", "cut", "key"):
        fleet.write_mission(tmp_path, stem)
    ranges = (tmp_path / "cut-ranges.csv").read_text().replace("B3", "B9", 1)
    (tmp_path / "cut-ranges.csv").write_text(ranges)
    (tmp_path / "key.toml").write_text((tmp_path / "key.toml").read_text() + "[option]\n")
    files = ["cut.toml", "sound.toml", "key.toml", "nothing.toml"]
    done = command("batch", *files, "-o", "out", "--no-figures", cwd=tmp_path)
    assert done.returncode == 1
    lines = done.stderr.splitlines()
    assert [line.partition(": ")[0] for line in lines] == ["ubl-graph"] * 3
    for line, named in zip(
        lines,
        [
            ["cut.toml: ", "cut-ranges.csv, row 3", "'B9'"],
            ["key.toml", "option"],
            ["nothing.toml: there is no such file"],
        ],
        strict=True,
    ):
        assert all(text in line for text in named), line
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        *("batch.csv", "batch.json", "sound"),
    ]
    rows = table(tmp_path / "out")
    assert [r["status"] for r in rows] == ["failed", "converged", "failed", "failed"]
    assert [bool(r["error"]) for r in rows] == [True, False, True, True]
    assert [r["median_sd_m"] == "" for r in rows] == [True, False, True, True]
    expected = smooth(load_mission(tmp_path / "sound.toml")).trajectory.position
    found = np.loadtxt(
        tmp_path / "out" / "sound" / "trajectory.csv",
        delimiter=",",
        skiprows=1,
        usecols=(2, 3, 4),
    )
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_an_unobservable_mission_is_no_failure(tmp_path):
    path = fleet.write_mission(tmp_path, "lost")
    lines = (tmp_path / "lost-ranges.csv").read_text().splitlines()
    (tmp_path / "lost-ranges.csv").write_text("\n".join(lines[:2]) + "\n")
    done = command("batch", path, "-o", tmp_path / "out", "--no-figures")
    assert done.returncode == 0, done.stderr
    (row,) = table(tmp_path / "out")
    assert row["status"] == "unobservable"
    assert row["reason"]
    assert f"lost: unobservable: {row['reason']}" in done.stdout


def test_a_mission_whose_folder_is_in_the_way_fails_alone(tmp_path):
    paths = [fleet.write_mission(tmp_path, stem) for stem in ("d1", "d2")]
    (tmp_path / "out" / "d1" / "trajectory.csv").mkdir(parents=True)
    (tmp_path / "out" / "d2").mkdir()
    (tmp_path / "out" / "d2" / "notes.txt").write_text("mine")
    rows = smooth_batch(paths, tmp_path / "out", executor=SerialExecutor(), figures=False)
    assert [r.status for r in rows] == ["failed", "converged"]
    assert "'trajectory.csv' in it is a folder" in rows[0].error
    assert [p.name for p in (tmp_path / "out" / "d1").iterdir()] == ["trajectory.csv"]
    assert (tmp_path / "out" / "d2" / "notes.txt").read_text() == "mine"
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["d1", "d2"]


# Bad input


def spoiled(folder: Path, how: str) -> list[str]:
    """Arguments of a command that must be refused."""
    match how:
        case "file for output":
            (folder / "out").write_text("mine")
        case "file above output":
            (folder / "out").write_text("mine")
            return ["d1.toml", "-o", "out/below"]
        case "file in place of a mission's folder":
            (folder / "out").mkdir()
            (folder / "out" / "d1").write_text("mine")
        case "folder in place of the table":
            (folder / "out" / "batch.csv").mkdir(parents=True)
        case "twice":
            return ["d1.toml", "./d1.toml", "-o", "out"]
        case "solver":
            return ["d1.toml", "-o", "out", "--solver", "lapack"]
        case "workers of a scheduler":
            return ["d1.toml", "-o", "out", "--workers", "2", "--scheduler", "127.0.0.1:1"]
    return ["d1.toml", "-o", "out"]


@pytest.mark.parametrize(
    ("how", "named"),
    [
        ("file for output", ["out: ", "file, not a folder"]),
        ("file above output", ["below", "cannot be written"]),
        ("file in place of a mission's folder", ["d1", "file, not a folder"]),
        ("folder in place of the table", ["batch.csv", "folder"]),
        ("twice", ["d1.toml", "given twice"]),
        ("solver", ["'lapack' is not one of auto, gtsam, banded"]),
        ("workers of a scheduler", ["workers", "scheduler"]),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(tmp_path, how, named):
    fleet.write_mission(tmp_path, "d1")
    arguments = spoiled(tmp_path, how)
    before = sorted(tmp_path.rglob("*"))
    done = command("batch", *arguments, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert all(text in line for text in named), line
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("arguments", [["-o", "out"], ["d1.toml"], ["d1.toml", "--workers", "0"]])
def test_a_command_that_lacks_a_part_is_refused(tmp_path, arguments):
    done = command("batch", *arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert "Usage: " in done.stderr
    assert not list(tmp_path.iterdir())


def test_no_missions_are_refused_in_python_too(tmp_path):
    with pytest.raises(ConfigurationError, match="no mission file"):
        smooth_batch([], tmp_path / "out")
    with pytest.raises(DataError, match="file, not a folder"):
        smooth_batch([tmp_path / "a.toml"], fleet.write_mission(tmp_path, "d1"))
    assert not (tmp_path / "out").exists()


def test_an_interrupt_leaves_whole_folders_only(tmp_path):
    paths = [fleet.write_mission(tmp_path, f"d{i}", seed=i) for i in range(40)]
    with subprocess.Popen(
        [sys.executable, "-m", "ubl_graph", "batch", *paths, "-o", "out", "--workers", "1"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        end_of_patience = time.monotonic() + 60.0
        while not (tmp_path / "out" / "d0").exists() and time.monotonic() < end_of_patience:
            time.sleep(0.02)
        os.killpg(process.pid, signal.SIGINT)
        printed, said = process.communicate(timeout=30)
    assert process.returncode == 130
    assert printed == ""
    assert "Traceback" not in said
    made = sorted((tmp_path / "out").iterdir())
    assert 0 < len(made) < 40
    for folder in made:
        assert {"trajectory.csv", "result.json", "track.png"} <= {p.name for p in folder.iterdir()}
