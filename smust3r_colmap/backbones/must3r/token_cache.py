"""Encoded images on disk, so that each is encoded once though segments overlap and loops come back to it.

One file per image, its name from the image's content and from all that the features depend on. What is there is
whole: writes are atomic, and files carry a checksum. What is not there, or is damaged, is encoded again,
so nothing but time depends on this cache. One process writes to the folder: the one that holds the run
directory. The drivers read a segment through ``TokenCache.images``.
"""

from __future__ import annotations

import logging
import os
import zlib
from collections import OrderedDict
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import overload

import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import Tensor

from smust3r_colmap.backbones.must3r.encoder import EncodedImage
from smust3r_colmap.errors import StorageError
from smust3r_colmap.storage.atomic_write import write_atomically

_log = logging.getLogger(__name__)

_SUFFIX = ".safetensors"
_FEATURES, _CHECKSUM = "features", "crc32"


class TokenCache:
    """A folder of encoded images of bounded size; the least recently used give way.

    Args:
        folder: made when needed. Files of other keys in it count, and give way like the others.
        key: of all that the features depend on besides the image: weights, image size, precision.
        limit_bytes: of all files together; 0 keeps nothing.
        dtype: in which features are stored. In that of the network's arithmetic the decoder loses nothing, for
            it starts by converting to it. bfloat16 under a float32 network moves points by 1e-4 of their
            distance (median, random weights of full size), float16 by 1e-5.
    """

    def __init__(self, folder: Path, *, key: str, limit_bytes: int, dtype: torch.dtype = torch.float32) -> None:
        self._folder = folder
        self._key = key
        self._limit_bytes = limit_bytes
        self._dtype = dtype
        self._takes_more = limit_bytes > 0
        self._sizes = _files_by_last_use(folder)
        self._make_room_for(0)

    @property
    def num_bytes(self) -> int:
        """Of all files in the folder."""
        return sum(self._sizes.values())

    def images(self, digests: Sequence[str], encode: Callable[[int], EncodedImage]) -> Sequence[EncodedImage]:
        """Encoded images that are loaded when indexed, and encoded when they are not here.

        Args:
            digests: of the content of each image file.
            encode: the image at a position of ``digests``.
        """
        return _CachedImages(self, digests, encode)

    def get(self, digest: str) -> EncodedImage | None:
        """The features of an image in float32 on the CPU; None if they are not here or damaged."""
        path = self._path(digest)
        if path.name not in self._sizes:
            return None
        try:
            image = _decoded(path.read_bytes())
            os.utime(path)
        except (OSError, SafetensorError, ValueError) as error:
            _log.warning("%s cannot be used (%s); the image is encoded again", path, error)
            self._forget(path.name)
            return None
        self._sizes.move_to_end(path.name)
        return image

    def put(self, digest: str, image: EncodedImage) -> None:
        """Keep the features of an image. A disk that refuses is said once, and nothing is kept from then on."""
        if not self._takes_more:
            return
        path = self._path(digest)
        content = _encoded(image, self._dtype)
        if len(content) > self._limit_bytes:
            return
        self._sizes.pop(path.name, None)  # about to be replaced
        self._make_room_for(len(content))
        try:
            write_atomically(path, content)
        except StorageError as error:
            self._takes_more = False
            _log.warning("%s; from now on encoded images are not cached, and encoded again when needed twice", error)
            return
        self._sizes[path.name] = len(content)

    def _path(self, digest: str) -> Path:
        return self._folder / f"{digest}-{self._key}{_SUFFIX}"

    def _make_room_for(self, num_bytes: int) -> None:
        while self._sizes and self.num_bytes + num_bytes > self._limit_bytes:
            self._forget(next(iter(self._sizes)))

    def _forget(self, name: str) -> None:
        del self._sizes[name]
        with suppress(OSError):  # what cannot be removed is not counted on either
            (self._folder / name).unlink()


class _CachedImages(Sequence[EncodedImage]):
    """The images of a segment; none stays in memory here."""

    def __init__(self, cache: TokenCache, digests: Sequence[str], encode: Callable[[int], EncodedImage]) -> None:
        self._cache = cache
        self._digests = digests
        self._encode = encode

    def __len__(self) -> int:
        return len(self._digests)

    @overload
    def __getitem__(self, position: int) -> EncodedImage: ...
    @overload
    def __getitem__(self, position: slice) -> Sequence[EncodedImage]: ...
    def __getitem__(self, position: int | slice) -> EncodedImage | Sequence[EncodedImage]:
        if isinstance(position, slice):
            return [self[k] for k in range(len(self))[position]]
        k = range(len(self))[position]
        image = self._cache.get(self._digests[k])
        if image is None:
            image = self._encode(k)
            self._cache.put(self._digests[k], image)
        return image


def _files_by_last_use(folder: Path) -> OrderedDict[str, int]:
    """Size of every file by its name, least recently used first."""
    found: list[tuple[float, str, int]] = []
    for path in folder.glob(f"*{_SUFFIX}"):
        with suppress(OSError):  # gone in the meantime
            facts = path.stat()
            found.append((facts.st_mtime, path.name, facts.st_size))
    return OrderedDict((name, size) for _, name, size in sorted(found))


def _encoded(image: EncodedImage, dtype: torch.dtype) -> bytes:
    """A safetensors file: features (rows, columns, C) and a checksum of their bytes."""
    features = image.features.detach().to("cpu", dtype).reshape(image.rows, image.columns, -1).contiguous()
    return safetensors.torch.save({_FEATURES: features, _CHECKSUM: torch.tensor(_checksum(features))})


def _decoded(content: bytes) -> EncodedImage:
    """Raises SafetensorError or ValueError where the content is not what was written."""
    tensors = safetensors.torch.load(content)
    if tensors.keys() != {_FEATURES, _CHECKSUM}:
        raise ValueError(f"holds {sorted(tensors)}")
    features = tensors[_FEATURES]
    if features.ndim != 3 or int(tensors[_CHECKSUM]) != _checksum(features):
        raise ValueError("does not match its checksum")
    rows, columns = features.shape[:2]
    return EncodedImage(features=features.flatten(0, 1).float(), rows=rows, columns=columns)


def _checksum(features: Tensor) -> int:
    return zlib.crc32(features.flatten().view(torch.uint8).numpy().data)
