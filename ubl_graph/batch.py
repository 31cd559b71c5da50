"""Many missions smoothed the same way, each into its own folder, and one table over them all.

Workers load, smooth and draw; what is to be written comes back as bytes, and this process alone
writes. So a cluster needs no shared disk, and a worker that dies leaves nothing half-written.
"""

from __future__ import annotations

import csv
import io
import json
import math
import tempfile
import time
from collections.abc import Generator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ubl_graph import errors
from ubl_graph.errors import ConfigurationError, DataError, UblGraphError
from ubl_graph.evaluation import Errors, evaluate
from ubl_graph.io.mission_file import load_mission
from ubl_graph.io.output_folder import check_folder
from ubl_graph.io.result_files import versions, write_result
from ubl_graph.mission import Mission
from ubl_graph.options import Options
from ubl_graph.smoother import smooth
from ubl_graph.study import CaseError, iter_study
from ubl_graph.workers import ProcessPool, SerialExecutor

if TYPE_CHECKING:
    from ubl_graph.result import Result
    from ubl_graph.work import Progress

#: Files of the whole batch, beside the missions' folders.
TABLES: tuple[str, ...] = ("batch.csv", "batch.json")
#: Status of a mission that could not be loaded, smoothed or written.
FAILED = "failed"


@dataclass(frozen=True)
class BatchRow:
    """What became of one mission. docs/batch.md explains each column.

    Attributes
    ----------
    mission : str
        Its name; the mission file's without suffix where it could not be loaded.
    file, folder : str
        The mission file as given; the folder in the output folder.
    status, reason : str
        Of the `Result`, or "failed" with `error` instead of a reason.
    segments, pings : int
        How many.
    down_weighted_share : float or None
        Of the pings; None where there are none.
    median_sd_m : float or None
        Median over all nodes of the larger of the standard deviations east and north, m.
    horizontal_rmse_m : float or None
        Against the reference, m; None where the mission has none.
    seconds : float
        Loading, smoothing and drawing, s.
    warnings : tuple of str
        Of the `Result`.
    error : str
        One line; empty where the mission was smoothed and written.
    """

    mission: str
    file: str
    folder: str
    status: str = FAILED
    reason: str = ""
    segments: int = 0
    pings: int = 0
    down_weighted_share: float | None = None
    median_sd_m: float | None = None
    horizontal_rmse_m: float | None = None
    seconds: float = 0.0
    warnings: tuple[str, ...] = ()
    error: str = ""

    @property
    def failed(self) -> bool:
        """Whether nothing was written for it."""
        return self.status == FAILED


@dataclass(frozen=True, eq=False)
class _Case:
    """A mission on its way to a worker: as its file where the worker sees it, else loaded."""

    row: BatchRow
    source: Path | Mission
    figures: bool
    solver: str | None


@dataclass(frozen=True, eq=False)
class _Written:
    """What comes back: the row, and the files by name."""

    row: BatchRow
    files: dict[str, bytes]


def smooth_batch(
    missions: Sequence[str | Path],
    folder: str | Path,
    *,
    executor: Executor | None = None,
    figures: bool = True,
    solver: str | None = None,
    progress: Progress | None = None,
) -> list[BatchRow]:
    """Smooth many missions, each into a folder of its own in `folder`.

    Every mission's folder holds what `write_result` writes, and is there in whole or not at all.
    A mission that cannot be loaded, smoothed or written gets a row that says so and does not end
    the batch. The table over all is the caller's to write (`write_table`).

    Parameters
    ----------
    missions : sequence of path
        Mission files.
    folder : path
        Made where it is missing.
    executor : concurrent.futures.Executor, optional
        Where the work is done; a process pool if None. Other executors than `ProcessPool` and
        `SerialExecutor` get missions that were loaded here: their workers may not see the files.
    figures : bool
        Whether to draw figures (PNG).
    solver : str, optional
        Instead of the one that the missions name.
    progress : callable, optional
        Called with a text and the share done, as missions end.

    Returns
    -------
    list of BatchRow
        In the order of `missions`.

    Raises
    ------
    ConfigurationError
        Where no mission is given, one is given twice, or the solver is unknown.
    DataError
        Where the folder cannot be written to.
    """
    folder = Path(folder)
    files = [Path(mission) for mission in missions]
    _check_missions(files)
    if solver is not None:
        Options(solver=solver)  # type: ignore[arg-type] - any word; it is judged here
    rows = [
        BatchRow(mission=file.stem, file=str(file), folder=name)
        for file, name in zip(files, folder_names(files), strict=True)
    ]
    prepare_folder(folder, [row.folder for row in rows])
    here = executor is None or isinstance(executor, ProcessPool | SerialExecutor)
    cases: list[_Case] = []
    done: dict[str, BatchRow] = {}
    for row, file in zip(rows, files, strict=True):
        try:
            cases.append(_Case(row, file if here else load_mission(file), figures, solver))
        except UblGraphError as error:
            done[row.folder] = replace(row, error=_one_line(str(error)))
    outcomes = iter_study(_smooth_case, cases, executor=executor, progress=progress, bundle=1)
    with closing(outcomes):
        for outcome in outcomes:
            row = outcome.case.row
            if outcome.value is None:
                assert outcome.error is not None
                row = replace(row, seconds=round(outcome.seconds, 3), error=_text(outcome.error))
            else:
                row = _placed(outcome.value, folder)
            done[row.folder] = row
    return [done[row.folder] for row in rows]


