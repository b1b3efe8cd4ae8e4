"""Models from anybody: what is read in spite of its faults, what is refused, and which file is which image."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from smust3r_colmap.errors import ConfigError, InputError
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.importers.camera_prior import CameraTags
from smust3r_colmap.importers.colmap_model import ExternalModel, SurfacePoints, read_colmap_model
from smust3r_colmap.importers.fitted_model import FittedModel, fit_to_images
from smust3r_colmap.importers.image_folder import FolderScan, ImportRecord
from smust3r_colmap.importers.images import Photo
from smust3r_colmap.products import EMPTY_CLOUD, RejectedImage

QUATERNION = "0.5 0.5 -0.5 0.5"
"""Turns x to -z... of no importance, but far from the identity in every column."""


@dataclass(frozen=True)
class Text:
    """The lines of a text model; three images that see five points between them, as COLMAP would write it."""

    cameras: tuple[str, ...] = ("1 PINHOLE 200 100 150 150 100 50",)
    images: tuple[str, ...] = (
        f"1 {QUATERNION} 0 0 0 1 a.jpg",
        "10 20 1 30 40 2",
        f"2 {QUATERNION} 1 0 0 1 b.jpg",
        "10 20 1 30 40 2",
        f"3 {QUATERNION} 2 0 0.5 1 c.jpg",
        "",
    )
    points: tuple[str, ...] | None = (
        "1 0.5 1.5 5 10 20 30 0.3 1 0 2 0",
        "2 1 1 6 255 0 0 0.3 1 1 2 1",
        "3 1 2 7 0 255 0 0.3",
    )

    def write(self, folder: Path) -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        for name, lines in (("cameras", self.cameras), ("images", self.images), ("points3D", self.points)):
            if lines is not None:
                (folder / f"{name}.txt").write_text("".join(f"{line}\n" for line in ("# a comment", *lines)))
        return folder


def read(text: Text, tmp_path: Path) -> ExternalModel:
    return read_colmap_model(text.write(tmp_path / "model"))


def synthetic(**options: int) -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(0)
    settings = pycolmap.SyntheticDatasetOptions()
    settings.num_rigs, settings.num_cameras_per_rig, settings.num_frames_per_rig, settings.num_points3D = 1, 2, 4, 30
    for name, value in options.items():
        setattr(settings, name, value)
    return pycolmap.synthesize_dataset(settings)


# ------------------------------------------------------------------------------- reading
@pytest.mark.parametrize("kind", ["binary", "text"])
def test_what_colmap_writes_is_read_as_colmap_reads_it(kind: str, tmp_path: Path) -> None:
    """Real rigs of two cameras: the poses in ``images`` are complete without the files of rigs and frames."""
    truth = synthetic()
    getattr(truth, f"write_{kind}")(tmp_path)
    model = read_colmap_model(tmp_path)
    assert model.fixes == ()
    assert sorted(model.names) == sorted(image.name for image in truth.images.values())
    for name, camera_id, cam_from_world in zip(model.names, model.camera_ids, model.cam_from_world, strict=True):
        image = truth.find_image_with_name(name)
        np.testing.assert_allclose(cam_from_world, image.cam_from_world().matrix(), atol=1e-12)
        assert replace(model.cameras[camera_id], has_prior_focal=False) == Intrinsics.from_colmap(
            truth.cameras[image.camera_id]
        )
    xyz = np.array([point.xyz for point in truth.points3D.values()])
    np.testing.assert_array_equal(np.sort(model.surface.cloud.xyz, axis=0), np.sort(xyz, axis=0))
    assert len(model.surface.point_of_observation) == truth.compute_num_observations()


def test_tracks_name_the_images_that_see_a_point(tmp_path: Path) -> None:
    surface = read(Text(), tmp_path).surface
    assert surface.point_of_observation.tolist() == [0, 0, 1, 1]
    assert surface.image_of_observation.tolist() == [0, 1, 0, 1]
    assert surface.cloud.rgb[0].tolist() == [10, 20, 30]


@pytest.mark.parametrize("below", ["sparse/0", "sparse", "0", "."])
def test_the_model_is_found_where_programs_put_it(below: str, tmp_path: Path) -> None:
    Text().write(tmp_path / below)
    assert len(read_colmap_model(tmp_path)) == 3


def test_binary_files_are_taken_where_both_kinds_lie(tmp_path: Path) -> None:
    synthetic().write_binary(tmp_path)
    assert len(read_colmap_model(Text().write(tmp_path))) == 8


def test_a_model_without_points_is_read_and_says_so(tmp_path: Path) -> None:
    model = read(Text(points=None), tmp_path)
    assert len(model.surface.cloud) == 0
    assert any("files of points are missing" in fix for fix in model.fixes)


def test_images_without_their_empty_lines_are_counted(tmp_path: Path) -> None:
    lines = [line for line in Text().images if "jpg" in line]
    model = read(Text(images=tuple(lines)), tmp_path)
    assert model.names == ("a.jpg", "b.jpg", "c.jpg")
    assert model.fixes[0].startswith("3 images without a line of observations")
    assert "images.txt: line 2" in model.fixes[0]


def test_pseudo_tracks_of_zeros_are_dropped_and_their_points_kept(tmp_path: Path) -> None:
    """VGGT-Long's converter fills every point line with three pairs 0 0; pycolmap reads none of its models."""
    points = tuple(f"{k} {k} 0 5 1 2 3 0 0 0 0 0 0 0" for k in range(4))
    model = read(Text(points=points), tmp_path)
    assert len(model.surface.cloud) == 4
    assert len(model.surface.point_of_observation) == 0
    assert any(fix.startswith("12 track elements name an image that has no pose") for fix in model.fixes)
    assert any(fix.startswith("4 points have a track that is none") for fix in model.fixes)


