"""From a network that looks at many images at once to a backbone.

A feed-forward network needs two things from us: somebody who keeps its predictions, so that a run can go
on, and somebody who turns them into submodels. It gives them as a ``Predictor``; ``FeedForwardBackbone``
does the rest. docs/backbones.md shows a whole one.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from smust3r_colmap.backbones.base import BackboneResult
from smust3r_colmap.errors import CheckpointError
from smust3r_colmap.execution.progress import Stage
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.products import (
    DenseMaps,
    ImageCollection,
    Segment,
    SegmentReconstruction,
    Submodel,
    UnregisteredImage,
)
from smust3r_colmap.segmentation.view_graph import ViewGraph
from smust3r_colmap.storage.dense_maps import ImageMaps, StoredMaps, write_maps
from smust3r_colmap.storage.digest import digest_of
from smust3r_colmap.storage.run_directory import (
    StageFolder,
    key_of,
    read_arrays,
    read_json,
    write_arrays,
    write_json,
)

MIN_IMAGES = 2
"""Of a submodel; one image has no baseline and ties nothing."""
MAX_CONFIDENCE = 6e4
"""What a half float holds."""
_ROTATION_TOLERANCE = 1e-3
_SAMPLES, _SAMPLED_BYTES = 64, 4096


@dataclass(frozen=True, kw_only=True, eq=False)
class PredictedImage:
    """What a network says of one image.

    Args:
        image: index into the collection.
        seg_from_cam: (3, 4) rigid. The frame of the segment is the network's choice, the same for all its images.
        intrinsics: of the original image.
        maps: depth, confidence and colours over the whole image, uniformly resized; depth 0 where the network
            did not look, such as outside its crop.
    """

    image: int
    seg_from_cam: npt.NDArray[np.float64]
    intrinsics: Intrinsics
    maps: ImageMaps


@dataclass(frozen=True, kw_only=True, eq=False)
class SegmentPrediction:
    """What a network says of a segment.

    Args:
        images: those with a camera, in any order.
        unregistered: the others, and why.
        method: how it was made, in words for people.
        notes: what is worth knowing about the making, such as a retry with less memory.
        warnings: why the geometry should not be trusted; the run ends as weak.
    """

    images: Sequence[PredictedImage]
    unregistered: tuple[UnregisteredImage, ...] = ()
    method: str
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def fingerprint_of(weights: Path) -> str:
    """What tells one file of weights from another, in milliseconds: its size and what stands in 64 places of it.

    Trained weights differ from others everywhere, so that a whole reading would tell no more.

    Raises:
        CheckpointError: the file cannot be read.
    """
    try:
        with weights.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            blocks = []
            for place in np.linspace(0, max(0, size - _SAMPLED_BYTES), _SAMPLES).astype(int):
                file.seek(int(place))
                blocks.append(file.read(_SAMPLED_BYTES))
    except OSError as error:
        raise CheckpointError(f"{weights}: cannot be read: {error.strerror}") from error
    return key_of(size, digest_of(b"".join(blocks)))


class Predictor(Protocol):
    """A network for the images of one collection."""

    name: str
    metric: bool
    """Its lengths are metres."""

    @property
    def key(self) -> object:
        """All that predictions depend on besides the images: weights, sizes, settings. Cheap, for every start asks."""

    def describe(self) -> npt.NDArray[np.float32]:
        """(N, D) one descriptor per image of the collection, of any length; zero or NaN where an image gave none."""

    def predict(self, segment: Segment, stage: Stage) -> SegmentPrediction:
        """One segment; ``stage`` has one unit for each of its images, to be advanced by the predictor.

        What is kept is final until the key changes, so a failure that another start may not meet is raised.
        """


class FeedForwardBackbone:
    """``Backbone`` around a predictor: every segment is one finished stage.

    Args:
        predictor: made for the collection.
        collection: the images of the run.
        run: where finished work is kept, and who is told about every stage.
    """

    has_tracks = False

    def __init__(self, predictor: Predictor, collection: ImageCollection, run: Run) -> None:
        self.predictor = predictor
        self.collection = collection
        self.run = run
        self.name = predictor.name
        self.metric = predictor.metric

    def describe(self) -> npt.NDArray[np.float32]:
        """See ``Backbone``."""
        digests = [image.digest for image in self.collection.images]
        stored = self.run.folder.stage("descriptors", key=key_of("descriptors", self.name, self.predictor.key, digests))
        if not stored.is_done:
            made = _unit_rows(self.predictor.describe(), len(self.collection))
            with stored.write() as folder:
                write_arrays(folder / "descriptors.safetensors", {"descriptors": made})
        descriptors: npt.NDArray[np.float32] = read_arrays(stored.path / "descriptors.safetensors")["descriptors"]
        return descriptors

    def reconstruct(
        self, segments: Sequence[Segment], view_graph: ViewGraph, *, with_maps: Collection[int]
    ) -> BackboneResult:
        """See ``Backbone``; a network makes the maps anyway, so every segment has them."""
        del view_graph, with_maps
        folders = [self._folder(segment) for segment in segments]
        with self.run.clock.stage(self.name, total=sum(len(segment.images) for segment in segments)) as stage:
            for segment, folder in zip(segments, folders, strict=True):
                if folder.is_done:
                    stage.skip(len(segment.images))
                else:
                    self._predict(segment, folder, stage)
        read = [_read(segment, folder, metric=self.metric) for segment, folder in zip(segments, folders, strict=True)]
        return BackboneResult(
            reconstructions=tuple(reconstruction for reconstruction, _ in read),
            dense=tuple(maps for _, of_submodel in read for maps in of_submodel),
            dense_key=key_of([folder.key for folder in folders]),
            matches=None,
            rejected=(),
        )

    def _predict(self, segment: Segment, folder: StageFolder, stage: Stage) -> None:
        prediction = self.predictor.predict(segment, stage)
        for note in prediction.notes:
            self.run.clock.note(f"segment {segment.index}: {note}")
        self._refuse_nonsense(prediction, segment)
        with folder.write() as written:
            _write(written, _checked(prediction, segment))

    def _refuse_nonsense(self, prediction: SegmentPrediction, segment: Segment) -> None:
        """A mistake of the predictor's author is refused before it is kept, where every start would meet it again."""
        where = f"backbone {self.name}, segment {segment.index}"
        numbers = _spoken_of(prediction)
        strange = sorted({number for number in numbers if number not in segment.images or numbers.count(number) > 1})
        if strange:
            raise ValueError(f"{where}: images {strange} come twice or are not of the segment")
        for one in prediction.images:
            image = self.collection.images[one.image]
            if (one.intrinsics.width, one.intrinsics.height) != (image.width, image.height):
                raise ValueError(
                    f"{where}, {image.name}: intrinsics are for {one.intrinsics.width}x{one.intrinsics.height} px, "
                    f"needed for the original image of {image.width}x{image.height} px"
                )
            shapes = (one.maps.depth.shape, one.maps.confidence.shape, one.maps.rgb.shape[:2])
            if len(set(shapes)) > 1 or one.maps.rgb.dtype != np.uint8:
                raise ValueError(
                    f"{where}, {image.name}: depth, confidence and rgb are {shapes[0]}, {shapes[1]} and "
                    f"{one.maps.rgb.shape} {one.maps.rgb.dtype}, needed (H, W), (H, W) and (H, W, 3) uint8"
                )

    def _folder(self, segment: Segment) -> StageFolder:
        images = [self.collection.images[index] for index in segment.images]
        cameras = [self.collection.cameras[image.camera] for image in images]
        inputs = [(image.digest, image.camera, camera) for image, camera in zip(images, cameras, strict=True)]
        key = key_of("prediction", self.name, self.predictor.key, segment.images, inputs)
        return self.run.folder.stage("segments", f"{segment.index:04d}", self.name, key=key)


