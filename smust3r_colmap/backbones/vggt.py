"""VGGT as a backbone, where its package is installed; the example of an adapter for somebody else's network.

VGGT (Wang et al., CVPR 2025) looks at all images of a segment at once and says a camera and a depth map for
each. The package ``vggt`` and its checkpoints have licences of their own and do not come with this one; only
the interface that its README and docstrings state is used here. Frames: ``seg`` is the network's world, ``net``
the pixels that the network sees. The authors state 11 GB of a card's memory for 50 images of a segment and 21 GB
for 100; in float32 on a processor it is more. The next module to read is ``feed_forward``.
"""

from __future__ import annotations

import pickle
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt
import safetensors
import safetensors.torch
import torch

from smust3r_colmap.backbones.base import BackboneContext, BackbonePlugin
from smust3r_colmap.backbones.feed_forward import (
    FeedForwardBackbone,
    PredictedImage,
    SegmentPrediction,
    fingerprint_of,
)
from smust3r_colmap.errors import CheckpointError, ConfigError, ImageError, MissingDependencyError, ReconstructionError
from smust3r_colmap.execution.progress import Reporter, Stage
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.importers.images import load_rgb
from smust3r_colmap.products import ImageCollection, Segment, SourceImage, UnregisteredImage
from smust3r_colmap.storage.dense_maps import ImageMaps

PATCH_PX = 14
"""Sides of the network's input are multiples of it."""
TRAINED_WIDTH_PX = 518
Device = Literal["auto", "cpu", "cuda"]
SURE_CONFIDENCE = 1.5
"""The authors' lower end of useful thresholds; 1 is none, as in our maps."""
LEAST_SURE_SHARE = 0.05
"""Of a segment's pixels. Confidences all near 1 come, say the authors, of moving things or of little overlap."""

_INSTALL = "pip install git+https://github.com/facebookresearch/vggt.git (it brings torch and torchvision)"


