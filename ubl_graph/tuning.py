"""Noise chosen by the data: what "auto" means in the options.

The data are the more likely the better the noise describes them. Too little motion noise and the
pings contradict the track, too much and they could have been anything: the marginal likelihood
weighs both, and `noise_search` finds where it is largest.

It knows no better than the model: what the model leaves out (horizontal gradients of the sound
speed, say, which look like smooth motion) makes the likeliest noise too small, and covariances with
it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ubl_graph.errors import SolverError
from ubl_graph.mission import Mission
from ubl_graph.noise_search import NoiseSearch, Progress
from ubl_graph.options import AUTO, Motion

#: Both motion priors.
MOTIONS: tuple[Motion, ...] = ("constant_velocity", "constant_acceleration")


@dataclass(frozen=True)
class Tuning:
    """What the data chose.

    Attributes
    ----------
    chosen : dict of str to (float or str)
        Options that were "auto", and the vertical noise that goes with one, with their values.
    travel_time_factor : float
        By which the travel times' standard deviations were multiplied; 1 where that was not asked.
    log_evidence : dict of str to float
        Logarithm of the marginal likelihood, but for a constant of the data, by motion prior tried.
    evaluations : int
        How many noises were tried.
    trouble : str
        Why the defaults stand instead; empty where the data chose.
    """

    chosen: dict[str, float | str]
    travel_time_factor: float
    log_evidence: dict[str, float]
    evaluations: int
    trouble: str = ""


def tuned(mission: Mission, progress: Progress | None = None) -> tuple[Mission, Tuning]:
    """Put numbers where a mission's options say "auto".

    Parameters
    ----------
    mission : Mission
        With options left to the data.
    progress : callable, optional
        Called now and then with the share done.

    Returns
    -------
    Mission
        Without any "auto": with the numbers that make its data likeliest, the travel times' sigmas
        multiplied by the factor found. The defaults where no likelihood can be computed.
    Tuning
        What was chosen.
    """
    asked = mission.options
    settled = replace(mission, options=asked.settled)
    motions = MOTIONS
    if asked.motion != AUTO:
        motions = (asked.motion,)
    elif _has_odometry(mission):
        # Where odometry joins nodes there is no motion prior to judge.
        motions = MOTIONS[:1]
    found: dict[Motion, NoiseSearch] = {}
    trouble = ""
    for number, motion in enumerate(motions):
        try:
            search = NoiseSearch(settled, asked, motion)
            search.run(_part(progress, number, len(motions)))
        except SolverError as error:
            trouble = str(error)
            continue
        if np.isfinite(search.best):
            found[motion] = search
    if not found:
        trouble = trouble or "the data do not determine the track, whatever the noise"
        return settled, Tuning({}, 1.0, {}, 0, trouble)
    best = max(found.values(), key=lambda s: s.best)
    if best.scarce:
        return settled, Tuning({}, 1.0, {}, 0, best.scarce)
    out = best.answer()
    chosen: dict[str, float | str] = {
        name: getattr(out.options, name)
        for name in (*asked.automatic, *best.vertical)
        if name in best.names
    }
    if len(motions) > 1:
        chosen = {"motion": best.motion, **chosen}
    tuning = Tuning(
        chosen,
        best.factor,
        {motion: search.best for motion, search in found.items()},
        sum(search.evaluations for search in found.values()),
    )
    return out, tuning


def _part(progress: Progress | None, number: int, count: int) -> Progress:
    def report(share: float) -> None:
        if progress is not None:
            progress((number + share) / count)

    return report


def _has_odometry(mission: Mission) -> bool:
    return any(s.velocity is not None and len(s.velocity) > 1 for s in mission.segments)
