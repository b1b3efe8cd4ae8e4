"""Images without a pose, tried once more by COLMAP's own mapper on the adjusted model.

The refinement has tried each of them once, by the points of a model that was only half adjusted. Here the mapper
goes on from the finished one, with all of its means: it estimates the pose from the points that the image sees, or
without points from the cameras beside it, triangulates, adjusts what is new and tries the next. What was there before
stays where it is. The mapper runs in a child process of its own: if it dies, nothing is added.
The next module to read is ``colmap_database``, which keeps the result for further continuations.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from smust3r_colmap.execution.task_pool import TaskFailure, in_child
from smust3r_colmap.refinement.acceptance import (
    MAX_LOST,
    StepReport,
    movement,
    num_good_observations,
    report_of,
    take_snapshot,
)
from smust3r_colmap.refinement.bundle_adjustment import ENOUGH_OBSERVATIONS, ModelFigures, figures_of, weak_images

Agrees = Callable[[pycolmap.Reconstruction, int], bool]

NAME = "completion"
MOVED_PERCENT = 1e-6
"""Of the path's extent; rounding, and nothing else, may move a camera that was there before."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Completion:
    """What came of it.

    Args:
        model: with the new images, or the given one where nothing was added.
        registered: ids of the new images, ascending.
        report: of the step.
    """

    model: pycolmap.Reconstruction
    registered: tuple[int, ...]
    report: StepReport


@dataclass(frozen=True, kw_only=True)
class _MappingTask:
    model: Path
    database: Path
    output: Path
    constant_cameras: frozenset[int]
    threads: int


def complete_model(
    model: pycolmap.Reconstruction, database: Path, *, agrees: Agrees, scratch: Path, threads: int
) -> Completion:
    """Let COLMAP's incremental mapper register images of the database that have no pose in the model.

    Poses and intrinsics that the model has stay; its points may move by what the new observations say. An image that
    ends with fewer than ``ENOUGH_OBSERVATIONS``, or whose matches deny its place, is given up again. Nothing is kept
    if no image is left, or if something that was there before became worse.

    Args:
        model: adjusted, with tracks; it is not changed.
        database: with the ids of the model and its keypoints; verified matches reach the images without a pose.
        agrees: whether most matches of an image, by its id, agree with its place in a model; look-alike places can
            have points enough.
        scratch: an existing folder for files in between.
        threads: of pycolmap; with one the result is the same in every run.
    """
    before = figures_of(model)
    with tempfile.TemporaryDirectory(dir=scratch) as folder:
        task = _MappingTask(
            model=Path(folder) / "before",
            database=database,
            output=Path(folder) / "after",
            constant_cameras=frozenset(model.image(i).camera_id for i in model.reg_image_ids()),
            threads=threads,
        )
        task.model.mkdir()
        task.output.mkdir()
        model.write_binary(task.model)
        failure = in_child(_map_on, task)
        if isinstance(failure, TaskFailure):
            return _nothing_added(model, before, f"COLMAP's mapper failed: {failure.reason}")
        completed = pycolmap.Reconstruction(task.output)
    _put_back_lost_images(completed, model)
    _give_up_doubtful_images(completed, model, agrees)
    registered = tuple(sorted(set(completed.reg_image_ids()) - set(model.reg_image_ids())))
    reason = _why_not_kept(completed, model, registered)
    if reason:
        return _nothing_added(model, before, reason)
    report = _report(completed, model, before)
    return Completion(model=completed, registered=registered, report=report)


def _map_on(task: _MappingTask) -> None:
    """In the child process."""
    options = pycolmap.IncrementalPipelineOptions()
    options.fix_existing_frames = True
    options.constant_cameras = set(task.constant_cameras)
    options.multiple_models = False
    options.extract_colors = False
    options.num_threads = task.threads
    options.random_seed = 0
    pycolmap.incremental_mapping(task.database, task.model.parent, task.output, options=options, input_path=task.model)


def _put_back_lost_images(completed: pycolmap.Reconstruction, model: pycolmap.Reconstruction) -> None:
    """The mapper drops images without a single observation; their place is known all the same."""
    for image_id in sorted(set(model.reg_image_ids()) - set(completed.reg_image_ids())):
        original = model.image(image_id)
        image = pycolmap.Image(name=original.name, camera_id=original.camera_id, image_id=image_id)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(point.xy) for point in original.points2D])
        completed.add_image_with_trivial_frame(image, original.cam_from_world())


def _give_up_doubtful_images(
    completed: pycolmap.Reconstruction, model: pycolmap.Reconstruction, agrees: Agrees
) -> None:
    weak = weak_images(completed)
    for image_id in sorted(set(completed.reg_image_ids()) - set(model.reg_image_ids())):
        if image_id in weak or not agrees(completed, image_id):
            completed.deregister_frame(completed.image(image_id).frame_id)


def _why_not_kept(
    completed: pycolmap.Reconstruction, model: pycolmap.Reconstruction, registered: tuple[int, ...]
) -> str:
    """In words, or empty where images were added and nothing became worse."""
    if not registered:
        return f"no further image has a place on {ENOUGH_OBSERVATIONS} points that its matches agree with"
    before = take_snapshot(model)
    moved, _ = movement(completed, before.rig_from_world)
    if moved.max() > MOVED_PERCENT:
        return f"the mapper moved a camera that was placed before by {moved.max():.2g} % of the path's extent"
    good = num_good_observations(completed)
    if good < (1 - MAX_LOST) * before.num_good:
        return f"only {good} of {before.num_good} good observations stayed good"
    return ""


def _report(completed: pycolmap.Reconstruction, model: pycolmap.Reconstruction, before: ModelFigures) -> StepReport:
    moved, turned = movement(completed, take_snapshot(model).rig_from_world)
    return report_of(NAME, before, figures_of(completed), moved, turned)


def _nothing_added(model: pycolmap.Reconstruction, before: ModelFigures, reason: str) -> Completion:
    report = report_of(NAME, before, before, np.zeros(0), np.zeros(0), reason)
    return Completion(model=model, registered=(), report=report)
