"""What the measurements of a mission leave open: rank, dilution over time, mirror images."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.assembly import UNOBSERVED_SHARE
from ubl_graph.builder import SegmentModel
from ubl_graph.errors import SolverError
from ubl_graph.factors.ranges import RangeBlock
from ubl_graph.graph import build_problem, model_segment
from ubl_graph.mission import Mission
from ubl_graph.nodes import NOMINAL_SPEED
from ubl_graph.observability.dilution import Dops, graph_dops
from ubl_graph.observability.directions import Rank, rank, reduced
from ubl_graph.pose_trajectory import PoseTrajectory
from ubl_graph.problem import Problem
from ubl_graph.result import Result, SegmentResult
from ubl_graph.smoother import smooth
from ubl_graph.solve.choice import choose
from ubl_graph.solve.rounds import solve
from ubl_graph.track import Track, mirror_images, place, track_of, unanchored
from ubl_graph.work import AMBIGUOUS_COST

#: A second track nearer than so many metres is no second track.
LEAST_SEPARATION = 1.0


@dataclass(frozen=True, eq=False)
class Mirror:
    """A second track beside the estimate that the ranges may not tell from it.

    Attributes
    ----------
    image : array, shape (N, 3)
        The track mirrored, at its nodes, m: in the vertical plane along the course through a
        single beacon, or along a line of several. With odometry, which knows the heading, it is
        the track moved to the plane's other side.
    separation : float
        rms distance of the image from the track, m.
    range_sigmas : float
        rms of the ranges' differences between image and track, in standard deviations.
    cost : float
        How much worse the best track near the image fits than the estimate, all measurements and
        priors counted; inf where a solver that begins at the image comes back to the estimate.
    """

    image: FloatArray
    separation: float
    range_sigmas: float
    cost: float

    @property
    def ambiguous(self) -> bool:
        """Whether nothing tells the two apart: odds below 20 to 1."""
        return self.cost < AMBIGUOUS_COST


@dataclass(frozen=True, eq=False)
class Observability:
    """What the measurements of a segment tell of its track.

    Attributes
    ----------
    measured : Rank
        By the measurements and the motion prior alone: of the state of the segment's middle node
        and of all that nodes share. Singular values are how many standard deviations a change as
        large as the geometry makes: of a range's length, of the vehicle's speed, of a radian.
        Below 2 it goes unnoticed, and does not count.
    informed : Rank
        The same with the priors: start, sound speed, clock, DVL errors, beacons.
    dops : Dops
        Of the graph at its nodes, horizontal.
    t : array, shape (N,)
        Times of the nodes, s.
    mirror : Mirror or None
        None where the track lies in the plane that it would be mirrored in.
    """

    measured: Rank
    informed: Rank
    dops: Dops
    t: FloatArray
    mirror: Mirror | None

    @property
    def summary(self) -> str:
        """The whole in a few plain lines."""
        lines = [
            _sentence("the measurements", self.measured),
            _sentence("measurements and priors", self.informed),
            f"PDOP (horizontal): median {np.median(self.dops.position):.2f}, "
            f"largest {np.max(self.dops.position):.2f} m per metre of range",
        ]
        if self.mirror is not None:
            said = "no second track" if np.isinf(self.mirror.cost) else "it is told apart"
            said = "nothing tells it apart" if self.mirror.ambiguous else said
            extra = f", extra cost {self.mirror.cost:.2g}" if np.isfinite(self.mirror.cost) else ""
            lines.append(
                f"mirror image {self.mirror.separation:.0f} m away, ranges "
                f"{self.mirror.range_sigmas:.2g} sigma apart (rms){extra}: {said}"
            )
        return "\n".join(lines)


def _sentence(who: str, found: Rank) -> str:
    of = f"{who} tell {found.rank} of {len(found.singular_values)} unknowns"
    return of + (f"; open: {', '.join(found.unobserved)}" if found.unobserved else "")


def observability(mission: Mission, result: Result | None = None) -> dict[str, Observability]:
    """What the measurements of a mission tell, segment by segment, each for itself.

    The equations are linearised at the smoothed track. All nodes but the middle one are eliminated
    by orthogonal transformations, so that what is left says what the measurements, before and
    after, tell of one state and of the shared unknowns. This takes time in proportion to the number
    of nodes, some 0.1 ms each, twice; smoothing takes several times as long.

    Parameters
    ----------
    mission : Mission
        What was, or is to be, smoothed.
    result : Result, optional
        What `smooth(mission)` gave; left out, it is called.

    Returns
    -------
    dict of str to Observability
        By segment name. Segments without ranges are left out.
    """
    result = smooth(mission) if result is None else result
    # What was left to the data ("auto") has been chosen there.
    mission = result.mission
    return {
        solved.name: _observability(mission, result, solved, model)
        for solved, model in zip(result.segments, _models(result), strict=True)
        if solved.residuals is not None
    }


def _models(result: Result) -> list[SegmentModel]:
    """Models whose nodes are those of the result: a start prior may have been left out there."""
    models: list[SegmentModel] = []
    for segment, solved in zip(result.mission.segments, result.segments, strict=True):
        model = model_segment(segment, result.mission.options)
        if not np.array_equal(model.t, solved.trajectory.t):
            model = model_segment(replace(segment, start=None), result.mission.options)
        models.append(model)
    return models


def _observability(
    mission: Mission, result: Result, solved: SegmentResult, model: SegmentModel
) -> Observability:
    problem = build_problem(mission, [model])
    x = _vector(problem, result, solved)
    assert solved.residuals is not None
    heard = np.unique(solved.residuals.beacon)
    beacons = np.stack([result.beacons[str(name)].value for name in heard])
    measured = tuple(b for b in problem.blocks if not b.name.endswith(" prior"))
    turned = unanchored(model) is not None
    # A heading that the reference may misread by anything holds no track; priors on it may.
    unheld = turned or (
        len(heard) == 1
        and problem.layout.has("heading_bias")
        and "position" not in model.segment.records()
    )
    return Observability(
        _turned(_rank(replace(problem, blocks=measured), x, beacons), unheld),
        _turned(_rank(problem, x, beacons), turned),
        graph_dops(mission, solved),
        solved.trajectory.t,
        _mirror(mission, model, problem, x, beacons),
    )


def _vector(problem: Problem, result: Result, solved: SegmentResult) -> FloatArray:
    """The flat vector of what was estimated."""
    layout = problem.layout
    x = np.zeros(layout.size)
    trajectory = solved.trajectory
    if isinstance(trajectory, PoseTrajectory):
        still = np.zeros(len(trajectory.t))
        states = (trajectory.position, trajectory.velocity, np.zeros_like(trajectory.position))
        track = Track(*states, still, still, 0.0, trajectory.rotation)
        place(layout, layout.chains[0], track, x)
        if not layout.still:
            layout.put(x, "rate", trajectory.rate[:, -dict(layout.kinematic)["rate"] :])
    else:
        for name, _ in layout.kinematic:
            layout.put(x, name, getattr(trajectory, name))
    for name, _ in layout.slow:
        layout.put(x, name, solved.slow[name].value)
    for name, _ in layout.shared:
        beacon = name.removeprefix("beacon ")
        known = result.beacons[beacon] if beacon != name else result.shared[name]
        layout.put(x, name, known.value)
    return x


def _rank(problem: Problem, x: FloatArray, beacons: FloatArray) -> Rank:
    """Rank of what a problem's rows tell of the middle node and the shared unknowns."""
    layout = problem.layout
    middle = layout.node_count // 2
    node = np.arange(layout.node_count)
    # From both ends towards the middle: a node is then determined by its neighbour, given that.
    turn = np.where(node < middle, node, middle + layout.node_count - 1 - node)
    turn[middle] = -1
    turn = np.repeat(turn, layout.node_width)
    turn = np.append(turn, np.full(layout.size - len(turn), -1))
    _, jacobian = problem.linearize(x, problem.frozen(x))
    names = [name for name, _ in layout.kinematic + layout.slow]
    states = {n: layout.node_columns(n, np.array([middle]))[0] for n in names}
    states |= {n: layout.shared_columns(n) for n, _ in layout.shared}
    kept = np.flatnonzero(turn < 0)
    sizes = _sizes(problem, x, beacons)
    scale = np.empty(layout.size)
    for name, columns in states.items():
        scale[columns] = sizes[name.split()[0]] / layout.unit(name)
    columns = {name: np.searchsorted(kept, c).tolist() for name, c in states.items()}
    return rank(reduced(jacobian, turn), columns, scale=scale[kept], least=1.0 / UNOBSERVED_SHARE)


