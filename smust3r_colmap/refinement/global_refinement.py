"""From stitched scenes and matches to adjusted models with tracks: the work of one child process.

    loose    matches that the stitched geometry consents to, triangulation with poses fixed, adjustment
             (large models part by part first)
    tight    the same again from the adjusted geometry: consent is worth more now, tracks grow longer, images
             without a pose are placed
    finish   filters, a last adjustment, colours

pycolmap does the work; every adjustment is judged by ``steps`` and undone where it made things worse.
The next module to read is ``refine``.
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
from smust3r_colmap.colmap.reconstruction import cameras_of, poses_of
from smust3r_colmap.errors import ImageError
from smust3r_colmap.features.correspondences import Correspondences, joined
from smust3r_colmap.features.guided_verification import (
    MIN_VERIFIED,
    Consent,
    MatchedFeatures,
    ask_consent,
    read_matched_features,
)
from smust3r_colmap.features.pointmap_matching import MappedView, match_by_pointmaps
from smust3r_colmap.geometry.arrays import FloatArray, Pair
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.importers.images import load_grey, load_rgb
from smust3r_colmap.products import DepthMaps, ImageCollection, Scene
from smust3r_colmap.refinement.acceptance import MAX_ERROR_PX, StepReport, report_of, tried_step
from smust3r_colmap.refinement.bundle_adjustment import (
    FUNCTION_TOLERANCE,
    ROUGH_TOLERANCE,
    ModelFigures,
    Priors,
    Tolerance,
    adjust,
    adjust_part,
    figures_of,
    pose_priors,
    priors_of,
    triangulate,
    weak_images,
)
from smust3r_colmap.refinement.mapper import LOOSE_PART, TIGHT_PART, Bench, agrees, views_of
from smust3r_colmap.refinement.principal_point import ask_for_principal_points
from smust3r_colmap.refinement.registration import complete_model
from smust3r_colmap.refinement.reregistration import NAME as REPLACEMENT
from smust3r_colmap.refinement.reregistration import are_any_bent, place_bent_images_again
from smust3r_colmap.refinement.subset_adjustment import adjust_on_part
from smust3r_colmap.storage.run_directory import DATABASE_FILE, MODEL_FOLDER, StageFolder, write_json

logger = logging.getLogger(__name__)

LOOSE_ANGLE_DEG, TIGHT_ANGLE_DEG = 4.0, 2.0
MIN_TIGHT_PX = 2.6
"""Tolerance of tracks in the second round, in small images: features are no better placed in them."""
FIRST_FILTER_PX = 8.0
FIRST_ITERATIONS, SECOND_ITERATIONS, LAST_ITERATIONS, PART_ITERATIONS = 12, 30, 10, 6
"""Upper bounds; after so many the figures stand still to three digits on the sets tried."""
MAP_KEYPOINTS = 1000
"""Corners of an image that are followed by pointmaps."""
MAX_LAST_ROUNDS, STILL_PERCENT = 4, 0.2
"""Filter and adjust again until no camera moves by more than this part of the path's extent: an image that wrong
matches hold lets go of them one by one."""
LARGE = 400
"""Images beyond which parts are adjusted before the whole, and cameras on a part of the points first."""
STAYED = "kept where it was"


@dataclass(frozen=True, kw_only=True, eq=False)
class RefineTask:
    """All scenes of a run, to be refined one after the other.

    Args:
        stored: the stage that gets ``0/model``, ``1/model`` ..., ``database.db`` and ``figures.json``.
        collection: all images.
        scenes: stitched; their points are not used.
        features: the run's database of SIFT features and matches, or None.
        maps: depth by image name, to match by pointmaps, or None.
        map_pairs: image pairs to match by pointmaps.
        parts: image indices of the segments, for large models.
        calibrated: intrinsics stay.
        threads: of pycolmap.
        tolerance: epipolar and reprojection tolerance of the first round, as a part of the longer image side.
        principal_point: let the principal points move where the model determines them.
        complete: let COLMAP's mapper try the images that have no pose in the end, on the largest model.
    """

    stored: StageFolder
    collection: ImageCollection
    scenes: tuple[Scene, ...]
    features: Path | None
    maps: DepthMaps | None
    map_pairs: tuple[Pair, ...]
    parts: tuple[tuple[int, ...], ...]
    calibrated: bool
    threads: int
    tolerance: float = LOOSE_PART
    principal_point: bool = True
    complete: bool = False


@dataclass(frozen=True, kw_only=True)
class RefinedFigures:
    """What became of one scene.

    Args:
        steps: in order, also those that were undone.
        num_pairs, num_matches: that the geometry consented to in the end.
        num_refused_pairs: verified pairs that contradict the geometry.
        weak: image indices with too few observations, which keep their stitched place among their neighbours.
        registered: image indices that the stitched scene did not have.
        final: figures of the model as it is stored.
        kept: the refined model stands; False where no image of it sees enough points to be adjusted by.
        principal_point: what became of it, and why.
        warnings: what speaks against the model, in words.
        reason: why not, or empty.
    """

    steps: tuple[StepReport, ...]
    num_pairs: int
    num_matches: int
    num_refused_pairs: int
    weak: tuple[int, ...]
    registered: tuple[int, ...]
    final: ModelFigures
    kept: bool
    principal_point: str
    warnings: tuple[str, ...]
    reason: str = ""


def refine_scenes(task: RefineTask) -> tuple[RefinedFigures, ...]:
    """Refine all scenes and store their models, the common database and the figures; see ``RefineTask``."""
    features = _gathered(task)
    with task.stored.write() as folder:
        outcomes: list[_Outcome] = []
        for scene in task.scenes:
            elsewhere = {i for other in task.scenes if other is not scene for i in other.image_indices}
            elsewhere |= {i for outcome in outcomes for i in poses_of(outcome.model)}
            outcomes.append(_refine_scene(task, scene, _without(elsewhere - {*scene.image_indices}, features), folder))
        if task.complete and outcomes[0].figures.kept:
            outcomes[0] = _completed(task, features, outcomes, folder)
        for number, outcome in enumerate(outcomes):
            model_folder = folder / str(number) / MODEL_FOLDER
            model_folder.mkdir(parents=True)
            write_binary_checked(outcome.model, model_folder)
        _write_database(task, features, outcomes, folder / DATABASE_FILE)
        figures = tuple(outcome.figures for outcome in outcomes)
        write_json(folder / "figures.json", figures)
    return figures


@dataclass(frozen=True, kw_only=True, eq=False)
class _Outcome:
    model: pycolmap.Reconstruction
    consent: Consent
    priors: Priors
    figures: RefinedFigures


def _gathered(task: RefineTask) -> MatchedFeatures:
    """Features and pointmap correspondences as one; the latter are taken for verified."""
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
    return match_by_pointmaps(views, chosen, max_keypoints=MAP_KEYPOINTS)


# ------------------------------------------------------------------------- one scene
def _refine_scene(task: RefineTask, scene: Scene, features: MatchedFeatures, scratch: Path) -> _Outcome:
    cameras = tuple(scene.cameras.get(i, prior) for i, prior in enumerate(task.collection.cameras))
    stitched = dict(zip(scene.image_indices, scene.cam_from_world, strict=True))
    consent = ask_consent(features, views_of(stitched, cameras, task.collection), tolerance=task.tolerance)
    bench = Bench(task.collection, cameras, consent, stitched, scratch=scratch, threads=task.threads)
    priors = priors_of(bench.model)
    steps = [_triangulation(bench, Tolerance(pixels=task.tolerance * _longer_side(task), angle_deg=LOOSE_ANGLE_DEG))]
    if not bench.model.num_points3D():
        return _nothing_to_adjust(bench, priors, steps)
    if len(scene) > LARGE:
        steps.append(tried_step("adjustment of parts", bench.model, lambda: _adjust_parts(bench.model, task)))
    steps += _adjustment("adjustment", bench.model, priors, task, FIRST_ITERATIONS, rough=True)
    bench.filter(FIRST_FILTER_PX)

    tight = Tolerance(pixels=max(TIGHT_PART * _longer_side(task), MIN_TIGHT_PX), angle_deg=TIGHT_ANGLE_DEG)
    bench = bench.with_matches(ask_consent(features, bench.views(), tolerance=TIGHT_PART))
    registered = bench.register_missing(features, tight)
    steps.append(_triangulation(bench, tight, name="longer tracks"))
    bench.drop_needless_pairs()
    steps += _adjustment("second adjustment", bench.model, priors, task, SECOND_ITERATIONS, rough=True)
    bench.filter(MAX_ERROR_PX)
    replacement = place_bent_images_again(bench, features, tight)
    if replacement.report:
        steps.append(replacement.report)
    if replacement.cam_from_world:
        # Where they were says nothing any more: not for the adjustment, and not where they turn out weak.
        bench, stitched = replacement.bench, {**stitched, **replacement.cam_from_world}
        priors = priors.with_places(replacement.cam_from_world)
        steps += _adjustment("adjustment around them", bench.model, priors, task, SECOND_ITERATIONS, rough=True)
        bench.filter(MAX_ERROR_PX)
    why_not = _why_principal_points_stay(bench.model, priors, task)
    if not why_not:
        moved = _tried_adjustment(
            "principal point",
            bench.model,
            priors,
            task,
            SECOND_ITERATIONS,
            calibrated=False,
            principal_point=True,
            rough=True,
        )
        steps.append(moved)
        why_not = moved.reason
        bench.filter(MAX_ERROR_PX)
    free = not why_not
    principal_point = f"{STAYED}: {why_not}" if why_not else "free: two halves of the points agree on it and fit better"
    for _ in range(MAX_LAST_ROUNDS):
        bench.complete(tight)
        bench.drop_needless_pairs()
        steps += _adjustment("last adjustment", bench.model, priors, task, LAST_ITERATIONS, principal_point=free)
        last = steps[-1]
        bench.filter(min(MAX_ERROR_PX, tight.pixels))
        if last.max_moved_percent < STILL_PERCENT or not last.kept:
            break
    warnings = _doubts(steps, stay_bent=replacement.report is not None and are_any_bent(bench, features))
    return _finished(task, bench, priors, stitched, steps, registered, principal_point, warnings)


def _triangulation(bench: Bench, tolerance: Tolerance, *, name: str = "triangulation") -> StepReport:
    before = figures_of(bench.model)
    triangulate(bench.mapper, tolerance)
    return report_of(name, before, figures_of(bench.model), moved=np.zeros(0), turned=np.zeros(0))


def _adjustment(
    name: str,
    model: pycolmap.Reconstruction,
    priors: Priors,
    task: RefineTask,
    max_iterations: int,
    *,
    principal_point: bool = False,
    rough: bool = False,
) -> list[StepReport]:
    """An adjustment, and where it is undone another with the cameras' parameters held.

    The distortion of a fisheye model runs away where all points are near the middle of the images, and poses and
    points want adjusting all the same.
    """
    adjusted = partial(
        _tried_adjustment,
        model=model,
        priors=priors,
        task=task,
        max_iterations=max_iterations,
        principal_point=principal_point,
        rough=rough,
    )
    first = adjusted(name, calibrated=task.calibrated)
    if first.kept or task.calibrated:
        return [first]
    return [first, adjusted(f"{name} with cameras held", calibrated=True)]


def _tried_adjustment(
    name: str,
    model: pycolmap.Reconstruction,
    priors: Priors,
    task: RefineTask,
    max_iterations: int,
    *,
    calibrated: bool,
    principal_point: bool,
    rough: bool,
) -> StepReport:
    """All cameras and points; ``rough``ly, and of a large model on a part of the points, where another follows."""

    def step() -> bool:
        return (adjust_on_part if rough and model.num_reg_images() > LARGE else adjust)(
            model,
            priors,
            calibrated=calibrated,
            max_iterations=max_iterations,
            threads=task.threads,
            principal_point=principal_point,
            function_tolerance=ROUGH_TOLERANCE if rough else FUNCTION_TOLERANCE,
        )

    return tried_step(name, model, step)


def _why_principal_points_stay(model: pycolmap.Reconstruction, priors: Priors, task: RefineTask) -> str:
    """In words, or empty where the model determines them."""
    if task.calibrated:
        return "the intrinsics are given"
    if not task.principal_point:
        return "as was asked for"
    return ask_for_principal_points(model, priors, threads=task.threads).reason


def _adjust_parts(model: pycolmap.Reconstruction, task: RefineTask) -> bool:
    registered = set(model.reg_image_ids())
    parts = [[i + 1 for i in part if i + 1 in registered] for part in task.parts]
    return all(adjust_part(model, part, max_iterations=PART_ITERATIONS, threads=task.threads) for part in parts if part)


def _nothing_to_adjust(bench: Bench, priors: Priors, steps: list[StepReport]) -> _Outcome:
    reason = "no point could be triangulated: too few matches, or a camera that only turned"
    figures = RefinedFigures(
        steps=tuple(steps),
        num_pairs=len(bench.consent.correspondences.matches),
        num_matches=bench.consent.correspondences.num_matches,
        num_refused_pairs=len(bench.consent.refused),
        weak=tuple(i - 1 for i in weak_images(bench.model)),
        registered=(),
        final=figures_of(bench.model),
        kept=False,
        principal_point=STAYED,
        warnings=(),
        reason=reason,
    )
    return _Outcome(model=bench.model, consent=bench.consent, priors=priors, figures=figures)


def _finished(
    task: RefineTask,
    bench: Bench,
    priors: Priors,
    stitched: Mapping[int, FloatArray],
    steps: list[StepReport],
    registered: tuple[int, ...],
    principal_point: str,
    warnings: tuple[str, ...],
) -> _Outcome:
    model = bench.model
    weak = _put_back_weak_images(bench, stitched)
    some_sound = len(weak) < model.num_reg_images()
    bench.mapper.end_reconstruction(False)
    _colour(model, task.collection)
    figures = RefinedFigures(
        steps=tuple(steps),
        num_pairs=len(bench.consent.correspondences.matches),
        num_matches=bench.consent.correspondences.num_matches,
        num_refused_pairs=len(bench.consent.refused),
        weak=tuple(i - 1 for i in weak),
        registered=tuple(i for i in registered if i + 1 in model.reg_image_ids()),
        final=figures_of(model),
        kept=some_sound,
        principal_point=principal_point,
        warnings=warnings,
        reason="" if some_sound else "no image sees enough points to be adjusted by",
    )
    return _Outcome(model=model, consent=bench.consent, priors=priors, figures=figures)


def _doubts(steps: Sequence[StepReport], *, stay_bent: bool) -> tuple[str, ...]:
    """No adjustment stood, or images stay bent."""
    adjustments = [step for step in steps if "adjustment" in step.name]
    warnings = [step.reason for step in steps if step.name == REPLACEMENT and not step.kept and stay_bent]
    if adjustments and not any(step.kept for step in adjustments):
        warnings.append(f"no adjustment stood: {adjustments[-1].reason}")
    return tuple(warnings)


def _completed(task: RefineTask, features: MatchedFeatures, outcomes: Sequence[_Outcome], scratch: Path) -> _Outcome:
    """The largest model with those of the images that no model has which COLMAP's mapper can add."""
    largest = outcomes[0]
    placed = {i for outcome in outcomes for i in poses_of(outcome.model)}
    if len(placed) == len(task.collection):
        return largest
    with tempfile.TemporaryDirectory(dir=scratch) as folder:
        database = Path(folder) / DATABASE_FILE
        write_colmap_database(
            database,
            task.collection,
            cameras_of(largest.model, task.collection.cameras),
            keypoints=largest.consent.correspondences.keypoints,
            matches=largest.consent.correspondences.matches,
            j_from_i={},
            priors=(),
        )
        completion = complete_model(
            largest.model,
            database,
            agrees=lambda model, image_id: agrees(features, model, image_id, task.collection),
            scratch=scratch,
            threads=task.threads,
        )
    steps = (*largest.figures.steps, completion.report)
    if not completion.registered:
        return replace(largest, figures=replace(largest.figures, steps=steps))
    _colour(completion.model, task.collection)
    registered = sorted({*largest.figures.registered, *(i - 1 for i in completion.registered)})
    still_weak = set(weak_images(completion.model))
    figures = replace(
        largest.figures,
        steps=steps,
        registered=tuple(registered),
        weak=tuple(i for i in largest.figures.weak if i + 1 in still_weak),
        final=completion.report.after,
    )
    return replace(largest, model=completion.model, figures=figures)


