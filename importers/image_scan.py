"""What was read of the image folder, on disk, so that a later start decodes changed files only."""

from __future__ import annotations

from pathlib import Path

from smust3r_colmap.importers.image_folder import FolderScan, ImportRecord, scan_image_folder
from smust3r_colmap.storage.run_directory import IMPORT_STAGE, RunDirectory, StageFolder, key_of, read_json, write_json


def scan_changed_files(images: Path, run: RunDirectory, *, overwrite: bool, workers: int) -> FolderScan:
    """Scan the folder; unless ``overwrite``, files that did not change since an earlier start are not decoded again."""
    stored = _stage(run)
    known = {}
    if stored.is_done and not overwrite:
        records = (ImportRecord.from_json(facts) for facts in read_json(stored.path / "records.json"))
        known = {record.name: record for record in records}
    return scan_image_folder(images, known=known, workers=workers)


def store_scan(scan: FolderScan, run: RunDirectory) -> None:
    """For later starts, and to know the images of a finished run again."""
    with _stage(run).write() as folder:
        write_json(folder / "records.json", [record.to_json() for record in scan.records])


def _stage(run: RunDirectory) -> StageFolder:
    return run.stage(IMPORT_STAGE, key=key_of(IMPORT_STAGE))
