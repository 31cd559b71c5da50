"""Rotations and rigid motions as matrix Lie groups, many at a time.

A pose is (R, p): `world_R_body` and the position in the world. A twist, a pose's logarithm and all
six-vectors here stand translation first: (along the axes, about the axes), in the body's axes. A
perturbation acts on the right, in the body: T Exp(delta).

Functions of an adjoint matrix are polynomials in it, since it has but three eigenvalues (0 and
plus and minus i theta, twice each): so the Jacobians of the exponential, their inverses and even
the inverses' derivatives are closed forms.

Source: Barfoot, State Estimation for Robotics, ch. 7 and 11; Sola et al. 2018, A micro Lie theory.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import zeta

from ubl_graph.arrays import FloatArray

#: Below this square of an angle (rad^2) its functions are power series of so many terms; above,
#: closed forms.
SERIES_LIMIT = 1.0
_TERMS = 14
_POWERS = np.arange(_TERMS, dtype=np.float64)
#: (a/2) cot(a/2) - 1 = sum of these times a^2n, n = 1, 2, ... (radius 2 pi).
_COT = -2.0 * zeta(2.0 * (_POWERS + 1.0)) / (2.0 * np.pi) ** (2.0 * (_POWERS + 1.0))


def cross_matrix(v: FloatArray) -> FloatArray:
    """[v]x with [v]x w = v x w; (M, 3) to (M, 3, 3)."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = v[:, 2], -v[:, 1], v[:, 0]
    return out


def rotation(vector: FloatArray) -> FloatArray:
    """Rotation matrices of rotation vectors (M, 3), rad: (M, 3, 3)."""
    u = np.einsum("mi,mi->m", vector, vector)
    k = cross_matrix(vector)
    sinc, versine, _ = _rotation_coefficients(u)[:, :, None, None]
    return np.eye(3) + sinc * k + versine * (k @ k)


def rotation_vector(matrix: FloatArray) -> FloatArray:
    """Rotation vectors of rotation matrices (M, 3, 3), no longer than pi: (M, 3), rad."""
    return Rotation.from_matrix(matrix).as_rotvec()


def rotation_slope(vector: FloatArray) -> FloatArray:
    """How a rotation turns in the body as its vector changes: the right Jacobian, (M, 3, 3)."""
    u = np.einsum("mi,mi->m", vector, vector)
    k = cross_matrix(vector)
    _, versine, cubic = _rotation_coefficients(u)[:, :, None, None]
    return np.eye(3) - versine * k + cubic * (k @ k)


def rotation_slope_inverse(vector: FloatArray) -> FloatArray:
    """Inverse of `rotation_slope`, (M, 3, 3); singular at full turns."""
    u = np.einsum("mi,mi->m", vector, vector)
    k = cross_matrix(vector)
    return np.eye(3) + 0.5 * k + _half_cot(u)[0, :, None, None] * (k @ k)


