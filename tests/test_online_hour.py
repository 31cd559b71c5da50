"""An hour at sea: what the estimator holds, and what it says, does not change with time."""

import gc
import os
from pathlib import Path

import numpy as np
import pytest
from online import Run, entry_of, records_of, survey

STATUS = Path("/proc/self/statm")


def resident_mb() -> float:
    gc.collect()
    return int(STATUS.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


@pytest.mark.slow
@pytest.mark.skipif(not STATUS.exists(), reason="resident memory is read from /proc")
def test_memory_and_status_over_an_hour():
    from ubl_graph import FixedLagEstimator

    # DVL and attitude five times a second, depth and a ping every second.
    mission, truth = survey(5, lines=12, length=400.0, ping=1.0)
    records = records_of(mission.segments[0])
    estimator = FixedLagEstimator.of(mission)
    result, memory, held = Run(estimator), [], []
    every = len(records) // 12
    for i, record in enumerate(records):
        outcome = estimator.add(record)
        if outcome.accepted and entry_of(record).kind == "two_way_range":
            result.estimates.append(estimator.estimate())
        if i % every == every - 1:
            memory.append(resident_mb())
            held.append(estimator.health()["window"]["records"])
    assert truth.span[1] > 3400.0
    assert max(memory[3:]) - memory[2] < 10.0
    assert max(held[3:]) < 1.1 * held[2]
    assert estimator.health()["rebuilds"] == 0
    assert result.share("ok", 80.0) > 0.98
    # Errors of hours are few independent ones: wide bounds.
    _, distances = result.errors(truth, 80.0)
    assert 0.3 < np.mean(distances) < 5.0
