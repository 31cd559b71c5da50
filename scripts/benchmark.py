"""Measure solvers and online estimator against GTSAM, scipy and a Kalman filter, in turns.

A ratio is our time over theirs; seconds depend on the machine, ratios hardly do. Every timed pair
that solves the same problem must give the same positions, or the run fails. What is timed on
either side stands in docs/performance.md.

    python scripts/benchmark.py                     # table, and the figure of the docs
    python scripts/benchmark.py --quick --gate      # exit status 1 where a limit is exceeded
    python scripts/benchmark.py --update-baseline   # measure anew what --gate compares with
    python scripts/benchmark.py --write-docs        # put that into the page's tables
    python scripts/benchmark.py --only online       # one part, with any of the first three
"""

from __future__ import annotations

import os

if __name__ == "__main__":
    # One thread on each side, as GTSAM's wheel has it, and no times that depend on whether
    # another process holds the next core. It must be said before numpy is loaded.
    for _name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
        os.environ.setdefault(_name, "1")

import argparse
import ctypes
import json
import platform
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import benchmark_online as online
import benchmark_problems as problems
import benchmark_rivals as rivals
import numpy as np

HERE = Path(__file__).resolve().parent
BASELINE = HERE / "benchmark_baseline.json"
FIGURE = HERE.parent / "docs" / "scaling.png"
PAGE = HERE.parent / "docs" / "performance.md"
#: A ratio fails where it is so many times the baseline's,
SLACK = 1.5
#: or above these, by name and number of nodes.
LIMITS: dict[str, dict[str, float]] = {
    "banded_vs_native": {"5000": 0.08, "20000": 0.06},
    "full_vs_wrapped_gtsam": {"4000": 0.06},
    "marginals_vs_gtsam": {"5000": 0.1},
    "gtsam_vs_plain_custom": {"4000": 0.05},
    "poses_with_vs_without_pings": {"5000": 3.0},
    "online_vs_plain_custom": {"60": 0.6, "200": 0.6, "500": 0.6},
}
#: Ratios of 99th percentiles. A few hundred updates have three slower ones, and which updates of
#: GTSAM's linearise much anew is chance: they are judged from so many updates of either side on,
#: fewer by the medians.
PERCENTILES = {
    "online_vs_plain_custom": "isam2_plain_custom",
    "online_lm_vs_isam2": "isam2",
    "online_vs_plain_one_update": "isam2_plain_custom",
}
ENOUGH_UPDATES = 3000
#: At the largest size of the scaling, time and memory are less than this, s and MB;
LARGEST, MOST_SECONDS, MOST_MB = 100_000, 4.0, 1000.0
#: and from this size on the longest time per node is at most so many times the shortest.
FLAT_FROM, FLATNESS = 5000, 1.3
#: Passes over all sizes of the scaling, at most.
MOST_PASSES = 5
#: Numbers of two of mallopt's parameters in glibc's malloc.h.
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3
#: What the ratios are of, as the table says it.
TITLES = {
    "banded_vs_native": "banded / GTSAM, C++ factors",
    "banded_vs_wrapped_gtsam": "banded / GTSAM, our factors",
    "full_vs_wrapped_gtsam": "banded / GTSAM, full mission",
    "marginals_vs_gtsam": "covariances / gtsam.Marginals",
    "gtsam_vs_native": "GTSAM, our factors / C++ factors",
    "gtsam_vs_plain_custom": "GTSAM, our factors / plain custom",
    "poses_with_vs_without_pings": "GTSAM, poses with / without pings",
    "banded_vs_scipy": "banded / scipy least_squares",
    "banded_vs_kalman": "banded / Kalman filter + RTS",
    "online_vs_plain_custom": "online p99, lm / GTSAM, plain",
    "online_median_vs_plain_custom": "online median, lm / GTSAM, plain",
    "online_vs_plain_one_update": "online p99, lm / plain, one update",
    "online_lm_vs_isam2": "online p99, lm / isam2",
}


