"""The cases of the Cao 2017 study: each is simulated, solved by the paper's methods and the graph.

A case is a frozen record; `run(case, seed)` is all of its work and gives named arrays, so that any
pool of processes can do it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.baselines import dead_reckoning
from ubl_graph.baselines.cao2017 import cao2017, converged_position
from ubl_graph.baselines.fixes import Fixes
from ubl_graph.mission import Mission, Reference, Segment
from ubl_graph.options import Options
from ubl_graph.sim import SeaTrial, cao_pass, cao_sea_trial
from ubl_graph.sim.cao2017 import PASS_OPTIONS
from ubl_graph.smoother import smooth


def fast(options: Options) -> Options:
    """The same answers to 3 digits in a quarter of the time, on straight tracks with a DVL.

    There a start is found in few long windows as well as in many short ones; one engine is enough.
    """
    return replace(options, start_window=1000.0, solver="banded")


#: The paper's errors of the velocity: forward, right, up, m/s.
ERRORS = {"forward": (0.005, 0.0, 0.0), "right": (0.0, 0.002, 0.0), "up": (0.0, 0.0, 0.002)}
#: Ends of the tracks, m east.
WEST, EAST = -3000.0, 3000.0
#: LM iterated to its end.
CONVERGED = {"max_iterations": 300, "tolerance": 1e-4}
FAST = fast(PASS_OPTIONS)

Found: TypeAlias = dict[str, FloatArray]


@dataclass(frozen=True)
class Windows:
    """How a window method is set.

    Attributes
    ----------
    pings : int
        In a window.
    interval : float
        Between pings, s.
    options : tuple of (str, value)
        Of `cao2017`.
    """

    pings: int = 10
    interval: float = 10.0
    options: tuple[tuple[str, Any], ...] = ()


@dataclass(frozen=True)
class WindowMap:
    """A2: window methods without noise, every window begun at the truth.

    Attributes
    ----------
    error : str
        Of `ERRORS`, or "none".
    north, east : tuple of float
        Nodes of the map, m.
    settings : tuple of (str, Windows)
        By name; all of one interval.
    """

    error: str
    north: tuple[float, ...]
    east: tuple[float, ...]
    settings: tuple[tuple[str, Windows], ...]

    def run(self, seed: int) -> Found:
        """Errors (N, E), m, by the settings' names."""
        (interval,) = {setting.interval for _, setting in self.settings}
        # A first window is complete where the map begins.
        lead = interval * (max(setting.pings for _, setting in self.settings) - 1)
        missions = [
            exact_pass(n, self.error, interval, WEST - lead, seed=seed)[0] for n in self.north
        ]
        mission = joined(missions)
        seeds = {s.name: reference_of(s) for s in mission.segments}
        out: Found = {}
        for name, setting in self.settings:
            fixes = cao2017(mission, window=setting.pings, seeds=seeds, **dict(setting.options))
            out[name] = errors_at(fixes, mission, self.east)
        return out


@dataclass(frozen=True)
class GraphTrack:
    """A2: one track of the same data through the graph, from an exact start."""

    error: str
    north: float
    east: tuple[float, ...]

    def run(self, seed: int) -> Found:
        """Causal errors (E,), m."""
        mission, _ = exact_pass(self.north, self.error, 10.0, WEST - 90.0, seed=seed)
        return {"graph": graph_errors(mission, self.east)}


@dataclass(frozen=True)
class Passes:
    """A3: passes with a constant error of the velocity, noise, and vague starts.

    Attributes
    ----------
    error : str
        Of `ERRORS`.
    start_sigma : float
        Of the start, m.
    range_sigma : float
        m, as stated.
    noise : float
        Multiplies both; 0 leaves none.
    tracks : tuple of (float, int)
        Where each is, m north, and its seed: what ties the methods to the same data.
    east : tuple of float
        Places along them, m.
    """

    error: str
    start_sigma: float
    range_sigma: float
    noise: float
    tracks: tuple[tuple[float, int], ...]
    east: tuple[float, ...]

    def missions(self) -> list[Mission]:
        """One a track."""
        return [
            cao_pass(
                seed,
                north=north,
                east=(WEST, max(self.east)),
                dvl_error=ERRORS[self.error],
                range_sigma=self.range_sigma,
                start_sigma=self.start_sigma,
                noise=self.noise,
                options=FAST,
            )[0]
            for north, seed in self.tracks
        ]


