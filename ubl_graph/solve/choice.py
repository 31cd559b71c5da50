"""Which engines solve a problem."""

from __future__ import annotations

from dataclasses import dataclass

from ubl_graph.errors import SolverError
from ubl_graph.factors.poses import PoseMotion
from ubl_graph.options import Solver
from ubl_graph.problem import LeastSquares
from ubl_graph.solve.banded import BandedEngine
from ubl_graph.solve.lm import GtsamEngine
from ubl_graph.solve.normal import shape_of
from ubl_graph.solve.rounds import Engine

#: Up to so many nodes `auto` has GTSAM confirm the answer: it takes a second or less.
GTSAM_NODES = 5000
#: Rows of poses that are not GTSAM's own, up to which it does: a second or less, too.
GTSAM_POSE_ROWS = 8000
#: Shared unknowns that the banded solver takes: its border is dense, each one costs a solve.
MOST_SHARED = 64
#: Entries of the band that fit: 2 GB, and as much again several times over for the solution. The
#: covariances need it whatever solves the problem.
MOST_ENTRIES = 1 << 28


@dataclass(frozen=True)
class Choice:
    """Engines for a problem.

    Attributes
    ----------
    scout : Engine
        Solves from every start that is tried.
    last : Engine
        Is shown the best answer and, should it find a better one from there, gives its own. The
        scout itself where one engine does all.
    note : str
        What a user should know of the choice; empty where it is what was asked for.
    """

    scout: Engine
    last: Engine
    note: str = ""


def choose(problem: LeastSquares, solver: Solver, most_shared: int = MOST_SHARED) -> Choice:
    """Engines for a problem.

    Parameters
    ----------
    problem : LeastSquares
        What is to be solved.
    solver : str
        The option. `auto` scouts on the fast path wherever that takes the problem, and has GTSAM
        confirm the answer on the factor graph up to 5 000 nodes.

    Returns
    -------
    Choice

    Raises
    ------
    SolverError
        Where the problem is too large for the memory of any ordinary machine.
    """
    shape = shape_of(problem)
    if shape.band_size > MOST_ENTRIES:
        joined = shape.reach // problem.layout.node_width
        raise SolverError(
            f"{problem.layout.node_count} nodes, of which single measurements join {joined} in a "
            f"row, would take {8e-9 * shape.band_size:.1f} GB for the normal equations alone",
            "divide the segment",
        )
    if solver == "gtsam":
        return _alone(GtsamEngine(problem))
    if shape.border > most_shared:
        return _alone(
            GtsamEngine(problem),
            f"GTSAM solves it, not the banded solver: {shape.border} unknowns are shared by all "
            f"nodes, more than {most_shared}",
        )
    banded = BandedEngine(problem)
    few = problem.layout.node_count <= GTSAM_NODES and _pose_rows(problem) <= GTSAM_POSE_ROWS
    if solver == "auto" and few:
        return Choice(banded, GtsamEngine(problem))
    return _alone(banded)


def _pose_rows(problem: LeastSquares) -> int:
    """Rows of poses that GTSAM asks Python for."""
    if problem.layout.node == "point":
        return 0
    native = PoseMotion if problem.layout.node == "pose3" else ()
    own = (b for b in problem.blocks if not b.linear and not isinstance(b, native))
    return sum(len(b.columns) for b in own)


def _alone(engine: Engine, note: str = "") -> Choice:
    return Choice(engine, engine, note)
