"""Simulated surveys with exact truth: a flight over hills in EPSG:25832, its model, GPS, and tagged points.

The model is the truth in a frame of its own, so everything that a fit leaves comes from the noise of positions, of tags
and of coordinates. Write it with ``write_model`` for tests of the command.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.georeferencing.crs import parse_crs
from smust3r_colmap.georeferencing.frame import LocalFrame
from smust3r_colmap.georeferencing.georeference import ModelGeometry
from smust3r_colmap.importers.survey import ImagePosition, ImagePositions, Role, SurveyPoint, SurveyPoints, Tag

CAMERA = Intrinsics(model="PINHOLE", width=1024, height=768, params=(900.0, 900.0, 512.0, 384.0))
HEIGHT_M = 45.0
PIXEL_M = HEIGHT_M / 900
"""5 cm."""
FRAME_ORIGIN = (600000.0, 5300000.0, 500.0)


def write_blank_survey(folder: Path) -> Path:
    """The survey of ``demo --survey`` with blank images, because rendering all of them takes a minute."""
    from smust3r_colmap.synthetic.survey import HEIGHT, WIDTH, SurveyScene, write_survey  # noqa: PLC0415

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SurveyScene, "render", lambda *_: np.zeros((HEIGHT, WIDTH, 3), np.uint8))
        write_survey(folder)
    return folder


@dataclass(frozen=True, kw_only=True, eq=False)
class Survey:
    """The truth of a flight.

    Args:
        frame: local frame in EPSG:25832. local_from_model: of the model.
        names: of the images. cam_from_local: (N, 3, 4). ground_local: (P, 3) points of the surface.
    """

    frame: LocalFrame
    local_from_model: Sim3
    names: tuple[str, ...]
    cam_from_local: FloatArray
    ground_local: FloatArray

    @property
    def centres_local(self) -> FloatArray:
        """(N, 3)."""
        centres: FloatArray = -np.einsum("nji,nj->ni", self.cam_from_local[:, :, :3], self.cam_from_local[:, :, 3])
        return centres

    def model(self, *, with_points: bool = True) -> ModelGeometry:
        """What was reconstructed: poses and surface without error, in the frame of the model."""
        model_from_local = self.local_from_model.inverse()
        centres = model_from_local.apply(self.centres_local)
        rotations = self.cam_from_local[:, :, :3] @ self.local_from_model.rotation
        poses = np.concatenate([rotations, -np.einsum("nij,nj->ni", rotations, centres)[:, :, None]], axis=2)
        return ModelGeometry(
            names=self.names,
            cam_from_model=poses,
            cameras=(CAMERA,) * len(self.names),
            points_model=model_from_local.apply(self.ground_local) if with_points else np.zeros((0, 3)),
            pixel_size_model=PIXEL_M / float(self.local_from_model.scale),
        )

    def positions(
        self, rng: np.random.Generator, *, sigma_h: float, sigma_v: float, shift: Iterable[float] = (0, 0, 0)
    ) -> ImagePositions:
        """GPS of all images in EPSG:25832, with noise and one shift for all."""
        noise = rng.normal(size=(len(self.names), 3)) * [sigma_h, sigma_h, sigma_v]
        xyz = self.frame.crs_from_local(self.centres_local + noise + np.array([*shift]))
        rows = [
            ImagePosition(image=name, x=x, y=y, z=z, origin=f"geo.txt:{k}")
            for k, (name, (x, y, z)) in enumerate(zip(self.names, xyz.tolist(), strict=True), start=2)
        ]
        return ImagePositions(crs="EPSG:25832", crs_origin="geo.txt:1", positions=tuple(rows))

    def points(
        self,
        rng: np.random.Generator,
        count: int,
        *,
        tag_px: float = 0.3,
        sigma_m: float = 0.0,
        roles: Iterable[Role] = (),
        max_tags: int = 5,
    ) -> SurveyPoints:
        """Points of the surface that three images or more see, evenly spread; control unless ``roles`` differ."""
        each = [(k, self._views(k)) for k in range(len(self.ground_local))]
        seen = [(k, views) for k, views in each if len(views) >= 3]
        chosen = [seen[int(k)] for k in np.linspace(0, len(seen) - 1, count)]
        wanted = [*roles, *["control"] * count]
        points = []
        for number, (k, views) in enumerate(chosen):
            xyz = self.frame.crs_from_local(self.ground_local[[k]] + rng.normal(size=(1, 3)) * sigma_m)[0]
            picked = rng.permutation(len(views))[:max_tags]
            tags = []
            for row, at in enumerate(picked):
                image, xy = views[int(at)]
                x, y = xy + rng.normal(size=2) * tag_px
                origin = f"gcp_list.txt:{2 + 10 * number + row}"
                tags.append(Tag(image=self.names[image], x_px=float(x), y_px=float(y), origin=origin))
            points.append(
                SurveyPoint(
                    label=f"p{number}",
                    x=float(xyz[0]),
                    y=float(xyz[1]),
                    z=float(xyz[2]),
                    role=wanted[number],  # type: ignore[arg-type]
                    tags=tuple(tags),
                    origin=f"gcp_list.txt:{2 + 10 * number}",
                )
            )
        return SurveyPoints(crs="EPSG:25832", crs_origin="gcp_list.txt:1", points=tuple(points))

    def _views(self, k: int) -> list[tuple[int, FloatArray]]:
        """Images that see a point, and where, away from their borders."""
        found = []
        for i, pose in enumerate(self.cam_from_local):
            xy = CAMERA.xy_img((pose[:, :3] @ self.ground_local[k] + pose[:, 3])[None])[0]
            if 20 < xy[0] < CAMERA.width - 20 and 20 < xy[1] < CAMERA.height - 20:
                found.append((i, xy))
        return found


def make_survey(rng: np.random.Generator, *, rows: int = 6, columns: int = 6, spacing_m: float = 11.0) -> Survey:
    """Nadir images in a grid, tilted by a few degrees, 45 m above hills; one row is a line of flight."""
    x, y = np.meshgrid(spacing_m * np.arange(columns), 1.3 * spacing_m * np.arange(rows))
    count = rows * columns
    level = np.column_stack([x.ravel() - x.mean(), y.ravel() - y.mean(), np.full(count, HEIGHT_M)])
    centres = level + (rng.normal(size=(count, 3)) * [0.5, 0.5, 1.0] if rows > 1 else 0.0)
    reach = np.array([x.max() - x.mean() + 25, y.max() - y.mean() + 18])
    east, north = rng.uniform(-reach, reach, (600, 2)).T
    ground = np.column_stack([east, north, 3 * np.sin(east / 12) * np.cos(north / 15)])
    poses = []
    for centre in centres:
        tilt = rng.normal(size=3) * np.radians([2, 2, 5])
        turn = pycolmap.Rotation3d(tilt).matrix() @ np.diag([1.0, -1.0, -1.0])
        poses.append(np.column_stack([turn, -turn @ centre]))
    rotation = pycolmap.Rotation3d(np.array([0.7, -1.1, 2.0])).matrix()
    return Survey(
        frame=LocalFrame(crs=parse_crs("EPSG:25832", "truth"), offset_m=FRAME_ORIGIN),
        local_from_model=Sim3(scale=np.asarray(7.3), rotation=rotation, translation=np.array([3.0, -8.0, 40.0])),
        names=tuple(f"flight/DJI_{k:04}.JPG" for k in range(count)),
        cam_from_local=np.array(poses),
        ground_local=ground,
    )


def with_moved(positions: ImagePositions, moved: dict[int, tuple[float, float]]) -> ImagePositions:
    """Some positions moved in the plane, by row."""
    rows = [
        replace(one, x=one.x + moved.get(k, (0, 0))[0], y=one.y + moved.get(k, (0, 0))[1])
        for k, one in enumerate(positions.positions)
    ]
    return replace(positions, positions=tuple(rows))


def write_model(survey: Survey, folder: Path) -> None:
    """As a COLMAP text model with the points that images observe."""
    geometry = survey.model()
    folder.mkdir(parents=True)
    params = " ".join(map(str, CAMERA.params))
    (folder / "cameras.txt").write_text(f"1 {CAMERA.model} {CAMERA.width} {CAMERA.height} {params}\n")
    lines: list[str] = []
    tracks: dict[int, list[str]] = {k: [] for k in range(0, len(geometry.points_model), 4)}
    for i, (name, pose) in enumerate(zip(geometry.names, geometry.cam_from_model, strict=True), start=1):
        qx, qy, qz, qw = pycolmap.Rotation3d(pose[:, :3]).quat
        observed: list[str] = []
        for k, track in tracks.items():
            xy = CAMERA.xy_img((pose[:, :3] @ geometry.points_model[k] + pose[:, 3])[None])[0]
            if 0 < xy[0] < CAMERA.width and 0 < xy[1] < CAMERA.height:
                track.append(f"{i} {len(observed)}")
                observed.append(f"{xy[0]!r} {xy[1]!r} {k + 1}".replace("np.float64(", "").replace(")", ""))
        place = " ".join(map(str, pose[:, 3].tolist()))
        lines += [f"{i} {qw} {qx} {qy} {qz} {place} 1 {name}", " ".join(observed)]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    points = [
        f"{k + 1} {' '.join(map(str, geometry.points_model[k].tolist()))} 90 120 60 0.1 {' '.join(track)}"
        for k, track in tracks.items()
        if len(track) > 1
    ]
    (folder / "points3D.txt").write_text("\n".join(points) + "\n")
