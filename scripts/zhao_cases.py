"""The cases of the Zhao study: runs of the formation through the paper's filters and the graph.

A case is a frozen record; `run(case)` is all of its work. What it finds adds up over the runs of
its group, so that any pool of processes can do them in any order.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, TypeAlias

import numpy as np
from zhao_solve import (
    OPTIONS,
    found_at,
    missed,
    nees,
    own_squares,
    smoothed,
    summed,
    target_times,
    under_way,
)

from ubl_graph.arrays import FloatArray
from ubl_graph.baselines import multilaterate, zhao_ekf
from ubl_graph.baselines.zhao_ekf import FormationFilter
from ubl_graph.sim import ZhaoRuns, ZhaoSettings, map_grid, zhao_fleet, zhao_map, zhao_runs
from ubl_graph.sim.zhao import TARGET_DEPTH, VEHICLE_DEPTH
from ubl_graph.sim.zhao_fleet import NAMES, TARGET

#: When a target is ranged: at the last ranging time, or at each.
Ranged: TypeAlias = Literal["once", "always"]
#: Of all noise, and of the random targets.
SEED, TARGET_SEED = 1, 10
#: A run whose estimate was off by more has lost a vehicle, m.
LOST = 1000.0
#: Random targets are within so far of the middle, m east and north.
SPREAD = 8000.0


@dataclass
class Found:
    """What came of some runs.

    Attributes
    ----------
    sums : dict of str to array
        Over the runs; "runs" is how many there are.
    kept : dict of str to array
        One entry a run, along the first axis.
    """

    sums: dict[str, FloatArray] = field(default_factory=dict[str, FloatArray])
    kept: dict[str, FloatArray] = field(default_factory=dict[str, FloatArray])

    def take(self, other: Found) -> None:
        """Count in what other runs gave."""
        for name, values in other.sums.items():
            self.sums[name] = self.sums.get(name, np.zeros(())) + values
        for name, values in other.kept.items():
            held = self.kept.get(name)
            self.kept[name] = values if held is None else np.concatenate([held, values])

    @property
    def runs(self) -> int:
        """How many runs there are."""
        return int(np.max(self.sums["runs"]))

    def mean(self, name: str) -> FloatArray:
        """Mean over the runs."""
        return self.sums[name] / self.sums["runs"]

    def rms(self, name: str) -> FloatArray:
        """Root of the mean over the runs: of squared errors the root mean square error."""
        return np.sqrt(self.mean(name))


@dataclass(frozen=True)
class Runs:
    """Some runs of one formation.

    Attributes
    ----------
    settings : ZhaoSettings
        Of the simulation.
    first, count : int
        Which of its runs.
    part : str
        What they are for, where two tables have numbers of runs of their own.
    """

    settings: ZhaoSettings
    first: int
    count: int
    part: str = field(default="", kw_only=True)

    @property
    def group(self) -> Runs:
        """What stands for all cases that are the same but for their runs."""
        return replace(self, first=0, count=0)

    @property
    def filter(self) -> FormationFilter:
        """The paper's filter for so many masters."""
        return "fused" if len(self.settings.masters) == 1 else "nearest_master"

    def drawn(self) -> ZhaoRuns:
        """These runs' measurements."""
        return zhao_runs(self.count, SEED, self.settings, first=self.first)


@dataclass(frozen=True)
class Filters(Runs):
    """The paper's systems: own errors, and maps of a target that is ranged once.

    Attributes
    ----------
    systems : tuple of str
        Which of those of `zhao_ekf`.
    nodes : int
        Of a side of the map; 0 for none.
    """

    systems: tuple[FormationFilter, ...] = ("plain", "fused")
    nodes: int = 0

    def run(self) -> Found:
        """Sums of squared errors, m^2, own (K + 1, A) and of the map's targets (T,)."""
        runs = self.drawn()
        found = counted(self.count)
        for system in self.systems:
            estimate = zhao_ekf(runs.data, system)
            found.sums[f"own {system}"] = summed(estimate, runs)
            largest = missed(estimate, runs).max(axis=(1, 2))
            found.kept[f"largest {system}"] = largest
            if self.nodes:
                errors = zhao_map(runs, estimate, map_grid(nodes=self.nodes))
                found.sums[f"map {system}"] = self.count * errors**2
        return found


