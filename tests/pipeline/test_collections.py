"""Whole runs on collections that are no evenly paced walk: names in no order, two rooms with strangers, a slow film."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from smust3r_colmap.config import (
    ClassicalConfig,
    FeatureConfig,
    FusionConfig,
    OutputConfig,
    RunConfig,
    SegmentationConfig,
)
from smust3r_colmap.evaluation.trajectory import compare_trajectories
from smust3r_colmap.execution.progress import QuietReporter
from smust3r_colmap.importers.model_poses import read_model_poses
from smust3r_colmap.importers.poses_txt import read_poses_txt
from smust3r_colmap.pipeline import reconstruct
from smust3r_colmap.report.summary import RunSummary
from smust3r_colmap.storage.config_file import config_to_toml
from smust3r_colmap.storage.depth_maps import depth_maps_of_run
from smust3r_colmap.synthetic.room import write_demo

pytestmark = pytest.mark.slow

CONFIG = RunConfig(
    workers=1,
    segmentation=SegmentationConfig(segment_length=16, overlap=8, retrieval_neighbours=10),
    features=FeatureConfig(max_features=1200),
    classical=ClassicalConfig(dense_size=160, depth_planes=32),
    fusion=FusionConfig(max_points=20_000),
    output=OutputConfig(trainer=False, dense=False, report=False),
)
NUM_IMAGES = 40
STRANGERS = ("0_stranger0.png", "0_stranger1.png", "0_stranger2.png")


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("room")
    write_demo(folder, num_images=NUM_IMAGES, width=320, height=240)
    return folder


def run(images: Path, output: Path, config: RunConfig = CONFIG) -> RunSummary:
    return reconstruct(images, output, config, reporter=QuietReporter(sys.stderr))


def shuffled(room: Path, folder: Path, *, seed: int) -> dict[str, str]:
    """Copies under names in no order; the old name by the new one."""
    folder.mkdir(exist_ok=True)
    paths = sorted((room / "images").iterdir())
    old_names = {}
    for number, k in enumerate(np.random.default_rng(seed).permutation(len(paths))):
        name = f"{seed}_{number:03d}{paths[k].suffix}"
        shutil.copy(paths[k], folder / name)
        old_names[name] = paths[k].name
    return old_names


@pytest.fixture(scope="module")
def mixed(room: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    """The room in no order with three pictures of nothing, and the old names of its images."""
    images = tmp_path_factory.mktemp("mixed") / "images"
    old_names = shuffled(room, images, seed=1)
    rng = np.random.default_rng(3)
    for name in STRANGERS:
        blobs = cv2.resize(rng.integers(0, 255, size=(24, 32, 3), dtype=np.uint8), (320, 240))
        cv2.imwrite(str(images / name), blobs)
    return images, old_names


@pytest.fixture(scope="module")
def finished(mixed: tuple[Path, dict[str, str]]) -> RunSummary:
    images, _ = mixed
    return run(images, images.parent / "out")


def test_images_in_no_order_give_the_model_of_the_walk(
    finished: RunSummary, mixed: tuple[Path, dict[str, str]], room: Path
) -> None:
    images, old_names = mixed
    assert {segment.kind for segment in finished.segments} == {"cluster"}
    assert len(finished.segments) > 2
    assert finished.order.startswith("images in no order")
    assert [model.num_images for model in finished.models] == [NUM_IMAGES]
    found = {old_names[name]: pose for name, pose in read_model_poses(finished.output / "sparse/0").items()}
    assert 0 < compare_trajectories(found, read_poses_txt(room / "poses.txt")).position_rmse < 0.02
    again = {stage.name: stage.reused for stage in run(images, finished.output).stages}
    assert all(again[name] for name in ("look-alikes", "cover", "mapping", "alignment", "refinement"))


def test_strangers_in_no_order_are_left_out_by_name(finished: RunSummary) -> None:
    assert {note.name for note in finished.unregistered} == set(STRANGERS)


@pytest.mark.parametrize("line", ["look-alikes", "cover"])
def test_killed_before_clusters_are_cut_it_goes_on_to_the_same_model(
    line: str, finished: RunSummary, mixed: tuple[Path, dict[str, str]], tmp_path: Path
) -> None:
    images, _ = mixed
    output, config = tmp_path / "out", tmp_path / "config.toml"
    config.write_text(config_to_toml(CONFIG))
    shutil.copytree(finished.output / "work/features", output / "work/features")
    (output / "work/lock").touch()
    command = [sys.executable, "-m", "smust3r_colmap", "reconstruct", str(images), "--output", str(output)]
    with subprocess.Popen(
        [*command, "--config", str(config)], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
    ) as process:
        assert process.stderr is not None
        for said in process.stderr:
            if said.startswith(line):
                process.kill()
                break
    assert process.returncode == -9
    run(images, output)
    for name in ("images.bin", "points3D.bin", "cameras.bin"):
        found = (output / "sparse/0" / name).read_bytes()
        assert found == (finished.output / "sparse/0" / name).read_bytes(), name


def test_frames_between_keyframes_get_pose_and_depth(room: Path, tmp_path: Path) -> None:
    settings = replace(CONFIG.segmentation, keyframes=3 * NUM_IMAGES // 4)
    summary = run(room / "images", tmp_path / "out", replace(CONFIG, segmentation=settings))
    assert summary.num_keyframes == 3 * NUM_IMAGES // 4
    assert (summary.num_registered, len(summary.models), summary.exit_code) == (NUM_IMAGES, 1, 0)
    truth = read_poses_txt(room / "poses.txt")
    distance = compare_trajectories(read_model_poses(tmp_path / "out/sparse/0"), truth)
    assert 0 < distance.position_rmse < 0.02
    maps = depth_maps_of_run(tmp_path / "out/work")
    covered = [float((maps.depth(name) > 0).mean()) for name in truth]
    assert min(covered) > 0.25
