"""What an estimator gives, and what it remembers beside its window."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.mission import Start
from ubl_graph.online.health import Status
from ubl_graph.online.state import Moment
from ubl_graph.records import Records


@dataclass(frozen=True)
class Event:
    """An earlier record whose fate was turned.

    Attributes
    ----------
    kind : str
        "rejected" or "readmitted".
    reason : str
        Why.
    record : Records
        The record, as it was given.
    final : bool
        Whether its fate can turn again.
    """

    kind: Literal["rejected", "readmitted"]
    reason: str
    record: Records | Start
    final: bool


@dataclass(frozen=True)
class Outcome:
    """What became of a record.

    Attributes
    ----------
    accepted : bool
        Whether it counts.
    reason : str
        Why it does not; empty where it does.
    final : bool
        False where that may turn while the record is in the window.
    others : tuple of Event
        Earlier records whose fate this one turned.
    """

    accepted: bool
    reason: str = ""
    final: bool = True
    others: tuple[Event, ...] = ()


@dataclass(frozen=True, eq=False)
class Estimate:
    """Where the vehicle is.

    Attributes
    ----------
    t : float
        s; increases from output to output.
    position, velocity : array, shape (3,), or None
        East, north, up; m and m/s. None while there is none.
    covariance : array, shape (6, 6), or None
        Position first, then velocity, world axes; m and m/s.
    status : str
        initialising, ok, coasting, degraded, ambiguous, lost or rebuilt.
    reasons : tuple of str
        Why the status is not ok.
    """

    t: float
    position: FloatArray | None
    velocity: FloatArray | None
    covariance: FloatArray | None
    status: Status
    reasons: tuple[str, ...] = ()


@dataclass
class Memory:
    """What an estimator remembers beside its window; times are in seconds."""

    located: bool = False
    located_at: float = 0.0
    waiting: str = ""
    lost_at: float = 0.0
    ambiguous: str = ""
    rival: FloatArray | None = None
    rebuilt: bool = False
    notes: dict[str, float] = field(default_factory=dict[str, float])
    clock_steps: int = 0
    searched_at: float = -math.inf
    doubted_at: float = -math.inf
    solved_at: float = -math.inf
    confirm: list[float] = field(default_factory=list[float])
    moment: Moment | None = None
    last_output: float | None = None

    def shift(self, by: float) -> None:
        """Move all times by so many seconds: the clock was set."""
        self.located_at += by
        self.lost_at += by
        self.searched_at += by
        self.doubted_at += by
        self.solved_at += by
        self.confirm = [t + by for t in self.confirm]
        self.notes = {note: until + by for note, until in self.notes.items()}
        if self.moment is not None:
            self.moment = Moment(self.moment.t + by, self.moment.mean, self.moment.covariance)


def sound(moment: Moment) -> bool:
    """Whether a moment holds finite numbers and a covariance that is one."""
    if not (np.isfinite(moment.mean).all() and np.isfinite(moment.covariance).all()):
        return False
    return bool((moment.covariance.diagonal() > 0.0).all())
