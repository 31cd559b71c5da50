"""A client's dialogue with an estimator: which line is answered by what.

Nothing that a client sends or an estimator does ends a session. It knows neither files nor signals
but for the checkpoint's name; `process` gives it these.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar
from weakref import WeakKeyDictionary

from ubl_graph.errors import UblGraphError
from ubl_graph.mission import Start
from ubl_graph.online import protocol
from ubl_graph.online.json_records import record_content
from ubl_graph.online.protocol import (
    HealthRequest,
    Measurement,
    Message,
    Query,
    Refused,
    Reset,
    SetPosition,
    encoded,
    estimate_content,
    verdict_content,
)
from ubl_graph.records import Records

if TYPE_CHECKING:
    from ubl_graph.online.estimator import Event, FixedLagEstimator, Outcome

Answer = TypeVar("Answer")
Warn = Callable[[str], None]

#: A checkpoint is written after a ping once so much data time has passed since the last one, s.
CHECKPOINT_INTERVAL = 1.0
#: The same after records of other kinds: a vehicle that hears no beacon is remembered too, s.
QUIET_INTERVAL = 10.0
#: A checkpoint waits for so many times what the last one took: a fifth of the time is the most.
CHECKPOINT_REST = 4.0


@dataclass
class Counts:
    """What a session counts, as its health line shows it.

    Attributes
    ----------
    lines : int
        Lines that came, but for blank ones.
    refused_lines : int
        Of these, the ones that were no record; the estimator never saw them.
    internal_errors : int
        Errors of this library, not of the data.
    last_internal_error : str or None
        The newest of them.
    checkpoints : int
        Checkpoints written.
    checkpoint_error : str or None
        Why the newest attempt at a checkpoint failed; None where it did not.
    resumed : bool
        Whether the session began with a checkpoint.
    """

    lines: int = 0
    refused_lines: int = 0
    internal_errors: int = 0
    last_internal_error: str | None = None
    checkpoints: int = 0
    checkpoint_error: str | None = None
    resumed: bool = False


@dataclass(frozen=True)
class Failure:
    """What a call of the estimator came to where it failed: the sentence that says why."""

    reason: str


class Checkpoints:
    """When a checkpoint is due: often enough to lose little, seldom enough to cost little.

    Parameters
    ----------
    file : path or None
        None where none are wanted.
    clock : callable
        Wall time, s.
    lag : float
        No record is taken that is older than this, s, unless the vehicle's clock was set back.
    """

    def __init__(self, file: Path | None, clock: Callable[[], float], lag: float) -> None:
        self.file, self._clock, self._lag = file, clock, lag
        self._newest = self._saved = -math.inf
        self._begun = math.inf
        self._wanted = False
        self._not_before = -math.inf

    @property
    def due(self) -> bool:
        """Whether to write one now."""
        return self._wanted and self.file is not None and self._clock() >= self._not_before

    def passed(self, t: float, *, ping: bool) -> None:
        """Note a record of time `t` (s) that the estimator took."""
        if t < self._newest - self._lag:
            self.changed()
        self._newest, self._begun = max(t, self._newest), min(t, self._begun)
        due = self._saved + CHECKPOINT_INTERVAL
        if not ping:
            due = max(self._saved, self._begun) + QUIET_INTERVAL
        self._wanted |= self._newest >= due

    def changed(self) -> None:
        """Note that the estimate was changed by other than records, or that time begins anew."""
        self._newest, self._saved, self._begun = -math.inf, -math.inf, math.inf
        self._wanted = True

    @contextmanager
    def writing(self) -> Generator[None]:
        """Time the writing of one."""
        begin = self._clock()
        yield
        end = self._clock()
        self._not_before = end + CHECKPOINT_REST * (end - begin)
        self._saved, self._wanted = self._newest, False


class Session:
    """A client's dialogue with an estimator.

    Parameters
    ----------
    estimator : FixedLagEstimator
    write : callable
        Takes a line of output, without its end. What it raises passes through.
    checkpoint : path, optional
        File to keep checkpoints in.
    warn : callable, optional
        Takes a sentence for whoever looks after the process.
    resumed : bool
        Whether the estimator comes from a checkpoint; shown in the health line.
    clock : callable, optional
        Wall time, s.

    Attributes
    ----------
    counts : Counts
    """

    def __init__(
        self,
        estimator: FixedLagEstimator,
        write: Callable[[str], None],
        checkpoint: Path | None = None,
        *,
        warn: Warn = lambda _: None,
        resumed: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.counts = Counts(resumed=resumed)
        self._estimator, self._write, self._warn = estimator, write, warn
        self._setup = estimator.setup
        # As long as the estimator keeps a record, and no longer, its line is remembered.
        self._came: WeakKeyDictionary[Records, dict[str, Any]] = WeakKeyDictionary()
        self._checkpoints = Checkpoints(checkpoint, clock, self._setup.options.lag)

    def handle(self, line: bytes) -> None:
        """Answer one line; whatever it holds, the session goes on.

        Parameters
        ----------
        line : bytes
            With or without its end.
        """
        message = protocol.parse(line, self._setup)
        if message is None:
            return
        self.counts.lines += 1
        if isinstance(message, Refused):
            self.counts.refused_lines += 1
            self._put(verdict_content("rejected", message.reason, message.came))
            return
        self._answer(message)
        if self._checkpoints.due:
            self.save()

    def finish(self) -> None:
        """Decide what is still open, keep a checkpoint, and write how it went."""
        events = self._tried(self._estimator.flush)
        try:
            if not isinstance(events, Failure):
                self._report(events)
        finally:  # a client that no longer reads loses its lines, not the state
            self.save()
        self._health()

    def save(self) -> None:
        """Write a checkpoint, where there is a file for it; a failure is reported, not raised."""
        file = self._checkpoints.file
        if file is None:
            return
        with self._checkpoints.writing():
            done = self._tried(lambda: self._estimator.checkpoint(file))
        if not isinstance(done, Failure):
            self.counts.checkpoints += 1
            self.counts.checkpoint_error = None
            return
        if self.counts.checkpoint_error is None:
            self._warn(f"no checkpoint could be written: {done.reason}")
        self.counts.checkpoint_error = done.reason

    def _answer(self, message: Message) -> None:
        came = message.came
        match message:
            case Measurement():
                self._measure(message)
            case Query():
                self._estimate(came, message.t)
            case SetPosition():
                own = Start(**message.values)
                self._judge(came, own, lambda: self._estimator.set_position(**message.values))
                self._checkpoints.changed()
            case Reset():
                done = self._tried(self._estimator.reset)
                if isinstance(done, Failure):
                    self._put(verdict_content("rejected", done.reason, came))
                self._checkpoints.changed()
            case HealthRequest():
                self._health()

    def _measure(self, message: Measurement) -> None:
        record, locates = message.record, message.locates
        self._came[record] = message.came
        if self._judge(message.came, record, lambda: self._estimator.add(record), locates):
            self._checkpoints.passed(message.t, ping=locates)

    def _judge(
        self,
        came: dict[str, Any],
        own: Records | Start,
        add: Callable[[], Outcome],
        answered: bool = True,
    ) -> bool:
        """Write what becomes of a record, or the estimate that answers it; say whether it is in."""
        outcome = self._tried(add)
        if isinstance(outcome, Failure):
            self._put(verdict_content("rejected", outcome.reason, came))
            return False
        # The record itself has a line of its own.
        self._report(event for event in outcome.others if event.record != own)
        if not outcome.accepted:
            self._put(verdict_content("rejected", outcome.reason, came, final=outcome.final))
        elif answered:
            self._estimate(came, failed="the record is in, but there is no estimate: ")
        return outcome.accepted

    def _estimate(self, came: dict[str, Any], t: float | None = None, failed: str = "") -> None:
        line = self._tried(lambda: encoded(estimate_content(self._estimator.estimate(t), t)))
        if isinstance(line, Failure):
            self._put(verdict_content("rejected", failed + line.reason, came))
        else:
            self._write(line)

    def _report(self, events: Iterable[Event]) -> None:
        for event in events:
            record = event.record
            came = self._came.get(record) if isinstance(record, Records) else None
            came = came or record_content(record)
            self._put(verdict_content(event.kind, event.reason, came, final=event.final))

    def _health(self) -> None:
        # Encoded within the attempt: what is no strict JSON is a fault like any other.
        told = self._tried(lambda: encoded(self._estimator.health()))
        estimator = {} if isinstance(told, Failure) else json.loads(told)
        self._put({"type": "health", **estimator, **asdict(self.counts)})

    def _put(self, content: dict[str, Any]) -> None:
        self._write(encoded(content))

    def _tried(self, call: Callable[[], Answer]) -> Answer | Failure:
        """Call the estimator; its refusals and its faults become a sentence."""
        try:
            return call()
        except UblGraphError as error:
            return Failure(protocol.reason(error))
        except OSError as error:
            return Failure(str(error))
        except Exception as error:
            # A fault of the library must not silence a vehicle: it is said and counted, and the
            # next line may fare better.
            self.counts.internal_errors += 1
            text = " ".join(f"internal error: {type(error).__name__}: {error}".split())
            self.counts.last_internal_error = text
            return Failure(text)
