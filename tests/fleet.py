"""What tests of studies and batches share: functions for workers, a dask cluster, mission files."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Generator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent


def draw(case, seed):
    """A case's own stream of random numbers; some cases go wrong, each in its way."""
    match case:
        case "raise":
            raise ValueError("a bad case\nin two lines")
        case "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        case "leave":
            os._exit(3)
        case "exit":
            sys.exit(4)
        case "unpicklable":
            return lambda: None
        case float():
            time.sleep(case)
    return case, np.random.default_rng(seed).standard_normal(3).tolist()


def window(duration, seed):
    """A short mission, simulated and smoothed."""
    # Not at the top: most workers that tests start never need the solver.
    from ubl_graph.sim import straight_pass
    from ubl_graph.smoother import smooth

    mission, _ = straight_pass(seed, duration=duration)
    return smooth(mission).trajectory.position


def note_and_die(case, seed):
    """Write down that the case runs; die while there are fewer notes than the case asks for."""
    folder, name, deaths = case
    with (folder / name).open("a") as notes:
        notes.write(f"{seed}\n")
    if len((folder / name).read_text().splitlines()) <= deaths:
        os.kill(os.getpid(), signal.SIGKILL)
    return name


def threads(_case, _seed):
    return os.environ.get("OPENBLAS_NUM_THREADS"), os.environ.get("MKL_NUM_THREADS")


class AwkwardError(Exception):
    """An exception that pickle cannot make again."""

    def __init__(self, first, second):
        super().__init__(f"{first} {second}")


def fail_as(kind):
    raise kind("bad value", "") if kind is AwkwardError else kind("bad value")


@contextmanager
def cluster(
    folder: Path, workers: int = 2, path: str = "", **settings: str
) -> Generator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A dask scheduler and its workers on the loopback address, each a process group of its own.

    Gives the address, and the processes: the scheduler, then the workers. `path` comes first where
    the workers look for modules.
    """
    from distributed import Client

    about = folder / "scheduler.json"
    base = {**os.environ, **settings, "PYTHONPATH": f"{HERE}", "OPENBLAS_NUM_THREADS": "1"}
    seen = {**base, "PYTHONPATH": f"{path}{os.pathsep}{HERE}"} if path else base
    started: list[subprocess.Popen[bytes]] = []

    def start(*arguments: str, env: Mapping[str, str]) -> None:
        with (folder / f"{len(started)}.log").open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "dask", *arguments],
                env=env,
                stdout=log,
                stderr=log,
                cwd=folder,
                start_new_session=True,
            )
        started.append(process)

    try:
        listen = ("--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--no-show")
        start("scheduler", *listen, "--scheduler-file", str(about), env=base)
        address = _address(about, started[0])
        for _ in range(workers):
            place = ("--local-directory", str(folder), "--host", "127.0.0.1")
            start("worker", address, "--nthreads", "1", "--no-dashboard", *place, env=seen)
        if workers:
            with Client(address, timeout=60.0, set_as_default=False) as client:
                client.wait_for_workers(workers, timeout=60.0)
        yield address, started
    finally:
        # A worker's nanny would wait for a scheduler that is gone.
        for process in reversed(started):
            end(process)


def end(process: subprocess.Popen[bytes]) -> None:
    """End a process and its children."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _address(about: Path, scheduler: subprocess.Popen[bytes]) -> str:
    end_of_patience = time.monotonic() + 60.0
    while time.monotonic() < end_of_patience:
        with suppress(OSError, ValueError):
            return json.loads(about.read_text())["address"]
        assert scheduler.poll() is None, "the scheduler does not start"
        time.sleep(0.05)
    raise AssertionError("the scheduler says nothing")


def write_mission(folder: Path, stem: str, *, seed: int = 1, name: str = "") -> Path:
    """A mission file with its data: the smallest sensible mission, with noise of its own."""
    from ubl_graph.sim import straight_pass

    mission, _ = straight_pass(seed, duration=80.0)
    (segment,) = mission.segments
    pings, depth = segment.two_way_range, segment.depth
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / f"{stem}-ranges.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["beacon", "t_transmit", "t_receive", "travel_time", "sigma"])
        columns = (pings.t_transmit, pings.t_receive, pings.travel_time, pings.sigma)
        rows.writerows(zip(pings.beacon, *(c.tolist() for c in columns), strict=True))
    with (folder / f"{stem}-depth.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["t", "depth", "sigma"])
        columns = (depth.t, depth.depth, depth.sigma)
        rows.writerows(zip(*(c.tolist() for c in columns), strict=True))
    beacons = "".join(
        f'[[beacon]]\nname = "{b.name}"\nturnaround = {b.turnaround}\nposition = '
        "{{ east = {}, north = {}, up = {} }}\n".format(*b.position.tolist())
        for b in mission.beacons
    )
    path = folder / f"{stem}.toml"
    path.write_text(
        f'[mission]\nname = "{name or stem}"\n{beacons}[sound_speed]\nconstant = 1490.0\n'
        f'[data]\ntwo_way_range = "{stem}-ranges.csv"\ndepth = "{stem}-depth.csv"\n'
    )
    return path