@dataclass(frozen=True)
class Plan:
    """What is run: numbers of nodes, and how often.

    Attributes
    ----------
    races : dict of int to int
        Nodes and repeats of banded, wrapped and native GTSAM on the simple problem.
    reported : dict of str to tuple of int
        Of these, the sizes at which a ratio is reported; the others only check the answers and
        draw the figure.
    native : dict of int to int
        Further sizes and repeats of native GTSAM alone, for the figure.
    plain, poses, full, marginals, scipy, kalman : dict of int to int
        Nodes and repeats of the other comparisons.
    scaling : dict of int to int
        Nodes and repeats of what runs in a process of its own.
    online : dict of int to online.Contest
        Nodes in the window, and the updates of the online estimator and its rivals.
    """

    races: Mapping[int, int]
    reported: Mapping[str, tuple[int, ...]]
    native: Mapping[int, int]
    plain: Mapping[int, int]
    poses: Mapping[int, int]
    full: Mapping[int, int]
    marginals: Mapping[int, int]
    scipy: Mapping[int, int]
    kalman: Mapping[int, int]
    scaling: Mapping[int, int]
    online: Mapping[int, online.Contest]

    def only_online(self) -> Plan:
        """The same with nothing but the online estimator."""
        others = ("races", "native", "plain", "poses", "full", "marginals", "scipy", "kalman")
        return replace(self, **{name: {} for name in (*others, "scaling")})


SIZES = (1000, 2000, 5000, 10_000, 20_000, 50_000, LARGEST)
#: Nodes in the online estimator's window.
WINDOWS = (60, 200, 500)
FULL = Plan(
    races={1000: 9, 2000: 9, 4000: 5, 5000: 7, 10_000: 5, 20_000: 5},
    reported={
        "banded_vs_native": (5000, 20_000),
        "banded_vs_wrapped_gtsam": (5000, 20_000),
        "gtsam_vs_native": (4000,),
    },
    native={50_000: 3},
    plain={4000: 1},
    poses={5000: 7},
    full={4000: 5},
    marginals={5000: 7},
    scipy={1000: 5},
    kalman={5000: 5},
    scaling=dict.fromkeys(SIZES, 5),
    online={
        nodes: online.Contest(
            {"lm": 10_000, "isam2": 3000, "isam2_plain_custom": 3000, online.ONE_UPDATE: 10_000},
            rest=nodes,
        )
        for nodes in WINDOWS
    },
)
QUICK = Plan(
    races={1000: 9, 2000: 7, 4000: 3, 5000: 5, 10_000: 3, 20_000: 3},
    reported=FULL.reported,
    native={},
    plain=FULL.plain,
    poses={5000: 5},
    full={4000: 5},
    marginals={5000: 5},
    scipy={1000: 5},
    kalman={5000: 3},
    scaling=dict.fromkeys(SIZES, 3),
    online={
        nodes: online.Contest(
            {"lm": 1000, "isam2": 300, "isam2_plain_custom": 300, online.ONE_UPDATE: 1000}, rest=60
        )
        for nodes in WINDOWS
    },
)


def keep_freed_memory() -> None:
    """Have glibc keep what is freed instead of giving it back to the kernel.

    Else each run begins by faulting its pages in again, which may take as long as a small run
    itself. It counts for both sides alike. Other C libraries are left as they are.
    """
    if sys.platform == "linux":
        library = ctypes.CDLL(None)
        if hasattr(library, "mallopt"):
            library.mallopt(TRIM_THRESHOLD, 2**31 - 1)
            library.mallopt(MMAP_THRESHOLD, 2**25)


def scale(sizes: Mapping[int, int]) -> list[dict[str, Any]]:
    """`benchmark_problems.scaling_row` of some sizes, each in a process of its own.

    The sizes cannot run in turns, and what else a machine does comes in spells and only ever adds
    to a time. So all are run twice, one pass after the other, and a few times more where the time
    per node is not flat; of each size the quickest row counts.
    """
    best: dict[int, dict[str, Any]] = {}
    for number in range(MOST_PASSES):
        if number > 1 and (flatness(list(best.values())) or 0.0) <= FLATNESS:
            break
        for nodes, repeats in sizes.items():
            say(f"scaling, {nodes} nodes")
            command = [sys.executable, str(HERE / "benchmark.py"), "--scaling-row"]
            command += [str(nodes), str(repeats)]
            row = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
            if nodes not in best or row["seconds"] < best[nodes]["seconds"]:
                best[nodes] = row
    return list(best.values())


