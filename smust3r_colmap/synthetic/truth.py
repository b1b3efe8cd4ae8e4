"""What is simulated from: images with exactly known cameras and depth.

``TrueScene.from_demo`` renders the demo room, ``TrueScene.from_rgbd_folder`` reads a sequence with
poses and depth maps. Nothing is rendered or read before it is asked for, and nothing twice; an
image then stays in memory, at 7 bytes a pixel. The next module to read is ``settings``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image, UnidentifiedImageError

from smust3r_colmap.errors import CollectionError, ImageError, InputError
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres, z_buffer
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.importers.images import load_rgb
from smust3r_colmap.importers.poses_txt import read_poses_txt
from smust3r_colmap.products import ImageCollection, SourceImage
from smust3r_colmap.storage.run_directory import key_of
from smust3r_colmap.synthetic.room import DemoScene, demo_intrinsics

DepthMap = npt.NDArray[np.float32]
RgbImage = npt.NDArray[np.uint8]

TYPICAL_DEPTH_IMAGES = 16
"""Images, evenly spread, whose depth tells the size of the scene."""
DEPTH_UNIT_M = 0.001
"""Of a 16-bit depth map."""
NO_DEPTH = (0, 65535)
"""Values of a 16-bit depth map that mean none; 7-Scenes has both."""
BORROWED_FROM = 2
"""Depth maps that are carried into a frame without one: the nearest in order, as a rule one on either side."""
BORROWED_DENSITY = 2
"""Points per pixel and axis when depth is carried over, so that surfaces have no holes seen from nearer."""


class Views(Protocol):
    """Where the pixels of a scene come from."""

    def depth(self, k: int) -> DepthMap:
        """(H, W) z-depth of image k, 0 where there is none."""

    def rgb(self, k: int) -> RgbImage:
        """(H, W, 3) of image k."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TrueScene:
    """Images whose cameras and depth are known.

    Args:
        names: of the N images, in order.
        world_from_cam: (N, 3, 4) rigid.
        intrinsics: of all images, at the size of the maps.
        metric: lengths are metres.
        views: depth and pixels, at the size of the intrinsics.

    Raises:
        ValueError: names repeat, or poses are not (N, 3, 4) and finite.
    """

    names: tuple[str, ...]
    world_from_cam: FloatArray
    intrinsics: Intrinsics
    metric: bool
    views: Views = field(repr=False)

    def __post_init__(self) -> None:
        n = len(self.names)
        if self.world_from_cam.shape != (n, 3, 4) or not np.isfinite(self.world_from_cam).all():
            raise ValueError(f"TrueScene: poses {self.world_from_cam.shape} of {n} images, needed ({n}, 3, 4), finite")
        if len(set(self.names)) != n:
            raise ValueError("TrueScene: two images share a name")

    def __len__(self) -> int:
        return len(self.names)

    def depth(self, k: int) -> DepthMap:
        """(H, W) float32 z-depth in the unit of the world, 0 where there is none; not to be written to."""
        return self.views.depth(k)

    def rgb(self, k: int) -> RgbImage:
        """(H, W, 3) uint8; not to be written to."""
        return self.views.rgb(k)

    @cached_property
    def typical_depth(self) -> float:
        """Median depth over images spread evenly: the length that errors of position are measured by.

        Raises:
            CollectionError: none of these images has depth.
        """
        chosen = np.unique(np.linspace(0, len(self) - 1, TYPICAL_DEPTH_IMAGES).astype(int))
        depths = np.concatenate([depth[depth > 0] for depth in (self.depth(int(k)) for k in chosen)])
        if len(depths) == 0:
            raise CollectionError(f"{len(chosen)} of {len(self)} images were looked at and none has depth")
        return float(np.median(depths))

    @cached_property
    def digest(self) -> str:
        """A hash of what tells this scene from others: names, cameras, and the pixels of the first image."""
        sample = [np.ascontiguousarray(view).tobytes().hex() for view in (self.depth(0), self.rgb(0))]
        return key_of("true scene", self.names, self.world_from_cam, self.intrinsics, self.metric, sample)

    @classmethod
    def from_demo(cls, num_images: int, height: int, width: int, seed: int = 0) -> TrueScene:
        """The demo room, once round.

        Args:
            num_images: at least 2, spread over the round.
            height, width: of the maps.
            seed: of textures and sway.

        Raises:
            ConfigError: fewer than two images.
        """
        scene = DemoScene(seed)
        world_from_cam = scene.camera_path(num_images)
        intrinsics = demo_intrinsics(width, height)
        return cls(
            names=tuple(f"{k:06d}.jpg" for k in range(num_images)),
            world_from_cam=world_from_cam,
            intrinsics=intrinsics,
            metric=True,
            views=_DemoViews(scene, world_from_cam, intrinsics),
        )

    @classmethod
    def from_rgbd_folder(cls, folder: Path, names: Sequence[str] | None = None, *, max_size: int = 128) -> TrueScene:
        """A sequence with ``images/``, ``depth/*.png``, ``poses.txt`` and ``intrinsics.txt``.

        Depth is 16 bit in millimetres, named as the image. A frame without depth of its own gets that
        of its two nearest frames in order, carried over by the known cameras; what those do not show
        stays without depth.

        Args:
            folder: as above, the poses in metres.
            names: the images to take, in this order; all with a pose when None.
            max_size: longer side of the maps, in pixels.

        Raises:
            InputError: a text file is not as above, a name has no pose or image, or there is no depth at all.
            ImageError: later, when an image or a depth map is read that does not decode.
        """
        world_from_cams = read_poses_txt(folder / "poses.txt")
        chosen = tuple(sorted(world_from_cams) if names is None else names)
        _check_folder(folder, chosen, world_from_cams)
        photographed = _read_intrinsics_txt(folder / "intrinsics.txt")
        shrink = max(1.0, max(photographed.width, photographed.height) / max_size)
        intrinsics = photographed.resized(round(photographed.width / shrink), round(photographed.height / shrink))
        return cls(
            names=chosen,
            world_from_cam=np.array([world_from_cams[name] for name in chosen]),
            intrinsics=intrinsics,
            metric=True,
            views=_RgbdViews(folder, chosen, world_from_cams, photographed, intrinsics),
        )


