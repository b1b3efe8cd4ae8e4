"""Encoded images on disk: exact, bounded, and never a reason to fail."""

from __future__ import annotations

import errno
import logging
import os
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from smust3r_colmap.backbones.must3r.encoder import EncodedImage
from smust3r_colmap.backbones.must3r.token_cache import TokenCache

ROWS, COLUMNS, WIDTH = 3, 4, 32
PLENTY = 1 << 20


def some_image(seed: int) -> EncodedImage:
    features = torch.randn(ROWS * COLUMNS, WIDTH, generator=torch.Generator().manual_seed(seed))
    return EncodedImage(features=features, rows=ROWS, columns=COLUMNS)


def cache_in(folder: Path, limit_bytes: int = PLENTY, key: str = "k") -> TokenCache:
    return TokenCache(folder, key=key, limit_bytes=limit_bytes)


def size_of_one(folder: Path) -> int:
    cache = cache_in(folder / "one")
    cache.put("a", some_image(0))
    return cache.num_bytes


def counting_encoder(encoded: list[int]) -> Callable[[int], EncodedImage]:
    def encode(k: int) -> EncodedImage:
        encoded.append(k)
        return some_image(k)

    return encode


def stored_files(folder: Path) -> list[Path]:
    return sorted(folder.iterdir())


def test_every_image_is_encoded_once_and_comes_back_bit_by_bit(tmp_path: Path) -> None:
    encoded: list[int] = []
    cache = cache_in(tmp_path)
    images = cache.images(["a", "b", "c"], counting_encoder(encoded))
    for _ in range(2):
        for k in range(3):
            assert torch.equal(images[k].features, some_image(k).features)
            assert images[k].grid == (ROWS, COLUMNS)
    overlapping = cache.images(["c", "d"], lambda k: counting_encoder(encoded)(k + 2))
    assert torch.equal(overlapping[0].features, some_image(2).features)
    assert torch.equal(overlapping[1].features, some_image(3).features)
    assert encoded == [0, 1, 2, 3]


def test_the_next_run_finds_them_and_another_key_does_not(tmp_path: Path) -> None:
    cache_in(tmp_path).put("a", some_image(0))
    found = cache_in(tmp_path).get("a")
    assert found is not None
    assert torch.equal(found.features, some_image(0).features)
    assert cache_in(tmp_path, key="other").get("a") is None
    assert cache_in(tmp_path).get("b") is None


def test_it_is_a_sequence(tmp_path: Path) -> None:
    images = cache_in(tmp_path).images(["a", "b", "c"], some_image)
    assert len(images) == 3
    assert torch.equal(images[-1].features, some_image(2).features)
    assert [image.grid for image in images[1:]] == [(ROWS, COLUMNS)] * 2
    assert len(list(images)) == 3
    with pytest.raises(IndexError):
        images[3]


def test_no_image_stays_in_memory(tmp_path: Path) -> None:
    images = cache_in(tmp_path).images(["a"], some_image)
    assert images[0] is not images[0]


@pytest.mark.parametrize(("dtype", "error"), [(torch.bfloat16, 2**-8), (torch.float16, 2**-11)])
def test_half_the_disk_costs_the_rounding_of_the_type(tmp_path: Path, dtype: torch.dtype, error: float) -> None:
    cache = TokenCache(tmp_path, key="k", limit_bytes=PLENTY, dtype=dtype)
    cache.put("a", some_image(0))
    found = cache.get("a")
    assert found is not None
    assert found.features.dtype == torch.float32
    relative = ((found.features - some_image(0).features) / some_image(0).features).abs().max()
    assert error / 4 < relative <= error
    assert 0.4 < cache.num_bytes / size_of_one(tmp_path) < 0.7


# --------------------------------------------------------------------------------- the bound
def test_the_least_recently_used_give_way(tmp_path: Path) -> None:
    cache = cache_in(tmp_path / "cache", limit_bytes=3 * size_of_one(tmp_path))
    for number, digest in enumerate("abc"):
        cache.put(digest, some_image(number))
    assert cache.get("a") is not None  # now b is the oldest
    cache.put("d", some_image(3))
    assert [digest for digest in "abcd" if cache.get(digest) is not None] == ["a", "c", "d"]
    assert len(stored_files(tmp_path / "cache")) == 3