def test_the_zeros_are_no_track_of_image_zero_either(tmp_path: Path) -> None:
    images = tuple(line.replace("1 0.5", "0 0.5", 1) if line.endswith("a.jpg") else line for line in Text().images)
    model = read(Text(images=images, points=("0 1 1 5 1 2 3 0 0 0 0 0 0 0",)), tmp_path)
    assert len(model.surface.cloud) == 1
    assert len(model.surface.point_of_observation) == 0


def test_tracks_of_one_image_are_no_evidence(tmp_path: Path) -> None:
    model = read(Text(points=("1 1 1 5 1 2 3 0.1 1 0", "2 1 1 6 1 2 3 0.1 1 1 3 1 1 2")), tmp_path)
    assert model.surface.point_of_observation.tolist() == [1, 1]
    assert model.surface.image_of_observation.tolist() == [0, 2]
    assert any(fix.startswith("1 points have a track that is none") for fix in model.fixes)


def test_points_that_are_not_finite_are_left_out_and_the_tracks_stay_right(tmp_path: Path) -> None:
    points = ("1 nan 1 5 1 2 3 0.1 1 0 2 0", "2 1 inf 5 1 2 3 0.1", "3 1 1 6 1 2 3 0.1 2 1 3 1")
    model = read(Text(points=points), tmp_path)
    assert model.surface.cloud.xyz.tolist() == [[1, 1, 6]]
    assert model.surface.point_of_observation.tolist() == [0, 0]
    assert model.surface.image_of_observation.tolist() == [1, 2]
    assert any(fix.startswith("2 points with a coordinate that is not finite") for fix in model.fixes)


def test_a_track_that_breaks_off_keeps_its_whole_pairs(tmp_path: Path) -> None:
    model = read(Text(points=("1 1 1 6 1 2 3 0.1 1 0 2 0 3",)), tmp_path)
    assert model.surface.image_of_observation.tolist() == [0, 1]
    assert any("1 tracks that break off" in fix and "line 2" in fix for fix in model.fixes)


def test_points_without_an_error_column_are_read(tmp_path: Path) -> None:
    assert len(read(Text(points=("1 1 1 6 1 2 3", "2 1 1 7 1 2 3")), tmp_path).surface.cloud) == 2


def test_colours_outside_a_byte_are_clipped(tmp_path: Path) -> None:
    assert read(Text(points=("1 1 1 6 -3 300 2.0 0",)), tmp_path).surface.cloud.rgb.tolist() == [[0, 255, 2]]


@pytest.mark.parametrize("name", ["my photo 1.jpg", "a b/c d.jpg", "12 34.jpg", "20240101"])
def test_names_with_blanks_or_of_digits_are_read_whole(name: str, tmp_path: Path) -> None:
    images = (f"1 {QUATERNION} 0 0 0 1 {name}", "1 2 3", f"2 {QUATERNION} 1 0 0 1 b.jpg", "1 2 -1 3 4 -1 5 6 -1 7 8 9")
    assert read(Text(images=images), tmp_path).names == (name, "b.jpg")


def test_backslashes_in_names_become_slashes(tmp_path: Path) -> None:
    images = tuple(line.replace("a.jpg", "left\\a.jpg") for line in Text().images)
    model = read(Text(images=images), tmp_path)
    assert model.names[0] == "left/a.jpg"
    assert any("1 image names with backslashes" in fix for fix in model.fixes)


