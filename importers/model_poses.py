"""The poses of COLMAP models, and of the folder of a run, without cameras and points."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import numpy as np

from smust3r_colmap.errors import InputError
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.importers.colmap_model import by_frame, cam_from_world_of, refuse_twins, tidy_name
from smust3r_colmap.importers.colmap_records import Fixes, holds_model, read_image_records
from smust3r_colmap.importers.pose_set import PoseSet, text_of
from smust3r_colmap.storage.run_directory import FINISHED_FILE

logger = logging.getLogger(__name__)


def read_model_poses(folder: Path) -> dict[str, FloatArray]:
    """``world_from_cam`` by name of the registered images of a COLMAP model, binary or text, in order of name.

    Poses that are not finite are none; they are counted in the log.

    Raises:
        InputError: there is no readable model in the folder, or a name comes twice; names file and line.
    """
    fixes = Fixes()
    records, poses = read_image_records(folder, fixes)
    images = [by_frame(record, poses, fixes) for record in records]
    posed = [record for record in images if np.isfinite(record.numbers).all()]
    fixes.note("poses are not finite and were left out", str(folder), len(images) - len(posed))
    names = [tidy_name(record, fixes) for record in posed]
    refuse_twins([(name, record.place) for name, record in zip(names, posed, strict=True)], "image name")
    for text in fixes.texts():
        logger.info("%s: %s", folder, text)
    found = {name: invert_rigid(cam_from_world_of(record, fixes)) for name, record in zip(names, posed, strict=True)}
    return dict(sorted(found.items()))


def read_models(path: Path) -> tuple[PoseSet, ...]:
    """The model in a folder, or all models below ``sparse``, ``reference_sparse`` or the folder itself, largest first.

    Of a run of this program also the times of its images.

    Raises:
        InputError: as ``read_model_poses``, or no image of a model has a pose.
    """
    stamps = _stamps_of_run(path)
    is_run = (path / "work").is_dir()
    found = []
    for folder in _model_folders(path):
        poses = read_model_poses(folder)
        found.append(
            PoseSet(
                layout="run" if is_run else "COLMAP model",
                place=folder,
                world_from_cam=np.array(list(poses.values())),
                names=tuple(poses),
                image_stamps=stamps,
                is_model=True,
                notes=_notes(path) if is_run else (),
            )
        )
    return tuple(sorted(found, key=lambda one: -len(one)))


def _model_folders(path: Path) -> list[Path]:
    """Where models lie; the folder itself where none do, so that reading it says so."""
    if holds_model(path):
        return [path]
    for below in (path / "sparse", path / "reference_sparse", path):
        if holds_model(below):
            return [below]
        numbered = [one for one in sorted(below.glob("*")) if one.name.isdigit() and holds_model(one)]
        if numbered:
            return numbered
    return [path]


def _notes(run: Path) -> tuple[str, ...]:
    is_finished = (run / "work" / FINISHED_FILE).is_file()
    return () if is_finished else (f"{run}: the run is not finished; its models may be those of an earlier start",)


def _stamps_of_run(run: Path) -> dict[str, float]:
    """Seconds by name, of the images of a finished run that have a time."""
    path = run / "work" / FINISHED_FILE
    if not path.is_file():
        return {}
    try:
        return {name: float(stamp_s) for name, stamp_s in json.loads(text_of(path)).get("timestamps_s", {}).items()}
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: is damaged ({error})") from error
