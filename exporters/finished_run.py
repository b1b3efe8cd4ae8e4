"""A finished run, opened again to write its results in other formats; nothing is computed anew.

The products of a run lie in its ``work`` folder. ``work/finished.json`` is written when all stages are done and says
which of them belong together. The next module to read is ``registry``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from smust3r_colmap.colmap.model_files import MODEL_FILES
from smust3r_colmap.errors import CollectionError, ImageError, InputError, RunDirectoryError
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.importers.image_folder import FolderScan, ImportRecord, bits_in_use
from smust3r_colmap.importers.image_scan import RECORDS, is_of_another_version, store_scan
from smust3r_colmap.importers.masks import MaskSet, check_masks
from smust3r_colmap.products import DepthMaps, Scene
from smust3r_colmap.storage.codec import Codec
from smust3r_colmap.storage.depth_maps import depth_maps_of_run
from smust3r_colmap.storage.digest import digest_of
from smust3r_colmap.storage.run_directory import (
    DATABASE_FILE,
    FINISHED_FILE,
    FORMAT_VERSION,
    IMPORT_STAGE,
    MODEL_FOLDER,
    REFINED_STAGE,
    SCENE_STAGE,
    RunDirectory,
    read_json,
    storage_errors,
)
from smust3r_colmap.storage.scenes import FUSED_SCENES


@dataclass(frozen=True, kw_only=True)
class _Parts:
    """What ``finished.json`` says: which version wrote it, and which products belong together."""

    format_version: int
    images: Path
    with_tracks: tuple[bool, ...]
    with_maps: bool
    masks: MaskSet | None
    timestamps_s: Mapping[str, float] = field(default_factory=dict)


_PARTS: Codec[_Parts] = Codec(_Parts, "finished")


@dataclass(frozen=True, kw_only=True, eq=False)
class FinishedRun:
    """All that formats are written from.

    Args:
        output: the folder that results go to, in most cases the run's own.
        native_log: for the messages of native code.
        images: the folder of the original images.
        scenes: largest first, with their clouds.
        models: one per scene, folder of the COLMAP model with tracks, or None where there are none.
        database: that goes with the models, or None.
        maps: depth of the images, or None.
        masks: those that the run was made with, or None.
        timestamps_s: capture times of the images that have one, by name.
        bits: that images with more than 8 bits a channel are scaled by, by name.
    """

    output: Path
    native_log: Path
    images: Path
    scenes: tuple[Scene, ...]
    models: tuple[Path | None, ...]
    database: Path | None
    maps: DepthMaps | None
    masks: MaskSet | None = None
    timestamps_s: Mapping[str, float] = field(default_factory=dict)
    bits: Mapping[str, int] = field(default_factory=dict)

    def sparse_model(self, number: int) -> Path:
        """Where the COLMAP model number ``number`` goes."""
        return self.output / "sparse" / str(number)


def write_finished(run: RunDirectory, finished: FinishedRun) -> None:
    """Record that the run is complete, where its images are and which parts it has."""
    masks = finished.masks
    parts = _Parts(
        format_version=FORMAT_VERSION,
        images=finished.images.resolve(),
        with_tracks=tuple(model is not None for model in finished.models),
        with_maps=finished.maps is not None,
        masks=None if masks is None else replace(masks, folder=masks.folder.resolve()),
        timestamps_s=finished.timestamps_s,
    )
    _PARTS.write(run.work, parts)


def begin_stages(run: Run, scan: FolderScan, *, overwrite: bool) -> None:
    """Call before the stages change: until the run ends again, they do not belong together.

    Call it after the input was checked, because the folder may hold a finished run.

    Args:
        scan: of the image folder.
        overwrite: delete all products of an earlier run.
    """
    if overwrite:
        run.folder.start_over(MODEL_FILES)
    elif is_of_another_version(run.folder):
        run.clock.note(f"{run.folder.work}: was written by another version; everything is computed again")
    run.folder.keep_frames(scan.folder)
    with storage_errors(run.folder.work):
        (run.folder.work / FINISHED_FILE).unlink(missing_ok=True)
    store_scan(scan, run.folder)


def check_is_finished(root: Path) -> None:
    """Refuse a folder that holds no finished run, before it is locked and thereby touched.

    Raises:
        InputError: there is no such folder, or no finished run in it.
    """
    if not root.is_dir():
        raise InputError(f"{root}: there is no such folder; give the output folder of reconstruct or refine")
    if not (root / "work" / "lock").is_file():
        raise InputError(f"{root}: is no run of this program, for it has no work folder of one")
    if not (root / "work" / FINISHED_FILE).is_file():
        raise InputError(
            f"{root}: the run is not finished; start the reconstruct or refine that made it again, it goes on"
        )


def open_finished(run: RunDirectory, *, images: Path | None = None, output: Path | None = None) -> FinishedRun:
    """What the run has stored.

    Args:
        run: locked by this process; see ``check_is_finished``.
        images: the folder of the images, where it has moved since.
        output: where results go instead of the run's folder.

    Raises:
        RunDirectoryError: the run was made by another version.
        StorageError: a stage cannot be read.
    """
    parts = _read_parts(run)
    refined = run.work / REFINED_STAGE
    return FinishedRun(
        output=run.root if output is None else output,
        native_log=run.native_log,
        images=parts.images if images is None else images,
        scenes=tuple(one.scene for one in FUSED_SCENES.read(run.work / SCENE_STAGE)),
        models=tuple(refined / str(k) / MODEL_FOLDER if has else None for k, has in enumerate(parts.with_tracks)),
        database=refined / DATABASE_FILE if any(parts.with_tracks) else None,
        maps=depth_maps_of_run(run.work) if parts.with_maps else None,
        masks=parts.masks,
        timestamps_s=parts.timestamps_s,
        bits=bits_in_use(RECORDS.read(run.work / IMPORT_STAGE)),
    )


def image_folder_of(run: RunDirectory) -> Path:
    """Where the images of a finished run were.

    Raises:
        RunDirectoryError, StorageError: as ``open_finished``.
    """
    return _read_parts(run).images


def _read_parts(run: RunDirectory) -> _Parts:
    path = run.work / FINISHED_FILE
    facts = read_json(path)
    if not isinstance(facts, dict) or facts.get("format_version") != FORMAT_VERSION:
        raise RunDirectoryError(f"{path}: was written by another version; start the same command again")
    try:
        return _PARTS.read(run.work)
    except (KeyError, TypeError, AttributeError) as error:
        raise RunDirectoryError(f"{path}: is damaged ({error}); start the same command again") from error


# -------------------------------------------------------------------- images and masks
def check_images(run: RunDirectory, finished: FinishedRun) -> None:
    """Refuse images other than those of the run: their pixels would not fit its cameras.

    A file of the same size that was touched since is compared by its content.

    Raises:
        CollectionError: the folder is gone.
        ImageError: a file is gone, or another one now.
    """
    if not finished.images.is_dir():
        raise CollectionError(f"{finished.images}: the images are not there any more; say with --images where they are")
    known = {record.name: record for record in RECORDS.read(run.work / IMPORT_STAGE)}
    for name in _names(finished.scenes):
        _check_image(finished.images / name, known[name])


def check_masks_of_run(finished: FinishedRun) -> None:
    """Refuse masks other than those of the run, for formats that contain them.

    Raises:
        InputError, ImageError: as ``check_masks``; the message names ``--masks``.
    """
    if finished.masks is not None:
        check_masks(finished.masks, _names(finished.scenes))


def _names(scenes: Iterable[Scene]) -> list[str]:
    return list(dict.fromkeys(name for scene in scenes for name in scene.image_names))


def _check_image(path: Path, record: ImportRecord) -> None:
    try:
        status = path.stat()
        if (status.st_size, status.st_mtime_ns) == (record.size_bytes, record.mtime_ns):
            return
        same = status.st_size == record.size_bytes and digest_of(path.read_bytes()) == record.digest
    except FileNotFoundError as error:
        raise ImageError(f"{record.name}: is not in {path.parent} any more; say with --images where it is") from error
    except OSError as error:
        raise ImageError(f"{path}: cannot be read ({error.strerror})") from error
    if not same:
        raise ImageError(
            f"{path}: has changed since the run ({record.size_bytes} bytes then, {status.st_size} now); "
            "put the old file back, or reconstruct again"
        )
