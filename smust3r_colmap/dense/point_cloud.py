"""From placed pieces to one scene: every image one pose, every camera one calibration, one cloud.

Pieces overlap, so most images were reconstructed twice. Their poses are averaged, calibrations are
voted on, and of the dense maps one per image is used, hung on the averaged pose so that cloud and
cameras agree. Pieces of loop segments only speak for images that no window piece holds: they are made
of two short runs of the sequence, and their work is done in the graph.
All of it takes values and returns values; maps are read one image at a time.
The next modules to read are the exporters.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import numpy.typing as npt

from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.geometry.so3 import angles_between, nearest_rotation
from smust3r_colmap.products import (
    DenseMaps,
    FloatArray,
    ImageCollection,
    IntArray,
    PointCloud,
    Scene,
)
from smust3r_colmap.stitching.resection import PlacedPiece

OUTLIER_RATIO = 5.0
"""A pose is left out beyond this many times the usual disagreement of its two pieces. Drift that grows
along an overlap reaches two to four times its own median, and is to be blended, not cut."""
SAMPLES_PER_POINT = 4
"""Pixels gathered per fused point: enough for every voxel to be an average, few enough for memory."""
FULL_ENOUGH = 0.9
"""The search for the voxel size stops between this part of ``max_points`` and all of it."""
ENOUGH_SEEN_TWICE = 0.5
"""Voxels seen by one image only are dropped where at least this part of the cloud stays."""
DEPTH_JUMP = 0.1
"""Neighbours whose depths differ by more than this part belong to two surfaces and give no normal."""
NO_NORMAL_WEIGHT = 1e-3
"""Weight of the viewing direction where a pixel has no normal: it counts where nothing else does."""
LONGEST_HOLE = 5
"""Images missing in a row that do not end a run: a few blurred frames do not take an image's
neighbours away, but the two sides of a loop are no neighbours."""

_CELL_BITS = 21  # three axes of 21 bits fill an int64 without its sign


# ---------------------------------------------------------------------------- cameras
@dataclass(frozen=True, kw_only=True, eq=False)
class FusedCameras:
    """One pose per image of a connected part, with what the pieces said about each other.

    Args:
        images: (N,) indices into the collection, ascending.
        cam_from_world: (N, 3, 4) rigid.
        num_pieces: (N,) pieces that speak for the image: the windows that hold it, else the loop pieces.
        num_dropped: (N,) of these, poses left out because they disagree with the rest.
        best_piece: (N,) position of the piece, among those used, where the image lies most central.
        position_spread: (N,) largest distance between two pieces' centres of the image, as a part of
            ``scene_radius``; dropped poses count too; NaN where one piece holds the image.
        rotation_spread_deg: (N,) the same for the rotations, in degrees.
        residual_px: (N,) of the image's camera in its best piece, see ``PlacedPiece``.
        scene_radius: median distance of the camera centres from their median, in world units.
    """

    images: tuple[int, ...]
    cam_from_world: FloatArray
    num_pieces: IntArray
    num_dropped: IntArray
    best_piece: IntArray
    position_spread: FloatArray
    rotation_spread_deg: FloatArray
    residual_px: FloatArray
    scene_radius: float

    def __post_init__(self) -> None:
        n = len(self.images)
        counts = ("num_pieces", "num_dropped", "best_piece")
        for name in (*counts, "position_spread", "rotation_spread_deg", "residual_px"):
            if getattr(self, name).shape != (n,):
                raise ValueError(f"FusedCameras: {n} images, {name} {getattr(self, name).shape}")
        if self.cam_from_world.shape != (n, 3, 4) or not np.isfinite(self.cam_from_world).all():
            raise ValueError(f"FusedCameras: {n} images, poses {self.cam_from_world.shape}, or one is not finite")


@dataclass(frozen=True, kw_only=True, eq=False)
class _Sightings:
    """What the pieces say about one image; leading axis: the pieces that hold it."""

    pieces: tuple[int, ...]
    world_from_cam: FloatArray  # (K, 3, 4)
    weights: FloatArray  # (K,) centrality

    def disagreement(self) -> tuple[FloatArray, FloatArray]:
        """(K, K) distances of the centres and (K, K) angles in degrees between the rotations."""
        centres, rotations = self.world_from_cam[:, :, 3], self.world_from_cam[:, :, :3]
        distances = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
        return distances, np.rad2deg(angles_between(rotations[:, None], rotations[None]))


def fuse_cameras(pieces: Sequence[PlacedPiece]) -> FusedCameras:
    """One pose per image: centres by weighted mean, rotations by weighted chordal mean.

    The weight is the image's ``centrality`` in each piece, so through an overlap the trajectory passes
    steadily from one piece to the next. Poses that disagree are treated in two ways. A disagreement as
    large as usual between these two pieces is drift: it is blended. A pose farther than
    ``OUTLIER_RATIO`` times that from the weighted medoid of its image is an accident of one piece: it
    is left out and counted. Of three poses the medoid is the majority, of two the more central one.
    An accident is told from drift where two pieces share at least three images; two that disagree on
    every image they share are blended all the same, and the spread tells.

    Args:
        pieces: of one connected part, placed in its world.

    Raises:
        ValueError: no piece.

    Source: chordal mean after Hartley, Trumpf, Dai and Li, Rotation Averaging, IJCV 2013.
    """
    if not pieces:
        raise ValueError("fusion: no piece, needed at least one")
    sightings = _sightings_by_image(pieces)
    centres = np.concatenate([sighting.world_from_cam[:, :, 3] for sighting in sightings.values()])
    radius = float(np.median(np.linalg.norm(centres - np.median(centres, axis=0), axis=1)))
    usual = _usual_disagreement(sightings.values(), radius)
    kept = [_agreeing(sighting, usual) for sighting in sightings.values()]
    spread = [[matrix.max() for matrix in sighting.disagreement()] for sighting in sightings.values()]
    alone = np.array([len(sighting.pieces) == 1 for sighting in sightings.values()])
    distance, angle_deg = np.array(spread).T
    world_from_cam = np.stack(
        [
            _mean_pose(sighting.world_from_cam[keep], sighting.weights[keep])
            for sighting, keep in zip(sightings.values(), kept, strict=True)
        ]
    )
    best_piece = np.array(
        [
            sighting.pieces[int(np.argmax(np.where(keep, sighting.weights, 0)))]
            for sighting, keep in zip(sightings.values(), kept, strict=True)
        ]
    )
    return FusedCameras(
        images=tuple(sightings),
        cam_from_world=invert_rigid(world_from_cam),
        num_pieces=np.array([len(keep) for keep in kept]),
        num_dropped=np.array([np.count_nonzero(~keep) for keep in kept]),
        best_piece=best_piece,
        position_spread=np.where(alone, np.nan, distance / radius if radius > 0 else distance),
        rotation_spread_deg=np.where(alone, np.nan, angle_deg),
        residual_px=np.array(
            [
                pieces[best].residual_px[pieces[best].piece.images.index(image)]
                for image, best in zip(sightings, best_piece, strict=True)
            ]
        ),
        scene_radius=radius,
    )


def centrality(images: Sequence[int]) -> FloatArray:
    """(N,) weight of each image of a piece, in (0, 1]: falls linearly from the middle of its run to the ends.

    An image in the middle of a run has neighbours on both sides, one at its end on one side only. A
    run ends where more than ``LONGEST_HOLE`` images are missing.

    Args:
        images: indices into the collection, ascending.
    """
    ends = np.flatnonzero(np.diff(images) > LONGEST_HOLE + 1) + 1
    runs = [np.arange(len(run)) for run in np.split(np.asarray(images), ends)]
    to_end = np.concatenate([np.minimum(run, run[::-1]) + 1 for run in runs])
    weights: FloatArray = to_end / to_end.max()
    return weights


def speaking_images(pieces: Sequence[PlacedPiece]) -> list[npt.NDArray[np.bool_]]:
    """Per piece, (N,) for which of its images it counts: all of a window's, of a loop's those no window holds."""
    in_windows = {image for placed in pieces if not placed.is_loop for image in placed.piece.images}
    return [
        np.array([not (placed.is_loop and image in in_windows) for image in placed.piece.images], dtype=np.bool_)
        for placed in pieces
    ]


def _sightings_by_image(pieces: Sequence[PlacedPiece]) -> dict[int, _Sightings]:
    """Per image, ascending, what each piece that speaks for it says."""
    found: dict[int, list[tuple[int, FloatArray, float]]] = defaultdict(list)
    for position, (placed, speaks) in enumerate(zip(pieces, speaking_images(pieces), strict=True)):
        weights = centrality(placed.piece.images)
        for k in np.flatnonzero(speaks):
            found[placed.piece.images[k]].append((position, placed.world_from_cam[k], weights[k]))
    return {
        image: _Sightings(
            pieces=tuple(position for position, _, _ in found[image]),
            world_from_cam=np.stack([pose for _, pose, _ in found[image]]),
            weights=np.array([weight for _, _, weight in found[image]]),
        )
        for image in sorted(found)
    }


def _usual_disagreement(sightings: Iterable[_Sightings], radius: float) -> dict[tuple[int, int], tuple[float, float]]:
    """Per pair of pieces, the median distance and angle in degrees over the images they share.

    Never less than rounding: 1e-6 of the scene's radius and 1e-4 degrees.
    """
    found: dict[tuple[int, int], list[tuple[float, float]]] = defaultdict(list)
    for sighting in sightings:
        distances, angles_deg = sighting.disagreement()
        for a, b in combinations(range(len(sighting.pieces)), 2):
            found[sighting.pieces[a], sighting.pieces[b]].append((distances[a, b], angles_deg[a, b]))
    usual = {}
    for pair, values in found.items():
        distance, angle_deg = np.median(values, axis=0)
        usual[pair] = (max(float(distance), 1e-6 * radius), max(float(angle_deg), 1e-4))
    return usual


def _agreeing(sighting: _Sightings, usual: dict[tuple[int, int], tuple[float, float]]) -> npt.NDArray[np.bool_]:
    """(K,) which poses lie near the weighted medoid, in units of the usual disagreement."""
    distances, angles_deg = sighting.disagreement()
    ratio = np.zeros_like(distances)
    for a, b in combinations(range(len(sighting.pieces)), 2):
        usual_distance, usual_angle_deg = usual[sighting.pieces[a], sighting.pieces[b]]
        by_distance = distances[a, b] / usual_distance if usual_distance > 0 else 0.0
        ratio[a, b] = ratio[b, a] = max(by_distance, angles_deg[a, b] / usual_angle_deg)
    medoid = int(np.argmin(ratio @ sighting.weights))
    agreeing: npt.NDArray[np.bool_] = ratio[medoid] <= OUTLIER_RATIO
    return agreeing


def _mean_pose(world_from_cam: FloatArray, weights: FloatArray) -> FloatArray:
    """Weighted mean (3, 4) of rigid poses (K, 3, 4)."""
    mean = np.average(world_from_cam, axis=0, weights=weights)
    # The rotation nearest to the mean matrix minimises the sum of squared chordal distances.
    mean[:, :3] = nearest_rotation(mean[:, :3])
    return mean


# ------------------------------------------------------------------------- intrinsics
def fuse_intrinsics(pieces: Sequence[PlacedPiece], camera_of_image: Sequence[int]) -> dict[int, Intrinsics]:
    """One calibration per camera: the median of each parameter over all registered images.

    A piece counts as often as it speaks for an image of the camera (``speaking_images``). Where pieces
    disagree about the camera model, the model of most images is taken and the others have no say.

    Args:
        pieces: of one connected part, intrinsics at the original image size.
        camera_of_image: camera of every image of the collection.

    Returns:
        By camera index, ascending; only cameras with a registered image.

    Raises:
        ValueError: two pieces hold one camera at different image sizes.
    """
    found: dict[int, list[Intrinsics]] = defaultdict(list)
    for placed, speaks in zip(pieces, speaking_images(pieces), strict=True):
        for k in np.flatnonzero(speaks):
            found[camera_of_image[placed.piece.images[k]]].append(placed.piece.intrinsics[k])
    return {camera: _median_intrinsics(camera, found[camera]) for camera in sorted(found)}


def _median_intrinsics(camera: int, candidates: Sequence[Intrinsics]) -> Intrinsics:
    """The median of those that have the most frequent model."""
    sizes = {(candidate.width, candidate.height) for candidate in candidates}
    if len(sizes) > 1:
        raise ValueError(f"camera {camera}: pieces hold it at sizes {sorted(sizes)}, needed the original size only")
    model = Counter(candidate.model for candidate in candidates).most_common(1)[0][0]
    same = [candidate for candidate in candidates if candidate.model == model]
    params = np.median([candidate.params for candidate in same], axis=0)
    prior = all(candidate.has_prior_focal for candidate in same)
    return replace(same[0], params=tuple(params), has_prior_focal=prior)


# ----------------------------------------------------------------------------- points
@dataclass(frozen=True, kw_only=True, eq=False)
class FusedPoints:
    """The cloud of a connected part, with what became of the pixels.

    Args:
        cloud: in the world frame, with normals.
        voxel_size: edge of the cells that were averaged, in world units; NaN for an empty cloud.
        num_pixels: confident pixels of all maps used.
        num_samples: of these, gathered.
        num_far: samples dropped because they lie more than a million voxels from the middle.
        num_seen_once: voxels dropped because one image only saw them.
    """

    cloud: PointCloud
    voxel_size: float
    num_pixels: int
    num_samples: int
    num_far: int
    num_seen_once: int


@dataclass(frozen=True, kw_only=True, eq=False)
class _Samples:
    """Pixels in space, ordered by image; positions relative to an origin so that float32 holds them."""

    xyz: npt.NDArray[np.float32]  # (S, 3)
    normals: npt.NDArray[np.float32]  # (S, 3), length 1, or NO_NORMAL_WEIGHT where unknown
    rgb: npt.NDArray[np.uint8]  # (S, 3)
    image: npt.NDArray[np.int32]  # (S,)

    def __len__(self) -> int:
        return len(self.xyz)

    @classmethod
    def joined(cls, parts: Sequence[_Samples]) -> _Samples:
        return cls(
            xyz=np.concatenate([part.xyz for part in parts]),
            normals=np.concatenate([part.normals for part in parts]),
            rgb=np.concatenate([part.rgb for part in parts]),
            image=np.concatenate([part.image for part in parts]),
        )

    def selected(self, rows: npt.NDArray[np.bool_]) -> _Samples:
        return _Samples(xyz=self.xyz[rows], normals=self.normals[rows], rgb=self.rgb[rows], image=self.image[rows])


@dataclass(frozen=True, kw_only=True, eq=False)
class _MapSamples:
    """Of the confident pixels of one map some that are evenly spread, in its camera's axes and in world units."""

    points_cam: FloatArray  # (M, 3)
    normals_cam: FloatArray  # (M, 3)
    rgb: npt.NDArray[np.uint8]  # (M, 3)
    spacing: float  # usual distance of neighbouring confident pixels, NaN where there are none
    num_pixels: int  # confident ones

    def in_world(self, image: int, world_from_cam: FloatArray, origin: FloatArray) -> _Samples:
        """Turned into the world and moved by ``-origin``."""
        rotation, centre = world_from_cam[:, :3], world_from_cam[:, 3]
        return _Samples(
            xyz=(self.points_cam @ rotation.T + (centre - origin)).astype(np.float32),
            normals=(self.normals_cam @ rotation.T).astype(np.float32),
            rgb=self.rgb,
            image=np.full(len(self.points_cam), image, dtype=np.int32),
        )


