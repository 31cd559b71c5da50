"""PyFG files: what is read, what is written, what is refused."""

from __future__ import annotations

import string
from pathlib import Path

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ubl_graph.errors import DataError
from ubl_graph.io.pyfg import (
    TOKENS,
    PointRows,
    PoseRows,
    PyfgGraph,
    RangeRows,
    read_pyfg,
    write_pyfg,
)

KINDS = tuple(dict.fromkeys(layout.kind for layout in TOKENS.values()))
EYE3, EYE6 = "1 0 0 1 0 1", " ".join(map(str, np.eye(6)[np.triu_indices(6)]))
STILL = "0 0 0 1"

#: One line of each token, so that every check has something to bite on.
PLANAR = f"""\
VERTEX_SE2 0.5 A0 1 2 0.1
VERTEX_SE2 1.5 A1 2 2 0.2
VERTEX_SE2 2.5 B0 9 9 0
VERTEX_XY L0 10 20
VERTEX_SE2:PRIOR 0.5 A0 1 2 0.1 {EYE3}
VERTEX_XY:PRIOR 0.0 L0 10 20 4 0 9
EDGE_SE2 1.5 A0 A1 1 0 0.1 4 1 0.5 9 0.25 1
EDGE_SE2_XY 1.5 A1 L0 8 18 1 0.5 2
EDGE_RANGE 1.5 A1 L0 19.5 0.25
EDGE_RANGE 1.5 A1 B0 9.5 0.5
"""
SPATIAL = f"""\
VERTEX_SE3:QUAT 0 A0 1 2 3 {STILL}
VERTEX_SE3:QUAT 0 A1 1 2 3 0 0 0.7071068 0.7071068
VERTEX_XYZ L0 1 2 3
VERTEX_SE3:QUAT:PRIOR 0 A0 1 2 3 {STILL} {EYE6}
VERTEX_XYZ:PRIOR 0 L0 1 2 3 {EYE3}
EDGE_SE3:QUAT 0 A0 A1 1 2 3 {STILL} {EYE6}
EDGE_SE3_XYZ 0 A0 L0 1 2 3 {EYE3}
EDGE_RANGE 0 A0 L0 4 0.5625
"""


@pytest.fixture
def read(tmp_path):
    def reads(text: str | bytes) -> PyfgGraph:
        file = tmp_path / "graph.pyfg"
        file.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_pyfg(file)

    return reads


def bits(graph: PyfgGraph) -> dict[str, list[object]]:
    """All that a graph holds, as bytes: -0.0 is not 0.0."""
    out: dict[str, list[object]] = {"dimension": [graph.dimension]}
    for kind in KINDS:
        rows = getattr(graph, kind)
        numbers = (rows.t, rows.values, rows.covariance)
        out[kind] = [rows.name.tolist(), *((a.shape, a.tobytes()) for a in numbers)]
    return out


# What is read


def test_every_token_is_read_into_its_place(read):
    graph = read(PLANAR)
    assert graph.dimension == 2 and graph.robots == ("A", "B")
    assert graph.poses.first == ["A0", "A1", "B0"]
    assert graph.poses.t.tolist() == [0.5, 1.5, 2.5]
    assert graph.poses.position.tolist() == [[1, 2], [2, 2], [9, 9]]
    np.testing.assert_array_equal(graph.poses.rotation_vector[:, 2], [0.1, 0.2, 0.0])
    assert graph.landmarks.first == ["L0"] and graph.landmarks.position.tolist() == [[10, 20]]
    assert graph.pose_priors.first == ["A0"]
    assert graph.landmark_priors.covariance.tolist() == [[[4, 0], [0, 9]]]
    edges = graph.pose_edges
    assert (edges.first, edges.second) == (["A0"], ["A1"])
    assert edges.covariance.tolist() == [[[4, 1, 0.5], [1, 9, 0.25], [0.5, 0.25, 1]]]
    seen = graph.landmark_edges
    assert (seen.first, seen.second, seen.position.tolist()) == (["A1"], ["L0"], [[8, 18]])
    assert graph.ranges.name.tolist() == [["A1", "L0"], ["A1", "B0"]]
    assert graph.ranges.distance.tolist() == [19.5, 9.5]
    assert graph.ranges.variance.tolist() == [0.25, 0.5]
    assert graph.ranges.line.tolist() == [9, 10]


