"""Where the unknowns of a survey sit: knots of the sound speed in time, and what they share.

The vehicle's track is no unknown, so a node is a knot and holds slow states alone; beacons are the
border. All else is the layout of any problem.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.layout import UNITS, Chain, Interpolation, Layout

#: Horizontal gradients of the log scale of the travel times, 1/m: on the vehicle's side, by where
#: the vehicle is, and on the beacons', by where the beacon is.
GRADIENTS = ("vehicle_gradient", "beacon_gradient")
#: As in `ubl_graph.layout.UNITS`.
SURVEY_UNITS: dict[str, float] = dict.fromkeys(GRADIENTS, 1e-8)


class SurveyLayout(Layout):
    """Columns of a survey's unknowns: slow states at knots, then beacons and range biases."""

    @cached_property
    def kinematic(self) -> tuple[tuple[str, int], ...]:
        """A knot holds nothing of the vehicle's motion."""
        return ()

    @staticmethod
    def unit(name: str) -> float:
        """SI value of one in a column of this quantity."""
        return SURVEY_UNITS.get(name) or UNITS.get(name, 1.0)


def knots(spans: list[tuple[float, float]], spacing: float) -> FloatArray:
    """Times of knots that cover spans of time, s, at most `spacing` apart within each.

    Spans that overlap are one. In what lies between spans there is no knot: nothing was measured.
    """
    merged: list[tuple[float, float]] = []
    for begin, end in sorted(spans):
        if merged and begin <= merged[-1][1] + spacing:
            merged[-1] = (merged[-1][0], max(end, merged[-1][1]))
        else:
            merged.append((begin, end))
    parts = [
        np.linspace(begin, end, max(int(np.ceil((end - begin) / spacing)), 1) + 1)
        if end > begin
        else np.array([begin])
        for begin, end in merged
    ]
    return np.concatenate(parts)


def log_scale(
    layout: Layout, chain: Chain, times: FloatArray, here: FloatArray, there: FloatArray
) -> Interpolation:
    """The log scale of travel times at `times` (N,): the water column's, and by where the ends are.

    It is g + G here + H there, with the scale g and the gradients G and H at these times.

    Parameters
    ----------
    layout, chain
        The knots.
    times : array, shape (N,)
        s.
    here, there : array, shape (N, 2)
        East and north of vehicle and beacon from the array's centre, m.
    """
    parts = [layout.slow_at("sound_speed", chain, times)]
    for name, offset in zip(GRADIENTS, (here, there), strict=True):
        if layout.has(name):
            both = layout.slow_at(name, chain, times)
            for axis in range(2):
                weights = both.weights * offset[:, axis, None]
                columns = np.where(weights == 0.0, -1, both.columns[:, :, axis])
                parts.append(Interpolation(columns[:, :, None], weights, both.dt, both.s))
    return Interpolation.together(parts)
