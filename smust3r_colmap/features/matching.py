"""Matching image pairs in a child process, with two-view verification by COLMAP.

The next module to read is ``guided_verification``.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from smust3r_colmap.colmap.database import internal_name, open_database
from smust3r_colmap.execution.progress import Stage
from smust3r_colmap.execution.task_pool import TaskFailure, TaskPool
from smust3r_colmap.geometry.arrays import Pair

logger = logging.getLogger(__name__)

_PAIRS_PER_THREAD = 100


@dataclass(frozen=True, kw_only=True)
class _MatchingTask:
    database: Path
    pairs: tuple[Pair, ...]
    threads: int
    seed: int


def match_pairs(
    path: Path,
    pairs: Iterable[Pair],
    *,
    workers: int,
    seed: int,
    log_file: Path | None,
    stage: Stage,
) -> frozenset[Pair]:
    """Match and verify every pair that is not in the database yet; each pair once in the run.

    pycolmap writes each finished pair, also one without matches, so pairs in the database are done.

    Returns:
        The finished pairs; the others failed and are tried again at the next start.
    """
    wanted = sorted(set(pairs))
    with open_database(path) as database:
        missing = [pair for pair in wanted if not database.exists_matches(pair[0] + 1, pair[1] + 1)]
    stage.skip(len(wanted) - len(missing))
    size = _PAIRS_PER_THREAD * workers
    tasks = [
        _MatchingTask(database=path, pairs=tuple(missing[k : k + size]), threads=workers, seed=seed)
        for k in range(0, len(missing), size)
    ]
    # One child with threads, not many children: SQLite takes one writer at a time.
    with TaskPool(workers=1, log_file=log_file) as child:
        for result in child.map(_match, tasks):
            if isinstance(result.value, TaskFailure):
                logger.warning("up to %d pairs not matched: %s", len(tasks[result.index].pairs), result.value.reason)
            stage.advance(len(tasks[result.index].pairs))
    with open_database(path) as database:
        return frozenset(pair for pair in wanted if database.exists_matches(pair[0] + 1, pair[1] + 1))


def _match(task: _MatchingTask) -> None:
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = task.threads
    matching.use_gpu = False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = task.seed
    with tempfile.TemporaryDirectory(prefix="smust3r-match-") as scratch:
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = Path(scratch) / "pairs.txt"
        pairing.match_list_path.write_text("".join(f"{internal_name(a)} {internal_name(b)}\n" for a, b in task.pairs))
        pycolmap.match_image_pairs(task.database, matching, pairing, verification, pycolmap.Device.cpu)
