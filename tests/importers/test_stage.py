"""What an import says of masks, alpha, EXIF and files that are no images."""

from __future__ import annotations

import io
import re
from pathlib import Path

import numpy as np
import pytest
from helpers.runs import quiet_run
from PIL import Image

from smust3r_colmap.config import RunConfig
from smust3r_colmap.execution.progress import PlainReporter
from smust3r_colmap.geometry.arrays import UInt8Array
from smust3r_colmap.importers.stage import ImageSource, read_images
from smust3r_colmap.products import ImageCollection

SHAPE = (60, 80)


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for number in range(4):
        Image.fromarray(rng.integers(0, 255, (*SHAPE, 3), np.uint8)).save(folder / f"{number}.png")
    return folder


def imported(photos: Path, masks: Path | None = None) -> tuple[str, ImageCollection]:
    """What was said, and the images."""
    told = io.StringIO()
    with quiet_run(photos.parent / "out", PlainReporter(told)) as run:
        _, collection = read_images(run, ImageSource(folder=photos), RunConfig(masks=masks), overwrite=False)
    return told.getvalue(), collection


def write_masks(folder: Path, *masks: UInt8Array) -> Path:
    folder.mkdir()
    for number, mask in enumerate(masks):
        Image.fromarray(mask).save(folder / f"{number}.png")
    return folder


def mask(left_out: float) -> UInt8Array:
    kept = np.full(SHAPE, 255, np.uint8)
    kept[:, : round(SHAPE[1] * left_out)] = 0
    return kept


def test_the_share_of_the_pixels_that_masks_leave_out_is_said(photos: Path, tmp_path: Path) -> None:
    told, _ = imported(photos, write_masks(tmp_path / "masks", mask(0.2), mask(0.2), mask(0.4), mask(0.0)))
    assert "the masks leave out 20.0% of the pixels of their images" in told
    assert "warning" not in told


@pytest.mark.parametrize(
    ("left_out", "told"),
    [
        (0.0, "warning: the masks leave out 0.0% of the pixels .* labels whose background is not 0, or inverted"),
        (1.0, "warning: the masks leave out 100.0% of the pixels .* are they empty, or inverted"),
        (0.8, "warning: that is more than half; .* inverted"),
    ],
)
def test_masks_of_nothing_and_of_all_are_warned_about(photos: Path, tmp_path: Path, left_out: float, told: str) -> None:
    text, _ = imported(photos, write_masks(tmp_path / "masks", *[mask(left_out)] * 4))
    assert re.search(told, text)


def test_single_masks_that_leave_out_all_are_named(photos: Path, tmp_path: Path) -> None:
    told, _ = imported(photos, write_masks(tmp_path / "masks", mask(0.1), mask(1.0), mask(0.1), mask(0.1)))
    assert "warning: the masks of 1 images leave out all of their pixels, such as that of 1.png" in told


def test_alpha_is_told_and_used(photos: Path) -> None:
    for path in sorted(photos.iterdir())[:2]:
        Image.fromarray(np.dstack([np.asarray(Image.open(path)), mask(0.25)])).save(path)
    told, collection = imported(photos)
    assert "alpha is the mask of 2 images, such as 0.png" in told
    assert "the masks leave out 25.0%" in told
    assert [image.mask is not None for image in collection.images] == [True, True, False, False]


@pytest.mark.filterwarnings("ignore:.*EXIF.*:UserWarning")
def test_what_is_not_read_is_named_once(photos: Path) -> None:
    for name in ("2.png", "3.png"):
        Image.open(photos / name).save(photos / f"{name}.jpg", exif=b"Exif\0\0MM\0*\0\0\0\x08\xff\xff" + b"\xff" * 60)
    (photos / "notes.txt").touch()
    (photos / "raw.CR2").touch()
    told, collection = imported(photos)
    assert "the EXIF of 2 images cannot be read and is not used, such as that of 2.png.jpg" in told
    assert "passed over, for they are no images: 1 .txt" in told
    assert "warning: left out: raw.CR2 (images of kind .cr2 are not read; convert it" in told
    assert [one.name for one in collection.rejected] == ["raw.CR2"], "counted, so that the run ends in 3"
