"""Real tracks and bundle adjustment for a model that another program made, start to end.

    read      anybody's files, repaired                     importers.colmap_model
    fit       to the image files, at their size             importers.fitted_model
    match     neighbours, where no points say who sees what; images to be placed, with those that look like them
    refine    as in a run of ours                           refinement.refine
    carry     the points without tracks, to the adjusted cameras
    export    as in a run of ours                           exports

Exports of feed-forward networks have poses that are nearly right, cameras at the size of the network and no
tracks; here such a model takes the place of the stitched one. The next module to read is ``refine_command``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap

from smust3r_colmap.alignment.from_poses import align_poses
from smust3r_colmap.colmap.model_files import MODEL_FILES, refuse_names_text_cannot_hold
from smust3r_colmap.config import RunConfig
from smust3r_colmap.errors import ConfigError, DegenerateAlignmentError
from smust3r_colmap.estimators.robust import evenly_chosen
from smust3r_colmap.execution.progress import Reporter
from smust3r_colmap.execution.stage_clock import StageClock, peak_memory_bytes
from smust3r_colmap.execution.task_pool import usable_cores
from smust3r_colmap.exporters.registry import FORMATS, FormatSettings, Outputs, write_where_possible
from smust3r_colmap.exporters.tum_trajectory import write_tum
from smust3r_colmap.features.matching import match_pairs
from smust3r_colmap.features.pairs import alike_pairs, neighbouring_pairs
from smust3r_colmap.features.stage import describe_images, features_of_run
from smust3r_colmap.geometry.arrays import IntArray, Pair
from smust3r_colmap.geometry.sim3 import Sim3, invert_rigid
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.importers.colmap_model import ExternalModel, read_colmap_model
from smust3r_colmap.importers.fitted_model import FittedModel, fit_to_images
from smust3r_colmap.importers.image_folder import (
    FolderScan,
    check_image_folder,
    check_masks_not_inside,
    check_output_not_inside,
)
from smust3r_colmap.importers.masks import masks_of
from smust3r_colmap.pipeline import masked_as_wanted, refinement_summaries
from smust3r_colmap.products import ImageCollection, PointCloud, RunFeatures, Scene, Submodel
from smust3r_colmap.refinement.stage import Refinement, refine, surfaces_of_clouds
from smust3r_colmap.report.summary import GraphSummary, ImageNote, ModelSummary, RunSummary
from smust3r_colmap.segmentation.windows import plan_windows
from smust3r_colmap.storage.finished_run import FinishedRun, begin_stages, write_finished
from smust3r_colmap.storage.image_scan import scan_changed_files
from smust3r_colmap.storage.run_directory import RunDirectory, key_of, write_json
from smust3r_colmap.storage.scenes import write_scenes

MAX_ALIGNED = 500
"""Cameras that say how all have moved as a whole; the alignment compares every two of them, which takes 3.6 GB of
5,000, and no similarity is better known by more."""


@dataclass(frozen=True, kw_only=True)
class CameraChoice:
    """What is to become of the model's cameras; see ``fit_to_images``."""

    share: bool = True
    model: str = ""
    calibrated: bool = False


