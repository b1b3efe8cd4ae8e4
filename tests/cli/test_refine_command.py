"""A model as a feed-forward network would export it, refined on the photographs it was made of."""

from __future__ import annotations

import io
import json
import shutil
import tracemalloc
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from smust3r_colmap.cli import main as cli
from smust3r_colmap.cli.refine import Refine
from smust3r_colmap.config import FeatureConfig, ModelCameraConfig, ModelOutputConfig, RefineConfig, TrackConfig
from smust3r_colmap.dense.external_points import refined_from_start
from smust3r_colmap.errors import ConfigError, InputError
from smust3r_colmap.evaluation.trajectory import Evaluation, compare_trajectories
from smust3r_colmap.execution.progress import QuietReporter
from smust3r_colmap.features.pairs import alike_pairs, neighbouring_pairs
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import pointmap_from_depth
from smust3r_colmap.geometry.sim3 import Sim3, invert_rigid
from smust3r_colmap.geometry.world_frame import WorldFrame
from smust3r_colmap.importers.model_poses import read_model_poses
from smust3r_colmap.products import EMPTY_CLOUD, Scene
from smust3r_colmap.refine_model import refine_model
from smust3r_colmap.report.summary import RunSummary
from smust3r_colmap.synthetic.room import DemoScene, demo_intrinsics
from smust3r_colmap.validation.surroundings import read_ply

pytestmark = pytest.mark.slow

NUM_IMAGES = 8
CAMERA = demo_intrinsics(320, 240)
NETWORK_SIZE = (518, 392)
"""518 wide, and the height rounded to a multiple of 14 from 388.5."""


MODEL_ONLY = ModelOutputConfig(trainer=False)

LACKING = ("003.png", "006.png")
"""Images that a model may lack."""


@dataclass(frozen=True)
class Export:
    """Photographs of the room, the true cameras, and the model a network would have made of them."""

    root: Path
    truth: dict[str, FloatArray]
    start: dict[str, FloatArray]

    @property
    def images(self) -> Path:
        return self.root / "photos"

    @property
    def model(self) -> Path:
        return self.root / "export"

    def error_of(self, model: Path) -> Evaluation:
        return compare_trajectories(read_model_poses(model), self.truth)