def test_a_spatial_file_has_translation_first_and_quaternions_with_w_last(read):
    numbers = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) + np.triu(np.arange(36).reshape(6, 6), 1) / 99
    triangle = " ".join(repr(v) for v in numbers[np.triu_indices(6)].tolist())
    edge = f"EDGE_SE3:QUAT 0 A0 A1 1 2 3 {STILL} "
    graph = read(SPATIAL.replace(edge + EYE6, edge + triangle))
    assert graph.dimension == 3
    (covariance,) = graph.pose_edges.covariance
    np.testing.assert_array_equal(covariance, np.triu(numbers) + np.triu(numbers, 1).T)
    # The rounded quaternion stays in the values, and is normalised where a rotation is asked for.
    assert graph.poses.values[1].tolist() == [1, 2, 3, 0, 0, 0.7071068, 0.7071068]
    np.testing.assert_allclose(graph.poses.rotation_vector[1], [0, 0, np.pi / 2], atol=1e-15)


@pytest.mark.parametrize("name", ["goats_15.pyfg", "goats_16.pyfg"])
def test_real_files_are_read_and_come_back(name, tmp_path):
    file = gtsam.findExampleDataFile(name)
    graph = read_pyfg(file)
    lines = [line.split() for line in Path(file).read_text().splitlines()]
    of = {token: [w for w in lines if w[0] == token] for token in {w[0] for w in lines}}
    assert of.keys() == {"VERTEX_XY", "VERTEX_SE2", "EDGE_SE2", "EDGE_RANGE"}
    assert graph.poses.first == [w[2] for w in of["VERTEX_SE2"]]
    assert graph.landmarks.first == [w[1] for w in of["VERTEX_XY"]]
    assert graph.pose_edges.name.tolist() == [w[2:4] for w in of["EDGE_SE2"]]
    assert graph.ranges.name.tolist() == [w[2:4] for w in of["EDGE_RANGE"]]
    assert graph.ranges.distance.tolist() == [float(w[4]) for w in of["EDGE_RANGE"]]
    assert set(graph.ranges.variance) == {0.5625}
    assert graph.ranges.line[0] == 1 + next(i for i, w in enumerate(lines) if w[0] == "EDGE_RANGE")
    write_pyfg(tmp_path / name, graph)
    assert bits(read_pyfg(tmp_path / name)) == bits(graph)


@pytest.mark.parametrize("text", [PLANAR, SPATIAL])
def test_vertices_may_stand_after_the_edges_that_name_them(text, read):
    lines = text.splitlines()
    edges_first = sorted(lines, key=lambda line: not line.startswith("EDGE"))
    assert edges_first != lines
    assert read("\n".join(edges_first)) == read(text)


def test_line_ends_blanks_tabs_and_a_byte_order_mark_do_not_matter(read):
    odd = "\ufeff\r\n" + PLANAR.replace("\n", " \r\n\r\n").replace(" ", "\t")
    graph = read(odd)
    assert graph == read(PLANAR)
    assert read(odd).ranges.line.tolist() == [18, 20]


def test_a_file_of_beacons_alone_is_a_graph(read):
    graph = read("VERTEX_XYZ L0 1 2 3\n")
    assert graph.dimension == 3 and len(graph.poses) == 0 and graph.robots == ()
    assert graph.ranges.distance.shape == (0,) and graph.poses.rotation_vector.shape == (0, 3)


# What is written

floats = st.floats(allow_nan=False, allow_infinity=False)


@st.composite
def covariances(draw, count: int, size: int):
    root = np.tril(draw(numbers((count, size, size), st.floats(-1.0, 1.0))), -1) + np.eye(size)
    scale = 10.0 ** draw(numbers((count, size), st.integers(-8, 8)))
    root = root * scale[:, :, None]
    full = root @ np.swapaxes(root, 1, 2)
    return np.triu(full) + np.swapaxes(np.triu(full, 1), 1, 2)


