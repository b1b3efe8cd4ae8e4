"""Where everything lies, and how a run takes up where it was left.

    OUT/
      sparse/0/ 1/ ...     COLMAP models, largest first
      database.db          keypoints, matches and priors, with the ids of the models
      points.ply  scene.glb
      trainer/             for splat and NeRF trainers
      dense/               COLMAP's workspace of depth and normal maps, fused.ply
      trajectory_tum.txt  trajectory_stitched_tum.txt  trajectory_without_loops_tum.txt
      poses_uncertainty.csv
      summary.json  config.toml  report.html
      work/
        lock               held by the process that writes
        native.log         messages of pycolmap's native code
        frames/            frames of videos, with links to the other images
        import/            what was read of each file
        features/          database.db: keypoints, descriptors, matches, ids = index + 1; static_regions
        descriptors/       one vector per image
        keyframes/         images that carry the reconstruction
        loops/             every candidate for a loop, why it was taken or not, the loop segments
        look_alikes/       pairs that the rotations of all others contradict
        cover/             clusters of images in no order
        tokens/            images as the MUSt3R network encoded them; the least recently used give way
        segments/0000/     mapping/  calibrated/  depth_0/  depth_1/ ..., or the prediction of a network
        segments.json      the images of each window or cluster, for the report
        alignment/         edges between the submodels
        stitched/          cameras as stitching placed them, one depth map per image
        track_pairs/       image pairs that the stitched geometry suggests for tracks
        refined/           0/model  1/model ...  database.db  refinements.json  uncertainties.json
        carried_depth/     one depth map per image that is no keyframe
        scene/             the adjusted cameras and fused clouds, before they are exported
        finished.json      when all stages stand: which of them belong together, and where the images are

A stage is a folder. It is written as ``NAME.partial`` and renamed, with a ``stage.json`` that
holds the key: a hash of its inputs and settings. A folder whose key is as expected is finished and
is read; any other is made again. What failed is not stored under the key of what was wanted, so the
next start tries it again. Arrays are safetensors, facts are JSON, nothing is pickled.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import safetensors
import safetensors.numpy
from filelock import FileLock, Timeout

from smust3r_colmap.errors import RunDirectoryError, RunLockedError, StorageError
from smust3r_colmap.storage.atomic_write import write_atomically
from smust3r_colmap.storage.digest import digest_of

IMPORT_STAGE, STITCHED_STAGE, REFINED_STAGE, SCENE_STAGE = "import", "stitched", "refined", "scene"
CARRIED_DEPTH_STAGE = "carried_depth"
"""Folders below ``work`` that are read again when a finished run is exported."""
FRAMES_STAGE = "frames"
"""Below ``work``: for each set of videos a folder of images."""
FINISHED_FILE = "finished.json"
"""Below ``work``: when all stages stand, which of them belong together."""
UNCERTAINTY_FILE = "poses_uncertainty.csv"
"""Among the results."""
MODEL_FOLDER, DATABASE_FILE = "model", "database.db"
"""Of the refinement: the model of each scene, and the database that goes with all of them."""

FORMAT_VERSION = 4
"""Part of every key; a change of what a stage stores or computes raises it."""

_LOCK_WAIT_S = 3.0
"""A killed run's lock lives on for a moment in a child that it was just starting, and so do its children."""

_STAGE_FILE = "stage.json"


