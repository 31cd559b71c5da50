"""What a PyFG file says: vertices, priors and edges as columns, and what its lines hold.

PyFG is the format of PyFactorGraph (Papalia et al., MIT Marine Robotics Group) for range-aided
SLAM. All noise stands as variances and covariances, never as standard deviations; translation comes
before rotation. `pyfg` reads and writes it; docs/pyfg.md names the traps.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from ubl_graph.arrays import BoolArray, FloatArray, frozen
from ubl_graph.errors import DataError
from ubl_graph.io.tables import did_you_mean, shortened
from ubl_graph.records import SINGULAR

#: A quaternion whose length differs from 1 by more was not rounded, but is something else.
QUATERNION_TOLERANCE = 0.01
_POSE_NAME = re.compile(r"[A-Za-z]+[0-9]+")


@dataclass(frozen=True)
class Layout:
    """What the lines of one token hold.

    Attributes
    ----------
    kind : str
        Where a `PyfgGraph` keeps them.
    dimension : 2, 3 or None
        Of the space; None for both.
    stamped : bool
        Whether a stamp follows the token.
    names : tuple of str
        What the one or two names are: "pose", "landmark" or "vertex", which is either.
    values : tuple of str
        The numbers after the names.
    noise : tuple of str
        What the covariance is over; its upper triangle, row by row, ends the line.
    """

    kind: str
    dimension: Literal[2, 3] | None
    stamped: bool
    names: tuple[str, ...]
    values: tuple[str, ...]
    noise: tuple[str, ...] = ()

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the words after the token, in order."""
        pairs = [(a, b) for i, a in enumerate(self.noise) for b in self.noise[i:]]
        return (
            *(("t",) if self.stamped else ()),
            *self.names,
            *self.values,
            *(f"variance of {a}" if a == b else f"covariance of {a} and {b}" for a, b in pairs),
        )


_SE2, _SE3 = ("x", "y", "theta"), ("x", "y", "z", "qx", "qy", "qz", "qw")
_SE3_NOISE = ("x", "y", "z", "about x", "about y", "about z")
_XY, _XYZ = ("x", "y"), ("x", "y", "z")
_POSE, _LANDMARK = ("pose",), ("landmark",)

TOKENS: dict[str, Layout] = {
    "VERTEX_SE2": Layout("poses", 2, True, _POSE, _SE2),
    "VERTEX_SE3:QUAT": Layout("poses", 3, True, _POSE, _SE3),
    "VERTEX_XY": Layout("landmarks", 2, False, _LANDMARK, _XY),
    "VERTEX_XYZ": Layout("landmarks", 3, False, _LANDMARK, _XYZ),
    "VERTEX_SE2:PRIOR": Layout("pose_priors", 2, True, _POSE, _SE2, _SE2),
    "VERTEX_SE3:QUAT:PRIOR": Layout("pose_priors", 3, True, _POSE, _SE3, _SE3_NOISE),
    "VERTEX_XY:PRIOR": Layout("landmark_priors", 2, True, _LANDMARK, _XY, _XY),
    "VERTEX_XYZ:PRIOR": Layout("landmark_priors", 3, True, _LANDMARK, _XYZ, _XYZ),
    "EDGE_SE2": Layout("pose_edges", 2, True, ("pose", "pose"), _SE2, _SE2),
    "EDGE_SE3:QUAT": Layout("pose_edges", 3, True, ("pose", "pose"), _SE3, _SE3_NOISE),
    "EDGE_SE2_XY": Layout("landmark_edges", 2, True, ("pose", "landmark"), _XY, _XY),
    "EDGE_SE3_XYZ": Layout("landmark_edges", 3, True, ("pose", "landmark"), _XYZ, _XYZ),
    "EDGE_RANGE": Layout("ranges", None, True, ("vertex", "vertex"), ("range",), ("range",)),
}


