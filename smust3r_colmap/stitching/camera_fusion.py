"""One pose and one camera for every image, from all submodels that have it."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import numpy.typing as npt

from smust3r_colmap.geometry.arrays import FloatArray, IntArray
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.geometry.so3 import angles_between, nearest_rotation
from smust3r_colmap.geometry.world_frame import WorldFrame
from smust3r_colmap.products import DenseMaps, ImageCollection, PointCloud, Scene
from smust3r_colmap.segmentation.view_graph import ViewGraph
from smust3r_colmap.stitching.resection import PlacedSubmodel

MAX_DISAGREEMENT_RATIO = 5.0
"""A pose is an outlier beyond this many times the median disagreement of its two submodels. Drift that
grows along an overlap reaches two to four times its own median, and is averaged."""
MAX_GAP_IMAGES = 5
"""Missing images that do not end a run: after a few blurred frames the neighbours still overlap, but the
two sides of a loop are not neighbours."""


@dataclass(frozen=True, kw_only=True, eq=False)
class FusedCameras:
    """One pose per image of a connected part, with the disagreement of its submodels.

    Args:
        images: (N,) indices into the collection, ascending.
        cam_from_world: (N, 3, 4) rigid.
        num_submodels: (N,) submodels that support the image: the windows that hold it, else the loop submodels.
        num_dropped: (N,) of these, poses rejected as outliers.
        best_submodel: (N,) position of the submodel, among those used, where the image lies most central.
        position_spread: (N,) largest distance between two submodels' centres of the image, as a part of
            ``scene_radius``; dropped poses count too; NaN where one submodel holds the image.
        rotation_spread_deg: (N,) the same for the rotations, in degrees.
        residual_px: (N,) of the image's camera in its best submodel, see ``PlacedSubmodel``.
        scene_radius: median distance of the camera centres from their median, in world units.
    """

    images: tuple[int, ...]
    cam_from_world: FloatArray
    num_submodels: IntArray
    num_dropped: IntArray
    best_submodel: IntArray
    position_spread: FloatArray
    rotation_spread_deg: FloatArray
    residual_px: FloatArray
    scene_radius: float

    def __post_init__(self) -> None:
        n = len(self.images)
        counts = ("num_submodels", "num_dropped", "best_submodel")
        for name in (*counts, "position_spread", "rotation_spread_deg", "residual_px"):
            if getattr(self, name).shape != (n,):
                raise ValueError(f"FusedCameras: {n} images, {name} {getattr(self, name).shape}")
        if self.cam_from_world.shape != (n, 3, 4) or not np.isfinite(self.cam_from_world).all():
            raise ValueError(f"FusedCameras: {n} images, poses {self.cam_from_world.shape}, or one is not finite")


@dataclass(frozen=True, kw_only=True, eq=False)
class _ImagePoses:
    """The poses of one image; leading axis: the submodels that support it."""

    submodels: tuple[int, ...]
    world_from_cam: FloatArray  # (K, 3, 4)
    weights: FloatArray  # (K,) support weights

    def disagreement(self) -> tuple[FloatArray, FloatArray]:
        """(K, K) distances of the centres and (K, K) angles in degrees between the rotations."""
        centres, rotations = self.world_from_cam[:, :, 3], self.world_from_cam[:, :, :3]
        distances = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
        return distances, np.rad2deg(angles_between(rotations[:, None], rotations[None]))


def fuse_cameras(submodels: Sequence[PlacedSubmodel], view_graph: ViewGraph) -> FusedCameras:
    """One pose per image: centres by weighted mean, rotations by weighted chordal mean.

    The weights are the ``support_weights`` of each submodel, so through an overlap the trajectory passes
    steadily from one submodel to the next. Poses that disagree are treated in two ways. A disagreement
    near the median of these two submodels is drift, and the poses are averaged. A pose farther than
    ``MAX_DISAGREEMENT_RATIO`` times that from the weighted medoid of its image is an outlier: it is
    rejected and counted. Of three poses the medoid is the majority, of two the one of larger weight.
    Outliers can be told from drift where two submodels share at least three images. Two submodels that
    disagree on every shared image are averaged; ``position_spread`` shows it.

    Args:
        submodels: of one connected part, placed in its world.
        view_graph: the order of the images.

    Raises:
        ValueError: no submodel.

    Source: chordal mean after Hartley, Trumpf, Dai and Li, Rotation Averaging, IJCV 2013.
    """
    if not submodels:
        raise ValueError("fusion: no submodel, needed at least one")
    all_poses = _poses_by_image(submodels, view_graph)
    centres = np.concatenate([poses.world_from_cam[:, :, 3] for poses in all_poses.values()])
    radius = float(np.median(np.linalg.norm(centres - np.median(centres, axis=0), axis=1)))
    median = _median_disagreement(all_poses.values(), radius)
    kept = [_agreeing(poses, median) for poses in all_poses.values()]
    spread = [[matrix.max() for matrix in poses.disagreement()] for poses in all_poses.values()]
    alone = np.array([len(poses.submodels) == 1 for poses in all_poses.values()])
    distance, angle_deg = np.array(spread).T
    world_from_cam = np.stack(
        [
            _mean_pose(poses.world_from_cam[keep], poses.weights[keep])
            for poses, keep in zip(all_poses.values(), kept, strict=True)
        ]
    )
    best_submodel = np.array(
        [
            poses.submodels[int(np.argmax(np.where(keep, poses.weights, 0)))]
            for poses, keep in zip(all_poses.values(), kept, strict=True)
        ]
    )
    return FusedCameras(
        images=tuple(all_poses),
        cam_from_world=invert_rigid(world_from_cam),
        num_submodels=np.array([len(keep) for keep in kept]),
        num_dropped=np.array([np.count_nonzero(~keep) for keep in kept]),
        best_submodel=best_submodel,
        position_spread=np.where(alone, np.nan, distance / radius if radius > 0 else distance),
        rotation_spread_deg=np.where(alone, np.nan, angle_deg),
        residual_px=np.array(
            [
                submodels[best].residual_px[submodels[best].submodel.images.index(image)]
                for image, best in zip(all_poses, best_submodel, strict=True)
            ]
        ),
        scene_radius=radius,
    )


def support_weights(images: Sequence[int], view_graph: ViewGraph) -> FloatArray:
    """(N,) weight of each image of a submodel, in (0, 1]: falls linearly from the middle of its run to the ends.

    An image in the middle of a run has neighbours on both sides, one at its end on one side only. A
    run ends where more than ``MAX_GAP_IMAGES`` images are missing.

    Args:
        images: indices into the collection.
        view_graph: their order.
    """
    runs = view_graph.runs(images, max_steps=MAX_GAP_IMAGES + 1)
    to_end = {image: 1 + min(k, len(run) - 1 - k) for run in runs for k, image in enumerate(run)}
    return np.array([to_end[image] for image in images]) / max(to_end.values())


def supported_images(submodels: Sequence[PlacedSubmodel]) -> list[npt.NDArray[np.bool_]]:
    """Per submodel, (N,) which of its images it supports: a window all, a loop those that no window holds."""
    in_windows = {image for placed in submodels if not placed.is_loop for image in placed.submodel.images}
    return [
        np.array([not (placed.is_loop and image in in_windows) for image in placed.submodel.images], dtype=np.bool_)
        for placed in submodels
    ]


def _poses_by_image(submodels: Sequence[PlacedSubmodel], view_graph: ViewGraph) -> dict[int, _ImagePoses]:
    """Per image, ascending, its pose in each submodel that supports it."""
    found: dict[int, list[tuple[int, FloatArray, float]]] = defaultdict(list)
    for position, (placed, supported) in enumerate(zip(submodels, supported_images(submodels), strict=True)):
        weights = support_weights(placed.submodel.images, view_graph)
        for k in np.flatnonzero(supported):
            found[placed.submodel.images[k]].append((position, placed.world_from_cam[k], weights[k]))
    return {
        image: _ImagePoses(
            submodels=tuple(position for position, _, _ in found[image]),
            world_from_cam=np.stack([pose for _, pose, _ in found[image]]),
            weights=np.array([weight for _, _, weight in found[image]]),
        )
        for image in sorted(found)
    }


def _median_disagreement(all_poses: Iterable[_ImagePoses], radius: float) -> dict[tuple[int, int], tuple[float, float]]:
    """Per pair of submodels, the median distance and angle in degrees over the images they share.

    Never less than rounding: 1e-6 of the scene's radius and 1e-4 degrees.
    """
    found: dict[tuple[int, int], list[tuple[float, float]]] = defaultdict(list)
    for poses in all_poses:
        distances, angles_deg = poses.disagreement()
        for a, b in combinations(range(len(poses.submodels)), 2):
            found[poses.submodels[a], poses.submodels[b]].append((distances[a, b], angles_deg[a, b]))
    median = {}
    for pair, values in found.items():
        distance, angle_deg = np.median(values, axis=0)
        median[pair] = (max(float(distance), 1e-6 * radius), max(float(angle_deg), 1e-4))
    return median


def _agreeing(poses: _ImagePoses, median: dict[tuple[int, int], tuple[float, float]]) -> npt.NDArray[np.bool_]:
    """(K,) which poses lie near the weighted medoid, in units of the median disagreement."""
    distances, angles_deg = poses.disagreement()
    ratio = np.zeros_like(distances)
    for a, b in combinations(range(len(poses.submodels)), 2):
        median_distance, median_angle_deg = median[poses.submodels[a], poses.submodels[b]]
        by_distance = distances[a, b] / median_distance if median_distance > 0 else 0.0
        ratio[a, b] = ratio[b, a] = max(by_distance, angles_deg[a, b] / median_angle_deg)
    medoid = int(np.argmin(ratio @ poses.weights))
    agreeing: npt.NDArray[np.bool_] = ratio[medoid] <= MAX_DISAGREEMENT_RATIO
    return agreeing


def _mean_pose(world_from_cam: FloatArray, weights: FloatArray) -> FloatArray:
    """Weighted mean (3, 4) of rigid poses (K, 3, 4)."""
    mean = np.average(world_from_cam, axis=0, weights=weights)
    # The rotation nearest to the mean matrix minimises the sum of squared chordal distances.
    mean[:, :3] = nearest_rotation(mean[:, :3])
    return mean


def fuse_intrinsics(submodels: Sequence[PlacedSubmodel], camera_of_image: Sequence[int]) -> dict[int, Intrinsics]:
    """One calibration per camera: the median of each parameter over all registered images.

    A submodel counts once per supported image of the camera (``supported_images``). Where submodels
    disagree about the camera model, the model of most images is taken and the others are ignored.

    Args:
        submodels: of one connected part, intrinsics at the original image size.
        camera_of_image: camera of every image of the collection.

    Returns:
        By camera index, ascending; only cameras with a registered image.

    Raises:
        ValueError: two submodels hold one camera at different image sizes.
    """
    found: dict[int, list[Intrinsics]] = defaultdict(list)
    for placed, supported in zip(submodels, supported_images(submodels), strict=True):
        for k in np.flatnonzero(supported):
            found[camera_of_image[placed.submodel.images[k]]].append(placed.submodel.intrinsics[k])
    return {camera: _median_intrinsics(camera, found[camera]) for camera in sorted(found)}


def _median_intrinsics(camera: int, candidates: Sequence[Intrinsics]) -> Intrinsics:
    """The median of those that have the most frequent model."""
    sizes = {(candidate.width, candidate.height) for candidate in candidates}
    if len(sizes) > 1:
        raise ValueError(f"camera {camera}: submodels hold it at sizes {sorted(sizes)}, needed the original size only")
    model = Counter(candidate.model for candidate in candidates).most_common(1)[0][0]
    same = [candidate for candidate in candidates if candidate.model == model]
    params = np.median([candidate.params for candidate in same], axis=0)
    prior = all(candidate.has_prior_focal for candidate in same)
    return replace(same[0], params=tuple(params), has_prior_focal=prior)


def depth_in_cameras(
    submodels: Sequence[PlacedSubmodel], dense: Sequence[DenseMaps], cameras: FusedCameras
) -> Iterator[tuple[int, npt.NDArray[np.float32], npt.NDArray[np.float32]]]:
    """Per image its index, its depth (H, W) in world units, 0 where there is none, and its confidence (H, W).

    Each image gives its map once, from ``cameras.best_submodel``; arguments as for ``fuse_points``.
    """
    for image, best in zip(cameras.images, cameras.best_submodel, strict=True):
        k = submodels[best].submodel.images.index(image)
        depth = points_in_camera(submodels[best], dense[best], k)[..., 2]
        yield image, np.where(np.nan_to_num(depth) > 0, depth, 0).astype(np.float32), dense[best].confidence(k)


def points_in_camera(placed: PlacedSubmodel, maps: DenseMaps, k: int) -> FloatArray:
    """(H, W, 3) of image ``k`` of a submodel, moved from the segment through the world into its camera there."""
    pointmap_seg = maps.pointmap_seg(k)
    cam_from_world = invert_rigid(placed.world_from_cam[k])
    with np.errstate(invalid="ignore", divide="ignore"):  # a projective transform has a plane at infinity
        points_world = placed.world_from_seg.apply(pointmap_seg.reshape(-1, 3))
        points_cam: FloatArray = points_world @ cam_from_world[:, :3].T + cam_from_world[:, 3]
    return points_cam.reshape(pointmap_seg.shape)


def build_scene(
    collection: ImageCollection,
    submodels: Sequence[PlacedSubmodel],
    cameras: FusedCameras,
    intrinsics: dict[int, Intrinsics],
    points: PointCloud,
    *,
    frame: WorldFrame,
) -> Scene:
    """Put the fused parts together under the names of the collection.

    Args:
        collection: all images of the run.
        submodels: of this connected part; the first is the world frame. Submodels of loops are named too.
        cameras, intrinsics, points: their fused cameras, calibrations and cloud.
        frame: of the scene.
    """
    images = [collection.images[image] for image in cameras.images]
    return Scene(
        image_indices=cameras.images,
        image_names=tuple(image.name for image in images),
        camera_indices=tuple(image.camera for image in images),
        cameras=intrinsics,
        cam_from_world=cameras.cam_from_world,
        points=points,
        frame=frame,
        segments=tuple(placed.submodel.name for placed in submodels),
    )
