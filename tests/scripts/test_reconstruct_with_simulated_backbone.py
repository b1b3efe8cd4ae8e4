"""The script that runs the simulated backbone on an RGB-D data set: its scene, links and refusals, and a short run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import reconstruct_with_simulated_backbone as script
from PIL import Image
from scipy.spatial.transform import Rotation

from smust3r_colmap.errors import InputError
from smust3r_colmap.evaluation.trajectory import compare_trajectories
from smust3r_colmap.geometry.camera import pixel_centres
from smust3r_colmap.importers.model_poses import read_model_poses
from smust3r_colmap.importers.poses_txt import read_poses_txt

NAMES = ("a.jpg", "b.jpg")
SLOPE = 0.8
"""The scene of the made-up data set is the plane z = 2 + 0.8 x before its sensor."""


@pytest.fixture
def rgbd(tmp_path: Path) -> Path:
    """Two frames of the same Kinect: ``a.jpg`` with a turned and shifted pose, ``b.jpg`` at the origin."""
    data = tmp_path / "data"
    for folder in ("images", "depth"):
        (data / folder).mkdir(parents=True)
    columns = (np.arange(640) + 0.5 - 320) / 585
    depth = np.broadcast_to(2 / (1 - SLOPE * columns), (480, 640))
    for name in NAMES:
        Image.new("RGB", (640, 480), (90, 120, 60)).save(data / "images" / name)
        millimetres = np.rint(depth * 1000).astype(np.uint16)
        Image.fromarray(millimetres).save(data / "depth" / Path(name).with_suffix(".png").name)
    x, y, z, w = Rotation.from_rotvec([0.1, 0.7, -0.2]).as_quat()
    (data / "poses.txt").write_text(f"a.jpg {w} {x} {y} {z} 1.5 -0.3 0.8\nb.jpg 1 0 0 0 0 0 0\n")
    (data / "intrinsics.txt").write_text("640 480 585 585 320 240\n")
    return data


# -------------------------------------------------------------------------------- scene
def test_depth_of_the_colour_camera_lies_on_the_surface_that_the_sensor_measured(rgbd: Path) -> None:
    """A camera left in the place of the sensor would put it two centimetres off."""
    scene = script.colour_scene(rgbd, NAMES)
    world_from_sensor = read_poses_txt(rgbd / "poses.txt")
    rays_cam = scene.intrinsics.rays_cam(pixel_centres(scene.intrinsics.width, scene.intrinsics.height))
    for k, name in enumerate(NAMES):
        z, pose, sensor = scene.depth(k).ravel(), scene.world_from_cam[k], world_from_sensor[name]
        points_world = (rays_cam * z[:, None])[z > 0] @ pose[:, :3].T + pose[:, 3]
        points_sensor = (points_world - sensor[:, 3]) @ sensor[:, :3]
        above_plane_m = (points_sensor[:, 2] - 2 - SLOPE * points_sensor[:, 0]) / np.hypot(1, SLOPE)
        assert 0.8 < (z > 0).mean() < 1
        assert 0 < np.abs(above_plane_m).max() < 0.01
        assert abs(np.median(above_plane_m)) < 0.001


def test_the_colour_camera_sits_an_inch_to_the_right_of_the_sensor(rgbd: Path) -> None:
    scene = script.colour_scene(rgbd, NAMES)
    np.testing.assert_allclose(scene.world_from_cam[1, :, 3], [0.0255, 0, 0], atol=0.003)
    assert scene.metric
    assert scene.rgb(0).shape == (*scene.depth(0).shape, 3) == (288, 384, 3)


def test_another_camera_than_a_kinect_is_refused(rgbd: Path) -> None:
    (rgbd / "intrinsics.txt").write_text("320 240 292 292 160 120\n")
    with pytest.raises(InputError, match=r"intrinsics.txt: images of 320 x 240 pixels, needed 640 x 480"):
        script.colour_scene(rgbd, NAMES)


# ------------------------------------------------------------------------------- images
def test_the_list_of_the_data_set_is_taken_unless_another_is_named(rgbd: Path, tmp_path: Path) -> None:
    output = tmp_path / "runs" / "out"
    assert script.chosen_images(rgbd, None, output) == rgbd / "images"
    (rgbd / script.SUBSET_FILE).write_text("b.jpg\n")
    links = script.chosen_images(rgbd, None, output)
    assert links == tmp_path / "runs" / "out_images"
    assert [path.name for path in links.iterdir()] == ["b.jpg"]
    own_list = tmp_path / "names.txt"
    own_list.write_text("a.jpg\nb.jpg\n")
    assert script.chosen_images(rgbd, own_list, output) == links
    assert {path.name: path.resolve() for path in links.iterdir()} == {
        name: (rgbd / "images" / name).resolve() for name in NAMES
    }
    with pytest.raises(InputError, match=r"out_images: has 1 files besides links to the 1 images, such as a.jpg"):
        script.chosen_images(rgbd, None, output)


def test_names_may_have_blanks_and_lie_in_subfolders(rgbd: Path, tmp_path: Path) -> None:
    names = ["left side/a b.jpg", "c.jpg"]
    (rgbd / "images/left side").mkdir()
    for name in names:
        (rgbd / "images" / name).touch()
    own_list = tmp_path / "names.txt"
    own_list.write_text("".join(f"{name}\r\n" for name in names) + "\n")
    for _ in range(2):  # links of an earlier start are no stranger's files
        links = script.chosen_images(rgbd, own_list, tmp_path / "out")
        found = {path.relative_to(links).as_posix(): path.resolve() for path in links.rglob("*.jpg")}
        assert found == {name: (rgbd / "images" / name).resolve() for name in names}
    (links / "left side/mine.txt").touch()
    with pytest.raises(InputError, match=r"has 1 files besides links to the 2 images, such as left side/mine.txt"):
        script.chosen_images(rgbd, own_list, tmp_path / "out")


def test_names_outside_of_the_data_set_are_refused(rgbd: Path, tmp_path: Path) -> None:
    (rgbd / "x.jpg").touch()
    for name in ("../x.jpg", str(rgbd / "x.jpg")):
        with pytest.raises(InputError, match=r"x.jpg does not lie in it; names are paths below that folder"):
            script.link_images(rgbd / "images", [name], tmp_path / "links")
    assert not (tmp_path / "links").exists()


def test_links_to_another_data_set_are_made_anew(rgbd: Path, tmp_path: Path) -> None:
    links = tmp_path / "links"
    links.mkdir()
    (links / "a.jpg").symlink_to(tmp_path / "elsewhere" / "a.jpg")
    script.link_images(rgbd / "images", ["a.jpg"], links)
    assert (links / "a.jpg").resolve() == (rgbd / "images" / "a.jpg").resolve()


def test_nothing_of_somebody_else_is_replaced_by_a_link(rgbd: Path, tmp_path: Path) -> None:
    (tmp_path / "links").mkdir()
    (tmp_path / "links" / "a.jpg").write_text("mine")
    with pytest.raises(InputError, match=r"links: has 1 files besides links to the 2 images, such as a.jpg"):
        script.link_images(rgbd / "images", NAMES, tmp_path / "links")
    assert (tmp_path / "links" / "a.jpg").read_text() == "mine"


def test_what_cannot_be_run_ends_with_exit_code_2(
    rgbd: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output, names = tmp_path / "out", tmp_path / "names.txt"
    assert script.main([str(rgbd), str(output), "--images", str(names)]) == 2
    assert "names.txt: needed a text file with names of images" in capsys.readouterr().err
    names.write_text("a.jpg\nx.jpg\n")
    assert script.main([str(rgbd), str(output), "--images", str(names)]) == 2
    assert "images: 1 of 2 images are missing, the first is x.jpg" in capsys.readouterr().err
    assert not output.exists()


# ------------------------------------------------------------------------------ whole run
@pytest.mark.data
def test_the_kitchen_without_errors_comes_out_in_metres(
    data_dir: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The poses are those of KinectFusion and good to a centimetre."""
    data, output, names = data_dir("kitchen_rgbd"), tmp_path / "out", tmp_path / "names.txt"
    names.write_text("".join(f"{k:06d}.jpg\n" for k in range(500, 530, 5)))
    words = [str(data), str(output), "--images", str(names), "--preset", "perfect", "--workers", "1", "--no-dense"]
    assert script.main(words) == 0
    assert "6 of 6 images have a pose. Scale: metres." in capsys.readouterr().out
    config = (output / "config.toml").read_text()
    assert 'backbone = "simulated"' in config and 'backbone_options = "preset=perfect"' in config
    found = compare_trajectories(read_model_poses(output / "sparse/0"), read_poses_txt(data / "poses.txt"))
    assert found.num_compared == 6
    assert found.reference_from_estimated.scale == pytest.approx(1, abs=0.05)
    assert 0 < found.position_rmse < 0.02
    assert (output / "points.ply").is_file()
    assert not (output / "dense").exists() and not (output / "trainer").exists()