@dataclass(frozen=True, eq=False)
class Rows:
    """Lines of one kind, as columns.

    Attributes
    ----------
    name : array of str, shape (M, 1) or (M, 2)
        The vertices that a line names.
    values : array, shape (M, V)
        The numbers as they stand in the file, but for stamp and noise.
    covariance : array, shape (M, C, C)
        m^2 and rad^2; shape (M, 0, 0) for vertices, which have none.
    t : array, shape (M,)
        Stamps, s; zeros for landmarks, which have none.
    line : array, shape (M,)
        Line of the file, from 1; 0 for what was made in Python. Not compared.
    """

    name: Any = ()
    values: Any = ()
    covariance: Any = None
    t: Any = 0.0
    line: Any = 0

    def __post_init__(self) -> None:
        names = np.array(self.name, dtype=np.str_)
        size = len(names)
        noise = np.zeros((size, 0, 0)) if self.covariance is None else self.covariance
        columns: dict[str, Any] = {
            # One name a line may be given without a second axis.
            "name": frozen(names[:, None] if names.ndim == 1 else names, np.str_),
            "values": frozen(self.values),
            "covariance": frozen(noise),
            "t": frozen(np.broadcast_to(np.asarray(self.t, dtype=np.float64), (size,))),
            "line": frozen(np.broadcast_to(self.line, (size,)), np.int64),
        }
        for column, array in columns.items():
            object.__setattr__(self, column, array)

    def __len__(self) -> int:
        return len(self.name)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Rows):
            return NotImplemented
        return all(
            np.array_equal(getattr(self, name), getattr(other, name))
            for name in ("name", "values", "covariance", "t")
        )

    __hash__ = None  # pyright: ignore[reportAssignmentType] - arrays do not hash

    @property
    def first(self) -> list[str]:
        """The first, or only, name of each line."""
        return self.name[:, 0].tolist()

    @property
    def second(self) -> list[str]:
        """The second name of each line."""
        return self.name[:, 1].tolist()


class PointRows(Rows):
    """Landmarks, priors on them, and landmarks seen from poses."""

    @property
    def position(self) -> FloatArray:
        """X, y (and z), m, shape (M, 2) or (M, 3)."""
        return self.values


class PoseRows(Rows):
    """Poses, priors on them, and poses seen from poses."""

    @property
    def position(self) -> FloatArray:
        """X, y (and z), m, shape (M, 2) or (M, 3)."""
        return self.values[:, : 3 if self._spatial else 2]

    @property
    def rotation_vector(self) -> FloatArray:
        """Rotation about x, y and z, rad, shape (M, 3); quaternions are normalised for it."""
        if self._spatial:
            # scipy reads no memory that is read-only.
            return Rotation.from_quat(self.values[:, 3:].copy()).as_rotvec()
        return np.stack([np.zeros(len(self)), np.zeros(len(self)), self.values[:, 2]], axis=1)

    @property
    def _spatial(self) -> bool:
        return self.values.shape[1] == len(_SE3)


class RangeRows(Rows):
    """Distances between two vertices."""

    @property
    def distance(self) -> FloatArray:
        """Metres, shape (M,)."""
        return self.values[:, 0]

    @property
    def variance(self) -> FloatArray:
        """Square metres, shape (M,)."""
        return self.covariance[:, 0, 0]


#: The class of each kind, by the graph's attributes.
CLASSES: dict[str, type[Rows]] = {
    kind: RangeRows if kind == "ranges" else PoseRows if kind.startswith("pose") else PointRows
    for kind in dict.fromkeys(layout.kind for layout in TOKENS.values())
}


def _empty(layout: Layout) -> Rows:
    names, values, noise = len(layout.names), len(layout.values), len(layout.noise)
    return CLASSES[layout.kind](
        np.zeros((0, names), dtype=np.str_), np.zeros((0, values)), np.zeros((0, noise, noise))
    )


