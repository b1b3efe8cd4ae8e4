"""Cameras from pointmaps.

The network gives every pixel a point in the camera's frame and one in the frame of the segment. The rays of the
former tell the focal length, both together the pose. `estimate_focal` and `register_camera` do it as published
(the network specification, section 11): all pixels, one image at a time. `fit_cameras` is for a whole segment:

    sightings = [sight(pointmaps, window) for each image]      a few thousand pixels of each are kept
    fitted = fit_cameras(sightings, camera_of_sighting, intrinsics, calibrated=False)

It takes confident pixels only, gives all images of a camera one focal length, and says for every image how well
its pose fits or why there is none. Angles are taken where they are known best: a pixel's ray comes from the
camera, only its depth from the network. The next module to read is ``full_image``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import pycolmap
from torch import Tensor

from smust3r_colmap.backbones.must3r.head import Pointmaps
from smust3r_colmap.backbones.must3r.pose_refinement import refine_pose
from smust3r_colmap.backbones.must3r.preprocessing import NetworkWindow
from smust3r_colmap.config import CameraFit
from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.estimators.robust import evenly_chosen, trimmed_median
from smust3r_colmap.estimators.sim3 import consensus_sim3
from smust3r_colmap.geometry.arrays import BoolArray, FloatArray
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres
from smust3r_colmap.geometry.se3 import SE3
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.geometry.so3 import nearest_rotation
from smust3r_colmap.importers.camera_prior import PLAUSIBLE_FOCAL_RATIO

WEISZFELD_ITERATIONS = 10
"""As published."""
SMALLEST_DISTANCE_PX = 1e-8
"""Of Weiszfeld's weights, as published."""
NUM_PIXELS = 2000
"""Kept of an image by `sight`; 4,000 gave the same poses, for neighbours err alike."""
CONFIDENCE_SHARE = 0.5
"""Of the median of what the confidence has above 1, which a pixel must reach: the low tail is dropped and never
more than half of the image."""
MIN_PIXELS = 50
"""Confident pixels of an image from which a camera is taken; of 2,000, 2.5 %."""
MAX_FOCAL_FACTOR = 2.0
"""Between the focal length that one image asks for and that of its camera; what is further off is no geometry."""
INLIER_RESIDUAL = 0.05
"""Distance of the two pointmaps of a pixel over its depth up to which they agree."""
START_ERROR = 0.05
"""Distance over the median depth up to which a pixel agrees with the consensus that the pose starts from."""
PNP_MAX_ERROR = 0.01
"""Reprojection error of an inlier over the longer side of the image: 5 px of 512, twice the usual bend of depth."""
PNP_PIXELS = 2000
"""Among which RANSAC chooses."""
PNP_TRIALS = 1000
"""At most; they find three right pixels where one in five is right, and nonsense costs 0.3 s rather than 3."""


# ---------------------------------------------------------------------------- as published
def estimate_focal(points_cam: npt.ArrayLike | Tensor, *, dtype: type[np.floating[Any]] = np.float32) -> float:
    """Focal length in network pixels of one image, for both axes, about the centre of the image.

    The f that minimises sum |u - f r| over all pixels u and rays r = (x/z, y/z), by Weiszfeld's iteration. Whatever
    the confidence and the sign of the depth, every pixel counts; a ray that is not finite counts as zero.

    Args:
        points_cam: (H, W, 3) in the camera frame.
        dtype: of the arithmetic, float32 for batch reconstruction and float64 for video.

    Returns:
        At least 0, which is no focal length and comes out where most points lie behind the camera; NaN where no
        ray has a length.

    Raises:
        ValueError: another shape.

    Source: the network specification, section 11.1.
    """
    points = _as_array(points_cam).astype(dtype)
    if points.ndim != 3 or points.shape[2] != 3:
        raise ValueError(f"points {points.shape}; (H, W, 3) of one image are needed")
    height, width = points.shape[:2]
    x, y = np.meshgrid(np.arange(width, dtype=dtype) - width / 2, np.arange(height, dtype=dtype) - height / 2)
    pixels = np.stack([x, y], axis=-1).astype(dtype)  # (H, W, 2)
    with np.errstate(all="ignore"):
        rays = np.nan_to_num(points[..., :2] / points[..., 2:], nan=0.0, posinf=0.0, neginf=0.0)
        along, squared = (rays * pixels).sum(axis=-1), (rays**2).sum(axis=-1)
        focal = along.mean() / squared.mean()
        for _ in range(WEISZFELD_ITERATIONS):
            distances = np.linalg.norm(pixels - focal * rays, axis=-1)
            weights = 1 / np.maximum(distances, dtype(SMALLEST_DISTANCE_PX))
            focal = (weights * along).mean() / (weights * squared).mean()
    return float(np.maximum(focal, 0))


