"""A recorded fleet as an online estimator would have seen it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ubl_graph.cooperative.fleet import Fleet
from ubl_graph.records import Records
from ubl_graph.segment import Segment


def bare(fleet: Fleet) -> Fleet:
    """The fleet without its records: what `FleetEstimator` is configured with."""
    return replace(
        fleet,
        vehicles=tuple(
            replace(m, segment=Segment(m.segment.name, start=m.segment.start))
            for m in fleet.vehicles
        ),
    )


def stream(fleet: Fleet) -> Iterator[tuple[float, str, Records]]:
    """Every record with the time when it was complete (s) and its vehicle, in order of time."""
    order: list[tuple[float, int, int, str, Records]] = []
    for number, member in enumerate(fleet.vehicles):
        for records in member.segment.records().values():
            for name in ("t_to", "t_receive", "t"):
                if hasattr(records, name):
                    times = np.asarray(getattr(records, name))
                    break
            else:
                continue
            order += [(t, number, i, member.name, records) for i, t in enumerate(times.tolist())]
    order.sort(key=lambda one: one[:3])
    for t, _, i, name, records in order:
        yield t, name, records[i]
