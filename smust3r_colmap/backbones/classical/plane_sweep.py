"""Dense depth of a registered submodel: a multi-view plane sweep, then agreement between views.

For every image, in this order:

1. ``Rectifier``: resize and undistort into a small grey pinhole view, once per image.
2. ``choose_neighbours`` (module ``view_selection``): views with parallax and overlap.
3. ``sweep_depth``: at half resolution, normalised cross-correlation (NCC) over planes of constant
   inverse depth, the mean of the best two neighbours, made smooth by semi-global matching; at full
   resolution, a few hypotheses around that surface, all neighbours weighted by their likeness. The
   windows of the second step are warped with the surface found by the first, so slanted walls and
   floors are not cut into steps.
4. ``check_consistency``: which other views found the same surface; this makes the confidence.
5. Back to the distorted grid that the maps of ``products.DenseMaps`` use.

Sources: plane sweep, Collins 1996; best two of several views, after Kang, Szeliski and Chai 2001;
semi-global matching, Hirschmueller 2008. The next module to read is ``confidence``.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from smust3r_colmap.backbones.classical.view_selection import (
    PinholeCamera,
    choose_neighbours,
    depths_in_views,
    inverse_depth_range,
)
from smust3r_colmap.errors import ImageError
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres
from smust3r_colmap.geometry.depth_noise import ADJACENT_PIXELS, FULL_VIEW_AGREEMENT
from smust3r_colmap.products import Tracks

logger = logging.getLogger(__name__)

FloatMap = npt.NDArray[np.float32]
ColourImage = npt.NDArray[np.uint8]
CostVolume = npt.NDArray[np.int16]

SWEEP_NEIGHBOURS = 4
"""Views that a sweep compares with; six are 0.5 % better for half again the time."""
CHECK_NEIGHBOURS = 8
"""Views that may confirm a depth. Looking one up costs a twentieth of sweeping with it."""
COARSE_WINDOW_PX = 3
"""Pixels at half resolution. Larger fattens foregrounds (5: 1 % fewer correct pixels indoors, 7: 2 %);
what a small window cannot tell, semi-global matching can."""
FINE_WINDOW_PX = 7
"""Pixels at full resolution."""
NOISE_VARIANCE = 1.0
"""Squared grey levels added to every window variance: NCC goes to 0 where there is only noise."""
MIN_PLANES = 12
"""A sweep of fewer planes has no room for smoothing."""
PLANE_STEP_PX = 1.0
"""Disparity between planes at half resolution, with the widest baseline. Finer steps (0.4) gained
nothing for 1.5 times the time: the parabola and the second step do the rest."""
FINE_STEPS_PX = (-1.2, -0.6, 0.0, 0.6, 1.2)
"""Hypotheses of the second step around the first, in pixels of disparity at full resolution."""
MIN_NCC = 0.3
"""NCC below which a pixel gets no depth: untextured, occluded or outside the range."""
FULL_WEIGHT_NCC = 0.7
"""NCC from which an agreeing view counts in full."""
NEGLIGIBLE_DISTORTION_PX = 0.25
"""Undistortion that moves no pixel further is left out."""

_COST_SCALE = 100  # an NCC of 0 costs this much, of 1 nothing
_SMALL_STEP_COST = 8  # semi-global matching: a change by one plane (P1)
_JUMP_COST = 100  # a change by more (P2) across even grey
_EDGE_GREY = 8.0  # grey step that halves P2: depth jumps where the image does
_MIN_WEIGHT_NCC = 0.05  # NCC given to a neighbour that fits nowhere, so that it lowers the score
_MAX_TANGENT = 2.5  # rays beyond 68 degrees from the axis are left out of pinhole views
_MAX_VIEW_GROWTH_RATIO = 1.5  # longer sides of a pinhole view and its image; wider views get a shorter focal
_MIN_OWN_POINTS = 20  # an image with fewer sparse points borrows those of the submodel
_TINY = 1e-6

# cv2 indexes pixels by their centres from 0, cameras here from 0.5.
_INDEX_FROM_IMG = np.array([[1.0, 0.0, -0.5], [0.0, 1.0, -0.5], [0.0, 0.0, 1.0]])
_IMG_FROM_INDEX = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """An undistorted grey image with its camera.

    Args:
        camera: of the undistorted image.
        grey: (height, width) float32, 0 to 255.
        interior: (height, width) float32, see ``interior_of``.
    """

    camera: PinholeCamera
    grey: FloatMap
    interior: FloatMap

    def __post_init__(self) -> None:
        if not self.grey.shape == self.interior.shape == (self.camera.height, self.camera.width):
            raise ValueError(f"View: image {self.grey.shape}, camera {(self.camera.height, self.camera.width)}")

    def halved(self) -> View:
        """The same view at half the size, rounded down."""
        camera = self.camera.resized(max(1, self.camera.width // 2), max(1, self.camera.height // 2))
        size = (camera.width, camera.height)
        grey = np.asarray(cv2.resize(self.grey, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
        interior = np.asarray(cv2.resize(self.interior, size, interpolation=cv2.INTER_NEAREST), dtype=np.float32)
        return View(camera=camera, grey=grey, interior=interior)


def interior_of(seen: npt.NDArray[np.bool_]) -> FloatMap:
    """1 where the window of a pixel and its interpolation stay inside what the camera saw (H, W), else 0.

    A window that straddles the border compares with made-up pixels: it scores well but a little off.
    """
    margin = FINE_WINDOW_PX // 2 + 1
    kernel = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
    eroded = cv2.erode(seen.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(eroded, dtype=np.float32)


@dataclass(frozen=True, kw_only=True, eq=False)
class ImageDepth:
    """The dense maps of one image, on the grid of the whole distorted image uniformly resized.

    Args:
        depth: (H, W) float32 z-depth in segment units, 0 where there is none.
        confidence: (H, W) float32, 1 where nothing is known. Every other view that found the same
            surface adds up to one: less where its depth differs by more than ``FULL_VIEW_AGREEMENT``, or where
            the images are unlike (NCC below ``FULL_WEIGHT_NCC``).
        rgb: (H, W, 3) uint8.
    """

    depth: FloatMap
    confidence: FloatMap
    rgb: ColourImage

    def __post_init__(self) -> None:
        if not self.depth.shape == self.confidence.shape == self.rgb.shape[:2]:
            raise ValueError(f"ImageDepth: {self.depth.shape}, {self.confidence.shape}, {self.rgb.shape}")


# ------------------------------------------------------------------------------- entry
def reconstruct_depth(
    load_rgb: Callable[[int], ColourImage],
    *,
    images: Sequence[int],
    seg_from_cam: FloatArray,
    intrinsics: Sequence[Intrinsics],
    tracks: Tracks,
    dense_size: int,
    planes: int,
) -> Iterator[ImageDepth]:
    """Depth of all images of a submodel, in their order.

    All of them are swept before the first is yielded, because the views confirm each other; about
    15 bytes per pixel and image are held meanwhile. An image without parallax, and every image of a
    submodel without sparse points, gets empty maps and a line in the log.

    Args:
        load_rgb: position in ``images`` to the (height, width, 3) image, or (height, width) grey.
        images: (N,) indices into the collection.
        seg_from_cam: (N, 3, 4) rigid.
        intrinsics: one per image, at the original size.
        tracks: sparse points of the submodel.
        dense_size: longer side of the maps; an image that is smaller keeps its size.
        planes: at most this many hypotheses per pixel.

    Raises:
        ImageError: an image has another size than its intrinsics.
    """
    cv2.setNumThreads(1)  # segments run in parallel, not images
    rectifiers = {camera: Rectifier.of(camera, dense_size) for camera in dict.fromkeys(intrinsics)}
    rgbs: list[ColourImage] = []
    views: list[View] = []
    for k, camera in enumerate(intrinsics):
        rectifier = rectifiers[camera]
        rgbs.append(_resized_rgb(load_rgb(k), camera, rectifier, image=images[k]))
        views.append(rectifier.view(rgbs[k], _inverse_rigid(seg_from_cam[k])))
    cameras = [view.camera for view in views]

    seen_by = _points_by_image(tracks, images, cameras)
    neighbours = [choose_neighbours(k, cameras, seen_by[k], count=CHECK_NEIGHBOURS) for k in range(len(views))]
    depths: list[FloatMap] = []
    scores: list[FloatMap] = []
    for k, view in enumerate(views):
        around = np.concatenate([seen_by[j] for j in (k, *neighbours[k])])
        depth_range = inverse_depth_range(view.camera, around)
        if not neighbours[k] or depth_range is None:
            logger.warning("image %d: no depth, no other image of the submodel has parallax with it", images[k])
            depth = score = np.zeros_like(view.grey)
        else:
            compared = [views[j] for j in neighbours[k][:SWEEP_NEIGHBOURS]]
            depth, score = sweep_depth(view, compared, inverse_depths=depth_range, planes=planes)
        depths.append(np.where(score >= MIN_NCC, depth, np.float32(0.0)))
        scores.append(score)

    for k, camera in enumerate(intrinsics):
        others = [(cameras[j], depths[j]) for j in neighbours[k]]
        agreement = check_consistency(cameras[k], depths[k], others, tolerance=FULL_VIEW_AGREEMENT)
        quality = np.clip((scores[k] - MIN_NCC) / (FULL_WEIGHT_NCC - MIN_NCC), 0.0, 1.0)
        depth, confidence = rectifiers[camera].maps_on_grid(depths[k], 1.0 + agreement * quality)
        yield ImageDepth(depth=depth, confidence=confidence, rgb=rgbs[k])


def _points_by_image(tracks: Tracks, images: Sequence[int], cameras: Sequence[PinholeCamera]) -> list[FloatArray]:
    """For each image the (P_k, 3) points it observes; all points in its view when those are too few."""
    points: list[FloatArray] = []
    for image, camera in zip(images, cameras, strict=True):
        rows = np.unique(tracks.point_of_observation[tracks.image_of_observation == image])
        own = tracks.points_seg[rows]
        if len(own) < _MIN_OWN_POINTS:
            own = tracks.points_seg[np.isfinite(depths_in_views([camera], tracks.points_seg)[0])]
        points.append(own)
    return points


def _resized_rgb(loaded: ColourImage, camera: Intrinsics, rectifier: Rectifier, *, image: int) -> ColourImage:
    """The loaded image as (H, W, 3) at the size of the maps."""
    if loaded.shape[:2] != (camera.height, camera.width):
        raise ImageError(
            f"image {image}: {loaded.shape[1]}x{loaded.shape[0]} pixels, "
            f"its camera is for {camera.width}x{camera.height}"
        )
    rgb = loaded if loaded.ndim == 3 else cv2.cvtColor(loaded, cv2.COLOR_GRAY2RGB)
    resized = cv2.resize(rgb, (rectifier.width, rectifier.height), interpolation=cv2.INTER_AREA)
    return np.asarray(resized, dtype=np.uint8)


def _inverse_rigid(b_from_a: FloatArray) -> FloatArray:
    """(3, 4) ``a_from_b`` of a rigid transform."""
    rotation = b_from_a[:, :3].T
    return np.column_stack([rotation, -rotation @ b_from_a[:, 3]])


# ----------------------------------------------------------------------- rectification
@dataclass(frozen=True, kw_only=True, eq=False)
class Rectifier:
    """How images of one camera become pinhole views, and how maps of the view come back.

    Args:
        width, height: of the grid, the whole image uniformly resized.
        img_from_cam: (3, 3) calibration of the view.
        view_width, view_height: of the view, large enough to hold the whole undistorted grid.
        grid_from_view: (2, view_height, view_width) float32, x and y as array positions, outside the
            grid where the camera saw nothing; None where view and grid are the same.
        view_from_grid: (2, height, width) float32, the way back; None likewise.
        interior: (view_height, view_width) float32, of every view (``interior_of``).
    """

    width: int
    height: int
    img_from_cam: FloatArray
    view_width: int
    view_height: int
    grid_from_view: FloatMap | None
    view_from_grid: FloatMap | None
    interior: FloatMap

    @classmethod
    def of(cls, original: Intrinsics, size: int) -> Rectifier:
        """For a camera, with a grid whose longer side is ``size`` pixels (or the image's, if shorter)."""
        shrink = min(1.0, size / max(original.width, original.height))
        width, height = max(1, round(original.width * shrink)), max(1, round(original.height * shrink))
        grid = original.resized(width, height)
        rays = grid.rays_cam(pixel_centres(width, height))
        calibration = np.asarray(grid.colmap_camera().calibration_matrix(), dtype=np.float64)
        shift = (rays @ calibration.T)[:, :2] - pixel_centres(width, height)
        if np.abs(shift).max() < NEGLIGIBLE_DISTORTION_PX:  # False for NaN
            return cls(
                width=width,
                height=height,
                img_from_cam=calibration,
                view_width=width,
                view_height=height,
                grid_from_view=None,
                view_from_grid=None,
                interior=interior_of(np.ones((height, width), dtype=bool)),
            )
        img_from_cam, view_width, view_height = _enclosing_pinhole(rays, grid.focal_px, max(width, height))
        grid_from_view = _grid_positions(grid, img_from_cam, view_width, view_height)
        x, y = grid_from_view
        view_from_grid = _finite_positions((rays @ img_from_cam.T)[:, :2] - 0.5, height, width)
        return cls(
            width=width,
            height=height,
            img_from_cam=img_from_cam,
            view_width=view_width,
            view_height=view_height,
            grid_from_view=grid_from_view,
            view_from_grid=view_from_grid,
            interior=interior_of((x > 0) & (y > 0) & (x < width - 1) & (y < height - 1)),
        )

    def view(self, rgb: ColourImage, cam_from_seg: FloatArray) -> View:
        """The grey pinhole view of a (height, width, 3) image; even where the camera saw nothing."""
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
        if self.grid_from_view is not None:
            grey = _sampled(grey, *self.grid_from_view, outside=float(grey.mean()))
        camera = PinholeCamera(
            img_from_cam=self.img_from_cam,
            cam_from_seg=cam_from_seg,
            width=self.view_width,
            height=self.view_height,
        )
        return View(camera=camera, grey=grey, interior=self.interior)

    def maps_on_grid(self, depth: FloatMap, confidence: FloatMap) -> tuple[FloatMap, FloatMap]:
        """Depth and confidence of the view, on the grid.

        Depth is interpolated on surfaces and taken from the nearest pixel at their edges, so that no
        depth is made up between foreground and background or beside a hole.
        """
        if self.view_from_grid is None:
            return depth, confidence
        x, y = self.view_from_grid
        nearest = _sampled(depth, x, y, interpolation=cv2.INTER_NEAREST)
        smooth = _sampled(depth, x, y)
        # The nearest pixel is at most half a pixel away.
        on_surface = np.abs(smooth - nearest) < ADJACENT_PIXELS / 2 * nearest
        moved = _sampled(confidence, x, y, interpolation=cv2.INTER_NEAREST)
        return np.where(on_surface, smooth, nearest), np.maximum(moved, np.float32(1.0))


def _enclosing_pinhole(rays_cam: FloatArray, focal_px: float, longer_side: int) -> tuple[FloatArray, int, int]:
    """Calibration, width and height of the pinhole image that holds all rays (N, 3) with z = 1."""
    tangents = np.clip(rays_cam[np.isfinite(rays_cam).all(axis=1), :2], -_MAX_TANGENT, _MAX_TANGENT)
    low, high = tangents.min(axis=0), tangents.max(axis=0)
    focal = min(focal_px, _MAX_VIEW_GROWTH_RATIO * longer_side / float((high - low).max()))
    width, height = (int(np.ceil(side)) for side in (high - low) * focal)
    calibration = np.array([[focal, 0.0, -low[0] * focal], [0.0, focal, -low[1] * focal], [0.0, 0.0, 1.0]])
    return calibration, max(1, width), max(1, height)


def _grid_positions(grid: Intrinsics, img_from_cam: FloatArray, width: int, height: int) -> FloatMap:
    """(2, height, width) array positions on the grid of the pixels of a pinhole image."""
    homogeneous = np.column_stack([pixel_centres(width, height), np.ones(width * height)])
    rays = homogeneous @ np.linalg.inv(img_from_cam).T
    xy_grid = grid.xy_img(rays)
    # Distortion polynomials fold back far outside the image: keep rays that come back as they went.
    returned = grid.rays_cam(np.nan_to_num(xy_grid, nan=-1.0))
    folded = ~(np.abs(returned - rays).max(axis=1) * grid.focal_px < 0.5)  # True for NaN
    xy_grid[folded] = np.nan
    return _finite_positions(xy_grid - 0.5, height, width)


def _finite_positions(positions: FloatArray, height: int, width: int) -> FloatMap:
    """(2, height, width) float32 of (height * width, 2); NaN becomes a place outside every image."""
    finite = np.where(np.isfinite(positions), positions, -10.0)
    return np.ascontiguousarray(finite.T, dtype=np.float32).reshape(2, height, width)


def _sampled(
    image: FloatMap, x: FloatMap, y: FloatMap, *, interpolation: int = cv2.INTER_LINEAR, outside: float = 0.0
) -> FloatMap:
    """The image at array positions (H, W)."""
    return np.asarray(cv2.remap(image, x, y, interpolation, borderValue=outside), dtype=np.float32)


# ------------------------------------------------------------------------------- sweep
def sweep_depth(
    reference: View, neighbours: Sequence[View], *, inverse_depths: tuple[float, float], planes: int
) -> tuple[FloatMap, FloatMap]:
    """Depth of one view by comparing it with others.

    Args:
        reference: the view that gets depth.
        neighbours: at least one, with parallax.
        inverse_depths: (far, near), both positive.
        planes: at most this many hypotheses over the range; fewer where they would be closer than
            ``PLANE_STEP_PX``.

    Returns:
        Depth (H, W) > 0 everywhere, and score (H, W), the mean NCC of the neighbours there weighted
        by their squared likeness, in [-1, 1]; depth means nothing where the score is low.

    Raises:
        ValueError: no neighbours, or the range is empty.
    """
    far, near = inverse_depths
    if not neighbours or not 0.0 < far < near:
        raise ValueError(f"sweep_depth: {len(neighbours)} neighbours, inverse depths {far} to {near}")
    px_per_inverse_depth = _disparity(reference.camera, [n.camera for n in neighbours], far, near) / (near - far)
    wanted = int(np.ceil((near - far) * px_per_inverse_depth * 0.5 / PLANE_STEP_PX)) + 1
    hypotheses = np.linspace(far, near, max(MIN_PLANES, min(planes, wanted)))
    half = reference.halved()
    costs = _plane_costs(half, [n.halved() for n in neighbours], hypotheses)
    plane = _lowest(_semi_global(costs, half.grey))
    plane = np.asarray(cv2.medianBlur(plane, 5), dtype=np.float32)  # matching along paths leaves streaks
    coarse = np.float32(far) + plane * np.float32(hypotheses[1] - hypotheses[0])
    size = (reference.camera.width, reference.camera.height)
    upsampled = np.asarray(cv2.resize(coarse, size, interpolation=cv2.INTER_LINEAR), dtype=np.float32)
    inverse_depth, score = _refine(
        reference, neighbours, upsampled, steps=np.array(FINE_STEPS_PX) / px_per_inverse_depth
    )
    return 1.0 / np.maximum(inverse_depth, np.float32(0.5 * far)), score


def _disparity(camera: PinholeCamera, others: Sequence[PinholeCamera], far: float, near: float) -> float:
    """Largest motion among the other images, in pixels, of what moves from far to near inverse depth.

    The median of nine pixels of the reference stands for all.
    """
    across, down = np.meshgrid(np.array([0.1, 0.5, 0.9]) * camera.width, np.array([0.1, 0.5, 0.9]) * camera.height)
    xy = np.stack([across.ravel(), down.ravel(), np.ones(9)])
    largest = _TINY
    for other in others:
        at_infinity, towards_near = _transfer(camera, other)
        ends = [at_infinity @ xy + towards_near[:, None] * inverse for inverse in (far, near)]
        start, end = (end[:2] / np.maximum(end[2], _TINY) for end in ends)
        largest = max(largest, float(np.median(np.linalg.norm(end - start, axis=0))))
    return largest


def _transfer(camera: PinholeCamera, other: PinholeCamera) -> tuple[FloatArray, FloatArray]:
    """Pixels of ``other`` from pixels of ``camera``, in array positions.

    A point at (x, y) with inverse depth d is seen by the other camera at ``M @ (x, y, 1) + d * v``
    (homogeneous; the third component is its depth there, times d). ``M`` is the homography of the
    plane at infinity, ``v`` the epipole times the calibration (Hartley and Zisserman, eq. 13.2).
    """
    rotation = other.cam_from_seg[:, :3] @ camera.cam_from_seg[:, :3].T
    translation = other.cam_from_seg[:, 3] - rotation @ camera.cam_from_seg[:, 3]
    index_from_cam = _INDEX_FROM_IMG @ other.img_from_cam
    at_infinity = index_from_cam @ rotation @ np.linalg.inv(camera.img_from_cam) @ _IMG_FROM_INDEX
    return at_infinity, index_from_cam @ translation


class _WindowNcc:
    """NCC of square windows of one image with the same windows of others; 0 where there is only noise."""

    def __init__(self, grey: FloatMap, window: int) -> None:
        self._grey = grey
        self._window = (window, window)
        self._mean = cv2.blur(grey, self._window)
        variance = cv2.blur(grey * grey, self._window) - self._mean * self._mean
        self._inverse_std = 1.0 / np.sqrt(np.maximum(variance, 0.0) + np.float32(NOISE_VARIANCE))
        self._product, self._variance = np.empty_like(grey), np.empty_like(grey)

    def __call__(self, other: FloatMap) -> FloatMap:
        """(H, W) in [-1, 1]; ``other`` is an image of the same size."""
        product, variance = self._product, self._variance
        mean = cv2.blur(other, self._window)
        np.multiply(other, other, out=product)
        cv2.blur(product, self._window, dst=variance)
        np.multiply(other, self._grey, out=product)
        ncc = np.asarray(cv2.blur(product, self._window), dtype=np.float32)  # E[ab]
        np.multiply(mean, self._mean, out=product)
        np.subtract(ncc, product, out=ncc)  # covariance
        np.multiply(ncc, self._inverse_std, out=ncc)
        np.multiply(mean, mean, out=mean)
        np.subtract(variance, mean, out=variance)
        np.maximum(variance, 0.0, out=variance)
        np.add(variance, np.float32(NOISE_VARIANCE), out=variance)
        np.sqrt(variance, out=variance)
        np.divide(ncc, variance, out=ncc)
        return ncc


def _plane_costs(reference: View, neighbours: Sequence[View], hypotheses: FloatArray) -> CostVolume:
    """(H, planes, W) cost of every plane: 0 where the best two neighbours fit perfectly, to _COST_SCALE.

    Outside a neighbour's image NCC is 0; there its mean grey stands in, because the step to black
    would attract windows that straddle the border. The best two are kept running, without a sort.
    """
    height, width = reference.grey.shape
    corners = np.array([[0, width, 0, width], [0, 0, height, height], [1, 1, 1, 1]], dtype=np.float64)
    transfers = [_transfer(reference.camera, neighbour.camera) for neighbour in neighbours]
    means = [float(neighbour.grey.mean()) for neighbour in neighbours]
    ncc_with = _WindowNcc(reference.grey, COARSE_WINDOW_PX)
    costs = np.empty((height, len(hypotheses), width), np.int16)
    warped, lesser = np.empty_like(reference.grey), np.empty_like(reference.grey)
    for i, inverse_depth in enumerate(hypotheses):
        best, second = np.zeros_like(reference.grey), np.zeros_like(reference.grey)
        for neighbour, mean, (at_infinity, towards_near) in zip(neighbours, means, transfers, strict=True):
            homography = at_infinity.copy()
            homography[:, 2] += inverse_depth * towards_near
            if (homography[2] @ corners).min() <= 0:
                continue  # part of the plane is behind this neighbour
            cv2.warpPerspective(
                neighbour.grey,
                homography,
                (width, height),
                dst=warped,
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderValue=mean,
            )
            ncc = ncc_with(warped)
            np.minimum(best, ncc, out=lesser)
            np.maximum(best, ncc, out=best)
            np.maximum(second, lesser, out=second)
        fit = best if len(neighbours) == 1 else (best + second) * np.float32(0.5)
        costs[:, i] = np.float32(_COST_SCALE) * (1.0 - fit) + np.float32(0.5)
    return costs


def _semi_global(costs: CostVolume, grey: FloatMap) -> CostVolume:
    """(H, planes, W) costs summed along the four axis-parallel paths to each pixel.

    A jump costs less across an edge of the image. Source: Hirschmueller 2008, eqs. 13 and 14.
    """
    down = _along_first_axis(costs, _jump_costs(grey))
    across = _along_first_axis(np.ascontiguousarray(costs.transpose(2, 1, 0)), _jump_costs(grey.T))
    summed: CostVolume = down + across.transpose(2, 1, 0)
    return summed


def _jump_costs(grey: FloatMap) -> npt.NDArray[np.int16]:
    """(H - 1, W) cost of a jump between each pixel and the one below."""
    costs = _JUMP_COST * _EDGE_GREY / (_EDGE_GREY + np.abs(np.diff(grey, axis=0)))
    jump: npt.NDArray[np.int16] = np.maximum(costs, _SMALL_STEP_COST + 1).astype(np.int16)
    return jump


def _along_first_axis(costs: CostVolume, jump_costs: npt.NDArray[np.int16]) -> CostVolume:
    """Sum of the path costs in both directions along axis 0 of (steps, planes, lanes).

    Both directions run in one loop, side by side, because the loop itself is the expense.
    """
    lanes = costs.shape[2]
    own = np.concatenate([costs, costs[::-1]], axis=2)
    jumps = np.concatenate([jump_costs, jump_costs[::-1]], axis=1)
    small = np.int16(_SMALL_STEP_COST)
    path = np.empty_like(own)
    path[0] = own[0]
    for i in range(1, len(own)):
        previous, current = path[i - 1], path[i]
        lowest = previous.min(axis=0)
        np.minimum(previous, lowest + jumps[i - 1], out=current)
        one_step = previous + small
        np.minimum(current[1:], one_step[:-1], out=current[1:])
        np.minimum(current[:-1], one_step[1:], out=current[:-1])
        current -= lowest  # keeps the numbers small, changes no decision
        current += own[i]
    summed: CostVolume = path[:, :, :lanes] + path[::-1, :, lanes:]
    return summed


def _lowest(costs: CostVolume) -> FloatMap:
    """(H, W) position of the lowest of (H, planes, W) costs, by a parabola through three planes."""
    index = costs.argmin(axis=1)
    inner = np.clip(index, 1, costs.shape[1] - 2)
    left, middle, right = (
        np.take_along_axis(costs, (inner + offset)[:, None], axis=1)[:, 0].astype(np.float32) for offset in (-1, 0, 1)
    )
    offset = np.where(index == inner, _parabola_peak(left, middle, right), 0.0)
    position: FloatMap = (index + offset).astype(np.float32)
    return position


def _parabola_peak(left: FloatMap, middle: FloatMap, right: FloatMap) -> FloatMap:
    """Where the parabola through values at -1, 0, 1 is extreme, at most half a step away."""
    curvature = left - 2.0 * middle + right
    safe = np.where(np.abs(curvature) > _TINY, curvature, np.float32(1.0))
    peak = np.clip(0.5 * (left - right) / safe, -0.5, 0.5)
    return np.where(np.abs(curvature) > _TINY, peak, np.float32(0.0))


def _refine(
    reference: View, neighbours: Sequence[View], inverse_depth: FloatMap, *, steps: FloatArray
) -> tuple[FloatMap, FloatMap]:
    """A better inverse depth near the given one, and its score.

    Each neighbour counts by the square of its best NCC among the hypotheses, so one that is occluded
    at a pixel is ignored there, and the same neighbours judge all hypotheses. One whose image ends
    there has no say; where none is left the score is 0.

    Args:
        inverse_depth: (H, W), the surface that the windows follow.
        steps: (S,) evenly spaced differences of inverse depth to try.
    """
    height, width = reference.grey.shape
    x, y = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
    ncc_with = _WindowNcc(reference.grey, FINE_WINDOW_PX)
    total = np.zeros((len(steps), height, width), np.float32)
    total_weight = np.zeros((height, width), np.float32)
    for neighbour in neighbours:
        at_infinity, towards_near = (m.astype(np.float32) for m in _transfer(reference.camera, neighbour.camera))
        x_other, y_other, z_other = (
            row[0] * x + (row[1] * y + row[2]) + offset * inverse_depth
            for row, offset in zip(at_infinity, towards_near, strict=True)
        )
        scale = 1.0 / np.maximum(z_other, np.float32(_TINY))
        x_other *= scale
        y_other *= scale
        # Derivatives by inverse depth; over the few pixels of the steps the path is straight.
        x_rate = (towards_near[0] - towards_near[2] * x_other) * scale
        y_rate = (towards_near[1] - towards_near[2] * y_other) * scale
        scores = np.empty_like(total)
        for i, step in enumerate(steps.astype(np.float32)):
            warped = _sampled(neighbour.grey, x_other + x_rate * step, y_other + y_rate * step)
            scores[i] = ncc_with(warped)
        weight = np.maximum(scores.max(axis=0), np.float32(_MIN_WEIGHT_NCC)) ** 2
        weight *= _sampled(neighbour.interior, x_other, y_other, interpolation=cv2.INTER_NEAREST)
        total += weight * scores
        total_weight += weight
    total /= np.maximum(total_weight, np.float32(_TINY))
    index = total.argmax(axis=0)
    inner = np.clip(index, 1, len(steps) - 2)
    left, middle, right = (np.take_along_axis(total, (inner + k)[None], axis=0)[0] for k in (-1, 0, 1))
    offset = np.where(index == inner, _parabola_peak(left, middle, right), np.float32(0.0))
    moved = (steps[0] + (index + offset) * (steps[1] - steps[0])).astype(np.float32)
    return inverse_depth + moved, total.max(axis=0)


# ------------------------------------------------------------------------- consistency
def check_consistency(
    camera: PinholeCamera,
    depth: FloatMap,
    others: Sequence[tuple[PinholeCamera, FloatMap]],
    *,
    tolerance: float,
) -> FloatMap:
    """How many other views found the same surface, at each pixel.

    Every pixel is carried into each other view and its depth compared with the one found there: a
    relative difference of up to ``tolerance`` counts 1, twice that or more counts 0, linear between.

    Args:
        camera, depth: the view to judge, (H, W) z-depth with 0 for none.
        others: camera and depth map of each other view, of any size.
        tolerance: relative.

    Returns:
        (H, W) float32 from 0 to the number of others; 0 where there is no depth.
    """
    height, width = depth.shape
    x, y = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
    agreement = np.zeros_like(depth)
    for other_camera, other_depth in others:
        at_infinity, towards_near = (m.astype(np.float32) for m in _transfer(camera, other_camera))
        x_other, y_other, z_other = (
            depth * (row[0] * x + (row[1] * y + row[2])) + offset
            for row, offset in zip(at_infinity, towards_near, strict=True)
        )
        z_other = np.maximum(z_other, np.float32(_TINY))
        found = _sampled(other_depth, x_other / z_other, y_other / z_other, interpolation=cv2.INTER_NEAREST)
        difference = np.abs(found / z_other - 1.0)
        agreement += np.clip(2.0 - difference / np.float32(tolerance), 0.0, 1.0)
    return np.where(depth > 0, agreement, np.float32(0.0))
