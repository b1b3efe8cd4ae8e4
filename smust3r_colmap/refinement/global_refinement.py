"""From initial poses and matches to refined models with tracks: the work of one child process.

    coarse   guided verification at the initial poses, triangulation with fixed poses, bundle adjustment
             (segments of large models first)
    fine     the same again at the adjusted poses with a smaller tolerance; images without a pose are registered,
             misregistered images re-registered
    final    bundle adjustment, completing tracks and filtering in turn until the cameras stop moving; then the images
             between keyframes are registered

The next module to read is ``stage``.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap

from smust3r_colmap.colmap.database import write_colmap_database
from smust3r_colmap.colmap.model_files import write_binary_checked
from smust3r_colmap.colmap.reconstruction import SparseObservations, cameras_of, poses_of
from smust3r_colmap.errors import ImageError
from smust3r_colmap.features.correspondences import Correspondences, joined
from smust3r_colmap.features.guided_verification import (
    MIN_VERIFIED,
    MatchedFeatures,
    VerifiedMatches,
    read_matched_features,
)
from smust3r_colmap.features.pointmap_matching import MappedView, match_by_pointmaps
from smust3r_colmap.geometry.arrays import FloatArray, Pair
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.importers.images import load_grey, load_rgb
from smust3r_colmap.products import DepthMaps, ImageCollection, Scene
from smust3r_colmap.refinement.acceptance import MAX_ERROR_PX
from smust3r_colmap.refinement.bundle_adjustment import Tolerance
from smust3r_colmap.refinement.contradictions import point_support
from smust3r_colmap.refinement.focal_lengths import contradicted_focal_lengths
from smust3r_colmap.refinement.mapper import (
    COARSE_TOLERANCE_FRACTION,
    FINE_TOLERANCE_FRACTION,
    MapperSession,
    agrees,
    views_of,
)
from smust3r_colmap.refinement.model_uncertainty import ModelUncertainty, adjusted_priors, measure_uncertainty
from smust3r_colmap.refinement.principal_point import estimate_principal_points
from smust3r_colmap.refinement.registration import register_images
from smust3r_colmap.refinement.reregistration import any_misregistered, pair_support, reregister_images
from smust3r_colmap.refinement.statistics import SceneRefinement, Statistics, StepReport, weak_images
from smust3r_colmap.storage.codec import Codec
from smust3r_colmap.storage.run_directory import DATABASE_FILE, MODEL_FOLDER, StageFolder

logger = logging.getLogger(__name__)

RESULTS: Codec[tuple[SceneRefinement, ...]] = Codec(tuple[SceneRefinement, ...], "refinements")
UNCERTAINTIES: Codec[tuple[ModelUncertainty, ...]] = Codec(tuple[ModelUncertainty, ...], "uncertainties")
"""How the results lie in the folder of the stage, one of each per scene."""

COARSE_ANGLE_DEG, FINE_ANGLE_DEG = 4.0, 2.0
MIN_FINE_TOLERANCE_PX = 2.6
"""Of tracks, for small images: features are not located more exactly in them."""
COARSE_MAX_ERROR_PX = 8.0
"""Of observations after the first adjustment."""
FIRST_ITERATIONS, SECOND_ITERATIONS, FINAL_ITERATIONS = 12, 30, 10
"""Upper limits; with more, the statistics of the data sets tried do not change in three digits."""
MAX_POINTMAP_KEYPOINTS = 1000
"""Corners of an image that are matched by pointmaps."""
MAX_FINAL_ROUNDS, CONVERGED_PERCENT = 4, 0.2
"""Filter and adjust again until no camera moves by more, in percent of the path's extent: an image that wrong matches
hold at a wrong pose loses them one by one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RefineTask:
    """All scenes of a run, to be refined one after the other.

    Args:
        stored: the stage that gets ``0/model``, ``1/model`` ..., ``database.db``, ``refinements.json`` and
            ``uncertainties.json``.
        collection: all images; those that are no keyframes are registered to the model when it is finished.
        scenes: with initial poses; their points are not used.
        features: the run's database of SIFT features and matches, or None.
        maps: depth by image name, to match by pointmaps, or None.
        map_pairs: image pairs to match by pointmaps.
        segments: image indices of each, for large models.
        calibrated: the intrinsics are fixed.
        threads: of pycolmap.
        tolerance: epipolar and reprojection tolerance at the initial poses, as a fraction of the longer image side.
        principal_point: refine the principal points where the model determines them.
        register_missing: let COLMAP's mapper register images without a pose in the end, in the largest model.
        initial_poses_count: see ``measure_uncertainty``.
    """

    stored: StageFolder
    collection: ImageCollection
    scenes: tuple[Scene, ...]
    features: Path | None
    maps: DepthMaps | None
    map_pairs: tuple[Pair, ...]
    segments: tuple[tuple[int, ...], ...]
    calibrated: bool
    threads: int
    tolerance: float = COARSE_TOLERANCE_FRACTION
    principal_point: bool = True
    register_missing: bool = False
    initial_poses_count: bool = False


