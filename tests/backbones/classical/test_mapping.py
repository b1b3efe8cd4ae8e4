"""The classical backbone's poses, on data that pycolmap synthesises and on made-up models."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers.runs import quiet_run
from helpers.scenes import CAMERA, make_submodel, points_ahead, rotation_about_y, walk

from smust3r_colmap.backbones.classical import backbone as backbone_module
from smust3r_colmap.backbones.classical import calibration, mapping
from smust3r_colmap.backbones.classical.backbone import ClassicalBackbone
from smust3r_colmap.backbones.classical.calibration import (
    CalibrationTask,
    agree_on_cameras,
    are_certain,
    calibrate_segment,
    choose_pilots,
    is_better,
    misfits,
)
from smust3r_colmap.backbones.classical.mapped_model import MappedModel, connected_groups, restrict_model
from smust3r_colmap.backbones.classical.mapping import MappedSegment, MappingTask, map_segment
from smust3r_colmap.backbones.classical.model_checks import (
    absurd_focal,
    diverged_focal,
    epipolar_errors_px,
    find_denied_steps,
    find_doubtful_jumps,
    find_hinges,
    find_jumps,
    near_positions,
)
from smust3r_colmap.backbones.classical.start_pair import StartPair
from smust3r_colmap.backbones.classical.storage import read_mapped, write_mapped
from smust3r_colmap.colmap.database import open_database, write_images
from smust3r_colmap.config import ClassicalConfig
from smust3r_colmap.errors import StorageError
from smust3r_colmap.execution.progress import QuietReporter
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.execution.task_pool import TaskFailure, TaskPool, TaskResult
from smust3r_colmap.features import sift as features_module
from smust3r_colmap.features.matching import match_pairs
from smust3r_colmap.features.pairs import plan_loop_pairs, plan_pairs
from smust3r_colmap.features.sift import _Features, _write_features
from smust3r_colmap.features.vlad import vlad_descriptors
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.products import ImageCollection, RunFeatures, Segment, SourceImage, Tracks

NUM_IMAGES = 8


# --------------------------------------------------------------------- which pairs
def test_small_segments_are_matched_exhaustively() -> None:
    pairs = plan_pairs(Segment(index=0, images=(4, 5, 6, 7)), neighbours=2, exhaustive_below=4)
    assert sorted(pairs) == [(4, 5), (4, 6), (4, 7), (5, 6), (5, 7), (6, 7)]


def test_long_segments_match_neighbours_and_doubling_steps() -> None:
    pairs = plan_pairs(Segment(index=0, images=tuple(range(100, 140))), neighbours=3, exhaustive_below=10)
    from_first = sorted(b - 100 for a, b in pairs if a == 100)
    assert from_first == [1, 2, 3, 4, 8, 16, 32]
    assert len(set(pairs)) == len(pairs)
    assert all(100 <= a < b < 140 for a, b in pairs)


# --------------------------------------------------------------------------- folds
def model_of_walk(num_images: int) -> MappedModel:
    submodel = make_submodel(
        walk(num_images), tuple(range(num_images)), points_ahead(50, np.random.default_rng(0)), Sim3.identity()
    )
    assert submodel.tracks is not None
    return MappedModel(
        images=submodel.images,
        seg_from_cam=submodel.seg_from_cam,
        intrinsics=submodel.intrinsics,
        tracks=submodel.tracks,
        reprojection_error_px=0.3,
        method="made up",
    )


def strong_neighbours(num_images: int) -> dict[tuple[int, int], int]:
    return {(k, k + 1): 200 for k in range(num_images - 1)}


def test_an_honest_walk_has_no_jumps() -> None:
    assert find_jumps(model_of_walk(12), strong_neighbours(12)) == []


def test_a_turn_between_matching_neighbours_is_a_jump() -> None:
    model = model_of_walk(12)
    model.seg_from_cam[7:, :, :3] = model.seg_from_cam[7:, :, :3] @ rotation_about_y(150.0)
    assert find_jumps(model, strong_neighbours(12)) == [6]


def test_a_leap_between_matching_neighbours_is_a_jump() -> None:
    model = model_of_walk(12)
    model.seg_from_cam[5:, 0, 3] += 15.0
    assert find_jumps(model, strong_neighbours(12)) == [4]


def test_neighbours_that_do_not_match_may_stand_apart() -> None:
    model = model_of_walk(12)
    model.seg_from_cam[5:, 0, 3] += 15.0
    pairs = strong_neighbours(12)
    pairs[4, 5] = 12
    assert find_jumps(model, pairs) == []


def test_moving_on_after_a_pause_is_not_a_jump() -> None:
    model = model_of_walk(12)
    model.seg_from_cam[:, 0, 3] *= 1e-3
    model.seg_from_cam[6:, 0, 3] += 0.5
    assert find_jumps(model, strong_neighbours(12)) == []


def test_the_two_ends_of_a_loop_are_not_neighbours() -> None:
    assert list(near_positions((3, 4, 5, 40, 41))) == [(0, 1), (0, 2), (1, 2), (3, 4)]
    model = model_of_walk(12)
    model.seg_from_cam[5:, 0, 3] += 15.0
    far = replace(model, images=(*range(5), *range(40, 47)))
    assert find_jumps(far, {**strong_neighbours(47), (4, 40): 500}) == []


def test_a_restricted_model_keeps_points_that_two_images_see() -> None:
    model = model_of_walk(6)
    once = replace(
        model,
        tracks=Tracks(
            points_seg=model.tracks.points_seg[:3],
            point_of_observation=np.array([0, 0, 1, 1, 2, 2]),
            image_of_observation=np.array([0, 1, 1, 5, 4, 5]),
            feature_of_observation=np.array([7, 8, 9, 10, 11, 12]),
        ),
    )
    part = restrict_model(once, [3, 4, 5])
    assert part.images == (3, 4, 5)
    np.testing.assert_array_equal(part.tracks.points_seg, model.tracks.points_seg[2:3])
    np.testing.assert_array_equal(part.tracks.point_of_observation, [0, 0])
    np.testing.assert_array_equal(part.tracks.image_of_observation, [4, 5])
    np.testing.assert_array_equal(part.tracks.feature_of_observation, [11, 12])


def test_epipolar_errors_tell_a_true_relative_pose_from_a_folded_one() -> None:
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


def hinged_model(num_across: int) -> MappedModel:
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


def test_halves_that_hang_on_few_points_are_found() -> None:
    assert find_hinges(hinged_model(11)) == [2]
    assert find_hinges(hinged_model(12)) == []


def test_models_that_share_four_images_hang_together() -> None:
    whole = model_of_walk(12)
    parts = [restrict_model(whole, list(range(a, b))) for a, b in ((0, 6), (2, 8), (7, 12))]
    groups = connected_groups(parts)
    assert sorted(sorted(model.images[0] for model in group) for group in groups) == [[0, 2], [7]]
    assert len(connected_groups([*parts, restrict_model(whole, list(range(4, 11)))])) == 1


# ------------------------------------------------------------------- pycolmap's maps
@pytest.fixture(scope="module")
def synthetic(tmp_path_factory: pytest.TempPathFactory) -> tuple[MappingTask, pycolmap.Reconstruction]:
    """A noise-free database of eight images round a cloud, and the truth."""
    path = tmp_path_factory.mktemp("synthetic") / "database.db"
    pycolmap.set_random_seed(3)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs = 1
    options.num_frames_per_rig = NUM_IMAGES
    options.num_points3D = 300
    with pycolmap.Database.open(path) as database:
        truth = pycolmap.synthesize_dataset(options, database)
    start = Intrinsics(model="SIMPLE_RADIAL", width=1024, height=768, params=(1200.0, 512.0, 384.0, 0.0))
    images = tuple(range(NUM_IMAGES))
    task = MappingTask(
        segment=0,
        database=path,
        images=images,
        camera_indices=(0,) * NUM_IMAGES,
        pairs=plan_pairs(Segment(index=0, images=images), neighbours=8, exhaustive_below=25),
        cameras=(start,),
        trusted={},
        seed=0,
    )
    return task, truth


def centre_error(model: MappedModel, truth: pycolmap.Reconstruction) -> float:
    """Largest distance of a camera centre from the truth after the best similarity."""
    true = np.array([truth.image(i + 1).projection_center() for i in model.images])
    truth_from_model = pycolmap.estimate_sim3d(model.seg_from_cam[:, :, 3], true)
    moved = np.array([truth_from_model * centre for centre in model.seg_from_cam[:, :, 3]])
    return float(np.linalg.norm(moved - true, axis=1).max())


def test_a_segment_is_mapped_to_rounding_without_noise(
    synthetic: tuple[MappingTask, pycolmap.Reconstruction],
) -> None:
    task, truth = synthetic
    mapped = map_segment(task)
    (model,) = mapped.models
    assert model.images == tuple(range(NUM_IMAGES))
    assert not mapped.unregistered
    assert centre_error(model, truth) < 1e-3
    assert model.intrinsics[0].params == pytest.approx((1280.0, 512.0, 384.0, 0.05), rel=1e-3, abs=1e-3)


def test_known_cameras_stay_as_they_are_and_become_no_prior(
    synthetic: tuple[MappingTask, pycolmap.Reconstruction],
) -> None:
    task, truth = synthetic
    known = replace(task.cameras[0], params=(1280.0, 512.0, 384.0, 0.05))
    (model,) = map_segment(replace(task, trusted={0: known})).models
    assert set(model.intrinsics) == {known}
    assert centre_error(model, truth) < 1e-4


def windows_of(cameras: Sequence[Sequence[int]], task: MappingTask) -> list[MappingTask]:
    """Windows whose images have these cameras."""
    return [
        replace(task, segment=k, camera_indices=tuple(own), images=tuple(range(len(own))))
        for k, own in enumerate(cameras)
    ]


def pilots_of(cameras: Sequence[Sequence[int]], task: MappingTask) -> list[int]:
    return [pilot.segment for pilot in choose_pilots(windows_of(cameras, task))]


def test_pilots_are_the_first_windows_that_share_no_images(
    synthetic: tuple[MappingTask, pycolmap.Reconstruction],
) -> None:
    task = synthetic[0]
    assert pilots_of([[0] * 60] * 9, task) == [0, 2, 4]
    assert pilots_of([[0] * 60] * 30, task) == [0, 2, 4]
    assert pilots_of([[0] * 20] * 40, task) == [0, 2, 4, 6, 8, 10, 12, 14]  # 150 images
    assert pilots_of([[0] * 60] * 4, task) == [0, 2, 1]
    assert pilots_of([[0] * 60], task) == [0]


def test_every_camera_has_pilots_of_its_own(synthetic: tuple[MappingTask, pycolmap.Reconstruction]) -> None:
    task = synthetic[0]
    two = [[0] * 60] * 8 + [[1] * 60] * 8
    assert sorted(pilots_of(two, task)) == [0, 2, 4, 8, 10, 12]
    # A camera of one window only, and one that is rare in all of them, leave their windows free.
    assert sorted(pilots_of([[0] * 60] * 8 + [[1] * 60] + [[0] * 60], task)) == [0, 2, 4, 8]
    assert len(pilots_of([[0] * 55 + [1] * 5] * 9, task)) == 9


def test_mapping_twice_gives_the_same_bits(synthetic: tuple[MappingTask, pycolmap.Reconstruction]) -> None:
    first, second = map_segment(synthetic[0]), map_segment(synthetic[0])
    np.testing.assert_array_equal(first.models[0].seg_from_cam, second.models[0].seg_from_cam)
    np.testing.assert_array_equal(first.models[0].tracks.points_seg, second.models[0].tracks.points_seg)


def test_images_without_matches_are_left_out_with_the_reason(
    synthetic: tuple[MappingTask, pycolmap.Reconstruction],
) -> None:
    task, _ = synthetic
    mapped = map_segment(replace(task, pairs=tuple(pair for pair in task.pairs if 7 not in pair)))
    assert [left.image for left in mapped.unregistered] == [7]
    assert mapped.unregistered[0].reason == "no verified matches to any image of its segment"


def test_a_segment_without_matches_gives_nothing_and_says_so(
    synthetic: tuple[MappingTask, pycolmap.Reconstruction],
) -> None:
    mapped = map_segment(replace(synthetic[0], pairs=()))
    assert mapped.models == ()
    assert mapped.attempts == ("no pair of images has 15 verified matches",)
    assert len(mapped.unregistered) == NUM_IMAGES


def test_mapped_segments_come_back_from_disk(
    synthetic: tuple[MappingTask, pycolmap.Reconstruction], tmp_path: Path
) -> None:
    mapped = map_segment(synthetic[0])
    write_mapped(tmp_path, mapped)
    back = read_mapped(tmp_path)
    assert (back.segment, back.attempts, back.unregistered) == (0, mapped.attempts, ())
    assert back.models[0].intrinsics == mapped.models[0].intrinsics
    np.testing.assert_array_equal(back.models[0].seg_from_cam, mapped.models[0].seg_from_cam)
    np.testing.assert_array_equal(
        back.models[0].tracks.feature_of_observation, mapped.models[0].tracks.feature_of_observation
    )


def test_a_model_that_its_matches_deny_is_broken_at_that_step(
    synthetic: tuple[MappingTask, pycolmap.Reconstruction],
) -> None:
    """The images look from all sides, so every step is a jump; only the one that was bent is denied."""
    task, _ = synthetic
    (model,) = map_segment(task).models
    inliers = dict.fromkeys(task.pairs, 200)
    with open_database(task.database) as database:
        assert find_jumps(model, inliers)
        assert find_doubtful_jumps(model, inliers, database) == []
        assert find_denied_steps(model, inliers, database) == []
        model.seg_from_cam[5:, :, :3] = model.seg_from_cam[5:, :, :3] @ rotation_about_y(25.0)
        assert 4 in find_denied_steps(model, inliers, database)
        assert not {0, 1, 2} & set(find_denied_steps(model, inliers, database))
        model.seg_from_cam[5:, :, :3] = model.seg_from_cam[5:, :, :3] @ rotation_about_y(90.0)
        assert find_doubtful_jumps(model, inliers, database) == [4]
        model.seg_from_cam[2:, 0, 3] += 1000.0
        assert 1 in find_doubtful_jumps(model, inliers, database), "matches say nothing of the length of a step"


def test_a_start_that_gives_no_model_is_followed_by_the_next(
    synthetic: tuple[MappingTask, pycolmap.Reconstruction], monkeypatch: pytest.MonkeyPatch
) -> None:
    task, _ = synthetic
    without = StartPair(first=0, second=1, angle_deg=20.0, forward=False)
    sound = StartPair(first=2, second=4, angle_deg=20.0, forward=False)
    monkeypatch.setattr(mapping, "choose_start_pairs", lambda *_, **__: (without, sound))
    mapped = map_segment(replace(task, pairs=tuple(pair for pair in task.pairs if pair != (0, 1))))
    assert mapped.attempts == ("incremental: 8 of 8 images",)
    monkeypatch.setattr(mapping, "choose_start_pairs", lambda *_, **__: ())
    mapped = map_segment(task)
    assert mapped.attempts == ("incremental: 0 of 8 images", "incremental, relaxed start: 8 of 8 images")


@pytest.mark.parametrize(("links", "last"), [(2, "incremental, continued relaxed"), (3, "global")])
def test_further_mappers_are_tried_only_where_enough_pairs_link_the_halves(
    links: int, last: str, synthetic: tuple[MappingTask, pycolmap.Reconstruction], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both halves are placed, as two models: with a pair or two between them no mapper makes it one."""
    task, _ = synthetic
    across = [pair for pair in task.pairs if pair[0] < 4 <= pair[1]]
    convert = mapping._Ladder._convert

    def in_halves(self: mapping._Ladder, models: dict[int, pycolmap.Reconstruction], method: str) -> list[MappedModel]:
        whole = max(convert(self, models, method), key=lambda model: len(model.images))
        if method == "incremental":
            return [restrict_model(whole, range(4))]
        return [restrict_model(whole, half) for half in (range(4), range(4, 8))]

    monkeypatch.setattr(mapping._Ladder, "_convert", in_halves)
    mapped = map_segment(replace(task, pairs=tuple(pair for pair in task.pairs if pair not in across[links:])))
    assert [len(model.images) for model in mapped.models] == [4, 4]
    assert mapped.attempts[0] == "incremental: 4 of 8 images"
    assert mapped.attempts[-1] == f"{last}: 4 + 4 of 8 images"


