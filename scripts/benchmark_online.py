"""The online estimator against GTSAM's fixed-lag smoother: how long one ping takes.

A vehicle without a DVL swims in a circle and pings four beacons in turn, once a second: one ping a
node. It goes out at a node and its reply comes in before the next one. Sound speed is constant and
no state; there is no depth, so that pings are all that comes in. Options are the defaults but for
the grid (1 s), the window, the sound speed and the first velocity's sigma.

All contestants get the same pings:

- `lm`, `isam2`: `FixedLagEstimator.add`, which judges the ping and solves the window again.
- `isam2_plain_custom`: GTSAM's IncrementalFixedLagSmoother as one would use it from Python to get
  that answer. Each ping is a bare CustomFactor whose callback is that of our own view on the
  residual, made off the clock; motion is GTSAM's own WNOA factor. Its parameters are those of our
  engine `isam2`: variables are linearised anew where they have moved by a tenth of a millimetre,
  `update` is called until the newest position rests, `findUnusedFactorSlots`, without which the
  smoother grows for ever. Cholesky instead of QR favours it. It gates nothing.
- `plain_one_update`: the same at GTSAM's default threshold (a decimetre), with one `update` a ping:
  a centimetre from the minimum, and much cheaper.
"""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol
from unittest import mock

import gtsam
import numpy as np
from benchmark_problems import SEED, SIGMA, SPEED, circle
from benchmark_rivals import Pair, farthest

from ubl_graph import Beacon, FixedLagEstimator, Options, SoundSpeedProfile, TwoWayRange
from ubl_graph.arrays import FloatArray
from ubl_graph.attitude import AttitudeTrack
from ubl_graph.builder import Builder
from ubl_graph.factors.loss import RobustLoss
from ubl_graph.gtsam_view import GraphView
from ubl_graph.layout import Chain, Layout
from ubl_graph.mission import Setup, Start, Vehicle
from ubl_graph.online.isam2 import MOST_UPDATES, RELINEARIZE, SETTLED
from ubl_graph.options import OnlineEngine
from ubl_graph.problem import Problem

#: Within reach of the whole circle in less than a second there and back, and in no plane.
BEACONS = tuple(
    Beacon(f"B{i}", [350.0 * math.cos(a), 350.0 * math.sin(a), up])
    for i, (a, up) in enumerate(
        zip(0.5 * np.pi * np.arange(4), (-100.0, -160.0, -220.0, -280.0), strict=True)
    )
)
#: Standard deviation of the start prior, m.
START_SIGMA = 1.0
#: Of the first velocity, m/s: wider ones GTSAM's Cholesky takes for none.
SPEED_SIGMA = 10.0
#: The contestants that the file lists, and the one that is compared only.
LISTED = ("lm", "isam2", "isam2_plain_custom")
ONE_UPDATE = "plain_one_update"
#: The estimator's window holds so many nodes more than its lag has seconds.
MORE_NODES = 4
#: It may have so many more or less than it was asked for.
NEAR = 2
#: Turns in which the updates of all contestants are run: what else the machine does hits all alike.
TURNS = 50
#: GTSAM's default movement at which a variable is linearised anew, m.
DEFAULT_THRESHOLD = 0.1
#: Farthest that newest positions of two contestants may be apart, m: two engines of ours, the plain
#: smoother, and the one of one update once it is left to settle at GTSAM's default.
TOLERANCE = {"isam2": 5e-3, "isam2_plain_custom": 5e-3, ONE_UPDATE: 0.05}


@dataclass(frozen=True)
class Contest:
    """What is timed at one size.

    Attributes
    ----------
    updates : dict of str to int
        Timed updates of each contestant; `lm` has the most.
    rest : int
        Updates between the window's being full and the first timed one. The searches of the
        beginning are over when it is full.
    """

    updates: Mapping[str, int]
    rest: int


