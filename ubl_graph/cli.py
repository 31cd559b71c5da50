"""The command `ubl-graph`: thin, it only parses, shows progress and prints.

Bad input ends with one line on standard error and exit code 2; nothing is written then.
"""

from __future__ import annotations

import logging
import os
import sys
import time
from collections.abc import Generator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from ubl_graph.cli_tables import (
    batch_table,
    errors_table,
    segments_table,
    targets_table,
    vehicles_table,
)
from ubl_graph.errors import UblGraphError

if TYPE_CHECKING:
    from ubl_graph.cooperative.result import FleetResult
    from ubl_graph.evaluation import Errors
    from ubl_graph.mission import Mission
    from ubl_graph.result import Result
    from ubl_graph.work import Progress as Report

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Underwater beacon localisation: from acoustic travel times to a trajectory with honest "
    "covariances.",
)

#: Work that takes less than this gets no progress bar, s.
PATIENCE = 1.0

Output = Annotated[
    Path, typer.Option("-o", "--output", metavar="DIR", help="Folder to write into.")
]
Figures = Annotated[bool, typer.Option(help="Draw figures (PNG).")]
SolverOption = Annotated[
    str | None,
    typer.Option("--solver", metavar="NAME", help="auto, gtsam or banded, whatever the file says."),
]


@app.callback(invoke_without_command=True)
def root(
    version: Annotated[bool, typer.Option("--version", help="Print the version and stop.")] = False,
) -> None:
    """Name the version, or hand over to a command."""
    if version:
        from ubl_graph import __version__

        typer.echo(f"ubl-graph {__version__}")
        raise typer.Exit


@app.command()
def smooth(
    mission: Annotated[Path, typer.Argument(metavar="MISSION.toml", help="The mission file.")],
    output: Output,
    figures: Figures = True,
    solver: SolverOption = None,
) -> None:
    """Smooth a mission and write trajectory, residuals, result and figures.

    A file with [[vehicle]] tables is a fleet's: all its vehicles are smoothed together, and each
    gets a folder in DIR.

    Example: ubl-graph smooth dive.toml -o dive-out
    """
    from ubl_graph.evaluation import Errors, evaluate
    from ubl_graph.io.mission_file import load_mission
    from ubl_graph.io.mission_parts import holds_fleet

    if holds_fleet(mission):
        _smooth_fleet(mission, output, figures, solver)
        return
    loaded = _solved_by(load_mission(mission), solver)
    _check_output(output)
    result = _judged(_smooth(loaded))
    _write(result, output, figures)
    _print_result(result)
    compared = evaluate(result)
    if compared:
        _show(errors_table({"against the reference": Errors.joined(compared.values())}))