def refine_model(
    model: Path,
    images: Path,
    output: Path,
    config: RunConfig,
    *,
    cameras: CameraChoice,
    pose_tolerance: float,
    overwrite: bool = False,
    reporter: Reporter,
) -> RunSummary:
    """From a COLMAP model of poor poses to one with tracks in ``output/sparse/0``, and a database that goes with it.

    Args:
        model: folder of the model; it is only read.
        images: folder of its images.
        output: made when missing; what an earlier start finished there is used.
        config: ``importing.masks``, ``classical`` (features), ``refinement`` (with ``complete`` also images of the
            folder that the model lacks are placed), ``output``, ``segmentation`` (parts of large models), ``workers``
            and ``seed`` are used.
        cameras: what is to become of the cameras.
        pose_tolerance: how far from its epipolar line a match may lie at first, as a part of the longer image side.
        overwrite: start over.
        reporter: told about every stage.

    Raises:
        InputError: the model, the images or the settings cannot be used.
        RunDirectoryError: the output folder cannot be used, is held by another run, or the disk refused.
    """
    check_output_not_inside(images, output)
    check_masks_not_inside(images, config.importing.masks)
    check_image_folder(images)
    external = read_colmap_model(model)
    _refuse_to_overwrite(external.folder, output)
    with RunDirectory(output) as run:
        clock = StageClock(reporter)
        scan, fitted = _fit(external, images, config, cameras, run, clock, overwrite=overwrite)
        begin_stages(run, scan, overwrite=overwrite)
        start = fitted.scene(origin=external.folder.name)
        features = _features(fitted, start, config, run, clock)
        refinement = _refine(fitted, start, features, config, run, clock, tolerance=pose_tolerance)
        refinement = _doubting_the_poses(refinement)
        result = _with_points(fitted, start, refinement)
        outputs = _export(result, start, refinement, images, fitted, config, run, clock)
        summary = _summarise(fitted, result, features, refinement, outputs, run, clock)
        facts = {
            **summary.to_json_dict(),
            "model_notes": fitted.notes,
            "settings": {"cameras": cameras, "pose_tolerance": pose_tolerance, "config": config},
        }
        write_json(run.root / "summary.json", facts)
    return summary


def _refuse_to_overwrite(model: Path, output: Path) -> None:
    """The results would take the place of what they are made of."""
    if output.resolve() in (model.resolve(), *model.resolve().parents):
        raise ConfigError(f"--output {output}: the model {model} lies there and would be lost; name another folder")


def _fit(
    external: ExternalModel,
    images: Path,
    config: RunConfig,
    cameras: CameraChoice,
    run: RunDirectory,
    clock: StageClock,
    *,
    overwrite: bool,
) -> tuple[FolderScan, FittedModel]:
    """Read the folder and hold the model against it; nothing in the run's folder changes."""
    with clock.stage("import", total=1) as stage:
        scan = scan_changed_files(images, run, overwrite=overwrite, workers=config.workers)
        fitted = fit_to_images(
            external,
            scan,
            share_cameras=cameras.share,
            camera_model=cameras.model,
            calibrated=cameras.calibrated,
            complete=config.refinement.complete,
        )
        if config.output.text:
            refuse_names_text_cannot_hold(image.name for image in fitted.collection.images)
        fitted = replace(fitted, collection=masked_as_wanted(fitted.collection, config.importing.masks, clock))
        stage.advance()
    for note in fitted.notes:
        clock.note(note)
    for rejected in fitted.collection.rejected:
        clock.warn(f"left out: {rejected.name} ({rejected.reason})")
    return scan, fitted


# --------------------------------------------------------------------------- matching
def _features(
    fitted: FittedModel, start: Scene, config: RunConfig, run: RunDirectory, clock: StageClock
) -> RunFeatures:
    """SIFT of all images, and the matches that no surface chooses: of neighbours in a model without points, and of
    images that have no pose yet."""
    workers = config.workers or usable_cores()
    features = features_of_run(fitted.collection, config.classical, run, clock, workers=workers, seed=config.seed)
    per_image, exhaustive_below = config.refinement.track_neighbours, config.classical.exhaustive_below
    pairs: set[Pair] = set()
    if not len(start.points):
        pairs |= set(neighbouring_pairs(start.cam_from_world, per_image=per_image, exhaustive_below=exhaustive_below))
    if fitted.num_posed < len(fitted.collection):
        descriptors = describe_images(features, run, seed=config.seed)
        pairs |= set(alike_pairs(descriptors, fitted.num_posed, per_image=per_image, exhaustive_below=exhaustive_below))
    usable = sorted((a, b) for a, b in pairs if features.usable[a] and features.usable[b])
    if usable:
        with clock.stage("matching", total=len(usable)) as stage:
            match_pairs(
                features.database, usable, workers=workers, seed=config.seed, log_file=run.native_log, stage=stage
            )
    return features


