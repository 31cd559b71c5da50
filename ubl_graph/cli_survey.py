"""The body of `ubl-graph calibrate`: it loads, surveys, writes, and says what to print."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table

if TYPE_CHECKING:
    from ubl_graph.mission import Mission
    from ubl_graph.survey import SurveyResult


def load(file: Path, sigma: float | None) -> Mission:
    """The mission, with its ship's track as data, and a sigma where beacons have none."""
    from ubl_graph.io.mission_file import load_mission

    mission = load_mission(file, known_track=True)
    if sigma is None:
        return mission
    beacons = tuple(b if b.sigma.any() else replace(b, sigma=sigma) for b in mission.beacons)
    return replace(mission, beacons=beacons)


def lines(result: SurveyResult) -> list[str]:
    """What is printed above the table."""
    reason = f" ({result.reason})" if result.reason else ""
    return [f"status: {result.status}{reason}", result.verdict]


def table(result: SurveyResult) -> Table:
    """One row a beacon."""
    from ubl_graph.io.survey_files import ranges_summary

    shown = Table(box=None, pad_edge=False, header_style="")
    columns = ("east, m", "north, m", "up, m", "sd e/n/u, m", "ranges", "down-weighted", "rms, ms")
    slant = bool((result.residuals.kind == "slant").all())
    columns = (*columns[:-1], "rms, m" if slant else columns[-1], "off by, sd")
    for i, column in enumerate(("beacon", *columns)):
        shown.add_column(column, justify="left" if i == 0 else "right", no_wrap=True)
    checks = {c.name: c for c in result.check.checks}
    for beacon in result.beacons:
        stated = ranges_summary(result.residuals, beacon.name)
        rms = stated["residual_rms_s"]
        check = checks.get(beacon.name)
        flag = "  <" if beacon.name in (*result.check.named, *result.check.undecided) else ""
        shown.add_row(
            beacon.name,
            *(f"{v:.3f}" for v in beacon.position),
            "/".join(f"{v:.3f}" for v in beacon.sigma),
            str(stated["ranges"]),
            str(stated["down_weighted"]),
            "-" if rms is None else f"{rms * (1500.0 if slant else 1e3):.3f}",
            "-" if check is None else f"{check.statistic**0.5:.1f}{flag}",
        )
    return shown
