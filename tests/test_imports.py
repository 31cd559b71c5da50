"""Imports go one way, and importing ubl_graph is cheap."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "ubl_graph"
#: A module imports only from those above it. Packages (trailing slash) are free within.
ORDER = [
    "errors",
    "arrays",
    "lie",
    "frames",
    "records",
    "measurements/",
    "beacon",
    "options",
    "acoustics/",
    "trajectory",
    "pose_path",
    "pose_trajectory",
    "segment",
    "mission_checks",
    "mission",
    "attitude",
    "layout",
    "factors/",
    "nodes",
    "problem",
    "pings",
    "builder",
    "odometry_noise",
    "odometry_chain",
    "pose_states",
    "pose_builder",
    "pose_nodes",
    "graph",
    "gtsam_batch",
    "gtsam_view",
    "windows",
    "reckoning",
    "track",
    "initial",
    "pose_windows",
    "pose_chain",
    "pose_starts",
    "pose_initial",
    "solve/",
    "noise_search",
    "tuning",
    "verdict",
    "result",
    "pose_assembly",
    "odometry_fill",
    "assembly",
    "steadiness",
    "hypotheses",
    "work",
    "solved",
    "noise_sources",
    "held_out",
    "variance_fit",
    "consistency",
    "smoother",
    "evaluation",
    "observability",
    "survey/",
    "cooperative/",
    "baselines/",
    "sim/",
    "drawing",
    "plots",
    "survey_plots",
    "fleet_plots",
    "io/",
    "online/",
    "cluster",
    "workers",
    "study",
    "batch",
    "cli_tables",
    "cli_survey",
    "cli",
    "__main__",
]


def place(module: str) -> int:
    """Rank of a module named like "factors.linear"."""
    head = module.split(".")[0]
    for rank, name in enumerate(ORDER):
        if name.rstrip("/") == head:
            return rank
    raise AssertionError(f"ubl_graph.{module} is missing in ORDER")


def imported(path: Path) -> set[str]:
    """Modules of ubl_graph that a file imports at run time, whether at its top or in a function."""
    tree = ast.parse(path.read_text())
    typing_only = {
        id(node)
        for branch in ast.walk(tree)
        if isinstance(branch, ast.If) and ast.unparse(branch.test) == "TYPE_CHECKING"
        for node in ast.walk(branch)
    }
    found: set[str] = set()
    for node in ast.walk(tree):
        if id(node) in typing_only:
            continue
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("ubl_graph"):
            module = (node.module or "").removeprefix("ubl_graph").lstrip(".")
            found |= {module} if module else {a.name for a in node.names}
        elif isinstance(node, ast.Import):
            found |= {
                a.name.removeprefix("ubl_graph.") for a in node.names if "ubl_graph" in a.name
            }
    return found - {"__version__"}


FILES = sorted(p for p in PACKAGE.rglob("*.py") if p != PACKAGE / "__init__.py")


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_a_module_imports_only_from_those_above_it(path):
    own = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
    for other in imported(path):
        same_package = own.split(".")[0] == other.split(".")[0] and "." in own
        assert place(other) < place(own) or same_package, f"{own} imports {other}"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_library_code_neither_prints_nor_exits(path):
    if path.name in ("cli.py", "__main__.py"):
        return
    calls = {
        ast.unparse(node.func)
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call)
    }
    assert not calls & {"print", "exit", "quit", "sys.exit", "os._exit"}


def test_importing_ubl_graph_pulls_nothing_heavy():
    heavy = ("matplotlib", "pydantic", "typer", "rich", "gtsam", "pymap3d", "scipy")
    code = f"import sys, ubl_graph; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_every_public_name_is_there():
    import ubl_graph

    for name in ubl_graph.__all__:
        assert getattr(ubl_graph, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = ubl_graph.nothing
