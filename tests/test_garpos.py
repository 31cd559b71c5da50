from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ubl_graph.errors import ConfigurationError, DataError
from ubl_graph.io.garpos import GARPOS_DEPTH_SIGMA, read_beacons, read_garpos
from ubl_graph.io.mission_file import load_mission

NAME = "SAGA.1903.kaiyo_k4"
STRAIGHT = ("S01/L01", "S01/L02", "S01/L04", "S02/L06", "S02/L07", "S02/L08", "S02/L09")

HEADER = (
    ",SET,LN,MT,TT,ResiTT,flag,ST,RT,ant_e0,ant_n0,ant_u0,head0,pitch0,roll0,"
    "ant_e1,ant_n1,ant_u1,head1,pitch1,roll1,mood"
)
ROW = "{i},{line},{mt},{tt},0.1,{flag},{st},{rt},1,2,20,90,0,0,3,4,20.5,90,0,0,calm"
CONFIG = """[Site-parameter]
# Latitude0 = 99
 Latitude0   =  35.0
 Longitude0  = 139.0
 Height0     =  43.0
[Model-parameter]
 M1_dPos     =   10.0  20.0  -1000.0   3.0  2.0  1.0   0.0  0.0  0.0
  M2_dPos    =   11.0  21.0  -1001.0   0.5  0.5  0.5
M3_dPos=12.0 22.0 -1002.0
 dCentPos    =    1.0   2.0      3.0   0.0  0.0  0.0
 ATDoffset   =    2.0   1.0     30.0   0.0  0.0  0.0
"""


def row(i=0, line="S1,L1", mt="M1", tt=1.5, flag="False", st=0.0, rt=2.5):
    return ROW.format(i=i, line=line, mt=mt, tt=tt, flag=flag, st=st, rt=rt)


PINGS = [
    row(0),
    row(1, mt="M2", st=2.5, rt=5.0),
    "# a comment",
    row(2, mt="M3", st=5.0, rt=2.0, tt="nan", flag="True"),
    row(3, "S1,L2", st=20.0, rt=22.5, flag="0"),
    row(4, "S1,L3", st=30.0, rt=32.5, flag="1"),
    row(5, st=10.0, rt=12.5),
]


@pytest.fixture
def campaign(tmp_path):
    """Writes a small campaign; returns the files' paths."""

    def write(pings=PINGS, config=CONFIG, beacons=None, header=HEADER) -> tuple[Path, ...]:
        files = [tmp_path / "obs.csv", tmp_path / "cfg.ini"]
        files[0].write_text("\n".join(["# cfgfile = x", header, *pings]) + "\n")
        files[1].write_text(config)
        if beacons is not None:
            files.append(tmp_path / "beacons.json")
            files[2].write_text(beacons if isinstance(beacons, str) else json.dumps(beacons))
        return tuple(files)

    return write


def failure(call, *args, kind=DataError, words="", **place):
    """The error that a call raises: file name, row, line, record and field checked."""
    with pytest.raises(DataError) as caught:
        call(*args)
    error = caught.value
    assert type(error) is kind
    assert "\n" not in str(error) and words in str(error)
    found = {name: getattr(error, name) for name in ("row", "line", "record", "field")}
    file = None if error.file is None else Path(error.file).name
    assert {"file": file, **found} == {
        **dict.fromkeys(("file", "row", "line", "record", "field")),
        **place,
    }


# A small campaign


def test_segments_are_lines_in_order_of_appearance(campaign):
    found = read_garpos(*campaign(), sigma=2e-4)
    assert [s.name for s in found.segments] == ["S1/L1", "S1/L2"]
    pings = found.segments[0].two_way_range
    assert pings.beacon.tolist() == ["M1", "M2", "M1"]
    assert pings.t_transmit.tolist() == [0.0, 2.5, 10.0]
    assert pings.t_receive.tolist() == [2.5, 5.0, 12.5]
    assert pings.travel_time.tolist() == [1.5] * 3
    assert pings.sigma.tolist() == [2e-4] * 3
    assert pings.source.row.tolist() == [1, 2, 6]
    assert pings.source.line.tolist() == [3, 4, 9]


