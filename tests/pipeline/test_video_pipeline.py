"""A video of the rendered room, from the file to models with the times of its frames."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.videos import write_video
from PIL import Image

from smust3r_colmap.config import (
    ClassicalConfig,
    FeatureConfig,
    OutputConfig,
    RunConfig,
    VideoConfig,
)
from smust3r_colmap.evaluation.trajectory import compare_trajectories
from smust3r_colmap.execution.progress import QuietReporter
from smust3r_colmap.exporters.finished_run import open_finished
from smust3r_colmap.importers.model_poses import read_model_poses
from smust3r_colmap.importers.poses_txt import read_poses_txt
from smust3r_colmap.pipeline import reconstruct
from smust3r_colmap.report.summary import RunSummary
from smust3r_colmap.storage.config_file import config_to_toml
from smust3r_colmap.storage.run_directory import RunDirectory
from smust3r_colmap.synthetic.room import write_demo

pytestmark = pytest.mark.slow

NUM_IMAGES, NUM_SHOWN, RATE = 24, 8, 4
CONFIG = RunConfig(
    workers=1,
    video=VideoConfig(fps=RATE),
    features=FeatureConfig(max_features=1200),
    classical=ClassicalConfig(dense_size=64, depth_planes=12),
    output=OutputConfig(trainer=False, dense=False, report=False),
)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The start of a walk, as a video beside the truth."""
    folder = tmp_path_factory.mktemp("room")
    write_demo(folder, num_images=NUM_IMAGES, width=320, height=240)
    images = [np.asarray(Image.open(path)) for path in sorted((folder / "images").iterdir())[:NUM_SHOWN]]
    write_video(folder / "walk.mp4", images, rate=RATE)
    return folder


@pytest.fixture(scope="module")
def finished(room: Path) -> RunSummary:
    return reconstruct(room / "walk.mp4", room / "out", CONFIG, reporter=QuietReporter(sys.stderr))


def test_the_video_is_reconstructed_as_its_images_would_be(finished: RunSummary, room: Path) -> None:
    assert (finished.num_images, finished.num_registered, len(finished.models)) == (NUM_SHOWN, NUM_SHOWN, 1)
    estimated = read_model_poses(finished.output / "sparse/0")
    names = [f"walk/{k / RATE:010.3f}.jpg" for k in range(NUM_SHOWN)]
    assert sorted(estimated) == names
    truth = list(read_poses_txt(room / "poses.txt").values())[:NUM_SHOWN]
    found = compare_trajectories(estimated, dict(zip(names, truth, strict=True)))
    assert found.num_compared == NUM_SHOWN
    assert 0 < found.position_rmse < 0.02


def test_trajectories_have_the_times_of_the_frames(finished: RunSummary) -> None:
    for name in ("trajectory_tum.txt", "trajectory_stitched_tum.txt"):
        times_s = np.loadtxt(finished.output / name)[:, 0]
        assert times_s == pytest.approx(np.arange(NUM_SHOWN) / RATE, abs=1e-9)


def test_a_finished_run_knows_its_frames_and_their_times(finished: RunSummary) -> None:
    with RunDirectory(finished.output) as run:
        opened = open_finished(run)
    assert opened.images.parent == (finished.output / "work/frames").resolve()
    assert opened.timestamps_s == {f"walk/{k / RATE:010.3f}.jpg": k / RATE for k in range(NUM_SHOWN)}


def test_a_second_start_reuses_the_frames(finished: RunSummary, room: Path) -> None:
    again = reconstruct(room / "walk.mp4", room / "out", CONFIG, reporter=QuietReporter(sys.stderr))
    assert {stage.name: stage.reused for stage in again.stages}["frames of walk.mp4"]


def test_killed_while_frames_are_taken_it_goes_on_to_the_same_model(
    finished: RunSummary, room: Path, tmp_path: Path
) -> None:
    (tmp_path / "config.toml").write_text(config_to_toml(CONFIG))
    command = [sys.executable, "-m", "smust3r_colmap", "reconstruct", str(room / "walk.mp4")]
    command += ["--output", str(tmp_path / "out"), "--config", str(tmp_path / "config.toml")]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as process:
        assert process.stderr is not None
        assert any(said.startswith("frames of walk.mp4") for said in process.stderr)
        process.kill()
    assert process.returncode == -9
    assert not (tmp_path / "out/summary.json").exists()
    again = reconstruct(room / "walk.mp4", tmp_path / "out", CONFIG, reporter=QuietReporter(sys.stderr))
    assert again.num_registered == NUM_SHOWN
    before, after = (next((out / "work/frames").iterdir()) for out in (finished.output, tmp_path / "out"))
    for path in sorted(before.rglob("*.*")):
        assert (after / path.relative_to(before)).read_bytes() == path.read_bytes()
    for name in ("images.bin", "points3D.bin", "cameras.bin"):
        found = (tmp_path / "out/sparse/0" / name).read_bytes()
        assert found == (finished.output / "sparse/0" / name).read_bytes(), name
