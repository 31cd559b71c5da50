"""Where the cases of a study run: worker processes here, a dask cluster, or this very process.

All are executors in the sense of `concurrent.futures`: any other will do as well.
"""

from __future__ import annotations

import os
import pickle
import signal
import threading
from collections.abc import Callable, Generator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any, ParamSpec, TypeVar

from ubl_graph.errors import ConfigurationError

P = ParamSpec("P")
T = TypeVar("T")

#: How many threads linear algebra takes, in every library that numpy may stand on.
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
#: A scheduler on the same network answers in milliseconds, s.
CONNECT_TIMEOUT = 10.0
#: A process whose pipe is closed may take so long to end, s.
PATIENCE = 5.0

_starting = threading.Lock()


class WorkerDied(BrokenProcessPool):
    """A worker process ended before its task did."""


class SerialExecutor(Executor):
    """Runs each task at once, in this process: for debuggers, and for what cannot be pickled.

    Examples
    --------
    >>> SerialExecutor().submit(max, 3, 7).result()
    7
    """

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Run `fn(*args, **kwargs)`; the future that comes back is done."""
        future: Future[T] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class ProcessPool(Executor):
    """Worker processes that do not share each other's fate.

    A process that dies (a fault in compiled code, no memory left) fails the one task that it ran,
    with `WorkerDied`; a fresh one takes its place. `concurrent.futures.ProcessPoolExecutor` would
    fail every task and take no more.

    Processes are spawned, not forked: a fork copies locks that threads of BLAS or of the caller
    hold. So functions must be importable (at the top of a module), and a script must start its
    work under ``if __name__ == "__main__":``. Linear algebra gets one thread a process, unless the
    environment says otherwise; an interrupt from the keyboard is left to the parent.

    Parameters
    ----------
    workers : int, optional
        Number of processes; as many as this process has processors if None. They start when there
        is work for them, and stay until `shutdown`.

    Raises
    ------
    ConfigurationError
        Where `workers` is no positive number; from a future, where processes do not start at all.

    Examples
    --------
    >>> with ProcessPool(2) as pool:
    ...     list(pool.map(abs, [-1, 2]))
    [1, 2]
    """

    def __init__(self, workers: int | None = None) -> None:
        count = processors() if workers is None else workers
        if count < 1:
            raise ConfigurationError(f"{count} workers", "give one or more", field="workers")
        self.workers = count
        self._threads = ThreadPoolExecutor(count, thread_name_prefix="ubl_graph-worker")
        self._lock = threading.Lock()
        self._all: set[_Worker] = set()
        self._idle: list[_Worker] = []
        self._open, self._killed = True, False
        self._proven = False

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Have `fn(*args, **kwargs)` run in the next process that is free."""
        return self._threads.submit(self._call, fn, args, kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Take no more tasks; end the processes, each when its task is done."""
        with self._lock:
            self._open = False
        self._threads.shutdown(wait, cancel_futures=cancel_futures)
        with self._lock:
            idle, self._idle = self._idle, []
        for worker in idle:
            self._drop(worker)

    def terminate(self) -> None:
        """End the processes at once, whatever they do."""
        with self._lock:
            self._open = False
        self._threads.shutdown(wait=False, cancel_futures=True)
        with self._lock:
            self._killed = True
            busy = list(self._all)
        for worker in busy:
            worker.kill()
        self.shutdown()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Wait for what runs; where an error or an interrupt leaves the block, end it."""
        if kind is None:
            self.shutdown()
        else:
            self.terminate()

    def _call(self, fn: Callable[..., T], args: Any, kwargs: Any) -> T:
        worker = self._take()
        try:
            return worker.call(fn, args, kwargs)
        finally:
            with self._lock:
                keep = self._open and worker.alive
                if keep:
                    self._idle.append(worker)
            if not keep:
                self._drop(worker)

    def _take(self) -> _Worker:
        with self._lock:
            if self._idle:
                return self._idle.pop()
        worker = _Worker()
        with self._lock:
            self._all.add(worker)
            if self._killed:
                worker.kill()
        try:
            worker.begin()
        except ConfigurationError as error:
            self._drop(worker)
            # Where others have started, the machine is at fault and not the script.
            if self._proven:
                raise WorkerDied(error.problem) from error
            raise
        self._proven = True
        return worker

    def _drop(self, worker: _Worker) -> None:
        worker.end()
        with self._lock:
            self._all.discard(worker)


class _Worker:
    """One process, and the pipe to it."""

    def __init__(self) -> None:
        context = get_context("spawn")
        self._pipe, theirs = context.Pipe()
        # A daemon ends with its parent, however that one ends.
        self._process = context.Process(target=_serve, args=(theirs,), daemon=True)
        self.alive = True
        try:
            with _starting, _quiet_and_single_threaded():
                self._process.start()
        except (RuntimeError, AssertionError, OSError) as error:
            self._pipe.close()
            why = error.strerror if isinstance(error, OSError) else "this is a worker process"
            raise _no_start(why or str(error)) from error
        finally:
            theirs.close()

    def begin(self) -> None:
        """Wait until the process takes tasks: one that fails to start would fail for every task."""
        try:
            self._pipe.recv_bytes()
        except (EOFError, OSError) as error:
            raise _no_start(self._last_words()) from error

    def call(self, fn: Callable[..., T], args: Any, kwargs: Any) -> T:
        task = _packed((fn, args, kwargs), "the task cannot be sent to another process")
        try:
            self._pipe.send_bytes(task)
            reply = self._pipe.recv_bytes()
        except (EOFError, OSError) as error:
            raise WorkerDied(f"the worker process died ({self._last_words()})") from error
        good, value = pickle.loads(reply)
        if good:
            return value
        raise value

    def kill(self) -> None:
        self._process.kill()

    def end(self) -> None:
        self.alive = False
        self._pipe.close()
        self._process.join(PATIENCE)
        self._process.kill()
        self._process.join()

    def _last_words(self) -> str:
        self.alive = False
        self._process.join(PATIENCE)
        # It lives where a task closed the pipe under our feet.
        self._process.kill()
        self._process.join()
        code = self._process.exitcode or 0
        with suppress(ValueError):
            return signal.Signals(-code).name
        return f"exit code {code}"


def _no_start(why: str) -> ConfigurationError:
    return ConfigurationError(
        f"worker processes do not start ({why})",
        'a script must start its work under: if __name__ == "__main__":',
    )


def _serve(pipe: Connection) -> None:
    """What a worker process does: one task after the other, until the pipe closes."""
    # An interrupt from the keyboard goes to the whole group; the parent decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with suppress(EOFError, OSError):
        pipe.send_bytes(b"")
        while True:
            pipe.send_bytes(_answer(pipe.recv_bytes()))


def _answer(task: bytes) -> bytes:
    """Do a task; its value or its exception, as bytes."""
    try:
        fn, args, kwargs = pickle.loads(task)
        return _packed((True, fn(*args, **kwargs)), "the result cannot be sent back")
    except Exception as error:
        try:
            reply = _packed((False, error), "")
            pickle.loads(reply)
        except Exception:
            reply = _packed((False, RuntimeError(f"{type(error).__name__}: {error}")), "")
        return reply


def _packed(content: object, complaint: str) -> bytes:
    try:
        return pickle.dumps(content, pickle.HIGHEST_PROTOCOL)
    except Exception as error:
        raise pickle.PicklingError(f"{complaint} ({error})") from error


@contextmanager
def _quiet_and_single_threaded() -> Generator[None]:
    """Let a process started in here have one BLAS thread, and never see SIGINT.

    BLAS reads the environment when it is loaded, which is before any code of ours runs there.
    """
    missing = [name for name in THREAD_VARIABLES if name not in os.environ]
    os.environ.update(dict.fromkeys(missing, "1"))
    masks = hasattr(signal, "pthread_sigmask")
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if masks else set[int]()
    try:
        yield
    finally:
        if masks:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for name in missing:
            os.environ.pop(name, None)


def processors() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def executor_at(
    address: str | None = None,
    *,
    workers: int | None = None,
    timeout: float = CONNECT_TIMEOUT,
) -> Generator[Executor]:
    """Open an executor: a dask cluster if an address is given, else worker processes here.

    Parameters
    ----------
    address : str, optional
        Of a dask scheduler, e.g. "tcp://10.0.0.5:8786". Needs the extra `fleet`.
    workers : int, optional
        Processes to start here; not to be given with an address, a cluster has the workers it has.
    timeout : float
        So long the scheduler may take to answer, and to have a worker, s.

    Yields
    ------
    concurrent.futures.Executor
        It ends with the block; what has not begun by then never will.

    Raises
    ------
    ConfigurationError
        Where dask is not installed, no scheduler answers, it has no workers, or its workers have
        no ubl_graph, or another version of it.
    """
    if address is None:
        with ProcessPool(workers) as pool:
            yield pool
        return
    if workers is not None:
        raise ConfigurationError(
            "workers are given with a scheduler", "it has its own", field="workers"
        )
    from ubl_graph.cluster import cluster_executor

    with cluster_executor(address, timeout) as executor:
        yield executor