@dataclass(frozen=True)
class WindowPasses:
    """A3: the paper's LM and dead reckoning, begun at the starts.

    Windows follow one another: it takes little longer to do all passes in step than a single one.

    Attributes
    ----------
    parts : tuple of Passes
        All of the same places east.
    """

    parts: tuple[Passes, ...]

    def run(self, seed: int) -> Found:  # noqa: ARG002 - the tracks have their own
        """Errors (T, E), m, by method and number of the part."""
        east = self.parts[0].east
        mission = joined([m for part in self.parts for m in part.missions()])
        reckoned = dead_reckoning(mission)
        found = {
            "lm": errors_at(cao2017(mission), mission, east),
            "lm converged": errors_at(cao2017(mission, **CONVERGED), mission, east),
            "dead reckoning": np.stack(
                [
                    horizontal(reckoned[s.name].at(t).position, s, t)
                    for s in mission.segments
                    for t in [pings_at(s, east)[1]]
                ]
            ),
        }
        ends = np.cumsum([len(part.tracks) for part in self.parts])[:-1]
        return {
            f"{name}, {number}": errors
            for name, every in found.items()
            for number, errors in enumerate(np.split(every, ends))
        }


@dataclass(frozen=True)
class GraphPasses(Passes):
    """A3: the graph, causal, with the starts as priors."""

    def run(self, seed: int) -> Found:  # noqa: ARG002 - the tracks have their own
        """Errors (T, E), m."""
        return {"graph": np.stack([graph_errors(m, self.east) for m in self.missions()])}


@dataclass(frozen=True)
class Trial:
    """A4: one run of the sea-trial-like pass.

    Attributes
    ----------
    north : float
        Of the track from the beacon, m.
    calibration : float
        Standard deviation of the beacon's position, each axis, m.
    pings : int
        How many.
    stride : int
        Of the fixes every so many are compared, by all methods.
    """

    north: float
    calibration: float
    pings: int
    stride: int = 1

    def run(self, seed: int) -> Found:
        """Horizontal errors (M,), m, of fixes and tracks by method, and where they are."""
        mission, _ = cao_sea_trial(
            seed,
            north=self.north,
            pings=self.pings,
            trial=SeaTrial(calibration_sigma=self.calibration),
        )
        mission = replace(mission, options=fast(mission.options))
        (segment,) = mission.segments
        newton, marquardt = cao2017(mission, method="gauss_newton")[""], cao2017(mission)[""]
        first = len(segment.one_way_range) - len(marquardt)
        kept = np.arange(0, len(marquardt), self.stride)
        t = marquardt.t[kept]
        batch = smooth(mission).trajectory.at(t).position
        live = np.stack([newest(mission, first + int(k)) for k in kept])
        places = {
            "gauss-newton": newton.position[kept],
            "lm": marquardt.position[kept],
            "graph": live,
            "graph, whole track": batch,
        }
        found = {name: horizontal(place, segment, t) for name, place in places.items()}
        truth = np.stack(
            [np.interp(t, segment.reference.t, segment.reference.position[:, i]) for i in (0, 1)], 1
        )
        found |= {f"{name}, place": place[:, :2] for name, place in places.items()}
        return found | {"truth": truth, "t": t}


@dataclass(frozen=True)
class MirrorMap:
    """Windows begun on the wrong side, without any error, and on which side they end.

    The map is 24 tracks by 25 places, 250 m apart: 600 nodes.
    """

    def run(self, seed: int) -> Found:
        """How many nodes end within a metre of the mirror image, and of the truth."""
        nodes = tuple(np.arange(WEST, EAST + 1.0, 250.0).tolist())
        tracks = [exact_pass(n, "none", 10.0, WEST - 90.0, seed=seed)[0] for n in nodes if n != 0.0]
        mission = joined(tracks)
        seeds = {s.name: wrong_side(reference_of(s)) for s in mission.segments}
        mirrored = joined([replace(m, segments=(image(m.segments[0]),)) for m in tracks])
        out: Found = {}
        for name, options in {
            "lm": {},
            "lm converged": {"max_iterations": 300, "tolerance": 1e-6},
            "gauss-newton": {"method": "gauss_newton"},
        }.items():
            fixes = cao2017(mission, seeds=seeds, **options)
            for place, reference in (("mirror", mirrored), ("truth", mission)):
                near = errors_at(fixes, reference, nodes) < 1.0
                out[f"{name}, {place}"] = np.array(float(near.sum()))
            out["nodes"] = np.array(float(near.size))
        return out


@dataclass(frozen=True)
class Unanchored:
    """A pass without any start, through the graph, and whether its report calls it ambiguous."""

    north: float
    noise: float

    def run(self, seed: int) -> Found:
        """1 where the status is "unobservable" and the reason "ambiguous", else 0."""
        mission, _ = cao_pass(
            seed,
            north=self.north,
            dvl_error=(0.0, 0.0, 0.0),
            start_sigma=None,
            noise=self.noise,
        )
        result = smooth(mission)
        named = result.status == "unobservable" and result.reason.startswith("ambiguous")
        return {"ambiguous": np.array(float(named))}


