"""What the Zhao study runs: the settings, and how many runs of what, in full and in short."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from zhao_cases import Case, Consistency, Filters, Lagged, Maps, Ranged, Smoothed, Targets

from ubl_graph.sim import ZhaoSettings
from ubl_graph.sim.zhao import TARGET_TIME

#: The two pairs of period and range noise that fit the paper equally well.
SHORT, LONG = ZhaoSettings(), ZhaoSettings(period=120.0, range_sigma=15.0)
BOTH = (SHORT, LONG)
#: Fig. 9: noise of the followers, one kind at a time.
SPEEDS = (0.1, 0.2, 0.3, 0.4, 0.5)
YAW_RATES = (0.01, 0.02, 0.05, 0.1, 0.15, 0.2)
#: Fig. 10: noise, and when each target is ranged, s.
NOISY = ZhaoSettings(speed_sigma=0.3, yaw_rate_sigma_deg=0.15)
TIMES = (120.0, 600.0, 3000.0)
#: Where the NEES is taken, s; and of a target, m east and north.
NEES_TIMES = (600.0, 1800.0, 3000.0, 3600.0)
NEES_TARGET = (5000.0, 0.0)
#: Runs done in one go; of other cases one.
SIZES: dict[type, int] = {Filters: 50, Smoothed: 5, Consistency: 5}


@dataclass(frozen=True)
class Plan:
    """How much is run; which rows there are does not depend on it.

    Attributes
    ----------
    filtered, nodes : int
        Runs of the filters, and nodes of a side of their maps.
    many : int
        Runs that tell what to expect of the filters; their maps are those of Fig. 9.
    smoothed : int
        Runs of the graph, whole.
    lagged : int
        Runs of the graph under way.
    mapped, mapped_once, graph_nodes : int
        Runs of the graph's maps of a target that is ranged each period, and once; nodes of a side.
    consistent : int
        Runs of the NEES.
    noisy, noisy_nodes, noisy_smoothed : int
        Of Fig. 9: runs and nodes of the filters' maps, and runs of the graph.
    targets, target_runs : int
        Of Fig. 10: targets and runs of each.
    """

    filtered: int = 200
    nodes: int = 21
    many: int = 2000
    smoothed: int = 100
    lagged: int = 100
    mapped: int = 100
    mapped_once: int = 6
    graph_nodes: int = 7
    consistent: int = 50
    noisy: int = 60
    noisy_nodes: int = 15
    noisy_smoothed: int = 20
    targets: int = 20
    target_runs: int = 5


FULL = Plan()
QUICK = Plan(
    filtered=50,
    nodes=11,
    many=100,
    smoothed=4,
    lagged=2,
    mapped=2,
    mapped_once=1,
    graph_nodes=3,
    consistent=5,
    noisy=12,
    noisy_nodes=7,
    noisy_smoothed=1,
    targets=5,
    target_runs=1,
)


def two_masters(settings: ZhaoSettings) -> ZhaoSettings:
    """The same with AUV1 as the second master."""
    return replace(settings, masters=(0, 1))


def mapped(settings: ZhaoSettings) -> ZhaoSettings:
    """The same up to when the target is ranged for the last time."""
    return replace(settings, duration=TARGET_TIME)


def noisy_settings() -> dict[str, ZhaoSettings]:
    """Fig. 9: settings by name."""
    found = {f"speed noise {s:g} m/s": replace(SHORT, speed_sigma=s) for s in SPEEDS}
    return found | {
        f"yaw-rate noise {y:g} deg/s": replace(SHORT, yaw_rate_sigma_deg=y) for y in YAW_RATES
    }


def groups(plan: Plan) -> dict[str, Case]:
    """All groups of cases by name, the longest first; each stands for so many runs."""
    sides = plan.nodes
    found: dict[str, Case] = {}
    for s in BOTH:
        found[f"lagged, {label(s)}"] = Lagged(s, 0, plan.lagged)
    maps: tuple[tuple[str, ZhaoSettings, int, Ranged], ...] = (
        ("always", SHORT, plan.mapped, "always"),
        ("once", SHORT, plan.mapped_once, "once"),
        ("two masters", two_masters(SHORT), plan.mapped_once, "once"),
    )
    for name, settings, runs, ranged in maps:
        side = plan.graph_nodes
        every = tuple(range(side**2))
        found[f"map, {name}"] = Maps(mapped(settings), 0, runs, ranged, side, every)
    for s in BOTH:
        found[f"filters, {label(s)}"] = Filters(s, 0, plan.filtered, nodes=sides)
        found[f"two masters, {label(s)}"] = Filters(
            two_masters(s), 0, plan.filtered, ("nearest_master",), sides
        )
        found[f"smoothed, {label(s)}"] = Smoothed(s, 0, plan.smoothed)
        found[f"all pairs, {label(s)}"] = Smoothed(s, 0, plan.smoothed, "all")
    grid = plan.noisy_nodes
    found["many"] = Filters(SHORT, 0, plan.many, nodes=grid, part="many")
    found["many, two masters"] = Filters(
        two_masters(SHORT), 0, plan.many, ("nearest_master",), grid, part="many"
    )
    found["consistency"] = Consistency(SHORT, 0, plan.consistent, NEES_TIMES, NEES_TARGET)
    for name, s in noisy_settings().items():
        found[f"filters, {name}"] = Filters(s, 0, plan.noisy, nodes=plan.noisy_nodes, part="growth")
        found[f"smoothed, {name}"] = Smoothed(s, 0, plan.noisy_smoothed, part="growth")
    for t in TIMES:
        settings = replace(NOISY, duration=t)
        found[f"targets, {t:g} s"] = Targets(settings, 0, plan.target_runs, plan.targets)
    return found


def cases(plan: Plan) -> list[Case]:
    """All that is run, cut into pieces, each once: the least noise of both kinds is one setting."""
    return list(dict.fromkeys(p for case in groups(plan).values() for p in pieces(case)))


def pieces(case: Case) -> list[Case]:
    """A group's runs, a few at a time; of maps one run and row of the map at a time."""
    size = SIZES.get(type(case), 1)
    last = case.first + case.count
    cut = [replace(case, first=i, count=min(size, last - i)) for i in range(case.first, last, size)]
    if not isinstance(case, Maps):
        return cut
    rows = np.array(case.chosen).reshape(case.nodes, case.nodes)
    return [replace(c, chosen=tuple(row.tolist())) for c in cut for row in rows]


def label(settings: ZhaoSettings) -> str:
    """Period and range noise."""
    return f"{settings.period:g} s, {settings.range_sigma:g} m"
