"""From a network's predictions to submodels: what is kept, what is thrown out, and how a run goes on."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from helpers.room_network import install_package, pinhole
from helpers.runs import quiet_run

from smust3r_colmap.backbones.base import Backbone, BackboneResult
from smust3r_colmap.backbones.feed_forward import (
    FeedForwardBackbone,
    PredictedImage,
    Predictor,
    SegmentPrediction,
    fingerprint_of,
)
from smust3r_colmap.config import OutputConfig, RefinementConfig, RunConfig, SegmentationConfig
from smust3r_colmap.errors import CheckpointError, ReconstructionError
from smust3r_colmap.evaluation.trajectory import compare_trajectories
from smust3r_colmap.execution.progress import QuietReporter, Stage
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import pointmap_from_depth
from smust3r_colmap.importers.model_poses import read_model_poses
from smust3r_colmap.importers.poses_txt import read_poses_txt
from smust3r_colmap.pipeline import reconstruct
from smust3r_colmap.products import ImageCollection, Segment, SourceImage, UnregisteredImage
from smust3r_colmap.report.summary import RunSummary
from smust3r_colmap.segmentation.view_graph import ViewGraph
from smust3r_colmap.storage.dense_maps import ImageMaps
from smust3r_colmap.synthetic.room import write_demo

WIDTH, HEIGHT, NUM_IMAGES = 40, 30, 6
CAMERA = pinhole(4 * WIDTH, 4 * HEIGHT, 130)
WINDOW = Segment(index=0, images=(0, 1, 2, 3))
ORDER = ViewGraph.chain(6)
LOOP = Segment(index=1, images=(0, 1, 4, 5), kind="loop")

Spoil = Callable[[PredictedImage], PredictedImage]


def photographs(num_images: int = NUM_IMAGES) -> ImageCollection:
    """Without files behind them: the network below looks at none."""
    images = tuple(
        SourceImage(
            name=f"{k}.png", path=Path(f"{k}.png"), width=CAMERA.width, height=CAMERA.height, camera=0, digest=str(k)
        )
        for k in range(num_images)
    )
    return ImageCollection(images=images, cameras=(CAMERA,))


def prediction_of(image: int, seed: int = 0) -> PredictedImage:
    """Cameras on a line; depth, confidence and colours as the image's number has them."""
    rng = np.random.default_rng((seed, image))
    return PredictedImage(
        image=image,
        seg_from_cam=np.column_stack([np.eye(3), [0.1 * image, 0, 0]]),
        intrinsics=CAMERA,
        maps=ImageMaps(
            depth=rng.uniform(1, 2, (HEIGHT, WIDTH)).astype(np.float32),
            confidence=rng.uniform(1, 9, (HEIGHT, WIDTH)).astype(np.float32),
            rgb=rng.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8),
        ),
    )


def unspoilt(one: PredictedImage) -> PredictedImage:
    return one


@dataclass(kw_only=True)
class CountingNetwork:
    """A predictor whose answers are known, spoilt by image number; remembers what it was asked."""

    key: object = "weights"
    spoils: dict[int, Spoil] = field(default_factory=dict)
    silent: tuple[int, ...] = ()
    unregistered: tuple[UnregisteredImage, ...] = ()
    extra: tuple[PredictedImage, ...] = ()
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    descriptors: npt.NDArray[np.float32] = field(default_factory=lambda: np.ones((NUM_IMAGES, 3), np.float32))
    asked: list[int] = field(default_factory=list)
    described: int = 0
    name: str = "counting"
    metric: bool = True

    def describe(self) -> npt.NDArray[np.float32]:
        self.described += 1
        return self.descriptors

    def predict(self, segment: Segment, stage: Stage) -> SegmentPrediction:
        self.asked.append(segment.index)
        left_out = {*self.silent, *(one.image for one in self.unregistered)}
        images = [prediction_of(image) for image in reversed(segment.images) if image not in left_out]
        stage.advance(len(segment.images))
        return SegmentPrediction(
            images=[*(self.spoils.get(one.image, unspoilt)(one) for one in images), *self.extra],
            unregistered=self.unregistered,
            method="looked",
            notes=self.notes,
            warnings=self.warnings,
        )


