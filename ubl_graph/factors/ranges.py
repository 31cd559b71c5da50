"""The range residual, two-way and one-way: travel times of the model minus the measured one.

A ping has legs: a two-way one from the vehicle at transmit time to the beacon and back to the
vehicle at receive time, a one-way one from the beacon to the vehicle at receive time. With tau
the acoustic time of one leg, g the logarithm of the sound-speed scale's effect and c the clock
offset (one-way only),

    residual = sum over legs of tau(here, there; at its time) exp(g at its time) + c - measured

The other end is a beacon, known or not, a target, or another vehicle. The residual sees the
positions of both ends and their derivatives alone; how a position is made of node states is the
layout's business (`Interpolation`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np

from ubl_graph.acoustics import TravelTimes
from ubl_graph.arrays import BoolArray, FloatArray, IntArray
from ubl_graph.factors.block import ALL_ROWS
from ubl_graph.layout import Interpolation

#: Travel times between two sets of points, (M, 3) each.
TravelTimeModel = Callable[[FloatArray, FloatArray], TravelTimes]


class Antenna(Protocol):
    """Where the transducer is at each of the L legs of M pings, and how that moves with x."""

    @property
    def columns(self) -> IntArray:
        """Columns of the flat vector that the legs of each ping touch, shape (M, W); -1 pads."""
        ...

    @property
    def legs(self) -> int:
        """Legs L of a ping."""
        ...

    def positions(self, x: FloatArray, rows: slice) -> tuple[FloatArray, Any]:
        """Positions (m, L, 3) of the pings `rows` at `x`, m, and what `slopes` needs of them."""
        ...

    def slopes(self, gradient: FloatArray, terms: Any, rows: slice) -> FloatArray:
        """Derivatives (m, W) of a sum over the legs, given those by the positions (m, L, 3)."""
        ...

    def variance(self, gradient: FloatArray, terms: Any) -> FloatArray:
        """What the motion between the nodes adds to the sum's variance, (M,)."""
        ...


class Arm(NamedTuple):
    """What a lever arm is off by, forward-left-up, as an unknown.

    Attributes
    ----------
    columns : array of int, shape (3,)
        Where it stands in the flat vector.
    rotation : array, shape (M, L, 3, 3)
        `world_R_body` at each leg's time, where the attitude is held.
    """

    columns: IntArray
    rotation: FloatArray


class PointAntenna:
    """Transducer on point nodes, whose attitude is held.

    Parameters
    ----------
    position : Interpolation
        Of the reference point at each leg's time, rows ping after ping (M * L).
    lever : array, shape (M, L, 3)
        Reference point to transducer, world axes, m.
    psd : array, shape (3,)
        Noise density of the motion prior per axis, for the interpolation's variance.
    variance_factor : array, shape (M * L,)
        Interpolation variance at unit density (`trajectory.interpolation_variance`).
    arm : Arm, optional
        What the lever arm is off by, where that is an unknown.
    """

    def __init__(
        self,
        position: Interpolation,
        lever: FloatArray,
        psd: FloatArray,
        variance_factor: FloatArray,
        arm: Arm | None = None,
    ) -> None:
        m, self.legs = lever.shape[:2]
        self._columns, self._weights = by_leg(position, m, self.legs)
        self._lever, self._arm = lever, arm
        self._variance = variance_factor.reshape(m, self.legs, 1) * psd
        self.columns = self._columns.reshape(m, -1)
        if arm is not None:
            off = np.broadcast_to(arm.columns, (m, 3))
            self.columns = np.concatenate([self.columns, off], axis=1)

    def positions(self, x: FloatArray, rows: slice) -> tuple[FloatArray, None]:
        """Positions (m, L, 3) at `x`, m."""
        columns, weights = self._columns[rows], self._weights[rows]
        place = (x[columns] * weights[..., None]).sum(axis=2) + self._lever[rows]
        if self._arm is not None:
            place = place + self._arm.rotation[rows] @ x[self._arm.columns]
        return place, None

    def slopes(self, gradient: FloatArray, terms: None, rows: slice) -> FloatArray:  # noqa: ARG002 - the protocol's form
        """Derivatives (m, W) by the columns, given those by the positions (m, L, 3)."""
        by_nodes = gradient[:, :, None, :] * self._weights[rows][..., None]
        own = by_nodes.reshape(len(gradient), -1)
        if self._arm is None:
            return own
        off = np.einsum("mli,mlij->mj", gradient, self._arm.rotation[rows])
        return np.concatenate([own, off], axis=1)

    def variance(self, gradient: FloatArray, terms: None) -> FloatArray:  # noqa: ARG002 - the protocol's form
        """Variance of the motion between the nodes along the gradients, (M,).

        The legs of one ping count as independent: they lie in different intervals, or the interval
        is so short that the term vanishes.
        """
        return (gradient**2 * self._variance).sum(axis=(1, 2))