@dataclass(frozen=True, kw_only=True)
class PyfgGraph:
    """All that a PyFG file says, in its own axes and units (metres, radians, seconds).

    Attributes
    ----------
    dimension : 2 or 3
        SE(2) and points of the plane, or SE(3) and points of space.
    poses : PoseRows
        Initial guesses or ground truth: a file does not say which. Values (x, y, theta) or
        (x, y, z, qx, qy, qz, qw); quaternions as they stand, not normalised.
    landmarks : PointRows
        Values (x, y) or (x, y, z).
    pose_priors : PoseRows
        Values as for poses; covariance over (x, y, theta), or (x, y, z, and the rotations about
        them).
    landmark_priors : PointRows
    pose_edges : PoseRows
        The second pose as seen from the first: odometry and loop closures.
    landmark_edges : PointRows
        The landmark as seen from the pose.
    ranges : RangeRows
        Between any two vertices.
    file : str, optional
        Where it was read; named in errors. Not compared.

    Raises
    ------
    DataError
        Where a value is not finite, a covariance not symmetric and positive definite, a quaternion
        not of length 1, a range negative, a vertex there twice, or a name unknown or that of
        another kind of vertex.
    """

    dimension: Literal[2, 3]
    poses: PoseRows = field(default_factory=PoseRows)
    landmarks: PointRows = field(default_factory=PointRows)
    pose_priors: PoseRows = field(default_factory=PoseRows)
    landmark_priors: PointRows = field(default_factory=PointRows)
    pose_edges: PoseRows = field(default_factory=PoseRows)
    landmark_edges: PointRows = field(default_factory=PointRows)
    ranges: RangeRows = field(default_factory=RangeRows)
    file: str | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        if self.dimension not in (2, 3):
            raise DataError(f"dimension {self.dimension} is neither 2 nor 3", file=self.file)
        for _, layout in self.layouts():
            kind = layout.kind
            if len(getattr(self, kind)) == 0:
                object.__setattr__(self, kind, _empty(layout))
            self._check_numbers(kind, layout)
        self._check_vertices()
        for _, layout in self.layouts():
            if layout.kind not in ("poses", "landmarks"):
                self._check_names(layout.kind, layout)

    def layouts(self) -> Iterator[tuple[str, Layout]]:
        """Tokens of this dimension, each with what its lines hold; one for each kind."""
        for token, layout in TOKENS.items():
            if layout.dimension in (self.dimension, None):
                yield token, layout

    @property
    def robots(self) -> tuple[str, ...]:
        """Letters before the numbers of the poses' names, in order of appearance."""
        return tuple(dict.fromkeys(name.rstrip("0123456789") for name in self.poses.first))

    def error(
        self, kind: str, index: int, problem: str, remedy: str = "", field: str | None = None
    ) -> DataError:
        """Build the error that names line `index` (from 0) of a kind, by file and line if known."""
        line = int(getattr(self, kind).line[index])
        if line:
            return DataError(problem, remedy, file=self.file, line=line, field=field)
        return DataError(problem, remedy, file=self.file, record=f"{kind}[{index}]", field=field)

    def _check_numbers(self, kind: str, layout: Layout) -> None:
        rows: Rows = getattr(self, kind)
        size, noise = len(rows), len(layout.noise)
        shapes = {
            "name": (size, len(layout.names)),
            "values": (size, len(layout.values)),
            "covariance": (size, noise, noise),
        }
        for column, shape in shapes.items():
            found = getattr(rows, column).shape
            if found != shape:
                raise DataError(
                    f"shape {found}, not {shape}", record=kind, field=column, file=self.file
                )
        self._forbid(~np.isfinite(rows.t), kind, "the stamp is not a finite number")
        for j, column in enumerate(layout.values):
            bad = ~np.isfinite(rows.values[:, j])
            self._forbid(bad, kind, "not a finite number", "drop or mend it", column)
        if noise:
            self._check_covariance(kind, layout)
        if kind == "ranges":
            self._forbid(
                rows.values[:, 0] < 0.0, kind, "a negative range", "drop or mend it", "range"
            )
        if not layout.stamped:
            self._forbid(rows.t != 0.0, kind, "a landmark has no stamp", "leave t out")
        if isinstance(rows, PoseRows) and self.dimension == 3:
            with np.errstate(over="ignore"):
                length = np.linalg.norm(rows.values[:, 3:], axis=1)
            self._forbid(
                np.abs(length - 1.0) > QUATERNION_TOLERANCE,
                kind,
                "the quaternion is not of length 1",
                "the order is x, y, z, qx, qy, qz, qw",
            )

    def _check_covariance(self, kind: str, layout: Layout) -> None:
        covariance: FloatArray = getattr(self, kind).covariance
        finite = np.isfinite(covariance).all(axis=(1, 2))
        self._forbid(~finite, kind, "a covariance is not a finite number", "drop or mend it")
        variances = np.diagonal(covariance, axis1=1, axis2=2)
        for j, name in enumerate(layout.noise):
            self._forbid(
                variances[:, j] <= 0.0,
                kind,
                "not more than zero",
                "the file's numbers are variances",
                f"variance of {name}",
            )
        # Of the correlations: metres and radians are of no common size.
        sigmas = np.sqrt(variances)
        with np.errstate(over="ignore"):
            correlations = covariance / sigmas[:, :, None] / sigmas[:, None, :]
        skew = (covariance != np.swapaxes(covariance, 1, 2)).any(axis=(1, 2))
        self._forbid(
            skew | (np.linalg.eigvalsh(correlations.clip(-2.0, 2.0))[:, 0] <= SINGULAR),
            kind,
            "the covariance is not symmetric and positive definite",
            "a line ends with its upper triangle, row by row",
        )

    def _forbid(
        self,
        bad: BoolArray | np.bool_,
        kind: str,
        problem: str,
        remedy: str = "drop or mend it",
        field: str | None = None,
    ) -> None:
        if bad.any():
            raise self.error(kind, int(np.argmax(bad)), problem, remedy, field)

    def _check_vertices(self) -> None:
        seen: dict[str, tuple[str, int]] = {}
        for kind in ("poses", "landmarks"):
            for i, name in enumerate(getattr(self, kind).first):
                if kind == "poses" and not _POSE_NAME.fullmatch(name):
                    problem = f"{shortened(name)} is no name of a pose"
                    raise self.error(kind, i, problem, "letters, then a number, as in A0", "pose")
                if name.split() != [name] or not name.isprintable():
                    raise self.error(
                        kind, i, f"{shortened(name)} is no name", "as in L0", "landmark"
                    )
                if name in seen:
                    other, j = seen[name]
                    before = int(getattr(self, other).line[j])
                    where = f" (before on line {before})" if before else ""
                    raise self.error(
                        kind, i, f"the vertex '{name}' is there twice{where}", "keep one of the two"
                    )
                seen[name] = kind, i

    def _check_names(self, kind: str, layout: Layout) -> None:
        known = {"pose": set(self.poses.first), "landmark": set(self.landmarks.first)}
        known["vertex"] = known["pose"] | known["landmark"]
        for i, names in enumerate(getattr(self, kind).name.tolist()):
            for name, wanted in zip(names, layout.names, strict=True):
                if name in known[wanted]:
                    continue
                if name in known["vertex"]:
                    other = "landmark" if wanted == "pose" else "pose"
                    raise self.error(
                        kind,
                        i,
                        f"'{name}' is a {other}, not a {wanted}",
                        f"the line names {', '.join(layout.names)}",
                    )
                problem = f"there is no vertex {shortened(name)}"
                kinds = "vertices" if wanted == "vertex" else f"{wanted} vertices"
                remedy = did_you_mean(name, sorted(known[wanted]), kinds)
                raise self.error(kind, i, problem, remedy, wanted)
            if len(set(names)) < len(names):
                raise self.error(kind, i, f"the edge joins '{names[0]}' to itself", "drop it")
