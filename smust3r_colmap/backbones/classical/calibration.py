"""One calibration for the whole run.

Self-calibration of a short segment is weak: focal lengths of neighbouring segments differ by a few percent, and some
diverge (853 px instead of 525). No similarity aligns segments with different cameras. So the run has one set of
intrinsics per camera: a few windows, the calibration segments, are self-calibrated, and all other segments are mapped
with the median of their cameras. If the calibration segments disagree, all windows are self-calibrated, and so is a
segment with a much larger reprojection error: with little parallax, a focal length that is off by two percent can give
a wrong model. Then self-calibrated models are adjusted to the median; diverged ones are mapped again with it.
The next module to read is ``dense``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pycolmap

from smust3r_colmap.backbones.classical.mapped_model import MappedModel, model_from_reconstruction, placed_images
from smust3r_colmap.backbones.classical.mapping import ENOUGH_REGISTERED_SHARE, MappedSegment, map_segment
from smust3r_colmap.backbones.classical.model_checks import FOCAL_TOLERANCE, diverged_focal
from smust3r_colmap.backbones.classical.strategies import MappingTask
from smust3r_colmap.colmap.database import internal_name, open_database
from smust3r_colmap.estimators.robust import mad_sigma, weighted_median
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.products import UnregisteredImage

MAX_ERROR_GROWTH_RATIO, ERROR_SLACK_PX = 1.25, 0.05
"""Growth of the mean reprojection error, as a ratio and in pixels, above which a model keeps its own cameras."""
MIN_KEPT_POINTS_SHARE = 0.7
"""Share of its points below which an adjusted model is discarded."""
MIN_CALIBRATION_SEGMENTS = 3
"""Windows that determine a camera; one of them may be wrong."""
MIN_CALIBRATION_IMAGES = 150
"""Images of a camera in them: three windows of the usual length, more of them where windows are shorter."""
MAX_FOCAL_UNCERTAINTY_RATIO = 0.02
"""Relative standard error of the median focal length above which calibration segments disagree."""
MIN_CAMERA_SHARE = 1 / 3
"""Share of a window's images that have to be of a camera for the window to count for it."""


@dataclass(frozen=True, kw_only=True)
class CalibrationTask:
    """One mapped segment to bring to the agreed cameras.

    Args:
        mapping: the task that made it. mapped: its result.
        agreed: the run's intrinsics by camera index, for the cameras that have any.
    """

    mapping: MappingTask
    mapped: MappedSegment
    agreed: Mapping[int, Intrinsics]


def choose_calibration_segments(windows: Sequence[MappingTask]) -> list[MappingTask]:
    """The windows to self-calibrate, before the others are mapped with the cameras found.

    With known cameras a mapper takes half of the time and does not diverge: focal length and distortion are nearly
    degenerate, which makes bundle adjustment converge slowly. Windows that share no images come first; they are the
    first of the collection, so that images appended to it change nothing. All windows of a rare camera are chosen.
    """
    num_windows: Counter[int] = Counter()
    num_images: Counter[int] = Counter()
    chosen = []
    for task in [*windows[::2], *windows[1::2]]:
        seen = Counter(task.camera_indices)
        if all(
            num_windows[camera] >= MIN_CALIBRATION_SEGMENTS and num_images[camera] >= MIN_CALIBRATION_IMAGES
            for camera in seen
        ):
            continue
        chosen.append(task)
        for camera, count in seen.items():
            if count >= MIN_CAMERA_SHARE * len(task.images):
                num_windows[camera] += 1
                num_images[camera] += count
    return chosen


def focal_lengths_agree(
    cameras: Collection[int], segments: Sequence[MappedSegment], camera_of_image: Sequence[int]
) -> bool:
    """Whether the median focal length of the calibration segments is certain enough for all of these cameras.

    That of a camera in only one model is not.
    """
    log_focal: dict[int, list[float]] = {camera: [] for camera in cameras}
    for model in (model for segment in segments for model in segment.models):
        for camera, intrinsics in _cameras_of(model, camera_of_image).items():
            log_focal.setdefault(camera, []).append(float(np.log(intrinsics.focal_px)))
    return all(
        len(log_focal[camera]) > 1 and _median_uncertainty(np.array(log_focal[camera])) <= MAX_FOCAL_UNCERTAINTY_RATIO
        for camera in cameras
    )


