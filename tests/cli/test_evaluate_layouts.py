"""Every layout of a reference, as the data sets have it on disk, against models and trajectories that others write."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from smust3r_colmap.cli.main import main
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import invert_rigid

N = 12
RNG = np.random.default_rng(2)
ROTATIONS = Rotation.from_rotvec(RNG.uniform(-1, 1, (N, 3)))
CENTRES = RNG.uniform(-4, 4, (N, 3))
POSES = np.concatenate([ROTATIONS.as_matrix(), CENTRES[:, :, None]], axis=2)
STAMPS_NS = 1403636579_000000000 + 50_000_000 * np.arange(N)
SECONDS = [f"{stamp / 1e9:.6f}" for stamp in STAMPS_NS]
BODY_FROM_CAM = np.column_stack([Rotation.from_rotvec([0.2, -1.0, 0.4]).as_matrix(), [0.1, -0.2, 0.3]])


def matrix(pose: FloatArray) -> str:
    return " ".join(f"{number:.12g}" for number in pose.ravel())


def quaternion(pose: FloatArray, order: str) -> str:
    number_of = dict(zip("xyzw", Rotation.from_matrix(pose[:, :3]).as_quat(), strict=True))
    return " ".join(f"{number_of[one]:.12g}" for one in order)


def centre(pose: FloatArray) -> str:
    return " ".join(f"{number:.12g}" for number in pose[:, 3])


def write(path: Path, lines: list[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")


def tum(folder: Path) -> Path:
    """Truth at more times than there are images."""
    rows = [f"{stamp} {centre(pose)} {quaternion(pose, 'xyzw')}" for stamp, pose in zip(SECONDS, POSES, strict=True)]
    between = f"{float(SECONDS[0]) + 0.02:.6f} 9 9 9 0 0 0 1"
    write(folder / "groundtruth.txt", ["# timestamp tx ty tz qx qy qz qw", *rows, between])
    write(folder / "rgb.txt", [f"{stamp} rgb/{stamp}.png" for stamp in SECONDS])
    return folder


def eth3d(folder: Path) -> Path:
    write(folder / "calibration.txt", ["700 700 369 230"])
    return tum(folder)


def seven_scenes(folder: Path) -> Path:
    for k, pose in enumerate(POSES):
        rows = [" ".join(f"{number:.12g}" for number in row) for row in pose]
        write(folder / f"frame-{k:06d}.pose.txt", [*rows, "0 0 0 1"])
    return folder


def kitti(folder: Path) -> Path:
    write(folder / "dataset/poses/07.txt", [matrix(pose) for pose in POSES])
    write(folder / "dataset/sequences/07/times.txt", [f"{0.1 * k:e}" for k in range(N)])
    return folder / "dataset/poses/07.txt"


def euroc(folder: Path) -> Path:
    """Truth of the body; world_from_body = world_from_cam cam_from_body."""
    square = np.vstack([invert_rigid(BODY_FROM_CAM), [0, 0, 0, 1]])
    rows = [
        ",".join([str(stamp), *f"{centre(pose)} {quaternion(pose, 'wxyz')}".split()])
        for stamp, pose in zip(STAMPS_NS + 1_000_000, POSES @ square, strict=True)
    ]
    write(folder / "mav0/state_groundtruth_estimate0/data.csv", ["#timestamp,x,y,z,qw,qx,qy,qz", *rows])
    write(folder / "mav0/cam0/data.csv", ["#timestamp [ns],filename", *(f"{one},{one}.png" for one in STAMPS_NS)])
    numbers = ", ".join(matrix(BODY_FROM_CAM).split())
    write(folder / "mav0/cam0/sensor.yaml", ["T_BS:", f"  data: [{numbers}, 0.0, 0.0, 0.0, 1.0]"])
    return folder


def poses_txt(folder: Path) -> Path:
    write(
        folder / "poses.txt",
        [f"{k:06d}.jpg {quaternion(pose, 'wxyz')} {centre(pose)}" for k, pose in enumerate(POSES)],
    )
    return folder


LAYOUTS = {
    "tum": (tum, [f"rgb/{stamp}.png" for stamp in SECONDS], "time within 0.01 s"),
    "tum, images alone": (tum, [f"{stamp}.png" for stamp in SECONDS], "time within 0.01 s"),
    "eth3d-slam": (eth3d, [f"rgb/{stamp}.png" for stamp in SECONDS], "time within 0.01 s"),
    "7-scenes": (seven_scenes, [f"frame-{k:06d}.color.png" for k in range(N)], "image name"),
    "kitti": (kitti, [f"image_0/{k:06d}.png" for k in range(N)], "image name without folder and suffix"),
    "euroc": (euroc, [f"{stamp}.png" for stamp in STAMPS_NS], "time within 0.01 s"),
    "poses.txt": (poses_txt, [f"{k:06d}.jpg" for k in range(N)], "image name"),
}


def write_model(folder: Path, names: list[str]) -> Path:
    """As COLMAP writes it: other order, another world, a tenth of the size."""
    turn = Rotation.from_rotvec([0.5, 2, -1]).as_matrix()
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="PINHOLE", width=4, height=4, params=[4.0, 4.0, 2.0, 2.0])
    )
    for number, k in enumerate(np.random.default_rng(0).permutation(N), start=1):
        moved = np.column_stack([turn @ POSES[k, :, :3], 0.1 * turn @ POSES[k, :, 3] + [1, 2, 3]])
        image = pycolmap.Image(name=names[k], camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(invert_rigid(moved)))
    folder.mkdir(parents=True)
    model.write_binary(folder)
    return folder


def rows_of(arguments: list[str], tmp_path: Path) -> dict[str, dict[str, object]]:
    assert main(["evaluate", *arguments, "--quiet", "--json", str(tmp_path / "rows.json")]) == 0
    return {row["metric"]: row for row in json.loads((tmp_path / "rows.json").read_text())["rows"]}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_right_model_has_no_error_in_any_layout(tmp_path: Path, layout: str) -> None:
    """Wrong axes, a wrong quaternion, an inverted pose or a wrong pair of images would show at once."""
    make, names, association = LAYOUTS[layout]
    model = write_model(tmp_path / "model", names)
    rows = rows_of([str(model), str(make(tmp_path / "data"))], tmp_path)
    assert {(row["association"], row["compared"]) for row in rows.values()} == {(association, N)}
    for metric in ("ape_translation", "aae", "aae_rotation_aligned", "rpe_translation", "rpe_rotation"):
        assert rows[metric]["values"]["max"] == pytest.approx(0, abs=2e-5)  # type: ignore[index]
    assert rows["scale"]["values"]["scale"] == pytest.approx(0.1, rel=1e-6)  # type: ignore[index]


def test_a_trajectory_with_frame_numbers_is_compared_with_kitti_and_7_scenes(tmp_path: Path) -> None:
    """As SLAM systems write it; every second frame."""
    rows = [f"{k} {centre(POSES[k])} {quaternion(POSES[k], 'xyzw')}" for k in range(0, N, 2)]
    write(tmp_path / "trajectory.txt", rows)
    for make in (kitti, seven_scenes):
        found = rows_of([str(tmp_path / "trajectory.txt"), str(make(tmp_path / make.__name__))], tmp_path)
        ape = found["ape_translation"]
        facts = [ape[key] for key in ("association", "compared", "in_estimate", "in_reference")]
        assert facts == ["frame number", N // 2, N // 2, N]
        assert ape["values"]["max"] == pytest.approx(0, abs=1e-9)  # type: ignore[index]


def test_kitti_files_are_compared_line_by_line(tmp_path: Path) -> None:
    reference = kitti(tmp_path / "data")
    write(tmp_path / "estimate.txt", [matrix(pose) for pose in POSES])
    found = rows_of([str(tmp_path / "estimate.txt"), str(reference), "--align", "none"], tmp_path)
    assert found["ape_translation"]["values"]["max"] == pytest.approx(0, abs=1e-9)  # type: ignore[index]
    assert found["ape_translation"]["unit"] == "m"
