"""The checks of mapped models: poses that contradict each other or the matches, weak links, diverged cameras."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from helpers.mapped_segments import model_of_walk, synthetic_segment
from helpers.scenes import CAMERA, points_ahead, rotation_about_y

from smust3r_colmap.backbones.classical.mapped_model import MappedModel
from smust3r_colmap.backbones.classical.mapping import map_segment
from smust3r_colmap.backbones.classical.model_checks import (
    diverged_focal,
    epipolar_errors_px,
    find_epipolar_outliers,
    find_inconsistent_poses,
    find_unconfirmed_poses,
    find_weak_links,
    implausible_focal,
    near_positions,
)
from smust3r_colmap.colmap.database import open_database
from smust3r_colmap.products import Tracks
from smust3r_colmap.segmentation.view_graph import ViewGraph

ORDER = ViewGraph.chain(50)


def strong_neighbours(num_images: int) -> dict[tuple[int, int], int]:
    return {(k, k + 1): 200 for k in range(num_images - 1)}


def test_a_walk_has_no_inconsistent_poses() -> None:
    assert find_inconsistent_poses(model_of_walk(12), ORDER, strong_neighbours(12)) == []


def test_a_large_rotation_between_matching_neighbours_is_inconsistent() -> None:
    model = model_of_walk(12)
    model.seg_from_cam[7:, :, :3] = model.seg_from_cam[7:, :, :3] @ rotation_about_y(150.0)
    assert find_inconsistent_poses(model, ORDER, strong_neighbours(12)) == [6]


def test_a_long_step_between_matching_neighbours_is_inconsistent() -> None:
    model = model_of_walk(12)
    model.seg_from_cam[5:, 0, 3] += 15.0
    assert find_inconsistent_poses(model, ORDER, strong_neighbours(12)) == [4]


def test_neighbours_that_do_not_match_may_be_far_apart() -> None:
    model = model_of_walk(12)
    model.seg_from_cam[5:, 0, 3] += 15.0
    pairs = strong_neighbours(12)
    pairs[4, 5] = 12
    assert find_inconsistent_poses(model, ORDER, pairs) == []


def test_moving_on_after_a_pause_is_consistent() -> None:
    model = model_of_walk(12)
    model.seg_from_cam[:, 0, 3] *= 1e-3
    model.seg_from_cam[6:, 0, 3] += 0.5
    assert find_inconsistent_poses(model, ORDER, strong_neighbours(12)) == []


def test_the_two_ends_of_a_loop_are_not_neighbours() -> None:
    assert list(near_positions((3, 4, 5, 40, 41), ORDER)) == [(0, 1), (0, 2), (1, 2), (3, 4)]
    model = model_of_walk(12)
    model.seg_from_cam[5:, 0, 3] += 15.0
    far = replace(model, images=(*range(5), *range(40, 47)))
    assert find_inconsistent_poses(far, ORDER, {**strong_neighbours(47), (4, 40): 500}) == []


def test_epipolar_errors_tell_a_true_relative_pose_from_a_wrong_one() -> None:
    model = model_of_walk(6)
    points = model.tracks.points_seg
    xy_img = []
    for k in (2, 3):
        cam_from_seg = np.linalg.inv(np.vstack([model.seg_from_cam[k], [0, 0, 0, 1]]))[:3]
        xy_img.append(CAMERA.xy_img(points @ cam_from_seg[:, :3].T + cam_from_seg[:, 3]))
    assert epipolar_errors_px(model, 2, 3, xy_img[0], xy_img[1]).max() < 1e-6
    off_px = epipolar_errors_px(model, 2, 3, xy_img[0], xy_img[1] + [0.0, 3.0])
    assert 1.0 < np.median(off_px) < 3.0
    model.seg_from_cam[3:, :, :3] = model.seg_from_cam[3:, :, :3] @ rotation_about_y(150.0)
    assert np.median(epipolar_errors_px(model, 2, 3, xy_img[0], xy_img[1])) > 4.0


def model_with_a_link(num_across: int) -> MappedModel:
    """Two halves of three images each with forty points of their own, and some that both see."""
    model = model_of_walk(6)
    num_points = 80 + num_across
    seen = [range(0, 3)] * 40 + [range(3, 6)] * 40 + [range(2, 4)] * num_across
    return replace(
        model,
        tracks=Tracks(
            points_seg=points_ahead(num_points, np.random.default_rng(0)),
            point_of_observation=np.repeat(np.arange(num_points), [len(images) for images in seen]),
            image_of_observation=np.concatenate([list(images) for images in seen]),
            feature_of_observation=np.concatenate([np.full(len(images), p) for p, images in enumerate(seen)]),
        ),
    )


def test_halves_with_few_common_points_are_weakly_linked() -> None:
    assert find_weak_links(model_with_a_link(11)) == [2]
    assert find_weak_links(model_with_a_link(12)) == []


def test_one_different_camera_of_many_does_not_reject_a_model() -> None:
    model = model_of_walk(8)
    camera_of = {image: image for image in model.images}
    other = replace(CAMERA, params=(900.0, 900.0, *CAMERA.params[2:]))
    assert diverged_focal(model, camera_of, {3: other}) == ""
    most = dict.fromkeys(range(5), other)
    assert diverged_focal(model, camera_of, most) == "focal length 500 px, the run's is 900 px"


def test_an_implausible_focal_length_is_reported_with_its_value() -> None:
    extreme = replace(CAMERA, params=(9510.0, 9510.0, 320.0, 240.0))
    model = model_of_walk(6)
    assert implausible_focal(model) == ""
    assert implausible_focal(replace(model, intrinsics=(extreme, *model.intrinsics[1:]))) == ""
    assert (
        implausible_focal(replace(model, intrinsics=(extreme,) * 6))
        == "focal length 9510 px is 14.9 times the longer side"
    )


def test_matches_that_contradict_a_model_name_the_position(tmp_path: Path) -> None:
    """The images look from all sides, so every pose is inconsistent; only the one that was rotated is an outlier."""
    task = synthetic_segment(tmp_path).task
    (model,) = map_segment(task).models
    inliers = dict.fromkeys(task.pairs, 200)
    with open_database(task.database) as database:
        assert find_inconsistent_poses(model, ORDER, inliers)
        assert find_unconfirmed_poses(model, ORDER, inliers, database) == []
        assert find_epipolar_outliers(model, ORDER, inliers, database) == []
        model.seg_from_cam[5:, :, :3] = model.seg_from_cam[5:, :, :3] @ rotation_about_y(25.0)
        assert 4 in find_epipolar_outliers(model, ORDER, inliers, database)
        assert not {0, 1, 2} & set(find_epipolar_outliers(model, ORDER, inliers, database))
        model.seg_from_cam[5:, :, :3] = model.seg_from_cam[5:, :, :3] @ rotation_about_y(90.0)
        assert find_unconfirmed_poses(model, ORDER, inliers, database) == [4]
        model.seg_from_cam[2:, 0, 3] += 1000.0
        assert 1 in find_unconfirmed_poses(model, ORDER, inliers, database), "epipolar errors do not depend on the step"
