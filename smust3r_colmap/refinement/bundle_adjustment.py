"""Triangulation and robust bundle adjustment of a model with known poses, as COLMAP's mapper does them.

Triangulator, adjustment and filters are pycolmap's. Position priors hold the frame and the scale of the world, which
observations alone do not determine. Everything here runs in a child process, because pycolmap ends the process when
one of its threads meets an error. The next module to read is ``subset_adjustment``.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from scipy.sparse import csr_array

from smust3r_colmap.colmap.reconstruction import SparseObservations, poses_of
from smust3r_colmap.estimators.similarity import CentredPairs
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.geometry.so3 import nearest_rotation

logger = logging.getLogger(__name__)

PRIOR_SIGMA_FRACTION = 0.01
"""Standard deviation of a position prior, as a fraction of the path's extent: the typical error of stitching."""
FUNCTION_TOLERANCE, COARSE_FUNCTION_TOLERANCE = 1e-4, 1e-3
"""Relative change of the cost at which Ceres stops: as good as full convergence at a quarter of the time. The coarse
one is for adjustments that another one follows."""
POINT_ITERATIONS = 10
"""Of an adjustment of points only, which start near their optimum."""
LOSS_SCALE_PX = 1.0
"""Of the Cauchy loss."""
MIN_ANGLE_DEG = 1.5
"""Minimum triangulation angle of a point; COLMAP's own."""
TRANSITIVITY = 2
"""Matches of matches are correspondences, too. With 1, many partial tracks are started, and merging them took 170 of
190 s for 1,000 images; with 3, starting tracks takes as long as this saves. The tracks are the same."""
MIN_PRIORS = 3
"""Position priors that hold a frame; with fewer a rotation is left free."""
WELL_CONSTRAINED_OBSERVATIONS = 60
"""Images with so many observations in longer tracks do not need points of two images."""
MAX_COVISIBLE_IMAGES = 120
"""Mean number of images that share points with an image, above which equations are solved iteratively. For 1,000 images
around a table this takes a sixth of the time, for 200 three quarters, to the same minimum. For a walk, where few images
share points, it is slower."""


@dataclass(frozen=True, kw_only=True)
class Tolerance:
    """Limits of an observation: reprojection error in pixels, and angle between ray and point in degrees."""

    pixels: float
    angle_deg: float


def triangulator_options(tolerance: Tolerance) -> pycolmap.IncrementalTriangulatorOptions:
    """COLMAP's options for tracks within the tolerance."""
    options = pycolmap.IncrementalTriangulatorOptions()
    options.create_max_angle_error = tolerance.angle_deg
    options.continue_max_angle_error = tolerance.angle_deg
    options.merge_max_reproj_error = tolerance.pixels
    options.complete_max_reproj_error = tolerance.pixels
    options.min_angle = MIN_ANGLE_DEG
    options.max_transitivity = options.complete_max_transitivity = TRANSITIVITY
    options.random_seed = 0
    return options


def triangulate(mapper: pycolmap.IncrementalMapper, tolerance: Tolerance) -> None:
    """Triangulate all features without a track, then complete and merge tracks; poses are fixed.

    Points of two images, which are wrong more often, are triangulated only for images with too few other points.
    """
    options = triangulator_options(tolerance)
    model = mapper.reconstruction
    for image_id in _bit_reversed(sorted(model.reg_image_ids())):
        mapper.triangulate_image(options, image_id)
    mapper.retriangulate(options)
    mapper.complete_and_merge_tracks(options)
    options.ignore_two_view_tracks = False
    for image_id in sorted(model.reg_image_ids()):
        if model.image(image_id).num_points3D < WELL_CONSTRAINED_OBSERVATIONS:
            mapper.triangulate_image(options, image_id)


def _bit_reversed(ids: Sequence[int]) -> list[int]:
    """In bit-reversed order (halves, quarters, eighths), because consecutive images would all start the same tracks."""
    digits = len(ids).bit_length()
    return [ids[k] for k in sorted(range(len(ids)), key=lambda k: format(k, f"0{digits}b")[::-1])]