class Heard(QuietReporter):
    """Remembers the notes."""

    def __init__(self) -> None:
        super().__init__(sys.stderr)
        self.notes: list[str] = []

    def note(self, text: str) -> None:
        self.notes.append(text)


def start(
    folder: Path, network: CountingNetwork, *segments: Segment, collection: ImageCollection | None = None
) -> BackboneResult:
    """One start of a run that lies in ``folder``."""
    with quiet_run(folder, Heard()) as run:
        predictor: Predictor = network
        backbone: Backbone = FeedForwardBackbone(predictor, collection or photographs(), run)
        return backbone.reconstruct(segments or (WINDOW,), ORDER, with_maps=())


# ------------------------------------------------------------------------------ what comes back
def test_a_prediction_comes_back_as_one_submodel_with_its_maps(tmp_path: Path) -> None:
    result = start(tmp_path / "run", CountingNetwork(), WINDOW, LOOP)
    assert [one.segment for one in result.reconstructions] == [0, 1]
    assert all(one.metric and not one.unregistered and not one.warnings for one in result.reconstructions)
    assert (result.matches, result.rejected, len(result.dense)) == (None, (), 2)
    for segment, submodel, maps in zip((WINDOW, LOOP), result.submodels, result.dense, strict=True):
        assert submodel.images == segment.images
        assert (submodel.method, submodel.tracks) == ("looked", None)
        assert len(maps) == 4
        for k, image in enumerate(submodel.images):
            said = prediction_of(image)
            np.testing.assert_array_equal(submodel.seg_from_cam[k], said.seg_from_cam)
            assert submodel.intrinsics[k] == CAMERA
            np.testing.assert_array_equal(maps.depth(k), said.maps.depth)
            np.testing.assert_allclose(maps.confidence(k), said.maps.confidence, rtol=1e-3)
            np.testing.assert_array_equal(maps.rgb(k), said.maps.rgb)
            points = pointmap_from_depth(said.maps.depth, CAMERA.resized(WIDTH, HEIGHT), said.seg_from_cam)
            np.testing.assert_array_equal(maps.pointmap_seg(k), points)


def test_notes_are_told_and_stand_among_the_attempts(tmp_path: Path) -> None:
    heard = Heard()
    with quiet_run(tmp_path / "run", heard) as run:
        network = CountingNetwork(notes=("half the keyframes",))
        result = FeedForwardBackbone(network, photographs(), run).reconstruct([WINDOW], ORDER, with_maps=())
    assert heard.notes == ["segment 0: half the keyframes"]
    assert result.reconstructions[0].attempts == ("looked", "half the keyframes")


# ------------------------------------------------------------------------------ a second start
def test_a_second_start_predicts_nothing_and_gives_the_same(tmp_path: Path) -> None:
    first, second = CountingNetwork(warnings=("dark",)), CountingNetwork()
    before = start(tmp_path / "run", first, WINDOW, LOOP)
    after = start(tmp_path / "run", second, WINDOW, LOOP)
    assert (first.asked, second.asked) == ([0, 1], [])
    assert before.dense_key == after.dense_key
    assert after.reconstructions[0].warnings == ("dark",)
    for one, other in zip(before.submodels, after.submodels, strict=True):
        np.testing.assert_array_equal(one.seg_from_cam, other.seg_from_cam)
        assert (one.images, one.intrinsics, one.method) == (other.images, other.intrinsics, other.method)


