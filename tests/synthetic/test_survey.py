"""The rendered survey: targets are where the list says, and its lists are read back with the errors they shall have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.surveys import write_blank_survey

from smust3r_colmap.errors import StorageError
from smust3r_colmap.georeferencing.georeference import ModelGeometry, georeference
from smust3r_colmap.importers.gps_tags import read_image_positions
from smust3r_colmap.importers.survey_files import read_points_files
from smust3r_colmap.synthetic import survey
from smust3r_colmap.synthetic.survey import (
    HEIGHT,
    PIXEL_M,
    WIDTH,
    SurveyScene,
    ground_height,
    survey_camera,
    write_survey,
)

pytest.importorskip("pyproj")

SCENE = SurveyScene()
POSES = SCENE.cam_from_local()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_blank_survey(tmp_path_factory.mktemp("survey"))


@pytest.mark.slow
def test_targets_are_painted_where_they_are_projected() -> None:
    picture = SCENE.render(POSES[9]).astype(float).mean(axis=2)
    found = 0
    for target in SCENE.targets_local:
        x, y = survey_camera().xy_img((POSES[9][:, :3] @ target + POSES[9][:, 3])[None])[0]
        if 20 < x < WIDTH - 20 and 20 < y < HEIGHT - 20:
            found += 1
            columns, rows = (int(x - 5), int(x + 4)), (int(y - 5), int(y + 4))
            quarters = np.array([[picture[row, column] for column in columns] for row in rows])
            assert np.ptp(quarters) > 150
            assert abs(quarters[0, 0] - quarters[1, 1]) < 80
            assert abs(quarters[0, 1] - quarters[1, 0]) < 80
    assert found >= 3


@pytest.mark.slow
def test_the_same_ground_has_the_same_colour_in_two_images() -> None:
    """Through height field and perspective: not so if a ray ended anywhere else than on the hills."""
    pictures = [SCENE.render(POSES[k]).astype(float).mean(axis=2) for k in (9, 10)]
    rng = np.random.default_rng(0)
    flat = rng.uniform([-20, -20], [5, 20], (400, 2))
    ground = np.column_stack([flat, ground_height(flat)])
    values = []
    for pose, picture in zip(POSES[9:11], pictures, strict=True):
        xy = survey_camera().xy_img(ground @ pose[:, :3].T + pose[:, 3])
        inside = np.abs(xy - [WIDTH / 2, HEIGHT / 2]).max(axis=1) < HEIGHT / 2 - 1
        columns, rows = np.where(np.stack([inside, inside], axis=1), xy, 1).astype(int).T
        values.append(np.where(inside, picture[rows, columns], np.nan))
    first, second = values
    both = np.isfinite(first + second)
    assert np.count_nonzero(both) > 100
    assert np.corrcoef(first[both], second[both])[0, 1] > 0.9


def test_neighbouring_images_overlap() -> None:
    centres = -np.einsum("nji,nj->ni", POSES[:, :, :3], POSES[:, :, 3])
    assert len(centres) == 28
    assert np.linalg.norm(np.diff(centres[:7, :2], axis=0), axis=1).max() < 0.35 * HEIGHT * PIXEL_M


def test_control_points_of_the_true_poses_place_check_points(folder: Path) -> None:
    names = tuple(f"DJI_{k:04}.jpg" for k in range(1, 29))
    model = ModelGeometry(
        names=names,
        cam_from_model=POSES,
        cameras=(survey_camera(),) * len(names),
        points_model=SCENE.targets_local,
        pixel_size_model=PIXEL_M,
    )
    points = read_points_files([folder / "gcp_list.txt"])
    positions = read_image_positions(folder / "images", names)
    assert (points.faults, positions.faults, len(positions.positions)) == ((), (), 28)
    found = georeference(
        model, positions, points, crs="auto", altitude="auto", height_offset_m=0, rng=np.random.default_rng(0)
    )
    accuracy = found.accuracies()
    assert (accuracy["control"].count, accuracy["check"].count) == (8, 12)
    assert 0.05 * PIXEL_M < accuracy["check"].horizontal < 0.5 * PIXEL_M
    assert 0.1 * PIXEL_M < accuracy["check"].rmse[2] < 1.0 * PIXEL_M
    assert float(found.local_from_model.scale) == pytest.approx(1, abs=1e-3)
    assert [one.image for one in found.fixes if one.left_out] == ["DJI_0005.jpg", "DJI_0014.jpg", "DJI_0023.jpg"]
    assert accuracy["gps"].rmse == pytest.approx(survey._GPS_M, rel=0.4)


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="cannot write the survey"):
        write_survey(tmp_path / "file")
