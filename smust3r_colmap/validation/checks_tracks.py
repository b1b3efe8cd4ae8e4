"""Rules about points, their tracks and the observations that the images list."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from smust3r_colmap.geometry.arrays import BoolArray, IntArray
from smust3r_colmap.validation.description import NO_POINT, Points, Subject
from smust3r_colmap.validation.projection import index_of
from smust3r_colmap.validation.rules import Evidence, Severity, measured, offenders, rule

MIN_OBSERVATIONS = 15
"""Fewer hold an image badly; COLMAP's mapper itself wants 30 inliers to place one."""

_MAX_OUTSIDE_SHARE = 0.01
"""COLMAP's undistortion leaves observations a little outside, so a few are no error."""

_REFINE = "`smust3r-colmap refine MODEL --images DIR` finds real tracks"


@rule("points-none", "the model has no points", severity=Severity.NOTE, advice=_REFINE)
def _no_points(subject: Subject) -> Evidence | None:
    points = subject.model.points
    return measured("0 points") if points is not None and len(points) == 0 else None


@rule("track-none", "points without a track", severity=Severity.NOTE, advice=_REFINE)
def _no_track(subject: Subject) -> Evidence | None:
    """Where no point at all has one, the rule ``tracks-all-missing`` says so."""
    return _points_where(subject, lambda points: (points.track_length == 0) & (len(points.track_images) > 0))


@rule(
    "tracks-all-missing",
    "no point has a track, so nothing says which image sees which point",
    severity=Severity.WARNING,
    advice=_REFINE,
)
def _no_tracks_at_all(subject: Subject) -> Evidence | None:
    points = subject.model.points
    if points is None or len(points) == 0 or len(points.track_images) > 0:
        return None
    return measured(f"{len(points):,} points, 0 observations")


@rule(
    "track-single",
    "points seen by one image only",
    severity=Severity.WARNING,
    advice=f"{_REFINE}; or delete these points: one view says nothing about where a point is",
)
def _single(subject: Subject) -> Evidence | None:
    return _points_where(subject, lambda points: points.track_length == 1)


@rule(
    "tracks-short",
    "most points are seen by two images only",
    severity=Severity.NOTE,
    advice="match more pairs of images: the third view is the first that can show a point to be wrong",
)
def _short(subject: Subject) -> Evidence | None:
    points = subject.model.points
    if points is None:
        return None
    num_two, num_tracked = int((points.track_length == 2).sum()), int((points.track_length >= 2).sum())
    if 2 * num_two <= num_tracked:
        return None
    return Evidence(count=num_two, of=num_tracked, unit="points with a track", example="")


@rule(
    "track-pseudo-zero",
    "tracks of `0 0` pairs, which are no observations",
    severity=Severity.WARNING,
    advice=f"the program that wrote the model made the tracks up; {_REFINE}",
)
def _pseudo_zero(subject: Subject) -> Evidence | None:
    return _points_where(subject, lambda points: pseudo_zero(subject, points))


def pseudo_zero(subject: Subject, points: Points) -> BoolArray:
    """(P,) the track is nothing but (0, 0), more than once or with no image 0."""
    zero = (points.track_images == 0) & (points.track_rows == 0)
    all_zero = _any_element(points, ~zero) == 0
    has_image_zero = bool((subject.model.images.ids == 0).any())
    return np.asarray(all_zero & (points.track_length > (1 if has_image_zero else 0)), np.bool_)


def _any_element(points: Points, chosen: BoolArray) -> IntArray:
    """(P,) how many of the chosen elements each point has."""
    return np.bincount(points.point_of_element[chosen], minlength=len(points))


@rule(
    "track-repeats",
    "tracks that name the same observation twice",
    severity=Severity.WARNING,
    advice="keep each pair of image and observation once",
)
def _repeats(subject: Subject) -> Evidence | None:
    return _points_where(subject, lambda points: _repeated(subject, points) & ~pseudo_zero(subject, points))


def _repeated(subject: Subject, points: Points) -> BoolArray:
    """(P,) an observation that is there stands twice in the track."""
    there = np.flatnonzero(subject.projection.row >= 0)
    rows = subject.projection.row[there]
    again = np.bincount(rows, minlength=1)[rows] > 1  # by this point or by two
    named = np.stack([points.point_of_element[there[again]], rows[again]])
    pairs, times = np.unique(named, axis=1, return_counts=True)
    return np.bincount(pairs[0][times > 1], minlength=len(points)) > 0


@rule(
    "track-dangling",
    "tracks that name images or observations that are not there",
    severity=Severity.WARNING,
    advice="drop these elements, and points left with less than two",
)
def _dangling(subject: Subject) -> Evidence | None:
    points = subject.model.points
    if points is None:
        return None
    lost = (subject.projection.row < 0) & ~pseudo_zero(subject, points)[points.point_of_element]
    found = np.flatnonzero(lost)
    if len(found) == 0:
        return None
    first = found[0]
    example = (
        f"point {points.ids[points.point_of_element[first]]}: image {points.track_images[first]}, "
        f"observation {points.track_rows[first]}"
    )
    return Evidence(count=len(found), of=len(lost), unit="elements of tracks", example=example)


