"""Many cases through one function: on worker processes, on a cluster, with the same results.

>>> from ubl_graph.sim import straight_pass
>>> from ubl_graph.smoother import smooth
>>> from ubl_graph.workers import SerialExecutor
>>> def largest_error(noise, seed):
...     mission, truth = straight_pass(seed, duration=60.0, noise=noise)
...     track = smooth(mission).trajectory
...     return float(abs(track.position - truth.position(track.t)).max())
>>> study = run_study(largest_error, [1.0, 2.0, "loud"], seed=7, executor=SerialExecutor())
>>> study.results[0] < study.results[1] < 10.0
True
>>> [(failure.case, failure.error.type) for failure in study.failures]
[('loud', 'TypeError')]

Without `executor`, a process pool takes the cases; the function must then stand at the top of a
module, and a script must call `run_study` under ``if __name__ == "__main__":``. Scripts that
run several studies, or may run them on a cluster, open an executor once::

    with executor_at(scheduler) as executor:        # None: processes here
        study = run_study(largest_error, noises, seed=7, executor=executor, progress=report)
"""

from __future__ import annotations

import pickle
import time
import traceback
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from contextlib import closing, nullcontext
from dataclasses import dataclass
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np

from ubl_graph.errors import ConfigurationError
from ubl_graph.workers import ProcessPool, SerialExecutor, executor_at, processors

if TYPE_CHECKING:
    from ubl_graph.work import Progress

__all__ = [
    "CaseError",
    "CaseOutcome",
    "ProcessPool",
    "SerialExecutor",
    "Study",
    "case_seeds",
    "executor_at",
    "iter_study",
    "run_study",
]

C = TypeVar("C")
V = TypeVar("V")

#: Cases travel in about so many bundles: few enough that sending them costs little beside cases
#: of some milliseconds, many enough that all workers end at about the same time.
BUNDLES = 256
#: A bundle is lost with its worker, and progress goes by bundles.
LARGEST_BUNDLE = 32


@dataclass(frozen=True)
class CaseError:
    """Why a case failed.

    Attributes
    ----------
    type, message : str
        Of the exception.
    traceback : str
        Where it was raised, as Python prints it; empty where the worker itself was lost.
    """

    type: str
    message: str
    traceback: str = ""

    def __str__(self) -> str:
        return f"{self.type}: {' '.join(self.message.split())}".rstrip(": ")


@dataclass(frozen=True, eq=False)
class CaseOutcome(Generic[C, V]):
    """What became of one case.

    Attributes
    ----------
    index : int
        Place of the case among the cases, from 0.
    case : object
        As given.
    seed : int
        What the function was given with it: ``function(case, seed)`` does it once more.
    value : object or None
        What the function returned; None where it failed.
    error : CaseError or None
        Why it failed; None where it did not.
    seconds : float
        Time that the function took, s; 0 where its worker was lost.
    """

    index: int
    case: C
    seed: int
    value: V | None
    error: CaseError | None
    seconds: float

    def summary(self) -> str:
        """One line: the case, its seed, and why it failed or how long it took."""
        end = f"{self.seconds:.3g} s" if self.error is None else str(self.error)
        return f"case {self.index} (seed {self.seed}): {end}"


@dataclass(frozen=True, eq=False)
class Study(Generic[C, V]):
    """What became of all cases.

    Attributes
    ----------
    outcomes : tuple of CaseOutcome
        One per case, in the cases' order.
    """

    outcomes: tuple[CaseOutcome[C, V], ...]

    @property
    def results(self) -> list[V]:
        """What the function returned, in the cases' order, without the cases that failed."""
        # A function may return None: what is None by failure is told by the error alone.
        return [o.value for o in self.outcomes if o.error is None]  # type: ignore[misc]

    @property
    def failures(self) -> list[CaseOutcome[C, V]]:
        """The cases that failed, in order."""
        return [o for o in self.outcomes if o.error is not None]


