"""What the coordinates of a scene mean outside of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class WorldFrame:
    """The world frame of a scene; georeferencing will set the CRS, in which a point is its coordinates plus the offset.

    Args:
        metric: lengths are metres.
        crs: coordinate reference system of the axes, such as ``"EPSG:32632"``; None where the frame is arbitrary.
        offset_m: of the origin, in the axes of the CRS; kept apart because its digits do not fit into float32.

    Raises:
        ValueError: a CRS whose lengths are not metres, or an offset that is not finite or without CRS.
    """

    metric: bool
    crs: str | None = None
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if self.crs is not None and not (self.crs and self.metric):
            raise ValueError(f"WorldFrame: CRS {self.crs!r} needs a name and metric lengths")
        if len(self.offset_m) != 3 or not np.isfinite(self.offset_m).all():
            raise ValueError(f"WorldFrame: offset {self.offset_m} needs three finite numbers")
        if self.crs is None and any(self.offset_m):
            raise ValueError(f"WorldFrame: offset {self.offset_m} needs a CRS")
