"""Calibrated covariances on real pings: SAGA.1903's straight lines against the ship's GNSS."""

from dataclasses import replace

import numpy as np
import pytest
from test_saga import mission_file

from ubl_graph import load_mission, smooth
from ubl_graph.evaluation import Errors, evaluate


@pytest.mark.parametrize("sigma", [None, 5e-5], ids=["defaults", "half the default sigma"])
def test_calibrated_covariances_on_the_straight_lines(tmp_path, saga, sigma):
    """With 5e-5 s, and motion noise to match, the prototype's covariances were too small."""
    mission = load_mission(mission_file(tmp_path, saga))
    options = replace(mission.options, covariance="calibrated")
    if sigma is not None:
        options = replace(options, acceleration_psd=1e-3, sound_speed_walk=3e-6)
        segments = [
            replace(s, two_way_range=replace(s.two_way_range, sigma=sigma))
            for s in mission.segments
        ]
        mission = replace(mission, segments=tuple(segments))
    result = smooth(replace(mission, options=options))
    found = result.consistency
    assert found is not None and found.applied
    errors = Errors.joined(evaluate(result).values())
    assert len(errors.nees) == 1886
    assert 1.2 < errors.nees.mean() < 3.5
    assert 0.88 < errors.covered.mean() < 0.98
    formal = errors.nees.mean() * found.factor**2
    if sigma is None:
        assert found.agrees
    else:
        assert formal > 3.0 and found.factor > 1.1 and not found.agrees
    # Residuals are far smaller than their sigmas: rescaling by them would go the wrong way.
    residuals = result.residuals
    assert np.median(np.abs(residuals.residual / residuals.sigma)) < 0.4
    assert found.blocks > 100
