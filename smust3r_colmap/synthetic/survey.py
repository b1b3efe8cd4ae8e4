"""A rendered survey with exact truth: nadir images over hills with painted targets, GPS in EXIF, and control points.

It lies in EPSG:25832 near E 600 000, N 5 300 000, where single precision fails. The lens is a pinhole, which the
reconstruction is not told. ``write_survey`` writes images and lists as a surveyor would hand them over.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from PIL import ExifTags, Image
from scipy.spatial.transform import Rotation

from smust3r_colmap.errors import StorageError
from smust3r_colmap.geometry.arrays import FloatArray, UInt8Array
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres
from smust3r_colmap.georeferencing.crs import parse_crs, transform
from smust3r_colmap.georeferencing.frame import LocalFrame

CRS = "EPSG:25832"
ORIGIN_M = (600000.0, 5300000.0, 500.0)
FLIGHT_HEIGHT_M = 45.0
FOCAL_PX = 720.0
WIDTH, HEIGHT = 800, 600
PIXEL_M = FLIGHT_HEIGHT_M / FOCAL_PX
"""Of the ground, 6 cm."""
GCP_FILE, CHECK_PREFIX = "gcp_list.txt", "CHK"

_STRIPS, _PER_STRIP = 4, 7
_BETWEEN_STRIPS_M, _ALONG_M = 15.0, 9.0
"""70 % of an image's width, and 76 % of its height, are in the next one."""
_TILT_DEG = 3.0
_TEXEL_M = 0.04
_REACH_M = (62.0, 56.0)
_GPS_M = (1.5, 1.5, 3.0)
_TAG_PX = 0.3
_TARGET_M = 0.6
_SUPERSAMPLING = 2
_ROUNDS = 7
"""Of finding where a ray meets the hills; each leaves a fifth of the error or less, so 0.1 mm remain."""
_GPS_SECONDS_DIGITS = 6
_QUALITY = 92


def survey_camera() -> Intrinsics:
    """Of all images."""
    return Intrinsics(model="PINHOLE", width=WIDTH, height=HEIGHT, params=(FOCAL_PX, FOCAL_PX, WIDTH / 2, HEIGHT / 2))


