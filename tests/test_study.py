"""Studies: the same results wherever they run, and no case that takes others along."""

import os
import pickle
import signal
import subprocess
import sys
import textwrap
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import closing, suppress
from functools import partial
from multiprocessing import get_context
from multiprocessing.spawn import get_executable, set_executable
from pathlib import Path

import fleet
import numpy as np
import psutil
import pytest
from hypothesis import given
from hypothesis import strategies as st

import ubl_graph.cluster
from ubl_graph.errors import ConfigurationError
from ubl_graph.study import (
    ProcessPool,
    SerialExecutor,
    case_seeds,
    executor_at,
    iter_study,
    run_study,
)

#: Sound cases among such that go wrong without taking their worker along.
MIXED = [1, 2, "raise", 3, "exit", 4, 5, 6, 7, 8]


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory):
    """Address of a dask scheduler with two workers; a case may take one worker along."""
    folder = tmp_path_factory.mktemp("cluster")
    with fleet.cluster(folder, DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES="0") as (address, _):
        yield address


@pytest.fixture(scope="module")
def pool():
    with ProcessPool(2) as pool:
        yield pool


# Results


def spawned():
    return ProcessPoolExecutor(2, mp_context=get_context("spawn"))


@pytest.mark.parametrize("bundle", [None, 3])
@pytest.mark.parametrize(
    "executor",
    [partial(ProcessPool, 1), partial(ProcessPool, 2), spawned, partial(ThreadPoolExecutor, 2)],
    ids=["one process", "two processes", "concurrent.futures", "threads"],
)
def test_results_are_the_same_whatever_the_executor(executor, bundle):
    expected = run_study(fleet.draw, MIXED, seed=5, executor=SerialExecutor())
    with executor() as executor:
        study = run_study(fleet.draw, MIXED, seed=5, executor=executor, bundle=bundle)
    assert study.results == expected.results
    assert len(study.results) == len(MIXED) - 2
    assert [o.seed for o in study.outcomes] == [o.seed for o in expected.outcomes]
    assert [o.case for o in study.outcomes] == MIXED
    assert [str(o.error) for o in study.failures] == [str(o.error) for o in expected.failures]


def test_smoothed_windows_are_the_same_to_the_last_bit(pool, scheduler):
    durations = [30.0, 40.0, 50.0, 60.0, 30.0, 30.0]
    expected = run_study(fleet.window, durations, executor=SerialExecutor()).results
    assert not np.array_equal(expected[0], expected[4])
    with executor_at(scheduler) as cluster:
        for executor in (pool, cluster):
            study = run_study(fleet.window, durations, executor=executor)
            for found, track in zip(study.results, expected, strict=True):
                np.testing.assert_array_equal(found, track)


def test_outcomes_stand_in_the_order_of_the_cases_whatever_ends_first(pool):
    cases = [0.4, 0.0, 0.01, 0.02]
    with closing(iter_study(fleet.draw, cases, executor=pool)) as outcomes:
        ended = [o.index for o in outcomes]
    study = run_study(fleet.draw, cases, executor=pool)
    assert ended[-1] == 0
    assert [o.index for o in study.outcomes] == [0, 1, 2, 3]
    assert study.results == run_study(fleet.draw, cases, executor=SerialExecutor()).results


@given(seed=st.integers(0, 2**70), count=st.integers(0, 40), more=st.integers(0, 5))
def test_seeds_depend_on_their_place_alone_and_differ(seed, count, more):
    seeds = case_seeds(seed, count)
    assert seeds == case_seeds(seed, count + more)[:count]
    assert len({*seeds, *case_seeds(seed + 1, count)}) == 2 * count
    assert all(0 <= s < 2**53 for s in seeds)
    for place, found in enumerate(seeds):
        sequence = np.random.SeedSequence(seed, spawn_key=(place,))
        assert found == int(sequence.generate_state(2, np.uint32).view(np.uint64)[0]) // 2**11


def test_a_study_without_cases_is_empty():
    assert run_study(fleet.draw, []).outcomes == ()


# Failures