@app.command()
def demo(
    output: Output = Path("ubl-graph-demo"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulated noise.")] = 1,
    figures: Figures = True,
    solver: SolverOption = None,
) -> None:
    """Simulate an AUV survey over one beacon, smooth it, and compare with dead reckoning.

    Example: ubl-graph demo -o demo-out
    """
    from ubl_graph.baselines.dead_reckoning import dead_reckoning
    from ubl_graph.evaluation import errors_of, evaluate
    from ubl_graph.sim import demo_survey

    _check_output(output)
    mission = _solved_by(demo_survey(seed)[0], solver)
    result = _judged(_smooth(mission))
    reckoned = dead_reckoning(mission)
    _write(result, output, figures, {"dead reckoning": list(reckoned.values())})
    _print_result(result)
    rows: dict[str, Errors] = {}
    for segment in mission.segments:
        assert segment.reference is not None
        rows["dead reckoning"] = errors_of(reckoned[segment.name], segment.reference)
        rows["smoothed"] = evaluate(result)[segment.name]
    _show(errors_table(rows))


@app.command()
def batch(
    missions: Annotated[
        list[Path], typer.Argument(metavar="MISSION.toml", help="The mission files.")
    ],
    output: Output,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Let the workers of this dask scheduler do it, e.g. tcp://10.0.0.5:8786.",
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Processes; one per processor if left out."),
    ] = None,
    figures: Figures = True,
    solver: SolverOption = None,
) -> None:
    """Smooth many missions the same way, side by side, and sum them up in one table.

    Each mission gets a folder in DIR, named after its file; the table is printed and written to
    DIR/batch.csv and DIR/batch.json. A mission that fails does not end the batch: it is named on
    standard error, and the exit code is then 1.

    Example: ubl-graph batch dives/*.toml -o dives-out
    """
    from ubl_graph.batch import smooth_batch, write_table
    from ubl_graph.workers import executor_at

    with executor_at(scheduler, workers=workers) as executor, _progress("batch") as report:
        if scheduler is not None:
            # What dask says of workers that come and go would tear the bar; what is lost with
            # one ends in the table.
            logging.getLogger("distributed").setLevel(logging.CRITICAL)
        rows = smooth_batch(
            missions, output, executor=executor, figures=figures, solver=solver, progress=report
        )
    for row in rows:
        if row.failed:
            _warn(row.error if row.file in row.error else f"{row.file}: {row.error}")
        for warning in row.warnings:
            typer.echo(f"warning: {row.folder}: {warning}", err=True)
    write_table(rows, output)
    typer.echo(f"written to {output}")
    _show(batch_table(rows))
    for row in rows:
        if row.reason:
            typer.echo(f"{row.folder}: {row.status}: {row.reason}")
    if any(row.failed for row in rows):
        raise typer.Exit(1)


@app.command()
def calibrate(
    mission: Annotated[Path, typer.Argument(metavar="MISSION.toml", help="The mission file.")],
    output: Output,
    figures: Figures = True,
    sigma: Annotated[
        float | None,
        typer.Option(
            min=1e-3,
            metavar="METRES",
            help="Standard deviation of given positions that have none; left out, they are free.",
        ),
    ] = None,
) -> None:
    """Survey a mission's beacons from a vehicle whose track is known, and check given positions.

    Writes beacons.json, which a garpos mission takes as its beacons, result.json, residuals and
    figures. Of a garpos mission the ship's track serves as data.

    Example: ubl-graph calibrate survey.toml -o survey-out
    """
    from ubl_graph import cli_survey
    from ubl_graph.io.survey_files import write_survey
    from ubl_graph.survey import calibrate as run

    loaded = cli_survey.load(mission, sigma)
    _check_output(output)
    with _progress(loaded.name) as report:
        result = run(loaded, progress=report)
    write_survey(result, output, figures)
    typer.echo(f"written to {output}")
    for line in cli_survey.lines(result):
        typer.echo(line)
    for warning in result.warnings:
        typer.echo(f"warning: {warning}", err=True)
    _show(cli_survey.table(result))


@app.command()
def live(
    config: Annotated[
        Path,
        typer.Argument(metavar="CONFIG.toml", help="A mission file without its data table."),
    ],
    checkpoint: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Keep the state in this file, and resume from it where it exists.",
        ),
    ] = None,
    udp: Annotated[
        int | None,
        typer.Option(
            metavar="PORT",
            min=0,
            max=65535,
            help="Take the lines from this UDP port on the loopback address instead of standard "
            "input; 0 takes a free one.",
        ),
    ] = None,
) -> None:
    """Estimate as the data come: JSON lines in, JSON lines out.

    One record a line, in any order of time inside the lag: two_way_range, one_way_range,
    slant_range, velocity, attitude, heading, angular_rate, odometry, depth, position; then query,
    health, reset, set_position. Every ping, position and query is answered by an estimate; what
    is not used, by a line that says why.
    A bad line never ends the process. It stops at the end of the input and at SIGTERM or SIGINT,
    says how it went, and exits 0.

    Example: ubl-graph live vehicle.toml --checkpoint vehicle.state

    {"type": "two_way_range", "beacon": "B1", "t_transmit": 10.0, "t_receive": 10.9,
    "travel_time": 0.7}

    {"type": "query", "t": 12.0}
    """
    # Matrices of a window are small: threads would wait for each other on a busy machine.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from ubl_graph.online.process import serve

    serve(config, checkpoint, udp, _warn)


