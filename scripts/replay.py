"""Replay a recorded mission through the online estimator, and say how far off it was.

Every record is fed in order of arrival; every ping is answered by an estimate, which is compared
with the reference track, or, where the mission has none, with the smoothed one. docs/replay.md says
what the numbers mean.

    python scripts/replay.py dive.toml
    python scripts/replay.py dive.toml --lag 40 --json dive.json --figure dive.png
    python scripts/replay.py dive.toml --real-time 10 --segment S01/L02
"""

from __future__ import annotations

import argparse
import difflib
import json
import os
import re
import sys
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import replay_runs as runs
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from ubl_graph.errors import ConfigurationError, DataError, UblGraphError
from ubl_graph.io.mission_file import load_mission
from ubl_graph.mission import Mission
from ubl_graph.result import Result
from ubl_graph.smoother import smooth

#: Columns of the table: title, key of the summary, form.
COLUMNS = (
    ("pings", "updates", "{:d}"),
    ("scored", "scored", "{:d}"),
    ("newest, m", "newest_rmse_m", "{:.2f}"),
    ("median", "newest_median_m", "{:.2f}"),
    ("half lag, m", "half_lag_rmse_m", "{:.2f}"),
    ("median", "half_lag_median_m", "{:.2f}"),
    ("smoothed, m", "smoothed_rmse_m", "{:.2f}"),
    ("NEES", "mean_nees", "{:.1f}"),
    ("ok", "share_ok", "{:.0%}"),
    ("rejected", "rejected", "{:d}"),
    ("p99, ms", "latency_p99_ms", "{:.1f}"),
    ("max", "latency_max_ms", "{:.1f}"),
)

#: Columns of text that no table needs more than.
WIDEST = 250

Report = Callable[[str, float], None]


