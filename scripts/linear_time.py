"""Show that Levenberg-Marquardt stays linear in the nodes with factors written in Python.

Grows the benchmark's simple problem, a chain of constant-velocity nodes each with one two-way ping
along straight rays, and times GTSAM's optimiser over the same number of iterations for

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

import benchmark_problems as problems
import benchmark_rivals as rivals
import numpy as np


def ours(nodes: int) -> rivals.GraphCase:
    """Graph and start as `smooth` would build them."""
    case = problems.simple(nodes)
    return rivals.wrapped(case, case.start, case.problem.frozen(case.start))


def solve_seconds(case: rivals.GraphCase) -> float:
    """Time of a fixed number of LM iterations, ordering included."""
    begin = time.perf_counter()
    case.iterate()
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
        made = {"ours": ours(nodes), "native": rivals.native(nodes)}
        runs = [{k: solve_seconds(v) for k, v in made.items()} for _ in range(arguments.repeats)]
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
