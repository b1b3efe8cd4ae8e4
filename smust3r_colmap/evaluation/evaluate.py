"""All figures of an estimate against a reference, as rows that say what was compared, and how.

Every metric has one implementation, in the modules of this folder; here they are put together. The next module to read
is ``table``, which writes the rows.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields

import numpy as np
from scipy.spatial.transform import Rotation

from smust3r_colmap.config import EvaluateConfig
from smust3r_colmap.errors import DegenerateAlignmentError
from smust3r_colmap.estimators.similarity import MIN_RELATIVE_WIDTH, fit_camera_similarity, relative_width
from smust3r_colmap.evaluation.absolute_error import (
    Statistics,
    align_centres,
    align_rotations,
    position_errors,
    rotation_errors_deg,
)
from smust3r_colmap.evaluation.association import Association, associate, match_names
from smust3r_colmap.evaluation.cloud_error import CloudErrors, cloud_errors
from smust3r_colmap.evaluation.depth_error import VIEW_FROM_SENSOR, DepthErrors, depth_in_view, map_ratios
from smust3r_colmap.evaluation.pairwise_auc import COLMAP_THRESHOLDS_DEG, VGGT_THRESHOLDS_DEG, auc_colmap, auc_vggt
from smust3r_colmap.evaluation.predicted_error import PredictedErrors
from smust3r_colmap.evaluation.relative_error import pairs_at, relative_errors, segment_errors
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.importers.pose_set import DepthFiles, PoseSet
from smust3r_colmap.importers.workspace_depth import DenseWorkspace, read_depth_image

MIN_COMPARED = 3
"""Two centres fit any other two."""
_LINE = 1e-6
"""Relative width of centres that are on a line but for rounding."""
_MAX_IMAGES_IN_PAIRS = 10_000
"""All pairs of more would take minutes."""
_MAX_DEPTHS = 20_000_000
"""More pixels are thinned evenly: their ratios are held in memory for the median."""
_SUSPECT_DEG, _SUSPECT_FACTOR = 5.0, 5.0
"""Orientations that are off by so much, and agree so many times better in another order or after another rotation."""

Values = Mapping[str, float | None]
_NO_STATISTICS: Values = dict.fromkeys(one.name for one in fields(Statistics))


@dataclass(frozen=True, kw_only=True)
class Row:
    """One metric.

    Args:
        metric: its name.
        values: by statistic; None where the poses do not determine it, which ``note`` explains.
        unit: of all values that do not name one.
        alignment: that was applied before.
        association: how poses were matched.
        compared, in_estimate, in_reference: numbers of poses.
        note: what else the figures depend on.
    """

    metric: str
    values: Values
    unit: str
    alignment: str
    association: str
    compared: int
    in_estimate: int
    in_reference: int
    note: str = ""


@dataclass(frozen=True, kw_only=True)
class EvaluationReport:
    """All rows.

    Args:
        estimate, reference: where they were read, and their layout.
        rows: in the order of the modules.
        notes: what a reader of the figures should know.
        warnings: why figures are missing, or not to be believed.
    """

    estimate: str
    reference: str
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class _Compared:
    """The poses that are compared, (K, 3, 4) each, before and after the alignment, and what every row says."""

    estimated: FloatArray
    reference: FloatArray
    aligned: FloatArray
    names: tuple[str, ...]
    options: EvaluateConfig
    unit: str
    facts: Mapping[str, str | int] = field(default_factory=dict)

    def row(self, metric: str, values: Values, unit: str, alignment: str | None = None, note: str = "") -> Row:
        facts = {**self.facts, "alignment": self.options.align if alignment is None else alignment}
        return Row(metric=metric, values=values, unit=unit, note=note, **facts)  # type: ignore[arg-type]

    @property
    def width(self) -> float:
        """Of the centres that are narrower."""
        return min(relative_width(poses[:, :, 3]) for poses in (self.estimated, self.reference))


def evaluate(
    models: Sequence[PoseSet],
    reference: PoseSet,
    options: EvaluateConfig,
    *,
    sigmas: Mapping[str, float] | None = None,
    clouds: tuple[FloatArray, FloatArray] | None = None,
    workspace: DenseWorkspace | None = None,
) -> EvaluationReport:
    """Compare the first model with the reference; the others count in COLMAP's area under the curve only.

    Args:
        models: of the estimate, largest first.
        sigmas: predicted standard deviations by image name, in units of the first model.
        clouds: points (N, 3) in the world of the first model, and (M, 3) of the reference.
        workspace: with depth maps in the world of the first model, to compare with the depth of the reference.

    Raises:
        InputError: no pose of the one has a pose in the other.
        DegenerateAlignmentError: fewer than three poses are compared, or they do not determine the alignment.
    """
    first, *others = models
    association = associate(
        first, reference, options.associate, max_difference_s=options.max_time_difference, offset_s=options.time_offset
    )
    associations = [association, *(match_names(model.names, reference.names) for model in others)]
    compared = _compared(first, reference, association, options)
    rows = [
        *_absolute(compared),
        _scale(compared),
        *_relative(compared),
        *_segments(compared),
        *_pairs(compared, models, reference, associations),
        *([] if sigmas is None else [_predicted(compared, sigmas)]),
        *([] if clouds is None else _cloud(compared, *clouds)),
        *([] if workspace is None or reference.depth is None else _depth(compared, workspace, reference.depth)),
    ]
    return EvaluationReport(
        estimate=_described(first),
        reference=_described(reference),
        rows=tuple(rows),
        notes=tuple(_notes(models, reference, workspace)),
        warnings=(*first.notes, *reference.notes, *_missing(rows), *_warnings(compared, first, reference)),
    )


def _compared(model: PoseSet, reference: PoseSet, association: Association, options: EvaluateConfig) -> _Compared:
    if len(association) < MIN_COMPARED:
        raise DegenerateAlignmentError(
            f"{len(association)} poses by {association.how} are in both {model.place} ({len(model)} poses) and "
            f"{reference.place} ({len(reference)}); needed {MIN_COMPARED}"
        )
    estimated = model.world_from_cam[association.estimate]
    true = reference.world_from_cam[association.reference]
    return _Compared(
        estimated=estimated,
        reference=true,
        aligned=align_centres(estimated, true, options.align).move_cameras(estimated),
        names=tuple(model.names[row] for row in association.estimate) if model.names else (),
        options=options,
        unit=options.unit or reference.unit,
        facts={
            "association": association.how,
            "compared": len(association),
            "in_estimate": len(model),
            "in_reference": len(reference),
        },
    )


def _described(poses: PoseSet) -> str:
    return f"{poses.place} ({poses.layout}, {len(poses)} poses)"


def _missing(rows: Sequence[Row]) -> tuple[str, ...]:
    """Why figures are missing."""
    return tuple(dict.fromkeys(f"{row.metric}: {row.note}" for row in rows if None in row.values.values()))


def _notes(models: Sequence[PoseSet], reference: PoseSet, workspace: DenseWorkspace | None) -> Iterator[str]:
    if len(models) > 1:
        others = ", ".join(f"{model.place.name} ({len(model)} poses)" for model in models[1:])
        yield f"figures are those of the largest model; auc_colmap, by image names, counts the others, too: {others}"
    if reference.is_model:
        yield "the reference is a reconstruction: its errors count as errors of the estimate"
    if workspace is not None and reference.depth is not None and reference.depth.intrinsics is None:
        yield "the depth of the reference is not compared: its layout has no intrinsics"


# --------------------------------------------------------------------------- absolute
def _absolute(compared: _Compared) -> Iterator[Row]:
    errors = position_errors(compared.aligned, compared.reference)
    yield compared.row("ape_translation", asdict(Statistics.of(errors)), compared.unit)
    extent = float(np.linalg.norm(np.ptp(compared.reference[:, :, 3], axis=0)))
    percent = 100 * float(np.sqrt(np.mean(errors**2))) / extent if extent else None
    yield compared.row(
        "ape_of_extent",
        {"rmse_percent": percent, "extent": extent},
        compared.unit,
        note="extent: diagonal of the box round the compared centres of the reference",
    )
    is_line = compared.options.align != "none" and compared.width < _LINE
    angles = asdict(Statistics.of(rotation_errors_deg(compared.aligned, compared.reference)))
    yield compared.row(
        "aae",
        _NO_STATISTICS if is_line else angles,
        "deg",
        note="not determined: the centres are on a line, which leaves the rotation about it free"
        if is_line
        else "orientations after the fit of the centres",
    )
    try:
        turned = align_rotations(compared.estimated, compared.reference)
    except DegenerateAlignmentError as error:
        yield compared.row("aae_rotation_aligned", _NO_STATISTICS, "deg", "mean rotation", note=str(error))
    else:
        errors_deg = rotation_errors_deg(turned, compared.reference)
        yield compared.row("aae_rotation_aligned", asdict(Statistics.of(errors_deg)), "deg", "mean rotation")


def _scale(compared: _Compared) -> Row:
    try:
        scale = 1 / float(align_centres(compared.estimated, compared.reference, "sim3").scale)
    except DegenerateAlignmentError as error:
        undetermined = {"scale": None, "error_percent": None}
        return compared.row("scale", undetermined, "", "none", note=f"not determined: {error}")
    values = {"scale": scale, "error_percent": 100 * (scale - 1)}
    return compared.row("scale", values, "", "none", note="length of the estimate per length of the reference")


def _warnings(compared: _Compared, *sides: PoseSet) -> Iterator[str]:
    if compared.options.align != "none" and _LINE <= compared.width < MIN_RELATIVE_WIDTH:
        yield (
            f"the compared centres are nearly on a line (width "
            f"{100 * compared.width:.2g} % of the length), so that they do not determine the rotation about it: aae is "
            "not to be believed; aae_rotation_aligned does not depend on it"
        )
    try:
        errors_deg = _rotation_error_deg(compared.estimated, compared.reference)
        after_fit_deg = float(rotation_errors_deg(compared.aligned, compared.reference).mean())
        is_fit = compared.options.align != "none" and compared.width >= MIN_RELATIVE_WIDTH
        if is_fit and _SUSPECT_DEG < after_fit_deg > _SUSPECT_FACTOR * errors_deg:
            yield (
                f"aae ({after_fit_deg:.3g} deg in the mean) is mostly that of the alignment: the orientations agree to "
                f"{errors_deg:.3g} deg after a rotation of their own, which aae_rotation_aligned has"
            )
        for side, poses in zip(sides, (compared.estimated, compared.reference), strict=True):
            other = compared.reference if poses is compared.estimated else compared.estimated
            swapped_deg = _rotation_error_deg(_scalar_first(poses), other)
            if side.numbers is None and side.names == () and _SUSPECT_DEG < errors_deg > _SUSPECT_FACTOR * swapped_deg:
                yield (
                    f"{side.place}: orientations are off by {errors_deg:.3g} deg in the mean, and by {swapped_deg:.3g} "
                    "deg if the scalar of its quaternions comes first: are its columns qw qx qy qz?"
                )
    except DegenerateAlignmentError:
        return


def _rotation_error_deg(estimated: FloatArray, reference: FloatArray) -> float:
    return float(rotation_errors_deg(align_rotations(estimated, reference), reference).mean())


def _scalar_first(poses: FloatArray) -> FloatArray:
    """Poses (N, 3, 4) as they would be if their quaternions x y z w were w x y z."""
    quat_xyzw = Rotation.from_matrix(poses[:, :, :3]).as_quat()
    rotations = Rotation.from_quat(quat_xyzw[:, [1, 2, 3, 0]]).as_matrix()
    return np.concatenate([rotations, poses[:, :, 3:]], axis=2)


# --------------------------------------------------------------------------- relative
def _relative(compared: _Compared) -> Iterator[Row]:
    options = compared.options
    pairs = pairs_at(compared.reference, options.rpe_delta, options.rpe_unit, all_pairs=options.rpe_all_pairs)
    kind = "from every pose" if options.rpe_all_pairs else "one after the other"
    note = f"{len(pairs)} pairs of compared poses, {kind}; delta {options.rpe_delta:g} {options.rpe_unit}"
    if not len(pairs):
        for metric, unit in (("rpe_translation", compared.unit), ("rpe_rotation", "deg")):
            yield compared.row(metric, _NO_STATISTICS, unit, note=f"{note}: the path is too short")
        return
    lengths, angles_deg = relative_errors(compared.aligned, compared.reference, pairs)
    yield compared.row("rpe_translation", asdict(Statistics.of(lengths)), compared.unit, note=note)
    yield compared.row("rpe_rotation", asdict(Statistics.of(angles_deg)), "deg", note=note)


def _segments(compared: _Compared) -> Iterator[Row]:
    """KITTI's errors need metres."""
    if compared.unit != "m":
        return
    for one in segment_errors(compared.aligned, compared.reference):
        yield compared.row(
            f"kitti_{one.length_m}m" if one.length_m else "kitti_all",
            {"translation_percent": one.translation_percent, "rotation_deg_per_m": one.rotation_deg_per_m},
            "",
            note=f"{one.num_segments} segments",
        )


