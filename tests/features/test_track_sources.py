"""Where tracks come from, for a backbone with depth maps and no features: from start to end, on a known room."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers.runs import quiet_run
from helpers.tracked_scenes import disturbed, stitched_scene
from PIL import Image

from smust3r_colmap.config import CameraConfig, FeatureConfig, RefinementConfig, TrackSource
from smust3r_colmap.evaluation.trajectory import compare_trajectories
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.importers.image_folder import collection_from_scan, scan_image_folder
from smust3r_colmap.refinement.stage import InitialScenes, Refinement, refine
from smust3r_colmap.segmentation.view_graph import ViewGraph
from smust3r_colmap.storage.depth_maps import DepthMapWriter, StoredDepthMaps
from smust3r_colmap.synthetic.room import DemoScene, demo_intrinsics

pytestmark = pytest.mark.slow

NUM_IMAGES, WITHOUT_POSE = 7, 6
CAMERA = demo_intrinsics(320, 240)
CONFIDENCE, SCALE_ERROR = 3.0, 1.01


@dataclass(frozen=True, kw_only=True, eq=False)
class Room:
    """Photographs with depth, and what stitching is said to have made of their (N, 3, 4) ``world_from_cam``."""

    images: Path
    world_from_cam: FloatArray
    stitched: FloatArray
    depth: tuple[FloatArray, ...]

    def error_of(self, world_from_cam: dict[str, FloatArray]) -> float:
        truth = {f"{k}.png": pose for k, pose in enumerate(self.world_from_cam)}
        return compare_trajectories(world_from_cam, truth).position_rmse


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Room:
    images = tmp_path_factory.mktemp("room") / "images"
    images.mkdir()
    scene = DemoScene()
    world_from_cam = scene.camera_path(32)[:NUM_IMAGES]
    depth = []
    for k, pose in enumerate(world_from_cam):
        rgb, one = scene.render(pose, CAMERA)
        Image.fromarray(rgb).save(images / f"{k}.png")
        depth.append(one.astype(np.float64))
    stitched = disturbed(invert_rigid(world_from_cam), np.random.default_rng(0), position=0.01, rotation_deg=0.3)
    return Room(images=images, world_from_cam=world_from_cam, stitched=stitched, depth=tuple(depth))


def refined(room: Room, output: Path, source: TrackSource) -> Refinement:
    posed = range(WITHOUT_POSE)
    with quiet_run(output) as run:
        collection = collection_from_scan(scan_image_folder(room.images), CameraConfig())
        scene = stitched_scene(collection, room.stitched, posed, {0: CAMERA})
        with run.folder.stage("stitched", key="a test").write() as folder:
            maps = DepthMapWriter(folder)
            for k in posed:
                depth = (SCALE_ERROR * room.depth[k][::2, ::2]).astype(np.float32)
                maps.write(f"{k}.png", depth, np.full(depth.shape, CONFIDENCE, np.float32))
            maps.finish()
        initial = InitialScenes(
            scenes=(scene,),
            subsets=(tuple(posed),),
            view_graph=ViewGraph.chain(len(collection)),
            maps=StoredDepthMaps(run.folder.work / "stitched"),
        )
        found = refine(run, initial, collection, None, RefinementConfig(track_source=source), FeatureConfig())
    assert found is not None
    return found


@pytest.mark.parametrize("source", ["features", "pointmaps", "both"])
def test_tracks_of_every_source_bring_the_cameras_to_the_truth(source: TrackSource, room: Room, tmp_path: Path) -> None:
    result = refined(room, tmp_path / "out", source)
    (refinement,), (folder,) = result.results, result.models
    assert folder is not None
    assert refinement.weak == ()
    model = pycolmap.Reconstruction(folder)
    assert min(point.track.length() for point in model.points3D.values()) >= 2
    before = {f"{k}.png": pose for k, pose in enumerate(invert_rigid(room.stitched))}
    after = {image.name: image.cam_from_world().inverse().matrix() for image in model.images.values() if image.has_pose}
    assert room.error_of(after) < room.error_of(before) / 3
    # Only features can say where an image without depth stands.
    assert refinement.registered == (() if source == "pointmaps" else (f"{WITHOUT_POSE}.png",))
    with pycolmap.Database.open(result.database) as database:
        assert all(database.num_keypoints_for_image(k + 1) for k in range(WITHOUT_POSE))
    again = tmp_path / "triangulated"
    again.mkdir()
    assert pycolmap.triangulate_points(model, result.database, room.images, again).num_points3D() > 100