def collection_of(truth: TrueScene) -> ImageCollection:
    """The images of a scene as if they had been imported, with their true camera; there are no files behind it."""
    width, height = truth.intrinsics.width, truth.intrinsics.height
    images = tuple(
        SourceImage(name=name, path=Path(name), width=width, height=height, camera=0, digest=key_of(truth.digest, k))
        for k, name in enumerate(truth.names)
    )
    return ImageCollection(images=images, cameras=(truth.intrinsics,))


class _DemoViews:
    """Renders an image when it is asked for, and keeps it."""

    def __init__(self, scene: DemoScene, world_from_cam: FloatArray, intrinsics: Intrinsics) -> None:
        self._scene, self._world_from_cam, self._intrinsics = scene, world_from_cam, intrinsics
        self._seen: dict[int, tuple[RgbImage, DepthMap]] = {}

    def depth(self, k: int) -> DepthMap:
        return self._view(k)[1]

    def rgb(self, k: int) -> RgbImage:
        return self._view(k)[0]

    def _view(self, k: int) -> tuple[RgbImage, DepthMap]:
        if k not in self._seen:
            self._seen[k] = self._scene.render(self._world_from_cam[k], self._intrinsics)
        return self._seen[k]


class _RgbdViews:
    """Reads images and depth maps when they are asked for, and keeps them."""

    def __init__(
        self,
        folder: Path,
        names: tuple[str, ...],
        world_from_cams: Mapping[str, FloatArray],
        photographed: Intrinsics,
        intrinsics: Intrinsics,
    ) -> None:
        self._folder, self._names, self._world_from_cams = folder, names, world_from_cams
        self._photographed, self._intrinsics = photographed, intrinsics
        self._order = {name: place for place, name in enumerate(sorted(world_from_cams))}
        self._with_depth = [name for name in self._order if _depth_path(folder, name).is_file()]
        if not self._with_depth:
            raise InputError(f"{folder / 'depth'}: no depth map is named as an image of poses.txt")
        self._borrowed_points = lru_cache(maxsize=2 * BORROWED_FROM)(self._points_world)
        self._depths: dict[int, DepthMap] = {}
        self._rgbs: dict[int, RgbImage] = {}

    def rgb(self, k: int) -> RgbImage:
        if k not in self._rgbs:
            width, height = self._photographed.width, self._photographed.height
            path = self._folder / "images" / self._names[k]
            pixels = load_rgb(SourceImage(name=str(path), path=path, width=width, height=height, camera=0, digest=""))
            size = (self._intrinsics.width, self._intrinsics.height)
            self._rgbs[k] = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        return self._rgbs[k]

    def depth(self, k: int) -> DepthMap:
        if k not in self._depths:
            name = self._names[k]
            own = _depth_path(self._folder, name).is_file()
            self._depths[k] = self._own_depth(name, self._intrinsics) if own else self._borrowed_depth(name)
        return self._depths[k]

    def _own_depth(self, name: str, intrinsics: Intrinsics) -> DepthMap:
        """The depth map at the pixel centres of another size; depths of two surfaces are never mixed."""
        stored = _read_depth(_depth_path(self._folder, name))
        rows = ((np.arange(intrinsics.height) + 0.5) * stored.shape[0] / intrinsics.height).astype(int)
        columns = ((np.arange(intrinsics.width) + 0.5) * stored.shape[1] / intrinsics.width).astype(int)
        sampled: DepthMap = stored[np.ix_(rows, columns)]
        return sampled

    def _borrowed_depth(self, name: str) -> DepthMap:
        """Depth of the nearest frames, seen from this one; of several surfaces the first."""
        near = sorted(self._with_depth, key=lambda other: abs(self._order[other] - self._order[name]))[:BORROWED_FROM]
        points_world = np.concatenate([self._borrowed_points(other) for other in near])
        cam_from_world = invert_rigid(self._world_from_cams[name])
        points_cam = points_world @ cam_from_world[:, :3].T + cam_from_world[:, 3]
        return z_buffer(points_cam, self._intrinsics)

    def _points_world(self, name: str) -> FloatArray:
        """(P, 3) of a frame with depth, denser than the maps."""
        width, height = (BORROWED_DENSITY * n for n in (self._intrinsics.width, self._intrinsics.height))
        dense = self._photographed.resized(width, height)
        depth = self._own_depth(name, dense).ravel()
        points_cam = dense.rays_cam(pixel_centres(width, height))[depth > 0] * depth[depth > 0, None]
        pose = self._world_from_cams[name]
        points: FloatArray = points_cam @ pose[:, :3].T + pose[:, 3]
        return points


