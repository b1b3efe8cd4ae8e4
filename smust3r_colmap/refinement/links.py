"""How firmly the tracks hold one side of a model to the other, for every cut between consecutive images.

Both sides are taken as rigid. A point that both see is then known twice, by the rays of either side, and the relative
similarity of the sides is that between two clouds with the covariances of these points. So a cut through images that
turn on the spot shows how few points carry the scale. The next module to read is ``contradictions``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from smust3r_colmap.geometry.arrays import FloatArray, IntArray
from smust3r_colmap.refinement.linearised_model import LinearisedModel, similarity_generators

MIN_SIDE = 3
"""Images of a side: two have no shape that a scale could spoil."""
FIRM_POINTS = 1000
"""Cuts that more points cross are judged by an even part of them."""


@dataclass(frozen=True, kw_only=True)
class Link:
    """What holds the images up to ``before`` and those from ``after`` on together.

    Args:
        before, after: consecutive images by row. num_smaller: images of the smaller side.
        num_points: tracks that cross the cut.
        num_scale_points: effective number of points that carry the scale, sum squared over sum of squares of their
            information.
        scale_sigma: of the relative log-scale. rotation_sigma_rad, translation_sigma: likewise, about the cut; the
            translation in extents.
        side_sigma: root mean square uncertainty of the smaller side's centres relative to the other side, in extents.
    """

    before: int
    after: int
    num_smaller: int
    num_points: int
    num_scale_points: float
    scale_sigma: float
    rotation_sigma_rad: float
    translation_sigma: float
    side_sigma: float


def links(linear: LinearisedModel) -> tuple[Link, ...]:
    """One per cut with at least ``MIN_SIDE`` images on both sides, in order."""
    n, num_points = len(linear), len(linear.points)
    ends = np.searchsorted(linear.image_of, np.arange(n + 1))
    by_point = linear.by_point * np.sqrt(linear.weights)[:, None, None] / linear.noise_px
    information = by_point.transpose(0, 2, 1) @ by_point
    below, above = np.zeros((num_points, 3, 3)), np.zeros((num_points, 3, 3))
    np.add.at(above, linear.point_of, information)
    num_below, num_above = np.zeros(num_points, np.int64), np.bincount(linear.point_of, minlength=num_points)
    found = []
    for before in range(n - 1):
        of_image = slice(ends[before], ends[before + 1])
        rows = linear.point_of[of_image]
        below[rows] += information[of_image]
        above[rows] -= information[of_image]
        num_below[rows] += 1
        num_above[rows] -= 1
        if min(before + 1, n - before - 1) >= MIN_SIDE:
            crossing = np.flatnonzero((num_below > 0) & (num_above > 0))
            found.append(_link(linear, before, crossing, below, above))
    return tuple(found)


def _link(linear: LinearisedModel, before: int, crossing: IntArray, below: FloatArray, above: FloatArray) -> Link:
    step = -(-len(crossing) // FIRM_POINTS) if len(crossing) else 1
    chosen = crossing[::step]
    left, right = below[chosen], above[chosen]
    # (A^-1 + B^-1)^-1 = A (A + B)^-1 B also where a side sees the point along one ray only
    total = left + right
    total = total + 1e-9 * np.trace(total, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    both = left @ np.linalg.solve(total, right)
    origin = linear.centres[before : before + 2].mean(axis=0)
    generators = similarity_generators(linear.points[chosen], origin)[:, :3]
    per_point = generators.transpose(0, 2, 1) @ ((both + both.transpose(0, 2, 1)) / 2) @ generators * step
    covariance = np.linalg.inv(per_point.sum(axis=0) + np.eye(7))
    along = covariance[:, 6] / covariance[6, 6]
    shares = np.einsum("i,pij,j->p", along, per_point, along)
    side = linear.centres[: before + 1] if 2 * (before + 1) <= len(linear) else linear.centres[before + 1 :]
    moves = similarity_generators(side, origin)[:, :3]
    return Link(
        before=before,
        after=before + 1,
        num_smaller=len(side),
        num_points=len(crossing),
        num_scale_points=float(step * shares.sum() ** 2 / max((shares**2).sum(), 1e-300)),
        scale_sigma=float(np.sqrt(covariance[6, 6])),
        rotation_sigma_rad=float(np.sqrt(np.trace(covariance[3:6, 3:6]))),
        translation_sigma=float(np.sqrt(np.trace(covariance[:3, :3]))),
        side_sigma=float(np.sqrt(np.einsum("nki,ij,nkj->", moves, covariance, moves) / len(side))),
    )
