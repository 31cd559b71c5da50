"""What is run for the tables of Xue et al. 2024, and the rows that come of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from paper_rows import Row
from xue2024_cases import WINDOW, Case, Tally

TRACKS = ("straight", "accelerating", "spiral")
#: Noise of the two-way travel times, s: as the paper states it, between, and as its errors show it.
STATED, MIDDLE, EFFECTIVE = 1e-4, 1e-3, 1.15e-3
SIGMAS = (STATED, MIDDLE, EFFECTIVE)
WNOA, WNOJ = "constant_velocity", "constant_acceleration"
CV, CA, SPACE = "constant velocity", "constant acceleration", "space intersection"

#: Windows of Fig. 5, pings 10 s apart.
FIG5 = (6, 7, 8, 9, 10, 12, 16, 20, 24, 32)
#: Table 1: where the passing track begins, m. The paper does not say.
PASSING = (-2000.0, 2000.0, -8000.0)
#: Motion priors and their noise that were given beforehand, at the effective noise and the stated.
GIVEN = {
    EFFECTIVE: (
        ("straight", WNOA, 1e-8),
        ("straight", WNOA, 1e-5),
        ("straight", WNOJ, 1e-8),
        ("straight", WNOJ, 1e-5),
        ("accelerating", WNOJ, 1e-10),
        ("accelerating", WNOJ, 1e-8),
        ("accelerating", WNOA, 1e-3),
        ("accelerating", WNOJ, 1e-5),
        ("spiral", WNOJ, 1e-5),
        ("spiral", WNOJ, 1e-4),
        ("spiral", WNOA, 1e-2),
    ),
    STATED: (
        ("straight", WNOA, 1e-8),
        ("straight", WNOJ, 1e-8),
        ("straight", WNOJ, 1e-5),
        ("accelerating", WNOJ, 1e-10),
        ("accelerating", WNOJ, 1e-8),
        ("spiral", WNOJ, 1e-5),
        ("spiral", WNOJ, 1e-4),
        ("spiral", WNOA, 1e-2),
    ),
}
#: Far too little motion noise for the track.
TOO_LITTLE = (("spiral", WNOA, 1e-5), ("spiral", WNOJ, 1e-8), ("accelerating", WNOA, 1e-8))
#: The track drawn from the prior, m^2/s^3.
WANDERING = 2e-4

#: What the paper prints.
TABLE_1 = {CV: {"position": 0.627, "velocity": 0.568}, CA: {"position": 0.531, "velocity": 0.455}}
TABLE_2 = {
    "straight": (107.6066, 1.5000),
    "accelerating": (114.8206, 1.5029),
    "spiral": (431.0249, 1.4982),
}
TABLE_3 = {1: (34.7739, 1.4510), 3: (104.4979, 1.4473), 4: (147.6306, 1.5368)}
TABLE_4 = {
    (CV, "straight"): (1.3893, 2.4948, 0.7975),
    (CV, "accelerating"): (1.5879, 2.9749, 0.8006),
    (CV, "spiral"): (34.8994, 85.3297, 0.7867),
    (CA, "straight"): (2.8209, 7.7028, 1.6857),
    (CA, "accelerating"): (2.3941, 6.0391, 1.6747),
    (CA, "spiral"): (4.1545, 11.7369, 1.4260),
}

Found = Mapping[Any, Tally]


@dataclass(frozen=True)
class Plan:
    """How much is run; which rows there are does not depend on it.

    Attributes
    ----------
    seeds : int
        Of every row but those below.
    given, alone : int
        Seeds of the rows with given noise, and of windows smoothed alone.
    stride : int
        One window in so many is smoothed alone.
    """

    seeds: int = 10
    given: int = 6
    alone: int = 3
    stride: int = 1


FULL, QUICK = Plan(), Plan(1, 1, 1, 12)


def cases(plan: Plan) -> list[Case]:
    """All that is run, the longest first."""
    seeds = range(1, plan.seeds + 1)
    speeds = [f"straight, {v} m/s" for v in TABLE_3 if v != 3]
    found = [
        Case("likelihood", track, sigma, seed, lags=lags_of(track, sigma))
        for sigma in (MIDDLE, STATED, EFFECTIVE)
        for track in ("accelerating", "straight", "spiral")
        for seed in seeds
    ]
    found += [Case("likelihood", track, STATED, s) for track in speeds for s in seeds]
    for sigma, settings in GIVEN.items():
        for track, motion, psd in settings:
            found += [Case("given", track, sigma, s, motion, psd) for s in range(1, plan.given + 1)]
    for track, motion, psd in GIVEN[EFFECTIVE]:
        found += [
            Case("alone", track, EFFECTIVE, s, motion, psd, stride=plan.stride)
            for s in range(1, plan.alone + 1)
        ]
    for track, motion, psd in TOO_LITTLE:
        found += [
            Case("too little", track, EFFECTIVE, s, motion, psd) for s in range(1, plan.given + 1)
        ]
    found += [
        Case("wrong speed", track, EFFECTIVE, s)
        for track in TRACKS
        for s in range(1, plan.given + 1)
    ]
    found += [Case("consistency", "wandering", MIDDLE, s, WNOA, WANDERING) for s in seeds]
    found += [Case("correlation", passing(x), STATED, s) for x in PASSING for s in seeds]
    return found


def passing(begin: float) -> str:
    """Name of the track that begins there, m east."""
    return f"passing, {begin:g} m"


def lags_of(track: str, sigma: float) -> tuple[int, ...]:
    """Windows of Fig. 5 where they are drawn, else the paper's own."""
    return FIG5 if (track, sigma) == ("accelerating", MIDDLE) else (WINDOW,)


