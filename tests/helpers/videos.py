"""Small videos of a textured wall that a camera moves along, written by PyAV."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from smust3r_colmap.geometry.arrays import UInt8Array

SIZE = (160, 120)
"""Width and height."""


@cache
def wall(seed: int = 0, *, length: int = 1600, height: int = SIZE[1]) -> UInt8Array:
    """(height, length, 3) blobs of all sizes, that KLT can follow."""
    rng = np.random.default_rng(seed)
    grey = np.zeros((height, length))
    for cell, weight in ((4, 0.35), (12, 0.4), (40, 0.25)):
        coarse = rng.random((height // cell + 2, length // cell + 2))
        grey += weight * cv2.resize(coarse, (length, height), interpolation=cv2.INTER_CUBIC)
    tint = np.array([1.0, 0.9, 0.8])
    return np.asarray(np.clip((grey[:, :, None] - 0.15) * 300 * tint, 0, 255), np.uint8)


def view(at_px: float, *, seed: int = 0) -> UInt8Array:
    """What the camera sees when it stands ``at_px`` along the wall."""
    width, height = SIZE
    shift = np.array([[1, 0, -at_px], [0, 1, 0]], np.float64)
    return np.asarray(cv2.warpAffine(wall(seed), shift, (width, height), flags=cv2.INTER_LINEAR), np.uint8)


def blurred(image: UInt8Array) -> UInt8Array:
    return np.asarray(cv2.blur(image, (9, 9)), np.uint8)


def write_video(
    path: Path,
    images: Iterable[UInt8Array],
    *,
    times_s: Sequence[float] | None = None,
    rate: int = 10,
    codec: str = "libx264",
    key_frame_every: int = 12,
    rotation_deg: int = 0,
    mirrored: bool = False,
    container_options: dict[str, str] | None = None,
    pixel_aspect: Fraction | None = None,
) -> Path:
    """Write a video; ``rotation_deg`` counter-clockwise, as PyAV counts, for players to apply."""
    unit = Fraction(1, 1000)
    with av.open(str(path), "w", options=container_options or {}) as container:
        stream: Any = container.add_stream(codec, rate=rate)
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = unit
        stream.codec_context.gop_size = key_frame_every
        if codec == "libx264":
            stream.options = {"crf": "15", "preset": "ultrafast"}
        if pixel_aspect is not None:
            stream.codec_context.sample_aspect_ratio = pixel_aspect
        if rotation_deg or mirrored:
            stream.set_display_rotation(rotation_deg, hflip=mirrored)
        for number, image in enumerate(images):
            if number == 0:
                stream.height, stream.width = image.shape[:2]
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame.pts = round(1000 * (number / rate if times_s is None else times_s[number]))
            frame.time_base = unit
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def write_sound(path: Path) -> Path:
    """A file without pictures."""
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("aac", rate=44100)
        for number in range(10):
            frame = av.AudioFrame.from_ndarray(np.zeros((2, 1024), np.float32), format="fltp", layout="stereo")
            frame.rate, frame.pts = 44100, number * 1024
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path
