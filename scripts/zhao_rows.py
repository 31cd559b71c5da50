"""The rows of the Zhao study: the paper's numbers, those of its filters here, and the graph's."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from paper_rows import Row
from scipy.stats import chi2
from zhao_cases import LOST, Found, Lagged, Runs, Targets
from zhao_plan import (
    BOTH,
    NEES_TIMES,
    NOISY,
    SHORT,
    TIMES,
    Plan,
    groups,
    label,
    noisy_settings,
)

from ubl_graph.arrays import FloatArray
from ubl_graph.sim import ZhaoSettings
from ubl_graph.sim.zhao import TARGET_TIME
from ubl_graph.sim.zhao_fleet import NAMES

#: The mean NEES lies outside its bounds this often by chance.
CHANCE = 1e-3
#: What the paper prints: own errors, smallest and largest error of the target, m.
OWN = {"plain": 36.0, "fused": 14.0}
MAP = {"plain": (15.0, 124.0), "fused": (14.0, 98.0), "nearest_master": (13.0, 97.0)}
TITLES = {"plain": "plain", "fused": "fused", "nearest_master": "two masters, each to the nearest"}

Results = Mapping[Runs, Found]


def rows(plan: Plan, results: Results) -> list[Row]:
    """All tables' rows."""
    found = {name: results[case.group] for name, case in groups(plan).items()}
    makers = (own, target_once, masters, batch, lagged, all_pairs, targets_always)
    out = [r for maker in makers for r in maker(found)]
    out += [r for maker in (consistency, growth, random_targets) for r in maker(found)]
    return out


def row(
    table: str,
    case: str,
    quantity: str,
    unit: str | None = "m",
    *,
    paper: float | None = None,
    baseline: float | None = None,
    graph: float | None = None,
) -> Row:
    """One row of the file."""
    return {
        "table": table,
        "case": case,
        "quantity": quantity,
        "unit": unit,
        "paper": paper,
        "baseline": None if baseline is None else float(baseline),
        "graph": None if graph is None else float(graph),
    }


def counted(found: Found, settings: ZhaoSettings | None = None) -> str:
    """A row's case: how many runs it rests on, and of which settings."""
    begin = "" if settings is None else f"{label(settings)}, "
    return f"{begin}{found.runs} runs" if found.runs > 1 else f"{begin}1 run"


def followers(errors: FloatArray) -> FloatArray:
    """Errors (..., F) of those (..., A) that are no masters."""
    return errors[..., 1:]


def own(found: Mapping[str, Found]) -> Iterator[Row]:
    """Fig. 6: largest own error of the plain and the fused system."""
    for settings, here in filtered(found, ""):
        for system, paper in OWN.items():
            errors = followers(here.rms(f"own {system}"))
            title = f"{system}, own position, largest of AUVs and times"
            case = counted(here, settings)
            yield row("Fig. 6", case, title, paper=paper, baseline=errors.max())


def filtered(found: Mapping[str, Found], masters: str) -> Iterator[tuple[ZhaoSettings, Found]]:
    """What the filters gave: with both settings, and with the first of them in many runs."""
    name = masters or "filters"
    yield from ((s, found[f"{name}, {label(s)}"]) for s in BOTH)
    yield SHORT, found[f"many, {masters}" if masters else "many"]


def target_once(found: Mapping[str, Found]) -> Iterator[Row]:
    """Fig. 7: a target that is ranged once."""
    for settings, here in filtered(found, ""):
        for system in ("plain", "fused"):
            yield from map_rows("Fig. 7", here, settings, system)
    yield from map_errors("Fig. 7", found["map, once"], SHORT, "fused filter or graph, ranged once")


def masters(found: Mapping[str, Found]) -> Iterator[Row]:
    """Fig. 8: the same with two masters."""
    for settings, here in filtered(found, "two masters"):
        yield from map_rows("Fig. 8", here, settings, "nearest_master")
    yield from map_errors("Fig. 8", found["map, two masters"], SHORT, "two masters, ranged once")


def map_rows(table: str, here: Found, settings: ZhaoSettings, system: str) -> Iterator[Row]:
    """Smallest and largest error of a filter's map beside the paper's."""
    errors = here.rms(f"map {system}")
    for what, number, paper in zip(
        ("smallest", "largest"), (errors.min(), errors.max()), MAP[system], strict=True
    ):
        title = f"{TITLES[system]}, target ranged once, {what} on the map"
        yield row(table, counted(here, settings), title, paper=paper, baseline=number)


def map_errors(table: str, here: Found, settings: ZhaoSettings, name: str) -> Iterator[Row]:
    """Errors over a map of the filter with multilateration and of the graph, on the same runs."""
    theirs, ours = here.rms("filter"), here.rms("graph")
    side = round(np.sqrt(len(ours)))
    case = f"{counted(here, settings)}, {side} x {side} places"
    for what, both in (
        ("mean", (theirs.mean(), ours.mean())),
        ("smallest", (theirs.min(), ours.min())),
        ("largest", (theirs.max(), ours.max())),
    ):
        yield row(table, case, f"{name}, {what} on the map", baseline=both[0], graph=both[1])


def batch(found: Mapping[str, Found]) -> Iterator[Row]:
    """The graph over the whole run, with the filter's own ranges."""
    for settings in BOTH:
        here = found[f"smoothed, {label(settings)}"]
        yield from own_rows("Batch", here, settings, "whole run")


def own_rows(table: str, here: Found, settings: ZhaoSettings, name: str) -> Iterator[Row]:
    """Own errors of filter and graph at the same times of the same runs."""
    theirs, ours = followers(here.rms("own filter")), followers(here.rms("own graph"))
    yield from error_rows(table, counted(here, settings), name, ours, theirs)