def test_a_failing_case_is_reported_with_its_seed_and_can_be_run_again(pool):
    study = run_study(fleet.draw, ["a", "raise", "b"], seed=3, executor=pool)
    (failure,) = study.failures
    assert (failure.index, failure.case, failure.value) == (1, "raise", None)
    assert failure.seed == case_seeds(3, 3)[1]
    assert failure.error.type == "ValueError"
    assert failure.error.message == "a bad case\nin two lines"
    assert "in draw" in failure.error.traceback
    assert failure.summary() == f"case 1 (seed {failure.seed}): ValueError: a bad case in two lines"
    with pytest.raises(ValueError, match="a bad case"):
        fleet.draw(failure.case, failure.seed)
    assert [v[0] for v in study.results] == ["a", "b"]


@pytest.mark.parametrize("bundle", [1, 4, 20])
def test_a_worker_that_dies_takes_one_case_along(bundle):
    cases = [*range(6), "kill", *range(6, 9), "leave", *range(9, 12)]
    study = run_study(fleet.draw, cases, workers=2, bundle=bundle)
    assert [(f.index, str(f.error)) for f in study.failures] == [
        (6, "WorkerDied: the worker process died (SIGKILL)"),
        (10, "WorkerDied: the worker process died (exit code 3)"),
    ]
    expected = run_study(
        fleet.draw, [c if isinstance(c, int) else None for c in cases], executor=SerialExecutor()
    )
    assert study.results == [v for v in expected.results if v[0] is not None]


def test_a_case_that_kills_runs_twice_at_most_and_one_that_recovers_counts(tmp_path, pool):
    cases = [(tmp_path, "sound", 0), (tmp_path, "once", 1), (tmp_path, "always", 99)]
    study = run_study(fleet.note_and_die, cases, executor=pool)
    assert study.results == ["sound", "once"]
    assert [f.index for f in study.failures] == [2]
    seeds = (tmp_path / "always").read_text().split()
    assert seeds == [str(study.failures[0].seed)] * 2
    assert len((tmp_path / "sound").read_text().split()) == 1


def test_a_broken_pool_of_the_callers_ends_the_study_with_a_reason():
    with spawned() as executor:
        study = run_study(fleet.draw, [*range(20), "kill"], executor=executor)
    assert len(study.outcomes) == 21
    assert study.outcomes[20].error.type == "BrokenProcessPool"
    assert {f.error.type for f in study.failures} == {"BrokenProcessPool"}


@pytest.mark.parametrize("bundle", [1, 5])
def test_what_cannot_be_sent_fails_alone(pool, bundle):
    cases = [1, "unpicklable", 2, lambda: None, 3]
    study = run_study(fleet.draw, cases, executor=pool, bundle=bundle)
    assert [f.index for f in study.failures] == [1, 3]
    back, there = (str(f.error) for f in study.failures)
    assert back.startswith("PicklingError: the result cannot be sent back")
    assert there.startswith("PicklingError: the task cannot be sent to another process")
    assert [v[0] for v in study.results] == [1, 2, 3]


def test_an_executor_goes_on_after_a_death(pool):
    run_study(fleet.draw, ["kill"], executor=pool)
    assert run_study(fleet.draw, [1], executor=pool).failures == []


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"seed": -1}, ["seed is -1", "0 or more"]),
        ({"workers": 0}, ["0 workers", "one or more"]),
        ({"bundle": 0}, ["bundles of 0"]),
        ({"workers": 2, "executor": SerialExecutor()}, ["workers", "executor"]),
    ],
)
def test_bad_arguments_are_refused(arguments, named):
    with pytest.raises(ConfigurationError) as caught:
        run_study(fleet.draw, [1], **arguments)
    assert all(text in str(caught.value) for text in named)


def test_a_function_that_other_processes_cannot_import_is_refused_at_once(pool):
    with pytest.raises(ConfigurationError, match="top of a module"):
        run_study(lambda _case, _seed: 0, [1, 2], executor=pool)
    assert run_study(lambda _case, _seed: 0, [1, 2], executor=SerialExecutor()).results == [0, 0]


# Progress and interrupts


