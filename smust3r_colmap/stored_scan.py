"""What was read of the image folder, on disk, so that a later start decodes changed files only."""

from __future__ import annotations

from pathlib import Path

from smust3r_colmap.importers.image_folder import FolderScan, ImportRecord, scan_image_folder
from smust3r_colmap.run_directory import RunDirectory, key_of, read_json, write_json


def scan_changed_files(images: Path, run: RunDirectory, *, workers: int) -> FolderScan:
    """Scan the folder; files that did not change since an earlier start of the run are not decoded again."""
    stored = run.stage("import", key=key_of("import"))
    known = {}
    if stored.is_done:
        records = (ImportRecord.from_json(facts) for facts in read_json(stored.path / "records.json"))
        known = {record.name: record for record in records}
    scan = scan_image_folder(images, known=known, workers=workers)
    with stored.write() as folder:
        write_json(folder / "records.json", [record.to_json() for record in scan.records])
    return scan
