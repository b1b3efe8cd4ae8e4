"""Camera poses and sparse points of one segment, by pycolmap's mappers.

No mapper is safe alone: the incremental one finds no start on straight forward motion and stops at
weak spots, the global one registers more but may be wrong with a perfect-looking error. So a ladder
is climbed until a model passes the tests: incremental, relaxed incremental, global. What still does
not hold together becomes several pieces. Everything here runs in a child process.
The next module to read is ``calibration``.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap

from smust3r_colmap.backbones.classical.features import Pair, open_database, write_images
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.products import Tracks, UnregisteredImage

logger = logging.getLogger(__name__)

ENOUGH_REGISTERED = 0.9
"""Share of a segment's images in sound models at which the ladder stops."""
MIN_PIECE_IMAGES = 4
"""Smaller models are too weak to be a node; only of a smaller segment they are all one can have."""
MIN_SHARED_IMAGES = 4
"""Common images that can join two models by a similarity with something left over to check it."""
MAX_TURN_DEG = 60.0
"""Neighbouring images that match cannot have turned by more (honest walks: 52 at most; folds: 150)."""
MAX_STEP_RATIO = 10.0
"""Nor moved by more than this many median steps (honest walks: 1.8; folds: 33 to 42) ..."""
MIN_JUMP_DEPTHS = 0.5
"""... unless the step is small beside the distance of what they see, as after a pause."""
MIN_PAIR_INLIERS = 15
"""Verified matches below which COLMAP does not use a pair."""
MIN_EXPLAINED_SHARE = 0.5
"""A relative pose that fewer of the pair's verified matches agree with is wrong (sound models: 0.57 at
least; wrong ones, on a walk round a building: 0 to 0.44)."""
MIN_HINGE_POINTS = 12
"""Common points that hold two halves of a model together (honest links: 16 at least; a wrong one: 9)."""
NEAR_STEPS = 2
"""How far apart in order two images may be to deny each other; farther ones may be look-alikes."""
MAX_EPIPOLAR_ERROR_PX = 4.0
"""COLMAP's own bound for an inlier of two views."""
STRONG_PAIR_INLIERS = 30
"""Verified matches that make two images certain neighbours (COLMAP's own bar for registration)."""
NEAR_OFFSET = 4
"""Reach of the pairs that are left when the longer ones folded the model."""
MIN_FOCAL_RATIO, MAX_FOCAL_RATIO = 0.2, 8.0
"""Focal length over the longer side, from a 136 degree lens to a 7 degree one; a few images in a row
on nearly parallel rays self-calibrate to anything."""
FOCAL_TOLERANCE = 0.15
"""A focal length farther from the run's median belongs to a diverged self-calibration."""


@dataclass(frozen=True, kw_only=True)
class MappingTask:
    """One segment to map.

    Args:
        segment: its index. database: the run's. images: indices in order, with their cameras.
        pairs: which of the database's pairs may be used; all of them have been matched.
        cameras: start values by camera index.
        trusted_focal: the run's consensus focal length by camera index, empty in the first pass.
        seed: of pycolmap's samplers.
        use_global: the last rung may be climbed; not after it brought the process down.
    """

    segment: int
    database: Path
    images: tuple[int, ...]
    camera_indices: tuple[int, ...]
    pairs: tuple[Pair, ...]
    cameras: tuple[Intrinsics, ...]
    trusted_focal: Mapping[int, float]
    seed: int
    use_global: bool = True


@dataclass(frozen=True, kw_only=True, eq=False)
class MappedModel:
    """One connected model of a segment, as arrays (see ``SegmentPiece`` for shapes)."""

    images: tuple[int, ...]
    seg_from_cam: npt.NDArray[np.float64]
    intrinsics: tuple[Intrinsics, ...]
    tracks: Tracks
    reprojection_error_px: float
    method: str


@dataclass(frozen=True, kw_only=True)
class MappedSegment:
    """All models of a segment, largest first, with what was tried and what was left out."""

    segment: int
    models: tuple[MappedModel, ...]
    attempts: tuple[str, ...]
    unregistered: tuple[UnregisteredImage, ...]


