"""Camera poses and sparse points of one segment, by COLMAP's mappers.

No mapper is reliable alone: the incremental one finds no start on straight forward motion and stops where images
share few points; the global one registers more, but its model may be wrong at a small reprojection error. So several
strategies are run until the models pass the checks: incremental from a chosen pair, relaxed incremental, global. A
model that fails some of them is split into several submodels. Everything here runs in a child process.
The next module to read is ``calibration``.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np

from smust3r_colmap.backbones.classical.mapped_model import (
    MappedModel,
    connected_groups,
    model_from_reconstruction,
    placed_images,
    restrict_model,
    share_images,
)
from smust3r_colmap.backbones.classical.model_checks import (
    diverged_focal,
    find_contradicted_images,
    find_epipolar_outliers,
    find_unconfirmed_poses,
    find_weak_links,
    implausible_focal,
    strongly_linked_parts,
)
from smust3r_colmap.backbones.classical.strategies import (
    MapperOutput,
    MappingStrategy,
    MappingTask,
    build_database,
    from_start_pairs,
    global_mapping,
    relaxed,
    run_strategy,
)
from smust3r_colmap.colmap.database import open_database
from smust3r_colmap.geometry.arrays import Pair
from smust3r_colmap.products import UnregisteredImage
from smust3r_colmap.storage.codec import Codec

ENOUGH_REGISTERED_SHARE = 0.9
"""Share of a segment's images in accepted models at which no further strategy is tried."""
MIN_PAIR_INLIERS = 15
"""Verified matches below which COLMAP does not use a pair."""
MIN_LINKED_PAIRS = 3
"""Pairs that match across two models before another strategy is tried on them. One or two hardly determine the scale
between the models; further strategies took 10 s and registered no image more."""
NEAR_OFFSET_IMAGES = 4
"""Largest distance in order of a pair that is kept where pairs farther apart led to a wrong model."""
MAX_ERROR_PX = 3.0
"""Mean reprojection error above which a model is rejected."""
CLEARLY_MORE_RATIO = 1.05
"""Earlier strategies are stricter: a later one has to register more images by this factor."""
MIN_NEW_SHARE_OF_BEST, MIN_NEW_SHARE_OF_OTHERS = 0.1, 0.3
"""Share of a model's images that no larger model has, for it to be kept: of the best strategy, of the others."""
METHOD_VERSION = 4
"""To be raised when mapping or calibration change, so that finished segments are mapped again."""


@dataclass(frozen=True, kw_only=True)
class MappedSegment:
    """All models of a segment, largest first, with what was tried and what was left out."""

    segment: int
    models: tuple[MappedModel, ...]
    attempts: tuple[str, ...]
    unregistered: tuple[UnregisteredImage, ...]


MAPPED_SEGMENT: Codec[MappedSegment] = Codec(MappedSegment, "segment")


@dataclass(frozen=True, kw_only=True, eq=False)
class Attempt:
    """The result of one strategy.

    Args:
        models: those that passed the checks, largest first.
        notes: what was found and done, for people.
        model_folder: the largest model in COLMAP's format, which another strategy may continue; None where the checks
            contradict it.
    """

    models: tuple[MappedModel, ...]
    notes: tuple[str, ...]
    model_folder: Path | None


RunStrategy = Callable[[MappingStrategy, Path, Path | None], MapperOutput]
"""See ``run_strategy``."""


def map_segment(task: MappingTask, *, run: RunStrategy = run_strategy) -> MappedSegment:
    """Run the strategies for one segment; never raises for geometry that does not come out.

    Args:
        run: gives the models of a strategy.
    """
    with tempfile.TemporaryDirectory(prefix="smust3r-map-") as scratch:
        mapper = SegmentMapper(task, Path(scratch), run)
        if any(count >= MIN_PAIR_INLIERS for count in mapper.inliers.values()):
            attempts = mapper.run_until_good(mapper.strategies())
            notes = tuple(note for attempt in attempts for note in attempt.notes)
        else:
            attempts, notes = [], (f"no pair of images has {MIN_PAIR_INLIERS} verified matches",)
    models = choose_models([attempt.models for attempt in attempts if attempt.models])
    placed = placed_images(models)
    left = tuple(
        UnregisteredImage(image=image, reason=unregistered_reason(image, placed, mapper.inliers))
        for image in task.images
        if image not in placed
    )
    return MappedSegment(segment=task.segment, models=models, attempts=notes, unregistered=left)


