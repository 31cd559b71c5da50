"""The Cao 2017 script: what its rows hold, what it writes, and how it refuses."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))

import cao2017 as script
import cao2017_plan as plans
from cao2017_cases import GraphPasses, Trial, WindowPasses, run
from paper_rows import behind

from ubl_graph.errors import SolverError
from ubl_graph.study import SerialExecutor

#: As little as gives every row a number.
TINY = plans.Plan(
    map_north=(0.0, 100.0, 3000.0),
    map_east=(-3000.0, 1000.0, 3000.0),
    draw_north=(0.0, 1000.0),
    draw_east=(-1000.0, -500.0),
    draws=2,
    runs=1,
    pings=30,
    stride=4,
    passes=(1000.0,),
)
ROW = ["table", "case", "quantity", "unit", "paper", "baseline", "graph"]


#: Of each kind of setting some: all of them are run by the slow test.
SOME = {
    "QUICK": TINY,
    "SETTINGS": (plans.SETTINGS[0], plans.SETTINGS[4]),
    "TRIALS": plans.TRIALS[:2],
    "DEPENDENCE": (*plans.DEPENDENCE[:4:2], plans.DEPENDENCE[9]),
}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder of one run of the tiny plan in this process."""
    folder = tmp_path_factory.mktemp("cao") / "out"
    with pytest.MonkeyPatch.context() as patch:
        for name, value in SOME.items():
            patch.setattr(plans, name, value)
        patch.setattr(script, "ProcessPool", SerialExecutor)
        assert script.main(["-o", str(folder), "--quick"]) == 0
    return folder


@pytest.fixture(scope="module")
def numbers(made):
    return json.loads((made / "cao2017.json").read_text())


def one(numbers, table, case, quantity):
    (row,) = [
        r
        for r in numbers["rows"]
        if r["table"] == table and r["case"].startswith(case) and r["quantity"].startswith(quantity)
    ]
    return row


def whole(numbers, settings, trials, dependence):
    """Check that every row is there and has its numbers."""
    rows = numbers["rows"]
    assert all(list(row) == ROW for row in rows)
    assert all(row["unit"] in ("m", None) for row in rows)
    names = [(r["table"], r["case"], r["quantity"]) for r in rows]
    assert len(set(names)) == len(names)
    # By three errors of the velocity; by two errors; by trial.
    assert Counter(r["table"] for r in rows) == {
        "A1": 3 * 2,
        "A2": 3 * (8 + 3),
        "A2 dependence": 3 * dependence + 2 * 3,
        "A2 mirror": 7,
        "A3": settings * 2 * 9,
        "A4": trials * (13 + 1),
    }
    for row in rows:
        values = [v for v in (row["paper"], row["baseline"], row["graph"]) if v is not None]
        assert values
        assert np.isfinite(values).all()
        if row["table"] in ("A2", "A3", "A4") and row["unit"] == "m":
            assert None not in (row["baseline"], row["graph"])
    assert numbers["compared"] == 3 * 8 + settings * 2 * 9 + trials * 13
    lost, compared = behind(rows)
    assert numbers["ahead"] == compared - len(lost)


def reproduced(numbers):
    """Check the numbers that do not depend on the plan."""
    ends = "axis ends, largest"
    newton = one(numbers, "A2", "forward", f"Gauss-Newton, {ends}")
    assert newton["paper"] == 200.0
    assert newton["baseline"] == pytest.approx(220.0, rel=0.01)
    for error, paper in (("forward", 30.0), ("right", 4.0), ("up", 3.0)):
        row = one(numbers, "A2", error, f"LM, {ends}")
        assert row["paper"] == paper
        assert row["baseline"] < paper
    axis = one(numbers, "A2", "forward", "Gauss-Newton, share of axis nodes")
    assert (axis["paper"], axis["baseline"], axis["graph"]) == (1.0, 1.0, 0.0)
    for trials, number in ((2, 22.4), (4, 36.4)):
        row = one(numbers, "A2 dependence", "forward", f"LM, {trials} trials")
        assert row["baseline"] == pytest.approx(number, rel=0.01)
    for step, number in ((50, 258.0), (100, 220.0), (200, 164.0)):
        row = one(numbers, "A2 dependence", "forward", f"Gauss-Newton, a grid of {step} m")
        assert row["baseline"] == pytest.approx(number, rel=0.01)
    assert all(r["baseline"] < 0.05 for r in numbers["rows"] if r["table"] == "A1")
    counts = [r["baseline"] for r in numbers["rows"] if r["table"] == "A2 mirror"]
    assert counts[:6] == [288.0, 0.0, 600.0, 0.0, 600.0, 0.0]


def test_every_table_is_there_and_every_row_is_whole(numbers):
    assert numbers["quick"] is True
    whole(numbers, len(SOME["SETTINGS"]), len(SOME["TRIALS"]), len(SOME["DEPENDENCE"]))


def test_the_papers_numbers_come_out(numbers):
    reproduced(numbers)
    assert one(numbers, "A2 mirror", "no error", "one beacon")["graph"] == 1.0