def map_segment(task: MappingTask) -> MappedSegment:
    """Climb the ladder for one segment; never raises for geometry that does not come out."""
    with tempfile.TemporaryDirectory(prefix="smust3r-map-") as scratch:
        ladder = _Ladder(task, Path(scratch))
        ladder.climb()
        models = ladder.best_models()
    placed = {image for model in models for image in model.images}
    left = tuple(
        UnregisteredImage(image=image, reason=ladder.why_not(image, placed))
        for image in task.images
        if image not in placed
    )
    return MappedSegment(segment=task.segment, models=models, attempts=tuple(ladder.attempts), unregistered=left)


class _Ladder:
    """The attempts at one segment and the best models so far."""

    def __init__(self, task: MappingTask, scratch: Path) -> None:
        self.task = task
        self.scratch = scratch
        self.attempts: list[str] = []
        self.candidates: list[tuple[MappedModel, ...]] = []
        self.largest_output: Path | None = None
        self.mapped: dict[str, dict[int, pycolmap.Reconstruction]] = {}
        self.min_images = MIN_PIECE_IMAGES if len(task.images) >= MIN_PIECE_IMAGES else 2
        self.inliers = self._build_database("segment.db", task.pairs)

    def climb(self) -> None:
        """Try the rungs in order until one places enough images."""
        if not any(count >= MIN_PAIR_INLIERS for count in self.inliers.values()):
            self.attempts.append(f"no pair of images has {MIN_PAIR_INLIERS} verified matches")
            return
        self._attempt("incremental", self._incremental("segment.db", relaxed=False))
        if self._enough():
            return
        if self.largest_output is not None:
            start = self.largest_output
            self._attempt("incremental, continued relaxed", self._incremental("segment.db", relaxed=True, start=start))
        if self._enough():
            return
        self._attempt("incremental, relaxed start", self._incremental("segment.db", relaxed=True))
        if not self._enough() and self.task.use_global:
            self._attempt("global", self._global())

    def best_models(self) -> tuple[MappedModel, ...]:
        """Models of the attempt that placed most images, then what others add to it, then bridges.

        Several sound models that overlap serve better than one that a weak link holds together: the
        neighbouring segments join them again. So images count, not the size of the largest model.
        """
        if not self.candidates:
            return ()
        # Earlier rungs are stricter: a later one has to place clearly more images.
        best = self.candidates[0]
        for models in self.candidates[1:]:
            if len(_placed(models)) > 1.05 * len(_placed(best)):
                best = models
        chosen: list[MappedModel] = []
        for models, share_of_new in [(best, 0.1), *[(models, 0.3) for models in self.candidates]]:
            for model in models:
                new = set(model.images) - _placed(chosen)
                if len(new) >= max(2, share_of_new * len(model.images)):
                    chosen.append(model)
        for models in self.candidates:
            for model in models:
                if sum(_share_images(model, group) for group in connected_groups(chosen)) >= 2:
                    chosen.append(model)  # a bridge
        return tuple(sorted(chosen, key=lambda model: -len(model.images)))

    def why_not(self, image: int, placed: set[int]) -> str:
        """Reason in words and numbers for an image in no model."""
        links = [count for pair, count in self.inliers.items() if image in pair and count > 0]
        to_placed = [
            count for pair, count in self.inliers.items() if image in pair and (set(pair) - {image}) & placed and count
        ]
        if not links:
            return "no verified matches to any image of its segment"
        if not to_placed:
            return f"matches {len(links)} images, none of which was placed"
        return f"at most {max(to_placed)} verified matches to a placed image, and the mappers refused it"

    # ------------------------------------------------------------------- attempts
    def _attempt(self, name: str, models: dict[int, pycolmap.Reconstruction]) -> None:
        """Record an attempt. Jumps ask for a second opinion; those that the matches deny are cut."""
        found = self._convert(models, name)
        if self._count_jumps(found):
            self.largest_output = None
            second = self._convert(self._incremental("segment.db", relaxed=True), f"{name}, second opinion")
            better = bool(second) and self._count_jumps(second) < self._count_jumps(found)
            self.attempts.append(
                f"{name}: {self._count_jumps(found)} jumps between neighbours that match, "
                f"{self._count_jumps(second)} from a relaxed start; {'the second' if better else 'the first'} is kept"
            )
            found = second if better else found
        denied = sum(len(self._denied_steps(model)) for model in found)
        hinges = sum(len(find_hinges(model)) for model in found)
        if denied or hinges:
            self.attempts.append(
                f"{name}: cut at {denied} steps that the matches deny and {hinges} that hang on few points"
            )
            found = [part for model in found for part in self._cut(model)]
        if denied:
            self.largest_output = None
            if name == "incremental":
                near = tuple(pair for pair in self.task.pairs if self._offset(pair) <= NEAR_OFFSET)
                self._build_database("near.db", near)
                again = self._convert(self._incremental("near.db", relaxed=False), f"{name}, near pairs")
                parts = [part for model in again for part in self._cut(model)]
                if len(_placed(parts)) >= len(_placed(found)):
                    self.attempts.append(f"{name}: mapped again with near pairs only")
                    found = parts
        accepted = []
        for model in sorted(found, key=lambda model: -len(model.images)):
            problem = self._problem(model)
            if problem:
                self.attempts.append(f"{name}: model of {len(model.images)} images refused: {problem}")
            else:
                accepted.append(model)
        sizes = " + ".join(str(len(model.images)) for model in accepted) or "0"
        self.attempts.append(f"{name}: {sizes} of {len(self.task.images)} images")
        if accepted:
            self.candidates.append(tuple(accepted))

    def _enough(self) -> bool:
        """Some attempt placed nearly all images, in models that hang together."""
        return any(
            len(_placed(models)) >= ENOUGH_REGISTERED * len(self.task.images) and len(connected_groups(models)) == 1
            for models in self.candidates
        )

    def _incremental(
        self, database: str, *, relaxed: bool, start: Path | None = None
    ) -> dict[int, pycolmap.Reconstruction]:
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads = 1
        options.random_seed = self.task.seed
        options.extract_colors = False
        options.min_model_size = self.min_images
        options.max_model_overlap = 20
        # COLMAP runs every adjustment to a function tolerance of 0; this stops when nothing moves any more.
        options.ba_local_function_tolerance = 1e-6
        options.ba_global_function_tolerance = 1e-6
        options.ba_global_max_refinements = 3
        options.mapper.num_threads = 1
        options.mapper.random_seed = self.task.seed
        options.triangulation.random_seed = self.task.seed
        if relaxed:
            options.mapper.init_min_tri_angle = 3.0
            options.mapper.init_max_forward_motion = 1.0
            options.mapper.init_min_num_inliers = 50
            options.mapper.abs_pose_min_num_inliers = 15
        if len(self.task.images) < MIN_PIECE_IMAGES:
            # There is hardly a third view that could confirm a point.
            options.triangulation.ignore_two_view_tracks = False
        name = "incremental" if not relaxed else ("continued" if start else "relaxed")
        output = self.scratch / (name if database == "segment.db" else f"{name}-near")
        if output.name in self.mapped:  # a second opinion and a later rung may ask the same
            return self.mapped[output.name]
        output.mkdir()
        models: dict[int, pycolmap.Reconstruction] = pycolmap.incremental_mapping(
            self.scratch / database, self.scratch, output, options, input_path=start or ""
        )
        self.mapped[output.name] = models
        if database == "segment.db" and not relaxed and models:
            largest = max(models, key=lambda number: models[number].num_reg_images())
            self.largest_output = output / str(largest)
        return models

    def _global(self) -> dict[int, pycolmap.Reconstruction]:
        options = pycolmap.GlobalPipelineOptions()
        options.num_threads = 1
        options.random_seed = self.task.seed
        options.min_model_size = self.min_images
        options.mapper.num_threads = 1
        options.mapper.random_seed = self.task.seed
        options.mapper.global_positioning.use_gpu = False
        options.mapper.bundle_adjustment.ceres.use_gpu = False
        output = self.scratch / "global"
        output.mkdir(exist_ok=True)
        models: dict[int, pycolmap.Reconstruction] = pycolmap.global_mapping(
            self.scratch / "segment.db", self.scratch, output, options
        )
        return models

    # ---------------------------------------------------------------------- tests
    def _problem(self, model: MappedModel) -> str:
        """Why a model cannot be believed, or nothing. Its pixels look perfect in every such case."""
        if not np.isfinite(model.reprojection_error_px) or model.reprojection_error_px > 3.0:
            return f"mean reprojection error {model.reprojection_error_px:.2f} px"
        return absurd_focal(model) or diverged_focal(model, self.task)

    def _count_jumps(self, models: Sequence[MappedModel]) -> int:
        return sum(len(find_jumps(model, self.task.images, self.inliers)) for model in models)

    def _denied_steps(self, model: MappedModel) -> list[int]:
        """Positions k such that the matches deny how the model places image k and the next.

        Every pair of near images with STRONG_PAIR_INLIERS has to find most of its verified matches on
        their epipolar lines. That tells a fold, or a bad bridge, from a drone's half turn at the end
        of a strip, where the model turns as well but the matches agree.
        """
        order = {image: place for place, image in enumerate(self.task.images)}
        denied = set()
        with open_database(self.task.database) as database:
            for a, b in near_positions(model.images, order):
                first, second = model.images[a], model.images[b]
                if self.inliers.get((first, second), 0) >= STRONG_PAIR_INLIERS:
                    share = explained_share(model, a, b, database)
                    if share < MIN_EXPLAINED_SHARE:
                        denied.add(b - 1)
        return sorted(denied)

    def _cut(self, model: MappedModel) -> list[MappedModel]:
        """The model without denied steps and hinges: its parts between them, those that are large enough."""
        breaks = sorted({*self._denied_steps(model), *find_hinges(model)})
        bounds = [0, *[k + 1 for k in breaks], len(model.images)]
        parts = [range(a, b) for a, b in pairwise(bounds) if b - a >= self.min_images]
        return [model] if len(bounds) == 2 else [restrict_model(model, part) for part in parts]

    # ------------------------------------------------------------------- plumbing
    def _offset(self, pair: Pair) -> int:
        return abs(self.task.images.index(pair[0]) - self.task.images.index(pair[1]))

    def _build_database(self, name: str, pairs: Sequence[Pair]) -> dict[Pair, int]:
        """A database of this segment alone, with the cameras to start from; inliers by pair."""
        inliers = {}
        path = self.scratch / name
        path.unlink(missing_ok=True)
        with (
            open_database(self.task.database) as run,
            pycolmap.Database.open(path) as own,
            pycolmap.DatabaseTransaction(own),
        ):
            write_images(own, self.task.cameras, zip(self.task.images, self.task.camera_indices, strict=True))
            for image in self.task.images:
                if run.exists_keypoints(image + 1):
                    own.write_keypoints(image + 1, run.read_keypoints(image + 1))
            for first, second in pairs:
                geometry = run.read_two_view_geometry(first + 1, second + 1)
                inliers[first, second] = len(geometry.inlier_matches)
                if len(geometry.inlier_matches):
                    own.write_matches(first + 1, second + 1, geometry.inlier_matches)
                    own.write_two_view_geometry(first + 1, second + 1, geometry)
        return inliers

    def _convert(self, models: dict[int, pycolmap.Reconstruction], method: str) -> list[MappedModel]:
        converted = [model_from_reconstruction(model, method) for model in models.values()]
        return [model for model in converted if len(model.images) >= self.min_images]