# ---------------------------------------------------------------------- calibration
START = Intrinsics(model="SIMPLE_RADIAL", width=640, height=480, params=(700.0, 320.0, 240.0, 0.0))


def with_focal(focal: float) -> MappedModel:
    return replace(model_of_walk(6), intrinsics=(replace(START, params=(focal, 320.0, 240.0, 0.01)),) * 6)


def test_one_diverged_segment_does_not_move_the_agreed_camera() -> None:
    segments = [read_only_segment(k, with_focal(focal)) for k, focal in enumerate([520.0, 525.0, 853.0, 528.0, 526.0])]
    agreed = agree_on_cameras(segments, [0] * 6, [START])
    assert agreed[0].params[0] == pytest.approx(526.0, abs=2.0)
    assert agreed[0].params[3] == pytest.approx(0.01)


def test_a_diverged_pilot_of_three_does_not_pull_the_agreed_camera() -> None:
    segments = [read_only_segment(k, with_focal(focal)) for k, focal in enumerate([494.0, 515.0, 1186.0])]
    assert 494 <= agree_on_cameras(segments, [0] * 6, [START])[0].params[0] <= 515
    apart = [read_only_segment(k, with_focal(focal)) for k, focal in enumerate([400.0, 900.0])]
    assert 400 < agree_on_cameras(apart, [0] * 6, [START])[0].params[0] < 900


