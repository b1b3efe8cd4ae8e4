"""From photo to network: the published bits, and the exact way back."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch
from helpers.reference_vectors import needs_vectors, vectors
from PIL import ExifTags, Image

from smust3r_colmap.backbones.must3r import preprocessing
from smust3r_colmap.backbones.must3r.preprocessing import (
    RESOLUTIONS,
    NetworkImage,
    NetworkWindow,
    choose_window,
    preprocess,
    resolutions_of,
)
from smust3r_colmap.geometry.arrays import FloatArray, UInt8Array


def noise_photo(height: int, width: int, seed: int = 0) -> UInt8Array:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def coordinates_photo(height: int, width: int) -> UInt8Array:
    """Red is the column, green the row."""
    photo = np.zeros((height, width, 3), np.uint8)
    photo[..., 0], photo[..., 1] = np.arange(width), np.arange(height)[:, None]
    return photo


def published_map(window: NetworkWindow) -> FloatArray:
    """(3, 3) as published: between pixels whose centres are whole numbers, and with the crop's shift unrounded.

    Off the exact map by half a pixel where the sides differ by an odd number, and by another (scale - 1) / 2 for
    the meaning of the coordinates (the network specification, sections 8.1 and 16.7).
    """
    matrix = window.orig_from_net
    matrix[0, 2] = (window.width_orig - window.crop_width) / 2
    matrix[1, 2] = (window.height_orig - window.crop_height) / 2
    return matrix


# ------------------------------------------------------------------------------- vectors
@needs_vectors
@pytest.mark.parametrize("i", range(8))
def test_offline_route_gives_the_published_bits_and_matrix(i: int) -> None:
    stored = vectors("inputs.npz")
    table = [(int(longer), int(shorter)) for longer, shorter in stored["resolution_table_values_long_short"]]
    made = preprocess(stored[f"raw_{i}"], 64, resolutions=table)
    assert made.pixels.dtype == torch.float32
    np.testing.assert_array_equal(made.pixels.numpy(), stored[f"img_{i}"])
    assert (made.window.height, made.window.width) == tuple(stored[f"true_shape_{i}"])
    np.testing.assert_allclose(published_map(made.window), stored[f"to_orig_{i}"], rtol=0, atol=1e-12)


@needs_vectors
@pytest.mark.parametrize("case", range(3))
def test_official_sizes_give_the_published_bits(case: int) -> None:
    stored = vectors("preprocess_official_sizes.npz")
    photo, size = stored[f"case{case}_raw"], int(stored[f"case{case}_size"])
    made = preprocess(photo, size)
    np.testing.assert_array_equal(made.pixels.numpy()[:, ::4, ::4], stored[f"case{case}_img_every4"])
    pixels = made.pixels.double()
    moments = [float(pixels.mean()), float(pixels.std(correction=0))]
    np.testing.assert_allclose(moments, stored[f"case{case}_img_mean_std"], atol=1e-6)


@needs_vectors
def test_every_published_choice_of_shape_is_made_again() -> None:
    rows = vectors("preprocess_official_sizes.npz")["resolution_choice_size_inH_inW_outH_outW"]
    assert len(rows) == 78
    for size, height, width, out_height, out_width in rows.tolist():
        window = choose_window(width, height, resolutions_of(size))
        assert (window.height, window.width) == (out_height, out_width), (size, height, width)


# ------------------------------------------------------------------------- the way back
@pytest.mark.parametrize(("height", "width"), [(187, 250), (250, 187), (103, 251), (201, 201), (131, 77)])
@pytest.mark.parametrize("size", [64, 224])
def test_exact_map_leads_to_the_photo_pixel_that_was_seen(height: int, width: int, size: int) -> None:
    made = preprocess(coordinates_photo(height, width), size)
    seen = (made.pixels.numpy() + 1) / 2 * 255 + 0.5  # a pixel's value is its index, its centre is half more
    x, y = np.meshgrid(np.arange(made.window.width) + 0.5, np.arange(made.window.height) + 0.5)
    to_orig = made.window.orig_from_net
    inner = (slice(4, -4), slice(4, -4))
    off_x, off_y = to_orig[0, 0] * x + to_orig[0, 2] - seen[0], to_orig[1, 1] * y + to_orig[1, 2] - seen[1]
    assert abs(off_x[inner].mean()) < 0.03
    assert abs(off_y[inner].mean()) < 0.03


def test_published_map_is_off_the_exact_one_by_half_a_pixel_of_an_odd_crop() -> None:
    window = preprocess(noise_photo(66, 84), 64, resolutions=[(64, 48)]).window
    off = published_map(window) - window.orig_from_net
    assert off[1, 2] == -0.5  # (66 - 63) / 2 = 1.5, cropped at 2
    assert np.count_nonzero(off) == 1


def test_whole_photo_without_crop_has_no_shift() -> None:
    window = preprocess(noise_photo(96, 128), 64, resolutions=[(64, 48)]).window
    np.testing.assert_array_equal(window.orig_from_net, np.diag([2.0, 2.0, 1.0]))
    assert window.seen_share == 1.0


# -------------------------------------------------------------------------------- shapes
@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        ((300, 300), (384, 512)),  # a square becomes landscape
        ((400, 300), (512, 384)),
        ((300, 400), (384, 512)),
        ((100, 1000), (160, 512)),
        ((1000, 100), (512, 160)),
        ((1, 1), (384, 512)),
        ((3, 900), (160, 512)),
        ((384, 512), (384, 512)),
    ],
)
def test_any_photo_gets_one_of_the_shapes(shape: tuple[int, int], expected: tuple[int, int]) -> None:
    photo = noise_photo(*shape)
    made = preprocess(photo, 512)
    assert tuple(made.pixels.shape) == (3, *expected)
    assert torch.isfinite(made.pixels).all()
    assert float(made.pixels.abs().max()) <= 1.0 + 1e-6  # a bilinear filter does not overshoot
    window = made.window
    assert 0 <= window.left <= window.left + window.crop_width <= shape[1]
    assert 0 <= window.top <= window.top + window.crop_height <= shape[0]


def test_panorama_says_how_much_of_it_is_seen() -> None:
    assert preprocess(noise_photo(100, 1000), 512).window.seen_share == pytest.approx(0.32)


def test_photo_of_the_networks_shape_is_only_normalised() -> None:
    photo = noise_photo(384, 512)
    made = preprocess(photo, 512)
    np.testing.assert_allclose(made.pixels.numpy().transpose(1, 2, 0), photo / 127.5 - 1, atol=1e-6)


def test_one_pixel_becomes_an_even_image() -> None:
    made = preprocess(np.full((1, 1, 3), 51, np.uint8), 224)
    np.testing.assert_allclose(made.pixels.numpy(), 51 / 127.5 - 1, atol=1e-6)


def test_rows_at_a_time_give_the_same_bits_as_all_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    photo = noise_photo(701, 533)
    by_strips = preprocess(photo, 512).pixels
    monkeypatch.setattr(preprocessing, "ROWS_AT_A_TIME", 10_000)
    assert torch.equal(by_strips, preprocess(photo, 512).pixels)


@pytest.mark.slow
def test_40_megapixels_take_less_memory_than_their_floats() -> None:
    script = (
        "import resource, numpy as np\n"
        "from smust3r_colmap.backbones.must3r.preprocessing import preprocess\n"
        "photo = np.zeros((5000, 8000, 3), np.uint8)\n"
        "preprocess(photo[:600, :800], 512)\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "assert preprocess(photo, 512).pixels.shape == (3, 336, 512)\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)
    grown_mib = int(done.stdout) / 1024
    assert grown_mib < 200  # 458 as floats, of which several copies at once


# --------------------------------------------------------------------------------- sizes
def test_rule_for_other_sizes_gives_the_published_shapes_at_512(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preprocessing, "RESOLUTIONS", _OnlyAsPattern(RESOLUTIONS))
    assert resolutions_of(512) == RESOLUTIONS[512]


class _OnlyAsPattern(dict[int, tuple[tuple[int, int], ...]]):
    def __contains__(self, key: object) -> bool:
        return False


@pytest.mark.parametrize("size", [16, 32, 64, 128, 256, 640, 1024])
def test_shapes_of_other_sizes_are_whole_patches_of_falling_height(size: int) -> None:
    shapes = resolutions_of(size)
    shorter = [side for _, side in shapes]
    assert shorter == sorted(set(shorter), reverse=True)
    assert all(longer == size and side % 16 == 0 and 16 <= side <= size for longer, side in shapes)


def test_shapes_at_256_and_640_are_as_documented() -> None:
    assert [side for _, side in resolutions_of(256)] == [192, 160, 144, 128, 80]
    assert [side for _, side in resolutions_of(640)] == [480, 416, 352, 320, 192]


# --------------------------------------------------------------------------------- input
def test_pillow_image_gives_the_same_as_its_array_and_its_orientation_is_ignored() -> None:
    photo = noise_photo(60, 90)
    image = Image.fromarray(photo)
    image.getexif()[ExifTags.Base.Orientation] = 6
    assert torch.equal(preprocess(image, 64).pixels, preprocess(photo, 64).pixels)


def test_grey_pillow_image_becomes_three_equal_channels() -> None:
    made = preprocess(Image.fromarray(noise_photo(60, 90)[..., 0]), 64)
    assert torch.equal(made.pixels[0], made.pixels[2])


@pytest.mark.parametrize(
    "image",
    [np.zeros((4, 4), np.uint8), np.zeros((4, 4, 4), np.uint8), np.zeros((4, 4, 3)), np.zeros((0, 4, 3), np.uint8)],
)
def test_arrays_that_are_no_photo_are_refused(image: UInt8Array) -> None:
    with pytest.raises(ValueError, match=r"\(H, W, 3\) uint8 is needed"):
        preprocess(image, 512)


@pytest.mark.parametrize("size", [0, -16, 100])
def test_sizes_that_are_no_whole_patches_are_refused(size: int) -> None:
    with pytest.raises(ValueError, match=f"network size {size}: a multiple of 16"):
        preprocess(noise_photo(20, 20), size)


def test_network_image_must_have_the_size_of_its_window() -> None:
    window = NetworkWindow(
        width_orig=64, height_orig=48, left=0, top=0, crop_width=64, crop_height=48, width=64, height=48
    )
    with pytest.raises(ValueError, match=r"pixels \(3, 64, 48\), window \(3, 48, 64\)"):
        NetworkImage(pixels=torch.zeros(3, 64, 48), window=window)