@dataclass(frozen=True)
class Smoothed(Runs):
    """The graph over whole runs, and the filter on the same.

    Attributes
    ----------
    pairs : {"filter", "all"}
        Whose ranges the graph has: those of the filter, or all six pairs.
    """

    pairs: Literal["filter", "all"] = "filter"

    def run(self) -> Found:
        """Sums of squared errors (K + 1, A), m^2."""
        runs = self.drawn()
        estimate = zhao_ekf(runs.data, self.filter)
        found = counted(self.count)
        found.sums["own filter"] = summed(estimate, runs)
        squares = np.zeros(runs.truth.shape[:2])
        for i in range(self.count):
            pairs: Any = "all" if self.pairs == "all" else estimate.partner[i]
            squares += own_squares(smoothed(runs, i, pairs=pairs), runs)
        found.sums["own graph"] = squares
        return found


@dataclass(frozen=True)
class Lagged(Runs):
    """The graph under way, with the filter's ranges, and the filter on the same.

    At each ranging time, after its ranges: where vehicles are, and where they were a lag ago.
    """

    #: Length of the window, s.
    lag: ClassVar[float] = 600.0

    def run(self) -> Found:
        """Sums of squared errors (E, A), m^2, at the ranging times; delayed, from the lag on."""
        runs = self.drawn()
        estimate = zhao_ekf(runs.data, self.filter)
        steps = np.concatenate([[0], runs.data.ranging_steps])
        squares = summed(estimate, runs)
        late = steps[runs.data.t[steps] <= runs.data.t[-1] - self.lag]
        found = counted(self.count)
        found.sums |= {"filter current": squares[steps[1:]], "filter delayed": squares[late]}
        for i in range(self.count):
            fleet = zhao_fleet(runs, i, pairs=estimate.partner[i], options=OPTIONS)
            current, delayed = under_way(fleet, runs.data.t[steps], self.lag)
            for name, places, there in (
                ("graph current", current, steps[1:]),
                ("graph delayed", delayed, late),
            ):
                errors = np.square(places - runs.truth[there, :, :2]).sum(axis=-1)
                found.take(Found({name: errors}))
        return found


@dataclass(frozen=True)
class Consistency(Runs):
    """Normalised estimation error squared of vehicles and of a target, at fixed times.

    Attributes
    ----------
    times : tuple of float
        Of the vehicles, s.
    target : tuple of float
        East, north, m; ranged at all ranging times to `TARGET_TIME`.
    """

    times: tuple[float, ...] = ()
    target: tuple[float, float] = (0.0, 0.0)

    def run(self) -> Found:
        """Sums over the runs: of vehicles (N, A), of the target one number; two freedoms each."""
        runs = self.drawn()
        estimate = zhao_ekf(runs.data, self.filter)
        rows = runs.data.ranging_steps[runs.epochs(self.times)]
        truth = runs.truth[rows, :, :2]
        found = counted(self.count)
        ours, target = np.zeros(truth.shape[:2]), 0.0
        for i in range(self.count):
            result = smoothed(
                runs,
                i,
                pairs=estimate.partner[i],
                target=self.target,
                times=target_times(self.settings),
                coarse=True,
            )
            for a, name in enumerate(NAMES):
                states = result.vehicles[name].trajectory.at(runs.data.t[rows])
                ours[:, a] += nees(
                    states.position[:, :2] - truth[:, a], states.covariance[:, :2, :2]
                )
            there = result.targets[TARGET]
            off = there.position[:2] - np.array(self.target)
            target += float(nees(off, there.covariance[:2, :2]))
        theirs = np.zeros_like(ours)
        followers = list(runs.data.followers)
        states = estimate.state[:, rows][:, :, followers, :2] - truth[:, followers]
        covariances = estimate.covariance[:, rows][:, :, followers, :2, :2]
        theirs[:, followers] = nees(states, covariances).sum(axis=0)
        found.sums |= {"graph": ours, "filter": theirs, "target": np.array(target)}
        return found


