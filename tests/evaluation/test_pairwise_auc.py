from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smust3r_colmap.evaluation.pairwise_auc import auc_colmap, auc_vggt
from smust3r_colmap.geometry.arrays import FloatArray

CENTRES = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])


def poses(centres: FloatArray = CENTRES, turns_deg: tuple[float, ...] = (0, 0, 0)) -> FloatArray:
    """Turned about z."""
    rotations = Rotation.from_rotvec(np.deg2rad(turns_deg)[:, None] * [0.0, 0, 1]).as_matrix()
    return np.concatenate([rotations[: len(centres)], centres[:, :, None]], axis=2)


def test_a_perfect_estimate_has_100_percent() -> None:
    assert auc_colmap([(poses(), poses(), 0)], 3, 6, (1, 3, 5)) == pytest.approx((100, 100, 100))
    assert auc_vggt(poses(), poses(), (1, 3, 30)) == pytest.approx((100, 100, 100))


def test_one_camera_turned_by_two_degrees() -> None:
    """Of three images one is turned: the 4 ordered pairs with it have 2 deg, the 2 others 0.

    COLMAP: the recall rises from 0 to 1/3 at 0 and to 1 at 2 deg along a line through its steps. From the second pair
    at 0 to the third at 2 deg it goes from 1/3 to 1/2; then upright to 1. Up to 4 deg the area is
    2 * (1/3 + 1/2) / 2 + 2 * 1 = 17/6, over 4 deg. Up to 1 deg no more than 1/3 is found.
    VGGT: of 3 unordered pairs 1 has 0 and 2 have 2 deg, which is in the bin from 2 to 3; where the last bin ends at 2,
    it is in that.
    """
    # A hair below 2 degrees, so that rounding cannot move it over the edge of a bin.
    turned = poses(turns_deg=(0, 0, 2 - 1e-9))
    models = [(turned, poses(), 0)]
    assert auc_colmap(models, 3, 6, (1, 4)) == pytest.approx((100 / 3, 100 * 17 / 24), abs=1e-5)
    assert auc_vggt(turned, poses(), (1, 3)) == pytest.approx((100 / 3, 100 * (1 / 3 + 1 + 1) / 3))


def test_the_direction_is_seen_from_each_camera() -> None:
    """Turned by 2 degrees, camera 2 sees the others 2 degrees aside; the others see it where it is.

    So the direction alone would give 2 of 6 ordered pairs an error; the rotation gives it to all 4 with camera 2.
    A centre that is off by 45 degrees, seen from camera 0, is off for all pairs with it.
    """
    moved = poses(np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]]))
    found = auc_colmap([(moved, poses(), 0)], 3, 6, (10,))
    assert found == pytest.approx((100 / 3,))


def test_opposite_directions_are_equal_for_vggt_only() -> None:
    backwards = poses(-CENTRES)
    assert auc_vggt(backwards, poses(), (1,)) == pytest.approx((100,))
    assert auc_colmap([(backwards, poses(), 0)], 3, 6, (5,)) == pytest.approx((0,))


def test_short_baselines_have_no_direction() -> None:
    """Centres 1 mm apart; the direction between them is 90 degrees off."""
    reference = poses(np.array([[0.0, 0, 0], [0.001, 0, 0], [0, 1, 0]]))
    estimate = poses(np.array([[0.0, 0, 0], [0, 0, 0.001], [0, 1, 0]]))
    thresholds = (5,)
    assert auc_colmap([(estimate, reference, 0)], 3, 6, thresholds)[0] < 100 * 4 / 6
    assert auc_colmap([(estimate, reference, 0)], 3, 6, thresholds, accuracy=0.002)[0] > 98


def test_the_recall_is_flat_up_to_the_accuracy() -> None:
    """6 pairs, errors 0, 0 and 4 times 2: flat at 1/3 up to 0.5, then a line to 1/2 at 2 and upright to 1."""
    turned = poses(turns_deg=(0, 0, 2))
    (found,) = auc_colmap([(turned, poses(), 0)], 3, 6, (4,), accuracy=0.5)
    assert found == pytest.approx(100 * (0.5 / 3 + 1.5 * (1 / 3 + 1 / 2) / 2 + 2) / 4, abs=1e-5)


def test_below_the_accuracy_the_recall_is_that_of_all_errors_up_to_it() -> None:
    """2 of 6 pairs are right, 4 are 2 deg off; with an accuracy of 2.5 all of them count as right."""
    models = [(poses(turns_deg=(0, 0, 2)), poses(), 0)]
    assert auc_colmap(models, 3, 6, (1,), accuracy=1.5) == pytest.approx((100 / 3,))
    assert auc_colmap(models, 3, 6, (1,), accuracy=2.5) == pytest.approx((100,))


def test_images_without_a_pose_and_unknown_ones_are_wrong() -> None:
    """Three of four images of the reference, and one that it lacks.

    12 ordered pairs of the reference, of which 6 are right; the unknown image makes 6 more. 6 of 18 are right.
    """
    (found,) = auc_colmap([(poses(), poses(), 1)], 4, 6, (5,))
    assert found == pytest.approx(100 * 6 / 18)


def test_an_image_in_two_models_counts_in_both() -> None:
    """Images 0, 1 and 1, 2 of three: 2 + 2 ordered pairs are right, and the 2 between 0 and 2 are missing."""
    first, second = poses()[:2], poses()[1:]
    (found,) = auc_colmap([(first, first, 0), (second, second, 0)], 3, 4, (5,))
    assert found == pytest.approx(100 * 4 / 6)
