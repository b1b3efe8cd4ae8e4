"""A simulated backbone: every segment as a network would give it, from a scene with ground truth.

    truth = TrueScene.from_demo(200, 72, 96)
    backbone = SimulatedBackbone(truth, collection_of(truth), PRESETS["network"], seed=0)
    graph = ViewGraph.chain(200)
    windows = plan_windows(graph, segment_length=60, overlap=30)
    result = backbone.reconstruct(windows, graph, with_maps=range(6))

Everything stays in memory; maps are made when they are read. The errors of a segment depend on the seed, its images and
its kind alone. The next module to read is ``truth``.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from smust3r_colmap.backbones.base import BackboneResult
from smust3r_colmap.errors import CollectionError, DegenerateAlignmentError
from smust3r_colmap.geometry.arrays import Float32Array, FloatArray
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres, pointmap_from_depth
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.products import (
    ImageCollection,
    Segment,
    SegmentReconstruction,
    Submodel,
    UnregisteredImage,
)
from smust3r_colmap.segmentation.view_graph import ViewGraph
from smust3r_colmap.storage.run_directory import key_of
from smust3r_colmap.synthetic.descriptors import (
    NO_OVERLAP,
    FalseLoop,
    choose_false_loops,
    descriptors_of,
    made_alike,
    overlap_matrix,
    with_noise,
)
from smust3r_colmap.synthetic.distortion import (
    DepthError,
    bent_path,
    chain_steps,
    confidence_of,
    depth_error,
    drift_steps,
    homogeneous,
    random_gauge,
    random_warp,
    smooth_coefficients,
    warped_cameras,
    warped_points,
)
from smust3r_colmap.synthetic.settings import SimulationSettings
from smust3r_colmap.synthetic.truth import TrueScene

_FALSE_LOOPS, _DESCRIPTORS, _CHAIN, _SEGMENT, _IMAGE = range(5)
"""Streams of random numbers of one seed, so that no setting changes what another one draws."""
RAYS_ACROSS = (8, 6)
"""Columns and rows of the rays by which a rigid camera is fitted to a warped scene."""
MIN_IMAGES = 2
"""Of a submodel; one image has no baseline."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SimulatedGeometry:
    """All errors of one submodel but those of single pixels, with what they are errors of.

    Args:
        seg_from_world: (N, 4, 4) the similarity by which image k's surroundings were put into the segment,
            before the warp; all equal in a submodel that does not bend.
        warp: (4, 4) of the segment frame, the identity where none was asked for.
        focal_factor: estimated over true focal length.
        smooth: (N, M) coefficients of the smooth depth error.
        false_loop: the two halves of this loop segment are placed on each other although they have nothing in common.
    """

    seg_from_world: FloatArray
    warp: FloatArray
    focal_factor: float
    smooth: FloatArray
    false_loop: bool

    @property
    def is_warped(self) -> bool:
        """The segment frame is more than a similarity away from the world."""
        return not np.array_equal(self.warp, np.eye(4))


