"""ubl_graph: underwater beacon localisation as a factor graph.

>>> import ubl_graph
>>> mission = ubl_graph.load_mission("dive.toml")        # doctest: +SKIP
>>> result = ubl_graph.smooth(mission)                   # doctest: +SKIP
>>> result.trajectory.at([10.0, 20.0]).position          # doctest: +SKIP

What a name needs is imported when the name is first used: `import ubl_graph` is cheap.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ubl_graph.acoustics import SoundSpeedProfile
    from ubl_graph.beacon import Beacon
    from ubl_graph.consistency import assess
    from ubl_graph.cooperative.fleet import Fleet, Member, Target
    from ubl_graph.cooperative.result import FleetResult
    from ubl_graph.cooperative.smoother import smooth_fleet
    from ubl_graph.errors import (
        ConfigurationError,
        DataError,
        NoDirectRayError,
        SolverError,
        TimeError,
        UblGraphError,
        UnobservableError,
    )
    from ubl_graph.evaluation import Errors, evaluate
    from ubl_graph.frames import GeodeticOrigin, LeverArm
    from ubl_graph.io.fleet_file import load_fleet
    from ubl_graph.io.mission_file import load_mission, load_setup
    from ubl_graph.measurements import (
        AngularRate,
        Attitude,
        Depth,
        Heading,
        Odometry,
        OneWayRange,
        PositionFix,
        SlantRange,
        TwoWayRange,
        Velocity,
    )
    from ubl_graph.mission import Mission, Reference, Segment, Setup, Start, Vehicle
    from ubl_graph.online.estimator import FixedLagEstimator
    from ubl_graph.online.fleet_estimator import FleetEstimator
    from ubl_graph.online.outputs import Estimate, Event, Outcome
    from ubl_graph.options import Options
    from ubl_graph.result import Result
    from ubl_graph.smoother import smooth
    from ubl_graph.survey import SurveyOptions, SurveyResult, calibrate
    from ubl_graph.trajectory import Trajectory
    from ubl_graph.verdict import Consistency

__version__ = "0.1.0"

_HOME = {
    "SoundSpeedProfile": "acoustics",
    "Fleet": "cooperative.fleet",
    "FleetResult": "cooperative.result",
    "Member": "cooperative.fleet",
    "Target": "cooperative.fleet",
    "smooth_fleet": "cooperative.smoother",
    "ConfigurationError": "errors",
    "DataError": "errors",
    "NoDirectRayError": "errors",
    "SolverError": "errors",
    "TimeError": "errors",
    "UblGraphError": "errors",
    "UnobservableError": "errors",
    "Errors": "evaluation",
    "evaluate": "evaluation",
    "GeodeticOrigin": "frames",
    "LeverArm": "frames",
    "Estimate": "online.outputs",
    "Event": "online.outputs",
    "FixedLagEstimator": "online.estimator",
    "FleetEstimator": "online.fleet_estimator",
    "Outcome": "online.outputs",
    "load_fleet": "io.fleet_file",
    "load_mission": "io.mission_file",
    "load_setup": "io.mission_file",
    "AngularRate": "measurements",
    "Attitude": "measurements",
    "Beacon": "beacon",
    "Depth": "measurements",
    "Heading": "measurements",
    "Odometry": "measurements",
    "OneWayRange": "measurements",
    "PositionFix": "measurements",
    "SlantRange": "measurements",
    "TwoWayRange": "measurements",
    "Velocity": "measurements",
    "Mission": "mission",
    "Reference": "mission",
    "Segment": "mission",
    "Setup": "mission",
    "Start": "mission",
    "Vehicle": "mission",
    "Options": "options",
    "Result": "result",
    "smooth": "smoother",
    "SurveyOptions": "survey",
    "SurveyResult": "survey",
    "calibrate": "survey",
    "assess": "consistency",
    "Consistency": "verdict",
    "Trajectory": "trajectory",
}

__all__ = [  # noqa: RUF022 - by subject, as in `_HOME`
    "ConfigurationError",
    "DataError",
    "NoDirectRayError",
    "SolverError",
    "TimeError",
    "UblGraphError",
    "UnobservableError",
    "AngularRate",
    "Attitude",
    "Beacon",
    "Consistency",
    "Depth",
    "Errors",
    "Estimate",
    "Event",
    "FixedLagEstimator",
    "Fleet",
    "FleetEstimator",
    "FleetResult",
    "GeodeticOrigin",
    "Heading",
    "LeverArm",
    "Member",
    "Mission",
    "Odometry",
    "OneWayRange",
    "Options",
    "Outcome",
    "PositionFix",
    "Reference",
    "Result",
    "Segment",
    "Setup",
    "SlantRange",
    "SoundSpeedProfile",
    "Start",
    "SurveyOptions",
    "SurveyResult",
    "Target",
    "Trajectory",
    "TwoWayRange",
    "Vehicle",
    "Velocity",
    "__version__",
    "assess",
    "calibrate",
    "evaluate",
    "load_fleet",
    "load_mission",
    "load_setup",
    "smooth",
    "smooth_fleet",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'ubl_graph' has no attribute '{name}'")
    return getattr(import_module(f"ubl_graph.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