class RunDirectory:
    """The output folder of one run, held by one process at a time.

    Args:
        root: made when missing.

    Raises:
        RunLockedError: another living process holds it, and goes on holding it for some seconds.
        RunDirectoryError: the path is a file, or a folder with other things in it.
        StorageError: the disk refused.
    """

    RESULTS = (
        "points.ply",
        "scene.glb",
        "trajectory_tum.txt",
        "trajectory_without_loops_tum.txt",
        "trajectory_stitched_tum.txt",
        UNCERTAINTY_FILE,
        "database.db",
        "trainer",
        "dense",
        "summary.json",
        "config.toml",
        *(f"geo/{name}" for name in ("geo.json", "cameras.geojson", "gcps.geojson")),
        "report.html",
    )

    def __init__(self, root: Path) -> None:
        self.root = root
        with storage_errors(root):
            if root.is_symlink() and not root.exists():
                raise RunDirectoryError(f"{root}: is a link to {root.readlink()}, which is not there; name a folder")
            if root.exists() and not root.is_dir():
                raise RunDirectoryError(f"{root}: is a file; --output must name a folder")
        lock = self.work / "lock"
        self._lock = FileLock(lock)
        with storage_errors(root):
            # A folder "work" alone proves nothing: `start_over` would empty somebody else's.
            if root.is_dir() and any(root.iterdir()) and not lock.exists() and not _is_empty_folder(self.work):
                raise RunDirectoryError(f"{root}: is not empty and was not made by this program; name another folder")
            self.work.mkdir(parents=True, exist_ok=True)
            try:
                self._lock.acquire(timeout=_LOCK_WAIT_S)
            except Timeout:
                raise RunLockedError(f"{root}: another process is writing here; wait for it or stop it") from None
            for left_over in self.work.rglob("*.partial*"):
                _remove(left_over)

    def __enter__(self) -> RunDirectory:
        return self

    def __exit__(self, *exc: object) -> None:
        self._lock.release()

    @property
    def work(self) -> Path:
        """Intermediate products, kept so that the next start can go on."""
        return self.root / "work"

    @property
    def native_log(self) -> Path:
        """Messages of native code in the child processes."""
        return self.work / "native.log"

    def stage(self, *names: str, key: str) -> StageFolder:
        """The stage at ``work/NAMES...`` that is finished only under this key."""
        return StageFolder(path=self.work.joinpath(*names), key=key)

    def check_space(self, what: str, num_bytes: int) -> None:
        """Refuse to begin what the disk has no room for.

        Args:
            what: is about to be written, as a plural.
            num_bytes: an estimate of its size.

        Raises:
            StorageError: less is free; it names both.
        """
        with storage_errors(self.root):
            free = shutil.disk_usage(self.root).free
        if free < num_bytes:
            raise StorageError(
                f"{self.root}: {what} need about {num_bytes / 2**20:.0f} MiB, and {free / 2**20:.0f} MiB are free; "
                "finished stages are kept, and with more room the same command goes on"
            )

    def sparse_model(self, index: int) -> Path:
        """Folder of the COLMAP model number ``index``."""
        return self.root / "sparse" / str(index)

    def clear_results(self, model_files: Collection[str] = ()) -> None:
        """Remove the results of an earlier run, so that none of them outlives its inputs.

        Of ``sparse`` only ``model_files``, what COLMAP models are made of; what somebody else put there stays.
        """
        with storage_errors(self.root):
            for name in self.RESULTS:
                _remove(self.root / name)
            for path in self.root.glob("sparse/*/*"):
                if path.parent.name.isdigit() and path.name in model_files:
                    _remove(path)
            for folder in self.root.glob("sparse/*"):
                if folder.is_dir() and not any(folder.iterdir()):
                    folder.rmdir()

    def start_over(self, model_files: Collection[str]) -> None:
        """Throw away what an earlier run left: its results, as ``clear_results`` does, and ``work`` but for frames."""
        self.clear_results(model_files)
        with storage_errors(self.work):
            for path in self.work.iterdir():
                if path.name not in ("lock", FRAMES_STAGE):
                    _remove(path)

    def keep_frames(self, images: Path) -> None:
        """Throw away the frames of videos that an earlier run took, unless they are the images of this one."""
        with storage_errors(self.work):
            for path in self.work.glob(f"{FRAMES_STAGE}/*"):
                if path != images:
                    _remove(path)


