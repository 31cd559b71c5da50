"""Checkpoints: all that an estimator knows, in one file written at once or not at all.

The first line says what it is and bears a checksum of the second, which is JSON. Numbers are
written so that they come back bit by bit. The rows of the window are not written: they are made
anew from the records, which are.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections import Counter, deque
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.beacon import Beacon
from ubl_graph.errors import DataError, UblGraphError
from ubl_graph.frames import GeodeticOrigin, LeverArm
from ubl_graph.measurements import PositionFix
from ubl_graph.mission import Setup, Start, Vehicle
from ubl_graph.online.buffer import Entry, columns_of, odometry_of
from ubl_graph.online.frame import Break
from ubl_graph.online.gate import MEMORY, Gate
from ubl_graph.online.keeper import Rival
from ubl_graph.online.revision import Reviser
from ubl_graph.online.state import Moment
from ubl_graph.options import Options

if TYPE_CHECKING:
    from ubl_graph.online.estimator import FixedLagEstimator
    from ubl_graph.online.tracker import Tracker

#: What the files say of themselves.
KIND, VERSION = "ubl_graph checkpoint", 1
_REMEDY = "delete it to begin afresh"


def write(estimator: FixedLagEstimator, path: Path) -> None:
    """Write a checkpoint.

    Raises
    ------
    DataError
        Where the file cannot be written; one that was there before is untouched then.
    """
    content = json.dumps(_told(estimator), separators=(",", ":"))
    head = {"kind": KIND, "version": VERSION, "sha256": _digest(content)}
    text = f"{json.dumps(head)}\n{content}\n"
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            Path(name).replace(path)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise DataError(
            f"the checkpoint cannot be written: {error.strerror}", "check the folder", file=path
        ) from error


def read(cls: type[FixedLagEstimator], path: Path) -> FixedLagEstimator:
    """Read a checkpoint.

    Raises
    ------
    DataError
        Where the file cannot be read, or is no checkpoint of this version.
    """
    try:
        head, _, content = path.read_text(encoding="utf-8").partition("\n")
    except OSError as error:
        raise DataError(f"cannot be read: {error.strerror}", file=path) from error
    except UnicodeDecodeError as error:
        raise DataError("is no checkpoint", _REMEDY, file=path) from error
    content = content.rstrip("\n")
    _check_head(head, content, path)
    try:
        return _restored(cls, json.loads(content))
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, UblGraphError) as error:
        raise DataError("the checkpoint is damaged", _REMEDY, file=path) from error


def _check_head(head: str, content: str, path: Path) -> None:
    """Refuse what is no checkpoint, or not as it was written."""
    try:
        told = json.loads(head[:1000])
    except ValueError as error:
        raise DataError("is no checkpoint", _REMEDY, file=path) from error
    if not isinstance(told, dict) or told.get("kind") != KIND:
        raise DataError("is no checkpoint", _REMEDY, file=path)
    if told.get("version") != VERSION:
        problem = f"a checkpoint of version {told.get('version')}, not {VERSION}"
        raise DataError(problem, _REMEDY, file=path)
    if told.get("sha256") != _digest(content):
        raise DataError("the checkpoint is damaged: its checksum is wrong", _REMEDY, file=path)


def _digest(content: str) -> str:
    return hashlib.sha256(content.encode()).hexdigest()


def _told(estimator: FixedLagEstimator) -> dict[str, Any]:
    core = estimator.core
    number = {id(e): i for i, e in enumerate(core.tracker.buffer.all())}
    return {
        "setup": _setup_told(estimator.setup),
        "start": None if core.start is None else asdict(core.start),
        "tracker": _tracker_told(core.tracker),
        "rivals": [
            {"tracker": _tracker_told(r.tracker), "weight": r.weight, "agrees": r.agrees}
            for r in core.rivals
        ],
        "clock": {
            "now": core.clock.now,
            "newest": [[*stream, t] for stream, t in core.clock.newest.items()],
            "held": [_entry_told(e) for e in core.clock.held],
            "ahead": [i for i, e in enumerate(core.clock.held) if e in core.clock.ahead],
            "behind": [[_entry_told(e), number.get(id(e))] for e in core.clock.behind],
        },
        "gates": {kind: _gate_told(gate, number) for kind, gate in core.gates.items()},
        "state": _state_told(core.state),
        "latency": {
            "count": core.latency.count,
            "most": core.latency.most,
            "overruns": core.latency.overruns,
            "recent": core.latency.recent,
        },
        "resets": core.resets,
    }


def _restored(cls: type[FixedLagEstimator], told: dict[str, Any]) -> FixedLagEstimator:
    estimator = cls.of(_setup(told["setup"]))
    core = estimator.core
    core.start = None if told["start"] is None else Start(**told["start"])
    _restore_tracker(core.tracker, told["tracker"])
    for rival in told.get("rivals", []):
        twin = Reviser(core.setup)
        _restore_tracker(twin, rival["tracker"])
        core.rivals.append(Rival(twin, rival["weight"], rival["agrees"]))
    core.clock.now = told["clock"]["now"]
    core.clock.newest = {(kind, name): t for kind, name, t in told["clock"]["newest"]}
    entries = list(core.tracker.buffer.all())
    core.clock.held = [_entry(e) for e in told["clock"]["held"]]
    core.clock.ahead = [core.clock.held[i] for i in told["clock"]["ahead"]]
    core.clock.behind = [_entry(e) if i is None else entries[i] for e, i in told["clock"]["behind"]]
    for kind, gate in told["gates"].items():
        core.gates[kind] = _gate(gate, entries)
    for name, value in told["state"].items():
        if name == "moment" and value is not None:
            parts: dict[str, Any] = {k: v if v is None else np.array(v) for k, v in value.items()}
            value = Moment(**{**parts, "t": value["t"]})
        if name == "rival" and value is not None:
            value = np.array(value)
        setattr(core.state, name, value)
    for name, value in told["latency"].items():
        setattr(core.latency, name, value)
    core.resets = told["resets"]
    return estimator


def _setup_told(setup: Setup) -> dict[str, Any]:
    return {
        "beacons": [
            [b.name, b.position.tolist(), b.sigma.tolist(), b.turnaround] for b in setup.beacons
        ],
        "sound_speed": [setup.sound_speed.depth.tolist(), setup.sound_speed.speed.tolist()],
        "vehicle": asdict(setup.vehicle),
        "options": asdict(setup.options),
        "start": None if setup.start is None else asdict(setup.start),
        "name": setup.name,
        "origin": None if setup.origin is None else asdict(setup.origin),
    }


def _setup(told: dict[str, Any]) -> Setup:
    return Setup(
        tuple(Beacon(*beacon) for beacon in told["beacons"]),
        SoundSpeedProfile(*(np.array(part) for part in told["sound_speed"])),
        Vehicle(**{name: LeverArm(**arm) for name, arm in told["vehicle"].items()}),
        Options(**told["options"]),
        None if told["start"] is None else Start(**told["start"]),
        told["name"],
        None if told["origin"] is None else GeodeticOrigin(**told["origin"]),
    )


def _entry_told(entry: Entry) -> dict[str, Any]:
    if isinstance(entry.record, Start):
        values: list[Any] = [asdict(entry.record)]
    else:
        values = [v.tolist() if isinstance(v, np.ndarray) else v for v in entry.values]
    return {
        "kind": entry.kind,
        "values": values,
        "t": entry.t,
        "begin": entry.begin,
        "gated": entry.gated,
        "reason": entry.reason,
    }


def _entry(told: dict[str, Any]) -> Entry:
    kind, values = told["kind"], tuple(told["values"])
    if kind == "position":
        values = (values[0], np.array(values[1]), np.array(values[2]))
    blank = Entry(kind, _NONE, values, told["t"], told["begin"], told["gated"], told["reason"])
    if kind == "set_position":
        blank.record, blank.values = Start(**values[0]), ()
    elif kind == "position":
        t, place, covariance = values
        up = place[:, 2] if place.shape[1] == 3 else None
        blank.record = PositionFix(t, place[:, 0], place[:, 1], up, covariance=covariance)
    elif kind == "odometry":
        if values[-1] is not None:
            blank.values = (*values[:-1], np.array(values[-1]))
        blank.record = odometry_of([blank])[0]
    else:
        blank.record = columns_of(kind, [blank])
    return blank


_NONE = Start(0.0, 0.0, 0.0)


def _tracker_told(tracker: Tracker) -> dict[str, Any]:
    window = tracker.window
    told: dict[str, Any] = {
        "entries": [_entry_told(e) for e in tracker.buffer.all()],
        "located": tracker.located,
        "horizontal_sigma": tracker.horizontal_sigma,
        "rebuilds": tracker.rebuilds,
        "kinds": sorted(tracker.kinds),
        "fresh": tracker.is_fresh,
        "weighed": tracker.is_weighed,
        "past": tracker.past,
        "window": None,
    }
    if window is not None:
        prior, target = window.prior
        told["window"] = {
            "lasting": window.frame.lasting,
            "gap": window.frame.gap,
            "first": window.first,
            "x": window.x.tolist(),
            "common": window.common.tolist(),
            "prior": prior.tolist(),
            "prior_target": target.tolist(),
            "breaks": {str(k): asdict(jump) for k, jump in window.breaks.items()},
            "pristine": window.is_pristine,
        }
        if window.frame.is_posed:
            told["window"]["poses"] = {
                "up": window.up.tolist(),
                "made_at": window.made_at.tolist(),
                "dirty": window.dirty,
            }
    return told


def _restore_tracker(tracker: Tracker, told: dict[str, Any]) -> None:
    for entry in told["entries"]:
        tracker.buffer.add(_entry(entry))
    tracker.located, tracker.rebuilds = told["located"], told["rebuilds"]
    tracker.kinds = set(told["kinds"])
    tracker.horizontal_sigma = told["horizontal_sigma"]
    # Checkpoints of before tracks were weighed do not say: what has left them is not known.
    tracker.is_fresh, tracker.past = told.get("fresh", False), told.get("past", 0.0)
    tracker.is_weighed = told.get("weighed", False)
    window = told["window"]
    if window is None:
        return
    tracker.restore_window(
        window["first"],
        (window["lasting"], window["gap"]),
        np.array(window["x"]),
        np.array(window["common"]),
        (np.array(window["prior"]), np.array(window["prior_target"])),
        {int(k): Break(**jump) for k, jump in window["breaks"].items()},
        window["pristine"],
    )
    if "poses" in window and tracker.window is not None:
        poses = window["poses"]
        tracker.window.restore_poses(
            np.array(poses["up"]), np.array(poses["made_at"]), poses["dirty"]
        )


def _gate_told(gate: Gate, number: dict[int, int]) -> dict[str, Any]:
    return {
        "run": [number[id(e)] for e in gate.run if id(e) in number],
        "refused": [number[id(e)] for e in gate.refused if id(e) in number],
        "accepted": gate.accepted,
        "rejected": dict(gate.rejected),
        "recent": list(gate.recent),
        "times": list(gate.times),
        "surprises": list(gate.surprises),
    }


def _gate(told: dict[str, Any], entries: list[Entry]) -> Gate:
    return Gate(
        told["accepted"],
        Counter(told["rejected"]),
        [entries[i] for i in told["run"]],
        deque((entries[i] for i in told["refused"]), maxlen=MEMORY),
        recent=deque(told["recent"], maxlen=MEMORY),
        times=deque(told["times"], maxlen=MEMORY),
        surprises=deque(told["surprises"], maxlen=MEMORY),
    )


def _state_told(state: Any) -> dict[str, Any]:
    told: dict[str, Any] = {}
    for f in fields(state):
        value = getattr(state, f.name)
        if isinstance(value, Moment):
            parts = {part.name: getattr(value, part.name) for part in fields(value)}
            value = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in parts.items()}
        told[f.name] = value.tolist() if isinstance(value, np.ndarray) else value
    return told
