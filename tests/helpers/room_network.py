"""The demo room as the perfect network would see it: whose photograph an array is, and what is true of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from helpers.runs import run_in
from smust3r_colmap.backbones.base import BackboneContext
from smust3r_colmap.backbones.feed_forward import PredictedImage, SegmentPrediction
from smust3r_colmap.config import RunConfig
from smust3r_colmap.execution.progress import Stage
from smust3r_colmap.geometry.arrays import Float32Array, FloatArray
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.importers.images import load_rgb
from smust3r_colmap.products import ImageCollection, Segment
from smust3r_colmap.storage.dense_maps import ImageMaps
from smust3r_colmap.storage.run_directory import RunDirectory
from smust3r_colmap.synthetic.room import DemoScene, demo_intrinsics

_THUMBNAIL = (32, 24)


@dataclass(frozen=True, kw_only=True, eq=False)
class NetworkAnswer:
    """What a typical network says of an image, in its own pixels and in the frame of the first image it was shown."""

    world_from_cam: FloatArray
    focal_px: float
    depth: Float32Array
    confidence: Float32Array


@cache
def demo_room() -> DemoScene:
    """Painted once, for that takes a second."""
    return DemoScene()


class RoomNetwork:
    """Knows the room of ``write_demo`` and answers with the truth, in a unit of its own.

    Args:
        num_images: of the round.
        unit_m: length of its unit of length.
    """

    def __init__(self, num_images: int, unit_m: float) -> None:
        self.unit_m = unit_m
        self.scene = demo_room()
        self.world_from_cam = self.scene.camera_path(num_images)
        small = demo_intrinsics(*_THUMBNAIL)
        self.thumbnails = np.array([self.scene.render(pose, small)[0] for pose in self.world_from_cam], np.float32)

    def which(self, rgb: npt.NDArray[np.uint8]) -> int:
        """The photograph that looks most like this one."""
        small = cv2.resize(rgb, _THUMBNAIL, interpolation=cv2.INTER_AREA)
        return int(np.abs(self.thumbnails - small).mean(axis=(1, 2, 3)).argmin())

    def embed(self, rgb: npt.NDArray[np.uint8]) -> Float32Array:
        """(D,) of any length."""
        small = cv2.resize(rgb, _THUMBNAIL, interpolation=cv2.INTER_AREA).astype(np.float32)
        vector: Float32Array = (small - small.mean()).ravel()
        return vector

    def reconstruct(self, images: list[npt.NDArray[np.uint8]]) -> list[NetworkAnswer]:
        """All images at once."""
        numbers = [self.which(rgb) for rgb in images]
        return [self._answer(k, numbers[0], rgb.shape) for k, rgb in zip(numbers, images, strict=True)]

    def _answer(self, k: int, first: int, shape: tuple[int, ...]) -> NetworkAnswer:
        height, width = shape[:2]
        intrinsics = demo_intrinsics(width, height)
        _, depth_m = self.scene.render(self.world_from_cam[k], intrinsics)
        return NetworkAnswer(
            world_from_cam=relative_pose(self.world_from_cam, k, first, self.unit_m),
            focal_px=intrinsics.focal_px,
            depth=(depth_m / self.unit_m).astype(np.float32),
            confidence=np.full(depth_m.shape, 5, np.float32),
        )


def relative_pose(world_from_cam: FloatArray, k: int, first: int, unit_m: float) -> FloatArray:
    """(3, 4) ``first_from_cam`` of image k, in units of ``unit_m`` metres."""
    to_first = world_from_cam[first, :, :3].T
    rotation = to_first @ world_from_cam[k, :, :3]
    centre = to_first @ (world_from_cam[k, :, 3] - world_from_cam[first, :, 3]) / unit_m
    pose: FloatArray = np.column_stack([rotation, centre])
    return pose


def context_of(
    collection: ImageCollection,
    run: RunDirectory,
    *,
    backbone: str = "classical",
    options: str = "",
) -> BackboneContext:
    """What the pipeline gives a backbone, for a quiet run."""
    return BackboneContext(
        collection=collection,
        config=RunConfig(backbone=backbone, backbone_options=options),
        run=run_in(run),
    )


def install_package(folder: Path, name: str, entry_points: str) -> None:
    """Lay the metadata of a package of this name into a folder, which is then put on the path."""
    metadata = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n", encoding="utf-8")
    (metadata / "entry_points.txt").write_text(entry_points, encoding="utf-8")


def pinhole(width: int, height: int, focal_px: float) -> Intrinsics:
    """A camera whose axis meets the middle of the image."""
    return Intrinsics(model="PINHOLE", width=width, height=height, params=(focal_px, focal_px, width / 2, height / 2))


class RoomPredictor:
    """``RoomNetwork`` as a predictor.

    Args:
        collection: the photographs of ``write_demo``, all of them.
        warnings: of every segment, or empty.
    """

    name = "room"
    metric = True

    def __init__(self, collection: ImageCollection, *, warnings: str) -> None:
        self.collection = collection
        self.warnings = warnings
        self.key = warnings
        self.network = RoomNetwork(len(collection), unit_m=1)

    def describe(self) -> Float32Array:
        return np.array([self.network.embed(self.pixels(k)) for k in range(len(self.collection))])

    def pixels(self, k: int) -> npt.NDArray[np.uint8]:
        return load_rgb(self.collection.images[k])

    def predict(self, segment: Segment, stage: Stage) -> SegmentPrediction:
        photographs = [self.pixels(k) for k in segment.images]
        images = []
        for k, rgb, answer in zip(segment.images, photographs, self.network.reconstruct(photographs), strict=True):
            image = self.collection.images[k]
            maps = ImageMaps(depth=answer.depth, confidence=answer.confidence, rgb=rgb)
            intrinsics = pinhole(image.width, image.height, answer.focal_px)
            images.append(PredictedImage(image=k, seg_from_cam=answer.world_from_cam, intrinsics=intrinsics, maps=maps))
            stage.advance()
        return SegmentPrediction(images=images, method="truth", warnings=(self.warnings,) if self.warnings else ())
