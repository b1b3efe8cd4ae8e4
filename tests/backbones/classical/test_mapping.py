"""Poses of a segment by COLMAP's mappers, on data that pycolmap synthesises."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers.mapped_segments import NUM_IMAGES, SyntheticSegment, synthetic_segment, without_pairs

from smust3r_colmap.backbones.classical.mapped_model import restrict_model
from smust3r_colmap.backbones.classical.mapping import (
    MAPPED_SEGMENT,
    MappedSegment,
    SegmentMapper,
    choose_models,
    map_segment,
)
from smust3r_colmap.backbones.classical.strategies import MapperOutput, MappingStrategy, run_strategy


@pytest.fixture(scope="module")
def segment(tmp_path_factory: pytest.TempPathFactory) -> SyntheticSegment:
    return synthetic_segment(tmp_path_factory.mktemp("synthetic"))


@pytest.fixture(scope="module")
def mapped(segment: SyntheticSegment) -> MappedSegment:
    return map_segment(segment.task)


def test_a_segment_is_mapped_to_rounding_without_noise(segment: SyntheticSegment, mapped: MappedSegment) -> None:
    (model,) = mapped.models
    assert model.images == tuple(range(NUM_IMAGES))
    assert not mapped.unregistered
    assert segment.centre_error(model) < 1e-3
    assert model.intrinsics[0].params == pytest.approx((1280.0, 512.0, 384.0, 0.05), rel=1e-3, abs=1e-3)


def test_known_cameras_stay_as_they_are_and_become_no_prior(segment: SyntheticSegment) -> None:
    task = segment.task
    known = replace(task.cameras[0], params=(1280.0, 512.0, 384.0, 0.05))
    (model,) = map_segment(replace(task, known_cameras={0: known})).models
    assert set(model.intrinsics) == {known}
    assert segment.centre_error(model) < 1e-4


def test_mapping_twice_gives_the_same_bits(segment: SyntheticSegment, mapped: MappedSegment) -> None:
    again = map_segment(segment.task)
    np.testing.assert_array_equal(mapped.models[0].seg_from_cam, again.models[0].seg_from_cam)
    np.testing.assert_array_equal(mapped.models[0].tracks.points_seg, again.models[0].tracks.points_seg)


def test_images_without_matches_are_left_out_with_the_reason(segment: SyntheticSegment) -> None:
    mapped = map_segment(without_pairs(segment.task, *(pair for pair in segment.task.pairs if 7 in pair)))
    assert [left.image for left in mapped.unregistered] == [7]
    assert mapped.unregistered[0].reason == "no verified matches to any image of its segment"


def test_a_segment_without_matches_gives_nothing_and_says_so(segment: SyntheticSegment) -> None:
    mapped = map_segment(replace(segment.task, pairs=()))
    assert mapped.models == ()
    assert mapped.attempts == ("no pair of images has 15 verified matches",)
    assert len(mapped.unregistered) == NUM_IMAGES


def test_mapped_segments_come_back_from_disk(mapped: MappedSegment, tmp_path: Path) -> None:
    MAPPED_SEGMENT.write(tmp_path, mapped)
    back = MAPPED_SEGMENT.read(tmp_path)
    assert (back.segment, back.attempts, back.unregistered) == (0, mapped.attempts, ())
    assert back.models[0].intrinsics == mapped.models[0].intrinsics
    np.testing.assert_array_equal(back.models[0].seg_from_cam, mapped.models[0].seg_from_cam)
    np.testing.assert_array_equal(
        back.models[0].tracks.feature_of_observation, mapped.models[0].tracks.feature_of_observation
    )


def test_the_next_start_pair_is_tried_where_one_gives_no_model(segment: SyntheticSegment, tmp_path: Path) -> None:
    task = without_pairs(segment.task, (0, 1))
    mapper = SegmentMapper(task, tmp_path)
    strategy = mapper.strategies()[0]
    without_matches, good = strategy.options[0], strategy.options[-1]
    assert isinstance(without_matches, pycolmap.IncrementalPipelineOptions)
    without_matches.init_image_id1, without_matches.init_image_id2 = 1, 2
    attempt = mapper.attempt(replace(strategy, options=(without_matches, good)))
    assert attempt.notes == ("incremental: 8 of 8 images",)


def test_a_relaxed_start_follows_where_no_start_pair_gives_a_model(segment: SyntheticSegment, tmp_path: Path) -> None:
    mapper = SegmentMapper(segment.task, tmp_path)
    first, *others = mapper.strategies()
    attempts = mapper.run_until_good([replace(first, options=()), *others])
    assert [note for attempt in attempts for note in attempt.notes] == [
        "incremental: 0 of 8 images",
        "incremental, relaxed start: 8 of 8 images",
    ]


def part_of(model: pycolmap.Reconstruction, images: range) -> pycolmap.Reconstruction:
    part = pycolmap.Reconstruction(model)
    for image_id in model.reg_image_ids():
        if image_id - 1 not in images:
            part.deregister_frame(model.image(image_id).frame_id)
    return part


@pytest.mark.parametrize(("links", "last"), [(2, "incremental, continued relaxed"), (3, "global")])
def test_further_strategies_are_run_only_where_enough_pairs_link_the_halves(
    links: int, last: str, segment: SyntheticSegment
) -> None:
    """Both halves are placed, as two models: with a pair or two between them no mapper joins them."""

    def in_halves(strategy: MappingStrategy, output: Path, start: Path | None) -> MapperOutput:
        found = run_strategy(strategy, output, start)
        whole = max(found.models.values(), key=lambda model: model.num_reg_images())
        halves = [range(4)] if strategy.name == "incremental" else [range(4), range(4, 8)]
        return replace(found, models={k: part_of(whole, half) for k, half in enumerate(halves)})

    across = [pair for pair in segment.task.pairs if pair[0] < 4 <= pair[1]]
    mapped = map_segment(without_pairs(segment.task, *across[links:]), run=in_halves)
    assert [len(model.images) for model in mapped.models] == [4, 4]
    assert mapped.attempts[0] == "incremental: 4 of 8 images"
    assert mapped.attempts[-1] == f"{last}: 4 + 4 of 8 images"


def test_a_strategy_without_a_model_to_continue_is_left_out(segment: SyntheticSegment, tmp_path: Path) -> None:
    mapper = SegmentMapper(segment.task, tmp_path)
    first, continued, *_ = mapper.strategies()
    attempts = mapper.run_until_good([replace(first, options=()), continued])
    assert [attempt.model_folder for attempt in attempts] == [None]


def test_larger_models_are_chosen_and_bridges_between_them(mapped: MappedSegment) -> None:
    (whole,) = mapped.models
    strict = [restrict_model(whole, range(4))]
    permissive = [restrict_model(whole, part) for part in (range(4), range(4, 8))]
    assert choose_models([]) == ()
    assert [model.images for model in choose_models([strict, permissive])] == [(0, 1, 2, 3), (4, 5, 6, 7)]
    assert [len(model.images) for model in choose_models([permissive, [whole]])] == [8, 4, 4]
    assert choose_models([[whole], strict]) == (whole,)
