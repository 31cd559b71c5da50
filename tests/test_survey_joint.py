"""Surveys in which the track is found together with the beacons, and their leave-one-out check."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import gtsam
import numpy as np
import pytest

from ubl_graph.beacon import Beacon
from ubl_graph.errors import ConfigurationError
from ubl_graph.io.mission_file import load_mission
from ubl_graph.mission import Mission
from ubl_graph.sim import planar_vehicle, straight_pass
from ubl_graph.survey import calibrate

#: What L1's given position in goats 16 is off by, as the other three have it, m.
L1_OFF = np.array([10.0, 24.6, 0.0])


def planar(seed: int, moved: str = "", sigma: float = 0.5) -> Mission:
    """A planar vehicle whose beacons are given with errors of `sigma`, one of them 24 m off."""
    mission, _ = planar_vehicle(seed)
    rng = np.random.default_rng(1000 + seed)
    beacons: list[Beacon] = []
    for b in mission.beacons:
        error = sigma * rng.standard_normal(2)
        bearing = rng.uniform(0.0, 2.0 * np.pi)
        if b.name == moved:
            error = error + 24.0 * np.array([np.sin(bearing), np.cos(bearing)])
        beacons.append(Beacon(b.name, b.position + np.append(error, 0.0), [sigma, sigma, 0.0]))
    return replace(mission, beacons=tuple(beacons))


def test_a_beacon_moved_by_24_m_is_named():
    true = {b.name: b.position for b in planar_vehicle(1)[0].beacons}
    result = calibrate(planar(1, moved="B2"))
    assert result.method == "joint" and result.status == "converged"
    assert result.check.named == ("B2",)
    at = result.names.index("B2")
    assert np.linalg.norm(result.position[at] - true["B2"]) < 3.0
    assert "B2 seems off by" in result.verdict


@pytest.mark.slow
def test_clean_missions_raise_no_alarm_and_moved_beacons_are_named():
    for seed in range(10):
        clean = calibrate(planar(50 + seed)).check
        assert not clean.named and not clean.undecided
    for seed in range(6):
        name = f"B{1 + seed % 3}"
        assert calibrate(planar(70 + seed, moved=name)).check.named == (name,)


def test_a_beacon_of_unknown_place_is_found_with_the_track():
    mission, _ = straight_pass(seed=3)
    true = np.stack([b.position for b in mission.beacons])
    beacons = [replace(b, sigma=0.1) for b in mission.beacons]
    # Beside a straight track its depth must be known.
    off = beacons[2].position + np.array([15.0, -12.0, 0.1])
    beacons[2] = replace(beacons[2], position=off, sigma=[0.0, 0.0, 0.3])
    result = calibrate(replace(mission, beacons=tuple(beacons)))
    assert result.method == "joint" and result.status == "converged"
    error = result.position - true
    assert (np.abs(error) < 4.0 * result.sigma).all() and np.abs(error).max() < 8.0
    assert [c.name for c in result.check.checks] == ["B1", "B2", "B4"]
    cross = result.covariance[6:9, :6]
    assert np.abs(cross).max() > 1e-4


def test_nothing_says_where_the_track_is():
    mission, _ = straight_pass(seed=1)
    one = (replace(mission.beacons[0], sigma=1.0), *mission.beacons[1:])
    with pytest.raises(ConfigurationError, match="1 of the 4 beacons that were heard have a sigma"):
        calibrate(replace(mission, beacons=one))


@cache
def goats(dive: int) -> Mission:
    """As a mission file that names the PyFG file and nothing else gives it."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "goats.toml"
        file = gtsam.findExampleDataFile(f"goats_{dive}.pyfg")
        path.write_text(f'[data]\nformat = "pyfg"\nfile = "{file}"\n')
        return load_mission(path)


def given_in(mission: Mission) -> dict[str, np.ndarray]:
    return {b.name: b.position for b in mission.beacons}


def moved(mission: Mission, name: str, shift: np.ndarray) -> Mission:
    beacons = tuple(
        replace(b, position=b.position + shift) if b.name == name else b for b in mission.beacons
    )
    return replace(mission, beacons=beacons)


@pytest.mark.slow
def test_goats_16_names_l1():
    result = calibrate(goats(16))
    assert result.check.named == ("L1",)
    assert np.linalg.norm(result.position[0] - given_in(goats(16))["L1"] - L1_OFF) < 5.0
    assert any("held as given" in warning for warning in result.warnings)
    # Those that were held are as given.
    given = given_in(goats(16))
    for beacon in result.beacons:
        if beacon.name != "L1":
            assert beacon.position.tolist() == given[beacon.name].tolist()
            assert not beacon.sigma.any()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["L0", "L1", "L2", "L3"])
def test_a_beacon_moved_by_24_m_in_goats_16_is_named(name):
    """In a copy in which L1 is put right: with two wrong of four no majority is left."""
    right = moved(goats(16), "L1", L1_OFF)
    bearing = 0.7 + 1.5 * int(name[1])
    shift = 24.0 * np.array([np.sin(bearing), np.cos(bearing), 0.0])
    assert calibrate(moved(right, name, shift)).check.named == (name,)


@pytest.mark.slow
def test_goats_15_does_not_tell_which_of_three_beacons_is_off():
    """With a free range scale three beacons have no redundancy to point at one of them."""
    check = calibrate(goats(15)).check
    assert not check.named and set(check.undecided) >= {"L0", "L2"}
