"""The mapping strategies of a segment: calls of COLMAP's mappers as values, and the database that they read.

The next module to read is ``mapping``, which runs them one after another.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pycolmap

from smust3r_colmap.backbones.classical.start_pair import ENOUGH_ANGLE_DEG, MIN_INLIERS, StartPair, choose_start_pairs
from smust3r_colmap.backbones.classical.thinning import thin_matches
from smust3r_colmap.colmap.database import open_database, write_images
from smust3r_colmap.geometry.arrays import Pair
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.segmentation.view_graph import ViewGraph

MIN_SUBMODEL_IMAGES = 4
"""Smaller models are too weak to be a node; a smaller segment cannot have larger ones."""
MAX_MODELS = 6
"""Models that one strategy may start; later ones hold few images and take minutes."""
ANGLE_TOLERANCE_RATIO = 0.3
"""Share of the start pair's angle that the mapper, which estimates it again by sampling, has to find."""

PipelineOptions = pycolmap.IncrementalPipelineOptions | pycolmap.GlobalPipelineOptions


@dataclass(frozen=True, kw_only=True)
class MappingTask:
    """One segment to map.

    Args:
        segment: its index. database: the run's. images: indices in order, with their cameras.
        pairs: which of the database's pairs may be used; all of them have been matched.
        view_graph: the pairs of the segment, with the order of its images.
        cameras: initial values by camera index.
        known_cameras: by camera index; empty for a calibration segment. They are held fixed where all cameras of the
            segment are known.
        seed: of pycolmap's samplers.
        use_global: the global mapper may be used; not after it aborted the process.
        in_order: images that follow each other in ``images`` are neighbours; not in a cluster.
    """

    segment: int
    database: Path
    images: tuple[int, ...]
    camera_indices: tuple[int, ...]
    pairs: tuple[Pair, ...]
    view_graph: ViewGraph
    cameras: tuple[Intrinsics, ...]
    known_cameras: Mapping[int, Intrinsics]
    seed: int
    use_global: bool = True
    in_order: bool = True

    @property
    def camera_of(self) -> dict[int, int]:
        """Camera index by image."""
        return dict(zip(self.images, self.camera_indices, strict=True))

    @property
    def calibrated(self) -> bool:
        """All cameras of the segment are known."""
        return self.known_cameras.keys() >= set(self.camera_indices)

    @property
    def start_cameras(self) -> tuple[Intrinsics, ...]:
        """Initial values by camera index.

        Without a prior COLMAP estimates the focal length with the first pose, whatever else is held fixed.
        """
        known = {index: replace(camera, has_prior_focal=True) for index, camera in self.known_cameras.items()}
        return tuple(known.get(index, camera) for index, camera in enumerate(self.cameras))

    @property
    def min_model_images(self) -> int:
        """Images that a model of the segment must have."""
        return MIN_SUBMODEL_IMAGES if len(self.images) >= MIN_SUBMODEL_IMAGES else 2


@dataclass(frozen=True, kw_only=True, eq=False)
class MappingStrategy:
    """One way to map a segment.

    Args:
        name: for people; strategies of one segment have different names.
        database: of the segment alone.
        options: of the incremental or the global mapper; tried in order until one gives a model.
        continues: name of the strategy whose model is extended; None to start anew.
        retry_with_near_pairs: map again with pairs of near images only, where matches contradict the model.
    """

    name: str
    database: Path
    options: tuple[PipelineOptions, ...]
    continues: str | None = None
    retry_with_near_pairs: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class MapperOutput:
    """The models of a strategy.

    Args:
        models: by number.
        folder: has the models as subfolders named by number; None where there are none.
    """

    models: Mapping[int, pycolmap.Reconstruction]
    folder: Path | None = None


def run_strategy(strategy: MappingStrategy, output: Path, start: Path | None) -> MapperOutput:
    """The models of the first options that give any.

    Args:
        output: folder for the models; created.
        start: model that is extended, in COLMAP's format.
    """
    for number, options in enumerate(strategy.options):
        folder = output / str(number)
        folder.mkdir(parents=True)
        images = strategy.database.parent  # needed for colours only, which are not extracted
        if isinstance(options, pycolmap.GlobalPipelineOptions):
            models = pycolmap.global_mapping(strategy.database, images, folder, options)
        else:
            models = pycolmap.incremental_mapping(strategy.database, images, folder, options, input_path=start or "")
        if models:
            return MapperOutput(models=models, folder=folder)
    return MapperOutput(models={})


