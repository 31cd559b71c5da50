"""The benchmark: what its script judges, and (with -m bench) ratios against the baseline.

pytest -m bench -n 0 tests/test_benchmarks.py
"""

from __future__ import annotations

import json
import os
import re
import sys
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))

import benchmark as script
import benchmark_online as online
import benchmark_problems as problems
import benchmark_rivals as rivals

ROOT = Path(__file__).resolve().parents[1]
BASELINE = json.loads(script.BASELINE.read_text())
#: How many times the baseline's ratio a marked test lets pass: it takes few rounds.
SLACK = 2.0
NODES = 5000
SMALL = 60
#: A window, and a contest in it.
WINDOW = 20
CONTEST = online.Contest(dict.fromkeys((*online.LISTED, online.ONE_UPDATE), 8), rest=4)
TINY = script.Plan(
    races={SMALL: 1},
    reported={},
    native={2 * SMALL: 1},
    plain={SMALL: 1},
    poses={SMALL: 1},
    full={SMALL: 1},
    marginals={SMALL: 1},
    scipy={SMALL: 1},
    kalman={SMALL: 1},
    scaling={SMALL: 1},
    online={WINDOW: CONTEST},
)
#: One pair of each kind that compares answers, and no process of its own.
PAIRS = replace(TINY, native={}, plain={}, poses={}, kalman={}, scaling={}, online={})


@pytest.fixture(autouse=True)
def _leave_malloc_alone(request, monkeypatch):
    """Only where it is timed does the process keep what it frees."""
    if "timer" not in request.fixturenames:
        monkeypatch.setattr(script, "keep_freed_memory", lambda: None)


def test_the_script_writes_what_it_promises(tmp_path, capsys):
    written, figure = tmp_path / "ratios.json", tmp_path / "scaling.png"
    arguments = ["--json", str(written), "--figure", str(figure)]
    assert script.main(arguments, TINY) == 0
    report = json.loads(written.read_text())
    for name in script.TITLES:
        size = WINDOW if name.startswith("online") else SMALL
        assert report[name][str(size)] > 0.0, name
    (row,) = report["scaling"]
    assert row["nodes"] == SMALL
    assert row["seconds"] == pytest.approx(row["solve_seconds"] + row["covariance_seconds"])
    assert 10.0 < row["peak_mb"] < 1000.0
    assert [r["nodes"] for r in report["native_scaling"]] == [SMALL, 2 * SMALL]
    assert figure.read_bytes().startswith(b"\x89PNG")
    table = capsys.readouterr().out
    assert all(title in table for title in script.TITLES.values())


