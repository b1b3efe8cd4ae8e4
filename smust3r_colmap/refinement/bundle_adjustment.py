"""Triangulation and robust bundle adjustment of a model with known poses, as COLMAP's mapper does them.

Everything is pycolmap's: the triangulator, the adjustment, the filters. Priors of the camera centres keep
the world's frame and scale, which pixels alone do not hold. Everything here runs in a child process.
The next module to read is ``part_adjustment``.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from scipy.sparse import csr_array

from smust3r_colmap.estimators.similarity import CentredPairs
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.geometry.so3 import nearest_rotation

logger = logging.getLogger(__name__)

PRIOR_SIGMA = 0.01
"""Standard deviation of a prior camera centre, as a part of the path's extent: what stitching usually leaves."""
FUNCTION_TOLERANCE, ROUGH_TOLERANCE = 1e-4, 1e-3
"""Ceres stops when the cost changes by less: as good as running to the end, at a quarter of the cost; rough where
another adjustment follows, which is repeated until the cameras stand still."""
POINT_ITERATIONS = 10
"""Of points alone, which are near where they belong."""
LOSS_SCALE_PX = 1.0
"""Where the Cauchy loss begins to bend."""
MIN_ANGLE_DEG = 1.5
"""Of the rays of a point; COLMAP's own."""
TRANSITIVITY = 2
"""Matches of matches are correspondences, too. With one step, tracks begin in many parts, and merging these took 170 of
190 s for 1,000 images; with three, beginning them takes as long as that saves. The tracks are the same."""
MIN_PRIORS = 3
"""Camera centres that hold a frame; fewer leave it turning."""
ENOUGH_OBSERVATIONS = 15
"""Images with fewer are weak: their pose rests on too little to be adjusted."""
MANY_OBSERVATIONS = 60
"""An image with so many longer tracks can do without points that only two images see."""
MAX_COVISIBLE = 120
"""Images that share points with an image, in the mean, beyond which equations are solved iteratively: for 1,000 images
round a table six times faster, for 200 by a quarter, to the same minimum; for a walk, of which few images share
points, slower."""
_NO_ERROR_PX = 1e100
"""What COLMAP calls the error of a point that a camera has behind it is far beyond."""


@dataclass(frozen=True, kw_only=True)
class Tolerance:
    """How far a track may be off: ``pixels`` of reprojection, ``angle_deg`` of a ray."""

    pixels: float
    angle_deg: float


@dataclass(frozen=True, kw_only=True)
class ModelFigures:
    """What a model is judged by.

    Args:
        num_images: registered. num_points, num_observations: of tracks of two images or more.
        mean_track_length: observations per point; 0 without points.
        reprojection_error_px: mean over the errors of the points in front of their cameras; 0 without such.
        num_weak: registered images with fewer than ``ENOUGH_OBSERVATIONS``.
    """

    num_images: int
    num_points: int
    num_observations: int
    mean_track_length: float
    reprojection_error_px: float
    num_weak: int


def figures_of(model: pycolmap.Reconstruction) -> ModelFigures:
    """The figures of a model as it is; its point errors are brought up to date."""
    model.update_point_3d_errors()
    errors = np.array([point.error for point in model.points3D.values()])
    errors = errors[errors < _NO_ERROR_PX]
    return ModelFigures(
        num_images=model.num_reg_images(),
        num_points=model.num_points3D(),
        num_observations=model.compute_num_observations(),
        mean_track_length=float(model.compute_mean_track_length()),
        reprojection_error_px=float(errors.mean()) if len(errors) else 0.0,
        num_weak=len(weak_images(model)),
    )


def weak_images(model: pycolmap.Reconstruction) -> list[int]:
    """Ids of the registered images with fewer than ``ENOUGH_OBSERVATIONS``, ascending."""
    return sorted(i for i in model.reg_image_ids() if model.image(i).num_points3D < ENOUGH_OBSERVATIONS)


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
    """New tracks for all features that have none, then longer and merged ones; poses stay.

    Points that two images only see, of which more are wrong, are made for images that have too few others.
    """
    options = triangulator_options(tolerance)
    model = mapper.reconstruction
    for image_id in _far_apart_first(sorted(model.reg_image_ids())):
        mapper.triangulate_image(options, image_id)
    mapper.retriangulate(options)
    mapper.complete_and_merge_tracks(options)
    options.ignore_two_view_tracks = False
    for image_id in sorted(model.reg_image_ids()):
        if model.image(image_id).num_points3D < MANY_OBSERVATIONS:
            mapper.triangulate_image(options, image_id)


