"""Simulated fleets for tests: vehicles of every kind, and what passes between them.

Places are asked for by name: of a vehicle by its own clock, of a target by the fleet's time. As in
`ubl_graph.sim`, `noise` multiplies the standard deviation that the records state.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ubl_graph import LeverArm, Options, Segment, SoundSpeedProfile, Start, Vehicle
from ubl_graph.beacon import Beacon
from ubl_graph.cooperative import Fleet, FleetResult, Member, Target
from ubl_graph.cooperative.model import FleetProblem, build_fleet, model_member
from ubl_graph.cooperative.peers import peer_pings
from ubl_graph.cooperative.starts import find_fleet_starts, with_clocks
from ubl_graph.cooperative.targets import target_starts
from ubl_graph.measurements import OneWayRange, SlantRange, TwoWayRange
from ubl_graph.sim import Clock, Truth, ahrs, dvl, fixes, odometer, pressure
from ubl_graph.track import start_vector

#: East, north, up (m) of something at one time (s).
Place = Callable[[float], np.ndarray]
#: Who measures, and who or what is at the other end.
Pair = tuple[str, str]
SPEED = 1500.0
PROFILE = SoundSpeedProfile.constant(SPEED)
#: Vehicles in the plane whose odometry has white noise alone; ranges without outliers.
CHAIN = Options(
    node="pose2",
    odometry_noise="growing",
    odometry_scale_sigma=0.0,
    odometry_turn_bias_sigma_deg=0.0,
    estimate_sound_speed=False,
    loss="none",
)
SPACE = replace(CHAIN, node="pose3")
#: Vehicles with DVL, attitude reference and depth; no prior that would pull an exact track.
POINT = Options(
    speed_sigma=1e5,
    dvl_scale_sigma=0.0,
    dvl_misalignment_sigma_deg=0.0,
    dvl_bias_sigma=0.0,
    heading_bias_sigma_deg=0.0,
    estimate_sound_speed=False,
    loss="none",
)


def arc(
    place: Sequence[float],
    course: float,
    span: tuple[float, float],
    *,
    speed: float = 1.5,
    turn: float = 0.0,
) -> Truth:
    """A constant twist in the plane, from `place` on; course clockwise from north, turn to it."""
    begin = np.asarray(place, dtype=np.float64)

    def motion(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        since = t - span[0]
        half = 0.5 * turn * since
        chord = speed * since * np.sinc(half / np.pi)
        ways = np.stack([np.sin(course + half), np.cos(course + half), 0.0 * t], axis=1)
        now = course + turn * since
        rates = speed * np.stack([np.sin(now), np.cos(now), 0.0 * t], axis=1)
        return begin + chord[:, None] * ways, rates

    return Truth(span, motion, lambda t: course + turn * (t - span[0]))


def at(truth: Truth) -> Place:
    """Where a vehicle is."""
    return lambda t: truth.position(t)[0]


def still(*place: float) -> Place:
    """Something at rest."""
    return moving(place, (0.0, 0.0, 0.0))


def moving(place: Sequence[float], velocity: Sequence[float]) -> Place:
    """Something in steady motion, at `place` at time zero."""
    return lambda t: np.asarray(place) + t * np.asarray(velocity)


def _flight(sent: np.ndarray, place: Place, when: float, scale: float) -> float:
    """Flight time of sound sent from a point at `when` to something that moves."""
    flight = 0.0
    for _ in range(30):
        before, flight = flight, float(np.linalg.norm(place(when + flight) - sent)) * scale / SPEED
        if abs(flight - before) < 1e-13:
            break
    return flight


@dataclass
class Sound:
    """What passes between vehicles, one list of rows a vehicle and kind."""

    places: Mapping[str, Place]
    rng: np.random.Generator
    noise: float = 1.0
    log_scale: float = 0.0
    clocks: Mapping[str, Clock] = field(default_factory=dict)
    rows: dict[tuple[str, str], list[tuple[object, ...]]] = field(default_factory=dict)

    def slant(self, pair: Pair, t: float, sigma: float = 1.0, extra: float = 0.0) -> None:
        """A distance at one instant, with something added to it."""
        here, there = (self.places[name](t) for name in pair)
        scale = float(np.exp(self.log_scale))
        distance = float(np.linalg.norm(here - there)) * scale
        read = distance + self.noise * sigma * float(self.rng.standard_normal()) + extra
        self._add("slant_range", pair, (t, pair[1], read, sigma))

    def two_way(self, pair: Pair, t: float, wait: float = 0.3, sigma: float = 1e-4) -> None:
        """A question at `t`, and the answer so long after it was heard."""
        here, there = (self.places[name] for name in pair)
        scale = float(np.exp(self.log_scale))
        out = _flight(here(t), there, t, scale)
        answered = t + out + wait
        back = _flight(there(answered), here, answered, scale)
        travel = out + back + self.noise * sigma * float(self.rng.standard_normal())
        self._add("two_way_range", pair, (pair[1], t, t + travel + wait, travel, sigma))

    def one_way(self, pair: Pair, stamped: float, sigma: float = 1e-4) -> None:
        """What the first one hears of the second one's broadcast, stamped by their own clocks."""
        hearer, sender = (self.places[name] for name in pair)
        heard_by, sent_by = (self.clocks.get(name, Clock()) for name in pair)
        scale = float(np.exp(self.log_scale))

        def read(t: float) -> float:
            """What the hearer's clock shows at a time of the fleet."""
            return (t + heard_by.offset) / (1.0 - heard_by.drift)

        sent = stamped - float(sent_by.at(np.array(stamped)))
        flight = _flight(sender(stamped), lambda t: hearer(read(t)), sent, scale)
        received = read(sent + flight) + self.noise * sigma * float(self.rng.standard_normal())
        self._add("one_way_range", pair, (pair[1], stamped, received, sigma))

    def of(self, name: str) -> dict[str, SlantRange | TwoWayRange | OneWayRange]:
        """Ranges that a vehicle measured, by kind."""
        makers = {
            "slant_range": SlantRange,
            "two_way_range": TwoWayRange,
            "one_way_range": OneWayRange,
        }
        return {
            kind: makers[kind](*(np.array(column) for column in zip(*rows, strict=True)))
            for (who, kind), rows in self.rows.items()
            if who == name
        }

    def _add(self, kind: str, pair: Pair, row: tuple[object, ...]) -> None:
        self.rows.setdefault((pair[0], kind), []).append(row)


