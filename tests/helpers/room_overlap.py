"""Points of a room that two segments saw from inside, with depth noise and one-sided outliers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from smust3r_colmap.alignment.seen_points import SubmodelFit, align_seen_points
from smust3r_colmap.estimators.robust import RobustKernel, RobustLoss
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.groups import TransformGroup
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.geometry.transform import Transform

ROOM_M = np.array([6.0, 3.0, 4.0])
TURN = Rotation.from_rotvec(np.deg2rad(35) * np.array([0.6, 0.64, 0.48])).as_matrix()
SIMILARITY = Sim3(scale=np.array(1.7), rotation=TURN, translation=np.array([1.0, -2.0, 3.0]))


@dataclass(frozen=True, kw_only=True, eq=False)
class Overlap:
    """Points seen from inside a room by two segments; see `room_overlap`."""

    points_source: FloatArray
    points_target: FloatArray
    depth_source: FloatArray
    depth_target: FloatArray
    exact_source: FloatArray
    exact_target: FloatArray

    @property
    def ones(self) -> FloatArray:
        return np.ones(len(self.points_source))

    def map_cm(self, target_from_source: Transform) -> float:
        """Mean distance of the exact points from where they belong."""
        apart = target_from_source.apply(self.exact_source) - self.exact_target
        return 100 * float(np.linalg.norm(apart, axis=1).mean())

    def aligned(self, group: TransformGroup, kernel: RobustKernel = "cauchy", **changes: Any) -> SubmodelFit:
        arguments: dict[str, Any] = {
            "points_source": self.points_source,
            "points_target": self.points_target,
            "weights": self.ones,
            "depth_source": self.depth_source,
            "depth_target": self.depth_target,
            "loss": RobustLoss(kernel=kernel),
            "group": group,
        }
        return align_seen_points(**(arguments | changes))


def room_overlap(
    source_from_target: Transform,
    *,
    count: int = 4000,
    outliers: float = 0.0,
    noise: float = 0.01,
    seed: int = 0,
    one_wall: bool = False,
) -> Overlap:
    """The target has one-sided outliers, 30 to 100 % too deep; both sides have depth noise."""
    rng = np.random.default_rng(seed)
    centres = ROOM_M / 2 + rng.uniform(-0.5, 0.5, (count, 3)) * [3.0, 0.5, 1.0]
    rays = rng.normal(size=(count, 3))
    if one_wall:
        rays = rng.uniform(-0.5, 0.5, (count, 3)) + np.array([0.0, 0.0, 2.0])
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    reach = (np.where(rays > 0, ROOM_M, 0.0) - centres) / rays
    depth = reach[:, 2] if one_wall else reach.min(axis=1)
    factor = np.where(rng.random(count) < outliers, rng.uniform(1.3, 2.0, count), 1.0)
    depth_target = depth * factor * (1 + noise * rng.standard_normal(count))
    depth_source = depth * (1 + noise * rng.standard_normal(count))
    exact = centres + depth[:, None] * rays
    return Overlap(
        points_source=source_from_target.apply(centres + depth_source[:, None] * rays),
        points_target=centres + depth_target[:, None] * rays,
        depth_source=1.7 * depth_source,
        depth_target=depth_target,
        exact_source=source_from_target.apply(exact),
        exact_target=exact,
    )