def absurd_focal(model: MappedModel) -> str:
    """What is wrong with the focal lengths of most images, or nothing."""
    ratios = np.array([one.focal_px / max(one.width, one.height) for one in model.intrinsics])
    absurd = (ratios < MIN_FOCAL_RATIO) | (ratios > MAX_FOCAL_RATIO)
    if absurd.mean() <= 0.5:
        return ""
    k = int(np.argmax(absurd))
    return f"focal length {model.intrinsics[k].focal_px:.0f} px is {ratios[k]:.1f} times the longer side"


def diverged_focal(model: MappedModel, task: MappingTask) -> str:
    """How far the focal lengths of most images are from the run's, or nothing."""
    camera_of = dict(zip(task.images, task.camera_indices, strict=True))
    trusted = np.array([task.trusted_focal.get(camera_of[image], np.nan) for image in model.images])
    focal = np.array([one.focal_px for one in model.intrinsics])
    diverged = np.abs(np.log(focal / trusted)) > np.log1p(FOCAL_TOLERANCE)  # False where the run has none
    if diverged.mean() <= 0.5:
        return ""
    k = int(np.argmax(diverged))
    return f"focal length {focal[k]:.0f} px, the run's is {trusted[k]:.0f} px"


def find_jumps(model: MappedModel, order: Sequence[int], inliers: Mapping[Pair, int]) -> list[int]:
    """Positions k where ``model.images[k]`` and its successor in ``order`` match but stand apart.

    A pair counts when it is consecutive in ``order`` and has STRONG_PAIR_INLIERS verified matches;
    standing apart is a turn above MAX_TURN_DEG, or a step above MAX_STEP_RATIO median steps and
    above MIN_JUMP_DEPTHS of the distance of what the first image sees.
    """
    place = {image: k for k, image in enumerate(order)}
    steps = []
    for k, (first, second) in enumerate(pairwise(model.images)):
        if place[second] - place[first] == 1 and inliers.get((first, second), 0) >= STRONG_PAIR_INLIERS:
            steps.append(k)
    if not steps:
        return []
    centres = model.seg_from_cam[:, :, 3]
    lengths = {k: float(np.linalg.norm(centres[k + 1] - centres[k])) for k in steps}
    median = float(np.median(list(lengths.values())))
    jumps = []
    for k in steps:
        relative = model.seg_from_cam[k, :, :3].T @ model.seg_from_cam[k + 1, :, :3]
        turn_deg = np.degrees(np.arccos(np.clip((np.trace(relative) - 1) / 2, -1, 1)))
        far = lengths[k] > MAX_STEP_RATIO * median and lengths[k] > MIN_JUMP_DEPTHS * _median_depth(model, k)
        if turn_deg > MAX_TURN_DEG or far:
            jumps.append(k)
    return jumps


