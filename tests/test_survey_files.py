"""`ubl-graph calibrate`: what it writes, what it prints, and how it fails."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from survey import TURNAROUND, survey
from typer.testing import CliRunner

from ubl_graph.beacon import Beacon
from ubl_graph.cli import app
from ubl_graph.errors import UblGraphError
from ubl_graph.io.garpos import read_beacons
from ubl_graph.io.mission_file import load_mission
from ubl_graph.io.survey_files import write_survey
from ubl_graph.survey import SurveyOptions, SurveyResult, calibrate

FILES = {"beacons.json", "result.json", "mission.json", "residuals.csv", "slow_states.csv"}
POSE = ("ant_e", "ant_n", "ant_u", "head", "pitch", "roll")
FIGURES = {"survey.png", "residuals.png", "sound_speed.png"}


def garpos_campaign(folder: Path, **changes: str) -> Path:
    """A simulated survey as a GARPOS campaign with a mission file."""
    mission, _ = survey(3, pings=150, start_off=2.0)
    (segment,) = mission.segments
    rows, fix = segment.two_way_range, segment.position
    at = dict(zip(fix.t.tolist(), fix.position.tolist(), strict=True))
    columns = [f"{name}{end}" for end in "01" for name in POSE]
    with (folder / "obs.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["SET", "LN", "MT", "TT", "flag", "ST", "RT", *columns])
        for i in range(len(rows)):
            sent, heard = float(rows.t_transmit[i]), float(rows.t_receive[i])
            ends = [v for t in (sent, heard) for v in (*at[t], 0.0, 0.0, 0.0)]
            line = "L1" if sent < 2000.0 else "L2"
            travel = float(rows.travel_time[i])
            writer.writerow(["S1", line, rows.beacon[i], travel, "False", sent, heard, *ends])
    stations = "\n".join(
        f"{b.name}_dPos = {' '.join(map(repr, b.position.tolist()))} 0 0 0" for b in mission.beacons
    )
    (folder / "cfg.ini").write_text(f"{stations}\nATDoffset = 0 0 0\n")
    keys = {"observations": '"obs.csv"', "config": '"cfg.ini"', "sound_speed": "1500.0"} | changes
    data = "\n".join(f"{key} = {value}" for key, value in keys.items())
    path = folder / "mission.toml"
    path.write_text(f'[mission]\nname = "campaign"\n[data]\nformat = "garpos"\n{data}\n')
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("campaign")
    done = CliRunner().invoke(
        app, ["calibrate", str(garpos_campaign(place)), "-o", str(place / "out")]
    )
    assert done.exit_code == 0, done.output
    (place / "printed.txt").write_text(done.output)
    return place


@pytest.fixture(scope="module")
def result(folder) -> SurveyResult:
    return calibrate(load_mission(folder / "mission.toml", known_track=True))


def test_the_track_of_a_garpos_mission_is_data_only_when_asked(folder):
    plain = load_mission(folder / "mission.toml")
    known = load_mission(folder / "mission.toml", known_track=True)
    for a, b in zip(plain.segments, known.segments, strict=True):
        assert a.records().keys() == {"two_way_range", "depth"}
        assert b.records().keys() == {"two_way_range", "position"}
        assert b.reference is None
        pings = b.two_way_range
        assert np.isin(pings.t_transmit, b.position.t).all()
        assert np.isin(pings.t_receive, b.position.t).all()
        np.testing.assert_allclose(
            pings.t_receive - pings.t_transmit - pings.travel_time, TURNAROUND, atol=1e-3
        )


def test_every_file_is_written(folder):
    assert {p.name for p in (folder / "out").iterdir()} == FILES | FIGURES


def test_beacons_json_is_a_beacons_file(folder, result):
    found = read_beacons(folder / "out" / "beacons.json")
    assert tuple(found) == result.names == ("M1", "M2", "M3", "M4")
    for i, beacon in enumerate(found.values()):
        np.testing.assert_allclose(beacon.position, result.position[i], atol=1e-6)
        np.testing.assert_allclose(beacon.sigma, result.sigma[i], rtol=1e-4)
    document = json.loads((folder / "out" / "beacons.json").read_text())["covariance"]
    assert document["order"][:4] == ["M1 east", "M1 north", "M1 up", "M2 east"]
    np.testing.assert_allclose(document["m2"], result.covariance, rtol=1e-4, atol=1e-9)


def test_a_garpos_mission_takes_the_surveyed_beacons(folder, tmp_path):
    path = garpos_campaign(tmp_path, beacons=f'"{folder}/out/beacons.json"')
    surveyed = read_beacons(folder / "out" / "beacons.json")
    for beacon in load_mission(path).beacons:
        assert beacon.position.tolist() == surveyed[beacon.name].position.tolist()


def test_result_json(folder, result):
    told = json.loads((folder / "out" / "result.json").read_text())
    assert (told["status"], told["method"]) == ("converged", "known track")
    assert told["verdict"] == result.verdict
    assert sum(b["ranges"] for b in told["beacons"].values()) == 150
    for name, beacon in told["beacons"].items():
        mine = (result.residuals.beacon == name) & ~result.residuals.down_weighted
        rms = np.sqrt(np.mean(result.residuals.residual[mine] ** 2))
        assert beacon["residual_rms_s"] == pytest.approx(rms, rel=1e-3)
        assert beacon["estimated"] and beacon["given_sigma_enu"] == [0.0, 0.0, 0.0]
    assert told["noise"]["range_factor"] == pytest.approx(result.noise.range_factor)
    assert set(told["slow_states"]) == {
        *("sound_speed", "track_error", "vehicle_gradient", "beacon_gradient")
    }
    assert told["leave_one_out"]["reason"] and told["versions"]["ubl-graph"]


def test_tables(folder, result):
    with (folder / "out" / "residuals.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 150 and {r["segment"] for r in rows} == {"S1/L1", "S1/L2"}
    stated = [float(r["residual"]) for r in rows]
    np.testing.assert_allclose(stated, result.residuals.residual, atol=1e-8)
    with (folder / "out" / "slow_states.csv").open() as file:
        rows = list(csv.DictReader(file))
    scale = result.slow["sound_speed"]
    assert [float(r["t"]) for r in rows] == scale.t.tolist()
    told = [float(r["sd_sound_speed_log_factor"]) for r in rows]
    np.testing.assert_allclose(told, scale.sigma[:, 0], rtol=1e-3)


def test_what_is_printed(folder):
    printed = (folder / "printed.txt").read_text()
    assert "status: converged" in printed and "4 beacons surveyed" in printed
    assert all(f"\nM{i} " in printed for i in range(1, 5))


def test_a_sigma_from_the_command_line_is_checked_against(folder, tmp_path):
    out = tmp_path / "out"
    args = ["calibrate", str(folder / "mission.toml"), "-o", str(out), "--sigma", "0.2"]
    done = CliRunner().invoke(app, [*args, "--no-figures"])
    assert done.exit_code == 0, done.output
    told = json.loads((out / "result.json").read_text())
    # The campaign's beacons are given 2 m from where they are.
    assert sorted(told["leave_one_out"]["named"]) == ["M1", "M2", "M3", "M4"]
    assert {p.name for p in out.iterdir()} == FILES


def test_bad_input_writes_nothing(tmp_path):
    (tmp_path / "ranges.csv").write_text(
        "beacon,t_transmit,t_receive,travel_time\nB1,0,2,1.5\nB1,5,7,1.6\n"
    )
    path = tmp_path / "dive.toml"
    path.write_text(
        '[data]\ntwo_way_range = "ranges.csv"\n[sound_speed]\nconstant = 1500.0\n'
        '[[beacon]]\nname = "B1"\nposition = { east = 0.0, north = 0.0, up = -900.0 }\n'
    )
    out = tmp_path / "out"
    done = CliRunner().invoke(app, ["calibrate", str(path), "-o", str(out)])
    assert isinstance(done.exception, UblGraphError)
    assert "nothing says where the track is" in str(done.exception)
    assert "\n" not in str(done.exception) and not out.exists()


def test_an_output_that_is_a_file_is_refused_before_the_work(folder, tmp_path):
    (tmp_path / "out").write_text("")
    args = ["calibrate", str(folder / "mission.toml"), "-o", str(tmp_path / "out")]
    done = CliRunner().invoke(app, args)
    assert isinstance(done.exception, UblGraphError) and "is a file" in str(done.exception)


def test_a_failure_leaves_nothing_half_written(result, tmp_path, monkeypatch):
    def fail(*_args: object) -> None:
        raise RuntimeError("no figure")

    monkeypatch.setattr("ubl_graph.survey_plots.save_all", fail)
    with pytest.raises(RuntimeError):
        write_survey(result, tmp_path / "out")
    assert not list(tmp_path.iterdir())


# Real pings


def saga_mission(folder: Path, data: Path) -> Path:
    name = f"{data}/SAGA.1903.kaiyo_k4"
    path = folder / "saga.toml"
    path.write_text(
        f'[mission]\nname = "SAGA.1903"\n[data]\nformat = "garpos"\n'
        f'observations = "{name}-obs.csv"\nconfig = "{name}-initcfg.ini"\n'
        f'sound_speed = "{name}-svp.csv"\n'
    )
    return path


def saga_errors(result: SurveyResult, data: Path) -> np.ndarray:
    """Positions minus those of GARPOS's own solution, (4, 3), m."""
    solved = read_beacons(data / "SAGA.1903-garpos-solution.json")
    return result.position - [solved[name].position for name in result.names]


