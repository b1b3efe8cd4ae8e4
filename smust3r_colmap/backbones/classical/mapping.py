"""Camera poses and sparse points of one segment, by pycolmap's mappers.

No mapper is safe alone: the incremental one finds no start on straight forward motion and stops at
weak spots, the global one registers more but may be wrong with a perfect-looking error. So a ladder
is climbed until the models pass the checks: incremental from a chosen pair, relaxed incremental, global.
What still does not hold together becomes several submodels. Everything here runs in a child process.
The next module to read is ``calibration``.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pycolmap

from smust3r_colmap.backbones.classical.mapped_model import (
    MappedModel,
    connected_groups,
    model_from_reconstruction,
    placed_images,
    restrict_model,
    share_images,
)
from smust3r_colmap.backbones.classical.model_checks import (
    absurd_focal,
    diverged_focal,
    find_denied_steps,
    find_doubtful_jumps,
    find_hinges,
)
from smust3r_colmap.backbones.classical.start_pair import ENOUGH_ANGLE_DEG, MIN_INLIERS, StartPair, choose_start_pairs
from smust3r_colmap.backbones.classical.thinning import thin_matches
from smust3r_colmap.colmap.database import open_database, write_images
from smust3r_colmap.geometry.arrays import Pair
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.products import UnregisteredImage

logger = logging.getLogger(__name__)

ENOUGH_REGISTERED = 0.9
"""Share of a segment's images in sound models at which the ladder stops."""
MIN_SUBMODEL_IMAGES = 4
"""Smaller models are too weak to be a node; only of a smaller segment they are all one can have."""
MIN_PAIR_INLIERS = 15
"""Verified matches below which COLMAP does not use a pair."""
MIN_LINKS = 3
"""Pairs that have to match across two models before another mapper is tried on them. One or two hardly carry the scale
across, and the mappers that were tried all the same took 10 s to place no image more."""
NEAR_OFFSET = 4
"""Reach of the pairs that are left when the longer ones folded the model."""
ANGLE_TOLERANCE = 0.3
"""Share of the chosen pair's angle that the mapper, which estimates it again by sampling, has to find."""
METHOD_VERSION = 3
"""To be raised when mapping or calibration change, so that finished segments are mapped again."""
MAX_MODELS = 6
"""Models that one attempt may start; what is left of a segment after so many is crumbs that cost minutes."""


