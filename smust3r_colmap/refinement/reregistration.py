"""Re-registration of misregistered images.

Stitching bends a segment where few points connect its images: a step straight ahead into the distance, the end of a
walk. Bundle adjustment does not correct this, because the images beyond the bend see their own points without error.
Resection does not correct it either, because points across the bend are few and far. So misregistered images are
mapped again, together with the images they match in the rest of the model, by COLMAP's global mapper, which estimates
rotations from pairs alone. The next module to read is ``principal_point``.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pycolmap

from smust3r_colmap.colmap.database import write_colmap_database
from smust3r_colmap.colmap.reconstruction import cameras_of, poses_of
from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.evaluation.trajectory import compare_trajectories
from smust3r_colmap.execution.task_pool import TaskFailure, in_child
from smust3r_colmap.features.guided_verification import (
    MIN_INLIER_FRACTION,
    MIN_MATCHES,
    MIN_VERIFIED,
    MatchedFeatures,
    View,
    inlier_fractions,
)
from smust3r_colmap.geometry.arrays import FloatArray, Pair
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.importers.model_poses import read_model_poses
from smust3r_colmap.refinement.acceptance import movement, report_of
from smust3r_colmap.refinement.bundle_adjustment import Tolerance, triangulate
from smust3r_colmap.refinement.mapper import FINE_TOLERANCE_FRACTION, MapperSession
from smust3r_colmap.refinement.misregistration import MIN_SUPPORTING_FRACTION, EpipolarSupport, find_misregistered
from smust3r_colmap.refinement.statistics import Statistics, StepReport

logger = logging.getLogger(__name__)

NAME = "re-registration"
MAX_NEIGHBOURS = 24
"""Images of the rest of the model that are mapped along, those with most matches first; they define the frame."""
MAX_MISREGISTERED = 60
"""With more, the model itself is in doubt, and mapping them takes the global mapper too long."""


def reregister_images(
    session: MapperSession,
    tolerance: Tolerance,
    *,
    map_images: Callable[[MapperSession, Collection[int]], dict[int, FloatArray]] | None = None,
) -> StepReport | None:
    """Find misregistered images, map them again, and accept the new poses if the matches fit them better.

    After an accepted step the session is verified and triangulated at the new poses.

    Args:
        session: with tracks, adjusted once; gets the report of the step.
        tolerance: of the tracks that the images get.
        map_images: gives new (3, 4) ``cam_from_world`` of the images; ``map_with_neighbours`` by default.

    Returns:
        The report; None if no image is misregistered.
    """
    poses, statistics = poses_of(session.model), Statistics.of(session.model)
    before = _support(session, poses)
    wrong = find_misregistered(before, poses.keys())
    if not wrong:
        return None
    found: dict[int, FloatArray] = {}
    if len(wrong) > MAX_MISREGISTERED:
        reason = f"more than {MAX_MISREGISTERED}, the limit of re-registration"
    else:
        found = (map_images or map_with_neighbours)(session, wrong)
        reason = "the global mapper does not connect them with their neighbours"
    if found:
        reason = _rejection_reason(before, _support(session, {**poses, **found}), wrong, poses.keys())
    if not reason:
        session.move_images(found)
        session.verify(FINE_TOLERANCE_FRACTION)
        triangulate(session.mapper, tolerance)
    reason = reason and f"{len(wrong)} misregistered images: {reason}; kept the old poses"
    moved, turned = movement(poses, poses_of(session.model))
    report = report_of(NAME, statistics, Statistics.of(session.model), moved, turned, reason)
    session.steps.append(report)
    return report


def any_misregistered(session: MapperSession) -> bool:
    """Whether the model has misregistered images now; later adjustments may have corrected them."""
    poses = poses_of(session.model)
    return bool(find_misregistered(_support(session, poses), poses.keys()))


def _support(session: MapperSession, poses: Mapping[int, FloatArray]) -> dict[Pair, EpipolarSupport]:
    return pair_support(session.features, session.views(poses))


def pair_support(features: MatchedFeatures, views: Mapping[int, View]) -> dict[Pair, EpipolarSupport]:
    """How the verified matches of all pairs fit the cameras, by image index; few matches say nothing."""
    fractions = inlier_fractions(features, views, tolerance=FINE_TOLERANCE_FRACTION, min_matches=MIN_MATCHES)
    return {
        pair: EpipolarSupport(num_matches=len(features.verified[pair]), inlier_fraction=fraction)
        for pair, fraction in fractions.items()
    }


def _rejection_reason(
    before: Mapping[Pair, EpipolarSupport],
    after: Mapping[Pair, EpipolarSupport],
    wrong: Collection[int],
    images: Collection[int],
) -> str:
    """Why the new poses are rejected; empty if they are accepted.

    More matches must fit than before, and no pair that fitted may be contradicted: look-alike places would gain many
    matches and lose the few true ones.
    """
    around = [pair for pair in before if not set(pair).isdisjoint(wrong)]
    old, new = (round(sum(one[p].inlier_fraction * one[p].num_matches for p in around)) for one in (before, after))
    if new <= old:
        return f"{new} matches fit the new poses, {old} the old"
    lost = [
        pair
        for pair in around
        if before[pair].inlier_fraction >= MIN_SUPPORTING_FRACTION and after[pair].inlier_fraction < MIN_INLIER_FRACTION
    ]
    if lost:
        return f"the new poses contradict {len(lost)} pairs that fit the old"
    still = set(wrong) & set(find_misregistered(after, images))
    return f"{len(still)} are misregistered at the new poses, too" if still else ""


# ------------------------------------------------------------------- global mapping
@dataclass(frozen=True, kw_only=True)
class _MappingTask:
    database: Path
    output: Path
    threads: int


def map_with_neighbours(session: MapperSession, wrong: Collection[int]) -> dict[int, FloatArray]:
    """(3, 4) ``cam_from_world`` of those of the images that the global mapper connects with their neighbours."""
    poses, features = poses_of(session.model), session.features
    together = {*wrong, *_neighbours(wrong, poses.keys(), features)}
    matches = {
        pair: rows for pair, rows in features.verified.items() if set(pair) <= together and len(rows) >= MIN_VERIFIED
    }
    cameras = [replace(one, has_prior_focal=True) for one in cameras_of(session.model, session.collection.cameras)]
    with tempfile.TemporaryDirectory(dir=session.scratch) as folder:
        task = _MappingTask(database=Path(folder) / "database.db", output=Path(folder), threads=session.threads)
        write_colmap_database(
            task.database,
            session.collection,
            cameras,
            keypoints=features.keypoints,
            matches=matches,
            j_from_i={},
            priors=(),
        )
        succeeded = in_child(_map_globally, task)
        if isinstance(succeeded, TaskFailure):
            logger.warning("the global mapper failed on %d misregistered images: %s", len(wrong), succeeded.reason)
            return {}
        if not succeeded:
            return {}
        mapped = read_model_poses(task.output)
    return _in_world(mapped, poses, wrong, [image.name for image in session.collection.images])


def _map_globally(task: _MappingTask) -> bool:
    """In the child process: write the largest model; returns whether there is one."""
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = options.mapper.num_threads = task.threads
    options.random_seed = options.mapper.random_seed = 0
    options.mapper.global_positioning.use_gpu = options.mapper.bundle_adjustment.ceres.use_gpu = False
    # The model's intrinsics were adjusted on more images than these.
    options.mapper.bundle_adjustment.refine_focal_length = False
    options.mapper.bundle_adjustment.refine_extra_params = False
    models = pycolmap.global_mapping(task.database, task.output, task.output, options)
    if not models:
        return False
    max(models.values(), key=lambda model: model.num_reg_images()).write_binary(task.output)
    return True


def _in_world(
    world_from_cam: Mapping[str, FloatArray],
    poses: Mapping[int, FloatArray],
    wrong: Collection[int],
    names: Sequence[str],
) -> dict[int, FloatArray]:
    """The mapped images' poses in the model's world, by a similarity that fits the neighbours' cameras."""
    others = {names[i]: invert_rigid(pose) for i, pose in poses.items() if i not in wrong}
    try:
        world_from_mapped = compare_trajectories(world_from_cam, others).reference_from_estimated
    except DegenerateAlignmentError as error:
        logger.info("misregistered images could not be aligned with the model: %s", error)
        return {}
    return {
        i: invert_rigid(world_from_mapped.move_cameras(world_from_cam[names[i]][None])[0])
        for i in wrong
        if names[i] in world_from_cam
    }


def _neighbours(wrong: Collection[int], images: Collection[int], features: MatchedFeatures) -> list[int]:
    """The other images with most verified matches to the misregistered ones, and those nearest to them in turn."""
    counts = dict.fromkeys(sorted(set(images) - set(wrong)), 0)
    reached = set(wrong)
    for _ in range(2):
        for (i, j), rows in features.verified.items():
            for inside, outside in ((i, j), (j, i)):
                if inside in reached and outside in counts and len(rows) >= MIN_VERIFIED:
                    counts[outside] += len(rows)
        reached |= set(sorted((i for i in counts if counts[i]), key=lambda i: -counts[i])[: MAX_NEIGHBOURS // 2])
    return sorted((i for i in counts if counts[i]), key=lambda i: -counts[i])[:MAX_NEIGHBOURS]
