"""Tags of points, triangulated from the poses of the model, and which of them are wrong.

A wrong tag is found by leaving each out: the others then agree with each other, and it lies far from where they put
it. Where more than one tag can be the wrong one, all answers are kept, and the coordinates of the point decide. The
next module to read is ``control``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
import pycolmap

from smust3r_colmap.estimators.robust import MAD_TO_SIGMA
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.geometry.triangulation import triangulation_angle_deg

MIN_ANGLE_DEG = 1.0
"""Largest angle between the rays of a point below which its depth is not known."""
LIMIT_SIGMAS = 6.0
"""Of reprojection errors, by their median; a tag further off is wrong."""
MIN_LIMIT = 0.003
"""Of the longer image side, so that a set of exact tags has a limit: 4 pixels of 1280. (Chosen on copr_gcp, whose right
tags are 0.4 pixels off and whose wrong one is a few hundred.)"""
SAME_PIXEL = 0.0016
"""Of the longer image side: two points tagged this near to each other are one. (2 pixels of 1280.)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """A tag with the camera that it was made in.

    Args:
        image: its name. xy: (2,) pixels. camera: of the image. cam_from_model: (3, 4).
    """

    image: str
    xy: FloatArray
    camera: Intrinsics
    cam_from_model: FloatArray

    @property
    def longer_side(self) -> int:
        """In pixels."""
        return max(self.camera.width, self.camera.height)


@dataclass(frozen=True, kw_only=True, eq=False)
class Triangulated:
    """A point from its tags.

    Args:
        point_model: (3,). errors_px: (n,) reprojection error of every tag, also of those left out; infinite behind a
            camera. left_out: tags that do not count, by row, with the reason.
    """

    point_model: FloatArray
    errors_px: FloatArray
    left_out: Mapping[int, str] = field(default_factory=dict)

    @property
    def worst_px(self) -> float:
        """Largest error of a tag that counts."""
        return float(max(error for k, error in enumerate(self.errors_px) if k not in self.left_out))


def triangulate(views: Sequence[View], left_out: Mapping[int, str] | None = None) -> Triangulated | None:
    """The point that tags show; None where fewer than two count, or their rays are nearly parallel."""
    left_out = left_out or {}
    counted = [view for k, view in enumerate(views) if k not in left_out]
    if len(counted) < 2:
        return None
    rays = np.vstack([view.camera.rays_cam(view.xy[None]) for view in counted])
    if not np.isfinite(rays).all():
        return None
    poses = [view.cam_from_model for view in counted]
    point = pycolmap.triangulate_multi_view_point(poses, rays / np.linalg.norm(rays, axis=1)[:, None])
    if point is None:
        return None
    point = np.asarray(point, np.float64).reshape(3)
    if triangulation_angle_deg(point, invert_rigid(np.stack(poses))[:, :, 3]) < MIN_ANGLE_DEG:
        return None
    return Triangulated(point_model=point, errors_px=reprojection_errors(point, views), left_out=left_out)


def reprojection_errors(point_model: FloatArray, views: Sequence[View]) -> FloatArray:
    """(n,) pixels between tags and where a point (3,) is seen; infinite behind a camera."""
    errors = []
    for view in views:
        in_camera = view.cam_from_model[:, :3] @ point_model + view.cam_from_model[:, 3]
        errors.append(float(np.linalg.norm(view.camera.xy_img(in_camera[None])[0] - view.xy)))
    return np.asarray(np.nan_to_num(np.array(errors), nan=np.inf), np.float64)


def tag_limit_px(triangulated: Sequence[Triangulated], longer_side: int) -> float:
    """The reprojection error that no right tag has, by those of all points."""
    errors = np.concatenate([one.errors_px for one in triangulated]) if triangulated else np.zeros(0)
    finite = errors[np.isfinite(errors)]
    spread = MAD_TO_SIGMA * float(np.median(finite)) if len(finite) else 0.0
    return max(LIMIT_SIGMAS * spread, MIN_LIMIT * longer_side)


def without_wrong_tags(views: Sequence[View], limit_px: float) -> list[Triangulated]:
    """The point without the tags that contradict the others: one answer, none, or several that are as good.

    Tags are left out one by one, always so that the rest agrees best, until all errors are within the limit.
    """
    whole = triangulate(views)
    if whole is not None and whole.worst_px <= limit_px:
        return [whole]
    left_out: dict[int, str] = {}
    while len(views) - len(left_out) > 2:
        tried = {k: triangulate(views, {**left_out, k: ""}) for k in range(len(views)) if k not in left_out}
        found = {k: one for k, one in tried.items() if one is not None}
        good = [_named(one, views) for one in found.values() if one.worst_px <= limit_px]
        if good:
            return sorted(good, key=lambda one: one.worst_px)
        if not found:
            return []
        left_out[min(found, key=lambda k: found[k].worst_px)] = ""
    return []


def _named(one: Triangulated, views: Sequence[View]) -> Triangulated:
    others = len(views) - len(one.left_out)
    reasons = {k: f"{one.errors_px[k]:.0f} px from where its {others} other tags put it" for k in one.left_out}
    return Triangulated(point_model=one.point_model, errors_px=one.errors_px, left_out=reasons)


def tags_on_one_pixel(tagged: Mapping[str, Sequence[View]]) -> list[tuple[str, str, str]]:
    """Image and two labels, for points of different labels that are tagged at the same place.

    Args:
        tagged: views by label.
    """
    by_image: dict[str, list[tuple[str, View]]] = {}
    for label, views in tagged.items():
        for view in views:
            by_image.setdefault(view.image, []).append((label, view))
    return [
        (image, label, other)
        for image, in_it in by_image.items()
        for (label, view), (other, second) in combinations(in_it, 2)
        if other != label and np.linalg.norm(second.xy - view.xy) <= SAME_PIXEL * view.longer_side
    ]
