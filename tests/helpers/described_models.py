"""A scene without fault as a described model, and edits that break one thing of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from PIL import Image

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.validation.description import Defect, ImageFile, Subject
from smust3r_colmap.validation.projection import index_of, project
from smust3r_colmap.validation.rules import apply_rules
from smust3r_colmap.validation.validate import RULES

WIDTH, HEIGHT, NUM_IMAGES, NUM_POINTS = 256, 192, 6, 60


ALWAYS = {"camera-model-PINHOLE"}
"""The one fact about the good model that some reader minds."""


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


def found_in(subject: Subject) -> set[str]:
    return set(apply_rules(subject, RULES.values()))


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


def expected(rule: str, others: set[str]) -> set[str]:
    mended = {other[1:] for other in others if other.startswith("-")}
    return (ALWAYS - mended) | {rule} | {other for other in others if not other.startswith("-")}


def edit_lines(path: Path, change: Callable[[list[str]], list[str]]) -> None:
    """Change the lines that are no comments."""
    lines = path.read_text().split("\n")
    head = [line for line in lines if line.startswith("#")]
    path.write_text("\n".join([*head, *change([line for line in lines[len(head) :] if line])]) + "\n")
