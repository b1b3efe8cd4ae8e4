"""A data set with the depth of a Kinect, and a dense workspace of it with stated errors."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap
from PIL import Image
from scipy.spatial.transform import Rotation

from helpers.dense_scenes import cameras_from_world, exact_depth, picture
from smust3r_colmap.evaluation.depth_error import VIEW_FROM_SENSOR
from smust3r_colmap.exporters.dense_workspace import write_map
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres
from smust3r_colmap.geometry.sim3 import invert_rigid

FloatMap = npt.NDArray[np.float32]

VIEW = Intrinsics(model="PINHOLE", width=120, height=90, params=(100.0, 102.0, 61.0, 44.0))
SENSOR = Intrinsics(model="PINHOLE", width=160, height=120, params=(146.0, 146.0, 80.0, 60.0))
NAMES = ("a.jpg", "b.jpg", "c.jpg", "d.jpg")
UNIT_M = 0.25  # of the model


def compose(c_from_b: FloatArray, b_from_a: FloatArray) -> FloatArray:
    """(3, 4) rigid."""
    return np.column_stack([c_from_b[:, :3] @ b_from_a[:, :3], c_from_b[:, :3] @ b_from_a[:, 3] + c_from_b[:, 3]])


def view_poses() -> dict[str, FloatArray]:
    """``cam_from_world`` in metres."""
    return dict(zip(NAMES, cameras_from_world(len(NAMES)), strict=True))


def write_data(folder: Path) -> Path:
    """What the nominal Kinect beside each view measures; ``d.jpg`` has no depth."""
    for name in ("images", "depth"):
        (folder / name).mkdir(parents=True)
    lines = []
    for name, view_from_world in view_poses().items():
        sensor_from_world = compose(invert_rigid(VIEW_FROM_SENSOR["kinect"]), view_from_world)
        world_from_sensor = invert_rigid(sensor_from_world)
        x, y, z, w = Rotation.from_matrix(world_from_sensor[:, :3]).as_quat()
        lines.append(" ".join(map(str, (name, w, x, y, z, *world_from_sensor[:, 3]))))
        Image.fromarray(picture(VIEW, view_from_world)).save(folder / "images" / name)
        if name != "d.jpg":
            millimetres = np.rint(1000 * exact_depth(SENSOR, sensor_from_world)).astype(np.uint16)
            millimetres[:, :16] = 0
            Image.fromarray(millimetres).save(folder / "depth" / f"{name[:-4]}.png")
    (folder / "poses.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    values = (SENSOR.width, SENSOR.height, *SENSOR.params)
    (folder / "intrinsics.txt").write_text(" ".join(map(str, values)), encoding="utf-8")
    return folder


def write_run(folder: Path, factors: Mapping[str, float], *, holes: int = 0) -> Path:
    """A dense workspace in units of ``UNIT_M``, each depth map wrong by its factor and empty in the first rows."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(VIEW.colmap_camera(1))
    seen: list[list[pycolmap.TrackElement]] = []
    places = []
    for number, (name, pose) in enumerate(view_poses().items(), start=1):
        in_units = np.column_stack([pose[:, :3], pose[:, 3] / UNIT_M])
        depth = exact_depth(VIEW, pose) / np.float32(UNIT_M)
        image = pycolmap.Image(name=name, camera_id=1, image_id=number)
        xy, points_world = some_points(depth, in_units)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(one) for one in xy])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(in_units))
        seen += [[pycolmap.TrackElement(number, k)] for k in range(len(xy))]
        places += list(points_world)
        if name in factors:
            depth[:holes] = 0
            write_map(folder / f"dense/stereo/depth_maps/{name}.geometric.bin", depth * np.float32(factors[name]))
    for place, elements in zip(places, seen, strict=True):
        model.add_point3D(place, pycolmap.Track(elements), np.zeros(3, np.uint8))
    (folder / "dense/sparse").mkdir(parents=True)
    model.write_binary(folder / "dense/sparse")
    return folder


def some_points(depth: FloatMap, cam_from_world: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(N, 2) pixel centres and (N, 3) what is seen there."""
    xy = pixel_centres(VIEW.width, VIEW.height)[::371]
    points_cam = VIEW.rays_cam(xy) * depth[xy[:, 1].astype(int), xy[:, 0].astype(int), None]
    return xy, (points_cam - cam_from_world[:, 3]) @ cam_from_world[:, :3]