def start_of(
    truth: Truth,
    t: float = 0.0,
    *,
    sigma: float = 1.0,
    heading_sigma: float | None = 0.02,
    off: Sequence[float] = (0.0, 0.0, 0.0, 0.0),
) -> Start:
    """A start where the vehicle is, or `off` by east, north, up (m) and heading (rad)."""
    east, north, up = (float(c) for c in truth.position(t)[0] + np.asarray(off[:3]))
    if heading_sigma is None:
        return Start(t, east, north, up, sigma=sigma)
    heading = float(truth.heading(t)[0]) + off[3]
    return Start(t, east, north, up, sigma=sigma, heading=heading, heading_sigma=heading_sigma)


def reckoning(
    name: str,
    truth: Truth,
    sound: Sound,
    *,
    options: Options = CHAIN,
    step: float = 1.0,
    start: Start | None = None,
    fix_every: float | None = None,
    fix_sigma: float = 1e-2,
    vehicle: Vehicle | None = None,
    **records: object,
) -> Member:
    """A vehicle with odometry, in the plane or in space as its nodes are."""
    times = np.arange(truth.span[0], truth.span[1] + 0.5 * step, step)
    odometry = odometer(
        truth, times, sound.rng, options, noise=sound.noise, planar=options.node == "pose2"
    )
    position = None
    if fix_every is not None:
        when = np.arange(truth.span[0], truth.span[1], fix_every)
        flat = options.node == "pose2"
        position = fixes(
            truth, when, sound.rng, sigma=fix_sigma, noise=sound.noise, horizontal=flat
        )
    segment = Segment(
        odometry=odometry, position=position, start=start, **{**sound.of(name), **records}
    )
    return Member(name, segment, Vehicle() if vehicle is None else vehicle, options)