class Parser(argparse.ArgumentParser):
    """A parser that says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        """Say it, and exit with 2."""
        self.exit(2, f"{self.prog}: {' '.join(message.split())}\n")


def parser() -> Parser:
    """The command line."""
    made = Parser(prog="replay", description=__doc__.splitlines()[0])
    made.add_argument("mission", type=Path, metavar="MISSION.toml", help="the mission file")
    made.add_argument(
        "--segment", action="append", default=[], metavar="NAME", help="this one alone; repeatable"
    )
    made.add_argument("--engine", choices=("lm", "isam2"), help="whatever the file says")
    made.add_argument("--lag", type=float, metavar="SECONDS", help="whatever the file says")
    made.add_argument(
        "--real-time",
        type=float,
        nargs="?",
        const=1.0,
        metavar="FACTOR",
        help="wait for each record's time, on a clock that runs FACTOR times as fast (1)",
    )
    made.add_argument("--no-smooth", action="store_true", help="do without the smoothed track")
    made.add_argument("--worst", type=int, default=0, metavar="N", help="list the worst estimates")
    made.add_argument("--json", type=Path, metavar="FILE", help="write the numbers here")
    made.add_argument("--figure", type=Path, metavar="FILE.png", help="draw errors and tracks here")
    return made


def check(given: argparse.Namespace) -> None:
    """Refuse before the run what would fail after it."""
    for path in filter(None, (given.json, given.figure)):
        if not path.resolve().parent.is_dir():
            raise DataError("there is no such folder", "make it first", file=path)
        if path.is_dir():
            raise DataError("the output is a folder, not a file", file=path)
    if given.figure and given.figure.suffix.lower() != ".png":
        raise ConfigurationError("no name of a PNG file", "end it in .png", file=given.figure)
    if given.real_time is not None and not 0.0 < given.real_time < float("inf"):
        raise ConfigurationError(f"a factor of {given.real_time}", field="--real-time")
    if given.worst < 0:
        raise ConfigurationError(f"{given.worst} is no number of estimates", field="--worst")


def loaded(given: argparse.Namespace) -> Mission:
    """The mission, with the segments and options that the command line names."""
    mission = load_mission(given.mission)
    names = [s.name for s in mission.segments]
    for name in given.segment:
        if name not in names:
            near = difflib.get_close_matches(name, names, n=1)
            hint = f"did you mean '{near[0]}'? " if near else ""
            known = ", ".join(filter(None, names)) or "none, the mission has a single one"
            raise ConfigurationError(
                f"there is no segment '{name}'", f"{hint}known: {known}", file=given.mission
            )
    mission = runs.chosen(mission, given.segment)
    for segment in mission.segments:
        if not set(runs.PINGS) & segment.records().keys():
            where = f"segment '{segment.name}'" if segment.name else "the mission"
            raise DataError(f"{where} holds no range to replay", file=given.mission)
    settings = {n: v for n in ("engine", "lag") if (v := getattr(given, n)) is not None}
    return replace(mission, options=replace(mission.options, **settings))


def replayed(mission: Mission, factor: float | None, report: Report) -> list[runs.Run]:
    """Run every segment, with an estimator of its own."""
    total, done = sum(map(runs.count, mission.segments)), 0
    out: list[runs.Run] = []
    for segment in mission.segments:

        def step(name: str = segment.name) -> None:
            nonlocal done
            done += 1
            report(name, done / total)

        out.append(runs.run(segment, mission.setup, runs.Pace(factor), step))
    return out


def scored(
    mission: Mission, result: Result | None, played: Sequence[runs.Run]
) -> tuple[str, list[runs.Score]]:
    """What the runs are compared with, "reference" or "smoothed", and their scores."""
    tracks: list[runs.Truth | None] = [None] * len(played)
    if result is not None:
        tracks = [runs.of_trajectory(s.trajectory) for s in result.segments]
    if not has_reference(mission):
        return "smoothed", [
            runs.score(r, truth, None) for r, truth in zip(played, tracks, strict=True) if truth
        ]
    truths = [runs.of_reference(s.reference) for s in mission.segments if s.reference is not None]
    found = [runs.score(*parts) for parts in zip(played, truths, tracks, strict=True)]
    return "reference", found


def has_reference(mission: Mission) -> bool:
    """Whether every segment has a reference track."""
    return all(s.reference is not None and len(s.reference.t) for s in mission.segments)


def report_of(mission: Mission, against: str, scores: Sequence[runs.Score]) -> dict[str, Any]:
    """What --json writes."""
    return {
        "mission": mission.name,
        "reference": against,
        "engine": mission.options.engine,
        "lag_s": mission.options.lag,
        **runs.summary(scores),
        "behind_max_s": max(s.run.behind for s in scores),
    }


def show(mission: Mission, against: str, scores: Sequence[runs.Score], real_time: bool) -> None:
    """Print the table."""
    print(
        f"{mission.name or 'mission'}: {mission.options.engine}, lag {mission.options.lag:g} s; "
        "horizontal RMSE and median "
        + ("against the reference" if against == "reference" else "against the smoothed track")
    )
    if against == "smoothed":
        print("There is no reference: the smoothed track, which knows the same pings, stands in.")
    table = Table(box=None, pad_edge=False, header_style="")
    table.add_column("segment", no_wrap=True)
    for title, _, _ in COLUMNS:
        table.add_column(title, justify="right", no_wrap=True)
    rows = {s.run.name or "-": runs.summary([s]) for s in scores}
    if len(scores) > 1:
        rows["all"] = runs.summary(scores)
    for name, numbers in rows.items():
        cells = [(numbers[key], form) for _, key, form in COLUMNS]
        table.add_row(name, *("-" if v is None else form.format(v) for v, form in cells))
    # Whatever the terminal's width: better a wrapped row than one without its end.
    Console(width=WIDEST, highlight=False).print(table)
    print("NEES: 2 expected" + ("." if against == "reference" else " of a reference, less here."))
    if real_time:
        behind = max(s.run.behind for s in scores)
        print(f"Longest wait of a record for the estimator: {behind:.3f} s")


def show_statuses(scores: Sequence[runs.Score]) -> None:
    """Say for what reasons scored estimates were not ok, how many and when."""
    found: dict[str, list[float]] = {}
    for s in scores:
        for i in np.flatnonzero(s.run.scored & (s.run.status != "ok")):
            # Reasons count seconds and metres: without the numbers they are the same.
            why = re.sub(r"\d+(\.\d+)?", "..", _why(s, int(i)))
            found.setdefault(f"{s.run.name or '-'}: {why}", []).append(float(s.newest.t[i]))
    for why, times in found.items():
        print(f"{len(times):5d} x {why}, {times[0]:.0f} to {times[-1]:.0f} s")


def show_worst(scores: Sequence[runs.Score], number: int) -> None:
    """List the scored newest estimates that are farthest off."""
    rows = [
        (float(s.newest.error[i]), float(s.newest.nees[i]), s, int(i))
        for s in scores
        for i in np.flatnonzero(s.run.scored & np.isfinite(s.newest.error))
    ]
    for error, nees, s, i in sorted(rows, key=lambda row: -row[0])[:number]:
        print(
            f"{s.run.name or '-'} at {s.newest.t[i]:.1f} s: {error:.2f} m, NEES {nees:.1f}, "
            f"{_why(s, i)}"
        )


def _why(s: runs.Score, i: int) -> str:
    estimate = s.run.estimates[i]
    return estimate.status + (f" ({'; '.join(estimate.reasons)})" if estimate.reasons else "")


@contextmanager
def progress() -> Generator[Report]:
    """A bar on standard error, where that is a terminal."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda what, share: bar.update(task, completed=share, description=what)