@pytest.mark.parametrize("seed", [None, 1, 2])
def test_saga_all_lines_and_circles(saga, tmp_path, seed):
    """From the configuration's positions, and from 30 m off in any direction."""
    mission = load_mission(saga_mission(tmp_path, saga), known_track=True)
    if seed is not None:
        away = np.random.default_rng(seed).standard_normal((4, 3))
        away *= 30.0 / np.linalg.norm(away, axis=1)[:, None]
        beacons = [
            Beacon(b.name, b.position + shift)
            for b, shift in zip(mission.beacons, away, strict=True)
        ]
        mission = replace(mission, beacons=tuple(beacons))
    result = calibrate(mission)
    assert result.status == "converged" and len(result.residuals) == 3614
    assert not result.check.named
    scatter = np.sqrt(np.mean(saga_errors(result, saga) ** 2, axis=0))
    assert (scatter < [0.03, 0.035, 0.02]).all(), scatter
    formal = np.sqrt(np.mean(result.sigma**2, axis=0))
    assert (formal < 2.0 * scatter).all() and (scatter < 2.0 * formal).all()
    kept = ~result.residuals.down_weighted
    assert np.sqrt(np.mean(result.residuals.residual[kept] ** 2)) < 0.07e-3


def test_saga_a_moved_beacon_is_named(saga, tmp_path):
    mission = load_mission(saga_mission(tmp_path, saga), known_track=True)
    beacons = list(mission.beacons)
    beacons[1] = replace(beacons[1], position=beacons[1].position + np.array([24.0, 0.0, 0.0]))
    result = calibrate(replace(mission, beacons=tuple(beacons)))
    assert result.check.named == ("M12",)


def test_saga_circles_alone(saga, tmp_path):
    """The two circles without a line over the array: less is known, and sigmas say so."""
    mission = load_mission(saga_mission(tmp_path, saga), known_track=True)
    circles = tuple(s for s in mission.segments if s.name in ("S01/L05", "S02/L10"))
    assert len(circles) == 2
    result = calibrate(replace(mission, segments=circles), SurveyOptions(fit_noise=False))
    error = saga_errors(result, saga)
    assert (np.abs(error) < 4.0 * result.sigma).all() and result.sigma.max() < 3.0