@st.composite
def numbers(draw, shape: tuple[int, ...], elements=floats):
    size = int(np.prod(shape))
    values = draw(st.lists(elements, min_size=size, max_size=size))
    return np.array(values, dtype=np.float64).reshape(shape)


@st.composite
def graphs(draw):
    dimension = draw(st.sampled_from([2, 3]))
    names = st.tuples(st.sampled_from("ABK"), st.integers(0, 10**6))
    poses = draw(st.lists(names, unique=True, min_size=1, max_size=4))
    poses = [f"{letter}{number}" for letter, number in poses]
    landmarks = draw(st.lists(st.integers(0, 99), unique=True, max_size=3))
    landmarks = [f"L{i}" for i in landmarks]
    place = {"pose": poses, "landmark": landmarks, "vertex": poses + landmarks}
    parts = {}
    for layout in TOKENS.values():
        if layout.dimension not in (dimension, None):
            continue
        if layout.kind in ("poses", "landmarks"):
            named = [[n] for n in place[layout.names[0]]]
        else:
            pairs = st.tuples(*(st.sampled_from(place[n] or [""]) for n in layout.names))
            named = draw(st.lists(pairs, max_size=4))
            named = [list(p) for p in named if "" not in p and len(set(p)) == len(p)]
        count = len(named)
        values = draw(numbers((count, len(layout.values))))
        if layout.kind == "ranges":
            values = np.abs(values)
        if len(layout.values) == 7:
            quaternion = np.random.default_rng(count).normal(size=(count, 4))
            quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
            values[:, 3:] = quaternion.round(draw(st.integers(4, 17)))
        rows = PoseRows if "pose" in layout.kind else PointRows
        parts[layout.kind] = (RangeRows if layout.kind == "ranges" else rows)(
            np.array(named, dtype=np.str_).reshape(count, len(layout.names)),
            values,
            draw(covariances(count, len(layout.noise))),
            draw(numbers((count,))) if layout.stamped else 0.0,
        )
    # "landmark_edges" and "landmark_priors" are points.
    for kind in ("landmark_edges", "landmark_priors"):
        assert isinstance(parts[kind], PointRows)
    return PyfgGraph(dimension=dimension, **parts)


@given(graph=graphs())
def test_written_and_read_back_unchanged_bit_by_bit(graph, tmp_path_factory):
    file = tmp_path_factory.mktemp("pyfg") / "graph.pyfg"
    write_pyfg(file, graph)
    again = read_pyfg(file)
    assert again == graph
    assert bits(again) == bits(graph)


def test_vertices_are_written_first(tmp_path, read):
    write_pyfg(tmp_path / "out.pyfg", read(PLANAR))
    tokens = [line.split()[0] for line in (tmp_path / "out.pyfg").read_text().splitlines()]
    assert tokens[:4] == ["VERTEX_SE2"] * 3 + ["VERTEX_XY"]
    assert tokens == [line.split()[0] for line in PLANAR.splitlines()]


def test_equal_graphs_differ_in_no_number(read):
    graph = read(PLANAR)
    assert graph != read(PLANAR.replace("19.5", "19.500000000000004"))
    assert graph != read(PLANAR.replace("A1 L0 19.5 0.25", "A0 L0 19.5 0.25"))
    assert graph != read(PLANAR.replace("VERTEX_SE2 0.5", "VERTEX_SE2 0.6"))
    assert graph != read(SPATIAL)
    assert (graph.ranges == 3) is False


