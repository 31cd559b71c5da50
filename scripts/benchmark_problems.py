"""The benchmark's problems, and our side of it: the banded solver and its covariances.

Three kinds of problem. The simple one has what every rival can take: constant-velocity nodes every
2 s, one two-way ping a node, straight rays at a constant speed. The one with poses is the same with
a heading. The full one is a mission as users have it: pings whose ends fall between nodes, a DVL
with its errors as states, a sound-speed state.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, replace

import numpy as np

from ubl_graph import Beacon, Mission, Options, Segment, SoundSpeedProfile, TwoWayRange
from ubl_graph.arrays import FloatArray
from ubl_graph.factors.ranges import RangeBlock
from ubl_graph.graph import build_problem, model_segment
from ubl_graph.options import Node
from ubl_graph.problem import Frozen, Problem
from ubl_graph.sim import DvlErrors, Sea, Truth, ahrs, dvl, two_way_pings
from ubl_graph.solve.banded import BandedEngine
from ubl_graph.solve.marginals import Marginals
from ubl_graph.solve.rounds import Descent, Solution

#: Levenberg-Marquardt iterations of every timed run.
ITERATIONS = 3
SEED = 1
#: Speed of sound of the simple problem, m/s.
SPEED = 1500.0
#: Between its nodes, s: a reply is in when the next ping goes out.
SPACING = 2.0
#: Standard deviation of a travel time, s.
SIGMA = 1e-4
#: Noise density of its motion prior, m^2/s^3: so large that no node can be spared.
PSD = 2e-2
#: Standard deviation of the starts' error in each axis, m.
START_ERROR = 1.0
BEACONS = tuple(
    Beacon(f"B{i}", [800.0 * np.cos(a), 800.0 * np.sin(a), -500.0])
    for i, a in enumerate(np.arange(3) * 2.0 * np.pi / 3.0)
)
#: Between the full problem's pings and between its DVL samples, s. Replies are under way for 0.7
#: to 1.6 s, so pings overlap.
PING_INTERVAL, DVL_INTERVAL = 1.0, 0.5
#: Seconds to a node that the thinning leaves at that rate.
FULL_SPACING = 1.5
FULL_UNKNOWNS = ("sound_speed", "dvl_scale", "dvl_misalignment", "dvl_bias", "heading_bias")


@dataclass(frozen=True, eq=False)
class Case:
    """A problem with its start.

    Attributes
    ----------
    mission : Mission
        What the problem was built from.
    problem : Problem
        What is solved.
    start : array
        Flat vector: true positions with an error of `START_ERROR`, all else zero.
    truth : array, shape (N, 3)
        True positions at the nodes, m.
    build_seconds : float
        Time that it took from the mission to the problem.
    """

    mission: Mission
    problem: Problem
    start: FloatArray
    truth: FloatArray
    build_seconds: float

    @property
    def nodes(self) -> int:
        """Number of nodes."""
        return self.problem.layout.node_count

    def positions(self, x: FloatArray) -> FloatArray:
        """Node positions in the flat vector `x`, (N, 3), m."""
        return self.problem.layout.get(x, "position")

    def rms(self, positions: FloatArray) -> float:
        """Root mean square distance of positions (N, 3) from the truth, m."""
        return float(np.sqrt(np.mean(np.sum((positions - self.truth) ** 2, axis=1))))


def circle(t: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Position (m) and velocity (m/s) on a wide circle at 1 m/s, at times (M,), (M, 3) each."""
    angle = t / 300.0
    east, north = np.sin(angle), np.cos(angle)
    position = np.stack([300.0 * east, 300.0 * north, np.full(t.shape, -10.0)], axis=-1)
    return position, np.stack([north, -east, np.zeros(t.shape)], axis=-1)


def simple(nodes: int, node: Node = "point") -> Case:
    """Problem of `nodes` nodes that every solver here can take."""
    rng = np.random.default_rng(SEED)
    t = SPACING * np.arange(nodes)
    places = circle(t)[0]
    which = np.arange(nodes - 1) % len(BEACONS)
    sites = np.array([b.position for b in BEACONS])[which]
    out = np.linalg.norm(places[:-1] - sites, axis=1)
    back = np.linalg.norm(places[1:] - sites, axis=1)
    travel = (out + back) / SPEED + SIGMA * rng.normal(size=nodes - 1)
    names = [BEACONS[i].name for i in which]
    segment = Segment("", TwoWayRange(names, t[:-1], t[1:], travel, SIGMA))
    options = Options(estimate_sound_speed=False, loss="none", acceleration_psd=PSD, node=node)
    profile = SoundSpeedProfile.constant(SPEED)
    case = _case(Mission((segment,), BEACONS, profile, options=options), rng)
    _require(case.nodes == nodes, f"{case.nodes} nodes instead of {nodes}")
    return case