def test_progress_counts_cases_and_failures(pool):
    heard = []
    run_study(fleet.draw, MIXED, executor=pool, progress=lambda *said: heard.append(said))
    assert [share for _, share in heard] == [(i + 1) / 10 for i in range(10)]
    assert heard[-1][0] == "10 of 10, 2 failed"


def test_an_error_in_progress_cancels_what_waits(tmp_path):
    def stop(_text, _share):
        raise KeyboardInterrupt

    cases = [(tmp_path, f"{i}", 0) for i in range(400)]
    with pytest.raises(KeyboardInterrupt):
        run_study(fleet.note_and_die, cases, workers=1, progress=stop, bundle=1)
    assert len(list(tmp_path.iterdir())) < 200


def test_leaving_early_ends_the_processes_at_once():
    begin = time.monotonic()
    with closing(iter_study(fleet.draw, [0.0, 60.0, 60.0], workers=2)) as outcomes:
        assert next(outcomes).index == 0
    assert time.monotonic() - begin < 30.0


SCRIPT = """
    import fleet
    from ubl_graph.study import run_study

    def say(text, share):
        print(text, flush=True)

    if {guard}:
        run_study(fleet.draw, [0.0, 60.0, 60.0, 60.0], workers=2, progress=say)
"""


def script(folder: Path, guard: str) -> subprocess.Popen[str]:
    path = folder / "script.py"
    path.write_text(textwrap.dedent(SCRIPT.format(guard=guard)))
    return subprocess.Popen(
        [sys.executable, path],
        env={**os.environ, "PYTHONPATH": str(fleet.HERE)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def running(group: int) -> list[psutil.Process]:
    """Processes of a group that have not ended."""
    found = []
    for process in psutil.process_iter():
        with suppress(ProcessLookupError, psutil.Error):
            if os.getpgid(process.pid) == group and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process)
    return found


def test_an_interrupt_from_the_keyboard_ends_all_processes(tmp_path):
    with script(tmp_path, "__name__ == '__main__'") as process:
        assert process.stdout.readline() == "1 of 4\n"
        os.killpg(process.pid, signal.SIGINT)
        _, said = process.communicate(timeout=30)
    assert process.returncode != 0
    assert said.count("Traceback") == said.count("KeyboardInterrupt\n") == 1
    end_of_patience = time.monotonic() + 10.0
    while (left := running(process.pid)) and time.monotonic() < end_of_patience:
        time.sleep(0.05)
    assert left == []


def test_a_script_without_guard_is_told_so(tmp_path):
    with script(tmp_path, "True") as process:
        _, said = process.communicate(timeout=60)
    assert process.returncode == 1
    last = said.strip().splitlines()[-1]
    assert "worker processes do not start" in last
    assert 'if __name__ == "__main__":' in last


# Worker processes


def test_linear_algebra_has_one_thread_in_a_worker_unless_the_environment_says_more(monkeypatch):
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "3")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    assert run_study(fleet.threads, [0], workers=1).results == [("3", "1")]
    assert "MKL_NUM_THREADS" not in os.environ


def test_a_pool_is_an_executor(pool):
    assert list(pool.map(divmod, [7, 9], [2, 4])) == [(3, 1), (2, 1)]
    with pytest.raises(ZeroDivisionError):
        pool.submit(divmod, 1, 0).result()
    with pytest.raises(ConfigurationError, match="bad value"):
        # An exception that pickle cannot make again arrives as text, others as themselves.
        pool.submit(fleet.fail_as, ConfigurationError).result()
    with pytest.raises(RuntimeError, match="AwkwardError: bad value"):
        pool.submit(fleet.fail_as, fleet.AwkwardError).result()


def test_a_worker_that_cannot_be_replaced_ends_its_case_and_not_the_study():
    executable = get_executable()
    with ProcessPool(1) as pool:
        assert pool.submit(abs, -1).result() == 1
        set_executable("/bin/false")
        try:
            study = run_study(fleet.draw, ["kill", 1], executor=pool)
            with pytest.raises(ConfigurationError, match=r"do not start \(exit code 1\)"):
                run_study(fleet.draw, [1], workers=1)
        finally:
            set_executable(executable)
        assert [str(f.error) for f in study.failures] == [
            "WorkerDied: worker processes do not start (exit code 1)"
        ] * 2
        assert run_study(fleet.draw, [1], executor=pool).failures == []