def _depth_path(folder: Path, name: str) -> Path:
    return folder / "depth" / Path(name).with_suffix(".png").name


def _read_depth(path: Path) -> DepthMap:
    """(H, W) in metres, 0 where there is none."""
    try:
        with Image.open(path) as opened:
            stored = np.asarray(opened)
    except (OSError, UnidentifiedImageError) as error:
        raise ImageError(f"{path}: not a readable depth map: {error}") from error
    if stored.ndim != 2 or not np.issubdtype(stored.dtype, np.integer):
        raise ImageError(f"{path}: {stored.shape} of {stored.dtype}, needed one channel of 16 bits")
    none = (stored == NO_DEPTH[0]) | (stored == NO_DEPTH[1])
    metres: DepthMap = np.where(none, np.float32(0), stored * np.float32(DEPTH_UNIT_M))
    return metres


def _check_folder(folder: Path, names: Sequence[str], world_from_cams: Mapping[str, FloatArray]) -> None:
    unknown = [name for name in names if name not in world_from_cams]
    if unknown:
        raise InputError(f"{folder / 'poses.txt'}: no pose for {len(unknown)} images, the first is {unknown[0]}")
    missing = [name for name in names if not (folder / "images" / name).is_file()]
    if missing or not names:
        first = f", the first is {missing[0]}" if missing else ""
        raise InputError(f"{folder / 'images'}: {len(missing)} of {len(names)} images are missing{first}")


def _read_intrinsics_txt(path: Path) -> Intrinsics:
    """A PINHOLE camera from the line ``width height fx fy cx cy``; ``#`` begins a comment."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        words = [word for line in lines if not line.startswith("#") for word in line.split()]
        width, height, *params = (float(word) for word in words)
        return Intrinsics(model="PINHOLE", width=int(width), height=int(height), params=tuple(params))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: needed one line width height fx fy cx cy: {error}") from error