def test_the_estimator_gets_depth_but_no_position_nor_attitude(campaign):
    segment = read_garpos(*campaign()).segments[0]
    assert segment.records().keys() == {"two_way_range", "depth"}
    assert segment.start is None
    # Antenna at 20 m (transmit) and 20.5 m (receive), transducer 30 m below it. At 2.5 s a reply
    # arrives in the instant of the next ping: the earlier row's depth stays.
    assert segment.depth.t.tolist() == [0.0, 2.5, 5.0, 10.0, 12.5]
    assert segment.depth.depth.tolist() == [10.0, 9.5, 9.5, 10.0, 9.5]
    assert segment.depth.source.row.tolist() == [1, 1, 2, 6, 6]
    assert set(segment.depth.sigma) == {GARPOS_DEPTH_SIGMA}


def test_reference_is_the_transducer_at_transmit_times(campaign):
    reference = read_garpos(*campaign([row(0, st=5.0, rt=8.0), row(1)])).segments[0].reference
    assert reference.t.tolist() == [0.0, 5.0]
    # Antenna (1, 2, 20), heading east: 2 m forward is east, 1 m to starboard is south.
    np.testing.assert_allclose(reference.position, [[3.0, 1.0, -10.0]] * 2, atol=1e-12)


def test_lines_are_taken_in_the_order_asked_for(campaign):
    files = campaign()
    found = read_garpos(*files, lines=["S1/L2", "S1/L1"])
    assert [s.name for s in found.segments] == ["S1/L2", "S1/L1"]
    assert [s.name for s in read_garpos(*files, lines=["S1/L2"]).segments] == ["S1/L2"]


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["S1/L9"], "there is no line 'S1/L9' in"),
        (["S01/L1"], "did you mean 'S1/L1'? lines found: S1/L1, S1/L2"),
        (["S1/L3"], "every ping of the line 'S1/L3'"),
        (["S1/L1", "S1/L1"], "'S1/L1' is asked for twice"),
    ],
)
def test_lines_that_cannot_be_taken(campaign, lines, words):
    files = (*campaign(), None)
    failure(read_garpos, *files, lines, kind=ConfigurationError, field="lines", words=words)


def test_beacons_of_the_configuration(campaign):
    found = read_garpos(*campaign())
    positions = {b.name: b.position.tolist() for b in found.beacons}
    assert positions == {
        "M1": [11.0, 22.0, -997.0],
        "M2": [12.0, 23.0, -998.0],
        "M3": [13.0, 24.0, -999.0],
    }
    sigmas = [b.sigma.tolist() for b in found.beacons]
    assert sigmas == [[3.0, 2.0, 1.0], [0.5] * 3, [0.0] * 3]
    assert (found.origin.latitude, found.origin.longitude, found.origin.height) == (35, 139, 43)


def test_beacons_file_replaces_and_adds(campaign):
    stations = {"M2": {"enu": [1, 2, 3], "sigma_enu": [0.1, 0.2, 0.3]}, "M7": {"enu": [4, 5, 6]}}
    found = {b.name: b for b in read_garpos(*campaign(beacons={"beacons": stations})).beacons}
    assert list(found) == ["M1", "M2", "M3", "M7"]
    assert found["M1"].position.tolist() == [11.0, 22.0, -997.0]
    assert found["M2"].position.tolist() == [1.0, 2.0, 3.0]
    assert found["M2"].sigma.tolist() == [0.1, 0.2, 0.3]
    assert found["M7"].sigma.tolist() == [0.0] * 3