class SegmentMapper:
    """Maps one segment with one strategy after another, and checks the models.

    Args:
        task: the segment.
        scratch: empty folder for databases and models.
        run: gives the models of a strategy.
    """

    def __init__(self, task: MappingTask, scratch: Path, run: RunStrategy = run_strategy) -> None:
        self.task = task
        self.inliers: Mapping[Pair, int] = build_database(scratch / "segment.db", task.pairs, task)
        self._scratch = scratch
        self._run = run
        self._outputs: dict[str, MapperOutput] = {}
        self._relaxed = relaxed("incremental, relaxed start", scratch / "segment.db", task)

    def strategies(self) -> list[MappingStrategy]:
        """From the strictest to the most permissive."""
        database = self._scratch / "segment.db"
        strategies = [
            from_start_pairs("incremental", database, self.task.pairs, self.task),
            relaxed("incremental, continued relaxed", database, self.task, continues="incremental"),
            self._relaxed,
        ]
        return [*strategies, global_mapping("global", database, self.task)] if self.task.use_global else strategies

    def run_until_good(self, strategies: Iterable[MappingStrategy]) -> list[Attempt]:
        """Attempts in order, up to the first after which enough images are registered."""
        attempts: dict[str, Attempt] = {}
        for strategy in strategies:
            start = attempts[strategy.continues].model_folder if strategy.continues else None
            if strategy.continues and start is None:
                continue
            attempts[strategy.name] = attempt = self.attempt(strategy, start)
            if self._registers_enough(attempt.models):
                break
        return list(attempts.values())

    def attempt(self, strategy: MappingStrategy, start: Path | None = None) -> Attempt:
        """Run a strategy and keep of its models what passes the checks.

        Inconsistent poses are compared with those of a relaxed start; models are split where matches contradict them.

        Args:
            start: model that the strategy extends.
        """
        output = self._output(strategy, start)
        models = self._converted(output, strategy.name)
        name = strategy.name
        notes = []
        inconsistent = self._count_unconfirmed(models)
        if inconsistent:
            others = self._converted(self._output(self._relaxed, None), self._relaxed.name)
            of_others = self._count_unconfirmed(others)
            others_better = bool(others) and of_others < inconsistent
            notes.append(
                f"{name}: {inconsistent} inconsistent poses of consecutive images that match, "
                f"{of_others} from a relaxed start; {'the second' if others_better else 'the first'} is kept"
            )
            models = others if others_better else models
        outliers = sum(len(self._epipolar_outliers(model)) for model in models)
        weak_links = sum(self._num_weak_links(model) for model in models)
        if outliers or weak_links:
            notes.append(f"{name}: split at {outliers} epipolar outliers and {weak_links} weak links")
            models = [part for model in models for part in self._split(model)]
        if outliers and strategy.retry_with_near_pairs and self.task.in_order:
            parts = self._mapped_with_near_pairs(name)
            if len(placed_images(parts)) >= len(placed_images(models)):
                notes.append(f"{name}: mapped again with near pairs only")
                models = parts
        accepted, rejections = self._accepted(models)
        notes += [f"{name}: {rejection}" for rejection in rejections]
        sizes = " + ".join(str(len(model.images)) for model in accepted) or "0"
        notes.append(f"{name}: {sizes} of {len(self.task.images)} images")
        folder = None if inconsistent or outliers else output.folder
        return Attempt(
            models=accepted,
            notes=tuple(notes),
            model_folder=folder / str(max(output.models)) if folder else None,
        )

    def _output(self, strategy: MappingStrategy, start: Path | None) -> MapperOutput:
        """The models of a strategy, which is run once: the relaxed start is also compared with."""
        if strategy.name not in self._outputs:
            folder = self._scratch / f"output-{len(self._outputs)}"
            self._outputs[strategy.name] = self._run(strategy, folder, start)
        return self._outputs[strategy.name]

    def _mapped_with_near_pairs(self, name: str) -> list[MappedModel]:
        """Parts of the models from pairs of images that are near in the sequence."""
        graph = self.task.view_graph
        pairs = tuple(pair for pair in self.task.pairs if graph.steps_between(*pair) <= NEAR_OFFSET_IMAGES)
        database = self._scratch / "near.db"
        build_database(database, pairs, self.task)
        strategy = from_start_pairs(f"{name}, near pairs", database, pairs, self.task)
        models = self._converted(self._output(strategy, None), strategy.name)
        return [part for model in models for part in self._split(model)]

    def _registers_enough(self, models: Sequence[MappedModel]) -> bool:
        """Nearly all images are placed, in models that are connected as far as the matches allow."""
        return len(placed_images(models)) >= ENOUGH_REGISTERED_SHARE * len(self.task.images) and not any(
            self._are_linked(a, b) for a, b in combinations(connected_groups(models), 2)
        )

    def _are_linked(self, first: Iterable[MappedModel], second: Iterable[MappedModel]) -> bool:
        """Enough pairs match across two groups for a mapper to join them."""
        only_first = placed_images(first) - placed_images(second)
        only_second = placed_images(second) - placed_images(first)
        num_pairs = sum(
            (a in only_first and b in only_second) or (a in only_second and b in only_first)
            for (a, b), count in self.inliers.items()
            if count >= MIN_PAIR_INLIERS
        )
        return num_pairs >= MIN_LINKED_PAIRS

    # --------------------------------------------------------------------- checks
    def _accepted(self, models: Sequence[MappedModel]) -> tuple[tuple[MappedModel, ...], list[str]]:
        """The models that pass, largest first, and why the others do not."""
        accepted, rejections = [], []
        for model in sorted(models, key=lambda model: -len(model.images)):
            if problem := self._problem(model):
                rejections.append(f"model of {len(model.images)} images rejected: {problem}")
            else:
                accepted.append(model)
        return tuple(accepted), rejections

    def _problem(self, model: MappedModel) -> str:
        """Why a model is wrong, or nothing."""
        if not np.isfinite(model.reprojection_error_px) or model.reprojection_error_px > MAX_ERROR_PX:
            return f"mean reprojection error {model.reprojection_error_px:.2f} px"
        return implausible_focal(model) or diverged_focal(model, self.task.camera_of, self.task.known_cameras)

    def _count_unconfirmed(self, models: Sequence[MappedModel]) -> int:
        with open_database(self.task.database) as database:
            return sum(
                len(find_unconfirmed_poses(model, self.task.view_graph, self.inliers, database)) for model in models
            )

    def _epipolar_outliers(self, model: MappedModel) -> list[int]:
        """Of a sequence, positions after which it breaks; of a cluster, images that do not belong."""
        with open_database(self.task.database) as database:
            if not self.task.in_order:
                return find_contradicted_images(model, self.inliers, database)
            return find_epipolar_outliers(model, self.task.view_graph, self.inliers, database)

    def _num_weak_links(self, model: MappedModel) -> int:
        return len(find_weak_links(model)) if self.task.in_order else len(strongly_linked_parts(model)) - 1

    def _split(self, model: MappedModel) -> list[MappedModel]:
        """The parts of a model between epipolar outliers and weak links, those that are large enough."""
        if not self.task.in_order:
            return self._split_cluster(model)
        breaks = sorted({*self._epipolar_outliers(model), *find_weak_links(model)})
        bounds = [0, *[k + 1 for k in breaks], len(model.images)]
        parts = [range(a, b) for a, b in pairwise(bounds) if b - a >= self.task.min_model_images]
        return [model] if len(bounds) == 2 else [restrict_model(model, part) for part in parts]

    def _split_cluster(self, model: MappedModel) -> list[MappedModel]:
        outliers = self._epipolar_outliers(model)
        rest = restrict_model(model, [k for k in range(len(model.images)) if k not in outliers]) if outliers else model
        parts = strongly_linked_parts(rest)
        if len(parts) == 1:
            return [rest]
        return [restrict_model(rest, part) for part in parts if len(part) >= self.task.min_model_images]

    def _converted(self, output: MapperOutput, method: str) -> list[MappedModel]:
        converted = [model_from_reconstruction(model, method) for model in output.models.values()]
        return [self._with_own_priors(model) for model in converted if len(model.images) >= self.task.min_model_images]

    def _with_own_priors(self, model: MappedModel) -> MappedModel:
        """The model whose cameras have a prior focal length only where the images' own cameras do."""
        camera_of = self.task.camera_of
        priors = [self.task.cameras[camera_of[image]].has_prior_focal for image in model.images]
        intrinsics = [replace(one, has_prior_focal=prior) for one, prior in zip(model.intrinsics, priors, strict=True)]
        return replace(model, intrinsics=tuple(intrinsics))


