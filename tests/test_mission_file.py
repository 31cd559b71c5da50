from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.errors import ConfigurationError, DataError
from ubl_graph.frames import GeodeticOrigin
from ubl_graph.io.mission_file import load_mission
from ubl_graph.io.resolved import resolved
from ubl_graph.mission import RECORD_KINDS, Mission, Setup, Start
from ubl_graph.mission_checks import POSE_KINDS
from ubl_graph.options import Options

DOCS = Path(__file__).resolve().parents[1] / "docs"

FILES = {
    "ranges.csv": (
        "beacon,t_transmit,t_receive,travel_time\n"
        "B1,0,2.5,2.0\n# a comment\nB1,10,12.5,1.9\n\nB1,20,22.5,1.8\n"
    ),
    "bare.csv": "beacon,t_transmit,t_receive\nB1,0,2.5\nB1,10,12.5\n",
    "heard.csv": "beacon,t_transmit,t_receive\nB1,5,6\n",
    "metres.csv": "t,beacon,distance\n5,B1,1000\n15,B1,1001\n",
    "dvl.csv": "t,forward,right,down\n0,1.5,0,0\n1,1.5,0,0\n",
    "water.csv": "t,forward,right,down,reference\n0,1.5,0,0,water\n1,1.5,0,0,water\n",
    "compass.csv": "t,heading\n0,90\n1,91\n",
    "gyro.csv": "t,about_down\n0,1\n1,1\n",
    "steps.csv": "t_from,t_to,forward,right,about_down\n0,1,1.5,0,1\n1,2,1.5,0,1\n",
    "attitude.csv": "t,heading\n0,90\n1,91\n",
    "depth.csv": "t,depth\n0,50\n25,51\n",
    "fixes.csv": "t,east,north\n0,1,2\n",
    "geo.csv": "t,latitude,longitude\n0,34.96,139.26\n",
    "svp.csv": "depth,speed\n0,1500\n1000,1480\n",
}

#: A mission's parts by table; each test replaces what it is about.
PARTS = {
    "mission": '[mission]\nname = "dive-7"',
    "beacon": '[[beacon]]\nname = "B1"\nposition = { east = 0, north = 0.0, up = -1000 }',
    "sound_speed": "[sound_speed]\nconstant = 1500",
    "vehicle": "",
    "start": "",
    "options": "",
    "data": '[data]\ntwo_way_range = "ranges.csv"',
}
ORIGIN = "[mission]\norigin = { latitude = 34.96, longitude = 139.26 }"


@pytest.fixture
def folder(tmp_path):
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    return tmp_path


def write(folder: Path, **parts: str) -> Path:
    file = folder / "mission.toml"
    file.write_text("\n".join({**PARTS, **parts}.values()) + "\n")
    return file


def load(folder: Path, **parts: str) -> Mission:
    return load_mission(write(folder, **parts))


def failure(folder, parts, *, file="mission.toml", kind=ConfigurationError, words="", **place):
    with pytest.raises(DataError) as caught:
        load(folder, **parts)
    error = caught.value
    assert type(error) is kind, error
    assert "\n" not in str(error) and words in str(error)
    found = {name: getattr(error, name) for name in ("row", "line", "record", "field")}
    assert Path(error.file) == folder / file
    assert found == {**dict.fromkeys(found), **place}


# What is read


def test_a_small_mission(folder):
    mission = load(folder)
    (segment,) = mission.segments
    assert (mission.name, segment.name) == ("dive-7", "")
    assert segment.records().keys() == {"two_way_range"}
    assert mission.beacons[0].position.tolist() == [0.0, 0.0, -1000.0]
    assert mission.sound_speed.speed.tolist() == [1500.0]
    assert mission.options == Options()
    assert mission.vehicle.transducer.is_zero
    assert segment.start is None and mission.origin is None