def dvl_vehicle(
    name: str,
    truth: Truth,
    sound: Sound,
    *,
    options: Options = POINT,
    start: Start | None = None,
    vehicle: Vehicle | None = None,
    every: float = 0.5,
) -> Member:
    """A vehicle of point nodes with DVL, attitude reference and depth."""
    vehicle = Vehicle() if vehicle is None else vehicle
    times = np.arange(truth.span[0], truth.span[1], every)
    segment = Segment(
        velocity=dvl(truth, times, sound.rng, arm=vehicle.dvl, noise=sound.noise),
        attitude=ahrs(truth, times),
        depth=pressure(truth, times[::2], sound.rng, arm=vehicle.depth_sensor, noise=sound.noise),
        start=start,
        **sound.of(name),
    )
    return Member(name, segment, vehicle, options)


def fleet_of(
    members: Sequence[Member],
    *,
    targets: Sequence[Target] = (),
    beacons: Sequence[Beacon] = (),
    **options: object,
) -> Fleet:
    """A fleet without outliers whose sound speed is known, but for what `options` say."""
    settings = {"estimate_sound_speed": False, "loss": "none", "solver": "banded", **options}
    return Fleet(tuple(members), tuple(beacons), tuple(targets), PROFILE, Options(**settings))


def with_options(fleet: Fleet, **options: object) -> Fleet:
    """The same fleet with other options of the whole."""
    return replace(fleet, options=replace(fleet.options, **options))


def without(fleet: Fleet, *names: str) -> Fleet:
    """The same fleet without some vehicles and targets, and without the ranges to them."""

    def cut(segment: Segment) -> Segment:
        kept = {}
        for kind in ("slant_range", "two_way_range", "one_way_range"):
            rows = getattr(segment, kind)
            if rows is not None:
                rows = rows[~np.isin(rows.beacon, names)]
                kept[kind] = rows if len(rows) else None
        return replace(segment, **kept)

    return replace(
        fleet,
        vehicles=tuple(
            replace(m, segment=cut(m.segment)) for m in fleet.vehicles if m.name not in names
        ),
        targets=tuple(t for t in fleet.targets if t.name not in names),
    )


def changed(fleet: Fleet, name: str, **records: object) -> Fleet:
    """The same fleet with other records of one vehicle."""
    return replace(
        fleet,
        vehicles=tuple(
            replace(m, segment=replace(m.segment, **records)) if m.name == name else m
            for m in fleet.vehicles
        ),
    )


def farthest_off(result: FleetResult, truths: Mapping[str, Truth]) -> dict[str, float]:
    """Largest distance of each vehicle's nodes from the truth, m."""
    out: dict[str, float] = {}
    for name, truth in truths.items():
        track = result.vehicles[name].segments[0].trajectory
        gap = track.position - truth.position(track.t)
        if result.fleet.member(name).options.node == "pose2":
            gap = gap[:, :2]
        out[name] = float(np.linalg.norm(gap, axis=1).max())
    return out


#: Times that vehicles of `mixed` may be asked for, and their clocks against the fleet's time.
MIXED_SPAN = (0.0, 120.0)
MIXED_CLOCKS = {"plane": Clock(0.02, 3e-6), "point": Clock(-0.4, -5e-6), "space": Clock(1.3, 1e-6)}
MIXED_TRUTHS = {
    "plane": arc([0.0, 0.0, -20.0], 0.3, MIXED_SPAN, turn=0.012),
    "point": arc([150.0, -80.0, -45.0], -0.6, MIXED_SPAN, speed=1.2),
    "space": arc([-120.0, 140.0, -70.0], 2.1, MIXED_SPAN, speed=1.0, turn=-0.008),
}
MIXED_PLACES = {
    **{name: at(truth) for name, truth in MIXED_TRUTHS.items()},
    "rock": still(40.0, 190.0, -110.0),
    "whale": moving([-160.0, -120.0, -60.0], [1.1, 0.6, 0.05]),
}


