"""The image folder: what is read, what is left out and why, and who shares a camera."""

from __future__ import annotations

import dataclasses
import io
import os
import random
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image, ImageOps
from PIL.TiffImagePlugin import IFDRational

from smust3r_colmap.config import CameraConfig, CameraMode
from smust3r_colmap.errors import CollectionError, ConfigError, ImageError, InputError
from smust3r_colmap.geometry.arrays import UInt8Array
from smust3r_colmap.importers import camera_prior, image_folder, images
from smust3r_colmap.importers.image_folder import (
    check_masks_not_inside,
    check_output_not_inside,
    collection_from_scan,
    import_image_folder,
    natural_key,
    scan_image_folder,
)
from smust3r_colmap.importers.image_scan import RECORDS
from smust3r_colmap.importers.images import load_grey, load_rgb
from smust3r_colmap.products import ImageCollection, SourceImage

AUTO = CameraConfig()


def picture(seed: int, *, width: int = 60, height: int = 40) -> UInt8Array:
    """Smooth colours, different for every seed, that survive JPEG nearly unchanged."""
    corners = np.random.default_rng(seed).integers(30, 220, (3, 3, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(corners, (width, height), interpolation=cv2.INTER_CUBIC), np.uint8)


def write(path: Path, seed: int = 0, *, size: tuple[int, int] = (60, 40), **options: Any) -> Path:
    """Write a small picture; the suffix says how."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture(seed, width=size[0], height=size[1])).save(path, **options)
    return path


def exif(
    *,
    make: str = "",
    model: str = "",
    focal_mm: float = 0,
    focal_35mm: int = 0,
    plane_px_per_mm: float = 0,
    pixel_size: tuple[int, int] = (0, 0),
    orientation: int = 1,
) -> bytes:
    tags = Image.Exif()
    tags[ExifTags.Base.Make], tags[ExifTags.Base.Model] = make, model
    tags[ExifTags.Base.Orientation] = orientation
    tags[ExifTags.IFD.Exif] = {
        ExifTags.Base.FocalLength: IFDRational(round(focal_mm * 1000), 1000),
        ExifTags.Base.FocalLengthIn35mmFilm: focal_35mm,
        ExifTags.Base.FocalPlaneXResolution: IFDRational(round(plane_px_per_mm * 1000), 1000),
        ExifTags.Base.FocalPlaneResolutionUnit: 4,
        ExifTags.Base.ExifImageWidth: pixel_size[0],
        ExifTags.Base.ExifImageHeight: pixel_size[1],
    }
    return tags.tobytes()


def names(collection: ImageCollection) -> list[str]:
    return [image.name for image in collection.images]


def reasons(collection: ImageCollection) -> dict[str, str]:
    return {image.name: image.reason for image in collection.rejected}


def only_image(folder: Path, name: str) -> SourceImage:
    """Import a folder and pick one image of it."""
    collection = import_image_folder(folder, AUTO)
    return next(image for image in collection.images if image.name == name)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two good images, to which a test adds its trouble."""
    write(tmp_path / "photos" / "good1.png", 1)
    write(tmp_path / "photos" / "good2.png", 2)
    return tmp_path / "photos"


# ---------------------------------------------------------------------- what is found
def test_every_suffix_in_any_case_and_any_depth_is_found(tmp_path: Path) -> None:
    written = ["a.jpg", "b.JPEG", "c.Png", "d/e.WEBP", "d/f/g.tif", "d/f/h.TIFF"]
    for seed, name in enumerate(written):
        write(tmp_path / name, seed)
    collection = import_image_folder(tmp_path, AUTO)
    assert names(collection) == written
    assert collection.rejected == ()


def test_hidden_and_foreign_files_are_passed_over_in_silence(folder: Path) -> None:
    write(folder / ".hidden.jpg", 3)
    write(folder / ".thumbnails" / "a.jpg", 4)
    write(folder / "@eaDir" / "a.jpg", 5)
    (folder / "notes.txt").write_text("not an image")
    (folder / "clip.mp4").write_bytes(b"\0" * 10)
    collection = import_image_folder(folder, AUTO)
    assert names(collection) == ["good1.png", "good2.png"]
    assert collection.rejected == ()


def test_order_is_natural_folder_by_folder() -> None:
    ordered = [
        "img.jpg",
        "img2.jpg",
        "IMG10.jpg",
        "img10b.jpg",
        "run2/1.jpg",
        "run2/01.png",
        "run2/b/0.jpg",
        "run10/0.jpg",
    ]
    shuffled = list(ordered)
    for seed in range(5):
        random.Random(seed).shuffle(shuffled)
        assert sorted(shuffled, key=natural_key) == ordered


def test_same_stem_with_two_suffixes_are_two_images(tmp_path: Path) -> None:
    write(tmp_path / "a.png", 1)
    write(tmp_path / "a.jpg", 2)
    assert names(import_image_folder(tmp_path, AUTO)) == ["a.jpg", "a.png"]


def test_names_with_blanks_and_any_script_are_kept_and_load(tmp_path: Path) -> None:
    odd = ["Été à Paris 1.png", "Ζεύς/写真 2.png", "🏠.png"]
    for seed, name in enumerate(odd):
        write(tmp_path / name, seed)
    collection = import_image_folder(tmp_path, AUTO)
    assert sorted(names(collection)) == sorted(odd)
    for image in collection.images:
        np.testing.assert_array_equal(load_rgb(image), picture(odd.index(image.name)))


def test_links_in_a_circle_end_and_real_places_name_the_files(tmp_path: Path) -> None:
    write(tmp_path / "z" / "1.png", 1)
    write(tmp_path / "z" / "2.png", 2)
    (tmp_path / "a").symlink_to(tmp_path / "z")
    (tmp_path / "zz").symlink_to(tmp_path / "z")
    (tmp_path / "z" / "up").symlink_to(tmp_path)
    (tmp_path / "self").symlink_to(tmp_path / "self")
    collection = import_image_folder(tmp_path, AUTO)
    assert names(collection) == ["z/1.png", "z/2.png"]
    assert collection.rejected == ()


def test_a_linked_folder_outside_is_read(folder: Path, tmp_path: Path) -> None:
    write(tmp_path / "elsewhere" / "3.png", 3)
    (folder / "link").symlink_to(tmp_path / "elsewhere")
    assert names(import_image_folder(folder, AUTO)) == ["good1.png", "good2.png", "link/3.png"]


# ------------------------------------------------------------------- what is left out
def damaged(kind: str) -> bytes:
    memory = io.BytesIO()
    if kind.startswith("jpeg"):
        noise = np.random.default_rng(0).integers(0, 255, (200, 300, 3), dtype=np.uint8)
        Image.fromarray(noise).save(memory, "JPEG", progressive="progressive" in kind)
        data = memory.getvalue()
        half = len(data) // 2
        return data[:half] + bytes(half if "zeros" in kind else 0)
    if kind.endswith("16"):
        values = np.random.default_rng(0).integers(0, 65535, (50, 60, 3), dtype=np.uint16)
        data = bytes(cv2.imencode(".png" if "png" in kind else ".tif", values)[1])
    else:
        noise = np.random.default_rng(0).integers(0, 255, (50, 60, 3), dtype=np.uint8)
        options = {"compression": "tiff_lzw"} if kind == "tiff" else {}
        Image.fromarray(noise).save(memory, kind, **options)
        data = memory.getvalue()
    return data[: len(data) // 2]


@pytest.mark.parametrize(
    "kind",
    ["jpeg", "jpeg progressive", "jpeg zeros", "jpeg progressive zeros", "png", "tiff", "webp", "png16", "tiff16"],
)
def test_a_file_cut_off_in_the_middle_is_left_out(folder: Path, kind: str) -> None:
    (folder / "cut.jpg").write_bytes(damaged(kind))
    collection = import_image_folder(folder, AUTO)
    assert names(collection) == ["good1.png", "good2.png"]
    assert list(reasons(collection)) == ["cut.jpg"]
    assert "damaged, cut off" in reasons(collection)["cut.jpg"]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "the file is empty"),
        (b"hello, world", r"no JPEG, PNG, WebP or TIFF image (starts with b'hello, w')"),
        (b"%!PS-Adobe-3.0 EPSF-3.0\n", "no JPEG, PNG, WebP or TIFF image"),
        (b"RIFF\0\0\0\0AVI LIST", "damaged, cut off"),
    ],
)
def test_what_is_no_image_is_left_out(folder: Path, content: bytes, reason: str) -> None:
    (folder / "odd.jpg").write_bytes(content)
    collection = import_image_folder(folder, AUTO)
    assert names(collection) == ["good1.png", "good2.png"]
    assert reason in reasons(collection)["odd.jpg"]


