"""What others do with the same data: baselines to compare the smoother with."""

from ubl_graph.baselines.dead_reckoning import dead_reckoning

__all__ = ["dead_reckoning"]
