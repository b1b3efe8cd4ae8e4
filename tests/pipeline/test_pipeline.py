"""Whole runs on a small rendered room, with the truth known exactly."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
import trimesh
from helpers.finished_runs import content
from helpers.independent_colmap_reader import read_binary

from smust3r_colmap.backbones.classical import backbone, calibration
from smust3r_colmap.backbones.classical.mapping import METHOD_VERSION
from smust3r_colmap.config import (
    AlignmentConfig,
    CameraConfig,
    ClassicalConfig,
    FeatureConfig,
    FusionConfig,
    LoopConfig,
    Must3rConfig,
    OutputConfig,
    RefinementConfig,
    RunConfig,
    SegmentationConfig,
    TransformGroup,
)
from smust3r_colmap.errors import CollectionError, ConfigError, InputError, ReconstructionError
from smust3r_colmap.evaluation.trajectory import compare_trajectories
from smust3r_colmap.execution.progress import QuietReporter
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.importers.model_poses import read_model_poses
from smust3r_colmap.importers.poses_txt import read_poses_txt
from smust3r_colmap.pipeline import reconstruct
from smust3r_colmap.report.summary import RunSummary
from smust3r_colmap.storage.config_file import config_to_toml
from smust3r_colmap.synthetic.room import DemoScene, demo_intrinsics, write_demo

pytestmark = pytest.mark.slow

NUM_IMAGES = 24
NUM_BRIEF = 12
"""The first images of the room, for tests of something else than where its cameras are: half a walk."""

# One process: in runs this small, starting a second one costs more than it brings. `finished` has as many as there
# are cores.
CONFIG = RunConfig(
    workers=1,
    segmentation=SegmentationConfig(segment_length=14, overlap=7),
    features=FeatureConfig(max_features=1200),
    classical=ClassicalConfig(dense_size=160, depth_planes=32),
    fusion=FusionConfig(max_points=20_000),
    output=OutputConfig(text=True, trainer=False, dense=False, report=False),
)

WITH_REPORT = replace(CONFIG, output=replace(CONFIG.output, report=True))
BRIEF = replace(WITH_REPORT, segmentation=SegmentationConfig(segment_length=8, overlap=4))
WITHOUT_TEXT = replace(CONFIG, output=OutputConfig(trainer=False, dense=False, report=False))
UNREFINED = replace(WITH_REPORT, refinement=RefinementConfig(refine=False))
NO_LOOPS = LoopConfig(loop_closure=False)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("room")
    write_demo(folder, num_images=NUM_IMAGES, width=320, height=240)
    return folder


@pytest.fixture(scope="module")
def finished(room: Path, tmp_path_factory: pytest.TempPathFactory) -> RunSummary:
    everything = replace(CONFIG, output=OutputConfig(text=True), workers="auto")
    return run(room / "images", tmp_path_factory.mktemp("run") / "out", everything)


@pytest.fixture(scope="module")
def brief_walk(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of its photographs."""
    images = tmp_path_factory.mktemp("brief") / "images"
    copy_photographs(room, images, NUM_BRIEF)
    return images


@pytest.fixture(scope="module")
def brief(brief_walk: Path) -> RunSummary:
    """A finished run of two segments, to be copied, stopped, resumed and changed."""
    summary = run(brief_walk, brief_walk.parent / "out", BRIEF)
    assert len(summary.segments) == 2
    assert summary.num_registered == NUM_BRIEF
    return summary


def copy_photographs(room: Path, folder: Path, count: int) -> None:
    folder.mkdir()
    for path in sorted((room / "images").iterdir())[:count]:
        shutil.copy(path, folder)


def run(images: Path, output: Path, config: RunConfig = CONFIG) -> RunSummary:
    return reconstruct(images, output, config, reporter=QuietReporter(sys.stderr))


def reused(summary: RunSummary) -> dict[str, bool]:
    return {stage.name: stage.reused for stage in summary.stages}


# --------------------------------------------------------------------------- result
def test_every_image_is_placed_within_centimetres_of_the_truth(finished: RunSummary, room: Path) -> None:
    assert finished.num_registered == NUM_IMAGES
    assert finished.exit_code == 0
    assert len(finished.models) == 1
    found = compare_trajectories(read_model_poses(finished.output / "sparse/0"), read_poses_txt(room / "poses.txt"))
    assert found.num_compared == NUM_IMAGES
    assert 0 < found.position_rmse < 0.03
    assert 0 < found.rotation_median_deg < 1.0


