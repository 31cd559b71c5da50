"""Marks and rules that all figures share.

Colours are Okabe and Ito's, which colour-blind readers tell apart; line styles and marks differ
too.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse

from ubl_graph.arrays import BoolArray, FloatArray
from ubl_graph.result import RangeResiduals, Shared

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C6D1F")
GREY, RED = "#7F7F7F", "#B2182B"
#: 95 % of a two-dimensional normal distribution lie within so many standard deviations.
ELLIPSE_95 = 2.4477
#: An ellipse that is everywhere wider than so many times the map holds all of it.
COVERING = 3.0
#: Residuals beyond so many times the largest that counts are drawn at the edge: one ping that is
#: far off must not flatten all others.
FAR = 6.0


def residual_limit(table: RangeResiduals, these: BoolArray) -> float:
    """Largest residual of `these` that is drawn in its place, in the residuals' unit."""
    size = np.abs(table.residual)
    kept = size[these & ~table.down_weighted].max(initial=0.0)
    largest = float(size[these].max())
    return 1.1 * (min(largest, FAR * float(kept)) or largest or 1e-9)


def draw_residuals(
    axes: Axes, table: RangeResiduals, mine: BoolArray, factor: float, limit: float
) -> None:
    """Residuals of one panel times `factor`, with the axis ending at `limit`."""
    t, residual, out = table.t_transmit, factor * table.residual, table.down_weighted
    far = mine & (np.abs(residual) > limit)
    kept, doubted = mine & ~out & ~far, mine & out & ~far
    axes.plot(t[kept], residual[kept], ".", color=COLOURS[0], ms=3, label="used")
    axes.plot(t[doubted], residual[doubted], "x", color=RED, ms=6, label="down-weighted")
    if far.any():
        edge = 0.97 * limit * np.sign(residual[far])
        axes.plot(t[far], edge, "D", color=RED, ms=5, mfc="none", label="beyond the axis")
    axes.axhline(0.0, color=GREY, lw=0.8)
    axes.set_ylim(-limit, limit)
    axes.grid(alpha=0.3)


def residual_title(
    name: str, table: RangeResiduals, mine: BoolArray, factor: float, unit: str
) -> str:
    """What stands above a panel of residuals: how many, how many doubted, how large."""
    out = table.down_weighted
    kept = factor * table.residual[mine & ~out]
    rms = float(np.sqrt(np.mean(kept**2))) if len(kept) else 0.0
    return (
        f"{name}: {int(mine.sum())} pings, {int((mine & out).sum())} down-weighted, "
        f"rms of the others {rms:.3f} {unit}"
    )


def draw_beacons(axes: Axes, beacons: Mapping[str, Shared]) -> None:
    """Mark and name beacons on a map."""
    for i, (name, beacon) in enumerate(beacons.items()):
        east, north = beacon.value[:2]
        axes.plot(east, north, "^", color="black", ms=8, label=None if i else "beacon", zorder=5)
        text = axes.annotate(name, (east, north), xytext=(6, 6), textcoords="offset points")
        text.set(fontsize=8, bbox={"fc": "white", "alpha": 0.7, "lw": 0, "pad": 1}, zorder=6)


def draw_ellipses(
    axes: Axes, position: FloatArray, covariance: FloatArray, factor: float, colour: str
) -> None:
    """Draw 95 % ellipses `factor` times as large as they are, when all else is on the map.

    Those that hold the whole map are left out: they would hide it.

    Parameters
    ----------
    axes : Axes
    position : array, shape (N, 3)
        East, north, up, m.
    covariance : array, shape (N, 3, 3)
        m^2.
    factor : float
    colour : str
    """
    values, vectors = np.linalg.eigh(covariance[:, :2, :2])
    widths = 2.0 * ELLIPSE_95 * factor * np.sqrt(np.maximum(values, 0.0))
    span = max(np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim()))
    for centre, width, axis in zip(position[:, :2], widths, vectors, strict=True):
        if width[0] > COVERING * span:
            continue
        angle = float(np.rad2deg(np.arctan2(axis[1, 1], axis[0, 1])))
        place = (float(centre[0]), float(centre[1]))
        # add_artist leaves the map's limits alone: one unsure end must not shrink all the rest.
        axes.add_artist(
            Ellipse(place, width[1], width[0], angle=angle, fc=colour, alpha=0.25, lw=0, zorder=2)
        )


def ellipse_factor(position: FloatArray, semi_axis: float) -> float:
    """1, 2, 5, 10, 20, ...: how much ellipses are enlarged so that they can be seen on the map.

    Parameters
    ----------
    position : array, shape (N, 2 or 3)
        All that the map shows, m.
    semi_axis : float
        Standard deviation along the longer axis of an ellipse that is to be seen, m.
    """
    extent = max(float(np.ptp(position[:, :2], axis=0).max()), 1.0)
    wanted = 0.02 * extent / max(ELLIPSE_95 * semi_axis, 1e-9)
    if wanted <= 1.0:
        return 1.0
    decade = 10.0 ** np.floor(np.log10(wanted))
    return float(decade * max(step for step in (1.0, 2.0, 5.0) if step * decade <= wanted))


def typical_sigma(covariance: FloatArray) -> float:
    """Median over (N, 3, 3) covariances of the longer horizontal semi-axis, m."""
    return float(np.sqrt(np.median(np.linalg.eigvalsh(covariance[:, :2, :2])[:, 1])))
