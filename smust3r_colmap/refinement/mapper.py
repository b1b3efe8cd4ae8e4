"""A session of COLMAP's incremental mapper on one scene: verified matches, model, position priors and step reports.

The methods are named as in COLMAP. Every step is reported, and an adjustment is rejected if it makes the model worse.
Everything here runs in a child process, because pycolmap ends the process when one of its threads meets an error.
The next module to read is ``misregistration``.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from smust3r_colmap.colmap.database import write_colmap_database
from smust3r_colmap.colmap.reconstruction import cameras_of, poses_of
from smust3r_colmap.features.guided_verification import MatchedFeatures, View, verify_guided
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.products import ImageCollection
from smust3r_colmap.refinement.acceptance import MAX_ERROR_PX, report_of, try_step
from smust3r_colmap.refinement.bundle_adjustment import (
    COARSE_FUNCTION_TOLERANCE,
    FUNCTION_TOLERANCE,
    MIN_ANGLE_DEG,
    WELL_CONSTRAINED_OBSERVATIONS,
    Tolerance,
    adjust,
    adjust_images,
    priors_of,
    triangulate,
    triangulator_options,
)
from smust3r_colmap.refinement.statistics import Statistics, StepReport, weak_images
from smust3r_colmap.refinement.subset_adjustment import adjust_on_subset

COARSE_TOLERANCE_FRACTION = 0.012
"""Of the longer image side: epipolar and reprojection tolerance at the initial poses, for the errors of stitching."""
FINE_TOLERANCE_FRACTION = 0.004
"""The same once the cameras have been adjusted."""
MIN_RESECTION_INLIERS, MIN_AGREEING_FRACTION = 12, 0.6
"""Points that an image without a pose is registered by, and the fraction of its verified matches that must satisfy the
epipolar constraint afterwards."""
LARGE_SCENE_IMAGES = 400
"""With more, segments are adjusted before the whole, and coarse adjustments use a subset of the points."""
SUBSET_ITERATIONS = 6
"""Of the adjustment of a segment."""


class MapperSession:
    """COLMAP's incremental mapper on the matches that agree with the geometry.

    Attributes:
        model: changed by every step.
        initial: (3, 4) initial ``cam_from_world`` by image index.
        priors: of the camera centres, at first the initial ones.
        verified: matches that agree with the model as it was when ``verify`` was last called.
        steps: reports in order, also of rejected steps.
        registered: indices of the images that ``register_missing`` added.
        principal_points_free: adjustments refine them as well.

    Args:
        collection: all images.
        features: of the run, with all matches.
        cameras: initial intrinsics by camera index.
        cam_from_world: (3, 4) initial poses by image index.
        tolerance: of the epipolar constraint, as a fraction of the longer image side.
        calibrated: the intrinsics are fixed.
        scratch: an existing folder for temporary databases.
        threads: of pycolmap.
    """

    def __init__(
        self,
        collection: ImageCollection,
        features: MatchedFeatures,
        cameras: Sequence[Intrinsics],
        cam_from_world: Mapping[int, FloatArray],
        *,
        tolerance: float,
        calibrated: bool,
        scratch: Path,
        threads: int,
    ) -> None:
        self.collection, self.features, self.scratch, self.threads = collection, features, scratch, threads
        self.calibrated, self.principal_points_free = calibrated, False
        self.steps: list[StepReport] = []
        self.registered: tuple[int, ...] = ()
        self.initial = dict(cam_from_world)
        self.verified = verify_guided(features, views_of(self.initial, cameras, collection), tolerance=tolerance)
        cache = self._matches_for_pycolmap(cameras)
        self.model = pycolmap.Reconstruction()
        self.model.load(cache)
        for index, pose in self.initial.items():
            self.model.frame(index + 1).rig_from_world = pycolmap.Rigid3d(pose)
            self.model.register_frame(index + 1)
        self.priors = priors_of(self.model)
        self._begin(cache)

    def _matches_for_pycolmap(self, cameras: Sequence[Intrinsics]) -> pycolmap.DatabaseCache:
        """The verified matches as pycolmap takes them, which is from a database only."""
        with tempfile.TemporaryDirectory(dir=self.scratch) as folder:
            path = Path(folder) / "database.db"
            write_colmap_database(
                path,
                self.collection,
                cameras,
                keypoints=self.verified.correspondences.keypoints,
                matches=self.verified.correspondences.matches,
                j_from_i={},
                priors=(),
            )
            with pycolmap.Database.open(path) as database:
                return pycolmap.DatabaseCache.create(
                    database, pycolmap.DatabaseCacheOptions(min_num_matches=1, load_all_images=True)
                )

    def _begin(self, cache: pycolmap.DatabaseCache) -> None:
        self.mapper = pycolmap.IncrementalMapper(cache)
        self._cache = cache  # pycolmap's mapper does not keep it alive
        self.mapper.begin_reconstruction(self.model)

    def end(self) -> None:
        """No step may follow; the model is complete."""
        self.mapper.end_reconstruction(False)

    def verify(self, tolerance: float) -> None:
        """Verify the matches against the model as it is; tracks stay."""
        self.end()
        self.verified = verify_guided(self.features, self.views(), tolerance=tolerance)
        self._begin(self._matches_for_pycolmap(cameras_of(self.model, self.collection.cameras)))

    def views(self, poses: Mapping[int, FloatArray] | None = None) -> dict[int, View]:
        """The model's cameras for guided verification, at the given (3, 4) poses or at those of the model."""
        cameras = cameras_of(self.model, self.collection.cameras)
        return views_of(poses_of(self.model) if poses is None else poses, cameras, self.collection)

    # ------------------------------------------------------------------------- tracks
    def triangulate(self, name: str, tolerance: Tolerance) -> None:
        """Triangulate all features without a track, complete and merge tracks."""
        before = Statistics.of(self.model)
        triangulate(self.mapper, tolerance)
        after = Statistics.of(self.model)
        self.steps.append(report_of(name, before, after, moved=np.zeros(0), turned=np.zeros(0)))

    def retriangulate(self, tolerance: Tolerance) -> None:
        """The same after the matches have changed, then remove redundant points."""
        self.triangulate("retriangulation", tolerance)
        self.remove_redundant_points()

    def complete(self, tolerance: Tolerance) -> None:
        """Complete and merge tracks, then remove redundant points."""
        self.mapper.complete_and_merge_tracks(triangulator_options(tolerance))
        self.remove_redundant_points()

    def filter(self, max_error_px: float) -> None:
        """Discard observations with a larger error and points with too small a triangulation angle."""
        self.mapper.observation_manager.filter_all_points3D(max_error_px, MIN_ANGLE_DEG)

    def remove_redundant_points(self) -> None:
        """Remove points of two images that both have enough others; see ``redundant_points``."""
        for point_id in redundant_points(self.model):
            self.mapper.observation_manager.delete_point3D(point_id)

    # -------------------------------------------------------------------- adjustment
    def adjust(self, name: str, max_iterations: int, *, coarse: bool = False) -> StepReport:
        """Bundle adjustment of all cameras and points; if it is rejected, another with fixed intrinsics.

        The distortion of a fisheye model diverges if all points are near the image centre, while poses and points can
        still be adjusted.
        """
        report = self.try_adjustment(name, max_iterations, calibrated=self.calibrated, coarse=coarse)
        if not report.accepted and not self.calibrated:
            report = self.try_adjustment(
                f"{name} with fixed intrinsics", max_iterations, calibrated=True, coarse=coarse
            )
        return report

    def try_adjustment(self, name: str, max_iterations: int, *, calibrated: bool, coarse: bool) -> StepReport:
        """Bundle adjustment of all cameras and points; ``coarse`` if another adjustment follows."""
        on_subset = coarse and self.model.num_reg_images() > LARGE_SCENE_IMAGES

        def step() -> bool:
            return (adjust_on_subset if on_subset else adjust)(
                self.model,
                self.priors,
                calibrated=calibrated,
                max_iterations=max_iterations,
                threads=self.threads,
                principal_point=self.principal_points_free,
                function_tolerance=COARSE_FUNCTION_TOLERANCE if coarse else FUNCTION_TOLERANCE,
            )

        return self._try(name, step)

    def adjust_segments(self, segments: Sequence[Sequence[int]]) -> None:
        """Adjust each segment, given as image indices, by itself; only in large scenes."""
        if len(self.initial) <= LARGE_SCENE_IMAGES:
            return
        registered = set(self.model.reg_image_ids())
        subsets = [[i + 1 for i in segment if i + 1 in registered] for segment in segments]

        def step() -> bool:
            return all(
                adjust_images(self.model, subset, max_iterations=SUBSET_ITERATIONS, threads=self.threads)
                for subset in subsets
                if subset
            )

        self._try("bundle adjustment of segments", step)

    def _try(self, name: str, step: Callable[[], bool]) -> StepReport:
        self.steps.append(try_step(name, self.model, step))
        return self.steps[-1]

    # ------------------------------------------------------------------ registration
    def register_missing(self, tolerance: Tolerance) -> None:
        """Register images without a pose by the points they see."""
        options = self._registration_options()
        found: list[int] = []
        while True:
            candidates = self.mapper.find_next_images(options, False)
            new = [i for i in candidates if self._register(options, i)]
            for image_id in new:
                self.mapper.triangulate_image(triangulator_options(tolerance), image_id)
            found += new
            if not new:
                break
        self.registered = tuple(sorted(i - 1 for i in found))

    def register_between(self, features: MatchedFeatures, images: Sequence[int], max_error_px: float) -> None:
        """Register images that see what the model's cameras beside them see, such as those between keyframes.

        They get observations of existing points and are adjusted with these points fixed, so that nothing of the model
        moves and the time is linear in their number.

        Args:
            features: of the run, with the matches of these images.
            images: indices into the collection, without a pose. max_error_px: of their observations.
        """
        self.features = features
        self.verify(FINE_TOLERANCE_FRACTION)
        found: list[int] = []
        while new := self._register_each([i + 1 for i in images if i + 1 not in found]):  # some match only these
            found += new

        def step() -> bool:
            return adjust_images(self.model, found, max_iterations=SUBSET_ITERATIONS, threads=self.threads)

        self._try("bundle adjustment of the registered images", step)
        self.filter(max_error_px)
        contradicted = contradicted_images(self.features, self.model, found, self.collection)
        for image_id in contradicted:
            self.mapper.observation_manager.deregister_frame(self.model.image(image_id).frame_id)
        self.registered = tuple(sorted({*self.registered, *(i - 1 for i in found if i not in contradicted)}))

    def _register_each(self, image_ids: Sequence[int]) -> list[int]:
        options = self._registration_options()
        return [i for i in image_ids if self.mapper.register_next_image(options, i)]

    def _registration_options(self) -> pycolmap.IncrementalMapperOptions:
        """Fewer points than COLMAP's minimum suffice, because most matches of the image must agree afterwards."""
        options = pycolmap.IncrementalMapperOptions()
        options.random_seed = 0
        options.num_threads = self.threads
        options.abs_pose_min_num_inliers = MIN_RESECTION_INLIERS
        options.abs_pose_refine_focal_length = options.abs_pose_refine_extra_params = False
        return options

    def _register(self, options: pycolmap.IncrementalMapperOptions, image_id: int) -> bool:
        if not self.mapper.register_next_image(options, image_id):
            return False
        if agrees(self.features, self.model, image_id, self.collection):
            return True
        self.mapper.observation_manager.deregister_frame(self.model.image(image_id).frame_id)
        return False

    def move_images(self, cam_from_world: Mapping[int, FloatArray]) -> None:
        """Give images, by index, other (3, 4) poses. They lose their observations, and their priors move along."""
        for index, pose in cam_from_world.items():
            frame_id = self.model.image(index + 1).frame_id
            self.mapper.observation_manager.deregister_frame(frame_id)
            self.model.frame(frame_id).rig_from_world = pycolmap.Rigid3d(pose)
            self.model.register_frame(frame_id)
        self.initial |= cam_from_world
        self.priors = self.priors.with_poses(cam_from_world)

    def reset_weak_images(self) -> None:
        """Return weak images to their initial pose relative to the nearest other image, and discard what does not fit.

        This can leave other images weak, which are reset as well. A weak image without an initial pose is
        de-registered.
        """
        while True:
            weak = weak_images(self.model)
            self._reset(weak)
            self.filter(MAX_ERROR_PX)
            self.remove_redundant_points()
            if weak_images(self.model) == weak:
                return

    def _reset(self, weak: Sequence[int]) -> None:
        anchors = [i for i in sorted(set(self.model.reg_image_ids()) - set(weak)) if i - 1 in self.initial]
        for image_id in weak:
            if image_id - 1 not in self.initial:
                self.model.deregister_frame(self.model.image(image_id).frame_id)
            elif anchors:
                here = _centre(self.initial[image_id - 1])
                near = min(anchors, key=lambda i: float(np.linalg.norm(_centre(self.initial[i - 1]) - here)))
                near_from_world = self.model.image(near).cam_from_world()
                old_near, old = (pycolmap.Rigid3d(self.initial[i - 1]) for i in (near, image_id))
                pose = old * old_near.inverse() * near_from_world
                self.model.frame(self.model.image(image_id).frame_id).rig_from_world = pose


