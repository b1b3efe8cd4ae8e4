"""The adapter for VGGT, held to the truth by a stand-in of the package's interface that knows the demo room.

The stand-in tells its images apart by the grey of their middle, so that nothing of what the adapter does to
pixels is needed to know what is true of them.
"""

from __future__ import annotations

import pickle
import sys
import types
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import safetensors.torch
import torch
from helpers.room_network import context_of, demo_room, pinhole, relative_pose
from helpers.runs import run_in
from PIL import Image
from scipy.spatial.transform import Rotation

from smust3r_colmap.backbones.feed_forward import FeedForwardBackbone
from smust3r_colmap.backbones.registry import make_backbone
from smust3r_colmap.backbones.vggt import Crop, Device, VggtPredictor
from smust3r_colmap.config import LoopConfig, OutputConfig, RefinementConfig, RunConfig, SegmentationConfig
from smust3r_colmap.errors import CheckpointError, ConfigError, MissingDependencyError, ReconstructionError
from smust3r_colmap.evaluation.trajectory import compare_trajectories
from smust3r_colmap.execution.progress import QuietReporter
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.importers.images import load_rgb
from smust3r_colmap.importers.model_poses import read_model_poses
from smust3r_colmap.pipeline import reconstruct
from smust3r_colmap.products import ImageCollection, Segment, SourceImage
from smust3r_colmap.segmentation.view_graph import ViewGraph
from smust3r_colmap.storage.run_directory import RunDirectory

NUM_IMAGES = 12
ORDER = ViewGraph.chain(5)
GREY_STEP = 20
UNIT_M = 0.37
"""Length of the stand-in's unit."""
SPECIAL_TOKENS = 5
SIZE = 140

CAMERAS = {
    "landscape": pinhole(160, 120, 130.0),
    "portrait": pinhole(120, 160, 130.0),
    "square": pinhole(100, 100, 90.0),
    "panorama": pinhole(300, 60, 160.0),
    "odd": pinhole(333, 217, 250.0),
    "high": pinhole(100, 390, 300.0),
}


# ------------------------------------------------------------------------------ the stand-in
class Room:
    """What is true, and how the stand-in is to misbehave."""

    def __init__(self) -> None:
        self.world_from_cam = demo_room().camera_path(NUM_IMAGES)
        self.cameras = [CAMERAS["landscape"]] * NUM_IMAGES
        self.confidence = 4.0
        self.lost: tuple[int, ...] = ()
        self.too_large = False
        self.inputs: list[torch.Tensor] = []


def camera_in_network(camera: Intrinsics, width: int, height: int) -> Intrinsics:
    """The true camera of what a network of this input sees: documented as width 518, height a multiple of 14."""
    full_height = 14 * round(camera.height * width / camera.width / 14)
    fx, fy, _, _ = camera.params
    params = (fx * width / camera.width, fy * full_height / camera.height, width / 2, height / 2)
    return Intrinsics(model="PINHOLE", width=width, height=height, params=params)


