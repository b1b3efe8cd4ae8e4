"""Which images of a submodel see the same surface from far enough apart, and how far away it is.

The plane sweep needs for every reference a few neighbours and a range of depths; both follow from
the sparse points. Pinhole cameras only: images are undistorted before. The next module to read is
``plane_sweep``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from smust3r_colmap.geometry.arrays import FloatArray

BEST_PARALLAX_DEG = 4.0
"""Smaller is imprecise, larger is occluded and slanted. Measured on an indoor sequence: 3 to 5 degrees
are alike, 10 degrees lose a tenth of the correct pixels."""
MIN_PARALLAX_DEG = 0.5
"""Below, a tenth of a pixel is about 4 % of the depth at 384 pixels: worse than no depth."""
MIN_OVERLAP_SHARE = 0.1
"""Share of a reference's points that a neighbour must contain."""
_SPREAD_BELOW, _SPREAD_ABOVE = 0.5, 0.8
"""Standard deviations of log parallax; a wide baseline is the lesser evil."""
_SAME_SIDE_PENALTY = 0.6
"""Share of its score that a neighbour loses when it lies in exactly the direction of a chosen one: what
is hidden on one side of the reference is often seen from the other."""
_MAX_POINTS = 200
"""Points per reference that vote; more do not change the choice."""
_NEAR_MARGIN, _FAR_MARGIN = 0.8, 1.25
"""Surfaces without features reach beyond the sparse points."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PinholeCamera:
    """A pinhole camera with its pose.

    Args:
        img_from_cam: (3, 3) calibration matrix in pixels; the first pixel's centre is (0.5, 0.5).
        cam_from_seg: (3, 4) rigid.
        width, height: in pixels.
    """

    img_from_cam: FloatArray
    cam_from_seg: FloatArray
    width: int
    height: int

    def __post_init__(self) -> None:
        if self.img_from_cam.shape != (3, 3) or self.cam_from_seg.shape != (3, 4):
            raise ValueError(f"PinholeCamera: matrices {self.img_from_cam.shape} and {self.cam_from_seg.shape}")

    @property
    def centre_seg(self) -> FloatArray:
        """(3,) projection centre."""
        centre: FloatArray = -self.cam_from_seg[:, :3].T @ self.cam_from_seg[:, 3]
        return centre

    def resized(self, width: int, height: int) -> PinholeCamera:
        """The same camera for the image resized to ``width`` x ``height`` (axes scale separately)."""
        scale = np.diag([width / self.width, height / self.height, 1.0])
        return PinholeCamera(
            img_from_cam=scale @ self.img_from_cam, cam_from_seg=self.cam_from_seg, width=width, height=height
        )


def depths_in_views(cameras: Sequence[PinholeCamera], points_seg: FloatArray) -> FloatArray:
    """(N, P) z-depth of points (P, 3) in N views; NaN where a point is behind a camera or outside its image."""
    img_from_seg = np.stack([camera.img_from_cam @ camera.cam_from_seg for camera in cameras])
    x, y, z = np.moveaxis(img_from_seg[:, :, :3] @ points_seg.T + img_from_seg[:, :, 3:], 1, 0)
    width, height = (np.array([getattr(c, side) for c in cameras])[:, None] for side in ("width", "height"))
    in_view = (z > 0) & (x >= 0) & (y >= 0) & (x < width * z) & (y < height * z)
    return np.where(in_view, z, np.nan)


def choose_neighbours(
    reference: int, cameras: Sequence[PinholeCamera], points_seg: FloatArray, *, count: int
) -> tuple[int, ...]:
    """The most useful neighbours of one camera, best first.

    A camera at the same place, the reference itself among them, has no parallax and is never chosen.
    A neighbour scores by the share of the points that it contains, each weighted by a log-normal
    function of the parallax angle. Neighbours on the same side of the reference count less.

    Args:
        reference: position in ``cameras``.
        cameras: all cameras of the submodel.
        points_seg: (P, 3) points that the reference sees.
        count: at most this many; fewer where parallax or overlap is missing, possibly none.
    """
    if len(points_seg) == 0:
        return ()
    points = points_seg[:: max(1, len(points_seg) // _MAX_POINTS)]
    in_view = np.isfinite(depths_in_views(cameras, points))
    centres = np.stack([camera.centre_seg for camera in cameras])
    parallax_deg = _parallax_deg(points, centres[reference], centres)
    usable = in_view.mean(axis=1) >= MIN_OVERLAP_SHARE
    usable &= (in_view & (parallax_deg >= MIN_PARALLAX_DEG)).sum(axis=1) > 0.5 * in_view.sum(axis=1)
    scores = np.where(usable, (_parallax_weight(parallax_deg) * in_view).mean(axis=1), 0.0)
    baselines = centres - centres[reference]
    directions = baselines / np.maximum(np.linalg.norm(baselines, axis=1, keepdims=True), 1e-12)
    chosen: list[int] = []
    while len(chosen) < count and scores.max() > 0:
        best = int(scores.argmax())
        chosen.append(best)
        scores[best] = 0.0
        same_side = np.clip(directions @ directions[best], 0.0, 1.0)
        scores *= 1.0 - _SAME_SIDE_PENALTY * same_side**2
    return tuple(chosen)


def inverse_depth_range(camera: PinholeCamera, points_seg: FloatArray) -> tuple[float, float] | None:
    """(far, near) inverse depths that enclose the points in view with a margin; None without points.

    The extreme percents are dropped first: a few sparse points are always wrong.
    """
    depths = depths_in_views([camera], points_seg)
    depths = depths[np.isfinite(depths)]
    if len(depths) == 0:
        return None
    near, far = np.percentile(depths, [1.0, 99.0])
    return float(1.0 / (far * _FAR_MARGIN)), float(1.0 / (near * _NEAR_MARGIN))


def _parallax_deg(points_seg: FloatArray, centre: FloatArray, others: FloatArray) -> FloatArray:
    """(N, P) angle at each of P points between the rays to one centre and to N others, in degrees."""
    to_centre, to_others = centre - points_seg, others[:, None] - points_seg
    lengths = np.linalg.norm(to_centre, axis=-1) * np.linalg.norm(to_others, axis=-1)
    cosines = (to_centre * to_others).sum(axis=-1) / np.maximum(lengths, 1e-300)
    angles: FloatArray = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    return angles


def _parallax_weight(parallax_deg: FloatArray) -> FloatArray:
    """In (0, 1], 1 at the best parallax; any shape."""
    log_ratio = np.log(np.maximum(parallax_deg, 1e-3) / BEST_PARALLAX_DEG)
    spread = np.where(log_ratio < 0, _SPREAD_BELOW, _SPREAD_ABOVE)
    weight: FloatArray = np.exp(-0.5 * (log_ratio / spread) ** 2)
    return weight