@dataclass(frozen=True, kw_only=True, eq=False)
class Priors:
    """Position priors: the camera centre (3,) by image id, and the standard deviation of each axis."""

    centres: Mapping[int, FloatArray]
    sigma: float

    def with_poses(self, cam_from_world: Mapping[int, FloatArray]) -> Priors:
        """With the centres of these (3, 4) poses, by image index, for the images that have a prior."""
        moved = {index + 1: invert_rigid(pose)[:, 3] for index, pose in cam_from_world.items()}
        centres = {image_id: moved.get(image_id, centre) for image_id, centre in self.centres.items()}
        return replace(self, centres=centres)


def priors_of(model: pycolmap.Reconstruction) -> Priors:
    """The current camera centres as priors, with the uncertainty of stitched centres."""
    centres = {i: model.image(i).projection_center() for i in sorted(model.reg_image_ids())}
    return Priors(centres=centres, sigma=PRIOR_SIGMA_FRACTION * extent_of(np.stack(list(centres.values()))))


def extent_of(points: FloatArray) -> float:
    """Diagonal of the bounding box of (N, 3) points without the outer 5 % on each side; 1 if it is zero."""
    low, high = np.quantile(points, [0.05, 0.95], axis=0)
    extent = float(np.linalg.norm(high - low))
    return extent if extent > 0 else 1.0


def pose_priors(model: pycolmap.Reconstruction, priors: Priors) -> list[pycolmap.PosePrior]:
    """The priors as pycolmap takes them, by image id."""
    covariance = np.eye(3) * priors.sigma**2
    return [
        pycolmap.PosePrior(
            pose_prior_id=image_id,
            corr_data_id=model.image(image_id).data_id,
            position=centre,
            position_covariance=covariance,
            coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
        )
        for image_id, centre in priors.centres.items()
        if image_id in model.images
    ]


def adjust(
    model: pycolmap.Reconstruction,
    priors: Priors,
    *,
    calibrated: bool,
    max_iterations: int,
    threads: int,
    principal_point: bool = False,
    function_tolerance: float = FUNCTION_TOLERANCE,
) -> bool:
    """Global bundle adjustment with a Cauchy loss and position priors, in place.

    Centres on a line, such as of a straight road, leave the rotation about this line free, and pycolmap, which first
    aligns the model with the priors, then chooses any. So the model is rotated back to the orientations of before.

    Args:
        model: with points.
        priors: hold frame and scale; if there are fewer than ``MIN_PRIORS``, two cameras are fixed instead.
        calibrated: fixed intrinsics; with fewer than ``MIN_PRIORS`` priors they are always fixed.
        max_iterations: of Ceres.
        threads: of Ceres; with one the result is the same in every run.
        principal_point: it is refined, too, unless the intrinsics are fixed.
        function_tolerance: relative change of the cost at which Ceres stops.

    Returns:
        Whether Ceres calls the solution usable.
    """
    few = len(priors.centres) < MIN_PRIORS
    options = _options(calibrated=calibrated or few, max_iterations=max_iterations, threads=threads)
    options.ceres.solver_options.function_tolerance = function_tolerance
    if mean_covisible(model) > MAX_COVISIBLE_IMAGES:
        options.ceres.max_num_images_direct_dense_cpu_solver = 0
        options.ceres.max_num_images_direct_sparse_cpu_solver = 1
    options.refine_principal_point = principal_point and options.refine_focal_length
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(model.reg_image_ids()):
        config.add_image(image_id)
    before = poses_of(model)
    if few:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        adjuster = pycolmap.create_default_bundle_adjuster(options, config, model)
    else:
        prior_options = pycolmap.PosePriorBundleAdjustmentOptions()
        prior_options.alignment_ransac.random_seed = 0
        # One wrong camera must not move the world. The scale of the loss is pycolmap's default.
        prior_options.ceres.prior_position_loss_function_type = pycolmap.LossFunctionType.HUBER
        adjuster = pycolmap.create_pose_prior_bundle_adjuster(
            options, prior_options, config, pose_priors(model, priors), model
        )
    usable = _solve(adjuster, "all images")
    if usable:
        _restore_orientation(model, before)
    return usable