def rows(found: Found) -> list[Row]:
    """All tables' rows."""
    makers = (
        _table_1,
        _table_2,
        _table_3,
        _table_4,
        _whole_track,
        _figure_5,
        _given,
        _alone,
        _too_little,
        _wrong_speed,
        _consistency,
    )
    return [row for maker in makers for row in maker(found)]


def row(
    table: str,
    case: str,
    quantity: str,
    unit: str | None,
    paper: float | None,
    baseline: float | None,
    graph: float | None = None,
) -> Row:
    """One row of the file."""
    return {
        "table": table,
        "case": case,
        "quantity": quantity,
        "unit": unit,
        "paper": paper,
        "baseline": baseline,
        "graph": graph,
    }


def best(tally: Tally, epoch: str, pings: int = WINDOW) -> float | None:
    """Error of the paper's best moving window."""
    errors = [tally.rms(f"{model} {epoch} {pings}") for model in (CV, CA)]
    return min((e for e in errors if e is not None), default=None)


def _of(found: Found, *key: Any) -> Tally:
    """What was counted; nothing where all cases failed."""
    return found.get(key, Tally())


def _noise(sigma: float) -> str:
    return f"{1e3 * sigma:g} ms"


def _table_1(found: Found) -> Iterator[Row]:
    for begin in PASSING:
        tally = _of(found, "correlation", passing(begin), STATED, "", 0.0)
        for model, printed in TABLE_1.items():
            for what, value in printed.items():
                yield row(
                    "Table 1",
                    f"{model}, from {begin:g} m east",
                    f"correlation of {what} error and DOP",
                    None,
                    value,
                    tally.mean(f"{model} {what}"),
                )


def _table_2(found: Found) -> Iterator[Row]:
    for track, (error, dop) in TABLE_2.items():
        yield from _intersection(
            "Table 2", track, _of(found, "likelihood", track, STATED, "", 0.0), error, dop
        )


def _table_3(found: Found) -> Iterator[Row]:
    for speed, (error, dop) in TABLE_3.items():
        name = "straight" if speed == 3 else f"straight, {speed} m/s"
        tally = _of(found, "likelihood", name, STATED, "", 0.0)
        yield from _intersection("Table 3", f"straight, {speed} m/s", tally, error, dop)


def _intersection(table: str, case: str, tally: Tally, error: float, dop: float) -> Iterator[Row]:
    label = f"{SPACE}, {case}, {_noise(STATED)}"
    window, lag = tally.rms(f"{SPACE} current {WINDOW}"), tally.rms(f"lag current {WINDOW}")
    yield row(table, label, "current", "m", error, window, lag)
    yield row(table, label, "TRDOP", None, dop, tally.mean(f"{SPACE} TRDOP {WINDOW}"))


def _table_4(found: Found) -> Iterator[Row]:
    for sigma in SIGMAS:
        for (model, track), printed in TABLE_4.items():
            tally = _of(found, "likelihood", track, sigma, "", 0.0)
            label = f"{model}, {track}, {_noise(sigma)}"
            for epoch, value in zip(("centre", "current"), printed[:2], strict=True):
                window = tally.rms(f"{model} {epoch} {WINDOW}")
                lag = tally.rms(f"lag {epoch} {WINDOW}")
                yield row("Table 4", label, epoch, "m", value, window, lag)
            if sigma == EFFECTIVE:
                dop = tally.mean(f"{model} TRDOP {WINDOW}")
                yield row("Table 4", f"{model}, {track}", "TRDOP", None, printed[2], dop)