def _centre(cam_from_world: FloatArray) -> FloatArray:
    centre: FloatArray = invert_rigid(cam_from_world)[:, 3]
    return centre


def redundant_points(model: pycolmap.Reconstruction) -> list[int]:
    """Ids of points of two images that both have ``WELL_CONSTRAINED_OBSERVATIONS`` in longer tracks.

    Two rays meet wherever the epipolar constraint allows, so wrong matches of a repetitive facade look as good as right
    ones and can hold an image at a wrong pose.
    """
    longer = dict.fromkeys(model.reg_image_ids(), 0)
    short = []
    for point_id, point in model.points3D.items():
        images = {element.image_id for element in point.track.elements}
        if len(images) > 2:
            for image_id in images:
                longer[image_id] += 1
        else:
            short.append((point_id, images))
    return [
        point_id
        for point_id, images in short
        if len(images) < 2 or all(longer[i] >= WELL_CONSTRAINED_OBSERVATIONS for i in images)
    ]


def agrees(
    features: MatchedFeatures, model: pycolmap.Reconstruction, image_id: int, collection: ImageCollection
) -> bool:
    """Most verified matches of the image with other registered images satisfy the epipolar constraint."""
    return not contradicted_images(features, model, [image_id], collection)


def contradicted_images(
    features: MatchedFeatures, model: pycolmap.Reconstruction, image_ids: Sequence[int], collection: ImageCollection
) -> set[int]:
    """Those of the images, by id, of whose verified matches too few satisfy the epipolar constraint; see ``agrees``."""
    poses, asked = poses_of(model), {image_id - 1 for image_id in image_ids}
    around = {
        pair: rows
        for pair, rows in features.verified.items()
        if not asked.isdisjoint(pair) and all(i in poses for i in pair)
    }
    near = {i: poses[i] for pair in around for i in pair}
    views = views_of(near, cameras_of(model, collection.cameras), collection)
    found = verify_guided(replace(features, raw=around, verified=around), views, tolerance=COARSE_TOLERANCE_FRACTION)
    total, agreeing = dict.fromkeys(asked, 0), dict.fromkeys(asked, 0)
    for pair, rows in around.items():
        for image in asked.intersection(pair):
            total[image] += len(rows)
            agreeing[image] += len(found.correspondences.matches.get(pair, ()))
    return {image + 1 for image in asked if agreeing[image] < MIN_AGREEING_FRACTION * max(total[image], 1)}


def views_of(
    poses: Mapping[int, FloatArray], cameras: Sequence[Intrinsics], collection: ImageCollection
) -> dict[int, View]:
    """The cameras by image index, for guided verification.

    Args:
        poses: (3, 4) ``cam_from_world`` by image index.
        cameras: by camera index.
        collection: says which image has which camera.
    """
    return {i: View(cam_from_world=pose, intrinsics=cameras[collection.images[i].camera]) for i, pose in poses.items()}