@pytest.mark.parametrize("case", ["no folder", "a folder", "read only"])
def test_a_file_that_cannot_be_written_leaves_nothing_behind(case, tmp_path, read, monkeypatch):
    graph = read(PLANAR)
    (tmp_path / "graph.pyfg").unlink()
    file = {"no folder": tmp_path / "gone" / "out.pyfg"}.get(case, tmp_path / "out.pyfg")
    if case == "a folder":
        (file / "kept").mkdir(parents=True)
    if case == "read only":
        file.write_text("as it was")

        def refuse(*_):
            raise PermissionError(13, "Permission denied")

        monkeypatch.setattr(Path, "replace", refuse)
    with pytest.raises(DataError, match="cannot be written") as caught:
        write_pyfg(file, graph)
    assert Path(caught.value.file) == file and "\n" not in str(caught.value)
    left = {p.name for p in tmp_path.iterdir()}
    assert left == (set() if case == "no folder" else {"out.pyfg"})
    if case == "read only":
        assert file.read_text() == "as it was"


# What is refused

#: What a line is replaced by (counted from 1), the line that the error names, words of the error.
WRONG_PLANAR = {
    "unknown token": (9, "EDGE_RNAGE 1.5 A1 L0 19.5 0.25", "did you mean 'EDGE_RANGE'?"),
    "comment": (9, "# EDGE_RANGE 1.5 A1 L0 19.5 0.25", "unknown token '#'"),
    "g2o's token": (9, "FIX 0", "unknown token 'FIX'"),
    "cut short": (9, "EDGE_RANGE 1.5 A1 L0 19.5", "4 words after EDGE_RANGE, not 5"),
    "token alone": (9, "EDGE_RANGE", "0 words after EDGE_RANGE, not 5"),
    "too long": (9, "EDGE_RANGE 1.5 A1 L0 19.5 0.25 7", "6 words after EDGE_RANGE, not 5"),
    "no stamp": (1, "VERTEX_SE2 A0 1 2 0.1", "t, pose, x, y, theta"),
    "covariance short": (7, "EDGE_SE2 1.5 A0 A1 1 0 0.1 4 1 0.5 9 0.25", "6 of covariance"),
    "no number": (9, "EDGE_RANGE 1.5 A1 L0 19,5 0.25", "field 'range': '19,5' is not a number"),
    "underscore": (9, "EDGE_RANGE 1.5 A1 L0 1_9 0.25", "'1_9' is not a number"),
    "stamp": (9, "EDGE_RANGE now A1 L0 19.5 0.25", "field 't': 'now' is not a number"),
    "nan": (9, "EDGE_RANGE 1.5 A1 L0 nan 0.25", "field 'range': not a finite number"),
    "inf": (1, "VERTEX_SE2 0.5 A0 inf 2 0.1", "field 'x': not a finite number"),
    "too large": (1, "VERTEX_SE2 0.5 A0 1e999 2 0.1", "field 'x': not a finite number"),
    "stamp nan": (9, "EDGE_RANGE nan A1 L0 19.5 0.25", "the stamp is not a finite number"),
    "covariance nan": (6, "VERTEX_XY:PRIOR 0.0 L0 10 20 4 nan 9", "covariance is not a finite"),
    "variance 0": (9, "EDGE_RANGE 1.5 A1 L0 19.5 0", "variance of range': not more than zero"),
    "variance < 0": (9, "EDGE_RANGE 1.5 A1 L0 19.5 -1", "the file's numbers are variances"),
    "variance of theta": (7, f"EDGE_SE2 1.5 A0 A1 1 0 0.1 {EYE3[:-1]}-1", "variance of theta"),
    "indefinite": (7, "EDGE_SE2 1.5 A0 A1 1 0 0.1 4 9 0.5 9 0.25 1", "positive definite"),
    "singular": (6, "VERTEX_XY:PRIOR 0.0 L0 10 20 4 6 9", "positive definite"),
    "huge": (6, "VERTEX_XY:PRIOR 0.0 L0 10 20 1e-300 1e300 1e-300", "positive definite"),
    "range < 0": (9, "EDGE_RANGE 1.5 A1 L0 -19.5 0.25", "a negative range"),
    "unknown pose": (9, "EDGE_RANGE 1.5 A7 L0 19.5 0.25", "there is no vertex 'A7'"),
    "unknown landmark": (8, "EDGE_SE2_XY 1.5 A1 L9 8 18 1 0.5 2", "landmark vertices: L0"),
    "unknown in a prior": (5, f"VERTEX_SE2:PRIOR 0.5 A9 1 2 0.1 {EYE3}", "pose vertices: A0"),
    "landmark for a pose": (7, f"EDGE_SE2 1.5 A0 L0 1 0 0.1 {EYE3}", "'L0' is a landmark, not a"),
    "pose for a landmark": (6, "VERTEX_XY:PRIOR 0.0 A0 10 20 4 0 9", "'A0' is a pose, not a"),
    "to itself": (9, "EDGE_RANGE 1.5 A1 A1 19.5 0.25", "joins 'A1' to itself"),
    "pose twice": (2, "VERTEX_SE2 1.5 A0 2 2 0.2", "'A0' is there twice (before on line 1)"),
    "both kinds": (4, "VERTEX_XY A1 10 20", "'A1' is there twice (before on line 2)"),
    "number for a name": (1, "VERTEX_SE2 0.5 0 1 2 0.1", "'0' is no name of a pose"),
    "spatial vertex": (4, "VERTEX_XYZ L0 10 20 30", "VERTEX_XYZ after VERTEX_SE2 (line 1)"),
    "spatial edge": (7, f"EDGE_SE3:QUAT 1.5 A0 A1 1 0 0 {STILL} {EYE6}", "planar (SE2, XY) or"),
}
WRONG_SPATIAL = {
    "quaternion": (2, "VERTEX_SE3:QUAT 0 A1 1 2 3 0 0 0.7 0.9", "not of length 1"),
    "quaternion 0": (6, f"EDGE_SE3:QUAT 0 A0 A1 1 2 3 0 0 0 0 {EYE6}", "qx, qy, qz, qw"),
    "quaternion huge": (2, "VERTEX_SE3:QUAT 0 A1 1 2 3 0 0 0 1e300", "not of length 1"),
    "planar": (3, "VERTEX_XY L0 1 2", "VERTEX_XY after VERTEX_SE3:QUAT (line 1)"),
}
CASES = [(PLANAR, *case) for case in WRONG_PLANAR.values()]
CASES += [(SPATIAL, *case) for case in WRONG_SPATIAL.values()]