def _unit_rows(descriptors: npt.NDArray[np.floating], num_images: int) -> npt.NDArray[np.float32]:
    """(N, D) rows of length one, or zero where a row has no finite direction."""
    if descriptors.ndim != 2 or len(descriptors) != num_images:
        raise ValueError(f"descriptors are {descriptors.shape}, needed ({num_images}, D)")
    length = np.linalg.norm(descriptors.astype(np.float64), axis=1, keepdims=True)
    known = np.isfinite(length) & (length > 0)
    return np.where(known, descriptors / np.where(known, length, 1), 0).astype(np.float32)


def _spoken_of(prediction: SegmentPrediction) -> list[int]:
    return [one.image for one in prediction.images] + [one.image for one in prediction.unregistered]


def _checked(prediction: SegmentPrediction, segment: Segment) -> SegmentPrediction:
    """Images in order, without those whose camera is none, and none at all where too few are left."""
    spoken_of = _spoken_of(prediction)
    lost = list(prediction.unregistered)
    lost += [
        UnregisteredImage(image=image, reason="the network said nothing of it")
        for image in segment.images
        if image not in spoken_of
    ]
    kept: list[PredictedImage] = []
    for one in sorted(prediction.images, key=lambda one: one.image):
        if fault := _fault(one):
            lost.append(UnregisteredImage(image=one.image, reason=fault))
        else:
            kept.append(one)
    if len(kept) < MIN_IMAGES:
        reason = f"only {len(kept)} image of its segment got a camera, needed are {MIN_IMAGES}"
        lost += [UnregisteredImage(image=one.image, reason=reason) for one in kept]
        kept = []
    return SegmentPrediction(
        images=kept,
        unregistered=tuple(lost),
        method=prediction.method,
        notes=prediction.notes,
        warnings=prediction.warnings if kept else (),
    )