def test_a_run_goes_on_where_it_was_stopped(tmp_path: Path) -> None:
    class FullCard(CountingNetwork):
        def predict(self, segment: Segment, stage: Stage) -> SegmentPrediction:
            if segment.index == 1:
                raise ReconstructionError("segment 1 does not fit")
            return super().predict(segment, stage)

    with pytest.raises(ReconstructionError, match="does not fit"):
        start(tmp_path / "run", FullCard(), WINDOW, LOOP)
    network = CountingNetwork()
    assert len(start(tmp_path / "run", network, WINDOW, LOOP).submodels) == 2
    assert network.asked == [1]


@pytest.mark.parametrize("change", ["weights", "photograph", "camera", "window"])
def test_what_the_prediction_depends_on_redoes_it(tmp_path: Path, change: str) -> None:
    before = start(tmp_path / "run", CountingNetwork(), WINDOW, LOOP)
    collection = photographs()
    network, window = CountingNetwork(), WINDOW
    match change:
        case "weights":
            network.key = "other weights"
        case "photograph":  # of the window alone
            images = [replace(one, digest="new") if k == 2 else one for k, one in enumerate(collection.images)]
            collection = replace(collection, images=tuple(images))
        case "camera":
            collection = replace(collection, cameras=(pinhole(CAMERA.width, CAMERA.height, 131),))
        case "window":
            window = replace(WINDOW, images=(0, 1, 2))
    after = start(tmp_path / "run", network, window, LOOP, collection=collection)
    assert network.asked == ([0, 1] if change in ("weights", "camera") else [0])
    assert before.dense_key != after.dense_key


def test_descriptors_are_made_once_and_have_unit_length(tmp_path: Path) -> None:
    rows = np.array([[3, 4], [0, 0], [np.nan, 1], [np.inf, 1], [-2, 0], [0, 1e-12]], np.float32)
    expected = np.array([[0.6, 0.8], [0, 0], [0, 0], [0, 0], [-1, 0], [0, 1]])
    network = CountingNetwork(descriptors=rows)
    for _ in range(2):
        with quiet_run(tmp_path / "run") as run:
            made = FeedForwardBackbone(network, photographs(), run).describe()
        np.testing.assert_allclose(made, expected, atol=1e-6)
        assert made.dtype == np.float32
    assert network.described == 1
    network.key = "other weights"
    with quiet_run(tmp_path / "run") as run:
        FeedForwardBackbone(network, photographs(), run).describe()
        assert network.described == 2
        network.key, network.descriptors = "too few", rows[:4]
        with pytest.raises(ValueError, match=r"descriptors are \(4, 2\), needed \(6, D\)"):
            FeedForwardBackbone(network, photographs(), run).describe()


# ------------------------------------------------------------------------------ bad predictions
COLOURS_FROM_0_TO_1: Any = np.ones((HEIGHT, WIDTH, 3))


def with_pose(change: Callable[[FloatArray], FloatArray]) -> Spoil:
    return lambda one: replace(one, seg_from_cam=change(one.seg_from_cam))


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (with_pose(lambda pose: pose * np.nan), "pose is not finite"),
        (with_pose(lambda pose: np.where(pose == 0, np.inf, pose)), "pose is not finite"),
        (with_pose(lambda pose: pose[:, :3]), "pose is not finite"),
        (with_pose(lambda pose: pose * 1.01), "pose is no rotation"),
        (with_pose(lambda pose: pose * [1, 1, -1, 1]), "pose is no rotation"),
        (lambda one: replace(one, intrinsics=pinhole(CAMERA.width, CAMERA.height, -3)), "focal length is -3.0 px"),
    ],
)
def test_a_camera_that_is_none_costs_its_image_only(tmp_path: Path, spoil: Spoil, reason: str) -> None:
    result = start(tmp_path / "run", CountingNetwork(spoils={2: spoil}))
    (reconstruction,) = result.reconstructions
    assert reconstruction.submodels[0].images == (0, 1, 3)
    assert [one.image for one in reconstruction.unregistered] == [2]
    assert reason in reconstruction.unregistered[0].reason
    np.testing.assert_array_equal(result.dense[0].depth(2), prediction_of(3).maps.depth)


