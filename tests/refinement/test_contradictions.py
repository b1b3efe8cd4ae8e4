"""Matches that contradict a model: a scaled part is found by its points, and the inflation follows its rule."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from helpers.tracked_scenes import arc, ball, make_world, model_with_true_tracks, pairs_within, true_matches

from smust3r_colmap.features.guided_verification import MIN_MATCHES, MatchedFeatures
from smust3r_colmap.refinement.contradictions import contradiction_inflation, point_support
from smust3r_colmap.refinement.misregistration import EpipolarSupport

NUM_IMAGES = 12


def model_and_features() -> tuple[pycolmap.Reconstruction, MatchedFeatures]:
    rng = np.random.default_rng(4)
    world = make_world(arc(NUM_IMAGES), ball(250, rng), rng)
    matches = {pair: true_matches(world, pair) for pair in pairs_within(range(NUM_IMAGES), 4)}
    features = MatchedFeatures(keypoints=dict(enumerate(world.keypoints)), raw=matches, verified=matches)
    return model_with_true_tracks(world, world.cam_from_world, rng, noise=0), features


def test_all_matches_agree_with_a_true_model() -> None:
    model, features = model_and_features()
    support = point_support(model, features)
    assert support.keys() == features.verified.keys()
    assert min(one.inlier_fraction for one in support.values()) == 1
    assert (contradiction_inflation([support], range(NUM_IMAGES)) == 1).all()


def test_a_part_at_another_scale_is_contradicted_by_points() -> None:
    model, features = model_and_features()
    part = set(range(NUM_IMAGES // 2 + 1, NUM_IMAGES + 1))
    about = model.image(NUM_IMAGES // 2).projection_center()
    grown = pycolmap.Sim3d(1.1, pycolmap.Rotation3d(np.eye(3)), about - 1.1 * about)
    for image_id in part:
        image = model.image(image_id)
        model.frame(image.frame_id).rig_from_world = grown.transform_camera_world(image.cam_from_world())
    for point in model.points3D.values():
        if sum(element.image_id in part for element in point.track.elements) * 2 > point.track.length():
            point.xyz = grown * point.xyz
    support = point_support(model, features)
    across = [one.inlier_fraction for (i, j), one in support.items() if i + 1 not in part and j + 1 in part]
    assert max(across) < 0.9
    assert np.mean(across) < 0.6
    assert np.isinf(contradiction_inflation([support], range(NUM_IMAGES))).any()


def test_matches_without_points_say_nothing() -> None:
    model, features = model_and_features()
    for point_id in sorted(model.point3D_ids())[MIN_MATCHES - 1 :]:
        model.delete_point3D(point_id)
    assert point_support(model, features) == {}


@pytest.mark.parametrize(("num_wrong", "expected"), [(0, 1.0), (1, 5 / 3), (2, 5.0), (3, np.inf)])
def test_inflation_breaks_down_where_half_of_the_evidence_is_wrong(num_wrong: int, expected: float) -> None:
    # image 0 against five others of equal weight, which support one another
    support = {
        (0, j): EpipolarSupport(num_matches=100, inlier_fraction=0.0 if j <= num_wrong else 1.0) for j in range(1, 6)
    }
    support |= {
        (i, j): EpipolarSupport(num_matches=100, inlier_fraction=1.0) for i in range(1, 6) for j in range(i + 1, 6)
    }
    assert contradiction_inflation([support], range(6))[0] == pytest.approx(expected)


def test_of_two_kinds_of_support_the_worse_counts() -> None:
    good = {(0, 1): EpipolarSupport(num_matches=100, inlier_fraction=1.0)}
    bad = {(0, 1): EpipolarSupport(num_matches=100, inlier_fraction=0.0)}
    assert np.isinf(contradiction_inflation([good, bad], range(2))).all()
    assert (contradiction_inflation([good], range(2)) == 1).all()
    assert (contradiction_inflation([], range(2)) == 1).all()