def test_a_closed_pool_takes_nothing():
    with ProcessPool(1) as pool:
        pass
    with pytest.raises(RuntimeError, match="shutdown"):
        pool.submit(abs, -1)


# A dask cluster


def test_a_cluster_gives_the_same_results_and_failures(scheduler):
    expected = run_study(fleet.draw, MIXED, seed=5, executor=SerialExecutor())
    for bundle in (None, 4):
        with executor_at(scheduler) as cluster:
            study = run_study(fleet.draw, MIXED, seed=5, executor=cluster, bundle=bundle)
        assert study.results == expected.results
        assert [(f.seed, str(f.error)) for f in study.failures] == [
            (f.seed, str(f.error)) for f in expected.failures
        ]


def test_a_cluster_worker_that_dies_takes_one_case_along(scheduler):
    cases = [*range(6), "kill", *range(6, 10)]
    with executor_at(scheduler) as cluster:
        study = run_study(fleet.draw, cases, executor=cluster, bundle=3)
    (failure,) = study.failures
    assert (failure.index, failure.seed) == (6, case_seeds(0, 11)[6])
    assert failure.error.type == "KilledWorker"
    assert [v[0] for v in study.results] == list(range(10))


@pytest.mark.parametrize("address", ["127.0.0.1:1", "nonsense", "foo://bar:1", ""])
def test_an_address_where_no_scheduler_is_is_refused(address):
    with (
        pytest.raises(ConfigurationError, match=r"no dask scheduler answers .*8786"),
        executor_at(address, timeout=0.5),
    ):
        raise AssertionError("never opened")


def test_workers_cannot_be_asked_of_a_cluster():
    with (
        pytest.raises(ConfigurationError, match="workers are given with a scheduler"),
        executor_at("127.0.0.1:1", workers=2),
    ):
        raise AssertionError("never opened")


def test_without_dask_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ConfigurationError, match=r"ubl-graph\[fleet\]"), executor_at("any:1"):
        raise AssertionError("never opened")


def test_a_cluster_without_workers_is_refused(tmp_path):
    with (
        fleet.cluster(tmp_path, workers=0) as (address, _),
        pytest.raises(ConfigurationError, match=f"has no workers; .*dask worker {address}"),
        executor_at(address, timeout=0.5),
    ):
        raise AssertionError("never opened")


def test_workers_with_another_version_are_refused(tmp_path):
    package = tmp_path / "other" / "ubl_graph"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("__version__ = '0.0.1'\n")
    path = str(package.parent)
    with (
        fleet.cluster(tmp_path, workers=1, path=path) as (address, _),
        pytest.raises(ConfigurationError, match=r"has no ubl_graph .*install the same version"),
        executor_at(address),
    ):
        raise AssertionError("never opened")


@pytest.mark.parametrize("lost", ["scheduler", "workers"])
def test_a_cluster_that_is_gone_ends_the_study(tmp_path, monkeypatch, lost):
    monkeypatch.setattr(ubl_graph.cluster, "ABANDONED", 1.0)
    with fleet.cluster(tmp_path) as (address, processes):
        victims = processes[:1] if lost == "scheduler" else processes[1:]

        def destroy(_text, _share):
            for process in victims:
                fleet.end(process)

        with executor_at(address, timeout=4.0) as cluster:
            study = run_study(
                fleet.draw, [0.0, *[0.2] * 30], executor=cluster, progress=destroy, bundle=1
            )
    assert len(study.outcomes) == 31
    assert study.failures
    assert f"the dask scheduler at '{address}'" in str(study.failures[-1].error)


def test_outcomes_are_picklable(pool):
    study = run_study(fleet.draw, MIXED, executor=pool)
    again = pickle.loads(pickle.dumps(study))
    assert again.results == study.results
    assert [f.summary() for f in again.failures] == [f.summary() for f in study.failures]
