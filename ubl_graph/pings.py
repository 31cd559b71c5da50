"""Ranges of any kind as the range residual takes them: times, noise, legs, and their model."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from ubl_graph.acoustics import SoundSpeedProfile, TravelTimes, eigenray, straight
from ubl_graph.arrays import FloatArray
from ubl_graph.factors.ranges import TravelTimeModel
from ubl_graph.measurements import OneWayRange, SlantRange, TwoWayRange
from ubl_graph.mission import Setup
from ubl_graph.nodes import NOMINAL_SPEED

#: Distances are held as the times that they would take at the nominal speed.
NOMINAL = SoundSpeedProfile.constant(NOMINAL_SPEED)


Pings = TwoWayRange | OneWayRange | SlantRange


@dataclass(frozen=True)
class DownWeightedPing:
    """A ping that the loss took for an outlier, or nearly so.

    Attributes
    ----------
    segment : str
        The segment's label.
    kind, beacon : str
        "two_way", "one_way" or "slant", and the name of the beacon.
    t_transmit, t_receive : float
        s, as given.
    residual : float
        Model minus measurement, s.
    residual_m : float
        The same as a distance from the beacon, at 1500 m/s: below zero where the ping came late.
    sigma : float
        Standard deviation of the residual, s.
    weight : float
        Robust weight; 1 would count in full.
    """

    segment: str
    kind: str
    beacon: str
    t_transmit: float
    t_receive: float
    residual: float
    residual_m: float
    sigma: float
    weight: float


def travel_time_model(setup: Setup) -> TravelTimeModel:
    """Travel times as the options ask for them.

    Where no direct ray exists the straight line stands in, so that a solver's trial step may
    wander; the result's residual table says where that is so in the end.
    """
    profile = setup.sound_speed
    if setup.uses_eigenrays:
        return partial(eigenray, profile, missing="straight")

    def along_lines(a: FloatArray, b: FloatArray) -> TravelTimes:
        return straight(profile, a, b)

    return along_lines


def along_distances(a: FloatArray, b: FloatArray) -> TravelTimes:
    """Times that distances would take at `NOMINAL_SPEED`."""
    return straight(NOMINAL, a, b)


def kind_of(pings: Pings) -> str:
    """The kind of some ranges, as segments and residuals name it."""
    if isinstance(pings, SlantRange):
        return "slant_range"
    return "one_way_range" if isinstance(pings, OneWayRange) else "two_way_range"


def measured_times(pings: Pings) -> tuple[FloatArray, FloatArray]:
    """What was measured and its standard deviation, s: (M,) each."""
    if isinstance(pings, SlantRange):
        return pings.distance / NOMINAL_SPEED, pings.sigma / NOMINAL_SPEED
    return np.asarray(pings.travel_time), pings.sigma


def leg_times(pings: Pings) -> FloatArray:
    """When the vehicle is at each leg's end, s: (M, 2), or (M, 1) where there is one leg."""
    if isinstance(pings, SlantRange):
        return pings.t[:, None]
    if isinstance(pings, OneWayRange):
        return pings.t_receive[:, None]
    return np.stack([pings.t_transmit, pings.t_receive], axis=1)
