"""Writing into an output folder: cells, tables, JSON, and all of it or nothing.

All files are written beside the target first and moved in at the end, so that a failure leaves
nothing half-written.
"""

from __future__ import annotations

import csv
import json
import os
import shutil
import tempfile
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.errors import DataError


def check_folder(folder: str | Path) -> None:
    """Refuse an output that is a file (before hours of work, not after); write nothing.

    Raises
    ------
    DataError
        Where `folder` exists and is no folder.
    """
    folder = Path(folder)
    if (folder.exists() or folder.is_symlink()) and not folder.is_dir():
        raise DataError("the output is a file, not a folder", "name a folder", file=folder)


def time_cell(t: float) -> str:
    """All digits of a stamp: what reads it back finds the very same float."""
    return repr(float(t))


def number_cells(row: FloatArray) -> list[str]:
    """Each as `number_cell`."""
    return [number_cell(v) for v in row]


def number_cell(v: float) -> str:
    """A micrometre, and never "-0.000000"; nothing where there is no number."""
    if not np.isfinite(v):
        return ""
    return f"{v:.6f}" if abs(v) >= 5e-7 else "0.000000"


def scientific_cell(v: float, digits: int) -> str:
    """With an exponent and so many digits behind the point; nothing where there is no number."""
    return f"{v:.{digits}e}" if np.isfinite(v) else ""


def write_rows(path: Path, columns: Iterable[str], rows: Iterable[list[str]]) -> None:
    """Write a CSV file: names of columns, then rows."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file; what is infinite or no number becomes null."""
    path.write_text(json.dumps(_finite(content), indent=2) + "\n", encoding="utf-8")


def _finite(value: Any) -> Any:
    """JSON knows no infinity and no NaN: null stands for them."""
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(v) for v in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value


def names_in(stage: Path) -> list[Path]:
    """All files in a folder and its subfolders, by their path in it, sorted."""
    return sorted(p.relative_to(stage) for p in stage.rglob("*") if not p.is_dir())


@contextmanager
def staged(folder: Path) -> Generator[Path]:
    """A folder beside the target, moved into it when all went well, removed when not.

    Parameters
    ----------
    folder : Path
        The target; made where it is missing. Files of the same names in it and in its subfolders
        are replaced, others stay.

    Raises
    ------
    DataError
        Where the target cannot be made or written to; then nothing is left behind.
    """
    check_folder(folder)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        stage = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    except OSError as error:
        reason = error.strerror or str(error)
        raise DataError(
            f"the output folder cannot be made ({reason})",
            "name a folder you may write",
            file=folder,
        ) from error
    try:
        yield stage
        _move_in(stage, folder)
    finally:
        shutil.rmtree(stage, ignore_errors=True)


def _move_in(stage: Path, folder: Path) -> None:
    """Let the staged files take their places: all of them, or none where one cannot."""
    _check_places(stage, folder)
    try:
        if not folder.exists():
            stage.chmod(0o755)
            stage.replace(folder)
            return
        # Those of subfolders first: what sums them up is not newer than they are.
        for name in sorted(names_in(stage), key=lambda name: -len(name.parts)):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (stage / name).replace(folder / name)
    except OSError as error:
        reason = error.strerror or str(error)
        raise DataError(f"the output cannot be written ({reason})", file=folder) from error


def _check_places(stage: Path, folder: Path) -> None:
    """Refuse a target in which a folder stands where a file is to go, or the other way round."""
    for staged_path in sorted(stage.rglob("*")):
        name = staged_path.relative_to(stage)
        place = folder / name
        if not staged_path.is_dir() and place.is_dir():
            problem = f"'{name}' in the output folder is a folder"
        elif staged_path.is_dir() and (place.exists() or place.is_symlink()) and not place.is_dir():
            problem = f"'{name}' in the output folder is a file"
        elif place.is_dir() and not os.access(place, os.W_OK | os.X_OK):
            problem = f"'{name}' in the output folder cannot be written to"
        else:
            continue
        raise DataError(problem, "move it away", file=folder)
