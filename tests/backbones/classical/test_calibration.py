"""One calibration for the run: which segments determine it, and what becomes of the models that differ from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from helpers.mapped_segments import SyntheticSegment, model_of_walk, segment_of, synthetic_segment
from helpers.scenes import CAMERA

from smust3r_colmap.backbones.classical.calibration import (
    CalibrationTask,
    agree_on_cameras,
    calibrate_segment,
    choose_calibration_segments,
    find_worse_fits,
    focal_lengths_agree,
    self_calibration_is_better,
)
from smust3r_colmap.backbones.classical.mapped_model import MappedModel, restrict_model
from smust3r_colmap.backbones.classical.mapping import MappedSegment, map_segment
from smust3r_colmap.backbones.classical.strategies import MappingTask
from smust3r_colmap.geometry.camera import Intrinsics

START = Intrinsics(model="SIMPLE_RADIAL", width=640, height=480, params=(700.0, 320.0, 240.0, 0.0))


@pytest.fixture(scope="module")
def segment(tmp_path_factory: pytest.TempPathFactory) -> SyntheticSegment:
    return synthetic_segment(tmp_path_factory.mktemp("synthetic"))


@pytest.fixture(scope="module")
def mapped(segment: SyntheticSegment) -> MappedSegment:
    return map_segment(segment.task)


def windows_of(cameras: Sequence[Sequence[int]], task: MappingTask) -> list[MappingTask]:
    """Windows whose images have these cameras."""
    return [
        replace(task, segment=k, camera_indices=tuple(own), images=tuple(range(len(own))))
        for k, own in enumerate(cameras)
    ]


def chosen_of(cameras: Sequence[Sequence[int]], task: MappingTask) -> list[int]:
    return [one.segment for one in choose_calibration_segments(windows_of(cameras, task))]


def test_calibration_segments_are_the_first_windows_that_share_no_images(segment: SyntheticSegment) -> None:
    task = segment.task
    assert chosen_of([[0] * 60] * 9, task) == [0, 2, 4]
    assert chosen_of([[0] * 60] * 30, task) == [0, 2, 4]
    assert chosen_of([[0] * 20] * 40, task) == [0, 2, 4, 6, 8, 10, 12, 14]  # 150 images
    assert chosen_of([[0] * 60] * 4, task) == [0, 2, 1]
    assert chosen_of([[0] * 60], task) == [0]


def test_every_camera_has_calibration_segments_of_its_own(segment: SyntheticSegment) -> None:
    task = segment.task
    two = [[0] * 60] * 8 + [[1] * 60] * 8
    assert sorted(chosen_of(two, task)) == [0, 2, 4, 8, 10, 12]
    # All windows of a camera of one window only, and of one that is rare in all of them, are chosen.
    assert sorted(chosen_of([[0] * 60] * 8 + [[1] * 60] + [[0] * 60], task)) == [0, 2, 4, 8]
    assert len(chosen_of([[0] * 55 + [1] * 5] * 9, task)) == 9


def with_focal(focal: float) -> MappedModel:
    return replace(model_of_walk(6), intrinsics=(replace(START, params=(focal, 320.0, 240.0, 0.01)),) * 6)


def test_one_diverged_segment_does_not_move_the_agreed_camera() -> None:
    segments = [segment_of(k, with_focal(focal)) for k, focal in enumerate([520.0, 525.0, 853.0, 528.0, 526.0])]
    agreed = agree_on_cameras(segments, [0] * 6, [START])
    assert agreed[0].params[0] == pytest.approx(526.0, abs=2.0)
    assert agreed[0].params[3] == pytest.approx(0.01)


def test_one_diverged_segment_of_three_does_not_change_the_agreed_camera() -> None:
    segments = [segment_of(k, with_focal(focal)) for k, focal in enumerate([494.0, 515.0, 1186.0])]
    assert 494 <= agree_on_cameras(segments, [0] * 6, [START])[0].params[0] <= 515
    apart = [segment_of(k, with_focal(focal)) for k, focal in enumerate([400.0, 900.0])]
    assert 400 < agree_on_cameras(apart, [0] * 6, [START])[0].params[0] < 900


@pytest.mark.parametrize(
    ("focal", "agree"),
    [
        ([315.6, 315.9, 316.4], True),
        ([515.0, 517.0, 1186.0], True),  # one that diverged among others that agree
        ([494.0, 515.0, 1186.0], False),
        ([500.0, 560.0], False),
        ([500.0], False),
        ([], False),
    ],
)
def test_cameras_are_used_where_the_calibration_segments_agree(focal: list[float], agree: bool) -> None:
    segments = [segment_of(k, with_focal(one)) for k, one in enumerate(focal)]
    assert focal_lengths_agree({0}, segments, [0] * 6) is agree
    assert focal_lengths_agree((), segments, [0] * 6)
    assert not focal_lengths_agree({0, 1}, segments, [0] * 6)


def test_segments_with_a_much_larger_error_than_the_calibration_segments_are_found() -> None:
    def with_error(number: int, error_px: float) -> MappedSegment:
        return segment_of(number, replace(with_focal(500.0), reprojection_error_px=error_px))

    calibration = [with_error(0, 0.53), with_error(2, 0.66), with_error(4, 0.71)]
    nothing = replace(calibration[0], segment=9, models=())
    assert find_worse_fits([with_error(1, 0.86), with_error(3, 1.03), with_error(5, np.nan), nothing], calibration) == [
        3,
        5,
    ]
    assert find_worse_fits([with_error(1, 9.0)], [nothing]) == []
    assert self_calibration_is_better(with_error(3, 0.64), with_error(3, 1.03))
    assert not self_calibration_is_better(with_error(3, 0.9), with_error(3, 1.03))
    assert not self_calibration_is_better(nothing, with_error(3, 1.03))
    smaller = replace(calibration[0], models=(restrict_model(calibration[0].models[0], range(4)),))
    assert not self_calibration_is_better(smaller, with_error(3, 1.03))


def test_a_camera_of_one_model_only_is_not_agreed_on() -> None:
    alone = [segment_of(0, model_of_walk(6))]
    assert agree_on_cameras(alone, [0] * 6, [CAMERA]) == {}
    assert agree_on_cameras(alone, [0] * 6, [CAMERA], min_models=1) == {0: CAMERA}


def test_adjusting_to_the_agreed_camera_fixes_it_exactly(segment: SyntheticSegment, mapped: MappedSegment) -> None:
    task = segment.task
    agreed = {0: replace(task.cameras[0], params=(1280.0, 512.0, 384.0, 0.05))}
    calibrated = calibrate_segment(CalibrationTask(mapping=task, mapped=mapped, agreed=agreed))
    (model,) = calibrated.models
    assert model.intrinsics[0].params == (1280.0, 512.0, 384.0, 0.05)
    assert segment.centre_error(model) < 1e-4
    assert "adjusted to the agreed camera" in calibrated.attempts[-1]


def test_a_model_that_the_agreed_camera_does_not_fit_keeps_its_own(
    segment: SyntheticSegment, mapped: MappedSegment
) -> None:
    task = segment.task
    agreed = {0: replace(task.cameras[0], params=(1180.0, 512.0, 384.0, -0.2))}
    calibrated = calibrate_segment(CalibrationTask(mapping=task, mapped=mapped, agreed=agreed))
    (model,) = calibrated.models
    assert model.intrinsics[0].params[0] == pytest.approx(1280.0, rel=1e-3)
    assert segment.centre_error(model) < 1e-3
    assert "keep their own focal length" in calibrated.attempts[-1]


def test_mapping_again_loses_no_model_that_had_not_diverged(segment: SyntheticSegment, mapped: MappedSegment) -> None:
    (whole,) = mapped.models
    good = restrict_model(whole, range(4))
    diverged = restrict_model(whole, range(4, 8))
    focal = (replace(whole.intrinsics[0], params=(2000.0, 512.0, 384.0, 0.05)),) * 4
    found = segment_of(0, good, replace(diverged, intrinsics=focal))
    task = CalibrationTask(mapping=segment.task, mapped=found, agreed={0: whole.intrinsics[0]})
    calibrated = calibrate_segment(task, map_again=lambda _: replace(found, models=(), attempts=("in vain",)))
    assert [model.images for model in calibrated.models] == [(0, 1, 2, 3)]
    assert [left.image for left in calibrated.unregistered] == [4, 5, 6, 7]
    assert "in vain" in calibrated.attempts