# ----------------------------------------------------------------------------- strategies
def from_start_pairs(name: str, database: Path, pairs: Sequence[Pair], task: MappingTask) -> MappingStrategy:
    """One model from the best start pair that gives one."""
    start_cameras = task.start_cameras
    cameras = {image: start_cameras[index] for image, index in task.camera_of.items()}
    with open_database(database) as opened:
        starts = choose_start_pairs(opened, pairs, cameras, seed=task.seed)
    return MappingStrategy(
        name=name,
        database=database,
        options=tuple(_start_pair_options(task, start) for start in starts),
        retry_with_near_pairs=True,
    )


def relaxed(name: str, database: Path, task: MappingTask, *, continues: str | None = None) -> MappingStrategy:
    """Models with relaxed demands, continued from those of another strategy or from pairs that COLMAP finds."""
    return MappingStrategy(name=name, database=database, options=(_relaxed_options(task),), continues=continues)


def global_mapping(name: str, database: Path, task: MappingTask) -> MappingStrategy:
    """COLMAP's global mapper: it registers more images, but its model may be wrong at a small reprojection error."""
    return MappingStrategy(name=name, database=database, options=(_global_options(task),))


def _start_pair_options(task: MappingTask, pair: StartPair) -> pycolmap.IncrementalPipelineOptions:
    """The start pair, and demands on it that it meets."""
    options = _incremental_options(task)
    options.init_image_id1 = pair.first + 1
    options.init_image_id2 = pair.second + 1
    options.multiple_models = False  # every further model would start from the same pair
    options.init_num_trials = 1  # and so would every further trial
    options.mapper.init_min_num_inliers = MIN_INLIERS
    options.mapper.init_min_tri_angle = min(ENOUGH_ANGLE_DEG, ANGLE_TOLERANCE_RATIO * pair.angle_deg)
    options.mapper.init_max_forward_motion = 1.0 if pair.forward else 0.95
    return options


def _relaxed_options(task: MappingTask) -> pycolmap.IncrementalPipelineOptions:
    options = _incremental_options(task)
    options.max_num_models = MAX_MODELS
    options.mapper.init_min_tri_angle = 3.0
    options.mapper.init_max_forward_motion = 1.0
    options.mapper.init_min_num_inliers = 50
    options.mapper.abs_pose_min_num_inliers = 15
    return options


def _incremental_options(task: MappingTask) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.random_seed = task.seed
    options.extract_colors = False
    options.min_model_size = task.min_model_images
    options.max_model_overlap = 20
    # COLMAP adjusts to a function tolerance of 0 whenever a model has grown by a tenth. A segment is adjusted
    # again in the whole scene; only focal length and distortion, which are nearly degenerate, need the iterations.
    known = task.calibrated
    options.ba_local_function_tolerance = 1e-2 if known else 1e-4
    options.ba_local_max_refinements = 1
    options.ba_global_function_tolerance = 1e-3 if known else 1e-5
    options.ba_global_max_refinements = 1 if known else 2
    options.ba_global_frames_ratio = 1.4
    options.ba_global_points_ratio = 1.4
    options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = not known
    options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = not known
    options.mapper.num_threads = 1
    options.mapper.random_seed = task.seed
    options.triangulation.random_seed = task.seed
    if len(task.images) < MIN_SUBMODEL_IMAGES:
        # Hardly any point is seen by a third view that could confirm it.
        options.triangulation.ignore_two_view_tracks = False
    return options


def _global_options(task: MappingTask) -> pycolmap.GlobalPipelineOptions:
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = 1
    options.random_seed = task.seed
    options.min_model_size = task.min_model_images
    options.mapper.num_threads = 1
    options.mapper.random_seed = task.seed
    options.mapper.global_positioning.use_gpu = False
    options.mapper.bundle_adjustment.ceres.use_gpu = False
    options.mapper.bundle_adjustment.refine_focal_length = not task.calibrated
    options.mapper.bundle_adjustment.refine_extra_params = not task.calibrated
    return options


# ------------------------------------------------------------------------------- database
def build_database(path: Path, pairs: Sequence[Pair], task: MappingTask) -> dict[Pair, int]:
    """Write a database of the segment alone, with its initial cameras and thinned matches.

    Args:
        path: of the new file. pairs: of the task's that are written.

    Returns:
        Verified matches by pair, before thinning.
    """
    with (
        open_database(task.database) as run,
        pycolmap.Database.open(path) as own,
        pycolmap.DatabaseTransaction(own),
    ):
        write_images(own, task.start_cameras, zip(task.images, task.camera_indices, strict=True))
        num_features = {}
        for image in task.images:
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