class FixedAntenna:
    """Known places, the same at the L legs of a ping: beacons that are no unknowns.

    Parameters
    ----------
    places : array, shape (M, 3)
        East, north, up, m.
    legs : int
        Legs L of a ping.
    """

    def __init__(self, places: FloatArray, legs: int) -> None:
        self.legs = legs
        self.columns = np.empty((len(places), 0), dtype=np.int64)
        self._places = np.repeat(places[:, None, :], legs, axis=1)

    def positions(self, x: FloatArray, rows: slice) -> tuple[FloatArray, None]:  # noqa: ARG002 - the protocol's form
        """Positions (m, L, 3), m."""
        return self._places[rows], None

    def slopes(self, gradient: FloatArray, terms: None, rows: slice) -> FloatArray:  # noqa: ARG002 - the protocol's form
        """Nothing to derive by, (m, 0)."""
        return np.empty((len(gradient), 0))

    def variance(self, gradient: FloatArray, terms: None) -> FloatArray:  # noqa: ARG002 - the protocol's form
        """Nothing moves: zeros (M,)."""
        return np.zeros(len(gradient))


class FreeAntenna(FixedAntenna):
    """Unknown places, the same at the L legs of a ping: beacons and targets at rest.

    Parameters
    ----------
    columns : array of int, shape (M, 3)
        Where they stand in the flat vector.
    legs : int
        Legs L of a ping.
    """

    def __init__(self, columns: IntArray, legs: int) -> None:
        self.legs, self.columns = legs, columns

    def positions(self, x: FloatArray, rows: slice) -> tuple[FloatArray, None]:
        """Positions (m, L, 3) at `x`, m."""
        return np.repeat(x[self.columns[rows]][:, None, :], self.legs, axis=1), None

    def slopes(self, gradient: FloatArray, terms: None, rows: slice) -> FloatArray:  # noqa: ARG002 - the protocol's form
        """Derivatives (m, 3) by the columns, given those by the positions (m, L, 3)."""
        return gradient.sum(axis=1)


