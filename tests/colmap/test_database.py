"""The database beside the model: the same ids, the same keypoints, and every image of the collection."""

from __future__ import annotations

import resource
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers.finished_runs import CAMERA, NAMES, NUM_PLACED, WITHOUT_FEATURES, Example
from helpers.mapped_segments import NUM_IMAGES, synthetic_segment
from helpers.tracked_scenes import make_collection, true_matches

from smust3r_colmap.colmap.database import check_room, open_database, write_colmap_database
from smust3r_colmap.errors import StorageError
from smust3r_colmap.execution.task_pool import TaskPool, in_child


@pytest.fixture(scope="module")
def database(finished_example: Example, tmp_path_factory: pytest.TempPathFactory) -> Iterator[pycolmap.Database]:
    """A copy, for pycolmap writes when it opens, and others compare the example byte by byte."""
    copy = tmp_path_factory.mktemp("database") / "database.db"
    shutil.copyfile(finished_example.root / "database.db", copy)
    with pycolmap.Database.open(copy) as opened:
        yield opened


@pytest.fixture(scope="module")
def model(finished_example: Example) -> pycolmap.Reconstruction:
    return finished_example.model


def test_ids_and_names_are_those_of_the_model(database: pycolmap.Database, model: pycolmap.Reconstruction) -> None:
    assert model.num_reg_images() == NUM_PLACED
    for image_id, image in model.images.items():
        stored = database.read_image(image_id)
        assert (stored.name, stored.camera_id) == (image.name, image.camera_id)
        assert stored.frame_id == image.frame_id
        assert database.read_frame(image.frame_id).data_ids == image.frame.data_ids
    assert {rig.rig_id for rig in database.read_all_rigs()} == set(model.rigs)


def test_every_image_is_there_also_without_pose_or_features(database: pycolmap.Database) -> None:
    assert [image.name for image in database.read_all_images()] == list(NAMES)
    assert database.num_frames() == len(NAMES)
    assert database.num_keypoints_for_image(NUM_PLACED + 1) > 0
    assert database.num_keypoints_for_image(WITHOUT_FEATURES + 1) == 0


def test_observations_of_the_model_are_the_keypoints_row_by_row(
    database: pycolmap.Database, model: pycolmap.Reconstruction
) -> None:
    for image_id, image in model.images.items():
        in_model = np.array([point.xy for point in image.points2D])
        np.testing.assert_array_equal(in_model.astype(np.float32), database.read_keypoints(image_id)[:, :2])


def test_the_camera_is_the_adjusted_one_and_its_focal_length_is_trusted(
    database: pycolmap.Database, model: pycolmap.Reconstruction
) -> None:
    (camera,) = database.read_all_cameras()
    assert camera.model == model.camera(1).model
    np.testing.assert_array_equal(camera.params, model.camera(1).params)
    assert camera.has_prior_focal_length


def test_every_placed_image_has_a_prior_at_its_place_with_a_covariance_of_its_own(
    database: pycolmap.Database, model: pycolmap.Reconstruction, finished_example: Example
) -> None:
    priors = {prior.corr_data_id.id: prior for prior in database.read_all_pose_priors()}
    assert priors.keys() == set(model.reg_image_ids())
    for image_id, prior in priors.items():
        assert prior.coordinate_system == pycolmap.PosePriorCoordinateSystem.CARTESIAN
        distance = np.linalg.norm(prior.position - model.image(image_id).projection_center())
        assert distance < 1e-9 * finished_example.world.extent
        variances = np.linalg.eigvalsh(prior.position_covariance)
        np.testing.assert_allclose(prior.position_covariance, prior.position_covariance.T)
        assert variances.min() > 0
        assert 1e-5 < np.sqrt(variances.sum()) / finished_example.world.extent < 0.02
    assert len({prior.position_covariance.tobytes() for prior in priors.values()}) == len(priors)


def test_two_view_geometries_hold_the_matches_and_the_poses_of_the_model(
    database: pycolmap.Database, model: pycolmap.Reconstruction
) -> None:
    pair_ids, geometries = database.read_two_view_geometries()
    assert len(pair_ids) == database.num_matched_image_pairs() == NUM_PLACED * (NUM_PLACED - 1) // 2
    for pair_id, geometry in zip(pair_ids, geometries, strict=True):
        a, b = pycolmap.pair_id_to_image_pair(pair_id)
        assert geometry.config == pycolmap.TwoViewGeometryConfiguration.CALIBRATED
        np.testing.assert_array_equal(geometry.inlier_matches, database.read_matches(a, b))
        b_from_a = model.image(b).cam_from_world() * model.image(a).cam_from_world().inverse()
        assert geometry.cam2_from_cam1 is not None
        np.testing.assert_allclose(geometry.cam2_from_cam1.matrix(), b_from_a.matrix(), atol=1e-9)
        rays = [CAMERA.rays_cam(database.read_keypoints(i)[:, :2]) for i in (a, b)]
        rows = geometry.inlier_matches
        assert geometry.E is not None
        residual = np.sum(rays[1][rows[:, 1]] * (rays[0][rows[:, 0]] @ geometry.E.T), axis=1)
        assert np.median(np.abs(residual)) < 0.01


