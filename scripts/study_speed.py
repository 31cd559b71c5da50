"""How much faster a study of many short missions is on two processes than on one.

Each case simulates a straight pass over four beacons and smooths it: a Monte-Carlo study as it is
run in earnest. The processes are started anew each time, and their start counts.

Example: python scripts/study_speed.py --cases 1000 --repeat 3
"""

from __future__ import annotations

import argparse
import os
import time

import numpy as np

from ubl_graph.sim import straight_pass
from ubl_graph.smoother import smooth
from ubl_graph.study import run_study


def window(duration: float, seed: int) -> tuple[float, float]:
    """Horizontal RMS error of one smoothed window, m, and its largest standard deviation, m."""
    mission, truth = straight_pass(seed, duration=duration)
    track = smooth(mission).trajectory
    error = (track.position - truth.position(track.t))[:, :2]
    return (
        float(np.sqrt((error**2).sum(axis=1).mean())),
        float(np.sqrt(track.covariance[:, [0, 1], [0, 1]].max())),
    )


def main() -> None:
    """Time one process and two in turn, and print each time, the ratios and the best one."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=1000, help="windows in a study (1000)")
    parser.add_argument("--duration", type=float, default=40.0, help="of a window, s (40)")
    parser.add_argument("--repeat", type=int, default=3, help="studies of each kind (3)")
    asked = parser.parse_args()
    if asked.cases < 1 or asked.repeat < 1 or not 20.0 <= asked.duration <= 240.0:
        parser.error("--cases and --repeat are 1 or more, --duration is 20 to 240 s")
    cases = [asked.duration] * asked.cases
    results, ratios = [], []
    for _ in range(asked.repeat):
        times = {}
        for workers in (1, 2):
            begin = time.perf_counter()
            study = run_study(window, cases, workers=workers)
            times[workers] = time.perf_counter() - begin
            results.append(study.results)
            load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
            each = 1e3 * np.median([o.seconds for o in study.outcomes])
            print(
                f"{workers} processes: {times[workers]:.2f} s, {each:.1f} ms a case, "
                f"{len(study.failures)} failed, load {load}"
            )
        ratios.append(times[1] / times[2])
        print(f"ratio {ratios[-1]:.2f}")
    same = all(r == results[0] for r in results)
    print(
        f"best ratio {max(ratios):.2f}; results {'the same' if same else 'DIFFER'} in all studies"
    )


if __name__ == "__main__":
    main()