# ------------------------------------------------------------------------------ pairs
def _pairs(
    compared: _Compared, models: Sequence[PoseSet], reference: PoseSet, associations: Sequence[Association]
) -> Iterator[Row]:
    n = len(compared.reference)
    if n > _MAX_IMAGES_IN_PAIRS:
        for metric, thresholds in (("auc_colmap_compared", COLMAP_THRESHOLDS_DEG), ("auc_vggt", VGGT_THRESHOLDS_DEG)):
            nothing = _by_threshold(thresholds, [None] * len(thresholds))
            yield compared.row(metric, nothing, "%", "none", note=f"not computed: {n} poses have too many pairs")
        return
    accuracy = compared.options.reference_accuracy
    alone = auc_colmap(
        [(compared.estimated, compared.reference, 0)], n, n * (n - 1), COLMAP_THRESHOLDS_DEG, accuracy=accuracy
    )
    if associations[0].by_name:
        missing = len(reference) - len(np.unique(np.concatenate([one.reference for one in associations])))
        unknown = sum(len(model) - len(one) for model, one in zip(models, associations, strict=True))
        note = (
            f"{missing} images of the reference have no pose and {unknown} of the estimate are unknown to it: all "
            "their pairs count as 180 deg"
        )
        is_alone = not (missing or unknown or len(models) > 1)
        whole = alone if is_alone else _auc_of_all(models, reference, associations, accuracy)
        values = _by_threshold(COLMAP_THRESHOLDS_DEG, whole)
        yield compared.row("auc_colmap", values, "%", "none", note="" if is_alone else note)
    yield compared.row("auc_colmap_compared", _by_threshold(COLMAP_THRESHOLDS_DEG, alone), "%", "none")
    vggt = auc_vggt(compared.estimated, compared.reference, VGGT_THRESHOLDS_DEG)
    yield compared.row("auc_vggt", _by_threshold(VGGT_THRESHOLDS_DEG, vggt), "%", "none", note="compared poses only")