@dataclass(frozen=True, eq=False)
class Timed:
    """Times (s) of a contestant's updates, and the newest positions (m) after them, (N, 3)."""

    seconds: FloatArray
    positions: FloatArray

    @property
    def leaf(self) -> dict[str, float | int]:
        """Median, 99th percentile and maximum, ms, and their number, ready for JSON."""
        ms = 1e3 * self.seconds
        return {
            "p50_ms": float(np.median(ms)),
            "p99_ms": float(np.percentile(ms, 99)),
            "max_ms": float(ms.max()),
            "updates": len(ms),
        }


def pings(count: int) -> TwoWayRange:
    """Pings of the circling vehicle, one a second, to one beacon after the other."""
    rng = np.random.default_rng(SEED)
    sent = np.arange(count, dtype=np.float64)
    which = np.arange(count) % len(BEACONS)
    sites = np.array([b.position for b in BEACONS])[which]
    out = np.linalg.norm(circle(sent)[0] - sites, axis=1)
    heard = sent + 2.0 * out / SPEED
    for _ in range(5):  # the vehicle makes 1 m/s: each round leaves a 1500th of the error
        heard = sent + (out + np.linalg.norm(circle(heard)[0] - sites, axis=1)) / SPEED
    travel = heard - sent + SIGMA * rng.normal(size=count)
    return TwoWayRange([BEACONS[i].name for i in which], sent, heard, travel, SIGMA)


def setup_of(nodes: int, engine: OnlineEngine = "lm") -> Setup:
    """What an estimator with a window of so many nodes is told."""
    options = Options(
        lag=float(nodes - MORE_NODES),
        node_spacing=1.0,
        engine=engine,
        estimate_sound_speed=False,
        speed_sigma=SPEED_SIGMA,
    )
    east, north, up = (float(x) for x in circle(np.zeros(1))[0][0])
    start = Start(0.0, east, north, up, START_SIGMA)
    return Setup(BEACONS, SoundSpeedProfile.constant(SPEED), Vehicle(), options, start)


class Contestant(Protocol):
    """Who takes pings in."""

    def prepare(self, k: int, ping: TwoWayRange) -> Any:
        """What the update with ping number `k` takes: made off the clock."""
        ...

    def update(self, prepared: Any) -> None:
        """Take a ping in; timed."""
        ...

    def newest(self) -> FloatArray:
        """Position of the newest node, m."""
        ...

    def check(self) -> None:
        """Make sure that the window is as long as it should be, and that the track is sound.

        Raises
        ------
        RuntimeError
            Where it is not.
        """
        ...


class Ours:
    """`FixedLagEstimator` with one of its engines."""

    def __init__(self, nodes: int, engine: OnlineEngine) -> None:
        self._nodes = nodes
        self.estimator = FixedLagEstimator.of(setup_of(nodes, engine))

    def prepare(self, k: int, ping: TwoWayRange) -> TwoWayRange:  # noqa: ARG002 - the protocol
        """The ping as it is."""
        return ping

    def update(self, prepared: TwoWayRange) -> None:
        """Add the ping."""
        self.estimator.add(prepared)

    def newest(self) -> FloatArray:
        """Position of the newest node, m."""
        window = self.estimator.core.tracker.window
        assert window is not None
        return window.x[-1, :3].copy()

    def check(self) -> None:
        """Window and status."""
        health = self.estimator.health()
        _check_nodes(health["window"]["nodes"], self._nodes)
        _require(health["status"] == "ok", f"the status is {health['status']}")
        rejected = health["sensors"]["two_way_range"]["rejected"]
        _require(not rejected, f"there are pings that were rejected: {rejected}")


