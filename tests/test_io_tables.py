from __future__ import annotations

import csv
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ubl_graph.beacon import Beacon
from ubl_graph.errors import ConfigurationError, DataError
from ubl_graph.frames import GeodeticOrigin
from ubl_graph.io import records
from ubl_graph.io.columns import HORIZONTAL_COVARIANCE, VERTICAL_COVARIANCE
from ubl_graph.io.tables import naming, nearest, read_table

BEACONS = (Beacon("B1", [0.0, 0.0, -10.0], turnaround=0.5), Beacon("B2", [9.0, 0.0, -10.0]))


@pytest.fixture
def write(tmp_path):
    def write_file(content: str | bytes, name: str = "data.csv") -> Path:
        file = tmp_path / name
        file.write_bytes(content if isinstance(content, bytes) else content.encode())
        return file

    return write_file


def failure(read, *args, row=None, line=None, field=None, words="", kind=DataError, **kwargs):
    """The error that `read` raises on a file, its place and its one line checked."""
    with pytest.raises(DataError) as caught:
        read(*args, **kwargs)
    error = caught.value
    assert type(error) is kind
    assert (str(error.file), error.row, error.line, error.field) == (str(args[0]), row, line, field)
    assert "\n" not in str(error) and words in str(error)
    return error


# Tables


@pytest.mark.parametrize("start", ["", "\ufeff", "# made by hand\n\n", "\n   \n#\n"])
@pytest.mark.parametrize("end_of_line", ["\n", "\r\n", "\r"])
def test_comments_blank_lines_and_marks_are_skipped(write, start, end_of_line):
    text = start + 't , name\n 1.5,B1\n\n  # 9,9\n-2e3 , "B 2"\n\n'
    table = read_table(write(text.replace("\n", end_of_line)))
    above = start.count("\n")
    assert table.names == ("t", "name")
    assert table.numbers("t").tolist() == [1.5, -2000.0]
    assert table.text("name").tolist() == ["B1", "B 2"]
    assert table.source.row.tolist() == [1, 2]
    assert table.source.line.tolist() == [above + 2, above + 5]


@pytest.mark.parametrize(
    ("content", "line", "field", "words"),
    [
        ("", None, None, "the file is empty"),
        ("# nothing\n\n", None, None, "the file is empty"),
        ("t,a\n# none\n", None, None, "no row below the header"),
        ("1.0,2.0\n3.0,4.0\n", 1, None, "the first line holds numbers"),
        ("#\nt,a,t\n1,2,3\n", 2, "t", "'t' is there twice"),
        ('t,a\n1,2\n#\n3,"4\n5,6\n', 4, None, "the row cannot be read"),
        ('t,a\n1,2\n3,"4\n5"\n6,7\n', 3, None, "a quoted value does not end on its line"),
        (b"t,a\n1,2\n1,\xff\n", 3, None, "byte 0xff is no UTF-8 text"),
        ("t,a\n1,2\n".encode("utf-16"), 1, None, "save the file as UTF-8"),
    ],
)
def test_unreadable_tables(write, content, line, field, words):
    failure(read_table, write(content), line=line, field=field, words=words)


@pytest.mark.parametrize(
    ("row", "words"), [("3", "1 value, the header names 2"), ("3,4,5", "3 values, the header")]
)
def test_rows_of_another_width(write, row, words):
    many = "".join(f"{i},0\n" for i in range(250))
    failure(read_table, write(f"t,a\n{many}#\n{row}\n1,2\n"), row=251, line=253, words=words)


def test_missing_files_and_folders(tmp_path, write):
    write("t\n1\n", "ranges.csv")
    failure(read_table, tmp_path / "range.csv", words="did you mean 'ranges.csv'?")
    failure(read_table, tmp_path / "none" / "ranges.csv", words="there is no folder")
    failure(read_table, tmp_path, words="this is a folder")
    failure(read_table, "a\0b", words="cannot be read")


def test_missing_columns_name_what_is_there(write):
    table = read_table(write("T_Transmit,a\n1,2\n"))
    with pytest.raises(DataError) as caught:
        table.require("a", "t_transmit")
    assert caught.value.field == "t_transmit"
    assert "did you mean 'T_Transmit'? columns found: T_Transmit, a" in str(caught.value)