@pytest.mark.parametrize(
    ("focal", "certain"),
    [
        ([315.6, 315.9, 316.4], True),
        ([515.0, 517.0, 1186.0], True),  # one that diverged among others that agree
        ([494.0, 515.0, 1186.0], False),
        ([500.0, 560.0], False),
        ([500.0], False),
        ([], False),
    ],
)
def test_pilots_are_relied_on_where_they_agree(focal: list[float], certain: bool) -> None:
    pilots = [read_only_segment(k, with_focal(one)) for k, one in enumerate(focal)]
    assert are_certain({0}, pilots, [0] * 6) is certain
    assert are_certain((), pilots, [0] * 6)  # of no camera there is nothing to know
    assert not are_certain({0, 1}, pilots, [0] * 6)


def test_segments_are_misfits_where_their_pixels_are_clearly_worse_than_the_pilots() -> None:
    def with_error(number: int, error_px: float) -> MappedSegment:
        return read_only_segment(number, replace(with_focal(500.0), reprojection_error_px=error_px))

    pilots = [with_error(0, 0.53), with_error(2, 0.66), with_error(4, 0.71)]
    nothing = replace(pilots[0], segment=9, models=())
    assert misfits([with_error(1, 0.86), with_error(3, 1.03), with_error(5, np.nan), nothing], pilots) == [3, 5]
    assert misfits([with_error(1, 9.0)], [nothing]) == []
    assert is_better(with_error(3, 0.64), with_error(3, 1.03))
    assert not is_better(with_error(3, 0.9), with_error(3, 1.03))
    assert not is_better(nothing, with_error(3, 1.03))
    smaller = replace(pilots[0], models=(restrict_model(pilots[0].models[0], range(4)),))
    assert not is_better(smaller, with_error(3, 1.03))