def test_the_focal_length_is_found_at_the_original_size(finished: RunSummary, room: Path) -> None:
    (camera,) = pycolmap.Reconstruction(finished.output / "sparse/0").cameras.values()
    width, height, focal = (float(x) for x in (room / "intrinsics.txt").read_text().split("\n")[1].split()[:3])
    assert (camera.width, camera.height) == (width, height)
    assert camera.params[0] == pytest.approx(focal, rel=0.02)
    assert tuple(camera.params[1:3]) == pytest.approx((width / 2, height / 2), abs=0.01 * width)


def test_a_known_calibration_is_kept_to_the_last_digit(room: Path, brief_walk: Path, tmp_path: Path) -> None:
    params = (room / "intrinsics.txt").read_text().split("\n")[1].split()[2:]
    known = CameraConfig(camera_model="PINHOLE", camera_params=",".join(params))
    summary = run(brief_walk, tmp_path / "out", replace(BRIEF, cameras=known, loop_closing=NO_LOOPS))
    (camera,) = pycolmap.Reconstruction(tmp_path / "out/sparse/0").cameras.values()
    assert (camera.model.name, [*camera.params]) == ("PINHOLE", [float(value) for value in params])
    poses = read_model_poses(tmp_path / "out/sparse/0")
    assert summary.num_registered == NUM_BRIEF
    assert compare_trajectories(poses, read_poses_txt(room / "poses.txt")).position_rmse < 0.02


def test_the_model_is_read_by_an_independent_reader(finished: RunSummary) -> None:
    model = read_binary(finished.output / "sparse/0")
    ours = pycolmap.Reconstruction(finished.output / "sparse/0")
    assert sorted(image.name for image in model.images.values()) == [f"{k:06d}.jpg" for k in range(NUM_IMAGES)]
    assert {i: image.name for i, image in model.images.items()} == {i: f"{i - 1:06d}.jpg" for i in model.images}
    assert len(model.points) == len(ours.points3D) == finished.refinements[0].statistics.num_points
    assert (finished.output / "sparse/0/images.txt").is_file()


def test_the_cloud_lies_inside_the_room_and_on_its_walls(finished: RunSummary, room: Path) -> None:
    """The room spans x -3..3, y -2..2, z 0..3 m; the cameras look level, so floor and ceiling are hardly seen."""
    estimated, truth = read_model_poses(finished.output / "sparse/0"), read_poses_txt(room / "poses.txt")
    fit = compare_trajectories(estimated, truth).reference_from_estimated
    cloud = trimesh.load(finished.output / "points.ply", process=False)
    assert isinstance(cloud, trimesh.PointCloud)
    points = fit.apply(np.asarray(cloud.vertices))
    assert 5_000 < len(points) <= CONFIG.fusion.max_points
    beyond = np.maximum(np.array([-3.0, -2.0, 0.0]) - points, points - [3.0, 2.0, 3.0]).max(axis=1)
    assert np.mean(beyond > 0.05) < 0.02
    to_wall = np.abs(np.abs(points[:, :2]) - [3.0, 2.0]).min(axis=1)
    assert np.mean(to_wall < 0.05) > 0.4


def test_all_results_are_written(finished: RunSummary) -> None:
    names = {path.name for path in finished.output.iterdir()}
    assert names == {
        "sparse", "database.db", "trainer", "dense", "points.ply", "scene.glb", "trajectory_tum.txt",
        "trajectory_stitched_tum.txt", "poses_uncertainty.csv", "summary.json", "config.toml", "report.html", "work",
    }  # fmt: skip
    facts = json.loads((finished.output / "summary.json").read_text())
    assert facts["num_registered"] == NUM_IMAGES
    assert facts["models"][0]["metric"] is False
    assert "arbitrary" in facts["scale"]
    assert len((finished.output / "trajectory_tum.txt").read_text().splitlines()) >= NUM_IMAGES


def test_neighbouring_segments_agree_on_what_they_share(finished: RunSummary) -> None:
    accepted = [edge for edge in finished.edges if edge.accepted]
    assert len(accepted) >= len(finished.segments) - 1 >= 2
    assert all(edge.relative_residual < 0.01 for edge in accepted)


