"""Sound speed over depth, linear between samples."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ubl_graph.arrays import BoolArray, FloatArray
from ubl_graph.errors import DataError

SLOWEST, FASTEST = 1300.0, 1700.0
"""Bounds of a plausible speed of sound in sea water, m/s: the coldest fresh water has 1402, the
deepest trench 1680; what lies outside is a unit or a column mixed up."""


class Nodes(NamedTuple):
    """A piecewise linear speed, constant before its first and after its last node.

    Layer k lies between nodes k - 1 and k; layers 0 and N are the constant ends, so that
    ``depth.searchsorted(z, "right")`` is the layer just after z, ``"left"`` the one just before.

    Attributes
    ----------
    depth : (N,) array
        Strictly increasing, m.
    speed : (N,) array
        m/s.
    gradient : (N + 1,) array
        Of layer k, 1/s; zero at both ends.
    """

    depth: FloatArray
    speed: FloatArray
    gradient: FloatArray


class MeanSlowness(NamedTuple):
    """Mean of 1/c over a depth interval, and its derivatives by the interval's ends.

    Attributes
    ----------
    value : (M,) array
        s/m.
    by_lo, by_hi : (M,) arrays
        s/m^2.
    """

    value: FloatArray
    by_lo: FloatArray
    by_hi: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class SoundSpeedProfile:
    """Speed of sound over depth, linear in depth between the samples.

    Above the first sample the first speed holds. Below the last sample the gradient of the last
    layer continues (a cast that ends above the sea floor), until it meets 1300 or 1700 m/s, which
    then holds.

    Parameters
    ----------
    depth : (L,) array_like
        Depths of the samples, m, positive down, strictly increasing; L >= 1.
    speed : (L,) array_like
        Speeds of sound there, m/s, each between 1300 and 1700.

    Attributes
    ----------
    depth, speed : (L,) arrays
        Read-only copies of the parameters.
    is_constant : bool
        True if all speeds are equal: every ray is then straight.
    nodes, upward, layers
        Tables for the travel-time functions. `nodes` is the profile with its continuation;
        `upward` the same in height (-depth) and cut at the sea surface, so that a ray turning
        upward is one turning downward in it; `layers` holds a column per layer of `nodes` (start
        depth, speed and vertical travel time from the first node; the same of its end; gradient).

    Raises
    ------
    DataError
        If shapes differ, a value is not finite, depths do not increase, or a speed is
        implausible; it names the index and the value.

    Examples
    --------
    >>> profile = SoundSpeedProfile([0.0, 100.0], [1500.0, 1510.0])
    >>> profile.speed_at([-5.0, 50.0, 200.0]).tolist()
    [1500.0, 1505.0, 1520.0]
    >>> round(float(profile.harmonic_mean(0.0, 100.0)), 4)
    1504.9945
    """

    depth: FloatArray
    speed: FloatArray
    is_constant: bool = field(init=False, repr=False)
    nodes: Nodes = field(init=False, repr=False)
    upward: Nodes = field(init=False, repr=False)
    layers: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        depth, speed = _column(self.depth, "depth"), _column(self.speed, "speed")
        _check(depth, speed)
        nodes = _nodes(*_continued(depth, speed))
        for name, value in (
            ("depth", _frozen(depth)),
            ("speed", _frozen(speed)),
            ("is_constant", bool((speed == speed[0]).all())),
            ("nodes", nodes),
            ("upward", _upward(nodes)),
            ("layers", _layers(nodes)),
        ):
            object.__setattr__(self, name, value)

    @classmethod
    def constant(cls, speed: float) -> SoundSpeedProfile:
        """Return the profile with one speed at all depths.

        Parameters
        ----------
        speed : float
            m/s.

        Returns
        -------
        SoundSpeedProfile

        Raises
        ------
        DataError
            If the speed is not between 1300 and 1700 m/s.
        """
        return cls(np.zeros(1), np.array([speed], dtype=np.float64))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, SoundSpeedProfile):
            return NotImplemented
        return np.array_equal(self.depth, other.depth) and np.array_equal(self.speed, other.speed)

    def __hash__(self) -> int:
        return hash((self.depth.tobytes(), self.speed.tobytes()))

    def speed_at(self, depth: ArrayLike) -> FloatArray:
        """Speed of sound at given depths.

        Parameters
        ----------
        depth : array_like, any shape
            m, positive down.

        Returns
        -------
        array, same shape
            m/s.
        """
        at = np.asarray(depth, dtype=np.float64)
        return np.asarray(np.interp(at, self.nodes.depth, self.nodes.speed))

    def harmonic_mean(self, depth_a: ArrayLike, depth_b: ArrayLike) -> FloatArray:
        """Harmonic mean of the speed over the depths between two ends.

        c_h = (z_b - z_a) / integral of dz/c from z_a to z_b; per linear layer the integral is
        dz / sqrt(c_1 c_2) asinh(v)/v with v = (c_2 - c_1) / (2 sqrt(c_1 c_2)), which is
        ln(c_2/c_1) / g without the division by the gradient g. Symmetric in its arguments; equal
        depths give the local speed, and nothing cancels near equality.

        Parameters
        ----------
        depth_a, depth_b : array_like
            m, positive down; any shapes that broadcast together.

        Returns
        -------
        array, the broadcast shape
            m/s.
        """
        a, b = np.broadcast_arrays(
            np.asarray(depth_a, dtype=np.float64), np.asarray(depth_b, dtype=np.float64)
        )
        mean = self.mean_slowness(np.minimum(a, b).ravel(), np.maximum(a, b).ravel())
        return (1.0 / mean.value).reshape(a.shape)

    def mean_slowness(self, lo: FloatArray, hi: FloatArray) -> MeanSlowness:
        """Mean of 1/c between two depths, with its derivatives by both.

        The integral is summed from the part of a layer below lo, whole layers (from a table) and
        the part of a layer above hi, so that it stays accurate as hi - lo goes to 0. The formula
        is that of `harmonic_mean`.

        Parameters
        ----------
        lo, hi : (M,) or (1,) arrays
            Depths, m, lo <= hi.

        Returns
        -------
        MeanSlowness
            s/m and s/m^2, each (M,).
        """
        height = hi - lo
        depth = np.empty((2, height.size))
        depth[0], depth[1] = lo, hi
        table = self.layers.take(self.nodes.depth.searchsorted(depth, "right"), 1)
        z_start, c_start, i_start, z_end, _, i_end, g = table
        speed = c_start + g * (depth - z_start)
        # Thickness of the two parts. In one and the same layer the first part is all of it.
        upper = np.minimum(z_end[0], hi)
        lower = np.maximum(z_start[1], upper)
        part = np.empty((2, height.size))
        np.subtract(upper, lo, out=part[0])
        np.subtract(hi, lower, out=part[1])
        rise = g * part
        inner = speed + rise * _INWARD
        mean = np.sqrt(speed * inner)
        v = rise / (mean + mean)
        v += 1e-200  # makes asinh(v)/v its limit 1 at v = 0 and changes no other v
        times = part * np.arcsinh(v) / (v * mean)
        time = times[0] + times[1]
        time += np.maximum(i_start[1] - i_end[0], 0.0)  # negative in one and the same layer
        slow = 1.0 / speed
        near = height < _NEAR
        if not near.any():
            value = time / height
            return MeanSlowness(value, (value - slow[0]) / height, (slow[1] - value) / height)
        level = height < 1e-200
        time[level] = slow[1, level]
        value = time / (height + level)
        step = np.where(near, 1.0, height)  # the near rows come below, without cancellation
        by_lo, by_hi = (value - slow[0]) / step, (slow[1] - value) / step
        by_lo[near], by_hi[near] = _near_slopes(table, part, speed, inner, v, near)
        return MeanSlowness(value, by_lo, by_hi)


_NEAR = 1.0
"""Below this height, m, the difference quotients of the mean slowness are summed from its parts:
dividing its rounding (2e-16 of it) by the height loses 1e-12 of the gradient at 1 m and 3 km."""


def _near_slopes(
    table: FloatArray,
    part: FloatArray,
    speed: FloatArray,
    inner: FloatArray,
    v: FloatArray,
    near: BoolArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of the mean slowness by lo and hi, for ends that nearly meet.

    With I the integral of 1/c from lo to hi and H = hi - lo, the derivative by hi is
    (1/c(hi) - I/H) / H. A part of thickness t, gradient g and end speeds c_1, c_2 adds
    (t/H)^2 g / (2 c_1 c_2) (h(v) - 1) to it, its own 1/c_2 minus its mean over t, where
    h(v) = (sqrt(1 + v^2) - asinh(v)/v) / v = 2v/3 - v^3/5 + ...; the upper part adds also the
    change of 1/c from its end to hi. Moving both ends changes I/H by the change of 1/c, over H;
    that gives the derivative by lo.
    """
    _, c_start, i_start, _, c_end, i_end, g = table[:, :, near]
    part, speed, inner, v = part[:, near], speed[:, near], inner[:, near], v[:, near]
    whole = table[0, 1, near] - table[3, 0, near]
    apart = whole > 0.0
    whole = np.where(apart, whole, 0.0)
    whole_time = np.where(apart, i_start[1] - i_end[0], 0.0)
    c_apart = np.where(apart, c_start[1] - c_end[0], 0.0)
    height = part[0] + whole + part[1]
    level = height < 1e-200
    height[level], part[0, level] = 1.0, 1.0  # at zero height the first part is all

    share = part / height
    vv = v * v
    h = v * (2 / 3 - vv * (1 / 5 - vv * (3 / 28 - vv * (5 / 72))))
    bend = share * share * g * (h - 1.0) / (2.0 * speed * inner)
    slope = share * g
    below = slope[1] + c_apart / height  # (c(hi) - c at the upper part's end) / H
    by_hi = bend[0] + bend[1] - share[0] * below / (speed[1] * inner[0])
    by_hi += (whole / speed[1] - whole_time) / (height * height)
    by_lo = -(slope[0] + below) / (speed[0] * speed[1]) - by_hi
    return by_lo, by_hi