def register_camera(
    points_cam: npt.ArrayLike | Tensor, points_world: npt.ArrayLike | Tensor, confidence: npt.ArrayLike | Tensor
) -> FloatArray:
    """(4, 4) rigid ``world_from_cam`` between the two pointmaps of one image, in float64.

    Minimises sum w |R p_cam + t - p_world|^2 over all pixels, with w = confidence - 1.

    Args:
        points_cam, points_world: (H, W, 3) or (N, 3). confidence: (H, W) or (N,).

    Raises:
        ValueError: other shapes, such as those of many images.
        DegenerateAlignmentError: a point or a confidence is not finite, or no pixel has a confidence above 1.

    Source: the network specification, section 11.2.
    """
    cam, world, certain = (_as_array(values) for values in (points_cam, points_world, confidence))
    if cam.shape != world.shape or cam.shape != (*certain.shape, 3) or certain.ndim > 2:
        raise ValueError(
            f"points {cam.shape} and {world.shape}, confidence {certain.shape}; (H, W, 3) twice and (H, W) of one "
            "image are needed"
        )
    cam, world = (points.reshape(-1, 3).astype(np.float64) for points in (cam, world))
    weights = certain.reshape(-1).astype(np.float64) - 1
    finite = np.isfinite(cam).all(axis=1) & np.isfinite(world).all(axis=1) & np.isfinite(weights)
    if not finite.all() or not weights.sum() > 0:
        raise DegenerateAlignmentError(
            f"{int((~finite).sum())} of {len(finite)} pixels are not finite, the weights add up to "
            f"{weights[finite].sum():.3g}; the published registration needs all of them"
        )
    weights /= weights.sum()
    mean_cam, mean_world = weights @ cam, weights @ world
    world_from_cam = np.eye(4)
    world_from_cam[:3, :3] = nearest_rotation((world - mean_world).T @ (weights[:, None] * (cam - mean_cam)))
    world_from_cam[:3, 3] = mean_world - world_from_cam[:3, :3] @ mean_cam
    return world_from_cam


# -------------------------------------------------------------------------- what is kept
@dataclass(frozen=True, kw_only=True, eq=False)
class PublishedCamera:
    """What the published procedure makes of one image.

    Args:
        focal_net: in network pixels; 0 or NaN is none.
        seg_from_cam: (3, 4), or None where the registration failed. failure: why.
    """

    focal_net: float
    seg_from_cam: FloatArray | None
    failure: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sighting:
    """The pixels of one image from which its camera is fitted.

    Args:
        xy_img: (N, 2) in the original image. points_cam, points_seg: (N, 3) float64.
        confidence: (N,). All rows are finite, in front of the camera and of a confidence above 1.
        window: where the network's image lies in the original.
        num_pixels: looked at, of which N came through.
        median_confidence: of the pixels looked at whose confidence is finite; 1 where there is none.
        published: for the camera fit "upstream".
    """

    xy_img: FloatArray
    points_cam: FloatArray
    points_seg: FloatArray
    confidence: FloatArray
    window: NetworkWindow
    num_pixels: int
    median_confidence: float
    published: PublishedCamera | None = None

    @property
    def rays_net(self) -> FloatArray:
        """(N, 2) directions with z = 1, as the network has them."""
        return self.points_cam[:, :2] / self.points_cam[:, 2:]

    def rows(self, chosen: BoolArray | npt.NDArray[np.int64]) -> Sighting:
        """These pixels only."""
        return replace(
            self,
            xy_img=self.xy_img[chosen],
            points_cam=self.points_cam[chosen],
            points_seg=self.points_seg[chosen],
            confidence=self.confidence[chosen],
        )

    def confident(self) -> Sighting:
        """The pixels whose confidence is not in the low tail of this image."""
        certainty = self.confidence - 1
        return self.rows(certainty >= CONFIDENCE_SHARE * np.median(certainty)) if len(certainty) else self


