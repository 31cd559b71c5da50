"""Mission files of fleets: what a good one holds, and what is said of every kind of bad one."""

from __future__ import annotations

import csv
import doctest
import json
import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from fleet_page import EXAMPLE, PAGE, write_example

from ubl_graph import (
    Beacon,
    Fleet,
    Member,
    Odometry,
    Options,
    PositionFix,
    Segment,
    SlantRange,
    SoundSpeedProfile,
    Target,
    load_fleet,
    load_mission,
    load_setup,
    smooth_fleet,
)
from ubl_graph.cooperative.result import FleetResult
from ubl_graph.errors import ConfigurationError, DataError
from ubl_graph.fleet_plots import MOST_PAIRS, fleet_map, fleet_residuals
from ubl_graph.io import fleet_result_files
from ubl_graph.io.fleet_result_files import vehicle_folders, write_fleet_result
from ubl_graph.io.fleet_schema import OF_THE_WHOLE
from ubl_graph.mission import Reference


@pytest.fixture
def folder(tmp_path) -> Path:
    write_example(tmp_path)
    return tmp_path


def spoilt(folder: Path, file: str, old: str, new: str) -> Path:
    """Replace one place in one file of the example; the mission file."""
    text = (folder / file).read_text(encoding="utf-8")
    assert text.count(old) >= 1
    (folder / file).write_text(text.replace(old, new, 1), encoding="utf-8")
    return folder / "fleet.toml"


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


# What a good file holds


def test_the_page_has_the_files_of_its_example():
    assert set(EXAMPLE) == {"fleet.toml", "boat-gnss.csv", "auv-odometry.csv", "ranges.csv"}


def test_the_examples_in_python_give_what_the_page_says():
    talk = "\n".join(re.findall(r"^```python\n(>>>.*?)^```$", PAGE, re.MULTILINE | re.DOTALL))
    test = doctest.DocTestParser().get_doctest(talk, {}, "fleet.md", "fleet.md", 0)
    assert len(test.examples) > 10
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    assert doctest.DocTestRunner(optionflags=flags).run(test).failed == 0


def test_a_good_file(folder):
    fleet = load_fleet(folder / "fleet.toml")
    assert fleet.name == "wreck-survey"
    assert fleet.vehicle_names == ("boat", "auv")
    assert fleet.target_names == ("wreck",)
    boat, auv = fleet.vehicles
    assert (boat.options.node, auv.options.node) == ("point", "pose2")
    assert fleet.options.travel_time_sigma == auv.options.travel_time_sigma == 5e-4
    assert auv.segment.start is not None
    assert (auv.segment.start.t, auv.segment.start.up, auv.segment.start.heading) == (0, -50, 0)
    assert boat.segment.start is None
    (wreck,) = fleet.targets
    np.testing.assert_array_equal(wreck.position, [250.0, 100.0, -80.0])
    np.testing.assert_array_equal(wreck.sigma, [200.0, 200.0, 1.0])
    rows = rows_of(folder / "ranges.csv")
    for member in fleet.vehicles:
        mine = [r for r in rows if r["vehicle"] == member.name]
        pings = member.segment.two_way_range
        assert pings is not None
        assert pings.beacon.tolist() == [r["peer"] for r in mine]
        np.testing.assert_array_equal(pings.travel_time, [float(r["travel_time"]) for r in mine])
        np.testing.assert_array_equal(pings.sigma, 5e-4)


