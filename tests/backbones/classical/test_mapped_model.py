"""Mapped models: parts of them, and groups that share images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from helpers.mapped_segments import model_of_walk

from smust3r_colmap.backbones.classical.mapped_model import connected_groups, restrict_model
from smust3r_colmap.products import Tracks


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


def test_models_that_share_four_images_are_one_group() -> None:
    whole = model_of_walk(12)
    parts = [restrict_model(whole, list(range(a, b))) for a, b in ((0, 6), (2, 8), (7, 12))]
    groups = connected_groups(parts)
    assert sorted(sorted(model.images[0] for model in group) for group in groups) == [[0, 2], [7]]
    assert len(connected_groups([*parts, restrict_model(whole, list(range(4, 11)))])) == 1