def test_a_folder_that_is_not_there_is_said_at_once(tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        script.main(["--json", str(tmp_path / "none" / "ratios.json")], TINY)
    assert stop.value.code == 2
    assert "there is no such folder" in capsys.readouterr().err


def test_answers_that_differ_fail_the_run(monkeypatch, capsys):
    right = rivals.positions
    monkeypatch.setattr(rivals, "positions", lambda *a: right(*a) + np.array([0.0, 0.0, 2e-6]))
    assert script.main(["--no-figure"], PAIRS) == 1
    failed = [line for line in capsys.readouterr().out.splitlines() if line.startswith("FAILED")]
    assert [line.split()[1] for line in failed] == [
        "full_vs_wrapped_gtsam,",
        "banded_vs_wrapped_gtsam,",
    ]
    assert "60 nodes: the answers differ by 2e-06, tolerance 1e-06" in failed[0]


@pytest.mark.parametrize(
    ("function", "name"), [("marginals", "marginals_vs_gtsam"), ("by_scipy", "banded_vs_scipy")]
)
def test_so_do_covariances_and_minima_that_differ(function, name, monkeypatch, capsys):
    right = getattr(rivals, function)
    monkeypatch.setattr(rivals, function, lambda *a: right(*a) * (1.0 + 1e-5))
    assert script.main(["--no-figure"], PAIRS) == 1
    assert f"FAILED {name}, 60 nodes" in capsys.readouterr().out


def test_a_run_that_fails_leaves_the_baseline(monkeypatch, tmp_path):
    monkeypatch.setattr(script, "BASELINE", tmp_path / "baseline.json")
    assert script.main(["--no-figure", "--update-baseline"], PAIRS) == 0
    before = json.loads(script.BASELINE.read_text())
    assert before["banded_vs_scipy"].keys() == {"60"}
    assert before.keys() == {*script.TITLES, "online"}
    script.BASELINE.write_text("{}")
    monkeypatch.setattr(rivals, "by_scipy", lambda case: case.start)
    assert script.main(["--no-figure", "--update-baseline"], PAIRS) == 1
    assert script.BASELINE.read_text() == "{}"


def test_the_gate_fails_the_run(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(script, "BASELINE", tmp_path / "baseline.json")
    loose = {name: {"60": 1e3} for name in script.TITLES}
    script.BASELINE.write_text(json.dumps(loose))
    assert script.main(["--no-figure", "--gate"], PAIRS) == 0
    loose["marginals_vs_gtsam"]["60"] = 1e-6
    script.BASELINE.write_text(json.dumps(loose))
    capsys.readouterr()
    assert script.main(["--no-figure", "--gate"], PAIRS) == 1
    assert "FAILED marginals_vs_gtsam, 60 nodes: ratio" in capsys.readouterr().out


def test_what_is_not_a_number_does_not_agree():
    pair = rivals.Pair("banded_vs_scipy", 60, 1.0, 2.0, float("nan"))
    assert not pair.agrees
    assert pair.ratio == 0.5


def test_runs_that_took_other_steps_are_not_compared():
    case = problems.simple(SMALL)
    other = problems.banded(case)[0]
    other.damping *= 10.0
    with pytest.raises(RuntimeError, match="different steps"):
        rivals.check_steps(problems.banded(case)[0], other)


def test_the_full_problem_is_what_it_says():
    case = problems.full(200)
    assert problems.share_between_nodes(case.problem) > 0.6
    assert problems.share_between_nodes(problems.simple(SMALL).problem) == 0.0


def test_the_filter_finds_the_track():
    case = problems.simple(500)
    mean, covariance = rivals.filtered(case)
    assert case.rms(mean[:, :3]) < 0.3
    assert (np.linalg.eigvalsh(covariance) > 0.0).all()


def limit(name, nodes):
    """A ratio's limit, infinite where it has none."""
    found = script.limit_of(name, nodes)
    return np.inf if found is None else found


def report_of(**changes):
    """A report that passes any gate, with some of its ratios changed."""
    ratios = {
        name: {nodes: min(0.9 * r, limit(name, nodes)) for nodes, r in BASELINE[name].items()}
        for name in script.TITLES
    }
    for name, values in changes.items():
        ratios[name] = ratios[name] | values
    row = {"seconds": 0.05, "peak_mb": 200.0}
    leaves = {name: {str(n): {"updates": 3000} for n in script.WINDOWS} for name in online.LISTED}
    return ratios | {"online": leaves, "scaling": [row | {"nodes": 1000}, row | {"nodes": 5000}]}


def test_the_gate_lets_good_numbers_pass():
    assert script.excesses(report_of(), BASELINE) == []


def test_the_gate_compares_with_the_baseline():
    ratio = 1.6 * BASELINE["banded_vs_scipy"]["1000"]
    (line,) = script.excesses(report_of(banded_vs_scipy={"1000": ratio}), BASELINE)
    assert line.startswith("banded_vs_scipy, 1000 nodes: ratio")
    assert "1.5 times the baseline" in line


def test_the_gate_wants_a_baseline_for_every_ratio():
    (line,) = script.excesses(report_of(banded_vs_scipy={"77": 1e-9}), BASELINE)
    assert "banded_vs_scipy, 77 nodes" in line


@pytest.mark.parametrize("name", script.LIMITS)
def test_the_gate_has_limits_of_its_own(name):
    nodes, limit = next(iter(script.LIMITS[name].items()))
    lenient = {n: dict.fromkeys(BASELINE[n], 100.0) for n in script.TITLES}
    (line,) = script.excesses(report_of(**{name: {nodes: 1.01 * limit}}), lenient)
    assert line.endswith(f"limit {limit:.4g}")


def test_the_slowest_hundredth_of_few_updates_is_not_judged():
    report = report_of(online_vs_plain_custom={"60": 1.0}, online_median_vs_plain_custom={"60": 9})
    assert len(script.excesses(report, BASELINE)) == 3  # by limit and baseline, and the median
    report["online"]["isam2_plain_custom"]["60"]["updates"] = 300
    (line,) = script.excesses(report, BASELINE)
    assert line.startswith("online_median_vs_plain_custom, 60 nodes")


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ({"seconds": 4.1, "peak_mb": 900.0}, ["seconds 4.1, limit 4", "time per node"]),
        ({"seconds": 1.0, "peak_mb": 1001.0}, ["MB 1001, limit 1000"]),
        ({"seconds": 1.31, "peak_mb": 900.0}, ["time per node 1.31, limit 1.3"]),
        ({"seconds": 0.76, "peak_mb": 900.0}, ["time per node 1.316, limit 1.3"]),
        ({"seconds": 0.8, "peak_mb": None}, []),
    ],
)
def test_the_gate_looks_at_the_scaling(row, says):
    report = report_of()
    report["scaling"].append(row | {"nodes": 100_000})
    lines = script.excesses(report, BASELINE)
    assert len(lines) == len(says)
    assert all(part in line for part, line in zip(says, lines, strict=True))