def test_a_full_mission(folder):
    mission = load(
        folder,
        mission='[mission]\nname = "all"\n'
        "origin = { latitude = 34.96, longitude = 139.26, height = 5 }",
        beacon='[[beacon]]\nname = "B1"\nposition = { latitude = 34.97, longitude = 139.26, '
        "height = -1000 }\nsigma = [1, 2, 3.5]\nturnaround = 0.5",
        sound_speed='[sound_speed]\nprofile = "svp.csv"',
        vehicle="[vehicle]\ntransducer = { forward = 0.3, down = 1 }\nantenna = { right = -1 }",
        start="[start]\nt = 0\neast = -590\nnorth = 8.0\nup = -5\nsigma = 15",
        options='[options]\nmotion = "constant_acceleration"\nmax_iterations = 7\n'
        "acceleration_psd = 1\nestimate_beacons = true\ntravel_time_sigma = 2e-4",
        data='[data]\nformat = "csv"\ntwo_way_range = "bare.csv"\none_way_range = "heard.csv"\n'
        'slant_range = "metres.csv"\nvelocity = "dvl.csv"\nattitude = "./attitude.csv"\n'
        'depth = "depth.csv"\nposition = "geo.csv"',
    )
    (segment,) = mission.segments
    assert set(segment.records()) == set(RECORD_KINDS) - set(POSE_KINDS)
    oracle = GeodeticOrigin(34.96, 139.26, 5.0).to_enu(34.97, 139.26, -1000.0)[0]
    assert np.array_equal(mission.beacons[0].position, oracle)
    assert mission.beacons[0].sigma.tolist() == [1.0, 2.0, 3.5]
    assert segment.two_way_range.travel_time.tolist() == [2.0, 2.0]
    assert segment.two_way_range.sigma[0] == segment.one_way_range.sigma[0] == 2e-4
    np.testing.assert_allclose(segment.position.position, [[0.0, 0.0]], atol=1e-9)
    assert mission.vehicle.transducer.body.tolist() == [0.3, 0.0, -1.0]
    assert mission.vehicle.antenna.right == -1.0
    assert (segment.start.up, segment.start.sigma) == (-5.0, 15.0)
    assert mission.options.motion == "constant_acceleration"
    assert (mission.options.max_iterations, mission.options.acceleration_psd) == (7, 1.0)
    assert mission.options.estimate_beacons
    assert mission.uses_eigenrays


POSES = {
    "mission": ORIGIN,
    "vehicle": "[vehicle]\ntransducer = { forward = 0.3 }\nantenna = { right = -1 }",
    "start": "[start]\nt = 0\neast = 1\nnorth = 2\nheading_deg = 90\nheading_sigma_deg = 180",
    "options": '[options]\nnode = "pose2"',
    "data": '[data]\nslant_range = "metres.csv"\nheading = "compass.csv"\n'
    'angular_rate = "gyro.csv"\nodometry = "steps.csv"\nvelocity = "dvl.csv"\n'
    'position = "geo.csv"',
}


@pytest.mark.parametrize("node", ["pose2", "pose3"])
def test_a_mission_of_poses_needs_neither_attitude_nor_sound_speed(folder, node):
    options = f'[options]\nnode = "{node}"'
    mission = load(folder, **{**POSES, "options": options, "sound_speed": ""})
    (segment,) = mission.segments
    assert set(POSE_KINDS) < segment.records().keys()
    assert segment.start.heading == pytest.approx(np.pi / 2)
    assert segment.start.heading_sigma == pytest.approx(np.pi)
    assert segment.odometry.dimension == 2
    assert mission.options.node == node


def test_velocities_through_the_water_are_for_poses_too(folder):
    data = '[data]\ntwo_way_range = "ranges.csv"\nvelocity = "water.csv"'
    with_current = '[options]\nnode = "pose3"\nestimate_current = true'
    assert load(folder, data=data, options=with_current).segments[0].velocity is not None
    place = {"file": "water.csv", "kind": DataError, "row": 1, "line": 2, "field": "reference"}
    parts = {"data": data, "options": POSES["options"]}
    failure(folder, parts, words="needs the current as a state", **place)


def test_name_defaults_to_the_files_name_and_start_to_its_own_sigma(folder):
    mission = load(folder, mission="", start="[start]\nt = 0\neast = 0\nnorth = 0")
    assert mission.name == "mission"
    assert mission.segments[0].start.sigma == 10.0


