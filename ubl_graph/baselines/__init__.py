"""What others do with the same data: baselines to compare the smoother with."""

from ubl_graph.baselines.cao2017 import cao2017
from ubl_graph.baselines.dead_reckoning import dead_reckoning
from ubl_graph.baselines.formation import FormationData, FormationEstimate, own_rmse
from ubl_graph.baselines.multilateration import multilaterate, target_rmse
from ubl_graph.baselines.xue2024 import xue2024
from ubl_graph.baselines.zhao_ekf import zhao_ekf

__all__ = [
    "FormationData",
    "FormationEstimate",
    "cao2017",
    "dead_reckoning",
    "multilaterate",
    "own_rmse",
    "target_rmse",
    "xue2024",
    "zhao_ekf",
]
