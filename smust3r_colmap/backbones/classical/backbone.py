"""The classical backbone as the pipeline sees it: stages, their keys, and what they hand on."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from smust3r_colmap.backbones.base import BackboneResult
from smust3r_colmap.backbones.classical.calibration import CalibrationTask, agree_on_cameras, calibrate_segment
from smust3r_colmap.backbones.classical.dense import DepthTask, make_depth, make_no_depth
from smust3r_colmap.backbones.classical.descriptors import vlad_descriptors
from smust3r_colmap.backbones.classical.features import (
    Pair,
    create_database,
    extract_features,
    match_pairs,
    open_database,
    plan_pairs,
)
from smust3r_colmap.backbones.classical.mapping import MappedSegment, MappingTask, map_segment
from smust3r_colmap.backbones.classical.storage import read_mapped, write_mapped
from smust3r_colmap.config import ClassicalConfig
from smust3r_colmap.execution import TaskFailure, map_tasks
from smust3r_colmap.products import (
    FeatureLinks,
    ImageCollection,
    RejectedImage,
    Segment,
    SegmentPiece,
    SegmentReconstruction,
    UnregisteredImage,
)
from smust3r_colmap.progress import Reporter, Stage
from smust3r_colmap.run_directory import RunDirectory, StageFolder, key_of, read_arrays, write_arrays
from smust3r_colmap.stored_maps import StoredMaps

logger = logging.getLogger(__name__)

TaskT = TypeVar("TaskT")


class ClassicalBackbone:
    """SIFT, mapping inside the segment, one calibration for the run, plane-sweep depth.

    Args:
        config: settings of the backbone.
        workers: processes, at least one.
        seed: of every sampler.
    """

    name = "classical"
    metric = False

    def __init__(self, config: ClassicalConfig, *, workers: int, seed: int) -> None:
        self.config = config
        self.workers = workers
        self.seed = seed

    def reconstruct(
        self, collection: ImageCollection, segments: Sequence[Segment], run: RunDirectory, reporter: Reporter
    ) -> BackboneResult:
        """All segments of the run; see ``Backbone``."""
        features = self._features_stage(collection, run)
        database = features.open_in_place() / "database.db"
        rejected = self._extract(database, collection, run, reporter)
        lost = {image.name for image in rejected}
        usable = [image.name not in lost for image in collection.images]
        pairs = self._match(database, segments, usable, run, reporter)
        descriptors = self._descriptors(database, usable, run, features.key)
        tasks = [self._mapping_task(segment, pairs[segment.index], database, collection) for segment in segments]
        mapped = self._map(tasks, collection, run, features.key, reporter)
        reconstructions = [_reconstruction(one, descriptors) for one in mapped]
        dense, dense_key = self._dense([p for r in reconstructions for p in r.pieces], collection, run, reporter)
        return BackboneResult(
            reconstructions=tuple(reconstructions),
            dense=dense,
            dense_key=dense_key,
            links=_read_links(database, sorted(set().union(*pairs.values()))),
            rejected=rejected,
        )

    # ------------------------------------------------------------- once in the run
    def _pairs(self, segment: Segment) -> tuple[Pair, ...]:
        return plan_pairs(
            segment, neighbours=self.config.match_neighbours, exhaustive_below=self.config.exhaustive_below
        )

    def _features_stage(self, collection: ImageCollection, run: RunDirectory) -> StageFolder:
        images = [(image.digest, image.width, image.height, image.camera) for image in collection.images]
        key = key_of(
            "features", images, collection.cameras, self.config.max_image_size, self.config.max_features, self.seed
        )
        return run.stage("features", key=key)

    def _extract(
        self, database: Path, collection: ImageCollection, run: RunDirectory, reporter: Reporter
    ) -> tuple[RejectedImage, ...]:
        create_database(database, collection)
        with reporter.stage("features", total=len(collection)) as stage:
            rejected = extract_features(
                database,
                collection,
                max_image_size=self.config.max_image_size,
                max_features=self.config.max_features,
                workers=self.workers,
                log_file=run.native_log,
                stage=stage,
            )
        for image in rejected:
            reporter.warn(f"no features: {image.name} ({image.reason})")
        return rejected

    def _match(
        self, database: Path, segments: Sequence[Segment], usable: Sequence[bool], run: RunDirectory, reporter: Reporter
    ) -> dict[int, tuple[Pair, ...]]:
        """The matched pairs by segment. Pairs that failed are in no key, so what comes later is not final either."""
        plan = {
            segment.index: [(a, b) for a, b in self._pairs(segment) if usable[a] and usable[b]] for segment in segments
        }
        every_pair = {pair for pairs in plan.values() for pair in pairs}
        with reporter.stage("matching", total=len(every_pair)) as stage:
            matched = match_pairs(
                database, every_pair, workers=self.workers, seed=self.seed, log_file=run.native_log, stage=stage
            )
        return {index: tuple(pair for pair in pairs if pair in matched) for index, pairs in plan.items()}

    def _descriptors(
        self, database: Path, usable: Sequence[bool], run: RunDirectory, features_key: str
    ) -> npt.NDArray[np.float32]:
        """(N, D) descriptors of all images, made once."""
        stage = run.stage("descriptors", key=key_of("descriptors", features_key, usable, self.seed))
        if not stage.is_done:
            with open_database(database) as opened:
                sift = [np.asarray(opened.read_descriptors(i + 1).data).reshape(-1, 128) for i in range(len(usable))]
            made = vlad_descriptors(sift, rng=np.random.default_rng(self.seed))
            with stage.write() as folder:
                write_arrays(folder / "descriptors.safetensors", {"vlad": made})
        vlad: npt.NDArray[np.float32] = read_arrays(stage.path / "descriptors.safetensors")["vlad"]
        return vlad

    # --------------------------------------------------------------- every segment
    def _mapping_task(
        self, segment: Segment, pairs: tuple[Pair, ...], database: Path, collection: ImageCollection
    ) -> MappingTask:
        return MappingTask(
            segment=segment.index,
            database=database,
            images=segment.images,
            camera_indices=tuple(collection.images[i].camera for i in segment.images),
            pairs=pairs,
            cameras=collection.cameras,
            trusted_focal={},
            seed=self.seed,
        )

    def _map(
        self,
        tasks: Sequence[MappingTask],
        collection: ImageCollection,
        run: RunDirectory,
        features_key: str,
        reporter: Reporter,
    ) -> list[MappedSegment]:
        """Map every segment freely, agree on the cameras, bring every segment to them."""
        keys = [key_of("mapping", features_key, task.images, task.pairs, self.seed) for task in tasks]
        folders = [_segment_stage(run, task.segment, "mapping", key) for task, key in zip(tasks, keys, strict=True)]
        with reporter.stage("mapping", total=len(tasks)) as stage:
            mapped = self._finish(map_segment, tasks, folders, [_nothing(task) for task in tasks], run, stage)
        crashed = [k for k, one in enumerate(mapped) if not one.models and not folders[k].is_done]
        if crashed:
            with reporter.stage("mapping without the global mapper", total=len(crashed)) as stage:
                careful = [replace(tasks[k], use_global=False) for k in crashed]
                again = self._finish(
                    map_segment, careful, [folders[k] for k in crashed], [mapped[k] for k in crashed], run, stage
                )
            for k, one in zip(crashed, again, strict=True):
                mapped[k] = one
        agreed = agree_on_cameras(mapped, [image.camera for image in collection.images], collection.cameras)
        for camera, intrinsics in agreed.items():
            reporter.note(f"camera {camera + 1}: the segments agree on a focal length of {intrinsics.focal_px:.1f} px")
        chosen = [k for k, one in enumerate(mapped) if one.models]
        keys = [key_of("calibrated", keys[k], sorted(agreed.items())) for k in chosen]
        folders = [
            _segment_stage(run, mapped[k].segment, "calibrated", key) for k, key in zip(chosen, keys, strict=True)
        ]
        calibrations = [CalibrationTask(mapping=tasks[k], mapped=mapped[k], agreed=agreed) for k in chosen]
        with reporter.stage("calibration", total=len(chosen)) as stage:
            calibrated = self._finish(calibrate_segment, calibrations, folders, [mapped[k] for k in chosen], run, stage)
        for k, one in zip(chosen, calibrated, strict=True):
            mapped[k] = one
        return mapped

    def _finish(
        self,
        function: Callable[[TaskT], MappedSegment],
        tasks: Sequence[TaskT],
        folders: Sequence[StageFolder],
        otherwise: Sequence[MappedSegment],
        run: RunDirectory,
        stage: Stage,
    ) -> list[MappedSegment]:
        """Run what no earlier start finished, store it, and return everything in order.

        A task that failed gives what ``otherwise`` has for it, which is not stored: the next start, with
        fewer workers or more disk, may get farther.
        """
        missing = [k for k, folder in enumerate(folders) if not folder.is_done]
        stage.skip(len(tasks) - len(missing))
        failed = {}
        for result in map_tasks(function, [tasks[k] for k in missing], workers=self.workers, log_file=run.native_log):
            k = missing[result.index]
            if isinstance(result.value, TaskFailure):
                failed[k] = _with_failure(otherwise[k], folders[k].path.name, result.value)
                logger.warning("segment %d, %s", failed[k].segment, failed[k].attempts[-1])
            else:
                with folders[k].write() as folder:
                    write_mapped(folder, result.value)
            stage.advance()
        return [failed[k] if k in failed else read_mapped(folder.path) for k, folder in enumerate(folders)]

    def _dense(
        self, pieces: Sequence[SegmentPiece], collection: ImageCollection, run: RunDirectory, reporter: Reporter
    ) -> tuple[tuple[StoredMaps, ...], str]:
        """Maps of every piece and their common key; a piece whose sweep failed gets empty ones and a warning."""
        tasks = []
        for piece in pieces:
            images = tuple(collection.images[i] for i in piece.images)
            geometry = (piece.seg_from_cam, piece.intrinsics, piece.tracks)
            key = key_of(
                "depth", [i.digest for i in images], geometry, self.config.dense_size, self.config.depth_planes
            )
            tasks.append(
                DepthTask(
                    piece=piece,
                    images=images,
                    folder=_segment_stage(run, piece.segment, f"depth_{piece.piece}", key),
                    dense_size=self.config.dense_size,
                    planes=self.config.depth_planes,
                )
            )
        missing = [task for task in tasks if not task.folder.is_done]
        total = sum(len(piece.images) for piece in pieces)
        with reporter.stage("depth", total=total) as stage:
            stage.skip(total - sum(len(task.images) for task in missing))
            for result in map_tasks(make_depth, missing, workers=self.workers, log_file=run.native_log):
                task = missing[result.index]
                if isinstance(result.value, TaskFailure):
                    reporter.warn(f"segment {task.piece.name} has no depth maps: {result.value.reason}")
                    make_no_depth(task)
                stage.advance(len(task.images))
        maps = tuple(StoredMaps(task.folder.path, task.piece) for task in tasks)
        return maps, key_of([(task.folder.key, task.folder.is_done) for task in tasks])


def _segment_stage(run: RunDirectory, segment: int, name: str, key: str) -> StageFolder:
    return run.stage("segments", f"{segment:04d}", name, key=key)


def _nothing(task: MappingTask) -> MappedSegment:
    reason = f"the mapping of segment {task.segment} failed"
    return MappedSegment(
        segment=task.segment,
        models=(),
        attempts=(),
        unregistered=tuple(UnregisteredImage(image=image, reason=reason) for image in task.images),
    )


def _with_failure(mapped: MappedSegment, stage: str, failure: TaskFailure) -> MappedSegment:
    return replace(mapped, attempts=(*mapped.attempts, f"{stage}: {failure.reason}"))


def _reconstruction(mapped: MappedSegment, descriptors: npt.NDArray[np.float32]) -> SegmentReconstruction:
    pieces = tuple(
        SegmentPiece(
            segment=mapped.segment,
            piece=number,
            images=model.images,
            seg_from_cam=model.seg_from_cam,
            intrinsics=model.intrinsics,
            method=model.method,
            reprojection_error_px=model.reprojection_error_px,
            tracks=model.tracks,
            descriptors=descriptors[list(model.images)],
        )
        for number, model in enumerate(mapped.models)
    )
    return SegmentReconstruction(
        segment=mapped.segment,
        pieces=pieces,
        unregistered=mapped.unregistered,
        attempts=mapped.attempts,
        metric=ClassicalBackbone.metric,
    )


def _read_links(database: Path, pairs: Sequence[Pair]) -> FeatureLinks:
    """The verified matches of all pairs of the plan."""
    columns: list[list[npt.NDArray[np.int64]]] = [[], [], [], []]
    with open_database(database) as opened:
        for first, second in pairs:
            matches = np.asarray(
                opened.read_two_view_geometry(first + 1, second + 1).inlier_matches, dtype=np.int64
            ).reshape(-1, 2)
            columns[0].append(np.full(len(matches), first))
            columns[1].append(matches[:, 0])
            columns[2].append(np.full(len(matches), second))
            columns[3].append(matches[:, 1])
    empty = np.zeros(0, dtype=np.int64)
    joined = [np.concatenate([empty, *column]) for column in columns]
    return FeatureLinks(image_a=joined[0], feature_a=joined[1], image_b=joined[2], feature_b=joined[3])
