"""What a survey gives: positions of images, and points on the ground with their pixels in images.

Coordinates are those of the source, in the order x (east, longitude), y (north, latitude), z (up); what they mean is
in ``crs``, as it was written. ``origin`` says where each record was read, as ``FILE:LINE`` or the name of an image;
every message about a record begins with it. The readers are ``gps_tags`` and ``survey_files``.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

from smust3r_colmap.errors import InputError

Role = Literal["control", "check", "tie", "horizontal", "vertical"]
"""control: x, y and z hold the model. check: compared only. tie: its tags are compared, its coordinates are not used.
horizontal, vertical: control by x and y only, or by z only."""

ROLES: tuple[Role, ...] = ("control", "check", "tie", "horizontal", "vertical")
_CHECK_PREFIXES = ("chk", "check")

WGS84 = "EPSG:4326"


@dataclass(frozen=True, kw_only=True)
class ImagePosition:
    """Where an image was taken.

    Args:
        image: its name, as the source writes it.
        x, y: in the CRS of the source.
        z: height; None where the source has none.
        sigma_h_m, sigma_v_m: standard deviations, per axis of the horizontal and of the height; None: not given.
        relative_z_m: height above the place of take-off; None: not given.
        up_cam: (3,) unit vector upwards in the frame of the camera (x right, y down, z forward), from gimbal angles;
            None: not given.
        origin: for messages.
    """

    image: str
    x: float
    y: float
    z: float | None = None
    sigma_h_m: float | None = None
    sigma_v_m: float | None = None
    relative_z_m: float | None = None
    up_cam: tuple[float, float, float] | None = None
    origin: str


@dataclass(frozen=True, kw_only=True)
class ImagePositions:
    """The positions of one source.

    Args:
        crs: of all positions, as written.
        crs_origin: where it is written.
        positions: at most one for an image.
        faults: a message for each record that is left out or that something was assumed for.
    """

    crs: str
    crs_origin: str
    positions: tuple[ImagePosition, ...]
    faults: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Tag:
    """A pixel of an image that shows a point.

    Args:
        image: its name, as the source writes it.
        x_px, y_px: in the upright image; the centre of its first pixel is (0.5, 0.5).
        origin: for messages.
    """

    image: str
    x_px: float
    y_px: float
    origin: str


@dataclass(frozen=True, kw_only=True)
class SurveyPoint:
    """A point on the ground.

    Args:
        label: unique in its set.
        x, y: in the CRS of the set.
        z: height; None where the source has none.
        sigma_h_m, sigma_v_m: standard deviations, per axis of the horizontal and of the height; None: not given.
        role: what the point is for.
        tags: at most one for an image.
        origin: for messages.
    """

    label: str
    x: float
    y: float
    z: float | None
    sigma_h_m: float | None = None
    sigma_v_m: float | None = None
    role: Role = "control"
    tags: tuple[Tag, ...] = ()
    origin: str


@dataclass(frozen=True, kw_only=True)
class SurveyPoints:
    """The points of one source; ``crs``, ``crs_origin`` and ``faults`` as in ``ImagePositions``."""

    crs: str
    crs_origin: str
    points: tuple[SurveyPoint, ...]
    faults: tuple[str, ...] = ()


def role_of_label(label: str) -> Role:
    """Check points are named as such: ``CHK-1``, ``check_07``."""
    return "check" if label.lower().startswith(_CHECK_PREFIXES) else "control"


def with_every_kth_as_check(points: Iterable[SurveyPoint], every: int) -> tuple[SurveyPoint, ...]:
    """Every k-th of the control points, in the order given, becomes a check point: the k-th, the 2k-th, ...

    Raises:
        InputError: ``every`` is less than 2, which would leave no control.
    """
    if every < 2:
        raise InputError(f"--check-every {every}: needs 2 or more, else no control point is left")
    changed, count = [], 0
    for point in points:
        count += point.role == "control"
        takes = point.role == "control" and count % every == 0
        changed.append(replace(point, role="check") if takes else point)
    return tuple(changed)
