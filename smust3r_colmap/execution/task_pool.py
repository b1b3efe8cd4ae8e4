"""Tasks in child processes, for two reasons that are kept apart.

- *Parallel work*: an ``Executor`` maps a function over tasks. ``TaskPool`` does it with processes of this machine;
  the stages know ``Run.executor`` only.
- *Isolation*: pycolmap aborts the whole process when one of its worker threads meets an error, so a risky call runs
  in a child of its own (``in_child``), on whichever machine needs it.

A child that dies costs its own task and nothing else: the task comes back as a ``TaskFailure`` and the rest goes on.
"""

from __future__ import annotations

import logging
import os
import re
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
from typing import Generic, Literal, Protocol, TypeVar

from smust3r_colmap.errors import SmustrError, StorageError

logger = logging.getLogger(__name__)

TaskT = TypeVar("TaskT")
ResultT = TypeVar("ResultT")

_PARENT_POLL_S = 1.0
_DISK_REFUSED = re.compile("database or disk is full|disk I/O error|No space left on device|File too large")
"""What native code writes before it ends the process."""


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


def num_workers(wanted: int | Literal["auto"]) -> int:
    """Processes for the setting ``workers``: auto is one per core that this process may use."""
    return usable_cores() if wanted == "auto" else wanted


def usable_cores() -> int:
    """Cores this process may run on, which in a container is often fewer than the machine has."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not Linux
        return os.cpu_count() or 1


class Executor(Protocol):
    """Maps functions over tasks, wherever they run."""

    @property
    def workers(self) -> int:
        """Tasks that may run at once, at least one."""

    def map(self, function: Callable[[TaskT], ResultT], tasks: Sequence[TaskT]) -> Iterator[TaskResult[ResultT]]:
        """Results of ``function`` over ``tasks`` as they are ready, in any order.

        Args:
            function: importable at module level; it and the tasks travel by pickle between our own processes.
        """


class TaskPool:
    """The ``Executor`` of this machine: child processes that stay from one batch of tasks to the next.

    Starting a child takes a second.

    Children start when there is a first task for them, and end with the ``with`` block.

    Args:
        workers: how many children at most, at least one even for a single task.
        log_file: where the native code of the children writes its messages; None throws them away.
    """

    def __init__(self, *, workers: int, log_file: Path | None = None) -> None:
        self.workers = max(1, workers)
        self.log_file = log_file
        self._executor: ProcessPoolExecutor | None = None
        self._cpu_s: dict[int, float] = {}
        self._log_start = 0

    def __enter__(self) -> TaskPool:
        _open_pools.append(self)
        return self

    def __exit__(self, kind: type[BaseException] | None, *exc: object) -> None:
        self._shut_down(kill=kind is not None)
        _open_pools.remove(self)

    @property
    def living_cpu_s(self) -> float:
        """Processor time of the living children when each of them finished its last task."""
        return sum(self._cpu_s.values())

    def map(self, function: Callable[[TaskT], ResultT], tasks: Sequence[TaskT]) -> Iterator[TaskResult[ResultT]]:
        """Results of ``function`` over ``tasks`` as they are ready, in any order.

        Args:
            function: importable at module level; it and the tasks travel by pickle between our own processes.
        """
        waiting = deque(range(len(tasks)))
        while waiting:
            suspects = yield from self._run_until_broken(function, tasks, waiting, self.workers)
            # One of the tasks in flight killed its process and took the pool along; find out which.
            for index in suspects:
                died = yield from self._run_until_broken(function, tasks, deque([index]), 1)
                if died:
                    self._refuse_full_disk()
                    reason = "the process that worked on it died (out of memory, or an error inside a native library)"
                    yield TaskResult(index=index, value=TaskFailure(reason=reason, crashed=True))

    def _run_until_broken(
        self, function: Callable[[TaskT], ResultT], tasks: Sequence[TaskT], waiting: deque[int], workers: int
    ) -> Generator[TaskResult[ResultT], None, list[int]]:
        """Drain ``waiting``; returns the indices in flight when a child died, empty when none did."""
        in_flight: dict[Future[_Report[ResultT]], int] = {}
        try:
            while waiting or in_flight:
                # Twice the workers keeps them busy and the list of suspects short.
                while waiting and len(in_flight) < 2 * workers:
                    index = waiting[0]
                    in_flight[self._started().submit(_guarded, function, tasks[index])] = index
                    waiting.popleft()
                done, _ = wait(in_flight, return_when=FIRST_COMPLETED)
                for future in done:
                    report = future.result()
                    self._cpu_s[report.process] = report.cpu_s
                    yield TaskResult(index=in_flight.pop(future), value=report.value)
        except BrokenProcessPool:
            suspects = sorted(in_flight.values())
            logger.warning("a child process died; running %d tasks again one by one", len(suspects))
            self._shut_down(kill=False)
            return suspects
        except BaseException:
            self._shut_down(kill=True)
            raise
        return []

    def _refuse_full_disk(self) -> None:
        """A child that died because the disk refused a write is no failure of its task.

        Raises:
            StorageError: its native code said so before.
        """
        if self.log_file is None or not self.log_file.exists():
            return
        with self.log_file.open("rb") as log:
            log.seek(self._log_start)
            said = _DISK_REFUSED.search(log.read().decode(errors="replace"))
        if said:
            raise StorageError(
                f"{self.log_file.parent}: {said[0]}; finished stages are kept, and with more room the "
                "same command goes on"
            )

    def _started(self) -> ProcessPoolExecutor:
        if self._executor is None:
            has_log = self.log_file is not None and self.log_file.exists()
            self._log_start = self.log_file.stat().st_size if has_log and self.log_file is not None else 0
            self._executor = ProcessPoolExecutor(
                max_workers=self.workers,
                mp_context=get_context("spawn"),
                initializer=_start_child,
                initargs=(os.getpid(), None if self.log_file is None else str(self.log_file)),
            )
        return self._executor

    def _shut_down(self, *, kill: bool) -> None:
        if self._executor is not None:
            for process in list((self._executor._processes or {}).values()) if kill else []:
                process.kill()
            # Waiting lets the system count the children's processor time as ours.
            self._executor.shutdown(wait=True, cancel_futures=True)
        self._executor = None
        self._cpu_s.clear()


_open_pools: list[TaskPool] = []


def living_children_cpu_s() -> float:
    """Processor time that the system does not count as ours yet, because the children that used it live on."""
    return sum(pool.living_cpu_s for pool in _open_pools)


def in_child(
    function: Callable[[TaskT], ResultT], task: TaskT, *, log_file: Path | None = None
) -> ResultT | TaskFailure:
    """The result of one call in a child process of its own, so that a crash of native code stays there.

    Args:
        function: importable at module level; it and the task travel by pickle.
        log_file: where native code writes its messages; None throws them away.
    """
    with TaskPool(workers=1, log_file=log_file) as pool:
        (result,) = pool.map(function, [task])
    return result.value


@dataclass(frozen=True, kw_only=True)
class _Report(Generic[ResultT]):
    """What a child sends back: the outcome, its process id, and its processor time so far."""

    value: ResultT | TaskFailure
    process: int
    cpu_s: float


def _guarded(function: Callable[[TaskT], ResultT], task: TaskT) -> _Report[ResultT]:
    value = _outcome(function, task)
    return _Report(value=value, process=os.getpid(), cpu_s=time.process_time())


def _outcome(function: Callable[[TaskT], ResultT], task: TaskT) -> ResultT | TaskFailure:
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