def test_a_camera_that_nothing_was_adjusted_for_keeps_its_guess(tmp_path: Path, finished_example: Example) -> None:
    """The writer by itself: two cameras, images without keypoints, no relative poses, no priors."""
    other = CAMERA.resized(200, 150)
    collection = make_collection(tmp_path, 3, names={1: "ü b.png"}, cameras=(CAMERA, other), camera_of={2: 1})
    world = finished_example.world
    write_colmap_database(
        tmp_path / "database.db",
        collection,
        (CAMERA, other),
        keypoints={0: world.keypoints[0], 1: world.keypoints[1]},
        matches={(0, 1): true_matches(world, (0, 1))},
        j_from_i={},
        priors=(),
    )
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        assert [camera.camera_id for camera in database.read_all_cameras()] == [1, 2]
        assert not any(camera.has_prior_focal_length for camera in database.read_all_cameras())
        assert [(i.name, i.camera_id, i.frame_id) for i in database.read_all_images()] == [
            ("0000.png", 1, 1),
            ("ü b.png", 1, 2),
            ("0002.png", 2, 3),
        ]
        assert [frame.rig_id for frame in database.read_all_frames()] == [1, 1, 2]
        assert database.num_keypoints_for_image(3) == 0
        assert database.num_pose_priors() == 0
        geometry = database.read_two_view_geometry(1, 2)
        assert geometry.E is None
        assert len(geometry.inlier_matches) == len(true_matches(world, (0, 1))) > 50
        (row, *_) = geometry.inlier_matches
        shown = [world.point_of[k][row[k]] for k in (0, 1)]
        assert shown[0] == shown[1] >= 0


# ------------------------------------------------------------------------------- opening
def open_many_times(path: Path) -> int:
    for _ in range(100):
        with open_database(path) as database:
            found = int(database.num_images())
    return found


@pytest.mark.slow
def test_processes_that_open_the_database_at_the_same_moment_wait_for_each_other(tmp_path: Path) -> None:
    path = synthetic_segment(tmp_path).task.database
    with TaskPool(workers=2) as pool:
        results = list(pool.map(open_many_times, [path] * 2))
    assert [result.value for result in results] == [NUM_IMAGES, NUM_IMAGES]


def test_what_does_not_pass_is_not_waited_for(tmp_path: Path) -> None:
    """A path that SQLite cannot hold, and a folder that is not there: said at once, without advice to delete."""
    deep = tmp_path.joinpath(*["d" * 100] * 6)
    deep.mkdir(parents=True)
    start = time.monotonic()
    with pytest.raises(StorageError, match=r"its path has \d+ bytes, and SQLite takes 500; name a shorter") as long:
        open_database(deep / "database.db", patience_s=30)
    with pytest.raises(StorageError, match=r"unable to open database file") as gone:
        open_database(tmp_path / "gone" / "database.db", patience_s=30)
    assert time.monotonic() - start < 5
    assert not any(word in str(error.value).lower() for error in (long, gone) for word in ("delete", "overwrite"))


def test_a_database_that_is_held_is_waited_for_and_never_advised_to_be_deleted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "database.db"
    pycolmap.Database.open(path).close()
    opened = pycolmap.Database.open
    tries: list[Path] = []

    def held(path: Path) -> pycolmap.Database:
        tries.append(path)
        if len(tries) < 4:
            raise RuntimeError("No registered database factory succeeded.")
        return opened(path)

    monkeypatch.setattr(pycolmap.Database, "open", held)
    with pytest.raises(StorageError, match=r"cannot be opened for 0 s .*another process holds it, wait") as gave_up:
        open_database(path, patience_s=0)
    assert "delete" not in str(gave_up.value).lower()
    open_database(path, patience_s=5).close()
    assert len(tries) == 4


def limited(path: Path) -> str:
    """What ``check_room`` says in a process whose files may have 1 MB; the limit ends with the process."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, 1 << 20))
    check_room(path, 100)
    return "went on"


def test_a_disk_that_refuses_is_told_in_the_words_of_the_system(tmp_path: Path) -> None:
    check_room(tmp_path / "database.db", 100)
    with pytest.raises(StorageError, match=r"database.db: File too large, 8 MiB more are needed; .* the same command"):
        in_child(limited, tmp_path / "database.db")
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_is_no_database_is_named(tmp_path: Path) -> None:
    (tmp_path / "database.db").write_bytes(b"garbage" * 1000)
    with pytest.raises(StorageError, match=r"database\.db: cannot be opened .* --overwrite"):
        open_database(tmp_path / "database.db", patience_s=0.1)
