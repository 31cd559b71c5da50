"""Which engines solve a problem."""

from __future__ import annotations

from dataclasses import dataclass

from ubl_graph.options import Solver
from ubl_graph.problem import Problem
from ubl_graph.solve.banded import BandedEngine
from ubl_graph.solve.lm import GtsamEngine
from ubl_graph.solve.normal import shape_of
from ubl_graph.solve.rounds import Engine

#: Up to so many nodes `auto` has GTSAM confirm the answer: it takes a second or less.
GTSAM_NODES = 5000
#: Shared unknowns that the banded solver takes: its border is dense, each one costs a solve.
MOST_SHARED = 64
#: Entries of the band that it takes: 2 GB.
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


def choose(problem: Problem, solver: Solver) -> Choice:
    """Engines for a problem.

    Parameters
    ----------
    problem : Problem
        What is to be solved.
    solver : str
        The option. `auto` scouts on the fast path wherever that takes the problem, and has GTSAM
        confirm the answer on the factor graph up to 5 000 nodes.

    Returns
    -------
    Choice
    """
    reason = "" if solver == "gtsam" else not_banded(problem)
    if solver == "gtsam" or reason:
        engine = GtsamEngine(problem)
        note = f"GTSAM solves it, not the banded solver: {reason}" if reason else ""
        return Choice(engine, engine, note)
    banded = BandedEngine(problem)
    if solver == "auto" and problem.layout.node_count <= GTSAM_NODES:
        return Choice(banded, GtsamEngine(problem))
    return Choice(banded, banded)


def not_banded(problem: Problem) -> str:
    """Why the banded solver does not take a problem; empty where it does."""
    shape = shape_of(problem)
    if shape.border > MOST_SHARED:
        return f"{shape.border} unknowns are shared by all nodes, more than {MOST_SHARED}"
    if shape.size > MOST_ENTRIES:
        return (
            f"a measurement spans {shape.reach // problem.layout.node_width} nodes, which would "
            f"take {8e-9 * shape.size:.1f} GB"
        )
    return ""