def test_files_are_named_as_the_user_wrote_them(folder, monkeypatch):
    write(folder, data='[data]\ntwo_way_range = "./sub/../gone.csv"')
    monkeypatch.chdir(folder.parent)
    with pytest.raises(DataError) as caught:
        load_mission(f"{folder.name}/mission.toml")
    assert str(caught.value.file) == f"{folder.name}/sub/../gone.csv"
    monkeypatch.chdir(folder)
    mission = load_mission(write(Path()))
    assert mission.segments[0].two_way_range.source.file == "ranges.csv"


def test_positions_alone_need_neither_beacon_nor_sound_speed(folder):
    mission = load(folder, beacon="", sound_speed="", data='[data]\nposition = "fixes.csv"')
    assert mission.segments[0].records().keys() == {"position"}


# What is refused: the mission file


@pytest.mark.parametrize(
    ("parts", "field", "words"),
    [
        (
            {"options": "[options]\naccelerationpsd = 1"},
            "options.accelerationpsd",
            "unknown key 'accelerationpsd'; did you mean 'acceleration_psd'?",
        ),
        ({"options": "[option]\nmotion = 1"}, "option", "did you mean 'options'?"),
        ({"data": '[data]\ntwoway = "ranges.csv"'}, "data.twoway", "unknown key 'twoway'"),
        (
            {"data": '[data]\nobservations = "o.csv"'},
            "data.observations",
            "it belongs to format = 'garpos'",
        ),
        ({"vehicle": "[vehicle]\ndvl = { fwd = 1 }"}, "vehicle.dvl.fwd", "forward, right, down"),
        ({"mission": "[mission]\nname = 7"}, "mission.name", "7 is not a text in quotes"),
        ({"mission": "mission = 7"}, "mission", "7 is not a table"),
        ({"data": '[data]\nformat = "garbos"'}, "data.format", "did you mean 'garpos'?"),
        ({"data": "[data]\nformat = [1]"}, "data.format", "[1] is no format of data"),
        ({"mission": "data = 3", "data": ""}, "data", "3 is not a table"),
        ({"options": '[options]\nspeed_sigma = "3"'}, "options.speed_sigma", "'3' is not a number"),
        ({"options": "[options]\nspeed_sigma = true"}, "options.speed_sigma", "True is not a"),
        ({"options": "[options]\nspeed_sigma = nan"}, "options.speed_sigma", "not a finite number"),
        ({"options": "[options]\nspeed_sigma = -1"}, "options.speed_sigma", "not a positive"),
        ({"options": "[options]\nmax_iterations = 1.5"}, "options.max_iterations", "whole number"),
        (
            {"options": "[options]\nmax_iterations = 0"},
            "options.max_iterations",
            "no number of iterations",
        ),
        (
            {"options": "[options]\nestimate_beacons = 1"},
            "options.estimate_beacons",
            "1 is neither true nor false",
        ),
        (
            {"options": '[options]\nloss = "cauchi"'},
            "options.loss",
            "'cauchi' is not allowed; did you mean 'cauchy'? known: cauchy, huber",
        ),
        ({"start": "[start]\nt = 0\neast = 0"}, "start.north", "the key is missing"),
        (
            {"start": "[start]\nt = 0\neast = 0\nnorth = 0\nsigma = 0"},
            "start.sigma",
            "more than zero",
        ),
        ({"sound_speed": "[sound_speed]"}, "sound_speed", "give either constant (m/s) or profile"),
        (
            {"sound_speed": '[sound_speed]\nconstant = 1500\nprofile = "svp.csv"'},
            "sound_speed",
            "give either",
        ),
        (
            {"vehicle": "[vehicle]\ntransducer = { down = 2000 }"},
            "vehicle.transducer.down",
            "at most 1000",
        ),
        (
            {"mission": "[mission]\norigin = { latitude = 134.96, longitude = 39 }"},
            "mission.origin.latitude",
            "134.96 is outside",
        ),
        (
            {"start": "[start]\nt = 0\neast = 0\nnorth = 0\nheading_deg = 721"},
            "start.heading_deg",
            "721.0 degrees is outside -720 to 720 degrees",
        ),
        (
            {"start": POSES["start"].replace("= 180", "= 0")},
            "start.heading_sigma_deg",
            "0.0 degrees is outside",
        ),
        (
            {"start": "[start]\nt = 0\neast = 0\nnorth = 0\nheading_sigma_deg = 5"},
            "start.heading_sigma_deg",
            "a sigma of no heading; give heading_deg too",
        ),
        ({"start": POSES["start"]}, "start.heading", "node = 'point' has no heading to start"),
        ({"options": '[options]\nnode = "pose"'}, "options.node", "did you mean 'pose3'?"),
        (
            {"options": '[options]\nnode = "pose2"\nmotion = "constant_acceleration"'},
            "options.motion",
            "poses move with white noise on acceleration; set motion = 'constant_velocity'",
        ),
        (
            {"options": '[options]\nnode = "pose3"\nmotion = "auto"'},
            "options.motion",
            "motion = 'auto' does not go with node = 'pose3'",
        ),
        *(
            (
                {"data": f'{PARTS["data"]}\n{kind} = "{file}"'},
                "options.node",
                f"{kind} records, which node = 'point' cannot use; set node = 'pose2' or 'pose3'",
            )
            for kind, file in zip(POSE_KINDS, ("compass.csv", "gyro.csv", "steps.csv"), strict=True)
        ),
        ({"sound_speed": ""}, "sound_speed", "no sound speed; add [sound_speed]"),
        ({"beacon": ""}, "beacon", "no beacon; add [[beacon]]"),
        ({"beacon": "", "data": '[data]\nslant_range = "metres.csv"'}, "beacon", "no beacon"),
        (
            {"beacon": PARTS["beacon"].replace("[[beacon]]", "[beacon]")},
            "beacon",
            "with [[beacon]]",
        ),
        ({"beacon": PARTS["beacon"] + "\n" + PARTS["beacon"]}, "beacon", "'B1' is there twice"),
        ({"data": "[data]"}, "data", "no data file is named; known: two_way_range"),
        ({"data": ""}, "data", "no data file is named"),
        ({"data": '[data]\ntwo_way_range = "ranges.csv"\nvelocity = "dvl.csv"'}, "velocity", ""),
        ({"vehicle": "[vehicle]\ntransducer = { down = 2 }"}, "vehicle.transducer", "no attitude"),
    ],
)
def test_wrong_mission_files(folder, parts, field, words):
    failure(folder, parts, field=field, words=words)


