"""Points of an external model that have no track, carried to the adjusted cameras.

The next module to read is ``exporters.registry``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap

from smust3r_colmap.alignment.from_poses import align_poses
from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.estimators.robust import evenly_chosen
from smust3r_colmap.execution.progress import Stage
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.geometry.arrays import IntArray
from smust3r_colmap.geometry.sim3 import Sim3, invert_rigid
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.products import FusedScene, PointCloud, Scene, Submodel
from smust3r_colmap.refinement.stage import Refinement
from smust3r_colmap.storage.run_directory import SCENE_STAGE
from smust3r_colmap.storage.scenes import FUSED_SCENES

MAX_ALIGNED_CAMERAS = 500
"""Cameras that say how all have moved as a whole; the alignment compares every two of them, which takes 3.6 GB of
5,000, and no similarity is better known by more."""


def fuse_external(run: Run, start: Scene, untracked: PointCloud, refinement: Refinement) -> FusedScene:
    """The refined scene with its tracked points, and behind them the given ones that have no track.

    Args:
        start: the scene before.
        untracked: points of the model without a track, in the world of ``start``.
    """

    def compute(progress: Stage) -> tuple[FusedScene, ...]:
        (folder,) = refinement.models
        scene = start
        if folder is not None:
            scene = _with_points(start, refinement.scenes[0], untracked, pycolmap.Reconstruction(folder))
        progress.advance()
        return (FusedScene(scene=scene, statistics=None),)

    geometry = [(scene.image_names, scene.cam_from_world, scene.cameras) for scene in (start, *refinement.scenes)]
    inputs = (geometry, refinement.key, start.points, untracked)
    (fused,) = run.cached(SCENE_STAGE, inputs, compute, FUSED_SCENES, title="points without tracks")
    return fused


def _with_points(start: Scene, refined: Scene, untracked: PointCloud, model: pycolmap.Reconstruction) -> Scene:
    tracked = list(model.points3D.values())
    moved = refined_from_start(start, refined, _median_depth(model)).apply(untracked.xyz)
    cloud = PointCloud(
        xyz=np.concatenate([np.reshape([point.xyz for point in tracked], (-1, 3)), moved]),
        rgb=np.concatenate([np.reshape([point.color for point in tracked], (-1, 3)).astype(np.uint8), untracked.rgb]),
    )
    return replace(refined, points=cloud)


def refined_from_start(start: Scene, refined: Scene, depth: float) -> Transform:
    """How the cameras have moved as a whole, for points that hang on no camera in particular.

    One similarity for all points. To move each with the cameras that may see it would need to know which do: by
    projection alone, walls between them unknown, the points of castle_p30 came to lie a third farther from the tracks.

    Args:
        start, refined: the first has no image that the second lacks.
        depth: median depth of the scene in the world of ``refined``.
    """
    before = _cameras_as_submodel(start, evenly_chosen(len(start), MAX_ALIGNED_CAMERAS))
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