def _auc_of_all(
    models: Sequence[PoseSet], reference: PoseSet, associations: Sequence[Association], accuracy: float
) -> tuple[float, ...]:
    parts = [
        (model.world_from_cam[one.estimate], reference.world_from_cam[one.reference], len(model) - len(one))
        for model, one in zip(models, associations, strict=True)
    ]
    joined = _num_joined(associations, len(reference))
    return auc_colmap(parts, len(reference), joined, COLMAP_THRESHOLDS_DEG, accuracy=accuracy)


def _by_threshold(thresholds: Sequence[int], values: Sequence[float | None]) -> Values:
    return {f"at_{threshold}_deg": value for threshold, value in zip(thresholds, values, strict=True)}


def _num_joined(associations: Sequence[Association], num_reference: int) -> int:
    """Ordered pairs of images of the reference that at least one model has both of."""
    has = np.zeros((len(associations), num_reference), dtype=bool)
    for k, one in enumerate(associations):
        has[k, one.reference] = True
    return sum(int(has[has[:, row]].any(axis=0).sum()) - 1 for row in np.flatnonzero(has.any(axis=0)))


# ------------------------------------------------------------------ sigmas and clouds
def _predicted(compared: _Compared, sigmas: Mapping[str, float]) -> Row:
    """After the similarity of the centres, which the standard deviations are given for."""
    rows = [row for row, name in enumerate(compared.names) if name in sigmas]
    if not rows:
        return compared.row("predicted_error", {"true_rmse": None}, "", "sim3", note="no compared image has a sigma")
    fit = align_centres(compared.estimated, compared.reference, "sim3")
    errors = position_errors(fit.move_cameras(compared.estimated), compared.reference)[rows]
    scaled = float(fit.scale) * np.array([sigmas[compared.names[row]] for row in rows])
    found = PredictedErrors.of(errors, scaled)
    values = {"true_rmse": found.true_rmse, "predicted_rmse": found.predicted_rmse}
    values |= {f"within_{k}_sigma_percent": share for k, share in enumerate(found.within, start=1)}
    return compared.row("predicted_error", values, compared.unit, "sim3", note=f"{len(rows)} images with a sigma")


