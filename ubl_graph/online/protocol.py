"""The line protocol: what a line of JSON asks for, and the lines that answer it.

Nothing here keeps a state or does input and output. A line becomes a message, or a refusal that
says what is wrong with it; nothing that a line may hold raises. docs/live-protocol.md lists the
records and answers.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from ubl_graph.errors import DataError, UblGraphError
from ubl_graph.io.tables import shortened
from ubl_graph.measurements import OneWayRange, PositionFix, SlantRange, TwoWayRange
from ubl_graph.online.json_records import heading_of, kind_of, numbers_of, record_of, shown
from ubl_graph.records import Records

if TYPE_CHECKING:
    from ubl_graph.mission import Setup
    from ubl_graph.online.estimator import Estimate
    from ubl_graph.online.outputs import Place

#: A line longer than this is no record, bytes.
MAX_LINE = 1_000_000
# Of a longer line the answer repeats so much, characters.
_REPEATED = 200


@dataclass(frozen=True, eq=False)
class Measurement:
    """A line that holds a measurement.

    Attributes
    ----------
    record : Records
        One row.
    came : dict
        The line as it came.
    """

    record: Records
    came: dict[str, Any]

    @property
    def locates(self) -> bool:
        """Whether it is a ping or a position fix, which an estimate answers."""
        return isinstance(self.record, (TwoWayRange, OneWayRange, SlantRange, PositionFix))

    @property
    def t(self) -> float:
        """When it was measured; a ping, when it was heard; odometry, when it ended, s."""
        names = ("t", "t_receive", "t_to")
        name = next(name for name in names if hasattr(self.record, name))
        return float(getattr(self.record, name)[0])


@dataclass(frozen=True)
class Query:
    """A line that asks for an estimate, at time `t` (s), or at the newest record's."""

    t: float | None
    came: dict[str, Any]


@dataclass(frozen=True)
class SetPosition:
    """A line that says where the vehicle is; `values` are the estimator's arguments (SI)."""

    values: dict[str, float]
    came: dict[str, Any]


@dataclass(frozen=True)
class Reset:
    """A line that has all measurements forgotten."""

    came: dict[str, Any]


@dataclass(frozen=True)
class HealthRequest:
    """A line that asks how the estimator does."""

    came: dict[str, Any]


@dataclass(frozen=True)
class Refused:
    """A line that is no record.

    Attributes
    ----------
    reason : str
        What is wrong, and what to do.
    came : object
        What the line holds where that can be written as JSON, else its text.
    """

    reason: str
    came: Any


Message: TypeAlias = Measurement | Query | SetPosition | Reset | HealthRequest


def parse(line: bytes, setup: Setup) -> Message | Refused | None:
    """Read one line.

    Parameters
    ----------
    line : bytes
        With or without its end.
    setup : Setup
        Says which beacons there are, their turnarounds, the default sigma of travel times, and
        where latitudes count from.

    Returns
    -------
    Message, Refused or None
        None for a blank line.
    """
    if not line.strip():
        return None
    try:
        content = _json(line)
    except DataError as error:
        return Refused(reason(error), _text(line))
    try:
        return _message(content, setup)
    except DataError as error:
        return Refused(reason(error), _repeatable(content, line))


def reason(error: UblGraphError) -> str:
    """Text of an error on one line, without the record's number: the answer repeats the record."""
    if isinstance(error, DataError):
        error = DataError(error.problem, error.remedy, file=error.file, field=error.field)
    return " ".join(str(error).split())


def _json(line: bytes) -> Any:
    if len(line) > MAX_LINE:
        raise DataError(f"a line of more than {MAX_LINE} bytes", "give one record a line")
    try:
        return json.loads(line.decode("utf-8-sig"), object_pairs_hook=_object)
    except UnicodeDecodeError as error:
        raise DataError(f"byte 0x{line[error.start]:02x} is no UTF-8 text") from error
    except json.JSONDecodeError as error:
        raise DataError(
            f"no JSON: {error.msg} at character {error.pos + 1}", "give one JSON object a line"
        ) from error
    except RecursionError as error:
        raise DataError("no record: nested too deeply", "give one JSON object a line") from error
    except ValueError as error:  # Python reads no integer of more than some 4 000 digits
        raise DataError("no record: a number of too many digits") from error


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content: dict[str, Any] = {}
    for key, value in pairs:
        if key in content:
            raise DataError(f"the key {shortened(key)} is there twice", "keep one of the two")
        content[key] = value
    return content


