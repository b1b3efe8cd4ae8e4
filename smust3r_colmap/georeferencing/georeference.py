"""Where on earth a model is: the table of contents of the room.

Control points decide where there are enough of them, positions of images otherwise, and both together where control
points are too few; the heights and places of a receiver may then be off by one shift in common. Check points are
compared and never fitted. Everything that is left out has its reason.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from smust3r_colmap.errors import DegenerateAlignmentError, InputError
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.georeferencing.accuracy import Accuracy
from smust3r_colmap.georeferencing.control import (
    DEFAULT_SIGMA_H_M,
    DEFAULT_SIGMA_V_M,
    MIN_CONTROL,
    ControlFit,
    fit_control,
)
from smust3r_colmap.georeferencing.crs import Crs, transform
from smust3r_colmap.georeferencing.frame import LocalFrame
from smust3r_colmap.georeferencing.positions import PositionsFit, fit_positions
from smust3r_colmap.georeferencing.similarity import (
    MAX_SCALE_SIGMA,
    MAX_TILT_SIGMA_DEG,
    Correspondences,
    Fit,
    fit,
    of_two,
)
from smust3r_colmap.georeferencing.survey_in_crs import (
    FAR_M,
    Altitude,
    ImageNames,
    coordinates,
    crs_of_points,
    crs_of_positions,
    in_area,
    near_the_others,
    target_crs,
    tell_unknown,
)
from smust3r_colmap.georeferencing.tags import (
    Triangulated,
    View,
    tag_limit_px,
    tags_on_one_pixel,
    triangulate,
    without_wrong_tags,
)
from smust3r_colmap.georeferencing.up_direction import UpDirection, find_up
from smust3r_colmap.importers.survey import ImagePosition, ImagePositions, Role, SurveyPoint, SurveyPoints, Tag

OPEN_TILT_DEG = 10 * MAX_TILT_SIGMA_DEG
"""A turn that is known less well than this is open."""
_SMALL_PART = 0.6
"""Of width and height, within which all tags of a set lie when they were made in a smaller copy of the images."""
_ENOUGH_TAGS = 8
"""By chance so many tags lie within that part of both with probability 0.0003."""

MANY_PIXELS = 10.0
"""On the ground, of the horizontal error of surveyed points, which is below one where points and model are sound. (0.25
on the rendered survey; 120 on copr_gcp, whose points are of a hand-held receiver.)"""
_FAULTS_SHOWN = 2
"""Of the records that could not be used, where nothing came out; the last are about all tags together."""

Basis = Literal["control points", "positions of images", "control points and positions of images"]


@dataclass(frozen=True, kw_only=True, eq=False)
class ModelGeometry:
    """What is needed of a COLMAP model.

    Args:
        names: of the N images with a pose. cam_from_model: (N, 3, 4). cameras: of each image.
        points_model: (P, 3). pixel_size_model: of a pixel on the surface, at the median; None without points.
    """

    names: tuple[str, ...]
    cam_from_model: FloatArray
    cameras: tuple[Intrinsics, ...]
    points_model: FloatArray
    pixel_size_model: float | None

    @property
    def centres_model(self) -> FloatArray:
        """(N, 3) of the cameras."""
        centres: FloatArray = -np.einsum("nji,nj->ni", self.cam_from_model[:, :, :3], self.cam_from_model[:, :, 3])
        return centres


@dataclass(frozen=True, kw_only=True, eq=False)
class FixResult:
    """The position of one image.

    Args:
        image: of the model. origin: where the position was read. crs_xyz: (3,) in the CRS.
        residual_m: (3,) position less the place of the camera, east, north, up; NaN where there is no height.
        sigma_m: (2,) in the plane and upwards, in the size of the errors; NaN where they are not known.
        left_out, without_height: why the position, or its height, was not used.
    """

    image: str
    origin: str
    crs_xyz: FloatArray
    residual_m: FloatArray
    sigma_m: FloatArray
    left_out: str | None = None
    without_height: str | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class TagResult:
    """One tag; ``error_px`` is its distance from where the other tags of the point put it, None where they do not."""

    tag: Tag
    error_px: float | None = None
    left_out: str | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class PointResult:
    """One surveyed point.

    Args:
        point: as read. crs_xyz: (3,) in the CRS.
        model_xyz: (3,) from its tags; None where they determine none.
        residual_m: (3,) coordinates less the place by tags and fit, east, north, up; NaN where not compared.
        leave_one_out_m: (3,) the same by a fit without this point; NaN where there is none.
        left_out: why the point was not used, or not compared.
        tags: in the order of the list; without those of images that are not in the model.
    """

    point: SurveyPoint
    crs_xyz: FloatArray
    model_xyz: FloatArray | None
    residual_m: FloatArray
    leave_one_out_m: FloatArray
    left_out: str | None
    tags: tuple[TagResult, ...]

    @property
    def role(self) -> Role:
        """What the point is for."""
        return self.point.role


@dataclass(frozen=True, kw_only=True, eq=False)
class Georeference:
    """Where the model is.

    Args:
        model: what was georeferenced.
        frame: the local frame and the CRS. local_from_model: the similarity.
        basis: what it was fitted to. up: the direction that was needed beside it, or None.
        tilt_sigma_deg, scale_sigma: of the turn that is known least, and of the scale, relative.
        gps_offset_m: (3,) of all positions, where they were fitted beside control points; else None.
        fixes, points: every record that belongs to the model, also those left out.
        faults: records that could not be used at all, with file and line.
        warnings: what is weak in the result, and every record that was left out of the fit.
        pixel_size_m: of a pixel on the ground, at the median; None where the model has no points.
    """

    model: ModelGeometry
    frame: LocalFrame
    local_from_model: Sim3
    basis: Basis
    up: UpDirection | None
    tilt_sigma_deg: float
    scale_sigma: float
    gps_offset_m: FloatArray | None
    fixes: tuple[FixResult, ...]
    points: tuple[PointResult, ...]
    faults: tuple[str, ...]
    warnings: tuple[str, ...]
    pixel_size_m: float | None

    @property
    def crs_from_model(self) -> FloatArray:
        """(4, 4) from the model to the CRS less ``frame.offset_m``, linear about the origin of the frame."""
        linear: FloatArray = self.frame.linear_crs_from_local() @ self.local_from_model.matrix
        return linear

    def to_crs(self, points_model: FloatArray) -> FloatArray:
        """(N, 3) coordinates in the CRS, exactly, of points (N, 3) of the model."""
        return self.frame.crs_from_local(self.local_from_model.apply(points_model))

    def accuracies(self) -> dict[str, Accuracy]:
        """Of positions, control and check points apart; of control points also as if each had been a check point."""
        control = [one for one in self.points if one.left_out is None and one.role not in ("check", "tie")]
        check = [one for one in self.points if one.left_out is None and one.role == "check"]
        residuals = {
            "gps": [one.residual_m for one in self.fixes if one.left_out is None],
            "control": [_counted(one) for one in control],
            "control_leave_one_out": [one.leave_one_out_m for one in control],
            "check": [one.residual_m for one in check],
        }
        found = {name: Accuracy.of(np.array(rows).reshape(-1, 3)) for name, rows in residuals.items()}
        return {name: one for name, one in found.items() if one is not None}


def _counted(one: PointResult) -> FloatArray:
    """The residual in the coordinates that held the model."""
    return np.where(np.isfinite(_sigma_of(one.point)), one.residual_m, np.nan)


def georeference(
    model: ModelGeometry,
    positions: ImagePositions | None,
    points: SurveyPoints | None,
    *,
    crs: str,
    altitude: Altitude,
    height_offset_m: float,
    rng: np.random.Generator,
) -> Georeference:
    """Find the similarity from the model to the ground.

    Args:
        model: the COLMAP model. positions, points: at least one of them.
        crs: of the result, or auto. altitude: what heights of positions refer to. height_offset_m: added to them.
        rng: of the consensus.

    Raises:
        InputError: a CRS cannot be used or does not fit the place, or no record is left.
        DegenerateAlignmentError: what is left determines no similarity.
        MissingDependencyError: pyproj is not installed.
    """
    names = ImageNames(model.names)
    faults = [*(positions.faults if positions else ()), *(points.faults if points else ())]
    survey = _Survey.of(positions, points, names, crs=crs, altitude=altitude, offset=height_offset_m, faults=faults)
    frame = LocalFrame.about(np.vstack([survey.points_xyz, survey.fixes_xyz]), survey.crs)
    tagged = _tagged_points(model, survey.points, names, faults)
    up = find_up(model.cam_from_model, _up_cams(survey.fixes, len(model.names)), model.points_model)
    gps = _gps(model, survey, frame, up, rng)
    local_points = frame.local_from_crs(survey.points_xyz)
    control, rows_of = _control(survey.points, tagged, local_points)
    try:
        solved = _decide(control, gps, up)
    except DegenerateAlignmentError as error:
        said = f"; besides: {'; '.join(faults[-_FAULTS_SHOWN:])}" if faults else ""
        raise DegenerateAlignmentError(f"{error}{said}") from error
    scale = float(solved.fit.local_from_model.scale)
    pixel_size_m = None if model.pixel_size_model is None else model.pixel_size_model * scale
    fixes = _fix_results(model, survey, frame, gps, solved)
    results = _point_results(survey, tagged, local_points, solved, rows_of)
    return Georeference(
        model=model,
        frame=frame,
        local_from_model=solved.fit.local_from_model,
        basis=solved.basis,
        up=solved.up,
        tilt_sigma_deg=solved.fit.tilt_sigma_deg,
        scale_sigma=solved.fit.scale_sigma,
        gps_offset_m=solved.fit.offset_m if solved.basis.startswith("control points and") else None,
        fixes=fixes,
        points=results,
        faults=tuple(faults),
        warnings=(*_warnings(fixes, results, solved, gps, tagged), *_doubts(results, solved, pixel_size_m)),
        pixel_size_m=pixel_size_m,
    )


# ------------------------------------------------------------------------- what was surveyed
@dataclass(frozen=True, kw_only=True, eq=False)
class _Survey:
    """Records of images of the model, in the CRS of the result.

    Args:
        fixes: by index of the image. fixes_xyz: (F, 3) in their order. far: of those, by index, why not used.
    """

    crs: Crs | None
    fixes: Mapping[int, ImagePosition]
    fixes_xyz: FloatArray
    far: Mapping[int, str]
    points: tuple[SurveyPoint, ...]
    points_xyz: FloatArray

    @classmethod
    def of(
        cls,
        positions: ImagePositions | None,
        points: SurveyPoints | None,
        names: ImageNames,
        *,
        crs: str,
        altitude: Altitude,
        offset: float,
        faults: list[str],
    ) -> _Survey:
        own_points = crs_of_points(points) if points else None
        surveyed = in_area(points.points, own_points, faults) if points else []
        own_positions = crs_of_positions(positions, altitude) if positions else None
        if positions and points and (own_points is None) != (own_positions is None):
            if positions.crs_origin != "EXIF":
                raise InputError(
                    f"{positions.crs_origin}: positions in {positions.crs!r} and control points in {points.crs!r} "
                    "cannot be brought together"
                )
            faults.append("the positions in EXIF are not used: the control points are in no CRS")
            positions = None
        by_image = _by_image(positions, own_positions, names, altitude, offset, faults) if positions else {}
        if points and not surveyed and not by_image:
            raise InputError(f"{points.crs_origin}: no point is left" + (f": {faults[-1]}" if faults else ""))
        if not surveyed and not by_image:
            raise InputError("no image of the model has a position" + (f": {faults[-1]}" if faults else ""))
        points_xyz, fixes_xyz = coordinates(surveyed), coordinates(by_image.values())
        sources = [
            (source, xyz)
            for source, xyz in ((own_points, points_xyz), (own_positions, fixes_xyz))
            if source is not None and len(xyz)
        ]
        target = target_crs(crs, sources, faults) if sources else None
        if target is not None:
            points_xyz = transform(points_xyz, own_points, target) if own_points else points_xyz
            fixes_xyz = transform(fixes_xyz, own_positions, target) if own_positions else fixes_xyz
        _refuse_two_places(points, points_xyz, positions, fixes_xyz)
        near = near_the_others(np.nan_to_num(fixes_xyz, posinf=1e12, neginf=-1e12))
        far = {i: _far(one, by_image) for (i, one), ok in zip(by_image.items(), near, strict=True) if not ok}
        faults.extend(f"{by_image[i].origin}: left out: {why}" for i, why in far.items())
        return cls(
            crs=target,
            fixes={i: one for i, one in by_image.items() if i not in far},
            fixes_xyz=fixes_xyz[near],
            far=far,
            points=tuple(surveyed),
            points_xyz=points_xyz,
        )


def _by_image(
    positions: ImagePositions,
    crs: Crs | None,
    names: ImageNames,
    altitude: Altitude,
    offset: float,
    faults: list[str],
) -> dict[int, ImagePosition]:
    found: dict[int, ImagePosition] = {}
    unknown: dict[str, str] = {}
    for one in in_area(positions.positions, crs, faults):
        index = names.find(one.image)
        if index is None:
            unknown[one.origin] = one.image
            continue
        z = one.relative_z_m if altitude == "relative" else None if altitude == "none" else one.z
        found[index] = replace(one, z=None if z is None else z + offset)
    tell_unknown(unknown, "positions", faults)
    if altitude == "relative" and found and all(one.z is None for one in found.values()):
        faults.append("--altitude relative: no image says its height above take-off; all are taken as without height")
    return dict(sorted(found.items()))


def _far(one: ImagePosition, all_fixes: Mapping[int, ImagePosition]) -> str:
    middle = np.median(coordinates(all_fixes.values())[:, :2], axis=0)
    as_far = np.hypot(*(np.array([one.x, one.y]) - middle))
    swapped = np.hypot(*(np.array([one.y, one.x]) - middle)) < 0.01 * as_far
    hint = "; x and y, or latitude and longitude, are swapped" if swapped else ""
    return f"the position is more than {FAR_M / 1000:.0f} km from the others{hint}"


def _refuse_two_places(
    points: SurveyPoints | None, points_xyz: FloatArray, positions: ImagePositions | None, fixes_xyz: FloatArray
) -> None:
    if points is None or positions is None or not len(points_xyz) or not len(fixes_xyz):
        return
    apart = float(np.hypot(*(np.median(points_xyz[:, :2], axis=0) - np.median(fixes_xyz[:, :2], axis=0))))
    if not apart < FAR_M:
        raise InputError(
            f"{points.crs_origin}: in {points.crs}, the points lie {apart / 1000:.0f} km from the positions of images "
            f"({positions.crs}, {positions.crs_origin}); correct the CRS, or leave the positions out with --geo off"
        )


def _up_cams(fixes: Mapping[int, ImagePosition], count: int) -> FloatArray:
    """(N, 3) by gimbal angles; NaN where there are none."""
    up = np.full((count, 3), np.nan)
    for i, one in fixes.items():
        if one.up_cam is not None:
            up[i] = one.up_cam
    return up


# -------------------------------------------------------------------------- positions of images
@dataclass(frozen=True, kw_only=True, eq=False)
class _Gps:
    """The fit to positions, or why there is none. images: of its rows."""

    images: tuple[int, ...]
    local: FloatArray
    fitted: PositionsFit | None
    failure: DegenerateAlignmentError | None = None


def _gps(
    model: ModelGeometry, survey: _Survey, frame: LocalFrame, up: UpDirection | None, rng: np.random.Generator
) -> _Gps:
    images, local = tuple(survey.fixes), frame.local_from_crs(survey.fixes_xyz)
    none = float("nan")
    sigma = [
        (none if one.sigma_h_m is None else one.sigma_h_m, none if one.sigma_v_m is None else one.sigma_v_m)
        for one in survey.fixes.values()
    ]
    try:
        fitted = fit_positions(
            model.centres_model[list(images)],
            local,
            np.array(sigma, dtype=np.float64).reshape(-1, 2),
            names=[model.names[i] for i in images],
            up=up,
            rng=rng,
        )
    except DegenerateAlignmentError as error:
        return _Gps(images=images, local=local, fitted=None, failure=error)
    return _Gps(images=images, local=local, fitted=fitted)


# --------------------------------------------------------------------------- tagged points
@dataclass(frozen=True, kw_only=True, eq=False)
class _Tagged:
    """A point in the model, or why not.

    Args:
        tags: of images of the model. found: from them, or None. reason: where it is None, or ambiguous.
        same_pixel: by row of a tag, the label of another point that is tagged there.
    """

    tags: tuple[Tag, ...]
    found: Triangulated | None
    reason: str | None
    same_pixel: Mapping[int, str]


def _tagged_points(
    model: ModelGeometry, points: Sequence[SurveyPoint], names: ImageNames, faults: list[str]
) -> list[_Tagged]:
    unknown: dict[str, str] = {}
    tags: dict[str, list[Tag]] = {}
    views: dict[str, list[View]] = {}
    everything: list[tuple[Tag, View]] = []
    for point in points:
        tags[point.label], views[point.label] = [], []
        for tag in point.tags:
            index = names.find(tag.image)
            if index is None:
                unknown[tag.origin] = tag.image
                continue
            view = View(
                image=model.names[index],
                xy=np.array([tag.x_px, tag.y_px]),
                camera=model.cameras[index],
                cam_from_model=model.cam_from_model[index],
            )
            everything.append((tag, view))
            if _is_inside(view):
                tags[point.label].append(tag)
                views[point.label].append(view)
            else:
                faults.append(
                    f"{tag.origin}: left out: pixel ({tag.x_px:.0f}, {tag.y_px:.0f}) lies outside of {tag.image}, "
                    f"which has {view.camera.width} x {view.camera.height}"
                )
    tell_unknown(unknown, "tags", faults)
    _tell_other_size(everything, faults)
    whole = [found for label in views if (found := triangulate(views[label])) is not None]
    longest = max((view.longer_side for one in views.values() for view in one), default=0)
    limit = tag_limit_px(whole, longest)
    shared = tags_on_one_pixel(views)
    return [_tagged(point.label, tags, views, limit, shared) for point in points]


def _is_inside(view: View) -> bool:
    x, y = view.xy
    return bool(0 <= x <= view.camera.width and 0 <= y <= view.camera.height)


def _tell_other_size(everything: Sequence[tuple[Tag, View]], faults: list[str]) -> None:
    """Tags of a copy of another size fit nowhere, and nobody looks for that."""
    if len(everything) < _ENOUGH_TAGS:
        return
    size = np.array([(view.camera.width, view.camera.height) for _, view in everything], dtype=np.float64)
    relative = np.array([view.xy for _, view in everything]) / size
    outside = float((relative > 1).any(axis=1).mean())
    if outside > 0.3:
        faults.append(
            f"{outside:.0%} of the tags lie outside of their images, up to {relative.max():.2g} times the size: they "
            "were made in images of another size"
        )
    elif relative.max() < _SMALL_PART:
        faults.append(
            f"all {len(everything)} tags lie within the first {relative.max():.0%} of width and height: they may have "
            "been made in smaller copies of the images"
        )


def _tagged(
    label: str,
    tags: Mapping[str, Sequence[Tag]],
    views: Mapping[str, Sequence[View]],
    limit_px: float,
    shared: Sequence[tuple[str, str, str]],
) -> _Tagged:
    own = views[label]
    same = {
        k: b if a == label else a
        for image, a, b in shared
        for k, view in enumerate(own)
        if view.image == image and label in (a, b)
    }
    answers = without_wrong_tags(own, limit_px)
    reason: str | None = None
    if not own:
        reason = "no tag in an image of the model"
    elif len(own) == 1:
        reason = f"one tag in the model ({own[0].image}); two are needed"
    elif not answers and triangulate(own) is None:
        reason = f"its {len(own)} tags determine no place: the images see it from nearly one direction, or contradict"
    elif not answers:
        reason = f"its {len(own)} tags contradict each other by more than {limit_px:.0f} px"
    elif len(answers) > 1:
        unsure = ", ".join(own[k].image for one in answers for k in one.left_out)
        reason = f"one of its tags is wrong, and it is not clear which: {unsure}"
    return _Tagged(
        tags=tuple(tags[label]), found=answers[0] if len(answers) == 1 else None, reason=reason, same_pixel=same
    )


# ------------------------------------------------------------------------------- the decision
@dataclass(frozen=True, kw_only=True, eq=False)
class _Solved:
    """The fit, what it stands on, and, where control points decided, their fit. notes: weaknesses."""

    fit: Fit
    basis: Basis
    up: UpDirection | None = None
    control: ControlFit | None = None
    notes: tuple[str, ...] = ()


def _control(
    points: Sequence[SurveyPoint], tagged: Sequence[_Tagged], local: FloatArray
) -> tuple[Correspondences, dict[int, int]]:
    """Rows of the points that hold the model, and the row of each by its index."""
    used = [k for k, one in enumerate(tagged) if one.found is not None and points[k].role not in ("check", "tie")]
    rows_of = {k: row for row, k in enumerate(used)}
    sigma = np.array([_sigma_of(points[k]) for k in used], dtype=np.float64).reshape(-1, 3)
    model = np.array([one.found.point_model for one in (tagged[k] for k in used) if one.found is not None])
    rows = Correspondences(
        model=model.reshape(-1, 3), local=local[used], sigma=sigma, shifted=np.zeros(len(used), np.bool_)
    )
    return rows, rows_of


def _sigma_of(point: SurveyPoint) -> tuple[float, float, float]:
    """Infinite for coordinates that do not hold the model."""
    plane = np.inf if point.role == "vertical" else (point.sigma_h_m or DEFAULT_SIGMA_H_M)
    height = np.inf if point.role == "horizontal" or point.z is None else (point.sigma_v_m or DEFAULT_SIGMA_V_M)
    return plane, plane, height


def _decide(control: Correspondences, gps: _Gps, up: UpDirection | None) -> _Solved:
    """Control points alone, both together, or positions alone."""
    open_by_control = "no control point is in the model"
    if control.complete.sum() >= MIN_CONTROL:
        alone = fit_control(control)
        if alone.fit.tilt_sigma_deg < OPEN_TILT_DEG and alone.fit.scale_sigma < MAX_SCALE_SIGMA * 2:
            return _Solved(fit=alone.fit, basis="control points", control=alone)
        open_by_control = (
            f"the {control.complete.sum()} control points lie nearly on a line or are too inexact (the turn is known "
            f"to {alone.fit.tilt_sigma_deg:.2g} degrees)"
        )
    elif len(control):
        open_by_control = (
            f"{control.complete.sum()} of {len(control)} control points in the model have three coordinates; alone, "
            f"{MIN_CONTROL} would be needed"
        )
    if gps.fitted is None and up is not None and control.complete.sum() >= 2:
        levelled = _by_control_and_up(control, up)
        if levelled is not None:
            return _Solved(fit=levelled, basis="control points", up=up, notes=(open_by_control,))
    if gps.fitted is None:
        assert gps.failure is not None
        raise DegenerateAlignmentError(f"{open_by_control}; and by the positions of images: {gps.failure}")
    if not len(control):
        return _Solved(fit=gps.fitted.fit, basis="positions of images", up=gps.fitted.up)
    kept = np.array([k not in gps.fitted.left_out for k in range(len(gps.images))])
    fixes = gps.fitted.rows.take(kept)
    with_offset = control.complete.any()
    both = replace(fixes, shifted=np.full(len(fixes), bool(with_offset))).joined(control)
    joined = fit(both, gps.fitted.fit.local_from_model)
    needed = up if joined.tilt_sigma_deg > MAX_TILT_SIGMA_DEG else None
    if needed is not None:
        joined = fit(both, gps.fitted.fit.local_from_model, up_model=needed.up_model, up_sigma_deg=needed.sigma_deg)
    return _Solved(fit=joined, basis="control points and positions of images", up=needed, notes=(open_by_control,))


def _by_control_and_up(control: Correspondences, up: UpDirection) -> Fit | None:
    """From the two complete control points that are farthest apart; none, or two above each other, give none."""
    complete = control.take(control.complete)
    apart = np.linalg.norm(complete.local[:, None] - complete.local[None], axis=2)
    first, second = np.unravel_index(int(np.argmax(apart)), apart.shape)
    ends = [int(first), int(second)]
    start = of_two(complete.model[ends], complete.local[ends], up.up_model)
    if start is None:
        return None
    return fit(control, start, up_model=up.up_model, up_sigma_deg=up.sigma_deg, robust=False)


# ------------------------------------------------------------------------------------ results
def _fix_results(
    model: ModelGeometry, survey: _Survey, frame: LocalFrame, gps: _Gps, solved: _Solved
) -> tuple[FixResult, ...]:
    residuals = gps.local - solved.fit.local_from_model.apply(model.centres_model[list(gps.images)])
    fitted = gps.fitted
    results = []
    for row, i in enumerate(gps.images):
        sigma = np.full(2, np.nan) if fitted is None else fitted.rows.sigma[row, [0, 2]]
        results.append(
            FixResult(
                image=model.names[i],
                origin=survey.fixes[i].origin,
                crs_xyz=survey.fixes_xyz[row],
                residual_m=residuals[row],
                sigma_m=np.where(np.isfinite(sigma), sigma, np.nan),
                left_out=None if fitted is None else fitted.left_out.get(row),
                without_height=None if fitted is None else fitted.without_height.get(row),
            )
        )
    return tuple(results)


def _point_results(
    survey: _Survey,
    tagged: Sequence[_Tagged],
    local: FloatArray,
    solved: _Solved,
    rows_of: Mapping[int, int],
) -> tuple[PointResult, ...]:
    results = []
    for k, (point, one) in enumerate(zip(survey.points, tagged, strict=True)):
        found = one.found
        residual, outside, left_out = np.full(3, np.nan), np.full(3, np.nan), one.reason
        if found is not None and point.role != "tie":
            residual = local[k] - solved.fit.local_from_model.apply(found.point_model[None])[0]
        if solved.control is not None and k in rows_of:
            outside = solved.control.leave_one_out[rows_of[k]]
            left_out = solved.control.left_out.get(rows_of[k])
        results.append(
            PointResult(
                point=point,
                crs_xyz=survey.points_xyz[k],
                model_xyz=None if found is None else found.point_model,
                residual_m=residual,
                leave_one_out_m=outside,
                left_out=left_out,
                tags=_tag_results(one),
            )
        )
    return tuple(results)


def _tag_results(one: _Tagged) -> tuple[TagResult, ...]:
    results = []
    for row, tag in enumerate(one.tags):
        reason = None if one.found is None else one.found.left_out.get(row)
        other = f"the pixel of {one.same_pixel[row]} in the same image" if row in one.same_pixel else None
        if reason is not None and other is not None:
            reason = f"{reason}; it has {other}"
        error = None if one.found is None or not np.isfinite(one.found.errors_px[row]) else one.found.errors_px[row]
        results.append(TagResult(tag=tag, error_px=None if error is None else float(error), left_out=reason))
    return tuple(results)


def _warnings(
    fixes: Sequence[FixResult],
    points: Sequence[PointResult],
    solved: _Solved,
    gps: _Gps,
    tagged: Sequence[_Tagged],
) -> list[str]:
    told = [
        f"{one.point.label}, tag in {tag.tag.image} ({tag.tag.origin}): left out: {tag.left_out}"
        for one in points
        for tag in one.tags
        if tag.left_out
    ]
    told += [
        f"{one.point.label}, tag in {one.tags[row].tag.image} ({one.tags[row].tag.origin}): is on the pixel of {other}"
        for one, at in zip(points, tagged, strict=True)
        for row, other in at.same_pixel.items()
        if one.tags[row].left_out is None
    ]
    told += [f"{one.point.label} ({one.point.origin}): left out: {one.left_out}" for one in points if one.left_out]
    told += [f"{one.image} ({one.origin}): left out: {one.left_out}" for one in fixes if one.left_out]
    told += [
        f"{one.image} ({one.origin}): its height is left out: {one.without_height}"
        for one in fixes
        if one.without_height
    ]
    told += solved.notes
    if gps.fitted is not None and gps.fitted.tilt_by_heights_deg is not None:
        told.append(
            f"the heights of the positions would tilt the model by {gps.fitted.tilt_by_heights_deg:.0f} degrees; they "
            "are not used for levelling"
        )
    if solved.up is not None:
        told.append(f"which way is up was taken from {solved.up.source}: the positions do not decide it")
    if solved.fit.tilt_sigma_deg > MAX_TILT_SIGMA_DEG:
        told.append(f"the model is levelled to {solved.fit.tilt_sigma_deg:.2g} degrees only")
    if gps.failure is not None and len(gps.images) > 1 and solved.basis == "control points":
        told.append(f"the positions of images are not compared: {gps.failure}")
    return told


def _doubts(points: Sequence[PointResult], solved: _Solved, pixel_size_m: float | None) -> list[str]:
    """What the residuals of surveyed points say of the whole."""
    if solved.control is None:
        return []
    check = [one.residual_m for one in points if one.role == "check" and one.left_out is None]
    outside = [one.leave_one_out_m for one in points if one.left_out is None]
    what, measured = ("check points", Accuracy.of(np.array(check))) if check else ("", None)
    if measured is None:
        what, measured = "control points, each left out of the fit,", Accuracy.of(np.array(outside))
    if measured is None:
        return [f"nothing checks the {MIN_CONTROL} control points: no other point is left to compare"]
    if pixel_size_m is not None and measured.horizontal > MANY_PIXELS * pixel_size_m:
        off = f"{measured.horizontal:.3g} m, {measured.horizontal / pixel_size_m:.0f} pixels on the ground"
        return [f"{what} are {off} off: the points are not exact, or the model is bent"]
    return []