@pytest.mark.parametrize(
    ("cell", "words"),
    [
        ("deep", "'deep' is not a number"),
        ("1_5", "'1_5' is not a number"),
        ('"1,5"', "'1,5' is not a number"),
        ("", "the value is missing"),
        ("x" * 99, "xxx... is not a number"),
    ],
)
def test_cells_that_are_no_numbers(write, cell, words):
    table = read_table(write(f"t,a\n1,2\n\n3,{cell}\n"))
    with pytest.raises(DataError) as caught:
        table.numbers("a")
    error = caught.value
    assert (error.file, error.row, error.line, error.field) == (table.file, 2, 4, "a")
    assert words in str(error) and len(error.problem) < 80


@given(
    st.lists(
        st.tuples(
            st.floats(allow_nan=False, allow_infinity=False),
            st.text(st.characters(codec="utf-8", exclude_categories=["C", "Z"]), min_size=1),
        ),
        min_size=1,
        max_size=8,
    )
)
def test_what_csv_writes_is_read_back(tmp_path_factory, rows):
    file = tmp_path_factory.mktemp("round") / "trip.csv"
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(["number", "word"])
        writer.writerows((repr(number), word) for number, word in rows)
    table = read_table(file)
    assert table.numbers("number").tolist() == [number for number, _ in rows]
    assert table.text("word").tolist() == [word for _, word in rows]


def test_large_files_are_read_fast(write):
    row = "12345.678901,1.234567,-0.012345,0.001234,0.01\n"
    file = write("t,forward,right,down,sigma\n" + row * 200_000)
    start = time.perf_counter()
    table = read_table(file)
    total = sum(table.numbers(name).size for name in table.names)
    assert total == 1_000_000
    assert time.perf_counter() - start < 5.0


def test_naming_completes_errors_but_leaves_their_files():
    with pytest.raises(ConfigurationError) as caught, naming("m.toml", "start.", record="r"):
        raise ConfigurationError("bad", "mend it", field="t")
    error = caught.value
    assert (error.file, error.field, error.record) == ("m.toml", "start.t", "r")
    with pytest.raises(DataError) as caught, naming("m.toml", columns={"travel_time": "TT"}):
        raise DataError("bad", file="a.csv", row=3, field="travel_time")
    assert (caught.value.file, caught.value.row, caught.value.field) == ("a.csv", 3, "TT")


def test_nearest_ignores_case_and_far_names():
    assert nearest("SGIMA", ("up", "Sigma")) == "Sigma"
    assert nearest("temperature", ("t", "sigma")) is None


# Records


def test_two_way_ranges(write):
    text = "beacon,t_transmit,t_receive,travel_time,ping\nB2,10,11.6,1.1,7\nB1,0,1.5,1.0,6\n"
    pings = records.read_two_way_range(write(text), sigma=3e-4)
    assert pings.beacon.tolist() == ["B2", "B1"]
    assert pings.travel_time.tolist() == [1.1, 1.0]
    assert pings.sigma.tolist() == [3e-4, 3e-4]
    assert pings.source.line.tolist() == [2, 3]


def test_two_way_ranges_from_slant_ranges(write):
    text = "beacon,t_transmit,t_receive,slant_range,sound_speed,sigma\nB1,0,3,1500,1500,2e-4\n"
    pings = records.read_two_way_range(write(text))
    assert (pings.travel_time[0], pings.sigma[0]) == (2.0, 2e-4)


def test_two_way_ranges_from_times_alone(write):
    file = write("beacon,t_transmit,t_receive\nB1,0,3\nB1,10,12.75\n")
    assert records.read_two_way_range(file, BEACONS).travel_time.tolist() == [2.5, 2.25]


BARE = "beacon,t_transmit,t_receive\nB1,0,3\n"
FULL = "beacon,t_transmit,t_receive,travel_time\nB1,0,3,2\n"
SLANT = "beacon,t_transmit,t_receive,slant_range,sound_speed\nB1,0,3,1500,1500\n"


@pytest.mark.parametrize(
    ("text", "place", "words"),
    [
        (FULL + "B1,10,13,-0.1\n", (2, 3, "travel_time"), "-0.1 s is outside"),
        (FULL + "B1,10,99,61\n", (2, 3, "travel_time"), "61.0 s is outside"),
        (FULL + "B1,10,9,1\n", (2, 3, "t_receive"), "before the transmit time"),
        (FULL + "B1,10,13,nan\n", (2, 3, "travel_time"), "nan is not a finite number"),
        (FULL + "B1,10,soon,1\n", (2, 3, "t_receive"), "'soon' is not a number"),
        (FULL + ",10,13,1\n", (2, 3, "beacon"), "the value is missing"),
        (SLANT + "B1,10,13,-1,1500\n", (2, 3, "slant_range"), "-1.0 m is no slant range"),
        (SLANT + "B1,10,13,900,150\n", (2, 3, "sound_speed"), "150.0 m/s is no speed"),
        (SLANT.replace(",sound_speed", ",c"), (None, None, "sound_speed"), "is missing"),
        (SLANT.replace(",slant_range", ",d"), (None, None, "slant_range"), "is missing"),
        (BARE + "B1,10,10.2\n", (2, 3, "t_receive"), "before the reply was sent"),
        (BARE + "B1,10,9\n", (2, 3, "t_receive"), "before the reply was sent"),
        (BARE + "b1,10,13\n", (2, 3, "beacon"), "unknown beacon 'b1'; did you mean 'B1'?"),
    ],
)
def test_wrong_two_way_ranges(write, text, place, words):
    row, line, field = place
    file = write(text)
    failure(records.read_two_way_range, file, BEACONS, row=row, line=line, field=field, words=words)