@dataclass(frozen=True, kw_only=True)
class MappingTask:
    """One segment to map.

    Args:
        segment: its index. database: the run's. images: indices in order, with their cameras.
        pairs: which of the database's pairs may be used; all of them have been matched.
        cameras: start values by camera index.
        trusted: cameras that are known, by camera index; empty for a pilot. They stay as they are where all of
            the segment's are known.
        seed: of pycolmap's samplers.
        use_global: the last rung may be climbed; not after it brought the process down.
    """

    segment: int
    database: Path
    images: tuple[int, ...]
    camera_indices: tuple[int, ...]
    pairs: tuple[Pair, ...]
    cameras: tuple[Intrinsics, ...]
    trusted: Mapping[int, Intrinsics]
    seed: int
    use_global: bool = True

    @property
    def camera_of(self) -> dict[int, int]:
        """Camera index by image."""
        return dict(zip(self.images, self.camera_indices, strict=True))

    @property
    def calibrated(self) -> bool:
        """All cameras of the segment are known."""
        return self.trusted.keys() >= set(self.camera_indices)

    @property
    def start_cameras(self) -> tuple[Intrinsics, ...]:
        """What to start from, by camera index.

        Without a prior COLMAP estimates the focal length with the first pose, whatever else is held.
        """
        known = {index: replace(camera, has_prior_focal=True) for index, camera in self.trusted.items()}
        return tuple(known.get(index, camera) for index, camera in enumerate(self.cameras))


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
        self.min_images = MIN_SUBMODEL_IMAGES if len(task.images) >= MIN_SUBMODEL_IMAGES else 2
        self.inliers = self._build_database("segment.db", task.pairs)

    def climb(self) -> None:
        """Try the rungs in order until one places enough images."""
        if not any(count >= MIN_PAIR_INLIERS for count in self.inliers.values()):
            self.attempts.append(f"no pair of images has {MIN_PAIR_INLIERS} verified matches")
            return
        self._attempt("incremental", self._from_chosen_pair("segment.db", self.task.pairs))
        if self._enough():
            return
        if self.largest_output is not None:
            start = self.largest_output
            self._attempt("incremental, continued relaxed", self._incremental(start=start))
        if self._enough():
            return
        self._attempt("incremental, relaxed start", self._incremental())
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
            if len(placed_images(models)) > 1.05 * len(placed_images(best)):
                best = models
        chosen: list[MappedModel] = []
        for models, share_of_new in [(best, 0.1), *[(models, 0.3) for models in self.candidates]]:
            for model in models:
                new = set(model.images) - placed_images(chosen)
                if len(new) >= max(2, share_of_new * len(model.images)):
                    chosen.append(model)
        for models in self.candidates:
            for model in models:
                if sum(share_images(model, group) for group in connected_groups(chosen)) >= 2:
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
            second = self._convert(self._incremental(), f"{name}, second opinion")
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
                near = tuple(pair for pair in self.task.pairs if pair[1] - pair[0] <= NEAR_OFFSET)
                self._build_database("near.db", near)
                again = self._convert(self._from_chosen_pair("near.db", near), f"{name}, near pairs")
                parts = [part for model in again for part in self._cut(model)]
                if len(placed_images(parts)) >= len(placed_images(found)):
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
        """Some attempt placed nearly all images, in models that hang together as far as the matches let them."""
        return any(
            len(placed_images(models)) >= ENOUGH_REGISTERED * len(self.task.images)
            and not any(self._is_linked(a, b) for a, b in combinations(connected_groups(models), 2))
            for models in self.candidates
        )

    def _is_linked(self, first: Iterable[MappedModel], second: Iterable[MappedModel]) -> bool:
        """Enough pairs match across two groups for a mapper to join them."""
        only_first = placed_images(first) - placed_images(second)
        only_second = placed_images(second) - placed_images(first)
        links = sum(
            (a in only_first and b in only_second) or (a in only_second and b in only_first)
            for (a, b), count in self.inliers.items()
            if count >= MIN_PAIR_INLIERS
        )
        return links >= MIN_LINKS

    def _from_chosen_pair(self, database: str, pairs: Sequence[Pair]) -> dict[int, pycolmap.Reconstruction]:
        """One model from the best pair that gives one; nothing where none does."""
        start_cameras = self.task.start_cameras
        cameras = {image: start_cameras[index] for image, index in self.task.camera_of.items()}
        with open_database(self.scratch / database) as opened:
            starts = choose_start_pairs(opened, pairs, cameras, seed=self.task.seed)
        for number, start in enumerate(starts):
            name = f"{database.removesuffix('.db')}-{number}"
            models = self._run_incremental(database, name, _from_pair(self._options(), start))
            if models:
                if database == "segment.db":
                    self.largest_output = self.scratch / name / str(max(models))
                return models
        return {}

    def _incremental(self, *, start: Path | None = None) -> dict[int, pycolmap.Reconstruction]:
        """Models with relaxed demands, continued from ``start`` or from pairs that COLMAP finds."""
        options = self._options()
        options.max_num_models = MAX_MODELS
        options.mapper.init_min_tri_angle = 3.0
        options.mapper.init_max_forward_motion = 1.0
        options.mapper.init_min_num_inliers = 50
        options.mapper.abs_pose_min_num_inliers = 15
        return self._run_incremental("segment.db", "continued" if start else "relaxed", options, start=start)

    def _options(self) -> pycolmap.IncrementalPipelineOptions:
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads = 1
        options.random_seed = self.task.seed
        options.extract_colors = False
        options.min_model_size = self.min_images
        options.max_model_overlap = 20
        # COLMAP adjusts to a function tolerance of 0 whenever a model has grown by a tenth. A segment is adjusted
        # again in the whole scene; only focal length and distortion, in their valley, need the iterations.
        known = self.task.calibrated
        options.ba_local_function_tolerance = 1e-2 if known else 1e-4
        options.ba_local_max_refinements = 1
        options.ba_global_function_tolerance = 1e-3 if known else 1e-5
        options.ba_global_max_refinements = 1 if known else 2
        options.ba_global_frames_ratio = 1.4
        options.ba_global_points_ratio = 1.4
        options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = not known
        options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = not known
        options.mapper.num_threads = 1
        options.mapper.random_seed = self.task.seed
        options.triangulation.random_seed = self.task.seed
        if len(self.task.images) < MIN_SUBMODEL_IMAGES:
            # There is hardly a third view that could confirm a point.
            options.triangulation.ignore_two_view_tracks = False
        return options

    def _run_incremental(
        self, database: str, name: str, options: pycolmap.IncrementalPipelineOptions, *, start: Path | None = None
    ) -> dict[int, pycolmap.Reconstruction]:
        if name not in self.mapped:  # a second opinion and a later rung may ask the same
            output = self.scratch / name
            output.mkdir()
            self.mapped[name] = pycolmap.incremental_mapping(
                self.scratch / database, self.scratch, output, options, input_path=start or ""
            )
        return self.mapped[name]

    def _global(self) -> dict[int, pycolmap.Reconstruction]:
        options = pycolmap.GlobalPipelineOptions()
        options.num_threads = 1
        options.random_seed = self.task.seed
        options.min_model_size = self.min_images
        options.mapper.num_threads = 1
        options.mapper.random_seed = self.task.seed
        options.mapper.global_positioning.use_gpu = False
        options.mapper.bundle_adjustment.ceres.use_gpu = False
        options.mapper.bundle_adjustment.refine_focal_length = not self.task.calibrated
        options.mapper.bundle_adjustment.refine_extra_params = not self.task.calibrated
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
        return absurd_focal(model) or diverged_focal(model, self.task.camera_of, self.task.trusted)

    def _count_jumps(self, models: Sequence[MappedModel]) -> int:
        with open_database(self.task.database) as database:
            return sum(len(find_doubtful_jumps(model, self.inliers, database)) for model in models)

    def _denied_steps(self, model: MappedModel) -> list[int]:
        with open_database(self.task.database) as database:
            return find_denied_steps(model, self.inliers, database)

    def _cut(self, model: MappedModel) -> list[MappedModel]:
        """The model without denied steps and hinges: its parts between them, those that are large enough."""
        breaks = sorted({*self._denied_steps(model), *find_hinges(model)})
        bounds = [0, *[k + 1 for k in breaks], len(model.images)]
        parts = [range(a, b) for a, b in pairwise(bounds) if b - a >= self.min_images]
        return [model] if len(bounds) == 2 else [restrict_model(model, part) for part in parts]

    # ------------------------------------------------------------------- plumbing
    def _build_database(self, name: str, pairs: Sequence[Pair]) -> dict[Pair, int]:
        """A database of this segment alone, with the cameras to start from; inliers by pair."""
        path = self.scratch / name
        path.unlink(missing_ok=True)
        with (
            open_database(self.task.database) as run,
            pycolmap.Database.open(path) as own,
            pycolmap.DatabaseTransaction(own),
        ):
            write_images(own, self.task.start_cameras, zip(self.task.images, self.task.camera_indices, strict=True))
            num_features = {}
            for image in self.task.images:
                if run.exists_keypoints(image + 1):
                    keypoints = run.read_keypoints(image + 1)
                    own.write_keypoints(image + 1, keypoints)
                    num_features[image] = len(keypoints)
            geometries = {(first, second): run.read_two_view_geometry(first + 1, second + 1) for first, second in pairs}
            inliers = {pair: len(geometry.inlier_matches) for pair, geometry in geometries.items()}
            kept = thin_matches({pair: geometry.inlier_matches for pair, geometry in geometries.items()}, num_features)
            for (first, second), matches in kept.items():
                geometry = geometries[first, second]
                geometry.inlier_matches = matches
                own.write_matches(first + 1, second + 1, matches)
                own.write_two_view_geometry(first + 1, second + 1, geometry)
        return inliers

    def _convert(self, models: dict[int, pycolmap.Reconstruction], method: str) -> list[MappedModel]:
        converted = [model_from_reconstruction(model, method) for model in models.values()]
        return [self._with_own_priors(model) for model in converted if len(model.images) >= self.min_images]

    def _with_own_priors(self, model: MappedModel) -> MappedModel:
        """The model whose cameras call a focal length prior knowledge only where the images' own cameras do."""
        camera_of = self.task.camera_of
        priors = [self.task.cameras[camera_of[image]].has_prior_focal for image in model.images]
        intrinsics = [replace(one, has_prior_focal=prior) for one, prior in zip(model.intrinsics, priors, strict=True)]
        return replace(model, intrinsics=tuple(intrinsics))


def _from_pair(options: pycolmap.IncrementalPipelineOptions, pair: StartPair) -> pycolmap.IncrementalPipelineOptions:
    """The options with the pair to start from, and with demands on it that it meets."""
    options.init_image_id1 = pair.first + 1
    options.init_image_id2 = pair.second + 1
    options.multiple_models = False  # every further model would start from the same pair
    options.init_num_trials = 1  # and so would every further trial
    options.mapper.init_min_num_inliers = MIN_INLIERS
    options.mapper.init_min_tri_angle = min(ENOUGH_ANGLE_DEG, ANGLE_TOLERANCE * pair.angle_deg)
    options.mapper.init_max_forward_motion = 1.0 if pair.forward else 0.95
    return options
