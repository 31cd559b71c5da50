"""Failures of the field, through the process: it lives, says what happened, and recovers."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest
from online import moved, records_of, retimed, survey, without

from ubl_graph.online.buffer import entry_of
from ubl_graph.online.json_records import record_content

LAG = 40.0
ALL = ("two_way_range", "velocity", "attitude", "depth")
PING = ("two_way_range",)


def through(folder, mission, records) -> list[dict]:
    """What `ubl-graph live` says to a stream; it ends with exit code 0 and strict JSON alone."""
    beacons = "".join(
        f'[[beacon]]\nname = "{b.name}"\n'
        f"position = {{ east = {b.position[0]}, north = {b.position[1]}, up = {b.position[2]} }}\n"
        for b in mission.beacons
    )
    config = folder / "vehicle.toml"
    config.write_text(f"{beacons}[sound_speed]\nconstant = 1490.0\n[options]\nlag = {LAG}\n")
    lines = [json.dumps(record_content(r)) if not isinstance(r, str) else r for r in records]
    done = subprocess.run(
        [sys.executable, "-m", "ubl_graph", "live", str(config)],
        input="\n".join(lines) + "\n",
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert (done.returncode, done.stderr) == (0, "")
    told = [json.loads(line) for line in done.stdout.splitlines()]
    assert told[-1]["type"] == "health"
    assert told[-1]["internal_errors"] == 0
    stamps = np.array([x["t"] for x in told if x["type"] == "estimate"])
    assert (np.diff(stamps) > 0.0).all()
    return told


def errors(told, truth, after, ahead=0.0):
    """Horizontal errors (m) after a time, and squared distances where the status is ok."""
    gaps, distances = [], []
    for x in told:
        if x["type"] != "estimate" or x["t"] < after or x["east"] is None:
            continue
        place = truth.position(x["t"] - ahead)[0][:2]
        gap = np.array([x["east"], x["north"]]) - place
        gaps.append(float(np.hypot(*gap)))
        if x["status"] == "ok":
            covariance = np.array(x["covariance"]).reshape(6, 6)[:2, :2]
            distances.append(float(gap @ np.linalg.solve(covariance, gap)))
    return np.array(gaps), np.array(distances)


def statuses(told, begin, end):
    return {x["status"] for x in told if x["type"] == "estimate" and begin <= x["t"] < end}


@pytest.fixture(scope="module")
def sea():
    mission, truth = survey(1, lines=2, length=150.0, dvl_rate=2.0, lag=LAG)
    return mission, truth, records_of(mission.segments[0])


def damaged(name, records):
    """A stream with a fault, the time after it has healed for a lag, and the clock's error then."""
    late = 100.0 + LAG + 10.0
    at = next(i for i, r in enumerate(records) if entry_of(r).t > 100.0)
    match name:
        case "blackout":
            return without(records, PING, 60.0, 100.0), late, 0.0
        case "dvl loss":
            return without(records, ("velocity",), 60.0, 100.0), late, 0.0
        case "silence":
            return without(records, ALL, 60.0, 100.0), late, 0.0
        case "clock back":
            return retimed(records, -5.0, 100.0), late, -5.0
        case "a stamp ahead":
            return [*records[:at], moved(records[at], 1e6), *records[at + 1 :]], late, 0.0
        case "junk":
            bad = ["{", '{"type":"depth","t":NaN,"depth":1}', '{"type":"depth","t":1e999}']
            return [*records[:at], *bad, *records[at:]], late, 0.0
        case "reversed":
            return [*records[:at], *reversed(records[at : at + 12]), *records[at + 12 :]], late, 0.0
        case _:
            return [*records[:at], *records[at - 30 : at], *records[at:]], late, 0.0


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("blackout", {"coasting"}),
        ("dvl loss", {"degraded"}),
        ("silence", set()),
        ("clock back", {"degraded"}),
        ("a stamp ahead", set()),
        ("junk", set()),
        ("reversed", set()),
        ("sent twice", set()),
    ],
)
def test_the_process_outlives_a_fault_and_recovers(name, said, sea, tmp_path):
    mission, truth, records = sea
    stream, healed, ahead = damaged(name, records)
    first = next(i for i, r in enumerate(stream) if not isinstance(r, str) and entry_of(r).t > 99.0)
    told = through(
        tmp_path, mission, [*stream[:first], '{"type":"query","t":99.0}', *stream[first:]]
    )
    gaps, distances = errors(told, truth, healed, ahead)
    assert len(gaps) > 10
    assert np.sqrt(np.mean(gaps**2)) < 0.15
    assert np.mean([x["status"] == "ok" for x in told if x.get("t", 0.0) > healed]) > 0.8
    # One run's errors are few independent ones: wide bounds on the mean of two components.
    assert 0.05 < np.mean(distances) < 8.0
    assert said <= statuses(told, 60.0, 130.0)
    refused = [x["reason"] for x in told if x["type"] == "rejected"]
    expected = {"a stamp ahead": "held back", "junk": "JSON", "sent twice": "duplicate"}
    if name in expected:
        assert any(expected[name] in reason for reason in refused)


def test_a_third_of_the_pings_are_outliers(tmp_path):
    mission, truth = survey(3, lines=2, length=150.0, dvl_rate=2.0, lag=LAG, outliers=0.3)
    told = through(tmp_path, mission, records_of(mission.segments[0]))
    gaps, distances = errors(told, truth, 2.0 * LAG)
    assert np.sqrt(np.mean(gaps**2)) < 0.15
    assert 0.05 < np.mean(distances) < 8.0
    refused = told[-1]["sensors"]["two_way_range"]["rejected"]["gated"]
    assert 0.15 < refused / len(mission.segments[0].two_way_range) < 0.45


def test_a_straight_pass_over_one_beacon_is_never_confidently_wrong(tmp_path):
    mission, truth = survey(2, lines=1, length=250.0, dvl_rate=2.0, lag=LAG, beacons=1)
    told = through(tmp_path, mission, records_of(mission.segments[0]))
    _, distances = errors(told, truth, 0.0)
    assert "ambiguous" in statuses(told, 0.0, 1e9)
    assert not len(distances) or distances.max() < 30.0