def refine_scenes(task: RefineTask) -> tuple[SceneRefinement, ...]:
    """Refine all scenes and store their models, the common database and the results; see ``RefineTask``."""
    features = _all_features(task)
    with task.stored.write() as folder:
        outcomes: list[_Outcome] = []
        for scene in task.scenes:
            elsewhere = {i for other in task.scenes if other is not scene for i in other.image_indices}
            elsewhere |= {i for outcome in outcomes for i in poses_of(outcome.model)}
            outcomes.append(_refine_scene(task, scene, _without(elsewhere - {*scene.image_indices}, features), folder))
        if task.register_missing and outcomes[0].result.succeeded:
            outcomes[0] = _with_missing_registered(task, features, outcomes, folder)
        for number, outcome in enumerate(outcomes):
            model_folder = folder / str(number) / MODEL_FOLDER
            model_folder.mkdir(parents=True)
            write_binary_checked(outcome.model, model_folder)
        uncertainties = tuple(_uncertainty(task, features, outcome) for outcome in outcomes)
        _write_database(task, features, outcomes, uncertainties[0], folder / DATABASE_FILE)
        results = tuple(outcome.result for outcome in outcomes)
        RESULTS.write(folder, results)
        UNCERTAINTIES.write(folder, uncertainties)
    return results


@dataclass(frozen=True, kw_only=True, eq=False)
class _Outcome:
    model: pycolmap.Reconstruction
    verified: VerifiedMatches
    result: SceneRefinement


def _all_features(task: RefineTask) -> MatchedFeatures:
    """SIFT features and pointmap correspondences together; the latter need no two-view verification."""
    everything = range(len(task.collection))
    if task.features is None:
        found = MatchedFeatures(keypoints={i: np.empty((0, 2), np.float32) for i in everything}, raw={}, verified={})
    else:
        found = read_matched_features(task.features, everything)
    if task.maps is None:
        return found
    for scene in task.scenes:
        pointmaps = _matched_by_pointmaps(task.collection, scene, task.maps, task.map_pairs)
        raw = joined(Correspondences(keypoints=found.keypoints, matches=found.raw), pointmaps)
        verified = joined(Correspondences(keypoints=found.keypoints, matches=found.verified), pointmaps)
        found = MatchedFeatures(keypoints=raw.keypoints, raw=raw.matches, verified=verified.matches)
    return found


def _matched_by_pointmaps(
    collection: ImageCollection, scene: Scene, maps: DepthMaps, pairs: Sequence[Pair]
) -> Correspondences:
    views = [
        MappedView(
            index=index,
            cam_from_world=pose,
            intrinsics=scene.cameras[camera],
            depth=partial(maps.depth, name),
            confidence=partial(maps.confidence, name),
            grey=partial(load_grey, collection.images[index]),
        )
        for index, name, camera, pose in zip(
            scene.image_indices, scene.image_names, scene.camera_indices, scene.cam_from_world, strict=True
        )
        if name in maps
    ]
    there = {view.index for view in views}
    chosen = [pair for pair in pairs if pair[0] in there and pair[1] in there]
    return match_by_pointmaps(views, chosen, max_keypoints=MAX_POINTMAP_KEYPOINTS)