def _far_apart_first(ids: Sequence[int]) -> list[int]:
    """Halves, quarters, eighths: the order of the reversed bits. Images in a row would all begin the same tracks."""
    digits = len(ids).bit_length()
    return [ids[k] for k in sorted(range(len(ids)), key=lambda k: format(k, f"0{digits}b")[::-1])]


@dataclass(frozen=True, kw_only=True, eq=False)
class Priors:
    """Where the cameras were: by image id the centre (3,), and the standard deviation of each axis."""

    centres: Mapping[int, FloatArray]
    sigma: float

    def with_places(self, cam_from_world: Mapping[int, FloatArray]) -> Priors:
        """With the centres of other (3, 4) poses, by image index, for the images that have a prior."""
        moved = {index + 1: invert_rigid(pose)[:, 3] for index, pose in cam_from_world.items()}
        centres = {image_id: moved.get(image_id, centre) for image_id, centre in self.centres.items()}
        return replace(self, centres=centres)


def priors_of(model: pycolmap.Reconstruction) -> Priors:
    """The present camera centres as priors, as sure as stitched centres are."""
    centres = {i: model.image(i).projection_center() for i in sorted(model.reg_image_ids())}
    return Priors(centres=centres, sigma=PRIOR_SIGMA * extent_of(np.stack(list(centres.values()))))


def extent_of(points: FloatArray) -> float:
    """Diagonal of the box around (N, 3) points without the outermost twentieth on each side; 1 for a single place."""
    low, high = np.quantile(points, [0.05, 0.95], axis=0)
    extent = float(np.linalg.norm(high - low))
    return extent if extent > 0 else 1.0


def pose_priors(model: pycolmap.Reconstruction, priors: Priors) -> list[pycolmap.PosePrior]:
    """As pycolmap takes them, with the images' ids."""
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
    """Global bundle adjustment with a Cauchy loss and priors of the centres, in place.

    Centres on a line, such as of a straight road, say nothing about the roll around it, and pycolmap, which aligns
    the model with the priors first, then takes any. So the whole model is turned back to where the cameras looked.

    Args:
        model: with points.
        priors: hold frame and scale; with fewer than three they cannot, and two cameras are held instead.
        calibrated: the intrinsics stay; two images by themselves say too little about them, theirs always do.
        max_iterations: upper bound of the work.
        threads: of Ceres; with one the result is the same in every run.
        principal_point: it is free, too, unless the intrinsics stay.
        function_tolerance: relative change of the cost at which Ceres stops.

    Returns:
        Whether Ceres calls the solution usable.
    """
    few = len(priors.centres) < MIN_PRIORS
    options = _options(calibrated=calibrated or few, max_iterations=max_iterations, threads=threads)
    options.ceres.solver_options.function_tolerance = function_tolerance
    if mean_covisible(model) > MAX_COVISIBLE:
        options.ceres.max_num_images_direct_dense_cpu_solver = 0
        options.ceres.max_num_images_direct_sparse_cpu_solver = 1
    options.refine_principal_point = principal_point and options.refine_focal_length
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(model.reg_image_ids()):
        config.add_image(image_id)
    before = _cam_from_world(model)
    if few:
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        adjuster = pycolmap.create_default_bundle_adjuster(options, config, model)
    else:
        prior_options = pycolmap.PosePriorBundleAdjustmentOptions()
        prior_options.alignment_ransac.random_seed = 0
        # One camera that was stitched to a wrong place must not pull the world along; the scale is pycolmap's.
        prior_options.ceres.prior_position_loss_function_type = pycolmap.LossFunctionType.HUBER
        adjuster = pycolmap.create_pose_prior_bundle_adjuster(
            options, prior_options, config, pose_priors(model, priors), model
        )
    usable = _solve(adjuster, "all images")
    if usable:
        _turn_back(model, before)
    return usable