def choose_models(attempts: Sequence[Sequence[MappedModel]]) -> tuple[MappedModel, ...]:
    """Models of the attempt that placed most images, then what others add to it, then bridges between them.

    Several models that overlap are better than one with a weak link: the neighbouring segments join them again. So the
    number of images counts, not the size of the largest model.
    """
    if not attempts:
        return ()
    best = attempts[0]
    for models in attempts[1:]:
        if len(placed_images(models)) > CLEARLY_MORE_RATIO * len(placed_images(best)):
            best = models
    chosen: list[MappedModel] = []
    others = [(models, MIN_NEW_SHARE_OF_OTHERS) for models in attempts]
    for models, share_of_new in [(best, MIN_NEW_SHARE_OF_BEST), *others]:
        for model in models:
            new = set(model.images) - placed_images(chosen)
            if len(new) >= max(2, share_of_new * len(model.images)):
                chosen.append(model)
    for models in attempts:
        for model in models:
            if sum(share_images(model, group) for group in connected_groups(chosen)) >= 2:
                chosen.append(model)  # a bridge
    return tuple(sorted(chosen, key=lambda model: -len(model.images)))


def unregistered_reason(image: int, placed: set[int], inliers: Mapping[Pair, int]) -> str:
    """Why an image is in no model.

    Args:
        placed: images that are. inliers: verified matches by pair.
    """
    of_image = {pair: count for pair, count in inliers.items() if image in pair and count > 0}
    to_placed = [count for pair, count in of_image.items() if (set(pair) - {image}) & placed]
    if not of_image:
        return "no verified matches to any image of its segment"
    if not to_placed:
        return f"matches {len(of_image)} images, none of which was placed"
    return f"at most {max(to_placed)} verified matches to a placed image; no mapper registered it"