# --------------------------------------------------------------------------- resume
def test_a_second_start_repeats_nothing_and_gives_the_same_model(finished: RunSummary, room: Path) -> None:
    before = (finished.output / "sparse/0/images.bin").read_bytes()
    again = run(room / "images", finished.output)
    assert (finished.output / "sparse/0/images.bin").read_bytes() == before
    computed = {name for name, was_reused in reused(again).items() if not was_reused}
    assert computed == {"import", "pose graph", "export"}


def test_a_changed_setting_redoes_its_stage_and_what_follows(
    brief: RunSummary, brief_walk: Path, tmp_path: Path
) -> None:
    copy = tmp_path / "out"
    shutil.copytree(brief.output, copy)
    denser = replace(BRIEF, classical=replace(BRIEF.classical, dense_size=120))
    again = reused(run(brief_walk, copy, denser))
    assert {name for name, was_reused in again.items() if was_reused} == {
        "keyframes", "features", "descriptors", "loops", "matching", "focal lengths", "mapping", "calibration",
        "alignment",
    }  # fmt: skip
    fewer_points = replace(denser, fusion=FusionConfig(max_points=5_000))
    again = reused(run(brief_walk, copy, fewer_points))
    assert not again["fusion"]
    assert again["depth"]
    assert again["alignment"]


