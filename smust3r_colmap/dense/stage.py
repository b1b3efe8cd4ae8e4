"""One cloud for every scene, on its cameras as they are now.

The next module to read is ``point_cloud``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap

from smust3r_colmap.backbones.base import BackboneResult
from smust3r_colmap.config import FusionConfig
from smust3r_colmap.dense.depth_consistency import depth_scales
from smust3r_colmap.dense.point_cloud import fuse_points
from smust3r_colmap.execution.progress import Stage
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.products import DepthMaps, FusedScene, Scene
from smust3r_colmap.refinement.stage import Refinement
from smust3r_colmap.segmentation.stage import Segments
from smust3r_colmap.stitching.camera_fusion import FusedCameras
from smust3r_colmap.stitching.stage import Stitched, placed_submodels
from smust3r_colmap.storage.run_directory import SCENE_STAGE
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


def _with_poses_of(scene: Scene, cameras: FusedCameras) -> FusedCameras:
    """The fused cameras, moved to where the scene has them."""
    position = {image: k for k, image in enumerate(scene.image_indices)}
    return replace(cameras, cam_from_world=scene.cam_from_world[[position[image] for image in cameras.images]])


def _depth_scale(cameras: FusedCameras, model: pycolmap.Reconstruction, maps: DepthMaps) -> FloatArray:
    """(N,) what each depth map is to be multiplied with to fit the points of the model."""
    scales = depth_scales(model, maps)
    return np.array([scales[image + 1] for image in cameras.images])