@dataclass(frozen=True, kw_only=True)
class Crop:
    """Where the pixels of an image lie in what the network sees: resized to its width, cut to its height.

    Args:
        width, full_height: the whole image, resized; both are multiples of 14, so that the sides may scale
            by slightly different factors.
        top, height: first row that the network sees, and how many.
    """

    width: int
    full_height: int
    top: int
    height: int

    @classmethod
    def of(cls, image: SourceImage, width: int) -> Crop:
        """The package's own rule ("crop"), as the docstring of its ``load_and_preprocess_images`` has it."""
        full_height = max(1, round(image.height * width / image.width / PATCH_PX)) * PATCH_PX
        height = min(full_height, width)
        return cls(width=width, full_height=full_height, top=(full_height - height) // 2, height=height)

    def original_intrinsics(
        self, camera_net: npt.NDArray[np.float64], image: SourceImage, *, first_row: int
    ) -> Intrinsics:
        """The camera of the original image.

        Args:
            camera_net: (3, 3) in network pixels, the centre of an image being half its size.
            image: gives the original size.
            first_row: of the network's input that shows this image; others are padding.
        """
        x_scale, y_scale = image.width / self.width, image.height / self.full_height
        fx, fy, cx, cy = camera_net[0, 0], camera_net[1, 1], camera_net[0, 2], camera_net[1, 2] - first_row + self.top
        params = (fx * x_scale, fy * y_scale, cx * x_scale, cy * y_scale)
        return Intrinsics(model="PINHOLE", width=image.width, height=image.height, params=params)

    def whole(self, values_net: npt.NDArray[np.float32], *, first_row: int, outside: float) -> npt.NDArray[np.float32]:
        """(full_height, width) of the whole image from (H, W) of the network, ``outside`` where it did not look."""
        values = np.full((self.full_height, self.width), outside, np.float32)
        values[self.top : self.top + self.height] = values_net[first_row : first_row + self.height]
        return values


@dataclass(frozen=True, kw_only=True, eq=False)
class _Shown:
    """An image on its way into the network: its number, where it is cut, and (full_height, width, 3) uint8."""

    image: int
    crop: Crop
    rgb: npt.NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Answer:
    """What the network says of S images, in its pixels.

    Args:
        cam_from_seg: (S, 3, 4) float64. camera_net: (S, 3, 3) float64.
        depth, confidence: (S, H, W) float32, the confidence at least 1.
    """

    cam_from_seg: npt.NDArray[np.float64]
    camera_net: npt.NDArray[np.float64]
    depth: npt.NDArray[np.float32]
    confidence: npt.NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Loaded:
    """The network where it runs, and the package's function that decodes its cameras."""

    model: Any
    decode_cameras: Callable[..., tuple[torch.Tensor, torch.Tensor]]
    device: torch.device
    fast_type: torch.dtype | None


@dataclass(frozen=True, kw_only=True)
class VggtOptions:
    """After ``--backbone-options``.

    Args:
        checkpoint: weights as the authors publish them; needed.
        size: width of the images in the network, a multiple of 14 px.
        device: where the network runs; auto takes a card where there is one.
    """

    checkpoint: Path | None = None
    size: int = TRAINED_WIDTH_PX
    device: Device = "auto"


def make_vggt(context: BackboneContext, options: VggtOptions) -> FeedForwardBackbone:
    """VGGT for one run.

    Raises:
        ConfigError: an option makes no sense.
        CheckpointError: there is no checkpoint.
        MissingDependencyError: the package is not installed; raised when the network is first needed.
    """
    if options.checkpoint is None:
        raise CheckpointError(
            "--backbone vggt: needs --backbone-options checkpoint=FILE, the model.pt or model.safetensors "
            "that the authors publish as facebook/VGGT-1B; nothing is fetched for you, mind its licence"
        )
    if options.size < PATCH_PX or options.size % PATCH_PX:
        raise ConfigError(
            f"--backbone-options size={options.size}: needed a multiple of {PATCH_PX} px, by default {TRAINED_WIDTH_PX}"
        )
    if context.collection.calibrated:
        context.run.clock.warn("vggt predicts the cameras itself; the given calibration is not used")
    predictor = VggtPredictor(
        context.collection,
        options.checkpoint,
        width=options.size,
        device=options.device,
        reporter=context.run.clock,
    )
    return FeedForwardBackbone(predictor, context.collection, context.run)


VGGT = BackbonePlugin(make=make_vggt, options=VggtOptions)


class VggtPredictor:
    """``Predictor`` that asks VGGT.

    Args:
        collection: the images of the run.
        checkpoint: weights as the authors publish them.
        width: of the images in the network, a multiple of 14; heights are cut to it.
        device: auto, cpu or cuda.
        reporter: told how far the descriptors are.

    Raises:
        CheckpointError: the file cannot be read.
    """

    name = "vggt"
    metric = False

    def __init__(
        self, collection: ImageCollection, checkpoint: Path, *, width: int, device: Device, reporter: Reporter
    ) -> None:
        self.collection = collection
        self.checkpoint = checkpoint
        self.width = width
        self.device = device
        self.reporter = reporter
        self._weights = fingerprint_of(checkpoint)

    @property
    def key(self) -> object:
        """See ``Predictor``; the device is left out, for it changes no more than rounding does."""
        return self._weights, self.width

    def describe(self) -> npt.NDArray[np.float32]:
        """Mean of the patch tokens of each image shown alone. What that is worth for finding loops was not measured."""
        described: dict[int, npt.NDArray[np.float32]] = {}
        with self.reporter.stage("descriptors", total=len(self.collection)) as stage:
            for index in range(len(self.collection)):
                shown, _ = self._show([index])
                if shown:
                    described[index] = self._mean_token(network_input(shown))
                stage.advance()
        length = max((len(one) for one in described.values()), default=1)
        none = np.zeros(length, np.float32)
        return np.array([described.get(index, none) for index in range(len(self.collection))])

    def predict(self, segment: Segment, stage: Stage) -> SegmentPrediction:
        """See ``Predictor``.

        Raises:
            ReconstructionError: the segment does not fit into the memory of the card.
        """
        shown, unregistered = self._show(segment.images)
        images: list[PredictedImage] = []
        warnings: tuple[str, ...] = ()
        if shown:
            pixels = network_input(shown)
            answer = self._asked(pixels, segment)
            rows = [_first_row(one.crop, pixels.shape[2]) for one in shown]
            for k, one in enumerate(shown):
                if np.isfinite(answer.camera_net[k]).all():
                    images.append(self._predicted(one, answer, k, first_row=rows[k]))
                else:
                    unregistered.append(UnregisteredImage(image=one.image, reason="its predicted camera is not finite"))
            warnings = _doubts(answer, shown, rows)
        stage.advance(len(segment.images))
        return SegmentPrediction(
            images=images,
            unregistered=tuple(unregistered),
            method=f"VGGT at {self.width} px, {len(shown)} images at once",
            warnings=warnings,
        )

    def _show(self, images: Sequence[int]) -> tuple[list[_Shown], list[UnregisteredImage]]:
        shown, lost = [], []
        for index in images:
            image = self.collection.images[index]
            crop = Crop.of(image, self.width)
            try:
                rgb = cv2.resize(load_rgb(image), (crop.width, crop.full_height), interpolation=cv2.INTER_AREA)
            except ImageError as error:
                lost.append(UnregisteredImage(image=index, reason=str(error)))
            else:
                shown.append(_Shown(image=index, crop=crop, rgb=np.asarray(rgb, np.uint8)))
        return shown, lost

    def _predicted(self, one: _Shown, answer: _Answer, k: int, *, first_row: int) -> PredictedImage:
        image = self.collection.images[one.image]
        return PredictedImage(
            image=one.image,
            seg_from_cam=invert_rigid(answer.cam_from_seg[k]),
            intrinsics=one.crop.original_intrinsics(answer.camera_net[k], image, first_row=first_row),
            maps=ImageMaps(
                depth=one.crop.whole(answer.depth[k], first_row=first_row, outside=0),
                confidence=one.crop.whole(answer.confidence[k], first_row=first_row, outside=1),
                rgb=one.rgb,
            ),
        )

    # --------------------------------------------------------------------------- torch
    @cached_property
    def _network(self) -> _Loaded:
        return _load(self.checkpoint, self.device)

    def _tokens(self, images: torch.Tensor) -> tuple[list[torch.Tensor | None], int]:
        """Tokens (1, S, T, C) of every layer that the heads read, and the first that stands for a patch.

        The blocks run in half precision where the card has it, as published; the heads in float32.
        """
        network = self._network
        with torch.autocast(network.device.type, dtype=network.fast_type, enabled=network.fast_type is not None):
            layers, first_patch = network.model.aggregator(images)
        return [None if layer is None else layer.float() for layer in layers], first_patch

    @torch.no_grad()
    def _mean_token(self, pixels: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        layers, first_patch = self._tokens(torch.from_numpy(pixels).to(self._network.device)[None])
        last = layers[-1]
        assert last is not None, "the heads read the last layer"
        return _numpy(last[0, 0, first_patch:].mean(dim=0))  # (T, C) -> (C,)

    @torch.no_grad()
    def _asked(self, pixels: npt.NDArray[np.float32], segment: Segment) -> _Answer:
        network = self._network
        try:
            images = torch.from_numpy(pixels).to(network.device)[None]  # (1, S, 3, H, W)
            layers, first_patch = self._tokens(images)
            codes = network.model.camera_head(layers)[-1]  # (1, S, 9), the last refinement
            cam_from_seg, camera_net = network.decode_cameras(codes, images.shape[-2:])
            depth, confidence = network.model.depth_head(layers, images, first_patch)
        except torch.cuda.OutOfMemoryError as error:
            height, width = pixels.shape[2:]
            raise ReconstructionError(
                f"segment {segment.index}: {len(pixels)} images of {width}x{height} px do not fit into the memory of "
                "the card; give a smaller --segment-length, --backbone-options size=392 or device=cpu"
            ) from error
        return _Answer(
            cam_from_seg=_numpy(cam_from_seg)[0].astype(np.float64),  # (S, 3, 4)
            camera_net=_numpy(camera_net)[0].astype(np.float64),  # (S, 3, 3)
            depth=_numpy(depth)[0, ..., 0],  # (1, S, H, W, 1) -> (S, H, W)
            confidence=_numpy(confidence)[0],  # (S, H, W)
        )


def network_input(shown: Sequence[_Shown]) -> npt.NDArray[np.float32]:
    """(S, 3, H, W) in 0..1; images that are less high than the highest lie in the middle of white."""
    height = max(one.crop.height for one in shown)
    pixels = np.ones((len(shown), 3, height, shown[0].crop.width), np.float32)
    for k, one in enumerate(shown):
        seen = one.rgb[one.crop.top : one.crop.top + one.crop.height]
        row = _first_row(one.crop, height)
        pixels[k, :, row : row + one.crop.height] = seen.transpose(2, 0, 1) / np.float32(255)
    return pixels


def import_vggt() -> tuple[Callable[[], Any], Callable[..., tuple[torch.Tensor, torch.Tensor]]]:
    """The network's class and the function that decodes its cameras.

    Raises:
        MissingDependencyError: the package, or one that it needs, is not installed.
    """
    try:
        from vggt.models.vggt import VGGT  # noqa: PLC0415
        from vggt.utils.pose_enc import pose_encoding_to_extri_intri  # noqa: PLC0415
    except ImportError as error:
        raise MissingDependencyError(f"the package vggt cannot be imported ({error}); {_INSTALL}") from error
    return VGGT, pose_encoding_to_extri_intri


def _first_row(crop: Crop, height: int) -> int:
    """Of the network's input that shows the image; the rows above and below are padding."""
    return (height - crop.height) // 2


def _doubts(answer: _Answer, shown: Sequence[_Shown], rows: Sequence[int]) -> tuple[str, ...]:
    seen = [
        answer.confidence[k, row : row + one.crop.height] for k, (one, row) in enumerate(zip(shown, rows, strict=True))
    ]
    sure = float(np.mean(np.concatenate([one.ravel() for one in seen]) > SURE_CONFIDENCE))
    if sure >= LEAST_SURE_SHARE:
        return ()
    return (f"VGGT is sure of {100 * sure:.1f} % of the pixels only, {100 * LEAST_SURE_SHARE:.0f} % are needed",)


def _load(checkpoint: Path, device: str) -> _Loaded:
    network_class, decode_cameras = import_vggt()
    has_cuda = torch.cuda.is_available()
    if device == "cuda" and not has_cuda:
        raise ConfigError("--backbone-options device=cuda: torch finds no CUDA card here; give auto or cpu")
    on_card = has_cuda and device != "cpu"
    model = network_class()
    weights = _read_checkpoint(checkpoint)
    try:
        model.load_state_dict(weights)
    except RuntimeError as error:
        raise CheckpointError(f"{checkpoint}: is no checkpoint of VGGT: {_short(error)}") from error
    fast_type = torch.bfloat16 if on_card and torch.cuda.is_bf16_supported() else torch.float16
    return _Loaded(
        model=model.to("cuda" if on_card else "cpu").eval(),
        decode_cameras=decode_cameras,
        device=torch.device("cuda" if on_card else "cpu"),
        fast_type=fast_type if on_card else None,
    )


def _read_checkpoint(checkpoint: Path) -> Mapping[str, torch.Tensor]:
    """Tensors by name; nothing else is unpickled."""
    try:
        if checkpoint.suffix == ".safetensors":
            weights = safetensors.torch.load_file(checkpoint)
        elif zipfile.is_zipfile(checkpoint):
            weights = torch.load(checkpoint, map_location="cpu", weights_only=True)
        else:
            raise CheckpointError(
                f"{checkpoint}: cannot be read as weights: no archive as torch.save has made since 1.6"
            )
    except (OSError, EOFError, RuntimeError, pickle.UnpicklingError, safetensors.SafetensorError) as error:
        raise CheckpointError(f"{checkpoint}: cannot be read as weights: {_short(error)}") from error
    if not isinstance(weights, Mapping):
        raise CheckpointError(f"{checkpoint}: holds a {type(weights).__name__}, needed are tensors by name")
    return weights


def _short(error: Exception) -> str:
    """The beginning, in one line; torch names every single tensor."""
    return " ".join(str(error).split())[:300]


def _numpy(tensor: torch.Tensor) -> npt.NDArray[np.float32]:
    return np.asarray(tensor.float().cpu().numpy(), np.float32)