def sight(
    pointmaps: Pointmaps, window: NetworkWindow, *, camera_fit: CameraFit = "robust", num_pixels: int = NUM_PIXELS
) -> Sighting:
    """Keep what the camera of one image is fitted from, so that its pointmaps can go.

    Args:
        pointmaps: of the image, (H, W, 3) and (H, W), on any device.
        window: of the image.
        camera_fit: "upstream" also runs the published procedure on all pixels.
        num_pixels: about as many are looked at, on a regular grid.
    """
    height, width = pointmaps.confidence.shape
    step = max(1, min(height, width, round(float(np.sqrt(height * width / num_pixels)))))
    grid = slice(step // 2, None, step)
    xy_net = pixel_centres(width, height).reshape(height, width, 2)[grid, grid].reshape(-1, 2)
    points_cam, points_seg = (
        _as_array(points[grid, grid]).reshape(-1, 3).astype(np.float64)
        for points in (pointmaps.points_cam, pointmaps.points_world)
    )
    confidence = _as_array(pointmaps.confidence[grid, grid]).reshape(-1).astype(np.float64)
    orig_from_net = window.orig_from_net
    looked_at = Sighting(
        xy_img=xy_net @ orig_from_net[:2, :2].T + orig_from_net[:2, 2],
        points_cam=points_cam,
        points_seg=points_seg,
        confidence=confidence,
        window=window,
        num_pixels=len(confidence),
        median_confidence=_median_or(confidence[np.isfinite(confidence)], 1.0),
        published=_published_camera(pointmaps) if camera_fit == "upstream" else None,
    )
    finite = np.isfinite(points_cam).all(axis=1) & np.isfinite(points_seg).all(axis=1) & np.isfinite(confidence)
    return looked_at.rows(finite & (points_cam[:, 2] > 0) & (confidence > 1))


def _published_camera(pointmaps: Pointmaps) -> PublishedCamera:
    focal = estimate_focal(pointmaps.points_cam)
    try:
        pose = register_camera(pointmaps.points_cam, pointmaps.points_world, pointmaps.confidence)
    except DegenerateAlignmentError as error:
        return PublishedCamera(focal_net=focal, seg_from_cam=None, failure=str(error))
    return PublishedCamera(focal_net=focal, seg_from_cam=pose[:3])


# ---------------------------------------------------------------------- a whole segment
@dataclass(frozen=True, kw_only=True, eq=False)
class FittedCamera:
    """The camera of one image, with its evidence.

    Args:
        seg_from_cam: (3, 4) rigid.
        intrinsics: at the original image size.
        depth_factor: by which the network's depth is multiplied to go with these intrinsics: known over predicted
            focal length of a calibrated camera, for what is seen too wide is seen too near; else 1.
        median_confidence: of the image.
        num_pixels: that took part.
        inlier_share: of them, those whose two pointmaps agree to `INLIER_RESIDUAL` of the depth.
        relative_residual: median of the distance between the two over the depth.
    """

    seg_from_cam: FloatArray
    intrinsics: Intrinsics
    depth_factor: float
    median_confidence: float
    num_pixels: int
    inlier_share: float
    relative_residual: float


@dataclass(frozen=True, kw_only=True)
class NoCamera:
    """An image whose pointmaps give no camera, and why."""

    reason: str


def fit_cameras(
    sightings: Sequence[Sighting],
    camera_of_sighting: Sequence[int],
    cameras: Sequence[Intrinsics],
    *,
    camera_fit: CameraFit = "robust",
    calibrated: bool = False,
) -> tuple[FittedCamera | NoCamera, ...]:
    """The camera of every image of a segment; bad geometry gives a reason and never an error.

    ``robust``: of each physical camera one focal length, from the median slope between known and predicted rays
    over the confident pixels of all its images; poses from those rays, the predicted depth and the points of the
    segment (see ``pose_refinement``), started by a consensus. ``pnp``: the same focal lengths; poses by RANSAC on
    reprojections (pycolmap), which does without the depth. ``upstream``: each image its own focal length and pose,
    as published; a single pixel that is not finite leaves an image without pose.

    Args:
        sightings: of the segment's images, from `sight` with the same ``camera_fit``.
        camera_of_sighting: index into ``cameras`` for each.
        cameras: priors at the original image sizes; principal point and distortion are kept.
        camera_fit: see above.
        calibrated: the priors are calibrations: their focal lengths are kept too, and with them ("robust", "pnp")
            the poses are found; the published procedure knows nothing of calibrations, so its poses stay.

    Returns:
        For each image its camera, or why it has none.

    Raises:
        ValueError: the sightings and their cameras differ in number, or "upstream" is asked for of sightings
            that were made for another camera fit.
    """
    if len(sightings) != len(camera_of_sighting):
        raise ValueError(f"{len(sightings)} sightings, cameras of {len(camera_of_sighting)}")
    if camera_fit == "upstream":
        return tuple(
            _as_published(sighting, cameras[camera], calibrated=calibrated)
            for sighting, camera in zip(sightings, camera_of_sighting, strict=True)
        )
    confident = [sighting.confident() for sighting in sightings]
    agreed: dict[int, _Agreed | NoCamera] = {}
    for camera in sorted(set(camera_of_sighting)):
        seen = [one for one, owner in zip(confident, camera_of_sighting, strict=True) if owner == camera]
        agreed[camera] = _agreed(seen, cameras[camera], calibrated=calibrated)
    place = _placed_by_pnp if camera_fit == "pnp" else _placed_by_rays_and_depth
    return tuple(
        _fitted(sighting, agreed[camera], place) for sighting, camera in zip(confident, camera_of_sighting, strict=True)
    )


def guess_cameras(
    sightings: Sequence[Sighting], camera_of_sighting: Sequence[int], cameras: Sequence[Intrinsics]
) -> tuple[FittedCamera | NoCamera, ...]:
    """For a segment of which `fit_cameras` makes nothing: prior intrinsics, and whatever pose fits best.

    It shows what the network said, so that a person can look at it, and is to be doubted.

    Args:
        sightings, camera_of_sighting, cameras: as for `fit_cameras`.
    """
    return tuple(
        _guessed(sighting, cameras[camera]) for sighting, camera in zip(sightings, camera_of_sighting, strict=True)
    )


def _guessed(sighting: Sighting, prior: Intrinsics) -> FittedCamera | NoCamera:
    rays_cam = prior.rays_cam(sighting.xy_img)
    known = np.flatnonzero(np.isfinite(rays_cam).all(axis=1))
    sighting, rays_cam = sighting.rows(known), rays_cam[known]
    if len(known) < MIN_PIXELS:
        return _too_few(sighting)
    agreed = _Agreed(intrinsics=prior, depth_factor=1.0)
    pose = register_camera(sighting.points_cam, sighting.points_seg, sighting.confidence)[:3]
    return _with_evidence(sighting, agreed, rays_cam, pose)


@dataclass(frozen=True, kw_only=True)
class _Agreed:
    """What all images of one camera share: its intrinsics, and the factor of the depth that goes with them."""

    intrinsics: Intrinsics
    depth_factor: float


def _as_published(sighting: Sighting, prior: Intrinsics, *, calibrated: bool) -> FittedCamera | NoCamera:
    """The published focal length and pose of one image, with the evidence that the others have."""
    published = sighting.published
    if published is None:
        raise ValueError('the sighting was made for another camera fit; call sight(..., camera_fit="upstream")')
    if published.seg_from_cam is None:
        return NoCamera(reason=published.failure)
    seg_from_cam = published.seg_from_cam
    # One focal length for two scales that differ by the rounding of the crop.
    focal = published.focal_net * float(np.sqrt(np.prod(sighting.window.orig_px_per_net_px)))
    if not _is_plausible(focal, prior):
        return NoCamera(reason=_implausible(focal, prior))
    zoom = focal / prior.focal_px
    agreed = (
        _Agreed(intrinsics=prior, depth_factor=1 / zoom)
        if calibrated
        else _Agreed(intrinsics=prior.zoomed(zoom), depth_factor=1.0)
    )
    return _fitted(sighting.confident(), agreed, lambda *_: seg_from_cam)


# -------------------------------------------------------------------------- focal length
def _agreed(sightings: Sequence[Sighting], prior: Intrinsics, *, calibrated: bool) -> _Agreed | NoCamera:
    """The focal length that all images of this camera ask for together, or the factor by which it is off."""
    ratio = _ray_ratio(sightings, prior)
    if np.isnan(ratio):
        return NoCamera(reason=f"none of {sum(one.num_pixels for one in sightings)} pixels of its camera has a ray")
    focal = prior.focal_px / ratio if ratio > 0 else 0.0
    if not _is_plausible(focal, prior):
        return NoCamera(reason=_implausible(focal, prior))
    if calibrated:
        return _Agreed(intrinsics=prior, depth_factor=ratio)
    return _Agreed(intrinsics=prior.zoomed(1 / ratio), depth_factor=1.0)


def _ray_ratio(sightings: Sequence[Sighting], intrinsics: Intrinsics) -> float:
    """Predicted over known rays, which is known over predicted focal length; NaN where no pixel has both.

    Per pixel it is the slope r.q / q.q of the predicted ray r on the known ray q. Errors are in r alone, so that noise
    does not shrink the slope as it would shrink the inverse one. They weigh less the longer q is.
    """
    predicted = np.concatenate([one.rays_net for one in sightings])
    known = np.concatenate([intrinsics.rays_cam(one.xy_img)[:, :2] for one in sightings])
    length = np.linalg.norm(known, axis=1)
    use = length > 0  # not where undistortion failed either
    slopes = (predicted[use] * known[use]).sum(axis=1) / length[use] ** 2
    return trimmed_median(slopes, length[use])


def _is_plausible(focal_px: float, prior: Intrinsics) -> bool:
    low, high = PLAUSIBLE_FOCAL_RATIO
    return low <= focal_px / max(prior.width, prior.height) <= high


def _implausible(focal_px: float, prior: Intrinsics) -> str:
    low, high = (ratio * max(prior.width, prior.height) for ratio in PLAUSIBLE_FOCAL_RATIO)
    return f"focal length {focal_px:.3g} px; {low:.0f} to {high:.0f} are plausible"


# ---------------------------------------------------------------------------------- pose
class _Placing(Protocol):
    """One of the ways to find a pose."""

    def __call__(self, sighting: Sighting, agreed: _Agreed, rays_cam: FloatArray, /) -> FloatArray:
        """(3, 4) ``seg_from_cam``.

        Args:
            sighting: the confident pixels. agreed: of its camera. rays_cam: (N, 3) of the pixels, with z = 1.

        Raises:
            DegenerateAlignmentError: the pixels do not determine it.
        """


def _fitted(sighting: Sighting, agreed: _Agreed | NoCamera, place: _Placing) -> FittedCamera | NoCamera:
    """The pose of one image under the agreed intrinsics, with its evidence."""
    if len(sighting.confidence) < MIN_PIXELS:
        return _too_few(sighting)
    if isinstance(agreed, NoCamera):
        return agreed
    wider = _ray_ratio([sighting], agreed.intrinsics) / agreed.depth_factor
    if not 1 / MAX_FOCAL_FACTOR <= wider <= MAX_FOCAL_FACTOR:
        return NoCamera(
            reason=f"its rays are {wider:.3g} times as wide as those of all images of its camera together; "
            f"beyond a factor of {MAX_FOCAL_FACTOR:.0f} it is no geometry"
        )
    rays_cam = agreed.intrinsics.rays_cam(sighting.xy_img)
    known = np.flatnonzero(np.isfinite(rays_cam).all(axis=1))  # not where undistortion failed
    sighting, rays_cam = sighting.rows(known), rays_cam[known]
    try:
        seg_from_cam = place(sighting, agreed, rays_cam)
    except DegenerateAlignmentError as error:
        return NoCamera(reason=str(error))
    return _with_evidence(sighting, agreed, rays_cam, seg_from_cam)


def _too_few(sighting: Sighting) -> NoCamera:
    return NoCamera(
        reason=f"{len(sighting.confidence)} of {sighting.num_pixels} pixels are finite, in front of the camera "
        f"and confident; {MIN_PIXELS} are needed"
    )


def _with_evidence(sighting: Sighting, agreed: _Agreed, rays_cam: FloatArray, seg_from_cam: FloatArray) -> FittedCamera:
    residuals = _relative_residuals(sighting, agreed, rays_cam, seg_from_cam)
    return FittedCamera(
        seg_from_cam=seg_from_cam,
        intrinsics=agreed.intrinsics,
        depth_factor=agreed.depth_factor,
        median_confidence=sighting.median_confidence,
        num_pixels=len(residuals),
        inlier_share=float(np.mean(residuals <= INLIER_RESIDUAL)),
        relative_residual=float(np.median(residuals)),
    )


def _placed_by_rays_and_depth(sighting: Sighting, agreed: _Agreed, rays_cam: FloatArray) -> FloatArray:
    """A consensus of three pixels at a time for a start, then all of them, each residual by its own scatter."""
    depths = agreed.depth_factor * sighting.points_cam[:, 2]
    points_cam = depths[:, None] * rays_cam
    max_error = START_ERROR * float(np.median(depths))
    start = consensus_sim3(sighting.points_seg, points_cam, max_error=max_error)
    cam_from_seg = refine_pose(
        rays_cam,
        depths,
        sighting.points_seg,
        sighting.confidence - 1,
        SE3(rotation=start.rotation, translation=start.translation),
    )
    seg_from_cam: FloatArray = cam_from_seg.inverse().matrix[:3]
    return seg_from_cam


def _placed_by_pnp(sighting: Sighting, agreed: _Agreed, _rays_cam: FloatArray) -> FloatArray:
    """LO-RANSAC on reprojections and refinement by least squares, both pycolmap's."""
    chosen = evenly_chosen(len(sighting.confidence), PNP_PIXELS)
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = PNP_MAX_ERROR * max(agreed.intrinsics.width, agreed.intrinsics.height)
    options.ransac.max_num_trials = PNP_TRIALS
    options.ransac.random_seed = 0
    found = pycolmap.estimate_and_refine_absolute_pose(
        sighting.xy_img[chosen], sighting.points_seg[chosen], agreed.intrinsics.colmap_camera(), options
    )
    num_inliers = 0 if found is None else found["num_inliers"]
    if found is None or num_inliers < MIN_PIXELS:
        raise DegenerateAlignmentError(
            f"{num_inliers} of {len(chosen)} pixels agree on a pose to {options.ransac.max_error:.1f} px; "
            f"{MIN_PIXELS} are needed"
        )
    return invert_rigid(found["cam_from_world"].matrix())


def _relative_residuals(
    sighting: Sighting, agreed: _Agreed, rays_cam: FloatArray, seg_from_cam: FloatArray
) -> FloatArray:
    """(N,) distance between the point on the known ray and the predicted one in the segment, over the depth."""
    depths = agreed.depth_factor * sighting.points_cam[:, 2:]
    points_seg = (depths * rays_cam) @ seg_from_cam[:, :3].T + seg_from_cam[:, 3]
    residuals: FloatArray = np.linalg.norm(points_seg - sighting.points_seg, axis=1) / depths[:, 0]
    return residuals


def _median_or(values: FloatArray, default: float) -> float:
    return float(np.median(values)) if len(values) else default


def _as_array(values: npt.ArrayLike | Tensor) -> npt.NDArray[Any]:
    return values.detach().cpu().numpy() if isinstance(values, Tensor) else np.asarray(values)