def _refine(
    fitted: FittedModel,
    start: Scene,
    features: RunFeatures,
    config: RunConfig,
    run: RunDirectory,
    clock: StageClock,
    *,
    tolerance: float,
) -> Refinement:
    """Which surface an image sees is known from its tracks, else from the points that fall into it."""
    windows = plan_windows(
        len(start), segment_length=config.segmentation.segment_length, overlap=config.segmentation.overlap
    )
    return refine(
        (start,),
        fitted.collection,
        None,
        features,
        config,
        run,
        clock,
        parts=[window.images for window in windows],
        surfaces=surfaces_of_clouds((start,)) | fitted.seen_by_tracks(),
        tolerance=tolerance,
    )


def _doubting_the_poses(refinement: Refinement) -> Refinement:
    """Poses of another meaning look like any others, but hardly a match agrees with them."""
    (figures,) = refinement.figures
    if figures.kept and figures.num_refused_pairs <= figures.num_pairs:
        return refinement
    doubt = (
        f"the matches of {figures.num_pairs} image pairs agree with the poses, those of {figures.num_refused_pairs} do "
        "not; has the model camera centres in place of translations, or poses from camera to world? COLMAP's are "
        "from world to camera"
    )
    doubted = (
        replace(figures, warnings=(*figures.warnings, doubt))
        if figures.kept
        else replace(figures, reason=f"{figures.reason}; {doubt}")
    )
    return replace(refinement, figures=(doubted,))


# ---------------------------------------------------------------------------- results
def _with_points(fitted: FittedModel, start: Scene, refinement: Refinement) -> Scene:
    """The refined scene with its tracked points, and behind them the given ones that have no track."""
    (folder,) = refinement.models
    if folder is None:
        return start
    scene = refinement.scenes[0]
    model = pycolmap.Reconstruction(folder)
    tracked, untracked = list(model.points3D.values()), fitted.untracked_points
    moved = refined_from_start(start, scene, _median_depth(model)).apply(untracked.xyz)
    cloud = PointCloud(
        xyz=np.concatenate([np.reshape([point.xyz for point in tracked], (-1, 3)), moved]),
        rgb=np.concatenate([np.reshape([point.color for point in tracked], (-1, 3)).astype(np.uint8), untracked.rgb]),
    )
    return replace(scene, points=cloud)


def refined_from_start(start: Scene, refined: Scene, depth: float) -> Transform:
    """How the cameras have moved as a whole, which takes along what hangs on no camera in particular.

    One similarity for all points. To move each with the cameras that may see it would need to know which do: by
    projection alone, walls between them unknown, the points of castle_p30 came to lie a third farther from the tracks.

    Args:
        start, refined: the first has no image that the second lacks.
        depth: usual depth of the scene in the world of ``refined``.
    """
    before = _cameras_as_submodel(start, evenly_chosen(len(start), MAX_ALIGNED))
    after = _cameras_as_submodel(refined, np.arange(len(refined)))
    try:
        return align_poses(after, before, depth_target=depth).estimate.b_from_a
    except DegenerateAlignmentError:  # the camera only turned: the priors have kept the world where it was
        return Sim3.identity()


def _cameras_as_submodel(scene: Scene, chosen: IntArray) -> Submodel:
    return Submodel(
        segment=0,
        submodel=0,
        images=tuple(scene.image_indices[k] for k in chosen),
        seg_from_cam=invert_rigid(scene.cam_from_world[chosen]),
        intrinsics=tuple(scene.cameras[scene.camera_indices[k]] for k in chosen),
        method="refinement",
        reprojection_error_px=np.nan,
        tracks=None,
    )


def _median_depth(model: pycolmap.Reconstruction) -> float:
    """Of the points, each in the first image of its track."""
    first = [(model.image(point.track.elements[0].image_id), point.xyz) for point in model.points3D.values()]
    return float(np.median([(image.cam_from_world() * xyz)[2] for image, xyz in first]))