# ------------------------------------------------------------------------- one scene
def _refine_scene(task: RefineTask, scene: Scene, features: MatchedFeatures, scratch: Path) -> _Outcome:
    side_px = _longer_side_px(task.collection)
    coarse = Tolerance(pixels=task.tolerance * side_px, angle_deg=COARSE_ANGLE_DEG)
    fine_px = max(FINE_TOLERANCE_FRACTION * side_px, MIN_FINE_TOLERANCE_PX)
    fine = Tolerance(pixels=fine_px, angle_deg=FINE_ANGLE_DEG)
    session = MapperSession(
        task.collection,
        _without(task.collection.others, features),
        tuple(scene.cameras.get(i, prior) for i, prior in enumerate(task.collection.cameras)),
        dict(zip(scene.image_indices, scene.cam_from_world, strict=True)),
        tolerance=task.tolerance,
        calibrated=task.calibrated,
        scratch=scratch,
        threads=task.threads,
    )
    session.triangulate("triangulation", coarse)
    if not session.model.num_points3D():
        reason = "no point could be triangulated: too few matches, or a camera that only rotated"
        return _outcome(task, session, reason=reason)
    session.adjust_segments(task.segments)
    session.adjust("bundle adjustment", FIRST_ITERATIONS, coarse=True)
    session.filter(COARSE_MAX_ERROR_PX)

    session.verify(FINE_TOLERANCE_FRACTION)
    session.register_missing(fine)
    session.retriangulate(fine)
    session.adjust("second bundle adjustment", SECOND_ITERATIONS, coarse=True)
    session.filter(MAX_ERROR_PX)
    reregistered = _reregister(session, fine)
    principal_point = _refine_principal_points(session, wanted=task.principal_point)

    _adjust_until_converged(session, fine)
    warnings = _warnings(session, reregistered, may_zoom=_may_zoom(task))
    if task.features is not None and not task.calibrated:
        warnings += contradicted_focal_lengths(session.model, task.features, task.collection)
    session.reset_weak_images()
    if task.collection.others:
        session.register_between(features, task.collection.others, _final_max_error_px(fine))
        session.reset_weak_images()
    session.end()
    _extract_colors(session.model, task.collection)
    return _outcome(task, session, principal_point=principal_point, warnings=warnings)


def _reregister(session: MapperSession, tolerance: Tolerance) -> StepReport | None:
    report = reregister_images(session, tolerance)
    if report is not None and report.accepted:
        session.adjust("bundle adjustment after re-registration", SECOND_ITERATIONS, coarse=True)
        session.filter(MAX_ERROR_PX)
    return report


def _refine_principal_points(session: MapperSession, *, wanted: bool) -> str:
    """Refine them from here on where the model determines them; returns what was decided, in words."""
    if session.calibrated:
        reason = "the intrinsics are given"
    elif not wanted:
        reason = "as requested"
    else:
        reason = estimate_principal_points(session.model, session.priors, threads=session.threads).reason
    if not reason:
        session.principal_points_free = True
        reason = session.try_adjustment("principal point", SECOND_ITERATIONS, calibrated=False, coarse=True).reason
        session.principal_points_free = not reason
        session.filter(MAX_ERROR_PX)
    return f"fixed: {reason}" if reason else "refined: two halves of the points agree on it"


def _adjust_until_converged(session: MapperSession, tolerance: Tolerance) -> None:
    for _ in range(MAX_FINAL_ROUNDS):
        session.complete(tolerance)
        last = session.adjust("final bundle adjustment", FINAL_ITERATIONS)
        session.filter(_final_max_error_px(tolerance))
        if last.max_moved_percent < CONVERGED_PERCENT or not last.accepted:
            return