def _put_back_weak_images(bench: Bench, stitched: Mapping[int, FloatArray]) -> list[int]:
    """Images that rest on too little go where their stitched pose is; returns their ids.

    From there they do not see all that they saw, which may leave others with too little.
    """
    while True:
        weak = weak_images(bench.model)
        _put_back(bench.model, weak, stitched)
        bench.filter(MAX_ERROR_PX)
        bench.drop_needless_pairs()
        if weak_images(bench.model) == weak:
            return weak


def _put_back(model: pycolmap.Reconstruction, weak: Sequence[int], stitched: Mapping[int, FloatArray]) -> None:
    """Each where its stitched pose is, seen from the nearest sound image, which adjustment may have moved.

    An image that had no stitched pose is given up again.
    """
    sound = sorted(set(model.reg_image_ids()) - set(weak))
    anchors = [i for i in sound if i - 1 in stitched]
    for image_id in weak:
        if image_id - 1 not in stitched:
            model.deregister_frame(model.image(image_id).frame_id)
        elif anchors:
            near = min(anchors, key=lambda i: abs(i - image_id))
            near_from_world = model.image(near).cam_from_world()
            old_near, old = pycolmap.Rigid3d(stitched[near - 1]), pycolmap.Rigid3d(stitched[image_id - 1])
            model.frame(model.image(image_id).frame_id).rig_from_world = old * old_near.inverse() * near_from_world


