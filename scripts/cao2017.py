"""The tables and figures of Cao 2017 again, and beside each number what the graph makes of it.

Simulates the paper's passes of a single beacon and what its sea trial may have been like, runs the
paper's methods and the graph on the same data, and writes cao2017.json and the figures.

    python scripts/cao2017.py -o OUT
    python scripts/cao2017.py -o OUT --quick
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cao2017_plan as plans
import cao2017_rows as tables
from cao2017_cases import run
from paper_rows import Row, behind, check, command, show, write
from replay import Parser, progress

from ubl_graph.study import ProcessPool, run_study

#: Of the command and its file.
NAME = "cao2017"


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = Parser(prog=NAME, description=__doc__.splitlines()[0])
    made.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="goes here")
    made.add_argument("--quick", action="store_true", help="fewer nodes and runs")
    return made


def studied(plan: plans.Plan) -> tuple[tables.Solved, list[str]]:
    """Run all cases on worker processes; what came out, and what failed."""
    with progress() as report, ProcessPool() as pool:
        study = run_study(
            run, plans.cases(plan), seed=plans.SEED, executor=pool, progress=report, bundle=1
        )
    solved = [(o.case, o.value) for o in study.outcomes if o.value is not None]
    return solved, [f"{o.case}: {o.error}" for o in study.failures]


def summary(rows: Sequence[Row], plan: plans.Plan, quick: bool) -> dict[str, Any]:
    """What the file holds."""
    lost, compared = behind(rows)
    return {
        "rows": list(rows),
        "quick": quick,
        "seed": plans.SEED,
        "ran": asdict(plan),
        "compared": compared,
        "ahead": compared - len(lost),
    }


def reproduce(given: argparse.Namespace) -> list[str]:
    """Run, write and print; what failed."""
    check(given.output)
    plan = plans.QUICK if given.quick else plans.FULL
    solved, failures = studied(plan)
    if failures:
        # Every table needs all of its cases.
        return failures
    from cao2017_figures import figures

    rows = tables.rows(plan, solved)
    write(given.output, f"{NAME}.json", summary(rows, plan, given.quick), figures(plan, solved))
    show(rows)
    return []


def main(arguments: Sequence[str] | None = None) -> int:
    """Run; what is wrong with the input becomes one line."""
    return command(NAME, lambda: reproduce(parser().parse_args(arguments)))


if __name__ == "__main__":
    sys.exit(main())
