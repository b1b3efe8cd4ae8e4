"""Segments that COLMAP maps in a moment, and mapped models that are made up."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap

from helpers.scenes import make_submodel, points_ahead, walk
from smust3r_colmap.backbones.classical.mapped_model import MappedModel
from smust3r_colmap.backbones.classical.mapping import MappedSegment
from smust3r_colmap.backbones.classical.strategies import MappingTask
from smust3r_colmap.features.pairs import plan_pairs
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.products import Segment
from smust3r_colmap.segmentation.view_graph import ViewGraph

NUM_IMAGES = 8


@dataclass(frozen=True, kw_only=True, eq=False)
class SyntheticSegment:
    """A segment to map, and its true model."""

    task: MappingTask
    truth: pycolmap.Reconstruction

    def centre_error(self, model: MappedModel) -> float:
        """Largest distance of a camera centre from the truth after the best similarity."""
        true = np.array([self.truth.image(i + 1).projection_center() for i in model.images])
        truth_from_model = pycolmap.estimate_sim3d(model.seg_from_cam[:, :, 3], true)
        moved = np.array([truth_from_model * centre for centre in model.seg_from_cam[:, :, 3]])
        return float(np.linalg.norm(moved - true, axis=1).max())


def synthetic_segment(folder: Path) -> SyntheticSegment:
    """A noise-free database of eight images round a cloud, and the truth."""
    path = folder / "database.db"
    pycolmap.set_random_seed(3)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs = 1
    options.num_frames_per_rig = NUM_IMAGES
    options.num_points3D = 300
    with pycolmap.Database.open(path) as database:
        truth = pycolmap.synthesize_dataset(options, database)
    start = Intrinsics(model="SIMPLE_RADIAL", width=1024, height=768, params=(1200.0, 512.0, 384.0, 0.0))
    images = tuple(range(NUM_IMAGES))
    task = MappingTask(
        segment=0,
        database=path,
        images=images,
        camera_indices=(0,) * NUM_IMAGES,
        pairs=plan_pairs(Segment(index=0, images=images), neighbours=8, exhaustive_below=25),
        view_graph=ViewGraph.chain(NUM_IMAGES),
        cameras=(start,),
        known_cameras={},
        seed=0,
    )
    return SyntheticSegment(task=task, truth=truth)


def without_pairs(task: MappingTask, *left_out: tuple[int, int]) -> MappingTask:
    """The task without some of its pairs."""
    return replace(task, pairs=tuple(pair for pair in task.pairs if pair not in left_out))


def model_of_walk(num_images: int) -> MappedModel:
    """Images along a straight line, and points ahead of them."""
    submodel = make_submodel(
        walk(num_images), tuple(range(num_images)), points_ahead(50, np.random.default_rng(0)), Sim3.identity()
    )
    assert submodel.tracks is not None
    return MappedModel(
        images=submodel.images,
        seg_from_cam=submodel.seg_from_cam,
        intrinsics=submodel.intrinsics,
        tracks=submodel.tracks,
        reprojection_error_px=0.3,
        method="made up",
    )


def segment_of(number: int, *models: MappedModel) -> MappedSegment:
    """A mapped segment with these models."""
    return MappedSegment(segment=number, models=models, attempts=(), unregistered=())