@contextmanager
def staged(path: Path) -> Generator[Path]:
    """A file beside `path` that takes its place when all went well, and goes when not."""
    stage = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        yield stage
        stage.replace(path)
    except OSError as error:
        reason = error.strerror or str(error)
        raise DataError(f"it cannot be written ({reason})", file=path) from error
    finally:
        with suppress(OSError):
            stage.unlink(missing_ok=True)


def write(
    given: argparse.Namespace, mission: Mission, against: str, scores: Sequence[runs.Score]
) -> None:
    """Write numbers and figure, once both are made."""
    with ExitStack() as stack:
        if given.json:
            text = json.dumps(report_of(mission, against, scores), indent=2, allow_nan=False)
            stack.enter_context(staged(given.json)).write_text(text + "\n", encoding="utf-8")
        if given.figure:
            from replay_figure import draw

            draw(mission, against, scores, stack.enter_context(staged(given.figure)))


def replay(given: argparse.Namespace) -> None:
    """Load, run, write and print."""
    check(given)
    mission = loaded(given)
    if given.no_smooth and not has_reference(mission):
        raise ConfigurationError(
            "without a reference and without the smoothed track there is nothing to compare with",
            "leave --no-smooth out",
            file=given.mission,
        )
    with progress() as report:
        result = None if given.no_smooth else smooth(mission, report)
        played = replayed(mission, given.real_time, report)
    if result is not None and result.status != "converged":
        warn(f"the smoothed track is {result.status}: {result.reason}")
    against, scores = scored(mission, result, played)
    if not any(s.run.scored.any() for s in scores):
        warn(f"nothing is scored: no segment is longer than the lag, {mission.options.lag:g} s")
    write(given, mission, against, scores)
    show(mission, against, scores, given.real_time is not None)
    show_statuses(scores)
    show_worst(scores, given.worst)


def warn(text: str) -> None:
    """One line on standard error."""
    print(f"replay: {' '.join(text.split())}", file=sys.stderr)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run; what is wrong with the input becomes one line."""
    try:
        replay(parser().parse_args(arguments))
    except UblGraphError as error:
        warn(str(error))
        return 2
    except KeyboardInterrupt:
        warn("interrupted")
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