def test_a_configuration_may_lack_origin_and_shift(campaign):
    short = "M1_dPos = 1 2 3\nATDoffset = 0 0 0\n"
    found = read_garpos(*campaign(config=short))
    assert found.origin is None
    assert found.beacons[0].position.tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize(
    ("ping", "field", "words"),
    [
        (row(tt=-0.1), "TT", "-0.1 s is outside"),
        (row(tt=61, rt=99), "TT", "61.0 s is outside"),
        (row(tt="nan"), "TT", "nan is not a finite number"),
        (row(tt="late"), "TT", "'late' is not a number"),
        (row(st="nan"), "ST", "nan is not a finite number"),
        (row(st=9.0, rt=8.0), "RT", "8.0 s is before the transmit time"),
        (row(mt=""), "MT", "the value is missing"),
        (row(flag="maybe"), "flag", "'maybe' is neither True nor False"),
        (row().replace(",20.5,", ",nan,"), "ant_u1", "nan is not a finite number"),
        (row().replace(",20,90,", ",20,inf,"), "head0", "inf is not a finite number"),
        (row().replace(",20,90,", ",20,9000,"), "head0", "9000.0 degrees is outside"),
    ],
)
def test_wrong_pings(campaign, ping, field, words):
    files = campaign([row(st=-10, rt=-7), ping])
    failure(read_garpos, *files, file="obs.csv", row=2, line=4, field=field, words=words)


def test_columns_and_pings_must_be_there(campaign):
    files = campaign([row(flag="True")])
    failure(read_garpos, *files, file="obs.csv", words="every ping is flagged")
    failure(read_garpos, *campaign([]), file="obs.csv", words="no row below the header")
    files = campaign(header=HEADER.replace("roll1", "Roll1"))
    failure(read_garpos, *files, file="obs.csv", field="roll1", words="did you mean 'Roll1'?")


@pytest.mark.parametrize(
    ("old", "new", "place", "words"),
    [
        ("ATDoffset", "ATDofset", {"field": "ATDoffset"}, "did you mean 'ATDofset'?"),
        (
            "1.0     30.0   0.0  0.0  0.0",
            "1.0",
            {"field": "ATDoffset", "line": 11},
            "2 of 3 numbers",
        ),
        ("  30.0 ", "deep ", {"field": "ATDoffset", "line": 11}, "'deep' is not a number"),
        ("=12.0 22.0 -1002.0", "=12.0 22.0", {"field": "M3_dPos", "line": 9}, "2 of 3 numbers"),
        ("-1002.0", "nan", {"field": "M3_dPos", "line": 9}, "not a finite number"),
        ("M3_dPos", "M1_dPos", {"field": "M1_dPos", "line": 9}, "twice (before on line 7)"),
        (" Longitude0", " Longitude", {"field": "Longitude0"}, "is missing"),
    ],
)
def test_wrong_configurations(campaign, old, new, place, words):
    files = campaign(config=CONFIG.replace(old, new))
    failure(read_garpos, *files, file="cfg.ini", words=words, **place)


def test_absurd_configurations_name_the_file(campaign):
    files = campaign(config=CONFIG.replace("35.0", "95.0"))
    place = {"file": "cfg.ini", "field": "latitude", "kind": ConfigurationError}
    failure(read_garpos, *files, **place, words="95.0 is outside")
    files = campaign(config=CONFIG.replace("30.0", "3e5"))
    place = {"file": "cfg.ini", "field": "ATDoffset.down", "kind": ConfigurationError}
    failure(read_garpos, *files, **place)


@pytest.mark.parametrize(
    ("beacons", "place", "words"),
    [
        ('{"beacons":\n {"M1" 3}}', {"line": 2}, "no JSON"),
        ([1, 2], {"field": "beacons"}, "the beacons are missing"),
        ({"beacon": {}}, {"field": "beacons"}, "the beacons are missing"),
        ({"beacons": {"M1": [1, 2, 3]}}, {"record": "beacon 'M1'", "field": "enu"}, "missing"),
        (
            {"beacons": {"M1": {"enu": [1, "two", 3]}}},
            {"record": "beacon 'M1'", "field": "enu"},
            "no east, north, up",
        ),
        (
            {"beacons": {"M1": {"enu": [1, 2, 3], "sigma_enu": [-1, 0, 0]}}},
            {"record": "beacon 'M1'", "field": "sigma_enu"},
            "no standard deviation",
        ),
    ],
)
def test_wrong_beacon_files(campaign, beacons, place, words):
    file = campaign(beacons=beacons)[2]
    failure(read_beacons, file, file="beacons.json", words=words, **place)


