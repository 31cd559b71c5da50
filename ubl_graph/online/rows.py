"""Residual rows of grid intervals: what the records between two nodes say of these two nodes.

A row touches the two nodes of the interval that its record falls into, and what all nodes share. So
intervals can be made anew one by one when a late record comes, by the same builder that makes a
whole mission's problem. Those of points are linear, those of poses are linearised where the nodes
stand. The range rows are not here.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.attitude import AttitudeTrack
from ubl_graph.builder import Builder, SegmentModel
from ubl_graph.factors.block import Block, LinearBlock
from ubl_graph.factors.odometry import Preintegration
from ubl_graph.layout import KINEMATIC, Chain, Layout
from ubl_graph.mission import Segment
from ubl_graph.nodes import grid
from ubl_graph.online.buffer import Buffer, columns_of, fixes_of
from ubl_graph.online.frame import Break, Frame
from ubl_graph.online.pose_rows import CONSTANT_SPAN, jump_block, linearised, pose_blocks
from ubl_graph.pose_builder import PoseBuilder
from ubl_graph.trajectory import transition

#: Blocks that speak of nodes one by one.
NODE_BLOCKS = ("velocity", "water velocity", "attitude", "rate", "upright")
#: The attitude of a vehicle that has not told it, and whose sensors do not ask for it.
LEVEL = AttitudeTrack(None)


def attitude_over(buffer: Buffer, begin: float, end: float) -> AttitudeTrack | None:
    """Attitude that holds from `begin` to `end` (s); None where none has come yet."""
    entries = buffer.around("attitude", begin, end)
    return AttitudeTrack(columns_of("attitude", entries)) if entries else None


def interval_rows(
    frame: Frame,
    buffer: Buffer,
    first: int,
    count: int,
    breaks: Mapping[int, Break],
    x: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Rows of `count` neighbouring intervals from the interval number `first` on.

    Parameters
    ----------
    frame : Frame
        The unknowns.
    buffer : Buffer
        The records.
    first, count : int
        Intervals; interval k lasts from k to k + 1 times the grid's spacing.
    breaks : mapping of int to Break
        Intervals in which the vehicle may have jumped.
    x : array, shape ((count + 1) W + B,)
        Where the nodes and what they share stand: rows of poses hold there.

    Returns
    -------
    array, shape (count, H, C)
        Whitened rows over the columns of two nodes and of what is shared, padded with zeros.
    array, shape (count, H)
        Their right-hand sides.
    """
    if not frame.is_posed and _silent(frame, buffer, first, count, breaks):
        rows, targets = _silent_rows(frame)
        return np.repeat(rows, count, axis=0), np.repeat(targets, count, axis=0)
    layout = frame.layout(grid(first, count + 1, frame.spacing))
    builder, chain = frame.builder(layout), layout.chains[0]
    if isinstance(builder, PoseBuilder):
        linear = pose_blocks(frame, buffer, builder, chain, x)
    else:
        model, blocks = _modelled(frame, buffer, builder, chain)
        blocks += builder.linear_blocks(chain, model, CONSTANT_SPAN)
        linear = [linearised(block, x) for block in blocks if len(block.columns)]
    kept = [_stacked(block, frame, count) for block in linear]
    broken = [k - first for k in breaks if first <= k < first + count]
    if broken:
        drop = {"motion", "odometry", "water odometry", "arrival"}
        for at, (block, part) in enumerate(zip(linear, kept, strict=True)):
            if block.name in drop:
                stay = ~np.isin(part[0], broken)
                kept[at] = part[0][stay], part[1][stay], part[2][stay]
        for k in broken:
            make = jump_block if frame.is_posed else _jump
            jump: Block = make(frame, layout, k, breaks[k + first])
            kept.append(_stacked(linearised(jump, x), frame, count))
    owner, rows, targets = (np.concatenate(part) for part in zip(*kept, strict=True))
    return _compressed(owner, rows, targets, count, frame.height)


def _silent(
    frame: Frame, buffer: Buffer, first: int, count: int, breaks: Mapping[int, Break]
) -> bool:
    """Whether there is nothing in some intervals but motion."""
    begin, end = first * frame.spacing, (first + count) * frame.spacing
    if any(first <= k < first + count for k in breaks):
        return False
    if any(buffer.between(k, begin - 1e-9, end) for k in ("depth", "position", "set_position")):
        return False
    return not buffer.around("velocity", begin, end)


@lru_cache(maxsize=8)
def _silent_rows(frame: Frame) -> tuple[FloatArray, FloatArray]:
    """Rows of one interval in which nothing was measured."""
    layout = frame.layout(np.array([0.0, frame.spacing]))
    builder = Builder(frame.setup, layout, frame.lasting)
    model = SegmentModel(Segment(), layout.chains[0].t, LEVEL, None, None)
    blocks = builder.linear_blocks(layout.chains[0], model, CONSTANT_SPAN)
    none = np.zeros(layout.size)
    kept = [_stacked(linearised(b, none), frame, 1) for b in blocks if len(b.columns)]
    owner, rows, targets = (np.concatenate(part) for part in zip(*kept, strict=True))
    return _compressed(owner, rows, targets, 1, frame.height)