def _whole_track(found: Found) -> Iterator[Row]:
    for sigma in SIGMAS:
        for track in TRACKS:
            tally = _of(found, "likelihood", track, sigma, "", 0.0)
            label = f"best window, {track}, {_noise(sigma)}"
            yield row(
                "Whole track smoothed",
                label,
                "centre",
                "m",
                _printed(track, "centre"),
                best(tally, "centre"),
                tally.rms("whole"),
            )


def _printed(track: str, epoch: str) -> float:
    """What the paper prints for its best moving window."""
    place = ("centre", "current").index(epoch)
    return min(TABLE_4[model, track][place] for model in (CV, CA))


def _figure_5(found: Found) -> Iterator[Row]:
    tally = _of(found, "likelihood", "accelerating", MIDDLE, "", 0.0)
    for model in (CV, CA):
        for pings in FIG5:
            label = f"{model}, {10 * pings} s, accelerating, {_noise(MIDDLE)}"
            for epoch in ("centre", "current"):
                # None where the guard has refused: 60 s are six pings for six parameters.
                window = tally.rms(f"{model} {epoch} {pings}")
                lag = tally.rms(f"lag {epoch} {pings}")
                yield row("Fig. 5", label, epoch, "m", None, window, lag)


def _setting(track: str, motion: str, psd: float, sigma: float, window: str = "best window") -> str:
    name, unit = ("WNOA", "m^2/s^3") if motion == WNOA else ("WNOJ", "m^2/s^5")
    return f"{window}, {track}, {_noise(sigma)}, {name} {psd:g} {unit}"


def _given(found: Found) -> Iterator[Row]:
    for sigma, settings in GIVEN.items():
        for track, motion, psd in settings:
            tally = _of(found, "given", track, sigma, motion, psd)
            label = _setting(track, motion, psd, sigma)
            for what, epoch, graph in (
                ("whole track", "centre", "whole"),
                ("centre", "centre", f"lag centre {WINDOW}"),
                ("current", "current", f"lag current {WINDOW}"),
            ):
                yield row(
                    "Motion noise given",
                    label,
                    what,
                    "m",
                    _printed(track, epoch),
                    best(tally, epoch),
                    tally.rms(graph),
                )


def _alone(found: Found) -> Iterator[Row]:
    """Without memory: a motion prior against the window of the same motion."""
    for track, motion, psd in GIVEN[EFFECTIVE]:
        tally = _of(found, "alone", track, EFFECTIVE, motion, psd)
        model = CV if motion == WNOA else CA
        for place, epoch in enumerate(("centre", "current")):
            yield row(
                "Eight pings alone",
                _setting(track, motion, psd, EFFECTIVE, model),
                epoch,
                "m",
                TABLE_4[model, track][place],
                tally.rms(f"{model} {epoch} {WINDOW}"),
                tally.rms(f"alone {epoch}"),
            )


def _too_little(found: Found) -> Iterator[Row]:
    for track, motion, psd in TOO_LITTLE:
        tally = _of(found, "too little", track, EFFECTIVE, motion, psd)
        yield row(
            "Too little motion noise",
            _setting(track, motion, psd, EFFECTIVE),
            "whole track",
            "m",
            _printed(track, "centre"),
            best(tally, "centre"),
            tally.rms("whole"),
        )


def _wrong_speed(found: Found) -> Iterator[Row]:
    for track in TRACKS:
        tally = _of(found, "wrong speed", track, EFFECTIVE, "", 0.0)
        for state in ("given", "estimated"):
            yield row(
                "Told 1500 m/s",
                f"best window, {track}, {_noise(EFFECTIVE)}, sound speed {state} in the graph",
                "whole track",
                "m",
                None,
                best(tally, "centre"),
                tally.rms(f"whole, {state}"),
            )


def _consistency(found: Found) -> Iterator[Row]:
    tally = _of(found, "consistency", "wandering", MIDDLE, WNOA, WANDERING)
    label = f"track drawn from WNOA {WANDERING:g} m^2/s^3, {_noise(MIDDLE)}"
    for what, name in (
        ("whole track", "whole"),
        ("centre", f"lag centre {WINDOW}"),
        ("current", f"lag current {WINDOW}"),
    ):
        error, predicted = tally.rms(name), tally.rms(f"{name} predicted")
        ratio = error / predicted if error is not None and predicted else None
        yield row("Own noise", label, f"RMSE over predicted sigma, {what}", None, None, None, ratio)