def measure(plan: Plan) -> tuple[dict[str, Any], list[rivals.Pair]]:
    """Run everything: what --json writes, and the pairs."""
    # First of all: a child's peak memory starts from what its parent holds when it is born.
    scaling = scale(plan.scaling)
    keep_freed_memory()
    # The largest graphs come last: the holes that they leave in the heap slow down what follows.
    pairs: list[rivals.Pair] = []
    latency: dict[str, dict[str, Any]] = {name: {} for name in online.LISTED}
    for nodes, contest in plan.online.items():
        say(f"online, {nodes} nodes")
        timed, found = online.compete(nodes, contest)
        pairs += found
        for name, leaves in latency.items():
            leaves[str(nodes)] = timed[name].leaf
    others = {
        rivals.compare_scipy: plan.scipy,
        rivals.compare_kalman: plan.kalman,
        rivals.compare_marginals: plan.marginals,
        rivals.compare_full: plan.full,
        rivals.compare_plain: plan.plain,
        rivals.compare_poses: plan.poses,
    }
    for compare, sizes in others.items():
        for nodes, repeats in sizes.items():
            say(f"{compare.__name__.removeprefix('compare_')}, {nodes} nodes")
            pairs.append(compare(nodes, repeats))
    for nodes, repeats in plan.races.items():
        say(f"banded and GTSAM, {nodes} nodes")
        pairs += rivals.compare_simple(nodes, repeats)
    native, wrapped = (
        [{"nodes": p.nodes, "seconds": p.theirs_s} for p in pairs if p.name == name]
        for name in ("banded_vs_native", "banded_vs_wrapped_gtsam")
    )
    for nodes, repeats in plan.native.items():
        say(f"GTSAM's own factors, {nodes} nodes")
        seconds, _ = rivals.race(repeats, native=rivals.native(nodes).iterate)
        native.append({"nodes": nodes, "seconds": seconds["native"]})
    report: dict[str, Any] = {name: {} for name in TITLES}
    for pair in pairs:
        if pair.nodes in plan.reported.get(pair.name, (pair.nodes,)):
            report[pair.name][str(pair.nodes)] = pair.ratio
    report |= {"scaling": scaling, "native_scaling": native, "wrapped_scaling": wrapped}
    report["online"] = latency
    report["pairs"] = [asdict(pair) | {"ratio": pair.ratio} for pair in pairs]
    report["versions"] = {"python": platform.python_version()} | {
        name: version(name) for name in ("gtsam", "numpy", "scipy")
    }
    return report, pairs


def say(text: str) -> None:
    """Tell who waits what is being run."""
    print(f"... {text}", file=sys.stderr, flush=True)


def disagreements(pairs: Sequence[rivals.Pair]) -> list[str]:
    """One line for each pair whose answers differ."""
    return [
        f"{p.name}, {p.nodes} nodes: the answers differ by {p.difference:.2g}, "
        f"tolerance {p.tolerance:g}"
        for p in pairs
        if not p.agrees
    ]


def excesses(report: Mapping[str, Any], baseline: Mapping[str, Any]) -> list[str]:
    """One line for each number of a report that is above its limit."""
    found = [
        (f"{name}, {nodes} nodes: ratio", ratio, limit, kind)
        for name in TITLES
        for nodes, ratio in report[name].items()
        if enough(report, name, nodes)
        for limit, kind in (
            (limit_of(name, nodes), "limit"),
            (SLACK * baseline.get(name, {}).get(nodes, 0.0), f"{SLACK:g} times the baseline"),
        )
        if limit is not None
    ]
    for row in report["scaling"]:
        if row["nodes"] >= LARGEST:
            at = f"scaling, {row['nodes']} nodes: "
            found.append((at + "seconds", row["seconds"], MOST_SECONDS, "limit"))
            if row["peak_mb"] is not None:
                found.append((at + "MB", row["peak_mb"], MOST_MB, "limit"))
    steady = flatness(report["scaling"])
    if steady is not None:
        found.append(("scaling: largest over smallest time per node", steady, FLATNESS, "limit"))
    return [
        f"{what} {measured:.4g}, {kind} {limit:.4g}"
        for what, measured, limit, kind in found
        if not measured <= limit
    ]


def enough(report: Mapping[str, Any], name: str, nodes: str) -> bool:
    """Whether a ratio was measured often enough to be judged."""
    other = PERCENTILES.get(name)
    return other is None or report["online"][other][nodes]["updates"] >= ENOUGH_UPDATES


def limit_of(name: str, nodes: str | int) -> float | None:
    """Largest ratio that is allowed whatever the baseline says, or None."""
    return LIMITS.get(name, {}).get(str(nodes))


