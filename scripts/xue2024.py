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
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import xue2024_rows as tables
from replay import Parser, progress, staged
from rich.console import Console
from rich.table import Table
from xue2024_cases import gathered, run

from ubl_graph.errors import DataError, UblGraphError
from ubl_graph.study import ProcessPool, run_study

#: Columns of text that no table needs more than.
WIDEST = 250
#: Draws a figure into a file.
Draw = Callable[[Path], None]


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = Parser(prog="xue2024", description=__doc__.splitlines()[0])
    made.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="goes here")
    made.add_argument("--quick", action="store_true", help="one seed instead of ten")
    made.add_argument(
        "--garpos", type=Path, metavar="MISSION.toml", help="Table 5 on this mission's lines"
    )
    return made


def check(given: argparse.Namespace) -> None:
    """Refuse before the run what would fail after it."""
    if given.output.exists() and not given.output.is_dir():
        raise DataError("the output is a file, not a folder", file=given.output)
    if not given.output.resolve().parent.is_dir():
        raise DataError("there is no such folder", "make it first", file=given.output.parent)


def simulated(plan: tables.Plan) -> tuple[dict[str, Any], list[str]]:
    """Run all cases on worker processes; what the file holds, and what failed."""
    cases = tables.cases(plan)
    with progress() as report, ProcessPool() as pool:
        study = run_study(run, cases, executor=pool, progress=report, bundle=1)
    solved = [o for o in study.outcomes if o.error is None]
    found = gathered([o.case for o in solved], [o.value for o in solved])
    rows = tables.rows(found)
    behind, compared = tables.behind(rows)
    numbers = {
        "rows": rows,
        "seeds": plan.seeds,
        "compared": compared,
        "ahead": compared - len(behind),
    }
    return numbers, [f"{o.case}: {o.error}" for o in study.failures]


def write(folder: Path, numbers: Mapping[str, Any], figures: Mapping[str, Draw]) -> None:
    """Write numbers and figures, once all are made."""
    made = not folder.exists()
    try:
        folder.mkdir(exist_ok=True)
        with ExitStack() as stack:
            text = json.dumps(numbers, indent=1, allow_nan=False)
            stack.enter_context(staged(folder / "xue2024.json")).write_text(
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


def show(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print all rows, and in how many the graph is ahead."""
    table = Table(box=None, pad_edge=False, header_style="")
    for title in ("table", "case", "quantity"):
        table.add_column(title, no_wrap=True)
    for title in ("paper", "baseline", "graph"):
        table.add_column(title, justify="right", no_wrap=True)
    behind, compared = tables.behind(list(rows))
    for row in rows:
        numbers = [row[name] for name in ("paper", "baseline", "graph")]
        mark = " <" if row in behind else ""
        cells = ["-" if v is None else f"{v:.4g}" for v in numbers]
        unit = f", {row['unit']}" if row["unit"] else ""
        table.add_row(
            row["table"], row["case"], row["quantity"] + unit, *cells[:2], cells[2] + mark
        )
    Console(width=WIDEST, highlight=False).print(table)
    if compared:
        ahead = compared - len(behind)
        print(f"The graph is ahead in {ahead} of {compared} errors ({ahead / compared:.0%}).")
    if behind:
        print("Where it is not, the row ends in <.")


def simulate(given: argparse.Namespace) -> list[str]:
    """The paper's simulations."""
    from xue2024_figures import simulated_figures

    numbers, failures = simulated(tables.QUICK if given.quick else tables.FULL)
    write(given.output, numbers, simulated_figures(numbers["rows"]))
    show(numbers["rows"])
    return failures


def record(given: argparse.Namespace) -> list[str]:
    """The paper's Table 5 on recorded lines."""
    from xue2024_figures import recorded_figures
    from xue2024_garpos import compared, loaded

    mission = loaded(given.garpos)
    with progress() as report:
        rows, tracks = compared(mission, report)
    behind, count = tables.behind(rows)
    numbers = {"rows": rows, "seeds": None, "compared": count, "ahead": count - len(behind)}
    write(given.output, numbers, recorded_figures(mission, tracks))
    show(rows)
    return []


def warn(text: str) -> None:
    """One line on standard error."""
    print(f"xue2024: {' '.join(text.split())}", file=sys.stderr)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run; what is wrong with the input becomes one line."""
    try:
        given = parser().parse_args(arguments)
        check(given)
        failures = record(given) if given.garpos else simulate(given)
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