def test_the_order_of_use_outlives_the_run(tmp_path: Path) -> None:
    size = size_of_one(tmp_path)
    folder = tmp_path / "cache"
    cache = cache_in(folder)
    for number, digest in enumerate("abc"):
        cache.put(digest, some_image(number))
    for age, path in enumerate(stored_files(folder)):  # a, b, c, all of long ago
        os.utime(path, (1000 + age, 1000 + age))
    assert cache.get("a") is not None
    smaller = cache_in(folder, limit_bytes=2 * size)
    assert [digest for digest in "abc" if smaller.get(digest) is not None] == ["a", "c"]


def test_files_of_other_settings_count_and_give_way_first(tmp_path: Path) -> None:
    size = size_of_one(tmp_path)
    folder = tmp_path / "cache"
    cache_in(folder, key="old").put("a", some_image(0))
    cache = cache_in(folder, key="new", limit_bytes=2 * size + 10)
    assert cache.num_bytes == size
    cache.put("a", some_image(0))
    cache.put("b", some_image(1))
    assert cache.get("a") is not None
    assert cache_in(folder, key="old").get("a") is None


def test_an_image_kept_again_is_the_most_recently_used(tmp_path: Path) -> None:
    cache = cache_in(tmp_path / "cache", limit_bytes=2 * size_of_one(tmp_path))
    for number in (0, 1, 0, 2):
        cache.put(f"{number}", some_image(number))
    assert [number for number in range(3) if cache.get(f"{number}") is not None] == [0, 2]


def test_the_same_image_again_takes_no_more_room(tmp_path: Path) -> None:
    cache = cache_in(tmp_path)
    for _ in range(3):
        cache.put("a", some_image(0))
    assert cache.num_bytes == sum(path.stat().st_size for path in stored_files(tmp_path))
    assert len(stored_files(tmp_path)) == 1


@pytest.mark.parametrize("limit_bytes", [0, 100])
def test_a_cache_too_small_for_one_image_keeps_nothing(tmp_path: Path, limit_bytes: int) -> None:
    encoded: list[int] = []
    images = cache_in(tmp_path / "cache", limit_bytes=limit_bytes).images(["a"], counting_encoder(encoded))
    for _ in range(2):
        assert torch.equal(images[0].features, some_image(0).features)
    assert encoded == [0, 0]
    assert not (tmp_path / "cache").exists() or not stored_files(tmp_path / "cache")


# ----------------------------------------------------------------------------------- damage
def flip_a_bit(content: bytes) -> bytes:
    middle = len(content) - 200  # inside the features
    return content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]


@pytest.mark.parametrize(
    "damage",
    [lambda content: content[:-7], lambda content: b"", lambda content: b"text" * 99, flip_a_bit],
    ids=["cut off", "empty", "other content", "one bit"],
)
def test_a_damaged_file_is_encoded_again(
    tmp_path: Path, damage: Callable[[bytes], bytes], caplog: pytest.LogCaptureFixture
) -> None:
    encoded: list[int] = []
    images = cache_in(tmp_path).images(["a"], counting_encoder(encoded))
    assert len(images[0].features) == ROWS * COLUMNS
    (path,) = stored_files(tmp_path)
    path.write_bytes(damage(path.read_bytes()))
    for _ in range(2):
        assert torch.equal(images[0].features, some_image(0).features)
    assert encoded == [0, 0]
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert "encoded again" in caplog.text


def test_a_file_that_was_taken_away_is_encoded_again(tmp_path: Path) -> None:
    encoded: list[int] = []
    images = cache_in(tmp_path).images(["a"], counting_encoder(encoded))
    assert len(images[0].features) == ROWS * COLUMNS
    stored_files(tmp_path)[0].unlink()
    assert torch.equal(images[0].features, some_image(0).features)
    assert encoded == [0, 0]
    assert len(stored_files(tmp_path)) == 1


def test_a_full_disk_is_said_once_and_the_run_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    cache = cache_in(tmp_path)
    cache.put("a", some_image(0))

    def full(path: Path, content: bytes) -> int:
        with path.open("wb") as file:
            file.write(content[:10])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", full)
    encoded: list[int] = []
    images = cache.images(["a", "b", "c"], counting_encoder(encoded))
    for k in (0, 1, 2, 1):
        assert torch.equal(images[k].features, some_image(k).features)
    assert encoded == [1, 2, 1]  # the first is still here
    assert [record.getMessage().count("No space left") for record in caplog.records] == [1]
    assert [path.suffix for path in stored_files(tmp_path)] == [".safetensors"]


def test_a_folder_that_cannot_be_made_is_no_error(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "file").write_text("in the way")
    images = cache_in(tmp_path / "file" / "cache").images(["a"], some_image)
    assert torch.equal(images[0].features, some_image(0).features)
    assert "encoded images are not cached" in caplog.text