def test_a_needed_turnaround_names_the_beacon(write):
    failure(
        records.read_two_way_range,
        write(BARE + "B2,10,13\n"),
        BEACONS,
        row=2,
        line=3,
        field="travel_time",
        kind=ConfigurationError,
        words="beacon 'B2' states no turnaround",
    )


def test_one_way_ranges(write):
    heard = records.read_one_way_range(
        write("beacon,t_transmit,t_receive\nB1,0,1.25\n"), sigma=2e-4
    )
    assert (heard.travel_time[0], heard.sigma[0]) == (1.25, 2e-4)


def test_velocities(write):
    text = "t,forward,right,down,reference\n1,1.5,0.1,-0.2,bottom\n2,1.5,0.1,-0.2,water\n"
    velocity = records.read_velocity(write(text))
    assert velocity.reference.tolist() == ["bottom", "water"]
    assert velocity.sigma.tolist() == [0.01, 0.01]
    assert velocity.down.tolist() == [-0.2, -0.2]


def test_attitudes_are_degrees_in_files(write):
    attitude = records.read_attitude(write("t,heading,roll,sigma\n0,90,-180,0.1\n1,450,5,0.1\n"))
    np.testing.assert_allclose(attitude.heading, [np.pi / 2, 5 * np.pi / 2], rtol=1e-15)
    np.testing.assert_allclose(attitude.roll, np.deg2rad([-180, 5]), rtol=1e-15)
    np.testing.assert_allclose(attitude.sigma, np.deg2rad(0.1), rtol=1e-15)
    assert attitude.pitch.tolist() == [0.0, 0.0]


def test_slant_ranges(write):
    ranges = records.read_slant_range(write("t,beacon,distance\n0,B1,12.5\n1,B2,13\n"))
    assert ranges.beacon.tolist() == ["B1", "B2"]
    assert ranges.distance.tolist() == [12.5, 13.0]
    assert ranges.sigma.tolist() == [1.0, 1.0]


def test_headings_and_angular_rates_are_degrees_in_files(write):
    heading = records.read_heading(write("t,heading,sigma\n0,-90,2\n"))
    np.testing.assert_allclose(heading.heading, [-np.pi / 2], rtol=1e-15)
    np.testing.assert_allclose(heading.sigma, np.deg2rad(2), rtol=1e-15)
    gyro = records.read_angular_rate(write("t,about_down,about_right,sigma\n0,5,-3,0.1\n"))
    np.testing.assert_allclose(gyro.rate, np.deg2rad([[0, 3, -5]]), rtol=1e-15)
    np.testing.assert_allclose(gyro.sigma, np.deg2rad(0.1), rtol=1e-15)


PLANE = "t_from,t_to,forward,right,about_down"


def test_odometry_of_a_plane(write):
    steps = records.read_odometry(write(f"{PLANE}\n0,1,1.5,0.1,10\n1,2,1.5,0.1,-10\n"))
    assert (steps.dimension, steps.covariance) == (2, None)
    assert steps.translation.tolist() == [[1.5, -0.1, 0.0]] * 2
    np.testing.assert_allclose(steps.about_down, np.deg2rad([10, -10]), rtol=1e-15)
    steps = records.read_odometry(write(f"{PLANE},sigma,sigma_turn\n0,1,1,0,0,0.1,2\n"))
    np.testing.assert_allclose(
        steps.covariance, [np.diag([0.01, 0.01, np.deg2rad(2) ** 2])], rtol=1e-14
    )