def flatness(rows: Sequence[Mapping[str, Any]]) -> float | None:
    """Longest over shortest time per node among the sizes from `FLAT_FROM` on."""
    per_node = [row["seconds"] / row["nodes"] for row in rows if row["nodes"] >= FLAT_FROM]
    return max(per_node) / min(per_node) if per_node else None


def show(report: Mapping[str, Any], pairs: Sequence[rivals.Pair]) -> None:
    """Print the tables."""
    print(
        f"{'ours / theirs':<34} {'nodes':>6} {'ours, s':>9} {'theirs, s':>9} {'ratio':>7} "
        f"{'limit':>6} {'difference':>10}"
    )
    for pair in sorted(pairs, key=lambda p: (list(TITLES).index(p.name), p.nodes)):
        limit = limit_of(pair.name, pair.nodes)
        print(
            f"{TITLES[pair.name]:<34} {pair.nodes:6d} {pair.ours_s:9.4f} {pair.theirs_s:9.4f} "
            f"{pair.ratio:7.4f} {'' if limit is None else f'{limit:g}':>6} "
            f"{'' if pair.difference is None else f'{pair.difference:.1e}':>10}  {pair.note}"
        )
    print("\nDifference: of positions, m; of covariances, relative.\n")
    show_latency(report["online"])
    if report["scaling"]:
        show_scaling(report["scaling"])


