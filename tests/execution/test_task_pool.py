import os
import signal
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from smust3r_colmap.errors import StorageError
from smust3r_colmap.execution.task_pool import TaskFailure, TaskPool, in_child, living_children_cpu_s


def square_unless_told_otherwise(task: int | str) -> int:
    if task == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if task == "raise":
        raise ValueError("bad value 7")
    if task == "opencv":
        cv2.resize(np.zeros((0, 0), np.uint8), (4, 4))
    if task == "disk":
        raise StorageError("disk full")
    assert isinstance(task, int)
    return task * task


def write_to_stderr_natively(text: str) -> None:
    os.write(2, text.encode())


def outcomes(tasks: list[int | str]) -> dict[int, int | TaskFailure]:
    with TaskPool(workers=2) as pool:
        return {result.index: result.value for result in pool.map(square_unless_told_otherwise, tasks)}


@pytest.mark.slow
def test_every_task_gives_its_own_result() -> None:
    assert outcomes([3, 4, 5]) == {0: 9, 1: 16, 2: 25}


@pytest.mark.slow
def test_a_child_that_dies_costs_only_its_own_task() -> None:
    found = outcomes([1, 2, "die", 3, 4, 5, 6])
    died = found.pop(2)
    assert isinstance(died, TaskFailure)
    assert died.crashed
    assert "died" in died.reason
    assert found == {0: 1, 1: 4, 3: 9, 4: 16, 5: 25, 6: 36}


@pytest.mark.slow
def test_an_error_becomes_a_failure_with_its_text() -> None:
    failed = outcomes([1, "raise"])[1]
    assert failed == TaskFailure(reason="ValueError: bad value 7", crashed=False)


@pytest.mark.slow
def test_an_error_inside_opencv_costs_only_its_task() -> None:
    found = outcomes([1, "opencv"])
    failed = found.pop(1)
    assert isinstance(failed, TaskFailure)
    assert "OpenCV" in failed.reason
    assert not failed.crashed
    assert found == {0: 1}


def test_a_full_disk_ends_the_run() -> None:
    with pytest.raises(StorageError, match="disk full"):
        outcomes(["disk"])


def process_of(work_s: float) -> int:
    started = time.process_time()
    while time.process_time() - started < work_s:
        pass
    return os.getpid()


def processes(pool: TaskPool, work_s: float = 0.0) -> set[int | TaskFailure]:
    return {result.value for result in pool.map(process_of, [work_s] * 4)}


@pytest.mark.slow
def test_children_of_a_pool_serve_batch_after_batch_and_their_time_is_counted_at_once() -> None:
    with TaskPool(workers=1) as pool:
        assert living_children_cpu_s() == 0
        first = processes(pool, 0.1)
        spent = living_children_cpu_s()
        assert spent > 0.4
        assert processes(pool) == first
        assert living_children_cpu_s() > spent
        ended = os.times()
    assert living_children_cpu_s() == 0
    assert os.times().children_user - ended.children_user > 0.3  # the system's account has it now


@pytest.mark.slow
def test_a_pool_goes_on_with_a_new_child_after_one_died() -> None:
    with TaskPool(workers=1) as pool:
        (dead,) = processes(pool)
        (failed,) = (result.value for result in pool.map(square_unless_told_otherwise, ["die"]))
        assert isinstance(failed, TaskFailure)
        (living,) = processes(pool)
        assert living != dead


@pytest.mark.slow
def test_an_error_inside_the_block_ends_the_children_at_once() -> None:
    started = time.monotonic()
    with pytest.raises(KeyboardInterrupt), TaskPool(workers=2) as pool:
        results = pool.map(time.sleep, [0.0, 60.0, 60.0])
        next(results)
        raise KeyboardInterrupt
    assert time.monotonic() - started < 30


@pytest.mark.slow
def test_native_messages_go_to_the_log(tmp_path: Path) -> None:
    log = tmp_path / "native.log"
    in_child(write_to_stderr_natively, "from the depths", log_file=log)
    assert "from the depths" in log.read_text()


@pytest.mark.slow
def test_stopping_early_ends_the_children() -> None:
    started = time.monotonic()
    with TaskPool(workers=2) as pool:
        results = pool.map(time.sleep, [0.0, 60.0, 60.0])
        next(results)
        results.close()  # type: ignore[attr-defined]
    assert time.monotonic() - started < 30


def die_of_a_full_disk(text: str) -> None:
    os.write(2, text.encode())
    os.abort()


@pytest.mark.slow
def test_a_child_that_died_of_a_full_disk_ends_the_run(tmp_path: Path) -> None:
    """What an earlier run left in the log is of no importance."""
    log = tmp_path / "native.log"
    log.write_text("SQLite error: database or disk is full\n")
    failed = in_child(die_of_a_full_disk, "some other fatal error\n", log_file=log)
    assert isinstance(failed, TaskFailure) and failed.crashed
    with pytest.raises(StorageError, match=r"disk I/O error; finished stages are kept, and with more room the same"):
        in_child(die_of_a_full_disk, "[database_sqlite.cc:9] SQLite error: disk I/O error\n", log_file=log)