def test_every_key_that_the_page_lists_is_read(folder):
    (folder / "fleet.toml").write_text(
        """
[mission]
name = "all"
origin = { latitude = 34.96, longitude = 139.26 }
[[beacon]]
name = "B1"
position = { east = 0, north = 0, up = -100 }
[sound_speed]
constant = 1480
[options]
loss = "huber"
travel_time_sigma = 2e-4
[[vehicle]]
name = "A"
transducer = { forward = 0.5, down = 0.2 }
antenna = { down = -1 }
dvl = { right = 0.1 }
depth_sensor = { forward = 0.2 }
[vehicle.options]
node = "pose2"
travel_time_sigma = 3e-4
clock_offset_sigma = 1e-5
clock_drift_sigma = 1e-9
[vehicle.data]
two_way_range = "own.csv"
position = "boat-gnss.csv"
[[vehicle]]
name = "B"
[vehicle.data]
one_way_range = "heard.csv"
position = "boat-gnss.csv"
[[target]]
name = "known"
position = { latitude = 34.96, longitude = 139.26, height = -90 }
sigma = 30
velocity_sigma = [0.5, 0.5, 0]
t = 12
[[target]]
name = "unknown"
[data]
format = "csv"
two_way_range = "two.csv"
one_way_range = "one.csv"
slant_range = "slant.csv"
"""
    )
    (folder / "own.csv").write_text(
        "beacon,t_transmit,t_receive,travel_time\nB1,1,1.4,0.4\nknown,2,2.4,0.4\n"
    )
    (folder / "heard.csv").write_text("beacon,t_transmit,t_receive,sigma\nA,30,30.2,1e-3\n")
    (folder / "two.csv").write_text(
        "vehicle,peer,t_transmit,t_receive,slant_range,sound_speed\nB,A,5,5.4,300,1500\n"
        "A,B1,6,6.4,150,1500\n"
    )
    (folder / "one.csv").write_text(
        "peer,vehicle,t_receive,t_transmit\nA,B,7.2,7\nB,A,8.2,8\nB1,A,9.1,9\n"
    )
    (folder / "slant.csv").write_text("vehicle,peer,t,distance,sigma\nB,unknown,9,120,2\n")
    fleet = load_fleet(folder / "fleet.toml")
    first, second = fleet.vehicles
    assert fleet.origin is not None
    assert fleet.sound_speed.speed[0] == 1480
    assert fleet.beacon_names == ("B1",)
    assert first.vehicle.transducer.forward == 0.5
    assert first.vehicle.antenna.down == -1
    assert first.vehicle.dvl.right == 0.1
    assert first.vehicle.depth_sensor.forward == 0.2
    assert first.options.clock_offset_sigma == 1e-5
    two = first.segment.two_way_range
    assert two is not None
    assert two.beacon.tolist() == ["B1", "known", "B1"]
    np.testing.assert_allclose(two.travel_time, [0.4, 0.4, 0.2])
    np.testing.assert_array_equal(two.sigma, 3e-4)
    assert second.segment.two_way_range is not None
    assert second.segment.two_way_range.sigma.tolist() == [2e-4]
    one = second.segment.one_way_range
    assert one is not None
    assert one.t_transmit.tolist() == [30, 7]
    assert one.sigma.tolist() == [1e-3, 2e-4]
    assert first.segment.one_way_range is not None
    assert first.segment.one_way_range.beacon.tolist() == ["B", "B1"]
    slant = second.segment.slant_range
    assert slant is not None
    assert (slant.beacon.tolist(), slant.distance.tolist()) == (["unknown"], [120])
    known, unknown = fleet.targets
    np.testing.assert_allclose(known.position, [0, 0, -90], atol=1e-9)
    assert known.velocity_sigma.tolist() == [0.5, 0.5, 0]
    assert known.t == 12
    assert unknown.position is None
    assert fleet.options_of(second).loss == "huber"


def test_what_belongs_to_the_whole_is_what_a_fleet_takes_from_it(folder):
    fleet = load_fleet(folder / "fleet.toml")
    other = {"loss": "none", "solver": "gtsam", "max_iterations": 7, "rays": "eigenray"}
    other["estimate_beacons"] = True
    assert other.keys() == set(OF_THE_WHOLE)
    member = replace(fleet.vehicles[0], options=Options(**other))
    taken = replace(fleet, vehicles=(member, *fleet.vehicles[1:])).options_of(member)
    ignored = {f.name for f in fields(Options) if getattr(taken, f.name) != other.get(f.name)}
    assert ignored >= set(OF_THE_WHOLE)
    for name in OF_THE_WHOLE:
        assert getattr(taken, name) == getattr(fleet.options, name)


# What is said of bad files

