"""What an estimator gives, and what it remembers beside its window."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.mission import Start
from ubl_graph.online.health import Status
from ubl_graph.online.state import Moment
from ubl_graph.pose_trajectory import mariners_angles, mariners_slopes
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
class Place:
    """One of several places where the vehicle may be.

    Attributes
    ----------
    position, velocity : array, shape (3,)
        East, north, up; m and m/s.
    covariance : array, shape (6, 6)
        Position first, then velocity; m and m/s. It holds if the vehicle is there.
    weight : float
        Posterior probability among them; they add up to 1.
    """

    position: FloatArray
    velocity: FloatArray
    covariance: FloatArray
    weight: float


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
    rotation : array, shape (3, 3), or None
        `world_R_body`, body forward-left-up to east-north-up; where nodes are poses.
    pose_covariance : array, shape (6, 6), or None
        Translation first, world axes: east, north, up (m), then the rotation about east, north and
        up (rad).
    hypotheses : tuple of Place
        While the status is ambiguous: this place first, then the others that fit, heaviest first.
    """

    t: float
    position: FloatArray | None
    velocity: FloatArray | None
    covariance: FloatArray | None
    status: Status
    reasons: tuple[str, ...] = ()
    rotation: FloatArray | None = None
    pose_covariance: FloatArray | None = None
    hypotheses: tuple[Place, ...] = ()

    @property
    def attitude(self) -> FloatArray | None:
        """Heading clockwise from true north, pitch bow up, roll starboard down, (3,), rad."""
        return None if self.rotation is None else mariners_angles(self.rotation[None])[0]

    @property
    def heading_sigma(self) -> float | None:
        """Standard deviation of the heading, rad."""
        if self.rotation is None or self.pose_covariance is None:
            return None
        slope = mariners_slopes(self.rotation[None])[0, 0]
        return float(np.sqrt(slope @ self.pose_covariance[3:, 3:] @ slope))


@dataclass
class Memory:
    """What an estimator remembers beside its window; times are in seconds."""

    located: bool = False
    located_at: float = 0.0
    waiting: str = ""
    lost_at: float = 0.0
    ambiguous: str = ""
    rival: FloatArray | None = None
    rival_weight: float = 0.5
    weighed_pings: int = 0
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
            self.moment = replace(self.moment, t=self.moment.t + by)


def sound(moment: Moment) -> bool:
    """Whether a moment holds finite numbers and a covariance that is one."""
    held = (moment.mean, moment.covariance, moment.rotation, moment.pose_covariance)
    if not all(np.isfinite(part).all() for part in held if part is not None):
        return False
    diagonal = moment.covariance.diagonal()
    if moment.rotation is not None:
        # What a planar vehicle is held at has no variance.
        return bool((diagonal >= 0.0).all() and (diagonal[[0, 1, 3, 4]] > 0.0).all())
    return bool((diagonal > 0.0).all())
