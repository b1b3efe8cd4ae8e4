"""Images that the model holds in a wrong place, taken out and placed again.

A segment can be bent where few points hold it together: a step straight ahead into the distance, the end of a
walk. Adjustment does not get out of it, since every bent image sees its own points without error, nor does
resection, for the points of the bend are few and far. But the verified matches across the bend tell: in a sound model
nearly all of them lie on their epipolar lines, over a bend a good part does not. So the images that no chain of
consenting pairs ties to the bulk of the model are mapped anew together with those they match in the bulk, by COLMAP's
global mapper, which takes the turns from pairs alone. The new places stand where they are tied to the bulk.
The next module to read is ``principal_point``.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.evaluation import compare_trajectories, read_reference_sparse
from smust3r_colmap.execution import TaskFailure, map_tasks
from smust3r_colmap.exporters.colmap_database import write_colmap_database
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.products import FloatArray
from smust3r_colmap.refinement.adjustment import Tolerance, triangulate
from smust3r_colmap.refinement.bench import TIGHT_PART, Bench, cameras_of, poses_of, views_of
from smust3r_colmap.refinement.correspondences import Pair
from smust3r_colmap.refinement.feature_matches import (
    MIN_VERIFIED,
    Consent,
    MatchedFeatures,
    ask_consent,
    consent_shares,
)

logger = logging.getLogger(__name__)

STRONG_MATCHES = 30
"""Verified matches of a pair that make its word count; COLMAP's own bar for registration."""
SOUND_SHARE = 0.85
"""Of a pair's verified matches, on their epipolar lines: sound models of nine collections are tied together by pairs
above 0.9; a bent street was not."""
MAX_NEIGHBOURS = 24
"""Images of the bulk that are mapped along, those with most matches first: they say where the others belong."""
MAX_BENT = 60
"""More is no bend but a model in parts, and more than the global mapper does in passing."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Replacement:
    """What came of it.

    Args:
        bench: to go on with; the given one, or one with other places, matches and tracks.
        bent: indices of the images that were found bent.
        placed: those of them that stand elsewhere now; empty where the new places are no good.
        share_before, share_after: of the verified matches of the bent images, on their epipolar lines.
    """

    bench: Bench
    bent: tuple[int, ...]
    placed: tuple[int, ...]
    share_before: float
    share_after: float

    @property
    def summary(self) -> str:
        """In words, for the report."""
        shares = f"{self.share_before:.0%} of their matches agreed, {self.share_after:.0%} with new places"
        return f"{len(self.bent)} images were bent: {shares}"


def place_bent_images_again(bench: Bench, features: MatchedFeatures, tolerance: Tolerance) -> Replacement:
    """Map bent images anew beside the bulk, and keep that if it ties all of them to it.

    Args:
        bench: adjusted once, with tracks; used up where images were placed.
        features: of the run, with all verified matches.
        tolerance: of the tracks that the images get.
    """
    poses = poses_of(bench.model)
    before = _shares(bench, poses, features)
    bent = bent_images(before, poses.keys())
    share_before = _pooled(before, bent, features)
    unchanged = Replacement(bench=bench, bent=bent, placed=(), share_before=share_before, share_after=share_before)
    if not bent or len(bent) > MAX_BENT:
        return unchanged
    found = _mapped_anew(bench, poses, bent, features)
    if not found:
        return unchanged
    moved = {**poses, **found}
    after = _shares(bench, moved, features)
    share_after = _pooled(after, bent, features)
    if share_after <= share_before or set(bent) & set(bent_images(after, poses.keys())):
        return replace(unchanged, share_after=share_after)
    for index in found:
        # Points of the old place go with it.
        frame_id = bench.model.image(index + 1).frame_id
        bench.mapper.observation_manager.deregister_frame(frame_id)
        bench.model.frame(frame_id).rig_from_world = pycolmap.Rigid3d(moved[index])
        bench.model.register_frame(frame_id)
    bench = bench.with_matches(_consent(bench, features))
    triangulate(bench.mapper, tolerance)
    return Replacement(
        bench=bench, bent=bent, placed=tuple(sorted(found)), share_before=share_before, share_after=share_after
    )


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
        (result,) = map_tasks(_map_globally, [task], workers=1)
        if isinstance(result.value, TaskFailure):
            logger.warning("the global mapper failed on %d bent images: %s", len(bent), result.value.reason)
            return {}
        if not result.value:
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


def bent_images(shares: Mapping[Pair, float], images: Collection[int]) -> tuple[int, ...]:
    """Those that no chain of sound pairs ties to the bulk, though pairs speak of them; ascending.

    Args:
        shares: by pair, the part of its matches that agree with the model.
        images: indices of all images of the model.

    Returns:
        Empty, too, where no bulk of more than half of the images is tied together: then nothing can be told.
    """
    order = np.array(sorted(images), dtype=np.int64)
    sound = np.array([pair for pair, share in shares.items() if share >= SOUND_SHARE], dtype=np.int64).reshape(-1, 2)
    rows, columns = np.searchsorted(order, sound).T
    ties = csr_array((np.ones(len(sound)), (rows, columns)), shape=(len(order), len(order)))
    _, group = connected_components(ties, directed=False)
    bulk = int(np.bincount(group).argmax())
    if 2 * np.count_nonzero(group == bulk) <= len(order):
        return ()
    spoken_of = {index for pair in shares for index in pair}
    return tuple(int(index) for index in order[group != bulk] if int(index) in spoken_of)


def _shares(bench: Bench, poses: Mapping[int, FloatArray], features: MatchedFeatures) -> dict[Pair, float]:
    views = views_of(poses, cameras_of(bench.model, bench.collection.cameras), bench.collection)
    return consent_shares(features, views, tolerance=TIGHT_PART, min_matches=STRONG_MATCHES)


def _consent(bench: Bench, features: MatchedFeatures) -> Consent:
    views = views_of(poses_of(bench.model), cameras_of(bench.model, bench.collection.cameras), bench.collection)
    return ask_consent(features, views, tolerance=TIGHT_PART)


def _pooled(shares: Mapping[Pair, float], images: Collection[int], features: MatchedFeatures) -> float:
    """Share of all verified matches of the images, over their pairs; 1 without any."""
    counts = {pair: len(features.verified[pair]) for pair in shares if not set(pair).isdisjoint(images)}
    total = sum(counts.values())
    return sum(shares[pair] * count for pair, count in counts.items()) / total if total else 1.0
