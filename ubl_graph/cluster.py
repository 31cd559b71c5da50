"""A dask cluster as an executor, checked before work is sent to it.

Needs the extra `fleet`. Workers need the same version of ubl_graph, and no shared disk.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Generator
from concurrent.futures import (
    BrokenExecutor,
    Executor,
    Future,
    InvalidStateError,
    ThreadPoolExecutor,
)
from contextlib import contextmanager, suppress
from typing import Any, ParamSpec, TypeVar

from ubl_graph.errors import ConfigurationError

P = ParamSpec("P")
T = TypeVar("T")

#: How often a cluster is looked at, s.
LOOK_EVERY = 1.0
#: A cluster without a worker for so long is given up; `dask worker` starts a new one in seconds.
ABANDONED = 60.0


@contextmanager
def cluster_executor(address: str, timeout: float) -> Generator[Executor]:
    """What `workers.executor_at` opens for an address."""
    try:
        from distributed import Client
    except ImportError as error:
        raise ConfigurationError(
            "a dask scheduler is named, but dask is not installed",
            "pip install 'ubl-graph[fleet]'",
            field="scheduler",
        ) from error
    _await_workers(address, timeout)
    with Client(address, timeout=timeout, set_as_default=False) as client:
        _check_versions(client, address)
        executor = _Cluster(client, address)
        try:
            yield executor
        finally:
            executor.shutdown(wait=False)


class _Cluster(Executor):
    """`Client.get_executor()`, whose futures would wait for ever for a cluster that is gone."""

    def __init__(self, client: Any, address: str) -> None:
        self._client, self._address = client, address
        self._executor: Any = client.get_executor(pure=False)
        self._pending: set[Future[Any]] = set()
        self._gone = ""
        self._over = threading.Event()
        self._watcher = threading.Thread(target=self._watch, daemon=True)
        self._watcher.start()

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Have a worker run `fn(*args, **kwargs)`."""
        if self._gone:
            raise BrokenExecutor(self._gone)
        try:
            future = self._executor.submit(fn, *args, **kwargs)
        except Exception as error:
            if self._client.status == "running":
                raise
            raise BrokenExecutor(self._scheduler_gone()) from error
        self._pending.add(future)
        future.add_done_callback(self._pending.discard)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Take no more tasks; cancel what has not begun unless told to wait for it."""
        self._over.set()
        self._watcher.join()
        if self._client.status == "running":
            self._executor.shutdown(wait and not cancel_futures)

    def _watch(self) -> None:
        last_seen = time.monotonic()
        while not self._over.wait(LOOK_EVERY):
            if self._client.status == "closed":
                self._gone = self._scheduler_gone()
                for future in list(self._pending):
                    with suppress(InvalidStateError):
                        future.set_exception(BrokenExecutor(self._gone))
                continue
            if self._has_workers():
                last_seen = time.monotonic()
            elif time.monotonic() - last_seen > ABANDONED:
                self._gone = f"the dask scheduler at '{self._address}' has lost all its workers"
                for future in list(self._pending):
                    future.cancel()

    def _has_workers(self) -> bool:
        try:
            about = self._client.sync(self._client.scheduler.identity, callback_timeout=ABANDONED)
            return bool(about["workers"])
        except Exception:  # cut off for the moment; the client tries to connect again
            return False

    def _scheduler_gone(self) -> str:
        return f"the dask scheduler at '{self._address}' is gone"


def _await_workers(address: str, timeout: float) -> None:
    """Ask for the workers first: a `Client` that cannot connect fails slowly and prints."""
    try:
        # In a thread of its own: a notebook has an event loop in this one.
        with ThreadPoolExecutor(1) as thread:
            kind, workers = thread.submit(asyncio.run, _identity(address, timeout)).result()
    except Exception as error:
        why = " ".join(str(error).split()) or f"no answer within {timeout:g} s"
        raise _scheduler_error(address, f"no dask scheduler answers ({why})") from error
    if kind != "Scheduler":
        raise _scheduler_error(address, f"this is no dask scheduler, but a {kind}")
    if not workers:
        raise ConfigurationError(
            f"the dask scheduler at '{address}' has no workers",
            f"start some: dask worker {address}",
            field="scheduler",
        )


def _scheduler_error(address: str, problem: str) -> ConfigurationError:
    return ConfigurationError(
        f"'{address}': {problem}", "give its address, like tcp://10.0.0.5:8786", field="scheduler"
    )


async def _identity(address: str, timeout: float) -> tuple[str, int]:
    """What answers at an address, and how many workers it has, once it has one or time is up."""
    from distributed.core import rpc
    from distributed.security import Security

    async def ask() -> tuple[str, int]:
        there: Any = rpc(
            address, timeout=timeout, connection_args=Security().get_connection_args("client")
        )
        async with there:
            about = await there.identity()
            return about["type"], len(about.get("workers", ()))

    end = time.monotonic() + timeout
    while True:
        kind, workers = await asyncio.wait_for(ask(), timeout)
        if workers or kind != "Scheduler" or time.monotonic() > end:
            return kind, workers
        await asyncio.sleep(0.1)


def _check_versions(client: Any, address: str) -> None:
    """Other versions would give other results, or none."""
    found: dict[str, Any] = client.run(installed_version, on_error="return")
    here = installed_version()
    for worker, version in found.items():
        if isinstance(version, Exception):
            why = f"has no ubl_graph {here} ({' '.join(str(version).split())})"
        elif version != here:
            why = f"has ubl_graph {version}, here it is {here}"
        else:
            continue
        raise ConfigurationError(
            f"the worker {worker} of the dask scheduler at '{address}' {why}",
            "install the same version there",
            field="scheduler",
        )


def installed_version() -> str:
    """Version of the ubl_graph that this process imports."""
    from ubl_graph import __version__

    return __version__
