"""The world frame: what it refuses, and that its offset keeps float64 on disk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from smust3r_colmap.geometry.world_frame import WorldFrame
from smust3r_colmap.storage.codec import Codec


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"metric": False, "crs": "EPSG:32632"}, "CRS 'EPSG:32632' needs a name and metric lengths"),
        ({"metric": True, "crs": ""}, "CRS '' needs a name and metric lengths"),
        ({"metric": True, "offset_m": (5e5, 0.0, 0.0)}, "needs a CRS"),
        ({"metric": True, "crs": "EPSG:32632", "offset_m": (5e5, float("nan"), 0.0)}, "three finite numbers"),
        ({"metric": True, "crs": "EPSG:32632", "offset_m": (5e5, 0.0)}, "three finite numbers"),
    ],
)
def test_a_frame_that_makes_no_sense_is_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        WorldFrame(**values)


@pytest.mark.parametrize(
    "frame",
    [
        WorldFrame(metric=False),
        WorldFrame(metric=True, crs="EPSG:32632", offset_m=(500_000.000_001, 5_400_000.000_001, 412.3)),
    ],
)
def test_a_frame_comes_back_from_disk_to_the_last_digit(frame: WorldFrame, tmp_path: Path) -> None:
    codec: Codec[WorldFrame] = Codec(WorldFrame, "frame")
    codec.write(tmp_path, frame)
    assert codec.read(tmp_path) == frame