def fuse_points(
    pieces: Sequence[PlacedPiece],
    dense: Sequence[DenseMaps],
    cameras: FusedCameras,
    *,
    max_points: int,
    min_confidence: float,
    depth_scale: FloatArray | None = None,
) -> FusedPoints:
    """The confident pixels of all maps as one cloud, averaged over the cells of a regular grid.

    Each image gives its map once, from ``cameras.best_piece``. The pointmap goes into the world by the
    piece's transform, into the camera by the pose that the piece itself placed there, and back into
    the world by the *fused* pose. For maps that are depth unprojected, under a similarity, this is depth
    times scale along the rays of the piece's own intrinsics (those made the depth, the fused ones did
    not); maps that carry more than depth keep it, and a transform that bends them bends the cloud.

    Cells start at the usual distance of neighbouring pixels and grow until ``max_points`` suffice.
    Cells that one image only saw are dropped where at least half of the cloud stays. Normals come from
    neighbouring pixels, face the camera, and are averaged; where no pixel of a cell has one (rims,
    depth jumps) the normal points to the cameras. The result depends on nothing but the arguments.

    Memory: about 100 bytes x ``SAMPLES_PER_POINT`` x ``max_points``, and one image's maps.

    Args:
        pieces, dense: one each, of one connected part.
        cameras: ``fuse_cameras`` of the same pieces.
        max_points: upper bound of the cloud, at least 1.
        min_confidence: pixels below are left out.
        depth_scale: (N,) what each image's map is multiplied with, where the cameras were adjusted since; 1 if
            not given.

    Raises:
        ValueError: numbers of pieces and maps differ, or ``max_points`` is below 1.
    """
    if len(pieces) != len(dense):
        raise ValueError(f"fusion: {len(pieces)} pieces and {len(dense)} sets of maps; needed one each")
    if max_points < 1:
        raise ValueError(f"max_points is {max_points}, needed at least 1")
    quota = -(-SAMPLES_PER_POINT * max_points // len(cameras.images))
    origin = np.median(invert_rigid(cameras.cam_from_world)[:, :, 3], axis=0)
    samples, spacing, num_pixels = _gathered(
        pieces,
        dense,
        cameras,
        np.ones(len(cameras.images)) if depth_scale is None else depth_scale,
        origin=origin,
        quota=quota,
        min_confidence=min_confidence,
    )
    if not len(samples):
        return FusedPoints(
            cloud=PointCloud(
                xyz=np.empty((0, 3)), rgb=np.empty((0, 3), np.uint8), normals=np.empty((0, 3), np.float32)
            ),
            voxel_size=np.nan,
            num_pixels=0,
            num_samples=0,
            num_far=0,
            num_seen_once=0,
        )
    near = _within_reach(samples.xyz, spacing)
    nearby = samples if near.all() else samples.selected(near)
    voxel_size = _voxel_size(nearby.xyz, spacing, max_points)
    cloud, num_seen_once = _averaged(nearby, _cells(nearby.xyz, voxel_size), origin)
    return FusedPoints(
        cloud=cloud,
        voxel_size=voxel_size,
        num_pixels=num_pixels,
        num_samples=len(samples),
        num_far=len(samples) - len(nearby),
        num_seen_once=num_seen_once,
    )


def surface_normals(points_cam: FloatArray, rows: IntArray, columns: IntArray) -> FloatArray:
    """Normals (M, 3) at pixels (M,) of a pointmap (H, W, 3) in the camera frame, facing the camera.

    The cross product of the central differences along both axes, one-sided at the rim. Length 1; a
    viewing direction of length ``NO_NORMAL_WEIGHT`` where a neighbour is NaN or across a depth jump.
    """
    last_row, last_column = points_cam.shape[0] - 1, points_cam.shape[1] - 1
    left, right = np.maximum(columns - 1, 0), np.minimum(columns + 1, last_column)
    above, below = np.maximum(rows - 1, 0), np.minimum(rows + 1, last_row)
    here = points_cam[rows, columns]
    with np.errstate(invalid="ignore", divide="ignore"):
        along_x = points_cam[rows, right] - points_cam[rows, left]
        along_y = points_cam[below, columns] - points_cam[above, columns]
        normals = _unit(np.cross(along_x, along_y))
        away = np.einsum("mi,mi->m", normals, here) > 0
        normals[away] *= -1
        steps = np.maximum(np.abs(along_x[:, 2]), np.abs(along_y[:, 2]))
        known = _finite(normals) & (steps <= DEPTH_JUMP * here[:, 2])
        return np.where(known[:, None], normals, -NO_NORMAL_WEIGHT * _unit(here))


def _unit(vectors: FloatArray) -> FloatArray:
    unit: FloatArray = vectors / _lengths(vectors)[..., None]
    return unit


def _lengths(vectors: FloatArray) -> FloatArray:
    """(...) of vectors (..., 3); numpy's norm takes several times as long along so short an axis."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    return np.asarray(np.sqrt(x * x + y * y + z * z))


def _finite(vectors: FloatArray) -> npt.NDArray[np.bool_]:
    """(...) for which vectors (..., 3) all coordinates are finite."""
    x, y, z = np.moveaxis(np.isfinite(vectors), -1, 0)
    return np.asarray(x & y & z)


def depth_in_cameras(
    pieces: Sequence[PlacedPiece], dense: Sequence[DenseMaps], cameras: FusedCameras
) -> Iterator[tuple[int, npt.NDArray[np.float32], npt.NDArray[np.float32]]]:
    """Per image its index, its depth (H, W) in world units, 0 where there is none, and its confidence (H, W).

    Each image gives its map once, from ``cameras.best_piece``; arguments as for ``fuse_points``.
    """
    for image, best in zip(cameras.images, cameras.best_piece, strict=True):
        k = pieces[best].piece.images.index(image)
        depth = _points_in_camera(pieces[best], dense[best], k)[..., 2]
        yield image, np.where(np.nan_to_num(depth) > 0, depth, 0).astype(np.float32), dense[best].confidence(k)


def _points_in_camera(placed: PlacedPiece, maps: DenseMaps, k: int) -> FloatArray:
    """(H, W, 3) of image ``k`` of a piece, moved from the segment through the world into its camera there."""
    pointmap_seg = maps.pointmap_seg(k)
    cam_from_world = invert_rigid(placed.world_from_cam[k])
    with np.errstate(invalid="ignore", divide="ignore"):  # a projective transform has a plane at infinity
        points_world = placed.world_from_seg.apply(pointmap_seg.reshape(-1, 3))
        points_cam: FloatArray = points_world @ cam_from_world[:, :3].T + cam_from_world[:, 3]
    return points_cam.reshape(pointmap_seg.shape)


def _sampled(
    placed: PlacedPiece, maps: DenseMaps, k: int, depth_scale: float, *, min_confidence: float, quota: int
) -> _MapSamples:
    """At most ``quota`` confident pixels of image ``k`` of a piece."""
    points_cam = _points_in_camera(placed, maps, k) * depth_scale
    with np.errstate(invalid="ignore"):
        confident = _finite(points_cam) & (maps.confidence(k) >= min_confidence) & (points_cam[..., 2] > 0)
        to_neighbour = _lengths(np.diff(points_cam, axis=1)[confident[:, 1:]])
    to_neighbour = to_neighbour[np.isfinite(to_neighbour)]
    pixels = np.flatnonzero(confident)
    count = min(quota, len(pixels))
    rows, columns = np.divmod(pixels[np.arange(count) * len(pixels) // max(count, 1)], points_cam.shape[1])
    return _MapSamples(
        points_cam=points_cam[rows, columns],
        normals_cam=surface_normals(points_cam, rows, columns),
        rgb=maps.rgb(k)[rows, columns],
        spacing=float(np.median(to_neighbour)) if len(to_neighbour) else np.nan,
        num_pixels=len(pixels),
    )


def _gathered(
    pieces: Sequence[PlacedPiece],
    dense: Sequence[DenseMaps],
    cameras: FusedCameras,
    depth_scale: FloatArray,
    *,
    origin: FloatArray,
    quota: int,
    min_confidence: float,
) -> tuple[_Samples, float, int]:
    """Samples of all images, the usual distance of neighbouring pixels, and the number of pixels."""
    parts, spacings, num_pixels = [], [], 0
    world_from_cam = invert_rigid(cameras.cam_from_world)
    each = zip(cameras.images, cameras.best_piece, depth_scale, world_from_cam, strict=True)
    for image, best, scale, pose in each:
        k = pieces[best].piece.images.index(image)
        sampled = _sampled(pieces[best], dense[best], k, float(scale), min_confidence=min_confidence, quota=quota)
        parts.append(sampled.in_world(image, pose, origin))
        spacings += [sampled.spacing] if np.isfinite(sampled.spacing) else []
        num_pixels += sampled.num_pixels
    samples = _Samples.joined(parts)
    spacing = float(np.median(spacings)) if spacings else 0.0
    if spacing == 0 and len(samples):  # maps one pixel wide, or all pixels in one place
        spacing = float(np.ptp(samples.xyz, axis=0).max()) * 2.0 ** (1 - _CELL_BITS) or 1.0
    return samples, spacing, num_pixels


def _within_reach(xyz: npt.NDArray[np.float32], spacing: float) -> npt.NDArray[np.bool_]:
    """(S,) which samples a grid of the finest cells around the middle can number."""
    reach = spacing * 2 ** (_CELL_BITS - 1)
    near: npt.NDArray[np.bool_] = (np.abs(xyz - np.median(xyz, axis=0)) < reach).all(axis=-1)
    return near


def _cells(xyz: npt.NDArray[np.float32], voxel_size: float) -> IntArray:
    """(S,) one number per cell of a grid that starts at the lowest corner."""
    x, y, z = (((along - along.min()) / np.float64(voxel_size)).astype(np.int64) for along in xyz.T)
    cells: IntArray = (x << 2 * _CELL_BITS) | (y << _CELL_BITS) | z
    return cells


def _num_occupied(xyz: npt.NDArray[np.float32], voxel_size: float) -> int:
    """Cells that hold a sample. Sorting takes a fiftieth of the time of ``np.unique``, which hashes."""
    cells = np.sort(_cells(xyz, voxel_size))
    return int(np.count_nonzero(np.diff(cells))) + 1


def _voxel_size(xyz: npt.NDArray[np.float32], finest: float, max_points: int) -> float:
    """The smallest size, not below ``finest``, at which at most ``max_points`` cells are occupied.

    Found by growing, then halving the bracket, to within ``FULL_ENOUGH`` or 2 percent of the size.
    """
    too_small, size = finest, finest
    count = _num_occupied(xyz, size)
    while count > max_points:
        too_small = size
        size *= 1.05 * np.sqrt(count / max_points)  # a surface occupies cells as size ** -2
        count = _num_occupied(xyz, size)
    while count < FULL_ENOUGH * max_points and size > 1.02 * too_small:
        middle = float(np.sqrt(too_small * size))
        count_middle = _num_occupied(xyz, middle)
        if count_middle > max_points:
            too_small = middle
        else:
            size, count = middle, count_middle
    return float(size)


def _averaged(samples: _Samples, cells: IntArray, origin: FloatArray) -> tuple[PointCloud, int]:
    """One point per cell, by rising cell number, and how many cells were dropped as seen once."""
    order = np.argsort(cells, kind="stable")
    starts = np.flatnonzero(np.diff(cells[order], prepend=-1))
    ends = np.append(starts[1:], len(order))
    # Samples are ordered by image and the sort is stable, so first and last tell of a second image.
    seen_twice = samples.image[order[starts]] != samples.image[order[ends - 1]]
    kept = seen_twice if seen_twice.mean() >= ENOUGH_SEEN_TWICE else np.ones_like(seen_twice)

    def sums(values: npt.NDArray[np.float32] | npt.NDArray[np.uint8]) -> FloatArray:
        columns = [np.add.reduceat(column[order].astype(np.float64), starts)[kept] for column in values.T]
        return np.column_stack(columns)

    counts = (ends - starts)[kept, None]
    normals = sums(samples.normals)
    cancelled = np.linalg.norm(normals, axis=1) < NO_NORMAL_WEIGHT / 2  # thin walls seen from both sides
    normals[cancelled] = samples.normals[order[starts[kept][cancelled]]]
    cloud = PointCloud(
        xyz=origin + sums(samples.xyz) / counts,
        rgb=np.rint(sums(samples.rgb) / counts).astype(np.uint8),
        normals=_unit(normals).astype(np.float32),
    )
    return cloud, int(np.count_nonzero(~kept))


# ------------------------------------------------------------------------------ scene
def build_scene(
    collection: ImageCollection,
    pieces: Sequence[PlacedPiece],
    cameras: FusedCameras,
    intrinsics: dict[int, Intrinsics],
    points: PointCloud,
    *,
    metric: bool,
) -> Scene:
    """Put the fused parts together under the names of the collection.

    Args:
        collection: all images of the run.
        pieces: of this connected part; the first is the world frame. Pieces of loops are named too.
        cameras, intrinsics, points: what the three fusions made of them.
        metric: lengths are metres.
    """
    images = [collection.images[image] for image in cameras.images]
    return Scene(
        image_indices=cameras.images,
        image_names=tuple(image.name for image in images),
        camera_indices=tuple(image.camera for image in images),
        cameras=intrinsics,
        cam_from_world=cameras.cam_from_world,
        points=points,
        metric=metric,
        segments=tuple(placed.piece.name for placed in pieces),
    )
