"""What a mission amounts to, in plain words and numbers: kept beside every result.

A result is worth what can be said of its making: the file that `resolved` fills records every
option with the value in force, also where the user gave none.
"""

from __future__ import annotations

from dataclasses import asdict, fields
from typing import Any

import numpy as np

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.arrays import FloatArray
from ubl_graph.beacon import Beacon
from ubl_graph.cooperative.fleet import Fleet, Member, Target
from ubl_graph.mission import Mission, Segment, Setup, Start
from ubl_graph.records import Records

#: A profile of more samples is thinned to these, for a file that people read.
MAX_SAMPLES = 200


def resolved(mission: Mission) -> dict[str, Any]:
    """Describe a mission by what JSON and TOML can hold.

    Parameters
    ----------
    mission : Mission

    Returns
    -------
    dict
        Keys `name`, `origin` (where there is one), `beacons`, `sound_speed`, `vehicle`, `options`
        and `segments`; the latter with `name`, `records` (how many of each kind), `time_span`
        (first and last, s) and `start` (where there is one). Units as in a mission file. What has
        no value is left out, as TOML cannot say it.
    """
    return {
        **_surroundings(mission),
        "vehicle": _plain(asdict(mission.vehicle)),
        "options": _options(mission),
        "segments": [_segment(segment) for segment in mission.segments],
    }


def resolved_fleet(fleet: Fleet) -> dict[str, Any]:
    """Describe a fleet by what JSON and TOML can hold.

    Parameters
    ----------
    fleet : Fleet

    Returns
    -------
    dict
        Keys `name`, `origin` (where there is one), `beacons`, `sound_speed`, `options` (of the
        whole), `vehicles` and `targets`. Of each vehicle `name`, lever arms, `options` in force,
        `records`, `time_span` and `start`, as of a mission and its segment; of each target `name`,
        `position`, `sigma`, `velocity_sigma` and `t`.
    """
    return {
        **_surroundings(fleet),
        "options": _options(fleet.setup),
        "vehicles": [_member(fleet, member) for member in fleet.vehicles],
        "targets": [_target(target) for target in fleet.targets],
    }


def _surroundings(whole: Mission | Fleet) -> dict[str, Any]:
    description: dict[str, Any] = {"name": whole.name}
    if whole.origin is not None:
        description["origin"] = _plain(asdict(whole.origin))
    return {
        **description,
        "beacons": [_beacon(beacon) for beacon in whole.beacons],
        "sound_speed": _sound_speed(whole.sound_speed),
    }


def _member(fleet: Fleet, member: Member) -> dict[str, Any]:
    return {
        "name": member.name,
        **_plain(asdict(member.vehicle)),
        "options": _options(fleet.mission_of(member.name)),
        **{key: value for key, value in _segment(member.segment).items() if key != "name"},
    }


def _target(target: Target) -> dict[str, Any]:
    return _plain(
        {
            "name": target.name,
            "position": None if target.position is None else _enu(target.position),
            "sigma": target.sigma.tolist(),
            "velocity_sigma": target.velocity_sigma.tolist(),
            "t": target.t,
        }
    )


def _enu(position: FloatArray) -> dict[str, float]:
    return dict(zip(("east", "north", "up"), position.tolist(), strict=True))


def _beacon(beacon: Beacon) -> dict[str, Any]:
    return _plain(
        {
            "name": beacon.name,
            "position": _enu(beacon.position),
            "sigma": beacon.sigma.tolist(),
            "turnaround": beacon.turnaround,
        }
    )


def _sound_speed(profile: SoundSpeedProfile) -> dict[str, Any]:
    if profile.is_constant:
        return {"constant": float(profile.speed[0])}
    size = len(profile.depth)
    shown = np.unique(np.linspace(0, size - 1, min(size, MAX_SAMPLES)).round().astype(np.int64))
    return {
        "samples": size,
        "depth": profile.depth[shown].tolist(),
        "speed": profile.speed[shown].tolist(),
    }


def _options(mission: Mission | Setup) -> dict[str, Any]:
    options = mission.options
    stated = {f.name: getattr(options, f.name) for f in fields(options)}
    in_force = {
        "rays": "eigenray" if mission.uses_eigenrays else "straight",
        "vertical_acceleration_psd": options.acceleration_psd,
        "vertical_jerk_psd": options.jerk_psd,
        "sound_speed_sigma": mission.sound_speed_sigma,
    }
    for name, value in in_force.items():
        if stated[name] in (None, "auto"):
            stated[name] = value
    return _plain(stated)


def _segment(segment: Segment) -> dict[str, Any]:
    records = segment.records()
    times = [_time_span(r) for r in records.values()]
    return {
        "name": segment.name,
        "records": {kind: len(r) for kind, r in records.items()},
        **({"time_span": [min(t for t, _ in times), max(t for _, t in times)]} if times else {}),
        **({} if segment.start is None else {"start": _start(segment.start)}),
    }


def _time_span(records: Records) -> tuple[float, float]:
    columns = [
        getattr(records, f.name)
        for f in fields(records)
        if f.name == "t" or f.name.startswith("t_")
    ]
    return float(min(c.min() for c in columns)), float(max(c.max() for c in columns))


def _start(start: Start) -> dict[str, Any]:
    stated = asdict(start)
    heading, sigma = stated.pop("heading"), stated.pop("heading_sigma")
    if heading is not None:
        stated["heading_deg"] = float(np.rad2deg(heading))
        stated["heading_sigma_deg"] = float(np.rad2deg(sigma))
    return _plain(stated)


def _plain(mapping: dict[str, Any]) -> dict[str, Any]:
    """Leave out what is None; turn numpy's numbers into Python's."""
    plain = {
        key: _plain(value) if isinstance(value, dict) else value for key, value in mapping.items()
    }
    return {
        key: value.item() if isinstance(value, np.generic) else value
        for key, value in plain.items()
        if value is not None
    }