def _text(line: bytes) -> str:
    text = line[: MAX_LINE + 1].decode("utf-8", errors="replace").rstrip("\r\n")
    return text if len(line) <= MAX_LINE else text[:_REPEATED] + "..."


def _repeatable(content: Any, line: bytes) -> Any:
    """What the line holds, or its text where that is no strict JSON (NaN, 1e999)."""
    try:
        encoded(content)
    except (ValueError, RecursionError):
        return _text(line)
    return content


def _message(content: Any, setup: Setup) -> Message:
    if not isinstance(content, dict):
        raise DataError(
            f"{shown(content)} is no record", 'give an object such as {"type": "query"}'
        )
    kind = kind_of(content)
    record = record_of(kind, content, setup)
    if record is not None:
        return Measurement(record, content)
    values = numbers_of(content)
    if kind == "query":
        return Query(values.get("t"), content)
    if kind == "set_position":
        heading = heading_of(values)
        PositionFix(**values)  # the same limits hold
        return SetPosition(values | heading, content)
    return Reset(content) if kind == "reset" else HealthRequest(content)


def estimate_content(estimate: Estimate, asked: float | None = None) -> dict[str, Any]:
    """Put an estimate in the words of the protocol.

    Parameters
    ----------
    estimate : Estimate
    asked : float, optional
        The time that a query asked for, s; shown where the estimate bears another.

    Returns
    -------
    dict
        What is not known is None.
    """
    content: dict[str, Any] = {"type": "estimate", "t": float(estimate.t)}
    if asked is not None and asked != estimate.t:
        content["asked"] = asked
    axes = {
        ("east", "north", "up"): estimate.position,
        ("v_east", "v_north", "v_up"): estimate.velocity,
    }
    for names, vector in axes.items():
        numbers = [None] * 3 if vector is None else vector.tolist()
        content.update(zip(names, numbers, strict=True))
    if estimate.rotation is not None:
        assert estimate.attitude is not None
        assert estimate.pose_covariance is not None
        angles = np.rad2deg(estimate.attitude).tolist()
        content.update(zip(("heading", "pitch", "roll"), angles, strict=True))
        content["heading_sigma"] = float(np.rad2deg(estimate.heading_sigma or 0.0))
        content["pose_covariance"] = estimate.pose_covariance.ravel().tolist()
    covariance = estimate.covariance
    content["covariance"] = None if covariance is None else covariance.ravel().tolist()
    if estimate.hypotheses:
        content["hypotheses"] = [_place_content(place) for place in estimate.hypotheses]
    content["status"] = estimate.status
    content["reasons"] = list(estimate.reasons)
    return content


def _place_content(place: Place) -> dict[str, Any]:
    content: dict[str, Any] = {"weight": place.weight}
    content.update(zip(("east", "north", "up"), place.position.tolist(), strict=True))
    content.update(zip(("v_east", "v_north", "v_up"), place.velocity.tolist(), strict=True))
    return content | {"covariance": place.covariance.ravel().tolist()}


def verdict_content(kind: str, why: str, record: Any, *, final: bool = True) -> dict[str, Any]:
    """Say what became of a record.

    Parameters
    ----------
    kind : str
        "rejected" or "readmitted".
    why : str
        One sentence.
    record : object
        As it came.
    final : bool
        False where the decision may yet be reversed.

    Returns
    -------
    dict
    """
    return {"type": kind, "reason": why, "record": record, "final": final}


def encoded(content: Any) -> str:
    """Write as one line of strict JSON, in ASCII.

    Raises
    ------
    ValueError
        Where a number is not finite.
    """
    return json.dumps(content, allow_nan=False, separators=(",", ":"))