@pytest.mark.parametrize(
    ("change", "field", "words"),
    [
        (("east = 0,", "east = '0',"), "beacon.position.east", "'0' is not a number"),
        (("east = 0,", "est = 0,"), "beacon.position.est", "did you mean 'east'?"),
        (("east = 0,", ""), "beacon.position", "the position has north, up; give east, north"),
        (("position =", "positio ="), "beacon.positio", "did you mean 'position'?"),
        (("-1000 }", "-1000 }\nsigma = 'x'"), "beacon.sigma", "'x' is neither a number nor ["),
        (("-1000 }", "-1000 }\nsigma = [1, 2]"), "beacon.sigma", "[1, 2] is neither"),
        (("-1000 }", "-1000 }\nturnaround = '1'"), "beacon.turnaround", "'1' is not a number"),
    ],
)
def test_wrong_beacons_are_named(folder, change, field, words):
    second = PARTS["beacon"].replace("B1", "B2").replace(*change)
    parts = {"beacon": PARTS["beacon"] + "\n" + second}
    failure(folder, parts, record="beacon 'B2'", field=field, words=words)


@pytest.mark.parametrize(
    ("addition", "field"),
    [("sigma = -1", "beacon.sigma"), ("turnaround = -0.5", "beacon.turnaround")],
)
def test_absurd_beacons_are_named(folder, addition, field):
    parts = {"beacon": f"{PARTS['beacon']}\n{addition}"}
    failure(folder, parts, kind=DataError, record="beacon 'B1'", field=field)


def test_a_beacon_without_name_is_counted(folder):
    beacon = PARTS["beacon"].replace('name = "B1"', "")
    failure(folder, {"beacon": beacon}, record="beacon number 1", field="beacon.name")


