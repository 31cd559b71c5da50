"""Ranges between vehicles and to targets as the range residual takes them.

A vehicle that asks is at the ping's transmit time when it asks and at its receive time when the
reply arrives; the one that replies hears the ping half the travel time after the first and sends
half of it before the second. The halves differ by what the range changes until the answer: a range
that changes by 3 m/s makes them differ by 1 ms for each second that the answer takes, and moves the
replier's place by a millimetre or two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from ubl_graph.arrays import BoolArray, FloatArray
from ubl_graph.cooperative.fleet import Fleet, peer_ranges
from ubl_graph.measurements import OneWayRange, SlantRange
from ubl_graph.nodes import NOMINAL_SPEED
from ubl_graph.pings import Pings, kind_of, leg_times, measured_times


@dataclass(frozen=True, eq=False)
class PeerPings:
    """Ranges of one kind between vehicles and to targets, M of them with L legs.

    Attributes
    ----------
    kind : str
        "two_way_range", "one_way_range" or "slant_range".
    vehicle, peer : array of str, shape (M,)
        Who measured, and who or what was at the other end.
    here, there : array, shape (M, L)
        When either was at its end of each leg, s.
    t_transmit, t_receive : array, shape (M,)
        As given, s.
    measured, sigma : array, shape (M,)
        Travel time and its standard deviation, s.
    """

    kind: str
    vehicle: FloatArray
    peer: FloatArray
    here: FloatArray
    there: FloatArray
    t_transmit: FloatArray
    t_receive: FloatArray
    measured: FloatArray
    sigma: FloatArray

    def __len__(self) -> int:
        return len(self.measured)

    def __getitem__(self, rows: BoolArray) -> PeerPings:
        columns = {f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name != "kind"}
        return PeerPings(self.kind, **columns)

    @property
    def metres(self) -> FloatArray:
        """Standard deviation of the distance, m, (M,)."""
        return self.sigma * NOMINAL_SPEED / self.here.shape[1]

    def times_of(self, name: str) -> tuple[FloatArray, FloatArray]:
        """When a vehicle was at either end of a leg (s), and what each range tells it to (m)."""
        times, sigmas = [np.empty(0)], [np.empty(0)]
        for who, at in ((self.vehicle, self.here), (self.peer, self.there)):
            rows = who == name
            times.append(at[rows].ravel())
            sigmas.append(np.repeat(self.metres[rows], at.shape[1]))
        return np.concatenate(times), np.concatenate(sigmas)


def peer_pings(fleet: Fleet) -> tuple[PeerPings, ...]:
    """All ranges between vehicles and to targets, one entry a kind that there is."""
    parts: dict[str, list[PeerPings]] = {}
    for member in fleet.vehicles:
        for kind, pings in peer_ranges(member, fleet.beacon_names).items():
            parts.setdefault(kind, []).append(_of(member.name, pings))
    return tuple(_joined(same) for same in parts.values())


def _of(vehicle: str, pings: Pings) -> PeerPings:
    at = leg_times(pings)
    measured, sigma = measured_times(pings)
    if isinstance(pings, SlantRange):
        there, sent, heard = at, pings.t, pings.t
    elif isinstance(pings, OneWayRange):
        there, sent, heard = pings.t_transmit[:, None], pings.t_transmit, pings.t_receive
    else:
        half = 0.5 * measured
        there = np.stack([pings.t_transmit + half, pings.t_receive - half], axis=1)
        sent, heard = pings.t_transmit, pings.t_receive
    names = np.full(len(pings), vehicle)
    return PeerPings(kind_of(pings), names, pings.beacon, at, there, sent, heard, measured, sigma)


def _joined(parts: Sequence[PeerPings]) -> PeerPings:
    columns = {
        f.name: np.concatenate([getattr(p, f.name) for p in parts])
        for f in fields(PeerPings)
        if f.name != "kind"
    }
    return PeerPings(parts[0].kind, **columns)
