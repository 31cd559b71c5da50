"""The numbers and figures of Zhao's paper again, and beside each number that of the graph.

Simulates the paper's formation of a master AUV and three followers, runs its plain and its fused
system and the graph on the same data, and writes zhao.json and the figures.

    python scripts/zhao.py -o OUT
    python scripts/zhao.py -o OUT --quick
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import zhao_plan as plans
import zhao_rows as tables
from paper_rows import Row, behind, check, command, show, write
from replay import Parser, progress
from zhao_cases import SEED, gathered, run

from ubl_graph.study import ProcessPool, run_study

#: Of the command and its file.
NAME = "zhao"


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = Parser(prog=NAME, description=__doc__.splitlines()[0])
    made.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="goes here")
    made.add_argument("--quick", action="store_true", help="fewer runs and places")
    return made


def studied(plan: plans.Plan) -> tuple[tables.Results, list[str]]:
    """Run all cases on worker processes; what came out by group, and what failed."""
    with progress() as report, ProcessPool() as pool:
        study = run_study(run, plans.cases(plan), executor=pool, progress=report, bundle=1)
    solved = [o for o in study.outcomes if o.value is not None]
    found = gathered([o.case for o in solved], [o.value for o in solved])
    return found, [f"{o.case}: {o.error}" for o in study.failures]


def summary(rows: Sequence[Row], plan: plans.Plan, quick: bool) -> dict[str, Any]:
    """What the file holds."""
    lost, compared = behind(rows)
    return {
        "rows": list(rows),
        "quick": quick,
        "seed": SEED,
        "ran": asdict(plan),
        "nees_bounds": tables.nees_bounds(plan.consistent),
        "compared": compared,
        "ahead": compared - len(lost),
    }


def reproduce(given: argparse.Namespace) -> list[str]:
    """Run, write and print; what failed."""
    check(given.output)
    plan = plans.QUICK if given.quick else plans.FULL
    found, failures = studied(plan)
    if failures:
        # Every number needs all of its runs.
        return failures
    from zhao_figures import figures

    rows = tables.rows(plan, found)
    write(given.output, f"{NAME}.json", summary(rows, plan, given.quick), figures(plan, found))
    show(rows)
    return []


def main(arguments: Sequence[str] | None = None) -> int:
    """Run; what is wrong with the input becomes one line."""
    return command(NAME, lambda: reproduce(parser().parse_args(arguments)))


if __name__ == "__main__":
    sys.exit(main())
