"""The measuring script for online fleets runs and says what it should."""

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent


def speed(*arguments):
    command = [sys.executable, str(ROOT / "scripts" / "fleet_speed.py"), *arguments]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    return subprocess.run(command, capture_output=True, text=True, env=environment)


def test_it_times_a_mission_beside_gtsam(tmp_path):
    out = tmp_path / "speed.json"
    done = speed("--vehicles", "3", "--duration", "90", "--rival", "batch", "--json", str(out))
    assert done.returncode == 0, done.stderr
    content = json.loads(out.read_text())
    assert content["updates"] == 16
    assert 0.0 < content["update_ms"]["p50"] <= content["update_ms"]["p99"]
    assert content["rival_over_ours_p50"] > 0.0
    assert content["rmse_m"] < 20.0
    assert "update_ms" in done.stdout


def test_a_rival_goes_with_slant_ranges_alone():
    done = speed("--kind", "two_way_range", "--rival", "batch")
    assert done.returncode == 2
    assert "slant ranges alone" in done.stderr
