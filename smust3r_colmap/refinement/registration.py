"""Registration of images without a pose by COLMAP's incremental mapper on the refined model.

The refinement has already tried each image once, by the points of a model that was adjusted only coarsely. Here the
mapper continues the refined model with all its methods: it estimates poses from points, or without points from the
cameras nearby, triangulates, adjusts what is new, and tries the next image. Existing poses are fixed. The mapper runs
in a child process of its own: if it crashes, nothing is added.
The next module to read is ``global_refinement``.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from smust3r_colmap.colmap.reconstruction import poses_of
from smust3r_colmap.execution.task_pool import TaskFailure, in_child
from smust3r_colmap.refinement.acceptance import (
    lost_observations_reason,
    movement,
    num_good_observations,
    report_of,
)
from smust3r_colmap.refinement.statistics import MIN_OBSERVATIONS, Statistics, StepReport, weak_images

Agrees = Callable[[pycolmap.Reconstruction, int], bool]

NAME = "image registration"
MAX_MOVED_PERCENT = 1e-6
"""Of the path's extent, that rounding may move an existing camera."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageRegistration:
    """The result of ``register_images``.

    Args:
        model: with the new images, or the given model if nothing was added.
        registered: ids of the new images, ascending.
        report: of the step.
    """

    model: pycolmap.Reconstruction
    registered: tuple[int, ...]
    report: StepReport


@dataclass(frozen=True, kw_only=True)
class MappingTask:
    """A model to be continued on a database, and an existing folder for the result."""

    model: Path
    database: Path
    output: Path
    constant_cameras: frozenset[int]
    threads: int


def continue_mapping(task: MappingTask) -> None:
    """Run COLMAP's incremental mapper with fixed poses and intrinsics; in the child process."""
    options = pycolmap.IncrementalPipelineOptions()
    options.fix_existing_frames = True
    options.constant_cameras = set(task.constant_cameras)
    options.multiple_models = False
    options.extract_colors = False
    options.num_threads = task.threads
    options.random_seed = 0
    pycolmap.incremental_mapping(task.database, task.model.parent, task.output, options=options, input_path=task.model)


def register_images(
    model: pycolmap.Reconstruction,
    database: Path,
    *,
    agrees: Agrees,
    scratch: Path,
    threads: int,
    run_mapper: Callable[[MappingTask], None] = continue_mapping,
) -> ImageRegistration:
    """Let COLMAP's incremental mapper register images of the database that have no pose in the model.

    Poses and intrinsics of the model are fixed; its points may move by the new observations. A new image with fewer
    than ``MIN_OBSERVATIONS``, or whose matches contradict its pose, is de-registered again. The result is rejected if
    no image is left, or if the existing model became worse.

    Args:
        model: adjusted, with tracks; it is not changed.
        database: with the ids of the model and its keypoints, and verified matches of the images without a pose.
        agrees: whether most matches of an image, by its id, agree with its pose in a model; look-alike places can
            have enough points.
        scratch: an existing folder for temporary files.
        threads: of pycolmap; with one the result is the same in every run.
        run_mapper: what runs in the child process.
    """
    before = Statistics.of(model)

    def rejected(reason: str) -> ImageRegistration:
        report = report_of(NAME, before, before, np.zeros(0), np.zeros(0), reason)
        return ImageRegistration(model=model, registered=(), report=report)

    with tempfile.TemporaryDirectory(dir=scratch) as folder:
        task = MappingTask(
            model=Path(folder) / "before",
            database=database,
            output=Path(folder) / "after",
            constant_cameras=frozenset(model.image(i).camera_id for i in model.reg_image_ids()),
            threads=threads,
        )
        task.model.mkdir()
        task.output.mkdir()
        model.write_binary(task.model)
        failure = in_child(run_mapper, task)
        if isinstance(failure, TaskFailure):
            return rejected(f"COLMAP's mapper failed: {failure.reason}")
        continued = pycolmap.Reconstruction(task.output)
    _restore_lost_images(continued, model)
    _deregister_doubtful_images(continued, model, agrees)
    registered = tuple(sorted(set(continued.reg_image_ids()) - set(model.reg_image_ids())))
    if not registered:
        return rejected(f"no further image has {MIN_OBSERVATIONS} observations and matches that agree with its pose")
    moved, turned = movement(poses_of(model), poses_of(continued))
    if moved.max() > MAX_MOVED_PERCENT:
        return rejected(f"the mapper moved an existing camera by {moved.max():.2g} % of the path's extent")
    if reason := lost_observations_reason(num_good_observations(model), num_good_observations(continued)):
        return rejected(reason)
    report = report_of(NAME, before, Statistics.of(continued), moved, turned)
    return ImageRegistration(model=continued, registered=registered, report=report)


def _restore_lost_images(continued: pycolmap.Reconstruction, model: pycolmap.Reconstruction) -> None:
    """The mapper drops images without observations, which keep their pose here."""
    for image_id in sorted(set(model.reg_image_ids()) - set(continued.reg_image_ids())):
        original = model.image(image_id)
        image = pycolmap.Image(name=original.name, camera_id=original.camera_id, image_id=image_id)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(point.xy) for point in original.points2D])
        continued.add_image_with_trivial_frame(image, original.cam_from_world())


def _deregister_doubtful_images(
    continued: pycolmap.Reconstruction, model: pycolmap.Reconstruction, agrees: Agrees
) -> None:
    weak = weak_images(continued)
    for image_id in sorted(set(continued.reg_image_ids()) - set(model.reg_image_ids())):
        if image_id in weak or not agrees(continued, image_id):
            continued.deregister_frame(continued.image(image_id).frame_id)