def posed(nodes: int) -> Case:
    """The simple problem with poses in space: motion prior and pings, and no prior beside them."""
    case = simple(nodes, "pose3")
    blocks = tuple(b for b in case.problem.blocks if b.name in ("motion", "two_way_range"))
    layout, x = case.problem.layout, case.start.copy()
    velocity = circle(layout.chains[0].t)[1]
    yaw = np.arctan2(velocity[:, 1], velocity[:, 0])
    layout.put(x, "rotation", yaw[:, None] * [0.0, 0.0, 1.0])
    layout.put(x, "velocity", np.tile([1.0, 0.0, 0.0], (nodes, 1)))
    return replace(case, problem=replace(case.problem, blocks=blocks), start=x)


def full(nodes: int) -> Case:
    """Problem of some `nodes` nodes as users have it: default options, straight rays."""
    rng = np.random.default_rng(SEED)
    end = FULL_SPACING * nodes
    truth = Truth((-10.0, end + 20.0), circle)
    profile = SoundSpeedProfile([0.0, 100.0, 300.0, 600.0], [1520.0, 1505.0, 1490.0, 1488.0])
    errors = DvlErrors(1e-3, (3e-3, -2e-3, 4e-3), (1e-3, -1e-3, 5e-4))
    samples = np.arange(0.0, end + 5.0, DVL_INTERVAL)
    sea = Sea(profile, log_scale=5e-4)
    segment = Segment(
        two_way_range=two_way_pings(truth, BEACONS, np.arange(0.0, end, PING_INTERVAL), sea, rng),
        velocity=dvl(truth, samples, rng, errors=errors),
        attitude=ahrs(truth, samples),
    )
    case = _case(Mission((segment,), BEACONS, profile, options=Options(rays="straight")), rng)
    _require(abs(case.nodes - nodes) <= max(3, nodes // 100), f"{case.nodes} nodes, not {nodes}")
    between = share_between_nodes(case.problem)
    _require(between > 0.5, f"only {between:.0%} of the legs lie between nodes")
    missing = [name for name in FULL_UNKNOWNS if not case.problem.layout.has(name)]
    _require(not missing, f"{', '.join(missing)} not among the unknowns")
    return case


def share_between_nodes(problem: Problem) -> float:
    """Share of the pings' legs whose position is made of more than one node."""
    blocks = [b for b in problem.blocks if isinstance(b, RangeBlock)]
    # At a node a leg touches the three columns of its position and no other.
    used = [
        (b.antenna.columns.reshape(len(b) * b.antenna.legs, -1) >= 0).sum(axis=1) for b in blocks
    ]
    return float(np.mean(np.concatenate(used) > 3))


def _case(mission: Mission, rng: np.random.Generator) -> Case:
    begin = time.perf_counter()
    problem = build_problem(mission, [model_segment(s, mission.options) for s in mission.segments])
    seconds = time.perf_counter() - begin
    truth = circle(problem.layout.chains[0].t)[0]
    x = np.zeros(problem.layout.size)
    problem.layout.put(x, "position", truth + START_ERROR * rng.normal(size=truth.shape))
    return Case(mission, problem, x, truth, seconds)


def _require(holds: bool, otherwise: str) -> None:
    if not holds:
        raise RuntimeError(f"the benchmark's problem is not what it should be: {otherwise}")


def banded(case: Case) -> tuple[Descent, Frozen]:
    """Some iterations of the banded solver, from the problem on."""
    frozen = case.problem.frozen(case.start)
    descent = BandedEngine(case.problem).begin(case.start, frozen)
    for _ in range(ITERATIONS):
        descent.iterate()
    return descent, frozen


def banded_solution(case: Case) -> Solution:
    """The same as a solution; the solver's memory is free by then."""
    descent, frozen = banded(case)
    return Solution(descent.vector(), frozen, descent.cost, ITERATIONS, "")


def covariances(case: Case, solution: Solution) -> FloatArray:
    """Joint covariance of position and velocity of every node, (N, 6, 6), SI."""
    return Marginals(case.problem, solution).joint(["position", "velocity"])


def scaling_row(nodes: int, repeats: int) -> dict[str, float | None]:
    """Time our solver and its covariances on the simple problem, and the process's peak memory.

    Parameters
    ----------
    nodes : int
        Size of the problem.
    repeats : int
        Timed runs, after one that is not; medians are taken.

    Returns
    -------
    dict
        `nodes`; `build_seconds` from mission to problem, once; `solve_seconds` and
        `covariance_seconds`; `seconds` of both together; `peak_mb` of the whole process, 1e6 bytes.
    """
    case = simple(nodes)
    solve, covariance = [], []
    for _ in range(repeats + 1):
        begin = time.perf_counter()
        solution = banded_solution(case)
        middle = time.perf_counter()
        covariances(case, solution)
        solve.append(middle - begin)
        covariance.append(time.perf_counter() - middle)
    both = np.add(solve, covariance)[1:]
    return {
        "nodes": nodes,
        "seconds": float(np.median(both)),
        "solve_seconds": float(np.median(solve[1:])),
        "covariance_seconds": float(np.median(covariance[1:])),
        "build_seconds": case.build_seconds,
        "peak_mb": peak_memory(),
    }


def peak_memory() -> float | None:
    """Largest resident memory that this process ever had, MB (1e6 bytes); None on Windows."""
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak * (1e-6 if sys.platform == "darwin" else 1024e-6)