@pytest.mark.parametrize("plan", [script.FULL, script.QUICK])
def test_both_plans_measure_what_the_gate_judges(plan):
    assert plan.reported["banded_vs_native"] == (5000, 20_000)
    measured = {name: {str(n) for n in sizes} for name, sizes in plan.reported.items()}
    measured |= {
        "full_vs_wrapped_gtsam": {str(n) for n in plan.full},
        "marginals_vs_gtsam": {str(n) for n in plan.marginals},
        "gtsam_vs_plain_custom": {str(n) for n in plan.plain},
        "poses_with_vs_without_pings": {str(n) for n in plan.poses},
        "banded_vs_scipy": {str(n) for n in plan.scipy},
        "banded_vs_kalman": {str(n) for n in plan.kalman},
    }
    measured |= {n: {str(k) for k in plan.online} for n in script.TITLES if n.startswith("online")}
    assert {name: set(BASELINE[name]) for name in script.TITLES} == measured
    assert {name: set(sizes) for name, sizes in BASELINE["online"].items()} == {
        name: {str(k) for k in plan.online} for name in online.LISTED
    }
    assert all(set(sizes) <= measured[name] for name, sizes in script.LIMITS.items())
    assert all(n in plan.races for sizes in plan.reported.values() for n in sizes)
    assert {script.FLAT_FROM, script.LARGEST} <= plan.scaling.keys()


def test_the_baseline_is_within_the_limits():
    for name, sizes in script.LIMITS.items():
        for nodes, limit in sizes.items():
            assert BASELINE[name][nodes] <= limit


def test_the_docs_show_the_baseline():
    page = (ROOT / "docs" / "performance.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \|.*\| ([\d ]+) \| ([\d.]+) \| ([\d.]*) *\|$", page, re.M)
    shown = {(name, nodes.replace(" ", "")): float(ratio) for name, nodes, ratio, _ in rows}
    limits = {(name, nodes.replace(" ", "")): float(x) for name, nodes, _, x in rows if x}
    flat = {(n, nodes): x for n in script.TITLES for nodes, x in BASELINE[n].items()}
    assert shown == flat
    assert limits == {(n, k): x for n, sizes in script.LIMITS.items() for k, x in sizes.items()}


