"""Running independent pieces of work in child processes.

pycolmap aborts the whole process when one of its worker threads meets an error, so every risky
call runs in a child. A child that dies costs its own task and nothing else: the task comes back
as a ``TaskFailure`` and the rest goes on.
"""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Generic, TypeVar

from smust3r_colmap.errors import SmustrError, StorageError

logger = logging.getLogger(__name__)

TaskT = TypeVar("TaskT")
ResultT = TypeVar("ResultT")

_PARENT_POLL_S = 1.0


@dataclass(frozen=True, kw_only=True)
class TaskFailure:
    """A task that gave no result.

    Args:
        reason: the error's text, or that the process died.
        crashed: the child process died, rather than raised.
    """

    reason: str
    crashed: bool


@dataclass(frozen=True, kw_only=True)
class TaskResult(Generic[ResultT]):
    """Outcome of one task.

    Args:
        index: position of the task in the sequence given.
        value: the function's result, or a ``TaskFailure``.
    """

    index: int
    value: ResultT | TaskFailure


def usable_cores() -> int:
    """Cores this process may run on, which in a container is often fewer than the machine has."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not Linux
        return os.cpu_count() or 1


def map_tasks(
    function: Callable[[TaskT], ResultT], tasks: Sequence[TaskT], *, workers: int, log_file: Path | None = None
) -> Iterator[TaskResult[ResultT]]:
    """Results of ``function`` over ``tasks`` as they are ready, in any order, from child processes.

    Args:
        function: importable at module level; it and the tasks travel by pickle between our own processes.
        workers: how many children at most, at least one even for a single task.
        log_file: where the native code of the children writes its messages; None throws them away.
    """
    waiting = deque(range(len(tasks)))
    while waiting:
        suspects = yield from _run_until_broken(function, tasks, waiting, workers, log_file)
        # One of the tasks in flight killed its process and took the pool along; find out which.
        for index in suspects:
            alone = deque([index])
            died = yield from _run_until_broken(function, tasks, alone, 1, log_file)
            if died:
                reason = "the process that worked on it died (out of memory, or an error inside a native library)"
                yield TaskResult(index=index, value=TaskFailure(reason=reason, crashed=True))


def _run_until_broken(
    function: Callable[[TaskT], ResultT],
    tasks: Sequence[TaskT],
    waiting: deque[int],
    workers: int,
    log_file: Path | None,
) -> Generator[TaskResult[ResultT], None, list[int]]:
    """Drain ``waiting``; returns the indices in flight when a child died, empty when none did."""
    pool = ProcessPoolExecutor(
        max_workers=max(1, min(workers, len(waiting))),
        mp_context=get_context("spawn"),
        initializer=_start_child,
        initargs=(os.getpid(), None if log_file is None else str(log_file)),
    )
    in_flight: dict[Future[ResultT | TaskFailure], int] = {}
    try:
        while waiting or in_flight:
            # Twice the workers keeps them busy and the list of suspects short.
            while waiting and len(in_flight) < 2 * workers:
                index = waiting[0]
                in_flight[pool.submit(_guarded, function, tasks[index])] = index
                waiting.popleft()
            done, _ = wait(in_flight, return_when=FIRST_COMPLETED)
            for future in done:
                value = future.result()
                yield TaskResult(index=in_flight.pop(future), value=value)
    except BrokenProcessPool:
        suspects = sorted(in_flight.values())
        logger.warning("a child process died; running %d tasks again one by one", len(suspects))
        return suspects
    except BaseException:
        _kill(pool)
        raise
    finally:
        # Waiting lets the system count the children's processor time as ours.
        pool.shutdown(wait=True, cancel_futures=True)
    return []


def _guarded(function: Callable[[TaskT], ResultT], task: TaskT) -> ResultT | TaskFailure:
    """An error of the task becomes its result; a full disk and mistakes of ours still end the run."""
    import cv2  # noqa: PLC0415  (only children pay for it)

    try:
        return function(task)
    except StorageError:
        raise
    except (
        SmustrError,
        ValueError,
        IndexError,
        RuntimeError,
        OSError,
        MemoryError,
        ArithmeticError,
        cv2.error,
    ) as error:
        logger.exception("task failed")
        return TaskFailure(reason=f"{type(error).__name__}: {error}", crashed=False)


def _start_child(parent_pid: int, log_file: str | None) -> None:
    """One OpenCV thread per child, native messages to the log, and never outlive the parent by more than a moment."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    target = os.open(log_file or os.devnull, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    os.dup2(target, 2)
    os.close(target)
    import cv2  # noqa: PLC0415  (only children pay for it)

    cv2.setNumThreads(1)

    def watch() -> None:
        while os.getppid() == parent_pid:
            time.sleep(_PARENT_POLL_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _kill(pool: ProcessPoolExecutor) -> None:
    for process in list((pool._processes or {}).values()):
        process.kill()
