"""Thumbnails are small, upright, and what has none is named."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from smust3r_colmap.report.thumbnails import MAX_BYTES, SIDE_PX, make_thumbnails


def test_thumbnails_keep_the_shape_and_are_bounded_also_of_noise(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    wide, tall = tmp_path / "wide.jpg", tmp_path / "tall.png"
    Image.fromarray(rng.integers(0, 256, (300, 900, 3), dtype=np.uint8)).save(wide)
    Image.new("RGB", (50, 200), (200, 120, 40)).save(tall)
    found, note = make_thumbnails([wide, tall], workers=2)
    assert note == ""
    assert all(len(data) <= MAX_BYTES for data in found.values())
    assert Image.open(io.BytesIO(found[wide])).size == (SIDE_PX, SIDE_PX // 3)
    assert Image.open(io.BytesIO(found[tall])).size == (SIDE_PX // 4, SIDE_PX)


def test_a_turned_photo_is_upright(tmp_path: Path) -> None:
    pixels = np.zeros((100, 200, 3), np.uint8)
    pixels[:, :100] = 255
    exif = Image.Exif()
    exif[0x0112] = 6  # the left side of the stored pixels is the top
    Image.fromarray(pixels).save(tmp_path / "turned.jpg", exif=exif)
    found, _ = make_thumbnails([tmp_path / "turned.jpg"], workers=1)
    small = np.asarray(Image.open(io.BytesIO(found[tmp_path / "turned.jpg"])).convert("L"))
    assert small.shape == (SIDE_PX, SIDE_PX // 2)
    assert small[5].mean() > 250
    assert small[-5].mean() < 5


def test_12_bits_in_a_16_bit_file_are_not_black(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "deep.png"), np.full((64, 64), 4095, np.uint16))
    found, _ = make_thumbnails([tmp_path / "deep.png"], workers=1)
    assert np.asarray(Image.open(io.BytesIO(found[tmp_path / "deep.png"]))).min() > 250


def test_files_that_cannot_be_read_are_named_and_counted(tmp_path: Path) -> None:
    good = tmp_path / "good.png"
    Image.new("RGB", (64, 64)).save(good)
    broken = tmp_path / "broken.jpg"
    broken.write_bytes(b"\xff\xd8\xffnothing")
    found, note = make_thumbnails([broken, good, tmp_path / "gone.png"], workers=1)
    assert list(found) == [good]
    assert note.startswith("broken.jpg: ")
    assert note.endswith("(and 1 more)")