# Garpos missions


def mission_file(folder: Path, data: str, more: str = "") -> Path:
    file = folder / "mission.toml"
    file.write_text(f'{more}\n[data]\nformat = "garpos"\n{data}\n')
    return file


DATA = 'observations = "obs.csv"\nconfig = "cfg.ini"\nsound_speed = 1500'


def test_a_garpos_mission(campaign, tmp_path):
    campaign()
    mission = load_mission(mission_file(tmp_path, DATA))
    assert mission.name == "mission"
    assert mission.sound_speed.is_constant and mission.sound_speed.speed[0] == 1500.0
    assert mission.options.vertical_acceleration_psd == 0.3
    assert mission.vehicle.transducer.is_zero
    options = "[options]\nvertical_acceleration_psd = 1\ntravel_time_sigma = 5e-5"
    mission = load_mission(mission_file(tmp_path, DATA, options))
    assert mission.options.vertical_acceleration_psd == 1.0
    assert mission.segments[0].two_way_range.sigma[0] == 5e-5


@pytest.mark.parametrize(
    ("data", "more", "place", "words"),
    [
        (DATA, "[vehicle]\n", {"field": "vehicle"}, "'vehicle' does not go with format = 'garpos'"),
        (DATA, "[start]\nt = 0", {"field": "start"}, "'start' does not go with"),
        (DATA, "[sound_speed]\nconstant = 1500", {"field": "sound_speed"}, "does not go with"),
        (DATA, '[[beacon]]\nname = "B"', {"field": "beacon"}, "does not go with"),
        (DATA + '\nvelocity = "v.csv"', "", {"field": "data.velocity"}, "it belongs to format"),
        (DATA + '\nbeacon = "b.csv"', "", {"field": "data.beacon"}, "did you mean 'beacons'?"),
        (DATA + "\nlines = []", "", {"field": "data.lines"}, "the list is empty"),
        (DATA + '\nlines = ["S1/L8"]', "", {"field": "data.lines"}, "there is no line"),
        (DATA + "\nlines = [1]", "", {"field": "data.lines"}, "1 is not a text in quotes"),
        (DATA.replace("1500", "true"), "", {"field": "data.sound_speed"}, "neither a number"),
        ('observations = "obs.csv"', "", {"field": "data.config"}, "the key is missing"),
    ],
)
def test_wrong_garpos_missions(campaign, tmp_path, data, more, place, words):
    campaign()
    file = mission_file(tmp_path, data, more)
    failure(load_mission, file, kind=ConfigurationError, file="mission.toml", words=words, **place)


def test_wrong_data_of_garpos_missions(campaign, tmp_path):
    campaign()
    slow = mission_file(tmp_path, DATA.replace("1500", "1.5"))
    failure(load_mission, slow, file="mission.toml", field="data.sound_speed", words="1.5 m/s")
    campaign([row(), row(1, mt="M9", st=5, rt=7.5)])
    file = mission_file(tmp_path, DATA)
    place = {"file": "obs.csv", "row": 2, "line": 4, "field": "MT"}
    failure(load_mission, file, **place, words="unknown beacon 'M9'")
    campaign([row(), row(1, st=5, rt=7.5), row(2)])
    place = {"file": "obs.csv", "row": 3, "line": 5, "field": "RT"}
    failure(load_mission, file, **place, words="duplicate record")


# The real campaign


def real(folder: Path, **changes):
    files = {
        "observations": folder / f"{NAME}-obs.csv",
        "config": folder / f"{NAME}-initcfg.ini",
        "beacons": folder / "SAGA.1903-garpos-solution.json",
    }
    return read_garpos(**{**files, **changes})