def robust_cost(model: pycolmap.Reconstruction) -> float:
    """Sum of the Cauchy losses of all observations in front of their cameras: the cost of ``adjust`` without priors.

    Source: twice Ceres's cost, its ``CauchyLoss`` with a scale of ``LOSS_SCALE_PX``.
    """
    cost = 0.0
    observations = SparseObservations.of(model, sorted(model.reg_image_ids()))
    for image_id, points in observations.points.items():
        if not len(points):
            continue
        image = model.image(image_id)
        projected = model.camera(image.camera_id).img_from_cam(image.cam_from_world() * observations.xyz[points])
        errors = np.linalg.norm(np.asarray(projected) - observations.xy[image_id], axis=1)
        cost += float(np.nansum(np.log1p((errors / LOSS_SCALE_PX) ** 2))) * LOSS_SCALE_PX**2
    return cost


def mean_covisible(model: pycolmap.Reconstruction) -> float:
    """Mean number of images that share points with an image, over the images with points; 0 without points."""
    tracks = [[element.image_id for element in point.track.elements] for point in model.points3D.values()]
    if not tracks:
        return 0.0
    images = np.concatenate([np.asarray(track, dtype=np.int64) for track in tracks])
    _, rows = np.unique(images, return_inverse=True)
    points = np.repeat(np.arange(len(tracks)), [len(track) for track in tracks])
    sees = csr_array((np.ones(len(rows), dtype=np.int32), (rows, points)))
    return float((sees @ sees.T).nnz / sees.shape[0] - 1)


def _restore_orientation(model: pycolmap.Reconstruction, before: Mapping[int, FloatArray]) -> None:
    """Rotate the model about its centre so that centres and axes of the cameras fit best to those before.

    A camera axis has the weight of a centre at the distance of one extent: stitching leaves errors of a hundredth in
    both.

    Source: Kabsch 1976; rows of a rotation are camera axes in the world.
    """
    old, new = (np.stack(list(poses.values())) for poses in (before, poses_of(model)))
    if not np.isfinite(new).all():
        return
    old_centres, new_centres = invert_rigid(old)[:, :, 3], invert_rigid(new)[:, :, 3]
    centres = CentredPairs.of(old_centres, new_centres)
    by_axes = np.einsum("nki,nkj->ij", new[:, :, :3], old[:, :, :3])
    old_from_new = nearest_rotation((centres.correlation() / extent_of(old_centres) ** 2 + by_axes).T)
    middle = centres.mean_b
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(old_from_new), middle - old_from_new @ middle))


def adjust_images(
    model: pycolmap.Reconstruction, images: Collection[int], *, max_iterations: int, threads: int
) -> bool:
    """Bundle adjustment of some images and the points that only they see; returns as ``adjust``.

    Points that other images see as well are fixed and hold the frame. Intrinsics are fixed, because other images share
    them. Images without points are left as they are.
    """
    if not any(model.image(image_id).num_points3D for image_id in images):
        return True
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(images):
        config.add_image(image_id)
    options = _options(calibrated=True, max_iterations=max_iterations, threads=threads)
    return _solve(pycolmap.create_default_bundle_adjuster(options, config, model), f"{len(images)} images")


def adjust_points(model: pycolmap.Reconstruction, *, threads: int) -> bool:
    """Bundle adjustment of the points with all cameras fixed; returns as ``adjust``."""
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(model.reg_image_ids()):
        config.add_image(image_id)
    for frame_id in sorted(model.reg_frame_ids()):
        config.set_constant_rig_from_world_pose(frame_id)
    options = _options(calibrated=True, max_iterations=POINT_ITERATIONS, threads=threads)
    options.ceres.solver_options.function_tolerance = COARSE_FUNCTION_TOLERANCE
    return _solve(pycolmap.create_default_bundle_adjuster(options, config, model), "all points")


def _options(*, calibrated: bool, max_iterations: int, threads: int) -> pycolmap.BundleAdjustmentOptions:
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = not calibrated
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = LOSS_SCALE_PX
    options.ceres.solver_options.max_num_iterations = max_iterations
    options.ceres.solver_options.function_tolerance = FUNCTION_TOLERANCE
    options.ceres.solver_options.num_threads = threads
    return options


def _solve(adjuster: pycolmap.BundleAdjuster, what: str) -> bool:
    summary = adjuster.solve()
    logger.info("bundle adjustment of %s: %s", what, summary.brief_report())
    return bool(summary.is_solution_usable())
