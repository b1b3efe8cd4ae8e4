"""Frames one by one, as they come from a camera (network specification, section 12).

Where ``drivers`` goes through a segment that lies there as a whole, ``Slam`` says after every frame where the
camera is, all frames having one focal length, and keeps those that show something new. Segments are not run
in this way; it is here because the network is used so elsewhere, and compared by it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
import torch

from smust3r_colmap.backbones.must3r.cameras import estimate_focal, register_camera
from smust3r_colmap.backbones.must3r.encoder import EncodedImage
from smust3r_colmap.backbones.must3r.head import Pointmaps, activate
from smust3r_colmap.backbones.must3r.keyframes import Discovery, NoveltyRule, View
from smust3r_colmap.backbones.must3r.memory import Memory
from smust3r_colmap.backbones.must3r.network import Network, init_memory, render

RENDER_BATCH = 64
"""Frames that are predicted again at once, as published."""


@dataclass(frozen=True, kw_only=True)
class SlamSettings:
    """As on the command line of the published program.

    Args:
        initial: frames that create the memory together.
        rule: what makes a frame a keyframe; its median confidence must also be more than ``min_confidence``.
        rerender: keep all frames, not the initial ones alone, so that ``Slam.rerender`` can predict them.
    """

    initial: int = 2
    rule: NoveltyRule = field(default_factory=lambda: NoveltyRule(threshold=0.1, min_confidence=1.2))
    rerender: bool = True


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackedFrame:
    """Where the camera was, as far as was known when the frame came.

    Args:
        index: of the frame.
        is_keyframe: it was accepted into the memory.
        score: how much of it was new; infinite for the first.
        world_from_cam: (4, 4) rigid; the first frame is the world.
        focal_net: of this frame alone, in network pixels.
        confidence: mean over its pixels.
    """

    index: int
    is_keyframe: bool
    score: float
    world_from_cam: npt.NDArray[np.float64]
    focal_net: float
    confidence: float


class Slam:
    """A camera followed frame by frame."""

    def __init__(self, network: Network, settings: SlamSettings | None = None) -> None:
        self._network = network
        self._settings = settings or SlamSettings()
        self._images: list[EncodedImage] = []  # of the frames that can be shown or predicted again
        self._start_again()

    def _start_again(self) -> None:
        self._frames: list[TrackedFrame] = []
        self._memory: Memory | None = None
        self._discovery = Discovery(self._settings.rule)

    @property
    def frames(self) -> tuple[TrackedFrame, ...]:
        """All so far."""
        return tuple(self._frames)

    @property
    def memory(self) -> Memory:
        """The initial frames and every keyframe after them; there is one as soon as there is a frame."""
        assert self._memory is not None, "no frame was added"
        return self._memory

    @property
    def focal_net(self) -> float:
        """Mean over the frames, each weighted by its mean confidence above 1; in network pixels, NaN without frames.

        Frames whose points lie behind the camera have none and do not count (section 16, number 9).
        """
        known = [(frame.focal_net, frame.confidence - 1) for frame in self._frames if frame.focal_net > 0]
        focals, weights = np.array(known).reshape(-1, 2).T
        return float(weights @ focals / weights.sum()) if weights.sum() > 0 else float("nan")

    def add(self, image: EncodedImage) -> TrackedFrame:
        """Follow one more frame; all frames have one shape.

        Until there are as many as create the memory, each starts everything again, so ``frames`` changes then.

        Raises:
            DegenerateAlignmentError: the frame's points are not finite, or none is confident. No frame can follow.
        """
        index = len(self._frames)
        if self._settings.rerender or index < self._settings.initial:
            self._images.append(image)
        if index < self._settings.initial:
            self._start_again()
            created = init_memory(self._network, self._images)
            self._memory = created.memory
            for raw in created.raw:
                self._track(raw)
        else:
            with self._network.running():
                seen = self._network.decoder.see([image], self.memory)
            if self._track(seen.raw[0]).is_keyframe:
                self._memory = self.memory.extended(seen.remembered)
        return self._frames[-1]

    def _track(self, raw: torch.Tensor) -> TrackedFrame:
        index = len(self._frames)
        pointmaps = self._activated(raw)
        focal_net = _focal_of(pointmaps)
        pointmaps = _with_focal(pointmaps, focal_net, self.focal_net)
        world_from_cam = _world_from_cam(pointmaps) if index else np.eye(4)
        confidence = pointmaps.confidence.cpu().numpy()
        view = View(
            points_world=pointmaps.points_world.cpu().numpy(),
            depth=pointmaps.points_cam[..., 2].cpu().numpy(),
            confidence=confidence,
            centre_world=world_from_cam[:3, 3],
        )
        score = self._discovery.score(view) if index else np.inf
        sure = float(np.quantile(confidence, 0.5, method="lower")) > self._settings.rule.min_confidence
        is_keyframe = not index or (score > self._settings.rule.threshold and sure)
        if is_keyframe:
            self._discovery.add(view)
        frame = TrackedFrame(
            index=index,
            is_keyframe=is_keyframe,
            score=float(score),
            world_from_cam=world_from_cam,
            focal_net=focal_net,
            confidence=float(confidence.mean()),
        )
        self._frames.append(frame)
        return frame

    def rerender(self) -> Iterator[TrackedFrame]:
        """The frames that were kept, predicted against the final memory with the mean focal length.

        The first is not held at the origin. Scores and keyframes are those of the first time.
        """
        for start in range(0, len(self._images), RENDER_BATCH):
            batch = self._images[start : start + RENDER_BATCH]
            for index, raw in enumerate(render(self._network, self.memory, batch, batch_size=len(batch)), start):
                pointmaps = self._activated(raw)
                focal_net = _focal_of(pointmaps)
                pointmaps = _with_focal(pointmaps, focal_net, self.focal_net)
                yield replace(
                    self._frames[index],
                    world_from_cam=_world_from_cam(pointmaps),
                    focal_net=focal_net,
                    confidence=float(pointmaps.confidence.mean()),
                )

    def _activated(self, raw: torch.Tensor) -> Pointmaps:
        return activate(raw, self._network.architecture.decoder.activation)


def _focal_of(pointmaps: Pointmaps) -> float:
    return estimate_focal(pointmaps.points_cam, dtype=np.float64)


def _with_focal(pointmaps: Pointmaps, focal_net: float, wanted_net: float) -> Pointmaps:
    """Depths stretched so that the rays are those of another focal length; as they are where either is unknown."""
    if not (focal_net > 0 and wanted_net > 0):
        return pointmaps
    stretch = torch.tensor([1.0, 1.0, wanted_net / focal_net], device=pointmaps.points_cam.device)
    return replace(pointmaps, points_cam=pointmaps.points_cam * stretch)


def _world_from_cam(pointmaps: Pointmaps) -> npt.NDArray[np.float64]:
    return register_camera(pointmaps.points_cam, pointmaps.points_world, pointmaps.confidence)
