"""Blocks of the intervals between poses, from the records there, and their rows where poses stand.

As for points a record counts for the interval that it falls into. Rows of poses are not linear:
they hold where they were made, and are made anew where nodes have moved away from there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ubl_graph import lie
from ubl_graph.arrays import BoolArray, FloatArray
from ubl_graph.attitude import AttitudeTrack
from ubl_graph.builder import Builder, SegmentModel
from ubl_graph.factors import pose_motion
from ubl_graph.factors.block import ALL_ROWS, Block, CurvedBlock, LinearBlock
from ubl_graph.factors.gyro import GyroTrack
from ubl_graph.factors.odometry import Preintegration, longest_gap_of
from ubl_graph.factors.poses import PoseBlock, PoseNodes
from ubl_graph.factors.tips import PosesAt
from ubl_graph.layout import POSE_PLACES, Chain, Interpolation, Layout
from ubl_graph.measurements import Attitude, Odometry
from ubl_graph.mission import Segment
from ubl_graph.nodes import slot_of
from ubl_graph.odometry_noise import PLANAR, node_of, odometry_covariances, whitening_of
from ubl_graph.online.buffer import Buffer, Entry, columns_of, fixes_of, odometry_of
from ubl_graph.online.frame import Break, Frame
from ubl_graph.online.grid_odometry import on_grid
from ubl_graph.pose_builder import PoseBuilder
from ubl_graph.pose_path import Poses
from ubl_graph.trajectory import inside

#: Rows are made anew where nodes have moved or turned by more than this from where they were made:
#: the second order is then a thousandth of a millimetre a second.
TURNED, MOVED = 5e-3, 0.05
#: The same of slow states and of what is shared.
STRAYED = {"heading_bias": 5e-3, "current": 0.05, "odometry_scale": 0.01}
#: Time over which a slow state that does not walk counts as constant, s.
CONSTANT_SPAN = 3600.0
#: The rate of a sensor of turns is judged by so many of its last records.
LAST_RECORDS = 100


def linearised(block: Block, x: FloatArray) -> LinearBlock:
    """A block's rows as they are at the flat vector `x`."""
    if isinstance(block, LinearBlock):
        return block
    residual, matrix = block.evaluate(x, block.frozen(x))
    assert matrix is not None
    target = np.einsum("mrc,mc->mr", matrix, x[block.columns]) - residual
    return LinearBlock(block.name, block.columns, matrix, target)


def tolerances(frame: Frame) -> FloatArray:
    """How far each column of an interval may stray from where its rows were made, (C,).

    Positions count as seen from the first of the two nodes.
    """
    far = {"position": MOVED, "velocity": MOVED, "rotation": TURNED, "rate": TURNED, **STRAYED}
    layout = frame.node
    node = np.concatenate(
        [
            np.full(size, far.get(name, np.inf) / layout.unit(name))
            for name, size in (*layout.kinematic, *layout.slow)
        ]
    )
    shared = [
        np.full(size, far.get(name, np.inf) / layout.unit(name)) for name, size in frame.shared
    ]
    return np.concatenate([node, node, *shared])


