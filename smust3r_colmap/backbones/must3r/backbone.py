"""MUSt3R as a backbone: images in, a camera and a depth map for each of them out.

    encode      every image once in the run, kept on disk        encoder, token_cache
    remember    the keyframes of a segment                       keyframes, drivers
    predict     every image against what is remembered           drivers
    fit         cameras from the pointmaps                       cameras
    carry over  depth to the grid of the whole image             full_image

How much is done at once is planned from the memory that is free (``memory_plan``); what fails for lack of it
all the same is tried again with less. Source: paper, section III-A; network specification, sections 8 to 11.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import torch

from smust3r_colmap.backbones.base import BackboneContext, BackbonePlugin
from smust3r_colmap.backbones.feed_forward import (
    MIN_IMAGES,
    FeedForwardBackbone,
    PredictedImage,
    SegmentPrediction,
    fingerprint_of,
)
from smust3r_colmap.backbones.must3r.cameras import (
    FittedCamera,
    NoCamera,
    Sighting,
    fit_cameras,
    guess_cameras,
    sight,
)
from smust3r_colmap.backbones.must3r.checkpoint import load_checkpoint
from smust3r_colmap.backbones.must3r.drivers import reconstruct_segment
from smust3r_colmap.backbones.must3r.encoder import EncodedImage
from smust3r_colmap.backbones.must3r.full_image import to_full_image
from smust3r_colmap.backbones.must3r.head import activate
from smust3r_colmap.backbones.must3r.keyframes import (
    EvenlySpread,
    EveryKth,
    KeyframeChoice,
    NoveltyRule,
    UnlikeEachOther,
    WhereNew,
)
from smust3r_colmap.backbones.must3r.memory_plan import (
    MemoryModel,
    MemoryPlan,
    bytes_of_weights,
    fewer,
    is_out_of_memory,
    memory_budget,
    plan_memory,
)
from smust3r_colmap.backbones.must3r.network import Network, encode, remembering_as
from smust3r_colmap.backbones.must3r.precision import PrecisionChoice, choose_device, choose_precision, prepare
from smust3r_colmap.backbones.must3r.preprocessing import (
    NetworkWindow,
    choose_window,
    preprocess,
    resolutions_of,
)
from smust3r_colmap.backbones.must3r.retrieval import RetrievalHead, mean_descriptor
from smust3r_colmap.backbones.must3r.token_cache import TokenCache
from smust3r_colmap.backbones.options import NoOptions
from smust3r_colmap.backbones.weights.cache import find_weights, named_file
from smust3r_colmap.config import Must3rConfig
from smust3r_colmap.execution.progress import Reporter, Stage
from smust3r_colmap.importers.images import load_rgb
from smust3r_colmap.products import ImageCollection, Segment, UnregisteredImage
from smust3r_colmap.storage.dense_maps import ImageMaps
from smust3r_colmap.storage.run_directory import key_of

GIB = 2**30
MIN_CONFIDENCE = 1.5
"""Median over an image below which the published viewer does not show its camera."""
MAX_RELATIVE_RESIDUAL = 0.1
"""Median distance of the two pointmaps of an image over the depth, above which they are inconsistent."""
ENCODED_AT_ONCE_ON_CARD = 16
"""A processor is as fast with one."""
MIN_SEEN_SHARE = 0.6
"""Of an image in its centre crop, below which the user is warned; a square keeps 75 %."""
MAX_UNRELIABLE_SHARE = 0.5
"""Of the images of a segment that may have low confidence or inconsistent pointmaps, before the user is warned."""


def make_must3r(context: BackboneContext, options: NoOptions) -> FeedForwardBackbone:
    """MUSt3R for one run.

    Raises:
        CheckpointError: there are no weights, or they cannot be used.
        ConfigError: the device or the precision is not available.
    """
    settings = context.config.must3r
    device = choose_device(settings.device)
    head = settings.retrieval_weights
    predictor = Must3rPredictor(
        collection=context.collection,
        settings=settings,
        weights=find_weights(settings.weights, settings.network_size),
        retrieval=named_file(head, said_by="--retrieval-weights", kind="retrieval head") if head else None,
        device=device,
        precision=choose_precision(settings.precision, device),
        token_folder=context.run.folder.work / "tokens",
        reporter=context.run.clock,
        threads=context.run.executor.workers,
    )
    _warn_of_narrow_views(context, settings.network_size)
    return FeedForwardBackbone(predictor, context.collection, context.run)


MUST3R = BackbonePlugin(make=make_must3r, options=NoOptions)


def _warn_of_narrow_views(context: BackboneContext, size: int) -> None:
    """The network's shapes go up to 16:5; of what is longer it sees the middle."""
    shares = {
        image.name: choose_window(image.width, image.height, resolutions_of(size)).seen_share
        for image in context.collection.images
    }
    narrow = {name: share for name, share in shares.items() if share < MIN_SEEN_SHARE}
    if narrow:
        name, share = min(narrow.items(), key=lambda item: item[1])
        context.run.clock.warn(
            f"MUSt3R sees the middle of {len(narrow)} of {len(shares)} images only, such as {share:.0%} of {name}"
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Sight:
    """What is kept of one image until the cameras of its segment are fitted.

    Args:
        sighting: pixels for the camera. depth, confidence: (h, w) float32, as the network has them.
    """

    sighting: Sighting
    depth: npt.NDArray[np.float32]
    confidence: npt.NDArray[np.float32]
    is_keyframe: bool


class Must3rPredictor:
    """``Predictor`` around the network.

    Args:
        collection: the images of the run.
        settings: of the backbone.
        weights: a checkpoint. retrieval: the trained head for descriptors, or None.
        device, precision: where the network runs, and in which number type.
        token_folder: where encoded images are kept.
        reporter: told what was chosen.
        threads: that the processor may use.

    Raises:
        CheckpointError: the weights cannot be used.
    """

    name = "must3r"
    metric = True

    def __init__(
        self,
        *,
        collection: ImageCollection,
        settings: Must3rConfig,
        weights: Path,
        retrieval: Path | None,
        device: torch.device,
        precision: PrecisionChoice,
        token_folder: Path,
        reporter: Reporter,
        threads: int,
    ) -> None:
        self.collection = collection
        self.settings = settings
        self._weights = weights
        self._head = None if retrieval is None else RetrievalHead.load(retrieval)
        self._device = device
        self._precision = precision
        self._token_folder = token_folder
        self._reporter = reporter
        self._threads = threads
        self._encoding_key = key_of(fingerprint_of(weights), settings.network_size, str(precision.dtype))
        self._head_key = "" if retrieval is None else fingerprint_of(retrieval)
        self._said: tuple[object, ...] = ()

    @property
    def key(self) -> object:
        """See ``Predictor``. How much memory is free is not in it: what was predicted stays."""
        s = self.settings
        choice = (
            s.network_keyframes,
            s.max_keyframes,
            s.keyframe_interval,
            s.keyframe_threshold,
            s.refinements,
            s.rerender,
        )
        return self._encoding_key, choice, s.camera_fit, self._head_key, self.collection.calibrated

    # -------------------------------------------------------------------------- every image
    def describe(self) -> npt.NDArray[np.float32]:
        """See ``Predictor``: the mean of the encoder's features, or what the trained head makes of them."""
        total = len(self.collection)
        with self._reporter.stage("encoding", total=total) as stage:
            descriptors = []
            for image in self._encoded_ahead(range(total)):
                descriptors.append(self._descriptor(image))
                stage.advance()
        return np.stack(descriptors)

    def _descriptor(self, image: EncodedImage) -> npt.NDArray[np.float32]:
        return mean_descriptor(image) if self._head is None else self._head.global_descriptor(image)

    def _encoded_ahead(self, indices: Sequence[int]) -> Iterator[EncodedImage]:
        """Encoded images in order; files are read while the network is busy, and a card gets many at once."""
        at_once = _encoded_at_once(self._device)
        with ThreadPoolExecutor(max_workers=min(2, self._threads)) as readers:
            waiting: deque[tuple[int, EncodedImage | None, Future[torch.Tensor] | None]] = deque()
            for index in indices:
                known = self._cache.get(self.collection.images[index].digest)
                waiting.append((index, known, None if known else readers.submit(self._pixels, index)))
                if len(waiting) == 2 * at_once:
                    yield from self._encode_first(waiting, at_once)
            while waiting:
                yield from self._encode_first(waiting, at_once)

    def _encode_first(
        self, waiting: deque[tuple[int, EncodedImage | None, Future[torch.Tensor] | None]], count: int
    ) -> Iterator[EncodedImage]:
        batch = [waiting.popleft() for _ in range(min(count, len(waiting)))]
        pixels = [loading.result() for _, _, loading in batch if loading is not None]
        fresh = iter(self._encoded(pixels))
        for index, known, _ in batch:
            image = known or next(fresh)
            if image is not known:
                self._cache.put(self.collection.images[index].digest, image)
            yield image

    def _encoded(self, pixels: Sequence[torch.Tensor]) -> tuple[EncodedImage, ...]:
        """All at once, or one by one where that is too much for the card."""
        try:
            return encode(self._network, pixels, batch_size=max(1, len(pixels)))
        except (MemoryError, RuntimeError) as error:
            if len(pixels) < 2 or not is_out_of_memory(error):
                raise
        return encode(self._network, pixels, batch_size=1)

    def _pixels(self, index: int) -> torch.Tensor:
        """(3, h, w) as the network wants them."""
        pixels = preprocess(load_rgb(self.collection.images[index]), self.settings.network_size).pixels
        return pixels.pin_memory() if self._device.type == "cuda" else pixels

    def _window(self, index: int) -> NetworkWindow:
        image = self.collection.images[index]
        return choose_window(image.width, image.height, resolutions_of(self.settings.network_size))

    @cached_property
    def _cache(self) -> TokenCache:
        return TokenCache(
            self._token_folder,
            key=self._encoding_key,
            limit_bytes=int(self.settings.token_cache * GIB),
            dtype=self._precision.dtype,
        )

    @cached_property
    def _network(self) -> Network:
        torch.set_num_threads(self._threads)
        network = load_checkpoint(self._weights, image_size=self.settings.network_size, device=self._device)
        self._reporter.note(f"MUSt3R of {self._weights.name} on {self._device.type}: {self._precision.reason}")
        return prepare(network, self._precision.dtype)

    # --------------------------------------------------------------------------- a segment
    def predict(self, segment: Segment, stage: Stage) -> SegmentPrediction:
        """See ``Predictor``. Memory that runs out in the middle costs keyframes, not the segment."""
        plan = self._plan(segment)
        self._say(plan, segment)
        notes = (
            [] if plan.is_full else [f"{plan.num_keyframes} of {plan.wanted_keyframes} keyframes, for lack of memory"]
        )
        progress = _Progress(stage, len(segment.images))
        while True:
            try:
                sights = self._look(segment, plan, progress)
                break
            except (MemoryError, RuntimeError) as error:
                if not is_out_of_memory(error):
                    raise
                failure = str(error).splitlines()[0] if str(error) else type(error).__name__
            # Only here, after the except block, are the tensors of the attempt given back.
            plan = fewer(plan)
            notes.append(f"memory ran out ({failure}); tried again with {plan.text}")
            self._reporter.warn(f"segment {segment.index}: {notes[-1]}")
        progress.finish()
        return self._prediction(segment, sights, notes)

    def _say(self, plan: MemoryPlan, segment: Segment) -> None:
        """What a segment is run with, before it runs; once for all segments that are run alike."""
        alike = (plan.num_keyframes, plan.wanted_keyframes, plan.memory_mode, plan.render_batch)
        if alike != self._said:
            self._reporter.note(f"segment {segment.index}: {plan.text}")
            self._said = alike

    def _plan(self, segment: Segment) -> MemoryPlan:
        """What fits into the memory that is free now."""
        network, settings = self._network, self.settings
        patch = network.architecture.encoder.patch_size
        windows = [self._window(index) for index in segment.images]
        mapped = self._device.type == "cpu" and network.dtype == torch.float32
        model = MemoryModel(
            architecture=network.architecture,
            tokens=max(window.width * window.height for window in windows) // patch**2,
            dtype=network.dtype,
            weights_bytes=bytes_of_weights(network.encoder, network.decoder) if mapped else 0,
            remakes_memory=settings.network_keyframes == "overlap",
            shown_again=2 if settings.refinements else 1,
        )
        return plan_memory(
            model,
            num_images=len(segment.images),
            wanted_keyframes=settings.max_keyframes,
            budget_bytes=memory_budget(self._device, settings.network_memory),
            on_card=self._device.type == "cuda",
        )

    def _look(self, segment: Segment, plan: MemoryPlan, progress: _Progress) -> list[_Sight]:
        """What the network says of every image of the segment, in order."""
        progress.expect((1 + self.settings.refinements) * plan.num_keyframes + len(segment.images))
        images = self._cache.images(
            [self.collection.images[index].digest for index in segment.images],
            lambda k: encode(self._network, [self._pixels(segment.images[k])])[0],
        )
        sights: dict[int, _Sight] = {}
        for prediction in reconstruct_segment(
            remembering_as(self._network, plan.memory_mode),
            images,
            self._choice(plan.num_keyframes, images),
            refinements=self.settings.refinements,
            rerender=self.settings.rerender,
            batch_size=plan.render_batch,
            on_memory=lambda _: progress.step(),
        ):
            pointmaps = activate(prediction.raw, self._network.architecture.decoder.activation)
            window = self._window(segment.images[prediction.index])
            sights[prediction.index] = _Sight(
                sighting=sight(pointmaps, window, camera_fit=self.settings.camera_fit),
                depth=pointmaps.points_cam[..., 2].cpu().numpy().copy(),
                confidence=pointmaps.confidence.cpu().numpy(),
                is_keyframe=prediction.is_keyframe,
            )
            progress.step()
        return [sights[k] for k in range(len(segment.images))]

    def _choice(self, most: int, images: Sequence[EncodedImage]) -> KeyframeChoice:
        settings = self.settings
        match settings.network_keyframes:
            case "linspace":
                return EvenlySpread(most=most)
            case "retrieval":
                descriptors = np.stack([self._descriptor(image) for image in images]).astype(np.float64)
                return UnlikeEachOther(most=most, similarity=descriptors @ descriptors.T)
            case "every-kth":
                return EveryKth(interval=settings.keyframe_interval, most=most)
            case "overlap":
                return WhereNew(most=most, rule=NoveltyRule(threshold=settings.keyframe_threshold))

    def _prediction(self, segment: Segment, sights: Sequence[_Sight], notes: Sequence[str]) -> SegmentPrediction:
        """Cameras for all images that have one, and their maps."""
        fitted, warnings = self._cameras(segment, [one.sighting for one in sights])
        images, lost = [], []
        for index, one, camera in zip(segment.images, sights, fitted, strict=True):
            if isinstance(camera, NoCamera):
                lost.append(UnregisteredImage(image=index, reason=camera.reason))
            else:
                images.append(self._predicted(index, one, camera))
        num_keyframes = sum(one.is_keyframe for one in sights)
        return SegmentPrediction(
            images=images,
            unregistered=tuple(lost),
            method=f"MUSt3R at {self.settings.network_size} px, {num_keyframes} keyframes",
            notes=tuple(notes),
            warnings=(*warnings, *_quality_warnings([camera for camera in fitted if isinstance(camera, FittedCamera)])),
        )

    def _cameras(
        self, segment: Segment, sightings: Sequence[Sighting]
    ) -> tuple[tuple[FittedCamera | NoCamera, ...], tuple[str, ...]]:
        """The camera of every image, and why they should be doubted if they had to be guessed."""
        owners = [self.collection.images[index].camera for index in segment.images]
        cameras = self.collection.cameras
        fitted = fit_cameras(
            sightings,
            owners,
            cameras,
            camera_fit=self.settings.camera_fit,
            calibrated=self.collection.calibrated,
        )
        reasons = [camera.reason for camera in fitted if isinstance(camera, NoCamera)]
        if not reasons or len(fitted) - len(reasons) >= MIN_IMAGES:
            return fitted, ()
        doubt = f"its pointmaps gave no cameras, so these are guesses ({reasons[0]})"
        return guess_cameras(sightings, owners, cameras), (doubt,)

    def _predicted(self, index: int, one: _Sight, camera: FittedCamera) -> PredictedImage:
        whole = to_full_image(one.depth * np.float32(camera.depth_factor), one.confidence, one.sighting.window)
        height, width = whole.depth.shape
        rgb = cv2.resize(load_rgb(self.collection.images[index]), (width, height), interpolation=cv2.INTER_AREA)
        return PredictedImage(
            image=index,
            seg_from_cam=camera.seg_from_cam,
            intrinsics=camera.intrinsics,
            maps=ImageMaps(depth=whole.depth, confidence=whole.confidence, rgb=np.asarray(rgb, np.uint8)),
        )


def _encoded_at_once(device: torch.device) -> int:
    return ENCODED_AT_ONCE_ON_CARD if device.type == "cuda" else 1


def _quality_warnings(cameras: Sequence[FittedCamera]) -> tuple[str, ...]:
    """Why the geometry of a segment should not be trusted."""
    warnings = []
    torn = [camera.relative_residual for camera in cameras if camera.relative_residual > MAX_RELATIVE_RESIDUAL]
    if len(torn) > MAX_UNRELIABLE_SHARE * len(cameras):
        warnings.append(
            f"the two pointmaps of {len(torn)} of {len(cameras)} images differ by more than "
            f"{MAX_RELATIVE_RESIDUAL:.0%} of the depth ({np.median(torn):.0%} in the median)"
        )
    unsure = [camera.median_confidence for camera in cameras if camera.median_confidence < MIN_CONFIDENCE]
    if len(unsure) > MAX_UNRELIABLE_SHARE * len(cameras):
        warnings.append(
            f"{len(unsure)} of {len(cameras)} images have a low confidence (median "
            f"{np.median(unsure):.2f}, needed {MIN_CONFIDENCE})"
        )
    return tuple(warnings)


class _Progress:
    """Counts every image once, however often the network looks at it and its segment is tried."""

    def __init__(self, stage: Stage, num_images: int) -> None:
        self._stage = stage
        self._num_images = num_images
        self._steps, self._expected, self._shown = 0, 1, 0

    def expect(self, steps: int) -> None:
        """So many steps from here to the end of the segment; what was shown before stays."""
        self._steps, self._expected = 0, steps

    def step(self) -> None:
        """An image was remembered or predicted."""
        self._steps += 1
        self._show(self._num_images * self._steps // self._expected)

    def finish(self) -> None:
        """All images are done, whatever was expected."""
        self._show(self._num_images)

    def _show(self, count: int) -> None:
        more = min(count, self._num_images) - self._shown
        if more > 0:
            self._shown += more
            self._stage.advance(more)
