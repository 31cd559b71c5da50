"""Show that Levenberg-Marquardt stays linear in the nodes with factors written in Python.

Grows a chain of constant-velocity nodes, one a second, each with one two-way ping along straight
rays, and times the solver over the same number of iterations for

- ours: the range residual as a wrapped custom factor, as `smooth` builds it;
- native: the same chain with GTSAM's own C++ RangeFactor3 (one-way at the node, beacon as a key).

What counts is the growth of time per node from the smallest to the largest chain, ours over
native. Exits with 1 where it exceeds --limit.

    python scripts/linear_time.py --json linear_time.json
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import gtsam
import numpy as np

from ubl_graph import Beacon, Mission, Options, Segment, SoundSpeedProfile, TwoWayRange
from ubl_graph.graph import build_problem, model_segment
from ubl_graph.gtsam_view import GraphView

SPEED = 1500.0
ITERATIONS = 3
#: So large that no node can be spared, m^2/s^3.
PSD = 2e-2
BEACONS = tuple(
    Beacon(f"B{i}", [800.0 * np.cos(a), 800.0 * np.sin(a), -500.0])
    for i, a in enumerate(np.arange(3) * 2.0 * np.pi / 3.0)
)


def position(t: np.ndarray) -> np.ndarray:
    """A wide circle at 1 m/s."""
    return np.stack(
        [300.0 * np.sin(t / 300.0), 300.0 * np.cos(t / 300.0), -10.0 + 0.0 * t], axis=-1
    )


def two_way_mission(nodes: int, rng: np.random.Generator) -> Mission:
    """One ping a node: sent at one, its reply heard two nodes later."""
    t = np.arange(float(nodes - 2))
    which = np.arange(len(t)) % 3
    receive = t + 2.0
    sites = np.array([BEACONS[i].position for i in which])
    out = np.linalg.norm(position(t) - sites, axis=1)
    back = np.linalg.norm(position(receive) - sites, axis=1)
    travel = (out + back) / SPEED + 1e-4 * rng.normal(size=len(t))
    names = [BEACONS[i].name for i in which]
    pings = TwoWayRange(names, t, receive, travel, 1e-4)
    options = Options(estimate_sound_speed=False, loss="none", acceleration_psd=PSD)
    return Mission(
        (Segment("", pings),), BEACONS, SoundSpeedProfile.constant(SPEED), options=options
    )


def ours(nodes: int, rng: np.random.Generator) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Graph and start as `smooth` would build them."""
    mission = two_way_mission(nodes, rng)
    problem = build_problem(mission, [model_segment(mission.segments[0], mission.options)])
    x = np.zeros(problem.layout.size)
    t = problem.layout.chains[0].t
    assert len(t) == nodes
    problem.layout.put(x, "position", position(t) + rng.normal(size=(len(t), 3)))
    view = GraphView(problem)
    return view.graph(problem.frozen(x)), view.values(x)


def native(nodes: int, rng: np.random.Generator) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The same chain with GTSAM's own factors."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    x, v, b = (gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.V, gtsam.symbol_shorthand.B)
    tight = gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)
    for j, beacon in enumerate(BEACONS):
        values.insert(b(j), np.array(beacon.position))
        graph.add(gtsam.PriorFactorPoint3(b(j), np.array(beacon.position), tight))
    wide = gtsam.noiseModel.Isotropic.Sigma(3, 10.0)
    noise = gtsam.noiseModel.Isotropic.Sigma(1, 0.075)
    psd = np.full(3, PSD)
    graph.add(gtsam.PriorFactorVector(v(0), np.zeros(3), wide))
    places = position(np.arange(float(nodes)))
    for k, place in enumerate(places):
        values.insert(x(k), place + rng.normal(size=3))
        values.insert(v(k), np.zeros(3))
        j = k % 3
        measured = np.linalg.norm(place - BEACONS[j].position) + 0.075 * rng.normal()
        graph.add(gtsam.RangeFactor3(x(k), b(j), measured, noise))
        if k:
            ends = [gtsam.StateData(x(i), v(i), float(i)) for i in (k - 1, k)]
            graph.add(gtsam.WnoaMotionFactorPoint3(*ends, psd))
    return graph, values


def solve_seconds(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> float:
    """Time of a fixed number of LM iterations, ordering included."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setlambdaInitial(1e-3)
    begin = time.perf_counter()
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
    for _ in range(ITERATIONS):
        optimizer.iterate()
    return time.perf_counter() - begin


def main() -> int:
    """Run, print the table, and judge."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--nodes", type=int, nargs="+", default=[1000, 2000, 4000, 8000, 16000])
    parser.add_argument("--repeats", type=int, default=3, help="runs of each, interleaved")
    parser.add_argument("--limit", type=float, default=1.5, help="largest growth, ours over native")
    parser.add_argument("--json", type=Path, help="write the numbers here")
    arguments = parser.parse_args()
    rows = []
    print(
        f"{'nodes':>7} {'ours, s':>9} {'native, s':>10} {'ours us/node':>13} {'native us/node':>15}"
    )
    for nodes in arguments.nodes:
        made = {
            "ours": ours(nodes, np.random.default_rng(1)),
            "native": native(nodes, np.random.default_rng(1)),
        }
        runs = [{k: solve_seconds(*v) for k, v in made.items()} for _ in range(arguments.repeats)]
        median = {k: float(np.median([run[k] for run in runs])) for k in made}
        row = {"nodes": nodes, "ours_s": median["ours"], "native_s": median["native"]}
        rows.append(row)
        per_node = (1e6 * row["ours_s"] / nodes, 1e6 * row["native_s"] / nodes)
        print(
            f"{nodes:7d} {row['ours_s']:9.3f} {row['native_s']:10.3f} "
            f"{per_node[0]:13.1f} {per_node[1]:15.1f}",
            flush=True,
        )

    def growth(name: str) -> float:
        return rows[-1][name] / rows[-1]["nodes"] / (rows[0][name] / rows[0]["nodes"])

    ratio = growth("ours_s") / growth("native_s")
    print(
        f"growth of time per node: ours {growth('ours_s'):.2f}, native {growth('native_s'):.2f}, "
        f"ratio {ratio:.2f} (limit {arguments.limit:g})"
    )
    if arguments.json:
        content = {"rows": rows, "growth_ratio": ratio}
        arguments.json.write_text(json.dumps(content, indent=2) + "\n")
    return int(ratio > arguments.limit)


if __name__ == "__main__":
    sys.exit(main())