def test_geodetic_beacons_need_an_origin_and_sane_degrees(folder):
    where = "{ latitude = 34.9, longitude = 139, height = -11000 }"
    beacon = f'[[beacon]]\nname = "B1"\nposition = {where}'
    place = {"record": "beacon 'B1'", "field": "beacon.position"}
    failure(folder, {"beacon": beacon}, **place, words="need an origin")
    assert load(folder, beacon=beacon, mission=ORIGIN).beacons[0].position[2] < -10_900.0
    place["field"] = "beacon.position.latitude"
    failure(folder, {"beacon": beacon.replace("34.9", "95"), "mission": ORIGIN}, **place)


@pytest.mark.parametrize(
    ("parts", "line", "words"),
    [
        ({"mission": "[mission]\nname = dive"}, 2, "no TOML: Invalid value"),
        ({"mission": "[mission\nname = 'a'"}, 1, "no TOML"),
        ({"mission": "[mission]", "data": "[mission]"}, 10, "twice"),
        ({"data": '[data]\ntwo_way_range = "ranges.csv'}, 12, "no TOML"),
    ],
)
def test_toml_errors_name_the_line(folder, parts, line, words):
    failure(folder, parts, line=line, words=words)


def test_an_impossible_constant_speed(folder):
    parts = {"sound_speed": "[sound_speed]\nconstant = 1.5"}
    failure(folder, parts, kind=DataError, field="sound_speed.constant", words="1.5 m/s")


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("mission.tml", b"", "there is no such file; did you mean 'mission.toml'?"),
        (".", b"", "this is a folder"),
        ("latin.toml", b"[mission]\nname = '\xe9'\n", "byte 0xe9 is no UTF-8 text"),
    ],
)
def test_mission_files_that_cannot_be_read(folder, name, content, words):
    write(folder)
    if content:
        (folder / name).write_bytes(content)
    with pytest.raises(DataError) as caught:
        load_mission(folder / name)
    assert type(caught.value) is DataError
    assert str(caught.value.file) == str(folder / name)
    assert words in str(caught.value) and "\n" not in str(caught.value)


# What is refused: the data


@pytest.mark.parametrize(
    ("text", "row", "line", "field", "words"),
    [
        (None, None, None, None, "there is no such file"),
        ("", None, None, None, "the file is empty"),
        ("beacon,t_transmit,t_receive,travel_time\n", None, None, None, "no row below the header"),
        ("beacon,t_transmit,t_recieve\nB1,0,1\n", None, None, "t_receive", "mean 't_recieve'?"),
        ("B1,10,12.5,nan", 2, 3, "travel_time", "nan is not a finite number"),
        ("B1,10,12.5,-1.9", 2, 3, "travel_time", "-1.9 s is outside 0 to 60 s"),
        ("B1,10,99,70", 2, 3, "travel_time", "70.0 s is outside 0 to 60 s"),
        ("B1,10,9,1", 2, 3, "t_receive", "9.0 s is before the transmit time"),
        ("B1,10,12.5,x", 2, 3, "travel_time", "'x' is not a number"),
        ("B1,10", 2, 3, None, "the row has 2 values, the header names 4"),
        ("B11,10,12.5,2", 2, 3, "beacon", "unknown beacon 'B11'; did you mean 'B1'? known: B1"),
        ("B1,0,2.5,2.0", 2, 3, "t_receive", "duplicate record"),
    ],
)
def test_wrong_data_files(folder, text, row, line, field, words):
    file = folder / "ranges.csv"
    if text is None:
        file.unlink()
    elif text.startswith("B"):
        file.write_text("\n".join([*FILES["ranges.csv"].splitlines()[:2], text]))
    else:
        file.write_text(text)
    failure(
        folder, {}, file="ranges.csv", kind=DataError, row=row, line=line, field=field, words=words
    )


