"""The process that estimates as the data come: lines in, lines out, until it is told to stop."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ubl_graph.errors import ConfigurationError, DataError
from ubl_graph.online import streams
from ubl_graph.online.session import Session, Warn

if TYPE_CHECKING:
    from ubl_graph.online.estimator import FixedLagEstimator


def run(session: Session, lines: Iterable[bytes]) -> None:
    """Answer line after line to the last, or until nobody reads the answers.

    Parameters
    ----------
    session : Session
    lines : iterable of bytes
    """
    with suppress(BrokenPipeError):  # nobody is left to say more to
        try:
            for line in lines:
                session.handle(line)
        finally:
            session.finish()


def serve(
    config: str | Path,
    checkpoint: str | Path | None = None,
    udp: int | None = None,
    warn: Warn = lambda _: None,
) -> None:
    """Be the process: standard input or a UDP port in, standard output out, until told to stop.

    It returns at the end of the input, at SIGTERM or SIGINT, and when nobody reads the output.

    Parameters
    ----------
    config : path
        Mission file without data.
    checkpoint : path, optional
        Resumed from where it exists, and kept up to date.
    udp : int, optional
        Port on this machine's loopback to take lines from instead of standard input; 0 takes a
        free one.
    warn : callable, optional
        Takes a sentence for whoever looks after the process.

    Raises
    ------
    DataError
        Where the configuration or the checkpoint is wrong, or standard input or output fails.
    """
    file = None if checkpoint is None else Path(checkpoint)
    if udp is None and sys.stdin is None:
        raise DataError("standard input is closed", "the records are read there; or name a --udp")
    with streams.stop_signals() as stopped, streams.own_stdout() as out:
        estimator, resumed = open_estimator(config, file)
        write = streams.LineWriter(out, stopped)
        session = Session(estimator, write, file, warn=warn, resumed=resumed)
        # A step that overflows is refused by its cost; standard error is for people.
        with _lines(udp, stopped, warn) as lines, np.errstate(all="ignore"):
            run(session, lines)


@contextmanager
def _lines(udp: int | None, stopped: streams.Stopped, warn: Warn) -> Generator[Iterator[bytes]]:
    if udp is None:
        yield streams.lines_of(0, stopped)
        return
    with streams.udp_socket(udp) as receiver:
        warn(f"listening on {streams.LOOPBACK}, UDP port {receiver.getsockname()[1]}")
        yield streams.lines_received(receiver, stopped)


def open_estimator(
    config: str | Path, checkpoint: Path | None = None
) -> tuple[FixedLagEstimator, bool]:
    """Make the estimator that a configuration asks for, or resume it from its checkpoint.

    Parameters
    ----------
    config : path
        Mission file without data.
    checkpoint : path, optional
        Resumed from where it exists.

    Returns
    -------
    estimator : FixedLagEstimator
    resumed : bool

    Raises
    ------
    DataError
        Where the configuration or the checkpoint cannot be read, or the latter not be written.
    ConfigurationError
        Where the configuration is wrong, or not the one that the checkpoint was made with.
    """
    from ubl_graph.io.mission_file import load_setup
    from ubl_graph.online.estimator import FixedLagEstimator

    setup = load_setup(config)
    if checkpoint is not None:
        _check_writable(checkpoint)
    if checkpoint is None or not checkpoint.exists():
        return FixedLagEstimator.of(setup), False
    estimator = FixedLagEstimator.restore(checkpoint)
    if estimator.setup.fingerprint() != setup.fingerprint():
        raise ConfigurationError(
            f"the checkpoint was made with another configuration than {config}",
            "start with that one, or move the checkpoint away to begin afresh",
            file=checkpoint,
        )
    return estimator, True


def _check_writable(checkpoint: Path) -> None:
    """Refuse a place where no checkpoint can be written, before anything is read."""
    try:
        if checkpoint.is_dir():
            raise DataError("this is a folder", "name a file in it", file=checkpoint)
        # A checkpoint is written beside its place and then moved there.
        with tempfile.TemporaryFile(dir=checkpoint.parent):
            pass
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise DataError(
            f"no checkpoint can be written there ({why})", "name another file", file=checkpoint
        ) from error
