from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from smust3r_colmap.errors import InputError
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.importers.model_poses import read_model_poses, read_models


def poses_of(count: int) -> dict[str, FloatArray]:
    rotations = Rotation.from_rotvec(np.arange(3 * count).reshape(-1, 3) / 7).as_matrix()
    centres = np.arange(3.0 * count).reshape(-1, 3, 1) ** 1.5
    return {f"{k}.jpg": pose for k, pose in enumerate(np.concatenate([rotations, centres], axis=2))}


def model_of(poses: dict[str, FloatArray]) -> pycolmap.Reconstruction:
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="PINHOLE", width=4, height=4, params=[4.0, 4.0, 2.0, 2.0])
    )
    for k, (name, pose) in enumerate(poses.items(), start=1):
        image = pycolmap.Image(name=name, camera_id=1, image_id=k)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(invert_rigid(pose)))
    return model


def write_images(folder: Path, *lines: str) -> None:
    """A text model whose images are these lines."""
    model_of(poses_of(2)).write_text(folder)
    for name in ("rigs.txt", "frames.txt"):
        (folder / name).unlink()
    (folder / "images.txt").write_text("\n\n".join(lines) + "\n\n")


@pytest.mark.parametrize("suffix", ["binary", "text"])
def test_colmaps_poses_are_inverted_and_names_kept(tmp_path: Path, suffix: str) -> None:
    poses = {f"left/{name}": pose for name, pose in poses_of(4).items()}
    getattr(model_of(poses), f"write_{suffix}")(tmp_path)
    read = read_model_poses(tmp_path)
    assert list(read) == sorted(poses)
    for name, pose in poses.items():
        np.testing.assert_allclose(read[name], pose, atol=1e-12)


def test_a_folder_without_a_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no COLMAP model"):
        read_model_poses(tmp_path)


def test_a_broken_line_is_refused_with_its_number(tmp_path: Path) -> None:
    write_images(tmp_path, "1 1 0 0 0 0 0 0 1 a.jpg", "2 0.5 0 0 0 0 0 0 1 b.jpg")
    with pytest.raises(InputError, match=r"images.txt: line 3: the quaternion of b.jpg has length 0.5"):
        read_model_poses(tmp_path)


def test_a_name_that_comes_twice_is_refused(tmp_path: Path) -> None:
    write_images(tmp_path, "1 1 0 0 0 0 0 0 1 a.jpg", "2 1 0 0 0 0 0 0 1 a.jpg")
    with pytest.raises(InputError, match=r"line 3: image name 'a.jpg' was there before"):
        read_model_poses(tmp_path)


def test_poses_that_are_not_finite_are_none(tmp_path: Path) -> None:
    write_images(tmp_path, "1 1 0 0 0 0 0 0 1 a.jpg", "2 nan 0 0 0 0 0 0 1 b.jpg")
    assert list(read_model_poses(tmp_path)) == ["a.jpg"]


def test_all_models_of_a_run_are_read_largest_first_with_the_times_of_images(tmp_path: Path) -> None:
    for number, count in enumerate((2, 3)):
        (tmp_path / f"sparse/{number}").mkdir(parents=True)
        model_of(poses_of(count)).write_binary(tmp_path / f"sparse/{number}")
    (tmp_path / "work").mkdir()
    (unfinished,) = {model.notes for model in read_models(tmp_path)}
    assert "the run is not finished" in unfinished[0]
    (tmp_path / "work/finished.json").write_text(json.dumps({"timestamps_s": {"0.jpg": 1.5}}))
    models = read_models(tmp_path)
    assert [(len(model), model.place.name, model.layout, model.notes) for model in models] == [
        (3, "1", "run", ()),
        (2, "0", "run", ()),
    ]
    assert models[0].image_stamps == {"0.jpg": 1.5}


def test_a_damaged_record_of_a_run_is_refused(tmp_path: Path) -> None:
    (tmp_path / "work").mkdir()
    (tmp_path / "work/finished.json").write_text("[")
    with pytest.raises(InputError, match=r"finished.json: is damaged"):
        read_models(tmp_path)


@pytest.mark.parametrize("below", [".", "sparse", "reference_sparse", "sparse/0"])
def test_one_model_is_found_in_the_folder_or_below(tmp_path: Path, below: str) -> None:
    (tmp_path / below).mkdir(parents=True, exist_ok=True)
    model_of(poses_of(3)).write_binary(tmp_path / below)
    (model,) = read_models(tmp_path)
    assert (model.layout, model.place, model.is_model) == ("COLMAP model", tmp_path / below, True)