class SimulatedMaps:
    """``DenseMaps`` of one submodel, made when they are read; only the last image is kept.

    Args:
        truth: what is simulated from.
        submodel: whose maps these are.
        geometry: its errors.
        settings: the errors of pixels.
        seed_words: of the random numbers of this submodel.
    """

    def __init__(
        self,
        truth: TrueScene,
        submodel: Submodel,
        geometry: SimulatedGeometry,
        settings: SimulationSettings,
        seed_words: Sequence[int],
    ) -> None:
        self.submodel, self.geometry = submodel, geometry
        self._truth, self._settings, self._seed_words = truth, settings, tuple(seed_words)
        self._last: tuple[int, _SimulatedMaps] | None = None

    def __len__(self) -> int:
        return len(self.submodel.images)

    def pointmap_seg(self, k: int) -> Float32Array:
        """(H, W, 3): the depth seen by the submodel's camera, or the warped points where a warp was asked for."""
        pointmap_seg: Float32Array = self._maps(k).pointmap_seg.copy()
        return pointmap_seg

    def depth(self, k: int) -> Float32Array:
        """(H, W) z-depth in segment units, 0 where there is none."""
        depth: Float32Array = self._maps(k).depth.copy()
        return depth

    def confidence(self, k: int) -> Float32Array:
        """(H, W) at least 1, exactly 1 where there is no depth."""
        confidence: Float32Array = self._maps(k).confidence.copy()
        return confidence

    def rgb(self, k: int) -> npt.NDArray[np.uint8]:
        """(H, W, 3) the true image."""
        rgb: npt.NDArray[np.uint8] = self._truth.rgb(self.submodel.images[k]).copy()
        return rgb

    def true_cameras(self, images: Sequence[int]) -> FloatArray:
        """(M, 3, 4) ``world_from_cam`` of images of the collection."""
        return self._truth.world_from_cam[list(images)]

    def _maps(self, k: int) -> _SimulatedMaps:
        if not 0 <= k < len(self):
            raise IndexError(f"submodel {self.submodel.name}: image {k} of {len(self)}")
        last = self._last
        if last is None or last[0] != k:
            last = self._last = (k, self._simulate(k))
        return last[1]

    def _simulate(self, k: int) -> _SimulatedMaps:
        true_depth = self._truth.depth(self.submodel.images[k])
        height, width = true_depth.shape
        rng = np.random.default_rng((*self._seed_words, _IMAGE, k))
        error = depth_error(height, width, self.geometry.smooth[k], self._settings, rng)
        confidence = confidence_of(error.known, self._settings.confidence_noise, rng)
        depth = self._segment_depth(k, true_depth, error)
        intrinsics = self.submodel.intrinsics[k].resized(width, height)
        if self.geometry.is_warped:
            depth, pointmap = self._warped(k, depth, intrinsics)
        else:
            pointmap = pointmap_from_depth(depth, intrinsics, self.submodel.seg_from_cam[k])
        confidence[depth <= 0] = 1.0
        return _SimulatedMaps(depth=depth, pointmap_seg=pointmap, confidence=confidence)

    def _segment_depth(self, k: int, true_depth: Float32Array, error: DepthError) -> Float32Array:
        """(H, W) the true depth with all its errors in segment units; an over-long focal length deepens it."""
        scale = np.cbrt(np.linalg.det(self.geometry.seg_from_world[k, :3, :3]))
        return np.asarray(true_depth * error.factor * scale * self.geometry.focal_factor, dtype=np.float32)

    def _warped(self, k: int, depth: Float32Array, intrinsics: Intrinsics) -> tuple[Float32Array, Float32Array]:
        """Depth and pointmap after the warp: where the points go, and how deep the fitted camera sees them."""
        camera = self._truth.world_from_cam[self.submodel.images[k]]
        unwarped = _rigid_parts(self.geometry.seg_from_world[k] @ homogeneous(camera))
        points = warped_points(self.geometry.warp, pointmap_from_depth(depth, intrinsics, unwarped).astype(np.float64))
        cam_from_seg = invert_rigid(self.submodel.seg_from_cam[k])
        z = points @ cam_from_seg[2, :3] + cam_from_seg[2, 3]
        seen = np.isfinite(z) & (z > 0)
        pointmap = np.where(seen[..., None], points, np.nan).astype(np.float32)
        return np.where(seen, z, 0.0).astype(np.float32), pointmap


@dataclass(frozen=True, kw_only=True, eq=False)
class _SimulatedMaps:
    depth: Float32Array
    pointmap_seg: Float32Array
    confidence: Float32Array


