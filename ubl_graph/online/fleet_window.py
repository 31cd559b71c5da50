"""The window of an online fleet: nodes of all vehicles over the last lag, solved as one.

What is older than the lag is eliminated by QR from all rows that touch it; the rest of these rows
is the prior of what remains, linearised where the window stood (`Prior`). Each vehicle keeps one
node at or before the lag's begin, so that a record from any later time finds nodes on both sides.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from scipy.linalg import block_diag

from ubl_graph import lie
from ubl_graph.arrays import BoolArray, FloatArray, IntArray
from ubl_graph.builder import FREE_POSITION
from ubl_graph.cooperative.fleet import Fleet
from ubl_graph.errors import SolverError
from ubl_graph.layout import UNITS
from ubl_graph.online.fleet_blocks import TARGET, Factor
from ubl_graph.online.fleet_gate import Verdict, judged
from ubl_graph.online.fleet_line import Line, Node
from ubl_graph.online.fleet_moments import Moments, PoseMoment
from ubl_graph.online.fleet_prior import Key, Prior
from ubl_graph.online.fleet_system import Evaluated, Point, Solved, System
from ubl_graph.online.rows import triangle
from ubl_graph.pose_builder import FREE_ROTATION


class Window:
    """Nodes, rows and prior.

    Parameters
    ----------
    fleet : Fleet
        Beacons, water, options.
    lines : dict of str to Line
        All vehicles.

    Attributes
    ----------
    factors : list of Factor
        What counts.
    shared : dict of str to array
        States that all nodes share, in the layout's units.
    epoch : float
        Time of clocks' offsets and of moving targets' positions, s.
    """

    def __init__(self, fleet: Fleet, lines: dict[str, Line]) -> None:
        self.fleet, self.lines = fleet, lines
        self.factors: list[Factor] = []
        self.shared: dict[str, FloatArray] = {}
        self.prior = Prior()
        self.epoch = 0.0
        self.solution: Solved | None = None
        self._point: Point | None = None
        self._system: System | None = None
        self._changed = False

    @property
    def planar(self) -> bool:
        """Whether vehicles move in planes."""
        return next(iter(self.lines.values())).planar

    @property
    def node_count(self) -> int:
        """Nodes of all vehicles."""
        return sum(len(line.nodes) for line in self.lines.values())

    # -- what there is --

    def share(self, name: str, mean: FloatArray, sigma: FloatArray) -> None:
        """Take in a state that all nodes share: mean and standard deviation, SI."""
        self._changed = True
        unit = UNITS.get(name, 1.0)
        self.shared[name] = np.asarray(mean, dtype=np.float64) / unit
        self.prior.know(name, self.shared[name], np.maximum(sigma / unit, 1e-9))

    def locate(self, line: Line, t: float, x: FloatArray) -> Node:
        """Give a vehicle its first node, of which next to nothing is known."""
        self._changed = True
        node = Node(t, x)
        line.nodes = [node]
        self.prior.know(node, x, _free(len(x)))
        return node

    def add(self, factor: Factor) -> None:
        """Take in a factor whose nodes are there."""
        self._changed = True
        for node in factor.nodes:
            node.held += 1
        self.factors.append(factor)

    def remove(self, factor: Factor) -> None:
        """Take a factor out."""
        self._changed = True
        self.factors.remove(factor)
        for node in factor.nodes:
            node.held -= 1

    def tidy(self) -> None:
        """Drop nodes that nothing needs any more."""
        held = self.prior.nodes
        for line in self.lines.values():
            for node in line.nodes[1:-1]:
                if node.held == 0 and node not in held:
                    line.drop(node)

    # -- solving --

    def solve(self) -> list[Verdict]:
        """Judge what is new by what is there, and solve with what passed.

        Raises
        ------
        SolverError, numpy.linalg.LinAlgError
            Where there is no solution; nodes and states are as they were.
        """
        for line in self.lines.values():
            line.refresh()
            if not line.planar:
                self._unwind(line)
        system = self._made()
        if not system.nodes:
            return []
        point = system.evaluate(system.x)
        verdicts, first = judged(system, point)
        if self._take_ups(verdicts):
            # Ranges that came with the fixes are judged at the heights that these say.
            system = self._made()
            point = system.evaluate(system.x)
            verdicts, first = judged(system, point)
        refused = [v.factor for v in verdicts if not v.accepted]
        for verdict in verdicts:
            verdict.factor.fresh = False
        if refused:
            for factor in refused:
                self.remove(factor)
            system.set_factors(self.factors)
            point, first = system.evaluate(system.x), None
        point, factor = system.minimise(point, first)
        if not np.isfinite(point.x).all():
            raise SolverError("the window's solution is not finite")
        width = system.layout.node_width
        for node in system.nodes:
            node.x = point.x[node.number * width : (node.number + 1) * width]
        for name in self.shared:
            self.shared[name] = point.x[system.layout.shared_columns(name)]
        self.solution = Solved(system.layout, point.x, factor, frozenset(system.nodes), self.epoch)
        self._point, self._system = point, system
        self._changed = False
        return verdicts

    def _made(self) -> System:
        return System(self.fleet, self.lines, self.factors, self.prior, self.shared, self.epoch)

    def _take_ups(self, verdicts: Sequence[Verdict]) -> bool:
        """Take up the heights of fixes of planar vehicles that passed, and no others'."""
        new = False
        for verdict in verdicts:
            factor, entry = verdict.factor, verdict.factor.entry
            if entry is None or entry.kind != "position" or entry.values[1].shape[1] < 3:
                continue
            up = float(entry.values[1][0, 2])
            if factor.line.planar and verdict.accepted:
                new |= factor.line.take_up(entry.t, up)
            elif factor.line.planar:
                factor.line.drop_up(entry.t, up)
        return new

    def restart(self) -> None:
        """Take for the past what the last solution knew of each first node and state alone."""
        self.prior = Prior()
        self._point, self._changed = None, True
        solution = self.solution
        for line in self.lines.values():
            for node in line.nodes[:1]:
                x, sigma = node.x, _free(len(node.x))
                if solution is not None and node in solution.nodes:
                    columns = node.number * len(x) + np.arange(len(x))
                    own = solution.covariance(columns).diagonal()
                    sigma = np.where(np.isfinite(own) & (own > 0.0), np.sqrt(np.abs(own)), sigma)
                    x = solution.x[columns]
                node.x = x
                self.prior.know(node, x, sigma)
        for name, values in self.shared.items():
            sigma = np.full(len(values), 1.0)
            if solution is not None and solution.layout.has(name):
                columns = solution.layout.shared_columns(name)
                sigma = np.sqrt(np.maximum(solution.covariance(columns).diagonal(), 1e-18))
                values = solution.x[columns].copy()
                self.shared[name] = values
            self.prior.know(name, values, sigma)

    def _unwind(self, line: Line) -> None:
        """Take full turns out of rotation vectors that nothing is linearised about."""
        held = self.prior.nodes
        for node in line.nodes:
            if node not in held and node.x[3:] @ node.x[3:] > np.pi**2:
                turn = lie.rotation_vector(lie.rotation(node.x[None, 3:]))[0]
                node.x = np.concatenate([node.x[:3], turn])

    # -- the past --

    def leaving(self, horizon: float) -> dict[str, list[Node]]:
        """Nodes that are older than the horizon (s) and have a later one that is, too."""
        out: dict[str, list[Node]] = {}
        for name, line in self.lines.items():
            count = 0
            while count + 1 < len(line.nodes) and line.nodes[count + 1].t <= horizon:
                count += 1
            if count:
                out[name] = line.nodes[:count]
        return out

    def moments(self, nodes: Sequence[Node], line: Line) -> list[PoseMoment]:
        """Poses of nodes of the solved window."""
        assert self.solution is not None
        moments = Moments(self.solution, self.lines)
        return [moments.at_node(node, line) for node in nodes]

    @property
    def can_leave(self) -> bool:
        """Whether the window is solved, and nothing has left it since."""
        return self._point is not None

    @property
    def is_changed(self) -> bool:
        """Whether a solve has anything new to say."""
        known = frozenset[Node]() if self.solution is None else self.solution.nodes
        return self._changed or any(
            node.step is None or node not in known
            for line in self.lines.values()
            for node in line.nodes[1:]
        )

    def marginalise(self, leaving: Iterable[Node], states: Sequence[str] = ()) -> None:
        """Eliminate nodes, and states that all nodes share, of the solved window."""
        assert self._system is not None and self._point is not None
        layout, width = self._system.layout, self._system.layout.node_width
        gone = set(leaving)
        numbers = np.array(sorted(node.number for node in gone), dtype=np.int64)
        away = (numbers[:, None] * width + np.arange(width)).ravel()
        away = np.concatenate([away, *(layout.shared_columns(name) for name in states)])
        is_away = np.zeros(layout.size + 1, dtype=np.bool_)
        is_away[away] = True
        parts = [
            (part, np.asarray(is_away[part.rows.block.columns].any(axis=1)))
            for part in self._point.parts
        ]
        parts = [(part, rows) for part, rows in parts if rows.any()]
        columns = [self.prior.columns(layout), away]
        columns += [part.rows.block.columns[rows].ravel() for part, rows in parts]
        touched = np.unique(np.concatenate(columns))
        rest = touched[(touched >= 0) & ~is_away[touched]]
        order = np.concatenate([away, rest])
        left = self._eliminated(parts, order, len(away))
        keys = self._keys(rest)
        self.prior.replace(keys, left[:, :-1], left[:, -1])
        for line in self.lines.values():
            line.nodes = [node for node in line.nodes if node not in gone]
        self.factors = [
            f
            for f in self.factors
            if not gone.intersection(f.nodes) and TARGET + f.peer not in states
        ]
        for name in states:
            del self.shared[name]
        self._point = None

    def _eliminated(
        self, parts: Sequence[tuple[Evaluated, BoolArray]], order: IntArray, count: int
    ) -> FloatArray:
        """Rows over the columns behind the first `count` of an order, right-hand side behind."""
        assert self._system is not None and self._point is not None
        layout, x = self._system.layout, self._point.x
        size = len(order)
        place = np.full(layout.size + 1, size, dtype=np.int64)
        place[order] = np.arange(size)
        known = np.zeros((len(self.prior.rows), size + 2))
        known[:, place[self.prior.columns(layout)]] = self.prior.rows
        known[:, -1] = self.prior.target
        stacked = [known]
        for part, rows in parts:
            root = np.sqrt(part.weight[rows])[:, None]
            slope = part.slope[rows] * root[:, :, None]
            residual = part.residual[rows] * root
            m, r, _ = slope.shape
            own = part.rows.block.columns[rows]
            whole = np.zeros((m, r, size + 2))
            at = place[np.where(own < 0, layout.size, own)]
            # A ping's legs may see one node twice.
            where = (np.arange(m)[:, None, None], np.arange(r)[None, :, None], at[:, None, :])
            np.add.at(whole, where, slope)
            whole[:, :, -1] = np.einsum("mrc,mc->mr", slope, x[own]) - residual
            stacked.append(whole.reshape(m * r, -1))
        rows = np.delete(np.concatenate(stacked), size, axis=1)
        return triangle(rows)[count:size, count:]

    def _keys(self, columns: IntArray) -> list[Key]:
        assert self._system is not None
        layout, width = self._system.layout, self._system.layout.node_width
        names = {
            int(column): (name, i)
            for name, _ in layout.shared
            for i, column in enumerate(layout.shared_columns(name))
        }
        return [
            (self._system.nodes[c // width], c % width) if c < layout.inner else names[c]
            for c in columns.tolist()
        ]

    def move_epoch(self, t: float, walks: Mapping[str, FloatArray]) -> None:
        """Refer clocks and moving targets to a later time, and let states wander till then.

        Parameters
        ----------
        t : float
            s.
        walks : mapping of str to array
            Random walk of each component of a state, SI per sqrt(s); those of a clock's offset
            and drift go together.
        """
        dt = t - self.epoch
        self.epoch = t
        keys: list[Key] = []
        parts: list[tuple[FloatArray, FloatArray]] = []
        for name, walk in walks.items():
            if name == "clock_drift":
                continue
            units = np.array([UNITS.get(name, 1.0), UNITS["clock_drift"]])
            for i, own in enumerate(np.maximum(walk, 1e-12 * units[0])):
                if name != "clock_offset":
                    keys.append((name, i))
                    parts.append((np.eye(1), np.array([[dt * (own / units[0]) ** 2]])))
                    continue
                keys += [(name, i), ("clock_drift", i)]
                phi = np.array([[1.0, dt * units[1] / units[0]], [0.0, 1.0]])
                drift = max(float(walks["clock_drift"][i]), 1e-15)
                noise = np.diag([dt * own**2, 0.0])
                noise += drift**2 * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
                parts.append((phi, noise / np.outer(units, units)))
                self.shared[name][i] += phi[0, 1] * self.shared["clock_drift"][i]
        if keys:
            phi, noise = (
                np.asarray(block_diag(*some), dtype=np.float64) for some in zip(*parts, strict=True)
            )
            self.prior.evolve(keys, phi, noise)
        for name, values in self.shared.items():
            if name.startswith(TARGET) and len(values) == 6:
                values[:3] += dt * values[3:]
                phi = np.eye(6)
                phi[:3, 3:] = dt * np.eye(3)
                self.prior.evolve([(name, i) for i in range(6)], phi)

    # -- what it says --

    def moment(self, name: str, t: float) -> PoseMoment:
        """A vehicle's pose at a time, by odometry from its last node before.

        Raises
        ------
        SolverError
            Where the vehicle has no node in the solved window.
        """
        if self.solution is None:
            raise SolverError("the window is not solved")
        return Moments(self.solution, self.lines).at(name, t)


def _free(size: int) -> FloatArray:
    """Standard deviations of a pose's columns of which nothing is known."""
    return np.array(
        [FREE_POSITION] * (2 if size == 3 else 3) + [FREE_ROTATION] * (size // 3 * 2 - 1)
    )