class StandIn(torch.nn.Module):
    """``vggt.models.vggt.VGGT`` as its README uses it."""

    room: Room

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(3))

    def aggregator(self, images: torch.Tensor) -> tuple[list[torch.Tensor | None], int]:
        batch, _, channels, height, width = images.shape
        assert (batch, channels, images.dtype) == (1, 3, torch.float32)
        assert height % 14 == 0 and width % 14 == 0 and height <= width
        assert float(images.min()) >= 0 and float(images.max()) <= 1
        if self.room.too_large:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory")
        self.room.inputs.append(images)
        grey = images[0, :, :, height // 2, width // 2]
        assert torch.allclose(grey, grey[:, :1], atol=1e-6)
        numbers = torch.round(grey[:, 0] * 255 / GREY_STEP)
        patches = height // 14 * (width // 14)
        tokens = torch.full((1, len(numbers), SPECIAL_TOKENS + patches, 4), 7.0)
        tokens[0, :, SPECIAL_TOKENS:] = torch.stack(
            [numbers, torch.full_like(numbers, height), torch.full_like(numbers, width), torch.ones_like(numbers)], -1
        )[:, None]
        return [None, tokens.double()], SPECIAL_TOKENS  # of another type, as blocks in half precision give

    def camera_head(self, layers: list[torch.Tensor | None]) -> list[torch.Tensor]:
        numbers, height, width = self._seen(layers)
        codes = []
        for k in numbers:
            pose = relative_pose(self.room.world_from_cam, k, numbers[0], UNIT_M)  # first_from_cam
            rotation = pose[:, :3].T
            camera = camera_in_network(self.room.cameras[k], width, height)
            quat_xyzw = Rotation.from_matrix(rotation).as_quat()
            fov = [2 * np.arctan(height / 2 / camera.params[1]), 2 * np.arctan(width / 2 / camera.params[0])]
            code = np.concatenate([-rotation @ pose[:, 3], quat_xyzw, fov])
            codes.append(code * np.nan if k in self.room.lost else code)
        refined = torch.tensor(np.array(codes), dtype=torch.float32)[None]
        return [torch.zeros_like(refined), refined]

    def depth_head(
        self, layers: list[torch.Tensor | None], images: torch.Tensor, first_patch: int
    ) -> tuple[torch.Tensor, torch.Tensor]:
        assert first_patch == SPECIAL_TOKENS
        numbers, height, width = self._seen(layers)
        assert images.shape == (1, len(numbers), 3, height, width)
        depth = np.array([self._depth(k, width, height) for k in numbers])
        confidence = torch.full((1, len(numbers), height, width), self.room.confidence)
        return torch.tensor(depth)[None, ..., None], confidence

    def _depth(self, k: int, width: int, height: int) -> npt.NDArray[np.float32]:
        camera = camera_in_network(self.room.cameras[k], width, height)
        _, depth_m = demo_room().render(self.room.world_from_cam[k], camera)
        return (depth_m / UNIT_M).astype(np.float32)

    def _seen(self, layers: list[torch.Tensor | None]) -> tuple[list[int], int, int]:
        last = layers[-1]
        assert last is not None and last.dtype == torch.float32
        first = last[0, :, SPECIAL_TOKENS]
        return [int(number) for number in first[:, 0]], int(first[0, 1]), int(first[0, 2])


def decode(code: torch.Tensor, image_size_hw: tuple[int, int]) -> tuple[torch.Tensor, torch.Tensor]:
    """``vggt.utils.pose_enc.pose_encoding_to_extri_intri``: camera from world, and the camera in pixels."""
    height, width = image_size_hw
    flat = code[0].numpy().astype(np.float64)
    known = np.isfinite(flat).all(axis=1)
    extrinsics = np.full((len(flat), 3, 4), np.nan)
    extrinsics[known, :, :3] = Rotation.from_quat(flat[known, 3:7]).as_matrix()
    extrinsics[:, :, 3] = flat[:, :3]
    intrinsics = np.tile(np.eye(3), (len(flat), 1, 1))
    intrinsics[:, 1, 1] = height / 2 / np.tan(flat[:, 7] / 2)
    intrinsics[:, 0, 0] = width / 2 / np.tan(flat[:, 8] / 2)
    intrinsics[:, :2, 2] = width / 2, height / 2
    return torch.tensor(extrinsics, dtype=torch.float32)[None], torch.tensor(intrinsics, dtype=torch.float32)[None]


@pytest.fixture
def room(monkeypatch: pytest.MonkeyPatch) -> Room:
    """The package ``vggt``, installed for one test; it answers from the room."""
    modules: dict[str, Any] = {
        name: types.ModuleType(name) for name in ("vggt", "vggt.models", "vggt.models.vggt", "vggt.utils.pose_enc")
    }
    modules["vggt.utils"] = types.ModuleType("vggt.utils")
    known = Room()
    modules["vggt.models.vggt"].VGGT = type("VGGT", (StandIn,), {"room": known})
    modules["vggt.utils.pose_enc"].pose_encoding_to_extri_intri = decode
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    return known


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "model.pt"
    torch.save({"weight": torch.ones(3)}, path)
    return path


@pytest.fixture
def run(tmp_path: Path) -> Iterator[RunDirectory]:
    with RunDirectory(tmp_path / "run") as opened:
        yield opened


def photographs(folder: Path, room: Room, cameras: list[Intrinsics]) -> ImageCollection:
    """Grey images of these sizes, one camera each; their cameras are true from now on."""
    room.cameras = cameras
    folder.mkdir(exist_ok=True)
    images = []
    for k, camera in enumerate(cameras):
        path = folder / f"{k:02d}.png"
        Image.new("RGB", (camera.width, camera.height), (GREY_STEP * k,) * 3).save(path)
        images.append(
            SourceImage(name=path.name, path=path, width=camera.width, height=camera.height, camera=k, digest=str(k))
        )
    return ImageCollection(images=tuple(images), cameras=tuple(cameras))


def backbone_of(
    collection: ImageCollection, run: RunDirectory, checkpoint: Path, options: Mapping[str, str] | None = None
) -> FeedForwardBackbone:
    given = {"checkpoint": str(checkpoint), "size": str(SIZE), **(options or {})}
    text = ",".join(f"{name}={value}" for name, value in given.items())
    made = make_backbone(context_of(collection, run, backbone="vggt", options=text))
    assert isinstance(made, FeedForwardBackbone)
    return made


# ------------------------------------------------------------------------------ geometry
@pytest.mark.parametrize("names", [(name,) * 3 for name in CAMERAS] + [("landscape", "portrait", "panorama")])
def test_cameras_and_depth_come_through_as_they_are(
    room: Room, run: RunDirectory, checkpoint: Path, tmp_path: Path, names: tuple[str, ...]
) -> None:
    cameras = [CAMERAS[name] for name in names]
    collection = photographs(tmp_path / "images", room, cameras)
    backbone = backbone_of(collection, run, checkpoint)
    assert (backbone.name, backbone.metric, backbone.has_tracks) == ("vggt", False, False)
    result = backbone.reconstruct([Segment(index=0, images=(0, 1, 2))], ORDER, with_maps=[0])

    (submodel,), (maps,) = result.submodels, result.dense
    assert submodel.images == (0, 1, 2)
    for k, camera in enumerate(cameras):
        truth = relative_pose(room.world_from_cam, k, 0, UNIT_M)
        np.testing.assert_allclose(submodel.seg_from_cam[k], truth, atol=2e-6)
        assert (submodel.intrinsics[k].width, submodel.intrinsics[k].height) == (camera.width, camera.height)
        np.testing.assert_allclose(submodel.intrinsics[k].params, camera.params, rtol=1e-5)
        expected, seen = true_depth(room, k, camera, maps.depth(k).shape[0])
        np.testing.assert_array_equal(maps.depth(k) > 0, seen)
        np.testing.assert_allclose(maps.depth(k)[seen], expected[seen], rtol=2e-4)
        np.testing.assert_array_equal(maps.confidence(k), np.where(seen, 4, 1))
        np.testing.assert_array_equal(maps.rgb(k), GREY_STEP * k)


def true_depth(
    room: Room, k: int, camera: Intrinsics, full_height: int
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Of the whole original image, resized to the size of its map, and which rows the network sees."""
    assert abs(full_height - camera.height * SIZE / camera.width) <= 7, "the nearest multiple of a patch"
    assert full_height % 14 == 0
    _, depth_m = demo_room().render(room.world_from_cam[k], camera.resized(SIZE, full_height))
    rows = np.abs(np.arange(full_height) + 0.5 - full_height / 2) < SIZE / 2
    return depth_m / np.float32(UNIT_M), np.repeat(rows[:, None], SIZE, axis=1)


def test_at_the_trained_size_a_photograph_is_518_wide(
    room: Room, run: RunDirectory, checkpoint: Path, tmp_path: Path
) -> None:
    collection = photographs(tmp_path / "images", room, [CAMERAS["landscape"]] * 2)
    predictor = backbone_of(collection, run, checkpoint, {"size": "518"}).predictor
    backbone = FeedForwardBackbone(predictor, collection, run_in(run))
    maps = backbone.reconstruct([Segment(index=0, images=(0, 1))], ORDER, with_maps=[0]).dense[0]
    assert room.inputs[0].shape == (1, 2, 3, 392, 518)
    assert maps.depth(1).shape == (392, 518)


@pytest.mark.parametrize(
    ("width", "height", "crop"),
    [
        (640, 480, Crop(width=518, full_height=392, top=0, height=392)),
        (480, 640, Crop(width=518, full_height=686, top=84, height=518)),
        (518, 518, Crop(width=518, full_height=518, top=0, height=518)),
        (4000, 40, Crop(width=518, full_height=14, top=0, height=14)),
    ],
)
def test_the_crop_is_that_of_the_package(width: int, height: int, crop: Crop) -> None:
    image = SourceImage(name="a", path=Path("a"), width=width, height=height, camera=0, digest="")
    assert Crop.of(image, 518) == crop


def test_the_network_sees_the_middle_of_the_image_with_white_around(
    room: Room, run: RunDirectory, checkpoint: Path, tmp_path: Path
) -> None:
    collection = photographs(tmp_path / "images", room, [CAMERAS["portrait"], CAMERAS["panorama"]])
    rows, columns = np.mgrid[:160, :120]
    gradient = np.stack([columns, rows, np.full_like(rows, 40)], axis=-1).astype(np.uint8)
    gradient[60:100, 40:80] = 0  # the middle, by which the stand-in knows it
    Image.fromarray(gradient).save(collection.images[0].path)
    backbone_of(collection, run, checkpoint).reconstruct([Segment(index=0, images=(0, 1))], ORDER, with_maps=[])
    (seen,) = room.inputs
    assert seen.shape == (1, 2, 3, SIZE, SIZE)
    portrait, panorama = seen[0].numpy() * 255
    # 120 x 160 becomes 140 x 182, of which the rows from 21 to 161 are seen.
    expected_x = (np.arange(SIZE) + 0.5) * 120 / 140 - 0.5
    expected_y = (np.arange(SIZE) + 21.5) * 160 / 182 - 0.5
    np.testing.assert_allclose(portrait[0, 3, 2:-2], expected_x[2:-2], atol=0.75)
    np.testing.assert_allclose(portrait[1, 2:20, 3], expected_y[2:20], atol=0.75)
    np.testing.assert_allclose(portrait[1, -20:-2, 3], expected_y[-20:-2], atol=0.75)
    # 300 x 60 becomes 140 x 28, in the middle of white.
    np.testing.assert_array_equal(panorama[:, 56:84], GREY_STEP)
    np.testing.assert_array_equal(panorama[:, :56], 255)
    np.testing.assert_array_equal(panorama[:, 84:], 255)


@pytest.mark.slow
def test_a_whole_run_gives_the_true_trajectory(room: Room, checkpoint: Path, tmp_path: Path) -> None:
    photographs(tmp_path / "images", room, [CAMERAS["portrait"]] * NUM_IMAGES)
    config = RunConfig(
        backbone="vggt",
        backbone_options=f"checkpoint={checkpoint},size={SIZE}",
        segmentation=SegmentationConfig(segment_length=6, overlap=3),
        loop_closing=LoopConfig(loop_closure=False),
        refinement=RefinementConfig(refine=False),  # the photographs of this room have nothing for SIFT
        output=OutputConfig(trainer=False, dense=False, report=False),
    )
    summary = reconstruct(tmp_path / "images", tmp_path / "out", config, reporter=QuietReporter(sys.stderr))
    assert (summary.exit_code, summary.weak_reasons, summary.metric) == (0, (), False)
    assert summary.segments[0].method == "VGGT at 140 px, 6 images at once"
    truth = {f"{k:02d}.png": pose for k, pose in enumerate(room.world_from_cam)}
    found = compare_trajectories(read_model_poses(tmp_path / "out" / "sparse" / "0"), truth)
    assert found.num_compared == NUM_IMAGES
    assert found.position_rmse_percent < 0.05


# ------------------------------------------------------------------------------ what goes wrong
def test_a_network_that_is_sure_of_nothing_is_doubted(
    room: Room, run: RunDirectory, checkpoint: Path, tmp_path: Path
) -> None:
    collection = photographs(tmp_path / "images", room, [CAMERAS["landscape"]] * 3)
    room.confidence = 1.02
    result = backbone_of(collection, run, checkpoint).reconstruct(
        [Segment(index=0, images=(0, 1, 2))], ORDER, with_maps=[]
    )
    assert result.reconstructions[0].warnings == ("VGGT is sure of 0.0 % of the pixels only, 5 % are needed",)
    assert len(result.submodels) == 1


def test_an_image_without_camera_or_file_is_left_out(
    room: Room, run: RunDirectory, checkpoint: Path, tmp_path: Path
) -> None:
    collection = photographs(tmp_path / "images", room, [CAMERAS["landscape"]] * 5)
    room.lost = (2,)
    collection.images[3].path.unlink()
    result = backbone_of(collection, run, checkpoint).reconstruct(
        [Segment(index=0, images=tuple(range(5)))], ORDER, with_maps=[]
    )
    (reconstruction,) = result.reconstructions
    assert reconstruction.submodels[0].images == (0, 1, 4)
    reasons = {one.image: one.reason for one in reconstruction.unregistered}
    assert "camera is not finite" in reasons[2]
    assert "03.png: cannot be read" in reasons[3]


def test_descriptors_are_the_mean_of_the_patch_tokens(
    room: Room, run: RunDirectory, checkpoint: Path, tmp_path: Path
) -> None:
    collection = photographs(tmp_path / "images", room, [CAMERAS["landscape"]] * 4)
    collection.images[2].path.unlink()
    made = backbone_of(collection, run, checkpoint).describe()
    expected = np.array([[k, 112, SIZE, 1] for k in range(4)], np.float64)
    expected[2] = 0
    lengths = np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(made, expected / np.maximum(lengths, 1), atol=2e-3)
    assert [one.shape[1] for one in room.inputs] == [1, 1, 1], "each image alone"


def test_a_segment_too_large_for_the_card_says_the_way_out_and_is_not_kept(
    room: Room, run: RunDirectory, checkpoint: Path, tmp_path: Path
) -> None:
    collection = photographs(tmp_path / "images", room, [CAMERAS["landscape"]] * 2)
    backbone = backbone_of(collection, run, checkpoint)
    segment = Segment(index=3, images=(0, 1))
    room.too_large = True
    with pytest.raises(ReconstructionError, match=r"segment 3: 2 images of 140x112 px do not fit.*--segment-length"):
        backbone.reconstruct([segment], ORDER, with_maps=[])
    room.too_large = False
    assert len(backbone.reconstruct([segment], ORDER, with_maps=[]).submodels) == 1


# ------------------------------------------------------------------------------ options and weights
def test_a_calibration_that_is_not_used_is_warned_about(
    run: RunDirectory, checkpoint: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for calibrated in (False, True):
        backbone_of(ImageCollection(images=(), cameras=(), calibrated=calibrated), run, checkpoint)
        assert ("the given calibration is not used" in capsys.readouterr().err) == calibrated


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"checkpoint": ""}, CheckpointError, r"needs --backbone-options checkpoint=FILE, the model\.pt or"),
        ({"checkpoint": "gone.pt"}, CheckpointError, r"gone\.pt: cannot be read: No such file"),
        ({"size": "500"}, ConfigError, "size=500: needed a multiple of 14 px, by default 518"),
        ({"size": "-14"}, ConfigError, "size=-14: needed a multiple"),
        ({"size": "large"}, ConfigError, "size=large: needed a whole number"),
        ({"device": "tpu"}, ConfigError, "device=tpu: needed one of auto, cpu, cuda"),
        (
            {"weights": "x.pt"},
            ConfigError,
            "options weights: the backbone vggt knows checkpoint, device, size",
        ),
    ],
)
def test_options_that_make_no_sense_are_refused(
    run: RunDirectory, checkpoint: Path, options: dict[str, str], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        backbone_of(ImageCollection(images=(), cameras=()), run, checkpoint, options)


def predicted(collection: ImageCollection, checkpoint: Path, device: Device = "auto") -> None:
    reporter = QuietReporter(sys.stderr)
    VggtPredictor(collection, checkpoint, width=SIZE, device=device, reporter=reporter).describe()


def test_without_the_package_it_is_said_how_to_install_it(
    room: Room, checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "vggt.models.vggt", None)
    collection = photographs(tmp_path / "images", room, [CAMERAS["square"]])
    with pytest.raises(MissingDependencyError, match=r"vggt cannot be imported.*pip install git\+https://github\.com/"):
        predicted(collection, checkpoint)


def test_cuda_is_refused_where_there_is_none(room: Room, checkpoint: Path, tmp_path: Path) -> None:
    collection = photographs(tmp_path / "images", room, [CAMERAS["square"]])
    with pytest.raises(ConfigError, match="device=cuda: torch finds no CUDA card here; give auto or cpu"):
        predicted(collection, checkpoint, device="cuda")


class Hostile:
    """Writes a file when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        return Path.touch, (self.mark,)


def test_bad_checkpoints_are_refused_and_nothing_in_them_runs(room: Room, tmp_path: Path) -> None:
    collection = photographs(tmp_path / "images", room, [CAMERAS["square"]])
    path = tmp_path / "model.pt"

    torch.save({"weight": torch.ones(4), "more": torch.ones(1)}, path)
    with pytest.raises(CheckpointError, match=r"model\.pt: is no checkpoint of VGGT: Error.*more.*size mismatch"):
        predicted(collection, path)
    torch.save([torch.ones(3)], path)
    with pytest.raises(CheckpointError, match="holds a list, needed are tensors by name"):
        predicted(collection, path)
    torch.save({"weight": torch.ones(3)}, path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(CheckpointError, match="cannot be read as weights"):
        predicted(collection, path)
    for content in (b"", b"text", b"<html>404</html>"):
        path.write_bytes(content)
        with pytest.raises(CheckpointError, match="cannot be read as weights"):
            predicted(collection, path)
    mark = tmp_path / "hacked"
    torch.save({"weight": Hostile(mark)}, path)
    with pytest.raises(CheckpointError, match="cannot be read as weights"):
        predicted(collection, path)
    path.write_bytes(pickle.dumps(Hostile(mark)))
    with pytest.raises(CheckpointError, match="cannot be read as weights"):
        predicted(collection, path)
    assert not mark.exists()
    (tmp_path / "model.safetensors").write_bytes(b"12345678{}")
    with pytest.raises(CheckpointError, match=r"model\.safetensors: cannot be read as weights"):
        predicted(collection, tmp_path / "model.safetensors")


def test_safetensors_are_as_good(room: Room, tmp_path: Path) -> None:
    collection = photographs(tmp_path / "images", room, [CAMERAS["square"]])
    safetensors.torch.save_file({"weight": torch.ones(3)}, tmp_path / "model.safetensors")
    predicted(collection, tmp_path / "model.safetensors")
    assert len(room.inputs) == 1
    assert load_rgb(collection.images[0]).shape == (100, 100, 3)