def _fault(one: PredictedImage) -> str:
    """Why this is no camera, or empty."""
    if one.seg_from_cam.shape != (3, 4) or not np.isfinite(one.seg_from_cam).all():
        return "its predicted pose is not finite"
    rotation = one.seg_from_cam[:, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        return "its predicted pose is no rotation"
    if one.intrinsics.focal_px <= 0:
        return f"its predicted focal length is {one.intrinsics.focal_px:.1f} px"
    return ""


# ------------------------------------------------------------------------------ on disk
def _write(folder: Path, prediction: SegmentPrediction) -> None:
    facts = {
        "images": [one.image for one in prediction.images],
        "intrinsics": [asdict(one.intrinsics) for one in prediction.images],
        "unregistered": [asdict(one) for one in prediction.unregistered],
        "method": prediction.method,
        "notes": prediction.notes,
        "warnings": prediction.warnings,
    }
    poses = np.array([one.seg_from_cam for one in prediction.images], np.float64).reshape(-1, 3, 4)
    write_json(folder / "segment.json", facts)
    write_arrays(folder / "poses.safetensors", {"seg_from_cam": poses})
    write_maps(folder, (_storable(one.maps) for one in prediction.images))


def _storable(maps: ImageMaps) -> ImageMaps:
    """Depth 0 wherever it is no depth, and confidence in the range that is stored."""
    known = np.isfinite(maps.depth) & (maps.depth > 0) & np.isfinite(maps.confidence)
    return ImageMaps(
        depth=np.where(known, maps.depth, np.float32(0)),
        confidence=np.where(known, maps.confidence.clip(1, MAX_CONFIDENCE), np.float32(1)),
        rgb=maps.rgb,
    )


def _read(
    segment: Segment, folder: StageFolder, *, metric: bool
) -> tuple[SegmentReconstruction, tuple[DenseMaps, ...]]:
    facts = read_json(folder.path / "segment.json")
    submodels: tuple[Submodel, ...] = ()
    if facts["images"]:
        submodel = Submodel(
            segment=segment.index,
            submodel=0,
            images=tuple(facts["images"]),
            seg_from_cam=read_arrays(folder.path / "poses.safetensors")["seg_from_cam"],
            intrinsics=tuple(Intrinsics(**one) for one in facts["intrinsics"]),
            method=facts["method"],
            reprojection_error_px=float("nan"),
            tracks=None,
        )
        submodels = (submodel,)
    unregistered = tuple(UnregisteredImage(**one) for one in facts["unregistered"])
    reasons = Counter(one.reason for one in unregistered).most_common(1 if not submodels else 0)
    reconstruction = SegmentReconstruction(
        segment=segment.index,
        submodels=submodels,
        unregistered=unregistered,
        attempts=(facts["method"], *(f"{count} images: {reason}" for reason, count in reasons), *facts["notes"]),
        metric=metric,
        warnings=tuple(facts["warnings"]),
    )
    return reconstruction, tuple(StoredMaps(folder.path, submodel) for submodel in submodels)