def run_study(
    function: Callable[[C, int], V],
    cases: Sequence[C],
    *,
    seed: int = 0,
    executor: Executor | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
    bundle: int | None = None,
) -> Study[C, V]:
    """Call ``function(case, seed)`` for every case; the seeds follow from `seed` and the order.

    The results are the same whatever the executor, the number of workers, and the order in which
    cases end. A case that raises is reported and does not end the study. One whose worker dies is
    tried once more when all others are through, alone; if it dies again, that is reported.

    Parameters
    ----------
    function : callable
        Takes a case and its seed. For a process pool it stands at the top of a module. What it
        returns must be picklable.
    cases : sequence
        One item per case, picklable.
    seed : int
        Each case's own seed is derived from it (`case_seeds`).
    executor : concurrent.futures.Executor, optional
        Where the cases run, and it stays open: `ProcessPool`, `SerialExecutor`, what `executor_at`
        gives, or any other. If None, a process pool that lives as long as the study.
    workers : int, optional
        Processes of that pool, one per processor if None; not to be given with `executor`.
    progress : callable, optional
        Called from this thread with a text and the share done, as cases end.
    bundle : int, optional
        Cases sent to a worker at a time. By default 1 for up to 511 cases, and 32 at most: give 1
        for cases that take long.

    Returns
    -------
    Study

    Raises
    ------
    ConfigurationError
        Where seed, workers or bundle are out of range, or worker processes do not start.

    Examples
    --------
    >>> def throw(sides, seed):
    ...     return int(np.random.default_rng(seed).integers(1, sides, endpoint=True))
    >>> run_study(throw, [6, 6, 20, 0], seed=1, executor=SerialExecutor()).results
    [6, 5, 11]
    """
    outcomes = iter_study(
        function,
        cases,
        seed=seed,
        executor=executor,
        workers=workers,
        progress=progress,
        bundle=bundle,
    )
    with closing(outcomes):
        return Study(tuple(sorted(outcomes, key=lambda o: o.index)))