def _cloud(compared: _Compared, estimated: FloatArray, reference: FloatArray) -> Iterator[Row]:
    """The cloud is moved with the cameras; the roll about a straight path comes from their orientations."""
    fit, alignment = _cloud_alignment(compared)
    found: CloudErrors = cloud_errors(fit.apply(estimated), reference, compared.options.cloud_thresholds)
    note = f"{len(estimated)} points of the estimate, {len(reference)} of the reference"
    for metric, one in (("cloud_accuracy", found.to_reference), ("cloud_completeness", found.from_reference)):
        yield compared.row(metric, asdict(one), compared.unit, alignment, note=note)
    yield compared.row("cloud_chamfer", {"mean": found.chamfer}, compared.unit, alignment, note=note)
    for share in found.shares:
        values = {"accuracy": share.accuracy, "completeness": share.completeness, "f_score": share.f_score}
        metric = f"cloud_within_{share.threshold:g}_{compared.unit}"
        yield compared.row(metric, values, "%", alignment, note=note)


def _depth(compared: _Compared, workspace: DenseWorkspace, truth: DepthFiles) -> Iterator[Row]:
    """At the scale of the cameras, and at the one that makes the median ratio 1."""
    names, names_ref = workspace.names, tuple(truth.files)
    matched = match_names(names, names_ref)
    pairs = [(names[a], truth.files[names_ref[b]]) for a, b in zip(matched.estimate, matched.reference, strict=True)]
    if truth.intrinsics is None:
        return
    if not pairs:
        yield compared.row("depth", {"abs_rel": None}, "", note="no image has both a map and depth in the reference")
        return
    registration = compared.options.depth_registration
    num_pixels = sum(workspace.camera(name).width * workspace.camera(name).height for name, _ in pairs)
    step = 1 + num_pixels // _MAX_DEPTHS
    found, num_compared, num_true = [], 0, 0
    for name, path in pairs:
        view, depth = workspace.camera(name), workspace.depth(name)
        measured = read_depth_image(path, truth.per_unit)
        sensor = truth.intrinsics.resized(measured.shape[1], measured.shape[0])
        seen = depth_in_view(measured, sensor, VIEW_FROM_SENSOR[registration], view)
        ratios = np.empty(0) if depth is None else map_ratios(depth, seen)
        found.append(ratios[::step])
        num_compared, num_true = num_compared + len(ratios), num_true + int((seen > 0).sum())
    ratios = np.concatenate(found)
    scale = float(align_centres(compared.estimated, compared.reference, compared.options.align).scale)
    for metric, factor in (("depth", scale), ("depth_median_scaled", 1 / np.median(ratios) if len(ratios) else 1.0)):
        errors = DepthErrors.of(metric, factor * ratios, None)
        values = {
            "abs_rel": errors.abs_rel,
            "median_rel": errors.median_rel,
            "delta_1.05": errors.delta_105,
            "delta_1.25": errors.delta_125,
            "coverage": num_compared / num_true if num_true else np.nan,
        }
        yield compared.row(
            metric,
            {name: None if np.isnan(value) else float(value) for name, value in values.items()},
            "",
            note=f"{len(pairs)} images, {num_compared} pixels{f', every {step}th taken' if step > 1 else ''}; scale "
            f"{factor:.5g}; registration {registration}",
        )


def _cloud_alignment(compared: _Compared) -> tuple[Sim3, str]:
    align = compared.options.align
    if align == "sim3" and compared.width < MIN_RELATIVE_WIDTH:
        fit, how = fit_camera_similarity(compared.estimated, compared.reference)
        return fit, f"sim3 ({how})"
    if align == "se3" and compared.width < MIN_RELATIVE_WIDTH:
        raise DegenerateAlignmentError(
            "the camera centres are nearly on a line and do not determine where the cloud goes; align by sim3 or none"
        )
    return align_centres(compared.estimated, compared.reference, align), align
