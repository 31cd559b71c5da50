"""Which given positions disagree with the data: each beacon in turn is left out.

Of a beacon that is left out nothing is believed beforehand; the data, and what was given of the
others, say where it is. The distance to where it was given, squared and divided by its covariance,
is chi-square distributed where nothing is wrong. As many beacons are looked at, the threshold is
that of the largest of them (Bonferroni): one false alarm in a hundred surveys.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.stats import chi2

from ubl_graph.arrays import FloatArray
from ubl_graph.beacon import Beacon
from ubl_graph.mission import Mission
from ubl_graph.survey.result import BeaconCheck, LeaveOneOut
from ubl_graph.survey.solving import Estimate
from ubl_graph.work import AMBIGUOUS_COST

#: Share of surveys without any fault in which some beacon is named.
FALSE_ALARMS = 0.01
#: Components of a position that a planar vehicle's ranges tell; up is held.
PLANE = 2
NOTHING_GIVEN = "no position was given with a standard deviation to check"


def thresholds(checks: Sequence[BeaconCheck]) -> dict[str, float]:
    """What each beacon's statistic may reach."""
    share = FALSE_ALARMS / max(len(checks), 1)
    return {c.name: float(chi2.isf(share, c.degrees_of_freedom)) for c in checks}


def distance_checks(
    mission: Mission,
    names: Sequence[str],
    position: FloatArray,
    covariance: FloatArray,
) -> LeaveOneOut:
    """Check what was given against positions that the data alone gave.

    Parameters
    ----------
    mission : Mission
        With the given positions and standard deviations; components of sigma 0 are not checked.
    names : sequence of str
        Beacons that were estimated.
    position, covariance : array, shapes (B, 3) and (3 B, 3 B)
        Without any prior.
    """
    given: Mapping[str, tuple[FloatArray, FloatArray]] = {
        b.name: (b.position, b.sigma) for b in mission.beacons
    }
    checks: list[BeaconCheck] = []
    for i, name in enumerate(names):
        place, sigma = given[name]
        known = sigma > 0.0
        if not known.any():
            continue
        own = covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] + np.diag(sigma**2)
        offset = position[i] - place
        part = own[np.ix_(known, known)]
        distance = float(offset[known] @ np.linalg.solve(part, offset[known]))
        checks.append(BeaconCheck(name, offset, own, distance, int(known.sum())))
    if not checks:
        return LeaveOneOut(reason=NOTHING_GIVEN)
    limits = thresholds(checks)
    bad = _beyond(checks, limits)
    return LeaveOneOut(tuple(checks), limits, tuple(c.name for c in bad))


def likelihood_checks(
    beacons: Sequence[Beacon],
    cost: float,
    trials: Mapping[str, Estimate],
    components: int | None,
) -> LeaveOneOut:
    """Check what was given by how much likelier the data are when a beacon is set free.

    Twice what the cost falls by is the squared distance of a linear problem, and holds where one
    beacon that is off bends the whole track.

    Parameters
    ----------
    beacons : sequence of Beacon
        As given: those of whose position something is known.
    cost : float
        With all that was given.
    trials : mapping of str to Estimate
        With each of them free, by name.
    components : int or None
        How many of a position were given: `PLANE` where up is held; None for those with a sigma.
    """
    checks: list[BeaconCheck] = []
    for beacon in beacons:
        trial = trials[beacon.name]
        place, covariance = trial.beacons([beacon.name])
        known = int((beacon.sigma > 0.0).sum()) if components is None else components
        fall = max(2.0 * (cost - trial.cost), 0.0)
        spread = covariance + np.diag(beacon.sigma**2)
        if components == PLANE:
            spread[PLANE:] = spread[:, PLANE:] = 0.0
        checks.append(BeaconCheck(beacon.name, place[0] - beacon.position, spread, fall, known))
    if not checks:
        return LeaveOneOut(reason=NOTHING_GIVEN)
    limits = thresholds(checks)
    bad = _beyond(checks, limits)
    if not bad:
        return LeaveOneOut(tuple(checks), limits)
    # To set any beacon free explains a part of what another one's error does.
    close = [c.name for c in bad if bad[0].statistic - c.statistic < 2.0 * AMBIGUOUS_COST]
    if len(close) > 1:
        return LeaveOneOut(tuple(checks), limits, undecided=tuple(close))
    return LeaveOneOut(tuple(checks), limits, (bad[0].name,))


def _beyond(checks: Sequence[BeaconCheck], limits: Mapping[str, float]) -> list[BeaconCheck]:
    """Checks beyond their limits, the worst first."""
    bad = [c for c in checks if c.statistic > limits[c.name]]
    return sorted(bad, key=lambda c: c.statistic, reverse=True)
