"""The scenes of a finished run on disk, so that they can be exported again without computing anything."""

from __future__ import annotations

from smust3r_colmap.products import FusedScene
from smust3r_colmap.storage.codec import Codec

FUSED_SCENES: Codec[tuple[FusedScene, ...]] = Codec(tuple[FusedScene, ...], "scenes")