@dataclass(frozen=True, eq=False)
class SurveyScene:
    """Hills with a pattern and painted targets; equal seeds give equal scenes.

    Args:
        seed: of pattern, flight and targets.
    """

    seed: int = 0
    targets_local: FloatArray = field(init=False, repr=False)
    _texture: UInt8Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng((self.seed, 0))
        east, north = np.meshgrid(np.linspace(-24, 24, 5), np.linspace(-26, 26, 4))
        flat = np.column_stack([east.ravel(), north.ravel()]) + rng.uniform(-3, 3, (20, 2))
        object.__setattr__(self, "targets_local", np.column_stack([flat, ground_height(flat)]))
        object.__setattr__(self, "_texture", _paint(rng, flat))

    def cam_from_local(self) -> FloatArray:
        """(N, 3, 4) of the flight: strips to the north and back, tilted by a few degrees."""
        rng = np.random.default_rng((self.seed, 1))
        poses = []
        for strip in range(_STRIPS):
            for k in range(_PER_STRIP):
                along = (k - (_PER_STRIP - 1) / 2) * _ALONG_M * (1 if strip % 2 == 0 else -1)
                centre = np.array([(strip - (_STRIPS - 1) / 2) * _BETWEEN_STRIPS_M, along, FLIGHT_HEIGHT_M])
                tilt = Rotation.from_rotvec(np.radians(rng.normal(size=3) * _TILT_DEG)).as_matrix()
                heading = np.diag([1.0, -1.0, -1.0]) if strip % 2 == 0 else np.diag([-1.0, 1.0, -1.0])
                rotation = tilt @ heading
                poses.append(np.column_stack([rotation, -rotation @ (centre + rng.normal(size=3) * [0.5, 0.5, 1.0])]))
        return np.array(poses)

    def render(self, cam_from_local: FloatArray) -> UInt8Array:
        """(HEIGHT, WIDTH, 3) of a camera above the hills, averaged over each pixel."""
        fine = survey_camera().resized(WIDTH * _SUPERSAMPLING, HEIGHT * _SUPERSAMPLING)
        rotation = cam_from_local[:, :3]
        centre = -rotation.T @ cam_from_local[:, 3]
        rays = fine.rays_cam(pixel_centres(fine.width, fine.height)) @ rotation
        ground = np.zeros(len(rays))
        for _ in range(_ROUNDS):
            flat = centre[:2] + rays[:, :2] * ((ground - centre[2]) / rays[:, 2])[:, None]
            ground = ground_height(flat)
        texels = ((flat + np.array(_REACH_M)) / _TEXEL_M).astype(np.float32).reshape(fine.height, fine.width, 2)
        rgb = cv2.remap(self._texture, texels[..., 0], texels[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        return np.asarray(cv2.resize(rgb, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA), np.uint8)


def ground_height(flat: FloatArray) -> FloatArray:
    """(N,) metres above the origin, of places (N, 2) east and north of it."""
    east, north = flat[:, 0], flat[:, 1]
    height: FloatArray = 3.0 * np.sin(east / 11) * np.cos(north / 14) + 1.5 * np.sin((east + 2 * north) / 9)
    return height


def _paint(rng: np.random.Generator, targets: FloatArray) -> UInt8Array:
    """Blotches of all sizes, and black and white quarters on the targets; row i and column j from the southwest."""
    columns, rows = (int(2 * reach / _TEXEL_M) for reach in _REACH_M)
    picture = np.full((rows, columns, 3), 110, np.float32)
    for cells in (12, 40, 140, 450, 1300):
        coarse = rng.normal(size=(cells * rows // columns + 1, cells, 3)).astype(np.float32)
        picture += 17 * cv2.resize(coarse, (columns, rows), interpolation=cv2.INTER_CUBIC)
    texture = np.clip(picture, 0, 255).astype(np.uint8)
    radius = _TARGET_M / _TEXEL_M
    for east, north in targets:
        x, y = (east + _REACH_M[0]) / _TEXEL_M, (north + _REACH_M[1]) / _TEXEL_M
        j, i = np.meshgrid(
            np.arange(int(x - radius), int(x + radius) + 1), np.arange(int(y - radius), int(y + radius) + 1)
        )
        inside = np.hypot(j - x, i - y) < radius
        texture[i[inside], j[inside]] = np.where((j > x) == (i > y), 255, 0)[inside][:, None]
    return texture


# ------------------------------------------------------------------------------------ files
def write_survey(folder: Path, *, seed: int = 0) -> None:
    """Write ``images/`` with GPS in EXIF, and ``gcp_list.txt`` with 8 control and 12 check points.

    Positions are off by 1.5 m in the plane and 3 m in height per axis, tags by 0.3 pixels. Three fixes are 200 m off.

    Raises:
        StorageError: the folder cannot be written. MissingDependencyError: pyproj is not installed.
    """
    frame = LocalFrame(crs=parse_crs(CRS, "survey"), offset_m=ORIGIN_M)
    scene, rng = SurveyScene(seed), np.random.default_rng((seed, 2))
    poses = scene.cam_from_local()
    names = [f"DJI_{k:04}.jpg" for k in range(1, len(poses) + 1)]
    try:
        (folder / "images").mkdir(parents=True, exist_ok=True)
        for name, pose, degrees in zip(names, poses, _gps(poses, frame, rng), strict=True):
            picture = Image.fromarray(scene.render(pose))
            picture.save(folder / "images" / name, quality=_QUALITY, exif=_exif(degrees))
        (folder / GCP_FILE).write_text(_gcp_list(scene, names, poses, frame, rng), encoding="utf-8")
    except OSError as error:
        raise StorageError(f"{folder}: cannot write the survey: {error}") from error


def _gps(poses: FloatArray, frame: LocalFrame, rng: np.random.Generator) -> FloatArray:
    """(N, 3) longitude, latitude and height with the errors of a receiver."""
    centres = -np.einsum("nji,nj->ni", poses[:, :, :3], poses[:, :, 3])
    measured = centres + rng.normal(size=centres.shape) * _GPS_M
    measured[[4, 13, 22], :2] += [[200, 0], [-120, 160], [0, -200]]
    assert frame.crs is not None
    return transform(frame.crs_from_local(measured), frame.crs, parse_crs("EPSG:4326", "EXIF"))


def _exif(degrees: FloatArray) -> Image.Exif:
    exif = Image.Exif()
    lon, lat, height = degrees.tolist()
    exif[ExifTags.IFD.GPSInfo] = {
        ExifTags.GPS.GPSLatitudeRef: "N",
        ExifTags.GPS.GPSLatitude: _degrees_minutes_seconds(lat),
        ExifTags.GPS.GPSLongitudeRef: "E",
        ExifTags.GPS.GPSLongitude: _degrees_minutes_seconds(lon),
        ExifTags.GPS.GPSAltitudeRef: b"\x00",
        ExifTags.GPS.GPSAltitude: round(height, 3),
    }
    return exif


def _degrees_minutes_seconds(degrees: float) -> tuple[float, float, float]:
    minutes = degrees % 1 * 60
    return float(int(degrees)), float(int(minutes)), round(minutes % 1 * 60, _GPS_SECONDS_DIGITS)


def _gcp_list(
    scene: SurveyScene, names: list[str], poses: FloatArray, frame: LocalFrame, rng: np.random.Generator
) -> str:
    """Every target with its tags in up to six images, as OpenDroneMap has it."""
    camera, lines = survey_camera(), [CRS]
    for k, (target, (x, y, z)) in enumerate(
        zip(scene.targets_local, frame.crs_from_local(scene.targets_local), strict=True)
    ):
        label = f"GCP-{k}" if k in (0, 2, 4, 7, 10, 15, 17, 19) else f"{CHECK_PREFIX}-{k}"
        seen = [(i, camera.xy_img((pose[:, :3] @ target + pose[:, 3])[None])[0]) for i, pose in enumerate(poses)]
        inside = [(i, xy) for i, xy in seen if 10 < xy[0] < WIDTH - 10 and 10 < xy[1] < HEIGHT - 10]
        for row in sorted(rng.permutation(len(inside))[:6].tolist()):
            i, xy = inside[row]
            px, py = xy - 0.5 + rng.normal(size=2) * _TAG_PX
            lines.append(f"{x:.4f} {y:.4f} {z:.4f} {px:.2f} {py:.2f} {names[i]} {label}")
    return "\n".join(lines) + "\n"