def exponential(twist: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pose (R, p) that a twist (M, 6) held for a unit of time leads to: (M, 3, 3), (M, 3)."""
    about = twist[:, 3:]
    # The left Jacobian of a rotation vector is the right one of its negative.
    along = np.einsum("mij,mj->mi", rotation_slope(-about), twist[:, :3])
    return rotation(about), along


def logarithm(matrix: FloatArray, position: FloatArray) -> FloatArray:
    """Twist (M, 6) that leads to the pose (R, p) in a unit of time."""
    about = rotation_vector(matrix)
    along = np.einsum("mij,mj->mi", rotation_slope_inverse(-about), position)
    return np.concatenate([along, about], axis=1)


def between(
    r1: FloatArray, p1: FloatArray, r2: FloatArray, p2: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Pose of the second seen from the first: (R1' R2, R1' (p2 - p1))."""
    back = np.swapaxes(r1, 1, 2)
    return back @ r2, np.einsum("mij,mj->mi", back, p2 - p1)


def adjoint(matrix: FloatArray, position: FloatArray) -> FloatArray:
    """Ad of poses: T Exp(x) = Exp(Ad x) T, (M, 6, 6)."""
    out = np.zeros((len(matrix), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = matrix
    out[:, :3, 3:] = cross_matrix(position) @ matrix
    return out


def small_adjoint(twist: FloatArray) -> FloatArray:
    """Ad of twists (M, 6): ad(x) y = -ad(y) x, (M, 6, 6)."""
    out = np.zeros((len(twist), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = cross_matrix(twist[:, 3:])
    out[:, :3, 3:] = cross_matrix(twist[:, :3])
    return out


def slope(twist: FloatArray) -> FloatArray:
    """Right Jacobian: Exp(x + d) = Exp(x) Exp(J d), (M, 6, 6)."""
    u = np.einsum("mi,mi->m", twist[:, 3:], twist[:, 3:])
    ad = small_adjoint(twist)
    squared = ad @ ad
    one, two, three, four = _slope_coefficients(u)[:, :, None, None]
    return np.eye(6) - one * ad + two * squared - three * (ad @ squared) + four * squared @ squared


def slope_inverse(twist: FloatArray) -> FloatArray:
    """Inverse of `slope`, (M, 6, 6); singular at full turns."""
    u = np.einsum("mi,mi->m", twist[:, 3:], twist[:, 3:])
    ad = small_adjoint(twist)
    squared = ad @ ad
    two, four = _inverse_coefficients(u)[:2, :, None, None]
    return np.eye(6) + 0.5 * ad + two * squared + four * (squared @ squared)


def slope_of(twist: FloatArray, vector: FloatArray) -> tuple[FloatArray, FloatArray]:
    """`slope(twist) vector`, and its derivative by the twist.

    Parameters
    ----------
    twist, vector : array, shape (M, 6)

    Returns
    -------
    array, shape (M, 6)
    array, shape (M, 6, 6)
    """
    u = np.einsum("mi,mi->m", twist[:, 3:], twist[:, 3:])
    sign = np.array([[-1.0], [1.0], [-1.0], [1.0]])
    return _applied(twist, vector, sign * _slope_coefficients(u), sign * _slope_bends(u))


def inverse_slope_of(twist: FloatArray, vector: FloatArray) -> tuple[FloatArray, FloatArray]:
    """`slope_inverse(twist) vector`, and its derivative by the twist; shapes as `slope_of`."""
    u = np.einsum("mi,mi->m", twist[:, 3:], twist[:, 3:])
    two, four, two_bend, four_bend = _inverse_coefficients(u)
    none = np.zeros_like(u)
    half = np.full_like(u, 0.5)
    coefficients = np.stack([half, two, none, four])
    return _applied(twist, vector, coefficients, np.stack([none, two_bend, none, four_bend]))


def _applied(
    twist: FloatArray, vector: FloatArray, coefficients: FloatArray, bends: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The sum y + c_1 ad y + ... + c_4 ad^4 y, and its derivative by the twist.

    `coefficients` (4, M) are functions of the square of the twist's angle, `bends` their
    derivatives by it.
    """
    ad = small_adjoint(twist)
    power, bend = vector, np.zeros((len(twist), 6, 6))
    value, by_twist = vector.copy(), np.zeros((len(twist), 6, 6))
    by_square = np.zeros_like(vector)
    for coefficient, change in zip(coefficients, bends, strict=True):
        # d(ad^n y)/dx = -ad(ad^(n-1) y) + ad d(ad^(n-1) y)/dx
        bend = ad @ bend - small_adjoint(power)
        power = np.einsum("mij,mj->mi", ad, power)
        value += coefficient[:, None] * power
        by_twist += coefficient[:, None, None] * bend
        by_square += change[:, None] * power
    by_twist[:, :, 3:] += 2.0 * by_square[:, :, None] * twist[:, None, 3:]
    return value, by_twist


# Functions of u, the square of an angle, several at a time: power series where u is small, closed
# forms elsewhere.


def _rotation_coefficients(u: FloatArray) -> FloatArray:
    """sin(a)/a, (1 - cos(a))/a^2, (a - sin(a))/a^3 of a^2 = u (M,), shape (3, M)."""
    return _by_size(u, _ROTATION_SERIES, _rotation_closed)


def _rotation_closed(u: FloatArray) -> list[FloatArray]:
    a = np.sqrt(u)
    sin, cos = np.sin(a), np.cos(a)
    return [sin / a, (1.0 - cos) / u, (a - sin) / (u * a)]


def _half_cot(u: FloatArray) -> FloatArray:
    """(1 - (a/2) cot(a/2))/a^2, shape (1, M)."""
    return _by_size(u, -_COT[:, None], _half_cot_closed)


def _half_cot_closed(u: FloatArray) -> list[FloatArray]:
    half = 0.5 * np.sqrt(u)
    return [(1.0 - half / np.tan(half)) / u]


def _slope_coefficients(u: FloatArray) -> FloatArray:
    """Of ad, ad^2, ad^3 and ad^4 in the left Jacobian, shape (4, M)."""
    return _by_size(u, _SLOPE_SERIES, _slope_closed)


def _slope_closed(u: FloatArray) -> list[FloatArray]:
    """Barfoot, eq. 7.95 of the first edition."""
    a = np.sqrt(u)
    sin, cos = np.sin(a), np.cos(a)
    return [
        (4.0 - a * sin - 4.0 * cos) / (2.0 * u),
        (4.0 * a - 5.0 * sin + a * cos) / (2.0 * u * a),
        (2.0 - a * sin - 2.0 * cos) / (2.0 * u * u),
        (2.0 * a - 3.0 * sin + a * cos) / (2.0 * u * u * a),
    ]


def _slope_bends(u: FloatArray) -> FloatArray:
    """Derivatives of `_slope_coefficients` by u, shape (4, M)."""
    return _by_size(u, _SLOPE_BENDS, _slope_bends_closed)


def _slope_bends_closed(u: FloatArray) -> list[FloatArray]:
    a = np.sqrt(u)
    sin, cos = np.sin(a), np.cos(a)
    above = [
        4.0 - a * sin - 4.0 * cos,
        4.0 * a - 5.0 * sin + a * cos,
        2.0 - a * sin - 2.0 * cos,
        2.0 * a - 3.0 * sin + a * cos,
    ]
    rising = [
        3.0 * sin - a * cos,
        4.0 - 4.0 * cos - a * sin,
        sin - a * cos,
        2.0 - 2.0 * cos - a * sin,
    ]
    return [
        (r * a - k * n) / (4.0 * a ** (k + 2))
        for k, (n, r) in enumerate(zip(above, rising, strict=True), start=2)
    ]


def _inverse_coefficients(u: FloatArray) -> FloatArray:
    """Of ad^2 and ad^4 in the inverse Jacobian, and their derivatives by u, shape (4, M).

    With H(u) = (a/2) cot(a/2) - 1 they are (u H' - 2 H)/u and (u H' - H)/u^2.
    """
    return _by_size(u, _INVERSE_SERIES, _inverse_closed)


def _inverse_closed(u: FloatArray) -> list[FloatArray]:
    a = np.sqrt(u)
    half = 0.5 * a
    cot, cosecant = 1.0 / np.tan(half), 1.0 / np.sin(half) ** 2
    h = half * cot - 1.0
    first = (0.5 * cot - 0.5 * half * cosecant) / (2.0 * a)
    second = (0.5 * half * cosecant * cot - 0.5 * cosecant - 2.0 * first) / (4.0 * u)
    two_slope = second - 2.0 * first / u + 2.0 * h / u**2
    return [(u * first - 2.0 * h) / u, (u * first - h) / u**2, two_slope, two_slope / u]


def _by_size(
    u: FloatArray, series: FloatArray, closed: Callable[[FloatArray], list[FloatArray]]
) -> FloatArray:
    """Functions of u (M,) by power series (terms, K) where u is small, else in closed form."""
    powers = np.minimum(u, SERIES_LIMIT)[:, None] ** _POWERS[: len(series)]
    out = (powers @ series).T
    large = u > SERIES_LIMIT
    if large.any():
        out[:, large] = closed(u[large])
    return out


def _tables() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Series of the rotation's functions, of the Jacobian's and of its inverse's coefficients."""
    n = np.arange(_TERMS)
    factorial = np.cumprod(np.concatenate([[1.0], np.arange(1.0, 2.0 * _TERMS + 6.0)]))
    sign = (-1.0) ** n
    rotation_series = [sign / factorial[2 * n + k] for k in (1, 2, 3)]
    # Powers ad^k reduce by ad^5 = -2 u ad^3 - u^2 ad; the sums that this leaves are these series.
    slope_series = [
        sign * (1.0 - n) / factorial[2 * n + 2],
        sign * (1.0 - n) / factorial[2 * n + 3],
        sign * (n + 1.0) / factorial[2 * n + 4],
        sign * (n + 1.0) / factorial[2 * n + 5],
    ]
    k = n + 1.0
    h = _COT
    bend = (k - 1.0) * (k - 2.0) * h
    none = np.zeros(2)
    inverse_series = [
        (k - 2.0) * h,
        np.concatenate([((k - 1.0) * h)[1:], none[:1]]),
        np.concatenate([bend[1:], none[:1]]),
        np.concatenate([bend[2:], none]),
    ]
    return (
        np.stack(rotation_series, axis=1),
        np.stack(slope_series, axis=1),
        np.stack(inverse_series, axis=1),
    )


_ROTATION_SERIES, _SLOPE_SERIES, _INVERSE_SERIES = _tables()
_SLOPE_BENDS = _POWERS[1:, None] * _SLOPE_SERIES[1:]
