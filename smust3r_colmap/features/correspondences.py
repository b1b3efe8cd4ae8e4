"""Keypoints and matches between images, the input of triangulation.

Sources are ``guided_verification`` (SIFT of the run's database) and ``pointmap_matching`` (no features).
The next module to read is ``covisibility``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from smust3r_colmap.geometry.arrays import Pair


@dataclass(frozen=True, kw_only=True, eq=False)
class Correspondences:
    """Keypoints of images and matches between them.

    Args:
        keypoints: by image index into the collection, (K, 2) float32 in pixels of the original image, the
            centre of the first pixel at (0.5, 0.5).
        matches: by pair (i, j) of image indices with i < j, (M, 2) uint32 rows of the two images' keypoints.

    Raises:
        ValueError: a pair is not ascending, or names an image or a keypoint that is not there.
    """

    keypoints: Mapping[int, npt.NDArray[np.float32]]
    matches: Mapping[Pair, npt.NDArray[np.uint32]]

    def __post_init__(self) -> None:
        for image, points in self.keypoints.items():
            if points.ndim != 2 or points.shape[1] != 2:
                raise ValueError(f"Correspondences: keypoints of image {image} are {points.shape}, needed (K, 2)")
        for (i, j), rows in self.matches.items():
            if not i < j or i not in self.keypoints or j not in self.keypoints:
                raise ValueError(f"Correspondences: pair ({i}, {j}) is not ascending or names an unknown image")
            if rows.ndim != 2 or rows.shape[1] != 2:
                raise ValueError(f"Correspondences: matches of pair ({i}, {j}) are {rows.shape}, needed (M, 2)")
            if len(rows) and (rows.max(axis=0) >= (len(self.keypoints[i]), len(self.keypoints[j]))).any():
                raise ValueError(f"Correspondences: pair ({i}, {j}) names a keypoint that does not exist")

    @property
    def num_matches(self) -> int:
        """Over all pairs."""
        return sum(len(rows) for rows in self.matches.values())


def joined(first: Correspondences, second: Correspondences) -> Correspondences:
    """Both sources together: the keypoints of ``second`` come after those of ``first`` in every image."""
    images = sorted({*first.keypoints, *second.keypoints})
    none = np.empty((0, 2), np.float32)
    keypoints = {i: np.concatenate([first.keypoints.get(i, none), second.keypoints.get(i, none)]) for i in images}
    matches = dict(first.matches)
    for (i, j), rows in second.matches.items():
        after = np.array([len(first.keypoints.get(i, none)), len(first.keypoints.get(j, none))], np.uint32)
        known = matches.get((i, j), np.empty((0, 2), np.uint32))
        matches[i, j] = np.concatenate([known, rows + after])
    return Correspondences(keypoints=keypoints, matches=matches)