def test_odometry_in_space(write):
    steps = records.read_odometry(write(f"{PLANE},about_right\n0,1,1.5,0.1,10,-3\n"))
    assert (steps.dimension, steps.down.tolist()) == (3, [0.0])
    np.testing.assert_allclose(steps.rotation_vector, np.deg2rad([[0, 3, -10]]), rtol=1e-15)
    text = f"{PLANE},down,sigma,sigma_turn\n0,1,1,0,0,0.2,0.1,2\n"
    steps = records.read_odometry(write(text))
    assert steps.translation.tolist() == [[1.0, 0.0, -0.2]]
    turn = np.deg2rad(2) ** 2
    np.testing.assert_allclose(steps.covariance, [np.diag([0.01] * 3 + [turn] * 3)], rtol=1e-14)


def test_depths(write):
    depth = records.read_depth(write("t,depth\n0,12.5\n"))
    assert (depth.depth[0], depth.sigma[0]) == (12.5, 0.1)


@pytest.mark.parametrize(
    ("read", "text", "place", "words"),
    [
        (records.read_velocity, "t,forward,right,down\n0,1,0,99\n", (1, 2, "down"), "99.0 m/s"),
        (records.read_attitude, "t,heading\n0,721\n", (1, 2, "heading"), "721.0 degrees is outs"),
        (records.read_attitude, "t,heading\n0,nan\n", (1, 2, "heading"), "nan is not a finite"),
        (records.read_attitude, "t,heading,pitch\n0,1,-181\n", (1, 2, "pitch"), "-181.0 degrees"),
        (records.read_slant_range, "t,beacon,distance\n0,B,-1\n", (1, 2, "distance"), "-1.0 m is"),
        (records.read_slant_range, "t,beacon,distance\n0,B,0\n", (1, 2, "distance"), "no distance"),
        (records.read_slant_range, "t,beacon,range\n0,B,5\n", (None, None, "distance"), "missing"),
        (records.read_heading, "t,heading\n0,721\n", (1, 2, "heading"), "721.0 degrees is outs"),
        (
            records.read_angular_rate,
            "t,about_down\n0,1\n1,600\n",
            (2, 3, "about_down"),
            "600.0 degrees/s is outside -572.958 to 572.958 degrees/s",
        ),
        (
            records.read_angular_rate,
            "t,about_down,about_rigth\n0,1,2\n",
            (None, None, "about_rigth"),
            "did you mean 'about_right'?",
        ),
        (records.read_odometry, f"{PLANE}\n1,1,0,0,0\n", (1, 2, "t_to"), "1.0 s is not after"),
        (records.read_odometry, f"{PLANE}\n0,1,0,0,361\n", (1, 2, "about_down"), "361.0 degrees"),
        (
            records.read_odometry,
            f"{PLANE},sigma\n0,1,0,0,0,0.1\n",
            (None, None, "sigma_turn"),
            "is missing",
        ),
        (
            records.read_odometry,
            f"{PLANE},sigma,sigma_turn\n0,1,0,0,0,0.1,0\n",
            (1, 2, "sigma_turn"),
            "0.0 degrees is outside",
        ),
        (records.read_depth, "t,depth\n0,2e4\n", (1, 2, "depth"), "20000.0 m is outside"),
        (records.read_depth, "t,dept\n0,2\n", (None, None, "depth"), "did you mean 'dept'?"),
        (records.read_depth, "t,depth,sgima\n0,2,1\n", (None, None, "sgima"), "mean 'sigma'?"),
        (records.read_depth, "t,depth,Sigma\n0,2,1\n", (None, None, "Sigma"), "mean 'sigma'?"),
        (
            records.read_velocity,
            "t,forward,right,down,refrence\n0,1,0,0,water\n",
            (None, None, "refrence"),
            "did you mean 'reference'?",
        ),
        (
            records.read_velocity,
            "t,forward,right,down,reference\n0,1,0,0,ground\n",
            (1, 2, "reference"),
            "ground is neither 'bottom' nor 'water'",
        ),
    ],
)
def test_wrong_records(write, read, text, place, words):
    row, line, field = place
    failure(read, write(text), row=row, line=line, field=field, words=words)


def test_other_columns_are_ignored(write):
    text = "index,t,depth,sigma,temperature,sigmas\n1,0,12,0.3,cold,?\n"
    assert records.read_depth(write(text)).sigma.tolist() == [0.3]


def test_fixes_in_metres(write):
    assert records.read_position(write("t,east,north\n0,1,2\n")).dimension == 2
    fix = records.read_position(write("t,east,north,up,sigma\n0,1,2,-3,0.5\n"))
    assert fix.position.tolist() == [[1.0, 2.0, -3.0]]
    assert fix.covariances[0].tolist() == (0.25 * np.eye(3)).tolist()


