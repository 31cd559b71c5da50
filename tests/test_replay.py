"""The replay script: what it feeds, what it counts, what it writes, and how it refuses."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))

import replay as script
import replay_runs as runs

from ubl_graph.measurements import Attitude, Depth, OneWayRange, PositionFix, TwoWayRange, Velocity
from ubl_graph.mission import Reference, Segment
from ubl_graph.online.estimator import Estimate, Event, Outcome
from ubl_graph.options import Options
from ubl_graph.sim import straight_pass

SCRIPT = Path(script.__file__)
LINES = ["S01/L01", "S01/L02", "S01/L04", "S02/L06", "S02/L07", "S02/L08", "S02/L09"]
#: What other programs read.
KEYS = {
    "newest_rmse_m",
    "newest_median_m",
    "half_lag_rmse_m",
    "half_lag_median_m",
    "smoothed_rmse_m",
    "mean_nees",
    "mean_nees_ok",
    "latency_p50_ms",
    "latency_p99_ms",
    "latency_max_ms",
    "rejected",
    "share_ok",
    "reference",
    "updates",
    "segments",
}


def command(*args: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(SCRIPT), *map(str, args)], capture_output=True, text=True
    )


def write(path: Path, header: str, rows: list[list]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header.split(","))
        writer.writerows(rows)


@pytest.fixture
def dive(tmp_path: Path) -> Path:
    """A simulated pass through four beacons, written as a mission file without a reference."""
    mission, _ = straight_pass(duration=120.0)
    (segment,) = mission.segments
    pings, depth = segment.two_way_range, segment.depth
    columns = ("beacon", "t_transmit", "t_receive", "travel_time", "sigma")
    rows = [list(r) for r in zip(*(getattr(pings, c).tolist() for c in columns), strict=True)]
    write(tmp_path / "ranges.csv", ",".join(columns), rows)
    write(
        tmp_path / "depth.csv",
        "t,depth,sigma",
        list(zip(depth.t.tolist(), depth.depth.tolist(), depth.sigma.tolist(), strict=True)),
    )
    beacons = "".join(
        f'[[beacon]]\nname = "{b.name}"\nturnaround = {b.turnaround}\nposition = {{ '
        + ", ".join(f"{n} = {v}" for n, v in zip(("east", "north", "up"), b.position, strict=True))
        + " }\n"
        for b in mission.beacons
    )
    (tmp_path / "dive.toml").write_text(
        f'[mission]\nname = "dive"\n{beacons}[sound_speed]\nconstant = 1490.0\n'
        "[options]\nlag = 40.0\n"
        '[data]\ntwo_way_range = "ranges.csv"\ndepth = "depth.csv"\n'
    )
    return tmp_path


def spoil(path: Path, row: int, column: str, change) -> None:
    with path.open() as file:
        rows = list(csv.DictReader(file))
    rows[row][column] = change(rows[row][column])
    write(path, ",".join(rows[0]), [list(r.values()) for r in rows])


def test_a_mission_without_a_reference_is_compared_with_the_smoothed_track(dive):
    # One ping took a detour of 75 m.
    spoil(dive / "ranges.csv", 20, "travel_time", lambda s: repr(float(s) + 0.1))
    spoil(dive / "ranges.csv", 20, "t_receive", lambda s: repr(float(s) + 0.1))
    written, figure = dive / "numbers.json", dive / "errors.png"
    done = command(dive / "dive.toml", "--json", written, "--figure", figure, "--worst", "2")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert "There is no reference: the smoothed track" in done.stdout
    assert done.stdout.count(" s: ") == 2
    numbers = json.loads(written.read_text())
    assert numbers.keys() >= KEYS
    assert not any(isinstance(v, (dict, list)) for v in numbers.values())
    assert numbers["reference"] == "smoothed"
    assert numbers["smoothed_rmse_m"] is None
    assert (numbers["updates"], numbers["segments"], numbers["rejected"]) == (30, 1, 1)
    # 29 pings are 4 s apart, and the lag is 40 s.
    assert 18 <= numbers["scored"] <= 20
    assert 0.0 < numbers["half_lag_median_m"] < numbers["newest_median_m"] < 1.0
    assert 0.0 < numbers["latency_p50_ms"] <= numbers["latency_p99_ms"] <= numbers["latency_max_ms"]
    assert 0.0 <= numbers["share_ok"] <= 1.0
    assert figure.read_bytes().startswith(b"\x89PNG")
    left = {p.name for p in dive.iterdir()}
    assert left == {"dive.toml", "ranges.csv", "depth.csv", "numbers.json", "errors.png"}


BAD = {
    "no file": (["none.toml"], "none.toml"),
    "no mission": ([], "MISSION.toml"),
    "engine": (["dive.toml", "--engine", "ekf"], "'ekf'"),
    "lag": (["dive.toml", "--lag", "-3"], "lag"),
    "lag that is no number": (["dive.toml", "--lag", "long"], "'long'"),
    "speed": (["dive.toml", "--real-time", "0"], "--real-time"),
    "segment": (["dive.toml", "--segment", "L01"], "'L01'"),
    "worst": (["dive.toml", "--worst", "-1"], "--worst"),
    "nothing to compare with": (["dive.toml", "--no-smooth"], "--no-smooth"),
    "json without folder": (["dive.toml", "--json", "none/a.json"], "no such folder"),
    "figure without folder": (["dive.toml", "--figure", "none/a.png"], "no such folder"),
    "json is a folder": (["dive.toml", "--json", "."], "is a folder"),
    "figure of another kind": (["dive.toml", "--figure", "a.pdf"], ".png"),
    "bad data": (["bad.toml"], "travel_time"),
}


@pytest.mark.parametrize(("arguments", "named"), BAD.values(), ids=BAD)
def test_bad_input_is_one_line(dive, arguments, named, monkeypatch, capsys):
    bad = (dive / "dive.toml").read_text().replace("ranges.csv", "bad.csv")
    (dive / "bad.toml").write_text(bad)
    (dive / "bad.csv").write_text((dive / "ranges.csv").read_text())
    spoil(dive / "bad.csv", 3, "travel_time", lambda _: "-1.0")
    before = sorted(p.name for p in dive.iterdir())
    monkeypatch.chdir(dive)
    monkeypatch.setattr(runs, "run", lambda *_: pytest.fail("it began"))
    try:
        code = script.main(arguments)
    except SystemExit as stop:
        code = stop.code
    assert code == 2
    said = capsys.readouterr()
    assert said.out == ""
    (line,) = said.err.splitlines()
    assert line.startswith("replay: ")
    assert named in line
    assert sorted(p.name for p in dive.iterdir()) == before


def test_the_process_says_the_same(dive):
    done = command(dive / "none.toml")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert "Traceback" not in done.stderr


def test_an_interrupt_is_one_line_and_leaves_nothing(dive, monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(runs, "run", interrupted)
    (dive / "a.json").write_text("mine")
    assert script.main([str(dive / "dive.toml"), "--json", str(dive / "a.json")]) == 130
    assert capsys.readouterr().err == "replay: interrupted\n"
    assert (dive / "a.json").read_text() == "mine"


def test_a_figure_that_fails_leaves_no_numbers(dive, monkeypatch, capsys):
    import replay_figure

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(replay_figure, "draw", full)
    arguments = ["--json", str(dive / "a.json"), "--figure", str(dive / "a.png")]
    assert script.main([str(dive / "dive.toml"), *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "a.png" in line
    assert "No space left on device" in line
    assert not [p for p in dive.iterdir() if p.name.startswith((".", "a."))]


def test_a_lag_longer_than_the_mission_scores_nothing_and_says_so(dive, capsys):
    written = dive / "a.json"
    arguments = [str(dive / "dive.toml"), "--lag", "500", "--json", str(written)]
    assert script.main(arguments) == 0
    assert "nothing is scored" in capsys.readouterr().err
    numbers = json.loads(written.read_text())
    assert numbers["newest_rmse_m"] is None
    assert numbers["mean_nees"] is None
    assert (numbers["scored"], numbers["updates"], numbers["lag_s"]) == (0, 30, 500.0)


def test_records_arrive_when_they_are_complete_and_pings_last():
    segment = Segment(
        two_way_range=TwoWayRange("B1", [0.0, 2.0], [5.0, 4.0], [4.0, 1.5]),
        one_way_range=OneWayRange("B1", 4.5, 5.0),
        velocity=Velocity([5.0, 1.0], 1.0, 0.0, 0.0),
        attitude=Attitude(5.0, 0.0, 0.0, 0.0),
        depth=Depth([5.0, 4.0], 3.0),
        position=PositionFix(5.0, 0.0, 0.0, sigma=1.0),
    )
    got = [(t, ping, type(r).__name__, len(r)) for t, ping, r in runs.arrivals(segment)]
    assert got == [
        (1.0, False, "Velocity", 1),
        (4.0, False, "Depth", 1),
        (4.0, True, "TwoWayRange", 1),
        (5.0, False, "Attitude", 1),
        (5.0, False, "Velocity", 1),
        (5.0, False, "Depth", 1),
        (5.0, False, "PositionFix", 1),
        (5.0, True, "TwoWayRange", 1),
        (5.0, True, "OneWayRange", 1),
    ]
    assert runs.count(segment) == len(got)


class Stand:
    """An estimator whose answers are known: 3 m east of the truth, 1 m half a lag later."""

    def __init__(self, fates: list[Outcome]) -> None:
        self.fates = fates

    @classmethod
    def with_fates(cls, fates):
        made = cls(fates)
        return type("Made", (), {"of": staticmethod(lambda _: made)})

    def add(self, record):
        outcome = self.fates.pop(0)
        self.first = getattr(self, "first", record)
        others = tuple(replace(e, record=self.first) for e in outcome.others)
        return replace(outcome, others=others)

    def estimate(self, t):
        status = "ok" if t < 75.0 else "coasting"
        covariance = np.diag([9.0 if t < 75.0 else 1.0, *[1.0] * 5])
        return Estimate(t, np.array([t + 3.0, 0.0, 0.0]), np.zeros(3), covariance, status)

    def smoothed(self, t):
        from ubl_graph.trajectory import States

        place, cubes = np.array([[t + 1.0, 0.0, 0.0]]), np.eye(3)[None]
        return States(np.array([t]), place, place, cubes, cubes)

    def flush(self):
        return ()


@pytest.fixture
def scored(monkeypatch) -> runs.Score:
    """Ten pings, 10 s apart: the first is refused at last, the second first, the third always."""
    turned = (Event("rejected", "", Depth(0.0, 0.0), False),)
    refused = Outcome(False, "gated", False)
    fates = [Outcome(True), Outcome(True), refused, Outcome(True, others=turned)]
    fates += [Outcome(True)] * 6
    monkeypatch.setattr(runs, "FixedLagEstimator", Stand.with_fates(fates))
    mission, _ = straight_pass()
    t = np.arange(10.0, 101.0, 10.0)
    segment = Segment("S", TwoWayRange("B1", t - 1.0, t, 0.9))
    known = np.arange(0.0, 96.0, 5.0)
    truth = runs.of_reference(Reference(known, known[:, None] * [1.0, 0.0, 0.0]))
    setup = replace(mission.setup, options=Options(lag=40.0))
    return runs.score(runs.run(segment, setup, runs.Pace()), truth, truth)


def test_the_numbers_are_what_they_are_called(scored):
    numbers = runs.summary([scored])
    # The pings at 60 to 100 s are later than a lag after the first; the truth ends at 95 s.
    assert (numbers["scored"], numbers["half_lag_scored"], numbers["updates"]) == (4, 5, 10)
    assert numbers["newest_rmse_m"] == pytest.approx(3.0)
    assert numbers["newest_median_m"] == pytest.approx(3.0)
    assert numbers["half_lag_rmse_m"] == pytest.approx(1.0)
    assert numbers["half_lag_mean_nees"] == pytest.approx(1.0)
    assert numbers["mean_nees"] == pytest.approx((1.0 + 1.0 + 9.0 + 9.0) / 4.0)
    assert numbers["mean_nees_ok"] == pytest.approx(1.0)
    assert numbers["share_ok"] == pytest.approx(0.4)
    assert numbers["smoothed_rmse_m"] == 0.0
    assert numbers["rejected"] == 2
    both = runs.summary([scored, scored])
    assert (both["scored"], both["rejected"], both["segments"]) == (8, 4, 2)


def test_what_was_readmitted_is_not_rejected():
    tally, ping = runs._Tally(), TwoWayRange("B1", 0.0, 1.0, 0.9)
    tally.note(ping, Outcome(False, "gated", False))
    assert tally.pings({ping}) == 1
    tally.note(Depth(0.0, 1.0), Outcome(False, others=(Event("readmitted", "", ping, False),)))
    assert tally.pings({ping}) == 0


def test_pings_before_a_position_are_unanswered(monkeypatch):
    nowhere = Estimate(70.0, None, None, None, "initialising")
    monkeypatch.setattr(Stand, "estimate", lambda _, t: replace(nowhere, t=t))
    fates = [Outcome(True)] * 10
    monkeypatch.setattr(runs, "FixedLagEstimator", Stand.with_fates(fates))
    t = np.arange(10.0, 101.0, 10.0)
    segment = Segment("S", TwoWayRange("B1", t - 1.0, t, 0.9))
    setup = replace(straight_pass()[0].setup, options=Options(lag=40.0))
    run = runs.run(segment, setup, runs.Pace())
    numbers = runs.summary([runs.score(run, lambda t: np.zeros((len(t), 2)), None)])
    assert (numbers["unanswered"], numbers["scored"], numbers["share_ok"]) == (5, 0, 0.0)
    assert numbers["newest_rmse_m"] is None


def test_a_reference_is_known_within_its_span():
    t = np.array([0.0, 1.0, 1.0, 4.0])
    truth = runs.of_reference(Reference(t, t[:, None] * [1.0, 2.0, 3.0]))
    got = truth(np.array([-0.1, 0.0, 0.5, 1.0, 2.5, 4.0, 4.1]))
    assert np.isnan(got[[0, -1]]).all()
    np.testing.assert_allclose(got[1:-1, 0], [0.0, 0.5, 1.0, 2.5, 4.0], atol=1e-12)
    np.testing.assert_allclose(got[1:-1, 1], 2.0 * got[1:-1, 0], atol=1e-12)
    lone = runs.of_reference(Reference(np.zeros(1), np.zeros((1, 3))))
    assert np.isnan(lone(np.zeros(2))).all()


def test_real_time_waits_and_notes_who_waited():
    pace = runs.Pace(100.0)
    begin = time.perf_counter()
    pace.wait(1000.0)
    time.sleep(0.03)
    pace.wait(1001.0)
    assert pace.behind > 0.015
    pace.wait(1010.0)
    assert time.perf_counter() - begin >= 0.1
    free = runs.Pace()
    free.wait(0.0)
    free.wait(1e6)
    assert free.behind == 0.0


def test_a_replay_in_real_time_takes_its_time(dive, capsys):
    begin = time.perf_counter()
    assert script.main([str(dive / "dive.toml"), "--real-time", "60"]) == 0
    assert time.perf_counter() - begin > 1.9
    assert "Longest wait of a record" in capsys.readouterr().out


@pytest.fixture(scope="module")
def campaign(tmp_path_factory, saga: Path) -> Path:
    path = tmp_path_factory.mktemp("saga") / "saga.toml"
    start = saga / "SAGA.1903.kaiyo_k4"
    path.write_text(
        '[mission]\nname = "SAGA.1903"\n[data]\nformat = "garpos"\n'
        f'observations = "{start}-obs.csv"\nconfig = "{start}-initcfg.ini"\n'
        f'sound_speed = "{start}-svp.csv"\nbeacons = "{saga}/SAGA.1903-garpos-solution.json"\n'
        f"lines = {json.dumps(LINES)}\n"
    )
    return path


def replayed(campaign: Path, folder: Path, *arguments: str) -> dict:
    written = folder / "a.json"
    done = command(campaign, "--json", written, *arguments)
    assert done.returncode == 0, done.stderr
    return json.loads(written.read_text())


def test_a_line_of_real_pings(campaign, tmp_path):
    numbers = replayed(campaign, tmp_path, "--segment", "S02/L07")
    assert numbers.keys() >= KEYS
    assert (numbers["reference"], numbers["updates"], numbers["segments"]) == ("reference", 288, 1)
    assert numbers["newest_rmse_m"] < 0.98
    assert numbers["half_lag_rmse_m"] < 0.68
    assert numbers["smoothed_rmse_m"] < 0.4


def test_the_smoothed_track_can_be_left_out(campaign, tmp_path):
    numbers = replayed(campaign, tmp_path, "--segment", "S01/L02", "--no-smooth", "--lag", "40")
    assert numbers["smoothed_rmse_m"] is None
    assert numbers["lag_s"] == 40.0
    assert numbers["newest_median_m"] < 1.0


def test_the_reference_between_its_times(campaign):
    """Half the times predict the other half: what interpolation is worth over twice the gaps."""
    mission = script.loaded(script.parser().parse_args([str(campaign)]))
    gaps = []
    for segment in mission.segments:
        t, place = segment.reference.t, segment.reference.position
        truth = runs.of_reference(Reference(t[::2], place[::2]))
        gaps.append(np.hypot(*(truth(t[1::2]) - place[1::2, :2]).T))
    gap = np.concatenate(gaps)
    assert np.sqrt(np.nanmean(gap**2)) < 0.5


@pytest.mark.slow
def test_seven_lines_of_real_pings(campaign, tmp_path):
    numbers = replayed(campaign, tmp_path)
    assert (numbers["updates"], numbers["segments"]) == (1886, 7)
    assert numbers["newest_rmse_m"] <= 0.98
    assert numbers["newest_median_m"] <= 0.45
    assert numbers["half_lag_rmse_m"] <= 0.68
    assert numbers["share_ok"] > 0.95
