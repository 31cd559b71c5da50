"""What others do with the same data: baselines to compare the smoother with."""

from ubl_graph.baselines.cao2017 import cao2017
from ubl_graph.baselines.dead_reckoning import dead_reckoning
from ubl_graph.baselines.xue2024 import xue2024

__all__ = ["cao2017", "dead_reckoning", "xue2024"]
