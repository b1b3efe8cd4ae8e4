"""What the verified matches of image pairs say against a model, of which its own residuals know nothing.

Tracks are made of matches that agree with the model, so the residuals of a wrong model may be small. The matches of
two-view verification were found without it. Two questions are asked of those of a pair: whether they satisfy the
epipolar constraint, and whether the points that the features of one image show are where the other image has them.
The second notices a wrong scale, the first also has matches without points. The next module to read is
``model_uncertainty``.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np
import pycolmap

from smust3r_colmap.features.guided_verification import MIN_MATCHES, MatchedFeatures
from smust3r_colmap.geometry.arrays import FloatArray, IntArray, Pair
from smust3r_colmap.refinement.misregistration import EpipolarSupport, find_misregistered

REPROJECTION_FRACTION = 0.008
"""Of the longer image side: twice the tolerance of tracks, because points that few images see are less exact."""


def point_support(model: pycolmap.Reconstruction, features: MatchedFeatures) -> dict[Pair, EpipolarSupport]:
    """How many matches of each pair agree with the points that their features show, by image index.

    A match agrees if the point of each of its features projects to the other feature. Matches without a point, and
    pairs with fewer than ``MIN_MATCHES`` others, are left out.

    Args:
        model: image ids are index + 1, features are numbered as in ``features``.
        features: of the run.
    """
    xyz = {point_id: point.xyz for point_id, point in model.points3D.items()}
    positions = np.array(list(xyz.values())).reshape(-1, 3)
    row_of = {point_id: row for row, point_id in enumerate(xyz)}
    views = {i - 1: _View(model, i, row_of, positions, features) for i in model.reg_image_ids()}
    found = {}
    for (i, j), matches in features.verified.items():
        if i not in views or j not in views:
            continue
        a, b = views[i], views[j]
        features_a, features_b = matches.astype(np.int64).T
        points_a, points_b = a.point_of[features_a], b.point_of[features_b]
        has_point = (points_a >= 0) | (points_b >= 0)
        if has_point.sum() < MIN_MATCHES:
            continue
        errors = np.maximum(b.errors(points_a, features_b), a.errors(points_b, features_a))[has_point]
        found[i, j] = EpipolarSupport(num_matches=len(errors), inlier_fraction=float((errors <= 1).mean()))
    return found


class _View:
    """A camera, with the row of the point that each of its features shows, or -1."""

    def __init__(
        self,
        model: pycolmap.Reconstruction,
        image_id: int,
        row_of: Mapping[int, int],
        positions: FloatArray,
        features: MatchedFeatures,
    ) -> None:
        image = model.image(image_id)
        self.keypoints, self.positions = features.keypoints[image_id - 1], positions
        self.cam_from_world, self.camera = image.cam_from_world(), model.camera(image.camera_id)
        self.point_of: IntArray = np.full(len(self.keypoints), -1)
        observed = [row_of[point.point3D_id] for point in image.get_observation_points2D()]
        self.point_of[image.get_observation_point2D_idxs()] = observed

    def errors(self, points: IntArray, keypoints: IntArray) -> FloatArray:
        """(M,) distance of projected points from features, in tolerances; 0 without a point, infinite behind."""
        errors = np.zeros(len(points))
        there = points >= 0
        if there.any():
            in_camera = np.asarray(self.cam_from_world * self.positions[points[there]])
            projected = np.asarray(self.camera.img_from_cam(in_camera))
            off = np.linalg.norm(projected - self.keypoints[keypoints[there]], axis=1)
            tolerance = REPROJECTION_FRACTION * max(self.camera.width, self.camera.height)
            is_before = (in_camera[:, 2] > 0) & np.isfinite(off)
            errors[there] = np.where(is_before, off / tolerance, np.inf)
        return errors


def contradiction_inflation(supports: Collection[Mapping[Pair, EpipolarSupport]], images: Sequence[int]) -> FloatArray:
    """(N,) by what the standard deviations of the images grow for the pairs that contradict them, at least 1.

    If a part p of the evidence about an image is wrong, it is 1 / (1 - 2 p), and infinite from 1/2 on; also for
    images of groups that contradict the largest group. Of several kinds of support the largest counts.

    Args:
        supports: by pair, of several kinds.
        images: indices of the registered images, ascending.

    Source: the bias of an estimate by the majority grows like this, and breaks down where the wrong evidence is half
    of it; Huber 1981, "Robust statistics", section 1.4.
    """
    largest = np.ones(len(images))
    for factors in _by_kind(supports, images):
        largest = np.maximum(largest, factors)
    return largest


def _by_kind(supports: Collection[Mapping[Pair, EpipolarSupport]], images: Sequence[int]) -> Iterator[FloatArray]:
    row_of = {image: row for row, image in enumerate(images)}
    for support in supports:
        weights = np.zeros((2, len(images)))
        for (i, j), found in support.items():
            weights[int(found.weight < 0), [row_of[i], row_of[j]]] += abs(found.weight)
        supporting, contradicting = weights
        part = contradicting / np.maximum(supporting + contradicting, 1)
        factors = np.where(part < 0.5, 1 / np.maximum(1 - 2 * part, 1e-12), np.inf)
        if len(images):
            factors[[row_of[i] for i in find_misregistered(support, images)]] = np.inf
        yield factors