def _final_max_error_px(tolerance: Tolerance) -> float:
    return min(MAX_ERROR_PX, tolerance.pixels)


def _may_zoom(task: RefineTask) -> bool:
    """Images share a camera of which only the user knows that they do."""
    return not task.calibrated and len(task.collection.cameras) < len(task.collection)


def _warnings(session: MapperSession, reregistered: StepReport | None, *, may_zoom: bool) -> tuple[str, ...]:
    """What speaks against the model: images that are still misregistered, and no accepted adjustment."""
    warnings = []
    if reregistered is not None and any_misregistered(session) and not reregistered.accepted:
        hint = "; with several lenses or zooms, --camera-mode per-image (refine: --no-share-cameras) may help"
        warnings.append(reregistered.reason + (hint if may_zoom else ""))
    adjustments = [step for step in session.steps if "adjustment" in step.name]
    if not any(step.accepted for step in adjustments):
        warnings.append(f"no bundle adjustment was accepted: {adjustments[-1].reason}")
    return tuple(warnings)


def _outcome(
    task: RefineTask,
    session: MapperSession,
    *,
    reason: str = "",
    principal_point: str = "",
    warnings: tuple[str, ...] = (),
) -> _Outcome:
    """The result of the session as it is; it has failed with a reason, or if all images are weak."""
    model, weak = session.model, weak_images(session.model)
    if len(weak) == model.num_reg_images():
        reason = reason or "no image has enough observations"
    result = SceneRefinement(
        succeeded=not reason,
        reason=reason,
        statistics=Statistics.of(model),
        num_pairs=len(session.verified.correspondences.matches),
        num_matches=session.verified.correspondences.num_matches,
        num_unverified_pairs=len(session.verified.unverified),
        weak=_names(task, weak),
        registered=_names(task, [i + 1 for i in session.registered if i + 1 in model.reg_image_ids()]),
        principal_point=principal_point,
        warnings=warnings,
        steps=tuple(session.steps),
    )
    return _Outcome(model=model, verified=session.verified, result=result)


def _names(task: RefineTask, image_ids: Sequence[int]) -> tuple[str, ...]:
    return tuple(task.collection.images[i - 1].name for i in image_ids)


def _with_missing_registered(
    task: RefineTask, features: MatchedFeatures, outcomes: Sequence[_Outcome], scratch: Path
) -> _Outcome:
    """The largest model with the images that no model has and that COLMAP's mapper can register."""
    largest = outcomes[0]
    posed = {i for outcome in outcomes for i in poses_of(outcome.model)}
    if len(posed) == len(task.collection):
        return largest
    with tempfile.TemporaryDirectory(dir=scratch) as folder:
        database = Path(folder) / DATABASE_FILE
        write_colmap_database(
            database,
            task.collection,
            cameras_of(largest.model, task.collection.cameras),
            keypoints=largest.verified.correspondences.keypoints,
            matches=largest.verified.correspondences.matches,
            j_from_i={},
            priors=(),
        )
        registration = register_images(
            largest.model,
            database,
            agrees=lambda model, image_id: agrees(features, model, image_id, task.collection),
            scratch=scratch,
            threads=task.threads,
        )
    before, model = largest.result, registration.model
    steps = (*before.steps, registration.report)
    if not registration.registered:
        return replace(largest, result=replace(before, steps=steps))
    _extract_colors(model, task.collection)
    registered = {*before.registered, *_names(task, registration.registered)}
    weak = set(_names(task, weak_images(model)))
    result = replace(
        before,
        steps=steps,
        registered=tuple(image.name for image in task.collection.images if image.name in registered),
        weak=tuple(name for name in before.weak if name in weak),
        statistics=registration.report.after,
    )
    return replace(largest, model=model, result=result)


def _uncertainty(task: RefineTask, features: MatchedFeatures, outcome: _Outcome) -> ModelUncertainty:
    model = outcome.model
    views = views_of(poses_of(model), cameras_of(model, task.collection.cameras), task.collection)
    supports = (pair_support(features, views), point_support(model, features))
    return measure_uncertainty(
        model, supports, calibrated=task.calibrated, initial_poses_count=task.initial_poses_count
    )


