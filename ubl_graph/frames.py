"""The only place where axes are flipped: ENU, NED, body axes, attitude, lever arms, geodesy.

Inside ubl_graph the world is local east-north-up (ENU) and the body forward-left-up (FLU,
REP-103); a rotation `world_R_body` takes body vectors into the world. Files speak the mariner's
language: heading clockwise from true north, pitch positive bow up, roll positive starboard
down, lever arms and velocities as forward, right, down, depth positive down.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ubl_graph.arrays import ArrayLike, FloatArray, frozen
from ubl_graph.errors import ConfigurationError

#: Takes north-east-down vectors to east-north-up ones; it is its own inverse.
ENU_R_NED: FloatArray = frozen([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
#: Takes forward-right-down vectors to forward-left-up ones; it is its own inverse.
FLU_R_FRD: FloatArray = frozen(np.diag([1.0, -1.0, -1.0]))


def world_R_body(heading: ArrayLike, pitch: ArrayLike, roll: ArrayLike) -> FloatArray:  # noqa: N802 - the frames' names
    """Rotation matrices from forward-left-up body axes to east-north-up.

    Parameters
    ----------
    heading, pitch, roll : float or array, shape (M,)
        Radians; heading clockwise from true north, pitch positive bow up, roll positive
        starboard down. In north-east-down axes the rotation is Rz(heading) Ry(pitch) Rx(roll)
        on column vectors (forward, right, down).

    Returns
    -------
    array, shape (M, 3, 3)

    Examples
    --------
    A vehicle that heads east has its bow east and its port side north:

    >>> world_R_body(np.pi / 2, 0.0, 0.0)[0].round(9) + 0.0
    array([[1., 0., 0.],
           [0., 1., 0.],
           [0., 0., 1.]])
    """
    angles = (np.atleast_1d(np.asarray(a, dtype=np.float64)) for a in (heading, pitch, roll))
    h, p, r = np.broadcast_arrays(*angles)
    ch, sh, cp, sp, cr, sr = np.cos(h), np.sin(h), np.cos(p), np.sin(p), np.cos(r), np.sin(r)
    ned = np.stack(
        [
            np.stack([ch * cp, ch * sp * sr - sh * cr, ch * sp * cr + sh * sr], axis=-1),
            np.stack([sh * cp, sh * sp * sr + ch * cr, sh * sp * cr - ch * sr], axis=-1),
            np.stack([-sp, cp * sr, cp * cr], axis=-1),
        ],
        axis=-2,
    )
    return ENU_R_NED @ ned @ FLU_R_FRD


def body_vector(forward: ArrayLike, right: ArrayLike, down: ArrayLike) -> FloatArray:
    """Forward, right, down components (any unit) to forward-left-up body vectors, (M, 3)."""
    f, r, d = np.broadcast_arrays(
        *(np.asarray(a, dtype=np.float64) for a in (forward, right, down))
    )
    return np.atleast_2d(np.stack([f, -r, -d], axis=-1))


def ned_to_enu(vectors: ArrayLike) -> FloatArray:
    """Swap north-east-down vectors, shape (..., 3), to east-north-up (its own inverse)."""
    return np.asarray(vectors, dtype=np.float64) @ ENU_R_NED.T


@dataclass(frozen=True)
class LeverArm:
    """Where a sensor sits, seen from the vehicle's reference point.

    Attributes
    ----------
    forward, right, down : float
        Metres, in the vehicle's axes.
    """

    forward: float = 0.0
    right: float = 0.0
    down: float = 0.0

    def __post_init__(self) -> None:
        for name in ("forward", "right", "down"):
            value = getattr(self, name)
            if not np.isfinite(value) or abs(value) > 1000.0:
                raise ConfigurationError(
                    f"a lever arm of {value} m", "give metres, at most 1000", field=name
                )

    @property
    def body(self) -> FloatArray:
        """Forward-left-up vector, shape (3,), metres."""
        return body_vector(self.forward, self.right, self.down)[0]

    @property
    def is_zero(self) -> bool:
        """Whether the sensor sits on the reference point."""
        return self.forward == 0.0 and self.right == 0.0 and self.down == 0.0


@dataclass(frozen=True)
class GeodeticOrigin:
    """Origin of the local east-north-up frame on the WGS 84 ellipsoid.

    Attributes
    ----------
    latitude, longitude : float
        Degrees, north and east positive.
    height : float
        Metres above the ellipsoid.
    """

    latitude: float
    longitude: float
    height: float = 0.0

    def __post_init__(self) -> None:
        limits = {"latitude": 90.0, "longitude": 360.0, "height": 10_000.0}
        for name, limit in limits.items():
            value = getattr(self, name)
            if not np.isfinite(value) or abs(value) > limit:
                raise ConfigurationError(
                    f"{value} is outside ±{limit:g}", "degrees and metres are meant", field=name
                )

    def to_enu(self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike) -> FloatArray:
        """Geodetic coordinates (degrees, metres) to east-north-up metres, shape (M, 3)."""
        import pymap3d  # only missions that speak latitude and longitude pay for the import

        enu = pymap3d.geodetic2enu(
            np.asarray(latitude, dtype=np.float64),
            np.asarray(longitude, dtype=np.float64),
            np.asarray(height, dtype=np.float64),
            self.latitude,
            self.longitude,
            self.height,
        )
        return np.atleast_2d(np.stack([np.asarray(c, dtype=np.float64) for c in enu], axis=-1))

    def to_geodetic(self, enu: ArrayLike) -> FloatArray:
        """East-north-up metres, shape (M, 3), to latitude, longitude (degrees) and height (m)."""
        import pymap3d

        e, n, u = np.atleast_2d(np.asarray(enu, dtype=np.float64)).T
        geodetic = pymap3d.enu2geodetic(e, n, u, self.latitude, self.longitude, self.height)
        return np.stack([np.asarray(c, dtype=np.float64) for c in geodetic], axis=-1)
