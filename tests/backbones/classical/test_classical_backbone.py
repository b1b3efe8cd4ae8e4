"""The classical backbone where a stage of a segment fails."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.mapped_segments import NUM_IMAGES, SyntheticSegment, model_of_walk, segment_of, synthetic_segment
from helpers.runs import quiet_run
from helpers.scenes import CAMERA

from smust3r_colmap.backbones.classical.backbone import ClassicalBackbone
from smust3r_colmap.backbones.classical.mapping import MappedSegment
from smust3r_colmap.backbones.classical.strategies import MappingTask
from smust3r_colmap.config import ClassicalConfig
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.products import ImageCollection, RunFeatures, Segment, SourceImage
from smust3r_colmap.segmentation.view_graph import ViewGraph

WINDOW = Segment(index=0, images=tuple(range(NUM_IMAGES)))
ORDER = ViewGraph.chain(NUM_IMAGES)


@pytest.fixture(scope="module")
def segment(tmp_path_factory: pytest.TempPathFactory) -> SyntheticSegment:
    return synthetic_segment(tmp_path_factory.mktemp("synthetic"))


def backbone_of(
    segment: SyntheticSegment, run: Run, mapper: Callable[[MappingTask], MappedSegment]
) -> ClassicalBackbone:
    """A calibrated backbone with the features of the segment; there are no image files."""
    image = SourceImage(name="0", path=run.folder.root / "0", width=640, height=480, camera=0, digest="0")
    images = tuple(replace(image, name=str(k)) for k in range(NUM_IMAGES))
    features = RunFeatures(database=segment.task.database, key="key", usable=(True,) * NUM_IMAGES, rejected=())
    return ClassicalBackbone(
        ImageCollection(images=images, cameras=(CAMERA,), calibrated=True),
        ClassicalConfig(),
        run,
        exhaustive_below=25,
        features=lambda: features,
        mapper=mapper,
    )


def run_out_of_memory(task: MappingTask) -> MappedSegment:
    raise MemoryError(f"segment {task.segment}")


def map_as_walk(task: MappingTask) -> MappedSegment:
    return segment_of(task.segment, model_of_walk(6))


def die_in_the_global_mapper(task: MappingTask) -> MappedSegment:
    if task.use_global:
        os.kill(os.getpid(), signal.SIGKILL)
    return map_as_walk(task)


@pytest.mark.slow
def test_a_segment_that_failed_is_tried_again_in_the_next_run(segment: SyntheticSegment, tmp_path: Path) -> None:
    with quiet_run(tmp_path / "out") as run:
        (failed,) = (
            backbone_of(segment, run, run_out_of_memory).reconstruct([WINDOW], ORDER, with_maps=()).reconstructions
        )
        (mapped,) = backbone_of(segment, run, map_as_walk).reconstruct([WINDOW], ORDER, with_maps=()).reconstructions
    assert failed.submodels == ()
    assert {one.reason for one in failed.unregistered} == {"the mapping of segment 0 failed"}
    assert all(attempt.startswith("mapping: ") and "segment 0" in attempt for attempt in failed.attempts)
    assert [submodel.images for submodel in mapped.submodels] == [tuple(range(6))]


@pytest.mark.slow
def test_a_global_mapper_that_aborts_its_process_is_left_out(segment: SyntheticSegment, tmp_path: Path) -> None:
    with quiet_run(tmp_path / "out") as run:
        (mapped,) = (
            backbone_of(segment, run, die_in_the_global_mapper)
            .reconstruct([WINDOW], ORDER, with_maps=())
            .reconstructions
        )
    assert [submodel.images for submodel in mapped.submodels] == [tuple(range(6))]


def test_a_sweep_that_failed_gives_empty_maps(
    segment: SyntheticSegment, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with quiet_run(tmp_path / "out") as run:
        (maps,) = backbone_of(segment, run, map_as_walk).reconstruct([WINDOW], ORDER, with_maps=[0]).dense
        assert not list((tmp_path / "out").rglob("depth_0/*"))
    assert "segment 0 has no depth maps" in capsys.readouterr().err
    assert len(maps) == 6
    assert maps.depth(2).shape == (288, 384)
    assert not maps.depth(2).any()
    assert (maps.confidence(2) == 1).all()
    assert np.isnan(maps.pointmap_seg(2)).all()
    assert maps.rgb(2).shape == (288, 384, 3)