@pytest.mark.parametrize(
    ("text", "line", "wrong", "words"), CASES, ids=[*WRONG_PLANAR, *WRONG_SPATIAL]
)
def test_wrong_lines_are_refused_by_number(text, line, wrong, words, read, tmp_path):
    lines = text.splitlines()
    lines[line - 1] = wrong
    with pytest.raises(DataError) as caught:
        read("\n".join(lines) + "\n")
    message = str(caught.value)
    assert caught.value.line == line and words in message and "\n" not in message
    assert message.startswith(f"{tmp_path / 'graph.pyfg'}, line {line}")
    assert caught.value.remedy


def test_negative_variances_about_an_axis_are_named(read):
    bad = np.diag([1.0, 1.0, 1.0, 1.0, -1.0, 1.0])[np.triu_indices(6)]
    edge = f"EDGE_SE3:QUAT 0 A0 A1 1 2 3 {STILL} "
    with pytest.raises(DataError, match="field 'variance of about y': not more than zero"):
        read(SPATIAL.replace(edge + EYE6, edge + " ".join(map(str, bad))))


@pytest.mark.parametrize("text", ["", "\n", " \r\n\t\n", "\ufeff"])
def test_an_empty_file_is_refused(text, read):
    with pytest.raises(DataError, match="the file is empty; a PyFG file begins with VERTEX lines"):
        read(text)


def test_a_missing_file_is_named(tmp_path):
    (tmp_path / "goats.pyfg").write_text(PLANAR)
    with pytest.raises(DataError, match=r"there is no such file; did you mean 'goats\.pyfg'\?"):
        read_pyfg(tmp_path / "goast.pyfg")


