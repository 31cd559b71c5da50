"""Parts of the online estimator, one by one, against independent computations."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from online import records_of, run, survey
from scipy.stats import chi2

from ubl_graph import (
    AngularRate,
    Attitude,
    Beacon,
    Depth,
    FixedLagEstimator,
    Heading,
    Odometry,
    OneWayRange,
    Options,
    PositionFix,
    Segment,
    SlantRange,
    SoundSpeedProfile,
    Start,
    TwoWayRange,
    Velocity,
)
from ubl_graph.factors.loss import WIDTHS, RobustLoss
from ubl_graph.mission import Setup
from ubl_graph.nodes import ROUND_SPACINGS, grid_spacing, grid_times, slot_of
from ubl_graph.online.buffer import Buffer, columns_of, entry_of, odometry_of
from ubl_graph.online.clock import AHEAD, BEHIND, Clock
from ubl_graph.online.elimination import RowsOf
from ubl_graph.online.equations import WindowEquations
from ubl_graph.online.frame import frame_of
from ubl_graph.online.gate import REOPENS, Gate, distance, limit, step_distance
from ubl_graph.online.window import Window
from ubl_graph.trajectory import (
    interpolation_covariance,
    interpolation_variance,
    process_noise,
    transition,
)

LAG = 20.0


def depth(t: float, value: float = 5.0):
    return entry_of(Depth(t, value))


def ping(t: float, beacon: str = "B1"):
    return entry_of(TwoWayRange(beacon, t - 0.5, t, 0.4))


# -- buffer --


@settings(max_examples=40)
@given(st.lists(st.integers(0, 200), unique=True, min_size=1, max_size=40), st.integers(0, 200))
def test_the_buffer_is_in_order_and_cuts_where_it_is_told(stamps, begin):
    buffer = Buffer()
    for t in stamps:
        buffer.add(depth(float(t)))
        buffer.add(entry_of(Attitude(float(t), 0.1)))
    assert [e.t for e in buffer.of("depth")] == sorted(stamps)
    assert len(buffer) == 2 * len(stamps)
    inside = [t for t in sorted(stamps) if begin <= t < begin + 50]
    assert [e.t for e in buffer.between("depth", begin, begin + 50)] == inside
    gone = buffer.trim(begin)
    older = [t for t in sorted(stamps) if t < begin]
    # The last attitude before the cut says what holds there.
    assert sorted(e.t for e in gone if e.kind == "depth") == older
    assert sorted(e.t for e in gone if e.kind == "attitude") == older[:-1]
    assert all(buffer.twin(e) is None for e in gone)
    assert len(buffer) == 2 * len(stamps) - len(gone)


def test_neighbours_and_surroundings_pass_over_gated_entries():
    buffer = Buffer()
    entries = [depth(float(t)) for t in range(10)]
    for e in entries:
        buffer.add(e)
    entries[4].gated = entries[7].gated = True
    before, after = buffer.neighbours(entries[5])
    assert (before.t, after.t) == (3.0, 6.0)
    assert [e.t for e in buffer.around("depth", 5.0, 6.0)] == [3.0, 5.0, 6.0, 8.0]
    assert buffer.neighbours(entries[0])[0] is None
    assert buffer.neighbours(entries[9])[1] is None


def test_twins_have_the_same_stamps():
    buffer = Buffer()
    for record in (
        TwoWayRange("B1", 1.0, 1.5, 0.4),
        OneWayRange("B1", 1.0, 1.5),
        Velocity(1.0, 1.0, 0.0, 0.0),
        PositionFix(1.0, 2.0, 3.0),
    ):
        assert buffer.twin(entry_of(record)) is None
        buffer.add(entry_of(record))
        assert buffer.twin(entry_of(record)) is not None
    assert buffer.twin(entry_of(TwoWayRange("B2", 1.0, 1.5, 0.4))) is None
    assert buffer.twin(entry_of(TwoWayRange("B1", 1.0, 1.6, 0.4))) is None
    assert buffer.twin(entry_of(TwoWayRange("B1", 1.0, 1.5, 0.41))) is not None
    assert buffer.twin(entry_of(Velocity(1.0, 1.0, 0.0, 0.0, reference="water"))) is None
    buffer.remove(buffer.of("velocity")[0])
    assert buffer.twin(entry_of(Velocity(1.0, 1.0, 0.0, 0.0))) is None


def test_a_shift_moves_every_time_and_nothing_else():
    buffer = Buffer()
    records = [
        TwoWayRange("B1", 1.0, 1.5, 0.4),
        OneWayRange("B1", 1.0, 1.5),
        Velocity(1.0, 1.0, 0.0, 0.0),
        Attitude(1.0, 0.3),
        Depth(1.0, 1.0),
        PositionFix(1.0, 1.0, 1.0),
    ]
    for record in records:
        buffer.add(entry_of(record))
    buffer.add(entry_of(Start(1.0, 1.0, 1.0)))
    buffer.shift(-10.0)
    by_kind = {e.kind: e for e in buffer.all()}
    assert by_kind["two_way_range"].values == ("B1", -9.0, -8.5, 0.4, 1e-4)
    assert by_kind["one_way_range"].values[:3] == ("B1", -9.0, -8.5)
    assert by_kind["velocity"].values[:4] == (-9.0, 1.0, 0.0, 0.0)
    assert by_kind["depth"].values[:2] == (-9.0, 1.0)
    assert by_kind["position"].values[0] == -9.0
    assert by_kind["position"].values[1].tolist() == [[1.0, 1.0]]
    assert by_kind["set_position"].t == -9.0
    assert (by_kind["two_way_range"].t, by_kind["two_way_range"].begin) == (-8.5, -9.0)
    assert buffer.twin(entry_of(Depth(-9.0, 1.0))) is by_kind["depth"]
    assert buffer.twin(entry_of(Depth(1.0, 1.0))) is None


def test_records_of_poses_move_with_the_clock_and_come_back_as_they_were():
    buffer = Buffer()
    covariance = np.diag([1.0, 2.0, 3.0])
    records = {
        "slant_range": SlantRange(1.0, "B1", 50.0),
        "heading": Heading(1.0, 0.3),
        "angular_rate": AngularRate(1.0, 0.1, 0.2, 0.3),
        "odometry": Odometry(1.0, 3.0, 1.5, 0.5, about_down=0.2, covariance=covariance),
    }
    for record in records.values():
        buffer.add(entry_of(record))
        assert buffer.twin(entry_of(record)).equals(entry_of(record))
    assert buffer.twin(entry_of(SlantRange(1.0, "B2", 50.0))) is None
    assert buffer.twin(entry_of(Odometry(1.0, 3.5, 1.5, 0.5))) is None
    other = entry_of(Odometry(1.0, 3.0, 1.5, 0.5, about_down=0.2))
    assert not buffer.twin(other).equals(other)
    buffer.shift(-10.0)
    (step,) = buffer.of("odometry")
    assert (step.begin, step.t) == (-9.0, -7.0)
    for kind, record in records.items():
        (entry,) = buffer.of(kind)
        (again,) = odometry_of([entry]) if kind == "odometry" else [columns_of(kind, [entry])]
        for f in fields(record):
            was, found = getattr(record, f.name), getattr(again, f.name)
            if was is None or f.name == "source":
                assert found is None
            elif f.name.startswith("t"):
                assert found.tolist() == (was - 10.0).tolist()
            else:
                assert np.array_equal(found, was)


def test_odometry_of_each_shape_comes_apart():
    steps = [
        Odometry(0.0, 1.0, 1.0, 0.0),
        Odometry(1.0, 2.0, 2.0, 0.0, covariance=np.eye(3)),
        Odometry(2.0, 3.0, 3.0, 0.0, 0.0, 0.0, 0.0, covariance=np.eye(6)),
        Odometry(3.0, 4.0, 4.0, 0.0),
    ]
    found = odometry_of([entry_of(s) for s in steps])
    assert [s.forward.tolist() for s in found] == [[1.0, 4.0], [2.0], [3.0]]
    assert [s.dimension for s in found] == [2, 2, 3]
    assert [s.covariance is None for s in found] == [True, False, False]
    assert odometry_of([]) == []


# -- clock --


def test_records_from_far_ahead_wait_until_their_time_or_until_five_agree():
    clock = Clock(LAG)
    assert not clock.is_far(depth(1e6), None)
    clock.tick(depth(100.0))
    assert not clock.is_far(depth(100.0 + LAG), None)
    assert clock.is_far(depth(100.1 + LAG), 0.5 * LAG / 3.0)
    # A sensor that speaks less often than once a lag is not far for that.
    assert not clock.is_far(depth(100.1 + LAG), LAG)
    early = depth(130.0)
    assert clock.hold(early) == []
    assert clock.due() == []
    clock.tick(depth(129.0))
    assert clock.due() == []
    clock.tick(depth(131.0))
    assert clock.due() == [early]
    assert clock.held == []
    run_of = [depth(1e6 + i) for i in range(AHEAD)]
    for e in run_of[:-1]:
        assert clock.hold(e) == []
    assert clock.hold(run_of[-1]) == run_of
    assert clock.held == []


def test_a_record_of_the_present_breaks_a_run_ahead():
    clock = Clock(LAG)
    clock.tick(depth(0.0))
    for i in range(3 * AHEAD):
        assert clock.hold(depth(1e6 + i)) == []
        if i % (AHEAD - 1) == AHEAD - 2:
            clock.tick(depth(0.1 * i))


def test_strange_records_in_order_of_time_prove_a_clock_set_back():
    clock = Clock(LAG)
    clock.tick(depth(100.0))
    run_of = [depth(50.0 + i) for i in range(BEHIND)]
    for e in run_of[:-1]:
        assert clock.suspect(e, True, 1.0) == []
    assert clock.suspect(run_of[-1], True, 1.0) == run_of
    # One that is not strange, or one that goes back, begins it anew.
    for e in run_of[:-1]:
        clock.suspect(e, True, 1.0)
    assert clock.suspect(depth(99.9), False, 1.0) == []
    for e in run_of[:-1]:
        assert clock.suspect(e, True, 1.0) == []
    assert clock.suspect(depth(50.0), True, 1.0) == []
    for e in reversed(run_of):
        assert clock.suspect(e, True, 1.0) == []


def test_late_records_that_are_sparser_than_usual_prove_nothing():
    clock = Clock(LAG)
    clock.tick(depth(100.0))
    for i in range(3 * BEHIND):
        assert clock.suspect(depth(20.0 + 2.0 * i), True, 10.0) == []


def test_a_record_is_strange_behind_its_own_sensor_alone():
    clock = Clock(LAG)
    clock.note(depth(100.0))
    assert not clock.is_strange(depth(99.9), None)
    assert clock.is_strange(depth(99.0), None)
    assert not clock.is_strange(depth(99.0), 1.0)
    assert not clock.is_strange(entry_of(PositionFix(50.0, 1.0, 1.0)), None)


# -- gate --


def test_limits_are_chi_square_quantiles():
    for dof in (1, 2, 3):
        assert chi2.sf(limit(dof) ** 2, dof) == pytest.approx(5.7e-7, rel=1e-9)
    assert limit(1) == pytest.approx(5.0, abs=0.01)


def test_distance_is_mahalanobis():
    rng = np.random.default_rng(3)
    for d in (1, 2, 3):
        root = rng.normal(size=(d, d)) + 2.0 * np.eye(d)
        unit = rng.normal(size=d)
        assert distance(root @ unit, root @ root.T) == pytest.approx(np.linalg.norm(unit))


def test_headings_are_compared_around_the_circle():
    a = entry_of(Attitude(0.0, 0.01))
    b = entry_of(Attitude(0.1, 2.0 * math.pi - 0.01))
    c = entry_of(Attitude(0.1, 1.0))
    assert step_distance(b, a)[0] < 1.0
    assert step_distance(c, a)[0] > limit(3)
    assert step_distance(entry_of(Attitude(100.0, 1.0)), a)[0] == 0.0


def test_a_gate_counts_and_doubts():
    gate = Gate()
    assert gate.last is None and gate.interval is None and gate.surprise == 1.0
    for t in range(30):
        gate.accept(ping(float(t)), 4.0)
    assert (gate.accepted, gate.last, gate.interval) == (30, 29.0, 1.0)
    assert gate.surprise == pytest.approx(4.0 / chi2.ppf(0.5, 1), rel=1e-3)
    assert not gate.is_doubtful and not gate.is_uneasy and gate.refused_share == 0.0
    bad = [ping(30.0 + t) for t in range(REOPENS)]
    for e in bad[:-1]:
        e.gated = True
        gate.refuse(e)
        assert not gate.is_doubtful
    bad[-1].gated = True
    gate.refuse(bad[-1])
    assert gate.is_doubtful and gate.is_uneasy
    assert gate.rejected["gated"] == REOPENS
    for e in bad:
        e.gated = False
        gate.change_mind(e)
    assert (gate.accepted, gate.rejected["gated"]) == (30 + REOPENS, 0)
    assert gate.last == 34.0
    assert gate.run == []
    gate.shift(-4.0)
    assert gate.last == 30.0


# -- window --

PSD = 3e-3
BEACONS = (
    Beacon("B1", [80.0, 20.0, -60.0], 1.0, turnaround=0.1),
    Beacon("B2", [-70.0, 40.0, -65.0], 1.0, turnaround=0.1),
)


def filled(seed: int = 0, *, order: int = 2, seconds: int = 12, unknown: bool = True, **more):
    """A window with every kind of record in it, at a random point; its pings."""
    rng = np.random.default_rng(seed)
    options = Options(
        motion="constant_velocity" if order == 2 else "constant_acceleration",
        acceleration_psd=PSD,
        estimate_beacons=unknown,
        speed_sigma=3.0,
        **more,
    )
    setup = Setup(BEACONS, SoundSpeedProfile.constant(1500.0), options=options)
    buffer = Buffer()
    for t in np.arange(0.1, seconds - 0.1, 0.5):
        buffer.add(entry_of(Velocity(t, 1.0 + 0.1 * rng.normal(), 0.1 * rng.normal(), 0.0)))
        buffer.add(entry_of(Attitude(t, 0.1 * rng.normal())))
        buffer.add(entry_of(Depth(t, 20.0 + 0.1 * rng.normal())))
    for t in np.arange(0.3, seconds - 0.1, 3.0):
        buffer.add(entry_of(PositionFix(t, *rng.normal(size=2), sigma=1.0)))
    for i, t in enumerate(np.arange(0.4, seconds - 0.5, 0.9)):
        name = f"B{i % 2 + 1}"
        travel = 0.11 + 0.001 * rng.normal()
        buffer.add(entry_of(TwoWayRange(name, t, t + travel + 0.1, travel)))
        if i % 3 == 0:
            buffer.add(entry_of(OneWayRange(name, t, t + 0.055, 2e-4)))
    frame = frame_of(setup, {"one_way_range", "bottom"}, 0.003, 2.0, 1.0)
    window = Window(frame, buffer, 0)
    window.extend(seconds - 0.2)
    window.refresh()
    x = window.vector + 0.3 * rng.normal(size=window.vector.shape)
    window.put(x)
    return window, window.ranges(window.usable())


def dense(window: Window, ranges, x, newton: bool = False):
    """All rows at `x`, weighted by the loss: matrix and residuals, each row by itself."""
    frame = window.frame
    w, b, n = frame.width, frame.border, window.count
    size = n * w + b
    shared = n * w + np.arange(b)
    rows, residuals = [], []
    prior, target = window.prior
    nodes = (prior.shape[1] - b) // w
    own = np.concatenate([np.arange(nodes * w), shared])
    for row, right in zip(prior, target, strict=True):
        full = np.zeros(size)
        full[own] = row
        rows.append(full)
        residuals.append(row @ x[own] - right)
    for k in range(n - 1):
        own = np.concatenate([np.arange(k * w, (k + 2) * w), shared])
        for row, right in zip(window.linear.rows[k], window.linear.targets[k], strict=True):
            full = np.zeros(size)
            full[own] = row
            rows.append(full)
            residuals.append(row @ x[own] - right)
    for block in ranges:
        r, slope = block.evaluate(x, block.frozen(x))
        for i in range(len(r)):
            full = np.zeros(size)
            for column, value in zip(block.columns[i], slope[i, 0], strict=True):
                if column >= 0:
                    full[column] += value
            weight = window.loss.curvature(r[i]) if newton else window.loss.weights(r[i])
            rows.append(np.sqrt(weight[0]) * full)
            residuals.append(np.sqrt(window.loss.weights(r[i]))[0] * r[i, 0])
    return np.array(rows), np.array(residuals)


@pytest.mark.parametrize("order", [2, 3])
@pytest.mark.parametrize("unknown", [True, False])
@pytest.mark.parametrize("loss", ["cauchy", "none", "huber"])
def test_the_equations_are_those_of_all_rows_one_by_one(order, unknown, loss):
    window, ranges = filled(1, order=order, unknown=unknown, loss=loss)
    x = window.vector
    equations = window.equations(ranges)
    equations.frozen = [b.frozen(x) for b in ranges]
    point = equations.evaluate(x)
    rows, residuals = dense(window, ranges, x)
    gradient = rows.T @ residuals
    scale = np.sqrt((rows**2).sum(axis=0))
    expected = gradient / scale
    assert_allclose(equations.gradient(point) / scale, expected, atol=1e-9 * np.abs(expected).max())
    rng = np.random.default_rng(2)
    for newton, damping in ((False, 0.0), (True, 0.0), (True, 0.5)):
        weighted, _ = dense(window, ranges, x, newton)
        normal = weighted.T @ weighted
        normal += damping * np.diag(np.diag(normal))
        right = normal @ (rng.normal(size=len(x)) / scale)
        # In the scale of the columns, where all of them have the same size.
        step = equations.factor(point, newton, damping).solve(right)
        back = (normal @ step - right) / scale
        assert np.abs(back).max() < 1e-9 * np.abs(right / scale).max()


@pytest.mark.parametrize("loss", ["cauchy", "none", "geman_mcclure"])
def test_the_gradient_is_the_slope_of_the_cost(loss):
    window, ranges = filled(4, loss=loss)
    x = window.vector
    equations = window.equations(ranges)
    equations.frozen = [b.frozen(x) for b in ranges]
    gradient = equations.gradient(equations.evaluate(x))
    rng = np.random.default_rng(5)
    for _ in range(6):
        way = rng.normal(size=len(x))
        way /= np.linalg.norm(way)
        h = 1e-5
        ahead = equations.evaluate(x + h * way, jacobian=False).cost
        behind = equations.evaluate(x - h * way, jacobian=False).cost
        slope = (ahead - behind) / (2.0 * h)
        assert slope == pytest.approx(gradient @ way, rel=1e-5, abs=1e-6 * np.abs(gradient).max())


@pytest.mark.parametrize("order", [2, 3])
def test_dropping_a_node_leaves_its_schur_complement(order):
    window, _ = filled(3, order=order)
    w = window.frame.width
    x = window.vector
    for _ in range(3):
        begin = window.begin
        leaving = [e for e in window.usable() if e.begin < begin + 1.0 - 1e-9]
        staying = [e for e in window.usable() if e.begin >= begin + 1.0 - 1e-9]
        gone = window.ranges(leaving)
        # Frozen at x, all rows are linear: only then is the Schur complement exact.
        full_rows, full_residuals = dense(window, [*gone, *window.ranges(staying)], x)
        whole = full_rows.T @ full_rows
        slope = full_rows.T @ full_residuals
        inverse = np.linalg.inv(whole[:w, :w])
        schur = whole[w:, w:] - whole[w:, :w] @ inverse @ whole[:w, w:]
        reduced = slope[w:] - whole[w:, :w] @ inverse @ slope[:w]
        rows = []
        for block in gone:
            r, derivative = block.evaluate(x, block.frozen(x))
            root = np.sqrt(window.loss.weights(r[:, 0]))
            rows.append(RowsOf(block.columns, root * r[:, 0], root[:, None] * derivative[:, 0]))
        window.drop(rows)
        x = window.vector
        assert len(x) == len(schur)
        # The node eliminated stood at its own best place, which is where its slope vanishes.
        kept, residuals = dense(window, window.ranges(staying), x)
        scale = np.sqrt(np.diagonal(schur))
        assert_allclose(
            kept.T @ kept / np.outer(scale, scale), schur / np.outer(scale, scale), atol=1e-9
        )
        assert_allclose(
            kept.T @ residuals / scale,
            reduced / scale,
            atol=1e-8 * max(1.0, np.abs(reduced / scale).max()),
        )
        assert window.begin == begin + 1.0
        assert not window.is_pristine


@pytest.mark.parametrize("order", [2, 3])
def test_a_leap_is_the_motion_prior_over_the_silence(order):
    window, _ = filled(6, order=order, unknown=False)
    frame = window.frame
    while window.count > 1:
        window.drop([])
    prior, target = window.prior
    before = np.linalg.inv(prior.T @ prior)
    mean = before @ prior.T @ target
    seconds = 37.0
    window.leap(window.first + int(seconds))
    prior, target = window.prior
    after = np.linalg.inv(prior.T @ prior)
    moved = after @ prior.T @ target
    w, k = frame.width, 3 * frame.order
    phi = np.kron(transition(frame.order, seconds)[0], np.eye(3))
    o = frame.setup.options
    psd = np.diag([o.horizontal_psd, o.horizontal_psd, o.vertical_psd])
    noise = np.kron(process_noise(frame.order, seconds)[0], psd)
    expected = phi @ before[:k, :k] @ phi.T + noise
    scale = np.sqrt(np.diagonal(expected))
    gap = (after[:k, :k] - expected) / np.outer(scale, scale)
    assert np.abs(gap).max() < 1e-6
    assert np.abs((moved[:k] - phi @ mean[:k]) / scale).max() < 1e-6
    # What all nodes share is as it was.
    old, new = before[w:, w:], after[w:, w:]
    assert_allclose(new, old, rtol=1e-6, atol=1e-9 * np.abs(old).max())
    assert window.count == 2
    assert window.begin == pytest.approx(window.first * 1.0)


def test_new_unknowns_enter_with_what_is_known_of_them_beforehand():
    window, _ = filled(7, unknown=False)
    setup, buffer = window.frame.setup, window._buffer
    bare = frame_of(setup, (), 0.0, 2.0, 1.0)
    small = Window(bare, buffer, 0)
    small.extend(11.8)
    small.refresh()
    for _ in range(3):
        small.drop([])
    x, prior = small.vector, small.prior
    information = prior[0].T @ prior[0]
    small.reframe(frame_of(setup, {"one_way_range", "bottom"}, 0.003, 2.0, 1.0))
    small.refresh()
    layout, rows = small.layout, small.prior[0]
    names = [n for n, _ in bare.slow]
    before = bare.layout(small.times)
    for name in ("position", "velocity", *names):
        assert np.array_equal(before.get(x, name), layout.get(small.vector, name))
    # Old columns keep their information, new ones have their prior's.
    w0, w1 = bare.width, small.frame.width
    first = np.array([0])
    at_old = np.concatenate(
        [before.node_columns(n, first)[0] for n in ("position", "velocity", *names)]
    )
    at_new = np.concatenate(
        [layout.node_columns(n, first)[0] for n in ("position", "velocity", *names)]
    )
    fresh = rows.T @ rows
    assert at_old.max() < w0 <= w1
    assert_allclose(
        fresh[np.ix_(at_new, at_new)], information[np.ix_(at_old, at_old)], rtol=1e-9, atol=1e-9
    )
    offset = layout.node_columns("clock_offset", first)[0]
    unit = layout.unit("clock_offset")
    assert fresh[offset[0], offset[0]] == pytest.approx(
        (unit / setup.options.clock_offset_sigma) ** 2
    )
    assert small.is_dirty is False


def test_a_late_record_changes_the_rows_of_its_own_interval_only():
    window, _ = filled(8)
    before = window.linear.rows.copy()
    late = entry_of(Depth(5.55, 20.0, 0.2))
    window._buffer.add(late)
    window.touch(late.t, late.t)
    assert window.refresh() == {5}
    changed = np.abs(window.linear.rows - before).max(axis=(1, 2)) > 0.0
    assert np.flatnonzero(changed).tolist() == [5]
    one, all_of_them = window.linear.rows.copy(), window.touch_all()
    assert all_of_them is None
    window.refresh()
    product = np.swapaxes(one, 1, 2) @ one
    anew = np.swapaxes(window.linear.rows, 1, 2) @ window.linear.rows
    assert_allclose(product, anew, rtol=1e-9, atol=1e-9 * np.abs(anew).max())


# -- losses, interpolation, grids --


@pytest.mark.parametrize("name", list(WIDTHS))
def test_curvature_is_the_slope_of_the_weighted_residual(name):
    loss = RobustLoss(name)
    width = min(WIDTHS[name], 10.0)
    r = np.linspace(-8.0 * width, 8.0 * width, 401)
    # Away from where a loss has a corner.
    r = r[np.abs(np.abs(r) - width) > 1e-3]
    h = 1e-6
    slope = ((r + h) * loss.weights(r + h) - (r - h) * loss.weights(r - h)) / (2.0 * h)
    weight, curvature = loss.weights(r), loss.curvature(r)
    # Where the slope is not much below the weight; else the weight stands in.
    near = slope > 0.25 * weight + 1e-6
    far = slope < 0.25 * weight - 1e-6
    assert_allclose(curvature[near], slope[near], atol=1e-8)
    assert_allclose(curvature[far], weight[far])
    assert (curvature <= weight + 1e-12).all()
    assert (curvature[weight > 0.0] > 0.0).all()
    assert (curvature[weight == 0.0] == 0.0).all()


@settings(max_examples=50)
@given(st.sampled_from([2, 3]), st.floats(0.05, 30.0), st.floats(0.01, 0.99))
def test_interpolation_covariance_is_the_bridge_of_the_process(order, dt, s):
    got = interpolation_covariance(order, dt, s)
    for i, derivative in enumerate((0, 1)):
        expected = float(interpolation_variance(order, dt, s, derivative))
        # Both are small differences of terms of the size of the unpinned process.
        free = process_noise(order, s * dt)[0, i, i]
        assert got[i, i] == pytest.approx(expected, rel=1e-6, abs=1e-10 * free)
    # Conditioned on the end: inv(inv(Qs) + Phi' inv(Q1-s) Phi).
    part = process_noise(order, s * dt)[0]
    rest = process_noise(order, (1.0 - s) * dt)[0]
    onward = transition(order, (1.0 - s) * dt)[0]
    bridge = part - part @ onward.T @ np.linalg.solve(
        rest + onward @ part @ onward.T, onward @ part
    )
    scale = np.sqrt(np.diagonal(part))
    assert_allclose(got / np.outer(scale, scale), bridge / np.outer(scale, scale), atol=1e-8)


@given(st.floats(0.3, 900.0), st.floats(0.5, 200.0), st.sampled_from([0.1, 0.25, 1.0]))
def test_a_grid_spans_the_data_on_multiples(begin, length, spacing):
    stamps = np.array([begin, begin + length])
    segment = Segment(position=PositionFix(stamps, 0.0, 0.0))
    times = grid_times(segment, spacing)
    number = times / spacing
    assert_allclose(number, np.round(number), atol=1e-9)
    assert_allclose(np.diff(times), spacing, atol=1e-9)
    assert times[0] <= begin + 1e-8 < times[0] + spacing + 2e-8
    assert times[-1] >= begin + length - 1e-8
    assert times[-1] <= begin + length + 2.0 * spacing
    assert slot_of(begin, spacing) == round(times[0] / spacing)


def test_the_grids_spacing_follows_the_noise():
    assert grid_spacing(Options()) == 1.0
    assert grid_spacing(Options(node_spacing=0.37)) == 0.37
    last = 1.0
    for psd in (1e-3, 1e-2, 1e-1, 1.0, 1e3):
        spacing = grid_spacing(Options(acceleration_psd=psd))
        assert spacing in ROUND_SPACINGS and spacing <= last
        sigma = 0.1 * 1e-4 * 1500.0 / 2.0
        if spacing > min(ROUND_SPACINGS):
            assert psd * spacing**3 / 192.0 <= sigma**2 * (1.0 + 1e-9)
        last = spacing
    assert last == min(ROUND_SPACINGS)


# -- the whole at rest --


def test_what_is_solved_is_a_minimum():
    mission, _ = survey(5, lines=1, length=80.0, dvl_rate=2.0, lag=LAG)
    estimator = run(mission, records_of(mission.segments[0]), at_every=()).estimator
    estimator.window()
    window = estimator.core.tracker.window
    ranges = window.ranges(window.usable())
    equations: WindowEquations = window.equations(ranges)
    equations.frozen = [b.frozen(window.vector) for b in ranges]
    point = equations.evaluate(window.vector)
    step = equations.factor(point).solve(-equations.gradient(point))
    # Half a squared length of a step, in sigmas: nothing to gain.
    assert -0.5 * equations.gradient(point) @ step < 1e-8
    rng = np.random.default_rng(0)
    for _ in range(5):
        way = equations.factor(point).solve(rng.normal(size=len(step)))
        assert equations.evaluate(window.vector + 1e-3 * way).cost >= point.cost


def test_no_setup_is_shared_between_estimators():
    one, other = FixedLagEstimator(), FixedLagEstimator()
    one.add(PositionFix(0.0, 1.0, 2.0, -3.0))
    assert other.health()["t"] is None
    assert replace(one.setup).options == other.setup.options