def _export(
    result: Scene,
    start: Scene,
    refinement: Refinement,
    images: Path,
    fitted: FittedModel,
    config: RunConfig,
    run: RunDirectory,
    clock: StageClock,
) -> Outputs:
    """The model, and where it has tracks its database; cloud, trajectory, and the one it began with; what failed."""
    run.clear_results(MODEL_FILES)
    has_tracks = any(refinement.models)
    with run.stage("scene", key=key_of("scene", result)).write() as folder:
        write_scenes(folder, (result,))
    finished = FinishedRun(
        output=run.root,
        native_log=run.native_log,
        images=images,
        scenes=(result,),
        models=refinement.models,
        database=refinement.database if has_tracks else None,
        maps=None,
        masks=masks_of(fitted.collection, config.importing.masks),
    )
    settings = FormatSettings.of(config.output)
    with clock.stage("export", total=1) as stage:
        for name in ("sparse", "ply", "glb", "tum", *(("database",) if has_tracks else ())):
            FORMATS[name].write(finished, settings)
        write_tum(start, run.root / "trajectory_stitched_tum.txt", None)
        write_finished(run, finished)
        stage.advance()
    large = config.output.large_formats if has_tracks else ()
    return write_where_possible(finished, large, settings, clock)


def _summarise(
    fitted: FittedModel,
    result: Scene,
    features: RunFeatures,
    refinement: Refinement,
    outputs: Outputs,
    run: RunDirectory,
    clock: StageClock,
) -> RunSummary:
    """In the form of a reconstruction, so that programs need to know one; nothing was segmented or stitched here."""
    return RunSummary(
        output=run.root,
        num_images=len(fitted.collection),
        num_registered=len(result),
        models=(
            ModelSummary(
                folder=run.sparse_model(0).relative_to(run.root).as_posix(),
                num_images=len(result),
                num_points=len(result.points),
                metric=result.metric,
                segments=result.segments,
            ),
        ),
        rejected=tuple(ImageNote(name=one.name, reason=one.reason) for one in fitted.collection.rejected),
        unregistered=_unplaced(fitted.collection, result, features, refined=any(refinement.models)),
        stages=tuple(clock.stages),
        segments=(),
        edges=(),
        loops=(),
        loops_note="",
        graph=GraphSummary(
            num_nodes=1,
            num_edges=0,
            num_loops=0,
            cost_before=0.0,
            cost_after=0.0,
            iterations=0,
            stop_reason="a given model",
            improved=False,
        ),
        peak_memory_bytes=peak_memory_bytes(),
        refinements=refinement_summaries(refinement, fitted.collection, run),
        missing_outputs=outputs.missing,
        notes=(*_remarks_on_points(fitted, refinement), *outputs.notes),
    )


def _unplaced(
    collection: ImageCollection, result: Scene, features: RunFeatures, *, refined: bool
) -> tuple[ImageNote, ...]:
    """The images without a pose, and why they have none."""
    unreadable = {one.name: one.reason for one in features.rejected}
    placed, notes = set(result.image_indices), []
    with pycolmap.Database.open(features.database) as database:
        for index, image in enumerate(collection.images):
            if index in placed:
                continue
            if image.name in unreadable:
                reason = unreadable[image.name]
            elif not database.num_keypoints_for_image(index + 1):
                reason = "no features were found in it"
            elif not refined:
                reason = "the model could not be refined, and images are placed by its tracks"
            else:
                reason = "no place was found that its matches agree with"
            notes.append(ImageNote(name=image.name, reason=reason))
    return tuple(notes)


def _remarks_on_points(fitted: FittedModel, refinement: Refinement) -> tuple[str, ...]:
    untracked = len(fitted.untracked_points)
    if not untracked or not any(refinement.models):
        return ()
    return (
        f"points.ply: {untracked} points of the given model have no track; they were moved with the cameras as a whole "
        "and are not in sparse/0",
    )
