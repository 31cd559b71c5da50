"""Beacon surveys: where beacons are, from a vehicle whose track is known.

`calibrate` takes a mission and gives a `SurveyResult`; docs/survey.md says what it assumes.
"""

from ubl_graph.survey.calibrate import calibrate
from ubl_graph.survey.model import Noise, SurveyOptions
from ubl_graph.survey.result import BeaconCheck, LeaveOneOut, SurveyResult

__all__ = ["BeaconCheck", "LeaveOneOut", "Noise", "SurveyOptions", "SurveyResult", "calibrate"]
