"""One cloud for every scene, on its cameras as they are now.

The next module to read is ``point_cloud``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from smust3r_colmap.backbones.base import BackboneResult
from smust3r_colmap.config import FusionConfig
from smust3r_colmap.dense.carried_depth import DepthView, carry_depth
from smust3r_colmap.dense.depth_consistency import depth_scales
from smust3r_colmap.dense.point_cloud import fuse_points
from smust3r_colmap.execution.progress import Stage
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.products import DepthMaps, FusedScene, Scene
from smust3r_colmap.refinement.stage import InitialScenes, Refinement
from smust3r_colmap.segmentation.stage import Segments
from smust3r_colmap.stitching.camera_fusion import FusedCameras
from smust3r_colmap.stitching.stage import Stitched, placed_submodels
from smust3r_colmap.storage.depth_maps import DepthMapWriter, JoinedDepthMaps, StoredDepthMaps
from smust3r_colmap.storage.run_directory import CARRIED_DEPTH_STAGE, SCENE_STAGE
from smust3r_colmap.storage.scenes import FUSED_SCENES


def fuse(
    run: Run,
    result: BackboneResult,
    segments: Segments,
    stitched: Stitched,
    refinement: Refinement | None,
    options: FusionConfig,
) -> tuple[FusedScene, ...]:
    """The scenes, refined where refinement was wanted, each with its cloud; largest first."""
    scenes = stitched.scenes if refinement is None else refinement.scenes

    def compute(progress: Stage) -> tuple[FusedScene, ...]:
        fused = []
        for number, scene in enumerate(scenes):
            placed, dense = placed_submodels(scene, stitched, result, segments)
            model = None if refinement is None else refinement.models[number]
            cameras, scale = stitched.placed[number].cameras, None
            if model is not None:
                cameras = _with_poses_of(scene, cameras)
                scale = _depth_scale(cameras, pycolmap.Reconstruction(model), stitched.maps)
            points = fuse_points(
                placed,
                dense,
                cameras,
                max_points=options.max_points,
                min_confidence=options.min_confidence,
                depth_scale=scale,
            )
            fused.append(FusedScene(scene=replace(scene, points=points.cloud), statistics=points.statistics))
            progress.advance()
        return tuple(fused)

    geometry = [(scene.image_names, scene.cam_from_world, scene.cameras, scene.segments) for scene in scenes]
    inputs = (geometry, result.dense_key, options)
    return run.cached(SCENE_STAGE, inputs, compute, FUSED_SCENES, total=len(scenes), title="fusion")


def with_depth_of_others(
    run: Run, initial: InitialScenes, segments: Segments, refinement: Refinement | None
) -> InitialScenes:
    """The scenes with depth, too, of the images that are no keyframes and were registered to the refined models."""
    maps = initial.maps
    if refinement is None or maps is None or not segments.others:
        return initial
    beside: dict[int, list[int]] = {image: [] for image in segments.others}
    for pair in segments.pairs_of_others:
        for image, other in (pair, pair[::-1]):
            if image in beside:
                beside[image].append(other)

    def write(folder: Path, progress: Stage) -> None:
        writer = DepthMapWriter(folder)
        for scene, model in zip(refinement.scenes, refinement.models, strict=True):
            scales = {} if model is None else depth_scales(pycolmap.Reconstruction(model), maps)
            views = _DepthViews(scene, maps, scales)
            for k, image in enumerate(scene.image_indices):
                if image not in beside:
                    continue
                seen = [views[keyframe] for keyframe in beside[image] if keyframe in views]
                if seen:
                    camera = scene.cameras[scene.camera_indices[k]]
                    writer.write(scene.image_names[k], *carry_depth(seen, camera, scene.cam_from_world[k]))
                progress.advance()
        writer.finish()

    registered = {image for scene in refinement.scenes for image in scene.image_indices}
    folder = run.cached_folder(
        CARRIED_DEPTH_STAGE,
        (refinement.key, segments.pairs_of_others),
        write,
        total=len(registered & beside.keys()),
        title="depth of other images",
    )
    return replace(initial, maps=JoinedDepthMaps(maps, StoredDepthMaps(folder)))


class _DepthViews:
    """The keyframes of a scene with their depth in its unit.

    Args:
        scene: with adjusted poses. maps: in the unit of stitching. scales: by image id, from the one to the other.
    """

    def __init__(self, scene: Scene, maps: DepthMaps, scales: Mapping[int, float]) -> None:
        self._scene, self._maps, self._scales = scene, maps, scales
        self._position = {image: k for k, image in enumerate(scene.image_indices)}

    def __contains__(self, image: int) -> bool:
        return image in self._position and self._scene.image_names[self._position[image]] in self._maps

    def __getitem__(self, image: int) -> DepthView:
        k = self._position[image]
        name = self._scene.image_names[k]
        return DepthView(
            depth=(self._maps.depth(name) * self._scales.get(image + 1, 1.0)).astype(np.float32),
            confidence=self._maps.confidence(name),
            intrinsics=self._scene.cameras[self._scene.camera_indices[k]],
            cam_from_world=self._scene.cam_from_world[k],
        )


def _with_poses_of(scene: Scene, cameras: FusedCameras) -> FusedCameras:
    """The fused cameras, moved to where the scene has them."""
    position = {image: k for k, image in enumerate(scene.image_indices)}
    return replace(cameras, cam_from_world=scene.cam_from_world[[position[image] for image in cameras.images]])


def _depth_scale(cameras: FusedCameras, model: pycolmap.Reconstruction, maps: DepthMaps) -> FloatArray:
    """(N,) what each depth map is to be multiplied with to fit the points of the model."""
    scales = depth_scales(model, maps)
    return np.array([scales[image + 1] for image in cameras.images])