def test_an_image_of_which_nothing_is_said_is_unregistered(tmp_path: Path) -> None:
    network = CountingNetwork(silent=(1,), unregistered=(UnregisteredImage(image=3, reason="too dark"),))
    (reconstruction,) = start(tmp_path / "run", network).reconstructions
    assert reconstruction.submodels[0].images == (0, 2)
    assert {one.image: one.reason for one in reconstruction.unregistered} == {
        3: "too dark",
        1: "the network said nothing of it",
    }


@pytest.mark.parametrize("left", [1, 0])
def test_fewer_than_two_cameras_give_no_submodel(tmp_path: Path, left: int) -> None:
    spoils = {image: with_pose(lambda pose: pose * np.nan) for image in WINDOW.images[left:]}
    result = start(tmp_path / "run", CountingNetwork(spoils=spoils, warnings=("dark",)))
    (reconstruction,) = result.reconstructions
    assert (result.submodels, result.dense, reconstruction.warnings) == ((), (), ())
    assert sorted(one.image for one in reconstruction.unregistered) == list(WINDOW.images)
    alone = [one for one in reconstruction.unregistered if "only 1 image" in one.reason]
    assert [one.image for one in alone] == ([0] if left else [])
    assert start(tmp_path / "run", CountingNetwork()).submodels == ()


def test_depth_that_is_none_is_stored_as_zero_and_confidence_in_range(tmp_path: Path) -> None:
    def holes(one: PredictedImage) -> PredictedImage:
        depth, confidence = one.maps.depth.copy(), one.maps.confidence.copy()
        depth[0, :4] = np.nan, np.inf, -np.inf, -1
        confidence[1, :4] = np.nan, np.inf, 0.5, 1e9
        return replace(one, maps=replace(one.maps, depth=depth, confidence=confidence))

    maps = start(tmp_path / "run", CountingNetwork(spoils={1: holes})).dense[0]
    depth, confidence, said = maps.depth(1), maps.confidence(1), prediction_of(1).maps
    np.testing.assert_array_equal(depth[0, :4], 0)
    np.testing.assert_array_equal(depth[0, 4:], said.depth[0, 4:])
    np.testing.assert_array_equal(depth[1, :4] > 0, [False, False, True, True])
    np.testing.assert_array_equal(confidence[0, :4], 1)
    np.testing.assert_allclose(confidence[1, :4], [1, 1, 1, 6e4], rtol=1e-3)
    assert np.isnan(maps.pointmap_seg(1)[0, :4]).all()
    assert np.isfinite(maps.pointmap_seg(1)[2:]).all()