def test_fixes_with_covariances(write):
    names = ",".join(HORIZONTAL_COVARIANCE)
    flat = records.read_position(write(f"t,east,north,{names}\n0,1,2,4,1,9\n"))
    assert flat.covariances.tolist() == [[[4.0, 1.0], [1.0, 9.0]]]
    names += "," + ",".join(VERTICAL_COVARIANCE)
    full = records.read_position(write(f"t,east,north,up,{names}\n0,1,2,3,4,1,9,0.1,0.2,16\n"))
    assert full.covariances.tolist() == [[[4.0, 1.0, 0.1], [1.0, 9.0, 0.2], [0.1, 0.2, 16.0]]]


def test_fixes_in_degrees(write):
    origin = GeodeticOrigin(34.96, 139.26, 43.0)
    file = write("t,latitude,longitude,height\n0,34.97,139.26,43\n1,34.96,139.27,40\n")
    fix = records.read_position(file, origin)
    oracle = origin.to_enu([34.97, 34.96], [139.26, 139.27], [43.0, 40.0])
    assert np.array_equal(fix.position, oracle)
    flat = records.read_position(write("t,latitude,longitude\n0,34.97,139.26\n"), origin)
    assert flat.dimension == 2
    assert np.array_equal(flat.position, oracle[:1, :2])


@pytest.mark.parametrize(
    ("text", "place", "words"),
    [
        ("t,lat\n0,1\n", (None, None, "east"), "columns found: t, lat"),
        ("t,east,nroth\n0,1,2\n", (None, None, "north"), "did you mean 'nroth'?"),
        ("t,latitude\n0,1\n", (None, None, "longitude"), "is missing"),
        ("t,latitude,longitude\n0,91,2\n", (1, 2, "latitude"), "91.0 degrees is outside"),
        ("t,latitude,longitude\n0,nan,2\n", (1, 2, "latitude"), "nan is not a finite"),
        ("t,east,north,cov_east_east\n0,1,2,3\n", (None, None, "cov_east_north"), "missing"),
        ("t,east,north,cov_up_up\n0,1,2,3\n", (None, None, "up"), "missing"),
        (
            "t,east,north,cov_east_east,cov_east_north,cov_north_north\n0,1,2,1,2,1\n",
            (1, 2, "covariance"),
            "not symmetric and positive definite",
        ),
    ],
)
def test_wrong_fixes(write, text, place, words):
    row, line, field = place
    file = write(text)
    origin = GeodeticOrigin(34.96, 139.26)
    failure(records.read_position, file, origin, row=row, line=line, field=field, words=words)


def test_latitudes_need_an_origin(write):
    file = write("t,latitude,longitude\n0,34.97,139.26\n")
    failure(
        records.read_position, file, field="latitude", kind=ConfigurationError, words="an origin"
    )


def test_sound_speed_profiles(write):
    profile = records.read_sound_speed(write("Depth, SPEED,salinity\n0,1500,35\n100,1490,35\n"))
    assert profile.depth.tolist() == [0.0, 100.0]
    assert profile.speed.tolist() == [1500.0, 1490.0]


@pytest.mark.parametrize(
    ("text", "place", "words"),
    [
        ("depth,speed\n0,1500\n#\n10,15\n", (2, 4, "speed"), "15.0 m/s is no speed of sound"),
        ("depth,speed\n0,1500\n10,nan\n", (2, 3, "speed"), "nan is not a finite number"),
        ("depth,speed\n0,1500\n10,1500\n10,1500\n", (3, 4, "depth"), "10.0 m is not below"),
        ("depth,velocity\n0,1500\n", (None, None, "speed"), "columns found: depth, velocity"),
        ("depth,speed\n", (None, None, None), "no row below the header"),
    ],
)
def test_wrong_sound_speed_profiles(write, text, place, words):
    row, line, field = place
    failure(records.read_sound_speed, write(text), row=row, line=line, field=field, words=words)


FINITE = st.floats(-1e6, 1e6)


@given(
    st.lists(st.tuples(FINITE, st.floats(-720, 720), st.floats(-180, 180)), min_size=1, max_size=6)
)
def test_attitudes_survive_being_written(tmp_path_factory, rows):
    file = tmp_path_factory.mktemp("attitude") / "attitude.csv"
    lines = [",".join(map(repr, row)) for row in rows]
    file.write_text("\n".join(["t,heading,pitch", *lines]))
    attitude = records.read_attitude(file)
    assert attitude.t.tolist() == [row[0] for row in rows]
    np.testing.assert_allclose(np.rad2deg(attitude.heading), [r[1] for r in rows], atol=1e-12)
    np.testing.assert_allclose(np.rad2deg(attitude.pitch), [r[2] for r in rows], atol=1e-12)
