"""Accuracy, completeness and F-score of a point cloud against a reference cloud, in one world.

The next module to read is ``depth_error``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from smust3r_colmap.evaluation.absolute_error import Statistics
from smust3r_colmap.geometry.arrays import FloatArray


@dataclass(frozen=True, kw_only=True)
class CloudShares:
    """At one threshold, in percent.

    Args:
        threshold: in the unit of the clouds.
        accuracy: points of the estimate that have a point of the reference within the threshold.
        completeness: points of the reference that have a point of the estimate within it.
    """

    threshold: float
    accuracy: float
    completeness: float

    @property
    def f_score(self) -> float:
        """The harmonic mean of the two; 0 where both are."""
        total = self.accuracy + self.completeness
        return 2 * self.accuracy * self.completeness / total if total else 0.0


@dataclass(frozen=True, kw_only=True)
class CloudErrors:
    """Distances to the nearest point of the other cloud, and shares below thresholds.

    Args:
        to_reference: of the points of the estimate (7-Scenes tables call its mean or rmse accuracy).
        from_reference: of the points of the reference (completion).
    """

    to_reference: Statistics
    from_reference: Statistics
    shares: tuple[CloudShares, ...]

    @property
    def chamfer(self) -> float:
        """Half the sum of the two mean distances."""
        return (self.to_reference.mean + self.from_reference.mean) / 2


def cloud_errors(estimated: FloatArray, reference: FloatArray, thresholds: Sequence[float]) -> CloudErrors:
    """Of points (N, 3) and (M, 3), at least one each.

    Source: Schöps et al. 2017 (ETH3D) and Knapitsch et al. 2017 (Tanks and Temples), without their voxels and masks:
    each point counts as one, so that clouds of uneven density should be thinned before.
    """
    to_reference, from_reference = KDTree(reference).query(estimated)[0], KDTree(estimated).query(reference)[0]
    return CloudErrors(
        to_reference=Statistics.of(to_reference),
        from_reference=Statistics.of(from_reference),
        shares=tuple(
            CloudShares(
                threshold=threshold,
                accuracy=float(100 * np.mean(to_reference <= threshold)),
                completeness=float(100 * np.mean(from_reference <= threshold)),
            )
            for threshold in thresholds
        ),
    )