def test_saga_lines_and_counts(saga):
    everything = real(saga)
    sizes = {s.name: len(s.two_way_range) for s in everything.segments}
    assert list(sizes) == [f"S0{1 + (i > 5)}/L{i:02}" for i in range(1, 11)]
    assert sum(sizes.values()) == 3614
    lines = real(saga, lines=STRAIGHT)
    assert [s.name for s in lines.segments] == list(STRAIGHT)
    assert sum(len(s.two_way_range) for s in lines.segments) == 1886


def test_saga_turnaround_is_constant(saga):
    pings = [segment.two_way_range for segment in real(saga).segments]
    waits = np.concatenate([p.t_receive - p.t_transmit - p.travel_time for p in pings])
    assert np.ptp(waits) < 6e-6
    np.testing.assert_allclose(waits.mean(), 1.06151, atol=5e-6)


def test_saga_beacons(saga):
    solved = {b.name: b.position for b in real(saga).beacons}
    stated = {b.name: b.position for b in real(saga, beacons=None).beacons}
    assert solved["M13"].tolist() == [-26.3103, -505.9327, -1335.895]
    assert stated["M13"].tolist() == [-26.358, -506.143, -1335.817]
    assert list(solved) == list(stated) == ["M11", "M12", "M13", "M14"]


def test_saga_transducer_follows_the_stated_rotation(saga):
    segment = real(saga, lines=["S01/L01"]).segments[0]
    # The first row, by another library: north-east-down, Rz(head) Ry(pitch) Rx(roll).
    turn = Rotation.from_euler("ZYX", [176.47, 0.59, -1.39], degrees=True)
    north, east, down = turn.apply([1.5547, -1.2690, 23.7295])
    expected = [-27.85291 + east, 1473.14423 + north, 14.73469 - down]
    np.testing.assert_allclose(segment.reference.position[0], expected, atol=1e-9)
    np.testing.assert_allclose(segment.depth.depth[0], -expected[2], atol=1e-9)
    assert len(segment.depth) == 2 * len(segment.two_way_range)


def test_saga_estimator_never_sees_east_and_north(saga, tmp_path):
    header, *rows = (saga / f"{NAME}-obs.csv").read_text().splitlines()[1:]
    columns = header.split(",")
    shifted = tmp_path / "shifted.csv"
    lines = [header]
    for text in rows:
        cells = text.split(",")
        for name in ("ant_e0", "ant_n0", "ant_e1", "ant_n1"):
            cells[columns.index(name)] = repr(float(cells[columns.index(name)]) + 5000.0)
        lines.append(",".join(cells))
    shifted.write_text("\n".join(lines))
    here, there = real(saga), real(saga, observations=shifted)
    for a, b in zip(here.segments, there.segments, strict=True):
        assert a.records().keys() == b.records().keys() == {"two_way_range", "depth"}
        for kind, columns_of in (
            ("two_way_range", ("beacon", "t_transmit", "t_receive", "travel_time", "sigma")),
            ("depth", ("t", "depth", "sigma")),
        ):
            for name in columns_of:
                mine, other = (getattr(getattr(s, kind), name) for s in (a, b))
                assert mine.tobytes() == other.tobytes()
        assert a.start is None and a.attitude is None
        assert np.array_equal(a.reference.t, b.reference.t)
        shift = b.reference.position - a.reference.position
        np.testing.assert_allclose(shift, [[5000.0, 5000.0, 0.0]] * len(shift), atol=1e-9)


def test_saga_mission_file(saga, tmp_path):
    file = tmp_path / "saga.toml"
    file.write_text(
        f"""
[mission]
name = "SAGA.1903"
[data]
format = "garpos"
observations = '{saga / f"{NAME}-obs.csv"}'
config = '{saga / f"{NAME}-initcfg.ini"}'
sound_speed = '{saga / f"{NAME}-svp.csv"}'
beacons = '{saga / "SAGA.1903-garpos-solution.json"}'
lines = ["S01/L01", "S01/L02"]
"""
    )
    mission = load_mission(file)
    assert [s.name for s in mission.segments] == ["S01/L01", "S01/L02"]
    assert mission.name == "SAGA.1903"
    assert mission.uses_eigenrays and len(mission.sound_speed.depth) == 34
    assert mission.origin.height == 43.0