def read_only_segment(number: int, model: MappedModel) -> MappedSegment:
    return MappedSegment(segment=number, models=(model,), attempts=(), unregistered=())


def test_one_odd_camera_of_many_does_not_condemn_a_model() -> None:
    model = model_of_walk(8)
    camera_of = {image: image for image in model.images}
    other = replace(CAMERA, params=(900.0, 900.0, *CAMERA.params[2:]))
    assert diverged_focal(model, camera_of, {3: other}) == ""
    odd = dict.fromkeys(range(5), other)
    assert diverged_focal(model, camera_of, odd) == "focal length 500 px, the run's is 900 px"


def test_a_focal_length_of_nonsense_is_refused_with_its_number() -> None:
    wild = replace(CAMERA, params=(9510.0, 9510.0, 320.0, 240.0))
    model = model_of_walk(6)
    assert absurd_focal(model) == ""
    assert absurd_focal(replace(model, intrinsics=(wild, *model.intrinsics[1:]))) == ""
    assert absurd_focal(replace(model, intrinsics=(wild,) * 6)) == "focal length 9510 px is 14.9 times the longer side"


def test_a_camera_seen_by_one_model_only_is_left_to_it() -> None:
    alone = [read_only_segment(0, model_of_walk(6))]
    assert agree_on_cameras(alone, [0] * 6, [CAMERA]) == {}
    assert agree_on_cameras(alone, [0] * 6, [CAMERA], min_models=1) == {0: CAMERA}


