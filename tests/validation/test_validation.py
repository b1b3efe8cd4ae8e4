"""Validation: every rule has a model that breaks it and it alone, and one that keeps them all."""

from __future__ import annotations

import json
import math
import random
import shutil
import sqlite3
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from PIL import Image

from smust3r_colmap.errors import ConfigError, InputError, StorageError
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.importers.colmap_records import Repairs, read_records
from smust3r_colmap.validation.description import CAMERA_MODELS, Defect, ImageFile, Rig, Subject
from smust3r_colmap.validation.layout import UnreadableModelError, find_layout
from smust3r_colmap.validation.projection import index_of, project
from smust3r_colmap.validation.readers import READERS, find_readers
from smust3r_colmap.validation.report import EXIT_REFUSED, EXIT_UNREADABLE, judge, verdicts
from smust3r_colmap.validation.rules import RULES, Severity, apply_rules
from smust3r_colmap.validation.surroundings import (
    read_database,
    read_dense,
    read_depth,
    read_image_folder,
    read_ply,
)
from smust3r_colmap.validation.transforms_file import read_transforms
from smust3r_colmap.validation.validate import describe, read_model, validate

WIDTH, HEIGHT, NUM_IMAGES, NUM_POINTS = 256, 192, 6, 60
ALWAYS = {"camera-model-PINHOLE"}
"""The one fact about the good model that some reader minds."""


