"""From initial poses to a model with tracks and adjusted cameras.

    track pairs      which images see the same surface            features.covisibility
    track matching   SIFT matches of the new pairs                features.matching
    refinement       triangulation and bundle adjustment          global_refinement, in a child process

If the refinement fails, the scene keeps its initial poses, with a reason. The next module to read is ``dense.stage``.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap

from smust3r_colmap.colmap.database import open_database
from smust3r_colmap.colmap.reconstruction import cameras_of, poses_of
from smust3r_colmap.config import FeatureConfig, RefinementConfig, SegmentationConfig, TrackConfig
from smust3r_colmap.errors import ConfigError, InputError
from smust3r_colmap.execution.progress import Stage
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.execution.task_pool import TaskFailure, in_child
from smust3r_colmap.features.covisibility import SeenSurface, select_pairs
from smust3r_colmap.features.guided_verification import count_verified, read_matched_features
from smust3r_colmap.features.pose_readings import AS_COLMAP, agreement, best_reading
from smust3r_colmap.features.seen_surfaces import seen_surfaces, surfaces_of_clouds, surfaces_of_maps
from smust3r_colmap.features.stage import features_of_run, match_pairs_of_run
from smust3r_colmap.geometry.arrays import FloatArray, Pair
from smust3r_colmap.products import EMPTY_CLOUD, DepthMaps, ImageCollection, RunFeatures, Scene
from smust3r_colmap.refinement.global_refinement import RESULTS, UNCERTAINTIES, RefineTask, refine_scenes
from smust3r_colmap.refinement.mapper import COARSE_TOLERANCE_FRACTION
from smust3r_colmap.refinement.model_uncertainty import ModelUncertainty, UncertaintySummary, summarise_uncertainty
from smust3r_colmap.refinement.statistics import SceneRefinement
from smust3r_colmap.segmentation.keyframes import pairs_with_neighbours
from smust3r_colmap.segmentation.stage import Segments
from smust3r_colmap.segmentation.view_graph import ViewGraph
from smust3r_colmap.segmentation.windows import plan_windows
from smust3r_colmap.stitching.stage import Stitched
from smust3r_colmap.storage.codec import Codec
from smust3r_colmap.storage.run_directory import (
    DATABASE_FILE,
    MODEL_FOLDER,
    REFINED_STAGE,
    key_of,
)

NEXT_IMAGES = 4
"""Neighbours in order that are always matched if the backbone has matched nothing."""
METHOD_VERSION = 10
"""To be raised when the refinement changes, so that finished folders are refined again."""
WORKERS_PER_THREAD = 2
"""Adjustment gains little from threads: on two cores a second one took 70 % more processor time and saved no time."""


_PAIRS: Codec[tuple[Pair, ...]] = Codec(tuple[Pair, ...], "pairs")


@dataclass(frozen=True, kw_only=True)
class Refinement:
    """The results of all scenes.

    Args:
        folder: holds the models and the database.
        key: hash of all that they depend on.
        scenes: with adjusted poses and cameras, without points; the initial one if its refinement failed.
        results: one per scene.
        uncertainties: of the models, one per scene; none if nothing could be refined.
    """

    folder: Path
    key: str
    scenes: tuple[Scene, ...]
    results: tuple[SceneRefinement, ...]
    uncertainties: tuple[ModelUncertainty, ...] = ()

    @property
    def database(self) -> Path:
        """Keypoints, matches and priors with the ids of the models."""
        return self.folder / DATABASE_FILE

    @property
    def models(self) -> tuple[Path | None, ...]:
        """Per scene the folder of its COLMAP model with tracks, or None if its refinement failed."""
        return tuple(self._model(number) if one.succeeded else None for number, one in enumerate(self.results))

    @property
    def summarised_uncertainties(self) -> tuple[UncertaintySummary | None, ...]:
        """One per scene; None if its refinement failed."""
        if not self.uncertainties:
            return (None,) * len(self.scenes)
        return tuple(
            summarise_uncertainty(one) if result.succeeded else None
            for one, result in zip(self.uncertainties, self.results, strict=True)
        )

    def _model(self, number: int) -> Path:
        return self.folder / str(number) / MODEL_FOLDER


@dataclass(frozen=True, kw_only=True, eq=False)
class InitialScenes:
    """The input of the refinement.

    Args:
        scenes: largest first.
        subsets: image indices of the segments, which are adjusted first in large models.
        maps: depth of the scenes; None if the model has none.
        maps_key: hash of all that the maps were made from.
        view_graph: the order of the images.
        pairs_of_others: images that are no keyframes with those beside them, to which they are registered.
        surfaces: (S, 3) world points that each image sees, by image index; by default from the maps, or from the
            points of the scenes.
        tolerance: of the poses, as a fraction of the longer image side.
    """

    scenes: tuple[Scene, ...]
    subsets: tuple[tuple[int, ...], ...]
    view_graph: ViewGraph
    pairs_of_others: tuple[Pair, ...] = ()
    maps: DepthMaps | None = None
    maps_key: str = ""
    surfaces: Mapping[int, FloatArray] | None = None
    tolerance: float = COARSE_TOLERANCE_FRACTION

    @classmethod
    def of(cls, stitched: Stitched, segments: Segments, *, maps_key: str) -> InitialScenes:
        """The scenes of stitching."""
        windows = tuple(window.images for window in segments.windows)
        return cls(
            scenes=stitched.scenes,
            subsets=windows,
            view_graph=segments.view_graph,
            pairs_of_others=segments.pairs_of_others,
            maps=stitched.maps,
            maps_key=maps_key,
        )

    @classmethod
    def of_external(
        cls, scene: Scene, seen_by_tracks: Mapping[int, FloatArray], options: SegmentationConfig, *, tolerance: float
    ) -> InitialScenes:
        """The model of another program; what an image sees is known from its tracks, else from the points in it."""
        graph = ViewGraph.chain(len(scene))
        windows = plan_windows(graph, segment_length=options.segment_length, overlap=options.overlap)
        return cls(
            scenes=(scene,),
            subsets=tuple(window.images for window in windows),
            view_graph=graph,
            surfaces=surfaces_of_clouds((scene,)) | dict(seen_by_tracks),
            tolerance=tolerance,
        )

    def seen(self) -> list[list[SeenSurface]]:
        """Per scene what each of its images sees."""
        surfaces = self.surfaces
        if surfaces is None:
            surfaces = (
                surfaces_of_clouds(self.scenes) if self.maps is None else surfaces_of_maps(self.scenes, self.maps)
            )
        return [seen_surfaces(scene, surfaces) for scene in self.scenes]

    @property
    def geometry(self) -> list[object]:
        """All of the scenes that the result depends on, for the key of the stage."""
        return [(s.image_names, s.image_indices, s.camera_indices, s.cameras, s.cam_from_world) for s in self.scenes]


def refine(
    run: Run,
    initial: InitialScenes,
    collection: ImageCollection,
    features: RunFeatures | None,
    options: RefinementConfig,
    feature_options: FeatureConfig,
) -> Refinement | None:
    """Build tracks in each scene and adjust it; None if it is switched off.

    Args:
        run: keeps what is finished.
        initial: scenes with initial poses.
        collection: all images of the run.
        features: the run's SIFT; extracted here if the backbone has none.
        options, feature_options: settings.

    Raises:
        ConfigError: tracks from pointmaps are requested and there are no maps.
    """
    if not options.refine:
        return None
    source = options.track_source
    is_network = features is None
    if initial.maps is None and source != "features":
        raise ConfigError(f"--track-source {source}: the model has no depth maps; take features")
    seen = initial.seen()
    pairs: tuple[Pair, ...] = ()
    if source == "pointmaps":
        features = None
    else:
        features = features or features_of_run(run, collection, feature_options)
        pairs = _match(run, initial, collection.others, seen, features, options.track_neighbours)
    map_pairs = () if source == "features" else _pairs_for_maps(initial, seen, options.track_neighbours)
    settings = (options, collection.calibrated, initial.tolerance, is_network, collection.others)
    inputs = (METHOD_VERSION, features and features.key, pairs, initial.geometry, settings, initial.maps_key)
    stored = run.folder.stage(REFINED_STAGE, key=key_of(REFINED_STAGE, inputs))
    with run.clock.stage("refinement", total=1) as stage:
        if stored.is_done:
            stage.skip(1)
        else:
            task = RefineTask(
                stored=stored,
                collection=collection,
                scenes=tuple(replace(scene, points=EMPTY_CLOUD) for scene in initial.scenes),
                features=None if features is None else features.database,
                maps=initial.maps if map_pairs else None,
                map_pairs=map_pairs,
                segments=initial.subsets,
                calibrated=collection.calibrated,
                principal_point=options.principal_point,
                threads=max(1, run.executor.workers // WORKERS_PER_THREAD),
                tolerance=initial.tolerance,
                register_missing=options.register_missing,
                initial_poses_count=is_network,
            )
            outcome = in_child(refine_scenes, task, log_file=run.folder.native_log)
            stage.advance()
            if isinstance(outcome, TaskFailure):
                run.clock.warn(f"no tracks, the initial poses are kept: {outcome.reason}")
                failed = tuple(SceneRefinement.failed(scene.image_names, outcome.reason) for scene in initial.scenes)
                return Refinement(folder=stored.path, key=stored.key, scenes=initial.scenes, results=failed)
    refined = Refinement(
        folder=stored.path,
        key=stored.key,
        scenes=initial.scenes,
        results=RESULTS.read(stored.path),
        uncertainties=UNCERTAINTIES.read(stored.path),
    )
    adjusted = tuple(
        scene if model is None else _adjusted_scene(scene, model, collection)
        for scene, model in zip(initial.scenes, refined.models, strict=True)
    )
    return replace(refined, scenes=adjusted)


def refine_external(
    run: Run,
    initial: InitialScenes,
    collection: ImageCollection,
    features: RunFeatures,
    options: TrackConfig,
    feature_options: FeatureConfig,
) -> Refinement:
    """As ``refine``, for a model that may mean something else by its poses than COLMAP does.

    Such poses look like any others, but few matches agree with them, and nothing that follows from them is a result.

    Raises:
        InputError: the matches of most image pairs contradict the poses; it names the reading that they agree with.
    """
    refinement = refine(run, initial, collection, features, RefinementConfig(**vars(options)), feature_options)
    assert refinement is not None, "switched on"
    (result,), (scene,) = refinement.results, initial.scenes
    if result.succeeded and result.num_unverified_pairs <= result.num_pairs:
        return refinement
    agreeing = agreement(
        read_matched_features(features.database, scene.image_indices),
        dict(zip(scene.image_indices, scene.cam_from_world, strict=True)),
        {i: scene.cameras[camera] for i, camera in zip(scene.image_indices, scene.camera_indices, strict=True)},
        tolerance=initial.tolerance,
    )
    best = best_reading(agreeing)
    if not result.succeeded and (not agreeing or best == AS_COLMAP):  # for want of matches, or of points
        return refinement
    if best is None or best == AS_COLMAP:
        hint = (
            "nor do more with another usual reading. Are these the images of the model, as it saw them (COLMAP ignores "
            "their EXIF orientation), and are its focal lengths in pixels of the full image?"
        )
    else:
        hint = (
            f"but {agreeing[best]:.0%} do if the model has {best}. Write the poses as COLMAP's: from "
            "world to camera, axes x right, y down, z forward, and quaternions QW QX QY QZ"
        )
    num_pairs = result.num_pairs + result.num_unverified_pairs
    agreed = f"{agreeing[AS_COLMAP]:.0%} of the" if agreeing else f"only {result.num_pairs} of {num_pairs} pairs'"
    raise InputError(f"{agreed} matches agree with the poses of the model, so no result is written, {hint}")


def _match(
    run: Run,
    initial: InitialScenes,
    others: Sequence[int],
    seen: Sequence[Sequence[SeenSurface]],
    features: RunFeatures,
    per_image: int,
) -> tuple[Pair, ...]:
    """Match the pairs that see the same surface; returns all pairs that have been matched in the run."""
    with open_database(features.database) as database:
        pair_ids, _ = database.read_all_matches()
    known = {(a - 1, b - 1) for a, b in map(pycolmap.pair_id_to_image_pair, pair_ids)}
    wanted = {*_wanted_pairs(run, initial, seen, features, known, per_image), *initial.pairs_of_others}
    matched = match_pairs_of_run(run, features, sorted(wanted), title="track matching")
    verified = count_verified(features.database).keys() & set(initial.pairs_of_others)
    blurred = set(others) - {image for pair in verified for image in pair}
    if blurred:
        near = pairs_with_neighbours(len(features.usable), blurred)
        matched |= match_pairs_of_run(run, features, near, title="track matching of blurred images")
    return tuple(sorted(known | matched))


def _wanted_pairs(
    run: Run,
    initial: InitialScenes,
    seen: Sequence[Sequence[SeenSurface]],
    features: RunFeatures,
    known: Collection[Pair],
    per_image: int,
) -> tuple[Pair, ...]:
    """Pairs beyond ``known`` that see the same surface; stored, because at a second start they are known, too."""
    graph = initial.view_graph

    def compute(progress: Stage) -> tuple[Pair, ...]:
        # A backbone without features has matched nothing yet.
        near = set() if known else _next_images(graph)
        wanted = set(near)
        for surfaces in seen:
            wanted |= set(select_pairs(surfaces, per_image=per_image, known=near or known, around=graph.around))
            progress.advance()
        return tuple(sorted(wanted))

    inputs = (features.key, seen, per_image)
    return run.cached("track_pairs", inputs, compute, _PAIRS, total=len(seen), title="track pairs")


def _pairs_for_maps(initial: InitialScenes, seen: Sequence[Sequence[SeenSurface]], per_image: int) -> tuple[Pair, ...]:
    """Neighbours in order, and other images that see the same surface."""
    graph = initial.view_graph
    pairs = _next_images(graph)
    for surfaces in seen:
        pairs |= set(select_pairs(surfaces, per_image=per_image, known=(), around=graph.around))
    return tuple(sorted(pairs))


def _next_images(graph: ViewGraph) -> set[Pair]:
    return {(a, b) for step in range(1, NEXT_IMAGES + 1) for a, b in graph.pairs_apart(step).tolist()}


# --------------------------------------------------------------------------- results
def _adjusted_scene(scene: Scene, folder: Path, collection: ImageCollection) -> Scene:
    """The scene with poses and cameras of the model, also of the images that the refinement registered."""
    model = pycolmap.Reconstruction(folder)
    poses = poses_of(model)
    images = [collection.images[i] for i in poses]
    cameras = cameras_of(model, collection.cameras)
    return replace(
        scene,
        image_indices=tuple(poses),
        image_names=tuple(image.name for image in images),
        camera_indices=tuple(image.camera for image in images),
        cameras={image.camera: cameras[image.camera] for image in images},
        cam_from_world=np.stack(list(poses.values())),
        points=EMPTY_CLOUD,
    )