def _extract_colors(model: pycolmap.Reconstruction, collection: ImageCollection) -> None:
    """Give each point the mean colour of its observations.

    Read by our own reader, because pycolmap's ``extract_colors_for_all_images`` ignores the orientation in EXIF.
    """
    observations = SparseObservations.of(model, sorted(model.reg_image_ids()))
    sums, counts = np.zeros((len(observations.xyz), 3)), np.zeros(len(observations.xyz))
    for image_id, points in observations.points.items():
        if not len(points):
            continue
        try:
            rgb = load_rgb(collection.images[image_id - 1])
        except ImageError as error:
            logger.warning("its points are coloured by other images: %s", error)
            continue
        column, row = np.clip(observations.xy[image_id].astype(np.int64), 0, (rgb.shape[1] - 1, rgb.shape[0] - 1)).T
        np.add.at(sums, points, rgb[row, column])
        np.add.at(counts, points, 1)
    colours = np.round(sums / np.maximum(counts, 1)[:, None]).astype(np.uint8)
    for point_id, colour, count in zip(list(model.points3D), colours, counts, strict=True):
        if count:
            model.point3D(point_id).color = colour


# ------------------------------------------------------------------------- helpers
def _adjusted_cameras(model: pycolmap.Reconstruction, priors: Sequence[Intrinsics]) -> tuple[Intrinsics, ...]:
    """As ``cameras_of``; an adjusted focal length is a good prior, which COLMAP's global mapper asks for."""
    used = {model.image(i).camera_id - 1 for i in model.reg_image_ids()}
    cameras = cameras_of(model, priors)
    return tuple(replace(one, has_prior_focal=one.has_prior_focal or k in used) for k, one in enumerate(cameras))


def _longer_side_px(collection: ImageCollection) -> int:
    return int(np.median([max(image.width, image.height) for image in collection.images]))


def _without(images: Collection[int], features: MatchedFeatures) -> MatchedFeatures:
    """Without matches of these images: another scene has them, or they come later."""

    left_out = set(images)

    def kept(matches: Mapping[Pair, npt.NDArray[np.uint32]]) -> dict[Pair, npt.NDArray[np.uint32]]:
        return {pair: rows for pair, rows in matches.items() if left_out.isdisjoint(pair)}

    return replace(features, raw=kept(features.raw), verified=kept(features.verified))


def _write_database(
    task: RefineTask,
    features: MatchedFeatures,
    outcomes: Sequence[_Outcome],
    uncertainty: ModelUncertainty,
    path: Path,
) -> None:
    """All images; the priors are the positions of the largest model with the covariance of each.

    Matches within a scene are those that agree with it, all others those of two-view verification."""
    scene_of = {i: number for number, outcome in enumerate(outcomes) for i in poses_of(outcome.model)}
    matches = {
        pair: rows
        for pair, rows in features.verified.items()
        if len(rows) >= MIN_VERIFIED and scene_of.get(pair[0], -1) != scene_of.get(pair[1], -2)
    }
    j_from_i: dict[Pair, FloatArray] = {}
    for outcome in reversed(outcomes):
        poses = poses_of(outcome.model)
        within = {
            pair: rows
            for pair, rows in outcome.verified.correspondences.matches.items()
            if pair[0] in poses and pair[1] in poses
        }
        matches |= within
        for i, j in within:
            j_from_i[i, j] = (pycolmap.Rigid3d(poses[j]) * pycolmap.Rigid3d(poses[i]).inverse()).matrix()
    largest = outcomes[0]
    write_colmap_database(
        path,
        task.collection,
        _adjusted_cameras(largest.model, task.collection.cameras),
        keypoints=features.keypoints,
        matches=dict(sorted(matches.items())),
        j_from_i=j_from_i,
        priors=adjusted_priors(largest.model, uncertainty),
    )
