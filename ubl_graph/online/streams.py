"""What a process of lines needs around it: lines cut from bytes, signals, a socket, an output.

Everything waits in short steps, so that a signal is noticed whatever the process waits for. The
signal itself only leaves a mark: no estimate is torn in the middle.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import sys
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager

from ubl_graph.errors import ConfigurationError, DataError
from ubl_graph.online.protocol import MAX_LINE

#: Until a signal is noticed while nothing comes in or nothing is taken off, s.
PATIENCE = 0.05
#: A reader of the output that takes nothing for so long after a stop has gone, s.
LAST_PATIENCE = 1.0
#: The only address that datagrams are taken from: this machine's own.
LOOPBACK = "127.0.0.1"
_CHUNK = 1 << 16
# Room for bursts while an estimate is computed, bytes.
_SOCKET_BUFFER = 1 << 22

Stopped = Callable[[], bool]


@contextmanager
def stop_signals() -> Generator[Stopped]:
    """Let SIGTERM and SIGINT leave a mark instead of ending the process.

    Yields
    ------
    callable
        Whether one of them has come.
    """
    seen: list[int] = []
    previous = {
        number: signal.signal(number, lambda n, _: seen.append(n))
        for number in (signal.SIGTERM, signal.SIGINT)
    }
    try:
        yield lambda: bool(seen)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


class LineCutter:
    """Cuts a stream of bytes into lines; of a line that is too long it keeps the beginning.

    `protocol.parse` refuses what is kept of such a line by its length.
    """

    def __init__(self) -> None:
        self._begun = bytearray()

    def feed(self, chunk: bytes) -> list[bytes]:
        """Lines that end in this chunk, without their ends.

        Parameters
        ----------
        chunk : bytes

        Returns
        -------
        list of bytes
        """
        *ended, begun = chunk.split(b"\n")
        lines: list[bytes] = []
        for part in ended:
            self._append(part)
            lines.append(self.rest())
        self._append(begun)
        return lines

    def rest(self) -> bytes:
        """Take what came after the last end of a line."""
        line = bytes(self._begun)
        self._begun.clear()
        return line

    def _append(self, part: bytes) -> None:
        self._begun += part[: MAX_LINE + 1 - len(self._begun)]


def lines_of(descriptor: int, stopped: Stopped) -> Iterator[bytes]:
    """Lines of a pipe, a terminal or a file as they come, until its end or a stop.

    Parameters
    ----------
    descriptor : int
        Of the file, open for reading.
    stopped : callable
        Looked at between lines; what has come, but was not handed on, is left.

    Yields
    ------
    bytes
        A line without its end. The last one need not have one.

    Raises
    ------
    DataError
        Where it cannot be read.
    """
    cutter = LineCutter()
    while _readable(descriptor, stopped):
        try:
            chunk = os.read(descriptor, _CHUNK)
        except BlockingIOError:
            continue
        except OSError as error:
            raise DataError(f"standard input cannot be read ({error.strerror})") from error
        for line in cutter.feed(chunk) if chunk else [cutter.rest()]:
            if stopped():
                return
            yield line
        if not chunk:
            return


@contextmanager
def udp_socket(port: int) -> Generator[socket.socket]:
    """Open a socket that takes datagrams of this machine.

    Parameters
    ----------
    port : int
        0 takes a free one.

    Yields
    ------
    socket

    Raises
    ------
    ConfigurationError
        Where the port is not to be had.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SOCKET_BUFFER)
        receiver.setblocking(False)
        try:
            receiver.bind((LOOPBACK, port))
        except (OSError, OverflowError) as error:
            why = getattr(error, "strerror", None) or str(error)
            raise ConfigurationError(
                f"UDP port {port} cannot be had ({why})", "name another one", field="--udp"
            ) from error
        yield receiver


def lines_received(receiver: socket.socket, stopped: Stopped) -> Iterator[bytes]:
    """Lines of datagrams as they come, until a stop.

    Parameters
    ----------
    receiver : socket
        As `udp_socket` opens it.
    stopped : callable
        Looked at between lines.

    Yields
    ------
    bytes
        A line without its end; the end of a datagram ends a line, too.
    """
    while _readable(receiver.fileno(), stopped):
        try:
            datagram = receiver.recv(_CHUNK)
        except OSError:  # nothing there after all, or a sender's port that is gone
            continue
        for line in datagram.split(b"\n"):
            if stopped():
                return
            yield line


def _readable(descriptor: int, stopped: Stopped) -> bool:
    """Wait until there is something to read; False at a stop."""
    while not stopped():
        # On Windows only sockets can be waited for; there a stop is noticed with the next line.
        if sys.platform == "win32" or select.select([descriptor], [], [], PATIENCE)[0]:
            return True
    return False


@contextmanager
def own_stdout() -> Generator[int]:
    """Keep standard output for the caller alone: what others print goes to standard error.

    The solvers' C++ code prints as it likes, and may do so until the process ends; so standard
    output is not given back.

    Yields
    ------
    int
        File descriptor of the true standard output.

    Raises
    ------
    DataError
        Where standard output is closed.
    """
    if sys.stdout is None:
        raise DataError("standard output is closed", "the estimates are written there")
    sys.stdout.flush()
    own = os.dup(1)
    if sys.stderr is None:
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, 1)
        os.close(nothing)
    else:
        os.dup2(2, 1)
    try:
        yield own
    finally:
        os.close(own)


class LineWriter:
    """Writes lines at once, and does not wait for ever on a reader that has stopped reading.

    Parameters
    ----------
    descriptor : int
        Of a pipe, a terminal or a file, open for writing.
    stopped : callable
        After a stop a reader that takes nothing is waited for no longer than `LAST_PATIENCE`.
    """

    def __init__(self, descriptor: int, stopped: Stopped) -> None:
        self._descriptor, self._stopped = descriptor, stopped
        self._stop_seen: float | None = None

    def __call__(self, line: str) -> None:
        """Write one line.

        Parameters
        ----------
        line : str
            ASCII, without its end.

        Raises
        ------
        BrokenPipeError
            Where nobody reads any more.
        DataError
            Where it cannot be written for another reason: a full disk, say.
        """
        data = line.encode("ascii") + b"\n"
        while data:
            self._wait()
            try:
                # As much as select has promised a place for: more could block for ever.
                written = os.write(self._descriptor, data[: _at_once()])
            except BlockingIOError:
                continue
            except BrokenPipeError:
                raise
            except OSError as error:
                why = error.strerror
                raise DataError(f"standard output cannot be written ({why})") from error
            data = data[written:]

    def _wait(self) -> None:
        """Wait until something can be written; after a stop, for all lines together not long."""
        if sys.platform == "win32":
            return
        while not select.select([], [self._descriptor], [], PATIENCE)[1]:
            if not self._stopped():
                continue
            now = time.monotonic()
            self._stop_seen = self._stop_seen or now
            if now - self._stop_seen > LAST_PATIENCE:
                raise BrokenPipeError


def _at_once() -> int:
    return _CHUNK if sys.platform == "win32" else select.PIPE_BUF
