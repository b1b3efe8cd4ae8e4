"""The judge of uncertainties: shares within sigmas, and that spoilt models are not good."""

from __future__ import annotations

from pathlib import Path

import judge_uncertainty as judge
import numpy as np
import pytest
from helpers.tracked_scenes import (
    arc,
    ball,
    make_collection,
    make_world,
    model_with_true_tracks,
    pairs_within,
    true_matches,
    write_features,
)
from scipy.spatial.transform import Rotation

from smust3r_colmap.geometry.sim3 import invert_rigid

NUM_IMAGES = 14


@pytest.fixture(scope="module")
def run_and_data(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A finished run with true tracks, and its truth in other units."""
    folder = tmp_path_factory.mktemp("judge")
    run, data = folder / "run", folder / "data"
    (run / "work/features").mkdir(parents=True)
    (run / "sparse/0").mkdir(parents=True)
    data.mkdir()
    rng = np.random.default_rng(7)
    world = make_world(arc(NUM_IMAGES), ball(300, rng), rng)
    pairs = pairs_within(range(NUM_IMAGES), 5)
    write_features(
        run / "work/features/database.db",
        make_collection(folder, NUM_IMAGES),
        world,
        verified={pair: true_matches(world, pair) for pair in pairs},
    )
    model_with_true_tracks(world, world.cam_from_world, rng, noise=0).write_binary(run / "sparse/0")
    off = rng.normal(scale=1e-3, size=(NUM_IMAGES, 3))
    lines = []
    for i, pose in enumerate(invert_rigid(world.cam_from_world)):
        x, y, z, w = Rotation.from_matrix(pose[:, :3]).as_quat()
        centre = 10 * (pose[:, 3] + off[i])
        lines.append(" ".join([f"{i:04d}.png", *(f"{number:.12g}" for number in (w, x, y, z, *centre))]))
    (data / "poses.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return f"{run}={data}"


def test_errors_are_relative_to_the_extent_in_whatever_unit(run_and_data: str) -> None:
    run, data = map(Path, run_and_data.split("="))
    judged = judge.judge(run, data)
    # 1e-3 in each axis, of which the similarity takes a part
    assert np.sqrt(np.mean(judged.errors**2)) * judged.uncertainty.extent == pytest.approx(np.sqrt(3) * 1e-3, rel=0.35)
    assert judged.figures.true_rmse == pytest.approx(np.sqrt(np.mean(judged.errors**2)))


def test_a_sound_model_is_good(run_and_data: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert judge.main([run_and_data]) == 0
    out = capsys.readouterr().out
    assert "; good\n" in out
    assert "all images together" in out


@pytest.mark.parametrize("how", judge.SPOILERS)
def test_a_spoilt_model_is_not_good(run_and_data: str, how: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert judge.main(["--spoil", how, run_and_data]) == 0
    out = capsys.readouterr().out
    assert "; failed\n" in out or "; weak\n" in out
    assert "contradict" in out


def test_a_folder_without_a_model_is_named(
    tmp_path: Path, run_and_data: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert judge.main([f"{tmp_path}={run_and_data.split('=')[1]}"]) == 2
    assert "no model in sparse/0" in capsys.readouterr().err