# ---------------------------------------------------------------------------- a scene without fault
@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """SCENE with everything that can lie in it, and all of it right."""
    folder = tmp_path_factory.mktemp("scene")
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=NUM_IMAGES)
    options.num_points3D = NUM_POINTS
    options.camera_width, options.camera_height = WIDTH, HEIGHT
    options.camera_model_id = pycolmap.CameraModelId.PINHOLE
    options.camera_params = [300.0, 300.0, WIDTH / 2, HEIGHT / 2]
    with pycolmap.Database.open(folder / "database.db") as database:
        model = pycolmap.synthesize_dataset(options, database)
    for point in model.points3D.values():
        point.color = np.array([10, 20, 30], np.uint8)
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    model.write_binary(sparse)
    names = [image.name for image in model.images.values()]
    for name in names:
        write_image(folder / "images" / name, WIDTH, HEIGHT)
        write_image(folder / "images_2" / name, WIDTH // 2, HEIGHT // 2)
        write_image(folder / "masks" / f"{name}.png", WIDTH, HEIGHT)
        write_image(folder / "masks" / f"{Path(name).stem}.png", WIDTH, HEIGHT)
        write_image(folder / "depths" / f"{Path(name).stem}.png", 8, 6)
        write_map(folder / "stereo" / "depth_maps" / f"{name}.geometric.bin", WIDTH, HEIGHT, 1)
        write_map(folder / "stereo" / "normal_maps" / f"{name}.geometric.bin", WIDTH, HEIGHT, 3)
    (folder / "stereo" / "fusion.cfg").write_text("\n".join(names) + "\n")
    params = {Path(name).stem: {"scale": 1.0 + number / 10, "offset": 0} for number, name in enumerate(names)}
    (sparse / "depth_params.json").write_text(json.dumps(params))
    write_ply(sparse / "points3D.ply", np.array([point.xyz for point in model.points3D.values()]))
    shutil.copy(sparse / "points3D.ply", folder / "sparse_pc.ply")
    (folder / "transforms.json").write_text(json.dumps(transforms_of(model)))
    return folder


def transforms_of(model: pycolmap.Reconstruction) -> dict[str, Any]:
    """With camera axes of OpenGL, in a world that is turned, scaled and moved."""
    turned, frames = np.array([[0.0, 0, 2], [2, 0, 0], [0, 2, 0]]), []
    for image in model.images.values():
        world_from_cam = image.cam_from_world().inverse()
        matrix = np.eye(4)
        matrix[:3, :3] = turned / 2 @ world_from_cam.rotation.matrix() @ np.diag([1, -1, -1])
        matrix[:3, 3] = turned @ world_from_cam.translation + (1, 2, 3)
        mask = f"masks/{Path(image.name).stem}.png"
        frames.append({"file_path": f"images/{image.name}", "mask_path": mask, "transform_matrix": matrix.tolist()})
    intrinsics = {"w": WIDTH, "h": HEIGHT, "fl_x": 300.0, "fl_y": 300.0, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    return {"camera_model": "PINHOLE", **intrinsics, "ply_file_path": "sparse_pc.ply", "frames": frames}


def write_image(path: Path, width: int, height: int, orientation: int = 1) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = Image.new("L", (width, height))
    exif = image.getexif()
    exif[0x0112] = orientation
    image.save(path, exif=exif)


def write_map(path: Path, width: int, height: int, channels: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(f"{width}&{height}&{channels}&".encode() + bytes(4 * width * height * channels))


PLY_COLUMNS = {
    **dict.fromkeys(("x", "y", "z", "nx", "ny", "nz"), "float"),
    **dict.fromkeys(("red", "green", "blue"), "uchar"),
}


def write_ply(
    path: Path, xyz: Any, columns: Mapping[str, str] = PLY_COLUMNS, form: str = "binary_little_endian"
) -> None:
    codes = {"float": "f4", "uchar": "u1", "double": "f8"}
    order = ">" if "big" in form else "<"
    rows = np.zeros(len(xyz), [(name, order + codes[kind]) for name, kind in columns.items()])
    for axis, name in enumerate("xyz"):
        rows[name] = xyz[:, axis]
    properties = "".join(f"property {kind} {name}\n" for name, kind in columns.items())
    head = f"ply\nformat {form} 1.0\ncomment made by hand\nelement vertex {len(xyz)}\n{properties}end_header\n"
    body = rows.tobytes()
    if form == "ascii":
        body = "".join(" ".join(repr(float(value)) for value in row) + "\n" for row in rows.tolist()).encode()
    path.write_bytes(head.encode() + body)


@pytest.fixture(scope="module")
def good(scene: Path) -> Subject:
    return describe(find_layout(scene, images=None, database=None), ask_colmap=False)


@pytest.fixture(scope="module")
def bare(good: Subject) -> Subject:
    """The model alone, so that renaming an image does not lose its file."""
    return Subject(model=good.model, projection=good.projection)


def found_in(subject: Subject) -> set[str]:
    return set(apply_rules(subject, RULES.values()))


def test_the_good_scene_has_everything_and_breaks_no_rule(good: Subject) -> None:
    parts = (good.images, good.masks, good.database, good.ply, good.depth, good.dense, good.transforms)

    assert all(part is not None for part in parts)
    assert set(good.downscaled) == {2}
    assert found_in(good) == ALWAYS


# ---------------------------------------------------------------------------- one model for every rule
Edit = Callable[[Subject], Subject]
Files = tuple[ImageFile, ...]


def with_model(subject: Subject, **changes: Any) -> Subject:
    model = replace(subject.model, **changes)
    return replace(subject, model=model, projection=project(model))


def with_images(subject: Subject, **changes: Any) -> Subject:
    return with_model(subject, images=replace(subject.model.images, **changes))


def with_points(subject: Subject, **changes: Any) -> Subject:
    assert subject.model.points is not None
    return with_model(subject, points=replace(subject.model.points, **changes))


def with_camera(subject: Subject, **changes: Any) -> Subject:
    return with_model(subject, cameras=tuple(replace(camera, **changes) for camera in subject.model.cameras))


def with_names(*first: str) -> Edit:
    return lambda subject: with_images(subject, names=(*first, *subject.model.images.names[len(first) :]))


def with_defect(rule: str) -> Edit:
    defect = Defect(rule=rule, where="a.bin, byte 3", text="is wrong")
    return lambda subject: with_model(subject, defects=(defect,))


def with_text(subject: Subject) -> Subject:
    return with_model(subject, form="text")


def at(values: Any, index: Any, value: Any) -> Any:
    """A copy with one value changed."""
    changed = np.array(values)
    changed[index] = value
    return changed


def with_tracks(subject: Subject, tracks: list[list[tuple[int, int]]]) -> Subject:
    """Other tracks, and observations that agree with them."""
    points, images = subject.model.points, subject.model.images
    assert points is not None
    elements = np.array([element for track in tracks for element in track], np.int64).reshape(-1, 2)
    lengths = [len(track) for track in tracks]
    owners = np.repeat(points.ids, lengths)
    point_ids = np.full(len(images.point_ids), -1)
    index = index_of(images.ids, elements[:, 0])
    there = index >= 0
    point_ids[images.starts[index[there]] + elements[there, 1]] = owners[there]
    return with_model(
        subject,
        points=replace(
            points,
            starts=np.cumsum([0, *lengths]),
            track_images=elements[:, 0],
            track_rows=elements[:, 1],
        ),
        images=replace(images, point_ids=point_ids),
    )


def tracks_of(subject: Subject) -> list[list[tuple[int, int]]]:
    points = subject.model.points
    assert points is not None
    elements = list(zip(points.track_images.tolist(), points.track_rows.tolist(), strict=True))
    return [elements[start:end] for start, end in zip(points.starts[:-1], points.starts[1:], strict=True)]


def with_first_tracks(count: int, track: Callable[[list[tuple[int, int]]], list[tuple[int, int]]]) -> Edit:
    def edit(subject: Subject) -> Subject:
        tracks = tracks_of(subject)
        return with_tracks(subject, [track(old) if number < count else old for number, old in enumerate(tracks)])

    return edit


def with_observed(image: int, count: int) -> Edit:
    """Keep ``count`` observations of one image that name a point, in tracks and observations alike."""

    def edit(subject: Subject) -> Subject:
        image_id, kept, tracks = int(subject.model.images.ids[image]), 0, []
        for track in tracks_of(subject):
            others = [element for element in track if element[0] != image_id]
            if len(others) < len(track) and kept < count:
                kept, others = kept + 1, track
            tracks.append(others)
        return with_tracks(subject, tracks)

    return edit


def renamed_point(old: int, new: int) -> Edit:
    def edit(subject: Subject) -> Subject:
        points, images = subject.model.points, subject.model.images
        assert points is not None
        return with_model(
            subject,
            points=replace(points, ids=np.where(points.ids == old, new, points.ids)),
            images=replace(images, point_ids=np.where(images.point_ids == old, new, images.point_ids)),
        )

    return edit


def free_row(subject: Subject) -> int:
    """An observation of the first image that names no point."""
    images = subject.model.images
    return int(np.flatnonzero(images.point_ids[: images.starts[1]] == -1)[0])


def with_files(subject: Subject, change: Callable[[Files], Files]) -> Subject:
    """Other image files; without smaller copies, which would no longer go with them."""
    assert subject.images is not None
    return replace(subject, images=replace(subject.images, files=change(subject.images.files)), downscaled={})


def with_first_file(**changes: Any) -> Edit:
    return lambda subject: with_files(subject, lambda files: (replace(files[0], **changes), *files[1:]))


def with_masks(change: Callable[[Files], Files]) -> Edit:
    def edit(subject: Subject) -> Subject:
        assert subject.masks is not None
        return replace(subject, masks=replace(subject.masks, files=change(subject.masks.files)))

    return edit


def part(name: str, **changes: Any) -> Edit:
    """Change one of the things beside the model."""
    return lambda subject: replace(subject, **{name: replace(getattr(subject, name), **changes)})


def with_database_image(**changes: Any) -> Edit:
    def edit(subject: Subject) -> Subject:
        assert subject.database is not None
        first, *others = subject.database.images
        return part("database", images=(replace(first, **changes), *others))(subject)

    return edit


def with_frame(**changes: Any) -> Edit:
    def edit(subject: Subject) -> Subject:
        first, *others = subject.model.frames or ()
        return with_model(subject, frames=(replace(first, **changes), *others))

    return edit


def one_camera_per_image(subject: Subject) -> Subject:
    (camera,) = subject.model.cameras
    ids = subject.model.images.ids
    return with_model(
        subject,
        cameras=tuple(replace(camera, camera_id=int(one_id)) for one_id in ids),
        images=replace(subject.model.images, camera_ids=ids),
    )


def second_camera(**changes: Any) -> Edit:
    """The last image gets a camera of its own."""

    def edit(subject: Subject) -> Subject:
        (camera,) = subject.model.cameras
        images = subject.model.images
        return with_model(
            subject,
            cameras=(camera, replace(camera, camera_id=2, **changes)),
            images=replace(images, camera_ids=at(images.camera_ids, -1, 2)),
        )

    return edit


def shifted_world(offset: float) -> Edit:
    """The same model with its origin elsewhere."""

    def edit(subject: Subject) -> Subject:
        images, points = subject.model.images, subject.model.points
        assert points is not None
        shift = np.array([offset, 0, 0])
        translation = images.translation - np.einsum("nij,j->ni", images.rotation, shift)
        frames = tuple(
            replace(frame, translation=tuple(translation[index].tolist()))
            for index, frame in enumerate(subject.model.frames or ())
        )
        return with_model(
            subject,
            images=replace(images, translation=translation),
            points=replace(points, xyz=points.xyz + shift),
            frames=frames,
        )

    return edit


def without_frames(subject: Subject) -> Subject:
    return with_model(subject, frames=None, rigs=None)


def unobserved(subject: Subject) -> Subject:
    """No track and no observation."""
    return with_tracks(subject, [[]] * NUM_POINTS)


UNOBSERVED = {"tracks-all-missing", "image-unobserved"}


def opposite(subject: Subject) -> Subject:
    """The first image turns its back on all points, and nobody says that it sees one."""
    unseeing = without_frames(with_observed(0, 0)(subject))
    w, x, y, z = unseeing.model.images.quat_wxyz[0]
    turned = at(unseeing.model.images.quat_wxyz, 0, [-y, z, w, -x])  # half a turn about the camera's y axis
    translation = unseeing.model.images.translation
    return with_images(unseeing, quat_wxyz=turned, translation=at(translation, 0, translation[0] * [-1, 1, -1]))


def far_camera(subject: Subject) -> Subject:
    """The first image goes straight back, so that it still looks at the points."""
    unseeing = without_frames(with_observed(0, 0)(subject))
    return with_images(unseeing, translation=at(unseeing.model.images.translation, 0, [0, 0, 200.0]))


def point_behind(subject: Subject) -> Subject:
    """One point, seen by two images, lies a little behind the first of them."""
    images = subject.model.images
    short = with_first_tracks(1, lambda track: track[:2])(subject)
    assert short.model.points is not None
    first = int(index_of(images.ids, short.model.points.track_images[:1])[0])
    behind = images.centre_world[first] - 0.01 * images.rotation[first, 2]
    return with_points(short, xyz=at(short.model.points.xyz, 0, behind))


def track_of_free_row(subject: Subject) -> Subject:
    """The first track names one more observation, which names no point itself."""
    points = subject.model.points
    assert points is not None
    return with_points(
        subject,
        starts=np.concatenate([[0], points.starts[1:] + 1]),
        track_images=np.concatenate([subject.model.images.ids[:1], points.track_images]),
        track_rows=np.concatenate([[free_row(subject)], points.track_rows]),
    )


def misplaced_observations(subject: Subject) -> Subject:
    xy_img = subject.model.images.xy_img
    inwards = np.sign(np.array([WIDTH / 2, HEIGHT / 2]) - xy_img)
    return with_images(subject, xy_img=xy_img + 2 * inwards)


def observations_outside(subject: Subject) -> Subject:
    """Two of a hundred observations, those next to the left border, slip over it."""
    images = subject.model.images
    used = np.flatnonzero(images.point_ids != -1)
    leftmost = used[np.argsort(images.xy_img[used, 0])[: len(used) // 50]]
    return with_images(subject, xy_img=at(images.xy_img, (leftmost, 0), -0.5))


def outlier_point(subject: Subject) -> Subject:
    loose = with_first_tracks(1, lambda track: [])(subject)
    assert loose.model.points is not None
    return with_points(loose, xyz=at(loose.model.points.xyz, 0, [900.0, 0, 0]))


def point_nowhere(subject: Subject) -> Subject:
    assert subject.model.points is not None
    return with_points(subject, xyz=at(subject.model.points.xyz, (0, 2), np.inf))


def points_none(subject: Subject) -> Subject:
    return with_points(
        unobserved(subject),
        ids=np.empty(0, np.int64),
        xyz=np.empty((0, 3)),
        rgb=np.empty((0, 3), np.uint8),
        starts=np.zeros(1, np.int64),
    )


def images_none(subject: Subject) -> Subject:
    none = {name: getattr(subject.model.images, name)[:0] for name in ("ids", "camera_ids", "names", "point_ids")}
    empty = replace(
        subject.model.images,
        **none,
        quat_wxyz=np.empty((0, 4)),
        translation=np.empty((0, 3)),
        starts=np.zeros(1, np.int64),
        xy_img=np.empty((0, 2)),
    )
    return without_frames(with_model(unobserved(subject), images=empty))


def camera_params(*params: float, model: str = "PINHOLE") -> Edit:
    """Other intrinsics of a model without observations, so that no reprojection error tells."""
    return lambda subject: with_camera(unobserved(subject), model=model, params=params)


CX, CY = WIDTH / 2, HEIGHT / 2
NAN = float("nan")

Case = tuple[Edit, set[str]]
"""What to change, and which other rules it cannot but break; a minus stands before one that it mends."""

FROM_BARE: dict[str, Case] = {
    "name-blank": (with_names("my image.png"), set()),
    "name-blank-in-text": (lambda bare: with_text(with_names("my image.png")(bare)), {"name-blank", "text-only"}),
    "name-comma": (with_names("a,b.png"), set()),
    "name-subfolder": (with_names("left/a.png"), set()),
    "name-two-dots": (with_names("a.b.png"), set()),
    "name-not-relative": (with_names("C:a.png"), set()),
    "name-duplicate": (with_names("a.png", "a.png"), set()),
    "name-case-clash": (with_names("a.png", "A.png"), set()),
    "name-stem-clash": (with_names("a.png", "a.jpg"), set()),
    "name-ending-clash": (with_names("1.png", "11.png"), set()),
    "id-duplicate": (lambda bare: with_model(bare, cameras=bare.model.cameras * 2), {"camera-id-not-one"}),
    "id-zero": (renamed_point(1, 0), set()),
    "id-too-large": (
        lambda bare: with_camera(with_images(bare, camera_ids=np.full(NUM_IMAGES, 2**31)), camera_id=2**31),
        {"camera-id-not-one"},
    ),
    "point-id-huge": (renamed_point(1, 10**9), set()),
    "camera-model-unknown": (lambda bare: with_camera(bare, model="MIRROR"), {"-camera-model-PINHOLE"}),
    "camera-missing": (lambda bare: with_images(bare, camera_ids=at(bare.model.images.camera_ids, 0, 7)), set()),
    "camera-unused": (
        lambda bare: with_model(bare, cameras=(*bare.model.cameras, replace(bare.model.cameras[0], camera_id=2))),
        {"camera-id-not-one"},
    ),
    "camera-per-image": (one_camera_per_image, {"camera-id-not-one"}),
    "camera-id-not-one": (second_camera(), set()),
    "camera-kinds-mixed": (
        second_camera(model="OPENCV_FISHEYE", params=(300.0, 300.0, CX, CY, 0, 0, 0, 0)),
        {"camera-id-not-one", "camera-model-OPENCV_FISHEYE"},
    ),
    "camera-size-zero": (
        lambda bare: with_camera(unobserved(bare), width=0),
        {*UNOBSERVED, "principal-point-off-centre"},
    ),
    "camera-not-finite": (lambda bare: with_camera(bare, params=(300.0, 300.0, CX, NAN)), set()),
    "principal-point-off-centre": (lambda bare: with_camera(bare, params=(300.0, 300.0, CX + 1.5, CY)), set()),
    "intrinsics-other-resolution": (camera_params(150.0, 150.0, CX / 2, CY / 2), UNOBSERVED),
    "focal-absurd": (camera_params(20.0, 20.0, CX, CY), UNOBSERVED),
    "focal-unequal": (camera_params(300.0, 250.0, CX, CY), UNOBSERVED),
    "distortion-absurd": (
        camera_params(300.0, CX, CY, 1.5, model="SIMPLE_RADIAL"),
        {*UNOBSERVED, "camera-model-SIMPLE_RADIAL", "-camera-model-PINHOLE"},
    ),
    "images-none": (images_none, {"tracks-all-missing", "camera-unused"}),
    "image-unobserved": (with_observed(0, 0), set()),
    "image-weak": (with_observed(0, 14), set()),
    "image-looks-away": (opposite, {"image-unobserved"}),
    "points-none": (points_none, {"image-unobserved"}),
    "points-file-missing": (lambda bare: with_model(unobserved(bare), points=None), {"image-unobserved"}),
    "points-colourless": (lambda bare: with_points(bare, rgb=np.zeros((NUM_POINTS, 3), np.uint8)), set()),
    "tracks-all-missing": (unobserved, {"image-unobserved"}),
    "tracks-short": (with_first_tracks(NUM_POINTS // 2 + 1, lambda track: track[:2]), set()),
    "track-none": (with_first_tracks(3, lambda track: []), set()),
    "track-single": (with_first_tracks(3, lambda track: track[:1]), set()),
    "track-pseudo-zero": (with_first_tracks(3, lambda track: [(0, 0)] * 3), set()),
    "track-repeats": (with_first_tracks(3, lambda track: [*track, track[-1]]), set()),
    "track-dangling": (with_first_tracks(3, lambda track: [*track, (77, 0)]), set()),
    "track-disagrees": (track_of_free_row, set()),
    "observation-dangling": (
        lambda bare: with_images(bare, point_ids=at(bare.model.images.point_ids, free_row(bare), 9999)),
        set(),
    ),
    "observation-one-sided": (
        lambda bare: with_images(bare, point_ids=at(bare.model.images.point_ids, free_row(bare), 5)),
        set(),
    ),
    "observation-not-finite": (
        lambda bare: with_images(bare, xy_img=at(bare.model.images.xy_img, (free_row(bare), 0), NAN)),
        set(),
    ),
    "observation-outside": (observations_outside, set()),
    "reprojection-high": (misplaced_observations, set()),
    "pose-not-finite": (
        lambda bare: with_images(bare, translation=at(bare.model.images.translation, (0, 1), NAN)),
        set(),
    ),
    "pose-quaternion": (
        lambda bare: with_images(without_frames(bare), quat_wxyz=bare.model.images.quat_wxyz * 1.01),
        set(),
    ),
    "coordinates-large": (shifted_world(1e6), set()),
    "outlier-cameras": (far_camera, {"image-unobserved"}),
    "outlier-points": (outlier_point, {"track-none"}),
    "point-behind-camera": (point_behind, set()),
    "point-not-finite": (point_nowhere, set()),
    "rigs-incomplete": (lambda bare: with_model(bare, rigs=None), set()),
    "rig-not-trivial": (lambda bare: with_model(bare, rigs=(Rig(rig_id=1, sensors=((0, 1), (0, 2))),)), set()),
    "frame-dangling": (with_frame(data=((0, 1, 77),)), set()),
    "frame-pose-differs": (with_frame(translation=(1.0, 2.0, 3.0)), set()),
    "text-only": (with_text, set()),
    "text-simple-pinhole": (
        lambda bare: with_text(with_camera(bare, model="SIMPLE_PINHOLE", params=(300.0, CX, CY))),
        {"text-only", "camera-model-SIMPLE_PINHOLE", "-camera-model-PINHOLE"},
    ),
    "model-without-number": (lambda bare: with_model(bare, folder=Path("scene/sparse")), set()),
    "model-not-largest": (lambda bare: replace(bare, siblings={"0": 6, "1": 7}), {"model-one-of-several"}),
    "model-one-of-several": (lambda bare: replace(bare, siblings={"0": 6, "1": 2}), set()),
    "file-unreadable": (lambda bare: with_model(bare, unread=("cameras.txt",)), {"-camera-model-PINHOLE"}),
    "colmap-cannot-read": (lambda bare: replace(bare, unread_by_colmap="IndexError: at"), set()),
    **{
        name: (with_defect(name), set[str]())
        for name in (
            *("file-truncated", "file-trailing-bytes", "text-bad-line"),
            *("text-observations-missing", "text-last-line-empty", "text-and-binary-differ"),
        )
    },
}


def with_first_frame(**changes: Any) -> Edit:
    def edit(good: Subject) -> Subject:
        assert good.transforms is not None
        first, *others = good.transforms.frames
        return part("transforms", frames=(replace(first, **changes), *others))(good)

    return edit


def with_first_matrix(change: Callable[[FloatArray], FloatArray]) -> Edit:
    def edit(good: Subject) -> Subject:
        assert good.transforms is not None
        matrix = change(good.transforms.frames[0].world_from_opengl.copy())
        return with_first_frame(world_from_opengl=matrix)(good)

    return edit


def moved(matrix: FloatArray) -> FloatArray:
    return np.asarray(matrix + np.pad([[0.5]], ((0, 3), (3, 0))))


def colmap_axes(good: Subject) -> Subject:
    """Whoever forgets to turn the axes of the cameras."""
    assert good.transforms is not None
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = tuple(replace(f, world_from_opengl=f.world_from_opengl @ flip) for f in good.transforms.frames)
    return part("transforms", frames=frames)(good)


def without_endings(good: Subject) -> Subject:
    """As instant-ngp's own scenes name images; it finds them."""
    assert good.transforms is not None
    frames = tuple(replace(f, file_path=f.file_path.removesuffix(".png")) for f in good.transforms.frames)
    by_ending = {k.removesuffix(".png"): v for k, v in good.transforms.images.items() if k[0] == "i"}
    masks = {k: v for k, v in good.transforms.images.items() if k[0] != "i"}
    return part("transforms", frames=frames, images=masks, images_by_ending=by_ending)(good)


FROM_GOOD: dict[str, Case] = {
    "transforms-unreadable": (part("transforms", problem="it has no list of frames", frames=()), set()),
    "transforms-image-missing": (
        lambda good: part("transforms", images={k: v for k, v in good.transforms.images.items() if k[0] != "i"})(good),  # type: ignore[union-attr]
        set(),
    ),
    "transforms-sharp-image-missing": (
        lambda good: part("transforms", images={k: v for k, v in good.transforms.images.items() if k[0] != "i"})(  # type: ignore[union-attr]
            part("transforms", has_sharpness=True)(good)
        ),
        set(),
    ),
    "transforms-image-ending": (without_endings, set()),
    "transforms-comments": (part("transforms", has_comments=True), set()),
    "transforms-masks-incomplete": (with_first_frame(mask_path=""), set()),
    "transforms-points-missing": (part("transforms", ply_is_there=False), set()),
    "transforms-camera-model": (part("transforms", camera_model="FOV"), set()),
    "transforms-intrinsics": (with_first_frame(numbers={"w": WIDTH, "h": HEIGHT, "fl_x": 0.0}), set()),
    "transforms-size-differs": (
        with_first_frame(numbers={"w": 512.0, "h": HEIGHT, "fl_x": 1.0, "fl_y": 1.0, "cx": 0.0, "cy": 0.0}),
        set(),
    ),
    "transforms-pose-not-rigid": (with_first_matrix(lambda matrix: matrix * 1.1), set()),
    "transforms-images-differ": (
        lambda good: part("transforms", frames=good.transforms.frames[1:])(good),  # type: ignore[union-attr]
        set(),
    ),
    "transforms-cameras-differ": (with_first_matrix(moved), set()),
    "image-file-missing": (lambda good: with_files(good, lambda files: files[1:]), set()),
    "image-file-extra": (
        lambda good: with_files(good, lambda files: (*files, replace(files[0], name="zz.png"))),
        set(),
    ),
    "image-file-unreadable": (with_first_file(width=0, height=0), set()),
    "image-size-resized": (with_first_file(width=2 * WIDTH, height=2 * HEIGHT), set()),
    "image-size-differs": (with_first_file(width=2 * WIDTH), set()),
    "image-exif-turned": (with_first_file(turned=True), set()),
    "image-exif-against-camera": (with_first_file(width=HEIGHT, height=WIDTH, turned=True), set()),
    "downscaled-list-differs": (
        lambda good: replace(good, downscaled={2: replace(good.downscaled[2], files=good.downscaled[2].files[1:])}),
        set(),
    ),
    "downscaled-size-differs": (lambda good: replace(good, downscaled={4: good.downscaled[2]}), set()),
    "mask-missing": (with_masks(lambda files: files[2:]), set()),
    "mask-one-naming": (with_masks(lambda files: files[1:]), set()),
    "mask-size-differs": (with_masks(lambda files: (replace(files[0], width=3), *files[1:])), set()),
    "ply-unreadable": (part("ply", problem="it has no PLY header"), set()),
    "ply-incomplete": (part("ply", properties=frozenset({"x", "y", "z", "nx", "ny", "nz"})), set()),
    "ply-stale": (lambda good: part("ply", xyz=1.1 * good.ply.xyz)(good), set()),  # type: ignore[union-attr]
    "depth-params-unreadable": (part("depth", problem="KeyError: 'scale'"), set()),
    "depth-params-without-png": (part("depth", pngs=frozenset()), set()),
    "depth-png-without-params": (part("depth", params=None), set()),
    "depth-scale-ignored": (
        lambda good: part("depth", params={**good.depth.params, next(iter(good.depth.params)): (9.0, 0.0)})(good),  # type: ignore[union-attr, arg-type, dict-item]
        set(),
    ),
    "dense-config-dangling": (part("dense", fusion_names=("nobody.png",)), set()),
    "dense-map-size": (
        lambda good: part("dense", depth_sizes=dict.fromkeys(good.dense.depth_sizes, (8, 6)))(good),  # type: ignore[union-attr]
        set(),
    ),
    "dense-normals-missing": (part("dense", normal_maps=frozenset()), set()),
    "database-unreadable": (part("database", problem="file is not a database"), set()),
    "database-image-missing": (with_database_image(name="other.png"), set()),
    "database-image-id-differs": (with_database_image(image_id=99), set()),
    "database-camera-id-differs": (with_database_image(camera_id=99), set()),
    "database-frame-id-differs": (with_database_image(frame_id=99), set()),
    "database-keypoints-differ": (with_database_image(num_keypoints=99), set()),
    "database-camera-differs": (part("database", cameras={1: (1, 2 * WIDTH, HEIGHT)}), set()),
}


def expected(rule: str, others: set[str]) -> set[str]:
    mended = {other[1:] for other in others if other.startswith("-")}
    return (ALWAYS - mended) | {rule} | {other for other in others if not other.startswith("-")}


@pytest.mark.parametrize("rule", FROM_BARE)
def test_a_model_can_break_this_rule_alone(bare: Subject, rule: str) -> None:
    edit, others = FROM_BARE[rule]

    assert found_in(edit(bare)) == expected(rule, others)


def test_fifteen_observations_are_enough_and_half_of_the_points_are_not_most(bare: Subject) -> None:
    half_short = with_first_tracks(NUM_POINTS // 2, lambda track: track[:2])

    assert found_in(with_observed(0, 15)(bare)) == ALWAYS
    assert found_in(half_short(bare)) == ALWAYS


@pytest.mark.parametrize("rule", FROM_GOOD)
def test_what_lies_beside_a_model_can_break_this_rule_alone(good: Subject, rule: str) -> None:
    edit, others = FROM_GOOD[rule]

    assert found_in(edit(good)) == expected(rule, others)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda matrix: matrix * np.array([[1, 1, 1, 1]] * 3 + [[2] * 4]), "the last row is 0 0 0 2"),
        (lambda matrix: matrix @ np.diag([-1, 1, 1, 1]), "the axes are left-handed"),
        (lambda matrix: matrix @ np.diag([1.01, 1, 1, 1]), "from orthonormal"),
        (lambda matrix: matrix * NAN, "not 4 x 4 finite numbers"),
    ],
)
def test_it_is_said_why_a_matrix_is_no_pose(
    good: Subject, change: Callable[[FloatArray], FloatArray], what: str
) -> None:
    found = apply_rules(with_first_matrix(change)(good), RULES.values())

    assert set(found) == ALWAYS | {"transforms-pose-not-rigid"}
    assert what in found["transforms-pose-not-rigid"].text


def test_axes_of_colmap_are_told_by_half_a_turn(good: Subject) -> None:
    found = apply_rules(colmap_axes(good), RULES.values())

    assert set(found) == ALWAYS | {"transforms-cameras-differ"}
    assert "1.8e+02 degrees" in found["transforms-cameras-differ"].text


@pytest.mark.parametrize("name", CAMERA_MODELS)
def test_every_camera_model_is_told(bare: Subject, name: str) -> None:
    camera = pycolmap.Camera.create_from_model_name(1, name, 300.0, WIDTH, HEIGHT)
    subject = with_camera(unobserved(bare), model=name, params=tuple(camera.params.tolist()))

    assert {rule for rule in found_in(subject) if rule.startswith("camera-model-")} == {f"camera-model-{name}"}
    assert CAMERA_MODELS[name].number == pycolmap.CameraModelId.__members__[name].value


def test_every_rule_has_a_case() -> None:
    by_model = {f"camera-model-{name}" for name in CAMERA_MODELS}

    assert set(FROM_BARE) | set(FROM_GOOD) | by_model == set(RULES)


# ---------------------------------------------------------------------------- the readers
READER_NAMES = [reader.name for reader in READERS]


def verdicts_of(subject: Subject) -> dict[str, str]:
    findings = judge(apply_rules(subject, RULES.values()), RULES, READERS)
    return {verdict.reader.name: verdict.verdict for verdict in verdicts(findings, READERS)}


@pytest.mark.parametrize("reader", READERS, ids=READER_NAMES)
def test_a_reader_names_rules_that_exist_and_says_what_happens(reader: Any) -> None:
    named = {**reader.refuses, **reader.warns}

    assert named.keys() <= RULES.keys()
    assert not reader.refuses.keys() & reader.warns.keys()
    assert all(named.values())


@pytest.mark.parametrize(
    ("edit", "refusing", "warning"),
    [
        (lambda bare: bare, set(), set()),
        (with_names("left/a.png"), {"3DGS-2023"}, set()),
        (
            lambda bare: with_camera(bare, model="SIMPLE_RADIAL", params=(300.0, CX, CY, 0.0)),
            {"3DGS", "3DGS-2023", "OpenMVS"},
            set(),
        ),
        (with_text, {"OpenSplat"}, set()),
        (one_camera_per_image, set(), {"nerfstudio"}),
        (unobserved, {"gsplat", "instant-ngp", "3DGS-depth"}, {"COLMAP"}),
    ],
    ids=["good", "subfolders", "SIMPLE_RADIAL", "text", "camera per image", "no tracks"],
)
def test_readers_judge_as_they_were_seen_to(bare: Subject, edit: Edit, refusing: set[str], warning: set[str]) -> None:
    """The scenes on which the programs themselves were run (OpenSplat and OpenMVS: by their source)."""
    judged = verdicts_of(edit(bare))

    assert {name for name, verdict in judged.items() if verdict == "refuses"} == refusing
    assert {name for name, verdict in judged.items() if verdict == "warns"} == warning


def test_what_is_wrong_by_itself_is_refused_by_everybody(bare: Subject) -> None:
    assert set(verdicts_of(with_names("a.png", "a.png")(bare)).values()) == {"refuses"}


def test_a_finding_is_as_bad_as_what_it_does_to_the_readers_asked_for(bare: Subject) -> None:
    evidence = apply_rules(with_names("left/a.png")(bare), RULES.values())

    (finding,) = judge(evidence, RULES, find_readers(["3dgs-2023"]))

    assert (finding.rule.name, finding.severity) == ("name-subfolder", Severity.REFUSED)
    assert judge(evidence, RULES, find_readers(["gsplat"])) == ()


def test_an_unknown_reader_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="--readers postshot: no such reader; there are COLMAP, 3DGS"):
        find_readers(["COLMAP", "Postshot"])


# ---------------------------------------------------------------------------- parsing
@pytest.fixture
def model(tmp_path: Path) -> pycolmap.Reconstruction:
    """A small model, written as text and as binary into the folders txt and bin."""
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=2, num_cameras_per_rig=2, num_frames_per_rig=2, num_points3D=9)
    reconstruction = pycolmap.synthesize_dataset(options)
    for form in ("txt", "bin"):
        (tmp_path / form).mkdir()
    reconstruction.write_text(tmp_path / "txt")
    reconstruction.write_binary(tmp_path / "bin")
    return reconstruction


def test_text_and_binary_give_what_pycolmap_has(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    for form in ("txt", "bin"):
        read = read_model(tmp_path / form)
        assert read.points is not None
        assert read.defects == ()
        assert {camera.camera_id: camera.params for camera in read.cameras} == {
            camera_id: tuple(camera.params) for camera_id, camera in model.cameras.items()
        }
        for index, (image_id, name) in enumerate(zip(read.images.ids, read.images.names, strict=True)):
            image = model.images[image_id]
            rows = slice(read.images.starts[index], read.images.starts[index + 1])
            assert name == image.name
            np.testing.assert_allclose(
                read.images.rotation[index], image.cam_from_world().rotation.matrix(), atol=1e-12
            )
            np.testing.assert_allclose(read.images.centre_world[index], image.projection_center(), atol=1e-12)
            np.testing.assert_array_equal(read.images.xy_img[rows], [point.xy for point in image.points2D])
            assert read.images.num_observed[index] == image.num_points3D
        for index, point_id in enumerate(read.points.ids.tolist()):
            point = model.points3D[point_id]
            rows = slice(read.points.starts[index], read.points.starts[index + 1])
            np.testing.assert_array_equal(read.points.xyz[index], point.xyz)
            elements = zip(read.points.track_images[rows].tolist(), read.points.track_rows[rows].tolist(), strict=True)
            assert list(elements) == [(element.image_id, element.point2D_idx) for element in point.track.elements]
        assert {rig.rig_id: len(rig.sensors) for rig in read.rigs or ()} == {1: 2, 2: 2}
        assert {frame.frame_id: sorted(frame.image_ids) for frame in read.frames or ()} == {
            frame_id: sorted(data.id for data in frame.data_ids) for frame_id, frame in model.frames.items()
        }


def test_projection_errors_are_those_of_pycolmap(good: Subject, scene: Path) -> None:
    reference = pycolmap.Reconstruction(scene / "sparse" / "0")
    reference.update_point_3d_errors()
    assert good.model.points is not None
    noisy = misplaced_observations(good)

    assert np.abs(good.projection.error_px).max() < 1e-6
    np.testing.assert_allclose(noisy.projection.error_px, np.hypot(2, 2), atol=1e-6)
    assert reference.compute_mean_reprojection_error() == pytest.approx(0, abs=1e-6)
    assert (good.projection.depth > 0).all()


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"])
def test_a_binary_file_cut_anywhere_is_named_and_never_crashes(
    model: pycolmap.Reconstruction, tmp_path: Path, file: str
) -> None:
    path = tmp_path / "bin" / file
    whole = path.read_bytes()
    for length in (0, 5, 8, 9, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        read = read_model(tmp_path / "bin")
        if whole[:length] == bytes(8):
            continue
        assert [defect.rule for defect in read.defects] == ["file-truncated"], length
        assert file in read.defects[0].where


def test_the_place_of_a_break_is_told(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    path = tmp_path / "bin" / "points3D.bin"
    path.write_bytes(path.read_bytes()[:-1])
    size = path.stat().st_size
    read = read_model(tmp_path / "bin")

    (defect,) = read.defects
    assert defect.text == f"ends inside record 9 of 9: {size:,} bytes are too few"
    assert read.points is not None
    assert len(read.points) == 8


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"])
def test_bytes_behind_the_last_record_are_told(model: pycolmap.Reconstruction, tmp_path: Path, file: str) -> None:
    path = tmp_path / "bin" / file
    path.write_bytes(path.read_bytes() + b"abc")

    (defect,) = read_model(tmp_path / "bin").defects
    assert (defect.rule, defect.text.split(" follow")[0]) == ("file-trailing-bytes", "3 bytes")
    assert defect.where.startswith(file)


def test_random_bytes_end_in_findings_and_not_in_errors(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    paths = sorted((tmp_path / "bin").glob("*.bin"))
    whole = {path: path.read_bytes() for path in paths}
    for path in paths * 8:
        damaged = bytearray(whole[path])
        for place in rng.integers(8, len(damaged), 3):
            damaged[place] = rng.integers(256)
        path.write_bytes(damaged)
        with np.errstate(all="ignore"):
            read = read_model(tmp_path / "bin")
            apply_rules(Subject(model=read, projection=project(read)), RULES.values())
        path.write_bytes(whole[path])


def test_an_unknown_camera_number_is_told(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    path = tmp_path / "bin" / "cameras.bin"
    content = bytearray(path.read_bytes())
    content[12:16] = (99).to_bytes(4, "little")
    path.write_bytes(content)

    (defect,) = read_model(tmp_path / "bin").defects
    assert "camera model number 99" in defect.text


def edit_lines(path: Path, change: Callable[[list[str]], list[str]]) -> None:
    """Change the lines that are no comments."""
    lines = path.read_text().split("\n")
    head = [line for line in lines if line.startswith("#")]
    path.write_text("\n".join([*head, *change([line for line in lines[len(head) :] if line])]) + "\n")


def test_a_lost_line_of_observations_is_told_with_its_line(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    edit_lines(tmp_path / "txt" / "images.txt", lambda lines: [*lines[:3], *lines[4:]])
    read = read_model(tmp_path / "txt")

    (defect,) = read.defects
    assert defect.rule == "text-observations-missing"
    assert defect.where == "images.txt, line 7"
    assert len(read.images) == len(model.images)
    assert read.images.num_rows[1] == 0
    assert read.images.num_rows[2] > 0


def test_a_lost_last_line_is_told(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    edit_lines(tmp_path / "txt" / "images.txt", lambda lines: lines[:-1])

    assert [defect.rule for defect in read_model(tmp_path / "txt").defects] == ["text-observations-missing"]


def test_empty_observation_lines_are_right_and_the_last_is_a_fact(
    model: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    path = tmp_path / "txt" / "images.txt"
    edit_lines(path, lambda lines: [line if number % 2 == 0 else "" for number, line in enumerate(lines)])
    read = read_model(tmp_path / "txt")

    assert [defect.rule for defect in read.defects] == ["text-last-line-empty"]
    assert len(read.images) == len(model.images)


@pytest.mark.parametrize(
    ("file", "line", "where", "text"),
    [
        ("cameras.txt", "1 PINHOLE 640 480 500 500 320", "line 4", "PINHOLE has 4 parameters, not 3"),
        ("cameras.txt", "1 PINHOLE", "line 4", "an id, a model, a width and a height"),
        ("images.txt", "1 0 0 0 1 0 0 0", "line 5", "neither an image nor"),
        ("points3D.txt", "1 0 0", "line 4", "is no point"),
        ("points3D.txt", "1 0 0 zero 1 1 1 1", "line 4", "is no point"),
        ("points3D.txt", "1 0 0 0 1 1 1 1 5", "line 4", "is no point"),
        ("rigs.txt", "1 1 SONAR 1", "line 4", "sensor type 'SONAR'"),
        ("frames.txt", "1 1 1 0 0 0 0 0 0 2 CAMERA 1 1", "line 4", "the line ends early"),
    ],
)
def test_a_line_that_cannot_be_read_is_named_and_the_rest_is_kept(
    model: pycolmap.Reconstruction, tmp_path: Path, file: str, line: str, where: str, text: str
) -> None:
    before = read_model(tmp_path / "txt")
    edit_lines(tmp_path / "txt" / file, lambda lines: [line, *lines])
    read = read_model(tmp_path / "txt")

    (defect,) = read.defects
    assert (defect.rule, defect.where) == ("text-bad-line", f"{file}, {where}")
    assert text in defect.text
    assert (len(read.images), len(read.cameras)) == (len(before.images), len(before.cameras))
    assert read.points is not None
    assert len(read.points) == 9


HUGE = 2**63 + 1


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("file", "line", "text"),
    [
        ("cameras.txt", f"{HUGE} PINHOLE 640 480 500 500 320 240", "its id is not from 0 to 4294967294"),
        ("cameras.txt", "4294967295 PINHOLE 640 480 500 500 320 240", "its id is not from 0 to 4294967294"),
        ("cameras.txt", "-1 PINHOLE 640 480 500 500 320 240", "its id is not from 0 to 4294967294"),
        ("cameras.txt", f"9 PINHOLE {2**64} 480 500 500 320 240", "its size has more than 64 bits"),
        ("cameras.txt", f"9 PINHOLE 640 {10**30} 500 500 320 240", "its size has more than 64 bits"),
        ("images.txt", f"{HUGE} 1 0 0 0 0 0 0 1 a.png\n1 2 -1", "an id that is not from 0 to 4294967294"),
        ("images.txt", f"9 1 0 0 0 0 0 0 {10**30} a.png\n", "an id that is not from 0 to 4294967294"),
        ("images.txt", "4294967295 1 0 0 0 0 0 0 1 a.png\n1 2 -1", "an id that is not from 0 to 4294967294"),
        ("points3D.txt", f"{2**64} 0 0 0 1 1 1 1", "id (below 2^64)"),
        ("points3D.txt", f"{2**64 - 1} 0 0 0 1 1 1 1", "id (below 2^64)"),
        ("points3D.txt", "nan 0 0 0 1 1 1 1", "id (below 2^64)"),
        ("points3D.txt", "1e300 0 0 0 1 1 1 1", "id (below 2^64)"),
        ("points3D.txt", "-1 0 0 0 1 1 1 1", "id (below 2^64)"),
        ("points3D.txt", "99 0 0 0 1 1 1 1 nan 0", "track in pairs (below 2^32)"),
        ("points3D.txt", f"99 0 0 0 1 1 1 1 1 {HUGE}", "track in pairs (below 2^32)"),
        ("points3D.txt", "99 0 0 0 1 1 1 1 4294967295 0", "track in pairs (below 2^32)"),
    ],
)
def test_a_line_with_a_number_that_is_no_id_is_named_and_the_rest_is_kept(
    model: pycolmap.Reconstruction, tmp_path: Path, file: str, line: str, text: str
) -> None:
    before = read_model(tmp_path / "txt")
    edit_lines(tmp_path / "txt" / file, lambda lines: [line, *lines])
    subject = describe(find_layout(tmp_path / "txt", images=None, database=None), ask_colmap=False)
    evidence = apply_rules(subject, RULES.values())["text-bad-line"]

    assert evidence.count == 1
    assert evidence.text.startswith(f"{file}, line {5 if file == 'images.txt' else 4}: ")
    assert text in evidence.text
    assert subject.model.cameras == before.cameras
    assert subject.model.images.names == before.images.names
    np.testing.assert_array_equal(subject.model.images.point_ids, before.images.point_ids)
    assert subject.model.points is not None
    assert len(subject.model.points) == 9


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("point_id", ["nan", "1.5", "-2", "1e300", str(2**64)])
def test_an_observation_of_a_point_that_is_no_id_is_named(
    model: pycolmap.Reconstruction, tmp_path: Path, point_id: str
) -> None:
    edit_lines(tmp_path / "txt" / "images.txt", lambda lines: [lines[0], f"{lines[1]} 1 2 {point_id}", *lines[2:]])
    read = read_model(tmp_path / "txt")

    assert [(defect.rule, defect.where) for defect in read.defects] == [("text-bad-line", "images.txt, line 6")]
    assert read.images.num_rows[0] == 0


@pytest.mark.filterwarnings("error")
def test_the_largest_ids_and_sizes_that_colmap_has_are_read_to_the_last_digit(
    model: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    """Above 2^63 as from binary files, where the ids of points are read with a sign."""
    folder = tmp_path / "txt"
    edit_lines(folder / "cameras.txt", lambda _: [f"{2**32 - 2} PINHOLE {2**64 - 1} 480 500 500 320 240"])
    edit_lines(
        folder / "images.txt",
        lambda _: [f"{2**32 - 2} 1 0 0 0 0 0 0 {2**32 - 2} a.png", f"1 2 {2**64 - 2} 3 4 {2**64 - 3} 5 6 -1"],
    )
    points = [f"{2**64 - 2 - index} 0 0 1 1 1 1 1 {2**32 - 2} {index}" for index in range(2)]
    edit_lines(folder / "points3D.txt", lambda _: points)
    (folder / "rigs.txt").unlink()
    (folder / "frames.txt").unlink()
    subject = describe(find_layout(folder, images=None, database=None), ask_colmap=False)
    found = found_in(subject)

    assert subject.model.defects == ()
    assert subject.model.points is not None
    assert subject.model.points.ids.tolist() == [-2, -3]
    assert subject.model.images.point_ids.tolist() == [-2, -3, -1]
    assert {"id-too-large", "point-id-huge"} <= found
    assert not {"id-duplicate", "observation-dangling", "track-dangling", "track-disagrees"} & found


@pytest.mark.filterwarnings("error")
def test_nasty_words_in_text_end_in_findings_and_not_in_errors(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    rng = random.Random(0)
    nasty = ("nan", "-inf", "-1", "0", "1e300", str(2**32 - 1), str(HUGE), str(2**64 - 1), "9" * 5000, "1.5", "x", "")
    for path in sorted((tmp_path / "txt").glob("*.txt")) * 30:
        whole = path.read_text()
        words = whole.split(" ")
        for _ in range(3):
            words[rng.randrange(len(words))] = rng.choice(nasty)
        path.write_text(" ".join(words))
        with np.errstate(all="ignore"):  # places as far away as 1e300
            read = read_model(tmp_path / "txt")
            found = apply_rules(Subject(model=read, projection=project(read)), RULES.values())
        assert all(evidence.text for evidence in found.values())
        path.write_text(whole)


def test_a_bad_line_of_observations_costs_that_image_its_observations(
    model: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    edit_lines(tmp_path / "txt" / "images.txt", lambda lines: [lines[0], lines[1] + " 3.5", *lines[2:]])
    read = read_model(tmp_path / "txt")

    assert [defect.where for defect in read.defects] == ["images.txt, line 6"]
    assert read.images.num_rows[0] == 0
    assert read.images.num_rows[1] > 0


def test_blanks_in_names_and_windows_lines_survive_the_text(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    path = tmp_path / "txt" / "images.txt"
    name = read_model(tmp_path / "txt").images.names[0]
    path.write_bytes(path.read_bytes().replace(name.encode(), b"my first image.png").replace(b"\n", b"\r\n"))
    read = read_model(tmp_path / "txt")

    assert read.images.names[0] == "my first image.png"
    assert read.defects == ()


def test_no_point_may_be_written_as_minus_one_or_as_the_largest_number(
    model: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    path = tmp_path / "txt" / "images.txt"
    before = read_model(tmp_path / "txt").images.point_ids
    path.write_text(path.read_text().replace(" -1", f" {2**64 - 1}"))

    np.testing.assert_array_equal(read_model(tmp_path / "txt").images.point_ids, before)
    assert (before == -1).sum() > 5


def test_exports_with_made_up_tracks_are_told(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    """As a neighbouring project writes them: three pairs `0 0` for every point, no observations."""
    edit_lines(
        tmp_path / "txt" / "points3D.txt", lambda lines: [" ".join([*line.split()[:8], *"000000"]) for line in lines]
    )
    edit_lines(
        tmp_path / "txt" / "images.txt",
        lambda lines: [line if number % 2 == 0 else "" for number, line in enumerate(lines)],
    )
    read = read_model(tmp_path / "txt")
    evidence = apply_rules(Subject(model=read, projection=project(read)), RULES.values())

    assert evidence["track-pseudo-zero"].count == 9
    assert "track-dangling" not in evidence
    assert "track-repeats" not in evidence


def test_two_forms_of_one_model_must_agree(model: pycolmap.Reconstruction, tmp_path: Path) -> None:
    for path in (tmp_path / "bin").iterdir():
        path.rename(tmp_path / "txt" / path.name)
    agreeing = read_model(tmp_path / "txt")
    edit_lines(tmp_path / "txt" / "points3D.txt", lambda lines: lines[1:])
    (fewer,) = read_model(tmp_path / "txt").defects
    edit_lines(tmp_path / "txt" / "images.txt", lambda lines: lines[2:])
    (missing,) = read_model(tmp_path / "txt").defects

    assert (agreeing.form, agreeing.defects) == ("binary", ())
    assert fewer.text == "9 points in .bin, 8 in .txt"
    assert "is in one form only (8 images in .bin, 7 in .txt)" in missing.text


def test_lines_that_cannot_be_read_are_told_instead_of_a_difference_to_the_other_form(
    model: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    for path in (tmp_path / "bin").iterdir():
        path.rename(tmp_path / "txt" / path.name)
    (tmp_path / "txt" / "images.txt").write_text("no images\n")
    bad_text = read_model(tmp_path / "txt")
    (tmp_path / "txt" / "images.bin").write_bytes(b"no images")
    bad_both = read_model(tmp_path / "txt")

    assert [(defect.rule, defect.where) for defect in bad_text.defects] == [("text-bad-line", "images.txt, line 1")]
    assert (bad_text.unread, bad_both.unread) == ((), ("images.bin",))
    assert [defect.rule for defect in bad_both.defects] == ["file-truncated", "text-bad-line"]


@pytest.mark.parametrize("form", ["txt", "bin"])
@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
def test_a_file_in_which_nothing_can_be_read_has_no_other_findings_than_that(
    model: pycolmap.Reconstruction, tmp_path: Path, part: str, form: str
) -> None:
    (tmp_path / form / f"{part}.{form}").write_text("garbage is no model\nand never was\n")
    report = validate(tmp_path / form, ask_colmap=True)
    noted = "text-bad-line" if form == "txt" else "file-truncated"

    assert report.exit_code == EXIT_UNREADABLE
    assert [finding.rule.name for finding in report.findings] == ["file-unreadable", noted]
    assert report.findings[0].evidence.text == f"{part}.{form}"
    assert report.findings[1].evidence.text.startswith(f"{part}.{form}, ")


def test_a_model_with_nothing_in_it_can_be_read(tmp_path: Path) -> None:
    for part in ("cameras", "images", "points3D"):
        (tmp_path / f"{part}.txt").write_text("# nothing\n")
    report = validate(tmp_path, ask_colmap=False)

    assert report.exit_code == EXIT_REFUSED
    assert {"images-none", "points-none"} <= {finding.rule.name for finding in report.findings}
    assert "camera-id-not-one" not in {finding.rule.name for finding in report.findings}
    assert "text, 0 images, 0 cameras, 0 points" in report.render_text()


def test_refine_is_advised_for_lost_lines_of_observations_and_reads_them(
    model: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    edit_lines(tmp_path / "txt" / "images.txt", lambda lines: lines[::2])
    report = validate(tmp_path / "txt", ask_colmap=False)
    (line,) = [line for line in report.render_text().splitlines() if "[text-observations-missing]" in line]
    repairs = Repairs()

    assert "Do: `smust3r-colmap refine MODEL --images DIR`" in line
    assert "Nobody can use it" not in line
    assert len(read_records(tmp_path / "txt", repairs).images) == len(model.images)
    assert "8 images without a line of observations" in repairs.texts()[0]


# ---------------------------------------------------------------------------- what lies beside
def test_every_form_of_ply_gives_the_same_points(tmp_path: Path) -> None:
    xyz = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    path = tmp_path / "points3D.ply"
    columns = {**PLY_COLUMNS, "quality": "double"}
    for form in ("binary_little_endian", "binary_big_endian", "ascii"):
        write_ply(path, xyz, columns, form)
        cloud = read_ply(path)
        assert (cloud.problem, cloud.properties) == ("", frozenset(columns))
        np.testing.assert_allclose(cloud.xyz, xyz, rtol=1e-6)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"solid", "no PLY header"),
        (b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n", "no vertices with x, y and z"),
        (b"ply\nformat ascii 1.0\nelement face 2\nend_header\n", "first element is 'face'"),
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\nproperty float y\n"
            b"property float z\nend_header\n" + bytes(30),
            "ends after 2 of 9 vertices",
        ),
        (
            b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n"
            b"property float z\nend_header\n1 2 3\n4 5\n",
            "5 numbers for 2 vertices of 3 columns",
        ),
    ],
)
def test_a_ply_that_cannot_be_read_says_why(tmp_path: Path, content: bytes, problem: str) -> None:
    path = tmp_path / "points3D.ply"
    path.write_bytes(content)

    assert problem in read_ply(path).problem


def test_a_ply_of_the_same_points_in_another_order_is_not_stale(good: Subject) -> None:
    assert good.ply is not None
    shuffled = replace(good.ply, xyz=good.ply.xyz[::-1])

    assert found_in(replace(good, ply=shuffled)) == ALWAYS


def test_image_headers_tell_size_turn_and_damage(tmp_path: Path) -> None:
    write_image(tmp_path / "a.jpg", 40, 30, orientation=6)
    write_image(tmp_path / "sub" / "b.png", 20, 10)
    (tmp_path / "c.jpg").write_bytes(b"no image")
    (tmp_path / "notes.txt").write_text("no image")
    write_image(tmp_path / ".hidden.jpg", 4, 4)
    turned, broken, flat = read_image_folder(tmp_path).files

    assert (turned.name, turned.width, turned.height, turned.turned) == ("a.jpg", 40, 30, True)
    assert turned.fits(30, 40)
    assert (broken.name, broken.readable) == ("c.jpg", False)
    assert (flat.name, flat.width, flat.turned) == ("sub/b.png", 20, False)


def test_depth_parameters_without_a_scale_are_unreadable(tmp_path: Path) -> None:
    (tmp_path / "depth_params.json").write_text('{"a": {"offset": 0}}')
    depth = read_depth(tmp_path / "depth_params.json", tmp_path / "depths")

    assert depth is not None
    assert "scale" in depth.problem
    assert read_depth(tmp_path / "none.json", tmp_path / "depths") is None


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ("{", "Expecting property name"),
        ("[]", "no list of frames"),
        ('{"frames": [{"file_path": "a"}, {}]}', "frame 2 has no file_path"),
        ('{"frames": []}', "its list of frames is empty"),
        ('{"frames": /* none', "Expecting value"),
    ],
)
def test_a_transforms_file_that_cannot_be_read_says_why(tmp_path: Path, content: str, problem: str) -> None:
    (tmp_path / "transforms.json").write_text(content)

    assert problem in read_transforms(tmp_path / "transforms.json").problem


def test_a_frame_has_numbers_of_its_own_before_those_of_the_file(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", 40, 30)
    frames = [{"file_path": "a.png", "w": 40, "fl_x": "wide"}, {"file_path": "b", "transform_matrix": [[1, 2], 3]}]
    document = {"w": 80, "h": 30, "frames": frames, "ply_file_path": "nothing.ply"}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    found = read_transforms(tmp_path / "transforms.json")

    assert (found.frames[0].numbers["w"], found.frames[1].numbers["w"]) == (40, 80)
    assert np.isnan(found.frames[0].numbers["fl_x"])
    assert np.isnan(found.frames[1].world_from_opengl).all()
    assert list(found.images) == ["a.png"]
    assert not found.ply_is_there


NASTY: tuple[Any, ...] = (
    *(None, True, "", "x" * 400, "\0", "\ud800", "/", "..", [], {}, [[1]], [[NAN] * 4] * 4, {"file_path": "a"}),
    *(0, -1, 10**400, -(10**400), 1e308, -1e200, math.inf, NAN),
)
"""What a program with a bug, or somebody who means harm, may write in place of anything."""


def with_something_nasty(document: Any, rng: random.Random) -> Any:
    """The document with one of its values, wherever it lies, replaced."""
    if not isinstance(document, (dict, list)) or not document or rng.random() < 0.1:
        return rng.choice(NASTY)
    if isinstance(document, dict):
        key = rng.choice(sorted(document))
        return {**document, key: with_something_nasty(document[key], rng)}
    place = rng.randrange(len(document))
    return [*document[:place], with_something_nasty(document[place], rng), *document[place + 1 :]]


def test_no_transforms_file_stops_a_check(good: Subject, tmp_path: Path) -> None:
    """Numbers beyond all floats, names that no file can have, matrices of texts: all of it is a finding, or none."""
    model, rng = pycolmap.Reconstruction(good.model.folder), random.Random(0)
    document = transforms_of(model)
    rules = [rule for name, rule in RULES.items() if name.startswith("transforms-")]
    path, seen = tmp_path / "transforms.json", set[str]()
    for _ in range(200):
        path.write_text(json.dumps(with_something_nasty(with_something_nasty(document, rng), rng)))
        found = apply_rules(replace(good, transforms=read_transforms(path)), rules)
        seen |= found.keys()
        "".join(evidence.text for evidence in found.values()).encode()  # can be printed
    assert {"transforms-unreadable", "transforms-intrinsics", "transforms-pose-not-rigid"} <= seen


def test_numbers_too_large_for_a_float_are_infinite(tmp_path: Path) -> None:
    document = {"fl_x": 10**400, "frames": [{"file_path": "x" * 400, "fl_y": -(10**400)}], "ply_file_path": "y" * 400}
    (tmp_path / "transforms.json").write_text(json.dumps(document))
    found = read_transforms(tmp_path / "transforms.json")

    assert (found.frames[0].numbers, found.ply_is_there) == ({"fl_x": math.inf, "fl_y": -math.inf}, False)


@pytest.mark.parametrize("field", ["ply_file_path", "camera_model"])
def test_texts_of_half_a_letter_can_be_reported(good: Subject, field: str) -> None:
    broken = part("transforms", **{field: "\ud800", "ply_is_there": False})(good)
    for evidence in apply_rules(broken, RULES.values()).values():
        evidence.text.encode()


def test_comments_are_told_and_texts_that_look_like_them_stay(tmp_path: Path) -> None:
    write_image(tmp_path / "a//b.png", 40, 30)
    (tmp_path / "transforms.json").write_text(
        '{ // made by hand\n "frames": [/* one */ {"file_path": "a//b.png"}]}', encoding="utf-8-sig"
    )
    found = read_transforms(tmp_path / "transforms.json")

    assert (found.problem, found.has_comments, list(found.images)) == ("", True, ["a//b.png"])


def test_a_path_without_an_ending_is_found_by_those_that_instant_ngp_adds(tmp_path: Path) -> None:
    write_image(tmp_path / "a.jpg", 40, 30)
    write_image(tmp_path / "b.png", 40, 30)
    frames = [{"file_path": name} for name in ("b.png", "a", "b.jpg", "c")]
    frames[1]["sharpness"] = "30"
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    found = read_transforms(tmp_path / "transforms.json")

    assert (list(found.images), list(found.images_by_ending)) == (["b.png"], ["a"])
    assert found.images_by_ending["a"].name == "a.jpg"
    assert found.has_sharpness


@pytest.mark.parametrize("model", ["VR180_L", "ORTHOPHOTO", "FISHEYE624", "OMNIDIRECTIONALSTEREO_R"])
def test_camera_models_of_nerfstudio_alone_are_known(good: Subject, model: str) -> None:
    assert found_in(part("transforms", camera_model=model)(good)) == ALWAYS


def test_an_image_that_pillow_cannot_read_has_no_size_to_differ(good: Subject) -> None:
    assert good.transforms is not None
    images = {name: replace(file, width=0, height=0) for name, file in good.transforms.images.items()}

    assert found_in(part("transforms", images=images)(good)) == ALWAYS


@pytest.mark.parametrize(
    ("rule", "stopped"),
    [
        ("transforms-unreadable", {"nerfstudio", "instant-ngp"}),
        ("transforms-image-missing", {"nerfstudio", "instant-ngp"}),
        ("transforms-sharp-image-missing", {"nerfstudio"}),
        ("transforms-image-ending", {"nerfstudio"}),
        ("transforms-comments", {"nerfstudio"}),
    ],
)
def test_what_instant_ngp_passes_over_stops_nerfstudio_only(rule: str, stopped: set[str]) -> None:
    assert {reader.name for reader in READERS if rule in reader.refuses} == stopped


def test_a_depth_map_cut_short_has_no_size(tmp_path: Path) -> None:
    path = tmp_path / "stereo" / "depth_maps" / "a.png.geometric.bin"
    write_map(path, 8, 6, 1)
    path.write_bytes(path.read_bytes()[:-1])
    dense = read_dense(tmp_path)

    assert dense is not None
    assert dense.depth_sizes == {"a.png.geometric.bin": (0, 0)}


def test_what_is_no_database_is_told(tmp_path: Path) -> None:
    (tmp_path / "text.db").write_text("not a database at all, but long enough to be looked at")
    with sqlite3.connect(tmp_path / "other.db") as connection:
        connection.execute("CREATE TABLE notes (line TEXT)")

    assert "not a database" in read_database(tmp_path / "text.db").problem
    assert "no such table" in read_database(tmp_path / "other.db").problem


# ---------------------------------------------------------------------------- where things lie
@pytest.mark.parametrize("place", [".", "sparse", "sparse/0"])
def test_a_scene_is_found_from_every_folder_on_the_way(scene: Path, place: str) -> None:
    layout = find_layout(scene / place, images=None, database=None)

    assert layout.model.resolve() == (scene / "sparse" / "0").resolve()
    assert layout.images is not None
    assert layout.images.resolve() == (scene / "images").resolve()
    assert layout.database is not None
    assert list(layout.numbered) == ["0"]


def test_the_largest_of_numbered_models_should_be_the_first(
    model: pycolmap.Reconstruction, scene: Path, tmp_path: Path
) -> None:
    pycolmap.Reconstruction(scene / "sparse" / "0").write_text(tmp_path / "txt")
    (tmp_path / "txt").rename(tmp_path / "0")
    (tmp_path / "bin").rename(tmp_path / "1")
    subject = describe(find_layout(tmp_path, images=None, database=None), ask_colmap=False)
    evidence = apply_rules(subject, RULES.values())

    assert evidence["model-not-largest"].text == "1 has 8 images, 0 has 6"


def test_scenes_inside_a_scene_are_named(scene: Path, tmp_path: Path) -> None:
    for name in ("sparse/0", "trainer/sparse/0", "dense/sparse"):
        shutil.copytree(scene / "sparse" / "0", tmp_path / name)
    layout = find_layout(tmp_path, images=None, database=None)

    assert layout.model == tmp_path / "sparse" / "0"
    assert [path.name for path in layout.inner_scenes] == ["trainer", "dense"]


def test_a_folder_without_a_model_says_where_it_looked(tmp_path: Path) -> None:
    with pytest.raises(UnreadableModelError, match=r"no COLMAP model here.*sparse/0, sparse"):
        find_layout(tmp_path, images=None, database=None)


def test_half_a_model_says_what_is_missing(tmp_path: Path) -> None:
    (tmp_path / "points3D.bin").write_bytes(bytes(8))
    with pytest.raises(UnreadableModelError, match=r"has points3D.bin, but a model needs cameras.bin and images.bin"):
        find_layout(tmp_path, images=None, database=None)


def test_paths_that_were_given_must_exist(scene: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        find_layout(tmp_path / "nothing", images=None, database=None)
    with pytest.raises(InputError, match=r"--images .*: no such folder"):
        find_layout(scene, images=tmp_path / "nothing", database=None)
    with pytest.raises(InputError, match=r"--database .*: no such file"):
        find_layout(scene, images=None, database=tmp_path / "nothing.db")


def test_a_file_in_the_place_of_a_folder_is_called_a_file(scene: Path) -> None:
    cameras = scene / "sparse" / "0" / "cameras.bin"
    with pytest.raises(InputError, match=r"cameras.bin: is a file; give the folder of the model"):
        find_layout(cameras, images=None, database=None)
    with pytest.raises(InputError, match=r"--images .*cameras.bin: is a file; give the folder that holds the images"):
        find_layout(scene, images=cameras, database=None)


def test_a_file_that_cannot_be_opened_is_named(
    model: pycolmap.Reconstruction, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path) -> bytes:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "read_bytes", refuse)
    with pytest.raises(StorageError, match=r"cameras.bin: cannot be read \(Permission denied\)"):
        read_model(tmp_path / "bin")


def test_ids_are_found_in_a_table_or_by_searching() -> None:
    for ids in (np.array([7, 3, 9]), np.array([7, 3, 10**15])):
        np.testing.assert_array_equal(index_of(ids, np.array([3, 7, 8, -1, ids[2], 10**16])), [1, 0, -1, -1, 2, -1])
    np.testing.assert_array_equal(index_of(np.empty(0, np.int64), np.array([1])), [-1])


def test_a_real_model_gives_no_false_alarm(data_dir: Callable[[str], Path]) -> None:
    folder = data_dir("lund_street")
    report = validate(folder / "reference_sparse", images=folder / "images", ask_colmap=False)

    assert [finding.rule.name for finding in report.findings] == ["camera-model-SIMPLE_RADIAL"]
    assert 0.5 < report.figures.mean_error_px < 1.0