_INWARD = np.array([[1.0], [-1.0]])


def _column(values: ArrayLike, name: str) -> FloatArray:
    try:
        column = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(f"{name} is not an array of numbers ({error})", field=name) from None
    if column.ndim != 1:
        raise DataError(
            f"{name} has shape {column.shape}", "give a one-dimensional array", field=name
        )
    return column


def _check(depth: FloatArray, speed: FloatArray) -> None:
    if depth.size != speed.size:
        raise DataError(
            f"{depth.size} depths but {speed.size} speeds", "give one speed for every depth"
        )
    if depth.size == 0:
        raise DataError("the sound speed profile is empty", "give at least one sample")
    for name, column in (("depth", depth), ("speed", speed)):
        bad = np.flatnonzero(~np.isfinite(column))
        if bad.size:
            raise DataError(
                f"{name}[{bad[0]}] is {column[bad[0]]}", "remove or repair the sample", field=name
            )
    bad = np.flatnonzero((speed < SLOWEST) | (speed > FASTEST))
    if bad.size:
        raise DataError(
            f"speed[{bad[0]}] is {speed[bad[0]]:g} m/s, outside {SLOWEST:g} to {FASTEST:g}",
            "give speeds in metres per second, and remove spikes",
            field="speed",
        )
    bad = np.flatnonzero(np.diff(depth) <= 0.0)
    if bad.size:
        k = int(bad[0]) + 1
        raise DataError(
            f"depth[{k}] is {depth[k]:g} m, not below depth[{k - 1}] = {depth[k - 1]:g} m",
            "sort the samples by depth, positive down, and drop duplicates",
            field="depth",
        )