def _turned(found: Rank, open_: bool) -> Rank:
    """The rank without the turn of the whole track about a lone beacon, where that is open.

    The residuals of motion prior and odometry turn with the track, so that their rows, linearised
    where they are not zero, seem to hold it.
    """
    if not open_ or found.unobserved:
        return found
    return replace(found, rank=found.rank - 1, unobserved=("the turn about the beacon",))


def _sizes(problem: Problem, x: FloatArray, beacons: FloatArray) -> dict[str, float]:
    """Changes as large as the geometry, SI, by the first word of a state's name."""
    layout = problem.layout
    length = float(np.median(np.linalg.norm(layout.positions(x)[:, None] - beacons, axis=2)))
    span = max(float(layout.chains[0].t[-1] - layout.chains[0].t[0]), 1.0)
    speed = length / span
    if layout.has("velocity"):
        velocity = layout.get(x, "velocity")
        speed = max(float(np.sqrt(np.mean(np.sum(velocity**2, axis=1)))), speed)
    flight = length / NOMINAL_SPEED
    return {
        "position": length,
        "beacon": length,
        "velocity": speed,
        "current": speed,
        "dvl_bias": speed,
        "acceleration": speed**2 / length,
        "clock_offset": flight,
        "clock_drift": flight / span,
        "sound_speed": 1.0,
        "dvl_scale": 1.0,
        "dvl_misalignment": 1.0,
        "heading_bias": 1.0,
        "rotation": 1.0,
        "rate": speed / length,
        "gyro_bias": 1.0 / span,
        "odometry_scale": 1.0,
        "odometry_turn_bias": 1.0 / span,
    }