@dataclass(frozen=True)
class Maps(Runs):
    """Where a target is, by the filter with multilateration and by the graph with all in one.

    The runs end when the target is ranged for the last time: neither knows anything later.

    Attributes
    ----------
    ranged : {"once", "always"}
        At the last ranging time, or at each.
    nodes : int
        Of a side of the map.
    chosen : tuple of int
        Which of its places are done here.
    """

    ranged: Ranged = "once"
    nodes: int = 7
    chosen: tuple[int, ...] = ()

    @property
    def group(self) -> Runs:
        """What stands for all cases that are the same but for their runs and places."""
        return replace(self, first=0, count=0, chosen=())

    def run(self) -> Found:
        """Sums of squared errors (T,), m^2, at the places that were chosen."""
        runs, every = self.drawn(), map_grid(nodes=self.nodes)
        estimate = zhao_ekf(runs.data, self.filter)
        times = self.settings.duration if self.ranged == "once" else target_times(self.settings)
        places = list(self.chosen)
        count, theirs, ours = np.zeros((3, len(every)))
        count[places] = self.count
        theirs[places] = self.count * zhao_map(runs, estimate, every[places], times) ** 2
        for place in places:
            for i in range(self.count):
                result = smoothed(
                    runs,
                    i,
                    pairs=estimate.partner[i],
                    target=every[place],
                    times=times,
                    coarse=True,
                )
                ours[place] += np.square(found_at(result) - every[place]).sum()
        return Found({"runs": count, "filter": theirs, "graph": ours})


@dataclass(frozen=True)
class Targets(Runs):
    """Random targets, each ranged once, at the end of runs that are as long as the settings say.

    Attributes
    ----------
    targets : int
        How many.
    """

    targets: int = 20

    @property
    def places(self) -> FloatArray:
        """Where they are, (T, 2), m."""
        rng = np.random.default_rng(TARGET_SEED)
        return rng.uniform(-SPREAD, SPREAD, (self.targets, 2))

    def run(self) -> Found:
        """Where each run finds them, (R, T, 2), m, by system."""
        runs, places, end = self.drawn(), self.places, self.settings.duration
        found = counted(self.count)
        slant = np.stack([runs.slant_ranges(p, end)[:, 0] for p in places], axis=1)
        estimates = {name: zhao_ekf(runs.data, name) for name in ("plain", "fused")}
        for name, estimate in estimates.items():
            here = estimate.state[:, None, -1, :, :2]
            begin = np.broadcast_to(places, (self.count, *places.shape))
            found.kept[name] = multilaterate(
                here, slant, begin, height=TARGET_DEPTH - VEHICLE_DEPTH
            )
        partner = estimates["fused"].partner
        found.kept["graph"] = np.array(
            [
                [
                    found_at(smoothed(runs, i, pairs=partner[i], target=p, times=end, coarse=True))
                    for p in places
                ]
                for i in range(self.count)
            ]
        )
        return found


Case: TypeAlias = Filters | Smoothed | Lagged | Consistency | Maps | Targets


def run(case: Case, _seed: int = 0) -> Found:
    """All work of a case, for any pool of processes; its runs have their own seed."""
    return case.run()


def gathered(cases: Iterable[Case], values: Iterable[Found]) -> dict[Runs, Found]:
    """What all cases of a group found together, the runs in order."""
    out: dict[Runs, Found] = {}
    for case, value in sorted(zip(cases, values, strict=True), key=lambda pair: pair[0].first):
        out.setdefault(case.group, Found()).take(value)
    return out


def counted(runs: int) -> Found:
    """What is found of so many runs, still empty."""
    return Found({"runs": np.array(float(runs))})