def _median_uncertainty(values: npt.NDArray[np.float64]) -> float:
    """Standard error of the median: 1.25 sigma / sqrt(n)."""
    return 1.25 * mad_sigma(values) / float(np.sqrt(len(values)))


def _cameras_of(model: MappedModel, camera_of_image: Sequence[int]) -> dict[int, Intrinsics]:
    return {camera_of_image[image]: one for image, one in zip(model.images, model.intrinsics, strict=True)}


def find_worse_fits(with_known: Sequence[MappedSegment], calibration: Sequence[MappedSegment]) -> list[int]:
    """Segments mapped with known cameras whose reprojection error is much larger than the calibration segments'."""
    errors_px = [mean_error_px(one) for one in calibration if one.models]
    if not errors_px:
        return []
    typical_px = float(np.median(errors_px))
    return [one.segment for one in with_known if one.models and fits_worse(one, typical_px)]


def fits_worse(mapped: MappedSegment, error_px: float) -> bool:
    """Whether its mean reprojection error is larger than ``error_px`` by more than chance explains."""
    return not mean_error_px(mapped) < MAX_ERROR_GROWTH_RATIO * error_px + ERROR_SLACK_PX


def self_calibration_is_better(free: MappedSegment, known: MappedSegment) -> bool:
    """Whether a segment mapped with free cameras loses no image and has a clearly smaller reprojection error."""
    no_fewer = len(placed_images(free.models)) >= len(placed_images(known.models))
    return bool(free.models) and no_fewer and fits_worse(known, mean_error_px(free))


def mean_error_px(mapped: MappedSegment) -> float:
    """Mean reprojection error over the points of all models, of which there is at least one."""
    errors = [model.reprojection_error_px for model in mapped.models]
    return float(np.average(errors, weights=[max(len(model.tracks.points_seg), 1) for model in mapped.models]))


def agree_on_cameras(
    segments: Sequence[MappedSegment],
    camera_of_image: Sequence[int],
    priors: Sequence[Intrinsics],
    *,
    min_models: int = 2,
) -> dict[int, Intrinsics]:
    """Weighted median of each parameter over the models, by camera index.

    A model's weight is its images of the camera times the square root of its points. Diverged focal lengths do not
    count. Cameras of fewer than ``min_models`` models are left out.
    """
    seen: dict[int, list[tuple[float, Intrinsics]]] = {}
    for segment in segments:
        for model in segment.models:
            count = Counter(camera_of_image[image] for image in model.images)
            for camera, intrinsics in _cameras_of(model, camera_of_image).items():
                weight = count[camera] * float(np.sqrt(len(model.tracks.points_seg)))
                seen.setdefault(camera, []).append((weight, intrinsics))
    return {
        camera: replace(priors[camera], params=_median_params(*zip(*models, strict=True)))
        for camera, models in seen.items()
        if len(models) >= min_models
    }


def _median_params(weights: Sequence[float], intrinsics: Sequence[Intrinsics]) -> tuple[float, ...]:
    weight, focal = np.array(weights), np.array([one.focal_px for one in intrinsics])
    near = np.abs(np.log(focal / weighted_median(focal, weight))) <= np.log1p(FOCAL_TOLERANCE)
    chosen = near if near.any() else ~near
    values = np.array([one.params for one in intrinsics])[chosen]
    return tuple(weighted_median(column, weight[chosen]) for column in values.T)


def calibrate_segment(
    task: CalibrationTask, *, map_again: Callable[[MappingTask], MappedSegment] = map_segment
) -> MappedSegment:
    """Map again if cameras diverged, then adjust every model with the agreed cameras held fixed.

    The new models replace all old ones, unless they register fewer images than the old ones that had not diverged.
    """
    mapped = task.mapped
    camera_of = task.mapping.camera_of
    sound = [model for model in mapped.models if not diverged_focal(model, camera_of, task.agreed)]
    placed = placed_images(sound)
    if len(placed) >= ENOUGH_REGISTERED_SHARE * len(task.mapping.images):
        left = unregistered_images(task.mapping, sound, mapped.unregistered)
        mapped = replace(mapped, models=tuple(sound), unregistered=left)
    elif len(sound) < len(mapped.models):
        again = map_again(replace(task.mapping, known_cameras=task.agreed))
        attempts = (*mapped.attempts, "focal length differs from the run's: mapped again", *again.attempts)
        if len(placed_images(again.models)) < len(placed):
            left = unregistered_images(task.mapping, sound, again.unregistered)
            again = replace(again, models=tuple(sound), unregistered=left)
        mapped = replace(again, attempts=attempts)
    models = []
    notes = []
    for model in mapped.models:
        adjusted, note = _adjust(model, task)
        models.append(adjusted)
        notes.append(note)
    return replace(mapped, models=tuple(models), attempts=(*mapped.attempts, *notes))