@rule(
    "track-disagrees",
    "tracks name an observation that names another point",
    severity=Severity.WARNING,
    advice="an observation belongs to one point; write the model again from one source",
)
def _disagrees(subject: Subject) -> Evidence | None:
    points = subject.model.points
    if points is None:
        return None
    rows = subject.projection.row
    there = np.flatnonzero((rows >= 0) & ~pseudo_zero(subject, points)[points.point_of_element])
    point_ids = points.ids[points.point_of_element[there]]
    named = subject.model.images.point_ids[rows[there]]
    wrong = np.flatnonzero(named != point_ids)
    if len(wrong) == 0:
        return None
    element = there[wrong[0]]
    example = (
        f"point {point_ids[wrong[0]]}: observation {points.track_rows[element]} of image "
        f"{points.track_images[element]} names {_point_name(int(named[wrong[0]]))}"
    )
    return Evidence(count=len(wrong), of=len(rows), unit="elements of tracks", example=example)


def _point_name(point_id: int) -> str:
    return "no point" if point_id == NO_POINT else f"point {point_id}"


@rule(
    "observation-dangling",
    "observations name points that are not there",
    severity=Severity.WARNING,
    advice="set their point id to -1; were points deleted from one file only?",
)
def _observation_dangling(subject: Subject) -> Evidence | None:
    points, images = subject.model.points, subject.model.images
    if points is None:
        return None
    named = np.flatnonzero(images.point_ids != NO_POINT)
    lost = named[index_of(points.ids, images.point_ids[named]) < 0]
    return _observations(subject, lost, [f"point {images.point_ids[row]}" for row in lost[:1]])


@rule(
    "observation-one-sided",
    "observations name a point whose track does not name them",
    severity=Severity.WARNING,
    advice="write the model again from one source; the track of a point and the images must agree",
)
def _one_sided(subject: Subject) -> Evidence | None:
    points, images = subject.model.points, subject.model.images
    if points is None:
        return None
    in_track = np.zeros(len(images.point_ids), np.bool_)
    in_track[subject.projection.row[subject.projection.row >= 0]] = True
    candidates = np.flatnonzero((images.point_ids != NO_POINT) & ~in_track)
    alone = candidates[index_of(points.ids, images.point_ids[candidates]) >= 0]
    return _observations(subject, alone, [f"point {images.point_ids[row]}" for row in alone[:1]])


@rule(
    "observation-outside",
    "observations outside the image",
    severity=Severity.WARNING,
    advice="coordinates must be in pixels of the camera's size",
)
def _outside(subject: Subject) -> Evidence | None:
    images, cameras = subject.model.images, subject.model.camera_by_id
    unknown = (np.inf, np.inf)
    sizes = [
        (cameras[camera_id].width, cameras[camera_id].height) if camera_id in cameras else unknown
        for camera_id in images.camera_ids.tolist()
    ]
    limits = np.repeat(np.array(sizes, np.float64).reshape(-1, 2), images.num_rows, axis=0)
    used = images.point_ids != NO_POINT
    outside = np.flatnonzero(used & ((images.xy_img < 0) | (images.xy_img > limits)).any(axis=1))
    if len(outside) <= _MAX_OUTSIDE_SHARE * max(1, int(used.sum())):
        return None
    return _observations(subject, outside, [f"({x:.0f}, {y:.0f})" for x, y in images.xy_img[outside[:1]]])


def _observations(subject: Subject, rows: IntArray, details: list[str]) -> Evidence | None:
    """Evidence of rows of ``Images.xy_img``, with the image and the detail of the first."""
    images = subject.model.images
    if len(rows) == 0:
        return None
    image = int(np.searchsorted(images.starts, rows[0], side="right")) - 1
    example = f"{details[0]} in {images.names[image]!r}, observation {rows[0] - images.starts[image]}"
    num_used = int((images.point_ids != NO_POINT).sum())
    return Evidence(count=len(rows), of=num_used, unit="observations", example=example)


@rule("image-unobserved", "images that see no point", severity=Severity.NOTE, advice=_REFINE)
def _unobserved(subject: Subject) -> Evidence | None:
    return _images_with(subject, lambda count: count == 0)


@rule(
    "image-weak",
    f"images with fewer than {MIN_OBSERVATIONS} observations",
    severity=Severity.NOTE,
    advice="their poses hang by little; look at them, match them with more images or leave them out",
)
def _weak(subject: Subject) -> Evidence | None:
    return _images_with(subject, lambda count: (count > 0) & (count < MIN_OBSERVATIONS))


def _images_with(subject: Subject, wrong: Callable[[IntArray], BoolArray]) -> Evidence | None:
    images = subject.model.images
    found = np.flatnonzero(wrong(images.num_observed))
    return offenders(
        [f"{images.names[index]!r} with {images.num_observed[index]}" for index in found], of=len(images), unit="images"
    )


def _points_where(subject: Subject, wrong: Callable[[Points], BoolArray]) -> Evidence | None:
    points = subject.model.points
    if points is None:
        return None
    found = np.flatnonzero(wrong(points))
    if len(found) == 0:
        return None
    return Evidence(count=len(found), of=len(points), unit="points", example=f"point {points.ids[found[0]]}")


RULES = (
    _no_points,
    _no_track,
    _no_tracks_at_all,
    _single,
    _short,
    _pseudo_zero,
    _repeats,
    _dangling,
    _disagrees,
    _observation_dangling,
    _one_sided,
    _outside,
    _unobserved,
    _weak,
)
"""In the order in which they are reported."""