@pytest.mark.parametrize("text", [PLANAR, SPATIAL])
def test_a_file_cut_anywhere_is_refused_or_lacks_its_last_lines(text, read):
    """Cut within a line's words it is refused there; a cut last number alone cannot be seen."""
    edges_last = "".join(sorted(text.splitlines(keepends=True), key=lambda s: s.startswith("E")))
    head = edges_last.index("EDGE")
    whole = read(edges_last)
    for end in range(head + 1, len(edges_last)):
        part = edges_last[:end]
        last = part.rsplit("\n", 1)[1]
        number = part.count("\n") + 1
        words = last.split()
        wanted = 1 + len(TOKENS[words[0]].columns) if words and words[0] in TOKENS else None
        if words and len(words) != wanted:
            with pytest.raises(DataError) as caught:
                read(part)
            assert caught.value.line == number
        elif not words:
            graph = read(part)
            assert len(graph.poses) == len(whole.poses)
            assert sum(len(getattr(graph, kind)) for kind in KINDS) == number - 1


@given(junk=st.binary(max_size=200))
def test_junk_is_refused(junk, tmp_path_factory):
    file = tmp_path_factory.mktemp("junk") / "junk.pyfg"
    file.write_bytes(junk)
    with pytest.raises(DataError) as caught:
        read_pyfg(file)
    assert "\n" not in str(caught.value) and str(file) in str(caught.value)


words = st.one_of(
    st.sampled_from([*TOKENS, "A0", "A1", "L0", "nan", "-1", "0", "1e400", "1e308", "\x00"]),
    st.floats().map(repr),
    st.text(string.printable, max_size=5),
)


@given(at=st.integers(0, 200), word=words, spatial=st.booleans())
def test_any_word_replaced_is_read_or_refused(at, word, spatial, tmp_path_factory):
    lines = [line.split() for line in (SPATIAL if spatial else PLANAR).splitlines()]
    places = [(i, j) for i, line in enumerate(lines) for j in range(len(line))]
    i, j = places[at % len(places)]
    lines[i][j] = word
    file = tmp_path_factory.mktemp("odd") / "odd.pyfg"
    file.write_text("\n".join(map(" ".join, lines)), encoding="utf-8", newline="")
    try:
        graph = read_pyfg(file)
    except DataError as error:
        assert "\n" not in str(error) and error.line is not None
    else:
        write_pyfg(file, graph)
        assert bits(read_pyfg(file)) == bits(graph)


# Graphs made in Python


def test_a_graph_made_in_python_is_checked_too():
    poses = PoseRows(["A0", "A1"], [[0, 0, 0], [1, 0, 0]])
    assert PyfgGraph(dimension=2, poses=poses).robots == ("A",)
    with pytest.raises(DataError, match=r"^ranges\[0\], field 'vertex': there is no vertex 'L0'"):
        PyfgGraph(dimension=2, poses=poses, ranges=RangeRows([["A0", "L0"]], [[5.0]], [[[1.0]]]))
    with pytest.raises(DataError, match=r"ranges, field 'covariance': shape \(1, 0, 0\), not"):
        PyfgGraph(dimension=2, poses=poses, ranges=RangeRows([["A0", "A1"]], [[5.0]]))
    with pytest.raises(DataError, match=r"poses, field 'values': shape \(2, 3\), not \(2, 7\)"):
        PyfgGraph(dimension=3, poses=poses)
    with pytest.raises(DataError, match="dimension 4 is neither 2 nor 3"):
        PyfgGraph(dimension=4)
    with pytest.raises(DataError, match=r"landmarks\[0\]: a landmark has no stamp"):
        PyfgGraph(dimension=2, landmarks=PointRows(["L0"], [[0, 0]], t=1.0))
    skew = [[[1.0, 0.5], [0.0, 1.0]]]
    with pytest.raises(DataError, match="not symmetric"):
        PyfgGraph(
            dimension=2,
            landmarks=PointRows(["L0"], [[0, 0]]),
            landmark_priors=PointRows(["L0"], [[0, 0]], skew),
        )


@pytest.mark.parametrize("name", ["L 0", "", "L0\n", "L\u00a00", "L\x07"])
def test_names_that_no_line_can_hold_are_refused(name):
    with pytest.raises(DataError, match="is no name"):
        PyfgGraph(dimension=2, landmarks=PointRows([name], [[0, 0]]))