def find_hinges(model: MappedModel) -> list[int]:
    """Positions k such that fewer than MIN_HINGE_POINTS points are seen on both sides of image k and the next.

    The two sides may turn and grow against each other about so few points, however well they fit.
    """
    tracks = model.tracks
    position = np.searchsorted(model.images, tracks.image_of_observation)
    num_points = len(tracks.points_seg)
    first, last = np.full(num_points, len(model.images)), np.full(num_points, -1)
    np.minimum.at(first, tracks.point_of_observation, position)
    np.maximum.at(last, tracks.point_of_observation, position)
    return [k for k in range(len(model.images) - 1) if np.count_nonzero((first <= k) & (last > k)) < MIN_HINGE_POINTS]


def near_positions(images: Sequence[int], order: Mapping[int, int]) -> Iterator[tuple[int, int]]:
    """Positions (a, b) of images that are at most NEAR_STEPS apart in ``order``, a before b."""
    for a in range(len(images)):
        for b in range(a + 1, min(a + 1 + NEAR_STEPS, len(images))):
            if abs(order[images[b]] - order[images[a]]) <= NEAR_STEPS:
                yield a, b


def explained_share(model: MappedModel, a: int, b: int, database: pycolmap.Database) -> float:
    """Share of the verified matches of the images at positions a and b that fit the model's relative pose."""
    first, second = model.images[a] + 1, model.images[b] + 1
    matches = database.read_two_view_geometry(first, second).inlier_matches
    xy_first = np.asarray(database.read_keypoints(first), dtype=np.float64)[matches[:, 0], :2]
    xy_second = np.asarray(database.read_keypoints(second), dtype=np.float64)[matches[:, 1], :2]
    return float(np.mean(epipolar_errors_px(model, a, b, xy_first, xy_second) < MAX_EPIPOLAR_ERROR_PX))


