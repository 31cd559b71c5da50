"""Result files and figures: what they hold, and that figures show it."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from ubl_graph import Options, SoundSpeedProfile, smooth
from ubl_graph.errors import ConfigurationError, DataError, TimeError
from ubl_graph.evaluation import Errors, errors_of, evaluate
from ubl_graph.io import result_files
from ubl_graph.io.result_files import summary, write_result
from ubl_graph.mission import Reference
from ubl_graph.plots import errors, residuals, slow_state, track
from ubl_graph.result import Result
from ubl_graph.sim import straight_pass
from ubl_graph.trajectory import Trajectory


@pytest.fixture(scope="module")
def result() -> Result:
    """Two segments of one mission, the second half an hour after the first."""
    mission, _ = straight_pass(seed=1)
    first = replace(mission.segments[0], name="A")

    def later(records):
        changes = {
            n: getattr(records, n) + 1800.0
            for n in ("t", "t_transmit", "t_receive")
            if hasattr(records, n)
        }
        return replace(records, **changes)

    second = replace(
        first,
        name="B",
        two_way_range=later(first.two_way_range),
        depth=later(first.depth),
        reference=Reference(first.reference.t + 1800.0, first.reference.position),
    )
    return smooth(replace(mission, segments=(first, second)))


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def test_trajectory_file_holds_the_nodes(tmp_path, result):
    write_result(result, tmp_path / "out", figures=False)
    rows = rows_of(tmp_path / "out" / "trajectory.csv")
    assert [r["segment"] for r in rows] == [s.name for s in result.segments for _ in s.trajectory.t]
    np.testing.assert_array_equal([float(r["t"]) for r in rows], result.trajectory.t)
    for names, values in (
        (("east", "north", "up"), result.trajectory.position),
        (("v_east", "v_north", "v_up"), result.trajectory.velocity),
        (
            ("sd_east", "sd_north", "sd_up"),
            np.sqrt(np.einsum("nii->ni", result.trajectory.covariance)),
        ),
    ):
        written = [[float(r[n]) for n in names] for r in rows]
        np.testing.assert_allclose(written, values, atol=6e-7)
    written = [float(r["cov_east_north"]) for r in rows]
    np.testing.assert_allclose(written, result.trajectory.covariance[:, 0, 1], atol=6e-7)


def test_residual_file_has_one_row_a_ping(tmp_path, result):
    write_result(result, tmp_path, figures=False)
    rows = rows_of(tmp_path / "residuals.csv")
    table = result.residuals
    assert table is not None
    assert [r["beacon"] for r in rows] == [str(b) for b in table.beacon]
    np.testing.assert_allclose([float(r["residual"]) for r in rows], table.residual, atol=1e-9)
    assert {r["direct_ray"] for r in rows} == {"yes"}


def test_result_file_is_strict_json_with_what_it_should_say(tmp_path, result):
    write_result(result, tmp_path, figures=False)
    text = (tmp_path / "result.json").read_text()
    content = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert content["status"] == "converged" and content["reason"] == ""
    assert content["cost"] == pytest.approx(sum(s.cost for s in result.segments))
    assert sum(b["used"] for b in content["pings"].values()) == len(result.residuals)
    assert set(content["versions"]) == {"python", "ubl-graph", "gtsam", "numpy", "scipy"}
    assert set(content["wall_times_s"]) == {"model", "start", "solve", "covariance"}
    compared = Errors.joined(evaluate(result).values()).summary()
    assert content["reference"] == pytest.approx(compared)
    assert [s["name"] for s in content["segments"]] == ["A", "B"]
    resolved = json.loads((tmp_path / "mission.json").read_text())
    assert resolved["options"]["acceleration_psd"] == Options().acceleration_psd


def test_shared_unknowns_make_one_problem(result):
    options = replace(result.mission.options, estimate_beacons=True)
    beacons = tuple(replace(b, sigma=1.0) for b in result.mission.beacons)
    joint = smooth(replace(result.mission, options=options, beacons=beacons))
    assert {s.problem for s in joint.segments} == {0}
    assert summary(joint)["cost"] == pytest.approx(joint.segments[0].cost)
    for beacon in beacons:
        found = joint.beacons[beacon.name]
        assert (found.sigma > 0.0).all() and (found.sigma < 1.01).all()
        assert np.linalg.norm(found.value - beacon.position) < 3.0 * np.linalg.norm(found.sigma)


def test_a_failure_while_writing_leaves_nothing(tmp_path, result, monkeypatch):
    def broken(_):
        raise RuntimeError("disk on fire")

    monkeypatch.setattr(result_files, "resolved", broken)
    with pytest.raises(RuntimeError, match="disk on fire"):
        write_result(result, tmp_path / "out", figures=False)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_a_data_error(tmp_path, result):
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="output"):
        write_result(result, tmp_path / "file" / "out", figures=False)


@pytest.mark.parametrize(
    "draw",
    [track, residuals, errors, lambda r: slow_state(r, "sound_speed")],
    ids=["track", "residuals", "errors", "slow state"],
)
def test_figures_have_labels_and_ink(result, draw):
    figure = draw(result)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    picture = np.asarray(canvas.buffer_rgba())[..., :3]
    assert (picture < 250).any(axis=2).mean() > 0.01
    for axes in figure.axes:
        assert axes.get_ylabel()
        assert axes.lines
        drawn = np.concatenate([np.asarray(line.get_ydata(), dtype=float) for line in axes.lines])
        assert np.isfinite(drawn).all()
    assert any(axes.get_xlabel() for axes in figure.axes)


def test_trajectory_is_asked_over_all_segments(result):
    times = np.array([5.0, 1805.0, 20.0])
    states = result.trajectory.at(times)
    for i, name in enumerate("ABA"):
        one = result.trajectory[name].at(times[i])
        np.testing.assert_array_equal(states.position[i], one.position[0])
        np.testing.assert_array_equal(states.covariance[i], one.covariance[0])
    with pytest.raises(TimeError, match="no segment"):
        result.trajectory.at(1000.0)
    with pytest.raises(ConfigurationError, match="known: 'A', 'B'"):
        _ = result.trajectory["C"]


def test_errors_are_written_out_by_hand():
    """Two metres east of a line whose east is known to one metre: NEES 4."""
    t = np.array([0.0, 100.0])
    position = np.array([[2.0, 0.0, 0.0], [2.0, 100.0, 0.0]])
    covariance = np.tile(np.diag([1.0, 4.0, 1.0]), (2, 1, 1))
    psd = (1e-30, 1e-30)
    line = Trajectory(t, position, np.tile([0.0, 1.0, 0.0], (2, 1)), None, covariance, psd)
    times = np.array([-5.0, 10.0, 50.0, 90.0, 100.0])
    truth = np.stack([0 * times, times, 0 * times], axis=1)
    found = errors_of(line, Reference(times, truth))
    np.testing.assert_array_equal(found.t, times[1:])
    np.testing.assert_allclose(found.horizontal, 2.0)
    np.testing.assert_allclose(found.nees, 4.0)
    np.testing.assert_array_equal(found.interior, [False, True, False, False])
    assert found.summary()["interior_count"] == 1


def test_what_should_stop_a_user_is_a_warning(result):
    """Half of the pings nonsense: more than outliers; with no loss the chi-square says it."""
    segment = result.mission.segments[0]
    pings = segment.two_way_range
    rng = np.random.default_rng(0)
    nonsense = rng.uniform(-0.03, 0.03, len(pings)) * (rng.random(len(pings)) < 0.5)
    wrong = pings.travel_time + nonsense
    pings = replace(pings, travel_time=wrong, t_receive=pings.t_receive + 0.05)
    spoilt = replace(segment, two_way_range=pings)
    for loss, said in (("cauchy", "down-weighted"), ("none", "chi-square")):
        options = replace(result.mission.options, loss=loss)
        found = smooth(replace(result.mission, segments=(spoilt,), options=options))
        assert any(said in w for w in found.warnings), (loss, found.warnings)


def test_a_profile_that_ends_far_above_the_beacons_is_said(result):
    mission = result.mission
    deepest = max(-b.position[2] for b in mission.beacons)
    short = SoundSpeedProfile([0.0, 0.5 * deepest], [1500.0, 1499.0])
    one = replace(mission, sound_speed=short, segments=mission.segments[:1])
    assert any("profile ends at" in w for w in smooth(one).warnings)
    long = SoundSpeedProfile([0.0, 0.95 * deepest], [1500.0, 1499.0])
    assert not any("profile" in w for w in smooth(replace(one, sound_speed=long)).warnings)