def mirror_image(track: FloatArray, beacons: FloatArray, *, odometry: bool = False) -> FloatArray:
    """The track on the other side of the beacons.

    Without odometry it is reflected in the vertical plane along its course through a single beacon
    (whose ranges stay as they are), or in the one that fits several beacons best (whose ranges stay
    where they stand on a line). Odometry knows how the vehicle moved: there the track is shifted
    across its course, and the ranges stay as they are where it is straight.

    Parameters
    ----------
    track : array, shape (N, 3)
        East, north, up, m.
    beacons : array, shape (B, 3)
        m.
    odometry : bool
        Whether the vehicle's displacements are measured with their heading.

    Returns
    -------
    array, shape (N, 3)
    """
    point, normal = _plane(track, beacons, odometry)
    aside = (track[:, :2] - point) @ normal
    if odometry:
        aside = np.full(len(track), aside.mean())
    image = track.copy()
    image[:, :2] -= 2.0 * aside[:, None] * normal
    return image


def _plane(track: FloatArray, beacons: FloatArray, odometry: bool) -> tuple[FloatArray, FloatArray]:
    """A point of the mirror's vertical plane, and the unit normal; east and north."""
    point = beacons[:, :2].mean(axis=0)
    along = beacons[:, :2] - point
    if odometry or np.abs(along).max() < LEAST_SEPARATION:
        along = track[:, :2] - track[:, :2].mean(axis=0)
    return point, np.linalg.svd(along)[2][-1]


def _mirror(
    mission: Mission, model: SegmentModel, problem: Problem, x: FloatArray, beacons: FloatArray
) -> Mirror | None:
    """The image that fits best, of those that there are."""
    layout, chain = problem.layout, problem.layout.chains[0]
    frozen = problem.frozen(x)
    cost = problem.cost(x, frozen)
    found: list[Mirror] = []
    for image in _images(mission, model, track_of(layout, chain, x), beacons):
        begin = x.copy()
        place(layout, chain, image, begin)
        apart = _rms(image.position - layout.positions(x))
        if apart < LEAST_SEPARATION:
            continue
        told = [
            [block.evaluate(at, held, jacobian=False)[0] for at in (begin, x)]
            for block, held in zip(problem.blocks, frozen, strict=True)
            if isinstance(block, RangeBlock)
        ]
        sigmas = _rms(np.concatenate([there - here for there, here in told]))
        extra = _extra_cost(problem, begin, x, cost, 0.5 * apart, mission.options.max_iterations)
        found.append(Mirror(image.position, apart, sigmas, extra))
    return min(found, key=lambda m: m.cost, default=None)


def _images(
    mission: Mission, model: SegmentModel, track: Track, beacons: FloatArray
) -> list[Track]:
    """Tracks that may fit as well as this one."""
    images = mirror_images(mission, model, track)
    if images:
        return images
    odometry = model.still or model.bottom is not None or model.water is not None
    image = replace(track, position=mirror_image(track.position, beacons, odometry=odometry))
    if odometry:
        return [image]
    _, normal = _plane(track.position, beacons, odometry)
    flip = np.eye(3)
    flip[:2, :2] -= 2.0 * np.outer(normal, normal)
    return [replace(image, velocity=track.velocity @ flip, acceleration=track.acceleration @ flip)]


def _extra_cost(
    problem: Problem, begin: FloatArray, x: FloatArray, cost: float, apart: float, most: int
) -> float:
    """What the minimum costs more that a solver finds from `begin`; inf if it is that of `x`."""
    try:
        end = solve(choose(problem, "banded").scout, begin, most)
    except SolverError:
        return float("inf")
    layout = problem.layout
    gap = _rms(layout.positions(end.x) - layout.positions(x))
    return max(end.cost - cost, 0.0) if gap > apart else float("inf")


def _rms(rows: FloatArray) -> float:
    """Root of the mean square length of some rows."""
    return float(np.sqrt(np.mean(np.sum(rows**2, axis=-1))))
