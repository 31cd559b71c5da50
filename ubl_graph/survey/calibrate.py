"""calibrate(mission) -> SurveyResult: where the beacons are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ubl_graph.errors import DataError
from ubl_graph.mission import Mission
from ubl_graph.smoother import SUSPICIOUS_SHARE
from ubl_graph.survey.joint import JointSurvey
from ubl_graph.survey.known import KnownSurvey, known_pings, range_count
from ubl_graph.survey.model import SurveyOptions
from ubl_graph.survey.result import SurveyResult
from ubl_graph.work import Progress, Work

#: Fixes say where the track is when they do so at this share of the ranges; the others are left
#: out.
KNOWN_SHARE = 0.9
#: Fewer ranges than this to a beacon leave no residual that could tell of an error.
FEWEST_RANGES = 4


def calibrate(
    mission: Mission, options: SurveyOptions | None = None, progress: Progress | None = None
) -> SurveyResult:
    """Survey a mission's beacons: their positions, from a vehicle whose track is known.

    Where position fixes every 2 s or closer, or at the very times of the ranges, say where the
    vehicle is, the track is taken from them, and the sound speed is estimated with horizontal
    gradients. Otherwise vehicle and beacons are estimated together, with the mission's own motion,
    odometry and fixes.

    Parameters
    ----------
    mission : Mission
        With beacons near where they are. A beacon's sigma is a prior on its given position; 0 is
        none. A garpos mission is to be loaded with ``load_mission(file, known_track=True)``.
    options : SurveyOptions, optional
        What is estimated beside the beacons.
    progress : callable, optional
        Called now and then with a text and the share done.

    Returns
    -------
    SurveyResult
        With status "unobservable" and the reason where the data leave a beacon open.

    Raises
    ------
    DataError
        Where there is no range.
    ConfigurationError
        Where nothing says where the track is.
    SolverError
        Where a solver fails on data that are sound.

    Examples
    --------
    >>> from ubl_graph.sim import straight_pass
    >>> mission, truth = straight_pass(seed=1)
    >>> result = calibrate(mission)
    >>> result.status, result.check.named
    ('converged', ())
    """
    options = SurveyOptions() if options is None else options
    count = range_count(mission.segments)
    if not count:
        raise DataError("the mission holds no range", "a survey needs ranges to the beacons")
    work = Work(mission.options.max_iterations, progress)
    with work.stage("track"):
        parts, lost = known_pings(mission)
    if count - lost >= KNOWN_SHARE * count:
        if lost:
            work.warn("", f"{lost} of {count} ranges lie where no fix is near; they are left out")
        result = KnownSurvey(work, mission, parts, options).run()
    else:
        result = JointSurvey(work, mission, options).run()
    _judge(work, result)
    return replace(result, warnings=tuple(work.warnings), wall_times=work.wall_times)


def _judge(work: Work, result: SurveyResult) -> None:
    """Warn of what does not stop a solver but should stop a user."""
    heard = np.unique(result.residuals.beacon)
    silent = [n for n in result.mission.beacon_names if n not in heard]
    if silent:
        work.warn("", f"never heard, and left as given: {', '.join(silent)}")
    for name in heard:
        count = int((result.residuals.beacon == name).sum())
        if count < FEWEST_RANGES:
            many = "range" if count == 1 else "ranges"
            work.warn("", f"with {count} {many} to '{name}' no error of one shows")
    share = float(result.residuals.down_weighted.mean())
    if share > SUSPICIOUS_SHARE:
        work.warn(
            "",
            f"{100 * share:.0f} % of the ranges are down-weighted; check track, sound speed and "
            "sigmas before trusting this survey",
        )
    blind = int((~result.residuals.found).sum())
    if blind:
        work.warn(
            "", f"{blind} ranges have no direct ray at the estimate; a straight line stands in"
        )