def pose_blocks(
    frame: Frame, buffer: Buffer, builder: PoseBuilder, chain: Chain, x: FloatArray
) -> list[LinearBlock]:
    """All blocks of the intervals of a chain of poses, but for ranges, linearised.

    Parameters
    ----------
    frame : Frame
        The unknowns.
    buffer : Buffer
        The records.
    builder : Builder
        Over a layout of this chain alone.
    chain : Chain
        Nodes of the grid.
    x : array
        Where they stand.
    """
    begin, end = float(chain.t[0]), float(chain.t[-1])
    # A record of the very end belongs to the next interval, as one of the very beginning to this.
    own = {
        kind: [e for e in buffer.between(kind, begin - 1e-9, end - 1e-9) if not e.gated]
        for kind in ("depth", "heading", "position", "set_position")
    }
    model = _model(frame, buffer, chain, own)
    blocks: list[Block] = [
        builder.fix_block(chain, rows, model.attitude) for rows in fixes_of(own["position"])
    ]
    for entry in own["set_position"]:
        blocks += builder.start_blocks(chain, entry.record)  # pyright: ignore[reportArgumentType]
    newest = _newest_attitude(frame, buffer, builder, chain)
    if newest is not None:
        blocks.append(newest)
    odometry = model.segment.odometry
    if odometry is not None:
        blocks.append(_arrival(builder, chain, odometry))
    if not frame.is_planar and not buffer.of("attitude"):
        blocks.append(builder.upright(chain))
    blocks += builder.linear_blocks(chain, model, CONSTANT_SPAN)
    linear = [linearised(block, x) for block in blocks if len(block.columns)]
    told = _told_nodes(frame, model, chain)
    return [
        _of_nodes(block, frame, told) if block.name == "attitude" else block for block in linear
    ]


def _told_nodes(frame: Frame, model: SegmentModel, chain: Chain) -> BoolArray:
    """Nodes that attitude records enclose, and that are the nearest ones to some of them, (N,).

    Of a few intervals alone the builder cannot tell: no record counts at more than one node.
    """
    records = model.segment.attitude
    if records is None:
        return np.zeros(len(chain.t), dtype=np.bool_)
    near = np.abs(records.t[None] - chain.t[:, None]).min(axis=1) <= 0.5 * frame.spacing + 1e-9
    return near & inside(records.t[[0, -1]], chain.t)


