"""Where nodes stand: never so close that double precision loses where they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ubl_graph import (
    Beacon,
    Mission,
    Options,
    Segment,
    SoundSpeedProfile,
    Start,
    TwoWayRange,
    smooth,
)
from ubl_graph.graph import model_segment
from ubl_graph.sim import Sea, ahrs, constant_velocity, dvl, pressure, two_way_pings
from ubl_graph.sim.tracks import Truth

PROFILE = SoundSpeedProfile.constant(1495.0)
TRUTH = constant_velocity([-100.0, 0.0, -20.0], [1.5, 0.2, 0.0], (-5.0, 400.0))
BEACONS = (
    Beacon("A", [0.0, 300.0, -200.0], turnaround=0.4),
    Beacon("B", [-150.0, -250.0, -210.0], turnaround=0.4),
    Beacon("C", [300.0, 50.0, -190.0], turnaround=0.4),
)
GAPS = [0.0, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 0.5]
MOTIONS = ["constant_velocity", "constant_acceleration"]


def mission(truth: Truth, gap: float, what: str, motion: str) -> Mission:
    """Something asks for a node `gap` seconds after a ping does."""
    rng = np.random.default_rng(0)
    sent = 5.0 * np.arange(40)
    pings = two_way_pings(truth, BEACONS, sent, Sea(PROFILE), rng)
    kinds = {"depth": pressure(truth, np.arange(0.0, 205.0), rng)}
    if what == "start":
        east, north, up = truth.position(100.0 + gap)[0]
        kinds["start"] = Start(100.0 + gap, east, north, up, sigma=5.0)
    elif what == "DVL":
        times = np.arange(sent[4] + gap, 190.0, 0.5)
        kinds["velocity"] = dvl(truth, times, rng, noise=0.0)
        kinds["attitude"] = ahrs(truth, np.arange(-1.0, 210.0))
    else:
        extra = two_way_pings(truth, BEACONS, sent + gap, Sea(PROFILE), rng, noise=0.0)
        names = ("beacon", "t_transmit", "t_receive", "travel_time", "sigma")
        pings = TwoWayRange(*(np.append(getattr(pings, n), getattr(extra, n)) for n in names))
    options = Options(motion=motion, loss="none")
    return Mission((Segment("", pings, **kinds),), BEACONS, PROFILE, options=options)


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("what", ["start", "DVL", "pings"])
def test_how_close_two_times_are_changes_no_covariance(what, motion):
    """At any gap both solvers say what they say at half a second, give or take what it tells."""
    middle = {}
    for gap in GAPS:
        made = mission(TRUTH, gap, what, motion)
        results = [
            smooth(replace(made, options=replace(made.options, solver=solver)))
            for solver in ("banded", "gtsam")
        ]
        assert [r.status for r in results] == ["converged"] * 2, gap
        a, b = (r.segments[0].trajectory for r in results)
        np.testing.assert_allclose(a.position, b.position, atol=1e-6)
        middle[gap] = np.sqrt(np.einsum("nii->ni", a.at(np.arange(95.0, 106.0)).covariance))
        off = a.position - TRUTH.position(a.t)
        nees = np.einsum("ni,ni->n", off, np.linalg.solve(a.covariance, off[..., None])[..., 0])
        assert nees.max() < 30.0, gap
    for gap, sigma in middle.items():
        np.testing.assert_allclose(sigma, middle[0.5], rtol=0.1, err_msg=f"gap {gap}")


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("gap", GAPS)
def test_ends_and_breaks_of_odometry_stay(gap, motion):
    made = mission(TRUTH, gap, "DVL", motion)
    (segment,) = made.segments
    model = model_segment(segment, made.options)
    times = np.concatenate([segment.two_way_range.t_transmit, segment.two_way_range.t_receive])
    assert (model.t[0], model.t[-1]) == (times.min(), times.max())
    assert model.bottom is not None
    assert np.isin(model.bottom.breaks(), model.t).all()
    assert np.diff(model.t).min() > 0.03
