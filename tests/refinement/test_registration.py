"""Images without a pose, which COLMAP's mapper registers in the refined model, and what it must not change."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers.finished_runs import NUM_PLACED, Example, refine_corner
from helpers.tracked_scenes import angle_deg, centres_of, poses_of

from smust3r_colmap.config import CameraConfig
from smust3r_colmap.execution.task_pool import TaskFailure
from smust3r_colmap.importers.image_folder import collection_from_scan, scan_image_folder
from smust3r_colmap.refinement import registration
from smust3r_colmap.refinement.mapper import MapperSession
from smust3r_colmap.refinement.registration import ImageRegistration, MappingTask, continue_mapping, register_images
from smust3r_colmap.refinement.statistics import StepReport
from smust3r_colmap.storage.run_directory import RunDirectory

TAKEN_OUT = 4


def register(
    model: pycolmap.Reconstruction,
    run: Example,
    scratch: Path,
    run_mapper: Callable[[MappingTask], None] = continue_mapping,
) -> ImageRegistration:
    return register_images(
        model,
        run.root / "database.db",
        agrees=lambda *_: True,
        scratch=scratch,
        threads=1,
        run_mapper=run_mapper,
    )


def without(run: Example, *images: int) -> pycolmap.Reconstruction:
    model = run.model
    for image in images:
        model.deregister_frame(image + 1)
    return model


def unchanged(found: pycolmap.Reconstruction, before: pycolmap.Reconstruction) -> bool:
    then, now = poses_of(before), poses_of(found)
    return then.keys() <= now.keys() and all(np.allclose(now[i], then[i], rtol=0, atol=1e-9) for i in then)


def drop_the_first(task: MappingTask) -> None:
    """The mapper itself, which of larger models drops images that are left without observations."""
    continue_mapping(task)
    model = pycolmap.Reconstruction(task.output)
    model.deregister_frame(1)
    model.write(task.output)


@pytest.mark.slow
def test_an_image_taken_out_returns_to_its_pose_and_all_others_stay(finished_example: Example, tmp_path: Path) -> None:
    before = without(finished_example, TAKEN_OUT)
    for k in range(len(before.image(1).points2D)):
        if before.image(1).points2D[k].has_point3D():
            before.delete_observation(1, k)
    done = register(before, finished_example, tmp_path, drop_the_first)
    assert done.registered == (TAKEN_OUT + 1,)
    assert done.report.accepted
    assert done.report.name == "image registration"
    assert (done.report.before.num_images, done.report.after.num_images) == (NUM_PLACED - 1, NUM_PLACED)
    assert done.report.after.num_observations > done.report.before.num_observations + 100
    assert done.report.max_moved_percent < 1e-6
    assert unchanged(done.model, before)
    assert len(done.model.image(1).points2D) == len(before.image(1).points2D) > 0
    assert (done.model.image(1).name, done.model.image(1).num_points3D) == (before.image(1).name, 0)
    np.testing.assert_array_equal(done.model.camera(1).params, before.camera(1).params)
    new, adjusted = (poses_of(model)[TAKEN_OUT] for model in (done.model, finished_example.model))
    distance = np.linalg.norm(centres_of(new[None]) - centres_of(adjusted[None]))
    assert 0 < distance < 0.01 * finished_example.world.extent
    assert angle_deg(new, adjusted) < 0.2
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_an_image_whose_matches_contradict_its_pose_is_deregistered(finished_example: Example, tmp_path: Path) -> None:
    before = without(finished_example, TAKEN_OUT)
    asked: list[int] = []

    def deny(model: pycolmap.Reconstruction, image_id: int) -> bool:
        assert model.image(image_id).has_pose
        asked.append(image_id)
        return False

    done = register_images(before, finished_example.root / "database.db", agrees=deny, scratch=tmp_path, threads=1)
    assert asked == [TAKEN_OUT + 1]
    assert done.model is before
    assert done.registered == ()
    assert not done.report.accepted
    assert done.report.after == done.report.before
    assert "no further image has 15 observations and matches that agree" in done.report.reason


def move_a_camera(task: MappingTask) -> None:
    """In place of the mapper: the missing image is added, and another moved by a thousandth of its distance."""
    continue_mapping(task)
    model = pycolmap.Reconstruction(task.output)
    pose = model.image(1).cam_from_world().matrix()
    pose[:, 3] *= 1.001
    model.frame(1).rig_from_world = pycolmap.Rigid3d(pose)
    model.write(task.output)


@pytest.mark.slow
def test_a_mapper_that_moves_an_existing_camera_is_rejected(finished_example: Example, tmp_path: Path) -> None:
    before = without(finished_example, TAKEN_OUT)
    done = register(before, finished_example, tmp_path, move_a_camera)
    assert done.model is before
    assert "moved an existing camera" in done.report.reason


def test_a_mapper_that_dies_adds_nothing(
    finished_example: Example, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    death = TaskFailure(reason="the process died", crashed=True)
    monkeypatch.setattr(registration, "in_child", lambda *_, **__: death)
    before = without(finished_example, TAKEN_OUT)
    done = register(before, finished_example, tmp_path)
    assert done.model is before
    assert not done.report.accepted
    assert done.report.reason == "COLMAP's mapper failed: the process died"


@pytest.mark.slow
@pytest.mark.parametrize("added", [True, False])
def test_the_refinement_stores_the_registered_image(
    added: bool, finished_example: Example, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The refinement by itself would have registered the image; this is prevented here."""
    monkeypatch.setattr(MapperSession, "register_missing", lambda *_: None)
    collection = collection_from_scan(scan_image_folder(finished_example.images), CameraConfig())
    placed = [i for i in range(NUM_PLACED) if i != TAKEN_OUT or not added]
    with RunDirectory(tmp_path / "run") as run:
        result = refine_corner(run, collection, finished_example.world, placed=placed, register_missing=True)
        model = pycolmap.Reconstruction(run.work / "refined/0/model")
        with pycolmap.Database.open(run.work / "refined/database.db") as database:
            geometry = database.read_two_view_geometry(TAKEN_OUT + 1, TAKEN_OUT + 2)
    report: StepReport = result.steps[-1]
    assert report.name == "image registration"
    assert report.accepted == added
    assert bool(report.reason) != added
    assert result.registered == ((collection.images[TAKEN_OUT].name,) if added else ())
    assert result.statistics.num_images == model.num_reg_images() == NUM_PLACED
    assert geometry.cam2_from_cam1 is not None
    black = [i for i, point in model.points3D.items() if not point.color.any()]
    assert not black
