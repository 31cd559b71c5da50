"""The tables and figures of Cao 2017 again, and beside each number what the graph makes of it.

Simulates the paper's passes of a single beacon and what its sea trial may have been like, runs the
paper's methods and the graph on the same data, and writes cao2017.json and the figures.

    python scripts/cao2017.py -o OUT
    python scripts/cao2017.py -o OUT --quick
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cao2017_plan as plans
import cao2017_rows as tables
from cao2017_cases import run
from replay import Parser, progress, staged
from rich.console import Console
from rich.table import Table

from ubl_graph.errors import DataError, UblGraphError
from ubl_graph.study import ProcessPool, run_study

#: Columns of text that no table needs more than.
WIDEST = 250
#: Draws a figure into a file.
Draw = Callable[[Path], None]


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = Parser(prog="cao2017", description=__doc__.splitlines()[0])
    made.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="goes here")
    made.add_argument("--quick", action="store_true", help="fewer nodes and runs")
    return made


def check(folder: Path) -> None:
    """Refuse before the run what would fail after it."""
    if folder.exists() and not folder.is_dir():
        raise DataError("the output is a file, not a folder", file=folder)
    if not folder.resolve().parent.is_dir():
        raise DataError("there is no such folder", "make it first", file=folder.parent)


def studied(plan: plans.Plan) -> tuple[tables.Solved, list[str]]:
    """Run all cases on worker processes; what came out, and what failed."""
    with progress() as report, ProcessPool() as pool:
        study = run_study(
            run, plans.cases(plan), seed=plans.SEED, executor=pool, progress=report, bundle=1
        )
    solved = [(o.case, o.value) for o in study.outcomes if o.value is not None]
    return solved, [f"{o.case}: {o.error}" for o in study.failures]


def summary(rows: Sequence[tables.Row], plan: plans.Plan, quick: bool) -> dict[str, Any]:
    """What the file holds."""
    behind, compared = tables.behind(rows)
    return {
        "rows": list(rows),
        "quick": quick,
        "seed": plans.SEED,
        "ran": asdict(plan),
        "compared": compared,
        "ahead": compared - len(behind),
    }


def write(folder: Path, numbers: Mapping[str, Any], figures: Mapping[str, Draw]) -> None:
    """Write numbers and figures, once all are made."""
    made = not folder.exists()
    try:
        folder.mkdir(exist_ok=True)
        with ExitStack() as stack:
            text = json.dumps(numbers, indent=1, allow_nan=False)
            stack.enter_context(staged(folder / "cao2017.json")).write_text(
                text + "\n", encoding="utf-8"
            )
            for name, draw in figures.items():
                draw(stack.enter_context(staged(folder / f"{name}.png")))
    except OSError as error:
        raise DataError(f"it cannot be written ({error.strerror or error})", file=folder) from error
    finally:
        if made:
            with suppress(OSError):
                folder.rmdir()  # only where nothing came of it


def show(rows: Sequence[tables.Row]) -> None:
    """Print all rows, and in how many the graph is ahead."""
    table = Table(box=None, pad_edge=False, header_style="")
    for title in ("table", "case", "quantity"):
        table.add_column(title, no_wrap=True)
    for title in ("paper", "baseline", "graph"):
        table.add_column(title, justify="right", no_wrap=True)
    behind, compared = tables.behind(rows)
    for row in rows:
        numbers = [row[name] for name in ("paper", "baseline", "graph")]
        cells = ["-" if v is None else f"{v:.4g}" for v in numbers]
        unit = f", {row['unit']}" if row["unit"] else ""
        mark = " <" if row in behind else ""
        table.add_row(
            row["table"], row["case"], row["quantity"] + unit, *cells[:2], cells[2] + mark
        )
    Console(width=WIDEST, highlight=False).print(table)
    ahead = compared - len(behind)
    print(f"The graph is ahead in {ahead} of {compared} errors ({ahead / compared:.0%}).")
    if behind:
        print("Where it is not, the row ends in <.")


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
    write(given.output, summary(rows, plan, given.quick), figures(plan, solved))
    show(rows)
    return []


def warn(text: str) -> None:
    """One line on standard error."""
    print(f"cao2017: {' '.join(text.split())}", file=sys.stderr)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run; what is wrong with the input becomes one line."""
    try:
        failures = reproduce(parser().parse_args(arguments))
    except UblGraphError as error:
        warn(str(error))
        return 2
    except KeyboardInterrupt:
        warn("interrupted")
        return 130
    for failure in failures:
        warn(failure)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
