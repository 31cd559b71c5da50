"""Several vehicles and targets in one graph, joined by the ranges between them."""

from ubl_graph.cooperative.fleet import Fleet, Member, Target
from ubl_graph.cooperative.result import FleetResiduals, FleetResult, TargetEstimate
from ubl_graph.cooperative.smoother import smooth_fleet

__all__ = [
    "Fleet",
    "FleetResiduals",
    "FleetResult",
    "Member",
    "Target",
    "TargetEstimate",
    "smooth_fleet",
]
