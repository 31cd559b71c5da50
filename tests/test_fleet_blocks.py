"""Ranges between vehicles: Jacobians against finite differences, residuals written out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fleets import MIXED_PLACES, MIXED_TRUTHS, SPEED, mixed, near, posed

from ubl_graph import SoundSpeedProfile
from ubl_graph.cooperative import Fleet
from ubl_graph.cooperative.model import FleetProblem
from ubl_graph.factors.block import Block
from ubl_graph.layout import Layout

LAYERED = SoundSpeedProfile([0.0, 40.0, 80.0, 200.0], [1518.0, 1510.0, 1494.0, 1496.0])
CASES = {
    "slant": {"kinds": ["slant"]},
    "two_way": {"kinds": ["two_way"]},
    "one_way": {"kinds": ["one_way"]},
    "slant, sound speed": {"kinds": ["slant"], "estimate_sound_speed": True},
    "two_way, sound speed": {"kinds": ["two_way"], "estimate_sound_speed": True},
    "one_way, sound speed": {"kinds": ["one_way"], "estimate_sound_speed": True},
    "all, sound speed, eigenrays": {"estimate_sound_speed": True, "rays": "eigenray"},
}
BY_CASE = pytest.mark.parametrize("case", CASES.values(), ids=list(CASES))


def fleet_of_case(case: dict[str, object]) -> Fleet:
    fleet = mixed(noise=1.0, every=9.0, **case)
    return replace(fleet, sound_speed=LAYERED) if case.get("rays") else fleet


def dense_of(block: Block, jacobian: np.ndarray, size: int) -> np.ndarray:
    """Jacobians (M, R, n) by all columns; what two legs have in common adds up."""
    out = np.zeros((*jacobian.shape[:2], size))
    for row, columns in enumerate(block.columns):
        used = columns >= 0
        np.add.at(out[row].T, columns[used], jacobian[row][:, used].T)
    return out


def range_blocks(problem: FleetProblem) -> list[tuple[Block, np.ndarray]]:
    """The blocks of ranges between vehicles with their standard deviations at a start."""
    return list(problem.blocks[problem.ranges])


@BY_CASE
def test_jacobians_match_finite_differences(case: dict[str, object]):
    problem, start = posed(fleet_of_case(case))
    x = near(start)
    blocks = range_blocks(problem)
    assert {b.name for b in blocks} == {p.kind for p in problem.pings}
    for block in blocks:
        held = block.frozen(x)
        _, jacobian = block.evaluate(x, held)
        assert jacobian is not None
        dense = dense_of(block, jacobian, problem.layout.size)
        for column in np.unique(block.columns[block.columns >= 0]):
            step = np.zeros(problem.layout.size)
            step[column] = 1e-3
            forward, _ = block.evaluate(x + step, held, jacobian=False)
            backward, _ = block.evaluate(x - step, held, jacobian=False)
            numeric = (forward - backward) / 2e-3
            scale = 1.0 + np.abs(numeric).max()
            np.testing.assert_allclose(
                dense[:, :, column], numeric, atol=3e-6 * scale, err_msg=block.name
            )


@BY_CASE
def test_nothing_but_the_blocks_columns_moves_a_residual(case: dict[str, object]):
    problem, start = posed(fleet_of_case(case))
    x = near(start)
    for block in range_blocks(problem):
        held = block.frozen(x)
        before, _ = block.evaluate(x, held, jacobian=False)
        for row, columns in enumerate(block.columns):
            other = near(x, seed=row + 1, size=5.0)
            other[columns[columns >= 0]] = x[columns[columns >= 0]]
            after, _ = block.evaluate(other, held, slice(row, row + 1), jacobian=False)
            np.testing.assert_allclose(after[0], before[row], rtol=1e-9, atol=1e-9)


@BY_CASE
def test_a_row_alone_is_the_row_in_the_batch(case: dict[str, object]):
    problem, start = posed(fleet_of_case(case))
    x = near(start)
    for block in range_blocks(problem):
        held = block.frozen(x)
        whole, jacobians = block.evaluate(x, held)
        assert jacobians is not None
        count = len(block.columns)
        for rows in (*(slice(i, i + 1) for i in range(count)), slice(2, 5), slice(3, None)):
            some, jacobian = block.evaluate(x, held, rows)
            assert jacobian is not None
            np.testing.assert_allclose(some, whole[rows], rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(jacobian, jacobians[rows], rtol=1e-7, atol=1e-9)


def residuals_at_truth(kinds: list[str], scale: float) -> dict[str, np.ndarray]:
    """Residuals (s) of exact ranges where the search starts and the sound speed is off."""
    problem, x = posed(mixed(kinds=kinds, estimate_sound_speed=True))
    layout = problem.layout
    x[layout.common_columns("sound_speed")] = scale / Layout.unit("sound_speed")
    return {
        pings.kind: block.evaluate(x, pings.sigma, jacobian=False)[0][:, 0] * pings.sigma
        for pings, block in zip(problem.pings, range_blocks(problem), strict=True)
    }


@pytest.mark.parametrize("kind", ["slant", "two_way"])
def test_the_sound_speed_between_vehicles_is_one_factor_on_all_travel_times(kind: str):
    plain, slower = residuals_at_truth([kind], 0.0), residuals_at_truth([kind], 0.01)
    problem, _ = posed(mixed(kinds=[kind], estimate_sound_speed=True))
    measured = problem.pings[0].measured
    name = problem.pings[0].kind
    times = plain[name] + measured
    np.testing.assert_allclose(slower[name] - plain[name], times * np.expm1(0.01), rtol=1e-9)


def truth_vector(fleet: Fleet) -> tuple[FleetProblem, np.ndarray]:
    """The problem with every vehicle and target where it truly is."""
    problem, x = posed(fleet)
    layout = problem.layout
    for member, place in zip(problem.members, layout.place, strict=True):
        truth, own = MIXED_TRUTHS[member.name], x[place].copy()
        width = member.layout.get(own, "position").shape[1]
        member.layout.put(own, "position", truth.position(member.model.t)[:, :width])
        if member.layout.node == "point":
            member.layout.put(own, "velocity", truth.velocity(member.model.t))
        else:
            heading = 0.5 * np.pi - truth.heading(member.model.t)
            turns = np.zeros((len(heading), 3))
            turns[:, 2] = heading
            size = member.layout.get(own, "rotation").shape[1]
            member.layout.put(own, "rotation", turns[:, -size:])
        x[place] = own
    for target in fleet.targets:
        x[layout.common_columns(f"target {target.name}")] = MIXED_PLACES[target.name](0.0)
        if layout.has(f"velocity {target.name}"):
            way = MIXED_PLACES[target.name](1.0) - MIXED_PLACES[target.name](0.0)
            x[layout.common_columns(f"velocity {target.name}")] = way
    return problem, x


@pytest.mark.parametrize("kind", ["slant", "two_way"])
def test_exact_ranges_leave_nothing_at_the_truth(kind: str):
    """Lever arms, who was where at which end of which leg, answers two seconds later."""
    problem, x = truth_vector(mixed(kinds=[kind]))
    (block,), (pings,) = range_blocks(problem), problem.pings
    whitened, _ = block.evaluate(x, pings.sigma, jacobian=False)
    # Halves of a two-way time differ by what the range changes until the answer.
    allowed = 1e-9 if kind == "slant" else 5e-3
    assert np.abs(whitened[:, 0] * pings.sigma).max() * SPEED < allowed


def test_clocks_of_both_ends_enter_with_their_signs():
    problem, x = posed(mixed(kinds=["one_way"]))
    (block,), (pings,) = range_blocks(problem), problem.pings
    before, _ = block.evaluate(x, pings.sigma, jacobian=False)
    for member, place in zip(problem.members, problem.layout.place, strict=True):
        own = x[place].copy()
        member.layout.put(own, "clock_offset", member.layout.get(own, "clock_offset") + 2e-3)
        moved = x.copy()
        moved[place] = own
        after, _ = block.evaluate(moved, pings.sigma, jacobian=False)
        expected = 2e-3 * ((pings.vehicle == member.name) * 1.0 - (pings.peer == member.name))
        np.testing.assert_allclose((after - before)[:, 0] * pings.sigma, expected, atol=1e-12)
