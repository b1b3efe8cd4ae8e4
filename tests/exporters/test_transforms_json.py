"""transforms.json by the rules of nerfstudio and instant-ngp."""

from __future__ import annotations

from typing import Any

import numpy as np
import pycolmap
import pytest

from smust3r_colmap.exporters.transforms_json import points_saved, transforms_json
from smust3r_colmap.products import PointCloud


def some_model(num_cameras: int) -> pycolmap.Reconstruction:
    """Six images of forty points that all of them see, without noise."""
    pycolmap.set_random_seed(4)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=num_cameras,
        num_cameras_per_rig=1,
        num_frames_per_rig=6 // num_cameras,
        num_points3D=40,
        num_points2D_without_point3D=0,
        camera_width=640,
        camera_height=480,
        camera_model_id=pycolmap.CameraModelId.PINHOLE,
        camera_params=[600, 610, 320, 240],
    )
    return pycolmap.synthesize_dataset(options)


def cloud_of(model: pycolmap.Reconstruction) -> PointCloud:
    xyz = np.array([point.xyz for point in model.points3D.values()])
    normals = np.tile(np.array([0, 1, 0], np.float32), (len(xyz), 1))
    return PointCloud(xyz=xyz, rgb=np.zeros((len(xyz), 3), np.uint8), normals=normals)


def intrinsics_of(document: dict[str, Any], frame: dict[str, Any]) -> dict[str, Any]:
    """nerfstudio: what stands at the top level counts for all frames."""
    return document if "fl_x" in document else frame


@pytest.mark.parametrize("num_cameras", [1, 2])
def test_opengl_cameras_see_the_saved_points_where_the_model_does(num_cameras: int) -> None:
    model = some_model(num_cameras)
    document = transforms_json(model)
    points = points_saved(cloud_of(model)).xyz
    row_of = {point_id: row for row, point_id in enumerate(model.points3D)}
    assert ("fl_x" in document) == (num_cameras == 1)
    for frame in document["frames"]:
        image = model.image(frame["colmap_im_id"])
        lens = intrinsics_of(document, frame)
        matrix = np.array(frame["transform_matrix"])
        assert matrix.shape == (4, 4) and np.linalg.det(matrix) == pytest.approx(1)
        in_cam = (points - matrix[:3, 3]) @ matrix[:3, :3]  # x right, y up, z backward
        assert (in_cam[:, 2] < 0).all()
        x = lens["cx"] + lens["fl_x"] * in_cam[:, 0] / -in_cam[:, 2]
        y = lens["cy"] - lens["fl_y"] * in_cam[:, 1] / -in_cam[:, 2]
        for observed in image.points2D:
            row = row_of[observed.point3D_id]
            np.testing.assert_allclose((x[row], y[row]), observed.xy, atol=1e-6)
        assert (lens["w"], lens["h"]) == (640, 480)
        assert lens["k1"] == lens["k2"] == lens["p1"] == lens["p2"] == 0
        assert frame["file_path"] == f"images/{image.name}"


def test_applied_transform_leads_from_the_model_to_the_file_with_z_up() -> None:
    model = some_model(1)
    document = transforms_json(model)
    applied = np.array(document["applied_transform"])
    assert applied.tolist() == [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]
    for frame in document["frames"]:
        centre = model.image(frame["colmap_im_id"]).projection_center()
        np.testing.assert_allclose(applied @ [*centre, 1], np.array(frame["transform_matrix"])[:3, 3], atol=1e-12)
    saved = points_saved(cloud_of(model))
    assert saved.normals is not None
    np.testing.assert_allclose(saved.normals, np.tile([0, 0, -1], (40, 1)), atol=1e-7)  # y down, so +y is -z


def test_masks_stand_in_every_frame_or_in_none() -> None:
    model = some_model(2)
    mask_of = {image.name: f"masks/{image.image_id}.png" for image in model.images.values()}
    for frame in transforms_json(model, mask_of=mask_of)["frames"]:
        assert frame["mask_path"] == f"masks/{frame['colmap_im_id']}.png"
    assert not any("mask_path" in frame for frame in transforms_json(model)["frames"])


def test_instant_ngp_gets_the_cameras_and_most_points_into_its_unit_cube() -> None:
    model = some_model(1)
    document = transforms_json(model)
    assert document["aabb_scale"] in (1, 2, 4, 8, 16, 32, 64, 128)
    scale, offset = document["scale"], np.array(document["offset"])
    centres = np.array([np.array(frame["transform_matrix"])[:3, 3] for frame in document["frames"]])
    cameras = scale * centres + offset
    points = scale * points_saved(cloud_of(model)).xyz + offset
    assert cameras.min() >= -1e-9 and cameras.max() <= 1 + 1e-9
    assert ((points > 0) & (points < 1)).all(axis=1).mean() > 0.7
    extent = np.ptp(np.concatenate([cameras, points]), axis=0).max()
    assert 0.9 < extent < 2