def robust_cost(model: pycolmap.Reconstruction) -> float:
    """Sum of the Cauchy losses of all observations in front of their cameras: what ``adjust`` lowers, without priors.

    Source: twice Ceres's cost, its ``CauchyLoss`` with a scale of ``LOSS_SCALE_PX``.
    """
    cost = 0.0
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        seen = image.get_observation_points2D()
        if not seen:
            continue
        xyz_world = np.stack([model.point3D(point.point3D_id).xyz for point in seen])
        projected = model.camera(image.camera_id).img_from_cam(image.cam_from_world() * xyz_world)
        errors = np.linalg.norm(np.asarray(projected) - np.stack([point.xy for point in seen]), axis=1)
        cost += float(np.nansum(np.log1p((errors / LOSS_SCALE_PX) ** 2))) * LOSS_SCALE_PX**2
    return cost


def mean_covisible(model: pycolmap.Reconstruction) -> float:
    """With how many others an image shares points, in the mean over the images that have any; 0 without points."""
    tracks = [[element.image_id for element in point.track.elements] for point in model.points3D.values()]
    if not tracks:
        return 0.0
    images = np.concatenate([np.asarray(track, dtype=np.int64) for track in tracks])
    _, rows = np.unique(images, return_inverse=True)
    points = np.repeat(np.arange(len(tracks)), [len(track) for track in tracks])
    sees = csr_array((np.ones(len(rows), dtype=np.int32), (rows, points)))
    return float((sees @ sees.T).nnz / sees.shape[0] - 1)


def _cam_from_world(model: pycolmap.Reconstruction) -> FloatArray:
    """(N, 3, 4) of the registered images, by ascending id."""
    return np.stack([model.image(i).cam_from_world().matrix() for i in sorted(model.reg_image_ids())])


def _turn_back(model: pycolmap.Reconstruction, before: FloatArray) -> None:
    """Turn the model around its middle so that centres and axes of the cameras fit best to those before.

    One camera axis counts as much as a centre one extent away from the middle: stitching leaves errors of
    a hundredth in both.

    Source: Kabsch 1976; rows of a rotation are camera axes in the world.
    """
    after = _cam_from_world(model)
    if not np.isfinite(after).all():
        return
    old, new = invert_rigid(before)[:, :, 3], invert_rigid(after)[:, :, 3]
    centres = CentredPairs.of(old, new)
    by_axes = np.einsum("nki,nkj->ij", after[:, :, :3], before[:, :, :3])
    old_from_new = nearest_rotation((centres.correlation() / extent_of(old) ** 2 + by_axes).T)
    middle = centres.mean_b
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(old_from_new), middle - old_from_new @ middle))


def adjust_part(model: pycolmap.Reconstruction, images: Collection[int], *, max_iterations: int, threads: int) -> bool:
    """Bundle adjustment of some images and the points that they alone see; returns as ``adjust``.

    A part that sees nothing has nothing to adjust, and stays as it is.

    Points that other images see too stay where they are and hold the part in its place; intrinsics stay,
    for other images share them.
    """
    if not any(model.image(image_id).num_points3D for image_id in images):
        return True
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(images):
        config.add_image(image_id)
    options = _options(calibrated=True, max_iterations=max_iterations, threads=threads)
    return _solve(pycolmap.create_default_bundle_adjuster(options, config, model), f"{len(images)} images")


def adjust_points(model: pycolmap.Reconstruction, *, threads: int) -> bool:
    """All points to where their observations want them, with every camera fixed; returns as ``adjust``."""
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(model.reg_image_ids()):
        config.add_image(image_id)
    for frame_id in sorted(model.reg_frame_ids()):
        config.set_constant_rig_from_world_pose(frame_id)
    options = _options(calibrated=True, max_iterations=POINT_ITERATIONS, threads=threads)
    options.ceres.solver_options.function_tolerance = ROUGH_TOLERANCE
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