RANGES = "ranges.csv"
FIRST = EXAMPLE[RANGES].splitlines()[1]
THIRD = EXAMPLE[RANGES].splitlines()[3]
TARGET_LINE = EXAMPLE["fleet.toml"].splitlines().index("[[target]]") + 1
#: Name, file, what is replaced, by what, the kind of error, and words that it must hold.
BAD = {
    "unknown end": (
        *(RANGES, THIRD, THIRD.replace("auv,boat", "auv,baot"), DataError),
        *("ranges.csv, row 3 (line 4), field 'peer'", "did you mean 'boat'?", "'baot'"),
    ),
    "range to itself": (
        *(RANGES, THIRD, THIRD.replace("auv,boat", "auv,auv"), DataError),
        *("ranges.csv, row 3 (line 4), field 'peer'", "vehicle 'auv' to itself"),
    ),
    "unknown vehicle": (
        *(RANGES, THIRD, THIRD.replace("auv,boat", "auvv,boat"), DataError),
        *("ranges.csv, row 3 (line 4), field 'vehicle'", "'auvv'", "did you mean 'auv'?"),
    ),
    "a target measures": (
        *(RANGES, THIRD, THIRD.replace("auv,boat", "wreck,boat"), DataError),
        *("ranges.csv, row 3 (line 4), field 'vehicle'", "'wreck'", "known: boat, auv"),
    ),
    "no end": (
        *(RANGES, THIRD, THIRD.replace("auv,boat", "auv,"), DataError),
        *("ranges.csv, row 3 (line 4), field 'peer'", "the value is missing"),
    ),
    "a negative travel time": (
        *(RANGES, THIRD, ",".join([*THIRD.split(",")[:4], "-0.3"]), DataError),
        *("ranges.csv, row 3 (line 4), field 'travel_time'", "-0.3 s is outside"),
    ),
    "no number": (
        *(RANGES, THIRD, ",".join([*THIRD.split(",")[:4], "x"]), DataError),
        *("ranges.csv, row 3 (line 4), field 'travel_time'", "'x' is not a number"),
    ),
    "the same range twice": (
        *(RANGES, THIRD, FIRST, DataError),
        *("ranges.csv, row 3 (line 4)", "duplicate"),
    ),
    "missing column peer": (
        *(RANGES, "vehicle,peer,", "vehicle,beacon,", DataError),
        *("ranges.csv, field 'peer'", "the column 'peer' is missing", "columns found: vehicle"),
    ),
    "a slip for an optional column": (
        *(RANGES, "travel_time", "travel_tiem", DataError),
        *("ranges.csv, field 'travel_tiem'", "did you mean 'travel_time'?"),
    ),
    "clocks hours apart": (
        *(RANGES, THIRD, "auv,boat,7245,7245.2,0.2", DataError),
        *("ranges.csv, row 3 (line 4)", "clocks of 'auv' and 'boat' seem to differ by"),
    ),
    "missing file of the fleet": (
        *("fleet.toml", '"ranges.csv"', '"range.csv"', DataError),
        *("range.csv", "there is no such file", "did you mean 'ranges.csv'?"),
    ),
    "missing file of a vehicle": (
        *("fleet.toml", '"auv-odometry.csv"', '"auv-odo.csv"', DataError),
        *("auv-odo.csv", "there is no such file"),
    ),
    "a bad row of a vehicle's own file": (
        *("boat-gnss.csv", "\n20,", "\n20s,", DataError),
        *("boat-gnss.csv, row 2 (line 3), field 't'", "'20s' is not a number"),
    ),
    "vehicle named twice": (
        *("fleet.toml", 'name = "auv"', 'name = "boat"', ConfigurationError),
        *("fleet.toml, field 'vehicle.name'", "'boat' is there twice"),
    ),
    "target named as a vehicle": (
        *("fleet.toml", 'name = "wreck"\n', 'name = "auv"\n', ConfigurationError),
        *("fleet.toml, field 'target.name'", "'auv' is there twice"),
    ),
    "target named as a beacon": (
        *(
            "fleet.toml",
            "[[target]]",
            BEACON := "[[beacon]]\nname = 'wreck'\nposition = "
            "{ east = 0, north = 0, up = 0 }\n[[target]]",
            ConfigurationError,
        ),
        *("fleet.toml, field 'target.name'", "'wreck' is there twice"),
    ),
    "unknown key of a vehicle": (
        *("fleet.toml", "[vehicle.data]\nodometry", "[vehicle.data]\nodometer", ConfigurationError),
        *("vehicle 'auv', field 'vehicle.data.odometer'", "did you mean 'odometry'?"),
    ),
    "unknown option of a vehicle": (
        *("fleet.toml", 'node = "pose2"', 'nodes = "pose2"', ConfigurationError),
        *("vehicle 'auv', field 'vehicle.options.nodes'", "did you mean 'node'?"),
    ),
    "option that is not one of the words": (
        *("fleet.toml", 'node = "pose2"', 'node = "pose4"', ConfigurationError),
        *("vehicle 'auv', field 'vehicle.options.node'", "'pose4' is not allowed"),
    ),
    "option of the wrong kind": (
        *("fleet.toml", "travel_time_sigma = 5e-4", "travel_time_sigma = [1]", ConfigurationError),
        *("fleet.toml, field 'options.travel_time_sigma'", "[1] is not a number or 'auto'"),
    ),
    "option out of range": (
        *(
            "fleet.toml",
            'node = "pose2"',
            'node = "pose2"\ngyro_bias_sigma = -1',
            ConfigurationError,
        ),
        *("fleet.toml, vehicle 'auv', field 'vehicle.options.gyro_bias_sigma'", "-1"),
    ),
    "option of the whole": (
        *("fleet.toml", 'node = "pose2"', 'loss = "huber"', ConfigurationError),
        *("vehicle 'auv', field 'vehicle.options.loss'", "put it into [options]"),
    ),
    "option left to the data": (
        *(
            "fleet.toml",
            "travel_time_sigma = 5e-4",
            'acceleration_psd = "auto"',
            ConfigurationError,
        ),
        *("fleet.toml, field 'options.acceleration_psd'", "auto"),
    ),
    "unknown key of a target": (
        *("fleet.toml", "sigma = [200.0, 200.0, 1.0]", "sgima = 200", ConfigurationError),
        *("target 'wreck', field 'target.sgima'", "did you mean 'sigma'?"),
    ),
    "sigma of a target": (
        *("fleet.toml", "[200.0, 200.0, 1.0]", "[200.0, 1.0]", ConfigurationError),
        *("target 'wreck', field 'target.sigma'", "neither a number nor [east, north, up]"),
    ),
    "negative sigma of a target": (
        *("fleet.toml", "[200.0, 200.0, 1.0]", "-3", DataError),
        *("fleet.toml, target 'wreck', field 'target.sigma'", "outside 0 to 100000 m"),
    ),
    "position of a target": (
        *("fleet.toml", "north = 100.0, up", "nort = 100.0, up", ConfigurationError),
        *("target 'wreck', field 'target.position.nort'", "did you mean 'north'?"),
    ),
    "position of a target in degrees": (
        *(
            "fleet.toml",
            "{ east = 250.0, north = 100.0, up = -80.0 }",
            "{ latitude = 3, longitude = 4, height = -80.0 }",
            ConfigurationError,
        ),
        *("fleet.toml, target 'wreck', field 'target.position'", "need an origin"),
    ),
    "half a position": (
        *("fleet.toml", ", up = -80.0 }", " }", ConfigurationError),
        *("fleet.toml, target 'wreck', field 'target.position'", "give east, north and up"),
    ),
    "one target's table": (
        *("fleet.toml", "[[target]]", "[target]", ConfigurationError),
        *("fleet.toml, field 'target'", "each target's table starts with [[target]]"),
    ),
    "start of a vehicle": (
        *("fleet.toml", "sigma = 20.0", "sigma = -20.0", ConfigurationError),
        *("fleet.toml, vehicle 'auv', field 'vehicle.start.sigma'", "-20.0 m"),
    ),
    "start of all": (
        *(
            "fleet.toml",
            "[[vehicle]]",
            "[start]\nt = 0\neast = 0\nnorth = 0\n[[vehicle]]",
            ConfigurationError,
        ),
        *("fleet.toml, field 'start'", "put it into [vehicle.start]"),
    ),
    "heading of a point": (
        *("fleet.toml", 'node = "pose2"', 'node = "point"', ConfigurationError),
        *("fleet.toml", "heading", "'point'"),
    ),
    "lever arm": (
        *(
            "fleet.toml",
            'name = "auv"',
            'name = "auv"\ntransducer = { down = 1e9 }',
            ConfigurationError,
        ),
        *("fleet.toml, vehicle 'auv', field 'vehicle.transducer.down'", "1000000000.0"),
    ),
    "vehicle without a name": (
        *("fleet.toml", 'name = "auv"\n', "", ConfigurationError),
        *("fleet.toml, vehicle number 2, field 'vehicle.name'", "the key is missing"),
    ),
    "vehicle with an empty name": (
        *("fleet.toml", 'name = "auv"\n', 'name = ""\n', ConfigurationError),
        *("fleet.toml, field 'vehicle.name'", "the name is empty"),
    ),
    "data of one vehicle at the top": (
        *("fleet.toml", "two_way_range", "velocity", ConfigurationError),
        *("fleet.toml, field 'data.velocity'", "belongs into [vehicle.data]"),
    ),
    "another format": (
        *("fleet.toml", "two_way_range", 'format = "pyfg"\ntwo_way_range', ConfigurationError),
        *("fleet.toml, field 'data.format'", "'pyfg' is not allowed; known: csv"),
    ),
    "no sound speed": (
        *("fleet.toml", "[sound_speed]\nconstant = 1500.0\n", "", ConfigurationError),
        *("fleet.toml, field 'sound_speed'", "add [sound_speed]"),
    ),
    "no TOML": (
        *("fleet.toml", "[[target]]", "[[target]", ConfigurationError),
        *(f"fleet.toml, line {TARGET_LINE}", "no TOML"),
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_refused(folder, case):
    file, old, new, kind, *words = BAD[case]
    path = spoilt(folder, file, old, new)
    with pytest.raises(DataError) as caught:
        load_fleet(path)
    text = str(caught.value)
    assert type(caught.value) is kind
    assert "\n" not in text
    for word in words:
        assert word in text


def test_the_line_that_the_page_shows(folder, monkeypatch):
    (line,) = re.findall(r"^    (ranges\.csv, .*)$", PAGE, re.MULTILINE)
    spoilt(folder, RANGES, THIRD, THIRD.replace("auv,boat", "auv,baot"))
    monkeypatch.chdir(folder)
    with pytest.raises(DataError) as caught:
        load_fleet("fleet.toml")
    assert str(caught.value) == line


def test_no_data_at_all(folder):
    text = (folder / "fleet.toml").read_text()
    text = re.sub(r'^(position|odometry|two_way_range) = ".*\n', "", text, flags=re.MULTILINE)
    (folder / "fleet.toml").write_text(text)
    with pytest.raises(ConfigurationError, match="field 'data': no data file is named"):
        load_fleet(folder / "fleet.toml")


def test_rows_of_two_files_keep_their_places(folder):
    path = spoilt(
        folder, "fleet.toml", 'odometry = "auv', 'two_way_range = "own.csv"\nodometry = "auv'
    )
    (folder / "own.csv").write_text(
        "beacon,t_transmit,t_receive,travel_time\nboat,1,1.3,0.3\nwreck,2,2.3,0.3\n"
    )
    fleet = load_fleet(path)
    pings = fleet.vehicles[1].segment.two_way_range
    assert pings is not None
    assert len(pings) == 2 + 18
    found = [str(pings[i:].error(0, "beacon", "p")).split(": ")[0] for i in (1, 2, 14)]
    assert [text.removeprefix(f"{folder}/") for text in found] == [
        "own.csv, row 2 (line 3), field 'beacon'",
        "ranges.csv, row 1 (line 2), field 'peer'",
        "ranges.csv, row 19 (line 20), field 'peer'",
    ]
    (folder / "own.csv").write_text(
        "beacon,t_transmit,t_receive,travel_time\nboat,1,1.3,0.3\nwrek,2,2.3,0.3\n"
    )
    with pytest.raises(DataError, match=r"own\.csv, row 2 \(line 3\), field 'beacon'.*'wreck'"):
        load_fleet(path)
    # The same range in both files.
    header, ping = EXAMPLE[RANGES].splitlines()[:2]
    (folder / "own.csv").write_text(
        header.replace("vehicle,peer", "beacon") + "\n" + ping.removeprefix("auv,") + "\n"
    )
    with pytest.raises(DataError, match=r"ranges\.csv, row 1 \(line 2\).*duplicate"):
        load_fleet(path)


def test_vehicles_state_no_turnaround(folder):
    path = spoilt(folder, RANGES, "travel_time", "remark")
    with pytest.raises(ConfigurationError) as caught:
        load_fleet(path)
    text = str(caught.value)
    assert "ranges.csv, row 1 (line 2), field 'travel_time'" in text
    assert "'boat' states no turnaround" in text
    assert text.endswith("add a column travel_time")
    (folder / RANGES).write_text("vehicle,peer,t_transmit,t_receive\nauv,bot,0,1\n")
    with pytest.raises(DataError, match=r"row 1 \(line 2\), field 'peer': unknown beacon, vehicle"):
        load_fleet(path)


def test_beacons_of_a_fleet_state_their_turnaround(folder):
    path = spoilt(
        *(folder, "fleet.toml", "[[target]]"),
        "[[beacon]]\nname = 'B'\nposition = { east = 0, north = 0, up = 0 }\nturnaround = 0.5\n"
        "[[target]]",
    )
    (folder / RANGES).write_text("vehicle,peer,t_transmit,t_receive\nauv,B,1,1.75\n")
    pings = load_fleet(path).vehicles[1].segment.two_way_range
    assert pings is not None
    np.testing.assert_allclose(pings.travel_time, 0.25)


def test_functions_for_one_vehicle_name_those_for_a_fleet(folder):
    path = folder / "fleet.toml"
    with pytest.raises(ConfigurationError, match=r"'vehicle'.*load_fleet.*ubl-graph smooth"):
        load_mission(path)
    with pytest.raises(ConfigurationError, match=r"field 'vehicle'.*FleetEstimator.*smooth"):
        load_setup(path)
    (folder / "dive.toml").write_text(
        '[vehicle]\ntransducer = { down = 1.0 }\n[data]\nposition = "boat-gnss.csv"\n'
    )
    with pytest.raises(ConfigurationError, match=r"field 'vehicle'.*load_mission"):
        load_fleet(folder / "dive.toml")


def test_a_target_without_vehicles_is_no_mission(folder):
    (folder / "dive.toml").write_text(
        '[[target]]\nname = "T"\n[data]\nposition = "boat-gnss.csv"\n'
    )
    with pytest.raises(ConfigurationError, match=r"field 'target'.*fleet; .*\[\[vehicle\]\]"):
        load_mission(folder / "dive.toml")


# What is written


@pytest.fixture(scope="module")
def wreck(tmp_path_factory) -> FleetResult:
    """The page's example."""
    place = tmp_path_factory.mktemp("wreck")
    write_example(place)
    return smooth_fleet(load_fleet(place / "fleet.toml"))


T = np.arange(0.0, 200.0, 5.0)
DRIFT = np.array([150.0, 250.0, -20.0]) + T[:, None] * np.array([0.3, 0.1, 0.0])


def ranged(name: str, way: np.ndarray, others: dict[str, np.ndarray], **more) -> Member:
    """A vehicle with slant ranges to others, in turn, and fixes."""
    beacon = [list(others)[i % len(others)] for i in range(len(T))]
    distance = [np.linalg.norm(others[b][i] - way[i]) for i, b in enumerate(beacon)]
    return Member(
        name,
        Segment(
            position=PositionFix(T, *way.T, sigma=0.5),
            slant_range=SlantRange(T, beacon, distance, sigma=0.5),
            reference=Reference(T, way),
        ),
        **more,
    )


@pytest.fixture(scope="module")
def mixed() -> FleetResult:
    """A beacon, two vehicles, one that nothing ties to the map, a target adrift, one unseen."""
    ways = {
        "rov/1": np.stack([1.5 * T, 0.0 * T, 0.0 * T], axis=1),
        "rov/2": np.stack([300.0 - 0.5 * T, 1.5 * T, 0.0 * T - 5.0], axis=1),
    }
    buoy = np.broadcast_to([0.0, 200.0, 0.0], (len(T), 3))
    first = ranged("rov/1", ways["rov/1"], {"rov/2": ways["rov/2"], "raft": DRIFT, "B": buoy})
    second = ranged("rov/2", ways["rov/2"], {"raft": DRIFT})
    steps = Odometry(T[:-1], T[1:], 5.0, 0.0, 0.05)
    lost = Member("lost", Segment(odometry=steps), options=Options(node="pose2"))
    return smooth_fleet(
        Fleet(
            (first, second, lost),
            (Beacon("B", [0.0, 200.0, 0.0]),),
            (
                Target("raft", [0, 0, -20], [500, 500, 0.1], [1, 1, 0], t=0.0),
                Target("unseen"),
                Target("guessed", [100, 100, 0], 30.0),
            ),
            SoundSpeedProfile.constant(1490.0),
        )
    )


def test_every_vehicle_has_what_a_mission_alone_gets(tmp_path, wreck):
    paths = write_fleet_result(wreck, tmp_path / "out")
    names = {str(p.relative_to(tmp_path / "out")) for p in paths}
    found = {str(p.relative_to(tmp_path / "out")) for p in (tmp_path / "out").rglob("*.*")}
    assert names == found
    whole = {"result.json", "mission.json", "targets.csv", "residuals.csv"}
    assert {n for n in names if "/" not in n} == whole | {"map.png", "residuals.png"}
    auv = {n.removeprefix("auv/") for n in names if n.startswith("auv/")}
    assert {"trajectory.csv", "pose_covariance.csv", "result.json", "mission.json"} <= auv
    assert {"track.png", "heading.png"} <= auv
    rows = rows_of(tmp_path / "out" / "auv" / "trajectory.csv")
    track = wreck.vehicles["auv"].trajectory
    np.testing.assert_array_equal([float(r["t"]) for r in rows], track.t)
    written = [[float(r[c]) for c in ("east", "north", "up")] for r in rows]
    np.testing.assert_allclose(written, track.position, atol=6e-7)
    # Nothing but the target folder is left.
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_residuals_hold_both_ends(tmp_path, wreck):
    write_fleet_result(wreck, tmp_path, figures=False)
    rows = rows_of(tmp_path / "residuals.csv")
    table = wreck.residuals
    assert table is not None
    assert len(rows) == len(table) == 24
    assert list(rows[0]) == [
        *("kind", "vehicle", "peer", "t_transmit", "t_receive", "travel_time"),
        *("residual", "sigma", "weight", "direct_ray"),
    ]
    for name in ("kind", "vehicle", "peer"):
        assert [r[name] for r in rows] == getattr(table, name).tolist()
    for name in ("t_transmit", "t_receive", "travel_time", "residual"):
        written = [float(r[name]) for r in rows]
        np.testing.assert_allclose(written, getattr(table, name), atol=1e-9)
    # Each row of the file of ranges is there once.
    given = sorted(line.split(",")[:3] for line in EXAMPLE[RANGES].splitlines()[1:])
    assert sorted([r["vehicle"], r["peer"], f"{float(r['t_transmit']):g}"] for r in rows) == given


def test_result_and_targets(tmp_path, mixed):
    write_fleet_result(mixed, tmp_path, figures=False)
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["status"] == mixed.status == "unobservable"
    assert "lost" in result["reason"]
    vehicles = result["vehicles"]
    assert {n: v["folder"] for n, v in vehicles.items()} == {
        "rov/1": "rov_1",
        "rov/2": "rov_2",
        "lost": "lost",
    }
    assert [v["status"] for v in vehicles.values()] == ["converged", "converged", "unobservable"]
    assert vehicles["rov/1"]["reference"]["horizontal_rmse_m"] < 0.5
    assert "reference" not in vehicles["lost"]
    # rov/1 ranged two others and the beacon in turn; those to the beacon are its own.
    assert result["pings"] == {
        "rov/1": {
            "raft": {"used": 13, "down_weighted": 0},
            "rov/2": {"used": 14, "down_weighted": 0},
        },
        "rov/2": {"raft": {"used": 40, "down_weighted": 0}},
    }
    own = json.loads((tmp_path / "rov_1" / "result.json").read_text())
    assert own["pings"] == {"B": {"used": 13, "down_weighted": 0}}
    raft = mixed.targets["raft"]
    assert result["targets"]["raft"]["enu"] == raft.position.tolist()
    assert result["targets"]["raft"]["covariance"] == raft.covariance.tolist()
    np.testing.assert_allclose(result["targets"]["raft"]["velocity_enu"], [0.3, 0.1, 0], atol=0.02)
    assert result["targets"]["raft"]["t"] == 0.0
    assert result["targets"]["guessed"]["t"] is None
    assert result["targets"]["unseen"]["status"] == "unobservable"
    assert result["targets"]["unseen"]["reason"] == "no vehicle ranged it"
    assert set(result["beacons"]) == {"B"}
    assert {"iterations", "cost", "solver", "warnings", "wall_times_s", "versions"} <= set(result)
    rows = {r["target"]: r for r in rows_of(tmp_path / "targets.csv")}
    assert list(rows) == ["raft", "unseen", "guessed"]
    for name in ("raft", "guessed"):
        row, target = rows[name], mixed.targets[name]
        found = [float(row[c]) for c in ("east", "north", "up")]
        np.testing.assert_allclose(found, target.position, atol=6e-7)
        spread = [float(row[f"sd_{c}"]) for c in ("east", "north", "up")]
        np.testing.assert_allclose(spread, np.sqrt(np.diag(target.covariance)), atol=6e-7)
        assert float(row["cov_east_north"]) == pytest.approx(target.covariance[0, 1], rel=1e-8)
        found = [float(row[f"v_{c}"]) for c in ("east", "north", "up")]
        np.testing.assert_allclose(found, target.velocity, atol=6e-7)
    assert (rows["raft"]["t"], rows["guessed"]["t"]) == ("0.0", "")


def test_the_resolved_fleet(tmp_path, mixed, wreck):
    write_fleet_result(mixed, tmp_path / "mixed", figures=False)
    stated = json.loads((tmp_path / "mixed" / "mission.json").read_text())
    assert stated["sound_speed"] == {"constant": 1490.0}
    assert [b["name"] for b in stated["beacons"]] == ["B"]
    assert stated["options"]["rays"] == "straight"
    first = stated["vehicles"][0]
    assert (first["name"], first["records"]) == ("rov/1", {"slant_range": 40, "position": 40})
    assert first["time_span"] == [0.0, 195.0]
    assert first["options"]["sound_speed_sigma"] == 5e-3
    assert stated["targets"][0] == {
        "name": "raft",
        "position": {"east": 0, "north": 0, "up": -20},
        "sigma": [500, 500, 0.1],
        "velocity_sigma": [1, 1, 0],
        "t": 0.0,
    }
    assert stated["targets"][1] == {
        "name": "unseen",
        "sigma": [1e5] * 3,
        "velocity_sigma": [0, 0, 0],
    }
    write_fleet_result(wreck, tmp_path / "wreck", figures=False)
    stated = json.loads((tmp_path / "wreck" / "mission.json").read_text())
    assert [v["options"]["node"] for v in stated["vehicles"]] == ["point", "pose2"]
    assert stated["vehicles"][1]["start"]["heading_deg"] == 0.0


def test_names_become_folders():
    names = ["A1", "a1", "ROV 2", "../up", "..", "result.json", "x" * 300, "Ä-1", "ROV_2"]
    folders = vehicle_folders(names)
    assert list(folders) == names
    assert folders["A1"] == "A1"
    assert folders["Ä-1"] == "Ä-1"
    # One whose name can stay keeps it, whoever comes first.
    assert folders["ROV_2"] == "ROV_2"
    assert folders["ROV 2"] == "ROV_2-2"
    assert len({f.casefold() for f in folders.values()}) == len(names)
    assert not {f.casefold() for f in folders.values()} & set(fleet_result_files.FILES)
    assert all(re.fullmatch(r"[^\W.][\w.+-]{0,63}", f) for f in folders.values())


def test_a_failure_leaves_the_folder_as_it_was(tmp_path, wreck, monkeypatch):
    out = tmp_path / "out"
    (out / "auv").mkdir(parents=True)
    (out / "auv" / "trajectory.csv").write_text("old")
    (out / "notes.txt").write_text("mine")

    def state() -> dict[str, str]:
        return {str(p.relative_to(tmp_path)): p.read_text() for p in tmp_path.rglob("*.*")}

    before = state()

    def broken(_fleet):
        raise DataError("no")

    with monkeypatch.context() as patched, pytest.raises(DataError, match="no"):
        patched.setattr(fleet_result_files, "resolved_fleet", broken)
        write_fleet_result(wreck, out, figures=False)
    assert state() == before
    # A file where a vehicle's folder is to go, a folder where a file is to go.
    (out / "boat").write_text("in the way")
    with pytest.raises(DataError, match="'boat' in the output folder is a file; move it away"):
        write_fleet_result(wreck, out, figures=False)
    (out / "boat").unlink()
    (out / "auv" / "result.json").mkdir()
    with pytest.raises(DataError, match=r"'auv/result\.json' in the output folder is a folder"):
        write_fleet_result(wreck, out, figures=False)
    (out / "auv" / "result.json").rmdir()
    assert state() == before
    # What is there and of another name stays.
    write_fleet_result(wreck, out, figures=False)
    assert (out / "notes.txt").read_text() == "mine"
    assert (out / "auv" / "trajectory.csv").read_text() != "old"
    assert not [p for p in tmp_path.iterdir() if p.name != "out"]


# Figures


def drawn(figure) -> dict[str, list]:
    """Lines of the first axes by label."""
    lines: dict[str, list] = {}
    for line in figure.get_axes()[0].lines:
        lines.setdefault(str(line.get_label()), []).append(line)
    return lines


def test_the_map_shows_tracks_targets_and_ranges(mixed):
    figure = fleet_map(mixed)
    lines = drawn(figure)
    labels = ("rov/1", "rov/2", "lost (unobservable)")
    for name, vehicle in zip(labels, mixed.vehicles.values(), strict=True):
        track = np.column_stack(lines[name][0].get_data())
        np.testing.assert_array_equal(track, vehicle.trajectory.position[:, :2])
    assert lines["lost (unobservable)"][0].get_linestyle() == ":"
    assert lines["rov/1"][0].get_linestyle() == "-"
    texts = {text.get_text() for text in figure.get_axes()[0].texts}
    # Nobody knows where "unseen" is.
    assert texts == {"raft", "guessed (unobservable)", "B"}
    ((east, north),) = np.column_stack(lines["target"][0].get_data())
    np.testing.assert_array_equal([east, north], mixed.targets["raft"].position[:2])
    # A range joins the two ends where they were: here its length is the distance measured.
    table = mixed.residuals
    assert table is not None
    ends = np.column_stack(lines["ranges"][0].get_data())
    first = table.vehicle[0]
    here = mixed.vehicles[str(first)].trajectory.at(float(table.t_receive[0])).position[0, :2]
    np.testing.assert_allclose(ends[0], here)


def test_residuals_are_in_metres(mixed, wreck):
    for result, factor in ((mixed, 1500.0), (wreck, 750.0)):
        table = result.residuals
        assert table is not None
        figure = fleet_residuals(result)
        panels = [axes for axes in figure.get_axes() if axes.get_visible()]
        titles = [axes.get_title(loc="left").partition(":")[0] for axes in panels]
        ends = {frozenset(t.split(" - ")) for t in titles}
        pairs = zip(table.vehicle.tolist(), table.peer.tolist(), strict=True)
        assert ends == {frozenset(pair) for pair in pairs}
        for axes, title in zip(panels, titles, strict=True):
            a, b = title.split(" - ")
            mine = np.isin(table.vehicle, [a, b]) & np.isin(table.peer, [a, b])
            used = next(line for line in axes.lines if line.get_label() == "used")
            np.testing.assert_allclose(used.get_ydata(), factor * table.residual[mine])


def test_many_pairs_get_a_panel_a_vehicle():
    ways = {f"V{i}": np.stack([T + 30 * i, 60.0 * i + 0 * T, 0 * T], axis=1) for i in range(7)}
    members = tuple(
        ranged(name, way, {n: w for n, w in ways.items() if n != name})
        for name, way in ways.items()
    )
    result = smooth_fleet(Fleet(members))
    assert MOST_PAIRS < 7 * 6 / 2
    panels = [axes for axes in fleet_residuals(result).get_axes() if axes.get_visible()]
    titles = [axes.get_title(loc="left").partition(":")[0] for axes in panels]
    assert titles == [f"{name} - all others" for name in ways]
