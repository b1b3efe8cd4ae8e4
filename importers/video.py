"""Video files: their frames one after the other, upright, with true times, as far as they can be decoded.

Times are the presentation times of the container, so a variable frame rate does no harm. PyAV is an optional package,
imported when the first video is opened. The next module to read is ``video_frames``, which writes frames as images.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from smust3r_colmap.errors import MissingDependencyError, VideoError
from smust3r_colmap.geometry.arrays import UInt8Array
from smust3r_colmap.importers.frame_selection import VideoFrame

if TYPE_CHECKING:
    import av
    from av.container import InputContainer
    from av.packet import Packet
    from av.video.stream import VideoStream

VIDEO_SUFFIXES = (".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi", ".mts", ".m2ts", ".3gp")
"""Of files taken for videos, in any case."""

_GREY_SIDE_PX = 960
"""Longer side at which sharpness is measured: blur of two pixels shows in video of 1920."""
_MIN_LOSS_S = 0.5
"""The length in the header and the last frame differ by less in sound files."""


class Video:
    """An open video file; iterate once, then ask what was lost.

    Args:
        name: for messages.
        container, stream: open in PyAV.
    """

    def __init__(self, name: str, container: InputContainer, stream: VideoStream) -> None:
        self.name = name
        self._container, self._stream = container, stream
        rate = stream.average_rate or stream.guessed_rate
        self._usual_gap_s = float(1 / rate) if rate else 1 / 30
        self._grey_size: dict[str, int] = {}
        self.num_decoded = 0
        self.num_out_of_order = 0
        self._lost_s = 0.0
        self._end_s = 0.0

    @property
    def duration_s(self) -> float:
        """As the header says; 0 where it does not."""
        if tag := re.fullmatch(r"(\d+):(\d+):([\d.]+)", self._stream.metadata.get("DURATION", "")):  # Matroska
            return 3600 * int(tag[1]) + 60 * int(tag[2]) + float(tag[3])
        if self._stream.duration and self._stream.time_base:
            return float(self._stream.duration * self._stream.time_base)
        return (self._container.duration or 0) / 1e6

    @property
    def whole_seconds(self) -> int:
        """Of the duration, at least 1: what progress is counted in."""
        return max(1, math.ceil(self.duration_s))

    @property
    def lost_s(self) -> float:
        """Seconds that could not be decoded, of the part that was iterated over and of the end that is missing."""
        missing_end_s = self.duration_s - self._end_s
        lost_s = self._lost_s + max(missing_end_s, 0.0)
        return lost_s if lost_s > _MIN_LOSS_S or self._lost_s else 0.0

    def length_s(self) -> float:
        """From the first frame to the end of the last, by the packets of the file; nothing is decoded."""
        times = [float(packet.pts * packet.time_base) for packet in self._packets() if packet.pts is not None]
        return max(times) - min(times) + self._usual_gap_s if times else self.duration_s

    def __iter__(self) -> Iterator[VideoFrame]:
        """The frames that can be decoded, ascending in time; the first has time 0 or later.

        Frames that come with a time before that of an earlier one are left out and counted.
        """
        first_s: float | None = None
        previous_s = -self._usual_gap_s
        for frame, after_fault in self._decoded():
            if first_s is None:
                first_s = min(_time_s(frame, 0.0), 0.0)
            time_s = _time_s(frame, first_s + previous_s + self._usual_gap_s) - first_s
            if self.num_decoded and time_s <= previous_s:
                self.num_out_of_order += 1
                continue
            if after_fault:
                self._lost_s += max(time_s - previous_s - self._usual_gap_s, 0.0)
            self.num_decoded += 1
            shown_s = float(frame.duration * frame.time_base) if frame.duration and frame.time_base else 0.0
            previous_s, self._end_s = time_s, time_s + max(shown_s, self._usual_gap_s)
            yield VideoFrame(time_s=time_s, grey=self._grey(frame), rgb=partial(self._upright_rgb, frame))

    def _decoded(self) -> Iterator[tuple[av.VideoFrame, bool]]:
        """Frames, each with whether something before it could not be decoded.

        What follows a fault is made from pixels that are not there, up to the next key frame.
        """
        from av.error import FFmpegError  # noqa: PLC0415  (an optional package)

        fault = False
        for packet in self._packets():
            try:
                frames = packet.decode()
            except FFmpegError:
                fault = True
                continue
            for frame in frames:
                if frame.is_corrupt or (fault and not frame.key_frame):
                    fault = True
                else:
                    yield frame, fault
                    fault = False

    def _packets(self) -> Iterator[Packet[VideoStream]]:
        """Up to the end, or to where the file is broken."""
        from av.error import FFmpegError  # noqa: PLC0415  (an optional package)

        packets = self._container.demux(self._stream)
        with suppress(FFmpegError):
            yield from packets

    def _grey(self, frame: av.VideoFrame) -> UInt8Array:
        if not self._grey_size:
            width, height = self._square_size(frame)
            scale = min(1.0, _GREY_SIDE_PX / max(width, height))
            self._grey_size = {"width": max(1, round(width * scale)), "height": max(1, round(height * scale))}
        grey = frame.reformat(format="gray", interpolation="AREA", **self._grey_size)
        return np.asarray(grey.to_ndarray(), np.uint8)

    def _upright_rgb(self, frame: av.VideoFrame) -> UInt8Array:
        """(H, W, 3)."""
        width, height = self._square_size(frame)
        pixels = frame.reformat(width=width, height=height, format="rgb24", interpolation="BICUBIC").to_ndarray()
        return _upright(np.asarray(pixels, np.uint8), _display_matrix(frame))

    def _square_size(self, frame: av.VideoFrame) -> tuple[int, int]:
        """Width and height with square pixels, as stored."""
        aspect = self._stream.sample_aspect_ratio
        return round(frame.width * float(aspect)) if aspect else frame.width, frame.height


@contextmanager
def open_video(path: Path, *, name: str, threads: int) -> Iterator[Video]:
    """Open a video to read its frames.

    Args:
        name: for messages.
        threads: of the decoder.

    Raises:
        MissingDependencyError: PyAV is not installed.
        VideoError: the file is no video, or its codec is not known.
    """
    av = import_av()
    try:
        if not path.stat().st_size:
            raise VideoError(f"{name}: the file is empty")
        container = av.open(str(path))
    except (OSError, ValueError) as error:  # FFmpeg's errors are among them
        raise VideoError(f"{name}: {_why_not_opened(error)}") from error
    with container:
        streams = [one for one in container.streams.video if not one.disposition & av.stream.Disposition.attached_pic]
        if not streams:
            kinds = ", ".join(sorted({one.type for one in container.streams})) or "nothing"
            raise VideoError(f"{name}: has no video stream, but {kinds}")
        stream = streams[0]
        if stream.codec_context is None:
            raise VideoError(f"{name}: its codec is not known to PyAV {av.__version__}; convert it, such as to H.264")
        stream.thread_type = "AUTO"
        stream.codec_context.thread_count = threads
        yield Video(name, container, stream)


def import_av() -> Any:
    """PyAV.

    Raises:
        MissingDependencyError: it is not installed.
    """
    try:
        import av  # noqa: PLC0415  (an optional package)
    except ImportError as error:
        raise MissingDependencyError(
            f"video needs PyAV, which cannot be imported ({error}); pip install smust3r-colmap[video]"
        ) from error
    return av


def _why_not_opened(error: Exception) -> str:
    from av.error import InvalidDataError  # noqa: PLC0415  (an optional package)

    if isinstance(error, InvalidDataError):
        return "is no video, or one that was cut off before its index was written"
    return f"cannot be read ({getattr(error, 'strerror', None) or error})"


def _time_s(frame: av.VideoFrame, unknown_s: float) -> float:
    """Presentation time; ``unknown_s`` where the container has none."""
    return unknown_s if frame.pts is None or frame.time is None else float(frame.time)


def _display_matrix(frame: av.VideoFrame) -> tuple[int, int, int, int]:
    """Signs (a, b, c, d) that take stored (x, y) to shown (a x + c y, b x + d y); rotations by multiples of 90 degrees.

    Source: ISO 14496-12, 6.2.2; FFmpeg, libavutil/display.h.
    """
    data: Any = frame.side_data.get("DISPLAYMATRIX")
    if data is None:
        return 1, 0, 0, 1
    a, b, _, c, d = np.frombuffer(bytes(data), np.int32)[:5] / 65536
    if abs(a) + abs(d) >= abs(b) + abs(c):
        return int(np.sign(a)) or 1, 0, 0, int(np.sign(d)) or 1
    return 0, int(np.sign(b)) or 1, int(np.sign(c)) or 1, 0


def _upright(pixels: UInt8Array, matrix: tuple[int, int, int, int]) -> UInt8Array:
    """Turn (H, W, 3) pixels, and mirror them where the matrix does."""
    a, b, c, d = matrix
    if not a and not d:  # shown x comes from stored y
        pixels, a, d = pixels.swapaxes(0, 1), c, b
    return np.ascontiguousarray(pixels[:: 1 if d > 0 else -1, :: 1 if a > 0 else -1])