def test_adjusting_to_the_agreed_camera_fixes_it_exactly(
    synthetic: tuple[MappingTask, pycolmap.Reconstruction],
) -> None:
    task, truth = synthetic
    agreed = {0: replace(task.cameras[0], params=(1280.0, 512.0, 384.0, 0.05))}
    calibrated = calibrate_segment(CalibrationTask(mapping=task, mapped=map_segment(task), agreed=agreed))
    (model,) = calibrated.models
    assert model.intrinsics[0].params == (1280.0, 512.0, 384.0, 0.05)
    assert centre_error(model, truth) < 1e-4
    assert "adjusted to the agreed camera" in calibrated.attempts[-1]


def test_a_model_that_the_agreed_camera_does_not_fit_keeps_its_own(
    synthetic: tuple[MappingTask, pycolmap.Reconstruction],
) -> None:
    task, truth = synthetic
    agreed = {0: replace(task.cameras[0], params=(1180.0, 512.0, 384.0, -0.2))}
    calibrated = calibrate_segment(CalibrationTask(mapping=task, mapped=map_segment(task), agreed=agreed))
    (model,) = calibrated.models
    assert model.intrinsics[0].params[0] == pytest.approx(1280.0, rel=1e-3)
    assert centre_error(model, truth) < 1e-3
    assert "keep their own focal length" in calibrated.attempts[-1]


