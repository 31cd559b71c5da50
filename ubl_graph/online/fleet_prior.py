"""What the past left: a square root of the information on the columns that it touched.

Rows P x - d over columns named by node or state, so that they stay right when nodes come and go.
They were linearised where the window stood when the nodes left it, and stay so.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ubl_graph.arrays import FloatArray, IntArray
from ubl_graph.layout import Layout
from ubl_graph.online.fleet_line import Node
from ubl_graph.online.rows import triangle

#: A column: a node's component, or that of a state that all nodes share.
Key = tuple[Node | str, int]


class Prior:
    """Rows over some columns.

    Attributes
    ----------
    keys : list of Key
        The columns, n of them.
    rows : array, shape (r, n)
        P.
    target : array, shape (r,)
        d.
    """

    def __init__(self) -> None:
        self.keys: list[Key] = []
        self.rows: FloatArray = np.empty((0, 0))
        self.target: FloatArray = np.empty(0)
        self._information: FloatArray | None = None

    @property
    def information(self) -> FloatArray:
        """P' P, (n, n)."""
        if self._information is None:
            self._information = self.rows.T @ self.rows
        return self._information

    @property
    def nodes(self) -> set[Node]:
        """Nodes that it speaks of."""
        return {key for key, _ in self.keys if isinstance(key, Node)}

    def columns(self, layout: Layout) -> IntArray:
        """Where its columns stand in the flat vector."""
        width = layout.node_width
        first = {name: int(layout.shared_columns(name)[0]) for name, _ in layout.shared}
        return np.array(
            [
                (key.number * width if isinstance(key, Node) else first[key]) + i
                for key, i in self.keys
            ],
            dtype=np.int64,
        )

    def know(self, key: Node | str, mean: FloatArray, sigma: FloatArray) -> None:
        """Add independent knowledge of new columns: mean and standard deviation, (k,) each."""
        n, k = len(self.keys), len(mean)
        rows = np.zeros((len(self.rows) + k, n + k))
        rows[: len(self.rows), :n] = self.rows
        rows[len(self.rows) :, n:] = np.diag(1.0 / sigma)
        self._set(
            [*self.keys, *((key, i) for i in range(k))], rows, [*self.target, *(mean / sigma)]
        )

    def learn(self, keys: Sequence[Key], rows: FloatArray, target: FloatArray) -> None:
        """Add rows over columns that are there already."""
        place = [self.keys.index(key) for key in keys]
        more = np.zeros((len(rows), len(self.keys)))
        more[:, place] = rows
        self._set(self.keys, np.concatenate([self.rows, more]), [*self.target, *target])

    def replace(self, keys: Sequence[Key], rows: FloatArray, target: FloatArray) -> None:
        """Take other rows over other columns in place of all."""
        self._set(list(keys), rows, target)

    def forget(self, keys: set[Key]) -> None:
        """Eliminate columns that nothing else speaks of."""
        away = [i for i, key in enumerate(self.keys) if key in keys]
        rest = [i for i, key in enumerate(self.keys) if key not in keys]
        whole = np.column_stack([self.rows[:, away + rest], self.target])
        left = triangle(whole)[len(away) : len(away) + len(rest), len(away) :]
        self._set([self.keys[i] for i in rest], left[:, :-1], left[:, -1])

    def evolve(
        self, keys: Sequence[Key], phi: FloatArray, covariance: FloatArray | None = None
    ) -> None:
        """Move states on: s becomes phi s + w, w of a covariance (k, k), in the columns' units."""
        place = [self.keys.index(key) for key in keys]
        rows = self.rows.copy()
        rows[:, place] = self.rows[:, place] @ np.linalg.inv(phi)
        self._set(self.keys, rows, self.target)
        if covariance is None:
            return
        k, size = len(keys), len(self.keys)
        away = set(place)
        rest = [i for i in range(size) if i not in away]
        white = np.linalg.inv(np.linalg.cholesky(covariance))
        whole = np.zeros((len(rows) + k, size + k + 1))
        whole[:-k, :size] = rows[:, place + rest]
        whole[:-k, -1] = self.target
        whole[-k:, :k] = -white
        whole[-k:, size : size + k] = white
        left = triangle(whole)[k : k + size, k:]
        self._set([*(self.keys[i] for i in rest), *keys], left[:, :-1], left[:, -1])

    def _set(self, keys: list[Key], rows: FloatArray, target: FloatArray | Sequence[float]) -> None:
        self.keys, self.rows = keys, rows
        self.target = np.asarray(target, dtype=np.float64)
        self._information = None
