"""What the papers' scripts have in common: rows, the table of them, and files that are whole."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, TypeAlias

from replay import staged
from rich.console import Console
from rich.table import Table

from ubl_graph.errors import DataError, UblGraphError

#: Keys table, case, quantity, unit, paper, baseline, graph.
Row: TypeAlias = dict[str, Any]
#: Draws a figure into a file.
Draw: TypeAlias = Callable[[Path], None]
#: Columns of text that no table needs more than.
WIDEST = 250


def behind(rows: Sequence[Row]) -> tuple[list[Row], int]:
    """Error rows in which the graph is not ahead, and how many hold both numbers."""
    both = [
        r for r in rows if r["unit"] == "m" and r["baseline"] is not None and r["graph"] is not None
    ]
    return [r for r in both if not r["graph"] < r["baseline"]], len(both)


def check(folder: Path) -> None:
    """Refuse before the run an output that would fail after it."""
    if folder.exists() and not folder.is_dir():
        raise DataError("the output is a file, not a folder", file=folder)
    if not folder.resolve().parent.is_dir():
        raise DataError("there is no such folder", "make it first", file=folder.parent)


def write(folder: Path, name: str, numbers: Mapping[str, Any], figures: Mapping[str, Draw]) -> None:
    """Write numbers (into `name`) and figures (PNG), once all are made."""
    made = not folder.exists()
    try:
        folder.mkdir(exist_ok=True)
        with ExitStack() as stack:
            text = json.dumps(numbers, indent=1, allow_nan=False)
            stack.enter_context(staged(folder / name)).write_text(text + "\n", encoding="utf-8")
            for figure, draw in figures.items():
                draw(stack.enter_context(staged(folder / f"{figure}.png")))
    except OSError as error:
        raise DataError(f"it cannot be written ({error.strerror or error})", file=folder) from error
    finally:
        if made:
            with suppress(OSError):
                folder.rmdir()  # only where nothing came of it


def command(name: str, reproduce: Callable[[], Sequence[str]]) -> int:
    """Run a script's command; what is wrong with the input becomes one line. Its exit code."""

    def warn(text: str) -> None:
        print(f"{name}: {' '.join(text.split())}", file=sys.stderr)

    try:
        failures = reproduce()
    except UblGraphError as error:
        warn(str(error))
        return 2
    except KeyboardInterrupt:
        warn("interrupted")
        return 130
    for failure in failures:
        warn(failure)
    return 1 if failures else 0


def show(rows: Sequence[Row]) -> None:
    """Print all rows, and in how many the graph is ahead."""
    table = Table(box=None, pad_edge=False, header_style="")
    for title in ("table", "case", "quantity"):
        table.add_column(title, no_wrap=True)
    for title in ("paper", "baseline", "graph"):
        table.add_column(title, justify="right", no_wrap=True)
    lost, compared = behind(rows)
    for row in rows:
        numbers = [row[name] for name in ("paper", "baseline", "graph")]
        cells = ["-" if v is None else f"{v:.4g}" for v in numbers]
        unit = f", {row['unit']}" if row["unit"] else ""
        mark = " <" if row in lost else ""
        table.add_row(
            row["table"], row["case"], row["quantity"] + unit, *cells[:2], cells[2] + mark
        )
    Console(width=WIDEST, highlight=False).print(table)
    if compared:
        ahead = compared - len(lost)
        print(f"The graph is ahead in {ahead} of {compared} errors ({ahead / compared:.0%}).")
    if lost:
        print("Where it is not, the row ends in <.")