def test_mapping_again_never_loses_sound_models(
    synthetic: tuple[MappingTask, pycolmap.Reconstruction], monkeypatch: pytest.MonkeyPatch
) -> None:
    task, _ = synthetic
    (whole,) = map_segment(task).models
    sound = restrict_model(whole, range(4))
    diverged = restrict_model(whole, range(4, 8))
    focal = (replace(whole.intrinsics[0], params=(2000.0, 512.0, 384.0, 0.05)),) * 4
    mapped = replace(read_only_segment(0, sound), models=(sound, replace(diverged, intrinsics=focal)))
    monkeypatch.setattr(calibration, "map_segment", lambda task: replace(mapped, models=(), attempts=("in vain",)))
    agreed = {0: whole.intrinsics[0]}
    calibrated = calibrate_segment(CalibrationTask(mapping=task, mapped=mapped, agreed=agreed))
    assert [model.images for model in calibrated.models] == [(0, 1, 2, 3)]
    assert [left.image for left in calibrated.unregistered] == [4, 5, 6, 7]
    assert "in vain" in calibrated.attempts


# ---------------------------------------------------------------------- what failed
def test_an_image_interrupted_between_its_two_writes_is_finished_later(tmp_path: Path) -> None:
    features = _Features(keypoints=np.ones((5, 4), np.float32), descriptors=np.ones((5, 128), np.uint8))
    with pycolmap.Database.open(tmp_path / "d.db") as database:
        write_images(database, [CAMERA], [(0, 0)])
        with pytest.raises(KeyboardInterrupt), pycolmap.DatabaseTransaction(database):
            kind = pycolmap.FeatureExtractorType.SIFT
            database.write_descriptors(1, pycolmap.FeatureDescriptors(kind, features.descriptors))
            raise KeyboardInterrupt
        assert not database.exists_keypoints(1)
        _write_features(database, 0, features)
        assert database.num_keypoints_for_image(1) == database.num_descriptors_for_image(1) == 5


