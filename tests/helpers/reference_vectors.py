"""The reference vectors of the network specification, and the tiny network they were made with."""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from smust3r_colmap.backbones.must3r import Network, load_checkpoint
from smust3r_colmap.backbones.must3r.architecture import MemoryMode

# The reference folder lies beside the data folder, unless told otherwise.
DATA = Path(os.environ.get("SMUST3R_DATA", Path(__file__).parents[3] / "shared" / "data"))
REFERENCE = Path(os.environ.get("SMUST3R_REFERENCE", DATA.parent / "reference"))
FOLDER = REFERENCE / "must3r" / "vectors"

needs_vectors = pytest.mark.skipif(not FOLDER.is_dir(), reason=f"no reference vectors at {FOLDER}")


def vector_path(name: str) -> Path:
    """Where one of the files lies."""
    return FOLDER / name


@cache
def vectors(name: str) -> Mapping[str, npt.NDArray[Any]]:
    """All arrays of one file, such as ``encoder.npz``."""
    with np.load(vector_path(name)) as stored:
        return dict(stored)


@cache
def tiny_network(memory_mode: MemoryMode | None = None, size: int | None = None) -> Network:
    """The network of ``tiny_checkpoint.pth``, as it is or with another memory or image size."""
    return load_checkpoint(vector_path("tiny_checkpoint.pth"), memory_mode=memory_mode, image_size=size)
