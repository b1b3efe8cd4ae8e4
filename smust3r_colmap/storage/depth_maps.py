"""One depth map per image of all models of a run, on disk: ``DepthMaps``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from smust3r_colmap.products import DepthMaps
from smust3r_colmap.storage.run_directory import (
    CARRIED_DEPTH_STAGE,
    STITCHED_STAGE,
    read_array,
    read_json,
    write_arrays,
    write_json,
)

_NAMES = "depth_names.json"


class DepthMapWriter:
    """Writes maps one by one, a file each, so that few are in memory at once.

    Args:
        folder: of a stage, existing; ``finish`` makes it readable.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._number: dict[str, int] = {}

    def write(self, name: str, depth: npt.NDArray[np.float32], confidence: npt.NDArray[np.float32]) -> None:
        """Depth (H, W) and confidence (H, W) of an image; the first map of a name counts."""
        if name in self._number:
            return
        arrays: dict[str, npt.NDArray[Any]] = {
            "depth": depth.astype(np.float32),
            "confidence": np.minimum(confidence, np.finfo(np.float16).max).astype(np.float16),
        }
        number = len(self._number)
        write_arrays(self._folder / f"{number:08d}.safetensors", arrays)
        self._number[name] = number

    def finish(self) -> None:
        """Say which file is whose."""
        write_json(self._folder / _NAMES, list(self._number))


@dataclass(frozen=True)
class JoinedDepthMaps:
    """The maps of two stages, of different images; implements ``DepthMaps``."""

    first: DepthMaps
    second: DepthMaps

    def __contains__(self, name: str) -> bool:
        return name in self.first or name in self.second

    def depth(self, name: str) -> npt.NDArray[np.float32]:
        """See ``DepthMaps``."""
        return self._of(name).depth(name)

    def confidence(self, name: str) -> npt.NDArray[np.float32]:
        """See ``DepthMaps``."""
        return self._of(name).confidence(name)

    def _of(self, name: str) -> DepthMaps:
        return self.first if name in self.first else self.second


def depth_maps_of_run(work: Path) -> DepthMaps:
    """The maps of a finished run: those of stitching, and those carried over to images that are no keyframes."""
    stitched = StoredDepthMaps(work / STITCHED_STAGE)
    carried = work / CARRIED_DEPTH_STAGE
    return JoinedDepthMaps(stitched, StoredDepthMaps(carried)) if carried.exists() else stitched


class StoredDepthMaps:
    """What a ``DepthMapWriter`` wrote; implements ``DepthMaps``."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._number = {name: number for number, name in enumerate(read_json(folder / _NAMES))}

    def __contains__(self, name: object) -> bool:
        return name in self._number

    def depth(self, name: str) -> npt.NDArray[np.float32]:
        """(H, W) z-depth in units of the stitched world, 0 where there is none; KeyError without a map."""
        return read_array(self._path(name), "depth")

    def confidence(self, name: str) -> npt.NDArray[np.float32]:
        """(H, W), at least 1; KeyError without a map."""
        return read_array(self._path(name), "confidence").astype(np.float32)

    def _path(self, name: str) -> Path:
        return self._folder / f"{self._number[name]:08d}.safetensors"
