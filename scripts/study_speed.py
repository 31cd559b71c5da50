"""How much faster a study of many short missions is on two processes than on one.

Each case simulates a straight pass over four beacons and smooths it: a Monte-Carlo study as it is
run in earnest. The processes are started anew each time, and their start counts.

The elapsed times mean something on an idle machine only. On a busy one there is the processor time
of the worker that took most of it, start included: what the study would take if each worker had a
processor to itself.

Example: python scripts/study_speed.py --cases 1000 --repeat 3
"""

from __future__ import annotations

import argparse
import os
import time
from typing import NamedTuple

import numpy as np

from ubl_graph.sim import straight_pass
from ubl_graph.smoother import smooth
from ubl_graph.study import run_study


class Window(NamedTuple):
    """One smoothed window: its error and sigma, m; who did it, and its processor time so far, s."""

    rmse: float
    sigma: float
    process: int
    spent: float


class Timing(NamedTuple):
    """One study: elapsed time and the busiest worker's processor time, s; what came out."""

    elapsed: float
    busiest: float
    results: list[tuple[float, float]]


def window(duration: float, seed: int) -> Window:
    """Simulate and smooth one window."""
    mission, truth = straight_pass(seed, duration=duration)
    track = smooth(mission).trajectory
    error = (track.position - truth.position(track.t))[:, :2]
    return Window(
        float(np.sqrt((error**2).sum(axis=1).mean())),
        float(np.sqrt(track.covariance[:, [0, 1], [0, 1]].max())),
        os.getpid(),
        time.process_time(),
    )


def timed(cases: list[float], workers: int) -> Timing:
    """Run the study once, and say how it went."""
    begin, before = time.perf_counter(), time.process_time()
    study = run_study(window, cases, workers=workers)
    elapsed, own = time.perf_counter() - begin, time.process_time() - before
    busiest = max(found.spent for found in study.results)
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    print(
        f"{workers} processes: {elapsed:.2f} s elapsed; processor time {busiest:.2f} s in the "
        f"busiest, {own:.2f} s here; {len(study.failures)} failed; load {load}"
    )
    return Timing(elapsed, busiest + own, [(w.rmse, w.sigma) for w in study.results])


def main() -> None:
    """Time one process and two in turn, and print each time, the ratios and the best one."""
    parser = argparse.ArgumentParser(description="A study on one process and on two.")
    parser.add_argument("--cases", type=int, default=1000, help="windows in a study (1000)")
    parser.add_argument("--duration", type=float, default=40.0, help="of a window, s (40)")
    parser.add_argument("--repeat", type=int, default=3, help="studies of each kind (3)")
    asked = parser.parse_args()
    if asked.cases < 1 or asked.repeat < 1 or not 20.0 <= asked.duration <= 240.0:
        parser.error("--cases and --repeat are 1 or more, --duration is 20 to 240 s")
    cases = [asked.duration] * asked.cases
    pairs = [(timed(cases, 1), timed(cases, 2)) for _ in range(asked.repeat)]
    elapsed = max(one.elapsed / two.elapsed for one, two in pairs)
    processor = max(one.busiest / two.busiest for one, two in pairs)
    print(f"best ratio {elapsed:.2f} elapsed, {processor:.2f} of processor time")
    same = all(timing.results == pairs[0][0].results for pair in pairs for timing in pair)
    print(f"results are {'the same' if same else 'DIFFERENT'} in all studies")


if __name__ == "__main__":
    main()
