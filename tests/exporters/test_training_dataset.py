"""The training dataset by the rules of its readers, read with struct, json and OpenCV, not with what wrote it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from helpers.independent_colmap_reader import ReadCamera, ReadModel, read_binary
from PIL import Image

from smust3r_colmap.errors import ImageError, InputError, RunDirectoryError, StorageError
from smust3r_colmap.exporters.centred_pinhole import CentredPinhole
from smust3r_colmap.exporters.flat_names import flat_names
from smust3r_colmap.exporters.inverse_depth import common_scale, inverse_depth_values
from smust3r_colmap.exporters.training_dataset import TrainingReport, write_training_dataset
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.products import PointCloud

WIDTH, HEIGHT = 160, 120
NAMES = ("left/IMG 1.a.png", "left/IMG 2.a.png", "right/IMG 1.a.png", "3.png", "4.png", "5.png")
PLANE_NORMAL = np.array([0.2, 0.1, 1.0]) / np.linalg.norm([0.2, 0.1, 1.0])
PLANE_OFFSET = 5.0


def camera(
    camera_id: int = 1, model: str = "SIMPLE_RADIAL", params: Sequence[float] = (150, 80, 60, -0.08)
) -> pycolmap.Camera:
    return pycolmap.Camera(camera_id=camera_id, model=model, width=WIDTH, height=HEIGHT, params=list(params))


RADIAL = camera()
OFF_CENTRE = camera(params=(150, 83.3, 56.2, -0.08))
PINHOLE = camera(model="PINHOLE", params=(150, 155, 80, 60))


def cam_from_world(k: int) -> FloatArray:
    """Cameras on a line, all turned a little differently, before the plane n . x = 5."""
    turn = pycolmap.Rotation3d(np.array([0.02 * k, -0.03 * k, 0.01])).matrix()
    return np.column_stack([turn, turn @ [-0.25 * k, -0.1 * k, 0.0]])


def plane_model(
    cameras: Sequence[pycolmap.Camera] = (RADIAL,), names: Sequence[str] = NAMES
) -> pycolmap.Reconstruction:
    """Eighty points of the plane, each seen by all images whose view holds it; the cameras take turns."""
    model = pycolmap.Reconstruction()
    for one in cameras:
        model.add_camera_with_trivial_rig(one)
    rng = np.random.default_rng(3)
    xy = rng.uniform([-1.5, -1.5], [2.5, 2.0], (80, 2))
    xyz = np.column_stack([xy, (PLANE_OFFSET - xy @ PLANE_NORMAL[:2]) / PLANE_NORMAL[2]])
    tracks = [pycolmap.Track() for _ in xyz]
    for k, name in enumerate(names):
        pose, one = cam_from_world(k), cameras[k % len(cameras)]
        seen_at = one.img_from_cam(xyz @ pose[:, :3].T + pose[:, 3])
        seen = np.flatnonzero(((seen_at > 1) & (seen_at < [WIDTH - 1, HEIGHT - 1])).all(axis=1))
        for row, point in enumerate(seen):
            tracks[point].add_element(7 + k, row)
        image = pycolmap.Image(name=name, camera_id=one.camera_id, image_id=7 + k)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(at) for at in seen_at[seen]])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    for position, track in zip(xyz, tracks, strict=True):
        if track.length() >= 2:
            model.add_point3D(position, track, rng.integers(1, 255, 3, dtype=np.uint8))
    return model


def move_back(model: pycolmap.Reconstruction, image_id: int, distance: float) -> None:
    """Backward along its axis a camera still has all its points in front, as one that a mapper lost has."""
    pose = model.image(image_id).cam_from_world()
    further = pycolmap.Rigid3d(pose.rotation, pose.translation + np.array([0, 0, distance]))
    model.frame(model.image(image_id).frame_id).set_cam_from_world(1, further)


def ramp(width: int = WIDTH, height: int = HEIGHT) -> npt.NDArray[np.uint8]:
    """(H, W, 3) red is the column and green the row, so that a resampled pixel tells where it came from."""
    column, row = np.meshgrid(np.arange(width), np.arange(height))
    return np.dstack([column, row, np.full_like(row, 77)]).astype(np.uint8)


def write_ramps(folder: Path, names: Sequence[str] = NAMES) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(ramp()).save(folder / name)
    return folder


@dataclass(frozen=True)
class Written:
    folder: Path
    report: TrainingReport
    sparse: ReadModel
    names: dict[str, str]

    def rgb(self, name: str, below: str = "images") -> npt.NDArray[np.uint8]:
        pixels = cv2.imread(str(self.folder / below / name), cv2.IMREAD_UNCHANGED)
        assert pixels is not None, name
        return np.asarray(pixels[:, :, ::-1], np.uint8)


def write(
    tmp_path: Path,
    model: pycolmap.Reconstruction,
    *,
    maps: TrueMaps | None = None,
    cloud: PointCloud | None = None,
    scales: tuple[int, ...] = (),
    masks: Path | None = None,
    keep_outliers: bool = False,
) -> Written:
    """Write the folder beside images that are made where they are missing."""
    images, folder = tmp_path / "in", tmp_path / "out" / "trainer"
    write_ramps(images, [i.name for i in model.images.values() if not (images / i.name).exists()])
    report = write_training_dataset(
        model, images, folder, maps=maps, cloud=cloud, scales=scales, masks=masks, keep_outliers=keep_outliers
    )
    names = json.loads((folder / "names.json").read_text(encoding="utf-8"))
    return Written(folder, report, read_binary(folder / "sparse/0"), names)


def undistorted_at(one: ReadCamera, original: pycolmap.Camera) -> FloatArray:
    """(H, W, 2) where the pixels of a pinhole's image lie in a SIMPLE_RADIAL image: COLMAP's formula of the model."""
    fx, fy, cx, cy = one.params
    f, original_cx, original_cy, k = original.params
    u, v = np.meshgrid((np.arange(one.width) + 0.5 - cx) / fx, (np.arange(one.height) + 0.5 - cy) / fy)
    radial = 1 + k * (u**2 + v**2)
    return np.dstack([f * radial * u + original_cx, f * radial * v + original_cy])


def read_ply(path: Path) -> npt.NDArray[np.void]:
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode().split("\n")
    assert "format binary_little_endian 1.0" in lines
    kinds = {"float": "<f4", "double": "<f8", "uchar": "u1"}
    columns = [(line.split()[2], kinds[line.split()[1]]) for line in lines if line.startswith("property")]
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    rows = np.frombuffer(body, dtype=columns)
    assert len(rows) == count
    return rows


def stacked(rows: npt.NDArray[np.void], *columns: str) -> FloatArray:
    return np.column_stack([rows[column] for column in columns]).astype(np.float64)


# -------------------------------------------------------------------------- the contract
@pytest.mark.parametrize("cameras", [(camera(5),), (camera(3), camera(9, params=(140, 83.3, 56.2, 0.05)))])
def test_the_folder_keeps_every_rule_of_its_readers(tmp_path: Path, cameras: tuple[pycolmap.Camera, ...]) -> None:
    model = plane_model(cameras)
    written = write(tmp_path, model)
    sparse = written.sparse

    assert list(sparse.cameras) == list(range(1, len(cameras) + 1)) == sorted(sparse.rigs)
    for one in sparse.cameras.values():
        assert one.model == "PINHOLE"
        assert one.params[2:] == (one.width / 2, one.height / 2)
    assert sorted(sparse.images) == [7, 8, 9, 10, 11, 12] == sorted(sparse.frames)
    assert list(sparse.points) == list(range(1, len(sparse.points) + 1))
    assert written.report.num_points == len(sparse.points) > 60
    for point in sparse.points.values():
        assert len({image for image, _ in point.track}) >= 2
    on_disk = sorted(path.name for path in (written.folder / "images").iterdir())
    assert on_disk == sorted(image.name for image in sparse.images.values())
    for image in sparse.images.values():
        one = sparse.cameras[image.camera_id]
        assert written.rgb(image.name).shape == (one.height, one.width, 3)
        assert image.points2d and all(point in sparse.points for *_, point in image.points2d)
        assert image.name.count(".") == 1 and not set(image.name) & set(" /,")
    assert written.names == {model.image(i).name: image.name for i, image in sparse.images.items()}


def test_observations_and_points_agree_with_the_pinholes(tmp_path: Path) -> None:
    sparse = write(tmp_path, plane_model((OFF_CENTRE,))).sparse
    pinhole = sparse.cameras[1]
    count = 0
    for image_id, image in sparse.images.items():
        pose = cam_from_world(image_id - 7)
        for x, y, point in image.points2d:
            in_cam = pose[:, :3] @ sparse.points[point].xyz + pose[:, 3]
            projected = pinhole.params[:2] * in_cam[:2] / in_cam[2] + pinhole.params[2:]
            np.testing.assert_allclose((x, y), projected, atol=1e-5)
            assert 0 <= x < pinhole.width and 0 <= y < pinhole.height
            count += 1
    assert 200 < count == sum(len(point.track) for point in sparse.points.values())


def test_the_cloud_of_3dgs_is_that_of_the_model_with_normals_towards_the_cameras(tmp_path: Path) -> None:
    written = write(tmp_path, plane_model())
    rows, points = read_ply(written.folder / "sparse/0/points3D.ply"), list(written.sparse.points.values())
    np.testing.assert_allclose(stacked(rows, "x", "y", "z"), [point.xyz for point in points], rtol=1e-6)
    np.testing.assert_array_equal(stacked(rows, "red", "green", "blue"), [point.rgb for point in points])
    normals = stacked(rows, "nx", "ny", "nz")
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)
    assert (normals[:, 2] < -0.7).all()  # the cameras are below the plane and look along z


def test_normals_come_from_the_cloud_where_it_reaches(tmp_path: Path) -> None:
    model = plane_model()
    xyz = np.array([point.xyz for point in model.points3D.values()])
    near = xyz[:, 0] < 0.5
    # Turned away from the cameras on purpose: the writer turns them back.
    lent = np.tile(PLANE_NORMAL, (near.sum(), 1)).astype(np.float32)
    cloud = PointCloud(xyz=xyz[near] + 0.01, rgb=np.zeros((near.sum(), 3), np.uint8), normals=lent)
    written = write(tmp_path, model, cloud=cloud)
    rows = read_ply(written.folder / "sparse/0/points3D.ply")
    as_the_plane = stacked(rows, "nx", "ny", "nz") @ -PLANE_NORMAL > 1 - 1e-6
    assert as_the_plane[rows["x"] < 0.5].all()
    assert not as_the_plane[rows["x"] > 0.8].any()


# ------------------------------------------------------------------------------- pixels
@pytest.mark.parametrize("original", [RADIAL, OFF_CENTRE])
def test_pixels_lie_where_the_distortion_puts_them(tmp_path: Path, original: pycolmap.Camera) -> None:
    written = write(tmp_path, plane_model((original,)))
    pinhole = written.sparse.cameras[1]
    came_from = written.rgb("3.png")[:, :, :2] + 0.5
    expected = undistorted_at(pinhole, original)
    inside = ((expected > 1) & (expected < [WIDTH - 1, HEIGHT - 1])).all(axis=2)
    assert inside.mean() > 0.95
    assert np.abs(came_from - expected)[inside].max() < 0.6  # half a grey level, and OpenCV's 1/32 pixel
    assert abs((came_from - expected)[inside].mean()) < 0.1


def test_a_centred_camera_gives_what_colmap_gives(tmp_path: Path) -> None:
    written = write(tmp_path, plane_model())
    bitmap = pycolmap.Bitmap.read(tmp_path / "in/3.png", True)
    assert bitmap is not None
    theirs, camera_theirs = pycolmap.undistort_image(pycolmap.UndistortCameraOptions(), bitmap, RADIAL)
    ours = written.sparse.cameras[1]
    assert (ours.width, ours.height) == (camera_theirs.width, camera_theirs.height)
    np.testing.assert_allclose(ours.params, camera_theirs.params)
    difference = np.abs(written.rgb("3.png").astype(int) - theirs.to_array().astype(int))
    assert difference[1:-1, 1:-1].max() <= 1


def test_a_calibrated_principal_point_loses_no_more_than_it_must() -> None:
    """20 pixels to the right of the middle: 40 columns go, on one side."""
    found = CentredPinhole.of(camera(model="PINHOLE", params=(150, 150, 100, 60)))
    assert found.size == (WIDTH - 40, HEIGHT)
    np.testing.assert_array_equal(found.lookup()[0, :, 0], np.arange(40, WIDTH))


def test_images_that_are_right_already_are_copied_byte_by_byte(tmp_path: Path) -> None:
    names = ("a.jpg", "b.png", "grey.png", "deep.png", "turned.jpg", "phone.jpg", "c.jpg")
    images = tmp_path / "in"
    images.mkdir()
    for name in ("a.jpg", "b.png", "c.jpg"):
        Image.fromarray(ramp()).save(images / name, quality=60)
    Image.fromarray(ramp()[:, :, 0]).save(images / "grey.png")
    cv2.imwrite(str(images / "deep.png"), ramp().astype(np.uint16) * 257)
    pair = [Image.fromarray(ramp()), Image.fromarray(ramp())]
    pair[0].save(images / "phone.jpg", format="MPO", save_all=True, append_images=pair[1:])
    exif = Image.Exif()
    exif[0x0112] = 3
    Image.fromarray(ramp()).save(images / "turned.jpg", exif=exif)

    written = write(tmp_path, plane_model((PINHOLE,), names))
    same = [name for name in names if (images / name).read_bytes() == (written.folder / "images" / name).read_bytes()]
    assert same == ["a.jpg", "b.png", "c.jpg"]
    assert written.report.num_copied == 3 and written.report.num_renamed == 0
    np.testing.assert_array_equal(written.rgb("deep.png")[:, :, ::-1], ramp())
    np.testing.assert_array_equal(written.rgb("grey.png")[:, :, 2], ramp()[:, :, 0])
    assert np.abs(written.rgb("turned.jpg")[::-1, ::-1, :2].astype(int) - ramp()[:, :, :2]).mean() < 2


def test_sixteen_bit_images_are_scaled_by_the_bits_of_their_camera(tmp_path: Path) -> None:
    """The red of the ramp says its column in steps of 64; by its own peak each image would be four times as bright."""
    images = tmp_path / "in"
    images.mkdir()
    names = ("a.png", "b.png", "c.png", "d.png")
    for name in names:
        cv2.imwrite(str(images / name), ramp()[:, :, ::-1].astype(np.uint16) * 64)
    folder = tmp_path / "trainer"
    bits = dict.fromkeys(names, 16)
    write_training_dataset(plane_model((PINHOLE,), names), images, folder, maps=None, cloud=None, bits=bits)
    for path in (folder / "images").iterdir():
        written = np.asarray(Image.open(path)).astype(int)
        assert np.abs(written - ramp().astype(float) * 64 / 257).max() <= 0.51


def test_an_image_that_the_model_has_as_stored_is_written_so(tmp_path: Path) -> None:
    images = write_ramps(tmp_path / "in")
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(ramp()).save(images / NAMES[0], exif=exif)
    written = write(tmp_path, plane_model((PINHOLE,)))
    assert np.array_equal(written.rgb(written.names[NAMES[0]]), ramp())
    assert (written.folder / "images" / written.names[NAMES[0]]).read_bytes() != (images / NAMES[0]).read_bytes()


def test_alpha_of_images_becomes_their_masks(tmp_path: Path) -> None:
    images = write_ramps(tmp_path / "in")
    alpha = np.full((HEIGHT, WIDTH), 255, np.uint8)
    alpha[:, :40] = 0
    Image.fromarray(np.dstack([ramp(), alpha])).save(images / NAMES[1])
    written = write(tmp_path, plane_model((PINHOLE,)))
    frames = json.loads((written.folder / "transforms.json").read_text())["frames"]
    found = {frame["file_path"]: np.asarray(Image.open(written.folder / frame["mask_path"])) for frame in frames}
    assert np.array_equal(found[f"images/{written.names[NAMES[1]]}"], alpha)
    assert all((mask == 255).all() for path, mask in found.items() if not path.endswith(written.names[NAMES[1]]))


def test_smaller_copies_pair_by_sorted_lists_and_are_means_over_areas(tmp_path: Path) -> None:
    written = write(tmp_path, plane_model((PINHOLE,)), scales=(2, 7))
    full = sorted(path.name for path in (written.folder / "images").iterdir())
    for scale in (2, 7):
        assert sorted(path.name for path in (written.folder / f"images_{scale}").iterdir()) == full
        small = written.rgb("3.png", f"images_{scale}")
        assert small.shape == (HEIGHT // scale, WIDTH // scale, 3)
        column = (np.arange(WIDTH // scale) + 0.5) * WIDTH / (WIDTH // scale) - 0.5
        np.testing.assert_allclose(small[3, :, 0], column, atol=0.75)


@pytest.mark.parametrize("scales", [(1,), (2, 2), (121,)])
def test_scales_that_make_no_sense_are_refused(tmp_path: Path, scales: tuple[int, ...]) -> None:
    with pytest.raises(
        InputError, match=rf"trainer scale {scales[0]}: needed are different whole numbers from 2 to 120"
    ):
        write(tmp_path, plane_model((PINHOLE,)), scales=scales)


# -------------------------------------------------------------------------------- masks
def test_masks_follow_the_images_in_both_naming_rules(tmp_path: Path) -> None:
    masks = tmp_path / "masks_in"
    (masks / "left").mkdir(parents=True)
    hidden_right = np.where(ramp()[:, :, 0] < 100, 1, 0).astype(np.uint8)  # what is not black is kept, be it 1
    Image.fromarray(hidden_right).save(masks / "left/IMG 1.a.png.png")
    Image.fromarray(hidden_right * 255).save(masks / "3.png")
    written = write(tmp_path, plane_model((OFF_CENTRE,)), masks=masks, scales=(2,))

    assert written.report.images_without_mask == ("left/IMG 2.a.png", "right/IMG 1.a.png", "4.png", "5.png")
    frames = json.loads((written.folder / "transforms.json").read_text())["frames"]
    assert len({frame["mask_path"] for frame in frames}) == 6
    expected = undistorted_at(written.sparse.cameras[1], OFF_CENTRE)[:, :, 0]
    for old, new in written.names.items():
        stem = PurePosixPath(new).stem
        by_stem = cv2.imread(str(written.folder / "masks" / f"{stem}.png"), cv2.IMREAD_UNCHANGED)
        by_name = cv2.imread(str(written.folder / "masks" / f"{new}.png"), cv2.IMREAD_UNCHANGED)
        small = cv2.imread(str(written.folder / "masks_2" / f"{new}.png"), cv2.IMREAD_UNCHANGED)
        assert by_stem is not None and small is not None
        np.testing.assert_array_equal(by_stem, by_name)
        assert set(np.unique(by_stem)) <= {0, 255}
        assert small.shape == (by_stem.shape[0] // 2, by_stem.shape[1] // 2)
        if old in written.report.images_without_mask:
            assert (by_stem == 255).all()
        else:
            sure = np.abs(expected - 100) > 1
            np.testing.assert_array_equal((by_stem == 255)[sure], (expected < 100)[sure])


def test_a_mask_of_another_size_is_refused_by_name(tmp_path: Path) -> None:
    masks = tmp_path / "masks_in"
    masks.mkdir()
    Image.fromarray(np.zeros((60, 80), np.uint8)).save(masks / "4.png")
    with pytest.raises(ImageError, match=r"4\.png: the mask is 80x60 px and its image 160x120"):
        write(tmp_path, plane_model(), masks=masks)
    assert not (tmp_path / "out/trainer").exists()
    with pytest.raises(InputError, match="nothing: there is no such folder of masks"):
        write(tmp_path, plane_model(), masks=tmp_path / "nothing")


# -------------------------------------------------------------------------------- depth
class TrueMaps:
    """Depth of the plane over the whole distorted image, at half its size and in a unit of its own."""

    def __init__(self, original: pycolmap.Camera, names: Sequence[str], *, unit: float) -> None:
        self._original, self._names, self._unit = original, names, unit

    def __contains__(self, name: str) -> bool:
        return name in self._names

    def depth(self, name: str) -> npt.NDArray[np.float32]:
        column, row = np.meshgrid(np.arange(0.5, WIDTH // 2), np.arange(0.5, HEIGHT // 2))
        uv = self._original.cam_from_img(2 * np.column_stack([column.ravel(), row.ravel()]))
        depth = plane_depth(uv, cam_from_world(NAMES.index(name))) / self._unit
        return depth.reshape(HEIGHT // 2, WIDTH // 2).astype(np.float32)

    def confidence(self, name: str) -> npt.NDArray[np.float32]:
        return np.full((HEIGHT // 2, WIDTH // 2), 9.0, np.float32)


def plane_depth(uv: npt.ArrayLike, pose: FloatArray) -> FloatArray:
    """z at which rays (u, v, 1) meet the plane n . x = d: x = R^T (z r - t)."""
    rays = np.column_stack([uv, np.ones(len(np.asarray(uv)))])
    n_cam = pose[:, :3] @ PLANE_NORMAL
    return np.asarray((PLANE_OFFSET + n_cam @ pose[:, 3]) / (rays @ n_cam))


def test_depth_pngs_are_inverse_depth_by_the_rule_of_3dgs(tmp_path: Path) -> None:
    with_map = [name for name in NAMES if name != "4.png"]
    written = write(tmp_path, plane_model(), maps=TrueMaps(RADIAL, with_map, unit=1.3))
    params = json.loads((written.folder / "sparse/0/depth_params.json").read_text())
    assert written.report.images_without_depth == ("4.png",)
    assert set(params) == {PurePosixPath(name).stem for name in written.names.values()}
    assert all(one["offset"] == 0 for one in params.values())
    used = [one["scale"] for one in params.values() if one["scale"] > 0]
    assert len(used) == 5 and max(used) == min(used)

    for image_id, image in written.sparse.images.items():
        stem = PurePosixPath(image.name).stem
        values = cv2.imread(str(written.folder / "depths" / f"{stem}.png"), cv2.IMREAD_UNCHANGED)
        assert values is not None and values.dtype == np.uint16
        if stem == "4":
            assert params[stem]["scale"] == 0 and not values.any()
            continue
        fx, fy, cx, cy = written.sparse.cameras[1].params
        height, width = values.shape
        u, v = np.meshgrid((np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy)
        depth = plane_depth(np.column_stack([u.ravel(), v.ravel()]), cam_from_world(image_id - 7)).reshape(values.shape)
        relative = values / 65536 * params[stem]["scale"] * depth - 1
        assert (values > 0).mean() > 0.6  # what no other view sees is not confirmed
        assert np.abs(relative[values > 0]).max() < 0.01
        assert np.median(np.abs(relative[values > 0])) < 0.001


def test_small_holes_are_closed_and_the_sky_stays_infinitely_far() -> None:
    depth = np.full((100, 200), 4.0, np.float32)
    depth[:40, :] = 0  # sky
    depth[70:72, 50:53] = 0  # a hole
    values = inverse_depth_values(depth, scale=1.0)
    assert not values[:39].any()
    assert (values[41:] == 65536 / 4).all()


def test_the_scale_leaves_room_before_the_nearest_points_and_clips_beyond() -> None:
    scale = common_scale(np.linspace(2.0, 50.0, 1000))
    assert 1 / scale == pytest.approx(2.0 / 4, rel=0.3)
    assert inverse_depth_values(np.full((4, 4), 0.01, np.float32), scale).max() == 65535


# ----------------------------------------------------------------------------- left out
def test_a_camera_gone_astray_and_a_point_at_infinity_are_left_out_unless_wanted(tmp_path: Path) -> None:
    model = plane_model()
    move_back(model, 9, 400)
    some_point = next(iter(model.points3D.values()))
    some_point.xyz = some_point.xyz * 1000
    num_points = model.num_points3D()

    report = write(tmp_path, model).report
    assert report.left_out.far_images == ("right/IMG 1.a.png",)
    assert report.num_images == 5
    assert report.left_out.far_points == 1
    assert report.num_points + report.left_out.points_of_few_views + 1 == num_points

    kept = write(tmp_path, model, keep_outliers=True)
    assert kept.report.left_out.far_images == () and kept.report.left_out.far_points == 0
    assert len(kept.sparse.images) == 6 and len(kept.sparse.points) == num_points


def test_a_walk_with_a_gap_of_three_distances_stays_whole(tmp_path: Path) -> None:
    """The usual distance is about 5; a step of 15 is no reason to leave half of the images out."""
    model = plane_model()
    for i in (10, 11, 12):
        move_back(model, i, 15)
    assert write(tmp_path, model).report.left_out.far_images == ()


def test_what_readers_fail_on_is_left_out_and_counted(tmp_path: Path) -> None:
    model = plane_model()
    seen_once = set(list(model.points3D)[:3])
    for point_id, point in model.points3D.items():
        track = [(element.image_id, element.point2D_idx) for element in point.track.elements]
        for position, (image_id, row) in enumerate(track):
            if image_id == 8 or (point_id in seen_once and position > 0):
                point.track.delete_element(image_id, row)
                model.image(image_id).reset_point3D_for_point2D(row)
    model.add_point3D(np.array([0.0, 0.0, 4.0]), pycolmap.Track(), np.zeros(3, np.uint8))
    num_seen_twice = sum(point.track.length() >= 2 for point in model.points3D.values())
    written = write(tmp_path, model)
    assert written.report.left_out.unobserved_images == ("left/IMG 2.a.png",)
    assert written.report.left_out.points_of_few_views == model.num_points3D() - num_seen_twice >= 4
    assert written.report.num_points == num_seen_twice
    assert sorted(written.sparse.images) == [7, 9, 10, 11, 12]
    assert "left/IMG 2.a.png" not in written.names
    assert not (tmp_path / "out/trainer/images/left_IMG_2_a.png").exists()


def test_points_behind_a_camera_lose_that_observation(tmp_path: Path) -> None:
    model = plane_model()
    behind = next(iter(model.points3D.values()))
    behind.xyz = behind.xyz * [1, 1, -1]
    report = write(tmp_path, model).report
    assert report.left_out.observations_behind == behind.track.length()
    assert report.left_out.points_of_few_views == 1


# ---------------------------------------------------------------------------- refusals
def test_a_model_that_nobody_can_train_on_is_refused(tmp_path: Path) -> None:
    model = plane_model()
    model.delete_all_points2D_and_points3D()
    with pytest.raises(InputError, match=r"it has no points, none seen by two images; find tracks first"):
        write(tmp_path, model)
    model.add_point3D(np.ones(3), pycolmap.Track(), np.zeros(3, np.uint8))
    with pytest.raises(InputError, match=r"none of its 1 points is seen by two images"):
        write(tmp_path, model)


def test_missing_and_misfit_images_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    images = write_ramps(tmp_path / "in")
    (images / "4.png").unlink()
    arguments = (plane_model(), images, tmp_path / "out/trainer")
    with pytest.raises(ImageError, match=r"^4\.png: there is no such file in .*in; give the folder"):
        write_training_dataset(*arguments, maps=None, cloud=None)
    Image.fromarray(ramp(80, 60)).save(images / "4.png")
    with pytest.raises(ImageError, match=r"^4\.png: the file is 80x60 px and its camera 160x120"):
        write_training_dataset(*arguments, maps=None, cloud=None)
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(ramp(80, 60)).save(images / "4.png", exif=exif)
    with pytest.raises(ImageError, match=r"is 60x80 px \(stored as 80x60, turned by its EXIF orientation\)"):
        write_training_dataset(*arguments, maps=None, cloud=None)
    (images / "4.png").write_text("no image")
    with pytest.raises(ImageError, match=r"^4\.png: cannot be read as JPEG, PNG, WebP or TIFF"):
        write_training_dataset(*arguments, maps=None, cloud=None)
    assert not (tmp_path / "out").exists()


def test_two_images_of_one_name_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"3\.png: images 7 and 9 of the model have this name"):
        write(tmp_path, plane_model(names=("3.png", "4.png", "3.png")))


def test_cameras_without_a_pinhole_are_refused() -> None:
    round_view = pycolmap.Camera(camera_id=4, model="EQUIRECTANGULAR", width=64, height=32, params=[64, 32])
    with pytest.raises(InputError, match="camera 4 is EQUIRECTANGULAR: no pinhole holds what it sees"):
        CentredPinhole.of(round_view)
    with pytest.raises(InputError, match=r"camera 1: its principal point \(200\.0, 60\.0\) lies outside the 160x120"):
        CentredPinhole.of(camera(model="PINHOLE", params=(150, 150, 200, 60)))


def test_an_older_folder_is_replaced_and_a_foreign_one_is_not(tmp_path: Path) -> None:
    first = write(tmp_path, plane_model())
    (first.folder / "images_4_png").mkdir()  # gsplat's own
    second = write(tmp_path, plane_model(names=("3.png", "4.png", "5.png")))
    assert len(list((second.folder / "images").iterdir())) == 3
    assert not (second.folder / "images_4_png").exists()
    for scales in ((100, 120), (2,)):  # as small as the images allow
        write(tmp_path, plane_model(), scales=scales)
    assert not list(second.folder.glob("*_100"))
    (second.folder / "my_splat.ply").touch()
    with pytest.raises(RunDirectoryError, match=r"'my_splat\.ply', which is not ours to replace"):
        write(tmp_path, plane_model())


def test_a_model_cut_short_by_a_full_disk_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    complete = pycolmap.Reconstruction.write_binary

    def cut(model: pycolmap.Reconstruction, folder: Path) -> None:
        complete(model, folder)
        data = (folder / "images.bin").read_bytes()
        (folder / "images.bin").write_bytes(data[:-10])

    monkeypatch.setattr(pycolmap.Reconstruction, "write_binary", cut)
    with pytest.raises(StorageError, match=r"images\.bin: \d+ of \d+ bytes arrived; is the disk full\?"):
        write(tmp_path, plane_model())
    assert not (tmp_path / "out/trainer").exists()


# -------------------------------------------------------------------------------- names
def test_names_become_flat_with_one_dot_and_without_blanks() -> None:
    found = flat_names({"a/b c.d.JPG": ".jpg", "übung-1.webp": ".png", "plain_2.png": ".png"})
    assert found == {"a/b c.d.JPG": "a_b_c_d.jpg", "übung-1.webp": "übung-1.png", "plain_2.png": "plain_2.png"}


def test_stems_differ_whatever_the_case_and_the_suffix() -> None:
    found = flat_names({"a/b.jpg": ".jpg", "a_b.png": ".png", "A b.jpg": ".jpg", "c.jpg": ".jpg"})
    assert list(found.values()) == ["a_b.jpg", "a_b_2.png", "A_b_3.jpg", "c.jpg"]


def test_no_name_ends_another() -> None:
    """Brush takes the first file whose path ends with the name."""
    found = flat_names({f"{k}.jpg": ".jpg" for k in (1, 2, 11)})
    assert list(found.values()) == ["1_1.jpg", "2_2.jpg", "3_11.jpg"]
    assert not clashes(found.values())


def clashes(names: Iterable[str]) -> list[tuple[str, str]]:
    """Names that end another, compared as Brush does."""
    lower = [name.lower() for name in names]
    return [(short, long) for short in lower for long in lower if short != long and long.endswith(short)]


@pytest.mark.parametrize(
    ("olds", "news"),
    [
        (["a.jpg", "1_a.jpg"], ["1_a.jpg", "2_1-a.jpg"]),
        (["1_1.jpg", "1.jpg", "2_1_1.jpg"], ["1_1-1.jpg", "2_1.jpg", "3_2-1-1.jpg"]),
        (["01_a.jpg", "1_a.jpg", "b_c.jpg"], ["1_01-a.jpg", "2_1-a.jpg", "3_b_c.jpg"]),
    ],
)
def test_numbers_in_front_of_numbers_end_no_name_either(olds: list[str], news: list[str]) -> None:
    found = list(flat_names(dict.fromkeys(olds, ".jpg")).values())
    assert found == news
    assert not clashes(found)


def test_names_of_every_sort_come_out_different_and_clean() -> None:
    rng = np.random.default_rng(7)
    for _ in range(500):
        stems = {"".join(rng.choice(list("12aA_-/"), size=rng.integers(1, 6))).strip("/") for _ in range(15)}
        found = flat_names({f"{stem}.x": str(rng.choice([".jpg", ".png"])) for stem in sorted(stems)})
        assert len({PurePosixPath(name).stem.lower() for name in found.values()}) == len(found)
        assert not clashes(found.values())
