"""Fixtures that several test files share."""

from __future__ import annotations

import os
from pathlib import Path

# Tests run side by side; linear algebra's own threads would wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from hypothesis import settings

settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")


def _absent(reason: str) -> None:
    """Skip, or fail where UBL_GRAPH_DATA_REQUIRED is set (as .ci/run does)."""
    if os.environ.get("UBL_GRAPH_DATA_REQUIRED"):
        pytest.fail(reason)
    pytest.skip(reason)


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """Folder of the real data sets: $UBL_GRAPH_DATA, or shared/data beside the repository."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("UBL_GRAPH_DATA", beside))
    if not folder.is_dir():
        _absent(f"real data are not at {folder}; set UBL_GRAPH_DATA to their folder")
    return folder


@pytest.fixture(scope="session")
def saga(data_folder: Path) -> Path:
    """Folder of the GARPOS sample campaign SAGA.1903."""
    folder = data_folder / "garpos"
    if not folder.is_dir():
        _absent(f"the GARPOS sample campaign is not at {folder}")
    return folder
