"""Time the online estimator of fleets on a simulated mission, beside GTSAM's fixed-lag smoothers.

Ten vehicles with odometry at 1 Hz range each other in random pairs every 5 s for an hour, two of
them with position fixes. An update is a range or fix added and the window solved. Printed are its
percentiles, what adding odometry takes, the errors and NEES of all vehicles against the truth, and
with --rival the processor time of a GTSAM smoother in the same process on the same graph (native
BetweenFactorPose2 and RangeFactorPose2, its odometry compounded beforehand and not timed; it has no
gate), alone and with the covariances of the vehicles' newest poses, which an update of ours has at
hand.

    OPENBLAS_NUM_THREADS=1 python scripts/fleet_speed.py --rival batch
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

# Equations of a few hundred columns are solved fastest by one thread.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from ubl_graph.measurements import Odometry, PositionFix, SlantRange
from ubl_graph.odometry_chain import compounded
from ubl_graph.online.fleet_estimator import FleetEstimator
from ubl_graph.online.fleet_replay import bare, stream
from ubl_graph.sim.fleets import random_fleet

#: Errors are looked at so often, in updates.
LOOK = 10


class Rival:
    """GTSAM's fixed-lag smoother on the same graph."""

    def __init__(self, fleet: Any, lag: float, kind: str) -> None:
        import gtsam

        self.gtsam = gtsam
        if kind == "batch":
            self.smoother = gtsam.BatchFixedLagSmoother(lag)
        else:
            parameters = gtsam.ISAM2Params()
            self.smoother = gtsam.IncrementalFixedLagSmoother(lag, parameters)
        self.fleet, self.names = fleet, fleet.vehicle_names
        self.cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(2.3849)
        self.last: dict[str, tuple[float, int]] = {}
        self.counts = dict.fromkeys(self.names, 0)
        self.graph, self.values, self.stamps = gtsam.NonlinearFactorGraph(), gtsam.Values(), {}
        self.poses: dict[str, Any] = {}
        self.up: dict[str, float] = {}
        for member in fleet.vehicles:
            start = member.segment.start
            pose = gtsam.Pose2(start.east, start.north, 0.5 * np.pi - start.heading)
            sigmas = [start.sigma, start.sigma, start.heading_sigma]
            noise = gtsam.noiseModel.Diagonal.Sigmas(np.array(sigmas))
            key = self._new(member.name, 0.0, pose)
            self.graph.addPriorPose2(key, pose, noise)
            self.up[member.name] = start.up

    def _new(self, name: str, t: float, pose: Any) -> int:
        key = self.gtsam.symbol(chr(ord("a") + self.names.index(name)), self.counts[name])
        self.counts[name] += 1
        self.values.insert(key, pose)
        self.stamps[key] = t
        self.last[name], self.poses[name] = (t, key), pose
        return key

    def node(self, name: str, t: float) -> int:
        """The vehicle's pose at a time, joined by odometry to its last one."""
        gtsam, (before, key) = self.gtsam, self.last[name]
        if t - before < 1e-6:
            return key
        member = self.fleet.member(name)
        records = member.segment.odometry
        some = records[(records.t_to > before) & (records.t_from < t)]
        whole = compounded(some, np.array([before, t]), member.options)
        at = int(np.argmin(np.abs(whole.t_from - before)))
        step = gtsam.Pose2(whole.forward[at], -whole.right[at], -whole.about_down[at])
        noise = gtsam.noiseModel.Gaussian.Covariance(whole.covariances_flu[at])
        new = self._new(name, t, self.poses[name].compose(step))
        self.graph.add(gtsam.BetweenFactorPose2(key, new, step, noise))
        return new

    def add(self, name: str, record: Any) -> None:
        """Make factors of a range or fix."""
        gtsam, t = self.gtsam, float(record.t[0])
        key = self.node(name, t)
        if isinstance(record, PositionFix):
            noise = gtsam.noiseModel.Isotropic.Sigma(2, float(record.sigma[0]))
            place = np.array([record.east[0], record.north[0]])
            self.graph.add(gtsam.PoseTranslationPrior2D(key, place, noise))
            return
        peer = str(record.beacon[0])
        other = self.node(peer, t)
        climb, distance = self.up[name] - self.up[peer], float(record.distance[0])
        level = np.sqrt(max(distance**2 - climb**2, 1.0))
        sigma = float(record.sigma[0]) * distance / level
        noise = gtsam.noiseModel.Robust.Create(
            self.cauchy, gtsam.noiseModel.Isotropic.Sigma(1, sigma)
        )
        self.graph.add(gtsam.RangeFactorPose2(key, other, level, noise))

    def update(self) -> tuple[float, float]:
        """Solve; processor time of that, and with the covariance of each newest pose, s."""
        begun = time.process_time()
        self.smoother.update(self.graph, self.values, self.stamps)
        estimate = self.smoother.calculateEstimate()
        taken = time.process_time() - begun
        if hasattr(self.smoother, "marginalCovariance"):
            covariance = self.smoother.marginalCovariance
        else:
            marginals = self.gtsam.Marginals(self.smoother.getFactors(), estimate)
            covariance = marginals.marginalCovariance
        for _, key in self.last.values():
            covariance(key)
        whole = time.process_time() - begun
        for name, (_, key) in self.last.items():
            if estimate.exists(key):
                self.poses[name] = estimate.atPose2(key)
        self.graph, self.values, self.stamps = (
            self.gtsam.NonlinearFactorGraph(),
            self.gtsam.Values(),
            {},
        )
        return taken, whole