def folder_names(files: Sequence[Path]) -> list[str]:
    """One folder name for each mission file: its name without suffix, made unique.

    Where several files share a name, that of their own folder goes before it; where that is not
    enough, a number goes behind. Names that differ in case alone count as the same.

    Examples
    --------
    >>> folder_names([Path("dive-7.toml"), Path("a/m.toml"), Path("b/m.toml"), Path("c/b/m.toml")])
    ['dive-7', 'a-m', 'b-m', 'b-m-2']
    """
    stems = [file.stem.casefold() for file in files]
    taken = {name.casefold() for name in TABLES}
    names: list[str] = []
    for file, stem in zip(files, stems, strict=True):
        shared = stems.count(stem) > 1
        base = f"{file.absolute().parent.name}-{file.stem}" if shared else file.stem
        name, number = base, 1
        while name.casefold() in taken:
            number += 1
            name = f"{base}-{number}"
        taken.add(name.casefold())
        names.append(name)
    return names


def prepare_folder(folder: Path, names: Sequence[str]) -> None:
    """Make the output folder, and find out now, not after hours of work, that it will not do.

    Raises
    ------
    DataError
        Where it cannot be written to, or something is in the way.
    """
    for part in (folder, *(folder / name for name in names)):
        check_folder(part)
    for name in TABLES:
        if (folder / name).is_dir():
            raise DataError(f"'{name}' in it is a folder", "move it away", file=folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(folder, error) from error
    with _stage(folder):
        pass


def write_table(rows: Sequence[BatchRow], folder: str | Path) -> None:
    """Write batch.csv and batch.json, one row a mission, into an existing folder.

    Raises
    ------
    DataError
        Where they cannot be written.
    """
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([field.name for field in fields(BatchRow)])
    writer.writerows([_cell(value) for value in asdict(row).values()] for row in rows)
    content = {"missions": [asdict(row) for row in rows], "versions": versions()}
    document = json.dumps(content, indent=2, allow_nan=False) + "\n"
    contents = (text.getvalue().encode(), document.encode())
    _place(dict(zip(TABLES, contents, strict=True)), Path(folder), Path(folder))


def _check_missions(files: Sequence[Path]) -> None:
    if not files:
        raise ConfigurationError("no mission file is given", "name one or more")
    seen: set[Path] = set()
    for file in files:
        if file.resolve() in seen:
            raise ConfigurationError("the mission file is given twice", "name it once", file=file)
        seen.add(file.resolve())


def _smooth_case(case: _Case, _seed: int) -> _Written:
    """Load, smooth and draw one mission, in a worker."""
    begin = time.perf_counter()
    mission = case.source if isinstance(case.source, Mission) else load_mission(case.source)
    if case.solver is not None:
        mission = replace(mission, options=replace(mission.options, solver=case.solver))
    result = smooth(mission)
    with tempfile.TemporaryDirectory(prefix="ubl-graph-") as folder:
        paths = write_result(result, folder, case.figures)
        files = {path.name: path.read_bytes() for path in paths}
    row = replace(_summed_up(case.row, result), seconds=round(time.perf_counter() - begin, 3))
    return _Written(row, files)


def _summed_up(row: BatchRow, result: Result) -> BatchRow:
    covariance = result.trajectory.covariance
    sd = np.sqrt(covariance[:, [0, 1], [0, 1]].max(axis=1))
    residuals = result.residuals
    compared = evaluate(result)
    rmse = Errors.joined(compared.values()).summary()["horizontal_rmse_m"] if compared else None
    return replace(
        row,
        mission=result.mission.name,
        status=result.status,
        reason=result.reason,
        segments=len(result.segments),
        pings=0 if residuals is None else len(residuals),
        down_weighted_share=None if residuals is None else _finite(residuals.down_weighted.mean()),
        median_sd_m=_finite(np.median(sd)),
        horizontal_rmse_m=_finite(rmse),
        warnings=result.warnings,
    )


def _placed(written: _Written, folder: Path) -> BatchRow:
    row = written.row
    try:
        _place(written.files, folder / row.folder, folder)
    except DataError as error:
        known = BatchRow(row.mission, row.file, row.folder, seconds=row.seconds)
        return replace(known, error=_one_line(str(error)))
    return row


def _text(error: CaseError) -> str:
    """Errors made on purpose say all that is needed; of others the kind is worth knowing."""
    kind = getattr(errors, error.type, None)
    ours = isinstance(kind, type) and issubclass(kind, UblGraphError)
    return _one_line(error.message if ours else str(error))


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _finite(value: Any) -> float | None:
    return None if value is None or not math.isfinite(value) else round(float(value), 6)


def _cell(value: Any) -> str:
    if isinstance(value, tuple):
        return "; ".join(value)
    return "" if value is None else str(value)


def _place(files: Mapping[str, bytes], target: Path, folder: Path) -> None:
    """Write files into `target`: into the batch's folder first, then all moved in."""
    with _stage(folder) as stage:
        for name, content in files.items():
            (stage / name).write_bytes(content)
        blocked = [name for name in files if (target / name).is_dir()]
        if blocked:
            raise DataError(f"'{blocked[0]}' in it is a folder", "move it away", file=target)
        if not target.exists():
            stage.replace(target)
            return
        for name in files:
            (stage / name).replace(target / name)


@contextmanager
def _stage(folder: Path) -> Generator[Path]:
    """A folder for files on their way, gone at the end; nothing but `folder` need be writable."""
    try:
        with tempfile.TemporaryDirectory(prefix=".ubl-graph-", dir=folder) as outer:
            # The outer one is for its owner alone; the inner one may take its final place.
            stage = Path(outer, "stage")
            stage.mkdir()
            yield stage
    except OSError as error:
        raise _unwritable(folder, error) from error


def _unwritable(folder: Path, error: OSError) -> DataError:
    return DataError(
        f"the output cannot be written ({error.strerror or error})",
        "name a folder you may write",
        file=folder,
    )