def _modelled(
    frame: Frame, buffer: Buffer, builder: Builder, chain: Chain
) -> tuple[SegmentModel, list[Block]]:
    """The records of some intervals as a segment; fixes, which come in two kinds, as blocks."""
    begin, end = float(chain.t[0]), float(chain.t[-1])
    # A sample from beyond a gap says nothing here, and its long way would drown the others'.
    low, high = begin - frame.gap, end + frame.gap
    velocity = [e for e in buffer.around("velocity", begin, end) if low <= e.t <= high]
    reach = [e.t for e in velocity] or [begin, end]
    attitude = attitude_over(buffer, min(begin, *reach), max(end, *reach))
    # A record of the very end belongs to the next interval, as one of the very beginning to this.
    inside = {
        kind: [e for e in buffer.between(kind, begin - 1e-9, end - 1e-9) if not e.gated]
        for kind in ("depth", "position", "set_position")
    }
    track = LEVEL if attitude is None else attitude
    blocks: list[Block] = []
    vehicle = frame.setup.vehicle
    if attitude is not None or vehicle.antenna.is_zero:
        blocks += [builder.fix_block(chain, rows, track) for rows in fixes_of(inside["position"])]
    for entry in inside["set_position"]:
        blocks += builder.start_blocks(chain, entry.record)  # pyright: ignore[reportArgumentType]
    depth = None
    if inside["depth"] and (attitude is not None or vehicle.depth_sensor.is_zero):
        depth = columns_of("depth", inside["depth"])
    by_reference: dict[str, Preintegration | None] = {"bottom": None, "water": None}
    for reference in by_reference if attitude is not None else ():
        rows = [e for e in velocity if e.values[-1] == reference]
        if len(rows) > 1 and _known(frame, reference):
            psd = frame.setup.options.number("acceleration_psd")
            by_reference[reference] = Preintegration(
                columns_of("velocity", rows), track, psd, frame.gap
            )
    segment = Segment(depth=depth)
    return SegmentModel(
        segment, chain.t, track, by_reference["bottom"], by_reference["water"]
    ), blocks


def _known(frame: Frame, reference: str) -> bool:
    """Whether velocities of a reference can enter: those through the water need the current."""
    return reference == "bottom" or "current" in dict(frame.slow)


def _jump(frame: Frame, layout: Layout, k: int, jump: Break) -> LinearBlock:
    """The motion of a point over one interval, all but free."""
    names = KINEMATIC[: layout.order]
    node = np.array([k])
    sides = [layout.node_columns(name, node + end) for end in (0, 1) for name in names]
    phi = np.kron(transition(layout.order, frame.spacing)[0], np.eye(3))
    sigma = np.repeat([getattr(jump, name) for name in names], 3)
    matrix = np.concatenate([-phi, np.eye(len(phi))], axis=1) / sigma[:, None]
    return LinearBlock(
        "break", np.concatenate(sides, axis=1), matrix[None], np.zeros((1, len(phi)))
    )


def _stacked(
    block: LinearBlock, frame: Frame, count: int
) -> tuple[IntArray, FloatArray, FloatArray]:
    """A linear block's rows over local columns: owner (R,), rows (R, C), right-hand sides (R,)."""
    width, inner = frame.width, (count + 1) * frame.width
    columns, matrix, target = block.columns, block.matrix, block.target
    nodes = np.where((columns >= 0) & (columns < inner), columns // width, count + 1).min(axis=1)
    if block.name in NODE_BLOCKS:
        # The last node's own rows are the next interval's.
        stay = nodes < count
        columns, matrix, target, nodes = columns[stay], matrix[stay], target[stay], nodes[stay]
    owner = np.minimum(nodes, count - 1)
    local = np.where(columns < inner, columns - owner[:, None] * width, columns - inner)
    local = np.where(columns >= inner, local + 2 * width, local)
    local = np.where(columns < 0, frame.interval, local)
    m, r, _ = matrix.shape
    dense = np.zeros((m, r, frame.interval + 1))
    dense[np.arange(m)[:, None, None], np.arange(r)[None, :, None], local[:, None, :]] = matrix
    rows = dense[..., :-1].reshape(m * r, frame.interval)
    return np.repeat(owner, r), rows, target.reshape(-1)


def triangle(rows: FloatArray) -> FloatArray:
    """Upper triangle R of rows = Q R: the same least squares in as many rows as columns."""
    factor: FloatArray = np.linalg.qr(rows, mode="r")  # pyright: ignore[reportAssignmentType]
    return factor


def _compressed(
    owner: IntArray, rows: FloatArray, targets: FloatArray, count: int, height: int
) -> tuple[FloatArray, FloatArray]:
    """At most `height` rows for each interval, by QR; the same least squares."""
    size = rows.shape[1]
    out, right = np.zeros((count, height, size)), np.zeros((count, height))
    for k in range(count):
        own = owner == k
        some = np.column_stack([rows[own], targets[own]])
        if len(some) > size:
            some = triangle(some)[:height]
        out[k, : len(some)], right[k, : len(some)] = some[:, :-1], some[:, -1]
    return out, right
