"""The values that cross the border of a stage, in the order in which the pipeline makes them.

Frames: ``world`` (one per model), ``seg`` (one per submodel, its own gauge), ``cam``, ``img``.
Images are numbered by their index in the collection; COLMAP ids are index + 1, everywhere.
Every value is complete and checked when it is born. The next module to read is ``pipeline``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
import numpy.typing as npt

from smust3r_colmap.geometry.arrays import FloatArray, IntArray
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.geometry.world_frame import WorldFrame


# ----------------------------------------------------------------------------- import
@dataclass(frozen=True, kw_only=True)
class ImageMask:
    """A file of the size of an image, black where the image is not to be used.

    Args:
        path: where the file lies.
        digest: hash of its content, part of the keys of the stages that look at it.
        of_alpha: it is the image itself, and its alpha is the mask.
    """

    path: Path
    digest: str
    of_alpha: bool = False


@dataclass(frozen=True, kw_only=True)
class SourceImage:
    """One usable image.

    Args:
        name: path relative to the image folder with forward slashes; the name in the COLMAP model.
        path: where the file lies.
        width, height: in pixels, after the EXIF orientation was applied.
        camera: index into ``ImageCollection.cameras``.
        digest: hash of the file's content, part of every key of a stage.
        timestamp_s: capture time, where the source has one.
        mask: what of it is to be used; None for all.
        bits: of each channel, that all images of its camera are scaled by if they have more than 8; None looks at the
            file alone.
        is_keyframe: it carries the reconstruction; others are registered to the finished model.
    """

    name: str
    path: Path
    width: int
    height: int
    camera: int
    digest: str
    timestamp_s: float | None = None
    mask: ImageMask | None = None
    bits: int | None = None
    is_keyframe: bool = True


@dataclass(frozen=True, kw_only=True)
class RejectedImage:
    """A file that was left out, and why."""

    name: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class ImageCollection:
    """All images in processing order, with the prior of each camera.

    Args:
        images: the usable ones.
        cameras: by the index that the images name; start values, unless calibrated.
        rejected: files that were left out.
        calibrated: the cameras are known and stay as they are.

    Raises:
        ValueError: two images share a name, or a camera index or size does not fit.
    """

    images: tuple[SourceImage, ...]
    cameras: tuple[Intrinsics, ...]
    rejected: tuple[RejectedImage, ...] = ()
    calibrated: bool = False

    def __post_init__(self) -> None:
        names = [image.name for image in self.images]
        if len(set(names)) != len(names):
            twice = sorted({name for name in names if names.count(name) > 1})
            raise ValueError(f"duplicate image names: {twice[:5]}")
        for image in self.images:
            if not 0 <= image.camera < len(self.cameras):
                raise ValueError(f"{image.name}: camera {image.camera} of {len(self.cameras)}")
            camera = self.cameras[image.camera]
            if (camera.width, camera.height) != (image.width, image.height):
                raise ValueError(f"{image.name}: size does not fit camera {image.camera}")

    def __len__(self) -> int:
        return len(self.images)

    @property
    def others(self) -> tuple[int, ...]:
        """Indices of the images that are no keyframes."""
        return tuple(k for k, image in enumerate(self.images) if not image.is_keyframe)

    @property
    def mask_digests(self) -> tuple[str, ...]:
        """One per image, an empty one where it has no mask; none at all where no image has one."""
        digests = tuple("" if image.mask is None else image.mask.digest for image in self.images)
        return digests if any(digests) else ()


# ----------------------------------------------------------------------- segmentation
SegmentKind = Literal["window", "cluster", "loop"]


@dataclass(frozen=True, kw_only=True)
class Segment:
    """Images that are reconstructed together.

    Args:
        index: number of the segment in the plan.
        images: indices into the collection, in order, without repeats.
        kind: ``"window"`` of a sequence, ``"cluster"`` of images that match each other, or ``"loop"``: images around
            the two ends of a loop.
    """

    index: int
    images: tuple[int, ...]
    kind: SegmentKind = "window"

    def __post_init__(self) -> None:
        if len(set(self.images)) != len(self.images) or not self.images:
            raise ValueError(f"segment {self.index}: images must be distinct and at least one")


# --------------------------------------------------------------------- reconstruction
class DenseMaps(Protocol):
    """Per-pixel geometry of the images of one submodel, read from disk when asked for.

    Position k runs over the images of the submodel. A map of H x W pixels covers the whole image,
    uniformly resized: ``x_orig = (j + 0.5) * width_orig / W``, and the same for y. H and W may
    differ between images.
    """

    def __len__(self) -> int: ...

    def pointmap_seg(self, k: int) -> npt.NDArray[np.float32]:
        """(H, W, 3) in the segment frame, NaN where there is none."""

    def depth(self, k: int) -> npt.NDArray[np.float32]:
        """(H, W) z-depth in segment units, 0 where there is none."""

    def confidence(self, k: int) -> npt.NDArray[np.float32]:
        """(H, W), at least 1; 1 means no confidence at all."""

    def rgb(self, k: int) -> npt.NDArray[np.uint8]:
        """(H, W, 3) the image at the size of the maps."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Tracks:
    """Points of a submodel seen as features of the run's database.

    Two submodels share a point when they share an (image, feature) pair.

    Args:
        points_seg: (P, 3) float64 in the segment frame.
        point_of_observation: (M,) row of ``points_seg``.
        image_of_observation: (M,) index into the collection.
        feature_of_observation: (M,) row of the image's keypoints in the database.
    """

    points_seg: FloatArray
    point_of_observation: IntArray
    image_of_observation: IntArray
    feature_of_observation: IntArray

    def __post_init__(self) -> None:
        m = self.point_of_observation.shape
        if self.points_seg.ndim != 2 or self.points_seg.shape[1] != 3:
            raise ValueError(f"Tracks: points_seg is {self.points_seg.shape}, needed (P, 3)")
        if self.image_of_observation.shape != m or self.feature_of_observation.shape != m:
            raise ValueError("Tracks: observation arrays differ in length")
        if m[0] and not 0 <= self.point_of_observation.min() <= self.point_of_observation.max() < len(self.points_seg):
            raise ValueError("Tracks: an observation names a point that does not exist")