@pytest.mark.slow
def test_the_quick_plan_shows_what_the_study_is_for(tmp_path):
    """On worker processes, all of it: the graph where the windows fail, from a start 1 m off."""
    done = subprocess.run(
        [sys.executable, script.__file__, "-o", str(tmp_path), "--quick"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    numbers = json.loads((tmp_path / "cao2017.json").read_text())
    whole(numbers, len(plans.SETTINGS), len(plans.TRIALS), len(plans.DEPENDENCE))
    reproduced(numbers)
    for error, number in (("forward", 22.4), ("right", 3.7), ("up", 1.6)):
        row = one(numbers, "A2", error, "LM, axis ends, largest")
        assert row["baseline"] == pytest.approx(number, rel=0.1)
    for error, mean, largest in (("forward", 0.6, 2.5), ("right", 0.7, 5.0)):
        case = f"start 1 m, range 0.1 m, {error}"
        assert one(numbers, "A3", case, "LM, map, mean")["graph"] <= mean
        assert one(numbers, "A3", case, "LM, map, largest")["graph"] <= largest
    assert numbers["ahead"] >= 0.85 * numbers["compared"]
    assert f"ahead in {numbers['ahead']} of {numbers['compared']} errors" in done.stdout


def test_figures_are_drawn_and_nothing_else_is_left(made):
    names = {"figure3.png", "figure4.png", "figure5.png", "figure8.png", "figure9.png"}
    assert {p.name for p in made.iterdir()} == names | {"cao2017.json"}
    for name in names:
        assert (made / name).read_bytes().startswith(b"\x89PNG")


def test_quick_and_full_make_the_same_rows():
    """The plans differ in numbers alone: the same cases are there, on more nodes."""

    def kinds(plan):
        return {
            (type(c).__name__, *(getattr(c, n, None) for n in ("error", "settings", "calibration")))
            for c in plans.cases(plan)
        }

    assert kinds(plans.QUICK) == kinds(plans.FULL) == kinds(TINY)
    assert set(plans.QUICK.map_north) <= set(plans.FULL.map_north)
    assert set(plans.QUICK.map_east) <= set(plans.FULL.map_east)


def test_windows_and_graph_see_the_same_data():
    every = plans.cases(TINY)
    windows = [c for c in every if isinstance(c, WindowPasses)]
    seen = [(part.error, track) for case in windows for part in case.parts for track in part.tracks]
    graph = [(c.error, track) for c in every if isinstance(c, GraphPasses) for track in c.tracks]
    assert sorted(seen) == sorted(graph)
    (first, *_) = [c for c in every if isinstance(c, GraphPasses) and c.noise]
    parts = [part for case in windows for part in case.parts if part.error == first.error]
    (part,) = [p for p in parts if (p.start_sigma, p.noise) == (first.start_sigma, first.noise)]
    for a, b in zip(part.missions(), first.missions(), strict=False):
        assert a.segments[0].start == b.segments[0].start
        heard = (m.segments[0].one_way_range.t_receive for m in (a, b))
        assert np.array_equal(*heard)


def test_the_graph_sees_nothing_later_than_now():
    """Its position at a ping stays the same whatever comes after."""
    from cao2017_cases import newest

    (mission, *_) = GraphPasses("forward", 5.0, 0.1, 1.0, ((300.0, 5),), (3000.0,)).missions()
    (segment,) = mission.segments
    later = segment.one_way_range.t_receive > segment.one_way_range.t_receive[200]
    pings = segment.one_way_range
    moved = replace(pings, t_transmit=pings.t_transmit - 0.1 * later)
    changed = replace(mission, segments=(replace(segment, one_way_range=moved),))
    assert np.array_equal(newest(mission, 200), newest(changed, 200))
    assert not np.array_equal(newest(mission, 201), newest(changed, 201))


def test_a_case_is_its_seed():
    trial = Trial(800.0, 3.0, 12)
    first, again, other = run(trial, 3), run(trial, 3), run(trial, 4)
    for name, values in first.items():
        assert np.array_equal(values, again[name], equal_nan=True)
    assert not np.array_equal(first["lm"], other["lm"])


# -- what goes wrong --


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["-o", "nowhere/deep"], "there is no such folder"),
        (["-o", "file"], "the output is a file"),
        ([], "the following arguments are required: -o"),
        (["-o", "out", "--fast"], "unrecognized arguments: --fast"),
    ],
)
def test_bad_input_is_one_line(tmp_path, monkeypatch, capsys, arguments, text):
    (tmp_path / "file").write_text("")
    monkeypatch.chdir(tmp_path)
    try:
        code = script.main(arguments)
    except SystemExit as end:
        code = end.code
    told = capsys.readouterr()
    assert code == 2
    assert told.err.count("\n") == 1
    assert text in told.err
    assert told.out == ""
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def failing(case, _seed):
    if isinstance(case, Trial):
        raise SolverError("no good")
    return {}


def test_a_case_that_fails_is_told_and_nothing_is_written(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(plans, "QUICK", replace(TINY, passes=()))
    monkeypatch.setattr(script, "ProcessPool", SerialExecutor)
    monkeypatch.setattr(script, "run", failing)
    assert script.main(["-o", str(tmp_path / "out"), "--quick"]) == 1
    told = capsys.readouterr()
    assert told.err.count("SolverError: no good") == len(plans.TRIALS)
    assert told.out == ""
    assert list(tmp_path.iterdir()) == []


def test_a_figure_that_cannot_be_written_leaves_nothing(tmp_path):
    def broken(path):
        path.write_text("half")
        raise OSError(28, "No space left on device")

    with pytest.raises(Exception, match="cannot be written"):
        script.write(tmp_path / "out", "cao2017.json", {"rows": []}, {"figure3": broken})
    assert list(tmp_path.iterdir()) == []
