"""Poses with covariances of a fleet's solved window: at nodes, and by odometry after them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ubl_graph import lie
from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.errors import SolverError
from ubl_graph.odometry_chain import INSTANT, Steps
from ubl_graph.odometry_noise import PLANAR
from ubl_graph.online.fleet_line import Line, Node, turns_and_ways
from ubl_graph.online.fleet_system import Solved

UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class PoseMoment:
    """Mean and covariance of a pose at one time.

    Attributes
    ----------
    t : float
        s.
    position : array, shape (3,)
        East, north, up, m.
    rotation : array, shape (3, 3)
        `world_R_body`.
    covariance : array, shape (6, 6)
        Position (m), then rotation about east, north, up (rad); zero for what a plane has not.
    """

    t: float
    position: FloatArray
    rotation: FloatArray
    covariance: FloatArray


class Moments:
    """Poses of a solved window.

    Parameters
    ----------
    solved : Solved
        The window's solution.
    lines : mapping of str to Line
        All vehicles.
    """

    def __init__(self, solved: Solved, lines: Mapping[str, Line]) -> None:
        self._solved, self._lines = solved, lines

    def at_node(self, node: Node, line: Line) -> PoseMoment:
        """The pose of a node."""
        return self._at_node(node, line)[0]

    def at(self, name: str, t: float) -> PoseMoment:
        """A vehicle's pose at a time, by odometry from its last node before.

        Raises
        ------
        SolverError
            Where the vehicle has no node in the solved window.
        """
        line = self._lines[name]
        node = self._known_before(line, t)
        at_node, body, columns = self._at_node(node, line)
        if t <= node.t + INSTANT:
            return at_node
        steps, slopes, extra = self._predicted(line, name, node.t, t)
        # Motions of the node in its own axes, and errors of the odometry, onto the end.
        carry = np.concatenate([steps.backward()[0] @ body, slopes], axis=1)
        joint = self._solved.covariance(np.concatenate([columns, extra]))
        covariance = carry @ joint @ carry.T + steps.covariance[0]
        turn = lie.rotation(steps.rotation[:, None] * UP) if steps.planar else steps.rotation
        way = np.zeros(3)
        way[: steps.way.shape[1]] = steps.way[0]
        rotation = at_node.rotation @ turn[0]
        position = at_node.position + at_node.rotation @ way
        if line.planar:
            position[2] = line.up_at(np.array([t]))[0]
        return PoseMoment(t, position, rotation, _in_world(rotation, covariance))

    def _known_before(self, line: Line, t: float) -> Node:
        known = [n for n in line.nodes if n in self._solved.nodes]
        earlier = [n for n in known if n.t <= t + INSTANT]
        if known:
            return earlier[-1] if earlier else known[0]
        raise SolverError(f"vehicle '{line.member.name}' is not in the solved window")

    def _at_node(self, node: Node, line: Line) -> tuple[PoseMoment, FloatArray, IntArray]:
        """Pose of a node; its body's motions by its columns; and these."""
        x, layout = self._solved.x, self._solved.layout
        width = layout.node_width
        columns = node.number * width + np.arange(width)
        own = x[columns]
        body = np.zeros((width, width))
        if line.planar:
            rotation = lie.rotation(own[2] * UP[None])[0]
            position = np.array([own[0], own[1], line.up_at(np.array([node.t]))[0]])
            body[:2, :2], body[2, 2] = rotation[:2, :2].T, 1.0
        else:
            rotation, position = lie.rotation(own[None, 3:])[0], own[:3].copy()
            body[:3, :3] = rotation.T
            body[3:, 3:] = lie.rotation_slope(own[None, 3:])[0]
        covariance = body @ self._solved.covariance(columns) @ body.T
        return (
            PoseMoment(node.t, position, rotation, _in_world(rotation, covariance)),
            body,
            columns,
        )

    def _predicted(
        self, line: Line, name: str, t_from: float, t_to: float
    ) -> tuple[Steps, FloatArray, IntArray]:
        """Odometry with its errors taken out, and how these move its end: slopes and columns."""
        x, layout = self._solved.x, self._solved.layout
        step = line.between((t_from, t_to))
        vectors, way = turns_and_ways(step)
        turn, own = lie.rotation(vectors), step.covariance
        owner = list(self._lines).index(name)
        slopes: list[FloatArray] = []
        columns: list[int] = []
        if layout.has("odometry_turn_bias"):
            columns.append(int(layout.shared_columns("odometry_turn_bias")[owner]))
            unit = layout.unit("odometry_turn_bias")
            missing = (x[columns[-1]] * unit * (t_to - t_from)) * UP[None]
            way = np.einsum("mij,mj->mi", lie.rotation(0.5 * missing), way)
            turn = lie.rotation(missing) @ turn
            half = np.cross(UP, 0.5 * (t_to - t_from) * way[0])
            moved = np.concatenate([turn[0].T @ half, (t_to - t_from) * turn[0, 2]])
            slopes.append(unit * moved)
        if layout.has("odometry_scale"):
            columns.append(int(layout.shared_columns("odometry_scale")[owner]))
            unit = layout.unit("odometry_scale")
            slopes.append(unit * np.concatenate([turn[0].T @ way[0], np.zeros(3)]))
            way = (1.0 + x[columns[-1]] * unit) * way
        keep = PLANAR if line.planar else np.arange(6)
        by_errors = np.array(slopes).reshape(-1, 6).T[keep]
        if line.planar:
            angle = np.arctan2(turn[:, 1, 0], turn[:, 0, 0])
            return Steps(angle, way[:, :2], own), by_errors, np.array(columns, dtype=np.int64)
        return Steps(turn, way, own), by_errors, np.array(columns, dtype=np.int64)


def _in_world(rotation: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariance (6, 6) in the world's axes of motions in the body's, (3, 3) or (6, 6)."""
    whole = np.zeros((6, 6))
    keep = PLANAR if len(covariance) == 3 else np.arange(6)
    whole[np.ix_(keep, keep)] = covariance
    turn = np.kron(np.eye(2), rotation)
    return turn @ whole @ turn.T
