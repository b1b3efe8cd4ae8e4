"""Image files of all kinds, as cameras, phones and programs write them."""

from __future__ import annotations

import builtins
import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from smust3r_colmap.config import CameraConfig
from smust3r_colmap.errors import ImageError
from smust3r_colmap.geometry.arrays import UInt8Array
from smust3r_colmap.importers.image_folder import import_image_folder
from smust3r_colmap.importers.images import inspect, load_alpha, load_rgb
from smust3r_colmap.products import SourceImage

WIDTH, HEIGHT = 160, 120


def picture(seed: int = 0) -> UInt8Array:
    """(H, W, 3) smooth, so that it survives JPEG."""
    rng = np.random.default_rng(seed)
    return np.asarray(cv2.resize(rng.integers(0, 255, (6, 8, 3), np.uint8), (WIDTH, HEIGHT)))


def encoded(pixels: UInt8Array, kind: str, **options: Any) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, kind, **options)
    return file.getvalue()


def source(path: Path, **fields: Any) -> SourceImage:
    plain = SourceImage(name=path.name, path=path, width=WIDTH, height=HEIGHT, camera=0, digest="")
    return replace(plain, **fields)


@pytest.mark.parametrize(
    ("name", "kind", "error"),
    [
        ("a.bmp", "BMP", 0.01),
        ("a.jfif", "JPEG", 4),
        ("a.JPE", "JPEG", 4),
        ("a.gif", "GIF", 30),
        ("a.jp2", "JPEG2000", 0.01),
        ("a.avif", "AVIF", 6),
    ],
)
def test_formats_that_people_have_are_read(tmp_path: Path, name: str, kind: str, error: float) -> None:
    (tmp_path / name).write_bytes(encoded(picture(), kind))
    (tmp_path / "b.png").write_bytes(encoded(picture(1), "PNG"))
    collection = import_image_folder(tmp_path, CameraConfig())
    assert [image.name for image in collection.images] == [name, "b.png"]
    assert collection.rejected == ()
    found = load_rgb(collection.images[0])
    assert np.abs(found.astype(int) - picture()).mean() <= error


def test_of_an_animation_the_first_frame_is_read(tmp_path: Path) -> None:
    frames = [Image.fromarray(np.full((HEIGHT, WIDTH), grey, np.uint8)) for grey in (40, 200)]
    frames[0].save(tmp_path / "a.gif", save_all=True, append_images=frames[1:])
    assert load_rgb(source(tmp_path / "a.gif")).mean() == pytest.approx(40, abs=1)


def test_heic_without_its_package_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name == "pillow_heif":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImageError, match=r"pip install 'smust3r-colmap\[heic\]', or convert it to JPEG"):
        inspect(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + b"\0" * 100)


def test_heic_is_read_where_its_package_is(tmp_path: Path) -> None:
    heif = pytest.importorskip("pillow_heif")
    heif.from_pillow(Image.fromarray(picture())).save(tmp_path / "a.heic", quality=95)
    assert np.abs(load_rgb(source(tmp_path / "a.heic")).astype(int) - picture()).mean() < 4


def test_a_jpeg_that_lacks_only_its_end_marker_is_read(tmp_path: Path) -> None:
    data = encoded(picture(), "JPEG", quality=92)
    for missing in (1, 2):
        (tmp_path / "a.jpg").write_bytes(data[:-missing])
        assert inspect(data[:-missing]).width == WIDTH
        whole = np.asarray(Image.open(io.BytesIO(data)))
        assert np.array_equal(load_rgb(source(tmp_path / "a.jpg")), whole)


@pytest.mark.parametrize("kept", [0.4, 0.9], ids=["cut in the middle", "near its end"])
@pytest.mark.parametrize("rest", [b"", b"\0"], ids=["missing", "zeros"])
@pytest.mark.parametrize("progressive", [False, True])
def test_a_jpeg_whose_pixels_are_missing_is_refused(kept: float, rest: bytes, progressive: bool) -> None:
    data = encoded(picture(), "JPEG", quality=92, progressive=progressive)
    cut = round(len(data) * kept)
    with pytest.raises(ImageError, match="damaged, cut off"):
        inspect(data[:cut] + rest * (len(data) - cut))


# ------------------------------------------------------------------------------ 16 bits
def write_sixteen_bits(path: Path, peak: int) -> None:
    values = picture().astype(np.float64) / picture().max() * peak
    cv2.imwrite(str(path), values.round().astype(np.uint16)[:, :, ::-1])


def test_images_of_one_camera_are_scaled_by_one_number_of_bits(tmp_path: Path) -> None:
    """The brightest pixels lie on either side of a quarter of the range: by file, brightness would jump by four."""
    for number, peak in enumerate((16100, 16700, 16200)):
        write_sixteen_bits(tmp_path / f"{number}.png", peak)
    images = import_image_folder(tmp_path, CameraConfig()).images
    assert [image.bits for image in images] == [16, 16, 16]
    means = [load_rgb(image).mean() for image in images]
    assert max(means) / min(means) < 1.06
    per_image = import_image_folder(tmp_path, CameraConfig(camera_mode="per-image")).images
    assert [image.bits for image in per_image] == [16, 16, 16]