def test_the_docs_show_the_latencies():
    page = (ROOT / "docs" / "performance.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \| (.+ / .+) \| (.+ / .+) \| (.+ / .+) \|$", page, re.M)
    assert [nodes for nodes, *_ in rows] == [str(n) for n in script.WINDOWS]
    for nodes, *cells in rows:
        for name, cell in zip(online.LISTED, cells, strict=True):
            leaf = BASELINE["online"][name][nodes]
            shown = [float(x) for x in cell.split(" / ")]
            assert shown == [leaf["p50_ms"], leaf["p99_ms"], leaf["max_ms"]], (name, nodes)


def test_the_baseline_is_written_into_the_docs(monkeypatch, tmp_path):
    page, copy, other = (
        script.PAGE.read_text("utf-8"),
        tmp_path / "page.md",
        tmp_path / "other.json",
    )
    copy.write_text(page, "utf-8")
    other.write_text(re.sub(r"(?<=: )[\d.]+", "7.5", script.BASELINE.read_text()))
    with monkeypatch.context() as patched:
        patched.setattr(script, "PAGE", copy)
        patched.setattr(script, "BASELINE", other)
        assert script.main(["--write-docs"]) == 0
    sevens = copy.read_text("utf-8")
    assert sevens.count(" 7.5 ") == 9 * len(script.WINDOWS) + sum(
        len(BASELINE[name]) for name in script.TITLES
    )
    assert script.with_numbers(sevens, BASELINE) == page


def test_only_the_online_estimator(monkeypatch, tmp_path, capsys):
    baseline, written = tmp_path / "baseline.json", tmp_path / "online.json"
    monkeypatch.setattr(script, "BASELINE", baseline)
    old = {name: {"60": 7.0} for name in script.TITLES}
    baseline.write_text(json.dumps(old))
    arguments = ["--only", "online", "--json", str(written), "--update-baseline"]
    assert script.main(arguments, TINY) == 0
    report = json.loads(written.read_text())
    assert report["online"].keys() == {"lm", "isam2", "isam2_plain_custom"}
    for sizes in report["online"].values():
        (leaf,) = sizes.values()
        assert sizes.keys() == {str(WINDOW)}
        assert leaf.keys() == {"p50_ms", "p99_ms", "max_ms", "updates"}
        assert 0.0 < leaf["p50_ms"] <= leaf["p99_ms"] <= leaf["max_ms"]
        assert leaf["updates"] == 8
    ours, theirs = (report["online"][name][str(WINDOW)] for name in ("lm", "isam2_plain_custom"))
    ratio = report["online_vs_plain_custom"][str(WINDOW)]
    assert ratio == pytest.approx(ours["p99_ms"] / theirs["p99_ms"])
    assert not report["banded_vs_native"]
    assert "isam2_plain_custom       20" in capsys.readouterr().out
    fresh = json.loads(baseline.read_text())
    assert fresh["banded_vs_native"] == {"60": 7.0}
    assert fresh["online_vs_plain_custom"].keys() == {str(WINDOW)}
    assert fresh["online"]["lm"][str(WINDOW)]["updates"] == 8


@pytest.fixture(scope="module")
def contest():
    """All contestants in a small window."""
    return online.compete(WINDOW, CONTEST)


def test_the_contestants_agree(contest):
    timed, pairs = contest
    assert all(pair.agrees for pair in pairs)
    apart = {pair.name: pair.difference for pair in pairs}
    assert apart["online_lm_vs_isam2"] < 1e-3
    assert apart["online_vs_plain_custom"] < 5e-3
    end = online.circle(np.array([WINDOW + CONTEST.rest + 8.0]))[0]
    for name, one in timed.items():
        assert one.positions.shape == (8, 3)
        assert rivals.farthest(one.positions[-1:], end) < 2.0, name