@pytest.mark.parametrize(
    ("file", "text", "row", "field", "words"),
    [
        ("metres.csv", "t,beacon,distance\n5,B11,9\n", 1, "beacon", "did you mean 'B1'?"),
        ("metres.csv", "t,beacon,distance\n5,B1,9\n5,B1,8\n", 2, "t", "duplicate record"),
        ("compass.csv", "t,heading\n5,1\n5,1\n", 2, "t", "duplicate record (t = 5.0)"),
        ("gyro.csv", "t,about_down\n5,1\n5,1\n", 2, "t", "duplicate record"),
        ("steps.csv", FILES["steps.csv"] + "1,2,1,0,0\n", 3, "t_to", "duplicate record"),
        ("compass.csv", "t,heading\n5e3,1\n6e3,1\n", 1, "t", "5000.0 s: no record lies within"),
        ("gyro.csv", "t,about_down\n-7e3,1\n-6e3,1\n", 1, "t", "the same epoch?"),
        (
            "steps.csv",
            "t_from,t_to,forward,right,about_down\n1e9,1.1e9,1,0,0\n1.1e9,1.2e9,1,0,0\n",
            1,
            "t_from",
            "the ranges' times, 5.0 to 15.0 s; are all files in the same epoch?",
        ),
    ],
)
def test_wrong_data_of_poses(folder, file, text, row, field, words):
    (folder / file).write_text(text)
    place = {"row": row, "line": row + 1, "field": field}
    failure(folder, POSES, file=file, kind=DataError, words=words, **place)


def test_odometry_that_reaches_into_the_ranges_times_is_of_their_epoch(folder):
    (folder / "steps.csv").write_text(
        "t_from,t_to,forward,right,about_down\n-2000,-1000,1,0,0\n-1000,10,1,0,0\n"
    )
    assert len(load(folder, **POSES).segments[0].odometry) == 2


@pytest.mark.parametrize("node", ["point", "pose2", "pose3"])
def test_nothing_that_locates_the_vehicle(folder, node):
    parts = {"data": '[data]\ndepth = "depth.csv"', "options": f'[options]\nnode = "{node}"'}
    failure(folder, parts, kind=DataError, words="no range and no position fix")


def test_wrong_profiles_and_fixes_name_their_files(folder):
    (folder / "svp.csv").write_text("depth,speed\n0,1500\n10,15\n")
    parts = {"sound_speed": '[sound_speed]\nprofile = "svp.csv"'}
    failure(folder, parts, file="svp.csv", kind=DataError, row=2, line=3, field="speed")
    parts = {"data": '[data]\nposition = "geo.csv"'}
    failure(folder, parts, file="geo.csv", field="latitude", words="need an origin")
    parts = {"data": '[data]\ntwo_way_range = "bare.csv"'}
    failure(folder, parts, file="bare.csv", row=1, line=2, field="travel_time", words="'B1' states")


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"heading": np.nan}, "start.heading"),
        ({"heading": 90.0}, "start.heading"),
        ({"heading": 1.0, "heading_sigma": 0.0}, "start.heading_sigma"),
        ({"heading": 1.0, "heading_sigma": 4.0}, "start.heading_sigma"),
        ({"heading": 1.0, "heading_sigma": np.inf}, "start.heading_sigma"),
        ({"sigma": -1.0}, "start.sigma"),
    ],
)
def test_wrong_starts(values, field):
    with pytest.raises(ConfigurationError) as caught:
        Start(0.0, 1.0, 2.0, **values)
    assert caught.value.field == field


def test_the_setup_of_a_live_process_is_held_to_the_same():
    sound = SoundSpeedProfile.constant(1500.0)
    start = Start(0.0, 1.0, 2.0, heading=1.0)
    with pytest.raises(ConfigurationError, match="has no heading to start with"):
        Setup((), sound, start=start)
    poses = Setup((), sound, options=Options(node="pose2"), start=start)
    assert poses.fingerprint() != replace(poses, start=replace(start, heading=2.0)).fingerprint()
    with pytest.raises(ConfigurationError, match="does not go with node = 'pose2'"):
        Setup((), sound, options=Options(node="pose2", motion="constant_acceleration"))


# Provenance


