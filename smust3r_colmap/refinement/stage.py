"""From a stitched model to one with real tracks and adjusted cameras: the stages and what they leave.

    track pairs      which images see the same surface            pair_selection
    track matching   SIFT of the new pairs                        backbones.classical.features
    refinement       triangulation, adjustment, in a child        task

Whatever fails or comes out worse leaves the stitched model as it is, with a reason.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from smust3r_colmap.colmap.database import open_database
from smust3r_colmap.config import RunConfig
from smust3r_colmap.errors import ConfigError
from smust3r_colmap.execution.stage_clock import StageClock
from smust3r_colmap.execution.task_pool import TaskFailure, map_tasks, usable_cores
from smust3r_colmap.features.covisibility import SeenSurface, sample_rows, select_pairs
from smust3r_colmap.features.matching import match_pairs
from smust3r_colmap.features.stage import features_of_run
from smust3r_colmap.geometry.arrays import FloatArray, Pair
from smust3r_colmap.geometry.camera import Intrinsics, pointmap_from_depth
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.products import EMPTY_CLOUD, DepthMaps, ImageCollection, RunFeatures, Scene
from smust3r_colmap.refinement.acceptance import StepReport
from smust3r_colmap.refinement.bundle_adjustment import ModelFigures
from smust3r_colmap.refinement.global_refinement import STAYED, RefinedFigures, RefineTask, refine_scenes
from smust3r_colmap.refinement.mapper import LOOSE_PART
from smust3r_colmap.storage.run_directory import (
    DATABASE_FILE,
    MODEL_FOLDER,
    RunDirectory,
    key_of,
    read_json,
    write_json,
)

CLOUD_POINTS_PER_IMAGE = 500
"""Of a cloud without tracks, how many points say what an image sees."""
MAX_CLOUD_POINTS = 50_000
"""Of a whole cloud: every image looks at all of them, 17 s for 1000 images."""
GRID = 12
"""Cells along the longer side of an image in which its surface is sampled."""
NEXT_IMAGES = 4
"""Neighbours in order that are matched in any case where no backbone has matched them."""
METHOD_VERSION = 5
"""To be raised when the refinement changes, so that finished folders are refined again."""
WORKERS_PER_THREAD = 2
"""Adjustment gains little from threads: on two cores a second one cost 70 % more processor time and saved none."""
MIN_CONFIDENCE = 1.5
"""Of depth that is sampled; 1 is none at all."""


@dataclass(frozen=True, kw_only=True)
class Refinement:
    """What came of the scenes.

    Args:
        folder: holds the models and the database.
        scenes: with adjusted poses and cameras, without points; the stitched one where refinement failed.
        figures: one per scene.
    """

    folder: Path
    scenes: tuple[Scene, ...]
    figures: tuple[RefinedFigures, ...]

    @property
    def database(self) -> Path:
        """Keypoints, matches and priors with the ids of the models."""
        return self.folder / DATABASE_FILE

    @property
    def models(self) -> tuple[Path | None, ...]:
        """Per scene the folder of its COLMAP model with tracks, or None where the stitched one was kept."""
        return tuple(self._model(number) if one.kept else None for number, one in enumerate(self.figures))

    def _model(self, number: int) -> Path:
        return self.folder / str(number) / MODEL_FOLDER


def refine(
    scenes: tuple[Scene, ...],
    collection: ImageCollection,
    maps: DepthMaps | None,
    features: RunFeatures | None,
    config: RunConfig,
    run: RunDirectory,
    clock: StageClock,
    *,
    parts: Sequence[Sequence[int]],
    surfaces: Mapping[int, FloatArray] | None = None,
    maps_key: str = "",
    tolerance: float = LOOSE_PART,
) -> Refinement:
    """Find tracks across each scene and adjust it to them.

    Args:
        scenes: stitched, largest first.
        collection: all images of the run.
        maps: depth of the stitched scenes; None where the model came without.
        features: the run's SIFT; extracted here where the backbone has none.
        config: ``refinement``, ``classical`` (features), ``workers`` and ``seed`` are used.
        run: keeps what is finished.
        clock: told about every stage.
        parts: image indices of the segments, adjusted by themselves first where the model is large.
        surfaces: (S, 3) world points that each image sees, by image index, where no depth maps say it.
        maps_key: hash of all that the maps were made from.
        tolerance: how far poses may be off, as a part of the longer image side, in the first round.

    Raises:
        ConfigError: tracks of pointmaps are wanted and there are no maps.
    """
    workers = config.workers or usable_cores()
    source = config.refinement.tracks
    if maps is None and source != "features":
        raise ConfigError(f"--tracks {source}: the model has no depth maps; take features")
    if surfaces is None:
        surfaces = surfaces_of_maps(scenes, maps) if maps is not None else surfaces_of_clouds(scenes)
    seen = [_seen_surfaces(scene, surfaces) for scene in scenes]
    pairs: tuple[Pair, ...] = ()
    if source == "pointmaps":
        features = None
    else:
        if features is None:
            features = features_of_run(collection, config.classical, run, clock, workers=workers, seed=config.seed)
        pairs = _match(seen, features, config, run, clock, workers=workers)
    map_pairs = () if source == "features" else _pairs_for_maps(seen, config.refinement.track_neighbours)
    geometry = [(s.image_names, s.image_indices, s.camera_indices, s.cameras, s.cam_from_world) for s in scenes]
    settings = (config.refinement, collection.calibrated, tolerance)
    inputs = (features and features.key, pairs, geometry, settings, maps_key)
    stored = run.stage("refined", key=key_of("refined", METHOD_VERSION, *inputs))
    with clock.stage("refinement", total=1) as stage:
        if stored.is_done:
            stage.skip(1)
        else:
            task = RefineTask(
                stored=stored,
                collection=collection,
                scenes=tuple(replace(scene, points=EMPTY_CLOUD) for scene in scenes),
                features=None if features is None else features.database,
                maps=maps if map_pairs else None,
                map_pairs=map_pairs,
                parts=tuple(tuple(part) for part in parts),
                calibrated=collection.calibrated,
                principal_point=config.refinement.principal_point,
                threads=max(1, workers // WORKERS_PER_THREAD),
                tolerance=tolerance,
                complete=config.refinement.complete,
            )
            (outcome,) = map_tasks(refine_scenes, [task], workers=1, log_file=run.native_log)
            stage.advance()
            if isinstance(outcome.value, TaskFailure):
                clock.warn(f"no tracks, the stitched model is kept: {outcome.value.reason}")
                return _not_refined(scenes, stored.path, outcome.value.reason)
    figures = tuple(_figures_from_json(facts) for facts in read_json(stored.path / "figures.json"))
    refined = Refinement(folder=stored.path, scenes=scenes, figures=figures)
    adjusted = tuple(
        scene if model is None else _adjusted_scene(scene, model, collection)
        for scene, model in zip(scenes, refined.models, strict=True)
    )
    return replace(refined, scenes=adjusted)


def _match(
    seen: Sequence[Sequence[SeenSurface]],
    features: RunFeatures,
    config: RunConfig,
    run: RunDirectory,
    clock: StageClock,
    *,
    workers: int,
) -> tuple[Pair, ...]:
    """Match the pairs that the geometry suggests; returns all pairs that have been matched in the run."""
    with open_database(features.database) as database:
        pair_ids, _ = database.read_all_matches()
    known = {(a - 1, b - 1) for a, b in map(pycolmap.pair_id_to_image_pair, pair_ids)}
    wanted = _wanted_pairs(seen, features, known, config.refinement.track_neighbours, run, clock)
    new = [(a, b) for a, b in wanted if features.usable[a] and features.usable[b]]
    with clock.stage("track matching", total=len(new)) as stage:
        matched = match_pairs(
            features.database, new, workers=workers, seed=config.seed, log_file=run.native_log, stage=stage
        )
    return tuple(sorted(known | matched))


def _wanted_pairs(
    seen: Sequence[Sequence[SeenSurface]],
    features: RunFeatures,
    known: Collection[Pair],
    per_image: int,
    run: RunDirectory,
    clock: StageClock,
) -> tuple[Pair, ...]:
    """What the geometry suggests beyond ``known``; stored, for at a second start the suggested pairs are known, too."""
    stored = run.stage("track_pairs", key=key_of("track pairs", features.key, seen, per_image))
    with clock.stage("track pairs", total=len(seen)) as stage:
        if stored.is_done:
            stage.skip(len(seen))
        else:
            # A backbone without features has matched nothing yet, neither neighbours nor images without a pose.
            near = set() if known else _next_images(range(len(features.usable)))
            wanted = set(near)
            for surfaces in seen:
                wanted |= set(select_pairs(surfaces, per_image=per_image, known=near or known))
                stage.advance()
            with stored.write() as folder:
                write_json(folder / "pairs.json", sorted(wanted))
    return tuple((a, b) for a, b in read_json(stored.path / "pairs.json"))


def _pairs_for_maps(seen: Sequence[Sequence[SeenSurface]], per_image: int) -> tuple[Pair, ...]:
    """The nearest neighbours in order, and the images of other passes that see the same surface."""
    pairs: set[Pair] = set()
    for surfaces in seen:
        images = sorted(surface.image for surface in surfaces)
        pairs |= _next_images(images) | set(select_pairs(surfaces, per_image=per_image, known=()))
    return tuple(sorted(pairs))


def _next_images(images: Sequence[int]) -> set[Pair]:
    return {(a, b) for step in range(1, NEXT_IMAGES + 1) for a, b in zip(images, images[step:], strict=False)}


# ------------------------------------------------------------------------- surfaces
def surfaces_of_maps(scenes: Sequence[Scene], maps: DepthMaps) -> dict[int, FloatArray]:
    """(S, 3) world points by image index: a grid over each depth map, where it is confident."""
    surfaces: dict[int, FloatArray] = {}
    for scene in reversed(scenes):
        for index, name, camera, pose in zip(
            scene.image_indices, scene.image_names, scene.camera_indices, scene.cam_from_world, strict=True
        ):
            if name not in maps:
                continue
            depth = np.where(maps.confidence(name) > MIN_CONFIDENCE, maps.depth(name), 0)
            step = max(1, max(depth.shape) // GRID)
            coarse = depth[step // 2 :: step, step // 2 :: step]
            intrinsics = scene.cameras[camera].resized(coarse.shape[1], coarse.shape[0])
            points = pointmap_from_depth(coarse, intrinsics, invert_rigid(pose)).reshape(-1, 3)
            surfaces[index] = points[np.isfinite(points).all(axis=1)].astype(np.float64)
    return surfaces


def surfaces_of_clouds(scenes: Sequence[Scene]) -> dict[int, FloatArray]:
    """The same from the points of the scenes: of those that fall into an image the nearest in every cell of a grid."""
    surfaces: dict[int, FloatArray] = {}
    for scene in reversed(scenes):
        wanted = min(CLOUD_POINTS_PER_IMAGE * len(scene), MAX_CLOUD_POINTS)
        xyz = scene.points.xyz[sample_rows(len(scene.points), wanted)]
        for index, camera, pose in zip(scene.image_indices, scene.camera_indices, scene.cam_from_world, strict=True):
            surfaces[index] = _nearest_in_cells(xyz, pose, scene.cameras[camera])
    return surfaces


def _nearest_in_cells(xyz: FloatArray, cam_from_world: FloatArray, intrinsics: Intrinsics) -> FloatArray:
    points_cam = xyz @ cam_from_world[:, :3].T + cam_from_world[:, 3]
    front = np.flatnonzero(points_cam[:, 2] > 0)
    if not len(front):
        return np.empty((0, 3))
    xy = np.nan_to_num(intrinsics.xy_img(points_cam[front]), nan=-1.0)
    inside = (xy >= 0).all(axis=1) & (xy[:, 0] < intrinsics.width) & (xy[:, 1] < intrinsics.height)
    front, cell = front[inside], (xy[inside] / (intrinsics.width, intrinsics.height) * GRID).astype(np.int64)
    order = np.argsort(points_cam[front, 2], kind="stable")
    _, first = np.unique((cell[:, 1] * GRID + cell[:, 0])[order], return_index=True)
    nearest: FloatArray = xyz[front[order[first]]]
    return nearest


def _seen_surfaces(scene: Scene, surfaces: Mapping[int, FloatArray]) -> list[SeenSurface]:
    return [
        SeenSurface(
            image=index,
            cam_from_world=pose,
            intrinsics=scene.cameras[camera],
            points_world=surfaces.get(index, np.empty((0, 3))),
        )
        for index, camera, pose in zip(scene.image_indices, scene.camera_indices, scene.cam_from_world, strict=True)
    ]


# --------------------------------------------------------------------------- results
def _adjusted_scene(scene: Scene, folder: Path, collection: ImageCollection) -> Scene:
    """The scene as the model with tracks has it; images that were placed late are in it, too."""
    model = pycolmap.Reconstruction(folder)
    indices = tuple(i - 1 for i in sorted(model.reg_image_ids()))
    images = [collection.images[i] for i in indices]
    return replace(
        scene,
        image_indices=indices,
        image_names=tuple(image.name for image in images),
        camera_indices=tuple(image.camera for image in images),
        cameras={image.camera: Intrinsics.from_colmap(model.camera(image.camera + 1)) for image in images},
        cam_from_world=np.stack([model.image(i + 1).cam_from_world().matrix() for i in indices]),
        points=EMPTY_CLOUD,
    )


def _not_refined(scenes: tuple[Scene, ...], folder: Path, reason: str) -> Refinement:
    def nothing(scene: Scene) -> RefinedFigures:
        final = ModelFigures(
            num_images=len(scene),
            num_points=0,
            num_observations=0,
            mean_track_length=0.0,
            reprojection_error_px=0.0,
            num_weak=len(scene),
        )
        return RefinedFigures(
            steps=(),
            num_pairs=0,
            num_matches=0,
            num_refused_pairs=0,
            weak=(),
            registered=(),
            final=final,
            kept=False,
            principal_point=STAYED,
            warnings=(),
            reason=reason,
        )

    return Refinement(folder=folder, scenes=scenes, figures=tuple(map(nothing, scenes)))


def _figures_from_json(facts: Mapping[str, Any]) -> RefinedFigures:
    steps = tuple(
        StepReport(**{**step, "before": ModelFigures(**step["before"]), "after": ModelFigures(**step["after"])})
        for step in facts["steps"]
    )
    listed = {name: tuple(facts[name]) for name in ("weak", "registered", "warnings")}
    return RefinedFigures(**{**facts, **listed, "steps": steps, "final": ModelFigures(**facts["final"])})
