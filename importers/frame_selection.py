"""Which frames of a video are worth an image, decided while it is decoded; few frames are in memory.

``choose_frames`` first cuts the video into shots, then takes frames of each shot: by time, or by how far the image has
moved since the last frame that was taken. The next module to read is ``video``, which decodes.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from smust3r_colmap.geometry.arrays import UInt8Array

Points = npt.NDArray[np.float32]

TAKE_FROM, TAKE_AT = 0.025, 0.05
"""Median displacement of the corners since the last frame taken, as a share of the longer image side, between which the
sharpest frame is taken. Neighbours of ordered sets that are known to work have 0.02 to 0.06 (``office_loop``, every 5th
of ``kitchen_rgbd``, ``headset_walk``)."""
MIN_SHARE_FOLLOWED = 0.5
"""Of the corners of the last frame taken; with fewer left a frame is taken, however far the rest has moved."""
SHARPNESS_TOLERANCE = 0.9
"""A later frame is preferred unless its sharpness is below this share: it has seen more that is new."""
CUT_HISTOGRAM_DISTANCE = 0.3
"""Bhattacharyya distance of grey values between consecutive frames of different shots, at least. Within the sets above
it is below 0.28, between images of two of them above 0.36."""
CUT_SHARE_FOLLOWED = 0.05
"""Of the corners of a frame that are found in the next one: at most so many across a cut."""
MAX_FLASH_FRAMES = 3
"""After so many frames unlike those before, it is a cut and no flash of light."""

_TRACKING_SIDE_PX = 320
_MAX_CORNERS, _CORNER_QUALITY, _CORNER_DISTANCE_PX = 150, 0.01, 6
_MIN_CORNERS = 20
_PYRAMID_LEVELS, _WINDOW_PX = 3, (15, 15)
_FORWARD_BACKWARD_PX = 0.7


@dataclass(frozen=True, kw_only=True, eq=False)
class VideoFrame:
    """A decoded frame.

    Args:
        time_s: its presentation time, in seconds from the start of the video.
        grey: (H, W) the luma, may be reduced and not upright; the frames of a video have it in one size.
        rgb: gives the (H, W, 3) upright pixels.
    """

    time_s: float
    grey: UInt8Array
    rgb: Callable[[], UInt8Array]


@dataclass(frozen=True, kw_only=True, eq=False)
class ChosenFrame:
    """A frame that was taken.

    Args:
        frame: the frame.
        shot: number of the shot it belongs to, from 1.
        sharpness: variance of the Laplacian of its grey values; to be compared within a video.
    """

    frame: VideoFrame
    shot: int
    sharpness: float


def choose_frames(frames: Iterable[VideoFrame], *, fps: float | None) -> Iterator[ChosenFrame]:
    """The frames to take, ascending in time.

    Args:
        frames: all frames of a video, ascending in time.
        fps: frames per second of video to take, each the sharpest near the middle of its interval; None takes
            frames by the motion of the image.
    """
    rule = _ByMotion() if fps is None else _ByTime(fps)
    for shot, frame in _shots(frames):
        yield from rule.see(_Look(frame, shot))
    yield from rule.end()


def displacement(before: UInt8Array, after: UInt8Array) -> float:
    """How far the image moved, as a share of its longer side; infinite where the two differ too much.

    Args:
        before, after: (H, W) grey values of one size.
    """
    return _Corners(_small(before)).motion(_small(after))


# ------------------------------------------------------------------------------------ shots
def _shots(frames: Iterable[VideoFrame]) -> Iterator[tuple[int, VideoFrame]]:
    """Each frame with the number of its shot, from 1. The frames of a flash are left out."""
    shot, before = 1, None
    unlike: deque[VideoFrame] = deque()
    """Frames after ``before`` that differ from it: a flash, or the first of the next shot."""
    for frame in frames:
        if before is None or not _is_cut(before.grey, frame.grey):
            unlike.clear()
        else:
            unlike.append(frame)
            if len(unlike) < MAX_FLASH_FRAMES:
                continue
            shot += 1
            while len(unlike) > 1:
                yield shot, unlike.popleft()
            unlike.clear()
        yield shot, frame
        before = frame
    yield from ((shot + 1, frame) for frame in unlike)


def _is_cut(before: UInt8Array, after: UInt8Array) -> bool:
    if _histogram_distance(before, after) < CUT_HISTOGRAM_DISTANCE:
        return False
    corners, small = _Corners(_small(before)), _small(after)
    if len(corners) < _MIN_CORNERS:
        return len(_Corners(small)) >= 2 * _MIN_CORNERS
    return corners.follow(small).share < CUT_SHARE_FOLLOWED


def _histogram_distance(a: UInt8Array, b: UInt8Array) -> float:
    one, other = (cv2.calcHist([grey], [0], None, [64], [0, 256]) / grey.size for grey in (a, b))
    return float(cv2.compareHist(one, other, cv2.HISTCMP_BHATTACHARYYA))


# ------------------------------------------------------------------------------------ rules
class _Look:
    """A frame of a shot, with what a rule asks of it."""

    def __init__(self, frame: VideoFrame, shot: int) -> None:
        self.frame, self.shot = frame, shot
        _, deviation = cv2.meanStdDev(cv2.Laplacian(frame.grey, cv2.CV_16S))
        self.sharpness = float(deviation[0, 0] ** 2)
        self.small = _small(frame.grey)

    def chosen(self) -> ChosenFrame:
        return ChosenFrame(frame=self.frame, shot=self.shot, sharpness=self.sharpness)


class _ByTime:
    """The sharpest frame of the middle half of each interval, or the one nearest to it."""

    def __init__(self, fps: float) -> None:
        self._fps = fps
        self._start_s: float | None = None
        self._interval = 0
        self._best: tuple[tuple[bool, float], _Look] | None = None

    def see(self, look: _Look) -> Iterator[ChosenFrame]:
        """The frame to take of an interval that is over."""
        if self._start_s is None:
            self._start_s = look.frame.time_s
        # a frame at the border belongs to the later interval, whatever rounding says
        position = (look.frame.time_s - self._start_s) * self._fps + 1e-6
        interval = math.floor(position)
        if interval != self._interval:
            yield from self.end()
            self._interval = interval
        off_centre = abs(position - interval - 0.5)
        merit = (True, look.sharpness) if off_centre <= 0.25 else (False, -off_centre)
        if self._best is None or merit > self._best[0]:
            self._best = merit, look

    def end(self) -> Iterator[ChosenFrame]:
        """What is left to take."""
        if self._best is not None:
            yield self._best[1].chosen()
            self._best = None


class _ByMotion:
    """A frame is taken when the image has moved enough since the last one: the sharpest before it moved too far.

    The first of a shot is the sharpest before the image moves at all.
    """

    def __init__(self) -> None:
        self._shot = 0
        self._corners: _Corners
        self._taken = False
        self._best: _Look | None = None

    def see(self, look: _Look) -> Iterator[ChosenFrame]:
        """The frame to take, where the image has moved enough."""
        if look.shot != self._shot:
            yield from self.end()
            self._shot, self._taken, self._corners = look.shot, False, _Corners(look.small)
        moved = self._corners.motion(look.small)
        if self._best is not None and moved > (TAKE_AT if self._taken else TAKE_FROM):
            yield self._best.chosen()
            self._taken, self._corners, self._best = True, _Corners(self._best.small), None
            moved = self._corners.motion(look.small)
        if self._taken and moved < TAKE_FROM:
            self._best = None  # what was beyond was blurred or covered, not far away
        elif self._best is None or look.sharpness >= SHARPNESS_TOLERANCE * self._best.sharpness:
            self._best = look

    def end(self) -> Iterator[ChosenFrame]:
        """What is left to take."""
        if self._best is not None:
            yield self._best.chosen()
            self._best = None


# --------------------------------------------------------------------------------- tracking
@dataclass(frozen=True, kw_only=True)
class _Followed:
    """Which corners were found again.

    Args:
        share: of the corners.
        displacement: their median, as a share of the longer image side; 0 where none was found.
    """

    share: float
    displacement: float


class _Corners:
    """Corners of one image, followed into later ones from where they were seen last (KLT, forward and backward)."""

    def __init__(self, grey: UInt8Array) -> None:
        found = cv2.goodFeaturesToTrack(grey, _MAX_CORNERS, _CORNER_QUALITY, _CORNER_DISTANCE_PX)
        self._start: Points = np.empty((0, 1, 2), np.float32) if found is None else np.asarray(found, np.float32)
        self._last = self._start.copy()
        self._grey = grey

    def __len__(self) -> int:
        return len(self._start)

    def motion(self, grey: UInt8Array) -> float:
        """Displacement in ``grey``; infinite where too many corners are lost.

        Where the image shows nothing to follow, infinite as soon as there is something to see.
        """
        if len(self) < _MIN_CORNERS:
            return math.inf if len(_Corners(grey)) >= 2 * _MIN_CORNERS else 0.0
        followed = self.follow(grey)
        return math.inf if followed.share < MIN_SHARE_FOLLOWED else followed.displacement

    def follow(self, grey: UInt8Array) -> _Followed:
        """Find the corners in another image of the same size."""
        settings: Any = {"winSize": _WINDOW_PX, "maxLevel": _PYRAMID_LEVELS, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
        there, found, _ = cv2.calcOpticalFlowPyrLK(self._grey, grey, self._start, self._last.copy(), **settings)
        back, found_back, _ = cv2.calcOpticalFlowPyrLK(grey, self._grey, there, self._start.copy(), **settings)
        error_px, moved_px = (np.linalg.norm((points - self._start)[:, 0], axis=1) for points in (back, there))
        good = (found[:, 0] > 0) & (found_back[:, 0] > 0) & (error_px < _FORWARD_BACKWARD_PX)
        self._last[good] = there[good]
        median_px = float(np.median(moved_px[good])) if good.any() else 0.0
        return _Followed(share=float(good.mean()), displacement=median_px / max(grey.shape))


def _small(grey: UInt8Array) -> UInt8Array:
    """At the size at which corners are followed."""
    scale = _TRACKING_SIDE_PX / max(grey.shape)
    if scale >= 1:
        return grey
    size = (max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale)))
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)