def test_resolved_missions_state_every_option_in_force(folder):
    mission = load(
        folder,
        mission='[mission]\nname = "x"\norigin = { latitude = 34.96, longitude = 139.26 }',
        start="[start]\nt = 0\neast = 1\nnorth = 2",
        options="[options]\nacceleration_psd = 0.5",
        data='[data]\ntwo_way_range = "ranges.csv"\ndepth = "depth.csv"',
    )
    plain = resolved(mission)
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
    # Without a grid the nodes' spacing is nothing that could be stated; nor is the sigma of a
    # heading bias where the data give it.
    unstated = {"node_spacing", "heading_bias_sigma_deg"}
    assert plain["options"].keys() | unstated == {f.name for f in fields(Options)}
    assert plain["options"]["vertical_acceleration_psd"] == 0.5
    assert plain["options"]["rays"] == "straight"
    assert plain["options"]["sound_speed_sigma"] == 5e-3
    assert plain["origin"] == {"latitude": 34.96, "longitude": 139.26, "height": 0.0}
    assert plain["sound_speed"] == {"constant": 1500.0}
    assert plain["beacons"] == [
        {
            "name": "B1",
            "position": {"east": 0.0, "north": 0.0, "up": -1000.0},
            "sigma": [0.0, 0.0, 0.0],
        }
    ]
    assert plain["vehicle"]["dvl"] == {"forward": 0.0, "right": 0.0, "down": 0.0}
    assert plain["segments"] == [
        {
            "name": "",
            "records": {"two_way_range": 3, "depth": 2},
            "time_span": [0.0, 25.0],
            "start": {"t": 0.0, "east": 1.0, "north": 2.0, "sigma": 10.0},
        }
    ]


def test_resolved_starts_state_their_heading_in_degrees(folder):
    plain = resolved(load(folder, **POSES))
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
    assert plain["options"]["node"] == "pose2"
    (segment,) = plain["segments"]
    assert segment["start"] == {
        "t": 0.0,
        "east": 1.0,
        "north": 2.0,
        "sigma": 10.0,
        "heading_deg": pytest.approx(90.0),
        "heading_sigma_deg": pytest.approx(180.0),
    }
    assert segment["records"]["odometry"] == 2
    assert segment["time_span"] == [0.0, 15.0]


def test_resolved_profiles(folder):
    rows = "\n".join(f"{d},{1500 - d / 100}" for d in range(1000))
    (folder / "svp.csv").write_text(f"depth,speed\n{rows}\n")
    plain = resolved(load(folder, sound_speed='[sound_speed]\nprofile = "svp.csv"'))
    profile = plain["sound_speed"]
    assert profile["samples"] == 1000 and len(profile["depth"]) == len(profile["speed"]) == 200
    assert (profile["depth"][0], profile["depth"][-1]) == (0.0, 999.0)
    assert plain["options"]["rays"] == "eigenray"
    assert plain["options"]["sound_speed_sigma"] == 1e-3


# The package and its documentation


def test_pydantic_is_not_imported_before_a_mission_file_is_read():
    code = (
        "import sys, ubl_graph.mission, ubl_graph.io.records, ubl_graph.io.garpos;"
        "sys.exit('pydantic' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def documented_default(name: str) -> str:
    text = (DOCS / "mission-file.md").read_text()
    (row,) = [line for line in text.splitlines() if line.startswith(f"| `{name}` |")]
    return row.split("|")[3].strip().strip("`")


@pytest.mark.parametrize("option", fields(Options), ids=lambda f: f.name)
def test_every_option_is_documented_with_its_default(option):
    written = documented_default(option.name)
    if option.default is None:
        assert written == "left out"
    elif isinstance(option.default, str):
        assert written == option.default
    else:
        assert json.loads(written) == option.default


def documented_examples() -> list[str]:
    text = (DOCS / "mission-file.md").read_text()
    return [block.split("```")[0] for block in text.split("```toml\n")[1:]]


def test_the_documented_examples_are_missions(folder):
    garpos, own = documented_examples()
    assert tomllib.loads(garpos)["data"]["format"] == "garpos"
    (folder / "mission.toml").write_text(own)
    mission = load_mission(folder / "mission.toml")
    assert mission.name == "dive-7"
    assert set(mission.segments[0].records()) >= {"two_way_range", "velocity", "attitude"}


def test_the_documented_garpos_example_reads_the_sample_campaign(saga, tmp_path):
    for file in saga.iterdir():
        (tmp_path / file.name).symlink_to(file)
    (tmp_path / "mission.toml").write_text(documented_examples()[0])
    mission = load_mission(tmp_path / "mission.toml")
    assert [s.name for s in mission.segments] == ["S01/L01", "S01/L02"]