Case: TypeAlias = (
    WindowMap | GraphTrack | WindowPasses | GraphPasses | Trial | MirrorMap | Unanchored
)


def run(case: Case, seed: int) -> Found:
    """All work of a case, for any pool of processes."""
    return case.run(seed)


def exact_pass(
    north: float, error: str, interval: float, west: float, *, seed: int
) -> tuple[Mission, Any]:
    """A pass without noise from an exact start."""
    return cao_pass(
        seed,
        north=north,
        east=(west, EAST),
        ping_interval=interval,
        dvl_error=ERRORS.get(error, (0.0, 0.0, 0.0)),
        start_sigma=0.0,
        noise=0.0,
        options=FAST,
    )


def joined(missions: Sequence[Mission]) -> Mission:
    """Passes as segments of one mission, for methods that take them one by one anyway."""
    segments = (replace(m.segments[0], name=f"track {i}") for i, m in enumerate(missions))
    return replace(missions[0], segments=tuple(segments))


def graph_errors(mission: Mission, east: Sequence[float]) -> FloatArray:
    """Errors (E,), m, at places along a pass, of the newest position given all pings so far."""
    (segment,) = mission.segments
    pings, t = pings_at(segment, east)
    return horizontal(np.stack([newest(mission, k) for k in pings.tolist()]), segment, t)


def newest(mission: Mission, ping: int) -> FloatArray:
    """Position (3,), m, at a ping, as `smooth` has it from nothing later than that."""
    (segment,) = mission.segments
    pings, velocity, depth = segment.one_way_range, segment.velocity, segment.depth
    assert pings is not None and velocity is not None and depth is not None
    now = pings.t_receive[ping]
    so_far = replace(
        segment,
        one_way_range=pings[pings.t_receive <= now],
        velocity=velocity[velocity.t <= now],
        depth=depth[depth.t <= now],
    )
    trajectory = smooth(replace(mission, segments=(so_far,))).trajectory
    # Stamps within a microsecond are one instant: the last node may stand that much earlier.
    return trajectory.at(min(now, trajectory.t[-1])).position[0]


def pings_at(segment: Segment, east: Sequence[float]) -> tuple[Any, FloatArray]:
    """Numbers of the pings heard nearest to places along a pass (E,), m, and when, s."""
    reference = reference_of(segment)
    assert segment.one_way_range is not None
    heard = segment.one_way_range.t_receive
    place = np.interp(heard, reference.t, reference.position[:, 0])
    pings = np.abs(place[None, :] - np.asarray(east)[:, None]).argmin(axis=1)
    return pings, heard[pings]


def errors_at(fixes: Mapping[str, Fixes], mission: Mission, east: Sequence[float]) -> FloatArray:
    """Errors (N, E), m, of each segment's fixes at places along it."""
    rows: list[FloatArray] = []
    for segment in mission.segments:
        mine = fixes[segment.name]
        assert segment.one_way_range is not None
        first = len(segment.one_way_range) - len(mine)
        rows.append(mine.errors(reference_of(segment))[pings_at(segment, east)[0] - first])
    return np.stack(rows)


def horizontal(position: FloatArray, segment: Segment, t: FloatArray) -> FloatArray:
    """Horizontal distances (M,), m, from a segment's reference."""
    solved = np.isfinite(position).all(axis=1)
    return Fixes(t, position, solved, np.zeros(len(t), dtype=np.int64)).errors(
        reference_of(segment)
    )


def closed_form_error(error: str, north: FloatArray, east: FloatArray) -> FloatArray:
    """Errors (N, E), m, of the converged window by its closed form."""
    north, east = np.broadcast_arrays(np.asarray(north)[:, None], np.asarray(east)[None, :])
    forward, right, up = ERRORS[error]
    place = converged_position(east, north, forward=forward, right=right, up=up)
    return np.hypot(place[..., 0] - east, place[..., 1] - north)


def reference_of(segment: Segment) -> Reference:
    """A simulated segment's truth."""
    assert segment.reference is not None
    return segment.reference


def wrong_side(truth: Reference) -> Reference:
    """Where the mirror experiment begins: on the other side, a tenth nearer, 20 m ahead."""
    return Reference(truth.t, truth.position * [1.0, -0.9, 1.0] + [20.0, 0.0, 0.0])


def image(segment: Segment) -> Segment:
    """The segment with its truth mirrored in the line through the beacon along the track."""
    truth = reference_of(segment)
    return replace(segment, reference=Reference(truth.t, truth.position * [1.0, -1.0, 1.0]))