@dataclass(frozen=True, kw_only=True)
class RunFeatures:
    """SIFT of all images of the run.

    Args:
        database: COLMAP database; image id = index + 1, images go by number, not by name.
        key: hash of what went in.
        usable: one per image of the collection, whether it has features.
        rejected: images that have none, and why.
    """

    database: Path
    key: str
    usable: tuple[bool, ...]
    rejected: tuple[RejectedImage, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class InterSegmentMatches:
    """Verified matches between features of two images; they align submodels that share no image.

    Args:
        image_a, feature_a, image_b, feature_b: (M,) each; images are indices into the collection,
            features rows of the image's keypoints.
    """

    image_a: IntArray
    feature_a: IntArray
    image_b: IntArray
    feature_b: IntArray

    def __post_init__(self) -> None:
        shapes = {self.image_a.shape, self.feature_a.shape, self.image_b.shape, self.feature_b.shape}
        if len(shapes) != 1 or self.image_a.ndim != 1:
            raise ValueError(f"InterSegmentMatches: arrays of shapes {sorted(shapes)}, needed (M,) each")


@dataclass(frozen=True, kw_only=True, eq=False)
class Submodel:
    """A connected part of a segment in a frame of its own; a node of the pose graph.

    Args:
        segment, submodel: together the name of the node.
        images: (N,) indices into the collection, ascending, all registered.
        seg_from_cam: (N, 3, 4) rigid.
        intrinsics: one per image, at the original image size.
        method: the mapping strategy that made it, in words.
        reprojection_error_px: mean over the observations; NaN where the backbone has no features.
        tracks: feature tracks, where the backbone has them.
    """

    segment: int
    submodel: int
    images: tuple[int, ...]
    seg_from_cam: FloatArray
    intrinsics: tuple[Intrinsics, ...]
    method: str
    reprojection_error_px: float
    tracks: Tracks | None

    def __post_init__(self) -> None:
        n = len(self.images)
        if self.seg_from_cam.shape != (n, 3, 4) or len(self.intrinsics) != n:
            raise ValueError(
                f"submodel {self.name}: {n} images, poses {self.seg_from_cam.shape}, {len(self.intrinsics)} intrinsics"
            )
        if list(self.images) != sorted(set(self.images)):
            raise ValueError(f"submodel {self.name}: images must ascend without repeats")
        if not np.isfinite(self.seg_from_cam).all():
            raise ValueError(f"submodel {self.name}: a pose is not finite")

    @property
    def name(self) -> str:
        """For people, such as ``3``, ``3b`` for the second submodel of segment 3, or ``3.27`` after ``3z``."""
        if self.submodel == 0:
            return str(self.segment)
        letter = chr(ord("a") + self.submodel)
        return f"{self.segment}{letter}" if letter <= "z" else f"{self.segment}.{self.submodel + 1}"


@dataclass(frozen=True, kw_only=True)
class UnregisteredImage:
    """An image of a segment that got no pose there, and why."""

    image: int
    reason: str


@dataclass(frozen=True, kw_only=True)
class SegmentReconstruction:
    """What a backbone made of one segment: any number of submodels, largest first.

    Args:
        segment: index of the segment.
        submodels: accepted submodels; empty when nothing came out.
        unregistered: images of the segment in no submodel.
        attempts: what was tried, in order, in words for people.
        metric: lengths are metres.
        warnings: why the geometry, though kept, should not be trusted.
    """

    segment: int
    submodels: tuple[Submodel, ...]
    unregistered: tuple[UnregisteredImage, ...]
    attempts: tuple[str, ...]
    metric: bool
    warnings: tuple[str, ...] = ()


# -------------------------------------------------------------------------- alignment
@dataclass(frozen=True, kw_only=True, eq=False)
class TransformEstimate:
    """A fitted ``b_from_a`` with its evidence.

    Args:
        b_from_a: the transform, in the group that was asked for or a smaller one.
        num_points: correspondences of positive weight that were offered.
        num_inliers: those within three robust standard deviations.
        rms: of the inlier residuals, in units of b (or relative, where the caller normalised).
        residual_sigma: robust standard deviation, 1.4826 times the median of the residuals within three of it.
        iterations: of the reweighting.
        stop_reason: ``"converged"`` or ``"iteration limit"``.
        information: (d, d) inverse covariance of the right perturbation ``b_from_a @ exp(delta)``,
            delta in the order of the group's tangent, rows of the residual taken as independent.
    """

    b_from_a: Transform
    num_points: int
    num_inliers: int
    rms: float
    residual_sigma: float
    iterations: int
    stop_reason: str
    information: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class SegmentAlignment:
    """An edge of the pose graph between two submodels.

    Args:
        target, source: positions in the list of all submodels of the run.
        estimate: ``target_from_source`` with its evidence.
        evidence: ``"tracks"``, ``"pointmaps"``, ``"poses"`` of the shared images' cameras, or ``"matches"``
            (matches between images).
        relative_residual: median residual divided by depth, the test of a sound edge.
        information: (d, d) inverse covariance of the right perturbation, correlated errors and the bending
            of segments included; what a pose graph may use, where the estimate's own is too sure.
        accepted: False when the edge failed a test; it is kept for the record.
        reason: why it was refused, or empty.
        fallback: why a smaller group than asked for was taken, or empty.
    """

    target: int
    source: int
    estimate: TransformEstimate
    evidence: str
    relative_residual: float
    information: FloatArray
    accepted: bool
    reason: str = ""
    fallback: str = ""


# ------------------------------------------------------------------------------ scene
@dataclass(frozen=True, kw_only=True, eq=False)
class PointCloud:
    """Coloured points without tracks.

    Args:
        xyz: (P, 3) float64. rgb: (P, 3) uint8. normals: (P, 3) float32 unit vectors, or None.
    """

    xyz: FloatArray
    rgb: npt.NDArray[np.uint8]
    normals: npt.NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        p = len(self.xyz)
        if self.xyz.shape != (p, 3) or self.rgb.shape != (p, 3) or self.rgb.dtype != np.uint8:
            raise ValueError(f"PointCloud: xyz {self.xyz.shape}, rgb {self.rgb.shape} {self.rgb.dtype}")
        if self.normals is not None and self.normals.shape != (p, 3):
            raise ValueError(f"PointCloud: normals {self.normals.shape} for {p} points")
        if not np.isfinite(self.xyz).all():
            raise ValueError("PointCloud: a coordinate is not finite")

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """One connected model: every image once, in one world frame.

    Args:
        image_indices: (N,) indices into the collection, ascending; COLMAP image id = index + 1.
        image_names: (N,) names in the model.
        camera_indices: (N,) camera of each image; COLMAP camera id = index + 1.
        cameras: intrinsics by camera index, at the original image size.
        cam_from_world: (N, 3, 4) rigid.
        points: the fused cloud, in the world frame.
        frame: what the coordinates mean outside of the scene.
        segments: names of the submodels that were stitched, the first being the world frame.
    """

    image_indices: tuple[int, ...]
    image_names: tuple[str, ...]
    camera_indices: tuple[int, ...]
    cameras: dict[int, Intrinsics]
    cam_from_world: FloatArray
    points: PointCloud
    frame: WorldFrame
    segments: tuple[str, ...]

    def __post_init__(self) -> None:
        n = len(self.image_indices)
        if len(self.image_names) != n or len(self.camera_indices) != n or self.cam_from_world.shape != (n, 3, 4):
            raise ValueError(f"Scene: {n} images, {len(self.image_names)} names, poses {self.cam_from_world.shape}")
        if list(self.image_indices) != sorted(set(self.image_indices)):
            raise ValueError("Scene: images must ascend without repeats")
        missing = set(self.camera_indices) - set(self.cameras)
        if missing:
            raise ValueError(f"Scene: no intrinsics for cameras {sorted(missing)}")

    def __len__(self) -> int:
        return len(self.image_indices)

    @property
    def metric(self) -> bool:
        """Lengths are metres."""
        return self.frame.metric


class DepthMaps(Protocol):
    """One depth map per image of a model, by image name, read from disk when asked for.

    A map of H x W pixels covers the whole original (distorted) image, uniformly resized, as in ``DenseMaps``.
    Depth is z in the camera, in units of the stitched world; an adjusted model may differ from it by a factor
    per image, see ``model_depth``.
    """

    def __contains__(self, name: str) -> bool: ...

    def depth(self, name: str) -> npt.NDArray[np.float32]:
        """(H, W) z-depth, 0 where there is none; KeyError for an image without a map."""

    def confidence(self, name: str) -> npt.NDArray[np.float32]:
        """(H, W), at least 1; 1 means no confidence at all."""


EMPTY_CLOUD = PointCloud(xyz=np.empty((0, 3)), rgb=np.empty((0, 3), np.uint8))


@dataclass(frozen=True, kw_only=True)
class CloudStatistics:
    """How a fused cloud came about.

    Args:
        voxel_size: edge of the cells that were averaged, in world units; NaN for an empty cloud.
        num_pixels: confident pixels of all maps used.
        num_samples: of these, gathered.
        num_far: samples dropped because they lie more than a million voxels from the middle.
        num_seen_once: voxels dropped because one image only saw them.
    """

    voxel_size: float
    num_pixels: int
    num_samples: int
    num_far: int
    num_seen_once: int


@dataclass(frozen=True, kw_only=True, eq=False)
class FusedScene:
    """A finished model.

    Args:
        scene: with its points.
        statistics: of the cloud; None where the points were not fused from depth maps.
    """

    scene: Scene
    statistics: CloudStatistics | None


@dataclass(frozen=True, kw_only=True)
class TriedAlignment:
    """Two submodels for which no transform was found, and why."""

    target: int
    source: int
    evidence: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class Edges:
    """All alignments of a run, accepted or not, and the pairs that gave none."""

    alignments: tuple[SegmentAlignment, ...]
    failures: tuple[TriedAlignment, ...]
