"""What every stage gets: where products lie, how work runs, who is told about it.

A stage asks ``Run.cached`` for its product and says how to compute it; whether an earlier start has finished it is
decided here and nowhere else. The next module to read is ``pipeline``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from smust3r_colmap.execution.progress import Reporter, Stage
from smust3r_colmap.execution.stage_clock import StageClock
from smust3r_colmap.execution.task_pool import Executor, TaskPool
from smust3r_colmap.storage.codec import Codec
from smust3r_colmap.storage.run_directory import RunDirectory, key_of

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Run:
    """One start of a run.

    Args:
        folder: the output folder, held by this process.
        clock: told about every stage, and measures it.
        executor: runs tasks in parallel; the only way to do so.
        seed: of every random choice.
    """

    folder: RunDirectory
    clock: StageClock
    executor: Executor
    seed: int

    @classmethod
    @contextmanager
    def open(cls, output: Path, *, workers: int, seed: int, reporter: Reporter) -> Iterator[Run]:
        """Hold the output folder and start child processes when there is a first task for them.

        Raises:
            RunDirectoryError: the folder cannot be used, or another process holds it.
        """
        with RunDirectory(output) as folder, TaskPool(workers=workers, log_file=folder.native_log) as executor:
            yield cls(folder=folder, clock=StageClock(reporter), executor=executor, seed=seed)

    def cached(
        self,
        name: str,
        inputs: object,
        compute: Callable[[Stage], T],
        codec: Codec[T],
        *,
        total: int = 1,
        title: str = "",
    ) -> T:
        """The product of a stage: that of an earlier start with the same inputs, or the one that is computed now.

        What is computed is read back, so that a run gives the same whether it was interrupted or not.

        Args:
            name: of the folder below ``work``.
            inputs: all that the product depends on, see ``key_of``.
            compute: makes the product, and advances the progress it is given by ``total`` in all.
            codec: writes and reads it.
            title: of the stage in progress and report; by default ``name``.
        """

        def write(folder: Path, progress: Stage) -> None:
            codec.write(folder, compute(progress))

        return codec.read(self.cached_folder(name, inputs, write, total=total, title=title))

    def cached_folder(
        self, name: str, inputs: object, write: Callable[[Path, Stage], None], *, total: int = 1, title: str = ""
    ) -> Path:
        """As ``cached``, for a product that is written bit by bit: the folder that holds it.

        Args:
            write: puts all files into the folder that it is given.
        """
        stored = self.folder.stage(name, key=key_of(name, inputs))
        with self.clock.stage(title or name, total=total) as progress:
            if stored.is_done:
                progress.skip(total)
            else:
                with stored.write() as folder:
                    write(folder, progress)
        return stored.path