class SimulatedBackbone:
    """``Backbone`` that knows the truth and disturbs it by stated amounts.

    A segment gives one submodel. A window comes out right up to its errors, and so does a loop segment
    whose halves (the images before and after the largest gap in its numbers) share some surface. Halves
    that share none, or less than they seem to by a false loop, are laid onto each other as if they were
    one place, in a confident, plausible and wrong relative pose: the mistake of a network that is shown
    two look-alike places.

    Args:
        truth: what is simulated from.
        collection: its images, in the same order; they may be larger than the maps.
        settings: all amounts.
        seed: of all random numbers.

    Raises:
        CollectionError: the collection has other images than the truth.
    """

    name = "simulated"
    has_tracks = False

    def __init__(
        self, truth: TrueScene, collection: ImageCollection, settings: SimulationSettings, seed: int = 0
    ) -> None:
        names = tuple(image.name for image in collection.images)
        if names != truth.names:
            first = next((pair for pair in zip(names, truth.names, strict=False) if pair[0] != pair[1]), None)
            where = f"; the first that differ are {first[0]} and {first[1]}" if first else ""
            raise CollectionError(f"{len(names)} images in the collection, {len(truth)} known exactly{where}")
        self.truth, self.collection, self.settings, self.seed = truth, collection, settings, seed
        self.metric = truth.metric

    def describe(self) -> npt.NDArray[np.float32]:
        """(N, D) descriptors of unit length; see ``descriptors``."""
        descriptors: Float32Array = self._descriptors.copy()
        return descriptors

    def reconstruct(
        self, segments: Sequence[Segment], view_graph: ViewGraph, *, with_maps: Collection[int]
    ) -> BackboneResult:
        """All segments; see ``Backbone``. Every submodel has maps, whatever ``with_maps``: unread they cost nothing."""
        del view_graph, with_maps
        made = [self._segment(segment) for segment in segments]
        return BackboneResult(
            reconstructions=tuple(reconstruction for reconstruction, _ in made),
            dense=tuple(maps for _, maps in made if maps is not None),
            dense_key=key_of("simulated", self.truth.digest, self.settings, self.seed, segments),
            matches=None,
            rejected=(),
        )

    @cached_property
    def overlap(self) -> FloatArray:
        """(N, N) true overlap of every pair of images, from 0 to 1; see ``descriptors.overlap_matrix``."""
        return overlap_matrix(self.truth)

    @cached_property
    def false_loops(self) -> tuple[FalseLoop, ...]:
        """The places that look alike although they share nothing.

        Raises:
            ConfigError: the scene does not have as many as the settings want.
        """
        return choose_false_loops(self.overlap, self.settings, np.random.default_rng((self.seed, _FALSE_LOOPS)))

    @cached_property
    def _descriptors(self) -> npt.NDArray[np.float32]:
        rng = np.random.default_rng((self.seed, _DESCRIPTORS))
        honest = descriptors_of(self.truth, self.overlap, rng)
        return with_noise(made_alike(honest, self.false_loops), self.settings.descriptor_noise, rng)

    # ------------------------------------------------------------------------- one segment
    def _segment(self, segment: Segment) -> tuple[SegmentReconstruction, SimulatedMaps | None]:
        seed_words = self._seed_words(segment)
        rng = np.random.default_rng((*seed_words, _SEGMENT))
        fails = rng.random() < self.settings.failed_share
        kept = rng.random(len(segment.images)) >= self.settings.dropped_share
        images = tuple(np.array(sorted(segment.images))[kept].tolist())
        if fails or len(images) < MIN_IMAGES:
            return self._nothing(segment), None
        geometry = self._geometry(segment, images, rng)
        submodel = self._submodel(segment, images, geometry)
        reconstruction = SegmentReconstruction(
            segment=segment.index,
            submodels=(submodel,),
            unregistered=tuple(
                UnregisteredImage(image=image, reason="the simulation drops images")
                for image in sorted(set(segment.images) - set(images))
            ),
            attempts=(submodel.method,),
            metric=self.metric,
        )
        return reconstruction, SimulatedMaps(self.truth, submodel, geometry, self.settings, seed_words)

    def _seed_words(self, segment: Segment) -> tuple[int, ...]:
        """What the random numbers of a segment start from: the seed, its images and its kind, not its index."""
        text = f"{segment.kind} {sorted(segment.images)}"
        return self.seed, int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little")

    def _nothing(self, segment: Segment) -> SegmentReconstruction:
        reason = "the simulation fails segments"
        return SegmentReconstruction(
            segment=segment.index,
            submodels=(),
            unregistered=tuple(UnregisteredImage(image=image, reason=reason) for image in segment.images),
            attempts=(reason,),
            metric=self.metric,
        )

    def _geometry(self, segment: Segment, images: tuple[int, ...], rng: np.random.Generator) -> SimulatedGeometry:
        settings, depth = self.settings, self.truth.typical_depth
        scale = np.exp(settings.scale_jitter * rng.normal())
        gauge = random_gauge(typical_depth=depth, rng=rng)
        focal_factor = float(np.exp(settings.focal_error * rng.normal()))
        own = drift_steps(len(images) - 1, settings, typical_depth=depth, rng=rng)
        smooth = smooth_coefficients(len(images), settings.depth_distortion, rng)

        cameras = self.truth.world_from_cam[list(images)]
        confused, false_loop = self._confused_cameras(segment, images, cameras)
        seg_from_first = gauge if settings.gauge == "random" else np.eye(4)
        seg_from_first[:3, :3] *= scale
        in_common = chain_steps(cameras, settings, np.random.default_rng((self.seed, _CHAIN)))
        seg_from_cam = bent_path(confused, in_common @ own, seg_from_first)

        warp = np.eye(4)
        if settings.warp > 0:
            warp = random_warp(
                seg_from_cam[:, :3, 3],
                amount=settings.warp,
                group=settings.warp_group,
                typical_depth=depth * float(scale),
                rng=rng,
            )
        return SimulatedGeometry(
            seg_from_world=seg_from_cam @ homogeneous(invert_rigid(cameras)),
            warp=warp,
            focal_factor=focal_factor,
            smooth=smooth,
            false_loop=false_loop,
        )

    def _submodel(self, segment: Segment, images: tuple[int, ...], geometry: SimulatedGeometry) -> Submodel:
        cameras = homogeneous(self.truth.world_from_cam[list(images)])
        seg_from_cam = _rigid_parts(geometry.seg_from_world @ cameras)
        sizes = [(self.collection.images[image].width, self.collection.images[image].height) for image in images]
        estimated = {size: self.truth.intrinsics.resized(*size).zoomed(geometry.focal_factor) for size in set(sizes)}
        if geometry.is_warped:
            rays_cam = estimated[sizes[0]].resized(*RAYS_ACROSS).rays_cam(pixel_centres(*RAYS_ACROSS))
            seg_from_cam = warped_cameras(geometry.warp, seg_from_cam, rays_cam)
        return Submodel(
            segment=segment.index,
            submodel=0,
            images=images,
            seg_from_cam=seg_from_cam,
            intrinsics=tuple(estimated[size] for size in sizes),
            method="simulated",
            reprojection_error_px=float("nan"),
            tracks=None,
        )

    # ------------------------------------------------------------------------- loop segments
    def _confused_cameras(
        self, segment: Segment, images: tuple[int, ...], cameras: FloatArray
    ) -> tuple[FloatArray, bool]:
        """(N, 3, 4) cameras of a network that may confuse two similar places, and whether it does."""
        split = _largest_gap(images) if segment.kind == "loop" else None
        pair = taken_for_each_other(images[:split], images[split:], self.overlap, self.false_loops) if split else None
        if pair is None:
            return cameras, False
        a, b = homogeneous(self.truth.world_from_cam[list(pair)])
        b_onto_a = a @ np.linalg.inv(b)
        return np.concatenate([cameras[:split], (b_onto_a @ homogeneous(cameras[split:]))[:, :3]]), True