def disturbed(world_from_cam: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Poses (N, 3, 4) with 2 cm and half a degree of noise in each axis."""
    moved: FloatArray = world_from_cam.copy()
    turns = Rotation.from_rotvec(rng.normal(0, np.deg2rad(0.5), (len(moved), 3))).as_matrix()
    moved[:, :, :3] = moved[:, :, :3] @ turns
    moved[:, :, 3] += rng.normal(0, 0.02, (len(moved), 3))
    return moved


def write_network_model(folder: Path, names: Sequence[str], world_from_cam: FloatArray, points: FloatArray) -> None:
    """Text as VGGT-Long writes it: one camera per image, at network size; no empty lines; tracks of zeros."""
    folder.mkdir()
    rng = np.random.default_rng(1)
    width, height = NETWORK_SIZE
    cameras, images = [], []
    for k, (name, pose) in enumerate(zip(names, invert_rigid(world_from_cam), strict=True), start=1):
        focal = 0.75 * rng.normal(1, 0.01)
        cameras.append(f"{k} PINHOLE {width} {height} {focal * 518} {focal * 392 * 4 / 3} {width / 2} {height / 2}")
        x, y, z, w = Rotation.from_matrix(pose[:, :3]).as_quat()
        images.append(f"{k} {w} {x} {y} {z} {pose[0, 3]} {pose[1, 3]} {pose[2, 3]} {k} {name}")
    rows = [f"{k} {x} {y} {z} 90 90 90 0 0 0 0 0 0 0" for k, (x, y, z) in enumerate(points)]
    for file, lines in (("cameras", cameras), ("images", images), ("points3D", rows)):
        (folder / f"{file}.txt").write_text("".join(f"{line}\n" for line in lines))


@pytest.fixture(scope="module")
def export(tmp_path_factory: pytest.TempPathFactory) -> Export:
    root = tmp_path_factory.mktemp("network")
    scene = DemoScene()
    world_from_cam = scene.camera_path(32)[:NUM_IMAGES]
    names = [f"{k:03d}.png" for k in range(NUM_IMAGES)]
    (root / "photos").mkdir()
    points = []
    for name, pose in zip(names, world_from_cam, strict=True):
        rgb, depth = scene.render(pose, CAMERA)
        Image.fromarray(rgb).save(root / "photos" / name)
        points.append(pointmap_from_depth(depth, CAMERA, pose)[8::16, 8::16].reshape(-1, 3))
    poor = disturbed(world_from_cam, np.random.default_rng(0))
    write_network_model(root / "export", names, poor, np.concatenate(points).astype(np.float64))
    return Export(
        root=root,
        truth=dict(zip(names, world_from_cam, strict=True)),
        start=dict(zip(names, poor, strict=True)),
    )


def command(export: Export, output: Path) -> Refine:
    settings = RefineConfig(features=FeatureConfig(max_features=800), workers=1, output=MODEL_ONLY)
    return Refine(model=export.model, images=export.images, output=output, settings=settings)


def refined(wanted: Refine) -> RunSummary:
    return refine_model(
        wanted.model, wanted.images, wanted.output, wanted.settings, reporter=QuietReporter(io.StringIO())
    )


@pytest.fixture(scope="module")
def result(export: Export, tmp_path_factory: pytest.TempPathFactory) -> RunSummary:
    return refined(command(export, tmp_path_factory.mktemp("refined") / "out"))


def test_poses_of_a_network_become_several_times_better(export: Export, result: RunSummary) -> None:
    """2 cm and 0.5 degrees an axis before; after, what photographs of 320 pixels allow."""
    before = compare_trajectories(export.start, export.truth)
    after = export.error_of(result.output / "sparse/0")
    assert result.exit_code == 0
    assert after.num_compared == NUM_IMAGES
    assert 0 < after.position_rmse < before.position_rmse / 3
    assert 0 < after.rotation_median_deg < before.rotation_median_deg / 3


def test_the_result_has_one_camera_at_the_size_of_the_photographs(result: RunSummary) -> None:
    (camera,) = pycolmap.Reconstruction(result.output / "sparse/0").cameras.values()
    assert (camera.width, camera.height) == (320, 240)
    assert camera.model.name == "SIMPLE_RADIAL"
    assert camera.focal_length == pytest.approx(240, rel=0.05)


def test_tracks_are_real_and_the_summary_counts_them(result: RunSummary) -> None:
    model = pycolmap.Reconstruction(result.output / "sparse/0")
    assert min(point.track.length() for point in model.points3D.values()) >= 2
    (refined,) = json.loads((result.output / "summary.json").read_text())["refinements"]
    assert refined["statistics"]["num_points"] == model.num_points3D() > 100
    assert refined["steps"][0]["name"] == "triangulation"
    assert "principal point fixed: " in result.render_text() or "principal point refined: " in result.render_text()
    assert refined["principal_point"] in result.render_text()
    adjustments = [step for step in refined["steps"] if "adjustment" in step["name"]]
    assert adjustments[0]["after"]["reprojection_error_px"] < adjustments[0]["before"]["reprojection_error_px"]


def test_the_model_and_the_database_go_together(result: RunSummary) -> None:
    model = pycolmap.Reconstruction(result.output / "sparse/0")
    with pycolmap.Database.open(result.output / "database.db") as database:
        assert {image.image_id: image.name for image in database.read_all_images()} == {
            image_id: image.name for image_id, image in model.images.items()
        }
        for image_id, image in model.images.items():
            assert len(database.read_keypoints(image_id)) == image.num_points2D()


def test_everything_that_was_assumed_is_in_the_summary(result: RunSummary) -> None:
    notes = "\n".join(json.loads((result.output / "summary.json").read_text())["model_notes"])
    assert "8 images without a line of observations" in notes
    assert "rescaled from 518x392 to 320x240 px" in notes
    assert "8 cameras with one image each became one" in notes


def test_the_files_are_those_of_a_reconstruction(result: RunSummary) -> None:
    names = {path.name for path in result.output.iterdir()}
    assert names >= {"points.ply", "scene.glb", "trajectory_tum.txt", "trajectory_stitched_tum.txt"}
    assert "config.toml" in names and not names & {"trainer", "dense"}
    page = (result.output / "report.html").read_text(encoding="utf-8")
    assert "8 cameras with one image each became one" in page
    assert "before bundle adjustment" in page.lower()


def test_the_settings_are_in_the_summary(result: RunSummary) -> None:
    settings = json.loads((result.output / "summary.json").read_text())["settings"]
    assert settings["pose_tolerance"] == 0.03
    assert settings["cameras"] == {"share_cameras": True, "camera_model": None, "calibrated": False}
    assert settings["features"]["max_features"] == 800


def test_the_settings_can_be_given_back(export: Export, result: RunSummary) -> None:
    words = ["refine", str(export.model), "--images", "i", "--config", str(result.output / "config.toml")]
    again = cli.parse(words)
    assert isinstance(again, Refine)
    assert again.settings == command(export, result.output).settings


def test_the_given_cloud_comes_along_with_the_cameras(export: Export, result: RunSummary) -> None:
    """Its points are those of the true surface, so they must lie there again, seen from the refined cameras."""
    cloud = read_ply(result.output / "points.ply").xyz
    (refined,) = result.refinements
    given = np.array([line.split()[1:4] for line in (export.model / "points3D.txt").read_text().splitlines()], float)
    assert len(cloud) == refined.statistics.num_points + len(given) == result.models[0].num_points
    truth_from_result = export.error_of(result.output / "sparse/0").reference_from_estimated
    off = np.linalg.norm(truth_from_result.apply(cloud[refined.statistics.num_points :]) - given, axis=1)
    assert np.linalg.norm(cloud[refined.statistics.num_points :] - given, axis=1).min() > 1e-4
    assert 0 < np.median(off) < 0.03
    assert f"{len(given)} points of the given model have no track" in result.render_text()


def test_images_that_the_model_lacks_are_placed_when_that_is_wanted(export: Export, tmp_path: Path) -> None:
    shutil.copytree(export.model, tmp_path / "export")
    lines = (tmp_path / "export/images.txt").read_text().splitlines(keepends=True)
    (tmp_path / "export/images.txt").write_text("".join(line for line in lines if line.split()[9] not in LACKING))
    shutil.copytree(export.images, tmp_path / "photos")
    Image.new("RGB", (320, 240), (128, 128, 128)).save(tmp_path / "photos/grey.png")
    wanted = command(export, tmp_path / "out")
    settings = replace(wanted.settings, refinement=TrackConfig(register_missing=True))
    wanted = replace(wanted, model=tmp_path / "export", images=tmp_path / "photos", settings=settings)
    summary = refined(wanted)
    assert (summary.num_images, summary.num_registered) == (NUM_IMAGES + 1, NUM_IMAGES)
    assert summary.refinements[0].registered == LACKING
    (grey,) = summary.unregistered
    assert grey.name == "grey.png" and grey.reason == "no features were found in it"
    model = pycolmap.Reconstruction(tmp_path / "out/sparse/0")
    assert model.num_cameras() == 1
    assert [model.image(i).name for i in sorted(model.images)][-2:] == list(LACKING)
    found = compare_trajectories(read_model_poses(tmp_path / "out/sparse/0"), export.truth)
    assert found.num_compared == NUM_IMAGES
    assert 0 < found.position_max < 0.03


def test_a_second_start_computes_nothing_and_writes_the_same(export: Export, result: RunSummary) -> None:
    before = (result.output / "sparse/0/points3D.bin").read_bytes()
    again = refined(command(export, result.output))
    assert {stage.name for stage in again.stages if stage.reused} >= {"features", "refinement"}
    assert (result.output / "sparse/0/points3D.bin").read_bytes() == before


def test_a_model_without_points_is_refined_as_well(export: Export, result: RunSummary, tmp_path: Path) -> None:
    """The features of the first run are taken along, for they are what takes long."""
    model = tmp_path / "export"
    shutil.copytree(export.model, model, ignore=shutil.ignore_patterns("points3D.txt"))
    shutil.copytree(result.output / "work/features", tmp_path / "out/work/features")
    with pycolmap.Database.open(tmp_path / "out/work/features/database.db") as database:
        database.clear_matches()
        database.clear_two_view_geometries()
    (tmp_path / "out/work/lock").touch()
    summary = refined(replace(command(export, tmp_path / "out"), model=model))
    assert summary.exit_code == 0
    before = compare_trajectories(export.start, export.truth)
    assert export.error_of(tmp_path / "out/sparse/0").position_rmse < before.position_rmse / 3


def test_poses_of_another_meaning_are_named_and_nothing_is_written(
    export: Export, result: RunSummary, tmp_path: Path
) -> None:
    """Camera centres where translations belong: the file looks as good as any."""
    model = tmp_path / "export"
    shutil.copytree(export.model, model)
    lines = [line.split() for line in (model / "images.txt").read_text().splitlines()]
    for words in lines:
        words[5:8] = map(str, export.start[words[9]][:, 3])
    (model / "images.txt").write_text("".join(f"{' '.join(words)}\n" for words in lines))
    shutil.copytree(result.output / "work/features", tmp_path / "out/work/features")
    (tmp_path / "out/work/lock").touch()
    with pytest.raises(InputError, match="% do if the model has camera centres in place of translations"):
        refined(replace(command(export, tmp_path / "out"), model=model))
    assert not (tmp_path / "out/sparse").exists()


def test_photographs_without_a_feature_leave_the_model_as_it_was(export: Export, tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in sorted(export.truth)[:3]:
        Image.new("RGB", (320, 240), (128, 128, 128)).save(photos / name)
    shutil.copy(export.images / sorted(export.truth)[3], photos / "new.png")  # with features, and nothing to match
    wanted = command(export, tmp_path / "out")
    settings = replace(
        wanted.settings,
        output=ModelOutputConfig(text=True, trainer=False),
        refinement=TrackConfig(register_missing=True),
    )
    summary = refined(replace(wanted, images=photos, settings=settings))
    assert summary.exit_code == 3
    assert [(one.name, one.reason) for one in summary.unregistered] == [
        ("new.png", "the model could not be refined, and images are placed by its tracks")
    ]
    assert any("has no tracks" in reason for reason in summary.weak_reasons)
    assert any("5 of 9 files could not be used" in reason for reason in summary.weak_reasons)
    found = compare_trajectories(read_model_poses(tmp_path / "out/sparse/0"), export.start)
    assert found.num_compared == 3
    assert found.position_max < 1e-6
    assert (tmp_path / "out/sparse/0/images.txt").exists()
    assert not (tmp_path / "out/database.db").exists()


# --------------------------------------------------------------------------- refusals
def test_the_model_is_not_overwritten_by_its_refinement(export: Export, tmp_path: Path) -> None:
    shutil.copytree(export.model, tmp_path / "run/sparse/0")
    wanted = replace(command(export, tmp_path / "run"), model=tmp_path / "run")
    with pytest.raises(ConfigError, match=r"the model .*sparse/0 lies there and would be lost"):
        refined(wanted)


def test_results_are_not_written_among_the_images(export: Export) -> None:
    with pytest.raises(ConfigError, match="lies inside the image folder"):
        refined(command(export, export.images / "out"))


def test_names_with_blanks_are_refused_before_any_work_when_text_is_wanted(export: Export, tmp_path: Path) -> None:
    shutil.copytree(export.images, tmp_path / "photos")
    (tmp_path / "photos/000.png").rename(tmp_path / "photos/00 0.png")
    shutil.copytree(export.model, tmp_path / "export")
    lines = (tmp_path / "export/images.txt").read_text().replace("000.png", "00 0.png")
    (tmp_path / "export/images.txt").write_text(lines)
    wanted = Refine(
        model=tmp_path / "export",
        images=tmp_path / "photos",
        output=tmp_path / "out",
        settings=RefineConfig(output=ModelOutputConfig(text=True)),
    )
    with pytest.raises(InputError, match=r"'00 0.png': COLMAP's text format cannot hold"):
        refined(wanted)
    assert not (tmp_path / "out/work/features").exists()


@pytest.mark.parametrize("tolerance", [0.0, -0.1, 0.3])
def test_a_tolerance_that_means_nothing_is_refused(tolerance: float) -> None:
    with pytest.raises(ConfigError, match=rf"--pose-tolerance {tolerance}: must be above 0 and at most 0.2"):
        RefineConfig(pose_tolerance=tolerance)


def test_flags_reach_the_settings_of_the_run() -> None:
    flags = "refine m --images i --output o --max-features 5 --track-neighbours 3 --text --no-trainer --workers 2"
    flags += " --seed 4 --register-missing --masks somewhere --trainer-scales 2 4 --camera-model OPENCV"
    command = cli.parse(flags.split())
    assert isinstance(command, Refine)
    assert command.settings == RefineConfig(
        masks=Path("somewhere"),
        workers=2,
        seed=4,
        cameras=ModelCameraConfig(camera_model="OPENCV"),
        output=ModelOutputConfig(text=True, trainer=False, trainer_scales=(2, 4)),
        features=FeatureConfig(max_features=5),
        refinement=TrackConfig(track_neighbours=3, register_missing=True),
    )


# ------------------------------------------------------------------------ the given cloud
def test_points_follow_the_cameras_as_a_whole_and_stay_where_that_is_unknown() -> None:
    rng = np.random.default_rng(0)
    world_from_cam = DemoScene().camera_path(32)[:NUM_IMAGES]
    start = scene_of(world_from_cam)
    moved = Sim3(
        scale=np.array(1.3), rotation=Rotation.from_rotvec((0.1, 0.4, 0)).as_matrix(), translation=np.array([1.0, 2, 3])
    )
    points = rng.normal(0, 3, (5, 3))
    followed = refined_from_start(start, scene_of(moved.move_cameras(world_from_cam)), 4.0).apply(points)
    assert np.allclose(followed, moved.apply(points), atol=1e-6)
    turned = scene_of(np.tile(world_from_cam[:1], (3, 1, 1)))
    assert np.array_equal(refined_from_start(turned, turned, 4.0).apply(points), points)


def test_the_given_cloud_of_a_large_model_is_moved_without_comparing_every_two_cameras() -> None:
    """1,500 cameras, each with each, would take 160 MB, and 5,000 eleven times as much."""
    rng = np.random.default_rng(0)
    world_from_cam = np.concatenate(
        [Rotation.from_rotvec(rng.normal(size=(1500, 3))).as_matrix(), rng.normal(size=(1500, 3, 1))], axis=2
    )
    moved = Sim3(scale=np.array(1.3), rotation=np.eye(3), translation=np.array([1.0, 2, 3]))
    start, refined_scene = scene_of(world_from_cam), scene_of(moved.move_cameras(world_from_cam))
    tracemalloc.start()
    found = refined_from_start(start, refined_scene, 4.0)
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert np.allclose(found.matrix, moved.matrix, atol=1e-6)
    assert peak_bytes < 100e6


def scene_of(world_from_cam: FloatArray) -> Scene:
    indices = tuple(range(len(world_from_cam)))
    return Scene(
        image_indices=indices,
        image_names=tuple(f"{k:03d}.png" for k in indices),
        camera_indices=(0,) * len(indices),
        cameras={0: CAMERA},
        cam_from_world=invert_rigid(world_from_cam),
        points=EMPTY_CLOUD,
        frame=WorldFrame(metric=False),
        segments=("0",),
    )


# ------------------------------------------------------------------- pairs without points
def test_images_to_be_placed_are_paired_with_those_most_like_them() -> None:
    turns = np.deg2rad([0, 10, 20, 90, 12, 88], dtype=np.float32)
    descriptors = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    assert alike_pairs(descriptors, 4, per_image=2, exhaustive_below=5) == ((1, 4), (2, 4), (2, 5), (3, 5))
    everything = alike_pairs(descriptors, 4, per_image=2, exhaustive_below=6)
    assert everything == tuple((i, j) for i in range(6) for j in range(i + 1, 6) if j > 3)
    assert alike_pairs(descriptors, 4, per_image=9, exhaustive_below=1) == everything


def looking(directions_deg: Sequence[float], positions: Sequence[float]) -> FloatArray:
    """``cam_from_world`` (N, 3, 4) of cameras on the x axis that look away from z by an angle."""
    world_from_cam = np.zeros((len(positions), 3, 4))
    world_from_cam[:, :, :3] = Rotation.from_euler("y", np.asarray(directions_deg)[:, None], degrees=True).as_matrix()
    world_from_cam[:, 0, 3] = positions
    return invert_rigid(world_from_cam)


def test_few_cameras_are_all_paired() -> None:
    assert neighbouring_pairs(looking([0, 90, 180], [0, 1, 2]), per_image=1, exhaustive_below=3) == (
        (0, 1),
        (0, 2),
        (1, 2),
    )


def test_cameras_are_paired_with_their_nearest() -> None:
    pairs = neighbouring_pairs(looking([0] * 5, [0, 1, 2.1, 3.3, 4.6]), per_image=1, exhaustive_below=2)
    assert pairs == ((0, 1), (1, 2), (2, 3), (3, 4))


def test_cameras_that_look_elsewhere_are_passed_over() -> None:
    pairs = neighbouring_pairs(looking([0, 90, 20, 95], [0, 0.1, 1, 2]), per_image=1, exhaustive_below=2)
    assert pairs == ((0, 2), (1, 3))