def test_windows_line_ends_and_a_byte_order_mark_are_passed_over(tmp_path: Path) -> None:
    folder = Text().write(tmp_path)
    for path in folder.iterdir():
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    model = read_colmap_model(folder)
    assert model.names == ("a.jpg", "b.jpg", "c.jpg")
    assert model.fixes == ()


def test_a_careless_quaternion_is_brought_to_length_one(tmp_path: Path) -> None:
    images = tuple(line.replace(QUATERNION, "0.5 0.5 -0.5 0.53") for line in Text().images)
    model = read(Text(images=images), tmp_path)
    rotations = model.cam_from_world[:, :, :3]
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (3, 1, 1)), atol=1e-12)
    assert any(fix.startswith("3 quaternions were brought to length 1") for fix in model.fixes)


def test_an_image_with_a_pose_of_nan_is_left_out_with_a_reason(tmp_path: Path) -> None:
    images = tuple(line.replace("2 0 0.5", "nan 0 0.5") for line in Text().images)
    model = read(Text(images=images), tmp_path)
    assert model.names == ("a.jpg", "b.jpg")
    assert [one.name for one in model.unposed] == ["c.jpg"]
    assert "line 6" in model.unposed[0].reason


def edited(index: int, old: str, new: str) -> Callable[[Text], Text]:
    """The text model with one word of the image or camera lines replaced."""

    def edit(text: Text) -> Text:
        if index < 0:
            return replace(text, cameras=tuple(line.replace(old, new) for line in text.cameras))
        lines = list(text.images)
        lines[index] = lines[index].replace(old, new)
        return replace(text, images=tuple(lines))

    return edit


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (edited(2, "2 0.5", "1 0.5"), r"images.txt: line 4: image id 1 was there before .*line 2"),
        (edited(2, "b.jpg", "a.jpg"), r"line 4: image name 'a.jpg' was there before .*line 2"),
        (edited(0, QUATERNION, "3 0.5 -0.5 0.5"), r"line 2: the quaternion of a.jpg has length 3.122, needed is 1"),
        (edited(0, QUATERNION, "0 0 0 0"), r"line 2: the quaternion of a.jpg has length 0"),
        (edited(4, " 1 c.jpg", " 7 c.jpg"), r"line 6: c.jpg has camera 7, which is not there; known: 1"),
        (edited(0, QUATERNION, "0.5 0.5 -0.5"), r"line 2: 9 words; an image has 10"),
        (edited(0, QUATERNION, "0.5 0.5 x 0.5"), r"line 2: 'x' stands where a number is needed"),
        (edited(0, "1 0.5", "1.5 0.5"), r"line 2: 1.5 stands where a whole number is needed"),
        (edited(-1, "PINHOLE", "PINHOLES"), r"cameras.txt: line 2: camera 1 cannot be used: .*unknown camera model"),
        (edited(-1, "100 50", "100"), r"line 2: camera 1 cannot be used: .*does not take 3 parameters"),
        (edited(-1, "200 100", "0 100"), r"line 2: camera 1 cannot be used: .*0x100 is empty"),
        (edited(-1, "150 150", "nan 150"), r"line 2: camera 1 cannot be used: .*not finite"),
        (edited(-1, "150 150", "-150 150"), r"line 2: camera 1 has focal length -150; it must be positive"),
        (edited(-1, "150 150", "1e308 150"), r"line 2: camera 1 has focal length 1e\+308 px, for 200x100 px; no lens"),
        (edited(-1, "150 150", "9 9"), r"focal length 9 px.* in millimetres \(50 px if .* 36 mm wide\)"),
        (edited(-1, "PINHOLE 200 100 150 150 100 50", "EQUIRECTANGULAR 200 100 200 100"), r"line 2: .* is EQUIRECT"),
        (edited(-1, "PINHOLE 200 100 150 150 100 50", "EUCM 200 100 150 150 100 50 0.6 1.05"), r"line 2: .* is EUCM"),
        (edited(-1, " 200 100 150 150 100 50", ""), r"cameras.txt: line 2: 2 words; a camera has"),
    ],
)
def test_what_cannot_be_meant_is_refused_with_its_line(
    edit: Callable[[Text], Text], message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=message):
        read(edit(Text()), tmp_path)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1 2 3 4 5 6", "points3D.txt: line 2: 6 words; a point has"),
        ("1 2 3 x 5 6 7 8", "points3D.txt: line 2: .*float"),
        ("1 2 3 4 5 6 7 8 1.5 0", "points3D.txt: line 2: .*int"),
    ],
)
def test_a_point_that_is_none_is_refused_with_its_line(line: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        read(Text(points=(line,)), tmp_path)


def test_one_image_is_no_model(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"1 of 1 images have a pose, needed are 2"):
        read(Text(images=Text().images[:2]), tmp_path)


def test_a_folder_without_a_model_says_what_it_has(tmp_path: Path) -> None:
    (tmp_path / "points3D.txt").write_text("")
    with pytest.raises(InputError, match=r"no COLMAP model .* found points3D.txt"):
        read_colmap_model(tmp_path)
    with pytest.raises(InputError, match=r"there is no such folder"):
        read_colmap_model(tmp_path / "nowhere")


def test_names_that_are_no_utf8_are_refused(tmp_path: Path) -> None:
    folder = Text().write(tmp_path)
    path = folder / "images.txt"
    path.write_bytes(path.read_bytes().replace(b"a.jpg", b"\xe4.jpg"))
    with pytest.raises(InputError, match=r"line 2: .* is not UTF-8"):
        read_colmap_model(folder)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_binary_file_that_is_cut_off_is_refused(name: str, tmp_path: Path) -> None:
    synthetic().write_binary(tmp_path)
    path = tmp_path / f"{name}.bin"
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(InputError, match=rf"{name}.bin: record \d+ of \d+: the file ends after \d+ bytes"):
        read_colmap_model(tmp_path)


def test_a_binary_count_beyond_the_file_costs_no_memory(tmp_path: Path) -> None:
    synthetic().write_binary(tmp_path)
    (tmp_path / "points3D.bin").write_bytes(struct.pack("<Q", 1 << 60))
    with pytest.raises(InputError, match=r"record 1 of 1152921504606846976: the file ends after 8 bytes"):
        read_colmap_model(tmp_path)


def test_bytes_behind_a_binary_file_are_passed_over_and_told(tmp_path: Path) -> None:
    synthetic().write_binary(tmp_path)
    with (tmp_path / "cameras.bin").open("ab") as file:
        file.write(b"12345")
    assert any(fix.startswith("5 bytes after the last record") for fix in read_colmap_model(tmp_path).fixes)


def test_an_unknown_binary_camera_model_is_refused_by_its_number(tmp_path: Path) -> None:
    synthetic().write_binary(tmp_path)
    data = bytearray((tmp_path / "cameras.bin").read_bytes())
    data[12:16] = struct.pack("<i", 99)
    (tmp_path / "cameras.bin").write_bytes(data)
    with pytest.raises(InputError, match=r"cameras.bin: record 1 of 2: camera model 99; known are 0 to \d+"):
        read_colmap_model(tmp_path)


# ------------------------------------------------------------------------------- fitting
def intrinsics(width: int = 200, height: int = 100, focal: float = 150.0, model: str = "PINHOLE") -> Intrinsics:
    params = {"PINHOLE": (focal, focal, width / 2, height / 2), "SIMPLE_RADIAL": (focal, width / 2, height / 2, 0.01)}
    return Intrinsics(model=model, width=width, height=height, params=params[model])


def external(
    names: Sequence[str], cameras: Sequence[Intrinsics], camera_ids: Sequence[int] | None = None
) -> ExternalModel:
    """A model of images that stand in a row; without ids each has the camera of its position."""
    n = len(names)
    poses = np.tile(np.eye(3, 4), (n, 1, 1))
    poses[:, 0, 3] = np.arange(n)
    return ExternalModel(
        folder=Path("export"),
        names=tuple(names),
        camera_ids=tuple(range(n) if camera_ids is None else camera_ids),
        cameras=dict(enumerate(cameras)),
        cam_from_world=poses,
        surface=SurfacePoints(
            cloud=EMPTY_CLOUD, point_of_observation=np.empty(0, np.int64), image_of_observation=np.empty(0, np.int64)
        ),
        unposed=(),
        fixes=(),
    )


def scanned(
    *names: str, size: tuple[int, int] = (200, 100), tags: CameraTags | None = None, damaged: Sequence[str] = ()
) -> FolderScan:
    """An image folder as the scan would have found it."""
    photo = Photo(width=size[0], height=size[1], tags=tags or CameraTags())
    records = [
        ImportRecord(
            name=name,
            size_bytes=1,
            mtime_ns=1,
            digest=name,
            photo=None if name in damaged else photo,
            reason="cut off" if name in damaged else "",
        )
        for name in names
    ]
    return FolderScan(folder=Path("photos"), records=tuple(records), unreadable=(), other_suffixes={})


def names_of(fitted: FittedModel) -> list[str]:
    return [image.name for image in fitted.collection.images]


def test_images_come_in_natural_order_with_their_own_poses() -> None:
    fitted = fit_to_images(external(["i10.jpg", "i9.jpg"], [intrinsics()], [0, 0]), scanned("i9.jpg", "i10.jpg"))
    assert names_of(fitted) == ["i9.jpg", "i10.jpg"]
    assert fitted.cam_from_world[:, 0, 3].tolist() == [1, 0]
    assert not fitted.collection.calibrated


@pytest.mark.parametrize(
    ("in_model", "in_folder", "how"),
    [
        (["images/a.jpg", "images/b.jpg"], ["a.jpg", "b.jpg"], "base name"),
        (["a.jpg", "b.jpg"], ["left/a.jpg", "right/b.jpg"], "base name"),
        (["a.png", "b.png"], ["a.JPG", "b.JPG"], "name without suffix"),
        (["/tmp/x/a.png", "b.png"], ["cam/a.jpg", "b.jpg"], "name without suffix"),
    ],
)
def test_files_are_found_by_what_is_unique_and_it_is_said(in_model: list[str], in_folder: list[str], how: str) -> None:
    fitted = fit_to_images(external(in_model, [intrinsics()], [0, 0]), scanned(*in_folder))
    assert sorted(names_of(fitted)) == sorted(in_folder)
    assert any(f"2 images found by their {how}" in note for note in fitted.notes)


def test_an_exact_name_wins_over_others_of_the_same_base_name() -> None:
    fitted = fit_to_images(external(["l/a.jpg", "r/a.jpg"], [intrinsics()], [0, 0]), scanned("l/a.jpg", "r/a.jpg"))
    assert names_of(fitted) == ["l/a.jpg", "r/a.jpg"]
    assert not any("found by" in note for note in fitted.notes)


def test_a_name_that_fits_two_files_is_refused_with_both() -> None:
    model = external(["a.jpg", "b.jpg"], [intrinsics()], [0, 0])
    with pytest.raises(InputError, match=r"image 'a.jpg' could be 'l/a.jpg', 'r/a.jpg' of photos, .* base name"):
        fit_to_images(model, scanned("l/a.jpg", "r/a.jpg", "b.jpg"))


def test_two_images_that_fit_one_file_are_refused_with_both() -> None:
    model = external(["l/a.jpg", "r/a.jpg"], [intrinsics()], [0, 0])
    with pytest.raises(InputError, match=r"images 'l/a.jpg' and 'r/a.jpg' both fit the file 'a.jpg'"):
        fit_to_images(model, scanned("a.jpg", "b.jpg"))


def test_images_without_a_usable_file_are_left_out_by_name() -> None:
    model = external(["a.jpg", "b.jpg", "c.jpg", "d.jpg"], [intrinsics()], [0] * 4)
    fitted = fit_to_images(model, scanned("a.jpg", "b.jpg", "c.jpg", damaged=["c.jpg"]))
    reasons = {one.name: one.reason for one in fitted.collection.rejected}
    assert reasons == {"c.jpg": "cut off", "d.jpg": "has a pose, but no file of that name is in photos"}


def test_images_without_a_pose_are_among_the_rejected() -> None:
    model = replace(
        external(["a.jpg", "b.jpg"], [intrinsics()], [0, 0]), unposed=(RejectedImage(name="n.jpg", reason="nan"),)
    )
    fitted = fit_to_images(model, scanned("a.jpg", "b.jpg", "n.jpg"))
    assert [one.name for one in fitted.collection.rejected] == ["n.jpg"]


def test_files_that_the_model_lacks_are_told() -> None:
    fitted = fit_to_images(external(["a.jpg", "b.jpg"], [intrinsics()], [0, 0]), scanned("a.jpg", "b.jpg", "z.jpg"))
    assert any("1 files of the folder are not in the model" in note and "'z.jpg'" in note for note in fitted.notes)


def test_files_that_the_model_lacks_come_behind_its_images_with_the_camera_of_their_like() -> None:
    model = external(["b.jpg", "c.jpg"], [intrinsics()], [0, 0])
    small = scanned("tele.jpg", size=(100, 80)).records
    scan = scanned("a.jpg", "b.jpg", "c.jpg")
    fitted = fit_to_images(
        model, replace(scan, records=(*scan.records, *small)), register_missing=True, camera_model="RADIAL"
    )
    assert names_of(fitted) == ["b.jpg", "c.jpg", "a.jpg", "tele.jpg"]
    assert [image.camera for image in fitted.collection.images] == [0, 0, 0, 1]
    guess = fitted.collection.cameras[1]
    assert (guess.model, guess.width, guess.height, guess.focal_px) == ("RADIAL", 100, 80, 120)
    assert fitted.num_posed == len(fitted.scene("given")) == 2
    assert not any("stay out" in note for note in fitted.notes)


def test_a_guessed_camera_is_that_of_a_run_and_not_the_fisheye_of_the_model() -> None:
    fisheye = Intrinsics(model="OPENCV_FISHEYE", width=200, height=100, params=(90, 90, 100, 50, 0.1, 0, 0, 0))
    records = [
        scanned(*names, size=size).records
        for names, size in ((("a.jpg", "b.jpg"), (200, 100)), (("x.jpg", "y.jpg"), (160, 120)))
    ]
    scan = replace(scanned("a.jpg"), records=(*records[0], *records[1]))
    fitted = fit_to_images(external(["a.jpg", "b.jpg"], [fisheye], [0, 0]), scan, register_missing=True)
    assert [camera.model for camera in fitted.collection.cameras] == ["OPENCV_FISHEYE", "SIMPLE_RADIAL"]
    assert any("1 cameras were guessed as SIMPLE_RADIAL, " in one and "for 2 images" in one for one in fitted.notes)
    plain = fit_to_images(
        external(["a.jpg", "b.jpg"], [fisheye], [0, 0]), scanned("a.jpg", "b.jpg", "c.jpg"), register_missing=True
    )
    assert not any("guessed" in note for note in plain.notes)


def test_no_camera_is_guessed_where_all_are_known() -> None:
    small = scanned("tele.jpg", size=(100, 80)).records
    scan = replace(scanned("a.jpg", "b.jpg", "c.jpg"), records=(*scanned("a.jpg", "b.jpg", "c.jpg").records, *small))
    fitted = fit_to_images(
        external(["b.jpg", "c.jpg"], [intrinsics()], [0, 0]), scan, register_missing=True, calibrated=True
    )
    assert names_of(fitted) == ["b.jpg", "c.jpg", "a.jpg"]
    (left_out,) = fitted.collection.rejected
    assert (left_out.name, left_out.reason) == ("tele.jpg", "no image of the model is of its size and camera")


def test_an_image_without_a_pose_in_the_model_is_placed_like_one_that_it_lacks() -> None:
    nameless = RejectedImage(name="a.jpg", reason="its pose in the model is not finite")
    model = replace(external(["b.jpg", "c.jpg"], [intrinsics()], [0, 0]), unposed=(nameless,))
    fitted = fit_to_images(model, scanned("a.jpg", "b.jpg", "c.jpg"), register_missing=True)
    assert names_of(fitted) == ["b.jpg", "c.jpg", "a.jpg"]
    assert fitted.collection.rejected == ()


@pytest.mark.parametrize("name", ["images/a.jpg", "a.png"])
def test_an_image_without_a_pose_that_is_placed_under_another_spelling_is_not_left_out_too(name: str) -> None:
    unposed = tuple(RejectedImage(name=one, reason="its pose is not finite") for one in (name, "gone.jpg"))
    model = replace(external(["b.jpg", "c.jpg"], [intrinsics()], [0, 0]), unposed=unposed)
    fitted = fit_to_images(model, scanned("a.jpg", "b.jpg", "c.jpg"), register_missing=True)
    assert names_of(fitted) == ["b.jpg", "c.jpg", "a.jpg"]
    assert [one.name for one in fitted.collection.rejected] == ["gone.jpg"]


def test_each_file_is_that_of_one_image_without_a_pose() -> None:
    unposed = tuple(RejectedImage(name=one, reason="its pose is not finite") for one in ("l/a.jpg", "r/a.jpg"))
    model = replace(external(["b.jpg", "c.jpg"], [intrinsics()], [0, 0]), unposed=unposed)
    fitted = fit_to_images(model, scanned("r/a.jpg", "b.jpg", "c.jpg"), register_missing=True)
    assert [one.name for one in fitted.collection.rejected] == ["l/a.jpg"]


def test_points_without_tracks_are_told_from_the_others(tmp_path: Path) -> None:
    fitted = fit_to_images(read_colmap_model(Text().write(tmp_path)), scanned("a.jpg", "b.jpg", "c.jpg"))
    assert fitted.untracked_points.xyz.tolist() == [[1, 2, 7]]
    assert fitted.untracked_points.rgb.tolist() == [[0, 255, 0]]


def test_a_folder_of_other_images_is_refused_with_examples_of_both() -> None:
    with pytest.raises(InputError, match=r"files for 1 of 2 images of export, needed are 2; .*'b.jpg'.*'x.jpg'"):
        fit_to_images(external(["a.jpg", "b.jpg"], [intrinsics()], [0, 0]), scanned("a.jpg", "x.jpg"))


def test_intrinsics_of_the_network_are_brought_to_the_file_axis_by_axis() -> None:
    """518x294 for 16:9 rounds the height from 291.4: focal lengths differ by 0.9 % and are equal again after."""
    network = Intrinsics(model="PINHOLE", width=518, height=294, params=(400, 400 * 294 / 291.375, 259, 147))
    fitted = fit_to_images(
        external(["a.jpg", "b.jpg"], [network], [0, 0]),
        scanned("a.jpg", "b.jpg", size=(1920, 1080)),
        camera_model="PINHOLE",
    )
    (camera,) = fitted.collection.cameras
    assert (camera.width, camera.height) == (1920, 1080)
    assert camera.params == pytest.approx((400 * 1920 / 518, 400 * 1920 / 518, 960, 540), rel=1e-6)
    assert any("2 images had intrinsics at another size" in r and "518x294 to 1920x1080" in r for r in fitted.notes)


@pytest.mark.parametrize(("height", "fits"), [(96, True), (104, True), (94, False), (106, False)])
def test_a_shape_may_differ_by_five_percent(height: int, fits: bool) -> None:
    model = external(["a.jpg", "b.jpg"], [intrinsics(200, height)], [0, 0])
    if fits:
        assert fit_to_images(model, scanned("a.jpg", "b.jpg", size=(400, 200))).collection.cameras[0].height == 200
        return
    with pytest.raises(
        InputError, match=rf"a.jpg: is 400x200 px, its camera 0 of export is for 200x{height} px.*cropped"
    ):
        fit_to_images(model, scanned("a.jpg", "b.jpg", size=(400, 200)))


def test_a_file_that_exif_turns_is_told_from_a_cropped_one() -> None:
    with pytest.raises(InputError, match=r"is 100x200 px, .* for 200x100 px; .*lying on its side"):
        fit_to_images(external(["a.jpg", "b.jpg"], [intrinsics()], [0, 0]), scanned("a.jpg", "b.jpg", size=(100, 200)))


def test_one_camera_per_image_becomes_one_camera() -> None:
    cameras = [intrinsics(focal=focal) for focal in (148.0, 150.0, 155.0)]
    fitted = fit_to_images(external(["a.jpg", "b.jpg", "c.jpg"], cameras), scanned("a.jpg", "b.jpg", "c.jpg"))
    (camera,) = fitted.collection.cameras
    assert camera.focal_px == 150.0
    assert any("3 cameras with one image each became one" in r and "148 to 155 px" in r for r in fitted.notes)


def test_cameras_stay_apart_when_that_is_wanted() -> None:
    cameras = [intrinsics(focal=focal) for focal in (148.0, 150.0)]
    fitted = fit_to_images(external(["a.jpg", "b.jpg"], cameras), scanned("a.jpg", "b.jpg"), share_cameras=False)
    assert [camera.focal_px for camera in fitted.collection.cameras] == [148.0, 150.0]


def test_a_zoomed_image_keeps_its_own_camera() -> None:
    cameras = [intrinsics(focal=focal) for focal in (150.0, 151.0, 300.0)]
    fitted = fit_to_images(external(["a.jpg", "b.jpg", "c.jpg"], cameras), scanned("a.jpg", "b.jpg", "c.jpg"))
    assert [image.camera for image in fitted.collection.images] == [0, 0, 1]
    assert fitted.collection.cameras[1].focal_px == 300.0


def test_cameras_that_the_author_shared_are_not_merged_further() -> None:
    names = ["a.jpg", "b.jpg", "c.jpg", "d.jpg"]
    fitted = fit_to_images(external(names, [intrinsics(), intrinsics(focal=151.0)], [0, 0, 1, 1]), scanned(*names))
    assert [image.camera for image in fitted.collection.images] == [0, 0, 1, 1]


def test_images_of_two_folders_or_lenses_do_not_share_a_camera() -> None:
    cameras = [intrinsics(focal=focal) for focal in (150.0, 151.0)]
    folders = fit_to_images(external(["l/a.jpg", "r/b.jpg"], cameras), scanned("l/a.jpg", "r/b.jpg"))
    assert len(folders.collection.cameras) == 2
    one, other = (scanned(name, tags=CameraTags(make="M", model=name)).records for name in ("a.jpg", "b.jpg"))
    lenses = fit_to_images(
        external(["a.jpg", "b.jpg"], cameras),
        FolderScan(folder=Path("photos"), records=(*one, *other), unreadable=(), other_suffixes={}),
    )
    assert len(lenses.collection.cameras) == 2


def test_one_camera_for_files_of_two_sizes_becomes_two() -> None:
    small, large = scanned("a.jpg").records, scanned("b.jpg", size=(400, 200)).records
    scan = FolderScan(folder=Path("photos"), records=(*small, *large), unreadable=(), other_suffixes={})
    fitted = fit_to_images(external(["a.jpg", "b.jpg"], [intrinsics()], [0, 0]), scan)
    assert [camera.focal_px for camera in fitted.collection.cameras] == [150.0, 300.0]


def test_pinholes_become_radial_unless_asked_otherwise() -> None:
    model, scan = external(["a.jpg", "b.jpg"], [intrinsics()], [0, 0]), scanned("a.jpg", "b.jpg")
    fitted = fit_to_images(model, scan)
    assert fitted.collection.cameras[0].model == "SIMPLE_RADIAL"
    assert fitted.collection.cameras[0].params == (150.0, 100.0, 50.0, 0.0)
    assert any("pinhole cameras became SIMPLE_RADIAL (1 of 1)" in note for note in fitted.notes)
    assert fit_to_images(model, scan, camera_model="PINHOLE").collection.cameras == (intrinsics(),)


def test_known_cameras_stay_as_they_are() -> None:
    cameras = [intrinsics(focal=focal) for focal in (148.0, 150.0)]
    model, scan = external(["a.jpg", "b.jpg"], cameras), scanned("a.jpg", "b.jpg")
    fitted = fit_to_images(model, scan, calibrated=True)
    assert fitted.collection.cameras == tuple(cameras)
    assert fitted.collection.calibrated
    with pytest.raises(ConfigError, match="--camera-model OPENCV: with --calibrated the cameras stay"):
        fit_to_images(model, scan, camera_model="OPENCV", calibrated=True)


def test_distortion_is_carried_into_a_larger_model() -> None:
    model = external(["a.jpg", "b.jpg"], [intrinsics(model="SIMPLE_RADIAL")], [0, 0])
    fitted = fit_to_images(model, scanned("a.jpg", "b.jpg"), camera_model="OPENCV")
    assert fitted.collection.cameras[0].params == (150.0, 150.0, 100.0, 50.0, 0.01, 0.0, 0.0, 0.0)
    assert fit_to_images(model, scanned("a.jpg", "b.jpg")).collection.cameras[0].model == "SIMPLE_RADIAL"


def test_a_fisheye_cannot_become_a_perspective_camera() -> None:
    fisheye = Intrinsics(model="OPENCV_FISHEYE", width=200, height=100, params=(90, 90, 100, 50, 0, 0, 0, 0))
    with pytest.raises(ConfigError, match=r"--camera-model OPENCV: a camera of the model is OPENCV_FISHEYE"):
        fit_to_images(external(["a.jpg", "b.jpg"], [fisheye], [0, 0]), scanned("a.jpg", "b.jpg"), camera_model="OPENCV")


def test_observations_follow_their_images_into_the_new_order(tmp_path: Path) -> None:
    """Image c has no file, so one point has one view left, which is none; a (now z) and b change places."""
    points = ("1 1 1 5 1 2 3 0 1 0 2 0", "2 1 1 6 1 2 3 0 2 1 3 1", "3 1 1 7 1 2 3 0 1 1 2 2 3 2")
    images = tuple(line.replace("a.jpg", "z.jpg") for line in Text().images)
    fitted = fit_to_images(read(Text(images=images, points=points), tmp_path), scanned("z.jpg", "b.jpg"))
    assert names_of(fitted) == ["b.jpg", "z.jpg"]
    seen = zip(fitted.surface.point_of_observation.tolist(), fitted.surface.image_of_observation.tolist(), strict=True)
    assert sorted(seen) == [(0, 0), (0, 1), (2, 0), (2, 1)]
    assert len(fitted.surface.cloud) == 3


def test_the_scene_has_every_image_once_and_the_cloud(tmp_path: Path) -> None:
    fitted = fit_to_images(read(Text(), tmp_path), scanned("a.jpg", "b.jpg", "c.jpg"))
    scene = fitted.scene("export")
    assert scene.image_names == ("a.jpg", "b.jpg", "c.jpg")
    assert len(scene.points) == 3
    assert not scene.metric
