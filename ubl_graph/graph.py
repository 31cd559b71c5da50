"""From a mission to a Problem: nodes, unknowns and blocks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ubl_graph.attitude import AttitudeTrack
from ubl_graph.builder import Builder, SegmentModel, heading_walks, shared_states
from ubl_graph.factors.block import Block
from ubl_graph.factors.loss import RobustLoss
from ubl_graph.factors.odometry import Preintegration
from ubl_graph.layout import Chain, Layout
from ubl_graph.mission import Mission, Segment
from ubl_graph.nodes import grid_times, node_times, order_of
from ubl_graph.options import Options
from ubl_graph.pose_builder import PoseBuilder
from ubl_graph.pose_nodes import model_poses
from ubl_graph.pose_states import held_up, lasting_heading_error, pose_states
from ubl_graph.problem import Problem


def model_segment(segment: Segment, options: Options) -> SegmentModel:
    """Derive nodes, attitude and preintegrated odometry of a segment."""
    if options.node != "point":
        return model_poses(segment, options)
    attitude = AttitudeTrack(segment.attitude)
    by_reference: dict[str, Preintegration] = {}
    psd = options.number("acceleration_psd")
    if segment.velocity is not None:
        for reference in ("bottom", "water"):
            rows = segment.velocity[segment.velocity.reference == reference]
            if len(rows) > 1:
                by_reference[reference] = Preintegration(rows, attitude, psd)
    odometry = tuple(by_reference.values())
    if options.node_spacing is None:
        times = node_times(segment, options, odometry)
    else:
        times = grid_times(segment, options.node_spacing, odometry)
    return SegmentModel(
        segment, times, attitude, by_reference.get("bottom"), by_reference.get("water")
    )


def build_problem(
    mission: Mission, models: Sequence[SegmentModel], layout: Layout | None = None
) -> Problem:
    """The least-squares problem of some segments of a mission, all unknowns in one layout.

    Parameters
    ----------
    mission : Mission
        Whose segments.
    models : sequence of SegmentModel
        Of these segments.
    layout : Layout, optional
        Of `layout_of`, where it is not what the segments alone ask for.
    """
    layout = layout_of(mission, models) if layout is None else layout
    builder = builder_of(mission, models, layout)
    blocks: list[Block] = []
    for chain, model in zip(layout.chains, models, strict=True):
        blocks += builder.segment_blocks(chain, model)
    blocks += builder.shared_priors()
    blocks = [b for b in blocks if len(b.columns)]
    options = mission.options
    psd = (options.horizontal_psd, options.vertical_psd)
    return Problem(layout, tuple(blocks), RobustLoss(options.loss), psd)


def builder_of(mission: Mission, models: Sequence[SegmentModel], layout: Layout) -> Builder:
    """What makes the blocks of some segments of a mission in a layout."""
    kind = Builder if layout.node == "point" else PoseBuilder
    return kind(mission.setup, layout, _lasting(models))


def shares_unknowns(mission: Mission, models: Sequence[SegmentModel]) -> bool:
    """Whether segments have unknowns in common, and so belong into one problem."""
    return bool(layout_of(mission, models).shared)


def layout_of(mission: Mission, models: Sequence[SegmentModel], *, clocked: bool = False) -> Layout:
    """The unknowns of some segments of a mission.

    Parameters
    ----------
    mission, models
        As `build_problem` takes them.
    clocked : bool
        Whether the vehicle's clock is an unknown although it hears no beacon: others hear it.
    """
    options = mission.options
    chains: list[Chain] = []
    first = 0
    for model in models:
        chains.append(Chain(model.segment.name, first, model.t))
        first += len(model.t)
    records = [model.segment.records() for model in models]
    has_ranges = any({"two_way_range", "one_way_range", "slant_range"} & r.keys() for r in records)
    slow: list[tuple[str, int]] = []
    if options.estimate_sound_speed and has_ranges:
        slow.append(("sound_speed", 1))
    if clocked or any("one_way_range" in r for r in records):
        slow += [("clock_offset", 1), ("clock_drift", 1)]
    if any(model.water is not None for model in models):
        slow.append(("current", 2))
    odometry = any(model.bottom is not None or model.water is not None for model in models)
    lasting = _lasting(models)
    if options.node != "point":
        kinds = set[str]().union(*records)
        travelling, shared = pose_states(mission.setup, kinds, lasting)
        ups = [held_up(mission.setup, model.segment, model.t) for model in models]
        return Layout(
            tuple(chains),
            2,
            (*slow, *travelling),
            shared,
            options.node,
            all(model.still for model in models),
            np.concatenate(ups),
        )
    if odometry and heading_walks(options, lasting):
        slow.append(("heading_bias", 1))
    shared = shared_states(mission.setup, lasting if odometry else None)
    return Layout(tuple(chains), order_of(options), tuple(slow), shared)


def _lasting(models: Sequence[SegmentModel]) -> float:
    """Standard deviation of the heading references' lasting error, rad."""
    return lasting_heading_error([m.segment for m in models])