class StageFolder:
    """One folder that is either finished under its key or not there at all."""

    def __init__(self, *, path: Path, key: str) -> None:
        self.path = path
        self.key = key

    @property
    def is_done(self) -> bool:
        """The folder is complete and was made from the same inputs and settings."""
        try:
            facts = json.loads((self.path / _STAGE_FILE).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return False
        return isinstance(facts, dict) and facts.get("key") == self.key

    @contextmanager
    def write(self) -> Iterator[Path]:
        """A folder to write into; it becomes the stage when the block ends without an error.

        It may be called in a child process. The name carries the process id, so that a child that
        outlives a killed parent by a moment cannot touch what the next run writes.
        """
        partial = self.path.with_name(f"{self.path.name}.partial-{os.getpid()}")
        with storage_errors(self.path):
            _remove(partial)
            partial.mkdir(parents=True)
            yield partial
            (partial / _STAGE_FILE).write_text(_json({"key": self.key}), encoding="utf-8")
            _remove(self.path)
            os.replace(partial, self.path)

    def open_in_place(self) -> Path:
        """For a store with transactions of its own: the folder, emptied if its key is another's."""
        with storage_errors(self.path):
            if not self.is_done:
                _remove(self.path)
                self.path.mkdir(parents=True)
                write_json(self.path / _STAGE_FILE, {"key": self.key})
        return self.path


def key_of(*parts: object) -> str:
    """A hash of inputs and settings (JSON-able values, dataclasses, other keys)."""
    text = json.dumps([FORMAT_VERSION, *parts], sort_keys=True, default=_hashable, ensure_ascii=False)
    return digest_of(text.encode())


def write_json(path: Path, facts: object) -> None:
    """Write ``facts`` as JSON, atomically."""
    write_atomically(path, _json(facts).encode())


def read_json(path: Path) -> Any:
    """The JSON in ``path``; StorageError when it cannot be read."""
    with storage_errors(path), _damage_named(path):
        return json.loads(path.read_text(encoding="utf-8"))


def write_arrays(path: Path, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Write named arrays as one safetensors file."""
    with storage_errors(path):
        safetensors.numpy.save_file({name: np.ascontiguousarray(value) for name, value in arrays.items()}, path)


def read_arrays(path: Path) -> dict[str, npt.NDArray[Any]]:
    """All arrays of a safetensors file, in memory."""
    with storage_errors(path), _damage_named(path):
        return dict(safetensors.numpy.load_file(path))


def read_array(path: Path, name: str) -> npt.NDArray[Any]:
    """One array of a safetensors file; the others are not read."""
    with storage_errors(path), _damage_named(path), safetensors.safe_open(path, framework="numpy") as file:
        array: npt.NDArray[Any] = file.get_tensor(name)
        return array


@contextmanager
def storage_errors(path: Path) -> Iterator[None]:
    """Turn what the disk refuses into a StorageError that names the path."""
    try:
        yield
    except OSError as error:
        raise StorageError(f"{path}: {error.strerror or error}; finished stages are kept") from error
    except safetensors.SafetensorError as error:
        raise StorageError(f"{path}: {error}; finished stages are kept") from error


@contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    """A finished stage that cannot be read stays so at every start: say the way out."""
    try:
        yield
    except (ValueError, safetensors.SafetensorError) as error:
        raise StorageError(f"{path}: is damaged ({error}); delete {path.parent} or start with --overwrite") from error


def _is_empty_folder(path: Path) -> bool:
    return path.is_dir() and not any(path.iterdir())


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _hashable(value: object) -> object:
    """As ``_jsonable``, but arrays by the hash of their bytes, and dataclasses with arrays inside."""
    if isinstance(value, np.ndarray):
        return [str(value.dtype), value.shape, digest_of(value.tobytes())]
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in fields(value)}
    return _jsonable(value)


def _json(facts: object) -> str:
    return json.dumps(facts, indent=1, default=_jsonable, ensure_ascii=False, allow_nan=False) + "\n"


def _jsonable(value: object) -> object:
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not JSON")
