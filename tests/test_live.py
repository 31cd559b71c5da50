"""`ubl-graph live` as a process: pipes, signals, datagrams, checkpoints, and the real estimator.

What only concerns the process runs with a stand-in for the estimator that starts quickly and does
as a record tells it; what concerns the estimate runs with the true one.
"""

from __future__ import annotations

import itertools
import json
import os
import queue
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ubl_graph.errors import ConfigurationError, DataError
from ubl_graph.io.mission_file import load_setup
from ubl_graph.mission import Mission, Setup
from ubl_graph.online import streams
from ubl_graph.online.estimator import FixedLagEstimator
from ubl_graph.online.json_records import record_content
from ubl_graph.online.protocol import MAX_LINE
from ubl_graph.online.session import Session
from ubl_graph.online.streams import LineCutter, LineWriter, lines_of, lines_received, udp_socket
from ubl_graph.sim import straight_pass

#: How long a test waits for a process before it gives up, s.
LONG = 30.0

CONFIG = """
[mission]
name = "auv"
[[beacon]]
name = "B1"
position = { east = 0, north = 0, up = -100 }
turnaround = 0.2
[sound_speed]
constant = 1500
"""
PING = {"type": "two_way_range", "beacon": "B1", "t_transmit": 0.0, "t_receive": 1.0}
DEPTH = {"type": "depth", "t": 0.5, "depth": 10.0}

STAND_IN = '''
"""The command with an estimator that counts, and does what a depth in metres tells it to."""
import os, pickle, sys, time, types
from dataclasses import dataclass
from types import SimpleNamespace

class FixedLagEstimator:
    def __init__(self, setup, count=0):
        self.setup, self.count, self.t = setup, count, 0.0

    of = classmethod(lambda cls, setup: cls(setup))

    def add(self, record):
        depth = record.depth[0] if hasattr(record, "depth") else 0.0
        if depth == 11.0:
            print("printed by the library")
            os.write(1, b"printed by its C++ code\\n")
        if depth == 12.0:
            raise RuntimeError("a fault")
        if depth == 13.0:
            time.sleep(1.0)
        self.count += 1
        return SimpleNamespace(accepted=True, reason="", final=True, others=())

    def estimate(self, t=None):
        self.t = max(self.t + 1e-3, t or 0.0)
        return SimpleNamespace(
            t=self.t, position=None, velocity=None, covariance=None,
            status="initialising", reasons=("none",), rotation=None, hypotheses=(),
        )

    def flush(self):
        return ()

    def health(self):
        return {"count": self.count}

    def checkpoint(self, path):
        with open(path, "wb") as file:
            pickle.dump((self.setup, self.count), file)

    @classmethod
    def restore(cls, path):
        from ubl_graph.errors import DataError
        try:
            with open(path, "rb") as file:
                return cls(*pickle.load(file))
        except Exception as error:
            raise DataError("this is no checkpoint", file=path) from error

module = types.ModuleType("ubl_graph.online.estimator")
module.FixedLagEstimator = FixedLagEstimator
sys.modules["ubl_graph.online.estimator"] = module
from ubl_graph.cli import main
main()
'''


def strict(text: str | bytes) -> dict[str, Any]:
    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    return json.loads(text, parse_constant=refuse)


def as_lines(*records: Any) -> bytes:
    return b"".join(
        (r if isinstance(r, bytes) else json.dumps(r).encode()) + b"\n" for r in records
    )


