"""Whole runs on real photographs, judged by surveyed cameras. Skipped only where the sets are missing."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers.independent_colmap_reader import read_binary

from smust3r_colmap.config import (
    ClassicalConfig,
    FeatureConfig,
    FusionConfig,
    OutputConfig,
    RunConfig,
    SegmentationConfig,
)
from smust3r_colmap.evaluation.trajectory import Evaluation, compare_trajectories
from smust3r_colmap.execution.progress import QuietReporter
from smust3r_colmap.importers.model_poses import read_model_poses
from smust3r_colmap.importers.poses_txt import read_poses_txt
from smust3r_colmap.pipeline import reconstruct
from smust3r_colmap.report.summary import RunSummary

pytestmark = [pytest.mark.slow, pytest.mark.data]

CONFIG = RunConfig(
    segmentation=SegmentationConfig(segment_length=8, overlap=4),
    features=FeatureConfig(max_image_size=1024, max_features=2500),
    classical=ClassicalConfig(dense_size=256),
    fusion=FusionConfig(max_points=100_000),
    output=OutputConfig(trainer=False, dense=False, report=False),
)


def run(folder: Path, names: list[str], work: Path, config: RunConfig = CONFIG) -> tuple[RunSummary, Evaluation]:
    """Reconstruct some images of a set and compare the largest model with its surveyed cameras."""
    images = work / "images"
    images.mkdir()
    for name in names:
        shutil.copy(folder / "images" / name, images)
    summary = reconstruct(images, work / "out", config, reporter=QuietReporter(sys.stderr))
    estimated = read_model_poses(summary.output / "sparse/0")
    return summary, compare_trajectories(estimated, read_poses_txt(folder / "poses.txt"))


@pytest.fixture(scope="module")
def fountain(
    data_dir: Callable[[str], Path], tmp_path_factory: pytest.TempPathFactory
) -> tuple[RunSummary, Evaluation]:
    folder = data_dir("fountain_p11")
    names = sorted(path.name for path in (folder / "images").iterdir())
    return run(folder, names, tmp_path_factory.mktemp("fountain"))


def test_fountain_in_two_segments_is_within_a_centimetre(fountain: tuple[RunSummary, Evaluation]) -> None:
    """15 m across; pycolmap's mappers, which are not given the calibration either, have 8 to 11 mm."""
    summary, found = fountain
    assert summary.exit_code == 0
    assert len(summary.segments) == 2
    assert summary.num_registered == found.num_compared == 11
    assert 0 < found.position_rmse < 0.01
    assert found.rotation_median_deg < 0.6


def test_fountain_reads_back_with_its_true_size_and_focal_length(fountain: tuple[RunSummary, Evaluation]) -> None:
    summary, _ = fountain
    model = read_binary(summary.output / "sparse/0")
    (camera,) = model.cameras.values()
    assert (camera.width, camera.height) == (1024, 683)
    assert camera.params[0] == pytest.approx(920.7, rel=0.01)  # the set's own calibration
    ours = pycolmap.Reconstruction(summary.output / "sparse/0")
    assert ours.num_points3D() == summary.refinements[0].statistics.num_points > 2_000
    assert min(point.track.length() for point in ours.points3D.values()) >= 2
    assert ours.compute_mean_track_length() > 4
    assert summary.models[0].num_points > 50_000


def test_fountain_has_no_double_walls(fountain: tuple[RunSummary, Evaluation]) -> None:
    """Where both segments see a surface, their depths agree to half a percent in the median."""
    summary, _ = fountain
    accepted = [edge for edge in summary.edges if edge.accepted]
    assert accepted
    assert max(edge.relative_residual for edge in accepted) < 0.005


def test_straight_forward_motion_registers_where_colmap_finds_no_start(
    data_dir: Callable[[str], Path], tmp_path: Path
) -> None:
    folder = data_dir("kitti_a")
    names = sorted(path.name for path in (folder / "images").iterdir())[:12]
    config = replace(
        CONFIG,
        features=FeatureConfig(max_image_size=1226, max_features=2000),
        classical=ClassicalConfig(dense_size=160),
    )
    summary, found = run(folder, names, tmp_path, config)
    assert summary.num_registered == found.num_compared == 12
    assert len(summary.models) == 1
    assert found.position_rmse_percent < 2.0
    assert summary.segments[0].method == "incremental", "from the pair that was chosen for it"


def test_photographs_of_many_cameras_get_a_camera_each(data_dir: Callable[[str], Path], tmp_path: Path) -> None:
    folder = data_dir("sacre_coeur")
    config = replace(CONFIG, segmentation=SegmentationConfig())
    summary = reconstruct(folder / "images", tmp_path / "out", config, reporter=QuietReporter(sys.stderr))
    model = pycolmap.Reconstruction(summary.output / "sparse/0")
    assert model.num_reg_images() >= 9
    assert len({image.camera_id for image in model.images.values()}) == model.num_reg_images()
    sizes = {image.name: (camera.width, camera.height) for image in model.images.values() if (camera := image.camera)}
    assert len(set(sizes.values())) > 1
    assert np.isfinite([camera.params[0] for camera in model.cameras.values()]).all()


def test_the_loop_round_a_courtyard_is_found_and_closed(data_dir: Callable[[str], Path], tmp_path: Path) -> None:
    """The last photographs of castle_p30 show again what the first ones show."""
    folder = data_dir("castle_p30")
    names = sorted(path.name for path in (folder / "images").iterdir())
    config = replace(
        CONFIG,
        segmentation=SegmentationConfig(segment_length=12, overlap=6),
        features=FeatureConfig(max_image_size=640, max_features=2000),
        classical=ClassicalConfig(dense_size=128),
        workers=1,
    )
    summary, found = run(folder, names, tmp_path, config)
    (loop,) = summary.loops
    assert loop.accepted, loop.reason
    assert loop.gap_after_percent < 0.6 * loop.gap_before_percent
    truth = read_poses_txt(folder / "poses.txt")
    ends = [truth[name] for name in (loop.image_a, loop.image_b)]
    assert np.linalg.norm(ends[0][:, 3] - ends[1][:, 3]) < 0.1 * found.extent
    assert np.degrees(np.arccos(ends[0][:, 2] @ ends[1][:, 2])) < 40
    assert summary.num_registered == found.num_compared == 30
    assert found.position_rmse_percent < 0.3
    assert summary.refinements[0].num_unverified_pairs > 10  # look-alike windows of the facades