def unregistered_images(
    task: MappingTask, models: Sequence[MappedModel], known: Sequence[UnregisteredImage]
) -> tuple[UnregisteredImage, ...]:
    """Images of the segment in none of ``models``, with the known reasons."""
    placed = placed_images(models)
    reasons = {one.image: one.reason for one in known}
    return tuple(
        UnregisteredImage(image=image, reason=reasons.get(image, "its model's focal length diverged"))
        for image in task.images
        if image not in placed
    )


def _adjust(model: MappedModel, task: CalibrationTask) -> tuple[MappedModel, str]:
    """Bundle adjustment with the agreed cameras, kept unless it fits clearly worse."""
    reconstruction = reconstruction_from_model(model, task)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = False
    options.refine_extra_params = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.function_tolerance = 1e-4
    options.ceres.solver_options.max_num_iterations = 50
    pycolmap.bundle_adjustment(reconstruction, options)
    observations = pycolmap.ObservationManager(reconstruction)
    observations.filter_all_points3D(4.0, 1.5)
    reconstruction.update_point_3d_errors()
    adjusted = model_from_reconstruction(reconstruction, model.method)
    before, after = model.reprojection_error_px, adjusted.reprojection_error_px
    worse = len(adjusted.images) < len(model.images) or not after < MAX_ERROR_GROWTH_RATIO * before + ERROR_SLACK_PX
    kept_points = len(adjusted.tracks.points_seg) / max(len(model.tracks.points_seg), 1)
    if worse or kept_points < MIN_KEPT_POINTS_SHARE:
        return (
            model,
            f"{len(model.images)} images keep their own focal length ({before:.2f} px, agreed one {after:.2f} px)",
        )
    return adjusted, f"{len(model.images)} images adjusted to the agreed camera ({before:.2f} -> {after:.2f} px)"


def reconstruction_from_model(model: MappedModel, task: CalibrationTask) -> pycolmap.Reconstruction:
    """A pycolmap model with the agreed cameras in place of its own, where there are any."""
    mapping = task.mapping
    camera_of = mapping.camera_of
    reconstruction = pycolmap.Reconstruction()
    for camera in sorted({camera_of[image] for image in model.images}):
        own = next(i for image, i in zip(model.images, model.intrinsics, strict=True) if camera_of[image] == camera)
        reconstruction.add_camera_with_trivial_rig(task.agreed.get(camera, own).colmap_camera(camera + 1))
    with open_database(mapping.database) as database:
        for k, index in enumerate(model.images):
            xy_img = np.asarray(database.read_keypoints(index + 1), dtype=np.float64)[:, :2]
            name, camera_id = internal_name(index), camera_of[index] + 1
            image = pycolmap.Image(name=name, keypoints=xy_img, camera_id=camera_id, image_id=index + 1)
            cam_from_seg = pycolmap.Rigid3d(invert_rigid(model.seg_from_cam[k]))
            reconstruction.add_image_with_trivial_frame(image, cam_from_seg)
    tracks = model.tracks
    order = np.argsort(tracks.point_of_observation, kind="stable")
    bounds = np.searchsorted(tracks.point_of_observation[order], np.arange(len(tracks.points_seg) + 1))
    for row, xyz in enumerate(tracks.points_seg):
        elements = [
            pycolmap.TrackElement(int(tracks.image_of_observation[m]) + 1, int(tracks.feature_of_observation[m]))
            for m in order[bounds[row] : bounds[row + 1]]
        ]
        reconstruction.add_point3D(xyz, pycolmap.Track(elements), np.zeros(3, np.uint8))
    return reconstruction