class Plain:
    """GTSAM's incremental fixed-lag smoother with bare custom factors.

    Parameters
    ----------
    nodes : int
        In the window.
    relinearize : float
        Movement at which a variable is linearised anew, m.
    settles : bool
        Whether `update` is called until the newest position rests.
    """

    def __init__(self, nodes: int, relinearize: float, settles: bool) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(relinearize)
        parameters.relinearizeSkip = 1
        parameters.findUnusedFactorSlots = True
        self._nodes, self._settles = nodes, settles
        self._smoother = gtsam.IncrementalFixedLagSmoother(nodes - 0.5, parameters)
        self._setup = setup_of(nodes)
        options = self._setup.options
        self._psd = (options.horizontal_psd, options.vertical_psd)
        self._loss = RobustLoss(options.loss)
        (self._position,), (self._velocity,) = circle(np.zeros(1))
        self._newest = 0

    def prepare(self, k: int, ping: TwoWayRange) -> gtsam.CustomFactor:
        """The ping's factor on nodes `k` and `k + 1`, as our own view makes it, but bare."""
        layout = Layout((Chain("", 0, np.array([k, k + 1.0])),), 2)
        builder = Builder(self._setup, layout)
        block = builder.range_block(layout.chains[0], ping, AttitudeTrack(None))
        problem = Problem(layout, (block,), self._loss, self._psd)
        ahead = self._position + self._velocity
        x = np.concatenate([self._position, self._velocity, ahead, self._velocity])
        with mock.patch("ubl_graph.gtsam_view.wrapped", lambda factor, _: factor):
            return GraphView(problem, k).graph(problem.frozen(x)).at(0)

    def update(self, prepared: gtsam.CustomFactor) -> None:
        """Add a node, motion and ping, and read the newest state."""
        k = self._newest
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        stamps: dict[int, float] = {}
        if k == 0:
            self._begin(graph)
            self._insert(0, values, stamps)
        ends = [gtsam.StateData(*_keys(i), float(i)) for i in (k, k + 1)]
        horizontal, vertical = self._psd
        psd = np.array([horizontal, horizontal, vertical])
        graph.add(gtsam.WnoaMotionFactorPoint3(*ends, psd))
        graph.add(prepared)
        self._position = self._position + self._velocity
        self._newest = k + 1
        self._insert(k + 1, values, stamps)
        self._smoother.update(graph, values, stamps)
        self._read()
        if self._settles:
            self.settle()

    def _begin(self, graph: gtsam.NonlinearFactorGraph) -> None:
        """The same priors on the first node as ours."""
        position, velocity = _keys(0)
        place = gtsam.noiseModel.Isotropic.Sigma(3, START_SIGMA)
        speed = gtsam.noiseModel.Isotropic.Sigma(3, SPEED_SIGMA)
        graph.add(gtsam.PriorFactorPoint3(position, self._position, place))
        graph.add(gtsam.PriorFactorPoint3(velocity, np.zeros(3), speed))

    def _insert(self, k: int, values: gtsam.Values, stamps: dict[int, float]) -> None:
        for key, value in zip(_keys(k), (self._position, self._velocity), strict=True):
            values.insert(key, value)
            stamps[key] = float(k)

    def _read(self) -> None:
        position, velocity = _keys(self._newest)
        self._position = self._smoother.calculateEstimatePoint3(position)
        self._velocity = self._smoother.calculateEstimatePoint3(velocity)

    def settle(self) -> None:
        """Call `update` until the newest position rests."""
        for _ in range(MOST_UPDATES):
            before = self._position
            self._smoother.update()
            self._read()
            if np.abs(self._position - before).max() < SETTLED:
                break

    def newest(self) -> FloatArray:
        """Position of the newest node, m."""
        return np.array(self._position)

    def check(self) -> None:
        """Window."""
        _check_nodes(self._smoother.calculateEstimate().size() // 2, self._nodes)


def _keys(k: int) -> tuple[int, int]:
    return gtsam.symbol("x", k), gtsam.symbol("v", k)


def _check_nodes(found: int, wanted: int) -> None:
    _require(abs(found - wanted) <= NEAR, f"the window has {found} nodes, not {wanted}")


def _require(holds: bool, otherwise: str) -> None:
    if not holds:
        raise RuntimeError(f"the online benchmark is not what it should be: {otherwise}")


class Runner:
    """A contestant on its way through the stream."""

    def __init__(self, contestant: Contestant, stream: TwoWayRange) -> None:
        self.contestant = contestant
        self._stream, self._next = stream, 0
        self._seconds: list[float] = []
        self._positions: list[FloatArray] = []

    def run(self, count: int) -> None:
        """Take so many pings in; times and newest positions are kept."""
        for k in range(self._next, self._next + count):
            prepared = self.contestant.prepare(k, self._stream[k])
            begin = time.perf_counter()
            self.contestant.update(prepared)
            self._seconds.append(time.perf_counter() - begin)
            self._positions.append(self.contestant.newest())
        self._next += count

    def warm_up(self, count: int) -> None:
        """Take so many pings in and forget how long that took."""
        self.run(count)
        self._seconds.clear()
        self._positions.clear()
        self.contestant.check()

    @property
    def timed(self) -> Timed:
        """What was kept."""
        return Timed(np.array(self._seconds), np.array(self._positions))


def contestants(nodes: int) -> dict[str, Contestant]:
    """All of them, with a window of so many nodes."""
    return {
        "lm": Ours(nodes, "lm"),
        "isam2": Ours(nodes, "isam2"),
        "isam2_plain_custom": Plain(nodes, RELINEARIZE, settles=True),
        ONE_UPDATE: Plain(nodes, DEFAULT_THRESHOLD, settles=False),
    }


def compete(nodes: int, contest: Contest) -> tuple[dict[str, Timed], list[Pair]]:
    """Run all contestants in turns.

    Parameters
    ----------
    nodes : int
        In the window.
    contest : Contest
        How often.

    Returns
    -------
    dict of str to Timed
        By contestant.
    list of Pair
        99th percentiles of `lm` and of each other one, and its median and the plain one's. The
        difference is the largest one between newest positions after the same ping; of the smoother
        that is not iterated, the one after the last ping and further updates, which are not timed.
    """
    warm = nodes + contest.rest
    stream = pings(warm + max(contest.updates.values()))
    runners = {name: Runner(c, stream) for name, c in contestants(nodes).items()}
    for runner in runners.values():
        runner.warm_up(warm)
    with _old_objects_apart():
        for turn in range(TURNS):
            for name, runner in runners.items():
                done, due = (contest.updates[name] * k // TURNS for k in (turn, turn + 1))
                runner.run(due - done)
    for runner in runners.values():
        runner.contestant.check()
    timed = {name: runner.timed for name, runner in runners.items()}
    plain = runners[ONE_UPDATE].contestant
    assert isinstance(plain, Plain)
    plain.settle()
    rested = plain.newest()[None]
    return timed, [
        _pair("online_vs_plain_custom", nodes, timed, "isam2_plain_custom"),
        _medians("online_median_vs_plain_custom", nodes, timed, "isam2_plain_custom"),
        _pair("online_vs_plain_one_update", nodes, timed, ONE_UPDATE, rested),
        _pair("online_lm_vs_isam2", nodes, timed, "isam2"),
    ]


def _pair(
    name: str, nodes: int, timed: Mapping[str, Timed], other: str, at_end: FloatArray | None = None
) -> Pair:
    ours, theirs = timed["lm"], timed[other]
    count = len(theirs.seconds)
    positions = theirs.positions if at_end is None else at_end
    apart = farthest(ours.positions[count - len(positions) : count], positions)
    p99 = [float(np.percentile(one.seconds, 99)) for one in (ours, theirs)]
    return Pair(name, nodes, *p99, difference=apart, tolerance=TOLERANCE[other])


def _medians(name: str, nodes: int, timed: Mapping[str, Timed], other: str) -> Pair:
    """Medians of `lm` and of another one; whether they agree the 99th percentiles' pair says."""
    return Pair(name, nodes, *(float(np.median(timed[one].seconds)) for one in ("lm", other)))


@contextmanager
def _old_objects_apart() -> Generator[None]:
    """Spare the garbage collector what is there already: it is no garbage of the updates."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
