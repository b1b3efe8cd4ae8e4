"""A small finished run with known truth: what ``reconstruct`` leaves, made without its slow parts.

The images show nothing; their features and matches are made up, and so are their depth maps. Refinement, database
and formats are the real ones.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap
from PIL import Image

from helpers.tracked_scenes import (
    World,
    cam_from_world_towards,
    disturbed,
    make_world,
    stitched_scene,
    true_matches,
    write_features,
)
from smust3r_colmap.config import CameraConfig
from smust3r_colmap.exporters.finished_run import FinishedRun, write_finished
from smust3r_colmap.exporters.registry import FORMATS, FormatSettings
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.importers.image_folder import collection_from_scan, scan_image_folder
from smust3r_colmap.importers.image_scan import RECORDS
from smust3r_colmap.products import FusedScene, ImageCollection, PointCloud
from smust3r_colmap.refinement.global_refinement import RefineTask, refine_scenes
from smust3r_colmap.refinement.statistics import SceneRefinement
from smust3r_colmap.storage.depth_maps import DepthMapWriter, StoredDepthMaps
from smust3r_colmap.storage.run_directory import DATABASE_FILE, MODEL_FOLDER, RunDirectory, key_of
from smust3r_colmap.storage.scenes import FUSED_SCENES

CAMERA = Intrinsics(model="SIMPLE_RADIAL", width=320, height=240, params=(290.0, 160.0, 120.0, -0.03))
NAMES = tuple(f"große Halle/view {k:02d}.png" for k in range(11))
"""Blanks, a subfolder and a letter beyond ASCII, in natural order."""
NUM_PLACED = 9
"""The images after these have no matches, and the last of all not even features."""
WITHOUT_FEATURES = NUM_PLACED + 1
_SLOPE, _CORNER_Z = 0.6, 2.0
"""The scene is a corner of a room: z + 0.6 |x| = 2."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Example:
    """The run in ``root``, its images, and the truth."""

    root: Path
    images: Path
    world: World
    result: SceneRefinement

    @property
    def model(self) -> pycolmap.Reconstruction:
        """Read anew at every call, to be changed at will."""
        return pycolmap.Reconstruction(self.root / "sparse/0")


def make_finished_run(folder: Path) -> Example:
    """Images in ``folder/images``, the run in ``folder/run``, with a model, a database and a dense workspace."""
    images, world = folder / "images", corner_of_a_room()
    for k, name in enumerate(NAMES):
        (images / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (CAMERA.width, CAMERA.height), (200, 120, 40 + k)).save(images / name)
    with RunDirectory(folder / "run") as run:
        scan = scan_image_folder(images)
        with run.stage("import", key=key_of("import")).write() as stage:
            RECORDS.write(stage, scan.records)
        collection = collection_from_scan(scan, CameraConfig())
        result = refine_corner(run, collection, world, placed=range(NUM_PLACED))
        finished = _store(run, collection, world, images)
        for name in ("sparse", "database", "ply", "dense"):
            FORMATS[name].write(finished, FormatSettings())
        write_finished(run, finished)
    return Example(root=folder / "run", images=images, world=world, result=result)


def corner_of_a_room() -> World:
    """Cameras that walk to the right in front of the corner, looking into it."""
    rng = np.random.default_rng(5)
    x, y = rng.uniform(-3, 3, 350), rng.uniform(-1.8, 1.8, 350)
    along = np.linspace(-2, 2, len(NAMES))
    centres = np.column_stack([along, 0.3 * np.sin(3 * along), -3 + 0.2 * np.cos(5 * along)])
    cam_from_world = cam_from_world_towards(centres, np.column_stack([0.5 * along, 0 * along, 0 * along + 1]))
    points = np.column_stack([x, y, _CORNER_Z - _SLOPE * np.abs(x)])
    return make_world(cam_from_world, points, rng, camera=CAMERA, noise_px=0.2)