def iter_study(
    function: Callable[[C, int], V],
    cases: Sequence[C],
    *,
    seed: int = 0,
    executor: Executor | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
    bundle: int | None = None,
) -> Generator[CaseOutcome[C, V]]:
    """As `run_study`, but give each outcome as it ends: for values too large to keep them all.

    Close it (`contextlib.closing`) where the loop over it may end early: what still waits is then
    cancelled.
    """
    if executor is not None and workers is not None:
        raise ConfigurationError(
            "workers are given with an executor", "an executor has its own", field="workers"
        )
    if bundle is not None and bundle < 1:
        raise ConfigurationError(f"bundles of {bundle} cases", "give 1 or more", field="bundle")
    seeds = case_seeds(seed, len(cases))
    tasks = [_Task(i, case, s) for i, (case, s) in enumerate(zip(cases, seeds, strict=True))]
    size = bundle or min(max(1, len(tasks) // BUNDLES), LARGEST_BUNDLE)
    if executor is None:
        needed = max(1, -(-len(tasks) // size))
        pool = executor = ProcessPool(min(processors(), needed) if workers is None else workers)
    else:
        pool = nullcontext(executor)
    if isinstance(executor, ProcessPool):
        _check_sendable(function)
    return _study(function, tasks, size, pool, progress)


def _check_sendable(function: Callable[..., Any]) -> None:
    """Refuse at once what would fail for every case."""
    try:
        pickle.dumps(function)
    except Exception as error:
        name = getattr(function, "__qualname__", repr(function))
        raise ConfigurationError(
            f"'{name}' cannot be sent to another process ({' '.join(str(error).split())})",
            "define it at the top of a module, or use a SerialExecutor",
            field="function",
        ) from error


def case_seeds(seed: int, count: int) -> list[int]:
    """Seeds of the cases of a study: independent streams, each depending on its place alone.

    Parameters
    ----------
    seed : int
        Of the study, 0 or more.
    count : int
        How many.

    Returns
    -------
    list of int
        From numpy's `SeedSequence`; 53 bits each, so that JSON and tables keep them whole.

    Examples
    --------
    >>> case_seeds(0, 2) == case_seeds(0, 3)[:2]
    True
    """
    if seed < 0:
        raise ConfigurationError(f"the seed is {seed}", "give 0 or more", field="seed")
    children = np.random.SeedSequence(seed).spawn(count)
    return [int(child.generate_state(1, np.uint64)[0] >> np.uint64(11)) for child in children]


@dataclass(frozen=True, eq=False)
class _Task:
    index: int
    case: Any
    seed: int


@dataclass(frozen=True, eq=False)
class _Bundle:
    """Cases on their way to a worker; no tuple, in which dask would look for tasks of its own."""

    function: Callable[[Any, int], Any]
    tasks: Sequence[_Task]

    def run(self) -> list[tuple[Any, CaseError | None, float]]:
        """Call the function for each case; value, error and seconds."""
        return [self._run(task) for task in self.tasks]

    def _run(self, task: _Task) -> tuple[Any, CaseError | None, float]:
        begin = time.perf_counter()
        value, error = None, None
        try:
            value = self.function(task.case, task.seed)
        except (Exception, SystemExit) as raised:
            text = "".join(traceback.format_exception(raised))
            error = CaseError(type(raised).__name__, str(raised), text)
        return value, error, time.perf_counter() - begin


def _run(bundle: _Bundle) -> list[tuple[Any, CaseError | None, float]]:
    return bundle.run()


def _study(
    function: Callable[[Any, int], Any],
    tasks: Sequence[_Task],
    size: int,
    pool: Any,
    progress: Progress | None,
) -> Generator[CaseOutcome[Any, Any]]:
    failed = 0
    with pool as executor:
        run = _Run(function, executor)
        try:
            for done, outcome in enumerate(run.outcomes(tasks, size), start=1):
                failed += outcome.error is not None
                if progress is not None:
                    text = f"{done} of {len(tasks)}" + (f", {failed} failed" if failed else "")
                    progress(text, done / len(tasks))
                yield outcome
        finally:
            run.cancel()


class _Run:
    """Bundles out, outcomes in.

    An exception that a future carries is the executor's, since a bundle catches those of its
    cases: the worker was lost, or something could not be sent.
    """

    def __init__(self, function: Callable[[Any, int], Any], executor: Executor) -> None:
        self._function, self._executor = function, executor
        self._pending: dict[Future[Any], Sequence[_Task]] = {}
        self._done: SimpleQueue[Future[Any]] = SimpleQueue()
        self._lost: list[_Task] = []

    def outcomes(self, tasks: Sequence[_Task], size: int) -> Iterator[CaseOutcome[Any, Any]]:
        """All outcomes, in the order in which they end."""
        for i in range(0, len(tasks), size):
            self._send(tasks[i : i + size])
            # An executor without workers has done it already.
            while not self._done.empty():
                yield from self._settle(self._done.get())
        while self._pending:
            yield from self._settle(self._done.get())
        # Who of those that ran side by side brought a worker down shows when each runs alone.
        for task in sorted(self._lost, key=lambda t: t.index):
            self._send([task])
            yield from self._settle(self._done.get(), again=True)

    def cancel(self) -> None:
        """Let what has not begun never begin."""
        for future in list(self._pending):
            future.cancel()

    def _send(self, tasks: Sequence[_Task]) -> None:
        try:
            future = self._executor.submit(_run, _Bundle(self._function, tasks))
        except BrokenExecutor as error:
            future = Future[Any]()
            future.set_exception(error)
        self._pending[future] = tasks
        future.add_done_callback(self._done.put)

    def _settle(self, future: Future[Any], again: bool = False) -> Iterator[CaseOutcome[Any, Any]]:
        tasks = self._pending.pop(future)
        try:
            results = future.result()
        except ConfigurationError:
            raise
        except (Exception, CancelledError) as error:
            if not again and _is_loss(error):
                self._lost += tasks
            elif len(tasks) > 1:
                for task in tasks:
                    self._send([task])
            else:
                # dask adds advice on its logs to the first sentence.
                reason = CaseError(type(error).__name__, str(error).partition(". ")[0])
                yield CaseOutcome(tasks[0].index, tasks[0].case, tasks[0].seed, None, reason, 0.0)
            return
        for task, (value, error, seconds) in zip(tasks, results, strict=True):
            yield CaseOutcome(task.index, task.case, task.seed, value, error, seconds)


def _is_loss(error: BaseException) -> bool:
    """Whether a worker was lost, and not just something that could not be sent."""
    of_dask = type(error).__module__.startswith("distributed.")
    return of_dask or isinstance(error, BrokenExecutor | CancelledError)