def _colour(model: pycolmap.Reconstruction, collection: ImageCollection) -> None:
    """The mean colour of each point's observations, read from the upright images."""
    point_ids: list[int] = []
    colours: list[FloatArray] = []
    for image_id in sorted(model.reg_image_ids()):
        seen = model.image(image_id).get_observation_points2D()
        if not seen:
            continue
        try:
            rgb = load_rgb(collection.images[image_id - 1])
        except ImageError as error:
            logger.warning("its points are coloured by other images: %s", error)
            continue
        xy = np.stack([point.xy for point in seen])
        column = np.clip(xy[:, 0].astype(np.int64), 0, rgb.shape[1] - 1)
        row = np.clip(xy[:, 1].astype(np.int64), 0, rgb.shape[0] - 1)
        colours.append(rgb[row, column].astype(np.float64))
        point_ids += [point.point3D_id for point in seen]
    if not colours:
        return
    ids, rows, counts = np.unique(point_ids, return_inverse=True, return_counts=True)
    sums = np.zeros((len(ids), 3))
    np.add.at(sums, rows, np.concatenate(colours))
    for point_id, colour in zip(ids.tolist(), np.round(sums / counts[:, None]).astype(np.uint8), strict=True):
        model.point3D(point_id).color = colour


# ------------------------------------------------------------------------- helpers
def _adjusted_cameras(model: pycolmap.Reconstruction, priors: Sequence[Intrinsics]) -> tuple[Intrinsics, ...]:
    """As ``cameras_of``; a focal length that images have adjusted is a good prior, and global mapping asks for one."""
    used = {model.image(i).camera_id - 1 for i in model.reg_image_ids()}
    cameras = cameras_of(model, priors)
    return tuple(replace(one, has_prior_focal=one.has_prior_focal or k in used) for k, one in enumerate(cameras))