class RangeBlock:
    """Residuals of M pings, one whitened component each.

    Parameters
    ----------
    name : str
        "two_way_range", "one_way_range" or "slant_range".
    chain : str
        Name of the chain whose pings they are; empty where they join several.
    model : callable
        Acoustic times and gradients of the two ends' positions, (N, 3) each.
    here : Antenna
        Where the transducer is at each leg's time.
    there : Antenna
        Where the other end is: `FixedAntenna`, `FreeAntenna`, or that of another vehicle.
    measured : array, shape (M,)
        Travel time, s, without turnaround; as stamped for one-way ranges.
    sigma : array, shape (M,)
        Its standard deviation, s.
    sound_speed : Interpolation, optional
        Of the log scale at each leg's time (M * L rows, one component).
    offset : Interpolation, optional
        What is added to the sum (M rows, one component): the clock offset at the receive time,
        receiver's minus sender's, and a beacon's range bias.
    """

    linear = False
    robust = True
    log_det = None

    def __init__(
        self,
        name: str,
        chain: str,
        model: TravelTimeModel,
        here: Antenna,
        there: Antenna,
        measured: FloatArray,
        sigma: FloatArray,
        sound_speed: Interpolation | None = None,
        offset: Interpolation | None = None,
    ) -> None:
        self.name = name
        self.chain = chain
        self.model = model
        self.measured = measured
        self.sigma = sigma
        self.antenna, self._there = here, there
        m, n_legs = len(measured), here.legs
        self._sound_speed = None if sound_speed is None else by_leg(sound_speed, m, n_legs)
        self._offset = None if offset is None else by_leg(offset, m, 1)
        slow = [part for part in (self._sound_speed, self._offset) if part is not None]
        parts = [here.columns, *(part[0].reshape(m, -1) for part in slow), there.columns]
        self.columns = np.concatenate(parts, axis=1)

    def __len__(self) -> int:
        return len(self.measured)

    def frozen(self, x: FloatArray) -> FloatArray:
        """Standard deviation of each row (M,), s: the measurement's and the interpolation's.

        The variance of the trajectory between its nodes is projected on the legs' directions at
        `x`.
        """
        terms = self._model_terms(x, ALL_ROWS)
        here = self.antenna.variance(terms.slopes, terms.here)
        return np.sqrt(self.sigma**2 + here + self._there.variance(terms.back, terms.there))

    def found(self, x: FloatArray) -> BoolArray:
        """Whether a direct ray exists for all legs of each ping, (M,)."""
        found = self._model_terms(x, ALL_ROWS).travel.found
        return np.all(found.reshape(len(self), -1), axis=1)

    def evaluate(
        self,
        x: FloatArray,
        frozen: FloatArray | None = None,
        rows: slice = ALL_ROWS,
        jacobian: bool = True,
    ) -> tuple[FloatArray, FloatArray | None]:
        """Whitened residuals (m, 1) of `rows` at `x` and Jacobians (m, 1, C)."""
        sigma = (self.sigma if frozen is None else frozen)[rows]
        terms = self._model_terms(x, rows)
        residual = ((terms.total - self.measured[rows]) / sigma)[:, None]
        if not jacobian:
            return residual, None
        m = len(terms.total)
        parts = [self.antenna.slopes(terms.slopes, terms.here, rows)]
        if self._sound_speed is not None:
            parts.append((terms.times[..., None] * self._sound_speed[1][rows]).reshape(m, -1))
        if self._offset is not None:
            parts.append(self._offset[1][rows].reshape(m, -1))
        if self._there.columns.shape[1]:
            parts.append(self._there.slopes(terms.back, terms.there, rows))
        jacobians = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
        return residual, (jacobians / sigma[:, None])[:, None, :]

    def _model_terms(self, x: FloatArray, rows: slice) -> _Terms:
        here, held = self.antenna.positions(x, rows)
        there, held_there = self._there.positions(x, rows)
        m, n_legs = here.shape[:2]
        travel = self.model(here.reshape(-1, 3), there.reshape(-1, 3))
        times = travel.time.reshape(m, n_legs)
        slopes, back = (g.reshape(m, n_legs, 3) for g in (travel.gradient_a, travel.gradient_b))
        if self._sound_speed is not None:
            columns, weights = self._sound_speed[0][rows], self._sound_speed[1][rows]
            scale = np.exp((x[columns[..., 0]] * weights).sum(axis=2))
            times = times * scale
            slopes, back = slopes * scale[..., None], back * scale[..., None]
        total = times.sum(axis=1)
        if self._offset is not None:
            columns, weights = self._offset[0][rows], self._offset[1][rows]
            total = total + (x[columns[..., 0]] * weights).sum(axis=(1, 2))
        return _Terms(total, times, slopes, back, travel, held, held_there)


class _Terms(NamedTuple):
    """What a residual is made of: sums, legs, and what the ends remember of their positions."""

    total: FloatArray  # (m,), s
    times: FloatArray  # (m, L), s
    slopes: FloatArray  # (m, L, 3), s/m, by the positions here
    back: FloatArray  # (m, L, 3), s/m, by those there
    travel: TravelTimes
    here: Any
    there: Any


def by_leg(part: Interpolation, m: int, n_legs: int) -> tuple[IntArray, FloatArray]:
    """Columns (M, L, W, D) and weights (M, L, W). Padding stays -1: its weight is zero."""
    part = part.compact()
    width = part.weights.shape[1]
    columns = part.columns.reshape(m, n_legs, width, -1)
    return columns, part.weights.reshape(m, n_legs, width)