def test_tiny_images_are_left_out(folder: Path) -> None:
    write(folder / "pixel.png", 3, size=(1, 1))
    write(folder / "strip.png", 4, size=(500, 31))
    write(folder / "least.png", 5, size=(500, 32))
    collection = import_image_folder(folder, AUTO)
    assert names(collection) == ["good1.png", "good2.png", "least.png"]
    assert reasons(collection) == {
        "pixel.png": "1x1 px; the shorter side must be at least 32",
        "strip.png": "500x31 px; the shorter side must be at least 32",
    }


@pytest.mark.slow
def test_an_image_20000_pixels_wide_is_read(folder: Path) -> None:
    # 200 megapixels, above the 178 at which Image.open refuses.
    Image.new("L", (20000, 10000), 77).save(folder / "wide.jpg")
    wide = only_image(folder, "wide.jpg")
    assert (wide.width, wide.height) == (20000, 10000)
    grey = load_grey(wide)
    assert grey.shape == (10000, 20000)
    assert grey[5000, 10000] == 77


def test_an_image_above_the_limit_is_left_out_undecoded(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(folder / "large.png", 3, size=(400, 300))
    monkeypatch.setattr(images, "MAX_MEGAPIXELS", 0.1)
    monkeypatch.setattr(images, "_check_decodes", lambda image, data: None if image.width < 400 else pytest.fail())
    collection = import_image_folder(folder, AUTO)
    assert reasons(collection) == {"large.png": "400x300 px are 0 megapixels; at most 0.1 are read"}


def test_a_file_too_long_to_hold_in_memory_is_left_out_unread(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "long.tif").write_bytes(bytes(200_000))
    monkeypatch.setattr(image_folder, "MAX_FILE_BYTES", 100_000)
    assert reasons(import_image_folder(folder, AUTO)) == {"long.tif": "200000 bytes; at most 100000 are read"}


def test_repeated_frames_are_all_kept(folder: Path) -> None:
    shutil.copy(folder / "good1.png", folder / "good3.png")
    collection = import_image_folder(folder, AUTO)
    assert names(collection) == ["good1.png", "good2.png", "good3.png"]
    assert reasons(collection) == {}


def test_composed_and_decomposed_accents_are_one_name(folder: Path) -> None:
    composed, decomposed = "\u00e9.png", "e\u0301.png"
    write(folder / composed, 3)
    write(folder / decomposed, 4)
    collection = import_image_folder(folder, AUTO)
    assert len(collection) == 3
    assert len(collection.rejected) == 1
    assert "but for the composition of accents" in collection.rejected[0].reason
    assert {collection.rejected[0].name, *names(collection)} >= {composed, decomposed}


def test_names_no_model_can_hold_are_left_out(folder: Path) -> None:
    write(folder / "two\nlines.png", 3)
    os.rename(os.fsencode(write(folder.parent / "x.png", 4)), os.path.join(os.fsencode(folder), b"caf\xe9.png"))
    collection = import_image_folder(folder, AUTO)
    assert list(reasons(collection)) == ["caf\\xe9.png", "two\\x0alines.png"]
    assert all("rename it" in reason for reason in reasons(collection).values())


def test_a_link_to_nothing_and_a_pipe_are_left_out(folder: Path) -> None:
    (folder / "dangling.jpg").symlink_to(folder / "gone.jpg")
    os.mkfifo(folder / "pipe.png")
    assert reasons(import_image_folder(folder, AUTO)) == {
        "dangling.jpg": "no regular file, or a link to nothing",
        "pipe.png": "no regular file, or a link to nothing",
    }


def test_an_unreadable_subfolder_is_reported(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(folder / "locked" / "a.png", 3)
    scandir = os.scandir

    def refusing(path: Path) -> Iterator[os.DirEntry[str]]:
        if path == folder / "locked":
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", refusing)
    collection = import_image_folder(folder, AUTO)
    assert names(collection) == ["good1.png", "good2.png"]
    assert reasons(collection) == {"locked/": "cannot be read: Permission denied"}


def test_an_unreadable_file_is_reported(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    locked = write(folder / "locked.png", 3)
    read_bytes = Path.read_bytes

    def refusing(path: Path) -> bytes:
        if path == locked:
            raise PermissionError(13, "Permission denied", str(path))
        return read_bytes(path)

    monkeypatch.setattr(Path, "read_bytes", refusing)
    assert reasons(import_image_folder(folder, AUTO)) == {"locked.png": "cannot be read: Permission denied"}


# --------------------------------------------------------------------------- refusals
def test_refuses_a_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(CollectionError, match="nowhere: there is no such folder"):
        import_image_folder(tmp_path / "nowhere", AUTO)


def test_refuses_a_file_in_place_of_a_folder(folder: Path) -> None:
    with pytest.raises(CollectionError, match=r"good1.png: is a file; give the folder"):
        import_image_folder(folder / "good1.png", AUTO)


def test_refuses_an_empty_folder_naming_folder_and_formats(tmp_path: Path) -> None:
    with pytest.raises(CollectionError, match=rf"{tmp_path}: no usable image.*\.jpg \.jpeg \.png \.webp \.tif \.tiff"):
        import_image_folder(tmp_path, AUTO)


def test_refuses_a_folder_of_other_formats_naming_them(tmp_path: Path) -> None:
    for name in ("a.dng", "b.txt", "c.TXT", "README"):
        (tmp_path / name).write_bytes(b"x")
    with pytest.raises(
        CollectionError,
        match=r"left out 1: a.dng: .*\.dng are not read; convert.*other kinds: 2 \.txt, 1 without suffix",
    ):
        import_image_folder(tmp_path, AUTO)


def test_refuses_one_image(tmp_path: Path) -> None:
    write(tmp_path / "a.png", 1)
    (tmp_path / "b.png").write_bytes(b"")
    with pytest.raises(CollectionError, match=r"1 usable image \(a.png\), at least 2.*left out 1: b.png: .*empty"):
        import_image_folder(tmp_path, AUTO)


def test_refuses_two_identical_images_naming_both(tmp_path: Path) -> None:
    shutil.copy(write(tmp_path / "a.png", 1), tmp_path / "b.png")
    with pytest.raises(CollectionError, match=r"2 images of the same content \(a.png, b.png, ...\), at least 2"):
        import_image_folder(tmp_path, AUTO)


def test_refuses_an_unknown_camera_model_before_reading(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(image_folder, "inspect", lambda data: pytest.fail("read an image"))
    with pytest.raises(ConfigError, match=r"--camera-model PINHOLES: .* choose one of SIMPLE_PINHOLE, PINHOLE"):
        import_image_folder(folder, CameraConfig(camera_model="PINHOLES"))


def test_refuses_an_output_among_the_images(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    (tmp_path / "link").symlink_to(photos)
    for output in (photos, photos / "out" / "deep", tmp_path / "link" / "out", photos / "a" / ".." / "b"):
        with pytest.raises(ConfigError, match=rf"{output} lies inside the image folder {photos}"):
            check_output_not_inside(photos, output)
    for output in (tmp_path, tmp_path / "photos_out", photos / ".." / "out"):
        check_output_not_inside(photos, output)


def test_refuses_masks_among_the_images(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    (tmp_path / "link").symlink_to(photos)
    for masks in (photos, photos / "masks", tmp_path / "link" / "masks"):
        with pytest.raises(ConfigError, match=rf"--masks {masks}: lies inside the image folder {photos}"):
            check_masks_not_inside(photos, masks)
    for allowed in (None, tmp_path, tmp_path / "photos_masks"):
        check_masks_not_inside(photos, allowed)


# ----------------------------------------------------------------------------- pixels
@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.webp", "a.tif"])
def test_exif_orientation_is_applied_as_pillow_does(folder: Path, name: str, orientation: int) -> None:
    write(folder / name, 3, exif=exif(orientation=orientation))
    image = only_image(folder, name)
    assert (image.width, image.height) == ((60, 40) if orientation < 5 else (40, 60))
    expected = np.asarray(ImageOps.exif_transpose(Image.open(folder / name)).convert("RGB"))
    np.testing.assert_array_equal(load_rgb(image), expected)
    assert load_grey(image).shape == expected.shape[:2]


@pytest.mark.parametrize("orientation", [3, 6])
@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_exif_orientation_is_applied_to_16_bit(folder: Path, suffix: str, orientation: int) -> None:
    grey = picture(3)[..., 0]
    path = folder / f"deep.{suffix}"
    Image.fromarray(grey.astype(np.uint16) * 257).save(path, exif=exif(orientation=orientation))
    image = only_image(folder, path.name)
    np.testing.assert_array_equal(load_grey(image), np.rot90(grey, 2 if orientation == 3 else -1))
    assert (image.width, image.height) == load_grey(image).shape[::-1]


@pytest.mark.parametrize("suffix", ["png", "tif"])
@pytest.mark.parametrize("bits", [10, 12, 14, 16])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_16_bit_files_span_the_8_bit_range(folder: Path, suffix: str, bits: int, channels: int) -> None:
    rgb = picture(3)
    rgb[0, 0], rgb[0, 1] = 0, 255
    deep = np.round(rgb / 255 * ((1 << bits) - 1)).astype(np.uint16)
    alpha = np.full((*deep.shape[:2], 1), 65535, np.uint16)
    stored = {1: deep[..., 0], 3: deep[..., ::-1], 4: np.dstack([deep[..., ::-1], alpha])}[channels]
    assert cv2.imwrite(str(folder / f"deep.{suffix}"), stored)
    expected = np.dstack([rgb[..., 0]] * 3) if channels == 1 else rgb
    loaded = load_rgb(only_image(folder, f"deep.{suffix}"))
    np.testing.assert_array_equal(loaded, expected)


@pytest.mark.parametrize("mode", ["L", "LA", "P", "RGBA", "1", "CMYK"])
def test_every_kind_of_pixel_becomes_rgb_and_grey(folder: Path, mode: str) -> None:
    source = Image.fromarray(picture(3))
    suffix = "tif" if mode == "CMYK" else "png"
    source.convert(mode).save(folder / f"kind.{suffix}")
    image = only_image(folder, f"kind.{suffix}")
    rgb, grey = load_rgb(image), load_grey(image)
    assert (rgb.shape, grey.shape) == ((40, 60, 3), (40, 60))
    assert all(array.dtype == np.uint8 and array.flags.writeable and array.flags.c_contiguous for array in (rgb, grey))
    np.testing.assert_array_equal(rgb, np.asarray(source.convert(mode).convert("RGB")))
    assert np.abs(grey.astype(int) - np.asarray(Image.fromarray(rgb).convert("L"))).max() <= 1


def test_the_colours_of_a_cmyk_jpeg_are_not_inverted(folder: Path) -> None:
    Image.fromarray(picture(3)).convert("CMYK").save(folder / "print.jpg", quality=95)
    difference = load_rgb(only_image(folder, "print.jpg")).astype(int) - picture(3)
    assert np.abs(difference).max() <= 12


def test_grey_of_a_jpeg_is_the_luma_of_its_colours(folder: Path) -> None:
    image = only_image(write(folder / "a.jpg", 3).parent, "a.jpg")
    luma = load_rgb(image) @ np.array([0.299, 0.587, 0.114])
    assert np.abs(load_grey(image) - luma).max() <= 2


@pytest.mark.parametrize(("suffix", "mode"), [("tif", "LAB"), ("tif", "F")])
def test_kinds_of_pixels_without_a_meaning_are_left_out(folder: Path, suffix: str, mode: str) -> None:
    source = Image.fromarray(picture(3))
    (source.convert("L").convert("F") if mode == "F" else source.convert("LAB")).save(folder / f"odd.{suffix}")
    collection = import_image_folder(folder, AUTO)
    assert len(collection) == 2
    assert "are not read; convert to 8 or 16 bit" in reasons(collection)[f"odd.{suffix}"]


def test_refuses_a_file_that_changed_or_went_after_the_import(folder: Path) -> None:
    image = only_image(folder, "good1.png")
    write(folder / "good1.png", 1, size=(50, 40))
    with pytest.raises(ImageError, match=r"good1.png: is 50x40 px now and was 60x40"):
        load_rgb(image)
    (folder / "good1.png").write_bytes(b"gone bad")
    with pytest.raises(ImageError, match=r"good1.png: no JPEG"):
        load_grey(image)
    (folder / "good1.png").unlink()
    with pytest.raises(ImageError, match=r"good1.png: cannot be read: No such file"):
        load_rgb(image)


# ---------------------------------------------------------------------------- cameras
def test_without_exif_one_camera_with_the_default_focal_length(folder: Path) -> None:
    (camera,) = import_image_folder(folder, AUTO).cameras
    assert camera.model == "SIMPLE_RADIAL"
    assert camera.params == (1.2 * 60, 30.0, 20.0, 0.0)
    assert not camera.has_prior_focal


def test_the_35_mm_tag_gives_the_focal_length_over_the_diagonal(folder: Path) -> None:
    write(folder / "a.webp", 3, exif=exif(focal_35mm=28))
    camera = import_image_folder(folder, AUTO).cameras[0]
    assert camera.has_prior_focal
    assert camera.focal_px == pytest.approx(28 / 43.27 * np.hypot(60, 40))


@pytest.mark.parametrize(
    ("make", "model", "sensor_mm"), [("Canon", "Canon EOS 5D Mark II", 36), ("DJI", "FC330", 6.25)]
)
def test_the_focal_length_in_mm_goes_through_the_sensor_database(
    folder: Path, make: str, model: str, sensor_mm: float
) -> None:
    write(folder / "a.jpg", 3, size=(40, 60), exif=exif(make=make, model=model, focal_mm=35))
    camera = import_image_folder(folder, AUTO).cameras[0]
    assert camera.has_prior_focal
    assert camera.focal_px == pytest.approx(35 / sensor_mm * 60, rel=1e-6)


def test_the_focal_plane_resolution_is_that_of_the_size_in_exif(folder: Path) -> None:
    # 4000 px over 8 mm of sensor, shrunk to 60 px: 6 mm are 3000 px there and 45 px here.
    tags = exif(make="X", model="Y", focal_mm=6, plane_px_per_mm=500, pixel_size=(4000, 3000))
    write(folder / "a.jpg", 3, exif=tags)
    camera = import_image_folder(folder, AUTO).cameras[0]
    assert camera.has_prior_focal
    assert camera.focal_px == pytest.approx(45)


@pytest.mark.parametrize(
    "tags",
    [
        exif(focal_mm=35),
        exif(make="X", model="Y", focal_mm=35),
        exif(make="X", model="Y", focal_mm=35, plane_px_per_mm=500),
        exif(focal_35mm=2),
        exif(focal_35mm=9999),
    ],
    ids=["no camera", "unknown camera", "no pixel size", "absurdly short", "absurdly long"],
)
def test_exif_that_tells_no_focal_length_leaves_the_default(folder: Path, tags: bytes) -> None:
    write(folder / "a.jpg", 3, exif=tags)
    image = only_image(folder, "a.jpg")
    camera = import_image_folder(folder, AUTO).cameras[image.camera]
    assert not camera.has_prior_focal
    assert camera.focal_px == pytest.approx(1.2 * 60)


def test_auto_parts_cameras_by_folder_size_and_exif(tmp_path: Path) -> None:
    phone, zoomed = exif(make="P", focal_35mm=26), exif(make="P", focal_35mm=52)
    write(tmp_path / "a" / "1.jpg", 1, exif=phone)
    write(tmp_path / "a" / "2.jpg", 2, exif=zoomed)
    write(tmp_path / "a" / "3.jpg", 3, exif=phone)
    write(tmp_path / "a" / "4.jpg", 4, exif=exif(make="P", focal_35mm=26, orientation=6))
    write(tmp_path / "b" / "1.jpg", 5, exif=phone)
    write(tmp_path / "b" / "2.jpg", 6)
    collection = import_image_folder(tmp_path, AUTO)
    assert [image.camera for image in collection.images] == [0, 1, 0, 2, 3, 4]
    assert [camera.has_prior_focal for camera in collection.cameras] == [True, True, True, True, False]


@pytest.mark.parametrize(("mode", "cameras"), [("single", [0, 0, 0, 0]), ("per-folder", [0, 0, 1, 1])])
def test_a_shared_camera_takes_the_median_of_the_priors(tmp_path: Path, mode: CameraMode, cameras: list[int]) -> None:
    for index, focal_35mm in enumerate([20, 30, 0, 55]):
        write(tmp_path / "ab"[index // 2] / f"{index}.jpg", index, exif=exif(focal_35mm=focal_35mm))
    collection = import_image_folder(tmp_path, CameraConfig(camera_mode=mode, camera_model="OPENCV"))
    assert [image.camera for image in collection.images] == cameras
    expected = {"single": [30], "per-folder": [25, 55]}[mode]
    unit = np.hypot(60, 40) / 43.27
    assert [camera.focal_px / unit for camera in collection.cameras] == pytest.approx(expected)
    assert {camera.model for camera in collection.cameras} == {"OPENCV"}


def test_a_known_calibration_holds_for_every_camera(tmp_path: Path) -> None:
    for index in range(3):
        write(tmp_path / f"{index}.jpg", index, exif=exif(focal_35mm=20))
    settings = CameraConfig(camera_mode="per-image", camera_model="OPENCV", camera_params="50, 51,30,20,.1,0,0,0")
    collection = import_image_folder(tmp_path, settings)
    assert collection.calibrated
    assert {camera.params for camera in collection.cameras} == {(50, 51, 30, 20, 0.1, 0, 0, 0)}
    assert {camera.model for camera in collection.cameras} == {"OPENCV"}
    assert len(collection.cameras) == 3
    assert not import_image_folder(tmp_path, AUTO).calibrated


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ("50,30", r"--camera-params 50,30: does not fit --camera-model PINHOLE, which takes fx, fy, cx, cy"),
        ("a,b,c,d", "--camera-params a,b,c,d: needed are numbers separated by commas"),
        ("0,0,30,20", "--camera-params 0,0,30,20: the focal length is 0 px"),
        ("nan,50,30,20", "--camera-params nan,50,30,20: does not fit .* not finite"),
    ],
)
def test_refuses_a_calibration_that_is_none(folder: Path, params: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        import_image_folder(folder, CameraConfig(camera_model="PINHOLE", camera_params=params))


def test_refuses_one_calibration_for_two_sizes(tmp_path: Path) -> None:
    write(tmp_path / "a.jpg", 0)
    write(tmp_path / "b.jpg", 1, size=(80, 60))
    with pytest.raises(ConfigError, match=r"holds for one image size, the images have 2 \(60x40, 80x60\)"):
        import_image_folder(tmp_path, CameraConfig(camera_params="50,30,20,0"))


def test_per_image_gives_every_image_its_camera(folder: Path) -> None:
    collection = import_image_folder(folder, CameraConfig(camera_mode="per-image"))
    assert [image.camera for image in collection.images] == [0, 1]


@pytest.mark.parametrize(("mode", "where"), [("single", "3 images here"), ("per-folder", "2 images in folder b")])
def test_refuses_to_share_a_camera_between_sizes(tmp_path: Path, mode: CameraMode, where: str) -> None:
    write(tmp_path / "a" / "1.png", 1)
    write(tmp_path / "b" / "2.png", 2)
    write(tmp_path / "b" / "3.png", 3, size=(80, 50))
    pattern = rf"--camera-mode {mode}: {where} have 2 sizes \(. of 60x40 such as ./..png, 1 of 80x50 such as b/3.png\)"
    with pytest.raises(ConfigError, match=pattern):
        import_image_folder(tmp_path, CameraConfig(camera_mode=mode))


def test_damaged_exif_costs_the_prior_not_the_image(folder: Path) -> None:
    path = write(folder / "a.jpg", 3, exif=exif(focal_35mm=28, orientation=6))
    data = path.read_bytes()
    start = data.index(b"Exif\0\0") + 6
    path.write_bytes(data[: start + 4] + b"\xff\xff\xff\x7f" + data[start + 8 :])
    image = only_image(folder, "a.jpg")
    assert (image.width, image.height) == (60, 40)


def test_the_database_does_not_know_cameras_without_a_name() -> None:
    assert camera_prior.database_sensor_mm("", "iPhone 6") is None
    assert camera_prior.database_sensor_mm("Nobody", "Nothing") is None


# ---------------------------------------------------------------------- second reading
def test_known_files_are_not_read_again_and_give_the_same_collection(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(folder / "a.jpg", 3, exif=exif(make="Canon", model="Canon EOS 5D Mark II", focal_mm=35))
    (folder / "bad.jpg").write_bytes(b"not an image")
    scan = scan_image_folder(folder)
    (folder.parent / "stored").mkdir()
    RECORDS.write(folder.parent / "stored", scan.records)
    known = {record.name: record for record in RECORDS.read(folder.parent / "stored")}
    read_bytes, reads = Path.read_bytes, []

    def counting(path: Path) -> bytes:
        reads.append(path.name)
        return read_bytes(path)

    monkeypatch.setattr(Path, "read_bytes", counting)
    assert import_image_folder(folder, AUTO, known=known) == collection_from_scan(scan, AUTO)
    assert reads == []
    write(folder / "good2.png", 9)
    os.utime(folder / "good1.png", ns=(1, 1))
    import_image_folder(folder, AUTO, known=known)
    assert sorted(reads) == ["good1.png", "good2.png"]


def test_a_record_is_either_a_photo_or_a_reason(folder: Path) -> None:
    record = scan_image_folder(folder).records[0]
    with pytest.raises(ValueError, match=r"good1.png: a record has either a photo or a reason"):
        dataclasses.replace(record, reason="both")


def test_the_digest_follows_the_content(folder: Path) -> None:
    before = only_image(folder, "good1.png").digest
    assert only_image(folder, "good1.png").digest == before
    write(folder / "good1.png", 7)
    assert only_image(folder, "good1.png").digest != before


def test_threads_do_not_change_the_result(tmp_path: Path) -> None:
    for seed in range(12):
        write(tmp_path / f"{seed}.png", seed)
    one, many = (import_image_folder(tmp_path, AUTO, workers=workers) for workers in (1, 8))
    assert one == many


# ------------------------------------------------------------------- hostile and real
@pytest.mark.filterwarnings("ignore:.*:UserWarning")
@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif"])
def test_random_damage_never_escapes_as_another_error(tmp_path: Path, suffix: str) -> None:
    data = write(tmp_path / f"a.{suffix}", 1, exif=exif(focal_35mm=28)).read_bytes()
    generator = np.random.default_rng(0)
    refused = 0
    for _ in range(150):
        broken = bytearray(data)
        for position in generator.integers(0, min(len(data), 600), generator.integers(1, 8)):
            broken[position] = generator.integers(256)
        try:
            photo = images.inspect(bytes(broken))
            camera_prior.focal_prior_px(photo.tags, photo.width, photo.height)
        except InputError:
            refused += 1
    assert refused > 0


@pytest.mark.data
def test_the_shrunken_drone_photos_get_a_focal_length_near_the_reference(data_dir: Callable[[str], Path]) -> None:
    collection = import_image_folder(data_dir("caliterra_drone") / "images", AUTO)
    assert len(collection) == 75
    assert collection.rejected == ()
    (camera,) = collection.cameras
    assert camera.has_prior_focal
    # COLMAP refined it to 769.6 px; its own EXIF prior, 2904 px, ignores that the photos were shrunk.
    assert 0.95 < camera.focal_px / 769.6 < 1.05


@pytest.mark.data
def test_tourist_photographs_get_a_camera_each(data_dir: Callable[[str], Path]) -> None:
    collection = import_image_folder(data_dir("sacre_coeur") / "images", AUTO)
    assert len(collection) == 10
    assert len(collection.cameras) >= 8
