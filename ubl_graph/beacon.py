"""Acoustic beacons."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ubl_graph.arrays import ArrayLike, FloatArray, frozen
from ubl_graph.errors import DataError

#: A beacon that takes longer than this to answer is none, s.
MAX_TURNAROUND = 60.0


@dataclass(frozen=True, eq=False)
class Beacon:
    """An acoustic beacon at a fixed position.

    Parameters
    ----------
    name : str
        The name that range records use.
    position : array, shape (3,)
        East, north, up, m.
    sigma : float or array, shape (3,), default 0
        Standard deviation of the position, m; used only where beacons are estimated, where
        0 means that nothing is known beforehand.
    turnaround : float, optional
        Time from hearing a ping to answering it, s; needed where pings come without a travel
        time.
    """

    name: str
    position: Any
    sigma: Any = 0.0
    turnaround: float | None = None

    def __post_init__(self) -> None:
        position = _numbers(self.position)
        if position is None or position.shape != (3,):
            raise self._error(
                "position",
                f"{self.position} is no east, north, up in metres",
                "give three finite numbers",
            )
        sigma = _numbers(self.sigma)
        if sigma is None or sigma.shape not in ((), (1,), (3,)) or (sigma < 0).any():
            raise self._error(
                "sigma",
                f"{self.sigma} is no standard deviation in metres",
                "give one or three numbers, zero or more",
            )
        wait = _numbers(0.0 if self.turnaround is None else self.turnaround)
        if wait is None or wait.shape != () or not 0.0 <= wait <= MAX_TURNAROUND:
            raise self._error(
                "turnaround", f"a turnaround of {self.turnaround} s", "give seconds, zero or more"
            )
        object.__setattr__(self, "position", frozen(position))
        object.__setattr__(self, "sigma", frozen(np.broadcast_to(sigma, (3,))))

    def _error(self, field: str, problem: str, remedy: str) -> DataError:
        one_line = " ".join(problem.split())
        return DataError(one_line, remedy, record=f"beacon '{self.name}'", field=field)


def _numbers(values: ArrayLike) -> FloatArray | None:
    """Finite numbers as an array, or None where `values` are anything else."""
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    return array if np.isfinite(array).all() else None
