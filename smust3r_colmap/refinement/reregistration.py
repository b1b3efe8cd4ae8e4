"""Images that the model holds in a wrong place, taken out and placed again.

A segment can be bent where few points hold it together: a step straight ahead into the distance, the end of a
walk. Adjustment does not get out of it, since every bent image sees its own points without error, nor does
resection, for the points of the bend are few and far. So bent images, see ``bends``, are mapped anew together with
those they match in the bulk of the model, by COLMAP's global mapper, which takes the turns from pairs alone.
The next module to read is ``principal_point``.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pycolmap

from smust3r_colmap.colmap.database import write_colmap_database
from smust3r_colmap.colmap.reconstruction import cameras_of, poses_of
from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.evaluation.readers import read_reference_sparse
from smust3r_colmap.evaluation.trajectory import compare_trajectories
from smust3r_colmap.execution.task_pool import TaskFailure, in_child
from smust3r_colmap.features.guided_verification import (
    MIN_CONSENT,
    MIN_MATCHES,
    MIN_VERIFIED,
    MatchedFeatures,
    ask_consent,
    consent_shares,
)
from smust3r_colmap.geometry.arrays import FloatArray, Pair
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.refinement.acceptance import StepReport, movement, report_of
from smust3r_colmap.refinement.bundle_adjustment import ModelFigures, Tolerance, figures_of, triangulate
from smust3r_colmap.refinement.mapper import TIGHT_PART, Bench
from smust3r_colmap.refinement.misregistration import SOUND_SHARE, Agreement, bent_images

logger = logging.getLogger(__name__)

NAME = "images placed again"
MAX_NEIGHBOURS = 24
"""Images of the bulk that are mapped along, those with most matches first: they say where the others belong."""
MAX_BENT = 60
"""More is no bend but a model in parts, and more than the global mapper does in passing."""
_NOT_MAPPED = "{} images are bent, and the global mapper does not tie them to their neighbours"


@dataclass(frozen=True, kw_only=True, eq=False)
class Replacement:
    """What came of it.

    Args:
        bench: to go on with; the given one, or one with other places, matches and tracks.
        cam_from_world: (3, 4) of the images that stand elsewhere now, by image index.
        report: of the step; None where no image is bent.
    """

    bench: Bench
    cam_from_world: Mapping[int, FloatArray]
    report: StepReport | None


def place_bent_images_again(bench: Bench, features: MatchedFeatures, tolerance: Tolerance) -> Replacement:
    """Map bent images anew beside the bulk, and keep that if more of their matches agree and none are bent any more.

    Args:
        bench: adjusted once, with tracks; used up where images were placed.
        features: of the run, with all verified matches.
        tolerance: of the tracks that the images get.
    """
    poses, figures = poses_of(bench.model), figures_of(bench.model)
    before = _agreements(bench, poses, features)
    bent = bent_images(before, poses.keys())
    if not bent:
        return Replacement(bench=bench, cam_from_world={}, report=None)
    found: dict[int, FloatArray] = {}
    if len(bent) > MAX_BENT:
        reason = f"{len(bent)} images are bent, and more than {MAX_BENT} are not placed again"
    else:
        found = _mapped_anew(bench, poses, bent, features)
        after = _agreements(bench, {**poses, **found}, features)
        reason = _why_no_better(before, after, bent, poses.keys()) if found else _NOT_MAPPED.format(len(bent))
    if reason:
        return Replacement(bench=bench, cam_from_world={}, report=_report(bench, figures, poses, reason))
    for index, pose in found.items():
        # Points of the old place go with it.
        frame_id = bench.model.image(index + 1).frame_id
        bench.mapper.observation_manager.deregister_frame(frame_id)
        bench.model.frame(frame_id).rig_from_world = pycolmap.Rigid3d(pose)
        bench.model.register_frame(frame_id)
    bench = bench.with_matches(ask_consent(features, bench.views(), tolerance=TIGHT_PART))
    triangulate(bench.mapper, tolerance)
    return Replacement(bench=bench, cam_from_world=found, report=_report(bench, figures, poses, ""))


def are_any_bent(bench: Bench, features: MatchedFeatures) -> bool:
    """Some images of the model are bent as it stands now: what later steps adjust may straighten them."""
    poses = poses_of(bench.model)
    return bool(bent_images(_agreements(bench, poses, features), poses.keys()))


def _why_no_better(
    before: Mapping[Pair, Agreement], after: Mapping[Pair, Agreement], bent: Collection[int], images: Collection[int]
) -> str:
    """In words, or empty where the new places are better.

    More matches must agree than before, and no pair may lose the consent that it had: look-alikes of another
    place would gain many matches and lose the few true ones.
    """
    around = [pair for pair in before if not set(pair).isdisjoint(bent)]
    agreed, agree = (round(sum(one[p].share * one[p].num_matches for p in around)) for one in (before, after))
    if agree <= agreed:
        return f"{len(bent)} images are bent, and of their matches {agree} agree with new places, {agreed} with the old"
    lost = [p for p in around if before[p].share >= SOUND_SHARE and after[p].share < MIN_CONSENT]
    if lost:
        return f"{len(bent)} images are bent, and new places contradict {len(lost)} pairs that agreed with the old"
    still = set(bent) & set(bent_images(after, images))
    return f"{len(bent)} images are bent, and {len(still)} of them also in new places" if still else ""


def _report(bench: Bench, before: ModelFigures, poses: Mapping[int, FloatArray], reason: str) -> StepReport:
    old = {bench.model.image(i + 1).frame_id: pycolmap.Rigid3d(pose) for i, pose in poses.items()}
    return report_of(NAME, before, figures_of(bench.model), *movement(bench.model, old), reason)


@dataclass(frozen=True, kw_only=True)
class _MappingTask:
    database: Path
    output: Path
    threads: int


def _mapped_anew(
    bench: Bench,
    poses: Mapping[int, FloatArray],
    bent: Collection[int],
    features: MatchedFeatures,
) -> dict[int, FloatArray]:
    """(3, 4) ``cam_from_world`` of those bent images that the global mapper ties to their neighbours."""
    together = {*bent, *_neighbours(bent, poses.keys(), features)}
    matches = {
        pair: rows for pair, rows in features.verified.items() if set(pair) <= together and len(rows) >= MIN_VERIFIED
    }
    cameras = [replace(one, has_prior_focal=True) for one in cameras_of(bench.model, bench.collection.cameras)]
    with tempfile.TemporaryDirectory(dir=bench.scratch) as folder:
        task = _MappingTask(database=Path(folder) / "database.db", output=Path(folder), threads=bench.threads)
        write_colmap_database(
            task.database,
            bench.collection,
            cameras,
            keypoints=features.keypoints,
            matches=matches,
            j_from_i={},
            priors=(),
        )
        mapped = in_child(_map_globally, task)
        if isinstance(mapped, TaskFailure):
            logger.warning("the global mapper failed on %d bent images: %s", len(bent), mapped.reason)
            return {}
        if not mapped:
            return {}
        anew = read_reference_sparse(task.output)
    return _in_world_of(poses, anew, bent, [image.name for image in bench.collection.images])


def _map_globally(task: _MappingTask) -> bool:
    """In the child process: write the largest model; whether there is one."""
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = options.mapper.num_threads = task.threads
    options.random_seed = options.mapper.random_seed = 0
    options.mapper.global_positioning.use_gpu = options.mapper.bundle_adjustment.ceres.use_gpu = False
    # The model's intrinsics rest on more images than these.
    options.mapper.bundle_adjustment.refine_focal_length = False
    options.mapper.bundle_adjustment.refine_extra_params = False
    models = pycolmap.global_mapping(task.database, task.output, task.output, options)
    if not models:
        return False
    max(models.values(), key=lambda model: model.num_reg_images()).write_binary(task.output)
    return True


def _in_world_of(
    poses: Mapping[int, FloatArray], anew: Mapping[str, FloatArray], bent: Collection[int], names: Sequence[str]
) -> dict[int, FloatArray]:
    """The bent images' poses in the model's world, after a similarity that fits the neighbours' cameras."""
    bulk = {names[i]: invert_rigid(pose) for i, pose in poses.items() if i not in bent}
    try:
        world_from_anew = compare_trajectories(anew, bulk).reference_from_estimated
    except DegenerateAlignmentError as error:
        logger.info("bent images mapped anew have no place in the model: %s", error)
        return {}
    return {i: invert_rigid(world_from_anew.move_cameras(anew[names[i]][None])[0]) for i in bent if names[i] in anew}


def _neighbours(bent: Collection[int], images: Collection[int], features: MatchedFeatures) -> list[int]:
    """Images of the bulk with most verified matches to bent ones, and those nearest to them in turn."""
    counts = dict.fromkeys(sorted(set(images) - set(bent)), 0)
    reached = set(bent)
    for _ in range(2):
        for (i, j), rows in features.verified.items():
            for inside, outside in ((i, j), (j, i)):
                if inside in reached and outside in counts and len(rows) >= MIN_VERIFIED:
                    counts[outside] += len(rows)
        reached |= set(sorted((i for i in counts if counts[i]), key=lambda i: -counts[i])[: MAX_NEIGHBOURS // 2])
    return sorted((i for i in counts if counts[i]), key=lambda i: -counts[i])[:MAX_NEIGHBOURS]


def _agreements(bench: Bench, poses: Mapping[int, FloatArray], features: MatchedFeatures) -> dict[Pair, Agreement]:
    shares = consent_shares(features, bench.views(poses), tolerance=TIGHT_PART, min_matches=MIN_MATCHES)
    return {pair: Agreement(num_matches=len(features.verified[pair]), share=share) for pair, share in shares.items()}