def error_rows(
    table: str, case: str, name: str, ours: FloatArray, theirs: FloatArray | None
) -> Iterator[Row]:
    """Largest error, and each AUV's mean over time, of errors (N, F)."""
    yield row(
        table,
        case,
        f"{name}, largest of AUVs and times",
        baseline=None if theirs is None else theirs.max(),
        graph=ours.max(),
    )
    for a, who in enumerate(NAMES[1:]):
        yield row(
            table,
            case,
            f"{name}, time mean, {who}",
            baseline=None if theirs is None else theirs[:, a].mean(),
            graph=ours[:, a].mean(),
        )


def lagged(found: Mapping[str, Found]) -> Iterator[Row]:
    """The graph under way."""
    for settings in BOTH:
        here = found[f"lagged, {label(settings)}"]
        lag = Lagged.lag
        for name, title in (("delayed", f"delayed by {lag:g} s"), ("current", "newest epoch")):
            theirs, ours = (followers(here.rms(f"{who} {name}")) for who in ("filter", "graph"))
            case = counted(here, settings)
            yield from error_rows(f"Fixed lag, {lag:g} s", case, title, ours, theirs)


def all_pairs(found: Mapping[str, Found]) -> Iterator[Row]:
    """The graph with six ranges a period, where the filter has three: no baseline."""
    for settings in BOTH:
        here = found[f"all pairs, {label(settings)}"]
        case = f"{counted(here, settings)}, more data than the filter's"
        ours = followers(here.rms("own graph"))
        yield from error_rows("All six pairs ranged", case, "whole run", ours, None)


def targets_always(found: Mapping[str, Found]) -> Iterator[Row]:
    """A target that is ranged each period."""
    epochs = int(TARGET_TIME / SHORT.period)
    yield from map_errors(
        "Target ranged each period", found["map, always"], SHORT, f"all {epochs} ranging times"
    )


def nees_bounds(runs: int) -> tuple[float, float]:
    """Where the mean over runs of a NEES of two freedoms, over two, is but for `CHANCE`."""
    low, high = chi2.ppf([CHANCE / 2.0, 1.0 - CHANCE / 2.0], 2 * runs) / (2 * runs)
    return float(low), float(high)


def consistency(found: Mapping[str, Found]) -> Iterator[Row]:
    """NEES over its degrees of freedom: 1 for errors as large as their covariance says."""
    here = found["consistency"]
    low, high = nees_bounds(here.runs)
    case = f"{counted(here, SHORT)}, 99.9 % within {low:.2f} to {high:.2f}"
    theirs, ours = here.mean("filter") / 2.0, here.mean("graph") / 2.0
    for a, who in list(enumerate(NAMES))[1:]:
        for n, t in enumerate(NEES_TIMES):
            title = f"NEES over 2, {who}, at {t:g} s"
            yield row("Consistency", case, title, None, baseline=theirs[n, a], graph=ours[n, a])
    number = float(here.mean("target")) / 2.0
    yield row("Consistency", case, "NEES over 2, target", None, graph=number)


def growth(found: Mapping[str, Found]) -> Iterator[Row]:
    """Fig. 9: how errors grow with the noise of speed and yaw rate."""
    for name, settings in noisy_settings().items():
        here = found[f"filters, {name}"]
        case = f"{name}, {counted(here, settings)}"
        for system in ("plain", "fused"):
            for what, key in (("own position, largest of AUVs and times", "own"), ("map", "map")):
                errors = here.rms(f"{key} {system}")
                title = "target ranged once, largest on the map" if key == "map" else what
                yield row("Fig. 9", case, f"{system}, {title}", baseline=errors.max())
        for system in ("plain", "fused"):
            number = np.median(here.kept[f"largest {system}"])
            title = f"{system}, own position, largest of a run, median of the runs"
            yield row("Fig. 9", case, title, baseline=number)
        lost = (here.kept["largest fused"] > LOST).sum()
        title = f"fused, runs that are off by more than {LOST:g} m"
        yield row("Fig. 9", case, title, None, baseline=lost)
        here = found[f"smoothed, {name}"]
        theirs, ours = (followers(here.rms(f"own {who}")) for who in ("filter", "graph"))
        case = f"{name}, {counted(here, settings)}"
        numbers = {"baseline": theirs.max(), "graph": ours.max()}
        yield row("Fig. 9", case, "graph over the whole run, largest of AUVs and times", **numbers)


def random_targets(found: Mapping[str, Found]) -> Iterator[Row]:
    """Fig. 10: targets anywhere, ranged once, with much noise."""
    for t in TIMES:
        here = found[f"targets, {t:g} s"]
        errors = target_errors(here)
        targets = errors["graph"].shape[1]
        case = f"{label(NOISY)}, at {t:g} s, {targets} targets, {counted(here)} each"
        for what, number in (("rms", rms), ("median", np.median)):
            yield row("Fig. 10", case, f"plain, {what}", baseline=number(errors["plain"]))
            numbers = {"baseline": number(errors["fused"]), "graph": number(errors["graph"])}
            yield row("Fig. 10", case, f"fused filter or graph, {what}", **numbers)


def target_errors(here: Found) -> dict[str, FloatArray]:
    """Errors (R, T), m, by system."""
    targets = here.kept["graph"].shape[1]
    places = Targets(NOISY, 0, 1, targets).places
    return {
        name: np.linalg.norm(here.kept[name] - places, axis=-1)
        for name in ("plain", "fused", "graph")
    }


def rms(errors: FloatArray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(errors**2)))
