"""Simulation: true tracks, sensors that look at them, and missions made of both.

>>> from ubl_graph.sim import straight_pass
>>> mission, truth = straight_pass(seed=1)
>>> mission.beacon_names
('B1', 'B2', 'B3', 'B4')
>>> truth.position([0.0, 60.0]).tolist()
[[-200.0, -40.0, -60.0], [-110.0, -10.0, -60.0]]
"""

from ubl_graph.sim.cao2017 import SeaTrial, cao_pass, cao_sea_trial
from ubl_graph.sim.fleets import random_fleet
from ubl_graph.sim.missions import (
    DRIFTING,
    PLANAR,
    demo_survey,
    drifting_heading,
    planar_vehicle,
    straight_pass,
)
from ubl_graph.sim.pose_sensors import compass, gyro, odometer
from ubl_graph.sim.sensors import (
    Clock,
    DvlErrors,
    Sea,
    ahrs,
    dvl,
    fixes,
    one_way_pings,
    pressure,
    slant_ranges,
    two_way_pings,
)
from ubl_graph.sim.tracks import (
    Truth,
    constant_acceleration,
    constant_velocity,
    lawn_mower,
    sampled,
    wander,
)
from ubl_graph.sim.xue2024 import munk_profile, xue_pass, xue_track, xue_wandering
from ubl_graph.sim.zhao import ZhaoRuns, ZhaoSettings, map_grid, zhao_map, zhao_runs, zhao_track
from ubl_graph.sim.zhao_fleet import ZHAO_OPTIONS, zhao_fleet

__all__ = [
    "DRIFTING",
    "PLANAR",
    "ZHAO_OPTIONS",
    "Clock",
    "DvlErrors",
    "Sea",
    "SeaTrial",
    "Truth",
    "ZhaoRuns",
    "ZhaoSettings",
    "ahrs",
    "cao_pass",
    "cao_sea_trial",
    "compass",
    "constant_acceleration",
    "constant_velocity",
    "demo_survey",
    "drifting_heading",
    "dvl",
    "fixes",
    "gyro",
    "lawn_mower",
    "map_grid",
    "munk_profile",
    "odometer",
    "one_way_pings",
    "planar_vehicle",
    "pressure",
    "random_fleet",
    "sampled",
    "slant_ranges",
    "straight_pass",
    "two_way_pings",
    "wander",
    "xue_pass",
    "xue_track",
    "xue_wandering",
    "zhao_fleet",
    "zhao_map",
    "zhao_runs",
    "zhao_track",
]