def epipolar_errors_px(
    model: MappedModel, a: int, b: int, xy_first: npt.NDArray[np.float64], xy_second: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """(M,) Sampson errors in pixels of points of the images at positions a and b under the model's poses."""
    second_from_first = pycolmap.Rigid3d(model.seg_from_cam[b]).inverse() * pycolmap.Rigid3d(model.seg_from_cam[a])
    squared = pycolmap.compute_squared_sampson_error(
        model.intrinsics[a].rays_cam(xy_first)[:, :2],
        model.intrinsics[b].rays_cam(xy_second)[:, :2],
        pycolmap.essential_matrix_from_pose(second_from_first),
    )
    focal_px = 0.5 * (model.intrinsics[a].focal_px + model.intrinsics[b].focal_px)
    errors: npt.NDArray[np.float64] = focal_px * np.sqrt(squared)
    return errors


def connected_groups(models: Sequence[MappedModel]) -> list[list[MappedModel]]:
    """Models that are linked by MIN_SHARED_IMAGES common images, directly or through others."""
    groups: list[list[MappedModel]] = []
    for model in models:
        linked = [group for group in groups if _share_images(model, group)]
        groups = [group for group in groups if group not in linked]
        groups.append([model, *[other for group in linked for other in group]])
    return groups


def _share_images(model: MappedModel, group: Iterable[MappedModel]) -> bool:
    return any(len(set(model.images) & set(other.images)) >= MIN_SHARED_IMAGES for other in group)


def _placed(models: Iterable[MappedModel]) -> set[int]:
    return {image for model in models for image in model.images}


def _median_depth(model: MappedModel, k: int) -> float:
    seen = model.tracks.point_of_observation[model.tracks.image_of_observation == model.images[k]]
    if not len(seen):
        return 0.0
    cam_from_seg = invert_rigid(model.seg_from_cam[k])
    return float(np.median(model.tracks.points_seg[seen] @ cam_from_seg[2, :3] + cam_from_seg[2, 3]))


def restrict_model(model: MappedModel, positions: Sequence[int]) -> MappedModel:
    """The same model with only some of its images, and the points they still see at least twice."""
    images = tuple(model.images[k] for k in positions)
    tracks = model.tracks
    kept = np.isin(tracks.image_of_observation, images)
    points, compact, counts = np.unique(tracks.point_of_observation[kept], return_inverse=True, return_counts=True)
    seen_twice = counts[compact] >= 2
    renumber = np.cumsum(counts >= 2) - 1
    return replace(
        model,
        images=images,
        seg_from_cam=model.seg_from_cam[list(positions)],
        intrinsics=tuple(model.intrinsics[k] for k in positions),
        tracks=Tracks(
            points_seg=tracks.points_seg[points[counts >= 2]],
            point_of_observation=renumber[compact][seen_twice],
            image_of_observation=tracks.image_of_observation[kept][seen_twice],
            feature_of_observation=tracks.feature_of_observation[kept][seen_twice],
        ),
        method=f"{model.method}, cut",
    )


def model_from_reconstruction(reconstruction: pycolmap.Reconstruction, method: str) -> MappedModel:
    """Arrays of a pycolmap model whose image ids are index + 1; images ascend."""
    ids = sorted(reconstruction.reg_image_ids())
    poses = [reconstruction.image(i).cam_from_world().inverse().matrix() for i in ids]
    intrinsics = [Intrinsics.from_colmap(reconstruction.camera(reconstruction.image(i).camera_id)) for i in ids]
    points, owner, image, feature = [], [], [], []
    for row, point_id in enumerate(sorted(reconstruction.points3D)):
        point = reconstruction.points3D[point_id]
        points.append(point.xyz)
        for element in point.track.elements:
            owner.append(row)
            image.append(element.image_id - 1)
            feature.append(element.point2D_idx)
    return MappedModel(
        images=tuple(i - 1 for i in ids),
        seg_from_cam=np.array(poses, dtype=np.float64).reshape(-1, 3, 4),
        intrinsics=tuple(intrinsics),
        tracks=Tracks(
            points_seg=np.array(points, dtype=np.float64).reshape(-1, 3),
            point_of_observation=np.array(owner, dtype=np.int64),
            image_of_observation=np.array(image, dtype=np.int64),
            feature_of_observation=np.array(feature, dtype=np.int64),
        ),
        reprojection_error_px=float(reconstruction.compute_mean_reprojection_error()),
        method=method,
    )
