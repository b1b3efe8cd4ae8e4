"""Each snippet of docs/continue_in_colmap.md is run, on a small finished run, and does what the page says."""

from __future__ import annotations

import os
import re
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers.finished_runs import NUM_PLACED, Example
from helpers.tracked_scenes import angle_deg, centres_of, poses_of

from smust3r_colmap.execution.task_pool import TaskFailure, TaskPool
from smust3r_colmap.geometry.arrays import FloatArray

PAGE = Path(__file__).resolve().parents[2] / "docs/continue_in_colmap.md"
TAKEN_OUT = 4
"""Index of an image whose pose is taken from the model, for the page to find it again."""


@dataclass(frozen=True, kw_only=True)
class Snippet:
    """A block of the page below a heading, with the first block before it, to be run in ``folder``."""

    heading: str
    code: str
    folder: Path


def read_snippets(folder: Path) -> list[Snippet]:
    heading, found = "", []
    for match in re.finditer(r"^## ([^\n]+)$|^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.M | re.S):
        if match[1]:
            heading = match[1]
        else:
            found.append((heading, match[2]))
    (_, first), *others = found
    return [Snippet(heading=heading, code=first + code, folder=folder) for heading, code in others]


def run_snippet(snippet: Snippet) -> str:
    """In a child process, where it may change the working directory and die."""
    os.chdir(snippet.folder)
    exec(compile(snippet.code, snippet.heading, "exec"), {})
    return snippet.heading


@pytest.fixture(scope="module")
def continued(finished_example: Example, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``CONTINUED`` after all snippets were run, one after the other, beside ``OUT`` and ``IMAGES``."""
    folder = tmp_path_factory.mktemp("page")
    shutil.copytree(finished_example.root, folder / "OUT", ignore=shutil.ignore_patterns("work"))
    shutil.copytree(finished_example.images, folder / "IMAGES")
    model = finished_example.model
    model.deregister_frame(TAKEN_OUT + 1)
    model.write(folder / "OUT/sparse/0")
    snippets = read_snippets(folder)
    with TaskPool(workers=1, log_file=folder / "native.log") as pool:
        results = list(pool.map(run_snippet, snippets))
    failed = [f"{snippets[r.index].heading}: {r.value.reason}" for r in results if isinstance(r.value, TaskFailure)]
    assert not failed, (failed, (folder / "native.log").read_text(errors="replace")[-3000:])
    return folder / "CONTINUED"


@pytest.fixture(scope="module")
def before(continued: Path) -> pycolmap.Reconstruction:
    """The model that the page goes on from: one image of the run is missing in it."""
    return pycolmap.Reconstruction(continued.parent / "OUT/sparse/0")


def assert_ids_and_names_agree(found: pycolmap.Reconstruction, run: Example) -> None:
    names = {i: image.name for i, image in run.model.images.items()}
    assert {i: image.name for i, image in found.images.items()}.items() <= names.items()
    assert all(image.frame_id == i and image.camera_id == 1 for i, image in found.images.items())


def largest_move(found: pycolmap.Reconstruction, before: pycolmap.Reconstruction) -> float:
    """Of a camera that both have, in the unit of the model."""
    then, now = poses_of(before), poses_of(found)
    assert then.keys() <= now.keys()
    both = sorted(then)
    distance = centres_of(np.array([now[i] for i in both])) - centres_of(np.array([then[i] for i in both]))
    return float(np.linalg.norm(distance, axis=1).max())


def distance_after_alignment(found: pycolmap.Reconstruction, truth: FloatArray) -> float:
    """Rms of the camera centres from the true ones (N, 3) by image index, after the best similarity."""
    poses = poses_of(found)
    centres = centres_of(np.array(list(poses.values())))
    true_from_found = pycolmap.estimate_sim3d(centres, truth[list(poses)])
    aligned = np.array([true_from_found * centre for centre in centres])
    return float(np.sqrt(np.mean(np.sum((aligned - truth[list(poses)]) ** 2, axis=1))))


def test_the_page_has_a_snippet_in_every_section_that_promises_one(tmp_path: Path) -> None:
    headings = [snippet.heading for snippet in read_snippets(tmp_path)]
    assert headings == [
        "Triangulation",
        *["Bundle adjustment"] * 2,
        "Missing images",
        *["Mapping"] * 2,
        *["Dense reconstruction"] * 2,
    ]


@pytest.mark.slow
def test_points_are_triangulated_anew_without_moving_a_camera(
    continued: Path, before: pycolmap.Reconstruction, finished_example: Example
) -> None:
    found = pycolmap.Reconstruction(continued / "points")
    assert_ids_and_names_agree(found, finished_example)
    assert largest_move(found, before) < 1e-9
    assert found.compute_num_observations() >= 0.98 * before.compute_num_observations()
    assert 2 < found.compute_mean_track_length() < NUM_PLACED
    assert 0.05 < found.compute_mean_reprojection_error() < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("name", ["adjusted", "adjusted_with_priors"])
def test_an_adjusted_model_stays_as_good_as_it_was(
    name: str, continued: Path, before: pycolmap.Reconstruction, finished_example: Example
) -> None:
    found = pycolmap.Reconstruction(continued / name)
    assert_ids_and_names_agree(found, finished_example)
    assert found.compute_num_observations() == before.compute_num_observations()
    assert found.compute_mean_reprojection_error() < 1.05 * before.compute_mean_reprojection_error()
    assert 0 < largest_move(found, before) < 0.02 * finished_example.world.extent


@pytest.mark.slow
def test_a_missing_image_is_registered_and_the_others_stay(
    continued: Path, before: pycolmap.Reconstruction, finished_example: Example
) -> None:
    assert before.num_reg_images() == NUM_PLACED - 1
    found = pycolmap.Reconstruction(continued / "completed")
    assert_ids_and_names_agree(found, finished_example)
    assert found.num_reg_images() == NUM_PLACED
    assert largest_move(found, before) < 1e-9
    assert found.compute_num_observations() > before.compute_num_observations()
    new, adjusted = poses_of(found)[TAKEN_OUT], poses_of(finished_example.model)[TAKEN_OUT]
    assert np.linalg.norm(centres_of(new[None]) - centres_of(adjusted[None])) < 0.01 * finished_example.world.extent
    assert angle_deg(new, adjusted) < 0.2


@pytest.mark.slow
def test_the_mapper_with_priors_keeps_frame_and_scale(continued: Path, finished_example: Example) -> None:
    found = pycolmap.Reconstruction(continued / "mapped_with_priors/0")
    assert_ids_and_names_agree(found, finished_example)
    assert found.num_reg_images() == NUM_PLACED
    assert largest_move(found, finished_example.model) < 0.02 * finished_example.world.extent


@pytest.mark.slow
def test_global_mapping_has_the_same_shape(continued: Path, finished_example: Example) -> None:
    found = pycolmap.Reconstruction(continued / "mapped_globally/0")
    assert_ids_and_names_agree(found, finished_example)
    assert found.num_reg_images() == NUM_PLACED
    assert distance_after_alignment(found, finished_example.world.centres) < 0.01 * finished_example.world.extent


@pytest.mark.slow
def test_the_dense_workspace_is_fused_and_images_are_undistorted(continued: Path, finished_example: Example) -> None:
    points = pycolmap.Reconstruction()
    points.import_PLY(continued / "fused/fused.ply")
    xyz = np.array([point.xyz for point in points.points3D.values()])
    assert 1_000 < len(xyz) < 20_000
    from_the_walls = np.abs(xyz[:, 2] + 0.6 * np.abs(xyz[:, 0]) - 2) / np.hypot(1, 0.6)
    assert np.quantile(from_the_walls, 0.9) < 0.1  # two percent of the depth, for the focal length is adjusted
    undistorted = pycolmap.Reconstruction(continued / "dense/sparse")
    assert undistorted.num_reg_images() == NUM_PLACED - 1
    assert {camera.model.name for camera in undistorted.cameras.values()} == {"PINHOLE"}
    assert all((continued / "dense/images" / image.name).is_file() for image in undistorted.images.values())
