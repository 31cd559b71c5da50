"""How the vehicle moves and lies: velocity, attitude, heading, angular rate, odometry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from ubl_graph.arrays import ArrayLike, FloatArray
from ubl_graph.errors import DataError
from ubl_graph.records import Records, Source

# One standard deviation of each kind where neither a column nor an option gives it.
VELOCITY_SIGMA = 0.01  #: m/s; a 600 kHz DVL's single-ping noise
ATTITUDE_SIGMA = float(np.deg2rad(0.2))  #: rad; a fibre-optic gyrocompass
HEADING_SIGMA = 0.02  #: rad; a MEMS compass from reading to reading
ANGULAR_RATE_SIGMA = 1e-3  #: rad/s; a MEMS gyro's sample at 100 Hz

#: Signs that turn forward, right, down into forward, left, up; of rotation vectors the same.
_FLU = np.array([1.0, -1.0, -1.0])
_FLU.setflags(write=False)

#: Odometry steps shorter than this take no time, s.
SHORTEST_STEP = 2e-6


@dataclass(frozen=True, eq=False)
class Velocity(Records):
    """Velocity through the DVL's eyes, in the vehicle's axes.

    Parameters
    ----------
    t : float or array, shape (M,)
        Seconds.
    forward, right, down : float or array, shape (M,)
        m/s.
    sigma : float or array, shape (M,), default 0.01
        Standard deviation of each component, m/s, white from sample to sample.
    reference : "bottom" or "water", or array of these, default "bottom"
        What the velocity is relative to. Water-track needs the current as a state.
    source : Source, optional
        File and rows the records came from.
    """

    t: Any
    forward: Any
    right: Any
    down: Any
    sigma: Any = VELOCITY_SIGMA
    reference: Any = "bottom"
    source: Source | None = None

    LIMITS: ClassVar = {
        "forward": (-50.0, 50.0, "m/s"),
        "right": (-50.0, 50.0, "m/s"),
        "down": (-50.0, 50.0, "m/s"),
        "sigma": (1e-6, 10.0, "m/s"),
    }

    def _check(self) -> None:
        self._forbid(
            ~np.isin(self.reference, ("bottom", "water")),
            "reference",
            self.reference,
            " is neither 'bottom' nor 'water'",
            "say which of the two",
        )


@dataclass(frozen=True, eq=False)
class Attitude(Records):
    """Attitude from a heading reference, mariner's angles.

    Parameters
    ----------
    t : float or array, shape (M,)
        Seconds.
    heading, pitch, roll : float or array, shape (M,)
        Radians; heading clockwise from true north, pitch bow up, roll starboard down.
    sigma : float or array, shape (M,), default 0.0035 (0.2 degrees)
        Standard deviation, radians, of an error that lasts (a heading reference's error does).
    source : Source, optional
        File and rows the records came from.
    """

    t: Any
    heading: Any
    pitch: Any = 0.0
    roll: Any = 0.0
    sigma: Any = ATTITUDE_SIGMA
    source: Source | None = None

    LIMITS: ClassVar = {
        "heading": (-4.0 * np.pi, 4.0 * np.pi, "rad"),
        "pitch": (-np.pi, np.pi, "rad"),
        "roll": (-np.pi, np.pi, "rad"),
        "sigma": (1e-6, np.pi, "rad"),
    }


@dataclass(frozen=True, eq=False)
class Heading(Records):
    """Heading from a compass; for vehicles whose nodes are poses.

    Parameters
    ----------
    t : float or array, shape (M,)
        Seconds.
    heading : float or array, shape (M,)
        Radians, clockwise from true north.
    sigma : float or array, shape (M,), default 0.02
        Standard deviation, radians, white from reading to reading. What the compass lastingly reads
        too far is a state of its own, `heading_bias`.
    source : Source, optional
        File and rows the records came from.

    Raises
    ------
    DataError
        Where a value is not finite, or outside two turns either way.
    """

    t: Any
    heading: Any
    sigma: Any = HEADING_SIGMA
    source: Source | None = None

    LIMITS: ClassVar = {
        "heading": (-4.0 * np.pi, 4.0 * np.pi, "rad"),
        "sigma": (1e-6, np.pi, "rad"),
    }


@dataclass(frozen=True, eq=False)
class AngularRate(Records):
    """Angular rate from gyros, about the vehicle's axes; for vehicles whose nodes are poses.

    Parameters
    ----------
    t : float or array, shape (M,)
        Seconds.
    about_forward, about_right : float or array, shape (M,), default 0.0
        Radians per second about the forward axis (positive: starboard goes down) and about the
        right one (positive: the bow goes up). A spatial pose takes zeros for measurements.
    about_down : float or array, shape (M,)
        Radians per second about the down axis; positive is clockwise from above, the heading
        increases.
    sigma : float or array, shape (M,), default 1e-3
        Standard deviation of each component, rad/s, white from sample to sample.
    source : Source, optional
        File and rows the records came from.

    Raises
    ------
    DataError
        Where a value is not finite or over 10 rad/s, or `about_down` is left out.
    """

    t: Any
    about_forward: Any = 0.0
    about_right: Any = 0.0
    about_down: Any = None
    sigma: Any = ANGULAR_RATE_SIGMA
    source: Source | None = None

    LIMITS: ClassVar = {
        "about_forward": (-10.0, 10.0, "rad/s"),
        "about_right": (-10.0, 10.0, "rad/s"),
        "about_down": (-10.0, 10.0, "rad/s"),
        "sigma": (1e-9, 10.0, "rad/s"),
    }

    def __post_init__(self) -> None:
        if self.about_down is None:
            raise DataError(
                "AngularRate without the rate about the down axis",
                "give it in rad/s, clockwise from above",
                field="about_down",
            )
        super().__post_init__()

    @property
    def rate(self) -> FloatArray:
        """About forward, left, up, rad/s, shape (M, 3)."""
        return np.stack([self.about_forward, self.about_right, self.about_down], axis=1) * _FLU


@dataclass(frozen=True, eq=False)
class Odometry(Records):
    """Change of pose from one time to another, in the vehicle's axes at the first.

    Parameters
    ----------
    t_from, t_to : float or array, shape (M,)
        Seconds; `t_to` is later than `t_from`.
    forward, right : float or array, shape (M,)
        Displacement, m, along the axes that the vehicle has at `t_from`.
    down : float or array, shape (M,), optional
        Displacement, m; left out, as `about_forward` and `about_right`, by a vehicle that moves in
        a plane.
    about_forward, about_right : float or array, shape (M,), optional
        Components of the rotation vector, rad.
    about_down : float or array, shape (M,), default 0.0
        The third component, rad; positive is clockwise from above, the heading increases.
    covariance : array, shape (6, 6), (3, 3), (M, 6, 6) or (M, 3, 3), optional
        Covariance over forward, right, down (m), about_forward, about_right, about_down (rad), or
        over forward, right, about_down where the motion is planar. Left out, the noise is that of
        the options, which grows with way and time.
    source : Source, optional
        File and rows the records came from.

    Raises
    ------
    DataError
        Where a value is not finite or absurd, `t_to` is not after `t_from`, or a covariance is not
        symmetric and positive definite or not of the size that the components ask for.
    """

    t_from: Any
    t_to: Any
    forward: Any
    right: Any
    down: Any = None
    about_forward: Any = None
    about_right: Any = None
    about_down: Any = 0.0
    covariance: Any = None
    source: Source | None = None

    LIMITS: ClassVar = {
        "forward": (-1e4, 1e4, "m"),
        "right": (-1e4, 1e4, "m"),
        "down": (-1e4, 1e4, "m"),
        "about_forward": (-2.0 * np.pi, 2.0 * np.pi, "rad"),
        "about_right": (-2.0 * np.pi, 2.0 * np.pi, "rad"),
        "about_down": (-2.0 * np.pi, 2.0 * np.pi, "rad"),
    }
    #: Components that a planar vehicle has none of.
    SPATIAL: ClassVar = ("down", "about_forward", "about_right")

    def _check(self) -> None:
        self._forbid(
            self.t_to - self.t_from < SHORTEST_STEP,
            "t_to",
            self.t_to,
            " s is not after t_from",
            "check the unit, and that the columns are not swapped; drop steps that take no time",
        )
        if self.covariance is None:
            return
        self._check_covariance(
            {
                3: "odometry over forward, right, about_down",
                6: "odometry over forward, right, down and the rotations about them",
            },
            "give variances in m^2 and rad^2 on the diagonal",
        )
        if self.covariance.shape[1] == 6:
            return
        for name in self.SPATIAL:
            values = getattr(self, name)
            if values is not None:
                self._forbid(
                    values != 0.0,
                    name,
                    values,
                    ": the covariance is that of a planar motion",
                    "give 6 x 6",
                )

    @property
    def dimension(self) -> Literal[2, 3]:
        """2 for planar motion, 3 for motion in space.

        A covariance says which by its size; without any, motion is planar where `down`,
        `about_forward` and `about_right` are all left out.
        """
        if self.covariance is not None:
            return 2 if self.covariance.shape[1] == 3 else 3
        return 2 if all(getattr(self, name) is None for name in self.SPATIAL) else 3

    @property
    def translation(self) -> FloatArray:
        """Displacement forward, left, up, m, shape (M, 3)."""
        return self._stacked("forward", "right", "down")

    @property
    def rotation_vector(self) -> FloatArray:
        """Rotation about forward, left, up, rad, shape (M, 3)."""
        return self._stacked("about_forward", "about_right", "about_down")

    @property
    def covariances_flu(self) -> FloatArray | None:
        """Covariance in forward, left, up axes, m^2, m rad and rad^2; None where there is none.

        Shape (M, 6, 6) over forward, left, up, about_forward, about_left, about_up, or (M, 3, 3)
        over forward, left, about_up.
        """
        if self.covariance is None:
            return None
        signs = _FLU if self.dimension == 2 else np.tile(_FLU, 2)
        return self.covariance * np.outer(signs, signs)

    def _stacked(self, *names: str) -> FloatArray:
        columns = [getattr(self, name) for name in names]
        none = np.zeros(len(self))
        return np.stack([none if c is None else c for c in columns], axis=1) * _FLU


def odometry_covariance(sigma: ArrayLike, sigma_turn: ArrayLike, dimension: int) -> FloatArray:
    """Return covariances for `Odometry` of which no component has to do with another.

    Parameters
    ----------
    sigma, sigma_turn : float or array, shape (M,)
        Standard deviations of each displacement, m, and of each rotation, rad.
    dimension : int
        2 for planar motion, 3 for motion in space.

    Returns
    -------
    array, shape (M, 3, 3) or (M, 6, 6)
    """
    way, turn = np.broadcast_arrays(*(np.atleast_1d(np.asarray(s)) for s in (sigma, sigma_turn)))
    columns = [way, way, turn] if dimension == 2 else [way] * 3 + [turn] * 3
    sigmas = np.stack(columns, axis=1).astype(np.float64)
    return sigmas[:, :, None] ** 2 * np.eye(len(columns))