def _longer_side(task: RefineTask) -> int:
    return int(np.median([max(image.width, image.height) for image in task.collection.images]))


def _without(elsewhere: Collection[int], features: MatchedFeatures) -> MatchedFeatures:
    """Images that another scene holds are not to be placed in this one, too."""

    def kept(matches: Mapping[Pair, npt.NDArray[np.uint32]]) -> dict[Pair, npt.NDArray[np.uint32]]:
        return {pair: rows for pair, rows in matches.items() if set(pair).isdisjoint(elsewhere)}

    return replace(features, raw=kept(features.raw), verified=kept(features.verified))


def _write_database(task: RefineTask, features: MatchedFeatures, outcomes: Sequence[_Outcome], path: Path) -> None:
    """All images; per scene the matches it consents to, between scenes and images without a pose the verified ones."""
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
            for pair, rows in outcome.consent.correspondences.matches.items()
            if pair[0] in poses and pair[1] in poses
        }
        matches |= within
        j_from_i |= {(i, j): _compose(poses[j], invert_rigid(poses[i])) for i, j in within}
    largest = outcomes[0]
    write_colmap_database(
        path,
        task.collection,
        _adjusted_cameras(largest.model, task.collection.cameras),
        keypoints=features.keypoints,
        matches=dict(sorted(matches.items())),
        j_from_i=j_from_i,
        priors=pose_priors(largest.model, largest.priors),
    )


def _compose(c_from_b: FloatArray, b_from_a: FloatArray) -> FloatArray:
    rotation = c_from_b[:, :3] @ b_from_a[:, :3]
    return np.column_stack([rotation, c_from_b[:, :3] @ b_from_a[:, 3] + c_from_b[:, 3]])
