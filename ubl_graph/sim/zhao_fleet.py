"""Zhao's simulation as a fleet: the same measurements, as an estimator of this library takes them.

The yaw of the simulation, counter-clockwise from east, becomes a heading, clockwise from north.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from ubl_graph.acoustics import SoundSpeedProfile
from ubl_graph.arrays import ArrayLike, BoolArray, FloatArray
from ubl_graph.baselines.formation import checked
from ubl_graph.cooperative.fleet import Fleet, Member, Target
from ubl_graph.errors import ConfigurationError, DataError
from ubl_graph.measurements import Odometry, PositionFix, SlantRange
from ubl_graph.mission import Segment, Start
from ubl_graph.options import Options
from ubl_graph.segment import Reference
from ubl_graph.sim.zhao import TARGET_DEPTH, TARGET_TIME, TRACKS, VEHICLE_DEPTH, ZhaoRuns

SOUND_SPEED = 1500.0  #: m/s
NAMES = tuple(f"AUV{i}" for i in range(len(TRACKS)))
TARGET = "target"
#: Standard deviation of a target's east and north before any range, m: nothing is known.
ANYWHERE = 1e5
#: What stands for exact in a prior or a fix, m and rad. The yaw is 5 cm after an hour's way.
EXACT, EXACT_YAW = 1e-3, 1e-5
#: Odometry's sigma across the way, m a record. The model has no noise there, but a covariance must
#: be regular; a millimetre a second adds up to 6 cm in the hour, where dead reckoning errs by 30 m.
ACROSS = 1e-3

#: What an estimator knows of this simulation: level vehicles, white noise alone on speed and yaw
#: rate, ranges in metres without outliers.
ZHAO_OPTIONS = Options(
    node="pose2",
    estimate_sound_speed=False,
    odometry_scale_sigma=0.0,
    odometry_turn_bias_sigma_deg=0.0,
    loss="none",
)


def zhao_fleet(
    runs: ZhaoRuns,
    run: int = 0,
    *,
    pairs: ArrayLike | Literal["all"] | None = "all",
    target: ArrayLike | None = None,
    times: ArrayLike = TARGET_TIME,
    guess: ArrayLike | None = None,
    options: Options = ZHAO_OPTIONS,
) -> Fleet:
    """One simulated run as a fleet.

    Parameters
    ----------
    runs : ZhaoRuns
        What was simulated.
    run : int
        Which of them, from 0 on.
    pairs : array of int, shape (E, A), or "all", or None
        Which AUV each one ranges at each ranging time, -1 for none: `partner[run]` of what
        `zhao_ekf` gives makes it the filter's own data. All six pairs; or no ranges between AUVs. A
        pair's range stands with the AUV of the higher number.
    target : array, shape (2,), optional
        Where a target is that all AUVs range, east and north, m.
    times : float or array, shape (N,)
        At which ranging times they do, s.
    guess : array, shape (2,), optional
        Where the target is thought to be; left out, at the truth, where the baseline's Gauss-Newton
        starts as well. Its sigma of 100 km lets it weigh nothing.
    options : Options
        Of all vehicles and the fleet.

    Returns
    -------
    Fleet
        Vehicles "AUV0" to "AUV3", a target "target" at a known depth. All have odometry each step
        and an exact start; masters have exact fixes besides, at the start and at the ranging times.
        Segments carry the truth as reference.

    Raises
    ------
    ConfigurationError
        Where there is no such run.
    DataError
        Where pairs are not as above, a place is not two finite numbers, or noise made a range
        negative.
    TimeError
        Where a time is no ranging time.

    Examples
    --------
    >>> from ubl_graph.baselines import zhao_ekf
    >>> from ubl_graph.sim import zhao_runs
    >>> runs = zhao_runs(2)
    >>> partner = zhao_ekf(runs.data).partner
    >>> fleet = zhao_fleet(runs, 1, pairs=partner[1], target=[5000.0, 0.0])
    >>> [len(m.segment.slant_range) for m in fleet.vehicles]
    [1, 23, 23, 137]
    """
    if type(run) is not int or not 0 <= run < len(runs):
        raise ConfigurationError(
            f"there is no run {run!r}", f"choose 0 to {len(runs) - 1}", field="run"
        )
    linked = _links(runs, pairs)
    ranged = [_between(runs, run, a, linked[:, a]) for a in range(len(NAMES))]
    targets: tuple[Target, ...] = ()
    if target is not None:
        place = checked("target", target, (2,))
        thought = place if guess is None else checked("guess", guess, (2,))
        sigma = [ANYWHERE, ANYWHERE, 0.0]
        targets = (Target(TARGET, [*thought, -TARGET_DEPTH], sigma=sigma),)
        t = runs.data.t[runs.data.ranging_steps[runs.epochs(times)]]
        slant = runs.slant_ranges(place, times)[run]
        names, sigmas = np.full(len(t), TARGET), np.full(len(t), runs.settings.toa_sigma)
        for a, columns in enumerate(ranged):
            columns.append((t, names, slant[:, a], sigmas))
    return Fleet(
        tuple(
            Member(name, _segment(runs, run, a, ranged[a]), options=options)
            for a, name in enumerate(NAMES)
        ),
        targets=targets,
        sound_speed=SoundSpeedProfile.constant(SOUND_SPEED),
        options=options,
        name=f"Zhao, run {run}",
    )


#: Columns of a `SlantRange`: times, names, distances, sigmas.
_Columns = tuple[FloatArray, "np.ndarray[tuple[int], np.dtype[np.str_]]", FloatArray, FloatArray]


def _segment(runs: ZhaoRuns, run: int, vehicle: int, ranged: list[_Columns]) -> Segment:
    """What one AUV measures."""
    data, truth = runs.data, runs.truth[:, vehicle]
    up = np.full(len(truth), -VEHICLE_DEPTH)
    along, turn = data.speed_sigma * data.dt, data.yaw_rate_sigma * data.dt
    east, north, yaw = truth[0]
    fixed = np.concatenate([[0], data.ranging_steps])
    slant = None
    if ranged:
        t, names, distances, sigmas = (np.concatenate(part) for part in zip(*ranged, strict=True))
        order = np.argsort(t, kind="stable")
        slant = SlantRange(t[order], names[order], distances[order], sigmas[order])
    return Segment(
        slant_range=slant,
        odometry=Odometry(
            data.t[:-1],
            data.t[1:],
            forward=data.speed[run, :, vehicle] * data.dt,
            right=0.0,
            about_down=-data.yaw_rate[run, :, vehicle] * data.dt,
            covariance=np.diag([along, ACROSS, turn]) ** 2,
        ),
        position=PositionFix(data.t[fixed], *truth[fixed, :2].T, sigma=EXACT)
        if vehicle in data.masters
        else None,
        start=Start(
            0.0,
            float(east),
            float(north),
            -VEHICLE_DEPTH,
            sigma=EXACT,
            heading=float(np.pi / 2.0 - yaw),
            heading_sigma=EXACT_YAW,
        ),
        reference=Reference(data.t, np.column_stack([truth[:, :2], up])),
    )


def _between(runs: ZhaoRuns, run: int, vehicle: int, linked: BoolArray) -> list[_Columns]:
    """Ranges of one AUV to others, as `linked` (E, A) says."""
    epochs, others = np.nonzero(linked)
    if not len(epochs):
        return []
    t = runs.data.t[runs.data.ranging_steps[epochs]]
    read = runs.data.ranges[run, epochs, vehicle, others]
    return [(t, np.array(NAMES)[others], read, np.full(len(t), runs.data.range_sigma))]


def _links(runs: ZhaoRuns, pairs: ArrayLike | Literal["all"] | None) -> BoolArray:
    """Which AUV holds the range to which at each ranging time, (E, A, A)."""
    epochs, vehicles = len(runs.data.ranging_steps), len(NAMES)
    out = np.zeros((epochs, vehicles, vehicles), dtype=np.bool_)
    if pairs is None:
        return out
    if isinstance(pairs, str):
        if pairs != "all":
            raise DataError(f"'{pairs}' names no pairs", "give 'all' or an array", field="pairs")
        out[:] = True
    else:
        partner = checked("pairs", pairs, (epochs, vehicles)).astype(np.int64)
        if not (
            np.array_equal(partner, pairs)
            and (partner >= -1).all()
            and (partner < vehicles).all()
            and (partner != np.arange(vehicles)).all()
        ):
            raise DataError(
                f"partners must be -1, or one of the AUVs 0 to {vehicles - 1} but itself",
                "give `partner[run]` of a FormationEstimate",
                field="pairs",
            )
        e, a = np.nonzero(partner >= 0)
        out[e, a, partner[e, a]] = out[e, partner[e, a], a] = True
    return np.tril(out, -1)
