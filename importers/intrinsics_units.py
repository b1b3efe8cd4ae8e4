"""Intrinsics in another unit than pixels of the image.

Programs write focal length and principal point for the image that a network saw, in parts of the width, in millimetres
of the sensor, or leave the principal point at (0, 0). The principal point tells: it should be near the middle of the
image, and what takes it there takes the focal length along. What has one meaning is mended; what has several is
refused, for poses and points would follow a wrong camera without a word. The next module to read is ``fitted_model``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from smust3r_colmap.errors import InputError

FOCAL_RATIO_RANGE = (0.1, 100.0)
"""Focal length over the longer side. The lower end is that of COLMAP's mapper, below which no lens is; telescopes reach
the upper one."""

MIN_RESCALING = 0.15
RESCALING_TOLERANCE = 0.03
"""A principal point off by 15 % of the centre, and by the same factor in x and y, is one of another resolution:
crops move it in one direction, and real lenses are off by a few percent."""

FILM_WIDTH_MM = 36.0
"""Of 35 mm film; programs that store millimetres often take a sensor of this width."""
WHOLE_FACTORS = (2, 3, 4, 5, 6, 8)
"""By which images are shrunk."""


@dataclass(frozen=True, kw_only=True)
class MendedIntrinsics:
    """Parameters in pixels, and what was done to them; ``what`` is empty where nothing was."""

    params: tuple[float, ...]
    what: str


def in_pixels(
    params: tuple[float, ...], width: int, height: int, *, num_focal: int, place: str, camera: str
) -> MendedIntrinsics:
    """Focal lengths and principal point in pixels of an image of ``width`` x ``height``.

    Args:
        params: of a COLMAP camera: focal lengths, principal point, distortion.
        num_focal: how many of them are focal lengths, 1 or 2.
        place: file and line, for messages.
        camera: its name in messages.

    Raises:
        InputError: a focal length is none, or what its unit is cannot be told.
    """
    focal, (cx, cy), rest = params[:num_focal], params[num_focal : num_focal + 2], params[num_focal + 2 :]
    _refuse_no_length(focal, place, camera)
    mended, what = (*focal, cx, cy), ""
    if abs(cx) < 0.5 / width and abs(cy) < 0.5 / height:
        mended, what = (*focal, width / 2, height / 2), "principal points at (0, 0) were put into the middle"
    elif (factors := _per_axis(cx, cy, width, height)) is not None:
        by_axis = (factors[0], factors[1])[:num_focal]
        mended = (*(f * by for f, by in zip(focal, by_axis, strict=True)), cx * factors[0], cy * factors[1])
        what = "intrinsics in parts of the image's width and height were multiplied by them"
    elif (factor := rescaling(cx, cy, width, height)) is not None:
        factor = _likely(factor, width)
        mended = tuple(value * factor for value in (*focal, cx, cy))
        what = f"intrinsics of another resolution or unit were multiplied by {factor:.4g}"
    _refuse_no_lens(mended[:num_focal], width, height, place, camera, what)
    return MendedIntrinsics(params=(*mended, *rest), what=what)


def rescaling(cx: float, cy: float, width: int, height: int) -> float | None:
    """What takes the principal point to the middle where it is that of a picture of the same shape and another size."""
    x, y = 2 * cx / width, 2 * cy / height
    if min(x, y) <= 0 or min(abs(x - 1), abs(y - 1)) <= MIN_RESCALING:
        return None
    return 2 / (x + y) if abs(x - y) < RESCALING_TOLERANCE * max(x, y) else None


def _per_axis(cx: float, cy: float, width: int, height: int) -> tuple[float, float] | None:
    """Width and height where the principal point is (0.5, 0.5), each in parts of its own side.

    In a square image that is the same as parts of the width.
    """
    near = all(abs(value - 0.5) < MIN_RESCALING / 2 for value in (cx, cy))
    return (float(width), float(height)) if near else None


def _likely(factor: float, width: int) -> float:
    """The factor that a program would have taken, where one is as near as the principal point can tell."""
    candidates = (*map(float, WHOLE_FACTORS), *(1 / whole for whole in WHOLE_FACTORS), width, width / FILM_WIDTH_MM)
    nearest = min(candidates, key=lambda one: abs(math.log(one / factor)))
    return nearest if abs(nearest / factor - 1) < RESCALING_TOLERANCE else factor


def _refuse_no_length(focal: tuple[float, ...], place: str, camera: str) -> None:
    for value in focal:
        if not (math.isfinite(value) and value > 0):
            raise InputError(
                f"{place}: {camera} has focal length {value:g}; it must be positive, in pixels. Was the camera "
                "never estimated (an image without matches), or is the axis reversed? Leave the image out, or write "
                "the focal length of the others"
            )


def _refuse_no_lens(focal: tuple[float, ...], width: int, height: int, place: str, camera: str, what: str) -> None:
    longer = max(width, height)
    low, high = FOCAL_RATIO_RANGE
    for value in focal:
        if low * longer <= value <= high * longer:
            continue
        if value > high * longer:
            why = "no lens has that: was the camera never estimated, or is this another number?"
        else:
            film = value / FILM_WIDTH_MM * width
            why = (
                f"no lens has that: is it in millimetres ({film:.4g} px if the sensor is {FILM_WIDTH_MM:g} mm wide) or "
                f"in parts of the width ({value * width:.4g} px)? Write it in pixels: millimetres over the width of "
                "the sensor, times the width of the image"
            )
        done = f" after {what}" if what else ""
        raise InputError(f"{place}: {camera} has focal length {value:.6g} px{done}, for {width}x{height} px; {why}")
