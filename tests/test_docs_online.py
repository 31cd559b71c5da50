"""The examples of docs/online.md give what the page says."""

import doctest
import re
import subprocess
import sys
from pathlib import Path

import pytest

PAGE = (Path(__file__).parent.parent / "docs" / "online.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
PROGRAM = BLOCKS[-1]
PRINTED = re.findall(r"^```text\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)[-1]


def test_examples():
    talk = "\n".join(block for block in BLOCKS if block.startswith(">>>"))
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    test = doctest.DocTestParser().get_doctest(talk, {}, "online.md", "online.md", 0)
    assert len(test.examples) > 10
    assert doctest.DocTestRunner(optionflags=flags).run(test).failed == 0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("vehicle")


@pytest.fixture(scope="module")
def lines(folder):
    """What the control loop prints, run as it stands on the page."""
    file = folder / "loop.py"
    file.write_text(PROGRAM, encoding="utf-8")
    command = [sys.executable, "-W", "error", file.name]
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout.splitlines()


def test_the_control_loop_is_short():
    assert len(PROGRAM.splitlines()) < 70


def test_the_control_loop_goes_through_all_statuses_and_comes_back(lines, folder):
    told = [re.fullmatch(r"(\S+) s (\w+): (\S+) m/s at (\d+) m", line) for line in lines]
    statuses = [m[2] for m in told if m]
    assert statuses == [
        *("degraded", "ok"),
        *("degraded", "coasting", "lost"),
        *("degraded", "ok"),
    ]
    orders = {m[2]: (float(m[3]), int(m[4])) for m in told if m}
    assert orders["ok"] == (1.5, 30)
    assert orders["coasting"] == (1.5, 30)
    assert orders["lost"] == (0.0, 0)
    when = {m[2]: float(m[1]) for m in told if m}
    assert 120.0 < when["coasting"] < when["lost"] < 300.0 <= when["ok"]
    assert [p.name for p in folder.iterdir()] == ["loop.py"]


def test_the_control_loop_goes_on_from_its_checkpoint(lines):
    restored = [re.search(r"restored; (\d+) of (\d+) records were new", line) for line in lines]
    new, sent = (int(n) for n in next(m for m in restored if m).groups())
    # 5 s of attitude, depth and DVL twice a second, and the pings of these.
    assert sent == 100
    assert 30 <= new <= 35


def test_the_control_loop_knows_where_the_vehicle_is(lines):
    off = re.fullmatch(r"(\S+) m off in the end", lines[-1])
    assert off is not None
    assert float(off[1]) < 0.5


def test_the_page_shows_what_it_prints(lines):
    def words(text):
        return [re.sub(r"[\d.]+", "#", line) for line in text]

    assert words(PRINTED.splitlines()) == words(lines)
