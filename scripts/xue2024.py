"""The tables and figures of Xue et al. 2024 again, and beside each number that of the graph.

Simulates the paper's three tracks, runs its windows (space intersection, constant velocity,
constant acceleration) and the graph on the same pings, and writes xue2024.json and the figures.
With --garpos it does the experiment of the paper's Table 5 on recorded lines instead.

    python scripts/xue2024.py -o OUT
    python scripts/xue2024.py -o OUT --quick
    python scripts/xue2024.py --garpos MISSION.toml -o OUT
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import xue2024_rows as tables
from paper_rows import behind, check, command, show, write
from replay import Parser, progress
from xue2024_cases import gathered, run

from ubl_graph.study import ProcessPool, run_study

#: Of the command and its file.
NAME = "xue2024"


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = Parser(prog=NAME, description=__doc__.splitlines()[0])
    made.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="goes here")
    made.add_argument("--quick", action="store_true", help="one seed instead of ten")
    made.add_argument(
        "--garpos", type=Path, metavar="MISSION.toml", help="Table 5 on this mission's lines"
    )
    return made


def simulated(plan: tables.Plan) -> tuple[dict[str, Any], list[str]]:
    """Run all cases on worker processes; what the file holds, and what failed."""
    cases = tables.cases(plan)
    with progress() as report, ProcessPool() as pool:
        study = run_study(run, cases, executor=pool, progress=report, bundle=1)
    solved = [o for o in study.outcomes if o.error is None]
    found = gathered([o.case for o in solved], [o.value for o in solved])
    rows = tables.rows(found)
    lost, compared = behind(rows)
    numbers = {
        "rows": rows,
        "seeds": plan.seeds,
        "compared": compared,
        "ahead": compared - len(lost),
    }
    return numbers, [f"{o.case}: {o.error}" for o in study.failures]


def simulate(given: argparse.Namespace) -> list[str]:
    """The paper's simulations."""
    from xue2024_figures import simulated_figures

    numbers, failures = simulated(tables.QUICK if given.quick else tables.FULL)
    write(given.output, f"{NAME}.json", numbers, simulated_figures(numbers["rows"]))
    show(numbers["rows"])
    return failures


def record(given: argparse.Namespace) -> list[str]:
    """The paper's Table 5 on recorded lines."""
    from xue2024_figures import recorded_figures
    from xue2024_garpos import compared, loaded

    mission = loaded(given.garpos)
    with progress() as report:
        rows, tracks = compared(mission, report)
    lost, count = behind(rows)
    numbers = {"rows": rows, "seeds": None, "compared": count, "ahead": count - len(lost)}
    write(given.output, f"{NAME}.json", numbers, recorded_figures(mission, tracks))
    show(rows)
    return []


def reproduce(arguments: Sequence[str] | None) -> list[str]:
    """Run, write and print; what failed."""
    given = parser().parse_args(arguments)
    check(given.output)
    return record(given) if given.garpos else simulate(given)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run; what is wrong with the input becomes one line."""
    return command(NAME, lambda: reproduce(arguments))


if __name__ == "__main__":
    sys.exit(main())