def _of_nodes(block: LinearBlock, frame: Frame, which: BoolArray) -> LinearBlock:
    """The rows of some nodes."""
    stay = which[block.columns[:, 0] // frame.width]
    return LinearBlock(block.name, block.columns[stay], block.matrix[stay], block.target[stay])


def _newest_attitude(frame: Frame, buffer: Buffer, builder: Builder, chain: Chain) -> Block | None:
    """The attitude reference's last record, where no node has been reached since it came.

    Others count at the nodes that they enclose; what is known of now should not wait for that.
    """
    last = next((e for e in reversed(buffer.of("attitude")) if not e.gated), None)
    if last is None or not chain.t[0] + 1e-6 < last.t < chain.t[-1] - 1e-6:
        return None
    at = np.array([last.t])
    on_node = np.abs(chain.t - last.t).min() < 1e-6
    if on_node or slot_of(last.t, frame.spacing) != round(chain.t[-2] / frame.spacing):
        return None
    bias = None
    if builder.layout.has("heading_bias"):
        bias = builder.layout.travelling_or_shared_at("heading_bias", chain, at)
    poses = PosesAt(builder.layout, chain, at)
    options = builder.options
    swing = options.angular_acceleration_psd * poses.variance_factor
    sigma = np.sqrt(np.deg2rad(options.attitude_noise_deg) ** 2 + swing)
    track = AttitudeTrack(columns_of("attitude", [last]))
    return AttitudeBlock(poses, track.at(at), sigma, bias, planar=frame.is_planar)


class AttitudeBlock(CurvedBlock):
    """Whitened residuals of attitudes at any times: Log(measured' Rz(-bias) R).

    Parameters
    ----------
    poses : PosesAt
        M poses at the records' times.
    measured : array, shape (M, 3, 3)
        `world_R_body` as read.
    sigma : array, shape (M,)
        About each axis, rad.
    bias : Interpolation, optional
        Of what the reference reads too far clockwise (M rows, one component), rad.
    planar : bool
        Whether the turn about the vertical alone counts.
    """

    name = "newest attitude"

    def __init__(
        self,
        poses: PosesAt,
        measured: FloatArray,
        sigma: FloatArray,
        bias: Interpolation | None,
        *,
        planar: bool,
    ) -> None:
        self._poses, self._sigma, self._bias = poses, sigma, bias
        self._residual = pose_motion.attitude(measured)
        self._keep = np.array([2]) if planar else np.arange(3)
        parts = [poses.columns]
        if bias is not None:
            parts.append(bias.columns[:, :, 0])
        self.columns = np.concatenate(parts, axis=1)

    def log_det(self) -> float:
        """Sum of the logarithms of what whitens the rows."""
        return -len(self._keep) * float(np.log(self._sigma).sum())

    def evaluate(
        self,
        x: FloatArray,
        frozen: FloatArray | None = None,  # noqa: ARG002 - the protocol's form
        rows: slice = ALL_ROWS,
        jacobian: bool = True,
    ) -> tuple[FloatArray, FloatArray | None]:
        """Whitened residuals (m, R) of `rows` at `x` and Jacobians (m, R, C)."""
        position, rotation, slopes = self._poses.at(x, rows)
        none = np.zeros((len(position), 6))
        extra = np.zeros((len(position), 1))
        if self._bias is not None:
            columns, weights = self._bias.columns[rows][:, :, 0], self._bias.weights[rows]
            extra[:, 0] = (x[columns] * weights).sum(axis=1)
        poses = Poses(position, rotation, rotation, none)
        value, (by_pose,), by_bias = self._residual([poses], extra, rows)
        inverse = 1.0 / self._sigma[rows][:, None]
        residual = value[:, self._keep] * inverse
        if not jacobian:
            return residual, None
        parts = [slopes.to_columns(by_pose[:, self._keep, :6])]
        if self._bias is not None:
            parts.append(by_bias[:, self._keep] * self._bias.weights[rows][:, None, :])
        return residual, np.concatenate(parts, axis=2) * inverse[:, :, None]


def _arrival(builder: Builder, chain: Chain, odometry: Odometry) -> Block:
    """Twists with which the vehicle leaves the intervals that odometry spans.

    Between nodes that odometry joins the motion prior is let go, and with it what a change of pose
    says of the twist. It takes the vehicle on from the last one: the mean twist of an interval
    strays from that at its end by a third of the prior's noise.
    """
    layout, options = builder.layout, builder.options
    k = node_of(chain.t, odometry.t_from)
    dt = odometry.t_to - odometry.t_from
    planar = layout.node == "pose2" or odometry.dimension == 2
    keep = PLANAR if planar else np.arange(6)
    turn = np.full(3, options.angular_acceleration_psd)
    noise = np.concatenate([builder.psd, turn])[keep] * (dt[:, None] / 3.0)
    covariance = odometry_covariances(odometry, options)
    if covariance.shape[1] > len(keep):
        covariance = covariance[:, keep[:, None], keep[None, :]]
    whole = covariance / dt[:, None, None] ** 2 + noise[:, :, None] * np.eye(len(keep))
    twist = lie.logarithm(lie.rotation(odometry.rotation_vector), odometry.translation)
    told = twist / dt[:, None]

    def residual(
        poses: Sequence[Poses], extra: FloatArray, rows: slice
    ) -> tuple[FloatArray, list[FloatArray], FloatArray]:
        value = poses[1].twist - told[rows]
        slope = np.zeros((len(value), 6, 12))
        slope[:, :, 6:] = np.eye(6)
        return value, [np.zeros_like(slope), slope], np.zeros((len(value), 6, extra.shape[1]))

    ends = (PoseNodes(layout, k), PoseNodes(layout, k + 1))
    return PoseBlock("arrival", ends, residual, whitening_of(whole), keep)


def _model(frame: Frame, buffer: Buffer, chain: Chain, own: dict[str, list[Entry]]) -> SegmentModel:
    """The records of some intervals as a segment, with what is derived from them."""
    begin, end = float(chain.t[0]), float(chain.t[-1])
    velocity = _around(buffer, "velocity", begin, end, frame.gap)
    reach = [e.t for e in velocity]
    first, last = min([begin, *reach]), max([end, *reach])
    attitudes = _around(buffer, "attitude", first, last, usual_gap(buffer, "attitude"))
    rates = _around(buffer, "angular_rate", first, last, usual_gap(buffer, "angular_rate"))
    gyro = None
    if len(rates) > 1:
        longest = usual_gap(buffer, "angular_rate")
        gyro = GyroTrack(columns_of("angular_rate", rates), longest)
    track, turn_sigma = _turns(buffer, attitudes, gyro, first, last)
    by_gyro = None if gyro is None else AttitudeTrack.of(gyro.t, gyro.rotations)
    odometry = [e for e in buffer.reaching("odometry", begin) if e.begin < end and not e.gated]
    segment = Segment(
        depth=columns_of("depth", own["depth"]) if own["depth"] else None,
        heading=columns_of("heading", own["heading"]) if own["heading"] else None,
        # A single record says nothing of the nodes beside it.
        attitude=columns_of("attitude", attitudes) if len(attitudes) > 1 else None,
        odometry=on_grid(odometry_of(odometry), chain.t, frame.setup.options),
    )
    return SegmentModel(
        segment,
        chain.t,
        track,
        _ways(frame, velocity, "bottom", track),
        _ways(frame, velocity, "water", track),
        gyro,
        _ways(frame, velocity, "bottom", by_gyro),
        _ways(frame, velocity, "water", by_gyro),
        turn_sigma,
    )


def _ways(
    frame: Frame, velocity: list[Entry], reference: str, track: AttitudeTrack | None
) -> Preintegration | None:
    """Velocities of a reference integrated along an attitude."""
    rows = [e for e in velocity if e.values[-1] == reference]
    if len(rows) < 2 or track is None:
        return None
    psd = frame.setup.options.number("acceleration_psd")
    return Preintegration(columns_of("velocity", rows), track, psd, frame.gap)


def _turns(
    buffer: Buffer, attitudes: list[Entry], gyro: GyroTrack | None, begin: float, end: float
) -> tuple[AttitudeTrack, float]:
    """Attitude that body velocities are turned by, of which the turns alone count, and its noise.

    The noise is white, rad; where the nodes' attitude has it in common it is none.
    """
    if attitudes:
        return AttitudeTrack(columns_of("attitude", attitudes)), 0.0
    if gyro is not None:
        return AttitudeTrack.of(gyro.t, gyro.rotations), 0.0
    compass = _around(buffer, "heading", begin, end, usual_gap(buffer, "heading"))
    if compass:
        rows = columns_of("heading", compass)
        return AttitudeTrack(Attitude(rows.t, rows.heading)), float(np.median(rows.sigma))
    return AttitudeTrack(None), 0.0


def _around(buffer: Buffer, kind: str, begin: float, end: float, gap: float) -> list[Entry]:
    """Good records between two times and beside them, but for those from beyond a gap, s."""
    low, high = begin - gap, end + gap
    return [e for e in buffer.around(kind, begin, end) if low <= e.t <= high]


def usual_gap(buffer: Buffer, kind: str) -> float:
    """Longest gap that records of a kind bridge, by their pace of late, s."""
    times = np.array([e.t for e in buffer.of(kind)[-LAST_RECORDS:]])
    return longest_gap_of(np.diff(times))


def jump_block(frame: Frame, layout: Layout, k: int, jump: Break) -> Block:
    """The motion of a pose over one interval, all but free."""
    kept = POSE_PLACES[layout.node]
    sigma = np.repeat(
        [getattr(jump, name) for name in ("position", "rotation", "velocity", "rate")], 3
    )[kept]
    nodes = np.array([k])
    ends = (PoseNodes(layout, nodes), PoseNodes(layout, nodes + 1))
    residual = pose_motion.motion(np.array([frame.spacing]))
    return PoseBlock("break", ends, residual, np.diag(1.0 / sigma)[None], kept)
