"""What was read of the image folder, on disk, so that a later start decodes changed files only."""

from __future__ import annotations

from pathlib import Path

from smust3r_colmap.importers.image_folder import FolderScan, ImportRecord, scan_image_folder
from smust3r_colmap.storage.codec import Codec
from smust3r_colmap.storage.run_directory import IMPORT_STAGE, RunDirectory, StageFolder, key_of

RECORDS: Codec[tuple[ImportRecord, ...]] = Codec(tuple[ImportRecord, ...], "records")
"""In the folder of the stage: one record for each file that could be read."""


def scan_changed_files(images: Path, run: RunDirectory, *, overwrite: bool, workers: int) -> FolderScan:
    """Scan the folder; unless ``overwrite``, files that did not change since an earlier start are not decoded again."""
    stored = _stage(run)
    records = RECORDS.read(stored.path) if stored.is_done and not overwrite else ()
    return scan_image_folder(images, known={record.name: record for record in records}, workers=workers)


def store_scan(scan: FolderScan, run: RunDirectory) -> None:
    """For later starts, and to know the images of a finished run again."""
    with _stage(run).write() as folder:
        RECORDS.write(folder, scan.records)


def is_of_another_version(run: RunDirectory) -> bool:
    """Whether the folder holds a scan, and with it products, that another version of this program wrote."""
    stored = _stage(run)
    return stored.path.exists() and not stored.is_done


def _stage(run: RunDirectory) -> StageFolder:
    return run.stage(IMPORT_STAGE, key=key_of(IMPORT_STAGE))
