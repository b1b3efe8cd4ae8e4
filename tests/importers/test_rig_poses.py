"""Poses by rigs and frames, as pycolmap writes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from smust3r_colmap.errors import InputError
from smust3r_colmap.importers.colmap_model import read_colmap_model
from smust3r_colmap.importers.rig_poses import composed, is_same_pose, poses_by_image


def rigid(rotation_deg: tuple[float, float, float], translation: tuple[float, float, float]) -> pycolmap.Rigid3d:
    turn = Rotation.from_euler("xyz", rotation_deg, degrees=True).as_matrix()
    return pycolmap.Rigid3d(pycolmap.Rotation3d(turn), np.array(translation))


@pytest.fixture
def model(tmp_path: Path) -> pycolmap.Reconstruction:
    """Two frames of a rig with a second camera 0.2 to the right, turned by 30 degrees."""
    model = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=4)
    for camera_id in (1, 2):
        camera = pycolmap.Camera(camera_id=camera_id, model="PINHOLE", width=64, height=48, params=[60, 60, 32, 24])
        model.add_camera(camera)
        if camera_id == 1:
            rig.add_ref_sensor(camera.sensor_id)
        else:
            rig.add_sensor(camera.sensor_id, rigid((0, 30, 0), (-0.2, 0, 0)))
    model.add_rig(rig)
    for number in (1, 2):
        frame = pycolmap.Frame(frame_id=number, rig_id=4)
        images = [
            pycolmap.Image(name=f"{side}/{number}.jpg", camera_id=camera, image_id=2 * number + camera)
            for camera, side in ((1, "left"), (2, "right"))
        ]
        for image in images:
            frame.add_data_id(image.data_id)
            image.frame_id = number
        frame.rig_from_world = rigid((5.0 * number, 10, 0), (number, 0.5, 2))
        model.add_frame(frame)
        for image in images:
            model.add_image(image)
        model.register_frame(number)
    return model


@pytest.mark.parametrize("suffix", [".txt", ".bin"])
def test_poses_are_those_that_colmap_composes(model: pycolmap.Reconstruction, suffix: str, tmp_path: Path) -> None:
    (model.write_text if suffix == ".txt" else model.write_binary)(tmp_path)
    poses = poses_by_image(tmp_path, suffix)
    assert sorted(poses) == [3, 4, 5, 6]
    for image_id, pose in poses.items():
        truth = model.image(image_id).cam_from_world()
        x, y, z, w = truth.rotation.quat
        assert is_same_pose(pose, (w, x, y, z, *truth.translation))


@pytest.mark.parametrize("suffix", [".txt", ".bin"])
def test_stale_lines_of_images_give_way_to_rigs_and_frames(
    model: pycolmap.Reconstruction, suffix: str, tmp_path: Path
) -> None:
    model.write_binary(tmp_path)
    stale = pycolmap.Reconstruction(tmp_path)
    stale.rig(4).set_sensor_from_rig(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 2), rigid((0, 42, 0), (0.4, 0, 0)))
    write = "write_text" if suffix == ".txt" else "write_binary"
    for of, folder in ((model, "new"), (stale, "old")):
        (tmp_path / folder).mkdir()
        getattr(of, write)(tmp_path / folder)
    (tmp_path / "old" / f"images{suffix}").replace(tmp_path / "new" / f"images{suffix}")
    read = read_colmap_model(tmp_path / "new")
    assert any(fix.startswith("2 images have another pose in their line than by rigs") for fix in read.fixes)
    for name, pose in zip(read.names, read.cam_from_world, strict=True):
        image = model.find_image_with_name(name)
        assert image is not None
        assert pose == pytest.approx(image.cam_from_world().matrix(), abs=1e-6)


def test_models_without_frames_keep_their_poses(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    model.write_text(tmp_path)
    (tmp_path / "frames.txt").unlink()
    assert poses_by_image(tmp_path, ".txt") == {}
    assert read_colmap_model(tmp_path).fixes == ()


@pytest.mark.parametrize(
    ("file", "lines", "message"),
    [
        ("rigs.txt", "1 2 CAMERA 1 CAMERA 2 1 1 0 0", r"rigs.txt: line 1: ends early"),
        ("rigs.txt", "1 1 LIDAR 1", r"rigs.txt: line 1: 'LIDAR' stands where the kind of a sensor"),
        ("frames.txt", "# c\n1 4 1 0 0 x 0 0 0 1 CAMERA 1 3", r"frames.txt: line 2: 'x' stands where a number"),
    ],
)
def test_broken_files_are_named(
    model: pycolmap.Reconstruction, file: str, lines: str, message: str, tmp_path: Path
) -> None:
    model.write_text(tmp_path)
    (tmp_path / file).write_text(lines)
    with pytest.raises(InputError, match=message):
        poses_by_image(tmp_path, ".txt")


def test_a_binary_file_that_ends_early_is_named(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    model.write_binary(tmp_path)
    path = tmp_path / "frames.bin"
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(InputError, match=r"frames.bin: record 2: ends early"):
        poses_by_image(tmp_path, ".bin")


def test_a_quaternion_that_is_none_gives_no_pose() -> None:
    assert np.isnan(composed((0.0,) * 7, (1.0, 0, 0, 0, 0, 0, 0))).all()
    assert not is_same_pose((1.0, 0, 0, 0, 0, 0, 0), (float("nan"),) * 7)
    assert is_same_pose((-1.0, 0, 0, 0, 0, 0, 5.0), (1.0, 0, 0, 0, 0, 0, 5.0))