def main() -> None:
    """Entry point: every error made on purpose becomes one line and exit code 2."""
    try:
        app(standalone_mode=True)
    except UblGraphError as error:
        # One line whatever a name in it may hold.
        text = " ".join(str(error).split())
        typer.echo(f"ubl-graph: {text}", err=True)
        sys.exit(2)
    except KeyboardInterrupt:
        typer.echo("ubl-graph: interrupted", err=True)
        sys.exit(130)


def _warn(text: str) -> None:
    # Where nobody reads warnings, nobody misses them.
    with suppress(OSError):
        typer.echo(f"ubl-graph: {' '.join(text.split())}", err=True)


def _solved_by(mission: Mission, solver: str | None) -> Mission:
    """The mission with the solver that the command line names."""
    if solver is None:
        return mission
    return replace(mission, options=replace(mission.options, solver=solver))


def _smooth(mission: Mission) -> Result:
    from ubl_graph.smoother import smooth as run

    with _progress(mission.name) as report:
        return run(mission, report)


def _smooth_fleet(file: Path, output: Path, figures: bool, solver: str | None) -> None:
    from ubl_graph.cooperative.smoother import smooth_fleet
    from ubl_graph.io.fleet_file import load_fleet
    from ubl_graph.io.fleet_result_files import write_fleet_result

    fleet = load_fleet(file)
    if solver is not None:
        fleet = replace(fleet, options=replace(fleet.options, solver=solver))
    _check_output(output)
    with _progress(fleet.name) as report:
        result = smooth_fleet(fleet, report)
    write_fleet_result(result, output, figures)
    typer.echo(f"written to {output}")
    _print_status(result)
    _show(vehicles_table(result))
    if result.targets:
        _show(targets_table(result))


def _judged(result: Result) -> Result:
    """The result with a verdict on its sigmas."""
    from ubl_graph.consistency import assess

    return replace(result, consistency=assess(result))


def _write(result: Result, folder: Path, figures: bool, beside: Any = None) -> None:
    from ubl_graph.io.result_files import write_result

    write_result(result, folder, figures, beside)
    typer.echo(f"written to {folder}")


def _check_output(folder: Path) -> None:
    from ubl_graph.io.output_folder import check_folder

    check_folder(folder)


@contextmanager
def _progress(name: str) -> Generator[Report]:
    """A bar on a terminal's standard error, shown only if the work takes longer than a second."""
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.fields[stage]}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
    )
    bar = Progress(*columns, console=console, transient=True)
    begin = time.monotonic()
    task = bar.add_task(name, total=1.0, stage="")

    def report(stage: str, done: float) -> None:
        bar.update(task, completed=done, stage=f"{name} {stage}".strip())
        if console.is_terminal and not bar.live.is_started and time.monotonic() - begin > PATIENCE:
            bar.start()

    try:
        yield report
    finally:
        if bar.live.is_started:
            bar.stop()


def _print_result(result: Result) -> None:
    _print_status(result)
    if result.tuning is not None and result.tuning.chosen:
        typer.echo("chosen by the data: " + ", ".join(_chosen(result.tuning.chosen)))
    if result.inflation is not None:
        typer.echo(f"noise inflated: {result.inflation.verdict}")
    if result.consistency is not None:
        typer.echo(result.consistency.verdict)
    _show(segments_table(result))


def _print_status(result: Result | FleetResult) -> None:
    typer.echo(f"status: {result.status}" + (f" ({result.reason})" if result.reason else ""))
    for warning in result.warnings:
        typer.echo(f"warning: {warning}", err=True)


def _chosen(values: dict[str, float | str]) -> list[str]:
    return [f"{k} {v if isinstance(v, str) else format(v, '.2g')}" for k, v in values.items()]


def _show(table: Any) -> None:
    # A pipe has no width; 120 keeps the rows whole.
    console = Console()
    Console(width=None if console.is_terminal else 120, highlight=False).print(table)


if __name__ == "__main__":
    main()
