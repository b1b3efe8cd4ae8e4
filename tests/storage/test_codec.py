"""Products on disk: what is read is what was written, to the last bit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from smust3r_colmap.errors import StorageError
from smust3r_colmap.geometry.affine3 import Affine3
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.se3 import SE3
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.geometry.sl4 import SL4
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.storage.codec import Codec


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    name: str
    points: FloatArray
    colours: FloatArray | None
    transform: Transform
    kind: Literal["a", "b"]
    path: Path | None
    cameras: dict[int, Intrinsics]
    numbers: tuple[float, ...]
    pair: tuple[int, str]


PART: Codec[Part] = Codec(Part, "part")
CAMERA = Intrinsics(model="SIMPLE_RADIAL", width=640, height=480, params=(600.1, 320, 240, -0.05))


def part(transform: Transform, **changes: Any) -> Part:
    rng = np.random.default_rng(0)
    facts: dict[str, Any] = {
        "name": "an ä and a \n",
        "points": rng.normal(size=(5, 3)),
        "colours": None,
        "transform": transform,
        "kind": "b",
        "path": Path("some/where"),
        "cameras": {7: CAMERA},
        "numbers": (0.1, math.nan, math.inf, -math.inf, 1e300),
        "pair": (3, "three"),
    }
    return Part(**{**facts, **changes})


@pytest.mark.parametrize("group", [Sim3, SE3, Affine3, SL4])
def test_every_field_comes_back_to_the_last_bit(group: type[Transform], tmp_path: Path) -> None:
    transform = group.exp(0.1 * np.random.default_rng(1).normal(size=group.DOF))
    parts = (part(transform), part(transform, colours=np.empty((0, 3)), path=None, cameras={}))
    codec: Codec[tuple[Part, ...]] = Codec(tuple[Part, ...], "parts")
    codec.write(tmp_path, parts)
    found = codec.read(tmp_path)
    assert len(found) == 2
    for one, other in zip(parts, found, strict=True):
        assert (one.name, one.kind, one.path, one.cameras, one.pair) == (
            other.name,
            other.kind,
            other.path,
            other.cameras,
            other.pair,
        )
        np.testing.assert_array_equal(one.points, other.points)
        np.testing.assert_array_equal(one.numbers, other.numbers)
        np.testing.assert_allclose(one.transform.matrix, other.transform.matrix, rtol=0, atol=1e-15)
        assert type(other.transform) is group
    assert found[0].colours is None
    assert found[1].colours is not None and found[1].colours.shape == (0, 3)


def test_what_was_read_is_written_alike_again(tmp_path: Path) -> None:
    (tmp_path / "again").mkdir()
    PART.write(tmp_path, part(Sim3.exp(np.full(7, 0.1))))
    first = PART.read(tmp_path)
    PART.write(tmp_path / "again", first)
    second = PART.read(tmp_path / "again")
    np.testing.assert_array_equal(first.transform.matrix, second.transform.matrix)
    assert (tmp_path / "part.safetensors").read_bytes() == (tmp_path / "again/part.safetensors").read_bytes()


def test_a_value_without_a_place_is_named(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"\.path: object has no place in a stored product"):
        PART.write(tmp_path, part(Sim3.identity(), path=object()))


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    PART.write(tmp_path, part(Sim3.identity()))
    (tmp_path / "part.safetensors").write_bytes(b"short")
    with pytest.raises(StorageError, match=r"part\.safetensors: is damaged"):
        PART.read(tmp_path)