@pytest.mark.parametrize(
    ("network", "message"),
    [
        (CountingNetwork(extra=(prediction_of(5),)), r"segment 0: images \[5\] come twice or are not of the segment"),
        (CountingNetwork(extra=(prediction_of(2),)), r"images \[2\] come twice"),
        (
            CountingNetwork(spoils={1: lambda one: replace(one, intrinsics=CAMERA.resized(WIDTH, HEIGHT))}),
            "1.png: intrinsics are for 40x30 px, needed for the original image of 160x120 px",
        ),
        (
            CountingNetwork(spoils={1: lambda one: replace(one, maps=replace(one.maps, depth=one.maps.depth[1:]))}),
            r"1.png: depth, confidence and rgb are \(29, 40\), \(30, 40\) and \(30, 40, 3\) uint8",
        ),
        (
            CountingNetwork(spoils={1: lambda one: replace(one, maps=replace(one.maps, rgb=COLOURS_FROM_0_TO_1))}),
            r"\(30, 40, 3\) float64, needed",
        ),
    ],
)
def test_mistakes_of_an_adapter_are_named_and_not_kept(tmp_path: Path, network: CountingNetwork, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        start(tmp_path / "run", network)
    assert start(tmp_path / "run", CountingNetwork()).submodels[0].images == WINDOW.images


# ------------------------------------------------------------------------------ fingerprints
def test_other_weights_have_another_fingerprint(tmp_path: Path) -> None:
    weights = np.random.default_rng(0).normal(size=400_000).astype(np.float32)
    path = tmp_path / "net.pth"
    path.write_bytes(weights.tobytes())
    first = fingerprint_of(path)
    (tmp_path / "copy.pth").write_bytes(weights.tobytes())
    assert fingerprint_of(tmp_path / "copy.pth") == first
    path.write_bytes((weights * np.float32(1.001)).tobytes())
    assert fingerprint_of(path) != first
    path.write_bytes(weights[:-1].tobytes())
    assert fingerprint_of(path) != first
    path.write_bytes(b"")
    assert fingerprint_of(path) != first
    with pytest.raises(CheckpointError, match=r"gone\.pth: cannot be read: No such file"):
        fingerprint_of(tmp_path / "gone.pth")


# ------------------------------------------------------------------------------ a whole run
ROOM_IMAGES = 36
CONFIG = RunConfig(
    backbone="room",
    segmentation=SegmentationConfig(segment_length=8, overlap=4),
    # The room is exact; features of images of 80 x 60 pixels would only add their own noise.
    refinement=RefinementConfig(refine=False),
    output=OutputConfig(trainer=False, dense=False, report=False),
)
ROOM_PACKAGE = """
from dataclasses import dataclass
from helpers.room_network import RoomPredictor
from smust3r_colmap.backbones.base import BackbonePlugin
from smust3r_colmap.backbones.feed_forward import FeedForwardBackbone

@dataclass(frozen=True)
class Options:
    warnings: str = ""

def make(context, options):
    predictor = RoomPredictor(context.collection, warnings=options.warnings)
    return FeedForwardBackbone(predictor, context.collection, context.run)

plugin = BackbonePlugin(make=make, options=Options)
"""


@pytest.fixture(scope="module")
def photographed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("room")
    write_demo(folder, num_images=ROOM_IMAGES, width=80, height=60)
    return folder


@pytest.fixture
def room(photographed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The demo's photographs, and the backbone ``room`` on the path."""
    site = tmp_path / "site"
    install_package(site, "room-backbone", "[smust3r_colmap.backbones]\nroom = room_backbone:plugin\n")
    (site / "room_backbone.py").write_text(ROOM_PACKAGE, encoding="utf-8")
    monkeypatch.syspath_prepend(str(site))
    return photographed


def run(room: Path, output: Path, config: RunConfig = CONFIG) -> RunSummary:
    return reconstruct(room / "images", output, config, reporter=QuietReporter(sys.stderr))


@pytest.mark.slow
def test_a_whole_run_closes_its_loop_and_goes_on_for_nothing(room: Path, tmp_path: Path) -> None:
    summary = run(room, tmp_path / "out")
    assert (summary.exit_code, summary.weak_reasons, summary.metric) == (0, (), True)
    assert [one.kind for one in summary.segments] == ["window"] * 8 + ["loop"]
    assert [one.accepted for one in summary.loops] == [True]
    assert (tmp_path / "out" / "work" / "segments" / "0008" / "room" / "maps.safetensors").is_file()
    model = read_model_poses(tmp_path / "out" / "sparse" / "0")
    assert len(model) == ROOM_IMAGES
    assert compare_trajectories(model, read_poses_txt(room / "poses.txt")).position_rmse_percent < 0.05
    again = run(room, tmp_path / "out")
    assert [one.reused for one in again.stages if one.name == "room"] == [True]


@pytest.mark.slow
def test_doubts_make_a_run_weak_and_leave_its_model(room: Path, tmp_path: Path) -> None:
    summary = run(room, tmp_path / "out", replace(CONFIG, backbone_options="warnings=all is fog"))
    assert summary.exit_code == 3
    assert summary.weak_reasons == (
        "the geometry of 9 of 9 segments should not be trusted, such as segment 0: all is fog",
    )
    assert len(read_model_poses(tmp_path / "out" / "sparse" / "0")) == ROOM_IMAGES
