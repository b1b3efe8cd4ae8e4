"""The classical backbone: SIFT features, incremental mapping of every segment, plane-sweep depth.

The stages, their keys and their results. The next module to read is ``start_pair``.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from smust3r_colmap.backbones.base import BackboneContext, BackbonePlugin, BackboneResult
from smust3r_colmap.backbones.classical.calibration import (
    CalibrationTask,
    agree_on_cameras,
    calibrate_segment,
    choose_calibration_segments,
    find_worse_fits,
    focal_lengths_agree,
    self_calibration_is_better,
)
from smust3r_colmap.backbones.classical.dense import DepthTask, make_depth
from smust3r_colmap.backbones.classical.mapping import MAPPED_SEGMENT, METHOD_VERSION, MappedSegment, map_segment
from smust3r_colmap.backbones.classical.strategies import MappingTask
from smust3r_colmap.backbones.options import NoOptions
from smust3r_colmap.colmap.database import open_database
from smust3r_colmap.config import ClassicalConfig
from smust3r_colmap.execution.progress import Stage
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.execution.task_pool import TaskFailure
from smust3r_colmap.features.pairs import plan_loop_pairs, plan_pairs
from smust3r_colmap.features.stage import (
    cross_validated_cameras_of_run,
    describe_images,
    features_of_run,
    match_pairs_of_run,
)
from smust3r_colmap.geometry.arrays import Pair
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.products import (
    DenseMaps,
    ImageCollection,
    InterSegmentMatches,
    RunFeatures,
    Segment,
    SegmentKind,
    SegmentReconstruction,
    Submodel,
    UnregisteredImage,
)
from smust3r_colmap.segmentation.view_graph import ViewGraph
from smust3r_colmap.storage.dense_maps import EmptyMaps, StoredMaps
from smust3r_colmap.storage.run_directory import StageFolder, key_of

logger = logging.getLogger(__name__)

TaskT = TypeVar("TaskT")


class ClassicalBackbone:
    """SIFT, mapping inside the segment, one calibration for the run, plane-sweep depth.

    Args:
        collection: the images of the run.
        config: settings of the backbone.
        run: where finished work is kept, and how tasks run.
        features: extracts those of the run that no earlier start has extracted.
        exhaustive_below: windows of at most this many images are matched exhaustively.
        mapper: maps a segment, in a child process.
    """

    name = "classical"
    metric = False
    has_tracks = True

    def __init__(
        self,
        collection: ImageCollection,
        config: ClassicalConfig,
        run: Run,
        *,
        features: Callable[[], RunFeatures],
        exhaustive_below: int,
        mapper: Callable[[MappingTask], MappedSegment] = map_segment,
    ) -> None:
        self.collection = collection
        self.config = config
        self.exhaustive_below = exhaustive_below
        self.run = run
        self._extract = features
        self._mapper = mapper

    def describe(self) -> npt.NDArray[np.float32]:
        """VLAD of the SIFT features of every image; see ``Backbone``."""
        return describe_images(self.run, self._features)

    def reconstruct(
        self, segments: Sequence[Segment], view_graph: ViewGraph, *, with_maps: Collection[int]
    ) -> BackboneResult:
        """All segments of the run; see ``Backbone``."""
        pairs = self._match(segments, view_graph)
        reconstructions = [_reconstruction(one) for one in self._map(segments, pairs, view_graph)]
        dense, dense_key = self._dense([p for r in reconstructions for p in r.submodels], with_maps)
        return BackboneResult(
            reconstructions=tuple(reconstructions),
            dense=dense,
            dense_key=dense_key,
            matches=_read_matches(self._features.database, sorted(set().union(*pairs.values()))),
            rejected=self._features.rejected,
            features=self._features,
        )

    # ------------------------------------------------------------- once in the run
    @cached_property
    def _features(self) -> RunFeatures:
        return self._extract()

    def _match(self, segments: Sequence[Segment], view_graph: ViewGraph) -> dict[int, tuple[Pair, ...]]:
        """The matched pairs by segment. Pairs that failed are in no key, so what comes later is not final either."""
        descriptors = self.describe() if any(segment.kind == "loop" for segment in segments) else None
        plan = {segment.index: self._pairs(segment, view_graph, descriptors) for segment in segments}
        every_pair = {pair for pairs in plan.values() for pair in pairs}
        matched = match_pairs_of_run(self.run, self._features, every_pair)
        return {index: tuple(pair for pair in pairs if pair in matched) for index, pairs in plan.items()}

    def _pairs(
        self, segment: Segment, view_graph: ViewGraph, descriptors: npt.NDArray[np.float32] | None
    ) -> tuple[Pair, ...]:
        neighbours = self.config.match_neighbours
        if segment.kind == "cluster":
            return view_graph.within(segment.images).tuples
        if segment.kind == "loop":
            assert descriptors is not None, "loops are found by descriptors"
            return plan_loop_pairs(view_graph.runs(segment.images), descriptors, neighbours=neighbours)
        return plan_pairs(segment, neighbours=neighbours, exhaustive_below=self.exhaustive_below)

    # --------------------------------------------------------------- every segment
    def _map(
        self, segments: Sequence[Segment], pairs: Mapping[int, tuple[Pair, ...]], view_graph: ViewGraph
    ) -> list[MappedSegment]:
        """Map the segments with one calibration for the run; see ``calibration``.

        Only windows determine the cameras, so a loop that is found later changes no window.
        """
        tasks = {segment.index: self._mapping_task(segment, pairs[segment.index], view_graph) for segment in segments}
        if self.collection.calibrated:
            mapped = self._map_all("mapping", list(tasks.values()))
            return [mapped[segment.index] for segment in segments]
        starts = self._start_cameras([tasks[segment.index] for segment in segments if segment.kind != "loop"])
        tasks = {index: replace(task, cameras=starts) for index, task in tasks.items()}
        mapped = self._self_calibrated([tasks[segment.index] for segment in segments if segment.kind != "loop"])
        known = self._agreed_cameras(segments, mapped)
        rest = [
            replace(tasks[segment.index], known_cameras=known[segment.kind])
            for segment in segments
            if segment.index not in mapped
        ]
        if rest:
            found = self._map_known(rest, list(mapped.values()))
            tasks |= {task.segment: task for task, _ in found}
            mapped |= {one.segment: one for _, one in found}
        free = {index: one for index, one in mapped.items() if one.models and not tasks[index].calibrated}
        agreed = self._agreed_cameras(segments, free)
        for camera, intrinsics in (agreed["window"] | known["window"]).items():
            self.run.clock.note(
                f"camera {camera + 1}: the segments agree on a focal length of {intrinsics.focal_px:.1f} px"
            )
        calibrations = [
            CalibrationTask(
                mapping=tasks[segment.index],
                mapped=free[segment.index],
                agreed={**agreed[segment.kind], **tasks[segment.index].known_cameras},
            )
            for segment in segments
            if segment.index in free
        ]
        mapped |= self._calibrate_all(calibrations)
        return [mapped[segment.index] for segment in segments]

    def _start_cameras(self, windows: Sequence[MappingTask]) -> tuple[Intrinsics, ...]:
        """By camera index. Only pairs of the calibration segments tell, so images appended later change nothing."""
        pairs = {pair for task in choose_calibration_segments(windows) for pair in task.pairs}
        return cross_validated_cameras_of_run(self.run, self._features, self.collection, pairs)

    def _self_calibrated(self, windows: Sequence[MappingTask]) -> dict[int, MappedSegment]:
        """Windows mapped with free cameras, by segment: the calibration segments, or all where these disagree."""
        mapped = self._map_all("mapping", choose_calibration_segments(windows))
        rest = [task for task in windows if task.segment not in mapped]
        cameras = {camera for task in rest for camera in task.camera_indices}
        if not focal_lengths_agree(cameras, list(mapped.values()), [image.camera for image in self.collection.images]):
            mapped |= self._map_all("mapping of more windows", rest)
        return mapped

    def _map_known(
        self, tasks: Sequence[MappingTask], calibration: Sequence[MappedSegment]
    ) -> list[tuple[MappingTask, MappedSegment]]:
        """Segments mapped with the cameras found, or with free ones where these fit better; each with its task."""
        mapped = self._map_all("mapping with the cameras found", tasks)
        chosen = {task.segment: (task, mapped[task.segment]) for task in tasks}
        worse = find_worse_fits(list(mapped.values()), calibration)
        if worse:
            again = [replace(task, known_cameras={}) for task in tasks if task.segment in worse]
            free = self._map_all("mapping where these do not fit", again, folder="mapping_free")
            for task in again:
                if self_calibration_is_better(free[task.segment], mapped[task.segment]):
                    chosen[task.segment] = (task, free[task.segment])
        return list(chosen.values())

    def _map_all(self, name: str, tasks: Sequence[MappingTask], *, folder: str = "mapping") -> dict[int, MappedSegment]:
        """Mapped segments by index; without the global mapper where a mapper aborted the process."""
        folders = [self._segment_stage(task.segment, folder, self._mapping_key(task)) for task in tasks]
        with self.run.clock.stage(name, total=len(tasks)) as stage:
            mapped = self._finish(self._mapper, tasks, folders, [_nothing(task) for task in tasks], stage)
        crashed = [k for k, one in enumerate(mapped) if not one.models and not folders[k].is_done]
        if crashed:
            with self.run.clock.stage("mapping without the global mapper", total=len(crashed)) as stage:
                careful = [replace(tasks[k], use_global=False) for k in crashed]
                again = self._finish(
                    self._mapper, careful, [folders[k] for k in crashed], [mapped[k] for k in crashed], stage
                )
            for k, one in zip(crashed, again, strict=True):
                mapped[k] = one
        return {one.segment: one for one in mapped}

    def _calibrate_all(self, tasks: Sequence[CalibrationTask]) -> dict[int, MappedSegment]:
        """Self-calibrated segments adjusted to the agreed cameras, by segment."""
        keys = [key_of("calibrated", self._mapping_key(task.mapping), sorted(task.agreed.items())) for task in tasks]
        folders = [
            self._segment_stage(task.mapping.segment, "calibrated", key) for task, key in zip(tasks, keys, strict=True)
        ]
        with self.run.clock.stage("calibration", total=len(tasks)) as stage:
            calibrated = self._finish(calibrate_segment, tasks, folders, [task.mapped for task in tasks], stage)
        return {one.segment: one for one in calibrated}

    def _mapping_key(self, task: MappingTask) -> str:
        inputs = (
            self._features.key,
            self.run.seed,
            task.images,
            task.pairs,
            task.view_graph.pairs,
            task.cameras,
            sorted(task.known_cameras.items()),
        )
        return key_of("mapping", METHOD_VERSION, *inputs)

    def _agreed_cameras(
        self, segments: Sequence[Segment], free: Mapping[int, MappedSegment]
    ) -> dict[SegmentKind, dict[int, Intrinsics]]:
        """The cameras of self-calibrated windows, by the kind of segment that may use them.

        A camera of one window alone is not used for other windows, but for the loops with this window.
        """
        windows = [free[segment.index] for segment in segments if segment.kind != "loop" and segment.index in free]
        camera_of_image = [image.camera for image in self.collection.images]
        least: dict[SegmentKind, int] = {"window": 2, "cluster": 2, "loop": 1}
        return {
            kind: agree_on_cameras(windows, camera_of_image, self.collection.cameras, min_models=count)
            for kind, count in least.items()
        }

    def _mapping_task(self, segment: Segment, pairs: tuple[Pair, ...], view_graph: ViewGraph) -> MappingTask:
        return MappingTask(
            segment=segment.index,
            database=self._features.database,
            images=segment.images,
            camera_indices=tuple(self.collection.images[i].camera for i in segment.images),
            pairs=pairs,
            view_graph=view_graph.within(segment.images),
            cameras=self.collection.cameras,
            known_cameras=dict(enumerate(self.collection.cameras)) if self.collection.calibrated else {},
            seed=self.run.seed,
            in_order=segment.kind != "cluster",
        )

    def _finish(
        self,
        function: Callable[[TaskT], MappedSegment],
        tasks: Sequence[TaskT],
        folders: Sequence[StageFolder],
        otherwise: Sequence[MappedSegment],
        stage: Stage,
    ) -> list[MappedSegment]:
        """Run and store what no earlier run finished, and return all results in order.

        A task that failed gives its entry of ``otherwise``, which is not stored: the next run, with fewer workers or
        more disk, may succeed.
        """
        missing = [k for k, folder in enumerate(folders) if not folder.is_done]
        stage.skip(len(tasks) - len(missing))
        failed = {}
        todo = [tasks[k] for k in missing]
        for result in self.run.executor.map(function, todo):
            k = missing[result.index]
            if isinstance(result.value, TaskFailure):
                failed[k] = _with_failure(otherwise[k], folders[k].path.name, result.value)
                logger.warning("segment %d, %s", failed[k].segment, failed[k].attempts[-1])
            else:
                with folders[k].write() as folder:
                    MAPPED_SEGMENT.write(folder, result.value)
            stage.advance()
        return [failed[k] if k in failed else MAPPED_SEGMENT.read(folder.path) for k, folder in enumerate(folders)]

    def _dense(self, submodels: Sequence[Submodel], with_maps: Collection[int]) -> tuple[tuple[DenseMaps, ...], str]:
        """Maps of every submodel and their common key; a submodel whose sweep failed gets empty ones and a warning."""
        tasks = [self._depth_task(submodel) for submodel in submodels]
        wanted = [task for task in tasks if task.submodel.segment in with_maps]
        missing = [task for task in wanted if not task.folder.is_done]
        total = sum(len(task.images) for task in wanted)
        with self.run.clock.stage("depth", total=total) as stage:
            stage.skip(total - sum(len(task.images) for task in missing))
            for result in self.run.executor.map(make_depth, missing):
                task = missing[result.index]
                if isinstance(result.value, TaskFailure):
                    self.run.clock.warn(f"segment {task.submodel.name} has no depth maps: {result.value.reason}")
                stage.advance(len(task.images))
        done = [task.submodel.segment in with_maps and task.folder.is_done for task in tasks]
        maps: tuple[DenseMaps, ...] = tuple(
            StoredMaps(task.folder.path, task.submodel)
            if there
            else EmptyMaps(task.submodel, longer_side=task.dense_size)
            for task, there in zip(tasks, done, strict=True)
        )
        return maps, key_of([(task.folder.key, there) for task, there in zip(tasks, done, strict=True)])

    def _depth_task(self, submodel: Submodel) -> DepthTask:
        images = tuple(self.collection.images[i] for i in submodel.images)
        geometry = (submodel.seg_from_cam, submodel.intrinsics, submodel.tracks)
        key = key_of("depth", [i.digest for i in images], geometry, self.config.dense_size, self.config.depth_planes)
        return DepthTask(
            submodel=submodel,
            images=images,
            folder=self._segment_stage(submodel.segment, f"depth_{submodel.submodel}", key),
            dense_size=self.config.dense_size,
            planes=self.config.depth_planes,
        )

    def _segment_stage(self, segment: int, name: str, key: str) -> StageFolder:
        return self.run.folder.stage("segments", f"{segment:04d}", name, key=key)


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


def _reconstruction(mapped: MappedSegment) -> SegmentReconstruction:
    submodels = tuple(
        Submodel(
            segment=mapped.segment,
            submodel=number,
            images=model.images,
            seg_from_cam=model.seg_from_cam,
            intrinsics=model.intrinsics,
            method=model.method,
            reprojection_error_px=model.reprojection_error_px,
            tracks=model.tracks,
        )
        for number, model in enumerate(mapped.models)
    )
    return SegmentReconstruction(
        segment=mapped.segment,
        submodels=submodels,
        unregistered=mapped.unregistered,
        attempts=mapped.attempts,
        metric=ClassicalBackbone.metric,
    )


def _read_matches(database: Path, pairs: Sequence[Pair]) -> InterSegmentMatches:
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
    return InterSegmentMatches(image_a=joined[0], feature_a=joined[1], image_b=joined[2], feature_b=joined[3])


def make_classical(context: BackboneContext, options: NoOptions) -> ClassicalBackbone:
    """The classical backbone of one run."""
    run, collection, sift = context.run, context.collection, context.config.features
    return ClassicalBackbone(
        collection,
        context.config.classical,
        run,
        features=partial(features_of_run, run, collection, sift),
        exhaustive_below=sift.exhaustive_below,
    )


CLASSICAL = BackbonePlugin(make=make_classical, options=NoOptions)