def run(arguments: argparse.Namespace, seed: int) -> dict[str, Any]:
    """One mission: times (s), errors (m) and NEES."""
    fleet, truths = random_fleet(
        seed, arguments.vehicles, arguments.duration, arguments.every, kind=arguments.kind
    )
    estimator = FleetEstimator(bare(fleet), arguments.lag)
    rival = Rival(fleet, arguments.lag, arguments.rival) if arguments.rival else None
    update, cpu, odometry, beside, errors, nees, refused = ([] for _ in range(7))
    for t, vehicle, record in stream(fleet):
        begun, begun_cpu = time.perf_counter(), time.process_time()
        estimator.add(vehicle, record)
        if isinstance(record, Odometry):
            odometry.append(time.perf_counter() - begun)
            continue
        events = estimator.update()
        update.append(time.perf_counter() - begun)
        cpu.append(time.process_time() - begun_cpu)
        refused += events
        if rival is not None and isinstance(record, (SlantRange, PositionFix)):
            rival.add(vehicle, record)
            beside.append(rival.update())
        if len(update) % LOOK == 0:
            for name in fleet.vehicle_names:
                estimate = estimator.estimate(name)
                if estimate.position is None:
                    raise SystemExit(f"{name} has no place at {t:g} s")
                off = (estimate.position - truths[name].position(estimate.t)[0])[:2]
                errors.append(float(np.hypot(*off)))
                nees.append(float(off @ np.linalg.solve(estimate.covariance[:2, :2], off)))
    return {
        "update": update,
        "cpu": cpu,
        "odometry": odometry,
        "beside": beside,
        "errors": errors,
        "nees": nees,
        "refused": len(refused),
        "window": estimator.health()["window"],
        "rebuilds": estimator.rebuilds,
    }


def percentiles(times: np.ndarray) -> dict[str, float]:
    """Milliseconds: median, 90th and 99th percentile, longest."""
    some = 1e3 * times
    names = {"p50": 50.0, "p90": 90.0, "p99": 99.0, "max": 100.0}
    return {name: round(float(np.percentile(some, q)), 3) for name, q in names.items()}


def main() -> int:
    """Run the missions and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--vehicles", type=int, default=10)
    parser.add_argument("--duration", type=float, default=3600.0, help="s")
    parser.add_argument("--every", type=float, default=5.0, help="s from range to range")
    parser.add_argument("--lag", type=float, default=300.0, help="s")
    kinds = ("slant_range", "two_way_range", "one_way_range")
    parser.add_argument("--kind", choices=kinds, default="slant_range")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--rival", choices=("batch", "incremental"), help="GTSAM's smoother beside")
    parser.add_argument("--json", type=Path, help="write the numbers here")
    arguments = parser.parse_args()
    if arguments.rival and arguments.kind != "slant_range":
        parser.error("--rival goes with slant ranges alone")
    runs = [run(arguments, seed) for seed in arguments.seeds]
    lists = ("update", "cpu", "odometry", "beside", "errors", "nees")
    joined = {k: np.array([v for r in runs for v in r[k]]) for k in lists}
    content: dict[str, Any] = {
        "vehicles": arguments.vehicles,
        "duration_s": arguments.duration,
        "lag_s": arguments.lag,
        "kind": arguments.kind,
        "updates": len(joined["update"]),
        "update_ms": percentiles(joined["update"]),
        "update_cpu_ms": percentiles(joined["cpu"]),
        "odometry_ms": percentiles(joined["odometry"]),
        "rmse_m": round(float(np.sqrt(np.mean(joined["errors"] ** 2))), 2),
        "nees_2dof": round(float(np.mean(joined["nees"])), 3),
        "refused": sum(r["refused"] for r in runs),
        "rebuilds": sum(r["rebuilds"] for r in runs),
        "window": runs[-1]["window"],
    }
    if len(joined["beside"]):
        content["rival"] = arguments.rival
        names = ("rival_cpu_ms", "rival_with_covariances_cpu_ms")
        for name, times in zip(names, joined["beside"].T, strict=True):
            content[name] = percentiles(times)
            ratio = content[name]["p50"] / content["update_cpu_ms"]["p50"]
            content[name.replace("cpu_ms", "over_ours_p50")] = round(ratio, 2)
    for name, value in content.items():
        print(f"{name:20} {value}")
    if arguments.json:
        arguments.json.write_text(json.dumps(content, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
