"""Are the sigmas true? A verdict from held-out pings, and covariances that it mends.

The pings that are kept out say by how much each source of noise is larger than stated; what that
makes of the track's covariance, the estimate left as it is, is known (`noise_sources`). The square
root of the mean ratio is the factor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from ubl_graph.arrays import FloatArray
from ubl_graph.errors import SolverError
from ubl_graph.held_out import Prediction, counted, predictions
from ubl_graph.mission import Mission, Segment
from ubl_graph.noise_sources import SOURCES, STATED, pings_of, track_shares
from ubl_graph.pose_trajectory import PoseTrajectory
from ubl_graph.result import RangeResiduals, Result, SegmentResult, Shared
from ubl_graph.solved import excerpts, solved_again
from ubl_graph.trajectory import NodeCovariance, Trajectory
from ubl_graph.variance_fit import VarianceFit
from ubl_graph.verdict import Consistency, Whiteness

#: Fewer blocks than this give no verdict.
LEAST_BLOCKS = 8
#: Where priors and the like make more than this share of the variance there is none either.
MOST_UNSEEN = 0.5
#: Lags of Ljung and Box's test, at most.
LAGS = 10


def assess(result: Result) -> Consistency:
    """Judge a result's covariances by pings that are kept out and predicted.

    Neither residuals of the solve nor the reference have a part in it.

    Parameters
    ----------
    result : Result
        Of `smooth`, with formal covariances.

    Returns
    -------
    Consistency
        With `trouble` instead of a verdict where no segment's track is determined, where there are
        fewer than 8 blocks of pings to predict, or where most of the track's variance comes from
        what no ping can judge. Segments that are not determined have no part in it.
    """
    if result.consistency is not None and result.consistency.applied:
        return result.consistency
    whiteness = {} if result.residuals is None else whiteness_of(result.residuals)
    sound = {s.name for s in result.segments if s.status == "converged"}
    left_out = tuple(s.name for s in result.segments if s.name not in sound)
    if not sound:
        return Consistency(trouble=f"the result is {result.status}", whiteness=whiteness)
    told: list[Prediction] = []
    shares: list[FloatArray] = []
    try:
        for solved in solved_again(result):
            pings = pings_of(solved)
            if len(pings) and sound.issuperset(m.segment.name for m in solved.models):
                shares.append(track_shares(solved, pings))
                told += [p for part in excerpts(result, solved) for p in predictions(part)]
    except SolverError as error:
        return Consistency(trouble=str(error), whiteness=whiteness)
    blocks, pings = counted(told)
    if blocks < LEAST_BLOCKS:
        trouble = (
            f"there are {blocks} blocks of pings, a minute or longer, with others on either side; "
            f"{LEAST_BLOCKS} would do"
        )
        return Consistency(trouble=trouble, blocks=blocks, pings=pings, whiteness=whiteness)
    return replace(_judged(told, np.concatenate(shares)), whiteness=whiteness, left_out=left_out)


def _judged(told: Sequence[Prediction], shares: FloatArray) -> Consistency:
    """The verdict of some predictions on a track whose variance comes from `shares` (M, 5)."""
    alone = [p for p in told if p.kind == "ping"]
    told = [p for p in told if p.kind != "ping"]
    fit, mean = VarianceFit(told), shares.mean(axis=0)
    best, each = fit.best(), fit.without_each()
    # Pings that are all but as long as their sigma are no predictions (`held_out.LOST`).
    if len(alone) >= len(each):
        single = VarianceFit(alone)
        best, each = _combined(best, single.best()), _combined(each, single.without_each())
    logs = 0.5 * np.log(each @ mean)
    # Jackknife over groups of neighbours (Efron and Tibshirani 1993, ch. 11).
    spread = float(np.sqrt((len(logs) - 1.0) * np.mean((logs - logs.mean()) ** 2)))
    # Divided by a factor that errs by `spread` itself, a squared error is too large on average.
    factor = _factor(best, mean) * float(np.exp(spread**2))
    blocks, pings = counted(told)
    unseen = float(mean[SOURCES.index("other")])
    trouble = ""
    if unseen > MOST_UNSEEN:
        trouble = (
            f"{100 * unseen:.0f} % of the track's variance comes from what no held-out ping can "
            "judge: starts, fixes, depths, and what is known of biases and beacons beforehand"
        )
    whitened = np.concatenate([p.whitened for p in told])
    unit = float(np.median([p.unit for p in told]))
    return Consistency(
        factor=factor,
        log_sigma=spread,
        noise={name: float(np.sqrt(best[k])) for k, name in enumerate(SOURCES[:3])},
        beacon_error=unit * float(np.sqrt(best[STATED])),
        shares={name: float(share) for name, share in zip(SOURCES, mean, strict=True)},
        blocks=blocks,
        pings=pings,
        nis=sum(p.nis for p in told) / len(whitened),
        coverage=float(np.mean(whitened**2 < chi2.ppf(0.95, 1))),
        trouble=trouble,
    )


def _combined(means: FloatArray, singles: FloatArray) -> FloatArray:
    """Variances (..., 5) by means over blocks, those of the ranges at least as by single pings.

    Errors that pings share show in means alone, where there are few of them; what each ping has for
    itself shows in single ones and can only be less than all.
    """
    out = means.copy()
    out[..., 0] = np.maximum(means[..., 0], singles[..., 0])
    return out


def _factor(variances: FloatArray, shares: FloatArray) -> float:
    """Factor on the track's sigmas.

    Motion and medium never count for less than stated: the mean over a minute does not see what is
    faster, and a vehicle that was quiet in these blocks need not be in others.
    """
    counted_as = variances.copy()
    counted_as[1:3] = np.maximum(counted_as[1:3], 1.0)
    return float(np.sqrt(counted_as @ shares))


def whiteness_of(residuals: RangeResiduals) -> dict[str, Whiteness]:
    """Autocorrelation of each beacon's residuals, ping after ping; outliers are left out.

    Source: Ljung and Box 1978, Q = n (n + 2) sum over lags of r_k^2 / (n - k), chi-square with as
    many degrees of freedom as lags for independent residuals. Those of a fit are a little less
    independent than the noise, and sums over segments count the pairs across their ends: Q is a
    sign, no proof.
    """
    out: dict[str, Whiteness] = {}
    for name in np.unique(residuals.beacon):
        mine = (residuals.beacon == name) & ~residuals.down_weighted
        value = (residuals.residual / residuals.sigma)[mine]
        value = value[np.argsort(residuals.t_receive[mine], kind="stable")]
        count = len(value)
        lags = min(LAGS, count // 4)
        centred = value - value.mean() if count else value
        power = float(centred @ centred)
        if lags < 1 or power == 0.0:
            continue
        lag = np.arange(1, lags + 1)
        r = np.array([centred[k:] @ centred[:-k] for k in lag]) / power
        q = float(count * (count + 2) * np.sum(r**2 / (count - lag)))
        out[str(name)] = Whiteness(count, float(r[0]), q, float(chi2.sf(q, lags)), lags)
    return out


def calibrated(result: Result) -> Result:
    """The same estimates with covariances that held-out pings call true.

    All covariances are multiplied by the square of one factor: of nodes and of times between them,
    of slow states, of beacons and of what nodes share. Where there is no verdict they stay.

    Parameters
    ----------
    result : Result
        Of `smooth`; its `consistency` is used where it has one.
    """
    found = assess(result) if result.consistency is None else result.consistency
    if found.trouble or found.applied:
        return replace(result, consistency=found)
    factor = found.factor
    return replace(
        result,
        segments=tuple(_scaled_segment(s, factor) for s in result.segments),
        beacons={name: _scaled_shared(s, factor) for name, s in result.beacons.items()},
        shared={name: _scaled_shared(s, factor) for name, s in result.shared.items()},
        consistency=replace(found, applied=True),
    )


def _scaled_shared(shared: Shared, factor: float) -> Shared:
    return replace(shared, covariance=factor**2 * shared.covariance, scale=factor * shared.scale)


def _scaled_segment(segment: SegmentResult, factor: float) -> SegmentResult:
    slow = {
        name: replace(s, sigma=factor * s.sigma, scale=factor * s.scale)
        for name, s in segment.slow.items()
    }
    others = tuple(
        replace(h, trajectory=_scaled_track(h.trajectory, factor)) for h in segment.hypotheses
    )
    track = _scaled_track(segment.trajectory, factor)
    return replace(segment, trajectory=track, slow=slow, hypotheses=others)


def _scaled_track(track: Trajectory, factor: float) -> Trajectory:
    square = factor**2
    horizontal, vertical = track.psd
    scaled = replace(
        track,
        covariance=square * track.covariance,
        psd=(square * horizontal, square * vertical),
        joint=_scaled_nodes(track.joint, square),
    )
    if not isinstance(scaled, PoseTrajectory):
        return scaled
    motion = _scaled_nodes(scaled.motion, square)
    assert motion is not None
    return replace(scaled, motion=motion, turning_psd=square * scaled.turning_psd)


def _scaled_nodes(joint: NodeCovariance | None, square: float) -> NodeCovariance | None:
    if joint is None:
        return None
    return NodeCovariance(square * joint.node, square * joint.following)


def inflated(mission: Mission, found: Consistency) -> Mission:
    """The mission with its stated noise multiplied by what held-out pings call it; never less.

    Ranges' sigmas; the velocities' and odometry's where there are any, else the noise density of
    the motion prior; the walk of the sound speed.

    Parameters
    ----------
    mission : Mission
        What `found` judged.
    found : Consistency
        Where no ping was predicted the mission stays as it is.
    """
    if not found.noise:
        return mission
    ranges, motion, medium = (max(found.noise[name], 1.0) for name in SOURCES[:3])
    options = mission.options
    segments = tuple(_inflated_segment(s, ranges, motion) for s in mission.segments)
    walks: dict[str, float] = {"sound_speed_walk": medium * options.number("sound_speed_walk")}
    walks["clock_walk"] = medium * options.clock_walk
    if not any(s.velocity is not None or s.odometry is not None for s in mission.segments):
        name = "acceleration_psd" if options.is_constant_velocity else "jerk_psd"
        walks[name] = motion**2 * options.horizontal_psd
        walks[f"vertical_{name}"] = motion**2 * options.vertical_psd
    if any(s.odometry is not None for s in mission.segments):
        # Records without a covariance have theirs from the options.
        for name in ("way_noise", "time_noise", "way_turn_noise_deg", "time_turn_noise_deg"):
            walks[f"odometry_{name}"] = motion * getattr(options, f"odometry_{name}")
    return replace(mission, segments=segments, options=replace(options, **walks))


def _inflated_segment(segment: Segment, ranges: float, motion: float) -> Segment:
    changes: dict[str, object] = {}
    for kind, factor in (
        ("two_way_range", ranges),
        ("one_way_range", ranges),
        ("slant_range", ranges),
        ("velocity", motion),
    ):
        records = getattr(segment, kind)
        if records is not None:
            changes[kind] = replace(records, sigma=factor * records.sigma)
    steps = segment.odometry
    if steps is not None and steps.covariance is not None:
        changes["odometry"] = replace(steps, covariance=motion**2 * steps.covariance)
    return replace(segment, **changes)  # pyright: ignore[reportArgumentType] - by name of the kind