def mixed(
    *,
    noise: float = 0.0,
    kinds: Sequence[str] = ("slant", "two_way", "one_way"),
    seed: int = 0,
    arms: bool = True,
    every: float = 6.0,
    **options: object,
) -> Fleet:
    """Vehicles of all kinds of nodes, a target at rest and one that moves, all ranging in turn."""
    rng = np.random.default_rng(seed)
    clocks = MIXED_CLOCKS if "one_way" in kinds else {}
    arm = LeverArm(0.8, -0.3, 0.4) if arms else LeverArm()
    places = dict(MIXED_PLACES)
    for name in ("point", "space"):
        places[name] = lambda t, truth=MIXED_TRUTHS[name]: truth.sensor_position(arm, t)[0]
    sound = Sound(places, rng, noise, clocks=clocks)
    vehicles = list(MIXED_TRUTHS)
    pairs = [(a, b) for a in vehicles for b in vehicles if a != b]
    to_targets = [(a, b) for a in vehicles for b in ("rock", "whale")]
    for i, t in enumerate(np.arange(2.5, MIXED_SPAN[1] - 5.0, every)):
        if "slant" in kinds and not clocks:
            sound.slant(pairs[i % len(pairs)], t + 0.3)
            sound.slant(to_targets[i % len(to_targets)], t + 1.7)
        if "slant" in kinds and clocks:
            # Distances have no stamp of the other's clock.
            sound.slant((vehicles[i % 3], "rock"), t + 1.7)
        if "two_way" in kinds and not clocks:
            sound.two_way(pairs[(i + 1) % len(pairs)], t + 0.9, wait=2.0)
            sound.two_way(to_targets[(i + 1) % len(to_targets)], t + 2.1)
        if "two_way" in kinds and clocks:
            sound.two_way((vehicles[i % 3], "rock"), t + 2.1)
        if "one_way" in kinds:
            sound.one_way(pairs[(i + 2) % len(pairs)], t + 3.7)
            sound.one_way(pairs[(i + 5) % len(pairs)], t + 3.7)
            sound.one_way(to_targets[(i + 2) % len(to_targets)], t + 4.2)
            sound.one_way(to_targets[(i + 5) % len(to_targets)], t + 4.5)
    carried = Vehicle(transducer=arm)
    starts = {name: start_of(truth) for name, truth in MIXED_TRUTHS.items()}
    members = [
        reckoning("plane", MIXED_TRUTHS["plane"], sound, start=starts["plane"], fix_every=20.0),
        dvl_vehicle(
            "point",
            MIXED_TRUTHS["point"],
            sound,
            start=replace(starts["point"], heading=None),
            vehicle=carried,
        ),
        reckoning(
            "space",
            MIXED_TRUTHS["space"],
            sound,
            options=SPACE,
            start=starts["space"],
            vehicle=carried,
            depth=pressure(MIXED_TRUTHS["space"], np.arange(0.0, 120.0, 5.0), rng, noise=noise),
        ),
    ]
    targets = (
        Target("rock", position=[30.0, 200.0, -110.0], sigma=[1e5, 1e5, 0.5]),
        Target(
            "whale", position=[-150, -130, -60], sigma=[1e5, 1e5, 1.0], velocity_sigma=2.0, t=0.0
        ),
    )
    return fleet_of(members, targets=targets, **options)


def posed(fleet: Fleet) -> tuple[FleetProblem, np.ndarray]:
    """The problem of a fleet that is one group, and where its solver starts."""
    pings = peer_pings(fleet)
    members = [model_member(fleet, member, pings) for member in fleet.vehicles]
    starts = find_fleet_starts(fleet, members, pings)
    ways = {m.name: (m.model.t, starts[m.name].tracks[0].position) for m in members}
    places = {t.name: target_starts(fleet, t, pings, ways) for t in fleet.targets}
    starts = with_clocks(fleet, members, pings, starts, places)
    found = {name: answers[0] for name, answers in places.items()}
    problem = build_fleet(fleet, members, pings, {n: s.position for n, s in found.items()})
    x = problem.layout.joined(
        [start_vector(m.mission, m.layout, [starts[m.name].tracks[0]]) for m in members]
    )
    for name, start in found.items():
        x[problem.layout.common_columns(f"target {name}")] = start.position
        if problem.layout.has(f"velocity {name}"):
            x[problem.layout.common_columns(f"velocity {name}")] = start.velocity
    return problem, x


def near(x: np.ndarray, seed: int = 0, size: float = 0.3) -> np.ndarray:
    """Another point, every column moved."""
    return x + size * np.random.default_rng(seed).normal(size=len(x))


def free(fleet: Fleet) -> Fleet:
    """The same fleet with so little said of the targets' velocities that nothing pulls."""
    targets = (replace(t, velocity_sigma=100.0) if t.moves else t for t in fleet.targets)
    return replace(fleet, targets=tuple(targets))