def test_contestants_that_differ_fail_the_run(monkeypatch, capsys):
    right = online.Ours.newest
    monkeypatch.setattr(online.Ours, "newest", lambda self: right(self) + 0.1)
    assert script.main(["--only", "online"], TINY) == 1
    failed = [line for line in capsys.readouterr().out.splitlines() if line.startswith("FAILED")]
    assert [line.split()[1] for line in failed] == [
        "online_vs_plain_custom,",
        "online_vs_plain_one_update,",
    ]


def test_a_ping_a_node():
    pings = online.pings(600)
    assert (pings.t_transmit == np.arange(600)).all()
    assert (pings.t_receive < pings.t_transmit + 1.0).all()
    sites = np.array([b.position for b in online.BEACONS])[np.arange(600) % 4]
    ends = (online.circle(t)[0] for t in (pings.t_transmit, pings.t_receive))
    ways = sum(np.linalg.norm(place - sites, axis=1) for place in ends)
    noise = (pings.travel_time - ways / online.SPEED) / online.SIGMA
    assert np.abs(noise).max() < 5.0
    assert noise.std() == pytest.approx(1.0, abs=0.1)


def test_the_rival_is_bare_and_has_the_window_that_was_asked_for():
    stream = online.pings(WINDOW + 10)
    plain = online.Plain(WINDOW, online.DEFAULT_THRESHOLD, settles=False)
    assert isinstance(plain.prepare(0, stream[0]), gtsam.CustomFactor)
    runner = online.Runner(plain, stream)
    with pytest.raises(RuntimeError, match="the window has 5 nodes, not 20"):
        runner.warm_up(4)
    runner.warm_up(WINDOW)
    assert len(runner.timed.seconds) == 0
    runner.run(2)
    assert runner.timed.leaf["updates"] == 2


@pytest.fixture(scope="module")
def case():
    """The simple problem that is timed."""
    return problems.simple(NODES)


@pytest.fixture
def timer(request):
    """The fixture of pytest-benchmark, where that is installed and does time."""
    pytest.importorskip("pytest_benchmark")
    if "PYTEST_XDIST_WORKER" in os.environ or request.config.getoption("benchmark_disable"):
        pytest.skip("nothing is timed beside others; run with -n 0")
    script.keep_freed_memory()
    return request.getfixturevalue("benchmark")


@pytest.mark.bench
def test_banded_against_native(timer, case):
    native = rivals.native(NODES)
    timer.pedantic(problems.banded, args=(case,), rounds=7, warmup_rounds=1)
    theirs, _ = rivals.race(3, native=native.iterate)
    ratio = timer.stats.stats.median / theirs["native"]
    assert ratio <= SLACK * BASELINE["banded_vs_native"][str(NODES)]


@pytest.mark.bench
def test_marginals_against_gtsam(timer, case):
    solution = problems.banded_solution(case)
    graph = rivals.wrapped(case, solution.x, solution.frozen)
    timer.pedantic(problems.covariances, args=(case, solution), rounds=7, warmup_rounds=1)
    theirs, _ = rivals.race(3, gtsam=lambda: rivals.marginals(graph.graph, graph.values, NODES))
    ratio = timer.stats.stats.median / theirs["gtsam"]
    assert ratio <= SLACK * BASELINE["marginals_vs_gtsam"][str(NODES)]


@pytest.mark.bench
def test_poses_with_pings_against_without():
    limit = script.LIMITS["poses_with_vs_without_pings"][str(NODES)]
    assert rivals.compare_poses(NODES, 3).ratio <= limit


@pytest.mark.bench
def test_residuals(timer, case):
    """What one evaluation of all residuals and Jacobians takes; an iteration takes it once."""
    frozen = case.problem.frozen(case.start)
    timer.pedantic(case.problem.linearize, args=(case.start, frozen), rounds=10, warmup_rounds=1)
    iteration, _ = rivals.race(3, banded=lambda: problems.banded(case))
    assert timer.stats.stats.median <= iteration["banded"]