def test_bits_are_those_of_the_folder(tmp_path: Path) -> None:
    """Another folder is another camera, and 12 bits there do not come out dark."""
    for folder, peak in (("a", 4000), ("b", 65535)):
        (tmp_path / folder).mkdir()
        for number in range(2):
            write_sixteen_bits(tmp_path / folder / f"{number}.png", peak - number)
    assert [image.bits for image in import_image_folder(tmp_path, CameraConfig()).images] == [12, 12, 16, 16]


def test_bits_of_alpha_do_not_count(tmp_path: Path) -> None:
    values = np.dstack([picture().astype(np.uint16) * 15, np.full((HEIGHT, WIDTH), 65535, np.uint16)])
    cv2.imwrite(str(tmp_path / "a.png"), values)
    assert inspect((tmp_path / "a.png").read_bytes()).bits == 12


# -------------------------------------------------------------------------------- alpha
@pytest.mark.parametrize("kind", ["PNG", "WEBP"])
def test_alpha_is_a_mask(tmp_path: Path, kind: str) -> None:
    alpha = np.zeros((HEIGHT, WIDTH), np.uint8)
    alpha[:, 40:] = 255
    path = tmp_path / "a.png"
    path.write_bytes(encoded(np.dstack([picture(), alpha]), kind, lossless=True))
    assert inspect(path.read_bytes()).transparent == pytest.approx(0.25)
    kept = load_alpha(source(path))
    assert kept is not None
    assert np.array_equal(kept, alpha)


def test_alpha_is_turned_with_its_image(tmp_path: Path) -> None:
    alpha = np.zeros((HEIGHT, WIDTH), np.uint8)
    alpha[:30] = 255
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    Image.fromarray(np.dstack([picture(), alpha])).save(tmp_path / "a.png", exif=exif)
    kept = load_alpha(source(tmp_path / "a.png", width=HEIGHT, height=WIDTH))
    assert kept is not None
    assert np.array_equal(kept, np.rot90(alpha, -1))


@pytest.mark.parametrize("mode", ["RGB", "L"])
def test_images_without_alpha_have_none(tmp_path: Path, mode: str) -> None:
    Image.fromarray(picture()).convert(mode).save(tmp_path / "a.png")
    assert inspect((tmp_path / "a.png").read_bytes()).transparent == 0
    assert load_alpha(source(tmp_path / "a.png")) is None


# ------------------------------------------------------------------ orientation and EXIF
def test_a_file_is_read_as_stored_where_only_that_has_the_size_of_its_image(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    Image.fromarray(picture()).save(tmp_path / "a.png", exif=exif)
    assert np.array_equal(load_rgb(source(tmp_path / "a.png")), picture())
    upright = load_rgb(source(tmp_path / "a.png", width=HEIGHT, height=WIDTH))
    assert np.array_equal(upright, np.rot90(picture(), -1))


@pytest.mark.parametrize("exif", [b"Exif\0\0MM\0*\0\0\0\x08\xff\xff" + b"\xff" * 60, b"Exif\0\0MM\0*"])
@pytest.mark.filterwarnings("ignore:.*EXIF.*:UserWarning")
def test_exif_that_cannot_be_read_is_told(exif: bytes) -> None:
    found = inspect(encoded(picture(), "JPEG", exif=exif))
    assert found.exif_unreadable
    assert not inspect(encoded(picture(), "JPEG")).exif_unreadable


def test_zeros_in_exif_are_no_focal_length() -> None:
    exif = Image.Exif()
    exif[ExifTags.IFD.Exif] = {
        ExifTags.Base.FocalLength: IFDRational(0, 0),
        ExifTags.Base.FocalLengthIn35mmFilm: 0,
        ExifTags.Base.DigitalZoomRatio: IFDRational(0, 1),
    }
    found = inspect(encoded(picture(), "JPEG", exif=exif.tobytes()))
    assert (found.tags.focal_mm, found.tags.focal_35mm, found.tags.digital_zoom) == (None, None, None)
    assert not found.exif_unreadable


def test_digital_zoom_makes_cameras_of_their_own(tmp_path: Path) -> None:
    for number, zoom in enumerate((1.0, 1.5, 1.0, 1.5)):
        exif = Image.Exif()
        exif[ExifTags.IFD.Exif] = {
            ExifTags.Base.FocalLength: IFDRational(57, 10),
            ExifTags.Base.FocalLengthIn35mmFilm: 32,
            ExifTags.Base.DigitalZoomRatio: IFDRational(round(zoom * 10), 10),
        }
        (tmp_path / f"{number}.jpg").write_bytes(encoded(picture(number), "JPEG", exif=exif.tobytes()))
    collection = import_image_folder(tmp_path, CameraConfig())
    assert [image.camera for image in collection.images] == [0, 1, 0, 1]