def _frozen(values: FloatArray) -> FloatArray:
    values.flags.writeable = False
    return values


def _continued(depth: FloatArray, speed: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Add the node at which the last layer's gradient meets a bound of the speed."""
    if depth.size > 1 and speed[-1] != speed[-2]:
        bound = FASTEST if speed[-1] > speed[-2] else SLOWEST
        thickness = (bound - speed[-1]) / (speed[-1] - speed[-2]) * (depth[-1] - depth[-2])
        if depth[-1] + thickness > depth[-1]:
            return np.append(depth, depth[-1] + thickness), np.append(speed, bound)
    return depth, speed


def _nodes(depth: FloatArray, speed: FloatArray) -> Nodes:
    gradient = np.zeros(depth.size + 1)
    gradient[1:-1] = np.diff(speed) / np.diff(depth)
    return Nodes(_frozen(depth), _frozen(speed), _frozen(gradient))


def _upward(nodes: Nodes) -> Nodes:
    depth, speed = nodes.depth, nodes.speed
    if depth[0] < 0.0:  # no ray turns above the sea surface
        under = depth > 0.0
        surface = np.interp([0.0], depth, speed)
        depth = np.concatenate((np.zeros(1), depth[under]))
        speed = np.concatenate((surface, speed[under]))
    return _nodes(-depth[::-1], speed[::-1].copy())


def _layers(nodes: Nodes) -> FloatArray:
    depth, speed, gradient = nodes
    mean = np.sqrt(speed[1:] * speed[:-1])
    v = 0.5 * np.diff(speed) / mean + 1e-200
    time = np.concatenate((np.zeros(1), np.cumsum(np.diff(depth) / mean * np.arcsinh(v) / v)))
    # 1e300 stands for infinity: times the zero gradient out there it makes 0, not nan.
    return _frozen(
        np.stack(
            (
                np.append(-1e300, depth),
                np.append(speed[0], speed),
                np.append(0.0, time),
                np.append(depth, 1e300),
                np.append(speed, speed[-1]),
                np.append(time, time[-1]),
                gradient,
            )
        )
    )