class Live:
    """A running process, of which the lines are read as they come."""

    def __init__(self, folder: Path, *arguments: str | Path, true: bool = False) -> None:
        if true:
            start = [sys.executable, "-m", "ubl_graph"]
        else:
            (folder / "stand_in.py").write_text(STAND_IN)
            start = [sys.executable, str(folder / "stand_in.py")]
        self._stderr = (folder / "stderr").open("w+")
        self.process = subprocess.Popen(
            [*start, "live", *map(str, arguments)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            cwd=folder,
        )
        self._answers: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        for text in self.process.stdout:
            self._answers.put(strict(text))
        self._answers.put(None)

    def write(self, content: bytes) -> None:
        self.process.stdin.write(content)
        self.process.stdin.flush()

    def say(self, *records: Any) -> None:
        self.write(as_lines(*records))

    def answer(self) -> dict[str, Any]:
        answer = self._answers.get(timeout=LONG)
        assert answer is not None, self.stderr
        return answer

    def ask(self, record: Any) -> dict[str, Any]:
        self.say(record)
        return self.answer()

    def rest(self) -> list[dict[str, Any]]:
        """What is written until the end of the output."""
        answers = list(iter(lambda: self._answers.get(timeout=LONG), None))
        self.process.wait(LONG)
        return answers

    def finish(self) -> list[dict[str, Any]]:
        self.process.stdin.close()
        return self.rest()

    @property
    def stderr(self) -> str:
        return Path(self._stderr.name).read_text()

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self._reader.join()
        self.process.stdin.close()
        self.process.stdout.close()
        self._stderr.close()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "auv.toml").write_text(CONFIG)
    return tmp_path


@pytest.fixture
def live(folder: Path) -> Iterator[Live]:
    with closing(Live(folder, "auv.toml")) as process:
        yield process


# Lines


def test_every_line_is_answered_before_the_next_is_written(live):
    for k in range(5):
        answer = live.ask({**PING, "t_receive": 1.0 + 0.1 * k})
        assert answer["type"] == "estimate"
    live.say(DEPTH)
    assert live.ask({"type": "health"})["count"] == 6
    assert live.ask(b"nonsense")["record"] == "nonsense"
    (health,) = live.finish()
    assert (health["type"], health["lines"], health["refused_lines"]) == ("health", 8, 1)
    assert live.process.returncode == 0
    assert live.stderr == ""


def test_lines_may_come_together_or_in_pieces(live):
    live.write(as_lines({"type": "query", "t": 1.0}, b"", {"type": "query", "t": 2.0}))
    assert [live.answer()["t"], live.answer()["t"]] == [1.0, 2.0]
    for piece in (b'{"type": "que', b'ry", "t"', b": 3.0}\r", b'\n{"type":'):
        live.write(piece)
        time.sleep(0.02)
    assert live.answer()["t"] == 3.0
    live.write(b' "query", "t": 4.0}')  # the last line has no end
    answers = live.finish()
    assert [a["type"] for a in answers] == ["estimate", "health"]
    assert answers[0]["t"] == 4.0


def test_an_empty_input_ends_with_health_and_0(live):
    (health,) = live.finish()
    assert (health["type"], health["lines"]) == ("health", 0)
    assert live.process.returncode == 0


def test_a_line_without_end_is_not_kept(live):
    live.write(b"x" * (3 * MAX_LINE) + b"\n")
    assert "more than 1000000 bytes" in live.answer()["reason"]
    assert live.ask(PING)["type"] == "estimate"


def test_nothing_but_lines_of_json_is_on_standard_output(live):
    live.say({**DEPTH, "depth": 11.0})
    assert live.ask(PING)["type"] == "estimate"
    (health,) = live.finish()
    assert health["type"] == "health"
    assert "printed by its C++ code" in live.stderr
    assert "printed by the library" in live.stderr


def test_a_fault_of_the_library_does_not_end_the_process(live):
    answer = live.ask({**DEPTH, "depth": 12.0})
    assert (answer["type"], answer["reason"]) == (
        "rejected",
        "internal error: RuntimeError: a fault",
    )
    assert live.ask(PING)["type"] == "estimate"
    (health,) = live.finish()
    assert health["internal_errors"] == 1
    assert live.process.returncode == 0