def open_many_times(path: Path) -> int:
    for _ in range(100):
        with open_database(path) as database:
            found = int(database.num_images())
    return found


def test_processes_that_open_the_database_at_the_same_moment_wait_for_each_other(
    synthetic: tuple[MappingTask, pycolmap.Reconstruction],
) -> None:
    with TaskPool(workers=2) as pool:
        results = list(pool.map(open_many_times, [synthetic[0].database] * 2))
    assert [result.value for result in results] == [NUM_IMAGES, NUM_IMAGES]


def test_a_file_that_is_no_database_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "database.db").write_bytes(b"garbage" * 1000)
    monkeypatch.setattr(features_module, "_PATIENCE_S", 0.1)
    with pytest.raises(StorageError, match=r"database\.db: cannot be opened .* --overwrite"):
        open_database(tmp_path / "database.db")


def test_pairs_that_could_not_be_matched_are_not_reported_as_done(
    synthetic: tuple[MappingTask, pycolmap.Reconstruction], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = synthetic[0].database
    monkeypatch.setattr(TaskPool, "map", one_failure)
    with QuietReporter(sys.stderr).stage("matching", total=2) as stage:
        done = match_pairs(path, [(0, 1), (0, 77)], workers=1, seed=0, log_file=None, stage=stage)
    assert done == {(0, 1)}


def one_failure(*_: object, **__: object) -> Iterator[TaskResult[MappedSegment]]:
    return iter([TaskResult(index=0, value=TaskFailure(reason="out of memory", crashed=True))])


def test_a_segment_that_failed_is_tried_again_at_the_next_start(
    synthetic: tuple[MappingTask, pycolmap.Reconstruction], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = read_only_segment(0, model_of_walk(6))
    monkeypatch.setattr(TaskPool, "map", one_failure)
    with quiet_run(tmp_path / "out") as run, run.clock.stage("mapping", total=1) as stage:
        backbone = backbone_of(synthetic[0], run)
        folder = run.folder.stage("segments", "0000", "calibrated", key="k")
        (found,) = backbone._finish(map_segment, [synthetic[0]], [folder], [kept], stage)
        assert not folder.is_done
    assert found.models == kept.models
    assert found.attempts == ("calibrated: out of memory",)


def die_in_the_global_mapper(task: MappingTask) -> MappedSegment:
    if task.use_global:
        os.kill(os.getpid(), signal.SIGKILL)
    return read_only_segment(task.segment, model_of_walk(6))


def test_a_global_mapper_that_kills_its_process_costs_only_its_own_rung(
    synthetic: tuple[MappingTask, pycolmap.Reconstruction], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backbone_module, "map_segment", die_in_the_global_mapper)
    task = synthetic[0]
    with quiet_run(tmp_path / "out") as run:
        (mapped,) = backbone_of(task, run)._map([Segment(index=0, images=task.images)], {0: task.pairs})
    assert mapped.models[0].images == tuple(range(6))


def backbone_of(task: MappingTask, run: Run) -> ClassicalBackbone:
    """A backbone whose features are in the database of a task."""
    image = SourceImage(name="0", path=run.folder.root / "0", width=640, height=480, camera=0, digest="0")
    collection = ImageCollection(
        images=tuple(replace(image, name=str(k)) for k in range(NUM_IMAGES)), cameras=(CAMERA,)
    )
    backbone = ClassicalBackbone(collection, ClassicalConfig(), run)
    backbone._features = RunFeatures(database=task.database, key="features", usable=(True,) * NUM_IMAGES, rejected=())
    return backbone


def test_a_sweep_that_failed_leaves_readable_empty_maps_and_is_tried_again(
    synthetic: tuple[MappingTask, pycolmap.Reconstruction], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(TaskPool, "map", one_failure)
    submodel = make_submodel(walk(3), (0, 1, 2), points_ahead(9, np.random.default_rng(0)), Sim3.identity())
    with quiet_run(tmp_path / "out") as run:
        backbone = backbone_of(synthetic[0], run)
        (maps,), _ = backbone._dense([submodel], [submodel.segment])
        assert not backbone._depth_task(submodel).folder.is_done
    assert len(maps) == 3
    assert maps.depth(2).shape == (288, 384)
    assert not maps.depth(2).any()
    assert (maps.confidence(2) == 1).all()
    assert np.isnan(maps.pointmap_seg(2)).all()
    assert maps.rgb(2).shape == (288, 384, 3)


def test_a_loop_pairs_each_end_like_a_window_and_across_the_most_alike() -> None:
    ends = (*range(10, 31), *range(70, 91))
    descriptors = np.zeros((100, 64), np.float32)
    for k in range(21):  # image 10 + k shows what image 70 + k shows, and a little of the next ones
        descriptors[10 + k, 2 * k : 2 * k + 4] = descriptors[70 + k, 2 * k : 2 * k + 4] = 0.5
    pairs = plan_loop_pairs(Segment(index=3, images=ends, kind="loop"), descriptors, neighbours=3)
    window = set(plan_pairs(Segment(index=0, images=tuple(range(60))), neighbours=3, exhaustive_below=25))
    across = {pair for pair in pairs if pair[0] < 60 <= pair[1]}
    inside = set(pairs) - across
    assert len(pairs) == len(set(pairs))
    assert {pair for pair in inside if pair[1] < 60} <= window
    assert len(inside) == 2 * (20 + 19 + 18 + 17 + 13 + 5)
    assert {(10 + k, 70 + k + step) for k in range(1, 20) for step in (-1, 0, 1)} <= across
    assert all(first < second for first, second in pairs)
    assert len(across) < 90


# ---------------------------------------------------------------------- descriptors
def test_descriptors_of_alike_images_are_alike() -> None:
    rng = np.random.default_rng(0)
    places = [rng.integers(0, 120, size=(300, 128), dtype=np.uint8) for _ in range(4)]
    again = [
        np.clip(place.astype(int) + rng.integers(-6, 7, size=place.shape), 0, 255).astype(np.uint8) for place in places
    ]
    vlad = vlad_descriptors([*places, *again], rng=np.random.default_rng(1))
    similarity = vlad[:4] @ vlad[4:].T
    np.testing.assert_allclose(np.linalg.norm(vlad, axis=1), 1.0, atol=1e-5)
    assert (similarity.argmax(axis=1) == np.arange(4)).all()
    assert similarity.diagonal().min() > 0.5 > np.abs(similarity - np.diag(similarity.diagonal())).max()


def test_an_image_without_features_has_a_zero_descriptor() -> None:
    rng = np.random.default_rng(0)
    some = rng.integers(0, 120, size=(300, 128), dtype=np.uint8)
    vlad = vlad_descriptors([some, np.zeros((0, 128), np.uint8)], rng=rng)
    assert not vlad[1].any()
    assert vlad[0].any()