def test_segments_of_another_version_are_mapped_again(
    brief: RunSummary, brief_walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(brief.output, tmp_path / "out")
    monkeypatch.setattr(backbone, "METHOD_VERSION", METHOD_VERSION + 1)
    again = reused(run(brief_walk, tmp_path / "out", BRIEF))
    assert (again["features"], again["matching"], again["mapping"], again["calibration"]) == (True, True, False, False)


def test_renamed_images_have_their_new_names_in_the_model(brief: RunSummary, brief_walk: Path, tmp_path: Path) -> None:
    shutil.copytree(brief.output, tmp_path / "out")
    shutil.copytree(brief_walk, tmp_path / "images")
    for path in sorted((tmp_path / "images").iterdir()):
        path.rename(path.with_name(f"renamed_{path.name}"))
    again = run(tmp_path / "images", tmp_path / "out", BRIEF)
    names = {image.name for image in pycolmap.Reconstruction(tmp_path / "out/sparse/0").images.values()}
    assert names == {f"renamed_{k:06d}.jpg" for k in range(NUM_BRIEF)}
    assert reused(again)["depth"]


KILL_AFTER = ("features: ", "mapping: ", "depth: ", "refinement: ", "fusion: ")


@pytest.mark.parametrize("line", KILL_AFTER)
def test_killed_in_the_middle_of_a_stage_it_goes_on_to_the_same_model(
    line: str, brief: RunSummary, brief_walk: Path, tmp_path: Path
) -> None:
    """kill -9 when the stage begins; only the import and what was not finished may be done again."""
    output = tmp_path / "out"
    config = tmp_path / "config.toml"
    config.write_text(config_to_toml(BRIEF))
    stages = ["features", "matching", "mapping", "calibration", "depth", "alignment", "placing", "refinement", "fusion"]
    reached = stages.index(line.split(":", maxsplit=1)[0])
    prepared = _copy_of_finished_stages(brief.output, output, stages[:reached])
    command = [sys.executable, "-m", "smust3r_colmap", "reconstruct", str(brief_walk)]
    command += ["--output", str(output), "--config", str(config), "--workers", "2"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as process:
        assert process.stderr is not None
        for said in process.stderr:
            if said.startswith(line) and "to do" in said:
                process.kill()
                break
    assert process.returncode == -9
    assert not (output / "summary.json").exists()
    again = reused(run(brief_walk, output, BRIEF))
    assert all(again[name] for name in prepared)
    for name in ("images.bin", "points3D.bin", "cameras.bin"):
        found = (output / "sparse/0" / name).read_bytes()
        assert found == (brief.output / "sparse/0" / name).read_bytes(), name
    assert report_without_cost(output) == report_without_cost(brief.output)


def report_without_cost(output: Path) -> str:
    """The page; of one start it says what it cost, and that is not the same twice, nor are the workers."""
    page = (output / "report.html").read_text(encoding="utf-8")
    without, num_costs = re.subn(r'<section id="cost">.*?</section>', "", page, flags=re.S)
    assert num_costs == 1
    return re.sub(r"^workers = .*$", "", without, flags=re.M)


def _copy_of_finished_stages(source: Path, output: Path, stages: list[str]) -> list[str]:
    """A run directory in which just these stages are finished, as a run stopped there leaves it."""
    folders = {
        "features": ["features"],
        "alignment": ["alignment"],
        "placing": ["stitched"],
        "refinement": ["track_pairs", "refined"],
        "fusion": ["scene"],
    }
    for stage in stages:
        for name in folders.get(stage, []):
            shutil.copytree(source / "work" / name, output / "work" / name)
        for segment in sorted((source / "work/segments").iterdir()):
            for part in segment.glob(f"{stage}*"):
                shutil.copytree(part, output / "work/segments" / segment.name / part.name)
    (output / "work").mkdir(parents=True, exist_ok=True)
    (output / "work/lock").touch()
    if "features" in stages and "matching" not in stages:
        with pycolmap.Database.open(output / "work/features/database.db") as database:
            database.clear_matches()
            database.clear_two_view_geometries()
    return stages


# ------------------------------------------------------------------------- bad input
def write_noise(folder: Path, count: int) -> None:
    """Pictures that SIFT finds a lot in and that have nothing in common."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    for k in range(count):
        coarse = rng.integers(0, 255, size=(30, 40, 3), dtype=np.uint8)
        cv2.imwrite(str(folder / f"{k}.png"), cv2.resize(coarse, (320, 240), interpolation=cv2.INTER_CUBIC))


def test_images_without_overlap_fail_with_what_was_tried(tmp_path: Path) -> None:
    write_noise(tmp_path / "noise", 4)
    with pytest.raises(ReconstructionError, match=r"none of the 1 segments \(4 images\).*no pair of images has 15"):
        run(tmp_path / "noise", tmp_path / "out", WITH_REPORT)
    page = (tmp_path / "out/report.html").read_text(encoding="utf-8")
    assert "none of the 1 segments (4 images) could be reconstructed" in page
    assert len(re.findall(r"no pose: [1-9]\d* features, 0 verified matches with 0 images", page)) == 4


def test_strangers_among_the_images_are_left_out_by_name(room: Path, tmp_path: Path) -> None:
    images = tmp_path / "images"
    copy_photographs(room, images, 10)
    write_noise(tmp_path / "noise", 1)
    shutil.copy(tmp_path / "noise/0.png", images / "000004_stranger.png")
    (images / "000005_broken.jpg").write_bytes((room / "images/000005.jpg").read_bytes()[:4000])
    summary = run(images, tmp_path / "out", UNREFINED)
    assert summary.exit_code == 3
    assert summary.num_registered == 10
    assert [one.name for one in summary.unregistered] == ["000004_stranger.png"]
    assert [one.name for one in summary.rejected] == ["000005_broken.jpg"]
    page = (tmp_path / "out/report.html").read_text(encoding="utf-8")
    assert "10 of 12" in page
    assert "The model has no tracks, hence no residuals." in page


def test_two_unconnected_rooms_become_two_models_largest_first(room: Path, tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    photograph(DemoScene(5), images, num_images=24, count=6)
    for k in range(10):
        shutil.copy(room / f"images/{k:06d}.jpg", images / f"b{k}.jpg")
    summary = run(images, tmp_path / "out", replace(WITH_REPORT, segmentation=SegmentationConfig()))
    assert [model.num_images for model in summary.models] == [10, 6]
    page = (tmp_path / "out/report.html").read_text(encoding="utf-8")
    assert "16 of 16" in page
    assert "Path of sparse/0" in page
    assert "<td>sparse/1</td><td>6</td>" in page
    assert summary.exit_code == 3
    assert any("2 models" in reason for reason in summary.weak_reasons)
    first = pycolmap.Reconstruction(tmp_path / "out/sparse/0")
    assert {image.name[0] for image in first.images.values()} == {"b"}
    assert pycolmap.Reconstruction(tmp_path / "out/sparse/1").num_reg_images() == 6


def photograph(scene: DemoScene, folder: Path, *, num_images: int, count: int) -> None:
    """The first ``count`` views of a round of ``num_images``, as a0.png and on."""
    for k, world_from_cam in enumerate(scene.camera_path(num_images)[:count]):
        rgb, _ = scene.render(world_from_cam, demo_intrinsics(320, 240))
        cv2.imwrite(str(folder / f"a{k}.png"), rgb[:, :, ::-1])


@pytest.mark.parametrize("count", [2, 3])
def test_a_handful_of_photographs_is_enough(count: int, tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    photograph(DemoScene(), images, num_images=72, count=count)
    summary = run(images, tmp_path / "out")
    assert summary.exit_code == 0
    assert summary.models[0].num_images == count
    assert summary.models[0].num_points > 500


def test_odd_names_survive_to_the_model(room: Path, tmp_path: Path) -> None:
    folder = tmp_path / "bilder mit Leerzeichen" / "süd"
    folder.mkdir(parents=True)
    for k in range(6):
        shutil.copy(room / "images" / f"{k:06d}.jpg", folder / f"photo {k} ñ.jpg")
    summary = run(folder.parent, tmp_path / "out put", WITHOUT_TEXT)
    names = {image.name for image in pycolmap.Reconstruction(summary.output / "sparse/0").images.values()}
    assert names == {f"süd/photo {k} ñ.jpg" for k in range(6)}


def test_an_output_among_the_images_is_refused(room: Path) -> None:
    with pytest.raises(ConfigError, match="inside the image folder"):
        run(room / "images", room / "images" / "out")
    assert not (room / "images/out").exists()


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize(
    ("images", "changes", "match"),
    [
        ("photos", {}, "photos: there is no such folder"),
        ("images", {"cameras": CameraConfig(camera_model="PINHOLE", camera_params="1,2")}, "1,2"),
        ("images", {"masks": Path("nowhere")}, "nowhere: there is no such folder"),
        ("images", {"backbone": "must3r", "must3r": Must3rConfig(weights="nowhere.pth")}, r"nowhere\.pth"),
    ],
)
def test_a_typing_error_costs_nothing_of_a_finished_run(
    images: str,
    changes: dict[str, Any],
    match: str,
    overwrite: bool,
    brief: RunSummary,
    brief_walk: Path,
    tmp_path: Path,
) -> None:
    output = tmp_path / "out"
    shutil.copytree(brief.output, output)
    before = content(output)
    with pytest.raises(InputError, match=match):
        reconstruct(
            brief_walk.parent / images,
            output,
            replace(BRIEF, **changes),
            overwrite=overwrite,
            reporter=QuietReporter(sys.stderr),
        )
    assert content(output) == before


def test_a_folder_that_is_not_there_makes_no_output(tmp_path: Path) -> None:
    with pytest.raises(CollectionError, match="there is no such folder"):
        run(tmp_path / "photos", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_starting_over_uses_and_leaves_nothing_of_before(brief: RunSummary, brief_walk: Path, tmp_path: Path) -> None:
    output = tmp_path / "out"
    shutil.copytree(brief.output, output)
    (output / "sparse/7").mkdir()
    shutil.copy(output / "sparse/0/cameras.bin", output / "sparse/7")
    again = reconstruct(brief_walk, output, BRIEF, overwrite=True, reporter=QuietReporter(sys.stderr))
    assert not any(reused(again).values())
    assert [path.name for path in (output / "sparse").iterdir()] == ["0"]


# ----------------------------------------------------------------------------- loops
NUM_ROUND = 36
ROUND = replace(CONFIG, segmentation=SegmentationConfig(segment_length=10, overlap=5))
UNREFINED_ROUND = replace(ROUND, refinement=RefinementConfig(refine=False))


@pytest.fixture(scope="module")
def round_trip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("round")
    write_demo(folder, num_images=NUM_ROUND, width=320, height=240)
    return folder


def test_a_walk_that_comes_back_is_closed_and_a_run_without_loops_is_not(
    round_trip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(calibration, "MIN_CALIBRATION_IMAGES", 30)  # three windows are self-calibrated, four follow
    summary = run(round_trip / "images", tmp_path / "out", ROUND)
    mapped, adjusted = (
        list((tmp_path / "out/work/segments").glob(f"*/{stage}")) for stage in ("mapping", "calibrated")
    )
    assert sorted(path.parent.name for path in adjusted) == ["0000", "0002", "0004"]
    assert len(mapped) == len(summary.segments)
    assert len(summary.models) == 1
    closed = [loop for loop in summary.loops if loop.accepted]
    assert closed, [loop.reason for loop in summary.loops]
    assert all(loop.segment_b - loop.segment_a >= 3 for loop in closed)
    assert all(0 <= loop.gap_after_percent < max(loop.gap_before_percent, 0.5) for loop in closed)
    assert summary.graph is not None
    assert summary.graph.num_loops == len(closed)
    assert summary.graph.cost_after <= summary.graph.cost_before
    assert {segment.kind for segment in summary.segments} == {"window", "loop"}
    plan = json.loads((tmp_path / "out/work/loops/plan.json").read_text())
    assert sum(candidate["taken"] for candidate in plan["candidates"]) == len(summary.loops)
    assert all(candidate["reason"] for candidate in plan["candidates"])
    truth = read_poses_txt(round_trip / "poses.txt")
    found = compare_trajectories(read_model_poses(tmp_path / "out/sparse/0"), truth)
    assert found.num_compared == summary.num_registered == NUM_ROUND
    assert found.position_rmse < 0.02
    before = np.loadtxt(tmp_path / "out/trajectory_without_loops_tum.txt")
    after = np.loadtxt(tmp_path / "out/trajectory_tum.txt")
    assert before.shape == after.shape == (NUM_ROUND, 8)
    assert not np.allclose(before[:, 1:], after[:, 1:], atol=1e-6)

    without = replace(ROUND, loop_closing=LoopConfig(loop_closure=False), refinement=UNREFINED.refinement)
    plain = run(round_trip / "images", tmp_path / "out", without)
    assert plain.loops == ()
    assert plain.graph is not None
    assert plain.graph.num_loops == 0
    assert not (tmp_path / "out/trajectory_without_loops_tum.txt").exists()
    assert all(was_reused for name, was_reused in reused(plain).items() if name in {"features", "mapping", "depth"})


def freely_mapped(output: Path) -> list[str]:
    return sorted(path.parent.name for path in (output / "work/segments").glob("*/calibrated"))


def test_all_windows_are_self_calibrated_where_the_first_disagree(
    round_trip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(calibration, "MIN_CALIBRATION_IMAGES", 30)
    monkeypatch.setattr(calibration, "MAX_FOCAL_UNCERTAINTY_RATIO", 0.0)
    summary = run(round_trip / "images", tmp_path / "out", replace(UNREFINED_ROUND, loop_closing=NO_LOOPS))
    assert freely_mapped(tmp_path / "out") == [f"{segment.index:04d}" for segment in summary.segments]
    assert len(summary.segments) == 7


def test_segments_that_a_wrong_camera_does_not_fit_are_self_calibrated(
    round_trip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where three segments agree by chance: a fixed focal length off by a few percent gives a wrong model."""

    def too_long(*args: Any, **kwargs: Any) -> dict[int, Intrinsics]:
        agreed = calibration.agree_on_cameras(*args, **kwargs)
        return {k: replace(one, params=(1.1 * one.focal_px, *one.params[1:])) for k, one in agreed.items()}

    monkeypatch.setattr(calibration, "MIN_CALIBRATION_IMAGES", 30)
    monkeypatch.setattr(backbone, "agree_on_cameras", too_long)
    summary = run(round_trip / "images", tmp_path / "out", replace(UNREFINED_ROUND, loop_closing=NO_LOOPS))
    again = {path.parent.name for path in (tmp_path / "out/work/segments").glob("*/mapping_free")}
    assert {"0005", "0006"} <= again <= {"0001", "0003", "0005", "0006"}
    assert {"0005", "0006"} <= set(freely_mapped(tmp_path / "out"))
    assert summary.num_registered == NUM_ROUND


@pytest.mark.parametrize("group", ["affine3", "sl4"])
def test_groups_that_bend_still_place_every_camera(
    group: TransformGroup, finished: RunSummary, room: Path, tmp_path: Path
) -> None:
    shutil.copytree(finished.output, tmp_path / "out")
    bending = replace(UNREFINED, alignment=AlignmentConfig(transform_group=group))
    summary = run(room / "images", tmp_path / "out", bending)
    assert all(was_reused for name, was_reused in reused(summary).items() if name in {"features", "mapping", "depth"})
    found = compare_trajectories(read_model_poses(tmp_path / "out/sparse/0"), read_poses_txt(room / "poses.txt"))
    assert found.num_compared == NUM_IMAGES
    assert found.position_rmse < 0.05