def test_a_file_may_be_the_input(folder):
    (folder / "log").write_bytes(as_lines(PING, DEPTH, PING))
    (folder / "stand_in.py").write_text(STAND_IN)
    with (folder / "log").open("rb") as log:
        done = subprocess.run(
            [sys.executable, "stand_in.py", "live", "auv.toml"],
            stdin=log,
            capture_output=True,
            cwd=folder,
        )
    answers = [strict(line) for line in done.stdout.splitlines()]
    assert [a["type"] for a in answers] == ["estimate", "estimate", "health"]
    assert (done.returncode, done.stderr) == (0, b"")


# Ends


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_while_it_waits_ends_it_in_good_order(live, number):
    live.ask(PING)
    live.write(b'{"type": "half a li')
    live.process.send_signal(number)
    (health,) = live.rest()
    assert (health["type"], health["count"], health["lines"]) == ("health", 1, 1)
    assert live.process.returncode == 0
    assert live.stderr == ""


def test_a_signal_while_it_works_waits_for_the_line_and_no_more(live):
    live.ask(PING)
    live.say({**DEPTH, "depth": 13.0}, *[PING] * 3)
    time.sleep(0.3)
    live.process.send_signal(signal.SIGTERM)
    live.process.send_signal(signal.SIGTERM)
    (health,) = live.rest()
    assert (health["type"], health["count"]) == ("health", 2)
    assert live.process.returncode == 0


