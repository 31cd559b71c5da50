"""What the unknowns of a window are: nodes on a regular grid, slow states, what all nodes share."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ubl_graph.arrays import FloatArray
from ubl_graph.builder import Builder, heading_walks, shared_states
from ubl_graph.layout import Chain, Layout
from ubl_graph.mission import Setup
from ubl_graph.nodes import order_of
from ubl_graph.pose_builder import PoseBuilder
from ubl_graph.pose_states import pose_states
from ubl_graph.trajectory import Order


@dataclass(frozen=True)
class Break:
    """Where the vehicle may have jumped: standard deviations of the step between two nodes.

    Attributes
    ----------
    position, velocity, acceleration : float
        m, m/s, m/s^2.
    rotation, rate : float
        Of poses, rad and rad/s.
    """

    position: float
    velocity: float = 1.0
    acceleration: float = 0.1
    rotation: float = 1.0
    rate: float = 0.1


#: The step that a clock set back may hide: seconds of way, m, and speed, m/s.
CLOCK_STEP = Break(5.0, 0.5)


@dataclass(frozen=True)
class Frame:
    """What the unknowns of a window are, wherever it stands.

    Attributes
    ----------
    setup : Setup
        Beacons, vehicle, options.
    spacing : float
        Of the grid of nodes, s.
    order : 2 or 3
        Of the motion prior.
    slow, shared : tuple of (str, int)
        Names and sizes of the slow states at the nodes, and of what all nodes share.
    lasting : float
        Standard deviation of the heading reference's lasting error, rad.
    gap : float
        Velocities farther apart than this do not join, s.
    """

    setup: Setup
    spacing: float
    order: Order
    slow: tuple[tuple[str, int], ...]
    shared: tuple[tuple[str, int], ...]
    lasting: float
    gap: float

    @property
    def is_posed(self) -> bool:
        """Whether nodes are poses, whose rows are linearised where the window stands."""
        return self.setup.options.node != "point"

    @property
    def is_planar(self) -> bool:
        """Whether the up of nodes is held."""
        return self.setup.options.node == "pose2"

    @cached_property
    def node(self) -> Layout:
        """The layout of a single node."""
        return self.layout(np.zeros(1))

    @cached_property
    def width(self) -> int:
        """Columns of a node."""
        return self.node.node_width

    @cached_property
    def border(self) -> int:
        """Columns that all nodes share."""
        return sum(size for _, size in self.shared)

    @property
    def interval(self) -> int:
        """Columns that an interval's rows touch: two nodes, and what they share."""
        return 2 * self.width + self.border

    @property
    def height(self) -> int:
        """Rows of an interval: one more for poses, the part of the residual that nothing changes.

        It varies with where they are linearised; costs are compared from place to place.
        """
        return self.interval + self.is_posed

    def layout(self, times: FloatArray, up: FloatArray | None = None) -> Layout:
        """The layout of nodes at some times; `up`: where planar ones are held, m."""
        return Layout(
            (Chain("", 0, times),),
            self.order,
            self.slow,
            self.shared,
            self.setup.options.node,
            held_up=up if self.is_planar else None,
        )

    def builder(self, layout: Layout) -> Builder:
        """What makes blocks over a layout."""
        if self.is_posed:
            return PoseBuilder(self._laid, layout, self.lasting)
        return Builder(self.setup, layout, self.lasting)

    @cached_property
    def _laid(self) -> Setup:
        """The setup for odometry laid onto the grid: its covariances hold the options' share."""
        return replace(self.setup, options=replace(self.setup.options, odometry_noise="given"))


def frame_of(
    setup: Setup, kinds: Iterable[str], lasting: float, gap: float, spacing: float
) -> Frame:
    """The unknowns that the kinds of records seen so far ask for.

    Parameters
    ----------
    setup : Setup
        Options and beacons.
    kinds : iterable of str
        Record kinds; "water" and "bottom" for velocities.
    lasting : float
        Standard deviation of the heading reference's lasting error, rad.
    gap : float
        Longest gap that velocities bridge, s.
    spacing : float
        Of the nodes, s.
    """
    seen = set(kinds)
    options = setup.options
    slow: list[tuple[str, int]] = []
    if options.estimate_sound_speed and setup.beacons:
        slow.append(("sound_speed", 1))
    if "one_way_range" in seen:
        slow += [("clock_offset", 1), ("clock_drift", 1)]
    if "water" in seen:
        slow.append(("current", 2))
    velocity = bool({"water", "bottom"} & seen)
    if options.node != "point":
        known = seen | ({"velocity"} if velocity else set[str]())
        travelling, shared = pose_states(setup, known, lasting)
        return Frame(setup, spacing, 2, (*slow, *travelling), shared, lasting, gap)
    if velocity and heading_walks(options, lasting):
        slow.append(("heading_bias", 1))
    shared = shared_states(setup, lasting if velocity else None)
    return Frame(setup, spacing, order_of(options), tuple(slow), shared, lasting, gap)