def show_latency(latency: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> None:
    """Print the online estimator's table."""
    print(
        f"{'online':<20} {'nodes':>6} {'p50, ms':>9} {'p99, ms':>9} {'max, ms':>9} {'updates':>8}"
    )
    for name, sizes in latency.items():
        for nodes, leaf in sizes.items():
            print(
                f"{name:<20} {nodes:>6} {leaf['p50_ms']:9.3f} {leaf['p99_ms']:9.3f} "
                f"{leaf['max_ms']:9.3f} {leaf['updates']:8d}"
            )
    print()


def show_scaling(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print the scaling's table."""
    print(
        f"{'nodes':>7} {'build, s':>9} {'solve, s':>9} {'cov., s':>9} {'both, s':>9} "
        f"{'us/node':>8} {'peak, MB':>9}"
    )
    for row in rows:
        print(
            f"{row['nodes']:7d} {row['build_seconds']:9.4f} {row['solve_seconds']:9.4f} "
            f"{row['covariance_seconds']:9.4f} {row['seconds']:9.4f} "
            f"{1e6 * row['seconds'] / row['nodes']:8.2f} {row['peak_mb'] or np.nan:9.0f}"
        )
    steady = flatness(rows)
    if steady is not None:
        print(f"From {FLAT_FROM} nodes on: largest over smallest time per node {steady:.2f}")


def draw(report: Mapping[str, Any], path: Path) -> None:
    """Draw time over nodes into a PNG file."""
    from matplotlib.figure import Figure

    rows = report["scaling"]
    # From top to bottom as the lines lie; colours are Okabe and Ito's.
    curves = [
        ("GTSAM, our factors", "#CC79A7", "D", report["wrapped_scaling"], "seconds"),
        ("GTSAM, its own C++ factors", "#D55E00", "s", report["native_scaling"], "seconds"),
        ("banded, with all covariances", "#009E73", "^", rows, "seconds"),
        ("banded", "#0072B2", "o", rows, "solve_seconds"),
    ]
    figure = Figure(figsize=(7.2, 4.8), layout="constrained")
    axes = figure.subplots()
    for label, colour, mark, points, what in curves:
        nodes, seconds = [p["nodes"] for p in points], [p[what] for p in points]
        axes.loglog(nodes, seconds, color=colour, marker=mark, ms=5, lw=1.6, label=label)
    ends = np.array([rows[0]["nodes"], rows[-1]["nodes"]])
    guide = 0.5 * rows[0]["solve_seconds"] * ends / ends[0]
    axes.loglog(ends, guide, color="#7F7F7F", ls="--", lw=1.0, label="proportional to the nodes")
    axes.xaxis.set_major_formatter(lambda nodes, _: f"{nodes:,.0f}".replace(",", "\N{THIN SPACE}"))
    axes.yaxis.set_major_formatter(lambda seconds, _: f"{seconds:g}")
    axes.set_xlabel("nodes, one two-way ping each")
    axes.set_ylabel(f"time of {problems.ITERATIONS} Levenberg-Marquardt iterations, s")
    axes.grid(which="major", alpha=0.4)
    axes.grid(which="minor", alpha=0.12)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=9, framealpha=1.0, edgecolor="none")
    figure.savefig(path, dpi=150)


def baseline_of(report: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """A report's ratios and the online estimator's latencies, to three digits."""
    ratios = {
        name: {nodes: _rounded(ratio) for nodes, ratio in report[name].items()} for name in TITLES
    }
    return ratios | {
        "online": {
            name: {
                nodes: {what: _rounded(x) for what, x in leaf.items()}
                for nodes, leaf in sizes.items()
            }
            for name, sizes in report["online"].items()
        }
    }


def _rounded(x: float) -> float:
    """To three digits; counts stay whole."""
    return x if isinstance(x, int) else float(f"{x:.3g}")


def update_baseline(report: Mapping[str, Any], part: str | None) -> None:
    """Write a report's baseline, or of one part; the others stay as they are."""
    fresh = baseline_of(report)
    if part is not None:
        old = json.loads(BASELINE.read_text())
        fresh = old | {name: sizes for name, sizes in fresh.items() if name.startswith(part)}
    BASELINE.write_text(json.dumps(fresh, indent=2) + "\n")


def with_numbers(page: str, baseline: Mapping[str, Any]) -> str:
    """The docs' page with a baseline's numbers in its tables."""

    def ratio_row(found: re.Match[str]) -> str:
        ratio = baseline[found["name"]][found["nodes"].replace(" ", "")]
        return f"{found['head']}{ratio:g}{found['tail']}"

    def latency_row(found: re.Match[str]) -> str:
        leaves = [baseline["online"][name][found["nodes"]] for name in online.LISTED]
        cells = [f"{x['p50_ms']:g} / {x['p99_ms']:g} / {x['max_ms']:g}" for x in leaves]
        return " | ".join([f"| {found['nodes']}", *cells]) + " |"

    ratio = (
        r"^(?P<head>\| `(?P<name>\w+)` \|.*\| (?P<nodes>[\d ]+) \| )[\d.]+(?P<tail> \| [\d.]* *\|)$"
    )
    page = re.sub(ratio, ratio_row, page, flags=re.M)
    return re.sub(
        r"^\| (?P<nodes>\d+) \|(?: [\d./ ]+ / [\d./ ]+ \|){3}$", latency_row, page, flags=re.M
    )


def main(arguments: Sequence[str] | None = None, plan: Plan | None = None) -> int:
    """Run, print, write, and judge."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer repeats: some three minutes")
    parser.add_argument("--only", choices=("online",), help="run this part alone")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers here")
    parser.add_argument("--figure", type=Path, metavar="PNG", help="where the scaling figure goes")
    parser.add_argument("--no-figure", action="store_true", help="draw none")
    parser.add_argument("--scaling-row", type=int, nargs=2, help=argparse.SUPPRESS)
    after = parser.add_mutually_exclusive_group()
    after.add_argument("--gate", action="store_true", help="fail where a limit is exceeded")
    after.add_argument("--update-baseline", action="store_true", help=f"write {BASELINE.name}")
    after.add_argument("--write-docs", action="store_true", help=f"fill {PAGE.name}, run nothing")
    given = parser.parse_args(arguments)
    if given.scaling_row:
        print(json.dumps(problems.scaling_row(*given.scaling_row)))
        return 0
    if given.write_docs:
        page = with_numbers(PAGE.read_text("utf-8"), json.loads(BASELINE.read_text()))
        PAGE.write_text(page, "utf-8")
        return 0
    for path in (given.json, given.figure):
        if path and not path.resolve().parent.is_dir():
            parser.error(f"{path}: there is no such folder; make it first")
    plan = plan or (QUICK if given.quick else FULL)
    report, pairs = measure(plan.only_online() if given.only else plan)
    show(report, pairs)
    failed = disagreements(pairs)
    if given.gate:
        failed += excesses(report, json.loads(BASELINE.read_text()))
    if given.json:
        given.json.write_text(json.dumps(report, indent=2) + "\n")
    if given.update_baseline and not failed:
        update_baseline(report, given.only)
    figure = given.figure or (FIGURE if FIGURE.parent.is_dir() else None)
    if figure and report["scaling"] and not given.no_figure:
        draw(report, figure)
    for line in failed:
        print(f"FAILED {line}")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