def taken_for_each_other(
    first: Sequence[int], second: Sequence[int], overlap: FloatArray, false_loops: Sequence[FalseLoop]
) -> tuple[int, int] | None:
    """Images of the two halves of a loop segment that a network confuses, or None.

    It does if the apparent overlap, summed over all pairs of images, is larger than the true one. Halves without any
    overlap are placed on each other by their middle images.
    """
    common = overlap[np.ix_(first, second)]
    seen = float(common[common > NO_OVERLAP].sum())
    strongest, pair = 0.0, None
    for loop in false_loops:
        alike = loop.alike(first, second)
        same = [m for m, other in alike if m == other]
        seeming = sum(float(overlap[loop.first[m], loop.first[other]]) for m, other in alike)
        if same and seeming > strongest:
            middle = same[len(same) // 2]
            strongest, pair = seeming, (loop.first[middle], loop.second[middle])
    if seen == 0 and pair is None:
        return first[len(first) // 2], second[len(second) // 2]
    return pair if strongest > seen else None


def _largest_gap(images: Sequence[int]) -> int | None:
    """Where the numbers of the images leap furthest, or None where they run on."""
    gaps = np.diff(images)
    return int(gaps.argmax()) + 1 if gaps.max() > 1 else None


def _rigid_parts(b_from_cam: FloatArray) -> FloatArray:
    """(..., 3, 4) poses of similarities (..., 4, 4): the centre moves with the scale, the axes stay orthonormal."""
    out: FloatArray = b_from_cam[..., :3, :].copy()
    out[..., :3] /= np.cbrt(np.linalg.det(out[..., :3]))[..., None, None]
    return out


# ------------------------------------------------------------------------------- scoring
@dataclass(frozen=True, kw_only=True, eq=False)
class TrueRelation:
    """What an alignment of two submodels should find.

    Args:
        target_from_source: (4, 4) homogeneous, the last entry 1; for ``from_matrix`` of the transform groups,
            a similarity unless a submodel is warped.
        num_shared: images on which it rests.
        spread_rotation_deg, spread_log_scale, spread_position: by how much the images differ about it (rms),
            the position in units of the target; zero between submodels that do not bend. No alignment can be
            told right from wrong below these.
    """

    target_from_source: FloatArray
    num_shared: int
    spread_rotation_deg: float
    spread_log_scale: float
    spread_position: float


def simulated_maps(result: BackboneResult) -> tuple[SimulatedMaps, ...]:
    """The maps of all submodels of a simulated result, with the simulated errors.

    Raises:
        TypeError: another backbone made it.
    """
    maps = tuple(one for one in result.dense if isinstance(one, SimulatedMaps))
    if len(maps) < len(result.dense):
        raise TypeError(f"{len(result.dense) - len(maps)} of {len(result.dense)} submodels are not simulated")
    return maps


def true_relation(target: SimulatedMaps, source: SimulatedMaps) -> TrueRelation:
    """The mean over the shared images of ``target_from_source``, as the simulation put each into both submodels.

    Of a false loop it is the relation of the half that the submodels share, which an alignment
    finds; the mistake lies between the halves (``SimulatedMaps.geometry.false_loop``).

    Raises:
        DegenerateAlignmentError: the submodels share no image.
    """
    shared = sorted(set(target.submodel.images) & set(source.submodel.images))
    if not shared:
        raise DegenerateAlignmentError(f"submodels {target.submodel.name} and {source.submodel.name} share no image")
    target_from_world, source_from_world = (
        maps.geometry.seg_from_world[[maps.submodel.images.index(image) for image in shared]]
        for maps in (target, source)
    )
    relations = target_from_world @ np.linalg.inv(source_from_world)
    centres_source = (source_from_world @ homogeneous(source.true_cameras(shared)))[:, :3, 3:]
    centres_target = (relations[:, :3, :3] @ centres_source + relations[:, :3, 3:])[..., 0]

    scales = np.cbrt(np.linalg.det(relations[:, :3, :3]))
    rotations = Rotation.from_matrix(relations[:, :3, :3] / scales[:, None, None])
    scale, rotation = np.exp(np.log(scales).mean()), rotations.mean()
    moved = scale * rotation.apply(centres_source[..., 0])
    translation = (centres_target - moved).mean(axis=0)
    mean = np.eye(4)
    mean[:3, :3], mean[:3, 3] = scale * rotation.as_matrix(), translation

    matrix = target.geometry.warp @ mean @ np.linalg.inv(source.geometry.warp)
    return TrueRelation(
        target_from_source=matrix / matrix[3, 3],
        num_shared=len(shared),
        spread_rotation_deg=float(np.rad2deg(_rms((rotation.inv() * rotations).magnitude()))),
        spread_log_scale=_rms(np.log(scales / scale)),
        spread_position=_rms(np.linalg.norm(moved + translation - centres_target, axis=1)),
    )


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