def test_a_closed_output_pipe_ends_it_quietly_with_a_checkpoint(folder):
    (folder / "stand_in.py").write_text(STAND_IN)
    process = subprocess.Popen(
        [sys.executable, "stand_in.py", "live", "auv.toml", "--checkpoint", "state"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=folder,
    )
    process.stdout.close()
    process.stdin.write(as_lines(DEPTH, PING, PING))
    process.stdin.flush()
    assert process.wait(LONG) == 0
    assert process.stderr.read() == b""
    assert (folder / "state").exists()
    process.stderr.close()
    process.stdin.close()


def test_a_reader_that_does_not_read_cannot_hold_it_back_from_stopping(folder):
    (folder / "stand_in.py").write_text(STAND_IN)
    (folder / "log").write_bytes(as_lines(PING, *[b'{"type": "query"}'] * 20_000))
    with (folder / "log").open("rb") as log:
        process = subprocess.Popen(
            [sys.executable, "stand_in.py", "live", "auv.toml", "--checkpoint", "state"],
            stdin=log,
            stdout=subprocess.PIPE,
            cwd=folder,
        )
    assert select.select([process.stdout], [], [], LONG)[0]
    time.sleep(0.5)  # enough for the pipe to fill
    (folder / "state").unlink()
    process.terminate()
    assert process.wait(LONG) == 0
    assert (folder / "state").exists()
    process.stdout.close()


# Checkpoints


def test_it_resumes_after_a_kill(folder):
    with closing(Live(folder, "auv.toml", "--checkpoint", "state")) as live:
        live.say(DEPTH, DEPTH)
        live.ask(PING)
        live.ask({"type": "health"})  # what comes after a ping is answered after its checkpoint
        live.process.kill()
    with closing(Live(folder, "auv.toml", "--checkpoint", "state")) as live:
        health = live.ask({"type": "health"})
        assert (health["count"], health["resumed"], health["lines"]) == (3, True, 1)
        live.say(DEPTH)
        live.finish()
    with closing(Live(folder, "auv.toml", "--checkpoint", "state")) as live:
        assert live.ask({"type": "health"})["count"] == 4


def test_a_checkpoint_that_fails_is_reported_and_the_process_goes_on(folder):
    (folder / "there").mkdir()
    with closing(Live(folder, "auv.toml", "--checkpoint", "there/state")) as live:
        live.ask(PING)
        assert live.ask({"type": "health"})["checkpoint_error"] is None
        (folder / "there" / "state").unlink()
        (folder / "there").rmdir()
        for k in range(1, 6):
            time.sleep(0.02)
            live.ask({**PING, "t_transmit": 10.0 * k, "t_receive": 10.0 * k + 1.0})
        assert "No such file" in live.ask({"type": "health"})["checkpoint_error"]
        live.finish()
        assert live.process.returncode == 0
        assert len(live.stderr.splitlines()) == 1
        assert "no checkpoint could be written" in live.stderr


def refusal(folder: Path, *arguments: str, **options: Any) -> str:
    """The one line that a process which does not start leaves."""
    (folder / "stand_in.py").write_text(STAND_IN)
    done = subprocess.run(
        [sys.executable, "stand_in.py", "live", *arguments],
        **{"input": as_lines(PING), "capture_output": True, "cwd": folder, **options},
    )
    assert done.returncode == 2, done.stderr
    assert not done.stdout
    (said,) = done.stderr.decode().splitlines()
    assert said.startswith("ubl-graph: ")
    return said


def test_a_bad_checkpoint_is_refused(folder):
    (folder / "state").write_text("no state")
    assert "state: this is no checkpoint" in refusal(folder, "auv.toml", "--checkpoint", "state")
    assert (folder / "state").read_text() == "no state"


def test_another_configurations_checkpoint_is_refused(folder):
    with closing(Live(folder, "auv.toml", "--checkpoint", "state")) as live:
        live.ask(PING)
        live.finish()
    (folder / "auv.toml").write_text(CONFIG.replace("1500", "1510"))
    said = refusal(folder, "auv.toml", "--checkpoint", "state")
    assert "made with another configuration than auv.toml" in said
    assert said.startswith("ubl-graph: state: ")


@pytest.mark.parametrize(
    ("place", "said"),
    [
        ("nowhere/state", "no checkpoint can be written there"),
        (".", "this is a folder"),
        ("auv.toml/state", "no checkpoint can be written there"),
        ("auv.toml", "this is no checkpoint"),
    ],
)
def test_a_place_for_no_checkpoint_is_refused_at_the_start(folder, place, said):
    assert said in refusal(folder, "auv.toml", "--checkpoint", place)
    assert (folder / "auv.toml").read_text() == CONFIG


# Starts


def test_a_bad_configuration_is_refused(folder):
    assert "no such file" in refusal(folder, "avu.toml")
    (folder / "auv.toml").write_text(CONFIG + '[data]\ntwo_way_range = "ranges.csv"\n')
    said = refusal(folder, "auv.toml")
    assert "auv.toml, field 'data': the configuration of a live process has no data" in said
    (folder / "auv.toml").write_text(CONFIG + "[options]\nacceleration = 1\n")
    assert "unknown key 'acceleration'" in refusal(folder, "auv.toml")


def test_a_closed_input_is_refused(folder):
    (folder / "stand_in.py").write_text(STAND_IN)
    done = subprocess.run(
        f"{sys.executable} stand_in.py live auv.toml <&-",
        shell=True,
        capture_output=True,
        text=True,
        cwd=folder,
    )
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert "standard input is closed" in line


def test_an_output_that_cannot_be_written_is_refused(folder):
    (folder / "stand_in.py").write_text(STAND_IN)
    command = f"{sys.executable} stand_in.py live auv.toml --checkpoint state"
    for redirection, said in {">&-": "is closed", "> /dev/full": "cannot be written"}.items():
        done = subprocess.run(
            f"{command} {redirection}",
            shell=True,
            input=as_lines(PING, PING),
            stderr=subprocess.PIPE,
            cwd=folder,
        )
        assert done.returncode == 2
        (line,) = done.stderr.decode().splitlines()
        assert f"standard output {said}" in line
    assert (folder / "state").exists()


def test_a_closed_standard_error_does_not_matter(folder):
    (folder / "stand_in.py").write_text(STAND_IN)
    done = subprocess.run(
        f"{sys.executable} stand_in.py live auv.toml 2>&-",
        shell=True,
        input=as_lines({**DEPTH, "depth": 11.0}, PING),
        stdout=subprocess.PIPE,
        cwd=folder,
    )
    assert [strict(line)["type"] for line in done.stdout.splitlines()] == ["estimate", "health"]
    assert done.returncode == 0


def test_help_shows_how_to_start_and_what_to_say():
    done = subprocess.run(
        [sys.executable, "-m", "ubl_graph", "live", "--help"],
        capture_output=True,
        text=True,
        env={**os.environ, "COLUMNS": "120"},
    )
    assert done.returncode == 0
    for text in (
        "ubl-graph live vehicle.toml --checkpoint vehicle.state",
        '{"type": "query", "t": 12.0}',
        "--udp",
        "A mission file without its data table.",
    ):
        assert text in done.stdout


# Datagrams


def test_datagrams_are_taken_on_the_loopback(folder):
    with (
        closing(Live(folder, "auv.toml", "--udp", "0")) as live,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        begin = time.monotonic()
        while "\n" not in live.stderr and time.monotonic() - begin < LONG:
            time.sleep(0.02)
        assert "listening on 127.0.0.1, UDP port " in live.stderr
        there = ("127.0.0.1", int(live.stderr.split()[-1]))
        sender.sendto(json.dumps(PING).encode(), there)
        assert live.answer()["type"] == "estimate"
        sender.sendto(as_lines({"type": "query", "t": 5.0}, b"", DEPTH, {"type": "health"}), there)
        assert live.answer()["t"] == 5.0
        assert live.answer()["count"] == 2
        sender.sendto(b"\xff\xfe", there)
        assert live.answer()["type"] == "rejected"
        sender.sendto(b"", there)
        live.process.send_signal(signal.SIGTERM)
        (health,) = live.rest()
        assert (health["type"], health["lines"]) == ("health", 5)
        assert live.process.returncode == 0


def test_a_port_that_is_taken_is_refused(folder):
    with udp_socket(0) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ConfigurationError, match=f"UDP port {port} cannot be had"):
            udp_socket(port).__enter__()
        assert "cannot be had" in refusal(folder, "auv.toml", "--udp", str(port))


# Streams


def never() -> bool:
    return False


@given(
    st.lists(st.binary(max_size=20).map(lambda b: b.replace(b"\n", b"")), max_size=8),
    st.lists(st.integers(0, 200), max_size=8),
)
def test_lines_are_the_same_however_the_stream_is_cut(lines, places):
    stream = b"\n".join(lines)
    cuts = sorted({0, len(stream), *(min(p, len(stream)) for p in places)})
    cutter = LineCutter()
    found = [line for a, b in pairwise(cuts) for line in cutter.feed(stream[a:b])]
    assert [*found, cutter.rest()] == (lines or [b""])


def test_of_a_line_that_is_too_long_the_beginning_is_kept():
    cutter = LineCutter()
    for _ in range(5):
        assert cutter.feed(b"x" * (MAX_LINE // 2)) == []
    assert cutter.feed(b"x\ny\n") == [b"x" * (MAX_LINE + 1), b"y"]


@pytest.fixture
def pipe() -> Iterator[list[int]]:
    ends = list(os.pipe())
    yield ends
    for end in ends:
        os.close(end)


def test_a_pipe_that_would_block_is_waited_for(pipe):
    os.set_blocking(pipe[0], False)
    thread = threading.Timer(0.1, lambda: os.write(pipe[1], b"one\ntwo\n"))
    thread.start()
    seen = list(itertools.islice(lines_of(pipe[0], never), 2))
    thread.join()
    assert seen == [b"one", b"two"]


def test_nothing_is_handed_on_after_a_stop(pipe):
    os.write(pipe[1], b"one\ntwo\nthree\n")
    stops = iter([False, False, True])
    assert list(lines_of(pipe[0], lambda: next(stops))) == [b"one"]


def test_an_input_that_fails_is_named(tmp_path):
    folder = os.open(tmp_path, os.O_RDONLY)
    with pytest.raises(DataError, match="standard input cannot be read"):
        next(lines_of(folder, never))
    os.close(folder)


def test_a_stop_ends_the_wait_for_datagrams():
    with udp_socket(0) as receiver:
        begin = time.monotonic()
        assert list(lines_received(receiver, lambda: time.monotonic() - begin > 0.1)) == []


@pytest.mark.parametrize("blocking", [True, False])
def test_a_long_line_is_written_whole_to_a_slow_reader(pipe, blocking):
    os.set_blocking(pipe[1], blocking)
    line = "0123456789" * 50_000
    parts: list[bytes] = []

    def read() -> None:
        while sum(map(len, parts)) < len(line) + 1:
            parts.append(os.read(pipe[0], 30_000))

    thread = threading.Thread(target=read)
    thread.start()
    LineWriter(pipe[1], never)(line)
    thread.join()
    assert b"".join(parts).decode() == line + "\n"


def test_after_a_stop_a_reader_that_does_not_read_is_left(pipe, monkeypatch):
    monkeypatch.setattr(streams, "LAST_PATIENCE", 0.1)
    with pytest.raises(BrokenPipeError):
        LineWriter(pipe[1], lambda: True)("x" * 1_000_000)


# The true estimator


def mission_lines(mission: Mission) -> list[dict[str, Any]]:
    """The records of a mission as they would come in, each when it is complete."""
    (segment,) = mission.segments
    rows = [records[k] for records in segment.records().values() for k in range(len(records))]
    contents = [record_content(row) for row in rows]
    return sorted(contents, key=lambda c: c.get("t_receive", c.get("t")))


def mission_config(mission: Mission) -> str:
    speed = mission.sound_speed.speed[0]
    text = f"[sound_speed]\nconstant = {speed}\n"
    for beacon in mission.beacons:
        east, north, up = beacon.position
        text += (
            f'[[beacon]]\nname = "{beacon.name}"\nturnaround = {beacon.turnaround}\n'
            f"position = {{ east = {east}, north = {north}, up = {up} }}\n"
        )
    return text


@pytest.fixture(scope="module")
def passage() -> tuple[list[dict[str, Any]], str, Any]:
    mission, truth = straight_pass(duration=100.0, ping_interval=2.0)
    return mission_lines(mission), mission_config(mission), truth


@pytest.fixture
def dive(tmp_path: Path, passage) -> Path:
    (tmp_path / "auv.toml").write_text(passage[1])
    return tmp_path


def check_estimate(answer: dict[str, Any], truth: Any) -> None:
    """The position is there, and no farther from the truth than its covariance allows."""
    position = np.array([answer[k] for k in ("east", "north", "up")])
    velocity = np.array([answer[k] for k in ("v_east", "v_north", "v_up")])
    covariance = np.array(answer["covariance"]).reshape(6, 6)
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-9)
    expected = truth_at(truth, answer["t"])
    error = np.concatenate([position, velocity]) - expected
    assert error @ np.linalg.solve(covariance, error) < 40.0
    assert np.linalg.norm(error[:3]) < 10.0


def parsed_setup(text: str) -> Setup:
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "auv.toml").write_text(text)
        return load_setup(Path(folder) / "auv.toml")


def truth_at(truth: Any, t: float) -> np.ndarray:
    """Position and velocity of the straight pass."""
    begin, later = truth.reference(np.array([0.0, 10.0])).position
    velocity = (later - begin) / 10.0
    return np.concatenate([begin + velocity * t, velocity])


def test_a_mission_in_lock_step(dive, passage):
    records, _, truth = passage
    pings = [r for r in records if r["type"] == "two_way_range"]
    estimates = []
    with closing(Live(dive, "auv.toml", true=True)) as live:
        for record in records:
            live.say(record)
            if record["type"] == "two_way_range":
                answer = live.answer()
                assert answer["type"] == "estimate", answer
                estimates.append(answer)
        estimates.append(live.ask({"type": "query", "t": pings[-1]["t_receive"] + 1.5}))
        (health,) = live.finish()
        assert live.process.returncode == 0
        assert live.stderr == ""
    assert (health["type"], health["internal_errors"]) == ("health", 0)
    stamps = [e["t"] for e in estimates]
    assert all(a < b for a, b in pairwise(stamps))
    known = [e for e in estimates if e["status"] != "initialising"]
    assert len(known) > len(pings) // 2
    for estimate in known[-10:]:
        check_estimate(estimate, truth)


JUNK: list[Any] = [
    b"nonsense",
    b"\xff\xff",
    b'{"type": "depth", "t": 20, "depth": NaN}',
    {"type": "depth", "t": 20.0, "depth": 60.0, "sgima": 1.0},
    {"type": "two_way_range", "beacon": "B9", "t_transmit": 20.0, "t_receive": 21.0},
    {"type": "velocity", "t": 20.0, "forward": "1", "right": 0, "down": 0},
    {"type": "velocity", "t": 20.0, "forward": 1, "right": 0, "down": 0, "reference": "water"},
    {"type": "querry"},
]


def test_refused_lines_leave_the_estimate_untouched(dive, passage):
    records, *_ = passage
    answers = []
    for junk in ([], JUNK):
        lines = [x for k, r in enumerate(records) for x in ([r, *junk] if k == 50 else [r])]
        done = subprocess.run(
            [sys.executable, "-m", "ubl_graph", "live", "auv.toml"],
            input=as_lines(*lines),
            capture_output=True,
            cwd=dive,
        )
        assert (done.returncode, done.stderr) == (0, b"")
        answers.append([strict(line) for line in done.stdout.splitlines()])
    clean, spoilt = ([a for a in found if a["type"] == "estimate"] for found in answers)
    assert clean == spoilt
    assert len(clean) + sum(a["type"] == "rejected" for a in answers[0]) == sum(
        r["type"] == "two_way_range" for r in records
    )
    assert sum(a["type"] == "rejected" for a in answers[1]) - sum(
        a["type"] == "rejected" for a in answers[0]
    ) == len(JUNK)
    assert answers[1][-1]["type"] == "health"


def test_a_kill_loses_nothing_that_is_sent_again(dive, passage):
    records, _, truth = passage
    half = len(records) // 2
    with closing(Live(dive, "auv.toml", "--checkpoint", "state", true=True)) as live:
        live.say(*records[:half], {"type": "health"})
        while live.answer()["type"] != "health":
            pass
        live.process.kill()
    with closing(Live(dive, "auv.toml", "--checkpoint", "state", true=True)) as live:
        # The client cannot know what the checkpoint holds: it sends the last seconds once more.
        live.say(*records[half - 20 :])
        answers = live.finish()
        assert live.process.returncode == 0
    assert answers[-1]["resumed"] is True
    assert any("duplicate" in a.get("reason", "") for a in answers)
    estimates = [a for a in answers if a["type"] == "estimate"]
    assert all(e["status"] != "initialising" for e in estimates)
    check_estimate(estimates[-1], truth)


def test_a_true_checkpoint_that_is_broken_or_foreign_is_refused(dive, passage):
    with closing(Live(dive, "auv.toml", "--checkpoint", "state", true=True)) as live:
        live.say(*passage[0][:40])
        live.finish()
    (dive / "cut").write_bytes((dive / "state").read_bytes()[:-20])
    (dive / "other.toml").write_text(passage[1].replace("turnaround = 0.2", "turnaround = 0.3"))
    for arguments, said in {
        ("auv.toml", "cut"): "cut",
        ("other.toml", "state"): "another configuration than other.toml",
    }.items():
        done = subprocess.run(
            [sys.executable, "-m", "ubl_graph", "live", arguments[0], "--checkpoint", arguments[1]],
            input="",
            capture_output=True,
            text=True,
            cwd=dive,
        )
        assert done.returncode == 2
        assert done.stdout == ""
        (line,) = done.stderr.splitlines()
        assert said in line


def test_a_signal_ends_the_true_process_in_good_order(dive, passage):
    with closing(Live(dive, "auv.toml", true=True)) as live:
        live.say(*passage[0][:40], {"type": "query"})
        while live.answer()["type"] != "estimate":
            pass
        live.process.send_signal(signal.SIGTERM)
        assert live.rest()[-1]["type"] == "health"
        assert live.process.returncode == 0
        assert live.stderr == ""


def disturbed(records: list[dict[str, Any]], seed: int) -> Iterator[dict[str, Any]]:
    """A mission's records with what can go wrong at sea, and in whoever sends them."""
    rng = np.random.default_rng(seed)
    offset = 0.0
    for k, record in enumerate(records):
        t = record.get("t_receive", record.get("t"))
        kind = int(rng.integers(40))
        spoilt: list[dict[str, Any]] = [record]
        if kind == 0:
            spoilt.append(records[max(k - int(rng.integers(30)), 0)])
        elif kind == 1:
            offset += float(rng.choice([1e-3, 0.5, 20.0, 1000.0, 1e6, -0.5, -20.0, -1000.0]))
        elif kind == 2 and "travel_time" in record:
            factor = float(rng.choice([0.5, 1.01, 2.0]))
            spoilt = [{**record, "travel_time": record["travel_time"] * factor}]
        elif kind == 3:
            spoilt = [{**record, "sigma": float(rng.choice([1e-6, 1.0]))}]
        elif kind == 4:
            sigma = float(rng.choice([1e-3, 1.0, 1e6]))
            east, north = rng.normal(0.0, 1e3, 2).tolist()
            spoilt = [{"type": "position", "t": t, "east": east, "north": north, "sigma": sigma}]
        elif kind == 5:
            spoilt.append({"type": "attitude", "t": t, "heading": float(rng.uniform(-720, 720))})
        elif kind == 6:
            forward = float(rng.uniform(-50.0, 50.0))
            spoilt.append({"type": "velocity", "t": t, "forward": forward, "right": 0, "down": 0})
        elif kind == 7:
            spoilt.append({"type": "depth", "t": t, "depth": float(rng.uniform(-1000, 12000))})
        elif kind == 8:
            spoilt.append({"type": "query", "t": t + float(rng.choice([-10.0, 10.0, 3e3, 1e9]))})
        elif kind == 9:
            east = float(rng.normal(0.0, 500.0))
            spoilt.append({"type": "set_position", "t": t, "east": east, "north": 0.0})
        elif kind == 10:
            spoilt.append({"type": str(rng.choice(["reset", "health"]))})
        for one in spoilt:
            yield {k: v + offset if k.startswith("t_") or k == "t" else v for k, v in one.items()}


@pytest.mark.parametrize("seed", range(4))
def test_whatever_comes_is_answered_in_time_and_in_good_order(passage, seed):
    """Slips, clocks that are set, absurd values: one answer each, no fault, nothing that lasts."""
    records, text, _ = passage
    setup = parsed_setup(text)
    lines: list[str] = []
    session = Session(FixedLagEstimator.of(setup), lines.append)
    last = -np.inf
    with np.errstate(all="ignore"):
        for record in disturbed(records, seed):
            lines.clear()
            begin = time.monotonic()
            session.handle(json.dumps(record).encode())
            assert time.monotonic() - begin < 2.0, record
            answers = [strict(line) for line in lines]
            own = [
                a
                for a in answers
                if a["type"] == "estimate" or (a["type"] == "rejected" and a["record"] == record)
            ]
            if record["type"] in ("two_way_range", "position", "set_position", "query"):
                assert len(own) == 1
                assert answers[-1] == own[0]
            for answer in answers:
                assert not str(answer.get("reason")).startswith("internal error"), answer
                if answer["type"] == "estimate":
                    # Only on a clock that was set back by more than the lag outputs begin anew.
                    assert answer["t"] > last or answer["t"] < last - setup.options.lag
                    last = answer["t"]
        lines.clear()
        session.finish()
    assert strict(lines[-1])["internal_errors"] == 0