def refine_corner(
    run: RunDirectory,
    collection: ImageCollection,
    world: World,
    *,
    placed: Collection[int],
    register_missing: bool = False,
) -> SceneRefinement:
    """The stage ``refined`` of ``placed`` images; all but the last two of the collection have matches."""
    features = run.work / "features.db"
    matched = {pair: true_matches(world, pair) for pair in combinations(range(NUM_PLACED), 2)}
    write_features(features, collection, world, verified=matched, without_features=(WITHOUT_FEATURES,))
    rng = np.random.default_rng(6)
    stitched = disturbed(world.cam_from_world, rng, position=0.01, rotation_deg=0.1)
    task = RefineTask(
        stored=run.stage("refined", key="refined"),
        collection=collection,
        scenes=(stitched_scene(collection, stitched, placed, {0: CAMERA}),),
        features=features,
        maps=None,
        map_pairs=(),
        segments=(tuple(placed),),
        calibrated=False,
        principal_point=False,
        threads=1,
        register_missing=register_missing,
    )
    (result,) = refine_scenes(task)
    return result


def _store(run: RunDirectory, collection: ImageCollection, world: World, images: Path) -> FinishedRun:
    """The other stages that formats are written from, and what they make together."""
    model = pycolmap.Reconstruction(run.work / "refined/0" / MODEL_FOLDER)
    poses = [model.image(i).cam_from_world().matrix() for i in sorted(model.reg_image_ids())]
    points = list(model.points3D.values())
    scene = stitched_scene(collection, np.array(poses), range(len(poses)), {0: Intrinsics.from_colmap(model.camera(1))})
    cloud = PointCloud(xyz=np.array([p.xyz for p in points]), rgb=np.array([p.color for p in points]))
    with run.stage("scene", key="scene").write() as stage:
        FUSED_SCENES.write(stage, (FusedScene(scene=replace(scene, points=cloud), statistics=None),))
    with run.stage("stitched", key="stitched").write() as stage:
        maps = DepthMapWriter(stage)
        for k in range(NUM_PLACED):
            depth = _depth(world.cam_from_world[k])
            maps.write(NAMES[k], depth, np.full_like(depth, 3))
        maps.finish()
    refined = run.work / "refined"
    return FinishedRun(
        output=run.root,
        native_log=run.native_log,
        images=images,
        scenes=tuple(one.scene for one in FUSED_SCENES.read(run.work / "scene")),
        models=(refined / "0" / MODEL_FOLDER,),
        database=refined / DATABASE_FILE,
        maps=StoredDepthMaps(run.work / "stitched"),
    )


def _depth(cam_from_world: FloatArray) -> npt.NDArray[np.float32]:
    """(H, W) z-depth of the corner, at half the size of the image."""
    small = CAMERA.resized(CAMERA.width // 2, CAMERA.height // 2)
    world_from_cam = invert_rigid(cam_from_world)
    rays_world = small.rays_cam(pixel_centres(small.width, small.height)) @ world_from_cam[:, :3].T
    x, _, z = world_from_cam[:, 3]
    walls = [
        (_CORNER_Z - z - side * _SLOPE * x) / (rays_world[:, 2] + side * _SLOPE * rays_world[:, 0]) for side in (-1, 1)
    ]
    nearest = np.min(np.where(np.array(walls) > 0, walls, np.inf), axis=0)
    depth: npt.NDArray[np.float32] = nearest.reshape(small.height, small.width).astype(np.float32)
    return depth


def content(folder: Path) -> dict[str, bytes]:
    """Of every file below the folder, by its name; but of no lock."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != "lock")
    return {path.relative_to(folder).as_posix(): _bytes_of(path) for path in files}


def _bytes_of(path: Path) -> bytes:
    """Of a database without the two counters of its header, which pycolmap raises when it only opens one."""
    data = path.read_bytes()
    return data[:24] + data[28:92] + data[96:] if path.suffix == ".db" else data
