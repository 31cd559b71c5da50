"""Acoustic travel times between points, with their derivatives.

`SoundSpeedProfile` holds the speed over depth; `straight` gives the time along the straight line
at the harmonic-mean speed, `eigenray` that along the refracted ray. Both work on many rows at
once and return `TravelTimes`.
"""

from ubl_graph.acoustics.eigenray import eigenray
from ubl_graph.acoustics.profile import SoundSpeedProfile
from ubl_graph.acoustics.straight import TravelTimes, straight

__all__ = [
    "SoundSpeedProfile",
    "TravelTimes",
    "eigenray",
    "straight",
]
